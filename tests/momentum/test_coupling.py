"""Every momentum matrix against routes that share no formula with it."""

from __future__ import annotations

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from mujoco_robots import mass_matrix, mujoco_model
from random_robots import random_state

import ssm_decouple as ssm

TOLERANCE = 1e-10


def relative(actual, expected):
    scale = max(np.linalg.norm(expected), 1e-300)
    return np.linalg.norm(np.asarray(actual) - np.asarray(expected)) / scale


def test_base_twist_and_coupling_from_the_joint_space_inertia(robot, rng):
    """CRBA: the base rows of M v are its momentum; zero them. A Schur complement moves them to the centre of mass."""
    for _ in range(10):
        q = random_state(robot, rng)
        coupling = robot.coupling(q)
        data = robot.model.createData()
        M = pin.crba(robot.model, data, q)
        M = np.triu(M) + np.triu(M, 1).T
        J_base = -np.linalg.solve(M[:6, :6], M[:6, 6:])
        assert relative(coupling.J_base, J_base) < TOLERANCE
        assert relative(coupling.J_rc, J_base[3:]) < TOLERANCE
        # Eliminate the base's linear velocity from the angular rows.
        M_vv, M_vw, M_ww = M[:3, :3], M[:3, 3:6], M[3:6, 3:6]
        H_ww = M_ww - M_vw.T @ np.linalg.solve(M_vv, M_vw)
        H_wq = M[3:6, 6:] - M_vw.T @ np.linalg.solve(M_vv, M[:3, 6:])
        assert relative(coupling.H_ww, H_ww) < TOLERANCE
        assert relative(coupling.H_wq, H_wq) < TOLERANCE
        np.testing.assert_allclose(coupling.H_ww, coupling.H_ww.T, rtol=1e-12, atol=1e-10)


def central(values, h):
    """Sixth-order central difference of samples at -3h .. 3h."""
    weights = np.array([-1, 9, -45, 0, 45, -9, 1]) / 60.0
    return np.tensordot(weights, np.array(values), axes=1) / h


def test_the_motion_it_predicts_conserves_momentum(robot, rng):
    """Differentiate positions and rotations of all bodies along a motion: no velocity formula is used."""
    h = 4e-2
    for _ in range(3):
        q = random_state(robot, rng)
        coupling = robot.coupling(q)
        rates = rng.uniform(-0.3, 0.3, robot.n_joints)
        v = np.r_[coupling.base_twist(rates), rates]
        model, data = robot.model, robot.model.createData()
        poses, tools, centres = [], [], []
        for step in range(-3, 4):
            pin.framesForwardKinematics(model, data, pin.integrate(model, q, step * h * v))
            poses.append([data.oMi[j].copy() for j in range(model.njoints)])
            tools.append(data.oMf[robot.end_effector_id].copy())
            centres.append(pin.centerOfMass(model, data, pin.integrate(model, q, step * h * v)).copy())
        linear, angular, size = np.zeros(3), np.zeros(3), 0.0
        for body in range(1, model.njoints):
            inertia = model.inertias[body]
            at = [pose[body].act(inertia.lever) for pose in poses]
            R = poses[3][body].rotation
            turned = [pin.log3(pose[body].rotation @ R.T) for pose in poses]
            velocity, spin = central(at, h), central(turned, h)
            linear += inertia.mass * velocity
            angular += np.cross(at[3] - centres[3], inertia.mass * velocity) + R @ inertia.inertia @ R.T @ spin
            size += inertia.mass * np.linalg.norm(velocity) + np.linalg.norm(R @ inertia.inertia @ R.T @ spin)
        assert np.linalg.norm(linear) < TOLERANCE * size
        assert np.linalg.norm(angular) < TOLERANCE * size
        moved = central([tool.translation for tool in tools], h)
        turned = central([pin.log3(tool.rotation @ tools[3].rotation.T) for tool in tools], h)
        assert relative(coupling.J_g @ rates, np.r_[moved, turned]) < TOLERANCE
        np.testing.assert_array_equal(coupling.J_gt, coupling.J_g[:3])


def test_mujoco_agrees(robot, rng):
    model = mujoco_model(robot)
    data = mujoco.MjData(model)
    addresses = [model.joint(name).qposadr[0] for name in robot.joint_names]
    columns = [model.joint(name).dofadr[0] for name in robot.joint_names]
    root_q, root_v = model.joint("root").qposadr[0], model.joint("root").dofadr[0]
    for _ in range(5):
        q = random_state(robot, rng)
        data.qpos[root_q : root_q + 3] = q[:3]
        data.qpos[root_q + 3 : root_q + 7] = q[[6, 3, 4, 5]]  # MuJoCo's quaternion starts with w
        data.qpos[addresses] = robot.joint_positions(q)
        mujoco.mj_forward(model, data)
        M = mass_matrix(model, data)
        base = list(range(root_v, root_v + 6))
        J_base = -np.linalg.solve(M[np.ix_(base, base)], M[np.ix_(base, columns)])
        coupling = robot.coupling(q)
        J_base[:3] = coupling.base_rotation.T @ J_base[:3]  # MuJoCo's free joint: linear in world, angular in body axes
        assert relative(coupling.J_base, J_base) < TOLERANCE
        body = model.body(model.jnt_bodyid[model.joint("root").id])
        assert relative(coupling.centre_of_mass, data.subtree_com[body.id]) < TOLERANCE
        # Momentum of any motion.
        v = rng.normal(size=robot.model.nv)
        data.qvel[root_v : root_v + 3] = coupling.base_rotation @ v[:3]
        data.qvel[root_v + 3 : root_v + 6] = v[3:6]
        data.qvel[columns] = v[6:]
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        momentum = robot.momentum(q, v)
        assert relative(momentum[:3], robot.mass * data.subtree_linvel[body.id]) < TOLERANCE
        assert relative(momentum[3:], data.subtree_angmom[body.id]) < TOLERANCE


def test_system_inertia_is_that_of_the_bodies_frozen_together(robot, rng):
    q = random_state(robot, rng)
    coupling, model, data = robot.coupling(q), robot.model, robot.model.createData()
    pin.forwardKinematics(model, data, q)
    centre = sum(model.inertias[j].mass * data.oMi[j].act(model.inertias[j].lever) for j in range(1, model.njoints))
    centre = centre / robot.mass
    inertia = np.zeros((3, 3))
    for j in range(1, model.njoints):
        body, R = model.inertias[j], data.oMi[j].rotation
        r = data.oMi[j].act(body.lever) - centre
        inertia += R @ body.inertia @ R.T + body.mass * (r @ r * np.eye(3) - np.outer(r, r))
    assert relative(coupling.inertial().H_ww, inertia) < TOLERANCE
    assert relative(coupling.centre_of_mass, centre) < TOLERANCE
    assert coupling.mass == pytest.approx(robot.mass)


def test_inertial_axes_are_the_base_s_turned(robot, rng):
    q = random_state(robot, rng)
    base, turned = robot.coupling(q), robot.coupling(q).inertial()
    R = base.base_rotation
    rates = rng.normal(size=robot.n_joints)
    assert (base.frame, turned.frame) == ("base", "inertial")
    assert turned.inertial() is turned
    np.testing.assert_allclose(turned.J_rc, -np.linalg.solve(turned.H_ww, turned.H_wq), rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(turned.J_rc @ rates, R @ (base.J_rc @ rates), rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(turned.base_twist(rates)[:3], R @ base.base_twist(rates)[:3], rtol=1e-12, atol=1e-14)
    np.testing.assert_array_equal(turned.J_g, base.J_g)


def test_a_turned_and_shifted_base_changes_nothing_in_base_axes(robot, rng):
    joints = rng.uniform(-1, 1, robot.n_joints)
    pose = pin.SE3(pin.rpy.rpyToMatrix(*rng.uniform(-3, 3, 3)), rng.uniform(-5, 5, 3))
    here, there = robot.coupling(robot.configuration(joints)), robot.coupling(robot.configuration(joints, pose))
    for name in ("H_ww", "H_wq", "J_rc", "J_base"):
        assert relative(getattr(there, name), getattr(here, name)) < TOLERANCE


def test_a_two_body_closed_form(write):
    """A wheel on a bus, both about z: the bus turns by -I_wheel / (I_bus + I_wheel) per turn of the wheel."""
    inertia = '<inertia ixx="{0}" ixy="0" ixz="0" iyy="{0}" iyz="0" izz="{0}"/>'
    text = (
        f'<robot name="r"><link name="bus"><inertial><mass value="50"/>{inertia.format(12.0)}</inertial></link>'
        f'<link name="wheel"><inertial><mass value="2"/>{inertia.format(0.5)}</inertial></link>'
        '<joint name="spin" type="continuous"><parent link="bus"/><child link="wheel"/><axis xyz="0 0 1"/></joint>'
        "</robot>"
    )
    coupling = ssm.load_robot(write(text)).coupling(np.r_[np.zeros(6), 1.0, np.cos(0.3), np.sin(0.3)])
    np.testing.assert_allclose(coupling.J_rc, [[0], [0], [-0.5 / 12.5]], rtol=1e-15, atol=1e-17)
    np.testing.assert_allclose(coupling.J_base[:3], 0, atol=1e-17)


def test_nothing_in_it_can_be_changed(ets_vii):
    coupling = ets_vii.coupling(ets_vii.configuration())
    for name in ("H_ww", "H_wq", "J_rc", "J_base", "J_g", "J_arm", "centre_of_mass", "base_position", "base_rotation"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(coupling, name)[0] = 1.0
    with pytest.raises(AttributeError):
        coupling.mass = 1.0
