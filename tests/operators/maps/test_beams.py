"""The beam of maps to which detectors, scans or entries of several beams contribute."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest

from zonda.core.maps.beams import Beams, effective_fwhm
from zonda.core.maps.map_file import MapFile
from zonda.core.numerics.projection import directions
from zonda.core.numerics.sphere import ARCMIN, FWHM_PER_SIGMA
from zonda.core.storage.fits_files import header_of
from zonda.operators.maps.bin_map import BinMap

STEP = 6 * math.radians(1 / 3600)


def dense(bench, n_det=3, index=0):
    """Every detector samples the same square of 12 arcmin, 6 arcsec apart."""
    n = 121
    observation = bench.observation(n_det, n * n, index=index)
    y, x = (STEP * (axis - n // 2) for axis in np.indices((n, n)).reshape(2, -1))
    lat = bench.CENTRE[1] + y
    observation.boresight_radec = bench.quaternions(bench.CENTRE[0] + x / np.cos(lat), lat, 0.0)
    observation.focalplane.xi[:] = observation.focalplane.eta[:] = 0.0
    return observation


def jansky(observation):
    """A source of 1 Jy in the middle, in Jy/sr, which each detector sees through its own beam."""
    ra, dec = observation.centre
    centre = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    d = directions(
        observation.boresight_radec, observation.focalplane.xi, observation.focalplane.eta
    )
    apart = 2 * np.arcsin(np.linalg.norm(d - centre, axis=-1) / 2)
    sigma = observation.focalplane.fwhm[:, None] / FWHM_PER_SIGMA
    return 1e-6 * np.exp(-(apart**2) / (2 * sigma**2)) / (2 * math.pi * sigma**2)


def area(fwhm):
    return math.pi / math.log(16) * fwhm**2


@pytest.mark.parametrize("net", [(1.0, 1.0, 1.0), (2.0, 1.0, 0.5)])
def test_peak_times_beam_and_the_integral_are_the_flux(bench, net):
    """Beams of 1, 3, 3 arcmin: peak x BMAJ's solid angle was 3.93 Jy for 1 Jy."""
    observation = dense(bench)
    plane = observation.focalplane
    plane.fwhm[:] = np.array([1.0, 3.0, 3.0]) * ARCMIN
    plane.net *= net
    with pytest.warns(UserWarning, match="beams of 1′ to 3′"):
        product = bench.run(
            [BinMap(pixel="6 arcsec")], observation, {"signal": jansky}, precision="float64"
        ).map
    # samples lie within half a pixel of 0.1 FWHM of the pixel's centre: 0.1^2 / 12 x 8 ln 2 / 2 =
    # 0.2 % of the peak, and what a pixel without a sample at the very centre misses is less
    assert np.nanmax(product.signal) * area(product.fwhm) == pytest.approx(1e-6, rel=0.01)
    assert float((product.signal * product.areas())[product.hits > 0].sum()) == pytest.approx(
        1e-6, rel=0.01
    )
    w = np.array(net) ** -2.0
    assert product.fwhm == pytest.approx(math.sqrt(w.sum() / (w / plane.fwhm**2).sum()), rel=1e-3)
    beam = header_of(MapFile.of("map", product).beam)
    assert beam["BMAJ"] == pytest.approx(math.degrees(product.fwhm))
    assert (beam["BEAMLOW"], beam["BEAMHIGH"]) == pytest.approx((1 / 60, 3 / 60))


def test_one_beam_is_itself_to_the_bit_and_dead_detectors_count_nothing(bench):
    observation = dense(bench)
    plane = observation.focalplane
    plane.fwhm[:] = np.array([1.1, 1.1, 3.0]) * ARCMIN
    observation.detector_flags[2] = 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        product = bench.run([BinMap(pixel="6 arcsec")], observation, {"signal": jansky}).map
    assert product.fwhm == plane.fwhm[0]
    assert "BEAMLOW" not in header_of(MapFile.of("map", product).beam)


def test_scans_of_two_beams(bench):
    """1.4 arcmin and 40 arcsec, whichever comes first; I, Q and U as well; smoothed with its own
    beam.
    """
    first, second = dense(bench), dense(bench, index=1)
    first.focalplane.fwhm[:], second.focalplane.fwhm[:] = 1.4 * ARCMIN, ARCMIN * 2 / 3
    for scan in (first, second):
        scan.focalplane.polarization_efficiency[:] = 1.0
        scan.focalplane.polarization_angle[:] = np.radians([0.0, 60.0, 120.0])
    expected = math.sqrt(2 / (1.4**-2 + 1.5**2)) * ARCMIN
    found = {}
    for order in ((first, second), (second, first)):
        for stokes in ("I", "IQU"):
            step = BinMap(pixel="6 arcsec", stokes=stokes, width="4 arcmin")
            with pytest.warns(UserWarning, match="beams of"):
                made = bench.run([step], list(order), {"signal": jansky}, precision="float64")
            assert made.map.fwhm == pytest.approx(expected, rel=1e-3)
            assert np.nanmax(made.map.signal) * area(made.map.fwhm) == pytest.approx(1e-6, rel=0.01)
            assert made.log["BinMap", "beam of the map (FWHM)"].startswith(
                "51.1″: peak times its area"
            )
            assert found.setdefault(stokes, made.map.fwhm) == made.map.fwhm  # to the bit


def test_sums_of_beams_do_not_depend_on_the_order():
    rng = np.random.default_rng(3)
    parts = [Beams() for _ in range(20)]
    for part in parts:
        part.add(
            rng.choice(rng.uniform(1, 2, 5), 30),
            rng.uniform(0.1, 3, 30),
            int(rng.integers(1, 10**6)),
        )
    results = set()
    for _ in range(5):
        whole = Beams()
        for k in rng.permutation(20):
            whole += parts[k]
        results.add(whole.fwhm)
    assert len(results) == 1


def test_unknown_beams():
    assert effective_fwhm({}) == 0.0
    assert effective_fwhm({0.0: 1, 1.0: 1}) == 0.0
    assert effective_fwhm({0.0: 0, 1.0: 2}) == 1.0
