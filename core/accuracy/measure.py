"""One run of a setting, timed by step, in a process that stays warm from one run to the next.

The first run in the process pays for imports, compiled code and caches and is reported apart. Each
run after it begins from the file anew, so that what an operator object keeps is made again; one in
which code had to be compiled is made again, too. Operators that act at the end of a run (pictures,
reports, files of maps) are left out: they cost the same at every setting.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import resource
import sys
import time
from collections.abc import Mapping
from concurrent.futures import BrokenExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import ZondaError
from ..experiment.variant import FileVariant
from ..faults import faults_named

if TYPE_CHECKING:
    from ..data import Data
    from ..experiment.engines import Pool

REST = "(rest)"
"""CPU seconds that no operator's stage accounts for."""


@dataclass(frozen=True)
class TimedRun:
    """Figures of one run.

    Attributes
    ----------
    found
        Value of the metric; None where the run had not all that the metric needs.
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
    variant: FileVariant, metric: str, threads: int | None, seed: int | None, alone: bool
) -> TimedRun:
    """Run a variant in this process.

    ``alone``: as the user's own run, without the steps and signals that the metric adds.
    """
    global _warm
    from numba.core.event import install_recorder

    from .metrics import metric_of

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
        memory, own = peak_memory(), variant.variant.steps([measures])
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
