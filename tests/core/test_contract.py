"""A class that breaks the contract is refused when it is made, or when the pipeline is built."""

from __future__ import annotations

from typing import Any

import pytest

import zonda
from zonda.core.errors import PipelineError, ZondaError
from zonda.plugins.checks.scenes import camera, scene

DUST = zonda.Component("dust", "calibrated")
STEPS = (zonda.PointingDaisy(scan_duration="4 s"), zonda.WhiteNoise(), zonda.Efficiency())


def made(**attributes: Any) -> Any:
    """An operator with these attributes; None: without it."""
    own = {
        "requires": frozenset({"signal"}),
        "provides": frozenset({"signal"}),
        "exec": lambda self, block, state: None,
        "__doc__": "A step.",
        "__module__": __name__,
    } | attributes
    return type(zonda.Operator)(
        "Mine", (zonda.Operator,), {k: v for k, v in own.items() if v is not None}
    )


def method(*arguments: str) -> Any:
    return eval(f"lambda {', '.join(('self', *arguments))}: None")


def test_a_method_that_takes_no_self_is_a_method() -> None:
    def emptied(block: Any, state: Any) -> None:
        block.detdata["signal"][...] = 0

    data = zonda.Pipeline([*STEPS, made(exec=staticmethod(emptied))(), zonda.BinMap()]).run(
        scene(camera(4))
    )
    signal = data["map"].signal
    assert (signal[data["map"].hits > 0] == 0).all()


@pytest.mark.parametrize(
    ("attributes", "said"),
    [
        (
            {"exec": None, "process": method("block")},
            "overrides none of observe.*is process what the step does",
        ),
        ({"exec": None}, "overrides none of observe"),
        (
            {"exec": None, "prepare": method("observation"), "apply": method("x")},
            "provides signal, but.*is apply what",
        ),
        (
            {"exec": None, "collect": method("data", "observation", "state")},
            "provides signal, but overrides no exec",
        ),
        (
            {"exec": None, "provides": frozenset({DUST}), "check": method("data")},
            "provides dust",
        ),
        ({"couples": "all"}, "couples all samples, but overrides no measure"),
    ],
)
def test_a_broken_class_is_refused(attributes: Any, said: str) -> None:
    with pytest.raises(PipelineError, match=f"(?s)step 4, Mine: .*{said}"):
        zonda.Pipeline([*STEPS, made(**attributes)(), zonda.BinMap()])


@pytest.mark.parametrize(
    ("attributes", "said"),
    [
        ({"name": "mine"}, r"Mine: name = 'mine': the label.*Mine\(name='mine'\)"),
        ({"rate": 3.0}, r"Mine: rate = 3.0 has no type.*rate: float = 3.0.*ClassVar\[float\]"),
        ({"rate": zonda.quantity("3 Hz")}, r"rate = quantity\('3 Hz'\) has no type"),
        ({"__annotations__": {"rate": "object()"}}, "its parameters cannot be used"),
        ({"requires": frozenset(), "__annotations__": {"requires": frozenset}}, "makes it a param"),
        ({"exec": 3}, "exec is a method"),
        (
            {"requires": ("signal",)},
            r'requires is a frozenset of names, not \(.*write requires = frozenset\(\{"signal"\}\)',
        ),
        ({"requires": ["signal", "white"]}, r'write requires = frozenset\(\{"signal", "white"\}\)'),
        ({"requires": "signal"}, "requires is a frozenset of names, not 'signal'"),
        ({"requires": frozenset({1})}, "requires is a frozenset of names"),
        ({"provides": ("signal",)}, "provides is a frozenset"),
        ({"optional": ("sky",)}, "optional is a frozenset"),
        ({"optional": {"sky": 1}}, "optional is a frozenset"),
        ({"couples": "detector"}, "couples is one of.*detectors"),
        ({"linear": "yes"}, "linear is True or False"),
        ({"knows_means": 1}, "knows_means is True or False"),
        (
            {"exec": method("block")},
            r"exec does not take block, state.*def exec\(self, block, state\)",
        ),
        ({"prepare": method()}, "prepare does not take observation"),
        ({"halo": method()}, "halo does not take observation"),
        ({"collect": method("data")}, "collect does not take data, observation, state"),
        ({"halo": 5}, "halo is a method"),
    ],
)
def test_a_class_that_cannot_be_made(attributes: Any, said: str) -> None:
    with pytest.raises(ZondaError, match=f"(?s){said}"):
        made(**attributes)


@pytest.mark.parametrize(
    "attributes",
    [
        {"provides": {"signal"}},
        {
            "provides": frozenset(),
            "requires": frozenset(),
            "exec": None,
            "configure": method("observation"),
        },
        {"provides": frozenset({"figure"}), "exec": None, "finalize": method("data")},
        {
            "provides": frozenset({"found"}),
            "exec": None,
            "couples": "all",
            "measure": method("stream", "model=None"),
        },
        {"exec": lambda self, *given: None},
    ],
)
def test_what_is_enough(attributes: Any) -> None:
    zonda.Pipeline([*STEPS, made(**attributes)(), zonda.BinMap()])


def test_a_class_inherits_what_it_does() -> None:
    class Later(zonda.HighpassFilter):
        """A filter by another name."""

    zonda.Pipeline([*STEPS, Later(frequency="1 Hz"), zonda.BinMap()])


def test_what_exec_returns_is_not_lost_without_a_word() -> None:
    step = made(exec=lambda self, block, state: 2 * block.detdata["signal"])()
    with pytest.raises(
        PipelineError, match=r"(?s)Mine: exec returned ndarray, which nobody takes.*\[\.\.\.\]"
    ):
        zonda.Pipeline([*STEPS, step]).run(scene(camera(3)), threads=1)
