"""Verdicts are computed from numbers: each of them, and the limits between them."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zonda.core.errors import ZondaError
from zonda.core.experiment.experiment import Values
from zonda.plugins.validation.claims import (
    LIMIT,
    Stated,
    Verdict,
    clears,
    compare,
    contradicted,
    decide,
    distance,
)
from zonda.plugins.validation.rows import combined

numbers = st.floats(-1e6, 1e6)


def test_scatter_and_standard_error_of_the_mean():
    found = Values((1.0, 2.0, 3.0, 4.0))
    assert found.mean == 2.5
    assert found.scatter == pytest.approx(math.sqrt(5 / 3))
    assert found.standard_error == pytest.approx(math.sqrt(5 / 3) / 2)


def test_a_single_value_scatters_as_its_metric_states():
    assert Values((3.0,), 0.5).standard_error == 0.5
    assert Values((3.0,)).scatter == 0
    assert math.isnan(Values(()).mean)


def test_distances_are_of_one_realization_and_of_the_mean():
    # mean 164, scatter 10 (four values: standard error 5), the paper 148 with an error of 3
    found = Values((154.0, 164.0, 164.0, 174.0))
    at = compare(Stated(148, 3), found)
    assert at.of_one == pytest.approx(16 / math.hypot(3, found.scatter))
    assert at.of_mean == pytest.approx(16 / math.hypot(3, found.standard_error))


@pytest.mark.parametrize(("of", "holds"), [("realization", True), ("mean", False)])
def test_what_is_compared_with_a_mean_must_be_nearer(of, holds):
    found = Values(
        tuple(160 + 10 * x for x in (-1.5, -1, -0.5, 0, 0, 0.5, 1, 1.5))
    )  # scatter 10, standard error 3.7
    assert compare(Stated(148, 3, of=of), found).holds is holds


@pytest.mark.parametrize(
    ("relation", "mean", "holds"),
    [
        ("equal", 0.55, True), ("equal", 0.4, False), ("equal", 0.45, True),
        ("at_least", 0.9, True), ("at_least", 0.46, True), ("at_least", 0.44, False),
        ("at_most", 0.1, True), ("at_most", 0.54, True), ("at_most", 0.56, False),
    ],
)  # fmt: skip
def test_rounding_and_limits(relation, mean, holds):
    at = compare(Stated(0.5, 0.0, 0.05, relation), Values((mean,)))
    assert at.holds is holds
    assert at.of_one == (0 if holds else math.inf)  # nothing is uncertain


def test_a_value_that_is_not_a_number_never_holds():
    assert not compare(Stated(1, 100), Values((math.nan,))).holds
    assert not compare(Stated(1, 100), Values(())).holds
    assert not clears(Values((math.nan,)), None, 1)


@given(numbers, st.floats(0, 1e3), numbers, st.floats(-10, 10))
def test_a_comparison_does_not_depend_on_the_zero_point_or_the_sign(value, error, mean, shift):
    def gap(v, m):
        return Stated(v, error, 1.0).gap(m)

    assert gap(-value, -mean) == pytest.approx(gap(value, mean))
    assert gap(value + shift, mean + shift) == pytest.approx(
        gap(value, mean), abs=1e-2
    )  # 1e-9 of the value stays inside


def test_limits_are_cleared_by_two_standard_errors():
    found = Values((0.9, 1.1))  # mean 1.0, standard error 0.1
    assert clears(found, 0.79, 1.21)
    assert not clears(found, 0.81, None)
    assert not clears(found, None, 1.19)


def test_distance():
    assert distance(0.0, 0.0) == 0
    assert distance(1.0, 0.0) == math.inf
    assert distance(1.0, 0.5) == LIMIT
    assert math.isnan(distance(math.nan, 1.0))


@pytest.mark.parametrize(
    ("paper", "other", "relation", "expected"),
    [
        (72, 74.67, "at_least", True),
        (75, 74.67, "at_least", False),
        (74.5, 74.67, "at_least", False),
        (4, 6.39, "equal", True),
        (6.4, 6.39, "equal", False),
        (0.879, 0.375, "at_most", True),
        (0.3, 0.375, "at_most", False),
    ],
)
def test_what_other_numbers_of_the_paper_exclude(paper, other, relation, expected):
    assert (
        contradicted(Stated(paper, 0.0, 0.2 if relation != "at_most" else 0.0), other, relation)
        is expected
    )


def test_an_error_that_the_paper_states_is_no_contradiction():
    assert not contradicted(Stated(148, 3), 143, "equal")
    assert contradicted(Stated(148, 3), 130, "equal")


@pytest.mark.parametrize(
    ("holds", "explanations", "more", "verdict"),
    [
        (True, [], {}, Verdict.AGREES),
        (True, [False], {}, Verdict.AGREES),
        (False, [], {}, Verdict.DIFFERS),
        (False, [True], {}, Verdict.EXPLAINED),
        (False, [True, False], {}, Verdict.DIFFERS),
        (None, [], {}, Verdict.DIFFERS),
        (None, [], {"needs_data": True}, Verdict.NEEDS_DATA),
        (False, [], {"contradicted": True}, Verdict.CONTRADICTION),
        (True, [], {"contradicted": True}, Verdict.CONTRADICTION),
    ],
)
def test_every_verdict(holds, explanations, more, verdict):
    assert decide(holds, explanations, **more) is verdict
    assert verdict.decided is (verdict is not Verdict.DIFFERS)


@pytest.mark.parametrize(
    ("statistic", "expected"),
    [
        ("ratio", (3.0, 2.0, 5 / 3)),
        ("difference", (2.0, 2.0, 2.0)),
        # mean of a - b: 2; scatter of a and of b: 1 each
        ("significance", (2 / math.sqrt(2),)),
    ],
)
def test_statistics_of_two_runs(statistic, expected):
    found, _ = combined(statistic, [[3.0, 4.0, 5.0], [1.0, 2.0, 3.0]], 0.0)
    assert found == pytest.approx(expected)


def test_significances_of_pairs():
    # differences 1, 2, 3: mean 2, scatter 1; ((1 + 2^2 / 2) / 3)^(1/2) = 1
    columns = [[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]]
    assert combined("paired", columns, 0.0) == (pytest.approx((2.0,)), pytest.approx(1.0))
    assert combined("paired_mean", columns, 0.0) == (
        pytest.approx((2 * math.sqrt(3),)),
        pytest.approx(math.sqrt(3)),
    )
    with pytest.raises(ZondaError, match="seeds that scatter"):
        combined("paired", [[1.0], [0.0]], 0.0)
