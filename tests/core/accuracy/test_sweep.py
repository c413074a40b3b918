"""Knobs alone: errors, convergence of the tightest rung, knobs that redraw, refused rungs."""

from dataclasses import replace

import numpy as np
import pytest

from zonda.core.accuracy.bench import Measured, TimedRun
from zonda.core.accuracy.pareto import search
from zonda.core.accuracy.sweep import convergence, sweep, tightest
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
    assert toy.calls == 2 + 4 + 1 + 4 + 1  # the reference twice, and after eight runs


def test_a_knob_that_redraws_is_compared_by_means_over_seeds(toy, metric):
    """The summary is the value plus noise that the two rungs share up to one part in a hundred:
    what is shared cancels.
    """
    random = np.random.default_rng(0).standard_normal((40, 2))

    def run(setting, seed, alone):
        own = random[seed, 0] + 0.01 * random[seed, 1] * (setting["Step0.n"] == "2")
        return TimedRun(toy.value(setting) + 0.05 * own, {"Step0": 1.0})

    toy.errors, toy.costs = (0.4,), (1.0,)
    knobs = toy.knobs(redraws=True)
    assert tightest(knobs) == {}
    bench = toy.bench(metric, run, {"Step0.n": "32"}, seeds=tuple(range(40)))
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
    def run(setting, seed, alone):
        if setting["Step1.n"] == "2":
            raise ZondaError("2 points cannot hold this")
        return toy.run(setting)

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


def measured(steps, units):
    rows = [dict(zip(steps, row, strict=True)) for row in zip(*steps.values(), strict=True)]
    return Measured([1.0], [TimedRun(1.0, row) for row in rows], list(units))


def test_medians_and_spread():
    found = measured({"a": (1.0, 5.0, 1.2), "b": (0.1, 0.1, 0.1)}, (1.0,) * 3)
    assert found.cost() == pytest.approx((1.3, 2.0))  # one slow run does not count
    assert found.cost("b") == pytest.approx((0.1, 0.0))


def test_the_load_of_the_machine_cancels():
    """Runs that take three times as long while the yardstick beside them does, too, cost the
    same.
    """
    found = measured({"a": (1.0, 3.0, 1.0), "b": (0.5, 1.5, 0.5)}, (2.0, 6.0, 2.0))
    assert found.cost() == pytest.approx((0.75, 0.0))


def test_seconds_are_on_the_scale_of_the_yardsticks_own_runs(toy, metric):
    """From the second time that the reference is run on, the machine is four times slower."""
    slow = 1.0

    def run(setting, seed, alone):
        nonlocal slow
        if toy.calls > 2 and setting == tightest(toy.knobs()):
            slow = 4.0
        found = toy.run(setting)
        return TimedRun(found.found, {k: slow * t for k, t in found.steps.items()})

    for alone in sweep(toy.bench(metric, run), toy.knobs()).alone:
        for rung in alone.rungs:
            setting = {k.key: "32" for k in toy.knobs()} | {alone.knob.key: rung.value}
            assert rung.seconds == pytest.approx(toy.seconds(setting))
    assert slow == 4.0


def test_the_budget_holds_and_claims_come_first(toy, metric):
    """18 runs: the reference twice and again after eight runs, the coarsest and the last rung but
    one of each of three knobs, and other rungs while a quarter is left.
    """
    said = []
    bench = toy.bench(metric, budget=18, say=said.append)
    found = sweep(bench, toy.knobs())
    assert toy.calls == bench.runs == len(said) == 13
    assert said[0].startswith("run 1 of at most 18: reference: ")
    assert said[10].startswith("run 11 of at most 18: reference: ")
    assert [[r.error is not None for r in a.rungs] for a in found.alone] == [
        [True, True, True, True, True],
        [True, False, True, True, True],
        [True, False, True, True, True],
    ]
    search(bench, found, 0.01)
    assert toy.calls == 18


@pytest.mark.parametrize("budget", range(2, 40))
def test_no_run_is_made_beyond_the_budget(toy, metric, budget):
    """Runs of the reference that fall due count, repeats do, and values that need a run of their
    own.
    """

    def run(setting, seed, alone):
        found = toy.run(setting)
        return replace(found, found=None if alone and budget % 2 else found.found)

    bench = toy.bench(metric, run, budget=budget, repeats=1 + budget % 3)
    found = sweep(bench, toy.knobs())
    search(bench, found, 0.01)
    assert toy.calls == bench.runs
    assert bench.runs <= max(budget, 4)  # the reference is measured in any case


def test_a_knob_that_the_budget_does_not_reach_counts_as_a_hundred_percent(toy, metric):
    bench = toy.bench(metric, budget=4)
    found = sweep(bench, toy.knobs())
    assert toy.calls == 4
    assert [a.unmeasured for a in found.alone] == [False, False, True]
    assert found.left > 1
    assert found.alone[0].left == pytest.approx(found.alone[0].rungs[0].error)  # its one step


def test_runs_that_cost_more_than_the_reference_count_as_more(toy, metric):
    def run(setting, seed, alone):
        toy.calls += 1
        return TimedRun(toy.value(setting), {"a": 1.0 if toy.calls < 3 else 4.0})

    bench = toy.bench(metric, run, budget=10)
    sweep(bench, toy.knobs())
    assert toy.calls == 4
    assert bench.cpu <= 10


def test_the_spread_of_single_runs_is_that_of_the_reference(toy, metric):
    reference = tightest(toy.knobs())
    seconds = iter((2.0, 2.2, 1.0))
    bench = toy.bench(metric, lambda *how: TimedRun(1.0, {"a": next(seconds)}))
    assert bench.seconds(reference)[0] == pytest.approx(2.1)
    found, spread = bench.seconds(reference | {"Step0.n": "2"})
    assert found == pytest.approx(2.1 / 2.2)
    assert spread == pytest.approx(0.1)
