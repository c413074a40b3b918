"""pydantic's errors as diagnostics with places in a document."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import PydanticCustomError

from .describe import described, types_in, unit_of
from .diagnostics import ConfigurationError, Diagnostic, nearest
from .units import Unit
from .yaml_places import Document, Path, Span

_LIMITS = {
    "greater_than": ("gt", "greater than"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "less than"),
    "less_than_equal": ("le", "at most"),
}

_WANTED = {
    "int": "a whole number",
    "bool": "true or false",
    "float": "a number",
    "string": "text",
    "list": "a list",
    "dict": "a mapping of keys",
    "model": "a mapping of keys",
    "path": "the path of a file or folder",
}
"""Expected values for pydantic's errors of type or parsing, by the first word of their kind."""

_IN_PYTHON = {"a mapping of keys": "a dict", "true or false": "True or False"}


def explain(
    error: ValidationError,
    model: type[BaseModel],
    document: Document,
    at: Path,
    who: str,
    keys: Iterable[str] = (),
    *,
    python: bool = False,
) -> list[Diagnostic]:
    """One diagnostic per mistaken value.

    Parameters
    ----------
    model
        What was validated, from the value at path ``at`` of the document.
    who
        How messages call it.
    keys
        The keys it takes, where they are not just the model's fields.
    python
        Whether it was called in Python: cures are then written so.
    """
    validated = _Validated(model, document, at, who, list(keys), python)
    found: list[Diagnostic] = []
    branches: dict[Span, int] = {}
    for e in error.errors():
        new = validated.diagnostic(e)
        if new.span not in branches or e["type"] in ("missing", "extra_forbidden"):
            branches[new.span] = len(found)
            found.append(new)
        else:  # another branch of a union
            k = branches[new.span]
            other = "or: " + new.message.removeprefix(found[k].message.split(": ")[0] + ": ")
            text = "\n".join(filter(None, (other, found[k].help)))
            found[k] = replace(found[k], label=found[k].label or new.label, help=text)
    return _together(found)


def _together(found: list[Diagnostic]) -> list[Diagnostic]:
    """More than two parameters that are missing at one place as one mistake; none that another name
    was meant for.
    """
    found = without_meant(found)
    for span in dict.fromkeys(d.span for d in found):
        lacking = [d for d in found if d.span == span and " needs '" in d.message]
        if len(lacking) > 2:
            names = ", ".join(_missing(d) for d in lacking)
            texts = "\n".join(f"{_missing(d)[1:-1]}: {d.help}" for d in lacking)
            one = Diagnostic(
                f"{lacking[0].message.split(' needs ')[0]} needs {names}",
                span,
                "these are missing",
                texts,
            )
            found = [
                one if d is lacking[0] else d for d in found if d is lacking[0] or d not in lacking
            ]
    return found


def without_meant(found: list[Diagnostic]) -> list[Diagnostic]:
    """Without what is missing as its name is written wrong: the wrong name says so."""
    meant = {d.label for d in found if d.message.startswith("unknown ")}
    lacking = [re.search(r" needs '(\w+)'", d.message) for d in found]
    return [
        d
        for d, match in zip(found, lacking, strict=True)
        if not (match and f"did you mean '{match[1]}'?" in meant)
    ]


def _missing(diagnostic: Diagnostic) -> str:
    return diagnostic.message.rpartition(" needs ")[2]


@dataclass(frozen=True)
class _Validated:
    """A validated value and its place: the arguments of `explain`."""

    model: type[BaseModel]
    document: Document
    at: Path
    who: str
    keys: list[str]
    python: bool

    def diagnostic(self, e: Any) -> Diagnostic:
        """One of pydantic's errors."""
        path = self.at
        loc = []
        place = (
            e["loc"][:-1]
            if e["type"] == "missing"
            else (*e["loc"], *e.get("ctx", {}).get("at", ()))
        )
        for part in place:  # leaves out tags of unions
            if (*path, part) in self.document.marks:
                path = (*path, part)
                loc.append(part)
        if e["type"] == "extra_forbidden":
            return self.unknown(e["loc"][-1], loc, self.document.marks[path].start)
        if e["type"] == "missing":
            return self.missing(str(e["loc"][-1]), loc, self.document.marks[path].start)
        return self.value(e, path, loc)

    def name(self, loc: list[Any]) -> str:
        """Name of the item at ``loc`` in messages."""
        return f"{self.who}, {'.'.join(map(str, loc))}" if loc else self.who

    def unknown(self, key: Any, loc: list[Any], span: Span) -> Diagnostic:
        owner, _ = _field(self.model, loc[:-1])
        fields = (owner or self.model).model_fields
        options = list(
            self.keys
            if self.keys and len(loc) == 1
            else (field.alias or name for name, field in fields.items())
        )
        inner = getattr(owner or self.model, "KEYS_BELONG_IN", "") if "." in str(key) else ""
        known = f"write {inner}: {{{key}: [...]}}" if inner else "not a known key"
        hint = nearest(key, options, known)
        inside = self.name(loc[:-1])
        message = f"unknown {'parameter' if self.python else 'key'} '{key}' for {inside}"
        return Diagnostic(
            message,
            span,
            glued(key, options) or hint,
            f"{inside} takes: {', '.join(options)}",
        )

    def missing(self, name: str, loc: list[Any], span: Span) -> Diagnostic:
        _, field = _field(self.model, [*loc, name])
        unit = unit_of(field) if field else None
        if self.python and not loc:
            label = (
                f"add {name}={unit.example!r}"
                if unit and unit.unit
                else f"add {name}={unit.example if unit else '...'}"
            )
        else:
            label = f"add '{name}: {unit.example}'" if unit else f"add '{name}:'"
        return Diagnostic(f"{self.name(loc)} needs '{name}'", span, label, _description(field))

    def value(self, e: Any, path: Path, loc: list[Any]) -> Diagnostic:
        _, field = _field(self.model, loc)
        context = e.get("ctx", {})
        span = self.document.marks[path].value
        if (
            isinstance(inner := context.get("error"), ConfigurationError) and inner.diagnostics
        ):  # a call within
            first = inner.diagnostics[0]
            return Diagnostic(f"{self.name(loc)}: {first.message}", span, first.label, first.help)
        if (caret := context.get("caret")) and not self.python:
            span = span.part(*caret)
        unit = unit_of(field) if field else None
        if unit and e["type"] == "mistake":
            try:
                unit.parse(e["input"])
            except PydanticCustomError as own:  # the same, with the parameter's example
                if own.message().partition(" such as")[0] == e["msg"].partition(" such as")[0]:
                    e = {**e, "msg": own.message(), "ctx": own.context}
        message, label = self.message(e, unit, path)
        message = (
            message[:1].lower() + message[1:] if re.match(r"[A-Z][a-z]+\b", message) else message
        )
        text = "\n".join(filter(None, (context.get("help"), _description(field))))
        return Diagnostic(f"{self.name(loc)}: {message}", span, label, text)

    def message(self, e: Any, unit: Unit | None, path: Path) -> tuple[str, str]:
        """(message, label) for a mistaken value."""
        kind = e["type"]
        context = e.get("ctx", {})
        given = f"{e['input']!r:.60}"
        if kind in _LIMITS:
            return _limit(e, unit, self.document, path), ""
        if kind == "literal_error":
            expected = context.get("expected", "")
            return f"must be {expected}, got {given}", nearest(
                e["input"],
                re.findall(r"'([^']*)'", expected),
            )
        if kind == "too_short":
            return (
                f"needs at least {context['min_length']} of them, got {context['actual_length']}",
                "",
            )
        if kind == "string_pattern_mismatch":
            within = (
                ", '.', '+', '-' and spaces within" if " " in context.get("pattern", "") else ""
            )
            return (
                f"{given} has a character that is not allowed here",
                f"use letters, digits and '_'{within}",
            )
        wanted = _WANTED.get(kind.split("_")[0])
        if (
            wanted
            and kind.endswith(("_parsing", "_type", "_from_float"))
            and e["msg"].startswith("Input")
        ):
            single = kind == "list_type" and isinstance(e["input"], str | int | float)
            label = f"write [{given if self.python else e['input']}]" if single else ""
            return (
                (
                    f"expected {_IN_PYTHON.get(wanted, wanted) if self.python else wanted}, got"
                    f" {given}"
                ),
                label,
            )
        return str(context.get("error") or e["msg"]), context.get("label") or ""


def glued(key: object, options: Iterable[str]) -> str:
    """Cure for a key and value that were written as one text: {pixel:2 arcsec}."""
    name, colon, value = str(key).partition(":")
    return f"write a space after the colon: {name}: {value}" if colon and name in options else ""


def _limit(e: Any, unit: Unit | None, document: Document, path: Path) -> str:
    """``must be at least 5 deg, got -1 deg``, in the unit that the user wrote."""
    key, words = _LIMITS[e["type"]]
    value: Any = document.value
    try:
        for part in path:
            value = value[part]
    except (
        TypeError,
        LookupError,
    ):  # a key that is there twice: its places are of one, its value of the other
        value = e["input"]
    limit = e["ctx"][key]
    shown = f"{limit}"
    if unit and unit.unit:
        shown = unit.write_in_unit_of(limit, value) if isinstance(value, str) else unit.write(limit)
    return f"must be {words} {shown}, got {value}"


def _field(
    model: type[BaseModel],
    loc: Iterable[Any],
) -> tuple[type[BaseModel] | None, FieldInfo | None]:
    """The model and the field at ``loc``: what a value there is checked against."""
    owner: type[BaseModel] | None = model
    field: FieldInfo | None = None
    for part in loc:
        if owner is not None and part in owner.model_fields:
            field = described(owner)[part]
            owner = next(
                (
                    t
                    for t in types_in(field.annotation)
                    if isinstance(t, type) and issubclass(t, BaseModel)
                ),
                None,
            )
    return owner, field


def _description(field: FieldInfo | None) -> str:
    return " ".join((field.description or "").split()) if field is not None else ""
