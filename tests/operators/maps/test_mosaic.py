"""Several targets in one map: in one run, in a campaign, about which centre, and what is too far
apart.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import zonda
from zonda.core.errors import InputError, ZondaError
from zonda.core.numerics.sphere import local_axes, separation
from zonda.core.registry import instruments
from zonda.operators.maps.map_layout import whole_of
from zonda.plugins.checks.scenes import sky_file

ARCMIN = math.radians(1 / 60)
A, B, C = "75 deg 20 deg", "75.10 deg 20 deg", "75.05 deg 20.08 deg"
GRID = {
    "pixel": "20 arcsec",
    "width": "24 arcmin",
    "height": "20 arcmin",
    "centre": "75.05 deg 20.04 deg",
}
CAMERA = instruments.create("mustang2").varied(detectors=19)


def scene(**more: Any) -> zonda.Scene:
    given = {"site": "green_bank", "instrument": CAMERA, "time": "2024-11-25T07:00", "seed": 3}
    return zonda.Scene(**{**given, **more})


def daisy(**more: Any) -> Any:
    return zonda.PointingDaisy(
        **{"radius": "3 arcmin", "scan_duration": "20 s", "sample_rate": "20 Hz", **more}
    )


@pytest.fixture(scope="module")
def sky() -> Any:
    """A map of 20 arcmin about A with structure everywhere, K_RJ."""
    y, x = np.mgrid[:120, :120] * 10.0
    with sky_file(
        1e-3 * (1 + 0.5 * np.sin(x / 80) + 0.3 * np.cos(y / 130 + 0.3)), pixel=10.0
    ) as path:
        yield path


def mapped(sky: Path, pointing: list[Any], scene: zonda.Scene, **grid: Any) -> Any:
    data = zonda.Pipeline([*pointing, zonda.SkyMap(file=sky), zonda.BinMap(**grid)]).run(
        scene, threads=1
    )
    return data.products["map"]


def test_the_map_of_a_mosaic_is_the_sum_of_the_maps_of_its_targets(sky: Path) -> None:
    whole = mapped(sky, [daisy(targets=[A, B, C])], scene(), **GRID)
    # each target alone, at the time at which the mosaic observes it: 20 s and 30 s between scans
    starts = ["2024-11-25T07:00:00", "2024-11-25T07:00:50", "2024-11-25T07:01:40"]
    alone = [
        mapped(sky, [daisy(target=t)], scene(time=start), **GRID)
        for t, start in zip((A, B, C), starts, strict=True)
    ]
    assert np.array_equal(whole.hits, sum(m.hits for m in alone))
    weight = sum(np.nan_to_num(m.weights) for m in alone)
    assert np.nan_to_num(whole.weights) == pytest.approx(weight, rel=1e-6)
    mean = sum(np.nan_to_num(m.signal * m.weights) for m in alone)[weight > 0] / weight[weight > 0]
    # the sums' fixed point: 1.5e-11 K a sample
    assert whole.signal[weight > 0] == pytest.approx(mean, abs=1e-10)
    assert all((m.hits > 0).any() for m in alone)


def test_it_is_centred_on_the_whole_and_holds_every_sample(sky: Path) -> None:
    whole = mapped(sky, [daisy(targets=[A, B, C], scans=2)], scene(), pixel="20 arcsec")
    assert int(whole.hits.sum()) == 6 * 400 * 19
    rows, columns = np.nonzero(whole.hits)
    ny, nx = whole.hits.shape
    # as far from each edge: within what the detectors leave empty at the rim of the field (half the
    # field of view: 2.1 arcmin)
    assert abs(rows.min() - (ny - 1 - rows.max())) * 20 < 2.1 * 60
    assert abs(columns.min() - (nx - 1 - columns.max())) * 20 < 2.1 * 60
    middle = np.radians([75.05, 20.04])
    assert separation(*whole.centre, tuple(middle)) < 0.3 * ARCMIN
    # two steps with a target each are a mosaic, too
    other = mapped(
        sky, [daisy(target=A), daisy(target=B, name="second")], scene(), pixel="20 arcsec"
    )
    assert separation(*other.centre, (math.radians(75.05), math.radians(20.0))) < 0.3 * ARCMIN


def test_the_scans_of_a_target_follow_each_other() -> None:
    data = zonda.Data(scene(target=C))
    daisy(targets=[A, B], scans=2).observe(data)
    found = [tuple(np.degrees(o.centre).round(6)) for o in data.observations]
    assert found == [(75.0, 20.0)] * 2 + [(75.1, 20.0)] * 2
    (line, *_) = daisy(targets=[A, B], scans=2).check(zonda.Data(scene()))
    assert line.startswith("4 scans of 2 targets from 2024-11-25T07:00:00Z")


def test_one_target_keeps_the_map_it_had(sky: Path) -> None:
    one = mapped(sky, [daisy(target=A, offsets="box", scans=2)], scene(), pixel="20 arcsec")
    assert one.centre == pytest.approx(np.radians([75, 20]), abs=1e-15)


PIPELINE = """
site: green_bank
instrument: {like: mustang2, detectors: 7}
time: 2024-11-25T07:00
target: 75 deg 20 deg
campaign:
  AXIS
  engine: serial
operators:
  - PointingDaisy: {radius: 3 arcmin, scan_duration: 10 s, sample_rate: 20 Hz}
  - SkyMap: {file: SKY}
  - BinMap: {pixel: 20 arcsec}
  - SaveMap
"""


@pytest.mark.parametrize(
    "axis",
    [
        "grid: {target: [75 deg 20 deg, 75.10 deg 20 deg]}",
        "observations: [{target: 75 deg 20 deg}, {target: 75.10 deg 20 deg}]",
    ],
)
def test_a_campaign_over_targets_is_one_map_about_the_middle(
    axis: str, sky: Path, tmp_path: Path
) -> None:
    from astropy.io import fits

    from zonda.core.cli import main

    file = tmp_path / "mosaic.yaml"
    file.write_text(PIPELINE.replace("AXIS", axis).replace("SKY", str(sky)))
    assert main(["run", str(file), "--output", str(tmp_path / "out")]) == 0
    header = fits.getheader(tmp_path / "out" / "map.fits", "SIGNAL")
    assert header["CRVAL1"] == pytest.approx(75.05, abs=0.005)
    assert header["CRVAL2"] == pytest.approx(20.0, abs=0.005)


@settings(max_examples=100, deadline=None)
@given(
    st.lists(
        st.tuples(st.floats(0, 0.3), st.floats(-0.2, 0.3), st.floats(0, 0.05), st.floats(0, 0.05)),
        min_size=2,
        max_size=5,
    ),
    st.floats(-1.5, 1.3),
)
def test_the_whole_holds_every_field(fields: list[tuple[float, ...]], declination: float) -> None:
    shifted = [
        (lon, lat + declination, w, h) for lon, lat, w, h in fields if abs(lat + declination) < 1.5
    ]
    if len({(f[0], f[1]) for f in shifted}) < 2:
        return
    lon, lat, width, height = whole_of(shifted, "map")
    axes = local_axes(lon, lat)
    for a, b, w, h in shifted:
        edge = np.linspace(-1, 1, 9)
        x, y = (v.ravel() for v in np.meshgrid(edge * w, edge * h))
        ahead, east, north = axes @ (np.stack([np.ones(81), x, y], axis=1) @ local_axes(a, b)).T
        assert abs(east / ahead).max() <= width + 1e-12
        assert abs(north / ahead).max() <= height + 1e-12


def test_one_field_is_the_whole_itself() -> None:
    assert whole_of([(1.0, 0.5, 0.01, 0.02)], "map") == (1.0, 0.5, 0.01, 0.02)


def test_targets_far_apart_want_healpix(sky: Path) -> None:
    far = daisy(targets=[A, "195 deg 40 deg"])
    with pytest.raises(InputError, match="too far for one image") as err:
        mapped(sky, [far], scene(), pixel="1 deg")
    assert "give nside for a HEALPix map" in err.value.cure
    with pytest.warns(UserWarning, match="no sample of scan-001"):
        found = mapped(sky, [far], scene(), nside=256)
    assert int(found.hits.sum()) == 2 * 400 * 19


def test_a_map_that_goes_with_the_target_is_told(sky: Path) -> None:
    data = zonda.Data(scene())
    daisy(targets=[A, B]).observe(data)
    with pytest.warns(UserWarning, match="is put on each of 2 targets, as a copy of its own"):
        zonda.SkyMap(file=sky, centre="target").check(data)


def test_its_own_coordinates_place_the_map_for_every_target(
    sky: Path, recwarn: pytest.WarningsRecorder
) -> None:
    """The same point of the sky is as bright in both fields: within the beam, pixels of 20 arcsec
    differ by few per cent.
    """
    one, other = (mapped(sky, [daisy(target=t)], scene(), **GRID) for t in (A, B))
    both = (one.hits > 3) & (other.hits > 3)
    assert both.sum() > 20
    assert one.signal[both] == pytest.approx(other.signal[both], rel=0.08)
    assert not [w for w in recwarn if "copy of its own" in str(w.message)]


def test_target_and_targets_exclude_each_other() -> None:
    with pytest.raises(ZondaError, match="give target, or targets for a mosaic"):
        daisy(target=A, targets=[B])
