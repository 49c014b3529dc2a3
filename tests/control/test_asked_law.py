"""The law on the whole base twist, with a protected rate that is asked for, and at a pace."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_robots import random_robot, random_state
from scipy.integrate import quad_vec
from test_law import exact_residual, kernel_J_sub, planar_robot

import ssm_decouple as ssm
from ssm_decouple import Protection, SelectiveLaw
from ssm_decouple.control import kernel

EPS = np.finfo(float).eps
START = np.deg2rad([150, -20, -10, 0, 0, 0])
TARGET = [-1.8, -0.3, 1.2]


def random_twists(rng: np.random.Generator, k: int, frame: str = "base") -> Protection:
    return Protection(np.linalg.qr(rng.normal(size=(6, 6)))[0][:, :k], frame)


def attainable(robot: ssm.Robot, protection: Protection, q: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A protected rate that modest joint rates give."""
    return protection.J_sub(robot.coupling(q)) @ rng.normal(scale=0.01, size=robot.n_joints)


def formula(robot: ssm.Robot, protection: Protection, q, v_cmd, wanted) -> tuple[np.ndarray, float]:
    """J_sub^+ b + (J_gt N)^+ (v_cmd - J_gt J_sub^+ b) by singular value decompositions, and its condition."""
    coupling = robot.coupling(q)
    J_sub, Z = protection.J_sub(coupling), protection.null_space_basis(coupling)
    fixed = np.linalg.pinv(J_sub) @ wanted
    task = coupling.J_gt @ Z
    rates = fixed + Z @ (np.linalg.pinv(task, rcond=1e-10) @ (v_cmd - coupling.J_gt @ fixed))
    singular = np.linalg.svd(task, compute_uv=False)
    freedom = min(3, Z.shape[1])
    return rates, np.linalg.cond(J_sub) * (singular[0] / singular[freedom - 1] if freedom else 1.0) ** 2


@pytest.mark.parametrize("frame", ["base", "inertial"])
@pytest.mark.parametrize("k", range(1, 7))
def test_the_formula_on_the_whole_twist(robot, rng, k, frame):
    """Minimum norm: Moore-Penrose inverses throughout, with b and without."""
    if robot.n_joints < k:
        return
    for _ in range(3):
        protection, q = random_twists(rng, k, frame), random_state(robot, rng)
        law = SelectiveLaw(robot, protection, gain=0.3, damping=0.0, rate_limit=np.inf)
        target, velocity = rng.uniform(-2, 2, 3), rng.normal(size=3)
        v_cmd = velocity + 0.3 * (target - robot.frame_pose(q).translation)
        for wanted in (np.zeros(k), attainable(robot, protection, q, rng)):
            command = law(q, target, velocity, protected_rate=wanted)
            expected, condition = formula(robot, protection, q, v_cmd, wanted)
            size = 1 + np.linalg.norm(expected)
            np.testing.assert_allclose(command.joint_rates, expected, atol=1e-13 * condition * size)
            np.testing.assert_allclose(command.protected_rate, wanted, atol=1e-13 * size)
            assert command.protected_rate.shape == (k,)
            assert command.rank == k


@pytest.mark.parametrize("k", range(1, 7))
@pytest.mark.parametrize("limit", [np.deg2rad(5.0), np.inf])
def test_both_are_rounding_in_exact_arithmetic(robots, rng, k, limit):
    worst = 0.0
    for robot in [*robots.values(), random_robot(20, joints=10)]:
        if robot.n_joints <= k:
            continue
        for _ in range(12):
            protection, q = random_twists(rng, k), random_state(robot, rng)
            law = SelectiveLaw(robot, protection, gain=1.0, rate_limit=limit)
            target, J_sub = rng.uniform(-3, 3, 3), kernel_J_sub(robot, protection, q)
            plain = law(q, target).joint_rates
            size = np.linalg.norm(J_sub, 2)
            assert exact_residual(J_sub, plain) <= 2 * EPS * size * np.linalg.norm(plain)
            wanted = J_sub @ rng.normal(scale=0.01, size=robot.n_joints)
            command = law(q, target, protected_rate=wanted)
            assert np.abs(command.joint_rates).max() <= limit
            bound = EPS * (size * np.linalg.norm(command.joint_rates) + np.linalg.norm(wanted))
            residual = exact_residual(J_sub, command.joint_rates, wanted)
            assert residual <= 2 * bound
            worst = max(worst, residual / bound)
    assert 0 < worst <= 2


@given(st.integers(0, 10**6), st.integers(1, 6), st.sampled_from(["base", "inertial"]))
@settings(max_examples=100)
def test_any_twist_any_state(seed, k, frame):
    """With J_base formed by another route, what is left is the rounding of J_base itself."""
    rng = np.random.default_rng(seed)
    robot = random_robot(seed % 7, joints=7)
    protection, q = random_twists(rng, k, frame), random_state(robot, rng)
    coupling = robot.coupling(q)
    J_sub = protection.J_sub(coupling)
    wanted = J_sub @ rng.normal(scale=1e-3, size=7)
    for rate in (None, wanted):
        command = SelectiveLaw(robot, protection)(q, rng.uniform(-3, 3, 3), protected_rate=rate)
        assert np.abs(command.joint_rates).max() <= 0.5
        size = (1 + np.linalg.norm(q[:3])) * np.linalg.norm(coupling.J_base, 2) * np.linalg.norm(command.joint_rates)
        left = J_sub @ command.joint_rates - (0 if rate is None else rate)
        assert np.linalg.norm(left) <= 64 * EPS * size
        assert (
            np.linalg.norm(
                protection.U_twist.T @ turned(command.base_twist, coupling, frame) - J_sub @ command.joint_rates
            )
            <= 64 * EPS * size
        )


def turned(twist, coupling, frame):
    R = coupling.base_rotation if frame == "inertial" else np.eye(3)
    return np.r_[R @ twist[:3], R @ twist[3:]]


def test_twists_of_rotation_alone_give_the_law_of_rotations(ets_vii, rng):
    for axes in ("yaw", "roll+yaw", "all"):
        for frame in ("base", "inertial"):
            rotations = Protection(axes, frame)
            q, target = random_state(ets_vii, rng), rng.uniform(-2, 2, 3)
            expected = SelectiveLaw(ets_vii, rotations)(q, target).values
            whole = SelectiveLaw(ets_vii, Protection(rotations.U_twist, frame))(q, target).values
            np.testing.assert_array_equal(whole, expected)


def test_the_basis_does_not_matter(ets_vii, rng):
    for k in range(1, 7):
        protection, q = random_twists(rng, k), random_state(ets_vii, rng)
        other = Protection(protection.U_c @ np.linalg.qr(rng.normal(size=(k, k)))[0])
        target, wanted = rng.uniform(-2, 2, 3), attainable(ets_vii, protection, q, rng)
        here = SelectiveLaw(ets_vii, protection)(q, target, protected_rate=wanted)
        there = SelectiveLaw(ets_vii, other)(q, target, protected_rate=other.U_c.T @ protection.U_c @ wanted)
        np.testing.assert_allclose(there.joint_rates, here.joint_rates, atol=1e-9 * np.abs(here.joint_rates).max())


@pytest.mark.parametrize("distance", [0.0, 1e2, 1e4])
def test_noise_in_twist_rows_costs_nothing(write, rng, distance):
    """Three joints about z in the plane of the bus move it along x and y and about z, whatever else is protected."""
    robot = planar_robot(write)
    for _ in range(20):
        attitude = pin.Quaternion(*(rng.normal(size=4))).normalized().matrix()
        q = robot.configuration(rng.uniform(-1, 1, 3), pin.SE3(attitude, distance * rng.uniform(-1, 1, 3)))
        for rows, rank in (([2, 3, 4], 0), ([0, 2], 1), ([1, 3, 5], 2), ([0, 1, 5], 3), (range(6), 3)):
            protection = Protection(np.eye(6)[:, list(rows)])
            assert SelectiveLaw(robot, protection)(q, q[:3]).rank == rank
            assert protection.null_space_basis(robot.coupling(q)).shape == (3, 3 - rank)


# A protected rate that is asked for.


def test_what_cannot_be_met_is_met_as_nearly_as_can_be(write, rng):
    """Least squares of the smallest norm where J_sub has not the rank, by too few joints or by noise."""
    flat = planar_robot(write)
    for robot in (flat, random_robot(42, joints=2), random_robot(43, joints=4)):
        for k in range(2, 7):
            protection, q = random_twists(rng, k), robot.configuration(rng.uniform(-1, 1, robot.n_joints))
            law = SelectiveLaw(robot, protection, rate_limit=np.inf, damping=0.0)
            wanted = rng.normal(scale=0.01, size=k)
            command = law(q, rng.uniform(-2, 2, 3), protected_rate=wanted)
            J_sub = protection.J_sub(robot.coupling(q))
            fixed = np.linalg.pinv(J_sub, rcond=1e-10) @ wanted
            assert command.rank == min(k, 3 if robot is flat else robot.n_joints)
            np.testing.assert_allclose(command.protected_rate, J_sub @ fixed, atol=1e-13)
            if command.rank == robot.n_joints:  # no freedom is left for the task
                np.testing.assert_allclose(command.joint_rates, fixed, atol=1e-10 * (1 + np.abs(fixed).max()))
    nothing = SelectiveLaw(flat, Protection(np.eye(6)[:, [2, 3]]))
    q = flat.configuration([0.3, 0.8, -0.6])
    asked, plain = nothing(q, [1, 0, 0], protected_rate=[1.0, 2.0]), nothing(q, [1, 0, 0])
    told = 6 + flat.n_joints + np.array([kernel.LOST, kernel.LOST_TO])
    np.testing.assert_array_equal(np.delete(asked.values, told), np.delete(plain.values, told))
    assert (asked.protection_lost, plain.protection_lost) == (2.0, 0.0)
    assert asked.protection_lost_to == ("no joint rates give it: J_sub has lost rank",)


@pytest.mark.parametrize("k", [1, 2, 4])
def test_at_the_limits_the_task_yields_before_the_protected_rate(ets_vii, rng, k):
    yielded = 0
    for _ in range(60):
        protection, q, target = random_twists(rng, k), random_state(ets_vii, rng), rng.uniform(-3, 3, 3)
        limits = rng.uniform(0.02, 0.1, 6)
        law = SelectiveLaw(ets_vii, protection, gain=1.0, rate_limit=limits)
        free = SelectiveLaw(ets_vii, protection, gain=1.0, rate_limit=np.inf)
        J_sub = protection.J_sub(ets_vii.coupling(q))
        wanted = J_sub @ (0.3 * limits * rng.uniform(-1, 1, 6))
        fixed = np.linalg.pinv(J_sub) @ wanted
        command, all_of_it = law(q, target, protected_rate=wanted), free(q, target, protected_rate=wanted)
        assert np.all(np.abs(command.joint_rates) <= limits)
        reach = np.max(np.abs(fixed) / limits)
        if reach < 1:
            np.testing.assert_allclose(command.protected_rate, wanted, atol=1e-15)
            expected = fixed + command.rate_scale * (all_of_it.joint_rates - fixed)
            np.testing.assert_allclose(command.joint_rates, expected, atol=1e-8)
            if command.rate_scale < 1:
                yielded += 1
                assert np.max(np.abs(command.joint_rates) / limits) == pytest.approx(1, rel=1e-9)
        # Ten times as much as the limits allow: what is left of b has its direction.
        greedy = law(q, target, protected_rate=10 / reach * wanted)
        assert np.all(np.abs(greedy.joint_rates) <= limits)
        np.testing.assert_allclose(greedy.protected_rate, wanted / reach, rtol=1e-9, atol=1e-15)
    assert yielded > 20


@pytest.mark.parametrize("k", [1, 3, 5])
def test_acceleration_limits_keep_the_protected_rate(ets_vii, rng, k):
    for _ in range(30):
        protection, q = random_twists(rng, k), random_state(ets_vii, rng)
        law = SelectiveLaw(
            ets_vii, protection, rate_limit=0.5, sample_time=0.1, acceleration_limit=rng.uniform(0.1, 0.5, 6)
        )
        J_sub = kernel_J_sub(ets_vii, protection, q)
        previous = rng.uniform(-0.04, 0.04, 6)
        wanted = J_sub @ previous
        command = law(q, rng.uniform(-3, 3, 3), previous_rates=previous, protected_rate=wanted)
        assert np.all(np.abs(command.joint_rates - previous) <= 0.1 * law.acceleration_limits * (1 + 1e-12))
        size = np.linalg.norm(J_sub, 2) * np.linalg.norm(command.joint_rates) + np.linalg.norm(wanted)
        assert exact_residual(J_sub, command.joint_rates, wanted) <= 2 * EPS * size
        # From rates that give another protected rate than b it goes to b at once, whatever the acceleration.
        other = J_sub @ rng.uniform(-0.04, 0.04, 6)
        command = law(q, rng.uniform(-3, 3, 3), previous_rates=previous, protected_rate=other)
        size = np.linalg.norm(J_sub, 2) * np.linalg.norm(command.joint_rates) + np.linalg.norm(other)
        assert exact_residual(J_sub, command.joint_rates, other) <= 2 * EPS * size


def moved_over_hold(robot, protection, q, rates, hold):
    """Motion along the protected rows while joint rates are held, by adaptive quadrature of J_sub q_dot."""

    def rate(time):
        moved = pin.integrate(robot.model, q, np.r_[np.zeros(6), time * rates])
        return protection.J_sub(robot.coupling(moved)) @ rates

    return quad_vec(rate, 0, hold, epsabs=1e-17, epsrel=1e-13)[0]


@pytest.mark.parametrize("k", [1, 2, 3, 6])
def test_a_planned_hold_gives_the_rate_times_its_length(ets_vii, rng, k):
    """The true integral over the hold: zero, or b times the hold."""
    protection, q, hold = random_twists(rng, k), ets_vii.configuration(START), 0.2
    law = SelectiveLaw(ets_vii, protection, sample_time=hold, hold_nodes=3)
    command = law(q, TARGET)
    assert np.abs(moved_over_hold(ets_vii, protection, q, command.joint_rates, hold)).max() < 1e-14
    wanted = attainable(ets_vii, protection, q, rng)
    command = law(q, TARGET, protected_rate=wanted)
    np.testing.assert_allclose(command.protected_rate, wanted, atol=1e-15)
    moved = moved_over_hold(ets_vii, protection, q, command.joint_rates, hold)
    np.testing.assert_allclose(moved, hold * wanted, atol=1e-13)
    at_sample = SelectiveLaw(ets_vii, protection)(q, TARGET, protected_rate=wanted)
    assert np.abs(moved_over_hold(ets_vii, protection, q, at_sample.joint_rates, hold) - hold * wanted).max() > 1e-8


# Pace.


@pytest.mark.parametrize("axes", ["none", "yaw", "all", "modes"])
@pytest.mark.parametrize("nodes", [0, 2])
def test_pace_scales_the_whole_command(ets_vii, rng, axes, nodes):
    protection = random_twists(rng, 3) if axes == "modes" else Protection(axes)
    law = SelectiveLaw(
        ets_vii, protection, gain=0.2, sample_time=1e-6, hold_nodes=nodes
    )  # so short that it stands still
    for _ in range(10):
        q, target, velocity = random_state(ets_vii, rng), rng.uniform(-2, 2, 3), rng.normal(scale=0.1, size=3)
        plain = law(q, target, velocity)
        for pace in (0.0, 1e-3, 0.5, 1.0):
            command = law(q, target, velocity, pace=pace)
            size = np.abs(plain.joint_rates).max()
            np.testing.assert_allclose(
                command.joint_rates, pace * plain.joint_rates, atol=1e-5 * nodes * size + 1e-11 * size
            )
            assert command.rate_scale == pytest.approx(plain.rate_scale if pace else command.rate_scale, rel=1e-5)


def test_pace_does_not_touch_the_protected_rate(ets_vii, rng):
    for pace in (0.0, 0.3, 1.0):
        for limit in (0.05, np.inf):
            protection, q = random_twists(rng, 2), random_state(ets_vii, rng)
            law = SelectiveLaw(ets_vii, protection, gain=1.0, rate_limit=limit)
            wanted = 0.1 * attainable(ets_vii, protection, q, rng)
            command = law(q, rng.uniform(-2, 2, 3), protected_rate=wanted, pace=pace)
            np.testing.assert_allclose(command.protected_rate, wanted, atol=1e-16)
            assert np.abs(command.joint_rates).max() <= limit


def test_without_limits_only_the_task_is_paced(ets_vii, rng):
    protection, q, target = random_twists(rng, 2), random_state(ets_vii, rng), rng.uniform(-2, 2, 3)
    law = SelectiveLaw(ets_vii, protection, gain=0.4, rate_limit=np.inf, damping=0.0)
    wanted = attainable(ets_vii, protection, q, rng)
    for pace in (0.0, 0.3):
        v_cmd = pace * 0.4 * (target - ets_vii.frame_pose(q).translation)
        expected, condition = formula(ets_vii, protection, q, v_cmd, wanted)
        command = law(q, target, protected_rate=wanted, pace=pace)
        np.testing.assert_allclose(command.joint_rates, expected, atol=1e-14 * condition)


# What is asked once is not asked again, and what makes no sense is refused.


def test_nothing_of_what_was_asked_stays_behind(ets_vii):
    for options in ({}, {"sample_time": 0.1, "hold_nodes": 2}):
        law, q = SelectiveLaw(ets_vii, Protection("roll+yaw"), **options), ets_vii.configuration(START)
        expected = law(q, TARGET).values
        assert np.any(law(q, TARGET, protected_rate=[1e-3, 0], pace=0.5).values != expected)
        np.testing.assert_array_equal(law(q, TARGET).values, expected)
        np.testing.assert_array_equal(law(q, TARGET, protected_rate=[0.0, 0.0], pace=1.0).values, expected)
        with pytest.raises(ssm.InputError, match="target is not finite"):
            law(q, [np.nan, 0, 0], protected_rate=[1e-3, 0], pace=0.5)
        np.testing.assert_array_equal(law(q, TARGET).values, expected)
        out = np.empty(law.size)
        law.evaluate(q, TARGET, np.zeros(3), out, protected_rate=[1e-3, 0], pace=0.5)
        np.testing.assert_array_equal(out, law(q, TARGET, protected_rate=[1e-3, 0], pace=0.5).values)


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        ({"protected_rate": [0.1]}, r"protected_rate is \[0.1\]; it needs 2 finite numbers"),
        ({"protected_rate": 0.1}, "protected_rate is 0.1; it needs 2"),
        ({"protected_rate": [0.1, np.nan]}, "it needs 2 finite numbers"),
        ({"protected_rate": "x"}, "protected_rate is 'x'; it needs real numbers"),
        ({"pace": -0.1}, "pace is -0.1; it is between 0"),
        ({"pace": 1.1}, "pace is 1.1"),
        ({"pace": np.nan}, "pace is nan; it needs one finite number"),
        ({"pace": [1.0, 1.0]}, "pace is"),
        ({"pace": "slow"}, "pace is 'slow'; it needs real numbers"),
    ],
)
def test_what_cannot_be_asked_is_refused(ets_vii, asked, says):
    law = SelectiveLaw(ets_vii, Protection("roll+yaw"))
    with pytest.raises(ssm.InputError, match=says):
        law(ets_vii.configuration(START), TARGET, **asked)
