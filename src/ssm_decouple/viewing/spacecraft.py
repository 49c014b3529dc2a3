"""The spacecraft in three dimensions, from the shapes in its URDF."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import pinocchio as pin
import xarray as xr
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from numpy.typing import NDArray

from ssm_decouple.model.robot import Robot
from ssm_decouple.model.urdf import Shape, visual_shapes
from ssm_decouple.simulation.motion import robot_of
from ssm_decouple.viewing.style import PAGE, PROTECTED, TARGET

Floats = NDArray[np.float64]

_LIGHT = np.array([-0.45, 0.55, 0.75]) / np.linalg.norm([-0.45, 0.55, 0.75])
_TILE = 0.8  # m: large faces are cut into tiles, because depth is sorted face by face
_VIEW = {"elev": 24.0, "azim": 132.0}


def draw_configurations(motion: xr.Dataset) -> Figure:
    """Draw the spacecraft at the start and at the end of a motion, side by side."""
    robot = robot_of(motion)
    turned = json.loads(motion.attrs.get("turned", "{}"))
    figure = Figure(figsize=(PAGE, 3.2))
    for i, (sample, label) in enumerate(((0, "start"), (-1, "end"))):
        axes = figure.add_subplot(1, 2, i + 1, projection="3d", computed_zorder=False)
        q = motion.configuration.values[sample]
        _draw_spacecraft(axes, robot, q, turned)
        _draw_motion(axes, motion, robot, q)
        axes.set_title(f"{label}, t = {float(motion.time[sample]):g} s", y=0.97)
    figure.suptitle(motion.attrs.get("title", motion.attrs["robot"]), fontsize=9)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, ncols=len(labels), loc="outside lower center")
    return figure


def _draw_spacecraft(axes: Axes3D, robot: Robot, q: Floats, turned: Mapping[str, float]) -> None:
    polygons: list[Floats] = []
    colors: list[Floats] = []
    pin.framesForwardKinematics(robot.model, data := robot.model.createData(), q)
    for shape in visual_shapes(robot.urdf):
        link = data.oMf[robot.model.getFrameId(shape.link)]
        about_y = pin.SE3(pin.rpy.rpyToMatrix(0.0, turned.get(shape.name, 0.0), 0.0), np.zeros(3))
        pose = link * about_y * pin.SE3(pin.rpy.rpyToMatrix(*shape.rpy), shape.xyz)
        for face in _faces(shape):
            corners = face @ pose.rotation.T + pose.translation
            normal = np.cross(corners[1] - corners[0], corners[2] - corners[1])
            shade = 0.72 + 0.28 * float(normal @ _LIGHT) / max(float(np.linalg.norm(normal)), 1e-12)
            polygons.append(corners)
            colors.append(np.clip(shade * np.array(shape.color), 0, 1))
    if polygons:
        edges = [0.85 * color for color in colors]
        axes.add_collection3d(Poly3DCollection(polygons, facecolors=colors, edgecolors=edges, linewidths=0.2, zorder=1))
    skeleton = np.array(
        [
            data.oMi[j].translation
            for j in robot.model.supports[robot.model.frames[robot.end_effector_id].parentJoint]
            if j > 1
        ]
    )
    skeleton = np.vstack([skeleton, data.oMf[robot.end_effector_id].translation])
    axes.plot(*skeleton.T, color="#333333", linewidth=1.0, marker="o", markersize=1.8, zorder=3)


def _draw_motion(axes: Axes3D, motion: xr.Dataset, robot: Robot, q: Floats) -> None:
    path, target = motion.end_effector_position.values, motion.target_position.values[-1]
    axes.plot(*path.T, color="#D55E00", linewidth=1.0, label="end-effector path", zorder=4)
    axes.plot(*target[:, None], color=TARGET, marker="*", markersize=6, linestyle="none", label="target", zorder=5)
    pose = robot.base_pose(q)
    U_c = motion.U_c.values
    # A line is an axis of rotation; a direction with a linear part is none.
    directions = U_c[3:, ~np.any(U_c[:3], axis=0)]
    directions = robot.coupling(q).inertial().rotation_of(json.loads(motion.attrs["law"])["frame"]) @ directions
    for i, direction in enumerate(directions.T):
        name = "protected axis $U_c$" if directions.shape[1] == 1 else "protected axes $U_c$"
        label = name if i == 0 else None
        ends = pose.translation + np.outer([-2.3, 2.3], direction)
        axes.plot(*ends.T, color=PROTECTED, linewidth=1.6, label=label, zorder=4)
        axes.quiver(
            *(ends[1] - 0.4 * direction),
            *(0.5 * direction),
            color=PROTECTED,
            linewidth=1.6,
            arrow_length_ratio=0.6,
            zorder=4,
        )
    corner = pose.translation + pose.rotation @ np.array([-2.0, -1.8, -1.6])
    for axis, name in zip(pose.rotation.T, "xyz", strict=True):
        axes.plot(*np.array([corner, corner + 0.9 * axis]).T, color="#555555", linewidth=0.9, zorder=4)
        axes.text(*(corner + 1.15 * axis), name, fontsize=7, color="#555555", ha="center", va="center")
    centre = pose.translation + [-0.5, 0.0, 0.6]
    for set_limits, middle, half in zip(
        (axes.set_xlim, axes.set_ylim, axes.set_zlim), centre, (2.6, 8.2, 2.1), strict=True
    ):
        set_limits(middle - half, middle + half)
    axes.set_box_aspect((2.6, 8.2, 2.1), zoom=1.52)
    axes.view_init(**_VIEW)
    axes.set_axis_off()


def _faces(shape: Shape) -> list[Floats]:
    if shape.kind == "box":
        return _box_faces(np.array(shape.size))
    if shape.kind == "cylinder":
        return _cylinder_faces(shape.size[0], shape.size[1])
    return _sphere_faces(shape.size[0])


def _box_faces(size: Floats) -> list[Floats]:
    faces = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        pieces = np.maximum(1, np.round(size[[u, v]] / _TILE).astype(int))
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
