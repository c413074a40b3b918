"""The transfer function of a noiseless run: what the filters leave of each angular scale."""

from itertools import pairwise

import numpy as np
import pytest

import zonda
from zonda.core.projection import rotation_matrices

PIXEL, CUT = 4.0, 0.08  # arcsec, Hz


@pytest.fixture(scope="module")
def field(tmp_path_factory):
    """A map of random structure on all scales, 17 arcmin wide."""
    from astropy.io import fits

    n, pixel = 512, 2.0
    k = np.hypot(*np.meshgrid(np.fft.fftfreq(n, pixel), np.fft.fftfreq(n, pixel)))
    white = np.fft.fft2(np.random.default_rng(1).standard_normal((n, n)))
    values = np.fft.ifft2(white * np.where(k > 0, np.maximum(k, 1 / 600) ** -1.5, 0)).real
    image = fits.PrimaryHDU(1e-3 * values / values.std())
    image.header.update(CTYPE1="RA---TAN", CTYPE2="DEC--TAN", CRPIX1=256.5, CRPIX2=256.5, CRVAL1=75, CRVAL2=20)
    image.header.update(CDELT1=-pixel / 3600, CDELT2=pixel / 3600, CUNIT1="deg", CUNIT2="deg", BUNIT="K", TEMPSCAL="K_RJ")
    path = tmp_path_factory.mktemp("sky") / "field.fits"
    image.writeto(path)
    return path


def noiseless(field, *filters):
    scene = zonda.Scene(site="green_bank", instrument="mustang2", time="2024-11-25T07:00", target="05h +20d", seed=1)
    steps = [
        zonda.PointingDaisy(radius="4 arcmin", speed="50 arcsec/s", scan_duration="4.3 min", sample_rate="50 Hz"),
        zonda.SkyMap(file=field),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        *filters,
        zonda.BinMap(pixel=f"{PIXEL} arcsec", width="10 arcmin"),
    ]
    data = zonda.Pipeline(steps, runs={"noiseless": {"only": ["sky"]}}).run(scene)
    return data.products["noiseless/map"], data.observations[0]


def transfer(before, after, scales):
    """Real part of the cross spectrum over the spectrum of what was there, in rings between the scales [arcsec]."""
    reach = np.radians(3.5 / 60)
    window = np.cos(np.pi / 2 * np.minimum(before.distance() / reach, 1)) ** 2

    def spectrum(product):
        signal = np.nan_to_num(product.signal)
        return np.fft.fft2((signal - (signal * window).sum() / window.sum()) * window)

    a, b = spectrum(before), spectrum(after)
    side = before.signal.shape[0]
    k = np.hypot(*np.meshgrid(np.fft.fftfreq(side, PIXEL), np.fft.fftfreq(side, PIXEL)))
    rings = [(k >= 1 / low) & (k < 1 / high) for low, high in pairwise(scales)]
    return [(k[r].mean(), (b[r] * a[r].conj()).real.sum() / (np.abs(a[r]) ** 2).sum()) for r in rings]


def test_high_pass_and_common_mode(field):
    """A wave of k per arcsec, crossed at an angle phi, is seen at f = k v |cos phi| and is lost where f is below the cut.

    Averaged over phi, T(k) = 1 - (2 / pi) asin(cut / (k v)), and over the speeds v of the scan. The path bends within a cycle
    of the filter, so this holds to some percent below 100 arcsec. The common mode of 4.2 arcmin takes only what is larger.
    """
    highpass = zonda.HighpassFilter(frequency=f"{CUT} Hz")
    plain, observation = noiseless(field)
    high, _ = noiseless(field, highpass)
    both, _ = noiseless(field, highpass, zonda.CommonModeFilter(modes=1))
    forward = rotation_matrices(observation.boresight_radec)[:, :, 2]
    speed = np.degrees(np.linalg.norm(np.diff(forward, axis=0), axis=1)) * 3600 * observation.sample_rate
    scales = [400, 250, 120, 75, 55, 40, 30, 22]
    of_high, of_both = transfer(plain, high, scales), transfer(plain, both, scales)
    for (k, found), (_, with_mode), large in zip(of_high, of_both, [True, True, *[False] * 5], strict=True):
        expected = 1 - 2 / np.pi * np.arcsin(np.minimum(1, CUT / (k * speed))).mean()
        assert with_mode < found + 0.01
        if large:
            assert with_mode < found < 0.85
        else:
            assert abs(found - expected) < 0.05
            assert abs(with_mode - found) < 0.02
    assert of_both[0][1] < 0.4  # beyond 250 arcsec most is lost
    assert of_both[-1][1] > 0.95  # at 25 arcsec nearly nothing


def test_without_filters_nothing_is_lost(field):
    """The unfiltered map is the beam-smoothed input at each pixel, whatever was on other scales."""
    from astropy.io import fits
    from astropy.wcs import WCS
    from scipy.ndimage import gaussian_filter, map_coordinates

    product, _ = noiseless(field)
    with fits.open(field) as file:
        smooth = gaussian_filter(file[0].data.astype(float), 8.5 / 2.3548 / 2.0)
        y, x = np.indices(product.signal.shape)
        world = WCS(product.header).pixel_to_world_values(x, y)
        column, row = WCS(file[0].header).world_to_pixel_values(*world)
    expected = map_coordinates(smooth, [row, column], order=3)
    use = (product.hits > 100) & (product.distance() < np.radians(3 / 60))
    # a pixel's samples are spread over it, not at its centre: 4 arcsec of a field whose gradient is 1e-5 K/arcsec
    assert np.sqrt(np.mean((product.signal - expected)[use] ** 2)) < 0.03 * expected[use].std()
    slope = (product.signal[use] * expected[use]).sum() / (expected[use] ** 2).sum()
    assert abs(slope - 1) < 0.01
