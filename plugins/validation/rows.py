"""From claims to verdicts: run what is missing, compare, write the table and the pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from zonda.core.errors import within
from zonda.core.experiment.experiment import Values
from zonda.core.storage.files import check_output_folder

from .calculations import Amount
from .claims import Claim, Experiment
from .runs import Runs, Say
from .verdict import Comparison, Verdict, compare, contradicted, decide


@dataclass(frozen=True)
class CounterResult:
    """A counter-experiment: its name, what it shows, its values, whether its criterion is
    satisfied; the unit that its values are stated in (of its criterion, which need not be that of
    the claim), and whether they are of the claim's quantity."""

    name: str
    shows: str
    experiment: Experiment
    values: Values
    satisfied: bool
    unit: Amount
    comparable: bool


@dataclass(frozen=True)
class Row:
    """A claim and what was found of it."""

    claim: Claim
    values: Values
    comparison: Comparison | None
    counters: tuple[CounterResult, ...]
    verdict: Verdict

    @classmethod
    def of(cls, claim: Claim, runs: Runs) -> Row:
        """The verdict on a claim whose runs have been made.

        A counter-experiment is of the claim's quantity if it agrees with the claim's value, or has
        its unit and is as the claim's a value, a ratio, a difference or a significance.
        """
        experiments = dict(claim.experiments())
        found = {name: runs.values(experiment) for name, experiment in experiments.items()}
        comparison = compare(claim.stated, found[""]) if "" in found else None
        counters = []
        for counter in claim.counter:
            expect, experiment = counter.expect, experiments[counter.name]
            unit = expect.above or expect.below or claim.paper
            alike = unit.unit == claim.paper.unit and experiment.kind == claim.kind
            counters.append(
                CounterResult(
                    counter.name,
                    counter.shows,
                    experiment,
                    found[counter.name],
                    expect.is_met(found[counter.name], claim.stated),
                    unit,
                    expect.agrees or alike,
                )
            )
        other = claim.contradiction
        verdict = decide(
            comparison.holds if comparison else None,
            [counter.satisfied for counter in counters] if claim.because else [],
            contradicted=other is not None
            and contradicted(claim.stated, other.calculate.value, other.relation),
            needs_data=bool(claim.needs),
        )
        return cls(claim, found.get("", Values(())), comparison, tuple(counters), verdict)


def measured(
    claims: Sequence[Claim], folder: Path, base: Path, say: Say = lambda text: None
) -> list[Row]:
    """Measure claims, and draw their pictures in a folder for each.

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
    runs.experiment.run()
    rows = [Row.of(claim, runs) for claim in claims]
    for claim in claims:
        with within(f"claim {claim.id}"):
            if claim.pictures:
                runs.draw(runs.pictured(claim), folder / claim.id)
            if claim.atmosphere:
                runs.draw_atmosphere(claim, folder / claim.id)
    return rows
