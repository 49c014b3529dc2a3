"""The shipped seven-joint arm and the bus with two arms."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest
import yourdfpy

import ssm_decouple as ssm

MASSES = (30.0, 20.0, 24.0, 15.0, 18.0, 14.0, 16.0)
LENGTHS = (0.3, 0.4, 0.6, 0.35, 0.55, 0.25, 0.45)
RADIUS = 0.1
X, Y, Z = np.eye(3)
AXES = (Z, Y, Z, -Y, X, Y, X)
RUNS = (Z, Z, Z, X, X, X, X)


@pytest.mark.parametrize("name", ["seven_joint", "two_arms"])
def test_nothing_is_suspicious(name, call):
    done = call("check", name)
    assert done.returncode == 0
    assert "nothing suspicious" in done.stdout


def test_seven_joints_of_solid_cylinders():
    urdf = yourdfpy.URDF.load(str(ssm.models()["seven_joint"]), load_meshes=False)
    for i, (mass, length, axis, run) in enumerate(zip(MASSES, LENGTHS, AXES, RUNS, strict=True)):
        joint, body = urdf.joint_map[f"joint_{i + 1}"], urdf.link_map[f"link_{i + 1}"].inertial
        np.testing.assert_array_equal(joint.axis, axis)
        at = np.array([-0.79, -0.29, 1.0]) if i == 0 else LENGTHS[i - 1] * RUNS[i - 1]
        np.testing.assert_array_equal(joint.origin[:3, 3], at)
        assert body.mass == mass
        np.testing.assert_allclose(body.origin[:3, 3], length / 2 * run)
        along, across = mass * RADIUS**2 / 2, mass * (3 * RADIUS**2 + length**2) / 12
        np.testing.assert_allclose(body.inertia, across * np.eye(3) + (along - across) * np.outer(run, run))
    robot = ssm.load_robot("seven_joint")
    assert (robot.n_joints, robot.mass, robot.end_effector) == (7, 2687.0, "end_effector")
    assert robot.reach == pytest.approx(2.9)


def test_shoulder_and_wrist_are_spherical(rng):
    """Three axes meet in a point where turning about them leaves it in place."""
    robot = ssm.load_robot("seven_joint")
    joints = rng.uniform(-np.pi, np.pi, 7)
    turned = joints + [*rng.uniform(-1, 1, 3), 0, *rng.uniform(-1, 1, 3)]
    poses = [[robot.frame_pose(robot.configuration(q), f"link_{i}") for i in (2, 4, 6)] for q in (joints, turned)]
    for shoulder, elbow, wrist in poses:
        np.testing.assert_allclose(shoulder.translation, [-0.79, -0.29, 1.3])
        assert np.linalg.norm(elbow.translation - shoulder.translation) == pytest.approx(1.0)
        assert np.linalg.norm(wrist.translation - elbow.translation) == pytest.approx(0.9)
    spans = [np.linalg.norm(wrist.translation - shoulder.translation) for shoulder, _, wrist in poses]
    assert spans[0] == pytest.approx(spans[1])  # the elbow alone sets it


def test_two_arms_are_ets_vii_s_arm_twice(rng):
    whole = ET.fromstring(ssm.load_robot("ets_vii").urdf)
    whole.findall("link")[0][:] = []
    arm = ssm.Robot(ET.tostring(whole, encoding="unicode"), name="arm")
    half_turn = pin.SE3(pin.exp3(np.pi * Y), np.zeros(3))
    composed = ssm.compose("ets_vii_bus", arm, half_turn, prefix="second_")
    composed = ssm.compose(composed, arm, [0, 0, 0], prefix="first_")
    robot = ssm.load_robot("two_arms")
    assert robot.joint_names == composed.joint_names
    assert robot.joint_names[6] == "second_joint_1"
    assert (robot.end_effector, robot.mass) == ("end_effector", pytest.approx(2550 + 2 * 140.4))
    q = robot.configuration(rng.uniform(-np.pi, np.pi, 12))
    for name in ("H_ww", "H_wq", "J_gt"):
        np.testing.assert_allclose(getattr(robot.coupling(q), name), getattr(composed.coupling(q), name), atol=1e-9)


def test_the_second_arm_stands_half_a_turn_of_pitch_from_the_first(rng):
    robot, joints = ssm.load_robot("two_arms"), rng.uniform(-np.pi, np.pi, 6)
    q = robot.configuration([*joints, *joints])
    first, second = (robot.frame_pose(q, name).translation for name in ("end_effector", "second_end_effector"))
    np.testing.assert_allclose(second, first * [-1, 1, -1], atol=1e-12)
