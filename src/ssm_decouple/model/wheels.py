"""Reaction wheels: rotors on the root link, taken out of its mass and inertia and driven as joints of the robot."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ssm_decouple.errors import InputError, as_floats, as_items, as_not_negative, as_positive, as_text, shown
from ssm_decouple.model.urdf import Body, floats, parted_urdf, refuse_twins, root_link, triple, write_body

Floats = NDArray[np.float64]

PARALLEL = np.deg2rad(1.0)  # axes closer than this are one axis

# A disk without thickness is at the edge of the triangle inequality: rounding must not push it over.
_THICK = 1 + 1e-14


@dataclass(frozen=True)
class Wheel:
    """A reaction wheel: a balanced rotor that turns about an axis fixed in the base.

    It becomes a continuous joint of the robot, called as the wheel is, whose positive rate is right-handed about the
    axis, relative to the base. Across the axis the rotor's inertia is that of a thin disk; like its mass and its
    position it moves with the base, was part of the root link and so changes nothing.

    Attributes:
        name: Of the joint; the rotor is the link `{name}_rotor`.
        axis: (3,), base axes; made a unit vector, a tuple.
        spin_inertia: About its axis, kg m2.
        max_speed: Largest speed relative to the base, rad/s: the joint's rate limit.
        max_torque: Largest torque of its motor, N m: the joint's effort limit.
        mass: kg, part of the root link's; zero leaves it there.
        position: Of the rotor's centre of mass (3,), m, base axes from the base origin; a tuple.

    Raises:
        InputError: a value makes no sense; the message names the wheel, the value and the mend.
    """

    name: str
    axis: ArrayLike
    spin_inertia: float
    max_speed: float
    max_torque: float
    mass: float = 0.0
    position: ArrayLike = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        as_text("a wheel's name", self.name, "give it a text that is not empty")
        for key, unit in {"spin_inertia": "kg m2", "max_speed": "rad/s", "max_torque": "N m"}.items():
            self._set(key, as_positive, f"it must be above zero and finite, in {unit}")
        self._set("mass", as_not_negative, "it must be zero or more and finite, in kg")
        axis = self._vector("axis")
        length = float(np.linalg.norm(axis))
        if not 1e-9 < length < np.inf:
            raise self._error("axis", "it needs a direction, a vector of length 1")
        object.__setattr__(self, "axis", tuple(map(float, axis / length)))
        object.__setattr__(self, "position", tuple(map(float, self._vector("position"))))

    def _error(self, key: str, mend: str) -> InputError:
        return InputError(f"wheel '{self.name}': {key} is {shown(getattr(self, key))}; {mend}")

    def _set(self, key: str, checked: Callable[[str, float, str], float], needs: str) -> None:
        object.__setattr__(self, key, checked(f"wheel '{self.name}': {key}", getattr(self, key), needs))

    def _vector(self, key: str) -> Floats:
        values = as_floats(f"wheel '{self.name}': {key}", getattr(self, key))
        if values.shape != (3,) or not np.all(np.isfinite(values)):
            raise self._error(key, "it needs 3 finite numbers, base axes")
        return values

    @property
    def body(self) -> Body:
        """The rotor, base axes from the base origin."""
        axis, across = np.array(self.axis), 0.5 * self.spin_inertia * _THICK
        inertia = across * np.eye(3) + (self.spin_inertia - across) * np.outer(axis, axis)
        return Body(self.mass, np.array(self.position), inertia)


def wheeled_urdf(root: ET.Element, wheels: Iterable[Wheel]) -> ET.Element:
    """Return a URDF with the wheels on its root link, their mass and inertia taken out of that.

    Each wheel's joint holds an element <wheel/>, which readers of URDF pass over, so that it is known in any copy.

    Raises:
        InputError: no wheel, two of one name, or two axes that are nearly parallel, also of wheels that it has.
        ModelError: a name that the URDF has, or wheels that leave the root link no possible mass or inertia.
    """
    added = _checked(wheels)
    _refuse_parallel({**wheel_axes(root), **{wheel.name: np.array(wheel.axis) for wheel in added}})
    base = root_link(root)
    return parted_urdf(root, "wheel", {wheel.name: (wheel.body, _rotor(wheel, base)) for wheel in added})


def wheel_axes(root: ET.Element) -> dict[str, Floats]:
    """Return the axes (3,), base axes, of the wheels that a URDF has, by joint name."""
    found = {}
    for joint in root.findall("joint"):
        axis = joint.find("axis")
        if joint.find("wheel") is not None and axis is not None:
            found[joint.get("name", "")] = floats(axis.get("xyz"), (1.0, 0.0, 0.0))
    return found


def _checked(wheels: Iterable[Wheel]) -> list[Wheel]:
    mend = "build them with ssm_decouple.Wheel(..)"
    found: list[Any] = [wheels] if isinstance(wheels, Wheel) else as_items("wheels", wheels, mend)
    if not found:
        raise InputError("no wheel is given; build them with ssm_decouple.Wheel(..)")
    for wheel in found:
        if not isinstance(wheel, Wheel):
            raise InputError(f"{shown(wheel)} is no wheel; build it with ssm_decouple.Wheel(..)")
    refuse_twins("wheels", [wheel.name for wheel in found])
    return found


def _refuse_parallel(axes: dict[str, Floats]) -> None:
    for (one, a), (two, b) in combinations(axes.items(), 2):
        angle = float(np.arctan2(np.linalg.norm(np.cross(a, b)), abs(a @ b)))
        if angle < PARALLEL:
            raise InputError(
                f"wheels '{one}' and '{two}' turn about the same axis ({np.rad2deg(angle):.3g} deg apart); make them "
                "one wheel, or turn one of them"
            )


def _rotor(wheel: Wheel, base: str) -> tuple[ET.Element, ET.Element]:
    link = ET.Element("link", name=f"{wheel.name}_rotor")
    write_body(link, Body(wheel.mass, np.zeros(3), wheel.body.inertia))
    joint = ET.Element("joint", name=wheel.name, type="continuous")
    ET.SubElement(joint, "parent", link=base)
    ET.SubElement(joint, "child", link=f"{wheel.name}_rotor")
    ET.SubElement(joint, "origin", xyz=triple(np.array(wheel.position)), rpy="0 0 0")
    ET.SubElement(joint, "axis", xyz=triple(np.array(wheel.axis)))
    ET.SubElement(joint, "limit", effort=repr(wheel.max_torque), velocity=repr(wheel.max_speed))
    ET.SubElement(joint, "wheel")
    return link, joint
