"""One setting measured: in a process of its own, so that peak memory and first-call costs are that
setting's.

A process loads the pipeline file with the setting's overrides and runs it once: that run pays for
imports, compiled code and caches and is reported apart. Then the setting and the yardstick (all
knobs at their tightest) run in turn, each time from the file anew, so what an operator object keeps
is made again. Costs are ratios to the yardstick's run beside it: what other programs on the machine
do to both cancels. Operators that act at the end of a run (pictures, reports, files of maps) are
left out: they cost the same at every setting.
"""

from __future__ import annotations

import json
import pickle
import statistics
import subprocess
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .. import children
from ..errors import ZondaError

REST = "(rest)"
"""CPU seconds that no operator's stage accounts for."""


@dataclass(frozen=True)
class Request:
    """What a process is to do.

    Attributes
    ----------
    pipeline, overrides, yardstick
        Path or shipped name; overrides of the setting, and of the setting that it is timed against.
    metric, seeds
        What to measure, at which seeds (None: the file's).
    repeats, threads
        Timed runs of each, and threads of every run.
    """

    pipeline: str
    overrides: tuple[str, ...]
    metric: str
    yardstick: tuple[str, ...] = ()
    seeds: tuple[int | None, ...] = (None,)
    repeats: int = 3
    threads: int = 1


@dataclass(frozen=True)
class Measured:
    """What came out.

    Attributes
    ----------
    found
        What the metric measured, by seed.
    steps
        CPU seconds of each step (label), one for each timed run; `REST` is what else the process
        used.
    yardstick
        CPU seconds of the yardstick's run beside each; empty: none ran.
    first
        CPU seconds of the first run, compilation and caches included.
    memory
        Peak resident memory of the process, bytes, libraries included.
    compiled
        Whether code was compiled on the way, which takes memory of its own; the next process finds
        it in the cache.
    """

    found: tuple[Any, ...]
    steps: dict[str, tuple[float, ...]] = field(default_factory=dict)
    yardstick: tuple[float, ...] = ()
    first: float = 0.0
    memory: int = 0
    compiled: bool = False

    def cost(self, step: str = "") -> tuple[float, float]:
        """CPU time of a step, or of all, in units of the yardstick's run beside it: (median, half
        the range) over the runs.

        Medians are added over steps, and half ranges in quadrature: a run that was disturbed in one
        step counts in the others.
        """
        chosen = [self.steps.get(step, (0.0,))] if step else list(self.steps.values())
        units = self.yardstick or (1.0,) * max((len(s) for s in chosen), default=0)
        ratios = [[seconds / unit for seconds, unit in zip(s, units, strict=False)] for s in chosen]
        middle = sum(statistics.median(r) for r in ratios)
        return middle, sum(((max(r) - min(r)) / 2) ** 2 for r in ratios) ** 0.5


def measure(request: Request) -> Measured:
    """Run a child process, again where it had to compile. Raises `ZondaError` as the run does, or
    where the process dies.
    """
    found = _measure(request)
    return _measure(request) if found.compiled and request.repeats else found


def _measure(request: Request) -> Measured:
    with tempfile.TemporaryDirectory(prefix="zonda-accuracy-") as folder:
        ask, answer = Path(folder) / "request.json", Path(folder) / "answer.pickle"
        ask.write_text(json.dumps(request.__dict__))
        command = children.command("zonda.core.accuracy.child", "main", str(ask), str(answer))
        done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        if done.returncode or not answer.exists():
            place = " ".join(request.overrides) or request.pipeline
            if done.returncode < 0:
                cure = "it may have run out of memory: shorten the scans with --duration"
                raise ZondaError(
                    f"the measuring process was killed by signal {-done.returncode}",
                    place=place,
                    cure=cure,
                )
            said = "\n".join(done.stderr.strip().splitlines()[-12:])
            raise ZondaError(
                f"the measuring process failed:\n{said}",
                place=place,
                cure="`zonda run` shows the same fault",
            )
        with answer.open("rb") as file:
            result = pickle.load(file)  # written by our own child into our own folder
    if isinstance(result, Measured):
        return result
    raise ZondaError(result["message"], place=result["place"], cure=result["cure"])
