"""Protections that change: shares, rows that stay, smooth hand-overs, limits, holds, records."""

from __future__ import annotations

import json
from fractions import Fraction

import numpy as np
import pytest
from random_robots import random_robot, random_state
from test_law import EPS, exact_residual, kernel_J_sub
from test_tasks import START

import ssm_decouple as ssm
from ssm_decouple import ManipulabilityTask, PositionTask, Protection, Schedule, ScheduledLaw, SelectiveLaw

TARGET = [-1.8, -0.3, 1.2]
THREE = [(0.0, "yaw"), (4.0, "roll+yaw"), (12.0, "pitch+yaw")]


def smooth(x) -> float:
    """10 x^3 - 15 x^4 + 6 x^5 in exact arithmetic."""
    x = Fraction(x)
    return float(10 * x**3 - 15 * x**4 + 6 * x**5)


# The schedule.


def test_who_is_protected_when():
    schedule = Schedule(THREE, hand_over=5.0)
    q = np.zeros(7)
    assert (schedule.k, schedule.frame) == (3, "base")
    np.testing.assert_array_equal(schedule.U_twist, np.eye(6)[:, [5, 3, 4]])
    assert schedule.rows == ([0], [1, 0], [2, 0])
    for time in (0.0, 1.0, 4.0, 9.0, 10.5, 12.0, 17.0, 1e6):
        number, share = schedule.at(time, q)
        assert number == (time >= 9.0) + (time >= 17.0)
        assert share == 0.0
    for time, number, x in ((6.5, 0, 0.5), (4.25, 0, 0.05), (13.0, 1, 0.2), (16.75, 1, 0.95)):
        found, share = schedule.at(time, q)
        assert found == number
        assert share == pytest.approx(smooth(x), abs=1e-12)
        told = schedule.shares(found, share)
        expected = [1.0, share, 0.0] if number == 0 else [1.0, 1.0 - share, share]
        np.testing.assert_allclose(told, expected, atol=1e-15)
    # What two have in common.
    np.testing.assert_allclose(np.abs(schedule.shared(1).U_twist), np.eye(6)[:, [5]], atol=1e-15)
    assert Schedule([(0, "roll"), (3, "yaw")], hand_over=1.0).shared(0).k == 0


def test_what_two_bases_have_in_common_does_not_depend_on_them(rng):
    """Planes that share a line, in bases that do not have it as a column."""
    for _ in range(5):
        line, one, other = np.linalg.qr(rng.normal(size=(3, 3)))[0].T
        planes = []
        for across in (one, other):
            turn = np.linalg.qr(rng.normal(size=(2, 2)))[0]
            planes.append(Protection(np.column_stack([line, across]) @ turn))
        schedule = Schedule([(0, planes[0]), (5, planes[1])], hand_over=2.0)
        assert schedule.k == 4
        np.testing.assert_allclose(np.abs(schedule.shared(0).U_twist[3:, 0] @ line), 1, atol=1e-12)
        assert schedule.shared(0).k == 1
    same = Protection(planes[0].U_c @ turn)
    assert Schedule([(0, planes[0]), (5, same)], hand_over=2.0).shared(0).k == 2


def test_by_state():
    schedule = Schedule(["none", "yaw", "all"], progress=lambda time, q: q[0])
    for place in (0.0, 0.3, 1.0, 1.75, 2.0):
        number, share = schedule.at(0.0, np.array([place]))
        assert (number, share) == (int(place), pytest.approx(smooth(Fraction(place) % 1), abs=1e-14))
    for bad in (-1e-9, 2.0 + 1e-9, np.nan, np.inf):
        with pytest.raises(ssm.InputError, match=r"progress.* of a schedule is .* at 3 s; it is from 0 to 2"):
            schedule.at(3.0, np.array([bad]))


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Schedule(THREE), "either hand_over, s, .* or progress"),
        (lambda: Schedule(THREE, hand_over=1.0, progress=lambda t, q: 0.0), "either hand_over"),
        (lambda: Schedule(THREE, hand_over=0.0), "hand_over is 0"),
        (lambda: Schedule(THREE, hand_over=np.nan), "hand_over is nan"),
        (lambda: Schedule(THREE, hand_over=8.1), "leave no room for hand-overs of 8.1 s"),
        (lambda: Schedule([(0, "none"), (0, "yaw")], hand_over=1.0), "leave no room"),
        (lambda: Schedule([(0, "none"), (9, "yaw"), (5, "all")], hand_over=1.0), "leave no room"),
        (lambda: Schedule([(1, "none"), (9, "yaw")], hand_over=1.0), "has to start at 0 s"),
        (lambda: Schedule([(0, "none"), (np.nan, "yaw")], hand_over=1.0), "has to start at 0 s"),
        (lambda: Schedule([], hand_over=1.0), "has to start at 0 s"),
        (lambda: Schedule([(0, "yaw")], hand_over=1.0), "two or more protections, not 1"),
        (lambda: Schedule(["yaw"], progress=lambda t, q: 0.0), "two or more protections, not 1"),
        (lambda: Schedule(["none", "yaw"], hand_over=1.0), "a list of pairs"),
        (lambda: Schedule([(0, "none"), (5, "jaw")], hand_over=1.0), "unknown protection 'jaw'"),
        (lambda: Schedule([("now", "none"), (5, "yaw")], hand_over=1.0), "schedule times is"),
        (
            lambda: Schedule([(0, "roll"), (5, Protection("yaw", "inertial"))], hand_over=1.0),
            "need the same frame, not base, inertial",
        ),
    ],
)
def test_what_is_no_schedule_is_refused(make, says):
    with pytest.raises(ssm.InputError, match=says):
        make()


def test_what_a_scheduled_law_refuses(ets_vii):
    q = ets_vii.configuration(START)
    with pytest.raises(ssm.InputError, match="give a Schedule, or use SelectiveLaw"):
        ScheduledLaw(ets_vii, Protection("yaw"))
    law = ScheduledLaw(ets_vii, Schedule(THREE, hand_over=5.0))
    with pytest.raises(ssm.InputError, match=r"ask law\.phases"):
        law.lost_direction(q)
    with pytest.raises(ssm.InputError, match="needs 3 finite numbers, one a direction of the schedule"):
        law(q, TARGET, protected_rate=[1e-3])
    for settings, says in (
        ({"feedback_gain": 0.1}, "a schedule has several: leave it out"),
        ({"servo": ssm.Servo(protects=True)}, "no schedule"),
    ):
        with pytest.raises(ssm.InputError, match=says):
            ssm.simulate(law, q, TARGET, 1.0, 0.1, ssm.Dynamic(**settings))


# The law at one configuration.


@pytest.mark.parametrize("momentum", [None, [0.1, -0.2, 0.3, 0.5, -0.4, 0.6]])
def test_between_two_it_is_the_mean_of_their_rates(ets_vii, rng, momentum):
    """And a row that enters keeps the other share of what the base has without it."""
    law = ScheduledLaw(ets_vii, Schedule(THREE, hand_over=5.0), momentum=momentum)
    axes = ["yaw", "roll+yaw", "pitch+yaw"]
    for time, number in ((5.0, 0), (6.5, 0), (8.9, 0), (13.0, 1), (16.0, 1)):
        q, target = random_state(ets_vii, rng), rng.uniform(-2, 2, 3)
        first, second = (
            SelectiveLaw(ets_vii, Protection(axes[i]), momentum=momentum)(q, target) for i in (number, number + 1)
        )
        command, s = law(q, target, time=time), law.schedule.at(time, q)[1]
        expected = (1 - s) * first.joint_rates + s * second.joint_rates
        np.testing.assert_allclose(command.joint_rates, expected, atol=1e-13)
        np.testing.assert_allclose(
            ets_vii.momentum(q, command.velocity), np.zeros(6) if momentum is None else momentum, atol=1e-12
        )
        entering = command.base_twist[3 + number]  # roll, then pitch
        assert entering == pytest.approx((1 - s) * first.base_twist[3 + number], abs=1e-14)
        assert abs(command.base_twist[5]) < 1e-16
        assert command.protected_rate.shape == (1,)
    for time, number in ((0.0, 0), (10.0, 1), (30.0, 2)):
        command = law(q, target, time=time)
        expected = SelectiveLaw(ets_vii, Protection(axes[number]), momentum=momentum)(q, target)
        np.testing.assert_array_equal(command.values, expected.values)


@pytest.mark.parametrize("limit", [np.deg2rad(5.0), np.inf])
def test_rows_that_stay_are_rounding_in_exact_arithmetic(robots, rng, limit):
    worst = 0.0
    for robot in robots.values():
        if robot.n_joints < 6:
            continue
        line, one, other = np.linalg.qr(rng.normal(size=(3, 3)))[0].T
        turn = np.linalg.qr(rng.normal(size=(2, 2)))[0]
        pair = [Protection(np.column_stack([line, a]) @ turn) for a in (one, other)]
        law = ScheduledLaw(robot, Schedule([(0, pair[0]), (1, pair[1])], hand_over=1.0), gain=1.0, rate_limit=limit)
        stays = law.schedule.shared(0)
        for _ in range(10):
            q, time = random_state(robot, rng), rng.uniform(1.0, 2.0)
            command, J_sub = law(q, rng.uniform(-3, 3, 3), time=time), kernel_J_sub(robot, stays, q)
            size = np.linalg.norm(J_sub, 2) * np.linalg.norm(command.joint_rates)
            residual = exact_residual(J_sub, command.joint_rates)
            assert residual <= 2 * EPS * size
            assert np.abs(command.joint_rates).max() <= limit
            worst = max(worst, residual / (EPS * size))
    assert 0 < worst <= 2


def test_rates_that_are_asked_for(ets_vii, rng):
    law, b = ScheduledLaw(ets_vii, Schedule(THREE, hand_over=5.0), rate_limit=np.inf), np.array([1e-3, 2e-3, -1e-3])
    q = ets_vii.configuration(START)
    for time in (0.0, 6.0, 10.0, 14.0, 20.0):
        command, (number, s) = law(q, TARGET, time=time, protected_rate=b), law.schedule.at(time, q)
        w = command.base_twist[3:]
        assert w[2] == pytest.approx(b[0], rel=1e-9)
        if number == 1:
            alone = SelectiveLaw(ets_vii, Protection("pitch+yaw"), rate_limit=np.inf)
            leaving = alone(q, TARGET, protected_rate=b[[2, 0]]).base_twist[3]
            assert w[0] == pytest.approx((1 - s) * b[1] + s * leaving, rel=1e-9)


def test_the_same_protection_twice_is_one(ets_vii, rng):
    law = ScheduledLaw(ets_vii, Schedule([(0, "yaw"), (5, "yaw")], hand_over=5.0))
    plain = SelectiveLaw(ets_vii, Protection("yaw"))
    assert law.schedule.k == 1
    for time in (0.0, 6.0, 8.0, 20.0):
        q = random_state(ets_vii, rng)
        np.testing.assert_allclose(law(q, TARGET, time=time).joint_rates, plain(q, TARGET).joint_rates, atol=1e-16)


def test_momentum_is_passed_on(ets_vii):
    law = ScheduledLaw(ets_vii, Schedule(THREE, hand_over=5.0), momentum=np.ones(6))
    q = ets_vii.configuration(START)
    for momentum in (np.ones(6), np.arange(6.0), None):
        law.momentum = momentum
        for time in (0.0, 6.0, 30.0):
            told = ets_vii.momentum(q, law(q, TARGET, time=time).velocity)
            np.testing.assert_allclose(told, np.zeros(6) if momentum is None else momentum, atol=1e-12)


# Motions.


def jumps(motion) -> float:
    """The largest change of the joints' accelerations from sample to sample."""
    dt = float(motion.time[1] - motion.time[0])
    return float(np.abs(np.diff(motion.joint_rates.values, n=2, axis=0)).max() / dt)


def test_neither_rates_nor_accelerations_jump(ets_vii):
    """They change the less from sample to sample the closer the samples are; with an abrupt hand-over they do not."""
    q, found = ets_vii.configuration(START), {}
    for hand_over in (4.0, 1e-6):
        schedule = Schedule([(0, "none"), (4, "yaw"), (12, "none")], hand_over=hand_over)
        law = ScheduledLaw(ets_vii, schedule, rate_limit=np.inf)
        found[hand_over] = [jumps(ssm.simulate(law, q, TARGET, 20.0, dt, "rk4")) for dt in (0.1, 0.05)]
    smooth_ones, abrupt = found.values()
    assert smooth_ones[1] == pytest.approx(0.5 * smooth_ones[0], rel=0.05)
    assert abrupt[1] > 1.5 * abrupt[0]


def test_at_the_rate_limits_the_rates_do_not_jump(ets_vii):
    q, changes = ets_vii.configuration(START), []
    for dt in (0.1, 0.05):
        law = ScheduledLaw(ets_vii, Schedule(THREE, hand_over=4.0), gain=0.3)
        motion = ssm.simulate(law, q, TARGET, 20.0, dt, "rk4")
        assert np.mean(motion.rate_scale < 1) > 0.1
        assert np.abs(motion.joint_rates).max() <= np.deg2rad(5.0)
        assert np.abs(motion.protected_rate[:, 0]).max() < 1e-17
        changes.append(np.abs(np.diff(motion.joint_rates.values, axis=0)).max())
    assert changes[1] == pytest.approx(0.5 * changes[0], rel=0.15)


@pytest.mark.filterwarnings("ignore:the commanded rates reverse")
@pytest.mark.parametrize(("nodes", "order", "bound"), [(0, 1, 1e-3), (1, 2, 1e-6), (2, 4, 1e-11)])
def test_what_is_on_does_not_turn_over_holds(ets_vii, nodes, order, bound):
    """Yaw all the time, hand-overs of the others included; pitch from the end of its hand-over on."""
    q, drift = ets_vii.configuration(START), []
    for dt in (0.5, 0.25):
        law = ScheduledLaw(ets_vii, Schedule(THREE, hand_over=4.0), sample_time=dt, hold_nodes=nodes)
        motion = ssm.simulate(law, q, TARGET, 24.0, dt, "held")
        angle = motion.protected_angle.values
        held_still = motion.time.values >= 16.0
        assert np.ptp(angle[held_still, 2]) < bound
        assert np.ptp(angle[~held_still, 2]) > 1e-5
        drift.append(np.abs(angle[:, 0]).max())
    assert drift[1] < bound
    assert np.log2(drift[0] / drift[1]) == pytest.approx(order, abs=0.6)


def test_a_motion_that_protects_near_its_target(ets_vii):
    """By state: none far away, yaw within 0.4 m."""
    goal = np.array(TARGET)

    def progress(time, q):
        return np.clip((0.8 - np.linalg.norm(ets_vii.frame_pose(q).translation - goal)) / 0.4, 0.0, 1.0)

    law = ScheduledLaw(ets_vii, Schedule(["none", "yaw"], progress=progress))
    motion = ssm.simulate(law, ets_vii.configuration(START), TARGET, 100.0, 0.1, "rk4")
    share, distance = motion.protection_share.values[:, 0], motion.end_effector_error.values
    assert motion.attrs["outcome"] == "converged"
    np.testing.assert_allclose(share[distance > 0.8], 0)
    np.testing.assert_allclose(share[distance < 0.4], 1)
    assert np.all(np.diff(share) > -1e-12)
    rate = np.abs(motion.protected_rate.values[:, 0])
    assert rate[share == 1].max() < 1e-17
    assert rate[share == 0].max() > 1e-5


def test_generous_acceleration_limits_change_nothing(ets_vii):
    """Up to where the motion without limits stays inside them all the time, a smooth start included."""
    q, runs = ets_vii.configuration(START), []
    for settings in ({}, {"acceleration_limit": 0.05}):
        law = ScheduledLaw(ets_vii, Schedule([(0, "none"), (8, "yaw")], hand_over=6.0), sample_time=0.1, **settings)
        runs.append(ssm.simulate(law, q, TARGET, 20.0, 0.1, "held", smooth_start=6.0).joint_rates.values)
    assert np.abs(np.diff(runs[0], axis=0)).max() < 0.5 * 0.05 * 0.1
    np.testing.assert_allclose(runs[1], runs[0], atol=1e-12)


@pytest.mark.parametrize("nodes", [0, 2])
def test_acceleration_limits_are_kept_in_hand_overs(ets_vii, nodes):
    """From rest to just before the hand-over ends, where the phase takes over that has the last word."""
    schedule = Schedule([(0, "none"), (5, "yaw")], hand_over=10.0)
    law = ScheduledLaw(ets_vii, schedule, sample_time=0.1, hold_nodes=nodes, acceleration_limit=0.003)
    motion = ssm.simulate(law, ets_vii.configuration(START), TARGET, 14.9, 0.1, "held")
    changes = np.abs(np.diff(motion.joint_rates.values, axis=0)).max(axis=1)
    assert changes.max() <= 0.003 * 0.1 * (1 + 1e-6)


def test_the_record(ets_vii, tmp_path):
    law = ScheduledLaw(ets_vii, Schedule(THREE, hand_over=4.0), momentum=[0, 0, 0, 0.1, 0.2, -0.1])
    motion = ssm.simulate(law, ets_vii.configuration(START), TARGET, 20.0, 0.1)
    assert motion.protection_share.dims == ("time", "protected")
    assert motion.U_c.shape == (6, 3)
    assert motion.protected_rate.shape == motion.protected_angle.shape == (201, 3)
    np.testing.assert_array_equal(motion.U_c, law.schedule.U_twist)
    time = motion.time.values
    np.testing.assert_allclose(motion.protection_share[:, 0], 1)
    np.testing.assert_allclose(
        motion.protection_share[:, 1],
        [smooth(Fraction(min(max((t - 4) / 4, 0), 1))) - smooth(Fraction(min(max((t - 12) / 4, 0), 1))) for t in time],
        atol=1e-9,
    )
    # The three rows are yaw, roll and pitch of the recorded base twist.
    np.testing.assert_array_equal(motion.protected_rate, motion.base_angular_velocity.values[:, [2, 0, 1]])
    fully = motion.protection_share.values == 1
    assert np.abs(motion.protected_rate.values[fully]).max() < 1e-17
    assert np.abs(motion.protected_rate.values[~fully]).max() > 1e-5
    np.testing.assert_allclose(motion.angular_momentum, np.tile([0.1, 0.2, -0.1], (201, 1)), atol=1e-10)
    again = ssm.load_motion(ssm.save_motion(motion, tmp_path / "motion.nc"))
    np.testing.assert_array_equal(again.protection_share, motion.protection_share)
    told = json.loads(again.attrs["law"])
    assert [part["start"] for part in told["schedule"]] == [0.0, 4.0, 12.0]
    np.testing.assert_array_equal(told["schedule"][1]["U_c"], Protection("roll+yaw").U_twist)
    assert told["momentum"] == [0, 0, 0, 0.1, 0.2, -0.1]
    np.testing.assert_array_equal(told["U_c"], law.schedule.U_twist)


def test_the_settings_tell_one_k(ets_vii):
    told = ScheduledLaw(ets_vii, Schedule(THREE, hand_over=4.0)).describe()
    assert told["k"] == np.shape(told["U_c"])[1]


def test_axes_of_a_body_levels_and_branches(rng):
    """A schedule in the axes of a link, with a task that climbs, on a tree."""
    robot = random_robot(290, joints=9)
    frame = robot.link_names[3]
    pair = [Protection("yaw", frame), Protection("pitch+yaw", frame)]
    tasks = [PositionTask(), ManipulabilityTask()]
    law = ScheduledLaw(robot, Schedule([(0, pair[0]), (1, pair[1])], hand_over=1.0), tasks=tasks)
    for time in (0.5, 1.3, 1.8, 3.0):
        q = random_state(robot, rng)
        command = law(q, rng.uniform(-1, 1, 3), time=time)
        R = robot.frame_pose(q, frame).rotation.T @ robot.base_pose(q).rotation
        w = R @ command.base_twist[3:]
        assert abs(w[2]) <= 1e-13 * np.linalg.norm(w) + 1e-18
        assert (abs(w[1]) <= 1e-13 * np.linalg.norm(w)) == (time > 2)


def test_a_dynamic_motion(ets_vii):
    law = ScheduledLaw(ets_vii, Schedule(THREE, hand_over=4.0))
    method = ssm.Dynamic(step=0.005, servo=ssm.Servo(frequency=4.0))
    motion = ssm.simulate(law, ets_vii.configuration(START), TARGET, 20.0, 0.1, method, smooth_start=3.0)
    rate, share = np.abs(motion.protected_rate.values), motion.protection_share.values
    settled = motion.time.values > 17.0
    assert share[settled][:, 1].max() == 0
    assert rate[settled][:, 2].max() < 0.1 * rate[~settled][:, 2].max()
    assert motion.attrs["energy_error"] < 1e-9
