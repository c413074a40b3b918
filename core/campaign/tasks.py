"""Tasks of a campaign, on workers: one runs scans of an entry and writes their partial product; one
adds up the partial products of a set.

The bits of a task do not depend on where and when it runs. The partial products of a set are
numbered in the order of their scans and added up in a fixed tree: runs of `FAN` of them from left
to right, the sums likewise, until one is left. So the bits are the same for any engine, any number
of workers, any order of completion. Sums of maps are integers and exact anyway; means of spectra
are floats and owe their bits to the tree.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from zonda import __version__

from .. import hooks
from ..data import Data
from ..errors import InputError, OutputError, PipelineError, PointingError, ZondaError
from ..experiment.engines import Pool
from ..experiment.experiment import Lost, Work
from ..experiment.variant import Variant
from ..faults import faults_named
from ..figures import Figures
from ..machine import available_memory, available_threads
from ..pipeline import Part
from ..run.streams import Files
from ..storage.files import check_output_folder, discard
from ..storage.output_folder import recording
from . import machines, trees
from .campaign_file import ENTRIES, Job, PlannedEntry, Task, layout_path, plural
from .folder import Record, clean
from .machines import Watch
from .partial import NotCombined, Partial

if TYPE_CHECKING:
    from ..configuration.pipeline_file import PipelineFile


@dataclass(frozen=True)
class Order:
    """A task as it is sent to a worker: everything it needs but the files.

    Attributes
    ----------
    entry, pipeline
        Its entry, and the planned pipeline as YAML.
    layout
        Digest of the layouts' file.
    folder
        The campaign's output folder, as the worker sees it.
    threads, memory
        For this task; None: all of the machine's. The memory is that of the worker's whole process.
    version
        Version of the zonda that sends it.
    """

    task: Task
    entry: PlannedEntry
    pipeline: str
    layout: str
    folder: Path
    threads: int | None
    memory: int | None
    version: str = __version__


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
    begin = time.monotonic()
    host = f"{socket.gethostname()}:{os.getpid()}"
    try:
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
        text = "".join(traceback.format_exception(err)).rstrip()
        stop = isinstance(err, OSError)
        return Outcome(host, time.monotonic() - begin, error=text, stop=stop)


@faults_named()
def _run(order: Order, host: str, begin: float) -> tuple[float, str]:
    """Write the product of a task; wall time since ``begin``, and the machine."""
    task = order.task
    folder = order.folder
    file = pipeline_of(order.pipeline, order.folder)
    variant = Variant(file.pipeline(), order.entry.scene(file))
    layouts = layouts_in(layout_path(folder, task.combination), order.layout)
    part = Part(task.scans, layouts, f"{task.entry:06d}-")
    with recording(folder, anew=False):
        data = variant.run(
            operators=variant.pipeline.operators,
            part=part,
            output=folder / ENTRIES / f"{task.entry:06d}",  # the time streams of one entry together
            threads=order.threads,
            ceiling=order.memory,
            provenance={"resolved_yaml": order.pipeline},
        )
    partial = Partial.of(data, task.before, part.prefix)
    seconds = time.monotonic() - begin
    machine = machines.here()
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
    if trees.digest_of(path) != digest:
        raise InputError(
            "cannot be used: it is missing, damaged or another campaign's",
            place=str(path),
            cure="can this worker see the campaign's folder?",
        )
    layouts: Mapping[str, Any] = trees.read(path, "layout")["layouts"]
    return layouts


FAN = 32
"""Partial products that are added up at once."""


@dataclass(frozen=True)
class Combined:
    """Result of a combination: its log (who, what, value, is a count), and the figures that were
    measured of its products.
    """

    log: tuple[tuple[str, str, str, bool], ...] = ()
    figures: tuple[tuple[Any, ...], ...] = ()


def combine(folder: Path, number: int, threads: int | None = None) -> Combined:
    """Add up one combination's partial products, finish its products and write them."""
    data = combined(Job.read(folder), folder, number, threads)
    counts = {(who, what) for who, what, _ in data.log.counts()}
    measured = [product for product in data.products.values() if isinstance(product, Figures)]
    return Combined(
        tuple((who, what, value, (who, what) in counts) for who, what, value in data.log.told()),
        tuple(astuple(figure) for figures in measured for figure in figures),
    )


@faults_named()
def combined(job: Job, folder: Path, number: int, threads: int | None = None) -> Data:
    """Finished data of `combine`. Raises `InputError` if a partial product is missing or
    damaged.
    """
    combination = job.combinations[number]
    tasks = job.tasks_of[number]
    first = job.entry_of(tasks[0])
    file = pipeline_of(job.pipelines[first.pipeline], folder)
    pipeline = file.pipeline()
    scene = first.scene(file)
    data = Data(scene, output=check_output_folder(folder / combination.folder))
    data.threads = threads or available_threads()
    data.provenance = {
        **pipeline.provenance(scene),
        "resolved_yaml": job.source[0] if len(job.source) == 1 else job.pipelines[first.pipeline],
        "command": job.command,
        "plan": job.plans[first.pipeline],
        "campaign": f"{combination.name or job.name}: {plural(len(tasks), 'task')}",
    }
    layouts = layouts_in(layout_path(folder, number), combination.layout)
    data.layouts, data.laid_out = dict(layouts), True
    depth = 1
    while FAN**depth < len(tasks):
        depth += 1
    size = sum(path.stat().st_size for task in tasks if (path := task.path(folder)).exists())
    files = Files(0) if size > available_memory() // 2 else None
    whole = _sum(tasks, folder, 0, depth, files)
    data.partial, data.log = whole.products, whole.log
    data.observations = whole.observations(scene)
    with recording(folder, anew=False):
        pipeline.finish(data)
    return data


def _sum(
    tasks: Sequence[Task],
    folder: Path,
    first: int,
    level: int,
    files: Files | None,
) -> Partial:
    """Sum of ``FAN**level`` partial products from the ``first`` on; each level holds one."""
    if level == 0:
        task = tasks[first]
        return Partial.read(task.path(folder), task.key, files)
    whole = _sum(tasks, folder, first, level - 1, files)
    width = FAN ** (level - 1)
    for branch in range(first + width, min(first + FAN * width, len(tasks)), width):
        whole += _sum(tasks, folder, branch, level - 1, files)
    return whole


LOST = "(lost)"
"""Host of an attempt whose worker was killed."""


@dataclass
class CampaignResult:
    """The result of a campaign.

    Attributes
    ----------
    log
        Of all combinations: rows (combination, who, what, value, whether it is a count).
    tasks
        Number of tasks that were run now.
    seconds
        Wall time of the tasks; ``samples`` in them.
    failed
        Errors of tasks that are given up, by number.
    """

    folder: Path
    log: list[tuple[str, str, str, str, bool]] = field(default_factory=list)
    tasks: int = 0
    samples: int = 0
    seconds: float = 0.0
    failed: dict[int, str] = field(default_factory=dict)


class Tasks(Work[Task, Outcome]):
    """The tasks of a campaign. ``watch`` compares the machines that they run on."""

    def __init__(self, record: Record, pool: Pool, watch: Watch) -> None:
        super().__init__(pool, str(record.folder), f"zonda resume {record.folder}")
        self.folder = record.folder
        self.job = record.job
        self.record = record
        self.watch = watch
        self.result = CampaignResult(record.folder)
        self._failures = 0

    def run(self, tasks: Sequence[Task]) -> CampaignResult:
        """Run these tasks; on an interrupt, those at work wait again."""
        self._all = {"total": len(tasks), "all_samples": sum(task.samples for task in tasks)}
        self._begin = time.monotonic()
        try:
            self.carry_out(tasks)
        except BaseException:
            with contextlib.suppress(Exception):
                self.record.put_off()
            if self.pool.stop():
                clean(self.folder, self.record.job)
            raise
        finally:
            hooks.manager().hook.zonda_campaign_end()
        self.result.seconds = time.monotonic() - self._begin
        return self.result

    def call(self, item: Task) -> tuple[Callable[[Order], Outcome], Order]:
        """See `Work.call`."""
        job = self.job
        entry = self.job.entry_of(item)
        return perform, Order(
            item,
            entry,
            job.pipelines[entry.pipeline],
            job.combinations[item.combination].layout,
            self.folder.resolve(),
            self.pool.threads,
            self.pool.memory,
        )

    def began(self, items: list[Task]) -> None:
        """See `Work.began`."""
        self.record.claim(task.number for task in items)

    def ended(self, item: Task, result: Outcome | Lost) -> bool:
        """Record the outcome of a task."""
        number = item.number
        outcome = Outcome(LOST, 0.0, error=str(result)) if isinstance(result, Lost) else result
        if not outcome.error and (
            error := self.watch.meet(outcome.machine, f"task {number} on {outcome.host}")
        ):
            discard(item.path(self.folder))
            outcome = replace(outcome, error=error, final=True, stop=True)
        host = outcome.host
        seconds = outcome.seconds
        error = outcome.error
        again = bool(error) and not outcome.final and self.attempts[item] <= self.job.retries
        if not error:
            self.record.succeeded(item, host, seconds, outcome.machine)
            self.result.tasks += 1
            self.result.samples += item.samples
        else:
            self._failures += 1
            self.record.failed(item, host, seconds, error, again)
            if not again:
                self.result.failed[number] = error
                self.stop = self.stop or outcome.stop
        hooks.manager().hook.zonda_campaign_progress(
            done=self.result.tasks, failed=self._failures, samples=self.result.samples,
            seconds=time.monotonic() - self._begin, **self._all,
        )  # fmt: skip
        return again


class Combinations(Work[int, Combined]):
    """The sets of products, by number. They are combined on workers: pictures and reports take time
    and memory.
    """

    def __init__(self, record: Record, result: CampaignResult, pool: Pool) -> None:
        cure = f"zonda resume {record.folder}"
        retries = record.job.retries
        super().__init__(pool, str(record.folder), cure, retries)
        self.folder = record.folder
        self.job = record.job
        self.record = record
        self.result = result

    def call(self, item: int) -> tuple[Callable[..., Combined], Path, int, int | None]:
        """See `Work.call`."""
        return combine, self.folder.resolve(), item, self.pool.threads

    def ended(self, item: int, result: Combined | Lost) -> bool:
        """Record that products are written, and remove their partial products."""
        if isinstance(result, Lost):
            return self.again(item, result)
        self.record.combine(item, result.figures)
        name = self.job.combinations[item].name
        self.result.log += [(name, *row) for row in result.log]
        if not self.job.keep_tasks:
            self.record.discard_partials(item)
        return False
