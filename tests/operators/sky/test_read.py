import contextlib

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from zonda.core.errors import InputError
from zonda.core.maps.units import parse_unit, written_unit
from zonda.core.numerics.projection import pixel_matrix
from zonda.operators.sky.geometry import placed
from zonda.operators.sky.input_map import HealpixMap, ImageMap
from zonda.operators.sky.read import read_map

ARCSEC = np.pi / 648000


def refused(path, *words, **options):
    """The error of reading ``path``, which names the file and all ``words``."""
    with pytest.raises(InputError) as caught:
        read_map(path, **options)
    for word in (str(path), *words):
        assert word in str(caught.value), str(caught.value)
    assert caught.value.cure
    return str(caught.value)


# --------------------------------------------------------------------------------------------------
# units


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("K_RJ", ("K_RJ", 1)),
        ("KRJ", ("K_RJ", 1)),
        ("mK_RJ", ("K_RJ", 1e-3)),
        ("K (RJ)", ("K_RJ", 1)),
        ("K_CMB", ("K_CMB", 1)),
        ("uK_CMB", ("K_CMB", 1e-6)),
        ("\N{MICRO SIGN}K_CMB", ("K_CMB", 1e-6)),
        ("Kcmb", ("K_CMB", 1)),
        ("Jy/pixel", ("Jy/pixel", 1)),
        ("JY/PIXEL", ("Jy/pixel", 1)),
        ("Jy/pix", ("Jy/pixel", 1)),
        ("mJy/pixel", ("Jy/pixel", 1e-3)),
        ("Jy pix-1", ("Jy/pixel", 1)),
        ("Jy pixel**-1", ("Jy/pixel", 1)),
        ("Jy/beam", ("Jy/beam", 1)),
        ("JY/BEAM", ("Jy/beam", 1)),
        ("MJy/sr", ("MJy/sr", 1)),
        ("MJy sr-1", ("MJy/sr", 1)),
        ("MJy sr**-1", ("MJy/sr", 1)),
        ("Jy/sr", ("MJy/sr", 1e-6)),
        ("kJy/sr", ("MJy/sr", 1e-3)),
        ("beam-1 Jy", ("Jy/beam", 1)),  # astropy's text of a FITS unit
        ("sr-1 MJy", ("MJy/sr", 1)),
        ("mJy/arcsec^2", ("MJy/sr", 1e-9 * (648000 / np.pi) ** 2)),  # SCUBA-2
        ("Jy/(arcsec**2)", ("MJy/sr", 1e-6 * (648000 / np.pi) ** 2)),
        ("mJy/sq.arcsec", ("MJy/sr", 1e-9 * (648000 / np.pi) ** 2)),
        ("W/m2/Hz/sr", ("MJy/sr", 1e20)),
        ("erg s-1 cm-2 Hz-1 sr-1", ("MJy/sr", 1e17)),
        ("10**-3 Jy/beam", ("Jy/beam", 1e-3)),
        ("10^(-3) Jy beam^{-1}", ("Jy/beam", 1e-3)),
        ("10-3 Jy/beam", ("Jy/beam", 1e-3)),  # FITS 4.0, section 4.3.1
        ("10+6 Jy/sr", ("MJy/sr", 1)),
        ("1e-3 Jy beam-1", ("Jy/beam", 1e-3)),
        ("0.001*Jy/beam", ("Jy/beam", 1e-3)),
        ("(mJy per beam)", ("Jy/beam", 1e-3)),
        (
            "\N{GREEK SMALL LETTER MU}Jy\N{DOT OPERATOR}beam\N{SUPERSCRIPT MINUS}"
            "\N{SUPERSCRIPT ONE}",
            ("Jy/beam", 1e-6),
        ),
        ("muJy/beam", ("Jy/beam", 1e-6)),
        ("K (Tb)", ("K_RJ", 1)),
        ("K (TMB)", ("K_RJ", 1)),
        ("muK_CMB", ("K_CMB", 1e-6)),
        ("mK,thermodynamic", ("K_CMB", 1e-3)),  # WMAP
        ("10**-6 K_CMB", ("K_CMB", 1e-6)),
        ("y", ("y", 1)),
        ("1e-6 y", ("y", 1e-6)),
        ("Compton-y", ("y", 1)),
        ("compton", ("y", 1)),
        ("y_compton", ("y", 1)),
    ],
)
def test_units(text, expected):
    unit, factor = parse_unit(text, place="map")
    assert unit == expected[0]
    assert factor == pytest.approx(expected[1])


@pytest.mark.parametrize(
    "text",
    [
        *("W/m2", "furlong", "Jy", "K/s", "K_XX", "counts", "Jy/px/beam", "K_", "MK_RJ", "1", ""),
        *("Jy/beam km/s", "K km/s", "mK_CMB^2", "mag(Jy/beam)", "0 Jy/beam", "-1 Jy/beam"),
        # numbers that would be computed to millions of digits
        *("10**9999999 deg", "10**9999999 Jy/beam", "1e999 Jy/beam", "Jy**9999999/beam"),
        "(" * 5000 + "Jy/beam",
    ],
)
def test_unknown_units(text):
    with pytest.raises(InputError, match=r"unknown unit|temperature scale"):
        parse_unit(text, place="map")


def test_an_antenna_temperature_is_not_that_of_the_sky():
    with pytest.raises(InputError, match=r"antenna temperature(.|\n)*main-beam efficiency"):
        parse_unit("K (Ta*)", place="map")


@pytest.mark.parametrize(
    ("text", "written"),
    [
        ("10**-3 beam-1 Jy", "mJy/beam"),
        ("1e-3 MJy sr-1", "kJy/sr"),
        ("muK_CMB", "uK_CMB"),
        ("10**-2 K (Tb)", "0.01 K_RJ"),
        ("1e-6 y", "1e-06 y"),
        ("mJy arcsec-2", "mJy arcsec-2"),
    ],
)
def test_units_are_written_so_that_they_are_read_back(text, written):
    assert written_unit(text, place="map") == written
    assert parse_unit(written, place="map") == pytest.approx(parse_unit(text, place="map"))


@pytest.mark.parametrize(
    ("scale", "unit"), [("K_RJ", "K_RJ"), ("K_CMB", "K_CMB"), ("RJ", "K_RJ"), ("cmb", "K_CMB")]
)
@pytest.mark.parametrize(("kelvin", "factor"), [("K", 1), ("mK", 1e-3), ("uK", 1e-6)])
def test_plain_kelvin_with_its_scale(made, save, scale, unit, kelvin, factor):
    image = read_map(
        save(np.full((4, 5), 2.0), made.tan_header((4, 5), unit=kelvin, TEMPSCAL=scale))
    )
    assert image.unit == unit
    np.testing.assert_allclose(image.values, 2.0 * factor)


def test_plain_kelvin_without_scale(made, save):
    refused(save(np.zeros((4, 4)), made.tan_header((4, 4), unit="K")), "TEMPSCAL", "unit: K_RJ")
    refused(
        save(np.zeros((4, 4)), made.tan_header((4, 4), unit="K", TEMPSCAL="Celsius")), "Celsius"
    )


def test_missing_unit_names_the_key_and_the_parameter(made, save):
    path = save(np.zeros((4, 4)), made.tan_header((4, 4), unit=None))
    refused(
        path, "unit of the map is missing", "BUNIT", "parameter unit", "Jy/pixel", "K_CMB", "MJy/sr"
    )
    assert read_map(path, unit="mK_RJ").unit == "K_RJ"


def test_wrong_unit_names_the_known_ones(made, save):
    refused(
        save(np.zeros((4, 4)), made.tan_header((4, 4), unit="furlong")),
        "unknown unit 'furlong'",
        "BUNIT",
        "Jy/pixel",
    )


def test_the_given_unit_overrides_and_is_noted(made, save):
    image = read_map(save(np.ones((4, 4)), made.tan_header((4, 4), unit="K_CMB")), unit="y")
    assert image.unit == "y"
    assert "K_CMB" in image.notes["unit"]


def test_jansky_per_beam_needs_its_beam(made, save):
    refused(save(np.zeros((4, 4)), made.tan_header((4, 4), unit="Jy/beam")), "BMAJ", "BMIN")
    header = made.tan_header((4, 4), unit="Jy/beam", BMAJ=10 / 3600, BMIN=8 / 3600)
    image = read_map(save(np.zeros((4, 4)), header))
    assert image.beam_solid_angle == pytest.approx(np.pi / (4 * np.log(2)) * 80 * ARCSEC**2)
    assert image.beam == pytest.approx((10 * ARCSEC, 8 * ARCSEC))


# --------------------------------------------------------------------------------------------------
# world coordinates


def radians_header(made, unit="rad"):
    header = made.tan_header((20, 30), crpix=(7.0, 9.0))
    for key in ("CRVAL1", "CRVAL2", "CDELT1", "CDELT2"):
        header[key] = np.radians(header[key])
    header["CUNIT1"] = header["CUNIT2"] = unit
    return header


@pytest.mark.parametrize("unit", ["rad", "radian", "RADIANS"])
def test_radians_and_degrees_agree(made, save, unit):
    degrees = read_map(
        save(np.zeros((20, 30)), made.tan_header((20, 30), crpix=(7.0, 9.0)), "d.fits")
    )
    radians = read_map(save(np.zeros((20, 30)), radians_header(made, unit), "r.fits"))
    np.testing.assert_allclose(
        pixel_matrix(radians.wcs), pixel_matrix(degrees.wcs), rtol=1e-11, atol=1e-8
    )


@pytest.mark.parametrize(("unit", "size"), [("arcsec", 3600), ("arcmin", 60), ("mas", 3.6e6)])
def test_coordinates_in_parts_of_a_degree_are_read(made, save, unit, size):
    degrees = made.tan_header((20, 30), crpix=(7.0, 9.0))
    header = degrees.copy()
    for key in ("CRVAL1", "CRVAL2", "CDELT1", "CDELT2"):
        header[key] *= size
    header["CUNIT1"] = header["CUNIT2"] = unit
    found, right = (
        read_map(save(np.zeros((20, 30)), header, "p.fits")),
        read_map(save(np.zeros((20, 30)), degrees, "d.fits")),
    )
    np.testing.assert_allclose(
        pixel_matrix(found.wcs), pixel_matrix(right.wcs), rtol=1e-11, atol=1e-8
    )
    header["CRVAL1"] = 721.0 * size
    refused(
        save(np.zeros((20, 30)), header, "f.fits"), "CRVAL1 =", "no longitude or latitude", "CUNIT1"
    )


def test_cd_pc_and_cdelt_agree(made, save):
    plain = made.tan_header((20, 30), CROTA2=20.0)
    c, s = np.cos(np.radians(20)), np.sin(np.radians(20))
    pc, cd = made.tan_header((20, 30)), made.tan_header((20, 30))
    pc["PC1_1"], pc["PC1_2"], pc["PC2_1"], pc["PC2_2"] = (
        c,
        s,
        -s,
        c,
    )  # equal sizes, so PC = R with CDELT1 < 0: see Paper II
    for key in ("CDELT1", "CDELT2"):
        del cd[key]
    matrix = WCS(plain).pixel_scale_matrix
    cd["CD1_1"], cd["CD1_2"], cd["CD2_1"], cd["CD2_2"] = matrix.ravel()
    first, second, third = (
        pixel_matrix(read_map(save(np.zeros((20, 30)), h)).wcs) for h in (plain, pc, cd)
    )
    np.testing.assert_allclose(third, first, rtol=1e-11, atol=1e-8)
    np.testing.assert_allclose(second, first, rtol=1e-11, atol=1e-8)


@pytest.mark.parametrize("options", [{}, {"centred": True}])
def test_missing_scale_names_the_keys(made, save, options):
    header = made.tan_header((4, 4))
    del header["CDELT1"], header["CDELT2"]
    path = save(np.zeros((4, 4)), header)
    refused(path, "pixel size is missing", "CDELT1", "CDELT2", "CUNIT1", "pixel_size", **options)
    image = read_map(path, pixel_size=2 * ARCSEC)
    np.testing.assert_allclose(image.wcs.pixel_scale_matrix * 3600, [[-2, 0], [0, 2]], atol=1e-12)


def test_missing_wcs_names_the_keys(save):
    bare = fits.Header({"BUNIT": "K_RJ"})
    refused(save(np.zeros((4, 4)), bare), "pixel size is missing", "CDELT1", "pixel_size")
    sized = fits.Header({"BUNIT": "K_RJ", "CDELT1": -1 / 3600, "CDELT2": 1 / 3600})
    refused(save(np.zeros((4, 4)), sized), "unit of the pixel size", "CUNIT1", "pixel_size")
    sized["CUNIT1"] = "deg"
    path = save(np.zeros((4, 4)), sized)
    refused(path, "no world coordinates", "CTYPE1", "CRVAL1", "CRPIX1", "centre")
    image = read_map(path, centred=True)
    assert image.placeless
    np.testing.assert_allclose(image.wcs.pixel_scale_matrix * 3600, np.diag([-1, 1]))


@pytest.mark.parametrize("key", ["CRVAL1", "CRPIX2"])
def test_half_a_wcs_names_the_missing_key(made, save, key):
    header = made.tan_header((4, 4))
    del header[key]
    text = refused(save(np.zeros((4, 4)), header), "no world coordinates", key, "centre")
    assert "CRVAL2" not in text


def test_bare_map_with_radians(save):
    header = fits.Header(
        {"BUNIT": "K_RJ", "CDELT1": ARCSEC, "CDELT2": 2 * ARCSEC, "CUNIT1": "rad", "CUNIT2": "rad"}
    )
    image = read_map(save(np.zeros((4, 4)), header), centred=True)
    np.testing.assert_allclose(image.wcs.pixel_scale_matrix * 3600, np.diag([-1, 2]))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"CDELT1": 0.0}, ["singular"]),
        ({"CUNIT1": "parsec"}, ["CUNIT1", "parsec", "no angle"]),
        ({"CTYPE1": "RA---XYZ", "CTYPE2": "DEC--XYZ"}, ["WCS is broken"]),
        (
            {"CTYPE1": "ELON-TAN", "CTYPE2": "ELAT-TAN"},
            ["ELON-TAN", "neither equatorial nor Galactic"],
        ),
        (
            {"CTYPE1": "RA---TAN", "CTYPE2": "GLAT-TAN"},
            ["GLAT-TAN", "neither equatorial nor Galactic"],
        ),
    ],
)
def test_broken_wcs(made, save, change, words):
    header = made.tan_header((4, 4))
    header.update(change)
    refused(save(np.zeros((4, 4)), header), *words)


@pytest.mark.parametrize("keys", [{}, {"RADESYS": "ICRS"}, {"RADESYS": "FK5", "EQUINOX": 2000.0}])
def test_galactic_tan_is_exact(made, save, keys):
    """Directions through `pixel_matrix` against astropy's own chain, whatever the keys that are
    meant for equatorial axes.
    """
    header = made.tan_header((40, 50), crpix=(3.0, 44.0))
    header["CTYPE1"], header["CTYPE2"] = "GLON-TAN", "GLAT-TAN"
    del header["RADESYS"]
    image = read_map(save(np.zeros((40, 50)), fits.Header([*header.cards, *keys.items()])))
    wcs = placed(image, None)
    sky = WCS(header).pixel_to_world(31.0, 22.0).icrs
    p = pixel_matrix(wcs) @ sky.cartesian.xyz.value
    np.testing.assert_allclose(p[:2] / p[2], [31.0, 22.0], atol=1e-6)


# --------------------------------------------------------------------------------------------------
# pixels


def test_nan_is_an_error_by_default(made, save):
    values = np.ones((6, 7))
    values[2, 3], values[5, 6] = np.nan, np.inf
    path = save(values, made.tan_header((6, 7)))
    refused(path, "2 of 42 pixels", "row 3, column 4", "missing: zero")
    image = read_map(path, missing="zero")
    assert image.zeroed == 2
    assert image.values[2, 3] == image.values[5, 6] == 0.0


def test_zeroed_pixels_are_counted(made, save):
    from zonda.operators.sky.skymap import SkyMap

    values = np.ones((6, 7))
    values[2, 3] = np.nan
    scan = made.observation([np.radians(75.0)], np.radians(20.0))
    made.look(SkyMap(file=save(values, made.tan_header((6, 7))), missing="zero"), scan)
    assert (
        scan.log.get("SkyMap", "pixels of the input map that are NaN or infinite, taken as zero")
        == 1
    )


@pytest.mark.parametrize("shape", [(1, 5, 6), (1, 1, 5, 6)])
def test_degenerate_axes_are_squeezed(made, save, shape):
    values = np.random.default_rng(1).standard_normal(shape)
    header = made.tan_header(
        (5, 6), CTYPE3="FREQ", CRVAL3=9e10, CDELT3=1e9, CRPIX3=1.0, CUNIT3="Hz"
    )
    np.testing.assert_array_equal(
        read_map(save(values, header)).values, values[..., :, :].reshape(5, 6)
    )


def test_cubes_are_refused(made, save):
    refused(save(np.zeros((3, 5, 6)), made.tan_header((5, 6))), "6 x 5 x 3", "plane")
    refused(save(np.zeros(7), fits.Header({"BUNIT": "K_RJ"})), "one axis")


def test_scaled_integers_and_extensions(made, tmp_path):
    header = made.tan_header((4, 5))
    hdu = fits.ImageHDU(np.arange(20, dtype=np.int16).reshape(4, 5), header)
    hdu.header["BSCALE"], hdu.header["BZERO"] = 0.5, 3.0
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(tmp_path / "x.fits")
    with fits.open(tmp_path / "x.fits") as raw:
        expected = raw[1].data.astype(float)
    np.testing.assert_array_equal(read_map(tmp_path / "x.fits").values, expected)


def test_compressed_files(made, save, tmp_path):
    values = np.random.default_rng(2).standard_normal((20, 20)).astype(np.float32)
    for name in ("map.fits.gz", "map.fits"):
        np.testing.assert_array_equal(
            read_map(save(values, made.tan_header((20, 20)), name)).values, values
        )
    fits.HDUList(
        [
            fits.PrimaryHDU(),
            fits.CompImageHDU(
                values, made.tan_header((20, 20)), compression_type="GZIP_1", quantize_level=0
            ),
        ]
    ).writeto(tmp_path / "c.fits")
    np.testing.assert_array_equal(read_map(tmp_path / "c.fits").values, values)


# --------------------------------------------------------------------------------------------------
# files


def test_unreadable_files(made, save, tmp_path):
    refused(tmp_path / "none.fits", "no such file")
    refused(tmp_path, "folder")
    (tmp_path / "text.fits").write_text("hello " * 2000)
    refused(tmp_path / "text.fits", "cannot be read as FITS")
    (tmp_path / "empty.fits").write_bytes(b"")
    refused(tmp_path / "empty.fits", "cannot be read as FITS")
    fits.PrimaryHDU().writeto(tmp_path / "nothing.fits")
    refused(tmp_path / "nothing.fits", "no image")


@pytest.mark.parametrize("keep", [0.9, 0.5, 0.05])
@pytest.mark.parametrize("name", ["map.fits", "map.fits.gz"])
def test_truncated_files(made, save, keep, name):
    path = save(np.random.default_rng(3).standard_normal((60, 60)), made.tan_header((60, 60)), name)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * keep)])
    refused(path, "cannot be read as FITS")


@pytest.mark.parametrize("seed", range(20))
def test_corrupt_headers_never_leave_a_traceback(made, save, seed):
    """Either the damage does not matter, or it is an InputError."""
    path = save(np.zeros((10, 10)), made.tan_header((10, 10)))
    data = bytearray(path.read_bytes())
    rng = np.random.default_rng(seed)
    for k in rng.integers(0, 1500, 12):
        data[k] = rng.integers(0, 256)
    path.write_bytes(bytes(data))
    with contextlib.suppress(InputError):
        assert isinstance(read_map(path), ImageMap)


def test_healpix_faults(tmp_path):
    import healpy

    values = np.arange(12 * 4**2, dtype=np.float64)
    path = tmp_path / "h.fits"
    healpy.write_map(path, values, coord="C", column_units="K_RJ", dtype=np.float64)
    assert isinstance(read_map(path), HealpixMap)
    refused(path, "centre does not apply", centred=True)
    refused(path, "pixel_size does not apply", pixel_size=1e-3)
    healpy.write_map(path, values, column_units="K_RJ", dtype=np.float64, overwrite=True)
    refused(path, "coordinate system", "COORDSYS")
    healpy.write_map(path, values, coord="C", dtype=np.float64, overwrite=True)
    refused(path, "unit of the map is missing", "TUNIT1", "parameter unit")
    values[7] = np.nan
    healpy.write_map(path, values, coord="C", column_units="K_RJ", dtype=np.float64, overwrite=True)
    refused(path, "1 of 192 pixels", "entry 8", "missing: zero")
    assert read_map(path, missing="zero").zeroed == 1
