"""The sources of weather: ERA5 files, tables, the standard atmosphere, and what a scene makes of
them.
"""

import dataclasses
import importlib.util
import math
import re
from pathlib import Path

import numpy as np
import pytest

from zonda import Scene
from zonda.core.configuration.diagnostics import ConfigurationError
from zonda.core.configuration.pipeline_file import parse
from zonda.core.configuration.time import Instant
from zonda.core.errors import InputError, ZondaError, placed
from zonda.core.registry import sites, weather_sources
from zonda.core.site import Site
from zonda.core.weather import PWV_MAX, Column, Pwv, WeatherSource
from zonda.operators.atmosphere.weather import air as measures
from zonda.operators.atmosphere.weather.climatology import profile
from zonda.operators.atmosphere.weather.era5 import Era5
from zonda.operators.atmosphere.weather.profiles import PwvDistribution
from zonda.operators.atmosphere.weather.sources import Climatology, Standard, Table, profile_of

_spec = importlib.util.spec_from_file_location(
    "era5_files", Path(__file__).with_name("era5_files.py")
)
files = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(files)

NIGHT = Instant.parse("2024-03-01T02:00Z")
TABLE = """# from a balloon
height [km], pressure [hPa], temperature [degC], Relative_Humidity [%], wind east [m/s], wind north [m/s]
0.5, 955, 10, 50, 3, 1
1.5, 845, 4, 40, 5, 1
3.0, 700, -5, 30, 9, 2
5.0, 540, -18, 20, 14, 3
9.0, 308, -44, 10, 25, 0   # the top
"""


def here(**changes):
    given = {"name": "here", "latitude": "40.3 deg", "longitude": "10.1 deg", "altitude": "600 m"}
    return Site.model_validate(given | changes)


def scene(weather, **changes):
    given = {
        "site": "green_bank",
        "instrument": "mustang2",
        "time": "2024-11-25T07:00",
        "weather": weather,
    }
    return Scene(**(given | changes))


def air(weather, **changes):
    s = scene(weather, **changes)
    return profile_of(s.weather, s.site, s.time, s.seed)


# --------------------------------------------------------------------------------------------------
# what is written


@pytest.mark.parametrize(
    ("text", "metres", "quantile"),
    [
        ("1.2 mm", 1.2e-3, None),
        ("25 %", None, 0.25),
        ("25%", None, 0.25),
        ("random", None, None),
        ("0 mm", 0.0, None),
        ("60 mm", 0.06, None),
    ],
)
def test_pwv_is_read_and_written(text, metres, quantile):
    pwv = Pwv.parse(text)
    assert (pwv.metres, pwv.quantile) == (metres, quantile)
    assert Pwv.parse(str(pwv)) == pwv


@pytest.mark.parametrize(
    ("weather", "kind"),
    [
        ({"pwv": "1.2 mm"}, Climatology),
        ({"pwv": "25 %"}, Climatology),
        ({"pwv": "random", "wind": "random"}, Climatology),
        ({"source": "standard", "pwv": "3 mm"}, Standard),
        ("climatology", Climatology),
        ({"file": "era5.nc", "pwv": "2 mm"}, Era5),
        ({"table": "air.csv"}, Table),
    ],
)
def test_yaml_names_a_source_and_survives(weather, kind, tmp_path):
    (tmp_path / "era5.nc").touch()
    (tmp_path / "air.csv").touch()
    text = "site: green_bank\ninstrument: mustang2\ntime: 2024-11-25\ntarget: 5h 20d\n"
    file = parse(f"{text}weather: {weather}\noperators: [PointingStare]\n", folder=tmp_path)
    assert type(file.scene().weather) is kind
    again = parse(file.resolved_yaml())
    assert again.scene() == file.scene()
    assert type(again.scene().weather) is kind


@pytest.mark.parametrize(
    ("weather", "words"),
    [
        ("{pwv: -1 mm}", "a precipitable water vapour of -1 mm is outside the limits, 0 to 60 mm"),
        (
            "{pwv: 500 mm}",
            "a precipitable water vapour of 500 mm is outside the limits, 0 to 60 mm",
        ),
        ("{pwv: 100 %}", "a quantile of 100 % is outside the limits"),
        ("{pwv: 3}", "3 has no unit"),
        ("{pvw: 3 mm}", r"unknown key 'pvw' for weather[\s\S]*did you mean 'pwv'"),
        ("{file: gone.nc}", "no such file: 'gone.nc'"),
        ("{file: a.nc, table: b.csv}", "file and table are two sources of weather"),
        ("{source: era6}", r"unknown weather source 'era6'[\s\S]*did you mean 'era5'"),
        ("{source: era5}", "weather needs 'file'"),
        ("[1]", "the weather is a mapping"),
    ],
)
def test_mistakes_are_reported_at_their_place(weather, words):
    scene_of = "site: green_bank\ninstrument: mustang2\ntime: 2024-11-25T07:00\n"
    with pytest.raises(ConfigurationError, match=words) as caught:
        parse(f"{scene_of}weather: {weather}\ntarget: 05h +20d\noperators: [PointingStare]\n")
    assert "<text>:4:" in str(caught.value)
    assert caught.value.message.startswith("1 mistake")


def test_mistakes_in_python():
    with pytest.raises(ZondaError, match="500 mm is outside"):
        scene({"pwv": "500 mm"})
    with pytest.raises(ZondaError, match="unknown weather source"):
        scene("nowhere")
    with pytest.raises(ZondaError, match="unknown parameter 'pvw'"):
        scene({"pvw": "1 mm"})


def test_schema_takes_every_source():
    jsonschema = pytest.importorskip("jsonschema")
    from zonda.core.configuration.schema import json_schema

    schema = json_schema()
    base = {
        "site": "green_bank",
        "instrument": "mustang2",
        "time": "2024-11-25",
        "operators": ["PointingStare"],
    }
    for weather in (
        {"pwv": "25 %"},
        {"file": "era5.nc"},
        {"table": "a.csv", "pwv": "1 mm"},
        {"source": "standard"},
        "climatology",
        None,
    ):
        jsonschema.validate(base | {"weather": weather}, schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(base | {"weather": {"pvw": "1 mm"}}, schema)


def test_sources_are_plugins():
    class Dry(WeatherSource):
        """Dry air."""

        def column(self, site, time):
            return measures.standard_column(site)

    weather_sources.register(Dry, name="dry_test")
    assert air({"source": "dry_test", "pwv": "1 mm"}).pwv == pytest.approx(1e-3)


# --------------------------------------------------------------------------------------------------
# water and wind


def test_given_water_and_climatology():
    median = profile(sites.create("green_bank"), Instant.parse("2024-11-25T07:00"))
    assert air(None).pwv == median.pwv
    assert air({"pwv": "7.7 mm"}).pwv == pytest.approx(7.7e-3, rel=1e-12)
    assert air({"pwv": "50 %"}).pwv == pytest.approx(
        median.pwv, rel=0.01
    )  # the cut at 60 mm moves it by less
    assert air({"pwv": "25 %"}).pwv < median.pwv < air({"pwv": "75 %"}).pwv


def test_quantiles_are_log_normal_and_never_beyond_the_limit():
    law = PwvDistribution(20e-3, 0.4)
    assert law.at(0.5) == pytest.approx(20e-3, rel=2e-3)
    assert math.log(law.at(0.8413) / law.at(0.1587)) / 2 == pytest.approx(0.4, rel=0.01)
    assert law.at(1 - 1e-9) <= PWV_MAX
    assert law.at(1e-9) > 0


def test_random_water_follows_the_distribution_and_the_seed():
    drawn = np.array(
        [air({"pwv": "random"}, seed=seed, site="chajnantor").pwv for seed in range(200)]
    )
    law = air(None, site="chajnantor").distribution
    assert air({"pwv": "random"}, seed=7).pwv == air({"pwv": "random"}, seed=7).pwv
    # 200 draws: the mean of the logarithm has standard error sigma / sqrt(200), its width sigma /
    # 20; 4 of them are allowed
    assert np.log(drawn).mean() == pytest.approx(
        math.log(law.median), abs=4 * law.sigma / math.sqrt(200)
    )
    assert np.log(drawn).std() == pytest.approx(law.sigma, rel=4 / 20)


def test_wind_is_typical_median_or_drawn():
    median, typical = air({"wind": "median"}), air(None)
    plain = profile(sites.create("green_bank"), Instant.parse("2024-11-25T07:00"))
    np.testing.assert_array_equal(median.wind_east, plain.wind_east)
    slow, fast = (
        np.hypot(median.wind_east, median.wind_north),
        np.hypot(typical.wind_east, typical.wind_north),
    )
    assert (fast > slow).all()
    np.testing.assert_allclose(
        typical.wind_east * median.wind_north, typical.wind_north * median.wind_east, atol=1e-9
    )
    drawn = [air({"wind": "random"}, seed=seed) for seed in range(100)]
    east = np.array([(d.wind_east - plain.wind_east) / plain.wind_east_spread for d in drawn])
    assert np.ptp(east, axis=1).max() < 1e-9  # the same draw at all heights
    assert abs(east[:, 0].mean()) < 4 / 10  # standard error 1 / sqrt(100)
    assert east[:, 0].std() == pytest.approx(1, abs=4 / math.sqrt(200))


def test_typical_speed_is_the_median_of_normal_components():
    # equation (2) of weather.py against 2e5 draws, whose median has a standard error below 0.4 %
    rng = np.random.default_rng(1)
    for u, v, s in ((0.0, 0.0, 5.0), (3.0, 1.0, 5.0), (10.0, -4.0, 5.0), (30.0, 5.0, 8.0)):
        truth = np.median(
            np.hypot(u + s * rng.standard_normal(200_000), v + s * rng.standard_normal(200_000))
        )
        one = np.ones(2)
        plain = profile(sites.create("green_bank"), NIGHT)
        made = type(plain)(*(one,) * 5, u * one, v * one, 0.0, s * one, s * one).typical_wind
        assert np.hypot(made.wind_east, made.wind_north)[0] == pytest.approx(truth, rel=0.03)


def test_operator_and_scene_may_not_disagree_about_the_water():
    s = scene({"pwv": "25 %"})
    with pytest.raises(
        InputError, match=r"given twice: 5 mm by the operator, 25 % by the scene's weather"
    ):
        profile_of(s.weather, s.site, s.time, 0, 5e-3)
    s = scene({"pwv": "5 mm"})
    assert profile_of(s.weather, s.site, s.time, 0, 5e-3).pwv == pytest.approx(5e-3)
    assert profile_of(
        scene({"wind": "median"}).weather, s.site, s.time, 0, 5e-3
    ).pwv == pytest.approx(5e-3)


def test_the_scenes_weather_reaches_the_pipeline():
    import zonda

    s = scene({"pwv": "3 mm", "wind": "median"}, target="az 180 deg el 60 deg")
    steps = [
        zonda.PointingStare(scan_duration="10 s"),
        zonda.AtmosphereLayers(layers=2),
        zonda.Efficiency(),
    ]
    said = {what: text for _, what, text in zonda.Pipeline(steps).run(s).log}
    assert said["PWV"] == "3 mm, as given"
    assert said["wind"] == "medians of the components"
    with pytest.raises(InputError, match="given twice"):
        zonda.Pipeline([steps[0], zonda.AtmosphereLayers(pwv="4 mm"), steps[2]]).run(s)


# --------------------------------------------------------------------------------------------------
# any place


def test_a_place_without_climatology_needs_water_or_a_file():
    with pytest.raises(
        InputError, match=r"site 'here': has no climatology[\s\S]*weather: \{pwv: 3 mm\}[\s\S]*ERA5"
    ):
        profile_of(None, here(), NIGHT, 0)
    with pytest.raises(InputError, match="has no climatology"):
        profile_of(Climatology(pwv="50 %"), here(), NIGHT, 0)
    with pytest.raises(InputError, match="standard atmosphere has no PWV of its own"):
        profile_of(Standard(), here(), NIGHT, 0)
    for made in (
        profile_of(Climatology(pwv="3 mm"), here(), NIGHT, 0),
        profile_of(None, here(), NIGHT, 0, 3e-3),
        profile(here(), NIGHT, 3e-3),
    ):
        assert made.pwv == pytest.approx(3e-3, rel=1e-12)
        assert dict(made.stated)["weather"].startswith("US Standard Atmosphere")


def test_standard_atmosphere():
    # US Standard Atmosphere 1976, geopotential heights: 0, 5, 11, 20, 32, 47 km
    want = [101325, 54020, 22632, 5474.9, 868.02, 110.91]
    np.testing.assert_allclose(measures.pressure([0, 5e3, 11e3, 20e3, 32e3, 47e3]), want, rtol=1e-3)
    for altitude in (0, 2000, 5600):
        made = profile(here(altitude=f"{altitude} m"), NIGHT, 1e-3)
        want = measures.pressure(altitude + made.height)
        np.testing.assert_allclose(
            made.pressure, want, rtol=0.04
        )  # 61 heights, the topmost km apart
        np.testing.assert_allclose(made.pressure[want > 500], want[want > 500], rtol=0.01)
        low = made.height < 47e3 - altitude
        np.testing.assert_allclose(
            made.temperature[low],
            measures.temperature(altitude + made.height)[low],
            atol=2,
        )
    # 8 + 30 exp(...) m/s at its jet, to the slope between heights
    assert np.hypot(made.wind_east, made.wind_north).max() == pytest.approx(38, abs=0.3)


def test_time_outside_the_climatology():
    for text in ("1850-01-01", "2150-01-01"):
        with pytest.raises(
            InputError,
            match=rf"{text}T00:00:00Z is outside what the climatology stands for, 1940 to 2100",
        ):
            profile(sites.create("green_bank"), Instant.parse(text))


# --------------------------------------------------------------------------------------------------
# ERA5


@pytest.mark.parametrize("layout", ["new", "old", "expver", "dateline", "reversed"])
def test_era5_is_interpolated_in_space_and_time(tmp_path, layout):
    path, site, shift = tmp_path / "era5.nc", here(), 0.0
    if layout in ("old", "expver"):
        files.old_layout(path, expver=layout == "expver")
    elif layout == "dateline":  # a globe from 0 to 360 deg east, and a place given as -349.9
        files.new_layout(path, longitude=np.arange(0, 360, 1.0))
        site = here(longitude="-349.9 deg")
    elif layout == "reversed":
        files.new_layout(path, latitude=(40.0, 40.5, 41.0), levels=files.LEVELS[::-1])
    else:
        files.new_layout(path)
    made = Era5(file=path).column(site, NIGHT)
    want = files.air(40.3, 10.1 + shift, 2.0)
    packed = 1.0 if layout in ("old", "expver") else 0.0  # 16 bits: half of 1/65000 of the range
    np.testing.assert_allclose(made.pressure, files.LEVELS * 100)
    np.testing.assert_allclose(made.temperature, want["t"], atol=1e-4 + 2e-3 * packed)
    np.testing.assert_allclose(made.wind_east, want["u"], atol=1e-4 + 1e-3 * packed)
    np.testing.assert_allclose(made.wind_north, want["v"], atol=1e-4 + 1e-3 * packed)
    np.testing.assert_allclose(made.height, want["z"] / 9.80665, atol=0.01 + 0.5 * packed)
    np.testing.assert_allclose(
        made.h2o, measures.from_specific(want["q"]), rtol=1e-4, atol=2e-7 * packed
    )
    np.testing.assert_allclose(made.ozone, 1e-6 * 28.964 / 47.998, rtol=1e-3)


def test_era5_gives_air_for_a_scene(tmp_path):
    path = files.new_layout(
        tmp_path / "era5.nc", levels=files.LEVELS[files.LEVELS >= 100], without=("o3",)
    )
    made = air({"file": str(path)}, site=here(), time="2024-03-01T02:00")
    # all the water of the column, by mass: the integral of q dp / g from the site up
    fine = np.linspace(100e2, made.pressure[0], 20001)
    q = files.air(40.3, 10.1, 2.0)["q"]
    water = np.exp(np.interp(np.log(fine), np.log(files.LEVELS[::-1] * 100), np.log(q[::-1])))
    assert made.pwv == pytest.approx(np.trapezoid(water, fine) / 9.80665 / 1000, rel=0.01)
    assert "ozone of the standard atmosphere" in dict(made.stated)["weather"]
    assert 15e3 < made.height[np.argmax(made.o3)] < 40e3
    assert (np.diff(made.pressure) < 0).all()
    assert (made.temperature > 190).all()
    assert air(
        {"file": str(path), "pwv": "2 mm"}, site=here(), time="2024-03-01T02:00"
    ).pwv == pytest.approx(2e-3)
    with pytest.raises(
        InputError,
        match="'25 %' needs a distribution, and source 'era5' has one state of the atmosphere only",
    ):
        air({"file": str(path), "pwv": "25 %"}, site=here(), time="2024-03-01T02:00")


def test_era5_relative_humidity_serves(tmp_path):
    def relative(values):
        p = files.LEVELS[None, :, None, None] * 100
        e = measures.from_specific(values["q"]) * p
        return values | {"r": 100 * e / measures.saturation_pressure(values["t"])}

    path = files.new_layout(tmp_path / "era5.nc", without=("q",), change=relative)
    want = files.air(40.5, 10.0, 3.0)
    made = Era5(file=path).column(
        here(latitude="40.5 deg", longitude="10 deg"), Instant.parse("2024-03-01T03:00")
    )
    np.testing.assert_allclose(made.h2o, measures.from_specific(want["q"]), rtol=1e-4)


def nan_at_a_level(values):
    values["u"][:, 3] = np.nan
    return values


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"without": ("v",)}, r"lacks v \(v_component_of_wind\)"),
        ({"without": ("q",)}, r"lacks q \(specific_humidity\)"),
        ({"latitude": (10.0, 10.25)}, "covers latitudes 10.00 deg to 10.25 deg, not 40.30 deg"),
        ({"longitude": (20.0, 20.25)}, "covers longitudes 20.00 deg to 20.25 deg, not 10.10 deg"),
        ({"latitude": (38.0, 42.0)}, "too coarse: its latitudes are 4 deg apart"),
        ({"longitude": (9.0, 12.0)}, "too coarse: its longitudes are 3 deg apart"),
        ({"hours": (0, 12)}, "too coarse: its times are 12 h apart"),
        (
            {"hours": (6, 9)},
            "covers times 2024-03-01T06:00Z to 2024-03-01T09:00Z, not 2024-03-01T02:00Z",
        ),
        (
            {"levels": (1000.0, 500.0, 250.0, 100.0)},
            r"too coarse: its 4 pressure levels \(1000, 500, 250, 100 hPa\) lie up to a factor 2",
        ),
        ({"levels": (1000.0, 850.0, 700.0, 500.0)}, "end at 500 hPa"),
        ({"change": nan_at_a_level}, "the variable u has no values at this place and time"),
    ],
)
def test_bad_era5_files(tmp_path, given, words):
    path = files.new_layout(tmp_path / "era5.nc", **given)
    with pytest.raises(InputError, match=words) as caught:
        Era5(file=path).column(here(), NIGHT)
    assert str(path) in caught.value.place
    assert caught.value.cure


def test_a_share_is_no_percentage(tmp_path):
    path = tmp_path / "air.csv"
    rows = [
        f"{z}, {measures.pressure(z)[()] / 100:.5g}, {measures.temperature(z)[()]:.5g}, 0.5"
        for z in (0, 2000, 4000, 6000, 9000)
    ]
    header = "height [m], pressure [hPa], temperature [K], relative humidity "
    path.write_text("\n".join([header + "[%]", *rows]))
    with pytest.raises(
        InputError, match=r"the relative humidity is 0[.]005 at most, which no air has"
    ):
        Table(table=path).column(here(), NIGHT)
    path.write_text("\n".join([header + "[1]", *rows]))
    assert Table(table=path).column(here(), NIGHT).h2o.max() > 1e-3


def test_files_that_are_not_netcdf(tmp_path):
    path = tmp_path / "era5.nc"
    for content in (
        b"",
        b"GRIB....",
        b"CDF\x01",
        b"PK\x03\x04zip",
        b"\x89HDF\r\n\x1a\n" + 30 * b"x",
    ):
        path.write_bytes(content)
        with pytest.raises(InputError, match="cannot be read as NetCDF"):
            Era5(file=path).column(here(), NIGHT)
    import h5py

    with h5py.File(path, "w") as file:
        file["t"] = file["u"] = file["v"] = file["z"] = file["q"] = np.zeros(3)
    with pytest.raises(InputError, match="has no axis pressure_level or"):
        Era5(file=path).column(here(), NIGHT)


def test_site_below_or_above_the_air(tmp_path):
    path = files.new_layout(tmp_path / "era5.nc", levels=files.LEVELS[files.LEVELS <= 700])
    with pytest.raises(
        InputError,
        match="site 'here': lies at 600 m, more than 500 m below the lowest level of ERA5",
    ):
        profile_of(Era5(file=path), here(), NIGHT, 0)


# --------------------------------------------------------------------------------------------------
# tables


def table(folder, text):
    (folder / "air.csv").write_text(text, encoding="utf-8")
    return Table(table=folder / "air.csv")


def test_table_is_read(tmp_path):
    made = table(tmp_path, TABLE).column(here(), NIGHT)
    np.testing.assert_allclose(made.height, [500, 1500, 3000, 5000, 9000])
    np.testing.assert_allclose(made.temperature[0], 283.15)
    np.testing.assert_allclose(made.pressure[1], 84500)
    np.testing.assert_allclose(made.h2o[0], 0.5 * measures.saturation_pressure(283.15) / 95500)
    np.testing.assert_allclose(made.wind_north, [1, 1, 2, 3, 0])
    made = profile_of(table(tmp_path, TABLE), here(), NIGHT, 0)
    assert 2e-3 < made.pwv < 15e-3
    # above the table: the standard lapse, hydrostatic; 9000 m and -44 C here, 229.7 K there
    assert made.temperature[np.argmin(abs(made.height - 14.4e3))] == pytest.approx(
        216.65 + 229.15 - 229.65, abs=1
    )
    scale = -np.diff(made.height) / np.diff(np.log(made.pressure))
    above = made.height[:-1] > 9500
    np.testing.assert_allclose(
        scale[above],
        (287.05 * (made.temperature[1:] + made.temperature[:-1]) / 2 / 9.80665)[above],
        rtol=0.02,
    )


def test_table_without_winds_and_with_density(tmp_path):
    rows = "".join(
        f"{h}, {p}, {t}, {d}\n"
        for h, p, t, d in (
            (5000, 540, 270, 1),
            (6e3, 470, 262, 0.5),
            (7e3, 410, 256, 0.3),
            (8e3, 356, 250, 0.1),
            (9e3, 308, 244, 0.05),
        )
    )
    made = table(
        tmp_path, "height [m], pressure [hPa], temperature [K], vapour density [g/m3]\n" + rows
    ).column(here(altitude="5 km"), NIGHT)
    np.testing.assert_allclose(made.h2o[0] * 54000 / (461.5 * 270), 1e-3, rtol=1e-3)
    np.testing.assert_allclose(made.wind_east, measures.wind_speed(np.arange(5) * 1e3))
    assert "without winds" in made.stated


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("700, -5", "nan, -5", "line 5: pressure is 'nan', not a finite number"),
        ("700, -5", "inf, -5", "line 5: pressure is 'inf', not a finite number"),
        ("700, -5", "seven, -5", "line 5: pressure is 'seven', not a finite number"),
        ("3.0, 700", "1.2, 700", "line 5: the height does not increase"),
        ("3.0, 700", "3.0, 900", "line 5: the pressure does not fall with height"),
        ("3.0, 700", "3.0, 1e-320", "line 5: the pressure is below 0.001 Pa"),
        (
            "pressure [hPa]",
            "pressure [Pa]",
            "line 3: its pressure does not belong to its height: no air has that",
        ),
        (
            "height [km]",
            "height [m]",
            "line 5: its pressure does not belong to its height: no air has that",
        ),
        (
            "-18, 20",
            "-18, -20",
            "line 6: the share of water vapour is not between 0 and 0.1 of the air",
        ),
        ("-18, 20", "-18, 200", "line 6: the relative humidity is above 120 %"),
        ("10, 50", "283, 50", "line 3: the temperature is not between 150 and 340 K"),
        ("9, 2", "900, 2", "line 5: the wind east is not between -200 and 200 m/s"),
        (
            "9.0, 308, -44, 10, 25, 0",
            "6.0, 480, -25, 10, 25, 0",
            "has 5 heights up to 6000 m above sea level",
        ),
        ("9.0, 308, -44, 10, 25, 0", "9.0, 308, -44", "line 7: has 3 values, not 6"),
        ("temperature [degC]", "temp [degC]", "the column 'temp' is not known"),
        ("temperature [degC]", "temperature [F]", "temperature has the unit 'F'"),
        ("temperature [degC]", "temperature", "temperature has no unit"),
        ("wind north [m/s]", "wind east [m/s]", "has two columns 'wind east'"),
        (
            "wind north [m/s]",
            "vapour density [g/m3]",
            "has 2 humidities",
        ),
        ("Relative_Humidity [%]", "ozone [ppm]", "has 0 humidities"),
        ("height [km]", "ozone [ppm]", "has no column 'height'"),
    ],
)
def test_bad_tables(tmp_path, old, new, words):
    assert old in TABLE
    with pytest.raises(InputError, match=words) as caught:
        table(tmp_path, TABLE.replace(old, new)).column(here(), NIGHT)
    assert caught.value.place == f"table {tmp_path / 'air.csv'}"
    assert caught.value.cure


def test_empty_and_binary_tables(tmp_path):
    with pytest.raises(InputError, match="has no rows"):
        table(tmp_path, "# nothing\n").column(here(), NIGHT)
    (tmp_path / "air.csv").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(InputError, match="cannot be read as a table"):
        Table(table=tmp_path / "air.csv").column(here(), NIGHT)


def test_column_needs_no_ozone_nor_spreads():
    column = measures.standard_column(here())
    assert isinstance(column, Column)
    assert column.ozone is None
    assert column.log_vapour_spread is None


# --------------------------------------------------------------------------------------------------
# fetching


def test_fetch_asks_for_the_cells_around_the_site(monkeypatch, tmp_path):
    import sys
    import types

    from zonda.operators.atmosphere.weather.era5 import request, retrieve

    asked = request(sites.create("llano_de_chajnantor"), Instant.parse("2022-08-01T23:30"), 2)
    assert asked["area"] == [-23.0, -68.0, -23.25, -67.75]
    assert (asked["day"], asked["time"]) == (["01", "02"], ["00:00", "01:00", "02:00", "23:00"])
    assert request(sites.create("amundsen_scott"), NIGHT, 1)["area"] == [-89.75, 0.0, -90.0, 0.25]
    monkeypatch.setitem(sys.modules, "cdsapi", None)
    with pytest.raises(
        InputError, match=r"cdsapi is not installed[\s\S]*pip install 'zonda\[weather\]'"
    ):
        retrieve(here(), NIGHT, 1, tmp_path / "x.nc")

    def client(**options):
        raise Exception("Missing/incomplete configuration file: /root/.cdsapirc")

    monkeypatch.setitem(sys.modules, "cdsapi", types.SimpleNamespace(Client=client))
    with pytest.raises(InputError, match=r"did not deliver: Missing/incomplete[\s\S]*free key"):
        retrieve(here(), NIGHT, 1, tmp_path / "x.nc")


def test_dry_air_keeps_the_shape_of_its_water() -> None:
    site, time = sites.create("chajnantor"), Instant.parse("2022-08-01T23:00:00Z")
    dry = profile_of(Climatology(pwv="0 mm"), site, time, 1)
    assert 0 < dry.pwv < 1e-11
    usual = profile_of(None, site, time, 1)
    # the pressure stays, so that the few per mille of molecules that were water are air: shapes
    # agree to that
    np.testing.assert_allclose(dry.scaled(usual.pwv).h2o, usual.h2o, rtol=1e-6)
    with pytest.raises(InputError, match="no vapour at all"):
        dataclasses.replace(usual, h2o=0 * usual.h2o).scaled(1e-3)


# --------------------------------------------------------------------------------------------------
# what is cut or kept


def said(profile, what):
    return dict(profile.stated).get(what)


def test_water_above_saturation_is_said(tmp_path):
    moist = table(tmp_path, TABLE.replace("-18, 20", "-18, 115"))
    text = said(profile_of(moist, here(), NIGHT, 1), "relative humidity above 100 %")
    levels, of, most = (
        int(n) for n in re.match(r"at (\d+) of (\d+) levels, up to (\d+)%", text).groups()
    )
    assert (of, 1 <= levels < 20) == (61, True)
    assert 100 <= most <= 115  # 115 % at one level of the table, between two of the profile
    assert text.endswith("above saturation; taken as it is")
    dry = profile_of(table(tmp_path, TABLE), here(), NIGHT, 1)
    assert said(dry, "relative humidity above 100 %") is None
    # a PWV that is asked for scales the water, past saturation where it must
    wet = profile_of(
        table(tmp_path, TABLE).model_copy(update={"pwv": Pwv.parse("50 mm")}), here(), NIGHT, 1
    )
    assert "taken as it is" in said(wet, "relative humidity above 100 %")


def test_water_that_an_inversion_cannot_hold_is_cut_and_said():
    cold = profile(sites.create("amundsen_scott"), Instant.parse("2024-07-01T00:00Z"))
    over = cold.h2o * cold.pressure / measures.saturation_pressure(cold.temperature)
    assert over[:8].max() <= 1 + 1e-9
    text = said(cold, "vapour near the ground")
    assert text is None or "cut to saturation at" in text
    column = Climatology().column(
        sites.create("amundsen_scott"), Instant.parse("2024-07-01T00:00Z")
    )
    wetter = dataclasses.replace(column, h2o=column.h2o * 3)
    from zonda.operators.atmosphere.weather.profiles import on_heights

    made = on_heights(wetter, sites.create("amundsen_scott"))
    assert "levels of the inversion, which takes" in said(made, "vapour near the ground")


def test_negative_water_and_ozone_of_era5_are_said(tmp_path):
    def change(values):
        values["q"][:, 3] = -1e-7
        values["o3"][:, :2] = -1e-9
        return values

    files.new_layout(tmp_path / "a.nc", change=change)
    stated = Era5(file=tmp_path / "a.nc").column(here(), NIGHT).stated
    assert "negative values of the humidity taken as none" in stated
    assert "2 negative levels of ozone taken as none" in stated
    files.new_layout(tmp_path / "b.nc")
    assert "negative" not in Era5(file=tmp_path / "b.nc").column(here(), NIGHT).stated


def test_an_error_is_given_its_place_once():
    with pytest.raises(InputError) as caught, placed("outside"):
        raise InputError("is wrong", cure="mend it")
    assert str(caught.value).startswith("outside: is wrong")
    with pytest.raises(InputError) as caught, placed("outside"):
        raise InputError("is wrong", place="inside")
    assert caught.value.place == "inside"
