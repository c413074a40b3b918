"""From pipeline files to a `Job`: entries, plans, common grids, tasks."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError, ZondaError
from ..storage.files import product_path
from . import parts
from .entries import Entry, entries
from .job import Combination, Job, Task, digest_of_text, key_of, layout_path, plural
from .settings import MOST_TASKS, Campaign

if TYPE_CHECKING:
    from ..configuration.pipeline_file import PipelineFile
    from ..configuration.time import Instant
    from ..data import Data


MEASURED = 8
"""Pipelines of each combination that are asked how much memory they need."""


@dataclass(frozen=True)
class Source:
    """A pipeline file and the settings from the command line. ``load(settings)`` reads it with further ones."""

    file: PipelineFile
    load: Callable[[tuple[str, ...]], PipelineFile]
    name: str
    """Folder of its products where there are several files, else ''."""

    @property
    def campaign(self) -> Campaign:
        """Its own, or one of a single entry."""
        return self.file.header.campaign or Campaign()


@dataclass(frozen=True)
class Look:
    """Where one entry points: number of its pipeline, seed, start; how messages call it."""

    pipeline: int
    seed: int
    time: Instant
    place: str


def job(
    sources: Sequence[Source],
    folder: Path,
    command: str,
    keep: Sequence[str] = (),
    drop: Sequence[str] = (),
    prune_all: bool = True,
    say: Callable[[int, int, str], None] = lambda done, total, what: None,
) -> Job:
    """Work out a campaign and write the layouts of its maps to ``folder``.

    Entries that differ in more than seed and night are planned one by one. Where n scans are co-added, the budget for the errors
    of the plan is that of one observation divided by sqrt(n): such errors may add up while noise averages down.

    Raises
    ------
    ZondaError
        As planning and pointing do, with the entry in its place; and for names of products that are not unique.
    """
    from zonda import __version__

    from ..plan.planner import plan
    from ..run.first_look import first_look

    pipelines: list[str] = []
    plans: list[tuple[tuple[str, ...], ...]] = []
    combinations: list[Combination] = []
    tasks: list[Task] = []
    planned_files: list[PipelineFile] = []
    files: dict[str, str] = {}
    entry_number, need = 0, 0
    for source in sources:
        campaign = source.campaign
        found = entries(campaign, source.file.scene().seed, lambda settings, s=source: s.load(settings).scene().time)  # type: ignore[misc]
        files |= _files(source.file)
        members: dict[Any, list[tuple[int, Entry]]] = {}
        for entry in found:
            members.setdefault(repr(entry.combination), []).append((entry_number, entry))
            entry_number += 1
        groups: dict[tuple[tuple[str, ...], float], int] = {}  # entries that differ in seed and night alone share a plan
        done = 0
        for together in members.values():
            share = 1 / math.sqrt(len(together))
            planned: list[tuple[int, Entry, int]] = []
            for number, entry in together:
                say(done, len(found), "campaign: plans and grids")
                done += 1
                if (entry.settings, share) not in groups:
                    with _placed(about(entry) or source.file.header.name):
                        file = _with_budget(source.load(entry.settings), share)
                        first_look(file.pipeline(), scene_of(file, entry.seed, entry.time))
                        made = plan(file, keep=keep, drop=drop, prune_all=prune_all)
                    groups[entry.settings, share] = len(pipelines)
                    planned_files.append(made.apply(file))
                    pipelines.append(planned_files[-1].resolved_yaml())
                    plans.append(tuple(tuple(map(str, row)) for row in made.summary.short))
                    files |= _files(planned_files[-1])
                planned.append((number, entry, groups[entry.settings, share]))
            looks = [Look(group, entry.seed, entry.time, about(entry)) for _, entry, group in planned]
            pointed: dict[int, Data] = {}
            layouts, scans = agree(looks, planned_files, pointed)
            need = max([need, *(_need(planned_files[group], data, layouts, folder) for group, data in pointed.items())])
            name, subfolder = _names(source, together[0][1], combinations)
            combination = Combination(name, subfolder, "")
            digest = parts.write(layout_path(folder, len(combinations)), "layout", {"layouts": layouts})
            combinations.append(dataclasses.replace(combination, layout=digest))
            tasks += _tasks(planned, scans, campaign.task, len(combinations) - 1, digest, pipelines, __version__, len(tasks))
            if len(tasks) > MOST_TASKS:
                raise InputError(
                    f"a campaign of more than {MOST_TASKS} tasks", cure="set campaign.task: entry, or make it smaller"
                )
    first = sources[0].campaign
    return Job(
        name=sources[0].file.header.name if len(sources) == 1 else "campaign",
        version=__version__,
        command=command,
        retries=first.retries,
        keep_tasks=first.keep_tasks,
        pipelines=tuple(pipelines),
        plans=tuple(plans),
        source=tuple(source.file.resolved_yaml() for source in sources),
        files=files,
        combinations=tuple(combinations),
        tasks=tuple(tasks),
        same_machine=first.same_machine,
        need=need,
    )


def outline(source: Source) -> tuple[str, PipelineFile]:
    """What a campaign consists of in one line; and its first entry as a pipeline file, with its share of the budget."""
    found = entries(source.campaign, source.file.scene().seed, lambda settings: source.load(settings).scene().time)
    first = found[0]
    together = sum(e.combination == first.combination for e in found)
    sets = len({repr(e.combination) for e in found})
    text = f"campaign of {len(found)} entries, combined into {plural(sets, 'set')} of products"
    return text, _with_budget(source.load(first.settings), 1 / math.sqrt(together))


def about(entry: Entry) -> str:
    """An entry's place on the axes, e.g. ``site=atacama, night=3``."""
    return ", ".join(f"{k}={v}" for k, v in entry.values.items())


def scene_of(file: PipelineFile, seed: int, time: Instant) -> Any:
    """The file's scene with another seed and start."""
    return file.scene().model_copy(update={"seed": seed, "time": time})


def changed(job: Job) -> list[str]:
    """Files that are not as they were when the campaign was worked out."""
    return [path for path, stamp in job.files.items() if _stamp(Path(path), stamp.partition(":")[0]) != stamp]


def agree(
    looks: Sequence[Look], files: Sequence[PipelineFile], pointed: dict[int, Data] | None = None
) -> tuple[dict[str, Mapping[str, Any]], list[tuple[int, ...]]]:
    """What the operators agree on for all scans of a combination; and the samples (detectors x samples) of each entry's scans.

    The telescope is pointed for one entry after the other, once for those that begin at the same time, and only as long as that
    can change something. Raises `PointingError` where it cannot be. ``pointed``: takes the first entry of some of the pipelines.
    """
    layouts: dict[str, Mapping[str, Any]] = {}
    by_start: dict[tuple[int, int], tuple[int, ...]] = {}
    by_pipeline: dict[int, tuple[int, ...]] = {}
    found = []
    for look in looks:
        at = look.pipeline, look.time.nanoseconds
        if at not in by_start:
            settled = bool(layouts) and all(layout.get("fixed") for layout in layouts.values())
            if settled and look.pipeline in by_pipeline:
                by_start[at] = by_pipeline[look.pipeline]
            else:
                with _placed(look.place):
                    data, by_start[at] = _point(files[look.pipeline], look, layouts)
                if pointed is not None and len(pointed) < MEASURED:
                    pointed.setdefault(look.pipeline, data)
                by_pipeline[look.pipeline] = by_start[at]
        found.append(by_start[at])
    return layouts, found


def restore_layout(job: Job, folder: Path, number: int) -> None:
    """Write the layout of a combination again, from its tasks. Raises InputError where it comes out otherwise than before."""
    from ..configuration.pipeline_file import parse
    from ..configuration.time import Instant

    first = {task.entry: task for task in reversed(job.tasks_of(number))}
    looks = [Look(t.pipeline, t.seed, Instant(t.time), t.about) for t in sorted(first.values(), key=lambda t: t.number)]
    files = [parse(text, name="campaign") for text in job.pipelines]
    path = layout_path(folder, number)
    if parts.write(path, "layout", {"layouts": agree(looks, files)[0]}) != job.combinations[number].layout:
        raise InputError(
            "is not what it was",
            place=str(path),
            cure="the pointing has changed since (another version?): run the campaign again",
        )


def _point(file: PipelineFile, look: Look, layouts: dict[str, Mapping[str, Any]]) -> tuple[Data, tuple[int, ...]]:
    """Point the telescope, let the operators agree; the observations, and the samples of each."""
    from ..data import Data

    pipeline = file.pipeline()
    data = Data(scene=scene_of(file, look.seed, look.time))
    for operator in pipeline.operators:
        if "boresight" in operator.provides:
            operator.observe(data)
    for operator in pipeline.operators:
        if not operator.at_end and (agreed := operator.agree(data, layouts.get(operator.label))) is not None:
            layouts[operator.label] = agreed
    return data, tuple(o.n_detectors * o.n_samples for o in data.observations)


def _need(file: PipelineFile, data: Data, layouts: Mapping[str, Mapping[str, Any]], folder: Path) -> int:
    """Least bytes with which a process runs a pipeline over these observations. ``folder``: the campaign's, to write to."""
    from ..run.memory_budget import least

    pipeline, data.output = file.pipeline(), folder
    for operator in pipeline.operators:
        if operator.label in layouts:
            operator.lay_out(layouts[operator.label])
        elif not operator.at_end and "boresight" not in operator.provides:
            operator.observe(data)
    return least(pipeline, data.observations)


def _tasks(
    planned: Sequence[tuple[int, Entry, int]],
    scans_of: Sequence[tuple[int, ...]],
    kind: str,
    combination: int,
    layout: str,
    pipelines: Sequence[str],
    version: str,
    number: int,
) -> list[Task]:
    found: list[Task] = []
    before = 0
    for (entry_number, entry, group), samples in zip(planned, scans_of, strict=True):
        every = tuple(range(len(samples)))
        for scans in [every] if kind == "entry" else [(k,) for k in every]:
            time = entry.time.nanoseconds
            key = key_of(version, pipelines[group], entry.seed, time, scans, before == 0, layout)
            found.append(
                Task(
                    number + len(found), key, group, combination, entry_number, scans, before, entry.seed, time,
                    sum(samples[k] for k in scans), about(entry),
                )
            )  # fmt: skip
            before += len(scans)
    return found


def _names(source: Source, entry: Entry, others: Sequence[Combination]) -> tuple[str, str]:
    """Name of a combination and the folder of its products."""
    name = ", ".join(f"{k}={v}" for k, v in entry.combination)
    texts = [f"{k}={_short(v)}" for k, v in entry.combination if k != "observation" or len(entry.combination) == 1]
    folder = product_path("", "_".join(texts)).name if texts else ""
    folder = "/".join(filter(None, (source.name, folder)))
    taken = {c.folder for c in others}
    plain, k = folder, 2
    while folder in taken:
        folder, k = f"{plain}.{k}", k + 1
    return ", ".join(filter(None, (source.name, name))), folder


def _short(value: Any) -> str:
    return str(value) if not isinstance(value, dict) else "_".join(f"{k}={v}" for k, v in value.items())


def _with_budget(file: PipelineFile, share: float) -> PipelineFile:
    budget = file.header.budget
    budget = budget * share if isinstance(budget, float | int) else budget
    return dataclasses.replace(file, header=file.header.model_copy(update={"budget": budget, "campaign": None}))


class _placed:
    """Name the entry in every error of the body."""

    def __init__(self, place: str) -> None:
        self.place = place

    def __enter__(self) -> None: ...

    def __exit__(self, kind: Any, err: Any, trace: Any) -> None:
        if isinstance(err, ZondaError) and not hasattr(err, "diagnostics"):
            err.place = f"entry {self.place}" + (f": {err.place}" if err.place else "")


def _files(file: PipelineFile) -> dict[str, str]:
    """The file and the inputs that it names, each with its stamp."""
    found: dict[str, str] = {}
    if Path(file.place).is_file():
        path = Path(file.place).resolve()
        found[str(path)] = _stamp(path, "text")
    models: list[Any] = [*file.operators, file.scene().weather]
    for model in filter(None, models):
        for field in type(model).model_fields:
            value = getattr(model, field)
            if isinstance(value, Path) and value.is_file():
                found[str(value)] = _stamp(value, "file")
    return found


def _stamp(path: Path, kind: str) -> str:
    try:
        if kind == "text":
            return f"text:{digest_of_text(path.read_text(encoding='utf-8', errors='replace'))}"
        stat = path.stat()
    except OSError:
        return "missing"
    return f"{kind}:{stat.st_size}:{stat.st_mtime_ns}"
