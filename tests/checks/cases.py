"""All rows of the stability matrix. A test compares them with the matrix the project was given."""

from __future__ import annotations

from zonda.core.checks import Case
from zonda.plugins.checks.scenes import BLOCKS, DECADES, DISPATCH, PINK, TIME, TWICE

NEAR = Case(
    "structure function as r -> 0",
    "relative error <= 1e-13 for x from 1e-12 to 50, against mpmath",
)
FAR = Case(
    "r -> infinity, r0 -> infinity, r0 << cell, r0 >> strip",
    "finite; implied covariance within the stated error for r0/cell from 1e-1 to 1e6; a clear"
    " refusal beyond",
)
OVERLAP = Case(
    "beams that overlap almost completely (D = 100 m, detectors 0.2 m apart)",
    "implied difference structure function between neighbours within 1 % of analytic",
)
STRIP = Case(
    "strip 2 cells wide; 1e6 long; one detector; one sample",
    "as above, and no special-case crash",
)
WIND = Case(
    "zero wind; wind along, across, against the scan; stare",
    "a frozen field seen by a stare gives identical samples; rotating scan, wind and field together"
    " changes nothing",
)
OPAQUE = Case(
    "opacity to infinity (bands on 557 GHz, 183 GHz), 1/(zeta e^-tau)",
    "the sample or band is masked with a reason; logs/expm1; no inf or NaN in a map",
)
BAND = Case(
    "band average of e^-tau against e^-(band average of tau)",
    "transmission is integrated over the band, always",
)
WATER = Case(
    "PWV driven negative or past the table; humidity > 100 %",
    "positivity-preserving fluctuation; range errors name the limits and the sample",
)
SPHERE = Case(
    "zenith crossing; poles; RA 0/360; Dec +-90; azimuth wrap; elevation 5 deg",
    "against erfa/longdouble < 1e-9 rad; shifting RA by 360 deg moves nothing (bits where the value"
    " is exactly representable, else 1e-12 rad); bundled IERS table, no download, a warning outside"
    " its range",
)
DEAD = Case(
    "dead, constant, identical, NaN detectors in the common mode",
    "flagged and reported; modes removed <= rank - 1; never all signal silently",
)
PIXELS = Case(
    "empty pixels; NaN or inf in the input map; 1x1 map; map smaller than the scan; huge map",
    "NaN stays local and hits = 0; outside the map is a stated value; predicted memory before"
    " the run",
)
PARTIAL = Case(
    "one detector dead in one block only; a scan of zero length",
    "clear error or correct result",
)
LEVEL = Case(
    "noise whose level is known only from the load (background-limited, quoted at the detector)",
    "std(signal / NOISE) = 1 within its error for every reference and model; the plan's depth is"
    " the run's",
)
BANDS = Case(
    "two bands, two cameras, one seed",
    "atmosphere correlates > 0.999 (equal beams, or dishes of 6 m and more), noise 0 within its"
    " error",
)
MEAN = Case(
    "a step that multiplies a stream with tens of kelvin of mean",
    "the result is the same whether the mean stands beside the stream or in it",
)
SIZES = Case(
    "pixels of another size than at the reference point (CAR, CEA, MER at high declination), oblong"
    " pixels, HEALPix near the beam's size",
    "a delta pixel keeps its flux within 0.5 % at any sub-pixel offset, declination and projection",
)
EDGES = Case(
    "a band with steep edges or an oxygen line in it (66-118 GHz), one polarization",
    "NET within 1 % of the integral over the band's own spectrum, edge cells included",
)
SLOW = Case(
    "a detector slower than the sampling (one pole at 2 samples per FWHM)",
    "within 0.5 % of the exact response; same bits for any block",
)
RED = Case(
    "red noise steeper than 1/f below its lowest frequency",
    "variance within 10 % of the stated law for slopes 1 to 3",
)
AT_ONCE = Case(
    "several processes that compile or start at the same instant",
    "four at once, different types: right values, then and in later runs",
)

MATRIX = (
    NEAR,
    FAR,
    OVERLAP,
    STRIP,
    WIND,
    DECADES,
    OPAQUE,
    BAND,
    WATER,
    PINK,
    TIME,
    SPHERE,
    DEAD,
    PIXELS,
    BLOCKS,
    TWICE,
    PARTIAL,
    LEVEL,
    BANDS,
    MEAN,
    DISPATCH,
    SIZES,
    EDGES,
    SLOW,
    RED,
    AT_ONCE,
)
"""Every row, in order."""
