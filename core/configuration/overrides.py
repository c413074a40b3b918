"""``--set Key.parameter=value``: changes to a pipeline file from the command line."""

from __future__ import annotations

from typing import Any

from ..registry import operators
from ..variants import LIKE
from . import yaml_places
from .diagnostics import Diagnostic, nearest
from .yaml_places import Document, Mark, Path, Source, Span


def apply(document: Document, text: str, keys: list[str]) -> list[Diagnostic]:
    """Put one ``key=value`` into the document; returns what is wrong with it.

    ``key`` is a key of the file (``seed``, ``site.altitude``), one of ``keys``; or a parameter of a
    step (``PinkNoise.knee``), which goes by its operator's name or by its own; the second of two
    namesakes is ``WhiteNoise.2.net``. Entries of a list are counted from 0, as messages do:
    ``instrument.bands.0.net``. The value is YAML.
    """
    source = Source("--set", text)
    key, equals, value = text.partition("=")
    place = Span(source, 0, 0, 0, max(1, len(key)))
    if not equals or not key.strip():
        cure = "write Key.parameter=value, e.g. --set Step.frequency='0.5 Hz' or --set seed=8"
        return [Diagnostic("a setting needs a key, '=' and a value", place, "", cure)]
    if any("\ud800" <= c <= "\udfff" for c in text):  # bytes of the command line
        cure = "write it in UTF-8; rename a file whose name is in another encoding"
        return [Diagnostic("a setting that is not UTF-8", place, "", cure)]
    new = yaml_places.load(source, column=len(key) + 1, text=value)
    if new.faults:
        return [
            Diagnostic(f.message, f.span, f.label, "the value is YAML; quote what YAML cannot read")
            for f in new.faults
        ]
    return put(document, key.strip(), new, place, keys)


def put(
    document: Document,
    key: str,
    value: Document,
    place: Span,
    keys: list[str],
) -> list[Diagnostic]:
    """Apply a value that was read already; see `apply`. ``place``: place of the key."""
    parts = key.split(".")
    try:
        path = (
            _header_path(document, parts) if parts[0] in keys else _step_path(document, key, keys)
        )
    except _Refused as why:
        message, label, cure = why.args
        return [Diagnostic(message, place, label, cure)]
    document.put(path, value, place)
    return []


class _Refused(Exception):
    """Arguments: message, label, help."""


def _header_path(document: Document, parts: list[str]) -> Path:
    if parts[0] == "operators":
        raise _Refused(
            "the list of operators cannot be set",
            "",
            "set one step's parameter: Operator.parameter=value",
        )
    here = document.value
    if parts[0] == "instrument" and len(parts) > 1 and isinstance(here.get("instrument"), str):
        here["instrument"] = {LIKE: here["instrument"]}  # a variant of the one that is named
        document.marks[("instrument", LIKE)] = document.mark(("instrument",))
    path: list[Any] = [*parts]
    for depth, part in enumerate(path[:-1], 1):
        where = ".".join(parts[:depth])
        within = parts[depth]
        if isinstance(here, dict) and part not in here and (depth == 1 or LIKE in here):
            if within.isdecimal():
                raise _Refused(
                    f"the file has no '{where}'",
                    "",
                    f"set the whole list: {where}='[...]'",
                )
            here[part] = {}
            document.marks[tuple(path[:depth])] = document.mark(tuple(path[: depth - 1]))
        here = here[path[depth - 1]] if isinstance(here, list) else here.get(part)
        if isinstance(here, list):
            if not (within.isdecimal() and int(within) < len(here)):
                cure = (
                    f"write {' or '.join(f'{where}.{k}' for k in range(len(here)))}"
                    if here
                    else f"set '{where}' itself"
                )
                raise _Refused(
                    f"'{where}' is a list of {len(here)}: its entries are counted from 0",
                    "",
                    cure,
                )
            path[depth] = int(within)
        elif not isinstance(here, dict):
            cure = f"set '{where}' itself, or write it as a mapping in the file"
            if where == "site":
                cure += ": resolved.yaml of a run has it written out, under x-resolved"
            raise _Refused(
                f"'{where}' is {'a name' if isinstance(here, str) else 'one value'}, not a mapping",
                "",
                cure,
            )
    return tuple(path)


def _step_path(document: Document, key: str, keys: list[str]) -> Path:
    steps = _steps(document)
    names = list(dict.fromkeys(name for _, labels in steps for name in labels))
    name = max((n for n in names if key.startswith(f"{n}.") or key == n), key=len, default=None)
    if name is None:
        first = key.split(".")[0]
        owners = [
            f"'{name}.{key}'"
            for name in names
            if name in operators and first in operators.get(name).model_fields
        ]
        near = (
            f"did you mean {' or '.join(owners)}?"
            if owners and "." not in key
            else nearest(first, [*names, *keys])
        )
        cure = f"it has the steps {', '.join(names)} and the keys {', '.join(keys)}"
        raise _Refused(f"nothing is called '{first}' in this pipeline", near, cure)
    same = [path for path, labels in steps if name in labels]
    parts = key[len(name) + 1 :].split(".")
    number = int(parts.pop(0)) if parts[0].isdigit() else 0
    ways = " or ".join(f"{name}.{k}" for k in range(1, len(same) + 1))
    if not number and len(same) > 1:
        raise _Refused(f"there are {len(same)} steps '{name}'", "", f"write {ways}")
    if number > len(same):
        raise _Refused(
            f"there is no step '{name}.{number}'",
            "",
            f"write {name if len(same) == 1 else ways}",
        )
    if not all(parts) or not parts:
        raise _Refused(
            f"'{key}' is a step, not a parameter",
            "add a parameter",
            f"write {key.rstrip('.')}.parameter=value",
        )
    inner = _opened(document, same[max(number, 1) - 1])
    here: Any = document.value["operators"][inner[1]][inner[2]]
    for depth, part in enumerate(["", *parts[:-1]]):
        here = here.get(part) if depth and isinstance(here, dict) else here
        if not isinstance(here, dict):
            where = ".".join([name, *parts[:depth]])
            raise _Refused(
                f"'{where}' is not a mapping",
                "",
                f"set '{where}' itself, or write it as a mapping in the file",
            )
    return (*inner, *parts)


def _steps(document: Document) -> list[tuple[Path, list[str]]]:
    """Path of each step and the names it goes by."""
    steps: list[tuple[Path, list[str]]] = []
    items = document.value.get("operators")
    for i, item in enumerate(items if isinstance(items, list) else []):
        if isinstance(item, str):
            steps.append((("operators", i), [item, item.rpartition(":")[2]]))
        elif isinstance(item, dict) and len(item) == 1:
            name, parameters = next(iter(item.items()))
            labels = [str(name), str(name).rpartition(":")[2]]
            if isinstance(parameters, dict) and isinstance(parameters.get("name"), str):
                labels.append(parameters["name"])
            steps.append((("operators", i), labels))
    return steps


def _opened(document: Document, path: Path) -> Path:
    """Path of the parameters of a step, which become a mapping where there were none."""
    item = document.value["operators"][path[1]]
    if isinstance(item, str):
        document.value["operators"][path[1]] = {item: {}}
        mark = document.marks[path]
        document.marks[(*path, item)] = Mark(mark.value, mark.value)
        return (*path, item)
    name = next(iter(item))
    if item[name] is None:
        item[name] = {}
    return (*path, name)
