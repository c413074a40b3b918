"""Intervals: TOAST's rule of which samples belong to them."""

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from zonda.core.flags import cut_intervals, intervals_of, samples_in


@given(st.lists(st.booleans(), min_size=2, max_size=60), st.integers(0, 2**31))
def test_runs_hold_their_samples(inside, seed):
    """All but the last one, which belongs to an interval that ends before it (TOAST's rule)."""
    mask = np.array(inside)
    seconds = np.sort(np.random.default_rng(seed).uniform(0, 100, len(mask)))
    spans = intervals_of(mask, seconds)
    found = samples_in(spans, seconds)
    np.testing.assert_array_equal(found[:-1], mask[:-1])
    assert found[-1] == mask[-2]
    assert all(a < b for a, b in spans)
    assert all(before[1] < after[0] for before, after in pairwise(spans))


def test_part():
    whole = {"scanning": [(0.0, 4.0), (5.0, 9.0)], "elnod": [(0.0, 1.0)]}
    assert cut_intervals(whole, 3.0, 7.0) == {"scanning": [(0.0, 1.0), (2.0, 4.0)], "elnod": []}
