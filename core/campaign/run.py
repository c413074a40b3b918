"""Begin, work through, resume and finish a campaign; the table of its figures: ``sweep.ecsv``,
``sweep.html`` and ``sweep.png``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .. import hooks
from ..canvas import SEQUENCE, new_axes
from ..configuration.units import factor_to
from ..errors import InputError, OutputError, PipelineError, ZondaError
from ..experiment.engines import Pool, share_out
from ..experiment.experiment import Values
from ..storage import output_folder
from ..storage.files import atomic_path, check_output_folder, write_text
from ..tables import Table, render
from . import trees
from .campaign_file import FILE, Job, Say, Task, digest_of_text, layout_path, plural
from .folder import (
    RESOLVED,
    Record,
    check_free,
    check_links,
    clean,
    make_way,
    publish,
    sources_of,
    write_sources,
)
from .machines import Watch
from .prepare import CampaignFile, Pruning, changed, restore_layout
from .prepare import job as prepare
from .tasks import CampaignResult, Combinations, Tasks

LOGARITHMIC = 8.0
"""Ratio of the largest to the smallest swept value from which the axis is logarithmic."""

COLUMNS = {
    "figure": "metric and parameters",
    "unit": "of mean, scatter and standard_error; empty: a pure number",
    "mean": "over realizations",
    "scatter": "standard deviation of one realization; nan: not known",
    "standard_error": "of the mean; nan: not known",
    "realizations": "number of realizations",
}


@dataclass(frozen=True)
class Point:
    """A figure at one point of the axes, whose values are texts as in YAML."""

    axes: dict[str, str]
    name: str
    unit: str
    values: Values


def write_table(record: Record) -> None:
    """Write the table of a campaign whose combinations are all finished."""
    job = record.job
    folder = record.folder
    points = collected(record)
    axes = list(dict.fromkeys(key for point in points for key in point.axes))
    rows = [
        {key: point.axes.get(key, "") for key in axes}
        | {
            "figure": point.name,
            "unit": point.unit,
            "mean": point.values.mean,
            "scatter": point.values.scatter,
            "standard_error": point.values.standard_error,
            "realizations": len(point.values.values),
        }
        for point in points
    ]
    meta = {"PIPELINE": job.name, "ZONDA": job.version, "COMMAND": job.command}
    table = Table.of(rows, dict.fromkeys(axes, "value on this axis") | COLUMNS, meta)
    table.write(folder / "sweep.ecsv")
    with atomic_path(folder / "sweep.png") as temporary:
        draw(points).savefig(temporary, bbox_inches="tight")
    page = render("zonda.core", "sweep.html", title=job.name, head=table.head, rows=table.shown())
    write_text(folder / "sweep.html", page)


def collected(record: Record) -> list[Point]:
    """Figures at every point, figure by figure."""
    job = record.job
    found: dict[str, dict[tuple[Any, ...], list[tuple[str, float, float]]]] = {}
    for number, combination in enumerate(job.combinations):
        own = [a for a in combination.axes if a[0] not in ("realization", "observation")]
        source = combination.folder.partition("/")[0] if len(job.source) > 1 else ""
        place = (source, *((key, _cell(value)) for key, value in own))
        for name, value, unit, error, _ in record.combined[number]:
            found.setdefault(name, {}).setdefault(place, []).append((unit, value, error))
    return [
        Point(
            dict(place[1:]),
            name,
            rows[0][0],
            Values(tuple(value for _, value, _ in rows), rows[0][2]),
        )
        for name, places in found.items()
        for place, rows in places.items()
    ]


def draw(points: Sequence[Point]) -> Any:
    """A matplotlib figure with a panel for each figure: mean and standard error (scatter, thin)
    against the first axis that changes; one line for each combination of the others."""
    names = list(dict.fromkeys(point.name for point in points))
    size = (6.4, 0.6 + 3.0 * len(names))
    axes = new_axes(size, nrows=len(names), squeeze=False, gridspec_kw={"hspace": 0.4})[:, 0]
    for ax, name in zip(axes, names, strict=True):
        _panel(ax, [point for point in points if point.name == name])
    return axes[0].figure


def _panel(ax: Any, points: Sequence[Point]) -> None:
    keys = list(dict.fromkeys(key for point in points for key in point.axes))
    changing = [k for k in keys if len({point.axes.get(k) for point in points}) > 1]
    first, others = (changing[0], changing[1:]) if changing else ("", [])
    places, unit, ticks = _positions([point.axes.get(first, "") for point in points])
    lines: dict[str, list[tuple[float, Values]]] = {}
    for place, point in zip(places, points, strict=True):
        name = ", ".join(f"{key}={point.axes.get(key, '')}" for key in others)
        lines.setdefault(name, []).append((place, point.values))
    for number, (name, line) in enumerate(lines.items()):
        line.sort(key=lambda item: item[0])
        colour = SEQUENCE[number % len(SEQUENCE)]
        x = [place for place, _ in line]
        mean, scatter, error = np.array([(v.mean, v.scatter, v.standard_error) for _, v in line]).T
        for size, style in ((scatter, {"lw": 0.7, "alpha": 0.6}), (error, {"lw": 2.2})):
            ax.vlines(x, mean - size, mean + size, colour, **style)
        ax.plot(x, mean, "o-", color=colour, ms=5, lw=1, label=name or None)
    if ticks:
        ax.set_xticks(range(len(ticks)), ticks)
    elif min(places) > 0 and max(places) / min(places) >= LOGARITHMIC:
        ax.set_xscale("log")
    ax.set_xlabel(f"{first} [{unit}]" if unit else first)
    ax.set_title(points[0].name, fontsize=9, loc="left")
    ax.set_ylabel(points[0].unit)
    ax.grid(True, color="#dddddd", lw=0.6)
    if len(lines) > 1:
        ax.legend(fontsize=7, frameon=False)


_QUANTITY = re.compile(r"\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(.*?)\s*$")


def _positions(values: Sequence[str]) -> tuple[list[float], str, list[str]]:
    """Places of values on an axis, the unit (that of the first), and the ticks where they are
    names.
    """
    found = [match.groups() for value in values if (match := _QUANTITY.match(value))]
    unit = found[0][1] if found else ""
    factors = [factor_to(unit, own) for _, own in found]
    if len(found) == len(values) and None not in factors:
        return [float(n) * (f or 0.0) for (n, _), f in zip(found, factors, strict=True)], unit, []
    names = list(dict.fromkeys(values))
    return [float(names.index(value)) for value in values], "", names


def _cell(value: Any) -> str:
    return value if isinstance(value, str) else "" if value is None else json.dumps(value)


def begin(
    sources: Sequence[CampaignFile],
    folder: Path,
    command: str,
    pool: Pool,
    say: Say,
    pruning: Pruning = Pruning(),
) -> CampaignResult:
    """Run a new campaign. The caller holds the folder's lock.

    Raises
    ------
    OutputError
        Where the folder holds an unfinished campaign, or cannot be written.
    ZondaError
        For mistakes in the campaign; and at the end where tasks have failed.
    """
    check_output_folder(folder)
    check_free(folder)
    check_links(folder)
    old = output_folder.earlier(folder, [path for source in sources for path in _read_by(source)])
    if (folder / RESOLVED).exists() and not (old or (folder / FILE).exists()):
        say(
            f"{folder} holds products of an earlier run: those of the same names are replaced,"
            " others stay"
        )
    make_way(folder)
    try:
        made = prepare(sources, folder, command, pruning, _progress())
        share_out(pool, made.need, made.name)
    except BaseException:
        make_way(folder)  # of the layouts of a campaign that does not begin
        raise
    _describe(made, folder, say)
    check_links(folder, made)
    make_way(folder, made)
    if old:
        say(f"{folder}: {plural(len(old), 'file')} of an earlier run removed")
    output_folder.clear(folder, old)
    made.write(folder)
    with output_folder.recording(folder, anew=False):
        write_sources(made, folder)
    record = Record(made, folder)
    return _work(record, pool, _watch(record, made.same_machine, say), made.tasks)


def resume(
    folder: Path,
    pool: Pool,
    say: Say,
    *,
    anyway: bool = False,
    same_machine: bool | None = None,
) -> CampaignResult:
    """Go on with a campaign: what is done is verified, what is missing is run. The caller holds the
    folder's lock.

    ``same_machine``: refuse what another kind of machine made, or do not; default: as the campaign
    has it.

    Raises
    ------
    InputError
        Where there is no campaign, its file is damaged, or zonda or a file has changed (not with
        ``anyway``).
    """
    job = Job.read(folder)
    check_links(folder, job)
    strict = job.same_machine if same_machine is None else same_machine
    check_unchanged(job, folder, anyway)
    share_out(pool, job.need, job.name)
    clean(folder, job)
    record = Record(job, folder)
    for number, combination in enumerate(job.combinations):
        layout = layout_path(folder, number)
        if number not in record.combined and trees.digest_of(layout) != combination.layout:
            restore_layout(job, folder, number)
    waiting = [task for task in job.tasks if task.combination not in record.combined]
    missing = record.verify(waiting, say, strict)
    return _work(record, pool, _watch(record, strict, say), missing)


def share(
    sources: Sequence[CampaignFile],
    folder: Path,
    command: str,
    pool: Pool,
    say: Say,
    pruning: Pruning,
    which: tuple[int, int],
) -> CampaignResult:
    """Run every n-th task from the k-th on (counted from 1), where ``which`` is (k, n): a job of an
    array. Combines nothing.

    The first job there works the campaign out. The caller holds the lock of its share.
    """
    from zonda import __version__

    check_output_folder(folder)
    check_links(folder)
    if not (folder / FILE).exists():
        old = output_folder.earlier(folder)
        if old and not (folder / FILE).exists():  # nor did another job begin in between
            raise OutputError(
                f"holds {plural(len(old), 'file')} of an earlier run",
                place=str(folder),
                cure="remove them, or choose another output folder",
            )
        made = prepare(sources, folder, command, pruning, _progress())
        check_links(folder, made)
        publish(made, folder)
        with output_folder.recording(folder, anew=False):
            write_sources(made, folder)
    job = Job.read(folder)
    if (
        job.source != tuple(s.file.resolved_yaml(folder) for s in sources)
        or job.version != __version__
    ):
        raise OutputError(
            "holds another campaign",
            place=str(folder),
            cure="choose another output folder",
        )
    share_out(pool, job.need, job.name)
    mine = [task for task in job.tasks if task.number % which[1] == which[0] - 1]
    record = Record(job, folder, f".{which[0]}-of-{which[1]}")
    missing = record.verify(mine, say, same_machine=False)
    result = Tasks(record, pool, _watch(record, job.same_machine, say)).run(missing)
    _tell(result, say)
    _fail(result, len(mine))
    return result


def check_unchanged(job: Job, folder: Path, anyway: bool) -> None:
    """Refuse to go on with another zonda or other files than at the beginning."""
    from zonda import __version__

    reasons = []
    if job.version != __version__:
        reasons.append(f"it began with zonda {job.version}, this is {__version__}")
    for path, text in zip(sources_of(job, folder), job.source, strict=True):
        if not path.is_file() or digest_of_text(
            path.read_text(encoding="utf-8", errors="replace")
        ) != digest_of_text(text):
            reasons.append(f"{path} has changed")
    reasons += [f"{path} has changed or is gone" for path in changed(job, folder)]
    if reasons and not anyway:
        raise InputError(
            "; ".join(reasons),
            place=str(folder),
            cure=(
                "the maps would mix two versions: run the campaign anew in another folder, or"
                " continue with --anyway"
            ),
        )


def _watch(record: Record, strict: bool, say: Say) -> Watch:
    known = {row.number: row.machine for row in record.rows() if row.machine}
    return Watch(known, strict, record.folder, say)


def _work(record: Record, pool: Pool, watch: Watch, tasks: Sequence[Task]) -> CampaignResult:
    """Run tasks, combine what is complete, remove partial products."""
    job = record.job
    folder = record.folder
    result = Tasks(record, pool, watch).run(tasks)
    if result.tasks:
        _tell(result, watch.say)
    incomplete = {task.combination for task in job.tasks if task.number not in record.done}
    ready = [n for n in range(len(job.combinations)) if n not in incomplete | set(record.combined)]
    with output_folder.recording(folder, anew=False):
        Combinations(record, result, pool).carry_out(ready)
    clean(folder, job)  # of workers that were killed while they wrote
    _fail(result, len(job.tasks))
    if missing := len(job.tasks) - len(record.done):
        raise PipelineError(
            f"{missing} tasks were not run",
            place=str(folder),
            cure=f"zonda resume {folder}",
        )
    if job.figures:
        with output_folder.recording(folder, anew=False):
            write_table(record)
    record.finish()
    return result


def _read_by(source: CampaignFile) -> list[Path]:
    """Pipeline file and input files of a campaign."""
    return [Path(source.file.place), *source.file.inputs]


def _progress() -> Callable[[int, int, str], None]:
    hook = hooks.manager().hook
    return lambda done, total, what: hook.zonda_progress(done=done, total=total, what=what)


def _describe(job: Job, folder: Path, say: Say) -> None:
    entries = len({task.entry for task in job.tasks})
    counts = [
        "1 entry" if entries == 1 else f"{entries} entries",
        plural(len(job.tasks), "task"),
        job.sets,
    ]
    say(f"campaign: {', '.join(counts)}, {job.samples:.3g} samples; zonda status {folder}")


def _tell(result: CampaignResult, say: Say) -> None:
    rate = result.samples / result.seconds if result.seconds else 0.0
    say(f"{plural(result.tasks, 'task')} in {result.seconds:.1f} s, {rate:.3g} samples/s")


def _fail(result: CampaignResult, total: int) -> None:
    if result.failed:
        number, error = min(result.failed.items())
        last = error.strip().splitlines()[-1] if error.startswith("Traceback") else error
        raise ZondaError(
            f"{len(result.failed)} of {total} tasks failed; the first is {number}: {last}",
            place=str(result.folder),
            cure=(
                f"zonda status {result.folder} lists them; zonda resume {result.folder} tries them"
                " again"
            ),
        )
