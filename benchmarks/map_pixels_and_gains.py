"""Large scales of maps whose pixels are too large for the beam, and of detectors with wrong gains
(Naess & Louis 2022), for filter-and-bin and maximum likelihood on the same streams.

    python benchmarks/map_pixels_and_gains.py m2         # MUSTANG-2, a daisy of 8.6 min
    python benchmarks/map_pixels_and_gains.py survey     # constant-elevation scans, I
    python benchmarks/map_pixels_and_gains.py gains      # the same, gains wrong by 0 to 5 %
    python benchmarks/map_pixels_and_gains.py bilinear   # samples see one pixel, or four; 60 s

The sky is mapped without noise, with filters and noise models of the complete signal. Its transfer
is that to the mean of the samples in each pixel (of ``bilinear``: to the least-squares map without
slow noise) in rings, a plane off all maps; the error is that of the map without noise, over the rms
of the sky.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import map_makers
import numpy as np
from scipy.sparse.linalg import LinearOperator, cg

import zonda
import zonda.linear as linear

PIXELS = {"beam / 4.5": 1 / 4.5, "beam / 2": 1 / 2, "beam / 1.5": 1 / 1.5}
SCALES = {"m2": [720, 320, 150, 70, 30], "survey": [18000, 7200, 2880, 1150, 460]}
FULL = {"sky": {"only": ["sky"], "modes": "full"}}
GAINS = {"right": "0 %", "5 % wrong": "5 %"}
SERIES = {"right": "0 %"} | {f"{k} % wrong": f"{k} %" for k in (1, 2, 5)}


def scene_of(kind: str, seed: int, folder: str) -> tuple[zonda.Scene, list[Any], list[Any]]:
    """Scene, steps up to `Efficiency`, and filters."""
    if kind == "m2":
        scene, steps, _, filters = map_makers.pipeline("m2", seed)
        daisy = steps[0].model_copy(update={"scans": 1})
        return scene, [daisy, *steps[1:]], filters
    file = Path(folder) / "night.ecsv"
    file.write_text(map_makers.SCHEDULE)
    scene = zonda.Scene(
        site="llano_de_chajnantor",
        instrument=map_makers.LAT,
        time="2025-08-01T05:12",
        seed=seed,
    )
    sky = 1e-4 * map_makers.waves((2048, 2048), seed)[0].reshape(2048, 2048)
    field = {"pixel_size": "0.4 arcmin", "centre": "0.207 deg -10.03 deg", "unit": "K_RJ"}
    steps = [
        zonda.PointingSchedule(
            schedule=str(file), speed="1 deg/s", acceleration="2 deg/s2", turnaround="smooth"
        ),
        zonda.SkyMap(map=sky, **field),
        zonda.AtmosphereLayers(pwv="1 mm"),
        zonda.WhiteNoise(),
        zonda.PinkNoise(),
        zonda.Efficiency(),
    ]
    return scene, steps, [zonda.PolynomialFilter(order=1)]


def kept(scene: zonda.Scene, steps: Sequence[Any], gain: str) -> Any:
    """A run with its streams, in which detectors have gain errors."""
    last = zonda.Efficiency(**{**steps[-1].model_dump(), "calibration_error": gain})
    pipeline = zonda.Pipeline([*steps[:-1], last], runs=FULL)
    return pipeline.run(scene, threads=1, keep=["signal", "signal/sky"])


def study(kind: str, seed: int, pixels: dict[str, float], gains: dict[str, str]) -> None:
    """Transfer and errors by pixel, gains and map maker."""
    with TemporaryDirectory() as folder:
        scene, steps, filters = scene_of(kind, seed, folder)
        runs = {name: kept(scene, steps, gain) for name, gain in gains.items()}
        beam = runs["right"].observations[0].instrument.beam_fwhm
        baseline = {"baseline": "0.1 s"} if kind == "survey" else {}
        for pixel, share in pixels.items():
            how = {"pixel": f"{share * beam} rad", "half_difference": False}
            truth = zonda.map(runs["right"], [zonda.BinMap(**how)], threads=1)["sky/map"]
            rings = map_makers.Rings(truth, SCALES[kind])
            true, use = rings.flat(truth.signal), rings.w > 0.5
            if pixel == next(iter(pixels)):
                scales = " ".join(f"{s:6.0f}" for s in rings.scale)
                print(f"{'pixel, gains, map maker':44s} scale {scales} arcsec  error %")
            for gain, data in runs.items():
                likely = {**how, **baseline}
                endings = {
                    "mean of samples": [zonda.BinMap(**how)],
                    "filter and bin": [*filters, zonda.BinMap(**how)],
                    "maximum likelihood": [zonda.MaximumLikelihoodMap(**likely)],
                    "modes: 0": [zonda.MaximumLikelihoodMap(**likely, modes=0, free=0)],
                }
                for name, ending in endings.items():
                    m = zonda.map(data, ending, threads=1)["sky/map"].signal
                    row = " ".join(f"{t:6.3f}" for t in rings.transfer(m, truth.signal))
                    error = 100 * (rings.flat(m) - true)[use].std() / true[use].std()
                    print(f"{f'{pixel}, {gain}, {name}':50s} {row}        {error:6.2f}", flush=True)


def least_squares(P: Any, Q: LinearOperator, d: Any) -> Any:
    """(P^T Q P)^-1 P^T Q d, (ny, nx)."""
    seen = P.T @ np.ones(P.shape[0])
    inverse = np.where(seen > 0, 1 / np.maximum(seen, 1e-3), 0.0)
    M = LinearOperator((P.shape[1], P.shape[1]), matvec=lambda m: inverse * m, dtype=float)
    m, _ = cg(P.T @ Q @ P, P.T @ (Q @ d), rtol=1e-6, maxiter=300, M=M)
    return m.reshape(P.grid.shape)


def bilinear(seed: int) -> None:
    """Transfer and errors by pixel and pointing; sparse matrices of every sample."""
    scene, steps, _ = scene_of("m2", seed, "")
    steps = [steps[0].model_copy(update={"scan_duration": 60.0}), *steps[1:]]
    data = kept(scene, steps, "0 %")
    (scan,) = data.observations
    d = np.asarray(data.tod("signal/sky"), float).ravel()
    for pixel, share in PIXELS.items():
        side = f"{share * scan.instrument.beam_fwhm} rad"
        for name, modes in (("maximum likelihood", 3), ("modes: 0", 0)):
            maker = zonda.MaximumLikelihoodMap(
                pixel=side, half_difference=False, modes=modes, free=min(modes, 1)
            )
            (runs,), (noise,), _ = linear.compressed(data, maker)
            Q = linear.noise_weight(runs, noise, scan)
            grid = linear.grid(data, maker)
            binned = zonda.map(data, [zonda.BinMap(pixel=side, half_difference=False)])["sky/map"]
            rings = map_makers.Rings(binned, SCALES["m2"])
            for interpolation in ("nearest", "bilinear"):
                P: Any = linear.pointing(scan, grid, interpolation)
                one = LinearOperator(Q.shape, matvec=lambda x: x, rmatvec=lambda x: x, dtype=float)
                true, m = least_squares(P, one, d), least_squares(P, Q, d)
                row = " ".join(f"{t:6.3f}" for t in rings.transfer(m, true))
                use = rings.w > 0.5
                error = (rings.flat(m) - rings.flat(true))[use].std() / rings.flat(true)[use].std()
                label = f"{pixel}, {name}, {interpolation}"
                print(f"{label:50s} {row}        {100 * error:6.2f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kind", choices=["m2", "survey", "gains", "bilinear"])
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    if options.kind == "bilinear":
        bilinear(options.seed)
    elif options.kind == "gains":
        study("survey", options.seed, {"beam / 1.5": PIXELS["beam / 1.5"]}, SERIES)
    else:
        study(options.kind, options.seed, PIXELS, GAINS)


if __name__ == "__main__":
    main()
