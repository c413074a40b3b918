from __future__ import annotations

import math
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from zonda.core.configuration.yaml_places import Document, Source, dump, load


def read(text: str) -> Document:
    return load(Source("t.yaml", text))


def test_scalars_are_yaml_1_2() -> None:
    text = (
        "ra: 13:47:30.6\ndec: -11:45:09\nk: 1e-3\nsw: on\nd: 2020-01-01\nn: 0o17\nz: 007\nu:"
        " 1_000\ne: \nt: true\nf: 1.\n"
    )
    expected = {
        "ra": "13:47:30.6",
        "dec": "-11:45:09",
        "k": 1e-3,
        "sw": "on",
        "d": "2020-01-01",
        "n": 15,
        "z": 7,
    }
    assert read(text).value == expected | {"u": "1_000", "e": None, "t": True, "f": 1.0}
    assert yaml.safe_load(text)["dec"] == -42309  # what plain PyYAML makes of a declination


def test_places() -> None:
    document = read("a:\n  - b: {c: 4 arcmin}\n")
    mark = document.marks["a", 0, "b", "c"]
    assert (mark.key.line, mark.key.column) == (1, 8)
    assert (mark.value.column, mark.value.end_column) == (11, 19)
    assert mark.value.part(2, 6).column == 13
    assert document.mark(("a", 0, "x", "y")) == document.marks["a", 0]


def test_parts_of_quoted_values_are_not_pointed_at() -> None:
    span = read("a: '4 amin'").marks["a",].value
    assert span.part(2, 4) == span


def test_duplicate_keys_are_all_reported() -> None:
    faults = read("a: 1\nb: {c: 1, c: 2}\na: 2\n").faults
    assert sorted((f.message, f.span.line, f.span.column, f.label) for f in faults) == [
        ("duplicate key 'a'", 2, 0, "first given on line 1"),
        ("duplicate key 'c'", 1, 10, "first given on line 2"),
    ]


def test_merged_keys_may_be_overridden() -> None:
    document = read("x-a: &a {r: 1, s: 2}\nb:\n  <<: *a\n  r: 3\n")
    assert document.faults == []
    assert document.value["b"] == {"r": 3, "s": 2}


@pytest.mark.parametrize(
    ("text", "message", "line", "column"),
    [
        ("a: [1, 2\nb: 3\n", "this '[' is not closed", 0, 3),
        ("a: 1\n\tb: 2\n", "not valid YAML", 1, 0),
        ("a: !point 3\n", "the tag !point is not known", 0, 3),
        ("a: *nowhere\n", "not valid YAML", 0, 3),
        ("a: 1\n---\nb: 2\n", "not valid YAML", 1, 0),
        ("a: b\x07\n", "not valid YAML", 0, 4),
        ("? [1, 2]\n: 3\n", "a key must be plain text", 0, 2),
        ("a: &a [*a]\n", "an alias may not stand inside what it names", 0, 3),
        (f"a: {'9' * 5000}\n", "cannot be read: a number of 5000 digits", 0, 3),
        (f"a: 0x{'f' * 5000}\n", "cannot be read: a number of 5002 digits", 0, 3),
        ("a: !!python/name:os.system ''\n", "the tag !!python/name:os.system is not known", 0, 3),
        (
            "a: !!python/object/apply:os.system [id]\n",
            "the tag !!python/object/apply:os.system is not known",
            0,
            3,
        ),
        ("a: !!set {b}\n", "the tag !!set is not known", 0, 3),
        ("a: !!timestamp 99\n", "the tag !!timestamp is not known", 0, 3),
        ("a: !!bool maybe\n", "cannot be read: ", 0, 3),
        ("a: {<<: [1]}\n", "only mappings can be merged", 0, 9),
        (
            "a0: &a0 [1]\n" + "".join(f"a{k}: &a{k} [*a{k - 1}]\n" for k in range(1, 100)),
            "not valid YAML: nested deeper",
            0,
            9,
        ),
    ],
)
def test_bad_text(text: str, message: str, line: int, column: int) -> None:
    (fault,) = read(text).faults
    assert fault.message.startswith(message)
    assert (fault.span.line, fault.span.column) == (line, column)


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000,
        "a: " + "[" * 5000 + "]" * 5000,
        "".join(f"{' ' * k}a:\n" for k in range(2000)),
    ],
)
def test_deep_nesting_is_refused(text: str) -> None:
    """By us beyond 64 levels, or by the parser before, in words and at a place of its own."""
    document = read(text)
    (fault,) = document.faults
    assert document.value is None
    assert fault.message.startswith("not valid YAML: ")


def test_65_levels_are_refused_where_the_65th_begins() -> None:
    assert read("[" * 64 + "]" * 64).faults == []
    (fault,) = read("[" * 65 + "]" * 65).faults
    assert fault.message == "not valid YAML: nested deeper than 64 levels"
    assert (fault.span.line, fault.span.column) == (0, 64)


def test_exploding_aliases_are_refused() -> None:
    text = "a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n"
    text += "".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 12))
    assert "more than 100000 values" in read(text).faults[0].message


def test_exploding_merges_stay_small() -> None:
    """Every key once: PyYAML's own list of merged keys has 2e8 members here."""
    text = "x0: &x0 {a: 1, b: 2}\n"
    text += "".join(
        f"x{k}: &x{k} {{<<: [{', '.join([f'*x{k - 1}'] * 10)}], c{k}: {k}}}\n" for k in range(1, 9)
    )
    document = read(text)
    assert document.faults == []
    assert document.value["x8"] == {"a": 1, "b": 2} | {f"c{k}": k for k in range(1, 9)}


def test_long_lists_are_refused_before_they_are_built() -> None:
    assert "more than 100000 values" in read(f"a: [{'1, ' * 1_000_000}]").faults[0].message


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("{<<: {b: 1}, b: 2}", {"b": 2}),
        ("{b: 2, <<: {b: 1, c: 3}}", {"b": 2, "c": 3}),
        ("{<<: [{b: 1}, {b: 2, c: 3}]}", {"b": 1, "c": 3}),
        ("{<<: {<<: {b: 1, c: 1}, c: 2}, d: 3}", {"b": 1, "c": 2, "d": 3}),
    ],
)
def test_merged_keys_give_way_to_nearer_ones(text: str, value: Any) -> None:
    """YAML's language-independent type "merge": own keys first, then the first of several mappings.

    PyYAML 6.0.4 takes {c: 1} of the last case, against the mapping that is merged there by its own
    rule.
    """
    assert read(text).value == value


def test_empty() -> None:
    for text in ("", "\n", "# nothing\n"):
        document = read(text)
        assert document.value is None
        assert document.faults == []


plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False)
    | st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"])),
    lambda inner: st.lists(inner) | st.dictionaries(st.text("abcxyz-_09", min_size=1), inner),
    max_leaves=20,
)


@given(plain)
def test_dump_loads_again(value: Any) -> None:
    document = read(dump({"v": value}))
    assert document.faults == []
    assert _keys_as_text(document.value["v"]) == _keys_as_text(value)


def test_texts_that_look_like_numbers_stay_texts() -> None:
    values = [
        "1e3",
        "on",
        "13:47:30",
        "0x1f",
        "1_0",
        ".5",
        "null",
        "~",
        "",
        "- a",
        "a: b",
        "#c",
        ".inf",
    ]
    assert read(dump(values)).value == values
    assert math.isinf(read(dump(math.inf)).value)


def _keys_as_text(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _keys_as_text(v) for k, v in value.items()}
    return [_keys_as_text(v) for v in value] if isinstance(value, list) else value
