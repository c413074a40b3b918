"""Numbers of a scene in a wrong unit, too large and too small, are warned of; those of known
instruments are not.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest

import zonda
from zonda.core.assembly.checks import looks
from zonda.core.plausibility import doubt, doubts
from zonda.core.registry import instruments


@pytest.mark.parametrize("name", list(instruments))
def test_registered_instruments_are_plausible(name: str) -> None:
    assert doubts(instruments.create(name)) == []


def test_limits_and_zero() -> None:
    assert doubt("x", 0.0, (1.0, 2.0), "m") == doubt("x", -1.5, (1.0, 2.0), "m") == ""
    assert "very small" in doubt("x", 0.9, (1.0, 2.0), "m")
    assert "very large" in doubt("x", -3.0, (1.0, 2.0), "m")


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        ({"net": "300 K s(1/2)"}, "NET is 300"),
        ({"net": "0.3 uK s(1/2)"}, "NET is 3e-07"),
        ({"fwhm": "8.5 arcmin"}, "1.22 lambda / D, is 62.9"),
        ({"fwhm": "0.14 arcsec"}, "very small"),
        ({"main_beam_efficiency": "0.6 %"}, "main beam efficiency is 0.006"),
    ],
)
def test_a_camera_in_a_wrong_unit(camera: dict[str, str], words: str) -> None:
    found = doubts(instruments.create("mustang2").varied(**camera))
    assert len(found) == 1
    assert words in found[0]
    assert "is its unit right?" in found[0]


@pytest.mark.parametrize(
    ("step", "words"),
    [
        (zonda.WhiteNoise(net="300 K s(1/2)"), "net is 300"),
        (zonda.PinkNoise(knee="500 Hz"), "above the Nyquist frequency"),
        (zonda.PinkNoise(knee="1 uHz"), "knee is 1e-06"),
        (zonda.AtmosphereLayers(pwv="5 um"), "PWV is 5e-06 m"),
    ],
)
def test_steps_in_a_wrong_unit(step: zonda.Operator, words: str) -> None:
    steps = [zonda.PointingDaisy(scan_duration="2 s"), step]
    steps += [zonda.WhiteNoise()] if isinstance(step, zonda.PinkNoise) else []
    scene = zonda.Scene(
        site="green_bank", instrument="mustang2", time="2024-11-25T07:00", target="05h +20d"
    )
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        assert not looks(steps, scene)[1]
    assert [str(w.message) for w in told if words in str(w.message)]


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("75, 20, 1e12", "very large"),
        ("75, 20, 1e-15", "very small"),
    ],
)
def test_a_catalogue_in_a_wrong_unit(tmp_path: Path, row: str, words: str) -> None:
    (tmp_path / "c.csv").write_text(f"ra [deg], dec [deg], flux [Jy]\n{row}\n")
    with pytest.warns(UserWarning, match=words):
        zonda.PointSources(catalogue=tmp_path / "c.csv").check(_data())


@pytest.mark.parametrize(
    ("head", "row", "words"),
    [
        ("", "400, 20, 1", "ra is 400 deg"),
        (", frequency [GHz]", "75, 20, 1, 0", "frequency is 0 Hz"),
        (", frequency [GHz]", "75, 20, 1, -90", "frequency is -9e"),
        (", spectral_index", "75, 20, 1, 1000", "spectral_index is 1000"),
    ],
)
def test_a_catalogue_that_cannot_be(tmp_path: Path, head: str, row: str, words: str) -> None:
    (tmp_path / "c.csv").write_text(f"ra [deg], dec [deg], flux [Jy]{head}\n{row}\n")
    with pytest.raises(zonda.ZondaError, match=words):
        zonda.PointSources(catalogue=tmp_path / "c.csv").check(_data())


def _data() -> zonda.Data:
    scene = zonda.Scene(
        site="green_bank", instrument="mustang2", time="2024-11-25T07:00", target="05h +20d"
    )
    return zonda.Data(scene=scene)
