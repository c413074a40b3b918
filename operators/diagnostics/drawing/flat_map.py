"""A map as its picture needs it: single precision, numpy alone."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.maps.grid import image_grid
from zonda.core.numerics.angles import FWHM_PER_SIGMA
from zonda.core.numerics.transforms import convolved, gaussian_taps
from zonda.core.types import AnyFloats

from .sky_axes import SkyAxes


@dataclass(frozen=True)
class FlatMap:
    """Planes (ny, nx) of one map.

    Attributes
    ----------
    planes
        K_RJ each, NaN where nothing is known.
    hits, weights
        Samples per pixel, and the sum of their weights.
    axes, header
        Where it is on the sky; the header for what `SkyAxes` does not know.
    centre
        (longitude, latitude) of its centre, rad.
    pixel, fwhm, smoothed_by
        Side of a pixel, the beam's FWHM and that of the Gaussian applied to the map, rad;
        ``smoothed_by`` 0 for none.
    rms
        What is known of a plane's rms beforehand (maps that were not flat).
    smooth
        Whether it can be smoothed (maps that were flat).
    per_beam
        `MapProduct.seconds_per_beam`.
    difference
        What a `half_difference` is the difference of, in words.
    """

    planes: dict[str, AnyFloats]
    hits: AnyFloats
    weights: AnyFloats
    axes: SkyAxes | None
    header: dict[str, Any]
    centre: tuple[float, float]
    pixel: float
    fwhm: float
    smoothed_by: float = 0.0
    rms: dict[str, float] = field(default_factory=dict)
    smooth: bool = True
    per_beam: AnyFloats | float | None = None
    difference: str = "even minus odd scans"

    def window(self) -> tuple[slice, slice]:
        """Rows and columns where there are samples, with a margin of a hundredth of the longer
        side; all, if they are most.
        """
        edges = []
        for axis, size in enumerate(self.hits.shape):
            used = np.flatnonzero((self.hits > 0).any(axis=1 - axis))
            edges.append((int(used[0]), int(used[-1]) + 1) if used.size else (0, size))
        spare = math.ceil(0.01 * max(high - low for low, high in edges))
        y, x = (
            slice(max(0, a - spare), min(n, b + spare))
            for (a, b), n in zip(edges, self.hits.shape, strict=True)
        )
        whole = (y.stop - y.start) * (x.stop - x.start) >= 0.9 * self.hits.size
        return (slice(0, self.hits.shape[0]), slice(0, self.hits.shape[1])) if whole else (y, x)

    def cropped(self, window: tuple[slice, slice] | None = None) -> FlatMap:
        """The rows and columns of `window`."""
        y, x = window or self.window()
        header = dict(self.header)
        for key, shift in (("CRPIX1", x.start), ("CRPIX2", y.start)):
            header[key] = float(header.get(key, 0.0)) - shift
        each = isinstance(self.per_beam, np.ndarray) and self.per_beam.ndim
        return replace(
            self,
            planes={name: plane[y, x] for name, plane in self.planes.items()},
            hits=self.hits[y, x],
            weights=self.weights[y, x],
            axes=None if self.axes is None else self.axes.shifted(x.start, y.start),
            header=header,
            per_beam=np.asarray(self.per_beam)[y, x] if each else self.per_beam,
        )

    @property
    def sky(self) -> Any:
        """What `plots.plot_map` takes for its ``wcs``."""
        return self.header if self.axes is None else self.axes

    def smoothed(self, fwhm: float) -> FlatMap:
        """As `MapProduct.smoothed`: every plane convolved with a Gaussian of ``fwhm`` [rad],
        weighted, without empty pixels.
        """
        planes = {}
        for name, values in self.planes.items():
            use = np.isfinite(values) & (self.hits > 0)
            weights = np.where(use, self.weights, np.float32(0))
            with np.errstate(invalid="ignore", divide="ignore"):
                total = self._convolve(weights * np.where(use, values, np.float32(0)), fwhm)
                mean = total / self._convolve(weights, fwhm)
            planes[name] = np.where(use, mean, np.float32(np.nan))
        return replace(self, planes=planes, smoothed_by=math.hypot(self.smoothed_by, fwhm))

    def covered(self, least: float) -> NDArray[np.bool_]:
        """Pixels with at least ``least`` of the 99th percentile of the samples, as smoothed as the
        map is: the edge is not ragged then."""
        hits = self.hits
        if self.smooth and self.smoothed_by:
            hits = self._convolve(hits, self.smoothed_by)
        seen = hits[self.hits > 0]
        return np.asarray(hits >= least * np.percentile(seen, 99) if seen.size else self.hits > 0)

    def limit(self, plane: str, hits: AnyFloats, share: float) -> float | None:
        """Brightness scale that covers ``share`` per cent of what ``hits`` cover well: the noisy
        rim must not set it.
        """
        values = self.planes[plane]
        if not hits.any():
            return None
        good = np.abs(
            values[(hits > 0.25 * np.percentile(hits[hits > 0], 99)) & np.isfinite(values)]
        )
        return float(np.percentile(good, share)) if good.size else None

    def central_rms(self, plane: str, radius: float) -> float:
        """Weighted rms about zero within ``radius`` [rad] of the centre; NaN where it is not
        known.
        """
        if plane in self.rms or self.axes is None:
            return self.rms.get(plane, math.nan)
        values = self.planes[plane]
        use = (self.axes.distance(values.shape, self.centre) <= radius) & np.isfinite(values)
        w = self.weights[use].astype(np.float64)
        return (
            math.sqrt((w * values[use].astype(np.float64) ** 2).sum() / w.sum())
            if w.sum() > 0
            else math.nan
        )

    def _convolve(self, values: AnyFloats, fwhm: float) -> AnyFloats:
        """Convolve with a Gaussian of ``fwhm`` [rad], in single precision; of a wide map each pixel
        with its own kernel.
        """
        grid = image_grid(self.header, (values.shape[0], values.shape[1]), self.pixel)
        if not grid.even:
            return grid.smoother(fwhm)(values).astype(np.float32)
        return convolved(
            values, gaussian_taps(fwhm / FWHM_PER_SIGMA / self.pixel).astype(np.float32)
        )
