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
ROOMS = ["model", "momentum", "control", "simulation", "batch", "studies", "viewing"]
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


def is_compiled(function: ast.AST) -> bool:
    return isinstance(function, ast.FunctionDef) and any(
        name.id in ("compiled", "compiled_for", "inlined", "unlocked")
        for decorator in function.decorator_list
        for name in ast.walk(decorator)
        if isinstance(name, ast.Name)
    )


def test_what_compiled_functions_use_is_seen_by_the_stamp_of_their_cache():
    """The stamp follows the imports at the head of a file; what is called is compiled, in whatever file it stands."""
    trees = {path: ast.parse(path.read_text()) for path in SOURCE.rglob("*.py")}
    compiled = {path: {f.name for f in tree.body if is_compiled(f)} for path, tree in trees.items()}
    assert sum(map(bool, compiled.values())) >= 5
    with_numba = {path.name for path in SOURCE.rglob("*.py") if "numba" in path.read_text().split('"""', 2)[-1]}
    assert with_numba <= {"compiled.py", "motion.py"}  # motion.py records its version, the others take their decorators
    for path in (path for path in trees if compiled[path]):
        head, everywhere = {}, {}
        for part in ast.walk(trees[path]):
            if isinstance(part, ast.ImportFrom):
                names = {alias.asname or alias.name: f"{part.module}.{alias.name}" for alias in part.names}
                everywhere |= names
                if part.col_offset == 0 and part in trees[path].body:
                    head |= names
        own = {part.name for part in trees[path].body if isinstance(part, ast.FunctionDef)}
        for function in (part for part in trees[path].body if is_compiled(part)):
            used = {node.id for part in function.body for node in ast.walk(part) if isinstance(node, ast.Name)}
            assert used & everywhere.keys() <= head.keys(), f"{path.name}: {function.name}"
            assert used & own <= compiled[path], f"{path.name}: {function.name} uses a function that is not compiled"
            for name in used & head.keys():
                module, _, what = head[name].rpartition(".")
                source = SOURCE.joinpath(*module.split(".")[1:]).with_suffix(".py")
                if source in trees and what in {f.name for f in trees[source].body if isinstance(f, ast.FunctionDef)}:
                    assert what in compiled[source], f"{path.name}: {function.name} calls {what}, which is not compiled"


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
