"""Segments of a chain, and the blocks and pieces in which they work."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..data import Block
from ..numerics.chunks import TILE_DETECTORS, TILE_SAMPLES
from ..numerics.smooth import SmoothField
from ..operator import Operator
from ..plan.planning import planning_of
from ..types import AnyFloats
from .settings import Held
from .views import View

PIECE = 4 * TILE_SAMPLES
"""Samples that operators without coupling see at once: 0.5 MB per float32 stream, and little time
lost between calls.
"""


@dataclass
class Source:
    """Streams that a segment reads.

    Attributes
    ----------
    arrays
        Those that are held, by name: the detectors of all bands, one band after the other.
    segment
        Makes them where none is held.
    means
        By number of the band, the mean emission that belongs to its rows.
    """

    arrays: dict[str, AnyFloats] = field(default_factory=dict)
    segment: Segment | None = None
    names: frozenset[str] = frozenset()
    means: dict[int, dict[str, SmoothField]] = field(default_factory=dict)


@dataclass(eq=False)
class Segment:
    """Operators that see the same blocks.

    Attributes
    ----------
    span
        What a block must hold whole for them: ``time``, ``detectors``, or ``sample``, nothing.
    halo
        Neighbours that they need on each side.
    in_time_order
        Blocks hold all detectors and come in order of time (`Planning.in_time_order`).
    wanted
        Names of the streams that it passes on.
    how, why
        What becomes of the streams that it makes new.
    held
        Bytes of streams that are held beside its blocks.
    swept
        Numbers of the bands of which it has worked on every sample once: what comes now comes
        again.
    """

    operators: list[Operator]
    span: str = "sample"
    halo: int = 0
    in_time_order: bool = False
    source: Source = field(default_factory=Source)
    wanted: frozenset[str] = frozenset()
    how: Held = "kept"
    why: str = ""
    held: int = 0
    swept: set[int] = field(default_factory=set)

    @property
    def whole(self) -> str:
        """Span that its blocks must hold whole, for those that make its streams again too."""
        before = self.source.segment
        return before.whole if before and self.span == "sample" else self.span

    @property
    def ordered(self) -> bool:
        """True if it, or what makes its streams again, is much cheaper in order of time."""
        before = self.source.segment
        return self.in_time_order or (before is not None and before.ordered)

    def has_been_swept(self, views: Sequence[View]) -> None:
        """Note that every sample of some bands was worked on."""
        self.swept.update(view.number for view in views)
        if self.source.segment is not None:
            self.source.segment.has_been_swept(views)

    def split(self) -> tuple[list[Operator], list[Operator]]:
        """The first operators, which take a block in pieces, and those from the first coupled one
        on.
        """
        if self.halo:
            return [], self.operators
        coupled = [o.couples in ("detectors", "time") for o in self.operators]
        cut = coupled.index(True) if any(coupled) else len(coupled)
        return self.operators[:cut], self.operators[cut:]


def cut(views: Sequence[View]) -> list[Segment]:
    """Cut the steps of bands that are executed together into segments where the coupling changes.

    A step is given as many neighbours as it needs in any of them, and blocks in order of time if
    it asks for that in one.
    """
    segments = [Segment([])]
    for steps in zip(*(view.chain.steps for view in views), strict=True):
        operator = steps[0]
        last = segments[-1]
        each = [(o, view.observation) for o, view in zip(steps, views, strict=True)]
        couples = operator.couples
        halo = max(o.halo(seen) for o, seen in each)
        in_order = any(planning_of(o).in_time_order(seen) for o, seen in each)
        apart = (in_order and last.span == "time") or (last.in_time_order and couples == "time")
        apart |= couples == "all"
        margins = 0 if apart or last.span == "time" else halo  # whole scans need none
        if not apart and not margins and couples in ("sample", last.span):
            last.operators.append(operator)
        elif not apart and not margins and last.span == "sample" and not last.halo:
            last.operators.append(operator)
            last.span = couples
        else:
            span = "sample" if couples == "all" or margins else couples
            segments.append(Segment([operator], span, margins))
        segments[-1].in_time_order |= in_order
    return [s for s in segments if s.operators]


def least_block(span: str, shape: tuple[int, int]) -> tuple[int, int]:
    """(rows, samples) of the smallest block."""
    n_det, n_samp = shape
    if span == "detectors":
        return n_det, min(n_samp, TILE_SAMPLES)
    return min(n_det, TILE_DETECTORS), n_samp if span == "time" else min(n_samp, TILE_SAMPLES)


def block_share(budget: int, whole: int, part: int) -> int:
    """Samples that a block may hold where ``whole`` arrays of its size and ``part`` of a piece's
    must fit in ``budget`` items.
    """
    pieces_take = part * TILE_DETECTORS * PIECE
    return max(budget // max(whole + part, 1), (budget - pieces_take) // max(whole, 1))


def blocks(
    span: str,
    in_time_order: bool,
    shape: tuple[int, int],
    share: int,
) -> Iterator[tuple[slice, slice]]:
    """Blocks of at most ``share`` samples (or the least) that cover the observation, detectors
    first.

    ``in_time_order``: times first, where the span allows.
    """
    n_det, n_samp = shape
    rows, _ = least_block(span, shape)
    if in_time_order and span == "sample":
        columns = min(n_samp, PIECE, max(1, share // rows // TILE_SAMPLES) * TILE_SAMPLES)
        rows = min(n_det, max(1, share // columns // TILE_DETECTORS) * TILE_DETECTORS)
        for start in range(0, n_samp, columns):
            for first in range(0, n_det, rows):
                yield (
                    slice(first, min(first + rows, n_det)),
                    slice(start, min(start + columns, n_samp)),
                )
        return
    columns = (
        n_samp
        if span == "time"
        else min(n_samp, max(1, share // rows // TILE_SAMPLES) * TILE_SAMPLES)
    )
    for first in range(0, n_det, rows):
        for start in range(0, n_samp, columns):
            yield slice(first, min(first + rows, n_det)), slice(start, min(start + columns, n_samp))


def pieces(detectors: slice, samples: slice) -> Iterator[tuple[slice, slice]]:
    """The pieces of a block, in order of time."""
    for start in range(samples.start, samples.stop, PIECE):
        for first in range(detectors.start, detectors.stop, TILE_DETECTORS):
            yield (
                slice(first, min(first + TILE_DETECTORS, detectors.stop)),
                slice(start, min(start + PIECE, samples.stop)),
            )


def within(whole: slice, part: slice) -> slice:
    """Place of ``part`` in an array that begins where ``whole`` does."""
    return slice(part.start - whole.start, part.stop - whole.start)


def trimmed(block: Block, samples: slice) -> Block:
    """The block without its margins."""
    inside = within(block.samples, samples)
    detdata = {
        name: np.ascontiguousarray(array[:, inside]) for name, array in block.detdata.items()
    }
    return Block(block.observation, block.detectors, samples, detdata, block.means, block.dtype)
