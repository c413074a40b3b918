"""Tables as text, records and files."""

from __future__ import annotations

import math
from pathlib import Path

from astropy.table import Table as AstropyTable

from zonda.core.storage.table_files import Column
from zonda.core.tables import Table, aligned

TABLE = Table(
    [
        Column("name", ["a", "bcd"], "", "of the row"),
        Column("value", [1.5, math.nan], "K", "what was measured"),
    ],
    {"ORIGIN": "test"},
)


def test_columns_are_as_wide_as_their_longest_cells() -> None:
    assert aligned([("a", 1), ("bcd", 222)], ("name", "n"), "<>") == [
        "name    n",
        "a       1",
        "bcd   222",
    ]


def test_the_last_alignment_holds_for_the_rest_and_lines_have_no_blanks_at_their_ends() -> None:
    assert aligned([("a", "b", "c"), ("long", "", "")], align="<>", indent=" ", gap=" ") == [
        " a    b c",
        " long",
    ]


def test_rows_may_be_shorter_than_others() -> None:
    assert aligned([("a",), ("b", "c")]) == ["a", "b  c"]
    assert aligned([]) == []


def test_records_have_none_where_a_number_is_not_known() -> None:
    assert TABLE.records() == [{"name": "a", "value": 1.5}, {"name": "bcd", "value": None}]


def test_lines_are_empty_where_a_number_is_not_known() -> None:
    assert TABLE.lines("<>") == ["name  value", "a       1.5", "bcd"]


def test_astropy_reads_the_file(tmp_path: Path) -> None:
    found = AstropyTable.read(TABLE.write(tmp_path / "t.ecsv"), format="ascii.ecsv")
    assert found["name"].tolist() == ["a", "bcd"]
    assert found["value"].unit.to_string() == "K"
    assert found.meta["ORIGIN"] == "test"
