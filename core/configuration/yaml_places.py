"""YAML with places, and without the traps of YAML 1.1.

Stock PyYAML reads ``-11:45:09`` as an integer of base 60, ``1e3`` as text, ``on`` as true and keeps
the last of two equal keys. Here scalars follow the YAML 1.2 core schema, equal keys are errors, and
every value knows where it stands.
"""

from __future__ import annotations

import copy
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import yaml


class Cause(NamedTuple):
    """A mistake and where it stands: line and columns count from 0, the end is exclusive."""

    message: str
    line: int
    column: int
    end: int
    label: str = ""


_KEY = r"[A-Za-z_][\w.-]*"
_NO_SPACE = re.compile(rf"(?P<indent>\s*(?:-\s+)?)(?P<key>{_KEY}):(?P<rest>[^\s:/].*)")
_NO_DASH_SPACE = re.compile(r"(?P<indent>\s*)-(?P<rest>[A-Za-z_].*)")
_EQUALS = re.compile(rf"(?P<indent>\s*(?:-\s+)?)(?P<key>{_KEY})\s*=\s*(?P<rest>\S.*)")
_TWO_KEYS = re.compile(rf"(?P<indent>\s*(?:-\s+)?)(?P<key>{_KEY}):\s+(?P<rest>{_KEY}:\s.*)")
_OPENED = {"while parsing a flow mapping": "{", "while parsing a flow sequence": "["}


def causes(err: Any, text: str) -> list[Cause]:
    """The mistakes behind ``err`` (a yaml.MarkedYAMLError of ``text``); none where it is what it
    says.
    """
    rows = text.splitlines() or [""]
    problem = err.problem or ""
    context = err.context or ""
    mark = err.problem_mark
    start = err.context_mark
    if context == "while scanning a quoted scalar" and start is not None:
        label = (
            "close it; a quote within text is written twice"
            if rows[start.line][start.column] == "'"
            else "close it"
        )
        return [
            Cause("this quote is not closed", start.line, start.column, start.column + 1, label)
        ]
    if context in _OPENED and start is not None and mark is not None:
        bracket = _OPENED[context]
        closing = {"{": "}", "[": "]"}[bracket]
        label = f"'{closing}' or a comma is missing behind it"
        return [
            Cause(
                f"this '{bracket}' is not closed",
                start.line,
                start.column,
                start.column + 1,
                label,
            )
        ]
    line = min(mark.line if mark is not None else 0, len(rows) - 1)
    column = mark.column if mark is not None else 0
    if problem == "found character that cannot start any token" and column < len(rows[line]):
        character = rows[line][column]
        if character == "\t":
            return [
                Cause(
                    "a tab stands in the indentation",
                    line,
                    column,
                    column + 1,
                    "indent with spaces, not tabs",
                )
            ]
        label = f"put the text between quotes: '{character}...'"
        return [Cause(f"text may not begin with {character} here", line, column, column + 1, label)]
    if "expected ':'" in problem or "mapping values are not allowed" in problem:
        first = start.line if start is not None else None
        return list(_unread(rows, line if first is None else first)) or _otherwise(
            rows,
            first,
            line,
            column,
        )
    if problem == "did not find expected '-' indicator" and column < len(rows[line]):
        end = len(rows[line].rstrip())
        return [
            Cause(
                "this stands among steps that begin with '- '",
                line,
                column,
                end,
                "begin it with '- ', or indent it further",
            )
        ]
    if problem == "did not find expected key" and column < len(rows[line]):
        label = "indent it as the keys above"
        return [
            Cause(
                "this line is indented neither as its neighbours nor under them",
                line,
                column,
                len(rows[line]),
                label,
            )
        ]
    return []


def _unread(rows: Sequence[str], line: int) -> Iterator[Cause]:
    """Lines from ``line`` upwards that were taken for text as they lack a space or a colon, from
    the top.
    """
    above: list[Cause] = []
    for k in range(line, -1, -1):
        bare = rows[k].strip()
        if not bare or bare.startswith("#"):
            continue
        found = missing_space(rows[k], k)
        if found is None and k < line:
            break
        if found is not None:
            above.append(found)
    yield from reversed(above)


def missing_space(row: str, line: int) -> Cause | None:
    """``site:green_bank``, ``-BinMap``, ``site = green_bank``."""
    if match := _NO_SPACE.fullmatch(row):
        label = f"write a space after the colon: {match['key']}: {match['rest']:.40}"
        return Cause(
            f"'{match['key']}:' has no space behind it",
            line,
            match.end("key"),
            match.end("key") + 1,
            label,
        )
    if match := _NO_DASH_SPACE.fullmatch(row):
        at = match.end("indent")
        return Cause(
            "'-' has no space behind it",
            line,
            at,
            at + 1,
            f"write a space after the dash: - {match['rest']:.40}",
        )
    if match := _EQUALS.fullmatch(row):
        at = row.index("=", match.end("key"))
        label = f"write a colon and a space: {match['key']}: {match['rest']:.40}"
        return Cause(f"'{match['key']}' is set by ':', not by '='", line, at, at + 1, label)
    return None


def _otherwise(rows: Sequence[str], first: int | None, line: int, column: int) -> list[Cause]:
    """Two keys on one line, or a line without a key."""
    if match := _TWO_KEYS.fullmatch(rows[line]):
        label = (
            f"write {match['key']}: {{{match['rest']:.40}}}, or begin a new line that is indented"
            " further"
        )
        return [Cause("two keys on one line", line, column, column + 1, label)]
    row = rows[min(first, len(rows) - 1)] if first is not None else ""
    bare = row.strip()
    if first is not None and bare and ":" not in bare:
        at = len(row) - len(row.lstrip())
        label = f"write '- {bare:.40}' for a step, '{bare:.40}: ...' for a key"
        return [Cause("this line is neither a step nor a key", first, at, len(row.rstrip()), label)]
    return []


Path = tuple[Any, ...]
"""Keys and indices that lead to a value: ("operators", 2, "BinMap", "pixel")."""

MAXIMUM_VALUES = 100_000
"""More values than this (nested aliases and merges multiply) are refused."""
MAXIMUM_DEPTH = 64
"""Lists and mappings nested deeper are refused: what reads them recurses, libyaml's C code without
a net.
"""
MAXIMUM_DIGITS = 64
"""Integers of more digits are refused: nothing here is as large, and Python would not write them.
"""


@dataclass(frozen=True)
class Source:
    """A text and what to call it: a file's path, or ``--set``."""

    name: str
    text: str


@dataclass(frozen=True)
class Span:
    """A part of a source; lines and columns count from 0, the end is exclusive."""

    source: Source
    line: int = 0
    column: int = 0
    end_line: int = 0
    end_column: int = 1

    def part(self, offset: int, length: int) -> Span:
        """``length`` characters from ``offset`` on, where the span lies on one line and is not
        quoted.
        """
        rows = self.source.text.splitlines()
        first = rows[self.line][self.column : self.column + 1] if self.line < len(rows) else ""
        if self.line != self.end_line or first in ("'", '"'):
            return self
        return Span(
            self.source,
            self.line,
            self.column + offset,
            self.line,
            self.column + offset + length,
        )


@dataclass(frozen=True)
class Mark:
    """Places of a value and of its key."""

    value: Span
    key: Span | None = None

    @property
    def start(self) -> Span:
        """The key where there is one, else the value."""
        return self.key or self.value


@dataclass(frozen=True)
class Fault:
    """Something that is not valid YAML, or not in this file format."""

    message: str
    span: Span
    label: str = ""


@dataclass
class Document:
    """Plain dictionaries, lists and scalars; a `Mark` for every path in them; and what is wrong
    with the text.
    """

    value: Any
    marks: dict[Path, Mark]
    faults: list[Fault]

    def mark(self, path: Path) -> Mark:
        """Mark of the value at ``path``, or of the nearest one above it."""
        while path and path not in self.marks:
            path = path[:-1]
        return self.marks[path]

    def copy(self) -> Document:
        """A document of its own with the same content."""
        return Document(copy.deepcopy(self.value), dict(self.marks), list(self.faults))

    def sub(self, path: Path) -> Document:
        """The value at ``path`` as a document of its own."""
        value = self.value
        for part in path:
            value = value[part]
        marks = {p[len(path) :]: m for p, m in self.marks.items() if p[: len(path)] == path}
        return Document(copy.deepcopy(value), {(): self.mark(path), **marks}, [])

    def put(self, path: Path, value: Document, key: Span) -> None:
        """Replace or add the value at ``path``, whose parent must be a mapping or a list."""
        parent = self.value
        for part in path[:-1]:
            parent = parent[part]
        parent[path[-1]] = value.value
        self.marks = {p: m for p, m in self.marks.items() if p[: len(path)] != path}
        self.marks |= {(*path, *p): m for p, m in value.marks.items()}
        self.marks[path] = Mark(value.marks[()].value, key)


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    yaml_implicit_resolvers: dict[str, list[Any]] = {}  # noqa: RUF012


class _Dumper(yaml.SafeDumper):
    yaml_implicit_resolvers: dict[str, list[Any]] = {}  # noqa: RUF012

    def ignore_aliases(self, data: Any) -> bool:
        return True

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        super().increase_indent(flow, False)


_FLOAT = (
    r"^[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?$"
    r"|^[-+]?\.(?:inf|Inf|INF)$|^\.(?:nan|NaN|NAN)$"
)
for _class in (_Loader, _Dumper):
    for _tag, _pattern, _first in [
        ("bool", r"^(?:true|True|TRUE|false|False|FALSE)$", "tTfF"),
        ("merge", r"^<<$", "<"),
        ("null", r"^(?:~|null|Null|NULL|)$", ["~", "n", "N", ""]),
        ("int", r"^(?:[-+]?[0-9]+|0x[0-9a-fA-F]+|0o[0-7]+)$", "-+0123456789"),
        ("float", _FLOAT, "-+0123456789."),
    ]:
        _class.add_implicit_resolver(
            f"tag:yaml.org,2002:{_tag}",
            re.compile(_pattern),
            list(_first),
        )


def _integer(loader: Any, node: Any) -> int:
    text = loader.construct_scalar(node)
    if len(text) > MAXIMUM_DIGITS:
        raise ValueError(f"a number of {len(text)} digits")
    return int(text, {"0x": 16, "0o": 8}.get(text[:2].lower(), 10))


_Loader.add_constructor("tag:yaml.org,2002:int", _integer)


def load(
    source: Source,
    *,
    column: int = 0,
    text: str | None = None,
    longest: Mapping[str, int] | None = None,
) -> Document:
    """Read a YAML document from ``text`` (default: all of the source), whose first line begins at
    ``column``.

    ``longest``: items that the list under a key of the top level may have; of a longer one nothing
    is built. Never raises for bad text: what is wrong is in `Document.faults`, and what could be
    read in its value.
    """
    reader = _Reader(source, column, source.text if text is None else text)
    try:
        loader = _Loader(reader.text)
    except yaml.YAMLError as err:  # a character that YAML does not allow
        reader.fault(err)
        return reader.document(None)
    try:
        reader.survey(reader.text, longest or {})
        node = loader.get_single_node()
        value = reader.build(loader, node, (), None, ()) if node is not None else None
    except yaml.YAMLError as err:
        reader.fault(err)
        value = None
    finally:
        loader.dispose()
    return reader.document(value)


def dump(value: Any) -> str:
    """YAML text that `load` reads back to the same value."""
    return yaml.dump(
        value,
        Dumper=_Dumper,
        sort_keys=False,
        allow_unicode=True,
        width=10_000,
        default_flow_style=False,
    )


class _TooMany(yaml.YAMLError):
    pass


class _TooLong(yaml.YAMLError):
    """The list under a key of the top level: the key's event, and how many items it may have."""

    def __init__(self, key: Any, most: int) -> None:
        super().__init__(f"{key.value} has more than {most} items")
        self.key = key
        self.most = most


def _too_deep(mark: Any) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(
        problem=f"nested deeper than {MAXIMUM_DEPTH} levels",
        problem_mark=mark,
    )


_PLAIN = frozenset(
    f"tag:yaml.org,2002:{tag}"
    for tag in ("str", "int", "float", "bool", "null", "merge", "seq", "map")
)
_MERGE = "tag:yaml.org,2002:merge"
_OPENING = (yaml.SequenceStartEvent, yaml.MappingStartEvent)
_CLOSING = (yaml.SequenceEndEvent, yaml.MappingEndEvent)


class _Reader:
    def __init__(self, source: Source, column: int, text: str) -> None:
        self.source = source
        self.column = column
        self.text = text
        self.marks: dict[Path, Mark] = {}
        self.faults: list[Fault] = []
        self.flat: dict[int, list[tuple[Any, Any]]] = {}
        self.merged = 0

    def survey(self, text: str, longest: Mapping[str, int]) -> None:
        """Count values and depth event by event, without recursion, before anything is built.
        Raises yaml.YAMLError.
        """
        depth = members = items = 0
        key, limit = None, math.inf  # of the top level
        for values, event in enumerate(yaml.parse(text, Loader=_Loader)):
            closes = isinstance(event, _CLOSING)
            if depth == 1 and not closes:
                members += 1
                if members % 2:
                    key = event
                else:
                    listed = isinstance(event, yaml.SequenceStartEvent)
                    items = 0
                    limit = (
                        longest.get(getattr(key, "value", None) or "", math.inf)
                        if listed
                        else math.inf
                    )
            elif depth == 2 and not closes:
                items += 1
                if items > limit:
                    raise _TooLong(key, int(limit))
            depth += isinstance(event, _OPENING) - closes
            if depth > MAXIMUM_DEPTH:
                raise _too_deep(event.start_mark)
            if values > 2 * MAXIMUM_VALUES:  # a list or mapping makes two events
                raise _TooMany(f"more than {MAXIMUM_VALUES} values")

    def document(self, value: Any) -> Document:
        self.marks.setdefault(
            (),
            Mark(Span(self.source, 0, self.column, 0, max(self.column + 1, len(self.source.text)))),
        )
        return Document(value, self.marks, self.faults)

    def span(self, node: Any) -> Span:
        a = node.start_mark
        b = node.end_mark
        shift = self.column if a.line == 0 else 0
        end_shift = self.column if b.line == 0 else 0
        return Span(self.source, a.line, a.column + shift, b.line, b.column + end_shift)

    def fault(self, err: yaml.YAMLError) -> None:
        if isinstance(err, _TooMany):
            self.faults.append(Fault(str(err), Span(self.source)))
        elif isinstance(err, _TooLong):
            self.faults.append(Fault(str(err), self.span(err.key), f"write at most {err.most}"))
        elif isinstance(err, yaml.MarkedYAMLError):
            mark = err.problem_mark or err.context_mark
            rows = self.source.text.splitlines() or [""]
            line, column = (mark.line, mark.column) if mark else (0, 0)
            column += self.column if line == 0 else 0
            if line >= len(rows):  # past the end
                line = len(rows) - 1
                column = len(rows[-1])

            found = causes(err, self.text)
            for cause in found:
                shift = self.column if cause.line == 0 else 0
                span = Span(
                    self.source,
                    cause.line,
                    cause.column + shift,
                    cause.line,
                    cause.end + shift,
                )
                self.faults.append(Fault(cause.message, span, cause.label))
            if found:
                return
            message = f"not valid YAML: {err.problem or err.context}"
            row = rows[line]
            label = "indent with spaces, not tabs" if "\t" in row[: column + 1] else ""
            self.faults.append(
                Fault(message, Span(self.source, line, column, line, column + 1), label)
            )
        else:
            at = getattr(err, "position", 0)
            line = self.source.text.count("\n", 0, at)
            column = at - (self.source.text.rfind("\n", 0, at) + 1)
            reason = f"not valid YAML: {getattr(err, 'reason', err)}"
            self.faults.append(Fault(reason, Span(self.source, line, column, line, column + 1)))

    def build(
        self,
        loader: Any,
        node: Any,
        path: Path,
        key: Span | None,
        above: tuple[int, ...],
    ) -> Any:
        span = self.span(node)
        if id(node) in above:
            self.faults.append(Fault("an alias may not stand inside what it names", span))
            return None
        if len(self.marks) > MAXIMUM_VALUES:
            raise _TooMany(f"more than {MAXIMUM_VALUES} values")
        if len(path) > MAXIMUM_DEPTH:
            raise _too_deep(node.start_mark)
        self.marks[path] = Mark(span, key)
        above = (*above, id(node))
        if node.tag not in _PLAIN:
            tag = node.tag.replace("tag:yaml.org,2002:", "!!")
            self.faults.append(
                Fault(
                    f"the tag {tag:.60} is not known",
                    span,
                    "leave it away: nothing here needs one",
                )
            )
            return None
        if isinstance(node, yaml.SequenceNode):
            return [
                self.build(loader, item, (*path, i), None, above)
                for i, item in enumerate(node.value)
            ]
        if isinstance(node, yaml.MappingNode):
            return self.mapping(loader, node, path, above)
        return self.scalar(loader, node)

    def mapping(self, loader: Any, node: Any, path: Path, above: tuple[int, ...]) -> dict[Any, Any]:
        first: dict[str, Any] = {}
        for key, _ in node.value:  # before merging, where the same key is an override
            if isinstance(key, yaml.ScalarNode) and key.tag != _MERGE:
                if key.value in first:
                    line = first[key.value].start_mark.line + 1
                    self.faults.append(
                        Fault(
                            f"duplicate key '{key.value}'",
                            self.span(key),
                            f"first given on line {line}",
                        )
                    )
                first.setdefault(key.value, key)
        result: dict[Any, Any] = {}
        for key, value in self.flattened(node):
            if not isinstance(key, yaml.ScalarNode):
                self.faults.append(Fault("a key must be plain text", self.span(key)))
                continue
            name = key.value if key.tag != "tag:yaml.org,2002:str" else self.scalar(loader, key)
            result[name] = self.build(loader, value, (*path, name), self.span(key), above)
        return result

    def flattened(self, node: Any) -> list[tuple[Any, Any]]:
        """Keys and values of a mapping, those merged by ``<<`` first; each key once where it is
        merged, nearer ones win.

        PyYAML's own repeats merged keys: eight lines of them fill the memory.
        """
        if id(node) in self.flat:
            return self.flat[id(node)]
        self.flat[id(node)] = []  # what merges itself finds nothing
        merged: dict[Any, tuple[Any, Any]] = {}
        own = []
        for key, value in node.value:
            if not (isinstance(key, yaml.ScalarNode) and key.tag == _MERGE):
                own.append((key, value))
                continue
            for part in reversed(value.value) if isinstance(value, yaml.SequenceNode) else [value]:
                if not isinstance(part, yaml.MappingNode):
                    self.faults.append(Fault("only mappings can be merged", self.span(part)))
                    continue
                merged |= {
                    k.value if isinstance(k, yaml.ScalarNode) else id(k): (k, v)
                    for k, v in self.flattened(part)
                }
        self.merged += len(merged)
        if self.merged > MAXIMUM_VALUES:
            raise _TooMany(f"more than {MAXIMUM_VALUES} values")
        self.flat[id(node)] = [*merged.values(), *own]
        return self.flat[id(node)]

    def scalar(self, loader: Any, node: Any) -> Any:
        try:
            return loader.construct_object(node, deep=True)
        except (
            ValueError,
            LookupError,
        ) as err:  # e.g. an integer of more digits than Python reads, !!bool maybe
            self.faults.append(Fault(f"cannot be read: {err}", self.span(node)))
        except yaml.MarkedYAMLError as err:  # a lone <<, a text that is said to be a list
            self.fault(err)
        return None
