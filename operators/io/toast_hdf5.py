"""TOAST 3's HDF5 observation file, layout version 2, written with h5py alone (`toast_reading` reads
it).

What TOAST requires of a file is in its `toast.io.observation_hdf_utils`; sotodlib's
``load_toast_h5_file`` reads the same file. TOAST wants float64 signals, and an uncompressed
``detdata/signal``.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from zonda.core.flags import INVALID
from zonda.core.numerics.quaternions import directions
from zonda.core.numerics.sphere import angles
from zonda.core.storage.files import writing
from zonda.core.storage.hdf5_files import Disk
from zonda.core.stream_names import UNITS
from zonda.core.types import AnyFloats
from zonda.core.weather import GroundWeather

from .time_ordered_data import TimeOrderedData

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


class Writer:
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

        self.path, self._tod = path, tod
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
                    np.isfinite(values), np.uint8(0), np.uint8(INVALID)
                )
            self._disk.check()

    def _flags(self) -> Any:
        """The flags of the detectors' samples; made where they are not there yet."""
        group = self._file["detdata"]
        if "flags" not in group:
            group.create_dataset("flags", (self._tod.n_detectors, self._tod.n_samples), "u1").attrs[
                "units"
            ] = ""
        return group["flags"]

    def finish(self) -> None:
        """Write everything else and close the file."""
        with writing(self.path):
            try:
                self._disk.check()
                _write_root(self._file, self._tod)
                _write_instrument(self._file.create_group("instrument"), self._tod)
                _write_metadata(self._file, self._tod)
                _write_shared(self._file, self._tod)
                flags = self._flags()
                for d in np.flatnonzero(
                    self._tod.detector_flags
                ):  # rows never written are zeros and take no room
                    flags[int(d)] |= self._tod.detector_flags[d]
            finally:
                self._file.close()
                self._disk.close()

    def close(self) -> None:
        """Close an unfinished file."""
        with contextlib.suppress(OSError):  # nothing is lost: the caller removes the file
            self._file.close()
            self._disk.close()


def _write_root(file: Any, tod: TimeOrderedData) -> None:
    file.attrs["toast_format_version"] = 2
    file.attrs["observation_name"] = tod.name
    file.attrs["observation_uid"] = name_uid(tod.name)
    file.attrs["observation_samples"] = tod.n_samples
    file.attrs["observation_detector_sets"] = "NONE"
    file.attrs["observation_sample_sets"] = "NONE"
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
    c, rate = tod.columns, tod.sample_rate
    if not {"net", "knee", "slope", "minimum_frequency"} <= set(c) or not (c["net"] > 0).all():
        return None
    lowest = min(1e-5, rate / max(2 * tod.n_samples, 1))
    frequency = np.geomspace(lowest, rate / 2, 100)
    f = np.maximum(frequency, c["minimum_frequency"][:, None])
    return frequency, c["net"][:, None] ** 2 * (1 + (c["knee"][:, None] / f) ** c["slope"][:, None])


def _write_noise(group: Any, tod: TimeOrderedData, frequency: AnyFloats, psd: AnyFloats) -> None:
    c, rate = tod.columns, tod.sample_rate
    names = [d.encode() for d in tod.names]
    width = max(len(d) for d in names) + 1
    group.attrs["class"] = "toast.noise.Noise"
    group.attrs["psd_units"] = "K2 s"
    weights = list(zip(names, 1 / (c["net"] ** 2 * rate), strict=True))
    group.create_dataset("detector_weights", data=np.array(weights, f"S{width}, f4")).attrs[
        "unit"
    ] = "1 / K2"
    group.create_dataset(
        "mixing_matrix", data=np.array([(d, d, 1.0) for d in names], f"S{width}, S{width}, f4")
    )
    group.create_dataset("psds", data=np.vstack([frequency, psd]).astype("f4"))
    group.create_dataset("psds_indices", data=np.array([name_uid(d) for d in tod.names], np.uint32))
    group.create_dataset("psds_keys", data=np.array(names, f"S{width}"))


def _write_shared(file: Any, tod: TimeOrderedData) -> None:
    azimuth, elevation = tod_azimuth_elevation(tod)
    shared = {
        "times": tod.times,
        "seconds": tod.seconds,
        "azimuth": azimuth,
        "elevation": elevation,
        "boresight_azel": tod.boresight_azel,
        "boresight_radec": tod.boresight_radec,
        "flags": tod.flags,
        **({} if tod.hwp_angle is None else {"hwp_angle": tod.hwp_angle}),
    }
    group = file.create_group("shared")
    for name, values in shared.items():
        group.create_dataset(name, data=values).attrs["comm_type"] = "column"
    intervals = file.create_group("intervals")
    intervals.attrs["times"] = "times"
    for name, spans in tod.intervals.items():
        at = np.searchsorted(tod.seconds, np.reshape(spans, (-1, 2)).T)
        intervals.create_dataset(
            name, data=tod.times[np.minimum(at, tod.n_samples - 1)]
        )  # to the last bit those of samples


def tod_azimuth_elevation(tod: TimeOrderedData) -> tuple[AnyFloats, AnyFloats]:
    """Azimuth, as recorded where it is, and elevation of a scan, rad."""
    longitude, elevation = angles(directions(tod.boresight_azel))
    return -longitude % (2 * np.pi) if tod.azimuth is None else tod.azimuth, elevation
