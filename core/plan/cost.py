"""CPU time and memory before they are spent.

An operator states its cost on a reference machine as seconds = a + b N_t + c N_det N_t
(`estimate.Cost`). What this machine needs follows from three kernels that are run for a fraction of
a second and compared with their times there: random numbers, streams through memory, and the
interpreter with small arrays.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from ..mapmaker import joins, makes_products
from ..output import Output
from ..run.budget import BASE, share_in_step
from ..run.schedule import Chain, schedule
from ..run.settings import Settings
from ..storage import user_cache
from .context import Context
from .estimate import Cost
from .planning import planning_of
from .summary import Prediction

REFERENCE = {"random": 1.7e-3, "stream": 1.0e-3, "python": 3.2e-3}
"""Seconds of the kernels on the reference machine: one core of a Sapphire Rapids server at 2.x GHz
with AVX-512.
"""

STARTUP = Cost(once=0.9, kernel="python")
"""Imports and compiled code from the cache; planning is measured."""

POINTED = 200
"""Bytes for one sample of one observation, whatever the detectors: times, boresight, flags."""

LASTS = 30 * 86400.0
"""Seconds after which a remembered calibration is measured again."""


@cache
def calibrate() -> Mapping[str, float]:
    """Time of each kernel relative to the reference machine: measured once, then remembered for
    `LASTS` seconds.
    """
    from ..versions import versions

    key = {"processor": user_cache.processor(), "versions": versions()}
    found = user_cache.recall("speed", key)
    if isinstance(found, dict) and abs(time.time() - found.get("measured", 0.0)) < LASTS:
        known: dict[str, Any] = {name: found.get(name) for name in REFERENCE}
        if all(isinstance(f, float) and 1e-3 < f < 1e3 for f in known.values()):
            return known
    measured = measure_speed()
    user_cache.remember("speed", key, {**measured, "measured": time.time()})
    return measured


def measure_speed(budget: float = 0.3) -> dict[str, float]:
    """`calibrate`, measured now in about ``budget`` seconds.

    The least of several runs: what other programs take does not count as this machine's speed.
    """
    from ..numerics.random import normals, stream_key

    key, array = stream_key(1, "calibration"), np.linspace(0.0, 1.0, 1 << 16, dtype=np.float32)
    other, small = np.empty_like(array), np.arange(64.0)

    def draw() -> None:
        normals(key, 0, 1 << 20)

    def stream() -> None:
        for _ in range(64):  # from the cache, as the blocks of a run
            np.multiply(array, np.float32(1.0001), out=other)
            np.add(other, array, out=other)

    def python() -> None:
        for _ in range(1500):
            np.einsum("i,i->", small, small)

    kernels: dict[str, Callable[[], None]] = {"random": draw, "stream": stream, "python": python}
    for kernel in kernels.values():
        kernel()
    best = dict.fromkeys(kernels, np.inf)
    until = time.process_time() + budget
    while time.process_time() < until:
        for (
            name,
            kernel,
        ) in kernels.items():  # in turn, so that a busy moment does not spoil one of them
            start = time.process_time()
            kernel()
            best[name] = min(best[name], time.process_time() - start)
    return {name: seconds / REFERENCE[name] for name, seconds in best.items()}


def predict(
    context: Context,
    costs: Mapping[str, Cost | None],
    item: int,
    threads: int,
    memory: int,
    portable: bool = False,
) -> Prediction:
    """CPU time and memory of the pipeline, all signals. Streams that memory has no room for may be
    made again (`core.run.schedule`).

    Parameters
    ----------
    costs
        By label of the operators that take part; None: unknown.
    item
        Bytes of one sample of a stream.
    threads, memory
        As in `Settings`, but the memory is that of the whole process.
    portable
        On the reference machine, not on this one.
    """
    factors = dict.fromkeys(REFERENCE, 1.0) if portable else calibrate()
    longest = max(context.observations, key=lambda o: o.n_samples * o.n_detectors)
    during = [o for o in context.operators if not isinstance(o, Output)]
    held = POINTED * context.times + sum(planning_of(o).memory(longest) for o in during)
    after = sum(planning_of(o).memory(longest) for o in context.operators if isinstance(o, Output))
    settings = Settings(
        threads, max(int(memory - BASE - held), 1), np.float64 if item == 8 else np.float32
    )
    work = context.work
    chain = Chain(work.steps, work.signals, work.components)
    products = sum(planning_of(o).memory(longest) for o in during if makes_products(o))
    bands = context.bands_alike
    in_step = None
    if bands > 1:
        alone = replace(settings, memory=max(settings.memory - (bands - 1) * products, 1))
        in_step = share_in_step(chain, longest, alone, bands, (bands - 1) * (held - products))
    found = schedule(chain, longest, in_step or settings)
    seconds = {}
    for label, cost in costs.items():
        if cost is not None:
            each = sum(cost.seconds(o.n_samples, o.n_detectors) for o in context.observations)
            again = found.again.get(label, 0) * (
                each - cost.fixed * len(context.observations)
            )  # prepared once, made again
            # decisions, which are portable, are those of the band alone
            own = 1.0 if in_step is None or portable else 1 - cost.shared * (1 - 1 / bands)
            seconds[label] = factors[cost.kernel] * (
                work.times.get(label, 1.0) * (own * each + again) + cost.once
            )
    unknown = tuple(label for label, cost in costs.items() if cost is None)
    startup = factors[STARTUP.kernel] * STARTUP.once
    if in_step is not None:
        products = held + found.bytes
    if any(map(joins, work.steps)):
        products = (
            held + found.bytes + item * longest.n_samples * longest.n_detectors
        )  # its part of the stream of all bands
    size = BASE + max(held + found.bytes, after)
    return Prediction(seconds, size, unknown, startup, work.times, factors, products)
