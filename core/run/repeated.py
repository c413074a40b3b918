"""Streams that a step makes alike in all runs: made in the main run, copied in the runs after it.

With `Operator.same_in_all_runs` a step's streams, and what it tells, depend on no other step. As many scans of them as fit into
a quarter of the memory for streams and blocks are kept until the last run that has the step; of the others they are made anew.
A copy has the same bits and takes 1 ns a sample, less than a tenth of what it takes to sample a map.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from ..data import Block, Observation, Tally
from ..errors import PipelineError
from ..numerics.chunks import empty
from ..operator import Operator
from ..types import AnyFloats
from .forecast import spares
from .layout import read
from .settings import Settings

SHARE = 4
"""Of the memory for streams and blocks, one part in so many may hold what is kept for later runs."""


def alike(steps: Sequence[Operator]) -> dict[str, frozenset[str]]:
    """Streams of each step of the main run, by label, that later runs may copy: nothing has made them before this step."""
    found, made, wanted = dict[str, frozenset[str]](), set[str](), read(steps)
    for operator in steps:
        declared = operator.declares("same_in_all_runs", "configure", "prepare", "exec", "collect")
        alone = operator.couples == "sample" and type(operator).halo is Operator.halo and not operator.provides & made
        if declared and operator.only_tells and alone and operator.provides & wanted:
            found[operator.label] = frozenset(operator.provides & wanted)
        made |= operator.provides
    return found


def affordable(
    steps: Sequence[Operator], names: Mapping[str, Collection[str]], observations: Sequence[Observation], settings: Settings
) -> list[int]:
    """Bytes that are kept of each scan, the first ones first; 0: nothing of it.

    Nothing at all where other streams would lack the room.
    """
    each = sum(len(streams) for streams in names.values()) * np.dtype(settings.dtype).itemsize
    sizes, left = list[int](), settings.memory // SHARE
    for observation in observations:
        size = each * observation.n_detectors * observation.n_samples
        sizes.append(size if size <= left else 0)
        left = left - size if size <= left else 0
    if not any(sizes):
        return [0] * len(sizes)
    longest = max(observations, key=lambda o: o.n_detectors * o.n_samples)
    return sizes if spares(steps, longest, settings, sum(sizes)) else [0] * len(sizes)


class Repeated:
    """One scan's streams that the main run makes for later runs.

    Parameters
    ----------
    names
        By label of the step: its streams (`alike`).
    """

    def __init__(self, names: Mapping[str, Collection[str]]) -> None:
        self.names = names
        self.told: dict[str, Tally] = {}
        """What the steps told in `Operator.collect` of the main run."""
        self.complete = False
        """The main run is through: `repeat` may be called, `record` not any more."""
        self._arrays: dict[tuple[str, str], AnyFloats] = {}

    def begin(self, shape: tuple[int, int], settings: Settings) -> None:
        """Take memory; ``settings`` knows of it."""
        self._arrays = {(who, name): empty(shape, settings.dtype) for who, names in self.names.items() for name in names}
        settings.kept += self._arrays.values()

    def record(self, label: str, block: Block) -> None:
        """Keep what the main run made of a block for the first time."""
        for name in self.names[label] if not block.again else ():
            if name not in block.detdata:
                cure = "let exec make it, or leave same_in_all_runs out"
                raise PipelineError(f"made no stream {name!r}, which it provides", place=label, cure=cure)
            self._arrays[label, name][block.detectors, block.samples] = block.detdata[name]

    def repeat(self, label: str, block: Block) -> None:
        """Put it into a later run's block."""
        for name in self.names[label]:
            block.new(name, zero=False)[...] = self._arrays[label, name][block.detectors, block.samples]

    def forget(self, settings: Settings) -> None:
        """Give the memory back."""
        mine = {id(a) for a in self._arrays.values()}
        settings.kept[:] = [a for a in settings.kept if id(a) not in mine]
        self._arrays.clear()
