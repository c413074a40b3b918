"""The same seed gives the same bits: blocks, threads, repetition; streams of random numbers are
independent.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache

import numpy as np

from zonda.core.checks import Family
from zonda.core.data import Data
from zonda.core.experiment.variant import Variant
from zonda.core.numerics.random import normals, stream_key
from zonda.core.operator import Operator
from zonda.core.pipeline import Pipeline
from zonda.operators.atmosphere.layers import AtmosphereLayers
from zonda.operators.filters.common_mode import CommonModeFilter
from zonda.operators.filters.highpass import HighpassFilter
from zonda.operators.maps.bin_map import BinMap
from zonda.operators.noise.pink import PinkNoise
from zonda.operators.noise.white import WhiteNoise
from zonda.operators.optics.efficiency import Efficiency
from zonda.operators.pointing.daisy import PointingDaisy

from .scenes import BLOCKS, TWICE, camera, differing, scene

checks = Family("determinism")

PLANES = ("signal", "hits", "weights", "noise")


def steps(*, filters: bool = True) -> list[Operator]:
    """The whole chain, from pointing to map."""
    filtered: Sequence[Operator] = (HighpassFilter(), CommonModeFilter()) if filters else ()
    return [
        PointingDaisy(scan_duration="45 s", radius="1 arcmin", sample_rate="100 Hz"),
        AtmosphereLayers(pwv="7.7 mm", layers=3),
        WhiteNoise(),
        PinkNoise(),
        Efficiency(),
        *filtered,
        BinMap(pixel="4 arcsec", width="8 arcmin"),
    ]


def _run(threads: int = 1, memory: int = 1 << 30, *, filters: bool = True) -> Data:
    variant = Variant(Pipeline(steps(filters=filters)), scene(camera(37)))
    return variant.run(threads=threads, memory=memory)


@cache
def _once() -> Data:
    return _run()


def _differing(one: Data, other: Data) -> int:
    return sum(
        differing(getattr(one.products["map"], p), getattr(other.products["map"], p))
        for p in PLANES
    )


@checks.add(BLOCKS, reference="one thread, one block", limit=0, unit="values")
def threads_and_blocks() -> int:
    """values of the map that differ with 2, 3 and 5 threads and in the smallest blocks, whole
    chain
    """
    return sum(
        _differing(_once(), _run(t, m))
        for t, m in ((2, 1 << 30), (3, 16_000_000), (5, 30_000_000), (1, 6_000_000))
    )


@checks.add(BLOCKS, reference="one thread, one block", limit=0, unit="values")
def blocks_in_time() -> int:
    """values of the map that differ without filters, where blocks are cut in time as well"""
    one = _run(filters=False)
    return sum(
        _differing(one, _run(t, m, filters=False)) for t, m in ((3, 8_000_000), (1, 3_000_000))
    )


@checks.add(TWICE, reference="the first run", limit=0, unit="values")
def twice() -> int:
    """values of the map that differ in a second run, whole chain"""
    return _differing(_once(), _run(2))


@checks.add(BLOCKS, reference="no correlation", limit=5, unit="standard errors")
def separate_streams() -> float:
    """largest correlation among 12 streams of random numbers: seeds, observations, operators,
    detectors
    """
    n = 1 << 17
    keys = [
        stream_key(seed, "observation", scan, who)
        for seed in (1, 2)
        for scan in (0, 1)
        for who in ("WhiteNoise", "x")
    ]
    streams = [normals(k, 0, n, stream=s) for k in keys[:4] for s in (0, 1)] + [
        normals(k, 0, n) for k in keys[4:]
    ]
    found = np.corrcoef(np.array(streams, np.float64)) - np.eye(len(streams))
    return float(abs(found).max() * math.sqrt(n))
