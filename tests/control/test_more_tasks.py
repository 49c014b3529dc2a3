"""Tasks between two frames, and the task that climbs: by differences, pseudo-inverses and exact arithmetic."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from random_robots import random_robot, random_state
from scipy.spatial.transform import Rotation
from test_law import EPS, exact_residual, kernel_J_sub, random_protection
from test_tasks import START, random_rotation, task_jacobian

import ssm_decouple as ssm
from ssm_decouple import (
    BoresightTask,
    ManipulabilityTask,
    OrientationTask,
    PositionTask,
    PostureTask,
    Protection,
    RelativePoseTask,
    SelectiveLaw,
)

UR5 = "ur_description/urdf/ur5_robot.urdf"
BENT = [0.3, -1.0, 1.3, -0.5, 0.7, 0.2]


@pytest.fixture(scope="module")
def two_arms() -> ssm.Robot:
    one = ssm.compose("ets_vii_bus", ssm.example_robot(UR5), [0.5, 0, 1.0], prefix="left_", end_effector="tool0")
    return ssm.compose(one, ssm.example_robot(UR5), [-0.5, 0, 1.0], prefix="right_", end_effector="tool0")


# A frame, and the one in which its target stands: on the other arm, on the base, further out, further in.
PAIRS = [
    ("left_tool0", "right_tool0"),
    ("right_wrist_1_link", "left_forearm_link"),
    ("left_tool0", "bus"),
    ("bus", "left_tool0"),
    ("left_forearm_link", "left_tool0"),
    ("left_tool0", "left_upper_arm_link"),
]


def relative_pose(robot, frame, reference, q) -> pin.SE3:
    return robot.frame_pose(q, reference).inverse() * robot.frame_pose(q, frame)


@pytest.mark.parametrize(("frame", "reference"), PAIRS)
def test_a_relative_pose_s_error_and_jacobian(two_arms, rng, frame, reference):
    law, step = SelectiveLaw(two_arms, Protection("none"), tasks=RelativePoseTask(frame, reference)), 1e-6
    for _ in range(3):
        q, target = random_state(two_arms, rng), pin.SE3(random_rotation(rng), rng.uniform(-2, 2, 3))
        error, X = law(q, target).errors[0], relative_pose(two_arms, frame, reference, q)
        np.testing.assert_allclose(error[:3], target.translation - X.translation, atol=1e-13)
        turn = Rotation.from_matrix(target.rotation @ X.rotation.T).as_rotvec()
        np.testing.assert_allclose(error[3:], turn, atol=1e-12)
        J, J_base = task_jacobian(law, q, target), two_arms.coupling(q).J_base
        for j in range(two_arms.n_joints):
            v = step * np.r_[J_base[:, j], np.eye(two_arms.n_joints)[j]]  # as the free base answers
            before, after = (
                relative_pose(two_arms, frame, reference, pin.integrate(two_arms.model, q, sign * v))
                for sign in (-1, 1)
            )
            slope = np.r_[after.translation - before.translation, pin.log3(after.rotation @ before.rotation.T)]
            np.testing.assert_allclose(J[:, j], slope / (2 * step), atol=1e-8)


def test_the_base_plays_no_part(two_arms, rng):
    """Neither its pose nor its inertia nor momentum on board changes what the joints do for the task."""
    heavy = two_arms.with_payload(5000.0, [0.1, 0.2, 0.3], 3000.0 * np.eye(3), "bus")
    task, target = RelativePoseTask("left_tool0", "right_tool0"), pin.SE3(random_rotation(rng), rng.uniform(-1, 1, 3))
    joints = rng.uniform(-1, 1, 12)
    expected = SelectiveLaw(two_arms, Protection("none"), tasks=task)(two_arms.configuration(joints), target)
    for robot, momentum in ((two_arms, None), (heavy, None), (two_arms, rng.normal(size=6))):
        pose = pin.SE3(random_rotation(rng), rng.uniform(-1, 1, 3))
        law = SelectiveLaw(robot, Protection("none"), tasks=task, momentum=momentum)
        command = law(robot.configuration(joints, pose), target)
        np.testing.assert_allclose(command.joint_rates, expected.joint_rates, atol=1e-12)
        np.testing.assert_allclose(command.errors[0], expected.errors[0], atol=1e-12)


@pytest.mark.parametrize("held", [False, True])
def test_a_relative_pose_is_reached_as_the_gain_says(two_arms, held):
    q = two_arms.configuration(BENT + [-x for x in BENT])
    X = relative_pose(two_arms, "left_tool0", "right_tool0", q)
    target = pin.SE3(X.rotation @ pin.exp3(np.array([0.1, -0.05, 0.08])), X.translation + [0.05, -0.04, 0.03])
    options = {"gain": 0.5, "rate_limit": np.inf, "damping": 0.0}
    if held:
        options |= {"sample_time": 0.1, "hold_nodes": 2}
    tasks = RelativePoseTask("left_tool0", "right_tool0")
    law = SelectiveLaw(two_arms, Protection("roll+yaw"), tasks=tasks, **options)
    motion = ssm.simulate(law, q, target, 10.0, 0.1, "held" if held else "rk4")
    error = motion.task_error.values
    assert list(motion.task_row.values[[0, 5]]) == ["left_tool0 in right_tool0 x", "left_tool0 in right_tool0 rz"]
    assert np.all(np.isnan(motion.end_effector_error))
    if not held:
        for half in (error[:, :3], error[:, 3:]):
            size = np.linalg.norm(half, axis=1)
            np.testing.assert_allclose(size, size[0] * np.exp(-0.5 * motion.time.values), rtol=1e-5)
    assert np.linalg.norm(error[-1]) < 0.01 * np.linalg.norm(error[0])
    assert np.abs(motion.protected_rate).max() < 1e-16
    end = relative_pose(two_arms, "left_tool0", "right_tool0", motion.configuration.values[-1])
    np.testing.assert_allclose(end.translation, target.translation, atol=1e-3)


def test_a_moving_relative_target_is_followed(two_arms):
    """Its velocity stands in the axes of the reference, which turn in space."""
    q = two_arms.configuration(BENT + [-x for x in BENT])
    X, v, w = relative_pose(two_arms, "left_tool0", "right_tool0", q), [0.01, -0.005, 0.004], [0.02, 0.01, -0.015]

    def target(time):
        moved = pin.SE3(pin.exp3(time * np.array(w)) @ X.rotation, X.translation + time * np.array(v))
        return [moved, two_arms.frame_pose(q, "right_tool0").translation + [0.0, 0.0, 0.01 * time]], [
            np.r_[v, w],
            [0, 0, 0.01],
        ]

    tasks = [RelativePoseTask("left_tool0", "right_tool0"), PositionTask("right_tool0")]
    law = SelectiveLaw(two_arms, Protection("yaw"), rate_limit=np.inf, damping=0.0, tasks=tasks)
    motion = ssm.simulate(law, q, target, 3.0, 0.05, "rk4")
    assert np.abs(motion.task_error).max() < 1e-8


@pytest.mark.parametrize(
    ("frames", "says"),
    [
        (("left_tool0", "left_tool0"), "no joint is between the two"),
        (("bus", "left_world"), "no joint is between the two"),
        (("left_tool0", "hand"), "no frame 'hand'"),
        (("hand", "left_tool0"), "no frame 'hand'"),
    ],
)
def test_frames_that_do_not_move_against_each_other_are_refused(two_arms, frames, says):
    with pytest.raises(ssm.InputError, match=says):
        SelectiveLaw(two_arms, Protection("yaw"), tasks=RelativePoseTask(*frames))
    law = SelectiveLaw(two_arms, Protection("yaw"), tasks=RelativePoseTask("left_tool0", "right_tool0"))
    with pytest.raises(ssm.InputError, match="a pose target has shape"):
        law(two_arms.configuration(BENT + BENT), [0, 0, 1])


def test_the_inertial_frame_is_no_reference(ets_vii):
    with pytest.raises(ssm.InputError):
        SelectiveLaw(ets_vii, Protection("yaw"), tasks=RelativePoseTask("end_effector", "universe"))


# The task that climbs.


def spare(seed: int) -> ssm.Robot:
    return random_robot(270 + seed, joints=8, branching=0.0)


def slope(robot, protection, q, step=1e-5) -> np.ndarray:
    """Gradient of log(manipulability) by central differences of `Coupling.manipulability`."""
    n, gradient = robot.n_joints, []
    for j in range(n):
        turn = np.r_[np.zeros(6), step * np.eye(n)[j]]
        up, down = (
            robot.coupling(pin.integrate(robot.model, q, sign * turn)).manipulability(protection).volume
            for sign in (1, -1)
        )
        gradient.append((np.log(up) - np.log(down)) / (2 * step))
    return np.array(gradient)


@pytest.mark.parametrize("k", [0, 1, 2])
@pytest.mark.parametrize("seed", range(2))
def test_it_goes_up_the_gradient_in_what_is_left(seed, k, rng):
    robot, protection = spare(seed), random_protection(rng, k)
    tasks, options = [PositionTask(), ManipulabilityTask(gain=1e-3)], {"rate_limit": 1.0, "damping": 0.0}
    law, plain = (SelectiveLaw(robot, protection, tasks=t, **options) for t in (tasks, tasks[0]))
    for _ in range(3):
        q = random_state(robot, rng)
        target = robot.frame_pose(q).translation + 1e-2 * rng.normal(size=3)
        command, before, coupling = law(q, target), plain(q, target), robot.coupling(q)
        assert command.rate_scale == 1.0
        rows = np.vstack([protection.J_sub(coupling), coupling.J_gt])
        left = np.eye(8) - np.linalg.pinv(rows) @ rows
        wanted = 1e-3 * slope(robot, protection, q)
        assert np.abs(wanted).max() < 0.25
        added = command.joint_rates - before.joint_rates
        np.testing.assert_allclose(added, left @ wanted, atol=1e-4 * np.linalg.norm(wanted))
        assert np.linalg.norm(added) > 0.1 * np.linalg.norm(wanted)
        # Level 1 does not feel it.
        scale = np.linalg.norm(coupling.J_gt) * np.linalg.norm(command.joint_rates)
        gained = coupling.J_gt @ command.joint_rates
        np.testing.assert_allclose(gained, coupling.J_gt @ before.joint_rates, atol=1e-12 * scale)
        np.testing.assert_array_equal(command.errors[1], 0.0)


def test_the_rates_asked_for_are_held_to_a_quarter_of_the_limits(rng):
    robot, protection = spare(3), Protection("yaw")
    q, limits = random_state(robot, rng), rng.uniform(0.05, 0.2, 8)
    tasks = [PositionTask(), ManipulabilityTask(gain=1e4)]
    law = SelectiveLaw(robot, protection, rate_limit=limits, damping=0.0, tasks=tasks)
    command, coupling = law(q, robot.frame_pose(q).translation), robot.coupling(q)
    wanted = slope(robot, protection, q)
    wanted *= 0.25 / np.max(np.abs(wanted) / limits)
    rows = np.vstack([protection.J_sub(coupling), coupling.J_gt])
    left = wanted - np.linalg.pinv(rows) @ (rows @ wanted)
    assert command.rate_scale == 1.0
    np.testing.assert_allclose(command.joint_rates, left, atol=1e-4 * np.linalg.norm(left))


def test_the_protected_rate_is_rounding_beside_it(rng):
    for seed in range(3):
        for k in (1, 2, 3):
            robot, protection = spare(seed), random_protection(rng, k)
            law = SelectiveLaw(robot, protection, tasks=[PositionTask(), ManipulabilityTask(gain=1.0)])
            q = random_state(robot, rng)
            command, J_sub = law(q, rng.uniform(-2, 2, 3)), kernel_J_sub(robot, protection, q)
            size = np.linalg.norm(J_sub, 2) * np.linalg.norm(command.joint_rates)
            assert exact_residual(J_sub, command.joint_rates) <= 2 * EPS * size


@pytest.mark.parametrize("nodes", [0, 2])
def test_a_motion_ends_with_more_freedom(nodes):
    robot, yaw, volumes = spare(2), Protection("yaw"), []
    q = robot.configuration(np.linspace(-1.0, 1.0, 8))
    target = robot.frame_pose(q).translation + [0.1, -0.05, 0.05]
    for tasks in ([PositionTask()], [PositionTask(), ManipulabilityTask(gain=0.05)]):
        law = SelectiveLaw(robot, yaw, gain=0.3, tasks=tasks, sample_time=0.2, hold_nodes=nodes)
        motion = ssm.simulate(law, q, target, 15.0, 0.2, "held")
        assert motion.attrs["outcome"] == "converged"
        assert np.abs(motion.protected_rate).max() < 1e-16
        assert nodes == 0 or np.abs(motion.protected_angle).max() < 1e-9
        volumes.append([robot.coupling(x).manipulability(yaw).volume for x in motion.configuration.values])
    assert volumes[1][-1] > 1.2 * volumes[0][-1]
    assert np.all(np.diff(volumes[1][-30:]) > 0)


def test_pace_and_an_asked_rate_beside_it(ets_vii, rng):
    q = ets_vii.configuration(START)
    law = SelectiveLaw(ets_vii, Protection("yaw"), tasks=[PositionTask(), ManipulabilityTask()], damping=0.0)
    full, half = law(q, [-1.8, -0.3, 1.2]), law(q, [-1.8, -0.3, 1.2], pace=0.5)
    np.testing.assert_allclose(half.joint_rates, 0.5 * full.joint_rates, rtol=1e-9)
    np.testing.assert_allclose(law(q, [-1.8, -0.3, 1.2], protected_rate=[1e-4]).protected_rate, [1e-4], rtol=1e-10)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: ManipulabilityTask(level=1), "its level is 2 or more"),
        (lambda: ManipulabilityTask(level=0), "level is 0"),
        (lambda: ManipulabilityTask(gain=0.0), "gain is 0.0"),
        (lambda: ManipulabilityTask(), "needs a task of a level before its own"),
        (lambda: [PositionTask(), ManipulabilityTask(), ManipulabilityTask(level=3)], "two manipulability tasks"),
    ],
)
def test_climbing_for_nothing_is_refused(ets_vii, make, says):
    with pytest.raises(ssm.InputError, match=says):
        SelectiveLaw(ets_vii, Protection("yaw"), tasks=make())


@pytest.mark.parametrize("task", [PostureTask(level=2), PositionTask(level=3)])
def test_it_needs_a_task_of_a_level_before_its_own(ets_vii, task):
    with pytest.raises(ssm.InputError):
        SelectiveLaw(ets_vii, Protection("yaw"), tasks=[task, ManipulabilityTask(level=2)])


def test_rows_that_depend_on_each_other_do_not_make_noise(rng):
    """A boresight inside an attitude adds nothing: the joints are asked for the same from one place to the next."""
    robot, line = random_robot(171, joints=8, branching=0.0), [0.3, -0.2, 0.9]
    law = SelectiveLaw(robot, Protection("yaw"), tasks=[OrientationTask(), BoresightTask(line), ManipulabilityTask()])
    for _ in range(8):
        q = random_state(robot, rng)
        R = robot.frame_pose(q).rotation
        near = [pin.integrate(robot.model, q, np.r_[np.zeros(6), 1e-9 * rng.normal(size=8)]) for _ in range(8)]
        assert np.ptp([law(x, [R, R @ line]).joint_rates for x in near], axis=0).max() < 1e-3


def test_targets_stand_for_the_other_tasks_alone(ets_vii):
    q = ets_vii.configuration(START)
    tasks = [ManipulabilityTask(level=3), PositionTask(), BoresightTask([0, 0, 1.0], level=2)]
    with pytest.warns(ssm.DecoupleWarning, match="nothing is left for the tasks from level 3"):
        law = SelectiveLaw(ets_vii, Protection("yaw"), tasks=tasks)
    command = law(q, [[-1.8, -0.3, 1.2], [0, 0, 1]], [None, [0, 0, 1e-3]])
    assert [e.size for e in command.errors] == [6, 3, 2]
    with pytest.raises(ssm.InputError, match="give 2, one a task, in their order: position, boresight"):
        law(q, [[-1.8, -0.3, 1.2], [0, 0, 1], []])
