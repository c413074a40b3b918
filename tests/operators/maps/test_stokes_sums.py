"""The sums of maps of I, Q and U: every term, whatever runs of samples fall in one pixel, and bands
that share their pixels.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zonda.core.polarization import PolarizationAngles
from zonda.operators.maps.intensity_kernel import (
    FLAGGED,
    LARGEST,
    NOT_FINITE,
    OUTSIDE,
    TOO_LARGE,
    VALUE,
    WEIGHT,
)
from zonda.operators.maps.stokes_kernel import AT_ONCE, DATA, add_stokes

N_PIXELS = 7


def term_by_term(
    signals,
    first,
    rows,
    at,
    cells,
    angles,
    which,
    start,
    good,
    window,
    weight,
    noise,
    own,
    sums,
    dropped,
    largest,
):
    """What `add_stokes` adds up, in plain Python: every term rounded once."""
    m = len(signals)
    turn = np.empty((2, len(rows), cells.shape[1]))
    PolarizationAngles(*angles[:4]).fill(which, start, *turn)
    turn = np.rint(angles[4][which, None] * turn * WEIGHT) / WEIGHT
    for k, d in enumerate(rows):
        high = 0.0
        for t in range(cells.shape[1]):
            values = [float(signal[d, first + t]) for signal in signals]
            pixel = cells[at[k], t]
            size = max(map(abs, values)) if np.isfinite(values).all() else np.inf
            if not good[t]:
                dropped[FLAGGED] += 1
            elif size == np.inf:
                dropped[NOT_FINITE] += 1
            elif pixel < 0:
                dropped[OUTSIDE] += 1
            elif size >= LARGEST / VALUE / max(weight[k], 1.0):
                dropped[TOO_LARGE] += 1
            else:
                high = max(high, size)
                c, s = turn[:, k, t]
                share = window[t] if window.size else 1.0
                w, n = weight[k] * share * WEIGHT, noise[k] * share * share * WEIGHT
                data = [weight[k] * VALUE * value for value in values]
                terms = [w, w * c, w * s, w * c * c, w * c * s, w * s * s]
                terms += [y for x in data for y in (x, x * c, x * s)]
                terms += [n, n * c, n * s, n * c * c, n * c * s, n * s * s] if own else []
                sums[pixel] += [1, *np.rint(terms).astype(np.int64)]
        if good.any():
            largest[0] = max(largest[0], weight[k] * WEIGHT, noise[k] * WEIGHT)
            largest[1] = max(largest[1], high * weight[k] * VALUE + 1.0)
    assert sums.shape[1] == DATA + 3 * m + 6 * own


def random_tile(seed, *, signals, n, run, own, window, spoilt, dtype, plate=False, n_rows=3):
    """Arguments of `add_stokes` without what it changes; some ``run`` samples in a pixel, one after
    the other.
    """
    rng = np.random.default_rng(seed)
    first, n_cells = int(rng.integers(0, 5)), n_rows + 1
    data = tuple(rng.normal(0, 3, (6, first + n + 2)).astype(dtype) for _ in range(signals))
    rows, at = (
        np.sort(rng.choice(6, n_rows, replace=False)),
        np.sort(rng.choice(n_cells, n_rows, replace=False)),
    )
    cells = rng.integers(0, N_PIXELS, (n_cells, n)).astype(np.int32)
    cells = np.repeat(cells, run, axis=1)[:, :n].copy()
    start, which = int(rng.integers(0, 9)), np.sort(rng.choice(8, n_rows, replace=False))
    plate = rng.normal(size=(2, start + n)) if plate else np.zeros((2, 0))
    plate /= np.hypot(*plate)
    gamma, efficiency = np.tile([0.8, -0.6], (8, 1)), rng.uniform(0, 1, 8)
    angles = rng.normal(size=(3, start + n)), rng.normal(size=(8, 2, 3)), plate, gamma, efficiency
    good = np.ones(n, np.uint8)
    weight, noise = rng.uniform(0.1, 3, (2, n_rows))
    if spoilt:
        good[rng.random(n) < 0.1] = 0
        cells[rng.random(cells.shape) < 0.1] = -1
        for signal in data:
            signal[rng.random(signal.shape) < 0.05] = rng.choice([np.nan, np.inf, -np.inf])
            signal[rng.random(signal.shape) < 0.05] = rng.choice([2e4, -2e4])
    share = rng.uniform(0, 1, n) if window else np.zeros(0)
    return data, first, rows, at, cells, angles, which, start, good, share, weight, noise, own


def results(function, tile):
    sums = np.zeros((N_PIXELS, DATA + 3 * len(tile[0]) + 6 * tile[-1]), np.int64)
    dropped, largest = np.zeros(4, np.int64), np.zeros(2)
    function(*tile, sums, dropped, largest)
    return sums, dropped, largest


def added(*of):
    """`add_stokes` of one band."""
    *tile, weight, noise, own, sums, dropped, largest = of
    add_stokes(*tile, own, ((weight, noise, sums, dropped, largest),))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("signals", [1, 3])
@pytest.mark.parametrize(("own", "window"), [(False, False), (True, False), (True, True)])
def test_every_term_is_added(signals, dtype, own, window):
    """Also over the ends of what is worked on at once, and where only some of it counts."""
    for seed, (n, run, spoilt) in enumerate(
        [(2 * AT_ONCE + 3, 1, False), (AT_ONCE + 40, 9, True), (AT_ONCE, 9, False)]
    ):
        tile = random_tile(
            seed, signals=signals, n=n, run=run, own=own, window=window, spoilt=spoilt, dtype=dtype
        )
        for found, expected in zip(results(added, tile), results(term_by_term, tile), strict=True):
            np.testing.assert_array_equal(found, expected)


@settings(deadline=None, max_examples=60)
@given(
    st.integers(0, 2**31),
    st.integers(1, 60),
    st.integers(1, 70),
    st.integers(1, 2),
    st.tuples(*[st.booleans()] * 4),
)
def test_terms_of_any_tile(seed, n, run, signals, choices):
    spoilt, own, window, plate = choices
    how = {
        "own": own or window,
        "window": window,
        "spoilt": spoilt,
        "plate": plate,
        "dtype": np.float64,
    }
    tile = random_tile(seed, signals=signals, n=n, run=run, **how)
    for found, expected in zip(results(added, tile), results(term_by_term, tile), strict=True):
        np.testing.assert_array_equal(found, expected)


@settings(deadline=None, max_examples=60)
@given(
    st.integers(0, 2**31),
    st.integers(1, 60),
    st.integers(1, 70),
    st.integers(1, 2),
    st.tuples(*[st.booleans()] * 5),
)
def test_bands_have_the_bits_that_they_have_alone(seed, n, run, signals, choices):
    """Of equal weights or others; what is spoilt is so in one of them or in both."""
    alike, spoilt, own, window, other = choices
    how = {
        "signals": signals,
        "n": n,
        "run": run,
        "own": own or window,
        "window": window,
        "dtype": np.float64,
    }
    one = random_tile(seed, spoilt=spoilt, **how)
    rng = np.random.default_rng(seed)
    data = tuple(rng.normal(0, 3, array.shape) for array in one[0])
    if other:
        data[0][rng.random(data[0].shape) < 0.05] = np.nan
    weight, noise = (one[-3], one[-2]) if alike else rng.uniform(0.1, 3, (2, one[-3].size))
    two = (data, *one[1:-3], weight, noise, one[-1])
    expected = [results(term_by_term, tile) for tile in (one, two)]
    found = [
        (np.zeros_like(sums), np.zeros_like(dropped), np.zeros_like(largest))
        for sums, dropped, largest in expected
    ]
    bands = tuple((tile[-3], tile[-2], *mine) for tile, mine in zip((one, two), found, strict=True))
    add_stokes(one[0] + data, *one[1:-3], one[-1], bands)
    for mine, theirs in zip(found, expected, strict=True):
        for a, b in zip(mine, theirs, strict=True):
            np.testing.assert_array_equal(a, b)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**31), st.integers(1, 2 * AT_ONCE), st.integers(1, 30))
def test_where_samples_are_cut_does_not_matter(seed, cut, run):
    """Two tiles, one after the other, add up to the bits of one."""
    n = 2 * AT_ONCE + 1
    tile = random_tile(
        seed, signals=1, n=n, run=run, own=False, window=False, spoilt=True, dtype=np.float32
    )
    signals, first, rows, at, cells, angles, which, start, good, *rest = tile
    one = signals, first, rows, at, cells[:, :cut].copy(), angles, which, start, good[:cut], *rest
    two = (
        signals,
        first + cut,
        rows,
        at,
        cells[:, cut:].copy(),
        angles,
        which,
        start + cut,
        good[cut:],
        *rest,
    )
    whole, parts = results(added, tile), [results(added, part) for part in (one, two)]
    np.testing.assert_array_equal(whole[0], parts[0][0] + parts[1][0])
    np.testing.assert_array_equal(whole[1], parts[0][1] + parts[1][1])
    np.testing.assert_array_equal(whole[2], np.maximum(parts[0][2], parts[1][2]))


def test_nothing_counts_in_a_tile_without_good_samples():
    tile = list(
        random_tile(
            1, signals=1, n=600, run=3, own=False, window=False, spoilt=False, dtype=np.float32
        )
    )
    tile[8] = np.zeros(600, np.uint8)
    sums, dropped, largest = results(added, tuple(tile))
    assert not sums.any()
    assert not largest.any()
    np.testing.assert_array_equal(dropped, [0, 3 * 600, 0, 0])


def test_a_window_enters_the_noise_squared() -> None:
    """Equation (2) of `binning`: two samples of window 1/2 add 2 x 1/4 of their w^2 sigma^2 to
    N, 2 x 1/2 of w to A.
    """
    sums, one, index = np.zeros((1, DATA + 3 + 6), np.int64), np.ones(1), np.zeros(1, np.int64)
    angles = (
        np.ones((3, 2)),
        np.array([[[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]]),
        np.zeros((2, 0)),
        np.zeros((1, 2)),
    )  # psi = 0
    how = (
        (*angles, 0.8 * one),
        index,
        0,
        np.ones(2, np.uint8),
        np.full(2, 0.5),
        one,
        0.8 * one,
        True,
    )
    added(
        (np.ones((1, 2)),),
        0,
        index,
        index,
        np.zeros((1, 2), np.int32),
        *how,
        sums,
        np.zeros(4, np.int64),
        np.zeros(2),
    )
    assert sums[0, 1] == WEIGHT
    expected = np.array([1, 0.8, 0, 0.64, 0, 0]) * 0.4
    np.testing.assert_allclose(sums[0, DATA + 3 :] / WEIGHT, expected, atol=2 / WEIGHT)
