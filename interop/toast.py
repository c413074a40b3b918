"""Scans as TOAST's Observations and back; zonda's operators in a pipeline of TOAST. Needs the extra
toast.

Either side writes a temporary file in TOAST's HDF5 layout, which the other reads.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from zonda.core.errors import InputError, PipelineError
from zonda.core.machine import needed
from zonda.core.operator import Operator
from zonda.core.pipeline import Pipeline
from zonda.core.types import AnyFloats
from zonda.operators.io.load_tod import LoadTOD
from zonda.operators.io.save_tod import load_tod, save_tod
from zonda.operators.io.time_ordered_data import TimeOrderedData

from .scans import Source, scan_of

EXTRA = "toast"

toast = needed("toast", EXTRA)
for _part in ("io", "ops", "traits"):
    needed(f"toast.{_part}", EXTRA)


def to_toast(
    source: Source,
    stream: str = "signal",
    *,
    scan: str | int | None = None,
    comm: Any = None,
) -> Any:
    """A scan as a `toast.Observation`: what TOAST reads from a file of `SaveTOD`.

    ``detdata`` has the stream [K] and ``flags``, whose bit 1 marks single samples that are not
    finite or flagged in the file; ``shared`` the times, the boresight and the flags; the noise
    model is the nominal one. Bands of one scan are one session.

    Parameters
    ----------
    source, stream, scan
        As for `zonda.interop.sotodlib.to_axismanager`.
    comm
        A `toast.Comm`. Where absent: ``toast.Comm()``. In a group of several processes each calls
        this with the same scan and holds its share of the detectors.

    Raises
    ------
    InputError
        The stream was not kept or is not in the file.
    """
    found = scan_of(source, stream, scan)
    values = np.where(found.spoilt, np.nan, found.tod.streams[stream])
    return observation_of(replace(found.tod, streams={stream: values}), comm or toast.Comm())


def observation_of(tod: TimeOrderedData, comm: Any) -> Any:
    """A `toast.Observation` of a scan and its streams, spread over the processes of a group."""
    first = comm.group_rank == 0
    with tempfile.TemporaryDirectory() as folder:
        path = save_tod(Path(folder) / "scan.h5", tod) if first else None
        if comm.comm_group is not None:
            path = comm.comm_group.bcast(path, root=0)
        found = toast.io.load_hdf5(str(path), comm)
        if comm.comm_group is not None:
            comm.comm_group.barrier()  # the file is there until all have read it
    return found


def from_toast(ob: Any, stream: str | None = "signal") -> TimeOrderedData:
    """A `toast.Observation` as `TimeOrderedData`, which `save_tod` writes and `to_axismanager`
    takes.

    Its pointing, focal plane, flags, intervals, weather and one stream (None: no stream), converted
    to K. A sample with a bit of ``detdata/flags`` that excludes it becomes NaN.

    Raises InputError where it has no site on the ground, no pointing, or no such stream in kelvin,
    or is spread over processes.
    """
    place = f"TOAST's observation {ob.name}"
    if ob.comm.group_size != 1:
        raise InputError(
            "is spread over several processes",
            place=place,
            cure="use toast.Comm(groupsize=1)",
        )
    if not hasattr(ob.telescope.site, "earthloc"):
        raise InputError(
            "has no site on the ground",
            place=place,
            cure="give its telescope a toast.instrument.GroundSite",
        )
    streams = [] if stream is None else [stream]
    for name in streams:
        if name not in ob.detdata:
            there = ", ".join(key for key in ob.detdata if key != "flags") or "none"
            cure = f"choose from: {there}"
            raise InputError(f"there is no stream {name!r}", place=place, cure=cure)
        unit = ob.detdata[name].units
        if not unit.is_equivalent("K"):
            raise InputError(
                f"the stream {name} is in {str(unit) or 'no unit'!r}, not in kelvin",
                place=place,
                cure="calibrate it to a temperature",
            )
    streams += ["flags"] if streams and "flags" in ob.detdata else []
    origin = [key for key in ob if str(key).startswith("zonda_")]  # of the data, by `to_toast`
    with tempfile.TemporaryDirectory() as folder:
        return load_tod(toast.io.save_hdf5(ob, folder, meta=origin, detdata=streams))


class Simulate(toast.ops.Operator):  # type: ignore[misc, name-defined]
    """Operator of TOAST that adds what zonda's operators simulate on each observation's pointing to
    its ``detdata``.

    For example, in place of SimAtmosphere::

        Simulate([zonda.AtmosphereLayers(pwv="1 mm"), zonda.Efficiency()], seed=1).apply(data)

    Observations of one session see the same turbulence (one draw for each ``seed`` and session).
    Site, focal plane, beams and band are the observation's; what it does not state is the
    instrument's of ``scene``. A flagged detector gets a signal too.

    Parameters
    ----------
    operators
        Operators of zonda that make the signal; none that points the telescope.
    seed
        Of the random numbers.
    scene
        Further parameters of `zonda.Scene`: ``instrument``, ``weather`` ...
    traits
        ``det_data``: name of the stream to add to, made [K] where it is not there; and those of
        every operator of TOAST.
    """

    det_data = toast.traits.Unicode(
        "signal",
        help="Observation detdata key for accumulating the simulated signal",
    )

    def __init__(
        self,
        operators: Sequence[Operator] = (),
        seed: int = 0,
        scene: dict[str, Any] | None = None,
        **traits: Any,
    ) -> None:
        self._operators = list(operators)
        self._seed = seed
        self._scene = dict(scene or {})
        super().__init__(**traits)
        if any("boresight" in operator.provides for operator in self._operators):
            cure = "leave it out: the observations are pointed already"
            raise PipelineError(
                "an operator points the telescope",
                place="zonda.interop.toast.Simulate",
                cure=cure,
            )

    def _exec(self, data: Any, detectors: Any = None, **kwargs: Any) -> None:
        import astropy.units as u

        for ob in data.obs:
            wanted = ob.select_local_detectors(detectors)
            if not wanted:
                continue
            ob.detdata.ensure(self.det_data, detectors=wanted, dtype=np.float64, create_units=u.K)
            factor = u.K.to(ob.detdata[self.det_data].units)
            rows = {name: row for row, name in enumerate(ob.local_detectors)}
            signal = self._simulated(ob)
            for name in wanted:
                ob.detdata[self.det_data][name] += factor * signal[rows[name]]

    def _simulated(self, ob: Any) -> AnyFloats:
        """(n_det, n_samp) K."""
        session = ob.session.uid if ob.session is not None else ob.uid
        seed = int(np.random.SeedSequence([self._seed, session]).generate_state(1)[0] >> 1)
        with tempfile.TemporaryDirectory() as folder:  # pointing and focal plane alone
            tod = from_toast(ob, None)
            tod.detector_flags = np.zeros_like(tod.detector_flags)
            path = save_tod(Path(folder) / "pointing.h5", tod)
            pointing = LoadTOD(file=path, signal=None)
            scene = pointing.scene(**{"seed": seed, **self._scene})
            return Pipeline([pointing, *self._operators]).run(scene, keep=["signal"]).tod("signal")

    def _finalize(self, data: Any, **kwargs: Any) -> None:
        pass

    def _requires(self) -> dict[str, list[str]]:
        return {"shared": ["times", "boresight_azel"]}

    def _provides(self) -> dict[str, list[str]]:
        return {"detdata": [self.det_data]}
