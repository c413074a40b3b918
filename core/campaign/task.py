"""Run one task: scans of one entry, to a file of partial products. The bits do not depend on where
and when it runs.
"""

from __future__ import annotations

import os
import socket
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
from .partial import NotCombined, Partial

if TYPE_CHECKING:
    from ..configuration.pipeline_file import PipelineFile


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
    """The outcome of a task.

    Attributes
    ----------
    error
        What went wrong, as shown to the user; empty where nothing did.
    final
        Whether trying again cannot help.
    stop
        Whether the other tasks would fail alike.
    seconds
        Wall time.
    machine
        On what it ran (`machines.here`).
    """

    host: str
    seconds: float
    machine: str = ""
    error: str = ""
    final: bool = False
    stop: bool = False


def perform(order: Order) -> Outcome:
    """Run a task. Never raises an `Exception`: the outcome states what failed."""
    begin, host = time.monotonic(), f"{socket.gethostname()}:{os.getpid()}"
    try:
        from zonda import __version__

        if __version__ != order.version:
            raise PipelineError(
                f"this worker has zonda {__version__}, the campaign {order.version}",
                place=host,
                cure="install the same one",
            )
        return Outcome(host, *_run(order, host, begin))
    except ZondaError as err:
        final = isinstance(err, PipelineError | PointingError)
        stop = isinstance(err, OutputError | NotCombined)
        return Outcome(host, time.monotonic() - begin, error=str(err), final=final, stop=stop)
    except Exception as err:
        import traceback

        text = "".join(traceback.format_exception(err)).rstrip()
        stop = isinstance(err, OSError)
        return Outcome(host, time.monotonic() - begin, error=text, stop=stop)


@faults_named()
def _run(order: Order, host: str, begin: float) -> tuple[float, str]:
    """Write the product of a task; wall time since ``begin``, and the machine."""
    from ..configuration.time import Instant
    from ..pipeline import Part
    from .prepare import scene_of

    task, folder, file = order.task, order.folder, pipeline_of(order.pipeline, order.folder)
    part = Part(
        task.scans,
        layouts_in(layout_path(folder, task.combination), order.layout),
        f"{task.entry:06d}-",
    )
    data = file.pipeline().run_part(
        scene_of(file, task.seed, Instant(task.time)),
        part,
        output=folder / "entries" / f"{task.entry:06d}",  # the time streams of one entry together
        threads=order.threads,
        ceiling=order.memory,
        provenance={"resolved_yaml": order.pipeline},
    )
    partial = Partial.of(data, task.before, part.prefix)
    seconds, machine = time.monotonic() - begin, machines.here()
    made = {"host": host, "seconds": seconds, "machine": machine}
    partial.write(task.path(folder), task.key, made)
    return seconds, machine


@lru_cache(4)
def pipeline_of(text: str, folder: Path) -> PipelineFile:
    """A pipeline of the campaign in ``folder``, kept by the worker with what its operators remember
    (maps read and convolved).
    """
    from ..configuration.pipeline_file import parse

    return parse(text, name="campaign", folder=folder)


@lru_cache(4)
def layouts_in(path: Path, digest: str) -> Mapping[str, Any]:
    """The layouts in a file, by label. Raises InputError where it is not the one meant."""
    if parts.digest_of(path) != digest:
        raise InputError(
            "cannot be used: it is missing, damaged or another campaign's",
            place=str(path),
            cure="can this worker see the campaign's folder?",
        )
    layouts: Mapping[str, Any] = parts.read(path, "layout")["layouts"]
    return layouts
