"""From claims to verdicts: run what is missing, compare, write the table and the pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from zonda.core.errors import within
from zonda.core.storage.files import check_output_folder

from .claims import Claim, ClaimsFile, Counter, Expected, Experiment
from .page import write
from .rows import CounterResult, Row
from .runs import Runs, Say
from .verdict import Stated, Values, clears, compare, contradicted, decide


def validate(
    file: ClaimsFile,
    claims: Sequence[Claim],
    folder: Path,
    base: Path,
    say: Say = lambda text: None,
) -> list[Row]:
    """Measure claims, and write ``claims.html``, ``claims.ecsv`` and a folder for each claim.

    What ``folder`` holds of the same runs is not run again. ``base``: folder of the claims file.
    Raises `ZondaError` with the claim in its place for a run that cannot be made.
    """
    check_output_folder(folder)
    runs = Runs(folder, base, say)
    for claim in claims:
        with within(f"claim {claim.id}"):
            for _, experiment in claim.experiments():
                runs.want(experiment)
            if claim.pictures:
                # its mistakes are found before anything is run
                runs.pictured(claim).file  # noqa: B018
    runs.execute()
    rows = [row(claim, runs) for claim in claims]
    for found in rows:
        if found.claim.pictures:
            with within(f"claim {found.claim.id}"):
                runs.draw(runs.pictured(found.claim), folder / found.claim.id)
        if found.claim.atmosphere:
            with within(f"claim {found.claim.id}"):
                runs.draw_atmosphere(dict(found.claim.experiments())[""], folder / found.claim.id)
    write(file, rows, folder)
    return rows


def row(claim: Claim, runs: Runs) -> Row:
    """The verdict on a claim whose runs have been made."""
    stated = stated_by(claim)
    found = {name: runs.values(experiment) for name, experiment in claim.experiments()}
    experiments = dict(claim.experiments())
    comparison = compare(stated, found[""]) if "" in found else None
    counters = tuple(
        counter_result(claim, c, experiments[c.name], found[c.name]) for c in claim.counter
    )
    other = claim.contradiction
    verdict = decide(
        comparison.holds if comparison else None,
        [counter.satisfied for counter in counters] if claim.because else [],
        contradicted=other is not None
        and contradicted(stated, other.calculate.value, other.relation),
        needs_data=bool(claim.needs),
    )
    return Row(claim, found.get("", Values(())), comparison, counters, verdict)


def counter_result(
    claim: Claim, counter: Counter, experiment: Experiment, found: Values
) -> CounterResult:
    """Result of a counter-experiment. It is of the claim's quantity if it agrees with the claim's
    value, or has its unit and is as the claim's a value, a ratio, a difference or a significance.
    """
    expect = counter.expect
    unit = expect.above or expect.below or claim.paper
    comparable = expect.agrees or (
        unit.unit == claim.paper.unit and kind(experiment) == kind(claim)
    )
    good = satisfied(expect, stated_by(claim), found)
    return CounterResult(counter.name, counter.shows, experiment, found, good, unit, comparable)


def kind(experiment: Experiment) -> str:
    """Kind of its values: of the metric itself (empty), ratios, differences, or significances."""
    return (
        "significance"
        if str(experiment.statistic).startswith("paired")
        else experiment.statistic or ""
    )


def satisfied(expect: Expected, stated: Stated, found: Values) -> bool:
    """True if a counter-experiment's result is the expected one."""
    if expect.agrees:
        return compare(stated, found).holds
    above, below = (
        limit.value if limit is not None else None for limit in (expect.above, expect.below)
    )
    return clears(found, above, below)


def stated_by(claim: Claim) -> Stated:
    """The paper's numbers."""
    return Stated(
        claim.paper.value, claim.error.value, claim.rounding.value, claim.relation, claim.of
    )
