"""The rows of the stability matrix that `zonda doctor` measures, and the machine itself."""

from __future__ import annotations

from zonda.core.checks import Case

DECADES = Case(
    "7 decades between atmosphere (30 K) and signal (1 uK)",
    "noiseless transfer function with and without a 30 K atmospheric mean differ by < 1e-3; a"
    " common mode 1e7 x the signal leaves < 1e-8 K in float64, and in float32 the run chooses"
    " float64 or refuses",
)
PINK = Case(
    "1/f noise to f -> 0; hours to days",
    "explicit f_min; PSD within the stated error over the whole band; variance of a week equals"
    " theory",
)
TIME = Case(
    "timestamps ~1.8e9 s; leap seconds; sampling jitter; gaps; NaN rows",
    "t0 kept exact; pointing error < 1e-9 rad over a day",
)
BLOCKS = Case(
    "blocks, threads, workers in any number",
    "identical bits",
)
TWICE = Case(
    "two identical runs, interrupted and resumed",
    "identical bits",
)
DISPATCH = Case(
    "another instruction set, numpy or numba dispatch",
    "tests pass; differences stated, and within float32 rounding",
)
MACHINE = Case("this machine", "what the other figures rest on")
"""Differs from machine to machine: shown by `zonda doctor`, not published."""
