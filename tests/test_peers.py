"""`benchmarks/peers.py`: environments that are not there, and the statistics against a process
drawn from its covariance.
"""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from zonda.operators.atmosphere.turbulence.covariance import beam_correlation

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
if not (BENCHMARKS / "peers.py").exists():
    pytest.skip("benchmarks are not in this copy", allow_module_level=True)


def module(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"benchmarks_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    found = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = found
    spec.loader.exec_module(found)
    return found


def test_a_missing_environment_is_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    peers = module(BENCHMARKS / "peers.py")
    assert peers.installed(
        {"toast": None, "maria": "/nowhere/python", "numpy": sys.executable}
    ) == {"numpy": sys.executable}
    said = capsys.readouterr().out.splitlines()
    assert [line.split(" (")[0] for line in said] == [
        "toast: not installed",
        "maria: not installed",
    ]
    assert peers.installed({"no_such_package": sys.executable}) == {}


def test_a_script_that_fails_is_one_line(tmp_path: Path) -> None:
    peers = module(BENCHMARKS / "peers.py")
    with pytest.raises(RuntimeError, match=r"No such file|cannot open"):
        peers.call(sys.executable, "zonda_chain_is_not_here.py", [], tmp_path, 60)


def test_scans_move_at_the_speed_of_the_case() -> None:
    peers = module(BENCHMARKS / "peers.py")
    t = np.arange(0, 60, 0.01)
    azimuth, elevation = peers.boresight(peers.CASES["SURVEY"], t)
    speed = np.abs(np.gradient(azimuth, t)).max() * np.cos(elevation[0])
    assert speed == pytest.approx(peers.CASES["SURVEY"].speed, rel=1e-3)


def test_statistics_of_a_process_with_the_wanted_covariance(tmp_path: Path) -> None:
    # Two detectors on one frozen layer, drawn from the exact covariance: ratios are 1 within 4 of
    # the errors they state (8 of them, 400 realizations: a false alarm in 2000), and not where one
    # detector's amplitude is 1.5 times what is stated.
    table = module(BENCHMARKS / "peers" / "statistics_table.py").table
    n, step, speed, r0, sigma, apart = 64, 1.0, 10.0, 300.0, 10.0, 25.0
    x = speed * step * np.arange(n)
    along, across = np.r_[x, x], np.repeat([0.0, apart], n)
    lag = np.hypot(along[:, None] - along, across[:, None] - across)
    value, vector = np.linalg.eigh(beam_correlation(lag.ravel(), r0, sigma).reshape(lag.shape))
    rng = np.random.default_rng(1)
    y = (rng.standard_normal((400, 2 * n)) * np.sqrt(np.maximum(value, 0))) @ vector.T
    layers = {
        "amplitude": [1.0],
        "outer_scale": [r0],
        "sigma": [sigma],
        "positions": [[[0.0, 0.0], [0.0, apart]]],
        "speed": [speed],
    }

    def ratios(factor: float) -> list[tuple[float, float]]:
        path = tmp_path / "y.npz"
        np.savez(path, y=factor * y.reshape(400, 2, n), step=step, **layers)
        parts = [text.split(" +- ") for _, text in table(path, {"pair": (0, 1)})]
        return [(float(mean), float(error)) for mean, error in parts]

    found = ratios(1.0)
    assert len(found) >= 4
    assert all(abs(mean - 1) < 4 * error + 1e-3 for mean, error in found)
    assert all(abs(mean - 1) > 4 * error for mean, error in ratios(1.5))
