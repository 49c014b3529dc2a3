"""What Pinocchio holds is what the file says, however it is written, or the file is refused by name."""

from __future__ import annotations

import os
import warnings
import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_robots import random_robot, random_urdf
from test_robot import BODY, BUS, LIMIT, arm, joint
from urdf_oracle import assert_holds
from urdf_rewriting import HEADS, WAYS, rewritten

import ssm_decouple as ssm
from ssm_decouple.model.plain import parser_heard, plain_urdf, said_of
from ssm_decouple.model.reading import Reading
from ssm_decouple.model.urdf import parse_urdf
from ssm_decouple.model.verify import refuse_other_numbers


def in_order_of(robot: ssm.Robot, other: ssm.Robot) -> list[int]:
    """Return the place in `other` of each joint of `robot`: by the mass it moves, as names may differ."""
    masses = [other.model.inertias[i + 2].mass for i in range(other.n_joints)]
    return [int(np.argmin(np.abs(np.array(masses) - robot.model.inertias[i + 2].mass))) for i in range(robot.n_joints)]


def assert_same(robot: ssm.Robot, other: ssm.Robot, seed: int = 0) -> None:
    places, rng = in_order_of(robot, other), np.random.default_rng(seed)
    assert sorted(places) == list(range(robot.n_joints))
    angles = rng.uniform(-2, 2, robot.n_joints)
    theirs = np.empty(robot.n_joints)
    theirs[places] = angles
    one, two = robot.coupling(robot.configuration(angles)), other.coupling(other.configuration(theirs))
    scale = np.abs(one.H_ww).max()
    np.testing.assert_allclose(two.H_ww, one.H_ww, rtol=1e-12, atol=1e-12 * scale)
    np.testing.assert_allclose(two.H_wq[:, places], one.H_wq, rtol=1e-12, atol=1e-12 * scale)
    np.testing.assert_allclose(two.J_rc[:, places], one.J_rc, rtol=1e-12, atol=1e-12)
    tool, same = robot.frame_pose(robot.configuration(angles)), other.frame_pose(other.configuration(theirs))
    np.testing.assert_allclose(same.homogeneous, tool.homogeneous, atol=1e-12 * (1 + min(robot.reach, 100.0)))
    for name in ("position_limits", "rate_limits"):
        np.testing.assert_array_equal(getattr(other, name)[places], getattr(robot, name))
    np.testing.assert_array_equal(other.model.effortLimit[6:][places], robot.model.effortLimit[6:])


@settings(max_examples=40)
@given(
    seed=st.integers(0, 10_000),
    joints=st.integers(1, 7),
    ways=st.lists(st.sampled_from(list(WAYS)), unique=True),
    head=st.sampled_from(list(HEADS)),
)
def test_the_same_robot_in_other_words(seed, joints, ways, head):
    plain = random_robot(seed, joints)
    text = rewritten(random_urdf(seed, joints), ways, head, seed)
    robot = ssm.Robot(text, name="rewritten", end_effector="end_effector")
    assert_holds(robot, text)
    assert_same(plain, robot, seed)
    # What is kept of it, and what any other tool reads, says the same.
    assert said_of(robot.urdf) == [] or "silent elements" in ways
    again = ssm.Robot(robot.urdf, name="again", end_effector="end_effector")
    assert again.urdf == robot.urdf
    assert_same(plain, again, seed)


@pytest.mark.parametrize("way", WAYS)
def test_what_is_built_on_it_keeps_it(way, write):
    """Each way into a robot goes through the same reading."""
    text = random_urdf(5, 4)
    plain, other = write(text, "plain.urdf"), write(rewritten(text, [way], "plain", 3), "other.urdf")
    wheel = [ssm.Wheel("wheel", [0, 0, 1], spin_inertia=0.01, max_speed=600.0, max_torque=0.2, mass=0.123)]

    def built(path):
        robot = ssm.load_robot(path, end_effector="end_effector")
        yield robot
        yield robot.with_wheels(wheel)
        yield robot.with_payload(3.3, [0.1, 0, 0], np.eye(3))
        yield robot.with_locked({robot.joint_names[in_order_of(random_robot(5, 4), robot)[1]]: 0.3})
        yield ssm.compose("ets_vii_bus", path, [0, 0, 1], prefix="arm_", end_effector="end_effector")
        yield ssm.compose(path, "ets_vii", [0, 0, 1], prefix="arm_", end_effector="end_effector")

    for one, two in zip(built(plain), built(other), strict=True):
        assert_same(one, two)


def test_a_toml_robot_and_its_plant_keep_it(tmp_path):
    source = ssm.models()["ets_vii_flexible"].read_text(encoding="utf-8")
    urdf = ssm.models()["ets_vii"].read_text(encoding="utf-8")
    (tmp_path / "bus.urdf").write_text(rewritten(urdf, ["white space", "quaternions"], "plain", 1), encoding="utf-8")
    (tmp_path / "robot.toml").write_text(source.replace('urdf = "ets_vii.urdf"', 'urdf = "bus.urdf"'), encoding="utf-8")
    assert 'urdf = "bus.urdf"' in (tmp_path / "robot.toml").read_text(encoding="utf-8")
    one, two = ssm.load_robot("ets_vii_flexible"), ssm.load_robot(tmp_path / "robot.toml")
    assert_same(one, two)
    np.testing.assert_allclose(ssm.Plant.of(two).frequencies(), ssm.Plant.of(one).frequencies(), rtol=1e-11)


@pytest.mark.parametrize("name", ["ets_vii", "ets_vii_bus", "ets_vii_flight", "seven_joint", "two_arms"])
def test_a_plain_file_is_kept_as_it_is(name):
    text = ssm.models()[name].read_text(encoding="utf-8")
    tool = "end_effector" if name != "two_arms" else None
    robot = ssm.Robot(text, name=name, end_effector=tool if name != "ets_vii_bus" else None)
    assert robot.urdf == text
    assert_holds(robot, text)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "latin-1"])
def test_files_in_other_encodings(tmp_path, encoding):
    text = arm().replace('"elbow"', '"Gelenk für alles"')
    declared = f'<?xml version="1.0" encoding="{encoding.removesuffix("-sig")}"?>{text}'
    (tmp_path / "robot.urdf").write_bytes(declared.encode(encoding))
    robot = ssm.load_robot(tmp_path / "robot.urdf")
    assert robot.joint_names == ("Gelenk für alles",)
    (tmp_path / "saved.urdf").write_text(robot.urdf, encoding="utf-8")
    assert_same(robot, ssm.load_robot(tmp_path / "saved.urdf"))


AXIS = '<axis xyz="0 0 1"/>'
CENTRE = '<origin xyz="0.5 0 0"/>'
MASS = '<mass value="2"/>'
TENSOR = '<inertia ixx=".1" ixy="0" ixz="0" iyy=".1" iyz="0" izz=".1"/>'


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        *(
            (MASS, f'<mass value="{bad}"/>', "link arm: <mass value")
            for bad in ("1,5", "0x10", "1.0f", "1d3", "\u22122", "\u0662")
        ),
        (MASS, '<mass value="1e400"/>', "beyond the largest number"),
        (MASS, '<mass value="inf"/>', "link arm: mass inf kg"),
        (MASS, '<mass value=""/>', 'link arm: <mass value="">'),
        (MASS, MASS + MASS, "link arm: has 2 <mass>"),
        (MASS, "<mass>2</mass>", "link arm: <mass> has the text '2'"),
        (MASS, '<Mass value="2"/>', "link arm: <Mass> is not read: write <mass>"),
        (MASS, '<mass values="2"/>', "link arm: <mass values=..> is not read: write value"),
        (MASS, '<mass value="2" unit="t"/>', "link arm: <mass unit=..> is not read"),
        ('izz=".1"', 'izz=".1 .1"', 'link arm: <inertia izz=".1 .1">'),
        ('iyz="0" izz=".1"', 'izz=".1"', "link arm: <inertial> lacks <inertia iyz"),
        ('iyz="0" izz=".1"', 'Iyz="0" izz=".1"', "link arm: <inertia Iyz=..> is not read: write iyz"),
        (TENSOR, "", "link arm: <inertial> lacks <inertia ixx"),
        (CENTRE, '<origin xyz="0.5 0 0" rpy="0 0 inf"/>', 'link arm: <origin rpy="0 0 inf"> needs 3 finite'),
        (CENTRE, '<origin xyz="0.5 0 0" rpy="0 0 0" quat_xyzw="0 0 0 1"/>', "link arm: <origin> has both rpy and quat"),
        (CENTRE, '<origin quat_xyzw="0 0 0 2"/>', "link arm: <origin quat_xyzw="),
        (CENTRE, '<origin quat_xyzw="0 0 0 0"/>', "link arm: <origin quat_xyzw="),
        (CENTRE, '<origin xyz="0.5 0 0" quat_wxyz="1 0 0 0"/>', "link arm: <origin quat_wxyz=..> is not read"),
        (CENTRE, '<origin XYZ="0.5 0 0"/>', "link arm: <origin XYZ=..> is not read: write xyz"),
        (CENTRE, '<orgin xyz="0.5 0 0"/>', "link arm: <orgin> is not read: write <origin>"),
        (CENTRE, CENTRE + CENTRE, "link arm: has 2 <origin>"),
        (BODY, BODY + BODY, "link arm: has 2 <inertial>"),
        (BODY, MASS + TENSOR, "link arm: <mass> is not read in <link>"),
        (BODY, '<origin xyz="0 0 1"/>' + BODY, "link arm: <origin> is not read in <link>"),
        (BODY, BODY.replace("inertial", "Inertial"), "link arm: <Inertial> is not read: write <inertial>"),
        (AXIS, AXIS + AXIS, "joint elbow: has 2 <axis>"),
        (AXIS, "<axis>0 0 1</axis>", "joint elbow: <axis> has the text '0 0 1'"),
        (AXIS, "<axis><xyz>0 0 1</xyz></axis>", "joint elbow: <axis> has <xyz> inside"),
        (AXIS, '<axis XYZ="0 0 1"/>', "joint elbow: <axis XYZ=..> is not read: write xyz"),
        (AXIS, "<axis/>", "joint elbow: <axis"),
        (AXIS, 'axis xyz="0 0 1"/&gt;', "joint elbow: has the text 'axis xyz="),
        (AXIS, AXIS + BODY, "joint elbow: <inertial> is not read in <joint>"),
        (LIMIT, LIMIT + LIMIT, "joint elbow: has 2 <limit>"),
        (LIMIT, LIMIT.replace('"0.1"', '"nan"'), 'joint elbow: <limit velocity="nan">'),
        (LIMIT, LIMIT.replace('"0.1"', '"1e400"'), 'joint elbow: <limit velocity="1e400">'),
        (LIMIT, LIMIT.replace('"0.1"', '"fast"'), 'joint elbow: <limit velocity="fast">'),
        (LIMIT, LIMIT.replace('"-1"', '"inf"'), 'joint elbow: <limit lower="inf">'),
        (LIMIT, LIMIT.replace("lower", "Lower"), "joint elbow: <limit Lower=..> is not read: write lower"),
        (LIMIT, LIMIT + '<dynamics damping="x"/>', 'joint elbow: <dynamics damping="x">'),
        ('"elbow"', '"universe"', "joint universe: Pinocchio calls its own world 'universe'"),
        ('"elbow"', '""', "joint : has no name"),
        ('"revolute"', '"Revolute"', "joint elbow: type 'Revolute' is not supported"),
        ('"revolute"', '"planar"', "joint elbow: type 'planar' is not supported"),
        ('"revolute"', '"floating"', "joint elbow: a floating joint between parts"),
        ("</robot>", '<Link name="lost"/></robot>', "robot: <Link> is not read there: write <link>"),
        ("</robot>", "link</robot>", "robot: has the text 'link'"),
        ('<child link="arm"/>', '<child link="arm "/>', "joint elbow: its child link 'arm ' does not exist"),
    ],
)
def test_what_would_be_overlooked_is_refused_by_name(old, new, says):
    text = arm()
    assert old in text
    text = text.replace(old, new)
    with pytest.raises(ssm.ModelError) as caught:
        ssm.Robot(text, name="r")
    assert says in str(caught.value)


def found(text: str, **options: str) -> tuple[ssm.Robot, str]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ssm.DecoupleWarning)
        robot = ssm.Robot(text, name="r", **options)
    return robot, "\n".join(f"{finding.level} {finding}" for finding in robot.report().findings)


@pytest.mark.parametrize(
    ("text", "limits", "says"),
    [
        (arm(limit=""), (-np.inf, np.inf, np.inf), "suspicious joint elbow: a revolute joint without <limit>"),
        (arm("prismatic", ""), (-np.inf, np.inf, np.inf), "suspicious joint elbow: a prismatic joint without <limit>"),
        (
            arm(limit='<limit effort="1" velocity="2"/>'),
            (-np.inf, np.inf, 2),
            "suspicious joint elbow: its <limit> gives it no position limits",
        ),
        (
            arm(limit='<limit upper="1" effort="1" velocity="2"/>'),
            (0, 1, 2),
            "suspicious joint elbow: its <limit> lacks lower, which URDF takes as 0",
        ),
        (
            arm(limit='<limit lower="-1" upper="1" effort="1"/>'),
            (-1, 1, np.inf),
            "suspicious joint elbow: its <limit> gives no velocity limit",
        ),
        (arm(limit='<limit lower="-1" upper="1" velocity="2"/>'), (-1, 1, 2), "note joint elbow: no effort limit"),
        (
            arm(limit='<limit lower="-1" upper="1" velocity="2" effort=" inf"/>'),
            (-1, 1, 2),
            "note joint elbow: no effort limit",
        ),
        (
            arm("continuous", '<limit lower="-2" upper="2" effort="1" velocity="2"/>'),
            (-np.inf, np.inf, 2),
            "suspicious joint elbow: its limits -2 to 2 are not kept",
        ),
        (
            arm(limit='<limit lower="-170" upper="170" effort="1" velocity="2"/>'),
            (-170, 170, 2),
            "suspicious joint elbow: position limits -170 to 170 rad, more than two turns: degrees?",
        ),
        (
            arm(limit='<limit lower="-2" upper="2" effort="1" velocity="180"/>'),
            (-2, 2, 180),
            "suspicious joint elbow: velocity limit 180 rad/s: degrees?",
        ),
        (arm(limit=LIMIT + "<dynamics/>"), (-1, 1, 0.1), "note joint elbow: its <dynamics> is empty"),
        (arm().replace(CENTRE, '<origin rpy="90 0 0"/>'), (-1, 1, 0.1), 'suspicious link arm: <origin rpy="90 0 0">'),
        (arm().replace(MASS, '<mass value="0"/>'), (-1, 1, 0.1), "suspicious link arm: zero mass but an inertia"),
        (arm().replace('".1"', '"0"'), (-1, 1, 0.1), "suspicious link arm: mass 2 kg but no inertia"),
        (
            arm(extra='<material name="a"><color rgba="1 0 0 1"/></material>' * 2),
            (-1, 1, 0.1),
            "note material a: stands twice",
        ),
    ],
)
def test_what_is_completed_or_strange_is_told(text, limits, says):
    robot, said = found(text)
    assert says in said
    assert (*robot.position_limits[0], robot.rate_limits[0]) == limits
    assert_holds(robot, text)
    again, _ = found(robot.urdf)  # and any other reader takes it
    assert_same(robot, again)


def test_usual_numbers_are_not_suspicious():
    for kind, limit in (
        ("revolute", '<limit lower="-6.2832" upper="6.2832" effort="1" velocity="30"/>'),
        ("revolute", '<limit lower="-1e9" upper="1e9" effort="1" velocity="10"/>'),
        ("continuous", '<limit effort="1" velocity="600"/>'),  # a wheel
        ("prismatic", '<limit lower="0" upper="100" effort="1" velocity="100"/>'),
    ):
        assert "degrees" not in found(arm(kind, limit))[1]


def test_a_mimic_joint_is_told_on_loading(write):
    second = '<link name="other"/><joint name="follower" type="revolute"><parent link="arm"/><child link="other"/>'
    text = arm(extra=f'{second}{LIMIT}<mimic joint="elbow" multiplier="-1"/></joint>')
    with pytest.warns(ssm.DecoupleWarning, match="joint follower: <mimic> is not followed.*'elbow'.*with_locked"):
        robot = ssm.load_robot(write(text), end_effector="arm")
    assert "suspicious joint follower: <mimic>" in "\n".join(f"{f.level} {f}" for f in robot.report().findings)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert robot.with_locked({"follower": 0.1}).joint_names == ("elbow",)
        for other in (robot.with_payload(1.0, [0, 0, 0], np.eye(3)), ssm.perturbed(robot, ssm.Tolerances(mass=0.1), 1)):
            assert other.n_joints == 2


WORLD = '<link name="world"/><joint name="free" type="floating"><parent link="world"/><child link="bus"/></joint>'


def test_a_robot_may_say_that_it_floats():
    robot, said = found(arm(extra=WORLD))
    plain, _ = found(arm())
    assert_same(plain, robot)
    assert robot.link_names == ("bus", "arm")
    assert "note joint free: the robot floats by itself" in said
    with pytest.raises(ssm.ModelError, match=r"no frame 'world'.*floats by itself"):
        ssm.Robot(arm(extra=WORLD), name="r", end_effector="world")


@pytest.mark.parametrize(
    "extra",
    [
        WORLD.replace('<link name="world"/>', f'<link name="world">{BODY}</link>'),
        WORLD
        + WORLD.replace("bus", "table")
        .replace('"free"', '"too"')
        .replace('<link name="world"/>', BUS.replace("bus", "table")),
    ],
)
def test_two_floating_bodies_are_no_robot(extra):
    with pytest.raises(ssm.ModelError, match="joint free: a floating joint between parts"):
        ssm.Robot(arm(extra=extra), name="r")


def test_pinocchios_world_is_no_frame_of_the_robot():
    robot, _ = found(arm())
    for name in ("universe",):
        with pytest.raises(ssm.InputError, match="no frame"):
            robot.frame_id(name)
        with pytest.raises(ssm.ModelError, match="no frame"):
            ssm.Robot(arm(), name="r", end_effector=name)
    named, _ = found(arm().replace('"arm"', '"universe"'))
    assert named.frame_id("universe") == named.end_effector_id > 0


SEED = 3


def _changed(model: pin.Model, what: str) -> None:
    """Change one number a little, as a reader that rounds might."""
    joint, off = 2, 1e-9
    body, place = model.inertias[joint], model.jointPlacements[joint]
    if what == "mass":
        model.inertias[joint] = pin.Inertia(body.mass * (1 + off), body.lever, body.inertia)
    elif what == "centre of mass":
        model.inertias[joint] = pin.Inertia(body.mass, body.lever + off, body.inertia)
    elif what == "inertia":
        model.inertias[joint] = pin.Inertia(body.mass, body.lever, body.inertia * (1 + off))
    elif what == "translation":
        model.jointPlacements[joint] = pin.SE3(place.rotation, place.translation + off)
    elif what == "rotation":
        model.jointPlacements[joint] = pin.SE3(place.rotation @ pin.exp3(np.full(3, off)), place.translation)
    elif what == "frame":
        frame = model.frames[model.getFrameId("end_effector")]
        model.frames[model.getFrameId("end_effector")].placement = frame.placement * pin.SE3(np.eye(3), np.full(3, off))
    elif what == "base":
        body = model.inertias[1]
        model.inertias[1] = pin.Inertia(body.mass, body.lever, body.inertia + off * np.eye(3))
    else:
        values = getattr(
            model, {"lower": "lowerPositionLimit", "upper": "upperPositionLimit"}.get(what, f"{what}Limit")
        )
        values[-1] *= 1 + off


@pytest.mark.parametrize(
    "what",
    [
        "mass",
        "centre of mass",
        "inertia",
        "translation",
        "rotation",
        "frame",
        "base",
        "lower",
        "upper",
        "velocity",
        "effort",
    ],
)
def test_a_model_that_is_off_by_a_billionth_is_refused(what):
    text = random_urdf(SEED, 4)
    robot = random_robot(SEED, 4)
    assert robot.model.joints[robot.n_joints + 1].nq == 1  # the last one has limits
    reading = Reading.of(parse_urdf(text, "r"))
    refuse_other_numbers(robot.model, reading)
    _changed(robot.model, what)
    with pytest.raises(ssm.ModelError, match=r"^(links?|joint) .*: its .* in the file but .* as Pinocchio reads it"):
        refuse_other_numbers(robot.model, reading)


def test_other_joints_are_refused():
    reading = Reading.of(parse_urdf(random_urdf(SEED, 4), "r"))
    with pytest.raises(ssm.ModelError, match=r"^(links?|joint) "):
        refuse_other_numbers(random_robot(SEED + 1, 4).model, reading)
    with pytest.raises(ssm.ModelError, match="other joints"):
        refuse_other_numbers(random_robot(SEED, 5).model, reading)


def test_nothing_is_written_on_the_terminal(capfd):
    for text in (arm(limit=LIMIT + "<dynamics/>"), arm(limit=""), arm(extra='<material name="a"/>' * 2)):
        found(text)
    for text in (arm("planar"), arm(limit=LIMIT.replace('"1"', '"x"'))):
        with pytest.raises(ssm.ModelError):
            found(text)
    assert capfd.readouterr() == ("", "")


def test_what_the_parser_says_is_heard_and_the_terminal_given_back(capfd):
    def fails(said):
        with parser_heard(said):
            os.write(2, b"Error:   joint [elbow]: limit has no effort\n         at line 176 in /x/joint.cpp\n")
            raise RuntimeError("mine")

    with pytest.raises(RuntimeError, match="mine"):
        fails(said := [])
    assert said == ["joint [elbow]: limit has no effort"]
    os.write(2, b"afterwards\n")
    assert capfd.readouterr().err == "afterwards\n"
    assert any("elbow" in line for line in said_of(arm(limit=LIMIT.replace('effort="1"', ""))))
    assert capfd.readouterr() == ("", "")


def test_check_tells_of_what_other_readers_refuse(write):
    shape = '<visual><origin xyz="0 0 0"/><geometry><box size="1 x 2"/></geometry></visual>'
    report = ssm.Report.of_file(write(arm().replace(BODY, BODY + shape)))
    assert report.usable
    assert any(f.where == "file" and "other readers" in f.message and f.level == "suspicious" for f in report.findings)
    assert ssm.Report.of_file(write(arm())).findings == ()


def test_a_figure_that_is_malformed_is_left_out_and_told():
    shape = '<visual name="v"><origin xyz="0 zero 0"/><geometry><sphere radius="1"/></geometry></visual>'
    robot, said = found(arm().replace(BODY, BODY + shape + shape.replace("zero", "0")))
    assert "suspicious link arm: a <visual> has a malformed <origin>" in said
    assert len(ET.fromstring(robot.urdf).findall("link/visual")) == 1


def test_clearances_do_not_suffer_from_figures():
    """What other readers refuse of a figure is no reason to have no clearances."""
    ball = '<{0}><origin xyz="0.5 0 0"/><geometry><sphere radius="{1}"/></geometry></{0}>'
    hand = f'<link name="hand">{BODY}{ball.format("collision", "0.1")}</link><joint name="wrist" type="revolute">'
    hand += f'<parent link="arm"/><child link="hand"/><origin xyz="1 0 0"/>{AXIS}{LIMIT}</joint>'
    text = arm(extra=hand).replace("</inertial></link>", "</inertial>" + ball.format("collision", "0.2") + "</link>", 1)
    limits = ssm.Limits(clearance=ssm.Clearance(0.05))
    rates = []
    for figure in ("", ball.format("visual", "much")):
        robot, _ = found(text.replace(BODY, BODY + figure))
        law = ssm.SelectiveLaw(robot, ssm.Protection("yaw"), rate_limit=0.1, sample_time=0.1, limits=limits)
        q = robot.configuration([0.3, 0.5])
        rates.append(law(q, [0.5, 0.2, 0]).joint_rates)
    np.testing.assert_array_equal(*rates)


def test_a_long_row_of_fixed_joints_loads():
    """The work is linear, and rounding does not add up to a refusal."""
    count = 3000
    rows, parent = [], "arm"
    for i in range(count):
        rows += [
            f'<link name="l{i}"><inertial><mass value="1"/>{TENSOR}</inertial></link>',
            joint(f"f{i}", parent, f"l{i}"),
        ]
        rows[-1] = rows[-1].replace("</joint>", '<origin xyz="0.1 0.01 0" rpy="0.1 0.2 0.3"/></joint>')
        parent = f"l{i}"
    robot = ssm.Robot(arm(extra="".join(rows)), name="long")
    assert robot.mass == 102 + count


@pytest.mark.parametrize(
    "text",
    [
        arm().replace('xyz="0.5 0 0"', 'xyz="1e200 0 0"'),
        arm().replace('ixx=".1"', 'ixx="1e308" ixy="1e308"').replace(' ixy="0" ixz="0" iyy=".1"', ' ixz="0" iyy=".1"'),
    ],
)
def test_numbers_beyond_all_use_are_refused(text):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            robot = ssm.Robot(text, name="r")
        except ssm.ModelError:
            return
    assert np.all(np.isfinite(robot.coupling(robot.configuration()).H_ww))


def test_plain_urdf_reads_before_it_writes():
    """What the model is compared with are the file's own numbers, not those that were written for Pinocchio."""
    text = arm().replace(CENTRE, '<origin xyz=" 0.5 0\t0 " quat_xyzw="0 0 0.6 0.8"/>')
    root = parse_urdf(text, "r")
    _, reading = plain_urdf(root, text)
    np.testing.assert_array_equal(reading.centres[1], [0.5, 0, 0])
    assert root.find("link[@name='arm']/inertial/origin").get("quat_xyzw") is None


_PART = '<inertial><mass value="3"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
_WHOLE = (
    '<robot name="r" xmlns:b="http://b">'
    f'<link name="bus">{_PART}</link><link name="arm">{_PART}</link><joint name="turn" type="revolute">'
    '<parent link="bus"/><child link="arm"/><origin xyz="1 0 0"/><axis xyz="0 1 0"/>'
    '<limit lower="-2" upper="2" effort="1" velocity="1"/></joint></robot>'
)
_LIMIT = '<limit lower="-2" upper="2" effort="1" velocity="1"/>'


@pytest.mark.parametrize(
    ("written", "instead", "words"),
    [
        (f'"arm">{_PART}', f'"arm"><collision>{_PART}</collision>', ("link arm", "inertial")),
        (f'"arm">{_PART}', f'"arm"><visual><body>{_PART}</body></visual>', ("link arm", "inertial")),
        (f'"arm">{_PART}', f'"arm"><physics>{_PART}</physics>', ("link arm", "inertial")),
        (f'"arm">{_PART}', f'"arm">{_PART.replace("inertial>", "b:inertial>")}', ("link arm", "inertial")),
        ("</robot>", f'<group><link name="more">{_PART}</link></group></robot>', ("inertial", "group")),
        ("</robot>", f'<b:link name="more">{_PART}</b:link></robot>', ("link",)),
        ("</robot>", '<include filename="arm.urdf"/></robot>', ("include",)),
        ('<origin xyz="1 0 0"/>', '<place><origin xyz="1 0 0"/></place>', ("joint turn", "origin")),
        ('<origin xyz="1 0 0"/>', '<b:origin xyz="1 0 0"/>', ("joint turn", "origin")),
        ('<origin xyz="1 0 0"/>', '<origin b:xyz="1 0 0"/>', ("joint turn", "xyz")),
        ('<origin xyz="1 0 0"/>', "<pose>1 0 0 0 0 0</pose>", ("joint turn", "pose", "origin")),
        ('name="turn"', 'name="turn" rpy="0 0 1"', ("joint turn", "rpy")),
        ('<axis xyz="0 1 0"/>', '<frame><axis xyz="0 1 0"/></frame>', ("joint turn", "axis")),
        (_LIMIT, _LIMIT.replace("lower", 'unit="deg" lower'), ("joint turn", "unit")),
        (_LIMIT, _LIMIT.replace("lower", "min").replace("upper", "max"), ("joint turn", "min", "lower")),
        (_LIMIT, _LIMIT.replace('effort="1"', 'effort="-1"'), ("joint turn", "effort")),
        (_LIMIT, _LIMIT.replace('velocity="1"', 'velocity="-1"'), ("joint turn", "velocity")),
        ('<robot name="r"', '<robot name="r" scale="0.001"', ("robot", "scale")),
    ],
)
def test_what_stands_where_it_is_not_read_is_refused_by_name(written, instead, words):
    assert written in _WHOLE
    ssm.Robot(_WHOLE, name="r")
    with pytest.raises(ssm.ModelError) as refusal:
        ssm.Robot(_WHOLE.replace(written, instead), name="r")
    assert all(word in str(refusal.value) for word in words), str(refusal.value)


def test_limits_that_are_not_kept_are_told():
    soft = '<safety_controller soft_lower_limit="-1" soft_upper_limit="1" k_position="1" k_velocity="1"/>'
    kept = ssm.Robot(_WHOLE.replace(_LIMIT, _LIMIT + soft), name="r")
    assert any("soft limits -1 to 1" in str(finding) for finding in kept.findings)
    endless = _WHOLE.replace("revolute", "continuous").replace('lower="-2" upper="2"', 'lower="2" upper="-2"')
    assert any("2 to -2 are not kept" in str(finding) for finding in ssm.Robot(endless, name="r").findings)
