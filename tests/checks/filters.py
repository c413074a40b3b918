"""Filters under a bright sky: seven decades, drifts, gaps, detectors that are no use."""

from __future__ import annotations

import numpy as np

from zonda.core.checks import Family, Measured
from zonda.core.errors import PipelineError, ZondaError
from zonda.core.types import Floats
from zonda.operators.atmosphere.layers import AtmosphereLayers
from zonda.operators.detectors.time_constant import TimeConstant
from zonda.operators.filters.common_mode import UNDETERMINED, CommonModeFilter
from zonda.operators.filters.highpass import HighpassFilter
from zonda.operators.maps.bin_map import BinMap
from zonda.operators.optics.efficiency import Efficiency
from zonda.operators.pointing.base import PointingStare
from zonda.operators.sky.skymap import SkyMap
from zonda.plugins.checks.numerics import N_DET, WHITE, N, ten_million, without_modes
from zonda.plugins.checks.scenes import differing, largest, run, scan, sky_file

from .cases import DEAD, DECADES, PARTIAL, SLOW, TIME

checks = Family("filters")


def _sky(common: float = 0.3, gradient: float = 0.03, white: float = WHITE) -> Floats:
    """Slow series that all detectors share, two gradients over the focal plane, white noise:
    (N_DET, N).
    """
    rng = np.random.default_rng(0)
    series = np.cumsum(rng.standard_normal((3, N)), axis=1)
    series -= series.mean(axis=1, keepdims=True)
    series /= series.std(axis=1, keepdims=True)
    place = rng.uniform(-1, 1, (2, N_DET))
    shared = common * np.outer(1 + 0.02 * place[0], series[0]) + gradient * (place.T @ series[1:])
    return np.asarray(shared + white * rng.standard_normal((N_DET, N)))


@checks.add(DECADES, reference="the same run without an atmosphere", limit=1e-3)
def transfer() -> float:
    """largest change of the map of a 1 uK source, over its peak, under a mean emission of 30 K,
    float32, high-passed
    """
    values = np.zeros((301, 301))
    values[150, 150] = 8e-5
    maps = []
    with sky_file(values) as path:
        for air in ([], [AtmosphereLayers(pwv="7.7 mm", pwv_rms=0)]):
            steps = [
                SkyMap(file=path),
                *air,
                Efficiency(),
                HighpassFilter(),
                BinMap(pixel="4 arcsec", width="9 arcmin"),
            ]
            o = scan(19, 4000, radius=1)
            maps.append(run(steps, o, precision="float32").products["map"].signal)
    bare, under = maps
    hit = ~np.isnan(bare)
    return float(abs(under - bare)[hit].max() / abs(bare[hit]).max())


@checks.add(
    DECADES, reference="an error that names precision: float64", limit=0, unit="not refused"
)
def common_mode_in_float32() -> int:
    """a common mode 1e7 times the signal in float32"""
    try:
        run([CommonModeFilter()], scan(N_DET, N), ten_million(), precision="float32")
    except PipelineError as err:
        return int("precision: float64" not in str(err))
    return 1


@checks.add(TIME, reference="the scan without gap", limit=0.2)
def gaps_and_nan() -> Measured:
    """change of good samples by a flagged gap of 50 samples of 1e6 K, a NaN and a row of inf, over
    the white noise

    The gap is bridged: 50 samples of white noise become a line, so the low part changes by some of
    its own rms.
    """
    x = np.random.default_rng(5).normal(0, WHITE, (3, 20000))
    clean = (
        run([HighpassFilter()], scan(3, 20000), x, keep=("signal",))
        .observations[0]
        .detdata["signal"]
    )
    spoilt, o = x.copy(), scan(3, 20000)
    o.flags[7000:7050] = 1
    spoilt[:, 7000:7050], spoilt[1, 100], spoilt[2] = 1e6, np.nan, np.inf
    data = run([HighpassFilter()], o, spoilt, keep=("signal",))
    good = np.r_[0:100, 101:7000, 7050:20000]
    counted = data.log.get("HighpassFilter", "samples not finite")
    change = abs(data.observations[0].detdata["signal"] - clean)[:2, good].max() / WHITE
    return float(change) if counted == 20001 else np.inf, f"{counted} samples counted as not finite"


@checks.add(DEAD, reference="numpy's SVD of the good detectors", limit=1e-4)
def useless_detectors() -> Measured:
    """relative error of what is left of the good detectors beside a dead, a constant and a NaN
    one
    """
    a = _sky()
    spoilt, bad = a.copy(), [3, 7, 11]
    spoilt[3], spoilt[7], spoilt[11, 200] = 0.0, 4.25, np.nan
    data = run([CommonModeFilter()], scan(N_DET, N), spoilt, keep=("signal",))
    flagged = np.flatnonzero(data.observations[0].detector_flags).tolist()
    good = np.setdiff1d(np.arange(N_DET), bad)
    left, expected = data.observations[0].detdata["signal"][good], without_modes(a[good], 1)
    error = float(np.linalg.norm(left - expected) / np.linalg.norm(expected))
    return error if flagged == bad else np.inf, f"flagged {flagged}"


@checks.add(DEAD, reference="the signal itself", limit=0, unit="values")
def one_or_identical() -> int:
    """values changed in the signal of a single detector and of 5 identical ones, method svd and
    mean
    """
    wrong = 0
    for n_det in (1, 5):
        a = np.tile(np.random.default_rng(5).standard_normal(N), (n_det, 1))
        for method in ("svd", "mean"):
            data = run([CommonModeFilter(method=method)], scan(n_det, N), a, keep=("signal",))
            wrong += differing(data.observations[0].detdata["signal"], a)
            wrong += (
                data.log.get(
                    "CommonModeFilter", "modes kept because the data do not determine them (rank)"
                )
                != 1
            )
    return wrong


@checks.add(DEAD, reference="rank - 1 of them", limit=0, unit="modes")
def more_modes_than_rank() -> int:
    """modes too many or too few, 5 asked for where the rank is 2"""
    rng = np.random.default_rng(6)
    a = rng.standard_normal((6, 2)) @ rng.standard_normal((2, N))
    data = run(
        [CommonModeFilter(modes=5, on_undetermined="remove")], scan(6, N), a, keep=("signal",)
    )
    return abs(int(np.linalg.matrix_rank(data.observations[0].detdata["signal"], tol=1e-6)) - 1)


@checks.add(DEAD, reference="their mean, counted", limit=1e-5)
def undetermined_mode() -> Measured:
    """relative error where white noise leaves no leading mode and the detectors' mean is removed
    instead
    """
    a = np.random.default_rng(4).standard_normal((N_DET, N))
    data = run([CommonModeFilter()], scan(N_DET, N), a, keep=("signal",))
    counted = data.log.get("CommonModeFilter", UNDETERMINED)
    error = float(
        np.linalg.norm(data.observations[0].detdata["signal"] - (a - a.mean(0))) / np.linalg.norm(a)
    )
    return error if counted == 1 else np.inf, f"{counted} mode counted as not determined"


@checks.add(PARTIAL, reference="flagged, counted, the rest in the map", limit=0, unit="samples")
def dead_in_one_block() -> Measured:
    """samples lost or not finite where one detector is NaN for one block of 2048 samples,
    high-passed, common mode, map
    """
    a = _sky()
    a[5, 2048:4096] = np.nan
    wrong, said = 0, []
    for memory in (1 << 30, 8 << 20):
        steps = [HighpassFilter(), CommonModeFilter(), BinMap(pixel="4 arcsec")]
        data = run(list(steps), scan(N_DET, N), a, memory=memory)
        product = data.products["map"]
        dropped = sum(
            n
            for who, what, n in data.log.counts()
            if who == "BinMap" and what.startswith("samples dropped")
        )
        wrong += abs(int(product.hits.sum()) + dropped - a.size) + int(
            (~np.isfinite(product.signal[product.hits > 0])).sum()
        )
        wrong += abs(int(product.hits.sum()) - a.size + N)
        said.append(data.log.get("CommonModeFilter", "detectors flagged: signal not finite"))
    return wrong, f"{said[0]} detector flagged"


@checks.add(PARTIAL, reference="an error", limit=0, unit="not refused")
def zero_length() -> int:
    """scans of zero and of negative length"""
    wrong = 0
    for duration in ("0 s", "-1 s"):
        try:
            PointingStare(scan_duration=duration)
        except ZondaError:
            continue
        wrong += 1
    return wrong


def _sources(samples: int = 20_000) -> tuple[Floats, Floats]:
    """A source of FWHM 2.1 samples, in each row a tenth of a sample later; frequencies per sample
    of its spectrum.
    """
    t = np.arange(samples) - 8000.0 - np.arange(10)[:, None] / 10
    return np.exp(-4 * np.log(2) * (t / 2.1) ** 2), np.fft.rfftfreq(samples)


@checks.add(SLOW, reference="1 / (1 + 2 pi i f tau) on the whole spectrum", limit=5e-3)
def one_pole() -> Measured:
    """largest error over the input's peak behind tau of 0.05 to 100 samples: a source of FWHM 2.1
    samples, at ten offsets
    """
    source, frequency = _sources()
    errors = {}
    for tau in (0.05, 0.3, 1.0, 3.0, 10.0, 100.0):
        steps = [TimeConstant(tau=f"{10 * tau} ms")]
        data = run(steps, scan(10, source.shape[1]), source, keep=("signal",))
        exact = np.fft.irfft(
            np.fft.rfft(source) / (1 + 2j * np.pi * frequency * tau), source.shape[1]
        )
        errors[tau] = float(abs(data.observations[0].detdata["signal"] - exact).max())
    worst = max(errors, key=lambda tau: errors[tau])
    return largest(*errors.values()), f"largest: tau {worst:g} samples"


@checks.add(SLOW, reference="one block", limit=0, unit="values")
def one_pole_in_blocks() -> int:
    """values that differ in their bits between one block and one thread, and small blocks and two
    threads
    """
    source, _ = _sources()
    given = source + np.random.default_rng(3).standard_normal(source.shape)
    found = []
    for settings in ({"threads": 1}, {"threads": 3, "memory": 4_000_000}):
        steps = [TimeConstant(tau="30 ms", scatter=0.2)]
        data = run(steps, scan(10, source.shape[1]), given, keep=("signal",), **settings)
        found.append(np.array(data.observations[0].detdata["signal"]))
    return differing(*found)
