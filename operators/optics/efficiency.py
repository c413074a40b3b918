"""From brightness on the sky to the calibrated scan: telescope efficiencies, opacity and
calibration.

    T_scan = (epsilon T_atm + zeta e^-tau T_astro + T_white + T_pink) / (zeta <e^-tau>)          (1)

(van Marrewijk, Morris et al. 2024). With t = <e^-tau> the smooth band transmission, e^-tau = t (1 +
x) and T_atm = E + A, mean emission and fluctuation, equation (1) reads

    T_scan = T_astro (1 + x) + (epsilon A + T_white + T_pink) / (zeta t) + M,
    M = epsilon E / (zeta t).     (2)

M, tens of kelvin, stays beside the stream as a float64 `SmoothField`; everything else is the stream
``signal``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from pydantic import Field

from zonda.core import flags
from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Fraction
from zonda.core.data import Block, Observation
from zonda.core.errors import PipelineError
from zonda.core.kernels import contracted
from zonda.core.numerics.chunks import chunks
from zonda.core.numerics.radiation import LEAST_TRANSMISSION
from zonda.core.numerics.random import normals
from zonda.core.numerics.smooth import FieldSums, Series, SmoothField, series_into
from zonda.core.operator import Operator
from zonda.core.types import AnyFloats, Floats

from .field_ratio import AT_ONCE, field_ratio, knots_of

KNOWN = frozenset({"atmosphere", "transmission", "white", "pink"})
"""Components at the detector that equation (1) names."""


class Efficiency(Operator):
    """Telescope efficiencies, opacity and calibration, equation (1): forms ``signal`` from the
    components.
    """

    provides = frozenset({"signal"})
    knows_means = True
    linear = True
    optional = frozenset({"sky", "atmosphere", "transmission", "white", "pink"})

    main_beam: Fraction | None = Field(None, gt=0, le=1, examples=["0.6"])
    """zeta, the share of an astronomical signal that the main beam delivers; where absent, the
    instrument's.
    """
    illumination: Fraction | None = Field(None, gt=0, le=1, examples=["0.9"])
    """epsilon, the share of the atmosphere's emission that reaches a detector; where absent, the
    instrument's.
    """
    scatter: Fraction = quantity("0 %", ge=0, le=0.5, examples=["5 %"])
    """Relative rms of zeta between detectors (normal). The calibration knows it: the sky keeps its
    gain, and so does a NET quoted on the sky. The atmosphere's fluctuation, and noise given at the
    detector (`reference: detector`), vary as 1 / zeta."""
    calibration: Literal["mean", "instantaneous"] = "mean"
    """Divide by e^-tau at the mean PWV and current elevation, or by the fluctuating e^-tau."""
    calibration_error: Fraction = quantity("0 %", ge=0, le=0.5, examples=["5 %"])
    """Relative rms of an unknown gain error per detector (normal), constant over a scan."""

    def configure(self, observation: Observation) -> None:
        """Write ``main_beam_efficiency`` and ``illumination_efficiency`` of the focal plane."""
        plane = observation.focalplane
        if self.illumination is not None:
            plane.illumination_efficiency = np.full(len(plane), self.illumination)
        if self.main_beam is not None:
            plane.main_beam_efficiency = np.full(len(plane), self.main_beam)
        if self.scatter > 0:
            self._scatter(observation)

    def prepare(self, observation: Observation) -> Calibration:
        """Coefficients of equation (2); flags what is opaque."""
        found = self._coefficients(observation)
        what = f"{found.zeta.mean():.4g}, {found.epsilon.mean():.4g}"
        observation.log.state(self.label, "zeta and epsilon (mean)", what)
        observation.log.state(self.label, "calibrated by", f"zeta e^-tau, {self.calibration}")
        return found

    def exec(self, block: Block, state: Calibration) -> None:
        """Equation (2) on one block."""
        if beside := sorted(self.optional & block.means.keys()):
            raise PipelineError(
                f"a mean stands beside {beside[0]} in block.means, which is not calibrated",
                place=self.label,
                cure=(
                    "let the step that makes it add the mean to the stream, or set"
                    " observation.smooth['atmosphere']"
                ),
            )
        instantaneous = self.calibration == "instantaneous" and "transmission" in block.detdata
        clipped = _make_signal(block, state, instantaneous)
        if instantaneous:
            what = f"samples whose fluctuating e^-tau was raised to {LEAST_TRANSMISSION:g}"
            block.observation.log.count(self.label, what, clipped)

    def _scatter(self, observation: Observation) -> None:
        """Scatter zeta."""
        plane = observation.focalplane
        nominal = plane.main_beam_efficiency
        if self.main_beam is None:  # from the instrument, so that configuring twice scatters once
            own = observation.instrument.focalplane()
            known = dict(zip(own.names, own.main_beam_efficiency, strict=True))
            nominal = np.array([known.get(d, z) for d, z in zip(plane.names, nominal, strict=True)])
        drawn = nominal * (1 + self.scatter * _normals(observation, self.label, "zeta"))
        plane.main_beam_efficiency = np.clip(drawn, 0.01 * nominal, 1.0)
        clipped = int(np.count_nonzero(plane.main_beam_efficiency != drawn))
        observation.log.count(self.label, "detectors whose scattered zeta was clipped", clipped)

    def _coefficients(self, observation: Observation) -> Calibration:
        zeta = observation.focalplane.main_beam_efficiency
        epsilon = observation.focalplane.illumination_efficiency
        gain = np.ones(len(zeta))
        transmission = observation.smooth.get("transmission")
        mean = None
        if self.calibration_error > 0:
            gain += self.calibration_error * _normals(observation, self.label, "gain")
        if transmission is not None:
            _flag_opaque(self.label, observation, transmission)
        if (ratio := observation.smooth.get("atmosphere")) is not None:
            share = gain * epsilon / zeta
            error = 0.0
            if transmission is not None:
                ratio, error = field_ratio(
                    ratio,
                    transmission,
                    np.flatnonzero(observation.good_detectors),
                )
            mean = ratio.scaled(share)
            text = f"{error * np.abs(share).max():.1e} K_RJ"
            observation.log.state(self.label, "largest error of the smooth mean emission", text)
        return Calibration(zeta, epsilon, gain, transmission, mean)


@dataclass(frozen=True)
class Calibration:
    """Factors of one observation per detector (n_det,), t and M of equation (2)."""

    zeta: Floats
    epsilon: Floats
    gain: Floats
    transmission: SmoothField | None
    mean: SmoothField | None
    means: FieldSums = field(default_factory=FieldSums)
    """M with the means of what enters calibrated."""


def _make_signal(block: Block, state: Calibration, instantaneous: bool) -> int:
    """Put the signal and its mean into a block. Returns how many samples of 1 + x were raised to
    `LEAST_TRANSMISSION`.
    """
    have = block.detdata
    signal = block.buffer("signal", block.shape)
    absent = np.empty((0, 0), block.dtype)
    divisor = level = Series(absent, 0, np.ones(1, block.dtype))
    mean = None if block.components and "atmosphere" not in block.components else state.mean
    sky = _sum(
        block,
        "sky",
        [n for n in block.entering("above the atmosphere") if n not in ("sky", "transmission")],
    )
    pink = _sum(block, "pink", [n for n in block.entering("at the detector") if n not in KNOWN])
    noisy = pink.size > 0 or any(name in have for name in ("atmosphere", "white"))
    if state.transmission is not None and noisy:
        divisor = state.transmission.series(block.detectors, block.samples, signal.dtype)
    if instantaneous and mean is not None:
        level = mean.series(block.detectors, block.samples, signal.dtype)
    streams = [
        sky,
        *(have.get(name, absent) for name in ("transmission", "atmosphere", "white")),
        pink,
    ]
    first = np.array([block.samples.start, divisor.first, level.first], np.int64)
    smooth = divisor.lines, divisor.inside, level.lines, level.inside
    factors = np.array(
        [a[block.detectors] for a in (state.gain, state.epsilon, state.zeta)],
        block.dtype,
    )
    if noisy or instantaneous:
        clipped = _calibrate(*streams, first, *smooth, factors, instantaneous, signal)
    else:
        clipped = _calibrate_sky(sky, streams[1], factors[0], signal)
    block.means.pop("signal", None)
    means = [] if mean is None else [mean]
    for name in block.entering("calibrated"):
        signal += have[name]
        means += [block.means[name]] if name in block.means else []
    have["signal"] = signal
    if means:
        block.means["signal"] = state.means.of(means)
    return int(clipped)


def _sum(block: Block, name: str, others: Sequence[str]) -> AnyFloats:
    """A stream and others that enter where it does; without rows where there are none."""
    names = [n for n in (name, *others) if n in block.detdata]
    if len(names) < 2:
        return block.detdata[names[0]] if names else np.empty((0, 0), block.dtype)
    total = block.buffer(f"{name} and others", block.shape)
    total[...] = block.detdata[names[0]]
    for other in names[1:]:
        total += block.detdata[other]
    return total


@contracted
def _calibrate_sky(sky, fluctuation, gain, out):  # type: ignore[no-untyped-def]
    """Equation (2) where there is nothing but the sky: the same bits in a third of the time."""
    one = out.dtype.type(1)
    for d in range(out.shape[0]):
        if not sky.shape[0]:
            out[d] = 0
        elif fluctuation.shape[0]:
            for t in range(out.shape[1]):
                out[d, t] = gain[d] * sky[d, t] * (one + fluctuation[d, t])
        else:
            for t in range(out.shape[1]):
                out[d, t] = gain[d] * sky[d, t]
    return 0


@contracted
def _calibrate(  # type: ignore[no-untyped-def]
    sky,
    fluctuation,
    emission,
    white,
    pink,
    first,
    divisor,
    inside,
    mean,
    mean_inside,
    factors,
    instantaneous,
    out,
):
    """Equation (2); absent streams have no rows. ``fluctuation`` is x; ``divisor``, t, and
    ``mean``, M, are lines of `Series`; ``first`` (3,): the first sample, and the first cells of t
    and M; ``factors`` (3, n_det): gain, epsilon, zeta. ``instantaneous``: calibrated by 1 + x too.

    Returns how many samples of 1 + x were raised to `LEAST_TRANSMISSION`.
    """
    gain, epsilon, zeta = factors[0], factors[1], factors[2]
    start, cell, mean_cell = first[0], first[1], first[2]
    n_det, n = out.shape
    clipped = 0
    one, opaque = out.dtype.type(1), out.dtype.type(LEAST_TRANSMISSION)
    noisy = emission.shape[0] or white.shape[0] or pink.shape[0]
    piece = 2048
    nothing, scale, level = (
        np.zeros(piece, out.dtype),
        np.empty(piece, out.dtype),
        np.zeros(piece, out.dtype),
    )
    for d in range(n_det):
        factor = gain[d] / zeta[d] if noisy else out.dtype.type(0)
        for begin in range(0, n, piece):
            m = min(piece, n - begin)
            s = sky[d, begin : begin + m] if sky.shape[0] else nothing[:m]
            x = fluctuation[d, begin : begin + m] if fluctuation.shape[0] else nothing[:m]
            a = emission[d, begin : begin + m] if emission.shape[0] else nothing[:m]
            w = white[d, begin : begin + m] if white.shape[0] else nothing[:m]
            p = pink[d, begin : begin + m] if pink.shape[0] else nothing[:m]
            row = out[d, begin : begin + m]
            scale[:] = one
            if divisor.shape[0]:
                series_into(divisor[d], cell, inside, start + begin, scale[:m])
            if not instantaneous:
                for t in range(m):
                    noise = epsilon[d] * a[t] + w[t] + p[t]
                    row[t] = gain[d] * s[t] * (one + x[t]) + noise * (
                        factor / max(scale[t], opaque)
                    )
            else:
                if mean.shape[0]:
                    series_into(mean[d], mean_cell, mean_inside, start + begin, level[:m])
                for t in range(m):
                    passed = max(one + x[t], opaque)
                    clipped += not one + x[t] >= opaque
                    noise = epsilon[d] * a[t] + w[t] + p[t]
                    row[t] = (
                        gain[d] * s[t]
                        + (noise * (factor / max(scale[t], opaque)) - level[t] * x[t]) / passed
                    )
    return clipped


def _normals(observation: Observation, *names: str) -> Floats:
    """(n_det,) standard normals that belong to this observation, instrument, band and ``names``."""
    return normals(observation.detector_key(*names), 0, observation.n_detectors).astype(np.float64)


def _flag_opaque(label: str, observation: Observation, transmission: SmoothField) -> None:
    """Flag detectors that are opaque most of the time, and the samples at which one of the others
    is.
    """
    knots = knots_of(transmission, transmission.step)
    dead = np.zeros(len(transmission.weights), bool)
    cell = np.zeros(knots.shape[1], bool)
    for rows in chunks(len(dead), AT_ONCE):
        opaque = ~(transmission.weights[rows] @ knots >= LEAST_TRANSMISSION)
        dead[rows] = opaque.mean(axis=1) > 0.5
        cell |= opaque[~dead[rows]].any(axis=0)
    observation.detector_flags[dead] |= flags.OPAQUE
    bad = np.repeat(cell[:-1] | cell[1:], transmission.step)[: observation.n_samples]
    observation.flags[bad] |= flags.OPAQUE
    observation.log.count(
        label,
        f"detectors flagged: band transmission below {LEAST_TRANSMISSION:g}",
        int(dead.sum()),
        observation.n_detectors,
    )
    observation.log.count(
        label,
        f"samples flagged: band transmission below {LEAST_TRANSMISSION:g}",
        int(bad.sum()),
        observation.n_samples,
    )
