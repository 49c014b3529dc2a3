"""Figures show what they claim: robots of any size fit, floors and gaps are told, units and axes are true."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pinocchio as pin
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from mpl_toolkits.mplot3d import proj3d
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

import ssm_decouple as ssm
from ssm_decouple.viewing import figures
from ssm_decouple.viewing.angles import joint_kinds
from ssm_decouple.viewing.viewer import scenes_of
from ssm_decouple.viewing.viewer.plots import caption, curves_of

START = np.deg2rad([150.0, -20.0, -10.0, 0.0, 0.0, 0.0])


def drawn(figure):
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].astype(float)


def resized(urdf, factor):
    """Return a URDF whose lengths are multiplied."""

    def larger(found):
        return found[1] + " ".join(repr(float(word) * factor) for word in found[2].split()) + found[3]

    for name in ("xyz", "size", "radius", "length"):
        urdf = re.sub(rf'(<(?:origin|box|cylinder|sphere)\b[^>]*\b{name}=")([^"]*)(")', larger, urdf)
    return urdf


def arm(reach, visual=True, joints=3):
    """A bus with a planar arm of so many links, folded out to a reach, m."""
    inertia = '<inertia ixx="9" iyy="9" izz="9" ixy="0" ixz="0" iyz="0"/>'
    length = reach / joints
    shape = f'<visual><origin xyz="{length / 2} 0 0"/><geometry><box size="{length} .01 .01"/></geometry></visual>'
    parts = [f'<link name="l0"><inertial><mass value="500"/>{inertia}</inertial></link>']
    for i in range(joints):
        parts += [
            f'<link name="l{i + 1}"><inertial><mass value="4"/>{inertia}</inertial>{shape if visual else ""}</link>',
            f'<joint name="j{i}" type="continuous"><parent link="l{i}"/><child link="l{i + 1}"/>'
            f'<origin xyz="{length if i else 0} 0 0"/><axis xyz="0 0 1"/></joint>',
        ]
    tip = f'<link name="tip"/><joint name="t" type="fixed"><parent link="l{joints}"/><child link="tip"/>'
    return ssm.Robot(
        f'<robot name="arm">{"".join(parts)}{tip}<origin xyz="{length} 0 0"/></joint></robot>', name=f"{reach} m"
    )


def moved(robot, q, protection="yaw", duration=4.0, way=None):
    law = ssm.SelectiveLaw(robot, ssm.Protection(protection), rate_limit=0.05)
    way = 0.05 * robot.reach * np.array([-1.0, 0.5, 0.0]) if way is None else way
    return ssm.simulate(law, q, robot.frame_pose(q).translation + way, duration, 0.5)


SIZES = {
    "0.3 m": lambda: moved(arm(0.3), arm(0.3).configuration([0.3, 0.8, -0.5])),
    "4 m": lambda: moved(arm(4.0), arm(4.0).configuration([2.5, 0.5, 0.5])),
    "12 m, straight": lambda: moved(arm(12.0), arm(12.0).configuration([0.0, 0.0, 0.0])),
    "12 m, no shapes": lambda: moved(arm(12.0, visual=False), arm(12.0).configuration([0.0, 2.9, 0.1])),
    "60 m, turned base": lambda: moved(
        arm(60.0),
        arm(60.0).configuration(
            [0.5, 1.0, 1.0], pin.SE3(pin.rpy.rpyToMatrix(1.0, -0.5, 2.0), np.array([7e3, 0.0, -5.0]))
        ),
    ),
    "two arms": lambda: moved(robot := ssm.load_robot("two_arms"), robot.configuration()),
}


def tiny_ets():
    own = ssm.load_robot("ets_vii")
    robot = ssm.Robot(resized(own.urdf, 0.02), name="tiny", end_effector=own.end_effector)
    return moved(robot, robot.configuration(START))


@pytest.mark.parametrize("name", [*SIZES, "ETS-VII, 0.3 m"])
def test_the_configuration_frames_the_robot_that_it_shows(name):
    """Every link is inside the limits and inside the picture, and the robot fills it."""
    motion = SIZES[name]() if name in SIZES else tiny_ets()
    figure = figures.configuration(motion)
    drawn(figure)
    width, height = figure.bbox.size
    robot = ssm.simulation.motion.robot_of(motion)
    for axes, sample, side in zip(figure.axes, (0, -1), (0, 1), strict=True):
        q = motion.configuration.values[sample]
        pin.framesForwardKinematics(robot.model, data := robot.model.createData(), q)
        frames = np.array([data.oMf[i].translation for i in range(1, robot.model.nframes)])
        (shapes,) = (child for child in axes.get_children() if isinstance(child, Poly3DCollection))
        corners = np.asarray(shapes._vec)[:3].T if hasattr(shapes, "_vec") else np.vstack(shapes._faces)
        body = np.vstack([frames, corners[np.isfinite(corners).all(axis=1)]])
        low, high = np.array([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()]).T
        assert np.all(low <= body.min(axis=0)), name
        assert np.all(body.max(axis=0) <= high), name
        share = np.ptp(body, axis=0).max() / (high - low).max()
        assert share > 0.4, (name, share)
        x, y, _ = proj3d.proj_transform(*body.T, axes.get_proj())
        pixels = axes.transData.transform(np.column_stack([x, y]))
        assert np.all((0.5 * side * width <= pixels[:, 0]) & (pixels[:, 0] <= 0.5 * (side + 1) * width)), name
        assert np.all((0.05 * height <= pixels[:, 1]) & (pixels[:, 1] <= 0.9 * height)), name
        extent = np.ptp(pixels, axis=0) / [0.5 * width, height]
        assert extent.max() > 0.4, (name, extent)
        # All arms: every joint of the model is a point of a line.
        points = np.vstack([np.array(line.get_data_3d()).T for line in axes.lines if line.get_color() == "#333333"])
        for joint in range(2, robot.model.njoints):
            assert np.linalg.norm(points - data.oMi[joint].translation, axis=1).min() < 1e-9 * robot.reach + 1e-12


def labels(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_the_ets_vii_s_arm_is_large_enough_to_read():
    motion = dataclasses.replace(ssm.load_case("case1"), duration=2.0).run()
    figure = figures.configuration(motion)
    drawn(figure)
    axes = figure.axes[0]
    x, y, _ = proj3d.proj_transform(*axes.lines[0].get_data_3d(), axes.get_proj())
    inches = np.ptp(axes.transData.transform(np.column_stack([x, y])), axis=0) / figure.dpi
    assert np.linalg.norm(inches) > 0.4
    assert labels(figure) == ["end-effector path", "target", "protected axis $U_c$"]


@pytest.mark.filterwarnings("ignore:the target .* beyond the arm's reach")
def test_what_of_a_motion_is_beside_the_picture_is_told():
    robot = ssm.load_robot("ets_vii")
    far = moved(robot, robot.configuration(START), way=np.array([0.0, 300.0, 0.0]))
    told = labels(figures.configuration(far))
    assert any(re.fullmatch(r"target: 300 m away, outside the picture", word) for word in told), told
    nowhere = far.copy(deep=True)
    nowhere.target_position[:] = np.nan
    assert labels(figures.configuration(nowhere)) == ["end-effector path", "protected axis $U_c$"]
    drifting = far.copy(deep=True)
    drifting.end_effector_position[:] += np.linspace(0.0, 100.0, far.sizes["time"])[:, None]
    assert "end-effector path (not all in the picture)" in labels(figures.configuration(drifting))
    mixed = moved(robot, robot.configuration(START), np.eye(6)[:, [0, 2, 5]])
    assert "2 of $U_c$ with a translation, not drawn" in labels(figures.configuration(mixed))


def test_samples_that_are_no_numbers_are_told_everywhere():
    case = dataclasses.replace(ssm.load_case("case1"), duration=4.0, dt=0.5)
    whole = case.run()
    motion = whole.copy(deep=True)
    for name in ("configuration", "joint_rates", "base_rpy", "protected_rate", "end_effector_error", "joint_positions"):
        motion[name][6:] = np.nan
    for kind in ("joints", "base", "protected_rate", "error"):
        figure = figures.FIGURES[kind](motion)
        drawn(figure)
        told = [text.get_text() for axes in figure.axes for text in axes.texts]
        assert "not a number at 3 of the samples" in told, (kind, told)
        figure = figures.FIGURES[kind](whole)
        assert not any("not a number" in text.get_text() for axes in figure.axes for text in axes.texts)
    titles = [text.get_text() for text in figures.configuration(motion).texts]
    assert "end, t = 2.5 s, the last that is a number" in titles
    motion["configuration"][:] = np.nan
    with pytest.raises(ssm.InputError, match="no sample whose configuration is finite"):
        figures.configuration(motion)
    with pytest.raises(ssm.InputError, match=r"9 of 9 samples whose configuration is not finite"):
        scenes_of(motion)


@pytest.mark.filterwarnings("error")
def test_a_record_of_one_sample_is_drawn():
    case = dataclasses.replace(ssm.load_case("case3"), duration=2.0, dt=0.5)
    motions = {law: motion.isel(time=slice(0, 1)) for law, motion in ssm.compare(case).motions.items()}
    for kind in figures.FIGURES:
        figure = figures.FIGURES[kind](motions["selective"])
        drawn(figure)
        if kind != "configuration":
            assert all(
                line.get_marker() == "o" for axes in figure.axes for line in axes.lines if len(line.get_xdata()) == 1
            )
    drawn(figures.comparison(motions))


def test_logarithmic_axes_say_where_their_floor_is():
    case = dataclasses.replace(ssm.load_case("case1"), duration=4.0, dt=0.5)
    motions = {law: motion.copy(deep=True) for law, motion in ssm.compare(case).motions.items()}
    sheet = figures.comparison(motions)
    assert not sheet.axes[0].texts
    motions["selective"].protected_rate[3:5] = 0.0
    motions["selective"].protected_rate[6] = 1e-30
    motions["selective"].smallest_singular_value[2] = 0.0
    motions["none"].base_angular_velocity[1, 2] = 4.0  # faster than any that was thought of
    sheet = figures.comparison(motions)
    drawn(sheet)
    disturbed, singular = sheet.axes[1:3]
    assert [text.get_text() for text in disturbed.texts] == ["1e-21 rad/s or less: zero or rounding"]
    assert "1e-09 m or less: zero or rounding" in [text.get_text() for text in singular.texts]
    line = disturbed.lines[list(motions).index("selective")]
    np.testing.assert_array_equal(np.asarray(line.get_ydata())[[3, 4, 6]], figures.FLOOR)
    low = np.flatnonzero(np.asarray(line.get_ydata()) == figures.FLOOR)
    assert list(line.get_markevery()) == list(low)
    assert {3, 4, 6} <= set(low)
    low, high = disturbed.get_ylim()
    for line in disturbed.lines:
        assert low < np.min(line.get_ydata()) <= np.max(line.get_ydata()) < high
    motion = motions["selective"]
    motion.end_effector_error[5:] = [1e-53, 0.0, 1e-17, 1e-14]
    figure = figures.error(motion)
    (axes,) = figure.axes
    assert axes.get_ylim()[0] > figures.FLOOR_ERROR / 1e4
    assert any(text.get_text() == "1e-12 mm or less: zero or rounding" for text in axes.texts)


SLIDER = """<robot name="s"><link name="base"><inertial><mass value="100"/>
<inertia ixx="9" iyy="9" izz="9" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="rail"><inertial><mass value="5"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
</link>
<link name="tip"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="slide" type="prismatic"><parent link="base"/><child link="rail"/><axis xyz="1 0 0"/>
<limit lower="0" upper="1" effort="9" velocity="0.05"/></joint>
<joint name="turn" type="continuous"><parent link="rail"/><child link="tip"/><origin xyz="0 0 0.8"/><axis xyz="0 1 0"/>
</joint></robot>"""


def test_sliders_turning_joints_and_wheels_have_units_of_their_own():
    robot = ssm.Robot(SLIDER, name="s").with_wheels(
        [ssm.Wheel("wheel", [0, 0, 1], spin_inertia=0.1, max_speed=600.0, max_torque=0.2)]
    )
    q = robot.configuration({"slide": 0.5, "turn": 0.3})
    law = ssm.SelectiveLaw(robot, ssm.Protection("none"), rate_limit=[0.05, 0.1, 10.0])
    motion = ssm.simulate(law, q, robot.frame_pose(q).translation + [0.1, 0, 0], 3.0, 0.5)
    kinds = dict(zip(motion.joint.values, joint_kinds(motion), strict=True))
    assert kinds == {"slide": "sliding", "turn": "turning", "wheel": "wheel"}
    figure = figures.joints(motion)
    drawn(figure)
    where = {name: i for i, name in enumerate(motion.joint.values)}
    expected = [("turn", "deg", 180 / np.pi), ("slide", "mm", 1e3), ("wheel", "rad", 1.0)]
    for (name, unit, factor), top, bottom in zip(expected, figure.axes[::2], figure.axes[1::2], strict=True):
        assert f"({unit})" in top.get_ylabel()
        assert f"({unit}/s)" in bottom.get_ylabel()
        for axes, values in ((top, motion.joint_positions.values), (bottom, motion.joint_rates.values)):
            (line,) = axes.lines
            np.testing.assert_allclose(line.get_ydata(), factor * values[:, where[name]])
    assert sorted(labels(figure)) == ["slide", "turn", "wheel"]
    plots = {plot.title: plot for plot in curves_of(scenes_of(motion), 0)}
    for (name, unit, factor), word in zip(expected, ("joint", "slider", "wheel"), strict=True):
        ((label, _, values),) = plots[f"{word} rates ({unit}/s)"].lines
        assert label == name
        np.testing.assert_allclose(values[-1], factor * motion.joint_rates.values[-1, where[name]])


def test_more_joints_than_a_legend_has_room_for_are_told():
    robot = arm(14.0, joints=14)
    figure = figures.joints(moved(robot, robot.configuration(np.full(14, 0.1)), duration=1.0))
    assert not figure.legends
    assert figure._suptitle.get_text() == "14 joints, from j0 (dark) to j13 (light)"


def test_axes_that_lie_on_each_other_are_all_seen():
    motion = dataclasses.replace(ssm.load_case("case1"), duration=2.0, dt=0.5).run()
    motion.base_rpy[:] = 0.0
    picture = drawn(figures.base(motion))
    for color in ((0xD5, 0x5E, 0x00), (0x00, 0x9E, 0x73), (0x00, 0x72, 0xB2)):
        near = np.abs(picture[: picture.shape[0] // 2, picture.shape[1] // 4 :] - color).max(axis=-1) < 40
        assert near[60:].sum() > 30, color
    motion.base_rpy[:, 2] = np.linspace(3.1, 3.2, motion.sizes["time"]) - 2 * np.pi * (
        np.linspace(3.1, 3.2, motion.sizes["time"]) > np.pi
    )
    assert np.ptp(figures.base(motion).axes[0].lines[2].get_ydata()) < 10.0  # no jump at 180 deg


def test_labels_name_the_axes_and_the_units_of_other_tasks(ets_vii):
    q = ets_vii.configuration(START)
    for frame in ("base", "inertial", "link_3"):
        law = ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw", frame), rate_limit=0.05)
        motion = ssm.simulate(law, q, ets_vii.frame_pose(q).translation + [0.1, 0, 0], 1.0, 0.5)
        assert figures.protected_rate(motion).axes[0].get_ylabel().endswith(f"\n{frame.replace('_', ' ')} axes")
    law = ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw"), rate_limit=0.05, tasks=[ssm.PostureTask()])
    motion = ssm.simulate(law, q, START + 0.1, 1.0, 0.5)
    motion.attrs.setdefault("arrival_tolerance", 0.01)
    (axes,) = figures.error(motion).axes
    assert axes.get_ylabel() == "error of level 1 (m, rad)"
    np.testing.assert_allclose(axes.lines[0].get_ydata()[0], 0.1 * np.sqrt(6.0))
    (scene,) = scenes_of({"posture": motion})
    assert curves_of([scene], 0)[0].title == "left (m, rad)"


def test_a_schedule_s_line_is_pale_while_it_does_not_protect():
    case = dataclasses.replace(ssm.load_case("case1"), duration=4.0, dt=0.5)
    motion = case.run()
    share = np.ones((motion.sizes["time"], 1))
    share[3:6] = 0.0
    motion["protection_share"] = (("time", "protected"), share)
    (axes,) = figures.protected_rate(motion).axes
    full, pale = axes.lines
    np.testing.assert_array_equal(np.ma.getmaskarray(full.get_ydata(orig=True)), share[:, 0] < 1.0)
    assert (pale.get_alpha(), pale.get_label()) == (0.35, "not protected")


def test_names_are_no_html_on_the_page():
    told = caption("a<b", [("<img src=x onerror=alert(1)>", "#fff", np.zeros(2))])
    assert "<img" not in told
    assert "a&lt;b" in told
