"""What the report says of the reference's own error and of the setting that it recommends."""

from dataclasses import replace

import pytest

from zonda.core.accuracy.bench import TimedRun
from zonda.core.accuracy.pareto import Point, Study
from zonda.core.accuracy.report import lines
from zonda.core.accuracy.sweep import Alone, Rung, Sweep, sweep, tightest

from .conftest import Value, setup_of


def said(found, points, **more):
    return "\n".join(lines(Study(setup_of(**more), "a toy", found, points[0], tuple(points))))


def test_what_is_called_the_cheapest_is_the_cheapest():
    """A setting that costs as much within the spread of the cheapest, and errs less, is
    recommended, and not called cheapest.
    """
    tight = Point({"k": "9"}, 0.0, 3.0, 0.1, 100)
    cheap, near = Point({"k": "1"}, 4e-3, 1.0, 0.3, 100), Point({"k": "2"}, 1e-3, 1.2, 0.1, 100)
    text = said(Sweep({"k": "9"}), [tight, cheap, near])
    assert "cheapest setting" not in text
    assert (
        "setting within 1 %: 0.1 % (+ 0 % of the reference), 1.2 ± 0.1 CPU s, the most accurate of"
        " those" in text
    )
    assert "that is 0.4 %, 1 ± 0.3 CPU s" in text
    assert text.rstrip().endswith("--set k=2")
    text = said(Sweep({"k": "9"}), [tight, replace(near, seconds=0.9)])
    assert (
        "cheapest setting within 1 %: 0.1 % (+ 0 % of the reference), 0.9 ± 0.1 CPU s, 3.3 times"
        " cheaper" in text
    )
    assert (
        "cheapest setting within 1 %: 0 % (+ 0 % of the reference), 3 ± 0.1 CPU s; it is the"
        " tightest" in said(Sweep({"k": "9"}), [tight])
    )


def redrawing(toy, present, noise=0.0):
    """The sweep of one knob that redraws, 0.4 / n^2 of about 1, beside one that does not, and the
    standard error of its rungs.
    """

    def run(setting, seed, alone):
        n = int(setting.get("Step0.n", present))
        found = 1 + 0.4 / n**2 + noise * (-1) ** seed * (n != 32)
        return TimedRun(found, {"Step0": 1.0}, 10**8)

    knob, other = toy.knobs()[:2]
    knob = replace(knob, redraws=True, present=present)
    bench = toy.bench(Value(), run, tightest([other]), seeds=tuple(range(4)))
    return sweep(bench, [knob, other])


@pytest.mark.parametrize("present", ["4", "8", "32"])
def test_the_reference_is_charged_with_the_knobs_that_stay_as_in_the_file(toy, present):
    """At n the toy is off by 0.4 / n^2 of its value, of which the rest of the series beyond 32 is
    known to one part in a hundred (`test_what_is_left_is_what_is_left`)."""
    found = redrawing(toy, present)
    assert found.left_of_turned == 0.0
    assert found.left == pytest.approx(0.4 / int(present) ** 2, rel=0.01)
    point = Point({}, 0.0, 1.0, 0.1, 100)
    text = said(found, [point])
    assert f"of knobs that stay as in the file: Step0.n={present} " in text
    assert ("no setting is shown to meet 1 %" in text) == (found.left > 0.01)
    if present == "4":
        assert "cause: Step0.n, 2.5 %: it stays at 4, as in the file" in text
        assert text.endswith("cure: --set Step0.n=32, or --target '3 %'")


def test_what_is_not_resolved_is_charged_with_twice_its_standard_error(toy):
    """Seeds scatter by 0.1 about the tightest rung's, whose 8 differs by 0.4 / 8^2 - 0.4 / 32^2 =
    0.6 %: the standard error of four is 0.1 sqrt(4 / 3) / 2, of a value of 1.0004."""
    found = redrawing(toy, "8", noise=0.1)
    alone = found.alone[0]
    expected = 2 * 0.1 * (4 / 3) ** 0.5 / 2 / (1 + 0.4 / 32**2)
    assert alone.rung("8").error < expected
    assert alone.stays - alone.left == pytest.approx(expected)
    assert alone.stays == pytest.approx(
        0.231, abs=0.001
    )  # of the tightest rung, whose neighbour is not resolved either, as much
    text = said(found, [Point({}, 0.0, 1.0, 0.1, 100)], seeds=range(4))
    assert "cause: Step0.n, 23 %: twice the standard error of means over 4 seeds" in text
    assert text.endswith("cure: more --seeds, or --target '30 %'")
    text = said(
        found,
        [Point({}, 0.0, 1.0, 0.1, 100)],
        target=0.1,
        seeds=range(4),
        shorter={"Scan.scan_duration": "30 s"},
    )
    assert text.endswith("cure: --seeds 22, or longer scans (--duration), or --target '30 %'")


def test_a_ladder_that_does_not_converge_is_the_cause(toy, metric):
    found = sweep(toy.bench(metric), toy.knobs())
    text = said(found, [Point({}, 0.0, 1.0, 0.1, 100)], target=1e-6)
    assert "cause: Step0.n, " in text
    assert "times the one before: the rest of that series" in text


def test_a_value_beside_the_ladder_counts_as_the_worst_rung(toy):
    knob = replace(toy.knobs()[0], redraws=True, present="5")
    rungs = (Rung("2", 0.3, 0.01), Rung("8", 0.1, 0.01), Rung("32", 0.0))
    assert Alone(knob, rungs, (), 0.02).stays == pytest.approx(0.32)
