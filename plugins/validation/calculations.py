"""Numbers with units as a claims file writes them (``148 uK``, ``13.97 uJy``), and claims that need
no run: closed forms and conversions, each a function of quantities with units. SI throughout.

Constants are those of the SI (exact). A claims file names them: ``calculate: {rayleigh_distance:
{aperture: 42 cm, ...}}``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import ValidationError, validate_call

from zonda.core.configuration.diagnostics import TextValue, mistake
from zonda.core.configuration.units import (
    Angle,
    AngularSpeed,
    Fraction,
    Kelvin,
    KelvinRootSecond,
    Metres,
    RadioFrequency,
    Seconds,
    read_unit,
)
from zonda.core.types import Floats

FURTHER = ("", "sigma", "samples")
"""Units of counts, which astropy does not know."""

_TEXT = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*$", re.DOTALL)


@dataclass(frozen=True)
class Amount(TextValue):
    """A number and its unit.

    Attributes
    ----------
    value
        In SI.
    unit, factor
        The unit it was written in, and that in SI.
    """

    value: float
    unit: str = ""
    factor: float = 1.0

    @classmethod
    def parse(cls, value: Any) -> Amount:
        """From text, a number without a unit, or an amount."""
        if isinstance(value, Amount):
            return value
        match = None if isinstance(value, bool) else _TEXT.match(str(value))
        if not match:
            raise mistake(f"expected a number and its unit such as '148 uK', got {value!r:.60}")
        unit = match[2]
        try:
            factor = 1.0 if unit in FURTHER else float(read_unit(unit).si.scale)
        except ValueError:
            known = ", ".join(filter(None, FURTHER))
            raise mistake(
                f"unknown unit '{unit}'",
                help=f"a unit that astropy reads, or one of: {known}",
            ) from None
        return cls(float(match[1]) * factor, unit, factor)

    def write(self, value: float, digits: int = 4) -> str:
        """``value`` (SI) as a number in this unit."""
        return "" if math.isnan(value) else f"{value / self.factor:.{digits}g}"

    def __str__(self) -> str:
        return f"{self.value / self.factor:.10g} {self.unit}".strip()


LIGHT = 299792458.0
BOLTZMANN = 1.380649e-23

CALCULATIONS: dict[str, Callable[..., float]] = {}
"""By name: functions that take texts with units. Called from Python, by their own names, they take
SI numbers.
"""


def _register(function: Callable[..., float]) -> Callable[..., float]:
    CALCULATIONS[function.__name__] = validate_call(function)
    return function


class Calculation(TextValue):
    """A calculation and its arguments: {name: {argument: value}}."""

    json_schema = {"type": "object", "minProperties": 1, "maxProperties": 1}  # noqa: RUF012

    def __init__(self, name: str, arguments: Mapping[str, Any], value: float) -> None:
        self.name = name
        self.arguments = dict(arguments)
        self.value = value

    @classmethod
    def parse(cls, value: Any) -> Calculation:
        """Evaluate it. Raises what `mistake` makes."""
        if isinstance(value, Calculation):
            return value
        if not isinstance(value, Mapping) or len(value) != 1:
            raise mistake("expected one calculation, {name: {argument: value}}")
        name, arguments = next(iter(value.items()))
        if name not in CALCULATIONS:
            from zonda.core.configuration.diagnostics import nearest

            raise mistake(
                f"there is no calculation '{name}'",
                nearest(name, CALCULATIONS),
                ", ".join(sorted(CALCULATIONS)),
            )
        if not isinstance(arguments, Mapping):
            raise mistake(f"the arguments of {name} are a mapping, {{argument: value}}")
        try:
            return cls(name, arguments, float(CALCULATIONS[name](**arguments)))
        except ValidationError as err:
            first = err.errors()[0]
            raise mistake(f"{name}: {'.'.join(map(str, first['loc']))}: {first['msg']}") from None

    def __str__(self) -> str:
        return f"{self.name}({', '.join(f'{k}={v}' for k, v in self.arguments.items())})"


@_register
def stated(value: str | float) -> float:
    """A number that the paper states elsewhere."""
    return Amount.parse(value).value


@_register
def ratio(of: str | float, to: str | float) -> float:
    """One stated number divided by another."""
    return Amount.parse(of).value / Amount.parse(to).value


@_register
def rayleigh_distance(aperture: Metres, frequency: RadioFrequency) -> float:
    """z_r = pi (D/2)^2 / lambda of the paper's beam, m."""
    return math.pi * (aperture / 2) ** 2 * frequency / LIGHT


@_register
def beam_width(aperture: Metres, frequency: RadioFrequency, distance: Metres) -> float:
    """FWHM of the paper's beam at a distance along the line of sight, D sqrt(1 + (z / z_r)^2),
    m.
    """
    return aperture * math.sqrt(1 + (distance / rayleigh_distance(aperture, frequency)) ** 2)


@_register
def far_field_fwhm(aperture: Metres, frequency: RadioFrequency) -> float:
    """Angular FWHM of the paper's beam far away, D / z_r = (4 / pi) lambda / D, rad."""
    return aperture / rayleigh_distance(aperture, frequency)


@_register
def diffraction_fwhm(aperture: Metres, frequency: RadioFrequency, factor: Fraction = 1.22) -> float:
    """factor lambda / D, rad."""
    return factor * LIGHT / frequency / aperture


@_register
def beam_shift(
    aperture: Metres,
    frequency: RadioFrequency,
    distance: Metres,
    factor: Fraction = 1.0,
) -> float:
    """Separation of the lines of sight of detectors that are factor lambda / D apart, at a
    distance, m.
    """
    return diffraction_fwhm(aperture, frequency, factor) * distance


@_register
def disc_overlap(
    aperture: Metres,
    frequency: RadioFrequency,
    distance: Metres,
    factor: Fraction = 1.0,
) -> float:
    """Share of area that two discs of the beam's FWHM have in common, their centres `beam_shift`
    apart.
    """
    x = beam_shift(aperture, frequency, distance, factor) / beam_width(
        aperture,
        frequency,
        distance,
    )
    return (2 / math.pi) * (math.acos(x) - x * math.sqrt(1 - x * x)) if x < 1 else 0.0


@_register
def gaussian_overlap(
    aperture: Metres,
    frequency: RadioFrequency,
    distance: Metres,
    factor: Fraction = 1.0,
) -> float:
    """Common volume of two Gaussian beams of unit volume, erfc(d / (sqrt(8) sigma)), d the
    `beam_shift`.
    """
    sigma = beam_width(aperture, frequency, distance) / math.sqrt(8 * math.log(2))
    return math.erfc(beam_shift(aperture, frequency, distance, factor) / math.sqrt(8) / sigma)


@_register
def overlap_of_smaller(shared: Fraction, large: Metres, small: Metres) -> float:
    """Largest share that beams of a smaller aperture can have in common where those of a larger one
    share ``shared``.

    Separation over width, lambda z / D^2, is (large / small)^2 times as much; the area that two
    equal shapes lose when they are moved apart grows at least in proportion to it as long as it is
    small. Beams far inside their Rayleigh distance.
    """
    return max(0.0, 1 - (1 - shared) * (large / small) ** 2)


@_register
def atmosphere_in_scan(
    atmosphere: Kelvin,
    illumination: Fraction,
    efficiency: Fraction,
    transmission: Fraction = 1.0,
) -> float:
    """Atmosphere alone in the paper's T_scan, eps T_atm / (zeta e^-tau), K_RJ."""
    return illumination * atmosphere / (efficiency * transmission)


@_register
def flux_per_beam(temperature: Kelvin, fwhm: Angle, frequency: RadioFrequency) -> float:
    """Flux of a Rayleigh-Jeans temperature that fills a Gaussian beam, 2 k T nu^2 / c^2 x pi fwhm^2
    / (4 ln 2), W m^-2 Hz^-1.
    """
    return (
        2
        * BOLTZMANN
        * temperature
        * (frequency / LIGHT) ** 2
        * math.pi
        * fwhm**2
        / (4 * math.log(2))
    )


@_register
def hexagonal_diameter(detectors: int, pitch: Angle) -> float:
    """Diameter of a disc that holds detectors on a hexagonal grid, pitch sqrt(2 sqrt(3) n / pi),
    rad.
    """
    return pitch * math.sqrt(2 * math.sqrt(3) * detectors / math.pi)


@_register
def daisy_speed(radius: Angle, speed: AngularSpeed, which: str = "mean") -> float:
    """Speed of the boresight on the paper's daisy, rad/s: mean, least, most, or at the centre of
    the outer term (centre_least, centre_most)."""
    phi = np.linspace(0, 2000 * math.pi, 2_000_001)
    around = np.linspace(-1e-4, 1e-4, 3)
    if which.startswith("centre"):
        phi = (np.arange(1, 2000)[:, None] * math.pi + around).ravel()
    x = _daisy(phi)
    steps = abs(np.diff(x)) / np.diff(phi)
    steps = steps.reshape(-1)[::3] if which.startswith("centre") else steps
    figures = {"mean": float(steps.mean()), "least": float(steps.min()), "most": float(steps.max())}
    if which.removeprefix("centre_") not in figures:
        raise ValueError("which is mean, least, most, centre_least or centre_most")
    return figures[which.removeprefix("centre_")] * speed


@_register
def daisy_reach(radius: Angle) -> float:
    """Largest distance of the boresight from the centre on the paper's daisy, rad."""
    return float(abs(_daisy(np.linspace(0, 2000 * math.pi, 2_000_001))).max()) * radius


def _daisy(phi: Floats) -> Any:
    """The paper's daisy in units of its radius, (n,) complex."""
    n = 10 / math.pi
    return np.sin(phi) * np.exp(1j * phi / n) + 0.15 * np.cos(phi) * np.exp(
        1j * math.sqrt(2) * phi / n
    )


@_register
def white_noise_of_daisy(
    noise: KelvinRootSecond,
    detectors: int,
    field: Angle,
    radius: Angle,
    duration: Seconds,
    fwhm: Angle,
) -> float:
    """White noise in the centre of a beam-smoothed map of the paper's daisy, K.

    ``noise`` of one detector in K sqrt(s), divided by the root of the detector-seconds that a
    Gaussian of 4 pi sigma^2 holds. Detectors fill a disc of the diameter ``field``; the centre is
    seen where the boresight is within that disc of it.
    """
    seen = float(
        (abs(_daisy(np.linspace(0, 2000 * math.pi, 2_000_001))) * radius <= field / 2).mean()
    )
    density = detectors * duration * seen / (math.pi * (field / 2) ** 2)
    return noise / math.sqrt(density * math.pi * fwhm**2 / (2 * math.log(2)))


@_register
def calculator_of_atlast(
    pwv: Metres,
    elevation: Angle,
    seconds: Seconds,
    at: str = "centre",
) -> float:
    """Point-source sensitivity of AtLAST's camera by the formula of the sensitivity calculator,
    with zonda's atmosphere (2022-08-01T23:00, Llano de Chajnantor): ``at`` the band's centre, or
    over the band, W m^-2 Hz^-1."""
    from zonda.core.configuration.time import Instant
    from zonda.core.registry import instruments, sites
    from zonda.operators.atmosphere.weather.sources import profile_of
    from zonda.plugins.forecast.calculator import calculate

    if at not in ("centre", "band"):
        raise ValueError("at is centre or band")
    camera = instruments.create("atlast")
    site = sites.create("llano_de_chajnantor")
    air = profile_of(None, site, Instant.parse("2022-08-01T23:00"), 0).scaled(pwv)
    found = calculate(air.layers, camera.band, camera.telescope.diameter, elevation, seconds)
    return (found.centre if at == "centre" else found.band) * 1e-26


@_register
def total_time(scans: int, duration: Seconds, gap: Seconds = 0.0) -> float:
    """Length of an observation of several scans, s."""
    return scans * duration + (scans - 1) * gap
