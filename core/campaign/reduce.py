"""Combine partial products in a fixed tree: the same bits for any engine, any number of workers,
any order of completion.

The parts of a combination are numbered in the order of their scans. Runs of `FAN` parts are added
up from left to right, the sums likewise, until one is left. Sums of maps are integers and exact
anyway; means of spectra are floats and owe their bits to the tree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..configuration.time import Instant
from ..data import Data
from ..errors import ZondaError
from ..faults import faults_named
from ..storage.files import check_output_folder
from . import table
from .job import Job, Task, layout_path, plural
from .partial import Partial
from .prepare import scene_of
from .task import layouts_in, pipeline_of

FAN = 32
"""Parts that are added up at once."""


@dataclass(frozen=True)
class Combined:
    """What became of a combination: its tally (who, what, value, whether it is a count), or what
    went wrong.
    """

    tally: tuple[tuple[str, str, str, bool], ...] = ()
    error: ZondaError | None = None


def combine(folder: Path, number: int) -> Combined:
    """Add up one combination's parts, finish its products and write them. Errors are returned, not
    raised.
    """
    try:
        data = combined(Job.read(folder), folder, number)
    except ZondaError as err:
        return Combined(error=err)
    counts = {(who, what) for who, what, _ in data.tally.counts()}
    return Combined(
        tuple((who, what, value, (who, what) in counts) for who, what, value in data.tally.told())
    )


@faults_named()
def combined(job: Job, folder: Path, number: int) -> Data:
    """As `combine`; the finished data. Raises `InputError` where a partial product is missing or
    damaged.
    """
    combination, tasks = job.combinations[number], job.tasks_of(number)
    first = tasks[0]
    file = pipeline_of(job.pipelines[first.pipeline], folder)
    pipeline, scene = file.pipeline(), scene_of(file, first.seed, Instant(first.time))
    data = Data(scene, output=check_output_folder(folder / combination.folder))
    data.provenance = {
        **pipeline.provenance(scene),
        "resolved_yaml": job.source[0] if len(job.source) == 1 else job.pipelines[first.pipeline],
        "command": job.command,
        "plan": job.plans[first.pipeline],
        "campaign": f"{combination.name or job.name}: {plural(len(tasks), 'task')}",
    }
    data.layouts, data.laid_out = (
        dict(layouts_in(layout_path(folder, number), combination.layout)),
        True,
    )
    depth = 1
    while FAN**depth < len(tasks):
        depth += 1
    whole = _sum(tasks, folder, 0, depth)
    data.partial, data.tally, data.observations = (
        whole.products,
        whole.tally,
        whole.observations(scene),
    )
    pipeline.finish(data)
    if job.figures:
        table.keep(folder, number, data)
    return data


def _sum(tasks: Sequence[Task], folder: Path, first: int, level: int) -> Partial:
    """Sum of ``FAN**level`` parts from the ``first`` on; one sum is held for each level."""
    if level == 0:
        task = tasks[first]
        return Partial.read(task.path(folder), task.key)
    whole = _sum(tasks, folder, first, level - 1)
    width = FAN ** (level - 1)
    for branch in range(first + width, min(first + FAN * width, len(tasks)), width):
        whole += _sum(tasks, folder, branch, level - 1)
    return whole
