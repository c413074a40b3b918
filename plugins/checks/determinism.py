"""The same seed gives the same bits: blocks, threads, repetition, interruption; different streams share nothing."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from zonda.core.checks import Family, Measured
from zonda.core.data import Block, Data
from zonda.core.numerics.random import normals, stream_key
from zonda.core.operator import Operator
from zonda.core.pipeline import Pipeline
from zonda.operators.atmosphere.layers import AtmosphereLayers
from zonda.operators.filters.common_mode import CommonModeFilter
from zonda.operators.filters.highpass import HighpassFilter
from zonda.operators.io.save_map import SaveMap
from zonda.operators.maps.bin_map import BinMap
from zonda.operators.noise.pink import PinkNoise
from zonda.operators.noise.white import WhiteNoise
from zonda.operators.optics.efficiency import Efficiency
from zonda.operators.pointing.daisy import PointingDaisy

from .cases import BLOCKS, TWICE
from .scenes import camera, differing, scene

checks = Family("determinism")

PLANES = ("signal", "hits", "weights", "noise")


class Stops(Operator):
    """Raises as Ctrl-C does, in the middle of a run."""

    requires = frozenset({"signal"})
    provides = frozenset({"signal"})

    def exec(self, block: Block, state: Any) -> None:
        """Stop at the last samples."""
        if block.samples.stop == block.observation.n_samples:
            raise KeyboardInterrupt


def _steps(*, filters: bool = True) -> list[Operator]:
    filtered: Sequence[Operator] = (HighpassFilter(), CommonModeFilter()) if filters else ()
    return [
        PointingDaisy(scan_duration="45 s", radius="1 arcmin", sample_rate="100 Hz"),
        AtmosphereLayers(pwv="7.7 mm", layers=3), WhiteNoise(), PinkNoise(), Efficiency(), *filtered,
        BinMap(pixel="4 arcsec", width="8 arcmin"),
    ]  # fmt: skip


def _run(threads: int = 1, memory: int = 1 << 30, *, filters: bool = True) -> Data:
    return Pipeline(_steps(filters=filters)).run(scene(camera(37)), threads=threads, memory=memory)


@cache
def _once() -> Data:
    return _run()


def _differing(one: Data, other: Data) -> int:
    return sum(differing(getattr(one.products["map"], p), getattr(other.products["map"], p)) for p in PLANES)


@checks.add(BLOCKS, reference="one thread, one block", limit=0, unit="values")
def threads_and_blocks() -> int:
    """values of the map that differ with 2, 3 and 5 threads and in the smallest blocks, whole chain"""
    return sum(_differing(_once(), _run(t, m)) for t, m in ((2, 1 << 30), (3, 16_000_000), (5, 30_000_000), (1, 6_000_000)))


@checks.add(BLOCKS, reference="one thread, one block", limit=0, unit="values")
def blocks_in_time() -> int:
    """values of the map that differ without filters, where blocks are cut in time as well"""
    one = _run(filters=False)
    return sum(_differing(one, _run(t, m, filters=False)) for t, m in ((3, 8_000_000), (1, 3_000_000)))


@checks.add(TWICE, reference="the first run", limit=0, unit="values")
def twice() -> int:
    """values of the map that differ in a second run, whole chain"""
    return _differing(_once(), _run(2))


@checks.add(TWICE, reference="a run that was not interrupted", limit=0, unit="files and bytes")
def interrupted() -> Measured:
    """half files left by an interrupted run, and bytes that differ when it is run again"""
    with TemporaryDirectory(prefix="zonda-check-") as folder:
        names = ["whole", "again"]
        whole, again = (Path(folder) / name for name in names)
        save = SaveMap()
        Pipeline([*_steps(), save]).run(scene(camera(37)), threads=2, output=whole)
        steps = _steps()
        try:
            Pipeline([*steps[:-1], Stops(), steps[-1], save]).run(scene(camera(37)), threads=2, output=again)
            return math.inf, "was not interrupted"
        except KeyboardInterrupt:
            left = [p for p in again.rglob("*") if p.is_file()]
        Pipeline([*_steps(), save]).run(scene(camera(37)), threads=1, output=again)
        files = sorted(p.relative_to(whole) for p in whole.rglob("*") if p.is_file())
        wrong = len(left) + abs(len(files) - len([p for p in again.rglob("*") if p.is_file()]))
        for path in files:
            one, other = ((root / path).read_bytes() for root in (whole, again))
            a, b = (np.frombuffer(x, np.uint8)[: min(len(one), len(other))] for x in (one, other))
            wrong += differing(a, b) + abs(len(one) - len(other))
        return wrong, f"{len(files)} file{'s' if len(files) > 1 else ''} compared, none to resume from: runs start again"


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
"""Sixteen tasks of a second or less; its spectra are means of floats, which a sum in another order would change."""


class Killed(BaseException):
    """Ends a campaign as a killed process does: nothing of its work in progress is kept."""


class Backwards(Executor):
    """Completes what was asked for last first, as an engine may; after ``stop`` calls it breaks the campaign off."""

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


def _campaign(folder: Path, executor: Executor, workers: int, *, again: bool = False) -> dict[str, bytes]:
    """Run or resume the campaign; its map."""
    from zonda.core.campaign.engines import Pool
    from zonda.core.campaign.prepare import Source
    from zonda.core.campaign.run import begin, resume
    from zonda.core.configuration.pipeline_file import load

    path = folder.parent / "campaign.yaml"
    path.write_text(CAMPAIGN)
    pool = Pool(executor, workers, 0, 1, 256_000_000)
    if again:
        resume(folder, pool, lambda text: None)
    else:
        source = Source(load(path), lambda settings: load(path, settings), "")
        begin([source], folder, "zonda run campaign.yaml", pool, lambda text: None)
    return {p.name: p.read_bytes() for p in sorted(folder.glob("*.fits"))}


def _bytes_that_differ(one: dict[str, bytes], other: dict[str, bytes]) -> float:
    if one.keys() != other.keys() or not one:
        return math.inf
    pairs = [[np.frombuffer(x, np.uint8) for x in (one[name], other[name])] for name in one]
    return sum(differing(a, b) if a.shape == b.shape else max(a.size, b.size) for a, b in pairs)


@cache
def _campaign_once() -> dict[str, bytes]:
    from zonda.core.campaign.engines import SerialExecutor

    with TemporaryDirectory(prefix="zonda-check-") as folder:
        return _campaign(Path(folder) / "out", SerialExecutor(), 1)


@checks.add(BLOCKS, reference="one worker, in order", limit=0, unit="bytes", quick=False)
def workers() -> float:
    """bytes of a campaign's map that differ with 2 and 7 workers, and when tasks are completed in the opposite order"""
    wrong = 0.0
    with TemporaryDirectory(prefix="zonda-check-") as folder:
        for number in (2, 7):
            with ThreadPoolExecutor(number) as executor:
                found = _campaign(Path(folder) / f"out-{number}", executor, number)
            wrong += _bytes_that_differ(_campaign_once(), found)
        return wrong + _bytes_that_differ(_campaign_once(), _campaign(Path(folder) / "backwards", Backwards(), 4))


@checks.add(TWICE, reference="a campaign that was not interrupted", limit=0, unit="bytes", quick=False)
def resumed() -> Measured:
    """bytes of a campaign's map that differ when it is broken off after 7 of 16 tasks, a product cut short, and resumed"""
    from zonda.core.campaign.engines import SerialExecutor

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


@checks.add(BLOCKS, reference="no correlation", limit=5, unit="standard errors")
def separate_streams() -> float:
    """largest correlation among 12 streams of random numbers: seeds, observations, operators, detectors"""
    n = 1 << 17
    keys = [stream_key(seed, "observation", scan, who) for seed in (1, 2) for scan in (0, 1) for who in ("WhiteNoise", "x")]
    streams = [normals(k, 0, n, stream=s) for k in keys[:4] for s in (0, 1)] + [normals(k, 0, n) for k in keys[4:]]
    found = np.corrcoef(np.array(streams, np.float64)) - np.eye(len(streams))
    return float(abs(found).max() * math.sqrt(n))
