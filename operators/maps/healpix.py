"""HEALPix pixels of samples, compiled: the projection of Gorski et al. (2005, ApJ 622, 759), and
which covered pixel it is.

With t = 2 phi / pi in [0, 4), sections 5 and 6 there: in the equatorial belt, |z| <= 2/3, a pixel
lies between the lines

    j+ = floor(nside (t + 1/2 - 3 z / 4)),   j- = floor(nside (t + 1/2 + 3 z / 4));   (1)

in a polar cap, with t' = t - floor(t) and s = nside sqrt(3 (1 - |z|)),

    j+ = floor(t' s),
    j- = floor((1 - t') s).                                                                      (2)

1 - |z| = (x^2 + y^2) / (1 + |z|) has no cancellation at the poles. Directions closer to a border
than rounding, some 1e-15 in z and phi, may fall in the pixel beyond it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zonda.core.kernels import kernel

PAGE = 6
"""A page holds 2 ** PAGE pixels."""
MOST_PAGES = 1 << 22
"""Largest table of pages: 16 MB."""


class Lookup(NamedTuple):
    """Places of pixels among the sorted ``covered`` ones: by pages of 64 pixels from page
    ``first`` on, or by search.
    """

    covered: NDArray[np.int64]
    first: int
    pages: NDArray[np.int32]
    """Number of each page in ``places``; -1: no covered pixel. Empty where a binary search is made
    instead.
    """
    places: NDArray[np.int32]
    """Index among the covered pixels of each pixel of each page, -1 elsewhere."""


def lookup(covered: NDArray[np.int64]) -> Lookup:
    """The table for ``covered`` (sorted): pages where they take at most some 64 bytes per pixel,
    else none.
    """
    searched = Lookup(covered, 0, np.empty(0, np.int32), np.empty(0, np.int32))
    if not covered.size:
        return searched
    page = covered >> PAGE
    first, count = int(page[0]), int(page[-1] - page[0]) + 1
    used = np.unique(page)
    if count > MOST_PAGES or len(used) << PAGE > 16 * covered.size + (1 << 20):
        return searched
    pages = np.full(count, -1, np.int32)
    pages[used - first] = np.arange(len(used), dtype=np.int32)
    places = np.full(len(used) << PAGE, -1, np.int32)
    start = pages[page - first].astype(np.int64) << PAGE
    places[start + (covered & ((1 << PAGE) - 1))] = np.arange(covered.size, dtype=np.int32)
    return Lookup(covered, first, pages, places)


@kernel(fastmath={"contract"})
def healpix_pixels(  # type: ignore[no-untyped-def]
    h, first, stop, xi, eta, nside, nest, covered, page, pages, places, out
):
    """Index among the covered pixels of the pixel that holds each sample, -1 elsewhere. ``h`` (9,
    n_samp); see `Lookup`.
    """
    height, cap, quarter, pixel = (
        np.empty(256),
        np.empty(256),
        np.empty(256),
        np.empty(256, np.int64),
    )
    for low in range(first, stop, 256):  # coefficients stay in the first cache for all detectors
        end = min(low + 256, stop)
        for d in range(xi.size):
            _angles(h, low, end, xi[d], eta[d], height, cap, quarter)
            for k in range(end - low):
                z, s, t = height[k], nside * cap[k], quarter[k]
                pixel[k] = _nested(z, s, t, nside) if nest else _ring(z, s, t, nside)
            found = out[d, low - first : end - first]
            if pages.size:
                _by_pages(pixel, page, pages, places, found)
            else:
                _by_search(pixel, covered, found)


@kernel(fastmath={"contract"})
def _angles(h, low, end, a, b, height, cap, quarter):  # type: ignore[no-untyped-def]
    """z, s / nside (equation 2) and t of the directions of one detector, without branches: in
    vectors.

    The arc tangent is Cephes' (Moshier 1989): a rational function below 0.66, pi / 4 + atan((r - 1)
    / (r + 1)) above.
    """
    h0, h1, h2 = h[0, low:end], h[1, low:end], h[2, low:end]
    h3, h4, h5 = h[3, low:end], h[4, low:end], h[5, low:end]
    h6, h7, h8 = h[6, low:end], h[7, low:end], h[8, low:end]
    squared = 1.0 / (a * a + b * b + 1.0)
    inverse = math.sqrt(squared)
    for k in range(h0.size):
        x = h0[k] * a + h1[k] * b + h2[k]
        y = h3[k] * a + h4[k] * b + h5[k]
        z = (h6[k] * a + h7[k] * b + h8[k]) * inverse
        height[k] = z
        cap[k] = math.sqrt(3.0 * (x * x + y * y) * squared / (1.0 + abs(z)))
        wide, high = abs(x), abs(y)
        small = high if high < wide else wide
        large = wide if high < wide else high
        large = large if large > 1e-300 else 1e-300
        near = small > 0.66 * large
        r = (small - large if near else small) / (small + large if near else large)
        q = r * r
        p = (
            ((-8.750608600031904e-1 * q - 1.615753718733365e1) * q - 7.500855792314705e1) * q
            - 1.2288666844901361e2
        ) * q
        p = (p - 6.485021904942025e1) * q
        w = (((q + 2.485846490142306e1) * q + 1.650270098316988e2) * q + 4.328810604912903e2) * q
        w = (w + 4.853903996359137e2) * q + 1.9455065714826139e2
        t = (r + r * (p / w)) * (2.0 / math.pi) + (0.5 if near else 0.0)
        t = 1.0 - t if high > wide else t
        t = 2.0 - t if x < 0.0 else t
        t = 4.0 - t if y < 0.0 else t
        quarter[k] = t if t < 4.0 else 0.0


@kernel(fastmath=False)
def _ring(z, s, t, nside):  # type: ignore[no-untyped-def]
    """Pixel number in the RING ordering."""
    if abs(z) <= 2.0 / 3.0:
        along, across = nside * (0.5 + t), nside * (0.75 * z)
        plus, minus = np.int64(along - across), np.int64(along + across)
        ring = nside + 1 + plus - minus  # from the ring where |z| = 2/3 on
        column = ((plus + minus + 1 - nside + 1 - (ring & 1)) >> 1) & (4 * nside - 1)
        return 2 * nside * (nside - 1) + (ring - 1) * 4 * nside + column
    part = t - np.int64(t)
    ring = np.int64(part * s) + np.int64((1.0 - part) * s) + 1  # from the nearest pole on
    column = np.int64(t * ring)
    return (
        2 * ring * (ring - 1) if z > 0.0 else 12 * nside * nside - 2 * ring * (ring + 1)
    ) + column


@kernel(fastmath=False)
def _nested(z, s, t, nside):  # type: ignore[no-untyped-def]
    """Pixel number in the NESTED ordering."""
    if abs(z) <= 2.0 / 3.0:
        along, across = nside * (0.5 + t), nside * (0.75 * z)
        plus, minus = np.int64(along - across), np.int64(along + across)
        up, down = plus // nside, minus // nside
        face = up | 4 if up == down else (up if up < down else down + 8)
        x, y = minus & (nside - 1), nside - 1 - (plus & (nside - 1))
    else:
        face = np.int64(t)
        plus = min(np.int64((t - face) * s), nside - 1)
        minus = min(np.int64((1.0 - (t - face)) * s), nside - 1)
        x, y = (nside - 1 - minus, nside - 1 - plus) if z > 0.0 else (plus, minus)
        face = face if z > 0.0 else face + 8
    return face * nside * nside + (_spread(x) | (_spread(y) << 1))


@kernel(fastmath=False)
def _spread(v):  # type: ignore[no-untyped-def]
    """The bits of ``v``, below 2 ** 29, at the even places."""
    v = (v | (v << 16)) & 0x0000FFFF0000FFFF
    v = (v | (v << 8)) & 0x00FF00FF00FF00FF
    v = (v | (v << 4)) & 0x0F0F0F0F0F0F0F0F
    v = (v | (v << 2)) & 0x3333333333333333
    return (v | (v << 1)) & 0x5555555555555555


@kernel(fastmath=False)
def _by_pages(pixel, page, pages, places, found):  # type: ignore[no-untyped-def]
    """Index of each pixel among the covered ones, -1 where it is none of them, from the pages of
    `Lookup`.
    """
    count = np.int64(pages.size)
    for k in range(found.size):
        where = (pixel[k] >> PAGE) - page
        number = np.int64(pages[where]) if 0 <= where < count else np.int64(-1)
        found[k] = (
            places[(number << PAGE) + (pixel[k] & ((1 << PAGE) - 1))]
            if number >= 0
            else np.int32(-1)
        )


@kernel(fastmath=False)
def _by_search(pixel, covered, found):  # type: ignore[no-untyped-def]
    """Index of each pixel among the covered ones, -1 where it is none of them, by bisection."""
    for k in range(found.size):
        low, high = np.int64(0), np.int64(covered.size)
        while low < high:
            middle = (low + high) >> 1
            if covered[middle] < pixel[k]:
                low = middle + 1
            else:
                high = middle
        found[k] = (
            np.int32(low) if low < covered.size and covered[low] == pixel[k] else np.int32(-1)
        )
