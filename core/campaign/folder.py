"""A campaign's output folder: the files in it besides products, and whether it may be used
again.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Sequence
from pathlib import Path

from ..errors import InputError, OutputError, ZondaError
from ..storage.files import discard, temporary_sibling, write_text
from . import machines, parts
from .job import FILE, TASKS, Job, OtherFormat, Say, Task, plural
from .record import FINISHED, Record, done_row

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
    for old in (folder / FILE, folder / FINISHED):
        old.unlink(missing_ok=True)
    shutil.rmtree(folder / TASKS, ignore_errors=True)


def finished(folder: Path) -> bool:
    """Whether all products of the campaign in a folder are written. Raises `OtherFormat`."""
    try:
        job = Job.read(folder)
        return len(Record(job, folder).combined) == len(job.combinations)
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


def verify(record: Record, tasks: Sequence[Task], say: Say, same_machine: bool) -> list[Task]:
    """Read the products of tasks, and return the tasks whose products are missing or damaged.

    ``same_machine``: products of another kind of machine than the first task's are removed.
    """
    found, missing, damaged, strange = [], [], 0, 0
    for task in tasks:
        path = task.path(record.folder)
        try:
            parts.read(path, task.key)
            row = done_row(task, record.folder)
        except InputError:
            row = None
        if row is None:
            missing.append(task)
            damaged += path.exists()
        else:
            found.append((task, row))
    known = sorted((row for row in record.rows() if row.machine), key=lambda row: row.number)
    first = next(filter(None, (machines.kind(row.machine) for row in known)), None)
    for task, row in found:
        if same_machine and machines.kind(row.machine) not in (first, frozenset()):
            discard(task.path(record.folder))
            missing.append(task)
            strange += 1
        else:
            record.known(row)
    record.reset(missing)
    if strange:
        say(f"{plural(strange, 'task')} ran on another kind of machine than the first: run again")
    if damaged:
        say(f"{plural(damaged, 'partial product')} damaged: run again")
    return sorted(missing, key=lambda task: task.number)


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
