"""Every row of the stability matrix: the checks of `zonda doctor` and those of tests/checks, which
docs/stability.md shows.
"""

from __future__ import annotations

import importlib.util
import json
import math
from functools import cache
from pathlib import Path
from types import ModuleType

import mpmath
import numpy as np
import pytest

from zonda.core import checks as core_checks
from zonda.core import registry
from zonda.core.checks import Case, Check, Family, Result, registered
from zonda.core.cli import main
from zonda.plugins.checks import machine
from zonda.plugins.checks.scenes import MACHINE

from .checks import covariance, matrix
from .checks.cases import MATRIX

ROOT = Path(__file__).parents[1]
GIVEN = ROOT.parent / "shared" / "hard_cases.md"
CHECKS = matrix()

FACTOR = 10
"""Figures vary by CPU; published and measured ones differ by less than this, or both are below
limit / FACTOR.
"""


@cache
def result(check: Check) -> Result:
    return check.run()


SLOW = ("dispatch.another_instruction_set", "determinism.compiled_at_once")
"""Checks that compile kernels again: .ci/nightly and `zonda doctor` run them."""


@pytest.mark.parametrize(
    "check",
    [
        pytest.param(each, id=each.name, marks=[pytest.mark.nightly] * (each.name in SLOW))
        for each in CHECKS
    ],
)
def test_within_its_limit(check: Check) -> None:
    found = result(check)
    assert found.passed, (
        f"{check.what}, against {check.reference}: {found.reached}, limit {found.accepted}"
        f" {found.remark}"
    )


@pytest.mark.skipif(not GIVEN.exists(), reason="the given matrix is not beside this checkout")
def test_the_rows_are_those_given() -> None:
    rows = [
        [cell.strip() for cell in line.strip().strip("|").split("|")]
        for line in GIVEN.read_text().splitlines()
        if "|" in line
    ]
    given = [(row[0], row[2]) for row in rows[2:]]
    ours = [(case.text, case.acceptance) for case in MATRIX]
    assert [row for row in given if row in ours] == ours, (
        "a row is not the given one, or stands elsewhere"
    )
    if missing := [case for case, _ in given if (case, _) not in ours]:
        pytest.skip(f"rows that no check covers yet: {'; '.join(missing)}")


def test_every_row_has_a_check_and_names_are_unique() -> None:
    assert {check.case for check in CHECKS} == set(MATRIX)
    names = [check.name for check in [*CHECKS, *machine.checks]]
    assert len(set(names)) == len(names)


@cache
def page_maker() -> ModuleType:
    spec = importlib.util.spec_from_file_location(
        "make_stability", ROOT / "docs" / "make_stability.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_says_what_is_measured() -> None:
    maker = page_maker()
    results = [result(check) for check in CHECKS if check.name not in SLOW]
    published, now = maker.rows(maker.PAGE.read_text()), maker.rows(maker.page(results))
    assert len(now) == len(results)
    why = "run python docs/make_stability.py"
    assert set(published) == {check.name for check in CHECKS}, why
    assert {name: published[name][:3] for name in now} == {
        name: row[:3] for name, row in now.items()
    }, why
    for r in results:
        figures = [float(row[r.check.name][3].split()[0]) for row in (published, now)]
        low, high = sorted(figures)
        assert high <= FACTOR * low or high <= r.check.limit / FACTOR, (
            f"{r.check.name}: {figures}; {why}"
        )


def test_constants_are_those_of_mpmath() -> None:
    nu = mpmath.mpf(5) / 6

    def correlation(x: float) -> mpmath.mpf:
        y = mpmath.mpf(x)
        return mpmath.mpf(2) ** (1 - nu) / mpmath.gamma(nu) * y**nu * mpmath.besselk(nu, y)

    def structure_behind_a_beam(r: float) -> mpmath.mpf:
        q, b = (mpmath.mpf(r) / 500) ** 2 / 4, (mpmath.mpf("42.5") / 500) ** 2

        def integrand(u: mpmath.mpf) -> mpmath.mpf:
            e = mpmath.exp(u) + b
            return -mpmath.exp((nu + 1) * u - mpmath.exp(u)) * mpmath.expm1(-q / e) / e

        return nu / mpmath.gamma(nu + 1) * mpmath.quad(integrand, [2.5 * k - 45 for k in range(21)])

    with mpmath.workdps(50):
        for x, s in covariance.STRUCTURE:
            assert s == pytest.approx(float(1 - correlation(x)), rel=3e-16)
        for x, c in covariance.CORRELATION:
            assert c == pytest.approx(float(correlation(x)), rel=3e-16)
        functions = {"arctan": "atan"}
        for name, x, value in machine.FUNCTIONS:
            assert value == float(getattr(mpmath, functions.get(name, name))(mpmath.mpf(x)))
    with mpmath.workdps(25):
        for r, s in covariance.BEHIND_A_BEAM:
            assert s == pytest.approx(float(structure_behind_a_beam(r)), rel=1e-14)


def test_a_check_that_raises_or_is_not_a_number_has_failed() -> None:
    family, case = Family("mine"), Case("a case", "no fault")

    @family.add(case, reference="nothing", limit=1.0)
    def broken() -> float:
        """raises"""
        raise ZeroDivisionError("by zero")

    @family.add(case, reference="nothing", limit=1.0, unit="K")
    def unknown() -> float:
        """NaN"""
        return math.nan

    @family.add(case, reference="nothing", limit=0)
    def exact() -> tuple[int, str]:
        """nothing

        More about it.
        """
        return 0, "a remark"

    raised, nan, good = (check.run() for check in family)
    assert (raised.passed, nan.passed, good.passed) == (False, False, True)
    assert raised.remark == "ZeroDivisionError: by zero"
    assert nan.reached == "nan K"
    assert (good.check.what, good.reached, good.remark, good.check.name) == (
        "nothing",
        "0",
        "a remark",
        "mine.exact",
    )
    with pytest.raises(ValueError, match="no docstring"):
        family.add(case, reference="nothing", limit=0)(lambda: 0.0)


def test_a_third_party_adds_checks() -> None:
    family = Family("receiver")

    @family.add(Case("a slow receiver", "1e-3"), reference="closed form", limit=1e-3)
    def time_constant() -> float:
        """step response"""
        return 1e-4

    registry.checks.register(family)
    assert "receiver.time_constant" in [check.name for check in registered()]


def some(*figures: float) -> list[Check]:
    return [
        Check(MACHINE, f"f.c{k}", "what", "reference", 1.0, "", lambda f=f: f)
        for k, f in enumerate(figures)
    ]


@pytest.mark.parametrize(
    ("figures", "status"), [((0.5, 0.0), 0), ((0.5, 2.0), 1), ((math.nan,), 1)]
)
def test_doctor(
    figures: tuple[float, ...],
    status: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(core_checks, "registered", lambda: some(*figures))
    assert main(["doctor"]) == status
    text = capsys.readouterr().out
    assert f"{len(figures)} checks" in text
    assert ("FAIL" in text) == bool(status)
    assert main(["doctor", "--json"]) == status
    found = json.loads(capsys.readouterr().out)
    assert found["passed"] == (not status)
    assert len(found["checks"]) == len(figures)
    assert {"numpy", "cpu", "threads", "free memory"} <= set(found["machine"])


def test_doctor_measures_what_is_registered_the_machine_first(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ran: list[Check] = []
    monkeypatch.setattr(core_checks, "measure", lambda checks: ran.extend(checks) or [])
    assert main(["doctor", "--json"]) == 0
    assert sorted(check.name for check in ran) == sorted(check.name for check in registered())
    assert [check.case is MACHINE for check in ran] == sorted(
        (check.case is MACHINE for check in ran), reverse=True
    )
    capsys.readouterr()


@pytest.mark.parametrize(
    "name",
    [
        "denormals",
        "rounding",
        "elementary_functions",
        "writable_cache",
        "memory",
        "earth_orientation",
    ],
)
def test_checks_of_the_machine_give_figures(name: str) -> None:
    (check,) = (c for c in machine.checks if c.name == f"machine.{name}")
    found = check.run()
    assert np.isfinite(found.figure)
    if name in ("denormals", "rounding", "elementary_functions"):
        assert found.passed, found.remark
