"""Maps that are not gnomonic: other projections, distortions and HEALPix, against analytic fields
on the sphere.
"""

import healpy
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS

from zonda.core.errors import InputError
from zonda.core.numerics.radiation import to_kelvin_rj
from zonda.operators.sky.convolved import tangent_areas
from zonda.operators.sky.gridding import interpolated
from zonda.operators.sky.input_map import ImageMap
from zonda.operators.sky.read import read_map
from zonda.operators.sky.region import tangent_grid_wcs
from zonda.operators.sky.skymap import SkyMap

ARCMIN = np.pi / 10800


def field(direction, scale=0.02):
    """A smooth field of ICRS unit vectors (..., 3): waves of some ``scale`` rad."""
    k = np.array([[1.0, 0.7, -0.4], [-0.3, 1.1, 0.5], [0.8, -0.6, 0.9]]) / scale
    phase = direction @ k.T
    return np.sin(phase[..., 0]) + 0.5 * np.cos(phase[..., 1]) - 0.3 * np.sin(phase[..., 2])


def unit(ra, dec):
    return np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=-1)


def scan_about(made, ra, dec, reach=20 * ARCMIN, n=300, **more):
    rng = np.random.default_rng(1)
    lon, lat = made.offset(
        np.radians(ra), np.radians(dec), *np.tan(rng.uniform(-reach, reach, (2, n)))
    )
    return made.observation(lon, lat, centre=(np.radians(ra), np.radians(dec)), **more), unit(
        lon, lat
    )


def pixels(header, shape):
    """ICRS unit vectors of a header's pixels, by astropy alone."""
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]]
    sky = WCS(header).pixel_to_world(x, y).icrs
    return np.moveaxis(sky.cartesian.xyz.value, 0, -1)


@pytest.mark.parametrize("kind", ["SIN", "ARC", "ZEA", "STG", "CAR", "CEA"])
@pytest.mark.parametrize("frame", ["icrs", "galactic", "fk4"])
def test_other_projections(made, save, kind, frame):
    target = SkyCoord(60.0, 25.0, unit="deg")
    lon, lat = {
        "icrs": (60.0, 25.0),
        "galactic": (target.galactic.l.deg, target.galactic.b.deg),
        "fk4": (target.fk4.ra.deg, target.fk4.dec.deg),
    }[frame]
    header = made.tan_header((150, 150), ra=lon, dec=lat, cdelt=(-30.0, 30.0))
    names = ("GLON", "GLAT") if frame == "galactic" else ("RA--", "DEC-")
    for k in (0, 1):
        header[f"CTYPE{k + 1}"] = f"{names[k]}-{kind}"
    del header["RADESYS"]
    if frame == "fk4":
        header["RADESYS"], header["EQUINOX"] = "FK4", 1950.0
    if kind in ("CAR", "CEA"):  # the reference of cylindrical projections lies on the equator
        header["CRVAL2"] = 0.0
        header["CRPIX2"] = (
            75.5 - (lat if kind == "CAR" else np.degrees(np.sin(np.radians(lat)))) * 120
        )
    path = save(field(pixels(header, (150, 150))), header)
    scan, directions = scan_about(made, 60.0, 25.0)
    got = made.look(SkyMap(file=path, beam="none"), scan)[0]
    # waves of 0.02 rad on 30 arcsec pixels: 140 rad per pixel^-1, cubic splines are good to (2 pi /
    # 860)^4; FK4 moves by E-terms
    np.testing.assert_allclose(got, field(directions), atol=1e-5)
    assert any("interpolated" in value for _, _, value in scan.log)
    assert scan.log.get("SkyMap", "samples outside the input map") == 0


def test_distorted_tan(made, save):
    header = made.tan_header((150, 150), ra=60.0, dec=25.0, cdelt=(-30.0, 30.0))
    header["CTYPE1"], header["CTYPE2"] = "RA---TAN-SIP", "DEC--TAN-SIP"
    header["A_ORDER"] = header["B_ORDER"] = 2
    header["A_2_0"], header["B_0_2"], header["A_1_1"] = 2e-4, -3e-4, 1e-4
    path = save(field(pixels(header, (150, 150))), header)
    scan, directions = scan_about(made, 60.0, 25.0)
    np.testing.assert_allclose(
        made.look(SkyMap(file=path, beam="none"), scan)[0], field(directions), atol=1e-4
    )


def test_the_seam_of_a_whole_sky_map(made, save):
    """A plate-carree map of the whole sky has no gap where it closes."""
    shape = (360, 720)
    header = made.tan_header(shape, ra=0.0, dec=0.0, cdelt=(-1800.0, 1800.0))
    header["CTYPE1"], header["CTYPE2"] = "RA---CAR", "DEC--CAR"
    path = save(field(pixels(header, shape), 0.5), header)
    for ra in (180.0, 179.8, 0.0, 90.0):
        scan, directions = scan_about(made, ra, 5.0, reach=np.radians(2))
        got = made.look(SkyMap(file=path, beam="none"), scan)[0]
        np.testing.assert_allclose(got, field(directions, 0.5), atol=2e-6)
        assert scan.log.get("SkyMap", "samples outside the input map") == 0


def test_outside_a_resampled_map(made, save):
    header = made.tan_header((60, 60), ra=60.0, dec=25.0, cdelt=(-30.0, 30.0))
    header["CTYPE1"], header["CTYPE2"] = "RA---SIN", "DEC--SIN"
    lon, lat = made.offset(
        np.radians(60), np.radians(25), np.tan(np.array([0.0, 14.0, 16.0, 40.0]) * ARCMIN), 0.0
    )
    scan = made.observation(lon, lat, centre=(np.radians(60), np.radians(25)))
    got = made.look(SkyMap(file=save(np.ones((60, 60)), header), outside="0.5 K"), scan)[0]
    np.testing.assert_allclose(
        got, [1, 1, 0.5, 0.5], atol=1e-4
    )  # 8 grid points from the edge: 0.27^8
    assert scan.log.get("SkyMap", "samples outside the input map") == 2


@pytest.mark.parametrize("kind", ["TAN", "SIN", "ZEA"])
def test_pixel_areas(made, kind):
    header = made.tan_header((60, 70), cdelt=(-600.0, 600.0))
    header["CTYPE1"], header["CTYPE2"] = f"RA---{kind}", f"DEC--{kind}"
    image = ImageMap(values=np.zeros((60, 70)), unit="K_RJ", wcs=WCS(header))
    areas = image.areas(tuple(np.indices((60, 70))))
    if kind == "ZEA":  # equal-area by name
        np.testing.assert_allclose(areas, (600 * ARCMIN / 60) ** 2, rtol=1e-5)
    if kind == "TAN":
        from zonda.core.numerics.projection import pixel_matrix

        np.testing.assert_allclose(
            areas, tangent_areas(pixel_matrix(WCS(header)), (60, 70)), rtol=1e-5
        )
    if kind == "SIN":  # dOmega = dx dy / cos(theta)
        y, x = np.mgrid[0:60, 0:70]
        r = np.hypot(x - 34.5, y - 29.5) * 10 * ARCMIN
        np.testing.assert_allclose(areas, (10 * ARCMIN) ** 2 / np.sqrt(1 - r * r), rtol=1e-5)


def test_jansky_per_pixel_of_another_projection(made, save):
    header = made.tan_header((150, 150), ra=60.0, dec=25.0, cdelt=(-30.0, 30.0), unit="Jy/pixel")
    header["CTYPE1"], header["CTYPE2"] = "RA---ZEA", "DEC--ZEA"
    scan, _ = scan_about(made, 60.0, 25.0)
    got = made.look(SkyMap(file=save(np.ones((150, 150)), header)), scan)[0]
    np.testing.assert_allclose(
        got, to_kelvin_rj("Jy/pixel", made.BAND, (0.5 * ARCMIN) ** 2), rtol=1e-5
    )


def test_flux_beyond_a_projection_is_counted(made, save):
    header = made.tan_header(
        (150, 150), ra=60.0, dec=25.0, cdelt=(-1.2 * 3600, 1.2 * 3600), unit="Jy/pixel"
    )
    header["CTYPE1"], header["CTYPE2"] = (
        "RA---ZEA",
        "DEC--ZEA",
    )  # the sphere is a disc of 114.6 deg: the corners are off it
    values = np.ones((150, 150))
    values[0, :3], values[75, 75] = 0.0, 2.0
    scan, _ = scan_about(made, 60.0, 25.0)
    made.look(SkyMap(file=save(values, header), beam="none"), scan)
    y, x = np.mgrid[:150, :150] - 74.5
    beyond = (np.hypot(x, y) * np.radians(1.2) > 2) & (values != 0)
    counted = scan.log.get(
        "SkyMap", "bright pixels of the input map beyond its projection, whose flux is lost"
    )
    assert abs(counted - beyond.sum()) < 0.05 * beyond.sum()  # by the midpoints of edges


# --------------------------------------------------------------------------------------------------
# HEALPix


def healpix(path, nside, nest=False, frame="C", partial=None, scale=0.02, **more):
    """Write the field as a HEALPix map; ``partial``: only pixels for which it is True of the ICRS
    vectors.
    """
    d = np.stack(healpy.pix2vec(nside, np.arange(12 * nside**2), nest=nest), axis=1)
    if frame == "G":
        sky = SkyCoord(*d.T, representation_type="cartesian", frame="galactic").icrs
        d = np.moveaxis(sky.cartesian.xyz.value, 0, -1)
    values = field(d, scale)
    if partial is not None:
        values[~partial(d)] = healpy.UNSEEN
    options = {
        "nest": nest,
        "coord": frame,
        "column_units": "K_RJ",
        "dtype": np.float64,
        "partial": partial is not None,
        **more,
    }
    healpy.write_map(path, values, overwrite=True, **options)
    return path


@pytest.mark.parametrize("nest", [False, True])
@pytest.mark.parametrize("frame", ["C", "G"])
@pytest.mark.parametrize(
    ("ra", "dec"), [(60.0, 25.0), (0.0, 0.0), (45.0, 41.8103), (90.0, 88.0), (270.0, -60.0)]
)
def test_healpix_against_the_analytic_field(made, tmp_path, nest, frame, ra, dec):
    """In the equatorial belt, at face edges, at the caps' border and by a pole."""
    nside = 256
    path = healpix(tmp_path / "h.fits", nside, nest, frame, scale=0.1)
    scan, directions = scan_about(made, ra, dec, reach=np.radians(1.0))
    got = made.look(SkyMap(file=path, beam="none"), scan)[0]
    # waves of 0.1 rad / 1.4 on pixels of 0.004 rad: h k = 0.057, (h k)^4 = 1e-5 times the fit's
    # constant, amplitude 1.8
    np.testing.assert_allclose(got, field(directions, 0.1), atol=3e-5)
    assert scan.log.get("SkyMap", "samples outside the input map") == 0


def test_partial_healpix_and_its_border(made, tmp_path):
    centre = unit(np.radians(60.0), np.radians(25.0))
    for nest in (False, True):
        path = healpix(
            tmp_path / "p.fits",
            256,
            nest,
            partial=lambda d: d @ centre > np.cos(np.radians(2.0)),
            scale=0.1,
        )
        east = np.radians(
            [0.0, 1.0, 1.4, 2.6, 3.0]
        )  # away from the jump at 2 deg, where any spline rings
        lon, lat = made.offset(np.radians(60), np.radians(25), np.tan(east), 0.0)
        scan = made.observation(lon, lat, centre=(np.radians(60), np.radians(25)))
        got = made.look(SkyMap(file=path, beam="none", outside="7 K"), scan)[0]
        exact = field(unit(lon, lat), 0.1)
        np.testing.assert_allclose(got, [*exact[:3], 7, 7], atol=1e-4)
        assert scan.log.get("SkyMap", "samples outside the input map") == 2


def test_healpix_far_away(made, tmp_path):
    centre = unit(np.radians(60.0), np.radians(25.0))
    path = healpix(tmp_path / "p.fits", 64, partial=lambda d: d @ centre > np.cos(np.radians(2.0)))
    scan = made.observation(np.full(20, np.radians(200.0)), np.radians(-40.0))
    np.testing.assert_array_equal(made.look(SkyMap(file=path), scan), 0.0)
    assert scan.log.get("SkyMap", "samples outside the input map") == 20


def test_constant_healpix_is_constant(made, tmp_path):
    """Also with holes: the fit reproduces polynomials, so a constant whatever is missing around."""
    values = np.full(12 * 64**2, 3.0)
    values[np.random.default_rng(2).random(values.size) < 0.3] = healpy.UNSEEN
    healpy.write_map(tmp_path / "c.fits", values, coord="C", column_units="K_RJ", dtype=np.float64)
    source = read_map(tmp_path / "c.fits")
    (got,), covered, poor = interpolated(
        source, tangent_grid_wcs(1.0, 0.4, (-14, 15, -14, 15), np.radians(0.3))
    )
    assert 0.5 < covered.mean() < 0.9
    np.testing.assert_allclose(got[covered], 3.0, rtol=1e-9)
    assert not got[~covered].any()
    assert poor == 0


def test_grid_points_without_a_fit_are_counted(made, tmp_path):
    """On a line of pixels no third-order polynomial is determined: the mean of the neighbours, and
    said so.
    """
    ring = healpy.query_strip(
        512, np.pi / 2 - 1e-4, np.pi / 2 + 1e-4, inclusive=False
    )  # the equator, straight on the plane
    values = np.full(12 * 512**2, healpy.UNSEEN)
    values[ring] = 2.0
    path = tmp_path / "line.fits"
    healpy.write_map(path, values, coord="C", column_units="K_RJ", dtype=np.float64)
    lon = np.radians(60.0) + np.linspace(-0.03, 0.03, 50)
    scan = made.observation(lon, 0.0, centre=(np.radians(60), 0.0))
    np.testing.assert_allclose(made.look(SkyMap(file=path, beam="none"), scan), 2.0)
    assert (
        scan.log.get(
            "SkyMap",
            "grid points whose neighbours determine no third-order fit, taken as their mean",
        )
        > 0
    )


@pytest.mark.parametrize("number", [1, 4, 9, 18, 23])
def test_partial_maps_of_a_few_pixels(made, tmp_path, number):
    """A constant over so few pixels is that constant on each of them."""
    centre = unit(np.radians(60.0), np.radians(25.0))
    d = np.stack(healpy.pix2vec(256, np.arange(12 * 256**2)), axis=1)
    seen = np.sort(np.argsort(-(d @ centre))[:number])
    values = np.full(12 * 256**2, healpy.UNSEEN)
    values[seen] = 2.0
    path = tmp_path / "few.fits"
    healpy.write_map(path, values, coord="C", column_units="K_RJ", dtype=np.float64, partial=True)
    lon, lat = np.arctan2(d[seen, 1], d[seen, 0]), np.arcsin(d[seen, 2])
    scan = made.observation(lon, lat, centre=(np.radians(60.0), np.radians(25.0)))
    np.testing.assert_allclose(
        made.look(SkyMap(file=path, beam="none", outside="2 K"), scan), 2.0, rtol=1e-6
    )
    assert scan.log.get("SkyMap", "samples outside the input map") == 0


def test_a_full_map_of_twelve_pixels(made, tmp_path):
    healpy.write_map(
        tmp_path / "h.fits", np.full(12, 3.0), coord="C", column_units="K_RJ", dtype=np.float64
    )
    scan, _ = scan_about(made, 60.0, 25.0)
    np.testing.assert_allclose(
        made.look(SkyMap(file=tmp_path / "h.fits", beam="none"), scan), 3.0, rtol=1e-6
    )


@pytest.mark.parametrize("bad", [-9999.0, -1.0e10, 0.0])
def test_pixels_that_the_file_marks_as_bad_are_no_sky(made, tmp_path, bad):
    """BAD_DATA (HEALPix's FITS conventions) is what UNSEEN is, to the last bit."""
    near = healpy.query_disc(64, unit(np.radians(60.0), np.radians(25.5)), np.radians(0.3))
    scan, got = scan_about(made, 60.0, 25.0, reach=60 * ARCMIN)[0], []
    for name, value in (("unseen", healpy.UNSEEN), ("bad", bad)):
        values = np.full(12 * 64**2, 1.5)
        values[near] = value
        extra = [("BAD_DATA", bad)] if name == "bad" else []
        path = tmp_path / f"{name}.fits"
        healpy.write_map(
            path, values, coord="C", column_units="K_RJ", dtype=np.float64, extra_header=extra
        )
        assert len(read_map(path).values) == 12 * 64**2 - len(near)
        got.append(made.look(SkyMap(file=path, fwhm="30 arcmin"), scan))
    np.testing.assert_array_equal(*got)
    assert got[0].min() > 0.0


def test_bad_data_is_a_number(tmp_path):
    extra = [("BAD_DATA", "none")]
    healpy.write_map(
        tmp_path / "m.fits",
        np.ones(192),
        coord="C",
        column_units="K_RJ",
        dtype=np.float64,
        extra_header=extra,
    )
    with pytest.raises(InputError, match="BAD_DATA"):
        read_map(tmp_path / "m.fits")


def test_healpix_units(made, tmp_path):
    healpy.write_map(
        tmp_path / "c.fits",
        np.full(12 * 64**2, 3.0),
        coord="C",
        column_units="Jy/pixel",
        dtype=np.float64,
    )
    scan = made.observation(np.full(4, 1.0), 0.3)
    got = made.look(SkyMap(file=tmp_path / "c.fits", beam="none"), scan)
    np.testing.assert_allclose(
        got, 3 * to_kelvin_rj("Jy/pixel", made.BAND, healpy.nside2pixarea(64)), rtol=1e-9
    )


def test_observations_of_one_field_share_the_work(made, tmp_path):
    operator = SkyMap(file=healpix(tmp_path / "h.fits", 64))
    first, _ = scan_about(made, 60.0, 25.0)
    second, _ = scan_about(made, 60.0, 25.0, psi=0.3)
    assert operator.prepare(first).beams[0] is operator.prepare(second).beams[0]


def test_another_scale_needs_a_tan_map(made, save):
    header = made.tan_header((20, 20), ra=60.0, dec=25.0)
    header["CTYPE1"], header["CTYPE2"] = "RA---SIN", "DEC--SIN"
    path = save(np.zeros((20, 20)), header)
    with pytest.raises(InputError, match="pixel_size cannot replace"):
        SkyMap(file=path, pixel_size="1 arcsec").prepare(made.observation([0.0], 0.0))


def test_ecliptic_healpix(tmp_path, made):
    nside = 64
    d = np.stack(healpy.pix2vec(nside, np.arange(12 * nside**2)), axis=1)
    icrs = SkyCoord(*d.T, representation_type="cartesian", frame="barycentricmeanecliptic").icrs
    values = field(np.moveaxis(icrs.cartesian.xyz.value, 0, -1), 0.5)
    healpy.write_map(tmp_path / "e.fits", values, coord="E", column_units="K_RJ", dtype=np.float64)
    scan, directions = scan_about(made, 60.0, 25.0, reach=np.radians(2.0))
    got = made.look(SkyMap(file=tmp_path / "e.fits", beam="none"), scan)[0]
    np.testing.assert_allclose(got, field(directions, 0.5), atol=1e-4)


def test_an_image_without_data_is_no_map(tmp_path):
    fits.HDUList(
        [
            fits.PrimaryHDU(),
            fits.BinTableHDU.from_columns([fits.Column("a", "E", array=np.zeros(3))]),
        ]
    ).writeto(tmp_path / "t.fits")
    with pytest.raises(InputError, match="no image of two axes and no HEALPix table"):
        read_map(tmp_path / "t.fits")
