"""Convolving an image with a Gaussian beam, ready for sampling.

The image is a brightness T_j at the pixel centres r_j, each standing for its pixel's area A:

    (T * B)(r) = sum_j A T_j B(r - r_j)                                                          (1)

with B of unit integral. Equation (1) is evaluated on a grid of step (pixel / q), q >= 1, such that
the FWHM has at least `PIXELS_PER_FWHM` steps (or as many as asked for): the image is set on every
q-th point and multiplied in Fourier space by the analytic transform of B,

    exp(-2 pi^2 k C k),   C = sigma^2 (J^T J)^-1,
    sigma = FWHM / sqrt(8 ln 2)                                 (2)

with J [rad per pixel] the linear map from pixels to the tangent plane, so rotated, skewed and
oblong pixels are right. A single bright pixel comes out as an exact Gaussian of the FWHM, a uniform
image ripples by 4 exp(-2 pi^2 (sigma / pixel)^2): 3e-6 at 2 pixels per FWHM. J is constant here:
images for which it is not are gridded (`gridding`).

Along an axis with fewer the image is taken as smooth instead (`Convolved.coarse`): the cubic spline
through its pixels, with the transform

    sinc^4(k) / sum_m sinc^4(k + m)   (k in cycles per pixel)                                    (3)

is convolved with B and taken at the pixel centres again (q = 1), which folds the product of (2) and
(3) over k + m. Nothing is ever deconvolved: what smoothing the pixels of the input carry stays.

Beyond its edge the image has the value `outside`; the grid reaches `REACH` sigma further, where the
beam has left the image.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len

from zonda.core.errors import InputError
from zonda.core.types import AnyFloats, Bools, Floats, Integers

PIXELS_PER_FWHM = 4.0
SMOOTH_BELOW = 2.0 - 1e-9
"""Pixels per FWHM below which the image is taken as smooth."""
FOLDS = (-3, -2, -1, 0, 1, 2, 3)
REACH = 6.0
SPLINE_MARGIN = 4
"""Grid points beyond the reach, for the 4 x 4 coefficients of the last sample."""
SIGMA = 1.0 / np.sqrt(8.0 * np.log(2.0))
TINY = 1e-16
"""Coefficients smaller than this share of the largest are set to zero: they are rounding of the
transform, and as float32 denormals they would slow the sampling. A sample is a mean of 16
coefficients, so it changes by no more of the image's peak."""


@dataclass(frozen=True)
class Convolved:
    """Cubic B-spline coefficients of a convolved image.

    Attributes
    ----------
    coefficients
        Of the values minus ``outside``, by type name (``float32``, ``float64``), each (ny, nx) in C
        order; the values between which is interpolated where that is linear.
    to_grid
        (3, 3): homogeneous input pixel (0-based) to homogeneous grid point.
    bounds
        (4,) x_low, x_high, y_low, y_high of the input image on the grid.
    steps
        (qx, qy) grid steps per input pixel.
    coarse
        True where an axis has fewer than `SMOOTH_BELOW` pixels per FWHM.
    """

    coefficients: dict[str, AnyFloats]
    to_grid: Floats
    bounds: Floats
    steps: tuple[int, int] = (1, 1)
    coarse: bool = False

    @classmethod
    def of(cls, grid: Floats, *described: Any) -> Convolved:
        """``grid``: the coefficients; ``described``: the other attributes."""
        size = np.abs(grid)
        grid[size < TINY * size.max(initial=0.0)] = 0.0
        return cls({"float64": grid, "float32": grid.astype(np.float32)}, *described)

    @property
    def nbytes(self) -> int:
        return sum(values.nbytes for values in self.coefficients.values())

    def covered(self, mask: Bools) -> NDArray[np.uint8]:
        """A mask of the input's pixels on the grid; (0, 0) where it is."""
        if not mask.size:
            return np.zeros((0, 0), np.uint8)
        whole = np.zeros(self.coefficients["float64"].shape, np.uint8)
        ny = len(whole)
        nx = len(whole.T)
        y = np.floor((np.arange(ny) - self.bounds[2]) / self.steps[1]).astype(int)
        x = np.floor((np.arange(nx) - self.bounds[0]) / self.steps[0]).astype(int)
        in_y = (y >= 0) & (y < mask.shape[0])
        in_x = (x >= 0) & (x < mask.shape[1])
        whole[np.ix_(in_y, in_x)] = mask[np.ix_(y[in_y], x[in_x])]
        return whole


def convolve(
    values: Floats,
    jacobian: Floats,
    fwhm: float,
    outside: float,
    pixels_per_fwhm: float = PIXELS_PER_FWHM,
    linear: bool = False,
) -> Convolved:
    """Equations (1) and (2) for ``values`` (ny, nx), ``jacobian`` J (2, 2) [rad per pixel] and
    ``fwhm`` [rad]; 0: no beam.

    ``linear``: for linear interpolation, whose mean response sinc^2(k h) along each axis is divided
    out (`sampling`).
    """
    covariance, _, across = _in_pixels(jacobian, fwhm)
    (qx, qy), (pad_x, pad_y), (ny, nx) = margins(values.shape, jacobian, fwhm, pixels_per_fwhm)
    rows, columns = values.shape
    grid = np.zeros((ny, nx))
    grid[pad_y : pad_y + rows * qy : qy, pad_x : pad_x + columns * qx : qx] = (values - outside) * (
        qx * qy
    )
    if fwhm > 0:
        # cycles per input pixel
        kx = np.float64(qx) * np.fft.rfftfreq(nx)
        ky = np.float64(qy) * np.fft.fftfreq(ny)[:, None]
        transfer = _transfer(covariance, kx, ky, across < SMOOTH_BELOW)
        along = [np.sinc(k) ** 2 if linear else _at_knots(k) for k in (kx / qx, ky / qy)]
        transfer /= along[0] * along[1]
        grid = np.fft.irfft2(np.fft.rfft2(grid) * transfer, (ny, nx))
    elif not linear:
        grid = _spline(_spline(grid, 0), 1)
    to_grid = np.array([[qx, 0.0, pad_x], [0.0, qy, pad_y], [0.0, 0.0, 1.0]])
    x = (pad_x - qx / 2, pad_x + (columns - 0.5) * qx)
    y = (pad_y - qy / 2, pad_y + (rows - 0.5) * qy)
    coarse = bool((across < SMOOTH_BELOW).any())
    return Convolved.of(grid, to_grid, np.array([*x, *y]), (qx, qy), coarse)


def _in_pixels(jacobian: Floats, fwhm: float) -> tuple[Floats, Floats, Floats]:
    """Covariance of the beam [pixel^2], and sigma [pixels] and pixels per FWHM along (x, y)."""
    covariance = (SIGMA * fwhm) ** 2 * np.linalg.inv(jacobian.T @ jacobian)
    return covariance, np.sqrt(np.diag(covariance)), fwhm / np.linalg.norm(jacobian, axis=0)


def margins(
    shape: tuple[int, ...],
    jacobian: Floats,
    fwhm: float,
    pixels_per_fwhm: float,
) -> tuple[tuple[int, int], tuple[int, int], tuple[int, int]]:
    """Steps per pixel and margins along (x, y), and the shape (ny, nx), of the grid on which
    `convolve` works. Raises InputError for one that does not fit in the memory.
    """
    _, width, across = _in_pixels(jacobian, fwhm)
    qx, qy = (
        int(np.ceil(pixels_per_fwhm / a - 1e-9)) if SMOOTH_BELOW <= a < pixels_per_fwhm else 1
        for a in across
    )
    _check_size(shape, width, across, (qx, qy))
    pad_x, pad_y = (
        int(np.ceil(REACH * width[k] * q)) + SPLINE_MARGIN + q for k, q in ((0, qx), (1, qy))
    )
    sides = shape[0] * qy + 2 * pad_y, shape[1] * qx + 2 * pad_x
    ny, nx = (next_fast_len(n, True) for n in sides)
    return (qx, qy), (pad_x, pad_y), (ny, nx)


def _at_knots(frequency: Floats) -> Floats:
    """Fourier transform of (1, 4, 1) / 6, the cubic B-spline at its knots; cycles per knot."""
    return (2 + np.cos(2 * np.pi * frequency)) / 3


def _spline(values: Floats, axis: int) -> Floats:
    """Cubic B-spline coefficients of values (ny, nx) along an axis, mirrored about both ends:
    (c_(k-1) + 4 c_k + c_(k+1)) / 6 = v_k is a division in the transform.
    """
    rows = np.moveaxis(values, axis, -1)
    n = rows.shape[-1]
    period = 2 * rows.shape[-1] - 2
    transform = np.fft.rfft(np.concatenate([rows, rows[..., -2:0:-1]], axis=-1))
    found = np.fft.irfft(transform / _at_knots(np.arange(n) / period), period)
    return np.moveaxis(found[..., :n], -1, axis)


def convolve_evenly(
    values: Floats,
    step: float,
    variance: float,
    outside: float,
    linear: bool = False,
) -> Convolved:
    """``values`` (ny, nx) on a grid of ``step`` [rad], convolved with a Gaussian of ``variance``
    [rad^2] of either axis.

    They fade out towards the edges. What interpolation between points takes from a wave is divided
    out: sinc^4(k h) of cubic B-splines and sinc^2(k h) of lines; what is left are its images, half
    of which are at the points and half between them.
    """
    rows, columns = values.shape
    ny = next_fast_len(rows, True)
    nx = next_fast_len(columns, True)
    kx, ky = np.fft.rfftfreq(nx), np.fft.fftfreq(ny)[:, None]  # cycles per step
    transfer = np.exp(-2 * np.pi**2 * variance / step**2 * (kx**2 + ky**2))
    transfer /= np.sinc(kx) ** (2 if linear else 4) * np.sinc(ky) ** (2 if linear else 4)
    grid = np.fft.irfft2(np.fft.rfft2(values - outside, (ny, nx)) * transfer, (ny, nx))
    bounds = np.array([-0.5, columns - 0.5, -0.5, rows - 0.5])
    return Convolved.of(grid, np.eye(3), bounds)


def _check_size(
    shape: tuple[int, ...],
    width: Floats,
    across: Floats,
    steps: tuple[int, int],
) -> None:
    """Refuse a map whose margins, a beam wide, do not fit the memory: pixels far smaller than the
    beam (`InputError`).
    """
    from zonda.core.machine import available_memory

    cells = np.prod((np.array(shape[::-1]) + 2 * REACH * width) * steps)
    # the grid, its transform, the beam's transform, and one on the way
    needed = 4 * 8 * float(cells)
    free = available_memory()
    if not needed <= free:
        raise InputError(
            f"convolving the map with the beam needs {needed / 1e9:.3g} GB, {free / 1e9:.3g}"
            f" GB are free: a beam is {np.max(across):.3g} of its pixels wide",
            place="sky map",
            cure="check the map's pixel size, or rebin it to some ten pixels per FWHM",
        )


def _transfer(covariance: Floats, kx: Floats, ky: Floats, smooth: Bools) -> Floats:
    """Equation (2) at frequencies ``kx``, ``ky`` [cycles per pixel]; folded with (3) along the axes
    that are ``smooth``.
    """
    total = np.zeros(np.broadcast_shapes(kx.shape, ky.shape))
    folds_x, folds_y = (FOLDS if s else (0,) for s in smooth)
    for m in folds_x:
        weight_x = _spline_transform(kx, m) if smooth[0] else 1.0
        for n in folds_y:
            weight_y = _spline_transform(ky, n) if smooth[1] else 1.0
            x = kx + m
            y = ky + n
            exponent = (
                covariance[0, 0] * x**2 + 2 * covariance[0, 1] * x * y + covariance[1, 1] * y**2
            )
            total += weight_x * weight_y * np.exp(-2 * np.pi**2 * exponent)
    return total


def _spline_transform(k: Floats, m: int) -> Floats:
    """Equation (3) at k + m for k in -1/2 .. 1/2."""
    return np.sinc(k + m) ** 4 / sum(np.sinc(k + n) ** 4 for n in FOLDS)


def distinct(fwhm: Floats, tolerance: float = 1e-3) -> tuple[Floats, Integers]:
    """Beams that serve all detectors: (values, index of each detector's value).

    Equal widths share one; widths that differ by less than ``tolerance`` share their mean.
    """
    order = np.argsort(fwhm, kind="stable")
    rising = fwhm[order]
    index = np.empty(len(fwhm), np.int64)
    values: list[float] = []
    start = 0
    while start < len(fwhm):
        stop = int(np.searchsorted(rising, rising[start] * (1.0 + tolerance), side="right"))
        group = rising[start:stop]
        index[order[start:stop]] = len(values)
        values.append(float(group[0] if group[0] == group[-1] else group.mean()))
        start = stop
    return np.array(values), index
