"""TOAST 3's HDF5 observation file, layout version 2, read with h5py alone: all but the streams at
once, those in rectangles.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.configuration.time import Instant
from zonda.core.errors import InputError
from zonda.core.flags import DETECTOR_MASK, PROCESSING, TRIMMED_INTERVALS, Flags, of_before
from zonda.core.intervals import Intervals, runs
from zonda.core.storage.files import reading
from zonda.core.storage.hdf5_files import check_size, checked
from zonda.core.types import AnyFloats, Floats
from zonda.core.weather import GroundWeather

from .recorded_stream import kelvin_per
from .time_ordered_data import TimeOrderedData
from .toast_hdf5 import COLUMNS, FLAGS_ARE, OFFSETS, WEATHER

KIND, CURE = (
    "HDF5 in TOAST's layout",
    "give an HDF5 file in TOAST's layout, whole, as SaveTOD writes it",
)
AGAIN = "save it again with TOAST 3.0 or later, or with SaveTOD"

DEFAULT_MODEL = "noise_model"
"""Name of the noise model that TOAST's operators make and read where no other is asked for."""

PARTS = {
    "instrument": "no instrument",
    "instrument/focalplane": "no focal plane",
    "shared": "no pointing",
    "shared/times": "no times of the samples",
    "detdata": "no data of detectors",
}
"""What must be there, and what to say where it is not."""

NUMBERS = {"times", "seconds", "flags", "boresight_azel", "boresight_radec", "hwp_angle"}
"""What is read of ``shared``."""


class Reader:
    """An open file. `read` and `flags` may be called from several threads at once.

    Attributes
    ----------
    tod
        All but the streams.
    streams
        Names of the streams, with their units as the file has them.

    Raises
    ------
    InputError
        No such file, not HDF5, another layout, an item that TOAST requires is missing, or what is
        in it does not fit together.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.place = f"time-ordered data {path}"
        with reading(self.place, KIND, CURE):
            self._file = checked(path, self.place, CURE)
        try:
            with reading(self.place, KIND, CURE):
                _check_parts(self._file, self.place)
                self.tod = _read(self._file, self.place)
                self.streams = self._streams()
            self.tod.check(self.place)
        except BaseException:
            self.close()
            raise

    def read(self, stream: str, detectors: NDArray[np.intp], samples: slice) -> AnyFloats:
        """(n, m) values of a stream: rows ``detectors`` (n,) of the file, in its own units and
        type.
        """
        with reading(self.place, KIND, CURE):
            found: AnyFloats = _rectangle(self._file["detdata"][stream], detectors, samples)
            return found

    def flags(self, detectors: NDArray[np.intp], samples: slice) -> Flags | None:
        """(n, m) uint8, flags of each sample of each detector; None: the file has none."""
        found = self._file["detdata"].get("flags")
        if found is None:
            return None
        with reading(self.place, KIND, CURE):
            return np.asarray(_rectangle(found, detectors, samples), np.uint8)

    def noise(self, model: str | None, mask: int) -> dict[str, Floats]:
        """`TimeOrderedData.columns` of the noise of a model of the file; None: of `DEFAULT_MODEL`,
        nothing where there is none.

        ``mask``: detectors with one of these bits are not used. Raises InputError where there is no
        model of this name, or it cannot be used.
        """
        have = models(self._file)
        if model is None and DEFAULT_MODEL not in have:
            return {}
        if model is not None and model not in have:
            cure = f"choose from: {', '.join(have)}" if have else "leave noise_model out"
            raise InputError(
                f"has no noise model {model!r} (/metadata)", place=self.place, cure=cure
            )
        with reading(self.place, KIND, CURE):
            group, unused = (
                self._file["metadata"][model or DEFAULT_MODEL],
                (self.tod.detector_flags & np.uint8(mask)) != 0,
            )
            return columns_of_model(group, self.tod.names, unused, self.place)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _streams(self) -> dict[str, str]:
        """Names and units; their shapes are checked."""
        import h5py

        shape, found = (self.tod.n_detectors, self.tod.n_samples), {}
        for name, item in self._file["detdata"].items():
            datasets = (
                [item]
                if isinstance(item, h5py.Dataset)
                else [d for d in item.values() if isinstance(d, h5py.Dataset)]
            )
            for dataset in datasets:
                check_size(dataset, self.place, whole=False)
            if isinstance(item, h5py.Dataset) and (
                item.shape != shape or item.dtype.kind not in "fiu"
            ):
                what = f"detdata/{name} is {' x '.join(map(str, item.shape))} of {item.dtype}"
                raise InputError(
                    f"{what}, not {shape[0]} x {shape[1]} numbers", place=self.place, cure=AGAIN
                )
            if name != "flags":
                found[name] = str(item.attrs.get("units", "K"))
        return found


def _check_parts(file: Any, place: str) -> None:
    version = file.attrs.get("toast_format_version")
    if version != 2:
        raise InputError(f"toast_format_version is {version}, not 2", place=place, cure=AGAIN)
    for part, what in PARTS.items():
        if part not in file:
            raise InputError(
                f"is incomplete or corrupt: there is {what} (/{part})", place=place, cure=CURE
            )
    for name, item in file["shared"].items():
        if name in NUMBERS and (not hasattr(item, "dtype") or item.dtype.kind not in "fiu"):
            text = f"shared/{name} holds no numbers ({getattr(item, 'dtype', 'a group')})"
            raise InputError(text, place=place, cure=AGAIN)
    if not {"boresight_azel", "boresight_radec"} & set(file["shared"]):
        message = "there is no pointing (shared/boresight_azel, shared/boresight_radec)"
        raise InputError(f"is incomplete or corrupt: {message}", place=place, cure=CURE)


def _rectangle(item: Any, rows: NDArray[np.intp], samples: slice) -> Any:
    """Rows and samples of a data set, or of a group that holds a FLAC-compressed one."""
    import h5py

    first, last = int(rows[0]), int(rows[-1]) + 1
    wanted = (
        slice(first, last)
        if last - first == len(rows) and (np.diff(rows) == 1).all()
        else rows.tolist()
    )
    if isinstance(item, h5py.Dataset):
        return item[wanted, samples]
    if "flacarray_format_version" not in item.attrs:
        raise InputError(
            f"{item.name} is a group, not a data set",
            cure="save it again, uncompressed or with FLAC",
        )
    try:
        from flacarray.hdf5 import read_array
    except ImportError:
        raise InputError(
            f"{item.name} is compressed with FLAC", cure="pip install flacarray"
        ) from None  # the extra flac
    keep = np.zeros(int(item["stream_starts"].shape[0]), bool)
    keep[rows] = True
    found = np.asarray(read_array(item, keep=keep, stream_slice=samples)).reshape(len(rows), -1)
    return found.astype(np.dtype(str(item.attrs["dtype"]))) if "dtype" in item.attrs else found


def read(path: str | os.PathLike[str]) -> TimeOrderedData:
    """Read all of a file. Temperatures are converted to K; single samples that it flags
    (`DETECTOR_MASK`) become NaN.

    Raises InputError as `Reader` does.
    """
    import h5py

    reader = Reader(path)
    try:
        tod = reader.tod
        every = np.arange(tod.n_detectors)
        flags = reader.flags(every, slice(0, tod.n_samples))
        spoilt = (
            None
            if flags is None
            else (flags & ~tod.detector_flags[:, None] & np.uint8(DETECTOR_MASK)) != 0
        )
        for name in reader.streams:
            item = reader._file["detdata"][name]
            for dataset in [item] if isinstance(item, h5py.Dataset) else []:
                check_size(dataset, reader.place)
            tod.streams[name] = reader.read(name, every, slice(0, tod.n_samples))
            if (factor := kelvin_per(reader.streams[name]) or 1.0) != 1.0:
                tod.streams[name] = tod.streams[name] * factor
            if spoilt is not None and spoilt.any():
                tod.streams[name] = np.where(spoilt, np.nan, tod.streams[name])
    finally:
        reader.close()
    tod.check(reader.place)
    return tod


def _read(file: Any, place: str) -> TimeOrderedData:
    """Read everything but the streams."""
    import astropy.units as u

    instrument, shared = file["instrument"], file["shared"]
    for dataset in (
        *shared.values(),
        *(file["intervals"].values() if "intervals" in file else ()),
        instrument["focalplane"],
    ):
        check_size(dataset, place)
    names = [str(d) for d in json.loads(file.attrs["observation_detectors"])]
    table, rows = _focalplane(instrument, names, place)
    other: Mapping[str, Any] = file["metadata/other"].attrs if "metadata/other" in file else {}
    times = shared["times"][:]
    seconds = shared["seconds"][:] if "seconds" in shared else times - times[0]
    start = other.get("zonda_start_utc")
    if start is None:
        start = Instant(round(float(times[0]) * 1e9)).isoformat()
    kept = (k for k in other if k.startswith("zonda_") and k not in ("zonda_start_utc", FLAGS_ARE))
    own = {k.removeprefix("zonda_"): other[k] for k in kept}
    flags, detector_flags, before = _flags(file, other, names)
    intervals = _intervals(file, times, seconds)
    if before:
        intervals[TRIMMED_INTERVALS] = runs((flags & np.uint8(PROCESSING)) != 0, seconds)
    a = instrument.attrs
    return TimeOrderedData(
        name=str(file.attrs["observation_name"]),
        start=str(start),
        seconds=seconds,
        times=times,
        sample_rate=float(table.meta["sample_rate"].to_value(u.Hz)),
        telescope=str(a["telescope_name"]),
        field_of_view=float(table.meta["field_of_view"].to_value(u.rad)),
        site=(
            str(a["site_name"]),
            float(np.radians(a["site_lat_deg"])),
            float(np.radians(a["site_lon_deg"])),
            float(a["site_alt_m"]),
        ),
        boresight_azel=_quaternions(shared, "boresight_azel"),
        boresight_radec=_quaternions(shared, "boresight_radec"),
        flags=flags,
        detector_flags=detector_flags,
        names=names,
        quats=np.asarray(table["quat"][rows], np.float64),
        columns=columns_of(table, rows),
        intervals=intervals,
        weather=_weather(a),
        hwp_angle=shared["hwp_angle"][:] if "hwp_angle" in shared else None,
        azimuth=np.asarray(shared["azimuth"][:], np.float64) if "azimuth" in shared else None,
        metadata={k: v.item() if isinstance(v, np.generic) else v for k, v in own.items()},
        offsets=offsets_of(table, rows),
    )


def columns_of(table: Any, rows: NDArray[np.intp]) -> dict[str, Floats]:
    """`TimeOrderedData.columns` of these rows of TOAST's table of detectors."""
    import astropy.units as u

    columns = {}
    for ours, (theirs, unit, si) in COLUMNS.items():
        if theirs in table.colnames:
            values = table[theirs][rows]
            columns[ours] = np.array(
                u.Quantity(values, unit).to_value(si) if unit else values, np.float64
            )
    if "pol_leakage" in table.colnames:
        epsilon = np.asarray(table["pol_leakage"][rows], np.float64)
        columns.setdefault("polarization_efficiency", (1 - epsilon) / (1 + epsilon))
    elif "polarization_angle" in columns:  # as TOAST's StokesWeights, whose epsilon is 0 then
        columns.setdefault("polarization_efficiency", np.ones(len(rows)))
    return columns


def offsets_of(table: Any, rows: NDArray[np.intp]) -> Floats | None:
    """`TimeOrderedData.offsets` of these rows of TOAST's table of detectors."""
    return (
        np.array([table[k][rows] for k in OFFSETS]).T if {*OFFSETS} <= set(table.colnames) else None
    )


def _focalplane(instrument: Any, names: list[str], place: str) -> tuple[Any, NDArray[np.intp]]:
    """The table of detectors, and the rows of those that have data."""
    from astropy.io.misc.hdf5 import read_table_hdf5
    from astropy.table import QTable

    table = QTable(read_table_hdf5(instrument, path="focalplane", character_as_bytes=False))
    every = [str(name) for name in np.asarray(table["name"]).astype(str)]
    order = {name: k for k, name in enumerate(every)}
    for what, of in ((names, "observation_detectors"), (every, "the focal plane")):
        if len(set(what)) < len(what):
            twice = next(name for name in what if what.count(name) > 1)
            cure = "give every detector a name of its own, and save it again"
            raise InputError(f"detector {twice!r} is there twice in {of}", place=place, cure=cure)
    if lacking := [name for name in names if name not in order]:
        raise InputError(
            f"detector {lacking[0]!r} has data, and no row in the focal plane",
            place=place,
            cure=AGAIN,
        )
    return table, np.array([order[name] for name in names], np.intp)


def _quaternions(shared: Any, name: str) -> Floats:
    return np.asarray(shared[name][:], np.float64) if name in shared else np.zeros((0, 4))


def _flags(file: Any, other: Mapping[str, Any], names: list[str]) -> tuple[Flags, Flags, bool]:
    """Flags of samples and of detectors, in TOAST's bits; whether an earlier zonda wrote them (its
    *processing*: trimmed).
    """
    shared = file["shared"]
    found = json.loads(file.attrs["observation_detector_flags"])
    flags = shared["flags"][:] if "flags" in shared else np.zeros(len(shared["times"]), np.uint8)
    detector_flags = np.array([found[d] for d in names], np.uint8)
    if "zonda_start_utc" in other and FLAGS_ARE not in other:
        return of_before(flags, samples=True), of_before(detector_flags, samples=False), True
    return np.asarray(flags, np.uint8), detector_flags, False


def _intervals(file: Any, times: AnyFloats, seconds: AnyFloats) -> Intervals:
    found: Intervals = {}
    for name, spans in file["intervals"].items() if "intervals" in file else ():
        start, stop = np.interp(np.asarray(spans[:], np.float64), times, seconds)
        found[name] = list(zip(start.tolist(), stop.tolist(), strict=True))
    return found


def _weather(attributes: Any) -> GroundWeather | None:
    """None where there is none, or one that states no numbers (TOAST's simulated weather names its
    distribution alone).
    """
    import astropy.units as u

    if not {"weather_time", *(f"weather_{theirs}" for theirs, _ in WEATHER.values())} <= set(
        attributes
    ):
        return None
    stated = {
        ours: float(
            u.Quantity(str(attributes[f"weather_{theirs}"])).to_value(
                unit or u.dimensionless_unscaled
            )
        )
        for ours, (theirs, unit) in WEATHER.items()
    }
    return GroundWeather(time=float(attributes["weather_time"]), **stated)


# --------------------------------------------------------------------------------------------------
# noise models (`toast.noise.Noise`): white level, knee and slope of power spectra

NOISE_CURE = "save the file again with TOAST 3.0 or later, or estimate the noise: zonda noise FILE"

RISE = 1.5
"""Power over the white level from which there is 1/f noise."""

STEEPEST = 4.0

BINS = 400
"""Frequencies that a spectrum is fitted at, at most."""


def models(file: Any) -> list[str]:
    """The names of the noise models in an open HDF5 file."""
    found = file["metadata"].items() if "metadata" in file else ()
    return [name for name, item in found if "mixing_matrix" in item and "psd_units" in item.attrs]


def columns_of_model(
    group: Any, detectors: list[str], unused: NDArray[np.bool_], place: str
) -> dict[str, Floats]:
    """NET [K sqrt(s)], knee, minimum_frequency [Hz] and slope (n_det,) of the spectra of an open
    noise model.

    The spectrum of a detector is the sum of those that TOAST mixes for it, times their weights
    squared. Of an ``unused`` detector (n_det,) they are NaN.

    Raises
    ------
    InputError
        A detector has no spectrum, or one that is not positive, finite and in kelvin^2 s.
    """
    spectra = _spectra(group, place)
    mixed: dict[str, list[tuple[str, float]]] = {}
    for detector, key, weight in group["mixing_matrix"][:]:
        mixed.setdefault(detector.decode(), []).append((key.decode(), float(weight)))
    found, known = np.full((4, len(detectors)), np.nan), dict[bytes, Floats]()
    for number in np.flatnonzero(~unused).tolist():
        detector = detectors[number]
        parts = [(key, weight) for key, weight in mixed.get(detector, ()) if weight != 0]
        if not parts or any(key not in spectra for key, _ in parts):
            raise InputError(
                f"{group.name} has no spectrum of detector {detector}", place=place, cure=NOISE_CURE
            )
        frequency = spectra[parts[0][0]][0]
        total = sum(weight**2 * np.interp(frequency, *spectra[key]) for key, weight in parts)
        digest = frequency.tobytes() + np.asarray(total).tobytes()
        if digest not in known:
            known[digest] = fit(
                frequency, np.asarray(total), f"{place}, {group.name}, detector {detector}"
            )
        found[:, number] = known[digest]
    return dict(zip(("net", "knee", "minimum_frequency", "slope"), found, strict=True))


def _spectra(group: Any, place: str) -> dict[str, tuple[Floats, Floats]]:
    """Frequencies [Hz], without zero, and power spectral densities [K^2 s] by key.

    There is one data set for each set of frequencies.
    """
    import astropy.units as u

    unit = str(group.attrs["psd_units"])
    try:
        factor = u.Unit(unit).to("K2 s")
    except (ValueError, u.UnitConversionError):
        text = f"{group.name} has spectra in {unit!r}, not in K2 s"
        raise InputError(
            text, place=place, cure="calibrate to kelvin, or estimate the noise: zonda noise FILE"
        ) from None
    found = {}
    for name in group:
        if f"{name}_keys" in group:
            check_size(group[name], place)
            rows = np.asarray(group[name][:], np.float64)
            use = rows[0] > 0
            for key, row in zip(group[f"{name}_keys"][:], rows[1:], strict=True):
                found[key.decode()] = rows[0][use], factor * row[use]
    return found


def fit(frequency: Floats, power: Floats, place: str) -> Floats:
    """NET, knee, minimum frequency and slope of a spectrum.

    That of TOAST's form (toast.noise_sim.AnalyticNoise) or of zonda's, whichever comes nearer,

        P(f) = NET^2 (f^a + knee^a) / (f^a + f_min^a),
        P(f) = NET^2 (1 + (knee / max(f, f_min))^a),

    fitted to ln P, each frequency with the share of ln f that it stands for; of many frequencies,
    means in bins of ln f. The knee is 0 where nothing rises above the white level.

    Raises InputError for a spectrum that is not positive and finite.
    """
    from scipy.optimize import least_squares

    if (
        len(frequency) < 4
        or not np.isfinite(power).all()
        or (power <= 0).any()
        or (np.diff(frequency) <= 0).any()
    ):
        raise InputError(
            "has a spectrum that is not positive and finite", place=place, cure=NOISE_CURE
        )
    x, y = np.log(frequency), np.log(power)
    if len(x) > BINS:
        number = ((x - x[0]) * (BINS / (x[-1] - x[0]))).astype(int)
        first = np.flatnonzero(np.diff(number, prepend=-1))
        count = np.diff(first, append=len(x))
        x, y = np.add.reduceat(x, first) / count, np.log(np.add.reduceat(power, first) / count)
    share = np.sqrt(np.gradient(x))
    white, top = float(np.median(y[x > x[-1] - 1.0])), float(y.max())
    least = float(np.exp(x[0]))
    if top - white < np.log(RISE):
        return np.array([np.exp(white / 2), 0.0, least, 1.0])

    def toast(p: Any) -> Any:
        level, knee, low, slope = p
        return level + np.logaddexp(slope * x, slope * knee) - np.logaddexp(slope * x, slope * low)

    def own(p: Any) -> Any:
        level, knee, low, slope = p
        return level + np.logaddexp(0.0, slope * (knee - np.maximum(x, low)))

    def away(p: Any, form: Any) -> Any:
        return share * (form(p) - y)

    knee = (
        float(x[np.flatnonzero(y - white > np.log(2.0))[-1]])
        if top - white > np.log(2.0)
        else float(x[0])
    )
    limits = [white - 5, x[0] - 20, x[0] - 20, 0.05], [white + 5, x[-1] + 5, x[-1], STEEPEST]
    tried = [
        least_squares(away, np.clip(start, *limits), args=(form,), bounds=limits)
        for form in (toast, own)
        for low in (x[0] - 5.0, x[0] + 1.0)
        for start in ([white, knee, min(low, knee - 0.1), slope] for slope in (1.0, 2.0))
    ]
    level, knee, low, slope = min(tried, key=lambda one: float(one.cost)).x
    if slope * (knee - max(low, x[0])) < np.log(RISE):
        return np.array([np.exp(white / 2), 0.0, least, 1.0])
    return np.array([np.exp(level / 2), np.exp(knee), max(np.exp(low), least), slope])
