"""Tables of detectors from focal planes of other packages: HDF5 of TOAST (`Focalplane.save_hdf5`,
or a whole observation) and TOML of sotodlib and s4sim (`Hardware.dump`).

Both give each detector a quaternion, from the boresight's frame to the detector's. Their NETs are
of the CMB's temperature: they become K_RJ with the mean of `cmb_slope` over the band that the file
states, flat between its edges.

Tables of `zonda noise` have NET, knee and slope by the name of the detector (`read_noise`).
"""

from __future__ import annotations

import tomllib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .errors import InputError
from .numerics.quaternions import directions
from .numerics.radiation import cmb_slope
from .storage.files import first_bytes, reading, unpacked
from .storage.hdf5_files import opened, read_columns
from .storage.table_files import AS_TEXT, LARGEST, Table, read_table
from .types import Floats

HDF5 = b"\x89HDF\r\n\x1a\n"
"""Begins every HDF5 file."""
TOAST = "a focal plane of TOAST"
HARDWARE = "hardware of sotodlib"
TOAST_CURE = "write it with toast: focalplane.save_hdf5(h5py.File(path, 'w'))"
HARDWARE_CURE = "write it with sotodlib: Hardware.dump(path), after detectors were simulated"
UNITS = {
    "fwhm": "rad",
    "net": "K s(1/2)",
    "knee": "Hz",
    "pink_minimum_frequency": "Hz",
    "slope": "",
    "correction": "",
    "centre": "Hz",
    "width": "Hz",
    "polarization_efficiency": "",
    "pol_leakage": "",
    "main_beam_efficiency": "",
    "illumination_efficiency": "",
}
"""Numbers of detectors, and their units here."""
OF_TOAST = {
    "net": "psd_net",
    "knee": "psd_fknee",
    "pink_minimum_frequency": "psd_fmin",
    "slope": "psd_alpha",
    "correction": "net_corr",
    "centre": "bandcenter",
    "width": "bandwidth",
    "polarization_efficiency": "pol_efficiency",
}
"""Names of columns in TOAST, in small letters, where they are not ours."""
OF_HARDWARE = {
    "fwhm": ("fwhm", np.pi / 180 / 60),
    "net": ("NET", 1e-6),
    "knee": ("fknee", 1e-3),
    "pink_minimum_frequency": ("fmin", 1e-3),
    "slope": ("alpha", 1.0),
    "correction": ("NET_corr", 1.0),
    "low": ("low", 1e9),
    "high": ("high", 1e9),
}
"""Keys of a detector, or of its band, in arcmin, uK s(1/2), mHz and GHz."""
STEEPEST = 3.0
"""Largest slope of pink noise."""
NO_ROTATION = 1e-6
"""Difference of a quaternion's square from 1 above which it is no rotation."""


def read_detectors(path: Path) -> tuple[Table, list[str]] | None:
    """The detectors of a file of TOAST or sotodlib, and notes; None: it is neither.

    Raises InputError for a file that cannot be read, and for a detector without a direction or with
    a value that is no number.
    """
    place = str(path)
    with reading(place, "a table", AS_TEXT):
        begin = first_bytes(path, len(HDF5))
    if begin == HDF5:
        return _table(place, _of_toast(path, place))
    return _of_hardware(path, place) if ".toml" in path.suffixes else None


def _of_toast(path: Path, place: str) -> dict[str, Any]:
    """Columns of a focal plane of TOAST, with ``quaternion``."""
    with opened(path, place, TOAST, TOAST_CURE) as file:
        found = read_columns(file.get("instrument", file), "focalplane", place)
        there = {name.lower(): found[name] for name in found.colnames}
        columns: dict[str, Any] = {"name": _texts(there["name"]), "quaternion": there["quat"]}
        for own, unit in UNITS.items():
            theirs = OF_TOAST.get(own, own)
            if theirs in there and not (theirs == "pol_efficiency" and "pol_leakage" in there):
                values = there[theirs]
                columns[own] = values.to_value(unit) if unit else values
        for theirs, own in {"band": "band", "wafer_number": "wafer", "wafer_slot": "wafer"}.items():
            if theirs in there:
                columns[own] = _texts(there[theirs])
        if "tangent_xi" in there:  # a file of zonda, whose NET is in K_RJ
            columns |= {"xi": there["tangent_xi"], "eta": there["tangent_eta"]}
        if "centre" in columns:
            centre, width = (np.array(columns.pop(key), float) for key in ("centre", "width"))
            columns |= {"low": centre - width / 2, "high": centre + width / 2}
            ghz = np.nan_to_num(centre / 1e9).round().astype(int).tolist()
            if "band" not in columns and len(set(ghz)) > 1:
                columns["band"] = [f"f{number:03d}" for number in ghz]
    return columns


def _texts(values: Any) -> list[str]:
    return [str(value) for value in np.asarray(values).tolist()]


def _of_hardware(path: Path, place: str) -> tuple[Table, list[str]]:
    with reading(place, HARDWARE, HARDWARE_CURE):
        found = tomllib.loads(unpacked(path, place, LARGEST).decode())
        if not found.get("detectors"):
            raise KeyError("there are no detectors")
        detectors = dict(found["detectors"])
        bands = dict(found.get("bands", {}))
    columns: dict[str, Any] = {key: [] for key in ("name", "band", "wafer", "quaternion")}
    columns |= {key: [] for key in OF_HARDWARE}
    for name, own in detectors.items():
        with reading(f"{place}, detector {name}", HARDWARE, HARDWARE_CURE):
            stated = {**bands.get(own["band"], {}), **own}
            x, y, z, w = (float(value) for value in own["quat"])
            numbers = [float(stated.get(key, np.nan)) for key, _ in OF_HARDWARE.values()]
        wafer = own.get("wafer_slot", own.get("wafer", ""))
        row = [name, str(own["band"]), str(wafer), (x, y, z, w), *numbers]
        for column, value in zip(columns.values(), row, strict=True):
            column.append(value)
    for key, (_, unit) in OF_HARDWARE.items():
        columns[key] = np.array(columns[key]) * unit
        if np.isnan(columns[key]).all():
            del columns[key]
    return _table(place, columns)


def _table(place: str, columns: dict[str, Any]) -> tuple[Table, list[str]]:
    """The table of what was read: places and angles of the quaternions, NETs in K_RJ."""
    notes = list[str]()
    texts = {key: columns.pop(key) for key in ("name", "band", "wafer") if key in columns}
    names = texts["name"]
    with reading(place, "a focal plane", "write it again"):
        numbers = {key: np.array(values, np.float64) for key, values in columns.items()}
    shapes = dict.fromkeys(numbers, (len(names),)) | {"quaternion": (len(names), 4)}
    wrong = [key for key, values in numbers.items() if values.shape != shapes[key]]
    if wrong:
        text = f"does not fit together: {', '.join(wrong)} for {len(names)} detectors"
        raise InputError(text, place=place, cure="write it again")
    if "low" in numbers:
        sees = np.isfinite(numbers["low"]) & np.isfinite(numbers["high"])
        numbers = {key: values[sees] for key, values in numbers.items()}
        rows = np.flatnonzero(sees).tolist()
        if dark := len(names) - len(rows):
            notes.append(f"dark detectors, without a band, are left out: {dark}")
            texts = {key: [values[row] for row in rows] for key, values in texts.items()}
    _check(place, texts["name"], numbers)
    begins = {band.partition("_")[:2] for band in texts.get("band", [])}
    if len(begins) == 1 and (begin := "".join(begins.pop())).endswith("_"):
        texts["band"] = [band.removeprefix(begin) for band in texts["band"]]
        notes.append(f"bands are called without {begin}")
    q = numbers.pop("quaternion")
    x, y, z = directions(q).T
    found: dict[str, Any] = {"xi": -y / z, "eta": -x / z}
    found["polarization_angle"] = 2 * np.arctan2(q[:, 2], q[:, 3]) % (2 * np.pi)
    if "net" in numbers:
        _convert_net(numbers, notes)
    if "slope" in numbers:
        if (numbers["slope"] > STEEPEST).any():
            notes.append(f"slopes above {STEEPEST:g} are taken as {STEEPEST:g}")
        white = numbers.get("knee", np.ones(1)) == 0  # TOAST's have slope 0, too
        numbers["slope"] = np.where(white, 1.0, np.minimum(numbers["slope"], STEEPEST))
    if "pink_minimum_frequency" in numbers:
        numbers["pink_minimum_frequency"] = np.maximum(numbers["pink_minimum_frequency"], 1e-9)
    found |= {key: v for key, v in numbers.items() if key not in ("low", "high", "correction")}
    units = {"xi": "rad", "eta": "rad", "polarization_angle": "rad"} | UNITS
    table = {key: (values, units.get(key, "")) for key, values in (texts | found).items()}
    return Table(place, table, [0] * (len(texts["name"]) + 1)), notes


def _check(place: str, names: list[str], numbers: Mapping[str, Any]) -> None:
    """Raise InputError for no detectors, a value that is no number, or a quaternion that is no
    rotation of less than 90 deg.
    """
    cure = "mend the detector, or leave it out"
    if not names:
        raise InputError("has no detectors that see the sky", place=place, cure="write it again")
    for key, values in numbers.items():
        known = np.isfinite(values.reshape(len(names), -1)).all(axis=1)
        for row in np.flatnonzero(~known)[:1]:
            raise InputError(f"{key} of detector {names[row]} is no number", place=place, cure=cure)
    q = numbers["quaternion"]
    bad = (np.abs(np.sum(q**2, axis=1) - 1) > NO_ROTATION) | (directions(q)[:, 2] <= 0)
    for row in np.flatnonzero(bad)[:1]:
        text = f"the quaternion of detector {names[row]}, {q[row].tolist()}, is no rotation by less"
        raise InputError(f"{text} than 90 deg", place=place, cure=cure)


def _convert_net(numbers: dict[str, Any], notes: list[str]) -> None:
    """Turn NETs from the CMB's temperature into K_RJ, those of a file of zonda excepted; without a
    band there are none.

    The correction for noise that detectors share is applied: noise here is independent, and maps
    get the depth that the file's authors expect.
    """
    if "xi" in numbers:
        return
    if "low" not in numbers:
        del numbers["net"]
        notes.append("NETs are not used: without a band they cannot be turned into K_RJ")
        return
    x, weight = np.polynomial.legendre.leggauss(16)
    low = numbers["low"][:, None]
    high = numbers["high"][:, None]
    slope = cmb_slope(low + (high - low) * (1 + x) / 2) @ weight / 2
    numbers["net"] = numbers["net"] * slope * numbers.get("correction", 1.0)
    by = ", times NET_corr," if "correction" in numbers else ""
    notes.append(f"NETs{by} are turned from K_CMB into K_RJ over the band of each detector")


@dataclass(frozen=True)
class NoiseTable:
    """NET [K_RJ sqrt(s)], knee [Hz] and slope by detector."""

    path: Path
    names: dict[str, int]
    columns: dict[str, Floats]

    def of(self, detectors: list[str], place: str) -> dict[str, Floats]:
        """The columns for these detectors. Raises InputError where one is not in the table."""
        if lacking := [name for name in detectors if name not in self.names]:
            text = (
                f"{len(lacking)} of {len(detectors)} detectors are not in {self.path}, e.g."
                f" {lacking[0]}"
            )
            cure = (
                "make the table of this file: zonda noise FILE; flag detectors that it finds no"
                " noise of"
            )
            raise InputError(text, place=place, cure=cure)
        rows = np.array([self.names[name] for name in detectors], np.intp)
        return {name: values[rows] for name, values in self.columns.items()}


def read_noise(path: Path) -> NoiseTable:
    """Read a table. Raises InputError where it is none, lacks a column, or has a value that cannot
    be.
    """
    try:
        return _read(path)
    except InputError as err:
        err.cure += "\nor make the table anew: zonda noise FILE"
        raise


def _read(path: Path) -> NoiseTable:
    table = read_table(path, f"noise table {path}")
    names = table.texts("name")
    columns = {}
    for name, otherwise in (("net", np.nan), ("knee", 0.0), ("slope", 1.0)):
        if any(table.texts(name)):
            unit = UNITS[name]
            values = table.values(name) * table.factor(name, unit, unit)
            wrong = ~np.isfinite(values) | (values < 0)
            columns[name] = np.where(wrong, otherwise, values)  # without 1/f noise it has neither
    net = columns.get("net", np.zeros(len(table)))
    cure = "leave the detector out of the pipeline's file, or give it a number"
    table.note_rows(
        np.isnan(net),
        lambda row: f"net of detector {names[row]} is {table.texts('net')[row]}",
        cure,
    )
    if len(set(names)) < len(names):
        twice = next(name for name, number in Counter(names).items() if number > 1)
        table.note(None, f"detector {twice!r} is there twice", "leave one of the rows out")
    table.check()
    return NoiseTable(path, {name: row for row, name in enumerate(names)}, columns)
