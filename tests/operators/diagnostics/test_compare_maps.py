"""`CompareMaps` and `MapSpectrum` in a run, and what they write, draw and refuse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS
from matplotlib.figure import Figure

import zonda
import zonda.testing
from zonda.core.assembly.checks import run_checks
from zonda.core.errors import PipelineError
from zonda.core.maps.image import Image
from zonda.core.maps.map_product import MapProduct
from zonda.core.numerics.sphere import ARCSEC
from zonda.operators.diagnostics.compare_maps import CompareMaps
from zonda.operators.diagnostics.comparison.files import plane_of, read_planes
from zonda.operators.diagnostics.comparison.radial import radial_spectra
from zonda.operators.diagnostics.comparison.statistics import compare
from zonda.operators.diagnostics.comparison_plots import draw_comparison, plot_radial_spectra
from zonda.operators.diagnostics.map_spectra import MapSpectrum
from zonda.operators.diagnostics.plot_operators import Plots
from zonda.plugins.checks import scenes

SIDE, PIXEL, BEAM = 64, 2.0, 9.0


def world():
    return {
        "CTYPE1": "RA---TAN",
        "CTYPE2": "DEC--TAN",
        "CUNIT1": "deg",
        "CUNIT2": "deg",
        "RADESYS": "ICRS",
        "CRVAL1": 75.0,
        "CRVAL2": 20.0,
        "CRPIX1": 32.5,
        "CRPIX2": 32.5,
        "CDELT1": -PIXEL / 3600,
        "CDELT2": PIXEL / 3600,
    }


def source(fwhm):
    y, x = (np.indices((SIDE, SIDE)) - 31.5) * PIXEL
    return 1e-3 * (30.0 / fwhm) ** 2 * np.exp(-4 * np.log(2) * (x**2 + y**2) / fwhm**2)


def product(signal, half=None, noise=1e-5):
    hits = np.full((SIDE, SIDE), 50)
    return MapProduct(
        signal,
        hits,
        hits * 1e6,
        np.full((SIDE, SIDE), noise),
        half,
        world(),
        (np.radians(75.0), np.radians(20.0)),
        PIXEL * ARCSEC,
        fwhm=BEAM * ARCSEC,
    )


def data(tmp_path, products):
    made = zonda.Data(scenes.scene())
    made.output = tmp_path
    made.products.update(products)
    return made


@pytest.fixture
def products():
    """The input is what the map shows before the beam; the map has 80 % of it and white noise of 10
    uK.
    """
    rng = np.random.default_rng(2)
    wide = np.hypot(30.0, BEAM)
    noise, half = 1e-5 * rng.standard_normal((2, SIDE, SIDE))
    signal = 0.8 * source(wide)
    return {
        "input": Image(source(30.0), world()),
        "map": product(signal + noise, half),
        "noiseless/map": product(signal),
        "source_free/map": product(noise),
    }


def test_contract():
    zonda.testing.check_operator(CompareMaps())
    zonda.testing.check_operator(MapSpectrum())


def test_the_input_with_the_beam_is_the_reference(tmp_path, products):
    """A map with 80 % of a source of 30 arcsec: the gain is 0.8 once the input has the map's
    resolution.

    White noise of 10 uK averages over the 540 pixels of the source to 1e-5 / 1e-3 / sqrt(540) =
    4e-4 of it.
    """
    run = data(tmp_path, products)
    CompareMaps().finalize(run)
    found = run.products["comparison"]
    assert found.values["gain"] == pytest.approx(0.8, abs=4e-3)
    assert found.fwhm == pytest.approx(np.sqrt(2) * BEAM * ARCSEC)
    CompareMaps(map="noiseless/map", name="filtered").finalize(run)
    assert run.products["filtered"].values["gain"] == pytest.approx(0.8, abs=1e-3)
    with fits.open(tmp_path / "comparison.fits") as hdus:
        names = [hdu.name for hdu in hdus]
        assert names == ["REFERENCE", "MAP", "DIFFERENCE", "FIDELITY", "SNR"]
        np.testing.assert_array_equal(hdus[2].data, hdus[1].data - hdus[0].data)
        assert hdus[0].header["BUNIT"] == "K"
        assert hdus[0].header["BMAJ"] * 3600 == pytest.approx(np.sqrt(2) * BEAM)
    table = Table.read(tmp_path / "comparison_spectra.ecsv")
    assert table.meta["GAIN"] == pytest.approx(found.values["gain"], rel=1e-6)
    np.testing.assert_allclose(table["difference"], found.spectra.power["difference"], rtol=1e-8)
    assert {"radius", "map", "map_error"} <= set(
        Table.read(tmp_path / "comparison_profiles.ecsv").colnames
    )


def test_noise_of_the_half_difference(products):
    """Half-difference and noise of the same rms: a factor of 1 within its error; three times the
    noise: three.
    """
    whole, half = products["map"], (products["map"].half_difference, "half the difference")
    plane = plane_of(whole, "map", half).measured()
    # 4096 pixels: the rms is known to 1 / sqrt(8192) = 1.1 %
    assert plane.noise[20, 20] == pytest.approx(1e-5, rel=0.05)
    loud = plane_of(whole, "map", (3 * half[0], "half the difference")).measured()
    assert loud.noise[20, 20] == pytest.approx(3 * plane.noise[20, 20], rel=1e-9)
    unknown = plane_of(product(whole.signal, noise=np.nan), "map", half).measured()
    assert unknown.noise[20, 20] == pytest.approx(plane.noise[20, 20], rel=1e-9)


def test_a_file_as_reference(tmp_path, products):
    path = tmp_path / "ref.fits"
    hdu = fits.PrimaryHDU(1e3 * products["noiseless/map"].signal)
    hdu.header.update(
        world() | {"BUNIT": "mK", "TEMPSCAL": "K_RJ", "BMAJ": BEAM / 3600, "BMIN": BEAM / 3600}
    )
    hdu.writeto(path)
    run = data(None, products)
    CompareMaps(map="noiseless/map", file=str(path)).finalize(run)
    assert run.products["comparison"].values["gain"] == pytest.approx(1.0, abs=1e-9)
    assert run.products["comparison"].values["rms difference"] < 1e-15


def test_map_spectrum(tmp_path, products):
    run = data(tmp_path, products)
    MapSpectrum(bins=8).finalize(run)
    found = run.products["map_spectra"]
    assert set(found.spectra.power) == {"map", "half_difference", "source_free/map"}
    level = (1e-5 * PIXEL * ARCSEC) ** 2
    np.testing.assert_allclose(found.spectra.white["map"], level, rtol=1e-12)
    s = found.spectra
    good = s.modes > 2
    score = (s.power["source_free/map"] / level - 1) * np.sqrt(s.modes)
    assert np.abs(score[good]).max() < 4
    assert "source_free_map" in Table.read(tmp_path / "map_spectra.ecsv").colnames
    assert found.names["half_difference"] == "half the difference, even - odd scans"
    run.products = run.products | {
        "map": replace(products["map"], difference="even - odd detectors")
    }
    MapSpectrum(bins=8).finalize(run)
    assert (
        run.products["map_spectra"].names["half_difference"]
        == "half the difference, even - odd detectors"
    )
    MapSpectrum(bins=8, maps=["noiseless/map"]).finalize(run)
    assert set(run.products["map_spectra"].spectra.white) == set()


def test_the_white_level_of_a_smoothed_map_is_that_of_its_pixels_before(tmp_path, products):
    """The noise that a smoothed map states is that behind the smoothing, sqrt(4 pi) sigma / pixel
    times smaller.
    """
    noise = np.random.default_rng(5).standard_normal((SIDE, SIDE)) * 1e-5
    run = data(tmp_path, {"map": product(noise).smoothed(BEAM * ARCSEC)})
    MapSpectrum(bins=16).finalize(run)
    s = run.products["map_spectra"].spectra
    good = (s.modes > 2) & (
        s.scale > 1.2 * BEAM * ARCSEC
    )  # beyond, less than 1 % of the power is left
    assert np.count_nonzero(good) >= 3
    score = (s.power["map"] / s.white["map"] - 1) * np.sqrt(s.modes)
    assert np.abs(score[good]).max() < 4


def test_rings_without_modes_have_no_white_level_and_are_drawn():
    values = np.random.default_rng(2).standard_normal((2, 5))
    edges = (
        np.array([0.15, 0.22, 0.24, 0.5]) / ARCSEC
    )  # modes of 5 pixels are 0.2 apart, of 2 pixels 0.5
    found = radial_spectra(
        {"map": values}, np.ones((2, 5)), ARCSEC, edges, {"map": np.ones((2, 5))}
    )
    assert np.isfinite(found.white["map"]).tolist() == [True, False, True]
    ax = plot_radial_spectra(Figure().add_subplot(), found, "K_RJ")
    assert np.isfinite(ax.get_ylim()).all()


def test_what_is_missing_is_named(tmp_path, products):
    run = data(tmp_path, products)
    with pytest.raises(PipelineError, match="there is no map 'mpa'") as caught:
        CompareMaps(map="mpa").finalize(run)
    assert "noiseless/map" in caught.value.cure
    with pytest.raises(PipelineError, match="no TAN map 'mpa'"):
        MapSpectrum(maps=["mpa"]).finalize(run)


def test_pictures(tmp_path, products):
    run = data(tmp_path, products)
    CompareMaps().finalize(run)
    MapSpectrum().finalize(run)
    Plots(dpi=60).finalize(run)
    names = {p.name for p in run.products["pictures"]}
    assert {"comparison", "comparison_quality", "comparison_spectra", "map_spectra", "map"} <= names
    for name in names:
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert not list(tmp_path.glob("*.pdf"))
    axes = draw_comparison("comparison", run.products["comparison"])[0].ax.figure.axes
    one, other, difference = (
        ax.images[0] for ax in axes if ax.images[:1] and hasattr(ax, "coords")
    )
    assert (one.cmap.name, one.get_clim()) == (other.cmap.name, other.get_clim())
    assert difference.cmap.name == "RdBu_r"
    assert difference.get_clim()[0] == -difference.get_clim()[1]


@pytest.mark.parametrize(
    ("maps", "step", "message"),
    [
        (
            [{"projection": "CAR", "pixel": "4 arcsec"}],
            MapSpectrum(),
            "no TAN or HEALPix map of the signal",
        ),
        ([{"contents": "hits"}], MapSpectrum(maps=["map"]), "no TAN map 'map'"),
        (
            [{"nside": 64}, {"nside": 32, "product": "b"}],
            MapSpectrum(maps=["map", "b"]),
            "HEALPix maps are of one map at a time",
        ),
        (
            [{"nside": 64}, {"product": "b"}],
            MapSpectrum(maps=["b", "source_free/map"]),
            "HEALPix maps are of one map at a time",
        ),
        ([{"nside": 64}], zonda.TransferFunction(), "needs a TAN map of the signal"),
        ([{"projection": "CAR", "pixel": "4 arcsec"}, {"product": "b"}], MapSpectrum(), ""),
        ([{"nside": 64}, {"product": "b"}], MapSpectrum(maps=["map"]), ""),
        ([{"nside": 64}, {"product": "b"}], zonda.TransferFunction(map="b"), ""),
    ],
)
def test_maps_that_do_not_suit_are_refused_before_the_run(maps, step, message):
    sky = zonda.SkyMap(map=source(9.0), wcs=WCS(world()), unit="K_RJ")
    steps = [zonda.PointingDaisy(scan_duration="2 s"), sky, zonda.WhiteNoise(), zonda.Efficiency()]
    steps += [zonda.BinMap(**given) for given in maps]
    pipeline = zonda.Pipeline(
        [*steps, step], runs={"source_free": {"without": ["sky"], "modes": "full"}}
    )
    if not message:
        run_checks(pipeline, scenes.scene(), saved=False)
        return
    with pytest.raises(PipelineError, match=message):
        run_checks(pipeline, scenes.scene(), saved=False)


@pytest.mark.parametrize(
    "binned", [{"pixel": "30 arcsec"}, {"projection": "CAR", "pixel": "30 arcsec"}, {"nside": 8192}]
)
def test_chi2_against_a_map_without_noise_is_one(tmp_path, binned):
    """A noiseless map's NOISE is that of the complete map: chi^2 counted it twice, 0.5 a pixel. In
    a run and of its files.
    """
    camera = {"like": "mustang2", "detectors": 19, "fwhm": "60 arcsec", "sample_rate": "20 Hz"}
    place = {"site": "green_bank", "time": "2024-11-25T07:00", "target": "05h +60d", "seed": 3}
    y, x = np.indices((40, 40)) - 19.5
    sky = zonda.SkyMap(
        map=1e-3 * np.exp(-(x**2 + y**2) / 30), pixel_size="20 arcsec", centre="target", unit="K_RJ"
    )
    steps = [
        zonda.PointingDaisy(scan_duration="60 s", radius="4 arcmin", speed="1 arcmin/s"), sky,
        zonda.WhiteNoise(), zonda.Efficiency(), zonda.BinMap(**binned),
        zonda.CompareMaps(reference="noiseless/map", beam="60.01 arcsec"), zonda.SaveMap(),
    ]  # fmt: skip
    pipeline = zonda.Pipeline(steps, runs={"noiseless": {"only": ["sky"]}})
    found = [pipeline.run(zonda.Scene(instrument=camera, **place), output=tmp_path)["comparison"]]
    reference, noisy = (
        read_planes(tmp_path / name).planes["I"] for name in ("noiseless_map.fits", "map.fits")
    )
    assert reference.quiet
    assert not noisy.quiet
    found.append(compare(reference, noisy))
    for each in found:
        error = np.sqrt(2 / each.values["chi2 values"])
        assert each.values["chi2"] / each.values["chi2 pixels"] == pytest.approx(1, abs=4 * error)
        assert 4 * error < 0.4
