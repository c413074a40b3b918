"""Whole streams for steps that do not know of means (`Operator.knows_means`).

Beside a stream x may stand a mean M, tens of kelvin (`Block.means`,
``observation.smooth["atmosphere"]``). A step f that does not say that it knows of means is given
all of the stream, in float64; the same mean is subtracted from what it makes of it, which is then
rounded once to the precision of the run:

    y = round(f(x + M) - M)                                                                      (1)

In float32, x + M itself would lose microkelvins. M has the same bits in every block, so that y does
not depend on the blocks. What the step only reads is not written back.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from ..data import Block, Observation, Stream
from ..mapmaker import MapMaker
from ..numerics.smooth import SmoothField
from ..operator import Operator
from ..signal import MAIN
from ..types import AnyFloats, Floats

EMISSION = "atmosphere"
"""The stream whose mean is in ``observation.smooth``, where calibration and noise models find it,
too.
"""


def knows_means(operator: Operator) -> bool:
    """Tell whether a step handles means itself. A class that overrides `exec` or `measure` of one
    that does must say so anew.
    """
    order = type(operator).__mro__
    says = next(n for n, c in enumerate(order) if "knows_means" in vars(c))
    does = next(
        (n for n, c in enumerate(order) if {"exec", "measure"} & vars(c).keys()),
        len(order),
    )
    return bool(operator.knows_means) and says <= does


def names_of(operator: Operator, signals: Sequence[str]) -> frozenset[str]:
    """Names that the step declares; for a map maker those of all ``signals``."""
    names = operator.requires | operator.optional | operator.provides
    return names.union(signals) if isinstance(operator, MapMaker) and MAIN in names else names


def may_have_means(operators: Sequence[Operator]) -> frozenset[str]:
    """Streams beside which a mean may stand, known before anything runs: steps that know of means
    put it there.
    """
    return frozenset({EMISSION}).union(*(o.provides for o in operators if knows_means(o)))


def means_of(
    observation: Observation,
    means: Mapping[str, SmoothField],
    names: frozenset[str],
) -> dict[str, SmoothField]:
    """The means of those of the streams ``names`` that have one; ``means``: `Block.means` or
    `Stream.means`.
    """
    found = {name: field for name, field in means.items() if name in names}
    if EMISSION in names and EMISSION in observation.smooth:
        found.setdefault(EMISSION, observation.smooth[EMISSION])
    return found


def whole_block(
    block: Block,
    operator: Operator,
    fields: Mapping[str, SmoothField],
    buffers: dict[str, AnyFloats],
) -> Block:
    """The block with x + M of equation (1), which the step may change.

    Parameters
    ----------
    fields
        M, by stream (`means_of`), of streams that are in the block.
    buffers
        float64 memory, reused from block to block.
    """
    whole = Block(
        block.observation,
        block.detectors,
        block.samples,
        means={name: field for name, field in block.means.items() if name not in fields},
        dtype=np.float64,
        buffers=buffers,
        again=block.again,
        components=block.components,
    )
    names = names_of(operator, block.signals)
    for name, stream in block.detdata.items():
        whole.detdata[name] = stream
        if name in names:
            copy = whole.detdata[name] = whole.buffer(name, block.shape)
            if name in fields:
                fields[name].evaluate(block.detectors, block.samples, out=copy)
                copy += stream
            else:
                copy[...] = stream
    return whole


def take_whole(
    block: Block,
    whole: Block,
    operator: Operator,
    fields: Mapping[str, SmoothField],
) -> None:
    """Put what a step made of the whole block into the block: equation (1)."""
    for name in operator.provides & (block.detdata.keys() | whole.detdata.keys()):
        if name not in whole.detdata:  # the step took it away
            del block.detdata[name]
            block.means.pop(name, None)
        elif name in fields and name not in whole.means:
            mean = whole.buffer("(mean)", block.shape)
            fields[name].evaluate(block.detectors, block.samples, out=mean)
            np.subtract(
                whole.detdata[name],
                mean,
                out=block.new(name, zero=False),
                casting="same_kind",
            )
        else:
            block.new(name, zero=False)[...] = whole.detdata[name]
    for name in block.means.keys() - whole.means.keys() - fields.keys():
        del block.means[name]
    block.means.update(whole.means)


class MeansOfBands:
    """Means of the bands of a stream, one band after the other; bands without a mean have zeros.

    Parameters
    ----------
    fields
        The mean of each band, or None, and its detectors' rows.
    """

    def __init__(self, fields: Sequence[tuple[SmoothField | None, slice]]) -> None:
        self._fields = fields

    def evaluate(self, detectors: slice, samples: slice) -> Floats:
        """Values of all bands on a rectangle (n_det_block, n_samp_block), as of `SmoothField`."""
        shape = detectors.stop - detectors.start, samples.stop - samples.start
        found = np.zeros(shape)
        for mean, rows in self._fields:
            first = max(rows.start, detectors.start)
            stop = min(rows.stop, detectors.stop)
            if mean is not None and first < stop:
                own = slice(first - rows.start, stop - rows.start)
                into = slice(first - detectors.start, stop - detectors.start)
                found[into] = mean.evaluate(own, samples)
        return found


class WholeStream(Stream):
    """A stream with its mean in it, float64, for `Operator.measure`.

    Parameters
    ----------
    stream, field
        x and M of equation (1).
    allocate
        Gives an array of a shape for all of it, where somebody wants it as one.
    """

    def __init__(
        self,
        stream: Stream,
        field: SmoothField,
        allocate: Callable[[tuple[int, int]], AnyFloats],
    ) -> None:
        vars(self).update((name, v) for name, v in vars(stream).items() if name != "array")
        self.means = {name: other for name, other in stream.means.items() if name != stream.name}
        self._stream = stream
        self._field = field
        self._allocate = allocate

    @cached_property
    def array(self) -> AnyFloats:  # type: ignore[override]
        """(n_det, n_samp) float64; where the stream is made again when it is read, as there:
        refused.
        """
        whole = self._allocate(self._stream.array.shape)
        for detectors, samples, part in self.sweep(lambda detectors, samples, part: part):
            whole[detectors, samples] = part
        return whole

    @property
    def dtype(self) -> np.dtype[Any]:
        """float64."""
        return np.dtype(np.float64)

    def sweep(
        self,
        work: Callable[[slice, slice, AnyFloats], Any],
    ) -> Iterator[tuple[slice, slice, Any]]:
        """See `Stream.sweep`."""

        def of_whole(detectors: slice, samples: slice, part: AnyFloats) -> Any:
            whole = self._field.evaluate(detectors, samples)
            whole += part
            return work(detectors, samples, whole)

        return self._stream.sweep(of_whole)
