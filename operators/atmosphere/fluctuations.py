"""The fluctuations that a block is given: from nodes over the focal plane, or of each detector
where no nodes pay.

At nodes everything is drawn once, before the blocks: few nodes stand for all detectors. Where each
detector is its own node its series are made on demand, a unit of detectors and samples at a time,
so that a scan of any length needs little memory; a unit has the same bits whenever it is made.
Where all units of a scan are kept they are made in order of time, those of bands that are executed
together side by side:
tiles of the turbulence serve all detectors of that moment.
"""

from __future__ import annotations

import math
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np

from zonda.core.numerics.smooth import (
    PAD,
    SPLINE_MARGIN,
    DetectorField,
    SmoothField,
    spline_coefficients,
)
from zonda.core.types import AnyFloats, Floats

from .response import Response
from .turbulence.nodes import Nodes
from .turbulence.sampling import TIMES_AT_ONCE, DriftingLayers

ToPwv = Callable[[Floats, Floats, Floats, slice], tuple[Floats, Floats]]
"""(sum of the layers, their weighted sums, sine of the elevation, columns that belong to the scan)
-> y, and the weighted sums as strong as y is there; it counts what it clips."""

UNIT_DETECTORS, UNIT_SAMPLES = 128, 16384
"""Size of a unit."""

POINTS_AT_ONCE = 1 << 19
"""Nodes x times that are worked on at a time, where nodes serve."""

AHEAD = 8
"""Units that a thread may work ahead."""

BYTES_KEPT = 128 << 20
"""Memory of the units that are kept: until the other detectors and operators have taken their part.
"""

ALL_KEPT, SHARE_KEPT = 384 << 20, 0.3
"""Memory up to which all units of a scan are kept, as long as it is at most this share of a
stream's: a step behind this one that needs whole scans would else need a whole stream, or the units
in another order than that of time."""


def times(samples: slice, step: int) -> tuple[int, int]:
    """First time (in units of ``step``) and number of times whose values make the spline over these
    samples.
    """
    first = samples.start // step - PAD - SPLINE_MARGIN
    return first, -(-samples.stop // step) + 2 + SPLINE_MARGIN - first


@dataclass(frozen=True)
class AtNodes:
    """Named fields (`Response.names`) interpolated from nodes."""

    fields: dict[str, SmoothField]
    sums: tuple[int, float, float]

    @classmethod
    def make(
        cls,
        nodes: Nodes,
        layers: DriftingLayers,
        to_pwv: ToPwv,
        response: Response,
        step: int,
        n_samples: int,
    ) -> AtNodes:
        """Evaluate the layers at the nodes over the whole scan, a part of it at a time."""
        n_node = len(nodes.xi)
        weights = np.ascontiguousarray(nodes.weights)
        width = -(-n_samples // step) + 3
        coefficients = {name: np.empty((n_node, width)) for name in response.names}
        sums = []
        part = step * max(TIMES_AT_ONCE, POINTS_AT_ONCE // n_node)
        for start in range(0, n_samples, part):
            at = times(slice(start, min(start + part, n_samples)), step)
            (g,), (weighted,), sine = layers.sums([], nodes.xi, nodes.eta, *at)
            own = _own(g.shape[1])
            y, weighted = to_pwv(g, weighted, sine, own)
            sums.append(_sums(y[:, own]))
            first = start // step
            for name, whole in coefficients.items():
                made = spline_coefficients(response(name, y, sine, weighted))
                whole[:, first : first + made.shape[1]] = made
        fields = {
            name: SmoothField(weights, c, step, n_samples) for name, c in coefficients.items()
        }
        return cls(fields, _added(sums))

    def drawn(self) -> tuple[int, float, float]:
        """Number of values of the PWV, their sum, and that of their squares."""
        return self.sums

    def into(self, detectors: slice, samples: slice, out: dict[str, AnyFloats]) -> None:
        """Overwrite the arrays ``out`` (n_det, n_samp), by name, with the fluctuations of a
        block.
        """
        for name, array in out.items():
            self.fields[name].evaluate(detectors, samples, array)


class OfDetectors:
    """Each detector's own series, in float32, made on demand. Safe for threads."""

    def __init__(
        self,
        nodes: Nodes,
        layers: DriftingLayers,
        to_pwv: ToPwv,
        response: Response,
        step: int,
        n_samples: int,
    ) -> None:
        self._xi = nodes.xi
        self._eta = nodes.eta
        self._layers = layers
        self._to_pwv = to_pwv
        self._response = response
        self.step = step
        self._n_samples = n_samples
        self._units: OrderedDict[tuple[int, int], Future[dict[str, AnyFloats]]] = OrderedDict()
        self._sums: dict[tuple[int, int], tuple[int, float, float]] = {}
        self._lock = threading.Lock()
        n_detectors = len(nodes.xi)
        streams = len(response.names)
        self._groups = -(-n_detectors // UNIT_DETECTORS)
        self._times = -(-n_samples // UNIT_SAMPLES)
        self._keeps_all = keeps_all(n_detectors, n_samples, step, streams)
        self._begun = 0
        self._most = max(1, BYTES_KEPT // _unit_size(n_detectors, step, streams))
        if self._keeps_all:
            self._most = self._groups * self._times
        self._beside: list[weakref.ref[OfDetectors]] = []
        self._alike = 0
        """The number that bands have in common whose detectors look along the same lines."""

    def join(self, bands: list[weakref.ref[OfDetectors]]) -> None:
        """Let bands with the same lines of sight compute their blocks of atmosphere together;
        ``bands``: a list that all of them are given.
        """
        if self._keeps_all:
            others = [one for held in bands if (one := held()) is not None]
            unlike = {one._alike for one in others if not one._looks_as(self)}
            self._alike = next(
                (one._alike for one in others if one._alike not in unlike),
                len(bands),
            )
            self._beside = bands
            bands.append(weakref.ref(self))

    def _looks_as(self, other: OfDetectors) -> bool:
        same = np.array_equal(self._xi, other._xi) and np.array_equal(self._eta, other._eta)
        return same and self._layers.looks_as(other._layers)

    def drawn(self) -> tuple[int, float, float]:
        """See `AtNodes.drawn`, for the units made so far."""
        return _added([self._sums[key] for key in sorted(self._sums)])

    def into(self, detectors: slice, samples: slice, out: dict[str, AnyFloats]) -> None:
        """See `AtNodes.into`."""
        for unit, of_detectors in _parts(detectors, UNIT_DETECTORS):
            for number, of_samples in _parts(samples, UNIT_SAMPLES):
                coefficients = self._unit(unit, number)
                rows = _from(of_detectors, unit * UNIT_DETECTORS)
                at = _from(of_samples, number * UNIT_SAMPLES)
                where = _from(of_detectors, detectors.start), _from(of_samples, samples.start)
                for name, array in out.items():
                    field = DetectorField(coefficients[name], self.step, UNIT_SAMPLES)
                    part = array[where]
                    if part.flags.c_contiguous:
                        field.evaluate(rows, at, part)
                    else:
                        part[...] = field.evaluate(rows, at, np.empty(part.shape, part.dtype))

    def _unit(self, unit: int, number: int) -> dict[str, AnyFloats]:
        """The coefficients of a unit. A thread that would wait for another to make it makes one
        that comes later instead.
        """
        while True:
            with self._lock:
                wanted = self._units.get((unit, number))
                if wanted is not None:
                    self._units.move_to_end((unit, number))
                key = None if wanted is not None and wanted.done() else self._to_make(unit, number)
                mine = None if key is None else self._begin(key)
            if key is None or mine is None:
                assert wanted is not None
                return wanted.result()
            self._fill(key, mine)
            if key == (unit, number):
                return mine.result()

    def _to_make(self, unit: int, number: int) -> tuple[int, int] | None:
        """The unit to begin with where one is wanted that is not made; None: all that may be of use
        have been begun.
        """
        if self._keeps_all:
            while self._begun < self._groups * self._times:
                number, unit = divmod(self._begun, self._groups)
                if (unit, number) not in self._units:
                    return unit, number
                self._begun += 1
            return None
        if (unit, number) not in self._units:
            return unit, number
        return next(
            (k for k in self._next(unit, number, min(AHEAD, self._most)) if k not in self._units),
            None,
        )

    def _begin(self, key: tuple[int, int]) -> Future[dict[str, AnyFloats]]:
        """Note that a unit is being made; the lock is held."""
        mine: Future[dict[str, AnyFloats]] = Future()
        self._units[key] = mine
        while len(self._units) > self._most:
            self._units.popitem(last=False)  # a thread that waits for it still holds it
        return mine

    def _fill(self, key: tuple[int, int], mine: Future[dict[str, AnyFloats]]) -> None:
        """Make a unit that has been begun, and that of bands beside this one, unless they have
        begun it.
        """
        todo = [(self, mine)]
        todo += [
            (other, theirs)
            for held in self._beside
            if (other := held()) and (theirs := other._also(key)) is not None
        ]
        try:
            for alike in sorted({band._alike for band, _ in todo}):
                these = [one for one in todo if one[0]._alike == alike]
                drawn, weighted, sine = these[0][0]._draw(
                    [band._layers for band, _ in these[1:]], *key
                )
                for (band, future), g, own in zip(these, drawn, weighted, strict=True):
                    future.set_result(band._make(key, g, own, sine))
        except BaseException as error:
            for band, future in todo:
                if not future.done():
                    future.set_exception(error)
                    with band._lock:
                        band._units.pop(key, None)
                        band._begun = 0
            raise

    def _also(self, key: tuple[int, int]) -> Future[dict[str, AnyFloats]] | None:
        """Begin a unit that another band makes, unless it has been begun."""
        with self._lock:
            return None if key in self._units else self._begin(key)

    def _next(self, unit: int, number: int, reach: int) -> Iterator[tuple[int, int]]:
        """Units that will be needed soon: later ones of the same detectors, the same time of the
        next detectors.
        """
        for k in range(number + 1, min(number + reach, self._times)):
            yield unit, k
        for k in range(unit + 1, min(unit + reach, self._groups)):
            yield k, number

    def _draw(
        self,
        others: Sequence[DriftingLayers],
        unit: int,
        number: int,
    ) -> tuple[Floats, list[Floats], Floats]:
        """`DriftingLayers.sums` for the detectors and times of a unit."""
        rows = slice(unit * UNIT_DETECTORS, (unit + 1) * UNIT_DETECTORS)
        samples = slice(number * UNIT_SAMPLES, min((number + 1) * UNIT_SAMPLES, self._n_samples))
        return self._layers.sums(
            others, self._xi[rows], self._eta[rows], *times(samples, self.step)
        )

    def _make(
        self,
        key: tuple[int, int],
        g: Floats,
        weighted: Floats,
        sine: Floats,
    ) -> dict[str, AnyFloats]:
        own = _own(g.shape[1])
        with self._lock:  # what is made again is not counted again
            counted = own if key not in self._sums else slice(0, 0)
            self._sums.setdefault(key, (0, 0.0, 0.0))
        y, weighted = self._to_pwv(g, weighted, sine, counted)
        self._sums[key] = _sums(y[:, own])
        made = ((name, self._response(name, y, sine, weighted)) for name in self._response.names)
        return {name: spline_coefficients(values, np.float32) for name, values in made}


def units_fit(n_detectors: int, n_samples: int, step: int, streams: int) -> bool:
    """True if all units of `OfDetectors` take little memory."""
    return units_bytes(n_detectors, n_samples, step, streams) <= BYTES_KEPT


def keeps_all(n_detectors: int, n_samples: int, step: int, streams: int) -> bool:
    """True if all units of `OfDetectors` are kept, so that blocks may be worked on in any order."""
    stream = 4 * n_detectors * n_samples
    return units_bytes(n_detectors, n_samples, step, streams) <= max(
        BYTES_KEPT,
        min(ALL_KEPT, SHARE_KEPT * stream),
    )


def units_bytes(n_detectors: int, n_samples: int, step: int, streams: int) -> int:
    """Bytes of all units of `OfDetectors`."""
    number = -(-n_detectors // UNIT_DETECTORS) * -(-n_samples // UNIT_SAMPLES)
    return number * _unit_size(n_detectors, step, streams)


def _unit_size(n_detectors: int, step: int, streams: int) -> int:
    """Bytes."""
    return (
        4
        * min(UNIT_DETECTORS, n_detectors)
        * (UNIT_SAMPLES // min(step, UNIT_SAMPLES) + 3)
        * streams
    )


def _sums(y: Floats) -> tuple[int, float, float]:
    return y.size, float(y.sum()), float(np.einsum("ij,ij->", y, y))


def _added(parts: list[tuple[int, float, float]]) -> tuple[int, float, float]:
    number, total, squares = zip(*parts, strict=True) if parts else ((), (), ())
    return sum(number), math.fsum(total), math.fsum(squares)


def _own(count: int) -> slice:
    """Columns of `times` that are not margin."""
    return slice(PAD + SPLINE_MARGIN, count - 2 - SPLINE_MARGIN)


def _from(part: slice, start: int) -> slice:
    return slice(part.start - start, part.stop - start)


def _parts(whole: slice, size: int) -> Iterator[tuple[int, slice]]:
    """(number, part) of the units of ``size`` that a slice reaches into."""
    for number in range(whole.start // size, -(-whole.stop // size)):
        yield number, slice(max(whole.start, number * size), min(whole.stop, (number + 1) * size))
