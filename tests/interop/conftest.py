"""A survey-like scan of two bands: turnarounds, trimmed ends, a dead and an opaque detector, kept
in Python and in files.
"""

import re
from pathlib import Path

import pytest
import yaml

import zonda

from ..scenes import Marks

INSTRUMENT = {
    "name": "camera",
    "telescope": {"name": "dish", "diameter": "6 m"},
    "bands": [
        {"name": "f090", "low": "77 GHz", "high": "106 GHz", "net": "300 uK s(1/2)"},
        {"name": "f150", "low": "130 GHz", "high": "170 GHz", "net": "360 uK s(1/2)"},
    ],
    "detectors": 14,
    "polarization": "pairs",
    "field_of_view": "8 deg",
    "main_beam_efficiency": 0.7,
    "illumination_efficiency": 0.9,
    "sample_rate": "100 Hz",
}
SCENE = {
    "site": "atacama",
    "instrument": INSTRUMENT,
    "time": "2024-06-25T07:00",
    "target": "az 180 deg el 50 deg",
    "seed": 1,
}
SCAN = {
    "throw": "4 deg",
    "speed": "0.8 deg/s",
    "acceleration": "1 deg/s2",
    "scan_duration": "41.3 s",
    "check_limits": "warn",
}


@pytest.fixture(scope="session")
def survey(tmp_path_factory):
    """The data of the run, whose products are files and maps of either band."""
    steps = [
        zonda.PointingBackAndForth(**SCAN, flag_turnarounds=True),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        Marks(),
        zonda.HighpassFilter(frequency="0.1 Hz", trim="1.5 s"),
        zonda.BinMap(projection="CAR", pixel="2 arcmin"),
        zonda.SaveTOD(),
    ]
    folder = tmp_path_factory.mktemp("survey")
    return zonda.Pipeline(steps).run(
        zonda.Scene(**SCENE), output=folder, keep=["signal"], threads=1
    )


SECTIONS = re.split(
    r"^## ", (Path(__file__).parents[2] / "docs" / "interop.md").read_text(), flags=re.MULTILINE
)


@pytest.fixture
def examples(tmp_path, monkeypatch):
    """Run all Python of a section of docs/interop.md, one block after the other, beside the my.yaml
    that it speaks of (and data of two bands where it names them). Returns the names that it
    defines."""
    monkeypatch.chdir(tmp_path)

    def run(section, pixels):
        scan = {"PointingBackAndForth": SCAN | {"scan_duration": "20 s", "flag_turnarounds": True}}
        steps = [scan, "WhiteNoise", "Efficiency", {"BinMap": pixels}, "SaveTOD"]
        scene = SCENE | {"instrument": "act_150ghz", "operators": steps}
        Path("my.yaml").write_text(yaml.safe_dump(scene))
        loaded = zonda.load("my.yaml")
        data = loaded.pipeline().run(loaded.scene(), output="out/before", keep=["signal"])
        bands = loaded.pipeline().run(zonda.Scene(**SCENE), output="out/bands", keep=["signal"])
        (text,) = (each for each in SECTIONS if each.startswith(f"{section}\n"))
        names = {"zonda": zonda, "data": data}
        for block in re.findall(r"```py\n(.*?)```", text, re.DOTALL):
            data = names["data"]
            if "f090" in block:
                names["data"] = bands
            exec(compile(block, "docs/interop.md", "exec"), names)
            if "f090" in block:
                names["data"] = data
        return names

    return run
