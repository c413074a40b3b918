"""Libraries and compiled loops against references of higher precision: LAPACK, FFT, filters, random
numbers, ERFA, time.
"""

from __future__ import annotations

import math
import warnings

import numpy as np

from zonda.core.checks import Family, Measured
from zonda.core.configuration.time import Instant
from zonda.core.numerics.celestial import CelestialTransform, orientation
from zonda.core.numerics.random import normals, stream_key
from zonda.core.numerics.sphere import unit_vectors
from zonda.core.site import Site
from zonda.core.types import Floats
from zonda.operators.filters.brick_wall import plan_highpass
from zonda.operators.filters.common_mode import CommonModeFilter
from zonda.operators.filters.highpass import HighpassFilter
from zonda.operators.noise.one_over_f import power_law_filter
from zonda.operators.noise.streams import Streams

from .scenes import DECADES, PINK, TIME, largest, run, scan

checks = Family("numerics")

WHITE = 1.7e-3 * 10.0
"""K: rms of a sample at 100 Hz."""
N_DET = 37
N = 5000

SITES = (
    Site(name="Green Bank", latitude="38.4331 deg", longitude="-79.8398 deg", altitude="818 m"),
    Site(name="South Pole", latitude="-90 deg", longitude="0 deg", altitude="2835 m"),
    Site(name="equator", latitude="0 deg", longitude="200 deg"),
)
ERROR = 1e-9
"""rad."""


@checks.add(DECADES, reference="numpy's SVD", limit=1e-8, unit="K")
def common_mode_of_ten_million() -> float:
    """what a common mode 1e7 times the signal leaves behind in float64"""
    a = ten_million()
    data = run([CommonModeFilter(residual=1e-11)], scan(N_DET, N), a, keep=("signal",))
    return float(abs(data.observations[0].detdata["signal"] - without_modes(a, 1)).max())


def ten_million() -> Floats:
    """A common mode of 10 K and, seven decades below, sources that cross the detectors one after
    the other.
    """
    t = np.arange(N)
    rng = np.random.default_rng(8)
    signal = 1e-6 * np.array(
        [np.exp(-0.5 * ((t - 1000 - 70 * d) / 20.0) ** 2) for d in range(N_DET)]
    )
    return np.asarray(10 * np.cumsum(rng.standard_normal(N)) / np.sqrt(N) + signal)


def without_modes(a: Floats, modes: int) -> Floats:
    """Remove the leading singular vectors with numpy."""
    u, s, v = np.linalg.svd(a, full_matrices=False)
    return np.asarray(a - (u[:, :modes] * s[:modes]) @ v[:modes])


@checks.add(DECADES, reference="nothing", limit=0.01)
def elevation_drift() -> Measured:
    """what a 15 K drift with curvature leaves anywhere in a scan, over the rms of the white
    noise
    """
    u = np.linspace(0, 1, 51600)
    drift = 15 * (u + 0.1 * u**2 + 0.03 * u**3 + 0.005 * u**4)
    left = drift[None].copy()
    plan_highpass(len(u), 0.08 / 100, HighpassFilter().degree, 24.0).apply(left)
    spectrum = np.fft.rfft(drift - drift.mean())
    spectrum[: int(0.08 / 100 * len(u)) + 1] = 0
    periodic = float(abs(np.fft.irfft(spectrum, len(u))).max())
    return float(abs(left).max()) / WHITE, f"a periodic brick wall leaves {periodic / WHITE:.0f}"


@checks.add(PINK, reference="integral of the PSD", limit=4.5, unit="standard errors")
def first_sample() -> Measured:
    """variance of the very first sample of 20000 detectors"""
    law = power_law_filter(1e-3, 1.0, 8)
    n = 20_000
    streams = Streams(law, stream_key(5, "a"), stream_key(5, "b"))
    out = np.zeros((20_000, 1), np.float32)
    streams.add(0, 0, out)
    ratio = float((out.astype(np.float64) ** 2).mean()) / law.variance
    return abs(ratio - 1) / math.sqrt(2 / n), f"{ratio:.4f} of theory"


@checks.add(PINK, reference="the same filter in float64", limit=1e-3)
def float32_states() -> float:
    """rms error of float32 states over the rms, f_min from 1e-8 to 1e-5 f_s, slopes 1 to 3"""
    from scipy.signal import lfilter

    worst = 0.0
    n = 1 << 14
    for f_min, slope in ((1e-5, 1.0), (1e-8, 1.0), (1e-7, 2.0), (1e-5, 3.0)):
        law = power_law_filter(f_min, slope, 8)
        out = np.zeros((16, n), np.float32)
        Streams(law, stream_key(7, "a"), stream_key(7, "b")).add(0, 0, out)
        exact = normals(stream_key(7, "a"), 0, 16 * n).reshape(n, 16).T.astype(np.float64)
        states = len(law.start)
        first = law.start @ normals(stream_key(7, "b"), 0, states * 16).reshape(states, 16)
        for q, z, s in zip(law.poles, law.zeros, first[: law.poles.size], strict=True):
            exact, _ = lfilter([1, z - 1], [1, q - 1], exact, axis=1, zi=((z - q) * s)[:, None])
        pairs = zip(law.pairs, first[law.poles.size :].reshape(-1, 2, 16), strict=True)
        for (real, imaginary, of_real, of_imaginary), (
            re,
            im,
        ) in pairs:  # equation (3) of `one_over_f`
            q = complex(real, imaginary)
            inside, _ = lfilter([0, 1], [1, q - 1], exact, axis=1, zi=(re + 1j * im)[:, None])
            exact = exact + of_real * inside.real + of_imaginary * inside.imag
        worst = largest(worst, float((out - exact).std() / exact.std()))
    return worst


@checks.add(TIME, reference="ERFA eraAtco13 at each instant", limit=ERROR, unit="rad")
def over_a_day() -> float:
    """pointing error at 300 instants of a day in 1985, 2024 and 2027 (1.8e9 s), three sites, all
    over the sky
    """
    rng = np.random.default_rng(1)
    worst = 0.0
    for site in SITES:
        for year in (1985, 2024, 2027):
            start = Instant.parse(f"{year}-01-15T07:00:00.123456789Z")
            seconds = np.round(rng.uniform(0, 86400, 300), 6)
            sky = unit_vectors(rng.uniform(0, 2 * np.pi, 300), np.arcsin(rng.uniform(-1, 1, 300)))
            transform = CelestialTransform(site, start, 86400.0)
            worst = largest(
                worst,
                angle(
                    transform.horizontal(sky, seconds),
                    erfa_horizontal(sky, start, seconds, site),
                ),
            )
    return worst


@checks.add(TIME, reference="the same instant reached from another start", limit=ERROR, unit="rad")
def exact_start() -> Measured:
    """pointing error between start + dt and a start dt later, near 1.8e9 s"""
    worst = 0.0
    sky = unit_vectors(np.array([2.0]), np.array([0.3]))
    for shift in (1, 999, 123_456_789, 499_999_999_999):
        early = Instant.parse("2027-01-15T03:04:05.678901234Z")
        late = Instant(early.nanoseconds + shift)
        one = CelestialTransform(SITES[0], early, 500.0).horizontal(sky, np.array([shift / 1e9]))
        worst = largest(
            worst,
            angle(one, CelestialTransform(SITES[0], late, 0.0).horizontal(sky, np.zeros(1))),
        )
    return worst, "0.24 us, the rounding of 1.8e9 s in float64, would be 1.7e-11 rad"


def erfa_horizontal(sky: Floats, start: Instant, seconds: Floats, site: Site) -> Floats:
    """Horizontal directions (n, 3) north, west, up of ICRS unit vectors (n, 3), from UTC calendar
    dates.
    """
    import erfa

    when = [Instant(start.nanoseconds + round(s * 1e9)).datetime for s in seconds]
    below = np.array([(start.nanoseconds + round(s * 1e9)) % 1000 for s in seconds])
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore",
            erfa.ErfaWarning,
        )  # leap seconds of dates to come are unknown
        second = np.array([t.second + t.microsecond / 1e6 for t in when]) + below / 1e9
        fields = (
            np.array([getattr(t, name) for t in when])
            for name in ("year", "month", "day", "hour", "minute")
        )
        utc1, utc2 = erfa.dtf2d("UTC", *fields, second)
        earth = orientation(utc1 - 2400000.5 + utc2)
        azimuth, zenith, *_ = erfa.atco13(
            np.arctan2(sky[:, 1], sky[:, 0]),
            np.arctan2(sky[:, 2], np.hypot(sky[:, 0], sky[:, 1])),
            0.0,
            0.0,
            0.0,
            0.0,
            utc1,
            utc2,
            earth.ut1_utc,
            site.longitude,
            site.latitude,
            site.altitude,
            earth.x,
            earth.y,
            0.0,
            0.0,
            0.0,
            1.0,
        )
    return unit_vectors(-azimuth, np.pi / 2 - zenith)


def angle(a: Floats, b: Floats) -> float:
    """Largest angle between directions (n, 3), rad."""
    return float(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1)).max())
