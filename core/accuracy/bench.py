"""Settings of one pipeline, each run, measured once and compared with others.

Runs are timed by step, in a process that stays warm from one run to the next. The first run in it
pays for imports, compiled code and caches and is reported apart. Each run after it begins from the
file anew, so that what an operator object keeps is made again; one in which code had to be compiled
is made again, too. Operators that act at the end of a run (pictures, reports, files of maps) are
left out: they cost the same at every setting.

All settings are timed in one process. The reference (all knobs at their tightest) runs again after
every `BETWEEN` runs: CPU seconds are ratios to its last run, which cancels the load that other
programs put on the machine.
"""

from __future__ import annotations

import contextlib
import gc
import math
import os
import resource
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from ..data import Data
from ..errors import InputError, ZondaError
from ..experiment.engines import Pool
from ..experiment.variant import FileVariant
from ..faults import faults_named
from ..machine import give_back_memory
from .metrics import Metric, metric_of
from .settings import Setting, overrides

REST = "(rest)"
"""CPU seconds that no operator's stage accounts for."""


@dataclass(frozen=True)
class TimedRun:
    """Figures of one run.

    Attributes
    ----------
    found
        Value of the metric; None if the run lacked a step or a signal that the metric needs.
    steps
        CPU seconds of each step (label); `REST` is what else the process used.
    memory
        Peak resident memory of the process in the run, bytes, libraries included.
    first
        CPU seconds of the first run of the process, compilation and caches included; 0 where the
        process was warm.
    """

    found: Any
    steps: Mapping[str, float] = field(default_factory=dict)
    memory: int = 0
    first: float = 0.0

    @property
    def cpu(self) -> float:
        """CPU seconds of the whole run."""
        return sum(self.steps.values())


def run_in(pool: Pool, variant: FileVariant, *how: Any) -> TimedRun:
    """Make a `timed_run` in the process of a pool.

    Raises `ZondaError` as the run does, or where the process dies; another one takes its place.
    """
    assert pool.executor is not None
    try:
        return pool.executor.submit(timed_run, variant, *how).result()
    except BrokenExecutor:
        pool.start()
        raise ZondaError(
            "the measuring process was killed",
            place=str(variant),
            cure="it may have run out of memory: shorten the scans with --duration",
        ) from None


_warm = False
"""True when this process has made a run."""


def timed_run(
    variant: FileVariant,
    metric: str,
    threads: int | None,
    seed: int | None,
    alone: bool,
) -> TimedRun:
    """Run a variant in this process.

    ``alone``: as the user's own run, without the steps and signals that the metric adds.
    """
    global _warm
    from numba.core.event import install_recorder

    with (
        open(os.devnull, "w") as nothing,
        contextlib.redirect_stdout(nothing),
        contextlib.redirect_stderr(nothing),
        faults_named(),
    ):
        measures = metric_of(variant.file, metric)

        def run() -> tuple[Data, float]:
            start, own = time.process_time(), replace(variant).variant
            steps = own.steps([measures]) if alone else None
            added = () if alone else [measures]
            data = own.run(added, operators=steps, seed=seed, threads=threads)
            return data, time.process_time() - start

        first = run()[1] if alone and not _warm else 0.0
        _warm = True
        while True:
            reset_peak_memory()
            with install_recorder("numba:compile") as compiled:
                data, seconds = run()
            if not (alone and compiled.buffer):
                break
            del data
        memory = peak_memory()
        own = variant.variant.steps([measures])
        adds = measures.signals(variant.file.runs) or len(measures.steps(own)) > len(own)
        found = None if alone and adds else measures.measure(data)
        return TimedRun(found, by_step(data, seconds), memory, first)


def by_step(data: Data, used: float) -> dict[str, float]:
    """CPU seconds of a run by the label of its steps."""
    row: dict[str, float] = {}
    for label, _, seconds in data.provenance["timings"]:
        row[label] = row.get(label, 0.0) + seconds
    return row | {REST: max(0.0, used - sum(row.values()))}


def reset_peak_memory() -> None:
    """Give back free memory and forget the peak so far, where the system can (Linux)."""
    gc.collect()
    give_back_memory()
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


BETWEEN = 8
"""Runs of settings between two of the reference."""
REFERENCE_RUNS = 2
"""Timed runs of the reference at the least: their spread is that of all single runs."""

Run = Callable[[Setting, int | None, bool], TimedRun]
"""Runs a setting at a seed; the last argument is ``alone`` of `timed_run`."""


@dataclass(frozen=True)
class Setup:
    """Subject of a study, and how it is measured.

    Attributes
    ----------
    pipeline, settings
        Path or shipped name, and the overrides it is loaded with.
    metric, target
        A metric's name, and the error that it may have.
    shorter
        Overrides that shorten the scans (`settings.shortened`).
    repeats, threads
        Timed runs of each setting (of the reference `REFERENCE_RUNS`, if that is more), and threads
        of each run.
    seeds
        For knobs that redraw and for the realization scatter; the first is the one that all
        settings share.
    budget
        Largest number of runs, and of CPU seconds in units of one run of the reference.
    """

    pipeline: str
    settings: tuple[str, ...]
    metric: str
    target: float
    shorter: Setting
    repeats: int = 1
    seeds: tuple[int | None, ...] = (None,)
    threads: int = 1
    budget: float = math.inf

    def __post_init__(self) -> None:
        if not self.target > 0:
            raise InputError(
                f"the target must be above 0, got {100 * self.target:g} %",
                place="--target",
                cure="e.g. 1 %",
            )

    def variant(self, setting: Setting) -> FileVariant:
        """The pipeline with a setting applied."""
        given = (*self.settings, *overrides(self.shorter), *overrides(setting))
        return FileVariant(self.pipeline, given)


@dataclass
class Measured:
    """Measurements of a setting.

    Attributes
    ----------
    found
        Values of the metric, one for each seed so far.
    runs, units
        Its timed runs, and the CPU seconds of the reference's last run before each.
    """

    found: list[object] = field(default_factory=list)
    runs: list[TimedRun] = field(default_factory=list)
    units: list[float] = field(default_factory=list)

    @property
    def memory(self) -> int:
        """Peak memory, bytes."""
        return max(run.memory for run in self.runs)

    def cost(self, step: str = "") -> tuple[float, float]:
        """CPU time of a step, or of all, in units of the reference's run: (median, half the range)
        over the runs.

        Medians are added over steps, and half ranges in quadrature: a run that was disturbed in one
        step counts in the others.
        """
        labels = [step] if step else list(dict.fromkeys(s for run in self.runs for s in run.steps))
        seconds = np.array([[run.steps.get(s, 0.0) for s in labels] for run in self.runs])
        ratios = seconds / np.array(self.units)[:, None]
        spread = np.linalg.norm(np.ptp(ratios, axis=0) / 2)
        return float(np.median(ratios, axis=0).sum()), float(spread)


class Bench:
    """Measures settings, each once, and compares them.

    Parameters
    ----------
    run
        Makes a run.
    metric
        Compares.
    yardstick
        The setting that all are timed against, the reference.
    setup
        How often and at which seeds each is run, and how many runs may be made.
    say
        Is told of each run.
    """

    def __init__(
        self,
        run: Run,
        metric: Metric,
        yardstick: Setting,
        setup: Setup,
        say: Callable[[str], None] = lambda what: None,
    ) -> None:
        self.run = run
        self.metric = metric
        self.yardstick = yardstick
        self.setup = setup
        self.say = say
        self.runs = 0
        self.cpu = 0.0
        self._dearest = 0.0
        self.names = {_key(yardstick): "reference"}
        self._references: list[TimedRun] = []
        self._since = 0
        self._done: dict[frozenset[tuple[str, str]], Measured] = {}
        self._refused: dict[frozenset[tuple[str, str]], ZondaError] = {}

    def measure(self, setting: Setting, all_seeds: bool = False) -> Measured:
        """The measurement of a setting; made where it is not there yet. Raises `ZondaError` where
        the run refuses the setting.
        """
        key = _key(setting)
        seeds = self.setup.seeds
        if key in self._refused:
            raise self._refused[key]
        done = self._done.get(key, Measured())
        try:
            for _ in range(0 if done.runs else self._repeats(setting)):
                unit = 0.0 if setting == self.yardstick else self._reference().cpu
                run = self._made(setting, seeds[0], alone=True)
                done.runs.append(run)
                done.units.append(unit or run.cpu)
                if run.found is not None and not done.found:
                    done.found.append(run.found)
            for seed in seeds[len(done.found) : None if all_seeds else 1]:
                done.found.append(self._made(setting, seed, alone=False).found)
        except ZondaError as err:
            self._refused[key] = err
            self.runs += 1
            self._report(setting, "refused")
            raise
        self._done[key] = done
        return done

    def missing(self, setting: Setting | None = None, all_seeds: bool = False) -> int:
        """Number of runs that `measure` would make, those of the reference among them. None: of a
        setting that is new.
        """
        if setting is not None and self.refusal(setting) is not None:
            return 0
        done = (self._done.get(_key(setting)) if setting is not None else None) or Measured()
        values = max((len(self.setup.seeds) if all_seeds else 1) - len(done.found), 0)
        if done.runs:
            return values
        timed = self._repeats(setting)
        due = (min(self._since, BETWEEN) + timed - 1) // BETWEEN
        in_timed = not self._references or self._references[0].found is not None
        return values + timed + due - in_timed

    def may(self, runs: float) -> bool:
        """True if so many more runs fit in the budget, each at the cost of the costliest so far."""
        unit = self._references[0].cpu if self._references else 0.0
        used = (self.cpu + runs * self._dearest) / unit if unit > 0 else 0.0
        return max(self.runs + runs, used) <= self.setup.budget

    def has(self, setting: Setting) -> bool:
        """True if the setting is measured."""
        return _key(setting) in self._done

    def refusal(self, setting: Setting) -> ZondaError | None:
        """The error of a setting that cannot be run."""
        return self._refused.get(_key(setting))

    def settings(self) -> Iterator[Setting]:
        """The settings measured so far whose random numbers are the reference's, in order."""
        keys = self.yardstick.keys()
        for done in self._done:
            if (setting := dict(done)).keys() == keys:
                yield {key: setting[key] for key in keys}

    def seconds(self, setting: Setting, step: str = "") -> tuple[float, float]:
        """CPU seconds of a setting, or of one of its steps, and their spread, on the scale of the
        yardstick's first runs. The spread of a single run is that of all runs of the yardstick.
        """
        measured = self.measure(setting)
        scale = float(np.median([run.cpu for run in self.measure(self.yardstick).runs]))
        middle, spread = measured.cost(step)
        if len(measured.runs) == 1:
            whole = [r.steps.get(step, 0.0) if step else r.cpu for r in self._references]
            spread = float(np.ptp(whole)) / 2 / scale
        return scale * middle, scale * spread

    def error(self, setting: Setting, reference: Setting) -> float:
        """Error of a setting against a reference with the same random numbers."""
        return self.metric.error(self.measure(setting).found[0], self.measure(reference).found[0])

    def errors(self, setting: Setting, reference: Setting) -> dict[str, float]:
        """`error` of each band, by its name; empty where the camera has one."""
        return dict(
            self.metric.errors(self.measure(setting).found[0], self.measure(reference).found[0])
        )

    def mean_error(self, setting: Setting, reference: Setting) -> tuple[float, float]:
        """Change of the mean over seeds and its standard error (`Metric.mean_error`)."""
        return self.metric.mean_error(
            self.measure(setting, True).found,
            self.measure(reference, True).found,
        )

    def scatter(self, reference: Setting) -> float | None:
        """Realization scatter in units of the error: rms over pairs of seeds of their error,
        divided by sqrt(2).
        """
        found = self.measure(reference).found
        pairs = [self.metric.error(a, b) ** 2 for a, b in combinations(found, 2)]
        return float(np.sqrt(np.mean(pairs) / 2)) if pairs else None

    def _repeats(self, setting: Setting | None) -> int:
        repeats = self.setup.repeats
        return max(repeats, REFERENCE_RUNS) if setting == self.yardstick else repeats

    def _reference(self) -> TimedRun:
        """The last run of the reference, which is made again if it is too old."""
        if not self._references:
            self.measure(self.yardstick)
        if self._since >= BETWEEN:
            self._made(self.yardstick, self.setup.seeds[0], alone=True)
        return self._references[-1]

    def _made(self, setting: Setting, seed: int | None, alone: bool) -> TimedRun:
        """A run, counted and reported."""
        run = self.run(setting, seed, alone)
        self.runs += 1
        self._since += 1
        self.cpu += run.cpu
        self._dearest = max(self._dearest, run.cpu)
        if alone and setting == self.yardstick:
            self._references.append(run)
            self._since = 0
        self._report(setting, f"{run.cpu:.1f} CPU s{'' if alone else f', seed {seed}'}")
        return run

    def _report(self, setting: Setting, words: str) -> None:
        name = self.names.get(_key(setting)) or " ".join(
            overrides(differences(setting, self.yardstick))
        )
        budget = self.setup.budget
        of = f" of at most {budget:g}" if math.isfinite(budget) else ""
        self.say(f"run {self.runs}{of}: {name}: {words}")


def differences(setting: Mapping[str, str], reference: Mapping[str, str]) -> Setting:
    """Values of a setting that differ from the reference."""
    return {k: v for k, v in setting.items() if reference.get(k) != v}


def _key(setting: Setting) -> frozenset[tuple[str, str]]:
    return frozenset(setting.items())
