"""The forecast of I, Q and U against the map's own covariances and against the noise of simulated
maps.
"""

import json
import math

import numpy as np
import pytest

import zonda
from zonda.core import cli
from zonda.core.configuration.pipeline_file import load, parse
from zonda.core.errors import InputError, PipelineError
from zonda.core.numerics.sphere import ARCMIN, ARCSEC
from zonda.plugins.forecast import stokes_noise
from zonda.plugins.forecast.depth import PARTS, WITHIN

RADIUS = 1.5 * ARCMIN
CAMERA = """
name: test
seed: 3
site: green_bank
time: 2024-11-25T07:00
target: 75 deg 20 deg
instrument:
  name: test
  telescope: {name: dish, diameter: 30 m}
  band: {name: band, low: 85 GHz, high: 95 GHz}
  DETECTORS
  fwhm: 20 arcsec
  main_beam_efficiency: 0.6
  illumination_efficiency: 0.9
  net: 2 mK s(1/2)
  knee: 0.5 Hz
  pink_minimum_frequency: 10 mHz
  sample_rate: 25 Hz
operators:
  - PointingDaisy: {radius: 2 arcmin, speed: 60 arcsec/s, scan_duration: 80 s, scans: 2, gap: 10 s}
"""
PAIRS = "{detectors: 38, field_of_view: 3 arcmin, polarization: pairs}"
MAP = "BinMap: {pixel: 5 arcsec, half_difference: false, stokes: IQU, width: 8 arcmin}"
PLATE = "HalfWavePlate: {frequency: 1 Hz}"
NOISE, FILTERS = (
    ("WhiteNoise", "PinkNoise", "Efficiency"),
    ("HighpassFilter: {frequency: 0.1 Hz}", "CommonModeFilter"),
)


def pipeline(folder, *steps, angles=None):
    """Pairs, or single detectors with ``angles`` [deg] in turn."""
    detectors = PAIRS[1:-1].replace(", ", "\n  ")
    if angles:
        places = [(0.5 * i + 0.25 * (j % 2), 0.433 * j) for j in range(-3, 4) for i in range(-3, 4)]
        rows = [f"d{k}, {x}, {y}, {angles[k % len(angles)]}\n" for k, (x, y) in enumerate(places)]
        (folder / "plane.csv").write_text(
            "name, xi [arcmin], eta [arcmin], polarization_angle [deg]\n" + "".join(rows)
        )
        detectors = f"focalplane: {folder / 'plane.csv'}"
    text = CAMERA.replace("DETECTORS", detectors) + "".join(
        f"  - {step}\n" for step in [*steps, MAP]
    )
    (folder / "pipeline.yaml").write_text(text)
    return load(folder / "pipeline.yaml")


UNBALANCED = (0, 0, 50, 70)


@pytest.mark.parametrize("angles", [None, UNBALANCED, (0, 60, 120)])
@pytest.mark.parametrize("plate", [(), (PLATE,)])
def test_white_noise_is_that_of_the_maps_own_covariances(tmp_path, angles, plate):
    file = pipeline(tmp_path, *plate, "WhiteNoise", "Efficiency", angles=angles)
    found = zonda.sensitivity(file, radius=RADIUS)
    product = file.pipeline().run(file.scene(), threads=1).products["map"]
    for plane in "IQU":
        one = product.stokes(plane).smoothed(product.fwhm)
        near = (one.distance() <= RADIUS) & (one.known)
        expected = math.sqrt(np.average(one.noise[near] ** 2, weights=one.weights[near]))
        # the map rounds weights and terms to 2^-30; a pixel on the circle may be on its other side
        assert found.rms(stokes=plane) == pytest.approx(expected, rel=1e-5)
        assert found.rms(stokes=plane, part="1/f") == 0


@pytest.mark.parametrize("angles", [None, UNBALANCED])
@pytest.mark.parametrize("plate", [(), (PLATE,)])
def test_against_simulated_maps(tmp_path, angles, plate):
    file = pipeline(tmp_path, *plate, *NOISE, *FILTERS, angles=angles)
    found = zonda.sensitivity(file, radius=RADIUS)
    audit = found.audited(24, threads=1).audit
    rows = {row.part: row for row in audit.rows}
    assert list(rows) == [
        f"{plane}{part}" for plane in ("", "Q ", "U ") for part in ("white", "1/f", "together")
    ]
    for row in rows.values():
        # what is stated, and four standard errors: of 24 maps with 79 beams in the circle each
        # about 2 % of the rms
        assert abs(row.difference) < WITHIN["1/f"] + 4 * row.error / row.mean, row
        assert row.error < 0.04 * row.mean
    # balanced angles make Q and U sqrt(2) noisier than I, pixels with few samples more; those of
    # the table as they are spread
    over_i = [rows[f"{plane} white"].mean / rows["white"].mean for plane in "QU"]
    if angles and not plate:
        assert over_i[0] > 1.8
        assert over_i[1] < 0.5
    else:
        assert over_i == pytest.approx([math.sqrt(2)] * 2, rel=0.15)
    share = found.rms(part="1/f", stokes="Q") / found.rms(part="white", stokes="Q")
    usual = found.rms(part="1/f") / found.rms(part="white")
    # behind the plate Q is at 4 Hz, where 1/f noise of knee 0.5 Hz has (0.5 / 4)^(1/2) of the white
    # noise's rms
    assert share == pytest.approx(math.sqrt(0.5 / 4) if plate else usual, rel=0.1)


def test_large_data_stand_by_drawn_instants(tmp_path, monkeypatch):
    file = pipeline(tmp_path, PLATE, "WhiteNoise", "Efficiency")
    every = zonda.sensitivity(file, radius=RADIUS)
    monkeypatch.setattr(stokes_noise, "SAMPLES", 38 * 2 * 80 * 25 / 2)
    some = zonda.sensitivity(file, radius=RADIUS)
    for plane in "IQU":  # pixels of half of some ten samples
        assert some.rms(stokes=plane) != every.rms(stokes=plane)
        assert some.rms(stokes=plane) == pytest.approx(every.rms(stokes=plane), rel=0.2)


AIR = "AtmosphereLayers: {pwv_rms: 2 %}"


def test_pairs_keep_the_atmosphere_out_of_q_and_u(tmp_path):
    file = pipeline(tmp_path, AIR, *NOISE, *FILTERS)
    found = zonda.sensitivity(file, radius=RADIUS)
    assert found.rms(part="atmosphere") > 0
    assert found.rms(part="atmosphere", stokes="Q") == found.rms(part="atmosphere", stokes="U") == 0
    steps = [o for o in file.operators if type(o).__name__ not in ("WhiteNoise", "PinkNoise")]
    product = zonda.Pipeline(steps).run(file.scene(), threads=1).products["map"]
    levels = [product.stokes(plane).smoothed_rms(product.fwhm, RADIUS) for plane in "IQU"]
    assert max(levels[1:]) < 1e-4 * levels[0]  # float32 rounding of the streams


def test_the_atmosphere_of_single_detectors_is_not_forecast(tmp_path, capsys):
    file = pipeline(tmp_path, AIR, *NOISE, *FILTERS, angles=UNBALANCED)
    found = zonda.sensitivity(file, radius=RADIUS)
    for plane in "IQU":
        assert math.isnan(found.rms(part="atmosphere", stokes=plane))
        both = math.hypot(*(found.rms(part=part, stokes=plane) for part in ("white", "1/f")))
        assert found.rms(stokes=plane) == pytest.approx(both)
    assert "-: what is left of the atmosphere is not forecast, and comes on top" in str(found)
    assert (
        cli.main(
            ["sensitivity", str(tmp_path / "pipeline.yaml"), "--json", "--radius", "1.5 arcmin"]
        )
        == 0
    )
    text = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert text["stokes"]["Q"][0]["K_RJ"]["atmosphere"] is None
    assert found.plot().axes[0].get_legend() is not None


def test_what_is_written_and_said(tmp_path, capsys):
    pipeline(tmp_path, PLATE, *NOISE, *FILTERS)
    arguments = "--radius", "1.5 arcmin", "--reach", "100 uK", "--output", str(tmp_path / "depth")
    assert cli.main(["sensitivity", str(tmp_path / "pipeline.yaml"), *arguments]) == 0
    text = capsys.readouterr().out
    assert (
        text.index("\nI\n")
        < text.index("\nQ\n")
        < text.index("\nU\n")
        < text.index("stated errors")
    )
    assert "\nQ: 100 uK after " in text
    from astropy.table import Table

    table = Table.read(tmp_path / "depth" / "sensitivity.ecsv")
    found = zonda.sensitivity(tmp_path / "pipeline.yaml", radius=RADIUS)
    assert set(found.planes) == set("IQU")
    for part, column in zip(PARTS, ("white", "one_over_f", "atmosphere"), strict=True):
        assert table[f"Q_{column}"][0] == pytest.approx(
            found.rms(float(table["time"][0]), part=part, stokes="Q")
        )
    assert found.reach("100 uK", "Q") > found.reach("100 uK")
    assert cli.main(["sensitivity", str(tmp_path / "pipeline.yaml"), *arguments[:4], "--json"]) == 0
    reach = json.loads(capsys.readouterr().out)["reach"]
    assert reach["seconds"] == pytest.approx(found.reach("100 uK"))
    assert reach["stokes"] == pytest.approx({plane: found.reach("100 uK", plane) for plane in "QU"})
    with pytest.raises(InputError, match="the map has no 'V'"):
        found.rms(stokes="V")


def test_pixels_that_are_not_solved(tmp_path):
    with pytest.raises(InputError, match="determine I, Q and U in no pixel"):
        zonda.sensitivity(
            pipeline(tmp_path, "WhiteNoise", "Efficiency", angles=(30,)), radius=20 * ARCSEC
        )


def test_detectors_that_are_not_polarized():
    text = (
        CAMERA.replace("DETECTORS", "detectors: 7\n  field_of_view: 1 arcmin")
        + f"  - WhiteNoise\n  - Efficiency\n  - {MAP}\n"
    )
    with pytest.raises(PipelineError, match="needs polarized detectors"):
        zonda.sensitivity(parse(text))
