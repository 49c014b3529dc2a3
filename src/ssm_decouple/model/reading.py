"""The numbers of a URDF, read without Pinocchio."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ssm_decouple.model.grammar import ATTRIBUTES, MOVING
from ssm_decouple.model.urdf import floats, joint_end, number, numbers

Floats = NDArray[np.float64]

UNLIMITED = 1e300  # Pinocchio writes the largest double where a URDF gives no limit


@dataclass(frozen=True)
class JointLimits:
    """Limits of a joint as the file means them: infinite where it gives none.

    Attributes:
        lower: rad or m.
        upper: rad or m.
        effort: N m or N.
        velocity: rad/s or m/s.
    """

    lower: float
    upper: float
    effort: float
    velocity: float

    @classmethod
    def of(cls, joint: ET.Element) -> JointLimits:
        """Read the limits of a joint that moves.

        A continuous joint has no position limits. A joint whose <limit> has one of lower and upper has the other at
        zero, as URDF says; with neither it has no position limits.
        """
        limit = joint.find("limit")
        given = (
            {}
            if limit is None
            else {key: number(text) for key, text in limit.attrib.items() if key in ATTRIBUTES["limit"]}
        )
        free = joint.get("type") == "continuous" or not ("lower" in given or "upper" in given)
        return cls(
            lower=-np.inf if free else _endless(given.get("lower", 0.0)),
            upper=np.inf if free else _endless(given.get("upper", 0.0)),
            effort=_endless(given.get("effort", np.inf)),
            velocity=_endless(given.get("velocity", np.inf)),
        )


def _endless(value: float) -> float:
    return value if abs(value) < UNLIMITED else math.copysign(math.inf, value)


@dataclass(frozen=True)
class JointReading:
    """A joint: its type, the links that it joins, its unit axis (3,), limits, damping and friction, SI."""

    name: str
    kind: str
    parent: str
    child: str
    axis: Floats
    limits: JointLimits
    damping: float
    friction: float

    @classmethod
    def of(cls, joint: ET.Element) -> JointReading:
        """Read a joint."""
        kind, moves = joint.get("type", ""), joint.get("type") in MOVING
        dynamics = joint.find("dynamics") if moves else None
        return cls(
            name=joint.get("name", ""),
            kind=kind,
            parent=joint_end(joint, "parent"),
            child=joint_end(joint, "child"),
            axis=unit_axis(joint) if moves else np.zeros(3),
            limits=JointLimits.of(joint) if moves else JointLimits(-np.inf, np.inf, np.inf, np.inf),
            damping=0.0 if dynamics is None else number(dynamics.get("damping", "0")),
            friction=0.0 if dynamics is None else number(dynamics.get("friction", "0")),
        )


def unit_axis(joint: ET.Element) -> Floats:
    """Return the axis of a joint (3,) as a unit vector, however long or short it is written."""
    element = joint.find("axis")
    axis = floats(None if element is None else element.get("xyz"), (1.0, 0.0, 0.0))
    axis = axis / np.abs(axis).max()  # first, so that no square overflows or vanishes
    unit: Floats = axis / np.linalg.norm(axis)
    return unit


def rotations(elements: Sequence[ET.Element | None]) -> Floats:
    """Return the rotations (k, 3, 3) that <origin> elements write as rpy or as a quaternion; None is the identity."""
    rpy = _triples(elements, "rpy")
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy).T, np.sin(rpy).T
    R = np.empty((len(elements), 3, 3))
    R[:, 0, 0], R[:, 0, 1], R[:, 0, 2] = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
    R[:, 1, 0], R[:, 1, 1], R[:, 1, 2] = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
    R[:, 2, 0], R[:, 2, 1], R[:, 2, 2] = -sp, cp * sr, cp * cr
    for i, element in enumerate(elements):
        if element is not None and element.get("quat_xyzw") is not None:
            R[i] = _of_quaternion(floats(element.get("quat_xyzw"), ()))
    return R


def _of_quaternion(quaternion: Floats) -> Floats:
    x, y, z, w = quaternion / np.linalg.norm(quaternion)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    R: Floats = np.eye(3) + 2 * w * K + 2 * K @ K
    return R


def _triples(elements: Sequence[ET.Element | None], key: str) -> Floats:
    found = [(0.0, 0.0, 0.0) if e is None or (text := e.get(key)) is None else numbers(text) for e in elements]
    return np.array(found, dtype=float).reshape(len(elements), 3)


@dataclass(frozen=True)
class Reading:
    """What a URDF says, number by number, each link in its own axes.

    Attributes:
        links: Names of the links (l), parents before children; the first is the root.
        masses: (l,), kg.
        centres: Centres of mass (l, 3), m.
        inertias: About the centres of mass (l, 3, 3), kg m2.
        joints: The joint above each link but the root (l - 1), in the order of `links`.
        turns: Rotation of each of these joints' frames in the parent link (l - 1, 3, 3).
        offsets: Its position there (l - 1, 3), m.
    """

    links: tuple[str, ...]
    masses: Floats
    centres: Floats
    inertias: Floats
    joints: tuple[JointReading, ...]
    turns: Floats
    offsets: Floats

    @classmethod
    def of(cls, root: ET.Element) -> Reading:
        """Read a URDF in which `inspect_urdf` found nothing impossible."""
        above = {joint_end(joint, "child"): joint for joint in root.findall("joint")}
        links = _parents_first(root, above)
        inertials = [link.find("inertial") for link in links]
        origins = [None if i is None else i.find("origin") for i in inertials]
        joints = [above[link.get("name", "")] for link in links[1:]]
        placed = [joint.find("origin") for joint in joints]
        tensors, R = np.array([_tensor(i) for i in inertials]).reshape(-1, 3, 3), rotations(origins)
        masses = [0.0 if i is None else number(i.find("mass").get("value", "")) for i in inertials]  # type: ignore[union-attr]
        return cls(
            links=tuple(link.get("name", "") for link in links),
            masses=np.array(masses),
            centres=_triples(origins, "xyz"),
            inertias=R @ tensors @ R.transpose(0, 2, 1),
            joints=tuple(JointReading.of(joint) for joint in joints),
            turns=rotations(placed),
            offsets=_triples(placed, "xyz"),
        )

    def placed(self) -> Placed:
        """Follow the fixed joints: which moving joint carries each link, and where it stands in that joint's frame."""
        place = {name: i for i, name in enumerate(self.links)}
        count = len(self.links)
        carrier, row = np.zeros(count, dtype=int), np.zeros(count, dtype=int)
        R, p, reach = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), np.zeros(count)
        turned, offset, held_by = np.empty((count - 1, 3, 3)), np.empty((count - 1, 3)), np.zeros(count - 1, dtype=int)
        lengths = np.linalg.norm(self.offsets, axis=1)
        for i, joint in enumerate(self.joints):
            parent, link = place[joint.parent], i + 1
            held_by[i] = parent
            if row[parent]:
                turned[i], offset[i] = R[parent] @ self.turns[i], p[parent] + R[parent] @ self.offsets[i]
            else:
                turned[i], offset[i] = self.turns[i], self.offsets[i]
            if joint.kind in MOVING:
                carrier[link] = link
            else:
                carrier[link], R[link], p[link] = carrier[parent], turned[i], offset[i]
                reach[link], row[link] = reach[parent] + lengths[i], row[parent] + 1
        return Placed(carrier, R, p, reach, row, held_by, turned, offset)


@dataclass(frozen=True)
class Placed:
    """Links in the frames of the joints that move them.

    Attributes:
        carrier: The link right below the moving joint that carries each link (l,); the root carries itself.
        R: Rotation of each link in the frame of that joint (l, 3, 3).
        p: Its position there (l, 3), m.
        reach: Length of the fixed joints in between, all in a row (l,), m.
        row: Their number (l,).
        held_by: The link that holds each joint (l - 1,).
        turned: Rotation of each joint's frame in the frame of the joint that carries that link (l - 1, 3, 3).
        offset: Its position there (l - 1, 3), m.
    """

    carrier: NDArray[np.int_]
    R: Floats
    p: Floats
    reach: Floats
    row: NDArray[np.int_]
    held_by: NDArray[np.int_]
    turned: Floats
    offset: Floats


def _parents_first(root: ET.Element, above: dict[str, ET.Element]) -> list[ET.Element]:
    elements = {link.get("name", ""): link for link in root.findall("link")}
    below: dict[str, list[str]] = {}
    for child, joint in above.items():
        below.setdefault(joint_end(joint, "parent"), []).append(child)
    ordered = [name for name in elements if name not in above]
    for name in ordered:  # grows while it is walked
        ordered += below.get(name, [])
    return [elements[name] for name in ordered]


def _tensor(inertial: ET.Element | None) -> list[float]:
    element = None if inertial is None else inertial.find("inertia")
    if element is None:
        return [0.0] * 9
    xx, xy, xz, yy, yz, zz = (number(element.get(key, "")) for key in ATTRIBUTES["inertia"])
    return [xx, xy, xz, xy, yy, yz, xz, yz, zz]
