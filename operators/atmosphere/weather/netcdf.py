"""Fields on pressure levels in a NetCDF file, whoever named its variables, axes and units.

What is read: the names of the Climate Data Store (old and new), cfgrib, ARCO-ERA5 and CMIP
(`plev`), or the CF standard name. A unit that is not known is refused; where a file states none it
is what ERA5 has, and the values must be air's (`era5`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from zonda.core.errors import InputError
from zonda.core.storage import hdf5_files
from zonda.core.storage.files import reading
from zonda.core.types import Floats

from .radiative_transfer import GRAVITY
from .time_reference import duration, posix_times

GET = (
    "`zonda weather fetch SITE --time TIME --output era5.nc` gets such a file, or the Climate Data"
    " Store's pages do"
)

Scale = tuple[float, float]
"""(factor, offset) from a unit to SI."""

_SHARE = {
    "kg kg-1": (1.0, 0.0),
    "kg/kg": (1.0, 0.0),
    "1": (1.0, 0.0),
    "g kg-1": (1e-3, 0.0),
    "g/kg": (1e-3, 0.0),
}
_SPEED = {
    "m s-1": (1.0, 0.0),
    "m/s": (1.0, 0.0),
    "ms-1": (1.0, 0.0),
    "km h-1": (1 / 3.6, 0.0),
    "km/h": (1 / 3.6, 0.0),
    **dict.fromkeys(("knot", "knots", "kt", "kts"), (1852 / 3600, 0.0)),
}
_PERCENT = {"%": (1.0, 0.0), "percent": (1.0, 0.0), "1": (100.0, 0.0), "(0 - 1)": (100.0, 0.0)}
_KELVIN = {
    **dict.fromkeys(("k", "kelvin", "kelvins", "deg k", "degk"), (1.0, 0.0)),
    **dict.fromkeys(
        (
            "degc",
            "c",
            "celsius",
            "°c",
            "deg c",
            "degree_celsius",
            "degrees_celsius",
            "degree celsius",
            "degrees celsius",
            "degree_c",
            "degrees_c",
        ),
        (1.0, 273.15),
    ),
}
_ENERGY = dict.fromkeys(("m2 s-2", "m2/s2", "m2s-2", "j kg-1", "j/kg"), (1.0, 0.0))
_HEIGHT = {
    **dict.fromkeys(
        ("m", "gpm", "meter", "meters", "metre", "metres", "geopotential meters"), (GRAVITY, 0.0)
    ),
    **dict.fromkeys(("dam", "gpdam", "gpdm"), (10 * GRAVITY, 0.0)),
    "km": (1e3 * GRAVITY, 0.0),
}
PRESSURES = {
    **dict.fromkeys(("pa", "pascal", "pascals"), (1.0, 0.0)),
    **dict.fromkeys(
        ("hpa", "hectopascal", "hectopascals", "mbar", "mb", "millibar", "millibars"), (100.0, 0.0)
    ),
    "kpa": (1e3, 0.0),
    "bar": (1e5, 0.0),
}
"""Of the level axis."""


@dataclass(frozen=True)
class Quantity:
    """Names that a variable may have, and its units; ``default`` is the unit of a variable that
    states none.
    """

    what: str
    names: tuple[str, ...]
    standard: str
    default: str
    units: Mapping[str, Scale]


QUANTITIES = {
    "t": Quantity("temperature", ("t", "temperature", "ta"), "air_temperature", "k", _KELVIN),
    "q": Quantity(
        "specific_humidity",
        ("q", "specific_humidity", "hus"),
        "specific_humidity",
        "kg kg-1",
        _SHARE,
    ),
    "r": Quantity(
        "relative_humidity", ("r", "relative_humidity", "hur"), "relative_humidity", "%", _PERCENT
    ),
    "u": Quantity(
        "u_component_of_wind", ("u", "u_component_of_wind", "ua"), "eastward_wind", "m s-1", _SPEED
    ),
    "v": Quantity(
        "v_component_of_wind", ("v", "v_component_of_wind", "va"), "northward_wind", "m s-1", _SPEED
    ),
    "z": Quantity(
        "geopotential", ("z", "geopotential"), "geopotential", "m2 s-2", _ENERGY | _HEIGHT
    ),
    "gh": Quantity(
        "geopotential_height",
        ("gh", "zg", "geopotential_height"),
        "geopotential_height",
        "gpm",
        _HEIGHT,
    ),
    "o3": Quantity(
        "ozone_mass_mixing_ratio",
        ("o3", "ozone_mass_mixing_ratio"),
        "mass_fraction_of_ozone_in_air",
        "kg kg-1",
        _SHARE,
    ),
}
"""By ERA5's short name; a geopotential height is read as a geopotential."""

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
"""kg/kg, or % of relative humidity: less is taken as this, which is 1e-5 mm of water in the whole
column.
"""

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
        return {
            dim: int(k)
            for dim, k in zip(self.dims, np.unravel_index(number, self.shape), strict=True)
        }


class NetCdf:
    """Base of the readers of NetCDF-3 and NetCDF-4.

    ``below_none``: how many values below 0 were raised to `DRIEST` before their logarithm was
    taken. ``remarks``: what was chosen.
    """

    def __init__(self, variables: Any, dimensions: dict[str, list[str]], place: str) -> None:
        self._variables, self._dimensions, self._place = variables, dimensions, place
        self.below_none = 0
        self.remarks: dict[str, None] = {}
        self._names = {
            key: name
            for key, quantity in QUANTITIES.items()
            if (name := self._found(quantity)) is not None
        }

    def __contains__(self, key: str) -> bool:
        return key in self._names

    def axes(self) -> dict[str, Axis]:
        """The axes by kind: times in s since 1970, levels in Pa, degrees.

        Raises
        ------
        InputError
            Without one of them, or with one in a unit or a calendar that is not known.
        """
        found = {
            "time": self._times(),
            **{kind: self._axis(*AXES[kind]) for kind in ("level", "lat", "lon")},
        }
        for kind in ("lat", "lon"):
            unit = self.units(found[kind].name)
            if unit and not unit.startswith("deg"):
                raise InputError(
                    f"its {found[kind].name} has the unit '{unit}'", cure="expected degrees"
                )
        level = found["level"]
        scale, offset = self._scale(level.name, PRESSURES, _of_levels(level.values))
        found["level"] = Axis(level.name, level.dims, level.shape, level.values * scale + offset)
        return found

    def attribute(self, name: str, key: str, default: Any = None) -> Any:
        variable = self._variables[name]
        value = (
            variable.attrs.get(key, default)
            if hasattr(variable, "attrs")
            else getattr(variable, key, default)
        )
        if isinstance(value, bytes):
            return value.decode(errors="replace")
        return value.item() if isinstance(value, np.ndarray) and value.size == 1 else value

    def units(self, name: str) -> str:
        """Units as the file has them, in lower case, with one way to write a power; empty where
        there are none.
        """
        text = str(self.attribute(name, "units", "") or "")
        return " ".join(text.replace("**", "").replace("^", "").replace("*", " ").lower().split())

    def raw(self, name: str, where: Any = ()) -> Any:
        """Values as they are stored."""
        if hasattr(self._variables[name], "dims"):
            hdf5_files.check_size(self._variables[name], self._place)
        return np.asarray(self._variables[name][where])

    def values(self, name: str, where: Any = ()) -> Floats:
        """Unpacked values, NaN where they are missing."""
        raw = self.raw(name, where)
        missing = [self.attribute(name, key) for key in ("_FillValue", "missing_value")]
        scale, offset = (
            float(self.attribute(name, "scale_factor", 1.0)),
            float(self.attribute(name, "add_offset", 0)),
        )
        out = raw.astype(np.float64) * scale + offset
        for value in missing:
            if value is not None:
                out = np.where(raw == value, np.nan, out)
        return np.atleast_1d(out)

    def interpolated(
        self, key: str, axes: dict[str, Axis], weights: dict[str, dict[int, float]], log: bool
    ) -> Floats:
        """(n_level,) of a quantity, SI but for a relative humidity in %."""
        name, quantity = self._names[key], QUANTITIES[key]
        factor, offset = self._scale(name, quantity.units, quantity.default)
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

    def _found(self, quantity: Quantity) -> str | None:
        fields = {name: dims for name, dims in self._dimensions.items() if len(dims) > 0}
        by_case = {name.lower(): name for name in reversed(fields)}
        named = [n for n in quantity.names if n in fields] or [
            by_case[n] for n in quantity.names if n in by_case
        ]
        standard = (
            n
            for n, dims in fields.items()
            if len(dims) > 1 and self._standard(n) == quantity.standard
        )
        return named[0] if named else next(standard, None)

    def _standard(self, name: str) -> str:
        return str(self.attribute(name, "standard_name", "") or "")

    def _scale(self, name: str, known: Mapping[str, Scale], default: str) -> Scale:
        unit = self.units(name) or default
        if unit not in known:
            raise InputError(
                f"the variable {name} has the unit '{self.attribute(name, 'units')}'",
                cure=f"expected one of {', '.join(known)}",
            )
        return known[unit]

    def _axis(
        self, names: tuple[str, ...], standard: str, convert: Callable[[str], Floats] | None = None
    ) -> Axis:
        found = next((name for name in names if name in self._dimensions), None)
        found = found or next(
            (name for name in self._dimensions if self._standard(name) == standard), None
        )
        if found is None:
            raise InputError(
                f"has no axis {' or '.join(names)}", cure=f"it must be on pressure levels: {GET}"
            )
        values, dims = (
            self.values(found) if convert is None else convert(found),
            self._dimensions[found],
        )
        if convert is None and len(dims) > 1:
            raise InputError(
                f"its {found} lies on {', '.join(dims)}",
                cure=f"it must be one row of values: {GET}",
            )
        return Axis(found, tuple(dims), values.shape if dims else (), np.ravel(values))

    def _times(self) -> Axis:
        """The time that the fields hold for: of a forecast, that of its start and its step."""
        axis = self._axis(*AXES["time"], self._posix)
        step = "step" if axis.name == "time" and "step" in self._dimensions else None
        if step is None:
            return axis
        steps = self.values(step) * duration(str(self.attribute(step, "units", "")), step)
        values, dims = axis.values[:, None] + steps, (*axis.dims, *self._dimensions[step])
        shape = tuple(
            n for n, of in zip(values.shape, (axis.dims, self._dimensions[step]), strict=True) if of
        )
        return Axis(axis.name, dims, shape, values.ravel())

    def _posix(self, name: str) -> Floats:
        units, calendar = (
            str(self.attribute(name, "units", "") or ""),
            self.attribute(name, "calendar"),
        )
        raw = self.raw(name)
        if (
            self.attribute(name, "scale_factor") is not None
            or self.attribute(name, "add_offset") is not None
        ):
            raw = self.values(name).reshape(raw.shape)
        return np.atleast_1d(
            posix_times(raw, units, None if calendar is None else str(calendar), name)
        )

    def _column(self, name: str, axes: dict[str, Axis], at: dict[str, int]) -> Floats:
        names, level = self._dimensions[name], axes["level"].dims
        index: dict[str, Any] = at | {level[0]: slice(None)} if level else dict(at)
        if any(dim not in names for dim in index) or not level:
            message = f"the variable {name} lies on {', '.join(names) or 'no axis'}"
            raise InputError(message, cure=f"it needs time, level, latitude and longitude: {GET}")
        values = self.values(name, tuple(index.get(n, slice(None)) for n in names))
        extra = [n for n in names if n not in index]
        if extra:
            rest = [n for n in names if n in extra or n == level[0]]
            several = [n for n in extra if values.shape[rest.index(n)] > 1]
            if unknown := [n for n in several if n not in FIRST_OF]:
                raise InputError(
                    f"the variable {name} lies on {', '.join(names)}",
                    cure=f"keep one entry of {unknown[0]}",
                )
            values = np.moveaxis(values, rest.index(level[0]), 0).reshape(
                values.shape[rest.index(level[0])], -1
            )
            whole = np.flatnonzero(np.isfinite(values).all(axis=0))
            values = values[:, whole[0] if len(whole) else 0]
            self.remarks.update(
                (f"the first {n} of several", None) for n in several if n != "expver"
            )
        if not np.isfinite(values).all():
            raise InputError(
                f"the variable {name} has no values at this place and time",
                cure="download the file again",
            )
        return values


def _of_levels(values: Floats) -> str:
    """The unit of levels that state none: surface air is between 300 and 1100 hPa."""
    return "pa" if values.size and np.nanmax(values) > 2000 else "hpa"


@contextmanager
def opened(path: Path, place: str) -> Iterator[NetCdf]:
    """A NetCDF-3 or NetCDF-4 file. Raises `InputError` for what is none."""
    import h5py

    kind, cure = "NetCDF", f"a GRIB file must be converted, a zip file unpacked; {GET}"
    with reading(place, kind, cure):
        of_hdf5 = path.is_file() and h5py.is_hdf5(path)
    if of_hdf5:
        with hdf5_files.opened(path, place, kind, cure) as file:
            sets = {name: file[name] for name in file if isinstance(file.get(name), h5py.Dataset)}
            own = {
                name: item
                for name, item in sets.items()
                if not _text(item.attrs.get("NAME", "")).startswith(_NO_VARIABLE)
            }
            yield NetCdf(own, {name: _dimensions(name, item) for name, item in own.items()}, place)
        return
    from scipy.io import netcdf_file

    with reading(place, kind, cure), netcdf_file(path, "r", mmap=False) as file:
        yield NetCdf(
            file.variables, {name: list(v.dimensions) for name, v in file.variables.items()}, place
        )


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
