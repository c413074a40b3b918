"""Radial power spectra and profiles of maps.

With a window w and the Fourier transform m_k of w (m - <m>_w), and pixels of area A,

    P_i = A / sum w^2  mean_i |m_k|^2,   (1)

the mean over the modes of ring i: the power spectral density, so that white noise of standard error
n per pixel has P = n^2 A whatever the window. Its relative standard error is N_i^(-1/2), N_i = n_i
/ (2 c) independent modes as in `transfer_function`, equation (3). The coherence of two maps is Re
sum a b* / (sum |a|^2 sum |b|^2)^(1/2).

The noise of a map that was smoothed with a Gaussian of s is w n g, n its standard error and g of
unit variance with the correlation rho(d) = exp(-d^2 / 4 s^2). With C(d) the autocorrelation of w n,

    <|m_k|^2> = sum_d C(d) rho(d) exp(-i k d),   (2)

what the window spreads from large scales, where there is more, included; without smoothing rho is 1
at d = 0 alone. What is spread so is the same in many modes: rings are not independent, and their
modes are counted from the scatter of draws of (2).

Of Q and U on parallel axes, those of the plane, with phi the angle of k from south to east (COSMO;
Seljak 1997, equation 17),

    E_k = Q_k cos 2 phi + U_k sin 2 phi,   B_k = -Q_k sin 2 phi + U_k cos 2 phi;   (3)

cross spectra are A / sum w^2 mean_i Re a_k b_k*. The window mixes some of E into B on scales near
its own.

Pixels may be oblong, turned or skew: a cell J (2, 2) [rad] holds the steps east and north by one
pixel in x (first column) and in y, A = |det J|, and the wave of f_x, f_y cycles per pixel has the
wavenumbers (k_east, k_north) = J^-T (f_x, f_y). A number in its place is the side of a square pixel
with x to the west and y to the north.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from zonda.core.types import Floats

DRAWS = 48
"""Draws of noise by which modes of smoothed maps are counted: their number is right to 20 %."""


def cell(steps: float | Floats) -> Floats:
    """(2, 2) J of a cell, or of the side of a square pixel."""
    return (
        np.array([[-steps, 0.0], [0.0, steps]])
        if np.ndim(steps) == 0
        else np.asarray(steps, np.float64)
    )


def lengths(steps: float | Floats) -> tuple[float, float]:
    """Lengths of a pixel along y and x, rad."""
    x, y = np.hypot(*cell(steps))
    return float(y), float(x)


def waves(shape: tuple[int, int], steps: float | Floats) -> tuple[Floats, Floats]:
    """(k_north, k_west) [rad^-1] of the modes of `numpy.fft.fft2`, (ny, nx) each. ``steps``: a cell
    or a side.
    """
    j = cell(steps)
    if not j[0, 1] and not j[1, 0]:
        north, west = np.meshgrid(
            np.fft.fftfreq(shape[0], j[1, 1]), np.fft.fftfreq(shape[1], -j[0, 0]), indexing="ij"
        )
        return north, west
    f_y, f_x = np.meshgrid(*(np.fft.fftfreq(n) for n in shape), indexing="ij")
    east, north = np.tensordot(np.linalg.inv(j).T, np.stack([f_x, f_y]), 1)
    return north, -east


def tapered(inside: NDArray[np.bool_], steps: float | Floats, taper: float | None = None) -> Floats:
    """sin^2(pi/2 min(d / taper, 1)), d [rad] the distance of a pixel to the nearest one that is not
    ``inside``, (ny, nx).

    ``steps``: a cell or a side. ``taper`` None: the largest d, so that a disc has cos^2(pi/2 r /
    R).
    """
    from scipy.ndimage import distance_transform_edt

    sides = lengths(steps)
    even = sides[0] == sides[1]
    depth = distance_transform_edt(np.pad(inside, 1), sampling=None if even else sides)[
        1:-1, 1:-1
    ] * (sides[0] if even else 1.0)
    width = depth.max(initial=0.0) if taper is None else taper
    return np.asarray(
        np.sin(np.pi / 2 * np.minimum(depth / max(width, *sides), 1)) ** 2, np.float64
    )


@dataclass(frozen=True)
class RadialSpectra:
    """Power spectra of maps on one grid, equation (1).

    Attributes
    ----------
    edges
        (n + 1,) wavenumbers between the rings, rad^-1 (1 / wavelength), ascending.
    wavenumber
        (n,) mean over each ring's modes; NaN without any.
    power
        (n,) of each map, unit^2 sr.
    modes
        (n,) independent modes.
    white
        (n,) of maps whose noise is known: what independent pixels of that noise have, behind the
        smoothing; NaN without modes.
    coherence
        (n,) of the first two maps; NaN of one map alone.
    draws
        (n_draw, n) powers of drawn noise like that of ``white`` where the maps are smoothed, over
        its mean: how rings scatter together.
    cross
        (n,) cross spectra by name (``map_TE``: of I and E), unit^2 sr; they have signs.
    """

    edges: Floats
    wavenumber: Floats
    power: dict[str, Floats]
    modes: Floats
    white: dict[str, Floats]
    coherence: Floats
    cross: dict[str, Floats] = field(default_factory=dict)
    draws: Floats | None = None

    @property
    def scale(self) -> Floats:
        """(n,) wavelengths, rad; of a ring without modes its middle."""
        middle = np.sqrt(self.edges[1:] * self.edges[:-1])
        return np.asarray(
            1 / np.where(np.isfinite(self.wavenumber), self.wavenumber, middle), np.float64
        )


def ring_edges(shape: tuple[int, int], steps: float | Floats, bins: int) -> Floats:
    """At most (bins + 1,) wavenumbers, from one wave across the map to two of the longer sides of a
    pixel per wave, rad^-1.

    ``steps``: a cell or a side. Their ratio is constant, but rings are at least as wide as the
    modes of the longer side of the map are apart.
    """
    sides = lengths(steps)
    step, highest = (
        1 / max(n * side for n, side in zip(shape, sides, strict=True)),
        0.5 / max(sides),
    )
    edges = [0.75 * step]
    ratio = (highest / edges[0]) ** (1 / bins)
    while edges[-1] < highest * (1 - 1e-9) and len(edges) <= bins:
        edges.append(min(max(edges[-1] * ratio, edges[-1] + step), max(highest, edges[0] + step)))
    return np.array(edges)


def radial_spectra(
    maps: Mapping[str, Floats],
    window: Floats,
    steps: float | Floats,
    edges: Floats,
    noise: Mapping[str, Floats] | None = None,
    smoothing: float = 0.0,
    polarized: Mapping[str, tuple[str, str]] | None = None,
) -> RadialSpectra:
    """Equation (1) of maps (ny, nx); pixels that are NaN in one of them count in none.

    Parameters
    ----------
    window
        (ny, nx).
    steps
        Cell of a pixel, or its side, rad.
    edges
        Between the rings, rad^-1.
    noise
        (ny, nx) standard errors of some of the maps.
    smoothing
        Standard deviation of the Gaussian that the maps were smoothed with, rad; 0: their pixels
        are independent.
    polarized
        Names of Q and U among the maps, by the name NAME of their I: in their place stand NAME_E
        and NAME_B, equation (3), whose noise is the mean of both, and the cross spectra NAME_TE,
        NAME_TB and NAME_EB (T where there is an I).
    """
    known = np.logical_and.reduce([np.isfinite(values) for values in maps.values()])
    window = np.where(known, window, 0.0)
    square = float((window**2).sum())
    area = abs(float(np.linalg.det(cell(steps)))) / square if square else math.nan
    transforms = {}
    for name, values in maps.items():
        kept = np.where(known, values, 0.0)
        mean = float((kept * window).sum() / window.sum()) if square else 0.0
        transforms[name] = np.fft.fft2((kept - mean) * window)
    north, west = waves((window.shape[0], window.shape[1]), steps)
    k = np.hypot(north, west)
    pairs: dict[str, tuple[str, str]] = {}
    for name, (q, u) in (polarized or {}).items():
        q_k, u_k = transforms.pop(q), transforms.pop(u)
        angle = 2 * np.arctan2(west, north)
        cosine, sine = np.cos(angle), np.sin(angle)
        transforms[f"{name}_E"], transforms[f"{name}_B"] = (
            q_k * cosine + u_k * sine,
            u_k * cosine - q_k * sine,
        )
        t, e, b = ({"T": name, "E": f"{name}_E", "B": f"{name}_B"}[letter] for letter in "TEB")
        pairs |= {
            f"{name}_{both}": two
            for both, two in (("TE", (t, e)), ("TB", (t, b)), ("EB", (e, b)))
            if two[0] in transforms
        }
    count, n = len(edges) - 1, np.searchsorted(edges, k, "right") - 1
    ring = np.where((n >= 0) & (n < count), n, count).ravel()

    def summed(values: Floats) -> Floats:
        return np.asarray(np.bincount(ring, values.ravel(), count + 1)[:count], np.float64)

    number = np.bincount(ring, minlength=count + 1)[:count]
    weighed = next((np.where(known, window * n, 0.0) for n in (noise or {}).values()), window)
    total = float((weighed**2).sum())
    correlated = window.size * float((weighed**4).sum()) / total**2 if total else math.inf
    with np.errstate(invalid="ignore", divide="ignore"):
        power = {
            name: area * summed(np.abs(values) ** 2) / number for name, values in transforms.items()
        }
        first, second = (list(transforms.values()) * 2)[:2]
        cross = summed((first * second.conj()).real) / np.sqrt(
            summed(np.abs(first) ** 2) * summed(np.abs(second) ** 2)
        )
        crosses = {
            name: area * summed((transforms[a] * transforms[b].conj()).real) / number
            for name, (a, b) in pairs.items()
        }
        wavenumber = summed(k) / number
        expected = {
            name: _of_noise(np.where(known, window * n, 0.0), steps, smoothing)
            for name, n in (noise or {}).items()
        }
        white = {name: area * summed(values) / number for name, values in expected.items()}
        modes, draws = number / 2 / correlated, None
        if smoothing and white:
            passed = np.exp(-((2 * np.pi * k * smoothing) ** 2) / 2)
            own = next(iter(white.values()))
            draws = np.array(
                [area * summed(found) / number / own for found in _drawn(weighed, passed)]
            )
            modes = np.where(number > 0, 1 / draws.var(axis=0, ddof=1), 0.0)
    for name, (q, u) in (polarized or {}).items():
        if q in white and u in white:
            white[f"{name}_E"] = white[f"{name}_B"] = (white.pop(q) + white.pop(u)) / 2
    if len(maps) < 2:
        cross = np.full(count, math.nan)
    return RadialSpectra(edges, wavenumber, power, modes, white, cross, crosses, draws)


def _drawn(error: Floats, passed: Floats) -> Iterator[Floats]:
    """|m_k|^2 of `DRAWS` draws of noise like equation (2)'s; ``passed``: of the amplitude of each
    mode by the smoothing.
    """
    rng = np.random.default_rng(1)
    passed = passed / math.sqrt(float((passed**2).mean()))
    for _ in range(DRAWS):
        even = np.fft.ifft2(np.fft.fft2(rng.standard_normal(error.shape)) * passed).real
        yield np.abs(np.fft.fft2(error * even)) ** 2


def _of_noise(error: Floats, steps: float | Floats, smoothing: float) -> Floats:
    """Equation (2) for each mode: w n is ``error`` (ny, nx)."""
    if not smoothing:
        return np.full(error.shape, float((error**2).sum()))
    ny, nx = error.shape
    lags = np.stack(
        np.meshgrid(np.fft.fftfreq(nx, 1 / nx), np.fft.fftfreq(ny, 1 / ny))
    )  # x and y, in pixels
    east, north = np.tensordot(cell(steps), lags, 1)
    correlation = np.fft.ifft2(np.abs(np.fft.fft2(error)) ** 2).real
    found = np.fft.fft2(correlation * np.exp(-(east**2 + north**2) / (4 * smoothing**2))).real
    return np.asarray(np.maximum(found, 0.0), np.float64)


@dataclass(frozen=True)
class Profiles:
    """Means in rings about a point.

    Attributes
    ----------
    radius
        (n,) middle of each ring, rad.
    mean, error
        (n,) of each map, its unit; standard errors from the scatter in the ring, of one value per
        beam; NaN where there is no pixel, or no scatter.
    """

    radius: Floats
    mean: dict[str, Floats]
    error: dict[str, Floats]


def profiles(
    maps: Mapping[str, Floats], distance: Floats, areas: Floats, width: float, beam_area: float
) -> Profiles:
    """Mean of each map in rings of ``width`` [rad], over the solid angle: pixels count with their
    ``areas`` [sr].

    ``distance``: of the pixels from the middle of the rings [rad]; all of one shape. ``beam_area``
    [sr]: area in which pixels are not independent.
    """
    known = (
        np.logical_and.reduce([np.isfinite(values) for values in maps.values()])
        & np.isfinite(distance)
        & (areas > 0)
    )
    ring, weight = (distance[known] / width).astype(np.int64), areas[known]
    number, covered = np.bincount(ring), np.bincount(ring, weight)
    independent = np.maximum(np.minimum(number, covered / beam_area if beam_area else np.inf), 1.0)
    mean, error = {}, {}
    for name, values in maps.items():
        with np.errstate(invalid="ignore", divide="ignore"):
            first = np.bincount(ring, weight * values[known]) / covered
            second = np.bincount(ring, weight * (values[known] - first[ring]) ** 2) / covered
            error[name] = np.where(
                independent > 1, np.sqrt(second / np.maximum(independent - 1, 1e-9)), np.nan
            )
        mean[name] = first
    return Profiles(np.asarray((np.arange(len(number)) + 0.5) * width, np.float64), mean, error)
