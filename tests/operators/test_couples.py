"""What an operator says its output depends on is what it depends on: one input sample is changed,
and the outputs are compared.

``sample``: only the same detector at the same instant changes; ``time``: only the same detector;
``detectors``: only the same instant; ``all``: anything may. Operators that claim more than they use
are reported too: ``time`` and ``all`` must spread.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import pytest
from pydantic import PrivateAttr

from zonda.core.data import Block, Data, Observation
from zonda.core.operator import Operator
from zonda.core.pipeline import Pipeline
from zonda.core.registry import declared, operators
from zonda.core.scene import Scene
from zonda.core.testing import STREAMS

N_DETECTORS, N_SAMPLES, DETECTOR, SAMPLE = 19, 4500, 5, 2500
SIZE = 3e-3  # K; a tenth for the relative transmission does not matter


class Scan(Operator):
    """A scan that stands still, with a little motion, of a small camera."""

    provides: ClassVar[frozenset[str]] = frozenset({"boresight"})
    _observation: Any = PrivateAttr(None)

    def observe(self, data: Data) -> None:
        data.observations.append(self._observation)


class Streams(Operator):
    """Given streams, one sample of one of them changed."""

    requires: ClassVar[frozenset[str]] = frozenset({"boresight"})
    provides: ClassVar[frozenset[str]] = frozenset(STREAMS)
    _changed: str = PrivateAttr("")

    def prepare(self, observation: Observation) -> dict[str, np.ndarray]:
        rng = np.random.default_rng(4)
        t = np.arange(N_SAMPLES) / 100
        slow = np.sin(t / 2) + 0.3 * np.sin(t * 1.7)
        made = {
            s: SIZE * (slow + 0.2 * rng.standard_normal((N_DETECTORS, N_SAMPLES))) for s in STREAMS
        }
        if self._changed:
            made[self._changed][DETECTOR, SAMPLE] += SIZE
        return made

    def exec(self, block: Block, state: Any) -> None:
        for name, values in state.items():
            block.new(name)[...] = values[block.detectors, block.samples]


def outputs(bench: Any, operator: Operator, changed: str) -> dict[str, np.ndarray]:
    scan, streams = Scan(), Streams()
    scan._observation, streams._changed = bench.observation(N_DETECTORS, N_SAMPLES), changed
    keep = sorted(operator.provides & set(STREAMS))
    scene = Scene(site="green_bank", instrument="mustang2", time="2024-11-25T07:00")
    data = Pipeline([scan, streams, operator], precision="float64").run(scene, keep=keep, threads=1)
    return data.observations[0].detdata


ACTING = {
    "Efficiency": {},
    "HighpassFilter": {"frequency": "0.5 Hz"},
    "CommonModeFilter": {},
    "Detrend": {},
    "Leakage": {},
    "Crosstalk": {},
    "GainDrift": {},
    "TimeConstant": {"tau": "0 s"},
    "GroundFilter": {"bin": "0.01 deg"},
    "PolynomialFilter": {},
    "Despline": {},
    "Taper": {"share": "1"},
}
"""Operators that make streams of streams. All others make theirs of nothing (tested by the
conformance kit) or none.
"""
NEED_OTHERS = {"ToastOperator"}
"""They need packages that are not installed with the tests; tests/interop has them."""


@pytest.mark.parametrize("name", ACTING)
def test_one_sample(bench: Any, name: str) -> None:
    make = operators.get(name)
    before = outputs(bench, make(**ACTING[name]), "")
    operator = make(**ACTING[name])
    for stream in sorted((operator.requires | operator.optional) & set(STREAMS)):
        after = outputs(bench, make(**ACTING[name]), stream)
        changed = np.zeros((N_DETECTORS, N_SAMPLES), bool)
        for kept in before:
            changed |= before[kept] != after[kept]
        assert changed[DETECTOR, SAMPLE], f"{name} declares {stream} and does not use it"
        elsewhere = changed.copy()
        elsewhere[DETECTOR, SAMPLE] = False
        others = np.delete(changed, DETECTOR, axis=0)
        if operator.couples == "sample":
            assert not elsewhere.any()
        elif operator.couples == "time":
            assert not others.any()
            assert changed[DETECTOR].mean() > 0.9
        elif operator.couples == "detectors":
            assert not np.delete(changed, SAMPLE, axis=1).any()
            assert changed[:, SAMPLE].sum() > 1
        else:
            assert operator.couples == "all"
            assert others.mean() > 0.9


def test_every_operator_that_couples_is_looked_at() -> None:
    """Whatever reads streams and makes streams is in the list above."""
    for candidate in operators.candidates():
        if candidate.distribution == "zonda":
            cls = operators.get(candidate.name)
            needs = declared(cls, "requires") | declared(cls, "optional")
            acting = needs & set(STREAMS) and declared(cls, "provides") & set(STREAMS)
            assert bool(acting) == (candidate.name in {*ACTING, *NEED_OTHERS}), candidate.name


@pytest.mark.parametrize("name", ["PowerSpectrum", "BinMap", "TimeStreams", "SaveTOD"])
def test_observers_leave_the_streams_as_they_are(bench: Any, name: str, tmp_path: Any) -> None:
    operator = operators.get(name)()
    scan, streams = Scan(), Streams()
    scan._observation = bench.observation(N_DETECTORS, N_SAMPLES)
    scene = Scene(site="green_bank", instrument="mustang2", time="2024-11-25T07:00")
    data = Pipeline([scan, streams, operator], precision="float64").run(
        scene, keep=STREAMS, threads=1, output=tmp_path
    )
    given = streams.prepare(data.observations[0])
    for stream in STREAMS:
        assert np.array_equal(data.observations[0].detdata[stream], given[stream]), stream
