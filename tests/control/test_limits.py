"""Limits: closed forms, independent solvers, and what holds along whole motions."""

from __future__ import annotations

import warnings

import daqp
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from random_robots import random_robot, random_state
from scipy.optimize import linprog, minimize

from ssm_decouple import DecoupleWarning, InputError, Protection, Robot, SelectiveLaw, load_robot, simulate
from ssm_decouple.control import limits_kernel as kernel
from ssm_decouple.control.collision import Clearance
from ssm_decouple.control.limits import LimitedRates, LimitedStep, Limits

EPS = np.finfo(float).eps
DT = 0.1
START = np.deg2rad([150, -20, -40, 0, 20, 0])
RATE = np.deg2rad(5)


class Matrices:
    """What a step needs at a configuration, by NumPy alone."""

    def __init__(self, robot: Robot, protection: Protection, q: np.ndarray) -> None:
        coupling = robot.coupling(q)
        self.positions = robot.joint_positions(q)
        self.J_sub = np.ascontiguousarray(protection.J_sub(coupling))
        self.J = np.ascontiguousarray(coupling.J_gt)
        self.N = np.eye(robot.n_joints) - np.linalg.pinv(self.J_sub) @ self.J_sub
        self.J_base = coupling.J_base

    def plain(self, v: np.ndarray) -> np.ndarray:
        return np.linalg.pinv(self.J @ self.N, rcond=1e-8) @ v

    def turning(self, wanted: np.ndarray, v: np.ndarray) -> np.ndarray:
        inverse = np.linalg.pinv(self.J_sub)
        rates = inverse @ wanted + self.plain(v - self.J @ (inverse @ wanted))
        return rates - inverse @ (self.J_sub @ rates - wanted)


def call(step: LimitedStep, at: Matrices, v, previous=None, wanted=None, rho=0.0, **more) -> LimitedRates:
    n, k = len(at.positions), len(at.J_sub)
    previous = np.zeros(n) if previous is None else previous
    wanted = np.zeros(k) if wanted is None else np.asarray(wanted, dtype=float)
    return step(at.positions, previous, at.turning(wanted, v), at.J_sub, wanted, [(at.J, v, rho)], **more)


def follow(step, protection, q, targets, samples, wanted=None, gain=0.3):
    """Yield (matrices, previous rates, result) along a motion with held rates and a momentum-conserving base."""
    robot, previous = step.robot, np.zeros(step.robot.n_joints)
    for i in range(samples):
        at = Matrices(robot, protection, q)
        v = gain * (targets[i * len(targets) // samples] - robot.frame_pose(q).translation)
        result = call(step, at, v, previous, None if wanted is None else wanted(i))
        yield at, previous, result
        previous = result.joint_rates.copy()
        q = pin.integrate(robot.model, q, DT * np.r_[at.J_base @ previous, previous])


@given(st.floats(1e-6, 10.0), st.floats(1e-3, 5.0), st.floats(0.01, 1.0))
def test_a_joint_stops_just_before_its_limit(room, deceleration, dt):
    """The speed, held once and then less by a constant each sample, goes exactly the room that there is."""
    step = deceleration * dt
    speed = kernel.stopping_speed(room, step, dt)
    speeds = np.maximum(speed - step * np.arange(int(speed / step) + 2), 0.0)
    assert dt * speeds.sum() == pytest.approx(room, rel=1e-9)


@given(st.floats(0.0, 50.0), st.floats(0.01, 1.0))
def test_the_way_of_all_joints_scaled_to_rest(time, dt):
    later = np.arange(1, int(time / dt) + 2) * dt
    assert kernel.stretch(time, dt) == pytest.approx(dt * (1.0 + np.sum(np.maximum(time - later, 0.0)) / (time or 1.0)))


@given(st.floats(0.0, 10.0), st.floats(0.1, 10.0), st.floats(0.01, 5.0))
def test_an_approach_has_no_kink_and_needs_no_more_than_the_deceleration(room, hold, deceleration):
    h = 1e-6 * (1.0 + room)
    here, there = (kernel.approach_speed(x, hold, deceleration) for x in (room, room + h))
    slope = (there - here) / h
    assert -1e-9 <= here * slope <= deceleration * (1 + 1e-4) + 1e-9


@pytest.mark.parametrize("acceleration", [None, 1.0])
def test_plain_rates_inside_all_limits_stay_as_they_are(acceleration):
    robot = load_robot("ets_vii")
    step = LimitedStep(robot, Limits(), RATE, acceleration, DT)
    at = Matrices(robot, Protection("yaw"), robot.configuration(START))
    v = np.array([0.001, -0.002, 0.001])
    result = call(step, at, v)
    np.testing.assert_array_equal(result.joint_rates, at.turning(np.zeros(1), v))
    assert (result.active, result.outside, result.excess, result.share) == ((), (), 0.0, 1.0)


@pytest.mark.parametrize("seed", range(6))
def test_one_level_by_an_independent_solver(seed):
    """SLSQP on the same convex problem in all n rates, bounds and objective written down anew."""
    rng = np.random.default_rng(seed)
    robot, protection = random_robot(seed, joints=7), Protection(["yaw", "all", "none"][seed % 3])
    step = LimitedStep(robot, Limits(), 0.4, None, DT)
    q, n = random_state(robot, rng), robot.n_joints
    at, previous, v, rho = Matrices(robot, protection, q), np.zeros(n), rng.normal(size=3), [0.0, 1e-3][seed % 2]
    previous = at.N @ rng.uniform(-0.2, 0.2, n)
    result = call(step, at, v, previous, rho=rho)
    limits = robot.position_limits
    low = np.maximum(-0.4, 0.5 * np.minimum(limits[:, 0] - at.positions, 0.0) / DT)
    high = np.minimum(0.4, 0.5 * np.maximum(limits[:, 1] - at.positions, 0.0) / DT)
    inside = np.all((limits[:, 0] < at.positions) & (at.positions < limits[:, 1]))
    if not inside:
        pytest.skip("outside its limits another problem comes first")
    decides = np.linalg.pinv(at.J @ at.N, rcond=1e-8) @ at.J @ at.N
    free, weight = at.N - decides, np.sum(at.J**2)
    steady = kernel.STEADY * weight * (decides + kernel.FADE * free) @ previous
    H = (
        at.J.T @ at.J
        + (kernel.STEADY * weight + rho) * np.eye(n)
        + (kernel.SMALLEST * weight * free if rho == 0 else 0)
    )
    f = -at.J.T @ v - steady
    solved = minimize(
        lambda x: 0.5 * x @ H @ x + f @ x,
        np.zeros(n),
        jac=lambda x: H @ x + f,
        bounds=list(zip(low, high, strict=True)),
        constraints={"type": "eq", "fun": lambda x: at.J_sub @ x, "jac": lambda x: at.J_sub} if len(at.J_sub) else (),
        options={"ftol": 1e-15, "maxiter": 500},
    )
    assert solved.success or solved.status == 8  # 8: nothing better along the line
    value = 0.5 * result.joint_rates @ H @ result.joint_rates + f @ result.joint_rates
    assert value <= solved.fun + 1e-9 * abs(solved.fun)
    np.testing.assert_allclose(result.joint_rates, solved.x, atol=2e-5)


def test_the_lower_level_does_not_disturb_the_upper():
    rng = np.random.default_rng(3)
    robot = random_robot(11, joints=8)
    step, protection = LimitedStep(robot, Limits(position=[[-4, 4]] * 8), 0.3, None, DT), Protection("yaw")
    n, met = robot.n_joints, 0
    for _ in range(20):
        at = Matrices(robot, protection, random_state(robot, rng))
        v, posture = rng.normal(size=3) * 0.05, rng.normal(size=n)
        plain = at.plain(v) + 1.0
        first = (at.J, v, 0.0)
        rates = {}
        for name, levels in {"one": [first], "two": [first, (np.eye(n), posture, 0.0)]}.items():
            rates[name] = step(at.positions, np.zeros(n), plain, at.J_sub, np.zeros(1), levels).joint_rates
        np.testing.assert_allclose(at.J @ rates["one"], at.J @ rates["two"], atol=1e-9)
        assert np.linalg.norm(rates["two"] - posture) <= np.linalg.norm(rates["one"] - posture) + 1e-9
        met += np.linalg.norm(rates["two"] - posture) < np.linalg.norm(rates["one"] - posture) - 1e-3
    assert met > 15


def way_to_rest(rates: np.ndarray, accelerations: float) -> np.ndarray:
    """Return the way (n,) of rates held once and then scaled down at 0.8 of the accelerations, sample by sample."""
    time = np.abs(rates).max() / (0.8 * accelerations)
    shares = np.maximum(1.0 - np.arange(int(time / DT) + 2) * DT / max(time, DT), 0.0)
    return DT * shares.sum() * np.abs(rates)


@pytest.mark.parametrize("k", ["yaw", "all"])
@pytest.mark.parametrize("acceleration", [None, 1.0, 0.1])
@pytest.mark.parametrize("width", [0.3, 1.0])
def test_what_holds_along_a_motion(k, acceleration, width):
    """Protection, position, rate and acceleration limits in every sample, with targets that the limits put far away."""
    rng = np.random.default_rng(2)  # at rates that the turning of null(J_sub) would take too much acceleration for
    robot, protection = load_robot("ets_vii"), Protection(k)
    accelerations = None if acceleration is None else np.deg2rad(acceleration)
    step = LimitedStep(robot, Limits(position=np.c_[START - width, START + width]), RATE, accelerations, DT)
    q = robot.configuration(START)
    targets = robot.frame_pose(q).translation + rng.uniform(-1, 1, (2, 3))
    reached = 0.0
    for at, previous, result in follow(step, protection, q, targets, 400, gain=1.0):
        rates, room = result.joint_rates, width - np.sign(result.joint_rates) * (at.positions - START)
        assert np.linalg.norm(at.J_sub @ rates) <= 2 * EPS * np.linalg.norm(at.J_sub) * np.linalg.norm(rates)
        assert np.abs(rates).max() <= RATE
        assert np.all(DT * np.abs(rates) <= room + 1e-14)
        assert (result.excess, result.share, result.outside) == (0.0, 1.0, ())
        if accelerations is not None:
            assert np.abs(rates - previous).max() <= accelerations * DT
            assert not result.stoppable or np.all(way_to_rest(rates, accelerations) <= room + 1e-13)
        reached = max(reached, np.abs(at.positions - START).max())
    assert reached > (0.1 if acceleration == 0.1 else 0.29)


@pytest.mark.parametrize("seed", range(4))
def test_what_holds_along_motions_of_random_robots(seed):
    rng = np.random.default_rng(seed)
    robot, protection = random_robot(seed, joints=7), Protection("yaw")
    q = robot.configuration(rng.uniform(-1, 1, 7))
    limits = robot.joint_positions(q)[:, None] + np.array([-0.2, 0.3])
    step = LimitedStep(robot, Limits(position=limits), 0.3, 0.2, DT)
    targets = robot.frame_pose(q).translation + rng.uniform(-1, 1, (2, 3))
    for at, previous, result in follow(step, protection, q, targets, 120, gain=1.0):
        rates, after = result.joint_rates, at.positions + DT * result.joint_rates
        assert np.linalg.norm(at.J_sub @ rates) <= 2 * EPS * np.linalg.norm(at.J_sub) * np.linalg.norm(rates)
        assert np.all((limits[:, 0] - 1e-13 <= after) & (after <= limits[:, 1] + 1e-13))
        assert np.abs(rates).max() <= 0.3
        assert result.excess > 0.0 or np.abs(rates - previous).max() <= 0.2 * DT
        assert result.excess < 0.01


def test_rates_do_not_jump_to_and_fro_at_limits():
    """Without acceleration limits, in steady approaches of targets that limits and reach put out of reach."""
    robot, protection, back = load_robot("ets_vii"), Protection("yaw"), []
    start = np.deg2rad([150, -20, -10, 0, 0, 0])
    q = robot.configuration(start)
    for width in (0.5, 2 * np.pi):
        step = LimitedStep(robot, Limits(position=np.c_[start - width, start + width]), RATE, None, DT)
        for target in np.random.default_rng(0).uniform(-1, 1, (3, 3)):
            targets = [robot.frame_pose(q).translation + target]
            rates = np.array([result.joint_rates for *_, result in follow(step, protection, q, targets, 250)])
            jumps = np.diff(rates, axis=0)
            back += list(np.minimum(np.abs(jumps[1:]), np.abs(jumps[:-1]))[jumps[1:] * jumps[:-1] < 0])
    assert max(back) < 0.2 * RATE


@pytest.mark.parametrize("acceleration", [None, 0.01])
def test_joints_outside_return_monotonically_and_are_told(acceleration):
    robot, protection = load_robot("ets_vii"), Protection("yaw")
    limits = np.c_[START - 1.0, START + 1.0]
    limits[1] = START[1] + 0.1, START[1] + 1.0
    limits[4] = START[4] - 1.0, START[4] - 0.05
    q = robot.configuration(START)
    step = LimitedStep(robot, Limits(position=limits), RATE, acceleration, DT)
    told, positions = [], []
    for at, _, result in follow(step, protection, q, [robot.frame_pose(q).translation], 150):
        told.append(result.outside)
        positions.append(at.positions)
        assert result.excess == 0.0
    positions = np.array(positions)
    assert told[0] == ("joint_2", "joint_5")
    assert told[-1] == ()
    outside = np.array([["joint_2" in names, "joint_5" in names] for names in told])[:-1]
    moved = np.diff(positions, axis=0)[:, [1, 4]] * [1, -1]
    assert np.all(moved[outside] > 0)


def test_a_wanted_rate_is_reached_or_yields_as_a_whole():
    robot, protection = load_robot("ets_vii"), Protection("all")
    at = Matrices(robot, protection, robot.configuration(START))
    v, wanted = np.array([0.05, 0.0, 0.02]), np.array([1e-5, -2e-5, 1e-5])
    step = LimitedStep(robot, Limits(), RATE, None, DT)
    for size in (1.0, 100.0):
        result = call(step, at, v, wanted=size * wanted)
        np.testing.assert_allclose(at.J_sub @ result.joint_rates, result.share * size * wanted, atol=1e-17)
        rows = np.vstack([at.J_sub.T, -size * wanted])  # unknown: rates and share, by a linear program
        best = linprog(
            [0.0] * 6 + [-1.0], A_eq=rows.T, b_eq=np.zeros(3), bounds=[(-RATE, RATE)] * 6 + [(0.0, 1.0)], method="highs"
        )
        assert result.share == pytest.approx(best.x[6], rel=1e-6)
    assert result.share < 1.0


def test_a_wanted_rate_along_a_motion_keeps_the_limits():
    robot, protection = load_robot("ets_vii"), Protection("yaw")
    q, width = robot.configuration(START), 0.4
    step = LimitedStep(robot, Limits(position=np.c_[START - width, START + width]), RATE, np.deg2rad(1), DT)
    shares = []
    for at, previous, result in follow(
        step, protection, q, [robot.frame_pose(q).translation], 400, wanted=lambda i: [2e-4]
    ):
        rates = result.joint_rates
        left = np.linalg.norm(at.J_sub @ rates - result.share * 2e-4)
        # What is wanted, a product itself, has its own rounding.
        assert left <= 2 * EPS * np.linalg.norm(at.J_sub) * np.linalg.norm(rates) + EPS * 2e-4
        assert np.abs(at.positions + DT * rates - START).max() <= width + 1e-14
        assert np.abs(rates - previous).max() <= np.deg2rad(1) * DT
        shares.append(result.share)
    assert max(shares) == pytest.approx(1.0)
    assert min(shares[300:]) < 0.5  # an arm at its limits cannot go on turning the base


@pytest.mark.parametrize("seed", range(5))
def test_the_least_excess_by_a_linear_program(seed):
    """Rates commanded before that today's null space does not hold: no acceleration inside the limits does."""
    rng = np.random.default_rng(seed)
    robot, protection, acceleration = load_robot("ets_vii"), Protection("all"), np.deg2rad(1)
    at = Matrices(robot, protection, robot.configuration(START))
    previous = rng.uniform(-RATE, RATE, 6)
    result = call(LimitedStep(robot, Limits(), RATE, acceleration, DT), at, np.zeros(3), previous)
    step = np.full((6, 1), acceleration * DT)
    best = linprog(
        [0.0] * 6 + [1.0],
        A_ub=np.block([[np.eye(6), -step], [-np.eye(6), -step]]),
        b_ub=np.r_[previous, -previous],
        A_eq=np.c_[at.J_sub, np.zeros(3)],
        b_eq=np.zeros(3),
        bounds=[(-RATE, RATE)] * 6 + [(0, None)],
        method="highs",
    )
    assert best.fun > 1.0
    assert result.excess == pytest.approx(best.fun - 1.0, rel=1e-3, abs=1e-6)
    assert np.linalg.norm(at.J_sub @ result.joint_rates) <= 1e-16
    assert np.abs(result.joint_rates).max() <= RATE


def test_the_same_call_gives_the_same_answer():
    robot = load_robot("ets_vii")
    step = LimitedStep(robot, Limits(), RATE, 0.01, DT)
    at = Matrices(robot, Protection("yaw"), robot.configuration(START))
    v = np.array([0.3, -0.2, 0.1])
    first = call(step, at, v).joint_rates
    call(step, at, -v)
    np.testing.assert_array_equal(first, call(step, at, v).joint_rates)


def test_rows_of_rounding_and_dependent_rows_constrain_nothing():
    """A third row that is the sum of two, and one of noise."""
    robot = load_robot("ets_vii")
    at = Matrices(robot, Protection("roll+yaw"), robot.configuration(START))
    step, v = LimitedStep(robot, Limits(), RATE, None, DT), np.array([0.3, -0.2, 0.1])
    expected = call(step, at, v).joint_rates
    plain = at.plain(v)
    at.J_sub = np.vstack([at.J_sub, at.J_sub.sum(axis=0), 1e-20 * np.ones(6)])
    wanted = np.zeros(4)
    rates = step(at.positions, np.zeros(6), plain, at.J_sub, wanted, [(at.J, v, 0.0)], noise=1e-18).joint_rates
    np.testing.assert_allclose(rates, expected, atol=1e-9)
    wanted = np.array([1e-5, 1e-5, 5e-6, 0.0])  # nearest that there is: the mean of what the sum says and the parts
    result = step(at.positions, np.zeros(6), plain, at.J_sub, wanted, [(at.J, v, 0.0)], noise=1e-18)
    nearest = at.J_sub[:3] @ np.linalg.pinv(at.J_sub[:3], rcond=1e-9) @ wanted[:3]
    np.testing.assert_allclose(at.J_sub[:3] @ result.joint_rates, result.share * nearest, atol=1e-15)
    assert result.share == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda: Limits(braking=1.0), "braking is 1.0"),
        (lambda: Limits(braking=0.0), "braking"),
        (lambda: Limits(clearance=0.1), "give a Clearance"),
        (lambda: step_with(Limits(position=[[1.0, -1.0]] * 6)), "'joint_1' are 1 and -1"),
        (lambda: step_with(Limits(position=[[0.0, np.nan]] * 6)), "nan"),
        (lambda: step_with(Limits(position=[[0.0, 1.0]] * 5)), r"shape \(5, 2\)"),
        (lambda: step_with("tight"), "give Limits"),
        (lambda: step_with(rate=0.0), "rate_limits"),
        (lambda: step_with(acceleration=-1.0), "acceleration_limits"),
        (lambda: step_with(acceleration=np.ones(3)), r"shape \(3,\)"),
        (lambda: step_with(dt=0.0), "sample_time"),
        (lambda: Clearance(-0.1), "distance"),
        (lambda: Clearance(0.1, horizon=0.05), "beyond the distance"),
        (lambda: Clearance(pairs=["bus"]), "no pair of link names"),
    ],
)
def test_what_makes_no_sense_is_told(change, message):
    with pytest.raises(InputError, match=message):
        change()


def step_with(limits=None, rate=RATE, acceleration=None, dt=DT) -> LimitedStep:
    return LimitedStep(load_robot("ets_vii"), Limits() if limits is None else limits, rate, acceleration, dt)


def test_arguments_that_do_not_fit_are_told():
    step, at = step_with(), Matrices(load_robot("ets_vii"), Protection("yaw"), load_robot("ets_vii").configuration())
    with pytest.raises(InputError, match="shapes do not fit 6 joints"):
        step(at.positions[:5], np.zeros(6), np.zeros(6), at.J_sub, np.zeros(1), [(at.J, np.zeros(3), 0.0)])
    with pytest.raises(InputError, match="not finite"):
        call(step, at, np.array([np.nan, 0.0, 0.0]))


def test_two_arrays_of_position_limits_are_a_table_of_them():
    robot = load_robot("ets_vii")
    np.testing.assert_array_equal(
        Limits(position=(START - 1, START + 1)).positions(robot), Limits(np.c_[START - 1, START + 1]).positions(robot)
    )
    np.testing.assert_array_equal(Limits().positions(robot), robot.position_limits)


@pytest.mark.parametrize("seed", range(5))
def test_the_last_bounds_are_tried_first(seed):
    """At the right bounds the answer is DAQP's, at others there is none."""
    rng, found = np.random.default_rng(seed), 0
    for _ in range(20):
        size, bounds = int(rng.integers(1, 7)), int(rng.integers(1, 12))
        root, A = rng.normal(size=(size, size)), rng.normal(size=(bounds, size))
        H, f = root @ root.T + 0.1 * np.eye(size), 3.0 * rng.normal(size=size)
        low, high = -rng.uniform(0.1, 1.0, bounds), rng.uniform(0.1, 1.0, bounds)
        expected, _, flag, told = daqp.solve(H, f, A, high, low, np.zeros(bounds, dtype=np.int32))
        assert flag == 1
        active, work, y = np.sign(told["lam"]), np.zeros((3 * size + 2, size)), np.zeros(size)
        assert kernel.solve_at(H, f, A, high, low, active, work, y)
        np.testing.assert_allclose(y, expected, atol=1e-8)
        if active.any():
            wrong = active.copy()
            wrong[np.flatnonzero(active)[0]] *= -1.0  # pushes the wrong way
            found += kernel.solve_at(H, f, A, high, low, wrong, work, y)
            found += kernel.solve_at(H, f, A, high, low, np.zeros(bounds), work, y)
    assert found == 0


@pytest.mark.parametrize("seed", range(9))
def test_the_return_from_outside_the_limits_throws_no_other_joint(seed):
    """Random limits and starts outside: hardly any rate changes its sign, and the joints come back."""
    rng, robot = np.random.default_rng(100 + seed), load_robot("ets_vii")
    middle, width = rng.uniform(-1.5, 1.5, 6), rng.uniform(0.3, 1.0, 6)
    start = middle + rng.uniform(-0.9, 0.9, 6) * width
    outside = rng.choice(6, 1 + seed % 3, replace=False)
    start[outside] += np.sign(start[outside] - middle[outside]) * (2.0 * width[outside])
    limits = Limits(np.c_[middle - width, middle + width])
    law = SelectiveLaw(
        robot,
        Protection(["yaw", "roll+yaw", "all"][seed % 3]),
        rate_limit=RATE,
        sample_time=DT,
        acceleration_limit=[None, 0.1][seed % 2],
        limits=limits,
    )
    q = robot.configuration(start)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DecoupleWarning)  # of the start
        motion = simulate(law, q, robot.frame_pose(q).translation + rng.uniform(-0.6, 0.6, 3), 30.0, DT, "held")
    rates = motion.joint_rates.values
    signs = (rates[1:] * rates[:-1] < 0.0) & (np.minimum(np.abs(rates[1:]), np.abs(rates[:-1])) > 1e-3)
    assert signs.sum(axis=0).max() < 10
    positions, bounds = motion.joint_positions.values, limits.positions(robot)
    beyond = np.maximum(positions - bounds[:, 1], bounds[:, 0] - positions).max(axis=1)
    assert beyond[-1] < 0.95 * beyond[0]


@pytest.mark.parametrize("seed", range(4))
def test_acceleration_limits_hold_with_weights_where_rows_depend_on_each_other(seed):
    """A planar arm in an oblique plane, of which the protection asks more rows than J_sub has rank."""
    rng = np.random.default_rng(seed)
    normal, joints = rng.normal(size=3), int(rng.integers(3, 6))
    normal /= np.linalg.norm(normal)
    along = np.cross(normal, [1.0, 0, 0]) / np.linalg.norm(np.cross(normal, [1.0, 0, 0]))

    def words(vector):
        return " ".join(map(repr, np.asarray(vector).tolist()))

    links, inertia = [], '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
    for i in range(joints + 1):
        mass, centre = (50.0, 0.0 * along) if i == 0 else (4.0, 0.3 * along)
        body = f'<origin xyz="{words(centre)}"/><mass value="{mass}"/>{inertia}'
        links.append(f'<link name="l{i}"><inertial>{body}</inertial></link>')
    for i in range(joints):
        links.append(
            f'<joint name="j{i}" type="continuous"><parent link="l{i}"/><child link="l{i + 1}"/>'
            f'<origin xyz="{words(0.7 * along)}"/><axis xyz="{words(normal)}"/></joint>'
        )
    robot = Robot(f'<robot name="planar">{"".join(links)}</robot>', name="planar")
    weights = rng.uniform(0.2, 5.0, joints)
    law = SelectiveLaw(
        robot,
        Protection("all"),
        gain=1.0,
        rate_limit=0.02,
        sample_time=DT,
        acceleration_limit=0.05,
        limits=Limits(),
        joint_weights=weights,
    )
    previous = np.zeros(joints)
    for _ in range(60):
        q = robot.configuration(rng.uniform(-2, 2, joints))
        goal = robot.frame_pose(q).translation + rng.choice([-0.5, 0.5]) * along
        command = law(q, goal, previous_rates=previous)
        assert np.abs(command.joint_rates).max() <= 0.05 * DT * (1 + 1e-9)
        J_rc = robot.coupling(q).J_rc
        assert np.linalg.norm(J_rc @ command.joint_rates) <= 64 * EPS * np.linalg.norm(J_rc) * 0.02
        lost = law.lost_direction(q)
        scale = 1 / np.sqrt(weights)
        row = scale * (normal @ J_rc)
        N = np.eye(joints) - np.outer(row, row) / (row @ row)
        assert lost.singular_value == pytest.approx(
            np.linalg.norm(lost.direction @ (scale * robot.coupling(q).J_gt) @ N), abs=1e-12
        )
