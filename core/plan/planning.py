"""Planning classes, one for each operator: error bounds, coarser forms, memory, and knobs
(parameters that trade accuracy for time).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Generic, TypeVar, cast

from pydantic import BaseModel, TypeAdapter

from ..data import Data, Observation
from ..function_operator import FunctionOperator
from ..mapmaker import filters
from ..operator import Operator
from ..registry import RegistryError, planning
from .bounds import Context, Cost, Estimate, Traits


@dataclass(frozen=True)
class Knob:
    """One parameter that trades accuracy for time; `Planning.knobs` lists them, `zonda accuracy`
    turns them, `zonda plan` chooses among the rungs that `Planning.estimate` bounds.

    Attributes
    ----------
    parameter
        Name of the field.
    ladder
        Its values as they stand in YAML, from coarse and cheap to fine and dear; at least two. The
        last one is what the others are judged by.
    approximates
        What a coarser value does to the result: half a line, for tables.
    redraws
        True where another value draws other random numbers. Two runs then differ by more than the
        approximation, so that only means over seeds compare, and the knob is left out of joint
        searches.
    """

    parameter: str
    ladder: tuple[str | int | float, ...]
    approximates: str
    redraws: bool = False

    def values(self, model: type[BaseModel]) -> list[Any]:
        """The ladder as values of the model's field. Raises pydantic's ValidationError for one that
        the field refuses.
        """
        field = model.model_fields[self.parameter]
        adapter: TypeAdapter[Any] = TypeAdapter(
            cast(Any, Annotated[field.annotation, self.parameter, *field.metadata])
        )
        return [adapter.validate_python(value) for value in self.ladder]


PRECISION = Knob("precision", ("float32", "float64"), "rounding of the time streams")
"""The one knob that belongs to a pipeline, not to an operator."""


O = TypeVar("O", bound=Operator)  # noqa: E741


class Planning(Generic[O]):
    """The planning of an operator. Its name in the registry (``zonda.planning``) is that of the
    operator's class.

    An operator without one is never coarsened.

    Attributes
    ----------
    of
        The class of the operator, or ``module:class`` where it need not be imported for the
        planning of others; classes derived from it inherit its planning.
    cost
        Not used, since times are measured; planning classes of earlier versions state it.
    knobs
        The parameters that trade accuracy for time, each with its ladder of values (`Knob`).
    reads_streams
        It makes a product of the time streams themselves (spectra, files), in which errors of a
        sample count.
    holds, per_detector, per_sample
        Bytes of its `memory`: for every observation, and for each detector and each sample of it.
    per_pixel
        Bytes that an output holds besides while it acts, for each pixel of the largest map.
    smaller
        Advice that lessens its `memory`, in a few words (``choose a larger pixel``), for a run that
        does not fit.
    """

    of: ClassVar[type[Operator] | str]
    cost: ClassVar[Cost | None] = None
    knobs: ClassVar[tuple[Knob, ...]] = ()
    reads_streams: ClassVar[bool] = False
    holds: ClassVar[int] = 0
    per_detector: ClassVar[int] = 0
    per_sample: ClassVar[int] = 0
    per_pixel: ClassVar[int] = 0
    smaller: ClassVar[str] = ""

    def __init__(self, operator: O) -> None:
        self.operator = operator
        self.whole: Data | None = None

    def traits(self, observation: Observation) -> Traits:
        """Properties that other operators' bounds depend on (noise, pixels, filters).

        Called after `Operator.configure`, before anything is prepared; ``observation`` has its
        pointing. A filter of which nothing is stated, and that couples all samples or is not
        linear, may find what it removes in the data.
        """
        own = self.operator
        return Traits(turns=filters(own) and (own.couples == "all" or not own.linear))

    def estimate(self, context: Context) -> Estimate:
        """Upper bounds on what its effects contribute, and coarser forms of them."""
        return Estimate()

    def memory(self, observation: Observation) -> int:
        """Bytes that the step will hold for one observation, besides streams and blocks: tables,
        accumulators.

        An upper bound, asked after `Operator.observe` and before `Operator.prepare`: a run that
        would not fit is refused before it starts.
        """
        each = self.per_detector * observation.n_detectors + self.per_sample * observation.n_samples
        return self.holds + each

    def per_thread(self, observation: Observation, spilled: int) -> int:
        """Bytes that each thread holds besides; ``spilled``: bytes of a sample of a stream on disk,
        0 where there is none.
        """
        return 0

    def held(self, observation: Observation, threads: int, spilled: int = 0) -> int:
        """Bytes that the step holds for a scan, besides streams and blocks, with all threads."""
        return self.memory(observation) + threads * self.per_thread(observation, spilled)

    def finished(self, observation: Observation) -> tuple[int, int]:
        """Bytes held while the product is finished, and bytes of the finished product; `memory` is
        held until then.
        """
        return (self.memory(observation),) * 2

    def states(self, observations: Sequence[Observation]) -> list[str]:
        """Statements about the work on all scans, for `zonda plan`."""
        return []

    def finishing(
        self,
        seconds: float,
        part: Data,
        observations: Sequence[Observation],
    ) -> tuple[float, str]:
        """CPU seconds of `Operator.finalize` in the run, of so many ``seconds`` in a run over a
        ``part`` of it; and what they are estimated from, in words, where they grow with the
        samples.
        """
        return seconds, ""

    @property
    def brief(self) -> O:
        """The operator in slices that are timed: one that repeats its work may do so less often."""
        return self.operator

    def counted(self, observations: Sequence[Observation]) -> O | None:
        """The operator over the whole first scan with few detectors, whose data `whole` are known
        to `finishing`: for work whose amount a shorter slice does not tell. None: not wanted.
        """
        return None

    @property
    def shortest(self) -> float:
        """Shortest scan that the step takes, s."""
        return 0.0

    @property
    def pixels(self) -> int:
        """Pixels of the map that it makes."""
        return 0

    def sweeps(self, observation: Observation) -> int:
        """Number of times that `Operator.measure` goes through its stream with `Stream.sweep`; 0:
        it wants ``stream.array``.
        """
        return 0

    def in_time_order(self, observation: Observation) -> bool:
        """True if `Operator.exec` is much cheaper when it sees all detectors at one time before it
        goes on to the next.
        """
        return False


def samples_in(observations: Iterable[Observation]) -> int:
    """Detectors x samples of all of them."""
    return sum(o.n_detectors * o.n_samples for o in observations)


def planning_of(operator: Operator) -> Planning[Any]:
    """The planning of an operator; of one that has none, `Planning` itself."""
    return planning_class(type(operator))(operator)


def planning_class(operator: type[Operator]) -> type[Planning[Any]]:
    """The class that plans the operators of a class; `Planning` itself where there is none."""
    for cls in operator.__mro__:
        if cls is Operator:
            break
        if cls.__name__ in planning:
            try:
                found: type[Planning[Any]] = planning.get(cls.__name__)
            except RegistryError:
                continue
            if found.of in (cls, f"{cls.__module__}:{cls.__qualname__}"):
                return found
    return Planning


class FunctionPlanning(Planning[FunctionOperator]):
    """Planning of a function, whose effect is not known."""

    of = FunctionOperator
    smaller = "make the scan shorter, or couple less: couples='all' holds a whole scan in float64"

    def memory(self, observation: Observation) -> int:
        """With ``couples="all"`` the scan in float64, what the function makes of it, and that of
        each signal.
        """
        if self.operator.couples != "all":
            return 0
        return 8 * (2 + len(observation.signals)) * observation.n_detectors * observation.n_samples
