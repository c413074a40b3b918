"""Fields with units: ``'4 arcmin'`` in YAML or Python, a plain SI float in the operator.

>>> class Scan(Parameters):
...     radius: Angle = quantity("4 arcmin", gt=0)
>>> Scan(radius="2 arcmin").radius      # doctest: +ELLIPSIS
0.00058...

Texts, astropy quantities and, for pure numbers, plain numbers are accepted; a number without a unit
is an error. Units are those of astropy, written as it reads them: ``mK s(1/2)``, ``deg / s2``.
"""

from __future__ import annotations

import math
import re
from functools import lru_cache
from numbers import Real
from typing import Annotated, Any, NamedTuple

import astropy.units as u
from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import PydanticCustomError, core_schema

from .diagnostics import mistake, nearest


class Kind(NamedTuple):
    """One kind of quantity: how messages call it, examples, the units in which values are written
    back, and the largest value (SI) that is computed with."""

    noun: str
    examples: tuple[str, ...]
    display: tuple[str, ...]
    most: float = 1e30


LEAST = 1e-30
"""Smallest value (SI) besides zero that is computed with: squares and products of a few such
values, and of `Kind.most`, are still numbers."""

KINDS = {
    "rad": Kind(
        "an angle",
        ("4 arcmin", "11 arcsec", "0.5 deg"),
        ("deg", "arcmin", "arcsec", "rad"),
        1e6,
    ),
    "rad / s": Kind(
        "an angular speed",
        ("51 arcsec/s", "0.5 deg/s"),
        ("deg/s", "arcmin/s", "arcsec/s", "rad/s"),
        1e6,
    ),
    "rad / s2": Kind(
        "an angular acceleration",
        ("0.05 deg/s2",),
        ("deg/s2", "arcmin/s2", "arcsec/s2", "rad/s2"),
        1e6,
    ),
    "rad / s3": Kind(
        "an angular jerk",
        ("0.2 deg/s3",),
        ("deg/s3", "arcmin/s3", "arcsec/s3", "rad/s3"),
        1e6,
    ),
    "s": Kind("a time", ("20 min", "600 s"), ("s", "min", "h", "ms"), 1e15),
    "Hz": Kind("a frequency", ("0.1 Hz", "100 Hz"), ("Hz", "mHz", "GHz"), 1e18),
    "m": Kind("a length", ("1.8 mm", "1 km"), ("m", "mm", "km"), 1e20),
    "m / s": Kind("a speed", ("10 m/s", "36 km/h"), ("m/s",), 1e15),
    "K": Kind("a temperature", ("150 mK", "270 K"), ("K", "mK", "uK"), 1e15),
    "J": Kind("an energy k T", ("8 keV",), ("keV",), 1e15),
    "K s(1/2)": Kind(
        "a noise level",
        ("1.7 mK s(1/2)", "400 uK s(1/2)"),
        ("mK s(1/2)", "uK s(1/2)", "K s(1/2)"),
        1e15,
    ),
    "": Kind("a pure number", ("0.3", "30 %"), ("",)),
}
"""Kinds of quantities by SI unit."""

OTHER_NETS = {
    "Jy": ("a flux density", "write 1222 K NEFD / mJy / (GHz^2 arcsec^2): band's centre, FWHM"),
    "CMB": ("the CMB's temperature", "times x^2 e^x / (e^x - 1)^2, x = GHz / 56.79 of the band"),
}
"""Noise levels in units of other quantities: the quantity and its conversion, by a part of the
unit."""

_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*$", re.DOTALL)
_LARGE_POWER = re.compile(r"\d{3}")
"""Powers of three digits are refused: astropy would compute 10**9999999."""


_DECIMAL_POWER = re.compile(r"(?:\^|\*\*)(-?\d*\.\d+)")
"""s^0.5 and s**0.5, which astropy reads as s**(0.5)."""


@lru_cache(maxsize=512)
def read_unit(text: str) -> u.UnitBase:
    """The unit that a text names, e.g. ``mK s(1/2)``. Raises ValueError where there is none."""
    if _LARGE_POWER.search(text):
        raise ValueError("a number of three digits")
    try:
        unit = u.Unit(_DECIMAL_POWER.sub(r"**(\1)", text))
        if isinstance(unit, u.StructuredUnit):  # "m, s"
            raise ValueError("several units")
        unit.decompose()
    except (TypeError, OverflowError) as err:  # powers beyond all numbers, "m(1/0)"
        raise ValueError(str(err)) from None
    return unit


def factor_to(si: str, text: str) -> float | None:
    """Factor from the unit that ``text`` names to ``si``; None where it is no unit of that kind."""
    try:
        return float(read_unit(text).to(read_unit(si)))
    except (ValueError, ZeroDivisionError):
        return None


class Unit:
    """Annotation: read a quantity and convert it to ``unit``, an SI unit of `KINDS` or any that
    astropy knows.

    ``examples`` are what messages give, where those of the kind would mislead (elevations are
    degrees).
    """

    def __init__(self, unit: str, *examples: str) -> None:
        self.unit = unit
        kind = KINDS.get(unit, Kind(f"a quantity in {unit}", (f"1 {unit}",), (unit,)))
        self.kind = kind._replace(examples=examples or kind.examples)

    def __repr__(self) -> str:
        return f"Unit({self.unit!r})"

    @property
    def example(self) -> str:
        """Format in which such a quantity is written."""
        return self.kind.examples[0]

    def parse(self, value: Any) -> float:
        """The quantity in SI. Raises what `mistake` makes."""
        if isinstance(value, str):
            number, unit, caret = self._split(value)
            result = number * self._factor(value, unit, caret) if unit else number
        elif isinstance(value, bool) or not (isinstance(value, Real) or hasattr(value, "to_value")):
            raise mistake(f"expected {self.kind.noun} such as '{self.example}', got {value!r:.60}")
        elif isinstance(value, Real):
            if self.unit:
                raise self._without_unit(f"{value}")
            result = float(value)
        else:
            result = self._from_astropy(value)
        if not math.isfinite(result):
            raise mistake(f"expected a finite number, got {value}")
        if result and not LEAST <= abs(result) <= self.kind.most:
            beyond = f"more than {self.kind.most:g}" if abs(result) > 1 else f"less than {LEAST:g}"
            raise mistake(
                f"{value} is {beyond} {self.unit}".rstrip() + ", beyond what can be computed with"
            )
        return result

    def write(self, value: float) -> str:
        """The shortest text that reads back to the same bits, in a unit people use."""
        texts = [_shortest(value, name, factor_to(self.unit, name)) for name in self.kind.display]
        return min(
            (t for t in texts if t),
            key=lambda t: len(t.split(" ")[0]),
            default=f"{value!r} {self.unit}".strip(),
        )

    def write_in_unit_of(self, value: float, like: str) -> str:
        """``value`` (SI) in the unit that the text ``like`` uses, for messages about limits."""
        match = _NUMBER.match(like)
        factor = factor_to(self.unit, match[2]) if match and match[2] else None
        return f"{value / factor:.6g} {match[2]}" if match and factor else self.write(value)

    def _split(self, text: str) -> tuple[float, str, tuple[int, int]]:
        match = _NUMBER.match(text)
        if not match:
            message = (
                f"cannot read {text!r:.60} as {self.kind.noun}; write a number and a unit such as"
                f" '{self.example}'"
            )
            raise mistake(message if self.unit else message.replace(" and a unit", ""))
        if not match[2] and self.unit:
            raise self._without_unit(match[1])
        return float(match[1]), match[2], (match.start(2), len(match[2]))

    def _factor(self, text: str, unit: str, caret: tuple[int, int]) -> float:
        for part, (noun, cure) in OTHER_NETS.items():
            if self.unit == "K s(1/2)" and part in unit:
                message = f"{self.kind.noun} is in K s(1/2), Rayleigh-Jeans; '{unit}' is of {noun}"
                raise mistake(message, cure, caret=caret)
        if self.unit == "K s(1/2)" and "Hz" in unit:
            message = (
                f"'{unit}' may mean two things that differ by sqrt(2); write {self.kind.noun} in K"
                " s(1/2)"
            )
            raise mistake(message, "divide a NET per root hertz by sqrt(2)", caret=caret)
        try:
            known = read_unit(unit)
        except ValueError as err:
            hint = re.search(r"Did you mean ([^?]*)\?", str(err))
            otherwise = (
                f"did you mean {hint[1]}?"
                if hint
                else f"expected {self.kind.noun}, e.g. '{self.example}'"
            )
            label = nearest(unit, self.kind.display, otherwise)
            raise mistake(f"unknown unit '{unit}' in {text!r:.60}", label, caret=caret) from None
        return self._converted(1.0 * known, unit, caret)

    def _from_astropy(self, value: Any) -> float:
        if getattr(value, "shape", ()) != ():
            raise mistake(f"expected one value, got an array of shape {value.shape}")
        if self.unit == "K s(1/2)" and "Hz" in str(value.unit):
            return self._factor(str(value), str(value.unit), (0, 0))  # raises
        return self._converted(value, str(value.unit), None)

    def _converted(self, value: Any, unit: str, caret: tuple[int, int] | None) -> float:
        try:
            return float(value.to_value(read_unit(self.unit)))
        except u.UnitConversionError:
            kinds = (kind.noun for si, kind in KINDS.items() if value.unit.is_equivalent(si))
            known = str(value.unit.physical_type).replace("unknown", "something else")
            got = next(kinds, f"a {known}").split("/")[0].split(" ", 1)[1]
            message = (
                f"expected {self.kind.noun} such as '{self.example}', but '{unit}' is a unit of"
                f" {got}"
            )
            raise mistake(message, f"not {self.kind.noun}", caret=caret) from None

    def _without_unit(self, number: str) -> PydanticCustomError:
        message = f"{number} has no unit; write {self.kind.noun} such as '{self.example}'"
        return mistake(message, f"add a unit, e.g. {number} {self.example.split(' ', 1)[1]}")

    def __get_pydantic_core_schema__(
        self,
        source: Any,
        handler: GetCoreSchemaHandler,
    ) -> core_schema.CoreSchema:
        write = (lambda v: v) if self.unit == "" else self.write
        written = core_schema.plain_serializer_function_ser_schema(write, when_used="json")
        return core_schema.no_info_before_validator_function(
            self.parse,
            handler(source),
            serialization=written,
        )

    def __get_pydantic_json_schema__(
        self,
        schema: Any,
        handler: GetJsonSchemaHandler,
    ) -> dict[str, Any]:
        text = {
            "type": "string",
            "pattern": (
                r"^\s*[-+]?[0-9.]+([eE][-+]?[0-9]+)?" + (r"\s*\S.*$" if self.unit else r"\s*\S*$")
            ),
        }
        options = [text] if self.unit else [{"type": "number"}, text]
        return {"anyOf": options, "examples": list(self.kind.examples), "x-unit": self.unit}


def _shortest(value: float, name: str, factor: float | None) -> str | None:
    """``value`` (SI) in unit ``name``, where 15 digits or fewer read back to the same bits."""
    if factor is None:
        return None
    digits = f"{value / factor:.15g}"
    return f"{digits} {name}".strip() if float(digits) * factor == value else None


Angle = Annotated[float, Unit("rad")]
"""rad."""
AngularSpeed = Annotated[float, Unit("rad / s")]
"""rad/s."""
AngularAcceleration = Annotated[float, Unit("rad / s2")]
"""rad/s^2."""
AngularJerk = Annotated[float, Unit("rad / s3")]
"""rad/s^3."""
Seconds = Annotated[float, Unit("s")]
"""s."""
Hertz = Annotated[float, Unit("Hz")]
"""Hz, of samples and noise."""
RadioFrequency = Annotated[float, Unit("Hz", "90 GHz", "350 GHz")]
"""Hz, of light."""
SampleRate = Annotated[float, Unit("Hz", "100 Hz")]
"""Hz."""
Metres = Annotated[float, Unit("m")]
"""m."""
MetresPerSecond = Annotated[float, Unit("m / s")]
"""m/s."""
Kelvin = Annotated[float, Unit("K")]
"""K."""
ThermalEnergy = Annotated[float, Unit("J")]
"""J: k T of hot gas, written in keV."""
KelvinRootSecond = Annotated[float, Unit("K s(1/2)")]
"""K s^(1/2): the rms of one second of integration."""
Fraction = Annotated[float, Unit("")]
"""A pure number; per cent are understood."""
