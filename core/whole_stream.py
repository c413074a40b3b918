"""Result of a step that changes a whole stream at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .block import Block
from .numerics.smooth import SmoothField
from .observation import Observation
from .stream import Stream
from .types import AnyFloats, Floats


@dataclass(frozen=True)
class Changed:
    """A stream that was changed as a whole: values (n_det, n_samp), and the mean that stands beside
    them, if it still does.
    """

    values: AnyFloats
    mean: SmoothField | None

    @classmethod
    def of(cls, values: Floats, stream: Stream, fixed: SmoothField | None = None) -> Changed:
        """Take the whole (n_det, n_samp), which is used up. The mean of ``stream`` stays beside it
        where it is nearer than zero; ``fixed``: one that others have, and that stays."""
        mean, observation = stream.means.get(stream.name), stream.observation
        if mean is not None and not _is_left(values, mean, observation):
            mean = None
        for field in (mean, fixed):
            if field is not None:
                for row, each in enumerate(values):
                    each -= field.evaluate(slice(row, row + 1), slice(0, len(each)))[0]
        return cls(values.astype(stream.dtype), mean)

    def put(self, block: Block, name: str) -> None:
        """Replace the stream ``name`` of a block."""
        block.detdata[name][...] = self.values[block.detectors, block.samples]
        block.means.pop(name, None)
        if self.mean is not None:
            block.means[name] = self.mean


def whole(stream: Stream, fixed: SmoothField | None = None) -> Floats:
    """A copy (n_det, n_samp) float64 of a stream with its mean."""
    values = np.empty(stream.shape)
    for row, each in enumerate(values):
        each[:] = stream.array[row]
        for field in (stream.means.get(stream.name), fixed):
            if field is not None:
                each += field.evaluate(slice(row, row + 1), slice(0, len(each)))[0]
    return values


def _is_left(values: AnyFloats, mean: SmoothField, observation: Observation) -> bool:
    """True if the mean is still in the signal: its samples are nearer to the mean than to zero."""
    with_it, without, good = 0.0, 0.0, observation.good_samples
    for row in np.flatnonzero(observation.good_detectors):
        part = values[row, good]
        rest = part - mean.evaluate(slice(row, row + 1), slice(0, len(good)))[0, good]
        with_it, without = (
            with_it + float(np.nansum(rest * rest)),
            without + float(np.nansum(part * part)),
        )
    return with_it < without
