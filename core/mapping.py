"""`zonda.map`: filters and map makers on the kept streams of a run, which are not made again.

The steps of the run that made components or filtered stand in the new pipeline as well, as steps
that do nothing: so signals, remainders and labels are those of one run, and so are the bits.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from pydantic import PrivateAttr

from .assembly.signals import acting_steps
from .block import Block
from .data import Data
from .errors import InputError
from .log import Log
from .mapmaker import filters, forms
from .observation import KeptStreams, Observation
from .operator import Operator
from .output import Output
from .pipeline import Pipeline
from .scene import Scene, WithScene
from .signal import MAIN, stream_of

PLACE = "zonda.map"


class DoneBefore(Operator):
    """A step of a run whose streams are mapped again: it does nothing any more."""

    _like: dict[str, Any] = PrivateAttr(default_factory=dict)

    @classmethod
    def of(cls, operator: Operator, components: frozenset[str]) -> DoneBefore:
        """In the place of ``operator``, which makes ``components`` or filters."""
        made = cls(name=operator.label)
        signal = frozenset({MAIN}) if filters(operator) else frozenset[str]()
        made._like = {
            "provides": signal or components,
            "requires": signal,
            "linear": operator.linear,
        }
        return made

    @property
    def provides(self) -> frozenset[str]:
        """Signal of a filter, or components."""
        return frozenset(self._like["provides"])

    @property
    def requires(self) -> frozenset[str]:
        """Signal of a filter."""
        return frozenset(self._like["requires"])

    @property
    def linear(self) -> bool:
        """True where the step was."""
        return bool(self._like["linear"])

    def exec(self, block: Block, state: Any) -> None:
        """Leave the streams as they are."""


class KeptSignals(Operator):
    """The scans of a run, and the signals that it kept."""

    provides = frozenset({"boresight", MAIN})
    linear = True
    knows_means = True

    _data: Data = PrivateAttr()

    def observe(self, data: Data) -> None:
        """Append the scans; of each band those with its flags, noise and weather."""
        before = self._data.bands[data.band] if data.band else self._data
        if not data.band:
            data.log.state(
                self.label,
                "signals",
                "kept by an earlier run, whose log has its counts",
            )
        scans = before.observations if data.band or not before.pointed else before.pointed
        common = [scan.common for scan in data.observations] or [None] * len(scans)
        data.observations[:] = [
            replace(
                scan,
                log=Log(),
                common=shared,
                flags=scan.flags.copy(),
                detector_flags=scan.detector_flags.copy(),
                windows=dict(scan.windows),
                detdata=KeptStreams(scan.detdata.every),
            )
            for scan, shared in zip(scans, common, strict=True)
        ]

    def prepare(self, observation: Observation) -> dict[str, tuple[Any, Any]]:
        """Take the streams of a scan, with their means."""
        streams, observation.detdata = observation.detdata.every, KeptStreams()
        return streams

    def exec(self, block: Block, state: dict[str, tuple[Any, Any]]) -> None:
        """Hand on a signal."""
        array, mean = state[MAIN + block.suffix]
        block.new(MAIN, zero=False)[...] = array[block.detectors, block.samples]
        if mean is not None:
            block.means[MAIN] = mean


def map(data: Data | Operator, steps: Iterable[Operator], **options: Any) -> Data:
    """Filter and map streams that are there, as often as you like: those of a run with
    ``keep=["signal"]``, or recorded ones.

    The maps have the bits that the same steps at the end of that run would have given them. Signals
    beside the complete one are mapped where they were kept (``signal/noiseless``), or are what the
    others leave of it.

    Parameters
    ----------
    data
        Of `Pipeline.run`, or a step that reads recorded data.
    steps
        Filters, map makers, diagnostics, outputs.
    options
        Those of `Pipeline.run`: ``output``, ``keep``, ``threads``, ``memory``, ``ceiling``.

    Raises
    ------
    InputError
        Where the signal, or one that a step needs, was not kept.
    PipelineError
        For steps that need what is not there.
    """
    steps = list(steps)
    if isinstance(data, WithScene):
        scene = Scene(**dict(data.own_scene(None)))
        return Pipeline([data, *steps], name=PLACE).run(scene, **options)  # type: ignore[list-item]
    if not isinstance(data, Data) or data.pipeline is None:
        text = f"{type(data).__name__} has no streams" if not isinstance(data, Data) else "no run"
        run = "what pipeline.run(scene, keep=['signal']) returned"
        cure = f"give {run}, or the step that reads recorded data"
        raise InputError(text, place=PLACE, cure=cure)
    pipeline = _pipeline(data, steps)
    known = data.provenance["operators"]
    done = {o.label for o in pipeline.operators if isinstance(o, DoneBefore | KeptSignals)}
    done |= {o.label for o in data.pipeline.operators if o.provides == {"boresight"}}
    own = [row for row in pipeline.provenance(data.scene)["operators"] if row[0] not in done]
    operators = [row for row in known if row[0] in done] + own
    return pipeline.run(data.scene, provenance={"operators": operators}, **options)


def _pipeline(data: Data, steps: list[Operator]) -> Pipeline:
    """The steps behind the kept signals. Raises InputError where one is not kept."""
    before = data.pipeline
    kept = frozenset[str].intersection(*(frozenset(o.detdata) for o in data.observations))
    acting = acting_steps(before.operators, [MAIN])
    source = KeptSignals(name=next(o.label for o in acting if forms(o)))
    source._data = data
    done = [
        source if forms(o) else DoneBefore.of(o, before.signals.components_of(o))
        for o in acting
        if forms(o) or filters(o) or before.signals.components_of(o)
    ]
    for step in steps:
        if before.signals.components_of(step) and not forms(step):
            text = f"{step.label} makes what the kept signal does not take"
            cure = "leave it out, or put it into the run that keeps the signal"
            raise InputError(text, place=PLACE, cure=cure)
    runs = dict(before.asked)
    while True:
        whole = Pipeline(
            [*done, *steps],
            runs=runs,
            only=before.only,
            name=before.name,
            description=before.description,
            precision=before.precision,
        )
        missing = [s.stream for s in whole.signals.formed if s.stream not in kept]
        named = {n for o in steps if isinstance(o, Output) for n in o.named_signals()}
        left = {n for n in runs if stream_of(n) in missing and n not in named}
        if not left:
            break
        runs = {name: signal for name, signal in runs.items() if name not in left}
    if missing:
        text = f"the stream {missing[0]!r} was not kept"
        cure = f"run it again with pipeline.run(scene, keep={sorted({*kept, *missing})!r})"
        raise InputError(text, place=PLACE, cure=cure)
    return whole
