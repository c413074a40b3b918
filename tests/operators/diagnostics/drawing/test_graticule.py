"""Meridians and parallels near the poles, in turned images and on the whole sky."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.wcs import WCS

from zonda.operators.diagnostics.drawing.graticule import AstropyAxes, graticule
from zonda.operators.diagnostics.drawing.map_layout import located
from zonda.operators.diagnostics.drawing.sky_axes import SkyAxes

SHAPE = (200, 300)


def made(projection, centre, scale, turned=0.0):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = [f"RA---{projection}", f"DEC--{projection}"]
    wcs.wcs.crval, wcs.wcs.crpix, wcs.wcs.cdelt = centre, [150.5, 100.5], [-scale, scale]
    c, s = np.cos(np.radians(turned)), np.sin(np.radians(turned))
    wcs.wcs.pc = [[c, -s], [s, c]]
    wcs.wcs.set()
    return wcs


def degrees(text):
    sign, unit = (-1 if text.startswith("−") else 1), (15 if "ʰ" in text else 1)
    fields = text.lstrip("−").translate(str.maketrans("ʰᵐˢ°′″", "      ")).split()
    return sign * unit * sum(float(f) / 60**k for k, f in enumerate(fields))


CASES = {
    "pole in the field": (
        made("TAN", [75, 89.9], 2 / 3600),
        "RA along the edges, Dec on its circles (ICRS)",
        "",
    ),
    "pole in the middle": (
        made("TAN", [75, -90], 0.01),
        "RA along the edges, Dec on its circles (ICRS)",
        "",
    ),
    "beside the pole": (
        made("TAN", [75, 88.5], 0.01),
        "RA along the edges, Dec on its circles (ICRS)",
        "",
    ),
    "turned by 50 deg": (made("TAN", [75, 20], 0.001, 50.0), "Dec (ICRS)", "RA (ICRS)"),
    "turned by 40 deg": (made("TAN", [75, 20], 0.001, 40.0), "RA (ICRS)", "Dec (ICRS)"),
    "turned by 90 deg": (made("TAN", [75, 20], 0.001, 90.0), "Dec (ICRS)", "RA (ICRS)"),
    "half the sky": (
        made("ZEA", [30, 40], 0.4),
        "RA along the edges, Dec on its circles (ICRS)",
        "",
    ),
    "all sky": (made("AIT", [0, 0], 1.2), "RA on its lines, Dec on its lines (ICRS)", ""),
}


@pytest.mark.parametrize("case", CASES)
def test_every_label_is_in_its_place(case):
    """Longitudes and latitudes written are astropy's there, and the axes are named after what
    stands at them.
    """
    wcs, across, up = CASES[case]
    axes = located(wcs)
    assert not isinstance(axes, SkyAxes) or axes.ticks(SHAPE, 60, 25) is None
    found = graticule(axes, SHAPE, 5.5, 12.0)  # pixels
    assert found.names == (across, up)
    written = [(x, y, t) for x, y, t in found.inside]
    for edge, ticks in found.marks.items():
        for place, text in zip(*ticks, strict=True):
            at = {
                "bottom": (place, -0.5),
                "top": (place, 199.5),
                "left": (-0.5, place),
                "right": (299.5, place),
            }[edge]
            written.append((*at, text))
            what = {"bottom": across, "left": up or across}.get(edge, across)
            assert ("RA" if "ʰ" in text else "Dec") in what
    assert len(written) >= 6
    for x, y, text in written:
        lon, lat = wcs.wcs_pix2world(x, y, 0)
        value, wanted = (lon, degrees(text)) if "ʰ" in text else (lat, degrees(text))
        # lines are drawn with 241 points, labels at their edges on the chord: within a pixel of the
        # true place
        shift = np.hypot(*(np.array(wcs.wcs_pix2world(x + 1, y + 1, 0)) - [lon, lat]))
        assert abs((value - wanted + 180) % 360 - 180) <= max(2 * shift, 1e-9), text


@pytest.mark.parametrize("case", CASES)
def test_labels_do_not_overlap(case):
    axes = located(CASES[case][0])
    found = graticule(axes, SHAPE, 5.5, 12.0)
    for edge, ticks in found.marks.items():
        for before, after, text in zip(
            ticks.places, ticks.places[1:], ticks.labels[1:], strict=False
        ):
            assert after - before >= (5.5 * len(text) if edge in ("bottom", "top") else 12.0)
    boxes = [(x, y, 5.5 * len(t) / 2, 6.0) for x, y, t in found.inside]
    for k, (x, y, w, h) in enumerate(boxes):
        assert w <= x <= 300 - w
        assert h <= y <= 200 - h
        assert all(abs(x - u) >= w / 2 + v / 2 or abs(y - z) >= h for u, z, v, _ in boxes[:k])


@pytest.mark.parametrize("wcs", [w for w, *_ in CASES.values()])
def test_pixels_are_the_reverse_of_positions(wcs):
    axes = located(wcs)
    x, y = np.meshgrid(np.linspace(10, 290, 9), np.linspace(10, 190, 7))
    lon, lat = axes.world(x, y)
    seen = np.isfinite(lon)
    back = np.array(axes.pixel(lon[seen], lat[seen]))
    np.testing.assert_allclose(back, [x[seen], y[seen]], rtol=0, atol=1e-6)
    if isinstance(axes, SkyAxes):
        np.testing.assert_allclose(
            back, AstropyAxes(wcs, axes.names).pixel(lon[seen], lat[seen]), rtol=0, atol=1e-6
        )


def test_what_a_projection_does_not_show_has_no_pixel():
    axes = located(made("TAN", [75, 20], 0.01))
    assert np.isnan(axes.pixel(255.0, -20.0)).all()
