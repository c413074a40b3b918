"""The map of a `SkyMap`, read once and kept by the step."""

from __future__ import annotations

import warnings
from collections.abc import Hashable
from typing import cast

from zonda.core.hooks import manager
from zonda.core.maps.map_reading import STOKES
from zonda.core.types import Floats

from .input_map import InputMap
from .parameters import SkyParameters
from .read import read_array, read_map
from .region import Progress, no_progress
from .units import DOUBT, seen_twice

LARGE = 1 << 26
"""Bytes of a file above which the progress bar shows that it is read."""


class SkyInput(SkyParameters):
    """A map of the sky that is read from a file or an array."""

    def _input(self, polarized: bool) -> tuple[InputMap, tuple[Hashable, ...]]:
        """The map, read once for all observations, and its key in the cache."""
        identity = (*self._identity(), *(["polarized"] if polarized else []))
        return (
            cast(InputMap, self._cache.get(identity, lambda: self.read_input(polarized))),
            identity,
        )

    def read_input(self, polarized: bool = False, header_alone: bool = False) -> InputMap:
        """The map of the file or the array; with Q and U if the camera is ``polarized``."""
        given = {
            name: getattr(self, name)
            for name in ("unit", "pixel_size", "missing", "input_beam", "coordsys", "column")
        }
        given |= {
            "plane": (self.plane,) if isinstance(self.plane, int) else self.plane,
            "centred": self.centre is not None,
        }
        given |= {"polarized": polarized, "convention": self.polarization_convention}
        if (array := self.array()) is not None:
            source = read_array(array, self.place, **given)
        else:
            assert self.file is not None
            large = self.file.exists() and self.file.stat().st_size > LARGE and not header_alone
            progress = self._progress(f"reading {self.file.name}") if large else no_progress
            progress(0, 1)
            source = read_map(self.file, hdu=self.hdu, header_alone=header_alone, **given)
            progress(0, 0)
        for what in (STOKES, DOUBT):
            if what in source.notes:
                warnings.warn(
                    f"{self.label}: {self.file or self.source}: {source.notes[what]}", stacklevel=2
                )
        return source

    def warn_of_beams(self, source: InputMap, telescope: Floats) -> str:
        """Warn if a map that was made with a beam is convolved with those of detectors, FWHM (n,)
        [rad]. Returns the statement about it, empty if there is none.
        """
        if self.beam == "none":
            return ""
        stated, text = seen_twice(source.beam, self.fwhm, telescope)
        if text:
            warnings.warn(f"{self.label}: {self.file or self.source}: {text}", stacklevel=2)
        return stated

    def _progress(self, what: str) -> Progress:
        """Callback that moves the progress bar."""
        hook, text = manager().hook, f"{self.label}: {what}"
        return lambda done, total: hook.zonda_progress(done=done, total=total, what=text)

    def _identity(self) -> tuple[Hashable, ...]:
        """Key of the map: an array's hash, a file's size and time of change."""
        if (array := self.array()) is not None:
            return ("array", array.digest)
        assert self.file is not None  # one of the two is given
        stamp = self.file.stat() if self.file.exists() else None
        return ("file", stamp and (stamp.st_mtime_ns, stamp.st_size))
