"""The cosmic microwave background, drawn from its power spectra, and the files of these.

    a^T = sqrt(C^TT) g_T,   a^E = C^TE / sqrt(C^TT) g_T + sqrt(C^EE - (C^TE)^2 / C^TT) g_E,
    a^B = sqrt(C^BB) g_B,   (1)

for every l and m, g complex normal deviates of unit variance (real for m = 0); healpy makes maps of
them (Gorski et al. 2005). A deviate belongs to its l and m, so that another `nside` shows the same
sky with more or less detail. K_CMB become K_RJ over the band as in any map of `SkyMap`, which does
everything else.

Files of power spectra say in comments above the numbers which columns they have, in which unit,
with which factor. CAMB writes l, TT, EE, BB, TE as l (l + 1) C_l / (2 pi) in uK^2; CLASS l, TT, EE,
TE, BB without dimension (of Delta T / T), or with ``format = camb`` as CAMB; Planck's likelihood l,
TT, TE, EE, BB, PP.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, PrivateAttr

from zonda.core.configuration.input_paths import InputPath
from zonda.core.data import Data, Observation
from zonda.core.errors import InputError
from zonda.core.numerics.radiation import T_CMB
from zonda.core.numerics.random import normals, stream_key
from zonda.core.storage.table_files import NUMBERED, read_table
from zonda.core.types import Floats

from .skymap import FullSky, Nside, ScanSampler, SkyMap

Unit = Literal["uK^2", "K^2", "dimensionless"]
Scaling = Literal["l(l+1)/2pi", "none"]

HIGHEST = 30_000
"""Multipole above which a spectrum is not read."""
READ = ("TT", "EE", "BB", "TE")
BY_NUMBER: dict[int, tuple[str, ...]] = {1: ("TT",), 4: READ}
"""Columns behind l where no heading names them."""
FACTORS: dict[Unit, float] = {"uK^2": 1e-12, "K^2": 1.0, "dimensionless": T_CMB**2}
"""K^2 per unit."""
PLAUSIBLE = 1.0, 3000.0
"""uK: limits of the rms of a CMB sky, which is 110 uK for all multipoles and 30 uK for the first
few.
"""
FALLS = 0.1
"""Least ratio of l (l + 1) C_l about l = 200 to that about l = 15. The CMB has 5; 0.03 is found
where the column holds C_l itself.
"""
CURE = (
    "give columns of text: l, TT or l, TT, EE, BB, TE, as l (l + 1) C_l / (2 pi) in uK^2 (as CAMB"
    " writes them)"
)


@dataclass(frozen=True)
class Spectrum:
    """Power spectra C_l of the CMB (TT, EE, BB, TE) that a file holds.

    Attributes
    ----------
    values
        C_l [K^2], (4, lmax + 1): TT, EE, BB, TE from l = 0; zero where the file has none.
    text
        Columns, unit and factor as they were read.
    """

    values: Floats
    text: str

    @property
    def rms(self) -> float:
        """Rms of the intensity, K."""
        ell = np.arange(self.values.shape[1])
        return float(np.sqrt(((2 * ell + 1) * self.values[0])[2:].sum() / (4 * np.pi)))


def read(
    place: str,
    unit: Unit | None = None,
    scaling: Scaling | None = None,
    columns: Sequence[str] = (),
) -> Spectrum:
    """Read a file of spectra. ``unit``, ``scaling`` and ``columns`` (behind l) stand above what its
    comments say.

    Raises
    ------
    InputError
        It is no table of rising multipoles without gaps; columns that no heading names; no sky has
        these spectra; the rms of the sky is not `PLAUSIBLE`, or the spectrum falls as C_l does,
        where no ``unit`` or ``scaling`` says so.
    """
    given = read_table(Path(place), place, names=NUMBERED)
    for name in given.columns:
        given.note_rows(
            ~np.isfinite(given.values(name)),
            f"has no number in column {name}",
            f"mend that row; {CURE}",
        )
    given.check()
    table = np.stack([given.values(name) for name in given.columns], axis=1)
    comments = [line.lstrip("! ") for line in given.meta.get("comments", ())]
    comments.append(" ".join(name.replace(" ", "_") for name in given.columns))
    units = [unit for _, unit in given.columns.values()]
    ell = table[:, 0]
    stated = " ".join([*comments, *units]).lower()
    rising = (ell == np.round(ell)).all() and (np.diff(ell) > 0).all()
    for wrong, text in (
        (table.shape[1] < 2, "has one column"),
        (
            not (rising and ell[0] >= 0 and ell[-1] <= HIGHEST),
            f"the first column is no rising series of multipoles up to {HIGHEST}",
        ),
        (
            ell[-1] - max(ell[0], 2) + 1 != np.count_nonzero(ell >= 2),
            "multipoles are missing between the first and the last",
        ),
    ):
        if wrong:
            raise InputError(text, place=place, cure=CURE)
    names, named = _names(table.shape[1] - 1, comments, columns, place)
    found_unit: Unit = unit or _unit_of(stated) or "uK^2"
    plain = (scaling or _scaling_of(stated)) == "none"
    values = np.zeros((4, int(ell[-1]) + 1))
    flat = np.ones(len(ell))
    if not plain:
        flat = np.where(ell > 0, 2 * np.pi / np.maximum(ell * (ell + 1), 1), 0.0)
    for name, powers in zip(names, table.T[1:], strict=True):
        if name in READ:
            values[READ.index(name), ell.astype(int)] = powers * flat * FACTORS[found_unit]
    if plain:
        values[:, :2] = 0.0  # monopole and dipole
    tt, ee, _, te = values
    if values[:3].min() < 0 or (te**2 > tt * ee * (1 + 1e-6)).any():
        text = "no sky has this spectrum: TT, EE or BB is negative, or TE^2 exceeds TT EE"
        raise InputError(text, place=place, cure=CURE)
    used, unused = ([n for n in names if (n in READ) is read] for read in (True, False))
    text = f"{', '.join(used)} ({named}) as {'C_l' if plain else 'l (l + 1) C_l / 2 pi'}"
    text += f" in {found_unit}" + (f"; not used: {', '.join(unused)}" if unused else "")
    found = Spectrum(values, text)
    if unit is None:
        _check_rms(found, found_unit, place)
    if scaling is None:
        _check_shape(tt, place)
    return found


def _names(
    number: int,
    comments: Sequence[str],
    given: Sequence[str],
    place: str,
) -> tuple[list[str], str]:
    """Names of the columns behind l, and who says so."""
    names = [_plain(name) for name in given]
    who = "as given"
    if not names:
        headings = [names for line in comments if len(names := _heading(line)) == number]
        names = list(BY_NUMBER.get(number, ()))
        who = "by their number"
        if headings:
            names = headings[-1]
            who = "by the file's heading"
    if len(names) != number or "TT" not in names or len(set(names)) < number:
        cure = f"set columns to the names of those behind l, e.g. columns: TT, EE, TE, BB; {CURE}"
        told = f"columns names {', '.join(names)}" if given else "no heading names them"
        raise InputError(f"has {number + 1} columns, and {told}", place=place, cure=cure)
    return names, who


def _heading(line: str) -> list[str]:
    """Names behind l of a line such as ``L TT EE`` or ``1:l 2:TT 3:EE``; empty where it is none."""
    words = [re.sub(r"^\d+:", "", word) for word in re.split(r"[\s,]+", line.strip())]
    return [_plain(w) for w in words[1:]] if words[0].lower() in ("l", "ell", "multipole") else []


def _plain(name: str) -> str:
    """``TT`` of TT, dl_tt, CL_TT, D_ell^TT; ``TE`` of ET."""
    plain = re.sub(r"^(D|C)_?(L|ELL)?[_^]*", "", name.strip().upper()) or name.strip().upper()
    return {"ET": "TE", "T": "TT", "E": "EE", "B": "BB", "": "TT"}.get(plain, plain)


def _unit_of(stated: str) -> Unit | None:
    """Unit that comments state."""
    if re.search(r"(micro|mu|\bu|\N{MICRO SIGN}|\N{GREEK SMALL LETTER MU})\s*-?k", stated):
        return "uK^2"
    return "dimensionless" if "dimensionless" in stated else None


def _scaling_of(stated: str) -> Scaling | None:
    """Factor that comments state."""
    return "l(l+1)/2pi" if re.search(r"l\s*\*?\s*\(\s*l\s*\+\s*1\s*\)", stated) else None


def _check_rms(found: Spectrum, unit: Unit, place: str) -> None:
    """Raise InputError if the rms is not plausible, and name units in which it is."""
    least, most = PLAUSIBLE
    rms = {name: 1e6 * found.rms * (f / FACTORS[unit]) ** 0.5 for name, f in FACTORS.items()}
    if rms[unit] == 0.0 or least <= rms[unit] <= most:
        return
    right = [f"{name} (rms {r:.3g} uK)" for name, r in rms.items() if least <= r <= most]
    cure = f"set unit: {' or '.join(right)}"
    if not right:
        cure = "set unit to uK^2, K^2 or dimensionless, if that is what is meant"
    text = f"a sky of this spectrum, taken in {unit}, has an rms of {rms[unit]:.3g} uK"
    raise InputError(f"{text}, and the CMB about 100 uK", place=place, cure=cure)


def _check_shape(tt: Floats, place: str) -> None:
    """Raise InputError if C_l itself stands in the column."""
    if len(tt) <= 300:
        return
    ell = np.arange(len(tt))
    power = ell * (ell + 1) * tt
    low = power[10:21].mean()
    high = power[150:301].mean()
    if low > 0 and high < FALLS * low:
        factor = f"{low / max(high, 1e-300):.3g}"
        raise InputError(
            f"l (l + 1) C_l falls from l = 15 to 200 by a factor of {factor}, where that of the CMB"
            " rises",
            place=place,
            cure=(
                "set scaling: none where the columns are C_l, or scaling: l(l+1)/2pi where they are"
                " as stated"
            ),
        )


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
        """The spectra of the file. Raises InputError as the function `read`."""
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
        healpy.alm2map([intensity, *polarized], nside, lmax=lmax, pol=True),
        np.float64,
    )
