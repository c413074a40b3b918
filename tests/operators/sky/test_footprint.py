"""Where an input map lies, by its header alone."""

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS

from zonda.core.configuration.target import Target
from zonda.operators.sky.geometry import off_the_map
from zonda.operators.sky.skymap import SkyMap


def footprint(path, pixel_size, centre, hdu=None):
    size = None if pixel_size is None else f"{pixel_size} rad"
    return SkyMap(file=path, pixel_size=size, centre=centre, hdu=hdu)._footprint()


def write(path, ctype, crval, shape=(40, 60), step=0.01, **cards):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval = list(ctype), list(crval)
    wcs.wcs.crpix, wcs.wcs.cdelt = [(shape[1] + 1) / 2, (shape[0] + 1) / 2], [-step, step]
    header = wcs.to_header()
    header.update({"BUNIT": "K", "TEMPSCAL": "K_RJ"} | cards)
    fits.PrimaryHDU(np.zeros(shape), header).writeto(path)
    return path


@pytest.mark.parametrize(
    ("ctype", "crval", "frame"),
    [
        (("RA---TAN", "DEC--TAN"), (30.0, 89.0), "icrs"),
        (("GLON-TAN", "GLAT-TAN"), (120.0, -30.0), "galactic"),
        (("RA---SIN", "DEC--SIN"), (200.0, -50.0), "icrs"),
        (("GLON-CAR", "GLAT-CAR"), (10.0, 0.0), "galactic"),
    ],
)
def test_its_centre_is_on_it_and_what_is_outside_is_not(tmp_path, ctype, crval, frame):
    """The centre is that of astropy to the 1e-9 deg to which it is given, 9e-12 rad at most."""
    found = footprint(write(tmp_path / "m.fits", ctype, crval), None, None)
    truth = SkyCoord(*crval, unit="deg", frame=frame).icrs
    ra, dec = found.target.icrs()
    assert abs(np.exp(1j * ra) - np.exp(1j * truth.ra.rad)) * np.cos(dec) < 2e-11
    assert dec == pytest.approx(truth.dec.rad, abs=2e-11)
    assert off_the_map(found, (ra, dec), "SkyMap") == ""
    away = truth.directional_offset_by(
        30 * truth.ra.unit, 1.0 * truth.ra.unit
    )  # the map reaches 0.36 deg
    said = off_the_map(found, (away.ra.rad, away.dec.rad), "SkyMap")
    assert "is not on the input map" in said
    assert "1 deg away" in said


def test_the_edge_of_a_tangent_image_is_exact(tmp_path):
    found = footprint(
        write(tmp_path / "m.fits", ("RA---TAN", "DEC--TAN"), (30.0, 20.0)), None, None
    )
    wcs = WCS(fits.getheader(tmp_path / "m.fits"))
    for x, y, on in [(-0.4, 10, True), (-0.6, 10, False), (30, 39.4, True), (30, 39.6, False)]:
        ra, dec = np.radians(wcs.wcs_pix2world([[x, y]], 0)[0])
        assert (off_the_map(found, (ra, dec), "SkyMap") == "") is on


def test_a_whole_sky_has_no_outside(tmp_path):
    found = footprint(
        write(tmp_path / "m.fits", ("RA---CAR", "DEC--CAR"), (0.0, 0.0), (180, 360), 1.0),
        None,
        None,
    )
    for ra, dec in np.radians([(0.5, 0.0), (179.0, 0.0), (181.0, -80.0), (90.0, 89.0)]):
        assert off_the_map(found, (ra, dec), "SkyMap") == ""


def test_a_map_that_is_moved_lies_where_it_is_put(tmp_path):
    centre = Target.parse("10 deg -5 deg")
    found = footprint(
        write(tmp_path / "m.fits", ("RA---TAN", "DEC--TAN"), (30.0, 89.0)), None, centre
    )
    assert np.degrees(found.target.icrs()) == pytest.approx((10.0, -5.0), abs=1e-9)


def test_what_has_no_place_of_its_own_has_no_footprint(tmp_path):
    import healpy

    healpy.write_map(
        tmp_path / "h.fits", np.zeros(12), coord="C", column_units="K_RJ", dtype=np.float32
    )
    assert footprint(tmp_path / "h.fits", None, None) is None
    fits.PrimaryHDU(np.zeros((3, 3)), fits.Header({"BUNIT": "K_RJ"})).writeto(tmp_path / "p.fits")
    assert footprint(tmp_path / "p.fits", 1e-5, None) is None


def test_a_moved_map_of_another_projection_and_an_extension(tmp_path):
    """The whole footprint moves with its centre; an extension is found by its name."""
    write(tmp_path / "m.fits", ("RA---SIN", "DEC--SIN"), (30.0, 20.0))
    with fits.open(tmp_path / "m.fits") as hdus:
        fits.HDUList(
            [
                fits.PrimaryHDU(),
                fits.ImageHDU(np.zeros(4)),
                fits.ImageHDU(hdus[0].data, hdus[0].header, "MAP"),
            ]
        ).writeto(tmp_path / "e.fits")
    still = footprint(tmp_path / "e.fits", None, None, "MAP")
    moved = footprint(tmp_path / "e.fits", None, Target.parse("260 deg -10 deg"), "MAP")
    np.testing.assert_allclose(np.degrees(moved.target.icrs()), [260.0, -10.0], atol=1e-8)
    np.testing.assert_allclose(moved.radius, still.radius, rtol=1e-6)
