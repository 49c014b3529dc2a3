"""In which units joints and angles are drawn."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
import xarray as xr
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Of joints that turn, that slide and of wheels: what is drawn, its unit, and how many of these one of SI is.
JOINT_UNITS = {
    "turning": ("joint angle", "deg", float(np.rad2deg(1.0))),
    "sliding": ("slider position", "mm", 1e3),
    "wheel": ("wheel angle", "rad", 1.0),
}


def joint_kinds(motion: xr.Dataset) -> list[str]:
    """Return of each joint of a motion whether it is "turning", "sliding" or a "wheel"."""
    root = ET.fromstring(str(motion.robot_urdf.values))
    sliding = {joint.get("name", "") for joint in root.findall("joint") if joint.get("type") == "prismatic"}
    wheels = set(map(str, motion.wheel.values)) if "wheel" in motion.coords else set()
    return [
        "sliding" if name in sliding else "wheel" if name in wheels else "turning"
        for name in map(str, motion.joint.values)
    ]


def unwrapped(angles: Floats) -> Floats:
    """Return angles (m, ..), rad, without jumps of a turn from one to the next; what is no number stays so."""
    found = angles.copy()
    there = np.isfinite(angles).reshape(len(angles), -1).all(axis=1)
    found[there] = np.unwrap(angles[there], axis=0)
    return found
