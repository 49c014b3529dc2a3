"""The shapes of a spacecraft from its URDF, each fixed to the body that carries it."""

from __future__ import annotations

import os
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Literal

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from ssm_decouple.errors import DecoupleWarning
from ssm_decouple.model.robot import Robot
from ssm_decouple.model.urdf import floats, visual_shapes

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Color = tuple[float, float, float]

GREY: Color = (0.7, 0.7, 0.72)
_THICKNESS = 0.12  # of a box that stands for a missing mesh, of its length


@dataclass(frozen=True)
class Part:
    """One shape.

    Attributes:
        name: Of the visual; "" where the file gives none.
        link: The link it belongs to.
        joint: Pinocchio index of the joint that moves it; 1 is the base.
        kind: "box", "cylinder" (about its z axis), "sphere" or "mesh".
        size: Box edges (3,), cylinder (radius, length), sphere (radius,), m; empty for a mesh.
        pose: In the axes of the joint.
        color: Red, green, blue from 0 to 1.
        vertices: Of a mesh (v, 3), m.
        faces: Of a mesh (f, 3), indices of vertices.
    """

    name: str
    link: str
    joint: int
    kind: Literal["box", "cylinder", "sphere", "mesh"]
    size: tuple[float, ...]
    pose: pin.SE3
    color: Color
    vertices: Floats = field(default_factory=lambda: np.empty((0, 3)))
    faces: Integers = field(default_factory=lambda: np.empty((0, 3), dtype=np.int64))

    @property
    def extent(self) -> Floats:
        """Corners of the box around the shape, lowest and highest (2, 3), m, in the axes of the shape."""
        if self.kind == "mesh":
            return np.array([self.vertices.min(axis=0), self.vertices.max(axis=0)])
        if self.kind == "box":
            half = 0.5 * np.array(self.size)
        elif self.kind == "cylinder":
            half = np.array([self.size[0], self.size[0], 0.5 * self.size[1]])
        else:
            half = np.full(3, self.size[0])
        return np.array([-half, half])

    @property
    def corners(self) -> Floats:
        """Corners of the box around the shape (8, 3), m, in the axes of the joint."""
        corners = np.array(np.meshgrid(*self.extent.T)).reshape(3, -1).T
        return corners @ self.pose.rotation.T + self.pose.translation


def spacecraft_parts(
    robot: Robot, turned: Mapping[str, float] | None = None, mesh_folders: Sequence[str | Path] = ()
) -> list[Part]:
    """Return the shapes of a robot.

    A mesh that cannot be found or read is replaced by the link's collision mesh, else by a box along the link; a
    warning names all of them once. A URDF without any visual is drawn as such boxes too.

    Args:
        robot: The robot.
        turned: Angles, rad, about the link's y axis, by the name of a visual: wings that face the Sun.
        mesh_folders: Where meshes are looked for, beside ROS_PACKAGE_PATH, the example robots and this folder.
    """
    angles = turned or {}
    found: list[Part] = []
    for shape in visual_shapes(robot.urdf):
        about_y = pin.SE3(pin.rpy.rpyToMatrix(0.0, angles.get(shape.name, 0.0), 0.0), np.zeros(3))
        pose = about_y * pin.SE3(pin.rpy.rpyToMatrix(*shape.rpy), shape.xyz)
        joint, link = _carrier(robot, shape.link)
        found.append(Part(shape.name, shape.link, joint, shape.kind, shape.size, link * pose, shape.color))
    found += _meshes(robot, [*map(Path, mesh_folders), *_usual_folders()])
    return found or _skeleton(robot)


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


def bus(parts: Sequence[Part]) -> Floats:
    """Return lowest and highest corner (2, 3), m, base axes, of what on the base takes the most room.

    That is one shape, so that wings do not count. Without any it is a point.
    """
    shapes = [part.corners for part in parts if part.joint == 1]
    boxes = [np.array([corners.min(axis=0), corners.max(axis=0)]) for corners in shapes]
    return max(boxes, key=lambda box: float(np.prod(box[1] - box[0])), default=np.zeros((2, 3)))


def _carrier(robot: Robot, link: str) -> tuple[int, pin.SE3]:
    frame = robot.model.frames[robot.frame_id(link)]
    return int(frame.parentJoint), frame.placement


def _usual_folders() -> list[Path]:
    folders = [Path(word) for word in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if word]
    try:
        shared = metadata.distribution("example-robot-data").locate_file("cmeel.prefix/share")
        folders.append(Path(str(shared)))
    except metadata.PackageNotFoundError:
        pass
    return [*folders, Path.cwd()]


@dataclass(frozen=True)
class _MeshVisual:
    name: str
    link: str
    files: tuple[str, ...]
    scales: tuple[Floats, ...]
    poses: tuple[pin.SE3, ...]
    color: Color | None


def _mesh_visuals(text: str) -> Iterator[_MeshVisual]:
    """Give every visual that is a mesh, with the collision meshes of its link as second choice."""
    root = ET.fromstring(text)
    palette = {m.get("name"): m.find("color") for m in root.iter("material") if m.find("color") is not None}
    for link in root.findall("link"):
        collisions = [item for item in link.findall("collision") if item.find("geometry/mesh") is not None]
        for visual in link.findall("visual"):
            if visual.find("geometry/mesh") is None:
                continue
            chosen = [visual, *collisions[:1]]
            meshes = [item.find("geometry/mesh") for item in chosen]
            material = visual.find("material")
            color = None
            if material is not None:
                color = material.find("color") if len(material) else palette.get(material.get("name"))
            rgb = None if color is None else tuple(floats(color.get("rgba"), (*GREY, 1.0))[:3].tolist())
            yield _MeshVisual(
                visual.get("name", ""),
                link.get("name", ""),
                tuple(mesh.get("filename", "") for mesh in meshes if mesh is not None),
                tuple(floats(mesh.get("scale"), (1.0, 1.0, 1.0)) for mesh in meshes if mesh is not None),
                tuple(_origin(item) for item in chosen),
                rgb,
            )


def _origin(element: ET.Element) -> pin.SE3:
    origin = element.find("origin")
    place = {} if origin is None else origin.attrib
    xyz, rpy = (floats(place.get(key), (0.0, 0.0, 0.0)) for key in ("xyz", "rpy"))
    return pin.SE3(pin.rpy.rpyToMatrix(*rpy), xyz)


def _meshes(robot: Robot, folders: Sequence[Path]) -> list[Part]:
    parts, missing = [], []
    for visual in _mesh_visuals(robot.urdf):
        joint, link = _carrier(robot, visual.link)
        for file, scale, pose in zip(visual.files, visual.scales, visual.poses, strict=True):
            loaded = _load(file, folders)
            if loaded is not None:
                vertices, faces = loaded
                color = visual.color or GREY
                parts.append(
                    Part(visual.name, visual.link, joint, "mesh", (), link * pose, color, vertices * scale, faces)
                )
                break
        else:
            missing.append(visual.files[0])
            parts.append(_stand_in(robot, visual, joint, link))
    if missing:
        listed = ", ".join(sorted(set(missing))[:3]) + (", .." if len(set(missing)) > 3 else "")
        warnings.warn(
            f"robot '{robot.name}': {len(missing)} of its meshes cannot be found or read and are drawn as boxes: "
            f"{listed}; name the folder that holds them with --meshes",
            DecoupleWarning,
            stacklevel=2,
        )
    return parts


def _load(file: str, folders: Sequence[Path]) -> tuple[Floats, Integers] | None:
    """Return vertices and faces of a mesh file; None where it is not found or trimesh cannot read it."""
    name = file.split("://", 1)[-1]
    places = [Path(name)] if Path(name).is_absolute() else [folder / name for folder in folders]
    places += [folder / Path(name).name for folder in folders]  # a folder that holds the files themselves
    place = next((place for place in places if place.is_file()), None)
    if place is None:
        return None
    import trimesh

    try:
        mesh = trimesh.load_mesh(place)
        vertices, faces = np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)
    except Exception:  # each format's reader has errors of its own, and a missing picture stops no viewer
        return None
    return (vertices, faces) if len(vertices) and len(faces) else None


def _stand_in(robot: Robot, visual: _MeshVisual, joint: int, link: pin.SE3) -> Part:
    """Return a box from the link's origin to the next joint, or to the end-effector, for a mesh that is not there."""
    model, tool = robot.model, robot.model.frames[robot.end_effector_id]
    ends = [model.jointPlacements[j].translation for j in range(2, model.njoints) if model.parents[j] == joint]
    if tool.parentJoint == joint:
        ends.append(tool.placement.translation)
    end = np.mean([link.actInv(end) for end in ends], axis=0) if ends and joint > 1 else np.zeros(3)
    length, color = float(np.linalg.norm(end)), visual.color or GREY
    if length < 1e-3:
        edge = (0.3 if joint == 1 else 0.05) * max(drawn_reach(robot), 0.2)
        return Part(visual.name, visual.link, joint, "box", (edge,) * 3, link, color)
    turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), end / length).toRotationMatrix()
    size = (_THICKNESS * length, _THICKNESS * length, length)
    return Part(visual.name, visual.link, joint, "box", size, link * pin.SE3(turn, 0.5 * end), color)


def drawn_reach(robot: Robot) -> float:
    """Return the arm's reach, m, to which drawn things are in proportion: 1 where a joint slides without limits."""
    return robot.reach if np.isfinite(robot.reach) else 1.0


def _skeleton(robot: Robot) -> list[Part]:
    """Return a box from each joint to the next, for a URDF without visuals."""
    names = [str(name) for name in robot.model.names]
    nameless = [_MeshVisual("", names[joint], (), (), (), None) for joint in range(robot.model.njoints)]
    return [_stand_in(robot, nameless[joint], joint, pin.SE3.Identity()) for joint in range(1, robot.model.njoints)]
