"""Maps of I, Q and U seen by polarized detectors: in every projection Q and U are those of the
map's own meridians.
"""

import healpy
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS

from zonda.core.errors import InputError
from zonda.core.maps.map_reading import STOKES
from zonda.core.numerics.projection import directions, frame_rotation
from zonda.core.numerics.sphere import local_axes
from zonda.core.polarization import PolarizationAngles, between_meridians, turned_by
from zonda.operators.sky.skymap import SkyMap

STOKES_I, Q, U = 1.0, 0.3, -0.2
N_DET = 6


def a_scan(made, dec=20.0, spread=0.05, n=300, efficiency=0.9):
    """A boresight about (75 deg, dec) that rolls, with detectors of all angles; the last one is not
    polarized.
    """
    rng = np.random.default_rng(1)
    ra0, dec0 = np.radians(75.0), np.radians(dec)
    ra, de = made.offset(ra0, dec0, *rng.uniform(-1, 1, (2, n)) * np.radians(spread))
    xi, eta = rng.uniform(-1, 1, (2, N_DET)) * np.radians(spread)
    o = made.observation(
        ra, de, xi=xi, eta=eta, psi=rng.uniform(0, 6, n), centre=(ra0, dec0), fwhm=120.0
    )
    o.focalplane.polarization_angle[:] = rng.uniform(0, 6, N_DET)
    o.focalplane.polarization_efficiency[:] = efficiency
    o.focalplane.polarization_efficiency[-1] = 0.0
    return o


def seen(o, values=(STOKES_I, Q, U), frame="icrs", turn=None):
    """What the detectors see of I, Q and U (each a number or (n_det, n_samp)) of the meridians of a
    frame.
    """
    pole = frame_rotation(frame)[2] if turn is None else turn[2]
    cosine, sine = np.empty((2, o.n_detectors, o.n_samples))
    PolarizationAngles.of(o, o.boresight_radec, pole).fill(
        np.arange(o.n_detectors), 0, cosine, sine
    )
    i, q, u = values
    return i + o.focalplane.polarization_efficiency[:, None] * (q * cosine + u * sine)


def stokes_header(made, shape, **more):
    cards = {"CTYPE3": "STOKES", "CRVAL3": 1.0, "CDELT3": 1.0, "CRPIX3": 1.0, "POLCCONV": "COSMO"}
    return made.tan_header(shape, **(cards | more))


def uniform(shape):
    return np.stack([np.full(shape, value) for value in (STOKES_I, Q, U)])


@pytest.mark.parametrize("dec", [20.0, -86.0])
@pytest.mark.parametrize("frame", ["icrs", "galactic"])
def test_uniform_i_q_u_of_a_tan_image_to_rounding(made, save, dec, frame):
    header = stokes_header(made, (128, 128), dec=dec, cdelt=(-20.0, 20.0))
    if frame == "galactic":
        middle = SkyCoord(75.0, dec, unit="deg").galactic
        header.update(
            CTYPE1="GLON-TAN", CTYPE2="GLAT-TAN", CRVAL1=middle.l.deg, CRVAL2=middle.b.deg
        )
        del header["RADESYS"]
    o = a_scan(made, dec)
    found = made.look(SkyMap(file=save(uniform((128, 128)), header), beam="none"), o)
    # splines between pixels: Q and U turn by 2 sin(dec) x / cos(dec), of which the fourth order in
    # a pixel of 1e-4 rad is (2e-4 tan(dec))^4 / 384, 2e-13 at 86 deg; 30 pixels from the edge the
    # border is felt by 0.27^30 = 1e-17
    np.testing.assert_allclose(found, seen(o, frame=frame), rtol=0, atol=1e-12)


@pytest.mark.parametrize("interpolation", ["cubic", "linear"])
def test_a_beam_leaves_uniform_i_q_u_as_they_are(made, save, interpolation):
    path = save(uniform((256, 256)), stokes_header(made, (256, 256), cdelt=(-20.0, 20.0)))
    o = a_scan(made)
    found = made.look(SkyMap(file=path, interpolation=interpolation), o)
    # of 6 pixels per FWHM a beam ripples by 4 exp(-2 pi^2 2.5^2); meridians turn by 6e-4 rad within
    # a beam of 6e-4 rad
    np.testing.assert_allclose(found, seen(o), rtol=0, atol=1e-6)


def test_values_at_pixel_centres_to_rounding(made, save):
    """A random map: at the centres of pixels splines are exact, whatever the map."""
    values = np.random.default_rng(2).normal(size=(3, 96, 96))
    header = stokes_header(made, (96, 96), dec=60.0, cdelt=(-20.0, 20.0))
    y, x = (k.ravel() for k in np.mgrid[40:56, 40:56])
    ra, dec = np.radians(WCS(header).celestial.wcs_pix2world(x, y, 0))
    o = made.observation(ra, dec, psi=np.linspace(0, 5, ra.size))
    o.focalplane.polarization_efficiency[:] = 1.0
    found = made.look(SkyMap(file=save(values, header), beam="none"), o)
    # directions are rounded to some 1e-16 rad, 1e-12 to 1e-11 of a pixel, over which a random map
    # changes by a few of that
    np.testing.assert_allclose(found, seen(o, values[:, y, x][:, None, :]), rtol=0, atol=1e-10)


@pytest.mark.parametrize("projection", ["CAR", "HEALPix", "HEALPix of Galactic coordinates"])
def test_uniform_i_q_u_of_other_projections(made, save, tmp_path, projection):
    o, frame = a_scan(made, dec=55.0), "galactic" if "Galactic" in projection else "icrs"
    if projection == "CAR":
        header = stokes_header(made, (200, 200), cdelt=(-30.0, 30.0))
        header.update(CTYPE1="RA---CAR", CTYPE2="DEC--CAR", CRVAL2=0.0, CRPIX2=100.5 - 55.0 * 120)
        path = save(uniform((200, 200)), header)
    else:
        nside, coord = 512, "G" if frame == "galactic" else "C"
        path = tmp_path / "sphere.fits"
        healpy.write_map(
            path,
            uniform(12 * nside**2),
            coord=coord,
            column_units="K_RJ",
            dtype=np.float64,
            partial=False,
        )
    found = made.look(SkyMap(file=path, beam="none", pixels_per_fwhm=2), o)
    # third order in pixels of 2e-3 rad (HEALPix) or 1.5e-4 rad, over which meridians turn by as
    # much times tan(55 deg)
    np.testing.assert_allclose(
        found, seen(o, frame=frame), rtol=0, atol=1e-7 if projection != "CAR" else 1e-9
    )


def test_a_map_in_another_frame_gives_the_same(made, save, tmp_path):
    """One field on the sky, tabulated in ICRS and in Galactic coordinates: Q and U differ, what is
    seen does not.
    """
    nside, o = 256, a_scan(made, dec=30.0, spread=0.5)
    d = np.array(healpy.pix2vec(nside, np.arange(12 * nside**2))).T

    def field(icrs):
        x, y, z = icrs.T
        return np.array([1 + x * y, 0.3 + 0.5 * z * x, 0.2 * y - 0.1 * z])

    found = []
    for coord, frame in (("C", "icrs"), ("G", "galactic")):
        turn = frame_rotation(frame)
        values = field(d @ turn)  # d are directions in the frame
        values[1:] = turned_by(
            values[1:], between_meridians(d @ turn, np.array([0.0, 0.0, 1.0]), turn[2])
        )
        path = tmp_path / f"{coord}.fits"
        healpy.write_map(path, values, coord=coord, column_units="K_RJ", dtype=np.float64)
        found.append(made.look(SkyMap(file=path, beam="none", pixels_per_fwhm=2), o))
    np.testing.assert_allclose(
        *found, rtol=0, atol=2e-7
    )  # third order in pixels of 4e-3 rad: (4e-3)^3 a few
    sky = directions(o.boresight_radec, o.focalplane.xi, o.focalplane.eta)
    expected = seen(o, field(sky.reshape(-1, 3)).reshape(3, *sky.shape[:2]))
    np.testing.assert_allclose(found[0], expected, rtol=0, atol=2e-7)


def test_a_moved_map_keeps_its_pattern(made, save):
    """``centre`` turns the sphere: Q and U stay what they are from the map's own meridians, which
    turn with it.
    """
    path = save(
        uniform((128, 128)), stokes_header(made, (128, 128), ra=10.0, dec=80.0, cdelt=(-20.0, 20.0))
    )
    o = a_scan(made)
    found = made.look(SkyMap(file=path, centre="75 deg 20 deg", beam="none"), o)
    turn = local_axes(*np.radians([10.0, 80.0])).T @ local_axes(*np.radians([75.0, 20.0]))
    np.testing.assert_allclose(
        found, seen(o, turn=turn), rtol=0, atol=1e-7
    )  # its middle lies between pixels, 1e-9 deg


@pytest.mark.parametrize("kind", ["TAN", "CAR"])
@pytest.mark.parametrize("frame", ["icrs", "galactic"])
def test_a_map_moved_onto_its_own_centre_stays_as_it_is(made, save, kind, frame):
    """Galactic north is 57.6 deg from that of ICRS there; the image's reference point is far from
    its middle.
    """
    middle = SkyCoord(83.6, 22.0, unit="deg").transform_to(frame).spherical
    header = stokes_header(
        made,
        (96, 96),
        ra=middle.lon.deg,
        dec=middle.lat.deg,
        cdelt=(-20.0, 20.0),
        crpix=(-3000.0, 48.5),
    )
    header.update({f"CTYPE{k}": f"{name}{kind}" for k, name in ((1, "RA---"), (2, "DEC--"))})
    if frame == "galactic":
        header.update({f"CTYPE{k}": f"{name}{kind}" for k, name in ((1, "GLON-"), (2, "GLAT-"))})
        del header["RADESYS"]
    header["CRVAL2"] = 0.0 if kind == "CAR" else header["CRVAL2"]
    wcs = WCS(header).celestial
    own = wcs.pixel_to_world(47.5, 47.5).icrs
    y, x = np.random.default_rng(5).uniform(30, 65, (2, 200))
    at = wcs.pixel_to_world(x, y).icrs
    o = made.observation(
        at.ra.rad,
        at.dec.rad,
        psi=np.linspace(0, 6, 200),
        centre=(own.ra.rad, own.dec.rad),
        fwhm=60.0,
    )
    o.focalplane.polarization_efficiency[:] = 0.9
    path = save(np.random.default_rng(6).standard_normal((3, 96, 96)), header)
    stays = made.look(SkyMap(file=path), o)
    moved = made.look(SkyMap(file=path, centre=f"{own.ra.deg:.12f} deg {own.dec.deg:.12f} deg"), o)
    # directions are rounded to 1e-12 deg; the tangent point of the grid is the same
    np.testing.assert_allclose(moved, stays, atol=1e-8)
    assert stays.std() > 0.1


def test_iau_is_cosmo_with_the_other_sign_of_u(made, save):
    values = np.random.default_rng(3).normal(size=(3, 9, 9))
    read = {}
    for convention in ("COSMO", "IAU"):
        path = save(values, stokes_header(made, (9, 9), POLCCONV=convention), f"{convention}.fits")
        read[convention] = SkyMap(file=path).read_input(True).polarization
        given = {"COSMO": "iau", "IAU": "cosmo"}[convention]
        other = SkyMap(file=path, polarization_convention=given).read_input(True)
        np.testing.assert_array_equal(other.polarization, read[convention] * [[[1]], [[-1]]])
        assert "overridden" in other.notes["polarization"]
    np.testing.assert_array_equal(read["IAU"], read["COSMO"] * [[[1]], [[-1]]])
    np.testing.assert_array_equal(read["COSMO"], values[1:])


def test_an_image_that_does_not_say_its_convention_is_refused(made, save):
    header = stokes_header(made, (9, 9))
    del header["POLCCONV"]
    path = save(uniform((9, 9)), header)
    with pytest.raises(InputError, match="no POLCCONV") as caught:
        SkyMap(file=path).read_input(True)
    assert "polarization_convention" in caught.value.cure
    assert SkyMap(file=path, polarization_convention="cosmo").read_input(
        True
    ).polarization.shape == (
        2,
        9,
        9,
    )
    with pytest.warns(UserWarning, match="Q, U are not used"):  # by a camera that is not polarized
        assert SkyMap(file=path).read_input().polarization is None
    path = save(uniform((9, 9)), stokes_header(made, (9, 9), POLCCONV="EUROPEAN"))
    with pytest.raises(InputError, match="neither COSMO nor IAU"):
        SkyMap(file=path).read_input(True)


@pytest.mark.parametrize("partial", [False, True])
def test_healpix_that_does_not_say_it_is_cosmo(tmp_path, partial):
    values = np.random.default_rng(4).normal(size=(3, 192))
    values[:, 5] = healpy.UNSEEN
    healpy.write_map(
        tmp_path / "m.fits",
        values,
        coord="C",
        column_units="K_RJ",
        dtype=np.float64,
        partial=partial,
    )
    found = SkyMap(file=tmp_path / "m.fits").read_input(True)
    np.testing.assert_array_equal(found.values, np.delete(values[0], 5))
    np.testing.assert_array_equal(found.polarization, np.delete(values[1:], 5, axis=1))
    assert "COSMO" in found.notes["polarization"]
    assert STOKES not in found.notes


def test_planes_in_extensions(made, tmp_path):
    values = np.random.default_rng(5).normal(size=(3, 9, 9))
    header = made.tan_header((9, 9), POLCCONV="COSMO")
    images = [
        fits.ImageHDU(plane, header, name=name) for plane, name in zip(values, "IQU", strict=True)
    ]
    fits.HDUList([fits.PrimaryHDU(), *images]).writeto(tmp_path / "iqu.fits")
    found = SkyMap(file=tmp_path / "iqu.fits").read_input(True)
    np.testing.assert_array_equal(found.values, values[0])
    np.testing.assert_array_equal(found.polarization, values[1:])


def test_an_array_of_three_images(made):
    values = np.random.default_rng(6).normal(size=(3, 9, 9))
    step = SkyMap(
        map=values, wcs=made.tan_header((9, 9)), unit="K_RJ", polarization_convention="iau"
    )
    found = step.read_input(True)
    np.testing.assert_array_equal(found.values, values[0])
    np.testing.assert_array_equal(found.polarization, values[1:] * [[[1]], [[-1]]])


def test_missing_pixels_of_u_are_zero_where_that_is_wanted(made, save):
    values = uniform((9, 9))
    values[2, 3, 4] = np.nan
    path = save(values, stokes_header(made, (9, 9)))
    with pytest.raises(InputError, match="plane 2 of Q and U, row 4, column 5"):
        SkyMap(file=path).read_input(True)
    found = SkyMap(file=path, missing="zero").read_input(True)
    assert found.polarization[1, 3, 4] == 0
    assert found.zeroed == 1


def test_blocks_do_not_change_the_bits(made, save):
    path = save(
        np.random.default_rng(7).normal(size=(3, 64, 64)),
        stokes_header(made, (64, 64), cdelt=(-20.0, 20.0)),
    )
    o = a_scan(made, n=1000)
    operator = SkyMap(file=path)
    whole = made.look(operator, o, dtype=np.float32)
    cut = made.look(operator, o, dtype=np.float32, cuts=([0, 2, 5], [0, 256, 768]))
    np.testing.assert_array_equal(whole, cut)


def test_detectors_that_are_not_polarized_see_the_bits_of_an_intensity_map(made, save):
    values = np.random.default_rng(8).normal(size=(3, 64, 64))
    header = stokes_header(made, (64, 64), cdelt=(-20.0, 20.0))
    both, alone = (
        save(values, header, "iqu.fits"),
        save(values[0], made.tan_header((64, 64), cdelt=(-20.0, 20.0)), "i.fits"),
    )
    o = a_scan(made)
    polarized = made.look(SkyMap(file=both), o)
    o.focalplane.polarization_efficiency[:] = 0
    plain = made.look(SkyMap(file=alone), o)
    np.testing.assert_array_equal(polarized[-1], plain[-1])
    assert (polarized[:-1] != plain[:-1]).mean() > 0.99
