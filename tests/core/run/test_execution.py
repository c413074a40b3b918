"""Blocks, segments, halos and spilling never change a bit."""

import threading
from contextlib import ExitStack, contextmanager
from typing import ClassVar
from unittest import mock

import numpy as np
import pytest

from zonda.core.assembly.signals import Chain
from zonda.core.data import Block, Data
from zonda.core.errors import PipelineError
from zonda.core.numerics.chunks import TILE_SAMPLES
from zonda.core.numerics.smooth import SmoothField
from zonda.core.operator import Operator
from zonda.core.plan.planning import Planning
from zonda.core.registry import planning
from zonda.core.run.block_maker import BlockMaker
from zonda.core.run.execution import Execution
from zonda.core.run.schedule import Schedule
from zonda.core.run.segments import PIECE, cut
from zonda.core.run.settings import Settings, Timer
from zonda.core.run.streams import Store
from zonda.core.run.views import View
from zonda.plugins.checks.scenes import scan


def observation(n_det=101, n_samp=9 * TILE_SAMPLES + 123):
    return scan(n_det, n_samp)


class Source(Operator):
    """A value that depends on the absolute detector and sample only."""

    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    knows_means: ClassVar[bool] = True

    def exec(self, block, state):
        d = np.arange(block.detectors.start, block.detectors.stop)[:, None]
        t = np.arange(block.samples.start, block.samples.stop)
        block.new("signal")[...] += np.sin(0.37 * d + 0.01 * t) + np.cos(1.3 * d * t)
        block.means["signal"] = SmoothField.constant(
            np.full(block.observation.n_detectors, 5.0), block.observation.n_samples
        )


class Smooth(Operator):
    """The mean of the samples at t - width, t and t + width (those that exist)."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    knows_means: ClassVar[bool] = True
    width: int = 5

    def halo(self, observation):
        return self.width

    def exec(self, block, state):
        signal = block.detdata["signal"].astype(np.float64)
        out, hits = np.zeros_like(signal), np.zeros(signal.shape[1])
        n = signal.shape[1]
        for k in (-self.width, 0, self.width):
            to, of = (
                slice(max(0, -k), max(0, min(n, n - k))),
                slice(max(0, k), max(0, min(n, n + k))),
            )
            out[:, to] += signal[:, of]
            hits[to] += 1
        block.detdata["signal"][...] = out / hits


class Demean(Operator):
    """Subtract each detector's mean over the scan."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    knows_means: ClassVar[bool] = True
    couples: ClassVar = "time"

    def exec(self, block, state):
        assert block.shape[1] == block.observation.n_samples
        for row in block.detdata["signal"]:
            row -= row.mean(dtype=np.float64)


class FocalPlaneMean(Operator):
    """Subtract the focal-plane mean at each sample."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    knows_means: ClassVar[bool] = True
    couples: ClassVar = "detectors"

    def exec(self, block, state):
        assert block.shape[0] == block.observation.n_detectors
        signal = block.detdata["signal"]
        total = np.zeros(signal.shape[1])
        for row in signal:
            total += row
        signal -= total / len(signal)


class Scale(Operator):
    """Divide by the rms of the whole stream."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    knows_means: ClassVar[bool] = True
    couples: ClassVar = "all"

    def measure(self, stream, model=None):
        assert stream.means["signal"].weights[0, 0] == 5.0
        return np.sqrt(
            sum(float(np.sum(row.astype(float) ** 2)) for row in stream.array) / stream.array.size
        )

    def exec(self, block, state):
        block.detdata["signal"] /= block.dtype(state)


class Sink(Operator):
    """Count every sample once."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    knows_means: ClassVar[bool] = True

    def prepare(self, observation):
        return np.zeros((observation.n_detectors, observation.n_samples), int)

    def exec(self, block, state):
        state[block.detectors, block.samples] += 1

    def collect(self, data, observation, state):
        data.products["seen"] = state


CHAIN = [
    Source(),
    Smooth(width=3),
    Demean(),
    Smooth(width=700),
    FocalPlaneMean(),
    Smooth(width=2500),
    Scale(),
    Sink(),
]


@contextmanager
def peak_of_streams_and_blocks():
    """A list of one number: the most bytes that streams and blocks have taken at once."""
    peak, stores, blocks, lock = [0], [], {}, threading.Lock()
    make, release, allocate = BlockMaker.make, BlockMaker.release, Store.allocate

    def note():
        with lock:
            peak[0] = max(peak[0], sum(store.held for store in stores) + sum(blocks.values()))

    def made(maker, *arguments, **more):
        block, held = make(maker, *arguments, **more), vars(maker._local)
        buffers = [*held.get("blocks", {}).values(), held.get("pieces", {}), held.get("whole", {})]
        size = sum(array.nbytes for one in buffers for array in one.values())
        blocks[threading.get_ident()] = size
        note()
        return block

    def released(maker):
        release(maker)
        blocks.clear()

    def allocated(store, *arguments, **more):
        array = allocate(store, *arguments, **more)
        stores[:] = {id(one): one for one in (*stores, store)}.values()
        note()
        return array

    with (
        mock.patch.object(BlockMaker, "make", made),
        mock.patch.object(BlockMaker, "release", released),
        mock.patch.object(Store, "allocate", allocated),
    ):
        yield peak
    assert peak[0] > 0


def execute(operators, obs, room=None, how=None, **settings):
    """The execution, the signal it keeps, the products. ``room``: bytes that streams may take,
    where not half of the memory; ``how``: what is done with those that do not fit.
    """
    operators = [o.model_copy() for o in operators]
    for i, o in enumerate(operators):
        o._label = f"{type(o).__name__}.{i}"
    data = Data(scene=None)
    view = View(Chain(operators, keep=("signal",)), obs, data)
    execution = Execution([view], Settings(**settings), Timer())
    with ExitStack() as stack:
        if room is not None:
            keeps = lambda self, stage, size, held, later: held + size <= room  # noqa: E731
            stack.enter_context(mock.patch.object(Schedule, "_keeps", keeps))
            stack.enter_context(
                mock.patch.object(Store, "fits", lambda self, size: self._in_use + size <= room)
            )
        if how is not None:
            stack.enter_context(mock.patch.object(Schedule, "_where", return_value=(how, "")))
        execution.run()
    return execution, obs.detdata["signal"], data


def run(operators, obs, **settings):
    return execute(operators, obs, **settings)[1:]


def reference(obs, chain=CHAIN):
    block = Block(obs, slice(0, obs.n_detectors), slice(0, obs.n_samples))
    for operator in chain[:-1]:
        state = None
        if operator.couples == "all":
            state = operator.measure(
                type("S", (), {"array": block.detdata["signal"], "means": block.means})()
            )
        operator.exec(block, state)
    return block.total("signal")


def test_blocks_halos_threads_and_spilling_change_no_bit():
    want = reference(observation())
    size = want.size * 4
    for memory, threads in (
        (1 << 30, 1),
        (3 * size, 3),
        (int(1.9 * size), 1),
        (int(1.9 * size), 3),
    ):
        for how in ("spilled", None):
            obs = observation()
            got, data = run(CHAIN, obs, memory=memory * threads, threads=threads, how=how)
            assert np.array_equal(got, want)
            assert (data.products["seen"] == 1).all()


class Peek(Operator):
    """Make no stream: count how often each sample is seen, and tell the log."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"seen"})
    knows_means: ClassVar[bool] = True

    def prepare(self, observation):
        return np.zeros((observation.n_detectors, observation.n_samples), int)

    def exec(self, block, state):
        state[block.detectors, block.samples] += 1
        assert not block.again

    def collect(self, data, observation, state):
        data.products[self.label] = state


class Tell(Source):
    """A source that counts its samples."""

    def exec(self, block, state):
        super().exec(block, state)
        block.observation.log.count(self.label, "samples made", block.shape[0] * block.shape[1])


class Level(Operator):
    """Subtract the mean of the whole stream, found by sweeps."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    knows_means: ClassVar[bool] = True
    couples: ClassVar = "all"

    def measure(self, stream, model=None):
        for _ in range(2):
            seen = np.zeros(stream.shape, int)
            total = np.zeros(stream.shape[0])

            def tiles(detectors, samples, part):
                return [
                    part[:, k : k + TILE_SAMPLES].sum(axis=1, dtype=float)
                    for k in range(0, part.shape[1], TILE_SAMPLES)
                ]

            for detectors, samples, parts in stream.sweep(tiles):
                seen[detectors, samples] += 1
                for part in parts:
                    total[detectors] += part
            assert (seen == 1).all()
        return total.sum() / seen.size

    def exec(self, block, state):
        block.detdata["signal"] -= block.dtype(state)


class LevelPlanning(Planning):
    """It reads its stream by sweeps."""

    of = Level

    def sweeps(self, observation):
        return 2


planning.register(LevelPlanning, name="Level")


class Square(Operator):
    """Add the square of the signal, kept beside it, so that a second stream comes into being piece
    by piece.
    """

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"square", "signal"})
    knows_means: ClassVar[bool] = True
    optional: ClassVar[frozenset[str]] = frozenset({"square"})

    def exec(self, block, state):
        block.new("square")[...] += block.detdata["signal"] ** 2
        block.detdata["signal"] += block.detdata["square"]


@pytest.mark.parametrize("coupled", [Demean(), FocalPlaneMean()])
def test_pieces_of_a_block_change_no_bit(coupled):
    """Operators without coupling that share a segment with a coupled one, before and after the
    stream was stored whole.
    """
    chain = [Source(), Square(), coupled, Scale(), Square(), coupled, Sink()]
    assert observation().n_samples > 2 * PIECE
    assert [len(s.split()[0]) for s in cut([View(Chain(chain), observation())])] == [2, 2]
    want = reference(observation(), chain)
    for memory, threads in ((1 << 30, 1), (16 * want.size, 2)):
        got, data = run(chain, observation(), memory=memory, threads=threads)
        assert np.array_equal(got, want)
        assert (data.products["seen"] == 1).all()


CHAINS_MADE_AGAIN = {
    "whole scans": [Tell(), Peek(), Demean(), Peek(), Level(), Sink()],
    "margins": [
        Tell(),
        Smooth(width=40),
        Peek(),
        Level(),
        Smooth(width=4000),
        Level(),
        Peek(),
        Sink(),
    ],
    "focal plane": [
        Tell(),
        Square(),
        Peek(),
        Level(),
        FocalPlaneMean(),
        Square(),
        Peek(),
        Level(),
        Sink(),
    ],
}


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("name", CHAINS_MADE_AGAIN)
def test_streams_made_again_change_no_bit_and_are_counted_once(name, threads):
    """Steps that make no stream see every sample once, in whichever reading comes first; so does
    the log.
    """
    chain = CHAINS_MADE_AGAIN[name]
    want, _ = run(chain, observation(), memory=1 << 30)
    size = 4 * want.size
    for how, said in (("again", "made again"), ("spilled", "spilled")):
        obs = observation()
        memory = threads * int(1.9 * size)
        with peak_of_streams_and_blocks() as peak:
            _, got, data = execute(
                chain, obs, memory=memory, threads=threads, how=how, room=size // 2
            )
        assert np.array_equal(got, want)
        assert any(said in what for _, what, _ in obs.log)
        assert all((seen == 1).all() for seen in data.products.values())
        assert obs.log.get("Tell.0", "samples made") == want.size
        assert peak[0] <= memory


def test_a_stream_wanted_whole_is_spilled_or_refused(monkeypatch):
    chain = [Source(), Demean(), Scale(), Sink()]
    obs = observation()
    size = 4 * obs.n_detectors * obs.n_samples
    run(chain, obs, memory=int(1.9 * size))
    assert any("spilled" in what for _, what, _ in obs.log)
    monkeypatch.setattr("zonda.core.run.schedule.free_disk", lambda: 1000)
    with pytest.raises(
        PipelineError,
        match=r"(?s)neither in memory nor on the disk.*Scale.2 reads it as a whole.*--memory 16MB",
    ):
        run(chain, observation(), memory=int(1.9 * size))
    level, obs = [Source(), Demean(), Level(), Sink()], observation()
    run(level, obs, memory=int(1.9 * size))
    assert any("made again" in what for _, what, _ in obs.log)


def test_the_memory_of_the_process_leaves_what_is_not_held_already():
    from zonda.core.machine import resident_memory

    obs = observation()
    size = 4 * obs.n_detectors * obs.n_samples
    chain = [Source(), Demean(), Level(), Sink()]
    execution, got, _ = execute(
        chain, obs, memory=1 << 30, process=resident_memory() + 3 * size // 2
    )
    assert execution.settings.memory <= 2 * size
    assert np.array_equal(got, run(chain, observation())[0])
    with pytest.raises(PipelineError, match="raise --memory to"):
        run(chain, observation(), memory=1 << 30, process=1000)


def test_a_stream_made_again_has_no_array():
    class Greedy(Level):
        """Reads the array after all."""

        def measure(self, stream, model=None):
            stream.array  # noqa: B018

    obs = observation()
    with pytest.raises(PipelineError, match="nowhere held as a whole"):
        run(
            [Source(), Greedy(), Sink()],
            obs,
            memory=int(1.9 * 4 * obs.n_detectors * obs.n_samples),
        )


def test_margins_that_reach_the_ends_leave_the_source_alone():
    """A block with margins can be the whole scan: it must not be filtered where other blocks read
    it.
    """
    chain = [Source(), Smooth(width=20)]
    want, _ = run(chain, observation(16, 3 * TILE_SAMPLES + 321), memory=1 << 30)
    got, _ = run(
        chain,
        observation(16, 3 * TILE_SAMPLES + 321),
        memory=2 * 4 * 4 * 16 * 3 * TILE_SAMPLES + 1000,
    )
    assert np.array_equal(got, want)


def test_spilling_is_stated():
    obs = observation()
    got, _ = run(CHAIN, obs, memory=int(1.9 * obs.n_detectors * obs.n_samples * 4))
    assert any("spilled" in what for _, what, _ in obs.log)
    assert np.array_equal(got, reference(observation()))


def test_budget_too_small_says_what_is_needed():
    with pytest.raises(
        PipelineError, match=r"(?s)one block of 16 detectors needs .* raise --memory"
    ):
        run(CHAIN, observation(), memory=100_000)


def test_one_detector_one_sample():
    got, data = run(CHAIN[:1] + CHAIN[-1:], observation(1, 1))
    assert got.shape == (1, 1)
    assert data.products["seen"].sum() == 1


def test_segments():
    spans = [(len(s.operators), s.span, s.halo) for s in cut([View(Chain(CHAIN), observation())])]
    assert spans == [
        (1, "sample", 0),
        (1, "sample", 3),
        (2, "time", 0),
        (1, "detectors", 0),
        (1, "sample", 2500),
        (2, "sample", 0),
    ]
    assert [
        s.operators[0].couples
        for s in cut([View(Chain([Source(), Demean(), Scale(), Sink()]), observation())])
    ] == ["sample", "all"]
    assert [
        len(s.operators)
        for s in cut([View(Chain([Source(), Demean(), Smooth(), Sink()]), observation())])
    ] == [4]  # whole scans need no halo


def test_failure_discards_what_was_begun():
    gone = []

    class Fails(Operator):
        """Fails in the second block."""

        def exec(self, block, state):
            if block.detectors.start:
                raise ValueError("no")

    class Begun(Operator):
        """Has something to undo."""

        def discard(self, observation, state):
            gone.append(True)

    for threads in (1, 2):
        with pytest.raises(ValueError, match="no"):
            run([Source(), Begun(), Fails()], observation(), threads=threads)
    assert gone == [True, True]


def test_kept_stream_must_exist():
    class Nothing(Operator):
        """Makes nothing."""

    with pytest.raises(PipelineError, match="'signal' was asked to be kept"):
        run([Nothing()], observation())


def test_smooth_field_matches_spline_and_any_cut():
    rng = np.random.default_rng(1)
    n, step = 5000, 64
    weights = rng.standard_normal((5, 3))
    k = np.arange(-(-n // step) + 3 + 24) - 13
    values = np.array([np.sin(0.01 * step * k), np.cos(0.004 * step * k), 0.1 + 0 * k])
    field = SmoothField.from_values(weights, values, step, n)
    t = np.arange(n)
    exact = weights @ np.array([np.sin(0.01 * t), np.cos(0.004 * t), 0.1 + 0 * t])
    got = field.evaluate(slice(0, 5), slice(0, n))
    # cubic splines err by (omega * step)^4 / 384 = 4e-4 of the fastest sine
    assert np.abs(got - exact).max() < 5e-4 * np.abs(weights).max() * 2
    part = field.evaluate(slice(2, 4), slice(2048, 4000))
    assert np.array_equal(part, got[2:4, 2048:4000])


@pytest.mark.parametrize("samples", [slice(-1, 5), slice(0, 5001)])
def test_smooth_field_refuses_samples_outside(samples):
    field = SmoothField.constant(np.ones(2), 5000)
    with pytest.raises(ValueError, match="outside"):
        field.evaluate(slice(0, 2), samples)
