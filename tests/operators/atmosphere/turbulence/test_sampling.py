"""Compiled geometry, sampling and response against their direct forms."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from zonda.core.configuration.time import Instant
from zonda.core.data import Observation
from zonda.core.errors import ZondaError
from zonda.core.instrument import Band, Instrument, Telescope
from zonda.core.numerics.smooth import SPLINE_MARGIN, spline_coefficients
from zonda.core.site import Site
from zonda.operators.atmosphere.response import Response, airmass
from zonda.operators.atmosphere.turbulence.geometry import axes, crossing, rays, scan_planes
from zonda.operators.atmosphere.turbulence.lattice import Turbulence
from zonda.operators.atmosphere.turbulence.lines_of_sight import LinesOfSight
from zonda.operators.atmosphere.turbulence.sampling import Drifting, DriftingLayers
from zonda.operators.atmosphere.weather.bands import BandAtmosphere
from zonda.operators.atmosphere.weather.sources import profile_of

_spec = importlib.util.spec_from_file_location("direct", Path(__file__).parents[1] / "direct.py")
assert _spec
assert _spec.loader
direct = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(direct)

Floats = NDArray[np.float64]
SITE = Site(
    name="here",
    latitude="-23.0193 deg",
    longitude="-67.7532 deg",
    altitude="5050 m",
    climatology="chajnantor",
)
BAND = Band(name="b", low="140 GHz", high="160 GHz")
SCANS = {
    "transverse": ("0.1 deg", 50.0, 0.3),
    "cone": ("8 deg", 45.0, 40.0),
    "far": ("35 deg", 50.0, 60.0),
    "horizontal": ("1 deg", 50.0, 350.0),
}
"""Field, elevation [deg], throw [deg] of azimuth."""


def observation(field: str, elevation: float, throw: float, samples: int = 1200) -> Observation:
    camera = Instrument(
        name="camera",
        telescope=Telescope(name="dish", diameter="6 m"),
        band=BAND,
        detectors=37,
        field_of_view=field,
        main_beam_efficiency=0.3,
        illumination_efficiency=0.8,
        net="1 mK s(1/2)",
        sample_rate="100 Hz",
    )
    t = np.arange(samples) / 100
    azimuth = np.radians(100 + throw / 2 * np.sin(2 * np.pi * np.arange(samples) / samples))
    a, b = -azimuth / 2, (np.pi / 2 - np.radians(elevation + 0.1 * np.sin(t))) / 2
    q = np.stack(
        [
            -np.sin(a) * np.sin(b),
            np.cos(a) * np.sin(b),
            np.sin(a) * np.cos(b),
            np.cos(a) * np.cos(b),
        ],
        axis=1,
    )
    start = Instant.parse("2022-08-01T23:00:00Z")
    return Observation(
        "scan", 0, SITE, camera, camera.focalplane(), start, t, 100.0, q, q, (0.0, 0.0), 1
    )


@pytest.mark.parametrize("kind", SCANS)
def test_positions_and_elevations_are_those_of_the_geometry(kind: str) -> None:
    o = observation(*SCANS[kind])
    track = scan_planes([o])[0]
    assert track.kind == {"far": "cone"}.get(kind, kind)
    path = LinesOfSight(o, track, 8, -20, 200)
    xi, eta = o.focalplane.xi, o.focalplane.eta
    x, y, sine = path(xi, eta, 0, 150)
    u = rays(axes(o.boresight_azel[:1200:8]), xi, eta)
    expected = track.unroll(crossing(u))
    # 1e-9 per metre of height from each of the polynomials of equation (1); the quotient on one
    # plane has rounding only.
    atol = 1e-8 if track.cone else 1e-13
    np.testing.assert_allclose(x, expected[0], atol=atol)
    np.testing.assert_allclose(y, expected[1], atol=atol)
    np.testing.assert_allclose(sine, u[2], atol=1e-13)
    assert path.low <= sine.min() < sine.max() <= path.high
    some = path(xi[5:9], eta[5:9], 40, 10)
    for part, everything in zip(some, (x, y, sine), strict=True):
        np.testing.assert_array_equal(part, everything[5:9, 40:50])


def test_times_outside_the_path_are_refused() -> None:
    o = observation(*SCANS["cone"])
    path = LinesOfSight(o, scan_planes([o])[0], 8, -20, 200)
    with pytest.raises(ValueError, match="outside"):
        path(o.focalplane.xi, o.focalplane.eta, 100, 100)


@pytest.mark.parametrize("kind", SCANS)
@pytest.mark.parametrize("spacing", [4, 16])
def test_layers_are_those_of_the_lattice_at_the_positions(kind: str, spacing: int) -> None:
    o = observation(*SCANS[kind])
    track = scan_planes([o])[0]
    field = Turbulence(1, "air", outer_scale=500.0, sigma=2.6)
    other = Turbulence(1, "more", outer_scale=500.0, sigma=3.1)
    wind = np.array([7.0, -3.0])
    drifting = [
        Drifting(field, 800.0, 0.7, wind, 4),
        Drifting(other, 3000.0, 0.3, 2 * wind, spacing),
    ]
    xi, eta = o.focalplane.xi, o.focalplane.eta
    layers = DriftingLayers(o, track, (xi, eta), drifting, 4, (-30, 330))
    assert (layers.cells > 1e4) is True
    total, sine = layers(xi, eta, 0, 300)
    u = rays(axes(o.boresight_azel[::4]), xi, eta)
    np.testing.assert_allclose(sine, u[2], atol=1e-13)
    expected = np.zeros(total.shape)
    coarse = np.zeros(total.shape)
    for layer in drifting:
        at = track.positions(crossing(u), o.seconds[::4], layer.height, layer.wind)
        values = layer.amplitude * direct.at_points(layer.field, *at)
        if layer.step == 4:
            expected += values
        else:
            coarse += values
    # float32 lattices; a layer with a coarser step is a spline through its own times, which it
    # passes through.
    np.testing.assert_allclose((total - expected - coarse)[:, :: spacing // 4], 0, atol=2e-6)
    if spacing == 4 or kind == "transverse":  # the other scans are so fast that 0.16 s is far apart
        assert np.sqrt(np.mean((total - expected - coarse) ** 2)) < (1e-6 if spacing == 4 else 1e-3)


def test_a_scan_that_sweeps_over_too_much_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    from zonda.operators.atmosphere.turbulence import sampling

    monkeypatch.setattr(sampling, "CELLS_IN_ALL", 1e4)
    o = observation(*SCANS["cone"])
    field = Turbulence(1, "air", outer_scale=500.0, sigma=2.6)
    with pytest.raises(ZondaError, match=r"sweep over .* lattice points .* limit is 1e\+04"):
        DriftingLayers(
            o,
            scan_planes([o])[0],
            (np.zeros(1), np.zeros(1)),
            [Drifting(field, 800.0, 1.0, np.zeros(2), 4)],
            4,
            (-30, 330),
        )


def test_spline_coefficients_are_scipys_and_local() -> None:
    from scipy.ndimage import spline_filter1d

    values = np.random.default_rng(0).standard_normal((3, 200)).cumsum(1)
    exact = spline_filter1d(values, 3, axis=1, mode="mirror")
    got = spline_coefficients(values)
    assert got.shape == (3, 200 - 2 * SPLINE_MARGIN)
    # 0.268^13 of differences between neighbours of order 1, mirrored at the ends.
    np.testing.assert_allclose(got[:, 12:-12], exact[:, 24:-24], atol=1e-5)
    np.testing.assert_array_equal(spline_coefficients(values[:, 30:90]), got[:, 30:66])


@pytest.fixture(scope="module")
def band() -> Any:
    profile = profile_of(None, SITE, Instant.parse("2022-08-01T23:00:00Z"), 1, 1e-3)
    return BandAtmosphere(BAND, profile, 3e-3)


@pytest.mark.parametrize(("rms", "low"), [(0.005, 0.7), (0.05, 0.5), (0.05, 0.09), (0.12, 0.2)])
def test_the_response_is_that_of_the_band(band: Any, rms: float, low: float) -> None:
    names = ("emission", "transmission", "opacity", "pwv", "path_delay")
    response = Response(band, 1e-3, (-8 * rms, 8 * rms), (low, low + 0.1), 1500.0, 6.5, names)
    assert all(c is not None for c in response._coefficients.values())
    rng = np.random.default_rng(1)
    y, s = rms * rng.standard_normal((4, 50)), low + 0.1 * rng.random((4, 50))
    elevation = np.arcsin(s)
    depth = band.log_transmission_difference(1e-3, 1e-3 * y, elevation)
    expected = {
        "emission": band.emission_difference(1e-3, 1e-3 * y, elevation),
        "transmission": np.expm1(depth),
        "opacity": -depth,
        "pwv": 1e-3 * y * airmass(elevation, 1500.0),
        "path_delay": 6.5e-3 * y * airmass(elevation, 1500.0),
    }
    for name in names:
        largest = abs(expected[name] / y).max()
        # ERROR = 1e-5 of the largest f / y, at points that the fit was not made from: twice that.
        assert abs((response(name, y, s) - expected[name]) / y).max() < 2e-5 * largest
        assert not response(name, np.zeros((1, 3)), s[:1, :3]).any()
        far = np.array([[9 * rms, 0.0]])
        np.testing.assert_allclose(
            response(name, far, s[:1, :2])[0, 0], _at(band, name, 9 * rms, s[0, 0]), rtol=1e-9
        )


def _at(band: Any, name: str, y: float, s: float) -> float:
    elevation = np.arcsin(s)
    depth = float(band.log_transmission_difference(1e-3, 1e-3 * y, elevation))
    column = 1e-3 * y * float(airmass(elevation, 1500.0))
    return {
        "emission": float(band.emission_difference(1e-3, 1e-3 * y, elevation)),
        "transmission": float(np.expm1(depth)),
        "opacity": -depth,
        "pwv": column,
        "path_delay": 6.5 * column,
    }[name]


def test_wide_ranges_are_left_to_the_band(band: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from zonda.operators.atmosphere import response as module

    monkeypatch.setattr(module, "_DEGREES", ((2, 2), (3, 3)))
    response = Response(band, 1e-5, (-1.0, 250.0), (0.3, 0.6), 1500.0, 6.5, ("emission",))
    assert any(c is None for c in response._coefficients.values())
    y, s = np.array([[-0.9, 0.0, 100.0]]), np.array([[0.4, 0.5, 0.55]])
    np.testing.assert_array_equal(
        response("emission", y, s), band.emission_difference(1e-5, 1e-5 * y, np.arcsin(s))
    )


@pytest.mark.parametrize(
    ("field", "elevation", "throw"),
    [("30 deg", 74.0, 20.0), ("12 deg", 83.0, 5.0), ("6 deg", 17.0, 60.0)],
)
def test_the_polynomials_hold_near_the_zenith_and_the_horizon(
    field: str, elevation: float, throw: float
) -> None:
    o = observation(field, elevation, throw, 400)
    track = scan_planes([o])[0]
    if track.kind != "cone":
        pytest.fail(f"{track.kind}: nothing is shown")
    path = LinesOfSight(o, track, 8, 0, 50)
    x, y, _ = path(o.focalplane.xi, o.focalplane.eta, 0, 50)
    expected = track.unroll(
        crossing(rays(axes(o.boresight_azel[::8]), o.focalplane.xi, o.focalplane.eta))
    )
    np.testing.assert_allclose(np.stack([x, y]), expected, atol=2e-8)


def test_what_no_polynomial_follows_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    from zonda.operators.atmosphere.turbulence import lines_of_sight as module

    o = observation(*SCANS["far"], samples=400)
    monkeypatch.setattr(module, "_DEGREES", (4,))  # of 35 deg, which wants 20
    with pytest.raises(ZondaError, match=r"so close to the horizon .* of the height at best"):
        LinesOfSight(o, scan_planes([o])[0], 8, 0, 50)
