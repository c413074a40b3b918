"""Apertures with a rim: their transforms and bounds, and the pyramid behind them against direct
integration.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.special import j1

from zonda.core.errors import ZondaError
from zonda.operators.atmosphere.layers import AtmosphereLayers
from zonda.operators.atmosphere.turbulence.beams import Aperture
from zonda.operators.atmosphere.turbulence.covariance import beam_structure, correlation, structure
from zonda.operators.atmosphere.turbulence.lattice import Turbulence
from zonda.operators.atmosphere.turbulence.nodes import Layer

from ....checks.implied import implied_covariance

Floats = NDArray[np.float64]
OUTER_SCALE = 500.0


def footprint_pairs(aperture: Aperture, cells: int = 80) -> tuple[Floats, Floats]:
    """Separations (n, 2) within the footprint and their weights: its autocorrelation, on a grid,
    straight from its definition.
    """
    x = (np.arange(-cells, cells + 1)) / cells * aperture.diameter / 2 * 1.02
    fine = np.linspace(-0.5, 0.5, 9)[1::2] * (x[1] - x[0])
    r2 = (x[:, None, None, None] + fine[:, None]) ** 2 + (x[:, None, None] + fine) ** 2
    u2 = r2 / (aperture.diameter / 2) ** 2
    power = (np.exp(-aperture.taper * np.log(10) / 10 * u2) * (u2 <= 1)).mean((2, 3))
    size = 4 * cells + 2
    auto = np.fft.irfft2(abs(np.fft.rfft2(power, (size, size))) ** 2, (size, size))
    lag = np.fft.fftfreq(size, 1 / size) * (x[1] - x[0])
    at = np.stack(np.meshgrid(lag, lag, indexing="ij"), axis=-1).reshape(-1, 2)
    keep = auto.ravel() > 1e-9 * auto.max()
    return at[keep], auto.ravel()[keep] / auto.sum()


def direct_structure(aperture: Aperture, r: Floats) -> Floats:
    """sum over pairs within the footprint of [S(|r + pair|) - S(|pair|)]: no transforms, the
    point-like structure function.
    """
    pair, weight = footprint_pairs(aperture)
    here = structure(np.hypot(*pair.T) / OUTER_SCALE)
    return np.array(
        [weight @ (structure(np.hypot(pair[:, 0] + x, pair[:, 1]) / OUTER_SCALE) - here) for x in r]
    )


@pytest.mark.parametrize("taper", [0.0, 3.0, 10.0, 20.0])
def test_structure_function_is_that_of_the_autocorrelated_aperture(taper: float) -> None:
    aperture = Aperture(50.0, taper)
    r = np.array([1.0, 5.0, 20.0, 60.0, 300.0])
    np.testing.assert_allclose(
        aperture.structure(r, OUTER_SCALE), direct_structure(aperture, r), rtol=1e-3
    )
    pair, weight = footprint_pairs(aperture)
    assert aperture.variance(OUTER_SCALE) == pytest.approx(
        weight @ correlation(np.hypot(*pair.T) / OUTER_SCALE), rel=1e-4
    )


def test_transforms() -> None:
    k = np.geomspace(1e-6, 10, 50)
    x = k * 3.0
    np.testing.assert_allclose(Aperture(6.0).transform(k), 2 * j1(x) / x, atol=1e-9)
    np.testing.assert_allclose(Aperture(6.0, 1e-9).transform(k), 2 * j1(x) / x, atol=1e-8)
    assert Aperture(6.0).transform(0.0) == 1
    assert Aperture(6.0).sigma == pytest.approx(1.5)
    # A strong taper is a Gaussian of power exp(-beta u^2): sigma of the illumination a / sqrt(2
    # beta), beta = 6 ln 10.
    assert Aperture(6.0, 60.0).sigma == pytest.approx(3 / np.sqrt(2 * 6 * np.log(10)), rel=1e-3)


@pytest.mark.parametrize("taper", [0.0, 10.0, 40.0])
def test_the_bound_is_nowhere_below_the_spectrum(taper: float) -> None:
    aperture = Aperture(10.0, taper)
    k = np.linspace(0, 8, 2000)  # x = k a to 40
    square, share = aperture.bound()
    assert (
        np.exp(-np.multiply.outer(k * k, square)) @ share - aperture.transform(k) ** 2
    ).min() > -1e-5
    small = np.array([1e-3])
    u = sum(c * np.exp(-s * small**2) for c, s in aperture.gaussians)
    assert (u - aperture.transform(small) ** 2)[0] == pytest.approx(0, abs=1e-8)


@pytest.mark.parametrize(
    ("diameter", "taper"), [(6.0, 0.0), (50.0, 0.0), (90.0, 0.0), (100.0, 10.0), (0.42, 20.0)]
)
@pytest.mark.parametrize("fidelity", ["default", "fine"])
def test_implied_covariance_behind_apertures(diameter: float, taper: float, fidelity: str) -> None:
    aperture = Aperture(diameter, taper)
    layer = Turbulence(0, outer_scale=OUTER_SCALE, aperture=aperture, fidelity=fidelity)
    lags = np.array([1, 2, 4, 8, 12, 20, 60, 300])
    for phase in ((0, 0), (1, 1)):
        for direction in ((0, 1), (1, 0), (1, 1)):
            a = np.array([phase] * len(lags))
            b = a + lags[:, None] * np.array(direction)
            here, there, between = (
                implied_covariance(layer, p, q) for p, q in ((a, a), (b, b), (a, b))
            )
            s = aperture.structure(lags * np.hypot(*direction) * layer.spacing, OUTER_SCALE)
            assert abs(((here + there) / 2 - between) / s - 1).max() < 1e-3
            assert abs(here / layer.variance - 1).max() < 1e-3
    # The cubic spline between lattice points (its weights at the middle of 24), with the analytic
    # covariance.
    knots = np.arange(24.0)
    w = make_interp_spline(knots, np.eye(24), k=3)(11.5)
    r = layer.spacing * np.abs(np.r_[knots - 11.5, np.subtract.outer(knots, knots).ravel()])
    s = aperture.structure(r, OUTER_SCALE)
    error = 2 * w @ s[:24] - w @ s[24:].reshape(24, 24) @ w
    assert 0 < error < 2e-3 * aperture.structure(layer.spacing, OUTER_SCALE)[0]


def test_footprints_compared() -> None:
    # The paper's Gaussian of FWHM D is wider than the aperture itself: sigma 0.425 D against D / 4,
    # so neighbours differ less.
    gaussian, disc = (
        beam_structure(0.5, OUTER_SCALE, 6 / 2.3548)[0],
        Aperture(6.0).structure(0.5, OUTER_SCALE)[0],
    )
    tapered = Aperture(6.0, 10.0).structure(0.5, OUTER_SCALE)[0]
    assert gaussian < disc < tapered
    model = Layer(1.0, 500.0, 600.0, OUTER_SCALE, 1.5, Aperture(6.0))
    e, w = model.components()
    assert (-np.expm1(-(0.5**2) / (4 * e)) @ w) > disc  # what the choice of nodes is judged by


def test_edge_taper_is_for_tapered_beams() -> None:
    with pytest.raises(ZondaError, match="edge_taper is for beam: tapered"):
        AtmosphereLayers(beam="top_hat", edge_taper=10.0)
    assert AtmosphereLayers(beam="tapered", edge_taper=12.0).edge_taper == 12


@pytest.mark.parametrize(
    "parameters",
    [{"beam": "top_hat"}, {"beam": "tapered"}, {"beam": "tapered", "edge_taper": 20.0}],
)
def test_the_operator_takes_the_footprint(parameters: dict[str, Any]) -> None:
    from ..test_layers import expected_variance, instrument, observe, operator, water

    # Same air, another footprint: fluctuations alike, but not the same; a bigger variance behind
    # the smaller footprint.
    camera = instrument(detectors=7, field="1 arcmin", diameter="50 m")
    common = {"layers": 2, "wind": {"speed": "15 m/s"}}
    o = observe(120.0, 10.0, camera=camera)
    gaussian, other = (
        water(operator(**common), o),
        water(operator(**common, **parameters), observe(120.0, 10.0, camera=camera)),
    )
    assert np.corrcoef(gaussian[0], other[0])[0, 1] > 0.9
    assert expected_variance(operator(**common), o) < 1
    assert np.diff(other).std() > 1.05 * np.diff(gaussian).std()
