"""What the protected rotation of a dynamic motion is made of, and how it is integrated, by independent routes."""

from __future__ import annotations

import warnings

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import trapezoid
from scipy.spatial.transform import Rotation

import ssm_decouple as ssm
from ssm_decouple.model.perturb import Tolerances, perturbed
from ssm_decouple.simulation import physics
from ssm_decouple.simulation.dynamic import Dynamic, DynamicMotion, Load, Servo

START = np.deg2rad([150, -20, -10, 0, 0, 0])
TARGET = [-1.8, -0.3, 1.2]
FINE = 2e-3


def law_of(robot: ssm.Robot, frame: str = "base", **changes) -> ssm.SelectiveLaw:
    return ssm.SelectiveLaw(robot, ssm.Protection("yaw", frame), gain=0.05, rate_limit=np.deg2rad(5), **changes)


def axes_in_base(robot: ssm.Robot, frame: str, q: np.ndarray) -> np.ndarray:
    """Return the protected axis, the third of the frame, in base axes."""
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    base = Rotation.from_quat(q[3:7]).as_matrix()
    if frame == "base":
        return np.array([0.0, 0.0, 1.0])
    if frame == "inertial":
        return base.T[:, 2]
    return base.T @ data.oMf[robot.frame_id(frame)].rotation[:, 2]


def dense(motion: DynamicMotion, robot: ssm.Robot, frame: str, commands: np.ndarray, dt: float):
    """Move through held commands in holds of FINE; return times, axis times true rate, and that of the model.

    The servo makes a new torque in each physics step, so that shorter holds change nothing.
    """
    times, truth, model = [0.0], [0.0], [0.0]
    for i, rates in enumerate(commands):
        for j in range(round(dt / FINE)):
            q, _ = motion.move(rates, i * dt + j * FINE, i * dt + (j + 1) * FINE)
            axis = axes_in_base(robot, frame, q)
            times.append(i * dt + (j + 1) * FINE)
            truth.append(axis @ motion.v[3:6])
            model.append(axis @ (robot.coupling(q).J_rc @ motion.v[6 + motion.driven]))
    return np.array(times), np.array(truth), np.array(model)


@pytest.mark.parametrize("frame", ["base", "inertial", "link_3", "end_effector"])
def test_truth_and_model_are_integrals_along_the_motion(ets_vii, frame):
    """Against sums over 2 ms, in which torques are constant and rates straight; prescribed, steps tell the same."""
    dt, law = 0.1, law_of(ets_vii, frame)
    plant = perturbed(ets_vii, Tolerances(0.05, 0.05, 0.005, 0.005), 4)
    q = ets_vii.configuration(START, pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.5, 1.0), np.zeros(3)))
    recorded = ssm.simulate(law, q, [-1.5, 0.2, 1.4], 6.0, dt, Dynamic(step=FINE, plant=plant))
    commands = recorded.joint_rates.values[:-1]
    times, truth, model = dense(DynamicMotion(Dynamic(step=FINE, plant=plant), law, q), ets_vii, frame, commands, dt)
    told = recorded.protected_angle.values[-1, 0], recorded.protected_angle_parts.values[-1, :, 0]
    size = np.abs(recorded.protected_angle.values).max()
    assert size > 1e-7
    assert told[0] == pytest.approx(trapezoid(truth, times), abs=1e-6 * size)
    assert told[1][0] + told[1][1] == pytest.approx(trapezoid(model, times), abs=1e-5 * size)
    coarse = DynamicMotion(Dynamic(step=0.02, servo=None, plant=plant), law, q)
    finer = DynamicMotion(Dynamic(step=0.0005, servo=None, plant=plant), law, q)
    for motion in (coarse, finer):
        for i, rates in enumerate(commands):
            motion.move(rates, dt * i, dt * (i + 1))
    np.testing.assert_allclose(coarse.parts, finer.parts, atol=1e-9 * np.abs(finer.parts).max())


@pytest.mark.parametrize("nodes", [0, 3])
@pytest.mark.parametrize("frame", ["base", "inertial", "link_3"])
def test_the_plan_is_what_a_perfect_servo_on_the_model_would_do(ets_vii, frame, nodes):
    """Where the joints follow at once and the plant is the model, the plan is the truth."""
    law = law_of(ets_vii, frame, sample_time=0.5, hold_nodes=nodes)
    physics_of = {"step": 0.01, "servo": None}
    motion = ssm.simulate(law, ets_vii.configuration(START), TARGET, 20.0, 0.5, Dynamic(**physics_of))
    plan, servo, model = motion.protected_angle_parts.transpose("cause", "time", "protected").values
    size = max(np.abs(motion.protected_angle.values).max(), 1e-9)
    np.testing.assert_allclose(plan, motion.protected_angle.values, atol=1e-6 * size + 1e-13)
    assert np.abs(servo).max() < 1e-6 * size + 1e-13
    assert not model.any()


@pytest.mark.parametrize("frame", ["base", "inertial", "link_3"])
@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"servo": Servo(torque_limits=0.3)},
        {"servo": Servo(frequency=0.5)},
        {"servo": None},
        {"load": Load(torque=(0.01, 0.02, -0.01))},
        {"feedback_gain": 1.0},
        {"plant": 3},
    ],
    ids=["plain", "limits", "soft", "prescribed", "load", "feedback", "plant"],
)
def test_the_parts_add_up_and_name_the_cause(ets_vii, frame, settings):
    given = dict(settings)
    if "plant" in given:
        given["plant"] = perturbed(ets_vii, Tolerances(0.05, 0.05, 0.005, 0.005), given["plant"])
    law = law_of(ets_vii, frame, sample_time=0.1, hold_nodes=3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ssm.DecoupleWarning)  # of the limits, which have their own tests
        motion = ssm.simulate(law, ets_vii.configuration(START), TARGET, 8.0, 0.1, Dynamic(step=0.005, **given))
    parts = motion.protected_angle_parts
    assert parts.dims == ("time", "cause", "protected")
    assert list(parts.cause.values) == ["plan", "servo", "model"]
    angle = motion.protected_angle.values
    np.testing.assert_allclose(parts.sum("cause").values, angle, atol=1e-14 * max(np.abs(parts.values).max(), 1e-9))
    largest = dict(zip(parts.cause.values.tolist(), np.abs(parts.values).max((0, 2)), strict=True))
    if "load" in given or "plant" in given:
        assert max(largest, key=largest.get) == "model"
    else:
        assert largest["model"] == 0.0
    if "servo" in given and given["servo"] is not None:
        assert max(largest, key=largest.get) == "servo"
    if "servo" in given and given["servo"] is None:
        assert largest["servo"] < 1e-12


def test_a_plant_of_the_same_numbers_is_no_other(ets_vii):
    motion = ssm.simulate(
        law_of(ets_vii), ets_vii.configuration(START), TARGET, 2.0, 0.1, Dynamic(plant=ssm.load_robot("ets_vii"))
    )
    assert not motion.protected_angle_parts.sel(cause="model").values.any()


def test_momentum_on_board_is_known_to_the_model(ets_vii):
    law = law_of(ets_vii, momentum=[0, 0, 0, 0.5, -0.3, 0.2])
    pose = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.5, 1.0), np.zeros(3))
    plant = ssm.load_robot("ets_vii_flexible")
    q = ets_vii.configuration(START, pose)
    rigid = ssm.simulate(law, q, TARGET, 5.0, 0.1, Dynamic(step=0.002))
    bending = ssm.simulate(law, q, TARGET, 5.0, 0.1, Dynamic(step=0.002, plant=plant))
    assert not rigid.protected_angle_parts.sel(cause="model").values.any()
    # What the model makes of nearly the same motion is nearly the same; without the momentum it would be far off.
    known = [motion.protected_angle_parts.values[-1, :2, 0].sum() for motion in (rigid, bending)]
    assert abs(known[1] - known[0]) < 0.02 * np.abs(rigid.protected_angle_parts.values).max() + 1e-7


@pytest.mark.parametrize("nodes", [0, 2])
@pytest.mark.parametrize("frame", ["link_2", "link_3", "end_effector", "inertial"])
def test_feedback_does_no_harm_about_any_axes(ets_vii, frame, nodes):
    drift = []
    for gain in (0.0, 1.0):
        law = law_of(ets_vii, frame, sample_time=0.1, hold_nodes=nodes)
        method = Dynamic(step=0.01, feedback_gain=gain)
        motion = ssm.simulate(law, ets_vii.configuration(START), TARGET, 40.0, 0.1, method, smooth_start=5.0)
        drift.append(float(np.abs(motion.protected_angle.values).max()))
    assert drift[1] <= 1.05 * drift[0]


@pytest.mark.parametrize("frame", ["base", "inertial", "link_3"])
def test_what_perfect_gyros_tell_is_the_truth(ets_vii, frame):
    law, q = law_of(ets_vii, frame), ets_vii.configuration(START)
    motion = DynamicMotion(Dynamic(step=0.005), law, q)
    for i in range(20):
        motion.move(np.deg2rad([3.0, -2.0, 1.0, 2.0, -1.0, 3.0]), 0.5 * i, 0.5 * (i + 1))
    assert np.abs(motion.measured).max() > 1e-3
    np.testing.assert_allclose(motion.measured, motion.parts[physics.TRUTH], rtol=1e-12)
