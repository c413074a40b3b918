"""Transforms against scipy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.fft import dct, next_fast_len
from scipy.ndimage import spline_filter1d

from zonda.core.numerics.transforms import (
    cosine_transform,
    fast_length,
    spline_filter,
    spline_response,
)

ROUNDING = 1e-13  # of sums of up to 1000 terms of order 1


@pytest.mark.parametrize("n", [2, 3, 17, 1000])
def test_cosine_transform(n: int) -> None:
    x = np.random.default_rng(n).normal(size=(3, n))
    np.testing.assert_allclose(cosine_transform(x), dct(x, type=1), rtol=0, atol=ROUNDING * n)


@pytest.mark.parametrize("shape", [(2, 2), (3, 5), (40, 33)])
@pytest.mark.parametrize("axis", [0, 1])
def test_spline_filter(shape: tuple[int, int], axis: int) -> None:
    x = np.random.default_rng(0).normal(size=shape)
    found = spline_filter(x, axis)
    # scipy's recursion starts from a sum that it cuts at 1e-15
    np.testing.assert_allclose(
        found, spline_filter1d(x, 3, axis=axis, mode="mirror"), rtol=0, atol=ROUNDING
    )


def test_spline_of_one_value_is_itself() -> None:
    assert np.array_equal(spline_filter(np.array([[3.0], [4.0]])), [[3.0], [4.0]])


def test_spline_response_is_that_of_its_values_at_the_knots() -> None:
    values = np.zeros(64)
    values[[-1, 0, 1]] = [1 / 6, 4 / 6, 1 / 6]
    np.testing.assert_allclose(
        spline_response(np.fft.fftfreq(64)), np.fft.fft(values).real, atol=1e-15
    )


def test_fast_lengths() -> None:
    for n in range(1, 3000):
        assert fast_length(n) == next_fast_len(n, True)
        assert fast_length(n, (2, 3, 5, 7, 11)) == next_fast_len(n)
