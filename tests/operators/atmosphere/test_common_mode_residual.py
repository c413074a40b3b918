"""What is left of the atmosphere when its common mode is removed, from end to end, against the
analytic covariance.
"""

import numpy as np

import zonda
from zonda.operators.atmosphere.model import beam_sigma
from zonda.operators.atmosphere.turbulence.covariance import beam_structure

HEIGHT, ELEVATION, P, SEEDS = 2000.0, 50.0, 0.02, 30


def runner(rms, pwv="7.7 mm", **filter_options):
    """Function of a seed: 37 detectors in 0.5 deg look north at one layer that a west wind carries
    by.
    """
    north = {"az": "0 deg", "el": f"{ELEVATION} deg"}
    scene = zonda.Scene(
        site="green_bank", instrument="mustang2", time="2024-11-25T07:00", target=north
    )
    camera = scene.instrument.model_copy(
        update={"detectors": 37, "field_of_view": np.radians(0.5), "sample_rate": 2.0}
    )
    wind = {"speed": "30 m/s", "direction": "270 deg"}
    air = zonda.AtmosphereLayers(
        pwv=pwv, pwv_rms=rms, layers=1, lowest=f"{HEIGHT} m", wind=wind, layer_response="column"
    )
    steps = [zonda.PointingStare(scan_duration="120 s"), air, zonda.Efficiency()]
    if filter_options:
        steps.append(zonda.CommonModeFilter(**filter_options))
    pipeline = zonda.Pipeline(steps, precision="float64")

    def run(seed):
        here = scene.model_copy(update={"instrument": camera, "seed": seed})
        return pipeline.run(here, keep=["signal"], threads=1).observations[0]

    return run


def test_the_residual_is_what_the_covariance_says():
    """With C the covariance of the water, the detectors' mean leaves sum_jk [C(0) - C(r_jk)] / n^2
    of the variance.

    xi is along the wind, eta across it, and the gradients along both are compared too: air that did
    not vary across the wind would leave half. Standard errors are from the scatter of 30 seeds.
    """
    still = runner(0.0)(0)
    calm = still.detdata["signal"] - still.detdata["signal"].mean(
        axis=0
    )  # elevation's gradient of the mean emission
    plane = still.focalplane
    distance = HEIGHT / np.sin(np.radians(ELEVATION))
    sigma = beam_sigma(still.instrument.telescope, still.instrument.band, distance)
    apart = distance * np.hypot(
        np.subtract.outer(plane.xi, plane.xi), np.subtract.outer(plane.eta, plane.eta)
    )
    structure = np.array(beam_structure(apart.ravel(), 500.0, sigma)).reshape(apart.shape)
    first = slice(0, 37), slice(0, 1)
    drier, wetter = (
        runner(0.0, pwv=f"{7.7 * f} mm")(0).smooth["atmosphere"].evaluate(*first).mean()
        for f in (0.99, 1.01)
    )
    transmission = still.smooth["transmission"].evaluate(*first).mean()
    slope = (
        0.8 / (0.3 * transmission) * (wetter - drier) / 0.02
    )  # K of T_scan per relative change of the water
    expected = (P * slope) ** 2 * structure.mean()

    x, y = plane.xi - plane.xi.mean(), plane.eta - plane.eta.mean()
    found, gradients = [], []
    of_mean, of_mode = runner(P, method="mean"), runner(P, modes=1, on_undetermined="remove")
    for seed in range(SEEDS):
        whole = of_mean(seed).detdata["signal"]
        left = whole - calm
        found.append(np.mean(left**2))
        gradients.append([np.mean((v @ left / (v @ v)) ** 2) for v in (x, y)])
        if seed < 3:  # the first singular mode takes at least as much as the mean
            singular = of_mode(seed).detdata["signal"]
            assert np.mean(singular**2) <= np.mean(whole**2) * (1 + 1e-9)
    error = np.std(found, ddof=1) / np.sqrt(SEEDS)
    assert error < 0.1 * expected
    assert abs(np.mean(found) - expected) < 4 * error
    for mine, v in zip(
        np.array(gradients).T, (x, y), strict=True
    ):  # least squares: <g^2> = - v S v / (v v)^2
        analytic = -((P * slope) ** 2) * (v @ structure @ v) / (v @ v) ** 2
        assert analytic > 0
        assert abs(mine.mean() - analytic) < 4 * mine.std(ddof=1) / np.sqrt(SEEDS)
