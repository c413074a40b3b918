"""Base class of everything a user configures: a frozen, checked set of parameters with units."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field


def quantity(default: str, **limits: Any) -> Any:
    """Default of a field with a unit: ``radius: Angle = quantity("4 arcmin", gt=0)``.

    Typed Any because the text becomes a float when the class is validated. Limits are in SI.
    """
    return Field(default, **limits)


class Parameters(BaseModel):
    """A frozen, validated parameter set. Attribute docstrings become schema descriptions and error messages."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        validate_default=True,
        use_attribute_docstrings=True,
        allow_inf_nan=False,
    )
