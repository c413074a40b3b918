"""One task: some scans of one entry, to a file of partial products. The same bits wherever and whenever it runs."""

from __future__ import annotations

import os
import resource
import socket
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError, OutputError, PipelineError, PointingError, ZondaError
from ..faults import faults_named
from . import machines, parts
from .job import Task, layout_path

if TYPE_CHECKING:
    from ..configuration.pipeline_file import PipelineFile

POINTS = 512
"""Boresight directions that are kept of a scan for pictures and tables; of those beyond `SCANS`, 16."""
SCANS = 32


@dataclass(frozen=True)
class Order:
    """A task as it is sent to a worker: everything it needs but the files.

    Attributes
    ----------
    task, pipeline
        What to do: the task and its planned pipeline as YAML.
    layout
        Digest of the layouts' file.
    folder
        The campaign's output folder, as the worker sees it.
    threads, memory
        For this task; None: all of the machine's. The memory is that of the worker's whole process.
    version
        Of the zonda that sends it.
    """

    task: Task
    pipeline: str
    layout: str
    folder: Path
    threads: int | None
    memory: int | None
    version: str


@dataclass(frozen=True)
class Outcome:
    """What became of a task.

    Attributes
    ----------
    digest
        Of the product's content; empty where it failed.
    error
        What went wrong, as shown to the user; empty where nothing did.
    final
        Whether trying again cannot help.
    stop
        Whether the other tasks would fail alike.
    seconds
        Wall time.
    peak
        Largest resident memory of the worker so far, bytes.
    machine
        On what it ran (`machines.here`).
    """

    number: int
    host: str
    seconds: float
    digest: str = ""
    error: str = ""
    final: bool = False
    stop: bool = False
    peak: int = 0
    machine: str = ""


def perform(order: Order) -> Outcome:
    """Do a task. Never raises an `Exception`: what fails is told in the outcome."""
    begin, number, host = time.monotonic(), order.task.number, f"{socket.gethostname()}:{os.getpid()}"
    try:
        from zonda import __version__

        if __version__ != order.version:
            raise PipelineError(
                f"this worker has zonda {__version__}, the campaign {order.version}", place=host, cure="install the same one"
            )
        digest = _run(order)
    except ZondaError as err:
        final = isinstance(err, PipelineError | PointingError)
        stop = isinstance(err, OutputError | _NotCombined)
        return Outcome(number, host, time.monotonic() - begin, error=str(err), final=final, stop=stop, peak=_peak())
    except Exception as err:
        import traceback

        text = "".join(traceback.format_exception(err)).rstrip()
        stop = isinstance(err, OSError)
        return Outcome(number, host, time.monotonic() - begin, error=text, stop=stop, peak=_peak())
    return Outcome(number, host, time.monotonic() - begin, digest, peak=_peak(), machine=machines.here())


class _NotCombined(PipelineError):
    """A product that cannot be added to those of other observations."""


@faults_named()
def _run(order: Order) -> str:
    from ..configuration.time import Instant
    from ..pipeline import Part
    from .prepare import scene_of

    task, folder = order.task, order.folder
    file = pipeline_of(order.pipeline)
    layouts = layouts_in(layout_path(folder, task.combination), order.layout)
    part = Part(task.scans, layouts, prefix=f"{task.entry:06d}-")
    pipeline = file.pipeline()
    data = pipeline.run_part(
        scene_of(file, task.seed, Instant(task.time)),
        part,
        output=folder / "entries" / f"{task.entry:06d}",  # the time streams of one entry together
        threads=order.threads,
        ceiling=order.memory,
        provenance={"resolved_yaml": order.pipeline},
    )
    if data.products:
        raise _NotCombined(
            f"the product {sorted(data.products)[0]!r} cannot be combined with those of other observations",
            place=file.header.name,
            cure="its operator needs to hand a Product to Data.add; or run the observations one by one",
        )
    scans = [_thinned(o, k + task.before) for k, o in enumerate(data.observations)]
    tally = data.tally
    tree = {
        "partial": {who: [type(product).__name__, dict(product.arrays())] for who, product in data.partial.items()},
        "scans": scans,
        "counts": [list(row) for row in tally.counts()],
        "totals": [list(row) for row in tally.totals()],
        # figures of scans of one number share a row, whatever the entry: there may be a million entries
        "figures": [[who, what.removeprefix(part.prefix), text] for who, what, text in tally.figures()],
    }
    return parts.write(task.path(folder), task.key, tree)


@lru_cache(4)
def pipeline_of(text: str) -> PipelineFile:
    """A pipeline, kept by the worker with what its operators remember (maps that were read and convolved)."""
    from ..configuration.pipeline_file import parse

    return parse(text, name="campaign")


@lru_cache(4)
def layouts_in(path: Path, digest: str) -> Mapping[str, Any]:
    """The layouts in a file, by label. Raises InputError where it is not the one meant."""
    try:
        layouts: Mapping[str, Any] = parts.read(path, "layout", digest)["layouts"]
    except InputError as err:
        raise InputError(err.message, place=err.place, cure="can this worker see the campaign's folder?") from None
    return layouts


def _thinned(observation: Any, number: int) -> dict[str, Any]:
    """What a report tells of a scan, with a few of its boresight directions."""
    import numpy as np

    n = observation.n_samples
    some = np.linspace(0, n - 1, min(n, POINTS if number < SCANS else 16)).round().astype(int)
    elevation = observation.elevation
    some = np.unique([*some, elevation.argmin(), elevation.argmax()])
    return {
        "name": observation.name,
        "start": observation.start.nanoseconds,
        "n_samples": n,
        "n_detectors": observation.n_detectors,
        "sample_rate": observation.sample_rate,
        "seconds": observation.seconds[some],
        "azel": observation.boresight_azel[some],
        "radec": observation.boresight_radec[some],
        "centre": list(observation.centre),
        "focal_plane": _levels(observation.focalplane) if number == 0 else {},
        "flagged": [int(np.count_nonzero(~observation.good_samples)), int(np.count_nonzero(~observation.good_detectors))],
    }


def _levels(plane: Any) -> dict[str, Any]:
    """What the steps made of the focal plane, for the report: efficiencies and noise as they were resolved."""
    return {name: getattr(plane, name) for name in ("main_beam_efficiency", "illumination_efficiency", "net", "knee", "slope")}


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
