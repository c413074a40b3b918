"""Descriptions of parameters in words, for `help()`, signatures and docs/operators.md."""

from __future__ import annotations

import ast
import inspect
import linecache
import sys
import textwrap
import tokenize
from collections.abc import Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticCustomError

from .target import Target
from .time import Instant
from .units import Unit

_places: dict[type, tuple[str, int, dict[str, Any]]] = {}
"""Places of class statements: file, line, globals of the module."""
_documented: dict[type, dict[str, str]] = {}


def remember_place(cls: type) -> None:
    """Remember where the class statement of ``cls`` stands; called while the class is made."""
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__") != cls.__module__:
        frame = frame.f_back  # through pydantic's metaclass, to where the class statement stands
    _places[cls] = (frame.f_code.co_filename, frame.f_lineno, frame.f_globals)


def own_doc(cls: type) -> str:
    """The docstring as it stands in the class."""
    return inspect.cleandoc(
        next(
            (
                own
                for c in cls.__mro__
                if (own := c.__dict__.get("__doc__")) and isinstance(own, str)
            ),
            "",
        )
    )


def described(model: type[BaseModel]) -> dict[str, FieldInfo]:
    """The fields of ``model``, with their docstrings as descriptions.

    These are read from the source when somebody asks, not when the class is made (pydantic's
    ``use_attribute_docstrings``): that takes a third of a second for the classes of a run, which
    asks for none.
    """
    for name, field in model.model_fields.items():
        if field.description is None:
            nearest = next((own for cls in model.__mro__ if name in (own := _docstrings(cls))), {})
            field.description = nearest.get(name) or None
    return model.model_fields


def source_is_known(model: type) -> bool:
    """True if the source of the class and of its bases can be read, which is not so for what was
    typed at the prompt of `python`.
    """
    places = [_places[cls] for cls in model.__mro__ if cls in _places]
    return all(linecache.getlines(file, module) for file, _, module in places)


def _docstrings(cls: type) -> dict[str, str]:
    """The docstring of each attribute that the class itself annotates, empty where it has none."""
    if cls not in _places:
        return {}
    if cls not in _documented:
        file, line, module = _places[cls]
        _documented[cls] = _of_class(linecache.getlines(file, module)[line - 1 :], cls.__name__)
    return _documented[cls]


def _of_class(lines: list[str], name: str) -> dict[str, str]:
    """Docstrings of fields, from lines that begin with the class statement or its decorators."""
    try:
        statement = ast.parse(textwrap.dedent("".join(inspect.getblock(lines)))).body[0]
    except (
        SyntaxError,
        IndexError,
        ValueError,
        tokenize.TokenError,
    ):  # the file has changed meanwhile
        return {}
    if not isinstance(statement, ast.ClassDef) or statement.name != name:
        return {}
    found = {}
    for one, after in pairwise([*statement.body, ast.Pass()]):
        if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name):
            text = (
                after.value.value
                if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
                else None
            )
            found[one.target.id] = inspect.cleandoc(text) if isinstance(text, str) else ""
    return found


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
    """The unit that a parameter is annotated with; its example is the parameter's own, or the
    default where that is not zero.
    """
    everything = [
        *field.metadata,
        *(m for t in types_in(field.annotation) for m in getattr(t, "__metadata__", ())),
    ]
    unit = next((m for m in everything if isinstance(m, Unit)), None)
    own = [str(example) for example in field.examples or ()]
    if unit and not own and isinstance(field.default, str | float):
        with suppress(PydanticCustomError):  # a default that is a name, as `beam`
            own = [f"{field.default}"] if unit.parse(field.default) else []
    return Unit(unit.unit, *own) if unit and own else unit


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
    return tuple(_alternatives(field.annotation))


def _alternatives(annotation: Any) -> Iterator[Any]:
    origin = get_origin(annotation)
    arguments = get_args(annotation)
    if origin is Annotated:
        yield from _alternatives(arguments[0])
    elif origin in (Union, UnionType):
        for argument in arguments:
            yield from _alternatives(argument)
    else:
        yield annotation


def types_in(annotation: Any) -> Iterator[Any]:
    """An annotation and all types that it is made of."""
    yield annotation
    if get_origin(annotation) is not Literal:
        for argument in get_args(annotation):
            yield from types_in(argument)
