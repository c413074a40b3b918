"""A map that was written comes back; maps of other origin are read for what they state."""

from __future__ import annotations

import math

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

import zonda
from zonda.core import registry
from zonda.core.errors import InputError
from zonda.plugins.checks.scenes import camera, scene

ARCSEC = math.pi / 648000
KINDS = {
    "TAN": {"pixel": "6 arcsec", "crosslinking": True, "scan_hits": True, "visits": True},
    "CAR": {"pixel": "6 arcsec", "projection": "CAR"},
    "HEALPix": {"nside": 4096, "scan_hits": True},
    "galactic": {"nside": 4096, "frame": "galactic"},
    "uniform": {"pixel": "6 arcsec", "weights": "uniform"},
    "hits": {"pixel": "6 arcsec", "contents": "hits"},
}


def made(instrument=None, **options):
    steps = [
        zonda.PointingDaisy(radius="1 arcmin", scan_duration="8 s", scans=2),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        zonda.BinMap(**options),
    ]
    data = zonda.Pipeline(steps).run(scene(instrument or camera(7)), threads=1)
    return data["map"]


def same(found, wanted):
    assert set(found.planes) == set(wanted.planes)
    for name, plane in wanted.planes.items():
        other = found.planes[name]
        assert (other.scale, list(other.names)) == (plane.scale, list(plane.names)), name
        assert (other.values.dtype.kind, other.values.shape) == (
            plane.values.dtype.kind,
            plane.values.shape,
        )
    np.testing.assert_allclose(found.grid.areas, wanted.grid.areas, rtol=1e-12)
    np.testing.assert_allclose(found.grid.directions(), wanted.grid.directions(), atol=1e-14)
    for name in ("unit", "weighting", "difference", "contents", "frame", "projection"):
        assert getattr(found, name) == getattr(wanted, name), name
    assert found.resolution == pytest.approx(wanted.resolution)
    assert found.pixel == pytest.approx(wanted.pixel)


@pytest.mark.parametrize("kind", KINDS)
def test_what_was_written_comes_back(kind, tmp_path):
    product = made(**KINDS[kind])
    path = product.write(tmp_path / "a.fits")
    found = zonda.read_map(path)
    if kind == "TAN":  # two rows of one plane are planes of their own in files
        rows = product.planes.pop("directions").values
        np.testing.assert_array_equal(found.planes.pop("mean_cos_2psi").values[0], rows[0])
        np.testing.assert_array_equal(found.planes.pop("mean_sin_2psi").values[0], rows[1])
        assert found.scans == list(product.scans)
    if KINDS[kind].get("scan_hits"):
        np.testing.assert_array_equal(found.hits_of(1), product.hits_of(1))
    if kind == "hits":
        np.testing.assert_array_equal(found.hits, product.hits)
        assert found.contents == "hits"
        return
    same(found, product)
    for name, plane in product.planes.items():
        np.testing.assert_array_equal(found.planes[name].values, plane.values)
    with fits.open(found.write(tmp_path / "b.fits")) as again, fits.open(path) as first:
        for key in ("DATE-OBS", "MJD-OBS", "EXPTIME", "OBJECT", "SEED", "NSCANS", "RESTFRQ"):
            assert again[0].header[key] == first[0].header[key]
        assert str(again[0].header.get("HISTORY")) == str(first[0].header.get("HISTORY"))
        for a, b in zip(again[:4], first, strict=False):
            assert a.header.get("BUNIT") == b.header.get("BUNIT")


@pytest.mark.parametrize("options", [{"pixel": "20 arcsec"}, {"nside": 2048}], ids=str)
def test_polarized_maps_come_back(options, tmp_path):
    pairs = camera(20).model_copy(update={"polarization": "pairs"})
    product = made(pairs, stokes="IQU", **options)
    found = zonda.read_map(product.write(tmp_path / "a.fits"))
    same(found, product)
    solved = product.known
    assert solved.any()
    for name, plane in product.planes.items():
        # weights of Q and U are those of I x COV_II / COV_QQ: to the rounding of inverses
        mine, theirs = found.planes[name].values[:, solved], plane.values[:, solved]
        np.testing.assert_allclose(mine, theirs, rtol=1e-9, err_msg=name)
    np.testing.assert_array_equal(found.stokes("U").signal, product.stokes("U").signal)
    with fits.open(tmp_path / "a.fits", mode="update") as file:
        for hdu in file:
            if "POLCCONV" in hdu.header:
                hdu.header["POLCCONV"] = "IAU"
    iau = zonda.read_map(tmp_path / "a.fits")
    np.testing.assert_array_equal(iau.polarization.u, -product.polarization.u)
    np.testing.assert_array_equal(iau.polarization.q, product.polarization.q)
    np.testing.assert_array_equal(
        iau.polarization.covariance[[2, 4]], -product.polarization.covariance[[2, 4]]
    )


def test_units_and_the_spectrum_of_their_conversion_come_back(tmp_path):
    product = made(pixel="6 arcsec")
    found = zonda.read_map(
        product.to("mJy/beam", spectral_index=3).write(tmp_path / "a.fits"), band=product.band
    )
    assert (found.unit, found.spectral_index) == ("mJy/beam", 3)
    known = product.known
    # of the index 3, whose brightness in the band is not that of a flat spectrum
    np.testing.assert_allclose(found.to("K_RJ").signal[known], product.signal[known], rtol=1e-12)
    np.testing.assert_allclose(found.to("K_RJ").weights[known], product.weights[known], rtol=1e-9)
    other = zonda.read_map(tmp_path / "a.fits")
    with pytest.raises(InputError, match=r"band of the map is not known(.|\n)*map\.band"):
        other.to("K_RJ")


def test_the_band_of_a_known_name_is_that_of_the_file(tmp_path):
    product = made({"like": "mustang2", "detectors": 7}, pixel="6 arcsec")
    found = zonda.read_map(product.to("MJy/sr").write(tmp_path / "a.fits"))
    assert found.band == product.band
    # one of a camera of several, called f090
    pa5 = registry.instruments.create("act_pa5").cameras["f090"].band
    fits.setval(tmp_path / "a.fits", "INSTRUME", value="act_pa5 (detectors 7)")
    fits.setval(tmp_path / "a.fits", "BAND", value="f090")
    assert zonda.read_map(tmp_path / "a.fits").band is None  # another frequency
    fits.setval(tmp_path / "a.fits", "RESTFRQ", value=pa5.centre)
    assert zonda.read_map(tmp_path / "a.fits").band == pa5


def image(path, values, unit="Jy beam-1", **cards):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval = ["RA---SIN", "DEC--SIN"], [75.0, 20.0]
    wcs.wcs.crpix, wcs.wcs.cdelt = [5.0, 4.0], [-4 / 3600, 2 / 3600]  # oblong
    header = wcs.to_header()
    header.update({"BUNIT": unit, "BMAJ": 12 / 3600, "BMIN": 8 / 3600, **cards})
    fits.PrimaryHDU(values, header).writeto(path, overwrite=True)
    return path


def test_a_map_of_other_origin(tmp_path):
    values = np.arange(63.0).reshape(7, 9)
    values[0, 0] = np.nan
    found = zonda.read_map(image(tmp_path / "a.fits", values, "10**-3 beam-1 Jy"))
    assert found.unit == "mJy/beam"
    assert found.resolution == pytest.approx(math.sqrt(96) * ARCSEC)
    assert found.projection == "SIN"
    assert found.sides == pytest.approx((2 * ARCSEC, 4 * ARCSEC), rel=1e-6)
    assert found.grid.areas[3, 4] == pytest.approx(8 * ARCSEC**2, rel=1e-6)
    assert found.hits.sum() == 62
    assert np.isnan(found.noise).all()
    with fits.open(found.write(tmp_path / "b.fits")) as file:  # nothing that it did not have
        assert [hdu.name for hdu in file] == ["SIGNAL"]
        assert "SEED" not in file[0].header
        np.testing.assert_array_equal(file[0].data, values)
    cube = image(tmp_path / "c.fits", np.stack([values, 2 * values, 3 * values]))
    np.testing.assert_array_equal(zonda.read_map(cube, plane=2).signal, 2 * values)


@pytest.mark.parametrize(
    ("cards", "options", "words"),
    [
        ({"BUNIT": "K"}, {}, "temperature scale(.|\n)*unit="),
        ({"BUNIT": ""}, {}, "unit of the map is missing(.|\n)*unit="),
        ({"BUNIT": "furlong"}, {}, "unknown unit 'furlong'(.|\n)*unit="),
        ({"CTYPE1": "X", "CTYPE2": "Y"}, {}, "no celestial coordinates"),
        ({"BMAJ": "wide"}, {}, "BMAJ"),
        ({}, {"hdu": 3}, "no extension 3"),
        ({}, {"band": "nowhere"}, "nowhere"),
        ({}, {"coordsys": "C"}, "coordsys is for HEALPix maps"),
        ({}, {"column": 1}, "column is for HEALPix maps"),
    ],
)
def test_what_a_file_lacks_is_named(cards, options, words, tmp_path):
    path = image(tmp_path / "a.fits", np.ones((7, 9)))
    fits.setval(path, "BUNIT", value="K_RJ")
    for key, value in cards.items():
        fits.setval(path, key, value=value)
    with pytest.raises(zonda.ZondaError, match=words):
        zonda.read_map(path, **options)
