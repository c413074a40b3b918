"""How scans cross in the pixels of a map, and which scan hit which.

At each sample a detector moves on the sky in a direction, at the angle psi from the parallel of the
map's frame (from east to north). In each pixel

    X = |sum_i exp(2 i psi_i)| / n                                                               (1)

over its n samples says how one-sided their directions are: 1 where all moved along one line, 0
where they crossed evenly. There is no weight. This is the crosslinking of ACT's maps (Aiola et al.
2020, arXiv:2007.07288: `xlink`, whose I, Q and U are n and the two sums, with weights) and of
TOAST's `CrossLinking`. With r the direction that a detector looks at and v how it moves,

    exp(2 i psi) = (e + i n)^2 / |e + i n|^2,   e = (x v_y - y v_x) |r|,
    n = (x^2 + y^2) v_z - z (x v_x + y v_y)         (2)

needs no trigonometry. v is half the difference of the next and the last sample's r. Where a
detector does not move its direction is not known, and the sample is left out; so is one at the
pole. Cosine and sine are rounded to 2^-30: as int64 the sums are exact.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.block import Block
from zonda.core.errors import PipelineError
from zonda.core.kernels import kernel
from zonda.core.maps.planes import Plane
from zonda.core.types import Floats

from .image_grid import rays
from .looking import Cells, Looking, tiles
from .sums import WEIGHT, Sums

SLOWEST = 1e-10
"""Radians per sample below which a detector does not move: far below sidereal motion, far above the
rounding of directions.
"""
CROSSLINKING = Plane(
    None,
    {"crosslinking": "0: scans cross evenly, 1: one direction"},
    unit="0: directions cross evenly, 1: one direction",
    colours=(0.0, 1.0),
    title="Crosslinking",
    caption=(
        "The size of the mean of exp(2iψ), ψ the direction in which detectors move through a pixel."
    ),
)
DIRECTIONS = Plane(
    None,
    {
        "mean_cos_2psi": "mean of cos 2 psi, psi the scan direction",
        "mean_sin_2psi": "mean of sin 2 psi, psi from east to north",
    },
    unit="mean of cos or sin 2 psi",
)
MOST_ENTRIES = 1 << 27
"""Pixels of all scans together whose hits are kept: 1 GB."""


@dataclass
class Directions:
    """One observation's directions of motion, and the sums of each thread, (n_pixels, 3): n, and
    both parts of equation (1).

    Attributes
    ----------
    rays, motion
        (9, n_samp) coefficients of r in the map's frame, and of v.
    good
        (n_samp,) uint8: which samples count.
    """

    looking: Looking
    rays: Floats
    motion: Floats
    good: NDArray[np.uint8]
    parts: dict[int, Sums] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)

    @classmethod
    def of(cls, looking: Looking, good: NDArray[np.bool_]) -> Directions:
        """``good`` (n_samp,): which samples count."""
        towards = rays(looking.observation, looking.grid.frame)
        motion = np.gradient(towards, axis=1) if towards.shape[1] > 1 else np.zeros_like(towards)
        return cls(looking, towards, motion, good.astype(np.uint8))

    def add(self, signals: Sequence[Any], block: Block, cells: Cells) -> None:
        """Add a block's samples that are finite in all ``signals``, each (n_det, n)."""
        finite = np.isfinite(signals[0])
        for signal in signals[1:]:
            finite &= np.isfinite(signal)
        mine = threading.get_ident()
        with self.lock:
            sums = self.parts.setdefault(mine, np.zeros((0, 3), np.int64))
            if not len(sums):
                sums = self.parts[mine] = np.zeros((self.looking.grid.n_pixels, 3), np.int64)
        plane, begin = block.observation.focalplane, block.samples.start
        for rows, start, stop in tiles(block, block.observation.good_detectors[block.detectors]):
            which = rows + block.detectors.start
            xi, eta = plane.xi[which], plane.eta[which]
            index = cells.of(self.looking, which, start, stop)
            add_directions(
                self.rays,
                self.motion,
                start,
                xi,
                eta,
                index,
                rows,
                finite,
                start - begin,
                self.good,
                sums,
            )


@kernel(fastmath=False)
def add_directions(  # type: ignore[no-untyped-def]
    rays, motion, start, xi, eta, index, rows, finite, first, good, sums
):
    """Add equation (2) of samples ``start`` .. of detectors at (xi, eta) to their pixels ``index``
    (n_det, n), -1 outside.

    ``finite`` (n_row, n_samp of the block): of detector ``rows[d]`` from sample ``first`` of the
    block on.
    """
    for d in range(xi.size):
        a, b = xi[d], eta[d]
        for k in range(index.shape[1]):
            t, pixel = start + k, index[d, k]
            if pixel < 0 or not good[t] or not finite[rows[d], first + k]:
                continue
            x = rays[0, t] * a + rays[1, t] * b + rays[2, t]
            y = rays[3, t] * a + rays[4, t] * b + rays[5, t]
            z = rays[6, t] * a + rays[7, t] * b + rays[8, t]
            u = motion[0, t] * a + motion[1, t] * b + motion[2, t]
            v = motion[3, t] * a + motion[4, t] * b + motion[5, t]
            w = motion[6, t] * a + motion[7, t] * b + motion[8, t]
            around = x * x + y * y
            square = around + z * z
            east = (x * v - y * u) * np.sqrt(square)
            north = around * w - z * (x * u + y * v)
            speed = east * east + north * north
            if speed > SLOWEST * SLOWEST * around * square * square:
                row = sums[pixel]
                row[0] += 1
                row[1] += np.int64(np.rint((east * east - north * north) / speed * WEIGHT))
                row[2] += np.int64(np.rint(2.0 * east * north / speed * WEIGHT))


@dataclass
class Coverage:
    """What a map tells beside its samples' mean; None: not asked for.

    Attributes
    ----------
    directions
        (n_pixels, 3) n and both parts of the sum of equation (1), the latter in units of 2^-30.
    pixels, hits
        Of each observation, int32: which pixels it hit, and how often.
    """

    directions: Sums | None = None
    pixels: list[NDArray[np.int32]] | None = None
    hits: list[NDArray[np.int32]] = field(default_factory=list)

    @classmethod
    def empty(cls, n_pixels: int, crosslinking: bool, scan_hits: bool) -> Coverage:
        """Of no observation."""
        return cls(
            np.zeros((n_pixels, 3), np.int64) if crosslinking else None, [] if scan_hits else None
        )

    def add_directions(self, found: Directions) -> None:
        """Add an observation's directions."""
        assert self.directions is not None
        for sums in found.parts.values():
            pixels = np.flatnonzero(sums[:, 0])
            self.directions[pixels] += sums.take(
                pixels, axis=0
            )  # of 2^33 samples in a pixel they would overflow
        found.parts.clear()

    def add_hits(self, hits: Sums, place: str) -> None:
        """Keep an observation's hits (n_pixels,). Raises PipelineError where all observations' are
        too many.
        """
        assert self.pixels is not None
        pixels = np.flatnonzero(hits)
        self.pixels.append(pixels.astype(np.int32))
        self.hits.append(hits[pixels].astype(np.int32))
        self.check(place)

    def check(self, place: str) -> None:
        """Raise PipelineError where hits of more pixels are kept than `MOST_ENTRIES`."""
        if (entries := sum(len(some) for some in self.pixels or [])) > MOST_ENTRIES:
            raise PipelineError(
                f"the hits of {len(self.hits)} scans in {entries:.3g} pixels would take more than"
                " 1 GB",
                place=place,
                cure="leave out scan_hits, or make larger pixels or maps of fewer scans",
            )

    def __iadd__(self, other: Coverage) -> Coverage:
        """Add what later observations made: exact."""
        if self.directions is not None and other.directions is not None:
            pixels = np.flatnonzero(other.directions[:, 0])
            self.directions[pixels] += other.directions.take(pixels, axis=0)
        if self.pixels is not None and other.pixels is not None:
            self.pixels += other.pixels
            self.hits += other.hits
        return self

    def arrays(self) -> dict[str, Any]:
        """See `Product.arrays`."""
        found: dict[str, Any] = {}
        if self.directions is not None:
            pixels = np.flatnonzero(self.directions[:, 0])
            found |= {"pixels": pixels, "directions": self.directions.take(pixels, axis=0)}
        if self.pixels is not None:
            found |= {"pixels_of_scans": list(self.pixels), "hits_of_scans": list(self.hits)}
        return found

    @classmethod
    def of(cls, arrays: Mapping[str, Any], n_pixels: int) -> Coverage:
        """What `arrays` gave, put together again."""
        made = cls.empty(n_pixels, "directions" in arrays, "hits_of_scans" in arrays)
        if made.directions is not None:
            made.directions[arrays["pixels"]] = arrays["directions"]
        if made.pixels is not None:
            made.pixels, made.hits = list(arrays["pixels_of_scans"]), list(arrays["hits_of_scans"])
        return made

    def planes(self) -> dict[str, Plane]:
        """Planes (n, n_pixels) of the map: equation (1), and the means of cos 2 psi and sin 2 psi;
        NaN where no sample has a direction.
        """
        if self.directions is None:
            return {}
        with np.errstate(invalid="ignore", divide="ignore"):
            means = np.asarray(self.directions[:, 1:].T / (self.directions[:, 0] * WEIGHT))
        return {
            "crosslinking": replace(CROSSLINKING, values=np.hypot(*means)[None]),
            "directions": replace(DIRECTIONS, values=means),
        }
