"""Removes what all detectors see alike: the first singular modes of the signal.

With A the stream (detectors x samples) and u_i the leading eigenvectors of G = A A^T, eigenvalues
sigma_i^2,

    A <- A - sum_i u_i v_i^T,
    v_i = A^T u_i.                                                            (1)

G is never formed (`gram`); the modes are iterated (`lanczos`) until

    |G u_i - sigma_i^2 u_i| <= residual * sigma_i^2   for every mode that is removed.            (2)

The detectors' mean (`method: mean`) is found in one reading (`focal_plane_mean`), so that the
stream may be larger than memory and disk; the iteration needs it whole.

The u_i depend on A. With `modes: full` those of the complete data A act on another signal B (the
sky alone):

    B <- B - sum_i u_i (B^T u_i)^T.                                                              (3)

That is what (1) does to the part B of A = B + C: (3) of B plus (3) of C is (1) of A. (1) also
changes with B because B turns the modes: to first order the filtered A changes by (1 - u u^T) B (1
- v v^T / |v|^2), which is (3) but for one degree of freedom in N_samples for each mode, and for
terms of order sigma_2 / sigma_1.
"""

from __future__ import annotations

import copy
from typing import ClassVar, Literal

import numpy as np

from zonda.core.data import Block, Data, Stream
from zonda.core.flags import DEAD
from zonda.core.kernels import kernel

from .mode_search import CommonModeParameters, Modes, ModeSearch


class CommonModeFilter(CommonModeParameters):
    """Filter that removes the leading singular modes of each scan, equation (1). Flagged samples
    and detectors are excluded.

    Detectors whose complete signal is not finite are flagged, and those whose complete signal is
    constant: they are dead. In a scene of the sky alone a constant signal is a valid zero, which
    takes part.
    """

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    knows_means: ClassVar[bool] = True
    linear: ClassVar[bool] = True
    couples: ClassVar[Literal["sample", "detectors", "time", "all"]] = "all"

    @property
    def all_bands(self) -> bool:
        """True where the modes are those of all bands' detectors."""
        return self.group == "all"

    def of_rows(self, measured: Modes, rows: slice) -> Modes:
        """The modes, for some of the detectors."""
        scale = None if measured.scale is None else measured.scale[rows]
        return Modes(measured.detectors[:, rows], measured.times, scale)

    def check(self, data: Data) -> list[str]:
        """Refuse a mask whose file cannot be used."""
        for observation in data.observations[:1] if self.mask is not None else ():
            if self.mask is not None:
                self.mask.of(observation)
        return []

    def measure(self, stream: Stream, model: Modes | None = None) -> Modes:
        """Find the modes; given those of the complete signal (``model``), their times in this
        one.
        """
        if self.group == "wafer":
            return self._wafer_by_wafer(stream, model)
        return self._modes(stream, model)

    def exec(self, block: Block, state: Modes) -> None:
        """Equation (1) on one block."""
        signal = block.detdata["signal"]
        mean = block.means.get("signal")
        if mean is not None and len(state.detectors):
            signal += mean.evaluate(block.detectors, block.samples)
            del block.means["signal"]
        for u, v in zip(state.detectors, state.times, strict=True):
            if not state.parts or u[block.detectors].any():
                _remove(signal, u[block.detectors], v[block.samples])

    def _modes(self, stream: Stream, model: Modes | None) -> Modes:
        """The modes of all detectors that are not flagged; see `measure`."""
        search = ModeSearch(self, stream, self.mask.of(stream.observation) if self.mask else None)
        return search.found() if model is None else search.of(model)

    def _wafer_by_wafer(self, stream: Stream, model: Modes | None) -> Modes:
        """The modes of each wafer's detectors: all others count as flagged."""
        whole, parts = stream.observation, []
        for k, wafer in enumerate(np.unique(whole.focalplane.wafer).tolist()):
            part, others = copy.copy(stream), whole.focalplane.wafer != wafer
            part.observation = copy.copy(whole)
            part.observation.name = f"{whole.name}, wafer {wafer}"
            part.observation.detector_flags = whole.detector_flags | np.where(
                others, DEAD, 0
            ).astype(np.uint8)
            parts.append(self._modes(part, model.parts[k] if model else None))
            whole.detector_flags[~others] |= part.observation.detector_flags[~others]
        detectors, times = (
            np.concatenate(found)
            for found in zip(*((p.detectors, p.times) for p in parts), strict=True)
        )
        return Modes(detectors, times, None, tuple(parts))


@kernel(fastmath={"contract", "nsz"})
def _remove(signal, u, v):  # type: ignore[no-untyped-def]
    """signal -= u v^T in float64, rounded once."""
    n_det, n = signal.shape
    for d in range(n_det):
        row, factor = signal[d], u[d]
        for t in range(n):
            row[t] = np.float64(row[t]) - factor * v[t]
