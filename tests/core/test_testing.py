"""The conformance kit passes zonda's own operators and catches broken ones."""

from typing import ClassVar

import numpy as np
import pytest

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Kelvin
from zonda.core.mapmaker import MapMaker
from zonda.core.operator import Operator
from zonda.core.product import Product
from zonda.core.registry import operators
from zonda.core.signal import Component
from zonda.testing import check_operator

SIGNAL = frozenset({"signal"})
BUILT_IN = {
    "PointingDaisy": {"scan_duration": "20 s", "scans": 2},
    "PointingStare": {"scan_duration": "20 s"},
    "PointingBackAndForth": {"scan_duration": "60 s"},
    "PointingRaster": {"scan_duration": "60 s", "scans": 2, "angles": "cross_hatch"},
    "AtmosphereLayers": {"pwv": "5 mm"},
    "WhiteNoise": {"scatter": 0.1},
    "PinkNoise": {"shared": 0.3},
    "Efficiency": {},
    "HighpassFilter": {},
    "CommonModeFilter": {"modes": 2},
    "Detrend": {"order": 2},
    "Despline": {"knots": "5 s"},
    "Taper": {"share": "20 %"},
    "PolynomialFilter": {"order": 2},
    "GroundFilter": {},
    "HalfWavePlate": {"frequency": "2 Hz"},
    "Leakage": {},
    "GroundPickup": {},
    "Glitches": {},
    "GainDrift": {},
    "TimeConstant": {},
    "Crosstalk": {},
    "BinMap": {"pixel": "20 arcsec"},
    "MaximumLikelihoodMap": {"pixel": "20 arcsec"},
    "PowerSpectrum": {},
    "TimeStreams": {},
    "SaveTOD": {},
    "SaveMap": {},
    "ModeSpectrum": {"modes": 2, "delays": 1},
    "CompareStreams": {"segment": "2 s"},
    "MeasureFigures": {"metrics": ["central_rms", {"coverage": {"radius": "20 arcsec"}}]},
    "TransferFunction": {},
    "AtmosphereScreens": {},
    "CompareMaps": {},
    "MapSpectrum": {},
    "Plots": {},
    "Report": {},
}


@pytest.mark.parametrize("name", BUILT_IN)
def test_built_in_operators_keep_the_contract(name):
    check_operator(operators.get(name)(**BUILT_IN[name]))


def test_sky_map_keeps_the_contract():
    from pathlib import Path

    import zonda.pipelines

    file = Path(zonda.pipelines.__file__).parent / "data" / "merging_cluster.fits"
    check_operator(operators.get("SkyMap")(file=file))


def test_recorded_pointing_keeps_the_contract(tmp_path):
    t = np.arange(400) / 20
    columns = [1732518000 + t, 10 + 0.01 * np.sin(t), 45 + 0.01 * np.cos(t)]
    np.savetxt(
        tmp_path / "scan.csv",
        np.transpose(columns),
        fmt="%.9f",
        delimiter=",",
        header="time [s], az [deg], el [deg]",
    )
    check_operator(operators.get("PointingRecorded")(file=tmp_path / "scan.csv"))


def test_schedules_keep_the_contract(tmp_path):
    row = "2024-11-25 07:00:00 | 2024-11-25 07:00:30 | 0 | patch | 120 | 124 | 50 | 0 | 0"
    (tmp_path / "night.txt").write_text(f"green_bank | dish | 38.4 | -79.8 | 818\n{row}\n")
    check_operator(
        operators.get("PointingSchedule")(
            schedule=tmp_path / "night.txt", speed="0.5 deg/s", check_limits="warn"
        )
    )


def test_point_sources_keep_the_contract(tmp_path):
    (tmp_path / "sources.csv").write_text("ra [deg],dec [deg],flux [Jy]\n75,20,1\n")
    check_operator(operators.get("PointSources")(catalogue=tmp_path / "sources.csv"))


def test_the_cmb_keeps_the_contract(tmp_path):
    np.savetxt(tmp_path / "theory.txt", [[number, 1000.0] for number in range(2, 200)])
    check_operator(operators.get("CMBSky")(spectrum=tmp_path / "theory.txt", nside=64))


OF_OTHER_SCANS = {"LoadTOD", "Mispointing"}
"""The kit has no scan for them: one brings its own, the other changes where those of another step
point.
"""
NEED_OTHERS = {"ToastOperator", "PySMSky"}
"""They need packages that are not installed with the tests; tests/interop and sky/test_pysm.py have
them.
"""


def test_none_is_forgotten():
    own = {c.name for c in operators.candidates() if c.distribution == "zonda"}
    files = {"SkyMap", "PointingRecorded", "PointingSchedule", "PointSources", "CMBSky"}
    assert own == {*BUILT_IN, *files, *OF_OTHER_SCANS, *NEED_OTHERS}


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


class Forgets(Good):
    """Makes a stream that never reaches the signal."""

    provides: ClassVar[frozenset[str]] = frozenset({"glitches"})

    def exec(self, block, state):
        block.new("glitches")[...] = 1e-3


class ComponentOfBlocks(Good):
    """Makes a component whose values depend on the limits of the blocks."""

    provides: ClassVar[frozenset[str]] = frozenset({Component("glitches", "at the detector")})

    def exec(self, block, state):
        block.new("glitches")[...] = np.arange(block.shape[1])


class Forgetful(Product):
    """A sum that loses its digits when it is written, and that cannot be subtracted."""

    total = np.zeros(1)

    def __iadd__(self, other):
        self.total = self.total + other.total
        return self

    def arrays(self):
        return {"total": self.total}

    @classmethod
    def of(cls, arrays):
        return cls()


class Faithful(Forgetful):
    """A sum that cannot be subtracted."""

    @classmethod
    def of(cls, arrays):
        made = cls()
        made.total = arrays["total"]
        return made


class Counts(MapMaker):
    """A linear map maker."""

    requires: ClassVar[frozenset[str]] = SIGNAL
    provides: ClassVar[frozenset[str]] = frozenset({"counts"})
    linear: ClassVar[bool] = True
    kind: ClassVar[type[Product]] = Forgetful

    def collect(self, data, observation, state):
        sums = self.kind()
        sums.total = np.array([observation.n_samples])
        data.add(self.label, sums)


class CountsFaithfully(Counts):
    """A linear map maker."""

    kind: ClassVar[type[Product]] = Faithful


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
        (Forgets(), r"check_components: makes \['glitches'\].*provide zonda.Component\('glitches'"),
        (ComponentOfBlocks(), "other bits with"),
        (Counts(), r"Forgetful.of does not restore its arrays\(\)"),
        (CountsFaithfully(), r"Faithful has no subtract\(\)"),
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


class Normalizes(Operator):
    """Divides by the rms of everything; it forgets to use the complete data's."""

    requires: ClassVar[frozenset[str]] = SIGNAL
    provides: ClassVar[frozenset[str]] = SIGNAL
    couples: ClassVar = "all"
    linear: ClassVar[bool] = True

    def measure(self, stream, model=None):
        return float(np.std(stream.array[:16, :1000].astype(float))) or 1.0

    def exec(self, block, state):
        block.detdata["signal"] /= block.dtype(state)


class NormalizesAlike(Normalizes):
    """The same, right."""

    def measure(self, stream, model=None):
        return super().measure(stream) if model is None else model


class Rectifies(Good):
    """Says that it is linear, and takes absolute values."""

    linear: ClassVar[bool] = True

    def exec(self, block, state):
        np.abs(block.detdata["signal"], out=block.detdata["signal"])


class Offsets(Good):
    """Says that it is linear, and adds a constant."""

    linear: ClassVar[bool] = True


def test_an_operator_that_is_not_linear():
    check_operator(NormalizesAlike())
    for broken, words in (
        (Normalizes(), "does not add up"),
        (Rectifies(), "does not add up"),
        (Offsets(), "something of nothing"),
    ):
        with pytest.raises(
            AssertionError, match=f"check_linear: says that it is linear, but .*{words}"
        ):
            check_operator(broken)


class Gain(Good):
    """Multiplies the signal; what is kept beside it is added for it."""

    def exec(self, block, state):
        block.detdata["signal"] *= block.dtype(1.001)


class GainThatKnows(Gain):
    """Says that it knows of means, and overlooks them."""

    knows_means: ClassVar[bool] = True

    def exec(self, block, state):
        super().exec(block, state)


class GainThatDoes(Gain):
    """Multiplies both."""

    knows_means: ClassVar[bool] = True

    def exec(self, block, state):
        super().exec(block, state)
        if "signal" in block.means:
            block.means["signal"] = block.means["signal"].scaled(
                np.full(block.observation.n_detectors, float(block.dtype(1.001)))
            )


class GainOfAtmosphere(Gain):
    """Multiplies the emission."""

    requires: ClassVar[frozenset[str]] = frozenset({"atmosphere"})
    provides: ClassVar[frozenset[str]] = frozenset({"atmosphere"})

    def exec(self, block, state):
        block.detdata["atmosphere"] *= block.dtype(1.001)


class GainOfAtmosphereThatKnows(GainOfAtmosphere):
    """Overlooks the mean in ``observation.smooth``."""

    knows_means: ClassVar[bool] = True

    def exec(self, block, state):
        super().exec(block, state)


class Counts(Operator):
    """Makes a product alone: the sum of all samples."""

    requires: ClassVar[frozenset[str]] = SIGNAL
    provides: ClassVar[frozenset[str]] = frozenset({"total"})

    def prepare(self, observation):
        return np.zeros((observation.n_detectors, observation.n_samples))

    def exec(self, block, state):
        state[block.detectors, block.samples] = block.detdata["signal"]

    def collect(self, data, observation, state):
        data.products["total"] = state.sum(axis=1)


class CountsThatKnows(Counts):
    """Leaves the mean out."""

    knows_means: ClassVar[bool] = True

    def exec(self, block, state):
        super().exec(block, state)


class MeasuresThatKnows(NormalizesAlike):
    """Measures without the mean, adds it in `exec`."""

    knows_means: ClassVar[bool] = True

    def measure(self, stream, model=None):
        return super().measure(stream, model)

    def exec(self, block, state):
        whole = block.total("signal") / state
        block.means.pop("signal", None)
        block.detdata["signal"][...] = whole


def test_the_mean_is_no_trap():
    for right in (Gain(), GainThatDoes(), GainOfAtmosphere(), Counts(), NormalizesAlike()):
        check_operator(right)


@pytest.mark.parametrize(
    ("broken", "words"),
    [
        (
            GainThatKnows(),
            (
                "check_means: scan-000 signal is another where the mean of signal stands beside the"
                " stream"
            ),
        ),
        (
            GainOfAtmosphereThatKnows(),
            "check_means: scan-000 atmosphere is another where the mean of atmosphere",
        ),
        (CountsThatKnows(), "check_means: total is another"),
        (MeasuresThatKnows(), "check_means: scan-000 signal is another"),
    ],
)
def test_whoever_says_that_it_knows_of_means_must(broken, words):
    with pytest.raises(AssertionError, match=words):
        check_operator(broken)


TYPED = """
import zonda
class Typed(zonda.Operator):
    "An operator typed at the prompt of python, whose source is in no file."
    requires = provides = frozenset({"signal"})
    level: float = 2.0
    "A parameter."
    def exec(self, block, state):
        block.detdata["signal"] *= self.level
"""


def test_an_operator_typed_at_the_prompt_keeps_the_contract():
    """Python keeps no source of it, so docstrings of fields cannot be asked for."""
    names = {"__name__": __name__}
    exec(compile(TYPED, "<stdin>", "exec"), names)
    check_operator(names["Typed"]())
