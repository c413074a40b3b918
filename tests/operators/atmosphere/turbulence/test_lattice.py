"""The pyramid: implied covariance, random access, ranges."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import spline_filter
from scipy.signal import fftconvolve

from zonda.core.errors import InputError
from zonda.core.numerics.random import lattice_normals
from zonda.operators.atmosphere.turbulence import lattice
from zonda.operators.atmosphere.turbulence.covariance import beam_correlation, beam_structure
from zonda.operators.atmosphere.turbulence.lattice import Turbulence
from zonda.operators.atmosphere.turbulence.levels import FIDELITIES

from ....checks.implied import implied_covariance

LAGS = (0, 1, 2, 5, 20, 130, 400)
DIRECTIONS = ((0, 1), (1, 0), (1, 1))  # along, across and diagonal
PHASES = ((0, 0), (1, 0), (1, 1), (22, 41))


def implied_error(layer: Turbulence) -> tuple[float, float]:
    """Largest error of the implied covariance (of the variance) and of the structure function (of
    itself, one cell and up).
    """
    ends = [
        (p, p + lag * np.array(d), lag * np.hypot(*d) * layer.spacing)
        for d in DIRECTIONS
        for p in PHASES
        for lag in LAGS
    ]
    a, b, r = (np.array(v) for v in zip(*ends, strict=True))
    here, there, between = (implied_covariance(layer, p, q) for p, q in ((a, a), (b, b), (a, b)))
    s = beam_structure(r, layer.outer_scale, layer.sigma)
    c = beam_correlation(r, layer.outer_scale, layer.sigma)
    apart = r > 0
    worst_c = max(abs(between - c).max(), abs(there - layer.variance).max()) / layer.variance
    worst_s = abs(((here + there) / 2 - between)[apart] / s[apart] - 1).max()
    return worst_c, worst_s


@pytest.mark.parametrize(
    ("fidelity", "sigma", "covariance", "structure"),
    [
        ("default", 21.0, 5e-4, 5e-4),
        ("default", 2.55, 5e-4, 5e-4),
        ("fine", 21.0, 6e-5, 7e-5),
        ("fine", 2.55, 6e-5, 8e-5),
    ],
)
def test_implied_covariance_along_and_across(
    fidelity: str, sigma: float, covariance: float, structure: float
) -> None:
    # Better than numerics.md section 1 (weights that sum to 1), computed exactly from the kernels
    # and taps.
    c, s = implied_error(Turbulence(0, outer_scale=500.0, sigma=sigma, fidelity=fidelity))
    assert c < covariance
    assert s < structure


@pytest.mark.parametrize("fidelity", FIDELITIES)
@pytest.mark.parametrize("ratio", [1e-3, 0.06, 1.0, 30.0, 400.0, 2e4, 1e6])
def test_error_over_the_whole_range_that_is_not_refused(fidelity: str, ratio: float) -> None:
    # hard_cases.md: r0 / cell from 1e-1 (r0 / sigma = 0.06) to 1e6.
    sigma = {1e-3: 21.0, 0.06: 30.0, 1.0: 21.0}.get(ratio, 30.0)
    layer = Turbulence(0, outer_scale=ratio * sigma, sigma=sigma, fidelity=fidelity)
    c, s = implied_error(layer)
    assert c < FIDELITIES[fidelity].error
    assert s < FIDELITIES[fidelity].structure_error


@pytest.mark.parametrize(
    ("outer_scale", "sigma"),
    [
        (1e9, 21.0),
        (0.01, 21.0),
        (np.inf, 21.0),
        (np.nan, 21.0),
        (0.0, 21.0),
        (-500.0, 21.0),
        (500.0, 0.0),
    ],
)
def test_what_the_error_does_not_cover_is_refused(outer_scale: float, sigma: float) -> None:
    with pytest.raises(InputError, match="outer scale"):
        Turbulence(0, outer_scale=outer_scale, sigma=sigma)


def test_refusal_names_the_cure() -> None:
    with pytest.raises(InputError, match=r"outer_scale from 0\.021 m to 2\.1e") as caught:
        Turbulence(0, outer_scale=50e6, sigma=21.0)
    assert "2.38e+06 times" in str(caught.value)


@pytest.mark.parametrize("ratio", [24.0, 1e4, 1e6])
def test_float32_keeps_the_structure_function(ratio: float) -> None:
    # The same field summed in float64 with the same float32 deviates, kernels and weights. What
    # float32 loses between neighbours is noise: its mean square must be small beside 2 S(1 cell),
    # 2e-10 of the variance where r0 / sigma = 1e6.
    layer = Turbulence(5, outer_scale=ratio * 21.0, sigma=21.0)
    fast, exact = layer.region(-20, 44, 7, 71), in_float64(layer, -20, 44, 7, 71)
    lost = fast - exact
    noise = np.mean(np.diff(lost, axis=1) ** 2)
    assert noise < 1e-2 * 2 * beam_structure(layer.spacing, layer.outer_scale, 21.0)[0]
    assert abs(lost).max() < 1e-5


def in_float64(layer: Turbulence, i0: int, i1: int, j0: int, j1: int) -> np.ndarray:
    """`Turbulence.region`, level by level, with scipy in float64."""
    half = layer.fidelity.taps // 2
    boxes = [(i0, i1, j0, j1)]
    for _ in layer.levels[1:]:
        a, b, c, d = boxes[-1]
        boxes.append(
            (
                (a >> 1) - half + 1,
                ((b - 1) >> 1) + half + 1,
                (c >> 1) - half + 1,
                ((d - 1) >> 1) + half + 1,
            )
        )
    weights = layer.weights.astype(np.float64)
    field = None
    for level, key, box, coarse in zip(
        layer.levels[::-1],
        layer._keys[::-1],
        boxes[::-1],
        [(0, 0, 0, 0), *boxes[:0:-1]],
        strict=True,
    ):
        a, b, c, d = box
        here = np.zeros((b - a, d - c))
        if field is not None:
            for axis, (first, last, origin) in enumerate(((a, b, coarse[0]), (c, d, coarse[2]))):
                x = np.arange(first, last)
                matrix = np.zeros((len(x), field.shape[axis]))
                for row, at in enumerate(x):
                    if at & 1:
                        matrix[
                            row, (at >> 1) - half + 1 - origin : (at >> 1) + half + 1 - origin
                        ] = weights
                    else:
                        matrix[row, (at >> 1) - origin] = 1
                field = np.moveaxis(np.tensordot(matrix, field, (1, axis)), 0, axis)
            here += field
        if level.kernel is not None:
            r = len(level.kernel) - 1
            index = abs(np.arange(-r, r + 1))
            noise = lattice_normals(key, a - r, b + r, c - r, d + r).astype(np.float64)
            here += fftconvolve(
                noise, level.kernel[np.ix_(index, index)].astype(np.float64), mode="valid"
            )
        field = here
    assert field is not None
    return field


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
    # 3000 independent realizations of the points 0 and 3 cells: the mean of products of Gaussians
    # of covariance c has the standard error sqrt((v^2 + c^2) / n); 4 of them are allowed.
    n = 3000
    x = np.array(
        [
            Turbulence(k, "mc", outer_scale=500.0, sigma=100.0).region(0, 1, 0, 4)[0, [0, 3]]
            for k in range(n)
        ],
        np.float64,
    )
    layer = Turbulence(0, "mc", outer_scale=500.0, sigma=100.0)
    v, c = beam_correlation([0.0, 3 * layer.spacing], 500.0, 100.0)
    error = 4 * np.sqrt((v * v + c * c) / n)
    assert np.mean(x[:, 0] * x[:, 1]) == pytest.approx(c, abs=error)
    assert np.mean(x**2) == pytest.approx(v, abs=4 * np.sqrt(2 * v * v / n))
    # The difference of the two, whose variance 2 S is 3 % of v, is where a wrong kernel shows:
    # standard error sqrt(2 / n) of it.
    s = beam_structure(3 * layer.spacing, 500.0, 100.0)[0]
    assert np.mean((x[:, 0] - x[:, 1]) ** 2) == pytest.approx(2 * s, rel=4 * np.sqrt(2 / n))
    assert abs(x.mean()) < 4 * np.sqrt(v / n)


def test_names_and_seeds_give_independent_layers() -> None:
    # Fields of 64 x 4096 cells of 8 m; correlation of independent ones: about 33 km / (pi r0) = 20
    # independent pieces.
    def field(seed: int, layer: int) -> np.ndarray:
        return Turbulence(seed, "layer", layer, outer_scale=50.0, sigma=21.0).region(0, 64, 0, 4096)

    a, b, c = field(1, 0), field(2, 0), field(1, 1)
    np.testing.assert_array_equal(a, field(1, 0))
    for other in (b, c):
        # r0 = 50 m: a correlation area of about 2 pi (r0 + sigma)^2 = 3e4 m2 in 512 m x 33 km: 500
        # pieces, 4 / sqrt(500).
        assert abs(np.corrcoef(a.ravel(), other.ravel())[0, 1]) < 0.18


def test_two_beams_see_the_same_air() -> None:
    a = Turbulence(1, "air", outer_scale=500.0, sigma=21.0).region(0, 64, 0, 512)
    b = Turbulence(1, "air", outer_scale=500.0, sigma=24.0).region(0, 64, 0, 512)
    assert np.corrcoef(a.ravel(), b.ravel())[0, 1] > 0.999


def test_the_spline_passes_through_the_field_and_is_scipys() -> None:
    layer = Turbulence(1, "air", outer_scale=500.0, sigma=21.0)
    field, coefficients = layer.region(-40, 60, -40, 60), layer.coefficients(-10, 30, -10, 30)
    exact = spline_filter(field.astype(np.float64), 3, mode="mirror")[30:70, 30:70]
    assert (
        abs(coefficients - exact).max() < 4e-6
    )  # the filter is cut where 3e-6 of the shortest wavelength is left
    third = np.array([1 / 6, 2 / 3, 1 / 6])
    at = sum(
        third[a] * third[b] * coefficients[a : 38 + a, b : 38 + b]
        for a in range(3)
        for b in range(3)
    )
    np.testing.assert_allclose(at, field[31:69, 31:69], atol=4e-6)


@pytest.mark.parametrize(("outer_scale", "sigma"), [(0.021, 21.0), (21e6, 21.0), (1.0, 900.0)])
def test_extremes_that_are_accepted_are_finite(outer_scale: float, sigma: float) -> None:
    field = Turbulence(1, outer_scale=outer_scale, sigma=sigma, fidelity="fine").region(0, 8, 0, 8)
    assert np.isfinite(field).all()
    assert field.std() > 0


def test_a_region_of_one_point_far_away() -> None:
    layer = Turbulence(1, outer_scale=500.0, sigma=21.0)
    assert layer.region(10**12, 10**12 + 1, -(10**12), -(10**12) + 1).shape == (1, 1)
    assert lattice.PREFILTER == 10
