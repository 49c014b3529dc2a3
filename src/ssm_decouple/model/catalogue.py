"""The robots that come with the package, and loading any other by its path."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

from ssm_decouple.errors import ModelError
from ssm_decouple.model.robot import Robot
from ssm_decouple.model.urdf import read_urdf

_PACKAGE = Path(__file__).parents[1]
# Installed, the models lie inside the package; in a source tree they lie at its top.
_FOLDERS = (_PACKAGE / "models", _PACKAGE.parents[1] / "models")


def models() -> dict[str, Path]:
    """Return the robots that come with the package: name to URDF path."""
    folder = next((folder for folder in _FOLDERS if folder.is_dir()), None)
    if folder is None:
        raise ModelError(f"the package's models are missing, expected in '{_FOLDERS[0]}': install ssm-decouple again")
    return {path.stem: path for path in sorted(folder.glob("*.urdf"))}


def find_urdf(source: str | Path) -> Path:
    """Return the URDF path that a catalogue name or a path stands for.

    Raises:
        ModelError: it is neither.
    """
    catalogue = models()
    if str(source) in catalogue:
        return catalogue[str(source)]
    path = Path(source).expanduser()
    if path.is_file():
        return path
    kind = "is a folder, not a URDF file" if path.is_dir() else "is neither a file nor a robot of the catalogue"
    raise ModelError(f"'{source}' {kind} ({', '.join(catalogue)})")


def load_robot(source: str | Path, end_effector: str | None = None) -> Robot:
    """Load a robot: a catalogue name such as "ets_vii", or a path to any URDF.

    Args:
        source: Catalogue name or path. The URDF's root link becomes the free-floating base.
        end_effector: The link or frame that the tasks move. None takes the link called "end_effector", else the only
            tip of the arm.

    Returns:
        The robot.

    Raises:
        ModelError: no such robot, not a URDF, impossible to simulate, or no such end-effector.
    """
    path = find_urdf(source)
    return Robot(read_urdf(path), name=path.stem, end_effector=end_effector)


def example_robot(path: str) -> Path:
    """Return the path of a robot in the `example-robot-data` package (extra `[robots]`).

    Args:
        path: Path under its `robots` folder, for example "ur_description/urdf/ur5_robot.urdf".

    Raises:
        ModelError: the package is not installed, or has no such file; the URDFs near it are named.
    """
    try:
        distribution = metadata.distribution("example-robot-data")
    except metadata.PackageNotFoundError:
        raise ModelError("example-robot-data is not installed: pip install 'ssm-decouple[robots]'") from None
    robots = Path(str(distribution.locate_file("cmeel.prefix/share/example-robot-data/robots")))
    found = robots / path
    if not found.is_file():
        first = Path(path).parts[0] if Path(path).parts else ""
        near = sorted((robots / first).rglob("*.urdf")) or sorted(robots.rglob("*.urdf"))
        names = ", ".join(str(urdf.relative_to(robots)) for urdf in near[:12])
        raise ModelError(f"example-robot-data has no '{path}'; it has {names}{', ..' if near[12:] else ''}")
    return found
