"""The built-in metrics of `zonda accuracy`: equations (1) to (5).

m is a run's, m0 that of the tightest setting with the same random numbers. Of a map of I, Q and U,
(1) to (3) are taken of each plane, and the largest counts.

``map_rms``, the rms of the difference map in units of the map's own noise (pixels with hits in
both; weights w and instrument noise n of the reference; the rms of m0 itself where the noise is not
known):

    E = sqrt( sum w (m - m0)^2 / sum w n^2 )                                                     (1)

It bounds the change of the map's rms, because | |m| - |m0| | <= |m - m0| for every norm.

``peak``, the extreme value p of the beam-smoothed map, of the sky alone where a signal keeps only
that, among pixels with at least `COVERED` of the usual coverage (of Q and U its absolute value,
where it is more than `POLARIZED` of that of I):

    E = |p - p0| / |p0|                                                                          (2)

``transfer``, the share T of each angular scale of the input map a (convolved with the beam, under
the window of the coverage) that is left in the map b of the sky alone, as `TransferFunction`
measures it; rings i of equal width in log k, from the map's extent to the beam, that hold power (of
Q and U where the input map has them):

    T_i = Re sum_ring b a* / sum_ring |a|^2,
    E = sqrt( mean_i (T_i - T0_i)^2 )                         (3)

``psd``, the mean power spectrum P of the signal as `PowerSpectrum` measures it, in `BINS` bins j of
equal width in log f:

    E = sqrt( mean_j (P_j / P0_j - 1)^2 )                                                        (4)

``structure``, the structure functions of the atmosphere's fluctuation s at `TRACED` detectors of
the first scan, in time (lags) and between detectors (bins of separation), all in one list of values
D:

    D = < (s(t + lag) - s(t))^2 >  and  < (s_i(t) - s_j(t))^2 >,
    E = sqrt( mean (D / D0 - 1)^2 )       (5)

Each of N differences d measured through white noise of rms n per sample has the square (d + sqrt(2)
n g)^2, g a standard normal, of variance 8 n^4 + 8 n^2 D where d is given, so that D, its 2 n^2
taken off, is known to within

    sqrt( (8 n^4 + 8 n^2 D) / N )                                                                (6)
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from zonda.core.accuracy.metrics import Metric, OfParts
from zonda.core.data import Data
from zonda.core.errors import InputError
from zonda.core.maps.image import Image
from zonda.core.maps.map_product import MapProduct
from zonda.core.numerics.projection import wcs_frame_rotation
from zonda.core.operator import Operator
from zonda.core.signal import Signal
from zonda.core.types import Bools, Floats
from zonda.operators.diagnostics.series import Spectrum, TimeStreams
from zonda.operators.diagnostics.transfer_function import compare

from .common import COVERED, as_seen, at_beam, covered, extreme, input_of, needs_tan

RINGS = 8
BINS = 24
LAGS = 12
SEPARATIONS = 6
POLARIZED = 1e-3
"""Of the extreme value of I: below it that of Q or U is taken as zero, which has no relative error.
"""
TRACED = 64
"""Detectors whose atmosphere is kept for the structure functions."""
INSTANTS = 4096
"""Instants at which pairs of detectors are compared."""
TRACE = "accuracy-structure"


class MapRms(OfParts):
    """Rms of the difference from the reference map over the map's noise, equation (1)."""

    says = "rms of the difference map / the map's instrument noise"
    reads = frozenset({"map"})
    instead = "measure central_rms, or name map_rms in zonda accuracy --metric"

    def measure(self, data: Data) -> dict[str, dict[str, Floats]]:
        return {
            plane: {"signal": one.signal, "weights": one.weights, "noise": one.noise}
            for plane, one in _map(data).by_stokes().items()
        }

    def between(self, found: dict[str, Floats], reference: dict[str, Floats]) -> float:
        if found["signal"].shape != reference["signal"].shape:
            cure = "fix the map: set BinMap.width and BinMap.centre"
            raise InputError("the map's size depends on the knobs", place="map_rms", cure=cure)
        known = np.isfinite(found["signal"]) & np.isfinite(reference["signal"])
        change = found["signal"] - reference["signal"]
        difference = _mean_square(change, reference["weights"], known)
        return math.sqrt(difference / self._unit(reference)) if difference else 0.0

    def summary(self, found: dict[str, Floats]) -> Floats:
        """The map's rms in units of its noise."""
        signal = found["signal"]
        square = _mean_square(signal, found["weights"], np.isfinite(signal))
        return np.array([math.sqrt(square / self._unit(found))])

    def floor_of(self, reference: dict[str, Floats]) -> float | None:
        """1, where the map knows its noise."""
        return 1.0 if np.isfinite(reference["noise"]).any() else None

    def _unit(self, of: dict[str, Floats]) -> float:
        known = np.isfinite(of["noise"]) & np.isfinite(of["signal"])
        values = of["noise"] if known.any() else of["signal"]
        return _mean_square(values, of["weights"], np.isfinite(values)) or 1.0


class Peak(OfParts):
    """Relative change of the extreme value of the beam-smoothed map, equation (2)."""

    says = "relative change of the beam-smoothed map's extreme value"
    reads = frozenset({"map"})
    instead = "measure peak_ratio or peak_snr, or name peak in zonda accuracy --metric"

    def measure(self, data: Data) -> dict[str, Floats]:
        main = _map(data)
        sky = _map(data, _sky_alone(data.provenance.get("runs", {})))
        noises = at_beam(main).by_stokes()
        found = {}
        for plane, smooth in at_beam(sky).by_stokes().items():
            where, peak = extreme(smooth.signal, covered(smooth), "peak")
            size = peak if plane == "I" else abs(peak)
            found[plane] = np.array([size, noises[plane].noise.flat[where]])
        return found

    def counted(self, reference: Mapping[str, Floats]) -> list[str]:
        """I, and Q and U that are more than next to nothing in the reference, whatever is left of
        them.
        """
        return [
            plane
            for plane, one in reference.items()
            if plane == "I" or one[0] > POLARIZED * abs(reference["I"][0])
        ]

    def summary(self, found: Floats) -> Floats:
        return found[:1]

    def floor_of(self, reference: Floats) -> float | None:
        """The smoothed map's instrument noise at the peak."""
        value = abs(reference[1] / reference[0]) if reference[0] else math.nan
        return float(value) if math.isfinite(value) else None


class Transfer(OfParts):
    """Rms error of the transfer function over angular scales, equation (3)."""

    says = (
        "rms error of the transfer function over angular scales (absolute; it is 1 where nothing is"
        " lost)"
    )
    reads = frozenset({"map", "sky"})
    instead = "measure transfer_at, or name transfer in zonda accuracy --metric"

    def signals(self, runs: Mapping[str, Signal]) -> Mapping[str, Signal]:
        """The sky alone, where the pipeline has no such signal."""
        alone = any(run.only == ["sky"] for run in runs.values())
        return {} if alone else {"sky_alone": Signal(only=["sky"])}

    def measure(self, data: Data) -> dict[str, Floats]:
        """Transfer (2, n) by plane: T_i, and its standard deviation from the instrument's noise in
        the main map.
        """
        sky = _map(data, _sky_alone(data.provenance.get("runs", {})))
        main = _map(data)
        needs_tan(sky.projection, "transfer")
        image = input_of(data, "transfer")
        window = sky.known_hits / np.percentile(sky.hits[sky.known], 99)
        window = np.where(window >= COVERED, np.minimum(window, 1.0), 0.0)
        side = np.array(window.shape) * sky.pixel
        edges = np.geomspace(1 / side.min(), 1 / max(sky.fwhm, 2 * sky.pixel), RINGS + 1)
        noises = main.by_stokes()
        found = {}
        pole = wcs_frame_rotation(sky.wcs)[2]
        for plane, one in sky.by_stokes().items():
            given: Image | None = image
            if plane != "I":
                given = None if image.polarization is None else image.stokes(plane, pole)
            if given is None or not np.nan_to_num(given.values).any():
                continue
            # variance of each mode
            noise = float((window**2 * np.nan_to_num(noises[plane].noise) ** 2).sum())
            rings = compare(as_seen(given, one), one.signal, window, sky.pixel, edges)
            use = rings.power > 1e-6 * rings.power.max()
            found[plane] = np.array([rings.transfer[use], np.sqrt(noise / 2 / rings.power[use])])
        if not found:
            cure = "use a sky with a source"
            raise InputError("the input map is zero everywhere", place="transfer", cure=cure)
        return found

    def between(self, found: Floats, reference: Floats) -> float:
        return float(np.sqrt(np.mean((found[0] - reference[0]) ** 2)))

    def summary(self, found: Floats) -> Floats:
        return np.asarray(found[0], np.float64)

    def floor_of(self, reference: Floats) -> float | None:
        return float(np.sqrt(np.mean(reference[1] ** 2)))


class _Binned(Metric):
    """Metric in bins: (2, n) values and their relative standard errors."""

    def error(self, found: Floats, reference: Floats) -> float:
        return float(np.sqrt(np.mean((found[0] / reference[0] - 1) ** 2)))

    def summary(self, found: Floats) -> Floats:
        """The logarithm of the values: differences of it are relative."""
        return np.asarray(np.log(np.maximum(found[0], 1e-300)), np.float64)

    def floor(self, reference: Floats) -> float | None:
        """The standard errors, from periodograms averaged or from white noise; None where they are
        not known.
        """
        value = float(np.sqrt(np.mean(reference[1] ** 2)))
        return value if math.isfinite(value) else None


class Psd(_Binned):
    """Rms relative error of the signal's power spectrum, equation (4)."""

    says = "rms over log-frequency bins of the relative error of the signal's power spectrum"
    reads = frozenset({"spectrum"})
    instead = "measure psd_slope or crossing, or name psd in zonda accuracy --metric"

    def measure(self, data: Data) -> Floats:
        """(2, n): P_j, and its relative standard error."""
        every = (p for p in data.products.values() if isinstance(p, Spectrum))
        spectrum = next((p for p in every if "signal" in p.psd), None)
        if spectrum is None:
            cure = "let PowerSpectrum.streams include signal"
            raise InputError("no spectrum of the signal was measured", place="psd", cure=cure)
        f = spectrum.frequency
        number = np.clip((BINS * np.log(f / f[0]) / np.log(f[-1] / f[0])).astype(int), 0, BINS - 1)
        count = np.bincount(number, minlength=BINS)
        mean = np.bincount(number, spectrum.psd["signal"], BINS)[count > 0] / count[count > 0]
        return np.array([mean, 1 / np.sqrt(spectrum.averages * count[count > 0])])


class Structure(_Binned):
    """Equation (5). It keeps the atmosphere's stream, and the white noise, at some detectors by a
    step of its own.
    """

    says = "rms relative error of the atmosphere's structure functions in time and across the field"
    reads = frozenset({"atmosphere", "signal"})
    instead = "name structure in zonda accuracy --metric"

    def steps(self, operators: list[Operator]) -> list[Operator]:
        """The steps with a `TimeStreams` of the atmosphere, and of the noise, behind the one that
        forms the signal.
        """
        at = next(k for k, o in enumerate(operators) if "signal" in o.provides) + 1
        noisy = any("white" in o.provides for o in operators[:at])
        streams = ["atmosphere", "white"] if noisy else ["atmosphere"]
        trace = TimeStreams(name=TRACE, streams=streams, detectors=TRACED)
        return [*operators[:at], trace, *operators[at:]]

    def measure(self, data: Data) -> Floats:
        """(2, n): D, and its relative standard error from the white noise of those detectors (NaN
        where there is none).
        """
        trace = data.products[TRACE]
        observation = data.observations[0]
        s: Floats = trace.streams["atmosphere"]
        n = s.shape[1]
        lags = np.unique(np.geomspace(1, max(1, n // 4), LAGS).astype(int))
        lags = lags[lags < n]
        in_time = np.array([float(np.mean((s[:, lag:] - s[:, :-lag]) ** 2)) for lag in lags])
        index = [observation.focalplane.names.index(name) for name in trace.names]
        plane = observation.focalplane
        noise = math.nan  # of one sample, in kelvins of the atmosphere
        if "white" in trace.streams:
            epsilon = plane.illumination_efficiency[index].mean()
            noise = float(trace.streams["white"].std() / epsilon)
        pairs = len(index) * (n - lags) / 2  # increments that overlap share a sample
        xi = plane.xi[index]
        eta = plane.eta[index]
        i, j = np.triu_indices(len(index), 1)
        if not i.size:
            return np.array([in_time, _uncertain(in_time, noise, pairs)])
        distance = np.hypot(xi[i] - xi[j], eta[i] - eta[j])
        seen = s[:, :: max(1, n // INSTANTS)]
        squares = np.array([np.mean((seen[a] - seen[b]) ** 2) for a, b in zip(i, j, strict=True)])
        edges = np.quantile(distance, np.linspace(0, 1, SEPARATIONS + 1))
        number = np.clip(np.searchsorted(edges, distance, "right") - 1, 0, SEPARATIONS - 1)
        count = np.bincount(number, minlength=SEPARATIONS)
        across = np.bincount(number, squares, SEPARATIONS)[count > 0] / count[count > 0]
        # a bin's pairs share detectors: no more of them are independent than there are detectors
        number = np.minimum(count[count > 0], len(index) / 2)
        pairs = np.concatenate([pairs, number * seen.shape[1]])
        d = np.concatenate([in_time, across])
        return np.array([d, _uncertain(d, noise, pairs)])


def _uncertain(d: Floats, noise: float, pairs: Floats) -> Floats:
    """Relative standard error of D from N differences that carry white noise of the given rms,
    equation (6).
    """
    error = np.sqrt((8 * noise**4 + 8 * noise**2 * d) / pairs)
    return error / np.maximum(d, 1e-300)


def _mean_square(values: Floats, weights: Floats, use: Bools) -> float:
    total = float(weights[use].sum())
    return float((weights[use] * values[use] ** 2).sum() / total) if total > 0 else 0.0


def _map(data: Data, run: str = "") -> MapProduct:
    """The first map of a signal; ``run`` empty: the complete one."""
    for name, product in data.products.items():
        if isinstance(product, MapProduct) and name.rpartition("/")[0] == run:
            return product
    cure = "add `- BinMap` to the operators"
    raise InputError(f"the run {run or 'itself'} made no map", place="--metric", cure=cure)


def _sky_alone(runs: Mapping[str, Any]) -> str:
    """Name of the signal that keeps the sky alone; empty (the complete one) where there is none."""
    return next((name for name, run in runs.items() if run.get("only") == ["sky"]), "")
