"""Noise models of TOAST's HDF5 files (`toast.noise.Noise`): white level, knee and slope of their
power spectra.
"""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np

from zonda.core.configuration.units import factor_to
from zonda.core.errors import InputError
from zonda.core.storage.hdf5_files import check_size
from zonda.core.types import Bools, Floats

DEFAULT_MODEL = "noise_model"
"""Name of the noise model that TOAST's operators make and read where no other is asked for."""

NOISE_CURE = "save the file again with TOAST 3.0 or later, or estimate the noise: zonda noise FILE"

RISE = 1.5
"""Power over the white level from which there is 1/f noise."""

STEEPEST = 4.0

BINS = 400
"""Frequencies that a spectrum is fitted at, at most."""


def models(file: Any) -> list[str]:
    """The names of the noise models in an open HDF5 file."""
    found = file["metadata"].items() if "metadata" in file else ()
    return [name for name, item in found if "mixing_matrix" in item and "psd_units" in item.attrs]


def columns_of_model(
    group: Any,
    detectors: list[str],
    unused: Bools,
    place: str,
) -> dict[str, Floats]:
    """NET [K sqrt(s)], knee, minimum_frequency [Hz] and slope (n_det,) of the spectra of an open
    noise model.

    The spectrum of a detector is the sum of those that TOAST mixes for it, times their weights
    squared. Of an ``unused`` detector (n_det,) they are NaN.

    Raises
    ------
    InputError
        A detector has no spectrum, or one that is not positive, finite and in kelvin^2 s.
    """
    spectra = _spectra(group, place)
    mixed = defaultdict[str, dict[str, float]](dict)
    for detector, key, weight in group["mixing_matrix"][:]:
        mixed[detector.decode()][key.decode()] = float(weight)
    found = np.full((4, len(detectors)), np.nan)
    known = dict[bytes, Floats]()
    for number in np.flatnonzero(~unused).tolist():
        detector = detectors[number]
        parts = {key: weight for key, weight in mixed[detector].items() if weight != 0}
        if not parts or not parts.keys() <= spectra.keys():
            raise InputError(
                f"{group.name} has no spectrum of detector {detector}",
                place=place,
                cure=NOISE_CURE,
            )
        frequency = spectra[next(iter(parts))][0]
        total = np.array([w**2 * np.interp(frequency, *spectra[k]) for k, w in parts.items()])
        digest = frequency.tobytes() + total.tobytes()
        if digest not in known:
            text = f"{place}, {group.name}, detector {detector}"
            known[digest] = fit(frequency, total.sum(axis=0), text)
        found[:, number] = known[digest]
    return dict(zip(("net", "knee", "minimum_frequency", "slope"), found, strict=True))


def _spectra(group: Any, place: str) -> dict[str, tuple[Floats, Floats]]:
    """Frequencies [Hz], without zero, and power spectral densities [K^2 s] by key.

    There is one data set for each set of frequencies.
    """
    unit = str(group.attrs["psd_units"])
    if (factor := factor_to("K2 s", unit)) is None:
        text = f"{group.name} has spectra in {unit!r}, not in K2 s"
        cure = "calibrate to kelvin, or estimate the noise: zonda noise FILE"
        raise InputError(text, place=place, cure=cure)
    found = {}
    for name in group:
        if f"{name}_keys" in group:
            check_size(group[name], place)
            rows = np.asarray(group[name][:], np.float64)
            use = rows[0] > 0
            for key, row in zip(group[f"{name}_keys"][:], rows[1:], strict=True):
                found[key.decode()] = rows[0][use], factor * row[use]
    return found


def fit(frequency: Floats, power: Floats, place: str) -> Floats:
    """NET, knee, minimum frequency and slope of a spectrum.

    That of TOAST's form (toast.noise_sim.AnalyticNoise) or of zonda's, whichever comes nearer,

        P(f) = NET^2 (f^a + knee^a) / (f^a + f_min^a),
        P(f) = NET^2 (1 + (knee / max(f, f_min))^a),

    fitted to ln P, each frequency with the share of ln f that it stands for; of many frequencies,
    means in bins of ln f. The knee is 0 where nothing rises above the white level.

    Raises InputError for a spectrum that is not positive and finite.
    """
    from scipy.optimize import least_squares

    sound = len(frequency) >= 4 and np.isfinite(power).all() and (power > 0).all()
    if not sound or (np.diff(frequency) <= 0).any():
        raise InputError(
            "has a spectrum that is not positive and finite",
            place=place,
            cure=NOISE_CURE,
        )
    x, y = np.log(frequency), np.log(power)
    if len(x) > BINS:
        count, xs, powers = (np.histogram(x, BINS, weights=w)[0] for w in (None, x, power))
        some = count > 0
        x, y = xs[some] / count[some], np.log(powers[some] / count[some])
    share = np.sqrt(np.gradient(x))

    def toast(level: Any, knee: Any, low: Any, slope: Any) -> Any:
        return level + np.logaddexp(slope * x, slope * knee) - np.logaddexp(slope * x, slope * low)

    def own(level: Any, knee: Any, low: Any, slope: Any) -> Any:
        return level + np.logaddexp(0.0, slope * (knee - np.maximum(x, low)))

    white = float(np.median(y[x > x[-1] - 1.0]))
    knee = x[y > white + np.log(2.0)].max(initial=x[0])
    limits = [white - 5, x[0] - 20, x[0] - 20, 0.05], [white + 5, x[-1] + 5, x[-1], STEEPEST]

    def away(p: Any, form: Any) -> Any:
        return share * (form(*p) - y)

    tried = [
        least_squares(
            away,
            np.clip([white, knee, min(low, knee - 0.1), slope], *limits),
            args=(form,),
            bounds=limits,
        )
        for form in (toast, own)
        for low in (x[0] - 5.0, x[0] + 1.0)
        for slope in (1.0, 2.0)
    ]
    level, knee, low, slope = min(tried, key=lambda one: float(one.cost)).x
    low = max(low, x[0])
    if slope * (knee - low) < np.log(RISE):
        level, knee, low, slope = np.array([white, -np.inf, x[0], 1.0])
    return np.array([*np.exp([level / 2, knee, low]), slope])
