"""Dynamic simulation against MuJoCo, Pinocchio's forward dynamics under SciPy, and closed forms."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import re

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from mujoco_robots import mujoco_model
from random_robots import random_robot, random_state
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

import ssm_decouple as ssm
from ssm_decouple.model.perturb import Tolerances, perturbed
from ssm_decouple.simulation.dynamic import Dynamic, DynamicMotion, Load, Sensors, Servo
from ssm_decouple.simulation.simulate import DivergenceError

START = np.deg2rad([150, -20, -10, 0, 0, 0])
TARGET = [-1.8, -0.3, 1.2]
STILL = {"smooth_start": 1e9}  # the law commands next to nothing


def law_of(robot: ssm.Robot, axes: str = "yaw", **changes) -> ssm.SelectiveLaw:
    return ssm.SelectiveLaw(robot, ssm.Protection(axes), **({"gain": 0.05} | changes))


def run(robot: ssm.Robot, duration: float, dt: float = 0.1, law: ssm.SelectiveLaw | None = None, **changes):
    """Simulate case 1; `changes` are those of `Dynamic`, and smooth_start."""
    start = changes.pop("smooth_start", 8.0)
    law, q = law or law_of(robot), robot.configuration(START)
    return ssm.simulate(law, q, TARGET, duration, dt, Dynamic(**changes), smooth_start=start)


def attitudes(quaternions) -> Rotation:
    return Rotation.from_quat(np.asarray(quaternions))


def angle_between(one, other) -> float:
    return float(np.max((attitudes(one).inv() * attitudes(other)).magnitude()))


def wing(**changes) -> ssm.Appendage:
    known = {"name": "wing", "mount": [0, 1.45, 0], "span_direction": [0, 1, 0], "normal": [1, 0, 0], "span": 6.5}
    known |= {"chord": 2.4, "mass": 50.0, "frequency": 0.15, "damping_ratio": 0.005}
    return ssm.Appendage(**(known | changes))


@pytest.fixture(scope="module")
def flexible() -> ssm.Robot:
    return ssm.load_robot("ets_vii_flexible")


# Other people's dynamics.


def replay(robot: ssm.Robot, torques: np.ndarray, dt: float, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Return base poses (m, 7) and joints (m, n) that MuJoCo makes of torques, each held for dt, at the end of each."""
    model = mujoco_model(robot)
    model.opt.integrator, model.opt.timestep = mujoco.mjtIntegrator.mjINT_RK4, step
    data = mujoco.MjData(model)
    columns = [model.joint(name).dofadr[0] for name in robot.joint_names]
    addresses = [model.joint(name).qposadr[0] for name in robot.joint_names]
    data.qpos[addresses] = START
    poses, joints = np.empty((len(torques), 7)), np.empty((len(torques), robot.n_joints))
    for i, torque in enumerate(torques):
        data.qfrc_applied[columns] = torque
        mujoco.mj_step(model, data, round(dt / step))
        poses[i], joints[i] = data.qpos[[0, 1, 2, 4, 5, 6, 3]], data.qpos[addresses]
    return poses, joints


def test_mujoco_moves_the_same_under_the_same_torques(ets_vii):
    motion = run(ets_vii, 20.0, 0.01, servo=Servo(period=0.01))
    poses, joints = replay(ets_vii, motion.joint_torques.values[1:], 0.01, 1e-3)
    assert np.abs(motion.joint_torques).max() > 0.2
    assert np.rad2deg(np.ptp(motion.joint_positions.values, axis=0)).max() > 45
    assert np.rad2deg(attitudes(poses[-1, 3:]).magnitude()) > 0.2
    assert angle_between(motion.base_quaternion[1:], poses[:, 3:]) < 1e-13
    np.testing.assert_allclose(motion.base_position[1:], poses[:, :3], atol=1e-13)
    np.testing.assert_allclose(motion.joint_positions[1:], joints, atol=1e-12)


def by_scipy(robot: ssm.Robot, q, v, torque, span: float) -> np.ndarray:
    """Return [rotation by columns, position, joints, v] after some time under constant torques, by pin.aba."""
    model = robot.model.copy()
    model.gravity = pin.Motion.Zero()
    data, n = model.createData(), robot.n_joints

    def rates(_, y):
        R, joints, v = y[:9].reshape(3, 3).T, y[12 : 12 + n], y[12 + n :]
        at = robot.configuration(joints)  # without gravity the base pose does not matter
        v_dot = pin.aba(model, data, at, v, np.r_[np.zeros(6), torque])
        return np.r_[(R @ pin.skew(v[3:6])).T.ravel(), R @ v[:3], v[6:], v_dot]

    y = np.r_[robot.base_pose(q).rotation.T.ravel(), q[:3], robot.joint_positions(q), v]
    return solve_ivp(rates, (0, span), y, "DOP853", rtol=1e-13, atol=1e-13).y[:, -1]


@pytest.mark.parametrize("name", ["ets_vii", "random_1", "random_4"])
def test_the_integrator_is_of_fourth_order(robots, name, rng):
    """Fast motion of everything, under torques that the servo holds all the time."""
    robot, span, off = robots[name], 0.4, []
    q, v = random_state(robot, rng), rng.normal(size=6 + robot.n_joints)
    for step in (0.01, 0.005, 0.0025):
        motion = DynamicMotion(Dynamic(step=step, servo=Servo(frequency=0.1, period=span)), law_of(robot, "none"), q)
        motion.v[:] = v
        motion.move(np.zeros(robot.n_joints), 0.0, span)
        y = np.r_[motion.pose[:9].reshape(3, 3).T.ravel(), motion.pose[9:], motion.q, motion.v]
        off.append(y - by_scipy(robot, q, v, motion.torques[0], span))
    assert np.abs(motion.torques[0]).min() > 1e-3
    parts = [slice(0, 9), slice(9, 12), slice(12, 12 + robot.n_joints), slice(12 + robot.n_joints, None)]
    for part in parts:
        sizes = np.log2([np.linalg.norm(error[part]) for error in off])
        order = -np.polyfit([0, 1, 2], sizes, 1)[0]
        assert 3.9 < order < 4.1, (name, part, order, sizes)


MJCF = """
<mujoco><compiler angle="radian" boundmass="0" boundinertia="0"/><option gravity="0 0 0" integrator="RK4"
timestep="2e-4"/><worldbody><body name="bus"><freejoint/><inertial pos="0 0 0" mass="600" diaginertia="300 200 250"/>
<body pos="0 1 0"><joint name="left" type="hinge" axis="0 0 -1" stiffness="{k}" damping="{c}"/>
<inertial pos="0 2 0" mass="30" diaginertia="{span} {chord} {both}"/></body>
<body pos="0 -1 0"><joint name="right" type="hinge" axis="0 0 1" stiffness="{k}" damping="{c}"/>
<inertial pos="0 -2 0" mass="30" diaginertia="{span} {chord} {both}"/></body>
<body pos="0.5 0 1"><inertial pos="0.3 0 0" mass="5" diaginertia="0.1 0.2 0.3"/></body>
</body></worldbody></mujoco>
"""

BUS_URDF = """<robot name="bus"><link name="bus"><inertial><origin xyz="0 0 0"/><mass value="660"/>
<inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="arm"><inertial><origin xyz="0.3 0 0"/><mass value="5"/>
<inertia ixx="0.1" iyy="0.2" izz="0.3" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="turn" type="revolute"><parent link="bus"/><child link="arm"/><origin xyz="0.5 0 1"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="0" velocity="1"/></joint></robot>"""


def test_mujoco_s_own_bus_with_wings_moves_the_same():
    """Written by hand in both: wings 4 m x 1.5 m of 30 kg, panels across x, on a bus of 600 kg."""
    span, chord = 30 * 1.5**2 / 12, 30 * 4.0**2 / 12  # about the span direction, about the normal's
    both = 2 * (30 * 3.0**2)
    # Wings in the bus: a plate's moment about its normal x is the sum of those about y, its span, and z.
    urdf = BUS_URDF.format(xx=300 + 2 * (span + chord) + both, yy=200 + 2 * span, zz=250 + 2 * chord + both)
    sides = {"left": 1.0, "right": -1.0}
    wings = [
        wing(name=name, mount=[0, y, 0], span_direction=[0, y, 0], span=4.0, chord=1.5, mass=30.0, damping_ratio=0.01)
        for name, y in sides.items()
    ]
    robot = ssm.Robot(urdf, name="bus", end_effector="arm", appendages=wings)
    motion = DynamicMotion(Dynamic(servo=None), law_of(robot, "none"), robot.configuration())
    k, c = 30 * 4.0**2 / 3 * (2 * np.pi * 0.15) ** 2, 2 * 0.01 * (30 * 4.0**2 / 3) * 2 * np.pi * 0.15
    model = mujoco.MjModel.from_xml_string(MJCF.format(k=k, c=c, span=span + chord, chord=span, both=chord))
    data = mujoco.MjData(model)
    data.qpos[7:] = angles = np.array([0.3, -0.1])
    data.qvel[:] = [0.02, -0.03, 0.01, 0.1, -0.05, 0.08, 0.1, 0.2]
    motion.q[motion.plant.hinges], motion.v[:6] = angles, data.qvel[:6]
    motion.v[6 + motion.plant.hinges] = data.qvel[6:]
    for end in (1.0, 2.0, 5.0):
        motion.move(np.zeros(1), data.time, end)
        mujoco.mj_step(model, data, round((end - data.time) / 2e-4))
        np.testing.assert_allclose(motion.q[motion.plant.hinges], data.qpos[7:], atol=1e-10)
        np.testing.assert_allclose(motion.pose[9:], data.qpos[:3], atol=1e-10)
        assert angle_between(motion.configuration()[3:7], data.qpos[[4, 5, 6, 3]]) < 1e-9


# What stays.


@functools.cache
def long_motion(flexible: bool, driven: bool):
    robot = ssm.load_robot("ets_vii_flexible" if flexible else "ets_vii")
    return run(robot, 150.0, step=2e-3, servo=Servo() if driven else None)


@pytest.mark.parametrize("flexible", [False, True])
@pytest.mark.parametrize("driven", [False, True])
def test_momentum_and_energy_over_a_whole_case(flexible, driven):
    motion = long_motion(flexible, driven)
    robot = ssm.load_robot("ets_vii_flexible")
    assert motion.outcome == "converged"
    assert motion.momentum_drift < 1e-12
    assert motion.energy_error < 1e-10
    assert np.abs(motion.drive_work).max() > 0.02
    hinges = motion.hinge_angles.values
    assert hinges.shape == (1501, 2 if flexible else 0)
    assert (np.abs(hinges).max(initial=0) > 1e-5) == flexible
    # Where everything is, by Pinocchio: the centre of mass stays.
    model = ssm.Plant.of(robot).robot.model
    data = model.createData()
    angles = hinges if flexible else np.zeros((1501, 2))
    plant = ssm.Plant.of(robot)
    centres = np.array(
        [
            pin.centerOfMass(model, data, plant.configuration(q, bent)).copy()
            for q, bent in zip(motion.configuration.values[::50], angles[::50], strict=True)
        ]
    )
    np.testing.assert_allclose(centres, np.tile(centres[0], (31, 1)), atol=1e-13)
    np.testing.assert_allclose(motion.centre_of_mass, np.tile(centres[0], (1501, 1)), atol=1e-13)
    spring = 0.5 * (angles**2 @ plant.stiffness[plant.hinges])
    np.testing.assert_allclose(motion.spring_energy, spring, rtol=1e-12, atol=1e-30)


@pytest.mark.parametrize("driven", [False, True])
def test_the_record_is_the_truth_about_a_rigid_plant(ets_vii, driven):
    """Velocities are the derivatives of poses, momentum is zero by another route, and the drives give the energy."""
    motion = long_motion(False, driven)
    for i in (200, 700):
        v = np.r_[motion.base_linear_velocity[i], motion.base_angular_velocity[i], motion.joint_velocities[i]]
        q = motion.configuration.values[i]
        parts = ets_vii.momentum(q, np.r_[np.zeros(6), v[6:]])
        whole = ets_vii.momentum(q, v)
        for part in (slice(0, 3), slice(3, 6)):
            assert np.linalg.norm(whole[part]) < 1e-11 * np.linalg.norm(parts[part])
        if driven:  # smooth
            before, after = motion.configuration.values[i - 1], motion.configuration.values[i + 1]
            difference = pin.difference(ets_vii.model, before, after) / 0.2
            np.testing.assert_allclose(difference, v, atol=5e-3 * np.abs(v).max())
        assert motion.kinetic_energy[i] == pytest.approx(0.5 * v @ whole_mass_matrix(ets_vii, q) @ v, rel=1e-10)
    largest = np.abs(motion.kinetic_energy.values).max()
    np.testing.assert_allclose(motion.drive_work, motion.kinetic_energy, atol=1e-10 * largest)
    names = {"joint_velocities", "joint_torques", "drive_work", "load_work", "damping_loss", "saturated_time"}
    assert names | {"hinge_angles", "tip_deflection", "kinetic_energy", "spring_energy"} <= set(motion.data_vars)
    for name, variable in motion.data_vars.items():
        assert {"units", "frame", "long_name"} <= variable.attrs.keys(), name
    assert motion.method == "dynamic"
    assert json.loads(motion.physics)["step"] == 2e-3


def whole_mass_matrix(robot: ssm.Robot, q) -> np.ndarray:
    upper = np.triu(pin.crba(robot.model, robot.model.createData(), q))
    return upper + np.triu(upper, 1).T


def test_a_dynamic_motion_survives_the_round_trip(flexible, tmp_path):
    motion = run(flexible, 2.0, sensors=Sensors(encoder_noise=1e-5), load=Load(torque=(0.1, 0, 0)))
    path = ssm.save_motion(motion, tmp_path / "motion.nc")
    assert ssm.load_motion(path).identical(motion)


# Prescribed joints.


@pytest.mark.parametrize("nodes", [0, 2])
def test_prescribed_joints_move_a_rigid_base_as_held_ones(ets_vii, nodes):
    options = {"sample_time": 0.1, "hold_nodes": nodes} if nodes else {}
    law, q = law_of(ets_vii, **options), ets_vii.configuration(START)
    held = ssm.simulate(law, q, TARGET, 60.0, 0.1, "held")
    motion = ssm.simulate(law, q, TARGET, 60.0, 0.1, Dynamic(servo=None, step=2e-3))
    assert np.rad2deg(attitudes(held.base_quaternion[-1]).magnitude()) > 0.5
    assert angle_between(held.base_quaternion, motion.base_quaternion) < 1e-13
    np.testing.assert_allclose(motion.base_position, held.base_position, atol=1e-13)
    np.testing.assert_allclose(motion.joint_positions, held.joint_positions, atol=1e-13)
    np.testing.assert_allclose(motion.protected_angle, held.protected_angle, atol=1e-15)
    np.testing.assert_allclose(motion.joint_velocities[1:], held.joint_rates[:-1], atol=1e-15)


def test_prescribed_joints_tell_their_torques(ets_vii):
    """What a servo finds when it makes the same motion."""
    slow = {"duration": 6.0, "dt": 0.01, "smooth_start": 6.0}
    prescribed = run(ets_vii, **slow, servo=None)
    v, torques = prescribed.joint_velocities.values, prescribed.joint_torques.values
    i = 300
    q, rates = prescribed.configuration.values[i], v[i]
    whole = np.r_[prescribed.base_linear_velocity[i], prescribed.base_angular_velocity[i], rates]
    model = ets_vii.model.copy()
    model.gravity = pin.Motion.Zero()
    M, bias = whole_mass_matrix(ets_vii, q), pin.nle(model, model.createData(), q, whole)
    base = np.linalg.solve(M[:6, :6], -bias[:6])  # the joints' rates are held
    np.testing.assert_allclose(torques[i], M[6:, :6] @ base + bias[6:], rtol=1e-3, atol=1e-6)
    assert np.abs(torques[i]).max() > 1e-4
    assert max(json.loads(prescribed.largest_torques)) >= np.abs(torques).max()


# Loads.


def locked(robot: ssm.Robot, q) -> tuple[float, np.ndarray, np.ndarray]:
    """Return mass, centre of mass and inertia about it, base axes, with the joints locked."""
    coupling = robot.coupling(q)
    R = coupling.base_rotation
    M = whole_mass_matrix(robot, q)
    centre = R.T @ (coupling.centre_of_mass - q[:3])
    skew = pin.skew(centre)
    return robot.mass, centre, M[3:6, 3:6] + robot.mass * skew @ skew


def test_a_load_turns_and_pushes_a_rigid_body_as_euler_has_it(ets_vii):
    load = Load(torque=(150.0, -80.0, 60.0), force=(20.0, 30.0, -10.0), start=2.0, duration=20.0)
    pose = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.5, 1.0), np.array([1.0, 2.0, -1.0]))
    q = ets_vii.configuration(START, pose)
    motion = ssm.simulate(law_of(ets_vii), q, [0.0, 1.0, 0.0], 30.0, 0.5, Dynamic(servo=None, load=load), **STILL)
    mass, centre, inertia = locked(ets_vii, q)
    force = np.array(load.force)
    torque = np.array(load.torque) - np.cross(centre, force)

    def rates(t, y, on):
        R, w, velocity = y[:9].reshape(3, 3), y[9:12], y[15:]
        w_dot = np.linalg.solve(inertia, on * torque - np.cross(w, inertia @ w))
        return np.r_[(R @ pin.skew(w)).ravel(), w_dot, velocity, on * R @ force / mass]

    y = np.r_[pose.rotation.ravel(), np.zeros(3), pose.act(centre), np.zeros(3)]
    for start, end in ((2.0, 22.0), (22.0, 30.0)):
        wanted = np.arange(start, end + 0.1, 0.5)
        found = solve_ivp(rates, (start, end), y, "DOP853", wanted, args=(start < 20,), rtol=1e-12, atol=1e-12).y
        y = found[:, -1]
        for t, state in zip(wanted, found.T, strict=True):
            at, R = motion.sel(time=t, method="nearest"), state[:9].reshape(3, 3)
            assert angle_between(at.base_quaternion, Rotation.from_matrix(R).as_quat()) < 1e-9
            np.testing.assert_allclose(at.base_angular_velocity, state[9:12], atol=1e-10)
            np.testing.assert_allclose(at.base_position, state[12:15] - R @ centre, atol=1e-9)
            np.testing.assert_allclose(at.linear_momentum, mass * state[15:], atol=1e-8)
            np.testing.assert_allclose(at.angular_momentum, R @ inertia @ state[9:12], atol=1e-7)
    assert np.linalg.norm(motion.base_angular_velocity[-1]) > 0.5
    assert motion.momentum_drift < 1e-11
    assert motion.energy_error < 1e-9
    np.testing.assert_allclose(motion.load_work[-1], motion.kinetic_energy[-1], rtol=1e-9)
    assert np.abs(motion.base_position[:5] - motion.base_position[0]).max() == 0  # before it begins


@pytest.mark.parametrize("servo", [None, Servo()])
def test_momentum_under_a_load_is_its_impulse(flexible, servo):
    load = Load(torque=(0.5, -0.3, 0.4), force=(0.5, 1.0, -0.2), start=3.05, duration=20.0)
    motion = run(flexible, 30.0, servo=servo, load=load)
    assert np.linalg.norm(motion.linear_momentum[-1]) == pytest.approx(20 * np.linalg.norm(load.force), rel=1e-2)
    assert motion.momentum_drift < 1e-11
    assert motion.energy_error < 1e-9
    # Newton and Euler by quadrature of the recorded motion, from inside the load's time.
    inside = motion.sel(time=slice(4.0, 22.0))
    R = attitudes(inside.base_quaternion).as_matrix()
    force, arm = R @ np.array(load.force), inside.base_position.values - inside.centre_of_mass.values
    torque = R @ np.array(load.torque) + np.cross(arm, force)
    for rate, name in ((force, "linear_momentum"), (torque, "angular_momentum")):
        gained = inside[name].values[-1] - inside[name].values[0]
        integral = CubicSpline(inside.time.values, rate).integrate(4.0, 22.0)
        np.testing.assert_allclose(integral, gained, atol=1e-6 * np.linalg.norm(gained))


# Wings.


def test_a_stiff_wing_is_a_rigid_one(ets_vii):
    """The difference falls with the square of the frequency."""
    rigid = run(ets_vii, 20.0, step=2e-3)
    off = []
    for frequency in (6.0, 12.0, 24.0):
        bent = run(ets_vii.with_appendages([wing(frequency=frequency, damping_ratio=0.2)]), 20.0, step=2e-3)
        off.append(angle_between(rigid.base_quaternion, bent.base_quaternion))
    assert off[0] > 5e-10
    for softer, stiffer in itertools.pairwise(off):
        assert 3.6 < softer / stiffer < 4.4, off


def test_a_wing_swings_at_its_frequency_and_dies_away_with_its_damping(ets_vii):
    robot = ets_vii.with_appendages([wing(damping_ratio=0.02)])
    load = Load(torque=(0, 0, 1.0), duration=0.5)
    motion = run(robot, 60.0, servo=None, load=load, step=5e-3, **STILL)
    free = ssm.Plant.of(robot).frequencies(ssm.Plant.of(robot).configuration(robot.configuration(START)))[0]
    assert free > 1.1 * 0.15
    ratio = 0.02 * free / 0.15  # the damper is that of the clamped wing
    late = motion.sel(time=slice(1.0, None))
    curve = CubicSpline(late.time.values, late.hinge_angles.values[:, 0])
    crossings = curve.roots(extrapolate=False)
    periods = np.diff(crossings[::2])
    np.testing.assert_allclose(1 / periods, free * np.sqrt(1 - ratio**2), rtol=1e-4)
    peaks = curve.derivative().roots(extrapolate=False)
    heights = np.abs(curve(peaks))
    decrement = np.log(heights[:-1] / heights[1:])  # over half a period
    np.testing.assert_allclose(decrement, np.pi * ratio / np.sqrt(1 - ratio**2), rtol=1e-2)
    np.testing.assert_allclose(motion.tip_deflection[:, 0], 6.5 * np.sin(motion.hinge_angles[:, 0]), atol=1e-15)
    lost = motion.load_work - motion.damping_loss - motion.kinetic_energy - motion.spring_energy
    assert np.abs(lost).max() < 1e-9 * motion.load_work.max()


# Torque limits.


def test_low_torque_limits_slow_the_arm_and_nothing_worse(ets_vii):
    free = run(ets_vii, 60.0, smooth_start=0.0)
    assert free.saturated_time[-1] == 0
    largest = np.array(json.loads(free.largest_torques))
    limits = 0.2 * largest
    motion = run(ets_vii, 150.0, step=2e-3, smooth_start=0.0, servo=Servo(torque_limits=limits))
    told = np.array(json.loads(motion.largest_torques))
    assert np.all(told <= limits)
    assert np.any(told == limits)
    assert np.all(np.abs(motion.joint_torques) <= limits)
    rising = motion.saturated_time.values
    assert rising[-1] > 0.1
    assert np.all(np.diff(rising) >= 0)
    assert rising[-1] == pytest.approx(rising[-500])  # it gets out of saturation
    assert motion.momentum_drift < 1e-11
    assert motion.energy_error < 1e-9
    assert np.abs(motion.joint_velocities).max() < 1.2 * np.deg2rad(5)
    assert motion.outcome == "converged"
    one = run(ets_vii, 5.0, smooth_start=0.0, servo=Servo(torque_limits=0.5))
    assert max(json.loads(one.largest_torques)) == 0.5


def test_torque_limits_come_from_the_urdf():
    robot = random_robot(3)
    q = robot.configuration(np.full(robot.n_joints, 0.3))
    law = law_of(robot, "none", gain=2.0, rate_limit=10.0)
    here = robot.frame_pose(q).translation
    motion = ssm.simulate(law, q, here + 0.2, 1.0, 0.1, Dynamic(servo=Servo(frequency=4.0)))
    assert max(json.loads(motion.largest_torques)) == 10.0


# Divergence.


def test_a_motion_that_runs_away_keeps_what_was_before(ets_vii):
    with pytest.raises(DivergenceError, match=r"diverged at (3\.\d+) s: .* try a shorter physics step") as caught:
        run(ets_vii, 10.0, load=Load(torque=(1e9, 0, 0), start=3.0))
    when = float(re.search(r"at ([\d.]+) s", str(caught.value)).group(1))
    kept = caught.value.motion
    assert 3.0 < when < 3.3
    assert kept.time[-1] <= when < kept.time[-1] + 0.1
    whole = run(ets_vii, 3.0)
    same = slice(0, 31)
    np.testing.assert_array_equal(kept.configuration[same], whole.configuration[same])
    assert isinstance(caught.value, ssm.DecoupleError)


def test_divergence_at_once_leaves_the_start(ets_vii):
    with pytest.raises(DivergenceError) as caught:
        run(ets_vii, 1.0, load=Load(force=(1e12, 0, 0)))
    assert caught.value.motion.sizes["time"] == 1


# Input.


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        (lambda: {"step": 0.0}, "physics step is 0.0; it must be a positive number"),
        (lambda: {"step": np.nan}, "physics step is nan"),
        (lambda: {"step": np.inf}, "physics step is inf"),
        (lambda: {"feedback_gain": -1.0}, "feedback_gain is -1.0; it must be zero or a positive number"),
        (lambda: {"servo": Servo(frequency=0.0)}, "servo frequency is 0.0; it must be a positive"),
        (lambda: {"servo": Servo(damping_ratio=-1.0)}, "servo damping_ratio is -1.0"),
        (lambda: {"servo": Servo(period=0.0)}, "servo period is 0.0"),
        (lambda: {"servo": Servo(torque_limits=-1.0)}, r"torque_limits is -1.0; give one positive number or 6"),
        (
            lambda: {"servo": Servo(torque_limits=np.ones(5))},
            r"torque_limits is \[1.0, .*\]; give one positive number or 6",
        ),
        (lambda: {"servo": Servo(torque_limits=np.nan)}, "torque_limits is nan"),
        (lambda: {"sensors": Sensors(encoder_noise=-1e-3)}, "encoder_noise is -0.001; it must be zero or a positive"),
        (lambda: {"sensors": Sensors(encoder_resolution=np.inf)}, "encoder_resolution is inf"),
        (lambda: {"sensors": Sensors(gyro_noise=np.nan)}, "gyro_noise is nan"),
        (lambda: {"load": Load(torque=(1, 2))}, "force and torque need 3 finite numbers each"),
        (lambda: {"load": Load(force=(1, 2), torque=(1, 2, 3, 4))}, "force and torque need 3 finite numbers each"),
        (lambda: {"load": Load(force=5.0)}, "force and torque need 3 finite numbers each"),
        (lambda: {"load": Load(force=(1, np.inf, 2))}, "force and torque need 3 finite numbers each"),
        (lambda: {"load": Load(force=("a", 1, 2))}, "load force is .* it needs real numbers"),
        (lambda: {"load": Load(start=-1.0)}, "start of the load is -1.0; it must be zero"),
        (lambda: {"load": Load(duration=0.0)}, "duration of the load is 0.0; it must be above zero"),
        (lambda: {"step": "a"}, "physics step is 'a'; it needs real numbers"),
        (lambda: {"feedback_gain": [1, 2]}, r"feedback_gain is \[1, 2\]"),
        (
            lambda: {"feedback_gain": 20.0},
            "feedback_gain is 20 1/s, with 0.1 s between samples it overshoots: use 10 1/s",
        ),
        (lambda: {"plant": "ets_vii"}, "plant is 'ets_vii'; give a Robot, or None"),
        (lambda: {"servo": 2.0}, "servo is 2.0; give a Servo, or None"),
        (lambda: {"load": [0, 0, 1]}, r"load is \[0, 0, 1\]; give a Load"),
        (lambda: {"sensors": Sensors(seed=-1)}, "seed of the sensors is -1; it must be a whole number from 0"),
    ],
)
def test_bad_settings_are_refused(ets_vii, changes, says):
    with pytest.raises(ssm.InputError, match=says):
        run(ets_vii, 1.0, **changes())


def test_another_robot_is_no_plant(ets_vii):
    with pytest.raises(
        ssm.InputError, match=r"the law commands the joints joint_1, .* of 'ets_vii', the plant 'random_2'"
    ):
        run(ets_vii, 1.0, plant=random_robot(2))
    bare = ssm.Robot(ets_vii.urdf.replace('"end_effector"', '"tool"'), name="bare", end_effector="tool")
    with pytest.raises(ssm.InputError, match="the plant 'bare' has no frame 'end_effector', the law's end-effector"):
        run(ets_vii, 1.0, plant=bare)


@pytest.mark.parametrize(
    ("servo", "wings", "what"),
    [
        (Servo(), False, "physics step of 1 s is too coarse for the servo at 2 Hz: use 0.039 s"),
        (Servo(period=1.0), False, "servo period of 1 s is too coarse for the servo at 2 Hz: use 0.039 s"),
        (
            None,
            True,
            r"physics step of 1 s is too coarse for the stiffest mode of the appendages at 0.\d+ Hz: use 0.\d+",
        ),
        (Servo(frequency=0.05), True, "physics step of 1 s is too coarse for the stiffest mode"),
    ],
)
def test_a_step_that_is_too_coarse_names_one_that_is_not(ets_vii, servo, wings, what):
    robot = ets_vii.with_appendages([wing()] if wings else [])
    with pytest.raises(ssm.InputError, match=what) as caught:
        run(robot, 10.0, 1.0, step=1.0, servo=servo)
    usable = float(re.search(r"use ([\d.e-]+) s or less", str(caught.value)).group(1))
    mend = {"step": usable, "servo": servo}
    if servo is not None and servo.period is not None:
        mend = {"servo": dataclasses.replace(servo, period=usable)}
    assert run(robot, 10.0, 1.0, **mend).energy_error < 1e-2
    assert usable > 0.8 * 0.5 / (2 * np.pi * float(re.search(r"at ([\d.]+) Hz", str(caught.value)).group(1)))


# The plant is not the model.


def test_a_plant_may_hold_its_configuration_in_another_way(ets_vii):
    """Continuous joints take two numbers each where revolute ones take one."""
    turning = ssm.Robot(ets_vii.urdf.replace('type="revolute"', 'type="continuous"'), name="turning")
    assert turning.model.nq != ets_vii.model.nq
    one, other = run(ets_vii, 5.0), run(ets_vii, 5.0, plant=turning)
    np.testing.assert_allclose(other.configuration, one.configuration, atol=1e-13)


def test_feedback_takes_back_what_a_wrong_model_lets_turn(ets_vii):
    """Held joints and a law that plans for it: the model's error is all that turns the protected axis."""
    law = law_of(ets_vii, sample_time=0.1, hold_nodes=2)
    plant = perturbed(ets_vii, Tolerances(mass=0.05, inertia=0.05), seed=1)
    options = {"law": law, "step": 5e-3, "servo": None}
    right, wrong, mended = (
        np.rad2deg(np.abs(run(ets_vii, 100.0, **options, **changes).protected_angle.values))
        for changes in ({}, {"plant": plant}, {"plant": plant, "feedback_gain": 0.5})
    )
    assert right.max() < 1e-11
    assert wrong.max() > 1e-3
    assert mended.max() < 0.1 * wrong.max()
    assert mended[-1] < 0.01 * wrong[-1]


@pytest.mark.parametrize("frame", ["base", "inertial"])
def test_feedback_measures_the_protected_angle(ets_vii, frame):
    law = ssm.SelectiveLaw(ets_vii, ssm.Protection([[1, 0], [0, 0.6], [0, 0.8]], frame), gain=0.05)
    plant = perturbed(ets_vii, Tolerances(mass=0.1), seed=2)
    physics = DynamicMotion(Dynamic(plant=plant, step=5e-3), law, ets_vii.configuration(START))
    whole = ssm.simulate(law, ets_vii.configuration(START), TARGET, 20.0, 0.1, physics.settings)
    for i in range(200):
        physics.move(whole.joint_rates.values[i], 0.1 * i, 0.1 * (i + 1))
    assert np.abs(physics.measured).max() > 1e-7
    np.testing.assert_allclose(physics.measured, whole.protected_angle.values[-1], rtol=1e-3, atol=1e-9)


def test_sensors_are_seeded(ets_vii):
    noisy = Sensors(encoder_noise=1e-4, gyro_noise=1e-5, seed=3)
    one = run(ets_vii, 3.0, sensors=noisy, feedback_gain=0.1)
    assert run(ets_vii, 3.0, sensors=noisy, feedback_gain=0.1).identical(one)
    other = run(ets_vii, 3.0, sensors=dataclasses.replace(noisy, seed=4), feedback_gain=0.1)
    assert np.abs(other.joint_rates - one.joint_rates).max() > 1e-9
    perfect = run(ets_vii, 3.0, feedback_gain=0.1)
    assert run(ets_vii, 3.0, sensors=Sensors(), feedback_gain=0.1).joint_rates.equals(perfect.joint_rates)


def test_encoders_round_and_scatter(ets_vii):
    law, q = law_of(ets_vii), ets_vii.configuration(START)
    coarse = DynamicMotion(Dynamic(sensors=Sensors(encoder_resolution=1e-3)), law, q)
    joints = ets_vii.joint_positions(coarse.seen())
    np.testing.assert_allclose(joints / 1e-3, np.round(START / 1e-3), atol=1e-9)
    np.testing.assert_array_equal(coarse.seen()[:7], q[:7])
    noisy = DynamicMotion(Dynamic(sensors=Sensors(encoder_noise=1e-3)), law, q)
    errors = np.array([ets_vii.joint_positions(noisy.seen()) - START for _ in range(2000)])
    np.testing.assert_allclose(errors.std(axis=0), 1e-3, rtol=0.1)
    np.testing.assert_allclose(errors.mean(axis=0), 0, atol=1e-4)


def test_gyro_noise_reaches_only_the_feedback(ets_vii):
    noisy = Sensors(gyro_noise=1e-4)
    still, deaf = run(ets_vii, 5.0), run(ets_vii, 5.0, sensors=noisy)
    assert deaf.drop_attrs(deep=False).identical(still.drop_attrs(deep=False))
    # Told to the feedback it is a random walk of the protected angle, N steps of noise x dt.
    fed = DynamicMotion(Dynamic(sensors=noisy, step=0.01), law_of(ets_vii, "all"), ets_vii.configuration(START))
    walk = [fed.measured.copy()]
    for i in range(400):
        fed.move(np.zeros(6), 0.1 * i, 0.1 * (i + 1))
        walk.append(fed.measured.copy())
    np.testing.assert_allclose(np.diff(walk, axis=0).std(), 1e-4 * 0.1, rtol=0.1)
    assert not run(ets_vii, 5.0, sensors=noisy, feedback_gain=0.1).joint_rates.equals(still.joint_rates)


@pytest.mark.parametrize("axes", ["none", "all"])
def test_feedback_with_nothing_and_with_everything_protected(ets_vii, axes):
    motion = run(ets_vii, 3.0, law=law_of(ets_vii, axes), feedback_gain=0.2)
    assert motion.momentum_drift < 1e-11


@pytest.mark.parametrize("frame", ["base", "inertial"])
def test_the_protected_rate_of_a_dynamic_motion_is_the_truth(ets_vii, frame):
    """Not what the law believes, which is rounding: against differences of the recorded attitude."""
    law = ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw", frame))
    q = ets_vii.configuration(np.deg2rad([150, -20, -10, 0, 0, 0]))
    motion = ssm.simulate(law, q, [-1.8, -0.3, 1.2], 5.0, 0.01, ssm.Dynamic(step=0.005), smooth_start=3.0)
    attitude = Rotation.from_quat(motion.base_quaternion.values)
    left, right = attitude[:-2], attitude[2:]
    turned = (left.inv() * right if frame == "base" else right * left.inv()).as_rotvec()[:, 2] / 0.02
    truth = motion.protected_rate.values[1:-1, 0]
    assert np.abs(truth).max() > 1e-9
    np.testing.assert_allclose(turned, truth, atol=0.02 * np.abs(truth).max())


@pytest.mark.parametrize(
    "protection",
    [ssm.Protection("yaw"), ssm.Protection("yaw", "inertial"), ssm.Protection.from_modes([6.0, 0, 0, 0, 0, -35.0])],
    ids=["base", "inertial", "twist"],
)
def test_a_servo_that_protects_holds_the_directions_when_the_model_is_off(ets_vii, protection):
    plant = perturbed(ets_vii, Tolerances(0.05, 0.05, 0.005, 0.005), 4)
    law = ssm.SelectiveLaw(ets_vii, protection, rate_limit=np.deg2rad(5))
    q = ets_vii.configuration(np.deg2rad([150, -20, -10, 0, 0, 0]))
    turned = {}
    for protects in (False, True):
        physics = Dynamic(step=0.005, plant=plant, servo=Servo(protects=protects))
        motion = ssm.simulate(law, q, [-1.8, -0.3, 1.2], 20.0, 0.1, physics)
        turned[protects] = float(np.abs(motion.protected_angle).max())
        assert motion.attrs["energy_error"] < 1e-9
    assert turned[True] < turned[False] / 500


def test_feedback_that_cannot_work_is_refused(ets_vii):
    with pytest.raises(ssm.InputError, match="would both hold the protected directions; use one"):
        Dynamic(servo=Servo(protects=True), feedback_gain=1.0)
    law = ssm.SelectiveLaw(ets_vii, ssm.Protection([1.0, 0, 0, 0, 0, 0]))
    with pytest.raises(ssm.InputError, match="rows of translation, which they do not"):
        ssm.simulate(law, ets_vii.configuration(), [1.0, 0.0, 2.0], 1.0, 0.1, Dynamic(feedback_gain=1.0))


def test_a_load_given_as_arrays_is_recorded(ets_vii):
    motion = run(ets_vii, 1.0, load=Load(torque=np.array([0.0, 0.0, 0.1])))
    assert json.loads(motion.attrs["physics"])["load"]["torque"] == [0.0, 0.0, 0.1]
