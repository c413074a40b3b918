"""Descriptions of parameters in words, for `help()`, signatures and docs/operators.md."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from .docstrings import described, own_doc
from .target import Target
from .time import Instant
from .units import Unit

_WORDS: dict[Any, str] = {
    bool: "True or False",
    int: "a whole number",
    float: "a number",
    str: "text",
    Path: "the path of a file",
    Target: "a position such as '05h00m00s +20d00m00s'",
    Instant: "a time such as '2024-11-25T07:00:00Z'",
}


def choices(field: FieldInfo) -> tuple[Any, ...]:
    """The values of a Literal that a parameter takes; empty where it takes others."""
    return tuple(
        dict.fromkeys(
            v for t in types_in(field.annotation) if get_origin(t) is Literal for v in get_args(t)
        )
    )


def kind(field: FieldInfo) -> str:
    """Values that a parameter takes: a kind of quantity with an example, its choices, or a type in
    words.
    """
    kinds = members(field)
    unit = unit_of(field)
    words = [f"{unit.kind.noun} such as '{unit.example}'"] if unit and float in kinds else []
    chosen = [repr(value) for value in choices(field)]
    words += (
        [f"{', '.join(chosen[:-1])} or {chosen[-1]}" if len(chosen) > 1 else chosen[0]]
        if chosen
        else []
    )
    for member in kinds:
        if get_origin(member) in (list, tuple):
            words.append("a list")
        elif get_origin(member) is dict:
            words.append("a dict")
        elif isinstance(member, type) and issubclass(member, BaseModel):
            words.append(f"a{'n' * (member.__name__[0] in 'AEIOU')} {member.__name__}")
        elif isinstance(member, type) and member in _WORDS and not (unit and member is float):
            words.append(_WORDS[member])
        elif isinstance(noun := getattr(member, "NOUN", None), str):  # a value type of an operator
            words.append(noun)
    return ", or ".join(dict.fromkeys(words)) or "see below"


def unit_of(field: FieldInfo) -> Unit | None:
    """The unit that a parameter is annotated with."""
    everything = [
        *field.metadata,
        *(m for t in types_in(field.annotation) for m in getattr(t, "__metadata__", ())),
    ]
    return next((m for m in everything if isinstance(m, Unit)), None)


def document(cls: type[BaseModel]) -> str:
    """The docstring with a section of parameters: what each takes, its default, what it is."""
    lines = [own_doc(cls), "", "Parameters", "----------"]
    for name, field in described(cls).items():
        default = "required" if field.is_required() else f"default {_value(field)!r}"
        lines.append(f"{field.alias or name} : {kind(field)}; {default}")
        lines += [f"    {line}" for line in (field.description or "").splitlines()]
    return "\n".join(lines).strip()


def signature(cls: type[BaseModel]) -> inspect.Signature:
    """Parameters with their defaults as a user would write them."""
    empty = inspect.Parameter.empty
    made = [
        inspect.Parameter(
            key,
            inspect.Parameter.KEYWORD_ONLY,
            default=empty if field.is_required() else _value(field),
        )
        for key, field in ((field.alias or name, field) for name, field in cls.model_fields.items())
    ]
    return inspect.Signature(made)


def _value(field: FieldInfo) -> Any:
    return field.get_default(call_default_factory=True)


def members(field: FieldInfo) -> tuple[Any, ...]:
    """The types of which a parameter takes one, without what they are annotated with."""
    annotation = field.annotation
    members = (
        get_args(annotation) if get_origin(annotation) in (Union, UnionType) else (annotation,)
    )
    return tuple(get_args(m)[0] if get_origin(m) is Annotated else m for m in members)


def types_in(annotation: Any) -> Iterator[Any]:
    """An annotation and all types that it is made of."""
    yield annotation
    if get_origin(annotation) is not Literal:
        for argument in get_args(annotation):
            yield from types_in(argument)
