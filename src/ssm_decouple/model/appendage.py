"""Flexible appendages such as solar wings: plates that bend out of plane, cut into segments on sprung hinges."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ssm_decouple.errors import InputError, as_floats, as_items, as_text, as_whole, shown
from ssm_decouple.model.inspection import inspect_urdf
from ssm_decouple.model.urdf import (
    Body,
    Finding,
    parted_urdf,
    refuse_twins,
    remaining_body,
    root_link,
    triple,
    write_body,
)
from ssm_decouple.settled import FixedArrays

Floats = NDArray[np.float64]

MOST_SEGMENTS = 500

_HINGE_LIMIT = "1e9"  # rad/s and N m: URDF wants a number, and nothing drives a hinge

# A plate without thickness is at the edge of the triangle inequality: rounding must not push it over, as MuJoCo, for
# one, allows no tolerance.
_THIN = 1e-14


_LARGEST = 1e9  # of any number of an appendage, SI: beyond it squares and cubes leave floating point


@dataclass(frozen=True)
class Appendage(FixedArrays):
    """A solar wing or another flat plate that bends out of its plane.

    The plate has uniform area density and no thickness. It is cut across its span into equal segments, each a rigid
    plate, joined to the base and to each other by revolute hinges with linear torsional springs and dampers; hinge i
    stands at i span / segments from the root. Positive hinge angles move the tip along +normal.

    The springs are those of a uniform cantilever, the bending of the half segments next to a hinge lumped in it: the
    root hinge is twice as stiff as the others. Their scale is such that the first frequency of the segments with the
    base held is `frequency`, exactly. Dampers are proportional to the springs, so that the first clamped mode has
    `damping_ratio` and mode i has w_i / w_1 times it. A rigid wing is no appendage: leave it in the robot's URDF.

    Attributes:
        name: What it is called; its hinges are `{name}_hinge_{i}`, its segments `{name}_segment_{i}`.
        mount: Where its root stands (3,), m, base axes from the base origin. Kept as a tuple, as the directions are.
        span_direction: From root to tip (3,), base axes; made a unit vector.
        normal: Normal of the panel at turn 0 (3,), base axes, perpendicular to the span; made a unit vector.
        span: Length, m.
        chord: Width, m.
        mass: kg.
        frequency: First out-of-plane bending frequency with the base held, Hz.
        damping_ratio: Of that mode, from 0 to below 1.
        segments: Number of segments, which is the number of hinges.
        turn: How far the panel is turned about its span direction, for example to face the Sun, rad, right-handed: two
            wings that point in opposite directions face the Sun with opposite turns.

    Raises:
        InputError: a value makes no sense; the message names the appendage, the value and the mend.
    """

    name: str
    mount: ArrayLike
    span_direction: ArrayLike
    normal: ArrayLike
    span: float
    chord: float
    mass: float
    frequency: float
    damping_ratio: float
    segments: int = 1
    turn: float = 0.0

    def __post_init__(self) -> None:
        as_text("an appendage's name", self.name, "give it a text that is not empty")
        for key, unit in {"span": "m", "chord": "m", "mass": "kg", "frequency": "Hz"}.items():
            value = self._number(key)
            if not 0 < value < np.inf:
                rigid = "; a rigid wing is no appendage, leave it in the URDF" if value == np.inf else ""
                raise self._error(key, f"it must be above zero and finite, in {unit}{rigid}")
        if not 0 <= self._number("damping_ratio") < 1:
            raise self._error("damping_ratio", "it must be from 0 to below 1, for example 0.005")
        segments = as_whole(f"appendage '{self.name}': segments", self.segments)
        if segments > MOST_SEGMENTS:
            raise self._error("segments", f"each is a body with a joint: {MOST_SEGMENTS} at most")
        if not np.isfinite(self._number("turn")):
            raise self._error("turn", "it must be a finite angle, rad")
        if abs(self.turn) > 2 * np.pi:
            raise self._error(
                "turn", f"more than a whole turn; in rad, {self.turn:g} deg are {np.deg2rad(self.turn):.4g}"
            )
        object.__setattr__(self, "segments", segments)
        object.__setattr__(self, "mount", tuple(map(float, self._vector("mount"))))
        span, normal = self._direction("span_direction"), self._direction("normal")
        along = float(span @ normal)
        if abs(along) > 1e-6:
            off = float(np.rad2deg(np.arcsin(min(abs(along), 1.0))))
            raise self._error("normal", f"it must be perpendicular to span_direction, it is {off:.3g} deg off")
        normal -= (span @ normal) * span
        object.__setattr__(self, "span_direction", tuple(map(float, span)))
        object.__setattr__(self, "normal", tuple(map(float, normal / np.linalg.norm(normal))))

    def _error(self, key: str, mend: str) -> InputError:
        return InputError(f"appendage '{self.name}': {key} is {shown(getattr(self, key))}; {mend}")

    def _number(self, key: str) -> float:
        try:
            value = as_floats(key, getattr(self, key))
        except InputError:
            raise self._error(key, "it must be a number") from None
        if value.shape != ():
            raise self._error(key, "it must be a number")
        try:
            number = float(value)
        except OverflowError:  # a whole number of hundreds of digits
            number = 2 * _LARGEST
        if _LARGEST < abs(number) < np.inf:
            raise self._error(key, f"it must be {_LARGEST:g} at most")
        object.__setattr__(self, key, number)
        return number

    def _vector(self, key: str) -> Floats:
        try:
            values = as_floats(key, getattr(self, key))
        except InputError:
            values = np.empty(0)
        if values.shape != (3,) or not np.all(np.isfinite(values)):
            raise self._error(key, "it needs 3 finite numbers, base axes")
        if np.abs(values).max() > _LARGEST:
            raise self._error(key, f"its numbers must be {_LARGEST:g} at most")
        return values

    def _direction(self, key: str) -> Floats:
        values = self._vector(key)
        length = float(np.linalg.norm(values))
        if not 1e-9 < length < np.inf:
            raise self._error(key, "it needs a direction, a vector of length 1")
        return values / length

    @cached_property
    def turned_normal(self) -> Floats:
        """Normal of the panel as it is turned (3,), unit, base axes."""
        span, normal = np.array(self.span_direction), np.array(self.normal)
        return _frozen(np.cos(self.turn) * normal + np.sin(self.turn) * np.cross(span, normal))

    @cached_property
    def hinge_axis(self) -> Floats:
        """Axis of every hinge (3,), unit, base axes: span x normal, so that positive angles lift the tip."""
        return _frozen(np.cross(np.array(self.span_direction), self.turned_normal))

    @cached_property
    def hinge_offsets(self) -> Floats:
        """Distance of each hinge from the root (segments,), m."""
        offsets: Floats = self.span / self.segments * np.arange(self.segments, dtype=float)
        return _frozen(offsets)

    @property
    def body(self) -> Body:
        """The undeformed plate as one rigid body, base axes from the base origin."""
        root = np.array(self.mount)
        flat = self._plate(self.span, self.mass)
        return Body(flat.mass, root + flat.centre, flat.inertia)

    @property
    def segment_body(self) -> Body:
        """Each segment as a rigid body, from its hinge, in axes parallel to the base's when nothing is bent."""
        return self._plate(self.span / self.segments, self.mass / self.segments)

    def _plate(self, length: float, mass: float) -> Body:
        span = np.array(self.span_direction)
        about_span, about_axis = mass * self.chord**2 / 12, mass * length**2 / 12
        inertia = (
            about_span * np.outer(span, span)
            + about_axis * np.outer(self.hinge_axis, self.hinge_axis)
            + (about_span + about_axis) * (1 - _THIN) * np.outer(self.turned_normal, self.turned_normal)
        )
        return Body(mass, 0.5 * length * span, inertia)

    @cached_property
    def mass_matrix(self) -> Floats:
        """Inertia of the hinge angles with the base held, nothing bent (segments, segments), kg m2."""
        rows, columns = self.hinge_offsets[:, None], self.hinge_offsets
        apart, beyond = np.abs(rows - columns), self.span - np.maximum(rows, columns)
        return _frozen(self.mass / self.span * (beyond**3 / 3 + apart * beyond**2 / 2))

    @cached_property
    def coupling(self) -> Floats:
        """Base-hinge block of the mass matrix, nothing bent (6, segments): [linear; angular] about the base origin.

        Times hinge rates it is the momentum that they carry, base axes, kg m and kg m2.
        """
        beyond = self.span - self.hinge_offsets
        first = self.mass / self.span * beyond**2 / 2  # integrals of the deflection of a unit angle, and of its moment
        second = self.mass / self.span * (beyond**3 / 3 + self.hinge_offsets * beyond**2 / 2)
        arm = np.cross(np.array(self.mount), self.turned_normal)
        angular = np.outer(arm, first) + np.outer(self.hinge_axis, second)
        return _frozen(np.vstack([np.outer(self.turned_normal, first), angular]))

    @cached_property
    def _clamped(self) -> tuple[float, Floats, Floats]:
        """Return the stiffness scale kappa, the clamped angular frequencies and the mass-normalised shapes."""
        root = 1 / np.sqrt(self._relative_stiffness)
        # 1 / w^2 are its eigenvalues: the lowest frequency, which sets the scale, is the most accurate of them.
        flexibility, vectors = np.linalg.eigh(root[:, None] * self.mass_matrix * root)
        flexibility, shapes = flexibility[::-1], root[:, None] * vectors[:, ::-1] / np.sqrt(flexibility[::-1])
        lifts = (self.span - self.hinge_offsets) @ shapes  # of the tip
        kappa = (2 * np.pi * self.frequency) ** 2 * float(flexibility[0])
        return kappa, np.sqrt(kappa / flexibility), shapes * np.where(lifts < 0, -1.0, 1.0)

    @property
    def _relative_stiffness(self) -> Floats:
        return np.array([2.0] + [1.0] * (self.segments - 1))

    @cached_property
    def stiffness(self) -> Floats:
        """Stiffness of each hinge, from the root (segments,), N m/rad."""
        return _frozen(self._clamped[0] * self._relative_stiffness)

    @cached_property
    def damping(self) -> Floats:
        """Damping of each hinge, from the root (segments,), N m s/rad: 2 zeta k / w_1."""
        return _frozen(2 * self.damping_ratio * self.stiffness / self._clamped[1][0])

    @property
    def frequencies(self) -> Floats:
        """Frequencies of the segments with the base held (segments,), Hz, rising; the first is `frequency`."""
        return self._clamped[1] / (2 * np.pi)

    @property
    def shapes(self) -> Floats:
        """Hinge angles of each clamped mode, a column each (segments, segments), mass-normalised, tip along +normal."""
        return self._clamped[2].copy()

    def tip_deflection(self, hinge_angles: ArrayLike) -> Floats:
        """Return how far the tip stands out of the undeformed plane, along +normal.

        Args:
            hinge_angles: (..., segments), rad, from the root.

        Returns:
            (...), m, for any size of angles.

        Raises:
            InputError: a wrong length, or not finite.
        """
        given = as_floats("hinge angles", hinge_angles)
        if not given.ndim or given.shape[-1] != self.segments or not np.all(np.isfinite(given)):
            raise InputError(
                f"hinge angles of shape {given.shape}; appendage '{self.name}' needs (.., {self.segments}) finite "
                "numbers, rad, from the root"
            )
        angles = np.cumsum(given, axis=-1)
        return np.asarray(self.span / self.segments * np.sin(angles).sum(axis=-1))


def _frozen(values: Floats) -> Floats:
    values.flags.writeable = False
    return values


@dataclass(frozen=True)
class Modes(FixedArrays):
    """Clamped bending modes of a robot's appendages.

    Mode j, at rest and for small motion, obeys
    eta'' + 2 zeta_j w_j eta' + w_j^2 eta = -participation[:, j] . d/dt(base twist), w_j = 2 pi frequencies[j].

    Attributes:
        names: One a mode (m), such as "wing_left 1".
        frequencies: With the base held (m,), Hz.
        damping_ratios: zeta_j (m,).
        participation: (6, m), [linear; angular] about the base origin, base axes, sqrt(kg) and sqrt(kg) m.
        shapes: Hinge angles of each mode (h, m), mass-normalised, rad / (sqrt(kg) m); hinges are ordered by appendage,
            then from root to tip.
    """

    names: tuple[str, ...]
    frequencies: Floats
    damping_ratios: Floats
    participation: Floats
    shapes: Floats

    @classmethod
    def of(cls, appendages: Sequence[Appendage], per_appendage: int) -> Modes:
        """Return the first modes of each appendage.

        Raises:
            InputError: fewer than one mode, or more than an appendage has segments.
        """
        per_appendage = as_whole("per_appendage", per_appendage)
        appendages = checked_appendages(appendages)
        if not appendages:
            raise InputError("there is no appendage and so no mode; build one with ssm_decouple.Appendage(..)")
        for appendage in appendages:
            if per_appendage > appendage.segments:
                raise InputError(
                    f"appendage '{appendage.name}' has {appendage.segments} segments and so as many modes, not "
                    f"{per_appendage}; give it more segments"
                )
        kept = range(per_appendage)
        hinges, modes = sum(a.segments for a in appendages), len(kept) * len(appendages)
        shapes, participation, row = np.zeros((hinges, modes)), np.zeros((6, modes)), 0
        for i, appendage in enumerate(appendages):
            columns, own = slice(i * len(kept), (i + 1) * len(kept)), appendage.shapes[:, kept]
            shapes[row : row + appendage.segments, columns] = own
            participation[:, columns] = appendage.coupling @ own
            row += appendage.segments
        return cls(
            names=tuple(f"{a.name} {j + 1}" for a in appendages for j in kept),
            frequencies=_frozen(np.concatenate([a.frequencies[kept] for a in appendages])),
            damping_ratios=_frozen(
                np.concatenate([a.damping_ratio * a.frequencies[kept] / a.frequency for a in appendages])
            ),
            participation=_frozen(participation),
            shapes=_frozen(shapes),
        )


def checked_appendages(appendages: Iterable[Appendage]) -> tuple[Appendage, ...]:
    """Return appendages as a tuple.

    Raises:
        InputError: one is none, or two share a name.
    """
    if isinstance(appendages, Appendage):
        raise InputError(f"appendages is the one appendage '{appendages.name}'; put it in a list")
    mend = "build them with ssm_decouple.Appendage(..)"
    found: tuple[Any, ...] = tuple(as_items("appendages", appendages, mend))
    for appendage in found:
        if not isinstance(appendage, Appendage):
            raise InputError(f"{shown(appendage)} is no appendage; build it with ssm_decouple.Appendage(..)")
    refuse_twins("appendages", [appendage.name for appendage in found])
    return found


def remaining_bus(root: ET.Element, appendages: Sequence[Appendage]) -> Body:
    """Return what remains of the root link when its appendages, undeformed, are taken out of it.

    Raises:
        ModelError: they weigh as much as the root link or more, or leave an inertia that no body can have.
    """
    return remaining_body(root, "appendage", {appendage.name: appendage.body for appendage in appendages})


def flexible_urdf(root: ET.Element, appendages: Sequence[Appendage]) -> ET.Element:
    """Return a URDF whose appendages are links of their own, on hinges of the root link, taken out of its inertia.

    Raises:
        ModelError: as `remaining_bus`, or the URDF has a link or joint of the same name.
    """
    base = root_link(root)
    return parted_urdf(root, "appendage", {part.name: (part.body, _chain(part, base)) for part in appendages})


def inspect_remaining_bus(root: ET.Element, appendages: Sequence[Appendage]) -> list[Finding]:
    """Say what is suspicious in the inertia that the root link keeps without its appendages.

    Raises:
        ModelError: as `flexible_urdf`.
    """
    if not appendages:
        return []
    link = f"link {root_link(root)}"
    return [
        Finding(finding.level, f"{link} without its appendages", finding.message)
        for finding in inspect_urdf(flexible_urdf(root, appendages))
        if finding.where == link and "principal moment" in finding.message
    ]


def _chain(appendage: Appendage, base: str) -> list[ET.Element]:
    """Return the joints and links of an appendage, from its root; all their axes are parallel to the base's."""
    elements, parent = [], base
    step = np.array(appendage.span_direction) * (appendage.span / appendage.segments)
    for i in range(appendage.segments):
        link = ET.Element("link", name=f"{appendage.name}_segment_{i}")
        write_body(link, appendage.segment_body)
        joint = ET.Element("joint", name=f"{appendage.name}_hinge_{i}", type="revolute")
        ET.SubElement(joint, "parent", link=parent)
        ET.SubElement(joint, "child", link=link.get("name", ""))
        ET.SubElement(joint, "origin", xyz=triple(step if i else np.array(appendage.mount)), rpy="0 0 0")
        ET.SubElement(joint, "axis", xyz=triple(appendage.hinge_axis))
        ET.SubElement(joint, "limit", lower=repr(-np.pi), upper=repr(np.pi), effort=_HINGE_LIMIT, velocity=_HINGE_LIMIT)
        elements += [link, joint]
        parent = link.get("name", "")
    return elements
