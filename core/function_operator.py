"""A function of a block as a step of a pipeline: ``zonda.operator(lambda block: ...)``.

>>> import zonda
>>> double = zonda.operator(lambda block: 2 * block.detdata["signal"], linear=True)
>>> double.label, sorted(double.requires), sorted(double.provides)
('function', ['signal'], ['signal'])
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterable
from typing import Any, Literal, cast, overload

import numpy as np
from pydantic import PrivateAttr

from .block import Block
from .errors import PipelineError, ZondaError
from .operator import Operator

Function = Callable[[Block], Any]


class FunctionOperator(Operator):
    """A step that calls a function; `operator` makes it."""

    function: str
    """Module and name of the function, for provenance."""
    source: str
    """File and line where it stands, for provenance."""

    _call: Any = PrivateAttr(None)

    def exec(self, block: Block, state: Any) -> None:
        """Call the function; an array that it returns becomes the stream that it provides.

        Raises PipelineError from whatever the function raises, with the step, the function and its place.
        """
        try:
            made = self._call(block)
        except (ZondaError, MemoryError):
            raise
        except Exception as err:
            words = "".join(str(err).strip().splitlines()[:1])
            text = f"the function {self.function} raised {type(err).__name__}{': ' * bool(words)}{words}"
            raise PipelineError(text, place=self.label, cure=f"mend it: {_where(err) or self.source}") from err
        if made is None:
            return
        values = np.asarray(made)
        if len(self.provides) != 1 or values.dtype.kind not in "fiu" or values.shape != block.shape:
            what = f"an array of shape {values.shape}" if values.dtype.kind in "fiu" else f"{made!r:.40}"
            wanted = f"nothing: it provides {len(self.provides) or 'no'} streams; several stand in block.detdata"
            if len(self.provides) == 1:
                wanted = f"nothing, or the stream {next(iter(self.provides))}, an array of shape {block.shape}"
            raise PipelineError(f"the function returned {what}", place=self.label, cure=f"return {wanted}")
        block.new(next(iter(self.provides)), zero=False)[...] = values


@overload
def operator(
    function: Function,
    *,
    name: str | None = None,
    requires: Iterable[str] = ("signal",),
    provides: Iterable[str] = ("signal",),
    couples: Literal["sample", "detectors", "time"] = "sample",
    linear: bool = False,
) -> FunctionOperator: ...
@overload
def operator(
    function: None = None,
    *,
    name: str | None = None,
    requires: Iterable[str] = ("signal",),
    provides: Iterable[str] = ("signal",),
    couples: Literal["sample", "detectors", "time"] = "sample",
    linear: bool = False,
) -> Callable[[Function], FunctionOperator]: ...
def operator(
    function: Function | None = None,
    *,
    name: str | None = None,
    requires: Iterable[str] = ("signal",),
    provides: Iterable[str] = ("signal",),
    couples: Literal["sample", "detectors", "time"] = "sample",
    linear: bool = False,
) -> FunctionOperator | Callable[[Function], FunctionOperator]:
    """A step that calls ``function(block)`` for every block; a plain call, or a decorator.

    The function returns the stream that it provides, (n_det_block, n_samp_block), or changes ``block.detdata`` and returns
    nothing. Streams have their mean in them, as for every step that does not say ``knows_means`` (`Operator`). It may be called
    from several threads, and its result must not depend on where a block begins. The step is for Python: a pipeline file and a
    campaign do not know it.

    Parameters
    ----------
    name
        Label of the step; default: the function's name, ``function`` for a lambda.
    requires, provides
        Names of streams that it reads and writes. What adds to the data provides a `Component`.
    couples, linear
        As of `Operator`.

    Raises
    ------
    PipelineError
        For what is no function, names that are no texts, or another coupling.
    """
    if function is None:
        return lambda made: operator(made, name=name, requires=requires, provides=provides, couples=couples, linear=linear)
    place = "zonda.operator"
    if not callable(function) or isinstance(function, type | Operator):
        raise PipelineError(f"expected a function of a block, got {function!r:.60}", place=place, cure="write lambda block: ...")
    for what, names in (("requires", requires), ("provides", provides)):
        if isinstance(names, str) or not all(isinstance(one, str) for one in names):
            raise PipelineError(f"{what} is a list of names, not {names!r:.60}", place=place, cure=f"write {what}=['signal']")
    if couples not in ("sample", "detectors", "time"):
        cure = "choose from 'sample', 'detectors', 'time'; what measures the whole stream is a class (docs/plugins.md)"
        raise PipelineError(f"a function cannot couple {couples!r:.40}", place=place, cure=cure)
    own = getattr(function, "__name__", type(function).__name__)
    label = name or ("function" if own == "<lambda>" else own)
    given = {
        "requires": frozenset(requires), "provides": frozenset(provides), "couples": couples, "linear": bool(linear),
        "__doc__": getattr(function, "__doc__", None) or "A function.", "__module__": __name__,
    }  # fmt: skip
    made = cast(Any, type(FunctionOperator))(label if label.isidentifier() else "function", (FunctionOperator,), given)
    step: FunctionOperator = made(name=label, function=_named(function, own), source=_place(function))
    step._call = function
    return step


def _where(err: Exception) -> str:
    """``file.py, line 12`` of the innermost code that raised it and is no library's: the function's own or what it calls."""
    frames = [(frame.f_code.co_filename, line) for frame, line in traceback.walk_tb(err.__traceback__)][1:]
    own = [place for place in frames if "site-packages" not in place[0] and not place[0].startswith("<")]
    return f"{own[-1][0]}, line {own[-1][1]}" if own else ""


def _named(function: Any, own: str) -> str:
    return f"{getattr(function, '__module__', None) or '?'}.{getattr(function, '__qualname__', own)}"


def _place(function: Any) -> str:
    """``file.py, line 12`` of the code that is called."""
    code = getattr(function, "__code__", None)
    return "not known" if code is None else f"{code.co_filename}, line {code.co_firstlineno}"
