"""What filters fit to each detector: the least-squares fit of numpy, in float64 whatever the stream
is; rows by themselves.
"""

from __future__ import annotations

import numpy as np
import pytest

from zonda.core.flags import INVALID
from zonda.core.numerics.smooth import SmoothField
from zonda.operators.filters.baseline import Fit, polynomials, splines
from zonda.operators.filters.ground import GroundFilter, Template
from zonda.operators.filters.polynomial import Detrend, Pieces, PolynomialFilter
from zonda.operators.filters.rows import AT_ONCE, ROWS, Rows

N = 3 * AT_ONCE + 77
"""Samples: some chunks and a rest."""
EPS = float(np.finfo(np.float64).eps)


def matrix(basis):
    """(N, K): the functions of a basis, all of them."""
    out, low = np.zeros((basis.functions.shape[1], basis.size)), 0
    for high, first in zip(basis.stops, basis.firsts, strict=True):
        out[low:high, first : first + len(basis.functions)] = basis.functions[:, low:high].T
        low = high
    return out


def fitted(functions, row, use):
    """The least-squares fit to the samples that are used, and its tolerance: rounding of the normal
    equations.

    Their coefficients err by about eps cond(B B^T) |c|, the sums by eps |x| for each of some tens
    of additions in a row.
    """
    solution, _, rank, singular = np.linalg.lstsq(functions[use], row[use], rcond=1e-9)
    condition = (singular[0] / singular[rank - 1]) ** 2
    return functions @ solution, 64 * EPS * condition * np.abs(row[np.isfinite(row)]).max()


def rows_of_all_kinds(n, use):
    """Rows, which of their samples are masked, and which are not finite: whole, spoilt, spoilt
    where flagged, masked, both.
    """
    rng = np.random.default_rng(8)
    x, masked = 30 + rng.standard_normal((5, n)).cumsum(axis=1), np.zeros((5, n), bool)
    x[1, [0, 700, n - 1]], x[2, np.flatnonzero(~use)[3]] = np.nan, np.inf
    masked[3, 900:930] = masked[4, 300:330] = True
    x[4, 310:340] = -np.inf
    x[:4, ~use] += 1e3
    return x, masked


@pytest.mark.parametrize("order", range(21))
def test_polynomials_are_the_least_squares_fit(order):
    use = np.ones(N, bool)
    use[1100:1150] = False
    x, masked = rows_of_all_kinds(N, use)
    found, functions = x.copy(), matrix(polynomials(N, order))
    assert Fit.of(polynomials(N, order), use).remove(Rows.of(found), masked) == np.count_nonzero(
        ~np.isfinite(x)
    )
    for before, after, inside in zip(x, found, masked, strict=True):
        finite = np.isfinite(before)
        fit, tolerance = fitted(functions, before, use & finite & ~inside)
        np.testing.assert_allclose(after[finite], (before - fit)[finite], rtol=0, atol=tolerance)
        np.testing.assert_array_equal(after[~finite], before[~finite])


@pytest.mark.parametrize(
    ("spacing", "gap"), [(9.0, 4), (9.0, 150), (3.3, 4), (200.0, 4), (1500.0, 4)]
)
def test_splines_are_the_least_squares_fit(spacing, gap):
    """Also of so many functions that they are solved for by a factor, and where none of the samples
    in a gap determines some.
    """
    use = np.ones(N, bool)
    use[1100 : 1100 + gap] = False
    assert (len(Fit.of(splines(N, spacing), use).inverse) == 4) == (spacing < 10 and gap < 100)
    x, masked = rows_of_all_kinds(N, use)
    x[4] = x[0]
    masked[:] = False
    found, functions = x.copy(), matrix(splines(N, spacing))
    Fit.of(splines(N, spacing), use).remove(Rows.of(found), masked)
    for before, after in zip(x, found, strict=True):
        finite = np.isfinite(before)
        fit, tolerance = fitted(functions, before, use & finite)
        np.testing.assert_allclose(
            after[finite], (before - fit)[finite], rtol=0, atol=max(tolerance, 1e-9)
        )


@pytest.mark.parametrize("trend", [0, 1, 7, 20])
def test_templates_are_the_least_squares_fit(trend):
    """A bin without used samples loses the trend alone."""
    number = np.floor(20 * (1 + np.sin(2 * np.pi * np.arange(N) / 500.3))).astype(np.int64)
    use = (np.arange(N) % 97 > 2) & (number != 11)
    x, _ = rows_of_all_kinds(N, use)
    legendre = polynomials(N, trend).functions[1:]
    found, functions = (
        x.copy(),
        np.column_stack([number[:, None] == np.arange(40), legendre.T]).astype(float),
    )
    assert Template.of(number, legendre, use).remove(Rows.of(found)) == np.count_nonzero(
        ~np.isfinite(x)
    )
    for before, after in zip(x, found, strict=True):
        finite = np.isfinite(before)
        fit, tolerance = fitted(
            functions, before, use & finite
        )  # of the least norm: 0 in the bin without samples
        np.testing.assert_allclose(after[finite], (before - fit)[finite], rtol=0, atol=tolerance)
        np.testing.assert_array_equal(after[~finite], before[~finite])


def drifting_mean(level, n):
    """A mean of these levels (n_det,) that changes by some percent within seconds."""
    drift = 1 + 0.02 * np.random.default_rng(6).standard_normal((1, -(-n // 256) + 3))
    return SmoothField(level[:, None], drift, 256, n)


NUMBER = (np.arange(N) // 50) % 23
REMOVED = {
    "polynomials": lambda use: Fit.of(polynomials(N, 3), use),
    "splines": lambda use: Fit.of(splines(N, 150), use),
    "intervals": lambda use: Pieces.of([slice(30, 800), slice(900, N - 1)], 2, use),
    "template": lambda use: Template.of(NUMBER, polynomials(N, 2).functions[1:], use),
}


@pytest.mark.parametrize("kind", REMOVED)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("beside", [False, True])
def test_a_row_has_the_same_bits_whatever_rows_stand_beside_it(kind, dtype, beside):
    rng = np.random.default_rng(4)
    x = rng.standard_normal((ROWS + 3, N)).astype(dtype)
    x[2, 70] = np.nan
    step = REMOVED[kind](rng.random(N) < 0.9)
    mean = drifting_mean(rng.uniform(30, 40, len(x)), N) if beside else None

    def left(which):
        rows = Rows.of(x[which].copy())
        if mean is not None:
            series = mean.series(which, slice(0, N), np.dtype(np.float64))
            rows = Rows(rows.values, *series, 0, 0)
        assert step.remove(rows) == int(np.isnan(x[which]).sum())
        return rows.values

    together = left(slice(0, len(x)))
    for d in range(len(x)):
        np.testing.assert_array_equal(left(slice(d, d + 1))[0], together[d])
    np.testing.assert_array_equal(left(slice(1, 6)), together[1:6])


@pytest.mark.parametrize(
    "step",
    [
        PolynomialFilter(order=3),
        GroundFilter(bin="10 arcsec", trend=2),
        Detrend(order=2, mask={"radius": "20 arcsec"}),
    ],
    ids=repr,
)
def test_microkelvins_beside_the_mean_are_kept(bench, step):
    """Of 70 K beside a stream of 1e-6 K, single precision would leave steps of 4e-6 K."""
    n = 6000
    level = drifting_mean(np.linspace(60, 70, 5), n)
    x = np.random.default_rng(4).normal(0, 1e-6, (5, n)).astype(np.float32)
    x[1, 33] = np.nan

    def run(stream, mean, precision):
        observation = bench.observation(5, n)
        observation.flags[2000:2100] = INVALID
        means = {"signal": level} if mean else {}
        return bench.run(
            [step], observation, {"signal": stream}, means=means, precision=precision
        ).signal

    beside, inside = (
        run(x, True, "float32"),
        run(x + level.evaluate(slice(0, 5), slice(0, n)), False, "float64"),
    )
    np.testing.assert_allclose(beside, inside, rtol=1e-6, atol=1e-12)
