"""Joints that do not move any more, written into the robot's URDF as fixed joints."""

from __future__ import annotations

import copy
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence

import numpy as np
import pinocchio as pin

from ssm_decouple.errors import InputError, as_number, shown, unknown
from ssm_decouple.model.urdf import floats, triple

_OF_A_FIXED_JOINT = ("parent", "child", "origin")


def locked_urdf(root: ET.Element, positions: Mapping[str, float], known: Sequence[str]) -> ET.Element:
    """Return a URDF in which joints are fixed where they stand.

    Args:
        root: The robot.
        positions: Joint name to position, rad or m.
        known: Names of the joints that move.

    Raises:
        InputError: an unknown joint (the nearest known one is named), or a position that is no finite number.
    """
    if not isinstance(positions, Mapping):
        raise InputError(f"joints to lock are {shown(positions)}; give a mapping such as {{'joint_2': 0.5}}, rad or m")
    whole = copy.deepcopy(root)
    joints = {joint.get("name"): joint for joint in whole.findall("joint")}
    for name, position in positions.items():
        if name not in known:
            raise InputError(unknown("joint", str(name), known))
        needs = "it needs one finite number, rad or m"
        _lock(joints[name], as_number(f"position of joint '{name}'", position, needs))
    ET.indent(whole)
    return whole


def _lock(joint: ET.Element, position: float) -> None:
    """Fold a joint's motion into its origin."""
    axis, origin = joint.find("axis"), joint.find("origin")
    direction = floats(None if axis is None else axis.get("xyz"), (1.0, 0.0, 0.0))
    direction /= np.linalg.norm(direction)
    place = {} if origin is None else origin.attrib
    xyz, rpy = (floats(place.get(key), (0.0, 0.0, 0.0)) for key in ("xyz", "rpy"))
    turned = pin.rpy.rpyToMatrix(*rpy)
    if joint.get("type") == "prismatic":
        xyz = xyz + position * turned @ direction
    else:
        turned = turned @ pin.AngleAxis(position, direction).matrix()
    for element in list(joint):
        if element.tag not in _OF_A_FIXED_JOINT:
            joint.remove(element)
    joint.set("type", "fixed")
    if origin is None:
        origin = ET.SubElement(joint, "origin")
    origin.set("xyz", triple(xyz))
    origin.set("rpy", triple(pin.rpy.matrixToRpy(turned)))
