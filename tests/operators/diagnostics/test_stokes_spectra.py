"""Spectra of I, E and B of TAN and HEALPix maps against a sky that healpy made of known spectra."""

import dataclasses

import healpy
import numpy as np
import pytest

from zonda.core.errors import PipelineError
from zonda.core.maps.map_product import MapProduct
from zonda.operators.diagnostics.comparison.files import on_meridians_of, planes_of, read_planes
from zonda.operators.diagnostics.map_spectra import MapSpectrum
from zonda.operators.maps.grid import tangent_wcs

NSIDE, LMAX = 512, 1000
ELL = np.arange(LMAX + 1)
C_T = 1e-6 * np.exp(-((ELL / 500.0) ** 2))
C_E, C_B, C_TE = 0.2 * C_T, 0.02 * C_T, 0.3 * C_T
"""Smooth, so that what a window mixes changes little; TE above zero tells the sign of E."""


@pytest.fixture(scope="module")
def sky():
    np.random.seed(4)  # noqa: NPY002 - healpy draws from it
    return healpy.synfast([C_T, C_E, C_B, C_TE], NSIDE, lmax=LMAX, new=True, pol=True)


def polarized(i, q, u, noise=None, **how):
    ones = np.ones(i.shape)
    levels = noise or (np.nan, 0.0, 0.0)
    covariance = np.zeros((6, *i.shape))
    for row, level in zip((0, 3, 5), noise or (0.0, 0.0, 0.0), strict=True):
        covariance[row] = level**2
    return MapProduct(
        np.stack([i, q, u]),
        ones.astype(np.int64),
        np.stack([ones] * 3),
        np.stack([level * ones for level in levels]),
        None,
        covariance=covariance,
        fwhm=1e-9,
        **how,
    )


def tan_map(sky, declination, pixels=256, pixel=np.radians(4 / 60), **more):
    wcs = tangent_wcs((1.0, declination), pixel, (pixels, pixels))
    x, y = np.meshgrid(np.arange(pixels), np.arange(pixels))
    lon, lat = wcs.pixel_to_world_values(x, y)
    planes = [healpy.get_interp_val(plane, lon, lat, lonlat=True) for plane in sky]
    centre = (1.0, declination)
    return polarized(
        *planes, header=wcs.to_header(relax=True), centre=centre, pixel=pixel, frame="icrs", **more
    )


def check(found, name="map", at=(100, 500)):
    """Within 4 standard errors and 5 %: pixels, and interpolation between them, which takes that of
    l = 500.
    """
    multipole = 2 * np.pi * found.wavenumber
    use = (multipole > at[0]) & (multipole < at[1]) & np.isfinite(multipole)
    assert np.count_nonzero(use) >= 5
    expected = {name: C_T, f"{name}_E": C_E, f"{name}_B": C_B}
    error = 4 / np.sqrt(found.modes[use]) + 0.05
    for key, spectrum in expected.items():
        true = np.interp(multipole[use], ELL, spectrum)
        assert np.all(np.abs(found.power[key][use] / true - 1) < error), key
    te = np.interp(multipole[use], ELL, C_TE)
    assert np.all(
        np.abs(found.cross[f"{name}_TE"][use] / te - 1)
        < error * np.sqrt(1 + C_T[9] * C_E[9] / C_TE[9] ** 2)
    )
    for key in (
        f"{name}_TB",
        f"{name}_EB",
    ):  # no parity violation: 0 within its scatter, (C_1 C_2 / 2 N)^(1/2)
        one, other = (
            np.interp(multipole[use], ELL, c) for c in ((C_T if "TB" in key else C_E), C_B)
        )
        assert np.all(
            np.abs(found.cross[key][use])
            < (4 / np.sqrt(found.modes[use]) + 0.05) * np.sqrt(one * other)
        )


@pytest.mark.parametrize("declination", [0.0, np.radians(-55)])
def test_flat_spectra_of_a_sky_of_healpy(sky, declination):
    """17 deg across: at 55 deg south the meridians turn by 16 deg to the edge, which would put 7 %
    of E into B.
    """
    found = MapSpectrum(maps=[], bins=24).spectra({"map": tan_map(sky, declination)}).spectra
    check(found)


def test_spectra_of_a_healpix_map(sky):
    latitude = healpy.pix2ang(NSIDE, np.arange(healpy.nside2npix(NSIDE)), lonlat=True)[1]
    pixels = np.flatnonzero(np.abs(latitude) < 50)
    how = {
        "header": None,
        "centre": (0.0, 0.0),
        "pixel": healpy.nside2resol(NSIDE),
        "frame": "icrs",
    }
    product = polarized(*(plane[pixels] for plane in sky), nside=NSIDE, pixels=pixels, **how)
    check(MapSpectrum(maps=[], bins=24).spectra({"map": product}).spectra)


def test_white_levels_of_e_and_b():
    """Noise alone, of other rms in I, Q and U: the power is the stated level, E and B have the mean
    of Q and U.
    """
    random, noise, pixel = np.random.default_rng(3), (1.0, 2.0, 3.0), np.radians(1 / 60)
    for shape, how in (
        (
            (128, 128),
            {
                "header": tangent_wcs((1.0, 0.2), pixel, (128, 128)).to_header(relax=True),
                "pixel": pixel,
            },
        ),
        (
            (healpy.nside2npix(64),),
            {
                "header": None,
                "nside": 64,
                "pixels": np.arange(healpy.nside2npix(64)),
                "pixel": 0.016,
            },
        ),
    ):
        planes = [level * random.standard_normal(shape) for level in noise]
        product = polarized(*planes, noise=noise, centre=(1.0, 0.2), frame="icrs", **how)
        found = MapSpectrum(maps=[], bins=8).spectra({"map": product}).spectra
        area = pixel**2 if len(shape) > 1 else healpy.nside2pixarea(64)
        assert found.white["map"] == pytest.approx(area, rel=1e-6)
        for key in ("map_E", "map_B"):
            assert found.white[key] == pytest.approx(area * 6.5, rel=1e-6)
        for key, power in found.power.items():
            use = found.modes > 20
            assert np.all(
                np.abs(power[use] / found.white[key][use] - 1) < 4.5 / np.sqrt(found.modes[use])
            ), key


def test_a_map_without_a_spectrum_is_passed_over(sky):
    """A CAR map before a TAN map; alone it is refused."""
    flat = tan_map(sky, 0.0, pixels=64)
    header = {**flat.header, "CTYPE1": "RA---CAR", "CTYPE2": "DEC--CAR"}
    strip = dataclasses.replace(flat, header=header)
    found = MapSpectrum(maps=[], bins=8).spectra({"a": strip, "map": flat})
    assert set(found.spectra.power) == {"map", "map_E", "map_B"}
    with pytest.raises(PipelineError, match="no TAN or HEALPix map"):
        MapSpectrum(maps=[], bins=8).spectra({"a": strip})


def test_what_has_no_spectrum_is_refused():
    pixels = np.arange(100)
    how = {"header": None, "centre": (0.0, 0.0), "pixel": 1e-4, "frame": "icrs"}
    product = polarized(*np.zeros((3, 100)), nside=8192, pixels=pixels, **how)
    with pytest.raises(PipelineError, match="nside 8192 would take gigabytes"):
        MapSpectrum(maps=[], bins=8).spectra({"map": product})
    product = polarized(*np.zeros((3, 0)), nside=64, pixels=pixels[:0], **how)
    with pytest.raises(PipelineError, match="no pixel has enough samples"):
        MapSpectrum(maps=[], bins=8).spectra({"map": product})
    with pytest.raises(PipelineError, match="there is no TAN map 'other'"):
        MapSpectrum(maps=["other"], bins=8).spectra({"map": product})


def test_windows_on_the_sphere():
    """Hits that fall from the middle of a field: white noise keeps its level, and scatters as the
    independent modes say.
    """
    nside, random, scatter = 128, np.random.default_rng(6), []
    pixels = healpy.query_disc(nside, [1.0, 0.0, 0.0], np.radians(30))
    away = np.arccos(np.clip(np.stack(healpy.pix2vec(nside, pixels))[0], -1, 1)) / np.radians(30)
    hits = np.rint(1000 * np.cos(np.pi / 2 * away) ** 2).astype(np.int64) + 1
    how = {
        "header": None,
        "centre": (0.0, 0.0),
        "pixel": healpy.nside2resol(nside),
        "frame": "icrs",
    }
    for _ in range(12):
        noise = np.full(len(pixels), 3.0)
        signal = noise * random.standard_normal(len(pixels))
        product = MapProduct(
            signal, hits, noise, noise, None, fwhm=1e-9, nside=nside, pixels=pixels, **how
        )
        found = MapSpectrum(maps=[], bins=8).spectra({"map": product}).spectra
        use = found.modes > 20
        scatter.append(
            (found.power["map"][use] / found.white["map"][use] - 1) * np.sqrt(found.modes[use])
        )
    size = np.size(scatter)
    assert size > 40
    assert abs(np.mean(scatter)) < 4 / np.sqrt(size)
    assert abs(np.mean(np.square(scatter)) - 1) < 4 * np.sqrt(2 / size)


def test_noise_of_each_plane_of_a_healpix_file(tmp_path):
    pixels = healpy.query_disc(64, [1.0, 0.0, 0.0], 0.3)
    how = {"header": None, "centre": (0.0, 0.0), "pixel": healpy.nside2resol(64), "frame": "icrs"}
    product = polarized(
        *np.ones((3, len(pixels))), noise=(1.0, 2.0, 3.0), nside=64, pixels=pixels, **how
    )
    product.write(tmp_path / "map.fits")
    planes = read_planes(tmp_path / "map.fits").planes
    assert [np.nanmedian(planes[which].noise) for which in "IQU"] == pytest.approx([1.0, 2.0, 3.0])


def test_noise_of_q_and_u_is_turned_with_them(sky):
    """By 2 delta: the sum of the variances stays, and where Q becomes U so does its noise."""
    product = tan_map(sky, 0.35, pixels=16, noise=(1.0, 2.0, 3.0))
    planes = planes_of(product, "map")
    other = tangent_wcs((3.0, -0.4), 1e-3, (16, 16), "galactic").to_header(relax=True)
    turned = on_meridians_of(dataclasses.replace(planes["I"], header=other), planes)
    values, before = (
        np.stack([found[which].values for which in "QU"]) for found in (turned, planes)
    )
    cosine, sine = (
        (a * before).sum(axis=0) / (before**2).sum(axis=0)
        for a in (values, [values[1], -values[0]])
    )
    assert np.abs(sine).min() > 0.1  # the frames differ
    np.testing.assert_allclose(turned["Q"].noise, np.hypot(2 * cosine, 3 * sine), rtol=1e-6)
    np.testing.assert_allclose(turned["U"].noise, np.hypot(3 * cosine, 2 * sine), rtol=1e-6)
