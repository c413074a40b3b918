"""The Galactic and extragalactic sky of PySM 3 (Thorne et al. 2017, MNRAS 469, 2821; Zonca et al.
2021, JOSS 6, 3783).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, Field, PrivateAttr, ValidationInfo, model_validator

from zonda.core.configuration.files import find
from zonda.core.data import Data
from zonda.core.observation import Observation
from zonda.core.versions import needed

from .full_sky import FullSky, Nside
from .pysm_emission import ALONE, EXTRA, check_templates, configuration, emission, is_file
from .scan_sampler import ScanSampler
from .skymap import SkyMap


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
        band, polarized = observation.instrument.band, observation.focalplane.polarized
        key = band.frequency.tobytes(), band.transmission.tobytes(), bytes([polarized])
        with ALONE:
            if key not in self._skies:
                config = configuration(self.models, self.components, self.label)
                maps = emission(config, self.nside, band, self.download, self.label)
                maps = maps if polarized and maps[1:].any() else maps[:1]
                self._skies[key] = self.sampler(maps, "K_RJ", "G")
            return self._skies[key]
