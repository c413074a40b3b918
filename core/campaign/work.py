"""A campaign's tasks, and the combination of their products, on workers."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from .. import hooks
from ..errors import PipelineError, ZondaError
from ..storage.files import discard
from .calls import Lost, Work, carry_out
from .engines import Pool, engine_failed
from .folder import clean
from .job import Task
from .machines import Watch
from .record import Record
from .reduce import Combined, combine
from .task import Order, Outcome, perform

LOST = "(lost)"
"""Host of an attempt whose worker was killed."""


@dataclass
class CampaignResult:
    """The result of a campaign.

    Attributes
    ----------
    tally
        Of all combinations: rows (combination, who, what, value, whether it is a count).
    tasks
        Number of tasks that were run now.
    seconds
        Wall time of the tasks; ``samples`` in them.
    failed
        Errors of tasks that are given up, by number.
    """

    folder: Path
    tally: list[tuple[str, str, str, str, bool]] = field(default_factory=list)
    tasks: int = 0
    samples: int = 0
    seconds: float = 0.0
    failed: dict[int, str] = field(default_factory=dict)


class Tasks(Work[Task, Outcome]):
    """The tasks of a campaign. ``watch`` compares the machines that they run on."""

    def __init__(self, record: Record, pool: Pool, watch: Watch) -> None:
        super().__init__()
        self.job, self.folder = record.job, record.folder
        self.record, self.pool, self.watch = record, pool, watch
        self.result = CampaignResult(record.folder)
        self._failures = 0

    def run(self, tasks: Sequence[Task]) -> CampaignResult:
        """Run these tasks; on an interrupt, those at work wait again."""
        self._all, self._begin = (
            {"total": len(tasks), "all_samples": sum(task.samples for task in tasks)},
            time.monotonic(),
        )
        try:
            carry_out(self, tasks, self.pool, self.folder)
        except BaseException:
            with contextlib.suppress(Exception):
                self.record.put_off()
            if self.pool.stop is not None:
                clean(self.folder)
            raise
        finally:
            hooks.manager().hook.zonda_campaign_end()
        self.result.seconds = time.monotonic() - self._begin
        return self.result

    def call(self, item: Task) -> tuple[Callable[[Order], Outcome], Order]:
        """See `Work.call`."""
        from zonda import __version__

        layout, pipeline = (
            self.job.combinations[item.combination].layout,
            self.job.pipelines[item.pipeline],
        )
        folder, pool = self.folder.resolve(), self.pool
        return perform, Order(
            item, pipeline, layout, folder, pool.threads, pool.memory, __version__
        )

    def began(self, items: list[Task]) -> None:
        """See `Work.began`."""
        self.record.claim(task.number for task in items)

    def ended(self, item: Task, result: Outcome | Lost) -> bool:
        """Record the outcome of a task."""
        number = item.number
        outcome = Outcome(LOST, 0.0, error=str(result)) if isinstance(result, Lost) else result
        if not outcome.error and (
            error := self.watch.meet(outcome.machine, f"task {number} on {outcome.host}")
        ):
            discard(item.path(self.folder))
            outcome = replace(outcome, error=error, final=True, stop=True)
        again = (
            bool(outcome.error) and not outcome.final and self.attempts[item] <= self.job.retries
        )
        if not outcome.error:
            self.record.done(item, outcome.host, outcome.seconds, outcome.machine)
            self.result.tasks += 1
            self.result.samples += item.samples
        else:
            self._failures += 1
            self.record.failed(item, outcome.host, outcome.seconds, outcome.error, again)
            if not again:
                self.result.failed[number] = outcome.error
                self.stop = self.stop or outcome.stop
        hooks.manager().hook.zonda_campaign_progress(
            done=self.result.tasks, failed=self._failures, samples=self.result.samples,
            seconds=time.monotonic() - self._begin, **self._all,
        )  # fmt: skip
        return again


class Combinations(Work[int, Combined]):
    """The sets of products, by number. They are combined on workers: pictures and reports take time
    and memory.
    """

    def __init__(self, record: Record, result: CampaignResult) -> None:
        super().__init__()
        self.job, self.folder, self.record, self.result = (
            record.job,
            record.folder,
            record,
            result,
        )
        self._error: ZondaError | None = None

    def run(self, numbers: Sequence[int], pool: Pool) -> None:
        """Combine these. Raises the first error, when what was at work has ended."""
        carry_out(self, numbers, pool, self.folder)
        if self._error is not None:
            raise self._error

    def call(self, item: int) -> tuple[Callable[..., Combined], Path, int]:
        """See `Work.call`."""
        return combine, self.folder.resolve(), item

    def ended(self, item: int, result: Combined | Lost) -> bool:
        """Record that products are written, and remove their parts."""
        if isinstance(result, Lost):
            if not engine_failed(result.error):
                raise result.error
            if self.attempts[item] <= self.job.retries:
                return True
            message = f"the engine failed when it combined the maps: {result}"
            error: ZondaError | None = PipelineError(
                message, place=str(self.folder), cure=f"zonda resume {self.folder}"
            )
        else:
            error = result.error
        if error is not None:
            self._error, self.stop = self._error or error, True
            return False
        assert isinstance(result, Combined)
        self.record.combine(item)
        name = self.job.combinations[item].name
        self.result.tally += [(name, *row) for row in result.tally]
        if not self.job.keep_tasks:
            self.record.discard_parts(item)
        return False
