"""The chain of the prototypes (research code, not part of zonda), for `stages.py --prototypes`: its
stages' CPU times.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import sys
import types
from pathlib import Path

STAGES = {
    "atmosphere": ["atm GEMM", "atm upsample"],
    "white and pink noise": ["white+pink"],
    "sky, cubic B-spline": ["sky cubic+pointing"],
    "high-pass": ["HP spread+coarse FFT", "HP subtract+store+mean"],
    "common mode": ["first-mode power x2"],
    "binning": ["subtract mode+pointing+bin"],
}
"""The prototype's names of the stages of `stages.BARS`."""

CASES = {
    "M2": ("M2", 223, 516.0),
    "AT-slice": ("AT", 3000, 32.0),
    "FULL-slice": ("FULL", 1024, 20.0),
}
"""Its case, detectors and seconds: a multiple of its coarse step, near those of `stages.CASES`."""


class Prototype:
    """The prototypes' chain for one of the `CASES`, compiled. ``absent`` says why there is none."""

    def __init__(self, folder: Path, case: str) -> None:
        self.absent = ""
        if case not in CASES:
            self.absent = f"the prototypes have no case like {case}"
        elif not (folder / "e2e.py").exists():
            self.absent = f"no prototypes in {folder}"
        if self.absent:
            return
        os.environ.setdefault("NUMBA_NUM_THREADS", "1")
        sys.dont_write_bytecode = True
        sys.path.append(str(folder))
        with contextlib.suppress(ImportError):
            import finufft  # noqa: F401
        sys.modules.setdefault(
            "finufft", types.ModuleType("finufft")
        )  # imported there, and not used by the chain
        self._chain = importlib.import_module("e2e")
        self._case, self._detectors, self._seconds = CASES[case]
        self.stages(32)

    def stages(self, detectors: int = 0) -> dict[str, float]:
        """Run it; ns of CPU time per sample of the stages in `STAGES`."""
        detectors = detectors or self._detectors
        with contextlib.redirect_stdout(io.StringIO()):
            times = self._chain.pipeline(self._case, detectors, verify=False, Tobs=self._seconds)
        samples = detectors * int(self._seconds * self._chain.q4.case(self._case).fs)
        return {
            stage: sum(times[name] for name in names) / samples * 1e9
            for stage, names in STAGES.items()
        }
