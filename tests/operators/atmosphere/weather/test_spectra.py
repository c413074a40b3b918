import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import quad

from zonda.core.configuration.time import Instant
from zonda.core.errors import InputError
from zonda.core.instrument import Band
from zonda.core.numerics.radiation import rayleigh_jeans
from zonda.core.site import Site
from zonda.operators.atmosphere.model import Models
from zonda.operators.atmosphere.weather.absorption import (
    TABLE,
    AbsorptionTable,
    CrossSections,
    absorption_table,
)
from zonda.operators.atmosphere.weather.bands import BandTransfer
from zonda.operators.atmosphere.weather.climatology import profile
from zonda.operators.atmosphere.weather.radiative_transfer import (
    EARTH_RADIUS,
    Layers,
    emission,
    spectrum,
)

ROOT = Path(__file__).resolve().parents[4]
WINDOWS = (
    (30, 50),
    (75, 115),
    (125, 175),
    (200, 310),
    (330, 365),
    (390, 420),
    (600, 720),
    (780, 900),
)
ZENITH = math.pi / 2


def reference(name):
    """A file of am's results: from tests/data, or from the project's reference folder."""
    for folder in (ROOT / "tests" / "data", ROOT.parent / "shared" / "reference"):
        if (folder / name).exists():
            return np.load(folder / name)
    pytest.skip(f"reference file {name} is not here")


class Flat(Layers):
    """Plane-parallel, as am's slants are."""

    def airmass(self, elevation):
        return np.full(len(self.h2o), 1 / math.sin(elevation))


def layers(file, h2o, kind=Layers):
    close = lambda name, last: np.append(file[name].astype(float), last)  # noqa: E731
    return kind(
        pressure=close("layer_Pbase_hPa", 0.0) * 100,
        temperature=close("layer_Tbase_K", file["layer_Tbase_K"][-1]),
        h2o=h2o.astype(float),
        o3=file["o3_vmr"].astype(float),
        height=file["layer_zbase_m"].astype(float),
    )


def at(frequency, file):
    """Indices of our frequencies in am's."""
    return np.searchsorted(file["freq_GHz"], frequency / 1e9 - 1e-3)


def windows(frequency):
    return [(frequency >= a * 1e9) & (frequency <= b * 1e9) for a, b in WINDOWS]


@pytest.mark.parametrize("site", ["green_bank", "chajnantor", "south_pole"])
def test_opacity_agrees_with_am_in_every_window(site):
    # am's spectra here are sampled at points, ours are means of cells: compare medians, which skip
    # the narrow lines
    file = reference(f"am_{site}.npz")
    for h2o, tau in zip(file["h2o_vmr"], file["tau_zenith"], strict=True):
        got = spectrum(layers(file, h2o), ZENITH)
        ratio = got.opacity / tau[at(got.frequency, file)]
        for window in windows(got.frequency):
            assert np.median(abs(ratio[window] - 1)) < 0.01


@pytest.mark.parametrize("pwv", [0, 1, 2])
def test_band_mean_brightness_agrees_with_am_at_green_bank(pwv):
    file = reference("am_green_bank.npz")
    got = spectrum(layers(file, file["h2o_vmr"][pwv]), ZENITH)
    want = file["trj_zenith_K"][pwv][at(got.frequency, file)]
    for window in windows(got.frequency):
        assert got.brightness[window].mean() == pytest.approx(want[window].mean(), rel=5e-3)


@pytest.mark.parametrize("name", ["am_era5_green_bank_nov_02h.npz", "am_era5_south_pole_jul.npz"])
def test_cell_means_agree_with_am_run_at_50_mhz(name):
    file = reference(name)
    got = spectrum(layers(file, file["h2o_vmr"]), ZENITH)
    k = at(got.frequency, file)
    for window in windows(got.frequency):
        assert got.brightness[window].mean() == pytest.approx(
            file["trj_zenith_cell_K"][k][window].mean(), rel=5e-3
        )
        assert np.median(abs(got.opacity[window] / file["tau_zenith_cell"][k][window] - 1)) < 0.01


def test_slant_brightness_agrees_with_am():
    file = reference("am_green_bank.npz")
    got = spectrum(layers(file, file["h2o_vmr"][1], Flat), math.radians(30))
    want = file["trj_el30_midpwv_K"][at(got.frequency, file)]
    for window in windows(got.frequency):
        assert got.brightness[window].mean() == pytest.approx(want[window].mean(), rel=5e-3)


@pytest.mark.parametrize(
    "name", ["am_chajnantor_july_el10.npz", "am_summit_january.npz", "am_green_bank_july_el05.npz"]
)
def test_dry_wet_and_low_air_agrees_with_am_in_every_window(name):
    # 10 deg over 0.3 mm: ozone's lines saturate there, narrower than a cell
    file = reference(name)
    got = spectrum(layers(file, file["h2o_vmr"], Flat), math.radians(float(file["elevation_deg"])))
    for window in windows(got.frequency):
        assert np.median(abs(got.opacity[window] / file["tau_zenith_cell"][window] - 1)) < 0.005
        assert np.median(abs(got.brightness[window] / file["trj_cell_K"][window] - 1)) < 0.005
        assert got.brightness[window].mean() == pytest.approx(
            file["trj_cell_K"][window].mean(), rel=5e-3
        )


@pytest.mark.parametrize(
    "name", ["am_chajnantor_july_el10.npz", "am_summit_january.npz", "am_green_bank_july_el05.npz"]
)
@pytest.mark.parametrize(
    ("low", "high"),
    [
        (78, 108),
        (66, 118),
        (128, 172),
        (175, 192),
        (180, 187),
        (200, 270),
        (315, 335),
        (330, 370),
        (540, 574),
    ],
)
def test_band_means_agree_with_am(name, low, high):
    file = reference(name)
    air = layers(file, file["h2o_vmr"])
    transfer = BandTransfer(
        Band(name="flat", low=f"{low} GHz", high=f"{high} GHz"), replace(air, height=plane(air))
    )
    emitted, log_transmission = transfer(air.pwv, [math.radians(float(file["elevation_deg"]))])[0]
    edges = np.append(file["freq_GHz"] - 0.25, file["freq_GHz"][-1] + 0.25)
    running = lambda y: np.interp([low, high], edges, np.append(0, np.cumsum(y)) * 0.5)  # noqa: E731
    want, passed = (
        np.diff(running(file[key].astype(float)))[0] / (high - low)
        for key in ("trj_cell_K", "transmission_cell")
    )
    assert emitted == pytest.approx(want, rel=5e-3)
    assert math.exp(log_transmission) == pytest.approx(passed, rel=0.02, abs=1e-3)


def plane(air):
    """Heights so small that shells are planes."""
    return air.height[0] + (air.height - air.height[0]) * 1e-6


def test_airmass_of_a_profile_at_5_deg_is_the_ray_integral():
    site = Site(
        name="gb",
        latitude="38.43 deg",
        longitude="-79.84 deg",
        altitude="825 m",
        climatology="green_bank",
    )
    air = profile(site, Instant.parse("2024-07-25T07:00:00Z"))
    e, top = math.radians(5), air.height[-1]
    ground = EARTH_RADIUS + air.altitude
    for density, got in (
        (lambda h: air.at(h).vapour_density, air.layers.molecules * air.layers.h2o),
        (lambda h: air.at(h).pressure / air.at(h).temperature, air.layers.molecules),
    ):
        s = np.linspace(
            0,
            math.sqrt((ground + top) ** 2 - (ground * math.cos(e)) ** 2) - ground * math.sin(e),
            400_001,
        )[:-1]
        h = (
            np.sqrt(ground**2 + s**2 + 2 * ground * s * math.sin(e)) - ground
        )  # along the straight ray, by the cosine rule
        vertical = np.linspace(0, top, 400_001)
        want = np.trapezoid(density(np.minimum(h, top)), s) / np.trapezoid(
            density(vertical), vertical
        )
        airmass = (got * air.layers.airmass(e)).sum() / got.sum()
        assert airmass == pytest.approx(want, rel=2e-3)


def test_ozone_and_dry_air_are_there():
    file = reference("am_green_bank.npz")
    dry = layers(file, 0 * file["h2o_vmr"][0])
    got = spectrum(dry, ZENITH)
    want = file["tau_zenith_dry"][at(got.frequency, file)]
    window = windows(got.frequency)[1]
    assert np.median(abs(got.opacity[window] / want[window] - 1)) < 0.01
    without = Layers(dry.pressure, dry.temperature, dry.h2o, 0 * dry.o3, dry.height)
    assert (spectrum(without, ZENITH).opacity <= got.opacity).all()
    line = np.argmin(abs(got.frequency - 110.8e9))  # ozone 6(0,6)-5(1,5) at 110.836 GHz
    assert got.opacity[line] - spectrum(without, ZENITH).opacity[line] > 3e-3


def simple(n=20, temperature=250.0):
    pressure = np.append(1e5 * 0.7 ** np.arange(n), 0.0)
    return Layers(
        pressure,
        np.full(n + 1, temperature),
        np.full(n, 2e-3),
        np.full(n, 1e-7),
        np.linspace(0, 60e3, n + 1),
    )


def test_isothermal_air_radiates_as_it_absorbs():
    air = simple()
    got = spectrum(
        replace(air, o3=0 * air.o3), math.radians(40)
    )  # without lines that are narrower than cells
    want = rayleigh_jeans(got.frequency, 250.0) * -np.expm1(-got.slant_opacity)
    np.testing.assert_allclose(got.brightness, want, rtol=1e-12)


@pytest.mark.parametrize("opacity", [1e-9, 1e-3, 0.3, 5.0, 200.0])
def test_source_linear_in_opacity_is_integrated_exactly(opacity):
    want = quad(
        lambda t: (280 - 60 * t / opacity) * math.exp(-t),
        0,
        min(opacity, 60),
        epsabs=0,
        epsrel=1e-12,
    )[0]
    got = emission(np.full((1, 1), opacity), np.array([[280.0], [220.0]]))
    assert got[0] == pytest.approx(want, rel=1e-9)
    split = emission(np.full((4, 1), opacity / 4), np.linspace(280, 220, 5)[:, None])
    assert split[0] == pytest.approx(want, rel=1e-9)


def test_transparent_and_opaque_air_give_no_nan():
    nothing = emission(np.zeros((3, 2)), np.full((4, 2), 250.0))
    assert (nothing == 0).all()
    opaque = spectrum(simple(), math.radians(5), low=550e9, high=560e9)
    assert opaque.slant_opacity.max() > 700
    assert np.isfinite(opaque.brightness).all()
    assert (opaque.cmb >= 0).all()


def test_background_is_attenuated_planck():
    got = spectrum(simple(), ZENITH, low=89e9, high=91e9)
    np.testing.assert_allclose(
        got.cmb, rayleigh_jeans(got.frequency, 2.72548) * np.exp(-got.opacity), rtol=1e-14
    )
    assert got.cmb.max() < 1.12


def test_airmass_is_one_at_zenith_and_spherical_below():
    air = simple()
    np.testing.assert_allclose(air.airmass(ZENITH), 1.0, rtol=1e-15)
    for degrees, low, high in ((60, 0.99, 1.0), (20, 0.95, 1.0)):
        ratio = air.airmass(math.radians(degrees)) * math.sin(math.radians(degrees))
        assert (ratio[:5] < high).all()
        assert (ratio[:5] > low).all()
    # a shell's path by the sagitta: the chord to height h seen at elevation e is sqrt((R+h)^2 - R^2
    # cos^2 e) - R sin e
    e, h = math.radians(5), np.array([1999.0, 2001.0])
    chord = np.sqrt((EARTH_RADIUS + h) ** 2 - (EARTH_RADIUS * math.cos(e)) ** 2)
    shell = Layers(
        np.array([1e5, 9.9e4, 9.8e4]),
        np.full(3, 280.0),
        np.zeros(2),
        np.zeros(2),
        np.array([0.0, 1999.0, 2001.0]),
    )
    assert shell.airmass(e)[1] == pytest.approx((chord[1] - chord[0]) / 2, rel=1e-9)
    assert (
        1.02 < 1 / math.sin(e) / shell.airmass(e)[1] < 1.07
    )  # the 2-7 % of plane-parallel air at 5 deg


def test_interpolation_passes_through_the_table():
    table = absorption_table()
    file = np.load(TABLE)
    code = np.cumsum(file["difference"], axis=-1, dtype=np.uint16)
    for i, k in ((3, 1), (12, 4)):
        got = table.cross_sections(table.pressure[[i]], table.temperature[i, [k]])
        want = (
            np.exp(
                file["low"][:, 0, 0]
                + code[:, i, k] / 65535 * (file["high"] - file["low"])[:, 0, 0].astype(float)
            )
            * 1e-4
        )
        np.testing.assert_allclose(got.dry_air[0], want[0], rtol=1e-5)
        np.testing.assert_allclose(got.water[0], want[1], rtol=1e-5)
        np.testing.assert_allclose(got.water[0] + 0.02 * got.water_self[0], want[2], rtol=1e-5)
        np.testing.assert_allclose(got.ozone[0], want[3], rtol=1e-5)


def test_a_part_of_the_table_is_the_table():
    whole, part = spectrum(simple(), ZENITH), spectrum(simple(), ZENITH, low=78e9, high=108e9)
    inside = np.isin(whole.frequency, part.frequency)
    np.testing.assert_array_equal(part.brightness, whole.brightness[inside])
    assert part.frequency[0] == 78e9
    assert part.frequency[-1] == 108e9


@pytest.mark.parametrize("pwv", [0.0, 1e-4, 7.7e-3, 6e-2])
def test_water_scales_to_the_wanted_column(pwv):
    assert simple().scaled(pwv).pwv == pytest.approx(pwv, rel=1e-13)


def test_limits_are_named():
    with pytest.raises(InputError, match=r"4\.00 deg leave the limits .* 4.5 to 90 deg"):
        spectrum(simple(), math.radians(4))
    with pytest.raises(
        InputError, match=r"not inside the range of the absorption table, 0\.75 to 1000\.25 GHz"
    ):
        spectrum(simple(), ZENITH, low=900e9, high=1100e9)
    hot = simple(temperature=400.0)
    with pytest.raises(InputError, match=r"temperature of 400\.0 K .* limits there, \d+ to \d+ K"):
        spectrum(hot, ZENITH)
    deep = Layers(
        np.array([3e5, 1e5]), np.full(2, 280.0), np.zeros(1), np.zeros(1), np.array([0.0, 1e4])
    )
    with pytest.raises(InputError, match=r"pressure of 2000 hPa is above .* limit of 1158\.7 hPa"):
        spectrum(deep, ZENITH)


class Thin(AbsorptionTable):
    """Half of everything."""

    def cross_sections(self, pressure, temperature, cells=slice(None)):
        k = super().cross_sections(pressure, temperature, cells)
        return CrossSections(
            k.dry_air / 2, k.water / 2, k.water_self / 2, k.ozone / 2, k.ozone_ratio
        )


def test_spectra_are_plugins():
    import zonda
    from zonda.core.errors import ZondaError
    from zonda.core.registry import instruments, sites, spectra

    spectra.register(lambda: Thin(TABLE), name="thin")
    spectra.register(lambda: "no table", name="wrong")
    observation = SimpleNamespace(
        site=sites.create("green_bank"),
        start=Instant.parse("2024-11-25T07:00:00Z"),
        seed=1,
        name="scan",
        instrument=instruments.create("mustang2"),
    )
    depths = {}
    for name in ("am", "thin"):
        _, band = Models().weather(zonda.AtmosphereLayers(pwv="5 mm", spectra=name), observation)
        depths[name] = float(band.opacity(5e-3, 1.0))
    # the band's mean of e^-tau is not linear in tau: a little more than half
    assert depths["thin"] / depths["am"] == pytest.approx(0.5, abs=0.02)
    with pytest.raises(ZondaError, match="'wrong' is str, not an AbsorptionTable"):
        Models().weather(zonda.AtmosphereLayers(pwv="5 mm", spectra="wrong"), observation)
    with pytest.raises(ValueError, match="unknown spectra 'thim'"):
        zonda.AtmosphereLayers(pwv="5 mm", spectra="thim")
