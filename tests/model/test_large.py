"""Robots with hundreds of moving links, and with thousands of fixed ones."""

import resource
import subprocess
import sys
import tracemalloc
import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import ssm_decouple as ssm
from ssm_decouple.model import folded
from ssm_decouple.model.folded import folded_model

BODY = '<inertial><mass value="{m}"/><inertia ixx="{i}" ixy="0" ixz="0" iyy="{i}" iyz="0" izz="{i}"/></inertial>'
SHAPE = '<collision><geometry><sphere radius="0.05"/></geometry></collision>'


def large_urdf(moving: int, fixed: int, shape: str) -> str:
    """Return a bus with an arm of joints and fixed links on it, each a chain or a star."""
    parts = [f'<robot name="large"><link name="bus">{BODY.format(m=1000, i=500)}{SHAPE}</link>']
    for prefix, count, kind in (("l", moving, "revolute"), ("f", fixed, "fixed")):
        for i in range(count):
            parent = "bus" if shape == "star" or i == 0 else f"{prefix}{i - 1}"
            inertial = BODY.format(m=1, i=0.1) if prefix == "l" else ""
            axis = ("1 0 0", "0 1 0", "0 0 1")[i % 3]
            parts.append(
                f'<link name="{prefix}{i}">{inertial}{SHAPE if i % 100 == 0 else ""}</link><joint name="{prefix}j{i}" '
                f'type="{kind}"><parent link="{parent}"/><child link="{prefix}{i}"/><origin xyz="0.2 0 0"/><axis '
                f'xyz="{axis}"/><limit lower="-2" upper="2" effort="10" velocity="1"/></joint>'
            )
    return "".join(parts) + "</robot>"


WORK = """
import sys, warnings
import numpy as np, ssm_decouple as ssm
warnings.simplefilter("ignore")
path, tool = sys.argv[1:3]
robot = ssm.load_robot(path, tool)
str(robot.report()), ssm.Report.of_file(path), robot.reach, robot.coupling(robot.configuration())
q = robot.configuration(np.full(robot.n_joints, 0.01))
law = ssm.SelectiveLaw(robot, ssm.Protection("yaw"), sample_time=0.1)
target = robot.frame_pose(q).translation + [-0.01, 0, 0]
assert abs(law(q, target).protected_rate).max() < 1e-15
ssm.simulate(law, q, target, 0.2, 0.1)
whole = ssm.compose("ets_vii_bus", robot, [0, 0, 1], prefix="p_", end_effector=tool)
whole.with_payload(1.0, [0, 0, 0], 0.1 * np.eye(3)).with_locked({"p_lj0": 0.1})
# What getrusage tells is at least the peak of the process that started this one.
(peak,) = [line for line in open("/proc/self/status") if line.startswith("VmHWM")]
print(whole.n_joints, int(peak.split()[1]) // 1024)
"""


@pytest.mark.parametrize(("moving", "fixed", "shape"), [(60, 0, "chain"), (60, 0, "star"), (7, 5000, "chain")])
def test_large_robots_go_all_the_way(moving, fixed, shape, tmp_path):
    path = tmp_path / "large.urdf"
    path.write_text(large_urdf(moving, fixed, shape))
    words = [sys.executable, "-c", WORK, str(path), f"l{moving - 1}"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stderr
    joints, megabytes = map(int, done.stdout.split())
    assert joints == moving
    assert megabytes < 900


def test_reading_takes_memory_in_step_with_the_file():
    peaks = []
    for fixed in (2000, 4000):
        text = large_urdf(3, fixed, "chain")
        tracemalloc.start()
        ssm.Robot(text, name="large", end_effector="l2")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 2.5 * peaks[0]


def test_joints_beyond_memory_are_refused_before_it_is_taken():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ssm.ModelError, match=r"600 joints.*GB"):
        ssm.Robot(large_urdf(600, 0, "star"), name="large", end_effector="l0")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300 * 1024


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_folded_model_is_pinocchio_s_own(seed):
    rng = np.random.default_rng(seed)
    parts = [f'<robot name="r"><link name="bus">{BODY.format(m=50, i=9)}</link>']
    names = ["bus"]
    for i in range(int(rng.integers(1, 14))):
        name, kind = f"l{rng.integers(1000)}_{i}", rng.choice(["fixed", "fixed", "revolute", "continuous", "prismatic"])
        xyz, rpy, axis = (" ".join(map(repr, rng.normal(size=3).tolist())) for _ in range(3))
        body = BODY.format(m=rng.uniform(0.1, 3), i=rng.uniform(0.1, 3)) if rng.random() < 0.7 else ""
        parts.append(
            f'<link name="{name}">{body}</link><joint name="j{rng.integers(1000)}_{i}" type="{kind}"><parent '
            f'link="{rng.choice(names)}"/><child link="{name}"/><origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>'
            '<limit lower="-2" upper="2" effort="10" velocity="1"/></joint>'
        )
        names.append(name)
    text = "".join(parts) + "</robot>"

    def build(text: str) -> pin.Model:
        return pin.buildModelFromXML(text, pin.JointModelFreeFlyer())

    plain, made = build(text), folded_model(ET.fromstring(text), build)
    assert list(made.names) == list(plain.names)
    assert list(made.parents) == list(plain.parents)
    for name in ("lowerPositionLimit", "upperPositionLimit", "velocityLimit", "effortLimit"):
        np.testing.assert_array_equal(getattr(made, name), getattr(plain, name))
    for one, other in zip(made.jointPlacements, plain.jointPlacements, strict=True):
        np.testing.assert_allclose(one.homogeneous, other.homogeneous, atol=1e-14)
    for one, other in zip(made.inertias, plain.inertias, strict=True):
        np.testing.assert_allclose(one.matrix(), other.matrix(), atol=1e-12)
    frames = {(frame.name, str(frame.type)): frame for frame in made.frames}
    assert len(frames) == plain.nframes
    for frame in plain.frames:
        same = frames[frame.name, str(frame.type)]
        assert same.parentJoint == frame.parentJoint
        assert made.frames[same.parentFrame].name == plain.frames[frame.parentFrame].name
        np.testing.assert_allclose(same.placement.homogeneous, frame.placement.homogeneous, atol=1e-13)
        np.testing.assert_allclose(same.inertia.matrix(), frame.inertia.matrix(), atol=1e-12)


def test_clearances_are_the_same_whether_links_are_folded_or_not(monkeypatch):
    from ssm_decouple.control.collision import Clearance, Distances

    text = large_urdf(4, 301, "star")
    q = ssm.Robot(text, name="plain", end_effector="l3").configuration([0.1, 0.2, 0.3, 0.4])
    plain = Distances(ssm.Robot(text, name="plain", end_effector="l3"), Clearance(pairs=[("l0", "f100")]))
    monkeypatch.setattr(folded, "MANY", 10)
    other = Distances(ssm.Robot(text, name="folded", end_effector="l3"), Clearance(pairs=[("l0", "f100")]))
    assert other.names == plain.names
    np.testing.assert_allclose(other(q)[1], plain(q)[1], atol=1e-9)


def test_an_mjcf_may_be_as_deep(tmp_path):
    body = '<body pos="0.1 0 0"><geom size="0.1" mass="0.1"/>'
    path = tmp_path / "deep.xml"
    path.write_text(
        '<mujoco><worldbody><body name="bus"><freejoint/><geom size="1"/>'
        + 1500 * body
        + '<site name="tip"/>'
        + 1500 * "</body>"
        + "</body></worldbody></mujoco>"
    )
    robot = ssm.load_robot(path, "tip")
    np.testing.assert_allclose(robot.frame_pose(robot.configuration()).translation, [150, 0, 0], rtol=1e-12)
