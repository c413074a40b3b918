"""Pixels and angles that bands share of a block: taken only where they are the same, and maps as of each band alone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import zonda
from zonda.core.numerics.projection import frame_rotation
from zonda.core.polarization import PolarizationAngles
from zonda.core.shared import SharedScan
from zonda.operators.maps.grid import HealpixGrid
from zonda.operators.maps.looking import Looking
from zonda.plugins.checks.scenes import scan

FOOTPRINT = np.arange(int(12 * 1024**2 * 0.32), int(12 * 1024**2 * 0.34))
GRID = HealpixGrid(1024, False, FOOTPRINT)
N_DET, N = 5, 300


def band(shared: SharedScan | None) -> Any:
    observation = scan(N_DET, N)
    observation.focalplane.polarization_angle[:] = np.linspace(0, 3, N_DET)
    observation.focalplane.polarization_efficiency[:] = 0.9
    observation.hwp_angle = np.linspace(0, 40, N)
    return replace(observation, shared=shared)


def looking(observation: Any, grid: Any = GRID) -> Looking:
    pole = frame_rotation(grid.frame)[2]
    return Looking.of(observation, grid, PolarizationAngles.of(observation, observation.boresight_radec, pole))


def found(one: Looking, which: Any = (0, 2, 4)) -> list[Any]:
    return [make(np.array(which), 10, 200) for make in (one.pixels, one.turns)]


def test_a_band_takes_what_another_one_made_within_a_block() -> None:
    shared = SharedScan(10**6)
    one, other = (looking(band(shared)) for _ in range(2))
    with shared.block():
        first = found(one)
        assert (first[0] >= 0).all()
        for mine, theirs in zip(first, found(other), strict=True):
            assert mine is theirs
        assert all(mine is not theirs for mine, theirs in zip(first, found(other, (0, 2, 3)), strict=True))
    for mine, theirs in zip(first, found(other), strict=True):
        assert mine is not theirs
        np.testing.assert_array_equal(mine, theirs)
    assert shared.claim(10**6)


def test_there_is_no_key_without_other_bands() -> None:
    assert looking(band(None)).keys == ()


CHANGES = ["xi", "eta", "polarization_angle", "polarization_efficiency", "hwp_angle", "boresight_radec"]


@settings(deadline=None, max_examples=60)
@given(st.sampled_from([*CHANGES, "nside", "pixels", "frame", "plate"]), st.integers(0, 10**6), st.floats(1e-3, 1e-1))
def test_whatever_differs_bands_have_their_own(what: str, where: int, by: float) -> None:
    shared = SharedScan(10**6)
    plain, changed, grid = band(shared), band(shared), GRID
    if what in ("xi", "eta", "polarization_angle", "polarization_efficiency"):
        array = getattr(changed.focalplane, what)
        array[where % N_DET] -= by
    elif what == "plate":
        changed.hwp_angle = None
    elif what in CHANGES:
        array = getattr(changed, what).copy()
        array.flat[where % array.size] += by
        setattr(changed, what, array)
    elif what == "nside":
        grid = HealpixGrid(512, False, FOOTPRINT)
    elif what == "pixels":
        grid = HealpixGrid(1024, False, np.delete(FOOTPRINT, where % FOOTPRINT.size))
    else:
        grid = HealpixGrid(1024, False, FOOTPRINT, "galactic")
    alone = found(looking(replace(changed, shared=None), grid))
    with shared.block():
        found(looking(plain))
        beside = found(looking(changed, grid))
    for mine, expected in zip(beside, alone, strict=True):
        np.testing.assert_array_equal(mine, expected)


BANDS = (
    {"name": "f090", "low": "77 GHz", "high": "106 GHz", "net": "300 uK s(1/2)"},
    {"name": "f150", "low": "130 GHz", "high": "170 GHz", "net": "360 uK s(1/2)"},
)


class Spoilt(zonda.Operator):
    """A detector of one band is dead from here on, some samples are flagged, others are not finite or off the map."""

    requires = frozenset({"signal"})
    provides = frozenset({"signal"})

    def prepare(self, observation: zonda.Observation) -> None:
        if observation.instrument.band.name == "f150":
            observation.detector_flags[3] = 1
            observation.flags[700:900] |= 1

    def exec(self, block: zonda.Block, state: Any) -> None:
        if block.observation.instrument.band.name == "f090" and block.detectors.start == 0:
            block.detdata["signal"][2, ::50] = np.nan


def maps(bands: Any, how: Any) -> Any:
    camera = zonda.Instrument(
        name="camera", telescope={"name": "dish", "diameter": "6 m"}, detectors=38, field_of_view="20 arcmin",
        polarization="pairs", main_beam_efficiency=0.8, illumination_efficiency=0.9, sample_rate="50 Hz",
        bands=[dict(b) for b in bands],
    )  # fmt: skip
    scene = zonda.Scene(site="llano_de_chajnantor", instrument=camera, time="2022-08-01T23:00", target="260d -10d", seed=3)
    steps = [
        zonda.PointingDaisy(radius="15 arcmin", speed="10 arcmin/s", scan_duration="70 s"),
        zonda.AtmosphereLayers(pwv="1 mm", pwv_rms="2 %"), zonda.WhiteNoise(), zonda.Efficiency(), Spoilt(),
        zonda.BinMap(stokes="IQU", half_difference="directions", crosslinking=True, **how),
        zonda.BinMap(product="intensity", half_difference="halves", crosslinking=True, **how),
    ]  # fmt: skip
    return zonda.Pipeline(steps).run(scene)


def planes(product: Any) -> dict[str, Any]:
    found = {name: getattr(product, name) for name in ("signal", "hits", "weights", "noise", "half_difference", "crosslinking")}
    if product.polarization is not None:
        found |= {f"{name} of Q, U": getattr(product.polarization, name) for name in ("q", "u", "covariance", "half_difference")}
    return found


@pytest.mark.parametrize("how", [{"nside": 1024}, {"pixel": "3 arcmin"}, {"pixel": "3 arcmin", "projection": "CAR"}])
def test_maps_of_bands_side_by_side_are_those_of_each_alone(how: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[bool] = []
    of_block = SharedScan.of_block

    def noted(self: SharedScan, key: Any, size: int, make: Any) -> Any:
        made: list[int] = []
        answer = of_block(self, key, size, lambda: made.append(1) or make())
        taken.append(not made)
        return answer

    monkeypatch.setattr(SharedScan, "of_block", noted)
    together = maps(BANDS, how)
    assert 0.2 < np.mean(taken) < 0.9  # not in the tile where a detector is dead in one band
    for one in BANDS:
        alone = maps([one], how)
        for product in ("map", "intensity"):
            expected = planes(alone.products[f"{product}_{one['name']}"])
            for name, plane in planes(together.products[f"{product}_{one['name']}"]).items():
                np.testing.assert_array_equal(plane, expected[name], err_msg=f"{one['name']} {product} {name}")
        counted = {(who, what, value) for who, what, value in alone.tally if "BinMap" in who}
        assert counted <= {(who, what, value) for who, what, value in together.tally}
        assert any("dropped" in what for _, what, _ in counted)
