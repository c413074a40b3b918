"""The map of a `SkyMap` read, on its grid, in K_RJ and convolved with beams; each is made once and
kept by the step.
"""

from __future__ import annotations

import warnings
from collections.abc import Hashable
from dataclasses import replace
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from zonda.core.configuration.target import Target
from zonda.core.hooks import manager
from zonda.core.numerics.angles import ARCSEC
from zonda.core.types import Floats

from .beam import REACH, SIGMA, Convolved, convolve, convolve_evenly, distinct
from .brightness import Brightness, conversion, on_own_pixels, resampled, too_bright
from .geometry import placed, turned
from .grid import Grid, is_flat, is_resolved, own_pixels, tangent_grid
from .inputs import HealpixMap, WcsMap
from .limits import check_brightness
from .parameters import SkyParameters
from .read import read_array, read_map
from .resample import Progress, no_progress
from .resolution import seen_twice
from .spread import Spread
from .state import Beam
from .stokes import STOKES
from .units import DOUBT

if TYPE_CHECKING:
    from zonda.core.data import Data, Observation
    from zonda.core.instrument import Band

LARGE = 1 << 26
"""Bytes of a file above which the progress bar shows that it is read."""
LOOKED_WHOLE = 1 << 28
"""Bytes of a file up to which `zonda check` reads its values."""
OBLONG = 20.0
"""Ratio of a pixel's sides beyond which an image's scale is doubted."""
COARSE = 100.0
"""Beams in a pixel beyond which an image's scale is doubted."""
SCANS_LOOKED_AT = 8
"""Scans of which `zonda check` lays out the grid."""


def beam_widths(step: SkyParameters, observation: Observation) -> tuple[Floats, NDArray[np.int64]]:
    """Distinct widths (FWHM, rad; 0: no beam) and the number of each detector's."""
    fwhm = (
        np.full(observation.n_detectors, step.fwhm)
        if step.fwhm is not None
        else observation.focalplane.fwhm
    )
    return (np.zeros(1), np.zeros(len(fwhm), np.int64)) if step.beam == "none" else distinct(fwhm)


def grid_of(step: SkyParameters, observation: Observation) -> Grid:
    """The grid on which the map will be convolved; nothing is convolved, interpolated or spread
    yet.
    """
    found, _ = beam_widths(step, observation)
    widths = float(found.min(initial=np.inf)), float(found.max(initial=0.0))
    source, identity = source_of(step, observation.focalplane.polarized)
    band = observation.instrument.band
    key = (*identity, band.frequency.tobytes(), band.transmission.tobytes())
    if isinstance(source, WcsMap):
        centre = step.centre.icrs() if isinstance(step.centre, Target) else None
        if step.centre == "target" or (centre is None and source.wcs is None):
            centre = observation.centre
        moved = (
            source if centre is None or source.wcs is None else turned(source, centre, step.place)
        )
        wcs = placed(source, centre)
        if wcs is not None:
            placeless = replace(source, wcs=wcs)
            reach = REACH * SIGMA * widths[1]
            if not is_resolved(placeless, widths[0]) or is_flat(source, wcs, observation, reach):
                return own_pixels(source, wcs, key, moved.turn)
            moved = placeless if source.wcs is None else moved
        source, key = moved, key if centre is None else (*key, centre)
    return tangent_grid(source, observation, widths, step.pixels_per_fwhm, key, step.place)


def source_of(
    step: SkyParameters, polarized: bool
) -> tuple[WcsMap | HealpixMap, tuple[Hashable, ...]]:
    """`read_of`, once for all observations, and what tells it from others."""
    identity = (*_identity(step), *(["polarized"] if polarized else []))
    return (
        cast("WcsMap | HealpixMap", step._cache.get(identity, lambda: read_of(step, polarized))),
        identity,
    )


def looked_at(step: SkyParameters, data: Data) -> list[str]:
    """What was chosen of the map, as `zonda check` tells it: read by the code with which a run
    reads it.

    Raises InputError as `SkyMap.prepare`, but for what convolution alone finds; of a file of more
    than `LOOKED_WHOLE` bytes as far as its header tells.
    """
    instrument = data.scene.instrument
    polarized = (
        any(o.focalplane.polarized for o in data.observations) or instrument.focalplane().polarized
    )
    large = (
        step.map is None
        and step.file is not None
        and step.file.exists()
        and step.file.stat().st_size > LOOKED_WHOLE
    )
    source = read_of(step, polarized, header_alone=True) if large else source_of(step, polarized)[0]
    if isinstance(source, WcsMap) and step.beam != "none":
        beam = instrument.beam_fwhm if step.fwhm is None else step.fwhm
        if text := odd_pixels(source, beam):
            warnings.warn(f"{step.label}: {step.file or step.source}: {text}", stacklevel=2)
    warn_of_beams(
        step, source, np.array([camera.beam_fwhm for camera in instrument.cameras.values()])
    )
    lines = [f"{what}: {text}" for what, text in source.notes.items() if what != DOUBT]
    if large:
        return [
            *lines,
            (
                f"the values of {step.source} are looked at by the run alone: more than"
                f" {LOOKED_WHOLE >> 20} MB"
            ),
        ]
    for whole in data.observations[:SCANS_LOOKED_AT]:
        for observation in whole.of_each_band():
            grid = grid_of(step, observation)
            found = conversion(grid, observation.instrument.band, step.spectral_index)
            check_brightness(
                np.array([np.abs(source.values).max(initial=0.0)]) * found.typical * step.scale,
                step.place,
            )
    if not source.values.any() or not step.scale:
        warnings.warn(f"{step.label}: {step.source}: all of its pixels are 0", stacklevel=2)
    return [*lines, *([f"pixels taken as zero: {source.zeroed}"] if source.zeroed else [])]


def warn_of_beams(step: SkyParameters, source: WcsMap | HealpixMap, telescope: Floats) -> str:
    """Warn where a map that was made with a beam is convolved with those of detectors, FWHM (n,)
    [rad]; what is stated of it.
    """
    if step.beam == "none":
        return ""
    stated, text = seen_twice(source.beam, step.fwhm, telescope)
    if text:
        warnings.warn(f"{step.label}: {step.file or step.source}: {text}", stacklevel=2)
    return stated


def odd_pixels(source: WcsMap, beam: float) -> str:
    """The warning about pixels that are far too large or too small for a beam of FWHM ``beam``
    [rad]; empty where none is due.
    """
    sides = (
        np.radians(np.asarray(source.wcs.pixel_scale_matrix))
        if source.scale is None
        else source.scale
    )
    x, y = (float(side) / ARCSEC for side in np.linalg.norm(sides, axis=0))
    across, fwhm = max(x * source.values.shape[1], y * source.values.shape[0]), beam / ARCSEC
    text = f"its pixels are {x:.4g} x {y:.4g} arcsec"
    cure = "are CDELT1 and CDELT2 in degrees?"
    if across < fwhm:
        return (
            f"{text} and all of it {across:.4g} arcsec, less than the beam of {fwhm:.4g} arcsec;"
            f" {cure}"
        )
    if max(x, y) > OBLONG * min(x, y):
        return f"{text}: is one of CDELT1 and CDELT2 wrong?"
    return f"{text}, and the beam {fwhm:.4g} arcsec; {cure}" if min(x, y) > COARSE * fwhm else ""


def brightness_on(grid: Grid, step: SkyParameters, band: Band) -> Brightness:
    """The map on the grid, in K_RJ."""
    return _brightness(grid, step, band, grid.spread)


def _brightness(grid: Grid, step: SkyParameters, band: Band, spread: Spread | None) -> Brightness:
    def make() -> Brightness:
        found = conversion(grid, band, step.spectral_index)
        if not grid.resampled:
            return on_own_pixels(grid, found, step.scale, step.place)
        progress = _progress(
            step, f"{'interpolating' if spread is None else 'spreading'} {step.source}"
        )
        return resampled(grid, found, step.scale, step.outside, step.place, progress, spread)

    return cast(Brightness, step._cache.get((*grid.key, spread), make))


def with_beam(grid: Grid, step: SkyParameters, band: Band, fwhm: float) -> Beam:
    """The map convolved with one beam.

    Where the map is spread over the grid the beam is right all over it; else it is that at the
    tangent point.
    """
    linear = step.interpolation == "linear"

    def make() -> Beam:
        sky, evenly = brightness_on(grid, step, band), grid.spread
        if evenly is not None and fwhm != evenly.fwhm and not grid.is_flat:
            evenly = Spread(fwhm, evenly.share)
            sky = _brightness(grid, step, band, evenly)

        def convolved(values: Floats, outside: float) -> Convolved:
            if evenly is not None:
                return convolve_evenly(values, grid.step, evenly.variance(fwhm), outside, linear)
            jacobian = np.radians(np.asarray(sky.wcs.pixel_scale_matrix, np.float64))
            return convolve(values, jacobian, fwhm, outside, step.pixels_per_fwhm, linear)

        intensity = convolved(sky.values, step.outside)
        if text := too_bright(
            float(np.abs(intensity.coefficients["float64"]).max(initial=0.0)),
            sky.notes["conversion"],
        ):
            warnings.warn(f"{step.label}: {step.file or step.source}: {text}", stacklevel=2)
        more = () if sky.polarization is None else sky.polarization
        return Beam.of(
            sky, fwhm, intensity, tuple(convolved(values, 0.0).coefficients for values in more)
        )

    return cast(
        Beam,
        step._cache.get((*grid.key, "beam", step.pixels_per_fwhm, step.interpolation, fwhm), make),
    )


def _identity(step: SkyParameters) -> tuple[Hashable, ...]:
    """Tells one map from another: an array's hash, a file's size and time of change."""
    if (array := step.array()) is not None:
        return ("array", array.digest)
    assert step.file is not None  # one of the two is given
    stamp = step.file.stat() if step.file.exists() else None
    return ("file", stamp and (stamp.st_mtime_ns, stamp.st_size))


def read_of(
    step: SkyParameters, polarized: bool = False, header_alone: bool = False
) -> WcsMap | HealpixMap:
    """The map as its file, or the array, has it; with Q and U where the camera is ``polarized``."""
    given = {
        name: getattr(step, name)
        for name in ("unit", "pixel_size", "missing", "input_beam", "coordsys", "column")
    }
    given |= {
        "plane": (step.plane,) if isinstance(step.plane, int) else step.plane,
        "centred": step.centre is not None,
    }
    given |= {"polarized": polarized, "convention": step.polarization_convention}
    if (array := step.array()) is not None:
        source = read_array(array, step.place, **given)
    else:
        assert step.file is not None
        large = step.file.exists() and step.file.stat().st_size > LARGE and not header_alone
        progress = _progress(step, f"reading {step.file.name}") if large else no_progress
        progress(0, 1)
        source = read_map(step.file, hdu=step.hdu, header_alone=header_alone, **given)
        progress(0, 0)
    for what in (STOKES, DOUBT):
        if what in source.notes:
            warnings.warn(
                f"{step.label}: {step.file or step.source}: {source.notes[what]}", stacklevel=2
            )
    return source


def _progress(step: SkyParameters, what: str) -> Progress:
    """Callback that moves the progress bar."""
    hook, text = manager().hook, f"{step.label}: {what}"
    return lambda done, total: hook.zonda_progress(done=done, total=total, what=text)
