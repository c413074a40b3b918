"""Digests of the shipped pipelines' main maps, to see whether a change moved a bit: `python
benchmarks/digests.py [NAME ...]`.

Bits belong to one machine's instruction set and one set of libraries: compare digests that the same
machine has printed.
"""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import llvmlite.binding
import numba
import numpy as np

from zonda.core.configuration.pipeline_file import load
from zonda.core.output import Output
from zonda.core.pipeline import Pipeline

PIPELINES = {
    "mustang2_cluster": (),
    "atlast_reduced": (),
    "atlast_full": (
        "PointingDaisy.scan_duration=2 s",
    ),  # 3.6e8 samples: all detectors, a short scan
}
ARRAYS = ("signal", "hits", "weights", "noise", "half_difference")


def digest(array: np.ndarray) -> str:
    """Of the values; every NaN counts as the same."""
    values = np.where(np.isnan(array), np.nan, array)
    return hashlib.sha256(np.ascontiguousarray(values).tobytes()).hexdigest()[:16]


def main(names: list[str]) -> None:
    """One line a map: a digest of each of its arrays."""
    print(
        f"numba {numba.__version__}, numpy {np.__version__}, CPU"
        f" {llvmlite.binding.get_host_cpu_name()}"
    )
    for name in names or PIPELINES:
        file = load(name, PIPELINES[name])
        steps = [
            o
            for o in file.operators
            if not isinstance(o, Output) and o.provides.isdisjoint({"spectrum", "time_streams"})
        ]
        with TemporaryDirectory() as folder:
            data = Pipeline(steps).run(file.scene(), output=Path(folder), memory=8 * 10**9)
        product = data.products["map"]
        found = {a: getattr(product, a) for a in ARRAYS if getattr(product, a) is not None}
        print(f"{name}:", ", ".join(f"{a} {digest(v)}" for a, v in found.items()))


if __name__ == "__main__":
    main(sys.argv[1:])
