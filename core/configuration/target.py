"""Target of the telescope: a position in ICRS, Galactic or horizontal coordinates, written as text.

>>> Target.parse("05h00m00s +20d00m00s").icrs()    # doctest: +ELLIPSIS
(1.3089..., 0.3490...)
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

from pydantic import GetJsonSchemaHandler

from .diagnostics import TextValue, mistake

Frame = Literal["icrs", "galactic", "horizontal"]

_EXAMPLES = [
    "05h00m00s +20d00m00s",
    "13:47:30.6 -11:45:09",
    "75 deg 20 deg",
    "galactic 120.5 deg -30 deg",
    "az 180 deg el 60 deg",
]
_KEYS: dict[Frame, tuple[str, str]] = {
    "icrs": ("ra", "dec"),
    "galactic": ("l", "b"),
    "horizontal": ("az", "el"),
}

GALACTIC_TO_ICRS = (
    (-0.05487565771259218, +0.49410943719272665, -0.8676661375596585),
    (-0.8734370519556162, -0.4448297212232957, -0.19807633727300056),
    (-0.4838350736167156, +0.7469821839866677, +0.45598381368730206),
)
"""IAU 1958 Galactic axes (columns) in ICRS, as astropy realizes them (pole 192.8595 deg +27.1283
deg in FK5 J2000).
"""

# one angle: sexagesimal (5h, 05h00m00s, +20d00m00s, 13:47:30.6) or a number with a unit (75 deg)
_ANGLE = (
    r"[-+]?\d+\s*(?:h|d|°|:)\s*\d+(?:\.\d*)?\s*(?:m|'|′|:)?"
    r"\s*(?:\d+(?:\.\d*)?\s*(?:s|\"|″)?)?(?![\w.])"
    r"|[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?\s*[A-Za-z°]*"
)
_PAIR = re.compile(
    rf"(?:(?P<frame>icrs|galactic|horizontal)\s*[:,]?\s*)?"
    rf"(?:(?P<key1>ra|az|l)\s*[=:]?\s*)?(?P<first>{_ANGLE})(?:\s*,\s*|\s+|(?=[-+]))"
    rf"(?:(?P<key2>dec|el|b)\s*[=:]?\s*)?(?P<second>{_ANGLE})",
    re.IGNORECASE,
)
_SEXAGESIMAL = re.compile(
    r"(?P<sign>[-+]?)(?P<whole>\d+)\s*(?P<mark>h|d|°|:)\s*"
    r"(?P<minutes>\d+(?:\.\d*)?)\s*(?P<mark2>m|'|′|:)?"
    r"\s*(?:(?P<seconds>\d+(?:\.\d*)?)\s*(?:s|\"|″)?)?",
    re.IGNORECASE,
)
_SPACED = re.compile(
    r"(\d{1,2}) +(\d{1,2}) +(\d{1,2}(?:\.\d*)?)[ ,]+([-+]?\d{1,2}) +(\d{1,2}) +(\d{1,2}(?:\.\d*)?)"
)
"""05 00 00 +20 00 00, as catalogues write it."""
_EQUINOX = re.compile(r"\(?\b(?:J2000(?:\.0)?|FK5|B1950(?:\.0)?|FK4)\)?", re.IGNORECASE)
_DECIMAL = re.compile(r"(?P<number>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(?P<unit>.*)")
_DEGREES = {
    **dict.fromkeys(("deg", "degree", "degrees", "d", "°"), 1.0),
    **dict.fromkeys(("h", "hour", "hours", "hourangle"), 15.0),
    "arcmin": 1 / 60,
    "arcsec": 1 / 3600,
}


@dataclass(frozen=True, repr=False)
class Target(TextValue):
    """A point of the sky.

    Attributes
    ----------
    frame
        ``icrs``, ``galactic`` (both fixed on the sky) or ``horizontal`` (fixed to the ground).
    longitude
        Right ascension, Galactic longitude, or azimuth (north through east), in [0, 2 pi) rad.
    latitude
        Declination, Galactic latitude, or elevation, rad.
    """

    frame: Frame
    longitude: float
    latitude: float

    @classmethod
    def parse(cls, value: Any) -> Target:
        """From text, a mapping {ra, dec}, {l, b} or {az, el} of angles with units, a pair of angles
        (ICRS), SkyCoord or Target.

        A SkyCoord in AltAz is a horizontal target: of its time and place nothing is used.

        Text: two angles, sexagesimal (h for hours; colons or spaces mean hours for a right
        ascension and degrees elsewhere) or with a unit; the frame's name or the coordinates' names
        may stand before them; ICRS where neither does."""
        if isinstance(value, Target):
            return value
        if isinstance(value, str):
            return cls._from_text(value)
        if isinstance(value, Mapping):
            return cls._from_mapping(value)
        if isinstance(value, list | tuple) and len(value) == 2:
            return cls._of("icrs", *value)
        if getattr(getattr(value, "frame", None), "name", "") == "altaz" and getattr(
            value,
            "isscalar",
            False,
        ):
            return cls("horizontal", float(value.az.rad) % (2 * math.pi), float(value.alt.rad))
        if hasattr(getattr(value, "icrs", None), "ra") and getattr(
            value,
            "isscalar",
            False,
        ):  # a SkyCoord
            return cls("icrs", float(value.icrs.ra.rad) % (2 * math.pi), float(value.icrs.dec.rad))
        raise mistake(f"expected a position such as '{_EXAMPLES[0]}', got {value!r}")

    @classmethod
    def _from_text(cls, text: str) -> Target:
        plain = text.replace("\N{MINUS SIGN}", "-").strip()
        if spaced := _SPACED.fullmatch(plain):
            h, m, s, *dec = spaced.groups()
            return cls._of("icrs", f"{h}:{m}:{s}", ":".join(dec))
        match = _PAIR.fullmatch(plain)
        if match is None and text.strip().lower() == "map":
            raise mistake(
                "'map', the centre of the input map, is for the target at the top level of a"
                " pipeline file"
            )
        if match is None and (
            _SEXAGESIMAL.fullmatch(plain) or (_DECIMAL.fullmatch(plain) and plain[-1:].isalpha())
        ):
            wanted = (
                "a position needs two, a right ascension and a declination, such as"
                f" '{_EXAMPLES[0]}'"
            )
            raise mistake(f"{text!r} is one angle; {wanted}", "one angle is missing")
        if match is None and (equinox := _EQUINOX.search(plain)):
            word = equinox[0].strip()
            label = f"leave '{word}' out" + ("" if "2000" in word else "; precess it")
            raise mistake(
                f"positions are ICRS (FK5 J2000 to 0.1 arcsec); '{word}' is not read",
                label,
            )
        if match is None:
            cure = f"write two angles such as '{_EXAMPLES[0]}' (names of objects are not looked up)"
            raise mistake(
                f"cannot read {text!r} as a position; {cure}",
                f"e.g. {' | '.join(_EXAMPLES)}",
            )
        keys = tuple((match[k] or "").lower() for k in ("key1", "key2"))
        named = match["frame"].lower() if match["frame"] else None
        frame: Frame = next((f for f in _KEYS if f == named), "icrs")
        if any(keys):
            by_key = [f for f, pair in _KEYS.items() if pair == keys]
            if not by_key or (named and named != by_key[0]):
                raise mistake(
                    f"the coordinate names in {text!r} do not belong together; use ra dec, l b, or"
                    " az el"
                )
            frame = by_key[0]
        return cls._of(frame, match["first"], match["second"])

    @classmethod
    def _from_mapping(cls, value: Mapping[Any, Any]) -> Target:
        for frame, pair in _KEYS.items():
            if set(value) == set(pair):
                return cls._of(frame, value[pair[0]], value[pair[1]])
        given = ", ".join(map(str, value)) or "none"
        raise mistake(
            f"a position needs exactly the keys ra and dec, l and b, or az and el, not {given}"
        )

    @classmethod
    def _of(cls, frame: Frame, first: Any, second: Any) -> Target:
        names = _KEYS[frame]
        longitude = radians(first, names[0], hours=frame == "icrs", wrap=True)
        latitude = radians(second, names[1], hours=False)
        if not abs(latitude) <= math.pi / 2:
            raise mistake(f"{names[1]} must lie between -90 deg and 90 deg, got {second}")
        return cls(frame, longitude, latitude)

    def icrs(self) -> tuple[float, float]:
        """(ra, dec) rad. Raises ValueError for a horizontal target, which has none without a time
        and a site.
        """
        if self.frame == "horizontal":
            raise ValueError("a horizontal target has no fixed ICRS position")
        if self.frame == "icrs":
            return self.longitude, self.latitude
        c = math.cos(self.latitude)
        galactic = (
            c * math.cos(self.longitude),
            c * math.sin(self.longitude),
            math.sin(self.latitude),
        )
        x, y, z = (
            sum(m * g for m, g in zip(row, galactic, strict=True)) for row in GALACTIC_TO_ICRS
        )
        return math.atan2(y, x) % (2 * math.pi), math.atan2(z, math.hypot(x, y))

    def __str__(self) -> str:
        """Text that parses back to the same bits."""
        lon = _text(self.longitude, wrap=True)
        lat = _text(self.latitude)
        if self.frame == "horizontal":
            return f"az {lon} el {lat}"
        return f"{self.frame} {lon} {lat}"

    def __repr__(self) -> str:
        return f"Target.parse({str(self)!r})"

    @classmethod
    def __get_pydantic_json_schema__(
        cls,
        schema: Any,
        handler: GetJsonSchemaHandler,
    ) -> dict[str, Any]:
        pairs = [
            {
                "type": "object",
                "properties": {k: {"type": "string"} for k in pair},
                "required": list(pair),
                "additionalProperties": False,
            }
            for pair in _KEYS.values()
        ]
        pair = {"type": "array", "items": {"type": "string"}, "minItems": 2, "maxItems": 2}
        return {"anyOf": [{"type": "string"}, *pairs, pair], "examples": _EXAMPLES}


@runtime_checkable
class WithMap(Protocol):
    """A step with a map of the sky, whose centre ``target: map`` stands for."""

    def map_centre(self) -> Target:
        """The middle of the map. Raises InputError where it has none of its own."""
        ...


def radians(value: Any, name: str, *, hours: bool, wrap: bool = False) -> float:
    """One angle in rad; ``hours``: colons count hours; ``wrap``: reduced to [0, 2 pi), exactly
    where it is in degrees.
    """
    number, unit = _read(value, name, hours=hours)
    if unit == "rad":
        return number % (2 * math.pi) if wrap else number
    return math.radians(number % 360.0 if wrap else number)


def _read(value: Any, name: str, *, hours: bool) -> tuple[float, Literal["rad", "deg"]]:
    if hasattr(value, "to_value"):  # an astropy Quantity or Angle
        return float(value.to_value("deg")), "deg"
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise mistake(f"{name} must be an angle such as '75 deg', got {value!r}")
    text = str(value).replace("\N{MINUS SIGN}", "-").strip()
    given = f"{name} {(value.strip() if isinstance(value, str) else value)!r}"
    if match := _SEXAGESIMAL.fullmatch(text):
        return _sexagesimal(match, name, hours=hours), "deg"
    match = _DECIMAL.fullmatch(text)
    if match is None:
        raise mistake(f"cannot read {given}; write an angle such as '75 deg'")
    number = float(match["number"])
    unit = match["unit"].strip().lower()
    if not unit:
        raise mistake(
            f"{given} has no unit; write an angle such as '{text} deg'",
            f"add a unit, e.g. {text} deg",
        )
    if not math.isfinite(number):
        raise mistake(f"{name} must be finite, got {value!r}")
    if unit in ("rad", "radian", "radians"):
        return number, "rad"
    if unit not in _DEGREES:
        raise mistake(
            f"unknown unit '{unit}' in {given}; use deg, hourangle, arcmin, arcsec or rad"
        )
    return number * _DEGREES[unit], "deg"


def _sexagesimal(match: re.Match[str], name: str, *, hours: bool) -> float:
    colons = match["mark"] == ":"
    given = f"{name} {match[0]!r}"
    if colons and match["mark2"] not in (":", None):
        raise mistake(f"cannot read {given}; do not mix colons and letters")
    minutes = float(match["minutes"])
    seconds = float(match["seconds"] or 0)
    if minutes >= 60 or seconds >= 60:
        raise mistake(f"minutes and seconds of {given} must be below 60")
    whole = float(match["whole"])
    if (match["mark"].lower() == "h" or (colons and hours)) and whole >= 24:
        raise mistake(f"the hours of {given} must be below 24")
    if not whole < 1e6:
        raise mistake(f"the degrees of {given:.60} must be below 1e6")
    magnitude = whole + (minutes + seconds / 60) / 60
    unit = 15.0 if match["mark"].lower() == "h" or (colons and hours) else 1.0
    return (-magnitude if match["sign"] == "-" else magnitude) * unit


def _text(angle: float, *, wrap: bool = False) -> str:
    """The shortest text in degrees that parses back to ``angle``; in radians where no number of
    degrees does.
    """
    degrees = math.degrees(angle)
    for digits in range(1, 18):
        text = f"{degrees:.{digits}g}"
        if "e" not in text and math.radians(float(text) % 360.0 if wrap else float(text)) == angle:
            return f"{text} deg"
    return f"{angle!r} rad"
