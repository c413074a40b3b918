"""What a beam sees of a map is the sum over the map's pixels, each of its own solid angle: in every
projection, anywhere.

The sums here are numpy's, of directions by astropy; solid angles are of pixels cut into 4 x 4 and
integrated over the sphere.
"""

import healpy
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS

from zonda.core.numerics.radiation import to_kelvin_rj
from zonda.core.polarization import PolarizationAngles
from zonda.operators.sky.skymap import SkyMap

ARCMIN = np.pi / 10800
SIGMA = 1 / np.sqrt(8 * np.log(2))


def directions(wcs, x, y):
    """ICRS unit vectors (..., 3) of 0-based pixels."""
    sky = wcs.pixel_to_world(x, y).icrs
    return np.moveaxis(np.asarray(sky.cartesian.xyz.value), 0, -1)


def solid_angles(wcs, x, y, parts=4):
    """Of the pixels about (x, y): the triangles of ``parts`` x ``parts`` pieces on the sphere,
    summed.
    """
    edges = np.linspace(-0.5, 0.5, parts + 1)
    corner = directions(wcs, x[..., None, None] + edges, y[..., None, None] + edges[:, None])
    a, b, c, d = (
        corner[..., :-1, :-1, :],
        corner[..., :-1, 1:, :],
        corner[..., 1:, 1:, :],
        corner[..., 1:, :-1, :],
    )
    doubled = sum(
        np.linalg.norm(np.cross(q - p, r - p), axis=-1) for p, q, r in ((a, b, c), (a, c, d))
    )
    return doubled.sum(axis=(-1, -2)) / 2


def beam(at, pixels, fwhm):
    """(n_at, n_pixel) Gaussians of unit integral."""
    r = 2 * np.arcsin(np.linalg.norm(at[:, None] - pixels[None], axis=2) / 2)
    return np.exp(-(r**2) / (2 * (SIGMA * fwhm) ** 2)) / (2 * np.pi * (SIGMA * fwhm) ** 2)


def around(centre, reach, n=200, seed=1):
    """ICRS directions (n, 3) within ``reach`` [rad] of one."""
    rng = np.random.default_rng(seed)
    axes = np.linalg.svd(centre[None])[2][1:]
    d = centre + np.tan(reach) * rng.uniform(-1, 1, (n, 2)) @ axes
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def seen(made, operator, d, fwhm, centre=None, **more):
    lon, lat = np.arctan2(d[:, 1], d[:, 0]), np.arcsin(d[:, 2])
    middle = d.mean(axis=0) if centre is None else centre
    at = np.arctan2(middle[1], middle[0]), np.arctan2(middle[2], np.hypot(middle[0], middle[1]))
    return made.look(
        operator, made.observation(lon, lat, centre=at, fwhm=fwhm / ARCMIN * 60, **more)
    )[0]


def header_of(
    made, kind, dec, sides=(1.0, 1.0), rotation=0.0, shape=(90, 90), unit="Jy/pixel", frame="RA"
):
    """A map whose middle is at (75 deg, dec), with pixels of ``sides`` [arcmin], by nature's own
    reference point.
    """
    header = made.tan_header(
        shape, ra=75.0, dec=dec, cdelt=(-60.0 * sides[0], 60.0 * sides[1]), unit=unit
    )
    if frame == "GLON":
        middle = SkyCoord(75.0, dec, unit="deg").galactic
        header["CRVAL1"], header["CRVAL2"] = middle.l.deg, middle.b.deg
        del header["RADESYS"]
    names = ("RA---", "DEC--") if frame == "RA" else ("GLON-", "GLAT-")
    header["CTYPE1"], header["CTYPE2"] = names[0] + kind, names[1] + kind
    c, s = np.cos(np.radians(rotation)), np.sin(np.radians(rotation))
    header["PC1_1"], header["PC1_2"], header["PC2_1"], header["PC2_2"] = c, -s, s, c
    if kind in (
        "CAR",
        "CEA",
        "MOL",
        "AIT",
        "SFL",
        "MER",
        "CYP",
        "PAR",
    ):  # whose own reference lies on the equator
        lat, header["CRVAL2"] = header["CRVAL2"], 0.0
        if kind == "CEA":  # 1 / cos as high
            header["CDELT2"] *= np.cos(np.radians(lat))
        if kind == "CYP":
            header["PV2_1"], header["PV2_2"] = 1.0, 0.8
        x, y = WCS(header).wcs_world2pix(
            header["CRVAL1"] + 5 / 60, lat, 1
        )  # a little beside the central meridian
        header["CRPIX1"] += (shape[1] + 1) / 2 - float(x)
        header["CRPIX2"] += (shape[0] + 1) / 2 - float(y)
    return header


KINDS = ["TAN", "CAR", "SIN", "ZEA", "CEA", "ARC", "STG", "MOL", "AIT", "SFL", "MER", "CYP"]


@pytest.mark.parametrize("rotation", [0.0, 33.0])
@pytest.mark.parametrize("sides", [(1.0, 1.0), (0.4, 1.0)], ids=["square", "oblong"])
@pytest.mark.parametrize("dec", [0.0, 30.0, -60.0, 80.0])
@pytest.mark.parametrize("kind", KINDS)
def test_one_bright_pixel(made, save, kind, dec, sides, rotation):
    """1 Jy in one pixel is 1 Jy over the beam at its centre, wherever that lies between points of
    any grid.
    """
    header, fwhm = header_of(made, kind, dec, sides, rotation), 2.4 * ARCMIN
    wcs = WCS(header)
    factor = to_kelvin_rj("Jy/beam", made.BAND, None, 0.0, 1.0)
    for row, column in ((45, 45), (43, 50)):
        values = np.zeros((90, 90))
        values[row, column] = 1.0
        pixel = directions(wcs, np.array([column]), np.array([row]))
        d = np.concatenate([pixel, around(pixel[0], 1.3 * fwhm)])
        got = seen(
            made,
            SkyMap(file=save(values, header)),
            d,
            fwhm,
            centre=around(pixel[0], fwhm, 1, row)[0],
        )
        expected = factor * beam(d, pixel, fwhm)[:, 0]
        # 5 points of the grid per FWHM err by 6e-4; TAN images with 2.4 pixels, of which they are
        # halves: 4.8
        np.testing.assert_allclose(
            got, expected, atol=(3e-3 if kind == "TAN" else 1e-3) * expected[0]
        )


@pytest.mark.parametrize("dec", [60.0, 80.0])
@pytest.mark.parametrize("kind", ["MER", "CAR", "CEA"])
def test_whether_pixels_are_resolved_is_asked_where_they_are(made, save, kind, dec):
    """Pixels that are larger by the header than where they are looked at (MER, CAR of CDELT1 = 1 /
    cos) are summed up; those that are larger there (CEA: 1 / cos as high) are smooth between their
    centres and leave no gaps."""
    header = header_of(made, kind, dec, (1.0, 1.0))
    if kind != "CEA":
        factor = 1 / np.cos(np.radians(dec))
        header["CDELT1"] *= factor
        header["CDELT2"] *= factor if kind == "MER" else 1.0
        x, y = WCS(header).wcs_world2pix(75.0, dec, 1)
        header["CRPIX1"] += 45 - float(x)
        header["CRPIX2"] += 45 - float(y)
    else:
        header["CDELT2"] = -header["CDELT1"]
        header["CRPIX2"] += 45 - float(WCS(header).wcs_world2pix(75.0, dec, 1)[1])
        header["BUNIT"] = "K_RJ"
    wcs, fwhm = WCS(header), 2.4 * ARCMIN
    values = np.ones((90, 90)) if kind == "CEA" else np.zeros((90, 90))
    values[44, 47] = 1.0
    pixel = directions(wcs, np.array([47]), np.array([44]))
    d = np.concatenate([pixel, around(pixel[0], 1.3 * fwhm)])
    got = seen(made, SkyMap(file=save(values, header)), d, fwhm)
    if kind == "CEA":
        np.testing.assert_allclose(got, 1.0, atol=1e-3)
    else:
        expected = to_kelvin_rj("Jy/beam", made.BAND, None, 0.0, 1.0) * beam(d, pixel, fwhm)[:, 0]
        np.testing.assert_allclose(got, expected, atol=1e-3 * expected[0])


@pytest.mark.parametrize("frame", ["RA", "GLON"])
@pytest.mark.parametrize("dec", [0.0, 60.0, 80.0])
@pytest.mark.parametrize("kind", ["TAN", "CAR", "ZEA", "CEA", "MOL"])
def test_white_noise(made, save, kind, dec, frame):
    """Brightness that differs from pixel to pixel counts by solid angles."""
    shape = (60, 300 if dec == 80 else 90)
    header, fwhm = header_of(made, kind, dec, unit="K_RJ", frame=frame, shape=shape), 2.4 * ARCMIN
    wcs = WCS(header)
    values = np.random.default_rng(2).standard_normal(shape)
    y, x = np.mgrid[: shape[0], : shape[1]]
    pixels, areas = directions(wcs, x, y).reshape(-1, 3), solid_angles(wcs, x, y).ravel()
    d = around(directions(wcs, np.array(shape[1] // 2), np.array(29)), 4 * ARCMIN)
    got = seen(made, SkyMap(file=save(values, header)), d, fwhm)
    expected = beam(d, pixels, fwhm) @ (areas * values.ravel())
    # the errors of a point source, 1e-3 (TAN 3e-3) of its peak and of both signs, of some 30 pixels
    # under the beam: rms of the stream is (4 pi (sigma/p)^2)^-1/2 = 0.28, so 5 sigma of their sum
    # are 5 x 1e-3 x 0.15 x 30^1/2
    np.testing.assert_allclose(got, expected, atol=4e-3 if kind != "TAN" else 1e-2)
    assert expected.std() > 0.1


@pytest.mark.parametrize("frame", ["C", "G"])
@pytest.mark.parametrize("nest", [False, True])
@pytest.mark.parametrize(("ra", "dec"), [(75.0, 20.0), (10.0, -60.0), (200.0, 80.0), (45.0, 41.81)])
@pytest.mark.parametrize("nside", [512, 2048])
def test_one_bright_healpix_pixel(made, tmp_path, nside, ra, dec, nest, frame):
    """No further smoothing by the pixel: the beam's peak is 1, at 2.3 pixels per FWHM and at 9."""
    fwhm, sphere = 16 * ARCMIN, "icrs" if frame == "C" else "galactic"
    middle = SkyCoord(ra, dec, unit="deg").transform_to(sphere).spherical
    number = int(healpy.ang2pix(nside, middle.lon.deg, middle.lat.deg, nest=nest, lonlat=True))
    own = SkyCoord(
        *healpy.pix2vec(nside, number, nest=nest), representation_type="cartesian", frame=sphere
    ).icrs
    pixel = np.asarray(own.cartesian.xyz.value)
    near = healpy.query_disc(
        nside, healpy.pix2vec(nside, number, nest=nest), np.radians(2.0), nest=nest
    )
    values = np.full(12 * nside**2, healpy.UNSEEN)
    values[near] = 0.0
    values[number] = 1.0
    options = {
        "nest": nest,
        "coord": frame,
        "column_units": "Jy/pixel",
        "dtype": np.float64,
        "partial": True,
    }
    healpy.write_map(tmp_path / "m.fits", values, **options)
    d = np.concatenate([pixel[None], around(pixel, 1.3 * fwhm)])
    got = seen(made, SkyMap(file=tmp_path / "m.fits"), d, fwhm, centre=around(pixel, fwhm, 1)[0])
    expected = to_kelvin_rj("Jy/beam", made.BAND, None, 0.0, 1.0) * beam(d, pixel[None], fwhm)[:, 0]
    np.testing.assert_allclose(got, expected, atol=1e-3 * expected[0])


def test_white_noise_of_healpix(made, tmp_path):
    nside, fwhm = 1024, 8 * ARCMIN
    values = np.random.default_rng(3).standard_normal(12 * nside**2)
    healpy.write_map(tmp_path / "m.fits", values, coord="C", column_units="K_RJ", dtype=np.float64)
    centre = np.array(healpy.ang2vec(75.0, 41.0, lonlat=True))
    near = healpy.query_disc(nside, centre, np.radians(1.0))
    d = around(centre, 10 * ARCMIN)
    expected = (
        beam(d, np.stack(healpy.pix2vec(nside, near), axis=1), fwhm)
        @ values[near]
        * healpy.nside2pixarea(nside)
    )
    np.testing.assert_allclose(
        seen(made, SkyMap(file=tmp_path / "m.fits"), d, fwhm), expected, atol=4e-3
    )


@pytest.mark.parametrize("angle", [2.0, 12.0, 35.0])
@pytest.mark.parametrize("kind", ["TAN", "ZEA", "healpix"])
def test_the_beam_is_right_far_from_the_tangent_point(made, save, tmp_path, kind, angle):
    """A wide field: the source lies ``angle`` from the middle of the scan, and of the TAN image."""
    fwhm, centre = np.radians(0.5), np.array(healpy.ang2vec(75.0, 20.0, lonlat=True))
    if kind == "healpix":
        values = np.zeros(12 * 512**2)
        number = healpy.ang2pix(512, 75.0 + angle / np.cos(np.radians(20)), 20.0, lonlat=True)
        values[number] = 1.0
        healpy.write_map(
            tmp_path / "m.fits", values, coord="C", column_units="Jy/pixel", dtype=np.float64
        )
        pixel, operator = np.array([healpy.pix2vec(512, number)]), SkyMap(file=tmp_path / "m.fits")
    else:
        n = int(2.6 * np.degrees(np.tan(np.radians(angle))) * 5) + 40
        header = made.tan_header((n, n), ra=75.0, dec=20.0, cdelt=(-720.0, 720.0), unit="Jy/pixel")
        header["CTYPE1"], header["CTYPE2"] = f"RA---{kind}", f"DEC--{kind}"
        x, y = (
            int(k) for k in WCS(header).wcs_world2pix(75.0 + 0.7 * angle, 20.0 + 0.7 * angle, 0)
        )
        values = np.zeros((n, n))
        values[y, x] = 1.0
        pixel, operator = (
            directions(WCS(header), np.array([x]), np.array([y])),
            SkyMap(file=save(values, header)),
        )
    d = np.concatenate(
        [pixel, around(pixel[0], 1.3 * fwhm), 2 * (pixel @ centre)[:, None] * centre - pixel]
    )
    got = seen(made, operator, d, fwhm, centre=centre)
    expected = to_kelvin_rj("Jy/beam", made.BAND, None, 0.0, 1.0) * beam(d, pixel, fwhm)[:, 0]
    np.testing.assert_allclose(got, expected, atol=2e-3 * expected[0])


def test_several_beams_in_a_wide_field(made, tmp_path):
    """Each detector its own, also where those of the grid are stretched by 1 / cos^3."""
    values = np.zeros(12 * 512**2)
    number = healpy.ang2pix(512, 75.0, 35.0, lonlat=True)
    values[number] = 1.0
    healpy.write_map(
        tmp_path / "m.fits", values, coord="C", column_units="Jy/pixel", dtype=np.float64
    )
    pixel = np.array([healpy.pix2vec(512, number)])
    d, fwhm = (
        np.concatenate([pixel, around(pixel[0], np.radians(0.4))]),
        np.array([30.0, 45.0]) * 60,
    )
    lon, lat = np.arctan2(d[:, 1], d[:, 0]), np.arcsin(d[:, 2])
    scan = made.observation(
        lon, lat, xi=np.zeros(2), eta=np.zeros(2), fwhm=fwhm, centre=np.radians((75.0, 20.0))
    )
    got = made.look(SkyMap(file=tmp_path / "m.fits"), scan)
    for row, width in zip(got, fwhm / 60 * ARCMIN, strict=True):
        expected = to_kelvin_rj("Jy/beam", made.BAND, None, 0.0, 1.0) * beam(d, pixel, width)[:, 0]
        np.testing.assert_allclose(row, expected, atol=1e-3 * expected[0])


def test_a_pole_inside_the_field(made, save):
    """The columns of CAR meet there: each pixel counts once, and counts what it is large."""
    shape, fwhm = (120, 1440), np.radians(0.8)  # pixels of 1/4 deg, dec 60 to 90
    header = made.tan_header(
        shape, ra=0.0, dec=0.0, crpix=(720.5, 1 - 4 * 60.125), cdelt=(-900.0, 900.0)
    )
    header["CTYPE1"], header["CTYPE2"] = "RA---CAR", "DEC--CAR"
    values = np.random.default_rng(4).standard_normal(shape)
    y, x = np.mgrid[60:120, :1440]
    pixels, areas = (
        directions(WCS(header), x, y).reshape(-1, 3),
        solid_angles(WCS(header), x, y).ravel(),
    )
    d = around(np.array([1e-3, 0.0, 1.0]), np.radians(1.0))
    got = seen(made, SkyMap(file=save(values, header)), d, fwhm)
    expected = beam(d, pixels, fwhm) @ (areas * values[60:].ravel())
    np.testing.assert_allclose(got, expected, atol=2e-3)
    assert expected.std() > 0.03


@pytest.mark.parametrize("columns", [720, 721, 730])
def test_columns_that_stand_for_the_same_sky_count_once(made, save, columns):
    """A plate-carree map of the whole sky, some of it twice, is uniform where its pixels are."""
    header = made.tan_header((360, columns), ra=0.0, dec=0.0, cdelt=(-1800.0, 1800.0))
    header["CTYPE1"], header["CTYPE2"] = "RA---CAR", "DEC--CAR"
    path = save(np.full((360, columns), 2.0), header)
    for ra in (180.0, 178.0, 0.0):
        d = around(np.array(healpy.ang2vec(ra, 10.0, lonlat=True)), np.radians(3.0))
        # left out is what a plane makes of the fourth power of angles: 8/3 sigma^2 = 2e-4 of a
        # uniform sky
        np.testing.assert_allclose(
            seen(made, SkyMap(file=path), d, np.radians(1.2)), 2.0, rtol=3e-4
        )


@pytest.mark.parametrize("dec", [60.0, 82.0])
def test_without_a_beam_no_pixel_is_skipped(made, save, dec):
    """A pixel of CAR is cos(dec) as wide as it is high: at the centres of pixels the stream is what
    they hold.
    """
    header = header_of(made, "CAR", dec, unit="K_RJ", shape=(40, 40))
    values = np.random.default_rng(5).standard_normal((40, 40))
    y, x = (k.ravel() for k in np.mgrid[15:25, 15:25])
    d = directions(WCS(header), x, y)
    got = seen(made, SkyMap(file=save(values, header), beam="none"), d, ARCMIN)
    # splines through white noise on a grid of steps of a quarter of the narrowest pixel
    np.testing.assert_allclose(got, values[15:25, 15:25].ravel(), atol=0.02)


@pytest.mark.parametrize("frame", ["RA", "GLON"])
@pytest.mark.parametrize("kind", ["TAN", "CAR", "ZEA"])
def test_a_moved_map_is_summed_where_it_is(made, save, kind, frame):
    """Every pixel stands at its distance and its angle from ICRS north from the new centre as it
    did from the old one.
    """
    header, fwhm = header_of(made, kind, 60.0, frame=frame, shape=(61, 121)), 2.4 * ARCMIN
    values = np.zeros((61, 121))
    values[40, 75] = 1.0
    middle, pixel = (WCS(header).pixel_to_world(x, y).icrs for x, y in ((60, 30), (75, 40)))
    target = SkyCoord(200.0, -10.0, unit="deg")
    there = target.directional_offset_by(middle.position_angle(pixel), middle.separation(pixel))
    source = np.asarray(there.cartesian.xyz.value)[None]
    d = np.concatenate([source, around(source[0], 1.3 * fwhm)])
    operator = SkyMap(file=save(values, header), centre="200 deg -10 deg")
    got = seen(made, operator, d, fwhm, centre=np.asarray(target.cartesian.xyz.value))
    expected = to_kelvin_rj("Jy/beam", made.BAND, None, 0.0, 1.0) * beam(d, source, fwhm)[:, 0]
    np.testing.assert_allclose(got, expected, atol=(3e-3 if kind == "TAN" else 1e-3) * expected[0])


@pytest.mark.parametrize("kind", ["CAR", "healpix"])
def test_q_and_u_are_summed_likewise(made, save, tmp_path, kind):
    """I, Q and U of white noise: Q and U of each pixel turned to the meridian where they are
    seen.
    """
    rng, fwhm = np.random.default_rng(6), 2.6 * ARCMIN if kind == "CAR" else 12 * ARCMIN
    if kind == "CAR":
        header = header_of(made, "CAR", 60.0, unit="K_RJ", shape=(60, 120))
        for key, value in {
            "CTYPE3": "STOKES",
            "CRVAL3": 1.0,
            "CDELT3": 1.0,
            "CRPIX3": 1.0,
            "POLCCONV": "COSMO",
        }.items():
            header[key] = value
        values, wcs = rng.standard_normal((3, 60, 120)), WCS(header).celestial
        path = save(values, header)
        y, x = np.mgrid[:60, :120]
        pixels, areas, values = (
            directions(wcs, x, y).reshape(-1, 3),
            solid_angles(wcs, x, y).ravel(),
            values.reshape(3, -1),
        )
        centre = directions(wcs, np.array(60), np.array(30))
    else:
        nside, path = 1024, tmp_path / "m.fits"
        values, centre = (
            rng.standard_normal((3, 12 * nside**2)),
            np.array(healpy.ang2vec(75.0, 60.0, lonlat=True)),
        )
        healpy.write_map(path, values, coord="C", column_units="K_RJ", dtype=np.float64)
        near = healpy.query_disc(nside, centre, np.radians(1.5))
        values, pixels, areas = (
            values[:, near],
            np.stack(healpy.pix2vec(nside, near), axis=1),
            healpy.nside2pixarea(nside),
        )
    d = around(centre, fwhm)
    lon, lat = np.arctan2(d[:, 1], d[:, 0]), np.arcsin(d[:, 2])
    scan = made.observation(
        lon,
        lat,
        psi=rng.uniform(0, 6, len(d)),
        centre=(lon.mean(), lat.mean()),
        fwhm=fwhm / ARCMIN * 60,
    )
    scan.focalplane.polarization_efficiency[:] = 1.0
    angles = np.empty((2, 1, len(d)))
    PolarizationAngles.of(scan, scan.boresight_radec, np.array([0.0, 0.0, 1.0])).fill(
        np.arange(1), 0, *angles
    )
    weights = beam(d, pixels, fwhm) * areas
    # a pixel's axes, carried along the great circle to where it is seen, stand to the meridian
    # there as they did at the pixel but for the turn of meridians, sin(dec) times the difference in
    # right ascension, 2e-3 rad in this field: by symmetry (dec'/2)
    longitudes, latitudes = np.arctan2(pixels[:, 1], pixels[:, 0]), np.arcsin(pixels[:, 2])
    turn = (lon[:, None] - longitudes) * np.sin((lat[:, None] + latitudes) / 2)
    q_and_u = (weights * np.exp(2j * turn)) @ (values[1] + 1j * values[2])
    expected = weights @ values[0] + q_and_u.real * angles[0, 0] + q_and_u.imag * angles[1, 0]
    np.testing.assert_allclose(made.look(SkyMap(file=path), scan)[0], expected, atol=8e-3)
    assert expected.std() > 0.1


@pytest.mark.parametrize("kind", ["CAR", "CYP", "HPX", "TSC"])
def test_seams_and_repeated_sky_leave_a_uniform_sky_uniform(made, kind):
    """450 deg of columns, a fifth of which repeat the sky of others; faces of a cube; where a
    projection closes.
    """
    header = made.tan_header((500, 900), ra=40.0, dec=0.0, cdelt=(-1800.0, 1800.0))
    header["CTYPE1"], header["CTYPE2"] = f"RA---{kind}", f"DEC--{kind}"
    if kind == "CYP":
        header["PV2_1"], header["PV2_2"] = 1.0, 0.8  # a full turn has 576 columns
    operator = SkyMap(map=fits.ImageHDU(np.ones((500, 900)), header))
    for ra, dec in ((40.0, 0.0), (85.0, 0.0), (220.0, 10.0), (310.0, -60.0)):
        d = around(np.array(healpy.ang2vec(ra, dec, lonlat=True)), np.radians(3.0))
        # 8/3 sigma^2 = 6e-4 of the fourth power of angles on a plane; creases between faces
        np.testing.assert_allclose(seen(made, operator, d, np.radians(2.0)), 1.0, atol=1.5e-3)


def test_pixels_at_the_edge_of_a_projection_count(made, save):
    """Half of this pixel is beyond the ellipse of AIT; it was taken for none."""
    header = made.tan_header((320, 640), ra=0.0, dec=0.0, cdelt=(-1800.0, 1800.0), unit="Jy/pixel")
    header["CTYPE1"], header["CTYPE2"] = "RA---AIT", "DEC--AIT"
    wcs = WCS(header)
    row = 160
    column = int(
        np.flatnonzero(np.isfinite(wcs.wcs_pix2world(np.arange(640), np.full(640, row), 0)[0]))[0]
    )
    values = np.zeros((320, 640))
    values[row, column] = 1.0
    pixel = directions(wcs, np.array([column]), np.array([row]))
    got = seen(
        made, SkyMap(file=save(values, header)), np.repeat(pixel, 3, axis=0), np.radians(1.5)
    )
    expected = (
        to_kelvin_rj("Jy/beam", made.BAND, None, 0.0, 1.0)
        * beam(pixel, pixel, np.radians(1.5))[0, 0]
    )
    np.testing.assert_allclose(got, expected, rtol=1e-3)


def test_linear_interpolation_of_spread_pixels(made, save):
    """Within its bound, 1.02 / n^2 of the peak on n points per FWHM, and of the right flux."""
    header, fwhm = header_of(made, "CAR", -60.0), 3.0 * ARCMIN
    values = np.zeros((90, 90))
    values[44, 47] = 1.0
    pixel = directions(WCS(header), np.array([47]), np.array([44]))
    d = np.concatenate([pixel, around(pixel[0], fwhm, 4000)])
    got = seen(
        made, SkyMap(file=save(values, header), interpolation="linear", pixels_per_fwhm=8), d, fwhm
    )
    expected = to_kelvin_rj("Jy/beam", made.BAND, None, 0.0, 1.0) * beam(d, pixel, fwhm)[:, 0]
    error = (got - expected) / expected[0]
    assert 1e-3 < np.abs(error).max() < 1.02 / 10**2
    assert abs((got @ expected) / (expected @ expected) - 1) < 1e-3
