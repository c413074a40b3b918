"""Small tables: what is written is read; astropy's are read; what is wrong is named with its
place.
"""

from __future__ import annotations

import gzip

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


POSITIONS = """#
#Column RAJ2000 (a10)
_RAJ2000\t_DEJ2000\tRAJ2000\tDEJ2000\tFlux
deg\tdeg\t"h:m:s"\t"d:m:s"\tmJy
--------\t--------\t----------\t---------\t----
083.6331\t+22.0145\t05 34 31.94\t+22 00 52.2\t1.5
"""


@pytest.mark.parametrize("mark", ["\t", ";"])
def test_tables_of_vizier(tmp_path, mark):
    """Names, units and dashes; both positions are the Crab's, to the digits written."""
    path = tmp_path / "vizier.tsv"
    path.write_text(POSITIONS.replace("\t", mark))
    table = read_table(path)
    deg = np.degrees([table.angles("_RAJ2000"), table.angles("RAJ2000", hours=True)])
    np.testing.assert_allclose(deg, 83.6331, atol=5e-5)
    deg = np.degrees([table.angles("_DEJ2000"), table.angles("DEJ2000")])
    np.testing.assert_allclose(deg, 22.0145, atol=5e-5)
    assert table.numbers("Flux", "Jy") == pytest.approx([1.5e-3])
    table.check()


@pytest.mark.parametrize(
    ("kind", "suffix"),
    [("ascii.ecsv", "ecsv"), ("ascii.ipac", "tbl"), ("votable", "vot"), ("fits", "fits")],
)
@pytest.mark.parametrize("packed", [False, True])
def test_formats_of_astropy(tmp_path, kind, suffix, packed):
    """Names, units, empty cells, texts and rows are those of the table that was written."""
    path = tmp_path / f"t.{suffix}"
    made = AstropyTable(
        {
            "Name": ["one two", "three"],
            "RA": [75.25, 359.5] * u.deg,
            "flux": [1.0, 2.5] * u.mJy,
            "index": np.ma.array([-0.7, 3.5], mask=[True, False]),
            "count": [1, 3],
            "good": [True, False],
        }
    )
    if kind == "ascii.ipac":
        made.remove_column("good")
    made.write(path, format=kind)
    if packed:
        path.write_bytes(gzip.compress(path.read_bytes()))
    table = read_table(path)
    assert len(table) == 2
    assert table.texts("Name") == ["one two", "three"]
    np.testing.assert_allclose(table.angles("RA", hours=True), np.radians([75.25, 359.5]))
    np.testing.assert_allclose(table.numbers("flux", "Jy"), [1e-3, 2.5e-3])
    np.testing.assert_allclose(table.numbers("index", empty=-9.0), [-9.0, 3.5])
    np.testing.assert_allclose(table.numbers("count"), [1, 3])
    table.check()
    table.numbers("index")
    with pytest.raises(
        InputError, match=r"(line|row) \d+: index is '(null|)', not a finite number"
    ):
        table.check()
    if "good" in table.columns:
        assert table.texts("good") in (["True", "False"], ["1", "0"])


@pytest.mark.parametrize(
    ("heading", "found"),
    [
        ("RA (deg),Freq_GHz", {"ra": "deg", "frequency": "GHz"}),
        ("coord.ra,nu [Hz]", {"ra": "", "frequency": "Hz"}),
        ("_RAJ2000 [deg],RA,freq", {"ra": "", "_RAJ2000": "deg", "frequency": ""}),
        ("Ra J2000,FREQUENCY", {"ra": "", "frequency": ""}),
        ("ra_error,frequency_of_what", {"ra_error": "", "frequency_of_what": ""}),
    ],
)
def test_names_that_files_have(tmp_path, heading, found):
    path = tmp_path / "t.csv"
    path.write_text(f"{heading}\n{','.join('1' * len(heading.split(',')))}\n")
    table = read_table(path)
    table.rename({"ra": ("ra", "_raj2000", "ra_j2000"), "frequency": ("frequency", "freq", "nu")})
    assert {name: unit for name, (_, unit) in table.columns.items()} == found


@pytest.mark.parametrize(
    ("unit", "cell", "degrees"),
    [
        ("", "05:00:00", 75.0),
        ("", "05h00m00s", 75.0),
        ("", "05 00 36.0", 75.15),
        ("deg", "05:00:00", 5.0),
        ("", "75d30m", 75.5),
        ("hourangle", "5", 75.0),
        ("h", "5.5", 82.5),
        ("", "05:61:00", None),
        ("", "05:00:00 x", None),
    ],
)
def test_right_ascensions(tmp_path, unit, cell, degrees):
    path = tmp_path / "t.csv"
    path.write_text(f"ra [{unit}],n\n{cell},1\n")
    table = read_table(path)
    found = np.degrees(table.angles("ra", hours=True))
    if degrees is None:
        with pytest.raises(InputError, match="line 2: ra '05:"):
            table.check()
    else:
        table.check()
        np.testing.assert_allclose(found, degrees, rtol=1e-14)


def test_names_for_numbers_without_a_heading(tmp_path):
    path = tmp_path / "t.txt"
    path.write_text("# two words\n\t1\t2  # here\n3 4\n")
    table = read_table(path, names=("x", "y", "z"))
    assert list(table.columns) == ["two", "words"], "a comment with as many words names them"
    path.write_text("# a remark of more words\n1\t 2  # here\n3 4\n")
    table = read_table(path, names=("x", "y", "z"))
    np.testing.assert_allclose([table.numbers("x"), table.numbers("y")], [[1, 3], [2, 4]])
    assert table.meta["comments"] == ["a remark of more words"]


HARM = {
    "a unit of a table's tag": (
        "# %ECSV 1.0\n# ---\n# meta: {a: !astropy.units.Unit {unit: '10**999999999 m'}}\n"
        "# datatype:\n# - {name: a, datatype: int64}\na\n1\n",
        "power of three digits",
    ),
    "an object of another package": (
        "# %ECSV 1.0\n# ---\n# meta: {a: !numpy.ndarray {shape: [9999999999], dtype: f8}}\n"
        "# datatype:\n# - {name: a, datatype: int64}\na\n1\n",
        "",
    ),
    "blanks before a bracket": ("a b" + " " * 300_000 + "c\n1 2 3\n", ""),
    "blanks within a name": ("a" + " " * 100_000 + "b,c\n1,2\n", "100002 characters"),
    "entities": (
        '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "c">]><VOTABLE>&b;</VOTABLE>',
        "declares entities",
    ),
    "a table elsewhere": (
        "<VOTABLE><RESOURCE><TABLE><FIELD name='a'/><DATA><BINARY><STREAM href='file:///etc/passwd'"
        "/></BINARY></DATA></TABLE></RESOURCE></VOTABLE>",
        "rows are binary",
    ),
    "elements within elements": ("<VOTABLE>" + "<a>" * 200_000, "cannot be read as VOTable"),
    "a long header": ("# %ECSV 1.0\n# ---\n" + "# - a\n" * 60_000 + "a\n1\n", "100000 characters"),
    "many lines": ("\n" * 20_000_000, "GB of memory"),
}
"""Tables, and why they are refused; "": they are read, without what could harm."""


@pytest.mark.parametrize(("text", "refused"), HARM.values(), ids=HARM)
def test_tables_made_to_harm(tmp_path, text, refused):
    """Each ends at once: nothing of it is evaluated, opened or unfolded."""
    path = tmp_path / "harm"
    path.write_text(text)
    if refused:
        with pytest.raises(InputError, match=refused):
            read_table(path)
    else:
        assert len(read_table(path)) == 1
