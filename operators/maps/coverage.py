"""Directions in which scans cross the pixels of a map, and the hits of each scan.

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
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from zonda.core.block import Block
from zonda.core.errors import PipelineError
from zonda.core.kernels import kernel
from zonda.core.maps.planes import Plane
from zonda.core.types import Floats

from .grid import Cells, Looking, PixelGrid, tiles
from .intensity_kernel import WEIGHT, Sums

SLOWEST = 1e-10
"""Radians per sample below which a detector does not move: far below sidereal motion, far above the
rounding of directions.
"""
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
        """Directions of a scan without any block; ``good`` (n_samp,): the samples that count."""
        towards = PixelGrid.pointing(looking.grid, looking.observation)
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


class PixelCount(ABC):
    """Integers that a map adds up over its scans beside the samples' means, and their planes.

    A further one is a subclass in `COUNTS` and a parameter of the same name in `MapParameters`.
    """

    columns: ClassVar[int] = 1
    """Integers in each pixel."""
    memory: ClassVar[int] = 24
    """Bytes for each pixel: those of two tasks while they are added up, and of the planes."""
    of_hits: ClassVar[bool] = True
    """The hits of each scan are needed."""

    @staticmethod
    @abstractmethod
    def of_scan(
        hits: Sums | None,
        directions: Directions | None,
    ) -> Iterator[tuple[NDArray[np.int64], Sums]]:
        """Pixels, and what a scan with ``hits`` (n_pixels,) adds there, (n, columns)."""

    @staticmethod
    @abstractmethod
    def planes(sums: Sums) -> dict[str, Plane]:
        """Planes of the map by name, each row (n_pixels,)."""


class Crosslinking(PixelCount):
    """n and both parts of the sum of equation (1), the latter in units of 2^-30."""

    columns = 3
    memory = 96
    of_hits = False

    @staticmethod
    def of_scan(
        hits: Sums | None,
        directions: Directions | None,
    ) -> Iterator[tuple[NDArray[np.int64], Sums]]:
        assert directions is not None
        for sums in directions.parts.values():
            pixels = np.flatnonzero(sums[:, 0])
            yield (
                pixels,
                sums.take(pixels, axis=0),
            )  # of 2^33 samples in a pixel they would overflow
        directions.parts.clear()

    @staticmethod
    def planes(sums: Sums) -> dict[str, Plane]:
        with np.errstate(invalid="ignore", divide="ignore"):
            means = np.asarray(sums[:, 1:].T / (sums[:, 0] * WEIGHT))
        crosslinking = Plane(
            np.hypot(*means)[None],
            {"crosslinking": "0: scans cross evenly, 1: one direction"},
            unit="0: directions cross evenly, 1: one direction",
            colours=(0.0, 1.0),
            title="Crosslinking",
            caption=(
                "The size of the mean of exp(2iψ), ψ the direction in which detectors move through"
                " a pixel."
            ),
        )
        names = {
            "mean_cos_2psi": "mean of cos 2 psi, psi the scan direction",
            "mean_sin_2psi": "mean of sin 2 psi, psi from east to north",
        }
        directions = Plane(means, names, unit="mean of cos or sin 2 psi")
        return {"crosslinking": crosslinking, "directions": directions}


class Visits(PixelCount):
    """Scans that have samples in a pixel."""

    @staticmethod
    def of_scan(
        hits: Sums | None,
        directions: Directions | None,
    ) -> Iterator[tuple[NDArray[np.int64], Sums]]:
        assert hits is not None
        pixels = np.flatnonzero(hits)
        yield pixels, np.ones((len(pixels), 1), np.int64)

    @staticmethod
    def planes(sums: Sums) -> dict[str, Plane]:
        visits = Plane(
            sums.T,
            {"visits": "scans per pixel"},
            unit="scans per pixel",
            colours=(0.0, None),
            title="Visits",
            caption="The number of scans that have samples in a pixel.",
        )
        return {"visits": visits}


COUNTS: dict[str, type[PixelCount]] = {"crosslinking": Crosslinking, "visits": Visits}
"""By the parameter of the map maker that asks for them."""


@dataclass
class Coverage:
    """Counts of a map beside its samples' mean, and the hits of each scan.

    Attributes
    ----------
    sums
        (n_pixels, columns) of each of `COUNTS` that is asked for.
    pixels, hits
        Of each observation, int32: which pixels it hit, and how often; None: not asked for.
    """

    sums: dict[str, Sums] = field(default_factory=dict)
    pixels: list[NDArray[np.int32]] | None = None
    hits: list[NDArray[np.int32]] = field(default_factory=list)

    @classmethod
    def empty(cls, n_pixels: int, counts: Iterable[str], scan_hits: bool) -> Coverage:
        """The coverage of no observation: zeros."""
        sums = {name: np.zeros((n_pixels, COUNTS[name].columns), np.int64) for name in counts}
        return cls(sums, [] if scan_hits else None)

    @property
    def of_hits(self) -> bool:
        """True if the hits of each scan are needed."""
        return self.pixels is not None or any(COUNTS[name].of_hits for name in self.sums)

    def add(self, hits: Sums | None, directions: Directions | None, place: str) -> None:
        """Add an observation with ``hits`` (n_pixels,) (None: not needed). Raises PipelineError
        where all observations' hits are too many to be kept.
        """
        for name, sums in self.sums.items():
            for where, more in COUNTS[name].of_scan(hits, directions):
                sums[where] += more
        if self.pixels is not None and hits is not None:
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
        for name, sums in self.sums.items():
            pixels = np.flatnonzero(other.sums[name].any(axis=1))
            sums[pixels] += other.sums[name].take(pixels, axis=0)
        if self.pixels is not None and other.pixels is not None:
            self.pixels += other.pixels
            self.hits += other.hits
        return self

    def arrays(self) -> dict[str, Any]:
        """See `Product.arrays`."""
        found: dict[str, Any] = {"counts": list(self.sums)}
        for name, sums in self.sums.items():
            pixels = np.flatnonzero(sums.any(axis=1))
            found |= {f"{name}_pixels": pixels, name: sums.take(pixels, axis=0)}
        if self.pixels is not None:
            found |= {"pixels_of_scans": list(self.pixels), "hits_of_scans": list(self.hits)}
        return found

    @classmethod
    def of(cls, arrays: Mapping[str, Any], n_pixels: int) -> Coverage:
        """The coverage that `arrays` took apart."""
        made = cls.empty(n_pixels, arrays["counts"], "hits_of_scans" in arrays)
        for name, sums in made.sums.items():
            sums[arrays[f"{name}_pixels"]] = arrays[name]
        if made.pixels is not None:
            made.pixels, made.hits = list(arrays["pixels_of_scans"]), list(arrays["hits_of_scans"])
        return made

    def planes(self) -> dict[str, Plane]:
        """Planes of the map, each row (n_pixels,)."""
        found = (COUNTS[name].planes(sums) for name, sums in self.sums.items())
        return {key: plane for planes in found for key, plane in planes.items()}
