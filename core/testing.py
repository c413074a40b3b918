"""The conformance kit: `check_operator` finds out whether an operator keeps the contract of
`core.operator`.

A plugin's test is one line::

    zonda.testing.check_operator(MyOperator(width="3 s"))

The operator is run over a made-up scan with made-up streams: whatever it requires or can use is
there.
"""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from .configuration.describe import described, source_is_known
from .configuration.time import Instant
from .data import STREAMS, Block, Data, Observation, Stream, kept
from .instrument import Band, Instrument, Telescope
from .mapmaker import MapMaker, filters
from .numerics.chunks import TILE_SAMPLES
from .numerics.quaternions import from_angles
from .numerics.random import normals
from .numerics.smooth import SmoothField
from .operator import Operator
from .output import Output
from .pipeline import Part, Pipeline
from .plan.planning import planning_of
from .product import Product
from .scene import Scene
from .signal import is_stream
from .site import Site
from .types import Floats

N_DETECTORS = 37
N_SAMPLES = 3 * TILE_SAMPLES + 321
RATE = 50.0


class Points(Operator):
    """Points at the made-up scan."""

    provides = frozenset({"boresight"})

    def observe(self, data: Data) -> None:
        data.observations.append(made_up_scan())


class Given(Operator):
    """Provides every stream: a slow wave, common to all detectors, with noise of each detector's
    own.

    ``mean`` names one that has a mean of some 30 K, ``beside`` it or in it.
    """

    requires = frozenset({"boresight"})
    provides = frozenset(STREAMS)
    knows_means = True
    mean: str = ""
    beside: bool = True

    def prepare(self, observation: Observation) -> SmoothField:
        """The mean: of each detector its own, falling slowly."""
        field = SmoothField.from_values(
            *slow(observation.n_samples), MEAN_STEP, observation.n_samples
        )
        if self.mean == "atmosphere" and self.beside:
            observation.smooth["atmosphere"] = field
        return field

    def exec(self, block: Block, state: Any) -> None:
        start = block.samples.start
        stop = block.samples.stop
        wave = np.sin(np.arange(start, stop) / RATE / 3.0)
        for number, name in enumerate(STREAMS):
            stream = block.new(name)
            for d in range(block.detectors.start, block.detectors.stop):
                noise = normals(block.observation.key("given", name, d), start, stop)
                stream[d - block.detectors.start] = 1e-3 * (3 * wave * (number + 1) + noise)
        if self.mean == "signal" and self.beside:
            block.means["signal"] = state
        elif self.mean and not self.beside:
            block.detdata[self.mean] += state.evaluate(block.detectors, block.samples)


MEAN_STEP = 256
"""Samples between the coefficients of the made-up mean."""


def slow(n_samples: int) -> tuple[Floats, Floats]:
    """Weights (detector, node) and node values of a mean: 30 K and more, falling by 0.3 K in a
    straight line.
    """
    weights = np.stack(
        [30 + 0.1 * np.arange(N_DETECTORS), np.linspace(0.5, 1, N_DETECTORS)],
        axis=1,
    )
    n = -(-n_samples // MEAN_STEP) + 3
    return weights, np.stack([np.ones(n + 24), -0.3 * np.arange(n + 24) / n])


def made_up_scene() -> Scene:
    """A camera of 37 detectors on a hill."""
    camera = Instrument(
        name="conformance",
        telescope=Telescope(name="dish", diameter="10 m"),
        band=Band(name="band", low="140 GHz", high="160 GHz"),
        detectors=N_DETECTORS,
        field_of_view="10 arcmin",
        main_beam_efficiency=0.5,
        illumination_efficiency=0.9,
        net="1 mK s(1/2)",
        knee="0.2 Hz",
        pink_minimum_frequency="10 mHz",
        sample_rate=f"{RATE} Hz",
    )
    site = Site(
        name="somewhere",
        latitude="38.4 deg",
        longitude="-79.8 deg",
        altitude="800 m",
        climatology="green_bank",
    )
    return Scene(
        site=site,
        instrument=camera,
        time=Instant.parse("2024-11-25T07:00"),
        target="05h +20d",
        seed=11,
    )


def made_up_scan() -> Observation:
    """A scan in circles of 5 arcmin around RA 75 deg, Dec 20 deg, at 60 deg of elevation."""
    scene = made_up_scene()
    t = np.arange(N_SAMPLES) / RATE
    ra = np.radians(75.0)
    dec = np.radians(20.0)
    reach = np.radians(5 / 60)
    x = reach * np.cos(t / 3)
    y = reach * np.sin(t / 3)
    return Observation(
        "scan-000",
        0,
        scene.site,
        scene.instrument,
        scene.instrument.focalplane(),
        scene.time,
        t,
        RATE,
        from_angles(-1.0 - x / np.cos(1.05), 1.05 + y),
        from_angles(ra + x / np.cos(dec), dec + y),
        (ra, dec),
        scene.seed,
    )


def given_signal(observation: Observation, factor: float) -> NDArray[np.float32]:
    """A whole scan of the given signal, times a factor."""
    block = Block(observation, slice(0, N_DETECTORS), slice(0, N_SAMPLES))
    given = Given()
    given.exec(block, given.prepare(observation))
    return np.asarray(block.detdata["signal"] * np.float32(factor), np.float32)


def check_operator(
    operator: Operator,
    *,
    expected_failures: Mapping[str, str] | None = None,
) -> None:
    """Run every check that applies; raise AssertionError with all that fail.

    Parameters
    ----------
    operator
        An instance, with parameters that suit a scan of 37 detectors and 129 s at 50 Hz.
    expected_failures
        Names of checks that are known to fail, each with the reason. One that passes all the same
        is reported too.
    """
    expected = dict(expected_failures or {})
    wrong = []
    for check in CHECKS:
        try:
            check(operator)
        except AssertionError as err:
            if check.__name__ not in expected:
                wrong.append(f"{check.__name__}: {err}")
        else:
            if check.__name__ in expected:
                wrong.append(
                    f"{check.__name__} passes, though it was expected to fail:"
                    f" {expected[check.__name__]}"
                )
    assert not wrong, f"{type(operator).__name__} does not keep the contract:\n" + "\n".join(wrong)


def check_parameters_are_documented(operator: Operator) -> None:
    """The class and every field have a docstring: messages, schema and documentation are made of
    them.

    Those of fields are read from the source. A class that was typed at the prompt of `python` has
    none: its fields pass.
    """
    assert (type(operator).__doc__ or "").strip(), "the class has no docstring"
    if source_is_known(type(operator)):
        for name, field in described(type(operator)).items():
            assert field.description, f"parameter {name} has no docstring"


def check_parameters_survive_text(operator: Operator) -> None:
    """Check that a resolved YAML file reads back to the same operator."""
    text = operator.model_dump(mode="json", exclude_unset=True)
    again = type(operator).model_validate(text)
    assert again.model_dump() == operator.model_dump(), f"{text} reads back as {again!r}"


def check_knobs(operator: Operator) -> None:
    """Check that each knob names a parameter and has at least two values that it accepts."""
    for knob in planning_of(operator).knobs:
        assert knob.parameter in type(operator).model_fields, (
            f"knob {knob.parameter} is not a parameter"
        )
        assert len(knob.ladder) >= 2, f"knob {knob.parameter} needs a ladder of at least two values"
        try:
            values = knob.values(type(operator))
        except ValidationError as err:
            raise AssertionError(f"knob {knob.parameter}: {err}") from None
        assert len(set(map(repr, values))) == len(values), (
            f"knob {knob.parameter} has two equal rungs"
        )


def check_declared_streams(operator: Operator) -> None:
    """`exec` reads only what is declared as required or optional, makes only what is provided, and
    changes nothing else.
    """
    if isinstance(operator, Output) or "boresight" in operator.provides:
        return
    before, watched = _one_block(operator)
    allowed = operator.requires | operator.optional | operator.provides
    made = set(watched) - set(before)
    assert made <= operator.provides, (
        f"makes {sorted(made - operator.provides)}, which it does not provide"
    )
    assert not (undeclared := watched.read - allowed), (
        f"reads {sorted(undeclared)}, which it does not declare"
    )
    for name in set(before) - operator.provides:
        assert np.array_equal(before[name], dict.__getitem__(watched, name), equal_nan=True), (
            f"changes {name}, which it does not provide"
        )


def check_components(operator: Operator) -> None:
    """A stream of its own becomes part of the signal: it is a `Component`.

    A stream that only another step reads is an expected failure.
    """
    if isinstance(operator, Output) or "boresight" in operator.provides:
        return
    before, watched = _one_block(operator)
    plain = sorted(set(watched) - set(before) - _streams_of(operator))
    assert not plain, (
        f"makes {plain}, which is not part of the signal: provide zonda.Component({plain[0]!r}, 'at"
        " the detector')"
    )


def _one_block(operator: Operator) -> tuple[dict[str, Any], _Watched]:
    """The given streams, and the same after a step acted on them as one block."""
    observation = made_up_scan()
    steps = [Given(), operator]
    states = []
    with tempfile.TemporaryDirectory() as folder:
        observation.output = Path(folder)
        data = Data(made_up_scene(), [observation], output=observation.output)
        operator.observe(data)
        for step in steps:
            step.configure(observation)
        states = [step.prepare(observation) for step in steps]
        block = Block(observation, slice(0, N_DETECTORS), slice(0, N_SAMPLES))
        steps[0].exec(block, states[0])
        before = {name: stream.copy() for name, stream in block.detdata.items()}
        if operator.couples == "all":
            (name,) = operator.requires - {"boresight"}
            states[1] = operator.measure(
                _stream(observation, block.detdata[name], states[1], name=name)
            )
        watched = _Watched(block.detdata)
        block.detdata = watched
        operator.exec(block, states[1])
        operator.discard(observation, states[1])
    return before, watched


def _streams_of(operator: Operator) -> set[str]:
    """The streams that a step provides, products apart."""
    return {name for name in operator.provides if is_stream(name)}


def check_same_bits(operator: Operator) -> None:
    """The same seed gives the same bits for every block size and thread count; two seeds of a
    random operator do not.
    """
    one = _products(operator, threads=1, memory=1 << 30)
    for threads, memory in ((1, _small(operator)), (3, 3 * _small(operator)), (2, 1 << 30)):
        other = _products(operator, threads=threads, memory=memory)
        assert _same(one, other), f"other bits with {threads} threads and {memory / 1e6:.1f} MB"


def check_linear(operator: Operator) -> None:
    """A filter that says that it is `linear` makes zero of zero, and of a sum the sum of what it
    makes of the parts, with what `Operator.measure` found in the sum (``modes: full``)."""
    if not (operator.linear and filters(operator)):
        return
    observation = made_up_scan()
    operator.configure(observation)
    state = operator.prepare(observation)
    parts = [given_signal(observation, factor) for factor in (1.0, -0.3)]
    parts[1][:, ::7] += np.float32(2e-3)
    whole = parts[0] + parts[1]
    nothing = np.zeros_like(parts[0])
    model = (
        operator.measure(_stream(observation, whole, state)) if operator.couples == "all" else None
    )

    def act(signal: NDArray[np.float32], own: Any = None) -> Floats:
        block = Block(
            observation,
            slice(0, N_DETECTORS),
            slice(0, N_SAMPLES),
            {"signal": signal.copy()},
        )
        if operator.couples == "all" and own is None:
            own = operator.measure(_stream(observation, signal, state, "signal/part"), model)
        operator.exec(block, state if own is None else own)
        return block.detdata["signal"].astype(np.float64)

    made = act(whole, model)
    scale = 1e-5 * float(np.std(made)) + 1e-6 * float(np.std(whole))  # float32
    assert np.abs(act(nothing)).max() <= scale, (
        "says that it is linear, but makes something of nothing"
    )
    assert np.allclose(act(parts[0]) + act(parts[1]), made, rtol=0, atol=4 * scale), (
        "says that it is linear, but what it makes of two parts does not add up to what it makes of"
        " their sum"
    )


def check_means(operator: Operator) -> None:
    """Check that the result is the same whether the mean, tens of kelvin, stands beside the stream
    or in it (`Operator.knows_means`).

    Both in float64, where 30 K are rounded to 4e-15 K; what a run in float32 would round, 2^-24 of
    the largest value, is allowed.
    """
    changed = operator.provides & frozenset(STREAMS)
    for name in sorted({"signal"} | ({"atmosphere"} if changed else set())):
        if isinstance(operator, Output) or name not in operator.requires | operator.optional:
            continue
        beside, inside = (
            _products(
                operator,
                threads=1,
                memory=1 << 30,
                given=Given(mean=name, beside=b),
                precision="float64",
            )
            for b in (True, False)
        )
        assert (wrong := _unlike(beside, inside)) is None, (
            f"{wrong} is another where the mean of {name} stands beside the stream (block.means,"
            " observation.smooth), not in it: leave knows_means out, or add that mean"
        )


def check_products(operator: Operator) -> None:
    """Partial products are restored from their `arrays`; those of a linear map maker can be
    subtracted.
    """
    if isinstance(operator, Output) or "boresight" in operator.provides:
        return
    with tempfile.TemporaryDirectory() as folder:
        pipeline = Pipeline([Points(), Given(), operator])
        layouts = pipeline.point(made_up_scene(), {}, Path(folder)).layouts
        data = pipeline.run_part(
            made_up_scene(),
            Part(layouts=layouts),
            threads=1,
            memory=1 << 30,
            output=folder,
        )
    for product in data.partial.values():
        kind = type(product)
        arrays = _comparable(product.arrays())
        assert _same(_comparable(kind.of(product.arrays()).arrays()), arrays), (
            f"{kind.__name__}.of does not restore its arrays()"
        )
        assert (
            not (isinstance(operator, MapMaker) and operator.linear)
            or kind.subtract is not Product.subtract
        ), f"a linear map maker, but {kind.__name__} has no subtract()"


def check_finite(operator: Operator) -> None:
    """Finite streams stay finite."""
    for name, stream in _products(operator, threads=1, memory=1 << 30).items():
        if isinstance(stream, np.ndarray):
            assert np.isfinite(stream).all(), f"{name} is not finite"


CHECKS: tuple[Callable[[Operator], None], ...] = (
    check_parameters_are_documented,
    check_parameters_survive_text,
    check_knobs,
    check_declared_streams,
    check_components,
    check_same_bits,
    check_linear,
    check_means,
    check_products,
    check_finite,
)


# ---- runs


def _products(
    operator: Operator,
    threads: int,
    memory: int,
    given: Operator | None = None,
    precision: Literal["float32", "float64"] = "float32",
) -> dict[str, Any]:
    """Everything that a run of the operator over given streams makes: streams, their means
    included, and products.
    """
    if isinstance(operator, Output):
        return {}
    pointing = "boresight" in operator.provides
    steps = [operator] if pointing else [Points(), given or Given(), operator]
    keep = sorted(_streams_of(operator))
    with tempfile.TemporaryDirectory() as folder:
        data = Pipeline(steps, precision=precision).run(
            made_up_scene(),
            threads=threads,
            memory=memory,
            keep=keep,
            output=folder,
        )
    found: dict[str, Any] = {}
    for observation in data.observations:
        found |= {f"{observation.name} {n}": kept(observation, n) for n in observation.detdata}
        if pointing:
            found |= {
                f"{observation.name} {name}": getattr(observation, name)
                for name in ("boresight_azel", "boresight_radec")
            }
    return found | {name: _comparable(product) for name, product in data.products.items()}


def _stream(
    observation: Observation,
    array: Any,
    state: Any,
    signal: str = "signal",
    name: str = "signal",
) -> Stream:
    """A whole stream for a step that measures."""
    return Stream(name, observation, array, {}, 1, signal=signal, state=state)


def _small(operator: Operator) -> int:
    """A budget in which blocks are small: whole scans of 16 detectors where the operator needs
    them, else short pieces.
    """
    least = {"time": 16 * N_SAMPLES, "detectors": N_DETECTORS * TILE_SAMPLES}.get(
        operator.couples,
        16 * TILE_SAMPLES,
    )
    return 2 * 4 * least * (len(STREAMS) + 6)


def _comparable(product: Any) -> Any:
    """Arrays inside a product, by name; texts are left out (they hold paths and times), and fields
    with ``compare=False``.
    """
    if dataclasses.is_dataclass(product):
        names = [f.name for f in dataclasses.fields(product) if f.compare]
        return {name: _comparable(getattr(product, name)) for name in names}
    if isinstance(product, Mapping):
        return {k: _comparable(v) for k, v in product.items()}
    return product if isinstance(product, np.ndarray | int | float) else None


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(_same(a[k], b[k]) for k in a)
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    return bool(a == b)


def _unlike(a: Any, b: Any, name: str = "") -> str | None:
    """The name of the first array or number of ``a`` that is not that of ``b`` within 2^-24 of the
    largest value; None: alike.
    """
    if isinstance(b, Mapping):
        if not isinstance(a, Mapping) or a.keys() != b.keys():
            return name or "what is made"
        return next(
            (w for k in b if (w := _unlike(a[k], b[k], f"{name}.{k}" if name else str(k)))),
            None,
        )
    if b is None or a is None:
        return None if a is b else name
    a = np.asarray(a, np.float64)
    b = np.asarray(b, np.float64)
    if a.shape != b.shape or (np.isfinite(a) != np.isfinite(b)).any():
        return name
    good = np.isfinite(b)
    return (
        None
        if (np.abs(a[good] - b[good]) <= 2.0**-24 * np.abs(b[good]).max(initial=0.0)).all()
        else name
    )


class _Watched(dict[str, Any]):
    """Streams of a block, noting what is read."""

    def __init__(self, streams: Mapping[str, Any]) -> None:
        super().__init__(streams)
        self.read: set[str] = set()

    def __getitem__(self, name: str) -> Any:
        self.read.add(name)
        return super().__getitem__(name)

    def get(self, name: str, default: Any = None) -> Any:
        if name in self:
            self.read.add(name)
        return super().get(name, default)

    def items(self) -> Any:
        self.read.update(self)
        return super().items()

    def values(self) -> Any:
        self.read.update(self)
        return super().values()

    def __iter__(self) -> Iterator[str]:
        return super().__iter__()
