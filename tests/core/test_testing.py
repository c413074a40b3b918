"""The conformance kit passes zonda's own operators and catches broken ones."""

from typing import ClassVar

import numpy as np
import pytest

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Kelvin
from zonda.core.operator import Operator
from zonda.core.registry import mapmakers, operators
from zonda.testing import check_operator

SIGNAL = frozenset({"signal"})
BUILT_IN = {
    "PointingDaisy": {"scan_duration": "20 s", "scans": 2},
    "PointingStare": {"scan_duration": "20 s"},
    "PointingBackAndForth": {"scan_duration": "60 s"},
    "AtmosphereLayers": {"pwv": "5 mm"},
    "WhiteNoise": {"scatter": 0.1},
    "PinkNoise": {"shared": 0.3},
    "Efficiency": {},
    "HighpassFilter": {},
    "CommonModeFilter": {"modes": 2},
    "BinMap": {"pixel": "20 arcsec"},
    "PowerSpectrum": {},
    "TimeStreams": {},
    "SaveTOD": {},
    "SaveMap": {},
    "Plots": {},
    "Report": {},
}


@pytest.mark.parametrize("name", BUILT_IN)
def test_built_in_operators_keep_the_contract(name):
    registry = mapmakers if name in mapmakers else operators
    check_operator(registry.get(name)(**BUILT_IN[name]))


def test_sky_map_keeps_the_contract():
    from pathlib import Path

    import zonda.pipelines

    file = Path(zonda.pipelines.__file__).parent / "data" / "merging_cluster.fits"
    check_operator(operators.get("SkyMap")(file=file))


def test_recorded_pointing_keeps_the_contract(tmp_path):
    t = np.arange(400) / 20
    columns = [1732518000 + t, 10 + 0.01 * np.sin(t), 45 + 0.01 * np.cos(t)]
    np.savetxt(tmp_path / "scan.csv", np.transpose(columns), fmt="%.9f", delimiter=",", header="time [s], az [deg], el [deg]")
    check_operator(operators.get("PointingRecorded")(file=tmp_path / "scan.csv"))


def test_none_is_forgotten():
    own = {c.name for r in (operators, mapmakers) for c in r.candidates() if c.distribution == "zonda"}
    assert own == {*BUILT_IN, "SkyMap", "PointingRecorded"}


class Good(Operator):
    """Adds a constant."""

    requires: ClassVar[frozenset[str]] = SIGNAL
    provides: ClassVar[frozenset[str]] = SIGNAL
    level: Kelvin = quantity("1 mK")
    """What is added."""

    def exec(self, block, state):
        block.detdata["signal"] += block.dtype(self.level)


class Undocumented(Good):
    """Has a field of which nobody knows what it is."""

    level: float = 1.0


class Peeks(Good):
    """Reads what it does not declare."""

    def exec(self, block, state):
        block.detdata["signal"] += block.detdata["white"]


class Meddles(Good):
    """Changes what it does not provide."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal", "white"})

    def exec(self, block, state):
        block.detdata["white"] += 1


class Invents(Good):
    """Makes what it does not provide."""

    def exec(self, block, state):
        block.new("glitches")


class DependsOnBlocks(Good):
    """Subtracts the mean of the block."""

    def exec(self, block, state):
        block.detdata["signal"] -= block.detdata["signal"].mean()


class Blows(Good):
    """Divides by zero."""

    def exec(self, block, state):
        with np.errstate(divide="ignore"):
            block.detdata["signal"] /= block.dtype(0)


@pytest.mark.parametrize(
    ("broken", "words"),
    [
        (Undocumented(), "parameter level has no docstring"),
        (Peeks(), r"reads \['white'\], which it does not declare"),
        (Meddles(), "changes white, which it does not provide"),
        (Invents(), r"makes \['glitches'\]"),
        (DependsOnBlocks(), "other bits with"),
        (Blows(), "signal is not finite"),
    ],
)
def test_broken_operators_are_caught(broken, words):
    check_operator(Good(level="2 mK"))
    with pytest.raises(AssertionError, match=words):
        check_operator(broken)


def test_expected_failures():
    check_operator(Blows(), expected_failures={"check_finite": "it is meant to"})
    with pytest.raises(AssertionError, match="though it was expected to fail"):
        check_operator(Good(), expected_failures={"check_finite": "it was meant to"})
