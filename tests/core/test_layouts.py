"""Where the pixels of a camera lie."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import zonda
from zonda.core import registry
from zonda.core.errors import ZondaError
from zonda.core.layouts import Layout, hexagon, hexagonal_packing, rings, wafers
from zonda.core.registry import instruments

CAMERA: dict[str, Any] = {
    "name": "camera",
    "telescope": {"name": "dish", "diameter": "6 m"},
    "band": {"name": "b150", "low": "140 GHz", "high": "160 GHz"},
    "field_of_view": "1 deg",
    "main_beam_efficiency": 0.6,
    "illumination_efficiency": 0.9,
    "net": "500 uK s(1/2)",
    "sample_rate": "20 Hz",
}


def nearest(x: Any, y: Any) -> Any:
    return (np.hypot(x[:, None] - x, y[:, None] - y) + 1e9 * np.eye(len(x))).min(axis=1)


def test_rings() -> None:
    x, y = rings(1 + 6 + 12 + 5)
    radii, counts = np.unique(np.hypot(x, y).round(9), return_counts=True)
    np.testing.assert_array_equal(radii, [0, 1, 2, 3])
    np.testing.assert_array_equal(counts, [1, 6, 12, 5])
    last = np.sort(np.arctan2(y[-5:], x[-5:]) % (2 * np.pi))
    np.testing.assert_allclose(np.diff(last), 2 * np.pi / 5)
    assert len(rings(1)[0]) == 1


@pytest.mark.parametrize("shells", [0, 1, 2, 5])
def test_a_hexagon_is_whole_with_the_numbers_of_a_hexagon(shells: int) -> None:
    n = 1 + 3 * shells * (shells + 1)
    x, y = hexagon(n)
    assert np.abs(x).max() == pytest.approx(shells)  # a corner on the x axis
    assert np.abs(y).max() == pytest.approx(shells * np.sqrt(3) / 2)  # an edge towards y
    if shells > 1:  # the six corners lie farther out than what a round patch of as many has
        assert np.hypot(x, y).max() >= np.hypot(*hexagonal_packing(n)).max()


@pytest.mark.parametrize(("number", "shells"), [(1, 3), (3, 2), (7, 4), (12, 2), (19, 1)])
def test_wafers_do_not_overlap_and_are_alike(number: int, shells: int) -> None:
    each = 1 + 3 * shells * (shells + 1)
    x, y, wafer = wafers(number * each, number)
    np.testing.assert_array_equal(np.bincount(wafer), each)
    np.testing.assert_allclose(nearest(x, y), 1)  # the pitch; between wafers there is more
    if number > 1:
        apart = [
            np.hypot(x[wafer == 0][:, None] - x[wafer == k], y[wafer == 0][:, None] - y[wafer == k])
            for k in range(1, number)
        ]
        assert 1 < min(a.min() for a in apart) < 1.5
    assert abs(x.mean()) < 1e-9 * number * each
    assert abs(y.mean()) < 1e-9 * number * each


@pytest.mark.parametrize("layout", ["hexagon", "rings", "wafers"])
def test_all_layouts_fill_the_field(layout: str) -> None:
    many = {"wafers": 3} if layout == "wafers" else {}
    plane = zonda.Instrument(
        **CAMERA, detectors=114, layout=layout, polarization="pairs", **many
    ).focalplane()
    assert len(plane) == 114
    assert 2 * np.arctan(plane.radius) == pytest.approx(np.radians(1))
    np.testing.assert_array_equal(np.bincount(plane.wafer), [38, 38, 38] if many else [114])


def test_wafers_of_two_bands_lie_upon_each_other() -> None:
    bands = [
        {"name": "f090", "low": "80 GHz", "high": "100 GHz"},
        {"name": "f150", "low": "140 GHz", "high": "160 GHz"},
    ]
    given = {k: v for k, v in CAMERA.items() if k != "band"} | {
        "bands": bands,
        "detectors": 21,
        "layout": "wafers",
        "wafers": 3,
    }
    plane = zonda.Instrument(**given).focalplane()
    one, other = plane.of_band(0), plane.of_band(1)
    np.testing.assert_array_equal(one.xi, other.xi)
    np.testing.assert_array_equal(one.wafer, other.wafer)


def test_overlaid_bands_fill_the_same_field_each_by_itself() -> None:
    bands = [
        {"name": "f090", "low": "80 GHz", "high": "100 GHz", "detectors": 19},
        {"name": "f150", "low": "140 GHz", "high": "160 GHz", "detectors": 61},
    ]
    given = {k: v for k, v in CAMERA.items() if k != "band"} | {
        "bands": bands,
        "pixels": "overlaid",
    }
    camera = zonda.Instrument(**given)
    plane = camera.focalplane()
    for k, (name, count) in enumerate({"f090": 19, "f150": 61}.items()):
        own = plane.of_band(k)
        assert len(own) == count
        assert 2 * np.arctan(own.radius) == pytest.approx(np.radians(1))
        np.testing.assert_array_equal(own.xi, camera.cameras[name].focalplane().xi)


def test_a_layout_of_a_plugin_has_places_angles_and_wafers() -> None:
    def cross(number: int) -> Layout:
        return Layout(
            np.arange(number) - 1.5,
            np.zeros(number),
            np.arange(number) // 2,
            np.full(number, 0.3),
            radius=3.0,
        )

    cross.wafers = 2  # type: ignore[attr-defined]
    registry.layouts.register(cross)
    plane = zonda.Instrument(
        **CAMERA, detectors=8, layout="cross", polarization="pairs"
    ).focalplane()
    scale = np.tan(np.radians(0.5)) / 3
    np.testing.assert_allclose(plane.xi, np.repeat([-1.5, -0.5, 0.5, 1.5], 2) * scale)
    np.testing.assert_allclose(plane.polarization_angle, np.tile([0.3, 0.3 + np.pi / 2], 4))
    np.testing.assert_array_equal(plane.wafer, [0, 0, 0, 0, 1, 1, 1, 1])
    with pytest.raises(
        ZondaError, match="2 wafers share their pixels equally; detectors is 6, no multiple of 4"
    ):
        zonda.Instrument(**CAMERA, detectors=6, layout="cross", polarization="pairs")
    registry.layouts.register(lambda number: cross(number + 1), name="cross")
    with pytest.raises(ZondaError, match="the layout cross gives 9 places for 8 pixels"):
        zonda.Instrument(**CAMERA, detectors=8, layout="cross").focalplane()


def test_an_unknown_layout() -> None:
    with pytest.raises(ZondaError, match=r"unknown layout 'ring'(.|\n)*did you mean 'rings'"):
        zonda.Instrument(**CAMERA, detectors=7, layout="ring")
    with pytest.raises(ZondaError, match=r"unknown layout 'so_lat_m'(.|\n)*did you mean 'so_lat_"):
        zonda.Instrument(**CAMERA, detectors=7, layout="so_lat_m")


def test_a_published_layout_with_fewer_pixels_keeps_its_wafers() -> None:
    whole, part = (
        instruments.create("so_lat_mf").varied(detectors=n).cameras["f090"].focalplane()
        for n in (10_320, 288)
    )
    for k in range(12):
        one, other = (
            np.stack([p.xi[p.wafer == k], p.eta[p.wafer == k]]).mean(axis=1) for p in (whole, part)
        )
        assert (
            np.degrees(np.abs(one - other)).max() < 0.05
        )  # of 2 deg: both fill the field, by 2 % of stretch


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (
            {"detectors": 22, "layout": "wafers", "wafers": 3},
            "3 wafers share their pixels equally; detectors is 22",
        ),
        ({"detectors": 21, "wafers": 3}, "3 wafers go with layout: wafers, not hexagon"),
    ],
)
def test_wafers_that_do_not_fit(given: dict[str, Any], words: str) -> None:
    with pytest.raises(ZondaError, match=words):
        zonda.Instrument(**CAMERA, **given)
