"""Speed, acceleration and jerk of a scan: of the axes, and of the beam on the sky, from its track;
samples per beam, and what too few of them cost.

Finite differences of the track over a step h are means of the derivatives over at most k h: they
never exceed the largest derivative (mean value theorem), and fall short of it by O(h^2). What is
missing is estimated from steps h and 2 h (Richardson), and from the second difference c of D_h at
its largest, a mean over k h that may stand half a step beside the peak (h may be such a part of a
period that neither step meets one):

    error = max(|max D_h - max D_2h| / 3, c / 8 + k c / 24)                                      (1)

The step is halved until the error is below `ACCURACY` for every figure that has a limit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from zonda.core.data import Observation
from zonda.core.numerics.quaternions import conjugate, multiply
from zonda.core.types import Bools, Floats

ACCURACY = 0.01
"""Error (1) aimed at, of the figure or of 0.3 of its limit, whichever is more."""

POINTS, MOST_POINTS = 1 << 14, 1 << 20
"""Points of the track that are looked at first, and at most."""

SHORTEST_STEP = 1e-3
"""s: rounding (4e-16 rad) is below 4e-9 rad/s^2 of acceleration and 1e-5 rad/s^3 of jerk at this
step.
"""

Quantity = tuple[str, int]
"""Axis (``azimuth``, ``elevation`` or ``sky``) and order of the derivative (1 to 3)."""

QUANTITIES: tuple[Quantity, ...] = (
    *((axis, order) for axis in ("azimuth", "elevation") for order in (1, 2, 3)),
    ("sky", 1),
    ("sky", 2),
)
"""What is measured. On the sky the azimuth counts times the cosine of the elevation."""


class LargestDerivative(NamedTuple):
    """A largest derivative of the track."""

    figure: float
    """rad/s^order."""
    second: float
    """s since the start of the scan: where it is reached."""
    elevation: float
    """rad, there."""
    error: float
    """Equation (1): what the figure may fall short by, rad/s^order."""


def motion(
    horizontal: Floats,
    rate: float,
    limits: Mapping[Quantity, float],
    finer: Callable[[float], Floats],
) -> dict[Quantity, LargestDerivative]:
    """The largest derivatives of a track.

    Parameters
    ----------
    horizontal
        Directions (n, 3) north, west, up at ``rate`` [Hz].
    limits
        Those quantities that must be known within `ACCURACY`, with their limits [rad/s^order].
    finer
        The same track in steps of so many seconds, where samples are too far apart.
    """
    stride = 1 << max(
        0,
        math.ceil(math.log2(max(len(horizontal) / POINTS, rate * SHORTEST_STEP, 1e-9))),
    )
    step = stride / rate
    while True:
        track = horizontal[::stride] if stride else finer(step)
        found = _peaks(track, step)
        known = all(
            found[q].error <= ACCURACY * max(found[q].figure, 0.3 * limit)
            for q, limit in limits.items()
            if q in found
        )
        points = 2 * len(track)
        enough = known and (found or not limits)
        if (
            enough
            or step / 2 < SHORTEST_STEP
            or points > max(MOST_POINTS, len(horizontal))
            or len(horizontal) < 2
        ):
            return found
        stride = stride // 2
        step = step / 2


def _peaks(track: Floats, step: float) -> dict[Quantity, LargestDerivative]:
    azimuth = np.unwrap(np.arctan2(-track[:, 1], track[:, 0]))
    elevation = np.arctan2(track[:, 2], np.hypot(track[:, 0], track[:, 1]))
    fine = _derivatives(azimuth, elevation, 1, step)
    coarse = _derivatives(azimuth, elevation, 2, step)
    found = {}
    for (axis, order), rates in fine.items():
        k = int(rates.argmax())
        largest = float(rates[k])
        around = rates[max(k - 1, 0) : k + 2]
        bend = 2 * largest - float(around[0] + around[-1]) if len(around) == 3 else 0.0
        error = max(
            abs(largest - float(coarse[axis, order].max(initial=0.0))) / 3,
            bend * (3 + order) / 24,
        )
        there = float(elevation[min(k + order // 2, len(elevation) - 1)])
        found[axis, order] = LargestDerivative(largest, (k + order / 2) * step, there, error)
    return found


def _derivatives(
    azimuth: Floats,
    elevation: Floats,
    lag: int,
    step: float,
) -> dict[Quantity, Floats]:
    """Magnitudes of difference quotients over ``lag`` steps, (n - order lag,) each; without those
    of no points.
    """
    axes = {"azimuth": azimuth, "elevation": elevation}
    found = {}
    for order in (1, 2, 3):
        axes = {axis: values[lag:] - values[:-lag] for axis, values in axes.items()}
        per = (lag * step) ** order
        if ("sky", order) in QUANTITIES:
            first = order // 2 * lag
            cosine = np.cos(elevation[first : first + len(axes["azimuth"])])
            found["sky", order] = np.hypot(axes["azimuth"] * cosine, axes["elevation"]) / per
        found |= {(axis, order): np.asarray(abs(values) / per) for axis, values in axes.items()}
    return {q: found[q] for q in QUANTITIES if len(found[q]) or lag > 1}


def rate_text(value: float, order: int) -> str:
    """An angle, speed, acceleration or jerk [rad/s^order] in degrees, or in arcseconds where it is
    small.
    """
    degrees = math.degrees(value)
    number, unit = (degrees, "deg") if degrees >= 0.1 else (degrees * 3600, "arcsec")
    return f"{number:.4g} {unit}" + (f"/s{order if order > 1 else ''}" if order else "")


FEW = 2.0
"""Samples per FWHM below which a scan warns: the beam's transfer at the Nyquist frequency,
exp(-pi^2 N^2 / (16 ln 2)), is then more than 3 % (41 % at one sample), folded to other scales.
Samples are instants: what is simulated stays right."""


class SamplesPerBeam:
    """Samples per FWHM of several scans, where the sky passes fastest.

    The speed is that of the outermost detector on the sky: the boresight's, and the field's
    rotation times its radius.
    """

    TOPICS = ("samples per FWHM",)
    """How its statement begins."""

    def __init__(self) -> None:
        self._fastest = 0.0
        self._usual = 0.0
        self._fwhm = 0.0
        self._rate = 0.0
        self._where = ""

    def add(self, observation: Observation, rate: float) -> None:
        """Take a scan into account, read out at ``rate`` [Hz]."""
        speed, turn = on_the_sky(
            observation.boresight_radec,
            observation.seconds,
            observation.good_samples,
        )
        total = speed + turn * math.atan(observation.focalplane.radius)
        if len(total) and total.max() > self._fastest:
            self._fastest = float(total.max())
            self._usual = float(np.median(total))
            self._fwhm = float(observation.focalplane.fwhm.min())
            self._rate = rate
            self._where = observation.name

    @property
    def least(self) -> float:
        """Samples per FWHM at the fastest; infinite where nothing moves."""
        return self._fwhm * self._rate / self._fastest if self._fastest else math.inf

    def statements(self) -> list[tuple[str, str]]:
        """(what, text) for the log."""
        if not self._fastest:
            return []
        usual = self._fwhm * self._rate / max(self._usual, 1e-3 * self._fastest)
        text = (
            f"{self.least:.3g} at {rate_text(self._fastest, 1)} on the sky, {usual:.3g} in the"
            f" median; {self._lost}"
        )
        return [
            (f"samples per FWHM of {self._beam}", f"{text} (not simulated: samples are instants)")
        ]

    def warnings(self) -> list[str]:
        """Warnings where there are fewer than `FEW`."""
        if self.least >= FEW:
            return []
        folded = math.exp(-((math.pi * self.least) ** 2) / (16 * math.log(2)))
        what = f"only {self.least:.3g} samples per FWHM of {self._beam} in {self._where}"
        cost = (
            f"{self._lost}, and up to {100 * folded:.3g} % of the beam's transfer is folded to"
            " other scales"
        )
        cure = f"scan at {rate_text(self._fwhm * self._rate / FEW, 1)} or less"
        return [
            f"{what}: {cost}; {cure}, or read out at {math.ceil(FEW * self._fastest / self._fwhm)}"
            " Hz or more"
        ]

    @property
    def _beam(self) -> str:
        return f"{math.degrees(self._fwhm) * 3600:.3g} arcsec"

    @property
    def _lost(self) -> str:
        return (
            f"integrating over its interval, a sample loses {100 * peak_lost(self.least):.2g} % of"
            " a point source's peak"
        )


def on_the_sky(boresight: Floats, seconds: Floats, use: Bools) -> tuple[Floats, Floats]:
    """Speed of the beam and rate of the field's rotation [rad/s] at up to about `POINTS` pairs of
    neighbouring samples.

    ``boresight``: quaternions (n, 4) at ``seconds`` (n,), of which those to ``use`` (n,) count.
    From the rotation between neighbours, in the focal plane's own axes.
    """
    at = np.arange(0, max(len(boresight) - 1, 0), max(1, len(boresight) // POINTS))
    at = at[use[at] & use[at + 1]]
    x, y, z, _ = multiply(conjugate(boresight[at]), boresight[at + 1]).T
    step = seconds[at + 1] - seconds[at]
    # sines of half angles: at most 1 but for rounding
    return (
        2 * np.arcsin(np.minimum(np.hypot(x, y), 1.0)) / step,
        2 * np.arcsin(np.minimum(abs(z), 1.0)) / step,
    )


def peak_lost(samples_per_fwhm: float) -> float:
    """Share of a point source's peak that a sample loses which integrates over its whole interval,
    along the scan.

    A Gaussian beam averaged over FWHM / N: 1 - sqrt(pi) erf(a) / (2 a), a = sqrt(ln 2) / N.
    """
    a = math.sqrt(math.log(2)) / samples_per_fwhm
    return 1 - math.sqrt(math.pi) * math.erf(a) / (2 * a) if a > 1e-4 else a * a / 3
