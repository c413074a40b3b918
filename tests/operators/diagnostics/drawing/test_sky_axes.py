"""Positions and tick marks against astropy's WCS."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.wcs import WCS

from zonda.operators.diagnostics.drawing.sky_axes import SkyAxes, label_of


def made(projection, centre, scale, galactic=False, turned=0.0, pole=None):
    wcs = WCS(naxis=2)
    lon, lat = ("GLON", "GLAT") if galactic else ("RA--", "DEC-")
    wcs.wcs.ctype = [f"{lon}-{projection}", f"{lat}-{projection}"]
    wcs.wcs.crval, wcs.wcs.crpix, wcs.wcs.cdelt = centre, [153.3, 99.0], [-scale, 1.1 * scale]
    c, s = np.cos(np.radians(turned)), np.sin(np.radians(turned))
    wcs.wcs.pc = [[c, -s], [s, c]]
    if pole is not None:
        wcs.wcs.lonpole = pole
    wcs.wcs.set()
    return wcs


CASES = [
    made("TAN", [75, 20], 2 / 3600),
    made("TAN", [0.001, -70], 0.001, turned=10.0),
    made("TAN", [10, 5], 1e-5, pole=170.0),
    made("SIN", [0.01, 60], 0.01),
    made("ARC", [359.9, -30], 0.02, galactic=True),
    made("STG", [100, 10], 0.3),
    made("ZEA", [200, 10], 0.1),
    made("CAR", [180, 0], 0.3, galactic=True),
    made("CAR", [180, 0], 1.0),
]
CASES[-1].wcs.crpix, CASES[-1].wcs.cdelt = [150.5, 100.5], [-1.2, 0.9]  # all of the sky
CASES[-1].wcs.set()


@pytest.mark.parametrize("wcs", CASES)
def test_positions_are_astropys(wcs):
    axes = SkyAxes.of(wcs)
    x, y = np.meshgrid(np.linspace(-0.5, 299.5, 13), np.linspace(-0.5, 199.5, 11))
    lon, lat = wcs.wcs_pix2world(x.ravel(), y.ravel(), 0)
    mine = [part.ravel() for part in axes.world(x, y)]
    np.testing.assert_allclose((mine[0] - lon + 180) % 360, 180, rtol=0, atol=1e-11)
    np.testing.assert_allclose(mine[1], lat, rtol=0, atol=1e-11)
    assert repr(axes) == repr(SkyAxes.of(wcs.to_header()))
    np.testing.assert_allclose(
        np.array(axes.scales), np.sqrt((wcs.pixel_scale_matrix**2).sum(axis=0)), rtol=1e-12
    )


@pytest.mark.parametrize("wcs", CASES)
def test_marks_are_where_the_round_values_are(wcs):
    axes, shape = SkyAxes.of(wcs), (200, 300)
    marks = axes.ticks(shape, 60, 25)
    assert set(marks) == {"bottom", "top", "left", "right"}
    for edge, ticks in marks.items():
        assert 2 <= len(ticks.places) == len(ticks.labels) <= 8
        along, fixed = (
            ticks.places,
            {"bottom": -0.5, "left": -0.5, "top": 199.5, "right": 299.5}[edge],
        )
        across = np.full(len(along), fixed)
        x, y = (along, across) if edge in ("bottom", "top") else (across, along)
        assert (along >= -0.5).all()
        assert (along <= (299.5 if edge in ("bottom", "top") else 199.5)).all()
        value = wcs.wcs_pix2world(x, y, 0)[0 if edge in ("bottom", "top") else 1]
        for place, text in zip(value, ticks.labels, strict=True):
            assert _degrees(text) == pytest.approx(place, abs=1e-9) or abs(
                _degrees(text) - place
            ) == pytest.approx(360, abs=1e-9)


def _degrees(text):
    sign, unit = (-1 if text.startswith("−") else 1), (15 if "ʰ" in text else 1)
    fields = text.lstrip("−").translate(str.maketrans("ʰᵐˢ°′″", "      ")).split()
    return sign * unit * sum(float(f) / 60**k for k, f in enumerate(fields))


def testlabel_ofs_have_the_digits_of_the_step():
    assert label_of(74.9999999999, 15 / 3600, True, True) == "5ʰ00ᵐ00ˢ"
    assert label_of(75.0, 15 * 0.05 / 3600, True, True) == "5ʰ00ᵐ00.00ˢ"
    assert label_of(359.99999999999, 15 * 5 / 60, True, True) == "0ʰ00ᵐ"
    assert label_of(-0.5, 0.25, False, False) == "−0°30′"
    assert label_of(-1e-14, 0.25, False, False) == "0°00′"
    assert label_of(-90.0, 30.0, True, False) == "270°"


def test_what_it_cannot_do_well_is_left_to_astropy():
    assert (
        SkyAxes.of(made("TAN", [75, 89.99], 0.01)).ticks((200, 300), 60, 25) is None
    )  # a pole in the field
    assert SkyAxes.of(made("TAN", [75, 20], 0.01, turned=80.0)).ticks((200, 300), 60, 25) is None
    assert SkyAxes.of(made("AIT", [0, 0], 0.5)) is None
    assert SkyAxes.of(made("CAR", [0, 30], 0.1)) is None
    header = made("TAN", [75, 20], 0.01).to_header()
    header["CTYPE1"], header["CTYPE2"], header["A_ORDER"], header["B_ORDER"] = (
        "RA---TAN-SIP",
        "DEC--TAN-SIP",
        2,
        2,
    )
    assert SkyAxes.of(header) is None


def test_a_thinned_image_stays_in_its_place():
    axes = SkyAxes.of(CASES[0])
    np.testing.assert_allclose(axes.thinned(4).world(7, 9), axes.world(28, 36), rtol=0, atol=1e-12)


@pytest.mark.parametrize("offset", [0.0, 1e-3])
def test_distances_are_angles_on_the_sky(offset):
    from astropy.coordinates import SkyCoord

    wcs = CASES[0]
    centre = np.radians([75 + offset, 20.0])
    y, x = np.indices((20, 30))
    lon, lat = wcs.wcs_pix2world(x.ravel(), y.ravel(), 0)
    angle = (
        SkyCoord(lon, lat, unit="deg").separation(SkyCoord(*centre, unit="rad")).rad.reshape(20, 30)
    )
    np.testing.assert_allclose(SkyAxes.of(wcs).distance((20, 30), tuple(centre)), angle, rtol=1e-9)
