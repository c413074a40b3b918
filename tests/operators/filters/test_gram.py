"""What a spilled stream of many detectors takes while it is read, and that its bits are those of
one in memory.
"""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from zonda.core.data import Stream
from zonda.core.plan.planning import planning_of
from zonda.operators.filters import gram
from zonda.operators.filters.common_mode import CommonModeFilter
from zonda.operators.filters.gram import (
    MOST_COPIED,
    SHORTEST_TILE,
    Gram,
    near_the_mean,
    tile_length,
)


def spilled(bench, folder, n_det, n, room=0, threads=1, flagged=slice(0, 0)):
    """A stream in memory and the same one in a file whose mapping nobody has touched."""
    observation = bench.observation(n_det, n)
    observation.flags[flagged] = 1
    array = np.random.default_rng(1).standard_normal((n_det, n), np.float32)
    array.tofile(folder / "stream")
    mapped = np.memmap(folder / "stream", np.float32, "r+", shape=(n_det, n))
    return [Stream("signal", observation, a, {}, threads, room) for a in (array, mapped)]


def everything(stream):
    with ThreadPoolExecutor(stream.threads) as pool:
        found = Gram(stream, pool)
        u = near_the_mean(found.use)
        image, time = found.apply(u)
        return (
            image,
            time,
            found.energy,
            found.left(u[None], time[None]),
            *found.apply(image / np.linalg.norm(image)),
        )


def test_tiles_are_as_long_as_a_copy_may_be():
    assert tile_length(200, 4) == tile_length(12207, 4) == 2048
    assert tile_length(12208, 4) == tile_length(12207, 8) == 1024
    assert tile_length(10**7, 8) == SHORTEST_TILE
    for n_det in (20_000, 50_000, 100_000):
        assert (
            n_det * tile_length(n_det, 8) * 8 <= MOST_COPIED < n_det * 2 * tile_length(n_det, 8) * 8
        )


@pytest.mark.parametrize("most", [MOST_COPIED, 200_000])  # as it is, and with tiles of 512 samples
@pytest.mark.parametrize("flagged", [slice(0, 0), slice(2000, 2100)])
def test_a_spilled_stream_gives_the_same_bits(bench, tmp_path, monkeypatch, most, flagged):
    monkeypatch.setattr(gram, "MOST_COPIED", most)
    kept, mapped = spilled(bench, tmp_path, 70, 9001, flagged=flagged)
    assert tile_length(70, 4) == (2048 if most == MOST_COPIED else 512)
    three = [
        Stream("signal", mapped.observation, mapped.array, {}, 3, room) for room in (0, 1 << 30)
    ]
    for stream in (mapped, *three):
        for mine, theirs in zip(everything(stream), everything(kept), strict=True):
            np.testing.assert_array_equal(mine, theirs)
    a = np.where(mapped.observation.flags == 0, kept.array.astype(float), 0.0)
    u = near_the_mean(np.ones(70, bool))
    image, time, energy, left, *_ = everything(mapped)
    np.testing.assert_allclose(image, a @ (a.T @ u), rtol=1e-9, atol=1e-9 * np.abs(image).max())
    assert energy == pytest.approx((a**2).sum(), rel=1e-12)
    assert left == pytest.approx(((a - np.outer(u, time)) ** 2).sum(), rel=1e-12)


@pytest.mark.parametrize(("n_det", "n"), [(40, 5000), (9000, 2100)])  # 9000: a tile of 74 MB
def test_a_mapping_is_never_touched(bench, tmp_path, monkeypatch, n_det, n):
    """Pages that are touched in a mapping are memory of the process until they are given back."""
    (_, stream), products, copied = spilled(bench, tmp_path, n_det, n), gram._products, []

    def look(array, *others, **named):
        copied.append(not np.may_share_memory(array, stream.array))
        products(array, *others, **named)

    monkeypatch.setattr(gram, "_products", look)
    with ThreadPoolExecutor(1) as pool:
        found = Gram(stream, pool)
        found.apply(near_the_mean(found.use))
    assert copied
    assert all(copied)


@pytest.mark.parametrize(
    ("room", "most"), [(0, 1), (40 * 2048 * 4 - 1, 1), (40 * 2048 * 4, 2), (1 << 30, 4)]
)
def test_copies_at_one_time_are_what_there_is_room_for(bench, tmp_path, monkeypatch, room, most):
    (_, stream), products = spilled(bench, tmp_path, 40, 40 * 2048, room, threads=4), gram._products
    lock, held = threading.Lock(), [0, 0]

    def look(*arguments, **named):
        with lock:
            held[0] += 1
            held[1] = max(held)
        time.sleep(0.005)
        products(*arguments, **named)
        with lock:
            held[0] -= 1

    monkeypatch.setattr(gram, "_products", look)
    with ThreadPoolExecutor(4) as pool:
        Gram(stream, pool)
    assert held[0] == 0
    assert 1 <= held[1] <= most
    if most > 1:
        assert held[1] > 1  # 40 tiles of 5 ms on 4 threads: two meet


def test_the_copy_is_announced(bench):
    """Each thread copies a part of a stream on disk; a stream in memory is not copied."""
    planning = planning_of(CommonModeFilter())
    for n_det in (300, 9000, 50_000):
        for n in (64, 4096):
            observation = bench.observation(n_det, n)
            length = min(n, tile_length(n_det, 4))
            assert planning.per_thread(observation, 4) >= 4 * n_det * length
            assert planning.per_thread(observation, 0) == 0
    assert (
        planning_of(CommonModeFilter(method="mean")).memory(bench.observation(9000, 4096))
        < 2_000_000
    )
