"""The batch engine's commands and motions against the law and `simulate`, one at a time."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from random_robots import random_robot, random_state

import ssm_decouple as ssm
from ssm_decouple.batch import Batch


@pytest.mark.parametrize("protection", ["none", "yaw", "roll+pitch", "all"])
def test_steps_are_the_law_s(robot, rng, protection):
    law = ssm.SelectiveLaw(robot, ssm.Protection(protection), gain=0.1, rate_limit=0.05)
    starts = np.array([random_state(robot, rng) for _ in range(6)])
    targets = rng.uniform(-3, 3, (6, 3))
    found = Batch(robot).step(law, starts, targets)
    for i, q in enumerate(starts):
        command = law(q, targets[i])
        if command.smallest_singular_value < 1e-3:  # there rounding is amplified
            continue
        for name in ("joint_rates", "base_twist", "end_effector_position", "end_effector_error", "protected_rate"):
            assert getattr(found, name)[i] == pytest.approx(getattr(command, name), abs=1e-12), name
        for name in ("smallest_singular_value", "damping", "rate_scale"):
            assert getattr(found, name)[i] == pytest.approx(getattr(command, name), rel=1e-9, abs=1e-13), name
        data = robot.model.createData()
        momentum = pin.computeCentroidalMomentum(robot.model, data, q, found.velocity[i]).vector
        assert np.abs(momentum).max() < 1e-11


def test_steps_protect_to_rounding(ets_vii, rng):
    law = ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw"))
    joints = rng.uniform(-3, 3, (200, 6))
    found = Batch(ets_vii).step(law, joints, [1.0, 0.0, 2.0])
    assert np.abs(found.joint_rates).max() > 0.01
    for row, rates in zip(joints, found.joint_rates, strict=True):
        assert abs(ets_vii.coupling(ets_vii.configuration(row)).J_rc[2] @ rates) < 1e-16


@pytest.mark.parametrize("joints", [[150, -20, -10, 0, 0, 0], [0, 90, 90, 0, 0, 0]])  # the second is damped
def test_steps_know_the_task_s_weight(ets_vii, joints):
    law = ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw"), rate_limit=np.inf, tasks=[ssm.PositionTask(weight=4.0)])
    q = ets_vii.configuration(np.deg2rad(joints))
    command, found = law(q, [-1.8, -0.3, 1.2]), Batch(ets_vii).step(law, q, [-1.8, -0.3, 1.2])
    assert found.joint_rates[0] == pytest.approx(command.joint_rates, rel=1e-9, abs=1e-15)
    assert found.smallest_singular_value[0] == pytest.approx(command.smallest_singular_value, rel=1e-9)


def test_steps_know_the_law_s_weights_and_wheels(ets_vii, rng):
    wheels = [ssm.Wheel(f"w{i}", np.eye(3)[i], 0.05, 300.0, 1.0) for i in range(3)]
    robot = ets_vii.with_wheels(wheels)
    law = ssm.SelectiveLaw(robot, ssm.Protection("all"))
    joints = rng.uniform(-1, 1, (4, robot.n_joints))
    found = Batch(robot).step(law, joints, [1.5, 0.0, 2.0])
    for i, row in enumerate(joints):
        command = law(robot.configuration(row), [1.5, 0.0, 2.0])
        assert found.joint_rates[i] == pytest.approx(command.joint_rates, rel=1e-10, abs=1e-12)
        assert found.smallest_singular_value[i] == pytest.approx(command.smallest_singular_value, rel=1e-10)


def agree(found, i, motion):
    assert found.outcome[i] == motion.outcome
    assert found.outcome_time[i] == pytest.approx(motion.outcome_time, abs=1e-9)
    assert found.final_error[i] == pytest.approx(motion.final_error, abs=1e-12)
    speed = np.linalg.norm(motion.joint_rates.values, axis=1)
    travel = np.sum(speed[:-1] * np.diff(motion.time.values))
    assert found.joint_travel[i] == pytest.approx(travel, abs=1e-12)
    assert found.peak_rate[i] == pytest.approx(np.abs(motion.joint_rates.values).max(), abs=1e-12)
    assert found.protected_rate[i] == pytest.approx(np.abs(motion.protected_rate.values).max(initial=0), abs=1e-16)
    assert found.base_rotation[i] == pytest.approx(np.ptp(motion.base_rpy.values, axis=0), abs=1e-12)
    assert found.smallest_singular_value[i] == pytest.approx(motion.smallest_singular_value.values.min(), abs=1e-12)
    assert found.configuration[i] == pytest.approx(motion.configuration.values[-1], abs=1e-12)


def within_reach(robot, q, target):
    shoulder = robot.shoulder_position(q)
    way = target - shoulder
    return shoulder + way * min(1.0, 0.9 * robot.reach / np.linalg.norm(way))


@pytest.mark.parametrize("seed", range(6))
def test_motions_are_those_of_simulate(seed, rng):
    robot = random_robot(40 + seed, joints=5 + seed % 4, branching=0.2)
    law = ssm.SelectiveLaw(robot, ssm.Protection("yaw"), gain=0.3, rate_limit=0.3)
    starts = np.array([random_state(robot, rng) for _ in range(2)])
    targets = [robot.frame_pose(q).translation + rng.uniform(-0.2, 0.2, 3) for q in starts]
    targets = [within_reach(robot, q, target) for q, target in zip(starts, targets, strict=True)]
    found = Batch(robot).motions(law, starts, targets, 2.05, 0.1)  # the last step is shorter
    for i in range(2):
        motion = ssm.simulate(law, starts[i], targets[i], 2.05, 0.1)
        if motion.smallest_singular_value.values.min() > 0.02:
            agree(found, i, motion)


@pytest.mark.parametrize(
    ("name", "duration", "outcome"), [("yaw", 110.0, "converged"), ("all", 80.0, "stalled"), ("yaw", 15.0, "running")]
)
def test_outcomes_of_a_case(ets_vii, name, duration, outcome):
    q = ets_vii.configuration(np.deg2rad([150, -20, -10, 0, 0, 0]))
    law = ssm.SelectiveLaw(ets_vii, ssm.Protection(name), rate_limit=np.deg2rad(5.0))
    found = Batch(ets_vii).motions(law, q, [-1.8, -0.3, 1.2], duration, 0.5)
    motion = ssm.simulate(law, q, [-1.8, -0.3, 1.2], duration, 0.5)
    assert found.outcome[0] == motion.outcome == outcome
    if outcome != "stalled":  # at a singularity rounding is amplified
        agree(found, 0, motion)


def test_a_large_step_moves_the_base_exactly():
    """One step of a light base, turned by a radian: the pose is Pinocchio's integral."""
    robot = random_robot(5, joints=6)
    law = ssm.SelectiveLaw(robot, ssm.Protection("none"), gain=5.0, rate_limit=np.inf, damping=0.1)
    q = robot.configuration(np.linspace(-1, 1, 6))
    target = robot.frame_pose(q).translation + [3.0, -2.0, 1.0]
    command = law(q, target)
    for dt in (0.05, 2.0, 9.0):
        wanted = pin.integrate(robot.model, q, dt * command.velocity)
        found = Batch(robot).motions(law, q, target, dt, dt)
        assert np.abs(found.configuration[0] - wanted).max() < 1e-12


def test_threads_and_neighbours_change_nothing(ets_vii, rng, monkeypatch):
    monkeypatch.setattr("ssm_decouple.batch.engine.MOTIONS", 5)
    law = ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw"))
    starts = ets_vii.configuration(np.deg2rad([150, -20, -10, 0, 0, 0]))
    targets, told = np.array([-1.8, -0.3, 1.2]) + rng.uniform(-0.3, 0.3, (23, 3)), []
    found = Batch(ets_vii, threads=3).motions(law, starts, targets, 2.0, 0.1, progress=told.append)
    assert told == sorted(told)
    assert told[-1] == 1.0
    for i in (0, 7, 22):
        alone = Batch(ets_vii).motions(law, starts, targets[i], 2.0, 0.1)
        assert np.array_equal(alone.configuration[0], found.configuration[i])
        assert alone.joint_travel[0] == found.joint_travel[i]


def test_a_row_that_is_not_finite_disturbs_no_other(ets_vii):
    law = ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw"))
    starts, targets = np.full((3, 6), 0.4), np.full((3, 3), 1.5)
    clean = Batch(ets_vii).motions(law, starts, targets, 1.0, 0.1)
    starts[0, 2], targets[2, 1] = np.nan, np.inf
    found = Batch(ets_vii).motions(law, starts, targets, 1.0, 0.1)
    assert list(found.outcome) == ["undefined", clean.outcome[1], "undefined"]
    for name in ("final_error", "joint_travel", "base_rotation", "smallest_singular_value", "outcome_time"):
        assert np.isnan(getattr(found, name)[[0, 2]]).all(), name
        assert np.array_equal(getattr(found, name)[1], getattr(clean, name)[1])
    assert np.isnan(Batch(ets_vii).step(law, starts, targets).joint_rates).any(axis=1).tolist() == [True, False, True]


def test_no_rows_give_empty_results(ets_vii):
    law = ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw"))
    found = Batch(ets_vii).motions(law, np.empty((0, 6)), np.empty((0, 3)), 1.0, 0.1)
    assert found.configuration.shape == (0, 13)
    assert Batch(ets_vii).step(law, np.empty((0, 6)), [0, 0, 0]).joint_rates.shape == (0, 6)


def test_what_makes_no_sense_is_refused(ets_vii):
    engine, yaw = Batch(ets_vii), ssm.Protection("yaw")
    law = ssm.SelectiveLaw(ets_vii, yaw)
    joints, target = np.zeros((2, 6)), [1.0, 0.0, 2.0]
    refused = {
        "hold_nodes": ssm.SelectiveLaw(ets_vii, yaw, sample_time=0.1, hold_nodes=1),
        "an acceleration_limit": ssm.SelectiveLaw(ets_vii, yaw, sample_time=0.1, acceleration_limit=1.0),
        "limits": ssm.SelectiveLaw(ets_vii, yaw, sample_time=0.1, limits=ssm.Limits()),
        "momentum on board": ssm.SelectiveLaw(ets_vii, yaw, momentum=[0, 0, 0, 0, 0, 1.0]),
        "directions fixed in 'inertial'": ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw", "inertial")),
        "other tasks": ssm.SelectiveLaw(ets_vii, yaw, tasks=ssm.PoseTask()),
    }
    for what, other in refused.items():
        with pytest.raises(ssm.InputError, match=f"the law has {what}"):
            engine.step(other, joints, target)
    with pytest.raises(ssm.InputError, match="make both of one robot"):
        Batch(ets_vii, ets_vii.link_names[2]).step(law, joints, target)
    with pytest.raises(ssm.InputError, match="give a SelectiveLaw"):
        engine.step("yaw", joints, target)
    with pytest.raises(ssm.InputError, match=r"shape \(2, 5\)"):
        engine.step(law, np.zeros((2, 5)), target)
    with pytest.raises(ssm.InputError, match=r"targets have shape \(3, 3\)"):
        engine.step(law, joints, np.zeros((3, 3)))
    with pytest.raises(ssm.InputError, match="row 1 of configurations has a quaternion"):
        engine.step(law, [ets_vii.configuration(), np.zeros(13)], target)
    with pytest.raises(ssm.InputError, match="dt is 2 s, longer"):
        engine.motions(law, joints, target, 1.0, 2.0)
    with pytest.raises(ssm.InputError, match="duration is -1"):
        engine.motions(law, joints, target, -1.0, 2.0)
