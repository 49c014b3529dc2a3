"""What files written by people may hold, and what is said where they hold something else."""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ssm_decouple.errors import InputError, unknown

# What a value must be, in words that a message can use.
NUMBER = "a number"
SWITCH = "true or false"
TEXT = "a text"
NUMBERS = "3 numbers"
JOINTS = "a list of numbers or a table by joint name"
AXES = "a name or a list of directions such as [[0, 0, 1]]"
TURNS = "a table of angles by the name of a visual"
NAMES = "a list of names"
LIST = "a list of numbers"
PHASES = "a list of tables { from = .., axes = .. }"

LARGEST = sys.float_info.max

Keys = Mapping[str, tuple[str, bool]]  # a key's name to what its value must be, and whether it has to be there


def read_toml(path: Path) -> tuple[dict[str, Any], str]:
    """Return what a TOML file holds, and its text.

    Raises:
        InputError: it cannot be read, or is not TOML.
    """
    try:
        text = path.read_text(encoding="utf-8")
        return tomllib.loads(text), text
    except OSError as error:
        raise InputError(f"cannot read '{path}': {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:  # not UTF-8, a number of thousands of digits, tables without end
        raise InputError(f"'{path}' is not TOML: {error}") from error


def check_keys(values: Mapping[str, Any], keys: Keys, place: str) -> None:
    """Refuse a table with an unknown key, a value of another kind, or a missing key.

    Args:
        values: The table.
        keys: What it may hold.
        place: What messages begin with: "[law] ", or nothing.

    Raises:
        InputError: the message names the key, and the nearest known one.
    """
    for key, value in values.items():
        if key not in keys:
            raise InputError(f"{place}{unknown('key', key, list(keys))}")
        if not _fits(value, keys[key][0]):
            raise InputError(f"{place}{key} is {value!r}; it must be {keys[key][0]}")
    missing = [key for key, (_, needed) in keys.items() if needed and key not in values]
    if missing:
        raise InputError(f"{place}{missing[0]} is missing")


def _fits(value: Any, kind: str) -> bool:
    def number(x: Any) -> bool:
        return isinstance(x, int | float) and not isinstance(x, bool) and abs(x) <= LARGEST  # so neither NaN nor inf

    if kind == NUMBER:
        return number(value)
    if kind == SWITCH:
        return isinstance(value, bool)
    if kind == TEXT:
        return isinstance(value, str)
    if kind == NUMBERS:
        return isinstance(value, list) and len(value) == 3 and all(map(number, value))
    if kind == LIST:
        return isinstance(value, list) and all(map(number, value))
    if kind == NAMES:
        return isinstance(value, list) and all(isinstance(x, str) for x in value)
    if kind == PHASES:
        return isinstance(value, list) and all(isinstance(x, dict) for x in value)
    if kind == TURNS:
        return isinstance(value, dict) and all(map(number, value.values()))
    if kind == AXES:
        return isinstance(value, str) or (
            isinstance(value, list) and all(number(x) or (isinstance(x, list) and all(map(number, x))) for x in value)
        )
    return (
        all(map(number, value.values() if isinstance(value, dict) else value))
        if isinstance(value, dict | list)
        else False
    )
