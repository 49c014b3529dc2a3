"""What can go wrong, in one small family: catch `DecoupleError` for all of it."""

from __future__ import annotations

import difflib
import os
import reprlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
T = TypeVar("T")


MOST_BYTES = 2 * 2**30  # of memory for one record or table


class DecoupleError(Exception):
    """Base of every error that this package raises on purpose."""


class ModelError(DecoupleError, ValueError):
    """A robot description that cannot be read or cannot be simulated."""


class InputError(DecoupleError, ValueError):
    """An argument, a protection or a case that makes no sense; the message names the value and the mend."""


class FileError(DecoupleError, OSError):
    """A file that cannot be read as what it should be, or a place that cannot be written."""


class DecoupleWarning(UserWarning):
    """Something that runs, but probably not as meant."""


def shown(value: object) -> str:
    """Return a value for a message, cut short where it is long."""
    short = reprlib.Repr()
    short.maxlist = short.maxtuple = short.maxset = short.maxdict = 16
    short.maxstring = short.maxother = short.maxlong = 200
    try:
        return " ".join(short.repr(value).split())
    except Exception:  # a stranger's own __repr__
        return f"an object of {type(value).__name__}"


def as_floats(name: str, value: ArrayLike) -> Floats:
    """Return numbers as an array of floats of its own: 64 bits in the machine's byte order, contiguous by rows.

    This is how every number enters the package. Integers and floats of any size and byte order, sequences of them and
    what NumPy makes an array of are numbers; text, truth values, complex numbers, times and objects are none, and nor
    is a masked array that hides an element.

    Raises:
        InputError: they are no real numbers; the message calls them `name`.
    """
    if type(value) is np.ndarray and value.dtype == np.float64:
        return np.array(value, order="C")
    try:
        given = np.asanyarray(value) if _hides_no_number(value) else np.ma.masked
        real = given.dtype.kind in "fiu" or (given.dtype.kind == "O" and all(map(_is_real, given.flat)))
        if real and not np.ma.is_masked(given):
            with np.errstate(over="ignore"):  # beyond the largest double is infinity, which is looked at as such
                return np.array(given, dtype=np.float64, order="C")
    except (TypeError, ValueError, OverflowError, RuntimeError, RecursionError):
        pass
    raise InputError(f"{name} is {shown(value)}; it needs real numbers")


def _hides_no_number(value: object) -> bool:
    """Say whether what NumPy would turn into numbers by itself, truth values and masked elements, is absent."""
    if isinstance(value, list | tuple):
        return all(type(item) is float or _hides_no_number(item) for item in value)
    if isinstance(value, np.ndarray | np.generic):
        return value.dtype.kind != "b" and not np.ma.is_masked(value)
    return not isinstance(value, bool)


def _is_real(item: object) -> bool:
    return isinstance(item, Real) and not isinstance(item, bool | np.bool_)


def as_triple(name: str, value: ArrayLike, axes: str = "") -> Floats:
    """Return three finite numbers (3,).

    Raises:
        InputError: they are not; the message calls them `name` and says in which axes they are wanted.
    """
    vector = as_floats(name, value)
    if vector.shape != (3,) or not np.all(np.isfinite(vector)):
        raise InputError(f"{name} is {shown(vector.tolist())}; it needs 3 finite numbers{axes and f', {axes}'}")
    return vector


def as_number(name: str, value: float, needs: str = "it needs one finite number", above: float = -np.inf) -> float:
    """Return a number that has to be finite and above another one.

    Raises:
        InputError: it is not; the message calls it `name` and ends with `needs`.
    """
    number = as_floats(name, value)
    if number.shape != () or not above < number < np.inf:
        raise InputError(f"{name} is {shown(value)}; {needs}")
    return float(number)


def as_positive(name: str, value: float, needs: str = "it must be a positive number") -> float:
    """Return a number that has to be finite and above zero.

    Raises:
        InputError: it is not; the message calls it `name` and ends with `needs`.
    """
    return as_number(name, value, needs, 0.0)


def as_not_negative(name: str, value: float, needs: str = "it must be zero or a positive number") -> float:
    """Return a number that has to be finite and not below zero.

    Raises:
        InputError: it is not; the message calls it `name` and ends with `needs`.
    """
    return as_number(name, value, needs, -5e-324)  # the number before zero


def as_whole(name: str, value: int, least: int = 1, needs: str = "", most: int = 2**53) -> int:
    """Return a whole number that has to be at least one number and at most another one.

    Raises:
        InputError: it is not; the message calls it `name` and ends with `needs`.
    """
    if not isinstance(value, Integral) or isinstance(value, bool) or value < least:
        raise InputError(f"{name} is {shown(value)}; {needs or f'it must be a whole number from {least}'}")
    if value > most:
        told = f"{int(value):,}" if value < 10**30 else "above 1e30"
        raise InputError(f"{name} is {told}; {most:,} at most")
    return int(value)


def as_seed(name: str, value: int) -> int:
    """Return the seed of a random generator.

    Raises:
        InputError: it is no whole number from 0; the message calls it `name`.
    """
    return as_whole(name, value, 0, most=2**63 - 1)


def as_switch(name: str, value: bool) -> bool:
    """Return true or false.

    Raises:
        InputError: it is neither; the message calls it `name`.
    """
    if not isinstance(value, bool | np.bool_):
        raise InputError(f"{name} is {shown(value)}; it must be True or False")
    return bool(value)


def as_kind(name: str, value: Any, kind: type[T], mend: str) -> T:
    """Return a value that has to be of a class.

    Raises:
        InputError: it is not; the message calls it `name` and ends with `mend`.
    """
    if not isinstance(value, kind):
        called = "the class itself, not one made of it" if isinstance(value, type) and issubclass(value, kind) else ""
        raise InputError(f"{name} is {called or shown(value)}; {mend}")
    return value


def as_text(name: str, value: str, mend: str = "it must be a text that is not empty") -> str:
    """Return a text that must not be empty.

    Raises:
        InputError: it is none; the message calls it `name` and ends with `mend`.
    """
    if not isinstance(value, str) or not value.strip():
        raise InputError(f"{name} is {shown(value)}; {mend}")
    return value


def as_path(name: str, value: str | os.PathLike[str], mend: str = "give a path, a text or a pathlib.Path") -> Path:
    """Return a path, with the user's home for "~".

    Raises:
        InputError: it is none; the message calls it `name` and ends with `mend`.
        FileError: it has a NUL character in it, which no file's name can have.
    """
    path = os.fspath(value) if isinstance(value, str | os.PathLike) else None
    if not isinstance(path, str) or not path:
        raise InputError(f"{name} is {shown(value)}; {mend}")
    if "\0" in path:
        raise FileError(f"{name} is {shown(value)}: no file's name has a NUL character in it; leave it out")
    try:
        return Path(path).expanduser()
    except RuntimeError:  # "~stranger"
        return Path(path)


def as_items(name: str, values: Iterable[T], mend: str) -> list[T]:
    """Return what a list or the like holds.

    Raises:
        InputError: it is none, or a text or a table; the message calls it `name` and ends with `mend`.
    """
    if isinstance(values, Iterable) and not isinstance(values, str | bytes | Mapping):
        try:
            return list(values)
        except TypeError:  # an array of no dimension
            pass
    raise InputError(f"{name} is {shown(values)}; {mend}")


def as_function(name: str, value: Callable[..., T] | None) -> Callable[..., T] | None:
    """Return a function, or None.

    Raises:
        InputError: it is neither; the message calls it `name`.
    """
    if value is not None and not is_function(value):
        raise InputError(f"{name} is {shown(value)}; it must be a function, or None")
    return value


def is_function(value: object) -> bool:
    """Say whether a value can be called as a function; a class is none."""
    return callable(value) and not isinstance(value, type)


def refuse_more_than_fits(what: str, size: float, mend: str) -> None:
    """Refuse what would take more than MOST_BYTES of memory, before it takes any.

    Raises:
        InputError: it would; the message says how much `what` takes, and the mend.
    """
    if not size <= MOST_BYTES:
        raise InputError(f"{what} would take {size / 2**30:.3g} GiB of memory, {MOST_BYTES / 2**30:g} at most; {mend}")


def unknown(kind: str, word: str, known: Sequence[str]) -> str:
    """Say that a word is not known, and which known one is nearest."""
    nearest = difflib.get_close_matches(word, known, 1, 0.5)
    return f"unknown {kind} '{word}'; " + (
        f"did you mean '{nearest[0]}'?" if nearest else f"known: {', '.join(known) or 'none'}"
    )
