"""``zonda status``, ``zonda resume``, and ``zonda run`` of a campaign. Only click is imported with this module."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from .job import Job, Task
    from .log import Row
    from .prepare import Source
    from .settings import Campaign
    from .work import Result

ENGINES = ("serial", "processes", "mpi", "dask")

engine_option = click.option("--engine", type=click.Choice(ENGINES), help="What works on the tasks.  [default: as in the file]")
workers_option = click.option("--workers", type=click.IntRange(min=1), metavar="N", help="Processes of --engine processes.")
scheduler_option = click.option("--scheduler", metavar="ADDRESS", help="Of Dask, e.g. tcp://host:8786, or its scheduler file.")


def run(
    pipelines: Sequence[str],
    settings: tuple[str, ...],
    *,
    keep: tuple[str, ...],
    drop: tuple[str, ...],
    no_prune: bool,
    output: Path | None,
    threads: int | None,
    memory: int | None,
    verbose: bool,
    engine: str | None,
    workers: int | None,
    scheduler: str | None,
    share: tuple[int, int] | None,
    command: str,
) -> None:
    """``zonda run`` of pipeline files as a campaign."""
    from ..storage.files import check_output_folder
    from ..storage.lock import lock
    from . import run as campaign
    from .engines import engine as opened

    sources = [source(p, settings, len(pipelines) > 1) for p in pipelines]
    if len({s.name for s in sources}) < len(sources):
        raise click.UsageError("two of the pipeline files have the same name: give one of them another with the key `name:`")
    folder = output or (sources[0].file.output if len(sources) == 1 else Path("out/campaign"))
    options = _engine(sources[0].campaign, engine, workers, scheduler)
    with opened(**options, threads=threads, memory=memory) as pool:
        if pool.executor is None:
            return
        check_output_folder(folder)
        pruning: dict[str, Any] = {"keep": keep, "drop": drop, "prune_all": not no_prune}
        if share is not None:
            with lock(folder, f"{share[0]}-of-{share[1]}"):
                campaign.share(sources, folder, command, pool, _say, *share, **pruning)
            _say(f"share {share[0]} of {share[1]} is done; when all are: zonda resume {folder}")
        else:
            with lock(folder), _told_how_to_go_on(folder):
                _show(campaign.begin(sources, folder, command, pool, _say, **pruning), verbose)
    click.echo(f"{folder}/")


@click.command()
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.option("--anyway", is_flag=True, help="Go on although zonda, the pipeline file or an input has changed.")
@click.option(
    "--same-machine/--any-machine",
    default=None,
    help="Refuse tasks of another kind of machine than the first.  [default: as in the file]",
)
@engine_option
@workers_option
@scheduler_option
@click.option("--threads", type=click.IntRange(min=1), metavar="N", help="Threads of each task.  [default: a worker's share]")
@click.option("--memory", metavar="SIZE", help="As of `zonda run`, e.g. 4GB.  [default: half of the free]")
@click.option("-v", "--verbose", is_flag=True, help="Say all that was counted, chosen and approximated.")
def resume(
    folder: Path,
    anyway: bool,
    same_machine: bool | None,
    engine: str | None,
    workers: int | None,
    scheduler: str | None,
    threads: int | None,
    memory: str | None,
    verbose: bool,
) -> None:
    """Go on with the campaign in DIR.

    The checksums of all partial products are verified, what is missing is run, failed tasks are tried again, and what is complete
    is combined. The maps are the same bits as those of an undisturbed campaign.
    """
    from ..command_types import Bytes
    from ..compilation.compiled import ensure_cache, one_blas_thread

    one_blas_thread()
    ensure_cache()
    from ..storage.files import check_output_folder
    from ..storage.lock import lock
    from . import run as campaign
    from .engines import engine as opened
    from .job import Job

    job = Job.read(folder)
    options = _engine(_campaign_of(job), engine, workers, scheduler)
    size = Bytes().convert(memory, None, None) if memory is not None else None
    with opened(**options, threads=threads, memory=size) as pool:
        if pool.executor is None:
            return
        check_output_folder(folder)
        with lock(folder), _told_how_to_go_on(folder):
            _show(campaign.resume(folder, pool, _say, anyway=anyway, same_machine=same_machine), verbose)
    click.echo(f"{folder}/")


@click.command()
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.option("--tasks", "listed", is_flag=True, help="List every task.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def status(folder: Path, listed: bool, as_json: bool) -> None:
    """Show how far the campaign in DIR is: its tasks by state, what failed and why."""
    from . import log
    from .job import LOG, Job

    job = Job.read(folder)
    paths = [p for p in (folder / LOG, *sorted(folder.glob("jobs.*-of-*.sqlite"))) if p.exists()]
    rows: dict[int, Row] = {}
    for path in paths:
        for row in log.read(path):
            if row.number not in rows or _rank(row) > _rank(rows[row.number]):
                rows[row.number] = row
    table = [(task, rows.get(task.number)) for task in job.tasks]
    if as_json:
        import json

        click.echo(json.dumps(_as_dict(job, table), indent=2))
        return
    for line in _lines(job, table, listed):
        click.echo(line)


def source(pipeline: str, settings: tuple[str, ...], several: bool) -> Source:
    """A pipeline file as part of a campaign, with the knobs that its ``accuracy`` asks for."""
    from ..configuration.pipeline_file import load
    from .prepare import Source

    file = load(pipeline, settings)
    if (target := file.header.accuracy) is not None:
        from ..accuracy.store import settings_for

        choice = settings_for(file, target.target, target.metric)
        _say(f"accuracy: {choice.reason}")
        settings = (*settings, *choice.overrides)
        file = load(pipeline, settings)
    return Source(file, lambda more: load(pipeline, (*settings, *more)), file.header.name if several else "")


def _engine(campaign: Campaign, engine: str | None, workers: int | None, scheduler: str | None) -> dict[str, Any]:
    name = engine or ("dask" if scheduler else campaign.engine)
    dask = name == "dask"
    return {
        "name": name,
        "workers": workers or campaign.workers,
        "scheduler": (scheduler or campaign.scheduler) if dask else None,
        "tls": campaign.tls if dask else None,
    }


def _campaign_of(job: Job) -> Campaign:
    """The campaign as the stored YAML has it, without looking at anything else in there."""
    from ..configuration import yaml_places
    from .settings import Campaign

    value = yaml_places.load(yaml_places.Source("resolved.yaml", job.source[0])).value
    return Campaign.model_validate((value.get("campaign") if isinstance(value, dict) else None) or {})


@contextlib.contextmanager
def _told_how_to_go_on(folder: Path) -> Iterator[None]:
    """Name the command that goes on, where a campaign that has begun is interrupted."""
    from .job import FILE

    try:
        yield
    except KeyboardInterrupt:
        if (folder / FILE).exists():
            with contextlib.suppress(OSError):
                _say(f"what is done is kept; to go on: zonda resume {folder}")
        raise


def _say(text: str) -> None:
    click.echo(text, err=True)


def _show(result: Result, verbose: bool) -> None:
    """What was lost, or with ``verbose`` all of the tally."""
    for combination, who, what, value, counted in result.tally:
        if verbose or (counted and value != "0" and "/" not in who and what != "samples binned"):
            _say(f"{combination}{': ' if combination else ''}{who}: {what}: {value}")


def _rank(row: Row) -> int:
    return ("waiting", "failed", "claimed", "done").index(row.state)


def _counts(table: Sequence[tuple[Task, Row | None]]) -> dict[str, int]:
    from .log import STATES

    counts = dict.fromkeys(STATES, 0)
    for _, row in table:
        counts[row.state if row else "waiting"] += 1
    return counts


def _lines(job: Job, table: Sequence[tuple[Task, Row | None]], listed: bool) -> list[str]:
    from .job import plural
    from .log import WAITING

    counts = _counts(table)
    done = [(task, row) for task, row in table if row and row.state == "done"]
    samples = sum(task.samples for task, _ in done)
    seconds = sum(row.seconds for _, row in done)
    lines = [f"{job.name}: {plural(len(job.tasks), 'task')}, {job.sets}"]
    lines += [f"  {state:<8} {number}" for state, number in counts.items() if number or state == "done"]
    share = samples / job.samples if job.samples else 1.0
    rate = f", {samples / seconds:.3g} samples/s of each worker" if seconds else ""
    lines.append(f"  samples  {samples:.3g} of {job.samples:.3g} ({100 * share:.0f} %){rate}")
    lines += _machines(done)
    if listed:
        lines += ["", "  task  state    attempts  seconds  worker                  entry"]
        for task, known in table:
            row = known or WAITING
            state, attempts, used, host = row.state, row.attempts, row.seconds, row.host
            scans = f"scan {task.scans[0]}" if len(task.scans) == 1 else f"{len(task.scans)} scans"
            about = ", ".join(filter(None, (task.about, scans)))
            lines.append(f"  {task.number:>4}  {state:<7}  {attempts:>8}  {used:>7.1f}  {host:<22}  {about}")
    troubled = [(task, row) for task, row in table if row and row.error and (row.state != "done" or listed)]
    for task, row in troubled[:20]:
        text = row.error.strip().splitlines()
        shown = text if listed or not row.error.startswith("Traceback") else text[-1:]
        lines += ["", f"task {task.number} ({', '.join(filter(None, (row.state, task.about)))}):", *(f"  {t}" for t in shown)]
    if len(troubled) > 20:
        lines += ["", f"and {len(troubled) - 20} more: zonda status --json"]
    return lines


def _machines(done: Sequence[tuple[Task, Row]]) -> list[str]:
    """On what the tasks ran."""
    from .job import plural
    from .machines import EFFECT, differences, kinds, short

    found = kinds(row.machine for _, row in done)
    if len(found) < 2:
        return [f"  machine  {short(machine)}" for machine, _ in found]
    lines = [f"  machine  {len(found)} kinds: {EFFECT}"]
    lines += [f"           {plural(count, 'task')}: {short(machine)}" for machine, count in found]
    lines += [f"           the {n}. has {differences(machine, found[0][0])}" for n, (machine, _) in enumerate(found[1:], 2)]
    return lines


def _as_dict(job: Job, table: Sequence[tuple[Task, Row | None]]) -> dict[str, Any]:
    from .machines import read

    made_on = list(dict.fromkeys(row.machine for _, row in table if row and row.machine))
    return {
        "name": job.name,
        "version": job.version,
        "counts": _counts(table),
        "samples": job.samples,
        "machines": [read(machine) for machine in made_on],
        "products": [{"name": c.name, "folder": c.folder} for c in job.combinations],
        "tasks": [
            {
                "number": task.number,
                "state": row.state if row else "waiting",
                "attempts": row.attempts if row else 0,
                "error": row.error if row else "",
                "host": row.host if row else "",
                "seconds": row.seconds if row else 0.0,
                "machine": made_on.index(row.machine) if row and row.machine else None,
                "samples": task.samples,
                "entry": task.about,
                "scans": list(task.scans),
                "combination": task.combination,
            }
            for task, row in table
        ],
    }
