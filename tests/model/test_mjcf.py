"""MJCF against MuJoCo itself: what the two make of the same file, body by body and number by number."""

import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mujoco_robots import mass_matrix

import ssm_decouple as ssm

pytestmark = pytest.mark.usefixtures("scratch_folder")  # MuJoCo writes a log into the folder that it runs in


BUS = '<inertial pos="0.1 0 0.05" mass="100" diaginertia="20 25 30"/>'
ARM = '<inertial pos="0.3 0 0.05" quat="1 0.2 0.3 0.1" mass="8" diaginertia="0.5 2 2.1"/>'


def mjcf(inside: str = "", before: str = "", after: str = "", joint: str = "<freejoint/>", world: str = "") -> str:
    body = f'<body name="bus">{joint}{BUS}{inside}</body>'
    return f"<mujoco>{before}<worldbody>{body}{world}</worldbody>{after}</mujoco>"


def arm(joint: str = '<joint name="j"/>', inside: str = ARM, body: str = "") -> str:
    return f'<body name="arm" pos="0.5 0.2 0" {body}>{joint}{inside}</body>'


def load(text: str, tmp_path: Path, end_effector: str | None = None) -> ssm.Robot:
    path = tmp_path / "robot.xml"
    path.write_text(text, encoding="utf-8")
    return ssm.load_robot(path, end_effector)


def states(model: mujoco.MjModel, robot: ssm.Robot, rng: np.random.Generator):
    """Return one random state in the coordinates of both: MuJoCo's qpos and qvel, and q and v."""
    names = [model.joint(j).name for j in range(1, model.njnt)]
    R = pin.exp3(rng.normal(size=3))
    quaternion = pin.Quaternion(R)
    there, joints = rng.normal(size=3), dict(zip(names, rng.uniform(-2, 2, len(names)), strict=True))
    qpos = np.zeros(model.nq)
    qpos[:7] = [*there, quaternion.w, quaternion.x, quaternion.y, quaternion.z]
    for name, value in joints.items():
        qpos[model.joint(name).qposadr[0]] = value
    q = robot.configuration(joints, pin.SE3(R, there))
    # The rows of a matrix that takes MuJoCo's velocities, the base's linear one in world axes, to ours.
    T = np.zeros((model.nv, model.nv))
    T[:3, :3], T[3:6, 3:6] = R.T, np.eye(3)
    for name in names:
        T[6 + robot.joint_index(name), model.joint(name).dofadr[0]] = 1.0
    return qpos, q, T


def assert_equal_to_mujoco(text: str, robot: ssm.Robot, rng: np.random.Generator) -> None:
    model = mujoco.MjModel.from_xml_string(text)
    model.dof_armature[:] = 0.0
    data = mujoco.MjData(model)
    root = int(model.jnt_bodyid[0])
    inside = [i for i in range(model.nbody) if model.body_rootid[i] == root]
    assert robot.mass == pytest.approx(model.body_mass[inside].sum(), rel=1e-13)
    for _ in range(2):
        qpos, q, T = states(model, robot, rng)
        qvel = rng.normal(size=model.nv)
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        M = mass_matrix(model, data)
        upper = np.triu(pin.crba(robot.model, robot.model.createData(), q))
        ours = T.T @ (upper + np.triu(upper, 1).T) @ T
        np.testing.assert_allclose(ours, M, rtol=0, atol=1e-12 * np.abs(M).max())
        momentum = np.r_[robot.mass * data.subtree_linvel[root], data.subtree_angmom[root]]
        scale = np.abs(M).max() * np.abs(qvel).max()
        np.testing.assert_allclose(robot.momentum(q, T @ qvel), momentum, rtol=0, atol=1e-12 * scale)
        bodies = {model.body(i).name: (data.xpos[i], data.xmat[i]) for i in inside if model.body(i).name}
        sites = {model.site(i).name: (data.site_xpos[i], data.site_xmat[i]) for i in range(model.nsite)}
        for name, (there, R) in (
            bodies | {f"{n}_site" if n in bodies else n: pose for n, pose in sites.items()}
        ).items():
            pose = robot.frame_pose(q, name)
            np.testing.assert_allclose(pose.translation, there, rtol=0, atol=1e-12 * max(1, np.abs(there).max()))
            np.testing.assert_allclose(pose.rotation.ravel(), R, rtol=0, atol=1e-12)
    for j in range(1, model.njnt):
        limits = robot.position_limits[robot.joint_index(model.joint(j).name)]
        if model.jnt_limited[j]:
            np.testing.assert_allclose(limits, model.jnt_range[j], rtol=1e-14)
        else:
            assert np.all(np.abs(limits) > 1e300)


FEATURES = {
    "hinge": mjcf(arm('<joint name="j" axis="0 1 1" pos="0.1 0.2 0.3" range="-90 45"/>', body='quat="9 1 2 3"')),
    "slide": mjcf(arm('<joint name="j" type="slide" axis="0 1 1" pos="1 2 3" range="-1 2"/>', body='euler="10 20 30"')),
    "ref": mjcf(arm('<joint name="j" axis="0 1 1" ref="30" pos="0.1 0 0.3"/>')),
    "ref of a slide": mjcf(arm('<joint name="j" type="slide" axis="0 1 1" ref="0.3" range="-1 1"/>')),
    "three joints in a body": mjcf(
        arm(
            '<joint name="a" axis="0 1 1" pos="0 .1 0" ref="20"/><joint name="b" type="slide" axis="1 0 1"/>'
            '<joint name="c" axis="1 0 0" pos=".2 0 0" range="-30 30"/>'
        )
    ),
    "radian": mjcf(arm('<joint name="j" range="-1 1"/>', body='euler="0.1 0.2 0.3"'), '<compiler angle="radian"/>'),
    "eulerseq": mjcf(arm(body='euler="10 20 30"'), '<compiler eulerseq="ZyX"/>'),
    "axisangle": mjcf(arm(body='axisangle="0 1 2 30"')),
    "xyaxes": mjcf(arm(body='xyaxes="1 1 0 0 1 0.3"')),
    "zaxis": mjcf(arm(body='zaxis="1 1 0.4"')),
    "zaxis, backwards": mjcf(arm(body='zaxis="0 0 -1"')),
    "fullinertia": mjcf(arm(inside='<inertial pos=".1 0 0" mass="3" fullinertia="1 2 2.5 .1 .2 .3"/>')),
    "inertial turned": mjcf(arm(inside='<inertial pos=".1 0 0" mass="3" axisangle="1 2 0 30" diaginertia="1 2 2.5"/>')),
    "limited false": mjcf(arm('<joint name="j" limited="false" range="-30 30"/>')),
    "sphere": mjcf(arm(inside='<geom size="0.2" pos="0.1 0 0"/>')),
    "capsule": mjcf(arm(inside='<geom type="capsule" size="0.1" fromto="0 0 0 0.4 0.1 0.2"/>')),
    "cylinder": mjcf(arm(inside='<geom type="cylinder" size="0.1 0.3" euler="10 20 30" mass="3"/>')),
    "boxes": mjcf(
        arm(inside='<geom type="box" size=".1 .3 .2" pos="1 0 0" euler="9 8 7" density="300"/><geom size=".3"/>')
    ),
    "box from to": mjcf(arm(inside='<geom type="box" size=".1" fromto="0 0 0 .1 .2 -.3" mass="2"/>')),
    "ellipsoid": mjcf(arm(inside='<geom type="ellipsoid" size=".1 .3 .2" euler="10 20 30" density="300"/>')),
    "inertial before geoms": mjcf(arm(inside=ARM + '<geom size="0.3"/>')),
    "inertia from geoms always": mjcf(arm(inside=ARM + '<geom size="0.3"/>'), '<compiler inertiafromgeom="true"/>'),
    "groups that weigh": mjcf(
        arm(inside='<geom size="0.3" group="1"/><geom size="0.5" group="3"/>'), '<compiler inertiagrouprange="0 1"/>'
    ),
    "bounds": mjcf(arm(), '<compiler boundmass="9" boundinertia="3"/>'),
    "balanced": mjcf(
        arm(inside='<inertial pos="0 0 0" mass="1" diaginertia="1 1 3"/>'), '<compiler balanceinertia="true"/>'
    ),
    "defaults": mjcf(
        arm(inside=ARM + '<body name="b" childclass="d"><joint name="k"/><geom/><body><geom class="c"/></body></body>'),
        '<default><joint axis="0 1 0" range="-30 30"/><geom size=".2 .1" type="cylinder"/><default class="c">'
        '<joint axis="1 0 0"/><default class="d"><joint pos="0 .2 0"/><geom type="box" size=".1 .2 .3"/></default>'
        "</default></default>",
    ),
    "an orientation before that of a class": mjcf(
        arm(inside='<geom type="box" size=".1 .2 .3" axisangle="1 0 0 20"/>'),
        '<default><geom euler="0 0 90"/></default>',
    ),
    "frames": mjcf(
        '<frame pos="1 0 0" euler="0 0 90"><frame euler="30 0 0">'
        + arm(
            inside=ARM + '<frame pos="0 1 0" zaxis="1 0 0"><geom type="box" size=".1 .2 .3"/><site name="s"/></frame>'
        )
        + "</frame></frame>"
    ),
    "a joint in a frame": mjcf(
        '<body name="arm"><frame pos="1 0 0" euler="0 30 90"><joint name="j" axis="1 0 0"/></frame>' + ARM + "</body>"
    ),
    "a free joint of type free": mjcf(arm(), joint='<joint type="free" name="root"/>'),
    "bodies without joints": mjcf(arm(inside=ARM + f'<body name="tool" pos="0 0 1" euler="0 90 0">{ARM}</body>')),
    "sites": mjcf(
        arm(inside=ARM + '<site name="tip" pos="0 0 1" euler="10 20 30"/>') + '<site name="imu" pos="1 0 0"/>'
    ),
    "a world around it": mjcf(
        arm(), world='<geom type="plane" size="1 1 1"/><body name="t" mocap="true"><geom size=".1"/></body>'
    ),
    "names in use twice": mjcf('<body name="a"><joint name="a"/>' + ARM + '<site name="a" pos="1 0 0"/></body>'),
    "armature and springs": mjcf(arm('<joint name="j" armature="3" damping="2" stiffness="1" frictionloss="1"/>')),
    "keyframes, sensors, contacts": mjcf(
        arm(inside=ARM + '<camera name="c"/><light name="l"/><site name="s"/>'),
        '<option gravity="0 0 -9"/><statistic extent="2"/><visual/><custom/><asset/><size nconmax="1"/>',
        '<sensor><gyro site="s"/></sensor><contact><exclude body1="bus" body2="arm"/></contact><keyframe>'
        '<key name="home" qpos="0 0 1 1 0 0 0 0.4"/></keyframe>',
    ),
}


@pytest.mark.parametrize("feature", FEATURES)
def test_it_is_what_mujoco_makes_of_it(feature, tmp_path, rng):
    assert_equal_to_mujoco(FEATURES[feature], load(FEATURES[feature], tmp_path, "bus"), rng)


def _turned(rng: np.random.Generator) -> str:
    def some(count: int) -> str:
        return " ".join(map(str, rng.normal(size=count)))

    ways = ["", f'quat="{some(4)}"', f'euler="{some(3)}"', f'axisangle="{some(4)}"', f'xyaxes="{some(6)}"']
    return str(rng.choice([*ways, f'zaxis="{some(3)}"']))


def _random_robot(rng: np.random.Generator) -> str:
    """Return a random MJCF tree with most of what is read, in random forms."""
    count = int(rng.integers(1, 6))
    inside: dict[int, list[int]] = {i: [] for i in range(count)}
    for i in range(1, count):
        inside[int(rng.integers(i))].append(i)

    def vector() -> str:
        return " ".join(map(str, rng.normal(size=3)))

    def body(i: int) -> str:
        parts = ["<freejoint/>"] if i == 0 else []
        for k in range(int(rng.integers(0, 4)) if i else 0):
            kind, scale = (("slide", 1), ("hinge", 40))[int(rng.integers(2))]
            limits = (
                f'range="{-scale * rng.uniform(0.1, 2)} {scale * rng.uniform(0.1, 2)}"' if rng.random() < 0.5 else ""
            )
            ref = f'ref="{scale * rng.normal()}"' if rng.random() < 0.4 else ""
            pos, name = rng.choice(["", f'pos="{vector()}"']), f"j{i}_{k}"
            cls = rng.choice(["", 'class="a"', 'class="b"'])
            parts.append(f'<joint name="{name}" type="{kind}" axis="{vector()}" {pos} {ref} {limits} {cls}/>')
        if rng.random() < 0.5:
            a, b = rng.uniform(0.5, 1.5, 2)
            parts.append(
                f'<inertial pos="{vector()}" mass="{rng.uniform(1, 5)}" {_turned(rng)} diaginertia="{a} {b} '
                f'{rng.uniform(abs(a - b) + 0.1, a + b)}"/>'
            )
        for _ in range(int(rng.integers(1, 3))):
            kind = rng.choice(["sphere", "capsule", "box", "cylinder", "ellipsoid"])
            weight = rng.choice(["", 'mass="2.5"', 'density="90"', 'class="a"'])
            size = " ".join(map(str, rng.uniform(0.1, 0.4, 3)))
            ends = kind != "sphere" and rng.random() < 0.3
            place = f'fromto="{vector()} {vector()}"' if ends else f'pos="{vector()}" {_turned(rng)}'
            parts.append(f'<geom type="{kind}" size="{size}" {place} {weight}/>')
        parts.append(f'<site name="s{i}" pos="{vector()}" {_turned(rng)}/>')
        nested = "".join(body(j) for j in inside[i])
        if rng.random() < 0.3:
            nested = f'<frame pos="{vector()}" {_turned(rng)} childclass="b">{nested}</frame>'
        cls = rng.choice(["", 'childclass="a"', 'childclass="b"'])
        return f'<body name="b{i}" pos="{vector()}" {_turned(rng)} {cls}>{"".join(parts)}{nested}</body>'

    sequence = "".join(rng.choice(list("xyzXYZ"), 3))
    angle = rng.choice(["degree", "radian"])
    return (
        f'<mujoco><compiler angle="{angle}" eulerseq="{sequence}" inertiafromgeom="{rng.choice(["auto", "true"])}"/>'
        '<default><geom density="500"/><joint pos=".1 .2 .3"/><default class="a"><geom mass="0.7"/><joint ref="0.2"/>'
        '<default class="b"><joint limited="false" pos="0 0 0"/></default></default></default>'
        f"<worldbody>{body(0)}</worldbody></mujoco>"
    )


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_random_files_are_what_mujoco_makes_of_them(tmp_path_factory, seed):
    rng = np.random.default_rng(seed)
    text = _random_robot(rng)
    assert_equal_to_mujoco(text, load(text, tmp_path_factory.mktemp("mjcf"), "b0"), rng)


REFUSED = {
    "ball joint 'wrist'|wrist.*ball": mjcf(arm('<joint name="wrist" type="ball"/>')),
    "several robots or free bodies, 'bus', 'debris'": mjcf(
        arm(), world='<body name="debris"><freejoint/><geom size="1"/></body>'
    ),
    "'other'": mjcf(arm(), world=f'<body name="other"><joint/>{ARM}</body>'),
    "replicate": mjcf(f'<replicate count="2" offset="1 0 0">{arm()}</replicate>'),
    "composite": mjcf(arm(inside=ARM + "<composite/>")),
    "flexcomp": mjcf(arm(inside=ARM + "<flexcomp/>")),
    "attach": mjcf(arm(inside=ARM + "<attach/>")),
    "shell": mjcf(arm(inside='<geom type="box" size=".1 .1 .1" shellinertia="true"/>')),
    "geom 'dish' is a mesh that weighs": mjcf(arm(inside='<geom name="dish" type="mesh" mesh="m"/>')),
    "equality connect between bus and arm": mjcf(
        arm(), after='<equality><connect body1="bus" body2="arm" anchor="0 0 1"/></equality>'
    ),
    "equality weld": mjcf(arm(), after='<equality><weld body1="arm"/></equality>'),
    "equality joint": mjcf(arm(), after='<equality><joint joint1="j"/></equality>'),
    "unknown attribute 'masss'; did you mean 'mass'": mjcf(arm(inside='<geom masss="2" size="1"/>')),
    "unknown attribute 'angel'": mjcf(arm(), '<compiler angel="radian"/>'),
    "unknown default class 'dd'": mjcf(arm('<joint class="dd"/>')),
    "global coordinates": mjcf(arm(), '<compiler coordinate="global"/>'),
    "autolimits is off": mjcf(arm('<joint name="j" range="-1 1"/>'), '<compiler autolimits="false"/>'),
    "turned twice": mjcf(arm(body='quat="1 0 0 0" euler="1 2 3"')),
    "aligned with its inertia": mjcf(arm(), joint='<freejoint align="true"/>'),
    "alignfree|aligned": mjcf(arm(), '<compiler alignfree="true"/>'),
    "free joint inside another body": mjcf(arm("<freejoint/>")),
    "finite numbers": mjcf(arm(body='euler="1 2"')),
    "needs 3 finite": mjcf(arm(inside='<inertial pos="0 0 nan" mass="1" diaginertia="1 1 1"/>')),
    "no direction": mjcf(arm('<joint axis="0 0 0"/>')),
    "has no mass": mjcf(arm(inside='<inertial pos="0 0 0" diaginertia="1 1 1"/>')),
    "nothing in it moves": "<mujoco><worldbody/></mujoco>",
    "element <bodyy>": mjcf("<bodyy/>"),
    "element <worldbodyy>": "<mujoco><worldbodyy/></mujoco>",
    "cannot include": mjcf('<include file="nowhere.xml"/>'),
    "flexible body": mjcf(arm(), after="<deformable><flex/></deformable>"),
    "rename one": mjcf(arm() + '<site name="s"/><site name="s"/>'),
}


@pytest.mark.parametrize("message", REFUSED)
def test_what_a_urdf_cannot_hold_is_refused_by_name(message, tmp_path):
    with pytest.raises(ssm.ModelError, match=message):
        load(REFUSED[message], tmp_path, "bus")


def test_what_is_left_out_is_told(tmp_path):
    text = mjcf(
        arm(
            '<joint name="j" armature="0.1" stiffness="2" damping="3"/>', ARM + '<geom type="ellipsoid" size="1 1 1"/>'
        ),
        after='<tendon><fixed name="cable"><joint joint="j" coef="1"/></fixed></tendon>',
        world='<body name="wall"/>',
    )
    told = [str(finding) for finding in load(text, tmp_path).report().findings]
    for words in ("armature 0.1", "stiffness 2", "damping 3", "1 geoms", "'cable'", "fixed to the world", "rate_limit"):
        assert any(words in each for each in told), words
    assert any(each.startswith("joint j: armature") for each in told)
    bare = [str(finding) for finding in load(mjcf(arm(), joint=""), tmp_path).report().findings]
    assert any("no free joint" in each for each in bare)


def test_efforts_are_those_of_the_drives(tmp_path):
    text = mjcf(
        arm('<joint name="j"/><joint name="k" axis="1 0 0" actuatorfrcrange="-5 7"/><joint name="l" axis="0 1 0"/>'),
        '<default><motor ctrlrange="-2 2" gear="3"/></default>',
        '<actuator><motor joint="j" gear="20" ctrlrange="-1 1"/><position joint="k" forcerange="-1 1" gear="4"/>'
        '<motor joint="l"/><motor joint="l"/></actuator>',
    )
    efforts = load(text, tmp_path).model.effortLimit[6:]
    np.testing.assert_allclose(efforts, [20.0, 4.0, 12.0])


def test_a_coupled_joint_is_a_mimic_joint_counted_from_zero(tmp_path):
    text = mjcf(
        arm('<joint name="j" ref="30"/>') + f'<body name="b"><joint name="k" ref="10"/>{ARM}</body>',
        after='<equality><joint joint1="k" joint2="j" polycoef="0.1 2 0 0 0"/></equality>',
    )
    from ssm_decouple.model.formats import read_robot

    (path := tmp_path / "robot.xml").write_text(text)
    mimic = ET.fromstring(read_robot(path)).find("joint[@name='k']/mimic")
    assert mimic is not None
    assert (mimic.get("joint"), float(mimic.get("multiplier", ""))) == ("j", 2.0)
    assert float(mimic.get("offset", "")) == pytest.approx(np.deg2rad(10) + 0.1 - 2 * np.deg2rad(30))


def test_sites_are_no_tips_but_can_be_the_end_effector(tmp_path):
    text = mjcf(arm(inside=ARM + '<site name="grip" pos="0 0 1"/><site name="eye"/>') + '<site name="imu"/>')
    robot = load(text, tmp_path)
    assert robot.end_effector == "arm"
    assert {"grip", "eye", "imu"} < set(robot.link_names)
    assert load(text, tmp_path, "grip").end_effector == "grip"
    named = text.replace('"grip"', '"end_effector"')
    assert load(named, tmp_path).end_effector == "end_effector"


def test_includes_are_put_in_their_place(tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts/arm.xml").write_text(f"<mujocoinclude>{arm()}</mujocoinclude>")
    (tmp_path / "classes.xml").write_text('<mujoco><default><joint axis="0 1 0"/></default></mujoco>')
    whole = load(mjcf(arm(), '<default><joint axis="0 1 0"/></default>'), tmp_path)
    parts = load(mjcf('<include file="parts/arm.xml"/>', '<include file="classes.xml"/>'), tmp_path)
    assert parts.urdf == whole.urdf
    (tmp_path / "loop.xml").write_text('<mujoco><include file="loop.xml"/></mujoco>')
    with pytest.raises(ssm.ModelError, match="includes itself"):
        load('<mujoco><include file="loop.xml"/></mujoco>', tmp_path)


def test_everything_else_works_on_it(tmp_path, call):
    path = tmp_path / "arm.xml"
    path.write_text(
        '<mujoco model="a"><worldbody><body name="base" pos="1 2 3">' + ARM + '<geom size=".1"/>'
        '<body name="upper" pos="0 0 .3"><joint name="a" axis="0 1 0" range="-90 90"/><geom type="capsule" size=".05" '
        'fromto="0 0 0 .6 0 0"/><body name="hand" pos=".6 0 0"><joint name="b" axis="0 0 1"/>'
        '<geom type="box" size=".1 .05 .05"/><site name="grip" pos=".1 0 0"/></body></body></body></worldbody></mujoco>'
    )
    arm_alone = ssm.load_robot(path, "grip")
    whole = ssm.compose("ets_vii_bus", path, [0, 0, 1], end_effector="grip", prefix="a_")
    assert whole.mass == pytest.approx(2550 + arm_alone.mass)
    (tmp_path / "winged.toml").write_text('urdf = "arm.xml"\nend_effector = "grip"\n')
    assert ssm.load_robot(tmp_path / "winged.toml").end_effector == "grip"
    law = ssm.SelectiveLaw(arm_alone, ssm.Protection("none"), rate_limit=0.2, sample_time=0.1)
    q = arm_alone.configuration({"a": 0.4, "b": 0.3})
    motion = ssm.simulate(law, q, arm_alone.frame_pose(q).translation + [-0.01, 0, 0], 0.5, 0.1, ssm.Dynamic())
    assert motion.energy_error < 1e-6
    assert ssm.load_robot(path).with_payload(1.0, [0, 0, 0], 0.01 * np.eye(3), "grip").mass > arm_alone.mass
    from ssm_decouple.model.urdf import visual_shapes

    assert sorted({shape.kind for shape in visual_shapes(arm_alone.urdf)}) == ["box", "cylinder", "sphere"]
    done = call("check", path)
    assert done.returncode == 0
    assert "grip" in done.stdout
