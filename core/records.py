"""`dataclass` as the standard library's, made in a third of the time.

The standard decorator writes up to six methods for every class and compiles them, some 0.5 ms; a run defines a hundred classes
before its first block. Here it writes ``__init__`` alone; comparison, hash, representation and what keeps a frozen one from being
changed are the same functions for all classes.
"""

from __future__ import annotations

import dataclasses
from functools import cache
from reprlib import recursive_repr
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dataclasses import dataclass as dataclass
else:

    def dataclass(cls=None, /, *, frozen=False, repr=True, eq=True, **others):
        """As `dataclasses.dataclass`; cases that are rare here are left to it."""

        def make(cls):
            own = vars(cls)
            late = any(isinstance(value, dataclasses.Field) and not value.init for value in own.values())
            based = any(base.__dataclass_params__.frozen for base in cls.__mro__[1:] if dataclasses.is_dataclass(base))
            if others or late or based:
                return dataclasses.dataclass(cls, frozen=frozen, repr=repr, eq=eq, **others)
            return _make(cls, frozen, repr, eq)

        return make if cls is None else make(cls)


def _make(cls: type, frozen: bool, repr: bool, eq: bool) -> Any:
    own = vars(cls)
    methods: dict[str, Any] = {"__repr__": _repr} if repr else {}
    if eq:
        methods["__eq__"] = _eq
        methods["__hash__"] = _hash if frozen else None
    if frozen:
        methods |= {"__setattr__": _refuse_change, "__delattr__": _refuse_deletion}
    explicit = set(own)
    if "__eq__" in own and own["__hash__"] is None:  # Python's own doing
        explicit.remove("__hash__")
    if not cls.__doc__:
        cls.__doc__ = cls.__name__  # or the signature is worked out
    made: Any = dataclasses.dataclass(cls, repr=False, eq=False)
    for name, method in methods.items():
        if name not in explicit:
            setattr(made, name, method)
    made.__dataclass_params__.frozen, made.__dataclass_params__.repr, made.__dataclass_params__.eq = frozen, repr, eq
    return made


@cache
def _names(cls: Any) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """Fields that are compared, hashed and shown."""
    fields = dataclasses.fields(cls)
    hashed = (f.name for f in fields if (f.compare if f.hash is None else f.hash))
    return tuple(f.name for f in fields if f.compare), tuple(hashed), tuple(f.name for f in fields if f.repr)


def _eq(self: Any, other: Any) -> Any:
    if other.__class__ is not self.__class__:
        return NotImplemented
    names = _names(self.__class__)[0]
    return tuple(getattr(self, name) for name in names) == tuple(getattr(other, name) for name in names)


def _hash(self: Any) -> int:
    return hash(tuple(getattr(self, name) for name in _names(self.__class__)[1]))


@recursive_repr()
def _repr(self: Any) -> str:
    shown = (f"{name}={getattr(self, name)!r}" for name in _names(self.__class__)[2])
    return f"{self.__class__.__qualname__}({', '.join(shown)})"


def _refuse_change(self: Any, name: str, value: Any) -> None:
    """Each field is set once, by ``__init__``."""
    cls = self.__class__
    if name in self.__dict__ if name in cls.__dataclass_fields__ else "__dataclass_fields__" in vars(cls):
        raise dataclasses.FrozenInstanceError(f"cannot assign to field {name!r}")
    object.__setattr__(self, name, value)


def _refuse_deletion(self: Any, name: str) -> None:
    cls = self.__class__
    if name in cls.__dataclass_fields__ or "__dataclass_fields__" in vars(cls):
        raise dataclasses.FrozenInstanceError(f"cannot delete field {name!r}")
    object.__delattr__(self, name)
