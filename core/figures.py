"""Figures of a run: single numbers with a unit and, where it is known, a standard error.

A metric that measures one is a subclass of `FigureMetric` in the entry-point group
``zonda.metrics``: its fields are its parameters, as an operator's are. It is named in three ways:
``central_rms``, ``{central_rms: {radius: 30 arcsec}}`` in YAML, and ``central_rms(radius=30
arcsec)`` as text. A function of `Data` that returns one number is a metric, too.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from pydantic_core import PydanticCustomError

from .accuracy.metrics import Metric, OfFunction, get
from .configuration.diagnostics import TextValue, mistake, refusal
from .configuration.parameters import Parameters
from .data import Data
from .errors import InputError, PipelineError, ZondaError
from .signal import Signal
from .tables import Table, html_table
from .types import Floats


@dataclass(frozen=True)
class Figure:
    """A number that characterizes a run.

    Attributes
    ----------
    name
        The metric with its parameters, e.g. ``central_rms(radius=30 arcsec)``.
    value, error
        Value and its standard error, in ``unit``; the error is NaN where it is not known.
    unit
        Empty for a pure number.
    description
        What was measured, in a sentence.
    """

    name: str
    value: float
    unit: str = ""
    error: float = math.nan
    description: str = ""

    def __float__(self) -> float:
        return self.value

    def __str__(self) -> str:
        error = f" +- {self.error:.2g}" if math.isfinite(self.error) else ""
        return f"{self.name} = {self.value:.5g}{error} {self.unit}".rstrip()


class FigureMetric(Metric, Parameters):
    """Base of metrics that are one number: `find` is required.

    ``reads`` says on which products it is measured: ``map``, ``spectrum`` ...
    """

    says: ClassVar[str] = "relative change"
    reads: ClassVar[frozenset[str]] = frozenset({"map"})

    @property
    def unit(self) -> str:
        """Unit of the number; empty for a pure number."""
        return ""

    def needs(self) -> tuple[Signal, ...]:
        """The signals of which it reads products, beside those in `named_signals`."""
        return ()

    def named_signals(self) -> tuple[str, ...]:
        """Names of the signals of the pipeline of which it reads products; empty text: the complete
        one.
        """
        return ("",)

    def look(self, kinds: Mapping[str, str]) -> None:
        """Raise `ZondaError` before a run whose maps are of these kinds, by product: its
        projection, HEALPix, or hits.
        """

    def find(self, data: Data, names: Sequence[str]) -> tuple[float, float]:
        """(value, standard error or NaN), in `unit`. ``names``: those of the signals in `needs`, in
        their order.

        Raises `ZondaError` where the products are not there.
        """
        raise NotImplementedError

    def describe(self, data: Data, names: Sequence[str]) -> str:
        """Description of the measurement, in a sentence."""
        return (type(self).__doc__ or "").split("\n\n")[0].strip().rstrip(".")

    # ---- as a metric of `zonda accuracy`

    def signals(self, runs: Mapping[str, Signal]) -> Mapping[str, Signal]:
        """Names in `needs` that the pipeline does not have."""
        return {
            f"for_figure_{k}": signal
            for k, signal in enumerate(self.needs())
            if signal not in runs.values()
        }

    def measure(self, data: Data) -> Floats:
        """(2,): value and standard error."""
        return np.array(self.find(data, names_of(data, self.needs())), np.float64)

    def summary(self, found: Floats) -> Floats:
        return found[:1]

    def floor(self, reference: Floats) -> float | None:
        """The standard error, relative to the value."""
        share = abs(float(reference[1] / reference[0])) if reference[0] else math.nan
        return share if math.isfinite(share) else None


def names_of(data: Data, wanted: Sequence[Signal]) -> list[str]:
    """Names of the signals of a run that are like ``wanted``; empty text: the complete one.

    Raises `PipelineError` where the run has none.
    """
    runs = {name: Signal(**given) for name, given in data.provenance.get("runs", {}).items()}
    components = {c for o in data.observations for c in getattr(o, "components", ())}
    found = []
    for signal in wanted:
        name = next((name for name, run in runs.items() if run == signal), None)
        if (
            name is None
            and signal.only is not None
            and components
            and components <= set(signal.only)
            and signal.filters == "all"
        ):
            name = ""
        if name is None:
            what = ", ".join(
                f"{key}: {value}" for key, value in signal.model_dump(exclude_defaults=True).items()
            )
            raise PipelineError(
                f"the run has no signal {{{what}}}",
                place="metric",
                cure=f"add it to runs, e.g. `runs: {{a: {{{what}}}}}`",
            )
        found.append(name)
    return found


class Choice(TextValue):
    """A metric and the name under which it was asked for: ``central_rms``, a mapping of one name to
    parameters, or a metric.
    """

    json_schema: ClassVar[dict[str, Any]] = {
        "anyOf": [{"type": "string"}, {"type": "object", "maxProperties": 1}]
    }

    def __init__(self, name: str, metric: Metric) -> None:
        self.metric = metric
        given = (
            metric.model_dump(mode="json", include=metric.model_fields_set)
            if isinstance(metric, FigureMetric)
            else {}
        )
        self.name = (
            f"{name}({', '.join(f'{key}={value}' for key, value in given.items())})"
            if given
            else name
        )

    @classmethod
    def parse(cls, value: Any) -> Self:
        """From YAML, text or a `FigureMetric`."""
        if isinstance(value, cls):
            return value
        if isinstance(value, FigureMetric):
            return cls(value.own_name(), value)
        try:
            if isinstance(value, str):
                return cls(*_of_one_run(value.partition("(")[0].strip(), get(value)))
            if isinstance(value, Mapping) and len(value) == 1:
                name, given = next(iter(value.items()))
                return cls(*_of_one_run(str(name), get(str(name), given or {})))
        except ZondaError as err:
            raise refusal(err) from None
        raise mistake(
            f"cannot read {value!r:.60} as a metric; write its name, or {{name: {{parameter:"
            " value}}"
        )

    @classmethod
    def of(cls, value: Any) -> Self:
        """A choice that is given in Python: `parse`, but raises InputError."""
        try:
            return cls.parse(value)
        except PydanticCustomError as err:
            told = err.context or {}
            message = err.message().removeprefix("metric: ")
            cure = str(told.get("help") or told.get("label", ""))
            raise InputError(message, place="metric", cure=cure) from None

    def __str__(self) -> str:
        return self.name

    def __repr__(self) -> str:
        return repr(self.name)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Choice) and other.name == self.name

    def __hash__(self) -> int:
        return hash(self.name)

    def figure(self, data: Data, names: Sequence[str] | None = None) -> Figure:
        """Its value for a run. ``names``: of the signals that it needs; None: those of the run that
        are like them.
        """
        if isinstance(self.metric, FigureMetric):
            names = names_of(data, self.metric.needs()) if names is None else names
            value, error = self.metric.find(data, names)
            return Figure(
                self.name,
                float(value),
                self.metric.unit,
                float(error),
                self.metric.describe(data, names),
            )
        found = self.metric.summary(self.metric.measure(data))
        if found.size != 1:
            cure = "choose one that is one number, or name it in zonda accuracy --metric"
            raise PipelineError(
                f"{self.name} is {found.size} numbers, not a figure",
                place=self.name,
                cure=cure,
            )
        says = (
            self.metric.function.__doc__
            if isinstance(self.metric, OfFunction)
            else type(self.metric).__doc__
        )
        return Figure(self.name, float(found[0]), "", math.nan, (says or "").strip().split("\n")[0])


def _of_one_run(name: str, metric: Metric) -> tuple[str, Metric]:
    """Name and metric. Raises InputError for one that is an error between two runs."""
    if metric.instead is not None:
        message = f"{name} is an error of one run against another, not a figure of one"
        raise InputError(message, place="metric", cure=metric.instead)
    return name, metric


def measure(data: Data, metric: str | FigureMetric, **parameters: Any) -> Figure:
    """A figure of a finished run: ``zonda.measure(data, "central_rms", radius="30 arcsec").value``.

    Raises `ZondaError` for a metric that there is not, parameters that are wrong, or products that
    the run has not.
    """
    if isinstance(metric, FigureMetric):
        return Choice(metric.own_name(), metric).figure(data)
    return Choice(*_of_one_run(metric.partition("(")[0].strip(), get(metric, parameters))).figure(
        data
    )


COLUMNS = {
    "name": "metric and parameters",
    "value": "in `unit`",
    "error": "standard error, in `unit`; nan: not known",
    "unit": "empty: a pure number",
    "description": "what was measured",
}


class Figures:
    """The figures of a run in their order: iterate over them, or take one by its name."""

    def __init__(self, figures: Iterable[Figure]) -> None:
        self._known = {figure.name: figure for figure in figures}

    def __iter__(self) -> Iterator[Figure]:
        return iter(self._known.values())

    def __len__(self) -> int:
        return len(self._known)

    def __getitem__(self, name: str) -> Figure:
        """Find a figure by name, however its parameters are ordered. Raises KeyError if there is
        none.
        """
        with suppress(ValueError):  # what is no metric any more has the name that it was given
            name = name if name in self._known else Choice.parse(name).name
        if name not in self._known:
            raise KeyError(f"no figure {name!r}: there are {', '.join(self._known)}")
        return self._known[name]

    def write(self, path: str | Path, meta: Mapping[str, Any]) -> Path:
        """An ECSV table that `astropy.table.Table.read` knows: name, value, error, unit,
        description.
        """
        return Table.of([vars(figure) for figure in self], COLUMNS, meta).write(path)

    def _repr_html_(self) -> str:
        return html_table("Figures", [(f.name, str(f).partition(" = ")[2]) for f in self])
