"""From pipeline files to a `Job`: entries, plans, common grids, tasks."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError, within
from ..experiment.variant import FileVariant
from ..scene import WithScene
from ..storage.files import product_path
from . import trees
from .campaign_file import (
    INPUTS,
    Combination,
    Job,
    PlannedEntry,
    Task,
    digest_of_text,
    layout_path,
    plural,
)
from .settings import MOST_TASKS, Campaign, Entry, entries

if TYPE_CHECKING:
    from ..configuration.pipeline_file import PipelineFile


MEASURED = 8
"""Pipelines of each combination that are asked how much memory they need."""


@dataclass(frozen=True)
class CampaignFile:
    """A pipeline file of a campaign, with the settings from the command line; its entries are
    further variants.
    """

    variant: FileVariant
    name: str = ""
    """Folder of its products where there are several files, else ''."""

    @property
    def file(self) -> PipelineFile:
        """The file itself."""
        return self.variant.file

    @property
    def campaign(self) -> Campaign:
        """The file's campaign, or one of a single entry."""
        return self.file.header.campaign or Campaign()


@dataclass(frozen=True)
class Pruning:
    """Options of the planner, as `zonda run` takes them."""

    keep: Sequence[str] = ()
    drop: Sequence[str] = ()
    prune_all: bool | None = None


def job(
    sources: Sequence[CampaignFile],
    folder: Path,
    command: str,
    pruning: Pruning,
    say: Callable[[int, int, str], None] = lambda done, total, what: None,
) -> Job:
    """Plan a campaign and write the layouts of its maps to ``folder``.

    Entries that differ in more than seed and night are planned one by one. Where n scans are
    co-added, the budget for the errors of the plan is that of one observation divided by sqrt(n):
    such errors may add up while noise averages down.

    Raises
    ------
    ZondaError
        As planning and pointing do, with the entry in its place; and for names of products that are
        not unique.
    """
    from zonda import __version__

    draft = _Draft(folder, pruning, say)
    first = sources[0].campaign
    for source in sources:
        draft.add(source)
    return Job(
        name=sources[0].file.header.name if len(sources) == 1 else "campaign",
        version=__version__,
        command=command,
        retries=first.retries,
        keep_tasks=first.keep_tasks,
        pipelines=tuple(draft.pipelines),
        plans=tuple(draft.plans),
        source=tuple(source.file.resolved_yaml(folder) for source in sources),
        files=draft.inputs,
        combinations=tuple(draft.combinations),
        entries=tuple(draft.entries),
        tasks=tuple(draft.tasks),
        same_machine=first.same_machine,
        figures=any(source.campaign.figures for source in sources),
        need=draft.need,
    )


class _Draft:
    """A campaign that is being planned, one pipeline file after the other."""

    def __init__(
        self,
        folder: Path,
        pruning: Pruning,
        say: Callable[[int, int, str], None],
    ) -> None:
        self._folder = folder
        self._pruning = pruning
        self._say = say
        self.pipelines: list[str] = []
        self.plans: list[tuple[tuple[str, ...], ...]] = []
        self.combinations: list[Combination] = []
        self.entries: list[PlannedEntry] = []
        self.tasks: list[Task] = []
        self.inputs: dict[str, str] = {}
        self.need = 0
        self._files: list[PipelineFile] = []

    def add(self, source: CampaignFile) -> None:
        """Add all entries of a pipeline file."""
        found = _entries(source)
        self.inputs |= _inputs(source.file, self._folder)
        together: dict[str, list[int]] = {}
        for number, entry in enumerate(found):
            together.setdefault(repr(entry.combination), []).append(number)
        planned: dict[tuple[tuple[str, ...], float], int] = {}
        entries: dict[int, PlannedEntry] = {}
        for members in together.values():
            share = 1 / math.sqrt(len(members))
            for number in members:
                self._say(len(entries), len(found), "campaign: plans and grids")
                entry = found[number]
                plan = (found[number].settings, share)
                if plan not in planned:  # those that differ in seed and night alone share a plan
                    planned[plan] = self._plan(source, entry, share)
                entries[number] = PlannedEntry(
                    planned[plan],
                    entry.seed,
                    entry.time.nanoseconds,
                    about(entry),
                )
            own = {number + len(self.entries): entries[number] for number in members}
            self._combine(source, found[members[0]], own)
        self.entries += [entries[number] for number in range(len(found))]

    def _plan(self, source: CampaignFile, entry: Entry, share: float) -> int:
        """Plan an entry's pipeline; its number."""
        from ..assembly.checks import run_checks
        from ..plan.planner import for_run

        with within(f"entry {about(entry) or source.file.header.name}"):
            file = _with_budget(source.variant.changed(entry.settings).file, share)
            scene = file.scene().model_copy(update={"seed": entry.seed, "time": entry.time})
            if entry.settings:  # the error names the entry, not a line of the file
                run_checks(file.pipeline(), scene)
            else:
                file.look(scene=scene)
            made = for_run(
                file,
                keep=self._pruning.keep,
                drop=self._pruning.drop,
                prune_all=self._pruning.prune_all,
            )
        self._files.append(made.apply(file))
        self.pipelines.append(self._files[-1].resolved_yaml(self._folder))
        self.plans.append(tuple(tuple(map(str, row)) for row in made.short))
        self.inputs |= _inputs(self._files[-1], self._folder)
        return len(self.pipelines) - 1

    def _combine(
        self,
        source: CampaignFile,
        first: Entry,
        entries: Mapping[int, PlannedEntry],
    ) -> None:
        """One set of products: the layout of all that is co-added, and its tasks."""
        from zonda import __version__

        members = list(entries.values())
        layouts, scans = common_layouts(members, self._files, self._folder)
        firsts = {entry.pipeline: entry for entry in reversed(members)}
        for entry in list(firsts.values())[:MEASURED]:
            file = self._files[entry.pipeline]
            pipeline = file.pipeline()
            data = pipeline.point(entry.scene(file), layouts, self._folder, laid_out=True)
            self.need = max(self.need, pipeline.least_memory(data.observations))
        name, subfolder = _names(source, first, self.combinations)
        path = layout_path(self._folder, len(self.combinations))
        trees.write(path, "layout", {"layouts": layouts})
        layout = trees.digest_of(path)
        before = 0
        self.combinations.append(Combination(name, subfolder, layout, first.combination))
        for (number, entry), samples in zip(entries.items(), scans, strict=True):
            every = tuple(range(len(samples)))
            for own in [every] if source.campaign.task == "entry" else [(k,) for k in every]:
                made_of = (
                    __version__,
                    self.pipelines[entry.pipeline],
                    entry.seed,
                    entry.time,
                    own,
                    before == 0,
                    layout,
                )
                task = Task(
                    len(self.tasks),
                    digest_of_text(json.dumps(made_of)),
                    len(self.combinations) - 1,
                    number,
                    own,
                    before,
                    sum(samples[k] for k in own),
                )
                if task.number == MOST_TASKS:
                    raise InputError(
                        f"a campaign of more than {MOST_TASKS} tasks",
                        cure="set campaign.task: entry, or make it smaller",
                    )
                self.tasks.append(task)
                before += len(own)


def _entries(source: CampaignFile) -> list[Entry]:
    if source.campaign.realizations > 1:
        _check_draws(source.file)
    return entries(
        source.campaign,
        source.file.scene().seed,
        lambda settings: source.variant.changed(settings).file.scene().time,
    )


def _check_draws(file: PipelineFile) -> None:
    """Refuse realizations of recorded data alone (`InputError`): they have the same bits for every
    seed.
    """
    pipeline = file.pipeline()
    for step in pipeline.operators:
        if (
            isinstance(step, WithScene)
            and pipeline.signals.components
            and pipeline.signals.components <= step.provides
        ):
            raise InputError(
                "recorded data are the same in every realization: nothing is simulated beside them",
                place=f"campaign, realizations, {step.label}",
                cure=(
                    "leave realizations out, or simulate a twin (signal: none); where a step draws"
                    " random numbers, list seeds: observations: [{seed: 1}, {seed: 2}]"
                ),
            )


def outline(source: CampaignFile) -> tuple[str, PipelineFile]:
    """A campaign in one line; and its first entry as a pipeline file, with its share of the
    budget.
    """
    found = _entries(source)
    first = found[0]
    together = sum(e.combination == first.combination for e in found)
    sets = len({repr(e.combination) for e in found})
    number = "1 entry" if len(found) == 1 else f"{len(found)} entries"
    text = f"campaign of {number}, combined into {plural(sets, 'set')} of products"
    return text, _with_budget(source.variant.changed(first.settings).file, 1 / math.sqrt(together))


def about(entry: Entry) -> str:
    """An entry's place on the axes, e.g. ``site=atacama, night=3``."""
    return ", ".join(f"{k}={v}" for k, v in entry.values.items())


def changed(job: Job, folder: Path) -> list[str]:
    """Files that have changed since the campaign in ``folder`` was planned."""
    return [
        path
        for path, stamp in job.files.items()
        if _stamp(folder / path, stamp.partition(":")[0]) != stamp
    ]


def common_layouts(
    entries: Sequence[PlannedEntry],
    files: Sequence[PipelineFile],
    folder: Path,
) -> tuple[dict[str, Mapping[str, Any]], list[tuple[int, ...]]]:
    """The layouts of all scans of a combination; and the samples (detectors x samples) of each
    entry's scans.

    The telescope is pointed for one entry after the other, once for those that begin at the same
    time, and only as long as that can change something. Raises `PointingError` where it cannot be.
    """
    layouts: dict[str, Mapping[str, Any]] = {}
    by_start: dict[tuple[int, int], tuple[int, ...]] = {}
    by_pipeline: dict[int, tuple[int, ...]] = {}
    for entry in entries:
        if (entry.pipeline, entry.time) in by_start:
            continue
        settled = bool(layouts) and all(layout.get("fixed") for layout in layouts.values())
        if not settled or entry.pipeline not in by_pipeline:
            file = files[entry.pipeline]
            with within(f"entry {entry.about}"):
                data = file.pipeline().point(entry.scene(file), layouts, folder)
            layouts = data.layouts
            bands = len(data.observations) // len(data.scans)
            sizes = [o.n_detectors * o.n_samples for o in data.observations]
            by_pipeline[entry.pipeline] = tuple(
                sum(sizes[k : k + bands]) for k in range(0, len(sizes), bands)
            )
        by_start[entry.pipeline, entry.time] = by_pipeline[entry.pipeline]
    return layouts, [by_start[entry.pipeline, entry.time] for entry in entries]


def restore_layout(job: Job, folder: Path, number: int) -> None:
    """Write the layout of a combination again, from its tasks. Raises InputError where it is not
    the same as before.
    """
    from ..configuration.pipeline_file import parse

    numbers = dict.fromkeys(task.entry for task in job.tasks_of[number])
    files = [parse(text, name="campaign", folder=folder) for text in job.pipelines]
    path = layout_path(folder, number)
    entries = [job.entries[entry] for entry in numbers]
    trees.write(path, "layout", {"layouts": common_layouts(entries, files, folder)[0]})
    if trees.digest_of(path) != job.combinations[number].layout:
        raise InputError(
            "differs from the layout that was planned",
            place=str(path),
            cure="the pointing has changed since (another version?): run the campaign again",
        )


def _names(source: CampaignFile, entry: Entry, others: Sequence[Combination]) -> tuple[str, str]:
    """Name of a combination and the folder of its products."""
    name = ", ".join(f"{k}={v}" for k, v in entry.combination)
    texts = [
        f"{k}={_short(v)}"
        for k, v in entry.combination
        if k != "observation" or len(entry.combination) == 1
    ]
    folder = product_path("", "_".join(texts)).name if texts else ""
    folder = "/".join(filter(None, (source.name, folder)))
    taken = {c.folder for c in others}
    plain = folder
    k = 2
    while folder in taken:
        folder = f"{plain}.{k}"
        k = k + 1
    return ", ".join(filter(None, (source.name, name))), folder


def _short(value: Any) -> str:
    return (
        str(value)
        if not isinstance(value, dict)
        else "_".join(f"{k}={v}" for k, v in value.items())
    )


def _with_budget(file: PipelineFile, share: float) -> PipelineFile:
    budget = file.header.budget
    budget = budget * share if isinstance(budget, float | int) else budget
    return dataclasses.replace(
        file,
        header=file.header.model_copy(update={"budget": budget, "campaign": None}),
    )


def _inputs(file: PipelineFile, folder: Path) -> dict[str, str]:
    """The file and the inputs that it names, each with its stamp; of those in the campaign's own
    ``folder`` a hash.
    """
    own = [Path(file.place).resolve()] if Path(file.place).is_file() else []
    root = folder.resolve()
    arrays = root / INPUTS
    inputs = file.inputs
    stamps = {str(p): _stamp(p, "file") for p in inputs if not p.is_relative_to(arrays)}
    stamps |= {
        str(p.relative_to(root)): _stamp(p, "bytes") for p in inputs if p.is_relative_to(arrays)
    }
    return {str(p): _stamp(p, "text") for p in own} | stamps


def _stamp(path: Path, kind: str) -> str:
    try:
        if kind == "text":
            return f"text:{digest_of_text(path.read_text(encoding='utf-8', errors='replace'))}"
        if kind == "bytes":
            return f"bytes:{trees.digest_of(path)}"
        stat = path.stat()
    except OSError:
        return "missing"
    return f"{kind}:{stat.st_size}:{stat.st_mtime_ns}"
