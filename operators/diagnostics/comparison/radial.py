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
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.numerics.sphere import ARCSEC
from zonda.core.storage.table_files import Column
from zonda.core.types import AnyFloats, Bools, Floats

DRAWS = 48
"""Draws of noise by which modes of smoothed maps are counted: their number is right to 20 %."""


def cell(steps: float | Floats) -> Floats:
    """(2, 2) J of a cell, or of the side of a square pixel."""
    if np.ndim(steps) == 0:
        return np.array([[-steps, 0.0], [0.0, steps]])
    return np.asarray(steps, np.float64)


def lengths(steps: float | Floats) -> Floats:
    """(2,) lengths of a pixel along y and x, rad."""
    return np.asarray(np.hypot(*cell(steps))[::-1], np.float64)


def tapered(inside: Bools, steps: float | Floats, taper: float | None = None) -> Floats:
    """sin^2(pi/2 min(d / taper, 1)), d [rad] the distance of a pixel to the nearest one that is not
    ``inside``, (ny, nx).

    ``steps``: a cell or a side. ``taper`` None: the largest d, so that a disc has cos^2(pi/2 r /
    R).
    """
    from scipy.ndimage import distance_transform_edt

    sides = lengths(steps)
    depth = distance_transform_edt(np.pad(inside, 1), sampling=sides)[1:-1, 1:-1]
    width = depth.max(initial=0.0) if taper is None else taper
    share = np.minimum(depth / max(width, *sides), 1)
    return np.asarray(np.sin(np.pi / 2 * share) ** 2, np.float64)


class Rings:
    """Fourier modes of maps under a window, in rings of wavenumbers k.

    Attributes
    ----------
    window
        (ny, nx), 0 where a map is NaN.
    north, west, k
        (ny, nx) wavenumbers of `numpy.fft.fft2`, rad^-1.
    ring
        (ny nx,) ring of each mode, `count` for those in none.
    number
        (count,) modes of each ring.
    """

    def __init__(self, maps: Any, window: Floats, steps: float | Floats, edges: Floats) -> None:
        known = np.logical_and.reduce([np.isfinite(values) for values in maps])
        self.window = np.where(known, window, 0.0)
        size = window.shape[::-1]
        waves = np.stack(np.meshgrid(*(np.fft.fftfreq(n, 1 / n) for n in size)))  # along x and y
        east, self.north = np.tensordot(np.linalg.inv(cell(steps) * size).T, waves, 1)
        self.west = -east
        self.count = len(edges) - 1
        self.k = np.hypot(self.north, self.west)
        ring = np.searchsorted(edges, self.k, "right") - 1
        self.ring = np.where((ring >= 0) & (ring < self.count), ring, self.count).ravel()
        self.number = self.sum(np.ones(window.shape))

    def transform(self, values: Floats) -> NDArray[np.complex128]:
        """Fourier transform of w (m - <m>_w)."""
        w = self.window
        m = np.where(self.window != 0, values, 0.0)
        mean = (m * w).sum() / w.sum() if w.any() else 0.0
        return np.asarray(np.fft.fft2((m - mean) * w), np.complex128)

    def sum(self, values: AnyFloats) -> Floats:
        """(count,) sums over the modes of each ring."""
        return np.asarray(np.bincount(self.ring, values.ravel(), self.count + 1)[: self.count])

    def mean_wavenumber(self) -> Floats:
        """(count,) rad^-1; NaN without modes."""
        with np.errstate(invalid="ignore"):
            return self.sum(self.k) / self.number


def correlation(window: Floats) -> float:
    """Number c of modes that share what one holds: n_pixels sum w^4 / (sum w^2)^2."""
    total = float((window**2).sum())
    return window.size * float((window**4).sum()) / total**2 if total else math.inf


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
        return scale_of(self.wavenumber, self.edges)

    def columns(self, unit: str, coherence: bool = False) -> list[Column]:
        """The table, largest scale first; ``unit``: of the maps, as FITS has it."""
        square = f"{unit}2 sr" if unit else "sr"
        plain = {name: name.replace("/", "_") for name in (*self.power, *self.cross)}
        white = "of white noise with the map's standard errors"
        modes = "independent modes; relative standard error of the power: modes^-1/2"
        both = "Re sum a b* / sqrt(sum |a|^2 sum |b|^2), a the reference, b the map"
        return [
            Column("scale", self.scale / ARCSEC, "arcsec", "1 / mean wavenumber of the ring"),
            Column("wavenumber", 1 / self.scale, "rad-1", "mean over the ring's modes"),
            *(Column(plain[n], p, square, "power spectral density") for n, p in self.power.items()),
            *(Column(f"{plain[n]}_white", p, square, white) for n, p in self.white.items()),
            *(
                Column(plain[n], p, square, "cross power spectral density")
                for n, p in self.cross.items()
            ),
            *([Column("coherence", self.coherence, "", both)] if coherence else []),
            Column("modes", self.modes, "", modes),
        ]


def scale_of(wavenumber: Floats, edges: Floats) -> Floats:
    """(n,) angular scales 1/k, rad; in a ring without modes its middle."""
    middle = np.sqrt(edges[1:] * edges[:-1])
    return 1 / np.where(np.isfinite(wavenumber), wavenumber, middle)


def ring_edges(shape: tuple[int, int], steps: float | Floats, bins: int) -> Floats:
    """At most (bins + 1,) wavenumbers, from one wave across the map to two of the longer sides of a
    pixel per wave, rad^-1.

    ``steps``: a cell or a side. Their ratio is constant, but rings are at least as wide as the
    modes of the longer side of the map are apart.
    """
    sides = lengths(steps)
    step = 1 / float((sides * shape).max())
    highest = 0.5 / float(sides.max())
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
    rings = Rings(maps.values(), window, steps, edges)
    polarized = polarized or {}
    w = rings.window
    square = float((w**2).sum())
    area = abs(float(np.linalg.det(cell(steps)))) / square if square else math.nan
    waves = {name: rings.transform(values) for name, values in maps.items()}
    pairs: dict[str, tuple[str, str]] = {}
    angle = 2 * np.arctan2(rings.west, rings.north)
    cosine = np.cos(angle)
    sine = np.sin(angle)
    for name, (q, u) in polarized.items():
        q_k = waves.pop(q)
        u_k = waves.pop(u)
        waves[f"{name}_E"] = q_k * cosine + u_k * sine
        waves[f"{name}_B"] = u_k * cosine - q_k * sine
        letters = {"T": name, "E": f"{name}_E", "B": f"{name}_B"}
        for both in ("TE", "TB", "EB"):
            if letters[both[0]] in waves:
                pairs[f"{name}_{both}"] = letters[both[0]], letters[both[1]]
    errors = [np.where(w != 0, w * n, 0.0) for n in (noise or {}).values()]
    weighed = errors[0] if errors else w

    def mean(values: Floats) -> Floats:
        return area * rings.sum(values) / rings.number

    with np.errstate(invalid="ignore", divide="ignore"):
        power = {name: mean(np.abs(values) ** 2) for name, values in waves.items()}
        cross = {n: mean((waves[a] * waves[b].conj()).real) for n, (a, b) in pairs.items()}
        coherence = np.full(rings.count, math.nan)
        if len(maps) > 1:
            (a, p), (b, q_) = [(waves[name], power[name]) for name in list(waves)[:2]]
            coherence = mean((a * b.conj()).real) / np.sqrt(p * q_)
        white = {
            name: mean(_of_noise(error, steps, smoothing))
            for name, error in zip(noise or {}, errors, strict=True)
        }
        modes = rings.number / 2 / correlation(weighed)
        draws = None
        if smoothing and white:
            passed = np.exp(-((2 * np.pi * rings.k * smoothing) ** 2) / 2)
            own = next(iter(white.values()))
            rng = np.random.default_rng(1)
            passed /= math.sqrt(float((passed**2).mean()))
            drawn = []
            for _ in range(DRAWS):  # noise like equation (2)'s
                even = np.fft.ifft2(np.fft.fft2(rng.standard_normal(w.shape)) * passed).real
                drawn.append(mean(np.abs(np.fft.fft2(weighed * even)) ** 2) / own)
            draws = np.array(drawn)
            modes = np.where(rings.number > 0, 1 / draws.var(axis=0, ddof=1), 0.0)
    for name, (q, u) in polarized.items():
        if q in white and u in white:
            white[f"{name}_E"] = white[f"{name}_B"] = (white.pop(q) + white.pop(u)) / 2
    k = rings.mean_wavenumber()
    return RadialSpectra(edges, k, power, modes, white, coherence, cross, draws)


def _of_noise(error: Floats, steps: float | Floats, smoothing: float) -> Floats:
    """Equation (2) for each mode: w n is ``error`` (ny, nx)."""
    if not smoothing:
        return np.full(error.shape, float((error**2).sum()))
    lags = np.meshgrid(*(np.fft.fftfreq(n, 1 / n) for n in error.shape[::-1]))  # x, y in pixels
    away = (np.tensordot(cell(steps), np.stack(lags), 1) ** 2).sum(axis=0)
    found = np.fft.ifft2(np.abs(np.fft.fft2(error)) ** 2).real
    found = np.fft.fft2(found * np.exp(-away / (4 * smoothing**2))).real
    return np.maximum(found, 0.0)


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
    maps: Mapping[str, Floats],
    distance: Floats,
    areas: Floats,
    width: float,
    beam_area: float,
) -> Profiles:
    """Mean of each map in rings of ``width`` [rad], over the solid angle: pixels count with their
    ``areas`` [sr].

    ``distance``: of the pixels from the middle of the rings [rad]; all of one shape. ``beam_area``
    [sr]: area in which pixels are not independent.
    """
    finite = [np.isfinite(values) for values in (*maps.values(), distance)]
    known = np.logical_and.reduce([*finite, areas > 0])
    ring = (distance[known] / width).astype(np.int64)
    weight = areas[known]
    number = np.bincount(ring)
    covered = np.bincount(ring, weight)
    independent = np.maximum(np.minimum(number, covered / beam_area if beam_area else np.inf), 1.0)
    mean = {}
    error = {}
    for name, values in maps.items():
        with np.errstate(invalid="ignore", divide="ignore"):
            first = np.bincount(ring, weight * values[known]) / covered
            second = np.bincount(ring, weight * (values[known] - first[ring]) ** 2) / covered
            error[name] = np.where(
                independent > 1,
                np.sqrt(second / np.maximum(independent - 1, 1e-9)),
                np.nan,
            )
        mean[name] = first
    return Profiles(np.asarray((np.arange(len(number)) + 0.5) * width, np.float64), mean, error)
