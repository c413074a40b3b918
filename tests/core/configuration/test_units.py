from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic_core import PydanticCustomError

import zonda
from zonda.core.configuration.parameters import Parameters, quantity
from zonda.core.configuration.units import (
    KINDS,
    LEAST,
    Angle,
    AngularAcceleration,
    AngularSpeed,
    Fraction,
    Hertz,
    Kelvin,
    KelvinRootSecond,
    Metres,
    MetresPerSecond,
    Seconds,
    Unit,
    factor_to,
)
from zonda.core.errors import ZondaError
from zonda.core.numerics.radiation import BOLTZMANN, PLANCK, T_CMB, intensity_to_kelvin


class All(Parameters):
    angle: Angle = quantity("4 arcmin", gt=0)
    speed: AngularSpeed = quantity("51 arcsec/s")
    acceleration: AngularAcceleration = quantity("0.05 deg/s2")
    time: Seconds = quantity("45 min")
    frequency: Hertz = quantity("78 GHz")
    length: Metres = quantity("7.7 mm")
    wind: MetresPerSecond = quantity("36 km/h")
    temperature: Kelvin | None = quantity("270 K")
    net: KelvinRootSecond = quantity("1.7 mK s(1/2)")
    share: Fraction = quantity("30 %")


def test_defaults_are_si() -> None:
    a = All()
    arcmin = np.pi / 180 / 60
    assert a.angle == pytest.approx(4 * arcmin, rel=1e-15)
    assert a.speed == pytest.approx(51 * arcmin / 60, rel=1e-15)
    assert a.acceleration == pytest.approx(np.radians(0.05), rel=1e-15)
    assert (a.time, a.frequency, a.length, a.wind, a.temperature, a.net, a.share) == (
        2700,
        78e9,
        7.7e-3,
        10,
        270,
        1.7e-3,
        0.3,
    )


ARCMIN, HOUR = np.pi / 10800, 3600.0


@pytest.mark.parametrize(
    ("si", "text", "factor"),
    [
        ("rad", "deg", np.pi / 180),
        ("rad", "°", np.pi / 180),
        ("rad", "arcsec", ARCMIN / 60),
        ("s", "min", 60),
        ("Hz", "GHz", 1e9),
        ("m", "µm", 1e-6),
        ("", "%", 0.01),
        *(
            ("K s(1/2)", text, 1e-3)
            for text in ("mK s(1/2)", "mK sqrt(s)", "mK * s(1/2)", "mK s**(1/2)", "mK s^0.5")
        ),
        *(
            ("rad / s2", text, np.pi / 180)
            for text in ("deg / s2", "deg/s^2", "deg s-2", "deg/s**2")
        ),
        *(("m / s", text, 1000 / HOUR) for text in ("km / h", "km h-1", "km.h-1")),
    ],
)
def test_units_and_the_ways_to_write_them(si: str, text: str, factor: float) -> None:
    # a product of a few correctly rounded factors
    assert factor_to(si, text) == pytest.approx(factor, rel=4 * np.finfo(float).eps)


@pytest.mark.parametrize("text", ["furlongs", "s(1/2", "m, s", "10**9999999 m", "K"])
def test_what_is_no_length(text: str) -> None:
    assert factor_to("m", text) is None


@pytest.mark.parametrize(
    "unit", ["km400", "s / mm400", "m(1/0)", "km" + "9" * 5000, "10**9999999 m"]
)
def test_powers_beyond_all_numbers_are_refused(unit: str) -> None:
    with pytest.raises(PydanticCustomError, match="unknown unit"):
        Unit("m").parse(f"1 {unit}")


def test_rarer_units_go_through_astropy() -> None:
    assert All(length="1 pc").length == pytest.approx(3.0856775814913674e16)
    assert All(time="1 yr").time == pytest.approx(365.25 * 86400)


def test_astropy_quantities() -> None:
    import astropy.units as u

    assert All(angle=2 * u.deg).angle == pytest.approx(np.radians(2))
    assert All(net=2 * u.mK * u.s**0.5).net == pytest.approx(2e-3)
    with pytest.raises(ZondaError, match="'s' is a unit of time"):
        All(angle=2 * u.s)
    with pytest.raises(ZondaError, match="an array of shape"):
        All(angle=[1, 2] * u.deg)


def test_numpy_pure_numbers() -> None:
    assert All(share=np.float32(0.5)).share == 0.5
    assert All(share="0.25").share == 0.25


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"angle": "4"}, "4 has no unit; write an angle such as '4 arcmin'"),
        ({"angle": 4}, "4 has no unit"),
        ({"angle": np.float64(4)}, "4.0 has no unit"),
        ({"angle": "4 s"}, "expected an angle such as '4 arcmin', but 's' is a unit of time"),
        ({"speed": "51 arcsec"}, "'arcsec' is a unit of angle"),
        ({"length": "7.7 mms"}, "unknown unit 'mms'"),
        ({"frequency": "fast"}, "cannot read 'fast' as a frequency"),
        ({"time": "1e999 s"}, "expected a finite number"),
        ({"time": "nan s"}, "cannot read 'nan s'"),
        ({"share": float("nan")}, "expected a finite number"),
        ({"share": float("inf")}, "expected a finite number"),
        ({"share": "3 m"}, "'m' is a unit of length"),
        ({"angle": True}, "expected an angle such as '4 arcmin', got True"),
        ({"angle": None}, "got None"),
        ({"angle": ["4 arcmin"]}, "expected an angle"),
        ({"angle": "-4 arcmin"}, "greater than 0"),
        ({"net": "1 mK/sqrt(Hz)"}, "differ by sqrt\\(2\\)"),
        ({"net": "1 mK Hz(-1/2)"}, "differ by sqrt\\(2\\)"),
    ],
)
def test_refusals(given: dict[str, object], words: str) -> None:
    with pytest.raises(ZondaError, match=words):
        All(**given)


def test_dump_is_readable_and_loads_again() -> None:
    a = All()
    assert a.model_dump(mode="json") == {
        "angle": "4 arcmin",
        "speed": "51 arcsec/s",
        "acceleration": "180 arcsec/s2",
        "time": "45 min",
        "frequency": "78 GHz",
        "length": "7.7 mm",
        "wind": "10 m/s",
        "temperature": "270 K",
        "net": "1.7 mK s(1/2)",
        "share": 0.3,
    }
    assert All.model_validate_json(a.model_dump_json()) == a
    assert All(temperature=None).model_dump(mode="json")["temperature"] is None


def test_si_text_is_exact() -> None:
    assert All(angle="0.001 rad").angle == 0.001


@pytest.mark.parametrize("unit", sorted(KINDS))
@given(value=st.floats(allow_nan=False, allow_infinity=False) | st.floats(-1e6, 1e6))
def test_written_values_read_back_to_the_same_bits(unit: str, value: float) -> None:
    kind = Unit(unit)
    if value == 0 or LEAST <= abs(value) <= kind.kind.most:
        assert kind.parse(kind.write(value)) == value
    else:
        with pytest.raises(PydanticCustomError, match="beyond what can be computed with"):
            kind.parse(kind.write(value))


def test_a_unit_of_ones_own() -> None:
    flux = Unit("Jy")
    assert flux.parse("3 mJy") == pytest.approx(3e-3)
    assert flux.parse(flux.write(0.1)) == 0.1
    with pytest.raises(
        ValueError,
        match="expected a quantity in Jy such as '1 Jy', but 'K' is a unit of temperature",
    ):
        flux.parse("3 K")


def test_schema_shows_unit_and_examples() -> None:
    angle = All.model_json_schema()["properties"]["angle"]
    assert angle["x-unit"] == "rad"
    assert "4 arcmin" in angle["examples"]


@pytest.mark.parametrize(
    ("make", "example"),
    [
        (lambda: zonda.HighpassFilter(frequency=3), "0.08 Hz"),
        (lambda: zonda.Band(name="x", low=3, high="4 GHz"), "90 GHz"),
        (lambda: zonda.PointingStare(sample_rate=3), "100 Hz"),
    ],
)
def test_an_example_is_of_the_parameters_own_size(make, example):
    with pytest.raises(ZondaError, match=f"such as '{example}'"):
        make()


@pytest.mark.parametrize(
    ("text", "cure"),
    [("9 mJy/beam s(1/2)", "1222 K NEFD / mJy"), ("9 uK_CMB s(1/2)", r"GHz / 56\.79")],
)
def test_a_noise_level_in_another_unit_is_told_its_conversion(text: str, cure: str) -> None:
    with pytest.raises(ZondaError, match=cure):
        All(net=text)


def test_the_conversions_of_noise_levels() -> None:
    """The factors that messages and docs/plugins.md state follow from the constants."""
    solid_angle = np.pi / (4 * np.log(2)) * np.radians(1 / 3600) ** 2
    assert 1e-29 * intensity_to_kelvin(1e9) / solid_angle == pytest.approx(1222, rel=1e-3)
    assert pytest.approx(56.79, rel=1e-4) == BOLTZMANN * T_CMB / PLANCK / 1e9
