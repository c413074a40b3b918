"""What a file of time-ordered data says of its instrument and its site, as an `Instrument`, a `Site` and a focal plane."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import PrivateAttr

from zonda.core.errors import InputError, ZondaError
from zonda.core.focalplane import Focalplane
from zonda.core.instrument import Band, Instrument, Telescope
from zonda.core.registry import sites
from zonda.core.scene import HIGHER, NEAR, distance
from zonda.core.site import Site
from zonda.core.types import Floats

from .time_ordered_data import TimeOrderedData

LIGHT = 299792458.0
SAME_BAND = 1e-3
"""Relative difference of centres up to which detectors are of one band."""

NO_NOISE = "the file states none: NET 0, and all detectors weigh the same"


class RecordedInstrument(Instrument):
    """A camera whose detectors are those of a file."""

    _plane: Focalplane = PrivateAttr()

    def focalplane(self) -> Focalplane:
        """The file's detectors."""
        return self._plane.copy()

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, RecordedInstrument) or self.model_dump() != other.model_dump():
            return False
        return all(np.array_equal(v, vars(other._plane)[k]) for k, v in vars(self._plane).items())

    def __hash__(self) -> int:
        return hash((self.name, self.detectors))


def site_of(tod: TimeOrderedData) -> Site:
    """Where the file's telescope stands, with the climatology of a registered site that is nearer than `NEAR`."""
    name, latitude, longitude, altitude = tod.site
    given: dict[str, Any] = {
        "name": name or "recorded", "latitude": f"{latitude!r} rad", "longitude": f"{longitude!r} rad",
        "altitude": f"{altitude!r} m", "provenance": "the file of time-ordered data",
    }  # fmt: skip
    for known in sites:
        try:
            other: Site = sites.create(known)
        except ZondaError:  # of a plugin that is not installed whole
            continue
        if other.climatology and distance((latitude, longitude), other) < NEAR and abs(other.altitude - altitude) < HIGHER:
            given["climatology"] = other.climatology
            break
    return Site(**given)


def rows_of_band(tod: TimeOrderedData, band: str | None, place: str) -> NDArray[np.intp]:
    """Rows of the detectors of one band; ``band``: its centre in GHz, where the file has several.

    Raises InputError for a file of several bands where none is chosen, or one that is not there.
    """
    every = np.arange(tod.n_detectors)
    centre = tod.columns.get("band_centre")
    if centre is None:
        return every
    centres = _distinct(centre)
    names = ", ".join(f"{c / 1e9:.4g} GHz" for c in centres)
    if band is None:
        if len(centres) > 1:
            cure = f"set band, e.g. band: {centres[0] / 1e9:.4g} GHz: one run for each"
            raise InputError(f"has detectors of {len(centres)} bands: {names}", place=place, cure=cure)
        return every
    try:
        wanted = float(band.lower().removesuffix("ghz")) * 1e9
    except ValueError:
        raise InputError(f"{band!r} is no frequency", place=place, cure=f"choose the centre of a band: {names}") from None
    rows = np.flatnonzero(np.abs(centre / wanted - 1) < 0.05)
    near = [c for c in centres if abs(c / wanted - 1) < 0.05]
    if len(near) != 1:
        raise InputError(f"has no band, or more than one, at {wanted / 1e9:g} GHz", place=place, cure=f"choose from: {names}")
    return rows


def _distinct(centres: Floats) -> list[float]:
    found: list[float] = []
    for centre in np.unique(centres):
        if not found or centre / found[-1] - 1 > SAME_BAND:
            found.append(float(centre))
    return found


def instrument_of(tod: TimeOrderedData, rows: NDArray[np.intp], given: Instrument | None, place: str) -> RecordedInstrument:
    """The camera that the file describes; what it does not state is taken from ``given``, the scene's.

    Raises InputError where neither states the beam, or a column is not finite.
    """
    columns = {name: values[rows] for name, values in tod.columns.items()}
    plane = _focalplane(tod, columns, rows, given, place)
    fwhm = float(np.median(plane.fwhm))
    band = _band(columns, given, place)
    diameter = tod.metadata.get("telescope_diameter")
    if diameter is None:
        diameter = 1.22 * LIGHT / band.centre / fwhm if given is None else given.telescope.diameter
    net, knee = float(np.median(plane.net)), float(np.median(plane.knee))
    made = RecordedInstrument(
        name=tod.telescope or "recorded",
        description=f"as {tod.name} was recorded",
        telescope=Telescope(
            name=str(tod.metadata.get("telescope", tod.telescope or "recorded")),
            diameter=f"{float(diameter)!r} m",
            elevation_min="0 deg",
        ),
        band=band,
        detectors=len(plane),
        field_of_view=f"{2 * float(np.arctan(plane.radius))!r} rad",
        fwhm=f"{fwhm!r} rad",
        main_beam_efficiency=float(np.median(plane.main_beam_efficiency)),
        illumination_efficiency=float(np.median(plane.illumination_efficiency)),
        net=f"{net!r} K s(1/2)",
        knee=f"{knee!r} Hz",
        slope=min(float(np.median(plane.slope)), 3.0),
        pink_minimum_frequency=f"{float(np.median(plane.minimum_frequency))!r} Hz",
        sample_rate=f"{tod.sample_rate!r} Hz",
        provenance="the file of time-ordered data",
    )
    made._plane = plane
    return made


def _band(columns: Mapping[str, Floats], given: Instrument | None, place: str) -> Band:
    """The passband: flat, of the file's centre and width."""
    if not {"band_centre", "band_width"} <= set(columns):
        if given is None:
            cure = "give the scene an instrument with its band"
            raise InputError("states no band (bandcenter, bandwidth)", place=place, cure=cure)
        return given.band
    centre, width = (float(np.median(columns[name])) for name in ("band_centre", "band_width"))
    if given is not None and np.isclose(given.band.centre, centre, rtol=1e-9) and np.isclose(given.band.width, width, rtol=1e-9):
        return given.band
    if not 0 < width < 2 * centre:
        cure = "mend bandcenter and bandwidth, or leave them out and give the scene an instrument"
        raise InputError(f"states a band of {width / 1e9:g} GHz about {centre / 1e9:g} GHz", place=place, cure=cure)
    low, high = centre - width / 2, centre + width / 2
    return Band(name=f"{centre / 1e9:.4g} GHz", low=f"{low!r} Hz", high=f"{high!r} Hz", provenance="flat, of the file's width")


def _focalplane(
    tod: TimeOrderedData, columns: Mapping[str, Floats], rows: NDArray[np.intp], given: Instrument | None, place: str
) -> Focalplane:
    n, found = len(rows), dict[str, Any]()
    stated = {
        "fwhm": None if given is None else given.beam_fwhm,
        "main_beam_efficiency": 1.0,
        "illumination_efficiency": 1.0,
        "net": 0.0 if given is None else given.net,
        "polarization_angle": 0.0,
        "knee": 0.0,
        "slope": 1.0,
        "minimum_frequency": 1e-3,
    }
    for name, otherwise in stated.items():
        if name in columns:
            found[name] = columns[name]
        elif otherwise is None:
            raise InputError("states no beam (fwhm)", place=place, cure="give the scene an instrument with its fwhm")
        else:
            found[name] = np.full(n, otherwise)
    if "polarization_efficiency" in columns:
        found["polarization_efficiency"] = columns["polarization_efficiency"]
    if "wafer" in columns:
        found["wafer"] = columns["wafer"]
    names = [tod.names[row] for row in rows]
    for name, values in {**found, "xi": tod.xi[rows], "eta": tod.eta[rows]}.items():
        bad = np.flatnonzero(~np.isfinite(values) | ((values <= 0) if name in ("fwhm", "slope") else values < -np.inf))
        if bad.size:
            cure = "give it a number in the focal plane of the file; flag the detector if it is not to be used"
            raise InputError(f"{name} of detector {names[bad[0]]} is {values[bad[0]]:g}", place=place, cure=cure)
    found["minimum_frequency"] = np.maximum(found["minimum_frequency"], 1e-9)
    return Focalplane(names=names, xi=tod.xi[rows], eta=tod.eta[rows], **found)
