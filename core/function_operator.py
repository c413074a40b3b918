"""A function of a block as a step of a pipeline: ``zonda.operator(lambda block: ...)``.

>>> import zonda
>>> double = zonda.operator(lambda block: 2 * block.detdata["signal"], linear=True)
>>> double.label, sorted(double.requires), sorted(double.provides)
('function', ['signal'], ['signal'])
"""

from __future__ import annotations

import traceback
import warnings
import zlib
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Literal, cast, overload

import numpy as np
from pydantic import PrivateAttr

from .block import Block
from .data import Data
from .errors import PipelineError, ZondaError
from .operator import Operator
from .stream import Changed, Stream, whole

Function = Callable[[Block], Any]


class FunctionOperator(Operator):
    """A step that calls a function; `operator` makes it."""

    function: str
    """Module and name of the function, for provenance."""
    source: str
    """File and line where it stands, for provenance."""

    _call: Any = PrivateAttr(None)
    _idle: bool | None = PrivateAttr(None)
    """True if every call so far left all that it provides as it was; None before the first call."""

    def measure(self, stream: Stream, model: Any = None) -> Changed | None:
        """``couples = "all"``: call the function with a block that is the whole scan. Each signal
        is acted on by itself.

        Raises PipelineError as `exec` does.
        """
        observation = stream.observation
        fixed = None
        if stream.name == EMISSION:
            fixed = observation.smooth.get(EMISSION)
        name, (n_det, n_samp) = stream.name, stream.shape
        values = whole(stream, fixed)
        every = (slice(0, n_det), slice(0, n_samp))
        block = Block(
            observation, *every, {name: values}, dtype=np.float64, components=stream.components
        )
        self._act(block)
        if not self.provides:
            return None
        left = block.detdata.get(name)
        if left is not values and (
            not isinstance(left, np.ndarray) or left.shape != block.shape or left.dtype.kind != "f"
        ):
            text = f"the function {self.function} left no stream {name} of shape {block.shape}"
            raise PipelineError(
                text,
                place=self.label,
                cure=f'change block.detdata["{name}"] in place, or return it',
            )
        return Changed.of(np.asarray(left, np.float64), stream, fixed)

    def exec(self, block: Block, state: Any) -> None:
        """Call the function; an array that it returns becomes the stream that it provides. With
        ``couples = "all"`` put what `measure` found.

        Raises PipelineError from whatever the function raises, with the step, the function and its
        place.
        """
        if self.couples != "all":
            self._act(block)
        elif state is not None:
            state.put(block, next(iter(self.provides)))

    def finalize(self, data: Data) -> None:
        """Warn where it did nothing."""
        if self._idle and self.provides:
            text = (
                f"the function {self.function} left {' and '.join(sorted(self.provides))} as it was"
            )
            warnings.warn(f"{self.label}: {text}: does it lack a return?", stacklevel=2)
        self._idle = None

    def _act(self, block: Block) -> None:
        """See `exec`."""

        def bits() -> dict[str, int]:
            return {k: _bits(block.detdata[k]) for k in self.provides & block.detdata.keys()}

        before = bits()
        try:
            made = self._call(block)
        except (ZondaError, MemoryError):
            raise
        except Exception as err:
            words = "".join(str(err).strip().splitlines()[:1])
            text = (
                f"the function {self.function} raised"
                f" {type(err).__name__}{': ' * bool(words)}{words}"
            )
            raise PipelineError(
                text,
                place=self.label,
                cure=f"mend it: {_where(err) or self.source}",
            ) from err
        self._idle = self._idle is not False and made is None and before == bits()
        if made is None:
            return
        values = np.asarray(made)
        only = len(self.provides) == 1
        numbers = values.dtype.kind in "fiu"
        name = next(iter(self.provides), "")
        if not only or not numbers or values.shape != block.shape:
            what = f"an array of shape {values.shape}" if numbers else f"{made!r:.40}"
            wanted = f", or the stream {name}, an array of shape {block.shape}"
            if not only:
                number = len(self.provides) or "no"
                wanted = f": it provides {number} streams; several stand in block.detdata"
            raise PipelineError(
                f"the function returned {what}",
                place=self.label,
                cure=f"return nothing{wanted}",
            )
        block.new(name, zero=False)[...] = values


EMISSION = "atmosphere"
"""The stream whose mean stands in ``observation.smooth`` (`core.run.means`)."""


@overload
def operator(
    function: Function,
    *,
    name: str | None = None,
    requires: Iterable[str] = ("signal",),
    provides: Iterable[str] = ("signal",),
    couples: Literal["sample", "detectors", "time", "all"] = "sample",
    linear: bool = False,
) -> FunctionOperator: ...
@overload
def operator(
    function: None = None,
    *,
    name: str | None = None,
    requires: Iterable[str] = ("signal",),
    provides: Iterable[str] = ("signal",),
    couples: Literal["sample", "detectors", "time", "all"] = "sample",
    linear: bool = False,
) -> Callable[[Function], FunctionOperator]: ...
def operator(
    function: Function | None = None,
    *,
    name: str | None = None,
    requires: Iterable[str] = ("signal",),
    provides: Iterable[str] = ("signal",),
    couples: Literal["sample", "detectors", "time", "all"] = "sample",
    linear: bool = False,
) -> FunctionOperator | Callable[[Function], FunctionOperator]:
    """A step that calls ``function(block)`` for every block; a plain call, or a decorator.

    With ``couples="all"`` the block is the whole scan: all detectors (of a band) and all samples,
    in float64, once for each scan and signal. Any other coupling sees parts: ``detectors`` all
    detectors at some of the samples, ``time`` all samples of some of the detectors.

    The function returns the stream that it provides, (n_det_block, n_samp_block), or changes
    ``block.detdata`` and returns nothing. Streams have their mean in them, as for every step that
    does not say ``knows_means`` (`Operator`). It may be called from several threads, and its result
    must not depend on where a block begins. The step is for Python: a pipeline file and a campaign
    do not know it.

    Parameters
    ----------
    name
        Label of the step; default: the function's name, ``function`` for a lambda.
    requires, provides
        Names of streams that it reads and writes. What adds to the data provides a `Component`.
    couples, linear
        As of `Operator`. With ``all`` it reads one stream, and provides that or nothing; it needs
        no `measure`.

    Raises
    ------
    PipelineError
        For what is no function, names that are no texts, or another coupling.
    """
    if function is None:
        return lambda made: operator(
            made,
            name=name,
            requires=requires,
            provides=provides,
            couples=couples,
            linear=linear,
        )
    refused = partial(PipelineError, place="zonda.operator")
    if not callable(function) or isinstance(function, type | Operator):
        text = f"expected a function of a block, got {function!r:.60}"
        raise refused(text, cure="write lambda block: ...")
    for what, names in (("requires", requires), ("provides", provides)):
        if isinstance(names, str) or not all(isinstance(one, str) for one in names):
            text = f"{what} is a list of names, not {names!r:.60}"
            raise refused(text, cure=f"write {what}=['signal']")
    if couples not in ("sample", "detectors", "time", "all"):
        cure = "choose from 'sample', 'detectors', 'time', 'all'"
        raise refused(f"a function cannot couple {couples!r:.40}", cure=cure)
    if couples == "all" and (len(set(requires)) != 1 or not set(provides) <= set(requires)):
        text = "a function of a whole scan reads one stream, and provides that or nothing"
        raise refused(text, cure="write requires=['signal'], and the same or nothing as provides")
    own = getattr(function, "__name__", type(function).__name__)
    label = name or ("function" if own == "<lambda>" else own)
    given = {
        "requires": frozenset(requires),
        "provides": frozenset(provides),
        "couples": couples,
        "linear": bool(linear),
        "knows_means": couples == "all",
        "__doc__": getattr(function, "__doc__", None) or "A function.",
        "__module__": __name__,
    }
    made = cast(Any, type(FunctionOperator))(
        label if label.isidentifier() else "function",
        (FunctionOperator,),
        given,
    )
    step: FunctionOperator = made(
        name=label,
        function=_named(function, own),
        source=_place(function),
    )
    step._call = function
    return step


def _bits(values: Any) -> int:
    """A check sum."""
    return zlib.crc32(np.ascontiguousarray(values).view(np.uint8))  # type: ignore[arg-type]


def _where(err: Exception) -> str:
    """``file.py, line 12`` of the innermost code that raised it and is no library's: the function's
    own or what it calls.
    """
    frames = [
        (frame.f_code.co_filename, line) for frame, line in traceback.walk_tb(err.__traceback__)
    ][1:]
    own = [
        place
        for place in frames
        if "site-packages" not in place[0] and not place[0].startswith("<")
    ]
    return f"{own[-1][0]}, line {own[-1][1]}" if own else ""


def _named(function: Any, own: str) -> str:
    return (
        f"{getattr(function, '__module__', None) or '?'}.{getattr(function, '__qualname__', own)}"
    )


def _place(function: Any) -> str:
    """``file.py, line 12`` of the code that is called."""
    code = getattr(function, "__code__", None)
    return "not known" if code is None else f"{code.co_filename}, line {code.co_firstlineno}"
