"""Bounds of effects that have no coarser form in the pipeline, against the effect itself computed
directly.
"""

import math

import numpy as np
import pytest

import zonda
from zonda.core.data import Data
from zonda.core.instrument import Band
from zonda.core.plan.bounds import Context, Coverage
from zonda.core.plan.planning import planning_of
from zonda.operators.atmosphere.planning import Calibrated, _slope, calibrated
from zonda.operators.atmosphere.weather.bands import BandAtmosphere, BandTransfer
from zonda.operators.filters.brick_wall import plan_highpass
from zonda.operators.pointing.planning import STEEPEST
from zonda.operators.sky.planning import CUBIC, chromaticity

FWHM = 8.0
SIGMA = FWHM / math.sqrt(8 * math.log(2))


def gaussian(x):
    return np.exp(-((x / SIGMA) ** 2) / 2)


@pytest.fixture(scope="module")
def context():
    scene = zonda.load("mustang2_cluster").scene()
    data = Data(scene)
    zonda.PointingDaisy(scan_duration="100 s").observe(data)
    found = Context(scene, data.observations, [], metrics=frozenset({"peak", "transfer"}))
    found.coverage = Coverage(100.0, math.radians(2 / 3600), math.radians(50 / 3600))
    return found


@pytest.mark.parametrize("shift", [0.001, 0.1, 1.0, 3.0])
def test_a_shift_of_the_beam(shift):
    x = np.linspace(-30, 30, 60001)
    error = np.abs(gaussian(x + shift) - gaussian(x)).max()
    assert error <= STEEPEST * shift / FWHM
    if shift <= 0.1:
        assert error == pytest.approx(STEEPEST * shift / FWHM, rel=1e-2)


def test_sample_integration(context):
    """A point source seen for a while in passing, against an instant: the loss of its peak."""
    o = context.first
    speed, fwhm = context.coverage.speed, float(o.focalplane.fwhm.min())
    rows = {e.name: e for e in planning_of(zonda.PointingDaisy()).estimate(context).effects}
    length = speed / o.sample_rate / fwhm * FWHM
    x = np.linspace(-length / 2, length / 2, 10001)
    loss = 1 - np.trapezoid(gaussian(x), x) / length
    bound = rows["sample integration"].choices[0].bound["transfer"]
    assert loss <= bound
    assert loss == pytest.approx(bound, rel=0.01)


def test_sky_rotation_and_reach(context):
    rows = {e.name: e for e in planning_of(zonda.PointingDaisy()).estimate(context).effects}
    psi = np.unwrap(context.first.derotate("boresight_radec")[2])
    radius = context.first.focalplane.radius
    moved = 2 * math.sin((psi.max() - psi.min()) / 2) * radius  # of the outermost detector
    fwhm = float(context.first.focalplane.fwhm.min())
    x = np.linspace(-30, 30, 60001)
    error = np.abs(gaussian(x + moved / fwhm * FWHM) - gaussian(x)).max()
    assert error <= rows["sky rotation"].size["transfer"] + 1e-12
    assert rows["time stamps"].size["transfer"] < 1e-9


def test_differential_refraction(context):
    """Bennett's formula, which the bound does not use, over the elevations of the scan and the
    field.
    """
    rows = {e.name: e for e in planning_of(zonda.PointingDaisy()).estimate(context).effects}

    def bennett(elevation):
        h = np.degrees(elevation)
        return np.radians(1 / np.tan(np.radians(h + 7.31 / (h + 4.4))) / 60) * math.exp(
            -context.scene.site.altitude / 8000
        )

    low = context.first.elevation.min() - context.first.focalplane.radius
    high = context.first.elevation.max() + context.first.focalplane.radius
    shift = bennett(low) - bennett(high)
    bound = rows["refraction"].choices[0].bound["transfer"]
    assert min(STEEPEST * shift / float(context.first.focalplane.fwhm.min()), 1.0) <= bound


def test_aberration_across_the_field():
    """Two directions 1 deg apart seen from a moving Earth: their separation changes by less than v
    / c of it.
    """
    beta = 1.0e-4
    for theta in np.linspace(0.1, 3.0, 30):
        pair = theta + np.array([0.0, math.radians(1)])
        seen = np.arccos((np.cos(pair) + beta) / (1 + beta * np.cos(pair)))
        assert abs(np.diff(seen)[0] - np.diff(pair)[0]) <= 1.001 * beta * np.diff(pair)[0]


def test_cubic_sampling():
    """A point source on 4 points per FWHM, two-dimensional, at every offset between the points."""
    from scipy.ndimage import map_coordinates

    n = 41
    sigma = 4 / math.sqrt(8 * math.log(2))
    y, x = np.mgrid[:n, :n]
    image = np.exp(-((x - 20) ** 2 + (y - 20) ** 2) / (2 * sigma**2))
    at = np.linspace(16, 24, 65)
    py, px = np.meshgrid(at, at, indexing="ij")
    exact = np.exp(-((px - 20) ** 2 + (py - 20) ** 2) / (2 * sigma**2))
    cubic = np.abs(map_coordinates(image, [py, px], order=3, mode="mirror") - exact).max()
    assert 0.5 * CUBIC < cubic <= CUBIC


@pytest.mark.parametrize("name", ["mustang2_90ghz", "so_145ghz", "laboca_345ghz"])
def test_chromaticity(name):
    """A point source through beams of FWHM ~ 1 / nu, each of unit integral, against the one of the
    centre: at the peak.
    """
    from zonda.core.registry import bands

    band = bands.create(name)
    nu, t = band.frequency, band.transmission
    peaks = (nu / band.centre) ** 2  # of beams of unit integral
    error = abs(np.trapezoid(t * peaks, nu) / np.trapezoid(t, nu) - 1)
    assert error == pytest.approx(chromaticity(band), abs=1e-12)
    x = np.linspace(0, 3 * FWHM, 2000)
    beams = peaks[:, None] * np.exp(-(x**2) * peaks[:, None] / (2 * SIGMA**2))
    mean = np.trapezoid(t[:, None] * beams, nu, axis=0) / np.trapezoid(t, nu)
    assert np.abs(mean - gaussian(x)).max() <= 1.05 * chromaticity(band) + 1e-6


# ---- filters


@pytest.mark.parametrize("knots", [8, 12, 16])
def test_the_low_part_of_the_high_pass_filter(knots):
    """Slow noise through coarse and fine knots: (f / f_cut)^4 q^-4 below the cut, at most q^-4 of
    the rms.
    """
    n, frequency = 1 << 16, 0.1 / 100
    rng = np.random.default_rng(5)
    amplitude = rng.standard_normal((4, n // 2 + 1)) * (np.fft.rfftfreq(n) < 0.9 * frequency)
    x = np.fft.irfft(amplitude, n)
    x /= x.std()
    fine, coarse = x.copy(), x.copy()
    plan_highpass(n, frequency, 3, 24.0).apply(fine)
    plan_highpass(n, frequency, 3, float(knots)).apply(coarse)
    assert (coarse - fine).std() <= knots**-4.0 + 24**-4.0


# ---- air


@pytest.fixture(scope="module")
def sky():
    file = zonda.load(
        "mustang2_cluster", overrides=["PointingDaisy.scan_duration=20 s", "PointingDaisy.scans=1"]
    )
    operator, data = file.operators[2], Data(file.scene())
    file.operators[0].observe(data)
    operator.observe(data)
    return operator, data.observations[0], calibrated(operator.model(data.observations[0]))


def test_the_rms_of_the_fluctuation(sky):
    """Equation (1) against the streams of many seeds, whose mean square is the ensemble's."""
    operator, o, a = sky
    share = float((o.focalplane.illumination_efficiency / o.focalplane.main_beam_efficiency)[0])
    seen = []
    for seed in range(24):
        o.seed = seed
        state = operator.prepare(o)
        values = np.empty((1, o.n_samples))
        state.into(slice(0, 1), slice(0, o.n_samples), {"emission": values})
        seen.append(float((values.astype(float) ** 2).mean()))
    o.seed = 20241125
    transmission = float(a.model.band.transmission(a.model.pwv, a.elevations[0]))
    rms = math.sqrt(np.mean(seen)) * share / transmission
    error = np.std(seen) / math.sqrt(len(seen)) / (2 * np.mean(seen))
    assert rms == pytest.approx(a.rms, rel=3 * error + 0.02)


def test_one_frequency_and_no_ozone(sky):
    """The slopes that the bounds compare, against the tabulated atmosphere of the band itself."""
    _, o, a = sky
    m = a.model
    band, elevation = o.instrument.band, a.elevations[0]
    right = _slope(BandTransfer(band, m.profile.layers), m.pwv, elevation)
    step = 1e-3 * m.pwv
    table = (
        float(m.band.emission_difference(m.pwv, step, elevation))
        / step
        / float(m.band.transmission(m.pwv, elevation))
    )
    assert right == pytest.approx(table, rel=2e-3)
    narrow = Band(
        name="middle", low=f"{band.centre - 0.25e9!r} Hz", high=f"{band.centre + 0.25e9!r} Hz"
    )
    one = BandAtmosphere(narrow, m.profile, 2 * m.pwv)
    alone = (
        float(one.emission_difference(m.pwv, step, elevation))
        / step
        / float(one.transmission(m.pwv, elevation))
    )
    bound = _slope(BandTransfer(narrow, m.profile.layers), m.pwv, elevation)
    assert alone == pytest.approx(bound, rel=2e-3)


@pytest.mark.parametrize("speed", [3.0, 30.0])
def test_what_of_the_air_is_faster_than_a_frequency(speed):
    """The spectrum of exp(-(v t)^2 / 4 e), by a numerical transform, against the share erfc(2 pi f
    sqrt(e) / v).
    """
    from zonda.operators.atmosphere.turbulence.nodes import Layer

    model = Layer(1.0, 1000.0, 1000.0, 500.0, 40.0)
    a = Calibrated([model], [1.0], 1.0, 0.0, [np.array([[speed], [0.0]])], None, (0.7, 0.8))
    t = np.arange(1 << 16) * 0.05
    e, w = model.gaussian()
    covariance = np.exp(-np.multiply.outer(t**2 * speed**2, 1 / (4 * e))) @ w
    spectrum = 2 * (np.fft.rfft(np.r_[covariance, covariance[-2:0:-1]]).real) * 0.05  # one-sided
    f = np.fft.rfftfreq(2 * len(t) - 2, 0.05)
    for frequency in (0.02, 0.1, 0.3):
        # trapezoids from the frequency on, which lies between two bins. The steepest end is at 3
        # m/s and 0.02 Hz, where ln erfc falls by 3.8 x 2 pi df 40 m / v = 0.05 from bin to bin:
        # trapezoids err by 0.05^2 / 12 = 2e-4
        bins = np.r_[frequency, f[f > frequency]]
        share = np.trapezoid(np.interp(bins, f, spectrum), bins)
        assert a.faster(0, frequency) ** 2 == pytest.approx(share, rel=1e-3, abs=1e-9)
