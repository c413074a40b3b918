"""Blocks: rectangles of detectors x samples, on which operators work."""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .errors import PluginError
from .log import Log
from .numerics.smooth import SmoothField
from .observation import Observation
from .signal import MAIN, Component, Entrance
from .types import AnyFloats, Floats

STREAMS = ("sky", "atmosphere", "transmission", "white", "pink", "signal")
"""Streams that zonda's own operators make in every block: the components, and their calibrated sum.
Their only use is to be read by a later operator of the same run."""


@dataclass
class Block:
    """A rectangle of detectors x samples of one observation, on which `Operator.exec` works.

    Attributes
    ----------
    observation
        The scan it belongs to. Read only inside ``exec``.
    detectors, samples
        Absolute ranges (slices with start and stop, step None).
    detdata
        Named streams, each (n_det_block, n_samp_block) of `dtype`, C-contiguous. The signal
        components are `sky` (main-beam sky signal above the atmosphere), `atmosphere` (fluctuation
        of the emission about its mean, before efficiency), `transmission` (relative fluctuation of
        e^-tau about its mean), `white` and `pink` (at the detector), all K_RJ but `transmission`;
        `signal` is the calibrated sum.
    means
        What must be added to a stream in float64 to have all of it, by stream name: the smooth mean
        emission. A step that does not say that it knows of means (`Operator.knows_means`) finds
        none here: its streams are whole.
    dtype
        float32 or float64: the type of every stream. Where a mean was added for a step that does
        not know of means, float64.
    """

    observation: Observation
    detectors: slice
    samples: slice
    detdata: dict[str, AnyFloats] = field(default_factory=dict)
    means: dict[str, SmoothField] = field(default_factory=dict)
    dtype: type[np.floating[Any]] = np.float32
    buffers: dict[str, AnyFloats] = field(default_factory=dict, repr=False)
    """Memory reused from block to block; `exec` must not keep a stream beyond the call."""
    places: dict[str, AnyFloats] = field(default_factory=dict, repr=False)
    """Array in which the executor wants a stream to be made, so that it need not be copied."""
    again: bool = False
    """These samples were worked on before, and are made again because the streams do not fit in
    memory: an operator makes the same bits and counts nothing (what it tells ``observation.log``
    is thrown away)."""

    components: frozenset[Component] = frozenset()
    """Components whose sum is ``signal``."""
    suffix: str = ""
    """Tells the buffers of one signal from those of the others."""

    @property
    def signals(self) -> list[str]:
        """Names of the streams of all signals that are here, in the order of
        `Observation.signals`.
        """
        return [name for name in self.observation.signals if name in self.detdata]

    def entering(self, where: Entrance) -> list[str]:
        """Names of the components of ``signal`` that are here and enter there, in a fixed order."""
        return sorted(c for c in self.components if c.enters == where and c in self.detdata)

    def alone(
        self,
        stream: str,
        components: frozenset[Component],
        others: Collection[str],
    ) -> Block:
        """The block as a step sees it that knows one signal: under the name ``signal``, with its
        mean and its components alone.

        ``others``: components of the scene that are not part of it. What a step tells of another
        than the complete signal is thrown away.
        """
        observation = self.observation
        if stream != MAIN:
            observation = copy.copy(observation)
            observation.log = Log()
        hidden = {*others, *self.signals}
        seen = Block(
            observation,
            self.detectors,
            self.samples,
            {name: array for name, array in self.detdata.items() if name not in hidden},
            {name: field for name, field in self.means.items() if name not in hidden},
            self.dtype,
            self.buffers,
            again=self.again,
            components=components,
            suffix=stream[len(MAIN) :],
        )
        if stream in self.detdata:
            seen.detdata[MAIN] = self.detdata[stream]
        if stream in self.means:
            seen.means[MAIN] = self.means[stream]
        if stream in self.places:
            seen.places[MAIN] = self.places[stream]
        return seen

    def take(self, stream: str, seen: Block) -> None:
        """Put back what a step made of a signal (`alone`)."""
        self.detdata.pop(stream, None)
        self.means.pop(stream, None)
        if MAIN in seen.detdata:
            self.detdata[stream] = seen.detdata[MAIN]
        if MAIN in seen.means:
            self.means[stream] = seen.means[MAIN]
        if stream == MAIN:  # what else it made
            self.detdata.update(
                (name, array) for name, array in seen.detdata.items() if name != MAIN
            )

    @property
    def shape(self) -> tuple[int, int]:
        return self.detectors.stop - self.detectors.start, self.samples.stop - self.samples.start

    def new(self, name: str, *, zero: bool = True) -> AnyFloats:
        """The stream ``name`` of this block; made, full of zeros, where there is none yet. Not
        ``zero``: with any values, for a caller that overwrites all of them.
        """
        if name not in self.detdata:
            self.detdata[name] = (
                self.places[name] if name in self.places else self.buffer(name, self.shape)
            )
            if zero:
                self.detdata[name].fill(0)
        return self.detdata[name]

    def buffer(self, name: str, shape: tuple[int, int]) -> AnyFloats:
        """An uninitialized array of `dtype`, reused between blocks under this name."""
        size = shape[0] * shape[1]
        key = name + self.suffix
        held = self.buffers.get(key)
        if held is None or held.size < size or held.dtype != self.dtype:
            held = self.buffers[key] = np.empty(size, self.dtype)
        return held[:size].reshape(shape)

    def total(self, name: str) -> Floats:
        """Stream plus its mean, float64: (n_det_block, n_samp_block). A copy."""
        whole = self.detdata[name].astype(np.float64)
        if name in self.means:
            whole += self.means[name].evaluate(self.detectors, self.samples)
        return whole

    def check(
        self,
        before: Mapping[str, AnyFloats],
        provides: frozenset[str],
        due: frozenset[str],
        who: Callable[[], str],
    ) -> None:
        """Refuse what `Operator.exec` must not leave: a stream that is missing, or is no array of
        the block's shape and type.

        Parameters
        ----------
        before
            The streams before; an array that is still there is not looked at.
        provides, due
            Streams that the step may take away, and those that it must have made.
        who
            Tells the step, its class and where that comes from, if there is something to refuse.

        Raises
        ------
        PluginError
            Names the step.
        """
        for name, stream in self.detdata.items():
            if stream is before.get(name):
                continue
            if not isinstance(stream, np.ndarray):
                found = f"a {type(stream).__name__}"
            elif stream.shape != self.shape or stream.dtype != self.dtype:
                found = f"an array {stream.shape} of {stream.dtype}"
            elif not stream.flags.c_contiguous:
                found = "an array that is not in C order"
            else:
                continue
            wanted = f"an array {self.shape} of {np.dtype(self.dtype)} in C order"
            raise PluginError(
                f"exec left the stream {name!r} as {found}; it must be {wanted}",
                place=who(),
                cure=f"fill it in place: block.new({name!r})[...] = values",
            )
        gone = (due - self.detdata.keys()) | (before.keys() - provides - self.detdata.keys())
        if gone:
            name = min(gone)
            what = "it provides" if name in provides else "others read"
            cure = f"make it with block.new({name!r}), or leave it out of provides"
            raise PluginError(
                f"exec left no stream {name!r}, which {what}",
                place=who(),
                cure=cure if name in due else "leave it in block.detdata",
            )
