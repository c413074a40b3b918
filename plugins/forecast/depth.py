"""The depth of a map against time: variances of its noise, their errors, and the units that
observers use.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from zonda.core.errors import InputError
from zonda.core.instrument import Band
from zonda.core.numerics.radiation import to_kelvin_rj
from zonda.core.types import Floats

from . import atmosphere_noise, detector_noise, stokes_noise

if TYPE_CHECKING:
    from .survey import Survey


PREFIXES = {"n": 1e-9, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "m": 1e-3, "": 1.0, "k": 1e3}
ALIASES = {"K": "K_RJ"}
_DEPTH = re.compile(
    r"\s*(?P<number>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(?P<unit>[^\s\d.]\S*)?\s*"
)


DEPTHS = "'10 uK', '10 uK_CMB', '0.2 mJy/beam', '0.01 MJy/sr', or '0.1 mJy' of a point source"


def read_depth(
    text: str,
    factors: Mapping[str, float],
    place: str = "--reach",
    what: str = "a depth",
    examples: str = DEPTHS,
) -> float:
    """A depth such as ``10 uK``, ``10 uK_CMB``, ``0.2 mJy/beam``, ``3 kJy/sr``, ``0.1 mJy`` (a
    point source) in K_RJ, or another quantity in the units of ``factors`` over these.

    Raises InputError.
    """
    wrong = ""
    cure = f"write e.g. {examples}"
    units = {a: unit for a, unit in ALIASES.items() if unit in factors} | {u: u for u in factors}
    known = {
        prefix + name: (size, unit)
        for name, unit in units.items()
        for prefix, size in PREFIXES.items()
        if "MJy" not in name
    }
    if "MJy/sr" in factors:
        known |= {"MJy/sr": (1.0, "MJy/sr"), "kJy/sr": (1e-3, "MJy/sr"), "Jy/sr": (1e-6, "MJy/sr")}
    match = _DEPTH.fullmatch(text)
    if match is None:
        wrong = f"cannot read '{text}' as {what}"
    elif match["unit"] is None:
        wrong = f"{text.strip()} has no unit"
    elif match["unit"] not in known:
        wrong = f"'{match['unit']}' is no unit of {what}"
    else:
        size, unit = known[match["unit"]]
        value = float(match["number"]) * size / factors[unit]
        if math.isfinite(value) and value > 0:
            return value
        wrong = f"no observation reaches a depth of {text}"
        cure = "give a positive depth"
        if place != "--reach":
            wrong = f"{text} is not positive"
            cure = "give its magnitude, also of a decrement"
    raise InputError(wrong, place=place, cure=cure)


def prefixed(value: float, unit: str) -> tuple[float, str]:
    """Factor and name of the unit in which a value reads well: 1e6, ``uK_RJ``."""
    scales = [(1.0, 1.0, unit), (1e-3, 1e3, f"m{unit}"), (1e-8, 1e6, f"u{unit}")]
    last = (1e9, f"n{unit}")
    if unit == "MJy/sr":
        scales = [(0.1, 1.0, unit), (1e-4, 1e3, "kJy/sr")]
        last = (1e6, "Jy/sr")
    size = abs(value) or 1e-8
    return next(((factor, name) for least, factor, name in scales if size >= least), last)


def number(value: float) -> str:
    """Three digits, without an exponent where it is large."""
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def in_unit(value: float, unit: str) -> str:
    """``158 uK_RJ``."""
    factor, name = prefixed(value, unit)
    return f"{number(value * factor)} {name}"


TIMES = {"h": 3600.0, "min": 60.0, "s": 1.0}


def unit_of(seconds: float) -> str:
    """The unit in which a time reads well, of `TIMES`."""
    return next((name for name, size in TIMES.items() if seconds >= size * (1 - 1e-9)), "s")


def duration(seconds: float, unit: str) -> str:
    """``8.6 min``, ``0.143 h``: a time in a unit of `TIMES`."""
    return f"{number(seconds / TIMES[unit])} {unit}"


PARTS = ("white", "1/f", "atmosphere")
"""What the noise is split into."""
WITHIN = {"white": 0.05, "1/f": 0.05, "atmosphere": 0.25}
"""Relative error of each part's rms that audits found at most (docs/sensitivity.md); the atmosphere
is indicative.
"""
TURNED = 0.1
"""Share of the atmosphere's variance from which what a turned mode leaves of it is not forecast: it
is known to a factor of some in the rms only."""
UNITS = ("K_RJ", "K_CMB", "Jy/beam", "MJy/sr", "Jy")
"""Units of a depth: ``Jy`` is the flux density of a point source, see `factors`."""
PER_DECADE = (1.0, 2.0, 5.0)


def factors(band: Band, fwhm: float) -> dict[str, float]:
    """Factors by which a depth in K_RJ (after smoothing with the beam) is multiplied, by unit.

    The spectrum of the source is flat over the band in S_nu, and that of CMB anisotropy for K_CMB
    (`core.numerics.radiation`). ``Jy/beam`` and ``MJy/sr`` are surface brightness, for the solid
    angle Omega = pi FWHM^2 / (4 ln 2) of the beam. ``Jy`` is the standard deviation of the flux
    density of a point source: the map behind the beam K is the matched filter, whose peak for a
    source of flux density S is S / (2 Omega) in surface brightness, because int K^2 / int K = 1/2.
    Hence Jy = 2 Jy/beam.
    """
    omega = math.pi * fwhm**2 / math.log(16)
    found = {unit: 1 / to_kelvin_rj(unit, band, beam_solid_angle=omega) for unit in UNITS[:-1]}
    return found | {"Jy": 2 * found["Jy/beam"]}


@dataclass(frozen=True)
class Depth:
    """Rms of the noise in a circle after smoothing with the beam, K_RJ.

    Attributes
    ----------
    seconds
        (n_scan,) integration time after each scan, from the first on after which a pixel of the
        circle has a value.
    variance
        By part (`PARTS`), (n_scan,) K^2; NaN of a part that is not forecast.
    error
        By part, relative error of its rms that is stated.
    """

    seconds: Floats
    variance: Mapping[str, Floats]
    error: Mapping[str, float]
    reason: str = ""
    """Why a part is not forecast."""

    @property
    def known(self) -> tuple[str, ...]:
        """The parts that are forecast."""
        return tuple(name for name in PARTS if not np.isnan(self.variance[name][-1]))

    def followed(self, seconds: float) -> bool:
        """True for an integration time within that of the scans."""
        return bool(self.seconds[0] * (1 - 1e-9) <= seconds <= self.seconds[-1] * (1 + 1e-9))

    def part(self, name: str, seconds: Floats | float) -> Floats:
        """The rms of a part of the noise, K_RJ, after ``seconds``: as forecast up to the end of the
        scans, then as time^-1/2; before the end of the first scan likewise."""
        wanted = np.asarray(seconds, np.float64)
        inside = np.clip(wanted, self.seconds[0], self.seconds[-1])
        variance = np.interp(inside, self.seconds, self.seconds * self.variance[name])
        return np.sqrt(variance / wanted)

    def total(self, seconds: Floats | float) -> Floats:
        """Quadratic sum of the parts that are forecast, K_RJ."""
        return np.sqrt(sum(self.part(name, seconds) ** 2 for name in self.known))

    def total_error(self, seconds: float) -> float:
        """Relative error of `total`, the parts' errors in quadrature."""
        parts = [float(self.part(name, seconds)) ** 2 * self.error[name] for name in self.known]
        return math.hypot(*parts) / max(float(self.total(seconds)) ** 2, 1e-300)

    def reach(self, rms: float) -> float:
        """Integration time [s] after which all parts together are ``rms`` [K_RJ]; all of them fall
        as time^-1/2 after the scans.

        Raises InputError for what is not positive.
        """
        if not rms > 0:
            text = f"no observation reaches a depth of {rms:g} K"
            raise InputError(text, place="--reach", cure="give a positive depth")
        start, end = (float(self.seconds[k]) for k in (0, -1))
        for seconds, beyond in ((end, rms.__le__), (start, rms.__ge__)):
            if beyond(total := float(self.total(seconds))):
                return seconds * (total / rms) ** 2
        fine = np.geomspace(start, end, 2000)
        return float(fine[np.argmax(self.total(fine) <= rms)])


def depths_of(survey: Survey, radius: float) -> dict[str, Depth]:
    """Forecast the noise after smoothing with the beam, averaged over a circle of ``radius`` [rad]
    about the map's centre: by the plane of the map, ``I`` alone or ``I``, ``Q`` and ``U``.

    The atmosphere is not polarized. Where detectors cancel it (`Survey.cancels`) Q and U have none
    of it; else what of it is in I, Q and U is not forecast.

    Raises PipelineError where the circle is not on the map, or not observed.
    """
    survey.check_radius(radius)
    variances = (
        stokes_noise.variances(survey, radius)
        if survey.polarized
        else {"I": detector_noise.variances(survey, radius)}
    )
    known = np.isfinite(sum(each["white"] + each["1/f"] for each in variances.values()))
    if not known[-1]:
        text = "nothing is observed in the circle"
        cure = "choose a larger --radius"
        if survey.polarized:
            text = "the samples in the circle determine I, Q and U in no pixel"
            cure += ", or larger pixels"
        raise InputError(text, place="zonda sensitivity", cure=cure)
    left = atmosphere_noise.variance(survey, radius)
    # an error of a variance is half as large of its root
    chance = left.mode.independent**-0.5 if left.mode else 0.0
    error = WITHIN | {"atmosphere": math.hypot(WITHIN["atmosphere"], left.error / 2, chance)}
    atmosphere = {"I": left.variance}  # it is not in Q and U
    reason = ""
    most = TURNED * left.variance[-1]
    if left.mode and left.mode.turned and _stays(survey, left.mode, radius) > most:
        reason = "noise turns the singular mode, which then leaves some of what all detectors see"
    if survey.polarized and left.variance.any() and not survey.cancels:
        reason = "the detectors at one place do not keep it out of Q and U"
    unknown = math.nan if reason else 0.0
    after = slice(int(known.argmax()), None)
    return {
        plane: Depth(
            survey.seconds[after],
            {
                part: values[after]
                for part, values in (
                    each | {"atmosphere": atmosphere.get(plane, 0 * left.variance) + unknown}
                ).items()
            },
            error,
            reason,
        )
        for plane, each in variances.items()
    }


def _stays(survey: Survey, mode: atmosphere_noise.Mode, radius: float) -> float:
    """Variance [K^2] in the map of what a turned mode leaves of the common mode: noise of each
    detector, of its spectrum.
    """
    alone = replace(
        survey,
        levels=[(mode.noise,)] * len(survey.observations),
        steps=replace(survey.steps, common=None),
    )
    return float(detector_noise.variances(alone, radius)["1/f"][-1])


def scatter(sigma: float, radius: float) -> float:
    """Relative standard deviation of the rms of one map of white noise behind a beam of standard
    deviation ``sigma`` in a circle of ``radius``: sigma / radius, because pi radius^2 / (2 pi
    sigma^2) areas in it are independent."""
    return sigma / max(radius, math.sqrt(2) * sigma)


def times(depth: Depth, wanted: float | None) -> Floats:
    """Round times [s] about the length of the scans (or ``wanted``) for a table: 1, 2 and 5 of each
    decade of hours, and the length."""
    end = float(depth.seconds[-1])
    chosen = np.array([end, wanted or end])
    low = chosen.min() / 5
    high = chosen.max() * 20
    ends = math.floor(math.log10(low / 3600)), math.ceil(math.log10(high / 3600))
    round_ones = 3600 * np.multiply.outer(PER_DECADE, 10.0 ** np.arange(ends[0], ends[1] + 1))
    return np.unique(np.r_[chosen, round_ones[(low <= round_ones) & (round_ones <= high)]])
