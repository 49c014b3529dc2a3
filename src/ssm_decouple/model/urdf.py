"""URDF text: read, the bodies in it and its shapes."""

from __future__ import annotations

import codecs
import copy
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from ssm_decouple.errors import InputError, ModelError

Level = Literal["note", "suspicious", "impossible"]


@dataclass(frozen=True)
class Finding:
    """Something worth knowing about a robot description.

    Attributes:
        level: "impossible" refuses the robot, "suspicious" probably is a mistake in the file, "note" is harmless.
        where: The link or joint meant, for example "link forearm".
        message: What is the matter, with the value, and what to do.
    """

    level: Level
    where: str
    message: str

    def __str__(self) -> str:
        return " ".join(f"{self.where}: {self.message}".split())  # on one line, whatever is quoted


def read_urdf(path: str | Path) -> str:
    """Return the text of a URDF file.

    Raises:
        ModelError: no such file, or not text.
    """
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise ModelError(f"cannot read '{path}': {error.strerror or error}") from error
    declared = re.match(rb"""\s*<\?xml[^>]*encoding\s*=\s*["']([\w.-]+)["']""", content)
    encoding = "utf-8" if declared is None else declared[1].decode("ascii")
    for mark, meant in _MARKS.items():
        if content.startswith(mark):
            encoding = meant
    try:
        text = content.decode(encoding)
        if encoding == "utf-16" and "<" not in text[:1000]:
            raise UnicodeError("two bytes that look like a mark")
    except (UnicodeError, LookupError) as error:
        raise ModelError(f"'{path}' is not a URDF: it is not text in the encoding {encoding}") from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


_MARKS = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}


def parse_urdf(text: str, source: str) -> ET.Element:
    """Return the <robot> element of URDF text.

    Raises:
        ModelError: not text, not XML, not a URDF, or still a xacro.
    """
    if not isinstance(text, str):
        raise ModelError(
            f"'{source}' is no URDF text but {type(text).__name__}; a file is loaded with load_robot(path)"
        )
    try:
        root = ET.fromstring(text.removeprefix("\ufeff"))
    except (ET.ParseError, ValueError) as error:
        raise ModelError(f"'{source}' is not XML: {error}") from error
    namespace = root.tag.removesuffix("robot")
    if namespace.startswith("{"):  # one for the whole file, which says nothing
        for element in root.iter():
            element.tag = element.tag.removeprefix(namespace)
    if root.tag != "robot":
        raise ModelError(f"'{source}' is XML but not a URDF: its root is <{root.tag}>, expected <robot>")
    if any("xacro" in str(element.tag) for element in root.iter()):
        raise ModelError(f"'{source}' still has xacro macros: expand it first with `xacro FILE > robot.urdf`")
    return root


_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_NO_NUMBER = re.compile(r"[+-]?(inf|infinity|nan)", re.IGNORECASE)


@lru_cache(maxsize=8192)
def number(text: str) -> float:
    """Parse a number as C++ does, blanks around it aside: Python alone would take 1_0 for ten, and other digits.

    Infinity and "nan" are read, so that who asks can say where they stand.

    Raises:
        ValueError: it is none, or beyond the largest one.
    """
    word = text.strip()
    if not (_NUMBER.fullmatch(word) or _NO_NUMBER.fullmatch(word)):
        raise ValueError(f"'{text}' is not a number")
    value = float(word)
    if math.isinf(value) and _NUMBER.fullmatch(word):
        raise ValueError(f"'{text}' is beyond the largest number")
    return value


@lru_cache(maxsize=8192)  # each is asked for several times, and many are the same
def numbers(text: str) -> tuple[float, ...]:
    """Parse the numbers of a URDF attribute such as xyz="0 0 1".

    Raises:
        ValueError: as `number`.
    """
    return tuple(number(word) for word in text.split())


def floats(text: str | None, default: tuple[float, ...]) -> NDArray[np.float64]:
    """Parse a URDF attribute such as xyz="0 0 1"."""
    return np.array(default if text is None else numbers(text))


def attribute(element: ET.Element, child: str, name: str) -> float:
    """Return a number that an element's child has as an attribute.

    Raises:
        ValueError: there is none.
    """
    found = element.find(child)
    if found is None or found.get(name) is None:
        raise ValueError(f"<{element.tag}> lacks <{child} {name}=..>")
    return number(found.get(name, ""))


def inertia_matrix(inertial: ET.Element) -> NDArray[np.float64]:
    """Return the inertia (3, 3), kg m2, that an <inertial> gives, in the axes of its <origin>."""
    xx, xy, xz, yy, yz, zz = (attribute(inertial, "inertia", f"i{ij}") for ij in ("xx", "xy", "xz", "yy", "yz", "zz"))
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


@dataclass(frozen=True)
class Body:
    """What a rigid body weighs, in the axes of its link.

    Attributes:
        mass: kg.
        centre: Centre of mass (3,), m.
        inertia: About the centre of mass (3, 3), kg m2.
    """

    mass: float
    centre: NDArray[np.float64]
    inertia: NDArray[np.float64]

    def without(self, parts: Iterable[Body]) -> Body:
        """Return what remains of the body when parts of it, given in the same axes, are taken out."""
        parts = list(parts)
        mass = self.mass - sum(part.mass for part in parts)
        moment = self.mass * self.centre - sum((part.mass * part.centre for part in parts), np.zeros(3))
        centre = moment / mass
        inertia = self._about(centre) - sum((part._about(centre) for part in parts), np.zeros((3, 3)))
        return Body(mass, centre, inertia)

    def _about(self, point: NDArray[np.float64]) -> NDArray[np.float64]:
        arm = self.centre - point
        return self.inertia + self.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))


def refuse_twins(kind: str, names: Sequence[str]) -> None:
    """Refuse a name that stands twice.

    Raises:
        InputError: one does; the message calls what is so named `kind`, in the plural.
    """
    twice = [name for i, name in enumerate(names) if name in names[:i]]
    if twice:
        raise InputError(f"two {kind} are called '{twice[0]}'; rename one")


def read_body(link: ET.Element) -> Body:
    """Return the mass, the centre of mass and the inertia of a link, in its axes; zero where it has no <inertial>."""
    inertial = link.find("inertial")
    if inertial is None:
        return Body(0.0, np.zeros(3), np.zeros((3, 3)))
    origin = inertial.find("origin")
    place = {} if origin is None else origin.attrib
    xyz, rpy = (floats(place.get(key), (0.0, 0.0, 0.0)) for key in ("xyz", "rpy"))
    turned = pin.rpy.rpyToMatrix(*rpy)
    return Body(attribute(inertial, "mass", "value"), xyz, turned @ inertia_matrix(inertial) @ turned.T)


def write_body(link: ET.Element, body: Body) -> None:
    """Give a link this mass, centre of mass and inertia, instead of any that it has."""
    for old in link.findall("inertial"):
        link.remove(old)
    inertial = ET.Element("inertial")
    ET.SubElement(inertial, "origin", xyz=triple(body.centre), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=repr(float(body.mass)))
    tensor = {f"i{'xyz'[i]}{'xyz'[j]}": repr(float(body.inertia[i, j])) for i in range(3) for j in range(i, 3)}
    ET.SubElement(inertial, "inertia", tensor)
    link.insert(0, inertial)


def remaining_body(root: ET.Element, kind: str, parts: Mapping[str, Body]) -> Body:
    """Return what remains of the root link when parts of it, by name and in its axes, are taken out.

    Raises:
        ModelError: they weigh as much as the root link or more, or leave an inertia that no body can have; the message
            calls each `kind`.
    """
    base = root_link(root)
    whole, weight, whose = read_body(_link(root, base)), sum(part.mass for part in parts.values()), ", ".join(parts)
    if not weight < whole.mass:
        raise ModelError(
            f"the {kind}s {whose} weigh {weight:g} kg of the {whole.mass:g} kg of the root link '{base}', which has to "
            "hold them; make them lighter or the root link heavier"
        )
    remaining = whole.without(parts.values())
    moments = np.linalg.eigvalsh(remaining.inertia)
    if not moments[0] > 0:
        listed = ", ".join(f"{moment:.5g}" for moment in moments)
        raise ModelError(
            f"without the {kind}s {whose} the root link '{base}' keeps the principal moments {listed} kg m2, which no "
            "body has: its inertia has to hold them; make them smaller, or the root link's inertia larger"
        )
    return remaining


def parted_urdf(root: ET.Element, kind: str, parts: Mapping[str, tuple[Body, Iterable[ET.Element]]]) -> ET.Element:
    """Return a URDF with parts as links and joints of their own, taken out of the root link.

    Args:
        root: The robot.
        kind: What messages call a part.
        parts: By name the body, in the axes of the root link, and the links and joints.

    Raises:
        ModelError: as `remaining_body`, or the URDF has a link or joint of the same name.
    """
    whole, taken = copy.deepcopy(root), {(element.tag, element.get("name")) for element in root}
    remaining = remaining_body(root, kind, {name: body for name, (body, _) in parts.items()})
    write_body(_link(whole, root_link(whole)), remaining)
    for part, (_, elements) in parts.items():
        for element in elements:
            name = element.get("name")
            if (element.tag, name) in taken:
                raise ModelError(f"the robot has a {element.tag} '{name}' already; call {kind} '{part}' something else")
            taken.add((element.tag, name))
            whole.append(element)
    ET.indent(whole)
    return whole


def _link(root: ET.Element, name: str) -> ET.Element:
    return next(link for link in root.findall("link") if link.get("name") == name)


def triple(vector: NDArray[np.float64]) -> str:
    """Write three numbers as a URDF attribute that loses no digit."""
    return " ".join(repr(float(x)) for x in vector)


def root_link(root: ET.Element) -> str:
    """Return the name of the link that has no parent."""
    children = {child.get("link") for child in root.findall("joint/child")}
    return next(link.get("name", "") for link in root.findall("link") if link.get("name") not in children)


def joint_end(joint: ET.Element, role: str) -> str:
    """Return the name of a joint's "parent" or "child" link; "" where it names none."""
    element = joint.find(role)
    return "" if element is None else element.get("link", "")


def tip_links(root: ET.Element) -> list[str]:
    """Return the links at the ends of the branches that at least one joint moves, in file order.

    Neither a wheel's rotor is one nor a frame that only marks a place: of the latter the link that it is fixed to.
    """
    every = root.findall("joint")
    joints = [joint for joint in every if joint.find("site") is None]
    marks = {joint_end(joint, "child") for joint in every if joint.find("site") is not None}
    parents = {joint_end(joint, "parent") for joint in joints}
    below: dict[str, list[ET.Element]] = {}
    for joint in joints:
        below.setdefault(joint_end(joint, "parent"), []).append(joint)
    moved, waiting = set(), [(root_link(root), False)]
    while waiting:
        link, moves = waiting.pop()
        if moves:
            moved.add(link)
        for joint in below.get(link, ()):
            turns = joint.get("type") != "fixed" and joint.find("wheel") is None
            waiting.append((joint_end(joint, "child"), moves or turns))
    names = [link.get("name", "") for link in root.findall("link")]
    return [name for name in names if name not in parents and name in moved and name not in marks]


@dataclass(frozen=True)
class Shape:
    """A box, cylinder or sphere that stands for a piece of a link.

    Attributes:
        name: The name of the visual, or "" where the file gives none.
        link: The link that it is fixed to.
        kind: "box", "cylinder" (about its z axis) or "sphere".
        size: Box edges (3,), cylinder (radius, length) or sphere (radius,), m.
        xyz: Position in the link frame (3,), m.
        rpy: Roll, pitch, yaw in the link frame (3,), rad.
        color: Red, green, blue from 0 to 1.
    """

    name: str
    link: str
    kind: Literal["box", "cylinder", "sphere"]
    size: tuple[float, ...]
    xyz: NDArray[np.float64]
    rpy: NDArray[np.float64]
    color: tuple[float, float, float]


def visual_shapes(text: str) -> list[Shape]:
    """Return the boxes, cylinders and spheres among the visuals of URDF text; meshes are left out."""
    root = ET.fromstring(text)
    palette = {m.get("name"): m.find("color") for m in root.iter("material") if m.find("color") is not None}
    shapes = []
    for link in root.findall("link"):
        for visual in link.findall("visual"):
            try:
                shape = _shape(visual, link.get("name", ""), palette)
            except ValueError:  # a malformed shape is no reason to refuse a figure
                continue
            if shape is not None:
                shapes.append(shape)
    return shapes


def _shape(visual: ET.Element, link: str, palette: dict[str | None, ET.Element | None]) -> Shape | None:
    sizes: dict[Literal["box", "cylinder", "sphere"], tuple[str, ...]] = {
        "box": ("size",),
        "cylinder": ("radius", "length"),
        "sphere": ("radius",),
    }
    material = visual.find("material")
    color = (
        None if material is None else (material.find("color") if len(material) else palette.get(material.get("name")))
    )
    red, green, blue = floats(None if color is None else color.get("rgba"), (0.7, 0.7, 0.7, 1.0))[:3]
    origin = visual.find("origin")
    place = {} if origin is None else origin.attrib
    for kind, attributes in sizes.items():
        element = visual.find(f"geometry/{kind}")
        if element is not None:
            size = tuple(float(x) for name in attributes for x in floats(element.get(name), ()))
            if len(size) != {"box": 3, "cylinder": 2, "sphere": 1}[kind]:
                return None  # as where a number is malformed
            xyz, rpy = (floats(place.get(key), (0.0, 0.0, 0.0)) for key in ("xyz", "rpy"))
            return Shape(visual.get("name", ""), link, kind, size, xyz, rpy, (red, green, blue))
    return None
