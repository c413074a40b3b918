"""The pyramid: implied covariance, random access, ranges."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import spline_filter

from zonda.core.errors import InputError
from zonda.operators.atmosphere import turbulence
from zonda.operators.atmosphere.covariance import beam_correlation, beam_structure
from zonda.operators.atmosphere.turbulence import FIDELITIES, Turbulence, interpolate

LAGS = (0, 1, 2, 5, 20, 130, 400)
DIRECTIONS = ((0, 1), (1, 0), (1, 1))  # along, across and diagonal
PHASES = ((0, 0), (1, 0), (1, 1), (22, 41))


def implied_error(layer: Turbulence) -> tuple[float, float]:
    """Largest error of the implied covariance (of the variance) and of the structure function (of itself, one cell and up)."""
    ends = [(p, p + lag * np.array(d), lag * np.hypot(*d) * layer.spacing) for d in DIRECTIONS for p in PHASES for lag in LAGS]
    a, b, r = (np.array(v) for v in zip(*ends, strict=True))
    here, there, between = (layer.implied_covariance(p, q) for p, q in ((a, a), (b, b), (a, b)))
    s = beam_structure(r, layer.outer_scale, layer.sigma)
    c = beam_correlation(r, layer.outer_scale, layer.sigma)
    apart = r > 0
    worst_c = max(abs(between - c).max(), abs(there - layer.variance).max()) / layer.variance
    worst_s = abs(((here + there) / 2 - between)[apart] / s[apart] - 1).max()
    return worst_c, worst_s


@pytest.mark.parametrize(
    ("fidelity", "sigma", "covariance", "structure"),
    [
        ("default", 21.0, 1.3e-3, 1.5e-3),
        ("default", 2.55, 2.9e-3, 4e-3),
        ("fine", 21.0, 1e-4, 1e-4),
        ("fine", 2.55, 2.3e-4, 2e-4),
    ],
)
def test_implied_covariance_along_and_across(fidelity: str, sigma: float, covariance: float, structure: float) -> None:
    # Figures of numerics.md section 1, computed exactly from the kernels and taps.
    c, s = implied_error(Turbulence(0, outer_scale=500.0, sigma=sigma, fidelity=fidelity))
    assert c < covariance
    assert s < structure


@pytest.mark.parametrize(
    ("fidelity", "ratio"), [(f, r) for f in FIDELITIES for r in (1e-3, 1.0, 30.0, FIDELITIES[f].scale_ratio)]
)
@pytest.mark.parametrize("sigma", [21.0, 30.0])
def test_error_over_the_whole_range_that_is_not_refused(fidelity: str, ratio: float, sigma: float) -> None:
    layer = Turbulence(0, outer_scale=ratio * sigma, sigma=sigma, fidelity=fidelity)
    c, s = implied_error(layer)
    assert c < FIDELITIES[fidelity].error
    assert s < FIDELITIES[fidelity].structure_error


@pytest.mark.parametrize(
    ("outer_scale", "sigma", "fidelity"),
    [(50e3, 21.0, "default"), (1e9, 21.0, "fine"), (0.01, 21.0, "default"), (np.inf, 21.0, "fine")],
)
def test_what_the_error_does_not_cover_is_refused(outer_scale: float, sigma: float, fidelity: str) -> None:
    with pytest.raises(InputError, match="outer scale"):
        Turbulence(0, outer_scale=outer_scale, sigma=sigma, fidelity=fidelity)


def test_refusal_names_the_cure() -> None:
    with pytest.raises(InputError, match="fidelity: fine"):
        Turbulence(0, outer_scale=50e3, sigma=21.0)
    Turbulence(0, outer_scale=50e3, sigma=21.0, fidelity="fine")


@settings(max_examples=40, deadline=None)
@given(
    corner=st.tuples(*[st.integers(-(2**40), 2**40)] * 2),
    inset=st.tuples(*[st.integers(0, 60)] * 2),
    shape=st.tuples(*[st.integers(1, 40)] * 2),
    prefiltered=st.booleans(),
)
def test_a_point_has_the_same_bits_in_every_region(
    corner: tuple[int, int], inset: tuple[int, int], shape: tuple[int, int], prefiltered: bool
) -> None:
    layer = Turbulence(3, "layer", 2, outer_scale=500.0, sigma=21.0)
    get = layer.coefficients if prefiltered else layer.region
    (i, j), (di, dj), (n, m) = corner, inset, shape
    whole = get(i, i + 100, j, j + 100)
    part = get(i + di, i + di + n, j + dj, j + dj + m)
    np.testing.assert_array_equal(part, whole[di : di + n, dj : dj + m])


def test_sampled_covariance_agrees_with_the_analytic_one() -> None:
    # 3000 independent realizations of the points 0 and 3 cells: the mean of products of Gaussians of covariance c has the
    # standard error sqrt((v^2 + c^2) / n); 4 of them are allowed.
    n = 3000
    x = np.array(
        [Turbulence(k, "mc", outer_scale=500.0, sigma=100.0).region(0, 1, 0, 4)[0, [0, 3]] for k in range(n)], np.float64
    )
    layer = Turbulence(0, "mc", outer_scale=500.0, sigma=100.0)
    v, c = beam_correlation([0.0, 3 * layer.spacing], 500.0, 100.0)
    error = 4 * np.sqrt((v * v + c * c) / n)
    assert np.mean(x[:, 0] * x[:, 1]) == pytest.approx(c, abs=error)
    assert np.mean(x**2) == pytest.approx(v, abs=4 * np.sqrt(2 * v * v / n))
    # The difference of the two, whose variance 2 S is 3 % of v, is where a wrong kernel shows: standard error sqrt(2 / n) of it.
    s = beam_structure(3 * layer.spacing, 500.0, 100.0)[0]
    assert np.mean((x[:, 0] - x[:, 1]) ** 2) == pytest.approx(2 * s, rel=4 * np.sqrt(2 / n))
    assert abs(x.mean()) < 4 * np.sqrt(v / n)


def test_names_and_seeds_give_independent_layers() -> None:
    # Fields of 64 x 4096 cells of 8 m; correlation of independent ones: about 33 km / (pi r0) = 20 independent pieces.
    def field(seed: int, layer: int) -> np.ndarray:
        return Turbulence(seed, "layer", layer, outer_scale=50.0, sigma=21.0).region(0, 64, 0, 4096)

    a, b, c = field(1, 0), field(2, 0), field(1, 1)
    np.testing.assert_array_equal(a, field(1, 0))
    for other in (b, c):
        # r0 = 50 m: a correlation area of about 2 pi (r0 + sigma)^2 = 3e4 m2 in 512 m x 33 km: 500 pieces, 4 / sqrt(500).
        assert abs(np.corrcoef(a.ravel(), other.ravel())[0, 1]) < 0.18


def test_two_beams_see_the_same_air() -> None:
    a = Turbulence(1, "air", outer_scale=500.0, sigma=21.0).region(0, 64, 0, 512)
    b = Turbulence(1, "air", outer_scale=500.0, sigma=24.0).region(0, 64, 0, 512)
    assert np.corrcoef(a.ravel(), b.ravel())[0, 1] > 0.999


def test_interpolation_passes_through_the_field_and_is_the_cubic_spline() -> None:
    layer = Turbulence(1, "air", outer_scale=500.0, sigma=21.0)
    field, coefficients = layer.region(-40, 60, -40, 60), layer.coefficients(-10, 30, -10, 30)
    exact = spline_filter(field.astype(np.float64), 3, mode="mirror")[30:70, 30:70]
    assert abs(coefficients - exact).max() < 2e-6
    i, j = (v.ravel().astype(np.float64) for v in np.mgrid[-8:26, -8:26])
    at = np.zeros(i.size)
    interpolate(coefficients, -10, -10, i, j, 2.0, at)
    np.testing.assert_allclose(at, 2 * field[32:66, 32:66].ravel(), atol=4e-6)


@pytest.mark.parametrize(("outer_scale", "sigma"), [(0.021, 21.0), (84e3, 21.0), (1.0, 900.0)])
def test_extremes_that_are_accepted_are_finite(outer_scale: float, sigma: float) -> None:
    field = Turbulence(1, outer_scale=outer_scale, sigma=sigma, fidelity="fine").region(0, 8, 0, 8)
    assert np.isfinite(field).all()
    assert field.std() > 0


def test_a_region_of_one_point_far_away() -> None:
    layer = Turbulence(1, outer_scale=500.0, sigma=21.0)
    assert layer.region(10**12, 10**12 + 1, -(10**12), -(10**12) + 1).shape == (1, 1)
    assert turbulence.PREFILTER == 10
