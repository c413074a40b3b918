"""The error that a run has reached, measured against all knobs at their tightest; and a stored
Pareto front tested again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ..errors import InputError
from ..experiment.variant import Variant
from .bands import metric_of
from .measure import Request, execute, measure
from .settings import knobs_of, overrides
from .store import StoredFront, fingerprint
from .sweep import tightest

if TYPE_CHECKING:
    from ..configuration.pipeline_file import PipelineFile
    from ..data import Data

SLACK = 0.2
"""By how much an error may exceed the stored one, relative: bits differ between CPUs, and the small
errors with them.
"""
SMALLEST = 1e-5
"""Errors below this are not told apart."""


@dataclass(frozen=True)
class Retest:
    """A point of a stored Pareto front and its error now."""

    setting: dict[str, str]
    stored: float
    now: float

    @property
    def good(self) -> bool:
        return self.now <= self.stored * (1 + SLACK) + SMALLEST


def achieved(
    file: PipelineFile,
    pipeline: str,
    settings: Sequence[str],
    metric: str,
    threads: int | None = None,
    data: Data | None = None,
) -> tuple[float, dict[str, float]]:
    """Error of this pipeline's own setting against its knobs at their tightest, same scans and
    seed; and that of each band by its name, of which it is the largest (empty where the camera has
    one band).

    ``data``: of a run of it, which saves one of the two runs where the metric needs no step and no
    signal of its own.
    """
    measures = metric_of(file, metric)
    measures.check(file.operators, file.runs)
    reference = overrides(tightest(knobs_of(file)))

    def found(given: Sequence[str]) -> Any:
        return measure(
            Request(pipeline, tuple(given), metric, repeats=0, threads=threads or 1)
        ).found[0]

    enough = len(measures.steps(list(file.operators))) == len(
        file.operators
    ) and not measures.signals(file.runs)
    own = measures.measure(data) if data is not None and enough else found(settings)
    tightened = found((*settings, *reference))
    return measures.error(own, tightened), dict(measures.errors(own, tightened))


def retest(
    front: StoredFront, file: PipelineFile, pipeline: str, points: int | None = None
) -> list[Retest]:
    """Measure the errors of a stored Pareto front again (of the ``points`` with the largest
    errors): errors only, never times, and therefore in this process.

    Raises InputError where the front is of another pipeline.
    """
    if front.fingerprint != fingerprint(file):
        cure = "make it anew: zonda accuracy PIPELINE --store"
        raise InputError(
            "the stored Pareto front is of other steps or another scene",
            place=file.place,
            cure=cure,
        )
    metric = metric_of(file, front.metric)
    base = (*overrides(front.shorter), f"seed={front.seed}")

    def found(setting: dict[str, str]) -> Any:
        variant = Variant(pipeline, (*base, *overrides(setting)))
        return metric.measure(execute(variant.file, metric, 1, timed=False)[0])

    reference = found(front.reference)
    chosen = sorted((p for p in front.points if p.error > 0), key=lambda p: -p.error)[:points]
    return [Retest(p.setting, p.error, metric.error(found(p.setting), reference)) for p in chosen]
