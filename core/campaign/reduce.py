"""Partial products together, in a fixed tree: the same bits for any engine, any number of workers, any order of completion.

The parts of a combination are numbered in the order of their scans. Runs of `FAN` parts are added up from left to right,
the sums likewise, until one is left. Sums of maps are integers and exact anyway; means of spectra are floats and owe their bits
to the tree.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..data import Data, Observation
from ..errors import ZondaError
from ..faults import faults_named
from ..output import Output
from ..pipeline import Pipeline
from ..product import Product
from ..registry import products
from ..storage.files import check_output_folder
from . import parts
from .job import Job, Task, layout_path, plural
from .prepare import scene_of
from .task import layouts_in, pipeline_of

FAN = 32
"""Parts that are added up at once."""


@dataclass
class Thinned(Observation):
    """A scan of which a few boresight directions are kept: `seconds`, `boresight_azel` and `boresight_radec` hold those alone.

    ``flags`` and ``detector_flags`` hold as many ones as there are flagged samples and detectors.
    """

    samples: int = 0
    detectors: int = 0

    def __post_init__(self) -> None:
        """No flags are made for the samples that are not here."""

    @property
    def n_samples(self) -> int:
        return self.samples

    @property
    def n_detectors(self) -> int:
        return self.detectors


@dataclass(frozen=True)
class Combined:
    """What became of a combination: its tally (who, what, value, whether it is a count), or what went wrong."""

    tally: tuple[tuple[str, str, str, bool], ...] = ()
    error: ZondaError | None = None


def combine(folder: Path, number: int, digests: Mapping[int, str]) -> Combined:
    """Add up one combination's parts, finish its products and write them. Works in any process; errors are told, not raised.

    ``digests``: of the tasks' products, by the task's number.
    """
    try:
        data = combined(Job.read(folder), folder, number, digests)
    except ZondaError as err:
        return Combined(error=err)
    counts = {(who, what) for who, what, _ in data.tally.counts()}
    return Combined(tuple((who, what, value, (who, what) in counts) for who, what, value in data.tally.told()))


@faults_named()
def combined(job: Job, folder: Path, number: int, digests: Mapping[int, str]) -> Data:
    """As `combine`; the finished data. Raises `InputError` where a partial product is missing or damaged."""
    combination = job.combinations[number]
    tasks = job.tasks_of(number)
    pipeline, data = _begin(job, folder, number, tasks)
    leaves = [(t.path(folder), t.key, digests[t.number]) for t in tasks]
    _add(data, _tree(data, leaves, lambda leaf: parts.read(*leaf)))
    data.output = check_output_folder(folder / combination.folder)
    for observation in data.observations[1:]:
        observation.focalplane = data.observations[0].focalplane
    return pipeline.finish(data)


def _begin(job: Job, folder: Path, number: int, tasks: Sequence[Task]) -> tuple[Pipeline, Data]:
    """The pipeline of the first task, laid out, and data without products."""
    from ..configuration.time import Instant

    first = tasks[0]
    file = pipeline_of(job.pipelines[first.pipeline])
    pipeline = file.pipeline()
    combination = job.combinations[number]
    layouts = layouts_in(layout_path(folder, number), combination.layout)
    scene = scene_of(file, first.seed, Instant(first.time))
    data = Data(scene=scene, layouts=dict(layouts), laid_out=True)
    for operator in pipeline.operators:
        if not isinstance(operator, Output) and "boresight" not in operator.provides:
            operator.observe(data)
    source = job.source[0] if len(job.source) == 1 else job.pipelines[first.pipeline]
    extra = {"resolved_yaml": source, "command": job.command, "plan": job.plans[first.pipeline]}
    extra["campaign"] = f"{combination.name or job.name}: {plural(len(tasks), 'task')}"
    data.provenance = {**pipeline._provenance(scene), **extra}
    return pipeline, data


def _tree(data: Data, nodes: Sequence[Any], read: Callable[[Any], dict[str, Any]]) -> dict[str, Any]:
    """The sum of parts, of which there are `FAN` at once in the branches of each level; one sum is held per level."""
    depth = 1
    while FAN**depth < len(nodes):
        depth += 1

    def total(low: int, level: int) -> dict[str, Any]:
        if level == 0:
            return read(nodes[low])
        branch = _empty(data)
        width = FAN ** (level - 1)
        for start in range(low, min(low + FAN**level, len(nodes)), width):
            _add(branch, total(start, level - 1))
        return _packed(branch)

    return total(0, depth)


def _empty(data: Data) -> Data:
    """The same scene without observations and products."""
    return Data(scene=data.scene, provenance=data.provenance)


def _packed(data: Data) -> dict[str, Any]:
    tally = data.tally
    rows = {name: [list(row) for row in getattr(tally, name)()] for name in ("counts", "totals", "figures")}
    partial = {who: [type(product).__name__, product] for who, product in data.partial.items()}
    return {"partial": partial, "scans": data.observations, **rows}


def _add(data: Data, tree: dict[str, Any]) -> None:
    for who, (kind, product) in tree["partial"].items():
        data.add(who, product if isinstance(product, Product) else products.get(kind).of(product))
    totals = {(who, what): total for who, what, total in tree["totals"]}
    for who, what, count in tree["counts"]:
        data.tally.count(who, what, count, totals.get((who, what), 0))
    for who, what, text in tree["figures"]:
        data.tally.state(who, what, text)
    for scan in tree["scans"]:
        index = len(data.observations)
        data.observations.append(replace(scan, index=index) if isinstance(scan, Thinned) else _thinned(data, scan, index))


def _thinned(data: Data, scan: dict[str, Any], index: int) -> Thinned:
    from ..configuration.time import Instant

    scene = data.scene
    if data.observations:
        plane = data.observations[0].focalplane
    else:  # the first scan tells what the steps made of it
        plane = scene.instrument.focalplane()
        for name, values in scan["focal_plane"].items():
            setattr(plane, name, values)
    return Thinned(
        name=scan["name"],
        index=index,
        site=scene.site,
        instrument=scene.instrument,
        focalplane=plane,
        start=Instant(scan["start"]),
        seconds=scan["seconds"],
        sample_rate=scan["sample_rate"],
        boresight_azel=scan["azel"],
        boresight_radec=scan["radec"],
        centre=(scan["centre"][0], scan["centre"][1]),
        seed=scene.seed,
        flags=np.ones(scan["flagged"][0], np.uint8),
        detector_flags=np.ones(scan["flagged"][1], np.uint8),
        samples=scan["n_samples"],
        detectors=scan["n_detectors"],
    )
