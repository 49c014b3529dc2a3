"""What can go wrong, in one small family: catch `DecoupleError` for all of it."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

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


def as_floats(name: str, value: ArrayLike) -> NDArray[np.float64]:
    """Return numbers as an array of floats.

    Raises:
        InputError: they are no real numbers; the message calls them `name`.
    """
    try:
        return np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{name} is {value!r}; it needs real numbers") from None


def as_triple(name: str, value: ArrayLike, axes: str = "") -> NDArray[np.float64]:
    """Return three finite numbers (3,).

    Raises:
        InputError: they are not; the message calls them `name` and says in which axes they are wanted.
    """
    vector = as_floats(name, value)
    if vector.shape != (3,) or not np.all(np.isfinite(vector)):
        raise InputError(f"{name} is {vector.tolist()}; it needs 3 finite numbers{axes and f', {axes}'}")
    return vector


def as_number(name: str, value: float, needs: str = "it needs one finite number", above: float = -np.inf) -> float:
    """Return a number that has to be finite and above another one.

    Raises:
        InputError: it is not; the message calls it `name` and ends with `needs`.
    """
    number = as_floats(name, value)
    if number.shape != () or not above < number < np.inf:
        raise InputError(f"{name} is {value}; {needs}")
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


def as_seed(name: str, value: int) -> int:
    """Return the seed of a random generator.

    Raises:
        InputError: it is no whole number from 0; the message calls it `name`.
    """
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise InputError(f"{name} is {value!r}; it must be a whole number from 0")
    return value


def as_count(name: str, value: int, most: int, needs: str = "give a whole number from 1") -> int:
    """Return a whole number from 1 to `most`: how often something is done or kept.

    Raises:
        InputError: it is none, and the message ends with `needs`, or above `most`; the message calls it `name`.
    """
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < 1:
        raise InputError(f"{name} is {value!r}; {needs}")
    if value > most:
        told = f"{value:,}" if value < 10**30 else "above 1e30"
        raise InputError(f"{name} is {told}; {most:,} at most")
    return int(value)


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
