"""Links without mass: told on loading, and refused before torques would have to move them."""

import warnings
import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

import ssm_decouple as ssm
from ssm_decouple.model.massless import massless_joints, refuse_singular_mass_matrix

BALL = (
    '<inertial><origin xyz="{x} 0 0"/><mass value="{m}"/><inertia ixx="{i}" ixy="0" ixz="0" iyy="{i}" iyz="0" '
    'izz="{i}"/></inertial>'
)


def link(name, mass=0.0, inertia=0.0, at=0.0):
    return f'<link name="{name}">{BALL.format(m=mass, i=inertia, x=at) if mass or inertia else ""}</link>'


def joint(name, parent, child, axis="0 0 1", kind="revolute", at="0.5 0 0"):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{at}"/>'
        f'<axis xyz="{axis}"/><limit lower="-2" upper="2" effort="10" velocity="0.5"/></joint>'
    )


BUS = link("bus", 100.0, 20.0)
ARM = joint("shoulder", "bus", "upper") + link("upper", 8.0, 1.0, 0.4) + joint("elbow", "upper", "hand", "0 1 0")
TOOL = link("hand", 3.0, 0.4, 0.2)


def robot(*parts, name="probe", end_effector="hand"):
    return ssm.Robot(f'<robot name="r">{"".join(parts)}</robot>', name=name, end_effector=end_effector)


def dynamic(found, **physics):
    law = ssm.SelectiveLaw(found, ssm.Protection("none"), sample_time=0.1)
    q = found.configuration(np.full(found.n_joints, 0.3))
    return ssm.simulate(law, q, found.frame_pose(q).translation, 0.2, 0.1, ssm.Dynamic(**physics))


SINGULAR = {
    "a rotor without inertial": (joint("spin", "bus", "rotor", kind="continuous") + link("rotor"), "spin", "rotor"),
    "a chain of two": (
        joint("spin", "bus", "rotor") + link("rotor") + joint("turn", "rotor", "tip", "1 0 0") + link("tip"),
        "turn",
        "tip",
    ),
    "a point mass on its axis": (joint("spin", "bus", "rotor") + link("rotor", 2.0), "spin", "rotor"),
    "a slide": (joint("lift", "hand", "pad", kind="prismatic") + link("pad"), "lift", "pad"),
    "two joints about one axis": (
        joint("a", "hand", "idle") + link("idle") + joint("b", "idle", "end", at="0 0 1") + link("end", 1.0, 0.1),
        "a",
        "idle",
    ),
    "a massless link fixed beyond": (
        joint("spin", "hand", "wrist") + link("wrist") + '<joint name="f" type="fixed"><parent link="wrist"/>'
        '<child link="tool"/><origin xyz="0.2 0 0"/></joint><link name="tool"/>',
        "spin",
        "wrist",
    ),
}


@pytest.mark.parametrize("case", SINGULAR)
def test_what_torques_cannot_move_is_refused_by_joint_and_link(case):
    parts, moved_by, moved = SINGULAR[case]
    found = robot(BUS, ARM, TOOL, parts)
    with pytest.raises(ssm.ModelError, match=f"joint '{moved_by}' moves '{moved}' without"):
        dynamic(found)


@pytest.mark.parametrize("case", SINGULAR)
def test_rates_that_are_given_need_no_inertia(case):
    found = robot(BUS, ARM, TOOL, SINGULAR[case][0])
    law = ssm.SelectiveLaw(found, ssm.Protection("yaw"))
    q = found.configuration(np.full(found.n_joints, 0.3))
    target = found.frame_pose(q).translation + [-0.02, 0.0, 0.0]
    assert ssm.simulate(law, q, target, 0.2, 0.1).time.size == 3
    motion = dynamic(found, servo=None)
    assert motion.energy_error < 1e-9
    assert np.all(np.isfinite(motion.joint_torques))


@pytest.mark.parametrize("case", [case for case in SINGULAR if case != "two joints about one axis"])
def test_a_joint_that_moves_nothing_stands_in_the_report(case):
    parts, moved_by, moved = SINGULAR[case]
    listed = [finding for finding in robot(BUS, ARM, TOOL, parts).report().findings if finding.level == "suspicious"]
    assert any(f.where == f"joint {moved_by}" and moved in f.message and "refused" in f.message for f in listed)


def test_a_massless_root_is_told_on_loading_and_refused_before_torques(tmp_path):
    path = tmp_path / "bare.urdf"
    path.write_text(f'<robot name="r"><link name="bus"/>{ARM}{TOOL}</robot>')
    with pytest.warns(ssm.DecoupleWarning, match="link bus: the root link has no mass"):
        found = ssm.load_robot(path)
    assert any("no mass" in finding.message for finding in ssm.Report.of_file(path).findings)
    with pytest.raises(ssm.ModelError, match="root link 'bus'"):
        dynamic(found)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert ssm.compose("ets_vii_bus", path, [0, 0, 1], prefix="arm_").mass == pytest.approx(2550 + 11)


def test_a_root_whose_mass_is_fixed_to_it_is_none_of_that(tmp_path):
    path = tmp_path / "held.urdf"
    mount = '<joint name="f" type="fixed"><parent link="frame"/><child link="bus"/></joint>'
    path.write_text(f'<robot name="r"><link name="frame"/>{mount}{BUS}{ARM}{TOOL}</robot>')
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = ssm.load_robot(path)
    assert not massless_joints(found.model)
    assert dynamic(found).energy_error < 1e-6


@pytest.fixture
def case(tmp_path):
    (tmp_path / "probe.urdf").write_text(
        f'<robot name="r">{BUS}{ARM}{TOOL}{joint("spin", "bus", "rotor")}{link("rotor")}</robot>'
    )
    path = tmp_path / "probe.toml"
    path.write_text(
        'title = "t"\nrobot = "probe.urdf"\nend_effector = "hand"\n[start]\njoints_deg = {shoulder = 20, elbow = 30}\n'
        '[target]\nposition = [1.3, 0.6, -0.2]\n[protection]\naxes = "yaw"\n[law]\ngain = 0.05\n[simulation]\n'
        "duration = 1\ndt = 0.1\n"
    )
    return path


@pytest.mark.parametrize("words", ["run --dynamic", "study robustness", "study pointing"])
def test_the_command_line_refuses_it_before_it_starts(words, case, call, tmp_path):
    done = call(*words.split(), case, cwd=tmp_path)
    assert done.returncode != 0
    assert "'spin'" in done.stderr
    assert "Traceback" not in done.stderr


@given(st.lists(st.sampled_from(["rod", "ball", "none"]), min_size=2, max_size=6), st.integers(0, 2**31))
def test_it_is_refused_exactly_where_the_mass_matrix_is_singular(kinds, seed):
    """An independent route: the smallest eigenvalue of the mass matrix, its diagonal scaled to one."""
    rng = np.random.default_rng(seed)
    parts, parent = [BUS], "bus"
    for i, kind in enumerate(kinds):
        axis, at = (" ".join(map(str, rng.normal(size=3))) for _ in range(2))
        parts.append(joint(f"j{i}", parent, f"l{i}", axis, "prismatic" if rng.random() < 0.3 else "revolute", at))
        parts.append(link(f"l{i}", *{"rod": (1.0, 0.0, 0.5), "ball": (2.0, 0.3, 0.1), "none": ()}[kind]))
        parent = f"l{rng.integers(i + 1)}"
    found = robot(*parts, end_effector="bus")
    q = found.configuration(rng.uniform(-1, 1, found.n_joints))
    upper = np.triu(pin.crba(found.model, found.model.createData(), q))
    M = upper + np.triu(upper, 1).T
    scale = np.sqrt(np.where(np.diag(M) > 0, np.diag(M), 1.0))
    smallest = np.linalg.eigvalsh(M / np.outer(scale, scale))[0]
    if 1e-13 < smallest < 1e-8:
        return  # neither clearly regular nor clearly singular
    if smallest > 1e-8:
        refuse_singular_mass_matrix(found.model, q, "r")
    else:
        with pytest.raises(ssm.ModelError, match="cannot be simulated dynamically"):
            refuse_singular_mass_matrix(found.model, q, "r")


def test_the_robots_that_come_with_the_package_move_no_massless_link():
    for name in ssm.models():
        assert not massless_joints(ssm.load_robot(name).model)


def test_wheels_and_payloads_are_regular():
    wheel = ssm.Wheel("w", [0, 0, 1], spin_inertia=0.05, max_speed=400, max_torque=0.2)
    found = ssm.load_robot("ets_vii").with_wheels([wheel]).with_payload(1e-3, [0, 0, 0], 1e-9 * np.eye(3))
    assert ET.fromstring(found.urdf) is not None
    refuse_singular_mass_matrix(found.model, found.configuration(), found.name)
