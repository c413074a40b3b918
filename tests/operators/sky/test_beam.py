import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from zonda.operators.sky.beam import SIGMA, convolve, distinct

ARCSEC = np.pi / 648000


def value(convolved, x, y, outside=0.0):
    """The convolved map at input pixels (x, y), 0-based."""
    p = convolved.to_grid @ np.array([x, y, np.ones_like(x)])
    return (
        map_coordinates(convolved.coefficients["float64"], p[1::-1], order=3, prefilter=False)
        + outside
    )


@pytest.mark.parametrize("shape", [(33, 47), (64, 50), (1, 1)])
@pytest.mark.parametrize("pixels", [8.5, 4.0, 3.0, 2.0])
def test_one_bright_pixel_is_a_gaussian_of_the_fwhm(shape, pixels):
    values = np.zeros(shape)
    values[shape[0] // 2, shape[1] // 2] = 1.0
    made = convolve(values, np.diag([-ARCSEC, ARCSEC]), pixels * ARCSEC, 0.0)
    dx, dy = np.random.default_rng(1).uniform(-pixels, pixels, (2, 500))
    s = SIGMA * pixels
    exact = np.exp(-(dx**2 + dy**2) / (2 * s * s)) / (2 * np.pi * s * s)
    # the cubic B-spline's own error at 4 points per FWHM is below 0.3 % of the peak (numerics.md,
    # section 3)
    np.testing.assert_allclose(
        value(made, shape[1] // 2 + dx, shape[0] // 2 + dy), exact, atol=3e-3 / (2 * np.pi * s * s)
    )


def test_oblong_rotated_pixels():
    angle, sides = np.radians(33.0), np.diag([-1.0, 2.0])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    jacobian = turn @ sides * ARCSEC
    values = np.zeros((40, 60))
    values[20, 30] = 1.0
    made = convolve(values, jacobian, 12 * ARCSEC, 0.0)
    dx, dy = np.random.default_rng(2).uniform(-5, 5, (2, 300))
    r = jacobian @ np.array([dx, dy])
    s = SIGMA * 12 * ARCSEC
    exact = 2 * ARCSEC**2 * np.exp(-(r**2).sum(0) / (2 * s * s)) / (2 * np.pi * s * s)
    np.testing.assert_allclose(value(made, 30 + dx, 20 + dy), exact, atol=3e-3 * exact.max())


@pytest.mark.parametrize(
    ("pixels", "tolerance"), [(8.0, 1e-9), (3.0, 1e-6), (2.0, 1e-5), (1.0, 1e-5), (0.3, 1e-5)]
)
def test_a_uniform_sky_stays_uniform_for_every_pixel_size(pixels, tolerance):
    # from 2 pixels per FWHM the ripple is 4 exp(-2 pi^2 sigma^2) = 3e-6 at 2; below, the image is
    # smooth by construction
    made = convolve(np.full((120, 121), 2.5), np.diag([-ARCSEC, ARCSEC]), pixels * ARCSEC, 0.0)
    x, y = np.random.default_rng(3).uniform(58, 62, (2, 400))
    np.testing.assert_allclose(value(made, x, y), 2.5, rtol=tolerance)


def test_a_coarse_image_is_smooth_and_keeps_its_grid():
    """Fewer than 2 pixels per FWHM: a wave of 12 pixels loses what the beam takes from it and
    nothing else.
    """
    x = np.arange(240.0)
    made = convolve(
        np.tile(np.cos(2 * np.pi * x / 12), (240, 1)), np.diag([-ARCSEC, ARCSEC]), 1.5 * ARCSEC, 0.0
    )
    assert made.coarse
    assert made.steps == (1, 1)
    at = np.random.default_rng(5).uniform(100, 140, (2, 300))
    loss = np.exp(-2 * np.pi**2 * (SIGMA * 1.5 / 12) ** 2)
    np.testing.assert_allclose(value(made, *at), loss * np.cos(2 * np.pi * at[0] / 12), atol=5e-4)
    assert not convolve(np.ones((9, 9)), np.diag([-ARCSEC, ARCSEC]), 2.0 * ARCSEC, 0.0).coarse


def test_outside_is_the_padding():
    """A map whose value is the outside's has no edge at all, and half of a step's edge is seen at
    the edge.
    """
    flat = convolve(np.full((9, 9), 3.0), np.diag([-ARCSEC, ARCSEC]), 9 * ARCSEC, 3.0)
    assert not np.any(flat.coefficients["float64"])
    step = convolve(np.full((101, 101), 1.0), np.diag([-ARCSEC, ARCSEC]), 8 * ARCSEC, 0.0)
    np.testing.assert_allclose(value(step, np.array([-0.5]), np.array([50.0])), 0.5, rtol=1e-3)


def test_nothing_wraps_around():
    values = np.zeros((30, 30))
    values[:, 0] = 1.0
    made = convolve(values, np.diag([-ARCSEC, ARCSEC]), 6 * ARCSEC, 0.0)
    assert abs(value(made, np.array([29.0]), np.array([15.0]))[0]) < 1e-12


def test_no_beam_returns_the_pixels():
    values = np.random.default_rng(4).standard_normal((12, 17))
    y, x = np.mgrid[0:12.0, 0:17.0]
    made = convolve(values, np.diag([-ARCSEC, ARCSEC]), 0.0, 0.0)
    np.testing.assert_allclose(value(made, x.ravel(), y.ravel()), values.ravel(), atol=1e-6)


def test_denormals_are_flushed():
    values = np.zeros((200, 200))
    values[100, 100] = 1e-3
    c = convolve(values, np.diag([-ARCSEC, ARCSEC]), 8 * ARCSEC, 0.0).coefficients["float32"]
    assert np.all((c == 0) | (np.abs(c) >= 0.9e-16 * np.abs(c).max()))
    assert np.count_nonzero(c == 0) > 1000


def test_distinct_beams():
    values, index = distinct(np.array([3.0, 1.0, 3.0, 1.0005, 2.0]))
    np.testing.assert_allclose(values, [1.00025, 2.0, 3.0])
    np.testing.assert_array_equal(index, [2, 0, 2, 0, 1])
    values, index = distinct(np.full(5, 4.1e-5))
    assert values.tolist() == [4.1e-5]


@pytest.mark.parametrize("pixel", [1e-9, 1e-35, 1e-100])
def test_pixels_far_smaller_than_the_beam_are_refused(pixel):
    """Their margins, a beam wide, fit no memory."""
    from zonda.core.errors import InputError

    with pytest.raises(InputError, match=r"needs .* GB"):
        convolve(np.ones((11, 11)), np.diag([-pixel, pixel]) * 4.8e-6, 5e-5, 0.0)


def test_a_faint_map_is_not_set_to_zero() -> None:
    """What is flushed is a share of the image's own peak: a map of 8e-25 K keeps its shape to the
    bit.
    """
    values = np.zeros((41, 41))
    values[20, 20] = 1.0
    jacobian = np.diag([-1.0, 1.0]) * 1e-5
    bright, faint = (
        convolve(values * scale, jacobian, 3e-5, 0.0).coefficients["float64"]
        for scale in (1.0, 2.0**-80)
    )
    assert np.array_equal(faint, bright * 2.0**-80)
    size = np.abs(bright[bright != 0])
    assert size.size > 100
    assert size.min() >= 1e-16 * size.max()
