"""Knobs alone: errors, convergence of the tightest rung, knobs that redraw, refused rungs."""

from dataclasses import replace

import numpy as np
import pytest

from zonda.core.accuracy.measure import Measured
from zonda.core.accuracy.pareto import search
from zonda.core.accuracy.sweep import Bench, convergence, sweep, tightest
from zonda.core.errors import ZondaError


def test_errors_follow_the_law(toy, metric):
    found = sweep(toy.bench(metric), toy.knobs())
    best = toy.value(found.reference)
    for number, alone in enumerate(found.alone):
        assert [r.value for r in alone.rungs] == list(toy.ladder)
        for rung in alone.rungs:
            law = toy.errors[number] * (1 / int(rung.value) ** 2 - 1 / 32**2) / best
            assert rung.error == pytest.approx(law, abs=1e-15)
            assert rung.own == pytest.approx(toy.costs[number] * int(rung.value))


def test_what_is_left_is_what_is_left(toy, metric):
    """Errors fall fourfold per rung, so the estimate is the rest of the series, a / 32^2 of the
    value.

    Steps are relative to the finer of two neighbours, whose values differ by a / 16^2 = 0.4 %.
    """
    found = sweep(toy.bench(metric), toy.knobs())
    for a, alone in zip(toy.errors, found.alone, strict=True):
        assert alone.left == pytest.approx(a / 32**2 / toy.value(found.reference), rel=0.01)
    assert found.left == pytest.approx(sum(a.left for a in found.alone))


@pytest.mark.parametrize(
    ("steps", "left", "words"),
    [
        ((1.0, 0.25), 0.25 / 3, "rest of that series"),
        ((1.0, 1e-9), 1e-9 / 9, "rest of that series"),  # no ratio below a tenth is believed
        (
            (1.0, 0.25, 0.0),
            0.25 / 3,
            "rest of that series",
        ),  # a step that changes no bit says nothing
        ((0.1, 0.1), 0.1, "not converging"),
        (
            (0.4, 1e-8, 0.1),
            0.1 / 3,
            "rest of that series",
        ),  # a small step before a larger one says nothing either
        ((0.1,), 0.1, "not a bound"),
        ((0.0, 0.0), 0.0, "no rung changes"),
        ((), 0.0, "no rung changes"),
    ],
)
def test_convergence(steps, left, words):
    found, how = convergence(steps)
    assert found == pytest.approx(left)
    assert words in how


def test_a_step_within_its_standard_error_shows_nothing():
    left, how = convergence((0.1, 0.01), (0.02, 0.02, 0.0))
    assert left == pytest.approx(0.04)
    assert "not resolved" in how


def test_an_inert_knob_costs_one_run(toy, metric):
    toy.errors = (1.0, 0.0, 0.02)
    found = sweep(toy.bench(metric), toy.knobs())
    assert [a.inert for a in found.alone] == [False, True, False]
    assert toy.calls == 1 + 4 + 1 + 4


def test_a_knob_that_redraws_is_compared_by_means_over_seeds(toy, metric):
    """The summary is the value plus noise that the two rungs share up to one part in a hundred:
    what is shared cancels.
    """
    random = np.random.default_rng(0).standard_normal((40, 2))

    def run(setting, seeds, yardstick):
        own = random[list(seeds), 0] + 0.01 * random[list(seeds), 1] * (setting["Step0.n"] == "2")
        return Measured(tuple(toy.value(setting) + 0.05 * x for x in own), {"Step0": (1.0,)})

    toy.errors, toy.costs = (0.4,), (1.0,)
    knobs = toy.knobs(redraws=True)
    assert tightest(knobs) == {}
    bench = Bench(run, metric, {"Step0.n": "32"}, seeds=range(40))
    coarse, fine = {"Step0.n": "2"}, {"Step0.n": "32"}
    error, resolution = bench.mean_error(coarse, fine)
    shift = 0.4 * (1 / 4 - 1 / 32**2)
    scale = 1 + 0.4 / 32**2 + 0.05 * random[:, 0].mean()
    assert resolution == pytest.approx(
        0.0005 * random[:, 1].std(ddof=1) / np.sqrt(40) / scale, rel=1e-6
    )
    assert abs(error - shift / scale) < 4 * resolution
    assert bench.scatter(fine) == pytest.approx(
        0.05, rel=0.4
    )  # standard error 0.05 / sqrt(80): 11 %


def test_refused_rungs_are_kept_with_the_reason(toy, metric):
    def run(setting, seeds, yardstick):
        if setting["Step1.n"] == "2":
            raise ZondaError("2 points cannot hold this")
        return toy.run(setting, seeds, yardstick)

    alone = sweep(toy.bench(metric, run), toy.knobs()).alone[1]
    assert alone.rungs[0].error is None
    assert "2 points cannot hold this" in alone.rungs[0].note
    assert alone.rungs[1].error > 0


def test_settings_are_measured_once(toy, metric):
    bench = toy.bench(metric)
    sweep(bench, toy.knobs())
    calls = toy.calls
    sweep(bench, toy.knobs())
    assert toy.calls == calls


def test_the_same_again(toy, metric):
    assert sweep(toy.bench(metric), toy.knobs()) == sweep(toy.bench(metric), toy.knobs())


def test_medians_and_spread():
    measured = Measured((1.0,), {"a": (1.0, 5.0, 1.2), "b": (0.1, 0.1, 0.1)})
    assert measured.cost() == pytest.approx((1.3, 2.0))  # one slow run does not count
    assert measured.cost("b") == pytest.approx((0.1, 0.0))


def test_the_load_of_the_machine_cancels():
    """Runs that take three times as long while the yardstick beside them does, too, cost the
    same.
    """
    measured = Measured(
        (1.0,), {"a": (1.0, 3.0, 1.0), "b": (0.5, 1.5, 0.5)}, yardstick=(2.0, 6.0, 2.0)
    )
    assert measured.cost() == pytest.approx((0.75, 0.0))


def test_seconds_are_on_the_scale_of_the_yardsticks_own_runs(toy, metric):
    """The second half of the measurements is made while the machine is four times slower."""

    def run(setting, seeds, yardstick):
        measured = toy.run(setting, seeds, yardstick)
        slow = 4.0 if toy.calls > 6 else 1.0
        steps = {k: tuple(slow * t for t in v) for k, v in measured.steps.items()}
        return Measured(measured.found, steps, tuple(slow * t for t in measured.yardstick))

    for alone in sweep(toy.bench(metric, run), toy.knobs()).alone:
        for rung in alone.rungs:
            setting = {k.key: "32" for k in toy.knobs()} | {alone.knob.key: rung.value}
            assert rung.seconds == pytest.approx(toy.seconds(setting))


def test_the_budget_holds_and_claims_come_first(toy, metric):
    """16 runs: the reference, the coarsest and the last rung but one of each of three knobs, and
    other rungs while a quarter is left.
    """
    said = []
    bench = Bench(toy.run, metric, tightest(toy.knobs()), budget=16, say=said.append)
    found = sweep(bench, toy.knobs())
    assert toy.calls == bench.runs == len(said) == 12
    assert said[0].startswith("run 1 of at most 16: reference: ")
    assert [[r.error is not None for r in a.rungs] for a in found.alone] == [
        [True, True, True, True, True],
        [True, True, True, True, True],
        [True, False, True, True, True],
    ]
    search(bench, found, 0.01)
    assert toy.calls == 16


def test_a_knob_that_the_budget_does_not_reach_counts_as_a_hundred_percent(toy, metric):
    bench = Bench(toy.run, metric, tightest(toy.knobs()), budget=3)
    found = sweep(bench, toy.knobs())
    assert toy.calls == 3
    assert [a.unmeasured for a in found.alone] == [False, False, True]
    assert found.left > 1
    assert found.alone[0].left == pytest.approx(found.alone[0].rungs[0].error)  # its one step


def test_runs_that_cost_more_than_the_reference_count_as_more(toy, metric):
    def run(setting, seeds, yardstick):
        return replace(toy.run(setting, seeds, yardstick), cpu=1.0 if toy.calls == 1 else 4.0)

    bench = Bench(run, metric, tightest(toy.knobs()), budget=10)
    sweep(bench, toy.knobs())
    assert bench.cpu <= 10


def test_the_spread_of_single_runs_is_that_of_the_reference(toy, metric):
    def run(setting, seeds, yardstick):
        steps = {"a": (2.0, 2.2) if setting == yardstick else (1.0,)}
        return Measured((1.0,), steps, (2.0, 2.2) if setting == yardstick else (2.2,))

    reference = tightest(toy.knobs())
    bench = Bench(run, metric, reference)
    assert bench.seconds(reference)[0] == pytest.approx(2.1)
    seconds, spread = bench.seconds(reference | {"Step0.n": "2"})
    assert seconds == pytest.approx(2.1 / 2.2)
    assert spread == pytest.approx(0.1)
