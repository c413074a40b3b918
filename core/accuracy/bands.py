"""Metrics of a camera with several bands: each band's own, the largest error counts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ..data import Data
from ..types import Floats
from .metrics import Metric, get

if TYPE_CHECKING:
    from ..configuration.pipeline_file import PipelineFile
    from ..operator import Operator
    from ..signal import Signal


def metric_of(file: PipelineFile, name: str) -> Metric:
    """The metric that ``name`` stands for, of each band where the file's camera has several. Raises
    as `metrics.get`.
    """
    found = get(name)
    return OfBands(found) if file.scene().instrument.bands else found


class OfBands(Metric):
    """A metric of each band. What was found is by the band's name."""

    def __init__(self, each: Metric) -> None:
        self.each = each
        self.says = f"{each.says}; the largest of all bands"  # type: ignore[misc]
        self.needs_end = each.needs_end  # type: ignore[misc]

    def check(self, operators: Sequence[Operator], runs: Mapping[str, Signal]) -> None:
        self.each.check(operators, runs)

    def signals(self, runs: Mapping[str, Signal]) -> Mapping[str, Signal]:
        return self.each.signals(runs)

    def steps(self, operators: list[Operator]) -> list[Operator]:
        return self.each.steps(operators)

    def measure(self, data: Data) -> dict[str, Any]:
        return {band: self.each.measure(own) for band, own in data.bands.items()}

    def errors(self, found: Mapping[str, Any], reference: Mapping[str, Any]) -> dict[str, float]:
        return {band: self.each.error(one, reference[band]) for band, one in found.items()}

    def error(self, found: Mapping[str, Any], reference: Mapping[str, Any]) -> float:
        return max(self.errors(found, reference).values())

    def mean_error(self, found: Sequence[Any], reference: Sequence[Any]) -> tuple[float, float]:
        bands = ([[one[band] for one in runs] for runs in (found, reference)] for band in found[0])
        return max(self.each.mean_error(*both) for both in bands)

    def summary(self, found: Any) -> Floats:
        # numbers of different bands are not compared as one list: `mean_error`
        raise NotImplementedError

    def floor(self, reference: Mapping[str, Any]) -> float | None:
        """The lowest of all bands; None where one has none."""
        floors = [self.each.floor(one) for one in reference.values()]
        known = [floor for floor in floors if floor is not None]
        return min(known) if len(known) == len(floors) else None
