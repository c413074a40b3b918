"""TOAST 3's HDF5 observation file, layout version 2, written and read with h5py alone: streams in
rectangles, all else at once.

What TOAST requires of a file is in its `toast.io.observation_hdf_utils`; sotodlib's
``load_toast_h5_file`` reads the same file. TOAST wants float64 signals, and an uncompressed
``detdata/signal``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from zonda.core.configuration.time import Instant
from zonda.core.configuration.units import Unit
from zonda.core.errors import InputError
from zonda.core.flags import INVALID, Flags
from zonda.core.storage.files import AnyPath, reading, writing
from zonda.core.storage.hdf5_files import Disk, check_size, checked, read_columns
from zonda.core.stream import UNITS
from zonda.core.types import AnyFloats, Floats, Indices
from zonda.core.weather import GroundWeather

from .time_ordered_data import OF_SAMPLES, TimeOrderedData, TodWriter
from .toast_noise import DEFAULT_MODEL, columns_of_model, models

SUFFIX = ".h5"

FLAGS_ARE = "zonda_flags"
"""Attribute of ``metadata/other`` in files whose flags have TOAST's bits; an earlier zonda wrote
none.
"""

COLUMNS = {  # ours: (TOAST's name, TOAST's unit, SI unit)
    "fwhm": ("fwhm", "arcmin", "rad"),
    "polarization_angle": ("gamma", "rad", "rad"),
    "polarization_efficiency": ("polarization_efficiency", "", ""),
    "band_centre": ("bandcenter", "GHz", "Hz"),
    "band_width": ("bandwidth", "GHz", "Hz"),
    "net": ("psd_net", "K s(1/2)", "K s(1/2)"),
    "knee": ("psd_fknee", "Hz", "Hz"),
    "minimum_frequency": ("psd_fmin", "Hz", "Hz"),
    "slope": ("psd_alpha", "", ""),
    "main_beam_efficiency": ("main_beam_efficiency", "", ""),
    "illumination_efficiency": ("illumination_efficiency", "", ""),
    "wafer": ("wafer_number", "", ""),
}

OFFSETS = ("tangent_xi", "tangent_eta")
"""Columns of the focal plane: `Focalplane.xi` and `Focalplane.eta`, which quaternions hold to
rounding.
"""


def name_uid(name: str) -> int:
    """TOAST's number of a name (toast.utils.name_UID)."""
    return int.from_bytes(hashlib.md5(name.encode()).digest(), "little") & 0x7FFFFFFF


class Writer(TodWriter):
    """Writes one observation, streams in rectangles and in any order. Not thread-safe: guard it.

    Parameters
    ----------
    path
        File to create.
    tod
        Everything but the streams.
    streams
        Their names; `signal` is what TOAST expects.
    dtype
        Type of the streams.
    """

    def __init__(self, path: Path, tod: TimeOrderedData, streams: list[str], dtype: str) -> None:
        import h5py

        super().__init__(path, tod)
        with writing(path):
            self._disk = Disk(path)
            self._file = h5py.File(self._disk, "w")
        group = self._file.create_group("detdata")
        for name in streams:
            data = group.create_dataset(name, (tod.n_detectors, tod.n_samples), dtype)
            data.attrs["units"] = UNITS.get(name, "K")

    def write(self, stream: str, detectors: slice, samples: slice, values: AnyFloats) -> None:
        """A rectangle of a stream."""
        with writing(self.path):
            self._file["detdata"][stream][detectors, samples] = values
            if not np.isfinite(
                np.sum(values)
            ):  # what is no number in one stream is not to be used in any
                self._flags()[detectors, samples] |= np.where(
                    np.isfinite(values),
                    np.uint8(0),
                    np.uint8(INVALID),
                )
            self._disk.check()

    def _flags(self) -> Any:
        """The flags of the detectors' samples; made where they are not there yet."""
        group = self._file["detdata"]
        if "flags" not in group:
            made = group.create_dataset("flags", (self.tod.n_detectors, self.tod.n_samples), "u1")
            made.attrs["units"] = ""
        return group["flags"]

    def _finish(self) -> None:
        self._disk.check()
        _write_root(self._file, self.tod)
        _write_instrument(self._file.create_group("instrument"), self.tod)
        _write_metadata(self._file, self.tod)
        _write_shared(self._file, self.tod)
        flags = self._flags()
        for d in np.flatnonzero(self.tod.detector_flags).tolist():
            flags[d] |= self.tod.detector_flags[d]  # rows never written are zeros, without room

    def _close(self) -> None:
        self._file.close()
        self._disk.close()


def _write_root(file: Any, tod: TimeOrderedData) -> None:
    file.attrs.update(
        toast_format_version=2,
        observation_name=tod.name,
        observation_uid=name_uid(tod.name),
        observation_samples=tod.n_samples,
        observation_detector_sets="NONE",
        observation_sample_sets="NONE",
    )
    _long_attribute(file, "observation_detectors", json.dumps(tod.names))
    flags = dict(zip(tod.names, tod.detector_flags.tolist(), strict=True))
    _long_attribute(file, "observation_detector_flags", json.dumps(flags))


def _long_attribute(group: Any, name: str, text: str) -> None:
    """An attribute beyond HDF5's 64 KiB for compact ones (a few thousand detectors) as a
    variable-length string.
    """
    import h5py

    group.attrs.create(name, text, dtype=h5py.string_dtype())


def session_of(tod: TimeOrderedData) -> str:
    """The name of the session, which bands of one scan have in common: that of the scan."""
    return tod.name.removesuffix(f"-{tod.metadata.get('band', '')}")


def _write_instrument(group: Any, tod: TimeOrderedData) -> None:
    from astropy.io.misc.hdf5 import write_table_hdf5

    site, latitude, longitude, altitude = tod.site
    group.attrs.update(
        toast_format_version=2,
        telescope_class="toast.instrument.Telescope",
        telescope_name=tod.telescope,
        telescope_uid=name_uid(tod.telescope),
        focalplane_class="toast.instrument.Focalplane",
        site_class="toast.instrument.GroundSite",
        site_name=site,
        site_uid=name_uid(site),
        site_lat_deg=float(np.degrees(latitude)),
        site_lon_deg=float(np.degrees(longitude)),
        site_alt_m=float(altitude),
        session_class="toast.instrument.Session",
        session_name=session_of(tod),
        session_uid=name_uid(session_of(tod)),
        session_start=float(tod.times[0]),
        session_end=float(tod.times[-1]),
    )
    if tod.weather is not None:
        _write_weather(group, tod.weather)
    table = detectors_table(tod)
    for name in ("name", "pixel"):
        table[name] = np.asarray(table[name]).astype("S")
    write_table_hdf5(table, group, path="focalplane", serialize_meta=True)


def detectors_table(tod: TimeOrderedData) -> Any:
    """The detectors as TOAST's `Focalplane` takes them: a QTable."""
    import astropy.units as u
    from astropy.table import QTable

    table = QTable()
    table["name"] = np.array(tod.names)
    table["quat"] = tod.quats
    for ours, values in tod.columns.items():
        theirs, unit, si = COLUMNS[ours]
        table[theirs] = u.Quantity(values, si).to(unit) if unit else values
    if "polarization_angle" in tod.columns:
        table["psi_pol"] = table["gamma"]
        efficiency = tod.columns.get("polarization_efficiency", np.ones(tod.n_detectors))
        table["pol_leakage"] = (1 - efficiency) / (1 + efficiency)  # TOAST's epsilon
    for name, values in zip(OFFSETS, (tod.xi, tod.eta), strict=True):
        table[name] = values
    table["pixel"] = table["name"]
    table["uid"] = np.array([name_uid(d) for d in tod.names], np.uint32)
    table.meta["sample_rate"] = tod.sample_rate * u.Hz
    table.meta["field_of_view"] = u.Quantity(tod.field_of_view, u.rad).to(u.deg)
    return table


WEATHER = {  # ours: (TOAST's name, unit)
    "pwv": ("pwv", "m"),
    "humidity": ("humidity", ""),
    "pressure": ("surface_pressure", "Pa"),
    "ground_temperature": ("surface_temperature", "K"),
    "temperature": ("air_temperature", "K"),
    "wind_east": ("west_wind", "m / s"),
    "wind_north": ("south_wind", "m / s"),
}


def _write_weather(group: Any, weather: GroundWeather) -> None:
    """Write what `toast.weather.Weather` reads: west wind blows towards east, clouds are absent."""
    group.attrs["weather_class"] = "toast.weather.Weather"
    group.attrs["weather_time"] = weather.time
    for name in ("ice_water", "liquid_water"):
        group.attrs[f"weather_{name}"] = "0.0 mm"
    for ours, (theirs, unit) in WEATHER.items():
        value, text = (weather.pwv * 1e3, "mm") if ours == "pwv" else (getattr(weather, ours), unit)
        group.attrs[f"weather_{theirs}"] = f"{value!r} {text}".rstrip()


def _write_metadata(file: Any, tod: TimeOrderedData) -> None:
    metadata = file.create_group("metadata")
    other = metadata.create_group("other")
    other.attrs["python_data_type"] = "dict"
    other.attrs["zonda_start_utc"] = tod.start
    other.attrs[FLAGS_ARE] = "TOAST's"
    for key, value in tod.metadata.items():
        other.attrs[f"zonda_{key}"] = value
    file.create_group("attr")
    if (noise := nominal_noise(tod)) is not None:
        _write_noise(metadata.create_group("noise_model"), tod, *noise)


def nominal_noise(tod: TimeOrderedData) -> tuple[AnyFloats, AnyFloats] | None:
    """Frequencies (n,) [Hz] and densities (n_det, n) [K^2 s] of the nominal noise; None: the
    detectors state none.

    In TOAST's two-sided convention: NET^2 (1 + (knee / max(f, f_min))^slope).
    """
    c = tod.columns
    rate = tod.sample_rate
    if not {"net", "knee", "slope", "minimum_frequency"} <= set(c) or not (c["net"] > 0).all():
        return None
    lowest = min(1e-5, rate / max(2 * tod.n_samples, 1))
    frequency = np.geomspace(lowest, rate / 2, 100)
    f = np.maximum(frequency, c["minimum_frequency"][:, None])
    return frequency, c["net"][:, None] ** 2 * (1 + (c["knee"][:, None] / f) ** c["slope"][:, None])


def _write_noise(group: Any, tod: TimeOrderedData, frequency: AnyFloats, psd: AnyFloats) -> None:
    c = tod.columns
    rate = tod.sample_rate
    names = [d.encode() for d in tod.names]
    width = max(len(d) for d in names) + 1
    group.attrs["class"] = "toast.noise.Noise"
    group.attrs["psd_units"] = "K2 s"
    weights = list(zip(names, 1 / (c["net"] ** 2 * rate), strict=True))
    group.create_dataset("detector_weights", data=np.array(weights, f"S{width}, f4")).attrs[
        "unit"
    ] = "1 / K2"
    group.create_dataset(
        "mixing_matrix",
        data=np.array([(d, d, 1.0) for d in names], f"S{width}, S{width}, f4"),
    )
    group.create_dataset("psds", data=np.vstack([frequency, psd]).astype("f4"))
    group.create_dataset("psds_indices", data=np.array([name_uid(d) for d in tod.names], np.uint32))
    group.create_dataset("psds_keys", data=np.array(names, f"S{width}"))


def _write_shared(file: Any, tod: TimeOrderedData) -> None:
    group = file.create_group("shared")
    for name, values in tod.of_samples().items():
        group.create_dataset(name, data=values).attrs["comm_type"] = "column"
    intervals = file.create_group("intervals")
    intervals.attrs["times"] = "times"
    for name, spans in tod.intervals.items():
        at = np.searchsorted(tod.seconds, np.reshape(spans, (-1, 2)).T)
        intervals.create_dataset(
            name,
            data=tod.times[np.minimum(at, tod.n_samples - 1)],
        )  # to the last bit those of samples


# --------------------------------------------------------------------------------------------------
# reading

AGAIN = "save it again with TOAST 3.0 or later, or with SaveTOD"

PARTS = {
    "instrument": "no instrument",
    "instrument/focalplane": "no focal plane",
    "shared": "no pointing",
    "shared/times": "no times of the samples",
    "detdata": "no data of detectors",
}
"""What must be there, and what to say where it is not."""


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

    kind: ClassVar[str] = "HDF5 in TOAST's layout"
    cure: ClassVar[str] = "give an HDF5 file in TOAST's layout, whole, as SaveTOD writes it"

    def __init__(self, path: AnyPath) -> None:
        self.place = f"time-ordered data {path}"
        with self._reading():
            self._file = checked(path, self.place)
        try:
            with self._reading():
                self.tod, self._data = self._opened()
                self.streams = self._streams()
                self.tod.check(self.place)
        except BaseException:
            self.close()
            raise

    def _reading(self) -> AbstractContextManager[None]:
        return reading(self.place, self.kind, self.cure)

    def _opened(self) -> tuple[TimeOrderedData, Any]:
        """Everything but the streams, and the group with the streams."""
        _check_parts(self._file, self.place)
        return _read(self._file, self.place), self._file["detdata"]

    def read(self, stream: str, detectors: Indices, samples: slice) -> AnyFloats:
        """(n, m) values of a stream: rows ``detectors`` (n,) of the file, in its own units and
        type.
        """
        with self._reading():
            found: AnyFloats = _rectangle(self._data[stream], detectors, samples)
            return found

    def flags(self, detectors: Indices, samples: slice) -> Flags | None:
        """(n, m) uint8, flags of each sample of each detector; None: the file has none."""
        found = self._data.get("flags")
        if found is None:
            return None
        with self._reading():
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
                f"has no noise model {model!r} (/metadata)",
                place=self.place,
                cure=cure,
            )
        with self._reading():
            group = self._file["metadata"][model or DEFAULT_MODEL]
            unused = (self.tod.detector_flags & np.uint8(mask)) != 0
            return columns_of_model(group, self.tod.names, unused, self.place)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _streams(self) -> dict[str, str]:
        """Names and units; their shapes are checked."""
        found = {}
        for name, item in self._data.items():
            self._check_stream(item)
            if name != "flags":
                found[name] = str(item.attrs.get("units", "K"))
        return found

    def _check_stream(self, item: Any) -> None:
        """Raise InputError for a data set, or a group with parts of one, of another shape or of no
        numbers.
        """
        import h5py

        shape = self.tod.n_detectors, self.tod.n_samples
        for dataset in [item] if isinstance(item, h5py.Dataset) else item.values():
            if isinstance(dataset, h5py.Dataset):
                check_size(dataset, self.place, whole=False)
        if isinstance(item, h5py.Dataset) and (item.shape != shape or item.dtype.kind not in "fiu"):
            what = f"{item.name.lstrip('/')} is {' x '.join(map(str, item.shape))} of {item.dtype}"
            raise InputError(
                f"{what}, not {shape[0]} x {shape[1]} numbers",
                place=self.place,
                cure=AGAIN,
            )


def _check_parts(file: Any, place: str) -> None:
    version = file.attrs.get("toast_format_version")
    if version != 2:
        raise InputError(f"toast_format_version is {version}, not 2", place=place, cure=AGAIN)
    for part, what in PARTS.items():
        if part not in file:
            raise KeyError(f"there is {what} (/{part})")
    for name, item in file["shared"].items():
        if name in OF_SAMPLES and (not hasattr(item, "dtype") or item.dtype.kind not in "fiu"):
            text = f"shared/{name} holds no numbers ({getattr(item, 'dtype', 'a group')})"
            raise InputError(text, place=place, cure=AGAIN)
    if not {"boresight_azel", "boresight_radec"} & set(file["shared"]):
        raise KeyError("there is no pointing (shared/boresight_azel, shared/boresight_radec)")


def _rectangle(item: Any, rows: Indices, samples: slice) -> Any:
    """Rows and samples of a data set, or of a group that holds a FLAC-compressed one."""
    import h5py

    first = int(rows[0])
    last = int(rows[-1]) + 1
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
            f"{item.name} is compressed with FLAC",
            cure="pip install flacarray",
        ) from None  # the extra flac
    keep = np.zeros(int(item["stream_starts"].shape[0]), bool)
    keep[rows] = True
    found = np.asarray(read_array(item, keep=keep, stream_slice=samples)).reshape(len(rows), -1)
    return found.astype(np.dtype(str(item.attrs["dtype"]))) if "dtype" in item.attrs else found


def _read(file: Any, place: str) -> TimeOrderedData:
    """Read everything but the streams."""
    import astropy.units as u

    instrument = file["instrument"]
    shared = file["shared"]
    spans = file.get("intervals", {})
    for dataset in (*shared.values(), *spans.values()):
        check_size(dataset, place)
    names = [str(d) for d in json.loads(file.attrs["observation_detectors"])]
    table, rows = _focalplane(instrument, names, place)
    given = {name: shared[name][:] for name in OF_SAMPLES if name in shared}
    given.pop("elevation", None)
    times = given["times"]
    seconds = given.setdefault("seconds", times - times[0])
    given["flags"] = np.asarray(given.get("flags", np.zeros(len(times))), np.uint8)
    other: Mapping[str, Any] = file["metadata/other"].attrs if "metadata/other" in file else {}
    start = other.get("zonda_start_utc")
    if start is None:
        start = Instant(round(float(times[0]) * 1e9)).isoformat()
    kept = (k for k in other if k.startswith("zonda_") and k not in ("zonda_start_utc", FLAGS_ARE))
    own = {k.removeprefix("zonda_"): other[k] for k in kept}
    of_detectors = json.loads(file.attrs["observation_detector_flags"])
    a = instrument.attrs
    tod = TimeOrderedData(
        name=str(file.attrs["observation_name"]),
        start=str(start),
        sample_rate=float(table.meta["sample_rate"].to_value(u.Hz)),
        telescope=str(a["telescope_name"]),
        field_of_view=float(table.meta["field_of_view"].to_value(u.rad)),
        site=(
            str(a["site_name"]),
            float(np.radians(a["site_lat_deg"])),
            float(np.radians(a["site_lon_deg"])),
            float(a["site_alt_m"]),
        ),
        detector_flags=np.array([of_detectors[d] for d in names], np.uint8),
        names=names,
        quats=np.asarray(table["quat"][rows], np.float64),
        columns=columns_of(table, rows),
        intervals={name: _in_seconds(found[:], times, seconds) for name, found in spans.items()},
        weather=_weather(a),
        metadata={k: v.item() if isinstance(v, np.generic) else v for k, v in own.items()},
        offsets=offsets_of(table, rows),
        **given,
    )
    if "zonda_start_utc" in other and FLAGS_ARE not in other:
        tod.update_flags()
    return tod


def _in_seconds(spans: Any, times: AnyFloats, seconds: AnyFloats) -> list[tuple[float, float]]:
    start, stop = np.interp(np.asarray(spans, np.float64), times, seconds)
    return list(zip(start.tolist(), stop.tolist(), strict=True))


def columns_of(table: Any, rows: Indices) -> dict[str, Floats]:
    """`TimeOrderedData.columns` of these rows of TOAST's table of detectors."""
    import astropy.units as u

    columns = {}
    for ours, (theirs, unit, si) in COLUMNS.items():
        if theirs in table.colnames:
            values = table[theirs][rows]
            columns[ours] = np.array(
                u.Quantity(values, unit).to_value(si) if unit else values,
                np.float64,
            )
    if "pol_leakage" in table.colnames:
        epsilon = np.asarray(table["pol_leakage"][rows], np.float64)
        columns.setdefault("polarization_efficiency", (1 - epsilon) / (1 + epsilon))
    elif "polarization_angle" in columns:  # as TOAST's StokesWeights, whose epsilon is 0 then
        columns.setdefault("polarization_efficiency", np.ones(len(rows)))
    return columns


def offsets_of(table: Any, rows: Indices) -> Floats | None:
    """`TimeOrderedData.offsets` of these rows of TOAST's table of detectors."""
    return (
        np.array([table[k][rows] for k in OFFSETS]).T if {*OFFSETS} <= set(table.colnames) else None
    )


def _focalplane(instrument: Any, names: list[str], place: str) -> tuple[Any, Indices]:
    """The table of detectors, and the rows of those that have data."""
    table = read_columns(instrument, "focalplane", place)
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


def _weather(attributes: Any) -> GroundWeather | None:
    """None where there is none, or one that states no numbers (TOAST's simulated weather names its
    distribution alone).
    """
    if not {"weather_time", *(f"weather_{theirs}" for theirs, _ in WEATHER.values())} <= set(
        attributes
    ):
        return None
    stated = {
        ours: Unit(unit).parse(str(attributes[f"weather_{theirs}"]))
        for ours, (theirs, unit) in WEATHER.items()
    }
    return GroundWeather(time=float(attributes["weather_time"]), **stated)
