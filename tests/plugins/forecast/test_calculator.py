"""The formula of the AtLAST sensitivity calculator."""

import math
import warnings

import numpy as np
import pytest

import zonda
from zonda.core.configuration.time import Instant
from zonda.core.instrument import Band
from zonda.core.numerics.radiation import BOLTZMANN, PLANCK
from zonda.core.registry import sites
from zonda.operators.atmosphere.weather.climatology import profile
from zonda.plugins.forecast.calculator import calculate, system_flux


def layers(pwv):
    return profile(
        sites.create("llano_de_chajnantor"), Instant.parse("2022-08-01T23:00"), pwv
    ).layers


def flat(low, high):
    return Band(name="flat", low=f"{low} GHz", high=f"{high} GHz")


def test_system_flux_by_hand():
    nu, tau, zenith = np.array([92e9]), np.array([0.05]), np.array([12.0])
    passed = math.exp(-0.05 / math.sin(1.0))
    x, cold = PLANCK * 92e9 / BOLTZMANN, 2.72548
    background = x / math.expm1(x / cold)
    warm = x / math.expm1(x / 270)
    sky = (1 - passed) * 12.0 / (1 - math.exp(-0.05)) + passed * background
    system = (5 * x + 0.95 * sky + 0.05 * warm) / (0.95 * passed)
    ruze = math.exp(-((4 * math.pi * 25e-6 * 92e9 / 299792458.0) ** 2))
    aperture = 0.8 * 0.95 * 0.995 * 0.94 * ruze * math.pi * 25.0**2
    assert system_flux(nu, tau, zenith, 50.0, 1.0)[0] == pytest.approx(
        2 * BOLTZMANN * system / aperture, rel=1e-9
    )


def test_a_narrow_band_is_its_centre():
    found = calculate(layers(1e-3), flat(91.9, 92.1), 50.0, 1.0, 100.0)
    assert found.band == pytest.approx(found.centre, rel=1e-3)


def test_it_falls_with_time_and_dish_and_rises_with_water():
    reference = calculate(layers(1e-3), flat(80, 100), 50.0, 1.0, 100.0)
    later = calculate(layers(1e-3), flat(80, 100), 50.0, 1.0, 400.0)
    assert later.centre == pytest.approx(reference.centre / 2)
    assert later.band == pytest.approx(reference.after(400.0).band)
    assert calculate(layers(1e-3), flat(80, 100), 100.0, 1.0, 100.0).band == pytest.approx(
        reference.band / 4
    )
    assert calculate(layers(5e-3), flat(80, 100), 50.0, 1.0, 100.0).band > 1.05 * reference.band


def test_figures_of_the_paper():
    """Version 2.0.0a3 of the calculator gives 12.38 uJy for AtLAST's 66 to 118 GHz in 516 s, at the
    centre of the band; the paper quotes 13.97. The atmosphere is not the same: am's of the plateau
    there, the climatology's of that hour here."""
    found = calculate(layers(None), flat(66, 118), 50.0, math.radians(57.3), 516.0)
    assert found.centre * 1e6 == pytest.approx(12.38, rel=0.04)
    assert found.band > 1.1 * found.centre
    assert found.centre < 13.97e-6 < found.band


def test_beside_the_forecast():
    file = zonda.load(
        "atlast_reduced", ["PointingDaisy.scans=1", "PointingDaisy.scan_duration=10 s"]
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the paper's daisy is too fast for the telescope
        found = zonda.sensitivity(file, integration="516 s")
    assert found.calculated.seconds == 516
    assert found.calculated.centre * 1e6 == pytest.approx(12.6, rel=0.02)
    assert "AtLAST sensitivity calculator" in str(found)
