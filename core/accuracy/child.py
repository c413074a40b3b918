"""The process that measures one setting: it calls `main`."""

from __future__ import annotations

import json
import pickle
import resource
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..compilation.compiled import ensure_cache, one_blas_thread
from ..errors import ZondaError
from ..faults import faults_named

if TYPE_CHECKING:
    from ..data import Data
    from .measure import Measured, Request
    from .metrics import Metric


def work(request: Request) -> Measured:
    """Run the pipeline as often as asked; raises `ZondaError` where it fails."""
    from numba.core.event import install_recorder

    from ..configuration.pipeline_file import load
    from .bands import metric_of
    from .measure import Measured

    first_seed = request.seeds[0]
    start, memory = time.process_time(), 0
    with install_recorder("numba:compile") as compiled:
        metric = metric_of(load(request.pipeline, request.overrides), request.metric)
        data, instrumented = run(request, metric, first_seed, timed=request.repeats > 0)
    first = time.process_time() - start
    timings: list[dict[str, float]] = []
    yardstick: list[float] = []
    for _ in range(request.repeats):
        del data
        start = time.process_time()
        data, instrumented = run(request, metric, first_seed, timed=True)
        timings.append(by_step(data, time.process_time() - start))
        if not yardstick:
            memory = peak_memory()  # before the yardstick takes any
        if request.yardstick:
            start = time.process_time()
            run(replace(request, overrides=request.yardstick), metric, first_seed, timed=True)
            yardstick.append(time.process_time() - start)
    if not instrumented:
        data, _ = run(request, metric, first_seed, timed=False)
    found = [metric.measure(data)]
    for seed in request.seeds[1:]:
        del data
        data, _ = run(request, metric, seed, timed=False)
        found.append(metric.measure(data))
    labels = dict.fromkeys(label for row in timings for label in row)
    steps = {label: tuple(row.get(label, 0.0) for row in timings) for label in labels}
    return Measured(tuple(found), steps, tuple(yardstick), first, memory, bool(compiled.buffer))


def by_step(data: Data, used: float) -> dict[str, float]:
    """CPU seconds of a run by the label of its steps."""
    from .measure import REST

    row: dict[str, float] = {}
    for label, _, seconds in data.provenance["timings"]:
        row[label] = row.get(label, 0.0) + seconds
    return row | {REST: max(0.0, used - sum(row.values()))}


def peak_memory() -> int:
    """Largest resident memory of this process so far, bytes (on Linux ``ru_maxrss`` begins with
    what the parent held).
    """
    with suppress(OSError, StopIteration, ValueError, IndexError):
        status = (
            Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines()
        )
        return 1024 * int(next(line for line in status if line.startswith("VmHWM:")).split()[1])
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (
        1 if sys.platform == "darwin" else 1024
    )


def run(request: Request, metric: Metric, seed: int | None, timed: bool) -> tuple[Data, bool]:
    """One run; and whether its data hold what the metric needs."""
    from ..configuration.pipeline_file import load

    overrides = [*request.overrides, *([f"seed={seed}"] if seed is not None else [])]
    return execute(load(request.pipeline, overrides), metric, request.threads, timed)


def execute(file: Any, metric: Metric, threads: int | None, timed: bool) -> tuple[Data, bool]:
    """Run a pipeline file without what acts at its end; ``timed``: without the steps and signals
    that the metric adds, too.
    """
    from ..output import Output
    from ..pipeline import Pipeline

    own = [o for o in file.operators if metric.needs_end or not isinstance(o, Output)]
    more, signals = metric.steps(list(own)), metric.signals(file.runs)
    steps, runs = (own, file.runs) if timed else (more, {**file.runs, **signals})
    header = file.header
    pipeline = Pipeline(
        steps, runs=runs, only=header.only, name=header.name, precision=header.precision
    )
    with tempfile.TemporaryDirectory(prefix="zonda-accuracy-") as folder:
        data = pipeline.run(file.scene(), output=folder, threads=threads)
    return data, not timed or (len(more) == len(own) and not signals)


def main(ask: str, answer: str) -> int:
    """Read a request, write the answer: a `Measured`, or what is wrong."""
    one_blas_thread()
    ensure_cache()
    from .measure import Request

    given: dict[str, Any] = json.loads(Path(ask).read_text())
    given |= {key: tuple(given[key]) for key in ("overrides", "yardstick", "seeds")}
    request = Request(**given)
    result: Any
    try:
        with faults_named():
            result = work(request)
    except ZondaError as err:
        message = str(err) if hasattr(err, "diagnostics") else err.message
        result = {"message": message, "place": err.place, "cure": err.cure}
    except KeyboardInterrupt:
        return 130
    with Path(answer).open("wb") as file:
        pickle.dump(result, file)
    return 0
