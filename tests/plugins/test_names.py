"""The sites, instruments and bands that come with zonda."""

import csv
import tomllib
from pathlib import Path

import numpy as np
import pytest

from zonda.core.registry import bands, instruments, sites
from zonda.operators.atmosphere.weather.climatology import climatologies
from zonda.plugins import bands as band_table
from zonda.plugins import cameras
from zonda.plugins import instruments as instrument_table
from zonda.plugins import sites as site_table

ROOT = Path(__file__).resolve().parents[2]
POINTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
ALL = {"zonda.sites": site_table, "zonda.instruments": instrument_table, "zonda.bands": band_table}


@pytest.mark.parametrize("group", ALL)
def test_every_name_has_its_entry_point(group):
    module = ALL[group]
    survey = {name: f"{cameras.__name__}:{name}" for name in dir(cameras)} if group == "zonda.instruments" else {}
    assert POINTS[group] == {name: f"{module.__name__}:{name}" for name in dir(module)} | survey
    with pytest.raises(AttributeError, match="no attribute 'nowhere'"):
        _ = module.nowhere


def test_sites_of_the_reference():
    path = ROOT.parent / "shared" / "reference" / "sites.csv"
    if not path.exists():
        pytest.skip(f"reference file {path.name} is not here")
    with path.open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            site = sites.create(row["site"])
            assert np.degrees([site.latitude, site.longitude]) == pytest.approx(
                [float(row["latitude_deg"]), float(row["longitude_deg"])]
            )
            assert site.altitude == float(row["altitude_m"])
            region = row["weathergen_region"]
            assert site.climatology == (region if region in climatologies() else None)


def test_every_site():
    used = {sites.create(name).climatology for name in sites if name in dir(site_table)}
    assert used - {None} == set(climatologies())
    for name in dir(site_table):
        site = sites.create(name)
        assert site.provenance
        assert site.description
    assert sites.create("chajnantor") == sites.create("llano_de_chajnantor")
    assert sites.create("south_pole").name == "amundsen_scott"


@pytest.mark.parametrize("name", sorted(instrument_table.names()))
def test_every_instrument(name):
    made = instruments.create(name)
    assert made.provenance
    assert made.band == bands.create(made.band.name)
    limit = 1.22 * 299792458 / made.band.centre / made.telescope.diameter
    assert 0.8 * limit < made.beam_fwhm < 1.8 * limit  # measured beams: dishes are not evenly illuminated
    plane = made.focalplane()
    assert len(plane) == made.detectors
    assert 2 * np.arctan(plane.radius) == pytest.approx(made.field_of_view, rel=1e-9)


@pytest.mark.parametrize("name", sorted(cameras.CAMERAS))
def test_every_camera_of_several_bands(name):
    made, table = instruments.create(name), cameras.CAMERAS[name]
    assert "stand-in: " in made.provenance
    assert made.telescope.site in sites
    plane, pixels = made.focalplane(), {}
    for k, (channel, (band, camera)) in enumerate(zip(table.channels, made.cameras.items(), strict=True)):
        rows = plane.of_band(k)
        assert (band, len(rows)) == (channel.name, channel.detectors)
        assert set(np.bincount(rows.wafer)) == {channel.detectors // table.wafers}
        limit = 1.22 * 299792458 / camera.band.centre / made.telescope.diameter
        assert 0.75 * limit < camera.beam_fwhm < 1.8 * limit  # published ones; of so_sat_lf 0.78
        pixels[band] = {*zip(rows.xi.tolist(), rows.eta.tolist(), strict=True)}
    alike = len({frozenset(places) for places in pixels.values()}) == 1
    assert alike == (made.pixels == "shared")
    # arrays side by side stand about the middle of all, so that the farthest detector is not quite at the edge
    assert 2 * np.arctan(plane.radius) == pytest.approx(made.field_of_view, rel=0.1 if made.pixels == "separate" else 1e-9)
    assert plane.polarized


def test_nets_of_the_cmb_are_turned_into_rayleigh_jeans():
    # dT_RJ / dT_CMB = x^2 e^x / (e^x - 1)^2 with x = h nu / k T_CMB
    x = 6.62607015e-34 * 92e9 / (1.380649e-23 * 2.72548)
    factor = x**2 * np.exp(x) / np.expm1(x) ** 2
    assert instruments.create("so_lat_mf").cameras["f090"].net == pytest.approx(361e-6 * factor, rel=1e-3)  # of 4 digits


def test_atlast_is_the_papers():
    made = instruments.create("atlast")
    assert (made.detectors, made.net, made.sample_rate, made.telescope.diameter) == (3000, 0.266e-3, 225.0, 50.0)
    assert (made.main_beam_efficiency, made.illumination_efficiency) == (0.3, 0.8)
    assert np.degrees([made.field_of_view, made.beam_fwhm * 3600]) == pytest.approx([0.25, 16])
    assert np.degrees([made.telescope.speed_max, made.telescope.acceleration_max]) == pytest.approx([3, 1])
    assert made.band.centre == pytest.approx(92e9)
    assert instruments.create("atlast_full").detectors == 200_000


@pytest.mark.parametrize(
    ("name", "metres", "degrees"),
    [
        ("gbt", 100, 4.2 / 60),
        ("lmt", 50, 4 / 60),
        ("act", 6, 0.9),
        ("so_lat", 6, 7.8),
        ("so_sat", 0.42, 35),
        ("spt", 10, 1.9),
        ("fyst", 6, 1.3),
        ("cmb_s4", 6, 7.8),
        ("apex", 12, 0.19),
    ],
)
def test_apertures_and_fields(name, metres, degrees):
    made = instruments.create(name)
    assert made.telescope.diameter == metres
    assert np.degrees(made.field_of_view) == pytest.approx(degrees)
