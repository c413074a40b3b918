"""Planes of a map: the quantities in its pixels, their units, and their scaling with the map; its
noise: the circle in which it is stated, its size in units of the white noise, and words for it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Generic, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..numerics.sphere import ARCMIN
from ..types import Floats, Integers

ACROSS = 5.0
"""Beams and pixels across the circle, at least: an rms of fewer beams is known to no better than a
quarter.
"""


def central_diameter(fwhm: float, pixel: float, given: float | None = None) -> float:
    """``given``; where that is None 1 arcmin, or `ACROSS` beams or pixels where these are wider.
    All in rad.
    """
    return max(ARCMIN, ACROSS * fwhm, ACROSS * pixel) if given is None else given


def in_beams(diameter: float, fwhm: float) -> str:
    """`` (6.7 beams)``, what a circle is wide; empty where the beam is not known."""
    return f" ({diameter / fwhm:.2g} beams)" if fwhm > 0 else ""


LEAST = 0.1
"""Share of the 99th percentile of the weight (1 / noise^2) that a pixel needs for its noise to be
measured.
"""
ELSEWHERE = "that of the complete map, none in this one"
"""Said of the noise of a signal without noise (`Signal.is_quiet`): it is that of the complete map.
"""
WHITE = "white noise only"
"""Said of noise that is the standard error of independent pixels, where no map of the noise alone
is known.
"""


def noise_factor(noise: Floats, alone: Floats) -> float | None:
    """The rms of ``alone`` / ``noise`` over pixels with at least `LEAST` of the usual weight: what
    white noise is to be multiplied by, so that noise that is correlated between pixels (1/f noise,
    the atmosphere) counts in full. None where it cannot be measured."""
    with np.errstate(invalid="ignore", divide="ignore"):
        weight = noise**-2.0
        ratio = alone / noise
    known = np.isfinite(ratio) & np.isfinite(weight)
    if not known.any():
        return None
    well = known & (weight >= LEAST * np.percentile(weight[known], 99))
    factor = float(np.sqrt(np.mean(ratio[well] ** 2)))
    return factor if factor > 0 else None


def stated(noise: Floats, alone: tuple[Floats, str] | None) -> tuple[float | None, str]:
    """`noise_factor`, and what it was measured in; None and `WHITE` where it is not known.
    ``alone``: the map and its name.
    """
    factor = None if alone is None else noise_factor(noise, alone[0])
    return (None, WHITE) if alone is None or factor is None else (factor, alone[1])


@dataclass
class ScanHits:
    """Pixels that each scan hit, and how often: a plane of hits for each, kept without its zeros.

    Attributes
    ----------
    scans
        Names, in the order of the map's `MapArrays.scans`.
    pixels, hits
        Of each scan, int32: places in the flat arrays of the map, in rising order, and the samples
        there.
    """

    scans: list[str]
    pixels: list[NDArray[np.int32]] = field(default_factory=list)
    hits: list[NDArray[np.int32]] = field(default_factory=list)

    def plane(self, scan: str | int, shape: Sequence[int]) -> NDArray[np.int32]:
        """The hits of one scan in arrays of ``shape``. Raises InputError for one that is not there,
        or a name of several.
        """
        number = scan
        if isinstance(scan, str):
            if self.scans.count(scan) != 1:
                text = f"{self.scans.count(scan)} scans of the map are called {scan!r}"
                raise InputError(
                    text,
                    place="map.scan_hits",
                    cure=f"give its number, 0 to {len(self.scans) - 1}",
                )
            number = self.scans.index(scan)
        if not 0 <= int(number) < len(self.scans):
            text = f"the map has {len(self.scans)} scans, and no number {number}"
            raise InputError(text, place="map.scan_hits", cure=f"choose 0 to {len(self.scans) - 1}")
        found = np.zeros(int(np.prod(shape)), np.int32)
        found[self.pixels[int(number)]] = self.hits[int(number)]
        return found.reshape(shape)

    @property
    def table(self) -> dict[str, NDArray[np.int32]]:
        """Columns ``SCAN`` (its number), ``PIXEL`` and ``HITS``, a row for each pixel of each
        scan.
        """
        number = np.repeat(
            np.arange(len(self.scans), dtype=np.int32),
            [len(some) for some in self.pixels],
        )
        none = np.zeros(0, np.int32)
        return {
            "SCAN": number,
            "PIXEL": np.concatenate([none, *self.pixels]),
            "HITS": np.concatenate([none, *self.hits]),
        }


IQU = ("I", "Q", "U")
COVARIANCES = ("ii", "iq", "iu", "qq", "qu", "uu")
"""Rows of the plane ``covariance``."""


@dataclass(frozen=True)
class Plane:
    """One quantity in the pixels of a map.

    Files, pictures, units and sums of maps walk through the planes of a product and know none by
    its name: a step that adds a plane says here all that they need.

    Attributes
    ----------
    values
        (n, *shape of the map): one row, or several.
    names
        Each row that files have (FITS extension or column), and its meaning; rows beyond are in no
        file.
    scale
        Power of the brightness that the values have: 1 in the unit of the map, -2 an inverse
        variance, 0 a number without unit.
    unit
        Label of the colours in pictures; empty: the unit of the map.
    stokes
        Names as above of the three rows I, Q and U of a polarized map; None: the plane is no
        property of a Stokes parameter.
    joint
        The plane belongs to I, Q and U together, and goes where one of them is taken.
    smoothing
        Smoothed maps hold the weighted ``mean``, or the standard ``error`` of it; or the plane is
        ``kept``, or ``lost``.
    noise_of
        Stokes parameter whose noise a row holds, by the row's name: its header says what the noise
        was measured in.
    of_halves
        The plane is a difference of two halves of the samples, which its header names.
    colours
        Lowest and highest value of the picture that `Plots` makes of the plane (None: those of the
        plane); None: no picture.
    title, caption
        Of that picture.
    """

    values: Any
    names: Mapping[str, str]
    scale: int = 0
    unit: str = ""
    stokes: Mapping[str, str] | None = None
    joint: bool = False
    smoothing: Literal["mean", "error", "kept", "lost"] = "kept"
    noise_of: Mapping[str, str] = field(default_factory=dict)
    of_halves: bool = False
    colours: tuple[float | None, float | None] | None = None
    title: str = ""
    caption: str = ""

    @property
    def rows(self) -> Iterator[tuple[str, str, Any]]:
        """Name, meaning and values of each row that files have."""
        names = self.names if self.stokes is None or len(self.values) == 1 else self.stokes
        return ((*name, row) for name, row in zip(names.items(), self.values, strict=False))

    def row(self, k: int) -> Plane:
        """One row as a plane."""
        return replace(self, values=self.values[k : k + 1])

    def scaled(self, factor: float | Floats) -> Plane:
        """The plane in another unit, ``factor`` of which make one old unit (one or per pixel)."""
        if not self.scale:
            return self
        power = factor ** abs(self.scale)
        return replace(self, values=self.values * power if self.scale > 0 else self.values / power)

    def fits_unit(self, unit: str) -> str:
        """FITS unit of the plane in a map in ``unit``; empty for plain numbers."""
        if self.scale == 1:
            return unit
        return f"{unit if unit.isalpha() else f'({unit})'}{self.scale}" if self.scale else ""


NOTHING = np.zeros((0, 0))
TEMPLATE = "weights of this map as a template"
KNOWN = {
    "signal": Plane(
        NOTHING,
        {"signal": "brightness"},
        1,
        stokes={"i": "Stokes I", "q": "Stokes Q", "u": "Stokes U"},
        smoothing="mean",
    ),
    "hits": Plane(NOTHING, {"hits": "samples per pixel"}, unit="samples per pixel"),
    "weights": Plane(
        NOTHING,
        {"weights": "sum of weights"},
        unit="weight",
        stokes={"weights": "sum of weights"},
    ),
    "noise": Plane(
        NOTHING,
        {"noise": "standard error per pixel"},
        1,
        stokes={},
        smoothing="error",
        noise_of={"noise": "I"},
    ),
    "covariance": Plane(
        NOTHING,
        {f"cov_{ab}": f"covariance of {ab[0].upper()} and {ab[1].upper()}" for ab in COVARIANCES},
        2,
        joint=True,
        noise_of={"cov_ii": "I", "cov_qq": "Q", "cov_uu": "U"},
    ),
    "condition": Plane(
        NOTHING,
        {"condition": "condition number of the angles in a pixel"},
        unit="condition number",
        joint=True,
    ),
    "half_difference": Plane(
        NOTHING,
        {"half_difference": "noise from the difference of two halves"},
        1,
        stokes={
            "half_difference": "noise from the difference of two halves",
            "half_difference_q": "Q of the difference of two halves",
            "half_difference_u": "U of the difference of two halves",
        },
        smoothing="mean",
        of_halves=True,
    ),
    "template": Plane(
        NOTHING,
        {"template_weights": TEMPLATE},
        -1,
        stokes={f"template_weights{row}": TEMPLATE for row in ("", "_q", "_u")},
        joint=True,
        smoothing="lost",
    ),
}
"""Planes of every map, of polarized ones, of maps of two halves, and of templates (`matched` of
`noise_figures`), without values."""


T = TypeVar("T")


class Rows(Generic[T]):
    """An attribute that is one row, or some, of a plane of the object; None without the plane. Of a
    map one may be set: arrays as `MapArrays.hold` takes them.
    """

    def __init__(self, plane: str, rows: Any = 0) -> None:
        self._plane = plane
        self._rows = rows

    def __get__(self, owner: Any, kind: type) -> T:
        if owner is None:
            return self  # type: ignore[return-value]  # of the class, for documentation
        plane = owner.planes.get(self._plane)
        return None if plane is None else np.asarray(plane.values)[self._rows]  # type: ignore

    def __set__(self, owner: Any, values: Any) -> None:
        owner.hold(self._plane, values)


@dataclass(frozen=True)
class Polarization:
    """Q and U beside the I of a map: rows of its ``planes``, as arrays of the shape of the map.

    Attributes
    ----------
    q, u
        COSMO, from the meridians of the map's frame, in the unit of the map; NaN where the angles
        of the samples do not determine I, Q and U.
    covariance
        (6, ...) of (I, Q, U), `COVARIANCES`, unit^2. After smoothing, which takes I, Q and U one by
        one, only the variances are known, and the others NaN.
    weights
        (2, ...) of Q and of U: 1 / (A^-1)_QQ and 1 / (A^-1)_UU; those of the map are of I.
    condition
        Condition number of the samples' angles in each pixel, largest over smallest eigenvalue: 2
        at best, infinite where they do not determine I, Q and U; NaN where there are no samples.
    hits
        Samples in each pixel, also in those that are not solved.
    half_difference
        (2, ...) of Q and U, each with the variance of the map there; None: not made.
    """

    planes: Mapping[str, Plane]

    q = Rows[Floats]("signal", 1)
    u = Rows[Floats]("signal", 2)
    covariance = Rows[Floats]("covariance", slice(None))
    weights = Rows[Floats]("weights", slice(1, None))
    condition = Rows[Floats]("condition")
    hits = Rows[Integers]("hits")
    half_difference = Rows["Floats | None"]("half_difference", slice(1, None))
