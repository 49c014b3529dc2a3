"""Reading a robot's file as URDF, whatever format it is in; of those that cannot be read, how they are converted."""

from __future__ import annotations

import re
from pathlib import Path

from ssm_decouple.errors import ModelError
from ssm_decouple.model.mjcf import urdf_of_mjcf
from ssm_decouple.model.urdf import read_urdf

_SDF = (
    "is SDF, which is not read: convert it to URDF with the Python package rod (pip install rod, rod.urdf.exporter."
    "UrdfExporter) or with sdformat_urdf of ROS 2; `gz sdf -p` goes the other way. Then check masses and frames with "
    "`ssm-decouple check`"
)
# By the root element of an XML file.
_ROOTS = {"sdf": _SDF, "gazebo": _SDF}
# By the end of a name: files that are no URDF, or not yet.
_ENDINGS = {
    ".sdf": _SDF,
    ".world": _SDF,
    ".xacro": "has xacro macros: expand it first with `xacro FILE > robot.urdf`",
    ".mjb": "is a compiled MuJoCo model, which is not read: load the MJCF (.xml) that it was compiled from",
    **dict.fromkeys(
        (".usd", ".usda", ".usdc", ".usdz"),
        "is USD, which is not read: load the URDF that it was made from, or export one in Isaac Sim with the extension "
        "isaacsim.asset.exporter.urdf",
    ),
    **dict.fromkeys(
        (".mat", ".m", ".slx", ".mdl"),
        'is MATLAB\'s, which is not read: write a URDF there with exportrobot(robot, OutputFileName="robot.urdf") of '
        "a rigidBodyTree",
    ),
    **dict.fromkeys(
        (".step", ".stp", ".stl", ".obj", ".dae"),
        "is a shape without joints and masses, which is no robot: write a URDF, with the shape as a <mesh> in it",
    ),
}


def read_robot(path: str | Path) -> str:
    """Return the URDF text that a robot's file holds or stands for; of MJCF that of the same robot.

    Raises:
        ModelError: no such file, not text, or another format; the message says how to convert it.
    """
    path = Path(path)
    refused = _ENDINGS.get(path.suffix.lower())
    if refused is not None:
        raise ModelError(f"'{path}' {refused}")
    text = read_urdf(path)
    root = _root_element(text)
    if root in _ROOTS:
        raise ModelError(f"'{path}' {_ROOTS[root]}")
    return urdf_of_mjcf(text, str(path), path.parent) if root == "mujoco" else text


def _root_element(text: str) -> str | None:
    """Return the name of the first element of a text, or None; whether it is XML at all is the parser's to say."""
    found = re.match(
        r"\ufeff?(?:\s|<\?.*?\?>|<!--.*?-->|<!DOCTYPE[^>\[]*(?:\[.*?\])?\s*>)*<([\w.:-]+)", text, re.DOTALL
    )
    return None if found is None else found[1]
