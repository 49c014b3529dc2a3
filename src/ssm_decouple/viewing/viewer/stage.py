"""Scenes in the browser: meshes are sent once, then only poses.

Pinocchio has a `ViserVisualizer`, which shows one robot of one geometry model and sends each pose by itself. Here
motions stand side by side, wings bend, and what belongs to one frame has to arrive as one: so the poses are sent here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from ssm_decouple.viewing.viewer.parts import antenna
from ssm_decouple.viewing.viewer.scene import Frame, Scene, rotated
from ssm_decouple.viewing.viewer.shapes import (
    FAINT,
    LONGEST,
    PATH,
    SIGHT,
    TARGET,
    Arrows,
    Trail,
    add_lines,
    add_part,
    joined,
    sight_line,
    simplified,
)

Floats = NDArray[np.float64]

PIECES = 60  # of the trail at least, each drawn when its time has come
COARSE = 2e-4  # of the size of the scene: how far a drawn path may be off


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
        largest = max(float(np.abs(scene.rates).max(initial=0.0)) for scene in scenes)
        # m per rad/s: the same in every scene, so that arrows compare
        self.rate_scale = LONGEST * self.size / largest if largest > 0 else 1.0
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
        width, height = client.camera.image_width, client.camera.image_height
        if not (width > 0 and height > 0):  # a page that is hidden has no size
            return
        with client.atomic():
            position, middle, fov = self.camera(max(width / height, 0.2))
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
        self.server, self.scene, self.size = server, scene, size
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
        self.sight = self._add_sight()
        self.arrows, self.rate_scale = Arrows(server, self.root, size, scene.parts), rate_scale
        self.arrows.protect(scene.motion.U_c.values)

    def _add_target(self) -> None:
        self.target = self.server.scene.add_frame(f"{self.root}/target", show_axes=False)
        name, radius = f"{self.root}/target/ball", 0.009 * self.size
        self.server.scene.add_icosphere(name, radius=radius, color=TARGET, cast_shadow=False, receive_shadow=False)
        self.target.visible = bool(np.all(np.isfinite(self.scene.at(0.0).target)))

    def _add_trail(self) -> None:
        """Add the path of the end-effector, and over it what has been of it, which grows from time to time."""
        path, size = self.scene.motion.end_effector_position.values, self.size
        self.trail: Trail | None = None
        if len(path) < 2:  # what an interrupted motion may leave
            return
        kept = simplified(path, COARSE * size)
        add_lines(self.server, f"{self.root}/path", joined(path[kept]), FAINT, 0.0009 * size)
        pieces = np.linspace(0, len(path) - 1, min(PIECES, len(path) - 1) + 1).astype(int)
        grown = np.union1d(kept, pieces)
        self.grown, self.times, self.done = path[grown], self.scene.time[grown], 0
        self.trail = Trail(self.server, f"{self.root}/trail", len(grown), PATH, 0.0022 * size)

    def _add_sight(self) -> list[Any]:
        """Add the line of sight of an antenna, now and at the start."""
        found = antenna(self.scene.parts)
        if found is None:
            return []
        foot, direction = found
        line = sight_line(direction, self.size)
        self.foot = foot
        name, thin = f"{self.root}/body_0/line_of_sight", 0.0009 * self.size
        now = add_lines(self.server, name, line, SIGHT, 2.0 * thin, position=foot)
        name = f"{self.root}/line_of_sight_at_start"
        before = add_lines(self.server, name, line, FAINT, thin, wxyz=self.start[3:])
        return [now, before]

    def draw(self, frame: Frame, riding: bool, shown: Shown) -> None:
        """Send what has changed."""
        for body, position, wxyz in zip(self.bodies, frame.positions, frame.quaternions, strict=True):
            body.position, body.wxyz = position, wxyz
        self.view.position, self.view.wxyz = (
            self.scene.riding(frame) if riding else (np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
        )
        if self.target.visible:
            self.target.position = frame.target
        now = self.scene.time[frame.sample]
        if self.trail is not None:
            done = int(np.searchsorted(self.times, now, side="right")) if shown.path else 0
            if done != self.done:
                self.trail.draw(self.grown[:done])
                self.done = done
        if self.sight:
            current, before = self.sight
            current.visible = before.visible = shown.sight
            before.position = frame.positions[0] + rotated(frame.quaternions[0], self.foot)
        self.arrows.draw(frame.vectors, self.rate_scale, shown.axes, shown.rates, shown.momentum)


def add_bodies(server: viser.ViserServer, root: str, scene: Scene) -> list[viser.FrameHandle]:
    """Put the spacecraft into the scene tree and return its bodies, in the order of a frame's poses."""
    handles = []
    for b, joint in enumerate(scene.joints):
        name = f"{root}/body_{b}"
        handles.append(server.scene.add_frame(name, show_axes=False))
        for i, part in enumerate(part for part in scene.parts if part.joint == joint):
            add_part(server, f"{name}/{part.name or 'part'}_{i}", part)
    for wing in scene.wings:
        for i in range(wing.appendage.segments):
            name = f"{root}/{wing.appendage.name}_{i}"
            handles.append(server.scene.add_frame(name, show_axes=False))
            add_part(server, f"{name}/panel", wing.segment)
    return handles


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
