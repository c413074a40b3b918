"""Experiments: variants of a pipeline at several seeds, measured by metrics, on an executor.

`Work` makes the calls, also those of a campaign. A call whose worker was killed is made again.
"""

from __future__ import annotations

import json
import math
import statistics
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    wait,
)
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from ..accuracy.metrics import Metric
from ..campaign.settings import separate
from ..errors import PipelineError
from ..figures import Choice, Figure, FigureMetric
from ..storage.files import write_text
from ..tables import Table
from .engines import (
    Pool,
    Registry,
    SerialExecutor,
    Warned,
    engine_failed,
    here,
    show_warnings,
    with_warnings,
)
from .variant import FileVariant, Variant

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class Lost:
    """Result of a call that failed: its worker was killed, the engine could not send it, or it
    raised ``error``.
    """

    error: Exception

    def __str__(self) -> str:
        if isinstance(self.error, BrokenExecutor):
            return (
                "its worker process was killed (by the system for want of memory?), or another one"
                " beside it"
            )
        return f"{type(self.error).__name__}: {self.error}"


class Work(ABC, Generic[T, R]):
    """A list of calls on an engine, one for each item: how they are made and how their results are
    recorded.

    Parameters
    ----------
    place, cure
        For the error where the engine has stopped for good.
    retries
        Largest number of times that a call is made again whose worker was killed.
    """

    def __init__(self, pool: Pool, place: str, cure: str = "", retries: int = 2) -> None:
        self.pool = pool
        self.place = place
        self.cure = cure
        self.retries = retries
        self.stop = False
        """Set to begin no more of them."""
        self.attempts = Counter[T]()
        """Number of times that each was begun."""
        self._shown: Registry = {}
        self._error: Exception | None = None

    @abstractmethod
    def call(self, item: T) -> tuple[Callable[..., R], *tuple[Any, ...]]:
        """A function and its arguments, to be sent to a worker."""

    def began(self, items: list[T]) -> None:
        """Record that these calls are about to be sent."""

    @abstractmethod
    def ended(self, item: T, result: R | Lost) -> bool:
        """End a call; True if it is tried again."""

    def again(self, item: T, lost: Lost) -> bool:
        """True if a call that did not end is tried again; else its error ends the work."""
        error = lost.error
        if engine_failed(error):
            if self.attempts[item] <= self.retries:
                return True
            error = PipelineError(f"the engine failed: {lost}", place=self.place, cure=self.cure)
        self._error = self._error or error
        self.stop = True
        return False

    def carry_out(self, items: Sequence[T]) -> None:
        """Make all calls; where this raises, workers of this machine have ended.

        A broken pool is replaced. Whatever was at work when it broke is tried again at the end, one
        call at a time, so that one that kills its worker does not take others with it.

        Raises
        ------
        PipelineError
            Where the engine has stopped for good.
        Exception
            The first that `again` found, when what was at work has ended.
        """
        pool = self.pool
        waiting = deque(items)
        suspects = deque[T]()
        at_work: dict[Future[tuple[R, list[Warned]]], T] = {}
        ended: set[Future[tuple[R, list[Warned]]]] = set()
        try:
            while True:
                batch: list[T] = []
                for future in ended:
                    item = at_work.pop(future)
                    result = self._result(future)
                    if self.ended(item, result):
                        (suspects if isinstance(result, Lost) else waiting).append(item)
                room = pool.workers + pool.ahead - len(at_work)
                while waiting and not self.stop and len(batch) < room:
                    batch.append(waiting.popleft())
                if suspects and not batch and not at_work and not self.stop:
                    batch.append(suspects.popleft())
                self.attempts.update(batch)
                self.began(batch)
                for item in batch:
                    at_work[_submit(pool, *self.call(item))] = item
                if not at_work:
                    break
                ended, _ = wait(at_work, return_when=FIRST_COMPLETED)
                if any(
                    isinstance(f.exception(), BrokenExecutor) for f in ended if not f.cancelled()
                ):
                    ended, _ = wait(at_work)
                    if not pool.start():
                        raise self._gone()
        except BaseException:
            for future in at_work:
                future.cancel()
            pool.stop()
            raise
        if self._error is not None:
            raise self._error

    def _result(self, future: Future[tuple[R, list[Warned]]]) -> R | Lost:
        """The result of a call, whose warnings are shown."""
        try:
            result, found = future.result()
        except CancelledError:
            raise self._gone() from None
        except Exception as err:
            # of the call, or of the engine: a Dask worker that died again and again, a task that
            # cannot be sent
            return Lost(err)
        show_warnings(found, self._shown)
        return result

    def _gone(self) -> PipelineError:
        return PipelineError("the engine has stopped", place=self.place, cure=self.cure)


def _submit(
    pool: Pool, function: Callable[..., R], *arguments: Any
) -> Future[tuple[R, list[Warned]]]:
    assert pool.executor is not None
    try:
        return pool.executor.submit(with_warnings, here(), function, *arguments)
    except Exception as err:
        future: Future[tuple[R, list[Warned]]] = Future()
        # a worker was killed; else the engine is gone
        future.set_exception(err if isinstance(err, BrokenExecutor) else CancelledError())
        return future


SECONDS = "seconds"
"""The metric that is the wall time of the run itself, s."""

AnyVariant = Variant | FileVariant
Item = tuple[AnyVariant, int]
"""A variant, and the number of a realization, counted from 0."""

Found = dict[str, Any]
"""Measurements by metric: a `Figure`, or whatever a metric gives that is no number."""

COLUMNS = {
    "variant": "what was changed",
    "seed": "seed of the random numbers",
    "metric": "metric and parameters",
    "value": "in unit",
    "error": "standard error that the metric states; nan: not known",
    "unit": "empty: a pure number",
}


class Experiment:
    """Variants, each at a number of seeds, and the metrics that are measured there.

    A variant is run once at each seed, for all its metrics. Variants of one seed share random
    numbers, so that their differences are those of the pipelines.

    Parameters
    ----------
    variants
        What is run: `Variant` or `FileVariant`.
    seeds
        Number of realizations of each variant, from its scene's seed on
        (`campaign.settings.separate`); or the seeds themselves.
    metrics
        What is measured: names such as ``central_rms(radius=30 arcsec)``, or metrics.
    folder
        Where values of a `FileVariant` are kept, in ``runs/``: what is there already is not run
        again. None: nowhere.
    say
        Is told a line for each run.
    threads
        Of each run; None: all that it may use.
    """

    def __init__(
        self,
        variants: Sequence[AnyVariant] = (),
        seeds: int | Sequence[int] = 1,
        metrics: Sequence[str | Choice | Metric] = (),
        *,
        folder: str | Path | None = None,
        say: Callable[[str], None] = lambda text: None,
        threads: int | None = None,
    ) -> None:
        self.folder = None if folder is None else Path(folder)
        self.say = say
        self.threads = threads
        self.seeds = None if isinstance(seeds, int) else tuple(seeds)
        self.made = 0
        self._wanted: dict[AnyVariant, dict[str, int]] = {}
        self._metrics: dict[str, Choice | Metric] = {}
        self._kept: dict[AnyVariant, dict[int, Found]] = {}
        for variant in variants:
            for metric in metrics:
                if isinstance(metric, str | FigureMetric):
                    metric = Choice.of(metric)
                self.want(variant, metric, seeds if isinstance(seeds, int) else len(seeds))

    def want(self, variant: AnyVariant, metric: Choice | Metric | None, seeds: int) -> None:
        """Add a metric (None: `SECONDS`) of a variant at so many seeds. Raises `PipelineError`
        where it cannot have the metric.
        """
        name = SECONDS
        known = (v for v in self._wanted if v == variant)
        variant = next(known, variant)
        if metric is not None:
            whole = variant.variant.pipeline
            name = str(metric)
            _measures(metric).check(whole.operators, whole.asked)
            self._metrics.setdefault(name, metric)
        metrics = self._wanted.setdefault(variant, {})
        metrics[name] = max(metrics.get(name, 0), seeds)

    def run(
        self,
        executor: Executor | Pool | None = None,
        take: Callable[[AnyVariant, int, Found], None] | None = None,
    ) -> Table:
        """Run what is missing, on an executor of `concurrent.futures` (None: in this process), and
        return all figures. Values are on disk as soon as their run has ended.

        ``take``: is given the variant, the number of the realization and what was measured as each
        run ends, in place of the table: for metrics that are no numbers and large.
        """
        items = [(v, n) for v, wanted in self._wanted.items() for n in range(max(wanted.values()))]
        if executor is None:
            pool = Pool(SerialExecutor(), 1)
        elif isinstance(executor, Pool):
            pool = executor
        else:  # MPI's and Dask's do not say how many workers they have
            workers = getattr(executor, "_max_workers", 0) or max(1, len(items))
            pool = Pool(executor, workers, workers)
        missing = {
            (variant, number): found
            for variant, number in items
            if (found := self._missing(variant, number))
        }
        _Runs(self, pool, items, missing, take).carry_out(list(missing))
        return self.table()

    def figures(self, variant: AnyVariant, metric: str) -> list[Figure]:
        """A metric's figures of a variant, by realization, which have been run."""
        kept = self._values(variant)
        return [kept[number][metric] for number in range(self._wanted[variant][metric])]

    def table(self) -> Table:
        """Figures that were measured, in the order of variants, seeds and metrics."""
        rows = [
            {
                "variant": str(variant),
                "seed": self.seed(variant, number),
                "metric": name,
                "value": figure.value,
                "error": figure.error,
                "unit": figure.unit,
            }
            for variant in self._wanted
            for number, found in sorted(self._values(variant).items())
            for name, figure in found.items()
            if isinstance(figure, Figure)
        ]
        return Table.of(rows, COLUMNS, {})

    def seed(self, variant: AnyVariant, number: int) -> int:
        """Seed of a realization, counted from 0."""
        if self.seeds is not None:
            return self.seeds[number]
        return separate(variant.variant.scene.seed, number)

    def _missing(self, variant: AnyVariant, number: int) -> list[str]:
        """Metrics wanted of a realization that are not there."""
        known = self._values(variant).get(number, {})
        wanted = self._wanted[variant]
        return [m for m, seeds in wanted.items() if number < seeds and m not in known]

    def _path(self, variant: AnyVariant) -> Path | None:
        if self.folder is None or not isinstance(variant, FileVariant):
            return None
        return self.folder / "runs" / f"{variant.key}.json"

    def _values(self, variant: AnyVariant) -> dict[int, Found]:
        """Known values of a variant, by realization; a damaged file counts as none."""
        if variant not in self._kept:
            self._kept[variant], path = {}, self._path(variant)
            with suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
                values = json.loads(path.read_text(encoding="utf-8"))["values"] if path else {}
                self._kept[variant] = {
                    int(n): {
                        str(m): Figure(str(m), float(v), str(u), float(e))
                        for m, (v, e, u) in row.items()
                    }
                    for n, row in values.items()
                }
        return self._kept[variant]

    def keep(self, variant: AnyVariant, number: int, found: Found) -> None:
        """Keep what was measured, and write it to the file at once."""
        self.made += 1
        kept = self._values(variant)
        path = self._path(variant)
        kept[number] = {**kept.get(number, {}), **found}
        if path is not None and isinstance(variant, FileVariant):
            values = {
                n: {m: (f.value, f.error, f.unit) for m, f in row.items()}
                for n, row in kept.items()
            }
            about = {"pipeline": Path(variant.pipeline).name, "settings": list(variant.overrides)}
            write_text(path, json.dumps({**about, "values": values}, indent=1) + "\n")


class _Runs(Work[Item, Found]):
    """The runs of an experiment."""

    def __init__(
        self,
        whole: Experiment,
        pool: Pool,
        items: Sequence[Item],
        missing: Mapping[Item, list[str]],
        take: Callable[[AnyVariant, int, Found], None] | None,
    ) -> None:
        cure = "run it again on another executor; runs that a folder holds are not repeated"
        super().__init__(pool, "experiment", cure)
        self.whole = whole
        self.missing = missing
        self.place_of = {item: place for place, item in enumerate(items, 1)}
        self.take = take or whole.keep

    def call(self, item: Item) -> tuple[Callable[..., Found], *tuple[Any, ...]]:
        """See `Work.call`."""
        whole, (variant, number) = self.whole, item
        metrics = {name: whole._metrics.get(name) for name in self.missing[item]}
        threads = whole.threads or self.pool.threads
        return measured, variant, whole.seed(variant, number), metrics, threads

    def began(self, items: list[Item]) -> None:
        """See `Work.began`."""
        for item in items:
            place, (variant, number) = f"{self.place_of[item]} of {len(self.place_of)}", item
            self.whole.say(f"run {place}: {variant}, realization {number + 1}")

    def ended(self, item: Item, result: Found | Lost) -> bool:
        """See `Work.ended`."""
        if isinstance(result, Lost):
            return self.again(item, result)
        self.take(*item, result)
        return False


def measured(
    variant: AnyVariant,
    seed: int,
    metrics: Mapping[str, Choice | Metric | None],
    threads: int | None = None,
) -> Found:
    """Run a variant at a seed, and measure its metrics."""
    known = {name: metric for name, metric in metrics.items() if metric is not None}
    begin = time.perf_counter()
    data = variant.run([_measures(m) for m in known.values()], seed=seed, threads=threads)
    found: Found = {SECONDS: Figure(SECONDS, time.perf_counter() - begin, "s", 0.0)}
    for name, metric in known.items():
        found[name] = metric.figure(data) if isinstance(metric, Choice) else metric.measure(data)
    return {name: found[name] for name in metrics}


def _measures(metric: Choice | Metric) -> Metric:
    return metric.metric if isinstance(metric, Choice) else metric


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
