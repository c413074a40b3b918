"""The pointing matrix P of one scan and its transpose, found anew tile by tile.

    (P m)_i = sum_k w_ik (I + c_i Q + s_i U)_(p_ik)                                          (1)

with c and s of `core.polarization`, over the pixel that holds a sample (w = 1), or over the four
pixels around it: in images w = (1 - |x - x_k|) (1 - |y - y_k|), on HEALPix the interpolation of
`healpy`.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator

from zonda.core.flags import has_a_signal
from zonda.core.kernels import kernel
from zonda.core.numerics.chunks import TILE_DETECTORS, TILE_SAMPLES, chunks
from zonda.core.numerics.projection import frame_rotation
from zonda.core.observation import Observation
from zonda.core.polarization import PolarizationAngles
from zonda.core.types import Floats

from .angle_checks import check_polarized
from .grid import Grid, HealpixGrid, Looking, TangentGrid
from .plate_carree import rows_of

Corners = tuple[NDArray[np.int32], Floats]
"""Pixels (1 or 4, n_det, n), -1 where a sample sees none, and their weights; (0, 0, 0): all 1."""


class Pointing(LinearOperator):
    """P of equation (1): maps (n_stokes, n_pixels) to streams (n_det, n_samp), both flat.

    Samples beyond the map see nothing, nor do those of dead detectors, and those whose flags say
    that they have no signal; `rmatvec` does not read them.

    Attributes
    ----------
    observation, grid
        The scan, and the pixels of the map.
    interpolation
        ``nearest`` or ``bilinear``.
    n_stokes
        1, or 3 for I, Q and U.
    """

    def __init__(
        self,
        observation: Observation,
        grid: Grid,
        interpolation: Literal["nearest", "bilinear"],
        n_stokes: Literal[1, 3],
    ) -> None:
        self.observation, self.grid = observation, grid
        self.interpolation, self.n_stokes = interpolation, n_stokes
        self._looking, self._angles = Looking.of(observation, grid), None
        if n_stokes == 3:
            check_polarized(observation, "zonda.linear.pointing")
            pole = frame_rotation(grid.frame)[2]
            self._angles = PolarizationAngles.of(observation, observation.boresight_radec, pole)
        samples = observation.n_detectors * observation.n_samples
        super().__init__(np.float64, (samples, n_stokes * grid.n_pixels))  # type: ignore[call-arg]

    def _matvec(self, m: Floats) -> Floats:
        out = np.zeros((self.observation.n_detectors, self.observation.n_samples))
        maps = np.ascontiguousarray(m, np.float64).reshape(self.n_stokes, -1)
        self._each(_see, maps, out)
        return out.ravel()

    def _rmatvec(self, d: Floats) -> Floats:
        out = np.zeros((self.n_stokes, self.grid.n_pixels))
        shape = self.observation.n_detectors, self.observation.n_samples
        self._each(_spread, out, np.ascontiguousarray(d, np.float64).reshape(shape))
        return out.ravel()

    def _each(self, act: Any, maps: Floats, streams: Floats) -> None:
        """Call a kernel for each tile of good detectors."""
        scan = self.observation
        good, seen = np.flatnonzero(scan.good_detectors), has_a_signal(scan.flags)
        efficiency = scan.focalplane.polarization_efficiency
        for some in chunks(good.size, TILE_DETECTORS):
            which = good[some]
            for at in chunks(scan.n_samples, TILE_SAMPLES):
                index, weight = self._corners(which, at.start, at.stop)
                index[:, :, ~seen[at]] = -1
                c, s = np.zeros((2, which.size, 0 if self._angles is None else index.shape[2]))
                if self._angles is not None:
                    self._angles.fill(which, at.start, c, s)
                    c *= efficiency[which, None]
                    s *= efficiency[which, None]
                act(index, weight, c, s, which, at.start, maps, streams)

    def _corners(self, which: NDArray[np.intp], start: int, stop: int) -> Corners:
        if self.interpolation == "nearest":
            return self._looking.pixels(which, start, stop)[None], np.zeros((0, 0, 0))
        plane, h = self.observation.focalplane, self._looking.pointing[:, None, start:stop]
        xi, eta = plane.xi[which, None], plane.eta[which, None]
        rays = [h[k] * xi + h[k + 1] * eta + h[k + 2] for k in (0, 3, 6)]
        return around(self.grid, *rays)


def around(grid: Grid, x: Floats, y: Floats, z: Floats) -> Corners:
    """The four pixels around directions (n_det, n), whose coordinates are those of
    `PixelGrid.pointing`; a sample sees none where one of them is not in the map.
    """
    if isinstance(grid, HealpixGrid):
        import healpy

        theta, phi = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x) % (2 * math.pi)
        pixel, weight = healpy.get_interp_weights(grid.nside, theta, phi, nest=grid.nest)
        covered = grid.pixels_covered
        index = np.minimum(np.searchsorted(covered, pixel), covered.size - 1)
        inside = covered[index] == pixel
        return np.where(inside.all(axis=0), index, -1).astype(np.int32), weight
    ny, nx = grid.shape
    if isinstance(grid, TangentGrid):
        ahead = z > 0
        column, row = (np.where(ahead, a / np.where(ahead, z, 1.0), -2.0) for a in (x, y))
    else:
        rows = rows_of(grid.pixel)
        column = ((math.pi - np.arctan2(y, x)) / math.pi * rows - grid.origin[0]) % (2 * rows)
        row = (np.arctan2(z, np.hypot(x, y)) / math.pi + 0.5) * rows - 0.5 - grid.origin[1]
    column, row = np.clip(column, -2.0, nx + 1.0), np.clip(row, -2.0, ny + 1.0)
    a, b = np.floor(column), np.floor(row)
    u, v = column - a, row - b
    inside = (a >= 0) & (a < nx - 1) & (b >= 0) & (b < ny - 1)
    first = np.where(inside, b * nx + a, -1.0).astype(np.int32)
    index = np.stack([np.where(inside, first + step, -1) for step in (0, 1, nx, nx + 1)])
    weight = np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v])
    return index.astype(np.int32), weight


@kernel
def _see(index, weight, cosine, sine, which, start, m, out):  # type: ignore[no-untyped-def]
    """Equation (1) for the detectors ``which`` of streams ``out``."""
    polarized = m.shape[0] > 1
    for d in range(index.shape[1]):
        for t in range(index.shape[2]):
            total = 0.0
            for k in range(index.shape[0]):
                p = index[k, d, t]
                if p >= 0:
                    v = m[0, p]
                    if polarized:
                        v += cosine[d, t] * m[1, p] + sine[d, t] * m[2, p]
                    total += weight[k, d, t] * v if weight.size else v
            out[which[d], start + t] = total


@kernel
def _spread(index, weight, cosine, sine, which, start, m, streams):  # type: ignore[no-untyped-def]
    """The transpose of `_see`: add the streams to maps ``m``."""
    polarized = m.shape[0] > 1
    for d in range(index.shape[1]):
        for t in range(index.shape[2]):
            for k in range(index.shape[0]):
                p = index[k, d, t]
                if p >= 0:
                    v = streams[which[d], start + t]
                    v *= weight[k, d, t] if weight.size else 1.0
                    m[0, p] += v
                    if polarized:
                        m[1, p] += cosine[d, t] * v
                        m[2, p] += sine[d, t] * v
