"""TOAST's MapMaker on a scan that zonda saved: python toast_maps.py SCAN.h5 GRID SECONDS [MAP.npy]

Offsets of so many seconds, the pointing kept. Two runs with the noise prior tell what an iteration
takes; with MAP.npy one without a prior makes the map instead.
"""

from __future__ import annotations

import sys

import numpy as np
import toast
import toast.ops
import toast.templates
from astropy import units as u
from common import cpu, peak, report

FEW, MANY, MOST = 2, 22, 2000
"""Iterations that are timed, and of the map."""


def make(data: toast.Data, grid: str, offsets: toast.templates.Offset, **how: object) -> None:
    """Run MapMaker. Products keep the name `maker`."""
    pointing = toast.ops.PointingDetectorSimple()
    pixels = toast.ops.PixelsWCS(detector_pointing=pointing, fits_header=grid, auto_bounds=False)
    binning = toast.ops.BinMap(
        pixel_dist="dist",
        pixel_pointing=pixels,
        stokes_weights=toast.ops.StokesWeights(mode="I", detector_pointing=pointing),
        noise_model="noise_model",
        full_pointing=True,
    )
    written = ("map", "hits", "cov", "invcov", "rcond", "binmap")
    toast.ops.MapMaker(
        name="maker",
        det_data="signal",
        binning=binning,
        template_matrix=toast.ops.TemplateMatrix(templates=[offsets]),
        keep_final_products=True,
        reset_pix_dist=True,
        **{f"write_{name}": False for name in written},
        **how,
    ).apply(data)


def offsets(seconds: float, prior: bool) -> toast.templates.Offset:
    return toast.templates.Offset(
        noise_model="noise_model",
        step_time=seconds * u.s,
        use_noise_prior=prior,
        precond_width=20 if prior else 1,
        good_fraction=0.0,
    )


def main() -> None:
    scan, grid, seconds, *path = sys.argv[1:]
    data = toast.Data(comm=toast.Comm(world=None))
    toast.ops.LoadHDF5(files=[scan]).apply(data)
    signal = data.obs[0].detdata["signal"].data
    signal -= signal.mean(axis=1, keepdims=True)  # some 100 K, of which 1e-8 is too much
    if path:
        start = cpu()
        step = offsets(float(seconds), prior=False)
        # MapMaker compares squares
        make(data, grid, step, iter_min=MOST, iter_max=MOST, convergence=1e-16)
        np.save(path[0], np.asarray(data["maker_map"].data).reshape(-1))
        report(seconds=cpu() - start)
        return
    spent = []
    for number in (FEW, MANY):
        start = cpu()
        step = offsets(float(seconds), prior=True)
        make(data, grid, step, iter_min=number, iter_max=number, convergence=1e-30)
        spent.append(cpu() - start)
    report(
        spent=spent,
        iterations=MANY - FEW,
        version=toast.__version__,
        peak=peak(),
    )


if __name__ == "__main__":
    main()
