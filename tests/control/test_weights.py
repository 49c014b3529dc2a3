"""Joint weights: the law against weighted pseudo-inverses, its protection in exact arithmetic, wheels that are real."""

from __future__ import annotations

import numpy as np
import pytest
from random_robots import random_robot, random_state
from test_law import EPS, exact_residual, kernel_J_sub, random_protection
from test_tasks import START, task_jacobian

import ssm_decouple as ssm
from ssm_decouple import BoresightTask, PositionTask, PostureTask, Protection, SelectiveLaw

TARGET = [-1.8, -0.3, 1.2]


def weighted_rates(weights, J_sub, b, levels) -> np.ndarray:
    """The smallest rates in sum w_j q_dot_j^2 level by level, with Moore-Penrose inverses of scaled matrices.

    `levels` are pairs (J, v); each is met as well as what stands before leaves.
    """
    S = np.diag(1 / np.sqrt(weights))
    rows = J_sub @ S
    x = np.linalg.pinv(rows, rcond=1e-12) @ b
    N = np.eye(len(weights)) - np.linalg.pinv(rows, rcond=1e-12) @ rows
    for J, v in levels:
        inverse = np.linalg.pinv(J @ S @ N, rcond=1e-10)
        x = x + inverse @ (v - J @ S @ x)
        N = N - inverse @ J @ S @ N
    return S @ x


def random_weights(rng, n: int) -> np.ndarray:
    return 10.0 ** rng.uniform(-2, 2, n)


@pytest.mark.parametrize("k", [0, 1, 2])
def test_the_rates_are_the_smallest_in_the_weighted_norm(robot, rng, k):
    for _ in range(3):
        weights, protection = random_weights(rng, robot.n_joints), random_protection(rng, k)
        law = SelectiveLaw(robot, protection, gain=0.3, rate_limit=np.inf, damping=0.0, joint_weights=weights)
        q, target = random_state(robot, rng), rng.uniform(-2, 2, 3)
        command, coupling = law(q, target), robot.coupling(q)
        J_sub, J = protection.J_sub(coupling), coupling.J_gt
        expected = weighted_rates(weights, J_sub, np.zeros(k), [(J, 0.3 * (target - robot.frame_pose(q).translation))])
        condition = np.linalg.cond(np.vstack([J_sub, J]) / np.sqrt(weights))
        if robot.n_joints >= k + 3:
            np.testing.assert_allclose(
                command.joint_rates, expected, atol=1e-13 * condition**2 * np.linalg.norm(expected)
            )


@pytest.mark.parametrize("seed", range(4))
def test_two_levels_and_a_rate_that_is_asked_for(seed, rng):
    robot = random_robot(210 + seed, joints=9)
    weights, protection = random_weights(rng, 9), random_protection(rng, 2)
    tasks = [PostureTask(robot.joint_names[:3], level=2, weight=2.0), PositionTask(), BoresightTask([0.3, 0.1, 0.9])]
    law = SelectiveLaw(robot, protection, tasks=tasks, rate_limit=np.inf, damping=0.0, joint_weights=weights)
    for _ in range(3):
        q, b = random_state(robot, rng), 1e-2 * rng.normal(size=2)
        targets = [rng.uniform(-1, 1, 3), rng.uniform(-2, 2, 3), rng.normal(size=3)]
        command, J = law(q, targets, protected_rate=b), task_jacobian(law, q, targets)
        # Rows stand by levels, each times the root of its task's weight.
        posture, position, sight = command.errors
        levels = [(J[:5], 0.05 * np.r_[position, sight]), (J[5:], 0.05 * np.sqrt(2.0) * posture)]
        J_sub = protection.J_sub(robot.coupling(q))
        expected = weighted_rates(weights, J_sub, b, levels)
        condition = np.linalg.cond(np.vstack([J_sub, J[:5]]) / np.sqrt(weights))
        np.testing.assert_allclose(command.joint_rates, expected, atol=1e-12 * condition**2 * np.linalg.norm(expected))
        np.testing.assert_allclose(command.protected_rate, b, rtol=1e-10)


def test_damping_acts_in_the_weighted_norm(ets_vii, rng):
    """Eq. 11 with |q_dot| weighted, as a stacked least-squares problem in the null space."""
    weights, protection = random_weights(rng, 6), random_protection(rng, 1)
    law = SelectiveLaw(
        ets_vii, protection, rate_limit=np.inf, damping=3e-3, damping_threshold=50.0, joint_weights=weights
    )
    S = np.diag(1 / np.sqrt(weights))
    for _ in range(5):
        q = random_state(ets_vii, rng)
        command, coupling = law(q, TARGET), ets_vii.coupling(q)
        assert command.regularised
        rows = protection.J_sub(coupling) @ S
        Z = np.linalg.svd(rows)[2][1:].T
        stacked = np.vstack([coupling.J_gt @ S @ Z, np.sqrt(command.damping) * np.eye(5)])
        y = np.linalg.lstsq(stacked, np.r_[0.05 * command.end_effector_error, np.zeros(5)], rcond=None)[0]
        np.testing.assert_allclose(command.joint_rates, S @ Z @ y, atol=1e-11 * np.linalg.norm(y))
        smallest = np.linalg.svd(coupling.J_gt @ S @ Z, compute_uv=False)[-1]
        assert command.smallest_singular_value == pytest.approx(smallest, rel=1e-9)


@pytest.mark.parametrize("asked", [0.0, 1e-3])
@pytest.mark.parametrize("k", [1, 2, 3])
def test_the_protected_rate_is_rounding_in_exact_arithmetic(robots, rng, k, asked):
    worst = 0.0
    for name, robot in robots.items():
        if robot.n_joints <= k:
            continue
        for _ in range(6):
            protection, weights = random_protection(rng, k), random_weights(rng, robot.n_joints)
            limit = np.inf if asked else np.deg2rad(5.0)
            law = SelectiveLaw(robot, protection, gain=1.0, rate_limit=limit, joint_weights=weights)
            q, b = random_state(robot, rng), asked * rng.normal(size=k)
            command = law(q, rng.uniform(-3, 3, 3), protected_rate=b)
            J_sub = kernel_J_sub(robot, protection, q)
            size = np.linalg.norm(J_sub, 2) * np.linalg.norm(command.joint_rates) + np.linalg.norm(b)
            residual = exact_residual(J_sub, command.joint_rates, b)
            assert residual <= 2 * EPS * size, name
            worst = max(worst, residual / (EPS * size))
    assert 0 < worst <= 2


@pytest.mark.parametrize("bend", [1e-3, 1e-9, 0.0])
def test_the_protected_rate_is_rounding_next_to_a_singularity(ets_vii, rng, bend):
    q = ets_vii.configuration([0.3, 0.2, np.pi / 2 - bend, bend, -bend, 0.1])
    for axes in ("yaw", "all"):
        for damping in (0.0, 1e-4):
            law = SelectiveLaw(ets_vii, Protection(axes), damping=damping, joint_weights=random_weights(rng, 6))
            command, J_sub = law(q, [0.5, 1.0, -2.0]), kernel_J_sub(ets_vii, Protection(axes), q)
            assert np.abs(command.joint_rates).max() <= np.deg2rad(5.0)
            size = np.linalg.norm(J_sub, 2) * np.linalg.norm(command.joint_rates)
            assert exact_residual(J_sub, command.joint_rates) <= 2 * EPS * size


def test_one_weight_for_all_changes_nothing(ets_vii, rng):
    plain = SelectiveLaw(ets_vii, Protection("yaw"), damping=0.0)
    for weight in (1.0, 4.0, 7.3):
        law = SelectiveLaw(ets_vii, Protection("yaw"), damping=0.0, joint_weights=weight)
        q, target = random_state(ets_vii, rng), rng.uniform(-2, 2, 3)
        np.testing.assert_allclose(law(q, target).joint_rates, plain(q, target).joint_rates, rtol=1e-10, atol=1e-16)


def test_a_heavy_joint_hardly_moves_and_acceleration_limits_blend_in_the_same_norm(ets_vii, rng):
    weights = np.array([1e8, 1, 1, 1, 1, 1])
    options = {"joint_weights": weights, "rate_limit": np.inf}
    q = ets_vii.configuration(START)
    free, heavy = (
        SelectiveLaw(ets_vii, Protection("yaw"))(q, TARGET),
        SelectiveLaw(ets_vii, Protection("yaw"), **options)(q, TARGET),
    )
    assert abs(heavy.joint_rates[0]) < 1e-5 * abs(free.joint_rates[0])
    # Out of rates that turn the base, and without room to go further: their nearest ones, in the weighted norm.
    law = SelectiveLaw(ets_vii, Protection("yaw"), sample_time=0.1, acceleration_limit=1e-9, **options)
    previous = 0.01 * rng.normal(size=6)
    J_sub = Protection("yaw").J_sub(ets_vii.coupling(q))
    nearest = previous - weighted_rates(weights, J_sub, J_sub @ previous, [])
    command = law(q, TARGET, previous_rates=previous)
    assert command.rate_blend == 0.0
    np.testing.assert_allclose(command.joint_rates, nearest, atol=1e-15)


def test_the_lost_direction_is_that_of_the_weighted_rows(ets_vii, rng):
    law = SelectiveLaw(ets_vii, Protection("yaw"), joint_weights=random_weights(rng, 6))
    q = random_state(ets_vii, rng)
    smallest = law(q, TARGET).smallest_singular_value
    assert law.lost_direction(q).singular_value == pytest.approx(smallest, rel=1e-9)


# Wheels.


def wheeled(robot: ssm.Robot, spin_inertia: float, max_speed: float) -> ssm.Robot:
    return robot.with_wheels(
        [
            ssm.Wheel(f"wheel_{name}", axis, spin_inertia=spin_inertia, max_speed=max_speed, max_torque=1.0)
            for name, axis in zip("xyz", np.eye(3), strict=True)
        ]
    )


def start_of(robot: ssm.Robot) -> np.ndarray:
    return robot.configuration({f"joint_{i + 1}": angle for i, angle in enumerate(START)})


def test_a_wheel_s_full_speed_counts_as_much_as_the_arm_s(ets_vii):
    whole = wheeled(ets_vii, 0.1, 600.0)
    weights = dict(zip(whole.joint_names, SelectiveLaw(whole, Protection("all")).joint_weights, strict=True))
    for name in whole.wheel_names:
        assert weights.pop(name) == pytest.approx((np.deg2rad(5.0) / 600.0) ** 2)
    assert set(weights.values()) == {1.0}
    np.testing.assert_array_equal(SelectiveLaw(ets_vii, Protection("all")).joint_weights, np.ones(6))


@pytest.mark.filterwarnings("ignore:wheels need more torque")
def test_small_and_fast_wheels_let_case_1_arrive_under_all_protected(ets_vii):
    """Equal momenta at full speed make the same motion, whatever the inertia."""
    motions = []
    for spin_inertia in (0.1, 10.0):
        whole = wheeled(ets_vii, spin_inertia, 60.0 / spin_inertia)
        law = SelectiveLaw(whole, Protection("all"), gain=0.05)
        motions.append(ssm.simulate(law, start_of(whole), TARGET, 150.0, 0.1))
    small, large = motions
    assert small.attrs["outcome"] == "converged"
    assert float(abs(small.base_rpy).max()) < 1e-14
    assert float(abs(small.protected_rate).max()) < 1e-17
    arm = [f"joint_{i + 1}" for i in range(6)]
    np.testing.assert_allclose(small.joint_rates.sel(joint=arm), large.joint_rates.sel(joint=arm), atol=1e-12)
    np.testing.assert_allclose(small.wheel_momentum, large.wheel_momentum, atol=1e-9)
    # The whole starts at rest: wheels carry what the arm carries, with the other sign.
    carried = np.array(
        [
            law.robot.coupling(q).H_wq @ np.where([name in arm for name in law.robot.joint_names], rates, 0.0)
            for q, rates in zip(large.configuration.values[::100], large.joint_rates.values[::100], strict=True)
        ]
    )
    np.testing.assert_allclose(large.wheel_momentum[::100], -carried, atol=1e-10)
    assert small.attrs["saturated_wheels"] == "{}"


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf, [1.0] * 5, "heavy", [1, 1, 1, 1, 1, 0]])
def test_bad_weights_are_refused(ets_vii, bad):
    with pytest.raises(ssm.InputError, match="joint_weights"):
        SelectiveLaw(ets_vii, Protection("yaw"), joint_weights=bad)
