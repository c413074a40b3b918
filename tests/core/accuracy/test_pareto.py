"""The joint search against the full product of the ladders."""

import pytest

from zonda.core.accuracy.bench import TimedRun
from zonda.core.accuracy.pareto import Point, cheapest, pareto, search
from zonda.core.accuracy.sweep import sweep

SETTINGS = 125


def searched(toy, metric, target):
    bench = toy.bench(metric)
    found = sweep(bench, toy.knobs())
    return search(bench, found, target - found.left), found


@pytest.mark.parametrize("target", [0.1, 0.03, 0.01, 0.003])
def test_the_cheapest_that_meets_the_target_is_found(toy, metric, target):
    points, found = searched(toy, metric, target)
    chosen = cheapest(points, target, found.left)
    best = toy.value(found.reference)
    good = [s for s in toy.all_settings() if abs(toy.value(s) - best) / best + found.left <= target]
    optimum = min(map(toy.seconds, good))
    assert chosen.error + found.left <= target
    assert chosen.seconds <= 1.1 * optimum  # greedy: within a tenth of the exhaustive optimum
    assert chosen.seconds < 0.5 * toy.seconds(found.reference)


def test_the_search_is_economical(toy, metric):
    searched(toy, metric, 0.01)
    assert toy.calls < 14 + 30 < SETTINGS  # 14 of the knobs alone, and some of the reference


def test_the_front_is_the_true_one_within_a_tenth(toy, metric):
    """No setting of the full product beats a point of the front by more than a tenth in cost at the
    same error.
    """
    points, found = searched(toy, metric, 0.01)
    best = toy.value(found.reference)
    every = [(abs(toy.value(s) - best) / best, toy.seconds(s)) for s in toy.all_settings()]
    front = pareto(points)
    assert [p.error for p in front] == sorted(p.error for p in front)
    assert [p.seconds for p in front] == sorted((p.seconds for p in front), reverse=True)
    for p in front:
        assert p.seconds <= 1.1 * min(seconds for error, seconds in every if error <= p.error)


def test_joint_errors_are_measured_not_added(toy, metric):
    """Two knobs whose errors cancel: the search finds what the knobs alone cannot tell."""
    toy.errors, toy.costs = (1.0, -1.0), (0.1, 0.1)
    points, _ = searched(toy, metric, 0.01)
    assert any(p.error < 1e-9 and p.seconds < 3 for p in points)


def test_a_saving_within_the_noise_is_none(toy, metric):
    def run(setting, seed, alone):
        found = toy.run(setting)
        noise = (-1.0, 0.0, 1.0)[toy.calls % 3]
        return TimedRun(found.found, found.steps | {"Step0": found.steps["Step0"] + noise})

    bench = toy.bench(metric, run, repeats=3)
    found = sweep(bench, toy.knobs())
    assert all(p.setting["Step0.n"] == "32" for p in search(bench, found, 0.1))


def test_pareto_and_ties():
    a, b = Point({"k": "1"}, 0.0, 3.0, 0.1, 100), Point({"k": "2"}, 0.1, 1.0, 0.3, 100)
    worse, near = Point({"k": "3"}, 0.2, 2.0, 0.1, 100), Point({"k": "4"}, 0.05, 1.2, 0.1, 100)
    small = Point({"k": "5"}, 0.2, 2.0, 0.1, 50)
    assert pareto([a, worse, b, a]) == [a, b]
    assert pareto([a, b, small]) == [a, b, small]  # in memory nothing beats it
    assert cheapest([a, b, near], 0.1) == near  # as cheap as b within its spread, and better
    assert cheapest([a, b, near], 0.1, left=0.06) == a
    assert cheapest([worse], 0.1) is None
