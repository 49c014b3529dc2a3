"""The cache of compiled code: a change in any file that code comes from must reach it, and nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import ssm_decouple
from ssm_decouple.compiled import SourceCache, compiled, source_stamp

CALLEE = """
from ssm_decouple.compiled import compiled

FACTOR = {factor}

@compiled
def times(x):
    return FACTOR * x + {offset}
"""
CALLER = """
from ssm_decouple.compiled import compiled
from ssm_decouple.probe import callee
from ssm_decouple.probe.callee import times

@compiled
def twice(x):
    return times(times(x)) + callee.FACTOR
"""
RUN = (
    "from ssm_decouple.probe.caller import twice; value = twice(1.0); hits = sum(twice.stats.cache_hits.values());"
    "print(value, hits)"
)


@pytest.fixture
def package(tmp_path: Path):
    """Return a folder with a small copy of the package: its compiling, and two files of which one calls the other."""
    source, copy = Path(ssm_decouple.__file__).parent, tmp_path / "ssm_decouple"
    (copy / "probe").mkdir(parents=True)
    (copy / "__init__.py").write_text("")
    (copy / "probe" / "__init__.py").write_text("")
    for name in ("compiled.py", "errors.py"):
        (copy / name).write_bytes((source / name).read_bytes())
    (copy / "probe" / "callee.py").write_text(CALLEE.format(factor=3.0, offset=0.5))
    (copy / "probe" / "caller.py").write_text(CALLER)
    return copy


def run(package: Path, code: str = RUN) -> subprocess.CompletedProcess[str]:
    kept = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA")}
    return subprocess.run(
        [sys.executable, "-W", "always", "-c", code],
        capture_output=True,
        text=True,
        env={**kept, "PYTHONPATH": str(package.parent), "PYTHONDONTWRITEBYTECODE": "1"},  # Python goes by the time too
    )


def changed(path: Path, old: str, new: str) -> None:
    """Change a file and leave its size and time as they were, which is all that Numba would look at."""
    before = path.stat()
    text = path.read_text()
    assert old in text
    assert len(old) == len(new)
    path.write_text(text.replace(old, new))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def test_a_change_in_another_file_reaches_compiled_code(package):
    def result() -> list[float]:
        done = run(package)
        assert done.returncode == 0, done.stderr
        return [float(word) for word in done.stdout.split()]

    assert result() == [3.0 * 3.5 + 0.5 + 3.0, 0]
    assert result() == [3.0 * 3.5 + 0.5 + 3.0, 1]  # from disk
    changed(package / "probe" / "callee.py", "+ 0.5", "+ 0.7")  # what the called function does
    assert result() == [3.0 * 3.7 + 0.7 + 3.0, 0]
    assert result() == [3.0 * 3.7 + 0.7 + 3.0, 1]
    changed(package / "probe" / "callee.py", "FACTOR = 3.0", "FACTOR = 4.0")  # a constant of another file
    assert result() == [4.0 * 4.7 + 0.7 + 4.0, 0]
    changed(package / "errors.py", "difflib", "difflib")  # no compiled code comes from here
    assert result()[1] == 1


def test_a_file_that_only_has_another_time_is_not_compiled_again(package):
    assert run(package).returncode == 0
    for path in package.rglob("*.py"):
        os.utime(path, (1e9, 1e9))
    assert run(package).stdout.split()[1] == "1"


def test_a_folder_that_cannot_be_written_is_told_with_the_mend(package):
    nowhere = (
        "import numba.core.caching as caching\n"
        "def refuse(self): raise OSError('read-only')\n"
        "caching._CacheLocator.ensure_cache_path = refuse\n"
        "for locator in caching.CacheImpl._locator_classes: locator.ensure_cache_path = refuse\n"
    )
    done = run(package, nowhere + RUN)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["14.0", "0"]
    assert done.stderr.count("DecoupleWarning") == 1  # once, not for each function
    assert "NUMBA_CACHE_DIR" in done.stderr


def test_a_full_disk_costs_the_cache_and_not_the_result(package):
    full = (
        "import errno, numba.core.caching as caching\n"
        "def refuse(self, key, data): raise OSError(errno.ENOSPC, 'No space left on device')\n"
        "caching.IndexDataCacheFile.save = refuse\n"
    )
    done = run(package, full + RUN)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["14.0", "0"]
    assert "No space left on device" in done.stderr
    assert "NUMBA_CACHE_DIR" in done.stderr


def test_numba_still_has_what_the_stamp_needs():
    """The stamp stands in a private attribute: a Numba without it would go by the file's time alone."""

    @compiled
    def function(x: float) -> float:
        return x

    assert isinstance(function._cache, SourceCache)
    assert function._cache._cache_file._source_stamp == source_stamp(__name__)
    assert source_stamp("ssm_decouple.control.kernel") != source_stamp("ssm_decouple.batch.lanes")
