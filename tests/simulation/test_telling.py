"""What is promised and not kept is told: in the record, by a warning and on the command line."""

from __future__ import annotations

import json
import warnings

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from random_robots import random_robot, random_state

import ssm_decouple as ssm
from ssm_decouple.control import law as law_module
from ssm_decouple.simulation.telling import REVERSALS, reversals, sentences

START = np.deg2rad([150.0, -20, -10, 0, 0, 0])
TARGET = np.array([-1.8, -0.3, 1.2])
TOLD = ("protection_lost", "plan_unsettled", "rate_reversals", "acceleration_exceeded", "wheel_torque_exceeded")


def run(law, q, target, duration, dt=0.1, method="explicit", **more):
    """Return a motion and its warnings, which are the sentences of its record."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        motion = ssm.simulate(law, q, target, duration, dt, method, **more)
    told = [str(warning.message) for warning in caught if "reach" not in str(warning.message)]
    assert told == sentences(motion)
    return motion, told


@given(seed=st.integers(0, 40), size=st.sampled_from([0.0, 1e-3, 0.3, 30.0, 1e3]), nodes=st.sampled_from([0, 2]))
@example(seed=0, size=1e3, nodes=2)
@settings(max_examples=25)
def test_a_protected_rate_that_is_not_kept_is_told_and_no_other(seed, size, nodes):
    """Random robots with momentum on board: the attribute is there exactly where the rates are above rounding."""
    rng, robot = np.random.default_rng(seed), random_robot(400 + seed, joints=6)
    protection = ssm.Protection(["yaw", "roll+yaw", "all"][seed % 3])
    options = {"sample_time": 0.1, "hold_nodes": nodes} if nodes else {}
    momentum = size * np.r_[rng.normal(size=3), rng.normal(size=3)]
    law = ssm.SelectiveLaw(robot, protection, rate_limit=0.2, momentum=momentum, **options)
    q = random_state(robot, rng)
    motion, told = run(law, q, robot.frame_pose(q).translation + 0.2, 2.0, method="held" if nodes else "explicit")
    rates = np.abs(motion.protected_rate.values).max(axis=1)
    lost = rates > 1e-12 * (1.0 + np.abs(motion.base_angular_velocity.values).max())
    assert ("protection_lost" in motion.attrs) == bool(lost.any())
    if lost.any():
        found = json.loads(motion.attrs["protection_lost"])
        assert found["largest_rate"] == pytest.approx(rates.max(), rel=1e-12)
        assert sum(end - start for start, end in found["spans"]) == pytest.approx(0.1 * lost[:-1].sum())
        assert found["why"]
        assert "momentum on board" in told[0]


def test_the_command_itself_says_it(ets_vii):
    q = ets_vii.configuration(START)
    heavy = ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw"), momentum=[0, 0, 0, 0, 0, 500.0])(q, TARGET)
    assert heavy.protection_lost == abs(heavy.protected_rate[0]) > 0
    assert heavy.protection_lost_to == ("the joint rates that it takes exceed the rate limits",)
    law = ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw"))
    for asked, kept in ((1e-5, True), (1.0, False)):
        command = law(q, TARGET, protected_rate=[asked])
        assert (command.protection_lost == 0.0) == kept == (not command.protection_lost_to)
    few = random_robot(5, joints=2)
    command = ssm.SelectiveLaw(few, ssm.Protection("all"))(few.configuration(), [1, 0, 0], protected_rate=[1e-4] * 3)
    assert command.protection_lost_to == ("no joint rates give it: J_sub has lost rank",)


def test_limits_that_take_the_protection_are_told(ets_vii):
    q = ets_vii.configuration(START)
    options = {"sample_time": 0.1, "momentum": [0, 0, 0, 0, 0, 20.0], "acceleration_limit": np.deg2rad(0.05)}
    law = ssm.SelectiveLaw(
        ets_vii, ssm.Protection("yaw"), limits=ssm.Limits(), joint_weights=[1, 2, 1, 1, 3, 1], **options
    )
    motion, told = run(law, q, TARGET, 5.0, method="held")
    found = json.loads(motion.attrs["protection_lost"])
    assert found["why"] == ["the joint rates that it takes exceed position, rate or acceleration limits"]
    assert found["largest_rate"] == pytest.approx(float(np.abs(motion.protected_rate).max()))
    assert "acceleration limits" in told[0]


def test_a_schedule_tells_of_what_is_on(ets_vii):
    q, schedule = ets_vii.configuration(START), ssm.Schedule([(0.0, "none"), (1.0, "yaw")], hand_over=1.0)
    motion, told = run(ssm.ScheduledLaw(ets_vii, schedule), q, TARGET, 4.0)
    assert not told
    assert not set(TOLD) & set(motion.attrs)
    assert np.abs(motion.protected_rate).max() > 1e-6  # before it is on
    motion, told = run(ssm.ScheduledLaw(ets_vii, schedule, momentum=[0, 0, 0, 0, 0, 500.0]), q, TARGET, 4.0)
    assert json.loads(motion.attrs["protection_lost"])["spans"] == [[2.0, 4.0]]


def test_a_plan_that_does_not_settle_is_told(ets_vii, monkeypatch):
    monkeypatch.setattr(law_module, "PASSES", 1)
    law = ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw"), sample_time=0.5, hold_nodes=2)
    motion, told = run(law, ets_vii.configuration(START), TARGET, 5.0, 0.5, "held")
    found = json.loads(motion.attrs["plan_unsettled"])
    assert found["largest_change"] == float(motion.plan_change.max())
    assert "does not settle" in told[0]


@given(seed=st.integers(0, 200))
def test_smooth_rates_reverse_nowhere_and_chatter_everywhere(seed):
    """Sines of six samples and more, noise of rounding; then what alternates, about any mean, five decades apart."""
    rng = np.random.default_rng(seed)
    time, scale = np.arange(300.0)[:, None], 10.0 ** rng.uniform(-2, 3, 5)
    periods, phases = rng.uniform(6, 200, (3, 5)), rng.uniform(0, 6, (3, 5))
    smooth = scale * sum(np.sin(2 * np.pi * time / p + a) for p, a in zip(periods, phases, strict=True))
    smooth *= np.exp(-0.2 * time * rng.integers(0, 2))  # arrives: what is left is rounding
    smooth += 1e-16 * smooth.max() * rng.normal(size=smooth.shape)
    assert reversals(smooth).sum() == 0
    chatter = smooth.copy()
    chatter[100:200, 2] += 5.0 * scale[2] * np.where(np.arange(100) % 2, 1.0, -1.0)
    counts = reversals(chatter).sum(axis=0)
    assert counts[2] >= 90
    assert counts.sum() == counts[2]


def test_a_rate_vector_that_reverses_is_told_and_damping_settles_it(ets_vii):
    q, counts = ets_vii.configuration(START), []
    engine, protection = ssm.batch.Batch(ets_vii, threads=1), ssm.Protection("all")
    for damping in (1e-4, 1e-3):
        law = ssm.SelectiveLaw(ets_vii, protection, rate_limit=np.deg2rad(5), damping=damping)
        motion, told = run(law, q, TARGET, 120.0)
        counts.append(int(reversals(motion.joint_rates.values).sum(axis=0).max()))
        assert bool(told) == ("rate_reversals" in motion.attrs) == (counts[-1] >= REVERSALS)
        # The batch counts the same motion, up to what chatter makes of rounding.
        found = engine.motions(law, q, TARGET, 120.0, 0.1).rate_reversals[0]
        assert found == pytest.approx(counts[-1], abs=0.2 * counts[-1])
    assert counts[0] > 100
    assert counts[1] == 0


def test_reversals_of_each_row_of_a_batch(ets_vii, rng):
    """Counted as it goes is counted afterwards."""
    law = ssm.SelectiveLaw(ets_vii, ssm.Protection("all"), rate_limit=np.deg2rad(5))
    starts = np.array([ets_vii.configuration(START + rng.uniform(-0.2, 0.2, 6)) for _ in range(4)])
    motions = ssm.batch.Batch(ets_vii).motions(law, starts, TARGET, 60.0, 0.2)
    for q, count in zip(starts, motions.rate_reversals, strict=True):
        motion, _ = run(law, q, TARGET, 60.0, 0.2)
        expected = reversals(motion.joint_rates.values).sum(axis=0).max()
        assert count == pytest.approx(expected, abs=max(2.0, 0.3 * expected))


def test_acceleration_limits_that_give_way_to_the_protection_are_told():
    """Case 2 at 0.1 deg/s2: the command as a whole exceeds it, joint by joint it is kept."""
    case, limit = ssm.load_case("case2"), np.deg2rad(0.1)
    for limits in (None, ssm.Limits()):
        options = {"sample_time": 0.1, "acceleration_limit": limit, "limits": limits}
        law = ssm.SelectiveLaw(case.robot, case.protection, gain=0.05, rate_limit=np.deg2rad(5.0), **options)
        motion, told = run(law, case.start(), case.target, 150.0, method="held")
        taken = np.abs(np.diff(motion.joint_rates.values, axis=0, prepend=0.0)) / 0.1
        beyond = taken > limit * (1 + 1e-6)
        assert ("acceleration_exceeded" in motion.attrs) == beyond.any() == (limits is None)
        if limits is None:
            found = json.loads(motion.attrs["acceleration_exceeded"])
            assert set(found["joints"]) == {
                name for name, any_ in zip(law.robot.joint_names, beyond.any(0), strict=True) if any_
            }
            for name, joint in found["joints"].items():
                assert joint["largest"] == pytest.approx(taken[:, law.robot.joint_index(name)].max(), rel=1e-12)
                assert joint["limit"] == limit
            assert sum(end - start for start, end in found["spans"]) == pytest.approx(0.1 * beyond.any(1)[:-1].sum())
            assert "acceleration limits are exceeded" in " ".join(told)


def wheeled(robot):
    axes = zip("xyz", np.eye(3), strict=True)
    return robot.with_wheels([ssm.Wheel(f"wheel_{n}", axis, 0.1, max_speed=600.0, max_torque=0.2) for n, axis in axes])


def test_wheels_that_have_not_the_torque_are_told_and_a_limit_mends_it(ets_vii):
    robot = wheeled(ets_vii)
    q = robot.configuration({f"joint_{i + 1}": angle for i, angle in enumerate(START)})
    at = [robot.joint_index(name) for name in robot.wheel_names]
    np.testing.assert_allclose(robot.acceleration_limits[at], 2.0)
    assert np.all(np.isinf(np.delete(robot.acceleration_limits, at)))
    law = ssm.SelectiveLaw(robot, ssm.Protection("all"), gain=0.05)
    motion, told = run(law, q, TARGET, 20.0)
    found = json.loads(motion.attrs["wheel_torque_exceeded"])
    for name, place in zip(robot.wheel_names, at, strict=True):  # all axes are protected: the base does not turn
        changes = np.diff(motion.joint_rates.values[:, place], prepend=0.0) / 0.1
        assert found[name]["needed"] == pytest.approx(0.1 * np.abs(changes).max(), rel=1e-9)
        assert found[name]["limit"] == 0.2
        assert found[name]["spans"][0][0] == 0.0
    assert "45.6 of 0.2 N m" in told[0]
    options = {"sample_time": 0.1, "acceleration_limit": robot.acceleration_limits}
    motion, told = run(ssm.SelectiveLaw(robot, ssm.Protection("all"), gain=0.05, **options), q, TARGET, 150.0)
    assert not told
    assert motion.attrs["outcome"] == "converged"
    assert np.abs(np.diff(motion.joint_rates.values[:, at], axis=0, prepend=0.0)).max() <= 0.2
    assert np.abs(motion.protected_rate).max() < 1e-17


def test_shipped_cases_have_nothing_to_tell_but_one():
    for name in ssm.cases():
        case = ssm.load_case(name)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ssm.DecoupleWarning)
            motion = case.run()
        told = set(TOLD) & set(motion.attrs)
        assert told == ({"rate_reversals"} if name == "case2_flight" else set()), name


def test_the_command_line_says_it(call, tmp_path):
    done = call("compare", "case1", "--no-figures", "-o", tmp_path)
    lines = [line for line in (done.stdout + done.stderr).splitlines() if "reverse" in line]
    assert len(lines) == 1
    assert lines[0].startswith("case1, reactionless: the commanded rates reverse")
    done = call("run", "case1", "--protect", "all", "--no-figures", "-o", tmp_path / "run")
    assert "warning: the commanded rates reverse" in done.stderr.replace("\n", " ")
