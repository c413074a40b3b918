"""Noise of a scan in maximum-likelihood maps: white noise of each detector, baselines with a
spectrum of their own, and modes that detectors share.

In units of each detector's white level, with g = sigma^2 / L the white variance of a baseline,

    N / sigma^2 = 1 + B C B^T + infinity u u^T,                                              (1)
    C(f) + 1 = D(f) + sum_k E_k(f) q_k q_k^T,   D >= 1                                      (2)

in which B spreads baselines over samples, and the free modes u (the first of the q_k) have no
weight at any frequency, within baselines too. D and the spectra E_k of the modes are means over
bins of frequency of the residual baselines' powers, D over the share that a map leaves of it. The
inverse of (2) is

    1 / D (1 - sum_k h_k q_k q_k^T),   h_k = E_k / (D + E_k), 1 for a free mode.            (3)

Q_b = Z g^(-1/2) (3) g^(-1/2) Z; Z takes a polynomial of each detector's scan off, fitted to the
baselines that have samples; powers are those per such baseline. Any Q_b >= 0 that does not
depend on the data makes an unbiased map; that of the noise itself makes the one of least noise.

`of_scene` takes the noise from closed forms of the scene: what detectors share has the spectra
S_de(f) = sum_w P_w(f) v_d v_e of waves w across the focal plane (`ClosedForm.across`), v
the cosine and the sine of a wave over the white level of a detector, and the part of pink noise
that all have in common. In equation (2) then

    E_k(f) = q_k^T S q_k,   D(f) = 1 + pink noise of its own + (tr S - sum_k E_k) / (n - k).

q_1 is what all see alike (or each wafer), the mean emission of the atmosphere too; the others are
the leading eigenvectors of S below `SLOW` beside it. The two ends of a scan of T seconds do not
meet: this step of variance 2 int P df adds 4 int P df / T / (2 pi f)^2 to each spectrum P. The
average over the samples of a baseline is neglected: it matters only where white noise is larger.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from zonda.core.data import Observation
from zonda.core.errors import PipelineError
from zonda.core.kernels import kernel
from zonda.core.numerics.random import Key, normals
from zonda.core.observation import ClosedForm
from zonda.core.types import Floats

from .shared_modes import NOWHERE, leading_of, members, orthonormal

BINS = 40
"""Bins of frequency, equal in its logarithm."""
LOWEST = 3
"""Frequencies of the first bin above zero."""
SLOW = 1.0
"""Modes are those of baselines below this frequency, Hz."""
FEWEST = 8
"""Frequencies that modes are found in at least."""
POOLED = np.ones(9)
"""Weights with which neighbouring bins are added up for the share that a map leaves."""
FILLS = 40
"""Steps of the fit that fills baselines: what is left falls by the share of them that lack."""
LEAST_LEFT = 0.1
"""Smallest share of a detector's white noise beside the modes from which its level is corrected."""
WAVES, ANGLES = 60, 12
"""Wave numbers across the focal plane, and directions of half a turn, isotropic in the mean."""
EVEN = 1e-5
"""Phase across the focal plane below which detectors see a wave alike: the gradients of longer
waves have 1e-10 of their power, which is up to 1e9 times that of white noise."""


@dataclass(frozen=True)
class BaselineNoise:
    """Equations (1) to (3) for the good detectors of a scan.

    Attributes
    ----------
    white
        (n_det,) variance of a sample, K^2.
    length
        Samples of a baseline.
    lines
        (n, n_base) orthonormal polynomials that Z takes off.
    modes
        (k, n_det) q_k, orthonormal; the first ``free`` have no weight.
    values
        (k,) mean power of the modes below `SLOW` Hz, in units of the white level.
    frequency
        (n_bins,) Hz.
    own, shared
        (n_bins,) D and (n_bins, k) E_k.
    least
        (n_bins,) power of baselines without the modes, in units of white noise: D, but for its
        limit.
    fast
        (n_det,) power of each detector's baselines without the modes, in units of white noise, in
        the upper half of the frequencies.
    freedom
        (n_bins,) degrees of freedom of ``least``; 0 at the lowest frequencies, of which ``lines``
        take a part.
    edges
        (n_bins + 1,) first frequency of each bin, and the end.
    groups
        (n_det,) number of the group with which each detector has modes in common: of a wafer, or 0.
    places
        (2, n_det) of the detectors in the focal plane, rad; (2, 0) where they are not known.
    kept
        (k,) true for modes that later estimates keep: the free ones, and gradients.
    """

    white: Floats
    length: int
    lines: Floats
    modes: Floats
    free: int
    values: Floats
    frequency: Floats
    edges: NDArray[np.intp]
    own: Floats
    shared: Floats
    least: Floats
    fast: Floats
    freedom: Floats
    groups: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))
    places: Floats = field(default_factory=lambda: NOWHERE)
    kept: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))

    @property
    def free_modes(self) -> Floats:
        """(free, n_det) u / sigma, 1 / K: what makes streams of free modes."""
        return np.ascontiguousarray(self.modes[: self.free] / np.sqrt(self.white))

    def of_some(self, rows: slice) -> BaselineNoise:
        """The noise of some of the detectors."""
        return replace(
            self,
            white=self.white[rows],
            modes=self.modes[:, rows],
            fast=self.fast[rows],
            groups=self.groups[rows],
            places=self.places[:, rows],
        )

    def draw(self, n_base: int, key: Key) -> Floats:
        """Draw of the noise of baselines beside white noise (n_det, n_base), K: the detectors' own,
        and modes that are not free. ``key``: of the random numbers.
        """
        n_det, bins = len(self.white), np.repeat(np.arange(len(self.own)), np.diff(self.edges))
        own = normals(key, 0, n_det * n_base, n_det).reshape(n_det, n_base).astype(np.float64)
        found = fft.rfft(own, axis=1) * np.sqrt(self.own[bins] - 1)
        for k in range(self.free, len(self.modes)):
            shared = fft.rfft(normals(key, 0, n_base, n_det + 1 + k).astype(np.float64))
            found += self.modes[k][:, None] * (np.sqrt(self.shared[bins, k]) * shared)
        g = np.sqrt(self.white / self.length)[:, None]
        return np.asarray(g * fft.irfft(found, n_base, axis=1))

    def weigh(self, y: Floats, counted: NDArray[np.int32]) -> Floats:
        """Q_b y of baselines (n_det, n_base), of which so many samples are ``counted``."""
        g = np.sqrt(self.white / self.length)[:, None]
        z = y / g
        take_lines(z, self.lines, counted)
        found = fft.rfft(z, axis=1, overwrite_x=True)
        bins = np.repeat(np.arange(len(self.own)), np.diff(self.edges))
        share = self.shared / (self.own[:, None] + self.shared)
        share[:, : self.free] = 1.0
        _weigh(found, 1 / self.own[bins], np.ascontiguousarray(share[bins].T), self.modes)
        z = fft.irfft(found, y.shape[1], axis=1, overwrite_x=True)
        take_lines(z, self.lines, counted)
        z /= g
        return np.asarray(z)


def estimate(
    residual: Floats,
    counted: NDArray[np.int32],
    white: Floats,
    length: int,
    rate: float,
    *,
    modes: int,
    free: int,
    trend: int,
    fixed: Floats | None = None,
    lacking: NDArray[np.bool_] | None = None,
    groups: NDArray[np.intp] | None = None,
    places: Floats = NOWHERE,
    remains: Floats | None = None,
) -> BaselineNoise:
    """Estimate the noise from baselines without a source, (n_det, n_base) [K].

    Parameters
    ----------
    counted
        (n_det, n_base) samples that each is the mean of.
    white
        (n_det,) variance of a sample, K^2.
    length, rate
        Samples of a baseline; samples per second.
    modes, free
        Modes that detectors of a group share, and how many of these have no weight.
    trend
        Degree of the polynomials of each detector's scan.
    fixed
        (k, n_det) modes that are known.
    lacking
        (n_det, n_base) baselines that were `filled`: they have no noise of their own.
    groups
        (n_det,) see `BaselineNoise`; None: all detectors are one.
    places
        (2, n_det) see `BaselineNoise`.
    remains
        (n_bins,) share of the detectors' own power that is in the residual; None: all.
    """
    n_det, n_base = residual.shape
    seen_of_each = np.count_nonzero(counted, axis=1)[:, None]
    lines = polynomials(n_base, trend)
    powers = _spectra(residual, counted, white / length, lines)
    has = np.ones(n_det)
    if lacking is not None:
        has -= np.count_nonzero(lacking, axis=1) / np.maximum(seen_of_each[:, 0], 1)
    top = min(max(int(SLOW * length / rate * n_base), FEWEST), powers.shape[1])
    slow = np.concatenate([powers[:, 1:top].real, powers[:, 1:top].imag], axis=1)
    n_seen = int(np.count_nonzero(seen_of_each))
    groups = np.zeros(n_det, np.intp) if groups is None else groups
    seen_in = [int(np.count_nonzero(seen_of_each[at])) for at in members(groups)]
    known = np.zeros((0, n_det)) if fixed is None else fixed
    numbers = [max(min(modes, n - 1), 0) for n in seen_in]
    alike = np.where(seen_of_each[:, 0] > 0, 1 / np.sqrt(white), 0.0)
    found, kept = leading_of(groups, slow, numbers, known, places, free, alike)
    free, modes = sum(max(min(free, modes, n - 1), 0) for n in seen_in), len(found)
    seen = np.einsum("kd,dt->kt", found, slow)
    values = np.einsum("kt,kt->k", seen, seen) / max(top - 1, 1)
    edges = bins_of(powers.shape[1])
    own_share = float(has[seen_of_each[:, 0] > 0].mean()) if n_seen else 1.0
    rest, amplitude = _power(powers, found, edges)
    least = rest / (max(n_seen - modes, 1) * own_share)
    shared = np.maximum(amplitude - np.maximum(least, 1.0), 0.0).T
    if remains is not None:
        least = least / remains
    own = np.maximum(least, 1.0)
    upper = powers[:, powers.shape[1] // 2 :]
    rest_of_each = upper - np.einsum("kd,kt->dt", found, _projected(upper, found))
    left = has - (found**2).sum(axis=0)  # of its white noise, without the modes
    fast = np.ones(n_det)
    told = (seen_of_each[:, 0] > 0) & (left > LEAST_LEFT)
    fast[told] = (np.abs(rest_of_each[told]) ** 2).mean(axis=1) / left[told]
    share = max(seen_of_each.max(), 1) / n_base
    middle = (edges[:-1] + edges[1:] - 1) / 2 / n_base * rate / length
    return BaselineNoise(
        white,
        length,
        lines,
        found,
        free,
        values,
        middle,
        edges,
        own,
        shared,
        least,
        fast,
        np.where(edges[:-1] < (1 + LOWEST) / share, 0, 2 * np.diff(edges) * share)
        * max(n_seen - modes, 1),
        groups,
        places,
        kept | (np.arange(modes) < free),
    )


def of_scene(
    found: BaselineNoise, observation: Observation, rows: NDArray[np.intp], place: str
) -> BaselineNoise:
    """Noise of the detectors ``rows`` from the scene's closed forms; number of modes and bins of
    frequency are those of what was ``found`` in the streams.

    Raises PipelineError where a component of the scene has no closed form.
    """
    net, lacking = observation.focalplane.net[rows], []
    for name in sorted(observation.components & {"atmosphere", "pink"}):
        if name not in observation.closed_forms:
            lacking += [name] * bool(name != "pink" or observation.focalplane.knee.any())
    if not observation.noise_levels or (net <= 0).any():
        lacking = ["white noise of each detector"]
    if lacking:
        raise PipelineError(
            f"the scene has no closed form of {lacking[0]}",
            place=place,
            cure="set noise: estimated, or give a table of zonda noise",
        )
    n, mean, f = len(rows), 2 * np.mean(net**2), found.frequency.copy()
    f[0] = f[1] / 2
    forms = [form for every in observation.closed_forms.values() for form in every]
    waves, across = _waves(observation, rows, forms, f)
    whole = [(form.shared, form(f)) for form in forms if form.across is None]
    pink = sum(((1 - share) * power for share, power in whole), np.zeros(len(f))) / mean
    even = sum((share * power for share, power in whole), np.zeros(len(f))) / mean
    columns = np.concatenate([np.full((n, 1), 1.0), waves], axis=1)
    powers = np.concatenate([even[:, None], across], axis=1)
    number = np.diff(found.edges).astype(np.float64)
    seconds = observation.n_samples / observation.sample_rate
    powers += 4 / seconds**2 * np.einsum("f,fw->w", number, powers) / (2 * np.pi * f[:, None]) ** 2
    slow = np.where(f < SLOW, number, 0.0)
    slow[0] = 0.0
    alike = waves[:, 0]
    groups = members(found.groups)
    first = np.zeros((len(groups), n))
    for row, at in zip(first, groups, strict=True):
        row[at] = alike[at] / np.sqrt((alike[at] ** 2).sum())
    numbers = [int((found.modes[:, at] != 0).any(axis=1).sum()) for at in groups]
    weighed = columns * np.sqrt(np.einsum("f,fw->w", slow, powers))
    q, _ = leading_of(found.groups, weighed, numbers, first)
    spectra = np.einsum("fw,kw->fk", powers, np.einsum("kd,dw->kw", q, columns) ** 2)
    whole_power = np.einsum("fw,w->f", powers, (columns**2).sum(axis=0))
    rest = whole_power - spectra.sum(axis=1)
    return replace(
        found,
        white=net**2 * observation.sample_rate,
        modes=q,
        values=1 + np.einsum("f,fk->k", slow, spectra) / max(slow.sum(), 1),
        own=1 + pink + np.maximum(rest, 0.0) / max(n - len(q), 1),
        shared=spectra,
    )


def of_table(found: BaselineNoise, columns: Mapping[str, Floats]) -> BaselineNoise:
    """Noise that was ``found``, with white levels of a table and the detectors' own spectra of its
    knees and slopes; the spectra of modes remain.
    """
    f = np.maximum(found.frequency, found.frequency[1] / 2)[:, None]
    knee, slope = (columns.get(name, np.zeros(1)) for name in ("knee", "slope"))
    return replace(found, own=1 + ((knee / f) ** slope).mean(axis=1))


def _waves(
    observation: Observation, rows: NDArray[np.intp], forms: list[ClosedForm], f: Floats
) -> tuple[Floats, Floats]:
    """Waves (n_det, n) over white noise, the even one first, and the density of each (n_f, n)."""
    plane = observation.focalplane
    xi, eta = plane.xi[rows] - plane.xi[rows].mean(), plane.eta[rows] - plane.eta[rows].mean()
    reach = max(float(np.hypot(xi, eta).max()), 1e-6)
    edges = np.concatenate([[0.0], np.geomspace(EVEN, 50, WAVES) / reach, [np.inf]])
    number = np.concatenate([[0.0], np.sqrt(edges[1:-2] * edges[2:-1]), edges[-2:-1]])
    angle = np.pi * (np.arange(ANGLES) + 0.5) / ANGLES
    k = np.multiply.outer(number, np.stack([np.cos(angle), np.sin(angle)])).transpose(1, 0, 2)
    phase = np.multiply.outer(xi, k[0].ravel()) + np.multiply.outer(eta, k[1].ravel())
    waves = np.concatenate([np.cos(phase), np.sin(phase)], axis=1)
    each = np.zeros((len(f), len(number)))
    for form in forms:
        each += form.across(f, edges) if form.across else 0.0
    density = np.repeat(each, ANGLES, axis=1) / ANGLES
    gain = (plane.illumination_efficiency / plane.main_beam_efficiency)[rows]
    gain /= np.sqrt(np.mean(gain**2))
    return waves * (gain / plane.net[rows] / np.sqrt(2))[:, None], np.tile(density, (1, 2))


def what_remains(
    rest: Floats, drawn: Floats, counted: NDArray[np.int32], noise: BaselineNoise
) -> Floats:
    """(n_bins,) share of the power of baselines (n_det, n_base) that are ``drawn`` from a noise
    model which is in their ``rest``, their map taken off; without modes. It changes slowly with
    frequency, and is that of `POOLED` bins on each side; at most 1.
    """
    unit = noise.white / noise.length
    number = np.diff(noise.edges)
    spectra = (_spectra(y, counted, unit, noise.lines) for y in (rest, drawn))
    powers = (_power(found, noise.modes, noise.edges)[0] for found in spectra)
    one, whole = (np.convolve(number * power, POOLED) for power in powers)
    some = slice(len(POOLED) // 2, len(POOLED) // 2 + number.size)
    return np.minimum(one[some] / np.where(whole[some] > 0, whole[some], np.inf), 1.0)


def _spectra(
    y: Floats, counted: NDArray[np.int32], unit: Floats, lines: Floats
) -> NDArray[np.complex128]:
    """Spectra (n_det, n) of baselines without lines, over white noise of variance ``unit`` (n_det,)
    in the baselines that count.
    """
    scaled = y / np.sqrt(unit)[:, None]
    take_lines(scaled, lines, counted)
    seen = np.maximum(np.count_nonzero(counted, axis=1), 1)[:, None]
    return np.asarray(fft.rfft(scaled, axis=1) / np.sqrt(seen))


def _power(
    powers: NDArray[np.complex128], modes: Floats, edges: NDArray[np.intp]
) -> tuple[Floats, Floats]:
    """Means over bins: power beside the modes, (n_bins,), and of each mode, (k, n_bins)."""
    amplitude = np.abs(_projected(powers, modes)) ** 2
    every = np.einsum("dt,dt->t", powers.real, powers.real)
    every += np.einsum("dt,dt->t", powers.imag, powers.imag)
    rows = np.concatenate([(every - amplitude.sum(axis=0))[None], amplitude])
    bins = [slice(max(low, 1), max(high, 2)) for low, high in pairwise(edges.tolist())]
    means = np.stack([rows[:, at].mean(axis=1) for at in bins], axis=1)
    return means[0], means[1:]


def filled(
    y: Floats,
    lacking: NDArray[np.bool_],
    white: Floats,
    mode: Floats,
    trend: int,
    groups: NDArray[np.intp],
) -> Floats:
    """Baselines (n_det, n_base) [K]; those that are ``lacking`` (n_det, n_base) are what the others
    of the group at that time see of a mode (n_det,), and a polynomial of the detector. Linear in y.
    """
    if not lacking.any():
        return y
    g, lines = np.sqrt(white)[:, None], polynomials(y.shape[1], trend)
    z, own = np.where(lacking, 0.0, y / g), np.zeros(y.shape)
    weights = np.where(lacking, 0.0, mode[:, None])
    common, detectors = np.zeros(y.shape), members(groups)
    for at in detectors:
        weights[at] /= np.maximum((weights[at] * mode[at, None]).sum(axis=0), 1e-300)
    for _ in range(FILLS):
        for at in detectors:
            common[at] = mode[at, None] * ((z[at] - own[at]) * weights[at]).sum(axis=0)
        rest = np.where(lacking, own, z - common)
        own = np.einsum("dp,pt->dt", np.einsum("dt,pt->dp", rest, lines), lines)
    return np.where(lacking, (own + common) * g, y)


def _projected(powers: NDArray[np.complex128], modes: Floats) -> NDArray[np.complex128]:
    """Amplitudes (k, n) of modes in spectra (n_det, n)."""
    real = np.einsum("kd,dt->kt", modes, powers.real)
    return np.asarray(real + 1j * np.einsum("kd,dt->kt", modes, powers.imag))


def bins_of(n: int) -> NDArray[np.intp]:
    """Edges of bins of ``n`` frequencies: 0 alone, `LOWEST` of them, then equal in the
    logarithm.
    """
    upper = np.geomspace(1 + LOWEST, max(n, 1 + LOWEST), BINS).round()
    edges = np.unique(np.concatenate([[0, 1, n], upper]).astype(np.intp))
    return edges[edges <= n]


def polynomials(n: int, degree: int) -> Floats:
    """Orthonormal polynomials (degree + 1, n) up to a degree."""
    x = np.linspace(-1, 1, n) if n > 1 else np.zeros(1)
    powers = np.array([x**power for power in range(min(degree + 1, n))])
    return orthonormal(powers, np.zeros((0, n)))


@kernel
def take_lines(rows, lines, counted):  # type: ignore[no-untyped-def]
    """Subtract from each row (n_det, n) its projection on orthonormal ``lines`` (k, n); where
    nothing is ``counted`` (n_det, n) rows become 0, and lines are those of the rest.
    """
    for d in range(rows.shape[0]):
        own = lines
        if (counted[d] == 0).any():
            own = lines.copy()
            for k in range(lines.shape[0]):
                before = (own[k] * own[k]).sum()
                for t in range(rows.shape[1]):
                    if counted[d, t] == 0:
                        own[k, t] = rows[d, t] = 0.0
                for _ in range(2):
                    for j in range(k):
                        own[k] -= (own[k] * own[j]).sum() * own[j]
                size = (own[k] * own[k]).sum()
                own[k] *= 1 / np.sqrt(size) if size > 1e-12 * before else 0.0
        for k in range(own.shape[0]):
            total = 0.0
            for t in range(rows.shape[1]):
                total += rows[d, t] * own[k, t]
            for t in range(rows.shape[1]):
                rows[d, t] -= total * own[k, t]


@kernel
def _weigh(found, inverse, share, modes):  # type: ignore[no-untyped-def]
    """Equation (3) of spectra ``found`` (n_det, n), in place: ``inverse`` (n,) 1 / D, ``share``
    (k, n) h, ``modes`` (k, n_det).
    """
    n_det, n = found.shape
    amplitude = np.zeros((modes.shape[0], n), np.complex128)
    for d in range(n_det):
        for k in range(modes.shape[0]):
            for t in range(n):
                amplitude[k, t] += modes[k, d] * found[d, t]
    for k in range(modes.shape[0]):
        for t in range(n):
            amplitude[k, t] *= share[k, t]
    for d in range(n_det):
        for k in range(modes.shape[0]):
            for t in range(n):
                found[d, t] -= modes[k, d] * amplitude[k, t]
        for t in range(n):
            found[d, t] *= inverse[t]
