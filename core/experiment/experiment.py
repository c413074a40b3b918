"""Variants times realizations as tasks on an executor; their values are kept in files."""

from __future__ import annotations

import json
import math
import statistics
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, Future
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..campaign.engines import SerialExecutor
from ..campaign.entries import separate
from ..figures import Choice
from ..storage.files import write_text
from .variant import Variant

SECONDS = "seconds"
"""The metric that is the wall time of the run itself, s."""

Pairs = dict[str, tuple[float, float]]
"""By metric, the value and its standard error."""


class Experiment:
    """Variants, each at a number of seeds, and the metrics that are measured there.

    A variant is run once at each seed, for all its metrics. Variants of one seed share random
    numbers, so that their differences are those of the pipelines.

    Parameters
    ----------
    folder
        Where values are kept, in ``runs/``: what is there already is not run again.
    say
        Is told a line for each run.
    """

    def __init__(self, folder: Path, say: Callable[[str], None] = lambda text: None) -> None:
        self.folder, self.say = folder, say
        self.made = 0
        self._wanted: dict[Variant, dict[str, int]] = {}
        self._choices: dict[str, Choice] = {}
        self._kept: dict[Variant, KeptValues] = {}

    def want(self, variant: Variant, choice: Choice | None, seeds: int) -> Variant:
        """Add a metric (None: `SECONDS`) of a variant at so many seeds; the variant as it is known.
        Raises `PipelineError` where it cannot have the metric.
        """
        variant = next((known for known in self._wanted if known == variant), variant)
        if choice is not None:
            choice.metric.check(variant.file.operators, variant.file.runs)
            self._choices.setdefault(choice.name, choice)
        metrics, name = self._wanted.setdefault(variant, {}), choice.name if choice else SECONDS
        metrics[name] = max(metrics.get(name, 0), seeds)
        return variant

    def run(self, executor: Executor | None = None) -> None:
        """Run what is missing; values are on disk as soon as their run has ended."""
        executor = executor or SerialExecutor()
        waiting = deque[tuple[Variant, int, Future[Pairs]]]()
        tasks = [(v, n) for v, wanted in self._wanted.items() for n in range(max(wanted.values()))]
        for done, (variant, number) in enumerate(tasks, 1):
            missing = self._of(variant).lacks(number, self._wanted[variant])
            if missing:
                self.say(f"run {done} of {len(tasks)}: {variant}, realization {number + 1}")
                choices = {name: self._choices.get(name) for name in missing}
                future = executor.submit(measured, variant, number, choices)
                waiting.append((variant, number, future))
            while waiting and waiting[0][2].done():
                self._keep(*waiting.popleft())
        while waiting:
            self._keep(*waiting.popleft())

    def values(self, variant: Variant, metric: str, seeds: int) -> list[tuple[float, float]]:
        """Means over realizations that have been run, and their errors."""
        kept = self._of(variant).values
        return [kept[str(number)][metric] for number in range(seeds)]

    def _of(self, variant: Variant) -> KeptValues:
        if variant not in self._kept:
            self._kept[variant] = KeptValues.read(self.folder, variant)
        return self._kept[variant]

    def _keep(self, variant: Variant, number: int, found: Future[Pairs]) -> None:
        self._of(variant).add(number, found.result())
        self.made += 1


def measured(variant: Variant, number: int, choices: Mapping[str, Choice | None]) -> Pairs:
    """The values of metrics at a variant's realization ``number``, counted from 0."""
    known = {name: choice for name, choice in choices.items() if choice is not None}
    begin = time.perf_counter()
    seed = separate(variant.file.scene().seed, number)
    data = variant.run([choice.metric for choice in known.values()], seed=seed)
    found = {SECONDS: (time.perf_counter() - begin, 0.0)}
    for name, choice in known.items():
        figure = choice.figure(data)
        found[name] = (figure.value, figure.error)
    return {name: found[name] for name in choices}


@dataclass(frozen=True)
class Values:
    """Values of a metric over realizations (n,); ``error``: standard error that the metric states
    for a single one, 0 where it states none, NaN where it is not known.
    """

    values: tuple[float, ...]
    error: float = 0.0

    @property
    def mean(self) -> float:
        """Mean over the realizations; NaN if there are none."""
        return math.fsum(self.values) / len(self.values) if self.values else math.nan

    @property
    def scatter(self) -> float:
        """Standard deviation of one realization; of a single one the error that its metric
        states.
        """
        if len(self.values) < 2:
            return self.error
        return statistics.stdev(self.values)

    @property
    def standard_error(self) -> float:
        """Standard error of the mean."""
        return self.scatter / math.sqrt(len(self.values)) if self.values else math.nan


@dataclass
class KeptValues:
    """Values of a variant in a file: by realization, then by metric."""

    path: Path
    about: dict[str, Any]
    values: dict[str, Pairs] = field(default_factory=dict)

    @classmethod
    def read(cls, folder: Path, variant: Variant) -> KeptValues:
        """The values of a variant in a folder; a damaged file counts as none."""
        about = {"pipeline": Path(variant.pipeline).name, "settings": list(variant.overrides)}
        found = cls(folder / "runs" / f"{variant.key}.json", about)
        with suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
            values = json.loads(found.path.read_text(encoding="utf-8"))["values"]
            found.values = {str(n): dict(_pairs(row)) for n, row in values.items()}
        return found

    def lacks(self, number: int, metrics: Mapping[str, int]) -> list[str]:
        """Metrics wanted of this realization (``metrics``: of how many) that are not there."""
        known = self.values.get(str(number), {})
        return [m for m, seeds in metrics.items() if number < seeds and m not in known]

    def add(self, number: int, values: Pairs) -> None:
        """Write values to the file at once."""
        self.values[str(number)] = {**self.values.get(str(number), {}), **values}
        write_text(self.path, json.dumps({**self.about, "values": self.values}, indent=1) + "\n")


def _pairs(row: Mapping[str, Any]) -> Iterator[tuple[str, tuple[float, float]]]:
    for name, (value, error) in row.items():
        yield str(name), (float(value), float(error))
