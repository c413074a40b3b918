import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zonda.core.numerics.random import TILE, lattice_normals, normals, philox, stream_key, uniforms

KEY = stream_key(1, "test")
PINNED_KEY = [3933384497, 3810671582]
PINNED_NORMALS = [0.0001664161, 0.8474617, 0.064707, 1.22968]
PINNED_UNIFORMS = [0.037095769658, 0.12072954082, 0.54030664929, 0.98243043164]
PINNED_LATTICE = [[0.6476921, -0.4335197], [-0.07885164, -0.09874845]]


@pytest.mark.parametrize(
    ("counter", "key", "expected"),
    [
        ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((0xFFFFFFFF,) * 4, (0xFFFFFFFF,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
            (0xA4093822, 0x299F31D0),
            (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
        ),
    ],
)
def test_philox_known_answers(counter, key, expected):
    """Random123 1.14, kat_vectors, philox4x32 10."""
    words = np.empty((4, 1), np.uint32)
    philox(np.array(key, np.uint32), *(np.uint64(c) for c in counter), words)
    assert tuple(words[:, 0].tolist()) == expected


def test_philox_many_counters_at_once():
    words, one = np.empty((4, 256), np.uint32), np.empty((4, 1), np.uint32)
    philox(KEY, np.uint64(512), np.uint64(7), np.uint64(8), np.uint64(9), words)
    for b in (0, 1, 100, 255):
        philox(KEY, np.uint64(512 + b), np.uint64(7), np.uint64(8), np.uint64(9), one)
        assert (words[:, b] == one[:, 0]).all()


def test_stream_keys_are_unambiguous():
    names = [
        (),
        ("",),
        ("a",),
        ("a", ""),
        ("", "a"),
        ("ab", "c"),
        ("a", "bc"),
        (1,),
        ("1",),
        (11,),
        (1, 1),
        (-1,),
    ]
    keys = {tuple(stream_key(seed, *n).tolist()) for seed in (0, 1, -1, 2**70) for n in names}
    assert len(keys) == 4 * len(names)
    assert stream_key(3, "x").dtype == np.uint32
    assert stream_key(3, "x").tolist() == stream_key(3, "x").tolist()
    assert stream_key(3, np.int64(5)).tolist() == stream_key(3, 5).tolist()
    with pytest.raises(TypeError, match="named by str and int"):
        stream_key(3, 1.5)


def test_bits_are_pinned():
    """The same seed gives the same sky in the next version. Rounded: the last bits may differ
    between processors.
    """
    assert stream_key(1, "test").tolist() == PINNED_KEY
    np.testing.assert_allclose(normals(KEY, -2, 2), PINNED_NORMALS, rtol=1e-5)
    np.testing.assert_allclose(uniforms(KEY, -2, 2), PINNED_UNIFORMS, rtol=1e-9)
    np.testing.assert_allclose(lattice_normals(KEY, -1, 1, -1, 1), PINNED_LATTICE, rtol=1e-5)


@settings(max_examples=40, deadline=None)
@given(
    start=st.integers(-(2**62), 2**62), cuts=st.lists(st.integers(0, 5000), min_size=2, max_size=6)
)
def test_cuts_never_change_a_bit(start, cuts):
    cuts = sorted(cuts)
    for make in (normals, uniforms):
        whole = make(KEY, start + cuts[0], start + cuts[-1], stream=5)
        parts = [make(KEY, start + a, start + b, stream=5) for a, b in itertools.pairwise(cuts)]
        assert np.array_equal(np.concatenate(parts), whole)


@settings(max_examples=25, deadline=None)
@given(
    i=st.integers(-(2**63), 2**63 - 200),
    j=st.integers(-(2**63), 2**63 - 200),
    a=st.integers(0, 99),
    b=st.integers(0, 99),
)
def test_lattice_regions_agree(i, j, a, b):
    whole = lattice_normals(KEY, i, i + 100, j, j + 100)
    part = lattice_normals(KEY, i + a, i + 100, j + b, j + 100)
    assert np.array_equal(part, whole[a:, b:])
    assert np.isfinite(whole).all()


def test_float64_output_holds_the_same_numbers():
    assert np.array_equal(normals(KEY, 5, 3000), normals(KEY, 5, 3000, out=np.empty(2995)))


def test_normals_are_standard_normal():
    n = 1 << 23
    x = normals(KEY, -n // 2, n // 2).astype(np.float64)
    # Standard errors of the first four moments, and sqrt(n p) of a histogram: 4.5 sigma each.
    assert abs(x.mean()) < 4.5 / np.sqrt(n)
    assert abs(x.var() - 1) < 4.5 * np.sqrt(2 / n)
    assert abs((x**3).mean()) < 4.5 * np.sqrt(15 / n)
    assert abs((x**4).mean() - 3) < 4.5 * np.sqrt(96 / n)
    from scipy.stats import norm

    edges = np.array([-9, -4.5, -4, -3.5, -3, -2, -1, -0.3, 0, 0.3, 1, 2, 3, 3.5, 4, 4.5, 9])
    count, _ = np.histogram(x, edges)
    expected = n * np.diff(norm.cdf(edges))
    assert (abs(count - expected) < 4.5 * np.sqrt(expected) + 1).all()


def test_normals_are_uncorrelated():
    n = 1 << 20
    x = normals(KEY, 0, n + TILE).astype(np.float64)
    bound = 4.5 / np.sqrt(n)  # standard error of a correlation coefficient
    for lag in (1, 2, 255, 256, 512, 768, TILE):  # 256: the two numbers of a Box-Muller pair
        assert abs((x[:n] * x[lag : lag + n]).mean()) < bound
        assert abs(((x[:n] ** 2 - 1) * (x[lag : lag + n] ** 2 - 1)).mean()) < 2 * bound
    others = [
        normals(KEY, 0, n, stream=1),
        normals(stream_key(2, "test"), 0, n),
        normals(KEY, TILE, TILE + n),
    ]
    others.append(lattice_normals(KEY, 0, 1024, 0, 1024).ravel())
    for y in others:
        assert abs((x[:n] * y).mean()) < bound


def test_uniforms():
    n = 1 << 20
    u = uniforms(KEY, 0, n)
    assert 0 < u.min() < 1e-5 < 1 - 1e-5 < u.max() < 1
    assert abs(u.mean() - 0.5) < 4.5 / np.sqrt(12 * n)
    assert abs(u.var() - 1 / 12) < 4.5 * np.sqrt(1 / 180 / n)
    count = np.bincount((u * 64).astype(int), minlength=64)
    assert (abs(count - n / 64) < 4.5 * np.sqrt(n / 64)).all()


def test_lattice_is_white():
    x = lattice_normals(KEY, -500, 500, -300, 700).astype(np.float64)
    bound = 4.5 / np.sqrt(x.size)
    assert abs(x.mean()) < bound
    assert abs(x.var() - 1) < np.sqrt(2) * bound
    for di, dj in ((1, 0), (0, 1), (1, 1), (8, 0), (0, 8), (32, 0), (0, 32), (16, 16)):
        assert abs((x[di:, dj:] * x[: 1000 - di, : 1000 - dj]).mean()) < bound * 1.1


def test_distant_tiles_of_the_lattice_differ():
    """Every bit of both tile indices reaches the counter."""
    corners = [0, *(1 << k for k in range(5, 63)), -(1 << 63)]
    seen = {lattice_normals(KEY, i, i + 1, 0, 1).item() for i in corners} | {
        lattice_normals(KEY, 0, 1, j, j + 1).item() for j in corners
    }
    assert len(seen) == 2 * len(corners) - 1


def test_bad_requests():
    with pytest.raises(ValueError, match="reversed range"):
        normals(KEY, 5, 4)
    with pytest.raises(ValueError, match="stream"):
        normals(KEY, 0, 4, stream=1 << 32)
    with pytest.raises(ValueError, match="shape"):
        uniforms(KEY, 0, 4, out=np.empty(3))
    with pytest.raises(ValueError, match="reversed lattice"):
        lattice_normals(KEY, 0, 4, 1, 0)
    assert normals(KEY, 7, 7).size == 0
    assert lattice_normals(KEY, 0, 0, 0, 5).shape == (0, 5)
