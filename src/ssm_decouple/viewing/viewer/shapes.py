"""What stands in the scene tree of both pages: parts, lines and arrows.

Lines are meshes of thin rods: viser's own lines are drawn by a shader that costs more than all the rest of a frame
where there is no graphics card.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin
import viser
from numpy.typing import NDArray

from ssm_decouple.viewing.viewer.parts import Color, Part, bus
from ssm_decouple.viewing.viewer.scene import Vectors, rotated

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Rgb = tuple[int, int, int]

# Okabe and Ito's palette, as in the figures: the same colour for the same thing.
PROTECTED: Rgb = (204, 121, 167)
FREE: Rgb = (86, 180, 233)
MOMENTUM: Rgb = (240, 228, 66)
PATH: Rgb = (213, 94, 0)
SIGHT: Rgb = (0, 158, 115)
TARGET: Rgb = (230, 159, 0)
FAINT: Rgb = (125, 130, 140)
CELLS: Rgb = (120, 140, 190)

SHORTEST = 1e-3  # m: an arrow of less is not drawn
THIN = 0.06  # a box whose thinnest edge is below this share of the next is a panel, drawn with cells
CELL = 0.8  # m
CELL_LINE = 0.012  # m
LONGEST = 5.0 / 16.0  # of the size of the scene: the arrow of the largest base rate
SLIM = 0.05  # of the size of the scene: an arrow that is shorter is thinner too
HEAD = 0.15  # of a rate's arrow, of its length
_CORNERS = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) / np.sqrt(2.0)  # of a rod, of its radius
_SIDES = np.array([[i, (i + 1) % 4, 4 + (i + 1) % 4, i, 4 + (i + 1) % 4, 4 + i] for i in range(4)]).reshape(8, 3)


def rods(segments: Floats, radius: float) -> tuple[Floats, Integers]:
    """Return a mesh that draws line segments as square rods without ends.

    Args:
        segments: (n, 2, 3), m.
        radius: From the axis to the corners, m.

    Returns:
        Vertices (8 n, 3), m, and faces (8 n, 3), their indices, outsides out.
    """
    along = segments[:, 1] - segments[:, 0]
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along = np.where(length > 0, along / np.where(length > 0, length, 1.0), [1.0, 0.0, 0.0])
    u = np.cross(along, np.eye(3)[np.abs(along).argmin(axis=1)])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    around = radius * np.einsum("ci,nik->nck", _CORNERS, np.stack([u, np.cross(along, u)], axis=1))
    vertices = (segments[:, :, None] + around[:, None]).reshape(-1, 3)
    faces = (8 * np.arange(len(segments))[:, None, None] + _SIDES).reshape(-1, 3)
    return vertices, faces


def simplified(path: Floats, tolerance: float) -> Integers:
    """Return which points of a path (m, 3) keep it within a tolerance, m, of where it was (Douglas and Peucker)."""
    kept, left = {0, len(path) - 1}, [(0, len(path) - 1)]
    while left:
        start, end = left.pop()
        if end - start < 2:
            continue
        chord, offsets = path[end] - path[start], path[start + 1 : end] - path[start]
        share = np.clip(offsets @ chord / max(float(chord @ chord), 1e-300), 0.0, 1.0)
        off = np.linalg.norm(offsets - share[:, None] * chord, axis=1)
        worst = int(off.argmax())
        if off[worst] > tolerance:
            middle = start + 1 + worst
            kept.add(middle)
            left += [(start, middle), (middle, end)]
    return np.array(sorted(kept))


def joined(points: Floats) -> Floats:
    """Return the segments (m - 1, 2, 3) from each of points (m, 3) to the next."""
    return np.stack([points[:-1], points[1:]], axis=1)


class Trail:
    """A line that grows: a mesh of so many rods from the start, those not needed in one point.

    Args:
        server: The viser server.
        name: Of its node.
        count: Points that it has at most.
        color: Of the line.
        radius: m.
    """

    def __init__(self, server: viser.ViserServer, name: str, count: int, color: Rgb, radius: float) -> None:
        self.which, self.radius = np.arange(count), radius
        self.mesh = add_lines(server, name, np.zeros((count - 1, 2, 3)), color, radius)
        self.mesh.visible = False

    def draw(self, points: Floats) -> None:
        """Draw points (m, 3), m; less than two are no line."""
        self.mesh.visible = len(points) > 1
        if self.mesh.visible:
            padded = points[np.minimum(self.which, len(points) - 1)]
            self.mesh.vertices = rods(joined(padded), self.radius)[0].astype(np.float32)


def add_lines(server: viser.ViserServer, name: str, segments: Floats, color: Rgb, radius: float, **place: Any) -> Any:
    """Draw segments (n, 2, 3), m, as one mesh of rods."""
    vertices, faces = rods(segments, radius)
    return server.scene.add_mesh_simple(
        name, vertices, faces.astype(np.uint32), color=color, cast_shadow=False, receive_shadow=False, **place
    )


def add_part(server: viser.ViserServer, name: str, part: Part) -> None:
    """Put a shape into the scene tree, under the body that carries it."""
    pose = pin.SE3ToXYZQUAT(part.pose)
    place: dict[str, Any] = {"position": pose[:3], "wxyz": pose[[6, 3, 4, 5]]}
    color = _rgb(part.color)
    if part.kind == "box":
        server.scene.add_box(name, dimensions=part.size, color=color, **place)  # type: ignore[arg-type]
        cells = _cells(part)
        if len(cells):
            add_lines(server, f"{name}/cells", cells, CELLS, CELL_LINE)
    elif part.kind == "cylinder":
        radius, height = part.size
        server.scene.add_cylinder(name, radius=radius, height=height, color=color, **place)
    elif part.kind == "sphere":
        server.scene.add_icosphere(name, radius=part.size[0], color=color, **place)
    else:
        server.scene.add_mesh_simple(name, part.vertices, part.faces.astype(np.uint32), color=color, **place)


def _cells(part: Part) -> Floats:
    """Return the borders of the cells on both faces of a solar panel (n, 2, 3), m, by which one sees it turn and bend.

    There are none on a box that is no panel.
    """
    size = np.array(part.size)
    thin, u, v = (int(i) for i in np.argsort(size))
    lines: list[Floats] = []
    if size[thin] > THIN * size[u]:
        return np.empty((0, 2, 3))
    for a, b in ((u, v), (v, u)):
        for x in np.linspace(-0.5, 0.5, max(2, round(size[a] / CELL)) + 1) * size[a]:
            for side in (-0.5, 0.5):
                ends = np.zeros((2, 3))
                ends[:, a], ends[:, thin] = x, side * (size[thin] + CELL_LINE)
                ends[:, b] = -0.5 * size[b], 0.5 * size[b]
                lines.append(ends)
    return np.array(lines)


def _rgb(color: Color) -> Rgb:
    red, green, blue = (round(255 * float(np.clip(x, 0.0, 1.0))) for x in color)
    return red, green, blue


def sight_line(direction: Floats, size: float) -> Floats:
    """Return the segment (1, 2, 3) that draws a line of sight, m, from the antenna."""
    return np.array([[np.zeros(3), 0.42 * size * direction]])


class Arrows:
    """The arrows on a base: protected directions, the base's rate in its two parts, the angular momentum.

    Args:
        server: The viser server.
        root: Name of the node that they stand under, in inertial axes.
        size: Of the scene, m.
        parts: Shapes, whose bus would hide where the arrows begin: they begin at its surface.
    """

    def __init__(self, server: viser.ViserServer, root: str, size: float, parts: Sequence[Part]) -> None:
        self.server, self.root, self.size, self.bus = server, root, size, bus(parts)
        self.frame = server.scene.add_frame(f"{root}/U_c", show_axes=False)
        self.directions: list[Any] = []
        # Each is one long and is turned and stretched: an arrow with new ends would be built anew for every frame.
        upwards = np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
        self.rates = [
            self._add(name, upwards, color, 2.6, HEAD)
            for name, color in (("free_rate", FREE), ("protected_rate", PROTECTED), ("momentum", MOMENTUM))
        ]
        for handle in self.rates:
            handle.visible = False

    def protect(self, U_twist: Floats) -> None:
        """Draw the protected directions U_c (6, k): turning about an arrow, or moving along it, is what must not be."""
        for handle in self.directions:
            handle.remove()
        self.directions = []
        for i, column in enumerate(U_twist.T):
            turning = not np.any(column[:3])
            end = 0.155 * self.size * (column[3:] if turning else column[:3])
            thick = 1.9 if turning else 1.0
            head = 0.014 * thick * self.size
            self.directions.append(self._add(f"U_c/{i}", np.array([[-end, end]]), PROTECTED, thick, head))

    def draw(
        self, now: Vectors, rate_scale: float, axes: bool = True, rates: bool = True, momentum: bool = True
    ) -> None:
        """Send what has changed, of what is to be shown; rates are as long as the scale has it, m per rad/s."""
        self.frame.position, self.frame.wxyz = now.base, now.axes
        for handle, share in zip(self.directions, now.shares, strict=True):
            handle.visible = bool(axes and share > 0)
        lengths = arrow_lengths(now, rate_scale, self.size)
        for handle, vector, wanted in zip(self.rates, lengths, (rates, rates, momentum), strict=True):
            length = float(np.linalg.norm(vector))
            handle.visible = bool(wanted and length > SHORTEST)
            if handle.visible:
                start = now.base + way_out(self.bus, now.attitude, vector / length)
                thick = min(1.0, length / (SLIM * self.size))
                handle.position, handle.wxyz, handle.scale = start, from_z_to(vector), (thick, thick, length)

    def _add(self, name: str, points: Floats, color: Rgb, thick: float, head: float) -> Any:
        return self.server.scene.add_arrows(
            f"{self.root}/{name}",
            points,
            np.array(color),
            shaft_radius=0.0016 * thick * self.size,
            head_radius=0.0045 * thick * self.size,
            head_length=head,
        )


def arrow_lengths(now: Vectors, rate_scale: float, size: float) -> tuple[Floats, Floats, Floats]:
    """Return the arrows (3,), m, of the free and the protected part of the base rate and of the momentum.

    The momentum's has one length, since it is kept: it shows a direction. Without momentum it has none.
    """
    length = float(np.linalg.norm(now.momentum))
    momentum = 0.14 * size / length * now.momentum if length > 0 else np.zeros(3)
    return rate_scale * now.free, rate_scale * now.protected, momentum


def way_out(box: Floats, attitude: Floats, direction: Floats) -> Floats:
    """Return the vector (3,), m, in a direction from a body's origin to where it leaves a box.

    Args:
        box: Lowest and highest corner (2, 3), m, body axes.
        attitude: Quaternion w x y z of the body (4,).
        direction: (3,), unit, inertial axes.

    Returns:
        In inertial axes; zero where the origin is outside the box.
    """
    along = rotated(attitude * [1.0, -1.0, -1.0, -1.0], direction)
    if np.any(box[0] > 0) or np.any(box[1] < 0):
        return np.zeros(3)
    walls = np.where(along > 0, box[1], box[0])
    distances = np.divide(walls, along, out=np.full(3, np.inf), where=np.abs(along) > 1e-12)
    return float(distances.min()) * direction


def from_z_to(vector: Floats) -> Floats:
    """Return the quaternion w x y z of a rotation that takes the z axis to the direction of a vector (3,)."""
    turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), vector).coeffs()
    return np.asarray(turn[[3, 0, 1, 2]])


def _square(color: tuple[int, int, int], text: str) -> str:
    return f'<span style="color:rgb{color}">&#9632;</span>&nbsp;{text}'


LEGEND = (
    '<div style="font-size:0.78em;padding:0.2em 0.9em;line-height:1.5">'
    + " &ensp;".join(
        [
            _square(PROTECTED, "U_c, protected rate"),
            _square(FREE, "free rate"),
            _square(MOMENTUM, "momentum"),
            _square(PATH, "path"),
            _square(TARGET, "target"),
            _square(SIGHT, "line of sight"),
        ]
    )
    + "</div>"
)
