"""Steps that do not know of means see whole streams, and lose nothing by it."""

from typing import ClassVar

import numpy as np
import pytest
from pydantic import PrivateAttr

from tests.core.run.test_execution import execute, observation
from zonda.core.data import Block
from zonda.core.errors import PluginError
from zonda.core.numerics.chunks import TILE_SAMPLES
from zonda.core.numerics.smooth import SmoothField
from zonda.core.operator import Operator
from zonda.core.plan.planning import Planning
from zonda.core.registry import planning

SIGNAL = frozenset({"signal"})


def mean_of(obs, name="signal"):
    """Some 30 K that differ from detector to detector and fall by 1 K during the scan."""
    wanted = -(-obs.n_samples // 512) + 3
    nodes = np.stack([np.ones(wanted), np.linspace(0, -1, wanted)])
    first = 30.0 if name == "signal" else 20.0
    weights = np.stack([first + 0.1 * np.arange(obs.n_detectors), np.ones(obs.n_detectors)], axis=1)
    return SmoothField.from_values(weights, nodes, 512, obs.n_samples)


class Gives(Operator):
    """Millikelvins with their mean beside them, or in them; ``atmosphere`` has its mean in
    ``observation.smooth``.
    """

    provides: ClassVar[frozenset[str]] = frozenset({"signal", "atmosphere", "white"})
    knows_means: ClassVar[bool] = True
    beside: bool = True

    def prepare(self, observation):
        if self.beside:
            observation.smooth["atmosphere"] = mean_of(observation, "atmosphere")

    def exec(self, block, state):
        d = np.arange(block.detectors.start, block.detectors.stop)[:, None]
        t = np.arange(block.samples.start, block.samples.stop)
        for k, name in enumerate(("signal", "atmosphere", "white")):
            # float32 in every precision, so that all runs begin with the same numbers
            block.new(name)[...] = (
                1e-3 * np.sin(0.37 * d + 0.01 * t + k) + 1e-3 * np.cos(1.3 * d * t)
            ).astype(np.float32)
            if name == "white":
                continue
            if not self.beside:
                block.detdata[name] += mean_of(block.observation, name).evaluate(
                    block.detectors, block.samples
                )
            elif name == "signal":
                block.means[name] = mean_of(block.observation)


class Gain(Operator):
    """A gain that drifts, differently in every detector."""

    requires: ClassVar[frozenset[str]] = SIGNAL
    provides: ClassVar[frozenset[str]] = SIGNAL
    stream: str = "signal"

    def gain(self, block):
        d = np.arange(block.detectors.start, block.detectors.stop)[:, None]
        t = np.arange(block.samples.start, block.samples.stop)
        return 1 + 0.01 * np.sin(0.5 * d + 3e-4 * t)

    def exec(self, block, state):
        block.detdata[self.stream] *= self.gain(block)


class GainOfAtmosphere(Gain):
    """The same for the emission."""

    requires: ClassVar[frozenset[str]] = frozenset({"atmosphere"})
    provides: ClassVar[frozenset[str]] = frozenset({"atmosphere"})
    stream: str = "atmosphere"


class Swaps(Gain):
    """Replaces the array."""

    def exec(self, block, state):
        block.detdata["signal"] = block.detdata["signal"] * self.gain(block)


class Blurs(Gain):
    """Means of three samples, the outer ones 40 away."""

    def halo(self, observation):
        return 40

    def exec(self, block, state):
        x = np.pad(block.detdata["signal"], ((0, 0), (40, 40)), mode="edge")
        block.detdata["signal"][...] = (x[:, :-80] + x[:, 40:-40] + x[:, 80:]) / 3


class TakesMean(Gain):
    """Subtracts half of each detector's mean over the scan."""

    couples: ClassVar = "time"

    def exec(self, block, state):
        for row in block.detdata["signal"]:
            row -= 0.5 * row.mean()


class FocalPlane(Gain):
    """Subtracts half of what all detectors see."""

    couples: ClassVar = "detectors"

    def exec(self, block, state):
        signal = block.detdata["signal"]
        total = np.zeros(signal.shape[1])
        for row in signal:  # in order, whatever the block
            total += row
        signal -= 0.5 * total / len(signal)


class Measures(Gain):
    """Divides by the rms of everything, mean included; reads it once or as a whole."""

    couples: ClassVar = "all"
    readings: int = 0
    _dtypes: set = PrivateAttr(default_factory=set)

    def measure(self, stream, model=None):
        assert "signal" not in stream.means
        assert stream.dtype == np.float64
        if not self.readings:
            rows = stream.array
            assert rows.dtype == np.float64
            return np.sqrt(sum(float((row**2).sum()) for row in rows) / rows.size)
        power = 0.0
        for tiles in stream.sweep(
            lambda d, t, part: [(x**2).sum() for x in np.split(part, range(16, len(part), 16))]
        ):
            power += float(sum(tiles[2]))
        return np.sqrt(power / np.prod(stream.shape))

    def exec(self, block, state):
        block.detdata["signal"] *= 30 / state


class ReadingsPlanning(Planning):
    """As often as the operator says."""

    of = Gain

    def sweeps(self, observation):
        return self.operator.readings


planning.register(ReadingsPlanning, name="Gain")


class Adds(Operator):
    """Makes a stream of its own of what it sees, and only reads the signal."""

    requires: ClassVar[frozenset[str]] = SIGNAL
    provides: ClassVar[frozenset[str]] = frozenset({"white"})

    def exec(self, block, state):
        assert block.dtype is np.float64
        assert np.array_equal(
            block.total("signal"), block.detdata["signal"]
        )  # the mean is added once
        block.detdata["white"][...] = block.detdata["signal"]
        block.detdata["signal"] += 1  # a breach of the contract that does no harm here


class PutsInPlace(Operator):
    """What is white is the signal, so that the bench can keep it."""

    requires: ClassVar[frozenset[str]] = frozenset({"white"})
    provides: ClassVar[frozenset[str]] = SIGNAL
    knows_means: ClassVar[bool] = True

    def exec(self, block, state):
        block.detdata["signal"][...] = block.detdata["white"]
        block.means.pop("signal")


class Whole(Operator):
    """The whole atmosphere is the signal."""

    requires: ClassVar[frozenset[str]] = frozenset({"atmosphere"})
    provides: ClassVar[frozenset[str]] = SIGNAL
    knows_means: ClassVar[bool] = True

    def exec(self, block, state):
        block.detdata["signal"][...] = block.detdata["atmosphere"]
        block.means.pop("signal", None)
        if "atmosphere" in block.observation.smooth:
            block.means["signal"] = block.observation.smooth["atmosphere"]


CHAINS = {
    "gain": [Gain()],
    "atmosphere": [GainOfAtmosphere(), Whole()],
    "replaced": [Swaps()],
    "halo": [Blurs()],
    "time": [TakesMean()],
    "detectors": [FocalPlane()],
    "all": [Measures()],
    "swept": [Measures(readings=1)],
    "many": [Gain(), Blurs(), Swaps(), FocalPlane(), Measures(readings=1), Gain()],
}


@pytest.mark.parametrize("chain", CHAINS.values(), ids=CHAINS)
def test_a_mean_beside_the_stream_is_as_good_as_one_in_it(chain):
    """float32 with the mean beside, against float64 with the mean in the stream.

    What stands beside the mean is rounded to 2^-24 of itself once in each step. Of six steps the
    largest are 16 K beside the mean (half of it was taken away), and a later one multiplies by 2.2
    what was rounded before.
    """
    obs = observation(37, 3 * TILE_SAMPLES + 21)
    _, found, _ = execute([Gives(), *chain], obs)
    _, true, _ = execute(
        [Gives(beside=False), *chain], observation(37, 3 * TILE_SAMPLES + 21), dtype=np.float64
    )
    name = "atmosphere" if isinstance(chain[-1], Whole) else "signal"
    left = np.abs(true - mean_of(obs, name).evaluate(slice(0, 37), slice(0, obs.n_samples))).max()
    assert np.abs(found - true).max() <= 2.0**-24 * (left if len(chain) < 3 else 6 * 16 * 2.2)


@pytest.mark.parametrize("chain", CHAINS.values(), ids=CHAINS)
def test_blocks_and_threads_change_no_bit(chain):
    size = 37 * (5 * TILE_SAMPLES + 21) * 4
    want, n = None, 5 * TILE_SAMPLES + 21
    for memory, threads, how in (
        (1 << 30, 1, None),
        (1 << 30, 3, None),
        (24 * size, 3, "again"),
        (6 * size, 1, "spilled"),
    ):
        _, got, _ = execute(
            [Gives(), *chain], observation(37, n), memory=memory, threads=threads, how=how
        )
        want = got if want is None else want
        assert np.array_equal(got, want)


def test_streams_made_again_are_whole():
    """Streams that are held nowhere (``room``: none may be kept) are swept with their means."""
    obs = observation(37, 5 * TILE_SAMPLES + 21)
    chain = [Gives(), Gain(), Measures(readings=1), Gain()]
    _, want, _ = execute(chain, obs)
    _, got, _ = execute(chain, obs, room=0)
    assert ("Execution", "stream signal made again when it is read") in {
        (who, what) for who, what, _ in obs.log
    }
    assert np.array_equal(got, want)


def test_what_is_only_read_stays_and_total_adds_the_mean_once():
    obs = observation(37, TILE_SAMPLES)
    _, want, _ = execute([Gives()], obs)
    _, kept, _ = execute([Gives(), Adds()], obs)
    assert np.array_equal(kept, want)
    _, seen, _ = execute([Gives(), Adds(), PutsInPlace()], obs)
    assert np.array_equal(seen, want.astype(np.float32))


class Restates(Gain):
    """Puts the mean beside the stream itself."""

    def exec(self, block, state):
        assert "signal" not in block.means
        block.detdata["signal"] -= 7.0
        block.means["signal"] = SmoothField.constant(
            np.full(block.observation.n_detectors, 7.0), block.observation.n_samples
        )


def test_a_mean_that_a_step_sets_itself_is_the_one_that_counts():
    obs = observation(37, TILE_SAMPLES)
    _, want, _ = execute([Gives()], obs)
    _, found, _ = execute([Gives(), Restates()], obs)
    assert np.abs(found - want).max() <= 2.0**-24 * 24  # 30 - 7 K in float32


class Sees(Operator):
    """Notes what it is given."""

    requires: ClassVar[frozenset[str]] = SIGNAL
    provides: ClassVar[frozenset[str]] = frozenset({"seen"})
    _seen: list = PrivateAttr(default_factory=list)

    def prepare(self, observation):
        return self._seen

    def exec(self, block, state):
        state.append((block.dtype, "signal" in block.means, block.detdata["signal"].dtype))


class Knows(Sees):
    """Says so."""

    knows_means: ClassVar[bool] = True

    def exec(self, block, state):
        super().exec(block, state)


class Forgets(Knows):
    """Overrides `exec` of one that knows."""

    def exec(self, block, state):
        super().exec(block, state)


@pytest.mark.parametrize(
    ("operator", "seen"),
    [
        (Sees(), (np.float64, False, np.dtype(np.float64))),
        (Knows(), (np.float32, True, np.dtype(np.float32))),
        (Forgets(), (np.float64, False, np.dtype(np.float64))),
    ],
)
def test_only_steps_that_do_not_know_pay(operator, seen):
    operator._seen.clear()
    execute([Gives(), operator], observation(3, 100))
    assert operator._seen == [seen]


def test_without_a_mean_nothing_is_copied():
    operator = Sees()
    execute([Gives(beside=False), operator], observation(3, 100))
    assert operator._seen == [(np.float32, False, np.dtype(np.float32))]


class Leaves(Operator):
    """Leaves in the block what it must not leave."""

    requires: ClassVar[frozenset[str]] = SIGNAL
    provides: ClassVar[frozenset[str]] = SIGNAL
    _what: object = PrivateAttr(None)

    def exec(self, block: Block, state):
        self._what(block)


def put(make):
    return lambda block: block.detdata.__setitem__("signal", make(block.detdata["signal"]))


@pytest.mark.parametrize("beside", [True, False])
@pytest.mark.parametrize(
    ("what", "words"),
    [
        (put(lambda x: x[:, :5].copy()), r"exec left the stream 'signal' as an array \(3, 5\)"),
        (
            put(lambda x: x.astype(np.int32)),
            r"as an array \(3, 100\) of int32; it must be an array \(3, 100\) of float",
        ),
        (put(lambda x: x.astype(np.float16)), "of float16"),
        (put(lambda x: x.tolist()), "as a list"),
        (put(lambda x: np.asfortranarray(x)), "not in C order"),
        (put(lambda x: 1.0), "as a float"),
        (
            lambda block: block.detdata.pop("signal"),
            "exec left no stream 'signal', which it provides",
        ),
        (
            lambda block: block.detdata.pop("white"),
            "exec left no stream 'white', which others read",
        ),
    ],
)
def test_what_a_step_leaves_is_looked_at(what, words, beside):
    operator = Leaves()
    operator._what = what
    with pytest.raises(PluginError, match=words) as caught:
        execute([Gives(beside=beside), operator, Sees()], observation(3, 100))
    assert "Leaves.1 (tests.core.run.test_means.Leaves)" in str(caught.value)
