"""A toy with known laws: knob i at rung n_i errs by a_i / n_i^2 and costs b_i n_i seconds."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import pytest

from zonda.core.accuracy.bench import Bench, Setup, TimedRun
from zonda.core.accuracy.metrics import Metric
from zonda.core.accuracy.settings import PipelineKnob
from zonda.core.accuracy.sweep import tightest


@dataclass
class Toy:
    """``value = sum_i a_i / n_i^2 + 1``; the reference's own error is known exactly."""

    errors: tuple[float, ...] = (1.0, 0.1, 0.02)
    costs: tuple[float, ...] = (0.01, 0.3, 0.02)
    noise: float = 0.0
    ladder: tuple[str, ...] = ("2", "4", "8", "16", "32")
    calls: int = 0

    def knobs(self, **changes):
        made = [
            PipelineKnob(f"Step{i}.n", f"Step{i}", self.ladder, "a sum", False, "8", False)
            for i in range(len(self.errors))
        ]
        return [PipelineKnob(**(k.__dict__ | changes)) for k in made] if changes else made

    def value(self, setting, seed=0):
        return (
            1
            + sum(a / int(setting[f"Step{i}.n"]) ** 2 for i, a in enumerate(self.errors))
            + self.noise * (seed or 0)
        )

    def seconds(self, setting):
        return 1 + sum(b * int(setting[f"Step{i}.n"]) for i, b in enumerate(self.costs))

    def run(self, setting, seed=None, alone=True):
        self.calls += 1
        steps = {f"Step{i}": b * int(setting[f"Step{i}.n"]) for i, b in enumerate(self.costs)}
        return TimedRun(self.value(setting, seed), steps | {"(rest)": 1.0}, 10**8)

    def bench(self, metric, run=None, yardstick=None, say=lambda what: None, **more):
        yardstick = tightest(self.knobs()) if yardstick is None else yardstick
        return Bench(run or self.run, metric, yardstick, setup_of(**more), say)

    def all_settings(self):
        for values in product(self.ladder, repeat=len(self.errors)):
            yield {f"Step{i}.n": v for i, v in enumerate(values)}


class Value(Metric):
    """The toy's value."""


def setup_of(target=0.01, **more):
    return Setup("toy", (), "value", target, **{"shorter": {}, **more})


@pytest.fixture
def toy():
    return Toy()


@pytest.fixture
def metric():
    return Value()
