"""The map of a `SkyMap`, read once and kept by the step; and what its header alone says of its
place.
"""

from __future__ import annotations

import warnings
from collections.abc import Hashable
from pathlib import Path
from typing import cast

from zonda.core.configuration.target import Target
from zonda.core.data import Data, percent
from zonda.core.errors import InputError
from zonda.core.hooks import manager
from zonda.core.maps.map_reading import STOKES
from zonda.core.numerics.projection import share_outside
from zonda.core.types import Floats

from .footprint import Footprint, off_the_map, position
from .input_map import ImageMap, InputMap
from .map_header import DOUBT, seen_twice
from .parameters import SkyParameters
from .read import read_map
from .region import Progress, no_progress

LARGE = 1 << 26
"""Bytes of a file above which the progress bar shows that it is read."""


class SkyInput(SkyParameters):
    """A map of the sky that is read from a file or an array."""

    def _input(self, polarized: bool) -> tuple[InputMap, tuple[Hashable, ...]]:
        """The map, read once for all observations, and its key in the cache."""
        key = (*self._identity(), *(["polarized"] if polarized else []))
        return cast(InputMap, self._cache.get(key, lambda: self.read_input(polarized))), key

    def read_input(self, polarized: bool = False, header_alone: bool = False) -> InputMap:
        """The map of the file or the array, with Q and U if the camera is ``polarized``; warns of
        what is doubtful.
        """
        found = self._read(polarized, header_alone)
        for what in (STOKES, DOUBT):
            if what in found.notes:
                self.warn(found.notes[what])
        return found

    def _read(self, polarized: bool = False, header_alone: bool = False) -> InputMap:
        names = ("unit", "pixel_size", "missing", "input_beam", "coordsys", "column", "hdu")
        progress: Progress = no_progress
        if self._bytes > LARGE and not header_alone:
            progress = self._progress(f"reading {self.source}")
        progress(0, 1)
        found = read_map(
            self.array() or cast(Path, self.file),
            plane=(self.plane,) if isinstance(self.plane, int) else self.plane,
            centred=self.centre is not None,
            polarized=polarized,
            convention=self.polarization_convention,
            header_alone=header_alone,
            **{name: getattr(self, name) for name in names},
        )
        progress(0, 0)
        return found

    def warn(self, text: str) -> None:
        """Warn about the map."""
        warnings.warn(f"{self.label}: {self.file or self.source}: {text}", stacklevel=3)

    def warn_of_beams(self, source: InputMap, telescope: Floats) -> str:
        """Warn if a map that was made with a beam is convolved with those of detectors, FWHM (n,)
        [rad]. Returns the statement about it, empty if there is none.
        """
        if self.beam == "none":
            return ""
        stated, text = seen_twice(source.beam, self.fwhm, telescope)
        if text:
            self.warn(text)
        return stated

    def _progress(self, what: str) -> Progress:
        """Callback that moves the progress bar."""
        hook, text = manager().hook, f"{self.label}: {what}"
        return lambda done, total: hook.zonda_progress(done=done, total=total, what=text)

    @property
    def _bytes(self) -> int:
        """Size of the file; 0 of an array."""
        return self.file.stat().st_size if self.file and self.file.exists() else 0

    def _identity(self) -> tuple[Hashable, ...]:
        """Key of the map: an array's hash, a file's size and time of change."""
        if (array := self.array()) is not None:
            return ("array", array.digest)
        assert self.file is not None  # one of the two is given
        return ("file", self._bytes and self.file.stat().st_mtime_ns, self._bytes)

    def _header(self) -> InputMap:
        """The map without its values."""
        key = *self._identity(), "header"
        return cast(InputMap, self._cache.get(key, lambda: self._read(header_alone=True)))

    def _footprint(self) -> Footprint | None:
        centre = self.centre if isinstance(self.centre, Target) else None
        return Footprint.of(self._header(), centre, self.place)

    def map_centre(self) -> Target:
        """The middle of the input map, for ``target: map``. Raises InputError where it has none of
        its own.
        """
        if self.centre == "target":
            message = "target: map and centre: target each refer to the other"
            cure = "give the target as coordinates, or remove centre: target"
            raise InputError(message, place=self.place, cure=cure)
        if isinstance(self.centre, Target):
            return self.centre
        if (found := self._footprint()) is None:
            message = "the map has no centre on the sky (HEALPix, or no WCS)"
            raise InputError(message, place=self.place, cure="give the target as coordinates")
        return found.target

    def check(self, data: Data) -> list[str]:
        """Check that scans are about a point of the map, by its header; states the share of samples
        outside.
        """
        header, targets = self._header(), dict.fromkeys(o.centre for o in data.observations)
        placeless = isinstance(header, ImageMap) and header.placeless and self.centre is None
        if len(targets) > 1 and (self.centre == "target" or placeless):
            warnings.warn(
                f"{self.label}: the map {self.source} is put on each of {len(targets)} targets, as"
                " a copy of its own; give centre a position, or remove it for a map that knows its"
                " own",
                stacklevel=2,
            )
        if self.centre == "target" or (found := self._footprint()) is None:
            return []
        for centre in targets:
            if text := off_the_map(found, centre, self.label):
                warnings.warn(text, stacklevel=2)
        lines = [f"centre of the input map: {position(*found.target.icrs())}"]
        if found.matrix is not None and data.observations:
            scans = (
                (o.boresight_radec, o.focalplane.xi, o.focalplane.eta) for o in data.observations
            )
            share = percent(share_outside(scans, found.matrix, found.shape), 2)
            lines.append(f"samples outside the input map: about {share}")
        return lines
