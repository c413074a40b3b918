"""HEALPix pixels are healpy's: both orderings, poles, all faces, outside the covered pixels, by
pages and by search.
"""

from __future__ import annotations

import math
from typing import Any

import healpy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from zonda.operators.maps.grid import HealpixGrid, _union
from zonda.operators.maps.healpix import Lookup, healpix_pixels, lookup

MARGIN = 1e-12
"""In z and phi: directions this close to a border of a pixel may fall on either side of it."""


def coefficients(directions: Any) -> Any:
    """(9, n) with which a detector at the boresight looks along ``directions`` (n, 3), others
    tilted off them.
    """
    towards = np.eye(3)[np.argmin(abs(directions), axis=1)]
    side = np.cross(directions, towards)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    return np.ascontiguousarray(
        np.stack([side, np.cross(directions, side), directions], axis=2).reshape(-1, 9).T
    )


def looked_at(h: Any, xi: Any, eta: Any) -> Any:
    """Unit vectors (n_det, n, 3)."""
    v = np.stack(
        [h[k] * xi[:, None] + h[k + 1] * eta[:, None] + h[k + 2] for k in (0, 3, 6)], axis=2
    )
    return v / np.linalg.norm(v, axis=2, keepdims=True)


def well_inside(nside: int, where: Any, nest: bool) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """healpy's pixels, and where none of the four directions a margin away has another."""
    z, phi = where[..., 2], np.arctan2(where[..., 1], where[..., 0])
    pixel = healpy.vec2pix(nside, *np.moveaxis(where, -1, 0), nest=nest)
    same = np.ones(pixel.shape, bool)
    flat = np.hypot(where[..., 0], where[..., 1])
    for dz, dphi in ((MARGIN, 0), (-MARGIN, 0), (0, MARGIN), (0, -MARGIN)):
        # a step in z beside a pole is one in the distance from it: sqrt(1 - z^2) - flat dz / z,
        # which keeps its digits there
        r = np.maximum(flat - dz * np.abs(z), 0.0)
        moved = (r * np.cos(phi + dphi), r * np.sin(phi + dphi), z + dz * flat)
        same &= healpy.vec2pix(nside, *moved, nest=nest) == pixel
    return pixel, same


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 13), st.booleans(), st.integers(0, 2**32 - 1))
def test_pixels_are_those_of_healpy(order: int, nest: bool, seed: int) -> None:
    nside, random = 1 << order, np.random.default_rng(seed)
    anywhere = random.normal(size=(300, 3))
    poles = random.normal(size=(300, 3)) * [1e-3, 1e-3, 1] * 10.0 ** random.uniform(
        -6, 0, (300, 1)
    ) + [0, 0, 1e-4]
    between = random.normal(size=(300, 3))  # |z| = 2/3 within 1e-3
    between[:, 2] = (
        np.sign(between[:, 2]) * np.hypot(between[:, 0], between[:, 1]) * 2 / math.sqrt(5)
    )
    between[:, 2] *= 1 + random.normal(size=300) * 1e-3
    directions = np.concatenate([anywhere, poles, between])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    h, xi, eta = (
        coefficients(directions),
        random.uniform(-0.1, 0.1, 3),
        random.uniform(-0.1, 0.1, 3),
    )
    xi[0] = eta[0] = 0.0
    expected, inside = well_inside(nside, looked_at(h, xi, eta), nest)
    assert inside.mean() > 0.99
    covered = np.unique(expected[:, : 2 * len(directions) // 3])  # some samples fall outside
    place = np.minimum(np.searchsorted(covered, expected), covered.size - 1)
    wanted = np.where(covered[place] == expected, place, -1)
    searched = Lookup(covered, 0, np.empty(0, np.int32), np.empty(0, np.int32))
    for table in (lookup(covered), searched):
        out = np.full(expected.shape, -7, np.int32)
        healpix_pixels(h, 0, len(directions), xi, eta, nside, nest, *table, out)
        np.testing.assert_array_equal(out[inside], wanted[inside])


@pytest.mark.parametrize("nest", [False, True])
@pytest.mark.parametrize("nside", [1, 2, 64, 1 << 18])
def test_centres_of_pixels_and_the_poles(nside: int, nest: bool) -> None:
    last = 12 * nside**2 - 1
    pixels = np.unique(np.linspace(0, last, 3000).astype(np.int64))
    h = coefficients(np.array(healpy.pix2vec(nside, pixels, nest=nest)).T)
    out = np.empty((1, len(pixels)), np.int32)
    HealpixGrid(nside, nest, pixels).pixels(h, 0, len(pixels), np.zeros(1), np.zeros(1), out)
    np.testing.assert_array_equal(out[0], np.arange(len(pixels)))
    poles = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    h, at = coefficients(poles), np.unique(healpy.vec2pix(nside, *poles.T, nest=nest))
    out = np.empty((1, 2), np.int32)
    HealpixGrid(nside, nest, at).pixels(h, 0, 2, np.zeros(1), np.zeros(1), out)
    np.testing.assert_array_equal(at[out[0]], healpy.vec2pix(nside, *poles.T, nest=nest))


def test_no_pixel_is_covered_and_pieces_of_a_scan() -> None:
    random = np.random.default_rng(4)
    directions = random.normal(size=(700, 3))
    h = coefficients(directions / np.linalg.norm(directions, axis=1, keepdims=True))
    out = np.empty((1, 700), np.int32)
    HealpixGrid(16, False, np.empty(0, np.int64)).pixels(h, 0, 700, np.zeros(1), np.zeros(1), out)
    assert (out == -1).all()
    grid = HealpixGrid(16, True, np.arange(12 * 256, dtype=np.int64))
    grid.pixels(h, 0, 700, np.zeros(1), np.zeros(1), out)
    piece = np.empty((1, 300), np.int32)
    grid.pixels(h, 210, 510, np.zeros(1), np.zeros(1), piece)
    np.testing.assert_array_equal(piece[0], out[0, 210:510])


@settings(deadline=None, max_examples=40)
@given(st.lists(st.lists(st.integers(0, 3000), max_size=30), max_size=4), st.integers(1, 10**9))
def test_a_footprint_is_all_pixels_of_its_discs(pieces, spread):
    """Whether they are marked in a range or sorted."""
    discs = [
        np.array([5 * spread], np.int64),
        *(spread * np.array(piece, np.int64) for piece in pieces),
    ]
    np.testing.assert_array_equal(_union(discs), np.unique(np.concatenate(discs)))
