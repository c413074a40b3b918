"""How the cost grows: CPU = a + b N_t + c N_det N_t + d N_det over 8 to 8000 detectors and 1 minute
to 10 hours.

    python benchmarks/scaling.py                  # some minutes
    python benchmarks/scaling.py --repeat 5

All corners are run in turn, again and again, so that a busy minute of the machine strikes all
alike; the medians are fitted by least squares of relative deviations. d is what a detector costs
however short the scan (tables, blocks). Then one superlinear term at a time is added, and its
coefficient printed with its error (bootstrap over the repeats, widened by the fit's own scatter): a
term within two errors of zero, or negative, is not there. The same is done for the user's part of
the CPU time: the rest is the system's, nearly all of it for memory that is touched for the first
time, which on a virtual machine may cost 3 ms for 2 MB where a process holds much, and depends on
what else the machine holds.
"""

from __future__ import annotations

import argparse
import math
import resource
import sys
import warnings
from collections.abc import Callable

import numpy as np
from stages import CASES, pipeline_of

RATE = 50.0
CORNERS = [
    (8, 60.0),
    (8, 3600.0),
    (8, 36000.0),
    (64, 600.0),
    (200, 600.0),
    (200, 3600.0),
    (1000, 60.0),
    (1000, 1200.0),
    (2000, 300.0),
    (8000, 60.0),
    (8000, 240.0),
]
"""(detectors, seconds)."""

SUPERLINEAR: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "N_det N_t log2(N_det)": lambda d, t: d * t * np.log2(d),
    "N_det N_t log2(N_t)": lambda d, t: d * t * np.log2(t),
    "N_det^2 N_t": lambda d, t: d * d * t,
    "N_det N_t^2": lambda d, t: d * t * t,
    "N_t^2": lambda d, t: t * t,
    "N_det^2": lambda d, t: d * d,
}


def cpu_seconds(detectors: int, seconds: float) -> tuple[float, float]:
    """(all, the user's part)"""
    import zonda

    scene = zonda.Scene(**{**CASES["M2"].scene, "target": "05h +85d"}, seed=1)  # never sets
    scene = scene.model_copy(
        update={"instrument": scene.instrument.model_copy(update={"detectors": detectors})}
    )
    chain = pipeline_of("M2", scan_duration=f"{seconds} s", sample_rate=f"{RATE} Hz")
    begin = resource.getrusage(resource.RUSAGE_SELF)
    chain.run(scene, threads=1)
    end = resource.getrusage(resource.RUSAGE_SELF)
    user = end.ru_utime - begin.ru_utime
    return user + end.ru_stime - begin.ru_stime, user


def fit(terms: np.ndarray, cost: np.ndarray) -> np.ndarray:
    """Coefficients (k,) that minimize the sum of squared relative deviations; terms (n, k)."""
    scaled = terms / cost[:, None]
    size = np.linalg.norm(scaled, axis=0)
    return np.linalg.lstsq(scaled / size, np.ones(len(cost)), rcond=None)[0] / size


def with_error(terms: np.ndarray, runs: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """(coefficients, their errors, rms relative deviation) from runs (n_repeat, n): bootstrap and
    the scatter of the fit.
    """
    rng, cost = np.random.default_rng(1), np.median(runs, axis=0)
    best = fit(terms, cost)
    deviation = terms @ best / cost - 1
    scatter = math.sqrt(float(deviation @ deviation) / max(1, len(cost) - terms.shape[1]))
    drawn = []
    for _ in range(400):
        median = np.median(runs[rng.integers(0, len(runs), len(runs))], axis=0)
        drawn.append(fit(terms, median * (1 + scatter * rng.standard_normal(len(cost)))))
    return best, np.std(drawn, axis=0), scatter


def superlinear(linear: np.ndarray, d: np.ndarray, t: np.ndarray, runs: np.ndarray) -> bool:
    """Print every term with its error; whether one is there."""
    found = False
    for name, term in SUPERLINEAR.items():
        extra = term(d, t)
        best, error, _ = with_error(np.column_stack([linear, extra]), runs)
        there = best[-1] > 2 * error[-1]
        found |= there
        share = float((best[-1] * extra / np.median(runs, axis=0)).max())
        verdict = "  SUPERLINEAR" if there else ""
        print(
            f"{name:24s} {best[-1]:10.2e} +- {error[-1]:.1e} s; at most {100 * share:5.1f}"
            f" %{verdict}"
        )
    return found


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeat", type=int, default=3)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    cpu_seconds(8, 60.0)  # imports, compilation
    runs, user = np.moveaxis(
        [[cpu_seconds(*corner) for corner in CORNERS] for _ in range(options.repeat)], 2, 0
    )
    d, t = (
        np.array([c[0] for c in CORNERS], float),
        np.array([round(c[1] * RATE) for c in CORNERS], float),
    )
    linear = np.column_stack([np.ones_like(d), t, d * t, d])
    best, error, scatter = with_error(linear, runs)
    print(f"{'detectors':>10s} {'samples':>9s} {'CPU s':>8s} {'fit':>8s} {'system':>7s}   range")
    for k, cost in enumerate(np.median(runs, axis=0)):
        low, high = runs[:, k].min(), runs[:, k].max()
        system = np.median(runs[:, k] - user[:, k])
        print(
            f"{d[k]:10.0f} {t[k]:9.0f} {cost:8.3f} {linear[k] @ best:8.3f} {system:7.3f}  "
            f" {low:.3f} to {high:.3f}"
        )
    units = (
        ("a", 1.0, "s"),
        ("b", 1e9, "ns/sample"),
        ("c", 1e9, "ns/sample/detector"),
        ("d", 1e6, "us/detector"),
    )
    for (name, factor, unit), value, sigma in zip(units, best, error, strict=True):
        print(f"{name} = {factor * value:.4g} +- {factor * sigma:.2g} {unit}")
    print(f"rms deviation {100 * scatter:.1f} %")
    found = superlinear(linear, d, t, runs)
    print("user's part:")
    superlinear(linear, d, t, user)
    return int(found)


if __name__ == "__main__":
    sys.exit(main())
