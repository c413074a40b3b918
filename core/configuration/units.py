"""Fields with units: ``'4 arcmin'`` in YAML or Python, a plain SI float in the operator.

>>> class Scan(Parameters):
...     radius: Angle = quantity("4 arcmin", gt=0)
>>> Scan(radius="2 arcmin").radius      # doctest: +ELLIPSIS
0.00058...

Texts, astropy quantities and, for pure numbers, plain numbers are accepted; a number without a unit
is an error. The common units are read here; what they do not cover is left to astropy, which takes
half a second to import.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from functools import lru_cache
from numbers import Real
from typing import Annotated, Any, NamedTuple

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import PydanticCustomError, core_schema

from .diagnostics import nearest
from .values import mistake


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
        "an angle", ("4 arcmin", "11 arcsec", "0.5 deg"), ("deg", "arcmin", "arcsec", "rad"), 1e6
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
        "an angular jerk", ("0.2 deg/s3",), ("deg/s3", "arcmin/s3", "arcsec/s3", "rad/s3"), 1e6
    ),
    "s": Kind("a time", ("20 min", "600 s"), ("s", "min", "h", "ms"), 1e15),
    "Hz": Kind("a frequency", ("90 GHz", "100 Hz"), ("Hz", "mHz", "GHz"), 1e18),
    "m": Kind("a length", ("1.8 mm", "1 km"), ("m", "mm", "km"), 1e20),
    "m / s": Kind("a speed", ("10 m/s", "36 km/h"), ("m/s",), 1e15),
    "K": Kind("a temperature", ("150 mK", "270 K"), ("K", "mK", "uK"), 1e15),
    "K s(1/2)": Kind(
        "a noise level",
        ("1.7 mK s(1/2)", "400 uK s(1/2)"),
        ("mK s(1/2)", "uK s(1/2)", "K s(1/2)"),
        1e15,
    ),
    "": Kind("a pure number", ("0.3", "30 %"), ("",)),
}
"""Kinds of quantities by SI unit."""

PURE, ANGLE, TIME, LENGTH, TEMPERATURE = (
    (0, 0, 0, 0),
    (1, 0, 0, 0),
    (0, 1, 0, 0),
    (0, 0, 1, 0),
    (0, 0, 0, 1),
)
FREQUENCY = (0, -1, 0, 0)
DIMENSIONS: dict[tuple[float, ...], str] = {
    PURE: "a pure number",
    ANGLE: "angle",
    TIME: "time",
    FREQUENCY: "frequency",
    LENGTH: "length",
    TEMPERATURE: "temperature",
    (1, -1, 0, 0): "angular speed",
    (1, -2, 0, 0): "angular acceleration",
    (1, -3, 0, 0): "angular jerk",
    (0, -1, 1, 0): "speed",
    (0, -2, 1, 0): "acceleration",
    (0, 0.5, 0, 1): "noise level",
}
"""Names of dimensions, which are the powers of (rad, s, m, K)."""

PREFIXES = {
    "": 1.0, "k": 1e3, "M": 1e6, "G": 1e9, "T": 1e12,
    "c": 1e-2, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "n": 1e-9,
}  # fmt: skip
_NAMED: list[tuple[str, float, tuple[int, ...]]] = [
    ("deg degree °", math.pi / 180, ANGLE),
    ("arcmin arcminute", math.pi / 10800, ANGLE),
    ("arcsec arcsecond", math.pi / 648000, ANGLE),
    ("mas", math.pi / 648000000, ANGLE),
    ("second", 1.0, TIME),
    ("min minute", 60.0, TIME),
    ("h hr hour", 3600.0, TIME),
    ("d day", 86400.0, TIME),
    ("hertz", 1.0, FREQUENCY),
    ("meter", 1.0, LENGTH),
    ("Kelvin", 1.0, TEMPERATURE),
    ("% percent", 0.01, PURE),
]
_PREFIXED = {"rad": ANGLE, "s": TIME, "Hz": FREQUENCY, "m": LENGTH, "K": TEMPERATURE}
UNITS = {name: (factor, powers) for names, factor, powers in _NAMED for name in names.split()} | {
    prefix + base: (factor, powers)
    for base, powers in _PREFIXED.items()
    for prefix, factor in PREFIXES.items()
}
"""Factor to SI and powers of (rad, s, m, K) of the units known without astropy."""

_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*$", re.DOTALL)
_FACTOR = re.compile(
    r"(?:sqrt\((?P<root>[^\W\d_]+)\)|(?P<name>[^\W\d_]+|%|°)"
    r"(?:(?:\^|\*\*)?(?:(?P<power>-?\d(?:\.\d{1,9})?)(?!\d)"
    r"|\((?P<top>-?\d)(?:/(?P<bottom>[1-9]))?\)))?)(?:\s*[*. ]\s*|$)"
)
# powers of one digit: no unit here overflows by them


class Measure(NamedTuple):
    """A unit: its factor to SI and its powers of (rad, s, m, K)."""

    factor: float
    powers: tuple[float, ...]


@lru_cache(maxsize=512)
def read_unit(text: str) -> Measure | None:
    """A product of powers of the units above with at most one ``/ factor`` behind it, e.g. ``mK
    s(1/2)``, ``deg / s2``.

    None where the text is anything else: astropy may know it.
    """
    upper, slash, lower = (
        text.strip().partition("/")
        if not re.search(r"\(-?\d+/\d+\)", text)
        else (text.strip(), "", "")
    )
    factor, powers = 1.0, [0.0] * 4
    for part, sign in ((upper.strip(), 1), (lower.strip(), -1)):
        factors = list(_factors(part))
        if (factors and factors[-1] is None) or (slash and sign < 0 and len(factors) != 1):
            return None
        for known in factors:
            assert known is not None
            (size, dimension), power = known
            # division, not a negative power: 36 km/h is then 10 m/s to the last bit
            factor = factor * size**power if sign > 0 else factor / size**power
            powers = [p + sign * power * d for p, d in zip(powers, dimension, strict=True)]
    return Measure(factor, tuple(powers))


def _factors(text: str) -> Iterator[tuple[tuple[float, tuple[int, ...]], float] | None]:
    """((factor, powers of the base units), exponent) of each factor of a product; None where one is
    not known.
    """
    at = 0
    while at < len(text):
        match = _FACTOR.match(text, at)
        name = match and (match["root"] or match["name"])
        if not match or name not in UNITS:
            yield None
            return
        exponent = (
            0.5
            if match["root"]
            else float(match["power"] or match["top"] or 1) / int(match["bottom"] or 1)
        )
        yield UNITS[name], exponent
        at = match.end()


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
        elif (
            isinstance(value, bool)
            or value is None
            or not (isinstance(value, Real) or hasattr(value, "to_value"))
        ):
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
        texts = [
            _shortest(value, name, Measure(1.0, ()) if name == "" else read_unit(name))
            for name in self.kind.display
        ]
        return min(
            (t for t in texts if t),
            key=lambda t: len(t.split(" ")[0]),
            default=f"{value!r} {self.unit}".strip(),
        )

    def write_in_unit_of(self, value: float, like: str) -> str:
        """``value`` (SI) in the unit that the text ``like`` uses, for messages about limits."""
        match = _NUMBER.match(like)
        measure = read_unit(match[2]) if match and match[2] else None
        return (
            f"{value / measure.factor:.6g} {match[2]}" if match and measure else self.write(value)
        )

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
        if self.unit == "K s(1/2)" and "Hz" in unit:
            message = (
                f"'{unit}' may mean two things that differ by sqrt(2); write {self.kind.noun} in K"
                " s(1/2)"
            )
            raise mistake(message, "divide a NET per root hertz by sqrt(2)", caret=caret)
        measure, own = read_unit(unit), read_unit(self.unit)
        if measure is None or own is None:
            return self._factor_by_astropy(text, unit, caret)
        if measure.powers != own.powers:
            raise self._wrong_kind(unit, DIMENSIONS.get(measure.powers, "another kind"), caret)
        return measure.factor / own.factor

    def _factor_by_astropy(self, text: str, unit: str, caret: tuple[int, int]) -> float:
        import astropy.units as u

        try:
            parsed = u.Unit(unit)
            if isinstance(parsed, u.StructuredUnit):  # "m, s"
                raise ValueError("several units")
            parsed.decompose()
        except (
            ValueError,
            TypeError,
            OverflowError,
        ) as err:  # the last: km400, by an astropy before 7
            hint = re.search(r"Did you mean ([^?]*)\?", str(err))
            otherwise = (
                f"did you mean {hint[1]}?"
                if hint
                else f"expected {self.kind.noun}, e.g. '{self.example}'"
            )
            own = read_unit(self.unit)
            label = nearest(
                unit,
                (name for name, (_, powers) in UNITS.items() if own and powers == own.powers),
                otherwise,
            )
            raise mistake(f"unknown unit '{unit}' in {text!r:.60}", label, caret=caret) from None
        try:
            return float(parsed.to(u.Unit(self.unit)))
        except u.UnitConversionError:
            raise self._wrong_kind(unit, str(parsed.physical_type).split("/")[0], caret) from None

    def _from_astropy(self, value: Any) -> float:
        import astropy.units as u

        if getattr(value, "shape", ()) != ():
            raise mistake(f"expected one value, got an array of shape {value.shape}")
        if self.unit == "K s(1/2)" and "Hz" in str(value.unit):
            return self._factor(str(value), str(value.unit), (0, 0))  # raises
        try:
            return float(value.to_value(u.Unit(self.unit)))
        except u.UnitConversionError:
            raise self._wrong_kind(
                str(value.unit), str(value.unit.physical_type).split("/")[0], None
            ) from None

    def _without_unit(self, number: str) -> PydanticCustomError:
        message = f"{number} has no unit; write {self.kind.noun} such as '{self.example}'"
        return mistake(message, f"add a unit, e.g. {number} {self.example.split(' ', 1)[1]}")

    def _wrong_kind(
        self, unit: str, got: str, caret: tuple[int, int] | None
    ) -> PydanticCustomError:
        message = (
            f"expected {self.kind.noun} such as '{self.example}', but '{unit}' is a unit of {got}"
        )
        return mistake(message, f"not {self.kind.noun}", caret=caret)

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        write = (lambda v: v) if self.unit == "" else self.write
        written = core_schema.plain_serializer_function_ser_schema(write, when_used="json")
        return core_schema.no_info_before_validator_function(
            self.parse, handler(source), serialization=written
        )

    def __get_pydantic_json_schema__(
        self, schema: Any, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        text = {
            "type": "string",
            "pattern": (
                r"^\s*[-+]?[0-9.]+([eE][-+]?[0-9]+)?" + (r"\s*\S.*$" if self.unit else r"\s*\S*$")
            ),
        }
        options = [text] if self.unit else [{"type": "number"}, text]
        return {"anyOf": options, "examples": list(self.kind.examples), "x-unit": self.unit}


def _shortest(value: float, name: str, measure: Measure | None) -> str | None:
    """``value`` (SI) in unit ``name``, where 15 digits or fewer read back to the same bits."""
    if measure is None:
        return None
    digits = f"{value / measure.factor:.15g}"
    return f"{digits} {name}".strip() if float(digits) * measure.factor == value else None


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
"""Hz."""
Metres = Annotated[float, Unit("m")]
"""m."""
MetresPerSecond = Annotated[float, Unit("m / s")]
"""m/s."""
Kelvin = Annotated[float, Unit("K")]
"""K."""
KelvinRootSecond = Annotated[float, Unit("K s(1/2)")]
"""K s^(1/2): the rms of one second of integration."""
Fraction = Annotated[float, Unit("")]
"""A pure number; per cent are understood."""
