"""A map in memory is the map of the file that would hold it, to the last bit."""

from __future__ import annotations

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

import zonda
from zonda.core.configuration.parameters import ParameterError
from zonda.core.errors import InputError, ZondaError
from zonda.plugins.checks.scenes import TARGET, camera, scene

rng = np.random.default_rng(4)
VALUES = rng.normal(0, 1e-3, (48, 64))


def wcs_of(projection: str = "TAN", turn: float = 0.3) -> WCS:
    """Pixels of 4.1 arcsec about the target, turned: numbers that 14 digits do not hold."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = [f"RA---{projection}", f"DEC--{projection}"]
    wcs.wcs.crval, wcs.wcs.crpix = TARGET, [32.123456789012345, 24.4]
    wcs.wcs.cdelt = [-4.1 / 3600, 4.1 / 3600]
    wcs.wcs.pc = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    wcs.wcs.set()
    return wcs


def run(**options):
    steps = [zonda.PointingDaisy(scan_duration="4 s", radius="1 arcmin"), zonda.SkyMap(**options)]
    return zonda.Pipeline(steps).run(scene(camera(7)), keep=["sky"], threads=1)


def sky(**options):
    return run(**options).tod("sky")


def file_of(folder, hdu):
    hdu.writeto(folder / "map.fits", overwrite=True)
    return folder / "map.fits"


@pytest.mark.parametrize("projection", ["TAN", "SIN", "CAR"])
@pytest.mark.parametrize("unit", ["K_RJ", "mK_CMB", "MJy/sr", "Jy/pixel"])
def test_the_same_bits_as_a_file(tmp_path, projection, unit):
    if projection != "TAN" and unit == "mK_CMB":
        pytest.skip("covered by the others")
    header = zonda.SkyMap(map=VALUES, wcs=wcs_of(projection), unit=unit).wcs
    hdu = fits.PrimaryHDU(VALUES, fits.Header(dict(header)))
    expected = sky(file=file_of(tmp_path, hdu), unit=unit)
    assert expected.any()
    np.testing.assert_array_equal(sky(map=VALUES, wcs=wcs_of(projection), unit=unit), expected)
    np.testing.assert_array_equal(sky(map=hdu, unit=unit), expected)
    np.testing.assert_array_equal(sky(map=VALUES, wcs=hdu.header, unit=unit), expected)


@pytest.mark.parametrize("kind", ["f4", ">f8", "i2", "u2"])
def test_numbers_of_other_types(tmp_path, kind):
    values = (VALUES * 1e4).astype(kind)
    hdu = fits.PrimaryHDU(values.astype("f8"), wcs_of(turn=0.0).to_header())
    expected = sky(file=file_of(tmp_path, hdu), unit="uK_RJ")
    np.testing.assert_array_equal(sky(map=values, wcs=hdu.header, unit="uK_RJ"), expected)


def test_quantities_carry_their_unit():
    where = {"wcs": wcs_of()}
    plain = sky(map=VALUES, unit="MJy/sr", **where)
    np.testing.assert_array_equal(sky(map=VALUES * u.MJy / u.sr, **where), plain)
    np.testing.assert_allclose(
        sky(map=(VALUES * u.MJy / u.sr).to("Jy/arcsec2"), **where), plain, rtol=1e-6, atol=1e-12
    )
    kelvin = sky(map=VALUES, unit="mK_RJ", **where)
    np.testing.assert_array_equal(sky(map=VALUES * u.mK, unit="mK_RJ", **where), kelvin)
    with pytest.raises(ParameterError, match="a quantity in mK, and unit is K_RJ"):
        zonda.SkyMap(map=VALUES * u.mK, unit="K_RJ", **where)
    with pytest.raises(ParameterError, match="'m' is no unit of a map"):
        zonda.SkyMap(map=VALUES * u.m, **where)
    with pytest.raises(InputError, match="does not say on which temperature scale"):
        sky(map=VALUES * u.K, **where)
    with pytest.raises(InputError, match="unit of the map is missing"):
        sky(map=VALUES * u.one, **where)


def test_a_pixel_size_and_a_centre_are_enough(tmp_path):
    hdu = fits.PrimaryHDU(VALUES)
    options = {"pixel_size": "4 arcsec", "centre": "target", "unit": "K_RJ"}
    np.testing.assert_array_equal(
        sky(map=VALUES, **options), sky(file=file_of(tmp_path, hdu), **options)
    )
    with pytest.raises(InputError, match="pixel size is missing"):
        sky(map=VALUES, unit="K_RJ")
    del options["centre"]  # an image without a WCS is put on the target
    np.testing.assert_array_equal(
        sky(map=VALUES, **options), sky(map=VALUES, centre="target", **options)
    )


def test_missing_pixels_are_an_error_or_zero():
    holes = VALUES.copy()
    holes[3, 4] = np.nan
    with pytest.raises(
        InputError, match=r"1 of 3072 pixels are NaN or infinite, the first at row 4, column 5"
    ):
        sky(map=holes, wcs=wcs_of(), unit="K_RJ")
    masked = np.ma.masked_array(VALUES, np.isnan(holes))
    zeroed = VALUES.copy()
    zeroed[3, 4] = 0.0
    expected = sky(map=zeroed, wcs=wcs_of(), unit="K_RJ")
    for given in (holes, masked):
        np.testing.assert_array_equal(
            sky(map=given, wcs=wcs_of(), unit="K_RJ", missing="zero"), expected
        )


def test_a_healpix_table_in_memory(tmp_path):
    import healpy as hp

    values = rng.normal(0, 1e-3, hp.nside2npix(64))
    path = tmp_path / "healpix.fits"
    hp.write_map(path, values, coord="C", column_units="K_CMB", dtype=np.float64)
    with fits.open(path) as hdus:
        np.testing.assert_array_equal(sky(map=hdus[1]), sky(file=path))


def test_a_plane_of_a_cube():
    cube = np.stack([VALUES, 2 * VALUES])
    options = {"wcs": wcs_of(), "unit": "K_RJ"}
    np.testing.assert_array_equal(sky(map=cube, plane=2, **options), sky(map=2 * VALUES, **options))


def test_what_happens_to_the_array_later_does_not_matter():
    values = VALUES.copy()
    step = zonda.SkyMap(map=values, wcs=wcs_of(), unit="K_RJ")
    values[...] = 7.0
    steps = [zonda.PointingDaisy(scan_duration="4 s", radius="1 arcmin"), step]
    found = zonda.Pipeline(steps).run(scene(camera(7)), keep=["sky"], threads=1).tod("sky")
    np.testing.assert_array_equal(found, sky(map=VALUES, wcs=wcs_of(), unit="K_RJ"))


def test_provenance_says_that_it_was_an_array():
    data = run(map=VALUES, wcs=wcs_of(), unit="K_RJ")
    said = next(values for label, _, values in data.provenance["operators"] if label == "SkyMap")
    assert "'array': [48, 64]" in said["map"]
    assert "float64" in said["map"]
    assert "hash" in said["map"]
    assert said["unit"] == "K_RJ"
    other = run(map=VALUES + 1e-9, wcs=wcs_of(), unit="K_RJ").provenance["operators"]
    assert dict(enumerate(other)) != dict(enumerate(data.provenance["operators"]))


def test_equality_is_that_of_the_numbers_and_their_place():
    one, same = (zonda.SkyMap(map=VALUES, wcs=wcs_of(), unit="K_RJ") for _ in range(2))
    assert one == same
    assert one != zonda.SkyMap(map=2 * VALUES, wcs=wcs_of(), unit="K_RJ")
    assert one != zonda.SkyMap(map=VALUES, wcs=wcs_of(turn=0.4), unit="K_RJ")


def test_target_map_and_check_know_where_it_is():
    step = zonda.SkyMap(map=VALUES, wcs=wcs_of(turn=0.0), unit="K_RJ")
    ra, dec = np.degrees(step.map_centre().icrs())
    pixel = wcs_of(turn=0.0).world_to_pixel_values(ra, dec)
    np.testing.assert_allclose(pixel, [31.5, 23.5], atol=1e-4)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({}, "give either file, the path of a FITS map, or in Python map, an array"),
        ({"map": VALUES, "hdu": 1}, "hdu is for files"),
        ({"map": VALUES[0]}, r"expected an image \(ny, nx\), got an array of shape \(64,\)"),
        ({"map": VALUES + 1j}, "expected an array of numbers"),
        ({"map": "map.fits"}, "a file is given as file='map.fits'"),
        ({"map": VALUES, "wcs": 3}, "expected an astropy WCS or FITS keywords"),
        ({"map": fits.HDUList([fits.PrimaryHDU(VALUES)])}, "map takes one HDU, not a list"),
        (
            {"map": fits.BinTableHDU.from_columns([fits.Column("a", "D", array=[1.0])])},
            "neither an image nor a HEALPix table",
        ),
    ],
)
def test_mistakes_are_said_at_once(options, said):
    with pytest.raises(ParameterError, match=said):
        zonda.SkyMap(**options)


def test_a_wcs_of_another_shape():
    wcs = wcs_of()
    wcs.pixel_shape = (48, 64)
    with pytest.raises(
        ParameterError, match="the WCS is that of an image of 48 x 64 pixels, the array has 64 x 48"
    ):
        zonda.SkyMap(map=VALUES, wcs=wcs)


def test_a_pipeline_file_has_no_arrays():
    from zonda.core.configuration.pipeline_file import parse

    text = """
site: green_bank
instrument: mustang2
time: 2024-11-25T07:00
target: 05h +20d
operators:
  - PointingDaisy
  - SkyMap: {map: {array: [2, 2], hash: abc}}
"""
    with pytest.raises(ZondaError, match=r"an array is given in Python(.|\n)*file: my_map.fits"):
        parse(text)


@pytest.mark.parametrize("kind", ["image", "cube", "quantity", "table"])
def test_in_files(tmp_path, kind):
    """A step with an array and the one with its file have the same bits; a step with a file stays
    as it is.
    """
    import healpy as hp

    options = {"map": VALUES, "wcs": wcs_of(), "unit": "K_RJ", "scale": 2.0}
    if kind == "cube":
        options |= {"map": np.stack([VALUES, 2 * VALUES]), "plane": 2}
    elif kind == "quantity":
        options |= {"map": VALUES * u.MJy / u.sr, "unit": None}
    elif kind == "table":
        hp.write_map(
            tmp_path / "healpix.fits",
            rng.normal(0, 1e-3, hp.nside2npix(64)),
            coord="C",
            column_units="K_CMB",
        )
        with fits.open(tmp_path / "healpix.fits") as hdus:
            options = {"map": hdus[1].copy(), "scale": 2.0}
    written = zonda.SkyMap(**options).in_files(tmp_path / "new" / "map.fits")
    assert written.map is written.wcs is None
    assert written.in_files(tmp_path / "other.fits") is written
    assert not (tmp_path / "other.fits").exists()
    daisy = zonda.PointingDaisy(scan_duration="4 s", radius="1 arcmin")
    found = (
        zonda.Pipeline([daisy, written]).run(scene(camera(7)), keep=["sky"], threads=1).tod("sky")
    )
    np.testing.assert_array_equal(found, sky(**options))
