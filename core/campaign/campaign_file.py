"""The plan of a campaign: made once, before the first task starts; every engine and every
resumption follows it.

``campaign.json`` in the output folder holds it. A task is named by a hash of all that its product
depends on.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter

from ..configuration.time import Instant
from ..errors import InputError
from ..storage.files import write_text

if TYPE_CHECKING:
    from ..configuration.loaded import PipelineFile
    from ..scene import Scene

FORMAT = 4
"""Of a campaign's folder: this file, the partial products and the records beside them."""

FILE = "campaign.json"
TASKS = "tasks"
"""Folder of partial products, layouts and the state of tasks."""

RECORD = "tasks.npz"
"""Record of the tasks of a set of products that is written."""

ENTRIES = "entries"
"""Folder of the time streams of each entry."""

INPUTS = "inputs"
"""Folder of arrays that were given in Python."""

Say = Callable[[str], None]
"""Shows the user a line."""


def plural(number: int, noun: str) -> str:
    """``1 task``, ``2 tasks``."""
    return f"{number} {noun}{'s' if number != 1 else ''}"


class OtherFormat(InputError):
    """A campaign's folder was written by another version of zonda."""


@dataclass(frozen=True)
class PlannedEntry:
    """One entry of a campaign.

    Attributes
    ----------
    pipeline
        Number of its pipeline in `Job.pipelines`.
    seed, time
        Of its scene; the time in ns since 1970 (`Instant`).
    about
        Its place on the campaign's axes, for tables and messages.
    """

    pipeline: int
    seed: int
    time: int
    about: str

    def scene(self, file: PipelineFile) -> Scene:
        """The scene of its pipeline file, with its seed and start."""
        return file.scene().model_copy(update={"seed": self.seed, "time": Instant(self.time)})


@dataclass(frozen=True)
class Task:
    """One scan of an entry, or all of them.

    Attributes
    ----------
    number
        Its place in the campaign, and in the order of the reduction.
    key
        Hash of what its product depends on.
    combination
        Number of what it is co-added into.
    entry
        Number of its entry in `Job.entries`.
    scans
        Positions of its scans among those of its entry.
    before
        Number of scans of the combination before it.
    samples
        Detectors x samples.
    """

    number: int
    key: str
    combination: int
    entry: int
    scans: tuple[int, ...]
    before: int
    samples: int

    @property
    def product(self) -> str:
        """Name of its partial product's file."""
        return f"{self.number:06d}.npz"

    def path(self, folder: Path) -> Path:
        """Path of its partial product, in the campaign's folder."""
        return folder / TASKS / self.product


@dataclass(frozen=True)
class Combination:
    """Tasks whose products are added up into one set of maps, written in ``folder`` ('': the
    output folder); they share a layout.
    """

    name: str
    folder: str
    layout: str
    """Digest of the layout's file."""
    axes: tuple[tuple[str, Any], ...] = ()
    """Values on the axes over which nothing is co-added."""


@dataclass(frozen=True)
class Job:
    """A whole campaign.

    Attributes
    ----------
    pipelines
        Planned pipelines, every default filled in, as YAML.
    plans
        What was left out or coarsened, for headers: by pipeline.
    source
        The campaign's own YAML, every default filled in: one text for each pipeline file.
    same_machine
        Whether what ran on another kind of machine than the first task is refused.
    files
        The pipeline files: path and digest of the text; input files: path, size and time of change;
        of arrays in Python: path and hash.
    """

    name: str
    version: str
    command: str
    retries: int
    keep_tasks: bool
    pipelines: tuple[str, ...]
    plans: tuple[tuple[tuple[str, ...], ...], ...]
    source: tuple[str, ...]
    files: Mapping[str, str]
    combinations: tuple[Combination, ...]
    entries: tuple[PlannedEntry, ...]
    tasks: tuple[Task, ...] = field(repr=False)
    same_machine: bool = False
    figures: bool = False
    """Whether the figures of all combinations are written as one table."""
    need: int = 0
    """Least bytes with which a process runs any task; 0: not known."""

    @property
    def samples(self) -> int:
        """Number of samples of all tasks."""
        return sum(task.samples for task in self.tasks)

    @property
    def sets(self) -> str:
        """``2 sets of products``."""
        return f"{plural(len(self.combinations), 'set')} of products"

    @cached_property
    def tasks_of(self) -> list[list[Task]]:
        """The tasks of each combination, in the order of the reduction."""
        found: list[list[Task]] = [[] for _ in self.combinations]
        for task in self.tasks:
            found[task.combination].append(task)
        return found

    def entry_of(self, task: Task) -> PlannedEntry:
        """The entry of a task."""
        return self.entries[task.entry]

    def identity(self, combination: int) -> str:
        """Identity of the record of a combination: of all its tasks."""
        return digest_of_text("".join(task.key for task in self.tasks_of[combination]))

    def record(self, folder: Path, combination: int) -> Path:
        """Path of the record of a combination whose products are written, beside these."""
        return folder / self.combinations[combination].folder / RECORD

    def write(self, folder: Path) -> None:
        """Write it to its folder, atomically. Raises `OutputError`."""
        text = json.dumps({"format": FORMAT, **asdict(self)}, indent=None, separators=(",", ":"))
        write_text(folder / FILE, json.dumps({"digest": digest_of_text(text)}) + "\n" + text + "\n")

    @classmethod
    def read(cls, folder: Path) -> Job:
        """The campaign in a folder. Raises `InputError` where there is none, or its file is damaged
        or of another format.
        """
        path = folder / FILE
        try:
            head, _, text = path.read_text(encoding="utf-8").partition("\n")
            if json.loads(head)["digest"] != digest_of_text(text.rstrip("\n")):
                raise ValueError("its checksum is wrong")
            values = json.loads(text)
            if values.pop("format") != FORMAT:
                what = (
                    f"holds a campaign of zonda {values['version']}, whose partial products cannot"
                    " be used any more"
                )
                cure = "remove it, choose another output folder, or finish it with that version"
                raise OtherFormat(what, place=str(folder), cure=cure)
            job: Job = TypeAdapter(cls).validate_python(values)
            if not all(_inside(c.folder) for c in job.combinations) or not all(
                re.fullmatch("[0-9a-f]{32}", t.key) for t in job.tasks
            ):
                raise ValueError("it names files outside its folder")
            return job
        except FileNotFoundError:
            raise InputError(
                "holds no campaign",
                place=str(folder),
                cure="zonda run FILE --output DIR begins one",
            ) from None
        except (OSError, ValueError, KeyError, TypeError) as err:
            cure = (
                f"remove {folder} and run the campaign again: its tasks are known from this file"
                " only"
            )
            raise InputError(f"cannot be used: {err}", place=str(path), cure=cure) from None


def layout_path(folder: Path, combination: int) -> Path:
    """File of the layouts of a combination."""
    return folder / TASKS / f"layout-{combination:04d}.npz"


def _inside(folder: str) -> bool:
    """True if a relative path, read as text, stays inside its folder."""
    return not Path(folder).is_absolute() and ".." not in Path(folder).parts and "\0" not in folder


def digest_of_text(text: str) -> str:
    """BLAKE2b of a text."""
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()
