"""The robots that come with the package, and loading any other by its path."""

from __future__ import annotations

import dataclasses
import math
import tomllib
import warnings
from contextlib import suppress
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from ssm_decouple.errors import DecoupleWarning, InputError, ModelError, as_path, as_text, shown, unknown
from ssm_decouple.files import is_file
from ssm_decouple.model.appendage import Appendage
from ssm_decouple.model.formats import read_robot
from ssm_decouple.model.massless import massless_root
from ssm_decouple.model.robot import Robot

_PACKAGE = Path(__file__).parents[1]
# Installed, the models lie inside the package; in a source tree they lie at its top.
_FOLDERS = (_PACKAGE / "models", _PACKAGE.parents[1] / "models")


# What a TOML robot may hold; an appendage has the attributes of `Appendage`, its turn in degrees.
_KEYS = ("urdf", "end_effector", "appendage")
_APPENDAGE_KEYS = {
    ("turn_deg" if field.name == "turn" else field.name): field.default is dataclasses.MISSING
    for field in dataclasses.fields(Appendage)
}


@dataclass(frozen=True)
class Description:
    """What a catalogue name or a path stands for, before anything is built.

    Attributes:
        name: Name of the robot.
        urdf: Path of its URDF or MJCF.
        end_effector: Frame that the tasks move; None as in `load_robot`.
        appendages: What a TOML robot adds to the URDF.
    """

    name: str
    urdf: Path
    end_effector: str | None = None
    appendages: tuple[Appendage, ...] = ()


def models() -> dict[str, Path]:
    """Return the robots that come with the package: name to the path of a URDF, or of a TOML file that adds to one."""
    folder = next((folder for folder in _FOLDERS if folder.is_dir()), None)
    if folder is None:
        raise ModelError(f"the package's models are missing, expected in '{_FOLDERS[0]}': install ssm-decouple again")
    return {path.stem: path for path in sorted(folder.iterdir()) if path.suffix in (".urdf", ".toml")}


def find_robot(source: str | Path) -> Path:
    """Return the path, of a URDF or a TOML file, that a catalogue name or a path stands for.

    Raises:
        ModelError: it is neither.
        InputError: it is no text and no path.
    """
    catalogue = models()
    if isinstance(source, str) and source.lstrip("\ufeff \t\r\n").startswith("<"):
        raise InputError(f"robot is {shown(source)}; that is the text of a URDF: give Robot(text, name='..') that")
    path = as_path("robot", source, f"give a path, or a name of the catalogue ({', '.join(catalogue)})")
    if str(source) in catalogue:
        return catalogue[str(source)]
    if is_file(path):
        return path
    kind = "is neither a file nor a robot of the catalogue"
    with suppress(OSError):
        kind = "is a folder, not a URDF file" if path.is_dir() else kind
    raise ModelError(f"'{source}' {kind} ({', '.join(catalogue)})")


def find_urdf(source: str | Path) -> Path:
    """Return the URDF path that a catalogue name or a path stands for; of a TOML file, that of the URDF it names.

    Raises:
        ModelError: it is neither, or a TOML file that is no robot.
    """
    return describe(source).urdf


def load_robot(source: str | Path, end_effector: str | None = None) -> Robot:
    """Load a robot: a catalogue name such as "ets_vii", or a path to a URDF, an MJCF, or a TOML file that adds to one.

    Args:
        source: Catalogue name or path. The URDF's root link becomes the free-floating base. An MJCF file, by its root
            element, is rewritten as a URDF. A TOML file, by its suffix, names a URDF or MJCF and the flexible
            appendages on its root link: see `Appendage`.
        end_effector: The link or frame that the tasks move. None takes the TOML file's own, else the link called
            "end_effector", else the only tip of the arm.

    Returns:
        The robot.

    Raises:
        ModelError: no such robot, a file of another format (the message says how to convert it), one that is impossible
            to simulate, or no such end-effector; a TOML file with an unknown key (the nearest known one is named), a
            missing one, or an appendage that makes no sense.
    """
    if end_effector is not None:
        as_text("end_effector", end_effector, "it is the name of a link or frame, or None")
    found = describe(source)
    text, tool = read_robot(found.urdf), end_effector or found.end_effector
    robot = Robot(text, name=found.name, end_effector=tool, appendages=found.appendages)
    for finding in massless_root(robot.model):  # an arm that compose puts on a bus is no mistake, one that floats is
        warnings.warn(f"robot '{robot.name}': {finding}", DecoupleWarning, stacklevel=2)
    return robot


def describe(source: str | Path) -> Description:
    """Return what a catalogue name or a path stands for: a URDF, and what a TOML file adds to it.

    Raises:
        ModelError: it is neither, or a TOML file that is no robot.
    """
    path = find_robot(source)
    if path.suffix.lower() != ".toml":
        return Description(path.stem, path)
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:  # not UTF-8, a number of thousands of digits, tables without end
        raise ModelError(f"'{path}' is not TOML: {error}") from error
    except OSError as error:
        raise ModelError(f"cannot read '{path}': {error.strerror or error}") from error
    try:
        return _description(content, path)
    except (InputError, ModelError) as error:
        raise ModelError(f"robot '{path}': {error}") from error


def _description(content: dict[str, Any], path: Path) -> Description:
    for key in content:
        if key not in _KEYS:
            raise ModelError(unknown("key", key, _KEYS))
    for key in ("urdf", "end_effector"):
        if key in content and not isinstance(content[key], str):
            raise ModelError(f"{key} is {content[key]!r}; it must be a text")
    if "urdf" not in content:
        raise ModelError("urdf is missing: name the URDF file, relative to this one, or a robot of the catalogue")
    wings = content.get("appendage", [])
    if not isinstance(wings, list) or not all(isinstance(wing, dict) for wing in wings):
        raise ModelError("'appendage' must be a list of tables: write [[appendage]] on a line of its own")
    named = content["urdf"]
    urdf = find_robot(named if named in models() else path.parent / Path(named).expanduser())
    if urdf.suffix.lower() == ".toml":
        raise ModelError(f"its urdf '{named}' is a TOML file too; name the URDF itself")
    appendages = tuple(_appendage(wing, i + 1) for i, wing in enumerate(wings))
    return Description(path.stem, urdf, content.get("end_effector"), appendages)


def _appendage(wing: dict[str, Any], count: int) -> Appendage:
    place = f"[[appendage]] {wing.get('name', count)}: "
    for key in wing:
        if key not in _APPENDAGE_KEYS:
            raise ModelError(place + unknown("key", key, list(_APPENDAGE_KEYS)))
    missing = [key for key, needed in _APPENDAGE_KEYS.items() if needed and key not in wing]
    if missing:
        raise ModelError(f"{place}{missing[0]} is missing")
    values = {key: value for key, value in wing.items() if key != "turn_deg"}
    turn = wing.get("turn_deg", 0.0)
    if not isinstance(turn, int | float) or isinstance(turn, bool) or not abs(turn) <= 360:
        raise ModelError(f"{place}turn_deg is {turn!r}; it must be a number, of degrees within one turn")
    return Appendage(**values, turn=math.radians(turn))


def example_robot(path: str) -> Path:
    """Return the path of a robot in the `example-robot-data` package (extra `[robots]`).

    Args:
        path: Path under its `robots` folder, for example "ur_description/urdf/ur5_robot.urdf".

    Raises:
        ModelError: the package is not installed, or has no such file; the URDFs near it are named.
    """
    as_path("path", path)
    try:
        distribution = metadata.distribution("example-robot-data")
    except metadata.PackageNotFoundError:
        raise ModelError("example-robot-data is not installed: pip install 'ssm-decouple[robots]'") from None
    robots = Path(str(distribution.locate_file("cmeel.prefix/share/example-robot-data/robots")))
    found = robots / path
    if not (is_file(found) and found.is_relative_to(robots)):
        first = Path(path).parts[0] if Path(path).parts else ""
        near = sorted(robots.rglob("*.urdf"))
        near = [urdf for urdf in near if urdf.relative_to(robots).parts[0] == first] or near
        names = ", ".join(str(urdf.relative_to(robots)) for urdf in near[:12])
        raise ModelError(f"example-robot-data has no '{path}'; it has {names}{', ..' if near[12:] else ''}")
    return found
