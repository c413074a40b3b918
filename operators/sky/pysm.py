"""The Galactic and extragalactic sky of PySM 3 (Thorne et al. 2017, MNRAS 469, 2821; Zonca et al.
2021, JOSS 6, 3783), averaged over a band.

A band sees

    T = sum_k w_k nu_k^2 T(nu_k) d_k / sum_k w_k nu_k^2 d_k,
    w_k nu_k^2 d_k = integral t(nu) h_k(nu) dnu,   (1)

with T in K_RJ, t the transmission per unit of Rayleigh-Jeans temperature, h_k the straight lines
that are 1 at nu_k and 0 at the other frequencies, d_k the widths of the trapezoidal rule: PySM's
weights w are of power. (1) is the band's average of the T that is straight between the nu_k; a
power law nu^n errs by n (n - 1) / 12 of the square of their relative distance.
"""

from __future__ import annotations

import math
import os
import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from inspect import signature
from pathlib import Path
from typing import Annotated, Any
from urllib.error import URLError

import numpy as np
from pydantic import AfterValidator, Field, PrivateAttr, ValidationInfo, model_validator

from zonda.core.configuration.diagnostics import nearest
from zonda.core.configuration.input_paths import find
from zonda.core.data import Data, Observation
from zonda.core.errors import InputError
from zonda.core.instrument import Band
from zonda.core.machine import needed
from zonda.core.types import Floats

from .skymap import FullSky, Nside, ScanSampler, SkyMap

EXTRA = "pysm"
STEP = 0.005
"""Largest relative distance of frequencies: (1) errs by 2.5e-5 for synchrotron of n = -3."""
FILES = (".fits", ".gz", ".h5", ".hdf5", ".dat", ".txt")
"""Ends of texts in a component that are names of files."""
ALONE = threading.RLock()
"""PySM draws from numpy's global generator, and whether astropy may download is a setting of the
process.
"""


def configuration(
    models: Sequence[str],
    components: Mapping[str, Any],
    place: str,
) -> dict[str, Any]:
    """Presets and components as PySM takes them. Raises InputError: it is not installed, or has no
    such preset.
    """
    presets: dict[str, Any] = needed("pysm3", EXTRA, place).sky.PRESET_MODELS
    for name in models:
        if name not in presets:
            cure = nearest(name, list(presets)) or f"choose from: {', '.join(presets)}"
            raise InputError(f"PySM has no model {name!r}", place=place, cure=cure)
    return {name: presets[name] for name in models} | {
        name: _texts(item) for name, item in components.items()
    }


def check_templates(config: Mapping[str, Any], nside: int, place: str) -> None:
    """Raises InputError where a component asks for a file that is not on this machine."""
    for item in _classes(config):
        near = min(item.get("available_nside") or [nside], key=lambda n: abs(n - nside))
        asked = [name.replace("{nside}", str(near)) for name in _asked_for(item, nside)]
        if asked and not any(map(_is_here, asked)):
            raise _lacks(asked[0], place)


def band_weights(band: Band) -> tuple[Floats, Floats]:
    """Frequencies [Hz] and PySM's weights there, equation (1)."""
    nu = band.frequency
    t = band.transmission
    seen = np.flatnonzero(t)
    low = float(nu[max(seen[0] - 1, 0)])
    high = float(nu[min(seen[-1] + 1, len(nu) - 1)])
    number = max(math.ceil((high - low) / (STEP * low)), 1)
    at = np.linspace(low, high, number + 1)
    edges = np.union1d(nu[(nu > low) & (nu < high)], at)
    third = np.diff(edges) / 6  # t and h are straight between edges: Simpson's rule is exact
    points = np.concatenate([edges[:-1], (edges[1:] + edges[:-1]) / 2, edges[1:]])
    shares = np.concatenate([third, 4 * third, third]) * np.interp(points, nu, t)
    k = np.clip(np.searchsorted(at, points, side="right") - 1, 0, number - 1)
    along = (points - at[k]) / (at[k + 1] - at[k])
    sums = np.bincount(k, shares * (1 - along), number + 1) + np.bincount(
        k + 1,
        shares * along,
        number + 1,
    )
    widths = np.full(number + 1, (high - low) / number)
    widths[[0, -1]] /= 2
    return at, sums / widths / at**2


def emission(
    config: Mapping[str, Any],
    nside: int,
    band: Band,
    download: bool,
    place: str,
) -> Floats:
    """The sum of PySM's components over a band: (3, n_pix) I, Q and U in COSMO's convention,
    Galactic, K_RJ, ring order.

    Raises
    ------
    InputError
        PySM is not installed, refuses a component, or lacks a template that may not or cannot be
        downloaded.
    """
    import astropy.units as u

    pysm3 = needed("pysm3", EXTRA, place)
    nu, weights = band_weights(band)
    # not the very freq_ref_I, where PySM 3.4.6 leaves Q and U of dust as they are at freq_ref_P
    frequencies = nu * (1 + 1e-12) / 1e9 * u.GHz
    total = np.zeros((3, 12 * nside**2))
    with ALONE, _offline(not download), _same_numbers():
        try:
            for component in pysm3.sky.create_components_from_config(
                _seeded(config, pysm3.models),
                nside=nside,
            ):
                found = np.atleast_2d(
                    component.get_emission(frequencies, weights).to_value(pysm3.units.uK_RJ)
                )
                # a sum of PySM's own would add I alone to Q and U as well
                total[: len(found)] += 1e-6 * found
        except URLError as err:
            raise _lacks(str(err.reason).partition(" was supposed")[0], place, download) from None
        except Exception as err:  # of any kind, also mistakes of PySM's own
            cure = "see PySM's documentation of the class (its data/presets.cfg has examples)"
            raise InputError(f"PySM: {type(err).__name__}: {err}", place=place, cure=cure) from err
    return total


def _lacks(what: str, place: str, download: bool = False) -> InputError:
    own = "put PySM's own under the folder that the environment variable PYSM_LOCAL_DATA names"
    cure = (
        f"correct the path; {own}, or {'check the network' if download else 'set download: true'}"
    )
    return InputError(
        f"neither files nor templates that PySM has on this machine: {what}",
        place=place,
        cure=cure,
    )


def _texts(config: Any) -> Any:
    """The configuration with paths as text."""
    if isinstance(config, Mapping):
        return {key: _texts(item) for key, item in config.items()}
    return str(config) if isinstance(config, Path) else config


def _seeded(config: Any, models: Any) -> Any:
    """The configuration with seeds for classes that draw another sky each time where none are
    given.
    """
    if not isinstance(config, Mapping):
        return config
    made = getattr(models, str(config.get("class")), None)
    seeds = (
        {"seeds": [1, 2, 3]} if made is not None and "seeds" in signature(made).parameters else {}
    )
    return seeds | {key: _seeded(item, models) for key, item in config.items()}


def is_file(item: Any) -> bool:
    """True if a value of a component is the name of a file."""
    return isinstance(item, str) and item.endswith(FILES)


def _classes(config: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """The configuration of each class: components may be made up of several."""
    if "class" in config:
        yield config
    for item in config.values():
        if isinstance(item, Mapping):
            yield from _classes(item)


class _Asked(Exception):
    """A component asked for a file."""


def _asked_for(item: Mapping[str, Any], nside: int) -> list[str]:
    """The first file that a class asks for when it is made, or its maps of all frequencies.

    Nothing is read. Empty where the class cannot be made, which `emission` tells.
    """
    from unittest.mock import patch

    pysm3 = needed("pysm3", EXTRA)

    def get(_: Any, name: str) -> str:
        raise _Asked(name)

    with ALONE, _same_numbers(), patch.object(pysm3.utils.RemoteData, "get", get):
        try:
            (made,) = pysm3.sky.create_components_from_config({"one": dict(item)}, nside=nside)
        except _Asked as asked:
            return [str(asked)]
        except Exception:  # of any kind, also mistakes of PySM's own
            return []
    return [str(name) for name in getattr(made, "maps", {}).values()]


def _is_here(name: str) -> bool:
    from astropy.utils.data import CacheMissingWarning, is_url_in_cache
    from pysm3.utils.data import DATAURL, RemoteData

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CacheMissingWarning)
        cached = is_url_in_cache(DATAURL + name)
    return cached or any(
        os.path.exists(os.path.join(folder, name)) for folder in ("", *RemoteData().data_folders)
    )


@contextmanager
def _offline(wanted: bool) -> Iterator[None]:
    from astropy.utils.data import conf

    with conf.set_temp("allow_internet", bool(conf.allow_internet and not wanted)):
        yield


@contextmanager
def _same_numbers() -> Iterator[None]:
    """Seed numpy's global generator, and restore its state afterwards."""
    before = np.random.get_state()  # noqa: NPY002
    np.random.seed(0)  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(before)  # noqa: NPY002


def _absolute(value: Any, info: ValidationInfo) -> Any:
    """Files of the user's as absolute paths; what is not found is PySM's."""
    if isinstance(value, Mapping):
        return {key: _absolute(item, info) for key, item in value.items()}
    try:
        return find(value, info) if is_file(value) else value
    except ValueError:
        return value


Components = Annotated[dict[str, dict[str, Any]], AfterValidator(_absolute)]


class PySMSky(FullSky):
    """Emission of the Galaxy, and of all else that PySM 3 models, over each band: part of the
    component ``sky``.

    Needs the extra pysm. Galactic coordinates, I, Q and U in COSMO's convention. Nothing is
    downloaded unless `download` says so.
    """

    models: list[str] = Field(default_factory=list)
    """PySM's presets by name: d1, s1, f1, a1 ... Their sum, with that of `components`, is the sky.
    """
    components: Components = Field(default_factory=dict)
    """Components by a name of yours, as in PySM's `component_config`: {class: PowerLaw, map_I:
    FILE, freq_ref_I: 23 GHz, ...}. Relative paths start at the pipeline file's folder."""
    nside: Nside = 512
    """Of the HEALPix maps; templates of another are degraded or repeated. A pixel should be smaller
    than half of the beam.
    """
    download: bool = False
    """Whether PySM may fetch templates that are neither in its local folders nor in its cache."""

    _skies: dict[tuple[bytes, ...], SkyMap] = PrivateAttr(default_factory=dict)

    @model_validator(mode="after")
    def _something(self) -> PySMSky:
        if not self.models and not self.components:
            raise ValueError("give models, e.g. [d1, s1], or components")
        names = [*self.models, *self.components]
        if len(set(names)) < len(names):
            raise ValueError("each model and component is given once, under a name of its own")
        return self

    def observe(self, data: Data) -> None:
        """Raises InputError where PySM is not installed, has no such model, or lacks templates that
        may not be downloaded.
        """
        config = configuration(self.models, self.components, self.label)
        if not self.download:
            check_templates(config, self.nside, self.label)

    def check(self, data: Data) -> list[str]:
        """Names the model and the version of PySM. Raises as `observe`."""
        self.observe(data)
        return [f"PySM {needed('pysm3', EXTRA).__version__}: {self._what}"]

    @property
    def _what(self) -> str:
        return f"{', '.join([*self.models, *self.components])} at nside {self.nside}"

    def prepare(self, observation: Observation) -> tuple[SkyMap, ScanSampler]:
        """The step that samples the band's map, and what that one knows of the scan."""
        sky = self.sky(observation)
        observation.log.state(self.label, "sky of PySM", self._what)
        return sky, sky.prepare(observation)

    def sky(self, observation: Observation) -> SkyMap:
        """The step that samples the map of an observation's band; made once for each band. Raises
        InputError as `emission`.
        """
        band = observation.instrument.band
        polarized = observation.focalplane.polarized
        key = band.frequency.tobytes(), band.transmission.tobytes(), bytes([polarized])
        with ALONE:
            if key not in self._skies:
                config = configuration(self.models, self.components, self.label)
                maps = emission(config, self.nside, band, self.download, self.label)
                maps = maps if polarized and maps[1:].any() else maps[:1]
                self._skies[key] = self.sampler(maps, "K_RJ", "G")
            return self._skies[key]
