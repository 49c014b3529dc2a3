"""Writing result files whole or not at all, and on the disk before anything says that they are."""

from __future__ import annotations

import errno
import filecmp
import logging
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

from ssm_decouple.errors import FileError

LOG = logging.getLogger(__name__)  # at level INFO, each file that something else is written over
_AT_ONCE = 16  # files that are forced to the disk together
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
    if "\0" in str(final):
        raise FileError(f"cannot write {str(final)!r}: no file can be called so")
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
    if changed:
        LOG.info("%s", final)


def write_all_whole(files: Mapping[Path, bytes]) -> None:
    """Write files, each whole or not at all, all of them on the disk when this returns.

    What a kill leaves of them has `PARTIAL` behind its name.

    Args:
        files: Contents by path; the folders are made.

    Raises:
        OSError: the place cannot be written.
    """
    partial = {path: path.with_name(path.name + PARTIAL) for path in files}
    try:
        for path, content in files.items():
            _make_folder(path.parent)
            partial[path].write_bytes(content)
        _all_synced(partial.values())
        for path, place in partial.items():
            os.replace(place, path)
    except BaseException:
        for place in partial.values():
            place.unlink(missing_ok=True)
        raise
    _all_synced({path.parent for path in files})


def _all_synced(paths: Iterable[Path]) -> None:
    """Force files or folders to the disk, at once, since a disk takes hardly longer for many than for one."""
    with ThreadPoolExecutor(_AT_ONCE) as threads:
        list(threads.map(synced, paths))


def synced(path: Path) -> None:
    """Force a file or a folder to the disk.

    Raises:
        OSError: that fails.
    """
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # a file system that cannot, such as some over a network
            raise
    finally:
        os.close(handle)


def _make_folder(folder: Path) -> None:
    """Make a folder and those above it, on the disk too."""
    if not folder.is_dir():
        _make_folder(folder.parent)
        folder.mkdir()
        synced(folder.parent)


def _refuse_unfit(place: Path) -> None:
    """Refuse what a file must not take the place of: a folder, a device, a pipe, what is write-protected."""
    if not place.is_file():
        raise FileError(f"cannot write '{place}': it is {'a folder' if place.is_dir() else 'no regular file'}")
    if not os.access(place, os.W_OK):
        raise FileError(f"cannot write '{place}': it is write-protected")


def _reason(error: Exception) -> str:
    return (isinstance(error, OSError) and error.strerror) or str(error)
