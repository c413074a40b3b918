"""Small tables: what is written is read; astropy's are read; what is wrong is named with its
place.
"""

from __future__ import annotations

import numpy as np
import pytest
from astropy import units as u
from astropy.table import Table as AstropyTable

from zonda.core.errors import InputError
from zonda.core.storage.table_files import Column, read_table, write_ecsv


def test_what_is_written_is_read(tmp_path):
    columns = [
        Column("name", ["a b", 'say "c"'], "", "who"),
        Column("ra", [1.5, -2.25], "deg", "where"),
    ]
    table = read_table(write_ecsv(tmp_path / "t.ecsv", columns, {"made": "by a test", "seed": 1}))
    assert table.texts("name") == ["a b", 'say "c"']
    np.testing.assert_allclose(table.numbers("ra", "rad"), np.radians([1.5, -2.25]), rtol=1e-15)
    assert len(table) == 2


def test_tables_of_astropy(tmp_path):
    path = tmp_path / "t.ecsv"
    made = AstropyTable(
        {"name": ["one two", "three"], "flux": [1.0, 2.0] * u.mJy, "index": [-0.7, 3.5]}
    )
    made.meta["comment"] = ["a", "b"]
    made.write(path, format="ascii.ecsv")
    table = read_table(path)
    assert table.texts("name") == ["one two", "three"]
    np.testing.assert_allclose(table.numbers("flux", "Jy"), [1e-3, 2e-3])
    np.testing.assert_allclose(table.numbers("index"), [-0.7, 3.5])


def test_csv_has_its_units_in_brackets(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text(
        "\ufeff# name, ra [arcmin], n\n# a remark\nx, 60, 3\n\ny,120,4\n", encoding="utf-8"
    )
    table = read_table(path)
    np.testing.assert_allclose(table.numbers("ra", "deg"), [1, 2])
    np.testing.assert_array_equal(table.numbers("n"), [3, 4])


@pytest.mark.parametrize(
    ("text", "what", "match"),
    [
        ("", ("a", ""), "has no rows"),
        ("a,a\n1,2\n", ("a", ""), "has two columns 'a'"),
        ("a,b\n1\n", ("a", ""), "line 2: has 1 values, not 2"),
        ("a,b\n1,2\n", ("c", ""), "has no column 'c'"),
        ("a\n1\ninf\n", ("a", ""), "line 3: a is 'inf', not a finite number"),
        ("a\n1\nx\n", ("a", ""), "line 3: a is 'x'"),
        ("a\n1\n", ("a", "deg"), "line 1: a has no unit\n  = give it in deg"),
        (
            "a\n1\n",
            ("a", "rad"),
            (
                "give it in deg, arcmin, arcsec or rad: in ECSV 'unit: deg', in CSV a heading such"
                " as a .deg."
            ),
        ),
        ("a [K]\n1\n", ("a", "deg"), "a has the unit 'K'"),
        (
            "a [K]\n1\n",
            ("a", "rad"),
            "give it in deg, arcmin, arcsec or rad, or another unit of its kind",
        ),
        ("# of May, 2024\n\na,b\n# a remark\n1,2\n3,x\n", ("b", ""), "line 6: b is 'x'"),
        (
            "a,b\n1,2,3\n\n4\n5,6\n",
            ("b", ""),
            "2 mistakes\n  = line 2: has 3 values, not 2; .*\n  = line 4: has 1 values",
        ),
        (
            "a\nx\n1\nnan\n",
            ("a", "s"),
            (
                "3 mistakes\n  = line 1: a has no unit.*\n  = line 2: a is 'x'.*\n  = line 4: a is"
                " 'nan'"
            ),
        ),
        (
            "a\n" + "x\n" * 20,
            ("a", ""),
            "20 mistakes\n  = line 2: (.*\n)+  = line 13: .*\n  = and 8 more$",
        ),
        ("a [nonsense]\n1\n", ("a", "deg"), "a has the unit 'nonsense'"),
        ("# %ECSV 1.0\n# ---\n# - nonsense\na\n1\n", ("a", ""), "cannot be read as ECSV"),
        (
            "# %ECSV 1.0\n# ---\n# datatype:\n# - {name: a, datatype: int64}\n",
            ("a", ""),
            "cannot be read as ECSV",
        ),
        (
            "# %ECSV 1.0\n# ---\n# datatype:\n# - {name: a, datatype: int64}\nb\n1\n",
            ("a", ""),
            "incomplete or corrupt: b",
        ),
    ],
)
def test_what_is_wrong_is_named(tmp_path, text, what, match):
    path = tmp_path / "bad.csv"
    path.write_text(text, encoding="utf-8")

    def read():
        table = read_table(path)
        table.numbers(*what)
        table.check()

    with pytest.raises(InputError, match=match) as caught:
        read()
    assert "bad.csv" in str(caught.value)


@pytest.mark.parametrize("content", [b"\x89HDF\r\n\x1a\n\x00\xff", b"\xff\xfe\x00"])
def test_other_files(tmp_path, content):
    path = tmp_path / "other.bin"
    path.write_bytes(content)
    with pytest.raises(InputError, match="cannot be read as a table"):
        read_table(path)
    with pytest.raises(InputError, match="no such file"):
        read_table(tmp_path / "none")


def test_more_columns_than_are_read(tmp_path):
    path = tmp_path / "wide.csv"
    path.write_text(",".join(f"c{k}" for k in range(60_000)) + "\n" + ",".join("1" * 60_000))
    with pytest.raises(InputError, match="has 60000 columns, more than the 999"):
        read_table(path)


def test_a_quote_that_is_not_closed(tmp_path):
    """The csv module reads on to the end of the file, up to 131072 characters."""
    path = tmp_path / "t.csv"
    path.write_text("a,b\n" + '"x,1\n' + "1,2\n" * 60000)
    with pytest.raises(InputError, match=r"t\.csv"):
        read_table(path)


def test_aliases_of_a_header_do_not_multiply(tmp_path):
    """1 kB of YAML whose text has 10^9 words, and one that stands inside itself."""
    levels = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    levels += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 9)]
    for meta in (levels, ["a0: &a0 [x, *a0]"]):
        (tmp_path / "t.ecsv").write_text(
            "# %ECSV 1.0\n# ---\n# datatype:\n# - {name: ra, datatype: float64}\n# meta:\n"
            + "".join(f"#   {line}\n" for line in meta)
            + "ra\n1.0\n"
        )
        with pytest.raises(InputError, match="aliases unfold to more than") as told:
            read_table(tmp_path / "t.ecsv")
        assert "table.write" in told.value.cure
