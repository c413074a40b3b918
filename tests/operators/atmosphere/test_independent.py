"""End to end, against the paper's equations written out afresh: no product function appears on the
expected side.

Geometry here is plain vectors in (east, north, up); the covariance is a Hankel integral over the
von Karman spectrum times the footprint's transform. Streams come from `Pipeline.run` with `outputs`
kept.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import j0, j1

import zonda
from zonda.core.data import Observation
from zonda.core.instrument import Band
from zonda.core.numerics.random import lattice_normals, stream_key
from zonda.operators.atmosphere.turbulence.lattice import Turbulence

from ...checks.implied import implied_covariance
from .test_layers import PWV, instrument, observe, quaternions

Floats = NDArray[np.float64]
NU = 5 / 6


# -------------------------------------------------------------------------------------------------
# written from the paper


def rays_of(azimuth: Floats, elevation: Floats, xi: float, eta: float) -> Floats:
    """Unit vectors (3, n): xi towards growing azimuth, eta up, on the plane tangent to the
    boresight.
    """
    azimuth, elevation = np.broadcast_arrays(azimuth, elevation)
    s, c, up, level = np.sin(azimuth), np.cos(azimuth), np.sin(elevation), np.cos(elevation)
    v = (
        np.array([s * level, c * level, up])
        + xi * np.array([c, -s, 0 * s])
        + eta * np.array([-s * up, -c * up, level])
    )
    return np.asarray(v / np.linalg.norm(v, axis=0), np.float64)


def full_width(diameter: float, frequency: float, z: float) -> float:
    """D sqrt(z^-2 + z_r^-2) rad at distance z, in metres."""
    rayleigh = math.pi * (diameter / 2) ** 2 * frequency / 299792458
    return diameter * z * math.sqrt(z**-2 + rayleigh**-2)


def footprint(k: Floats, width: float, beam: str) -> Floats:
    """Transform of the Gaussian of FWHM ``width``, or of the disc of that diameter."""
    if beam == "gaussian":
        return np.asarray(np.exp(-((k * width) ** 2) / (16 * math.log(2))), np.float64)
    x = np.maximum(k * width / 2, 1e-9)
    return np.asarray(2 * j1(x) / x, np.float64)


def hankel(r: float, r0: float, width: float, beam: str = "gaussian") -> tuple[float, float]:
    """(C(r), C(0) - C(r)): int k dk / 2 pi P(k) B(k)^2 J_0(k r) with P = 4 pi nu r0^(-2 nu) (k^2 +
    r0^-2)^(-nu-1).
    """
    u = np.linspace(math.log(1e-5 / r0), math.log(400 / width), 40001)
    k = np.exp(u)
    density = (
        2
        * NU
        * r0 ** (-2 * NU)
        * (k * k + r0**-2) ** (-NU - 1)
        * footprint(k, width, beam) ** 2
        * k
        * k
    )
    return float(np.trapezoid(density * j0(k * r), u)), float(
        np.trapezoid(density * (1 - j0(k * r)), u)
    )


def streams(observations: list[Observation], bench: Any, **parameters: Any) -> list[Observation]:
    air = zonda.AtmosphereLayers(
        **{
            "pwv": "7.7 mm",
            "outputs": ["pwv", "opacity", "path_delay"],
            "tolerance": "0.1 %",
            **parameters,
        }
    )
    keep = ("pwv", "opacity", "path_delay", "atmosphere", "transmission")
    return bench.run([air], observations, keep=keep, precision="float64").observations


def shell_airmass(elevation: Any, height: float) -> Any:
    return 1 / np.sqrt(1 - (np.cos(elevation) / (1 + height / 6.371e6)) ** 2)


def relative(o: Observation, elevation: Any, height: float, rms: float, pwv: float = PWV) -> Floats:
    """The stream ``pwv`` in units of the rms asked for."""
    return np.asarray(o.detdata["pwv"] / (pwv * rms * shell_airmass(elevation, height)), np.float64)


def mean_and_error(values: Floats, pieces: int = 40) -> tuple[float, float]:
    """Mean, and its standard error from the scatter of ``pieces`` stretches, each many outer scales
    long.
    """
    parts = values[: len(values) // pieces * pieces].reshape(pieces, -1).mean(1)
    return float(parts.mean()), float(parts.std(ddof=1) / math.sqrt(pieces))


# ------------------------------------------------------------------------------------- separations,
# drift, footprints


@pytest.mark.parametrize(
    ("elevation", "azimuth", "wind_from", "throw"),
    [
        (30.0, 130.0, 70.0, 0.0),
        (50.0, 0.0, 180.0, 0.0),
        (80.0, 200.0, 33.0, 0.0),
        (40.0, 0.0, 90.0, 1.0),
    ],
)
def test_lagged_structure_functions(
    bench: Any, elevation: float, azimuth: float, wind_from: float, throw: float
) -> None:
    # Any two detectors, now and 1.5 s later: the air has moved on by 1.5 s of the wind (from
    # ``wind_from``), and what counts is the separation across the line of sight. r0 = 30 m, so 6000
    # s hold some 1000 pieces of air; 4.5 standard errors are allowed (some 50 values are compared).
    # The last case scans 1 deg back and forth across azimuth 0, with and against the wind.
    height, r0, speed, rms = 1000.0, 30.0, 10.0, 0.01
    t = np.arange(12000) * 0.5
    el = math.radians(elevation)
    z = height / math.sin(el)
    az = math.radians(azimuth) + math.radians(throw) * (2 * np.abs(t / 40 % 1 * 2 - 1) - 1)
    xi, eta = np.array([0.0, 15.0, 0.0, 9.0]) / z, np.array([0.0, 0.0, 15.0, -9.0]) / z
    o = observe(6000.0, 2.0, camera=instrument(diameter="1 m"), offsets=(xi, eta), seed=5)
    o.boresight_azel = quaternions(az % (2 * np.pi), np.full(len(t), el))
    wind = {"speed": f"{speed} m/s", "direction": f"{wind_from} deg"}
    (o,) = streams(
        [o], bench, layers=1, lowest=f"{height} m", outer_scale=f"{r0} m", wind=wind, pwv_rms=rms
    )
    rays = [rays_of(az, np.full(len(t), el), x, e) for x, e in zip(xi, eta, strict=True)]
    y = np.array([relative(o, np.arcsin(u[2]), height, rms)[k] for k, u in enumerate(rays)])
    n = rays_of(np.array(math.radians(azimuth)), np.array(el), 0.0, 0.0)
    drift = -speed * np.array(
        [math.sin(math.radians(wind_from)), math.cos(math.radians(wind_from)), 0.0]
    )
    width = full_width(
        1.0, 93e9, z
    )  # far beyond the Rayleigh distance: as wide as the slant path is long
    grid = np.linspace(0, 120, 61)
    s_of = np.array([hankel(r, r0, width)[1] for r in grid])
    for lag in (0, 3):
        first, later = slice(0, len(t) - lag), slice(lag, len(t))
        for i, one in enumerate(rays):
            for j, two in enumerate(rays):
                if lag == 0 and j <= i:
                    continue
                apart = (
                    height * (two / two[2])[:, later]
                    - height * (one / one[2])[:, first]
                    - drift[:, None] * lag / 2
                )
                r = np.linalg.norm(apart - (n @ apart) * n[:, None], axis=0)
                if np.median(r) < 5:
                    continue
                found, error = mean_and_error((y[i, first] - y[j, later]) ** 2 / 2)
                expected = float(np.interp(r, grid, s_of).mean())
                assert error < 0.06 * expected
                assert abs(found - expected) < 4.5 * error, (lag, i, j, float(np.median(r)))


def test_a_detector_downwind_sees_in_the_next_scan_what_another_saw_a_minute_before(
    bench: Any,
) -> None:
    # Two scans that begin 60 s apart, wind 0.5 m/s from 230 deg: the air has moved by 30 m towards
    # 50 deg. A detector whose line of sight crosses the layer there sees the very same samples. Not
    # 30 m upwind, and not in the same direction.
    height, el, az = 1500.0, math.radians(50.0), math.radians(120.0)
    here = rays_of(np.array(az), np.array(el), 0.0, 0.0)
    offsets = [(0.0, 0.0)]
    for sign in (1, -1):
        target = height * here / here[2] + sign * 30 * np.array(
            [math.sin(math.radians(50)), math.cos(math.radians(50)), 0.0]
        )
        target /= np.linalg.norm(target)
        right, up = (
            rays_of(np.array(az), np.array(el), 1e9, 0.0),
            rays_of(np.array(az), np.array(el), 0.0, 1e9),
        )
        offsets.append(
            (float(target @ right / (target @ here)), float(target @ up / (target @ here)))
        )
    xi, eta = np.array(offsets).T
    camera = instrument(diameter="6 m")
    scans = [
        observe(
            20.0,
            10.0,
            50.0,
            120.0,
            camera=camera,
            offsets=(xi, eta),
            index=k,
            start=f"2024-11-25T07:0{k}:00Z",
        )
        for k in (0, 1)
    ]
    wind = {"speed": "0.5 m/s", "direction": "230 deg"}
    first, second = streams(
        scans, bench, layers=1, lowest="1500 m", outer_scale="100 m", wind=wind, pwv_rms=0.01
    )
    elevation = np.arcsin([rays_of(np.array(az), np.array(el), x, e)[2] for x, e in offsets])[
        :, None
    ]
    a, b = (relative(o, elevation, height, 0.01) for o in (first, second))
    np.testing.assert_allclose(b[1], a[0], atol=1e-3)
    np.testing.assert_allclose(b[0], a[2], atol=1e-3)
    assert abs(b[2] - a[0]).max() > 0.05


@pytest.mark.parametrize(
    ("beam", "diameter"), [("gaussian", 1.0), ("gaussian", 6.0), ("top_hat", 25.0)]
)
def test_ten_layers_add_up_to_the_rms_asked_for(bench: Any, beam: str, diameter: float) -> None:
    # Variance of the whole and structure function of two lines of sight, each the sum over layers
    # of a_l^2 times the layer's own, with a_l from the profile's vapour density, and the paper's
    # width at each layer's distance (a 1 m telescope sees layers far beyond its Rayleigh distance
    # of 244 m through columns up to 23 m wide). r0 = 20 m and winds of some 10 m/s: 8000 s.
    r0, el, rms = 20.0, math.radians(60.0), 0.01
    angle = 4.0 / (1500 / math.sin(el))
    o = observe(
        8000.0,
        0.25,
        60.0,
        0.0,
        camera=instrument(diameter=f"{diameter} m"),
        offsets=([0.0, angle], [0.0, 0.0]),
        seed=6,
    )
    profile = zonda.AtmosphereLayers(pwv="7.7 mm").model(o).profile
    heights = np.linspace(500.0, 5000.0, 10)
    vapour = np.asarray(profile.at(heights).vapour_density)
    share = vapour / math.sqrt((vapour**2).sum())
    (o,) = streams([o], bench, outer_scale=f"{r0} m", pwv_rms=rms, beam=beam, tolerance="1 %")
    y = relative(o, el, float(share @ heights / share.sum()), rms)
    variance = structure = 0.0
    for a, h in zip(share, heights, strict=True):
        z = h / math.sin(el)
        c, s = hankel(angle * z, r0, full_width(diameter, 93e9, z), beam)
        variance, structure = variance + a * a * (c + s), structure + a * a * s
    for found, expected in ((y[0] ** 2, variance), ((y[0] - y[1]) ** 2 / 2, structure)):
        mean, error = mean_and_error(found)
        assert error < 0.06 * expected
        assert abs(mean - expected) < 4 * error
    mean, error = mean_and_error(y[0])
    assert abs(mean) < 4 * error


# ------------------------------------------------------------------------------------- emission,
# opacity, path, log-normal


@pytest.mark.parametrize(
    ("low", "high", "elevation", "pwv", "rms"),
    [
        ("78 GHz", "108 GHz", 12.0, 7.7, 0.14),
        ("175 GHz", "195 GHz", 50.0, 5.0, 0.3),
        ("630 GHz", "680 GHz", 60.0, 0.5, 1.0),
    ],
)
def test_streams_are_the_radiative_transfer_at_the_water_they_state(
    bench: Any, low: str, high: str, elevation: float, pwv: float, rms: float
) -> None:
    # The stream `pwv` says how much water lies along the line of sight; radiative transfer at that
    # much, not interpolated, must give the emission, transmission and opacity of the other streams.
    # Table: 1e-5 of the mean (docs/physics.md).
    camera = instrument(diameter="50 m").model_copy(
        update={"band": Band(name="b", low=low, high=high)}
    )
    o = observe(200.0, 1.0, elevation, camera=camera, offsets=([0.0, 1e-3], [0.0, 2e-3]), seed=4)
    parameters = {
        "pwv": f"{pwv} mm",
        "pwv_rms": rms,
        "layers": 3,
        "wind": {"speed": "15 m/s"},
        "layer_response": "column",
    }
    model = zonda.AtmosphereLayers(**parameters).model(o)
    profile, band = model.profile, model.band
    (o,) = streams([o], bench, **parameters)
    heights = np.linspace(500.0, 5000.0, 3)
    air = profile.at(heights)
    vapour = np.asarray(air.vapour_density)
    el = np.arcsin(rays_of(np.zeros(1), np.array([math.radians(elevation)]), 1e-3, 2e-3)[2, 0])
    y = relative(o, el, float(vapour @ heights / vapour.sum()), 1.0, pwv * 1e-3)[1]
    assert y.min() > -1
    mean, log_mean = band.transfer(pwv * 1e-3, [el])[0]
    for n in range(0, 200, 25):
        emission, log_transmission = band.transfer(pwv * 1e-3 * (1 + y[n]), [el])[0]
        assert o.detdata["atmosphere"][1, n] == pytest.approx(emission - mean, abs=2e-5 * mean)
        assert o.detdata["transmission"][1, n] == pytest.approx(
            math.expm1(log_transmission - log_mean), abs=2e-5
        )
        assert o.detdata["opacity"][1, n] == pytest.approx(log_mean - log_transmission, abs=2e-5)
    warm = vapour.sum() / (vapour / np.asarray(air.temperature)).sum()
    delay = 1e-6 * 1000 * 461.5 * (3739 / warm + 0.221)  # Bevis et al. (1994)
    np.testing.assert_allclose(
        o.detdata["path_delay"], delay * o.detdata["pwv"], rtol=2e-4, atol=1e-9
    )


@pytest.mark.parametrize(("rms", "after"), [(0.5, False), (1.0, True)])
def test_log_normal_water_has_the_mean_and_rms_asked_for_and_stays_positive(
    bench: Any, rms: float, after: bool
) -> None:
    # One line of sight for 20000 s in a wind of 20 m/s, r0 = 20 m: thousands of pieces. Behind 25 m
    # the normal field keeps the share v = 0.7 of its variance; where the rms is that before the
    # beam, y has the rms sqrt(exp(s^2 v) - 1) and s^2 = ln(1 + rms^2). 1 mm is far below the
    # table's end.
    el, height = math.radians(60.0), 1000.0
    o = observe(
        20000.0, 0.2, 60.0, camera=instrument(diameter="25 m"), offsets=([0.0], [0.0]), seed=11
    )
    (o,) = streams(
        [o],
        bench,
        pwv="1 mm",
        pwv_rms=rms,
        pwv_rms_after_beam=after,
        layers=1,
        lowest="1 km",
        outer_scale="20 m",
        wind={"speed": "20 m/s"},
        tolerance="1 %",
    )
    y = relative(o, el, height, 1.0, 1e-3)[0]
    v = hankel(0.0, 20.0, full_width(25.0, 93e9, height / math.sin(el)))[0]
    expected = rms**2 if after else math.expm1(math.log1p(rms**2) * v)
    assert y.min() > -1
    mean, error = mean_and_error(y)
    assert abs(mean) < 4 * error
    square, error = mean_and_error(y**2)
    assert error < 0.12 * expected
    assert abs(square - expected) < 4 * error
    assert ("AtmosphereLayers", "values of the PWV clipped to the table", "0") in list(o.log)


# --------------------------------------------------------------------------------------------------
# the lattice


def test_levels_layers_seeds_and_neighbours_are_independent() -> None:
    # Means of products of n = 1e6 pairs of independent deviates: standard error 1e-3. 60 of them:
    # 4.5 are allowed.
    n = 1024

    def draw(seed: int, layer: int, level: int) -> Floats:
        key = stream_key(seed, "AtmosphereLayers", "layer", layer, "level", level)
        return lattice_normals(key, -n // 2, n // 2, -n // 2, n // 2).astype(np.float64)

    one = draw(1, 0, 3)
    assert abs(one.mean()) < 4.5 / n
    assert abs(one.var() - 1) < 4.5 * math.sqrt(2) / n
    others = (
        [(1, k, 3) for k in range(1, 10)]
        + [(1, 0, e) for e in (-3, -1, 0, 2, 4, 10)]
        + [(s, 0, 3) for s in (0, 2, 3)]
    )
    for other in others:
        assert abs((one * draw(*other)).mean()) < 4.5 / n, other
    for di, dj in (
        (0, 1),
        (1, 0),
        (1, 1),
        (0, 8),
        (8, 0),
        (16, 0),
        (0, 16),
        (32, 0),
        (0, 32),
        (32, 32),
        (0, n // 2),
        (n // 2, 0),
    ):
        a, b = one[: n - di, : n - dj], one[di:, dj:]
        assert abs((a * b).mean()) < 4.5 / math.sqrt(a.size), (di, dj)
        assert abs(((a * a - 1) * (b * b - 1)).mean()) < 2 * 4.5 / math.sqrt(a.size), (di, dj)


@pytest.mark.parametrize("sigma", [2.55, 42.5])
def test_variance_is_the_same_at_every_phase_of_the_pyramid(sigma: float) -> None:
    # Lattice points of level j differ in how many upsamplings they pass through: the variance must
    # not be modulated with 2^j.
    layer = Turbulence(0, outer_scale=500.0, sigma=sigma)
    points = np.array([(i, j) for i in range(64) for j in (0, 1, 2, 21)])
    variance = implied_covariance(layer, points, points)
    assert np.ptp(variance) < layer.fidelity.error * layer.variance
    assert abs(variance.mean() / layer.variance - 1) < layer.fidelity.error / 2


@pytest.mark.parametrize(("one", "two"), [(21.2, 19.2), (42.5, 43.5), (2.55, 21.2)])
def test_two_beams_through_the_same_stream_are_nearly_as_alike_as_the_same_air_would_be(
    one: float, two: float
) -> None:
    # Two bands or telescopes, cross-covariance at a point of both lattices (even points pass
    # straight through the upsampling): exact from the kernels. In truth int P exp(-(s1^2 + s2^2)
    # k^2 / 2); levels split by e = s + sigma^2 lose a little of it.
    a, b = (Turbulence(0, outer_scale=500.0, sigma=s) for s in (one, two))
    cross = 0.0
    for level in a.levels:
        other = next((v for v in b.levels if v.exponent == level.exponent), None)
        if level.kernel is not None and other is not None and other.kernel is not None:
            times = np.where(np.arange(len(level.kernel)) > 0, 2.0, 1.0)
            cross += float(times @ (level.kernel.astype(np.float64) * other.kernel) @ times)
    width = math.sqrt(8 * math.log(2) * (one**2 + two**2) / 2)
    truth = a.variance + b.variance - 2 * hankel(0.0, 500.0, width)[0]
    difference = a.variance + b.variance - 2 * cross
    assert 0.9 * truth < difference < 2.5 * truth
    assert cross / math.sqrt(a.variance * b.variance) > 0.996
