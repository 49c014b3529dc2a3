"""Compiling with Numba, in files that may call each other.

Numba keeps compiled code on disk and looks only at the time of the file that a function stands in: after a change in
another file, whose functions are called or whose constants are read, the old code would go on without a word. The cache
here is stamped with what all these files hold.
"""

from __future__ import annotations

import hashlib
import re
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core.caching import FunctionCache
from numba.core.errors import NumbaError as NumbaError  # of an array that no signature knows

from ssm_decouple.errors import DecoupleWarning

F = TypeVar("F", bound=Callable[..., Any])

# At the beginning of a line: what is imported for the types alone is indented.
_IMPORTED = re.compile(r"^from (ssm_decouple[\w.]*) import (\([^)]*\)|[^\n(]*)", re.MULTILINE)


def compiled_for(*signature: str, inline: str = "never", nogil: bool = False) -> Callable[[F], F]:
    """Compile with Numba and keep the machine code on disk.

    Args:
        signature: With one it is compiled at once and for that one only: an array of another layout must not start a
            second compilation.
        inline: "always" compiles it into the caller: for what is called in one or two places, where a call would cost
            as much as the work.
        nogil: Let other Python threads go on while the function runs.
    """

    def decorate(function: F) -> F:
        njit: Any = numba.njit
        dispatcher = njit(inline=inline, nogil=nogil, error_model="numpy")(function)
        try:
            dispatcher._cache = SourceCache(function)
        except RuntimeError:  # from Numba: no folder can be written
            _tell_that_nothing_is_kept()
        for each in signature:
            dispatcher.compile(each)
        if signature:
            dispatcher.disable_compile()
        return cast(F, dispatcher)

    return decorate


compiled = compiled_for()
inlined = compiled_for(inline="always")
unlocked = compiled_for(nogil=True)


class SourceCache(FunctionCache):
    """Numba's cache of a function, with a stamp that changes with any of the files that its code comes from."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        self._cache_file._source_stamp = source_stamp(function.__module__)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep compiled code; where the disk is full the code in memory still is good."""
        try:
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]
        except OSError as error:
            _tell_that_nothing_is_kept(f": {error.strerror or error}")


@cache
def source_stamp(module: str) -> str:
    """Return a digest of a module's file and of the files of this package that it imports, and so on."""
    digest, seen, left = hashlib.sha256(), set[str](), [module]
    while left:
        name = left.pop()
        path = None if name in seen else _path(name)
        if path is None:
            continue
        seen.add(name)
        source = path.read_text(encoding="utf-8")
        digest.update(f"{name}\n{source}\n".encode())
        if name == __name__:
            continue  # what is imported here is no part of the code
        for package, names in _IMPORTED.findall(source):
            left += [package, *(f"{package}.{word}" for word in re.findall(r"\w+", names))]
    return digest.hexdigest()


def _path(module: str) -> Path | None:
    """Return the file of a module of this package; None where the name is not one but, say, a function's."""
    base = Path(__file__).parent.joinpath(*module.split(".")[1:])
    return next((path for path in (base.with_suffix(".py"), base / "__init__.py") if path.is_file()), None)


@cache
def _tell_that_nothing_is_kept(why: str = "") -> None:
    warnings.warn(
        f"compiled code cannot be kept on disk{why}; each new process compiles for a minute. Set NUMBA_CACHE_DIR to a "
        "folder that can be written",
        DecoupleWarning,
        stacklevel=2,
    )
