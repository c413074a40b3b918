"""Sampling of a scan, the state of `SkyMap` for an observation: convolved maps, the boresight on
them, counts.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from functools import partial
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
from .sampling import Chunks, Rows, pointing, sample

if TYPE_CHECKING:
    from zonda.core.data import Log


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


@dataclass(frozen=True)
class Beam:
    """A map convolved with one beam.

    Attributes
    ----------
    fwhm
        rad; 0: no beam.
    planes
        I, or I, Q and U, on one grid.
    matrix
        (3, 3) from ICRS directions to the points of the convolved grid.
    covered
        `Brightness.covered` on those points.
    """

    fwhm: float
    planes: tuple[Convolved, ...]
    matrix: Floats
    covered: NDArray[np.uint8]

    @classmethod
    def of(cls, sky: Brightness, fwhm: float, planes: tuple[Convolved, ...]) -> Beam:
        """``planes``: those of ``sky`` with the beam of ``fwhm`` [rad]."""
        first = planes[0]
        return cls(fwhm, planes, first.to_grid @ pixel_matrix(sky.wcs), first.covered(sky.covered))

    @property
    def nbytes(self) -> int:
        return self.covered.nbytes + sum(plane.nbytes for plane in self.planes)

    def tell(self, log: Log, label: str) -> None:
        """State its width and how finely it is sampled."""
        if self.fwhm == 0.0:
            log.state(label, "beam", "none")
            return
        first = self.planes[0]
        text = f"Gaussian, {' x '.join(str(q) for q in first.steps)} grid steps per input pixel"
        if first.coarse:
            text += (
                "; the input has fewer than 2 pixels per FWHM: it is taken as smooth between its"
                " pixels"
            )
        log.state(label, f"beam of {np.degrees(self.fwhm) * 3600:.6g} arcsec", text)

    def pointing(self, block: Block, kind: Any) -> Chunks:
        """`sampling.pointing` of a block, for samples of the type ``kind``."""
        boresight = block.observation.sky_boresight[block.samples]
        quaternions = np.ascontiguousarray(boresight, np.float64)
        first = self.planes[0]
        shape = first.coefficients["float64"].shape
        return pointing(quaternions, self.matrix, shape, first.bounds, kind)

    def add(
        self, plane: int, chunks: Chunks, rows: Rows, out: AnyFloats, linear: bool, over: bool
    ) -> tuple[int, int]:
        """Add the plane of this number to ``out``, see `sampling.sample`; ``chunks`` by
        `pointing`.
        """
        values = self.planes[plane].coefficients[out.dtype.name]
        return sample(chunks, rows, values, self.covered, out, linear=linear, over=over)


@dataclass
class ScanSampler:
    """State for `SkyMap.exec`: samples the convolved maps in the blocks of a scan.

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

    def tell(self, log: Log, label: str) -> None:
        """State what was chosen, and count what was taken for something else."""
        for what, text in self.sky.notes.items():
            log.state(label, what, text)
        for what, number in self.sky.counts.items():
            if number:
                log.count(label, what, number)
        for beam in self.beams:
            beam.tell(log, label)

    def sample(self, block: Block, out: AnyFloats, linear: bool, over: bool) -> None:
        """Add the sky to a block's stream (`sampling.sample`), and count the samples that see
        none.
        """
        plane, index = block.observation.focalplane, self.index[block.detectors]
        xi, eta = plane.xi[block.detectors], plane.eta[block.detectors]
        efficiency = plane.polarization_efficiency[block.detectors]
        beyond = behind = 0
        if not self.beams:
            boresight = block.observation.sky_boresight[block.samples]
            beyond, behind = out.size, self.grid.behind(boresight, xi, eta)
        for number, beam in enumerate(self.beams):
            rows = np.flatnonzero(index == number)
            if not rows.size:
                continue
            kind = out.dtype.type
            key = block.samples.start, block.samples.stop, number, kind
            chunks = self._chunks.get(
                key, partial(beam.pointing, block, kind)
            )  # detectors share it
            found = beam.add(0, chunks, Rows(rows, xi[rows], eta[rows]), out, linear, over)
            beyond, behind = beyond + found[0], behind + found[1]
            rows = rows[efficiency[rows] > 0]
            if self.angles is None or not rows.size:
                continue
            # p (Q cos 2 psi + U sin 2 psi), equation (1) of core.polarization
            own = Rows(np.arange(rows.size), xi[rows], eta[rows])
            q, u = (block.buffer(f"sky {name}", (rows.size, out.shape[1])) for name in "QU")
            beam.add(1, chunks, own, q, linear, True)
            beam.add(2, chunks, own, u, linear, True)
            detectors, start = rows + block.detectors.start, block.samples.start
            self.angles.add(detectors, start, efficiency[rows], (q, u), rows, out)
        if not block.again:  # a block that is made again is counted once
            self._counts[block.detectors.start, block.samples.start] = (beyond, behind)

    def totals(self) -> tuple[int, int]:
        """Samples (outside the input map, more than 90 deg from its centre)."""
        counts = list(self._counts.values())
        return sum(c[0] for c in counts), sum(c[1] for c in counts)
