"""The cosmic microwave background, drawn from its power spectra.

    a^T = sqrt(C^TT) g_T,   a^E = C^TE / sqrt(C^TT) g_T + sqrt(C^EE - (C^TE)^2 / C^TT) g_E,
    a^B = sqrt(C^BB) g_B,   (1)

for every l and m, g complex normal deviates of unit variance (real for m = 0); healpy makes maps of
them (Gorski et al. 2005). A deviate belongs to its l and m, so that another `nside` shows the same
sky with more or less detail. K_CMB become K_RJ over the band as in any map of `SkyMap`, which does
everything else.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import Field, PrivateAttr

from zonda.core.configuration.files import InputPath
from zonda.core.data import Data
from zonda.core.numerics.random import normals, stream_key
from zonda.core.observation import Observation
from zonda.core.types import Floats

from .full_sky import FullSky, Nside
from .scan_sampler import ScanSampler
from .skymap import SkyMap
from .spectrum_file import Scaling, Spectrum, Unit, read


class CMBSky(FullSky):
    """Cosmic microwave background, a Gaussian field of given power spectra: part of the component
    ``sky``.

    No spectrum comes with zonda: give a file of a theory code. With TT alone it is not polarized.
    """

    spectrum: InputPath
    """Text: columns l, TT or l, TT, EE, BB, TE, as l (l + 1) C_l / (2 pi) in uK^2; # begins a
    remark. A remark that names columns (CAMB's, CLASS's, Planck's) or their unit is heeded."""
    columns: str | None = None
    """Columns behind l, e.g. `TT, EE, TE, BB`. Default: those of the file's heading, else by their
    number.
    """
    unit: Unit | None = None
    """Unit of the columns: `uK^2`, `K^2` or `dimensionless` (CLASS's default). Default: the file's,
    else uK^2; refused where the sky is then no CMB."""
    scaling: Scaling | None = None
    """Factor on C_l in the columns, or `none`. Default: l (l + 1) / (2 pi), and refused where the
    shape is that of C_l.
    """
    nside: Nside = 2048
    """Of the HEALPix map that is drawn; a pixel should be smaller than half of the beam."""
    realization: int | None = Field(None, ge=0)
    """Number of the sky: the same for every seed. Where absent the seed draws it, and in a campaign
    every entry has another.
    """

    _skies: dict[tuple[int, bool], tuple[SkyMap, float]] = PrivateAttr(default_factory=dict)

    def check(self, data: Data) -> list[str]:
        """Up to which multipole the spectrum reaches; raises InputError where it is wrong."""
        found = self.read()
        return [
            (
                f"{self.spectrum} reaches multipole {found.values.shape[1] - 1}, rms"
                f" {1e6 * found.rms:.4g} uK_CMB before the beam"
            ),
            f"its columns: {found.text}",
        ]

    def read(self) -> Spectrum:
        """The spectra of the file. Raises InputError as `spectrum_file.read`."""
        columns = [name for name in (self.columns or "").replace(",", " ").split() if name]
        return read(str(self.spectrum), self.unit, self.scaling, columns)

    def prepare(self, observation: Observation) -> tuple[SkyMap, ScanSampler]:
        """The step that samples the map, and what that one knows of the scan."""
        sky, rms = self.sky(observation.seed, observation.focalplane.polarized)
        observation.log.state(self.label, "spectrum", self.read().text)
        observation.log.state(
            self.label,
            "rms of the sky before the beam",
            f"{1e6 * rms:.4g} uK_CMB, nside {self.nside}",
        )
        return sky, sky.prepare(observation)

    def sky(self, seed: int, polarized: bool) -> tuple[SkyMap, float]:
        """The step that samples the map of a seed, and the map's rms, K_CMB; I alone where
        detectors are not ``polarized``.
        """
        number = seed if self.realization is None else self.realization
        if (number, polarized) not in self._skies:
            spectra = self.read().values
            maps = draw(
                spectra if polarized else spectra[:1],
                self.nside,
                stream_key(number, "CMBSky", self.label),
            )
            self._skies.clear()
            self._skies[number, polarized] = (
                self.sampler(maps, "K_CMB", "C"),
                float(np.std(maps[0])),
            )
        return self._skies[number, polarized]


def draw(spectra: Floats, nside: int, key: Any) -> Floats:
    """Equation (1): maps (1 or 3, n_pix) of I, or I, Q and U in COSMO's convention, K_CMB, ring
    order.

    ``spectra``: TT, EE, BB, TE, or TT alone.
    """
    import healpy

    lmax = min(spectra.shape[1] - 1, 3 * nside - 1)
    ell, m = healpy.Alm.getlm(lmax)
    number = ell * (ell + 1) // 2 + m
    tt, *others = spectra[:, : lmax + 1]

    def deviates(stream: int) -> Any:
        pairs = (
            normals(key, 0, (lmax + 1) * (lmax + 2), stream=stream)
            .astype(np.float64)
            .reshape(-1, 2)[number]
        )
        return np.where(m == 0, pairs[:, 0], (pairs[:, 0] + 1j * pairs[:, 1]) / np.sqrt(2))

    first = deviates(0)
    root = np.sqrt(tt)
    intensity = root[ell] * first
    if not any(power.any() for power in others):
        return np.asarray(healpy.alm2map(intensity, nside, lmax=lmax), np.float64)[None]
    ee, bb, te = others
    with np.errstate(divide="ignore", invalid="ignore"):
        shared = np.where(tt > 0, te / root, 0.0)
    own = np.sqrt(np.maximum(ee - shared**2, 0.0))
    polarized = [shared[ell] * first + own[ell] * deviates(1), np.sqrt(bb)[ell] * deviates(2)]
    return np.asarray(
        healpy.alm2map([intensity, *polarized], nside, lmax=lmax, pol=True), np.float64
    )
