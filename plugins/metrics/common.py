"""Access to the products of a run that several metrics need."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np

from zonda.core.data import Data
from zonda.core.errors import InputError, PipelineError
from zonda.core.maps.grid import ImagePixels, wcs_grid
from zonda.core.maps.image import Image
from zonda.core.maps.map_product import MapProduct
from zonda.core.maps.smoothing import smoothed, smoother
from zonda.core.numerics.sphere import FWHM_PER_SIGMA
from zonda.core.signal import Signal, product_name, stream_of
from zonda.core.types import Bools, Floats

COVERED = 0.1
"""Share of the 99th percentile of the hits from which a pixel counts as covered."""


def sky_alone(modes: str) -> tuple[Signal, Signal]:
    """Signals of the sky alone with filters and without, with its own singular modes (``sky``) or
    those of the complete data (``full``).
    """
    more: Any = {} if modes == "sky" else {"modes": "full"}
    return Signal(only=["sky"], **more), Signal(only=["sky"], filters="none", **more)


Kind = TypeVar("Kind")


def product_of(data: Data, name: str, kind: type[Kind], metric: str, what: str) -> Kind:
    """The product of that kind and name; else an InputError about ``metric`` that lists those that
    there are. ``what``: the kind in words and its step, ``spectrum, PowerSpectrum``.
    """
    found = data.products.get(name)
    if isinstance(found, kind):
        return found
    words, _, step = what.partition(", ")
    there = ", ".join(sorted(key for key, p in data.products.items() if isinstance(p, kind)))
    raise InputError(
        f"there is no {words} {name!r}",
        place=metric,
        cure=f"those of this run: {there or f'none; add a {step}'}",
    )


def map_of(data: Data, metric: str, signal: str = "", name: str = "map") -> MapProduct:
    """The map ``name`` of a signal (empty: the complete one); else an InputError about
    ``metric``.
    """
    wanted = product_name(stream_of(signal), name)
    product = product_of(data, wanted, MapProduct, metric, "map, BinMap")
    needs_signal({name: product.contents}, metric, name)
    return product


def needs_signal(kinds: Mapping[str, str], metric: str, name: str) -> None:
    """InputError about ``metric`` where the map ``name`` will count samples alone. ``kinds``: as in
    `FigureMetric.look`.
    """
    if kinds.get(name) == "hits":
        raise InputError(
            f"the map {name!r} counts samples and has no signal",
            place=metric,
            cure="leave contents: hits out",
        )


def at_beam(product: MapProduct, fwhm: float | None = None) -> MapProduct:
    """A map smoothed with its beam, or with ``fwhm`` [rad] where that is given; one that was
    smoothed when it was made stays.
    """
    width = product.fwhm if fwhm is None else fwhm
    return product if product.smoothed_by or not width else product.smoothed(width)


def covered(product: MapProduct) -> Bools:
    """Pixels that have a value and at least `COVERED` of the usual samples."""
    seen = product.hits[product.known]
    least = COVERED * float(np.percentile(seen, 99)) if seen.size else 1.0
    return np.isfinite(product.signal) & (product.hits >= max(least, 1e-9))


def as_seen(image: Image, product: MapProduct, fwhm: float | None = None) -> Floats:
    """The input map, the mean under a Gaussian (``fwhm`` [rad]; the beam), at the centres of the
    map's pixels; 0 beside it.
    """
    from scipy.ndimage import map_coordinates

    own = wcs_grid(image.wcs, (image.values.shape[0], image.values.shape[1]))
    width = product.fwhm if fwhm is None else fwhm
    smooth, _ = smoothed(
        own,
        np.nan_to_num(image.values),
        math.sqrt(max(width**2 - image.fwhm**2, 0.0)),
    )
    grid = product.grid
    x, y = own.coordinates(grid.directions() @ grid.turn @ own.turn.T)  # either may be galactic
    at = np.where(np.isfinite(x) & np.isfinite(y), [y, x], -2.0)
    return map_coordinates(np.nan_to_num(smooth), at, order=3)


def extreme(values: Floats, where: Bools, metric: str) -> tuple[int, float]:
    """(flat index, value) of the largest absolute value; InputError about ``metric`` where there is
    none.
    """
    if not where.any():
        cure = "map a larger field, or choose a larger radius"
        raise InputError("no pixel has enough samples", place=metric, cure=cure)
    index = int(np.argmax(np.where(where, abs(values), -1.0)))
    return index, float(values.flat[index])


def relative_error_of_rms(product: MapProduct, where: Bools) -> float:
    """Standard error of a weighted rms over pixels, relative, of white noise behind the smoothing
    of the map:

        (2 N)^(-1/2),   N = (sum w)^2 / sum_ij w_i w_j rho_ij^2,   rho = exp(-d^2 / 4 sigma^2)

    sigma that of the smoothing, d the angle between pixels. HEALPix: N is the area divided by 2 pi
    sigma^2. NaN without pixels.
    """
    w = np.where(where & np.isfinite(product.signal), product.weights, 0.0)
    if not w.any():
        return math.nan
    cell = 2 * math.pi * (product.smoothed_by / FWHM_PER_SIGMA) ** 2
    grid = product.grid
    if not isinstance(grid, ImagePixels):
        count = float(np.count_nonzero(w))
        return 1 / math.sqrt(2 * min(grid.solid_angle(w != 0) / cell if cell else np.inf, count))
    rows, columns = (np.flatnonzero(w.any(axis=axis)) for axis in (1, 0))
    window = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
    w = w[window]
    grid = grid.window(*window)
    near = w  # the pixel alone
    if cell > float(np.nanmin(grid.areas)):
        near = smoother(grid, product.smoothed_by)(w) * cell / grid.areas
    return 1 / math.sqrt(2 * float(w.sum()) ** 2 / float((w * near).sum()))


def needs_tan(kind: str, metric: str) -> None:
    """PipelineError about ``metric`` for a map that is not TAN."""
    if kind != "TAN":
        raise PipelineError(
            f"{metric} needs a TAN map",
            place=metric,
            cure="leave BinMap.nside and projection out",
        )


def input_of(data: Data, metric: str) -> Image:
    """The input map that a `SkyMap` kept; InputError about ``metric`` where there is none."""
    image = next((p for p in data.products.values() if isinstance(p, Image)), None)
    if image is None:
        raise InputError("no step kept the input map", place=metric, cure="use a SkyMap")
    return image
