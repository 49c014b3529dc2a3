from __future__ import annotations

import re

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from PIL import Image

import ssm_decouple as ssm
from ssm_decouple.viewing import figures, style
from ssm_decouple.viewing.spacecraft import _faces
from ssm_decouple.viewing.table import HEADINGS, cells, explain, markdown_table, terminal_table


@pytest.fixture(scope="module")
def compared():
    import dataclasses

    return ssm.compare(dataclasses.replace(ssm.load_case("case3"), duration=60.0, dt=0.5))


@pytest.fixture(scope="module")
def motion(compared):
    return compared.motions["selective"]


@pytest.mark.parametrize("kind", ["joints", "base", "protected_rate", "error"])
def test_every_axis_is_labelled_with_its_unit(motion, kind):
    figure = figures.FIGURES[kind](motion)
    assert figure.get_size_inches()[0] == style.COLUMN
    for axes in figure.axes:
        assert re.search(r"\(.*(deg|mm|rad/s).*\)", axes.get_ylabel())
    assert figure.axes[-1].get_xlabel() == "time (s)"
    assert figure.axes[-1].get_xlim() == (0.0, 60.0)


def test_the_curves_are_the_motion(motion):
    top, bottom = figures.joints(motion).axes
    for i in range(6):
        np.testing.assert_allclose(top.lines[i].get_ydata(), np.rad2deg(motion.joint_positions.values[:, i]))
        np.testing.assert_allclose(bottom.lines[i].get_ydata(), np.rad2deg(motion.joint_rates.values[:, i]))
    top, bottom = figures.base(motion).axes
    for i in range(3):
        np.testing.assert_allclose(top.lines[i].get_ydata(), np.rad2deg(motion.base_rpy.values[:, i]))
        np.testing.assert_allclose(bottom.lines[i].get_ydata(), 1e3 * motion.base_angular_velocity.values[:, i])
    (axes,) = figures.protected_rate(motion).axes
    exponent = int(re.search(r"10\^\{(-\d+)\}", axes.get_ylabel())[1])
    np.testing.assert_allclose(axes.lines[1].get_ydata() * 10.0**exponent, motion.protected_rate.values[:, 1])


def test_the_same_thing_has_the_same_colour(compared, motion):
    top, bottom = figures.base(motion).axes
    assert [line.get_color() for line in top.lines[:3]] == [line.get_color() for line in bottom.lines[:3]]
    sheet = figures.comparison(compared.motions)
    for axes in sheet.axes:
        for line, law in zip(axes.lines, compared.motions, strict=False):
            assert line.get_color() == style.LAW_LINES[law]["color"]
    assert len({to_hex(color) for color in style.joint_colors(7)}) == 7


def test_the_comparison_has_a_line_for_each_law(compared):
    sheet = figures.comparison(compared.motions)
    assert len(sheet.axes) == 6
    (legend,) = sheet.legends
    assert [text.get_text() for text in legend.get_texts()] == list(compared.motions)
    for axes, motion in zip(sheet.axes[:1], compared.motions.values(), strict=False):
        np.testing.assert_allclose(axes.lines[0].get_ydata(), 1e3 * motion.end_effector_error)


def test_the_spacecraft_is_drawn_with_the_target_and_the_protected_axes(motion):
    figure = figures.configuration(motion)
    start, end = figure.axes
    for axes, sample in ((start, 0), (end, -1)):
        labels = {line.get_label(): line for line in axes.lines}
        target = np.array(labels["target"].get_data_3d())[:, 0]
        np.testing.assert_allclose(target, motion.target_position.values[sample])
        x, y, z = np.array(axes.lines[0].get_data_3d())[:, -1]  # the arm's line ends at the end-effector
        np.testing.assert_allclose([x, y, z], motion.end_effector_position.values[sample], atol=1e-12)
        axis = np.diff(np.array(labels["protected axes $U_c$"].get_data_3d()), axis=1)[:, 0]
        np.testing.assert_allclose(axis / np.linalg.norm(axis), [1, 0, 0], atol=0.01)


def test_turned_wings_are_drawn_turned():
    import dataclasses

    case = ssm.load_case("case2")
    assert {name: round(np.rad2deg(angle)) for name, angle in case.turned.items()}["wing_left"] == 30
    motion = dataclasses.replace(case, duration=1.0).run()
    flat = motion.copy()
    flat.attrs["turned"] = "{}"
    images = []
    for variant in (motion, flat):
        canvas = FigureCanvasAgg(figures.configuration(variant))
        canvas.draw()
        images.append(np.asarray(canvas.buffer_rgba()).copy())
    assert np.mean(images[0] != images[1]) > 0.01


@pytest.mark.parametrize("kind", [("box", (0.04, 6.5, 2.4)), ("cylinder", (0.1, 0.87)), ("sphere", (0.3,))])
def test_shapes_are_closed_and_of_the_right_size(kind):
    """The faces' outward area vectors of a closed body sum to zero, and their flux gives its volume."""
    from ssm_decouple.model.urdf import Shape

    name, size = kind
    faces = _faces(Shape("", "", name, size, np.zeros(3), np.zeros(3), (1, 1, 1)))
    assert {face.shape for face in faces} == {(4, 3)}
    area, volume = np.zeros(3), 0.0
    for face in faces:
        vector = 0.5 * np.cross(face[2] - face[0], face[3] - face[1])
        area += vector
        volume += face.mean(axis=0) @ vector / 3
    np.testing.assert_allclose(area, 0, atol=1e-12)
    exact = {"box": np.prod(size), "cylinder": np.pi * size[0] ** 2 * size[-1], "sphere": 4 / 3 * np.pi * size[0] ** 3}[
        name
    ]
    assert volume == pytest.approx(exact, rel={"box": 1e-12, "cylinder": 0.03, "sphere": 0.2}[name])


def test_a_motion_without_protection_can_be_drawn(compared):
    none = compared.motions["none"]
    assert "nothing is protected" in [text.get_text() for text in figures.protected_rate(none).axes[0].texts]
    figures.configuration(none)


def test_protected_twists_are_drawn_with_their_units():
    import dataclasses

    rows = np.eye(6)[:, [0, 1, 2, 4]]
    case = dataclasses.replace(ssm.load_case("case1"), protection=ssm.Protection(rows), duration=2.0)
    motions = ssm.compare(case).motions
    (axes,) = figures.protected_rate(motions["selective"]).axes
    assert "m/s, rad/s" in axes.get_ylabel()
    assert [text.get_text() for text in axes.get_legend().get_texts()][3] == "along (0, 0, 0, 0, 1, 0)"
    assert len({to_hex(line.get_color()) for line in axes.lines}) == 4
    assert "m/s, rad/s" in figures.comparison(motions).axes[1].get_ylabel()
    # Only the fourth is an axis.
    drawn = figures.configuration(motions["selective"]).axes[0]
    assert sum(line.get_color() == style.PROTECTED for line in drawn.lines) == 1


def test_a_robot_of_meshes_can_be_drawn(robots):
    robot = robots["composed"]
    law = ssm.SelectiveLaw(robot, ssm.Protection("yaw"))
    q = robot.configuration()
    motion = ssm.simulate(law, q, robot.frame_pose(q).translation + [0, 0, -0.1], 2.0, 0.1)
    assert len(figures.configuration(motion).axes) == 2


def test_files_are_written_whole_in_both_formats(motion, tmp_path):
    paths = figures.save_figures(motion, tmp_path / "new" / "folder", "selective")
    assert len(paths) == 10
    assert {path.suffix for path in paths} == {".pdf", ".png"}
    for path in paths:
        if path.suffix == ".pdf":
            assert path.read_bytes().startswith(b"%PDF")
        else:
            image = Image.open(path)
            assert image.width >= 600
            assert len(np.unique(np.asarray(image.convert("L")))) > 20
    assert {path.name for path in (tmp_path / "new" / "folder").iterdir()} == {path.name for path in paths}
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(ssm.FileError, match="cannot write to the folder"):
        figures.save_figures(motion, blocked, "selective")


def test_drawing_leaves_other_people_s_style_alone(motion):
    before = dict(mpl.rcParams)
    figures.base(motion)
    assert dict(mpl.rcParams) == before


def test_tables(compared):
    rows = compared.summaries()
    assert [len(cells(row)) for row in rows] == [len(HEADINGS)] * len(rows)
    assert terminal_table(rows).row_count == len(rows)
    lines = markdown_table(rows).splitlines()
    assert len(lines) == 2 + len(rows)
    assert all(line.count("|") == len(HEADINGS) + 1 for line in lines)
    reasons = [explain(row) for row in rows]
    assert reasons[1] is not None or rows[1].outcome == "converged"
    stuck = explain(rows[-1])
    assert stuck.startswith("case3, reactionless, undamped: stalled at")
    assert "Smallest singular value of J_gt N_sub" in stuck
