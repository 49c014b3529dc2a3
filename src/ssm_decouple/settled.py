"""Settings that stay as they were given, so that a record which tells them tells the truth."""

from __future__ import annotations

import inspect
from abc import ABCMeta
from collections.abc import Mapping
from typing import Any, ClassVar, NoReturn

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class _Settling(ABCMeta):
    """Ends the making of an object, that of its subclasses' part included."""

    def __call__(cls, *args: Any, **kwargs: Any) -> Any:
        made = super().__call__(*args, **kwargs)
        object.__setattr__(made, "_settled", True)
        return made

    @property
    def __signature__(cls) -> inspect.Signature:
        """The arguments of the class, which Python would look for in the method above."""
        made = inspect.signature(cls.__init__)  # type: ignore[misc]
        return made.replace(parameters=list(made.parameters.values())[1:], return_annotation=inspect.Signature.empty)


class FixedArrays:
    """What a class has whose public arrays are read-only: they stay so in copies and where they are unpickled."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        for name, value in state.items():
            if name[0] != "_" and isinstance(value, np.ndarray):
                value.flags.writeable = False  # NumPy does not keep it


class Settled(FixedArrays, metaclass=_Settling):
    """What a class has whose settings are read when an object of it is made, and not again.

    Once it is made no public attribute can be assigned, but properties that have a setter and the names in
    `_assignable`: these act. Names that begin with an underscore are the class's own.
    """

    _assignable: ClassVar[tuple[str, ...]] = ()

    def __setattr__(self, name: str, value: Any) -> None:
        if name[0] != "_":
            self.__look(name)
        object.__setattr__(self, name, value)

    def __delattr__(self, name: str) -> None:
        self.__look(name)
        object.__delattr__(self, name)

    def __look(self, name: str) -> None:
        if (
            "_settled" not in self.__dict__
            or name in self._assignable
            or hasattr(getattr(type(self), name, None), "__set__")
        ):
            return
        kind = type(self).__name__
        raise AttributeError(
            f"'{name}' of a {kind} cannot be assigned: its settings are read when it is made; make another {kind}"
        )


class FixedDict(dict[Any, Any]):
    """A dictionary that stays as it is; `{**this, ..}` is one to change."""

    def _refuse(self, *_: Any, **__: Any) -> NoReturn:
        raise TypeError("these settings are read-only; make a dictionary of them to change: {**settings, ..}")

    __setitem__ = __delitem__ = __ior__ = _refuse
    clear = pop = popitem = setdefault = update = _refuse

    def __reduce__(self) -> tuple[Any, tuple[dict[Any, Any]]]:
        return fixed, (dict(self),)


class FixedList(list[Any]):
    """A list that stays as it is; `[*this, ..]` is one to change."""

    def _refuse(self, *_: Any, **__: Any) -> NoReturn:
        raise TypeError("these settings are read-only; make a list of them to change: [*settings, ..]")

    __setitem__ = __delitem__ = __iadd__ = __imul__ = _refuse
    append = extend = insert = remove = pop = clear = sort = reverse = _refuse

    def __reduce__(self) -> tuple[Any, tuple[list[Any]]]:
        return fixed, (list(self),)


def fixed_array(values: NDArray[Any]) -> NDArray[Any]:
    """Return a read-only copy of an array, which no view of the given one can change."""
    copy = np.array(values)
    copy.flags.writeable = False
    return copy


def fixed(value: Any) -> Any:
    """Return a read-only copy of tables, lists and arrays, one in another; anything else as it is."""
    if isinstance(value, Mapping):
        return FixedDict({key: fixed(item) for key, item in value.items()})
    if isinstance(value, list):
        return FixedList([fixed(item) for item in value])
    if type(value) is tuple:
        return tuple(map(fixed, value))
    return fixed_array(value) if isinstance(value, np.ndarray) else value
