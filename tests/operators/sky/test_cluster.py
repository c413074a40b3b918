import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.cosmology import Planck18
from astropy.io import fits
from scipy.integrate import quad

from zonda.core.numerics.radiation import thermal_sz

ROOT = Path(__file__).resolve().parents[3]
SCRIPT = ROOT / "benchmarks" / "sky_data" / "cluster.py"
SHIPPED = ROOT / "pipelines" / "data" / "merging_cluster.fits"

if not SCRIPT.exists():
    pytest.skip("benchmarks are not in this copy", allow_module_level=True)
_found = importlib.util.spec_from_file_location("cluster", SCRIPT)
cluster = sys.modules["cluster"] = importlib.util.module_from_spec(_found)
_found.loader.exec_module(cluster)


@pytest.fixture(scope="module")
def remade(tmp_path_factory):
    path = tmp_path_factory.mktemp("cluster") / "cluster.fits"
    cluster.main([str(path)])
    return path


def test_the_shipped_map_is_what_the_script_makes(remade):
    with fits.open(SHIPPED) as old, fits.open(remade) as new:
        before, after = dict(old[0].header), dict(new[0].header)
        assert list(before) == list(after)
        for key, value in before.items():
            # a few operations in float64: other CPUs and libraries may round each otherwise
            assert after[key] == (
                pytest.approx(value, rel=1e-14) if isinstance(value, float) else value
            ), key
        # float32 of float64 sums: other CPUs may round the last bit or two otherwise
        np.testing.assert_allclose(old[0].data, new[0].data, rtol=1e-6, atol=1e-12)
    assert SHIPPED.stat().st_size < 2e6


def test_the_same_machine_gives_the_same_bytes(remade, tmp_path):
    cluster.main([str(tmp_path / "again.fits")])
    assert (tmp_path / "again.fits").read_bytes() == remade.read_bytes()
    assert b"DATE" not in remade.read_bytes()[:8640]


def test_header_and_decrement():
    with fits.open(SHIPPED) as hdus:
        header, values = hdus[0].header, hdus[0].data
    assert values.shape == (600, 600)
    assert values.dtype == np.dtype(">f4")
    assert (header["BUNIT"], header["TEMPSCAL"]) == ("K", "K_RJ")
    assert header["M500"] == pytest.approx(8e14, rel=1e-12)
    assert header["YTOKRJ"] == pytest.approx(float(thermal_sz(90e9)), rel=1e-12)
    assert -2e-3 < values.min() < -0.5e-3
    assert values.max() <= 0


def test_unit_y_is_the_same_map_before_conversion(tmp_path):
    cluster.main([str(tmp_path / "y.fits"), "--unit", "y"])
    with fits.open(tmp_path / "y.fits") as y, fits.open(SHIPPED) as kelvin:
        assert y[0].header["BUNIT"] == "y"
        np.testing.assert_allclose(y[0].data * thermal_sz(90e9), kelvin[0].data, rtol=1e-6)
    with pytest.raises(ValueError, match="unit must be y or K_RJ"):
        cluster.make("K_CMB")


@pytest.mark.parametrize("radius", [1.0, 30.0, 300.0, 1500.0])
def test_projection_against_adaptive_quadrature(radius):
    mass, z = 5e14, 1.0
    edge = np.sqrt((cluster.OUTER * cluster.r500(mass, z)) ** 2 - radius**2)
    exact = (
        2
        * quad(
            lambda depth: float(cluster.pressure(np.array(np.hypot(radius, depth)), mass, z)),
            0,
            edge,
            limit=400,
            points=[radius],
        )[0]
    )
    assert cluster.projected(np.array([radius]), mass, z)[0] == pytest.approx(exact, rel=1e-5)


def test_pressure_at_r500_is_arnaud_2010():
    # eq. 13 at x = 1 by hand, with h70 = H0 / 70
    mass, z = 3e14, 0.5
    h70 = Planck18.H0.value / 70
    shape = (
        8.403 * h70**-1.5 / (1.177**0.3081 * (1 + 1.177**1.0510) ** ((5.4905 - 0.3081) / 1.0510))
    )
    expected = 1.65e-3 * Planck18.efunc(z) ** (8 / 3) * h70 ** (2 / 3 + 0.12 + 2) * shape
    assert float(cluster.pressure(np.array([cluster.r500(mass, z)]), mass, z)[0]) == pytest.approx(
        expected, rel=1e-9
    )


def test_the_shock_is_an_edge():
    """Along the cap's axis y falls much faster than in the same map without a shock."""
    y, smooth = cluster.compton_y(), cluster.compton_y(shock=None)
    shock = cluster.SHOCK
    along = np.arange(20.0, 60.0)
    angle = np.radians(shock.angle)
    column = np.rint(299.5 - (shock.east + along * np.sin(angle))).astype(int)
    row = np.rint(299.5 + shock.north + along * np.cos(angle)).astype(int)
    assert np.abs(np.diff(y[row, column])).max() > 3 * np.abs(np.diff(smooth[row, column])).max()
    np.testing.assert_array_equal(y[0], smooth[0])
    assert shock.jump == pytest.approx(4.75)
