"""Interrupted runs, campaigns in any number of workers, resumed campaigns: identical bits."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from zonda.core.checks import Family, Measured
from zonda.core.data import Block
from zonda.core.operator import Operator
from zonda.core.pipeline import Pipeline
from zonda.operators.io.save_map import SaveMap
from zonda.plugins.checks.determinism import steps
from zonda.plugins.checks.scenes import camera, differing, scene

from .cases import AT_ONCE, BLOCKS, TWICE

checks = Family("determinism")


class Stops(Operator):
    """Raises as Ctrl-C does, in the middle of a run."""

    requires = frozenset({"signal"})
    provides = frozenset({"signal"})

    def exec(self, block: Block, state: Any) -> None:
        """Stop at the last samples."""
        if block.samples.stop == block.observation.n_samples:
            raise KeyboardInterrupt


@checks.add(TWICE, reference="a run that was not interrupted", limit=0, unit="files and bytes")
def interrupted() -> Measured:
    """half files left by an interrupted run, and bytes that differ when it is run again"""
    with TemporaryDirectory(prefix="zonda-check-") as folder:
        names = ["whole", "again"]
        whole, again = (Path(folder) / name for name in names)
        save = SaveMap()
        Pipeline([*steps(), save]).run(scene(camera(37)), threads=2, output=whole)
        chain = steps()
        try:
            Pipeline([*chain[:-1], Stops(), chain[-1], save]).run(
                scene(camera(37)), threads=2, output=again
            )
            return math.inf, "was not interrupted"
        except KeyboardInterrupt:
            left = [p for p in again.rglob("*") if p.is_file()]
        Pipeline([*steps(), save]).run(scene(camera(37)), threads=1, output=again)
        files = sorted(p.relative_to(whole) for p in whole.rglob("*.fits"))
        wrong = len(left) + abs(len(files) - len(list(again.rglob("*.fits"))))
        for path in files:
            one, other = ((root / path).read_bytes() for root in (whole, again))
            a, b = (np.frombuffer(x, np.uint8)[: min(len(one), len(other))] for x in (one, other))
            wrong += differing(a, b) + abs(len(one) - len(other))
        return (
            wrong,
            (
                f"{len(files)} file{'s' if len(files) > 1 else ''} compared, none to resume from:"
                " runs start again"
            ),
        )


CAMPAIGN = """
site: green_bank
instrument: {name: check, telescope: {name: dish, diameter: 100 m}, band: {name: band, low: 78 GHz, high: 108 GHz}, detectors: 7,
  field_of_view: 2 arcmin, fwhm: 8.5 arcsec, main_beam_efficiency: 0.3, illumination_efficiency: 0.8, net: 1.7 mK s(1/2),
  knee: 0.5 Hz, sample_rate: 50 Hz}
time: 2024-11-25T07:00
target: 05h00m00s +20d00m00s
seed: 7
budget: 0 %
campaign: {nights: 4, realizations: 2}
operators:
  - PointingDaisy: {radius: 1 arcmin, scan_duration: 10 s, scans: 2}
  - AtmosphereLayers: {pwv: 7.7 mm, layers: 2}
  - WhiteNoise
  - PinkNoise
  - Efficiency
  - PowerSpectrum: {segment: 4 s}
  - HighpassFilter
  - BinMap: {pixel: 4 arcsec}
  - SaveMap
"""
"""Sixteen tasks of a second or less; its spectra are means of floats, which a sum in another order
would change.
"""


class Killed(BaseException):
    """Ends a campaign as a killed process does: nothing of its work in progress is kept."""


class Backwards(Executor):
    """Completes what was asked for last first, as an engine may; after ``stop`` calls it breaks the
    campaign off.
    """

    def __init__(self, stop: int = 10**9) -> None:
        self.left, self.stop = 0, stop
        self.calls: list[tuple[Future[Any], Callable[[], Any]]] = []

    def submit(self, fn: Callable[..., Any], /, *arguments: Any, **options: Any) -> Future[Any]:
        """A future that is done when three more were asked for, or all."""
        future: Future[Any] = Future()
        self.calls.append((future, lambda: fn(*arguments, **options)))
        if len(self.calls) >= 4 or self.left + len(self.calls) >= 16:
            while self.calls:
                done, call = self.calls.pop()
                self.left += 1
                if self.left > self.stop:
                    raise Killed
                done.set_result(call())
        return future


def _campaign(
    folder: Path, executor: Executor, workers: int, *, again: bool = False
) -> dict[str, bytes]:
    """Run or resume the campaign; its map."""
    from zonda.core.campaign.prepare import CampaignFile
    from zonda.core.campaign.run import begin, resume
    from zonda.core.experiment.engines import Pool
    from zonda.core.experiment.variant import FileVariant

    path = folder.parent / "campaign.yaml"
    path.write_text(CAMPAIGN)
    pool = Pool(executor, workers, 0, 1, 256_000_000)
    if again:
        resume(folder, pool, lambda text: None)
    else:
        begin(
            [CampaignFile(FileVariant(path))],
            folder,
            "zonda run campaign.yaml",
            pool,
            lambda text: None,
        )
    return {p.name: p.read_bytes() for p in sorted(folder.glob("*.fits"))}


def _bytes_that_differ(one: dict[str, bytes], other: dict[str, bytes]) -> float:
    if one.keys() != other.keys() or not one:
        return math.inf
    pairs = [[np.frombuffer(x, np.uint8) for x in (one[name], other[name])] for name in one]
    return sum(differing(a, b) if a.shape == b.shape else max(a.size, b.size) for a, b in pairs)


@cache
def _campaign_once() -> dict[str, bytes]:
    from zonda.core.experiment.engines import SerialExecutor

    with TemporaryDirectory(prefix="zonda-check-") as folder:
        return _campaign(Path(folder) / "out", SerialExecutor(), 1)


@checks.add(BLOCKS, reference="one worker, in order", limit=0, unit="bytes")
def workers() -> float:
    """bytes of a campaign's map that differ with 2 and 7 workers, and when tasks are completed in
    the opposite order
    """
    wrong = 0.0
    with TemporaryDirectory(prefix="zonda-check-") as folder:
        for number in (2, 7):
            with ThreadPoolExecutor(number) as executor:
                found = _campaign(Path(folder) / f"out-{number}", executor, number)
            wrong += _bytes_that_differ(_campaign_once(), found)
        return wrong + _bytes_that_differ(
            _campaign_once(), _campaign(Path(folder) / "backwards", Backwards(), 4)
        )


@checks.add(TWICE, reference="a campaign that was not interrupted", limit=0, unit="bytes")
def resumed() -> Measured:
    """bytes of a campaign's map that differ when it is broken off after 7 of 16 tasks, a product
    cut short, and resumed
    """
    from zonda.core.experiment.engines import SerialExecutor

    with TemporaryDirectory(prefix="zonda-check-") as folder:
        out = Path(folder) / "out"
        try:
            _campaign(out, Backwards(stop=7), 4)
            return math.inf, "was not broken off"
        except Killed:
            products = sorted((out / "tasks").glob("[0-9]*.npz"))
        products[0].write_bytes(products[0].read_bytes()[:1000])
        found = _campaign(out, SerialExecutor(), 1, again=True)
        return _bytes_that_differ(_campaign_once(), found), f"{len(products) - 1} tasks were kept"


KERNEL = """
from zonda.core.kernels import kernel

@kernel
def total(values):
    found = values[0] * 0
    for value in values:
        found += value * value
    return found
"""
COMPILING = """
import importlib.util, sys
import numpy as np
spec = importlib.util.spec_from_file_location("zonda.toy_at_once", sys.argv[1])
module = sys.modules["zonda.toy_at_once"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
print(*(float(module.total(np.arange(10, dtype=kind))) for kind in sys.argv[2:]))
"""


@checks.add(AT_ONCE, reference="sum of the squares of 0 to 9", limit=0, unit="values")
def compiled_at_once() -> Measured:
    """wrong values of a kernel that four processes compile at once for four types, and of each type
    in four later processes
    """
    kinds = ("float64", "float32", "int64", "int32")
    with TemporaryDirectory(prefix="zonda-check-") as folder:
        path = Path(folder) / "toy_at_once.py"
        path.write_text(KERNEL)
        settings = {
            **os.environ,
            "NUMBA_CACHE_DIR": f"{folder}/cache",
            "PYTHONDONTWRITEBYTECODE": "1",
        }

        def values(*types: Sequence[str]) -> list[float]:
            command = [sys.executable, "-c", COMPILING, str(path)]
            started = [
                subprocess.Popen([*command, *some], env=settings, stdout=subprocess.PIPE, text=True)
                for some in types
            ]
            return [
                float(value) for process in started for value in process.communicate()[0].split()
            ]

        first = values(*([kind] for kind in kinds))
        later = values(*(kinds[k:] + kinds[:k] for k in range(len(kinds))))
    wrong = (
        sum(value != 285.0 for value in first + later) + abs(len(first) - 4) + abs(len(later) - 16)
    )
    return wrong, f"{len(first)} values at once, {len(later)} later"
