"""A robot that is not quite as its URDF says."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ssm_decouple.errors import InputError, as_floats, as_kind, as_seed, shown
from ssm_decouple.model.robot import Robot, checked_robot, mimics_told
from ssm_decouple.model.urdf import parse_urdf, root_link

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Tolerances:
    """How far the real robot may be from the model; each value is drawn uniformly from within.

    Attributes:
        mass: Of each link, relative.
        inertia: Of each link about its centre of mass, relative, beside the mass.
        centre_of_mass: Of each link, m, along each of its axes.
        mount: Of what stands on the root link, m, along each axis of the base.
        length: Of every other link, m, along each of its axes: how far what it holds, the next joint or the
            end-effector, is from where the model has it. An arm that has been calibrated has a small one.
    """

    mass: float = 0.0
    inertia: float = 0.0
    centre_of_mass: float = 0.0
    mount: float = 0.0
    length: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what is no tolerance.

        Raises:
            InputError: a negative number, or a relative one of 1 or more.
        """
        for name in ("mass", "inertia", "centre_of_mass", "mount", "length"):
            largest = 1.0 if name in ("mass", "inertia") else np.inf
            value = as_floats(f"tolerance of {name}", getattr(self, name))
            if value.shape != () or not (np.isfinite(value) and 0 <= value < largest):
                raise InputError(
                    f"tolerance of {name} is {shown(getattr(self, name))}; it must be at least 0 and below {largest:g}"
                )
            object.__setattr__(self, name, float(value))


def perturbed(robot: Robot, tolerances: Tolerances, seed: int | np.random.Generator) -> Robot:
    """Return a robot whose masses, inertias, centres of mass, mounts and lengths are off by random amounts.

    Each inertia stays that of a solid body: along each of its own axes the body is stretched a little.

    Args:
        robot: The robot as it should be; its appendages stay as they are.
        tolerances: How far off it may be.
        seed: The same seed gives the same robot.

    Raises:
        ModelError: the result cannot be simulated.
        InputError: no tolerances, or a seed that is no whole number from 0.
    """
    checked_robot(robot)
    as_kind("tolerances", tolerances, Tolerances, "give a Tolerances, such as Tolerances(mass=0.05)")
    rng = seed if isinstance(seed, np.random.Generator) else np.random.default_rng(as_seed("seed", seed))
    root = parse_urdf(robot.urdf, robot.name)
    for inertial in root.findall("link/inertial"):
        _disturb_body(inertial, tolerances, rng)
    base = root_link(root)
    # Mounts first: a seed means the same masses and mounts whatever the tolerance of the lengths is.
    for on_base, tolerance in ((True, tolerances.mount), (False, tolerances.length)):
        for joint in root.findall("joint"):
            parent = joint.find("parent")
            if parent is not None and (parent.get("link") == base) is on_base:
                _shift(joint, tolerance * rng.uniform(-1, 1, 3))
    with mimics_told():
        return Robot(
            ET.tostring(root, encoding="unicode"),
            name=f"{robot.name} (perturbed)",
            end_effector=robot.end_effector,
            appendages=robot.appendages,
        )


def _disturb_body(inertial: ET.Element, tolerances: Tolerances, rng: np.random.Generator) -> None:
    mass, inertia = inertial.find("mass"), inertial.find("inertia")
    heavier, stretch = 1 + tolerances.mass * rng.uniform(-1, 1), 1 + tolerances.inertia * rng.uniform(-1, 1, 3)
    _shift(inertial, tolerances.centre_of_mass * rng.uniform(-1, 1, 3))
    if mass is None or inertia is None:
        return
    mass.set("value", repr(float(mass.get("value", "0")) * heavier))
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    I = np.zeros((3, 3))  # noqa: E741
    I[np.triu_indices(3)] = [float(inertia.get(name, "0")) for name in names]
    I = I + np.triu(I, 1).T  # noqa: E741
    # The second moments of the mass, whose principal values a stretch of the body multiplies.
    moments, axes = np.linalg.eigh(0.5 * np.trace(I) * np.eye(3) - I)
    stretched = (axes * (moments * stretch * heavier)) @ axes.T
    new = np.trace(stretched) * np.eye(3) - stretched
    for name, value in zip(names, new[np.triu_indices(3)], strict=True):
        inertia.set(name, repr(float(value)))


def _shift(element: ET.Element, by: Floats) -> None:
    origin = element.find("origin")
    if origin is None:
        origin = ET.SubElement(element, "origin")
    before = np.array([float(word) for word in origin.get("xyz", "0 0 0").split()])
    origin.set("xyz", " ".join(repr(float(x)) for x in before + by))
