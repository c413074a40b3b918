"""Recorded data of the Simons Observatory: HDF5 of sotodlib's `AxisManager.save`, read with h5py
alone, streams in rectangles.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from zonda.core.configuration.time import Instant
from zonda.core.configuration.units import factor_to
from zonda.core.errors import InputError
from zonda.core.flags import (
    INVALID,
    IRREGULAR,
    PROCESSING,
    SOLAR_SYSTEM_OBJECT,
    SUN_CLOSE,
    SUN_UP,
    TURNAROUND,
    Flags,
    intervals_of,
)
from zonda.core.numerics.quaternions import detector_quaternions, from_angles, multiply
from zonda.core.storage.files import AnyPath
from zonda.core.storage.hdf5_files import check_size
from zonda.core.types import Bools, Floats, Indices, Integers

from . import toast_hdf5
from .time_ordered_data import TimeOrderedData

SCHEMA = "_axisman"
"""Attribute of a group that holds an AxisManager."""
AXES = ["dets", "samps"]
"""Axes of streams."""
STREAMS = ("ndarray", "quantity", "flacarray")
"""How streams may be written."""
SAMPLES = {
    "turnarounds": TURNAROUND,
    "invalid": INVALID,
    "processing": PROCESSING,
    "irregular": IRREGULAR,
    "sun_up": SUN_UP,
    "sun_close": SUN_CLOSE,
}
"""Bits of the flags of samples by name; any other flag is `INVALID`."""
SOURCES = ("source_flags", "source_moon")
"""Flags of samples that see a source: `SOLAR_SYSTEM_OBJECT`."""
SCANS = {"left_scan": "rightleft", "right_scan": "leftright"}
"""Flags that are intervals here, with the ends of their names; left is towards smaller azimuth."""
UNION = "excluded"
"""Flag of `to_axismanager`: the union of its others."""
SITES = {
    "lat": (-22.960963888888887, -67.78768888888888),
    "sat1": (-22.960105555555554, -67.78836388888888),
    "sat2": (-22.96009722222222, -67.78813333333333),
    "sat3": (-22.959991666666667, -67.787925),
}
"""Latitude and longitude [deg] of the telescopes of the Simons Observatory, as in so3g."""
ALTITUDE = 5188.0
"""m, of all of them."""
BAND = re.compile(r"(?:.*_)?f?(\d+(?:\.\d+)?) ?(?:ghz)?", re.IGNORECASE)
"""Names of bands with their centre: f150, so_145ghz, 150 GHz."""


def holds_axismanager(path: AnyPath) -> bool:
    """True for an HDF5 file with an AxisManager at its root, or in its first group."""
    import h5py

    try:
        with h5py.File(path, "r") as file:
            return SCHEMA in _root(file).attrs
    except Exception:  # a damaged file: TOAST's reader reports it
        return False


def _root(file: Any) -> Any:
    """The group with the AxisManager, if there is one."""
    return file if SCHEMA in file.attrs else file[next(iter(file))]


@dataclass(frozen=True)
class Flag:
    """A flag of samples of single detectors.

    Attributes
    ----------
    spans
        (n, 2) samples at which it begins and ends, one detector after the other.
    ends
        (n_det,) end of each detector's spans; None: they are those of all detectors.
    bit
        Of `core.flags`.
    common
        (n_samp,) samples of all detectors, which the flags of samples have.
    """

    spans: Integers
    ends: Integers | None
    bit: int = INVALID
    common: Bools = field(default_factory=lambda: np.zeros(0, bool))


class Reader(toast_hdf5.Reader):
    """An open file with an AxisManager, as `toast_hdf5.Reader`.

    There must be ``timestamps``, ``boresight`` (az, el, roll) and ``focal_plane`` (xi, eta, gamma);
    streams are the fields of detectors and samples, in the unit of a Quantity or in none. The site
    is what `to_axismanager` wrote into ``obs_info``, or that of the telescope of the Simons
    Observatory that is named there. Detectors without a place or a band are flagged.
    """

    kind = "an AxisManager of sotodlib"
    cure = "write it again with sotodlib: aman.save(path)"

    def _opened(self) -> tuple[TimeOrderedData, Any]:
        group = _root(self._file)
        aman = Fields(group, self.place)
        names = [str(name) for name in aman.axis("dets")]
        n = int(aman.axis("samps"))
        times = aman.numbers("timestamps", n)
        if n < 2 or not (interval := float(np.median(np.diff(times)))) > 0:
            raise ValueError("its timestamps do not increase")
        xi, eta, gamma = aman.angles("focal_plane", ("xi", "eta", "gamma"), len(names))
        known = np.isfinite(gamma) & (np.hypot(xi, eta) < 1)
        xi, eta, gamma = (np.where(known, angle, 0.0) for angle in (xi, eta, gamma))
        cosine = np.sqrt(1 - xi**2 - eta**2)  # theirs are sines
        xi = xi / cosine
        eta = eta / cosine
        columns = {"polarization_angle": gamma, "polarization_efficiency": np.ones(len(names))}
        info = aman.child("det_info")
        if (centre := _centres(info, len(names))) is not None:
            sees = np.isfinite(centre)
            columns["band_centre"] = np.where(sees, centre, centre[sees][0])
            known &= sees
        if (slots := info.texts("wafer_slot", len(names))) is not None:
            columns["wafer"] = np.unique(slots, return_inverse=True)[1].astype(np.float64)
        az, el, roll = aman.angles("boresight", ("az", "el", "roll"), n)
        radec = np.zeros((0, 4))
        if "boresight_equ" in aman:
            radec = _rotations(*aman.angles("boresight_equ", ("ra", "dec", "psi"), n))
        plate = aman if "hwp_angle" in aman else aman.child("hwp_solution")
        about = aman.child("obs_info").scalars
        tod = TimeOrderedData(
            name=str(about.get("obs_id", "axismanager")),
            start=Instant(round(float(times[0]) * 1e9)).isoformat(),
            seconds=times - times[0],
            times=times,
            sample_rate=1 / interval,
            telescope=str(about.get("telescope", "")),
            field_of_view=2 * float(np.arctan(np.hypot(xi, eta).max())),
            site=_site(about),
            boresight_azel=_rotations(-az, el, roll),
            boresight_radec=radec,
            flags=np.zeros(n, np.uint8),
            detector_flags=np.where(known, 0, INVALID).astype(np.uint8),
            names=names,
            quats=detector_quaternions(xi, eta, gamma),
            columns=columns,
            hwp_angle=plate.numbers("hwp_angle", n) if "hwp_angle" in plate else None,
            offsets=np.stack([xi, eta], axis=1),
        )
        self._aman = aman
        self._flags = _take_flags(tod, aman.child("flags"))
        return tod, group

    def _streams(self) -> dict[str, str]:
        found = {}
        for name, item in self._aman.schema.items():
            if item.get("axes") == AXES and item.get("encoding") in STREAMS:
                self._check_stream(self._data[name])
                found[name] = str(self._aman.units.get(name, ""))
        return found

    def flags(self, detectors: Indices, samples: slice) -> Flags | None:
        """(n, m) uint8, flags of samples of each detector but for those of all; None: there are
        none.
        """
        if not self._flags:
            return None
        found = np.zeros((len(detectors), samples.stop - samples.start), np.uint8)
        for flag in self._flags:
            part = np.zeros_like(found)
            for out, row in zip(part, detectors.tolist(), strict=True):
                assert flag.ends is not None
                own = flag.spans[flag.ends[row - 1] if row else 0 : flag.ends[row]]
                for start, stop in np.clip(own - samples.start, 0, len(out)).tolist():
                    out[start:stop] = flag.bit
            part[:, flag.common[samples]] = 0
            found |= part
        return found


def _rotations(longitude: Floats, latitude: Floats, psi: Floats) -> Floats:
    """Rz(longitude) Ry(pi/2 - latitude) Rz(psi), (n, 4)."""
    zero = np.zeros(len(psi))
    turn = np.stack([zero, zero, np.sin(psi / 2), np.cos(psi / 2)], axis=1)
    return multiply(from_angles(longitude, latitude), turn)


def _centres(info: Fields, n: int) -> Floats | None:
    """(n,) centre of each detector's band by its name [Hz], NaN for dark ones; None: of no band."""
    for path in ("wafer.bandpass", "band"):
        found = [BAND.fullmatch(name.strip()) for name in info.texts(path, n) or ()]
        centres = np.array([float(m[1]) * 1e9 if m else np.nan for m in found])
        if (centres > 0).any():
            return np.where(centres > 0, centres, np.nan)
    return None


def _site(about: Mapping[str, Any]) -> tuple[str, float, float, float]:
    """Name, latitude, longitude [rad] and altitude [m] of the telescope.

    Raises InputError if they are not stated and the telescope is none of the Simons Observatory's.
    """
    if {"latitude", "longitude", "altitude"} <= about.keys():
        latitude = float(about["latitude"])
        longitude = float(about["longitude"])
        altitude = float(about["altitude"])
        name = str(about.get("site", ""))
    else:
        telescope = str(about.get("telescope", "")).lower().replace("satp", "sat")
        if (key := telescope if telescope[:3] == "sat" else telescope[:3]) not in SITES:
            text = f"does not say where its telescope {telescope!r} stands"
            cure = "aman.obs_info.wrap('latitude', ...), 'longitude' [deg] and 'altitude' [m]"
            raise InputError(text, cure=cure)
        (latitude, longitude), altitude, name = SITES[key], ALTITUDE, "cerro_toco"
    return name, float(np.radians(latitude)), float(np.radians(longitude)), altitude


def _take_flags(tod: TimeOrderedData, child: Fields) -> list[Flag]:
    """Put the file's flags into those of samples and of whole detectors of a scan, and into its
    intervals; return the flags of single detectors' samples.
    """
    n = tod.n_samples
    found = list[Flag]()
    for name in sorted(child.schema, key=lambda name: name != "turnarounds"):
        flag = child.flag(name, tod.n_detectors, n)
        if flag is None or name == UNION:
            continue
        edges = np.zeros(n + 1, np.int64)
        np.add.at(edges, flag.spans[:, 0], 1)
        np.add.at(edges, flag.spans[:, 1], -1)
        common = np.cumsum(edges)[:-1] >= (1 if flag.ends is None else tod.n_detectors)
        if name in SCANS:
            still = common & ((tod.flags & np.uint8(TURNAROUND)) == 0)
            tod.intervals[f"throw_{SCANS[name]}"] = intervals_of(common, tod.seconds)
            tod.intervals[f"scan_{SCANS[name]}"] = intervals_of(still, tod.seconds)
            continue
        bit = SOLAR_SYSTEM_OBJECT if name in SOURCES else INVALID
        if flag.ends is not None:
            lengths = np.append(0, np.cumsum(flag.spans[:, 1] - flag.spans[:, 0]))
            whole = np.diff(lengths[flag.ends], prepend=0) == n
            tod.detector_flags[whole] |= np.uint8(bit)
            common &= bit == INVALID and not whole.all()
            if flag.ends[-1] and not whole.all():
                found.append(Flag(flag.spans, flag.ends, bit, common))
        tod.flags[common] |= np.uint8(SAMPLES.get(name, INVALID))
    return found


class Fields:
    """Fields of an AxisManager, checked where they are read.

    Attributes
    ----------
    schema, units
        What the file states of each field; empty for a child that is not there.
    """

    def __init__(self, group: Any, place: str) -> None:
        self._group = group
        self._place = place
        about: Any = {"version": 0, "schema": []}
        if group is not None:
            about = json.loads(group.attrs[SCHEMA])
        if about["version"] != 0:
            raise ValueError(f"it is of version {about['version']}, not 0")
        self.schema: dict[str, Any] = {str(item["name"]): dict(item) for item in about["schema"]}
        self.units: dict[str, Any] = dict(self._attribute("_units"))

    def __contains__(self, name: str) -> bool:
        return name in self.schema

    @property
    def scalars(self) -> dict[str, Any]:
        """Values that are no arrays."""
        return dict(self._attribute("_scalars"))

    def _attribute(self, name: str) -> Any:
        return json.loads("{}" if self._group is None else self._group.attrs.get(name, "{}"))

    def axis(self, name: str) -> Any:
        """Labels of an axis, or its length."""
        return self.schema[name]["args"][1]

    def child(self, name: str) -> Fields:
        """The AxisManager that is a field of this name."""
        return Fields(self._group[name] if name in self else None, self._place)

    def numbers(self, name: str, n: int, si: str = "") -> Floats:
        """(n,) numbers, in ``si`` where they have a unit."""
        values = self._array(name)
        if values.shape != (n,) or values.dtype.kind not in "fiu":
            raise ValueError(f"{name} is no array of {n} numbers")
        unit = self.units.get(name)
        factor = 1.0 if unit is None else factor_to(si, str(unit))
        if factor is None:
            raise ValueError(f"{name} is in {unit}")
        return np.asarray(values, np.float64) * factor

    def angles(self, name: str, keys: Sequence[str], n: int) -> tuple[Floats, ...]:
        """Angles (n,) [rad] of the child of this name."""
        child = self.child(name)
        return tuple(child.numbers(key, n, "rad") for key in keys)

    def texts(self, path: str, n: int) -> list[str] | None:
        """(n,) texts; None where there is no such field."""
        first, _, rest = path.partition(".")
        if rest:
            return self.child(first).texts(rest, n)
        if first not in self:
            return None
        values = self._array(first)
        if values.shape != (n,):
            raise ValueError(f"{first} is no array of {n} texts")
        return [v.decode() if isinstance(v, bytes) else str(v) for v in values.tolist()]

    def flag(self, name: str, n_detectors: int, n: int) -> Flag | None:
        """A flag of samples; None: it is one of something else."""
        if self.schema[name].get("encoding") != "rangesmatrix":
            return None
        shape, spans, ends = (
            self._array(f"{name}/{key}").astype(np.int64) for key in ("shape", "intervals", "ends")
        )
        if shape.tolist() not in ([n], [n_detectors, n]):
            return None
        counts = np.diff(ends, prepend=0)
        steps = np.diff(spans)
        inner = ends[(ends > 0) & (ends < len(spans))]
        steps[inner - 1] = 0  # from one detector to the next
        fits = ends.shape == ((n_detectors if len(shape) == 2 else 1),) and ends[-1] == len(spans)
        if not fits or min(counts.min(), steps.min(initial=0), spans.min(initial=0)) < 0:
            raise ValueError(f"the intervals of the flag {name} do not fit together")
        if (counts % 2).any() or spans.max(initial=0) > n:
            raise ValueError(f"the flag {name} has intervals beyond its {n} samples")
        return Flag(spans.reshape(-1, 2), ends // 2 if len(shape) == 2 else None)

    def _array(self, name: str) -> Any:
        if self._group is None or name not in self._group:
            raise KeyError(f"there is no field {name}")
        check_size(self._group[name], self._place)
        return np.asarray(self._group[name][()])
