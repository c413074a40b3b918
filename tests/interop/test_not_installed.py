"""Steps that need a package which is not installed say so, with the cure, before anything is
simulated.
"""

from importlib.util import find_spec

import pytest
import yaml

from zonda.core.cli import main

SCENE = {
    "site": "atacama",
    "instrument": "act_150ghz",
    "time": "2024-06-25T07:00",
    "target": "az 180 deg el 50 deg",
    "seed": 1,
}
STEPS = {
    "toast": (
        "toast",
        [
            "WhiteNoise",
            "Efficiency",
            {"ToastOperator": {"operator": "PolyFilter", "traits": {"order": 3}}},
        ],
    ),
    "pysm3": ("pysm", [{"PySMSky": {"models": ["d1", "s1"]}}, "WhiteNoise", "Efficiency"]),
}
"""Of each package its extra and steps that need it."""


@pytest.mark.parametrize("package", STEPS)
@pytest.mark.parametrize("command", ["check", "run"])
def test_the_cure_is_the_extra(package, command, tmp_path, capsys):
    if find_spec(package) is not None:
        pytest.skip(f"{package} is installed")
    scan = {"PointingBackAndForth": {"scan_duration": "10 s", "check_limits": "warn"}}
    extra, chain = STEPS[package]
    steps = [scan, *chain, {"BinMap": {"pixel": "2 arcmin"}}]
    (tmp_path / "run.yaml").write_text(yaml.safe_dump(SCENE | {"operators": steps}))
    more = ["--output", str(tmp_path / "out")] if command == "run" else []
    assert main([command, str(tmp_path / "run.yaml"), *more]) == 2
    said = capsys.readouterr().err
    assert f"cannot import {package}" in said
    assert f"pip install 'zonda[{extra}]'" in said
