"""Share of each angular scale of the sky that the filters leave.

a is the map of the sky alone, binned without any filter; b the map of the sky alone through all
filters; both of the same samples and pixels, so that beam, pixels and coverage are in both and only
the filters tell them apart. With a window w and the Fourier transforms a_k, b_k of w (m - <m>_w),
and rings i of wavenumbers k,

    T_i = Re sum_i b_k a_k^* / sum_i |a_k|^2,   (1)
    S_i = sqrt( sum_i |b_k|^2 / sum_i |a_k|^2 ) >= |T_i|.                                        (2)

T is the share that is left, in phase; S is the definition of van Marrewijk, Morris et al. (2024),
which also counts what the filters bring from other scales and places. The standard error of T is
that from the scatter of the modes of the ring, the sky being one of many with its spectrum (the
maps have no noise):

    sigma_i^2 = N / (N - 1) 2 c sum_i (Re (b_k - T_i a_k) a_k^*)^2 / (sum_i |a_k|^2)^2,
    N = n_i / (2 c),   (3)

n_i modes, each in the ring twice since maps are real, c = n_pixels sum w^4 / (sum w^2)^2 for the
correlation of neighbours through the window.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from zonda.core.configuration.units import Angle
from zonda.core.data import Data
from zonda.core.errors import PipelineError
from zonda.core.maps.map_product import MapProduct
from zonda.core.numerics.sphere import ARCSEC, FWHM_PER_SIGMA
from zonda.core.output import Output, publish
from zonda.core.signal import Signal, product_name, stream_of
from zonda.core.storage.table_files import Column
from zonda.core.tables import html_table
from zonda.core.types import Floats

from .comparison.radial import Rings, correlation, scale_of, tapered
from .series import check_map, key_of, kinds_of_maps, plane_key

NOT_TAN = "a transfer function needs a TAN map of the signal"
CURE = "leave nside, projection and contents of the map out"

NO_POWER = 1e-12
"""Share of the largest ring's power per mode below which a ring holds nothing but rounding."""


class TransferFunction(Output):
    """Transfer function of the filters: the share of the sky that they leave in the map at each
    angular scale.

    The map of the sky alone is compared with the same map binned without filters: the ratio of
    their cross spectrum to the spectrum of the latter, in rings of equal width in the logarithm of
    the scale. The two signals are made for this step, unless `runs` has them. Makes the product
    ``transfer_function`` (a `Transfer`), or one under this step's own name where it has one; where
    there is an output folder, it is written there as a table (ECSV). Of a map of I, Q and U each
    plane has its own: ``transfer_function_Q`` and ``transfer_function_U`` stand beside
    ``transfer_function``, which is of I.
    """

    requires = frozenset({"map"})
    provides = frozenset({"transfer_function"})
    one_band = True

    modes: Literal["sky", "full"] = "sky"
    """Singular modes of the sky alone (`sky`: the paper's noiseless map), or of the complete data,
    applied to it (`full`).
    """
    bins: int = Field(12, ge=1, le=500)
    """Number of rings, of equal width in the logarithm of the scale."""
    largest: Angle | None = Field(None, gt=0)
    """Largest angular scale, 1/k; where absent, the diameter of the disc with the window's area."""
    smallest: Angle | None = Field(None, gt=0, examples=["9 arcsec"])
    """Smallest angular scale; where absent, the beam's FWHM, or two pixels."""
    radius: Angle | None = Field(None, gt=0)
    """Use only what lies this near to the map's centre."""
    taper: Angle | None = Field(None, gt=0)
    """Width of the window's cosine edge; where absent, it reaches to the middle."""
    least_coverage: float = Field(0.1, ge=0, lt=1)
    """Where the (beam-smoothed) samples per pixel are below this share of their 99th percentile,
    the window is zero.
    """
    map: str = Field("map", pattern=r"^[A-Za-z0-9_]+$")
    """Which map, by its name among the products."""

    @model_validator(mode="after")
    def _ordered(self) -> TransferFunction:
        if self.largest is not None and self.smallest is not None and self.largest <= self.smallest:
            raise ValueError("largest must be larger than smallest")
        return self

    def signals(self) -> tuple[Signal, ...]:
        """The sky alone through the filters, and without them."""
        modes: Literal["own", "full"] = "full" if self.modes == "full" else "own"
        return Signal(only=["sky"], modes=modes), Signal(only=["sky"], modes=modes, filters="none")

    def check(self, data: Data) -> list[str]:
        """Raises PipelineError where the map that will be made cannot be compared."""
        check_map(data, self.map, self.label)
        if kinds_of_maps(data).get(self.map, "TAN") != "TAN":
            raise PipelineError(NOT_TAN, place=self.label, cure=CURE)
        return []

    def finalize(self, data: Data) -> None:
        """Compare the two maps. Raises PipelineError where there is none, or none that can be
        compared.
        """
        after, before = (self._map(data, signal) for signal in self.shown)
        window = window_of(before, self.radius, self.taper, self.least_coverage)
        edges = self._edges(before, window)
        data.log.state(self.label, "window", f"{np.count_nonzero(window)} pixels")
        if self.modes == "full":
            alone = "" if self.shown[0] else ", which are the sky alone"
            data.log.state(self.label, "singular modes", f"of the complete data{alone}")
        both = zip(before.by_stokes().items(), after.by_stokes().values(), strict=True)
        for (plane, a), b in both:
            rings = compare(a.signal, b.signal, window, a.pixel, edges)
            empty = int(np.count_nonzero(~np.isfinite(rings.transfer)))
            what = "" if plane == "I" else f"{plane}: "
            data.log.count(self.label, f"{what}rings without modes or power: NaN", empty)
            key = plane_key(key_of(self, "transfer_function"), plane)
            of = plane_key(self.map, plane)
            found = Transfer(rings, edges, self.modes, before.fwhm, self.label, of)
            command = data.provenance.get("command")
            publish(data, key, found, {"": found.columns()}, COMMAND=command, **found.meta)

    def _map(self, data: Data, signal: str) -> MapProduct:
        product: Any = data.products.get(product_name(stream_of(signal), self.map))
        if self.map not in data.products:
            cure = "set map to the product of the step that makes it, or that step's product to map"
            raise PipelineError(f"there is no map {self.map!r}", place=self.label, cure=cure)
        of_signal = isinstance(product, MapProduct) and product.contents != "hits"
        if not of_signal or product.projection != "TAN":
            raise PipelineError(NOT_TAN, place=self.label, cure=CURE)
        return product  # type: ignore[no-any-return]

    def _edges(self, before: MapProduct, window: Floats) -> Floats:
        """(bins + 1,) wavenumbers between the rings, rad^-1."""
        if not window.any():
            what = "no pixel is left in the window"
            cure = "choose a larger radius"
            raise PipelineError(what, place=self.label, cure=cure)
        smallest = self.smallest or max(before.fwhm, 2 * before.pixel)
        largest = self.largest or 2 * before.pixel * math.sqrt(np.count_nonzero(window) / math.pi)
        if largest <= smallest:
            low = smallest / ARCSEC
            high = largest / ARCSEC
            what = f"scales from {high:.3g} to {low:.3g} arcsec are none"
            cure = "set largest and smallest, or map a larger field"
            raise PipelineError(what, place=self.label, cure=cure)
        return np.geomspace(1 / largest, 1 / smallest, self.bins + 1)


@dataclass(frozen=True)
class Found:
    """Equations (1) to (3), (n,) each: NaN where a ring has no modes or no power.

    Attributes
    ----------
    wavenumber
        Mean of k over the ring's modes, rad^-1.
    transfer, error, amplitude
        T, sigma and S; sigma is NaN where there are not two independent modes.
    power
        sum |a_k|^2.
    modes
        Independent modes N.
    """

    wavenumber: Floats
    transfer: Floats
    error: Floats
    amplitude: Floats
    power: Floats
    modes: Floats


def compare(before: Floats, after: Floats, window: Floats, pixel: float, edges: Floats) -> Found:
    """Equations (1) to (3) of two maps (ny, nx) of pixels of side ``pixel`` [rad]; NaN counts as
    nothing.

    Parameters
    ----------
    before, after
        a and b; pixels that are NaN in one of them are left out of both.
    window
        (ny, nx).
    edges
        (n + 1,) wavenumbers between the rings, rad^-1, ascending.
    """
    rings = Rings((before, after), window, pixel, edges)
    a, b = (rings.transform(m) for m in (before, after))
    power = rings.sum(abs(a) ** 2)
    modes = rings.number / 2 / (c := correlation(rings.window))
    with np.errstate(invalid="ignore", divide="ignore"):
        transfer = rings.sum((b * a.conj()).real) / power
        amplitude = np.sqrt(rings.sum(abs(b) ** 2) / power)
        rest = (b - np.append(transfer, 0.0)[rings.ring].reshape(a.shape) * a) * a.conj()
        error = np.sqrt(modes / (modes - 1) * 2 * c * rings.sum(rest.real**2)) / power
        error[modes < 2] = np.nan
        each = power / modes
        for values in (transfer, error, amplitude):
            values[~(each > NO_POWER * np.nanmax(each, initial=0.0))] = np.nan
    return Found(rings.mean_wavenumber(), transfer, error, amplitude, power, modes)


def window_of(
    product: MapProduct,
    radius: float | None = None,
    taper: float | None = None,
    least: float = 0.1,
) -> Floats:
    """`comparison.radial.tapered`, (ny, nx).

    Inside are pixels with at least ``least`` of the 99th percentile of the beam-smoothed samples,
    holes filled, within ``radius`` [rad] of the centre.
    """
    from scipy.ndimage import binary_fill_holes, gaussian_filter

    seen = product.known
    sigma = product.fwhm / FWHM_PER_SIGMA / product.pixel
    hits = gaussian_filter(product.known_hits.astype(np.float64), sigma, mode="constant")
    usual = float(np.percentile(hits[seen], 99)) if seen.any() else np.inf
    inside = hits >= max(least * usual, 1e-9)
    inside = binary_fill_holes(inside)
    if radius is not None:
        inside &= product.distance() <= radius
    return tapered(np.asarray(inside, np.bool_), product.pixel, taper)


@dataclass(frozen=True)
class Transfer:
    """A transfer function.

    Attributes
    ----------
    rings
        What was found.
    edges
        (n + 1,) wavenumbers between the rings, rad^-1.
    modes
        ``sky`` or ``full``: whose singular modes the filters took out.
    fwhm
        The beam's, rad.
    label, map
        Of the step, and of the map that it looked at.
    """

    rings: Found
    edges: Floats
    modes: str
    fwhm: float
    label: str
    map: str

    @property
    def scale(self) -> Floats:
        """(n,) angular scales 1/k, rad; in a ring without modes its middle."""
        return scale_of(self.rings.wavenumber, self.edges)

    @property
    def kilolambda(self) -> Floats:
        """(n,) the same as lengths of baselines in 1000 wavelengths."""
        return 1e-3 / self.scale

    @property
    def meta(self) -> dict[str, str]:
        """Cards of the table."""
        return {"MODES": self.modes, "MAP": self.map, "BEAM": f"{self.fwhm / ARCSEC:.6g} arcsec"}

    def columns(self) -> list[Column]:
        """The table, largest scale first."""
        r = self.rings
        share = "Re sum b a* / sum |a|^2: share that the filters leave, in phase"
        error = "standard error of transfer from the scatter of the ring's modes"
        return [
            Column("scale", self.scale / ARCSEC, "arcsec", "1 / mean wavenumber of the ring"),
            Column("scale_largest", 1 / self.edges[:-1] / ARCSEC, "arcsec", "edge of the ring"),
            Column("scale_smallest", 1 / self.edges[1:] / ARCSEC, "arcsec", "edge of the ring"),
            Column("kilolambda", self.kilolambda, "", "wavenumber, 1000 wavelengths"),
            Column("transfer", r.transfer, "", share),
            Column("error", r.error, "", error),
            Column("amplitude", r.amplitude, "", "sqrt(sum |b|^2 / sum |a|^2)"),
            Column("modes", r.modes, "", "independent modes"),
        ]

    def _repr_html_(self) -> str:
        r = self.rings
        rows = [
            (f"{s / ARCSEC:.3g} arcsec", f"{t:.3f} +- {e:.3f}")
            for s, t, e in zip(self.scale, r.transfer, r.error, strict=True)
        ]
        return html_table(f"Transfer function, modes: {self.modes}", rows)
