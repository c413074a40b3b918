"""Values that are written as text, and what a validator raises where one is mistaken."""

from __future__ import annotations

from typing import Any, ClassVar, Self

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import PydanticCustomError, core_schema

from ..errors import ZondaError
from .diagnostics import ConfigurationError


class TextValue:
    """A pydantic field type that `parse` reads and ``str`` writes."""

    json_schema: ClassVar[dict[str, Any]] = {"type": "string"}

    @classmethod
    def parse(cls, value: Any) -> Self:
        """From text, or whatever else stands for such a value. Raises what `mistake` makes."""
        raise NotImplementedError

    @classmethod
    def __get_pydantic_core_schema__(
        cls, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        return core_schema.no_info_plain_validator_function(
            cls.parse,
            serialization=core_schema.plain_serializer_function_ser_schema(str, when_used="json"),
        )

    @classmethod
    def __get_pydantic_json_schema__(
        cls, schema: Any, handler: GetJsonSchemaHandler
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
