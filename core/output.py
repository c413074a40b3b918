"""Outputs: what shows or compares products once all of them are there (reports, plots, transfer functions)."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

from .operator import Operator

if TYPE_CHECKING:
    from .data import Data

Progress = Literal["pointing", "scan", "run", "runs"]


class Output(Operator):
    """A step that acts in `finalize` alone, once, after all signals of all scans are mapped.

    Its `observe` is called before that of all other steps: what it refuses (an output folder) is refused at once.
    """

    at_end: ClassVar[bool] = True

    def watch(self, data: Data, done: Progress) -> None:
        """Called once the telescope is pointed, after every scan, and when all scans are through: time to begin, in the
        background, with what `finalize` will do, as far as it depends on products that will not change."""
