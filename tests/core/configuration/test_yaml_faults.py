"""Mistakes in YAML are shown where they were made, not where the parser gave up."""

from __future__ import annotations

import pytest

from zonda.core.configuration.yaml_places import Source, load

HEAD = "site: green_bank\ninstrument: mustang2\ntime: 2024-11-25T07:00\n"


@pytest.mark.parametrize(
    ("text", "line", "column", "message", "label"),
    [
        # a space that is missing makes a key the beginning of a text that goes on in the next line
        (
            HEAD.replace("instrument: m", "instrument:m"),
            1,
            10,
            "'instrument:' has no space behind it",
            "instrument: mustang2",
        ),
        (
            HEAD.replace("site: g", "site:g"),
            0,
            4,
            "'site:' has no space behind it",
            "site: green_bank",
        ),
        (
            HEAD.replace("time: 2", "time:2") + "seed: 1\n",
            2,
            4,
            "'time:' has no space",
            "time: 2024-11-25T07:00",
        ),
        (
            HEAD + "# note\n\ntarget:05h +20d\n# note\n\nseed: 1\n",
            5,
            6,
            "'target:' has no space",
            "target: 05h +20d",
        ),
        (
            HEAD + "operators:\n  - A:\n      x:1 m\n      y: 2 m\n",
            5,
            7,
            "'x:' has no space",
            "x: 1 m",
        ),
        (HEAD + "operators:\n  - A\n  -B\n  - C\n", 5, 2, "'-' has no space behind it", "- B"),
        (
            HEAD.replace("instrument: m", "instrument = m"),
            1,
            11,
            "'instrument' is set by ':'",
            "instrument: mustang2",
        ),
        ("operators:\n  - A\n  B\n", 2, 2, "neither a step nor a key", "'- B' for a step"),
        ("operators:\n  - A: x: 2 m\n", 1, 8, "two keys on one line", "A: {x: 2 m}"),
        ("operators:\n  - A: {x: 2 m\n  - B\n", 1, 7, "this '{' is not closed", "'}' or a comma"),
        ("x: [1, 2\ny: 3\n", 0, 3, "this '[' is not closed", "']' or a comma"),
        ("x: 'abc\ny: 3\n", 0, 3, "this quote is not closed", "close it"),
        ("x: @2\n", 0, 3, "text may not begin with @ here", "between quotes"),
        ("operators:\n\t- A\n", 1, 0, "a tab stands in the indentation", "indent with spaces"),
        (
            "operators:\n  - A:\n  name: x\n",
            2,
            2,
            "among steps that begin with '- '",
            "indent it further",
        ),
        (
            "x:\n   a: 1\n  b: 2\n",
            2,
            2,
            "indented neither as its neighbours nor under them",
            "indent it as",
        ),
    ],
)
def test_the_cause_is_shown_at_its_own_place(
    text: str, line: int, column: int, message: str, label: str
) -> None:
    (fault,) = load(Source("t.yaml", text)).faults
    assert (fault.span.line, fault.span.column) == (line, column)
    assert message in fault.message
    assert label in fault.label


def test_each_line_without_its_space_is_shown() -> None:
    text = "site:green_bank\ninstrument:mustang2\ntime:2024-11-25T07:00\nseed: 1\n"
    faults = load(Source("t.yaml", text)).faults
    assert [(f.span.line, f.span.column) for f in faults] == [(0, 4), (1, 10), (2, 4)]


def test_the_first_line_of_a_setting_is_counted_from_its_own_column() -> None:
    text = "BinMap.x={a: 1"
    (fault,) = load(Source("--set", text), column=9, text="{a: 1").faults
    assert (fault.span.line, fault.span.column) == (0, 9)


def test_what_has_no_known_cause_keeps_the_parsers_words() -> None:
    (fault,) = load(Source("t.yaml", "a: 1\n---\nb: 2\n")).faults
    assert fault.message.startswith("not valid YAML: ")
