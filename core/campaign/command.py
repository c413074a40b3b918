"""``zonda status``, ``zonda resume``, and ``zonda run`` of a campaign. Only click is imported with
this module.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import click

from ..command_options import on_engine

if TYPE_CHECKING:
    from ..command_options import RunRequest
    from ..experiment.engines import Pool
    from .campaign_file import Job, Task
    from .folder import TaskRow
    from .prepare import CampaignFile
    from .settings import Campaign
    from .tasks import CampaignResult

    Table = Sequence[tuple[Task, TaskRow]]


def run(request: RunRequest) -> None:
    """``zonda run`` of pipeline files as a campaign."""
    from ..storage.output_folder import lock
    from . import run as campaign
    from .prepare import Pruning

    sources = [source(p, request.settings, len(request.pipelines) > 1) for p in request.pipelines]
    if len({s.name for s in sources}) < len(sources):
        raise click.UsageError(
            "two of the pipeline files have the same name: give one of them another with the key"
            " `name:`"
        )
    folder = request.output or (
        sources[0].file.output if len(sources) == 1 else Path("out/campaign")
    )
    with _working(sources[0].campaign, folder, request) as pool:
        pruning = Pruning(request.keep, request.drop, request.prune)
        if request.share is not None:
            k, n = request.share
            with lock(folder, f"{k}-of-{n}"):
                campaign.share(sources, folder, request.command, pool, _say, pruning, (k, n))
            _say(f"share {k} of {n} is done; when all are: zonda resume {folder}")
        else:
            with lock(folder), _resumable(folder):
                found = campaign.begin(sources, folder, request.command, pool, _say, pruning)
                _show(found, request.verbose)


@click.command()
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.option(
    "--anyway",
    is_flag=True,
    help="Go on although zonda, the pipeline file or an input has changed.",
)
@click.option(
    "--same-machine/--any-machine",
    default=None,
    help="Refuse tasks of another kind of machine than the first.  [default: as in the file]",
)
@on_engine
def resume(folder: Path, anyway: bool, same_machine: bool | None, **how: Any) -> None:
    """Go on with the campaign in DIR.

    The checksums of all partial products are verified, what is missing is run, failed tasks are
    tried again, and what is complete is combined. The maps are the same bits as those of an
    undisturbed campaign.
    """
    from ..machine import one_blas_thread

    one_blas_thread()
    from ..storage.output_folder import lock
    from . import run as campaign
    from .campaign_file import Job

    given = SimpleNamespace(**how)
    job = Job.read(folder)
    with (
        _working(_campaign_of(job), folder, given) as pool,
        lock(folder),
        _resumable(folder),
    ):
        found = campaign.resume(folder, pool, _say, anyway=anyway, same_machine=same_machine)
        _show(found, given.verbose)


@click.command()
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.option("--tasks", "listed", is_flag=True, help="List every task.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def status(folder: Path, listed: bool, as_json: bool) -> None:
    """Show how far the campaign in DIR is: its tasks by state, what failed and why."""
    from .campaign_file import Job
    from .folder import Record

    job = Job.read(folder)
    table = list(zip(job.tasks, Record(job, folder).rows(), strict=True))
    if as_json:
        import json

        click.echo(json.dumps(_as_dict(job, table), indent=2))
    else:
        click.echo("\n".join(_lines(job, table, listed)))


def source(pipeline: str, settings: tuple[str, ...], several: bool) -> CampaignFile:
    """A pipeline file as part of a campaign, with the knobs that its ``accuracy`` asks for."""
    from ..experiment.variant import FileVariant
    from .prepare import CampaignFile

    variant = FileVariant(pipeline, settings)
    if (target := variant.file.header.accuracy) is not None:
        from ..accuracy.fronts import settings_for

        choice = settings_for(variant.file, target.target, target.metric)
        _say(f"accuracy: {choice.reason}")
        variant = variant.changed(choice.overrides)
    return CampaignFile(variant, variant.file.header.name if several else "")


@contextlib.contextmanager
def _working(campaign: Campaign, folder: Path, given: Any) -> Iterator[Pool]:
    """An engine as the options say (``given``, `on_engine`), else as the campaign does. A worker
    of MPI ends here when it has done its part.
    """
    from ..experiment.engines import engine
    from ..storage.files import check_output_folder

    name = given.engine or ("dask" if given.scheduler else campaign.engine)
    dask = name == "dask"
    with engine(
        name,
        workers=given.workers or campaign.workers,
        threads=given.threads,
        memory=given.memory,
        scheduler=(given.scheduler or campaign.scheduler) if dask else None,
        tls=campaign.tls if dask else None,
    ) as pool:
        if main := pool.executor is not None:
            check_output_folder(folder)
            yield pool
    if not main:
        raise click.exceptions.Exit
    click.echo(f"{folder}/")


def _campaign_of(job: Job) -> Campaign:
    """The campaign as the stored YAML has it, without looking at anything else in there."""
    from ..configuration import yaml_places
    from .settings import Campaign

    value = yaml_places.load(yaml_places.Source("resolved.yaml", job.source[0])).value
    return Campaign.model_validate(
        (value.get("campaign") if isinstance(value, dict) else None) or {}
    )


@contextlib.contextmanager
def _resumable(folder: Path) -> Iterator[None]:
    """Show the command that resumes a campaign when that is interrupted."""
    from .campaign_file import FILE

    try:
        yield
    except KeyboardInterrupt:
        if (folder / FILE).exists():
            with contextlib.suppress(OSError):
                _say(f"what is done is kept; to go on: zonda resume {folder}")
        raise


def _say(text: str) -> None:
    click.echo(text, err=True)


def _show(result: CampaignResult, verbose: bool) -> None:
    """Print losses, or with ``verbose`` the whole log."""
    for combination, who, what, value, counted in result.log:
        if verbose or (counted and value != "0" and "/" not in who and what != "samples binned"):
            _say(f"{combination}{': ' if combination else ''}{who}: {what}: {value}")


def _counts(table: Table) -> dict[str, int]:
    from .folder import STATES

    found = [row.state for _, row in table]
    return {state: found.count(state) for state in STATES}


def _lines(job: Job, table: Table, listed: bool) -> list[str]:
    from ..tables import aligned
    from .campaign_file import plural

    done = [(task, row) for task, row in table if row.state == "done"]
    samples = sum(task.samples for task, _ in done)
    seconds = sum(row.seconds for _, row in done)
    share = samples / job.samples if job.samples else 1.0
    rate = f", {samples / seconds:.3g} samples/s of each worker" if seconds else ""
    about: list[tuple[str, Any]] = [
        (state, n) for state, n in _counts(table).items() if n or state == "done"
    ]
    about += [
        ("samples", f"{samples:.3g} of {job.samples:.3g} ({100 * share:.0f} %){rate}"),
        *_machines(done),
    ]
    lines = [f"{job.name}: {plural(len(job.tasks), 'task')}, {job.sets}"]
    lines += aligned(about, indent="  ")
    places = {
        task.number: (
            job.entry_of(task).about,
            f"scan {task.scans[0]}" if len(task.scans) == 1 else f"{len(task.scans)} scans",
        )
        for task in job.tasks
    }
    if listed:
        rows = [
            (r.number, r.state, r.attempts, f"{r.seconds:.1f}", r.host, _text(places[r.number]))
            for _, r in table
        ]
        head = ("task", "state", "attempts", "seconds", "worker", "entry")
        lines += ["", *aligned(rows, head, "><>><", indent="  ")]
    troubled = [row for _, row in table if row.error and (row.state != "done" or listed)]
    for row in troubled[:20]:
        text = row.error.strip().splitlines()
        shown = text if listed or not row.error.startswith("Traceback") else text[-1:]
        what = _text((row.state, places[row.number][0]))
        lines += ["", f"task {row.number} ({what}):", *(f"  {t}" for t in shown)]
    if len(troubled) > 20:
        lines += ["", f"and {len(troubled) - 20} more: zonda status --json"]
    return lines


def _text(words: Sequence[str]) -> str:
    return ", ".join(filter(None, words))


def _machines(done: Table) -> list[tuple[str, str]]:
    """The machines that the tasks ran on."""
    from .campaign_file import plural
    from .machines import EFFECT, differences, kinds, short

    found = kinds(row.machine for _, row in done)
    if len(found) < 2:
        return [("machine", short(machine)) for machine, _ in found]
    texts = [f"{len(found)} kinds: {EFFECT}"]
    texts += [f"{plural(count, 'task')}: {short(machine)}" for machine, count in found]
    texts += [
        f"the {n}. has {differences(machine, found[0][0])}"
        for n, (machine, _) in enumerate(found[1:], 2)
    ]
    return [("" if n else "machine", text) for n, text in enumerate(texts)]


def _as_dict(job: Job, table: Table) -> dict[str, Any]:
    from .machines import read

    made_on = list(dict.fromkeys(row.machine for _, row in table if row.machine))
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
                **{
                    key: getattr(row, key)
                    for key in ("state", "attempts", "error", "host", "seconds")
                },
                "machine": made_on.index(row.machine) if row.machine else None,
                "samples": task.samples,
                "entry": job.entry_of(task).about,
                "scans": list(task.scans),
                "combination": task.combination,
            }
            for task, row in table
        ],
    }
