"""Mistakes in a call in Python, shown as those in a file are: the call written out, with carets
under what is wrong.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import FunctionType
from typing import Any

from pydantic import BaseModel, ValidationError

from ..errors import ZondaError
from .diagnostics import ConfigurationError, Diagnostic
from .explain import explain
from .yaml_places import Document, Mark, Path, Source, Span

LONGEST = 60
"""Characters of a value that are shown."""


class ParameterError(ConfigurationError, ValueError):
    """Parameters of an operator, a scene, an instrument ... that cannot be used, each with its
    cause and cure.

    Attributes
    ----------
    diagnostics
        One per mistake; their spans lie in the call, written out on one line.
    """

    def render(self, colour: bool = False) -> str:
        """The mistakes, each with the call and a caret."""
        return "\n".join(self._one(d, colour) for d in self.diagnostics)

    def _one(self, diagnostic: Diagnostic, colour: bool) -> str:
        first, _, _, call, caret, *rest = diagnostic.render(colour).splitlines()
        return "\n".join(
            [first.replace("error: ", "", 1), f"    {call[4:]}", f"    {caret[4:]}", *rest]
        )


def mistakes_of(
    error: ValidationError, model: type[BaseModel], given: Mapping[str, Any]
) -> ParameterError:
    """``error``, which a call ``model(**given)`` met, as what a user reads."""
    document = written(model.__name__, given)
    found = explain(error, model, document, (), model.__name__, python=True)
    return ParameterError(found, f"{model.__name__}(...)")


def positional(model: type[BaseModel], values: tuple[Any, ...]) -> ParameterError:
    """A call with values that have no names."""
    fields = list(model.model_fields)
    text = f"{model.__name__}({', '.join(_short(value) for value in values)})"
    span = Span(Source("the call", text), 0, len(model.__name__) + 1, 0, len(text) - 1)
    message = f"{model.__name__} takes its parameters by their names"
    example = next((name for name in fields if name != "name"), "name")
    label = f"name {'it' if len(values) == 1 else 'each'}, as in {example}={_short(values[0])}"
    return ParameterError(
        [Diagnostic(message, span, label, f"{model.__name__} takes: {', '.join(fields)}")], text
    )


def changed(model: type[BaseModel], name: str) -> ParameterError:
    """An attribute that somebody tried to change."""
    text = f"{model.__name__}.{name} = ..."
    span = Span(Source("the assignment", text), 0, 0, 0, len(text))
    message = f"a {model.__name__} is not changed once it is made"
    return ParameterError(
        [Diagnostic(message, span, "", f"make another: {model.__name__}({name}=..., ...)")], text
    )


def written(name: str, given: Mapping[str, Any]) -> Document:
    """The text ``name(key=value, ...)`` on one line, as a document that knows where each value
    stands in it.
    """
    text = ""
    places: dict[Path, tuple[int, int, int]] = {}

    def write(value: Any, path: Path) -> None:
        nonlocal text
        begin = len(text)
        if isinstance(value, Mapping) and value:
            for k, (key, inner) in enumerate(value.items()):
                text += ", " if k else "{"
                at = len(text)
                text += f"{key!r}: "
                write(inner, (*path, key))
                places[*path, key] = (at, *places[*path, key][1:])
            text += "}"
        elif isinstance(value, list | tuple) and value:
            for k, inner in enumerate(value):
                text += ", " if k else "["
                write(inner, (*path, k))
            text += "]"
        else:
            text += _short(value)
        places[path] = (begin, begin, len(text))

    text = f"{name}("
    for k, (key, value) in enumerate(given.items()):
        text += ", " if k else ""
        at = len(text)
        text += f"{key}="
        write(value, (key,))
        places[key,] = (at, *places[key,][1:])
    text += ")"
    places[()] = (0, 0, len(text))
    source = Source(f"{name}(...)", text)
    marks = {
        path: Mark(
            Span(source, 0, begin, 0, end),
            (
                Span(source, 0, key, 0, key + len(text[key:begin].rstrip("=: ")))
                if key < begin
                else None
            ),
        )
        for path, (key, begin, end) in places.items()
    }
    return Document(dict(given), marks, [])


def _short(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 4]} ..."


def without_a_type(
    name: str, bases: tuple[type, ...], namespace: Mapping[str, Any], error: Exception
) -> ZondaError:
    """A class ``name`` of parameters, one of whose attributes pydantic cannot take."""
    typed, kinds = (
        namespace.get("__annotations__", {}),
        (FunctionType, property, classmethod, staticmethod, type),
    )
    plain = {
        k: v
        for k, v in namespace.items()
        if not k.startswith("_") and k not in typed and not isinstance(v, kinds)
    }
    fields = {field for base in bases for field in getattr(base, "model_fields", {})}
    methods = {k for k in plain if any(callable(getattr(base, k, None)) for base in bases)}
    constants = {k for base in bases for k in getattr(base, "__class_vars__", ())}
    for attribute, value in plain.items():
        if attribute in constants:
            continue
        text = f"{attribute} = {value!r:.40}"
        if attribute in methods:
            return ZondaError(
                f"{text}: {attribute} is a method",
                place=name,
                cure=f"write def {attribute}(self, ...): ...",
            )
        if attribute == "name" and attribute in fields:
            cure = (
                "leave it out, and give a step its label where it is made:"
                f" {name}(name={value!r:.40})"
            )
            return ZondaError(
                f"{text}: the label of a step is no constant of its class", place=name, cure=cure
            )
        kind = type(value).__name__ if value is not None else "Any"
        cure = (
            f"write {attribute}: {kind} = {value!r:.40} for a parameter, {attribute}:"
            f" ClassVar[{kind}] = ... for a constant"
        )
        return ZondaError(f"{text} has no type", place=name, cure=cure)
    return ZondaError(
        f"its parameters cannot be used: {str(error).splitlines()[0]}",
        place=name,
        cure="give each a type",
    )
