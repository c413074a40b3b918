"""Maps are brought to one beam and one grid without changing what they show."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.coordinates import SkyCoord

from zonda.core.errors import InputError
from zonda.core.numerics.sphere import ARCSEC
from zonda.operators.diagnostics.comparison.planes import Plane, common, positions


def header(
    side: int, pixel: float, shift: float = 0.0, axes: str = "TAN", frame: str = "icrs"
) -> dict[str, object]:
    lon, lat = ("RA---", "DEC--") if frame == "icrs" else ("GLON-", "GLAT-")
    middle = (side + 1) / 2
    place = SkyCoord(75.0, 20.0, unit="deg").galactic
    crval = (75.0, 20.0) if frame == "icrs" else (place.l.deg, place.b.deg)
    world = {
        "CTYPE1": lon + axes,
        "CTYPE2": lat + axes,
        "CUNIT1": "deg",
        "CUNIT2": "deg",
        "CRVAL1": crval[0],
        "CRVAL2": crval[1],
    }
    world |= {
        "CRPIX1": middle + shift,
        "CRPIX2": middle,
        "CDELT1": -pixel / 3600,
        "CDELT2": pixel / 3600,
    }
    return world | ({"RADESYS": "ICRS"} if frame == "icrs" else {})


def gaussian(side: int, pixel: float, fwhm: float, shift: float = 0.0) -> np.ndarray:
    """A Gaussian of integral 1 in units of pixels of 1 arcsec^2, about the reference point of
    `header`.
    """
    y, x = np.indices((side, side)) - (side - 1) / 2
    r2 = ((x - shift) * pixel) ** 2 + (y * pixel) ** 2
    return np.exp(-4 * np.log(2) * r2 / fwhm**2) * 4 * np.log(2) / (np.pi * fwhm**2)


def test_the_same_grid_keeps_its_bits():
    values = np.random.default_rng(1).standard_normal((20, 20))
    values[3, 4] = np.nan
    a = Plane("a", values, header(20, 2.0), fwhm=9 * ARCSEC)
    b = Plane("b", 2 * values, header(20, 2.0), fwhm=9 * ARCSEC)
    first, second, notes = common(a, b)
    assert first.values is values
    np.testing.assert_array_equal(second.values, 2 * values)
    assert "is on the same pixels" in notes[-1]


def test_a_shift_of_whole_pixels_keeps_bits():
    values = np.random.default_rng(2).standard_normal((20, 20))
    moved = Plane("b", values, header(20, 2.0, shift=3.0))
    _, found, _ = common(Plane("a", np.ones((20, 20)), header(20, 2.0)), moved)
    np.testing.assert_array_equal(found.values[:, :17], values[:, 3:])
    assert np.isnan(found.values[:, 17:]).all()


@pytest.mark.parametrize(("axes", "frame"), [("TAN", "icrs"), ("SIN", "icrs"), ("TAN", "galactic")])
def test_other_grids_are_interpolated(axes, frame):
    """A Gaussian of 10 pixels FWHM on shifted pixels of another size, projection and frame is what
    it is on the grid itself.

    The error of cubic splines for a wave of n pixels is about (pi / n)^4 of it; a Gaussian of FWHM
    F pixels has waves of n = 2 pi F / 2.355 pixels at 1 sigma, here 27: 2e-4. Its place is wrong by
    1e-3 pixels where the frames agree to 1e-7 deg.
    """
    fine, coarse = 2.0, 3.0
    a = Plane("a", gaussian(81, fine, 30.0), header(81, fine))
    b = Plane(
        "b",
        gaussian(61, coarse, 30.0, shift=0.4),
        header(61, coarse, shift=0.4, axes=axes, frame=frame),
    )
    first, second, notes = common(a, b)
    assert first.values is a.values  # smaller pixels
    both = np.isfinite(second.values)
    assert np.abs(second.values - a.values)[both].max() < 1e-3 * a.values.max()
    assert "interpolated by cubic splines" in notes[-1]
    assert both.sum() > 0.7 * both.size


def test_the_finer_grid_is_used_whichever_comes_first():
    a = Plane("a", gaussian(61, 3.0, 30.0), header(61, 3.0))
    b = Plane("b", gaussian(81, 2.0, 30.0), header(81, 2.0))
    first, second, _ = common(a, b)
    assert first.values.shape == second.values.shape == (81, 81)
    np.testing.assert_array_equal(second.values, b.values)


def test_one_beam():
    """Gaussians of 20 and 30 arcsec, smoothed to 36, are the same Gaussian: kernels are cut at 5
    sigma, 4e-6 of the weight.
    """
    a = Plane("a", gaussian(121, 2.0, 20.0), header(121, 2.0), fwhm=20 * ARCSEC)
    b = Plane("b", gaussian(121, 2.0, 30.0), header(121, 2.0), fwhm=30 * ARCSEC)
    first, second, notes = common(a, b, 36 * ARCSEC)
    expected = gaussian(121, 2.0, 36.0)
    inner = slice(30, 91)
    for found in (first, second):
        np.testing.assert_allclose(
            found.values[inner, inner], expected[inner, inner], atol=1e-4 * expected.max()
        )
    assert "smoothed from 20″ to 36″" in notes[0]
    with pytest.raises(InputError, match="smaller than the map's"):
        common(a, b, 25 * ARCSEC)


def test_smoothing_knows_no_holes_and_propagates_noise():
    """A constant map stays constant around a hole; independent noise n becomes n (sum K^2)^(1/2),
    as 150 realizations say.
    """
    values = np.full((31, 31), 3.0)
    values[15, 15] = np.nan
    found = Plane("a", values, header(31, 2.0), fwhm=0.0, noise=np.ones((31, 31))).smoothed(
        8 * ARCSEC
    )
    assert np.isnan(found.values[15, 15])
    np.testing.assert_allclose(found.values[np.isfinite(values)], 3.0, rtol=1e-12)
    rng = np.random.default_rng(3)
    drawn = [
        Plane("n", rng.standard_normal((31, 31)), header(31, 2.0), fwhm=0.0)
        .smoothed(8 * ARCSEC)
        .values
        for _ in range(150)
    ]
    assert found.noise is not None
    measured = (
        np.std(drawn, axis=0)[5:-5, 5:-5] / found.noise[5:-5, 5:-5]
    )  # the hole changes its neighbours by some per cent
    assert np.nanmean(measured) == pytest.approx(
        1.0, abs=0.04
    )  # 1/sqrt(300) = 0.06 each, some 20 independent patches: 0.013


def test_unknown_beams_are_said():
    a = Plane("a", gaussian(41, 2.0, 20.0), header(41, 2.0), fwhm=20 * ARCSEC)
    b = Plane("b", gaussian(41, 2.0, 20.0), header(41, 2.0))
    _, second, notes = common(a, b, 30 * ARCSEC)
    np.testing.assert_array_equal(second.values, b.values)
    assert "b: its beam is not known" in notes[0]


def test_refusals():
    a = Plane("a", np.ones((9, 9)), header(9, 2.0))
    far = header(9, 2.0) | {"CRVAL1": 80.0}
    with pytest.raises(InputError, match="no pixel in common"):
        common(a, Plane("b", np.ones((9, 9)), far))
    with pytest.raises(InputError, match="b: no pixel has a value"):
        common(a, Plane("b", np.full((9, 9), np.nan), header(9, 2.0)))


def test_behind_the_tangent_point_there_is_nothing():
    behind = Plane("b", np.ones((9, 9)), header(9, 2.0) | {"CRVAL1": 255.0, "CRVAL2": -20.0})
    x, _ = positions(Plane("a", np.ones((9, 9)), header(9, 2.0)).grid, behind.grid)
    assert np.isnan(x).all()
