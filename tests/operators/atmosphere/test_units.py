"""Units of the detectors' series: which are kept, in which order they are made, and those of bands
in step beside each other.
"""

from __future__ import annotations

import weakref
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

from zonda.core.types import Floats
from zonda.operators.atmosphere import fluctuations
from zonda.operators.atmosphere.fluctuations import (
    UNIT_DETECTORS,
    UNIT_SAMPLES,
    OfDetectors,
    keeps_all,
    units_bytes,
    units_fit,
)
from zonda.operators.atmosphere.turbulence.nodes import Nodes

DETECTORS, SAMPLES, STEP = 3 * UNIT_DETECTORS - 5, 4 * UNIT_SAMPLES - 100, 64
EVERY = [(unit, number) for number in range(4) for unit in range(3)]
"""In order of time."""


class Response:
    """The fluctuation itself."""

    names = ("emission",)

    def __call__(self, name: str, y: Floats, sine: Floats, weighted: Floats) -> Floats:
        return y


class Layers:
    """Layers that note (name, unit, number) of what they are asked for, and how many bands are
    asked for together.
    """

    def __init__(self, made: list[tuple[str, int, int]], name: str, looks: str) -> None:
        self.made, self.name, self.looks = made, name, looks
        self.together: list[int] = []

    def looks_as(self, other: Layers) -> bool:
        return self.looks == other.looks

    def sums(
        self, others: list[Layers], xi: Floats, eta: Floats, first: int, count: int
    ) -> tuple[Floats, list[Floats], Floats]:
        number = round(first * STEP / UNIT_SAMPLES)
        self.made += [(one.name, int(xi[0]) // UNIT_DETECTORS, number) for one in (self, *others)]
        self.together.append(1 + len(others))
        times = np.arange(first, first + count)
        sums = np.sin(0.1 * times + xi[:, None])
        bands = 1 + len(others)
        return np.stack([sums] * bands), [np.zeros((0, *sums.shape))] * bands, np.ones(sums.shape)


def series(
    made: list[tuple[str, int, int]], name: str = "", looks: str = "", shift: float = 0.0
) -> OfDetectors:
    """Of `Layers`; ``shift`` of the detectors."""
    rows = np.arange(float(DETECTORS))
    nodes: Any = Nodes.__new__(Nodes)
    object.__setattr__(nodes, "xi", rows)
    object.__setattr__(nodes, "eta", rows + shift)
    law: Any = lambda g, weighted, sine, own: (g, weighted)  # noqa: E731
    return OfDetectors(nodes, Layers(made, name, looks), law, Response(), STEP, SAMPLES)  # type: ignore[arg-type]


def block(state: OfDetectors, detectors: slice, samples: slice) -> Floats:
    out = np.empty((detectors.stop - detectors.start, samples.stop - samples.start), np.float32)
    state.into(detectors, samples, {"emission": out})
    return np.asarray(out)


def test_where_all_units_are_kept_they_are_made_in_order_of_time() -> None:
    """A block of a few detectors and all times first: the tiles of a moment serve all detectors."""
    made: list[tuple[str, int, int]] = []
    state = series(made)
    block(state, slice(0, 16), slice(0, SAMPLES))
    assert [(unit, number) for _, unit, number in made] == EVERY[: EVERY.index((0, 3)) + 1]
    block(state, slice(0, DETECTORS), slice(0, SAMPLES))
    assert [(unit, number) for _, unit, number in made] == EVERY


def test_where_few_are_kept_only_what_is_wanted_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    size = units_bytes(UNIT_DETECTORS, UNIT_SAMPLES, STEP, 1)
    whole = block(series([]), slice(0, DETECTORS), slice(0, SAMPLES))
    monkeypatch.setattr(fluctuations, "BYTES_KEPT", 2 * size)
    monkeypatch.setattr(fluctuations, "ALL_KEPT", 2 * size)
    made: list[tuple[str, int, int]] = []
    state = series(made)
    again = block(state, slice(0, 16), slice(0, SAMPLES))
    assert [(unit, number) for _, unit, number in made] == [(0, number) for number in range(4)]
    np.testing.assert_array_equal(again, whole[:16])


@pytest.mark.parametrize("looks", ["xx", "xy"])
@pytest.mark.parametrize("threads", [1, 4])
def test_bands_in_step_make_units_next_to_each_other(threads: int, looks: str) -> None:
    made: list[tuple[str, int, int]] = []
    bands: list[weakref.ref[OfDetectors]] = []
    states = [series(made, name, looks) for name, looks in zip("ab", looks, strict=True)]
    for state in states:
        state.join(bands)
    parts = [(slice(k, min(k + 16, DETECTORS)), slice(0, SAMPLES)) for k in range(0, DETECTORS, 16)]

    def work(part: tuple[slice, slice]) -> list[Floats]:
        return [block(state, *part) for state in states]

    with ThreadPoolExecutor(threads) as pool:
        found = list(pool.map(work, parts))
    expected = block(series([]), slice(0, DETECTORS), slice(0, SAMPLES))
    for k in range(2):
        np.testing.assert_array_equal(np.concatenate([both[k] for both in found]), expected)
    assert sorted(made) == sorted((name, *key) for name in "ab" for key in EVERY)  # each once
    if threads == 1:
        assert made == [(name, *key) for key in EVERY for name in "ab"]


@pytest.mark.parametrize(
    ("looks", "shift", "together"), [("xxx", 0.0, {3}), ("xyx", 0.0, {2, 1}), ("xxx", 1e-9, {2, 1})]
)
def test_bands_that_look_alike_are_drawn_together(
    looks: str, shift: float, together: set[int]
) -> None:
    """Of three bands, of which one may look elsewhere: at another lattice's drift, or with
    detectors that stand elsewhere.
    """
    states = [
        series([], name, look, shift * (name == "b"))
        for name, look in zip("abc", looks, strict=True)
    ]
    bands: list[weakref.ref[OfDetectors]] = []
    for state in states:
        state.join(bands)
    block(states[0], slice(0, DETECTORS), slice(0, SAMPLES))
    layers: list[Any] = [state._layers for state in states]
    assert set().union(*(one.together for one in layers)) == together
    assert [len(one.together) for one in layers] == [
        len(EVERY),
        len(EVERY) * (len(together) - 1),
        0,
    ]


def test_bands_are_drawn_together_only_where_each_looks_as_every_other(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """a looks as b and as c, which take steps that a has not: b and c need not look alike."""
    monkeypatch.setattr(
        Layers, "looks_as", lambda self, other: {self.name, other.name} != {"b", "c"}
    )
    states = [series([], name) for name in "abc"]
    bands: list[weakref.ref[OfDetectors]] = []
    for state in states:
        state.join(bands)
    block(states[0], slice(0, DETECTORS), slice(0, SAMPLES))
    layers: list[Any] = [state._layers for state in states]
    assert [set(one.together) for one in layers] == [{2}, set(), {1}]


def test_a_band_that_is_gone_makes_nothing() -> None:
    made: list[tuple[str, int, int]] = []
    bands: list[weakref.ref[OfDetectors]] = []
    gone, state = series(made, "a"), series(made, "b")
    gone.join(bands)
    state.join(bands)
    del gone
    block(state, slice(0, DETECTORS), slice(0, SAMPLES))
    assert {name for name, *_ in made} == {"b"}


def test_a_unit_that_fails_is_made_again() -> None:
    made: list[tuple[str, int, int]] = []
    state = series(made)
    real, state._to_pwv = state._to_pwv, lambda g, weighted, sine, own: 1 / 0  # type: ignore[assignment, return-value]
    with pytest.raises(ZeroDivisionError):
        block(state, slice(0, 16), slice(0, 100))
    state._to_pwv = real
    block(state, slice(0, 16), slice(0, 100))
    assert [(unit, number) for _, unit, number in made] == [(0, 0), (0, 0)]


def test_all_are_kept_where_they_take_little_of_a_stream() -> None:
    """1720 detectors for half an hour at 100 Hz: two streams, one value in 16 or 8 samples, are 1/8
    and 1/4 of one in float32.
    """
    for step, kept in ((16, True), (8, True), (4, False)):
        assert not units_fit(1720, 180_000, step, 2)
        assert keeps_all(1720, 180_000, step, 2) == kept
    assert not keeps_all(17200, 180_000, 16, 2)  # 1.6 GB
    assert keeps_all(100, 1000, 1, 2)
