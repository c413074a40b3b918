"""Maps of I, Q, U: I is read, and what is not used is said."""

import healpy
import numpy as np
import pytest
from astropy.io import fits

from zonda.core.errors import InputError
from zonda.core.maps.map_reading import STOKES, polarized_letter
from zonda.operators.sky.read import read_map
from zonda.operators.sky.skymap import SkyMap


@pytest.mark.parametrize(
    ("name", "polarized"),
    [("Q_POLARISATION", True), ("U_STOKES", True), ("STOKES_Q", True), ("V", True), ("q-pol", True)]
    + [
        (name, False)
        for name in (
            "TEMPERATURE",
            "I_STOKES",
            "SIGNAL",
            "UNITS",
            "QUALITY",
            "VALUE",
            "PRIMARY",
            "",
        )
    ],
)
def test_names(name, polarized):
    assert bool(polarized_letter(name)) is polarized


def healpix_file(path, **options):
    i, q, u = np.random.default_rng(1).normal(size=(3, 192))
    healpy.write_map(path, [i, q, u], coord="C", column_units="K_RJ", dtype=np.float64, **options)
    return i


def test_healpix_iqu(tmp_path):
    i = healpix_file(tmp_path / "iqu.fits")
    found = read_map(tmp_path / "iqu.fits")
    np.testing.assert_array_equal(found.values, i)
    expected = (
        "column TEMPERATURE is read as I; Q_POLARISATION, U_POLARISATION are not used: detectors"
        " measure total intensity"
    )
    assert found.notes[STOKES] == expected


def test_partial_healpix_iqu(tmp_path):
    healpix_file(tmp_path / "iqu.fits", partial=True)
    assert (
        "Q_POLARISATION, U_POLARISATION are not used"
        in read_map(tmp_path / "iqu.fits").notes[STOKES]
    )


def test_healpix_of_i_alone_has_no_note(tmp_path):
    healpy.write_map(
        tmp_path / "i.fits", np.zeros(192), coord="C", column_units="K_RJ", dtype=np.float64
    )
    assert STOKES not in read_map(tmp_path / "i.fits").notes


def test_healpix_that_begins_with_q_is_read_by_its_names(tmp_path):
    healpix_file(tmp_path / "q.fits", column_names=["Q_STOKES", "U_STOKES", "I_STOKES"])
    found = read_map(tmp_path / "q.fits")
    assert found.notes["column"] == "I_STOKES (3 of 3: Q_STOKES, U_STOKES, I_STOKES)"
    assert np.array_equal(found.values, read_map(tmp_path / "q.fits", column=3).values)
    assert not np.array_equal(found.values, read_map(tmp_path / "q.fits", column="q_stokes").values)


def table(path, names, unit="K_RJ"):
    """Column k holds k; a column PIXEL numbers the pixels."""
    columns = [
        (
            fits.Column(n, "J", array=np.arange(192))
            if n == "PIXEL"
            else fits.Column(n, "D", unit=unit, array=np.full(192, k))
        )
        for k, n in enumerate(names)
    ]
    hdu = fits.BinTableHDU.from_columns(columns)
    hdu.header.update(PIXTYPE="HEALPIX", ORDERING="RING", NSIDE=4, COORDSYS="C")
    hdu.writeto(path)
    return path


@pytest.mark.parametrize(
    ("names", "read"),
    [
        (["HITS", "I_STOKES"], 1),
        (["N_OBS", "TEMPERATURE"], 1),
        (["PIXEL", "HITS", "SIGNAL", "WEIGHTS"], 2),
        (["TEMPERATURE", "N_OBS"], 0),
        (["II_COV", "I_STOKES", "Q_STOKES", "U_STOKES"], 1),
        (["TMASK", "I_STOKES_INP", "I_STOKES"], 2),
        (["HITS", "I_143GHZ"], 1),
        (["MY_MAP", "HITS"], 0),
        (["SIGNAL", "PIXEL"], 0),
        (["COMPTON", "STDDEV"], 0),
    ],
)
def test_the_column_of_a_table_is_found_by_its_name(tmp_path, names, read):
    found = read_map(table(tmp_path / "t.fits", names))
    assert set(found.values) == {float(read)}
    several = len([name for name in names if name != "PIXEL"]) > 1
    assert found.notes.get("column", "").startswith(
        f"{names[read]} ({read + 1} of {len(names)}" if several else ""
    )


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["HITS"], "none of its columns is an intensity: HITS"),
        (["PIXEL", "HITS", "WEIGHTS"], "none of its columns is an intensity"),
        (["Q_STOKES", "U_STOKES"], "none of its columns is an intensity"),
        (["FULL", "FIRST", "LAST"], "several of its columns may be the map: FULL, FIRST, LAST"),
    ],
)
def test_a_table_without_a_known_column_is_refused(tmp_path, names, words):
    with pytest.raises(InputError, match=words):
        read_map(table(tmp_path / "t.fits", names))
    assert set(read_map(tmp_path / "t.fits", column=names[-1]).values) == {len(names) - 1.0}
    with pytest.raises(InputError, match="there is no map in a column NONE"):
        read_map(tmp_path / "t.fits", column="NONE")


@pytest.mark.parametrize(
    ("cards", "words"),
    [
        ({"NSIDE": 8}, "NSIDE = 8"),
        ({"NSIDE": "four"}, "NSIDE = 'four'"),
        ({"INDXSCHM": "EXPLICIT"}, "no column numbers the pixels"),
    ],
)
def test_a_table_that_contradicts_itself(tmp_path, cards, words):
    table(tmp_path / "t.fits", ["SIGNAL"])
    with fits.open(tmp_path / "t.fits", mode="update") as hdus:
        hdus[1].header.update(cards)
    with pytest.raises(InputError, match=words):
        read_map(tmp_path / "t.fits")


@pytest.mark.parametrize(("first", "step", "plane"), [(1, 1, 0), (3, -1, 2)])
def test_cube_of_i_q_u(made, save, first, step, plane):
    values = np.random.default_rng(2).normal(size=(3, 5, 6))
    header = made.tan_header(
        (5, 6), CTYPE3="STOKES", CRVAL3=float(first), CDELT3=float(step), CRPIX3=1.0
    )
    found = read_map(save(values, header))
    np.testing.assert_array_equal(found.values, values[plane])
    assert found.notes[STOKES].startswith(f"plane {plane + 1} of 3 is read, I; ")
    assert "are not used" in found.notes[STOKES]


@pytest.mark.parametrize(("length", "found"), [(1, "Q"), (2, "Q, U")])
def test_cube_without_i(made, save, length, found):
    header = made.tan_header((5, 6), CTYPE3="STOKES", CRVAL3=2.0, CDELT3=1.0, CRPIX3=1.0)
    with pytest.raises(InputError, match=f"axis STOKES has {found} and no I") as caught:
        read_map(save(np.zeros((length, 5, 6)), header))
    assert "CRVAL3" in caught.value.cure


def test_one_plane_of_i_has_no_note(made, save):
    header = made.tan_header((5, 6), CTYPE3="STOKES", CRVAL3=1.0, CDELT3=1.0, CRPIX3=1.0)
    assert STOKES not in read_map(save(np.zeros((1, 5, 6)), header)).notes


def test_extensions_q_and_u(made, tmp_path):
    images = [
        fits.ImageHDU(np.zeros((5, 6)), made.tan_header((5, 6)), name=name)
        for name in ("I", "Q", "U")
    ]
    fits.HDUList([fits.PrimaryHDU(), *images]).writeto(tmp_path / "iqu.fits")
    assert (
        read_map(tmp_path / "iqu.fits")
        .notes[STOKES]
        .startswith("the first image, I, is read as I; Q, U are not used")
    )
    fits.HDUList([fits.PrimaryHDU(), *images[1:]]).writeto(tmp_path / "qu.fits")
    with pytest.raises(InputError, match="its first image, Q, is no intensity"):
        read_map(tmp_path / "qu.fits")


def test_skymap_warns(tmp_path):
    healpix_file(tmp_path / "iqu.fits")
    with pytest.warns(
        UserWarning, match=r"SkyMap: .*iqu\.fits: column TEMPERATURE is read as I; .* are not used"
    ):
        SkyMap(file=str(tmp_path / "iqu.fits")).read_input()
