"""From pipeline files to a `Job`: entries, plans, common grids, tasks."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..configuration.files import paths_in
from ..errors import InputError, within
from ..scene import WithScene
from ..storage.files import product_path
from . import parts
from .campaign_file import (
    INPUTS,
    Combination,
    Job,
    Task,
    digest_of_text,
    key_of,
    layout_path,
    plural,
)
from .entries import Entry, entries
from .settings import MOST_TASKS, Campaign

if TYPE_CHECKING:
    from ..configuration.pipeline_file import PipelineFile
    from ..configuration.time import Instant
    from ..scene import Scene


MEASURED = 8
"""Pipelines of each combination that are asked how much memory they need."""


@dataclass(frozen=True)
class CampaignFile:
    """A pipeline file and the settings from the command line. ``load(settings)`` reads it with
    further ones.
    """

    file: PipelineFile
    load: Callable[[tuple[str, ...]], PipelineFile]
    name: str
    """Folder of its products where there are several files, else ''."""

    @property
    def campaign(self) -> Campaign:
        """The file's campaign, or one of a single entry."""
        return self.file.header.campaign or Campaign()


@dataclass(frozen=True)
class Look:
    """Pointing of one entry: number of its pipeline, seed, start; its name in messages."""

    pipeline: int
    seed: int
    time: Instant
    place: str

    def scene(self, files: Sequence[PipelineFile]) -> Scene:
        """The scene of one of these files, at its time."""
        return scene_of(files[self.pipeline], self.seed, self.time)


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

    draft, first = _Draft(folder, pruning, say), sources[0].campaign
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
        tasks=tuple(draft.tasks),
        same_machine=first.same_machine,
        figures=any(source.campaign.figures for source in sources),
        need=draft.need,
    )


class _Draft:
    """A campaign that is being planned, one pipeline file after the other."""

    def __init__(
        self, folder: Path, pruning: Pruning, say: Callable[[int, int, str], None]
    ) -> None:
        self._folder, self._pruning, self._say = folder, pruning, say
        self.pipelines: list[str] = []
        self.plans: list[tuple[tuple[str, ...], ...]] = []
        self.combinations: list[Combination] = []
        self.tasks: list[Task] = []
        self.inputs: dict[str, str] = {}
        self.need = 0
        self._files: list[PipelineFile] = []
        self._entries = 0

    def add(self, source: CampaignFile) -> None:
        """Add all entries of a pipeline file."""
        found = _entries(source)
        self.inputs |= _inputs(source.file, self._folder)
        together: dict[str, list[tuple[int, Entry]]] = {}
        for number, entry in enumerate(found, self._entries):
            together.setdefault(repr(entry.combination), []).append((number, entry))
        self._entries += len(found)
        planned: dict[tuple[tuple[str, ...], float], int] = {}
        done = 0
        for members in together.values():
            share, looks = 1 / math.sqrt(len(members)), []
            for _, entry in members:
                self._say(done, len(found), "campaign: plans and grids")
                done += 1
                if (
                    entry.settings,
                    share,
                ) not in planned:  # those that differ in seed and night alone share a plan
                    planned[entry.settings, share] = self._plan(source, entry, share)
                looks.append(
                    Look(planned[entry.settings, share], entry.seed, entry.time, about(entry))
                )
            self._combine(source, members, looks)

    def _plan(self, source: CampaignFile, entry: Entry, share: float) -> int:
        """Plan an entry's pipeline; its number."""
        from ..assembly.checks import run_checks
        from ..plan.bands import for_run

        with within(f"entry {about(entry) or source.file.header.name}"):
            file = _with_budget(source.load(entry.settings), share)
            scene = scene_of(file, entry.seed, entry.time)
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
        self, source: CampaignFile, members: Sequence[tuple[int, Entry]], looks: Sequence[Look]
    ) -> None:
        """One set of products: the layout of all that is co-added, and its tasks."""
        layouts, scans = common_layouts(looks, self._files, self._folder)
        firsts = {look.pipeline: look for look in reversed(looks)}
        for look in list(firsts.values())[:MEASURED]:
            pipeline = self._files[look.pipeline].pipeline()
            data = pipeline.point(look.scene(self._files), layouts, self._folder, laid_out=True)
            self.need = max(self.need, pipeline.least_memory(data.observations))
        name, subfolder = _names(source, members[0][1], self.combinations)
        path = layout_path(self._folder, len(self.combinations))
        parts.write(path, "layout", {"layouts": layouts})
        self.combinations.append(
            Combination(name, subfolder, parts.digest_of(path), members[0][1].combination)
        )
        before = 0
        for (number, _), look, samples in zip(members, looks, scans, strict=True):
            every = tuple(range(len(samples)))
            for own in [every] if source.campaign.task == "entry" else [(k,) for k in every]:
                self._task(number, look, own, before, sum(samples[k] for k in own))
                before += len(own)

    def _task(
        self, entry: int, look: Look, scans: tuple[int, ...], before: int, samples: int
    ) -> None:
        from zonda import __version__

        time, combination = look.time.nanoseconds, len(self.combinations) - 1
        pipeline, layout = self.pipelines[look.pipeline], self.combinations[combination].layout
        key = key_of(__version__, pipeline, look.seed, time, scans, before == 0, layout)
        number = len(self.tasks)
        if number == MOST_TASKS:
            raise InputError(
                f"a campaign of more than {MOST_TASKS} tasks",
                cure="set campaign.task: entry, or make it smaller",
            )
        self.tasks.append(
            Task(
                number,
                key,
                look.pipeline,
                combination,
                entry,
                scans,
                before,
                look.seed,
                time,
                samples,
                look.place,
            )
        )


def _entries(source: CampaignFile) -> list[Entry]:
    if source.campaign.realizations > 1:
        _check_draws(source.file)
    return entries(
        source.campaign,
        source.file.scene().seed,
        lambda settings: source.load(settings).scene().time,
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
    return text, _with_budget(source.load(first.settings), 1 / math.sqrt(together))


def about(entry: Entry) -> str:
    """An entry's place on the axes, e.g. ``site=atacama, night=3``."""
    return ", ".join(f"{k}={v}" for k, v in entry.values.items())


def scene_of(file: PipelineFile, seed: int, time: Instant) -> Scene:
    """The file's scene with another seed and start."""
    return file.scene().model_copy(update={"seed": seed, "time": time})


def changed(job: Job, folder: Path) -> list[str]:
    """Files that have changed since the campaign in ``folder`` was planned."""
    return [
        path
        for path, stamp in job.files.items()
        if _stamp(folder / path, stamp.partition(":")[0]) != stamp
    ]


def common_layouts(
    looks: Sequence[Look], files: Sequence[PipelineFile], folder: Path
) -> tuple[dict[str, Mapping[str, Any]], list[tuple[int, ...]]]:
    """The layouts of all scans of a combination; and the samples (detectors x samples) of each
    entry's scans.

    The telescope is pointed for one entry after the other, once for those that begin at the same
    time, and only as long as that can change something. Raises `PointingError` where it cannot be.
    """
    layouts: dict[str, Mapping[str, Any]] = {}
    by_start: dict[tuple[int, int], tuple[int, ...]] = {}
    by_pipeline: dict[int, tuple[int, ...]] = {}
    for look in looks:
        at = look.pipeline, look.time.nanoseconds
        if at in by_start:
            continue
        settled = bool(layouts) and all(layout.get("fixed") for layout in layouts.values())
        if not settled or look.pipeline not in by_pipeline:
            with within(f"entry {look.place}"):
                data = files[look.pipeline].pipeline().point(look.scene(files), layouts, folder)
            layouts = data.layouts
            bands = len(data.observations) // len(data.scans)
            sizes = [o.n_detectors * o.n_samples for o in data.observations]
            by_pipeline[look.pipeline] = tuple(
                sum(sizes[k : k + bands]) for k in range(0, len(sizes), bands)
            )
        by_start[at] = by_pipeline[look.pipeline]
    return layouts, [by_start[look.pipeline, look.time.nanoseconds] for look in looks]


def restore_layout(job: Job, folder: Path, number: int) -> None:
    """Write the layout of a combination again, from its tasks. Raises InputError where it is not
    the same as before.
    """
    from ..configuration.pipeline_file import parse
    from ..configuration.time import Instant

    first = {task.entry: task for task in reversed(job.tasks_of(number))}
    looks = [
        Look(t.pipeline, t.seed, Instant(t.time), t.about)
        for t in sorted(first.values(), key=lambda t: t.number)
    ]
    files = [parse(text, name="campaign", folder=folder) for text in job.pipelines]
    path = layout_path(folder, number)
    parts.write(path, "layout", {"layouts": common_layouts(looks, files, folder)[0]})
    if parts.digest_of(path) != job.combinations[number].layout:
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
    plain, k = folder, 2
    while folder in taken:
        folder, k = f"{plain}.{k}", k + 1
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
        file, header=file.header.model_copy(update={"budget": budget, "campaign": None})
    )


def _inputs(file: PipelineFile, folder: Path) -> dict[str, str]:
    """The file and the inputs that it names, each with its stamp; of those in the campaign's own
    ``folder`` a hash.
    """
    own, root = [Path(file.place).resolve()] if Path(file.place).is_file() else [], folder.resolve()
    arrays = root / INPUTS
    inputs = [path for path in paths_in([file.scene(), *file.operators]) if path.is_file()]
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
            with open(path, "rb") as content:
                return f"bytes:{hashlib.file_digest(content, 'blake2b').hexdigest()[:32]}"
        stat = path.stat()
    except OSError:
        return "missing"
    return f"{kind}:{stat.st_size}:{stat.st_mtime_ns}"
