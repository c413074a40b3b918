"""Every coarser form of every effect of the shipped pipeline against its bound: the same random
numbers, in full and coarse.
"""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest

import zonda
from zonda.core import cli
from zonda.core.plan.audit import SHORTEST, Audit, Checked, _compare, _Result, audit, extent
from zonda.core.plan.bounds import Choice
from zonda.core.plan.prediction import SECONDS, sliced

SHORT = ["PointingDaisy.scan_duration=40 s", "PointingDaisy.scans=1"]
SET = [a for s in SHORT for a in ("--set", s)]


@pytest.fixture(scope="module")
def file():
    return zonda.load("mustang2_cluster", overrides=SHORT)


@pytest.fixture(scope="module")
def made(file):
    return zonda.plan(file, threads=1)


@pytest.fixture(scope="module")
def everything_coarse(file):
    plain = zonda.plan(file, prune_all=False, threads=1)
    names = [d.name for d in plain.decided if len(d.effect.choices) > 1]
    made = zonda.plan(file, drop=names, threads=1)
    return audit(file, made, threads=1, seconds=40.0)


def test_every_bound_of_the_shipped_pipeline_holds(everything_coarse):
    assert not everything_coarse.violated, str(everything_coarse)
    checked = {row.effect for row in everything_coarse.rows}
    assert len([c for c in checked if ".layer" in c]) == 10
    assert {
        "SkyMap.sampling order",
        "SkyMap.beam convolution",
        "HighpassFilter.high-pass decimation",
        "all together",
    } <= checked


def test_the_errors_are_there(everything_coarse):
    """An audit that compared a run with itself would hold too: most coarser forms do make a
    difference.
    """
    actual = {(r.effect, r.metric): r.actual for r in everything_coarse.rows}
    for name in (
        "AtmosphereLayers.layer 3",
        "HighpassFilter.high-pass decimation",
    ):
        assert actual[name, "tod"] > 0, name
    assert actual["SkyMap.beam convolution", "peak"] > 0


def test_layers_are_bounded_by_what_is_there():
    """Behind the detectors' mean they do not come out a hundred times smaller than they are
    bounded.
    """
    file = zonda.load("mustang2_cluster", overrides=[*SHORT, "CommonModeFilter.method=mean"])
    layers = ["layer 0", "layer 5", "layer 9"]
    found = audit(file, zonda.plan(file, drop=layers, threads=1), threads=1, seconds=40.0)
    assert not found.violated, str(found)
    rows = {r.effect: r for r in found.rows if r.metric == "tod"}
    for name in layers:
        assert (
            0
            < rows[f"AtmosphereLayers.{name}"].bound
            < 100 * rows[f"AtmosphereLayers.{name}"].actual
        )


def test_the_shipped_plan_holds(file, made):
    found = audit(file, made, threads=1, seconds=30.0)
    assert not found.violated, str(found)


def test_a_violated_bound_is_seen(file, made):
    """The same audit with a bound a thousand times too small."""
    plain = zonda.plan(file, drop=["high-pass decimation"], threads=1)
    whole = audit(file, plain, threads=1, seconds=20.0)
    tight = Audit(tuple(dataclasses.replace(r, bound=r.bound / 1000) for r in whole.rows), "test")
    assert tight.violated
    assert "VIOLATED" in str(tight)
    assert json.loads(tight.json())["rows"][0]["violated"]
    assert Checked("a", "b", "tod", 1.0, 1.5, 0.2).violated
    assert not Checked("a", "b", "tod", 1.0, 1.5, 0.3).violated, "within two standard errors"
    assert Checked("a", "b", "tod", 1.0, math.nan, 0.0).violated


def test_the_table_has_units():
    """Temperatures in kelvin; the transfer function has none."""
    rows = (
        Checked("a", "b", "map_rms", 1.21e-5, 0.0, 0.0),
        Checked("a", "b", "transfer", 5.3e-4, 1.2e-4, 0.0),
    )
    kelvin, plain = (line.split("  ") for line in str(Audit(rows, "test")).splitlines()[2:4])
    assert [cell.strip() for cell in kelvin if cell] == [
        "a",
        "b",
        "map_rms",
        "12.1 uK",
        "0 K",
        "0 K",
        "holds",
    ]
    assert [cell.strip() for cell in plain if cell] == [
        "a",
        "b",
        "transfer",
        "5.3e-04",
        "1.2e-04",
        "0.0e+00",
        "holds",
    ]


def test_command_audit(capsys, monkeypatch):
    status, out, _ = _command(
        capsys,
        "plan",
        "mustang2_cluster",
        *SET,
        "--drop",
        "high-pass decimation",
        "--audit",
        "--threads",
        "1",
    )
    assert status == 0
    assert "0 violated" in out
    bad = Audit((Checked("a", "b", "tod", 1.0, 9.0, 0.1),), "test")
    monkeypatch.setattr("zonda.core.plan.audit.audit", lambda *a, **k: bad)
    status, out, _ = _command(capsys, "plan", "mustang2_cluster", *SET, "--audit")
    assert status == 1
    assert "VIOLATED" in out


def _command(capsys, *arguments):
    status = cli.main([str(a) for a in arguments])
    said = capsys.readouterr()
    return status, said.out, said.err


def test_what_no_output_depends_on_is_audited(tmp_path):
    """A component that the sum does not read is left out: the map is the same."""
    (tmp_path / "hits.yaml").write_text("""
site: green_bank
instrument: mustang2
time: 2024-11-25T07:00
target: 05h +20d
operators:
  - PointingDaisy: {scan_duration: 5 s}
  - WhiteNoise
  - Efficiency
  - HighpassFilter: {frequency: 1 Hz}
  - BinMap
  - CommonModeFilter
  - SaveMap
""")
    file = zonda.load(str(tmp_path / "hits.yaml"))
    made = zonda.plan(file, threads=1)
    assert "CommonModeFilter" not in made.structure.operators
    found = audit(file, made, threads=1, seconds=5.0)
    assert [(r.effect, r.metric, r.actual) for r in found.rows if r.effect == "structure"] == [
        ("structure", "map_rms", 0.0)
    ]
    assert not found.violated


def test_the_slice_is_chosen_by_its_samples(file, made):
    """Few runs: the whole minute or the scan; three thousand times as many: the shortest, and fewer
    detectors.
    """
    assert extent(made, 4).seconds == pytest.approx(min(SECONDS, 40.0))
    assert extent(made, 4).every == 1
    found = extent(made, 12000)
    assert found.seconds == SHORTEST
    assert found.every == 223 // 64
    assert extent(made, 400).seconds < extent(made, 4).seconds


def test_a_slice_of_detectors(file):
    """Every fourth, and the outermost: the field keeps its extent."""
    part = sliced(file, 2.0, every=4)
    data = part.pipeline().run(part.scene(), threads=1)
    whole = zonda.load("mustang2_cluster").scene().instrument.focalplane()
    plane = data.observations[0].focalplane
    assert len(whole) / 4 <= len(plane) <= len(whole) / 4 + 5
    assert plane.radius == pytest.approx(whole.radius, rel=0.02)
    assert data.observations[0].n_samples == 200
    assert np.isfinite(data.products["map"].signal).any()


class _Map:
    def __init__(self, signal, hits):
        self.signal, self.hits = np.asarray(signal), np.asarray(hits)


def test_the_sky_is_compared_wherever_both_maps_have_it():
    """Every pixel counts, whatever its hits; where one of them has none there is nothing to
    compare.
    """
    choice = Choice("coarse", "test", bound={"peak": 0.5})
    hits, signal = np.full(100, 7), np.ones(100)
    other, wrong = hits.copy(), signal.copy()
    other[:3], wrong[:3], wrong[9], other[20], wrong[20] = 6, 4.0, 1.25, 0, np.nan
    full, coarse = (_Result([], None, _Map(s, h)) for s, h in ((signal, hits), (wrong, other)))
    (row,) = [r for r in _compare("sky", choice, full, coarse, None) if r.metric == "peak"]
    assert row.actual == 3.0
    assert row.violated


def test_a_bound_that_nothing_exercised_is_not_said_to_hold():
    """The coarser form is not in what is compared: both maps of the sky are the same."""
    sky = _Result([], None, _Map(np.ones(9), np.ones(9)))
    rows = _compare(
        "x", Choice("coarse", "test", bound={"peak": 0.5, "transfer": 0.1}), sky, sky, None
    )
    assert [(r.metric, r.verdict) for r in rows] == [
        ("peak", "not exercised"),
        ("transfer", "not exercised"),
    ]
    found = Audit(tuple(rows), "test")
    assert "not exercised" in str(found).splitlines()[-1]
    assert not found.violated


def test_an_audit_without_a_good_sample_compares_nothing(recwarn):
    """Not the mean of nothing, which is no number and violates every bound."""
    choice = Choice("coarse", "test", bound={"tod": 0.5, "peak": 0.5})
    empty, sky = [np.empty((0, 100))], _Map(np.ones(9), np.ones(9))
    assert [
        r.metric
        for r in _compare("x", choice, _Result(empty, None, sky), _Result(empty, None, sky), None)
    ] == [
        "tod",
        "peak",
    ]
    assert not any(
        r.violated
        for r in _compare("x", choice, _Result(empty, None, sky), _Result(empty, None, sky), None)
    )
    assert not recwarn.list


POLARIZED = """
name: polarized
seed: 3
site: green_bank
time: 2024-11-25T07:00
target: 75 deg 20 deg
instrument: {name: test, telescope: {name: dish, diameter: 30 m}, band: {name: b, low: 85 GHz, high: 95 GHz}, detectors: 38,
  field_of_view: 3 arcmin, fwhm: 20 arcsec, net: 2 mK s(1/2), knee: 0.5 Hz, pink_minimum_frequency: 10 mHz, sample_rate: 25 Hz,
  main_beam_efficiency: 0.6, illumination_efficiency: 0.9, polarization: pairs}
operators:
  - PointingDaisy: {radius: 2 arcmin, speed: 60 arcsec/s, scan_duration: 20 s}
  - SkyMap: {file: sky.fits}
  - WhiteNoise
  - PinkNoise
  - Efficiency
  - HighpassFilter: {frequency: 0.1 Hz}
  - BinMap: {pixel: 5 arcsec, stokes: IQU, width: 8 arcmin}
"""


def test_an_error_of_polarization_alone_is_seen(tmp_path):
    """A sky of uniform I and a filament of Q: without a beam I is as it was. Each plane has its
    row.
    """
    from astropy.io import fits

    y = (np.arange(160) - 79.5)[:, None] * np.ones(160) * 6.0
    cube = np.stack([np.full_like(y, 1e-3), 5e-4 * np.exp(-(y**2) / 2 / 6**2), 0 * y])
    cards = {
        "CTYPE1": "RA---TAN",
        "CRVAL1": 75.0,
        "CRPIX1": 80.5,
        "CDELT1": -6 / 3600,
        "CUNIT1": "deg",
        "CTYPE2": "DEC--TAN",
        "CRVAL2": 20.0,
        "CRPIX2": 80.5,
        "CDELT2": 6 / 3600,
        "CUNIT2": "deg",
        "CTYPE3": "STOKES",
        "CRVAL3": 1.0,
        "CRPIX3": 1.0,
        "CDELT3": 1.0,
        "BUNIT": "K_RJ",
        "POLCCONV": "COSMO",
    }
    fits.PrimaryHDU(cube, fits.Header(cards)).writeto(tmp_path / "sky.fits")
    (tmp_path / "polarized.yaml").write_text(POLARIZED)
    file = zonda.load(tmp_path / "polarized.yaml")
    found = audit(
        file,
        zonda.plan(file, drop=["beam convolution", "poles"], threads=1),
        threads=1,
        seconds=20.0,
    )
    assert not found.violated, str(found)
    actual = {(r.effect, r.metric): r.actual for r in found.rows}
    assert actual["SkyMap.beam convolution", "peak"] < 1e-8
    # the beam of 20 arcsec takes 1 - 14 / (14^2 + 20^2)^(1/2) = 43 % of a filament of FWHM 14;
    # pixels and filters some of it
    assert actual["SkyMap.beam convolution", "peak Q"] == pytest.approx(0.43 * 5e-4, rel=0.4)
    # relative to what the samples of a pixel determine of a plane, independent noise of the
    # detectors is the same in all planes; of the deep pixels a few ten are independent
    for plane in "QU":
        assert actual["PinkNoise.poles", f"map_rms {plane}"] == pytest.approx(
            actual["PinkNoise.poles", "map_rms"], rel=0.3
        )
