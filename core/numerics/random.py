"""Counter-based random numbers: every number has an absolute address and can be made alone, in any
order, in any thread.

Philox4x32-10 (Salmon et al. 2011, "Parallel random numbers: as easy as 1, 2, 3") maps a 64-bit key
and a 128-bit counter to 128 random bits. Normal deviates follow by Box-Muller in float32: 24
significant bits, largest magnitude 6.66.

The unit of work is a tile of `TILE` = 1024 numbers = 256 consecutive counters x 4 words, always
made whole, so the bits of a number never depend on where a request begins or ends.

The counter words (c0, least significant, to c3) of block b = 0 .. 255 of a tile:

=============  ===============================  ====================
========================================== kind           c0, c1                           c2
c3
=============  ===============================  ====================
========================================== normals        256 tile + b, 64 bits            stream
0 uniforms       256 tile + b, 64 bits            stream                2^30 lattice        b + 2^8
J, low 64 bits           I, low 32 bits        I >> 32 (27 bits), J >> 56 (3 bits), 2^31
=============  ===============================  ====================
==========================================

with (I, J) = (i >> 5, j >> 5) the lattice tile of 32 x 32 points: kinds, streams and tiles never
share a counter.
"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
from numba import float32, int32, int64, uint32, uint64
from numpy.typing import NDArray

from ..kernels import contracted, kernel

TILE = 1024
"""Numbers made together."""

LATTICE_TILE = 32
"""Side of a lattice tile: 32 x 32 = `TILE` points."""

_BLOCKS = TILE // 4
_UNIFORMS = 1 << 30
_LATTICE = 1 << 31
_STREAMS = 1 << 32

Key = NDArray[np.uint32]
"""Key (2,) of a random stream."""


def stream_key(seed: int, *names: str | int) -> Key:
    """Key of the random stream that belongs to ``seed`` and ``names``.

    BLAKE2b over the type, length and content of each part, so no two different lists are encoded
    alike (``"ab", "c"`` and ``"a", "bc"``; ``1`` and ``"1"``).
    """
    digest = hashlib.blake2b(digest_size=8)
    for part in (int(seed), *names):
        if isinstance(part, str):
            tag = b"s"
            body = part.encode()
        elif isinstance(part, (int, np.integer)) and not isinstance(part, bool):
            tag = b"i"
            body = str(int(part)).encode()
        else:
            raise TypeError(f"a stream is named by str and int, not {part!r}")
        digest.update(tag + len(body).to_bytes(8, "little") + body)
    return np.frombuffer(digest.digest(), "<u4").astype(np.uint32)


def normals(
    key: Key,
    start: int,
    stop: int,
    stream: int = 0,
    out: NDArray[np.floating[Any]] | None = None,
) -> NDArray[Any]:
    """Standard normal deviates ``start`` .. ``stop - 1`` of stream ``stream`` (0 .. 2^32 - 1) under
    ``key``.

    Indices are absolute and may be negative. Shape (stop - start,), float32, or ``out`` filled
    (float32 or float64, same values).
    """
    out = _target(start, stop, stream, out, np.float32)
    fill_normals(key, stream, start, out)
    return out


def uniforms(
    key: Key,
    start: int,
    stop: int,
    stream: int = 0,
    out: NDArray[np.floating[Any]] | None = None,
) -> NDArray[Any]:
    """Uniform deviates in the open interval (0, 1), 32 bits each; arguments as in `normals`. Shape
    (stop - start,), float64.
    """
    out = _target(start, stop, stream, out, np.float64)
    fill_uniforms(key, stream, start, out)
    return out


def lattice_normals(
    key: Key,
    i0: int,
    i1: int,
    j0: int,
    j1: int,
) -> NDArray[np.float32]:
    """Standard normal deviates at the points (i0 .. i1 - 1, j0 .. j1 - 1) of an unbounded integer
    lattice.

    Any int64 indices. Shape (i1 - i0, j1 - j0), float32.
    """
    if i1 < i0 or j1 < j0:
        raise ValueError(f"empty or reversed lattice region {i0}:{i1}, {j0}:{j1}")
    out = np.empty((i1 - i0, j1 - j0), np.float32)
    fill_lattice_normals(key, i0, j0, out)
    return out


def _target(
    start: int,
    stop: int,
    stream: int,
    out: NDArray[Any] | None,
    dtype: type,
) -> NDArray[Any]:
    if stop < start:
        raise ValueError(f"reversed range {start}:{stop}")
    if not 0 <= stream < _STREAMS:
        raise ValueError(f"stream {stream} is outside 0 .. 2^32 - 1")
    if out is None:
        return np.empty(stop - start, dtype)
    if out.shape != (stop - start,):
        raise ValueError(f"out has shape {out.shape}, wanted ({stop - start},)")
    return out


# ----------------------------------------------------------------------------------------------
# kernels (callable from numba)


@kernel(fastmath=False)
def fill_normals(key, stream, start, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (n,) float32 or float64 with normal deviates ``start`` .. of ``stream`` under
    ``key`` (2,) uint32.
    """
    words, bits, tile = normal_scratch()
    first = int64(start)
    stop = first + int64(out.size)
    for number in range(first >> int64(10), (stop + int64(TILE - 1)) >> int64(10)):
        normal_tile(key, stream, number, words, bits, tile)
        origin = number << int64(10)
        low, high = max(first, origin), min(stop, origin + int64(TILE))
        source, target = tile[low - origin : high - origin], out[low - first : high - first]
        for k in range(uint64(source.size)):
            target[k] = source[k]


@kernel(fastmath=False)
def normal_scratch():  # type: ignore[no-untyped-def]
    """(words, bits, tile) for `normal_tile`."""
    return (
        np.empty((4, _BLOCKS), np.uint32),
        np.empty(_BLOCKS, np.int32),
        np.empty(TILE, np.float32),
    )


@kernel(fastmath=False)
def normal_tile(key, stream, number, words, bits, tile):  # type: ignore[no-untyped-def]
    """Fill ``tile`` (`TILE`,) float32 with normal deviates `TILE` number .. of ``stream`` under
    ``key``.
    """
    counter = uint64(number) << uint64(8)
    philox(
        key,
        counter & uint64(0xFFFFFFFF),
        counter >> uint64(32),
        uint64(stream),
        uint64(0),
        words,
    )
    box_muller(words[0], words[1], bits, tile[0:256], tile[256:512])
    box_muller(words[2], words[3], bits, tile[512:768], tile[768:1024])


@kernel
def fill_uniforms(key, stream, start, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (n,) with uniform deviates in (0, 1); arguments as in `fill_normals`."""
    words = np.empty((4, _BLOCKS), np.uint32)
    first = int64(start)
    stop = first + int64(out.size)
    flat = words.reshape(TILE)
    for number in range(first >> int64(10), (stop + int64(TILE - 1)) >> int64(10)):
        counter = uint64(number) << uint64(8)
        philox(
            key,
            counter & uint64(0xFFFFFFFF),
            counter >> uint64(32),
            uint64(stream),
            uint64(_UNIFORMS),
            words,
        )
        origin = number << int64(10)
        low, high = max(first, origin), min(stop, origin + int64(TILE))
        for k in range(low, high):
            out[k - first] = (np.float64(flat[k - origin]) + 0.5) * 2.0**-32


@kernel
def fill_lattice_normals(key, i0, j0, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (n_i, n_j) with the normal deviates of the lattice points from (i0, j0) under
    ``key`` (2,) uint32.
    """
    words = np.empty((4, _BLOCKS), np.uint32)
    tile = np.empty(TILE, np.float32)
    bits = np.empty(_BLOCKS, np.int32)
    side = int64(LATTICE_TILE)
    i0, j0 = int64(i0), int64(j0)
    i1, j1 = i0 + int64(out.shape[0]), j0 + int64(out.shape[1])
    for row in range(i0 >> int64(5), ((i1 - int64(1)) >> int64(5)) + int64(1)):
        for column in range(j0 >> int64(5), ((j1 - int64(1)) >> int64(5)) + int64(1)):
            a, b = (
                uint64(row) & uint64(0x7FFFFFFFFFFFFFF),
                uint64(column) & uint64(0x7FFFFFFFFFFFFFF),
            )
            low = b << uint64(8)
            c3 = (
                (a >> uint64(32))
                | ((b >> uint64(56)) << uint64(27))
                | (uint64(_LATTICE) & uint64(0xC0000000))
            )
            philox(
                key,
                low & uint64(0xFFFFFFFF),
                (low >> uint64(32)) & uint64(0xFFFFFFFF),
                a & uint64(0xFFFFFFFF),
                c3,
                words,
            )
            box_muller(words[0], words[1], bits, tile[0:256], tile[256:512])
            box_muller(words[2], words[3], bits, tile[512:768], tile[768:1024])
            top, left = row * side, column * side
            # Offsets from the tile's corner: the corner of the last tile plus 32 could overflow
            # int64.
            i_low, i_high = (
                max(i0 - top, int64(0)),
                min(i1 - int64(1) - top, side - int64(1)) + int64(1),
            )
            j_low, j_high = (
                max(j0 - left, int64(0)),
                min(j1 - int64(1) - left, side - int64(1)) + int64(1),
            )
            for i in range(i_low, i_high):
                source = tile[i * side + j_low : i * side + j_high]
                target = out[top - i0 + i, left - j0 + j_low : left - j0 + j_high]
                for j in range(uint64(source.size)):
                    target[j] = source[j]


@kernel
def philox(key, c0, c1, c2, c3, words):  # type: ignore[no-untyped-def]
    """Philox4x32-10 of the counters (c0 + b, c1, c2, c3), b = 0 .. n - 1 (no carry): words (4, n)
    uint32.

    Each 32-bit word is held in the low half of a uint64, which the compiler turns into vector
    multiplications; the high half is masked where they are made, so that the masks become part of
    them.
    """
    low, half = uint64(0xFFFFFFFF), uint64(32)
    m0, m1 = uint64(0xD2511F53), uint64(0xCD9E8D57)
    w0, w1 = uint64(0x9E3779B9), uint64(0xBB67AE85)
    k0, k1 = uint64(key[0]), uint64(key[1])
    out0, out1, out2, out3 = words[0], words[1], words[2], words[3]
    for b in range(uint64(out0.size)):
        x0, x1, x2, x3 = uint64(c0) + uint64(b), uint64(c1), uint64(c2), uint64(c3)
        for r in range(10):
            p, q = m0 * (x0 & low), m1 * (x2 & low)
            x0 = (q >> half) ^ x1 ^ (k0 + uint64(r) * w0)
            x1 = q
            x2 = (p >> half) ^ x3 ^ (k1 + uint64(r) * w1)
            x3 = p
        out0[b], out1[b], out2[b], out3[b] = uint32(x0), uint32(x1), uint32(x2), uint32(x3)


@contracted
def box_muller(a, b, bits, one, two):  # type: ignore[no-untyped-def]
    """Two arrays of normal deviates ``one, two`` (n,) float32 from two of random words ``a, b``
    (n,) uint32.

    Radius sqrt(-2 ln u), u = (a/2 + 1/2) / 2^31, with the single-precision polynomials of Cephes
    for the logarithm and for sine and cosine on a quarter turn; the top two bits of ``b`` choose
    the quadrant. ``bits``: (n,) int32, overwritten.
    """
    value = bits.view(np.float32)
    for i in range(uint64(a.size)):
        value[i] = (float32(int32(a[i] >> uint32(1))) + float32(0.5)) * float32(4.656612873e-10)
    for i in range(uint64(a.size)):
        two[i] = float32((bits[i] >> int32(23)) - int32(126))
        bits[i] = (bits[i] & int32(0x007FFFFF)) | int32(0x3F000000)
    for i in range(uint64(a.size)):
        # u = m 2^e, m in [sqrt(1/2), sqrt(2)) - 1
        m, e = value[i], two[i]
        small = m < float32(0.70710678)
        e = e - (float32(1) if small else float32(0))
        m = (m + m if small else m) - float32(1)
        z = m * m
        y = float32(7.0376836292e-2)
        y = y * m + float32(-1.1514610310e-1)
        y = y * m + float32(1.1676998740e-1)
        y = y * m + float32(-1.2420140846e-1)
        y = y * m + float32(1.4249322787e-1)
        y = y * m + float32(-1.6668057665e-1)
        y = y * m + float32(2.0000714765e-1)
        y = y * m + float32(-2.4999993993e-1)
        y = y * m + float32(3.3333331174e-1)
        y = y * m * z - float32(0.5) * z + e * float32(0.6931471805599453)
        radius = np.sqrt(max(float32(-2) * (m + y), float32(0)))
        turn = b[i]
        angle = float32(int32(turn << uint32(2))) * float32(3.657347e-10)
        z = angle * angle
        sine = (
            (float32(-1.9515295891e-4) * z + float32(8.3321608736e-3)) * z
            + float32(-1.6666654611e-1)
        ) * z * angle + angle
        cosine = (float32(2.443315711809948e-5) * z + float32(-1.388731625493765e-3)) * z + float32(
            4.166664568298827e-2
        )
        cosine = cosine * z * z - float32(0.5) * z + float32(1)
        quadrant = int32(turn >> uint32(30))
        odd = (quadrant & int32(1)) != 0
        x, y = (sine if odd else cosine), (cosine if odd else sine)
        one[i] = radius * x if quadrant < 2 else -(radius * x)
        two[i] = radius * y if (quadrant == 0 or quadrant == 3) else -(radius * y)
