"""What one does with a map in Python: other units, smoothing, pictures, files."""

from __future__ import annotations

import math

import numpy as np
import pytest
from astropy import units
from astropy.io import fits
from matplotlib.figure import Figure

import zonda
from zonda.core.errors import InputError, OutputError
from zonda.core.maps.image import Image
from zonda.core.maps.map_plots import Look
from zonda.core.maps.map_product import MapProduct
from zonda.core.numerics.radiation import band_average, cmb_slope, intensity_to_kelvin
from zonda.plugins.checks.scenes import TARGET, camera, scene

ARCSEC = math.pi / 648000


@pytest.fixture(scope="module")
def data():
    steps = [
        zonda.PointingDaisy(scan_duration="10 s", scans=2),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        zonda.BinMap(pixel="6 arcsec"),
    ]
    return zonda.Pipeline(steps).run(scene(camera(19)), threads=1)


@pytest.fixture
def brightness(data):
    return data["map"]


def finite(a):
    return a[np.isfinite(a)]


def test_other_units_follow_the_band_and_the_beam_of_the_run(data, brightness):
    band, fwhm = data.scene.instrument.band, 8.5 * ARCSEC
    per_cmb = band_average(band, cmb_slope)
    per_intensity = band_average(band, intensity_to_kelvin) * 1e-20  # K per MJy/sr
    beam = math.pi * fwhm**2 / (4 * math.log(2))
    for unit, factor in {
        "uK": 1e6,
        "K_CMB": 1 / per_cmb,
        "mK_CMB": 1e3 / per_cmb,
        "MJy/sr": 1 / per_intensity,
        "Jy/beam": beam * 1e6 / per_intensity,
        "mJy / beam": beam * 1e9 / per_intensity,
    }.items():
        other = brightness.to(unit)
        for plane in ("signal", "noise", "half_difference"):
            np.testing.assert_allclose(
                finite(getattr(other, plane)),
                factor * finite(getattr(brightness, plane)),
                rtol=1e-12,
            )
        assert other.rms() == pytest.approx(factor * brightness.rms())
        back = other.to("K_RJ")
        np.testing.assert_allclose(finite(back.signal), finite(brightness.signal), rtol=1e-12)
        assert back.unit == "K_RJ"
    assert np.shares_memory(other.hits, brightness.hits)
    assert brightness.to("mJy / beam").unit == "mJy/beam"
    assert brightness.to("uK").unit == "uK_RJ"
    assert brightness.to(units.mJy / units.beam).unit == "mJy/beam"


def test_weights_stay_the_inverse_variance(data):
    steps = [
        zonda.PointingDaisy(scan_duration="10 s"), zonda.WhiteNoise(), zonda.Efficiency(),
        zonda.BinMap(pixel="6 arcsec", weights="inverse_variance"),
    ]  # fmt: skip
    one = zonda.Pipeline(steps).run(scene(camera(7)), threads=1)["map"]
    other = one.to("uK_CMB")
    np.testing.assert_allclose(
        other.weights * np.nan_to_num(other.signal) ** 2,
        one.weights * np.nan_to_num(one.signal) ** 2,
    )


def test_flux_in_the_pixels_of_a_tangent_plane_is_kept(data):
    """Jy/pixel of a uniform sky falls by cos^3 outwards, as the pixels' solid angle does."""
    wide = zonda.Pipeline(
        [
            zonda.PointingStare(scan_duration="1 s"),
            zonda.WhiteNoise(),
            zonda.Efficiency(),
            zonda.BinMap(pixel="1 deg", width="40 deg"),
        ]
    )
    found = wide.run(scene(camera(7)), threads=1)["map"]
    found.signal[...] = 1.0
    flux = found.to("Jy/pixel").signal
    np.testing.assert_allclose(
        flux / flux.max(),
        np.cos(found.distance()) ** 3 / np.cos(found.distance().min()) ** 3,
        rtol=1e-12,
    )


def test_a_smoothed_map_has_a_wider_beam(brightness):
    twice = brightness.smooth()
    assert twice.resolution == pytest.approx(math.sqrt(2) * brightness.resolution)
    assert twice.smooth("10 arcsec").smoothed_by == pytest.approx(math.hypot(8.5, 10) * ARCSEC)
    # a beam of twice the solid angle holds twice the flux of a uniform brightness
    ratio = finite(twice.to("Jy/beam").signal) / finite(twice.signal)
    before = finite(brightness.to("Jy/beam").signal) / finite(brightness.signal)
    np.testing.assert_allclose(ratio, 2 * before[0], rtol=1e-9)
    with pytest.raises(InputError, match=r"which smoothing widens(.|\n)*smooth it before"):
        brightness.to("Jy/beam").smooth()


def test_what_cannot_be_converted_is_said(brightness):
    with pytest.raises(InputError, match=r"unknown unit 'furlong'(.|\n)*use Jy/pixel"):
        brightness.to("furlong")
    with pytest.raises(InputError, match="unknown unit 'None'"):
        brightness.to(None)
    with pytest.raises(InputError, match="9 arcsec"):
        brightness.smooth(9)
    with pytest.raises(InputError, match="is no angle above 0"):
        brightness.smooth("0 arcsec")
    bare = MapProduct(
        np.ones((2, 2)),
        np.ones((2, 2), np.int64),
        np.ones((2, 2)),
        np.ones((2, 2)),
        None,
        brightness.header,
        (0.0, 0.0),
        ARCSEC,
    )
    assert bare.to("mK").signal[0, 0] == pytest.approx(1e3)
    with pytest.raises(InputError, match="band of the map is not known"):
        bare.to("K_CMB")
    with pytest.raises(InputError, match="beam of the map is not known"):
        bare.smooth()


def test_pictures_are_drawn_into_the_axes_that_are_given(brightness):
    from matplotlib import pyplot as plt

    figure = plt.figure()
    left, right = (figure.add_subplot(1, 2, k, projection=brightness.wcs) for k in (1, 2))
    assert brightness.plot(left, title="mine") is left
    assert left.get_title() == "mine"
    assert brightness.plot(ax=right, plane="hits") is right
    own = brightness.to("uK_CMB").plot(limit=5.0)
    assert own.figure is not figure
    assert own.images[0].get_clim() == (-5.0, 5.0)
    assert own.images[0].colorbar.ax.get_ylabel() == "brightness [uK_CMB]"
    lon, lat = own.coords[0], own.coords[1]
    assert (lon.get_axislabel(), lat.get_axislabel()) == ("RA (ICRS)", "Dec (ICRS)")
    with pytest.raises(InputError, match=r"no plane 'nois'(.|\n)*did you mean 'noise'"):
        brightness.plot(plane="nois")
    image = Image(np.eye(3), brightness.header, "K_RJ").plot()
    assert image.images[0].get_array().shape == (3, 3)
    plt.close("all")


def test_colours_are_the_users(brightness):
    """Limits are in the map's unit, the bar in K_RJ; a bar of 1 arcmin is 60 arcsec / pixel long."""
    from matplotlib import colors

    look = {"colours": "magma", "limits": (-1e-4, 2e-3), "stretch": "asinh"}
    ax = brightness.plot(Figure().subplots(), scale_bar="1 arcmin", **look)
    image = ax.images[0]
    assert (image.cmap.name, type(image.norm)) == ("magma", colors.AsinhNorm)
    np.testing.assert_allclose(image.get_clim(), (-100, 2000))  # the bar's microkelvin
    pixels = np.ptp(ax.lines[0].get_xdata())
    assert pixels * brightness.sides[0] == pytest.approx(np.radians(1 / 60), rel=1e-3)
    wrong = (
        {"colours": "magna"},
        {"limits": (2, 1)},
        {"limits": 3},
        {"stretch": "cubic"},
        {"scale_bar": "0 deg"},
    )
    texts = (
        "no colour map 'magna'",
        "2 to 1 are no limits",
        "3 are no limits",
        "no stretch 'cubic'",
        "0 deg is no angle",
    )
    for given, text in zip(wrong, texts, strict=True):
        with pytest.raises(InputError, match=text):
            brightness.plot(Figure().subplots(), **given)


@pytest.mark.parametrize("stretch", ["linear", "sqrt", "asinh", "log"])
def test_each_stretch_ends_at_the_limits_and_grows(stretch):
    norm = Look(stretch=stretch).norm(1e-3, 2.0)
    values = np.ma.filled(norm(np.geomspace(1e-3, 2.0, 50)))
    np.testing.assert_allclose(values[[0, -1]], [0, 1], atol=1e-12)
    assert (np.diff(values) > 0).all()


def test_a_map_far_from_zero_is_shown_between_its_lowest_and_highest(brightness):
    from dataclasses import replace

    from matplotlib import pyplot as plt

    low, top = replace(brightness, signal=brightness.signal + 50).plot().images[0].get_clim()
    assert 49 < low < 50 < top < 51
    plt.close("all")


def test_healpix_maps_are_drawn_and_converted():
    from matplotlib import pyplot as plt

    steps = [
        zonda.PointingDaisy(scan_duration="5 s"),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        zonda.BinMap(nside=1024),
    ]
    found = zonda.Pipeline(steps).run(scene(camera(7)), threads=1)["map"]
    drawn = found.to("mK_CMB").plot().images[0].get_array()
    known = np.asarray(drawn[np.isfinite(drawn)])
    assert set(np.round(known, 9)) <= set(np.round(found.to("mK_CMB").signal, 9))
    plt.close("all")


def test_it_is_written_in_its_unit_and_never_over_another(brightness, tmp_path):
    path = brightness.to("uK_CMB").write(tmp_path / "a.fits")
    with fits.open(path) as hdus:
        assert (hdus[0].header["BUNIT"], hdus[0].header["TEMPSCAL"]) == ("uK", "K_CMB")
        np.testing.assert_array_equal(hdus[0].data, brightness.to("uK_CMB").signal)
        assert hdus["NOISE"].header["BUNIT"] == "uK"
        assert hdus[0].header["BMAJ"] == pytest.approx(8.5 / 3600)
    with pytest.raises(OutputError, match="exists already"):
        brightness.write(path)
    flux = fits.getheader(brightness.to("MJy/sr").write(path, overwrite=True))
    assert flux["BUNIT"] == "MJy/sr"
    assert "TEMPSCAL" not in flux


def test_a_written_map_is_a_sky_map_again(brightness, tmp_path):
    """What `write` writes, SkyMap reads: a point of the map in uK_CMB comes back in K_RJ."""
    filled = brightness.to("uK_CMB")
    filled.signal[...] = 7.0
    path = filled.write(tmp_path / "flat.fits")
    steps = [zonda.PointingStare(scan_duration="1 s"), zonda.SkyMap(file=path, beam="none")]
    data = zonda.Pipeline(steps).run(
        scene(camera(1), target=f"{TARGET[0]} deg {TARGET[1]} deg"), keep=["sky"], threads=1
    )
    per_cmb = band_average(data.scene.instrument.band, cmb_slope)
    np.testing.assert_allclose(data.tod("sky"), 7e-6 * per_cmb, rtol=1e-5)  # float32
