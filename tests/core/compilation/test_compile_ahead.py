from __future__ import annotations

import gc
from importlib import import_module
from threading import Event

import pytest
from numba import types
from numba.core.dispatcher import Dispatcher

import zonda.core.numerics.random  # noqa: F401  it says where kernels are kept, before any is defined
from zonda.core.compilation import compile_ahead, kernel_cache
from zonda.core.compilation.compile_ahead import (
    Helper,
    compile_listed,
    for_child,
    listed,
    text_of,
    type_of,
)

CHEAP = ("0.1", "zonda.operators.maps.sums", "_scales", "f8", "f8", "b1")


@pytest.mark.parametrize(
    "kind",
    [
        types.float64,
        types.int32,
        types.uint64,
        types.boolean,
        types.Array(types.float32, 2, "C"),
        types.Array(types.boolean, 1, "A"),
        types.Array(types.float64, 3, "C", readonly=True),
        types.UniTuple(types.Array(types.float32, 2, "C"), 3),
    ],
)
def test_types_there_and_back(kind):
    assert type_of(text_of(kind)) == kind


@pytest.mark.parametrize(
    "kind",
    [
        types.unicode_type,
        types.Tuple((types.int64, types.float32)),
        types.Array(types.complex128, 1, "C").dtype,
    ],
)
def test_other_types_are_not_listed(kind):
    assert text_of(kind) is None


@pytest.mark.parametrize("text", ["", "os", "float64", "f2", "c8", "f8:1X", "f8:C"])
def test_other_texts_are_no_types(text):
    with pytest.raises(ValueError, match="no type"):
        type_of(text)


def test_the_list_names_kernels():
    rows = listed()
    assert len(rows) >= 20
    assert [row[2] for row in rows[:2]] == [
        "_prefilter",
        "_lines",
    ]  # in the order of their first use
    for _, module, name, *kinds in rows:
        assert isinstance(getattr(import_module(module), name), Dispatcher), f"{module}.{name}"
        assert (
            len(list(map(type_of, kinds)))
            == getattr(import_module(module), name).py_func.__code__.co_argcount
        )


def test_the_second_process_begins_with_the_dearest_of_the_second_half():
    rows = [[seconds, name] for seconds, name in zip("25143212", "abcdefgh", strict=True)]
    assert "".join(name for _, name in for_child(rows)) == "defhgcba"
    assert for_child([]) == []


def test_listed_kernels_are_compiled_and_what_is_wrong_is_passed_over(monkeypatch):
    wrong = [
        ("0.3", "zonda.no_module", "_scales"),
        ("0.1", CHEAP[1], "no_kernel"),
        (*CHEAP[:3], "f8"),
        (*CHEAP[:3], "x8"),
    ]
    monkeypatch.setattr(compile_ahead, "listed", lambda: [list(row) for row in (CHEAP, *wrong)])
    assert compile_listed(["zonda.elsewhere"]) == 0
    enough = Event()
    assert compile_listed([CHEAP[1], "zonda.no_module"], False, enough) == 1
    enough.set()
    assert compile_listed([CHEAP[1], "zonda.no_module"], False, enough) == 0
    assert compile_listed([CHEAP[1], "zonda.no_module"]) == 1
    kernel = getattr(import_module(CHEAP[1]), CHEAP[2])
    assert tuple(map(type_of, CHEAP[3:])) in kernel.overloads


def test_there_is_one_first_run(monkeypatch, tmp_path):
    monkeypatch.setenv("ZONDA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(compile_ahead, "available_threads", lambda: 2)
    monkeypatch.setattr(kernel_cache, "_CLAIMS", kernel_cache._Claims())
    started, before = [], gc.get_threshold()
    monkeypatch.setattr(
        compile_ahead.subprocess,
        "Popen",
        lambda command, **options: started.append(command) or Process(),
    )
    for expected in (1, 2):  # the first failed
        helper = Helper()
        helper.prepare()
        helper.begin()
        assert gc.get_threshold() == compile_ahead.COMPILING
        helper.close()
        assert gc.get_threshold() == before
        assert len(started) == expected
    helper = Helper()
    helper.prepare()
    helper.begin()
    helper.succeeded()
    helper.close()
    loaded = []
    monkeypatch.setattr(
        compile_ahead, "compile_listed", lambda *arguments: loaded.append(arguments)
    )
    later = Helper()
    later.prepare()
    later.begin()
    later.close()
    assert len(started) == 3
    ((modules, as_child, enough),) = loaded
    assert "zonda.core.compilation.compile_ahead" in modules
    assert not as_child
    assert enough.is_set()


class Process:
    """A child that hears and does nothing."""

    def __init__(self):
        self.stdin = self

    def write(self, body):
        assert body.endswith(b"\n")

    flush = kill = communicate = lambda self: None


def test_one_processor_compiles_alone(monkeypatch, tmp_path):
    monkeypatch.setenv("ZONDA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(compile_ahead, "available_threads", lambda: 1)
    helper = Helper()
    helper.prepare()
    assert helper._process is None
