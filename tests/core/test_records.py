"""Every case beside the standard library's decorator."""

from __future__ import annotations

import copy
import dataclasses
import pickle
from dataclasses import FrozenInstanceError, field
from functools import cached_property
from typing import Any, ClassVar

import pytest

from zonda.core import records

BOTH = [dataclasses.dataclass, records.dataclass]


def family(dataclass: Any) -> dict[str, Any]:
    """Classes made with a decorator, by name."""

    @dataclass(frozen=True)
    class Frozen:
        a: int
        b: list[int] = field(default_factory=list, compare=False)
        c: float = field(default=2.0, repr=False)
        LIMIT: ClassVar[int] = 3

        @cached_property
        def double(self) -> int:
            return 2 * self.a

    @dataclass
    class Free:
        """With a docstring."""

        a: int
        b: str = "x"

        def __post_init__(self) -> None:
            self.b += "!"

    @dataclass(frozen=True)
    class Own:
        a: int

        def __eq__(self, other: object) -> bool:
            return True

        def __repr__(self) -> str:
            return "own"

    @dataclass(frozen=True)
    class Hashed:
        a: int

        def __hash__(self) -> int:
            return 7

    @dataclass(frozen=True, repr=False)
    class Child(Frozen):
        d: int = 5

    @dataclass(eq=False)
    class Alone:
        a: int = 1

    @dataclass(frozen=True, order=True)
    class Ordered:
        a: int = 1

    class Plain(Frozen):
        pass

    return {k: v for k, v in locals().items() if isinstance(v, type)}


@pytest.fixture(params=BOTH, ids=["standard", "records"])
def made(request: pytest.FixtureRequest) -> dict[str, Any]:
    return family(request.param)


def test_values(made: dict[str, Any]) -> None:
    frozen, free = made["Frozen"], made["Free"]
    assert (frozen(1).a, frozen(1).b, frozen(a=1, b=[2]).b, frozen(1).c, frozen(3).double) == (1, [], [2], 2.0, 6)
    assert free(1).b == "x!"
    assert [f.name for f in dataclasses.fields(made["Child"])] == ["a", "b", "c", "d"]
    assert dataclasses.asdict(free(1)) == {"a": 1, "b": "x!"}
    assert dataclasses.replace(frozen(1), a=2) == frozen(2)
    assert made["Child"](1, d=4).d == 4
    with pytest.raises(TypeError, match="missing 1 required positional argument: 'a'"):
        frozen()


def test_comparison_and_hash(made: dict[str, Any]) -> None:
    frozen, free = made["Frozen"], made["Free"]
    assert frozen(1, [2]) == frozen(1, [3])
    assert frozen(1) != frozen(2)
    assert frozen(1) != made["Child"](1)
    assert hash(frozen(1)) == hash(frozen(1, [3]))
    assert len({frozen(1), frozen(1), frozen(2)}) == 2
    assert free(1) == free(1)
    with pytest.raises(TypeError, match="unhashable"):
        hash(free(1))
    assert made["Own"](1) == 5
    assert hash(made["Own"](1)) == hash((1,))
    assert hash(made["Hashed"](1)) == 7
    assert made["Alone"]() != made["Alone"]()
    assert hash(made["Alone"]()) != 0
    assert made["Ordered"](1) < made["Ordered"](2)


def test_representation(made: dict[str, Any]) -> None:
    assert repr(made["Frozen"](1)) == "family.<locals>.Frozen(a=1, b=[])"
    assert repr(made["Own"](1)) == "own"
    around = made["Free"](1)
    around.a = around
    assert repr(around) == "family.<locals>.Free(a=..., b='x!')"
    assert made["Free"].__doc__ == "With a docstring."


@pytest.mark.parametrize("kind", ["Frozen", "Child", "Own", "Ordered"])
def test_frozen(made: dict[str, Any], kind: str) -> None:
    one = made[kind](1)
    for name in ("a", "new"):
        with pytest.raises(FrozenInstanceError, match=f"cannot assign to field '{name}'"):
            setattr(one, name, 2)
        with pytest.raises(FrozenInstanceError, match=f"cannot delete field '{name}'"):
            delattr(one, name)
    assert one.a == 1
    assert copy.copy(one) == copy.deepcopy(one) == one


def test_a_plain_subclass_may_have_more(made: dict[str, Any]) -> None:
    one = made["Plain"](1)
    one.more = 2
    assert one.more == 2
    del one.more
    with pytest.raises(FrozenInstanceError):
        one.a = 2


def test_frozen_and_free_do_not_mix(made: dict[str, Any]) -> None:
    frozen = made["Frozen"]
    dataclass: Any
    for dataclass in BOTH:
        with pytest.raises(TypeError, match="cannot inherit non-frozen dataclass from a frozen one"):
            dataclass(type("Other", (frozen,), {}))
        child: Any = type("Other", (frozen,), {"__annotations__": {"e": int}, "e": 1})
        assert dataclass(frozen=True)(child)(1).e == 1


@records.dataclass(frozen=True)
class Kept:
    a: int


def test_pickled() -> None:
    assert pickle.loads(pickle.dumps(Kept(3))) == Kept(3)
