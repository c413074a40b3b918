"""Figures of a run as a table."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Self

from pydantic import Field, model_validator

from zonda.core.data import Data
from zonda.core.errors import InputError
from zonda.core.figures import Choice, Figure, FigureMetric, Figures
from zonda.core.output import Output, about
from zonda.core.signal import Signal
from zonda.core.storage.files import product_path

from .series import key_of, kinds_of_maps


class MeasureFigures(Output):
    """Figures of a run: the numbers that it is judged by, with units and, where they are known,
    standard errors.

    Metrics are those of the group ``zonda.metrics`` that are one number, e.g. ``central_rms`` or
    ``{transfer_at: {scale: 60 arcsec}}``. The signals that they need are made for this step, unless
    `runs` has them. Makes the product ``figures`` (a `Figures`), or one under this step's own name
    where it has one; where there is an output folder, it is written there as a table,
    ``figures.ecsv``. `Report` shows it.

    Raises `PipelineError` or `InputError` where a metric cannot be measured on what the run made.
    """

    provides = frozenset({"figures"})
    one_band = True

    metrics: list[Choice] = Field(min_length=1)
    """What to measure: names, or mappings of a name to its parameters."""

    @model_validator(mode="after")
    def _once(self) -> Self:
        names = [choice.name for choice in self.metrics]
        if twice := next((name for name in names if names.count(name) > 1), None):
            raise ValueError(f"{twice} is listed twice")
        return self

    @property
    def requires(self) -> frozenset[str]:
        """Products that the metrics read."""
        return frozenset[str]().union(*(metric.reads for metric in self._measured))

    def signals(self) -> tuple[Signal, ...]:
        """Signals that the metrics need."""
        return tuple(signal for metric in self._measured for signal in metric.needs())

    def named_signals(self) -> tuple[str, ...]:
        """Signals that parameters of the metrics name."""
        return tuple(name for metric in self._measured for name in metric.named_signals())

    def reads(self, signal: str) -> bool:
        """True if a metric reads products of that signal."""
        plain = len(self._measured) < len(self.metrics) and not signal.startswith("_")
        return plain or signal in self.shown or signal in self.named_signals()

    def check(self, data: Data) -> list[str]:
        """Raises `ZondaError` where a metric cannot be measured on the kind of map that will be
        made.
        """
        for metric in self._measured:
            metric.look(kinds_of_maps(data))
        return []

    def finalize(self, data: Data) -> None:
        """Measure, in the order of the list."""
        names = list(self.shown)
        found = []
        for choice in self.metrics:
            count = len(choice.metric.needs()) if isinstance(choice.metric, FigureMetric) else 0
            found.append(_figure(choice, data, names[:count]))
            del names[:count]
        if data.band:
            found = [replace(figure, name=f"{figure.name} {data.band}") for figure in found]
        key = key_of(self, "figures")
        figures = data.products[key] = Figures(found)
        for figure in figures:
            data.log.state(self.label, figure.name, str(figure).partition(" = ")[2])
        if data.output is not None:
            figures.write(product_path(data.output, data.named(key), ".ecsv"), about(data))

    @property
    def _measured(self) -> list[FigureMetric]:
        chosen = getattr(self, "metrics", ())  # a mistaken step of a pipeline file has none
        return [choice.metric for choice in chosen if isinstance(choice.metric, FigureMetric)]


def _figure(choice: Choice, data: Data, names: list[str]) -> Figure:
    """`Choice.figure`; NaN, with the reason, for what cannot be measured on the sum of a
    campaign's scans.
    """
    try:
        return choice.figure(data, names)
    except InputError as err:
        if not data.laid_out:
            raise
        return Figure(
            choice.name,
            math.nan,
            getattr(choice.metric, "unit", ""),
            description=f"not known: {err.message}",
        )
