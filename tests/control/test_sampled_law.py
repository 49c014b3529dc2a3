"""Commands that are held: planned over the hold, and within acceleration limits."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pinocchio as pin
import pytest
from random_robots import random_robot, random_state
from scipy.integrate import quad

import ssm_decouple as ssm
from ssm_decouple import Protection, SelectiveLaw

EPS = np.finfo(float).eps
START = np.deg2rad([150, -20, -10, 0, 0, 0])
TARGET = [-1.8, -0.3, 1.2]


def turned_over_hold(robot, protection, q, rates, hold):
    """Rotation about the protected axes while joint rates are held, by adaptive quadrature of J_sub q_dot."""

    def rate(time, row):
        moved = pin.integrate(robot.model, q, np.r_[np.zeros(6), time * rates])
        return float((protection.J_sub(robot.coupling(moved)) @ rates)[row])

    return [quad(rate, 0, hold, args=(row,), epsabs=1e-16, epsrel=1e-13)[0] for row in range(protection.k)]


@pytest.mark.parametrize(("nodes", "bound"), [(0, 1e-4), (1, 2e-7), (2, 1e-11), (3, 2e-15)])
@pytest.mark.parametrize("axes", ["yaw", "roll+yaw"])
def test_the_rotation_over_a_hold_is_what_the_plan_promises(ets_vii, nodes, bound, axes):
    hold, protection = 0.5, Protection(axes)
    law = SelectiveLaw(ets_vii, protection, sample_time=hold, hold_nodes=nodes)
    q = ets_vii.configuration(START)
    command = law(q, TARGET)
    turned = np.abs(turned_over_hold(ets_vii, protection, q, command.joint_rates, hold)).max()
    assert turned < bound * hold
    assert turned > 0 or nodes == 3
    if nodes == 0:
        assert turned > 1e-6  # the paper's projection does turn the axis between samples


@pytest.mark.parametrize("seed", range(4))
def test_it_holds_for_any_robot(seed, rng):
    robot = random_robot(60 + seed, joints=5 + seed % 3, branching=0.0)
    protection = Protection(np.linalg.qr(rng.normal(size=(3, 3)))[0][:, :2])
    q = random_state(robot, rng)
    target = robot.frame_pose(q).translation + rng.uniform(-0.3, 0.3, 3)
    drift = []
    for nodes in (0, 1, 2):
        law = SelectiveLaw(robot, protection, gain=0.3, rate_limit=0.2, sample_time=0.1, hold_nodes=nodes)
        drift.append(np.linalg.norm(turned_over_hold(robot, protection, q, law(q, target).joint_rates, 0.1)))
    assert drift[1] < 0.05 * drift[0]
    assert drift[2] < 0.05 * drift[1]


def test_the_planned_command_is_the_law_on_averaged_matrices(ets_vii):
    """With one node: the fixed point of the law posed at the middle of the hold."""
    hold = 0.2
    law = SelectiveLaw(ets_vii, Protection("yaw"), rate_limit=np.inf, sample_time=hold, hold_nodes=1)
    plain = SelectiveLaw(ets_vii, Protection("yaw"), rate_limit=np.inf)
    q = ets_vii.configuration(START)
    command = law(q, TARGET)
    middle = pin.integrate(ets_vii.model, q, 0.5 * hold * command.velocity)
    np.testing.assert_allclose(command.joint_rates, plain(middle, TARGET).joint_rates, rtol=1e-10)
    # What it tells of the base is at the sample, so that [base twist; rates] has no momentum there.
    assert np.linalg.norm(ets_vii.momentum(q, command.velocity)) < 1e-13
    assert np.linalg.norm(command.protected_rate) < 1e-17
    np.testing.assert_allclose(command.end_effector_position, ets_vii.frame_pose(q).translation, atol=1e-15)


def test_held_steps_are_of_sixth_order(ets_vii, rng):
    """One hold of two seconds in two pieces, in four, in eight, against a hundred."""
    from ssm_decouple.simulation.steps import hold_piece

    law = SelectiveLaw(ets_vii, Protection("none"))
    q0, rates = random_state(ets_vii, rng), rng.uniform(-0.4, 0.4, 6)
    values = np.r_[np.zeros(6), rates]

    def after(steps):
        q, turned = q0, np.zeros(6)
        for _ in range(steps):
            q, more = hold_piece(law, q, values, 2.0 / steps)
            turned = turned + more
        return q, turned

    truth, turned = after(100)
    errors = [np.linalg.norm(pin.difference(ets_vii.model, truth, after(steps)[0])) for steps in (2, 4, 8)]
    np.testing.assert_allclose(np.log2(np.array(errors[:-1]) / errors[1:]), 6, atol=0.7)
    np.testing.assert_allclose(after(4)[1], turned, atol=1e-13)
    # Momentum: the centre of mass has not moved, to the same accuracy.
    moved = ets_vii.coupling(truth).centre_of_mass - ets_vii.coupling(q0).centre_of_mass
    assert np.linalg.norm(moved) < 1e-13


@pytest.mark.parametrize(("nodes", "order"), [(0, 1), (1, 2), (2, 4)])
def test_order_of_the_drift(ets_vii, nodes, order):
    drift = []
    for dt in (0.5, 0.25):
        law = SelectiveLaw(ets_vii, Protection("yaw"), sample_time=dt, hold_nodes=nodes)
        motion = ssm.simulate(law, ets_vii.configuration(START), TARGET, 60.0, dt, method="held")
        drift.append(np.abs(motion.protected_angle.values).max())
    assert np.log2(drift[0] / drift[1]) == pytest.approx(order, abs=0.25)


def test_with_three_nodes_the_axis_does_not_drift(ets_vii):
    law = SelectiveLaw(ets_vii, Protection("yaw"), sample_time=0.1, hold_nodes=3)
    motion = ssm.simulate(law, ets_vii.configuration(START), TARGET, 150.0, 0.1, method="held")
    assert np.rad2deg(np.abs(motion.protected_angle.values).max()) < 1e-15
    assert motion.attrs["final_error"] < 1e-3
    assert np.abs(motion.angular_momentum.values).max() < 1e-12
    assert np.ptp(motion.centre_of_mass.values, axis=0).max() < 1e-12


@pytest.mark.filterwarnings("ignore:the commanded rates reverse")
@pytest.mark.parametrize("name", ["case2_flight", "case3_flight"])
def test_the_plan_holds_at_singularities_too(name):
    """There the iteration on the whole law does not settle, and the last rates are projected instead."""
    case = ssm.load_case(name)
    law = SelectiveLaw(case.robot, case.protection, rate_limit=np.deg2rad(5), sample_time=0.5, hold_nodes=3)
    motion = ssm.simulate(law, case.start(), case.target, 150.0, 0.5, method="held")
    assert motion.attrs["outcome"] == "stalled"
    assert motion.damping.values.max() > 0
    assert motion.plan_change.values.max() < 1e-12
    assert np.rad2deg(np.abs(motion.protected_angle.values).max()) < 1e-12
    assert np.abs(motion.joint_rates.values).max() <= np.deg2rad(5)
    assert np.abs(motion.protected_rate.values).max() < 1e-18


def test_a_moving_target_is_led_by_half_a_hold(ets_vii):
    q = ets_vii.configuration(START)
    centre, speed = ets_vii.frame_pose(q).translation, np.array([0.01, 0.0, 0.0])
    law = SelectiveLaw(ets_vii, Protection("yaw"), sample_time=0.5, hold_nodes=2)
    motion = ssm.simulate(law, q, lambda time: (centre + speed * time, speed), 20.0, 0.5, method="held")
    assert motion.end_effector_error.values[0] < 1e-15
    assert motion.end_effector_error.values.max() < 1e-5  # it moves 5 mm in each hold


# Acceleration limits.


@pytest.mark.parametrize("nodes", [0, 2])
@pytest.mark.parametrize("limit", [0.5, 2.0])
def test_accelerations_stay_inside_their_limit_and_the_protection_exact(nodes, limit):
    """From rest to the end, at every sample."""
    case = ssm.load_case("case1")
    law = SelectiveLaw(
        case.robot,
        case.protection,
        rate_limit=np.deg2rad(5),
        sample_time=0.1,
        hold_nodes=nodes,
        acceleration_limit=np.deg2rad(limit),
    )
    motion = ssm.simulate(law, case.start(), case.target, 150.0, 0.1, method="held")
    rates = np.vstack([np.zeros(6), motion.joint_rates.values])
    assert np.abs(np.diff(rates, axis=0)).max() <= 0.1 * np.deg2rad(limit)
    assert np.abs(rates).max() <= np.deg2rad(5)
    assert motion.attrs["outcome"] == "converged"
    assert np.abs(motion.protected_rate.values).max() < 1.5e-19
    free = ssm.simulate(case.make_law(), case.start(), case.target, 150.0, 0.1)
    assert np.abs(free.joint_rates.values[0]).max() > 4 * 0.1 * np.deg2rad(limit)  # the paper's jump
    blend = motion.rate_blend.values
    assert blend[0] < 1
    assert blend[-1] == 1


def test_from_rest_the_blend_is_time_scaling(ets_vii):
    q = ets_vii.configuration(START)
    limited = SelectiveLaw(ets_vii, Protection("roll+yaw"), sample_time=0.1, acceleration_limit=0.02)
    free = SelectiveLaw(ets_vii, Protection("roll+yaw"))
    gentle, wanted = limited(q, TARGET, previous_rates=np.zeros(6)), free(q, TARGET)
    np.testing.assert_allclose(gentle.joint_rates, gentle.rate_blend * wanted.joint_rates, rtol=1e-12)
    assert np.abs(gentle.joint_rates).max() == pytest.approx(0.002, rel=1e-9)


@pytest.mark.parametrize("k", [1, 2, 3])
def test_blended_rates_are_protected_in_exact_arithmetic(ets_vii, rng, k):
    from test_law import kernel_J_sub

    protection = Protection(np.linalg.qr(rng.normal(size=(3, 3)))[0][:, :k])
    law = SelectiveLaw(ets_vii, protection, sample_time=0.1, acceleration_limit=rng.uniform(0.1, 0.5, 6))
    for _ in range(50):
        q = random_state(ets_vii, rng)
        previous = protection.N_sub(ets_vii.coupling(q)) @ rng.uniform(-0.04, 0.04, 6)
        command = law(q, rng.uniform(-3, 3, 3), previous_rates=previous)
        assert np.all(np.abs(command.joint_rates - previous) <= 0.1 * law.acceleration_limits + 1e-16)
        J_sub = kernel_J_sub(ets_vii, protection, q)
        residual = [
            float(sum(Fraction(float(a)) * Fraction(float(b)) for a, b in zip(row, command.joint_rates, strict=True)))
            for row in J_sub
        ]
        assert np.linalg.norm(residual) <= 2 * EPS * np.linalg.norm(J_sub, 2) * np.linalg.norm(command.joint_rates)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"hold_nodes": 2}, "need the sample_time"),
        ({"acceleration_limit": 1.0}, "need the sample_time"),
        ({"hold_nodes": 4, "sample_time": 0.1}, r"hold_nodes is 4; it is 0 \(at the sample\), 1, 2 or 3"),
        ({"sample_time": 0.0}, "sample_time is 0.0; it must be a positive number"),
        (
            {"sample_time": 0.1, "acceleration_limit": 0.0},
            "acceleration_limit is 0.0; every joint's must be above zero",
        ),
        ({"sample_time": 0.1, "acceleration_limit": [1.0, 2.0]}, r"acceleration_limit has shape \(2,\)"),
    ],
)
def test_bad_settings_are_refused(ets_vii, options, says):
    with pytest.raises(ssm.InputError, match=says):
        SelectiveLaw(ets_vii, Protection("yaw"), **options)


def test_bad_use_is_refused(ets_vii):
    q = ets_vii.configuration(START)
    limited = SelectiveLaw(ets_vii, Protection("yaw"), sample_time=0.1, acceleration_limit=0.1)
    with pytest.raises(ssm.InputError, match="an acceleration limit needs previous_rates"):
        limited(q, TARGET)
    with pytest.raises(ssm.InputError, match="previous_rates needs 6 finite joint rates"):
        limited(q, TARGET, previous_rates=[0.0, 0.0])
    with pytest.raises(ssm.InputError, match="previous_rates needs 6 finite joint rates"):
        limited(q, TARGET, previous_rates=np.full(6, np.nan))
    planned = SelectiveLaw(ets_vii, Protection("yaw"), sample_time=0.1, hold_nodes=1)
    with pytest.raises(ssm.InputError, match=r"sample_time is 0.1 s, dt is 0.2 s"):
        ssm.simulate(planned, q, TARGET, 1.0, 0.2, method="held")
    with pytest.raises(ssm.InputError, match=r"duration 1.05 s is no whole number of steps of 0.1 s"):
        ssm.simulate(planned, q, TARGET, 1.05, 0.1, method="held")
    with pytest.raises(ssm.InputError, match="use method 'held' or a Dynamic, not 'explicit'"):
        ssm.simulate(planned, q, TARGET, 1.0, 0.1)
    with pytest.raises(ssm.InputError, match="not 'rk4'"):
        ssm.simulate(limited, q, TARGET, 1.0, 0.1, method="rk4")
    broken = q.copy()
    broken[8] = np.nan
    with pytest.raises(ssm.InputError, match=r"not finite at q\[8\]"):
        planned(broken, TARGET)
