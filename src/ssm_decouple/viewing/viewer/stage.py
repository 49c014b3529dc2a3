"""Scenes in the browser: meshes are sent once, then only poses.

Pinocchio has a `ViserVisualizer`, which shows one robot of one geometry model and sends each pose by itself. Here
motions stand side by side, wings bend, and what belongs to one frame has to arrive as one: so the poses are sent here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pinocchio as pin
import viser
from numpy.typing import NDArray

from ssm_decouple.viewing.viewer.parts import Color, Part
from ssm_decouple.viewing.viewer.scene import Frame, Scene

Floats = NDArray[np.float64]

# Okabe and Ito's palette, as in the figures: the same colour for the same thing.
PROTECTED = (204, 121, 167)
FREE = (86, 180, 233)
MOMENTUM = (240, 228, 66)
PATH = (213, 94, 0)
SIGHT = (0, 158, 115)
TARGET = (230, 159, 0)
FAINT = (125, 130, 140)

PIECES = 30  # of the trail: a piece is shown when its time has come, and none is sent twice
SHORTEST = 1e-3  # m: an arrow of less is not drawn
THIN = 0.06  # a box whose thinnest edge is below this share of the next is a panel, drawn with cells
CELL = 0.8  # m


@dataclass
class Shown:
    """What of the extras is drawn.

    Attributes:
        axes: The protected directions U_c.
        rates: The base's angular velocity.
        momentum: The angular momentum.
        path: The end-effector's path.
        sight: The antenna's line of sight.
    """

    axes: bool = True
    rates: bool = True
    momentum: bool = True
    path: bool = True
    sight: bool = True


class Stage:
    """Several scenes on one server, side by side, on one clock.

    Args:
        server: The viser server.
        scenes: What to draw.
        named: Whether each has its name beside it.
    """

    def __init__(self, server: viser.ViserServer, scenes: Sequence[Scene], named: bool = True) -> None:
        self.server, self.scenes = server, list(scenes)
        self.boxes = np.array([scene.box for scene in scenes])
        low, high = self.boxes[:, 0].min(axis=0), self.boxes[:, 1].max(axis=0)
        self.offsets = _offsets(low, high, len(scenes))
        self.size = float(np.max(high - low))
        scale = 5.0 / max((float(np.abs(scene.rates).max(initial=0.0)) for scene in scenes), default=0.0) or 1.0
        scale = scale if np.isfinite(scale) else 1.0
        self.rate_scale = scale * self.size / 16.0  # m per rad/s: the same in every scene, so that arrows compare
        self.actors = [
            Actor(server, scene, f"/motion_{i}", offset, self.size, self.rate_scale, named)
            for i, (scene, offset) in enumerate(zip(scenes, self.offsets, strict=True))
        ]
        self.corners = np.array([low + self.offsets.min(axis=0), high + self.offsets.max(axis=0)])
        self._aim()

    def _aim(self) -> None:
        """Look at everything from the side on which the arm works, as the figures do."""
        position, middle, fov = self.camera()
        camera = self.server.initial_camera
        camera.position, camera.look_at, camera.fov = position, middle, fov
        camera.far = 60.0 * self.size
        self.server.on_client_connect(self._fit)

    def _fit(self, client: viser.ClientHandle) -> None:
        """Step back where a page is so narrow that it would cut the wings."""
        with client.atomic():
            position, middle, fov = self.camera(max(client.camera.aspect, 0.2))
            # The point looked at comes after: viser moves it along with the camera.
            client.camera.position, client.camera.look_at, client.camera.fov = position, middle, fov

    def camera(self, aspect: float = 1.2) -> tuple[Floats, Floats, float]:
        """Return position (3,), the point looked at (3,), m, and the vertical field of view, rad."""
        middle = self.corners.mean(axis=0)
        azimuth, elevation, fov = np.deg2rad(156.0), np.deg2rad(17.0), np.deg2rad(26.0)
        back = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
        right = np.cross(np.array([0.0, 0.0, 1.0]), back)
        right /= np.linalg.norm(right)
        up = np.cross(back, right)
        cube = np.array(np.meshgrid(*(self.corners - middle).T)).reshape(3, -1).T
        slope = np.tan(0.5 * fov)
        # Each corner has to be inside the picture: how far back the camera stands for it.
        needed = [max(abs(c @ up) / slope, abs(c @ right) / (slope * aspect)) + c @ back for c in cube]
        return middle + 1.05 * max(needed) * back, middle, float(fov)

    def draw(self, time: float, riding: bool = False, exaggeration: float = 1.0, shown: Shown | None = None) -> None:
        """Draw all scenes at a time, s; one that is over stays at its end."""
        with self.server.atomic():
            for actor in self.actors:
                actor.draw(actor.scene.at(time, exaggeration), riding, shown or Shown())


class Actor:
    """One scene in the browser."""

    def __init__(
        self,
        server: viser.ViserServer,
        scene: Scene,
        root: str,
        offset: Floats,
        size: float,
        rate_scale: float,
        named: bool,
    ) -> None:
        self.server, self.scene, self.size, self.rate_scale = server, scene, size, rate_scale
        self.root = f"{root}/view"
        server.scene.add_frame(root, show_axes=False, position=offset)
        self.view = server.scene.add_frame(self.root, show_axes=False)
        self.bodies = add_bodies(server, self.root, scene)
        self.start = np.r_[scene.body_poses[0, 0]]
        if named:
            low, high = scene.box
            place = (0.5 * (low[0] + high[0]), high[1], high[2] - 0.06 * size)
            server.scene.add_label(
                f"{root}/name", scene.name, position=place, anchor="bottom-left", font_screen_scale=1.15
            )
        self._add_target()
        self._add_trail()
        self.axes = self._add_axes()
        self.sight = self._add_sight()
        self.rates = [
            self._arrow("free_rate", FREE),
            self._arrow("protected_rate", PROTECTED),
            self._arrow("momentum", MOMENTUM),
        ]

    def _add_target(self) -> None:
        self.target = self.server.scene.add_frame(f"{self.root}/target", show_axes=False)
        name, radius = f"{self.root}/target/ball", 0.009 * self.size
        self.server.scene.add_icosphere(name, radius=radius, color=TARGET, cast_shadow=False, receive_shadow=False)
        self.target.visible = bool(np.all(np.isfinite(self.scene.at(0.0).target)))

    def _add_trail(self) -> None:
        scene, path = self.scene, self.scene.motion.end_effector_position.values
        coarse = path[_about(len(path), 400)]
        self._add_line("path", coarse, FAINT, 0.0009)
        edges = np.unique(np.linspace(0, len(path) - 1, min(PIECES, len(path) - 1) + 1).astype(int))
        self.pieces: list[Any] = []
        self.times = scene.time[edges[1:]]
        for i, (start, end) in enumerate(pairwise(edges)):
            piece = path[start : end + 1][_about(end - start + 1, 12)]
            self.pieces.append(self._add_line(f"trail/{i}", piece, PATH, 0.0024))
            self.pieces[-1].visible = False
        self.done = 0

    def _add_line(self, name: str, points: Floats, color: tuple[int, int, int], thickness: float) -> Any:
        ends = np.stack([points[:-1], points[1:]], axis=1)
        return self.server.scene.add_line_segments(
            f"{self.root}/{name}", ends, np.array(color), thickness=thickness * self.size
        )

    def _add_axes(self) -> list[Any]:
        """Add an arrow for each protected direction; turning about it, or moving along it, is what must not be."""
        self.U_c = self.server.scene.add_frame(f"{self.root}/U_c", show_axes=False)
        arrows = []
        for i, column in enumerate(self.scene.motion.U_c.values.T):
            turning = not np.any(column[:3])
            direction = column[3:] if turning else column[:3]
            length = 0.155 * self.size
            points = np.array([[-length * direction, length * direction]])
            arrows.append(self._add_arrows(f"U_c/{i}", points, PROTECTED, 1.9 if turning else 1.0))
        return arrows

    def _add_sight(self) -> list[Any]:
        """Add the line of sight of an antenna, now and at the start."""
        found = antenna(self.scene.parts)
        if found is None:
            return []
        foot, direction = found
        line = sight_line(direction, self.size)
        self.foot = foot
        now = self.server.scene.add_line_segments(
            f"{self.root}/body_0/line_of_sight", line, np.array(SIGHT), thickness=0.0022 * self.size, position=foot
        )
        before = self.server.scene.add_line_segments(
            f"{self.root}/line_of_sight_at_start", line, np.array(FAINT), thickness=0.0011 * self.size
        )
        before.wxyz = self.start[3:]
        return [now, before]

    def _arrow(self, name: str, color: tuple[int, int, int]) -> Any:
        handle = self._add_arrows(name, np.array([[np.zeros(3), np.array([0.0, 0.0, 0.1])]]), color, 2.6)
        handle.visible = False
        return handle

    def _add_arrows(self, name: str, points: Floats, color: tuple[int, int, int], thick: float) -> Any:
        return self.server.scene.add_arrows(
            f"{self.root}/{name}",
            points,
            np.array(color),
            shaft_radius=0.0016 * thick * self.size,
            head_radius=0.0045 * thick * self.size,
            head_length=0.014 * thick * self.size,
        )

    def draw(self, frame: Frame, riding: bool, shown: Shown) -> None:
        """Send what has changed."""
        for body, position, wxyz in zip(self.bodies, frame.positions, frame.quaternions, strict=True):
            body.position, body.wxyz = position, wxyz
        self.view.position, self.view.wxyz = (
            self.scene.riding(frame) if riding else (np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
        )
        if self.target.visible:
            self.target.position = frame.target
        self.U_c.position, self.U_c.wxyz = frame.positions[0], frame.axes
        for arrow, share in zip(self.axes, self.scene.shares[frame.sample], strict=True):
            arrow.visible = bool(shown.axes and share > 0)
        now = self.scene.time[frame.sample]
        done = int(np.searchsorted(self.times, now, side="right")) if shown.path else 0
        for piece in self.pieces[min(done, self.done) : max(done, self.done)]:
            piece.visible = done > self.done
        self.done = done
        if self.sight:
            current, before = self.sight
            current.visible = before.visible = shown.sight
            before.position = frame.positions[0] + rotated(frame.quaternions[0], self.foot)
        vectors = rate_arrows(frame, self.rate_scale, self.size, self.scene.has_momentum)
        for handle, vector, wanted in zip(self.rates, vectors, (shown.rates, shown.rates, shown.momentum), strict=True):
            handle.visible = bool(wanted and np.linalg.norm(vector) > SHORTEST)
            if handle.visible:
                handle.position = frame.positions[0]
                handle.points = np.array([[np.zeros(3), vector]], dtype=np.float32)


def add_bodies(server: viser.ViserServer, root: str, scene: Scene) -> list[viser.FrameHandle]:
    """Put the spacecraft into the scene tree and return its bodies, in the order of a frame's poses."""
    handles = []
    for b, joint in enumerate(scene.joints):
        name = f"{root}/body_{b}"
        handles.append(server.scene.add_frame(name, show_axes=False))
        for i, part in enumerate(part for part in scene.parts if part.joint == joint):
            add_part(server, f"{name}/{part.name or 'part'}_{i}", part)
    for wing in scene.wings:
        for i in range(wing.segments):
            name = f"{root}/{wing.name}_{i}"
            handles.append(server.scene.add_frame(name, show_axes=False))
            add_part(server, f"{name}/panel", wing.segment())
    return handles


def rate_arrows(frame: Frame, rate_scale: float, size: float, has_momentum: bool) -> tuple[Floats, Floats, Floats]:
    """Return the arrows (3,), m, of the free and the protected part of the base rate and of the momentum.

    The momentum's has one length, since it is kept: it shows a direction. Without momentum it has none.
    """
    length = float(np.linalg.norm(frame.momentum))
    momentum = 0.14 * size / length * frame.momentum if has_momentum and length > 0 else np.zeros(3)
    return rate_scale * frame.free, rate_scale * frame.protected, momentum


def rotated(wxyz: Floats, vector: Floats) -> Floats:
    """Return a vector (3,) turned by a quaternion (4,)."""
    return pin.Quaternion(*map(float, wxyz)).toRotationMatrix() @ vector


def antenna(parts: Sequence[Part]) -> tuple[Floats, Floats] | None:
    """Return where an antenna on the base stands (3,) and where it looks (3,), base axes; None where there is none.

    It is the widest cylinder on the base whose name says antenna or dish; it looks along its axis, outwards.
    """
    named = [
        part
        for part in parts
        if part.joint == 1 and part.kind == "cylinder" and ("antenna" in part.name or "dish" in part.name)
    ]
    if not named:
        return None
    dish = max(named, key=lambda part: part.size[0])
    axis, foot = dish.pose.rotation[:, 2], dish.pose.translation
    return foot.copy(), axis if axis @ foot >= 0 else -axis


def sight_line(direction: Floats, size: float) -> Floats:
    """Return the segment (1, 2, 3) that draws a line of sight, m, from the antenna."""
    return np.array([[np.zeros(3), 0.42 * size * direction]])


def add_part(server: viser.ViserServer, name: str, part: Part) -> None:
    """Put a shape into the scene tree, under the body that carries it."""
    pose = pin.SE3ToXYZQUAT(part.pose)
    place: dict[str, Any] = {"position": pose[:3], "wxyz": pose[[6, 3, 4, 5]]}
    color = _rgb(part.color)
    if part.kind == "box":
        server.scene.add_box(name, dimensions=part.size, color=color, **place)  # type: ignore[arg-type]
        _add_cells(server, name, part)
    elif part.kind == "cylinder":
        radius, height = part.size
        server.scene.add_cylinder(name, radius=radius, height=height, color=color, **place)
    elif part.kind == "sphere":
        server.scene.add_icosphere(name, radius=part.size[0], color=color, **place)
    else:
        server.scene.add_mesh_simple(name, part.vertices, part.faces.astype(np.uint32), color=color, **place)


def _add_cells(server: viser.ViserServer, name: str, part: Part) -> None:
    """Draw the cells of a solar panel on both of its faces, so that one sees it turn and bend."""
    size = np.array(part.size)
    thin, u, v = (int(i) for i in np.argsort(size))
    if size[thin] > THIN * size[u]:
        return
    lines = []
    for a, b in ((u, v), (v, u)):
        for x in np.linspace(-0.5, 0.5, max(2, round(size[a] / CELL)) + 1) * size[a]:
            for side in (-0.5, 0.5):
                ends = np.zeros((2, 3))
                ends[:, a], ends[:, thin] = x, side * (size[thin] + 0.006)
                ends[:, b] = -0.5 * size[b], 0.5 * size[b]
                lines.append(ends)
    server.scene.add_line_segments(f"{name}/cells", np.array(lines), np.array([120, 140, 190]), thickness=0.014)


def _rgb(color: Color) -> tuple[int, int, int]:
    red, green, blue = (round(255 * float(np.clip(x, 0.0, 1.0))) for x in color)
    return red, green, blue


def _about(count: int, wanted: int) -> NDArray[np.int64]:
    """Return about `wanted` places of `count`, the ends among them."""
    return np.unique(np.linspace(0, count - 1, min(count, max(2, wanted))).astype(np.int64))


def _offsets(low: Floats, high: Floats, count: int) -> Floats:
    """Return where each scene stands (count, 3), m: above each other where they are wide, else side by side."""
    extent = high - low
    vertical = extent[2] < 0.7 * max(extent[0], extent[1])
    offsets = np.zeros((count, 3))
    if vertical:
        offsets[:, 2] = -1.12 * extent[2] * np.arange(count)
    else:
        offsets[:, 1] = -1.25 * extent[1] * np.arange(count)
    return offsets
