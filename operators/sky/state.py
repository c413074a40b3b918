"""State of `SkyMap` for an observation: convolved maps, the boresight on them, counts."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.data import Block
from zonda.core.numerics.projection import pixel_matrix
from zonda.core.polarization import PolarizationAngles
from zonda.core.types import AnyFloats, Floats

from .beam import Convolved
from .brightness import Brightness
from .grid import Grid
from .linear import add_lines
from .sampling import Chunks, Rows, add_splines, pointing, sample


class Cache:
    """Computed values by key. Thread-safe; copies and pickles are empty.

    Parameters
    ----------
    limit
        Bytes kept; the values least recently used go first (an observation that needs them holds
        them itself).
    """

    def __init__(self, limit: int = 2**30) -> None:
        self._limit = limit
        self._lock = threading.RLock()
        self._kept: OrderedDict[Hashable, Any] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """The value of ``key``, made where it is not there. Values have ``nbytes``."""
        with self._lock:
            if key not in self._kept:
                self._kept[key] = make()
                while (
                    len(self._kept) > 1 and sum(v.nbytes for v in self._kept.values()) > self._limit
                ):
                    self._kept.popitem(last=False)
            self._kept.move_to_end(key)
            return self._kept[key]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Cache)

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> tuple[type[Cache], tuple[int]]:
        return Cache, (self._limit,)


Coefficients = dict[str, NDArray[np.floating[Any]]]

if TYPE_CHECKING:
    from zonda.core.data import Tally


@dataclass(frozen=True)
class Beam:
    """A map convolved with one beam.

    Attributes
    ----------
    fwhm
        rad; 0: no beam.
    matrix
        (3, 3) from ICRS directions to the points of the convolved grid.
    covered
        `Brightness.covered` on those points.
    polarization
        Coefficients of Q and of U, as those of ``convolved``; none where there are no such.
    """

    fwhm: float
    convolved: Convolved
    matrix: Floats
    covered: NDArray[np.uint8]
    polarization: tuple[Coefficients, ...] = ()

    @classmethod
    def of(
        cls,
        sky: Brightness,
        fwhm: float,
        convolved: Convolved,
        polarization: tuple[Coefficients, ...] = (),
    ) -> Beam:
        """``convolved``: ``sky`` with the beam of ``fwhm`` [rad]."""
        matrix = convolved.to_grid @ pixel_matrix(sky.wcs)
        return cls(fwhm, convolved, matrix, _on_grid(sky.covered, convolved), polarization)

    @property
    def nbytes(self) -> int:
        kept = (self.convolved.coefficients, *self.polarization)
        return self.covered.nbytes + sum(
            c.nbytes for coefficients in kept for c in coefficients.values()
        )

    def tell(self, tally: Tally, label: str) -> None:
        """State its width and how finely it is sampled."""
        if self.fwhm == 0.0:
            tally.state(label, "beam", "none")
            return
        text = (
            f"Gaussian, {' x '.join(str(q) for q in self.convolved.steps)} grid steps per input"
            " pixel"
        )
        if self.convolved.coarse:
            text += (
                "; the input has fewer than 2 pixels per FWHM: it is taken as smooth between its"
                " pixels"
            )
        tally.state(label, f"beam of {np.degrees(self.fwhm) * 3600:.6g} arcsec", text)


def _on_grid(covered: NDArray[np.bool_], convolved: Convolved) -> NDArray[np.uint8]:
    if not covered.size:
        return np.zeros((0, 0), np.uint8)
    shape = convolved.coefficients["float64"].shape
    whole = np.zeros(shape, np.uint8)
    (qx, qy), (x0, _, y0, _) = convolved.steps, convolved.bounds
    x, y = (
        np.floor((np.arange(shape[1]) - x0) / qx).astype(int),
        np.floor((np.arange(shape[0]) - y0) / qy).astype(int),
    )
    in_x, in_y = (x >= 0) & (x < covered.shape[1]), (y >= 0) & (y < covered.shape[0])
    whole[np.ix_(in_y, in_x)] = covered[np.ix_(y[in_y], x[in_x])]
    return whole


@dataclass(frozen=True)
class _Held:
    chunks: Chunks

    @property
    def nbytes(self) -> int:
        return sum(part.nbytes for part in self.chunks)


@dataclass
class SkyState:
    """State for `SkyMap.exec`.

    Attributes
    ----------
    beams
        None where no detector reaches the map.
    index
        (n_det,) number of each detector's beam.
    angles
        Of the detectors on the sky, from the meridians of the grid's Q and U; None: there are no Q
        and U.
    """

    grid: Grid
    sky: Brightness
    beams: list[Beam]
    index: NDArray[np.int64]
    angles: PolarizationAngles | None = None
    _counts: dict[tuple[int, int], tuple[int, int]] = field(default_factory=dict)
    _chunks: Cache = field(default_factory=lambda: Cache(2**22))

    def tell(self, tally: Tally, label: str) -> None:
        """State what was chosen, and count what was taken for something else."""
        for what, text in self.sky.notes.items():
            tally.state(label, what, text)
        for what, number in self.sky.counts.items():
            if number:
                tally.count(label, what, number)
        for beam in self.beams:
            beam.tell(tally, label)

    def sample(self, block: Block, out: AnyFloats, linear: bool, over: bool) -> None:
        """Add the sky to a block's stream (`sampling.sample`), and count the samples that see
        none.
        """
        plane, index = block.observation.focalplane, self.index[block.detectors]
        xi, eta = plane.xi[block.detectors], plane.eta[block.detectors]
        beyond = behind = 0
        if not self.beams:
            beyond, behind = (
                out.size,
                self.grid.behind(block.observation.sky_boresight[block.samples], xi, eta),
            )
        kernel = add_lines if linear else add_splines
        for number, beam in enumerate(self.beams):
            rows = np.flatnonzero(index == number)
            if rows.size:
                coefficients = beam.convolved.coefficients[out.dtype.name]
                chunks = self._pointing(block, number, out.dtype.type)
                detectors = Rows(rows, xi[rows], eta[rows])
                found = sample(kernel, chunks, detectors, coefficients, beam.covered, out, over)
                beyond, behind = beyond + found[0], behind + found[1]
                if self.angles is not None:
                    self._polarize(block, kernel, chunks, beam, detectors, out)
        if not block.again:  # a block that is made again is counted once
            self._counts[block.detectors.start, block.samples.start] = (beyond, behind)

    def _polarize(
        self, block: Block, kernel: Any, chunks: Chunks, beam: Beam, detectors: Rows, out: AnyFloats
    ) -> None:
        """Add p (Q cos 2 psi + U sin 2 psi) of the detectors that are polarized, equation (1) of
        `core.polarization`.
        """
        efficiency = block.observation.focalplane.polarization_efficiency[block.detectors][
            detectors.numbers
        ]
        seeing = efficiency > 0
        rows = Rows(detectors.numbers[seeing], detectors.xi[seeing], detectors.eta[seeing])
        if not rows.numbers.size or self.angles is None:
            return
        own = Rows(np.arange(rows.numbers.size), rows.xi, rows.eta)
        planes = []
        for name, coefficients in zip("QU", beam.polarization, strict=True):
            planes.append(block.buffer(f"sky {name}", (rows.numbers.size, out.shape[1])))
            sample(
                kernel, chunks, own, coefficients[out.dtype.name], beam.covered, planes[-1], True
            )
        which = rows.numbers + block.detectors.start
        self.angles.add(
            which,
            block.samples.start,
            efficiency[seeing],
            (planes[0], planes[1]),
            rows.numbers,
            out,
        )

    def _pointing(self, block: Block, number: int, kind: Any) -> Chunks:
        """`pointing` of a block for a beam, which blocks of other detectors share."""

        def make() -> _Held:
            quaternions = np.ascontiguousarray(
                block.observation.sky_boresight[block.samples], np.float64
            )
            beam = self.beams[number]
            shape = beam.convolved.coefficients["float64"].shape
            return _Held(pointing(quaternions, beam.matrix, shape, beam.convolved.bounds, kind))

        held: _Held = self._chunks.get(
            (block.samples.start, block.samples.stop, number, kind), make
        )
        return held.chunks

    def totals(self) -> tuple[int, int]:
        """Samples (outside the input map, more than 90 deg from its centre)."""
        counts = list(self._counts.values())
        return sum(c[0] for c in counts), sum(c[1] for c in counts)
