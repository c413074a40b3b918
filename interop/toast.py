"""Scans as TOAST's Observations and back, without a file; zonda's operators in a pipeline of TOAST.
Needs the extra toast.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from zonda.core.configuration.time import Instant
from zonda.core.errors import InputError, PipelineError
from zonda.core.flags import INVALID
from zonda.core.operator import Operator
from zonda.core.pipeline import Pipeline
from zonda.core.types import AnyFloats, Floats
from zonda.core.versions import needed
from zonda.core.weather import GroundWeather
from zonda.operators.io.load_tod import LoadTOD
from zonda.operators.io.save_tod import save_tod
from zonda.operators.io.time_ordered_data import TimeOrderedData
from zonda.operators.io.toast_hdf5 import (
    FLAGS_ARE,
    WEATHER,
    columns_of,
    detectors_table,
    name_uid,
    nominal_noise,
    offsets_of,
    session_of,
)

from .scans import Source, scan_of

EXTRA = "toast"

toast = needed("toast", EXTRA)
for _part in ("instrument", "noise", "ops", "traits", "weather"):
    needed(f"toast.{_part}", EXTRA)

START = "zonda_start_utc"


def to_toast(
    source: Source, stream: str = "signal", *, scan: str | int | None = None, comm: Any = None
) -> Any:
    """A scan as a `toast.Observation`: what TOAST reads from a file of `SaveTOD`, without the file.

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
    ob = unfilled(found.tod, toast.Comm() if comm is None else comm)
    fill(
        ob,
        stream,
        found.tod.detector_flags,
        lambda row: (found.tod.streams[stream][row], found.spoilt[row]),
    )
    return ob


def unfilled(tod: TimeOrderedData, comm: Any) -> Any:
    """A `toast.Observation` of all but the streams of a scan."""
    session = toast.instrument.Session(
        session_of(tod), start=_datetime(tod.times[0]), end=_datetime(tod.times[-1])
    )
    ob = toast.Observation(
        comm, _telescope(tod), n_samples=tod.n_samples, name=tod.name, session=session
    )
    _fill_shared(ob, tod)
    if (noise := _noise(tod, list(ob.local_detectors))) is not None:
        ob["noise_model"] = noise
    for name, spans in tod.intervals.items():
        at = np.searchsorted(tod.seconds, np.reshape(spans, (-1, 2)))
        stamps = tod.times[np.minimum(at, tod.n_samples - 1)]
        ob.intervals.create(name, [tuple(row) for row in stamps.tolist()], ob.shared["times"])
    ob[START], ob[FLAGS_ARE] = tod.start, "TOAST's"
    for name, value in tod.metadata.items():
        ob[f"zonda_{name}"] = value
    return ob


def _telescope(tod: TimeOrderedData) -> Any:
    import astropy.units as u

    name, latitude, longitude, altitude = tod.site
    table = detectors_table(tod)
    plane = toast.instrument.Focalplane(
        detector_data=table,
        sample_rate=table.meta["sample_rate"],
        field_of_view=table.meta["field_of_view"],
    )
    site = toast.instrument.GroundSite(
        name,
        latitude * u.rad,
        longitude * u.rad,
        altitude * u.m,
        weather=tod.weather and _weather(tod.weather),
    )
    return toast.instrument.Telescope(tod.telescope, focalplane=plane, site=site)


def _weather(weather: GroundWeather) -> Any:
    """The weather as TOAST has it. Its west wind blows towards east, as ours; there are no
    clouds.
    """
    import astropy.units as u

    found = {
        theirs: u.Quantity(getattr(weather, ours), unit) for ours, (theirs, unit) in WEATHER.items()
    }
    return toast.weather.Weather(
        time=_datetime(weather.time), ice_water=0 * u.mm, liquid_water=0 * u.mm, **found
    )


def _fill_shared(ob: Any, tod: TimeOrderedData) -> None:
    for name, values in tod.of_samples().items():
        ob.shared.create_column(name, values.shape, dtype=values.dtype)
        ob.shared[name].set(np.ascontiguousarray(values), fromrank=0)


def fill(ob: Any, stream: str, flags: Any, row_of: Callable[[int], tuple[AnyFloats, Any]]) -> None:
    """Give an observation its stream [K] and the flags of detectors and single samples.

    ``flags``: (n_det,) of detectors. ``row_of``: values (n_samp,) of a detector by its number, and
    which of them (n_samp,) cannot be used.
    """
    import astropy.units as u

    rows = {name: row for row, name in enumerate(ob.all_detectors)}
    ob.detdata.create(stream, dtype=np.float64, units=u.K)
    ob.detdata.create("flags", dtype=np.uint8)
    for name in ob.local_detectors:
        ob.detdata[stream][name], spoilt = row_of(rows[name])
        ob.detdata["flags"][name] = flags[rows[name]] | np.where(
            spoilt, np.uint8(INVALID), np.uint8(0)
        )
    ob.update_local_detector_flags({name: int(flags[rows[name]]) for name in ob.local_detectors})


def _noise(tod: TimeOrderedData, local: list[str]) -> Any:
    """The nominal noise of the detectors that a process holds; None: it is not known."""
    import astropy.units as u

    nominal = nominal_noise(tod)
    if nominal is None:
        return None
    frequency, psd = nominal
    weights = 1 / (tod.columns["net"] ** 2 * tod.sample_rate)
    rows = {name: tod.names.index(name) for name in local}
    return toast.noise.Noise(
        detectors=local,
        freqs=dict.fromkeys(local, frequency * u.Hz),
        psds={name: psd[row] * u.K**2 * u.s for name, row in rows.items()},
        indices={name: name_uid(name) for name in local},
        detweights={name: weights[row] / u.K**2 for name, row in rows.items()},
    )


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
            "is spread over several processes", place=place, cure="use toast.Comm(groupsize=1)"
        )
    if not hasattr(ob.telescope.site, "earthloc"):
        raise InputError(
            "has no site on the ground",
            place=place,
            cure="give its telescope a toast.instrument.GroundSite",
        )
    names, table = list(ob.local_detectors), ob.telescope.focalplane.detector_data
    order = {str(name): row for row, name in enumerate(table["name"])}
    rows = np.array([order[name] for name in names], np.intp)
    times = np.array(ob.shared["times"].data)
    location = ob.telescope.site.earthloc.geodetic
    site = (
        ob.telescope.site.name,
        location.lat.rad,
        location.lon.rad,
        float(location.height.to_value("m")),
    )
    seconds = np.array(ob.shared["seconds"].data) if "seconds" in ob.shared else times - times[0]
    own = {
        key.removeprefix("zonda_"): value
        for key, value in _metadata(ob).items()
        if key not in (START, FLAGS_ARE)
    }
    tod = TimeOrderedData(
        name=ob.name,
        start=str(_metadata(ob).get(START, Instant(round(float(times[0]) * 1e9)).isoformat())),
        seconds=seconds,
        times=times,
        sample_rate=float(ob.telescope.focalplane.sample_rate.to_value("Hz")),
        telescope=ob.telescope.name,
        field_of_view=float(ob.telescope.focalplane.field_of_view.to_value("rad")),
        site=site,
        boresight_azel=_boresight(ob, "boresight_azel"),
        boresight_radec=_boresight(ob, "boresight_radec"),
        flags=(
            np.array(ob.shared["flags"].data, np.uint8)
            if "flags" in ob.shared
            else np.zeros(len(times), np.uint8)
        ),
        detector_flags=np.array([ob.local_detector_flags[name] for name in names], np.uint8),
        names=names,
        quats=np.asarray(table["quat"][rows], np.float64),
        columns=columns_of(table, rows),
        streams={} if stream is None else {stream: _stream(ob, stream, place)},
        intervals={
            name: _spans(ob.intervals[name], times, seconds)
            for name in ob.intervals
            if name != ob.intervals.all_name
        },
        weather=_ground_weather(ob.telescope.site.weather),
        hwp_angle=np.array(ob.shared["hwp_angle"].data) if "hwp_angle" in ob.shared else None,
        azimuth=np.array(ob.shared["azimuth"].data, np.float64) if "azimuth" in ob.shared else None,
        metadata=own,
        offsets=offsets_of(table, rows),
    )
    tod.check(place)
    return tod


def _metadata(ob: Any) -> dict[str, Any]:
    """Metadata of `to_toast` and of files of `SaveTOD` on the origin of the data."""
    return {key: value for key, value in ob.items() if str(key).startswith("zonda_")}


def _boresight(ob: Any, name: str) -> Floats:
    return np.array(ob.shared[name].data, np.float64) if name in ob.shared else np.zeros((0, 4))


def _spans(intervals: Any, times: AnyFloats, seconds: AnyFloats) -> list[tuple[float, float]]:
    found = [(float(each.start), float(each.stop)) for each in intervals]
    start, stop = np.interp(np.reshape(found, (-1, 2)).T, times, seconds)
    return list(zip(start.tolist(), stop.tolist(), strict=True))


def _stream(ob: Any, stream: str, place: str) -> Floats:
    """(n_det, n_samp) K, NaN where flagged."""
    if stream not in ob.detdata:
        cure = f"choose from: {', '.join(ob.detdata.keys()) or 'none'}"
        raise InputError(f"there is no stream {stream!r}", place=place, cure=cure)
    data = ob.detdata[stream]
    if not data.units.is_equivalent("K"):
        cure = "calibrate it to a temperature"
        raise InputError(
            f"the stream {stream} is in {str(data.units) or 'no unit'!r}, not in kelvin",
            place=place,
            cure=cure,
        )
    values: Floats = np.array(data.data, np.float64) * float(data.units.to("K"))
    if "flags" in ob.detdata:
        dead = np.array([ob.local_detector_flags[name] for name in ob.local_detectors], np.uint8)
        bad = (ob.detdata["flags"].data & ~dead[:, None] & np.uint8(7)) != 0
        values[bad] = np.nan
    return values


def _ground_weather(weather: Any) -> GroundWeather | None:
    """None where there is none."""
    if weather is None:
        return None
    stated = {
        ours: float(getattr(weather, theirs).to_value(unit))
        for ours, (theirs, unit) in WEATHER.items()
    }
    return GroundWeather(time=weather.time.timestamp(), **stated)


def _datetime(seconds: float) -> datetime:
    return datetime.fromtimestamp(float(seconds), tz=UTC)


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
        "signal", help="Observation detdata key for accumulating the simulated signal"
    )

    def __init__(
        self,
        operators: Sequence[Operator] = (),
        seed: int = 0,
        scene: dict[str, Any] | None = None,
        **traits: Any,
    ) -> None:
        self._operators, self._seed, self._scene = list(operators), seed, dict(scene or {})
        super().__init__(**traits)
        if any("boresight" in operator.provides for operator in self._operators):
            cure = "leave it out: the observations are pointed already"
            raise PipelineError(
                "an operator points the telescope", place="zonda.interop.toast.Simulate", cure=cure
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
