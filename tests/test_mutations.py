"""Each safeguard matters: with it the check passes, without it the same check fails."""

from __future__ import annotations

from functools import cache

import pytest

from zonda.core.checks import Result
from zonda.plugins.checks import determinism

from .checks import lattice, matrix, opacity
from .mutations import MUTATIONS, Mutation

CHECKS = {check.name: check for check in matrix()}
CACHED = (lattice.implied_error, lattice._strip, opacity._air, opacity._band, determinism._once)


def run_anew(name: str) -> Result:
    """Run a check with nothing kept from before, and keep nothing."""
    for function in CACHED:
        function.cache_clear()
    found = CHECKS[name].run()
    for function in CACHED:
        function.cache_clear()
    return found


@cache
def passes(name: str) -> bool:
    """Unbroken."""
    return run_anew(name).passed


def test_there_are_ten_at_least() -> None:
    assert len({mutation.breaks for mutation in MUTATIONS}) >= 10


@pytest.mark.nightly
@pytest.mark.parametrize("mutation", MUTATIONS, ids=lambda mutation: mutation.breaks.__name__)
def test_a_check_fails_without_the_safeguard(
    mutation: Mutation, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert passes(mutation.check)
    mutation.breaks(monkeypatch)
    broken = run_anew(mutation.check)
    assert not broken.passed, f"{mutation.what}: {mutation.check} still reaches {broken.reached}"
