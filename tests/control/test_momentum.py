"""Momentum on board: what moves the base while the joints stand still is taken off, beside what the law does."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from random_robots import random_robot, random_state
from test_law import EPS, random_protection
from test_tasks import START, random_rotation, task_jacobian
from test_weights import random_weights, weighted_rates

import ssm_decouple as ssm
from ssm_decouple import (
    BoresightTask,
    OrientationTask,
    PoseTask,
    PositionTask,
    PostureTask,
    Protection,
    RelativePoseTask,
    SelectiveLaw,
)

TARGET = [-1.8, -0.3, 1.2]


def base_twist(robot: ssm.Robot, q, rates, momentum) -> np.ndarray:
    """The base twist, base axes, by one 6 x 6 solve of Pinocchio's centroidal map."""
    A_g = pin.computeCentroidalMap(robot.model, robot.model.createData(), q)
    return np.linalg.solve(A_g[:, :6], momentum - A_g[:, 6:] @ rates)


def carried(robot: ssm.Robot, q, velocity) -> float:
    """The largest sum of momenta that base and joints carry one by one: what the whole momentum rounds as."""
    A_g = pin.computeCentroidalMap(robot.model, robot.model.createData(), q)
    return float((np.abs(A_g) @ np.abs(velocity)).max())


def axes_of(robot: ssm.Robot, protection: Protection, q) -> np.ndarray:
    """Base axes to those in which the protection is fixed."""
    R = robot.base_pose(q).rotation
    if protection.frame == "base":
        return np.eye(3)
    return R if protection.frame == "inertial" else robot.frame_pose(q, protection.frame).rotation.T @ R


@pytest.mark.parametrize("frame", ["base", "inertial", "end_effector"])
def test_the_command_carries_the_momentum_and_the_axes_stay_still(robot, rng, frame):
    for k in (0, 1, 2):
        if robot.n_joints <= k:
            continue
        momentum, protection = rng.normal(size=6), random_protection(rng, k, _known(robot, frame))
        law = SelectiveLaw(robot, protection, rate_limit=np.inf, momentum=momentum)
        for _ in range(3):
            q = random_state(robot, rng)
            command = law(q, rng.uniform(-2, 2, 3))
            scale = carried(robot, q, command.velocity) + 1
            np.testing.assert_allclose(robot.momentum(q, command.velocity), momentum, atol=1e-13 * scale)
            twist, C = base_twist(robot, q, command.joint_rates, momentum), axes_of(robot, protection, q)
            size = np.linalg.norm(robot.coupling(q).J_rc) * np.linalg.norm(command.joint_rates) + np.linalg.norm(twist)
            np.testing.assert_allclose(command.base_twist, twist, atol=1e-12 * scale)
            np.testing.assert_allclose(protection.U_c.T @ C @ twist[3:], 0, atol=100 * EPS * size)
            assert np.linalg.norm(command.protected_rate) <= 16 * EPS * size


def _known(robot: ssm.Robot, frame: str) -> str:
    return robot.end_effector if frame == "end_effector" else frame


@pytest.mark.parametrize("nodes", [0, 2])
@pytest.mark.parametrize("seed", range(2))
def test_every_task_falls_at_its_gain_beside_the_momentum(seed, nodes, rng):
    """Errors a moment before and after, along the motion that the command and the momentum make together."""
    robot = random_robot(240 + seed, joints=9, branching=0.0)
    link, tiny = "body_2", {"sample_time": 1e-7, "hold_nodes": nodes} if nodes else {}
    pose, step = pin.SE3(random_rotation(rng), rng.uniform(-1, 1, 3)), 1e-6
    for task, target in [
        (PositionTask(), rng.uniform(-2, 2, 3)),
        (OrientationTask(), random_rotation(rng)),
        (PoseTask(), pose),
        (BoresightTask([0.3, -0.5, 0.8]), rng.normal(size=3)),
        (PostureTask(), rng.uniform(-1, 1, 9)),
        (RelativePoseTask(robot.end_effector, link), pose),
    ]:
        protection = Protection("none" if isinstance(task, PostureTask) else "yaw")
        options = {"gain": 0.3, "rate_limit": np.inf, "damping": 0.0, "tasks": task, **tiny}
        law = SelectiveLaw(robot, protection, momentum=rng.normal(size=6), **options)
        q = random_state(robot, rng)
        command = law(q, target)
        before, after = (
            np.linalg.norm(law(pin.integrate(robot.model, q, sign * step * command.velocity), target).errors[0])
            for sign in (-1, 1)
        )
        wanted = -0.3 * np.linalg.norm(command.errors[0])
        assert (after - before) / (2 * step) == pytest.approx(wanted, rel=1e-5), type(task).__name__


@pytest.mark.parametrize("seed", range(3))
def test_the_formula_with_weights_levels_and_a_rate_that_is_asked_for(seed, rng):
    """J_sub q_dot + drift = b, tasks by what is left; the drifts by Pinocchio's frame Jacobians."""
    robot = random_robot(250 + seed, joints=9)
    weights, protection, momentum = random_weights(rng, 9), random_protection(rng, 2), rng.normal(size=6)
    tasks = [PoseTask(), PostureTask(level=2)]
    options = {"rate_limit": np.inf, "damping": 0.0, "joint_weights": weights, "momentum": momentum}
    law = SelectiveLaw(robot, protection, tasks=tasks, **options)
    for _ in range(3):
        q, b = random_state(robot, rng), 1e-2 * rng.normal(size=2)
        targets = [pin.SE3(random_rotation(rng), rng.uniform(-2, 2, 3)), rng.uniform(-1, 1, 9)]
        command, J = law(q, targets, protected_rate=b), task_jacobian(law, q, targets)
        drift, data = base_twist(robot, q, np.zeros(9), momentum), robot.model.createData()
        pin.computeJointJacobians(robot.model, data, q)
        pin.updateFramePlacements(robot.model, data)
        J_frame = pin.getFrameJacobian(robot.model, data, robot.end_effector_id, pin.LOCAL_WORLD_ALIGNED)
        levels = [
            (J[:6], 0.05 * command.errors[0] - J_frame[:, :6] @ drift),
            (J[6:], 0.05 * command.errors[1]),
        ]
        J_sub = protection.J_sub(robot.coupling(q))
        expected = weighted_rates(weights, J_sub, b - protection.U_twist.T @ drift, levels)
        condition = np.linalg.cond(np.vstack([J_sub, J[:6]]) / np.sqrt(weights))
        np.testing.assert_allclose(command.joint_rates, expected, atol=1e-12 * condition**2 * np.linalg.norm(expected))
        np.testing.assert_allclose(command.protected_rate, b, atol=1e-13 * condition)


def test_none_is_zero_and_it_can_be_assigned(ets_vii, rng):
    q, momentum = random_state(ets_vii, rng), rng.normal(size=6)
    never, law = (SelectiveLaw(ets_vii, Protection("yaw"), momentum=m) for m in (None, momentum))
    np.testing.assert_array_equal(never.momentum, np.zeros(6))
    np.testing.assert_array_equal(law.momentum, momentum)
    with_it = law(q, TARGET).values
    assert np.abs(with_it - never(q, TARGET).values).max() > 1e-3
    for nothing in (np.zeros(6), None):
        law.momentum = nothing
        np.testing.assert_array_equal(law(q, TARGET).values, never(q, TARGET).values)
    law.momentum = momentum.tolist()
    np.testing.assert_array_equal(law(q, TARGET).values, with_it)
    np.testing.assert_array_equal(law.describe()["momentum"], momentum)
    # Asking for a rate or for a slower pace leaves it alone.
    law(q, TARGET, protected_rate=[1e-3], pace=0.5)
    np.testing.assert_array_equal(law(q, TARGET).values, with_it)


def test_the_base_twist_of_any_rates(robot, rng):
    law = SelectiveLaw(robot, Protection("none"), momentum=rng.normal(size=6))
    for _ in range(3):
        q, rates = random_state(robot, rng), rng.normal(size=robot.n_joints)
        expected = base_twist(robot, q, rates, law.momentum)
        np.testing.assert_allclose(law.base_twist(q, rates), expected, atol=1e-12 * (1 + np.linalg.norm(expected)))


def test_what_the_joints_cannot_take_up_is_told(ets_vii):
    """Far beyond the rate limits: the compensation is scaled as a whole, and the protected rate is what is left."""
    q, momentum = ets_vii.configuration(START), np.array([0, 0, 0, 0, 0, 500.0])
    law = SelectiveLaw(ets_vii, Protection("yaw"), momentum=momentum)
    command = law(q, TARGET)
    J_sub = Protection("yaw").J_sub(ets_vii.coupling(q))
    drift = base_twist(ets_vii, q, np.zeros(6), momentum)[5]
    alone = np.linalg.pinv(J_sub) @ [-drift]
    factor = np.deg2rad(5.0) / np.abs(alone).max()
    assert factor < 0.9
    assert np.abs(command.joint_rates).max() <= np.deg2rad(5.0)
    assert command.protected_rate[0] == pytest.approx((1 - factor) * drift, rel=1e-9)
    np.testing.assert_allclose(ets_vii.momentum(q, command.velocity), momentum, atol=1e-10)


def test_acceleration_limits_and_momentum(ets_vii, rng):
    """From rates that already hold the axis the blend goes on holding it; from rest it takes what the axis needs."""
    q, momentum = ets_vii.configuration(START), np.array([0.2, 0, 0, 0, 0, 2.0])
    options = {"sample_time": 0.1, "acceleration_limit": 0.01, "momentum": momentum}
    law = SelectiveLaw(ets_vii, Protection("yaw"), **options)
    drift = base_twist(ets_vii, q, np.zeros(6), momentum)[5]
    J_sub = Protection("yaw").J_sub(ets_vii.coupling(q))
    still = np.linalg.pinv(J_sub) @ [-drift]
    command = law(q, TARGET, previous_rates=still)
    assert 0 < command.rate_blend < 1
    assert np.abs(command.joint_rates - still).max() <= 0.001
    for previous in (still, np.zeros(6), 0.01 * rng.normal(size=6)):
        assert np.abs(law(q, TARGET, previous_rates=previous).protected_rate).max() < 1e-17


@pytest.mark.parametrize("bad", [[1, 2, 3], 1.0, [np.nan] * 6, [np.inf] * 6, "spin"])
def test_what_is_no_momentum_is_refused(ets_vii, bad):
    with pytest.raises(ssm.InputError, match="momentum is"):
        SelectiveLaw(ets_vii, Protection("yaw"), momentum=bad)
    law = SelectiveLaw(ets_vii, Protection("yaw"), momentum=np.ones(6))
    with pytest.raises(ssm.InputError, match="momentum is"):
        law.momentum = bad
    np.testing.assert_array_equal(law.momentum, np.ones(6))
