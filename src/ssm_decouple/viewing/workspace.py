"""Figures and tables of the workspace study."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from numpy.typing import NDArray

from ssm_decouple.model.robot import Robot
from ssm_decouple.model.urdf import parse_urdf, root_link, visual_shapes
from ssm_decouple.studies.workspace import JointSlice, Kept, Workspace
from ssm_decouple.viewing.style import AXIS_COLORS, COLUMN, PAGE, styled

Floats = NDArray[np.float64]

SHOWN = ("none", "yaw", "roll+yaw", "all")  # small multiples: none, one, two and three directions
FLOOR = 1e-3  # m: the darkest colour of sigma
_LINES: dict[str, dict[str, Any]] = {
    "none": {"color": "#8C8C8C", "linestyle": (0, (5, 1.5))},
    **{name: {"color": color} for name, color in AXIS_COLORS.items()},
    "roll+pitch": {"color": "#CC79A7", "linestyle": (0, (4, 1))},
    "roll+yaw": {"color": "#56B4E9", "linestyle": (0, (4, 1))},
    "pitch+yaw": {"color": "#000000", "linestyle": (0, (4, 1))},
    "all": {"color": "#E69F00", "linestyle": (0, (5, 1.5, 1, 1.5))},
}
_KINDS = {"half of the drawn ones or more": "#0072B2", "some found": "#56B4E9", "none found": "#D55E00"}
_OUTLINE = "#D55E00"
_LIGHT = {"x": 0.8, "y": 1.0, "z": 0.92}  # how bright faces across these axes are


@styled
def slices(study: Workspace) -> Figure:
    """Draw the voxels of the upright plane through the shoulder: best posture found, and share of postures fit."""
    shown, grid = _shown(study.protections), study.grid
    figure = Figure(figsize=(PAGE, 3.75))
    axes = figure.subplots(2, len(shown), sharex=True, sharey=True, squeeze=False)
    x, z, layer = grid.edges(0), grid.edges(2), grid.shape[1] // 2
    top_value = max(1.0, *(float(np.nanmax(study.best(name)[:, layer], initial=0.0)) for name in shown))
    for column, protection in enumerate(shown):
        top, bottom = axes[:, column]
        best = np.maximum(study.best(protection)[:, layer], FLOOR).T
        sigma = top.pcolormesh(x, z, best, cmap="viridis", norm=LogNorm(FLOOR, top_value), rasterized=True)
        top.contour(_middles(x), _middles(z), best, levels=[study.margin], colors="white", linewidths=0.7)
        share = study.fit_share(protection)[:, layer].T
        fit = bottom.pcolormesh(x, z, 100 * share, cmap="cividis", vmin=0, vmax=100, rasterized=True)
        top.set_title(_title(protection))
        bottom.set_xlabel("x (m)")
        for panel in (top, bottom):
            _draw_base(panel, study.robot)
            panel.set_aspect("equal")
            panel.grid(False)
    for row in axes:
        row[0].set_ylabel("z (m)")
    figure.colorbar(sigma, ax=axes[0], label=r"largest $\sigma$ found (m)", extend="min", pad=0.01, aspect=14)
    figure.colorbar(fit, ax=axes[1], label=f"postures above {study.margin:g} m (%)", pad=0.01, aspect=14)
    y = float(grid.corner[1] + (layer + 0.5) * grid.edge)
    figure.suptitle(f"{study.robot.name}: plane y = {y:.2f} m through the shoulder, base axes", fontsize=9)
    return figure


@styled
def volumes(study: Workspace) -> Figure:
    """Draw the reached voxels, a quarter in front of the shoulder taken away, by how many postures are fit there."""
    shown, grid = _shown(study.protections), study.grid
    figure = Figure(figsize=(PAGE, 2.7))
    kept = {row.protection: row.volume for row in study.rows() if row.margin_m == study.margin}
    for i, protection in enumerate(shown):
        panel = figure.add_subplot(1, len(shown), i + 1, projection="3d", computed_zorder=False)
        best, share = study.best(protection), study.fit_share(protection)
        kinds = np.where(share >= 0.5, 0, np.where(best > study.margin, 1, 2))
        kinds[np.isnan(best)] = -1
        kinds[grid.shape[0] // 2 :, : grid.shape[1] // 2] = -1
        faces, colors = _voxel_faces(kinds, grid.corner, grid.edge)
        panel.add_collection3d(Poly3DCollection(faces, facecolors=colors, edgecolors=colors, linewidths=0.2, zorder=1))
        half = 0.5 * grid.edge * grid.shape[0]
        middle = grid.corner + half
        for set_limits, centre in zip((panel.set_xlim, panel.set_ylim, panel.set_zlim), middle, strict=True):
            set_limits(centre - 0.9 * half, centre + 0.9 * half)
        panel.set_box_aspect((1, 1, 1), zoom=1.25)
        panel.view_init(elev=25, azim=-50)
        panel.set_axis_off()
        _draw_triad(panel, middle + half * np.array([0.15, -0.75, -0.85]), 0.28 * half)
        panel.set_title(f"{_title(protection)}\n{100 * kept[protection]:.1f} % of the volume", y=1.0)
    handles = [Patch(color=color, label=kind) for kind, color in _KINDS.items()]
    title = rf"postures with $\sigma$ above {study.margin:g} m"
    figure.legend(handles=handles, ncols=3, loc="outside lower center", title=title, title_fontsize=7)
    figure.suptitle(f"{study.robot.name}: where the end-effector can be, base axes", fontsize=9)
    return figure


@styled
def distributions(studies: Sequence[Workspace]) -> Figure:
    """Draw the share of joint space that is fit against the margin, a panel a robot, a line for each protection."""
    columns = min(len(studies), 3)
    rows = -(-len(studies) // columns)
    figure = Figure(figsize=(COLUMN if columns == 1 else PAGE, 1.85 * rows + 0.6))
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for panel in axes.flat[len(studies) :]:
        panel.set_axis_off()
    reached = [study.edges[study.above(name) > 0].max(initial=0.0) for study in studies for name in study.protections]
    widest = max(1.5, *reached)
    for panel, study in zip(axes.flat, studies, strict=False):
        for protection in study.protections:
            line = _LINES.get(protection, {})
            panel.semilogx(study.edges, 100 * study.above(protection), label=_title(protection), **line)
        panel.axvline(study.margin, color="black", linewidth=0.5, linestyle=":")
        panel.set(xlim=(1e-4, widest), ylim=(0, 101), title=study.robot.name)
        panel.set_xticks([1e-4, 1e-3, 1e-2, 1e-1, 1])
    for panel in axes.flat[max(0, len(studies) - columns) : len(studies)]:
        panel.set_xlabel(r"margin on the smallest $\sigma$ (m)")
        panel.tick_params(labelbottom=True)
    for row in axes:
        row[0].set_ylabel("joint space above (%)")
    handles = axes.flat[0].get_legend_handles_labels()
    figure.legend(*handles, ncols=3 if columns == 1 else 8, loc="outside lower center", columnspacing=1.0)
    return figure


@styled
def joint_plane(subject: tuple[Robot, JointSlice, float, str]) -> Figure:
    """Draw the smallest singular value over two joints: robot, slice, margin, m, and a word on the other joints."""
    robot, cut, margin, rest = subject
    shown = _shown(cut.protections)
    figure = Figure(figsize=(PAGE, 2.35))
    panels = figure.subplots(1, len(shown), sharex=True, sharey=True, squeeze=False)[0]
    units = [1.0 if _slides(robot, name) else np.rad2deg(1.0) for name in cut.joints]
    x, y = (unit * angles for unit, angles in zip(units, cut.angles, strict=True))
    top_value = max(1.0, float(np.max(cut.sigma)))
    for panel, protection in zip(panels, shown, strict=True):
        sigma = np.maximum(cut.sigma[cut.protections.index(protection)].T, FLOOR)
        map_ = panel.pcolormesh(
            x, y, sigma, cmap="viridis", norm=LogNorm(FLOOR, top_value), shading="auto", rasterized=True
        )
        if sigma.min() < margin < sigma.max():
            panel.contour(x, y, sigma, levels=[margin], colors="white", linewidths=0.6)
        panel.set_title(f"{_title(protection)}: {100 * np.mean(sigma > margin):.0f} %")
        panel.set_xlabel(_joint_label(cut.joints[0], units[0]))
        panel.grid(False)
        for axis, values in ((panel.xaxis, x), (panel.yaxis, y)):
            if np.isclose(values[-1] - values[0], 360.0):
                axis.set_ticks([-180, -90, 0, 90, 180])
    panels[0].set_ylabel(_joint_label(cut.joints[1], units[1]))
    figure.colorbar(map_, ax=panels, label=r"smallest $\sigma$ (m)", extend="min", pad=0.01, aspect=14)
    figure.suptitle(f"{robot.name}: {rest}; share of the plane above {margin:g} m (white lines)", fontsize=9)
    return figure


FIGURES: dict[str, Callable[[Workspace], Figure]] = {"slices": slices, "volumes": volumes}


def kept_table(rows: Sequence[Kept]) -> list[list[str]]:
    """Return what protections leave at the margin of `rows` as rows of texts, headings first."""
    head = ["robot", "protected", "k", "joint space (%)", "95 % interval", "typical place (%)", "volume (%)", "at half"]
    return [[*head, "sigma, median (m)"]] + [
        [
            row.robot,
            row.protection,
            str(row.k),
            f"{100 * row.share:.2f}",
            f"{100 * row.share_low:.2f} to {100 * row.share_high:.2f}",
            f"{100 * row.typical:.1f}",
            f"{100 * row.volume:.1f}",
            "" if row.volume_half is None else f"{100 * row.volume_half:.1f}",
            f"{row.sigma_median_m:.2g}",
        ]
        for row in rows
    ]


def margin_table(rows: Sequence[Kept]) -> list[list[str]]:
    """Return shares of joint space, then of the volume, by margin, as rows of texts, headings first."""
    margins = sorted({row.margin_m for row in rows})
    found = {(row.robot, row.protection, row.margin_m): row for row in rows}
    lines = [["robot", "protected", *(f"{margin:g} m" for margin in margins)]]
    for robot, protection in dict.fromkeys((row.robot, row.protection) for row in rows):
        mine = [found[robot, protection, margin] for margin in margins]
        lines.append([robot, protection, *(f"{100 * row.share:.1f} / {100 * row.volume:.1f}" for row in mine)])
    return lines


def _shown(protections: Sequence[str]) -> list[str]:
    return [name for name in SHOWN if name in protections] or list(protections)[: len(SHOWN)]


def _title(protection: str) -> str:
    return {"none": "nothing protected", "all": "all three"}.get(protection, protection.replace("+", " + "))


def _middles(edges: Floats) -> Floats:
    return 0.5 * (edges[:-1] + edges[1:])


def _draw_base(panel: Axes, robot: Robot) -> None:
    """Draw the shoulder, and the outlines of the root link's upright boxes where the plane y = const cuts them."""
    x, y, z = robot.shoulder_position(robot.configuration())
    panel.plot(x, z, marker="o", markersize=2.5, color=_OUTLINE)
    root = root_link(parse_urdf(robot.urdf, robot.name))
    for shape in visual_shapes(robot.urdf):
        if shape.link == root and shape.kind == "box" and not shape.rpy.any():
            width, depth, height = shape.size
            if abs(shape.xyz[1] - y) < depth / 2:
                corner = shape.xyz[0] - width / 2, shape.xyz[2] - height / 2
                panel.add_patch(Rectangle(corner, width, height, fill=False, color=_OUTLINE, linewidth=0.8))


def _draw_triad(panel: Axes3D, corner: Floats, length: float) -> None:
    for axis, name in zip(np.eye(3), "xyz", strict=True):
        panel.plot(*np.array([corner, corner + length * axis]).T, color="#555555", linewidth=0.9)
        panel.text(*(corner + 1.3 * length * axis), name, fontsize=7, color="#555555", ha="center", va="center")


def _voxel_faces(kinds: NDArray[np.int64], corner: Floats, edge: float) -> tuple[list[Floats], list[Floats]]:
    """Return the squares between filled voxels and empty ones (4, 3), and their colours; -1 is empty."""
    palette = np.array([to_rgb(color) for color in _KINDS.values()])
    padded = np.pad(kinds, 1, constant_values=-1)
    faces, colors = [], []
    for axis, name in enumerate("xyz"):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for side in (-1, 1):
            beside = np.roll(padded, -side, axis=axis)
            for cell in np.argwhere((padded >= 0) & (beside < 0)):
                square = np.tile((cell - 1).astype(float), (4, 1))
                square[:, axis] += side > 0
                square[:, u] += [0, 1, 1, 0]
                square[:, v] += [0, 0, 1, 1]
                faces.append(corner + edge * square)
                colors.append(_LIGHT[name] * palette[padded[tuple(cell)]])
    return faces, colors


def _slides(robot: Robot, joint: str) -> bool:
    return bool(robot.model.joints[robot.joint_index(joint) + 2].shortname().startswith("JointModelP"))


def _joint_label(name: str, unit: float) -> str:
    return f"{name.replace('_', ' ')} ({'m' if unit == 1.0 else 'deg'})"
