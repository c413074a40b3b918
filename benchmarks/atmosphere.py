"""The atmosphere alone: what it costs, and how well the pyramid's implied covariance holds.

    python benchmarks/atmosphere.py cost               # all cases, each in a process of its own
    python benchmarks/atmosphere.py cost M2 WIDE
    python benchmarks/atmosphere.py covariance         # the tables of docs/atmosphere.md (some
    minutes)

Cost: ns per sample of one core, and as a ratio to numpy drawing as many float32 normal deviates in
the same run. Set-up is `AtmosphereLayers.prepare` (turbulence, radiative transfer, node values) for
the scan's length; evaluation is `exec` over blocks.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

ARCMIN, DEG = np.pi / 180 / 60, np.pi / 180

# name: (text, diameter, band GHz, field [deg], detectors, of them used, rate Hz, seconds, scan,
# size [deg], speed [deg/s])
CASES = {
    "M2": (
        "223 detectors, 100 m, 4.2 arcmin",
        100,
        93,
        4.2 / 60,
        223,
        223,
        100,
        516,
        "daisy",
        4 / 60,
        50 / 3600,
    ),
    "AT": (
        "3000 detectors, 50 m, 0.25 deg",
        50,
        92,
        0.25,
        3000,
        3000,
        225,
        516,
        "daisy",
        0.25,
        0.5,
    ),
    "FULL": (
        "256 of 200 000 detectors, 50 m, 2 deg",
        50,
        150,
        2.0,
        200_000,
        256,
        900,
        516,
        "daisy",
        1.0,
        3.0,
    ),
    "WIDE": (
        "5000 detectors, 6 m, 7.8 deg, 30 deg of throw",
        6,
        150,
        7.8,
        5000,
        5000,
        200,
        120,
        "azimuth",
        30.0,
        1.5,
    ),
    "SAT": (
        "2000 detectors, 0.42 m, 35 deg, 60 deg of throw",
        0.42,
        93,
        35.0,
        2000,
        2000,
        200,
        120,
        "azimuth",
        60.0,
        1.5,
    ),
}


def observation(case: str, seconds: float | None = None):
    from zonda.core.configuration.time import Instant
    from zonda.core.data import Observation
    from zonda.core.focalplane import Focalplane
    from zonda.core.instrument import Band, Instrument, Telescope
    from zonda.core.site import Site

    _, diameter, band, field, every, used, rate, duration, scan, size, speed = CASES[case]
    camera = Instrument(
        name=case,
        telescope=Telescope(name="dish", diameter=f"{diameter} m"),
        band=Band(name="b", low=f"{band - 10} GHz", high=f"{band + 10} GHz"),
        detectors=every if used == every else 7,
        field_of_view=f"{field} deg",
        main_beam_efficiency=0.3,
        illumination_efficiency=0.8,
        net="1 mK s(1/2)",
        sample_rate=f"{rate} Hz",
    )
    plane = camera.focalplane()
    if used != every:
        rng = np.random.default_rng(0)
        r, phi = field / 2 * DEG * np.sqrt(rng.random(used)), 2 * np.pi * rng.random(used)
        one = np.ones(used)
        plane = Focalplane(
            [str(k) for k in range(used)],
            r * np.cos(phi),
            r * np.sin(phi),
            one * 4e-5,
            one,
            one,
            one,
        )
    t = np.arange(round((seconds or duration) * rate)) / rate
    elevation = 50 * DEG
    if scan == "daisy":
        phase = t * speed / size
        z = np.sin(phase) * np.exp(1j * phase * np.pi / 10) + 0.15 * np.cos(phase) * np.exp(
            1j * np.sqrt(2) * phase * np.pi / 10
        )
        az, el = (
            150 * DEG + size * DEG * z.real / np.cos(elevation),
            elevation + size * DEG * z.imag,
        )
    else:
        reach = size / 2 / np.cos(elevation) * DEG
        az, el = (
            150 * DEG + reach * np.sin(t * speed * DEG / np.cos(elevation) / reach),
            np.full(len(t), elevation),
        )
    a, b = az / 2, (np.pi / 2 - el) / 2
    q = np.stack(
        [
            np.sin(a) * np.sin(b),
            np.cos(a) * np.sin(b),
            -np.sin(a) * np.cos(b),
            np.cos(a) * np.cos(b),
        ],
        axis=1,
    )
    site = Site(
        name="here",
        latitude="-23.0193 deg",
        longitude="-67.7532 deg",
        altitude="5050 m",
        climatology="chajnantor",
    )
    start = Instant.parse("2022-08-01T23:00:00Z")
    return Observation(case, 0, site, camera, plane, start, t, float(rate), q, q, (0.0, 0.0), 1)


def run(op, o) -> tuple[float, float, object]:
    """CPU seconds of the set-up and of the evaluation of every block, single-threaded."""
    from zonda.core.data import Block

    start = time.process_time()
    state = op.prepare(o)
    middle = time.process_time()
    buffers: dict = {}
    for first in range(0, o.n_detectors, 16):
        for begin in range(0, o.n_samples, 16384):
            detectors = slice(first, min(first + 16, o.n_detectors))
            block = Block(
                o, detectors, slice(begin, min(begin + 16384, o.n_samples)), buffers=buffers
            )
            op.exec(block, state)
    return middle - start, time.process_time() - middle, state


def cost(case: str) -> None:
    from zonda.operators.atmosphere.layers import AtmosphereLayers

    def operator():
        return AtmosphereLayers(pwv="1 mm", pwv_rms="5 %")

    run(operator(), observation(case, 2.0))  # compile
    o = observation(case)
    setup, evaluation, _ = run(operator(), o)
    out = np.empty(1 << 20, np.float32)
    rng = np.random.default_rng(0)
    start = time.process_time()
    for _ in range(8):
        rng.standard_normal(dtype=np.float32, out=out)
    reference = (time.process_time() - start) / 8 / len(out) * 1e9
    n = o.n_detectors * o.n_samples
    said = {what: text for _, what, text in o.log}
    total = (setup + evaluation) / n * 1e9
    print(f"{case}: {CASES[case][0]}, {o.duration:.0f} s, {n / 1e6:.0f} M samples")
    print(
        f"    set-up {setup:.2f} s, evaluation {evaluation / n * 1e9:.2f} ns/sample (emission and"
        " transmission)"
    )
    print(
        f"    together {total:.2f} ns/sample, {total / reference:.2f} of numpy's normal deviate"
        f" ({reference:.1f} ns)"
    )
    for what in (
        "nodes",
        "step in time",
        "nodes and step of the mean emission",
        "plane of the turbulence",
    ):
        print(f"    {what}: {said[what]}")


def implied_error(layer, ratio: float) -> tuple[float, float]:
    """Largest errors of C (of the variance) and S (of itself), along, across and oblique, from one
    cell to 3 r0.
    """
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    from tests.checks.implied import implied_covariance

    top = max(400, int(3 * ratio * layer.sigma / layer.spacing))
    lags = np.unique(np.r_[1, 2, 3, 5, 8, np.geomspace(12, top, 8).astype(int)])
    worst_c = worst_s = 0.0
    for phase in ((0, 0), (1, 1), (22, 41)):
        for direction in ((0, 1), (1, 1), (1, 3)):
            a = np.array([phase] * len(lags))
            b = a + lags[:, None] * np.array(direction)
            here, there, between = (
                implied_covariance(layer, p, q) for p, q in ((a[:1], a[:1]), (b, b), (a, b))
            )
            s = structure_of(layer, lags * np.hypot(*direction) * layer.spacing)
            worst_c = max(
                worst_c,
                abs(between / layer.variance - 1 + s / layer.variance).max(),
                abs(there / layer.variance - 1).max(),
            )
            worst_s = max(worst_s, abs(((here + there) / 2 - between) / s - 1).max())
    return worst_c, worst_s


def structure_of(layer, r):
    from zonda.operators.atmosphere.turbulence.covariance import beam_structure

    if layer.aperture:
        return layer.aperture.structure(r, layer.outer_scale)
    return beam_structure(r, layer.outer_scale, layer.sigma)


def covariance() -> None:
    from zonda.operators.atmosphere.turbulence.beams import Aperture
    from zonda.operators.atmosphere.turbulence.lattice import Turbulence
    from zonda.operators.atmosphere.turbulence.levels import FIDELITIES

    ratios = (1e-3, 0.06, 1.0, 30.0, 100.0, 1e3, 1e4, 1e6)
    print("Gaussian footprint; r0 / sigma:", *(f"{r:g}" for r in ratios), sep="\t")
    for name in FIDELITIES:
        rows = []
        for ratio in ratios:
            layers = [
                Turbulence(0, outer_scale=ratio * s, sigma=s, fidelity=name)
                for s in (14.0, 21.0, 26.6)
            ]
            rows.append(np.max([implied_error(layer, ratio) for layer in layers], axis=0))
        for what, values in zip("CS", np.transpose(rows), strict=True):
            print(f"{name} {what}", *(f"{v:.1e}" for v in values), sep="\t", flush=True)
    print("Apertures, r0 = 500 m; D [m], taper [dB]: C, S")
    for name in FIDELITIES:
        for diameter, taper in (
            (0.42, 0.0),
            (6.0, 0.0),
            (50.0, 0.0),
            (100.0, 0.0),
            (6.0, 10.0),
            (100.0, 10.0),
        ):
            layer = Turbulence(
                0, outer_scale=500.0, aperture=Aperture(diameter, taper), fidelity=name
            )
            c, s = implied_error(layer, 500.0 / layer.sigma)
            print(f"{name}\t{diameter:g}\t{taper:g}\t{c:.1e}\t{s:.1e}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["cost", "covariance"])
    parser.add_argument("cases", nargs="*")
    arguments = parser.parse_args()
    if arguments.what == "cost" and len(arguments.cases) == 1:
        cost(arguments.cases[0])
    elif arguments.what == "cost":
        for name in arguments.cases or CASES:
            subprocess.run([sys.executable, __file__, "cost", name], check=True)
    else:
        covariance()
