import math
from pathlib import Path

import numpy as np
import pytest

from zonda.core.configuration.time import Instant
from zonda.core.errors import InputError
from zonda.core.site import Site
from zonda.operators.atmosphere.weather import climatology, profiles
from zonda.operators.atmosphere.weather.climatology import (
    climatologies,
    coefficients,
    harmonics,
    profile,
)
from zonda.operators.atmosphere.weather.radiative_transfer import spectrum

ROOT = Path(__file__).resolve().parents[4]
NOVEMBER = Instant.parse("2024-11-25T07:00:00Z")


def reference(name):
    for folder in (ROOT / "tests" / "data", ROOT.parent / "shared" / "reference"):
        if (folder / name).exists():
            return np.load(folder / name)
    pytest.skip(f"reference file {name} is not here")


def site(climatology="green_bank", altitude=825.0):
    return Site(
        name="here",
        latitude="38 deg",
        longitude="-80 deg",
        altitude=f"{altitude} m",
        climatology=climatology,
    )


def monthly_pwv(where):
    """(12,) mm, mean of four hours on the 15th."""
    times = [
        [Instant.parse(f"2023-{m:02d}-15T{h:02d}:00Z") for h in (0, 6, 12, 18)]
        for m in range(1, 13)
    ]
    return np.array([[profile(where, t).pwv * 1e3 for t in month] for month in times]).mean(axis=1)


# Annual medians of ERA5 (shared/atmosphere.md); the fit's own PWV error is up to 8 % rms.
@pytest.mark.parametrize(
    ("name", "altitude", "low", "high"),
    [
        ("green_bank", 825, 12.1, 12.7),
        ("chajnantor", 5064, 1.1, 1.3),
        ("south_pole", 2835, 0.39, 0.40),
        ("mauna_kea", 4092, 1.6, 1.9),
        ("sierra_negra", 4640, 4.1, 4.6),
        ("pico_veleta", 2850, 4.2, 4.2),
    ],
)
def test_annual_median_of_the_water_column(name, altitude, low, high):
    assert low / 1.06 < np.median(monthly_pwv(site(name, altitude))) < high * 1.06


def test_green_bank_around_the_year():
    np.testing.assert_allclose(
        monthly_pwv(site())[::2], [6.5, 7.7, 18.7, 29.3, 23.8, 8.5], rtol=0.11
    )


@pytest.mark.parametrize("name", ["green_bank", "chajnantor", "south_pole"])
def test_fit_follows_era5(name):
    era5 = reference(f"weathergen_{name}.npz")
    keys = {
        "temperature": "temperature_K",
        "wind_east": "wind_east_ms",
        "wind_north": "wind_north_ms",
        "height": "height_m",
    }
    limit = {"temperature": 0.9, "wind_east": 2.0, "wind_north": 2.0, "height": 30.0}
    for quantity, key in keys.items():
        fitted = coefficients(name)[quantity]
        want = (
            era5[key][..., : fitted.shape[1]]
            if quantity == "height"
            else era5[key][..., : fitted.shape[1], 2]
        )
        got = np.array(
            [[harmonics(d, h) @ fitted for h in era5["utc_hour"]] for d in era5["year_day"]]
        )
        assert np.sqrt(np.mean((got - want) ** 2)) < limit[quantity]
    vapour = era5["water_vapor_raw_kg_m3"][..., 2] * era5["rh_water_to_mixed_correction"]
    fitted = coefficients(name)["log_vapour_density"]
    got = np.array([[harmonics(d, h) @ fitted for h in era5["utc_hour"]] for d in era5["year_day"]])
    assert np.sqrt(np.mean((got - np.log(vapour[..., : fitted.shape[1]]))[..., :8] ** 2)) < 0.12


@pytest.mark.parametrize(("low", "high"), [(78, 108), (66, 118), (140, 160), (200, 270)])
def test_brightness_of_the_november_night_agrees_with_am_on_era5(low, high):
    # ERA5's own profile of that night against our fit of it, at the same water column: 1.5 % allows
    # for the fit's 1.5 K
    file = reference("am_era5_green_bank_nov_02h.npz")
    ours = profile(site(), Instant.parse("2023-11-21T07:30:00Z"), pwv=7.65e-3)
    got = spectrum(ours.layers, math.pi / 2, low=low * 1e9, high=high * 1e9).brightness.mean()
    band = (file["freq_GHz"] >= low) & (file["freq_GHz"] <= high)
    assert got == pytest.approx(file["trj_zenith_cell_K"][band].mean(), rel=0.015)
    assert ours.pressure[0] == pytest.approx(file["layer_Pbase_hPa"][0] * 100, rel=2e-3)


def test_profile_goes_from_the_ground_to_45_km_and_is_physical():
    air = profile(site(), NOVEMBER)
    assert 50 <= len(air.height) <= 61
    assert air.height[0] == 0
    assert air.height[-1] >= 45e3
    assert (np.diff(air.height) > 0).all()
    assert (np.diff(air.pressure) < 0).all()
    assert (air.temperature > 180).all()
    assert (air.temperature < 310).all()
    assert (air.h2o > 0).all()
    assert (air.h2o < 0.05).all()
    assert 15e3 < air.height[np.argmax(air.o3)] < 40e3  # the ozone layer
    # hydrostatic: the pressure's scale height is R T / g M within the climatology's own consistency
    scale = -np.diff(air.height) / np.diff(np.log(air.pressure))
    np.testing.assert_allclose(
        scale, 287.05 * (air.temperature[1:] + air.temperature[:-1]) / 2 / 9.80665, rtol=0.02
    )
    # the same water by mass of air and by height
    assert np.trapezoid(air.vapour_density, air.height) / 1e3 == pytest.approx(air.pwv, rel=0.01)


def test_layers_converge(monkeypatch):
    got = spectrum(
        profile(site(), NOVEMBER, 7.7e-3).layers, math.pi / 2, low=78e9, high=108e9
    ).brightness.mean()
    monkeypatch.setattr(profiles, "LEVELS", 481)
    fine = spectrum(
        profile(site(), NOVEMBER, 7.7e-3).layers, math.pi / 2, low=78e9, high=108e9
    ).brightness.mean()
    assert got == pytest.approx(fine, abs=0.04)


def test_year_and_day_close():
    for a, b in (
        ("2022-12-31T23:59:59Z", "2023-01-01T00:00:01Z"),
        ("2023-06-01T23:59:59Z", "2023-06-02T00:00:01Z"),
    ):
        before, after = (profile(site(), Instant.parse(t)) for t in (a, b))
        np.testing.assert_allclose(before.temperature, after.temperature, atol=1e-3)
        np.testing.assert_allclose(before.wind_east, after.wind_east, atol=1e-3)


@pytest.mark.parametrize("pwv", [0.0, 1e-5, 7.7e-3, 60e-3])
def test_water_is_scaled_to_what_was_asked(pwv):
    air = profile(site(), NOVEMBER, pwv)
    assert air.pwv == pytest.approx(pwv, rel=1e-12)
    assert np.isfinite(air.vapour_density).all()
    np.testing.assert_array_equal(air.temperature, profile(site(), NOVEMBER).temperature)
    assert np.isfinite(spectrum(air.layers, math.pi / 2).brightness).all()


def test_values_between_heights():
    air = profile(site(), NOVEMBER)
    on = air.at(air.height)
    for name in ("pressure", "temperature", "vapour_density", "wind_east", "wind_north"):
        np.testing.assert_allclose(getattr(on, name), getattr(air, name), rtol=1e-12)
    h = (air.height[3] + air.height[4]) / 2
    middle = air.at([[h]])
    assert middle.wind_east.shape == (1, 1)
    assert middle.wind_east[0, 0] == pytest.approx((air.wind_east[3] + air.wind_east[4]) / 2)
    assert middle.vapour_density[0, 0] == pytest.approx(
        math.sqrt(air.vapour_density[3] * air.vapour_density[4])
    )
    assert profile(site(), NOVEMBER, 0.0).at(1000.0).vapour_density == 0
    for wrong in (-1.0, 47e3, math.nan):
        with pytest.raises(InputError, match="outside the profile, 0 to 46000 m"):
            air.at(wrong)


def test_every_climatology_gives_air():
    assert "green_bank" in climatologies()
    for name in climatologies():
        ground = float(coefficients(name)["height"][0, 0])
        air = profile(site(name, max(ground, 0.0)), NOVEMBER)
        assert 0 < air.pwv < profiles.PWV_MAX
        assert np.isfinite(spectrum(air.layers, math.pi / 2).brightness).all()


def test_stratosphere_is_dry_and_its_ozone_has_seasons():
    # 5 ppm of water is known from satellites; rounded relative humidities would make 50 to 300 ppm
    # at 10 hPa
    for name in climatologies():
        air = profile(site(name, max(float(coefficients(name)["height"][0, 0]), 0.0)), NOVEMBER)
        assert air.h2o[air.pressure < 9000].max() < 5.5e-6
    winter, spring = (
        profile(site("south_pole", 2835), Instant.parse(f"2023-{m}-10T00:00Z"))
        for m in ("06", "10")
    )
    at = np.argmin(abs(winter.pressure - 5000))
    assert spring.o3[at] < 0.5 * winter.o3[at]  # the ozone hole


@pytest.mark.parametrize("name", ["south_pole", "summit_station"])
def test_ice_sheets_have_their_inversion_in_winter(name):
    winter, summer = ("07", "01") if name == "south_pole" else ("01", "07")
    ground = {"south_pole": 2835, "summit_station": 3216}[name]
    cold, warm = (
        profile(site(name, ground), Instant.parse(f"2023-{m}-15T00:00Z")) for m in (winter, summer)
    )
    assert 5 < cold.at(500.0).temperature - cold.temperature[0] < 20
    assert abs(warm.at(500.0).temperature - warm.temperature[0]) < 7
    # no more vapour than saturates that air over ice, and above the inversion as before
    assert cold.vapour_density[0] < cold.at(300.0).vapour_density


def test_water_has_one_width_below_its_median_and_another_above():
    law = profiles.PwvDistribution(10e-3, 0.6, 0.4)
    half = 0.6744897501960817  # quartile of the normal law
    assert law.at(0.25) == pytest.approx(10e-3 * math.exp(-0.6 * half), rel=1e-3)
    assert law.at(0.75) == pytest.approx(10e-3 * math.exp(0.4 * half), rel=1e-3)
    assert law.sigma == pytest.approx(0.5)
    assert profiles.PwvDistribution(40e-3, 0.3, 0.9).at(1 - 1e-12) <= profiles.PWV_MAX


def test_data_are_small():
    assert sum(path.stat().st_size for path in climatology.CLIMATOLOGY.parent.glob("*.npz")) < 3e6


def test_bad_requests_name_cause_and_cure():
    with pytest.raises(
        InputError, match=r"site 'here': has no climatology(.|\n)*zonda plugins(.|\n)*green_bank"
    ):
        profile(site(None), NOVEMBER)
    with pytest.raises(
        InputError, match=r"climatology 'atlantis' does not exist\n.*choose one of: .*green_bank"
    ):
        profile(site("atlantis"), NOVEMBER)
    with pytest.raises(
        InputError,
        match="lies at 100 m, more than 500 m below the lowest level of climatology 'chajnantor'",
    ):
        profile(site("chajnantor", 100), NOVEMBER)
    for pwv in (-1e-3, 61e-3, math.nan):
        with pytest.raises(InputError, match="outside the limits, 0 to 60 mm"):
            profile(site(), NOVEMBER, pwv)
        with pytest.raises(InputError, match="outside the limits, 0 to 60 mm"):
            profile(site(), NOVEMBER).scaled(pwv)


def test_the_mean_of_a_layer_where_the_vapour_pressure_does_not_change():
    """r = r0 p0 / p between p0 and p1: its mean over mass is r0 p0 ln(p0 / p1) / (p0 - p1), and
    next to it nearly the same.
    """
    pressure, r0 = np.array([900.0, 700.0]), 3e-3
    exact = r0 * 900.0 * math.log(900.0 / 700.0) / 200.0
    for power in (-1.0, -1.0 + 1e-12, -1.0 - 1e-9):
        mixing_ratio = np.array([r0, r0 * (700.0 / 900.0) ** power])
        assert profiles._layer_mean(pressure, mixing_ratio)[0] == pytest.approx(exact, rel=1e-9)
    # another power against the trapezium rule over 1e4 parts, whose error is 1e-9 here
    p = np.linspace(700.0, 900.0, 10_001)
    mixing_ratio = np.array([r0, r0 * (700.0 / 900.0) ** 3.0])
    mean = np.trapezoid(r0 * (p / 900.0) ** 3.0, p) / 200.0
    assert profiles._layer_mean(pressure, mixing_ratio)[0] == pytest.approx(mean, rel=1e-8)
