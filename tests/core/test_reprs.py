"""What is shown of operators, scenes and hardware is in units that people use, and makes an equal
one again.
"""

from __future__ import annotations

from typing import Any

import pytest

import zonda

SCENE = {
    "site": "green_bank",
    "instrument": "mustang2",
    "time": "2024-11-25T07:00",
    "target": "05h +20d",
}


def scene(**changes: Any) -> zonda.Scene:
    return zonda.Scene(**{**SCENE, **changes})


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: zonda.BinMap(pixel="2 arcsec"), "BinMap(pixel='2 arcsec')"),
        (
            lambda: zonda.PointingDaisy(
                radius="4 arcmin", speed="51 arcsec/s", target="az 100 deg el 60 deg"
            ),
            "PointingDaisy(target='az 100 deg el 60 deg', radius='4 arcmin', speed='51 arcsec/s')",
        ),
        (
            lambda: zonda.PointingDaisy(offsets=[("1 arcmin", "2 arcmin")]),
            "PointingDaisy(offsets=[['1 arcmin', '2 arcmin']])",
        ),
        (
            lambda: zonda.WhiteNoise(net="1.7 mK s(1/2)", scatter="10 %"),
            "WhiteNoise(net='1.7 mK s(1/2)', scatter=0.1)",
        ),
        (lambda: zonda.WhiteNoise(model={"name": "background_limited", "modes": 2}), "'modes': 2"),
        (
            lambda: zonda.AtmosphereLayers(pwv="7.7 mm", layers=1),
            "AtmosphereLayers(pwv='7.7 mm', layers=1)",
        ),
        (lambda: zonda.HighpassFilter(frequency="0.08 Hz"), "HighpassFilter(frequency='80 mHz')"),
        (lambda: zonda.SaveMap(), "SaveMap()"),
        (lambda: zonda.BinMap(pixel=9.8e-6 * 2 * u_rad()), "BinMap(pixel='1.96e-05 rad')"),
        (
            scene,
            (
                "Scene(site='green_bank', instrument='mustang2', time='2024-11-25T07:00:00Z',"
                " target='icrs 75 deg 20 deg')"
            ),
        ),
        (lambda: scene(weather={"pwv": "1.2 mm"}), "'pwv': '1.2 mm'"),
        (
            lambda: scene(site=zonda.Site(name="x", latitude="1 deg", longitude="2 deg")),
            "site=Site(name='x', latitude='1 deg'",
        ),
        (lambda: scene().site, "altitude='825 m'"),
        (lambda: scene().instrument, "fwhm='8.5 arcsec'"),
        (
            lambda: scene().instrument.telescope,
            "Telescope(name='GBT', diameter='100 m', site='green_bank'",
        ),
        (
            lambda: scene().instrument.band,
            "Band(name='mustang2_90ghz', low='78 GHz', high='108 GHz'",
        ),
    ],
)
def test_a_repr_reads_back_to_an_equal_thing(make: Any, text: str) -> None:
    thing = make()
    assert text in repr(thing)
    assert str(thing) == repr(thing)
    names = {name: getattr(zonda, name) for name in dir(zonda) if name[0].isupper()}
    again = eval(repr(thing), names)
    assert type(again) is type(thing)
    assert again == thing
    assert f"<caption>{type(thing).__name__}</caption>" in thing._repr_html_()


def u_rad() -> Any:
    import astropy.units as u

    return u.rad


def test_notebooks_show_defaults_too() -> None:
    html = zonda.PointingDaisy(radius="2 arcmin")._repr_html_()
    assert "&#39;2 arcmin&#39;" in html
    assert "50 arcsec/s (default)" in html


def test_a_registered_name_that_stands_for_another_thing_is_not_written() -> None:
    mine = zonda.Site(name="green_bank", latitude="1 deg", longitude="2 deg")
    assert "site=Site(name='green_bank', latitude='1 deg'" in repr(scene(site=mine))
