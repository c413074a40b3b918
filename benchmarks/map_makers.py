"""Maximum-likelihood maps beside filter-and-bin on the same streams: transfer by scale, peak,
noise, signal-to-noise ratio of the true source, CPU time of an iteration.

    python benchmarks/map_makers.py m2                  # MUSTANG-2, two daisies of 8.6 min
    python benchmarks/map_makers.py m2 --seeds 12       # and the mean noise over so many seeds
    python benchmarks/map_makers.py m2 --iterated 2 10  # and filter-and-bin that is iterated
    python benchmarks/map_makers.py m2 --templates 6    # S/N of the cluster, over so many seeds
    python benchmarks/map_makers.py atlast              # AtLAST's reduced camera, a daisy of 20 s
    python benchmarks/map_makers.py survey              # constant-elevation scans, I, Q and U
    python benchmarks/map_makers.py plate               # the same with a half-wave plate: cost
    python benchmarks/map_makers.py gaps                # MUSTANG-2, 2 min, samples of some missing

Transfer and noise are those of rings in angular frequency under a window of the hits, a plane taken
off all maps. CPU seconds are those of one thread.
"""

from __future__ import annotations

import argparse
import os
import time
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402
from scipy import fft, ndimage  # noqa: E402

import zonda  # noqa: E402
import zonda.linear as linear  # noqa: E402
from zonda.core.numerics.projection import directions  # noqa: E402

RESPONSE = "AtmosphereLayers.layer_response=layer"
PIPELINES = {
    "m2": ("mustang2_cluster", ("PointingDaisy.scans=2", RESPONSE)),
    "atlast": (
        "atlast_reduced",
        ("PointingDaisy.scans=1", "PointingDaisy.scan_duration=20 s", RESPONSE),
    ),
}
SCALES = {
    "m2": [720, 480, 320, 220, 150, 100, 70, 50, 30, 20, 12, 8],
    "atlast": [1800, 1200, 800, 500, 300, 180, 100, 60, 30, 15],
}
BEAM = {"m2": 9, "atlast": 15}
REPEAT = 3
"""Solutions that are timed; the least counts."""


class Solved(NamedTuple):
    """Equations, right side and solution of the complete signal, CPU seconds of its iterations (the
    least), and those of all solutions that were timed.
    """

    equations: Any
    right: Any
    solution: Any
    seconds: float
    timed: float


KEPT: list[Solved] = []


class Maker(zonda.MaximumLikelihoodMap):
    """The map maker, which keeps what it solves."""

    def finalize(self, data: Any) -> None:
        (made,) = self.maps([data])
        equations, spent = made.system.equations, []
        for _ in range(1 + REPEAT):
            start = time.process_time()
            solution = made.system.solved("signal")
            spent.append(time.process_time() - start)
        right = made.system.right_side(equations, "signal")
        # the first makes smooth patterns, too
        KEPT[:] = [Solved(equations, right, solution, min(spent[1:]), sum(spent))]
        made.finish(data)


def pipeline(kind: str, seed: int) -> tuple[zonda.Scene, list[Any], dict[str, Any], list[Any]]:
    """Scene, steps up to the calibrated streams, parameters of the map, and filters."""
    file = zonda.load(*PIPELINES[kind])
    steps = [step.operator for step in file.steps]
    end = 1 + next(k for k, step in enumerate(steps) if isinstance(step, zonda.Efficiency))
    filters = [s for s in steps if isinstance(s, zonda.HighpassFilter | zonda.CommonModeFilter)]
    pixel = next(step.pixel for step in steps if isinstance(step, zonda.BinMap))
    how = {"pixel": f"{pixel} rad", "half_difference": False}
    return file.scene().model_copy(update={"seed": seed}), steps[:end], how, filters


SIGNALS = {"sky": {"only": ["sky"]}, "rest": {"without": ["sky"]}}


def run(scene: zonda.Scene, steps: list[Any], full: bool = False, signals: Any = SIGNALS) -> Any:
    """Products of a pipeline; ``full``: filters act as they do on the complete signal."""
    runs = {name: {**how, **({"modes": "full"} if full else {})} for name, how in signals.items()}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return zonda.Pipeline(steps, runs=runs).run(scene, threads=1)


def iterated(kind: str, seed: int, number: int) -> tuple[Any, Any]:
    """Maps of the sky and of the rest: ``number`` times the map is subtracted from the streams, and
    what filters leave of the difference is added to it.
    """
    scene, steps, how, filters = pipeline(kind, seed)
    kept = zonda.Pipeline(steps, runs={"sky": {**SIGNALS["sky"], "modes": "full"}}).run(
        scene, threads=1, keep=["signal", "signal/sky"]
    )
    maps: dict[str, Any] = {}
    pixels: dict[str, Any] = {}

    def less_the_map(block: Any) -> None:
        m = np.append(np.nan_to_num(maps[block.suffix]), 0.0)
        at = pixels[block.observation.name][block.detectors, block.samples]
        block.detdata["signal"] -= m[at]

    again = zonda.operator(less_the_map, linear=True)
    for _ in range(number):
        first = [again] if maps else []
        made = zonda.map(kept, [*first, *filters, zonda.BinMap(**how)], threads=1)
        for suffix, name in (("", "map"), ("/sky", "sky/map")):
            maps[suffix] = maps.get(suffix, 0.0) + made[name].signal
        for scan in () if pixels else kept.observations:
            places = directions(scan.boresight_radec, scan.focalplane.xi, scan.focalplane.eta)
            pixels[scan.name] = made["map"].grid.pixels_at(places).astype(np.int32)
    return maps["/sky"], maps[""] - maps["/sky"]


class Rings:
    """Window of the hits (smooth, zero where thin) and rings between angular ``scales``, arcsec."""

    def __init__(self, product: Any, scales: list[float]) -> None:
        hits, arcsec = product.hits.astype(float), np.degrees(product.pixel) * 3600
        h = ndimage.gaussian_filter(hits, 4)
        w = np.clip((h / np.percentile(h, 98) - 0.15) / 0.35, 0, 1)
        self.w = ndimage.gaussian_filter(w, 6) * (hits > 0) * (w > 0)
        ny, nx = hits.shape
        k = np.hypot(*np.meshgrid(np.fft.fftfreq(nx, arcsec), np.fft.fftfreq(ny, arcsec)))
        edges = 1 / np.asarray(scales, float)
        self.index, self.n = np.digitize(k, edges) - 1, len(scales) - 1
        self.scale = 1 / np.sqrt(edges[1:] * edges[:-1])
        y, x = np.indices(hits.shape)
        root = np.sqrt(self.w).ravel()
        basis = np.stack([np.ones(x.size), x.ravel() - nx / 2, y.ravel() - ny / 2], axis=1)
        self.q, self.root = np.linalg.qr(basis * root[:, None])[0], root

    def flat(self, m: Any) -> Any:
        """A map under the window without the plane that fits best."""
        v = np.nan_to_num(m).ravel() * self.root
        v -= self.q @ (self.q.T @ v)
        return (v * np.where(self.root > 0, 1 / np.where(self.root > 0, self.root, 1), 0)).reshape(
            m.shape
        )

    def sums(self, x: Any) -> Any:
        return np.array([x[self.index == r].sum() for r in range(self.n)])

    def transfer(self, m: Any, true: Any) -> Any:
        a, b = (np.fft.fft2(self.flat(x) * self.w) for x in (true, m))
        return self.sums((b * a.conj()).real) / self.sums(np.abs(a) ** 2)

    def smooth(self, m: Any, product: Any, fwhm: float) -> Any:
        s = fwhm / 2.3548 / (np.degrees(product.pixel) * 3600)
        h = product.hits * (self.w > 0)
        total = ndimage.gaussian_filter(h.astype(float), s)
        return ndimage.gaussian_filter(self.flat(m) * h, s) / np.maximum(total, 1e-3 * h.max())


def compare(kind: str, seed: int, again: Sequence[int], baseline: str | None) -> float:
    """Print transfer, peak and noise; the noise of maximum likelihood over filter and bin's."""
    scene, steps, how, filters = pipeline(kind, seed)
    truth = run(scene, [*steps, zonda.BinMap(**how)], signals={"sky": SIGNALS["sky"]})["sky/map"]
    binned = run(scene, [*steps, *filters, zonda.BinMap(**how)], full=True)
    start = time.process_time()
    likely = run(scene, [*steps, Maker(**how, baseline=baseline)])
    seconds = time.process_time() - start
    rings, beam = Rings(truth, SCALES[kind]), BEAM[kind]
    core = rings.w > 0.9
    true = rings.smooth(truth.signal, truth, beam)
    at = np.unravel_index(np.argmin(np.where(core, true, 0)), true.shape)
    samples = int(truth.hits.sum())
    equations, _, solution, cpu, timed = KEPT[0]
    runs = sum(scan.pixel.size for scan, _ in equations.scans) / samples
    print(f"{samples:.3g} samples, {runs:.2f} runs a sample, {seconds - timed:.1f} CPU s in all")
    print(
        f"{len(solution.history)} iterations to {solution.history[-1]:.0e},"
        f" {cpu / len(solution.history) / samples * 1e9:.1f} ns a sample and iteration;"
        f" smallest Ritz value {solution.ritz[0]:.1e}"
    )
    print("scale [arcsec]     ", *(f"{s:6.0f}" for s in rings.scale))
    maps = {
        name: (data["sky/map"].signal, data["rest/map"].signal)
        for name, data in (("filter and bin", binned), ("maximum likelihood", likely))
    }
    maps |= {f"iterated {number} times": iterated(kind, seed, number) for number in again}
    levels: dict[str, float] = {}
    for name, (sky, rest) in maps.items():
        transfer = rings.transfer(sky, truth.signal)
        levels[name] = noise = rings.smooth(rest, truth, beam)[core].std()
        ratio = noise / levels["filter and bin"]
        peak = rings.smooth(sky, truth, beam)[at] / true[at]
        print(
            f"{name:19s}",
            *(f"{t:6.3f}" for t in transfer),
            f" peak {peak:.3f}, noise in {beam} arcsec {noise * 1e6:.0f} uK, {ratio:.3f}",
        )
    return levels["maximum likelihood"] / levels["filter and bin"]


PLACES = ((0, 0), (30, 30), (-30, 30), (30, -30))
"""Shifts of the cluster in rows and columns."""


def variance(w: Any, scan: Any, white: float) -> float:
    """Variance of the sum of a scan's white and pink noise times ``w`` (n_det n_samp,), whose white
    noise has the variance ``white`` a sample, K^2: exact.
    """
    rows = w.reshape(scan.n_detectors, -1)
    n = 2 * fft.next_fast_len(rows.shape[1])
    f = np.fft.rfftfreq(n, 1 / scan.sample_rate)
    step = f[1]
    f[0] = step / 2
    own = sum((np.abs(fft.rfft(part, n)) ** 2).sum(axis=0) for part in np.array_split(rows, 16))
    even = np.abs(fft.rfft(rows.sum(axis=0), n)) ** 2
    pink = sum(
        form(f) * ((1 - form.shared) * own + form.shared * even)
        for form in scan.closed_forms["pink"]
    )
    return float(white * (w @ w) + step * np.sum(pink))


def templates(seeds: list[int]) -> None:
    """Signal-to-noise ratio of the true cluster t, at four places for each seed.

    Both map makers measure its amplitude as a = w^T d / w^T P t, with w = Q P t of maximum
    likelihood, and w = F^T P t of filters F, of which the map of hits h has t^T h m = w^T d. The
    variance of w^T n is exact for white and pink noise; that of the atmosphere is its mean over the
    draws. Maximum likelihood states w^T P t.
    """
    scene, steps, how, filters = pipeline("m2", 1)
    quiet = [s for s in steps if not {"white", "pink", "atmosphere"} & set(s.provides)]
    truth = run(scene, [*quiet, zonda.BinMap(**how)], signals={})["map"]
    t = np.nan_to_num(truth.signal)
    signals = {name: {"only": [name]} for name in ("atmosphere", "white")}
    kept = ["signal", *(f"signal/{name}" for name in signals)]
    found = np.zeros((len(seeds), 2, len(PLACES), 3))
    for sums, seed in zip(found, seeds, strict=True):
        data = zonda.Pipeline(steps, runs=signals).run(
            scene.model_copy(update={"seed": seed}), threads=1, keep=kept
        )
        grid = linear.grid(data, zonda.BinMap(**how))
        scans, noises, _ = linear.compressed(data, zonda.MaximumLikelihoodMap(**how))
        for scan, compressed, noise in zip(data.observations, scans, noises, strict=True):
            signal, air, white = (np.asarray(scan.detdata[name], float) for name in kept)
            F = linear.filters(filters, scan, linear.modes(filters, scan, signal))
            P, Q = linear.pointing(scan, grid), linear.noise_weight(compressed, noise, scan)
            for k, place in enumerate(PLACES):
                seen = P @ np.roll(t, place, (0, 1)).ravel()
                for row, w in zip(sums[:, k], (F.T @ seen, Q @ seen), strict=True):
                    row += w @ seen, variance(w, scan, white.var()), w @ air.ravel()
        print(seed, *(f"{x:.4g}" for x in sums.ravel()))
    ratio = []
    for name, (size, quiet_power, air) in zip(
        ("filter and bin", "maximum likelihood"), np.moveaxis(found, (1, 3), (0, 1)), strict=True
    ):
        share = (air**2 / quiet_power).mean(axis=1)
        error = share.std(ddof=1) / np.sqrt(len(seeds)) if len(seeds) > 1 else np.nan
        best = float((size / np.sqrt(quiet_power)).mean())
        ratio.append(best / np.sqrt(1 + share.mean()))
        half = error / (1 + share.mean()) / 2
        print(
            f"{name}: S/N {best:.2f} without the atmosphere, whose power is {share.mean():.3f} +-"
            f" {error:.3f} of the other noise: {ratio[-1]:.2f} +- {ratio[-1] * half:.2f}"
        )
    size, quiet_power, air = np.moveaxis(found[:, 1], 2, 0)
    z = np.sqrt(((quiet_power + air**2) / size).mean())
    print(
        f"ratio {ratio[1] / ratio[0]:.3f}; maximum likelihood states {np.sqrt(size).mean():.2f},"
        f" rms of deviates {z:.3f}"
    )


SCHEDULE = """# %ECSV 1.0
# ---
# datatype:
# - {name: name, datatype: string}
# - {name: start_time, datatype: string}
# - {name: stop_time, datatype: string}
# - {name: boresight_angle, unit: deg, datatype: float64}
# - {name: azmin, unit: deg, datatype: float64}
# - {name: azmax, unit: deg, datatype: float64}
# - {name: el, unit: deg, datatype: float64}
# - {name: scan_index, datatype: int32}
# - {name: subscan_index, datatype: int32}
# meta:
#   site_name: Atacama
#   telescope_name: LAT
#   site_lat: -22.958064 deg
#   site_lon: -67.786222 deg
#   site_alt: 5200.0 m
# schema: astropy-2.0
name start_time stop_time boresight_angle azmin azmax el scan_index subscan_index
field "2025-08-01 05:12:30" "2025-08-01 05:15:00"  0.0  73.0  82.0 50.0 0 0
field "2025-08-01 05:15:10" "2025-08-01 05:17:40" 45.0  73.0  82.0 50.0 0 1
field "2025-08-01 10:27:30" "2025-08-01 10:30:00"  0.0 278.0 287.0 50.0 1 0
field "2025-08-01 10:30:10" "2025-08-01 10:32:40" 45.0 278.0 287.0 50.0 1 1
"""
LAT = {
    "name": "lat",
    "telescope": {"name": "LAT", "diameter": "6 m"},
    "band": {"name": "f150", "low": "127 GHz", "high": "169 GHz"},
    "net": "360 uK s(1/2)",
    "fwhm": "1.4 arcmin",
    "pixels": "shared",
    "polarization": "pairs",
    "detectors": 74,
    "field_of_view": "1 deg",
    "main_beam_efficiency": 0.9,
    "illumination_efficiency": 1,
    "knee": "1 Hz",
    "sample_rate": "100 Hz",
}


ITERATIONS = (15, 30, 60, 120)


def waves(shape: tuple[int, int], seed: int) -> Any:
    """I, Q and U of a random field with a power of 1 / k^2, Q and U a tenth of I."""
    k = np.hypot(*np.meshgrid(*(np.fft.fftfreq(n) for n in shape), indexing="ij"))
    white = np.random.default_rng(seed).normal(size=(3, *shape))
    field = np.fft.ifft2(np.fft.fft2(white) / np.where(k > 0, k, np.inf)).real
    field *= np.array([1.0, 0.1, 0.1])[:, None, None] / field.std(axis=(1, 2), keepdims=True)
    return field.reshape(3, -1)


def convergence(equations: Any, shape: tuple[int, int], ok: Any, seed: int) -> None:
    """Error of I of a map without noise, its mean off, over the rms of the sky, by iteration, with
    and without smooth patterns in the preconditioner.
    """
    sky = waves(shape, seed) * ok.ravel()
    right = equations.apply(sky)
    print("error of I without noise after " + ", ".join(map(str, ITERATIONS)) + " iterations, %")
    for name, places in (("pixels", None), ("smooth patterns", equations.places)):
        system, row = replace(equations, places=places), []
        for most in ITERATIONS:
            error = (system.solve(right, 1e-4, most).values - sky)[0, ok.ravel()]
            row.append(100 * error.std() / sky[0, ok.ravel()].std())
        start = time.process_time()
        found = system.solve(right, 1e-4, 1000)
        seconds = time.process_time() - start
        print(
            f"{name:19s}", ", ".join(f"{e:.3g}" for e in row),
            f" to 1e-4: {len(found.history)} iterations, {seconds:.1f} CPU s",
        )  # fmt: skip


def night(seed: int, folder: str) -> tuple[zonda.Scene, list[Any], dict[str, Any]]:
    """Scene, steps up to the calibrated streams, and parameters of the map of a survey."""
    file = Path(folder) / "night.ecsv"
    file.write_text(SCHEDULE)
    scene = zonda.Scene(
        site="llano_de_chajnantor", instrument=LAT, time="2025-08-01T05:12", seed=seed
    )
    steps = [
        zonda.PointingSchedule(
            schedule=str(file), speed="1 deg/s", acceleration="2 deg/s2", turnaround="smooth"
        ),
        zonda.AtmosphereLayers(pwv="1 mm"),
        zonda.WhiteNoise(),
        zonda.PinkNoise(),
        zonda.Efficiency(),
    ]
    return scene, steps, {"pixel": "3 arcmin", "stokes": "IQU", "half_difference": False}


def cost() -> str:
    """Runs, bytes and time of the last solution, of each sample."""
    equations, _, solution, cpu, _ = KEPT[0]
    scans = [scan for scan, _ in equations.scans]
    samples = sum(scan.shape[0] * scan.n_samples for scan in scans)
    n = len(solution.history)
    runs, size = sum(scan.pixel.size for scan in scans), sum(scan.nbytes for scan in scans)
    return (
        f"{samples:.3g} samples, {runs / samples:.2f} runs and {size / samples:.1f} bytes a sample;"
        f" {n} iterations, {cpu / n / samples * 1e9:.1f} ns a sample and iteration"
    )


def plate(seed: int) -> None:
    """Cost of a survey with and without a half-wave plate."""
    with TemporaryDirectory() as folder:
        scene, (pointing, *steps), how = night(seed, folder)
        for name, more in (("no plate", []), ("plate", [zonda.HalfWavePlate(frequency="2 Hz")])):
            run(scene, [pointing, *more, *steps, Maker(**how, baseline="0.1 s")], signals={})
            print(f"{name:9s}", cost())


def missing(what: str, row: Any, n_det: int, t: Any, n: int) -> Any:
    """(n_det, n_samp) True for samples that are missing; ``row``, ``t``: their numbers."""
    row, t = np.asarray(row)[:, None], np.asarray(t)[None]
    if what == "a third of every second detector, at the end":
        return (row % 2 == 0) & (t >= 2 * n // 3)
    if what == "a third of every second detector, within":
        return (row % 2 == 0) & (t >= n // 3) & (t < 2 * n // 3)
    if what == "a quarter of each detector, at other times":
        return (t + row * n // n_det) % n < n // 4
    raise ValueError(what)


GAPS = (
    "nothing",
    "a third of every second detector, at the end",
    "a third of every second detector, within",
    "a quarter of each detector, at other times",
)


def gaps(seed: int) -> None:
    """Noise of a daisy of which samples of some detectors are missing, over that without gaps, and
    over the noise of as many samples; and cost.
    """
    scene, steps, how, _ = pipeline("m2", seed)
    daisy = steps[0].model_copy(update={"scans": 1, "scan_duration": 120.0})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        data = zonda.Pipeline([daisy, *steps[1:]], runs={"rest": SIGNALS["rest"]}).run(
            scene, threads=1, keep=["signal", "signal/rest"]
        )
    first = 0.0
    for what in GAPS:

        def lose(block: Any, what: str = what) -> None:
            o, d, t = block.observation, block.detectors, block.samples
            rows, times = np.arange(d.start, d.stop), np.arange(t.start, t.stop)
            lost = missing(what, rows, o.n_detectors, times, o.n_samples)
            block.detdata["signal"][lost] = np.nan

        loses = [] if what == "nothing" else [zonda.operator(lose, linear=True)]
        made = zonda.map(data, [*loses, Maker(**how)], threads=1)
        product = made["rest/map"]
        if not first:
            rings, all_hits = Rings(product, SCALES["m2"]), product.hits.sum()
        noise = rings.smooth(product.signal, product, BEAM["m2"])[rings.w > 0.9].std()
        first = first or noise
        ratio, left = noise / first, product.hits.sum() / all_hits
        print(
            f"missing: {what:44s} noise {ratio:.3f}, {ratio * np.sqrt(left):.3f} for as many"
            f" samples; {cost()}",
            flush=True,
        )


def survey(seed: int) -> None:
    """Noise of I, Q and U over white noise, and convergence."""
    with TemporaryDirectory() as folder:
        scene, steps, how = night(seed, folder)
        start = time.process_time()
        found = run(scene, [*steps, Maker(**how, baseline="0.1 s")], signals={})["map"]
        seconds = time.process_time() - start
        filters = [zonda.PolynomialFilter(order=1)]
        binned = run(scene, [*steps, *filters, zonda.BinMap(**how)], signals={})["map"]
    equations, right, solution, cpu, timed = KEPT[0]
    samples = int(found.hits.sum())
    print(
        f"{samples:.3g} samples, {len(solution.history)} iterations,"
        f" {cpu / len(solution.history) / samples * 1e9:.1f} ns a sample and iteration,"
        f" {seconds - timed:.1f} CPU s in all"
    )
    plain = replace(equations, places=None).solve(right, 1e-4, 1000)
    print(f"{len(plain.history)} iterations without smooth patterns")
    weight = found.stokes("I").weights
    ok = found.known & (weight > 0.3 * np.percentile(weight[found.known], 95))
    for name, product in (("a line per detector", binned), ("maximum likelihood", found)):
        ratio = []
        for k in "IQU":
            one = product.stokes(k)
            m = one.signal - np.nanmean(one.signal[ok])
            ratio.append(np.nanstd((m / found.stokes(k).noise)[ok]))
        print(f"{name:19s} noise over white: " + ", ".join(f"{r:.2f}" for r in ratio))
    convergence(equations, found.hits.shape, ok, seed)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kind", choices=["m2", "atlast", "survey", "plate", "gaps"])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--baseline", help="e.g. '0.2 s'; where absent, by the scan")
    parser.add_argument("--templates", type=int, default=0, metavar="SEEDS")
    parser.add_argument("--iterated", type=int, nargs="*", default=[], metavar="TIMES")
    options = parser.parse_args()
    if options.templates:
        templates([options.seed + k for k in range(options.templates)])
    elif (
        special := {"survey": survey, "plate": plate, "gaps": gaps}.get(options.kind)
    ) is not None:
        special(options.seed)
    else:
        seeds = range(options.seed, options.seed + options.seeds)
        ratio = [compare(options.kind, seed, options.iterated, options.baseline) for seed in seeds]
        if len(ratio) > 1:
            error = np.std(ratio, ddof=1) / np.sqrt(len(ratio))
            each = ", ".join(f"{r:.3f}" for r in ratio)
            print(f"noise over filter and bin's: {np.mean(ratio):.3f} +- {error:.3f} ({each})")


if __name__ == "__main__":
    main()
