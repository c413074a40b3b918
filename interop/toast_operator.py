"""An operator of TOAST as a step of a pipeline."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import numpy as np
from pydantic import Field, JsonValue, model_validator

from zonda.core.configuration.diagnostics import nearest, refusal
from zonda.core.data import Block, Data, Observation
from zonda.core.errors import InputError, PipelineError
from zonda.core.flags import DETECTOR_MASK, PROCESSING
from zonda.core.machine import needed
from zonda.core.operator import Operator
from zonda.core.plan.planning import Planning
from zonda.core.signal import MAIN
from zonda.core.stream import Changed, Stream, whole
from zonda.core.types import AnyFloats
from zonda.operators.io.time_ordered_data import TimeOrderedData

EXTRA = "toast"
ALONE = threading.Lock()
"""TOAST works on one scan at a time, with threads of its own (OMP_NUM_THREADS)."""


class ToastOperator(Operator):
    """Let an operator of TOAST 3 act on the signal of each scan, e.g. a filter. Needs the extra
    toast.

    For example ``ToastOperator: {operator: PolyFilter, traits: {order: 3, view: throw}}``. It is
    given what TOAST reads from a file of `SaveTOD`: one scan of one band with all detectors and
    samples in float64, flags, intervals, pointing, weather and nominal noise. Samples that are not
    finite are flagged for it. What it flags no map uses. Its random numbers, if any, are TOAST's:
    they follow from the trait `realization` and the names of scan and detectors, not from the
    scene's seed.
    """

    requires = frozenset({"signal"})
    provides = frozenset({"signal"})
    knows_means = True
    couples = "all"

    operator: str
    """Its name in `toast.ops`, e.g. PolyFilter, GroundFilter, CommonModeFilter."""
    traits: dict[str, JsonValue] = Field(default_factory=dict)
    """Its traits by name; what has a unit as text (`1 deg`). A trait that is an operator:
    {operator: NAME, traits: ...}.
    """

    @model_validator(mode="after")
    def _traits(self) -> ToastOperator:
        """Errors at their place in the file, where TOAST is installed; where it is not, the run and
        `zonda check` say so.
        """
        if find_spec("toast") is not None:
            try:
                made(self.operator, self.traits)
            except InputError as err:
                raise refusal(err) from None
        return self

    def observe(self, data: Data) -> None:
        """Raises InputError where TOAST is not installed."""
        needed("toast.ops", EXTRA)

    def check(self, data: Data) -> list[str]:
        """Raises InputError where TOAST is not installed, PipelineError where a scan lacks what the
        operator needs.
        """
        self.observe(data)
        for scan in data.observations[:1]:
            whole = scan.instrument
            camera = next(iter(whole.cameras.values())) if whole.bands else whole
            flags = np.zeros(0, np.uint8)
            self.prepare(
                replace(
                    scan,
                    instrument=camera,
                    focalplane=camera.focalplane(),
                    detector_flags=flags,
                )
            )
        return []

    def prepare(self, observation: Observation) -> None:
        """Raises PipelineError where the scan lacks what the operator needs."""
        self._check_needs(observation)

    def measure(self, stream: Stream, model: Any = None) -> Changed:
        """Apply TOAST's operator to a signal. ``model`` is not used: each signal is acted on by
        itself.
        """
        return self._changed(stream)

    def exec(self, block: Block, state: Changed) -> None:
        """Replace the signal by what TOAST made of it."""
        state.put(block, "signal")

    def _check_needs(self, observation: Observation) -> None:
        """Raises PipelineError where the scan lacks what the operator needs."""
        ob = _in_toast(observation, {})
        operator = made(self.operator, self.traits)
        try:
            wanted = operator.requires()
            makes = operator.provides()
        except Exception:  # SimAtmosphere of TOAST 3.0.6 cannot say it
            return
        for kind, there in {
            "shared": ob.shared,
            "intervals": ob.intervals,
            "detdata": ("signal", "flags"),
            "meta": ob,
        }.items():
            for name in wanted[kind]:
                if name is not None and name not in there and name not in makes[kind]:
                    names = [
                        n for n in there if not (kind == "intervals" and n == ob.intervals.all_name)
                    ]
                    raise PipelineError(
                        f"toast.ops.{self.operator} needs {name!r} of {WHAT[kind]}, which the scan"
                        " does not have",
                        place=f"{self.label}, {observation.name}",
                        cure=(
                            "name another in its traits:"
                            f" {', '.join(map(str, names)) or 'there is none'}"
                        ),
                    )

    def _apply(self, ob: Any, observation: Observation) -> None:
        """Let it act. Raises PipelineError with what it says where it cannot."""
        import toast

        shape = ob.detdata["signal"].data.shape
        place = f"{self.label}, {observation.name}"
        data = toast.Data(ob.comm)
        data.obs.append(ob)
        try:
            made(self.operator, self.traits).apply(data)
        except Exception as err:  # of any kind, also mistakes of TOAST's own
            cure = "see the description of its traits in TOAST's documentation"
            raise PipelineError(
                f"toast.ops.{self.operator}: {type(err).__name__}: {err}",
                place=place,
                cure=cure,
            ) from err
        finally:
            there = list(data.obs)
            data.obs.clear()  # else they are emptied with it
        same = len(there) == 1 and there[0] is ob and "signal" in ob.detdata
        if not same or ob.detdata["signal"].data.shape != shape:
            cure = "save the streams (SaveTOD) and go on in TOAST"
            raise PipelineError(
                f"toast.ops.{self.operator} leaves other detectors, samples or streams than it was"
                " given",
                place=place,
                cure=cure,
            )

    def _changed(self, stream: Stream) -> Changed:
        """See `ToastOperator.measure`."""
        observation = stream.observation
        with ALONE:
            values = whole(stream)
            spoilt = ~np.isfinite(values)
            ob = _in_toast(observation, {"signal": values})
            ob.detdata["signal"].data[spoilt] = 0.0
            before = ob.detdata["flags"].data.copy()
            sums = _sums(ob)
            self._apply(ob, observation)
            if np.array_equal(sums, _sums(ob)) and np.array_equal(before, ob.detdata["flags"].data):
                observation.log.state(
                    self.label,
                    "no effect",
                    f"{self.operator} left the signal and its flags as they were",
                )
            values = np.array(ob.detdata["signal"].data)
            values[spoilt] = np.nan
            values[_newly_flagged(self.label, stream, ob, before)] = np.nan
        return Changed.of(values, stream)


WHAT = {
    "shared": "shared data",
    "intervals": "intervals",
    "detdata": "detector data",
    "meta": "metadata",
}


def made(name: str, traits: Mapping[str, Any]) -> Any:
    """An operator of `toast.ops`. Raises InputError where there is none of that name or no such
    trait, or where it takes no such value."""
    ops = needed("toast.ops", EXTRA)
    known = {
        n: v for n, v in vars(ops).items() if isinstance(v, type) and issubclass(v, ops.Operator)
    }
    if (cls := known.get(name.removeprefix("toast.ops."))) is None:
        cure = (
            nearest(name, list(known)) or "give the name of a class of toast.ops, e.g. PolyFilter"
        )
        raise InputError(f"toast.ops has no operator {name!r}", cure=cure)
    own = cls.class_traits()  # type: ignore[attr-defined]
    for trait in traits:
        if trait not in own:
            cure = nearest(trait, list(own)) or f"choose from: {', '.join(sorted(own))}"
            raise InputError(f"toast.ops.{name} has no trait {trait!r}", cure=cure)
    if traits.get("det_data", "signal") != "signal":
        raise InputError("there is no stream for TOAST but the signal", cure="leave det_data out")
    values = {
        trait: _value(own[trait], value, f"toast.ops.{name}, trait {trait}")
        for trait, value in traits.items()
    }
    if "det_data" in own:
        values["det_data"] = "signal"
    traitlets = needed("traitlets", EXTRA)
    try:
        return cls(**values)
    except (traitlets.TraitError, ValueError, TypeError) as err:
        raise InputError(f"toast.ops.{name}: {err}", cure="correct its traits") from None


def _value(trait: Any, value: Any, place: str) -> Any:
    """A trait's value from what a file says."""
    import astropy.units as u
    import toast.traits as kinds

    if isinstance(value, Mapping) and "operator" in value:
        return made(str(value["operator"]), value.get("traits") or {})
    try:
        if isinstance(trait, kinds.Quantity) and isinstance(value, str):
            return u.Quantity(value)
        if isinstance(trait, kinds.Unit) and isinstance(value, str):
            return u.Unit(value)
    except (ValueError, TypeError) as err:
        raise InputError(f"{place}: {err}", cure="give a number with a unit, e.g. 1 deg") from None
    return value


def _in_toast(observation: Observation, streams: Mapping[str, AnyFloats]) -> Any:
    """The scan in TOAST, on this process alone."""
    from . import toast as bridge

    mpi = needed("toast.mpi", EXTRA)
    comm = bridge.toast.Comm(world=mpi.MPI.COMM_SELF) if mpi.use_mpi else bridge.toast.Comm()
    tod = replace(TimeOrderedData.of(observation), streams=dict(streams))
    return bridge.observation_of(tod, comm)


def _sums(ob: Any) -> AnyFloats:
    """(n_det, 2) sums by which a changed signal is recognized."""
    values = np.asarray(ob.detdata["signal"].data)
    return np.stack([values.sum(axis=1), np.abs(values).sum(axis=1)], axis=1)


def _newly_flagged(label: str, stream: Stream, ob: Any, before: Any) -> Any:
    """(n_det, n_samp) single samples that no map may use any more. The complete signal decides
    which whole detectors, and which instants of all of them, are flagged."""
    observation = stream.observation
    own = np.array(
        [ob.local_detector_flags[name] for name in ob.local_detectors],
        np.uint8,
    ) & np.uint8(DETECTOR_MASK)
    used = observation.good_detectors
    good = observation.good_samples
    new = (ob.detdata["flags"].data & ~before & np.uint8(DETECTOR_MASK)) != 0
    new[:, ~good] = False
    new[~used | (own != 0)] = False
    left = new[used & (own == 0)]
    instants = good & ((np.asarray(ob.shared["flags"].data) & ~observation.flags & 15) != 0)
    if len(left):
        instants |= left.all(axis=0)
    if stream.signal == MAIN:
        dead = used & (own != 0)
        observation.detector_flags[dead] |= own[dead]
        observation.flags[instants] |= PROCESSING
        log = observation.log
        log.count(label, "detectors that TOAST flagged", int(dead.sum()), observation.n_detectors)
        log.count(label, "instants that TOAST flagged", int(instants.sum()), observation.n_samples)
        log.count(
            label,
            "further single samples that TOAST flagged",
            int((new & ~instants).sum()),
            new.size,
        )
    return new & ~instants


class ToastPlanning(Planning[ToastOperator]):
    """Planning of an operator of TOAST, whose cost and effect are not known."""

    of = ToastOperator
    smaller = "make the scan shorter: TOAST holds all of it in float64"

    def memory(self, observation: Observation) -> int:
        """For TOAST the signal in float64, its flags and as much again to work with; what it made
        of each signal.
        """
        return (
            (8 + 2 + 1 + 8 + 8 * len(observation.signals))
            * observation.n_detectors
            * observation.n_samples
        )
