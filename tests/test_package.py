"""What holds for the package as a whole: its rooms, its names, what it loads."""

from __future__ import annotations

import ast
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import ssm_decouple as ssm

SOURCE = Path(ssm.__file__).parent
ROOMS = ["model", "momentum", "control", "simulation", "studies", "viewing"]
# The two doors that open from the robot into rooms that come after it.
DOORS = {("model/robot.py", "momentum")}


def imports(path: Path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("ssm_decouple."):
            yield node.module.split(".")[1]


@pytest.mark.parametrize("path", sorted(SOURCE.rglob("*.py")), ids=lambda path: str(path.relative_to(SOURCE)))
def test_imports_run_from_right_to_left(path):
    parts = path.relative_to(SOURCE)
    room = parts.parts[0]
    if room not in ROOMS:
        return
    for used in imports(path):
        if used in ROOMS and (str(parts), used) not in DOORS:
            assert ROOMS.index(used) <= ROOMS.index(room), f"{parts} imports from {used}"


def test_compiled_functions_stand_in_one_file():
    compiled = [path.name for path in SOURCE.rglob("*.py") if "numba" in path.read_text().split('"""', 2)[-1]]
    assert [name for name in compiled if name != "motion.py"] == ["kernel.py"]  # motion.py records numba's version


def test_every_public_name_is_there_and_described():
    for name in ssm.__all__:
        value = getattr(ssm, name)
        assert name == "__version__" or inspect.getdoc(value), name
    assert set(ssm.__all__) <= set(dir(ssm))
    with pytest.raises(AttributeError, match="no attribute 'Protektion'"):
        ssm.Protektion  # noqa: B018


def test_importing_loads_nothing_heavy():
    heavy = ("numpy", "pinocchio", "numba", "xarray", "matplotlib")
    code = f"import sys, ssm_decouple; print([name for name in {heavy} if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"


def test_a_law_needs_no_plotting_and_no_files():
    code = (
        "import sys, ssm_decouple as ssm; robot = ssm.load_robot('ets_vii');"
        "ssm.SelectiveLaw(robot, ssm.Protection('yaw'))(robot.configuration(), [1, 0, 2]);"
        "print([m for m in ('matplotlib', 'xarray', 'typer', 'h5netcdf', 'rich') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"


def test_the_error_family():
    for error in (ssm.ModelError, ssm.InputError, ssm.FileError):
        assert issubclass(error, ssm.DecoupleError)
    assert issubclass(ssm.InputError, ValueError)
    assert issubclass(ssm.FileError, OSError)
