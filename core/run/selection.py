"""Which of a pipeline's operators take part in which of its runs."""

from __future__ import annotations

from collections.abc import Sequence

from ..errors import PipelineError
from ..operator import Operator
from ..sky_signal import SkySignal, place_of_signal
from .companion import Companion
from .same_air import TRANSMISSION, SameAir


class Selection:
    """The runs of a pipeline. The main run has no name (an empty text).

    Parameters
    ----------
    operators
        The pipeline's steps, named.
    runs
        Companion runs by name. Those that operators need (`Operator.needs`) are added.
    place
        The pipeline's name, for errors.

    Raises
    ------
    PipelineError
        For a run that cannot be made of these steps.
    """

    def __init__(self, operators: Sequence[Operator], runs: dict[str, Companion], place: str) -> None:
        self.operators, self.runs, self._place = operators, runs, place
        self._check_runs()
        self._add_needed_runs()

    def steps(self, run: str) -> list[Operator]:
        """The operators that act on the observations of a run."""
        steps = [o for o in self.operators if not o.at_end and "boresight" not in o.provides]
        if place_of_signal(self.operators) is not None:
            steps.insert(place_of_signal(steps) or 0, SkySignal())
        if not run:
            return steps
        companion = self.runs[run]
        dropped = {o.label for o in self.generators() if not companion.keeps(o.provides)}
        if companion.filters == "none":
            dropped |= {o.label for o in self._filters()}
        found: list[Operator] = []
        for operator in steps:
            if operator.main_run_only:
                continue
            if operator.label not in dropped:
                found.append(operator)
            elif companion.modes == "full" and TRANSMISSION in operator.provides - {*(companion.without or ())}:
                found += [operator, SameAir.behind(operator)]
        return found

    def generators(self) -> list[Operator]:
        """The operators that make signal components: those before `signal` is formed, pointing aside."""
        found = []
        for operator in self.operators:
            if "signal" in operator.provides | operator.requires:
                break
            if operator.provides and "boresight" not in operator.provides:
                found.append(operator)
        return found

    def components(self, run: str) -> frozenset[str]:
        """Labels of the steps whose components a run keeps."""
        return self._kind(self.runs[run] if run else None)[0]

    def streams(self, run: str) -> frozenset[str]:
        """Names of the streams that the steps of a run make before there is a signal."""
        kept = self.components(run)
        return frozenset[str]().union(*(o.provides for o in self.generators() if o.label in kept))

    def is_frozen(self, run: str) -> bool:
        """Whether a companion run takes singular modes from the main run (which itself never does)."""
        return bool(run) and self._kind(self.runs[run])[2]

    def _filters(self) -> list[Operator]:
        """The operators that change the signal."""
        return [o for o in self.operators if "signal" in o.requires & o.provides]

    def _kind(self, run: Companion | None) -> tuple[frozenset[str], frozenset[str], bool]:
        """What tells runs apart: steps of components, filters, whether modes are the complete data's. None: the main run."""
        makers, filters = self.generators(), self._filters()
        kept = frozenset(o.label for o in makers if run is None or run.keeps(o.provides))
        frozen = run is not None and run.modes == "full" and len(kept) < len(makers)
        labels = frozenset(o.label for o in filters if run is None or run.filters == "all")
        differ = any(o.couples == "all" or (TRANSMISSION in o.provides and o.label not in kept) for o in self.operators)
        return kept, labels, frozen and differ

    def _check_runs(self) -> None:
        for name, companion in self.runs.items():
            if not name.isidentifier() or name.startswith("_"):
                cure = "use letters, digits and underscores, the first a letter"
                raise PipelineError(f"{name!r} cannot name a run", place=self._place, cure=cure)
            self._check_components(companion, f"run {name} names")
            self._check_frozen(name)

    def _check_components(self, companion: Companion, who: str) -> None:
        components = sorted(set().union(*(o.provides for o in self.generators())))
        for what in [*(companion.only or ()), *(companion.without or ())]:
            if what not in components:
                cure = f"choose from: {', '.join(components)}"
                raise PipelineError(f"{who} {what!r}, which no step provides", place=self._place, cure=cure)

    def _check_frozen(self, name: str) -> None:
        if self.runs[name].modes == "own":
            return
        for operator in self.steps(name):
            if operator.couples == "all" and not operator.can_freeze:
                raise PipelineError(
                    f"run {name} has modes: full, but {operator.label} cannot freeze what it measures",
                    place=self._place,
                    cure=f"leave modes: full out, or give {type(operator).__name__} freeze and measure_frozen (docs/plugins.md)",
                )

    def _add_needed_runs(self) -> None:
        """Find for each step the runs that it reads, see `Operator.needs`; add those that are not there."""
        for operator in self.operators:
            names = []
            for wanted in operator.needs():
                self._check_components(wanted, f"{operator.label} needs")
                kind = self._kind(wanted)
                same = [name for name, run in self.runs.items() if self._kind(run) == kind]
                if kind == self._kind(None):
                    names.append("")
                elif same:
                    names.append(same[0])
                else:
                    parts = [*(wanted.only or ["without", *(wanted.without or ())])]
                    parts += ["unfiltered"] * (wanted.filters == "none") + ["full"] * (wanted.modes == "full")
                    names.append("_" + "_".join(parts))
                    self.runs[names[-1]] = wanted
                    self._check_frozen(names[-1])
            operator._runs = tuple(names)
