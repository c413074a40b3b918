"""One setting measured: in a process of its own, so that peak memory and first-call costs are that setting's.

A process loads the pipeline file with the setting's overrides and runs it 1 + repeats times. The first run pays for compiled
code, imports and caches and is reported apart; the others read the pipeline anew: what an operator object keeps is made again.
Operators that act at the end of a run (pictures, reports, files of maps) are left out: they cost the same at every setting.
"""

from __future__ import annotations

import json
import os
import pickle
import statistics
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..errors import ZondaError

REST = "(rest)"
"""CPU seconds that no operator's stage accounts for."""


@dataclass(frozen=True)
class Request:
    """What a process is to do: pipeline and overrides, metric, seeds whose metric is wanted (none: the file's), timed runs."""

    pipeline: str
    overrides: tuple[str, ...]
    metric: str
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
        CPU seconds of each step (label), one for each timed run; `REST` is what else the process used.
    first
        CPU seconds of the first run, compilation and caches included.
    memory
        Peak resident memory of the process, bytes, libraries included.
    compiled
        Whether code was compiled on the way, which takes memory of its own; the next process finds it in the cache.
    """

    found: tuple[Any, ...]
    steps: dict[str, tuple[float, ...]] = field(default_factory=dict)
    first: float = 0.0
    memory: int = 0
    compiled: bool = False

    def seconds(self, step: str = "") -> float:
        """CPU seconds of a step, or of all: the sum over steps of the median over runs."""
        chosen = [self.steps.get(step, (0.0,))] if step else list(self.steps.values())
        return sum(statistics.median(s) for s in chosen)

    def spread(self, step: str = "") -> float:
        """Half the range over runs, added in quadrature over steps: how far `seconds` may be trusted."""
        chosen = [self.steps.get(step, (0.0,))] if step else list(self.steps.values())
        return float(sum(((max(s) - min(s)) / 2) ** 2 for s in chosen) ** 0.5)


def measure(request: Request) -> Measured:
    """Run a child process, again where it had to compile. Raises `ZondaError` as the run does, or where the process dies."""
    found = _measure(request)
    return _measure(request) if found.compiled and request.repeats else found


def _measure(request: Request) -> Measured:
    with tempfile.TemporaryDirectory(prefix="zonda-accuracy-") as folder:
        ask, answer = Path(folder) / "request.json", Path(folder) / "answer.pickle"
        ask.write_text(json.dumps(request.__dict__))
        command = [sys.executable, "-m", "zonda.core.accuracy.child", str(ask), str(answer)]
        done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=os.environ.copy())
        if done.returncode or not answer.exists():
            place = " ".join(request.overrides) or request.pipeline
            if done.returncode < 0:
                cure = "it may have run out of memory: shorten the scans with --duration"
                raise ZondaError(f"the measuring process was killed by signal {-done.returncode}", place=place, cure=cure)
            said = "\n".join(done.stderr.strip().splitlines()[-12:])
            raise ZondaError(f"the measuring process failed:\n{said}", place=place, cure="`zonda run` shows the same fault")
        with answer.open("rb") as file:
            result = pickle.load(file)  # written by our own child into our own folder
    if isinstance(result, Measured):
        return result
    raise ZondaError(result["message"], place=result["place"], cure=result["cure"])
