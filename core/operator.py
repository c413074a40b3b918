"""An operator: a checked set of parameters and the steps in which it acts on the data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import PrivateAttr

from .configuration.parameters import Parameters
from .discovery import API_VERSION
from .knobs import Knob

if TYPE_CHECKING:
    from .data import Block, Data, Observation, Stream
    from .plan.context import Context
    from .plan.estimate import Estimate, Traits
    from .run.companion import Companion


class Operator(Parameters):
    """Base class of operators.

    A pipeline calls, in this order:

    1. ``observe(data)`` once, in order: pointing operators append `Observation`s. `at_end` operators come first: what they refuse
       (an output folder) is refused at once.
    2. For each observation, ``configure(observation)`` of every operator (resolve values that others need: efficiencies,
       NET), then ``prepare(observation) -> state`` of every operator (draw turbulence, build coefficients).
    3. ``exec(block, state)`` for every block. Called from several threads at once: the state is read only, or guarded.
       Its result may depend on absolute detector and sample indices only, never on where the block begins or ends. A block may
       come again (`Block.again`) where the streams between operators do not fit in memory; one that makes no stream is spared.
    4. ``collect(data, observation, state)`` once per observation, in observation order: add partial products to ``data``.
    5. ``finalize(data)`` once at the end of the run: turn sums into products, write files.

    `at_end` operators hear of what is done by ``watch(data, done)``.

    A campaign (`core.campaign`) shares the observations out among tasks. What `observe` works out from all of them comes from
    `agree` and `lay_out`; between `collect` and `finalize`, `pack` takes a task's partial products out of ``data.products`` and
    `merge` adds them together. An operator that puts anything there in `collect` needs both to take part in a campaign; with
    `subtract` its products of a companion run can be derived from those of other runs.

    Class attributes
    ----------------
    requires, provides
        Names of data read and written; checked before anything runs. ``boresight`` comes from a pointing operator; block
        streams are ``sky, atmosphere, transmission, white, pink, signal``; products are named by their makers.
    optional
        Names it uses when an earlier or later operator provides them.
    couples
        What one output sample depends on: ``sample`` (itself alone, plus `halo` neighbours), ``detectors`` (all detectors
        at that instant), ``time`` (one detector's whole scan), ``all``. An ``all`` operator implements
        ``measure(stream, state)``, which reads the whole stream as often as it likes; its ``exec`` then works like that of
        a ``sample`` operator. One that says how often, in `sweeps`, need not have the stream in memory. With ``freeze`` and
        ``measure_frozen`` it can take part in companion runs with ``modes: full``.
    knows_means
        True where it handles the means that stand beside streams (`Block.means`, ``observation.smooth["atmosphere"]``). Without
        it `exec` sees whole streams: where one that it declares has a mean, a float64 block with the mean in it, and no entry in
        `Block.means`; the same mean is subtracted from what it leaves there (`core.run.whole`). `measure` likewise. A class that
        overrides `exec` or `measure` must say so anew.
    main_run_only
        True for operators left out of companion runs (spectra, saved time streams).
    prepares_ahead
        True where `configure` and `prepare` may be called for the next observation, from another thread, while `exec`, `measure`
        and `collect` work on the one before: they change only that observation and what a lock guards. Neither is ever called for
        two observations at once. A class that overrides one of the two must say so itself; one that overrides none need not.
    at_end
        True for operators that only act in `finalize` (plots, reports): they run once, after all companion runs.
    linear
        True where what `exec` makes of the components, or of ``signal``, is linear in them, with the same transmission of the air
        and, for ``couples = "all"``, with what `freeze` kept. A run may then be derived from others (`core.run.derived`).
    same_in_all_runs
        True where the streams that `exec` makes are the same in all runs of a pipeline: they follow from the pointing and from
        this step alone, never from other streams, flags, noise levels or the air. It adds no mean, and tells the tally in
        `prepare` and `collect` only, which ``only_tells``. Runs after the main run may then copy its streams
        (`core.run.repeated`): `exec` and `collect` are not called. A class that overrides `configure`, `prepare`, `exec` or
        `collect` must say so anew.
    only_tells
        True where `collect` puts nothing into ``data.products`` that differs from run to run: it only tells the tally.
    product_only
        True for operators that only make products in memory (map makers, spectra): a plan leaves them out of a run from a file
        where no later step reads what they provide.
    knobs
        The parameters that trade accuracy for time, each with its ladder of values (`core.knobs`).
    lighter
        What makes its `memory` less, in a few words (``choose a larger pixel``), for a run that does not fit.
    """

    zonda_api: ClassVar[int] = API_VERSION
    requires: ClassVar[frozenset[str]] = frozenset()
    provides: ClassVar[frozenset[str]] = frozenset()
    optional: ClassVar[frozenset[str]] = frozenset()
    couples: ClassVar[Literal["sample", "detectors", "time", "all"]] = "sample"
    knows_means: ClassVar[bool] = False
    main_run_only: ClassVar[bool] = False
    prepares_ahead: ClassVar[bool] = False
    at_end: ClassVar[bool] = False
    linear: ClassVar[bool] = False
    same_in_all_runs: ClassVar[bool] = False
    only_tells: ClassVar[bool] = False
    product_only: ClassVar[bool] = False
    knobs: ClassVar[tuple[Knob, ...]] = ()
    lighter: ClassVar[str] = ""

    name: str | None = None
    """Label of this step in messages, products and random streams; the class name where absent."""

    _label: str = PrivateAttr("")
    _runs: tuple[str, ...] = PrivateAttr(())

    @property
    def label(self) -> str:
        """Unique name of this step in its pipeline (the pipeline numbers namesakes: ``WhiteNoise``, ``WhiteNoise.2``)."""
        return self._label or self.name or type(self).__name__

    def needs(self) -> tuple[Companion, ...]:
        """The runs whose products this step reads (``at_end`` only); empty: whatever runs there are.

        The pipeline adds a companion run of its own where none of the user's is like one of these; `runs` then names them. The
        products of such a run are for this step alone: no other writes or draws them.
        """
        return ()

    @property
    def runs(self) -> tuple[str, ...]:
        """Names of the runs that `needs` asks for, in its order; empty text: the main run, which leaves nothing out."""
        return self._runs

    def observe(self, data: Data) -> None:
        """Append observations to ``data`` (pointing operators), or look at those that are there (map makers: a common grid)."""

    def check(self, data: Data) -> list[str]:
        """What `zonda check` finds out beyond the parameters, in well under a second: lines to print, or a `ZondaError`.

        Pointing operators append (possibly coarser) observations to ``data``, on which later steps may look.
        """
        return []

    def configure(self, observation: Observation) -> None:
        """Resolve values that other operators read, e.g. the focal plane's efficiencies."""

    def prepare(self, observation: Observation) -> Any:
        """Return what `exec` needs for this observation. It may set ``observation.smooth`` fields."""
        return None

    def halo(self, observation: Observation) -> int:
        """Samples on each side of a block that `exec` needs to be right inside it (a finite filter's half-length)."""
        return 0

    def in_time_order(self, observation: Observation, state: Any) -> bool:
        """Whether `exec` is much cheaper when it sees all detectors at one time before it goes on to the next."""
        return False

    def memory(self, observation: Observation) -> int:
        """Bytes that this step will hold for one observation, besides streams and blocks: tables, accumulators, products.

        An upper bound, asked after `observe` and before `prepare`: a run that would not fit is refused before it starts.
        """
        return 0

    def measure(self, stream: Stream, state: Any) -> None:
        """Read the whole stream (``couples = "all"`` only); leave the result in ``state``."""

    def sweeps(self, observation: Observation) -> int:
        """How often `measure` goes through its stream with `Stream.sweep`; 0: it wants ``stream.array``, in memory or on disk."""
        return 0

    @property
    def can_freeze(self) -> bool:
        """Whether it has both `freeze` and `measure_frozen`."""
        mine = type(self)
        return mine.freeze is not Operator.freeze and mine.measure_frozen is not Operator.measure_frozen

    def freeze(self, state: Any) -> Any:
        """What `measure` found in the complete data, small enough to keep, for `measure_frozen` (``couples = "all"`` only)."""
        raise NotImplementedError(f"{self.label} cannot freeze what it measures")

    def measure_frozen(self, stream: Stream, state: Any, frozen: Any) -> None:
        """As `measure`, with what `freeze` returned in place of what this stream would show.

        `exec` must then be linear in the stream, and the same as the main run's where the stream is the same. Flags are the main
        run's already.
        """
        raise NotImplementedError(f"{self.label} cannot freeze what it measures")

    def exec(self, block: Block, state: Any) -> None:
        """Act on one block."""

    def collect(self, data: Data, observation: Observation, state: Any) -> None:
        """Add this observation's partial products to ``data.products``."""

    def watch(self, data: Data, done: Literal["pointing", "scan", "run", "runs"]) -> None:
        """Called for `at_end` operators once the telescope is pointed, after every scan, after every run (``data.run``), and when
        all runs have ended: time to begin with what `finalize` will do, as far as it depends on products that are there and will
        not change; in the background, until the runs have ended."""

    def discard(self, observation: Observation, state: Any) -> None:
        """Undo what `prepare` and `exec` began (temporary files): called instead of `collect` when the run fails."""

    def finalize(self, data: Data) -> None:
        """Finish products."""

    def agree(self, data: Data, before: Mapping[str, Any] | None = None) -> Mapping[str, Any] | None:
        """What all observations of a campaign must have in common (the grid of a map), as plain values and arrays; None: nothing.

        Called after pointing instead of `observe`, for one part of the observations after the other. ``before``: what those
        before had in common. An entry ``fixed: True`` says that later parts cannot change it.
        """
        return None

    def lay_out(self, layout: Mapping[str, Any]) -> None:
        """Take what `agree` found for all observations."""

    def pack(self, data: Data, first: bool) -> Mapping[str, Any] | None:
        """Take the partial products of the run in progress out of ``data.products``: plain values and arrays; None: nothing.

        Where there is `subtract`, it makes copies: what was taken out may be put back, and go on.

        ``first``: the part begins with the very first observation; what is of that one alone need not be in the others.
        """
        return None

    def merge(self, data: Data, part: Mapping[str, Any]) -> None:
        """Add a part that `pack` made to ``data.products``. Parts come in the order of their observations."""

    def subtract(self, whole: Mapping[str, Any], parts: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
        """What `pack` would give of a run of all components but those of ``parts``: ``whole`` (the main run) minus these, all as
        `pack` made them; None where it cannot be told, and must be simulated (`core.run.derived`)."""
        return None

    @property
    def can_subtract(self) -> bool:
        """Whether its products of a run may be derived from those of others: it has `subtract`, or makes none in `collect`."""
        mine = type(self)
        return mine.subtract is not Operator.subtract or mine.collect is Operator.collect or self.only_tells

    def declares(self, flag: str, *methods: str) -> bool:
        """Whether ``flag`` is true, and no class derived from the one that says so overrides one of the ``methods``."""
        order = type(self).__mro__
        says = next(n for n, c in enumerate(order) if flag in vars(c))
        does = next((n for n, c in enumerate(order) if any(m in vars(c) for m in methods)), len(order))
        return bool(getattr(self, flag)) and says <= does

    def keep_out(self, observation: Observation, state: Any) -> Any:
        """What the main run left out sample by sample because of their values, for `leave_out`; None: nothing."""
        return None

    def leave_out(self, state: Any, kept_out: Any) -> None:
        """Leave out of a run with ``modes: full`` what `keep_out` found in the main run. Called before `exec`."""

    def traits(self, observation: Observation) -> Traits:
        """What other operators' bounds need to know of this one (noise, pixels, filters); see `core.plan`.

        Called after `configure`, before anything is prepared; ``observation`` has its pointing.
        """
        from .plan.estimate import Traits

        return Traits()

    def estimate(self, context: Context) -> Estimate:
        """Upper bounds on what this operator's effects contribute, coarser forms of them, and what it costs; see `core.plan`.

        Without it the planner leaves the operator as it is and says that its cost is not counted.
        """
        from .plan.estimate import Estimate

        return Estimate()
