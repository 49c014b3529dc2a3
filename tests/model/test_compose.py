from __future__ import annotations

import warnings

import numpy as np
import pinocchio as pin
import pytest

import ssm_decouple as ssm

UR5 = "ur_description/urdf/ur5_robot.urdf"
MOUNT = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.4, 1.2), np.array([-0.79, -0.29, 1.0]))


@pytest.mark.parametrize(
    ("path", "tip"),
    [
        (UR5, "tool0"),
        ("panda_description/urdf/panda.urdf", "panda_hand_tcp"),
        ("kinova_description/robots/kinova.urdf", "j2s6s200_end_effector"),
    ],
)
def test_the_whole_equals_bus_and_arm_side_by_side(path, tip, rng):
    """Momentum of the composed robot against Pinocchio's own way of joining two models."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*it has joints that mimic others", ssm.DecoupleWarning)  # Panda's fingers
        robot = ssm.compose("ets_vii_bus", ssm.example_robot(path), MOUNT, end_effector=tip, prefix="a_")
    bus = pin.buildModelFromUrdf(str(ssm.models()["ets_vii_bus"]), pin.JointModelFreeFlyer())
    arm = pin.buildModelFromUrdf(str(ssm.example_robot(path)))
    joined = pin.appendModel(bus, arm, bus.getFrameId("bus"), MOUNT)
    assert [name.removeprefix("a_") for name in robot.joint_names] == list(joined.names)[2:]
    assert robot.end_effector == "a_" + tip
    data = joined.createData()
    for _ in range(5):
        q = robot.configuration(rng.uniform(-1, 1, robot.n_joints))
        pin.computeCentroidalMap(joined, data, q)
        np.testing.assert_allclose(robot.coupling(q).H_wq, data.Ag[3:, 6:], rtol=1e-12, atol=1e-10)
        pin.framesForwardKinematics(joined, data, q)
        np.testing.assert_allclose(
            robot.frame_pose(q).homogeneous, data.oMf[joined.getFrameId(tip)].homogeneous, atol=1e-13
        )


def test_the_composed_urdf_loads_again_from_its_text(write):
    robot = ssm.compose("ets_vii_bus", ssm.example_robot(UR5), [0, 0, 1.0], end_effector="tool0")
    again = ssm.load_robot(write(robot.urdf), end_effector="tool0")
    assert again.joint_names == robot.joint_names
    assert again.mass == robot.mass


def test_two_arms_on_one_bus():
    one = ssm.compose("ets_vii_bus", ssm.example_robot(UR5), [0.5, 0, 1.0], prefix="left_", end_effector="tool0")
    two = ssm.compose(one, ssm.example_robot(UR5), [-0.5, 0, 1.0], prefix="right_", end_effector="tool0")
    assert two.n_joints == 12
    assert two.end_effector == "right_tool0"
    assert two.mass == pytest.approx(2 * one.mass - 2550)


def test_an_arm_can_be_mounted_on_any_link():
    on_tip = ssm.compose("ets_vii", ssm.example_robot(UR5), [0, 0, 0], mount_link="end_effector", end_effector="tool0")
    assert on_tip.n_joints == 12
    q = on_tip.configuration()
    np.testing.assert_allclose(
        on_tip.frame_pose(q, "world").translation, on_tip.frame_pose(q, "end_effector").translation
    )


@pytest.mark.parametrize("mount", [np.diag([-1.0, 1, 1, 1]), np.zeros((4, 4)), 2 * np.eye(4), "abc", [[1], [2, 3]]])
def test_what_is_no_mount_is_refused(mount):
    with pytest.raises(ssm.InputError, match="mount is"):
        ssm.compose("ets_vii_bus", ssm.example_robot(UR5), mount, end_effector="tool0", prefix="a_")


def test_what_cannot_be_composed_is_refused():
    with pytest.raises(
        ssm.ModelError, match=r"share the link names bus, link_1, link_2, \.\.; give compose another prefix"
    ):
        ssm.compose("ets_vii", "ets_vii_flight", [0, 0, 0])
    with pytest.raises(ssm.ModelError, match="has no link 'roof'; it has bus"):
        ssm.compose("ets_vii_bus", ssm.example_robot(UR5), [0, 0, 0], mount_link="roof")
    with pytest.raises(ssm.ModelError, match="has 2 tips"):
        ssm.compose("ets_vii_bus", ssm.example_robot(UR5), [0, 0, 0])
    with pytest.raises(ssm.ModelError, match="no link 'hand' for its end-effector; it has base_link, shoulder_link"):
        ssm.compose("ets_vii_bus", ssm.example_robot(UR5), [0, 0, 0], end_effector="hand")
    with pytest.raises(ssm.InputError, match=r"mount is not finite"):
        ssm.compose("ets_vii_bus", ssm.example_robot(UR5), [0, 0, np.nan], end_effector="tool0")
    with pytest.raises(
        ssm.ModelError, match=r"example-robot-data has no 'ur_description/urdf/ur6.urdf'; it has ur_desc"
    ):
        ssm.example_robot("ur_description/urdf/ur6.urdf")
