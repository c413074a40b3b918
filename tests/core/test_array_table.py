"""Focal planes from tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import zonda
from zonda.core.configuration.pipeline_file import load
from zonda.core.errors import ZondaError
from zonda.core.flags import DEAD
from zonda.core.focalplane import Focalplane

CAMERA: dict[str, Any] = {
    "name": "camera",
    "telescope": {"name": "dish", "diameter": "6 m"},
    "band": {"name": "b150", "low": "140 GHz", "high": "160 GHz"},
    "main_beam_efficiency": 0.6,
    "illumination_efficiency": 0.9,
    "net": "500 uK s(1/2)",
    "knee": "0.2 Hz",
    "sample_rate": "20 Hz",
}
LAID_OUT = CAMERA | {"detectors": 7, "field_of_view": "10 arcmin"}
BANDS = [
    {"name": "f090", "low": "80 GHz", "high": "100 GHz"},
    {"name": "f150", "low": "140 GHz", "high": "160 GHz", "net": "700 uK s(1/2)"},
]
TWO = {key: value for key, value in CAMERA.items() if key != "band"} | {"bands": BANDS}
HEAD = "name, xi [deg], eta [deg]"
EACH = {"names", "xi", "eta", "fwhm", "net", "knee"}


def written(path: Path, head: str, rows: Sequence[str]) -> Path:
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


def of(path: Path, head: str, *rows: str, camera: dict[str, Any] = CAMERA) -> Focalplane:
    return zonda.Instrument(
        **camera, focalplane=str(written(path / "array.csv", head, rows))
    ).focalplane()


def as_table(plane: Focalplane, path: Path, bands: Sequence[str] = ()) -> Path:
    """A table with all that a focal plane has, to the last bit."""
    names = {
        "xi": "rad",
        "eta": "rad",
        "fwhm": "rad",
        "net": "K s(1/2)",
        "knee": "Hz",
        "slope": "",
        "polarization_angle": "rad",
        "polarization_efficiency": "",
        "main_beam_efficiency": "",
        "illumination_efficiency": "",
        "wafer": "",
    }
    columns = [[repr(v) for v in getattr(plane, key).tolist()] for key in names]
    columns.insert(
        0, [name.rpartition("-")[0] + "@" + name if bands else name for name in plane.names]
    )
    head = ["name", *(f"{key} [{unit}]" if unit else key for key, unit in names.items())]
    if bands:
        head.append("band")
        columns.append([bands[k] for k in plane.band])
    return written(path, ", ".join(head), [", ".join(row) for row in zip(*columns, strict=True)])


def scene(instrument: dict[str, Any]) -> zonda.Scene:
    return zonda.Scene(
        site="llano_de_chajnantor",
        instrument=instrument,
        time="2022-08-01T23:00",
        target="260d -10d",
        seed=3,
    )


def mapped(instrument: dict[str, Any], *more: Any) -> Any:
    steps = [
        zonda.PointingDaisy(radius="10 arcmin", speed="5 arcmin/s", scan_duration="10 s"),
        zonda.AtmosphereLayers(pwv="1 mm"),
        zonda.WhiteNoise(),
        zonda.PinkNoise(),
        zonda.Efficiency(),
        *more,
        zonda.BinMap(pixel="1 arcmin"),
    ]
    return zonda.Pipeline(steps).run(scene(instrument))


def test_the_generators_values_have_the_generators_bits(tmp_path: Path) -> None:
    whole = LAID_OUT | {"detectors": 14, "polarization": "pairs"}
    plane = zonda.Instrument(**whole).focalplane()
    table = as_table(plane, tmp_path / "array.csv")
    made = zonda.Instrument(**CAMERA, focalplane=str(table))
    for key, value in vars(plane).items():
        np.testing.assert_array_equal(getattr(made.focalplane(), key), value)
    assert made.detectors == 14
    assert made.field_of_view == pytest.approx(np.radians(10 / 60), rel=1e-12)
    assert zonda.Instrument.model_validate(made.model_dump(mode="json")) == made
    one, other = mapped(whole), mapped(CAMERA | {"focalplane": str(table)})
    np.testing.assert_array_equal(one["map"].signal, other["map"].signal)


def test_two_bands_have_the_generators_bits(tmp_path: Path) -> None:
    whole = TWO | {"detectors": 5, "field_of_view": "10 arcmin"}
    table = as_table(
        zonda.Instrument(**whole).focalplane(), tmp_path / "array.csv", ["f090", "f150"]
    )
    given = TWO | {"focalplane": str(table)}
    one, other, alone = mapped(whole), mapped(given), mapped(given | {"band": "f150"})
    for name in ("map_f090", "map_f150"):
        np.testing.assert_array_equal(one[name].signal, other[name].signal)
    np.testing.assert_array_equal(other["map_f150"].signal, alone["map"].signal)


def test_what_a_column_lacks_is_the_instruments_or_the_bands(tmp_path: Path) -> None:
    rows = ("a, 0, 0, f150", "b, 0.1, 0, f090", "c, 0, -0.1, f150")
    plane = of(tmp_path, f"{HEAD}, band", *rows, camera=TWO)
    assert plane.names == ["b", "a", "c"]
    assert plane.band.tolist() == [0, 1, 1]
    np.testing.assert_array_equal(plane.net, [500e-6, 700e-6, 700e-6])
    np.testing.assert_array_equal(plane.knee, 0.2)
    assert plane.fwhm[0] / plane.fwhm[1] == pytest.approx(150 / 90)
    assert not plane.polarized


def test_each_detector_has_its_own(tmp_path: Path) -> None:
    head = (
        f"{HEAD}, polarization_angle [deg], fwhm [arcmin], net [uK s(1/2)], knee [mHz], wafer, dead"
    )
    plane = of(
        tmp_path, head, "a, 0, 0, 45, 1, 300, 50, w2, false", "b, 0.1, 0, 135, 2, 400, 60, w1, true"
    )
    np.testing.assert_allclose(np.degrees(plane.polarization_angle), [45, 135])
    np.testing.assert_allclose(np.degrees(plane.fwhm) * 60, [1, 2])
    np.testing.assert_allclose(plane.net, [3e-4, 4e-4])
    np.testing.assert_allclose(plane.knee, [0.05, 0.06])
    assert plane.polarization_efficiency.tolist() == [1, 1]
    assert plane.wafer.tolist() == [1, 0]
    assert plane.dead.tolist() == [0, 1]


def test_the_instrument_need_not_state_what_the_table_has(tmp_path: Path) -> None:
    table = written(
        tmp_path / "a.csv",
        f"{HEAD}, net [uK s(1/2)]",
        ["a, 0, 0, 300", "b, 0.1, 0, 400", "c, 0, 0.1, 420"],
    )
    camera = zonda.Instrument(
        **{k: v for k, v in CAMERA.items() if k != "net"}, focalplane=str(table)
    )
    assert camera.net == pytest.approx(4e-4)
    assert camera.detectors == 3


def test_of_a_table_that_cannot_be_read_nothing_else_is_said(tmp_path: Path) -> None:
    table = written(
        tmp_path / "a.csv", f"{HEAD}, net [uK s(1/2)]", ["a, 0, 0, 300", "a, 0.1, 0, 400"]
    )
    with pytest.raises(
        ZondaError
    ) as caught:  # not that net is missing, which the table would have given
        zonda.Instrument(**{k: v for k, v in CAMERA.items() if k != "net"}, focalplane=str(table))
    assert "is that of line 2 too" in str(caught.value)
    assert "net" not in str(caught.value).splitlines()[0]


def test_ecsv_of_astropy(tmp_path: Path) -> None:
    from astropy import units as u
    from astropy.table import QTable

    table = QTable(
        {
            "name": ["a", "b"],
            "xi": [0, 6] * u.arcmin,
            "eta": [0, 0] * u.arcmin,
            "dead": [False, True],
        }
    )
    table.write(tmp_path / "a.ecsv")
    plane = zonda.Instrument(**CAMERA, focalplane=str(tmp_path / "a.ecsv")).focalplane()
    np.testing.assert_allclose(np.degrees(plane.xi), [0, 0.1])
    assert plane.dead.tolist() == [0, 1]


def test_no_map_uses_a_dead_detector(tmp_path: Path) -> None:
    rows = ["a, 0, 0", "b, 0.02, 0", "c, 0, 0.02"]
    alive = written(tmp_path / "alive.csv", HEAD, rows[:2])
    whole = written(
        tmp_path / "whole.csv", f"{HEAD}, dead", [f"{rows[0]}, 0", f"{rows[1]}, 0", f"{rows[2]}, 1"]
    )
    one, other = (
        mapped(CAMERA | {"focalplane": str(f)}, zonda.HighpassFilter(), zonda.CommonModeFilter())
        for f in (alive, whole)
    )
    assert other.observations[0].detector_flags.tolist() == [0, 0, DEAD]
    np.testing.assert_array_equal(one["map"].hits, other["map"].hits)


def test_wafers_group_the_common_mode(tmp_path: Path) -> None:
    rows = [f"{w}{k}, {0.02 * k}, {0.1 * (w == 'r')}, {w}" for w in "lr" for k in range(4)]
    table = written(tmp_path / "a.csv", f"{HEAD}, wafer", rows)
    data = mapped(
        CAMERA | {"focalplane": str(table)},
        zonda.HighpassFilter(),
        zonda.CommonModeFilter(group="wafer"),
    )
    assert data.observations[0].focalplane.wafer.tolist() == [0] * 4 + [1] * 4


def test_a_variant_with_a_table(tmp_path: Path) -> None:
    table = written(tmp_path / "mine.csv", HEAD, ["a, 0, 0", "b, 0.01, 0"])
    made = scene({"like": "mustang2", "focalplane": str(table)}).instrument
    assert (made.detectors, made.focalplane().names) == (2, ["a", "b"])
    assert "focalplane mine.csv" in made.description
    assert str(tmp_path) not in made.name + made.description


def test_the_names_of_sotodlib_and_toast(tmp_path: Path) -> None:
    """gamma runs from eta towards xi, as `polarization_angle`; TOAST's leakage e is an efficiency
    of (1 - e) / (1 + e).
    """
    own = of(
        tmp_path,
        f"{HEAD}, polarization_angle [deg], polarization_efficiency",
        "a, 0, 0, 30, 0.8",
        "b, 0, 0, 120, 1",
    )
    for head, rows in (
        (
            "det_id, xi [deg], eta [deg], gamma [deg], pol_eff",
            ["a, 0, 0, 30, 0.8", "b, 0, 0, 120, 1"],
        ),
        (f"{HEAD}, pol_angle [deg], pol_leakage", [f"a, 0, 0, 30, {1 / 9}", "b, 0, 0, 120, 0"]),
        (f"{HEAD}, psi_pol [deg], pol_efficiency", ["a, 0, 0, 30, 0.8", "b, 0, 0, 120, 1"]),
    ):
        plane = of(tmp_path, head, *rows)
        np.testing.assert_allclose(plane.polarization_angle, own.polarization_angle, rtol=1e-15)
        np.testing.assert_allclose(
            plane.polarization_efficiency, own.polarization_efficiency, rtol=1e-12
        )
        assert plane.names == ["a", "b"]
    assert of(tmp_path, f"{HEAD}, gamma [deg]", "a, 0, 0, 0").polarized
    noisy = of(
        tmp_path, f"{HEAD}, psd_fknee [Hz], psd_alpha, psd_fmin [Hz]", "a, 0, 0, 0.3, 1.5, 0.001"
    )
    assert (noisy.knee[0], noisy.slope[0], noisy.minimum_frequency[0]) == (0.3, 1.5, 0.001)


def test_what_was_read_under_another_name_and_what_was_not_is_told(tmp_path: Path) -> None:
    table = written(tmp_path / "a.csv", f"{HEAD}, gamma [deg], pixel, ufm", ["a, 0, 0, 10, 1, Mv6"])
    camera = zonda.Instrument(**CAMERA, focalplane=str(table))
    told = "gamma is read as polarization_angle; not used: pixel, ufm"
    assert camera.notes == {"focal plane": told}
    assert ("camera", "focal plane", told) in list(mapped(CAMERA | {"focalplane": str(table)}).log)


def test_columns_that_say_again_what_ours_say_are_left_out(tmp_path: Path) -> None:
    """Places in mm beside xi and eta, TOAST's NET beside net."""
    table = written(
        tmp_path / "a.csv",
        f"{HEAD}, x [mm], y [mm], net [mK s(1/2)], psd_net",
        ["a, 0, 0, 1, 2, 3, 4"],
    )
    assert zonda.Instrument(**CAMERA, focalplane=str(table)).notes == {
        "focal plane": "not used: x, y, psd_net"
    }


FAULTS = [
    ("name, x [mm], y [mm]", ["a, 1, 2"], "has a column 'x', which is not read", "write xi"),
    (
        f"{HEAD}, quat",
        ["a, 0, 0, 1"],
        "has a column 'quat', which is not read",
        "polarization_angle",
    ),
    (f"{HEAD}, tau [s]", ["a, 0, 0, 1"], "has a column 'tau', which is not read", "remove it"),
    (f"{HEAD}, gamma", ["a, 0, 0, 0"], "polarization_angle has no unit", "deg"),
    (
        f"{HEAD}, gamma [deg], polarization_angle [deg]",
        ["a, 0, 0, 0, 0"],
        "has 'gamma' beside",
        "remove one",
    ),
    (f"{HEAD}, gamma [rad]", ["a, 0, 0, 0", "b, 0, 0, 90"], "goes to 90 rad", "unit of the angles"),
    (
        f"{HEAD}, gamma [deg]",
        ["a, 0, 0, 0", "b, 0, 0, 1.5708", "c, 0, 0, 0.7854"],
        "0.7854, 1.5708 deg: parts of pi",
        "unit",
    ),
    (
        f"{HEAD}, psd_net [K s(1/2)]",
        ["a, 0, 0, 1"],
        "has a column 'psd_net', which is not read",
        "write net",
    ),
    (
        "name, xi [deg], eta [deg], psi [deg]",
        ["a, 0, 0, 1"],
        "has a column 'psi', which is not read",
        "polarization_angle",
    ),
    (
        f"{HEAD}, gamma [deg], pol_leakage",
        ["a, 0, 0, 1, -0.1"],
        "pol_leakage is -0.1",
        "give 0 to 1",
    ),
    (
        "name, xi [deg]",
        ["a, 0"],
        "has no column 'eta'",
        "a table of detectors has name, xi and eta",
    ),
    (HEAD, ["a, 0, 0", "a, 1, 0"], "line 3: name 'a' is that of line 2 too", "name of its own"),
    (HEAD, ["a, 0, 0", ", 1, 0"], "line 3: has no name", "name of its own"),
    (HEAD, ["a, 0, 0", "b, nan, 0"], "line 3: xi is 'nan'", "mend or remove that row"),
    (HEAD, ["a, 0, 0", "b, east, 0"], "line 3: xi is 'east'", "mend or remove that row"),
    (HEAD, ["a, 0"], "line 2: has 2 values, not 3", "write 3 values"),
    ("name, xi, eta [deg]", ["a, 0, 0"], "xi has no unit", "deg, arcmin, arcsec or rad: in ECSV"),
    (
        "name, xi [parsnips], eta [deg]",
        ["a, 0, 0"],
        "xi has the unit 'parsnips'",
        "give it in deg, arcmin, arcsec or rad",
    ),
    (
        f"{HEAD}, net [K]",
        ["a, 0, 0, 1"],
        "net has the unit 'K'",
        "give it in mK s(1/2), uK s(1/2) or K s(1/2)",
    ),
    (f"{HEAD}, fwhm [deg]", ["a, 0, 0, 0"], "line 2: fwhm is 0", "more than 0"),
    (
        f"{HEAD}, polarization_efficiency",
        ["a, 0, 0, 1.5"],
        "line 2: polarization_efficiency is 1.5",
        "at most 1",
    ),
    (f"{HEAD}, dead", ["a, 0, 0, maybe"], "line 2: dead is 'maybe'", "true or false"),
    (
        f"{HEAD}, polarisation_angle [deg]",
        ["a, 0, 0, 0"],
        "unknown column 'polarisation_angle'",
        "'polarization_angle'",
    ),
    (HEAD, [], "has no rows", "a row or more"),
    (
        HEAD,
        ["a, 0, 0", "b, 30, 20"],
        "line 3: detector b looks 32.18 deg away",
        "see that their units are right",
    ),
]


@pytest.mark.parametrize(("head", "rows", "cause", "cure"), FAULTS)
def test_faults_of_a_table(
    tmp_path: Path, head: str, rows: list[str], cause: str, cure: str
) -> None:
    with pytest.raises(ZondaError) as caught:
        of(tmp_path, head, *rows)
    assert "array.csv" in str(caught.value)
    assert cause in str(caught.value)
    assert cure in str(caught.value)


@pytest.mark.parametrize(
    ("camera", "head", "rows", "cause"),
    [
        (TWO, HEAD, ["a, 0, 0"], "has no column 'band', and the instrument has several"),
        (
            TWO,
            f"{HEAD}, band",
            ["a, 0, 0, f090", "b, 0, 0, f151"],
            "line 3: detector b is of the unknown band 'f151'",
        ),
        (
            TWO,
            f"{HEAD}, band",
            ["a, 0, 0, f090"],
            "has no detector of the band f150; its bands: f090",
        ),
        (
            TWO,
            f"{HEAD}, band",
            ["a, 0, 0, f090", "b, 0, 0, f151"],
            "did you mean 'f150'? the instrument has: f090, f150",
        ),
        (CAMERA, f"{HEAD}, band", ["a, 0, 0, f090"], "unknown band 'f090'"),
        (
            CAMERA | {"detectors": 2},
            f"{HEAD}, band",
            ["a, 0, 0, b150", "b, 0, 0, b15"],
            "1 rows, but the instrument states 2",
        ),
        (
            CAMERA | {"detectors": 7},
            HEAD,
            ["a, 0, 0", "b, 0.1, 0"],
            "2 rows, but the instrument states 7",
        ),
        (CAMERA | {"field_of_view": "1 arcmin"}, HEAD, ["a, 0.1, 0"], "more than field_of_view"),
        (
            CAMERA | {"polarization": "pairs"},
            HEAD,
            ["a, 0, 0"],
            "has no column 'polarization_angle'",
        ),
    ],
)
def test_tables_that_do_not_suit_the_instrument(
    tmp_path: Path, camera: dict[str, Any], head: str, rows: list[str], cause: str
) -> None:
    with pytest.raises(ZondaError) as caught:
        of(tmp_path, head, *rows, camera=camera)
    assert "array.csv" in str(caught.value)
    assert cause in str(caught.value)


def test_all_mistakes_of_a_table_are_told_at_once_with_their_lines(tmp_path: Path) -> None:
    rows = [
        "# an outer ring",
        "a, 0, 0, 1, 0.5, no",
        "b, 40, x, 1, 4, maybe",
        "",
        "b, 0.1, 0, -1, nan, yes",
    ]
    with pytest.raises(ZondaError) as caught:
        of(tmp_path, "name, xi [deg], eta [deg], net, slope, dead", *rows)
    told = [
        line.removeprefix("  = ")
        for line in str(caught.value).splitlines()
        if line.startswith("  = line ")
    ]
    assert [line.partition(";")[0] for line in told] == [
        "line 1: net has no unit",
        "line 4: eta is 'x', not a finite number",
        "line 4: slope is 4",
        "line 4: dead is 'maybe'",
        "line 6: name 'b' is that of line 4 too",
        "line 6: net is -1",
        "line 6: slope is 'nan', not a finite number",
    ]
    assert "array.csv: 7 mistakes" in str(caught.value)


def test_a_pipeline_file_names_the_table_beside_it(tmp_path: Path) -> None:
    written(tmp_path / "array.csv", HEAD, ["a, 0, 0", "b, nan, 0"])
    path = tmp_path / "my.yaml"
    path.write_text(
        "site: green_bank\ninstrument:\n  like: mustang2\n  focalplane: array.csv\ntime:"
        " 2024-11-25T07:00\ntarget: 05h +20d\noperators:\n  - PointingDaisy\n  - WhiteNoise\n  -"
        " Efficiency\n  - BinMap\n"
    )
    with pytest.raises(ZondaError, match=r"line 3: xi is 'nan'") as caught:
        load(path)
    assert "my.yaml:4" in str(caught.value)
    assert "1 mistake" in str(caught.value)
    written(tmp_path / "array.csv", HEAD, ["a, 0, 0", "b, 0.01, 0"])
    assert load(path).scene().instrument.detectors == 2
