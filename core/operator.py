"""An operator: a checked set of parameters and the steps in which it acts on the data.

Declarations and methods are checked when the class is made, the rest when a pipeline is built: a
step that would do nothing, or fail amid a run, is refused before.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Set
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import PrivateAttr

from .block import Block
from .configuration.diagnostics import nearest
from .configuration.parameters import Parameters
from .data import Data
from .discovery import API_VERSION
from .errors import ZondaError
from .observation import Observation
from .signal import is_stream
from .stream import Stream

STAGES = {
    "observe": "data",
    "check": "data",
    "configure": "observation",
    "prepare": "observation",
    "measure": "stream, model",
    "exec": "block, state",
    "collect": "data, observation, state",
    "finalize": "data",
}
"""Methods of an operator of which one at least is its own, and their arguments."""
OTHERS = {"halo": "observation", "discard": "observation, state"}
COUPLES = ("sample", "detectors", "time", "all")
NAMES = ("requires", "provides", "optional", "on_request")
SWITCHES = ("linear", "knows_means", "all_bands")

Fault = tuple[str, str]
"""A mistake and its cure."""


def labels(steps: Iterable[Labelled]) -> list[str]:
    """Their labels in a pipeline, which numbers namesakes: ``WhiteNoise``, ``WhiteNoise.2``."""
    seen: dict[str, int] = {}
    found = []
    for step in steps:
        base = step.name or type(step).__name__
        seen[base] = seen.get(base, 0) + 1
        found.append(base if seen[base] == 1 else f"{base}.{seen[base]}")
    return found


class Labelled(Parameters):
    """Something with parameters and a label of its own in a pipeline."""

    name: str | None = None
    """Label of this step in messages, products and random streams; the class name where absent."""

    _label: str = PrivateAttr("")

    @property
    def label(self) -> str:
        """Unique name of this step in its pipeline (the pipeline numbers namesakes: ``WhiteNoise``,
        ``WhiteNoise.2``).
        """
        return self._label or self.name or type(self).__name__


class Operator(Labelled):
    """Base class of operators.

    A pipeline calls, in this order:

    1. ``observe(data)`` once, in order: pointing operators append `Observation`s; map makers lay
       out what all of them share (`Data.layouts`).
    2. For each observation, ``configure(observation)`` of every operator (resolve values that
       others need: efficiencies, NET), then ``prepare(observation) -> state`` of every operator
       (draw turbulence, build coefficients). Both may be called for the next observation, from
       another thread, while `exec`, `measure` and `collect` work on the one before: they change
       only that observation and what a lock guards.
    3. ``exec(block, state)`` for every block. Called from several threads at once: the state is
       read only, or guarded. Its result may depend on absolute detector and sample indices only,
       never on where the block begins or ends. A block may come again (`Block.again`) where the
       streams between operators do not fit in memory.
    4. ``collect(data, observation, state)`` once per observation, in observation order: hand
       partial products to `Data.add`.
    5. ``finalize(data)`` once at the end of the run: turn partial products (`Data.take`) into
       products, write files.

    A step that requires and provides ``signal`` is called once for every signal (`core.signal`), as
    if that were the only one. A step that reads ``signal`` alone sees the complete one; a
    `MapMaker` sees all of them. What adds to the data provides a `Component`.

    Attributes
    ----------
    requires, provides
        Names of data read and written; checked before anything runs. ``boresight`` comes from a
        pointing operator; block streams are ``sky, atmosphere, transmission, white, pink, signal``;
        products are named by their makers.
    optional
        Names it uses when an earlier or later operator provides them.
    on_request
        Names that it provides only if its parameters ask for them.
    couples
        What one output sample depends on: ``sample`` (itself alone, plus `halo` neighbours),
        ``detectors`` (all detectors at that instant), ``time`` (one detector's whole scan),
        ``all``. An ``all`` operator implements `measure`; its ``exec`` then works like that of a
        ``sample`` operator.
    linear
        True where what `exec` makes of ``signal`` is linear in it: zero of zero, and additive; for
        ``couples = "all"`` with what `measure` found given.
    knows_means
        True where it handles the means that stand beside streams (`Block.means`,
        ``observation.smooth["atmosphere"]``). Without it `exec` sees whole streams: where one that
        it declares has a mean, a float64 block with the mean in it, and no entry in `Block.means`;
        the same mean is subtracted from what it leaves there (`core.run.means`). `measure`
        likewise. A class that overrides `exec` or `measure` must say so anew.
    all_bands
        True where it is given all bands of a camera at once, instead of one after the other: a
        step that measures, the stream of all detectors (`core.mapmaker.JoinsBands`); a map
        maker, their blocks (`core.mapmaker.MapMaker.exec_bands`).

    Each may be a property, if it depends on the parameters.
    """

    zonda_api: ClassVar[int] = API_VERSION
    if TYPE_CHECKING:  # a subclass may have a constant or a property

        @property
        def requires(self) -> frozenset[str]: ...
        @property
        def provides(self) -> frozenset[str]: ...
        @property
        def optional(self) -> frozenset[str]: ...
        @property
        def linear(self) -> bool: ...
        @property
        def all_bands(self) -> bool: ...

    else:
        requires: ClassVar[frozenset[str]] = frozenset()
        provides: ClassVar[frozenset[str]] = frozenset()
        optional: ClassVar[frozenset[str]] = frozenset()
        linear: ClassVar[bool] = False
        all_bands: ClassVar[bool] = False
    on_request: ClassVar[frozenset[str]] = frozenset()
    couples: ClassVar[Literal["sample", "detectors", "time", "all"]] = "sample"
    knows_means: ClassVar[bool] = False

    @classmethod
    def __pydantic_init_subclass__(cls, **options: Any) -> None:
        """Raise ZondaError for a class that breaks the contract."""
        super().__pydantic_init_subclass__(**options)
        if fault := fault_of_class(cls, Operator):
            raise ZondaError(fault[0], place=cls.__name__, cure=fault[1])

    def observe(self, data: Data) -> None:
        """Append observations to ``data`` (pointing operators), or look at those that are there
        (map makers: a common grid).
        """

    def check(self, data: Data) -> list[str]:
        """Lines for `zonda check`, found in well under a second. Raises a `ZondaError` for a
        mistake beyond the parameters.

        Pointing operators append observations to ``data``, on which later steps may look: of a long
        scan fewer instants, with what the run will take in `Observation.seen_of`
        (`Observation.sampling`). ``data.made`` names what the steps make.
        """
        return []

    def configure(self, observation: Observation) -> None:
        """Resolve values that other operators read, e.g. the focal plane's efficiencies."""

    def prepare(self, observation: Observation) -> Any:
        """Return what `exec` needs for this observation. It may set ``observation.smooth``
        fields.
        """
        return None

    def halo(self, observation: Observation) -> int:
        """Samples on each side of a block that `exec` needs to be right inside it (a finite
        filter's half-length).
        """
        return 0

    def measure(self, stream: Stream, model: Any = None) -> Any:
        """Read a whole stream (``couples = "all"`` only) and return what `exec` needs for it, in
        place of what `prepare` returned (``stream.state``).

        Called for every signal, the complete one first (``stream.signal``); that one decides which
        detectors are flagged. ``model``: what it returned for the complete signal, where this one
        is to be treated as a part of that (``modes: full``); else None.
        """
        return stream.state

    def exec(self, block: Block, state: Any) -> None:
        """Act on one block."""

    def collect(self, data: Data, observation: Observation, state: Any) -> None:
        """Hand this observation's partial products to `Data.add`."""

    def discard(self, observation: Observation, state: Any) -> None:
        """Undo what `prepare` and `exec` began (temporary files): called instead of `collect` when
        the run fails.
        """

    def finalize(self, data: Data) -> None:
        """Finish products."""


def fault_of_class(cls: type[Any], base: type[Any]) -> Fault | None:
    """Fault in the declarations and methods of a subclass of ``base``, which is `Operator`."""
    return _parameters(cls) or _declarations(cls) or _methods(cls, base)


def fault_of_step(operator: Any, base: type[Any]) -> Fault | None:
    """Fault of an operator that can be seen before it runs."""
    return _declarations(operator) or _acts(operator, base)


def _parameters(cls: type[Any]) -> Fault | None:
    """Declarations and methods that a type has made parameters."""
    for what in (*NAMES, "couples", *SWITCHES, *STAGES, *OTHERS):
        if what in cls.model_fields:
            method = what in STAGES | OTHERS
            cure = f"def {what}(self, ...): ..." if method else f"{what} = ... without a type"
            return f"{what} has a type, which makes it a parameter", f"write {cure}"
    return None


def _declarations(owner: Any) -> Fault | None:
    """Fault of what a class or an operator declares; the properties of a class are left out."""
    for what in NAMES:
        names = getattr(owner, what)
        if isinstance(names, property):
            continue
        if not isinstance(names, Set) or not all(isinstance(one, str) for one in names):
            listed = [names] if isinstance(names, str) else names
            listed = listed if isinstance(listed, tuple | list | Set) else ()
            texts = ", ".join(f'"{one}"' for one in listed if isinstance(one, str)) or '"signal"'
            return (
                f"{what} is a frozenset of names, not {names!r:.60}",
                f"write {what} = frozenset({{{texts}}})",
            )
    if not isinstance(owner.couples, property) and owner.couples not in COUPLES:
        cure = nearest(owner.couples, COUPLES) or f"choose from: {', '.join(COUPLES)}"
        return f"couples is one of {', '.join(COUPLES)}, not {owner.couples!r:.60}", cure
    for what in SWITCHES:
        value = getattr(owner, what)
        if not isinstance(value, bool | property):
            return (
                f"{what} is True or False, not {value!r:.60}",
                f"write {what} = True, or leave it out",
            )
    return None


def _methods(cls: type[Any], base: type[Any]) -> Fault | None:
    for stage, arguments in (STAGES | OTHERS).items():
        if (method := getattr(cls, stage, None)) is getattr(base, stage):
            continue
        head = f"def {stage}(self, {arguments})"
        if not callable(method):
            return f"{stage} is a method, not {method!r:.60}", f"write {head}: ..."
        try:
            bound = getattr(object.__new__(cls), stage)
            inspect.signature(bound).bind(*arguments.split(", "))
        except TypeError:
            return f"{stage} does not take {arguments}", f"write {head}: ..."
        except ValueError:  # a method of compiled code
            continue
    return None


def _acts(operator: Any, base: type[Any]) -> Fault | None:
    cls = type(operator)
    own = [stage for stage in STAGES if getattr(cls, stage) is not getattr(base, stage)]
    others = _further_methods(cls, base)
    if not own:
        return f"overrides none of {', '.join(STAGES)}: it would do nothing", _named(others, "exec")
    if "exec" not in own and (
        streams := sorted(name for name in operator.provides if is_stream(name))
    ):
        return (
            f"provides {' and '.join(streams)}, but overrides no exec: it would do nothing to it",
            _named(others, "exec"),
        )
    if operator.couples == "all" and "measure" not in own:
        return (
            "couples all samples, but overrides no measure, which reads the whole stream",
            _named(others, "measure"),
        )
    return None


def _further_methods(cls: type[Any], base: type[Any]) -> list[str]:
    """Public methods that a class has beyond `Operator`."""
    classes = [c for c in cls.__mro__ if issubclass(c, base) and c is not base]
    methods = [
        name for c in classes for name, value in vars(c).items() if inspect.isfunction(value)
    ]
    return [name for name in methods if not name.startswith("_") and not hasattr(base, name)]


def _named(others: list[str], stage: str) -> str:
    """The cure of a class whose method has another name than ``stage``."""
    head = f"def {stage}(self, {STAGES[stage]})"
    return (
        f"is {others[0]} what the step does? call it {stage}: {head}"
        if others
        else f"write {head}: ..."
    )
