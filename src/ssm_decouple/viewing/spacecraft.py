"""The spacecraft in three dimensions, from the shapes in its URDF, framed as large as it is."""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
import xarray as xr
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D, proj3d
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from ssm_decouple.errors import DecoupleWarning, InputError
from ssm_decouple.model.robot import Robot
from ssm_decouple.model.urdf import Shape
from ssm_decouple.simulation.motion import robot_of
from ssm_decouple.viewing.style import PAGE, PROTECTED, TARGET
from ssm_decouple.viewing.viewer.parts import Part, bus, spacecraft_parts
from ssm_decouple.viewing.viewer.scene import wings_of

Floats = NDArray[np.float64]

_LIGHT = np.array([-0.45, 0.55, 0.75]) / np.linalg.norm([-0.45, 0.55, 0.75])
_TILES = 20  # along the spacecraft: large faces are cut into tiles, because depth is sorted face by face
_WAYS = 150
_ELEVATION, _AZIMUTHS = 24.0, (132.0, 122.0, 112.0, 142.0, 152.0)  # deg; of these the one that shows most of the arm
_BESIDE = 0.5  # of the spacecraft's size: how far beside it the path and the target are in the picture
_HEIGHT, _TOP, _BOTTOM = 3.2, 0.5, 0.3  # inches: of the figure, of its titles and of its legend
_ROOM = 0.96 * np.array([PAGE / 2, _HEIGHT - _TOP - _BOTTOM])  # inches: what a spacecraft fills


@dataclass(frozen=True)
class _Sight:
    """A spacecraft at one time: what is drawn of it, inertial axes.

    Attributes:
        pose: Of the base.
        faces: Polygons (.., 3), m.
        colors: Of the faces.
        arms: Joints of each arm from its root to its tip (.., 3), m; the first is that of the end-effector.
        axes: Ends of each protected axis (k, 2, 3), m.
        bus: Corners of the box around the bus (8, 3), m.
        size: Largest extent of the spacecraft, m.
    """

    pose: pin.SE3
    faces: list[Floats]
    colors: list[Floats]
    arms: list[Floats]
    axes: Floats
    bus: Floats
    size: float

    @property
    def body(self) -> Floats:
        """All points of the spacecraft (.., 3), m."""
        return np.vstack([*self.faces, *self.arms])

    def triad(self, azimuth: float) -> Floats:
        """Return the corner, and the ends of the base axes (4, 3), m, of a triad that stands beside the bus."""
        right, up = _screen(azimuth)
        place = (0.09 * self.size + np.max(self.bus @ right)) * right + np.min(self.bus @ up) * up
        corner = place + (self.pose.translation @ np.cross(right, up)) * np.cross(right, up)
        return np.vstack([corner, corner + 0.055 * self.size * self.pose.rotation.T])


def draw_configurations(motion: xr.Dataset) -> Figure:
    """Draw the spacecraft at the start and at the end of a motion, side by side and in one scale.

    It fills the panels whatever its size, at least two fifths of their room where the path or the target stand beside
    it. What of these is farther away than half its size is left out, and the legend says so.

    Raises:
        InputError: no sample of the motion is a number.
    """
    robot = robot_of(motion)
    parts, told = _parts(robot, motion)
    samples = _samples(motion)
    seen = [_sight(motion, robot, parts, sample) for sample in samples]
    azimuth = max(_AZIMUTHS, key=lambda angle: _arm_share(seen[0], angle))
    shown = [_shown(motion, sight, sample, azimuth) for sight, sample in zip(seen, samples, strict=True)]
    frames = [np.array([points.min(axis=0), points.max(axis=0)]) for points in shown]
    figure = Figure(figsize=(PAGE, _HEIGHT))
    figure.set_layout_engine("none")
    for i, (sample, sight, frame) in enumerate(zip(samples, seen, frames, strict=True)):
        axes = figure.add_subplot(1, 2, i + 1, projection="3d", computed_zorder=False)
        _draw_spacecraft(axes, sight)
        _draw_motion(axes, motion, sample, sight, frame)
        _draw_triad(axes, sight.triad(azimuth))
        _set_view(axes, frame, azimuth)
        last = "" if i == 0 or samples[1] == motion.sizes["time"] - 1 else ", the last that is a number"
        label = f"{('start', 'end')[i]}, t = {float(motion.time[sample]):g} s{last}"
        figure.text(0.25 + 0.5 * i, 1.0 - 0.86 * _TOP / _HEIGHT, label, ha="center", va="center", fontsize=8)
    _fill(figure, shown)
    figure.suptitle(motion.attrs.get("title", motion.attrs["robot"]), fontsize=9, y=1.0 - 0.3 * _TOP / _HEIGHT)
    labelled: dict[str, Any] = {}
    for axes in figure.axes:
        handles, labels = axes.get_legend_handles_labels()
        labelled |= dict(zip(labels, handles, strict=True))
    figure.legend(list(labelled.values()), list(labelled), ncols=len(labelled), loc="lower center", borderaxespad=0.2)
    if told:
        figure.text(0.01, _BOTTOM / _HEIGHT, told, va="bottom", fontsize=6, color="#8C8C8C")
    return figure


def _samples(motion: xr.Dataset) -> tuple[int, int]:
    """Return the first and the last sample whose configuration is finite."""
    there = np.flatnonzero(np.isfinite(motion.configuration.values).all(axis=1))
    if not there.size:
        raise InputError("the motion has no sample whose configuration is finite; there is nothing to draw")
    return int(there[0]), int(there[-1])


def _parts(robot: Robot, motion: xr.Dataset) -> tuple[list[Part], str]:
    """Return the shapes, with those of appendages that the URDF does not draw, and what is to be said of them."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", DecoupleWarning)
        parts = spacecraft_parts(robot, json.loads(motion.attrs.get("turned", "{}")))
    names = {part.name for part in parts if part.joint == 1 and part.kind == "box"}
    parts += [wing.plate for wing in wings_of(motion, parts) if wing.appendage.name not in names]
    if "<visual" not in robot.urdf:
        return parts, "the URDF draws no shapes: boxes stand for its links"
    return parts, "meshes that are not found are drawn as boxes" if caught else ""


def _sight(motion: xr.Dataset, robot: Robot, parts: Sequence[Part], sample: int) -> _Sight:
    q = motion.configuration.values[sample]
    pin.framesForwardKinematics(robot.model, data := robot.model.createData(), q)
    arms = _arms(robot, data, motion.wheel.values if "wheel" in motion.coords else ())
    corners = [data.oMi[part.joint].act(corner) for part in parts for corner in part.corners]
    size = float(np.max(np.ptp(np.vstack([*arms, *corners]), axis=0))) or 1.0
    faces: list[Floats] = []
    colors: list[Floats] = []
    for part in parts:
        pose = data.oMi[part.joint] * part.pose
        for face in _faces(part, size / _TILES):
            corners_ = face @ pose.rotation.T + pose.translation
            normal = np.cross(corners_[1] - corners_[0], corners_[2] - corners_[1])
            shade = 0.72 + 0.28 * float(normal @ _LIGHT) / max(float(np.linalg.norm(normal)), 1e-300)
            faces.append(corners_)
            colors.append(np.clip(shade * np.array(part.color), 0, 1))
    pose, box = robot.base_pose(q), bus(parts)
    axes = np.array([_axis(pose, box, size, direction) for direction in _directions(motion, robot, sample)])
    corners = [pose.act(corner) for corner in np.array(np.meshgrid(*box.T)).reshape(3, -1).T]
    return _Sight(pose, faces, colors, arms, axes.reshape(-1, 2, 3), np.array(corners), size)


def _arms(robot: Robot, data: pin.Data, wheel_names: Sequence[str]) -> list[Floats]:
    """Return the joints of each arm from root to tip, that of the end-effector first; reaction wheels are none."""
    model, tool = robot.model, robot.model.frames[robot.end_effector_id]
    wheels = {model.getJointId(str(name)) for name in wheel_names}

    def chain(joint: int, tip: Floats) -> Floats:
        return np.vstack([*(data.oMi[j].translation for j in model.supports[joint] if j > 1), tip])

    arms = [chain(tool.parentJoint, data.oMf[robot.end_effector_id].translation)]
    for joint in range(2, model.njoints):
        if joint in wheels or len(model.subtrees[joint]) > 1 or joint in model.supports[tool.parentJoint]:
            continue
        root = data.oMi[joint].translation
        held = [data.oMf[i].translation for i, frame in enumerate(model.frames) if frame.parentJoint == joint]
        farthest = int(np.argmax([np.linalg.norm(tip - root) for tip in held]))
        arms.append(chain(joint, held[farthest]))
    return arms


def _directions(motion: xr.Dataset, robot: Robot, sample: int) -> Floats:
    """Return the protected axes of rotation (k, 3), inertial axes; a direction with a linear part is none."""
    U_c, q = motion.U_c.values, motion.configuration.values[sample]
    turns = U_c[3:, ~np.any(U_c[:3], axis=0)]
    return (robot.coupling(q).inertial().rotation_of(json.loads(motion.attrs["law"])["frame"]) @ turns).T


def _axis(pose: pin.SE3, box: Floats, size: float, direction: Floats) -> Floats:
    """Return the ends (2, 3), m, of a line through the base origin that stands out of the bus on both sides."""
    along = np.abs(pose.rotation.T @ direction) @ np.abs(box).max(axis=0)
    return pose.translation + np.outer([-1.0, 1.0], (1.1 * along + 0.06 * size) * direction)


def _shown(motion: xr.Dataset, sight: _Sight, sample: int, azimuth: float) -> Floats:
    """Return points (.., 3), m, whose box a panel shows: the spacecraft, and what is near of path and target."""
    body = sight.body
    low, high = body.min(axis=0) - _BESIDE * sight.size, body.max(axis=0) + _BESIDE * sight.size
    beside = np.vstack([motion.end_effector_position.values, motion.target_position.values[sample]])
    beside = beside[np.all((low <= beside) & (beside <= high), axis=1)]
    points = np.vstack([body, sight.axes.reshape(-1, 3), _beyond(sight.triad(azimuth)), beside])
    room = 0.01 * sight.size
    return np.vstack([points, points.min(axis=0) - room, points.max(axis=0) + room])


def _arm_share(sight: _Sight, azimuth: float) -> float:
    """Return how large, inches, the arm is in a panel that the spacecraft fills, seen from an azimuth, deg."""
    arm, body = (np.ptp(points @ _screen(azimuth).T, axis=0) for points in (sight.arms[0], sight.body))
    return float(np.linalg.norm(arm) * np.min(_ROOM / np.maximum(body, 1e-300)))


def _screen(azimuth: float) -> Floats:
    """Return the directions to the right and upwards in the picture (2, 3)."""
    a, e = np.deg2rad(azimuth), np.deg2rad(_ELEVATION)
    return np.array([[-np.sin(a), np.cos(a), 0.0], [-np.cos(a) * np.sin(e), -np.sin(a) * np.sin(e), np.cos(e)]])


def _draw_spacecraft(axes: Axes3D, sight: _Sight) -> None:
    edges = [0.85 * color for color in sight.colors]
    axes.add_collection3d(
        Poly3DCollection(sight.faces, facecolors=sight.colors, edgecolors=edges, linewidths=0.2, zorder=1)
    )
    for arm in sight.arms:
        axes.plot(*arm.T, color="#333333", linewidth=1.0, marker="o", markersize=1.8, zorder=3)


def _draw_motion(axes: Axes3D, motion: xr.Dataset, sample: int, sight: _Sight, frame: Floats) -> None:
    path, target = motion.end_effector_position.values.copy(), motion.target_position.values[sample]
    outside = ~np.all((frame[0] <= path) & (path <= frame[1]), axis=1)
    part = " (not all in the picture)" if np.any(outside & np.isfinite(path).all(axis=1)) else ""
    path[outside] = np.nan
    axes.plot(*path.T, color="#D55E00", linewidth=1.0, label=f"end-effector path{part}", zorder=4)
    star: dict[str, Any] = {"color": TARGET, "marker": "*", "markersize": 6, "linestyle": "none", "zorder": 5}
    if np.all((frame[0] <= target) & (target <= frame[1])):
        axes.plot(*target[:, None], label="target", **star)
    elif np.all(np.isfinite(target)):
        away = float(np.linalg.norm(target - motion.end_effector_position.values[sample]))
        axes.plot([], [], [], label=f"target: {away:.3g} m away, outside the picture", **star)
    name = "protected axis $U_c$" if len(sight.axes) == 1 else "protected axes $U_c$"
    for i, ends in enumerate(sight.axes):
        label = name if i == 0 else None
        axes.plot(*ends.T, color=PROTECTED, linewidth=1.6, label=label, zorder=4)
        tip = 0.12 * (ends[1] - ends[0])
        axes.quiver(*(ends[1] - tip), *tip, color=PROTECTED, linewidth=1.6, arrow_length_ratio=0.6, zorder=4)
    mixed = motion.sizes["protected"] - len(sight.axes)
    if mixed:
        axes.plot([], [], [], linestyle="none", label=f"{mixed} of $U_c$ with a translation, not drawn")


def _draw_triad(axes: Axes3D, triad: Floats) -> None:
    for end, at, word in zip(triad[1:], _beyond(triad)[1:], "xyz", strict=True):
        axes.plot(*np.array([triad[0], end]).T, color="#555555", linewidth=0.9, zorder=4)
        axes.text(*at, word, fontsize=7, color="#555555", ha="center", va="center")


def _beyond(triad: Floats) -> Floats:
    """Return where a triad's letters stand, m, after its corner."""
    return triad[0] + 1.35 * (triad - triad[0])


def _set_view(axes: Axes3D, frame: Floats, azimuth: float) -> None:
    for set_limits, (low, high) in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), frame.T, strict=True):
        set_limits(low, high)
    axes.set_proj_type("ortho")
    axes.set_box_aspect(np.ptp(frame, axis=0))
    axes.view_init(elev=_ELEVATION, azim=azimuth)
    axes.set_axis_off()
    axes.patch.set_visible(False)  # the squares of the two panels lie over each other


def _fill(figure: Figure, shown: Sequence[Floats]) -> None:
    """Place the panels so that what they show fills their room in one scale.

    Matplotlib fits the box of the limits into a square, with room about it. The square is therefore made as large, and
    moved so far, that the points themselves, as they are projected, are fitted into the middle of the panel.
    """
    extents, middles = [], []
    for axes, points in zip(figure.axes, shown, strict=True):
        assert isinstance(axes, Axes3D)
        x, y, _ = proj3d.proj_transform(*points.T, axes.get_proj())
        at = axes.transLimits.transform(np.column_stack([x, y]))  # shares of the square
        low, high = at.min(axis=0), at.max(axis=0)
        # Where the square is as long as the diagonal of the limits' box, m and inches are the same in both panels.
        extents.append((high - low) * np.linalg.norm(np.ptp(points, axis=0)))
        middles.append(0.5 * (low + high))
    scale = float(np.min(_ROOM / np.max(extents, axis=0)))  # inches per m, but for one factor
    size = np.array([PAGE, _HEIGHT])
    for i, (axes, points, middle) in enumerate(zip(figure.axes, shown, middles, strict=True)):
        square = scale * float(np.linalg.norm(np.ptp(points, axis=0)))
        centre = np.array([(0.25 + 0.5 * i) * PAGE, _BOTTOM + 0.5 * (_HEIGHT - _TOP - _BOTTOM)])
        for artist in axes.get_children():
            artist.set_clip_on(False)  # a long spacecraft stands out of the square, not out of the panel
        axes.set_position((*((centre - square * middle) / size), *(square / size)))


def _faces(shape: Shape | Part, tile: float = 0.8) -> list[Floats]:
    """Return the faces of a shape in its own axes, m, outsides out: a box is cut into tiles, a mesh has its hull's."""
    if shape.kind == "box":
        return _box_faces(np.array(shape.size), tile)
    if shape.kind == "cylinder":
        return _cylinder_faces(shape.size[0], shape.size[1])
    if shape.kind == "sphere":
        return _sphere_faces(shape.size[0])
    assert isinstance(shape, Part)
    return _hull_faces(shape.vertices)


def _hull_faces(vertices: Floats) -> list[Floats]:
    """Return the hull of a mesh, of its vertices that are farthest in each of some hundred directions."""
    k = np.arange(0.5, _WAYS)
    up, around = 1.0 - 2.0 * k / _WAYS, np.pi * (1.0 + np.sqrt(5.0)) * k  # a spiral, even over the sphere
    ways = np.vstack([np.sqrt(1.0 - up**2) * np.cos(around), np.sqrt(1.0 - up**2) * np.sin(around), up]).T
    kept = vertices[np.unique(np.argmax(vertices @ np.vstack([ways, np.eye(3), -np.eye(3)]).T, axis=0))]
    hull = ConvexHull(kept, qhull_options="QJ")
    corners, outwards = kept[hull.simplices], hull.equations[:, :3]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1])
    inwards = np.einsum("fi,fi->f", normals, outwards) < 0
    corners[inwards] = corners[inwards, ::-1]
    return list(corners)


def _box_faces(size: Floats, tile: float) -> list[Floats]:
    faces = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        pieces = np.maximum(1, np.round(size[[u, v]] / tile).astype(int))
        for sign in (-1.0, 1.0):
            for i in range(pieces[0]):
                for j in range(pieces[1]):
                    square: Any = np.zeros((4, 3))
                    square[:, axis] = sign / 2
                    square[:, u] = (i + np.array([0, 1, 1, 0])) / pieces[0] - 0.5
                    square[:, v] = (j + np.array([0, 0, 1, 1])) / pieces[1] - 0.5
                    faces.append(square[:: int(sign)] * size)
    return faces


def _cylinder_faces(radius: float, length: float, sides: int = 16) -> list[Floats]:
    angles = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = np.column_stack([radius * np.cos(angles), radius * np.sin(angles), np.zeros(sides)])
    low, high = ring - [0, 0, length / 2], ring + [0, 0, length / 2]
    walls = [np.array([low[i], low[(i + 1) % sides], high[(i + 1) % sides], high[i]]) for i in range(sides)]
    # The ends as quadrilaterals about their centre: every face has four corners.
    lids = [
        np.array([ring[(i + step) % sides] for step in order] + [[0, 0, middle]])
        for ring, middle, order in ((low, -length / 2, (2, 1, 0)), (high, length / 2, (0, 1, 2)))
        for i in range(0, sides, 2)
    ]
    return [*walls, *lids]


def _sphere_faces(radius: float, sides: int = 12) -> list[Floats]:
    up = np.linspace(-np.pi / 2, np.pi / 2, sides // 2 + 1)
    round_ = np.linspace(0, 2 * np.pi, sides + 1)

    def point(a: float, b: float) -> list[float]:
        return [radius * np.cos(a) * np.cos(b), radius * np.cos(a) * np.sin(b), radius * np.sin(a)]

    return [
        np.array(
            [
                point(up[i], round_[j]),
                point(up[i], round_[j + 1]),
                point(up[i + 1], round_[j + 1]),
                point(up[i + 1], round_[j]),
            ]
        )
        for i in range(len(up) - 1)
        for j in range(sides)
    ]
