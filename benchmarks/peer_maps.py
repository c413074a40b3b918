"""Maximum-likelihood maps beside pysanepic's and TOAST's: CPU time of an iteration, noise, and the
map of a destriper without a prior.

    python benchmarks/peer_maps.py --toast PYTHON --sanepic PYTHON
    python benchmarks/peer_maps.py --sanepic PYTHON --minutes 2 --repeat 1

A daisy of `mustang2_cluster`. All get the same streams and pixels, peers in processes of their own,
one thread, in turns. pysanepic (GPL-3) and TOAST are peers here and nothing that zonda needs:
an environment that is not named, or lacks its package, is a line of the output.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import map_makers
import numpy as np
from astropy.io import fits
from peers import call, installed
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

import zonda
from zonda.operators.maps.normal_equations import NormalEquations, WeighedScan

FEW, MANY = 4, 24
"""Iterations that are timed."""
MODES = 1, 3
"""Modes that detectors share, of pysanepic."""
BEAM = map_makers.BEAM["m2"]


def solved(equations: NormalEquations, right: Any) -> dict[str, Any]:
    """CPU seconds of few and of many iterations of conjugate gradients."""
    spent = []
    for most in (FEW, MANY):
        start = time.process_time()
        equations.solve(right, 0.0, most)
        spent.append(time.process_time() - start)
    return {"spent": spent, "iterations": MANY - FEW}


def iteration(reports: list[dict[str, Any]]) -> float:
    """CPU seconds of an iteration, from the least of each of two timings."""
    few, many = np.min([report["spent"] for report in reports], axis=0)
    return float(many - few) / reports[0]["iterations"]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--toast", metavar="PYTHON", help="interpreter with toast")
    parser.add_argument("--sanepic", metavar="PYTHON", help="interpreter with pysanepic")
    parser.add_argument("--minutes", type=float, default=8.6, help="length of the scan")
    parser.add_argument("--short", type=float, default=1, help="the same, without a prior")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--limit", type=float, default=1200, help="seconds of a process")
    options = parser.parse_args()
    found = installed({"toast": options.toast, "pysanepic": options.sanepic})
    with tempfile.TemporaryDirectory() as name:
        compare(found, options, Path(name))
    if "toast" in found:
        with tempfile.TemporaryDirectory() as name:
            without_a_prior(found["toast"], options, Path(name))
    print(f"load of the machine {os.getloadavg()[0]:.1f}")


@dataclass(frozen=True)
class Scan:
    """A scan as the makers get it: files in ``folder``, and what zonda made of it."""

    folder: Path
    data: Any
    equations: NormalEquations
    pixel: Any
    iterations: int

    @classmethod
    def of(cls, minutes: float, folder: Path) -> Scan:
        """Simulate it, write it, and make its maps."""
        file, changes = map_makers.PIPELINES["m2"]
        length = f"PointingDaisy.scan_duration={minutes} min"
        map_makers.PIPELINES["one scan"] = file, (*changes, "PointingDaisy.scans=1", length)
        scene, steps, how, _ = map_makers.pipeline("one scan", 1)
        data = zonda.Pipeline(
            [*steps, zonda.SaveTOD(), map_makers.Maker(**how)], runs=map_makers.SIGNALS
        ).run(scene, threads=1, keep=["signal", "signal/rest"], output=folder)
        equations, _, solution, *_ = map_makers.KEPT[0]
        ((scan, _),) = equations.scans
        pixel = np.repeat(scan.pixel, scan.samples).reshape(scan.shape[0], scan.n_samples)
        pixel[pixel == equations.n_pixels] = -1
        made = cls(folder, data, equations, pixel, len(solution.history))
        np.savez(folder / "scan.npz", pixel=pixel, noise=made.stream("signal/rest"))
        product = data["map"]
        empty = np.zeros(product.signal.shape, np.float32)
        fits.PrimaryHDU(empty, product.header).writeto(folder / "grid.fits")
        return made

    def stream(self, name: str) -> Any:
        """(n_det, n_samples) of the good detectors, less their means, K."""
        found = self.data.tod(name, 0)[self.data.observations[0].good_detectors]
        return found - found.mean(axis=1, keepdims=True)

    def of_toast(self, *more: str) -> list[str]:
        """Arguments of `toast_maps`."""
        ((scan, _),) = self.equations.scans
        (file,) = self.folder.glob("tod_*.h5")
        return [str(file), str(self.folder / "grid.fits"), str(scan.length / scan.rate), *more]


def compare(peers: dict[str, str], options: argparse.Namespace, folder: Path) -> None:
    """Time and noise of each maker."""
    scan = Scan.of(options.minutes, folder)
    equations, total = scan.equations, scan.pixel.size
    runs = equations.scans[0].scan.pixel.size / total
    print(f"{total / 1e6:.1f} M samples of {len(scan.pixel)} detectors, {runs:.2f} runs a sample")
    jobs: dict[str, Any] = {}
    for modes in MODES if "pysanepic" in peers else ():
        arguments = [str(folder / "scan.npz"), str(modes), str(folder / f"sanepic_{modes}.npy")]
        jobs[f"pysanepic, modes: {modes}"] = peers["pysanepic"], "sanepic_maps.py", arguments
    if "toast" in peers:
        jobs["TOAST, with a prior"] = peers["toast"], "toast_maps.py", scan.of_toast()
    right = equations.apply(np.nan_to_num(scan.data["sky/map"].signal).reshape(1, -1))
    reports: dict[str, list[Any]] = {job: [] for job in ("zonda", *jobs)}
    for _ in range(options.repeat):
        reports["zonda"].append(solved(equations, right) | {"needed": scan.iterations})
        for job, (python, script, arguments) in jobs.items():
            reports[job].append(json.loads(call(python, script, arguments, folder, options.limit)))
    unit = iteration(reports["zonda"])
    print(
        f"{'':22s} ns a sample and iteration, over zonda's, iterations needed, set-up ns a sample"
    )
    for job, found in reports.items():
        one = iteration(found)
        needed, version = (found[0].get(key, "") for key in ("needed", "version"))
        setup = min(report.get("setup", np.nan) for report in found) / total * 1e9
        print(
            f"{job:22s} {one / total * 1e9:6.1f} {one / unit:6.1f} {needed:>4} {setup:6.0f} {version}"
        )
    product = scan.data["rest/map"]
    rings = map_makers.Rings(product, map_makers.SCALES["m2"])
    for modes in MODES if "pysanepic" in peers else ():
        found = np.load(folder / f"sanepic_{modes}.npy")
        other = np.pad(found, (0, equations.n_pixels - len(found))).reshape(product.signal.shape)
        one, two = (
            rings.smooth(m, product, BEAM)[rings.w > 0.9].std() for m in (product.signal, other)
        )
        print(
            f"noise of the map smoothed with {BEAM} arcsec over pysanepic's, modes: {modes}:"
            f" {one / two:.3f} ({one * 1e6:.0f}, {two * 1e6:.0f} uK)"
        )


def without_a_prior(python: str, options: argparse.Namespace, folder: Path) -> None:
    """TOAST's offsets and ours, both solved to 1e-8."""
    scan = Scan.of(options.short, folder)
    path = folder / "toast.npy"
    call(python, "toast_maps.py", scan.of_toast(str(path)), folder, options.limit)
    (o,) = scan.data.observations
    white = o.focalplane.net[o.good_detectors] ** 2 * o.sample_rate
    ours, weight, iterations = destriped(scan, white)
    difference = ours - np.load(path)[: len(ours)]
    part = connected(scan)
    sums = [np.bincount(part, w) for w in (weight, weight * difference)]
    difference -= (sums[1] / np.maximum(sums[0], 1e-300))[part]
    ratio = (difference * np.sqrt(weight))[weight > 0]
    print(
        f"offsets without a prior, {scan.pixel.size / 1e6:.1f} M samples, {iterations} iterations"
        f" of ours: TOAST's map minus ours has an rms of {np.sqrt((ratio**2).mean()):.1e} of the"
        f" noise of a pixel, and at most {np.abs(ratio).max():.1e}; {len(ratio)} pixels in"
        f" {np.count_nonzero(sums[0])} parts, less the mean of each"
    )


def destriped(scan: Scan, white: Any) -> tuple[Any, Any, int]:
    """The map (n_pixels,) of baselines whose power has no limit, of no modes, its weights, and
    iterations.
    """
    ((one, noise),) = scan.equations.scans
    signal, none = scan.stream("signal"), np.zeros((0, one.n_samples))
    free = replace(
        noise,
        white=white,
        modes=np.zeros((0, len(white))),
        free=0,
        lines=np.zeros((0, one.shape[1])),
        own=np.full(len(noise.own), 1e30),
        shared=np.zeros((len(noise.own), 0)),
    )
    system = NormalEquations([WeighedScan(one, free)], 1, scan.equations.n_pixels)
    seen = scan.pixel >= 0
    weight = np.broadcast_to(1 / white[:, None], seen.shape)[seen]
    binned = np.bincount(scan.pixel[seen], weight * signal[seen], system.n_pixels)
    edges = np.arange(0, one.n_samples, one.length)
    y = np.add.reduceat(np.where(seen, signal, 0.0), edges, axis=1) / np.maximum(one.counted, 1)
    found = system.solve(system.right_side(binned[None], [(y, none)]), 1e-8, 5000)
    return found.values[0], system.weights[0], len(found.history)


def connected(scan: Scan) -> Any:
    """(n_pixels,) the part of the map that each pixel is in: no baseline leads from one to
    another, so that the mean of each part is not determined.
    """
    one, n_pixels = scan.equations.scans[0].scan, scan.equations.n_pixels
    baseline = np.repeat(np.arange(one.counted.size), np.diff(one.first))
    size = n_pixels + 1 + one.counted.size
    ones = np.ones(len(baseline), bool)
    graph = coo_array((ones, (one.pixel, n_pixels + 1 + baseline)), (size, size))
    return connected_components(graph, directed=False)[1][:n_pixels]


if __name__ == "__main__":
    main()
