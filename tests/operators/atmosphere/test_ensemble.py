"""`pwv_rms` is a property of the ensemble, not of one realization: short scans see one piece of
slowly changing air.
"""

import math

import numpy as np
import pytest

import zonda
from zonda.operators.atmosphere.distribution import Fluctuation
from zonda.operators.atmosphere.model import beam_sigma
from zonda.operators.atmosphere.turbulence.covariance import beam_correlation

HEIGHT, SPEED, P = 1500.0, 8.0, 0.02


def scans_of(seeds, seconds):
    """Observations of one detector that looks up, with the stream ``atmosphere`` kept: one per
    seed.
    """
    up = {"az": "0 deg", "el": "80 deg"}
    scene = zonda.Scene(
        site="green_bank", instrument="mustang2", time="2024-11-25T07:00", target=up
    )
    camera = scene.instrument.model_copy(
        update={"detectors": 1, "sample_rate": 30 / seconds if seconds > 30 else 2.0}
    )
    wind = {"speed": f"{SPEED} m/s", "direction": "270 deg"}
    air = zonda.AtmosphereLayers(
        pwv="7.7 mm", pwv_rms=P, layers=1, lowest=f"{HEIGHT} m", wind=wind, layer_response="column"
    )
    pipeline = zonda.Pipeline(
        [zonda.PointingStare(scan_duration=f"{seconds} s"), air], precision="float64"
    )
    scenes = (
        scene.model_copy(update={"instrument": camera, "seed": seed}) for seed in range(seeds)
    )
    return [pipeline.run(s, keep=["atmosphere"], threads=1).observations[0] for s in scenes]


def slope():
    """K per relative change of the water, from the mean emission at 1 % more and less."""
    up = {"az": "0 deg", "el": "80 deg"}
    scene = zonda.Scene(
        site="green_bank", instrument="mustang2", time="2024-11-25T07:00", target=up
    )
    found = []
    for factor in (0.99, 1.01):
        air = zonda.AtmosphereLayers(pwv=f"{7.7 * factor} mm", pwv_rms="0 %")
        data = zonda.Pipeline([zonda.PointingStare(scan_duration="1 s"), air]).run(scene)
        found.append(
            data.observations[0].smooth["atmosphere"].evaluate(slice(0, 1), slice(0, 1)).item()
        )
    return (found[1] - found[0]) / 0.02


@pytest.mark.parametrize("seconds", [30, 120, 2700])
def test_between_and_within_scans(seconds):
    """<y^2> is v for every duration; the scan's own variance is v (1 - mean of rho over the lags
    within it).

    With rho the correlation of the beam's view of the drifting air. The two are told apart: forcing
    every realization to the rms that was asked for would put all of v into every scan, though 30 s
    of air 8 m/s fast hold a tenth of it. Scan means of normal air have chi-square distributed
    squares: standard errors are those of the seeds' own scatter, or sqrt(2 / seeds).
    """
    seeds = 60 if seconds < 1000 else 20
    scans = scans_of(seeds, seconds)
    y = np.array([o.detdata["atmosphere"][0] for o in scans]) / slope()
    distance = HEIGHT / math.sin(math.radians(80))
    sigma = beam_sigma(scans[0].instrument.telescope, scans[0].instrument.band, distance)
    v = P**2 * beam_correlation(0.0, 500.0, sigma)[0]
    lag = SPEED * np.abs(np.subtract.outer(scans[0].seconds, scans[0].seconds))
    rho = (
        np.array(beam_correlation(lag.ravel(), 500.0, sigma)).reshape(lag.shape)
        / beam_correlation(0.0, 500.0, sigma)[0]
    )
    per_scan = np.mean(rho**2)  # relative variance of a scan's mean square, over 2
    assert np.mean(y**2) == pytest.approx(v, rel=4 * math.sqrt(2 * per_scan / seeds))
    assert abs(np.mean(y)) < 4 * math.sqrt(v * rho.mean() / seeds)
    within = y.var(axis=1)
    error = within.std(ddof=1) / math.sqrt(seeds)
    assert abs(within.mean() - v * (1 - rho.mean())) < 4 * error
    if seconds == 30:
        assert within.mean() + 4 * error < 0.4 * v
    if seconds == 2700:
        assert within.mean() - 4 * error > 0.6 * v


@pytest.mark.parametrize("rho", [0.3, 0.9, 0.999])
def test_covariance_of_the_log_normal_water(rho):
    """Two lines of sight with normal correlation rho: <y1 y2> = exp(s^2 v rho) - 1, and neighbours'
    differences follow.
    """
    p, v, n = 0.4, 0.9, 2_000_000
    law = Fluctuation(p, True, v)
    first, second = np.random.default_rng(3).standard_normal((2, n))
    g = np.sqrt(v) * np.array([first, rho * first + math.sqrt(1 - rho**2) * second])
    one, other = law(g)
    assert min(one.min(), other.min()) > -1
    s2v = math.log1p(p**2)  # after the beam: s^2 v gives the rms that was asked for
    product, difference = one * other, (one - other) ** 2
    expected = math.expm1(s2v * rho)
    assert abs(product.mean() - expected) < 5 * product.std() / math.sqrt(n)
    assert abs(difference.mean() - 2 * (p**2 - expected)) < 5 * difference.std() / math.sqrt(n)
