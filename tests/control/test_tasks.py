"""Tasks: their Jacobians by differences, their priorities by pseudo-inverses, their protection in exact arithmetic."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from random_robots import random_robot, random_state
from scipy.spatial.transform import Rotation
from test_law import EPS, exact_residual, kernel_J_sub, random_protection

import ssm_decouple as ssm
from ssm_decouple import (
    BoresightTask,
    OrientationTask,
    PoseTask,
    PositionTask,
    PostureTask,
    Protection,
    SelectiveLaw,
)
from ssm_decouple.control import kernel

START = np.deg2rad([150, -20, -10, 0, 0, 0])


def a_link_on_the_arm(robot: ssm.Robot) -> str:
    """A link other than the end-effector's that a joint carries."""
    frames = {frame.name: frame.parentJoint for frame in robot.model.frames if frame.name in robot.link_names}
    return next(name for name, joint in frames.items() if joint > 1)


def random_rotation(rng) -> np.ndarray:
    return Rotation.random(random_state=rng).as_matrix()


def error_by_another_route(robot, task, q, target) -> np.ndarray:
    """Each task's error from Pinocchio's frame placements and SciPy's rotations."""
    if isinstance(task, PostureTask):
        names = task.joints or robot.joint_names
        positions = robot.joint_positions(q)[[robot.joint_index(name) for name in names]]
        left = np.asarray(target) - positions
        turning = [robot.model.joints[robot.joint_index(name) + 2].nq == 2 for name in names]
        return np.where(turning, (left + np.pi) % (2 * np.pi) - np.pi, left)
    pose = robot.frame_pose(q, task.frame)
    if isinstance(task, PositionTask):
        return target - pose.translation
    if isinstance(task, OrientationTask):
        return Rotation.from_matrix(target @ pose.rotation.T).as_rotvec()
    if isinstance(task, PoseTask):
        turn = Rotation.from_matrix(target.rotation @ pose.rotation.T).as_rotvec()
        return np.r_[target.translation - pose.translation, turn]
    raise AssertionError(task)


def cases_of(robot, rng) -> list[tuple]:
    """Pairs of a task and a target for it."""
    link = a_link_on_the_arm(robot)
    some = tuple(rng.permutation(robot.joint_names)[:2].tolist())
    pose = pin.SE3(random_rotation(rng), rng.uniform(-2, 2, 3))
    return [
        (PositionTask(), rng.uniform(-2, 2, 3)),
        (PositionTask(link), rng.uniform(-2, 2, 3)),
        (OrientationTask(), random_rotation(rng)),
        (OrientationTask(link), random_rotation(rng)),
        (PoseTask(), pose),
        (PoseTask(link), pose),
        (PostureTask(), rng.uniform(-1, 1, robot.n_joints)),
        (PostureTask(some), rng.uniform(-1, 1, 2)),
        (BoresightTask(rng.normal(size=3)), rng.normal(size=3)),
        (BoresightTask(rng.normal(size=3), link), rng.normal(size=3)),
    ]


def task_jacobian(law: SelectiveLaw, q: np.ndarray, target) -> np.ndarray:
    """The rows that the kernel forms, by levels."""
    model, data, _, constants, fixed = law._prepared
    pin.computeCentroidalMap(model, data, q)
    kernel.read_joints(q, constants[2])
    matrices, rates = np.zeros((kernel.J_TASK + law.layout.size, law.robot.n_joints)), np.zeros(law.layout.size)
    targets, velocities = law.layout.flat_targets(target), law.layout.flat_velocities(None)
    drift, out = np.zeros((len(matrices), 1)), np.zeros(law.size)
    assert kernel.add_matrices(*fixed, targets, velocities, 1.0, matrices, drift, rates, out) == kernel.OK
    return matrices[kernel.J_TASK :]


@pytest.mark.parametrize("seed", range(4))
def test_errors_and_jacobians(seed, rng):
    """The error by another route, and how the frame moves while the base follows: minus the error's rate near zero."""
    robot = random_robot(80 + seed, joints=4 + seed)
    for task, target in cases_of(robot, rng):
        law, q = SelectiveLaw(robot, Protection("none"), tasks=task), random_state(robot, rng)
        error = law(q, target).errors[0]
        if not isinstance(task, BoresightTask):
            np.testing.assert_allclose(error, error_by_another_route(robot, task, q, target), atol=1e-12)
        J = task_jacobian(law, q, target)
        rates, step = rng.uniform(-1, 1, robot.n_joints), 1e-6
        v = np.r_[robot.coupling(q).J_base @ rates, rates]
        # From where the task is met: there the error is minus the small motion, in any good coordinates.
        met = target_that_is_met(robot, task, q)
        J_met = task_jacobian(law, q, met)
        if not isinstance(task, BoresightTask):
            np.testing.assert_allclose(J_met, J, atol=1e-12)
        ahead, behind = (law(pin.integrate(robot.model, q, sign * step * v), met).errors[0] for sign in (1, -1))
        np.testing.assert_allclose((behind - ahead) / (2 * step), J_met @ rates, atol=1e-8)


def target_that_is_met(robot, task, q):
    if isinstance(task, PostureTask):
        return robot.joint_positions(q)[[robot.joint_index(name) for name in task.joints or robot.joint_names]]
    pose = robot.frame_pose(q, task.frame)
    if isinstance(task, BoresightTask):
        return 3.0 * pose.rotation @ task.direction
    return {PositionTask: pose.translation, OrientationTask: pose.rotation, PoseTask: pose}[type(task)]


def test_a_boresight_s_error_is_the_angle_and_its_rate_shrinks_it(rng):
    """d(angle)/dt = -gain angle, for any axes across: the angle by arctan2 of cross and dot product."""
    robot = random_robot(90, joints=7, branching=0.0)
    for _ in range(20):
        direction, target, q = rng.normal(size=3), rng.normal(size=3), random_state(robot, rng)
        law = SelectiveLaw(
            robot, Protection("yaw"), tasks=BoresightTask(direction), gain=0.2, rate_limit=np.inf, damping=0
        )

        def angle(q, direction=direction, target=target):
            seen = robot.frame_pose(q).rotation @ direction
            return np.arctan2(np.linalg.norm(np.cross(seen, target)), seen @ target)

        command = law(q, target)
        assert np.linalg.norm(command.errors[0]) == pytest.approx(angle(q), abs=1e-12)
        ahead, behind = (angle(pin.integrate(robot.model, q, s * command.velocity)) for s in (1e-6, -1e-6))
        assert (ahead - behind) / 2e-6 == pytest.approx(-0.2 * angle(q), abs=1e-7)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 1e-4, 1.0, 3.0, np.pi - 1e-4, np.pi - 1e-8, np.pi])
def test_rotation_vectors_near_zero_and_near_pi(rng, angle):
    for axis in [*np.eye(3), *(rng.normal(size=(20, 3)))]:
        expected = angle * axis / np.linalg.norm(axis)
        R, vector = Rotation.from_rotvec(expected).as_matrix(), np.empty(3)
        kernel.rotation_vector(R, vector)
        if angle == np.pi and vector @ expected < 0:
            vector *= -1  # both are right
        np.testing.assert_allclose(vector, expected, atol=4e-15, rtol=0)


def stacked(robot, tasks, protection, q, targets, gain):
    """Hierarchical least squares by pseudo-inverses in an orthonormal basis of what is left."""
    coupling, rates = robot.coupling(q), np.zeros(robot.n_joints)
    Z = protection.null_space_basis(coupling)
    worst = np.linalg.cond(protection.J_sub(coupling)) if protection.k else 1.0
    for level in sorted({task.level for task in tasks}):
        rows, wishes = [], []
        for task, target in zip(tasks, targets, strict=True):
            if task.level == level:
                law = SelectiveLaw(robot, Protection("none"), tasks=task)
                J = task_jacobian(law, q, target) / np.sqrt(task.weight)
                rows.append(np.sqrt(task.weight) * J)
                wish = (task.gain or gain) * error_by_another_route(robot, task, q, target)
                wishes.append(np.sqrt(task.weight) * wish)
        J, v = np.vstack(rows), np.concatenate(wishes)
        if Z.shape[1] == 0:
            break
        rates = rates + Z @ (np.linalg.pinv(J @ Z, rcond=1e-9) @ (v - J @ rates))
        _, singular, right = np.linalg.svd(J @ Z)
        rank = int(np.sum(singular > 1e-9 * singular[0]))
        worst = max(worst, singular[0] / singular[rank - 1])
        Z = Z @ right[rank:].T
    return rates, worst


@pytest.mark.parametrize("frame", ["base", "inertial"])
@pytest.mark.parametrize("k", [0, 1, 2, 3])
def test_priorities_by_an_independent_solver(rng, k, frame):
    for seed in range(6):
        robot = random_robot(100 + seed, joints=6 + seed)
        link, n = a_link_on_the_arm(robot), robot.n_joints
        sets = [
            [PositionTask(), PostureTask(level=2)],
            [PositionTask(weight=4.0), OrientationTask(weight=0.25, gain=0.7)],
            [PostureTask(level=7), PoseTask(level=3)],
            [PositionTask(link, level=2), PositionTask(), PostureTask(level=3)],
            [PoseTask()],
        ]
        for tasks in sets:
            levels = sorted({task.level for task in tasks})
            if len(levels) > 1 and any(isinstance(task, PoseTask) for task in tasks) and n - k <= 6:
                continue
            if (len(levels) == 3 and n - k <= 6) or (len(levels) == 2 and n - k <= 3):
                continue
            protection, q = random_protection(rng, k, frame), random_state(robot, rng)
            law = SelectiveLaw(robot, protection, gain=0.3, damping=0.0, rate_limit=np.inf, tasks=tasks)
            targets = [
                {
                    PositionTask: rng.uniform(-2, 2, 3),
                    OrientationTask: random_rotation(rng),
                    PoseTask: pin.SE3(random_rotation(rng), rng.uniform(-2, 2, 3)),
                    PostureTask: rng.uniform(-1, 1, n),
                }[type(task)]
                for task in tasks
            ]
            command = law(q, targets[0] if len(tasks) == 1 else targets)
            expected, condition = stacked(robot, tasks, protection, q, targets, 0.3)
            size = 1 + np.linalg.norm(expected)
            np.testing.assert_allclose(command.joint_rates, expected, atol=1e-12 * condition**2 * size)
            for task, target, error in zip(tasks, targets, command.errors, strict=True):
                np.testing.assert_allclose(error, error_by_another_route(robot, task, q, target), atol=1e-12)


def test_a_lower_level_does_not_disturb_a_higher_one(rng):
    for seed in range(10):
        robot = random_robot(120 + seed, joints=8)
        protection, q = random_protection(rng, 2), random_state(robot, rng)
        target, posture = rng.uniform(-2, 2, 3), rng.uniform(-1, 1, 8)
        alone = SelectiveLaw(robot, protection, gain=0.3, rate_limit=np.inf)
        both = SelectiveLaw(
            robot, protection, gain=0.3, rate_limit=np.inf, tasks=[PositionTask(), PostureTask(level=2, gain=2.0)]
        )
        J, first = robot.coupling(q).J_gt, alone(q, target)
        command = both(q, [target, posture])
        size = np.linalg.norm(J, 2) * np.linalg.norm(command.joint_rates)
        assert np.linalg.norm(J @ (command.joint_rates - first.joint_rates)) <= 16 * EPS * size
        assert np.linalg.norm(command.joint_rates - first.joint_rates) > 1e-3
        assert command.smallest_singular_value == pytest.approx(first.smallest_singular_value, rel=1e-12)
        assert command.smallest_singular_values.shape == command.dampings.shape == (2,)


def test_a_level_that_is_met_in_part_leaves_the_rest_to_the_next(write):
    """A planar arm cannot leave its plane: the third row of its position must not cost a freedom."""
    from test_law import planar_robot

    robot = planar_robot(write)
    law = SelectiveLaw(
        robot, Protection("none"), damping=0.0, rate_limit=np.inf, tasks=[PositionTask(), PostureTask(("j3",), level=2)]
    )
    q = robot.configuration([0.3, 0.8, -0.6])
    command = law(q, [robot.frame_pose(q).translation + [0.1, 0.1, 0.3], [0.4]])
    np.testing.assert_allclose(robot.coupling(q).J_gt[:2] @ command.joint_rates, [0.005, 0.005], atol=1e-15)
    assert command.joint_rates[2] == pytest.approx(0.05 * 1.0, rel=1e-12)


@pytest.mark.parametrize("k", [1, 2, 3])
@pytest.mark.parametrize("limit", [np.deg2rad(5.0), np.inf])
def test_the_protected_rate_is_rounding_in_exact_arithmetic(rng, k, limit):
    worst = 0.0
    for seed in range(8):
        robot = random_robot(140 + seed, joints=6 + seed % 3)
        for tasks in (
            [PoseTask()],
            [PositionTask(), BoresightTask([0, 0, 1])],
            [PositionTask(), PostureTask(("j07",) if "j07" in robot.joint_names else None)],
        ):
            protection, q = random_protection(rng, k), random_state(robot, rng)
            law = SelectiveLaw(robot, protection, gain=1.0, rate_limit=limit, tasks=tasks)
            targets = [
                pin.SE3(random_rotation(rng), rng.uniform(-2, 2, 3))
                if isinstance(task, PoseTask)
                else rng.uniform(-2, 2, task.sizes(robot)[0])
                for task in tasks
            ]
            command = law(q, targets[0] if len(tasks) == 1 else targets)
            J_sub = kernel_J_sub(robot, protection, q)
            size = np.linalg.norm(J_sub, 2) * np.linalg.norm(command.joint_rates)
            residual = exact_residual(J_sub, command.joint_rates)
            assert residual <= 2 * EPS * size
            assert np.abs(command.joint_rates).max() <= limit
            worst = max(worst, residual / (EPS * size)) if size else worst
    assert 0 < worst <= 2


@pytest.mark.parametrize("bend", [1e-3, 1e-9, 0.0])
def test_next_to_a_singularity(ets_vii, rng, bend):
    q = ets_vii.configuration([0.3, 0.2, np.pi / 2 - bend, bend, -bend, 0.1])
    for axes in ("yaw", "all"):
        protection = Protection(axes)
        law = SelectiveLaw(ets_vii, protection, tasks=PoseTask())
        command = law(q, pin.SE3(random_rotation(rng), rng.uniform(-2, 2, 3)))
        J_sub = kernel_J_sub(ets_vii, protection, q)
        assert np.all(np.isfinite(command.values))
        assert np.abs(command.joint_rates).max() <= np.deg2rad(5.0)
        assert command.regularised
        size = np.linalg.norm(J_sub, 2) * np.linalg.norm(command.joint_rates)
        assert exact_residual(J_sub, command.joint_rates) <= 2 * EPS * size


def test_one_position_is_the_law_without_tasks(ets_vii, rng):
    for options in ({}, {"sample_time": 0.1, "hold_nodes": 2}):
        plain = SelectiveLaw(ets_vii, Protection("yaw"), **options)
        named = SelectiveLaw(ets_vii, Protection("yaw"), tasks=[PositionTask("end_effector")], **options)
        for _ in range(5):
            q, target, velocity = random_state(ets_vii, rng), rng.uniform(-2, 2, 3), rng.normal(size=3)
            np.testing.assert_array_equal(named(q, target, velocity).values, plain(q, target, velocity).values)


def test_a_pose_is_a_position_and_an_orientation(rng):
    robot = random_robot(160, joints=8)
    q, velocity = random_state(robot, rng), rng.normal(size=6)
    pose = pin.SE3(random_rotation(rng), rng.uniform(-2, 2, 3))
    for options in ({}, {"sample_time": 0.1, "hold_nodes": 2}):
        one = SelectiveLaw(robot, Protection("yaw"), tasks=PoseTask(), **options)
        two = SelectiveLaw(robot, Protection("yaw"), tasks=[PositionTask(), OrientationTask()], **options)
        expected = two(q, [pose.translation, pose.rotation], [velocity[:3], velocity[3:]])
        for target in (pose, pose.homogeneous, pose.homogeneous.tolist()):
            command = one(q, target, velocity)
            np.testing.assert_array_equal(command.joint_rates, expected.joint_rates)
            np.testing.assert_array_equal(command.errors[0], np.concatenate(expected.errors))


def test_the_lost_direction_and_the_row_that_takes_it(write, ets_vii, rng):
    """A planar arm cannot leave its plane, whatever is protected; five joints lose a row to three protected ones."""
    from test_law import planar_robot

    robot = planar_robot(write)
    q = robot.configuration([0.3, 0.8, -0.6])
    lost = SelectiveLaw(robot, Protection("yaw")).lost_direction(q)
    np.testing.assert_allclose(np.abs(lost.direction), [0, 0, 1], atol=1e-12)
    assert lost.singular_value == pytest.approx(0, abs=1e-15)
    np.testing.assert_allclose(lost.without, 0, atol=1e-15)  # the arm itself is singular
    # Five joints, three protected: one of the three rows of position is lost to the protection.
    robot = random_robot(180, joints=5, branching=0.0)
    q, protection = random_state(robot, rng), Protection("all")
    lost = SelectiveLaw(robot, protection).lost_direction(q)
    coupling = robot.coupling(q)
    assert np.linalg.norm(lost.direction) == pytest.approx(1)
    np.testing.assert_allclose(lost.direction @ coupling.J_gt @ protection.N_sub(coupling), 0, atol=1e-12)
    for i, axes in enumerate(("pitch+yaw", "roll+yaw", "roll+pitch")):
        freed = lost.direction @ coupling.J_gt @ Protection(axes).N_sub(coupling)
        assert lost.without[i] == pytest.approx(np.linalg.norm(freed), rel=1e-9)
        assert lost.without[i] > 1e-6
    # The smallest singular value is what the command tells.
    q, law = random_state(ets_vii, rng), SelectiveLaw(ets_vii, Protection("yaw"))
    assert law.lost_direction(q).singular_value == pytest.approx(law(q, [0, 0, 1]).smallest_singular_value, rel=1e-9)


# Motions.


def falls_as_the_gain_says(motion, gain, tolerance=1e-6):
    error = np.linalg.norm(motion.task_error.values, axis=1)
    np.testing.assert_allclose(error, error[0] * np.exp(-gain * motion.time.values), rtol=tolerance)


def test_a_pose_is_reached_as_the_gain_says(rng):
    """Seven joints and yaw protected leave six: the error falls exactly exponentially, its two halves alike."""
    robot = random_robot(171, joints=8, branching=0.0)
    q = robot.configuration(rng.uniform(-1, 1, 8))
    pose = robot.frame_pose(q)
    target = pin.SE3(pin.exp3(np.array([0.02, -0.03, 0.025])) @ pose.rotation, pose.translation + [0.03, -0.02, 0.02])
    law = SelectiveLaw(robot, Protection("yaw"), gain=0.5, rate_limit=np.inf, damping=0.0, tasks=PoseTask())
    motion = ssm.simulate(law, q, target, 10.0, 0.05, method="rk4")
    falls_as_the_gain_says(motion, 0.5)
    error = motion.task_error.values
    for half in (error[:, :3], error[:, 3:]):
        size = np.linalg.norm(half, axis=1)
        np.testing.assert_allclose(size, size[0] * np.exp(-0.5 * motion.time.values), rtol=1e-6)
        np.testing.assert_allclose(half[-1] / size[-1], half[0] / size[0], atol=1e-6)  # a straight line, one axis
    assert np.abs(motion.protected_rate).max() < 1e-15
    assert list(motion.task_row.values) == [f"end_effector {name}" for name in ("x", "y", "z", "rx", "ry", "rz")]
    assert motion.attrs["final_error"] == pytest.approx(np.linalg.norm(error[-1]))


def test_position_and_line_of_sight_with_yaw_protected(ets_vii):
    """Case 1's start; three and two rows are what six joints can do beside one protected direction."""
    q, direction = ets_vii.configuration(START), [0.0, 0.0, 1.0]
    pose = ets_vii.frame_pose(q)
    look = pin.exp3(np.array([0.1, 0.15, 0.0])) @ pose.rotation @ direction
    law = SelectiveLaw(ets_vii, Protection("yaw"), gain=0.05, tasks=[PositionTask(), BoresightTask(direction)])
    motion = ssm.simulate(law, q, [pose.translation + [0.1, 0.05, -0.05], look], 120.0, 0.1, method="rk4")
    assert motion.attrs["outcome"] == "converged"
    assert motion.attrs["final_error"] < 1e-3
    free = motion.isel(time=motion.rate_scale.values == 1.0)
    error = np.linalg.norm(free.task_error.values, axis=1)
    np.testing.assert_allclose(error, error[0] * np.exp(-0.05 * (free.time - free.time[0]).values), rtol=1e-5)
    assert np.abs(motion.protected_rate).max() < 1e-17
    np.testing.assert_allclose(
        motion.end_effector_error, np.linalg.norm(motion.task_error.values[:, :3], axis=1), rtol=1e-12
    )


def test_a_pose_with_yaw_protected(ets_vii):
    """Six rows on five freedoms: a pose to which a protected motion leads is met in the least-squares sense."""
    q = ets_vii.configuration(START)
    protection = Protection("yaw")
    away = SelectiveLaw(ets_vii, protection, tasks=PostureTask())
    there = ssm.simulate(away, q, ets_vii.joint_positions(q) + [0.05, 0.04, -0.05, 0.04, 0.03, -0.04], 100.0, 0.1)
    reachable = ets_vii.frame_pose(there.configuration.values[-1])
    law = SelectiveLaw(ets_vii, protection, tasks=PoseTask())
    motion = ssm.simulate(law, q, reachable, 200.0, 0.1)
    error = np.linalg.norm(motion.task_error.values, axis=1)
    assert error[-1] < 0.05 * error[0]
    assert np.abs(motion.protected_rate).max() < 1e-17
    assert float(motion.smallest_singular_value.max()) == 0.0


def test_moving_targets_are_followed(rng):
    """A target that moves, turns and bends: with its velocity fed forward no error arises."""
    robot = random_robot(171, joints=8, branching=0.0)
    q = robot.configuration(rng.uniform(-1, 1, 8))
    pose, line = robot.frame_pose(q), [0.3, -0.2, 0.9]
    velocity, spin = np.array([0.01, -0.005, 0.008]), np.array([0.01, 0.006, -0.008])

    def moved(time):
        return pin.SE3(pin.exp3(time * spin) @ pose.rotation, pose.translation + time * velocity)

    def pose_target(time):
        return moved(time), np.r_[velocity, spin]

    def sight_target(time):
        return [moved(time).translation, moved(time).rotation @ line], [velocity, spin]

    for tasks, target in ((PoseTask(), pose_target), ([PositionTask(), BoresightTask(line)], sight_target)):
        law = SelectiveLaw(robot, Protection("yaw"), rate_limit=np.inf, damping=0.0, tasks=tasks)
        motion = ssm.simulate(law, q, target, 5.0, 0.05, method="rk4")
        assert np.abs(motion.task_error).max() < 1e-8
        planned = SelectiveLaw(
            robot, Protection("yaw"), rate_limit=np.inf, damping=0.0, tasks=tasks, sample_time=0.05, hold_nodes=2
        )
        held = ssm.simulate(planned, q, target, 5.0, 0.05, method="held")
        assert np.abs(held.task_error).max() < 1e-5
        assert np.abs(held.protected_angle).max() < 1e-11


def test_limits_and_holds_with_tasks(ets_vii):
    q = ets_vii.configuration(START)
    pose = ets_vii.frame_pose(q)
    targets = [pose.translation + [0.3, -0.2, 0.2], pose.rotation @ [0.3, 0.1, 0.9]]
    tasks = [PositionTask(), BoresightTask([0.0, 0.0, 1.0], level=2)]
    options = {"rate_limit": 0.05, "sample_time": 0.2, "hold_nodes": 2, "acceleration_limit": 0.02}
    law = SelectiveLaw(ets_vii, Protection("yaw"), tasks=tasks, **options)
    motion = ssm.simulate(law, q, targets, 40.0, 0.2, method="held")
    rates = motion.joint_rates.values
    assert np.abs(rates).max() <= 0.05
    assert np.abs(np.diff(rates, axis=0))[motion.rate_blend.values[1:] > 0].max() <= 0.02 * 0.2
    assert np.abs(motion.protected_angle).max() < 1e-10
    assert float(motion.plan_change.max()) < 1e-10
    assert "task_level" in motion.coords


def test_a_protected_rate_that_is_asked_for_with_tasks(ets_vii, rng):
    protection = Protection("yaw")
    law = SelectiveLaw(
        ets_vii, protection, rate_limit=np.inf, damping=0.0, tasks=[PositionTask(), BoresightTask([1, 0, 0])]
    )
    for _ in range(10):
        q = random_state(ets_vii, rng)
        command = law(q, [rng.uniform(-2, 2, 3), rng.normal(size=3)], protected_rate=[1e-3])
        np.testing.assert_allclose(command.protected_rate, [1e-3], rtol=1e-10)
        J = ets_vii.coupling(q).J_gt
        scale = np.linalg.norm(J) * np.linalg.norm(command.joint_rates)
        np.testing.assert_allclose(J @ command.joint_rates, 0.05 * command.errors[0], atol=1e-12 * scale)


def test_the_record_of_other_tasks(ets_vii, tmp_path):
    law = SelectiveLaw(ets_vii, Protection("yaw"), tasks=PostureTask(("joint_1", "joint_2")))
    motion = ssm.simulate(law, ets_vii.configuration(), [0.1, 0.2], 2.0, 0.1)
    assert np.all(np.isnan(motion.end_effector_error))
    assert np.all(np.isnan(motion.target_position))
    assert list(motion.task_row.values) == ["joint joint_1", "joint joint_2"]
    again = ssm.load_motion(ssm.save_motion(motion, tmp_path / "motion.nc"))
    np.testing.assert_array_equal(again.task_error, motion.task_error)
    usual = ssm.simulate(SelectiveLaw(ets_vii, Protection("yaw")), ets_vii.configuration(), [1, 0, 2], 1.0, 0.1)
    assert "task_error" not in usual


def test_the_view_of_all_placements_is_pinocchio_s(ets_vii, rng):
    law = SelectiveLaw(ets_vii, Protection("yaw"))
    model, data, (*_, placements), *_ = law._prepared
    law(random_state(ets_vii, rng), [1, 0, 0])
    for i in range(model.njoints):
        np.testing.assert_array_equal(placements[i, :9].reshape(3, 3).T, data.oMi[i].rotation)
        np.testing.assert_array_equal(placements[i, 9:], data.oMi[i].translation)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: [], "tasks is .*give one or more"),
        (lambda: "pose", "tasks is 'pose'"),
        (lambda: [PositionTask(), "pose"], "'pose' is no task"),
        (lambda: PositionTask("hand"), "no frame 'hand'"),
        (lambda: PostureTask(("joint_9",)), "no joint 'joint_9'"),
        (lambda: PostureTask(("joint_1", "joint_1")), "different joints"),
        (lambda: PostureTask(()), "one or more different joints"),
        (lambda: PositionTask(level=0), "level is 0"),
        (lambda: PositionTask(level=1.5), "level is 1.5"),
        (lambda: PositionTask(level=True), "level is True"),
        (lambda: PositionTask(weight=0.0), "weight is 0.0"),
        (lambda: PositionTask(gain=-1.0), "gain is -1.0"),
        (lambda: BoresightTask([0, 0, 0]), "not all zero"),
        (lambda: BoresightTask([0, 1]), "3 finite numbers"),
    ],
)
def test_bad_tasks_are_refused(ets_vii, make, says):
    with pytest.raises(ssm.InputError, match=says):
        SelectiveLaw(ets_vii, Protection("yaw"), tasks=make())


def test_a_task_on_a_fixed_frame_is_refused(ets_vii):
    with pytest.raises(ssm.InputError, match="no joint carries it, it is fixed to the base"):
        SelectiveLaw(ets_vii, Protection("yaw"), tasks=PoseTask(ets_vii.link_names[0]))


def test_a_protection_that_leaves_nothing_is_refused():
    robot = random_robot(42, joints=3, branching=0.0)
    with pytest.raises(ssm.InputError, match=r"takes 3 of the 3 freedoms .* leaves 0 to the tasks, which have 3 rows"):
        SelectiveLaw(robot, Protection("all"), tasks=PositionTask())
    with pytest.warns(ssm.DecoupleWarning, match="nothing is left for the tasks from level 2"):
        SelectiveLaw(robot, Protection("none"), tasks=[PositionTask(), PostureTask(level=2)])


def test_bad_targets_are_refused(ets_vii):
    q = ets_vii.configuration(START)
    skew = np.eye(3)
    skew[0, 1] = 0.1
    tilted = np.eye(4)
    tilted[:3, :3] = skew
    for task, target, says in [
        (OrientationTask(), skew, "no rotation"),
        (OrientationTask(), -np.eye(3), "no rotation"),
        (OrientationTask(), np.zeros((3, 3)), "no rotation"),
        (OrientationTask(), np.full((3, 3), np.nan), "target is not finite"),
        (OrientationTask(), [0, 0, 1], r"shape \(3,\); it needs a rotation matrix"),
        (PoseTask(), tilted, "no rotation"),
        (PoseTask(), [0, 0, 1], "homogeneous matrix"),
        (PoseTask(), 2 * np.eye(4), "last row is 0 0 0 1"),
        (BoresightTask([0, 0, 1]), [0, 0, 0], "zero: it has no direction"),
        (BoresightTask([0, 0, 1]), [0, 0], "it needs 3 numbers"),
        (PostureTask(), [0, 0], "it needs 6 numbers"),
        ([PositionTask(), PostureTask(level=2)], [0, 0, 1], "give 2, one a task, in their order: position, posture"),
        ([PositionTask(), PostureTask(level=2)], 1.0, "give 2"),
        ([PositionTask(), PostureTask(level=2)], [[0, 0], np.zeros(6)], r"position target has shape \(2,\)"),
    ]:
        with pytest.raises(ssm.InputError, match=says):
            SelectiveLaw(ets_vii, Protection("yaw"), tasks=task)(q, target)
    law = SelectiveLaw(ets_vii, Protection("yaw"), tasks=PoseTask())
    with pytest.raises(ssm.InputError, match="target velocity of a pose task has shape"):
        law(q, pin.SE3.Identity(), [0, 0, 0])
    with pytest.raises(ssm.InputError, match="16 numbers"):
        law.evaluate(q, np.zeros(3), np.zeros(6), np.empty(law.size))
