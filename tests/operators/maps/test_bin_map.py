"""Where samples land, what is dropped, exact sums, noise, half-differences, smoothing, HEALPix."""

from __future__ import annotations

import math
import warnings

import astropy.units as u
import healpy
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from hypothesis import given, settings
from hypothesis import strategies as st

import zonda
from zonda.core.errors import InputError, PipelineError
from zonda.core.flags import INVALID
from zonda.core.numerics.projection import directions, frame_rotation
from zonda.core.numerics.smooth import SmoothField
from zonda.core.numerics.sphere import ARCMIN
from zonda.operators.filters.highpass import HighpassFilter
from zonda.operators.maps.bin_map import BinMap
from zonda.operators.maps.intensity_kernel import VALUE, WEIGHT
from zonda.operators.maps.map_layout import MapLayout
from zonda.operators.maps.map_sums import MapSums
from zonda.operators.maps.maximum_likelihood import MaximumLikelihoodMap

ARCSEC = np.radians(1 / 3600)
N_DET, N = 19, 4500
STEP = 2.0**-36


def sky_of(observation, function):
    """``function`` of tangent offsets (east, north) [rad] from the observation's centre, at every
    sample.
    """
    d = directions(
        observation.boresight_radec, observation.focalplane.xi, observation.focalplane.eta
    )
    ra, dec = observation.centre
    centre = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    w = d @ centre
    return function(d @ east / w, d @ np.cross(centre, east) / w)


def source(x0, y0, fwhm=8.5 * ARCSEC):
    sigma = fwhm / np.sqrt(8 * np.log(2))
    return lambda x, y: np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2 * sigma**2))


@pytest.mark.parametrize("frame", ["icrs", "galactic"])
@pytest.mark.parametrize("shape", [(120, 120), (121, 121), (120, 91)])
def test_source_at_the_right_world_coordinate(bench, frame, shape):
    observation = bench.observation(61, 20000)
    x0, y0 = 11 * ARCSEC, -23 * ARCSEC
    nx, ny = shape
    operator = BinMap(width=f"{2 * nx} arcsec", height=f"{2 * ny} arcsec", frame=frame)
    product = bench.run(
        [operator], observation, {"signal": lambda o: sky_of(o, source(x0, y0))}
    ).map
    assert product.signal.shape == (ny, nx)
    values = np.nan_to_num(product.signal)
    y, x = np.indices(values.shape)
    centroid = (values * x).sum() / values.sum(), (values * y).sum() / values.sum()
    found = product.wcs.pixel_to_world(*centroid).icrs
    # a gnomonic offset of 25 arcsec is an angle to 1e-8
    ra, dec = observation.centre
    expected = SkyCoord(ra, dec, unit="rad").spherical_offsets_by(*(np.array([x0, y0]) * u.rad))
    # samples fill the pixels unevenly: a twentieth of a pixel
    assert found.separation(expected).arcsec < 0.1
    middle = product.wcs.pixel_to_world((nx - 1) / 2, (ny - 1) / 2).icrs
    assert middle.separation(SkyCoord(ra, dec, unit="rad")).arcsec < 1e-6


def test_every_sample_is_in_the_pixel_that_astropy_says(bench):
    observation = bench.observation(7, 3000)
    a = np.arange(7 * 3000.0).reshape(7, 3000) % 97
    product = bench.run(
        [BinMap(width="90 arcsec", height="70 arcsec")],
        observation,
        {"signal": a},
        precision="float64",
    ).map
    d = directions(
        observation.boresight_radec, observation.focalplane.xi, observation.focalplane.eta
    )
    sky = SkyCoord(x=d[..., 0], y=d[..., 1], z=d[..., 2], representation_type="cartesian")
    sky.representation_type = "unitspherical"
    x, y = (np.floor(p + 0.5).astype(int) for p in product.wcs.world_to_pixel(sky))
    inside = (x >= 0) & (x < 45) & (y >= 0) & (y < 35)
    hits, total = np.zeros((35, 45), int), np.zeros((35, 45))
    np.add.at(hits, (y[inside], x[inside]), 1)
    np.add.at(total, (y[inside], x[inside]), a[inside])
    np.testing.assert_array_equal(product.hits, hits)
    with np.errstate(invalid="ignore"):
        np.testing.assert_allclose(product.signal, total / hits, rtol=1e-12)


def test_outside_flagged_and_nan_are_dropped_and_counted(bench):
    observation = bench.observation(N_DET, N)
    observation.flags[100:150] = 1
    observation.detector_flags[4] = 1
    a = np.ones((N_DET, N))
    a[2, 300:310] = np.nan
    a[3, 301] = -np.inf
    a[:, 100:150] = 1e30
    result = bench.run([BinMap(width="1 arcmin")], observation, {"signal": a})
    count = {
        what: int(v)
        for (who, what), v in result.log.items()
        if who == "BinMap" and what.startswith("samples")
    }
    assert count["samples dropped: flagged"] == N + (N_DET - 1) * 50
    assert count["samples dropped: not finite"] == 11
    assert count["samples dropped: outside the map"] > 1000
    assert sum(count.values()) == N_DET * N
    assert result.map.hits.sum() == count["samples binned"]
    assert np.isnan(result.map.signal[result.map.hits == 0]).all()
    np.testing.assert_array_equal(result.map.signal[result.map.hits > 0], 1.0)
    whole = bench.run([BinMap()], bench.observation(N_DET, N), {"signal": np.ones((N_DET, N))})
    assert whole.log["BinMap", "samples dropped: outside the map"] == "0"


@pytest.mark.parametrize("how", [{"width": "1 arcmin"}, {"nside": 4096}])
@pytest.mark.parametrize("weights", ["uniform", "inverse_variance"])
def test_what_is_dropped_is_counted_once_whatever_else_is_wrong_with_it(bench, how, weights):
    """Outside and not finite or too large, flagged and too large; 9 detectors (a rest beside groups
    of four), unequal NETs.
    """
    a, observation, whole = np.full((9, N), 0.5), bench.observation(9, N), bench.observation(9, N)
    for o in (observation, whole):
        o.focalplane.net[:] = np.linspace(1e-3, 3e-3, 9)
    clean = bench.run([BinMap(weights=weights, **how)], whole, {"signal": a})
    a[:, 500:520] = np.nan
    a[5, 1000:1010] = -np.inf
    observation.flags[1005:1020] = 1
    a[:, 1005:1020] = 1e20
    result = bench.run([BinMap(weights=weights, **how)], observation, {"signal": a})
    count = {
        what: int(v)
        for (who, what), v in result.log.items()
        if who == "BinMap" and what.startswith("samples")
    }
    assert count["samples dropped: flagged"] == 9 * 15
    assert count["samples dropped: not finite"] == 9 * 20 + 5
    assert sum(count.values()) == 9 * N
    assert result.map.hits.sum() == count["samples binned"]
    lost = clean.map.hits.sum() - result.map.hits.sum()
    assert 0 <= lost <= 9 * 35 + 5
    if "nside" in how:
        assert lost == 9 * 35 + 5
    np.testing.assert_allclose(
        result.map.signal[result.map.hits > 0], 0.5, rtol=1e-9
    )  # rounded weights, 2^-31 of the smallest


def test_behind_the_image_is_outside(bench):
    """The image's antipode: its homographies have positive numerators there too."""
    there = BinMap(width="1 deg", height="1 deg", pixel="1 arcmin", centre="255 deg -20 deg")
    result = bench.run([there], bench.observation(N_DET, N), {"signal": np.ones((N_DET, N))})
    assert result.map.hits.sum() == 0
    assert result.log["BinMap", "samples dropped: outside the map"] == str(N_DET * N)


def test_scans_of_the_next_thread_and_pass_begin_with_empty_sums(bench):
    """The arrays of one scan's sums serve the next."""
    step = BinMap(width="1 arcmin")
    once = bench.run([step], bench.observation(N_DET, N), {"signal": np.ones((N_DET, N))}).map
    again = bench.run([step], bench.observation(N_DET, N), {"signal": np.ones((N_DET, N))}).map
    np.testing.assert_array_equal(once.hits, again.hits)


def test_nothing_is_piled_into_the_edge(bench):
    """A small map equals the middle of a large one (centre off the scan's, so that no sample lies
    on a pixel's corner).
    """
    maps = [
        bench.run(
            [BinMap(width=w, centre="75.0001 deg 20.0001 deg")],
            bench.observation(N_DET, N),
            {"signal": np.ones((N_DET, N))},
        ).map
        for w in ("1 arcmin", "7 arcmin")
    ]
    small, large = (m.hits for m in maps)
    np.testing.assert_array_equal(small, large[90:120, 90:120])
    assert large.sum() == N_DET * N


def test_default_map_covers_the_scan_closely(bench):
    observation = bench.observation(61, 20000)
    product = bench.run([BinMap()], observation, {"signal": np.ones((61, 20000))}).map
    rows, columns = (
        np.flatnonzero(product.hits.any(axis=1)),
        np.flatnonzero(product.hits.any(axis=0)),
    )
    assert (
        min(rows[0], columns[0]) < 12
    )  # the field of view is a circle around every boresight: at most some pixels too wide
    assert product.hits.sum() == 61 * 20000


def test_uniform_sky_returns_its_value_with_the_mean_beside_the_stream(bench):
    mean = SmoothField.constant(np.full(N_DET, 65.5), N)
    a = np.full((N_DET, N), 1e-6)
    product = bench.run(
        [BinMap()], bench.observation(N_DET, N), {"signal": a}, means={"signal": mean}
    ).map
    hit = product.hits > 0
    # float32 holds 1e-6 to 6e-14, the mean is a float64 spline (1e-14 of 65), the sums round to
    # 2^-37
    assert np.abs(product.signal[hit] - 65.500001).max() < 2e-11


@pytest.mark.parametrize("weights", ["uniform", "inverse_variance"])
@pytest.mark.parametrize("noise", ["net", "scatter"])
@pytest.mark.parametrize("scattered", [False, True])
def test_noise_of_the_pixels(bench, weights, noise, scattered):
    """The map's noise in units of the stated one has unit variance."""
    many = [bench.observation(N_DET, 30000, index=i) for i in range(2)]
    rng = np.random.default_rng(0)
    for o in many:
        if scattered:
            o.focalplane.net = o.focalplane.net * np.linspace(0.5, 2.0, N_DET)
    sigma = many[0].focalplane.net[:, None] * 10.0
    drawn = {o.name: sigma * rng.standard_normal((N_DET, 30000)) for o in many}
    product = bench.run(
        [BinMap(pixel="4 arcsec", weights=weights, noise=noise)],
        many,
        {"signal": lambda o: drawn[o.name]},
    ).map
    use = product.hits > 60
    n = int(use.sum())
    assert n > 1000
    ratio = (product.signal / product.noise)[use]
    # variance of n unit normals: 1 +- sqrt(2 / n); scatter: the t-distribution with > 60 degrees
    # widens it by < 4 %; with scattered NETs the estimate from the scatter is that of the mean NET
    # only for uniform weights and many detectors
    if scattered and noise == "scatter":
        assert 0.8 < ratio.std() < 1.3
    else:
        assert abs(ratio.var() - 1) < 4 * math.sqrt(2 / n) + (0.04 if noise == "scatter" else 0)
    half = (
        product.half_difference[use & np.isfinite(product.half_difference)]
        / product.noise[use & np.isfinite(product.half_difference)]
    )
    if not (noise == "scatter" and scattered) and weights == "inverse_variance":
        assert abs(half.var() - 1) < 4 * math.sqrt(2 / half.size) + (
            0.04 if noise == "scatter" else 0
        )
    if weights == "uniform":
        np.testing.assert_array_equal(product.weights, product.hits)
    elif noise == "net":
        np.testing.assert_allclose(product.weights[use], product.noise[use] ** -2, rtol=1e-6)


def test_half_difference_removes_the_sky(bench):
    many = [bench.observation(N_DET, 20000, index=0), bench.observation(N_DET, 20000, index=0)]
    many[1].index, many[1].name = 1, "scan1"
    product = bench.run([BinMap()], many, {"signal": lambda o: sky_of(o, source(0, 0))}).map
    both = np.isfinite(product.half_difference)
    assert both.any()
    assert np.abs(product.half_difference[both]).max() < 2 * STEP
    assert product.signal[both].max() > 0.9
    alone = bench.run([BinMap()], many[:1], {"signal": lambda o: sky_of(o, source(0, 0))})
    assert alone.map.half_difference is None
    assert alone.log["BinMap", "half-difference"].startswith("not made")
    assert (
        bench.run(
            [BinMap(half_difference=False)], many, {"signal": lambda o: sky_of(o, source(0, 0))}
        ).map.half_difference
        is None
    )


def test_identical_bits_for_blocks_threads_and_order(bench):
    def run(threads, memory, order=1, scatter="net"):
        many = [bench.observation(37, 9001, index=i) for i in range(3)]
        for o in many:
            o.focalplane.net = o.focalplane.net * np.linspace(0.5, 2.0, 37)
        rng = np.random.default_rng(1)
        drawn = {o.name: rng.standard_normal((37, 9001)) for o in many}
        operator = BinMap(half_difference=False, noise=scatter, width="4 arcmin")
        return bench.run(
            [operator],
            many[::order],
            {"signal": lambda o: drawn[o.name]},
            threads=threads,
            memory=memory,
        ).map

    for scatter in ("net", "scatter"):
        first = run(1, 1 << 30, scatter=scatter)
        for other in (
            run(3, 1 << 30, scatter=scatter),
            run(2, 8 << 20, scatter=scatter),
            run(1, 1 << 30, -1, scatter=scatter),
        ):
            for name in ("signal", "hits", "weights", "noise"):
                np.testing.assert_array_equal(getattr(first, name), getattr(other, name))


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 1000), a=st.floats(-3, 3), b=st.floats(-3, 3))
def test_maps_are_linear_without_singular_modes(seed, a, b):
    from ..conftest import Workbench

    bench, rng = Workbench(), np.random.default_rng(seed)
    one, two = rng.standard_normal((2, 7, 3000))

    def mapped(signal):
        return bench.run(
            [HighpassFilter(), BinMap()],
            bench.observation(7, 3000),
            {"signal": signal},
            precision="float64",
        ).map.signal

    np.testing.assert_allclose(
        mapped(a * one + b * two), a * mapped(one) + b * mapped(two), rtol=0, atol=8 * STEP + 1e-11
    )


def test_filtered_point_source_is_neither_shifted_nor_skewed_and_keeps_its_amplitude(bench):
    """Zero phase, and no window: what the brick wall takes from a fast crossing is small and
    known.
    """
    observation = bench.observation(61, 20000)
    signal = sky_of(observation, source(0, 0))
    operators = [
        HighpassFilter(frequency="0.02 Hz"),
        BinMap(pixel="2 arcsec", width="121 arcsec", height="121 arcsec"),
    ]
    product = bench.run(operators, observation, {"signal": signal}, precision="float64").map
    plain = bench.run([operators[1]], observation, {"signal": signal}, precision="float64").map
    near = product.distance() < 6 * ARCSEC
    offset = np.nanmean((plain.signal - product.signal)[near])
    recovered = (product.signal + offset)[near]
    assert (
        abs(np.nansum(recovered * plain.signal[near]) / np.nansum(plain.signal[near] ** 2) - 1)
        < 0.01
    )
    y, x = np.indices(product.signal.shape)
    ok = near & np.isfinite(product.signal)
    weight, reference = (product.signal + offset)[ok], plain.signal[ok]
    for axis in (x[ok], y[ok]):
        assert (
            abs((weight * axis).sum() / weight.sum() - (reference * axis).sum() / reference.sum())
            < 0.02
        )


@pytest.mark.parametrize("smooth", ["beam", "17 arcsec"])
def test_smoothing_is_normalized_local_and_states_its_noise(bench, smooth):
    many = [bench.observation(N_DET, 30000, index=i) for i in range(2)]
    rng = np.random.default_rng(2)
    sigma = many[0].focalplane.net[:, None] * 10.0
    drawn = {o.name: sigma * rng.standard_normal((N_DET, 30000)) for o in many}
    product = bench.run(
        [BinMap(smooth=smooth, pixel="3 arcsec")], many, {"signal": lambda o: drawn[o.name]}
    ).map
    fwhm = 8.5 * ARCSEC if smooth == "beam" else 17 * ARCSEC
    assert abs(product.smoothed_by - fwhm) < 1e-12
    assert (np.isnan(product.signal) == (product.hits == 0)).all()
    inner = product.distance() < 1.2 * ARCMIN
    use = inner & (product.hits > 0)
    ratio = (product.signal / product.noise)[use]
    # independent beams: area over 2 pi sigma^2 * 2 (the noise's own correlation area, 4 pi sigma^2)
    independent = use.sum() * product.pixel**2 / (4 * np.pi * (fwhm / 2.3548) ** 2)
    assert abs(ratio.var() - 1) < 4 * math.sqrt(2 / independent)
    flat = bench.run(
        [BinMap(smooth=smooth, pixel="3 arcsec")], many, {"signal": np.ones((N_DET, 30000))}
    ).map
    np.testing.assert_allclose(flat.signal[flat.hits > 0], 1.0, rtol=1e-12)


def test_rms_in_the_central_arcmin(bench):
    product = bench.run(
        [BinMap()], bench.observation(N_DET, N), {"signal": np.full((N_DET, N), -3.0)}
    ).map
    assert abs(product.rms() - 3) < 1e-9
    product.signal[product.distance() > 0.5 * ARCMIN] = 1e9
    assert abs(product.rms() - 3) < 1e-9
    assert product.rms(2 * ARCMIN) > 1e6
    with pytest.raises(InputError, match="half-difference"):
        product.rms(of="half_difference")
    assert "pixels hit" in product._repr_html_()


@pytest.mark.parametrize("ordering", ["ring", "nested"])
@pytest.mark.parametrize("frame", ["icrs", "galactic"])
def test_healpix_map(bench, ordering, frame):
    observation = bench.observation(N_DET, N, radius=600 * ARCSEC)
    a = np.arange(N_DET * N, dtype=float).reshape(N_DET, N) % 11
    product = bench.run(
        [BinMap(nside=1024, ordering=ordering, frame=frame)],
        observation,
        {"signal": a},
        precision="float64",
    ).map
    where = (
        directions(
            observation.boresight_radec, observation.focalplane.xi, observation.focalplane.eta
        )
        @ frame_rotation(frame).T
    )
    pixel = healpy.vec2pix(1024, *np.moveaxis(where, 2, 0), nest=ordering == "nested").ravel()
    hits = np.bincount(pixel, minlength=12 * 1024**2)
    np.testing.assert_array_equal(product.pixels, np.flatnonzero(hits))
    np.testing.assert_array_equal(product.hits, hits[product.pixels])
    total = np.bincount(pixel, a.ravel(), minlength=12 * 1024**2)
    np.testing.assert_allclose(
        product.signal, (total / np.maximum(hits, 1))[product.pixels], rtol=1e-12
    )
    full = product.healpix_full
    assert (full != healpy.UNSEEN).sum() == len(product.pixels)
    assert math.isfinite(product.rms(5 * ARCMIN))


def test_healpix_smoothing(bench):
    observation = bench.observation(N_DET, N, radius=2400 * ARCSEC)
    product = bench.run(
        [BinMap(nside=256, smooth="40 arcmin")], observation, {"signal": np.ones((N_DET, N))}
    ).map
    np.testing.assert_allclose(product.signal, 1.0, rtol=1e-9)


@pytest.mark.parametrize(
    ("weight", "kelvin", "words"),
    [(1e6, 1.0, "weights or variances up to 1e\\+06 times"), (1.0, 1e4, "each up to 1e\\+04 K")],
)
def test_an_overflow_names_what_overflows(weight, kelvin, words):
    """2^32 samples in a pixel of two tasks together."""

    def task():
        sums = MapSums(1, ["signal"])
        sums.sums[0, 0, 0], sums.scans = 2**31, ["scan"]
        return MapSums.of(sums.arrays() | {"largest": [weight * WEIGHT, kelvin * VALUE]})

    sums = task()
    with pytest.raises(PipelineError, match=f"4294967296 samples in one pixel, .*{words}"):
        sums += task()


def test_far_too_large_samples_and_overflow_are_refused(bench):
    a = np.zeros((N_DET, N))
    a[0, 0] = 1e9
    with pytest.raises(PipelineError, match="too large"):
        bench.run([BinMap()], bench.observation(N_DET, N), {"signal": a})
    with pytest.raises(PipelineError, match="overflow"):
        bench.run(
            [BinMap(pixel="1 deg", width="1 deg")],
            bench.observation(N_DET, N),
            {"signal": np.full((N_DET, N), 1.2e4)},
        )


def test_zero_net_needs_uniform_weights(bench):
    observation = bench.observation(7, 300)
    observation.focalplane.net[3] = 0
    with pytest.raises(PipelineError, match="NET 0"):
        bench.run([BinMap()], observation, {"signal": np.ones((7, 300))})
    assert (
        bench.run(
            [BinMap(weights="uniform")], observation, {"signal": np.ones((7, 300))}
        ).map.hits.sum()
        == 2100
    )
    observation.detector_flags[3] = INVALID  # then it does not matter
    found = bench.run([BinMap()], observation, {"signal": np.ones((7, 300))})
    assert found.map.hits.sum() == 1800
    assert "uniform: every NET is 0" not in str(found.log)


def test_two_maps_need_two_names(bench):
    signal = {"signal": np.ones((7, 300))}
    with pytest.raises(PipelineError, match="two steps make the product"):
        bench.run([BinMap(), BinMap(pixel="4 arcsec")], bench.observation(7, 300), signal)
    products = bench.run(
        [BinMap(), BinMap(nside=512, product="sphere")], bench.observation(7, 300), signal
    ).data.products
    assert sorted(products) == ["map", "sphere"]


@pytest.mark.parametrize(
    "bad",
    [
        {"pixel": "0 arcsec"},
        {"nside": 100},
        {"nside": 64, "pixel": "2 arcsec"},
        {"ordering": "nested"},
        {"projection": "SIN"},
        {"centre": "az 180 deg el 60 deg"},
        {"smooth": "-1 arcsec"},
        {"smooth": "0 arcsec"},
        {"weights": "best"},
        {"product": "a/b"},
    ],
)
def test_bad_parameters(bad):
    with pytest.raises(ValueError):
        BinMap(**bad)


def test_a_map_of_too_many_pixels_is_refused(bench):
    with pytest.raises(InputError, match="too large"):
        bench.run(
            [BinMap(pixel="0.001 arcsec")], bench.observation(7, 300), {"signal": np.ones((7, 300))}
        )


@pytest.mark.parametrize("projection", ["TAN", "CAR"])
@pytest.mark.parametrize(
    "size", [{"pixel": "0.001 arcsec"}, {"pixel": "0.1 arcsec", "width": "2 deg"}]
)
def test_the_check_refuses_a_map_of_too_many_pixels(bench, projection, size):
    data = zonda.Data(None, [bench.observation(7, 300)])
    with pytest.raises(InputError, match="too large"):
        BinMap(projection=projection, **size).check(data)
    for fits in (BinMap(projection=projection, pixel="2 arcsec"), BinMap(nside=2**20)):
        assert fits.check(data) == []


def test_scan_too_wide_for_a_tangent_plane_is_refused(bench):
    observation = bench.observation(1, 3000, radius=np.radians(80), centre=(1.0, 0.0))
    with pytest.raises(InputError, match="75 deg"):
        bench.run([BinMap()], observation, {"signal": np.ones((1, 3000))})


def test_one_detector_one_sample(bench):
    product = bench.run([BinMap()], bench.observation(1, 1), {"signal": np.ones((1, 1))}).map
    assert product.hits.sum() == 1


def test_noise_that_is_not_known_is_counted(bench):
    signal = {"signal": np.random.default_rng(3).standard_normal((N_DET, N))}
    run = bench.run(
        [BinMap(noise="scatter", pixel="1 arcsec", smooth="5 arcsec")],
        bench.observation(N_DET, N),
        signal,
    )
    alone = int((run.map.hits == 1).sum())
    assert alone > 10
    assert run.log["BinMap", "pixels with one sample, whose scatter is unknown: noise NaN"] == str(
        alone
    )
    assert run.log[
        "BinMap", "of them left out of the smoothed noise, which is too low around them"
    ] == str(alone)
    observation = bench.observation(7, 300)
    observation.focalplane.net[:] = 0
    run = bench.run([BinMap()], observation, {"signal": np.ones((7, 300))})
    assert run.log["BinMap", "weights"] == "uniform: every NET is 0"


def test_equal_samples_have_no_scatter_and_are_counted(bench):
    """A constant signal: what is left of its squares is rounding, of either sign."""
    run = bench.run(
        [BinMap(pixel="4 arcsec", noise="scatter")],
        bench.observation(7, 3000),
        {"signal": np.full((7, 3000), 0.3)},
    )
    several = run.map.hits > 1
    counted = int(run.log["BinMap", "pixels whose samples scatter by less than rounding: noise 0"])
    assert counted == np.count_nonzero(run.map.noise[several] == 0) > 0
    assert np.isfinite(run.map.noise[several]).all()
    assert run.map.noise[several].max() < 1e-6
    rng = np.random.default_rng(1).normal(0, 1e-3, (7, 3000))
    run = bench.run(
        [BinMap(pixel="4 arcsec", noise="scatter")], bench.observation(7, 3000), {"signal": rng}
    )
    assert run.log["BinMap", "pixels whose samples scatter by less than rounding: noise 0"] == "0"


@pytest.mark.parametrize("net", ["1e-3 uK s(1/2)", "1 uK s(1/2)", "5 K s(1/2)", "100 K s(1/2)"])
def test_noise_far_from_the_instruments(net):
    """Sums are laid out for the level that the pipeline states, be it 60 000 times the instrument's
    or a millionth of it.

    White noise of P pixels with weights 1 / variance: sum w m^2 = P (1 +- sqrt(2 / P)); four
    standard errors are allowed.
    """
    scene = zonda.Scene(
        site="green_bank", instrument="mustang2", time="2024-11-25T07:00", target="05h +20d", seed=1
    )
    steps = [
        zonda.PointingDaisy(scan_duration="5 s"),
        zonda.WhiteNoise(net=net),
        zonda.Efficiency(),
        BinMap(pixel="8 arcsec"),
    ]
    found = zonda.Pipeline(steps).run(scene).products["map"]
    seen = found.hits > 0
    pixels = np.count_nonzero(seen)
    assert np.sum(found.weights[seen] * found.signal[seen] ** 2) == pytest.approx(
        pixels, abs=4 * np.sqrt(2 * pixels)
    )
    assert found.weights.sum() * scene.instrument.sample_rate == pytest.approx(
        found.hits.sum() / steps[1].net ** 2, rel=1e-6
    )


@pytest.mark.parametrize("how", [{"pixel": "2 arcsec"}, {"pixel": "5 arcsec"}, {"nside": 8192}])
@pytest.mark.parametrize("rate", [100.0, 37.0])
def test_seconds_per_beam_add_up_to_what_the_detectors_observed(bench, how, rate):
    """Summed over pixels, seconds per beam times pixels per beam are the detector-seconds of the
    scans, at the scans' own rate (the camera's is 100 Hz), whatever the pixels."""
    scans = [bench.observation(7, 1500, rate=rate, index=k) for k in range(2)]
    scans[0].flags[:100] = 1  # what is not used is no integration time
    product = bench.run([BinMap(**how)], scans, {"signal": np.zeros((7, 1500))}).map
    area = (
        healpy.nside2pixarea(how["nside"])
        if "nside" in how
        else float(how["pixel"].split()[0]) ** 2 * ARCSEC**2
    )
    beam = np.pi / (4 * np.log(2)) * (8.5 * ARCSEC) ** 2
    seconds = (product.hits * product.seconds_per_beam()).sum() * area / beam
    assert seconds == pytest.approx(7 * (2 * 1500 - 100) / rate, rel=1e-12)


def test_seconds_per_beam_of_smoothed_maps_are_those_of_the_telescopes_beam(bench):
    plain, smooth = (
        bench.run([BinMap(**how)], bench.observation(), {"signal": np.zeros((7, 3000))}).map
        for how in ({}, {"smooth": "beam"})
    )
    assert smooth.seconds_per_beam() == plain.seconds_per_beam()


def test_seconds_per_beam_are_not_known_where_scans_have_different_rates(bench):
    scans = [bench.observation(7, 1500, rate=r, index=k) for k, r in enumerate((100.0, 50.0))]
    assert (
        bench.run([BinMap()], scans, {"signal": np.zeros((7, 1500))}).map.seconds_per_beam() is None
    )


def test_pixels_far_from_the_centre_are_smaller_and_hold_less_of_a_beam():
    """A pixel of a tangent plane at the distance c from the centre covers cos(c)^3 of the middle
    one's part of the sky.
    """
    from astropy.wcs import WCS

    from zonda.core.maps.map_product import MapProduct

    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval, wcs.wcs.crpix, wcs.wcs.cdelt = (
        ["RA---TAN", "DEC--TAN"],
        [75.0, 20.0],
        [21, 21],
        [-1.0, 1.0],
    )
    none = np.zeros((41, 41))
    product = MapProduct(
        none,
        none.astype(int),
        none,
        none,
        None,
        wcs.to_header(),
        centre=(np.radians(75.0), np.radians(20.0)),
        pixel=np.radians(1.0),
        fwhm=np.radians(2.0),
        sample_rate=10.0,
    )
    x, y = np.array([[20, 40, 0, 33], [20, 20, 5, 40]], float)
    corners = [
        np.radians(wcs.wcs_pix2world(x + a, y + b, 0))
        for a, b in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))
    ]
    d = [
        np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
        for lon, lat in corners
    ]
    area = (
        np.linalg.norm(np.cross(d[2] - d[0], d[3] - d[1], axis=0), axis=0) / 2
    )  # of the flat quadrilateral: 1e-4 less
    beam = np.pi / (4 * np.log(2)) * np.radians(2.0) ** 2
    np.testing.assert_allclose(
        product.seconds_per_beam()[y.astype(int), x.astype(int)], beam / area / 10.0, rtol=1e-3
    )


@pytest.mark.parametrize(
    ("maker", "words"),
    [
        (BinMap(pixel="2 arcmin"), "120 arcsec for a beam of 8.5 arcsec(.|\n)*averaged(.|\n)*2.83"),
        (BinMap(nside=1024), "nside"),
        (MaximumLikelihoodMap(pixel="5 arcsec"), "5 arcsec for a beam(.|\n)*noise(.|\n)*2.83"),
    ],
)
def test_a_pixel_that_is_too_large_for_the_beam_warns(bench, maker, words):
    observation = bench.observation(3, 50)
    with pytest.warns(UserWarning, match=words):
        MapLayout(maker).common([observation], None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for fine in (BinMap(pixel="8 arcsec"), MaximumLikelihoodMap(pixel="4 arcsec")):
            MapLayout(fine).common([observation], None)
