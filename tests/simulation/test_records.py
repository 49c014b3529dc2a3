"""A record is what it is called: all that it derives, computed again from configurations and joint rates alone.

The oracle integrates the momentum law by scipy's DOP853, with matrices from Pinocchio's composite rigid body algorithm,
and shares nothing with the package but the model.
"""

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

import ssm_decouple as ssm
from ssm_decouple.simulation import steps
from ssm_decouple.simulation.replay import integral_along, rates_along

START = np.deg2rad([150, -20, -10, 10, 20, -30])
POSE = pin.SE3(pin.rpy.rpyToMatrix(0.4, -0.3, 1.1), np.array([0.5, -1.0, 2.0]))
TARGET = POSE.act(np.array([-1.8, -0.3, 1.2]))
MOMENTUM = np.array([0.5, -0.3, 0.2, 1.0, -2.0, 1.5])
FRAMES = ["base", "inertial", "link_3", "end_effector"]
DIRECTIONS = {
    "yaw": np.array([0.0, 0, 1]),
    "two": np.array([[0.6, 0], [0, 1], [0.8, 0]]),
    "twist": np.linalg.qr(np.random.default_rng(4).normal(size=(6, 6)))[0][:, :2],
}


def base_twist(robot, q, rates, momentum):
    """Return the base twist (6,), base axes, from the momentum about the base origin and the joint-space inertia."""
    data = robot.model.createData()
    M = pin.crba(robot.model, data, q)
    M = np.triu(M) + np.triu(M, 1).T
    R, p = pin.Quaternion(q[3:7]).matrix(), momentum[:3]
    arm = pin.centerOfMass(robot.model, data, q) - q[:3]
    there = np.r_[R.T @ p, R.T @ (momentum[3:] + np.cross(arm, p))]
    return np.linalg.solve(M[:6, :6], there - M[:6, 6:] @ rates)


def to_axes(robot, frame, q):
    """Return the rotation (3, 3) from base axes to the axes of a frame."""
    R = pin.Quaternion(q[3:7]).matrix()
    if frame in ("base", "inertial"):
        return np.eye(3) if frame == "base" else R
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    return data.oMf[robot.model.getFrameId(frame)].rotation.T @ R


def turned(C, twist):
    return np.r_[C @ twist[:3], C @ twist[3:]]


def oracle(robot, frame, q, h, motion):
    """Return configuration after a hold, and the integrals of the base twist in base axes and in others (2, 6).

    `motion` gives base twist and joint rates of a time and a configuration.
    """

    def slope(t, y):
        at = y[: q.size].copy()
        at[3:7] /= np.linalg.norm(at[3:7])
        twist, rates = motion(t, at)
        x, y, z, w = at[3:7]
        a, b, c = twist[3:]
        R = pin.Quaternion(at[3:7]).matrix()
        spin = [w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a, -x * a - y * b - z * c]
        return np.r_[R @ twist[:3], 0.5 * np.array(spin), rates, twist, turned(to_axes(robot, frame, at), twist)]

    start = np.r_[q, np.zeros(12)]
    end = solve_ivp(slope, (0, h), start, "DOP853", rtol=1e-13, atol=1e-16).y[:, -1]
    return end[: q.size], end[q.size :].reshape(2, 6)


def run(robot, protection, method, dt=0.25, holds=8, nodes=0, **settings):
    """Return a law and its motion; without rate limits and damping the law is smooth, as "rk4" needs it."""
    smooth = {"gain": 0.01, "rate_limit": np.inf, "damping": 0.0} if method == "rk4" else {}
    settings = {"gain": 0.1, "hold_nodes": nodes, "sample_time": dt if nodes else None, **smooth, **settings}
    made = ssm.ScheduledLaw if isinstance(protection, ssm.Schedule) else ssm.SelectiveLaw
    law = made(robot, protection, **settings)
    return law, ssm.simulate(law, robot.configuration(START, POSE), TARGET, holds * dt, dt, method)


def moving(robot, motion, law, i, method):
    """Return base twist and joint rates within a hold, as the method means them."""
    rates, momentum = motion.joint_rates.values[i], law.momentum
    twist = np.r_[motion.base_linear_velocity.values[i], motion.base_angular_velocity.values[i]]
    if method == "explicit":
        return lambda t, q: (twist, rates)
    if method == "held":
        return lambda t, q: (base_twist(robot, q, rates, momentum), rates)

    def continuous(t, q):
        v = law(q, TARGET, time=float(motion.time[i]) + t).joint_rates
        return base_twist(robot, q, v, momentum), v

    return continuous


def judge_integrals(robot, law, motion, method, frame, U, angle, tolerance):
    """Compare configurations, the integral of the base twist and `angle` (m, k) with the oracle, hold by hold."""
    steps = np.diff(motion.time.values)
    for i, h in enumerate(steps):
        q = motion.configuration.values[i]
        end, (base, along) = oracle(robot, frame, q, h, moving(robot, motion, law, i, method))
        found = motion.base_twist_integral.values[i + 1] - motion.base_twist_integral.values[i]
        np.testing.assert_allclose(found, base, rtol=0, atol=tolerance)
        np.testing.assert_allclose(angle[i + 1] - angle[i], U.T @ along, rtol=0, atol=tolerance)
        there = motion.configuration.values[i + 1]
        end[3:7] *= np.sign(end[3:7] @ there[3:7]) / np.linalg.norm(end[3:7])
        np.testing.assert_allclose(there, end, rtol=0, atol=tolerance)


STEP = {"explicit": 0.25, "held": 0.25, "rk4": 0.02}  # s; rk4 is of fourth order, the others are exact in a hold
EXACT = {"explicit": 1e-12, "held": 1e-12, "rk4": 1e-11}  # m and rad


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("words", DIRECTIONS)
@pytest.mark.parametrize("method", STEP)
def test_the_protected_angle_is_the_integral_of_the_true_rate(ets_vii, method, words, frame):
    law, motion = run(ets_vii, ssm.Protection(DIRECTIONS[words], frame), method, STEP[method])
    judge_integrals(
        ets_vii, law, motion, method, frame, law.directions[0], motion.protected_angle.values, EXACT[method]
    )
    assert np.abs(motion.base_twist_integral).max() > 1e-5


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("method", STEP)
def test_with_momentum_on_board_too(ets_vii, method, frame):
    dt = 0.25 if method == "explicit" else 0.02
    law, motion = run(ets_vii, ssm.Protection("yaw", frame), method, dt, momentum=MOMENTUM)
    judge_integrals(
        ets_vii, law, motion, method, frame, law.directions[0], motion.protected_angle.values, EXACT[method]
    )


@pytest.mark.parametrize("frame", FRAMES[1:])
@pytest.mark.parametrize("method", STEP)
def test_along_directions_that_the_law_does_not_know(ets_vii, method, frame):
    """What comparisons tell of the case's directions under another law."""
    U = DIRECTIONS["twist"]
    law, motion = run(ets_vii, ssm.Protection("none"), method, STEP[method])
    judge_integrals(ets_vii, law, motion, method, frame, U, integral_along(motion, U, frame), EXACT[method])


# Plans for the hold.


@pytest.mark.parametrize("momentum", [None, MOMENTUM])
@pytest.mark.parametrize("frame", FRAMES)
def test_with_three_nodes_nothing_turns_in_any_axes(ets_vii, frame, momentum):
    _law, motion = run(ets_vii, ssm.Protection("yaw", frame), "held", 0.5, 20, nodes=3, gain=0.05, momentum=momentum)
    assert np.rad2deg(np.abs(motion.protected_angle).max()) < 1e-12
    assert np.abs(motion.base_twist_integral[:, 3:]).max() > 1e-4
    assert float(motion.plan_change.max()) < 1e-12


@pytest.mark.parametrize(("nodes", "order"), [(0, 1), (1, 2), (2, 4)])
def test_the_order_of_a_plan_for_inertial_axes(ets_vii, nodes, order):
    drift = []
    for dt in (0.5, 0.25):
        _law, motion = run(ets_vii, ssm.Protection("yaw", "inertial"), "held", dt, int(20 / dt), nodes=nodes, gain=0.05)
        drift.append(np.abs(motion.protected_angle.values).max())
    assert np.log2(drift[0] / drift[1]) == pytest.approx(order, abs=0.3)


def test_what_a_plan_for_inertial_axes_holds_at_singularities(ets_vii):
    """The iteration on the whole law need not settle there; its last rates are projected."""
    _law, motion = run(ets_vii, ssm.Protection("all", "inertial"), "held", 0.5, 100, nodes=3, gain=0.05)
    assert motion.damping.values.max() > 0
    assert np.rad2deg(np.abs(motion.protected_angle).max()) < 1e-11


def test_six_rows_in_inertial_axes_are_planned_too(ets_vii):
    _law, motion = run(ets_vii, ssm.Protection(DIRECTIONS["twist"], "inertial"), "held", 0.5, 20, nodes=3, gain=0.05)
    assert np.abs(motion.protected_angle).max() < 1e-12


# What a protected rate is.

SCHEDULES = {
    "base": [(0.0, "yaw"), (2.0, "roll+yaw"), (4.0, "pitch")],
    "inertial": [(0.0, ssm.Protection("yaw", "inertial")), (2.0, ssm.Protection("roll", "inertial"))],
    "link_3": [(0.0, "none"), (1.0, ssm.Protection("yaw", "link_3"))],
}


@pytest.mark.parametrize("frame", SCHEDULES)
@pytest.mark.parametrize("momentum", [None, 0.1 * MOMENTUM])
def test_a_schedules_protected_rate_is_the_mean_over_the_hold(ets_vii, frame, momentum):
    schedule = ssm.Schedule(SCHEDULES[frame], hand_over=1.0)
    _law, motion = run(ets_vii, schedule, "held", 0.2, 30, nodes=2, gain=0.05, momentum=momentum)
    rate, angle, on = (motion[name].values for name in ("protected_rate", "protected_angle", "protection_share"))
    np.testing.assert_allclose(0.2 * rate[:-1], np.diff(angle, axis=0), rtol=0, atol=1e-11)
    assert np.abs(rate[on == 1.0]).max() < 1e-17
    assert np.abs(rate[on < 1.0]).max() > 1e-6
    assert np.abs(np.diff(angle, axis=0)[on[:-1] == 1.0]).max() < 1e-11
    assert "mean over the coming hold" in motion.protected_rate.attrs["long_name"]


@pytest.mark.parametrize("nodes", [0, 1, 3])
def test_a_schedule_that_stays_tells_what_its_one_protection_tells(ets_vii, nodes):
    always = ssm.Schedule([(0.0, "yaw"), (1e6, "roll")], hand_over=1.0)
    _, one = run(ets_vii, ssm.Protection("yaw"), "held", 0.2, 10, nodes=nodes)
    _, other = run(ets_vii, always, "held", 0.2, 10, nodes=nodes)
    np.testing.assert_allclose(other.protected_rate[:, 0], one.protected_rate[:, 0], atol=1e-16)
    np.testing.assert_allclose(other.protected_angle[:, 0], one.protected_angle[:, 0], atol=1e-16)
    rates = rates_along(one, always.U_twist, "base")
    np.testing.assert_allclose(other.protected_rate, rates, atol=1e-16)


def test_the_record_says_what_its_protected_rate_is(ets_vii):
    for nodes, words in ((0, "at the sample, as commanded"), (2, "mean over the coming hold, as the law plans it")):
        _, motion = run(ets_vii, ssm.Protection("yaw"), "held", 0.25, 2, nodes=nodes)
        assert motion.protected_rate.attrs["long_name"].endswith(words)
    law = ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw"), sample_time=0.1, hold_nodes=2)
    dynamic = ssm.simulate(law, ets_vii.configuration(START), [-1.8, -0.3, 1.2], 0.3, 0.1, ssm.Dynamic())
    assert dynamic.protected_rate.attrs["long_name"].endswith("the truth at the sample")


# All that a record derives.


def singular_value(robot, q, protection, weights):
    """Return the smallest singular value of J_gt N_sub with joint weights, by the columns one by one."""
    n, scale = robot.n_joints, 1 / np.sqrt(weights)
    data = robot.model.createData()
    J = pin.computeFrameJacobian(robot.model, data, q, robot.end_effector_id, pin.LOCAL_WORLD_ALIGNED)[:3]
    twists = np.array([base_twist(robot, q, e, np.zeros(6)) for e in np.eye(n)]).T
    C = to_axes(robot, protection.frame, q)
    seen = np.vstack([C @ twists[:3], C @ twists[3:]])
    J_sub, J_gt = (protection.U_twist.T @ seen) * scale, (J[:, 6:] + J[:, :6] @ twists) * scale
    N = np.eye(n) - np.linalg.pinv(J_sub) @ J_sub
    return np.linalg.svd(J_gt @ N)[1][-1]


@pytest.mark.parametrize("weights", [None, [1.0, 4.0, 0.25, 2.0, 9.0, 1.0]])
@pytest.mark.parametrize("momentum", [None, MOMENTUM])
@pytest.mark.parametrize("frame", ["base", "inertial", "link_3"])
@pytest.mark.parametrize("method", STEP)
def test_every_derived_variable(ets_vii, method, frame, momentum, weights):
    law, motion = run(ets_vii, ssm.Protection("yaw", frame), method, 0.1, 6, momentum=momentum, joint_weights=weights)
    U, h = law.directions[0], np.zeros(6) if momentum is None else momentum
    for i in range(len(motion.time)):
        at = motion.isel(time=i)
        q, rates = at.configuration.values, at.joint_rates.values
        R, data = pin.Quaternion(q[3:7]).matrix(), ets_vii.model.createData()
        twist = base_twist(ets_vii, q, rates, h)
        tool = ets_vii.frame_pose(q).translation
        expected = {
            "joint_positions": q[7:],
            "base_position": q[:3],
            "base_quaternion": q[3:7],
            "base_linear_velocity": twist[:3],
            "base_angular_velocity": twist[3:],
            "protected_rate": U.T @ turned(to_axes(ets_vii, frame, q), twist),
            "end_effector_position": tool,
            "target_position": TARGET,
            "end_effector_error": np.linalg.norm(TARGET - tool),
            "smallest_singular_value": singular_value(
                ets_vii, q, law.protection, np.ones(6) if weights is None else np.array(weights)
            ),
            "centre_of_mass": pin.centerOfMass(ets_vii.model, data, q),
            "linear_momentum": h[:3],
            "angular_momentum": h[3:],
        }
        for name, value in expected.items():
            np.testing.assert_allclose(at[name].values, value, rtol=1e-9, atol=1e-11, err_msg=name)
        np.testing.assert_allclose(pin.rpy.rpyToMatrix(*at.base_rpy.values), R, atol=1e-14)
        ratio = float(at.smallest_singular_value) / law.damping_threshold
        rho = law.damping * (1 - ratio**2) ** 2 if ratio < 1 else 0.0
        np.testing.assert_allclose(at.damping, rho, rtol=1e-6, atol=1e-15)
        assert np.abs(rates).max() <= law.rate_limits.max()
        assert float(at.rate_scale) == 1.0 or np.abs(np.abs(rates) / law.rate_limits).max() > 1 - 1e-9
        assert float(at.rate_blend) == 1.0


def test_what_the_rows_of_other_tasks_are_measured_in(ets_vii):
    law = ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw"), tasks=ssm.OrientationTask())
    motion = ssm.simulate(law, ets_vii.configuration(START), np.eye(3), 0.2, 0.1)
    assert motion.smallest_singular_value.attrs["units"] == "as the rows of level 1"
    _, plain = run(ets_vii, ssm.Protection("yaw"), "held", 0.1, 1)
    assert (plain.smallest_singular_value.attrs["units"], plain.damping.attrs["units"]) == ("m", "m2")


# Angles that go on.


def test_the_attitude_goes_on_beyond_half_a_turn(ets_vii):
    """A base that starts just short of half a turn, and one that spins all the way round."""
    spin = np.array([0.0, 0, 0, 0, 0, 4000.0])
    law = ssm.SelectiveLaw(ets_vii, ssm.Protection("none"), gain=1e-9, momentum=spin)
    q = ets_vii.configuration(START)
    motion = ssm.simulate(law, q, [-1.8, -0.3, 1.2], 15.0, 0.05, "held")
    rpy = motion.base_rpy.values
    assert np.ptp(rpy[:, 2]) > 2 * np.pi
    assert np.abs(np.diff(rpy, axis=0)).max() < 0.5
    for angles, at in zip(rpy[::20], motion.configuration.values[::20], strict=True):
        np.testing.assert_allclose(pin.rpy.rpyToMatrix(*angles), ets_vii.base_pose(at).rotation, atol=1e-13)


def engines(robot):
    yield ssm.batch.Batch(robot)
    pytest.importorskip("jax")
    yield ssm.batch.JaxBatch(robot)


@pytest.mark.parametrize("way", [1, -1])
def test_batches_count_on_too(ets_vii, way):
    law = ssm.SelectiveLaw(ets_vii, ssm.Protection("none"))
    starts, alone = [], []
    for yaw in (0.0, way * (np.pi - 1e-4)):
        pose = pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, yaw), np.zeros(3))
        starts.append(ets_vii.configuration(START, pose))
    targets = np.array([[-1.8, -0.3, 1.2], pose.act(np.array([-1.8, -0.3, 1.2]))])
    for q, target in zip(starts, targets, strict=True):
        alone.append(np.ptp(ssm.simulate(law, q, target, 30.0, 0.1).base_rpy.values, axis=0))
    np.testing.assert_allclose(alone[1][2], alone[0][2], atol=1e-9)
    for engine in engines(ets_vii):
        found = engine.motions(law, np.array(starts), targets, 30.0, 0.1)
        np.testing.assert_allclose(found.base_rotation, alone, atol=1e-9)


def test_batches_judge_by_the_gain_of_the_task(ets_vii):
    law = ssm.SelectiveLaw(ets_vii, ssm.Protection("all"), gain=1.0, tasks=ssm.PositionTask(gain=0.05))
    q = ets_vii.configuration(START)
    motion = ssm.simulate(law, q, [-1.8, -0.3, 1.2], 60.0, 0.1)
    found = ssm.batch.Batch(ets_vii).motions(law, q[None], np.array([[-1.8, -0.3, 1.2]]), 60.0, 0.1)
    assert (found.outcome[0], found.outcome_time[0]) == (motion.outcome, motion.outcome_time)


# Wheels.


def wheeled(robot):
    axes = np.eye(3)
    wheels = [ssm.Wheel(f"w{i}", axes[i], spin_inertia=0.1, max_speed=600.0, max_torque=5.0) for i in range(3)]
    both = robot.with_wheels(wheels)
    return both, both.configuration({f"joint_{i + 1}": angle for i, angle in enumerate(START)})


@pytest.mark.filterwarnings("ignore:wheels need more torque:ssm_decouple.errors.DecoupleWarning")
def test_a_wheel_that_turns_many_times_between_samples(ets_vii):
    both, q = wheeled(ets_vii)
    law = ssm.SelectiveLaw(both, ssm.Protection("all"), gain=0.05)
    motion = ssm.simulate(law, q, [-1.8, -0.3, 1.2], 20.0, 0.5, "held")
    moved, rates = np.diff(motion.joint_positions.values, axis=0), motion.joint_rates.values[:-1]
    assert np.abs(moved).max() > 2 * np.pi
    np.testing.assert_allclose(moved, 0.5 * rates, atol=1e-9)


def test_the_momentum_of_wheels_is_that_of_their_true_speed(ets_vii):
    both, q = wheeled(ets_vii)
    law = ssm.SelectiveLaw(both, ssm.Protection("all"), gain=0.05, sample_time=0.1)
    method = ssm.Dynamic(step=0.01, servo=ssm.Servo(frequency=0.5))
    motion = ssm.simulate(law, q, [-1.8, -0.3, 1.2], 3.0, 0.1, method, smooth_start=3.0)
    at = [both.joint_index(name) for name in both.wheel_names]
    speeds = motion.joint_velocities.values[:, at] + motion.base_angular_velocity.values
    np.testing.assert_allclose(motion.wheel_momentum, 0.1 * speeds, rtol=1e-9, atol=1e-12)
    assert np.abs(motion.joint_rates - motion.joint_velocities).max() > 0.1  # the servo lags
    moved = np.diff(motion.joint_positions.values, axis=0)
    v = motion.joint_velocities.values
    np.testing.assert_allclose(moved, 0.05 * (v[1:] + v[:-1]), atol=0.05)


# Outcomes.


def test_who_follows_a_moving_target_is_not_stalled(ets_vii):
    """Without its velocity the law follows at a distance, which stays."""
    q = ets_vii.configuration(START)
    start = ets_vii.frame_pose(q).translation
    velocity = np.array([0.004, 0.002, -0.003])

    def target(time):
        return start + velocity * time, np.zeros(3)

    law = ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw"), gain=0.1)
    motion = ssm.simulate(law, q, target, 60.0, 0.1)
    assert 0.02 < motion.attrs["final_error"] < 0.06
    assert motion.attrs["outcome"] == "running"
    # An arm that cannot move any more while its target goes on has stalled.
    stuck = ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw"), gain=0.1, rate_limit=1e-7)
    assert ssm.simulate(stuck, q, target, 60.0, 0.1).attrs["outcome"] == "stalled"


@pytest.mark.parametrize("momentum", [None, [3.0, 0, 1, 2, 0, 8.0]])
@pytest.mark.parametrize("frame", ["base", "inertial"])
def test_long_holds_are_moved_as_truly_as_short_ones(ets_vii, momentum, frame):
    """What is held for 20 s, in which joints turn by 1.7 rad, is what twenty holds of 1 s make of the same rates."""
    q, law = ets_vii.configuration(START), ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw", frame), momentum=momentum)
    rates = 0.087 * np.array([1.0, -0.5, 0.8, 1.0, -1.0, 0.3])

    def velocity(q):
        return np.r_[law.base_twist(q, rates), rates]

    at, moved = q, np.zeros((2, 6))
    for _ in range(400):
        at, more = steps.hold_rates(law, at, velocity(at), 0.05)
        moved += more
    end, whole = steps.hold_rates(law, q, velocity(q), 20.0)
    np.testing.assert_allclose(end, at, atol=2e-9)
    np.testing.assert_allclose(whole, moved, atol=2e-9)
    with pytest.raises(ssm.InputError, match="rad in the 1e\\+09 s for which a command is held"):
        steps.hold_rates(law, q, velocity(q), 1e9)
