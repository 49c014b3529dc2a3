"""Drives at their torque limits: the arm arrives, the protection stands first, steps do not decide, and it is told."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from random_robots import random_robot, random_state

import ssm_decouple as ssm
from ssm_decouple.model.perturb import Tolerances, perturbed
from ssm_decouple.simulation import physics
from ssm_decouple.simulation.dynamic import Dynamic, Servo, tree_of

START = np.deg2rad([150, -20, -10, 0, 0, 0])
TARGET = [-1.8, -0.3, 1.2]
told = pytest.mark.filterwarnings("ignore:drives at their torque limits")


def run(robot: ssm.Robot, duration: float = 150.0, axes: str = "yaw", frame: str = "base", **changes):
    """Simulate case 1; `changes` are those of `Dynamic`."""
    law = ssm.SelectiveLaw(robot, ssm.Protection(axes, frame), gain=0.05, rate_limit=np.deg2rad(5), sample_time=0.1)
    q = robot.configuration(START)
    return ssm.simulate(law, q, TARGET, duration, 0.1, Dynamic(**changes), smooth_start=10.0)


def with_wheels(robot: ssm.Robot, torque: float) -> tuple[ssm.Robot, np.ndarray]:
    wheels = [
        ssm.Wheel(f"wheel_{name}", axis, spin_inertia=0.1, max_speed=600.0, max_torque=torque)
        for name, axis in zip("xyz", np.eye(3), strict=True)
    ]
    both = robot.with_wheels(wheels)
    return both, both.configuration(dict(zip(robot.joint_names, START, strict=True)))


@told
@pytest.mark.parametrize("limit", [2.0, 0.5, 0.2, 0.1])
def test_the_arm_arrives_and_the_physics_step_does_not_decide(ets_vii, limit):
    """Torques are held for a step, so that all converges with its first power; before, 5 ms stalled."""
    motions = {step: run(ets_vii, step=step, servo=Servo(torque_limits=limit)) for step in (0.002, 0.004, 0.008)}
    for motion in motions.values():
        assert motion.attrs["outcome"] == "converged"
        assert motion.attrs["final_error"] < 2e-3
        assert motion.attrs["momentum_drift"] < 1e-12
        assert motion.attrs["energy_error"] < 1e-11
        assert max(json.loads(motion.attrs["largest_torques"])) <= limit
    joints = [motion.joint_positions.values for motion in motions.values()]
    off = [np.abs(after - before).max() for before, after in itertools.pairwise(joints)]
    assert off[1] < 0.01
    assert 1.3 < off[1] / off[0] < 2.5  # 2 at first order
    at_limit = [float(motion.saturated_time[-1]) for motion in motions.values()]
    assert at_limit[2] == pytest.approx(at_limit[0], rel=0.15)


@told
@pytest.mark.parametrize("torque", [0.2, 0.1])
def test_wheels_at_their_limits_lock_nothing(ets_vii, torque):
    both, q = with_wheels(ets_vii, torque)
    law = ssm.SelectiveLaw(both, ssm.Protection("all"), gain=0.05, sample_time=0.1)
    motion = ssm.simulate(law, q, TARGET, 150.0, 0.1, Dynamic(step=0.005), smooth_start=10.0)
    assert motion.attrs["outcome"] == "converged"
    # The base turns by 0.2 deg without protection.
    assert np.rad2deg(np.abs(motion.protected_angle.values).max()) < 0.02
    assert motion.attrs["momentum_drift"] < 1e-12
    assert motion.attrs["energy_error"] < 1e-11


@told
@pytest.mark.parametrize("limit", [0.5, 0.1])
@pytest.mark.parametrize("plant", [None, 4])
def test_a_servo_that_protects_does_so_at_its_limits(ets_vii, limit, plant):
    given_plant = None if plant is None else perturbed(ets_vii, Tolerances(0.05, 0.05, 0.005, 0.005), plant)
    servo = Servo(torque_limits=limit, protects=True)
    motion = run(ets_vii, 100.0, step=0.005, servo=servo, plant=given_plant)
    assert motion.attrs["final_error"] < 0.05
    assert float(motion.saturated_time[-1]) > 0.1
    assert np.rad2deg(np.abs(motion.protected_angle.values).max()) < 1e-6


@told
@pytest.mark.parametrize("servo", [{"period": 0.02}, {"frequency": 1.0}, {"damping_ratio": 0.7}])
def test_other_servos_do_not_lock_either(ets_vii, servo):
    motion = run(ets_vii, step=0.01, servo=Servo(torque_limits=0.3, **servo))
    assert motion.attrs["outcome"] == "converged"


@told
def test_one_weak_drive_holds_no_other_for_good(ets_vii):
    motion = run(ets_vii, step=0.005, servo=Servo(torque_limits=[50.0, 50.0, 0.1, 50.0, 50.0, 50.0]))
    assert motion.attrs["outcome"] == "converged"
    assert json.loads(motion.attrs["saturated_joints"]).keys() == {"joint_3"}


@told
@pytest.mark.parametrize("frame", ["inertial", "link_3"])
def test_limits_and_feedback_about_other_axes(ets_vii, frame):
    motion = run(ets_vii, 100.0, frame=frame, step=0.01, servo=Servo(torque_limits=0.3), feedback_gain=0.5)
    assert motion.attrs["final_error"] < 0.05
    assert np.rad2deg(np.abs(motion.protected_angle.values).max()) < 2e-3


@told
def test_wings_and_limits(ets_vii):
    motion = run(ssm.load_robot("ets_vii_flexible"), 100.0, step=0.01, servo=Servo(torque_limits=0.3))
    assert motion.attrs["final_error"] < 0.05
    assert motion.attrs["energy_error"] < 1e-9
    assert motion.attrs["momentum_drift"] < 1e-11


# What is told.


def test_saturation_that_costs_protection_warns(ets_vii):
    with pytest.warns(ssm.DecoupleWarning, match=r"drives at their torque limits have cost protection: .*joint_3 for"):
        motion = run(ets_vii, 60.0, step=0.005, servo=Servo(torque_limits=0.1))
    shares = json.loads(motion.attrs["saturated_joints"])
    assert {"joint_2", "joint_3"} <= shares.keys()
    assert all(0 < share <= 1 for share in shares.values())
    assert max(shares.values()) * 60.0 <= float(motion.saturated_time[-1]) + 1e-9
    assert sum(shares.values()) * 60.0 >= 0.98 * float(motion.saturated_time[-1])


def test_saturation_that_costs_next_to_nothing_does_not(ets_vii):
    motion = run(ets_vii, 20.0, step=0.005, servo=Servo(torque_limits=0.5, protects=True))
    assert json.loads(motion.attrs["saturated_joints"])
    free = run(ets_vii, 20.0, step=0.005)
    assert json.loads(free.attrs["saturated_joints"]) == {}
    assert float(free.saturated_time[-1]) == 0.0


def test_the_summary_names_the_drives(ets_vii):
    from ssm_decouple.simulation.dynamic import drives_at_limits

    motion = run(ets_vii, 20.0, step=0.005, servo=Servo(torque_limits=0.5, protects=True))
    assert "joint_2 for" in drives_at_limits(motion)
    assert "deg" in drives_at_limits(motion)
    assert drives_at_limits(run(ets_vii, 1.0, servo=None)) == ""


# The mechanism.


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(seed=st.integers(0, 10**6), k=st.integers(0, 3), share=st.floats(0.05, 0.95))
def test_limited_torques_keep_what_the_base_needs(seed, k, share):
    """By Pinocchio's forward dynamics: limits are kept, and along U the base accelerates as asked all the same."""
    robot, rng = random_robot(seed % 1000, 7, 0.3), np.random.default_rng(seed)
    n, model = robot.n_joints, robot.model.copy()
    model.gravity = pin.Motion.Zero()
    q, v = random_state(robot, rng), 0.05 * rng.normal(size=6 + robot.n_joints)
    U = np.linalg.qr(rng.normal(size=(6, 6)))[0][:, :k].copy()
    wanted, torque, room = rng.normal(size=n), np.empty(n), physics.scratch_of(n)
    own = (*tree_of(robot.model), robot.joint_positions(q), v)
    free = pin.aba(model, model.createData(), q, v, np.zeros(6 + n))
    asked = U.T @ free[:6]  # as the base accelerates by itself: no torque is needed for it
    plain = np.empty(n)
    physics.servo_torque(*own, wanted.copy(), U, asked, np.full(n, np.inf), room, plain)
    limits = share * np.abs(plain)
    assert physics.servo_torque(*own, wanted.copy(), U, asked, limits, room, torque)
    assert np.all(np.abs(torque) <= limits)
    assert np.any(np.abs(torque) >= limits * (1 - 1e-9))
    found = pin.aba(model, model.createData(), q, v, np.r_[np.zeros(6), torque])
    size = 1 + np.abs(found).max()
    if k:
        J_sub = U.T @ robot.coupling(q).J_base
        assert np.abs(U.T @ found[:6] - asked).max() < 1e-8 * size * np.linalg.cond(J_sub)
    np.testing.assert_allclose(torque, share * plain, atol=1e-7 * np.abs(plain).max() * size)
