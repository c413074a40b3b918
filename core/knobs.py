"""Knobs: the parameters of operators that trade accuracy for time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, cast

from pydantic import BaseModel, TypeAdapter


@dataclass(frozen=True)
class Knob:
    """One parameter that trades accuracy for time; `Planning.knobs` lists them, `zonda accuracy`
    turns them, `zonda plan` chooses among the rungs that `Planning.estimate` bounds.

    Attributes
    ----------
    parameter
        Name of the field.
    ladder
        Its values as they stand in YAML, from coarse and cheap to fine and dear; at least two. The
        last one is what the others are judged by.
    approximates
        What a coarser value does to the result: half a line, for tables.
    redraws
        True where another value draws other random numbers. Two runs then differ by more than the
        approximation, so that only means over seeds compare, and the knob is left out of joint
        searches.
    """

    parameter: str
    ladder: tuple[str | int | float, ...]
    approximates: str
    redraws: bool = False

    def values(self, model: type[BaseModel]) -> list[Any]:
        """The ladder as values of the model's field. Raises pydantic's ValidationError for one that
        the field refuses.
        """
        field = model.model_fields[self.parameter]
        adapter: TypeAdapter[Any] = TypeAdapter(
            cast(Any, Annotated[field.annotation, self.parameter, *field.metadata])
        )
        return [adapter.validate_python(value) for value in self.ladder]

    def coarser(self, model: BaseModel) -> list[Any]:
        """The rungs that are coarser than the model's own value, the finest of them first."""
        rungs, own = self.values(type(model)), getattr(model, self.parameter)
        if own in rungs:
            return rungs[: rungs.index(own)][::-1]
        rising = rungs[0] < rungs[-1]
        return [rung for rung in reversed(rungs) if (rung < own) == rising]


PRECISION = Knob("precision", ("float32", "float64"), "rounding of the time streams")
"""The one knob that belongs to a pipeline, not to an operator."""
