"""Mistakes in a call in Python: each with the parameter, the cause and the cure."""

from __future__ import annotations

from collections.abc import Mapping
from types import FunctionType
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

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
        One per mistake.
    """

    def render(self, colour: bool = False) -> str:
        """Each mistake with its cure, indented."""
        rows = []
        for found in self.diagnostics:
            cures = [text for text in (found.label, *found.help.splitlines()) if text]
            rows += [found.message, *(f"  = {text}" for text in cures)]
        return "\n".join(rows)


def mistakes_of(
    error: ValidationError, model: type[BaseModel], given: Mapping[str, Any]
) -> ParameterError:
    """``error``, which a call ``model(**given)`` met, as what a user reads."""
    document = _as_document(model.__name__, given)
    found = explain(error, model, document, (), model.__name__, python=True)
    return ParameterError(found, f"{model.__name__}(...)")


def positional(model: type[BaseModel], values: tuple[Any, ...]) -> ParameterError:
    """A call with values that have no names."""
    fields = list(model.model_fields)
    example = next((name for name in fields if name != "name"), "name")
    label = f"name {'it' if len(values) == 1 else 'each'}, as in {example}={_short(values[0])}"
    message = f"{model.__name__} takes its parameters by their names"
    return _one(message, label, f"{model.__name__} takes: {', '.join(fields)}")


def changed(model: type[BaseModel], name: str) -> ParameterError:
    """An attribute that somebody tried to change."""
    cure = f"make another: {model.__name__}({name}=..., ...)"
    return _one(f"a {model.__name__} is not changed once it is made", "", cure)


def _one(message: str, label: str, cure: str) -> ParameterError:
    return ParameterError([Diagnostic(message, Span(Source("", "")), label, cure)], "")


def _as_document(name: str, given: Mapping[str, Any]) -> Document:
    """The arguments of a call as a document; places are numbered in the order of the call."""
    marks: dict[Path, Mark] = {}
    source = Source(f"{name}(...)", "")

    def mark(value: Any, path: Path) -> None:
        place = len(marks)
        marks[path] = Mark(Span(source, place, 0, place))
        if isinstance(value, Mapping | list | tuple):
            pairs = value.items() if isinstance(value, Mapping) else enumerate(value)
            for key, inner in pairs:
                mark(inner, (*path, key))

    mark(given, ())
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
        if not k.startswith("_") and k not in (*typed, "model_config") and not isinstance(v, kinds)
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
        if isinstance(value, FieldInfo):
            written = f"quantity({value.default!r:.40})"
            cure = f"write {attribute}: TYPE = {written} with a type, e.g. zonda.Seconds"
            return ZondaError(f"{attribute} = {written} has no type", place=name, cure=cure)
        cure = (
            f"write {attribute}: {kind} = {value!r:.40} for a parameter, {attribute}:"
            f" ClassVar[{kind}] = ... for a constant"
        )
        return ZondaError(f"{text} has no type", place=name, cure=cure)
    return ZondaError(
        f"its parameters cannot be used: {str(error).splitlines()[0]}",
        place=name,
        cure="give each the type of a number, a text or a list, or one of zonda's (zonda.Seconds)",
    )
