"""pydantic's errors as diagnostics with places in a document."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from .diagnostics import ConfigurationError, Diagnostic, nearest
from .docstrings import described
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
"""What pydantic's errors of type (or parsing) want, by the first word of their kind."""
SYNONYMS = {
    **dict.fromkeys(("steps", "pipeline", "ops"), "operators"),
    **dict.fromkeys(("camera", "telescope", "receiver"), "instrument"),
    **dict.fromkeys(("location", "observatory", "place"), "site"),
    **dict.fromkeys(("date", "start", "begin", "epoch"), "time"),
    **dict.fromkeys(("position", "source", "center", "field"), "target"),
    **dict.fromkeys(("pwv", "atmosphere"), "weather"),
    **dict.fromkeys(("output", "folder", "out"), "outputs"),
}
"""Keys that people write for another one."""

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
    found: list[Diagnostic] = []
    branches: dict[Span, int] = {}
    for e in error.errors():
        new = _one(e, model, document, at, who, keys, python)
        if new.span not in branches or e["type"] in ("missing", "extra_forbidden"):
            branches[new.span] = len(found)
            found.append(new)
        else:  # another branch of a union
            k = branches[new.span]
            other = "or: " + new.message.removeprefix(found[k].message.split(": ")[0] + ": ")
            found[k] = replace(found[k], help="\n".join(filter(None, (other, found[k].help))))
    return _together(found)


def _together(found: list[Diagnostic]) -> list[Diagnostic]:
    """More than two parameters that are missing at one place as one mistake; none that another name was meant for."""
    found = without_meant(found)
    for span in dict.fromkeys(d.span for d in found):
        lacking = [d for d in found if d.span == span and " needs '" in d.message]
        if len(lacking) > 2:
            names = ", ".join(_missing(d) for d in lacking)
            texts = "\n".join(f"{_missing(d)[1:-1]}: {d.help}" for d in lacking)
            one = Diagnostic(f"{lacking[0].message.split(' needs ')[0]} needs {names}", span, "these are missing", texts)
            found = [one if d is lacking[0] else d for d in found if d is lacking[0] or d not in lacking]
    return found


def without_meant(found: list[Diagnostic]) -> list[Diagnostic]:
    """Without what is missing as its name is written wrong: the wrong name says so."""
    meant = {d.label for d in found if d.message.startswith("unknown ")}
    lacking = [re.search(r" needs '(\w+)'", d.message) for d in found]
    return [d for d, match in zip(found, lacking, strict=True) if not (match and f"did you mean '{match[1]}'?" in meant)]


def _missing(diagnostic: Diagnostic) -> str:
    return diagnostic.message.rpartition(" needs ")[2]


def _one(e: Any, model: type[BaseModel], document: Document, at: Path, who: str, keys: Iterable[str], python: bool) -> Diagnostic:
    path, loc = at, []
    kind, context = e["type"], e.get("ctx", {})
    for part in e["loc"][:-1] if kind == "missing" else e["loc"]:  # leaves out tags of unions
        if (*path, part) in document.marks:
            path = (*path, part)
            loc.append(part)
    mark = document.marks[path]
    if kind == "extra_forbidden":
        owner, _ = _field(model, loc[:-1])
        options = list(keys if keys and len(loc) == 1 else (owner or model).model_fields)
        inside = who if len(loc) == 1 else f"{who}, {'.'.join(map(str, loc[:-1]))}"
        name = e["loc"][-1]
        meant = SYNONYMS.get(str(name).lower(), "")
        hint = glued(name, options) or (
            f"did you mean '{meant}'?" if meant in options else nearest(name, options, "not a known key")
        )
        message = f"unknown {'parameter' if python else 'key'} '{e['loc'][-1]}' for {inside}"
        return Diagnostic(message, mark.start, hint, f"{inside} takes: {', '.join(options)}")
    if kind == "missing":
        name = str(e["loc"][-1])
        _, field = _field(model, [*loc, name])
        unit = _unit(field)
        if python and not loc:
            label = f"add {name}={unit.example!r}" if unit and unit.unit else f"add {name}={unit.example if unit else '...'}"
        else:
            label = f"add '{name}: {unit.example}'" if unit else f"add '{name}:'"
        inside = f"{who}, {'.'.join(map(str, loc))}" if loc else who
        return Diagnostic(f"{inside} needs '{name}'", mark.start, label, _description(field))
    _, field = _field(model, loc)
    if isinstance(inner := context.get("error"), ConfigurationError) and inner.diagnostics:  # a call within
        first = inner.diagnostics[0]
        where = f"{who}, {'.'.join(map(str, loc))}" if loc else who
        return Diagnostic(f"{where}: {first.message}", mark.value, first.label, first.help)
    span, label = mark.value, context.get("label") or ""
    if caret := context.get("caret"):
        offset, length = caret
        span = span.inner(offset + 1, length) if python and isinstance(e["input"], str) else span.part(offset, length)
    message = str(context.get("error") or e["msg"])
    if kind in _LIMITS:
        message = _limit(e, _unit(field), document, path)
    elif kind == "literal_error":
        message = f"must be {context.get('expected', '')}, got {e['input']!r:.60}"
        label = nearest(e["input"], re.findall(r"'([^']*)'", context.get("expected", "")))
    elif kind == "string_pattern_mismatch":
        message = f"{e['input']!r:.60} has a character that is not allowed here"
        label = "use letters, digits and '_'" + (", '.', '+', '-' and spaces within" if " " in context.get("pattern", "") else "")
    elif kind.endswith(("_parsing", "_type", "_from_float")) and kind.split("_")[0] in _WANTED and e["msg"].startswith("Input"):
        wanted = _WANTED[kind.split("_")[0]]
        message = f"expected {_IN_PYTHON.get(wanted, wanted) if python else wanted}, got {e['input']!r:.60}"
    message = message[:1].lower() + message[1:] if not message[:2].isupper() else message
    where = f"{who}, {'.'.join(map(str, loc))}" if loc else who
    text = "\n".join(filter(None, (context.get("help"), _description(field))))
    return Diagnostic(f"{where}: {message}", span, label, text)


def glued(key: object, options: Iterable[str]) -> str:
    """What to write where a key and its value are one text: {pixel:2 arcsec}."""
    name, colon, value = str(key).partition(":")
    return f"write a space after the colon: {name}: {value}" if colon and name in options else ""


def _limit(e: Any, unit: Unit | None, document: Document, path: Path) -> str:
    """``must be at least 5 deg, got -1 deg``, in the unit that the user wrote."""
    key, words = _LIMITS[e["type"]]
    value: Any = document.value
    try:
        for part in path:
            value = value[part]
    except (TypeError, LookupError):  # a key that is there twice: its places are of one, its value of the other
        value = e["input"]
    limit = e["ctx"][key]
    shown = f"{limit}"
    if unit and unit.unit:
        shown = unit.write_in_unit_of(limit, value) if isinstance(value, str) else unit.write(limit)
    return f"must be {words} {shown}, got {value}"


def _field(model: type[BaseModel], loc: Iterable[Any]) -> tuple[type[BaseModel] | None, FieldInfo | None]:
    """The model and the field at ``loc``: what a value there is checked against."""
    owner: type[BaseModel] | None = model
    field: FieldInfo | None = None
    for part in loc:
        if owner is not None and part in owner.model_fields:
            field = described(owner)[part]
            owner = next((t for t in _types(field.annotation) if isinstance(t, type) and issubclass(t, BaseModel)), None)
    return owner, field


def _unit(field: FieldInfo | None) -> Unit | None:
    if field is None:
        return None
    everything = [*field.metadata, *(m for t in _types(field.annotation) for m in getattr(t, "__metadata__", ()))]
    return next((m for m in everything if isinstance(m, Unit)), None)


def _types(annotation: Any) -> Iterator[Any]:
    yield annotation
    for argument in get_args(annotation):
        yield from _types(argument)


def _description(field: FieldInfo | None) -> str:
    return " ".join((field.description or "").split()) if field is not None else ""
