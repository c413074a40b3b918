"""Stretches of long scans, and memory for what lasts."""

import numpy as np
import pytest
from scipy.ndimage import spline_filter1d

from zonda.core.numerics.chunks import CHUNK, LARGE, chunks, empty
from zonda.core.numerics.smooth import REACH, interpolating


@pytest.mark.parametrize("n", [0, 1, CHUNK - 1, CHUNK, CHUNK + 1, 5 * CHUNK + 7])
def test_chunks_are_all_instants_in_order(n: int) -> None:
    parts = chunks(n)
    assert [k for part in parts for k in (part.start, part.stop)] == sorted(
        [0, n] + 2 * [*range(CHUNK, n, CHUNK)]
    ) * (n > 0)


@pytest.mark.parametrize("bytes_", [0, 48, LARGE, LARGE + 24])
def test_empty_is_an_array_like_any_other(bytes_: int) -> None:
    found = empty((3, bytes_ // 24))
    assert not found.any()
    found[...] = 7.0
    assert found.shape == (3, bytes_ // 24)
    assert found.flags.c_contiguous
    assert (found == 7.0).all()


@pytest.mark.parametrize("m", [1, 2, 3, REACH, REACH + 1, 300])
def test_interpolating_is_the_filter_that_mirrors_its_rows(m: int) -> None:
    """To rounding: the filter's absolute values add up to 3 (1.1e-16 each way), and what is cut off
    is 0.27^29 = 3e-17.
    """
    values = np.random.default_rng(m).uniform(-1, 1, (2, m))
    expected = spline_filter1d(values, 3, axis=1, mode="mirror") if m > 1 else values
    np.testing.assert_allclose(interpolating(values), expected, rtol=0, atol=3e-15)
    np.testing.assert_array_equal(interpolating(np.asfortranarray(values)), interpolating(values))
