"""A rigid body that the arm holds, written into the robot's URDF."""

from __future__ import annotations

import copy
import xml.etree.ElementTree as ET

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ssm_decouple.errors import InputError, ModelError, as_floats, as_positive, shown
from ssm_decouple.model.urdf import Body, write_body

Floats = NDArray[np.float64]

_MOST = 1e100  # kg m2: the squares of larger ones leave the range of numbers
_THIN = 1e-9  # a flat body is at the edge of the triangle inequality: rounding must not push it over


def payload_body(mass: float, centre_of_mass: ArrayLike, inertia: ArrayLike) -> Body:
    """Return a payload as a body, checked.

    Args:
        mass: kg.
        centre_of_mass: (3,), m.
        inertia: About the centre of mass (3, 3), kg m2.

    Raises:
        InputError: a mass that is not positive, or numbers of the wrong shape.
        ModelError: an inertia that no body has.
    """
    needs = "it must be above zero, in kg: with nothing in its hand leave it out"
    weight, centre = as_positive("payload mass", mass, needs), as_floats("payload centre_of_mass", centre_of_mass)
    if centre.shape != (3,) or not np.all(np.isfinite(centre)):
        raise InputError(
            f"payload centre_of_mass is {shown(centre.tolist())}; it needs 3 finite numbers, m, the frame's axes"
        )
    return Body(weight, centre, possible_inertia("payload inertia", inertia))


def possible_inertia(name: str, inertia: ArrayLike) -> Floats:
    """Return the inertia (3, 3) of a rigid body about its centre of mass, kg m2, made exactly symmetric.

    Raises:
        InputError: not a symmetric (3, 3) of finite numbers; the message calls it `name`.
        ModelError: no body has it: a principal moment is not positive, or larger than the sum of the others.
    """
    matrix = as_floats(name, inertia)
    if matrix.shape != (3, 3) or not np.all(np.abs(matrix) < _MOST):
        raise InputError(
            f"{name} is {shown(matrix.tolist())}; it needs (3, 3) finite numbers, kg m2, about the centre of mass"
        )
    if np.abs(matrix - matrix.T).max() > _THIN * np.abs(matrix).max():
        raise InputError(f"{name} is not symmetric: {matrix.tolist()}")
    matrix = 0.5 * (matrix + matrix.T)
    small, middle, large = np.linalg.eigvalsh(matrix)
    listed = f"{name} has the principal moments {small:.6g}, {middle:.6g}, {large:.6g} kg m2"
    if not small > 0:
        raise ModelError(f"{listed}; each must be above zero")
    if small + middle < large * (1 - _THIN):
        raise ModelError(f"{listed}, which no body has: the largest must not be above the sum of the others")
    return matrix


def loaded_urdf(root: ET.Element, body: Body, frame: str) -> tuple[ET.Element, str]:
    """Return a URDF with the body as a link on a fixed joint, and the name of that link.

    Args:
        root: The robot.
        body: In the frame's axes.
        frame: A link, or a joint, whose frame is its child link's.

    Raises:
        InputError: no such link or joint.
    """
    whole = copy.deepcopy(root)
    links = [link.get("name", "") for link in whole.findall("link")]
    children = {joint.get("name"): joint.find("child") for joint in whole.findall("joint")}
    child = children.get(frame)
    carrier = frame if frame in links or child is None else child.get("link", "")
    if carrier not in links:
        raise InputError(f"the robot has no frame '{frame}' to hold a payload; its links are {', '.join(links)}")
    name = _free_name({*links, *map(str, children)})
    link = ET.SubElement(whole, "link", name=name)
    write_body(link, body)
    joint = ET.SubElement(whole, "joint", name=f"{name}_grasp", type="fixed")
    ET.SubElement(joint, "parent", link=carrier)
    ET.SubElement(joint, "child", link=name)
    ET.indent(whole)
    return whole, name


def _free_name(taken: set[str]) -> str:
    name, number = "payload", 1
    while name in taken or f"{name}_grasp" in taken:
        number += 1
        name = f"payload_{number}"
    return name
