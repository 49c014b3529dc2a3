from __future__ import annotations

import warnings

import numpy as np
import pinocchio as pin
import pytest
from random_robots import random_robot, random_state, random_urdf

import ssm_decouple as ssm

BUS = (
    '<link name="bus"><inertial><mass value="100"/>'
    '<inertia ixx="9" ixy="0" ixz="0" iyy="9" iyz="0" izz="9"/></inertial></link>'
)
BODY = (
    '<inertial><origin xyz="0.5 0 0"/><mass value="2"/>'
    '<inertia ixx=".1" ixy="0" ixz="0" iyy=".1" iyz="0" izz=".1"/></inertial>'
)
LIMIT = '<limit lower="-1" upper="1" effort="1" velocity="0.1"/>'


def arm(kind: str = "revolute", limit: str = LIMIT, body: str = BODY, extra: str = "") -> str:
    joint = (
        f'<joint name="elbow" type="{kind}"><parent link="bus"/><child link="arm"/><axis xyz="0 0 1"/>{limit}</joint>'
    )
    return f'<robot name="r">{BUS}<link name="arm">{body}</link>{joint}{extra}</robot>'


def joint(name: str, parent: str, child: str) -> str:
    return f'<joint name="{name}" type="fixed"><parent link="{parent}"/><child link="{child}"/></joint>'


def test_a_joint_and_a_link_may_share_a_name(write):
    text = arm(extra="<link name='tip'/>" + joint("tip", "arm", "tip"))
    robot = ssm.load_robot(write(text))
    assert robot.end_effector == "tip"
    np.testing.assert_array_equal(robot.frame_pose(robot.configuration(), "tip").translation, 0)


def test_configuration_from_an_array_and_by_name_agree(robot, rng):
    values = rng.uniform(-1, 1, robot.n_joints)
    by_name = dict(zip(robot.joint_names, values, strict=True))
    shuffled = dict(sorted(by_name.items(), key=lambda item: hash(item[0])))
    q = robot.configuration(values)
    np.testing.assert_array_equal(q, robot.configuration(shuffled))
    np.testing.assert_allclose(robot.joint_positions(q), values, atol=1e-15)


def test_missing_names_are_zero_and_the_base_pose_is_kept(ets_vii):
    pose = pin.SE3(pin.rpy.rpyToMatrix(0.1, -0.2, 0.3), np.array([1.0, 2.0, 3.0]))
    q = ets_vii.configuration({"joint_3": 0.7}, pose)
    np.testing.assert_allclose(ets_vii.joint_positions(q), [0, 0, 0.7, 0, 0, 0], atol=1e-16)
    np.testing.assert_allclose(ets_vii.base_pose(q).homogeneous, pose.homogeneous, atol=1e-15)
    np.testing.assert_array_equal(q, ets_vii.configuration([0, 0, 0.7, 0, 0, 0], pose.homogeneous))


def test_a_continuous_joint_turns_and_a_prismatic_one_slides(write):
    turning = ssm.load_robot(write(arm("continuous", "")))
    assert (turning.model.nq, turning.model.nv) == (9, 7)
    q = turning.configuration([2.5])
    np.testing.assert_allclose(turning.frame_pose(q).rotation, pin.rpy.rpyToMatrix(0, 0, 2.5), atol=1e-15)
    assert turning.rate_limits[0] == np.inf
    assert np.all(np.isinf(turning.position_limits))
    sliding = ssm.load_robot(write(arm("prismatic")))
    np.testing.assert_allclose(sliding.frame_pose(sliding.configuration([0.3])).translation, [0, 0, 0.3], atol=1e-16)
    assert sliding.reach == 1.0  # its stroke


def test_branches_are_mapped_by_name(write):
    """Pinocchio orders sibling branches by name, not as the file does."""
    second = (
        f'<link name="left">{BODY}</link><joint name="a_left" type="prismatic"><parent link="bus"/>'
        f'<child link="left"/><axis xyz="1 0 0"/>{LIMIT}</joint>'
    )
    robot = ssm.load_robot(write(arm(extra=second)), end_effector="left")
    assert robot.joint_names == ("a_left", "elbow")
    q = robot.configuration({"elbow": 0.4, "a_left": 0.2})
    np.testing.assert_allclose(robot.frame_pose(q, "left").translation, [0.2, 0, 0], atol=1e-16)
    np.testing.assert_allclose(robot.frame_pose(q, "arm").rotation, pin.rpy.rpyToMatrix(0, 0, 0.4), atol=1e-15)


def test_reach_bounds_the_distance_from_the_first_joint(robot, rng):
    for _ in range(20):
        q = robot.configuration(rng.uniform(-1, 1, robot.n_joints))
        distance = np.linalg.norm(robot.frame_pose(q).translation - robot.shoulder_position(q))
        assert distance <= robot.reach + 1e-12


def test_ets_vii_reaches_as_far_as_its_links(ets_vii):
    q = ets_vii.configuration(np.deg2rad([0, 0, 90, 0, 0, 0]))  # the elbow pitches about -y: forearm straight up
    distance = np.linalg.norm(ets_vii.frame_pose(q).translation - ets_vii.shoulder_position(q))
    assert ets_vii.reach == pytest.approx(0.35 + 0.87 + 0.63 + 0.26 + 0.28 + 0.53)
    assert distance == pytest.approx(ets_vii.reach)


def test_momentum_of_a_motion_is_the_sum_over_bodies(robot, rng):
    for _ in range(5):
        q, v = random_state(robot, rng), rng.normal(size=robot.model.nv)
        model, data = robot.model, robot.model.createData()
        pin.forwardKinematics(model, data, q, v)
        centre = pin.centerOfMass(model, data, q)
        linear, angular = np.zeros(3), np.zeros(3)
        for body in range(1, model.njoints):
            pose, velocity, inertia = data.oMi[body], data.v[body], model.inertias[body]
            at = pose.act(inertia.lever)
            moving = pose.rotation @ (velocity.linear + np.cross(velocity.angular, inertia.lever))
            linear += inertia.mass * moving
            angular += inertia.mass * np.cross(at - centre, moving)
            angular += pose.rotation @ inertia.inertia @ velocity.angular
        np.testing.assert_allclose(robot.momentum(q, v), [*linear, *angular], rtol=1e-10, atol=1e-10 * robot.mass)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("not xml at all", "is not XML"),
        ("<urdf/>", "root is <urdf>, expected <robot>"),
        ('<robot name="r" xmlns:xacro="http://ros.org/wiki/xacro"><xacro:macro/></robot>', "xacro"),
        ('<robot name="r"/>', "has no <link>"),
        ('<robot name="r"><link name="a"/><link name="b"/></robot>', "exactly one root link"),
        ('<robot name="r"><link name="a"/></robot>', "no link has mass"),
        (
            arm(extra="<link name='x'/><link name='y'/>" + joint("p", "x", "y") + joint("q", "y", "x")),
            "links x, y form a loop",
        ),
        (arm().replace('<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>'), 'joint elbow: <axis xyz="0 0 0"> needs 3 finite'),
        (arm().replace('origin xyz="0.5 0 0"', 'origin xyz="0.5 0"'), 'link arm: <origin xyz="0.5 0"> needs 3 finite'),
        (arm().replace('mass value="2"', 'mass value="2_0"'), "'2_0' is not a number"),
        (arm().replace('<robot name="r">', "<robot>"), "robot: has no name"),
        (arm("planar"), "joint elbow: type 'planar' is not supported"),
        (arm().replace('<child link="arm"/>', '<child link="arn"/>'), "child link 'arn' does not exist"),
        (arm(extra="<link name='bus'/>"), "link bus: this name stands 2 times"),
        (arm().replace('mass value="2"', 'mass value="-2"'), "link arm: mass -2 kg"),
        (arm().replace('mass value="2"', 'mass value="two"'), "malformed"),
        (arm().replace('<mass value="2"/>', ""), "lacks <mass value=..>"),
        (arm().replace('ixx=".1"', 'ixx="nan"'), "link arm: inertia is not finite"),
        (
            '<robot name="r"><link name="a"><inertial><mass value="1"/>'
            '<inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial></link></robot>',
            "H_ww is singular",
        ),
    ],
)
def test_an_impossible_urdf_is_refused_with_the_reason(write, text, says):
    with pytest.raises(ssm.ModelError, match="robot") as caught:
        ssm.load_robot(write(text))
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_is_no_robot_is_refused(tmp_path):
    with pytest.raises(ssm.ModelError, match=r"neither a file nor a robot of the catalogue \(ets_vii"):
        ssm.load_robot("ets_vi")
    with pytest.raises(ssm.ModelError, match="is a folder"):
        ssm.load_robot(tmp_path)
    (tmp_path / "robot.urdf").write_bytes(b"\xff\xfe\x00binary\x80")
    with pytest.raises(ssm.ModelError, match="not text"):
        ssm.load_robot(tmp_path / "robot.urdf")


def test_an_unknown_end_effector_is_refused_with_the_names(write):
    with pytest.raises(ssm.ModelError, match="no frame 'hand' for its end-effector; it has bus, link_1"):
        ssm.load_robot("ets_vii", end_effector="hand")
    with pytest.raises(ssm.ModelError, match="has 2 tips: name one as end_effector: ee_link, tool0"):
        ssm.load_robot(ssm.example_robot("ur_description/urdf/ur5_robot.urdf"))


@pytest.mark.parametrize(
    ("joints", "says"),
    [
        ([0, 0], r"shape \(2,\), 'ets_vii' needs \(6,\): joint_1"),
        ([0, 0, np.nan, 0, 0, 0], "not finite at joint_3"),
        ({"joint_7": 1.0}, "no joint 'joint_7'; it has joint_1"),
        ({"joint_2": np.inf}, "not finite at joint_2"),
    ],
)
def test_bad_joint_positions_are_refused(ets_vii, joints, says):
    with pytest.raises(ssm.InputError, match=says):
        ets_vii.configuration(joints)


def test_bad_configurations_are_refused(ets_vii):
    q = ets_vii.configuration()
    with pytest.raises(ssm.InputError, match=r"shape \(12,\), 'ets_vii' needs \(13,\)"):
        ets_vii.coupling(q[:-1])
    with pytest.raises(ssm.InputError, match=r"not finite at q\[8\]"):
        ets_vii.coupling(np.where(np.arange(13) == 8, np.nan, q))
    with pytest.raises(ssm.InputError, match="length 2, not 1"):
        ets_vii.coupling(np.where(np.arange(13) == 6, 2.0, q))
    with pytest.raises(ssm.InputError, match="velocity needs 12 finite numbers"):
        ets_vii.momentum(q, np.zeros(6))
    with pytest.raises(ssm.InputError, match="is no rigid pose"):
        ets_vii.configuration(base_pose=2 * np.eye(4))
    with pytest.raises(ssm.InputError, match="homogeneous matrix"):
        ets_vii.configuration(base_pose=np.eye(3))
    with pytest.raises(ssm.InputError, match="no frame 'hand'"):
        ets_vii.frame_pose(q, "hand")


def test_a_strange_inertia_warns_once_with_the_link(write):
    text = arm().replace('izz=".1"', 'izz=".9"')
    with pytest.warns(ssm.DecoupleWarning, match=r"link arm: principal moments .* break the triangle inequality"):
        ssm.load_robot(write(text))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ssm.load_robot(write(arm()))


def test_the_report_tells_what_is_suspicious(write):
    text = arm(limit='<limit lower="1" upper="-1" effort="1" velocity="0"/><mimic joint="elbow"/>')
    path = write(text.replace('izz=".1"', 'izz="-.1"'), "odd.urdf")
    with pytest.warns(ssm.DecoupleWarning):
        report = ssm.Report.of_file(path)
    said = str(report)
    assert report.usable
    for words in ("no velocity limit", "leave it no room", "<mimic> is not followed", "negative principal moment"):
        assert words in said
    assert report.to_dict()["joints"][0]["rate_limit"] is None


def test_the_report_of_an_impossible_file_lists_everything(write):
    broken = arm("spherical", body=BODY.replace('value="2"', 'value="-2"'))
    report = ssm.Report.of_file(write(broken))
    assert not report.usable
    assert len([finding for finding in report.findings if finding.level == "impossible"]) == 2
    assert "cannot be used" in str(report)


def test_the_report_of_a_good_robot(ets_vii):
    report = ets_vii.report()
    assert report.usable
    assert report.mass == pytest.approx(2690.4)
    assert report.base_mass == 2550
    assert [joint.mass for joint in report.joints] == [35.0, 22.5, 21.9, 16.5, 26.0, 18.5]
    assert [joint.moves for joint in report.joints] == [f"link_{i}" for i in range(1, 7)]
    assert "nothing suspicious" in str(report)


def test_random_trees_load_with_every_kind_of_joint():
    kinds = {word for seed in range(8) for word in ("continuous", "prismatic", "fixed") if word in random_urdf(seed)}
    assert kinds == {"continuous", "prismatic", "fixed"}
    assert random_robot(3, joints=7).n_joints == 7


def test_nothing_pulls_on_the_robot(robot):
    """Pinocchio's own gravity would be in everything that a user computes with `robot.model`."""
    import pinocchio as pin

    model = robot.model
    assert np.all(pin.nle(model, model.createData(), robot.configuration(), np.zeros(model.nv)) == 0.0)
