"""Diagnostics: cause, place and cure of mistakes, printed with the source line and a caret."""

from __future__ import annotations

import difflib
import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, ClassVar, Self

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import PydanticCustomError, core_schema

from ..errors import InputError, ZondaError
from .yaml_places import Span


class TextValue:
    """A pydantic field type that `parse` reads and `dump` writes."""

    json_schema: ClassVar[dict[str, Any]] = {"type": "string"}

    @classmethod
    def parse(cls, value: Any) -> Self:
        """From text, or whatever else stands for such a value. Raises what `mistake` makes."""
        raise NotImplementedError

    def dump(self) -> Any:
        """Value that stands for it in files; by default its text."""
        return str(self)

    @classmethod
    def __get_pydantic_core_schema__(
        cls,
        source: Any,
        handler: GetCoreSchemaHandler,
    ) -> core_schema.CoreSchema:
        return core_schema.no_info_plain_validator_function(
            cls.parse,
            serialization=core_schema.plain_serializer_function_ser_schema(
                cls.dump,
                when_used="json",
            ),
        )

    @classmethod
    def __get_pydantic_json_schema__(
        cls,
        schema: Any,
        handler: GetJsonSchemaHandler,
    ) -> dict[str, Any]:
        return cls.json_schema


def mistake(
    message: str,
    label: str = "",
    help: str = "",
    caret: tuple[int, int] | None = None,
    at: tuple[str | int, ...] = (),
) -> PydanticCustomError:
    """Error for a validator to raise; it is shown at the value's place.

    ``caret``: (offset, length) of what is wrong in a text. ``at``: keys and indices that lead to it
    within a mapping or list.
    """
    context = {"message": message, "label": label, "help": help, "caret": caret, "at": at}
    return PydanticCustomError("mistake", "{message}", context)


def input_error(err: PydanticCustomError, place: str, cure: str = "") -> InputError:
    """Error about a value that is not in a pipeline; its own hint stands before the cure."""
    hint = (err.context or {}).get("label", "")
    return InputError(err.message(), place=place, cure="\n".join(filter(None, [hint, cure])))


def refusal(err: ZondaError, at: tuple[str | int, ...] = ()) -> PydanticCustomError:
    """Error for a validator to raise from ``err``, about its value or a place ``at`` within it."""
    if isinstance(err, ConfigurationError) and err.diagnostics:
        first = err.diagnostics[0]
        return mistake(first.message, first.label, first.help, at=at)
    return mistake(
        f"{err.place}: {err.message}" if err.place else err.message,
        getattr(err, "label", ""),
        err.cure,
        at=at,
    )


WIDTH = 140
"""Longer source lines are cut around the caret."""

_CONTROL = dict.fromkeys([*range(9), *range(10, 32), 127], "\N{REPLACEMENT CHARACTER}")
"""Control characters, which a terminal would obey, and the signs that stand for them."""


@dataclass(frozen=True)
class Diagnostic:
    """One mistake.

    Attributes
    ----------
    message
        The cause: one sentence, lower case, no full stop.
    span
        Where.
    label
        A few words behind the caret.
    help
        What is expected, or what to do.
    """

    message: str
    span: Span
    label: str = ""
    help: str = ""

    @property
    def place(self) -> str:
        """``file:line:column``, counted from 1."""
        return f"{self.span.source.name}:{self.span.line + 1}:{self.span.column + 1}"

    def render(self, colour: bool = False) -> str:
        """Several lines of text, the last with a line feed."""
        red, blue, bold, off = (
            ("\033[31;1m", "\033[34;1m", "\033[1m", "\033[0m") if colour else ("",) * 4
        )
        lines = self.span.source.text.splitlines() or [""]
        row = min(self.span.line, len(lines) - 1)
        line = lines[row]
        start = min(self.span.column, len(line))
        end = self.span.end_column if self.span.end_line == row else len(line.rstrip())
        cut = max(0, start - WIDTH // 2) if len(line) > WIDTH else 0
        shown = line[cut : cut + WIDTH]
        before = line[cut:start]
        under = line[start : min(end, cut + WIDTH)]
        indent = "".join(c if c == "\t" else " " * _columns(c) for c in before)
        caret = "^" * max(1, _columns(under))
        gutter = " " * len(str(row + 1))
        parts = [
            f"{red}error{off}{bold}: {self.message}{off}",
            f"{gutter}{blue}-->{off} {self.place}",
            f"{gutter} {blue}|{off}",
            f"{blue}{row + 1} |{off} {shown.translate(_CONTROL)}",
            (
                f"{gutter} {blue}|{off}"
                f" {indent}{red}{caret}{' ' + self.label if self.label else ''}{off}"
            ),
        ]
        if self.help:
            parts += [f"{gutter} {blue}={off} {text}" for text in self.help.splitlines()]
        return "\n".join(parts) + "\n"


def refused(err: ZondaError, span: Span) -> Diagnostic:
    """An error that says what is wrong at ``span``."""
    message = f"{err.place}: {err.message}" if err.place else err.message
    return Diagnostic(message, span, getattr(err, "label", ""), err.cure)


class ConfigurationError(ZondaError):
    """Everything that is wrong with a configuration, each with its place.

    Attributes
    ----------
    diagnostics
        In the order of the file; mistakes in overrides come last.
    """

    def __init__(self, diagnostics: Iterable[Diagnostic], place: str) -> None:
        found = sorted(
            dict.fromkeys(diagnostics),
            key=lambda d: (d.span.source.name != place, d.span.line, d.span.column),
        )
        count = f"{len(found)} mistake{'s' if len(found) != 1 else ''}"
        where = dict.fromkeys(d.span.source.name for d in found)
        super().__init__(f"{count} in {' and '.join(filter(None, where)) or place}", place="")
        self.diagnostics = found
        self.place = place

    def __reduce__(self) -> tuple[type[ConfigurationError], tuple[list[Diagnostic], str]]:
        return type(self), (self.diagnostics, self.place)

    def render(self, colour: bool = False) -> str:
        """Text of all diagnostics, with their number."""
        return "\n".join([*(d.render(colour) for d in self.diagnostics), self.message])

    def __str__(self) -> str:
        return self.render()


def nearest(word: object, options: Iterable[str], otherwise: str = "") -> str:
    """``did you mean 'option'?``, or ``otherwise`` where no option is near."""
    folded = {option.lower(): option for option in options}
    near = difflib.get_close_matches(str(word).lower(), folded, n=1, cutoff=0.6)
    return f"did you mean '{folded[near[0]]}'?" if near else otherwise


def _columns(text: str) -> int:
    """Columns that ``text`` takes on a terminal."""
    wide = sum(unicodedata.east_asian_width(c) in "WF" for c in text)
    marks = sum(unicodedata.combining(c) > 0 for c in text)
    return len(text) + wide - marks
