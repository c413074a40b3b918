"""One setting measured, in a process that stays warm from one setting to the next.

The first run in the process pays for imports, compiled code and caches and is reported apart. Each
run after it begins from the file anew, so that what an operator object keeps is made again. The
reference (all knobs at their tightest) runs again after every `BETWEEN` runs: CPU seconds are
ratios to its last run, which cancels the load that other programs put on the machine. Operators
that act at the end of a run (pictures, reports, files of maps) are left out: they cost the same at
every setting.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import resource
import statistics
import sys
import time
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import ZondaError
from ..experiment.variant import Variant, run_file, steps_for
from ..faults import faults_named

if TYPE_CHECKING:
    from ..campaign.engines import Pool
    from ..configuration.pipeline_file import PipelineFile
    from ..data import Data
    from .metrics import Metric

REST = "(rest)"
"""CPU seconds that no operator's stage accounts for."""

BETWEEN = 8
"""Runs of settings between two of the reference."""


@dataclass(frozen=True)
class Request:
    """A measurement that the process is asked for.

    Attributes
    ----------
    pipeline, overrides, yardstick
        Path or shipped name; overrides of the setting, and of the reference that it is timed
        against (empty: none).
    metric, seeds
        Name of the metric, and the seeds at which it is measured (None: the file's).
    repeats, threads
        Timed runs at the first seed (0: none is timed), and threads of every run.
    """

    pipeline: str
    overrides: tuple[str, ...]
    metric: str
    yardstick: tuple[str, ...] = ()
    seeds: tuple[int | None, ...] = (None,)
    repeats: int = 1
    threads: int = 1


@dataclass(frozen=True)
class Measured:
    """The result of a request.

    Attributes
    ----------
    found
        Value of the metric at each seed.
    steps
        CPU seconds of each step (label), one for each timed run; `REST` is what else the process
        used.
    yardstick
        CPU seconds of the reference's last run before each; empty: none ran.
    first
        CPU seconds of the first run of the process, compilation and caches included; 0 where the
        process was warm.
    memory
        Peak resident memory of the process in the timed runs, bytes, libraries included.
    runs, cpu
        Number of runs that this took, and their CPU seconds, but for the first run.
    """

    found: tuple[Any, ...]
    steps: dict[str, tuple[float, ...]] = field(default_factory=dict)
    yardstick: tuple[float, ...] = ()
    first: float = 0.0
    memory: int = 0
    runs: int = 1
    cpu: float = 0.0

    @property
    def timed(self) -> int:
        """Number of timed runs."""
        return max((len(seconds) for seconds in self.steps.values()), default=0)

    def cost(self, step: str = "") -> tuple[float, float]:
        """CPU time of a step, or of all, in units of the reference's run: (median, half the range)
        over the runs.

        Medians are added over steps, and half ranges in quadrature: a run that was disturbed in one
        step counts in the others.
        """
        chosen = [self.steps.get(step, (0.0,))] if step else list(self.steps.values())
        units = self.yardstick or (1.0,) * max((len(s) for s in chosen), default=0)
        ratios = [[seconds / unit for seconds, unit in zip(s, units, strict=False)] for s in chosen]
        middle = sum(statistics.median(r) for r in ratios)
        return middle, sum(((max(r) - min(r)) / 2) ** 2 for r in ratios) ** 0.5


@dataclass(frozen=True)
class Refused:
    """An error of a run, as it travels between processes."""

    message: str
    place: str
    cure: str


@contextlib.contextmanager
def measuring(threads: int) -> Iterator[Pool]:
    """A pool of one process for `measure`; it ends with the context."""
    from ..campaign.engines import engine

    with engine("processes", workers=1, threads=threads) as pool:
        yield pool


def measure(request: Request, pool: Pool | None = None) -> Measured:
    """Measure a setting in the process of ``pool``, or in one of its own.

    Raises `ZondaError` as the run does, or where the process dies; another one takes its place.
    """
    if pool is None:
        with measuring(request.threads) as own:
            return measure(request, own)
    place = " ".join(request.overrides) or request.pipeline
    assert pool.executor is not None
    try:
        result = pool.executor.submit(work, request).result()
    except BrokenExecutor:
        assert pool.remake is not None
        pool.executor = pool.remake()
        raise ZondaError(
            "the measuring process was killed",
            place=place,
            cure="it may have run out of memory: shorten the scans with --duration",
        ) from None
    if isinstance(result, Measured):
        return result
    raise ZondaError(result.message, place=result.place or place, cure=result.cure)


def work(request: Request) -> Measured | Refused:
    """Carry out a request in this process; an error is returned."""
    import traceback

    with (
        open(os.devnull, "w") as nothing,
        contextlib.redirect_stdout(nothing),
        contextlib.redirect_stderr(nothing),
    ):
        try:
            with faults_named():
                return _worker.measured(request)
        except ZondaError as err:
            message = str(err) if hasattr(err, "diagnostics") else err.message
            return Refused(message, err.place, err.cure)
        except Exception as err:
            said = "".join(traceback.format_exception(err)).strip().splitlines()[-12:]
            message = "the measuring process failed:\n" + "\n".join(said)
            return Refused(message, "", "`zonda run` shows the same fault")


class _Worker:
    """State of a measuring process: the reference's last run and how many runs ago it was."""

    def __init__(self) -> None:
        self.warm = False
        self.reference = 0.0
        self.since = BETWEEN
        self.runs, self.cpu = 0, 0.0

    def measured(self, request: Request) -> Measured:
        """See `work`."""
        from .bands import metric_of

        variant = Variant(request.pipeline, request.overrides)
        metric = metric_of(variant.file, request.metric)
        first, seed, self.runs, self.cpu = 0.0, request.seeds[0], 0, 0.0
        if request.repeats and not self.warm:
            start = time.process_time()
            execute(variant.file, metric, request.threads, True, seed)
            first, self.warm = time.process_time() - start, True
        timings: list[dict[str, float]] = []
        yardstick: list[float] = []
        found: list[Any] = []
        memory = 0
        for _ in range(request.repeats):
            if request.yardstick and request.yardstick != request.overrides:
                yardstick.append(self._reference(request, metric))
            data, whole, seconds = self._timed(request, request.overrides, metric, seed)
            memory = max(memory, peak_memory())
            timings.append(by_step(data, seconds))
            if request.yardstick == request.overrides:
                self.reference, self.since = seconds, 0
                yardstick.append(seconds)
            if whole and not found:
                found = [metric.measure(data)]
            del data
        for seed in request.seeds[len(found) :]:
            start = time.process_time()
            file = Variant(request.pipeline, request.overrides).file
            data, _ = execute(file, metric, request.threads, False, seed)
            found.append(metric.measure(data))
            del data
            self._count(time.process_time() - start)
        labels = dict.fromkeys(label for row in timings for label in row)
        steps = {label: tuple(row.get(label, 0.0) for row in timings) for label in labels}
        return Measured(tuple(found), steps, tuple(yardstick), first, memory, self.runs, self.cpu)

    def _reference(self, request: Request, metric: Metric) -> float:
        """CPU seconds of the reference's last run, made where that is too long ago."""
        if self.since >= BETWEEN:
            self.reference = self._timed(request, request.yardstick, metric, request.seeds[0])[2]
            self.since = 0
        return self.reference

    def _timed(
        self, request: Request, overrides: tuple[str, ...], metric: Metric, seed: int | None
    ) -> tuple[Data, bool, float]:
        """A run as the user's, again where code had to be compiled: its data, whether they hold
        what the metric needs, and its CPU seconds.
        """
        from numba.core.event import install_recorder

        while True:
            reset_peak_memory()
            start = time.process_time()
            with install_recorder("numba:compile") as compiled:
                file = Variant(request.pipeline, overrides).file
                data, whole = execute(file, metric, request.threads, True, seed)
            seconds = time.process_time() - start
            self._count(seconds)
            if not compiled.buffer:
                return data, whole, seconds
            del data

    def _count(self, seconds: float) -> None:
        self.runs += 1
        self.since += 1
        self.cpu += seconds


_worker = _Worker()


def by_step(data: Data, used: float) -> dict[str, float]:
    """CPU seconds of a run by the label of its steps."""
    row: dict[str, float] = {}
    for label, _, seconds in data.provenance["timings"]:
        row[label] = row.get(label, 0.0) + seconds
    return row | {REST: max(0.0, used - sum(row.values()))}


def reset_peak_memory() -> None:
    """Give back free memory and forget the peak so far, where the system can (Linux)."""
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_memory() -> int:
    """Largest resident memory of this process since `reset_peak_memory`, bytes (elsewhere than on
    Linux: since it began).
    """
    with contextlib.suppress(OSError, StopIteration, ValueError, IndexError):
        status = (
            Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines()
        )
        return 1024 * int(next(line for line in status if line.startswith("VmHWM:")).split()[1])
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (
        1 if sys.platform == "darwin" else 1024
    )


def execute(
    file: PipelineFile,
    metric: Metric,
    threads: int | None,
    timed: bool,
    seed: int | None = None,
) -> tuple[Data, bool]:
    """Run a pipeline file without what acts at its end; and whether the data hold what the metric
    needs. ``timed``: without the steps and signals that the metric adds, too.
    """
    if not timed:
        return run_file(file, [metric], seed=seed, threads=threads), True
    own = steps_for(file, [metric])
    data = run_file(file, operators=own, seed=seed, threads=threads)
    return data, len(metric.steps(list(own))) == len(own) and not metric.signals(file.runs)
