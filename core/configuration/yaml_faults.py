"""Syntax errors of YAML, reported at the line of their cause: the parser itself stops one or more
lines below.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple


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
    problem, context = err.problem or "", err.context or ""
    mark, start = err.problem_mark, err.context_mark
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
                f"this '{bracket}' is not closed", start.line, start.column, start.column + 1, label
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
            rows, first, line, column
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
