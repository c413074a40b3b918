"""Arguments of ``zonda run``."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class RunRequest:
    """The arguments and options of ``zonda run``."""

    pipelines: tuple[str, ...]
    settings: tuple[str, ...]
    keep: tuple[str, ...]
    drop: tuple[str, ...]
    only: tuple[str, ...]
    prune: bool | None
    output: Path | None
    threads: int | None
    memory: int | None
    verbose: bool
    verify: bool
    engine: str | None
    workers: int | None
    scheduler: str | None
    share: tuple[int, int] | None

    @property
    def is_campaign(self) -> bool:
        """True if the arguments make a campaign, whatever the file says."""
        return bool(
            len(self.pipelines) > 1 or self.engine or self.workers or self.scheduler or self.share
        )

    @property
    def command(self) -> str:
        """The command that makes the same products elsewhere: what changes no result (threads,
        memory, folder) is left out.
        """
        options = [
            ("--set", self.settings),
            ("--keep", self.keep),
            ("--drop", self.drop),
            ("--only", self.only),
        ]
        parts = [part for option, texts in options for text in texts for part in (option, text)]
        pruning = {None: [], True: ["--prune"], False: ["--no-prune"]}[self.prune]
        return shlex.join(["zonda", "run", *self.pipelines, *parts, *pruning])
