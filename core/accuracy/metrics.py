"""Metrics: a metric turns the products of a run into numbers, and two runs into one relative error.

A metric is a subclass of `Metric` in the entry-point group ``zonda.metrics``, or just a function
there that takes a `Data` and returns a number or an array: its error is then |m - m0| / |m0|
(Euclidean norms).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from .. import registry
from ..configuration import yaml_places
from ..configuration.parameters import Parameters
from ..configuration.pipeline_file import PipelineFile
from ..data import Data
from ..errors import InputError, PipelineError
from ..operator import Operator
from ..signal import Signal
from ..types import Floats


class Metric:
    """Base of metrics. `measure` is required; the rest has defaults for a metric that is a number
    or an array.

    Class attributes
    ----------------
    says
        Meaning of the error, half a line.
    needs_end
        True where `measure` reads products of an `Output` (plots, reports); these are left out
        otherwise.
    reads
        Streams and products on which it is measured: ``map``, ``spectrum`` ...
    instead
        Of a metric that is no number of one run, only an error between two: what to measure of one
        run in its place. None: a number of one run.
    """

    says: ClassVar[str] = "|m - m0| / |m0|"
    needs_end: ClassVar[bool] = False
    reads: ClassVar[frozenset[str]] = frozenset()
    instead: ClassVar[str | None] = None

    def check(self, operators: Sequence[Operator], runs: Mapping[str, Signal]) -> None:
        """Raise `PipelineError` where a pipeline of these steps and signals cannot have this
        metric: no step makes what it ``reads``.
        """
        made = frozenset[str]().union(*(o.provides for o in operators))
        for what in sorted(self.reads - made):
            found = " or ".join(registry.makers(what))
            cure = f"add {found}" if found else "choose another metric"
            raise PipelineError(
                f"the metric {self.own_name()} needs {what}, which no step makes",
                place="--metric",
                cure=cure,
            )

    def signals(self, runs: Mapping[str, Signal]) -> Mapping[str, Signal]:
        """Signals that `measure` reads beside those of the pipeline, ``runs``. They are not
        timed.
        """
        return {}

    def steps(self, operators: list[Operator]) -> list[Operator]:
        """The steps to measure with: more than the pipeline's own where the metric needs more. They
        are not timed.
        """
        return operators

    def measure(self, data: Data) -> Any:
        """Measure a run: anything that can be pickled."""
        raise NotImplementedError

    def error(self, found: Any, reference: Any) -> float:
        """Relative error of one run against another with the same random numbers; 0 only where they
        are alike.
        """
        a = self.summary(found)
        b = self.summary(reference)
        size = float(np.linalg.norm(b))
        return float(np.linalg.norm(a - b)) / size if size > 0 else float(np.any(a != b))

    def errors(self, found: Any, reference: Any) -> Mapping[str, float]:
        """`error` by the names of parts of which the largest counts (bands, planes of a map); empty
        where there is one part.
        """
        return {}

    def mean_error(self, found: Sequence[Any], reference: Sequence[Any]) -> tuple[float, float]:
        """(E, R): change of the mean over seeds of `summary`, relative, and its standard error,
        equation (1).

        With d_s the difference of the two summaries at seed s (n values each), m the mean summary
        of the reference,

            E^2 = mean_n (mean_s d)^2 / mean_n m^2,
            R^2 = mean_n (var_s d / S) / mean_n m^2                   (1)

        What the same seed leaves in common in both cancels in d.
        """
        a, b = (np.array([self.summary(f) for f in runs]) for runs in (found, reference))
        size = np.mean(b.mean(0) ** 2)
        count = len(a)
        d = a - b
        error = np.mean(d.mean(0) ** 2) / size
        resolution = np.mean(d.var(0, ddof=1) / count) / size if count > 1 else np.inf
        return float(np.sqrt(error)), float(np.sqrt(resolution))

    def summary(self, found: Any) -> Floats:
        """(n,) numbers whose means over seeds are compared where the random numbers differ."""
        return np.atleast_1d(np.asarray(found, np.float64)).ravel()

    def floor(self, reference: Any) -> float | None:
        """The instrument's noise in units of the error; None where it has no meaning."""
        return None

    @classmethod
    def own_name(cls) -> str:
        """Name of the class in snake case: ``CentralRms`` is ``central_rms``."""
        return "".join(
            f"_{c.lower()}" if c.isupper() and k else c.lower() for k, c in enumerate(cls.__name__)
        )


class OfFunction(Metric):
    """A plain function of `Data`."""

    def __init__(self, function: Callable[[Data], Any]) -> None:
        self.function = function

    def measure(self, data: Data) -> Floats:
        return np.asarray(self.function(data), np.float64)


class OfParts(Metric):
    """Base of metrics whose `measure` finds something of each part, by its name: planes of a map,
    bands of a camera. The largest error of the parts counts.

    A subclass has `floor_of` of one part, and `summary` or both of `between` and `mean_between`;
    `counted`, where not all parts of a reference count.
    """

    def error(self, found: Mapping[str, Any], reference: Mapping[str, Any]) -> float:
        return max(self._each(found, reference).values())

    def errors(self, found: Mapping[str, Any], reference: Mapping[str, Any]) -> Mapping[str, float]:
        each = self._each(found, reference)
        return each if len(each) > 1 else {}

    def mean_error(self, found: Sequence[Any], reference: Sequence[Any]) -> tuple[float, float]:
        every = [*map(self.counted, reference), *found]
        return max(
            self.mean_between([one[part] for one in found], [one[part] for one in reference])
            for part in self.counted(reference[0])
            if all(part in counted for counted in every)
        )

    def floor(self, reference: Mapping[str, Any]) -> float | None:
        """The lowest of all parts; None where one has none."""
        floors = [self.floor_of(reference[part]) for part in self.counted(reference)]
        known = [floor for floor in floors if floor is not None]
        return min(known) if len(known) == len(floors) else None

    def counted(self, reference: Mapping[str, Any]) -> Sequence[str]:
        """The parts of a reference in which errors are looked for."""
        return list(reference)

    def between(self, found: Any, reference: Any) -> float:
        """`error` of one part."""
        return super().error(found, reference)

    def mean_between(self, found: Sequence[Any], reference: Sequence[Any]) -> tuple[float, float]:
        """`mean_error` of one part."""
        return super().mean_error(found, reference)

    def floor_of(self, reference: Any) -> float | None:
        """`floor` of one part."""
        raise NotImplementedError

    def _each(self, found: Mapping[str, Any], reference: Mapping[str, Any]) -> dict[str, float]:
        return {
            part: self.between(found[part], reference[part])
            for part in self.counted(reference)
            if part in found
        }


class OfBands(OfParts):
    """A metric of each band of a camera."""

    def __init__(self, each: Metric) -> None:
        self.each = each
        self.says = f"{each.says}; the largest of all bands"  # type: ignore[misc]
        self.needs_end = each.needs_end  # type: ignore[misc]
        self.reads = each.reads  # type: ignore[misc]

    def check(self, operators: Sequence[Operator], runs: Mapping[str, Signal]) -> None:
        self.each.check(operators, runs)

    def signals(self, runs: Mapping[str, Signal]) -> Mapping[str, Signal]:
        return self.each.signals(runs)

    def steps(self, operators: list[Operator]) -> list[Operator]:
        return self.each.steps(operators)

    def measure(self, data: Data) -> dict[str, Any]:
        return {band: self.each.measure(own) for band, own in data.bands.items()}

    def between(self, found: Any, reference: Any) -> float:
        return self.each.error(found, reference)

    def mean_between(self, found: Sequence[Any], reference: Sequence[Any]) -> tuple[float, float]:
        return self.each.mean_error(found, reference)

    def floor_of(self, reference: Any) -> float | None:
        return self.each.floor(reference)


def metric_of(file: PipelineFile, name: str) -> Metric:
    """The metric that ``name`` stands for, of each band where the file's camera has several. Raises
    as `get`.
    """
    found = get(name)
    return OfBands(found) if file.scene().instrument.bands else found


def get(name: str, parameters: Mapping[str, Any] | None = None) -> Metric:
    """The metric that ``name`` stands for: a name, or name(parameter=value, ...) with values as in
    YAML.

    ``parameters``: more of them. Raises `RegistryError` with the nearest name where there is none,
    `ParameterError` for parameters that are wrong, `InputError` where a metric has none.
    """
    head, parenthesis, rest = name.strip().partition("(")
    if parenthesis and not rest.endswith(")"):
        raise InputError(
            f"cannot read the metric {name!r}",
            place="metric",
            cure="write name(parameter=value, ...)",
        )
    given = {**_arguments(name, rest[:-1]), **(parameters or {})}
    found = registry.metrics.get(head.strip())
    is_class = isinstance(found, type) and issubclass(found, Metric)
    if given and not (is_class and issubclass(found, Parameters)):
        raise InputError(
            f"the metric {head} has no parameters",
            place="metric",
            cure=f"write {head} alone",
        )
    if is_class:
        return found(**given)  # type: ignore[no-any-return]
    return found if isinstance(found, Metric) else OfFunction(found)


def _arguments(name: str, text: str) -> dict[str, Any]:
    """``a=1, b=2 arcmin`` as a mapping; commas inside brackets belong to values."""
    found: dict[str, Any] = {}
    for part in re.split(r",(?![^\[\]{}]*[\]}])", text) if text.strip() else []:
        key, equals, value = part.partition("=")
        new = yaml_places.load(yaml_places.Source("metric", name), text=value.strip())
        if not equals or not key.strip() or new.faults:
            raise InputError(
                f"cannot read {part.strip()!r} in the metric {name!r}",
                place="metric",
                cure="write parameter=value",
            )
        found[key.strip()] = new.value
    return found
