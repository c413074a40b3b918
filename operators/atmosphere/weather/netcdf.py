"""Fields on pressure levels in a NetCDF file, whoever named its variables, axes and units.

What is read: the names of the Climate Data Store (old and new), cfgrib, ARCO-ERA5 and CMIP
(`plev`), or the CF standard name. A unit that is not known is refused; where a file states none it
is what ERA5 has, and the values must be air's (`era5`). A time is a number in a unit since a
reference, read whole: half a reference passed over is another time.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple

import astropy.units as u
import numpy as np

from zonda.core.configuration.units import read_unit
from zonda.core.errors import InputError
from zonda.core.storage import hdf5_files
from zonda.core.storage.files import reading
from zonda.core.types import Floats

from .radiative_transfer import GRAVITY

GET = (
    "`zonda weather fetch SITE --time TIME --output era5.nc` gets such a file, or the Climate Data"
    " Store's pages do"
)

SPELLED: dict[str, Any] = {
    "(0 - 1)": "1",
    **dict.fromkeys(("degc", "c", "celsius", "°c", "deg c"), "deg_C"),
    **dict.fromkeys(("degree_celsius", "degrees_celsius", "degree celsius"), "deg_C"),
    **dict.fromkeys(("kelvins", "deg k", "degk"), "K"),
    **dict.fromkeys(("gpm", "geopotential meters", "meters", "metres", "metre"), "m"),
    **dict.fromkeys(("gpdam", "gpdm"), "dam"),
    **dict.fromkeys(("mb", "millibar", "millibars"), "mbar"),
    **dict.fromkeys(("hectopascal", "hectopascals", "hpa"), "hPa"),
    **dict.fromkeys(("knot", "knots", "kt", "kts"), u.imperial.knot),
    "ms-1": "m s-1",
    "m2s-2": "m2 s-2",
    "pascals": "Pa",
    "percent": "%",
    **dict.fromkeys(("hours", "hrs"), "h"),
    **dict.fromkeys(("seconds", "sec", "secs"), "s"),
    "minutes": "min",
    "mins": "min",
    "days": "d",
    "nanoseconds": "ns",
    "microseconds": "us",
    "milliseconds": "ms",
}
"""Units in small letters as files write them, in astropy's words."""
HEIGHTS = [(u.m, u.m**2 / u.s**2, lambda height: height * GRAVITY, lambda z: z / GRAVITY)]
"""A geopotential height is read as a geopotential."""


class Quantity(NamedTuple):
    """Names that a variable may have, its unit where it states none, and that it is read in."""

    what: str
    also: tuple[str, ...]
    standard: str
    default: str
    unit: str


SHARE = ("kg kg-1", "")
SPEED = ("m s-1", "m s-1")
ENERGY = "m2 s-2"
QUANTITIES = {
    "t": Quantity("temperature", ("ta",), "air_temperature", "K", "K"),
    "q": Quantity("specific_humidity", ("hus",), "specific_humidity", *SHARE),
    "r": Quantity("relative_humidity", ("hur",), "relative_humidity", "%", ""),
    "u": Quantity("u_component_of_wind", ("ua",), "eastward_wind", *SPEED),
    "v": Quantity("v_component_of_wind", ("va",), "northward_wind", *SPEED),
    "z": Quantity("geopotential", (), "geopotential", ENERGY, ENERGY),
    "gh": Quantity("geopotential_height", ("zg",), "geopotential_height", "m", ENERGY),
    "o3": Quantity("ozone_mass_mixing_ratio", (), "mass_fraction_of_ozone_in_air", *SHARE),
}
"""By ERA5's short name."""

AXES = {
    "time": (("valid_time", "time"), "time"),
    "level": (
        ("pressure_level", "isobaricInhPa", "isobaricInPa", "plev", "level", "lev"),
        "air_pressure",
    ),
    "lat": (("latitude", "lat"), "latitude"),
    "lon": (("longitude", "lon"), "longitude"),
}
"""Names of the axes, and their standard name."""
FIRST_OF = ("expver", "number", "realization", "member")
"""Axes of which the first entry with values is taken: ERA5 and its preliminary months, members of
an ensemble.
"""

DRIEST = 1e-9
"""Share of the air: less water is taken as this, which is 1e-5 mm in the whole column."""

CALENDARS = ("standard", "gregorian", "proleptic_gregorian")
"""Calendars in which a date is that of everyday life."""
RESOLVED = 60.0
"""s: where a number of this type cannot tell times apart that differ by this, the times have been
rounded.
"""
AS_DATE = re.compile(r"days? as %y%m%d(?:\.%f)?")

_NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable"


@dataclass(frozen=True)
class Axis:
    """A coordinate: its variable, the axes of the file that it lies on (none: one value for all),
    and its values, flat.
    """

    name: str
    dims: tuple[str, ...]
    shape: tuple[int, ...]
    values: Floats

    def at(self, number: int) -> dict[str, int]:
        """Index of its value ``number``, by axis of the file."""
        index = np.unravel_index(number, self.shape)
        return {dim: int(k) for dim, k in zip(self.dims, index, strict=True)}


class Variable(NamedTuple):
    """A variable of NetCDF-3 or NetCDF-4, its attributes and its axes."""

    data: Any
    attributes: Mapping[str, Any]
    dims: list[str]


class NetCdf:
    """Fields of a file.

    ``below_none``: how many values below 0 were raised to `DRIEST` before their logarithm was
    taken. ``remarks``: what was chosen.
    """

    def __init__(self, variables: dict[str, Variable], place: str) -> None:
        self._variables = variables
        self._place = place
        self.below_none = 0
        self.remarks: dict[str, None] = {}
        found = {
            key: self._found((key, q.what, *q.also), q.standard, 1) for key, q in QUANTITIES.items()
        }
        self._names = {key: name for key, name in found.items() if name is not None}

    def __contains__(self, key: str) -> bool:
        return key in self._names

    def axes(self) -> dict[str, Axis]:
        """The axes by kind: times in s since 1970, levels in Pa, degrees.

        Raises
        ------
        InputError
            Without one of them, or with one in a unit or a calendar that is not known.
        """
        found = {kind: self._axis(*AXES[kind]) for kind in ("level", "lat", "lon")}
        for kind in ("lat", "lon"):
            unit = self.text(found[kind].name, "units")
            if unit and not unit.startswith("deg"):
                raise InputError(
                    f"its {found[kind].name} has the unit '{unit}'",
                    cure="expected degrees",
                )
        level = found["level"]
        plainly_pa = level.values.size and np.nanmax(level.values) > 2000  # surface: 300-1100 hPa
        scale, offset = self._scale(level.name, "Pa" if plainly_pa else "hPa", "Pa")
        return found | {
            "time": self._times(),
            "level": replace(level, values=level.values * scale + offset),
        }

    def attribute(self, name: str, key: str, default: Any = None) -> Any:
        """An attribute of a variable."""
        value = self._variables[name].attributes.get(key, default)
        if isinstance(value, bytes):
            return value.decode(errors="replace")
        return value.item() if isinstance(value, np.ndarray) and value.size == 1 else value

    def text(self, name: str, key: str) -> str:
        """An attribute as text, with one blank between words; empty where there is none."""
        return " ".join(str(self.attribute(name, key) or "").split())

    def raw(self, name: str, where: Any = ()) -> Any:
        """Values as they are stored."""
        data = self._variables[name].data
        if hasattr(data, "dims"):
            hdf5_files.check_size(data, self._place)
        return np.asarray(data[where])

    def values(self, name: str, where: Any = ()) -> Floats:
        """Unpacked values, NaN where they are missing."""
        raw = self.raw(name, where)
        scale = self.attribute(name, "scale_factor", 1.0)
        offset = self.attribute(name, "add_offset", 0)
        out = raw.astype(np.float64) * float(scale) + float(offset)
        for key in ("_FillValue", "missing_value"):
            if (value := self.attribute(name, key)) is not None:
                out = np.where(raw == value, np.nan, out)
        return np.atleast_1d(out)

    def interpolated(
        self,
        key: str,
        axes: dict[str, Axis],
        weights: dict[str, dict[int, float]],
        log: bool,
    ) -> Floats:
        """(n_level,) of a quantity, SI."""
        name = self._names[key]
        quantity = QUANTITIES[key]
        factor, offset = self._scale(name, quantity.default, quantity.unit)
        total: Floats | float = 0.0
        for i, a in weights["time"].items():
            for j, b in weights["lat"].items():
                for k, c in weights["lon"].items():
                    at = axes["time"].at(i) | axes["lat"].at(j) | axes["lon"].at(k)
                    column = self._column(name, axes, at) * factor + offset
                    if log:
                        self.below_none += int(np.count_nonzero(column < 0))
                        column = np.log(np.maximum(column, DRIEST))
                    total = total + a * b * c * column
        return np.asarray(np.exp(total) if log else total)

    def _found(self, names: tuple[str, ...], standard: str, least: int = 0) -> str | None:
        """The variable of one of these names, in any case, that lies on ``least`` axes or more;
        else that of the standard name.
        """
        there = [name for name, one in self._variables.items() if len(one.dims) >= least]
        by_case = {name.lower(): name for name in reversed(there)}
        named = [n for n in names if n in there] or [
            by_case[n.lower()] for n in names if n.lower() in by_case
        ]
        standards = (
            n
            for n in there
            if len(self._variables[n].dims) > least and self.text(n, "standard_name") == standard
        )
        return next(iter(named), None) or next(standards, None)

    def _scale(self, name: str, default: str, si: str) -> tuple[float, float]:
        """(factor, offset) from a variable's unit to ``si``."""
        written = self.text(name, "units")
        try:
            known = SPELLED.get(written.lower(), written or default)
            unit = read_unit(known) if isinstance(known, str) else known
            zero, one = unit.to(
                read_unit(si),
                np.array([0.0, 1.0]),
                equivalencies=[*u.temperature(), *HEIGHTS],
            ).tolist()
        except ValueError:
            raise InputError(
                f"the variable {name} has the unit '{written}'",
                cure=f"expected {si or 'kg kg-1'}, or another unit of its kind",
            ) from None
        return one - zero, zero

    def _axis(
        self,
        names: tuple[str, ...],
        standard: str,
        convert: Callable[[str], Floats] | None = None,
    ) -> Axis:
        found = self._found(names, standard)
        if found is None:
            raise InputError(
                f"has no axis {' or '.join(names)}",
                cure=f"it must be on pressure levels: {GET}",
            )
        dims = self._variables[found].dims
        values = (convert or self.values)(found)
        if convert is None and len(dims) > 1:
            raise InputError(
                f"its {found} lies on {', '.join(dims)}",
                cure=f"it must be one row of values: {GET}",
            )
        return Axis(found, tuple(dims), values.shape if dims else (), np.ravel(values))

    def _times(self) -> Axis:
        """The time that the fields hold for: of a forecast, that of its start and its step."""
        axis = self._axis(*AXES["time"], self._posix)
        if axis.name != "time" or "step" not in self._variables:
            return axis
        steps = self.values("step") * self._scale("step", "", "s")[0]
        values = axis.values[:, None] + steps
        more = self._variables["step"].dims
        on = zip(values.shape, (axis.dims, more), strict=True)
        shape = tuple(n for n, dims in on if dims)
        return Axis(axis.name, (*axis.dims, *more), shape, values.ravel())

    def _posix(self, name: str) -> Floats:
        packed = any(self.attribute(name, key) for key in ("scale_factor", "add_offset"))
        raw = self.raw(name)
        raw = self.values(name).reshape(raw.shape) if packed else raw
        calendar = self.text(name, "calendar") or None
        return np.atleast_1d(posix_times(raw, self.text(name, "units"), calendar, name))

    def _column(self, name: str, axes: dict[str, Axis], at: dict[str, int]) -> Floats:
        names = self._variables[name].dims
        level = axes["level"].dims
        index: dict[str, Any] = at | {level[0]: slice(None)} if level else dict(at)
        if any(dim not in names for dim in index) or not level:
            message = f"the variable {name} lies on {', '.join(names) or 'no axis'}"
            raise InputError(message, cure=f"it needs time, level, latitude and longitude: {GET}")
        values = self.values(name, tuple(index.get(n, slice(None)) for n in names))
        rest = [n for n in names if n not in at]
        several = [
            n for n, size in zip(rest, values.shape, strict=True) if n != level[0] and size > 1
        ]
        if unknown := [n for n in several if n not in FIRST_OF]:
            raise InputError(
                f"the variable {name} lies on {', '.join(names)}",
                cure=f"keep one entry of {unknown[0]}",
            )
        values = np.moveaxis(values, rest.index(level[0]), 0)
        values = values.reshape(len(values), -1)
        whole = np.isfinite(values).all(axis=0)
        if not whole.any():
            raise InputError(
                f"the variable {name} has no values at this place and time",
                cure="download the file again",
            )
        remarks = (f"the first {n} of several" for n in several if n != "expver")
        self.remarks.update(dict.fromkeys(remarks))
        return np.asarray(values[:, int(np.argmax(whole))], np.float64)


def posix_times(values: Any, units: str, calendar: str | None, name: str) -> Floats:
    """Seconds since 1970-01-01T00:00 UTC of the numbers ``values`` of a time axis called ``name``.

    Raises
    ------
    InputError
        A unit, a reference or a calendar that is not known, also in part; numbers that are rounded
        to more than a minute.
    """
    raw = np.asarray(values)
    text = " ".join(units.split()).lower()
    calendar = (calendar or "standard").strip().lower()
    if calendar not in CALENDARS:
        raise InputError(
            f"its {name} counts in the calendar '{calendar}', not in that of everyday life",
            cure=(
                f"expected one of {', '.join(CALENDARS)}: this may be a model's output, not a"
                " reanalysis"
            ),
        )
    try:
        if AS_DATE.fullmatch(text):
            unit = 86400.0
            start = 0.0
        else:
            unit_of, since, reference = text.partition(" since ")
            unit = float(read_unit(str(SPELLED.get(unit_of, unit_of))).to(u.s)) if since else 0.0
            if not 0 < unit <= 86400:  # months and years have no fixed length
                raise ValueError("expected nanoseconds to days since a date, or day as %Y%m%d")
            start = _reference(reference, calendar)
        finite = raw[np.isfinite(raw)]
        largest = np.abs(finite).max(initial=0)
        if raw.dtype.kind == "f" and float(np.spacing(largest)) * unit > RESOLVED:
            raise ValueError(f"{raw.dtype} rounds these times by more than {RESOLVED:g} s")
        if AS_DATE.fullmatch(text):
            return np.asarray(np.vectorize(_of_date, otypes=[np.float64])(raw), np.float64)
    except ValueError as error:
        raise InputError(
            f"its {name} has the unit '{units}': {error}",
            cure=(
                "expected e.g. hours since 2022-08-01 06:00:00 +00:00, or day as %Y%m%d, in int32,"
                " int64 or float64"
            ),
        ) from None
    return np.asarray(start + raw.astype(np.float64) * unit, np.float64)


def _reference(text: str, calendar: str) -> float:
    """A reference in s since 1970. Raises ValueError for what is no time.

    Before 15 October 1582 the standard calendar is the Julian one, whose days are these later than
    days of the Gregorian calendar of the same name.
    """
    if re.search(r"(:\d\d?){3}", text):
        raise ValueError("no such clock")
    year, *rest = re.sub(r"\s*(?:utc|gmt)$", "z", text).partition("-")
    padded = re.sub(r"(?<![\d.])(\d)(?!\d)", r"0\1", "".join(rest))
    found = datetime.fromisoformat(re.sub(r" (?=[-+z])", "", year.rjust(4, "0") + padded).upper())
    found = found if found.tzinfo else found.replace(tzinfo=UTC)
    if abs(found.utcoffset() or timedelta()) > timedelta(hours=14):
        raise ValueError("no such time zone")
    later = 0
    day = (found.year, found.month, found.day)
    if calendar != "proleptic_gregorian" and day < (1582, 10, 15):
        if day > (1582, 10, 4):
            raise ValueError("the standard calendar has no such date")
        century = (found.year - (found.month < 3)) // 100
        later = century - century // 4 - 2
    return (found - datetime(1970, 1, 1, tzinfo=UTC)).total_seconds() + 86400.0 * later


def _of_date(number: float) -> float:
    """A date such as 20220801.25 in s since 1970; of eight digits 0.3 ms are left."""
    day = datetime.strptime(f"{int(number)}", "%Y%m%d")
    return day.replace(tzinfo=UTC).timestamp() + round(number % 1 * 86400.0, 2)


@contextmanager
def opened(path: Path, place: str) -> Iterator[NetCdf]:
    """A NetCDF-3 or NetCDF-4 file. Raises `InputError` for what is none."""
    import h5py

    kind = "NetCDF"
    cure = f"a GRIB file must be converted, a zip file unpacked; {GET}"
    with reading(place, kind, cure):
        of_hdf5 = path.is_file() and h5py.is_hdf5(path)
    if of_hdf5:
        with hdf5_files.opened(path, place, kind, cure) as file:
            sets = {name: file[name] for name in file if isinstance(file.get(name), h5py.Dataset)}
            variables = {
                name: Variable(item, dict(item.attrs), _dimensions(name, item))
                for name, item in sets.items()
                if not _text(item.attrs.get("NAME", "")).startswith(_NO_VARIABLE)
            }
            yield NetCdf(variables, place)
        return
    from scipy.io import netcdf_file

    with reading(place, kind, cure), netcdf_file(path, "r", mmap=False) as file:
        found = {
            name: Variable(v, vars(v), list(v.dimensions)) for name, v in file.variables.items()
        }
        yield NetCdf(found, place)


def _dimensions(name: str, item: Any) -> list[str]:
    """Axes of a variable of NetCDF-4; that of a coordinate is its own name."""
    if item.ndim == 1 and _text(item.attrs.get("CLASS", "")) == "DIMENSION_SCALE":
        return [name]
    found = [_label(d) for d in item.dims]
    return [name] if len(found) == 1 and not found[0] else found


def _text(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


def _label(dimension: Any) -> str:
    return str(dimension[0].name).rpartition("/")[2] if len(dimension) else str(dimension.label)
