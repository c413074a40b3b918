"""The table of detectors: where they look, how large their beams are, how noisy they are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from .errors import InputError
from .tables import html_table
from .types import Floats, Indices, Integers

DEFAULTS: dict[str, float] = {
    "polarization_angle": 0.0,
    "polarization_efficiency": 0.0,
    "band": 0,
    "wafer": 0,
    "knee": 0.0,
    "slope": 1.0,
    "minimum_frequency": 1e-3,
    "dead": 0,
}
"""Values of columns that are not given."""

WHOLE = ("band", "wafer", "dead")
"""Columns of whole numbers."""


@dataclass(repr=False)
class Focalplane:
    """Detectors of one instrument. Every array has shape (n_det,).

    Attributes
    ----------
    names
        Unique detector names.
    xi, eta
        Gnomonic tangent-plane offsets from the boresight [tan(rad)], xi towards increasing azimuth,
        eta towards increasing elevation. In TOAST's boresight frame the direction is proportional
        to (-eta, -xi, 1). Tangents: sotodlib's xi and eta are sines.
    polarization_angle
        rad, COSMO convention, from the focal plane's +X (TOAST) axis.
    polarization_efficiency
        0 (not polarized) to 1 (a perfect polarizer): TOAST's (1 - epsilon) / (1 + epsilon) with the
        cross-polar leakage epsilon.
    fwhm
        Main-beam full width at half maximum on the sky, rad.
    main_beam_efficiency
        zeta of the paper: the share of an astronomical signal that the main beam delivers.
    illumination_efficiency
        epsilon of the paper: the share of the atmosphere's emission that reaches the detector.
    net
        Noise-equivalent temperature on the sky, K_RJ sqrt(s): the rms of one second of integration.
    band
        Whole numbers: which of the instrument's `bands` each detector observes in; 0 where there is
        one.
    wafer
        Whole numbers: which part of the focal plane each detector is on.
    knee, slope, minimum_frequency
        Pink noise: frequency at which it equals white noise of ``net`` [Hz], exponent of the fall
        f^-slope, frequency below which it is flat [Hz]. The knee is 0 where there is none.
    dead
        1 for a detector that gives no data, else 0: an observation begins with it flagged.
    """

    names: list[str]
    xi: Floats
    eta: Floats
    fwhm: Floats
    main_beam_efficiency: Floats
    illumination_efficiency: Floats
    net: Floats
    polarization_angle: Floats = field(default_factory=lambda: np.zeros(0))
    polarization_efficiency: Floats = field(default_factory=lambda: np.zeros(0))
    band: Integers = field(default_factory=lambda: np.zeros(0, np.int64))
    wafer: Integers = field(default_factory=lambda: np.zeros(0, np.int64))
    knee: Floats = field(default_factory=lambda: np.zeros(0))
    slope: Floats = field(default_factory=lambda: np.zeros(0))
    minimum_frequency: Floats = field(default_factory=lambda: np.zeros(0))
    dead: Integers = field(default_factory=lambda: np.zeros(0, np.int64))

    def __post_init__(self) -> None:
        n = len(self.names)
        for name, default in DEFAULTS.items():
            if not getattr(self, name).size:
                setattr(self, name, np.full(n, default))
        if len(set(self.names)) != n:
            twice = sorted({d for d in self.names if self.names.count(d) > 1})
            raise InputError(
                f"detector names must be unique; {twice[0]!r} is there twice",
                place="focal plane",
            )
        for f in fields(self):
            value: Any = getattr(self, f.name)
            if len(value) != n:
                raise InputError(
                    f"{f.name} has {len(value)} entries for {n} detectors",
                    place="focal plane",
                )
            if isinstance(value, np.ndarray):
                setattr(
                    self,
                    f.name,
                    np.asarray(value, np.int64 if f.name in WHOLE else np.float64),
                )
                if not np.isfinite(value).all():
                    bad = self.names[int(np.flatnonzero(~np.isfinite(value))[0])]
                    raise InputError(
                        f"{f.name} of detector {bad} is not finite",
                        place="focal plane",
                    )
        outside = (self.polarization_efficiency < 0) | (self.polarization_efficiency > 1)
        if outside.any():
            bad = self.names[int(np.flatnonzero(outside)[0])]
            raise InputError(
                f"polarization_efficiency of detector {bad} is not between 0 and 1",
                place="focal plane",
            )

    def __repr__(self) -> str:
        reach = np.degrees(np.arctan(self.radius)) * 60
        return f"<Focalplane: {len(self)} detectors within {reach:.3g} arcmin of the boresight>"

    def _repr_html_(self) -> str:
        def span(values: Floats, scale: float, unit: str) -> str:
            low, high = (f"{v * scale:.4g}" for v in (values.min(), values.max()))
            return f"{low} {unit}" if low == high else f"{low} to {high} {unit}"

        if not len(self):
            return html_table("Focalplane", [("detectors", 0)])
        rows = [
            ("detectors", len(self)),
            ("bands", len(set(self.band.tolist()))),
            (
                "farthest from the boresight",
                f"{np.degrees(np.arctan(self.radius)) * 60:.4g} arcmin",
            ),
            ("FWHM", span(self.fwhm, np.degrees(3600), "arcsec")),
            ("NET on the sky", span(self.net, 1e3, "mK_RJ sqrt(s)")),
            ("main-beam efficiency zeta", span(self.main_beam_efficiency, 1, "")),
            ("illumination efficiency epsilon", span(self.illumination_efficiency, 1, "")),
            ("polarized detectors", int((self.polarization_efficiency > 0).sum())),
            ("dead detectors", int(self.dead.sum())),
        ]
        return html_table("Focalplane", rows)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def polarized(self) -> bool:
        """Mask of polarized detectors."""
        return bool((self.polarization_efficiency > 0).any())

    @property
    def radius(self) -> float:
        """Largest distance of a detector from the boresight, tan(rad)."""
        return float(np.hypot(self.xi, self.eta).max()) if len(self) else 0.0

    @property
    def reach(self) -> float:
        """Largest distance of a detector from the middle of the array, which need not be the
        boresight, tan(rad).
        """
        middle = [(v.min() + v.max()) / 2 for v in (self.xi, self.eta)] if len(self) else (0.0, 0.0)
        return float(np.hypot(self.xi - middle[0], self.eta - middle[1]).max(initial=0.0))

    def copy(self) -> Focalplane:
        """An independent copy (an observation may change its own, e.g. `Efficiency` sets the
        efficiencies).
        """
        return Focalplane(**{f.name: getattr(self, f.name).copy() for f in fields(self)})

    def rows(self, index: Indices) -> Focalplane:
        """A focal plane of some of the detectors, copied in this order."""
        found = {f.name: getattr(self, f.name)[index] for f in fields(self) if f.name != "names"}
        return Focalplane([self.names[row] for row in index], **found)

    def of_band(self, number: int) -> Focalplane:
        """The detectors of one band, in their order, as those of a camera that has no other:
        copies.
        """
        found = self.rows(np.flatnonzero(self.band == number))
        found.band[:] = 0
        return found

    @classmethod
    def of_bands(cls, planes: Mapping[str, Focalplane], suffix: bool = True) -> Focalplane:
        """The detectors of several bands by name, one band after the other; with ``suffix`` their
        names end with the band's.
        """
        columns = [f.name for f in fields(cls) if f.name not in ("names", "band")]
        found: dict[str, Any] = {
            c: np.concatenate([getattr(plane, c) for plane in planes.values()]) for c in columns
        }
        names = [
            f"{detector}-{band}" if suffix else detector
            for band, plane in planes.items()
            for detector in plane.names
        ]
        return cls(
            names,
            **found,
            band=np.repeat(np.arange(len(planes)), [len(plane) for plane in planes.values()]),
        )
