"""The fast path against a direct, slow, obviously right one: every detector, every sample, float64,
no lattice and no nodes.

The reference is a sum of random plane waves drawn from the spectrum alone (`waves`): a Gaussian
field in the limit of many, and of exactly the wanted covariance for any number. The fast path is
compared with it and with closed forms through its *implied* covariance: lattice, kernels,
upsampling, spline between lattice points (`implied_between`), rays and wind.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.signal.windows import blackmanharris
from scipy.special import erfc

from zonda.operators.atmosphere.model import beam_sigma
from zonda.operators.atmosphere.turbulence.beams import widened
from zonda.operators.atmosphere.turbulence.covariance import (
    NU,
    beam_correlation,
    beam_structure,
    mixture,
)
from zonda.operators.atmosphere.turbulence.geometry import axes, crossing, rays, scan_planes
from zonda.operators.atmosphere.turbulence.lattice import Turbulence

from ...checks.implied import implied_covariance
from .test_layers import instrument, layers_of, observe, operator, quaternions, water

Floats = NDArray[np.float64]
OUTER_SCALE = 500.0
DIAMETERS = (0.42, 6.0, 50.0, 100.0)

# D [m], overlap of discs and of Gaussians, structure function of neighbours: docs/atmosphere.md,
# "How much air neighbours share"
OVERLAPS = [
    (0.42, 0.1169, 0.3563, 4.53e-4),
    (6.0, 0.9295, 0.9480, 2.32e-6),
    (50.0, 0.9990, 0.9992, 1.17e-8),
]


def waves(rng: np.random.Generator, number: int, sigma: float) -> tuple[Floats, Floats]:
    """Wave vectors (2, number) and amplitudes: sum a cos(k . x + phase) has the covariance of
    `beam_correlation`.

    |k| is drawn from P(k) k dk of the point-like layer, whose share below k is 1 - (1 + k^2 r0^2)^-nu: inverted exactly.
    """
    u = (np.arange(number) + rng.random(number)) / number  # stratified
    k = np.sqrt((1 - u) ** (-1 / NU) - 1) / OUTER_SCALE
    angle = 2 * np.pi * rng.random(number)
    return k * np.stack([np.cos(angle), np.sin(angle)]), np.sqrt(2 / number) * np.exp(
        -((sigma * k) ** 2) / 2
    )


def implied_difference(layer: Turbulence, at: Floats, r: float, phase: tuple[int, int]) -> Floats:
    """Half the mean squared difference of the fast path at points ``at`` and at + r/spacing
    (lattice units) of one row.

    The cubic spline through 18 lattice points, and the exact covariance of all of them.
    """
    n = 18
    i, j = (v.ravel() for v in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    ends = (np.stack([v + phase[0], 0 * v + phase[1]], axis=1) for v in (i, j))
    among = implied_covariance(layer, *ends).reshape(n, n)
    cardinal = make_interp_spline(np.arange(n), np.eye(n), k=3)
    w = cardinal(at + n // 2 - 3 + r / layer.spacing) - cardinal(at + n // 2 - 3)
    return np.asarray(np.einsum("an,nm,am->a", w, among, w) / 2, np.float64)


# -------------------------------------------------------------------------------------------------
# implied covariance


@pytest.mark.parametrize("diameter", DIAMETERS)
@pytest.mark.parametrize("height", [1000.0, 3000.0, 5000.0])
def test_every_aperture_along_across_and_oblique_to_the_wind(
    diameter: float, height: float
) -> None:
    # Lines of sight 1/3 sigma to 3 r0 apart at 57 deg; the lattice's axis is the wind's. Bounds:
    # the pyramid's stated ones.
    camera = instrument(diameter=f"{diameter} m")
    distance = height / np.sin(np.radians(57.0))
    sigma = beam_sigma(camera.telescope, camera.band, distance)
    layer = Turbulence(0, outer_scale=OUTER_SCALE, sigma=sigma)
    for angle in (0.0, 90.0, 32.0):
        for r in (sigma / 3, sigma, 4 * sigma, 100.0, 1500.0):
            step = (
                r / layer.spacing * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
            )
            end = np.round(step).astype(int)
            if not end.any():
                end = np.array([1, 0]) if angle < 45 else np.array([0, 1])
            a, b = np.array([[3, 8]]), np.array([[3, 8]]) + end
            here, there, between = (
                implied_covariance(layer, p, q)[0] for p, q in ((a, a), (b, b), (a, b))
            )
            at = np.hypot(*end) * layer.spacing
            assert between == pytest.approx(
                beam_correlation(at, OUTER_SCALE, sigma)[0], abs=layer.fidelity.error
            )
            exact = beam_structure(at, OUTER_SCALE, sigma)[0]
            assert (here + there) / 2 - between == pytest.approx(
                exact, rel=layer.fidelity.structure_error
            )


@pytest.mark.parametrize(
    ("sigma", "fidelity"), [(27.0, "default"), (42.5, "default"), (27.0, "fine")]
)
@pytest.mark.parametrize("r", [0.2, 50.0])
def test_between_lattice_points(sigma: float, fidelity: str, r: float) -> None:
    # Anywhere in a cell. hard_cases.md asks 1 % of beams that overlap almost completely (D = 100 m,
    # detectors 0.2 m apart, where matrices have condition numbers of 1e17); reached: 9e-4 at a
    # lattice of 0.75 sigma, `fine` 1e-4.
    layer = Turbulence(0, outer_scale=OUTER_SCALE, sigma=sigma, fidelity=fidelity)
    exact = beam_structure(r, OUTER_SCALE, sigma)[0]
    for phase in ((0, 0), (1, 0), (2, 5)):
        np.testing.assert_allclose(
            implied_difference(layer, (np.arange(5) + 0.5) / 5, r, phase),
            exact,
            rtol=1.2e-3 if fidelity == "default" else 2e-4,
        )


def test_a_strip_two_cells_wide_and_a_million_long() -> None:
    # As in the middle of a wide region, bit for bit at both ends; and the difference across it as
    # it should be: the mean over 1e6 cells of d^2 has a relative variance 2 / n_eff, 1 / n_eff =
    # sum of rho^2 over lags; 5 standard errors are allowed.
    sigma, n = 30.0, 1_000_000
    layer = Turbulence(2, outer_scale=OUTER_SCALE, sigma=sigma)
    strip = layer.region(0, 2, 0, n)
    assert np.isfinite(strip).all()
    np.testing.assert_array_equal(strip[:, :300], layer.region(-40, 40, -50, 300)[40:42, 50:])
    np.testing.assert_array_equal(
        strip[:, -300:], layer.region(-40, 40, n - 300, n + 50)[40:42, :300]
    )
    d2 = np.mean(np.diff(strip.astype(np.float64), axis=0) ** 2)
    s = beam_structure(layer.spacing, OUTER_SCALE, sigma)[0]
    lag = layer.spacing * np.arange(2000)
    near = beam_structure(np.hypot(lag, layer.spacing), OUTER_SCALE, sigma) - beam_structure(
        lag, OUTER_SCALE, sigma
    )
    rho = near / s
    error = np.sqrt(2 * (2 * (rho**2).sum() - 1) / n)
    assert error < 0.02
    assert d2 == pytest.approx(2 * s, rel=5 * error)


# ------------------------------------------------------------------------------------- the
# reference and the whole operator


@pytest.mark.parametrize(
    ("diameter", "field"),
    [("100 m", "4 arcmin"), ("50 m", "1 deg"), ("6 m", "2 deg"), ("0.42 m", "20 deg")],
)
def test_the_fast_path_has_the_statistics_of_the_direct_sum(diameter: str, field: str) -> None:
    # Differences between detectors after subtraction of their mean (what a map is made of), at 40
    # instants, rms over seeds and detectors: fast and direct must agree within 5 standard errors of
    # both, found from the scatter of the seeds.
    camera = instrument(detectors=19, field=field, diameter=diameter)
    op = operator(layers=2, wind={"speed": "12 m/s", "direction": "230 deg"}, tolerance="0.5 %")
    seeds = 40
    fast, slow = np.empty(seeds), np.empty(seeds)
    for seed in range(seeds):
        o = observe(40.0, 5.0, camera=camera, seed=seed, scan=20.0)
        y = water(op, o)[:, ::5] / op.pwv_rms
        fast[seed] = np.mean((y - y.mean(0)) ** 2)
        rng = np.random.default_rng(seed)
        track = scan_planes([o])[0]
        u = rays(axes(o.boresight_azel[::5]), o.focalplane.xi, o.focalplane.eta)
        direct = np.zeros(u.shape[1:])
        for layer in layers_of(op, o):
            across, along = track.positions(crossing(u), o.seconds[::5], layer.height, layer.wind)
            k, a = waves(rng, 400, layer.sigma)
            phase = 2 * np.pi * rng.random(len(a))
            direct += (
                layer.amplitude
                * np.cos(np.multiply.outer(across, k[0]) + np.multiply.outer(along, k[1]) + phase)
                @ a
            )
        slow[seed] = np.mean((direct - direct.mean(0)) ** 2)
    error = np.hypot(fast.std(), slow.std()) / np.sqrt(seeds - 1)
    assert fast.mean() == pytest.approx(slow.mean(), abs=5 * error)
    assert error < 0.35 * slow.mean()


def test_the_direct_sum_has_the_wanted_covariance() -> None:
    # Expectation over phases is exact; the stratified |k| and random angles leave 1 / sqrt(number).
    k, a = waves(np.random.default_rng(0), 200_000, 20.0)
    for r in (10.0, 100.0, 600.0):
        assert (a**2 / 2) @ np.cos(k[0] * r) == pytest.approx(
            beam_correlation(r, OUTER_SCALE, 20.0)[0], abs=3e-3
        )
        s = (a**2 / 2) @ (1 - np.cos(k[0] * r))
        assert s == pytest.approx(beam_structure(r, OUTER_SCALE, 20.0)[0], rel=0.02)


# --------------------------------------------------------------------------------------------------
# temporal spectra


def spectrum(frequency: Floats, speed: float, sigma: float) -> Floats:
    """One-sided temporal spectrum of a layer of unit variance that passes at ``speed``: closed
    form, 1/Hz.

    int P(k_x, k_y) exp(-sigma^2 k^2) dk_y / pi v at k_x = 2 pi f / v, by the mixture of Gaussians:
    each is 1-D Gaussian.
    """
    e, w = mixture(OUTER_SCALE, sigma)
    k = 2 * np.pi * frequency / speed
    # exp(-(v t)^2 / 4e) has the one-sided spectrum 2 sqrt(4 pi e) / v exp(-e k^2).
    return np.asarray(
        np.exp(-np.multiply.outer(k * k, e)) @ (w * np.sqrt(4 * np.pi * e)) * 2 / speed, np.float64
    )


def expected_periodogram(covariance: Floats, window: Floats) -> Floats:
    """Exact expectation of |sum w y exp(-i omega n)|^2 of a stationary series, ``covariance`` at
    lags 0 .. len(window) - 1.
    """
    n = len(window)
    lagged = np.correlate(window, window, "full")[n - 1 :] * covariance
    return np.asarray(np.fft.rfft(np.r_[lagged, 0, lagged[:0:-1]]).real[::2], np.float64)


@pytest.mark.parametrize(
    ("diameter", "scan"), [("6 m", 0.0), ("100 m", 0.0), ("6 m", 1.5), ("50 m", 1.0)]
)
def test_temporal_spectrum_is_the_closed_form(diameter: str, scan: float) -> None:
    # One layer 2 km up, a stare in a wind of 20 m/s or a scan at ``scan`` deg/s, 40 deg long,
    # without wind. The periodogram's expectation is exact (`expected_periodogram`). In a band of m
    # frequencies, with s seeds of g segments: m g s / 4 independent values or more of relative
    # variance 1 (the window correlates 4 neighbours); 5 standard errors are allowed.
    distance, seeds, segment = 2000 / np.sin(np.radians(50.0)), 8, 512
    wind = {"speed": "0 m/s" if scan else "20 m/s", "direction": "0 deg"}
    op = operator(layers=1, lowest="2000 m", wind=wind, tolerance="0.1 %")
    camera = instrument(detectors=1, field="0 deg", diameter=diameter)
    rate, seconds = (25.6, 40.0) if scan else (6.4, 800.0)
    window = blackmanharris(segment, sym=False)
    measured = np.zeros(segment // 2 + 1)
    pieces = round(rate * seconds) // segment
    for seed in range(seeds):
        o = observe(seconds, rate, 50.0, 0.0, camera=camera, seed=seed)
        if scan:  # along the circle of constant elevation
            azimuth = np.radians(scan / np.cos(np.radians(50.0))) * (o.seconds - seconds / 2)
            o.boresight_azel = quaternions(azimuth, np.full(len(azimuth), np.radians(50.0)))
        y = water(op, o)[0][: pieces * segment].reshape(pieces, segment) / op.pwv_rms
        measured += (abs(np.fft.rfft(y * window)) ** 2).mean(0) / seeds
    sigma = layers_of(op, o)[0].sigma
    # A wind along the azimuth is foreshortened; along an arc of the unrolled cone chords are up to
    # 1 % shorter than arcs.
    speed = np.radians(scan) * distance if scan else 20.0 * np.sin(np.radians(50.0))
    expected = expected_periodogram(
        beam_correlation(speed * np.arange(segment) / rate, OUTER_SCALE, sigma), window
    )
    edges = [0, 1, 2, 4, 8, 16, 32, 64, 128]
    checked = 0
    for low, high in pairwise(edges):
        band = slice(low, high)
        if expected[band].min() < 1e-6 * expected[0]:
            break
        n = max(1.0, (high - low) / 4) * seeds * pieces
        assert np.mean(measured[band] / expected[band]) == pytest.approx(
            1, abs=5 * np.sqrt(2 / n)
        ), (low, high)
        checked += 1
    assert checked >= 4


@pytest.mark.parametrize(("speed", "sigma"), [(15.0, 2.6), (15.0, 42.5), (68.0, 21.0)])
def test_closed_form_spectrum_is_the_transform_of_the_covariance(
    speed: float, sigma: float
) -> None:
    f = np.array([0.0, 0.01, 0.05, 0.1]) * speed / sigma
    t = np.arange(0, 40 * OUTER_SCALE / speed, sigma / speed / 8)
    c = beam_correlation(speed * t, OUTER_SCALE, sigma)
    transform = 4 * np.trapezoid(c * np.cos(2 * np.pi * np.multiply.outer(f, t)), t, axis=-1)
    np.testing.assert_allclose(
        spectrum(f, speed, sigma), transform, rtol=1e-6, atol=1e-9 * transform[0]
    )


def test_slope_is_minus_eight_thirds_for_points_and_steeper_behind_a_beam() -> None:
    speed = 20.0
    f = np.array(
        [5.0, 5.1]
    )  # v / r0 = 0.04 Hz: far inside the inertial range; sigma = 1 cm: point-like up to 300 Hz
    slope = np.diff(np.log(spectrum(f, speed, 0.01)))[0] / np.diff(np.log(f))[0]
    assert slope == pytest.approx(-8 / 3, abs=0.01)
    beam = np.diff(np.log(spectrum(f, speed, 2.6)))[0] / np.diff(np.log(f))[0]
    assert beam < -15  # v / (2 pi sigma) = 1.2 Hz: exp(-(sigma k)^2) takes over
    # Its own identity: the variance, and the structure function from the spectrum.
    grid = np.geomspace(1e-6, 50, 40001)
    p = spectrum(grid, speed, 2.6)
    assert np.trapezoid(p, grid) == pytest.approx(
        beam_correlation(0.0, OUTER_SCALE, 2.6)[0], rel=1e-3
    )
    s = np.trapezoid(p * (1 - np.cos(2 * np.pi * grid * 1.0)), grid)
    assert s == pytest.approx(beam_structure(speed * 1.0, OUTER_SCALE, 2.6)[0], rel=1e-3)


# --------------------------------------------------------------------------------------------------
# overlap


def overlap(width: float, r: float, shape: str) -> float:
    """Share of the air that two footprints ``r`` metres apart have in common.

    disc: common area over area, of diameter ``width``. gaussian: integral of the smaller of two
    normalized footprints of FWHM ``width``, erfc(r / (2 sqrt(2) sigma)).
    """
    if shape == "disc":
        x = min(r / width, 1.0)
        return float(2 / np.pi * (np.arccos(x) - x * np.sqrt(1 - x * x)))
    return float(erfc(r / (2 * np.sqrt(2) * width / 2.3548)))


@pytest.mark.parametrize(("diameter", "disc", "gaussian", "structure_function"), OVERLAPS)
def test_overlap_between_adjacent_detectors(
    diameter: float, disc: float, gaussian: float, structure_function: float
) -> None:
    # The table of docs/atmosphere.md: 150 GHz, lambda / D apart on the sky, 1 km away along the
    # line of sight.
    wavelength = 299792458 / 150e9
    r = wavelength / diameter * 1000
    width = widened(diameter, wavelength, 1000.0)
    assert overlap(width, r, "disc") == pytest.approx(disc, abs=6e-4)
    assert overlap(width, r, "gaussian") == pytest.approx(gaussian, abs=6e-4)
    assert beam_structure(r, OUTER_SCALE, width / 2.3548)[0] == pytest.approx(
        structure_function, rel=0.02
    )
