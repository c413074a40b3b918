"""Pixels that bands have in common: found once only where they are the same, and maps as of each
band alone.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import zonda
from zonda.operators.maps import binning
from zonda.operators.maps.grid import HealpixGrid, Looking
from zonda.plugins.checks.scenes import scan

FOOTPRINT = np.arange(int(12 * 1024**2 * 0.32), int(12 * 1024**2 * 0.34))
GRID = HealpixGrid(1024, False, FOOTPRINT)
N_DET, N = 5, 300


def band() -> Any:
    return replace(scan(N_DET, N), common={})


def test_there_is_no_key_without_other_bands() -> None:
    assert Looking.of(replace(band(), common=None), GRID).key is None


def test_bands_that_look_alike_have_one_key() -> None:
    assert Looking.of(band(), GRID).key == Looking.of(band(), GRID).key


@settings(deadline=None, max_examples=60)
@given(
    st.sampled_from(["xi", "eta", "boresight_radec", "nside", "nest", "pixels", "frame"]),
    st.integers(0, 10**6), st.floats(1e-3, 1e-1),
)  # fmt: skip
def test_whatever_differs_bands_have_their_own(what: str, where: int, by: float) -> None:
    plain, changed, grid = band(), band(), GRID
    if what in ("xi", "eta"):
        getattr(changed.focalplane, what)[where % N_DET] -= by
    elif what == "boresight_radec":
        changed.boresight_radec = changed.boresight_radec.copy()
        changed.boresight_radec.flat[where % changed.boresight_radec.size] += by
    else:
        nside, footprint = 512 if what == "nside" else 1024, FOOTPRINT
        if what == "pixels":
            footprint = np.delete(FOOTPRINT, where % FOOTPRINT.size)
        grid = HealpixGrid(
            nside, what == "nest", footprint, "galactic" if what == "frame" else "icrs"
        )
    assert Looking.of(changed, grid).key != Looking.of(plain, GRID).key


BANDS = (
    {"name": "f090", "low": "77 GHz", "high": "106 GHz", "net": "300 uK s(1/2)"},
    {"name": "f150", "low": "130 GHz", "high": "170 GHz", "net": "360 uK s(1/2)"},
)


class Spoilt(zonda.Operator):
    """A detector of one band is dead from here on, some samples are flagged, others are not finite
    or off the map.
    """

    requires = frozenset({"signal"})
    provides = frozenset({"signal"})
    what: str = "dead flagged nan"

    def prepare(self, observation: zonda.Observation) -> None:
        if observation.instrument.band.name == "f150":
            if "dead" in self.what:
                observation.detector_flags[3] = 1
            if "flagged" in self.what:
                observation.flags[700:900] |= 1

    def exec(self, block: zonda.Block, state: Any) -> None:
        if (
            "nan" in self.what
            and block.observation.instrument.band.name == "f090"
            and block.detectors.start == 0
        ):
            block.detdata["signal"][2, ::50] = np.nan


def scene(bands: Any) -> zonda.Scene:
    camera = zonda.Instrument(
        name="camera",
        telescope={"name": "dish", "diameter": "6 m"},
        detectors=38,
        field_of_view="20 arcmin",
        polarization="pairs",
        main_beam_efficiency=0.8,
        illumination_efficiency=0.9,
        sample_rate="50 Hz",
        bands=[dict(b) for b in bands],
    )
    return zonda.Scene(
        site="llano_de_chajnantor",
        instrument=camera,
        time="2022-08-01T23:00",
        target="260d -10d",
        seed=3,
    )


def maps(bands: Any, how: Any, steps: Any = (Spoilt(),)) -> Any:
    steps = [
        zonda.PointingDaisy(radius="15 arcmin", speed="10 arcmin/s", scan_duration="70 s"),
        zonda.AtmosphereLayers(pwv="1 mm", pwv_rms="2 %"),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        *steps,
        zonda.BinMap(stokes="IQU", half_difference="directions", crosslinking=True, **how),
        zonda.BinMap(product="intensity", half_difference="halves", crosslinking=True, **how),
    ]
    return zonda.Pipeline(steps).run(scene(bands))


def planes(product: Any) -> dict[str, Any]:
    found = {
        name: getattr(product, name)
        for name in ("signal", "hits", "weights", "noise", "half_difference", "crosslinking")
    }
    if product.polarization is not None:
        found |= {
            f"{name} of Q, U": getattr(product.polarization, name)
            for name in ("q", "u", "covariance", "half_difference")
        }
    return found


@pytest.mark.parametrize(
    "how", [{"nside": 1024}, {"pixel": "3 arcmin"}, {"pixel": "3 arcmin", "projection": "CAR"}]
)
def test_maps_of_bands_side_by_side_are_those_of_each_alone(
    how: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[int] = []
    pixels = Looking.pixels

    def noted(self: Looking, which: Any, start: int, stop: int) -> Any:
        found.append(len(which) * (stop - start))
        return pixels(self, which, start, stop)

    monkeypatch.setattr(Looking, "pixels", noted)
    together = maps(BANDS, how)
    both, found[:] = sum(found), []
    assert_as_alone(together, how, (Spoilt(),))
    assert both < 0.9 * sum(found)  # not in the tile where a detector is dead in one band


def assert_as_alone(together: Any, how: Any, steps: Any) -> None:
    for one in BANDS:
        alone = maps([one], how, steps)
        for product in ("map", "intensity"):
            expected = planes(alone.products[f"{product}_{one['name']}"])
            for name, plane in planes(together.products[f"{product}_{one['name']}"]).items():
                np.testing.assert_array_equal(
                    plane, expected[name], err_msg=f"{one['name']} {product} {name}"
                )
        counted = {(who, what, value) for who, what, value in alone.log if "BinMap" in who}
        assert counted <= {(who, what, value) for who, what, value in together.log}
        assert any("dropped" in what for _, what, _ in counted)


@pytest.mark.parametrize("weights", ["inverse_variance", "uniform"])
@pytest.mark.parametrize(
    ("spoilt", "shares"), [("", 1.0), ("nan", 1.0), ("dead", 0.7), ("flagged", 0.0)]
)
def test_samples_of_bands_go_to_their_maps_together(
    spoilt: str, shares: float, weights: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Behind a step that needs whole scans, whose blocks stay. One of five tiles has the detector
    that is dead in one band.
    """
    taken, add = [], binning.add_stokes

    def noted(signals: Any, *others: Any) -> None:
        taken.append(len(others[-1]))
        add(signals, *others)

    monkeypatch.setattr(binning, "add_stokes", noted)
    how, steps = (
        {"nside": 1024, "weights": weights},
        (Spoilt(what=spoilt), zonda.PolynomialFilter(order=1)),
    )
    together = maps(BANDS, how, steps)
    assert set(taken) <= {1, 2}
    assert taken.count(2) / len(taken) == pytest.approx(shares, abs=0.2 if 0 < shares < 1 else 0)
    assert_as_alone(together, how, steps)


def test_streams_that_are_made_again_for_neighbours_give_the_same_maps() -> None:
    """A map before a step that reads its neighbours' samples, from streams that are made again."""

    def run(**options: Any) -> Any:
        steps = [
            zonda.PointingDaisy(radius="15 arcmin", speed="10 arcmin/s", scan_duration="1800 s"),
            zonda.WhiteNoise(),
            zonda.Efficiency(),
            zonda.Crosstalk(),
            zonda.BinMap(product="before", stokes="IQU", nside=256),
            zonda.TimeConstant(tau="50 ms"),
            zonda.BinMap(product="after", stokes="IQU", nside=256),
        ]
        return zonda.Pipeline(steps).run(scene(BANDS), threads=1, **options)

    ample = run()
    little = run(memory=24_000_000)
    assert any("made again" in f"{what} {text}" for _, what, text in little.log)
    for name in ("before_f090", "before_f150", "after_f090", "after_f150"):
        for plane, expected in planes(ample.products[name]).items():
            np.testing.assert_array_equal(
                planes(little.products[name])[plane], expected, err_msg=f"{name} {plane}"
            )
