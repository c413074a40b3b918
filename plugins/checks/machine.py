"""The machine that zonda runs on: arithmetic, caches, memory, tables. Only for `zonda doctor`."""

from __future__ import annotations

import datetime
import math
import os
import platform
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from zonda.core.checks import Family, Measured
from zonda.core.kernels import folder

from .scenes import MACHINE

checks = Family("machine")

ULP = 2.0**-52

# arguments and correctly rounded values (mpmath, 60 digits; tests/test_hard_cases.py makes them
# again)
FUNCTIONS = (
    ("exp", 1.0, 2.718281828459045),
    ("exp", -700.5, 5.980196118639791e-305),
    ("expm1", 1e-10, 1.00000000005e-10),
    ("log", 3.0, 1.0986122886681098),
    ("log1p", 1e-10, 9.999999999500001e-11),
    ("sin", 1e6, -0.34999350217129294),
    ("cos", 1e6, 0.9367521275331447),
    ("tan", 1.5, 14.101419947171719),
    ("arctan", 0.7, 0.6107259643892086),
    ("sqrt", 2.0, 1.4142135623730951),
    ("cbrt", 3.0, 1.4422495703074083),
)


def description() -> dict[str, str]:
    """Describe this machine: interpreter, libraries, CPU, memory, threads."""
    from zonda.core.machine import available_memory, available_threads, versions

    found = versions()
    cpu, features = _cpu()
    found["cpu"] = cpu
    found["vector units"] = (
        " ".join(
            f for f in ("sse4.2", "avx", "avx2", "fma", "avx512f", "neon", "sve") if f in features
        )
        or "?"
    )
    found["long double"] = f"{np.finfo(np.longdouble).nmant + 1} bits"
    found["threads"] = f"{available_threads()} of {os.cpu_count()}"
    found["free memory"] = f"{available_memory() / 1e9:.1f} GB"
    found["compiled code"] = str(folder() or "not kept")
    found["system"] = f"{platform.system()} {platform.release()}"
    return found


def _cpu() -> tuple[str, set[str]]:
    """Name and features of the CPU as LLVM sees them: what compiled code is made for."""
    from llvmlite import binding

    return binding.get_host_cpu_name(), {
        name for name, there in binding.get_host_cpu_features().items() if there
    }


@checks.add(MACHINE, reference="IEEE 754", limit=0, unit="operations")
def denormals() -> Measured:
    """denormal numbers flushed to zero, float32 and float64, in the main thread and in two others,
    after compiled code ran

    A library built with -ffast-math switches them off for the whole process.
    """
    from zonda.core.numerics.random import normals, stream_key

    def flushed(_: int) -> int:
        normals(stream_key(1, "doctor"), 0, 10)
        tiny64, tiny32 = np.full(8, 2.3e-308), np.full(8, 1.2e-38, np.float32)
        return int((tiny64 / 4 == 0).any()) + int((tiny32 / np.float32(4) == 0).any())

    with ThreadPoolExecutor(2) as pool:
        count = sum(pool.map(flushed, range(4))) + flushed(0)
    return count, "flushed" if count else "kept"


@checks.add(
    MACHINE,
    reference="IEEE 754, to nearest even, no excess precision",
    limit=0,
    unit="operations",
)
def rounding() -> int:
    """float64 sums, products and quotients that are rounded in another way"""
    one = np.float64(1.0)
    half = np.float64(ULP / 2)
    excess = (np.float64(1e16) + np.float64(2.9999)) - np.float64(1e16)
    good = [
        one + half == one,
        one + half * 1.0001 != one,
        one + ULP + half == one + 2 * ULP,
        excess == 2.0 or excess == 4.0,
    ]
    good += [
        np.float64(0.1) + np.float64(0.2) == 0.30000000000000004,
        np.float64(1) / np.float64(49) * np.float64(49) != 1.0,
    ]
    good += [
        np.float64(5e-324) > 0,
        math.fsum([1e100, 1.0, -1e100]) == 1.0,
        np.float32(16777217) == np.float32(16777216),
    ]
    return sum(not g for g in good)


@checks.add(
    MACHINE,
    reference="60-digit arithmetic (mpmath)",
    limit=4,
    unit="units in the last place",
)
def elementary_functions() -> Measured:
    """error of exp, log, sin and their like, of vectors as zonda calls them"""
    worst = 0.0
    which = ""
    for name, x, exact in FUNCTIONS:
        found = getattr(np, name)(np.full(16, x))
        error = float(abs(found - exact).max() / np.spacing(abs(exact)))
        if not error <= worst:
            worst = error
            which = f"{name}({x:g})"
    return worst, which


@checks.add(MACHINE, reference="a lock taken in the folder", limit=0, unit="folders")
def writable_cache() -> Measured:
    """whether compiled code can be kept: without it every run compiles for half a minute"""
    place = folder()
    if place is None:
        return 1, "set NUMBA_CACHE_DIR to a folder of yours that lasts"
    return 0, str(place)


@checks.add(MACHINE, reference="1 GB, enough for the shipped pipelines", limit=0, unit="GB short")
def memory() -> Measured:
    """free memory"""
    from zonda.core.machine import available_memory

    free = available_memory() / 1e9
    return max(0.0, 1.0 - free), f"{free:.1f} GB free"


@checks.add(MACHINE, reference="today", limit=0, unit="days short")
def earth_orientation() -> Measured:
    """how far the bundled IERS tables, predictions included, fall short of today; pip install -U
    astropy-iers-data renews them
    """
    from zonda.core.numerics.celestial import orientation

    today = (
        datetime.datetime.now(datetime.UTC) - datetime.datetime(1858, 11, 17, tzinfo=datetime.UTC)
    ).days
    known = [day for day in range(0, 400, 10) if orientation(np.array([today + day + 0.5])).known]
    if known:
        return 0, f"known for {max(known)} days and more to come"
    short = next(
        (day for day in range(1, 20000, 30) if orientation(np.array([today - day + 0.5])).known),
        math.inf,
    )
    return float(short), "UT1 = UTC is assumed, within 0.9 s"
