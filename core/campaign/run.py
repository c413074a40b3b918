"""Begin, work through, resume and finish a campaign."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from .. import hooks
from ..errors import InputError, OutputError, PipelineError, ZondaError
from ..experiment.engines import Pool, share_out
from ..storage import written
from ..storage.files import check_output_folder
from . import table, trees
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
    old = written.earlier(folder, [path for source in sources for path in _read_by(source)])
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
    written.clear(folder, old)
    made.write(folder)
    with written.recording(folder, anew=False):
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
        old = written.earlier(folder)
        if old and not (folder / FILE).exists():  # nor did another job begin in between
            raise OutputError(
                f"holds {plural(len(old), 'file')} of an earlier run",
                place=str(folder),
                cure="remove them, or choose another output folder",
            )
        made = prepare(sources, folder, command, pruning, _progress())
        check_links(folder, made)
        publish(made, folder)
        with written.recording(folder, anew=False):
            write_sources(made, folder)
    job = Job.read(folder)
    if (
        job.source != tuple(s.file.resolved_yaml(folder) for s in sources)
        or job.version != __version__
    ):
        raise OutputError(
            "holds another campaign", place=str(folder), cure="choose another output folder"
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
    job, folder = record.job, record.folder
    result = Tasks(record, pool, watch).run(tasks)
    if result.tasks:
        _tell(result, watch.say)
    incomplete = {task.combination for task in job.tasks if task.number not in record.done}
    ready = [n for n in range(len(job.combinations)) if n not in incomplete | set(record.combined)]
    with written.recording(folder, anew=False):
        Combinations(record, result, pool).carry_out(ready)
    clean(folder, job)  # of workers that were killed while they wrote
    _fail(result, len(job.tasks))
    if missing := len(job.tasks) - len(record.done):
        raise PipelineError(
            f"{missing} tasks were not run", place=str(folder), cure=f"zonda resume {folder}"
        )
    if job.figures:
        with written.recording(folder, anew=False):
            table.write(record)
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
