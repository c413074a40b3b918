"""A campaign's output folder: the files in it besides products, and whether it may be used
again.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

from ..errors import InputError, OutputError, ZondaError
from ..storage.files import discard, temporary_sibling, write_text
from . import log as joblog
from . import machines, parts
from .job import FILE, LOG, TASKS, Job, OtherFormat, Say, Task, plural
from .log import Log

RESOLVED = "resolved.yaml"

PART = re.compile(r"\.\d+-[0-9a-f]{8}\.part")
"""In the names of `temporary_sibling`."""


def check_free(folder: Path) -> None:
    """Raise `OutputError` where the folder holds an unfinished campaign."""
    if (folder / FILE).exists() and not finished(folder):
        raise OutputError(
            "holds an unfinished campaign",
            place=str(folder),
            cure=f"zonda resume {folder}, remove it, or choose another folder",
        )


def make_way(folder: Path) -> None:
    """Remove what an earlier campaign left besides its products. The caller holds the folder's
    lock.
    """
    for old in (folder / FILE, folder / LOG, *folder.glob("jobs.*.sqlite")):
        with contextlib.suppress(FileNotFoundError):
            old.unlink()
    shutil.rmtree(folder / TASKS, ignore_errors=True)


def finished(folder: Path) -> bool:
    """Whether all products of the campaign in a folder are written. Raises `OtherFormat`."""
    try:
        job = Job.read(folder)
        if not (folder / LOG).exists():
            return False
        with contextlib.closing(Log(folder / LOG)) as log:
            return len(log.combined(job.layouts)) == len(job.combinations)
    except OtherFormat:
        raise
    except ZondaError:
        return False


def publish(job: Job, folder: Path) -> None:
    """Write the campaign's file unless another job of an array was first."""
    draft = temporary_sibling(folder / FILE).with_suffix("")
    draft.mkdir()
    try:
        job.write(draft)
        try:
            os.link(draft / FILE, folder / FILE)
        except FileExistsError:
            pass
        except OSError:  # no hard links here
            if not (folder / FILE).exists():
                os.replace(draft / FILE, folder / FILE)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def verify(
    tasks: Sequence[Task], folder: Path, log: Log, say: Say, same_machine: bool = False
) -> list[Task]:
    """Tasks whose products are missing or damaged, which is recorded in the log.

    ``same_machine``: products of another kind of machine than the first task's are removed.
    """
    rows = {row.number: row for row in log.rows()}
    others = {row.number: row for path in shares(folder) for row in readable(path)}
    missing, lost, strange = [], set(), 0
    first = next(
        filter(None, (machines.kind((others.get(n) or rows[n]).machine) for n in sorted(rows))),
        None,
    )
    with log.together():
        for task in tasks:
            row, other = rows[task.number], others.get(task.number)
            digest = parts.digest_of(task.path(folder), task.key)
            if digest is None or (row.state == "done" and digest != row.digest):
                missing.append(task)
                if row.state == "done":
                    lost.add(task.number)
            elif same_machine and machines.kind((other or row).machine) not in (first, frozenset()):
                discard(task.path(folder))
                missing.append(task)
                strange += 1
            elif row.state != "done":
                known = other or row
                log.done(task.number, known.host, known.seconds, digest, known.machine)
        log.put_off(task.number for task in missing if task.number not in lost)
        log.put_off(
            lost, "its partial product was missing or damaged when the campaign was resumed"
        )
    if strange:
        say(f"{plural(strange, 'task')} ran on another kind of machine than the first: run again")
    if lost:
        say(f"{len(lost)} partial products were missing or damaged: their tasks are run again")
    return missing


def shares(folder: Path) -> list[Path]:
    """Logs of the jobs of an array."""
    return sorted(folder.glob("jobs.*-of-*.sqlite"))


def readable(path: Path) -> list[joblog.TaskRow]:
    """Rows of a log that may be damaged: none, then."""
    try:
        return joblog.read(path)
    except InputError:
        return []


def open_log(path: Path, tasks: Sequence[Task]) -> Log:
    """A job log that knows these tasks."""
    log = Log(path)
    log.begin(task.number for task in tasks)
    return log


def opened(path: Path, tasks: Sequence[Task], layouts: Mapping[int, str], say: Say) -> Log:
    """As `open_log`; a log that is damaged or of another campaign is put aside and made anew.
    ``layouts``: see `Log.combined`.
    """
    try:
        log = open_log(path, tasks)
        if {row.number for row in log.rows()} != {task.number for task in tasks}:
            raise InputError("it belongs to another campaign", place=str(path))
        log.check()
        log.combined(layouts)
        return log
    except InputError:
        aside = next(
            p
            for k in range(1, 1000)
            if not (p := path.with_name(f"jobs.damaged-{k}.sqlite")).exists()
        )
        os.replace(path, aside)
        for journal in path.parent.glob(f"{path.name}-*"):
            discard(journal)
        say(
            f"the job log was damaged: it is kept as {aside.name} and made anew from the partial"
            " products"
        )
        return open_log(path, tasks)


def clean(folder: Path) -> None:
    """Remove temporary files that killed workers left anywhere in the folder. No worker may be
    active there.
    """
    for path in [p for p in folder.rglob(".*.part*") if PART.search(p.name)]:
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            discard(path)


def sources_of(job: Job, folder: Path) -> list[Path]:
    """Where the campaign's own YAML is kept."""
    if len(job.source) == 1:
        return [folder / RESOLVED]
    return [folder / f"resolved-{k}.yaml" for k in range(1, len(job.source) + 1)]


def write_sources(job: Job, folder: Path) -> None:
    """Write the campaign's own YAML."""
    for path, text in zip(sources_of(job, folder), job.source, strict=True):
        write_text(path, text)
