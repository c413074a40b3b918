"""The map of a `SkyMap` read, on its grid, in K_RJ and convolved with beams; each is made once and kept by the step."""

from __future__ import annotations

import warnings
from collections.abc import Hashable
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from zonda.core.configuration.target import Target
from zonda.core.hooks import manager
from zonda.core.types import Floats

from .beam import REACH, SIGMA, convolve, distinct
from .brightness import Brightness, conversion, interpolated, on_own_pixels, too_bright
from .geometry import placed, turned
from .grid import Grid, own_pixels, tangent_grid
from .inputs import HealpixMap, WcsMap
from .parameters import SkyParameters
from .read import read_array, read_map
from .resample import Progress, no_progress
from .state import Beam
from .stokes import STOKES

if TYPE_CHECKING:
    from zonda.core.data import Observation
    from zonda.core.instrument import Band

LARGE = 1 << 26
"""Bytes of a file above which the progress bar shows that it is read."""


def beam_widths(step: SkyParameters, observation: Observation) -> tuple[Floats, NDArray[np.int64]]:
    """Distinct widths (FWHM, rad; 0: no beam) and the number of each detector's."""
    fwhm = np.full(observation.n_detectors, step.fwhm) if step.fwhm is not None else observation.focalplane.fwhm
    return (np.zeros(1), np.zeros(len(fwhm), np.int64)) if step.beam == "none" else distinct(fwhm)


def grid_of(step: SkyParameters, observation: Observation) -> Grid:
    """The grid on which the map will be convolved; nothing is convolved or interpolated yet."""
    widths, _ = beam_widths(step, observation)
    beam = REACH * SIGMA * float(widths.max(initial=0.0)), float(widths.min(initial=np.inf)) / step.pixels_per_fwhm
    polarized = observation.focalplane.polarized
    identity = (*_identity(step), *(["polarized"] if polarized else []))
    source: WcsMap | HealpixMap = step._cache.get(identity, lambda: read_of(step, polarized))
    band = observation.instrument.band
    key = (*identity, band.frequency.tobytes(), band.transmission.tobytes())
    if isinstance(source, WcsMap):
        centre = step.centre.icrs() if isinstance(step.centre, Target) else None
        if step.centre == "target" or (centre is None and source.wcs is None):
            centre = observation.centre
        wcs = placed(source, centre)
        if wcs is not None:
            moved = centre is not None and source.wcs is not None and source.polarization is not None
            turn = turned(source, centre, step.place).turn if centre is not None and moved else None
            return own_pixels(source, wcs, key, turn)
        if centre is not None:
            return tangent_grid(turned(source, centre, step.place), observation, beam, (*key, centre), step.place)
    return tangent_grid(source, observation, beam, key, step.place)


def brightness_on(grid: Grid, step: SkyParameters, band: Band) -> Brightness:
    """The map on the grid, in K_RJ."""

    def make() -> Brightness:
        found = conversion(grid, band, step.spectral_index)
        if not grid.resampled:
            return on_own_pixels(grid, found, step.scale, step.place)
        progress = _progress(step, f"interpolating {step.source}")
        return interpolated(grid, found, step.scale, step.outside, step.place, progress)

    return cast(Brightness, step._cache.get(grid.key, make))


def with_beam(sky: Brightness, step: SkyParameters, fwhm: float) -> Beam:
    """The map convolved with one beam; the Jacobian is that at the tangent point."""

    def make() -> Beam:
        jacobian = np.radians(np.asarray(sky.wcs.pixel_scale_matrix, np.float64))
        linear = step.interpolation == "linear"
        convolved = convolve(sky.values, jacobian, fwhm, step.outside, step.pixels_per_fwhm, linear)
        if text := too_bright(float(np.abs(convolved.coefficients["float64"]).max(initial=0.0)), sky.notes["conversion"]):
            warnings.warn(f"{step.label}: {step.file or step.source}: {text}", stacklevel=2)
        more = () if sky.polarization is None else sky.polarization
        others = [convolve(values, jacobian, fwhm, 0.0, step.pixels_per_fwhm, linear) for values in more]
        return Beam.of(sky, fwhm, convolved, tuple(other.coefficients for other in others))

    return cast(Beam, step._cache.get((*sky.key, "beam", step.pixels_per_fwhm, step.interpolation, fwhm), make))


def _identity(step: SkyParameters) -> tuple[Hashable, ...]:
    """Tells one map from another: an array's hash, a file's size and time of change."""
    if (array := step.array()) is not None:
        return ("array", array.digest)
    assert step.file is not None  # one of the two is given
    stamp = step.file.stat() if step.file.exists() else None
    return ("file", stamp and (stamp.st_mtime_ns, stamp.st_size))


def read_of(step: SkyParameters, polarized: bool = False) -> WcsMap | HealpixMap:
    """The map as its file, or the array, has it; with Q and U where the camera is ``polarized``."""
    given = {name: getattr(step, name) for name in ("unit", "pixel_size", "missing", "input_beam", "coordsys")}
    given |= {"plane": (step.plane,) if isinstance(step.plane, int) else step.plane, "centred": step.centre is not None}
    given |= {"polarized": polarized, "convention": step.polarization_convention}
    if (array := step.array()) is not None:
        source = read_array(array, step.place, **given)
    else:
        assert step.file is not None
        large = step.file.exists() and step.file.stat().st_size > LARGE
        progress = _progress(step, f"reading {step.file.name}") if large else no_progress
        progress(0, 1)
        source = read_map(step.file, hdu=step.hdu, **given)
        progress(0, 0)
    if STOKES in source.notes:
        warnings.warn(f"{step.label}: {step.file or step.source}: {source.notes[STOKES]}", stacklevel=2)
    return source


def _progress(step: SkyParameters, what: str) -> Progress:
    """Callback that moves the progress bar."""
    hook, text = manager().hook, f"{step.label}: {what}"
    return lambda done, total: hook.zonda_progress(done=done, total=total, what=text)
