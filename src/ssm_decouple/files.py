"""Writing result files whole or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ssm_decouple.errors import FileError


def writable_folder(folder: str | Path) -> Path:
    """Make `folder` if needed and return it.

    Raises:
        FileError: it cannot be made or written.
    """
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise FileError(
            f"cannot write to the folder '{path}': {error.strerror or error}; choose another with --output"
        ) from error
    return path


def is_file(path: Path) -> bool:
    """Say whether a path leads to a file; one that is too long to be a path does not."""
    try:
        return path.is_file()
    except OSError:
        return False


@contextmanager
def written_whole(path: str | Path) -> Iterator[Path]:
    """Give a temporary name beside `path`; what was written there takes its place only if all went well.

    Raises:
        FileError: the place cannot be written.
    """
    final = Path(path)
    if not final.name:
        raise FileError(f"cannot write '{final}': it names no file")
    temporary = final.with_name(f".{final.stem}.{os.getpid()}.part{final.suffix}")
    try:
        yield temporary
        os.replace(temporary, final)
    except OSError as error:
        raise FileError(f"cannot write '{final}': {error.strerror or error}") from error
    finally:
        with suppress(OSError):  # a name too long for a file, told above
            temporary.unlink(missing_ok=True)
