"""A robot with joints locked against the same robot with those joints where they stand, and against Pinocchio."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest
from random_robots import random_robot, random_state

import ssm_decouple as ssm


def some_of(robot: ssm.Robot, rng: np.random.Generator) -> list[str]:
    return [str(name) for name in rng.choice(robot.joint_names, rng.integers(1, robot.n_joints + 1), replace=False)]


def locked_at(robot: ssm.Robot, names: list[str], q: np.ndarray) -> tuple[ssm.Robot, np.ndarray, list[int]]:
    """Return the robot with joints locked as they stand in q, its own q, and which joints of the robot it has left."""
    angles = dict(zip(robot.joint_names, robot.joint_positions(q), strict=True))
    locked = robot.with_locked({name: angles[name] for name in names})
    rest = {name: angle for name, angle in angles.items() if name not in names}
    assert list(locked.joint_names) == list(rest)
    return locked, locked.configuration(rest, robot.base_pose(q)), [robot.joint_index(name) for name in rest]


def test_the_rest_moves_as_it_did(robot, rng):
    """Momentum matrices, generalized Jacobian and frames: columns of the joints that are left."""
    for _ in range(3):
        q, names = random_state(robot, rng), some_of(robot, rng)
        locked, q_left, left = locked_at(robot, names, q)
        before, after = robot.coupling(q), locked.coupling(q_left)
        assert locked.mass == pytest.approx(robot.mass, rel=1e-14)
        assert locked.end_effector == robot.end_effector
        np.testing.assert_allclose(after.H_ww, before.H_ww, rtol=1e-12, atol=1e-12 * np.abs(before.H_ww).max())
        np.testing.assert_allclose(after.H_wq, before.H_wq[:, left], atol=1e-12 * np.abs(before.H_wq).max())
        np.testing.assert_allclose(after.J_base, before.J_base[:, left], atol=1e-12)
        np.testing.assert_allclose(after.J_g, before.J_g[:, left], atol=1e-12)
        np.testing.assert_allclose(after.centre_of_mass, before.centre_of_mass, atol=1e-12)
        for link in robot.link_names:
            np.testing.assert_allclose(
                locked.frame_pose(q_left, link).homogeneous, robot.frame_pose(q, link).homogeneous, atol=1e-12
            )


def test_the_mass_matrix_is_that_of_pinocchios_reduced_model(robot, rng):
    q, names = random_state(robot, rng), some_of(robot, rng)
    locked, q_left, _ = locked_at(robot, names, q)
    oracle = pin.buildReducedModel(robot.model, [robot.model.getJointId(name) for name in names], q)
    assert list(oracle.names) == list(locked.model.names)
    M, ours = (pin.crba(model, model.createData(), q_left) for model in (oracle, locked.model))
    np.testing.assert_allclose(np.triu(ours), np.triu(M), rtol=1e-12, atol=1e-12 * np.abs(M).max())


def test_joints_of_every_kind_one_by_one(rng):
    kinds = set()
    for seed in range(3):
        robot = random_robot(seed)
        q = random_state(robot, rng)
        for joint in ET.fromstring(robot.urdf).findall("joint"):
            if joint.get("type") == "fixed":
                continue
            locked, q_left, left = locked_at(robot, [joint.get("name")], q)
            np.testing.assert_allclose(locked.coupling(q_left).J_g, robot.coupling(q).J_g[:, left], atol=1e-12)
            kinds.add(joint.get("type"))
    assert kinds == {"revolute", "continuous", "prismatic"}


def test_an_axis_of_any_length_and_a_missing_origin(ets_vii, rng):
    text = ets_vii.urdf.replace('<axis xyz="0 -1 0"/>', '<axis xyz="0.3 -2 0.4"/>')
    text = text.replace('<origin xyz="0.63 0 0" rpy="0 0 0"/>\n    <axis', "<axis")
    assert text.count("<origin") == ets_vii.urdf.count("<origin") - 1
    robot = ssm.Robot(text, name="odd")
    q = random_state(robot, rng)
    locked, q_left, left = locked_at(robot, ["joint_3", "joint_4"], q)
    np.testing.assert_allclose(locked.coupling(q_left).J_g, robot.coupling(q).J_g[:, left], atol=1e-13)


def test_a_step_of_the_law_is_that_of_the_arm_that_holds_the_joint(ets_vii, rng):
    """A law that weighs the locked joint out of its problem, in plain NumPy, gives the same rates."""
    q = random_state(ets_vii, rng)
    locked, q_left, left = locked_at(ets_vii, ["joint_5"], q)
    yaw, target = ssm.Protection("yaw"), ets_vii.frame_pose(q).translation + [0.1, -0.2, 0.1]
    command = ssm.SelectiveLaw(locked, yaw, rate_limit=np.inf)(q_left, target)
    coupling = ets_vii.coupling(q)
    J_sub, J = yaw.J_sub(coupling)[:, left], coupling.J_gt[:, left]
    N = np.eye(5) - np.linalg.pinv(J_sub) @ J_sub
    v = 0.05 * (target - ets_vii.frame_pose(q).translation)
    np.testing.assert_allclose(command.joint_rates, np.linalg.pinv(J @ N) @ v, rtol=1e-9, atol=1e-15)


def test_wings_wheels_and_limits_stay():
    robot = ssm.load_robot("ets_vii_flexible")
    wheels = [ssm.Wheel(f"wheel_{n}", axis, 0.1, 600, 0.2) for n, axis in zip("xyz", np.eye(3), strict=True)]
    wheeled = robot.with_wheels(wheels)
    locked = wheeled.with_locked({"joint_2": 0.4, "wheel_y": 1.0})
    assert locked.appendages == robot.appendages
    assert locked.wheel_names == ("wheel_x", "wheel_z")
    left = [wheeled.joint_index(name) for name in locked.joint_names]
    np.testing.assert_array_equal(locked.rate_limits, wheeled.rate_limits[left])
    np.testing.assert_array_equal(locked.position_limits, wheeled.position_limits[left])
    spare = ssm.Wheel("spare", [0, 1, 0], 0.1, 600, 0.2)  # about the axis of the wheel that is stuck
    assert set(locked.with_wheels([spare]).wheel_names) == {"spare", "wheel_x", "wheel_z"}
    assert locked.name == "ets_vii_flexible + wheels, joint_2, wheel_y locked"


def test_all_joints_or_none(ets_vii, write):
    q = ets_vii.configuration(np.linspace(-1, 1, 6))
    rigid, alone, left = locked_at(ets_vii, list(ets_vii.joint_names), q)
    assert (rigid.n_joints, left, rigid.name) == (0, [], "ets_vii, 6 joints locked")
    np.testing.assert_allclose(rigid.frame_pose(alone).homogeneous, ets_vii.frame_pose(q).homogeneous, atol=1e-14)
    with pytest.raises(ssm.InputError, match="has no joints to command"):
        ssm.SelectiveLaw(rigid, ssm.Protection("yaw"))
    same = ets_vii.with_locked({})
    assert (same.joint_names, same.name) == (ets_vii.joint_names, "ets_vii")
    again = ssm.load_robot(write(ets_vii.with_locked({"joint_1": 0.2}).urdf))
    assert again.joint_names == ets_vii.joint_names[1:]


def test_a_robot_that_has_warned_warns_no_more(ets_vii):
    text = ets_vii.urdf.replace('ixx="6200"', 'ixx="62000"')
    with pytest.warns(ssm.DecoupleWarning, match="triangle"):
        strange = ssm.Robot(text, name="strange")
    strange.with_locked({"joint_1": 0.1})


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        ({"joint2": 0.1}, r"robot 'ets_vii': unknown joint 'joint2'; did you mean 'joint_2'\?"),
        ({"knee": 0.1}, "unknown joint 'knee'; known: joint_1, joint_2"),
        ({"end_effector_mount": 0.1}, "unknown joint 'end_effector_mount'"),
        ({"joint_2": np.nan}, "position of joint 'joint_2' is nan; it needs one finite number"),
        ({"joint_2": np.inf}, "position of joint 'joint_2' is inf"),
        ({"joint_2": [0.1, 0.2]}, r"position of joint 'joint_2' is \[0.1, 0.2\]; it needs one finite number"),
        ({"joint_2": "bent"}, "position of joint 'joint_2' is 'bent'; it needs real numbers"),
        (["joint_2"], r"joints to lock are \['joint_2'\]; give a mapping"),
    ],
)
def test_what_cannot_be_locked_is_refused(ets_vii, joints, message):
    with pytest.raises(ssm.InputError, match=message):
        ets_vii.with_locked(joints)
