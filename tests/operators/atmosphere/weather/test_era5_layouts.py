"""Files of ERA5 as people have them: names, units, time references and calendars; nothing of a text
is left unread.
"""

import importlib.util
from pathlib import Path

import h5py
import numpy as np
import pytest

from zonda.core.configuration.time import Instant
from zonda.core.errors import InputError
from zonda.core.site import Site
from zonda.operators.atmosphere.weather.era5 import Era5
from zonda.operators.atmosphere.weather.netcdf import posix_times

_spec = importlib.util.spec_from_file_location(
    "era5_files", Path(__file__).with_name("era5_files.py")
)
files = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(files)

NIGHT = Instant.parse("2024-03-01T02:00Z")
SITE = Site(name="here", latitude="40.3 deg", longitude="10.1 deg", altitude="600 m")
GRAVITY = 9.80665


def written(
    path, names=None, units=None, values=None, time=None, drop=(), attributes=None, **given
):
    """A file of `new_layout`, then renamed, converted, annotated; ``time``: (numbers, attributes),
    a scalar if the number is.
    """
    files.new_layout(path, **given)
    with h5py.File(path, "a") as file:
        variables = {
            name: (item[()], dict(item.attrs), [d[0].name[1:] for d in item.dims if len(d)])
            for name, item in file.items()
        }
    names, new = names or {}, path.with_suffix(".made.nc")
    axes = ["valid_time", "pressure_level", "latitude", "longitude"]
    with h5py.File(new, "w") as file:
        for axis in axes:
            data, attrs, _ = variables[axis]
            keep = {"units": attrs["units"]} if "units" in attrs else {}
            if axis == "valid_time" and time is not None:
                data, keep = np.asarray(time[0]), time[1]
            if values and axis in values:
                data = values[axis](data)
            item = file.create_dataset(names.get(axis, axis), data=data)
            item.attrs.update(keep)
            if data.ndim:
                item.make_scale(names.get(axis, axis))
        scalar = np.ndim(variables["valid_time"][0] if time is None else time[0]) == 0
        for name, (data, _, _) in variables.items():
            if name in axes or name == "number" or name in drop:
                continue
            data = values[name](data) if values and name in values else data
            item = file.create_dataset(names.get(name, name), data=data[0] if scalar else data)
            for k, axis in enumerate(axes[1:] if scalar else axes):
                item.dims[k].attach_scale(file[names.get(axis, axis)])
        for name, unit in (units or {}).items():
            file[names.get(name, name)].attrs["units"] = unit
        for name, more in (attributes or {}).items():
            file[names.get(name, name)].attrs.update(more)
    return new


def column(path, time=NIGHT):
    return Era5(file=path).column(SITE, time)


def same(found, expected):
    for name in ("pressure", "height", "temperature", "h2o", "wind_east", "wind_north", "ozone"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(expected, name), rtol=2e-6, atol=1e-9, err_msg=name
        )


@pytest.fixture(scope="module")
def right(tmp_path_factory):
    return column(files.new_layout(tmp_path_factory.mktemp("right") / "era5.nc"))


# The file's hours are 0, 3 and 6 of 2024-03-01; every entry writes them in another way.
TIMES = [
    (np.array([-6, -3, 0]), "hours since 2024-03-01 06:00:00"),
    (np.array([-6, -3, 0]), "hours since 2024-03-01T06:00:00Z"),
    (np.array([-6, -3, 0]), "Hours since 2024-3-1 6:00"),
    (np.array([-6.0, -3.0, 0.0]), "hrs since 2024-03-01 08:00:00.0 +02:00"),
    (np.array([-6, -3, 0]), "hour since 2024-03-01 00:30 -5:30"),
    (np.array([-6, -3, 0]), "h since 2024-03-01 06:00:00 UTC"),
    (np.array([0, 180, 360]), "minutes since 2024-03-01"),
    (np.array([0, 180, 360]), "min since 20240301"),
    (np.array([0, 10800, 21600]), "seconds since 2024-03-01 00:00:00 GMT"),
    (np.array([0, 10800, 21600]) * 10**9, "nanoseconds since 2024-03-01"),
    (np.array([-0.5, -0.375, -0.25]), "days since 2024-03-01 12:00"),
    (np.array([20240301.0, 20240301.125, 20240301.25]), "day as %Y%m%d.%f"),
    (
        np.array([738947.0, 738947.125, 738947.25]),
        "days since 1-1-1 00:00:00",
    ),  # the Julian 1 January of the year 1
]


@pytest.mark.parametrize(("numbers", "unit"), TIMES, ids=[unit for _, unit in TIMES])
def test_time_references_are_read_whole(tmp_path, right, numbers, unit):
    same(column(written(tmp_path / "era5.nc", time=(numbers, {"units": unit}))), right)


def test_the_julian_calendar_ends_where_it_ended():
    """Standard: 4 October 1582 is followed by the 15th; proleptic: the Gregorian calendar has
    always been.
    """
    from datetime import UTC, datetime

    new_year = datetime(2000, 1, 1, tzinfo=UTC).timestamp()
    days = (datetime(2000, 1, 1, tzinfo=UTC) - datetime(1582, 10, 15, tzinfo=UTC)).days
    assert posix_times(days + 1, "days since 1582-10-04", "standard", "time") == new_year
    assert (
        posix_times(days + 11, "days since 1582-10-04", "proleptic_gregorian", "time") == new_year
    )
    assert posix_times(days, "days since 1582-10-15", None, "time") == new_year
    # Julian 29 February of a year that the Gregorian calendar takes as common
    assert posix_times(2, "days since 1500-02-28", "gregorian", "time") == posix_times(
        0, "days since 1500-03-01", "gregorian", "time"
    )
    with pytest.raises(InputError, match="no such date"):
        posix_times(0, "days since 1582-10-10", "standard", "time")


@pytest.mark.parametrize(
    ("unit", "words"),
    [
        ("hours since 2024-03-01 06:00:00 CEST", "has the unit"),
        ("hours since 2024-03-01 06:00:00 PM", "has the unit"),
        ("hours since 2024-03-01 06:00:00:00", "has the unit"),
        ("hours since 2024-03-01 06:00:00 (noon)", "has the unit"),
        ("hours since 2024-13-01", "month"),
        ("hours since 2024-02-30 06:00", "day"),
        ("hours since 2024-03-01 25:00", "hour must be"),
        ("hours since 2024-03-01 06:00 +19:00", "no such time zone"),
        ("months since 2024-03-01", "has the unit"),
        ("day as %d%m%Y", "has the unit"),
        ("hours", "has the unit"),
        ("", "has the unit"),
    ],
)
def test_what_is_no_time_reference_is_refused(tmp_path, unit, words):
    path = written(tmp_path / "era5.nc", time=(np.array([0, 3, 6]), {"units": unit}))
    with pytest.raises(InputError, match=words) as caught:
        column(path)
    assert caught.value.cure


@pytest.mark.parametrize("calendar", ["noleap", "360_day", "julian", "all_leap"])
def test_another_calendar_is_refused(tmp_path, calendar):
    time = np.array([0, 3, 6]), {"units": "hours since 2024-03-01", "calendar": calendar}
    with pytest.raises(InputError, match=f"calendar '{calendar}'"):
        column(written(tmp_path / "era5.nc", time=time))


@pytest.mark.parametrize("calendar", ["standard", "gregorian", "Proleptic_Gregorian"])
def test_calendars_of_everyday_life_are_read(tmp_path, right, calendar):
    time = np.array([0, 3, 6]), {"units": "hours since 2024-03-01", "calendar": calendar}
    same(column(written(tmp_path / "era5.nc", time=time)), right)


def test_rounded_times_are_refused(tmp_path):
    """float32 holds seconds since 1970 in steps of 128 s, and dates as numbers in steps of 2
    days.
    """
    for numbers, unit in (
        (files.START.timestamp(), "seconds since 1970-01-01"),
        (20240301, "day as %Y%m%d.%f"),
    ):
        path = written(
            tmp_path / "era5.nc",
            time=(np.float32(numbers) * np.ones(3, np.float32), {"units": unit}),
        )
        with pytest.raises(InputError, match="rounds these times"):
            column(path)


def test_one_time_as_a_scalar(tmp_path):
    """As xarray writes a file after `isel(valid_time=0)`."""
    path = written(
        tmp_path / "era5.nc",
        time=(np.int64(2), {"units": "hours since 2024-03-01"}),
        hours=(2, 3, 6),
    )
    assert column(path).temperature[0] == pytest.approx(
        column(files.new_layout(tmp_path / "b.nc")).temperature[0], abs=1e-4
    )
    with pytest.raises(
        InputError, match="covers times 2024-03-01T02:00Z to 2024-03-01T02:00Z, not"
    ):
        column(path, Instant.parse("2024-03-01T05:00Z"))


CFGRIB = {"valid_time": "time", "pressure_level": "isobaricInhPa"}
PLEV = {"valid_time": "time", "pressure_level": "plev", "latitude": "lat", "longitude": "lon",
        "t": "ta", "q": "hus", "u": "ua", "v": "va", "z": "zg"}  # fmt: skip
ARCO = {
    "valid_time": "time",
    "pressure_level": "level",
    "t": "temperature",
    "q": "specific_humidity",
    "u": "u_component_of_wind",
    "v": "v_component_of_wind",
    "z": "geopotential",
    "o3": "ozone_mass_mixing_ratio",
}
OWN = {"t": "T_air", "q": "moisture", "u": "east", "v": "north", "z": "phi", "o3": "ozone"}
STANDARD = {
    "t": "air_temperature",
    "q": "specific_humidity",
    "u": "eastward_wind",
    "v": "northward_wind",
    "z": "geopotential",
    "o3": "mass_fraction_of_ozone_in_air",
}
SINCE = np.array([0, 3, 6]), {"units": "hours since 2024-03-01"}


@pytest.mark.parametrize(
    "given",
    [
        {"names": CFGRIB, "time": SINCE},
        {
            "names": CFGRIB | {"pressure_level": "isobaricInPa"},
            "units": {"pressure_level": "Pa"},
            "time": SINCE,
            "values": {"pressure_level": lambda p: 100 * p},
        },
        {
            "names": PLEV,
            "time": SINCE,
            "units": {"pressure_level": "Pa", "t": "K", "q": "1", "u": "m s-1", "z": "m"},
            "values": {"pressure_level": lambda p: 100 * p, "z": lambda z: z / GRAVITY},
        },
        {"names": ARCO, "time": SINCE},
        {"names": {k: v.upper() for k, v in zip("tquvz", "tquvz", strict=True)}},
        {"names": OWN, "attributes": {k: {"standard_name": v} for k, v in STANDARD.items()}},
        {"units": {"pressure_level": "millibars"}},
        {"units": {"pressure_level": "kPa"}, "values": {"pressure_level": lambda p: p / 10}},
        # none, and plainly Pa
        {"units": {"pressure_level": ""}, "values": {"pressure_level": lambda p: 100 * p}},
        {"units": {"t": "degC"}, "values": {"t": lambda t: t - 273.15}},
        {"units": {"q": "g kg**-1", "o3": "kg kg**-1"}, "values": {"q": lambda q: 1e3 * q}},
        {
            "units": {"u": "knots", "v": "km/h"},
            "values": {"u": lambda u: u * 3600 / 1852, "v": lambda v: 3.6 * v},
        },
        {"units": {"z": "m**2 s**-2", "t": "K", "q": "kg kg**-1", "u": "m s**-1", "v": "m s**-1"}},
        {"units": {"z": "gpm"}, "values": {"z": lambda z: z / GRAVITY}},
        {"names": {"z": "gh"}, "values": {"z": lambda z: z / GRAVITY}},
    ],
    ids=[
        "cfgrib",
        "isobaricInPa",
        "plev",
        "arco",
        "upper case",
        "standard names",
        "millibars",
        "kPa",
        "Pa unsaid",
        "degC",
        "g/kg",
        "knots",
        "cds",
        "gpm",
        "gh",
    ],
)
def test_names_and_units_of_others(tmp_path, right, given):
    found = column(written(tmp_path / "era5.nc", **given))
    if "o3" not in given.get("names", {}) and "zg" in given.get("names", {}).values():
        assert "ozone" not in found.stated
    same(found, right)


def test_valid_time_beside_the_time_axis(tmp_path, right):
    """cfgrib keeps the axis `time` and the coordinates `step` and `valid_time` beside it; a
    forecast's time is start and step.
    """
    path = written(
        tmp_path / "era5.nc",
        names=CFGRIB,
        time=(np.array([-3, 0, 3]), {"units": "hours since 2024-03-01"}),
    )
    with h5py.File(path, "a") as file:
        file["step"] = 3
        file["step"].attrs["units"] = "hours"
    same(column(path), right)
    with h5py.File(path, "a") as file:
        file["valid_time"] = np.array([0, 3, 6])
        file["valid_time"].attrs["units"] = "hours since 2024-03-01"
        file["valid_time"].dims[0].attach_scale(file["time"])
    same(column(path), right)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"units": {"pressure_level": "psi"}}, "pressure_level has the unit 'psi'"),
        ({"units": {"t": "degF"}}, "t has the unit 'degF'"),
        ({"units": {"q": "g m-3"}}, "q has the unit 'g m-3'"),
        ({"units": {"u": "Pa s-1"}}, "u has the unit 'Pa s-1'"),
        ({"units": {"z": "feet"}}, "z has the unit 'feet'"),
        ({"units": {"latitude": "radians"}}, "latitude has the unit 'radians'"),
        ({"values": {"t": lambda t: t - 273.15}}, "the temperature is not between"),
        ({"values": {"z": lambda z: z / GRAVITY}}, "its pressure does not belong to its height"),
        ({"values": {"q": lambda q: 1e3 * q}}, "the share of water vapour is not between"),
        ({"values": {"u": lambda u: 100 * u}}, "the wind east is not between"),
        ({"units": {"pressure_level": "Pa"}}, "too coarse|does not belong"),
    ],
)
def test_other_units_are_refused(tmp_path, given, words):
    with pytest.raises(InputError, match=words) as caught:
        column(written(tmp_path / "era5.nc", **given))
    assert caught.value.cure


def test_an_unknown_axis_is_not_passed_over(tmp_path):
    """Members of an ensemble: the first, and said; any other axis is refused."""
    files.new_layout(tmp_path / "a.nc")
    for name, read in (("number", True), ("simulation", False)):
        path = tmp_path / f"{name}.nc"
        with h5py.File(tmp_path / "a.nc") as old, h5py.File(path, "w") as file:
            axes = ["valid_time", "pressure_level", "latitude", "longitude"]
            for axis in axes:
                file[axis] = old[axis][()]
                file[axis].attrs.update({k: v for k, v in old[axis].attrs.items() if k == "units"})
                file[axis].make_scale(axis)
            file[name] = np.arange(2)
            file[name].make_scale(name)
            for key in "tquvz":
                file[key] = np.stack([old[key][()], old[key][()] + 1], axis=1)
                for k, axis in enumerate([axes[0], name, *axes[1:]]):
                    file[key].dims[k].attach_scale(file[axis])
        if read:
            assert "the first number of several" in column(path).stated
        else:
            with pytest.raises(InputError, match="keep one entry of simulation"):
                column(path)
