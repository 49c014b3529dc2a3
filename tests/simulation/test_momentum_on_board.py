"""Motions with momentum on board: audits, orders, the equations of motion, free spins in closed form, loaded wheels."""

from __future__ import annotations

import json

import numpy as np
import pinocchio as pin
import pytest
from random_robots import random_robot, random_state
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import ssm_decouple as ssm
from ssm_decouple import PostureTask, Protection, SelectiveLaw
from ssm_decouple.simulation.steps import hold_piece

START = np.deg2rad([150, -20, -10, 0, 0, 0])
TARGET = [-1.8, -0.3, 1.2]
MOMENTUM = np.array([0.5, -0.3, 0.8, 1.0, -2.0, 1.5])


def attitude(q) -> np.ndarray:
    return Rotation.from_quat(np.asarray(q)[3:7]).as_matrix()


def the_truth(robot, q, rates, momentum, span) -> np.ndarray:
    """Return the configuration after joint rates have been held, base pose by SciPy from the momentum law."""
    data, start = robot.model.createData(), robot.joint_positions(q)

    def slope(time, y):
        pose = pin.SE3(y[:9].reshape(3, 3), y[9:])
        at = robot.configuration(start + time * rates, pin.SE3(Rotation.from_matrix(pose.rotation).as_matrix(), y[9:]))
        A_g = pin.computeCentroidalMap(robot.model, data, at)
        twist = np.linalg.solve(A_g[:, :6], momentum - A_g[:, 6:] @ rates)
        return np.r_[(pose.rotation @ pin.skew(twist[3:])).ravel(), pose.rotation @ twist[:3]]

    y = solve_ivp(slope, (0, span), np.r_[attitude(q).ravel(), q[:3]], "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    rotation = Rotation.from_matrix(y[:9].reshape(3, 3)).as_matrix()
    return robot.configuration(start + span * rates, pin.SE3(rotation, y[9:]))


def test_held_steps_with_momentum_are_of_fourth_order(ets_vii, rng):
    momentum = np.array([40.0, -20, 30, 200, -300, 400])
    law = SelectiveLaw(ets_vii, Protection("none"), momentum=momentum)
    q0, rates = random_state(ets_vii, rng), rng.uniform(-0.4, 0.4, 6)
    values, errors = np.r_[law.base_twist(q0, rates), rates], []
    truth = the_truth(ets_vii, q0, rates, momentum, 2.0)
    for steps in (4, 8, 16):
        q = q0
        for _ in range(steps):
            values[:6] = law.base_twist(q, rates)
            q, _ = hold_piece(law, q, values, 2.0 / steps)
        errors.append(np.linalg.norm(pin.difference(ets_vii.model, truth, q)))
    assert errors[0] < 1e-4
    np.testing.assert_allclose(np.log2(np.array(errors[:-1]) / errors[1:]), 4, atol=0.3)


@pytest.mark.parametrize("method", ["explicit", "held", "rk4", ssm.Dynamic(), ssm.Dynamic(servo=None)])
def test_the_audit_stays_where_it_is(ets_vii, method):
    law = SelectiveLaw(ets_vii, Protection("yaw"), momentum=MOMENTUM)
    motion = ssm.simulate(law, ets_vii.configuration(START), TARGET, 20.0, 0.1, method)
    np.testing.assert_allclose(motion.linear_momentum, np.tile(MOMENTUM[:3], (201, 1)), atol=1e-10)
    np.testing.assert_allclose(motion.angular_momentum, np.tile(MOMENTUM[3:], (201, 1)), atol=1e-10)
    centre = motion.centre_of_mass.values
    drifted = centre[0] + np.outer(motion.time, MOMENTUM[:3] / ets_vii.mass)
    np.testing.assert_allclose(centre, drifted, atol=1e-3 if method == "explicit" else 1e-7)
    if isinstance(method, str):
        assert np.abs(motion.protected_rate).max() < 1e-17
    else:
        assert motion.attrs["energy_error"] < 1e-9
        assert motion.attrs["momentum_drift"] < 1e-12
        # The joints are at rest at first: all that is on board is the base's, and locked joints' with it.
        first = motion.isel(time=0)
        H = ets_vii.coupling(first.configuration.values)
        locked = np.linalg.solve(H.H_ww, attitude(first.configuration.values).T @ MOMENTUM[3:])
        np.testing.assert_allclose(first.base_angular_velocity, locked, rtol=1e-9)


@pytest.mark.parametrize(
    ("nodes", "order"),
    [
        (0, 1),
        (1, 2),
        (2, 4),
    ],
)
def test_the_plan_for_a_hold_counts_the_momentum(ets_vii, nodes, order):
    drift = []
    for dt in (1.0, 0.5):
        law = SelectiveLaw(ets_vii, Protection("yaw"), sample_time=dt, hold_nodes=nodes, momentum=MOMENTUM)
        motion = ssm.simulate(law, ets_vii.configuration(START), TARGET, 30.0, dt, "held")
        drift.append(np.abs(motion.protected_angle.values).max())
        assert motion.plan_change.max() < 1e-12
    assert np.log2(drift[0] / drift[1]) == pytest.approx(order, abs=0.25)
    assert drift[1] < {0: 1e-4, 1: 1e-6, 2: 1e-8}[nodes]


def test_stiff_drives_make_the_motion_of_the_momentum_law(ets_vii):
    """Held commands by the equations of motion, ever closer to the kinematic ones as the servo gets stiffer."""
    drives = {"torque_limits": 1e6}  # the rates jump from rest at first
    law = SelectiveLaw(ets_vii, Protection("yaw"), momentum=MOMENTUM)
    q, off = ets_vii.configuration(START), []
    exact = ssm.simulate(law, q, TARGET, 8.0, 0.1, "held").configuration.values[-1]
    for frequency in (2.0, 4.0, 8.0):
        method = ssm.Dynamic(servo=ssm.Servo(frequency=frequency, **drives))
        driven = ssm.simulate(law, q, TARGET, 8.0, 0.1, method).configuration.values[-1]
        off.append(np.linalg.norm(pin.difference(ets_vii.model, exact, driven)))
    assert off[0] < 1e-4
    assert off[1] < 0.3 * off[0]
    assert off[2] < 0.3 * off[1]
    prescribed = ssm.simulate(law, q, TARGET, 8.0, 0.1, ssm.Dynamic(servo=None)).configuration.values[-1]
    # The rates jump at each command, and the base with them: nothing is lost but the integrators' errors.
    np.testing.assert_allclose(pin.difference(ets_vii.model, exact, prescribed), 0, atol=1e-11)


# Joints that stand still: a free rigid body.


def locked(robot, momentum) -> SelectiveLaw:
    return SelectiveLaw(robot, Protection("none"), tasks=PostureTask(), momentum=momentum)


def top() -> ssm.Robot:
    """A bus with a turret on its axis of symmetry."""
    links = [
        f'<link name="{name}"><inertial><origin xyz="0 0 {z}"/><mass value="{mass}"/>'
        f'<inertia ixx="{across}" iyy="{across}" izz="{along}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        for name, z, mass, across, along in (("bus", 0, 100, 30, 45), ("turret", 0.4, 20, 2, 3))
    ]
    joint = (
        '<joint name="turn" type="revolute"><parent link="bus"/><child link="turret"/><origin xyz="0 0 1"/>'
        '<axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="10" velocity="0.1"/></joint>'
    )
    return ssm.Robot(f'<robot name="top">{"".join(links)}{joint}</robot>', name="top", end_effector="turret")


@pytest.mark.parametrize("method", ["held", "rk4", ssm.Dynamic()])
def test_a_symmetric_body_precesses_as_the_closed_form_says(method):
    """R(t) = exp(t h / A) R(0) exp(t (1 / C - 1 / A) h_z e_z), with A and C across and along its axis."""
    robot, momentum = top(), np.array([0, 0, 0, 8.0, -5.0, 12.0])
    q = robot.configuration([0.4], pin.SE3(pin.rpy.rpyToMatrix(0.3, 0.5, -0.7), np.zeros(3)))
    H, R0 = robot.coupling(q).H_ww, attitude(q)
    A, C = H[0, 0], H[2, 2]
    motion = ssm.simulate(locked(robot, momentum), q, [0.4], 60.0, 0.1, method)
    np.testing.assert_allclose(motion.joint_rates, 0, atol=1e-12)
    along = (R0.T @ momentum[3:])[2] * (1 / C - 1 / A) * np.array([0, 0, 1.0])
    expected = [pin.exp3(t * momentum[3:] / A) @ R0 @ pin.exp3(t * along) for t in (0.0, 30.0, 60.0)]
    got = [attitude(motion.configuration.values[i]) for i in (0, 300, 600)]
    np.testing.assert_allclose(got, expected, atol=1e-7)
    turned = np.linalg.norm(momentum[3:]) / A * 60
    assert turned > 4 * np.pi


def test_a_spin_about_a_principal_axis_is_steady(ets_vii):
    q = ets_vii.configuration(START)
    H = ets_vii.coupling(q)
    values, axes = np.linalg.eigh(H.H_ww)
    spin = 0.02 * axes[:, 2]
    momentum = np.r_[np.zeros(3), H.base_rotation @ (values[2] * spin)]
    motion = ssm.simulate(locked(ets_vii, momentum), q, ets_vii.joint_positions(q), 100.0, 0.5, "rk4")
    np.testing.assert_allclose(motion.base_angular_velocity, np.tile(spin, (201, 1)), atol=1e-12)
    np.testing.assert_allclose(
        attitude(motion.configuration.values[-1]), attitude(q) @ pin.exp3(100.0 * spin), atol=1e-10
    )


# Wheels that store it.


def wheeled(robot: ssm.Robot, max_speed: float = 600.0, turned: float = 0.0) -> ssm.Robot:
    axes = pin.rpy.rpyToMatrix(turned, turned, turned)
    return robot.with_wheels(
        [
            ssm.Wheel(f"wheel_{name}", axis, spin_inertia=0.1, max_speed=max_speed, max_torque=1.0)
            for name, axis in zip("xyz", axes, strict=True)
        ]
    )


def start_of(robot: ssm.Robot, pose: pin.SE3 | None = None) -> np.ndarray:
    return robot.configuration({f"joint_{i + 1}": angle for i, angle in enumerate(START)}, pose)


@pytest.mark.filterwarnings("ignore:wheels need more torque")
@pytest.mark.parametrize("turned", [0.0, 0.4])
def test_wheels_store_what_is_on_board_and_the_base_stands_still(ets_vii, turned):
    robot, pose = wheeled(ets_vii, turned=turned), pin.SE3(pin.rpy.rpyToMatrix(0.5, -0.3, 0.8), np.zeros(3))
    momentum = np.array([0, 0, 0, 3.0, -6.0, 9.0])
    arm = tuple(name for name in robot.joint_names if name not in robot.wheel_names)
    law = SelectiveLaw(robot, Protection("all"), tasks=PostureTask(arm), momentum=momentum)
    motion = ssm.simulate(law, start_of(robot, pose), START, 10.0, 0.1)
    np.testing.assert_allclose(motion.base_angular_velocity, 0, atol=1e-17)
    np.testing.assert_allclose(motion.joint_rates.sel(joint=list(arm)), 0, atol=1e-14)
    axes = pin.rpy.rpyToMatrix(turned, turned, turned)
    stored = dict(zip(["wheel_x", "wheel_y", "wheel_z"], axes @ (pose.rotation.T @ momentum[3:]), strict=True))
    for name, value in stored.items():
        np.testing.assert_allclose(motion.wheel_momentum.sel(wheel=name), value, rtol=1e-9)
        np.testing.assert_allclose(motion.joint_rates.sel(joint=name), value / 0.1, rtol=1e-9)
    assert motion.attrs["saturated_wheels"] == "{}"
    assert motion.wheel_momentum.dims == ("time", "wheel")
    assert motion.wheel_momentum.attrs["units"] == "N m s"


@pytest.mark.filterwarnings("ignore:wheels need more torque")
def test_a_wheel_s_momentum_counts_the_base_s_turn(ets_vii):
    robot = wheeled(ets_vii)
    law = SelectiveLaw(robot, Protection("none"), momentum=[0, 0, 0, 0, 0, 40.0])
    motion = ssm.simulate(law, start_of(robot), TARGET, 5.0, 0.1)
    speeds = motion.joint_rates.sel(joint=["wheel_x", "wheel_y", "wheel_z"]).values
    turning = motion.base_angular_velocity.values
    assert np.abs(turning).max() > 1e-3
    np.testing.assert_allclose(
        motion.wheel_momentum.sel(wheel=["wheel_x", "wheel_y", "wheel_z"]), 0.1 * (speeds + turning), rtol=1e-12
    )


@pytest.mark.filterwarnings("ignore:wheels need more torque")
def test_saturated_wheels_are_told_from_when_to_when(ets_vii, tmp_path):
    """Case 1 under all protected asks 4.6 N m s of the x wheel: one of 2 N m s is at its limit for a while."""
    robot = wheeled(ets_vii, max_speed=20.0)
    # The joints' weights are those of faster wheels, so that these are asked for more than they have.
    weights = SelectiveLaw(wheeled(ets_vii), Protection("all")).joint_weights
    law = SelectiveLaw(robot, Protection("all"), joint_weights=weights)
    motion = ssm.simulate(law, start_of(robot), TARGET, 60.0, 0.1)
    spans = json.loads(motion.attrs["saturated_wheels"])
    assert "wheel_x" in spans
    time, speeds = motion.time.values, np.abs(motion.joint_rates.sel(joint="wheel_x").values)
    assert speeds.max() <= 20.0
    inside = np.zeros(time.size, dtype=bool)
    for begin, end in spans["wheel_x"]:
        assert 0.0 <= begin < end <= 60.0
        inside |= (time >= begin) & (time < end)
    np.testing.assert_array_equal(speeds[inside] >= 20.0 * (1 - 1e-9), True)
    np.testing.assert_array_equal(speeds[~inside][:-1] < 20.0 * (1 - 1e-9), True)
    assert inside.any()
    assert not inside.all()
    assert np.all(motion.rate_scale.values[inside] < 1)
    assert np.abs(motion.protected_rate).max() < 1e-17  # the task gives way, not the base
    again = ssm.load_motion(ssm.save_motion(motion, tmp_path / "motion.nc"))
    assert json.loads(again.attrs["saturated_wheels"]) == spans
    np.testing.assert_array_equal(again.wheel_momentum, motion.wheel_momentum)
    assert json.loads(again.attrs["law"])["joint_weights"] == pytest.approx(weights.tolist())


def test_more_than_the_wheels_hold(ets_vii):
    """The arm may not help: what is beyond the wheels' 60 N m s turns the base, at once and all the time."""
    robot = wheeled(ets_vii)
    arm = tuple(name for name in robot.joint_names if name not in robot.wheel_names)
    weights = [1e-9 if name in robot.wheel_names else 1e9 for name in robot.joint_names]
    options = {"tasks": PostureTask(arm), "joint_weights": weights}
    law = SelectiveLaw(robot, Protection("yaw"), momentum=[0, 0, 0, 0, 0, 100.0], **options)
    with pytest.warns(ssm.DecoupleWarning) as told:
        motion = ssm.simulate(law, start_of(robot), START, 2.0, 0.1)
    assert sorted(str(warning.message)[:6] for warning in told) == ["the pr", "wheels"]
    lost = json.loads(motion.attrs["protection_lost"])
    assert lost["spans"] == [[0.0, 2.0]]
    assert lost["largest_rate"] == np.abs(motion.protected_rate).max()
    assert json.loads(motion.attrs["saturated_wheels"])["wheel_z"] == [[0.0, pytest.approx(2.0)]]
    assert np.abs(motion.protected_rate).min() > 1e-3


def test_branched_robots_too(rng):
    robot = random_robot(2, joints=7)
    q, momentum = random_state(robot, rng), rng.normal(size=6)
    law = SelectiveLaw(robot, Protection("yaw", "inertial"), rate_limit=np.inf, damping=0.0, momentum=momentum)
    motion = ssm.simulate(law, q, robot.frame_pose(q).translation, 1.0, 0.01, "rk4")
    np.testing.assert_allclose(motion.angular_momentum, np.tile(momentum[3:], (101, 1)), atol=1e-9)
    centre = motion.centre_of_mass.values
    np.testing.assert_allclose(centre[-1] - centre[0], momentum[:3] / robot.mass, atol=1e-7)
