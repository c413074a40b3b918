"""Bounds, temperatures and times as text."""

from __future__ import annotations

from collections.abc import Iterable

from .estimate import METRICS, Bound


def describe(bound: Bound, metrics: Iterable[str]) -> str:
    """A bound in the products' units, the metrics that matter only."""
    return ", ".join(f"{m} {figure(m, bound[m])}" for m in METRICS if m in bound and m in metrics)


def figure(metric: str, value: float) -> str:
    """A bound in the unit of its metric, which may name a plane too: ``transfer Q``."""
    return f"{value:.1e}" if metric.split()[0] in ("transfer", "psd") else kelvin(value)


def kelvin(value: float) -> str:
    """A temperature with two figures and a unit that reads well."""
    for factor, unit in ((1.0, "K"), (1e3, "mK"), (1e6, "uK"), (1e9, "nK")):
        if abs(value) * factor >= 1:
            return f"{value * factor:.3g} {unit}"
    return f"{value * 1e9:.1g} nK" if value else "0 K"


def duration(seconds: float) -> str:
    """A duration as text, in s, min or h."""
    if seconds < 120:
        return f"{seconds:.2g} s" if seconds < 10 else f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
