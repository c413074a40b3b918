"""Interpolation errors against brute force with the covariance, and the choices made from them."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

from zonda.operators.atmosphere.turbulence.covariance import beam_correlation, mixture
from zonda.operators.atmosphere.turbulence.nodes import (
    LARGEST_STEP,
    Layer,
    _sides,
    candidate_steps,
    chebyshev,
    choose_nodes,
    differential_rms,
    grid,
    grid_error,
    lagrange,
    spline_error,
    spread_evenly,
    time_error,
)

RNG = np.random.default_rng(1)
XI, ETA = RNG.uniform(-0.01, 0.01, (2, 300))
LAYERS = [Layer(0.8, 500.0, 600.0, 500.0, 2.6), Layer(0.6, 3000.0, 3600.0, 500.0, 3.0)]


@pytest.mark.parametrize("n", [1, 2, 3, 5])
@pytest.mark.parametrize("stretch", [1.0, 1.7])
def test_focal_plane_error_is_the_expectation_over_the_ensemble(n: int, stretch: float) -> None:
    # Brute force: mean over detectors of C(0) - 2 W.C(d, nodes) + W C(nodes, nodes) W for the whole
    # weight matrix.
    nodes = grid(XI, ETA, n)
    total = 0.0
    for layer in LAYERS:
        a, b = (
            np.array([x, stretch * y]) * layer.distance
            for x, y in ((XI, ETA), (nodes.xi, nodes.eta))
        )
        cross = beam_correlation(
            np.hypot(*(a[:, :, None] - b[:, None])), layer.outer_scale, layer.sigma
        )
        among = beam_correlation(
            np.hypot(*(b[:, :, None] - b[:, None])), layer.outer_scale, layer.sigma
        )
        error = beam_correlation(0.0, layer.outer_scale, layer.sigma)[0] - 2 * (
            nodes.weights * cross
        ).sum(1)
        error += np.einsum("dn,nm,dm->d", nodes.weights, among, nodes.weights)
        total += layer.amplitude**2 * error.mean()
    assert grid_error(nodes.xi[::n], nodes.eta[:n], XI, ETA, LAYERS, stretch) == pytest.approx(
        np.sqrt(total), rel=1e-3
    )


def test_differential_rms_is_what_the_mean_leaves() -> None:
    r = np.hypot(*(np.array([XI, ETA])[:, :, None] - np.array([XI, ETA])[:, None]))
    expected = 0.0
    for layer in LAYERS:
        c = beam_correlation(r * layer.distance, layer.outer_scale, layer.sigma)
        expected += layer.amplitude**2 * (c[0, 0] - c.mean())
    assert differential_rms(XI, ETA, LAYERS) == pytest.approx(np.sqrt(expected), rel=1e-6)


@pytest.mark.parametrize("q", [0.2, 0.5, 1.0, 2.0, 5.0, 50.0])
def test_spline_error_is_the_expectation_over_the_ensemble(q: float) -> None:
    # The weights of a 61-point cubic spline at the middle interval, averaged over the position
    # inside it.
    knots = np.arange(61.0)
    u = 30 + (np.arange(20) + 0.5) / 20
    weights = make_interp_spline(knots, np.eye(61), k=3)(u)
    cross = np.exp(-((q * np.subtract.outer(u, knots)) ** 2) / 4)
    among = np.exp(-((q * np.subtract.outer(knots, knots)) ** 2) / 4)
    error = 1 - 2 * (weights * cross).sum(1) + np.einsum("un,nm,um->u", weights, among, weights)
    assert spline_error(np.array([q]))[0] == pytest.approx(error.mean(), rel=1e-3, abs=1e-14)


def test_spline_error_falls_as_the_eighth_power() -> None:
    small = spline_error(np.array([1e-3, 1e-2, 2e-2]))
    assert small[1] / small[0] == pytest.approx(1e8, rel=1e-2)
    assert small[2] / small[1] == pytest.approx(2.0**8, rel=1e-2)
    assert spline_error(np.array([0.0]))[0] < 1e-40


def test_the_table_of_the_spline_error_is_what_its_equation_gives() -> None:
    path = (
        Path(__file__).resolve().parents[4]
        / "benchmarks"
        / "atmosphere_data"
        / "tabulate_spline_error.py"
    )
    log_q, log_g = runpy.run_path(str(path))["spline_table"]()
    # Where q is small the integrand is a difference of numbers near 1: G >= 1e-23 there, of
    # rounding 1e-32.
    assert np.allclose(spline_error(np.exp(log_q)), np.exp(log_g), rtol=1e-6, atol=0.0)


@pytest.mark.parametrize(("lattice", "error"), [(0.8, 1.2e-4), (0.6, 5e-5), (0.5, 2e-5)])
def test_the_lattice_itself_is_fine_enough(lattice: float, error: float) -> None:
    # numerics.md section 3: rms 7e-6 to 3e-5 of the field at 0.5 to 0.7 sigma, per axis; here for
    # both axes together.
    e, w = mixture(500.0, 21.0)
    assert np.sqrt(2 * (spline_error(lattice * 21.0 / np.sqrt(e)) @ w)) < error


def test_time_error_adds_path_and_speed() -> None:
    still = time_error(LAYERS, [np.zeros(1)] * 2, [0.0, 0.0], 1.0)
    moved = time_error(LAYERS, [np.zeros(1)] * 2, [0.1, 0.1], 1.0)
    fast = time_error(LAYERS, [np.full(1, 20.0)] * 2, [0.0, 0.0], 1.0)
    assert still < 1e-15
    assert 0 < moved < 0.1
    assert 0.01 < fast < 1.5
    # Across many sigma per step the samples are independent: error > the field itself.
    assert time_error(LAYERS, [np.full(1, 1e6)] * 2, [0.0, 0.0], 1.0) > 1


def test_an_error_is_within_what_it_is_itself() -> None:
    way = [np.full(3, 2.0)] * 2, [0.01, 0.02], 0.5
    error = time_error(LAYERS, *way)
    assert time_error(LAYERS, *way, error) == error
    assert time_error(LAYERS, *way, 0.0) > 0


@pytest.mark.parametrize(("radius", "stretch"), [(1e-6, 1.0), (1e-3, 1.5), (0.02, 1.0), (0.3, 1.0)])
def test_differences_of_near_detectors_are_those_of_far_ones(radius: float, stretch: float) -> None:
    # By the definition, all exponentials taken; expm1 cancels nothing, so only rounding differs.
    xi, eta = XI / 0.01 * radius, ETA / 0.01 * radius
    square = np.subtract.outer(xi, xi) ** 2 + (stretch * np.subtract.outer(eta, eta)) ** 2
    total = 0.0
    for layer in LAYERS:
        for e, w in zip(*layer.gaussian(), strict=True):
            total -= (
                layer.amplitude**2 * w * np.expm1(-(layer.distance**2) * square / (4 * e)).mean()
            )
    assert differential_rms(xi, eta, LAYERS, stretch) == pytest.approx(np.sqrt(total), rel=1e-12)


@pytest.mark.parametrize("tolerance", [1e-2, 1e-4, 1e-6])
def test_the_coarsest_grid_within_tolerance_is_chosen(tolerance: float) -> None:
    layers = [Layer(1.0, 500.0, 600.0, 500.0, 42.5)]
    nodes, error = choose_nodes(XI, ETA, layers, tolerance)
    assert error <= tolerance
    assert nodes.shape is not None
    coarser = nodes.shape[0] - 1
    assert (
        coarser == 0
        or grid_error(*_sides(XI, ETA, coarser), *spread_evenly(XI, ETA), layers) > tolerance
    )


def test_where_nodes_do_not_pay_the_detectors_are_the_nodes() -> None:
    nodes, error = choose_nodes(XI * 100, ETA * 100, LAYERS, 1e-5)
    assert nodes.shape is None
    assert error == 0.0
    assert nodes.weights.size == 0
    one, error = choose_nodes(np.array([0.3]), np.array([0.2]), LAYERS, 1e-5)
    assert (one.xi, one.eta, error) == (0.3, 0.2, 0.0)
    assert str(one) == "none: each of 1 detectors by itself"
    assert str(grid(XI, ETA, 2)) == "2 x 2 Chebyshev"


def test_detectors_on_a_line_need_nodes_on_a_line() -> None:
    nodes = grid(XI, np.full_like(XI, 0.1), 4)
    assert nodes.shape == (4, 1)
    assert set(nodes.eta) == {0.1}


@pytest.mark.parametrize("n", [1, 2, 5, 16])
def test_weights_reproduce_polynomials(n: int) -> None:
    x = np.linspace(-1, 3, 40)
    nodes = chebyshev(-1, 3, n)
    points = np.r_[x, nodes]
    for power in range(n):
        np.testing.assert_allclose(
            lagrange(nodes, points) @ nodes**power,
            points**power,
            atol=1e-13 * 3.0**power,
            rtol=1e-12,
        )
    assert np.isfinite(lagrange(nodes, nodes)).all()


@pytest.mark.parametrize(("n_samples", "largest"), [(1, 1), (7, 1), (50, 8), (10**6, LARGEST_STEP)])
def test_candidate_steps(n_samples: int, largest: int) -> None:
    steps = candidate_steps(n_samples)
    assert steps[0] == largest
    assert steps[-1] == 1
