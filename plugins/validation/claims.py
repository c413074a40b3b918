"""A claims file: what the paper states, how zonda measures it, what explains a difference. Its keys
are described at the top of ``pipelines/validation/claims.yaml``. And verdicts on a claim, computed
from numbers alone.

With the paper's value p, its standard error e and the half width r to which it is stated, and n
values of zonda's of mean m and scatter s (one realization; s / sqrt(n) is the standard error of the
mean),

    gap = max(0, |m - p| - r)                                                                    (1)
    distance of one realization = gap / sqrt(e^2 + s^2),
    of the mean = gap / sqrt(e^2 + s^2 / n)        (2)

For a lower limit p, |m - p| is replaced by p - m, for an upper one by m - p. The claim holds where
the distance is at most `LIMIT`: that of one realization, where the paper's figure is one
realization; else that of the mean.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

import zonda.pipelines
from zonda.core.configuration import yaml_places
from zonda.core.configuration.diagnostics import ConfigurationError, Diagnostic
from zonda.core.configuration.locate import read as read_text
from zonda.core.configuration.parameters import Parameters
from zonda.core.configuration.steps import Mistakes
from zonda.core.configuration.yaml_places import Source, Span
from zonda.core.experiment.experiment import Values

from .calculations import Amount, Calculation

LIMIT = 2.0
"""Largest distance that counts as agreement, in standard deviations."""

Relation = Literal["equal", "at_least", "at_most"]
Of = Literal["realization", "mean"]


class Verdict(StrEnum):
    """Verdict on a claim. `DIFFERS` is the only one that is not decided."""

    AGREES = "agrees"
    EXPLAINED = "differs, explained"
    CONTRADICTION = "the paper contradicts itself"
    NEEDS_DATA = "needs data we do not have"
    DIFFERS = "differs"

    @property
    def decided(self) -> bool:
        """True if nothing is left to explain."""
        return self is not Verdict.DIFFERS


@dataclass(frozen=True)
class Stated:
    """Statement of the paper: value, standard error, half width of rounding, all SI; its meaning;
    of one realization or of the mean.
    """

    value: float
    error: float = 0.0
    rounding: float = 0.0
    relation: Relation = "equal"
    of: Of = "realization"

    def gap(self, mean: float) -> float:
        """Equation (1); NaN for no value."""
        if math.isnan(mean):
            return math.nan
        away = {
            "equal": abs(mean - self.value),
            "at_least": self.value - mean,
            "at_most": mean - self.value,
        }[self.relation]
        return max(
            0.0,
            away - self.rounding - 1e-9 * abs(self.value),
        )  # a limit itself is inside, whatever its last bit


def distance(gap: float, sigma: float) -> float:
    """Equation (2): 0 for no gap, infinite for a gap without any uncertainty."""
    if math.isnan(gap) or gap == 0:
        return gap
    return gap / sigma if sigma > 0 else math.inf


@dataclass(frozen=True)
class Comparison:
    """Distances of equation (2), and whether the claim holds."""

    of_one: float
    of_mean: float
    holds: bool


def compare(stated: Stated, found: Values) -> Comparison:
    """Compare what was found with what is stated. What is NaN never holds."""
    gap = stated.gap(found.mean)
    of_one = distance(gap, math.hypot(stated.error, found.scatter))
    of_mean = distance(gap, math.hypot(stated.error, found.standard_error))
    return Comparison(of_one, of_mean, (of_one if stated.of == "realization" else of_mean) <= LIMIT)


def clears(found: Values, above: float | None, below: float | None) -> bool:
    """True if the mean is above and below limits by `LIMIT` standard errors of the mean."""
    margin = LIMIT * found.standard_error
    if math.isnan(found.mean):
        return False
    return (above is None or found.mean - margin >= above) and (
        below is None or found.mean + margin <= below
    )


def contradicted(stated: Stated, other: float, relation: Relation) -> bool:
    """True if the paper's statement cannot stand beside ``other``, which follows from other numbers
    of the paper.
    """
    beside = Stated(other, 0.0, stated.rounding, relation)
    return distance(beside.gap(stated.value), stated.error) > LIMIT


def decide(
    holds: bool | None,
    explanations: Sequence[bool],
    *,
    contradicted: bool = False,
    needs_data: bool = False,
) -> Verdict:
    """The verdict.

    Parameters
    ----------
    holds
        Whether zonda's value agrees; None where there is none.
    explanations
        For each counter-experiment whether its result satisfies its criterion. A difference is
        explained where there is at least one and all do.
    contradicted
        Whether other numbers of the paper exclude the claim.
    needs_data
        Whether it can only be compared with data that are not here.
    """
    if needs_data:
        return Verdict.NEEDS_DATA
    if contradicted:
        return Verdict.CONTRADICTION
    if holds:
        return Verdict.AGREES
    return Verdict.EXPLAINED if explanations and all(explanations) else Verdict.DIFFERS


FOLDER = Path(zonda.pipelines.__file__).parent / "validation"
SHIPPED = FOLDER / "claims.yaml"

MOST = 1000
"""More claims than this are refused."""

Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", max_length=60)]


class Experiment(Parameters):
    """Measurement of a value on runs of a pipeline, or its calculation."""

    pipeline: str | None = Field(None, min_length=1)
    """File in pipelines/validation (without suffix), shipped pipeline, or path beside the claims
    file.
    """
    change: dict[str, Any] = Field(default_factory=dict)
    """Values that differ from the pipeline's, with keys as for `--set`."""
    metric: Any = None
    """A metric that is one number: name, or {name: {parameter: value}}."""
    calculate: Calculation | None = None
    """A calculation and its arguments, {name: {argument: value}}, in place of a pipeline."""
    seeds: Annotated[int, Field(ge=1, le=1000)] | None = None
    """Realizations, each with other random numbers; 1 where absent."""
    versus: dict[str, Any] | None = None
    """Values that differ in a second run of each seed; compared by `statistic`."""
    statistic: Literal["ratio", "difference", "significance", "paired", "paired_mean"] | None = None
    """Of the first run's value a and the second's b: a / b; a - b; mean(a - b) over the scatter of
    one a and one b (significance), over the scatter of one a - b (paired), or over the standard
    error of its mean (paired_mean)."""

    @model_validator(mode="after")
    def _one_way(self) -> Experiment:
        if self.calculate is not None and (
            self.pipeline or self.metric or self.change or self.versus or (self.seeds or 1) > 1
        ):
            raise ValueError("calculate stands alone: it runs no pipeline")
        if (self.versus is None) != (self.statistic is None):
            raise ValueError("versus and statistic belong together")
        return self

    @property
    def kind(self) -> str:
        """Kind of its values: of the metric itself (empty), ratios, differences, significances."""
        paired = str(self.statistic).startswith("paired")
        return "significance" if paired else self.statistic or ""

    def __str__(self) -> str:
        """Pipeline, changes, metric, seeds; or the calculation."""
        if self.calculate is not None:
            return str(self.calculate)
        parts = [f"{self.pipeline}", *(f"{key}={value}" for key, value in self.change.items())]
        if self.versus is not None:
            other = ", ".join(f"{key}={value}" for key, value in self.versus.items())
            parts.append(f"{self.statistic} to {other}")
        metric = self.metric
        seeds = self.seeds or 1
        if not isinstance(metric, str):
            metric = ", ".join(f"{name}({given or ''})" for name, given in metric.items())
        return ", ".join([*parts, metric, f"{seeds} seed{'s' if seeds > 1 else ''}"])

    def differs_from(self, other: Experiment) -> bool:
        """True if it finds another value than ``other`` apart from random numbers: not if seeds
        alone differ.
        """
        if self.calculate is not None or other.calculate is not None:
            return str(self.calculate) != str(other.calculate)
        return any(
            getattr(self, key) != getattr(other, key)
            for key in Experiment.model_fields
            if key != "seeds"
        )


class Expected(Parameters):
    """Condition on the result of a counter-experiment: limits hold by two standard errors of the
    mean.
    """

    agrees: bool = False
    """It agrees with the paper's value, by the rule of the claim itself."""
    above: Amount | None = None
    """It is at least this."""
    below: Amount | None = None
    """It is at most this."""

    @model_validator(mode="after")
    def _something(self) -> Expected:
        if self.agrees == (self.above is not None or self.below is not None):
            raise ValueError("give either agrees: true, or above, below or both")
        return self

    def is_met(self, found: Values, stated: Stated) -> bool:
        """True if a counter-experiment's result is the expected one."""
        if self.agrees:
            return compare(stated, found).holds
        above, below = (limit.value if limit else None for limit in (self.above, self.below))
        return clears(found, above, below)


class Counter(Experiment):
    """A counter-experiment. What it does not state is as in its claim; `change` is added to the
    claim's.
    """

    name: Name
    """Short name, unique in the claim."""
    shows: str = Field(min_length=1)
    """What it shows, one sentence."""
    expect: Expected
    """What its result must satisfy."""


class Contradiction(Parameters):
    """Other numbers of the paper that exclude the claim."""

    calculate: Calculation
    """What follows from them."""
    relation: Relation = "equal"
    """The claim's value must equal it, or be at least or at most it."""
    says: str = Field(min_length=1)
    """From which numbers, one sentence."""


class Claim(Experiment):
    """One row of the table."""

    id: Name
    """Unique name."""
    section: str = Field(min_length=1)
    """Where it stands in the paper."""
    claim: str = Field(min_length=1)
    """What the paper states, in our words."""
    paper: Amount
    """Its value and unit, e.g. 148 uK."""
    error: Amount = Field(default_factory=lambda: Amount.parse(0))
    """Its standard error as the paper states it."""
    rounding: Amount = Field(default_factory=lambda: Amount.parse(0))
    """Half width of the value as stated: half a unit of its last digit, or what 'about' leaves
    open.
    """
    relation: Relation = "equal"
    """The value is equal to the paper's, at least or at most it."""
    of: Of = "realization"
    """Whether the paper's value is of one realization, or of a mean or without random numbers."""
    note: str = ""
    """What else must be known: scan length, window, how the paper worked it out."""
    stand_in: str = ""
    """Data that stand for those of the paper."""
    needs: str = ""
    """Data without which it cannot be compared, where they are not here."""
    because: str = ""
    """Why it differs, in a sentence; it counts only with counter-experiments."""
    counter: list[Counter] = Field(default_factory=list)
    """Counter-experiments."""
    contradiction: Contradiction | None = None
    """Other numbers of the paper that exclude the value."""
    quick: bool = False
    """Whether it is among the rows of `--quick`; calculations always are."""
    pictures: bool | Annotated[str, Field(min_length=1)] = False
    """Draw the pictures of the first run, or those of this pipeline with the row's `change`."""
    atmosphere: bool = False
    """Draw emission and transmission above the pipeline's site to 1 THz, for several PWVs."""

    @model_validator(mode="after")
    def _complete(self) -> Claim:
        if self.calculate is None and not self.needs and not (self.pipeline and self.metric):
            raise ValueError("give pipeline and metric, or calculate, or what data it needs")
        if self.needs and (self.calculate or self.pipeline or self.counter):
            raise ValueError("needs stands alone: without the data nothing is run")
        if (self.pictures or self.atmosphere) and self.pipeline is None:
            raise ValueError("pictures and atmosphere need a pipeline")
        names = [counter.name for counter in self.counter]
        if len(set(names)) < len(names):
            raise ValueError("two counter-experiments have the same name")
        if self.because and not self.counter:
            raise ValueError("an explanation needs a counter-experiment")
        for name, experiment in self.experiments():
            if (
                name
                and experiment.calculate is None
                and not (experiment.pipeline and experiment.metric)
            ):
                raise ValueError(
                    f"the counter-experiment {name} runs nothing: give calculate, or pipeline and"
                    " metric"
                )
            if name and not experiment.differs_from(self):
                raise ValueError(f"the counter-experiment {name} is the claim's own experiment")
        return self

    @property
    def stated(self) -> Stated:
        """The paper's numbers."""
        numbers = (self.paper.value, self.error.value, self.rounding.value)
        return Stated(*numbers, self.relation, self.of)

    @property
    def is_quick(self) -> bool:
        """True if `--quick` includes it."""
        return self.quick or (
            self.pipeline is None and all(c.pipeline is None for c in self.counter)
        )

    def experiments(self) -> Iterator[tuple[str, Experiment]]:
        """Its own experiment, under an empty name, and the counter-experiments by name, each with
        all that it takes over.
        """
        if self.needs:
            return
        own = {key: getattr(self, key) for key in Experiment.model_fields}
        yield "", Experiment.model_validate(own)
        for counter in self.counter:
            stated = {
                key: getattr(counter, key)
                for key in Experiment.model_fields
                if key in counter.model_fields_set
            }
            if counter.calculate is not None:
                yield counter.name, Experiment.model_validate(stated)
                continue
            base = {} if self.calculate is not None else own
            yield (
                counter.name,
                Experiment.model_validate(
                    {**base, **stated, "change": {**self.change, **counter.change}}
                ),
            )


class ClaimsFile(Parameters):
    """A claims file."""

    paper: str = Field(min_length=1)
    """The paper, as it is cited."""
    claims: Annotated[list[Claim], Field(min_length=1, max_length=MOST)]
    """The rows, in the order of the table."""


def read(path: Path = SHIPPED) -> ClaimsFile:
    """Read and check a claims file.

    Raises
    ------
    ConfigurationError
        With every mistake, each with its place.
    InputError
        Where there is no such file.
    """
    document = yaml_places.load(Source(str(path), read_text(path)))
    found = Mistakes(
        document,
        path.parent,
        [Diagnostic(f.message, f.span, f.label) for f in document.faults],
    )
    file = None
    if not isinstance(document.value, dict):
        found.wrong(
            "a claims file is a mapping of the keys paper and claims",
            Span(Source(str(path), "")),
        )
    else:
        tree = {k: v for k, v in document.value.items() if not str(k).startswith("x-")}
        file = found.validate(ClaimsFile, tree, (), "the claims file")
    seen: dict[str, int] = {}
    for number, claim in enumerate(file.claims if file else []):
        at = document.mark(("claims", number, "id")).value
        if claim.id in seen:
            found.wrong(
                f"two claims are called '{claim.id}'",
                at,
                f"the first is number {seen[claim.id] + 1}",
            )
        seen.setdefault(claim.id, number)
    if found.found or file is None:
        raise ConfigurationError(found.found, str(path))
    return file
