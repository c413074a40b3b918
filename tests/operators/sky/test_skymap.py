import copy
import pickle
import threading

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from zonda.core.data import Data
from zonda.core.errors import InputError, ZondaError
from zonda.core.numerics.radiation import BOLTZMANN, sz_of_band, sz_per_y, to_kelvin_rj
from zonda.operators.sky.skymap import InputImage, SkyMap

ARCSEC = np.pi / 648000
FWHM = 9.0
SIGMA = FWHM / np.sqrt(8 * np.log(2))


def point(shape, where, flux=1.0):
    """A map with one bright pixel at (row, column)."""
    values = np.zeros(shape)
    values[where] = flux
    return values


def stare(made, ra, dec, reach=15.0, n=400, **more):
    """A scan at random offsets [arcsec] within ``reach`` of (ra, dec) [deg], and the offsets."""
    rng = np.random.default_rng(5)
    east, north = rng.uniform(-reach, reach, (2, n))
    east[0] = north[0] = 0.0
    lon, lat = made.offset(
        np.radians(ra), np.radians(dec), np.tan(east * ARCSEC), np.tan(north * ARCSEC)
    )
    return made.observation(lon, lat, **more), east, north


def gaussian(east, north, flux=1.0):
    """A point source of ``flux`` [value arcsec^2] seen by the beam."""
    return flux / (2 * np.pi * SIGMA**2) * np.exp(-(east**2 + north**2) / (2 * SIGMA**2))


# -------------------------------------------------------------------------------------------------
# what comes out


@pytest.mark.parametrize("shape", [(64, 64), (63, 65), (80, 51)])
@pytest.mark.parametrize("cdelt", [(-1.0, 1.0), (1.0, 1.0), (-1.0, -1.0), (-2.0, 1.5)])
def test_a_source_at_crval_lands_there(made, save, shape, cdelt):
    """Whatever CRPIX and the signs of CDELT; the offset is found by the centroid of the samples'
    departure.
    """
    crpix = (20.0, 41.0)
    path = save(point(shape, (40, 19)), made.tan_header(shape, crpix=crpix, cdelt=cdelt))
    scan, east, north = stare(made, 75.0, 20.0, fwhm=FWHM)
    got = made.look(SkyMap(file=path), scan)[0]
    exact = gaussian(east, north, abs(cdelt[0] * cdelt[1]))
    np.testing.assert_allclose(got, exact, atol=3e-3 * exact.max())
    # least-squares shift: d exact / d east = -east / sigma^2 exact
    slopes = np.stack([exact, exact * east, exact * north], axis=1)
    fit = np.linalg.lstsq(slopes, got, rcond=None)[0]
    shift = fit[1:] / fit[0] * SIGMA**2
    assert np.abs(shift).max() < 1e-3  # arcsec; pixels are 1 arcsec or larger


def test_flux_and_width_of_a_point_source(made, save):
    path = save(point((120, 120), (60, 60)), made.tan_header((120, 120), crpix=(61.0, 61.0)))
    n = 61
    grid = np.linspace(-30, 30, n)
    east, north = (g.ravel() for g in np.meshgrid(grid, grid))
    lon, lat = made.offset(
        np.radians(75), np.radians(20), np.tan(east * ARCSEC), np.tan(north * ARCSEC)
    )
    got = made.look(SkyMap(file=path), made.observation(lon, lat, fwhm=FWHM))[0]
    assert got.sum() * (60 / (n - 1)) ** 2 == pytest.approx(1.0, rel=1e-3)
    width = np.sqrt((got * east**2).sum() / got.sum() * 8 * np.log(2))
    assert width == pytest.approx(FWHM, rel=1e-3)
    assert got.max() == pytest.approx(gaussian(0, 0), rel=3e-3)


@pytest.mark.parametrize(
    "detail",
    [
        {"CROTA2": 30.0},
        {"PC1_1": 0.6, "PC1_2": -0.8, "PC2_1": 0.8, "PC2_2": 0.6},
        {"LONPOLE": 150.0},
    ],
)
def test_rotated_maps_agree_with_astropy(made, save, detail):
    header = made.tan_header((90, 100), crpix=(31.0, 52.5), **detail)
    where = (70, 62)
    path = save(point((90, 100), where), header)
    ra, dec = (float(v) for v in WCS(header).wcs_pix2world(where[1], where[0], 0))
    scan, east, north = stare(made, ra, dec, fwhm=FWHM)
    exact = gaussian(east, north)
    np.testing.assert_allclose(
        made.look(SkyMap(file=path), scan)[0], exact, atol=3e-3 * exact.max()
    )


@pytest.mark.parametrize(
    ("ra", "dec"),
    [(0.0, 0.0), (359.9999, -30.0), (0.0001, 45.0), (120.0, 89.99), (10.0, -90.0), (200.0, 90.0)],
)
def test_ra_wrap_and_poles(made, save, ra, dec):
    path = save(
        point((71, 71), (30, 41)), made.tan_header((71, 71), ra=ra, dec=dec, crpix=(42.0, 31.0))
    )
    east, north = np.random.default_rng(6).uniform(-12, 12, (2, 300))
    lon, lat = made.offset(
        np.radians(ra), np.radians(dec), np.tan(east * ARCSEC), np.tan(north * ARCSEC)
    )
    exact = gaussian(east, north)
    got = made.look(SkyMap(file=path), made.observation(lon, lat, fwhm=FWHM))[0]
    np.testing.assert_allclose(got, exact, atol=3e-3 * exact.max())
    # a turn of 2 pi changes nothing but the rounding of the quaternion
    again = made.look(SkyMap(file=path), made.observation(lon + 2 * np.pi, lat, fwhm=FWHM))[0]
    np.testing.assert_allclose(again, got, atol=1e-7 * exact.max())


def test_detector_offsets_and_boresight_angle(made, save):
    """xi, eta of each detector, rotated by psi, land where TOAST's frame R (-eta, -xi, 1) puts
    them.
    """
    path = save(point((64, 64), (32, 32)), made.tan_header((64, 64), crpix=(33.0, 33.0)))
    rng = np.random.default_rng(7)
    xi, eta = rng.uniform(-8, 8, (2, 6)) * ARCSEC
    psi = rng.uniform(0, 2 * np.pi, 50)
    scan = made.observation(
        np.full(50, np.radians(75)), np.radians(20), xi=xi, eta=eta, psi=psi, fwhm=FWHM
    )
    # Rz(psi) turns (-eta, -xi); before it, the frame's x axis points south and its y axis east
    south = -eta[:, None] * np.cos(psi) + xi[:, None] * np.sin(psi)
    east = -eta[:, None] * np.sin(psi) - xi[:, None] * np.cos(psi)
    exact = gaussian(east / ARCSEC, -south / ARCSEC)
    np.testing.assert_allclose(made.look(SkyMap(file=path), scan), exact, atol=3e-3 * exact.max())


def test_a_uniform_sky_returns_its_value(made, save):
    path = save(np.full((150, 150), 2.5e-3), made.tan_header((150, 150)))
    scan, _, _ = stare(made, 75.0, 20.0, reach=20.0, fwhm=FWHM)
    np.testing.assert_allclose(made.look(SkyMap(file=path), scan), 2.5e-3, rtol=1e-7)


def test_several_beams(made, save):
    """Each detector sees the source through its own beam."""
    path = save(point((120, 120), (60, 60)), made.tan_header((120, 120), crpix=(61.0, 61.0)))
    fwhm = np.array([9.0, 12.0, 9.0, 20.0])
    scan = made.observation(
        [np.radians(75)], np.radians(20), xi=np.zeros(4), eta=np.zeros(4), fwhm=fwhm
    )
    got = made.look(SkyMap(file=path), scan)[:, 0]
    np.testing.assert_allclose(got, 8 * np.log(2) / (2 * np.pi * fwhm**2), rtol=3e-3)
    same = made.look(SkyMap(file=path, fwhm="15 arcsec"), scan)[:, 0]
    np.testing.assert_allclose(same, 8 * np.log(2) / (2 * np.pi * 15.0**2), rtol=3e-3)


def test_no_beam(made, save):
    values = np.random.default_rng(8).standard_normal((40, 40))
    header = made.tan_header((40, 40))
    ra, dec = WCS(header).wcs_pix2world([10.0, 20.0, 30.0], [12.0, 20.0, 31.0], 0)
    got = made.look(
        SkyMap(file=save(values, header), beam="none"),
        made.observation(np.radians(ra), np.radians(dec)),
    )[0]
    np.testing.assert_allclose(got, [values[12, 10], values[20, 20], values[31, 30]], rtol=1e-6)


@settings(
    max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(a=st.floats(-3, 3), b=st.floats(-3, 3), seed=st.integers(0, 2**32 - 1))
def test_linearity(made, save, a, b, seed):
    rng = np.random.default_rng(seed)
    first, second = rng.standard_normal((2, 30, 31))
    header = made.tan_header((30, 31))
    scan, _, _ = stare(made, 75.0, 20.0, n=64)

    def seen(values):
        return made.look(SkyMap(file=save(values, header)), scan)

    np.testing.assert_allclose(
        seen(a * first + b * second), a * seen(first) + b * seen(second), rtol=0, atol=1e-12
    )


# --------------------------------------------------------------------------------------------------
# blocks, types


def wide_scan(made, n_det=40, n=2048 * 3 + 517):
    t = np.arange(n) / 100.0
    east, north = 60 * np.sin(t / 3) * ARCSEC, 60 * np.cos(t / 2.2) * ARCSEC
    lon, lat = made.offset(np.radians(75), np.radians(20), east, north)
    xi, eta = np.random.default_rng(9).uniform(-100, 100, (2, n_det)) * ARCSEC
    return made.observation(lon, lat, xi=xi, eta=eta, psi=t / 50, fwhm=FWHM)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_bits_do_not_depend_on_blocks(made, save, dtype):
    path = save(np.random.default_rng(10).standard_normal((120, 120)), made.tan_header((120, 120)))
    scan = wide_scan(made)
    whole = made.look(SkyMap(file=path), scan, dtype=dtype)
    cut = made.look(SkyMap(file=path), scan, dtype=dtype, cuts=([0, 16, 32], [0, 2048, 6144]))
    np.testing.assert_array_equal(whole, cut)


def test_float32_agrees_with_float64(made, save):
    path = save(np.random.default_rng(11).standard_normal((120, 120)), made.tan_header((120, 120)))
    scan = wide_scan(made)
    exact, single = (made.look(SkyMap(file=path), scan, dtype=t) for t in (np.float64, np.float32))
    # offsets up to 200 pixels: 200 * 2e-7 pixel times a slope of some rms / (2 pixels)
    assert np.abs(single - exact).max() < 2e-4 * exact.std()


def test_float32_far_from_the_map_corner(made, save):
    """The origin is taken out: a grid of 6000 pixels is as exact as a small one."""
    values = np.zeros((3, 6000))
    values[1, 5990] = 1.0
    path = save(values, made.tan_header((3, 6000), crpix=(5991.0, 2.0)))
    scan, east, north = stare(made, 75.0, 20.0, fwhm=FWHM)
    exact, single = (
        made.look(SkyMap(file=path), scan, dtype=t)[0] for t in (np.float64, np.float32)
    )
    assert np.abs(single - exact).max() < 2e-6 * exact.max()
    np.testing.assert_allclose(exact, gaussian(east, north), atol=3e-3 * exact.max())


def test_threads_share_the_state(made, save):
    path = save(np.random.default_rng(12).standard_normal((120, 120)), made.tan_header((120, 120)))
    scan, operator = wide_scan(made), SkyMap(file=path)
    expected = made.look(operator, scan)
    states, results = [None] * 4, [None] * 4
    fresh = SkyMap(file=path)

    def work(k):
        states[k] = fresh.prepare(scan)
        results[k] = made.look(fresh, scan, state=states[k])

    threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    [t.start() for t in threads]
    [t.join() for t in threads]
    for k in range(4):
        np.testing.assert_array_equal(results[k], expected)
        assert states[k].beams[0] is states[0].beams[0]  # convolved once


def test_two_maps_add(made, save):
    header = made.tan_header((60, 60))
    scan, _, _ = stare(made, 75.0, 20.0)
    rng = np.random.default_rng(13)
    one, two = (
        SkyMap(file=save(rng.standard_normal((60, 60)), header, f"{k}.fits"), name=f"m{k}")
        for k in "ab"
    )
    from zonda.core.data import Block

    block = Block(scan, slice(0, 1), slice(0, scan.n_samples), dtype=np.float64)
    one.exec(block, one.prepare(scan))
    two.exec(block, two.prepare(scan))
    np.testing.assert_allclose(
        block.detdata["sky"], made.look(one, scan) + made.look(two, scan), rtol=0, atol=1e-15
    )


# -----------------------------------------------------------------------------------------------
# outside, log


def test_samples_outside_take_the_value_and_are_counted(made, save):
    path = save(np.full((40, 40), 1.0), made.tan_header((40, 40)))
    east = np.array([0.0, 15.0, 19.4, 20.6, 100.0, 5000.0])  # the edge is at 20 arcsec
    lon, lat = made.offset(np.radians(75), np.radians(20), np.tan(east * ARCSEC), 0 * east)
    scan = made.observation(lon, lat, fwhm=3.0)
    got = made.look(SkyMap(file=path, outside="0.25 K"), scan)[0]
    assert scan.log.get("SkyMap", "samples outside the input map") == 3
    np.testing.assert_allclose(got[[0, 4, 5]], [1.0, 0.25, 0.25], atol=1e-7)
    assert 0.25 < got[3] < got[2] < 1.0  # the beam smooths the edge
    assert ("SkyMap", "conversion", "1 K_RJ per K_RJ") in list(scan.log)


def test_none_outside_is_stated(made, save):
    scan, _, _ = stare(made, 75.0, 20.0)
    made.look(SkyMap(file=save(np.zeros((64, 64)), made.tan_header())), scan)
    assert ("SkyMap", "samples outside the input map", "0") in list(scan.log)


def test_a_sky_that_no_detector_reaches(made, save):
    path = save(np.ones((20, 20)), made.tan_header((20, 20)))
    for ra, dec in ((75.0, 25.0), (180.0, 0.0), (255.0, -20.0)):  # near, far, exactly behind
        scan = made.observation(
            np.full(300, np.radians(ra)), np.radians(dec), xi=[0, 1e-3], eta=[0, 0]
        )
        with pytest.warns(
            UserWarning,
            match="no sample of .* falls on the input map .*`centre: target` moves the map there",
        ):
            got = made.look(SkyMap(file=path, outside="1 mK"), scan, dtype=np.float32)
        np.testing.assert_array_equal(got, np.float32(1e-3))
        assert scan.log.get("SkyMap", "samples outside the input map") == 600
    assert scan.log.get("SkyMap", "samples more than 90 deg from the input map's centre") == 600


def test_a_sky_that_no_detector_reaches_is_not_convolved(made, save, monkeypatch):
    from zonda.operators.sky import convolved

    path = save(np.ones((20, 20)), made.tan_header((20, 20)))
    calls = []
    monkeypatch.setattr(
        convolved,
        "convolve",
        lambda *a, **k: calls.append(1) or (_ for _ in ()).throw(RuntimeError),
    )
    far = made.observation(
        np.full(300, np.radians(75.0)), np.radians(25.0), xi=[0, 1e-3], eta=[0, 0]
    )
    assert not SkyMap(file=path).prepare(far).beams
    assert not calls
    near = made.observation(
        np.full(300, np.radians(75.0)), np.radians(20.0), xi=[0, 1e-3], eta=[0, 0]
    )
    with pytest.raises(RuntimeError):
        SkyMap(file=path).prepare(near)


@pytest.mark.parametrize(
    "axes", [("RA---TAN", "DEC--TAN"), ("DEC--TAN", "RA---TAN"), ("GLON-TAN", "GLAT-TAN")]
)
def test_a_map_is_reached_whatever_its_axes(made, save, axes):
    header = made.tan_header((20, 20))
    header["CTYPE1"], header["CTYPE2"] = axes
    if axes[0] == "DEC--TAN":
        header["CRVAL1"], header["CRVAL2"], header["CDELT1"], header["CDELT2"] = (
            20.0,
            75.0,
            header["CDELT2"],
            header["CDELT1"],
        )
    if axes[0] == "GLON-TAN":
        del header["RADESYS"]
    middle = WCS(header).pixel_to_world(9.5, 9.5).icrs
    operator, scan = (
        SkyMap(file=save(np.ones((20, 20)), header)),
        made.observation(np.full(30, middle.ra.rad), middle.dec.rad),
    )
    np.testing.assert_allclose(made.look(operator, scan), 1.0, rtol=0.05)
    assert scan.log.get("SkyMap", "samples outside the input map") == 0


def test_a_block_made_twice_is_counted_once(made, save):
    operator = SkyMap(file=save(np.ones((20, 20)), made.tan_header((20, 20))))
    scan = made.observation(np.full(30, np.radians(80)), np.radians(20))
    state = operator.prepare(scan)
    made.look(operator, scan, state=state)
    second = made.observation(np.full(30, np.radians(80)), np.radians(20))
    made.look(operator, second, state=state)
    assert second.log.get("SkyMap", "samples outside the input map") == 30


def test_a_map_much_coarser_than_the_beam(made, save):
    """1 arcmin pixels under a 9 arcsec beam: no huge grid, and it is said."""
    x = np.arange(60)
    path = save(
        np.tile(np.sin(2 * np.pi * x / 20), (60, 1)),
        made.tan_header((60, 60), crpix=(30.5, 30.5), cdelt=(-60.0, 60.0)),
    )
    scan, east, _ = stare(made, 75.0, 20.0, reach=300.0, fwhm=FWHM)
    got = made.look(SkyMap(file=path), scan)[0]
    np.testing.assert_allclose(got, np.sin(2 * np.pi * (29.5 - east / 60) / 20), atol=3e-3)
    assert any("fewer than 2 pixels per FWHM" in value for _, _, value in scan.log)


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (2, 3)])
def test_tiny_maps(made, save, shape):
    path = save(np.ones(shape), made.tan_header(shape))
    scan, east, north = stare(made, 75.0, 20.0, fwhm=FWHM)
    got = made.look(SkyMap(file=path), scan)[0]
    if shape == (1, 1):
        np.testing.assert_allclose(got, gaussian(east, north), atol=3e-3 * got.max())
    assert np.isfinite(got).all()
    assert got.max() > 0


# --------------------------------------------------------------------------------------------------
# units, place


@pytest.mark.parametrize("unit", ["K_RJ", "K_CMB", "MJy/sr", "y", "Jy/pixel", "Jy/beam"])
def test_units_are_those_of_radiation(made, save, unit):
    header = made.tan_header((150, 150), unit=unit, BMAJ=12 / 3600, BMIN=10 / 3600)
    scan, _, _ = stare(made, 75.0, 20.0, n=50)
    beam = np.pi / (4 * np.log(2)) * 120 * ARCSEC**2
    factor = to_kelvin_rj(unit, made.BAND, ARCSEC**2, beam_solid_angle=beam)
    got = made.look(SkyMap(file=save(np.full((150, 150), 0.5), header)), scan)
    np.testing.assert_allclose(got, 0.5 * factor, rtol=1e-6)
    twice = made.look(SkyMap(file=save(np.full((150, 150), 0.5), header), scale=2), scan)
    np.testing.assert_allclose(twice, factor, rtol=1e-6)


def test_spectral_index(made, save):
    path = save(np.ones((150, 150)), made.tan_header((150, 150), unit="MJy/sr"))
    scan, _, _ = stare(made, 75.0, 20.0, n=20)
    got = made.look(SkyMap(file=path, spectral_index=3.5), scan)
    np.testing.assert_allclose(
        got, to_kelvin_rj("MJy/sr", made.BAND, spectral_index=3.5), rtol=1e-6
    )


@pytest.mark.parametrize("projection", ["TAN", "SIN"])
def test_each_pixel_has_the_spectrum_of_its_own_temperature(made, save, projection):
    header = made.tan_header((150, 150), unit="y")
    header["CTYPE1"], header["CTYPE2"] = f"RA---{projection}", f"DEC--{projection}"
    y = save(np.full((150, 150), 2e-4), header)
    kev = np.where(np.arange(150) < 75, 12.0, 3.0) * np.ones((150, 1))
    header["BUNIT"] = "keV"
    te = save(kev, header, name="te.fits")
    cold = 2e-4 * to_kelvin_rj("y", made.BAND)
    for side, value in ((40 * ARCSEC, 12.0), (-40 * ARCSEC, 3.0)):  # east is the first half
        scan, _, _ = stare(made, 75.0 + np.degrees(side) / np.cos(np.radians(20)), 20.0, n=20)
        want = 2e-4 * sz_per_y(sz_of_band(made.BAND), value * 1.602176634e-16)
        assert abs(want / cold - 1) > 0.01
        for gas in (te, f"{value} keV"):
            got = made.look(SkyMap(file=y, te=gas), scan)
            np.testing.assert_allclose(got, want, rtol=1e-5)
            stated = next(text for _, what, text in scan.log if what == "electron temperature")
            state = SkyMap(file=y, te=gas).prepare(scan)
            kept = InputImage(state.sky.image("SkyMap", state.grid)).arrays()
            assert InputImage.of(kept).image.header["GASTEMP"] == stated
            assert f"(cold gas {cold / 2e-4:.5g})" in stated
        assert stated.startswith(f"{value:g} keV: {want / 2e-4:.5g} K_RJ per y")


def test_temperatures_that_do_not_fit_are_refused(made, save):
    header = made.tan_header((20, 20), unit="y")
    y, scan = save(np.ones((20, 20)), header), stare(made, 75.0, 20.0, n=5)[0]

    def refused(step, message):
        with pytest.raises(InputError, match=message):
            step.prepare(scan)

    def hdr(**cards):
        return fits.Header((dict(header) | {"BUNIT": "keV"} | cards).items())

    refused(SkyMap(file=y, te=save(np.ones((20, 21)), hdr(), "a.fits")), "other pixels")
    refused(SkyMap(file=y, te=save(np.ones((20, 20)), hdr(CRVAL2=20.01), "b.fits")), "other pixels")
    refused(SkyMap(file=y, te=save(np.full((20, 20), 16.0), hdr(), "c.fits")), "0 keV to 16 keV")
    refused(SkyMap(file=y, te=save(np.full((20, 20), -1.0), hdr(), "d.fits")), "-1 keV")
    refused(SkyMap(file=y, te=save(np.ones((20, 20)), hdr(BUNIT="Jy"), "e.fits")), "keV or K")
    refused(SkyMap(file=y, te=save(np.full((20, 20), np.nan), hdr(), "f.fits")), "NaN")
    refused(SkyMap(file=y, unit="K_RJ", te="5 keV"), "te is for maps in y")
    with pytest.raises(ZondaError, match="at most 15 keV"):
        SkyMap(file=y, te="15.1 keV")
    with pytest.raises(ZondaError, match=r"te: no such file: 'nowhere\.fits'"):
        SkyMap(file=y, te="nowhere.fits")


def test_temperatures_in_kelvin_on_healpix(made, tmp_path):
    import healpy

    y, te = (tmp_path / name for name in ("y.fits", "te.fits"))
    healpy.write_map(y, np.full(12 * 64**2, 1e-4), column_units="y", coord="C", dtype=float)
    kelvin = np.full(12 * 64**2, 8 * 1.602176634e-16 / BOLTZMANN)
    healpy.write_map(te, kelvin, column_units="K", coord="C", dtype=float)
    scan, _, _ = stare(made, 75.0, 20.0, n=20, fwhm=7200.0)
    got = made.look(SkyMap(file=y, te=te), scan)
    np.testing.assert_allclose(got, made.look(SkyMap(file=y, te="8 keV"), scan), rtol=1e-6)
    healpy.write_map(te, kelvin, column_units="K", coord="G", dtype=float, overwrite=True)
    with pytest.raises(InputError, match="other pixels"):
        SkyMap(file=y, te=te).prepare(scan)


def test_jansky_per_pixel_keeps_the_flux_off_axis(made, save):
    """A gnomonic pixel 2 deg off axis spans cos^3 less sky: the flux found there, and the beam, are
    still those on the sky.
    """
    header = made.tan_header((40, 40), unit="Jy/pixel", crpix=(21.0, 21.0 - 7200.0))
    ra, dec = (float(v) for v in WCS(header).wcs_pix2world(20, 20, 0))
    scan = made.observation([np.radians(ra)], np.radians(dec))
    peak = made.look(SkyMap(file=save(point((40, 40), (20, 20)), header)), scan)[0, 0]
    expected = to_kelvin_rj("Jy/pixel", made.BAND, ARCSEC**2) * gaussian(0.0, 0.0)
    assert peak == pytest.approx(expected, rel=1e-3)  # it was 1 / cos^3 times that, 1.8e-3 too high


def test_a_map_without_wcs_is_centred_on_the_target(made, save):
    """First axis west, second north."""
    header = fits.Header({"BUNIT": "K_RJ"})
    path = save(point((64, 64), (40, 20)), header)
    centre = (np.radians(200.0), np.radians(-30.0))
    # pixel (20, 40) counted from 0 lies 11.5 pixels east and 8.5 north of the centre at 31.5
    lon, lat = made.offset(*centre, np.tan(11.5 * 2 * ARCSEC), np.tan(8.5 * 2 * ARCSEC))
    scan = made.observation([lon], lat, centre=centre, fwhm=FWHM)
    got = made.look(SkyMap(file=path, pixel_size="2 arcsec"), scan)[0, 0]
    assert got == pytest.approx(4 * gaussian(0, 0), rel=3e-3)
    elsewhere = SkyMap(file=path, pixel_size="2 arcsec", centre="10 deg 10 deg")
    lon, lat = made.offset(
        np.radians(10), np.radians(10), np.tan(11.5 * 2 * ARCSEC), np.tan(8.5 * 2 * ARCSEC)
    )
    assert made.look(elsewhere, made.observation([lon], lat, fwhm=FWHM))[0, 0] == pytest.approx(
        4 * gaussian(0, 0), rel=3e-3
    )


def test_centre_moves_a_map(made, save):
    """The middle of the map goes there, the rotation stays."""
    header = made.tan_header((64, 64), crpix=(1.0, 1.0), CROTA2=90.0)
    path = save(point((64, 64), (31, 41)), header)
    centre = (np.radians(120.0), np.radians(40.0))
    x, y = (41 - 31.5), (31 - 31.5)
    turned = WCS(header).pixel_scale_matrix @ [x, y] * 3600
    lon, lat = made.offset(*centre, np.tan(turned[0] * ARCSEC), np.tan(turned[1] * ARCSEC))
    scan = made.observation([lon], lat, centre=centre, fwhm=FWHM)
    assert made.look(SkyMap(file=path, centre="target"), scan)[0, 0] == pytest.approx(
        gaussian(0, 0), rel=3e-3
    )


def test_pixel_size_overrides_the_scale(made, save):
    path = save(
        point((64, 64), (32, 42)), made.tan_header((64, 64), crpix=(33.0, 33.0), cdelt=(1.0, 1.0))
    )
    lon, lat = made.offset(np.radians(75), np.radians(20), np.tan(10 * 2 * ARCSEC), 0.0)
    scan = made.observation([lon], lat, fwhm=FWHM)
    assert made.look(SkyMap(file=path, pixel_size="2 arcsec"), scan)[0, 0] == pytest.approx(
        4 * gaussian(0, 0), rel=3e-3
    )
    assert any("overridden" in value for _, _, value in scan.log)


# ---------------------------------------------------------------------------------------------
# products, manners


def test_the_input_map_is_a_product(made, save):
    values = np.random.default_rng(14).standard_normal((30, 31))
    header = made.tan_header((30, 31), unit="mK_RJ")
    operator = SkyMap(file=save(values, header))
    scan, _, _ = stare(made, 75.0, 20.0, n=4)
    data = Data(scene=None)
    for k in range(2):
        operator.collect(data, scan, operator.prepare(scan))
        assert list(data.products) == ["input"], k
    image = data.products["input"]
    np.testing.assert_allclose(image.values, values * 1e-3, rtol=1e-12)
    assert (image.unit, image.header["BUNIT"], image.header["TEMPSCAL"]) == ("K_RJ", "K", "K_RJ")
    np.testing.assert_allclose(
        image.wcs.wcs_pix2world(3, 4, 0), WCS(header).wcs_pix2world(3, 4, 0), rtol=1e-13
    )
    second = SkyMap(file=operator.file, name="dust")
    second.collect(data, scan, second.prepare(scan))
    assert sorted(data.products) == ["input", "input.dust"]


def test_copies_and_pickles_are_equal_after_use(made, save):
    operator = SkyMap(file=save(np.zeros((20, 20)), made.tan_header((20, 20))))
    scan, _, _ = stare(made, 75.0, 20.0, n=4)
    operator.prepare(scan)
    for other in (
        copy.deepcopy(operator),
        pickle.loads(pickle.dumps(operator)),
        SkyMap(file=operator.file),
    ):
        assert other == operator
        other.prepare(scan)


def test_a_changed_file_is_read_again(made, save):
    header = made.tan_header((150, 150))
    operator = SkyMap(file=save(np.ones((150, 150)), header))
    scan, _, _ = stare(made, 75.0, 20.0, n=4)
    assert made.look(operator, scan)[0, 0] == pytest.approx(1.0)
    import os

    save(np.full((150, 150), 2.0), header)
    os.utime(operator.file, ns=(1, 1))
    assert made.look(operator, scan)[0, 0] == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"beam": "none", "fwhm": "9 arcsec"}, "beam: none has no width"),
        ({"centre": "az 10 deg el 50 deg"}, "fixed on the sky"),
        ({"fwhm": "0 arcsec"}, "greater than 0"),
        ({"pixel_size": "-1 arcsec"}, "greater than 0"),
        ({"missing": "ignore"}, "'error' or 'zero'"),
        ({"outside": "3"}, "no unit"),
    ],
)
def test_wrong_parameters(made, save, more, message):
    with pytest.raises(ZondaError, match=message):
        SkyMap(file=save(np.zeros((9, 9)), made.tan_header((9, 9))), **more)


def test_missing_file(tmp_path):
    with pytest.raises(ZondaError, match="no such file"):
        SkyMap(file=tmp_path / "none.fits")


def test_a_file_that_vanishes(made, save):
    path = save(np.zeros((9, 9)), made.tan_header((9, 9)))
    operator = SkyMap(file=path)
    path.unlink()
    with pytest.raises(InputError, match="no such file"):
        operator.prepare(made.observation([0.0], 0.0))


def test_spectral_index_of_a_kelvin_map_is_refused(made, save):
    path = save(np.zeros((9, 9)), made.tan_header((9, 9)))
    with pytest.raises(InputError, match="spectral index"):
        SkyMap(file=path, spectral_index=1.0).prepare(made.observation([0.0], 0.0))


def test_of_several_input_images_the_first_stays(made, save):
    first, second = (
        SkyMap(file=save(np.full((20, 20), v), made.tan_header((20, 20)), f"{v}.fits"))
        for v in (1.0, 2.0)
    )
    scan = made.observation(np.full(30, np.radians(75)), np.radians(20))
    states = [o.prepare(scan) for o in (first, second)]
    one, other = (InputImage(state.sky.image("SkyMap", state.grid)) for state in states)
    one += other
    back = InputImage.of(one.arrays()).image
    np.testing.assert_array_equal(back.values, np.ones((20, 20)))
    assert dict(back.header.items()) == dict(one.image.header.items())
    assert back.unit == "K_RJ"
