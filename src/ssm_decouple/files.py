"""Writing result files whole or not at all, and on the disk before anything says that they are."""

from __future__ import annotations

import filecmp
import logging
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ssm_decouple.errors import FileError

LOG = logging.getLogger(__name__)  # at level INFO, each file that something else is written over
PARTIAL = ".partial"  # what the name of a file ends in until it is whole


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
    except (OSError, ValueError) as error:
        raise FileError(
            f"cannot write to the folder '{path}': {_reason(error)}; choose another with --output"
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

    It is on the disk before it takes that place. Where that was another's, the logger of this module says so.

    Raises:
        FileError: the place cannot be written, or is no place for a file.
    """
    final, temporary = Path(path), None
    if not final.name:
        raise FileError(f"cannot write '{final}': it names no file")
    try:
        if final.exists():
            _refuse_unfit(final)
        # A name that fits wherever the final one does, with its suffix, by which writers know the format.
        temporary = final.with_name(f".{final.stem[:64]}.{os.getpid()}.part{final.suffix}")
        yield temporary
        synced(temporary)
        changed = final.exists() and not filecmp.cmp(final, temporary, shallow=False)
        os.replace(temporary, final)
        synced(final.parent)
    except (OSError, ValueError) as error:
        if isinstance(error, FileError) or (isinstance(error, ValueError) and temporary is not None):
            raise
        raise FileError(f"cannot write '{final}': {_reason(error)}") from error
    finally:
        if temporary is not None:
            with suppress(OSError):  # a name too long for a file, told above
                temporary.unlink(missing_ok=True)
