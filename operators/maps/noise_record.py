"""Product ``noise_model`` of maximum-likelihood maps: the noise of each scan, and how the map was
found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from zonda.core.canvas import SEQUENCE, Sketch, finish, new_axes
from zonda.core.tables import html_table
from zonda.core.types import Floats

from .baseline_noise import BaselineNoise
from .normal_equations import Work

if TYPE_CHECKING:
    from zonda.core.storage.table_files import Column


WIDTHS: dict[str, Any] = {"width_ratios": (0.5, 0.3), "gridspec_kw": {"wspace": 0.3}}
"""Of two axes side by side."""


@dataclass(frozen=True, repr=False)
class NoiseRecord:
    """Noise models of scans, and the solution for the map of the complete signal.

    Attributes
    ----------
    scans, models
        Name of each scan, and its `BaselineNoise`: spectra D and E_k, modes, their power, white
        level of each detector.
    history, ritz, before
        As of `Solution`.
    chi2
        Per degree of freedom of the samples, and its standard error.
    tolerance, label
        Residual that was wanted; the step.
    noise
        Where the models come from, in words.
    work
        For all solutions.
    """

    scans: list[str]
    models: list[BaselineNoise]
    history: list[float]
    ritz: Floats
    before: int
    chi2: tuple[float, float]
    tolerance: float
    label: str
    noise: str
    work: Work = field(default_factory=Work, compare=False)

    def tables(self) -> dict[str, list[Column]]:
        """Spectra and power of the modes of each scan, residuals and Ritz values."""
        from zonda.core.storage.table_files import Column

        models, history = self.models, self.history
        most = max(len(one.values) for one in models)

        def of_modes(rows: Sequence[Any], name: str, text: str) -> list[Column]:
            more = ((0, 0), (0, most))
            wide = np.concatenate(
                [np.pad(row, more, constant_values=np.nan)[:, :most] for row in rows]
            )
            return [Column(f"{name}{k}", wide[:, k - 1], "", text) for k in range(1, most + 1)]

        scans = np.repeat(np.arange(len(models)), [len(one.own) for one in models])
        unit = "in units of white noise"
        spectra = [
            Column("scan", scans, "", ", ".join(self.scans)),
            Column(
                "frequency", np.concatenate([m.frequency for m in models]), "Hz", "middle of a bin"
            ),
            Column("own", np.concatenate([m.own for m in models]), "", f"D: baselines, {unit}"),
            *of_modes([m.shared for m in models], "mode_", f"E: of a shared mode beside D, {unit}"),
        ]
        power = [
            Column("scan", np.arange(len(models)), "", ", ".join(self.scans)),
            Column("white", [np.sqrt(m.white.mean()) for m in models], "K", "rms of a sample"),
            Column("free", [m.free for m in models], "", "modes without weight, the first"),
            *of_modes([m.values[None] for m in models], "power_", f"of a mode below 1 Hz, {unit}"),
        ]
        found = [
            Column("iteration", np.arange(1, len(history) + 1), "", "of conjugate gradients"),
            Column("residual", history, "", "its norm over that of the right side"),
        ]
        ritz = "information over that of white noise, rising"
        return {
            "": spectra,
            "_modes": power,
            "_convergence": found,
            "_ritz": [Column("ritz", self.ritz, "", ritz)],
        }

    def sketches(self, name: str) -> list[Sketch]:
        """Spectra and power of modes, and the way to the map; see `core.canvas.Drawable`."""
        return [self._noise(name), self._convergence(f"{name}_convergence")]

    def _noise(self, name: str) -> Sketch:
        left, right = new_axes((9.6, 4.2), ncols=2, **WIDTHS)
        for k, model in enumerate(self.models):
            f = model.frequency[1:]
            for j, power in enumerate([model.own, *model.shared.T]):
                label = f"mode {j}{', free' if j <= model.free else ''}" if j else "each detector"
                colour = SEQUENCE[(j - 1) % 6] if j else "black"
                style: dict[str, Any] = {"color": colour, "label": "" if k else label}
                left.loglog(f, np.where(power[1:] > 0, power[1:], np.nan), linewidth=1.0, **style)
            number = np.arange(1, len(model.values) + 1)
            right.semilogy(
                number, model.values, "o-", color=SEQUENCE[0], linewidth=0.6, markersize=4
            )
        left.axhline(1.0, color="0.5", linestyle="--", linewidth=1.0)
        right.set_xticks(number[:: 1 + len(number) // 10])
        up = "power / white noise"
        finish(left, "frequency [Hz]", up, "Noise of baselines", loc="upper right")
        finish(right, "mode", f"{up}, below 1 Hz", "Power of modes")
        value, error = self.chi2
        caption = (
            f"Spectra of the noise model ({self.noise}), in units of white noise (dashed): of each"
            " detector, and of modes that detectors share, beside it; free modes have no weight in"
            f" the map. A line for each of {len(self.models)} scans. Right: mean power of the modes"
            " below 1 Hz."
            f" χ² per sample is {value:.4g} ± {error:.1g}."
        )
        return Sketch(name, "Noise model", caption, left)

    def _convergence(self, name: str) -> Sketch:
        left, right = new_axes((9.6, 4.2), ncols=2, **WIDTHS)
        history, ritz = self.history, self.ritz
        left.semilogy(np.arange(1, len(history) + 1), history, ".-", color=SEQUENCE[0])
        left.axhline(self.tolerance, color="0.5", linestyle="--", linewidth=1.0)
        if self.before:
            left.axvline(self.before + 0.5, color="0.5", linestyle=":", linewidth=1.0)
        right.semilogy(np.arange(1, len(ritz) + 1), np.maximum(ritz, 1e-12), ".", color=SEQUENCE[1])
        finish(left, "iteration", "residual / right side", "Convergence")
        finish(right, "number", "Ritz value", "Information over white noise's")
        caption = (
            "Norm of the residual after each iteration, and the tolerance (dashed; dotted: smooth"
            " patterns join the preconditioner). Right: Ritz values; one far below 1 is a pattern"
            " whose noise is far above white noise."
        )
        return Sketch(name, "Convergence of the map", caption, left)

    def __repr__(self) -> str:
        return f"<NoiseRecord of {len(self.scans)} scans, {len(self.history)} iterations>"

    def _repr_html_(self) -> str:
        rows = [
            (scan, ", ".join(f"{value:.3g}" for value in model.values) or "no modes")
            for scan, model in zip(self.scans, self.models, strict=True)
        ]
        value, error = self.chi2
        rows.append(("noise model", self.noise))
        rows.append(("chi^2 per sample", f"{value:.5g} +- {error:.1g}"))
        return html_table("Power of modes over white noise", rows)
