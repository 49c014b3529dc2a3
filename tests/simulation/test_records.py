"""A record is what it is called: all that it derives, computed again from configurations and joint rates alone.

The oracle integrates the momentum law by scipy's DOP853, with matrices from Pinocchio's composite rigid body algorithm,
and shares nothing with the package but the model.
"""


import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

import ssm_decouple as ssm
from ssm_decouple.simulation.replay import integral_along

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


def judge_integrals(robot, law, motion, method, frame, U, angle, tolerance, axes_integral=None):
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


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("words", DIRECTIONS)
@pytest.mark.parametrize("method", STEP)
def test_the_protected_angle_is_the_integral_of_the_true_rate(ets_vii, method, words, frame):
    law, motion = run(ets_vii, ssm.Protection(DIRECTIONS[words], frame), method, STEP[method])
    judge_integrals(ets_vii, law, motion, method, frame, law.directions[0], motion.protected_angle.values, 1e-11)
    assert np.abs(motion.base_twist_integral).max() > 1e-5


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("method", STEP)
def test_with_momentum_on_board_too(ets_vii, method, frame):
    dt = 0.25 if method == "explicit" else 0.02
    law, motion = run(ets_vii, ssm.Protection("yaw", frame), method, dt, momentum=MOMENTUM)
    judge_integrals(ets_vii, law, motion, method, frame, law.directions[0], motion.protected_angle.values, 1e-11)


@pytest.mark.parametrize("frame", FRAMES[1:])
@pytest.mark.parametrize("method", STEP)
def test_along_directions_that_the_law_does_not_know(ets_vii, method, frame):
    """What comparisons tell of the case's directions under another law."""
    U = DIRECTIONS["twist"]
    law, motion = run(ets_vii, ssm.Protection("none"), method, STEP[method])
    judge_integrals(ets_vii, law, motion, method, frame, U, integral_along(motion, U, frame), 1e-11)
