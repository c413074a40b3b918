"""Pink noise from f_min on, for any length; the noise that a map states, for every noise model; two
bands of one seed.
"""

from __future__ import annotations

import math
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import zonda
from zonda.core.checks import Family, Measured
from zonda.core.data import Observation
from zonda.core.errors import ZondaError
from zonda.core.numerics.random import stream_key
from zonda.core.registry import noise_models
from zonda.operators.noise.one_over_f import PowerLawFilter, power_law_filter
from zonda.operators.noise.streams import Streams
from zonda.operators.noise.white import WhiteNoise
from zonda.plugins.checks.scenes import camera, largest

from .cases import BANDS, LEVEL, PINK, RED
from .scenes import unrefused

checks = Family("noise")


def _spectrum_error(law: PowerLawFilter, f_min: float, slope: float) -> float:
    """Largest relative error of the response to f^-slope from f_min to the Nyquist frequency."""
    f = np.r_[np.geomspace(f_min, 0.5, 3001), np.linspace(0.9 * 0.5 + 0.1 * f_min, 0.5, 1001)]
    return float(abs(law.response(f) * (f / f_min) ** slope - 1).max())


@checks.add(PINK, reference="1/f", limit=0.02)
def spectrum() -> Measured:
    """largest relative error of the PSD, 8 poles, from f_min = 1e-5 f_s to the Nyquist frequency"""
    law = power_law_filter(1e-5, 1.0, 8)
    return _spectrum_error(law, 1e-5, 1.0), f"stated {law.error:.2g}"


@checks.add(PINK, reference="f^-slope", limit=0.08)
def spectrum_to_lower_frequencies() -> float:
    """largest relative error of the PSD, 10 poles, f_min from 1e-8 to 0.3 f_s, slopes 0.5 to 3"""
    laws = [(f, s) for f in (1e-8, 1e-5, 1e-2, 0.3) for s in (0.5, 1.0, 2.0, 3.0)]
    return largest(*(_spectrum_error(power_law_filter(f, s, 10), f, s) for f, s in laws))


@checks.add(PINK, reference="integral of the PSD", limit=4.5, unit="standard errors")
def a_week() -> Measured:
    """variance of the last day of a week at 10 Hz, f_min 1 mHz, 16 detectors

    Var(sample variance) = 2 int C^2 dt / T for each series, and int C^2 dt = int P^2 df
    (two-sided).
    """
    law, n_det, day = power_law_filter(1e-4, 1.0, 8), 16, 864_000
    streams = Streams(law, stream_key(6, "a"), stream_key(6, "b"))
    out, total = np.zeros((n_det, day), np.float32), 0.0
    for number in range(7):
        out[...] = 0
        streams.add(0, number * day, out)
        total = float((out.astype(np.float64) ** 2).mean())
    f = np.r_[np.linspace(0, 1e-4, 2000, endpoint=False), np.geomspace(1e-4, 0.5, 20_000)]
    power = law.response(f) / law.gain
    error = math.sqrt(2 * 2 * float(np.trapezoid(power**2, f)) / (day * n_det)) / law.variance
    return abs(
        total / law.variance - 1
    ) / error, f"{total / law.variance:.4f} of theory, standard error {error:.4f}"


@checks.add(PINK, reference="no correlation", limit=5, unit="standard errors")
def no_period() -> float:
    """correlation of a first stretch of 200000 samples with the second, and with the seventh: no
    period, no wrap
    """
    law, n_det, day = power_law_filter(1e-2, 1.0, 8), 16, 200_000
    streams = Streams(law, stream_key(6, "a"), stream_key(6, "b"))
    days = []
    for number in (0, 1, 6):
        out = np.zeros((n_det, day), np.float32)
        streams.add(0, number * day, out)
        days.append(out.astype(np.float64) / math.sqrt(law.variance))
    f = np.r_[np.linspace(0, 1e-2, 2000, endpoint=False), np.geomspace(1e-2, 0.5, 20_000)]
    power = law.response(f) / law.gain / law.variance
    error = math.sqrt(
        2 * float(np.trapezoid(power**2, f)) / (day * n_det)
    )  # Bartlett: sum of rho^2 over lags
    return largest(*(float(abs((days[0] * other).mean())) / error for other in days[1:]))


@checks.add(PINK, reference="an error with a cure", limit=0, unit="not refused")
def refusals() -> Measured:
    """f_min above the Nyquist frequency, spectra that so few poles cannot follow"""
    return unrefused(
        [
            (lambda: power_law_filter(0.6, 1.0, 8), "Nyquist"),
            (lambda: power_law_filter(1e-7, 1.0, 4), "poles fit"),
        ]
    )


def over_stated(*white: WhiteNoise, seed: int = 1, **optics: Any) -> tuple[float, float]:
    """std(signal / NOISE) of a map of white noise through 1.5 mm of water at 800 to 900 GHz, and
    its standard error.

    The map less that of the same run without the noise, so that the mean emission is not in it.
    """
    instrument = camera(low="800 GHz", high="900 GHz").model_copy(update={"knee": 0.0})
    scene = zonda.Scene(
        site="chajnantor",
        instrument=instrument,
        time="2024-07-25T03:00",
        target="17h -20d",
        seed=seed,
    )
    steps = [
        zonda.PointingDaisy(radius="4 arcmin", speed="1 arcmin/s", scan_duration="10 s"),
        zonda.AtmosphereLayers(pwv="1.5 mm", pwv_rms="0 %"),
        *white,
        zonda.Efficiency(**optics),
        zonda.BinMap(pixel="2 arcsec", half_difference=False),
    ]
    pipeline = zonda.Pipeline(steps, runs={"quiet": {"without": ["white"], "modes": "full"}})
    products = pipeline.run(scene, threads=1).products
    product, use = products["map"], products["map"].hits > 0
    ratio = (product.signal[use] - products["quiet/map"].signal[use]) / product.noise[use]
    return float(np.sqrt(np.mean(ratio**2))), 1 / math.sqrt(2 * ratio.size)


def levels() -> dict[str, WhiteNoise]:
    """White noise of every reference, and of every registered model that needs no parameters."""
    found = {
        "the instrument's": WhiteNoise(),
        "on the sky": WhiteNoise(net="3 mK s(1/2)", scatter="30 %"),
        "at the detector": WhiteNoise(net="1 mK s(1/2)", reference="detector", scatter="30 %"),
    }
    for name in noise_models:
        with suppress(ZondaError, ValueError):
            found[name] = WhiteNoise(model=name, scatter="30 %")
    return found


@checks.add(LEVEL, reference="1", limit=4.5, unit="standard errors")
def stated() -> Measured:
    """std(signal / NOISE) of maps of white noise, NET on the sky, at the detector, every noise
    model, 850 GHz, 1.5 mm of PWV
    """
    found = {name: over_stated(level, scatter="10 %") for name, level in levels().items()}
    text = ", ".join(f"{name} {ratio:.3f}" for name, (ratio, _) in found.items())
    return largest(*(abs(ratio - 1) / error for ratio, error in found.values())), text


def _two_bands() -> tuple[Observation, Observation]:
    """One scene at 93 and at 225 GHz: the same beams, detectors and seed."""
    found = []
    for low, high in (("78 GHz", "108 GHz"), ("195 GHz", "255 GHz")):
        steps = [
            zonda.PointingDaisy(radius="4 arcmin", speed="1 arcmin/s", scan_duration="30 s"),
            zonda.AtmosphereLayers(pwv="1 mm"),
            zonda.WhiteNoise(),
            zonda.PinkNoise(),
            zonda.Efficiency(),
        ]
        scene = zonda.Scene(
            site="chajnantor",
            instrument=camera(low=low, high=high),
            time="2024-07-25T03:00",
            target="17h -20d",
            seed=1,
        )
        found += (
            zonda.Pipeline(steps)
            .run(scene, threads=1, keep=("white", "pink", "atmosphere"))
            .observations
        )
    return found[0], found[1]


def _correlation(a: Any, b: Any) -> float:
    a, b = (np.asarray(x, np.float64) - x.mean() for x in (a, b))
    return float((a * b).mean() / (a.std() * b.std()))


@checks.add(BANDS, reference="no correlation", limit=4.5, unit="standard errors")
def two_bands() -> Measured:
    """correlation of the white noise, and of pink noise's second differences, of two bands of one
    seed
    """
    one, two = (o.detdata for o in _two_bands())
    white = _correlation(one["white"], two["white"]) * math.sqrt(one["white"].size)
    a, b = (np.diff(o["pink"].astype(np.float64), 2, axis=1) for o in (one, two))
    # of nearly white noise, twice differenced: the sum over lags of rho^2 is 1 + 2 (4/9 + 1/36) =
    # 35/18 (Bartlett)
    pink = _correlation(a, b) / math.sqrt(35 / 18 / a.size)
    return largest(abs(white), abs(pink)), f"white {white:+.2f}, pink {pink:+.2f}"


@checks.add(BANDS, reference="one turbulence", limit=1e-3)
def one_atmosphere() -> float:
    """1 - correlation of the atmosphere's fluctuation at 93 and at 225 GHz, equal beams"""
    one, two = _two_bands()
    return 1 - _correlation(one.detdata["atmosphere"], two.detdata["atmosphere"])


PLANNED = """
site: chajnantor
instrument:
  name: check
  telescope: {{name: dish, diameter: 6 m}}
  band: {{name: b, low: 800 GHz, high: 900 GHz}}
  detectors: 37
  field_of_view: 10 arcmin
  main_beam_efficiency: 0.6
  illumination_efficiency: 0.9
  net: 1 mK s(1/2)
  sample_rate: 50 Hz
time: 2024-07-25T11:00
target: 05h00m00s -20d00m00s
operators:
  - PointingDaisy: {{scan_duration: 20 s, scans: 2, gap: 1 h, radius: 3 arcmin, speed: 1 arcmin/s}}
  - AtmosphereLayers: {{pwv: 1.5 mm, layers: 3}}
  - WhiteNoise: {white}
  - Efficiency
  - BinMap: {{pixel: 8 arcsec}}
"""


@checks.add(LEVEL, reference="the NET of the run, which is simulated", limit=0.02)
def planned() -> float:
    """largest relative difference of the noise of a sample that a plan states, at the detector and
    background-limited, 850 GHz
    """
    worst = 0.0
    for white in ("{net: 1 mK s(1/2), reference: detector}", "{model: background_limited}"):
        with TemporaryDirectory(prefix="zonda-check-") as folder:
            path = Path(folder) / "planned.yaml"
            path.write_text(PLANNED.format(white=white), encoding="utf-8")
            file = zonda.load(path)
            made = zonda.plan(file, threads=1)
        run = file.pipeline().run(file.scene(), threads=1)
        squares = [float(np.mean(o.focalplane.net**2)) * o.sample_rate for o in run.observations]
        worst = largest(worst, abs(made.noise[0] / math.sqrt(np.mean(squares)) - 1))
    return worst


@checks.add(RED, reference="integral of a spectrum that is flat below f_min", limit=0.1)
def variance_below_its_lowest_frequency() -> Measured:
    """largest relative error of the variance, 8 poles, f_min 1e-5 to 1e-2 f_s, slopes 1 to 3: that
    stated, and of the response
    """
    errors = {}
    for f_min in (1e-5, 1e-4, 1e-3, 1e-2):
        for slope in (1.0, 1.5, 2.0, 2.5, 3.0):
            law = power_law_filter(f_min, slope, 8)
            above = (
                math.log(0.5 / f_min)
                if slope == 1
                else (1 - (0.5 / f_min) ** (1 - slope)) / (slope - 1)
            )
            expected = 2 * f_min * (1 + above)
            f = np.r_[0.0, np.geomspace(1e-6 * f_min, 0.5, 400_000)]
            measured = 2 * float(np.trapezoid(law.response(f), f))
            errors[slope, f_min] = largest(
                abs(law.gain * law.variance / expected - 1), abs(measured / expected - 1)
            )
    slope, f_min = max(errors, key=lambda key: errors[key])
    return largest(*errors.values()), f"largest: slope {slope:g}, f_min {f_min:g} f_s"
