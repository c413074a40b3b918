"""Bilinear sampling of the sky against exact Gaussians and its bound, |e| <= h^2 / 12 (|f_xx| +
|f_yy|).
"""

import numpy as np
import pytest

from zonda.operators.sky.planning import LINEAR
from zonda.operators.sky.skymap import SkyMap

ARCSEC = np.pi / 648000
FWHM = 9.0
SIGMA = FWHM / np.sqrt(8 * np.log(2))


@pytest.fixture
def source(made, save):
    """(a map of one bright pixel of flux 1, a scan at random offsets within 15 arcsec of it, what
    the beam makes of it).
    """
    values = np.zeros((90, 90))
    values[45, 40] = 1.0
    path = save(values, made.tan_header((90, 90), crpix=(41.0, 46.0)))
    rng = np.random.default_rng(7)
    east, north = rng.uniform(-15, 15, (2, 4000))
    east[:2000] /= 15  # many near the peak, where the error is largest
    north[:2000] /= 15
    lon, lat = made.offset(
        np.radians(75), np.radians(20), np.tan(east * ARCSEC), np.tan(north * ARCSEC)
    )
    exact = np.exp(-(east**2 + north**2) / (2 * SIGMA**2)) / (2 * np.pi * SIGMA**2)
    return path, made.observation(lon, lat, fwhm=FWHM), exact


@pytest.mark.parametrize("points", [9, 18])
def test_the_error_is_within_its_bound_and_has_no_mean(made, source, points):
    path, scan, exact = source
    got = made.look(
        SkyMap(file=path, interpolation="linear", pixels_per_fwhm=min(points, 16)), scan
    )[0]
    error = (got - exact) / exact.max()
    bound = LINEAR / points**2
    assert 0.5 * bound < np.abs(error).max() < bound
    # regression on the source: without the division by sinc^2 its amplitude would be low by h^2 /
    # 12 x 2 / sigma^2 / 2, that is a third of the largest error or more; the scatter of 4000
    # samples of e ~ bound / 3 leaves less than a twentieth
    amplitude = (got @ exact) / (exact @ exact) - 1
    assert abs(amplitude) < bound / 10


def test_bits_do_not_depend_on_blocks_and_precision_agrees(made, source):
    path, scan, exact = source
    operator = SkyMap(file=path, interpolation="linear")
    single, double = (
        made.look(operator, scan, dtype=np.float32)[0],
        made.look(operator, scan, dtype=np.float64)[0],
    )
    np.testing.assert_allclose(single, double, atol=3e-5 * exact.max())


def test_off_the_grid_is_left_alone(made, save):
    path = save(np.ones((40, 40)), made.tan_header((40, 40), crpix=(20.5, 20.5)))
    lon, lat = made.offset(np.radians(75), np.radians(20), np.array([0.0, 0.05]), np.zeros(2))
    got = made.look(
        SkyMap(file=path, interpolation="linear", outside="2 K"),
        made.observation(lon, lat, fwhm=FWHM),
    )[0]
    assert got[1] == 2.0
    assert got[0] == pytest.approx(1.0, abs=2e-3)


def test_nan_free_far_behind(made, source):
    path, _, _ = source
    scan = made.observation(np.radians([255.0, 75.0]), np.radians([-20.0, 20.0]), fwhm=FWHM)
    got = made.look(SkyMap(file=path, interpolation="linear"), scan)[0]
    assert np.isfinite(got).all()
    assert got[0] == 0.0


def test_the_bound_of_oblong_pixels_is_that_of_their_longer_side(made, save):
    """It was that of the square of their area: four times too low for 1 x 4 arcsec."""
    from types import SimpleNamespace

    from zonda.core.plan.planning import planning_of

    operator = SkyMap(file=save(np.zeros((60, 60)), made.tan_header((60, 60), cdelt=(-1.0, 4.0))))
    grid = operator.grid_of(made.observation([np.radians(75)], np.radians(20), fwhm=16.0))
    context = SimpleNamespace(sky_error=lambda share: {"peak": share}, samples=1e9)
    effect = planning_of(operator)._order(context, grid, 16 * ARCSEC)
    assert effect.choices[-1].bound["peak"] == pytest.approx(LINEAR / 4**2)
