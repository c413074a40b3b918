"""Instrument and site that a file of time-ordered data states, as an `Instrument`, a `Site` and a
focal plane.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydantic import PrivateAttr

from zonda.core.errors import InputError, ZondaError
from zonda.core.focalplane import Focalplane
from zonda.core.instrument import Band, CameraBand, Instrument, Telescope
from zonda.core.registry import sites
from zonda.core.scene import HIGHER, NEAR, distance
from zonda.core.site import Site
from zonda.core.types import Bools, Floats, Indices

from .time_ordered_data import TimeOrderedData

LIGHT = 299792458.0
SAME_BAND = 1e-2
"""Relative difference of neighbouring centres up to which detectors are of one band."""
NEAR_BAND = 0.05
"""Relative difference of centres up to which a band is the one that was named."""
NAMED_BAND = 0.2
"""The same where a band's name alone gives the centre: SO's f030 has its mean at 25.7 GHz."""

DEFAULTS = {
    "fwhm": 0.0,
    "main_beam_efficiency": 1.0,
    "illumination_efficiency": 1.0,
    "net": 0.0,
    "polarization_angle": 0.0,
    "knee": 0.0,
    "slope": 1.0,
    "minimum_frequency": 1e-3,
}
"""Values of detectors for which neither the file nor the scene's instrument states one."""

POSITIVE = ("fwhm", "slope")
"""What is above zero, of the columns."""


class RecordedInstrument(Instrument):
    """A camera whose detectors are those of files."""

    polarized_by = (
        "state angles and efficiencies in the focal plane of the file "
        "(HDF5: gamma, pol_leakage; FITS: POLARIZATION_ANGLE, POLARIZATION_EFFICIENCY)"
    )

    _planes: dict[str, Focalplane] = PrivateAttr(default_factory=dict)
    """The detectors of each band, by its name."""

    @property
    def cameras(self) -> dict[str, Instrument]:
        """Cameras of one band each, by its name."""
        found = super().cameras
        for name, camera in found.items():
            assert isinstance(camera, RecordedInstrument)
            camera._planes = {name: self._planes[name]}
        return found

    def focalplane(self) -> Focalplane:
        """The files' detectors; several bands follow each other."""
        planes = list(self._planes.values())
        return (
            planes[0].copy()
            if len(planes) == 1
            else Focalplane.of_bands(self._planes, suffix=False)
        )

    def has_the_detectors_of(self, other: Instrument | None) -> bool:
        """True if the other is recorded too, and has the same detectors."""
        return (
            isinstance(other, RecordedInstrument)
            and self.focalplane().names == other.focalplane().names
        )

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, RecordedInstrument) or self.model_dump() != other.model_dump():
            return False
        pairs = zip(self._planes.values(), other._planes.values(), strict=True)
        return all(
            np.array_equal(v, vars(theirs)[k])
            for ours, theirs in pairs
            for k, v in vars(ours).items()
        )

    def __hash__(self) -> int:
        return hash((self.name, self.detectors))


def site_of(tod: TimeOrderedData) -> Site:
    """Site of the telescope, with the climatology of a registered site nearer than `NEAR`."""
    name, latitude, longitude, altitude = tod.site
    given: dict[str, Any] = {
        "name": name or "recorded",
        "latitude": f"{latitude!r} rad",
        "longitude": f"{longitude!r} rad",
        "altitude": f"{altitude!r} m",
        "provenance": "the file of time-ordered data",
    }
    for known in sites:
        try:
            other: Site = sites.create(known)
        except ZondaError:  # of a plugin that is not installed whole
            continue
        if (
            other.climatology
            and distance((latitude, longitude), other) < NEAR
            and abs(other.altitude - altitude) < HIGHER
        ):
            given["climatology"] = other.climatology
            break
    return Site(**given)


def rows_of_bands(tod: TimeOrderedData, band: float | None, place: str) -> list[Indices]:
    """Rows of the detectors of each band, in the order of their centres; ``band``: centre [Hz] of
    the only one that is used.

    Raises InputError where there is no such band.
    """
    centre = tod.columns.get("band_centre")
    if centre is None:
        return [np.arange(tod.n_detectors)]
    known = np.isfinite(centre) & (centre > 0)
    for row in np.flatnonzero(~known & (tod.detector_flags == 0))[:1]:
        text = f"the band of detector {tod.names[row]} is at {centre[row] / 1e9:g} GHz"
        raise InputError(text, place=place, cure="give it its centre, or flag the detector")
    if not known.any():
        raise InputError("states no band of any detector", place=place, cure="unflag what is used")
    centre = np.where(known, centre, centre[known][0])
    order = np.argsort(centre, kind="stable")
    steps = np.flatnonzero(np.diff(centre[order]) > SAME_BAND * centre[order][:-1]) + 1
    every = [np.sort(rows) for rows in np.split(order, steps)]
    if band is None:
        return every
    centres = [float(np.median(centre[rows])) for rows in every]
    cure = f"choose the centre of a band: {', '.join(f'{c / 1e9:.4g} GHz' for c in centres)}"
    near = [rows for rows, c in zip(every, centres, strict=True) if is_near(c, band)]
    if len(near) != 1:
        raise InputError(
            f"has no band, or more than one, at {band / 1e9:g} GHz",
            place=place,
            cure=cure,
        )
    return near


def is_near(centre: float, band: float) -> bool:
    """True if ``band`` [Hz] names a band of this centre [Hz]."""
    return abs(centre / band - 1) < NEAR_BAND


def joined(cameras: Sequence[RecordedInstrument], place: str) -> RecordedInstrument:
    """One camera of cameras of one band each, in the order of their centres. Raises InputError
    where two have one band.
    """
    if len(cameras) == 1:
        return cameras[0]
    cameras = sorted(cameras, key=lambda camera: camera.band.centre)
    first = cameras[0]
    bands = []
    for camera in cameras:
        own = {
            key: value
            for key, value in camera.model_dump(mode="json").items()
            if key in CameraBand.model_fields
        }
        own |= camera.band.model_dump(mode="json", exclude_none=True)
        bands.append(CameraBand.model_validate(own | {"name": _plain(camera.band.name)}))
    names = [band.name for band in bands]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(
            f"several bands are called {twice}",
            place=place,
            cure="set band, the centre of the one to be used",
        )
    planes = dict(zip(names, (camera.focalplane() for camera in cameras), strict=True))
    made = first.model_copy(update={
        "band": None, "bands": bands, "pixels": "overlaid", "fwhm": None,
        "field_of_view": max(camera.field_of_view for camera in cameras),
    })  # fmt: skip
    made._planes = planes
    try:
        made.focalplane()
    except InputError as err:
        raise InputError(
            err.message,
            place=place,
            cure="give every detector a name of its own",
        ) from None
    return made


def _plain(name: str) -> str:
    """A name that products and files can bear."""
    return re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_")


def band_of(
    instrument: Instrument | None,
    centre: float | None,
    place: str,
) -> Instrument | None:
    """The camera, of one band, that ``instrument`` has nearest to ``centre`` [Hz].

    Raises InputError where that is not known, and the instrument has several bands.
    """
    if instrument is None or not instrument.bands:
        return instrument
    if centre is None:
        cure = "choose one of the instrument's: instrument: {like: NAME, band: NAME}"
        raise InputError("states no band, and the instrument has several", place=place, cure=cure)
    known = float(centre)
    return min(instrument.cameras.values(), key=lambda camera: abs(camera.band.centre - known))


def instrument_of(
    tod: TimeOrderedData,
    rows: Indices,
    used: Bools,
    given: Instrument | None,
    place: str,
) -> RecordedInstrument:
    """The camera of one band that the file describes; what it does not state is taken from
    ``given``, the scene's.

    ``used`` (len(rows),): what is not known of other detectors is that of a used one. Raises
    InputError where neither states the beam, or a column of a used detector is not finite.
    """
    columns = {name: _known(name, values[rows], used) for name, values in tod.columns.items()}
    centre = float(np.median(columns["band_centre"])) if "band_centre" in columns else None
    given = band_of(given, centre, place)
    plane = _focalplane(tod, columns, rows, given, place)
    band = _band(tod, columns, given, place)
    usual = {key: float(np.median(getattr(plane, key))) for key in DEFAULTS}
    diameter = 1.22 * LIGHT / band.centre / usual["fwhm"]
    if given is not None:
        diameter = given.telescope.diameter
    name = tod.telescope or "recorded"
    about = tod.metadata
    made = RecordedInstrument(
        name=name,
        description=f"as {tod.name} was recorded",
        telescope=Telescope(
            name=str(about.get("telescope", name)),
            diameter=f"{float(about.get('telescope_diameter', diameter))!r} m",
            elevation_min="0 deg",
        ),
        band=band,
        detectors=len(plane),
        field_of_view=f"{2 * float(np.arctan(plane.radius))!r} rad",
        fwhm=f"{usual['fwhm']!r} rad",
        main_beam_efficiency=usual["main_beam_efficiency"],
        illumination_efficiency=usual["illumination_efficiency"],
        net=f"{usual['net']!r} K s(1/2)",
        knee=f"{usual['knee']!r} Hz",
        slope=min(usual["slope"], 3.0),
        pink_minimum_frequency=f"{usual['minimum_frequency']!r} Hz",
        sample_rate=f"{tod.sample_rate!r} Hz",
        provenance="the file of time-ordered data",
    )
    made._planes = {band.name: plane}
    return made


def _known(name: str, values: Floats, used: Bools) -> Floats:
    """The values (n_det,), and the median of the used detectors' where one that is not ``used`` has
    none that can be.
    """
    known = np.isfinite(values) & ((values > 0) | (name not in POSITIVE))
    found = np.sort(values[used & known])
    return np.where(used | known, values, found[len(found) // 2]) if found.size else values


def _band(
    tod: TimeOrderedData,
    columns: Mapping[str, Floats],
    given: Instrument | None,
    place: str,
) -> Band:
    """The passband: flat, of the file's centre and width. It has the name that a file of zonda
    states, or f150 at 150 GHz.
    """
    if not {"band_centre", "band_width"} <= set(columns):
        if given is None:
            cure = "give the scene an instrument with its band"
            raise InputError("states no band (bandcenter, bandwidth)", place=place, cure=cure)
        stated = np.median(columns.get("band_centre", given.band.centre))
        if abs(given.band.centre / stated - 1) > NAMED_BAND:
            text = f"has detectors at {stated / 1e9:.4g} GHz, the instrument at"
            cure = "give the scene an instrument with that band"
            raise InputError(
                f"{text} {given.band.centre / 1e9:.4g} GHz alone",
                place=place,
                cure=cure,
            )
        return given.band
    centre, width = (float(np.median(columns[name])) for name in ("band_centre", "band_width"))
    if (
        given is not None
        and np.isclose(given.band.centre, centre, rtol=1e-9)
        and np.isclose(given.band.width, width, rtol=1e-9)
    ):
        return given.band
    if not 0 < width < 2 * centre:
        cure = "mend bandcenter and bandwidth, or leave them out and give the scene an instrument"
        raise InputError(
            f"states a band of {width / 1e9:g} GHz about {centre / 1e9:g} GHz",
            place=place,
            cure=cure,
        )
    low, high = (
        float(f"{edge:.12g}") for edge in (centre - width / 2, centre + width / 2)
    )  # without the rounding of their sums
    own = (
        str(tod.metadata.get("band", "")) if len(columns["band_centre"]) == tod.n_detectors else ""
    )
    return Band(
        name=_plain(own) or f"f{int(round(centre / 1e9, 6) + 0.5):03d}",
        low=f"{low!r} Hz",
        high=f"{high!r} Hz",
        provenance="flat, of the file's width",
    )


def _focalplane(
    tod: TimeOrderedData,
    columns: Mapping[str, Floats],
    rows: Indices,
    given: Instrument | None,
    place: str,
) -> Focalplane:
    stated = {} if given is None else {"fwhm": given.beam_fwhm, "net": given.net}
    otherwise = {**DEFAULTS, **stated}
    if "fwhm" not in columns and given is None:
        cure = "give the scene an instrument with its fwhm"
        raise InputError("states no beam (fwhm)", place=place, cure=cure)
    found = {name: np.full(len(rows), value) for name, value in otherwise.items()}
    optional = ("polarization_efficiency", "wafer")
    found |= {name: columns[name] for name in (*otherwise, *optional) if name in columns}
    found |= {"xi": tod.xi[rows], "eta": tod.eta[rows]}
    names = [tod.names[row] for row in rows]
    for name, values in found.items():
        bad = np.flatnonzero(~np.isfinite(values) | ((values <= 0) & (name in POSITIVE)))
        if bad.size:
            cure = (
                "give it a number in the focal plane of the file; flag the detector if it is not to"
                " be used"
            )
            raise InputError(
                f"{name} of detector {names[bad[0]]} is {values[bad[0]]:g}",
                place=place,
                cure=cure,
            )
    found["minimum_frequency"] = np.maximum(found["minimum_frequency"], 1e-9)
    return Focalplane(names=names, **found)
