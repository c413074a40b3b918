"""Variants of registered instruments: `{like: mustang2, detectors: 170}`."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import zonda
from zonda.core.configuration.diagnostics import ConfigurationError
from zonda.core.configuration.pipeline_file import parse
from zonda.core.configuration.schema import json_schema
from zonda.core.instrument import Instrument
from zonda.core.registry import instruments
from zonda.core.variants import variant

TEXT = """
site: green_bank
instrument: {like: mustang2, detectors: 170}
time: 2024-11-25T07:00
target: 05h +20d
operators:
  - PointingDaisy: {scan_duration: 5 s}
  - WhiteNoise
  - Efficiency
  - BinMap
"""


@pytest.fixture
def base() -> Instrument:
    made: Instrument = instruments.create("mustang2")
    return made


def scene(**instrument: Any) -> zonda.Scene:
    return zonda.Scene(
        site="green_bank", instrument=instrument, time="2024-11-25T07:00", target="05h +20d"
    )


def test_it_differs_in_what_was_changed_alone(base: Instrument) -> None:
    made = scene(like="mustang2", detectors=170).instrument
    assert (made.detectors, len(made.focalplane())) == (170, 170)
    texts = {"name", "description", "provenance", "detectors"}
    assert made.model_dump(exclude=texts) == base.model_dump(exclude=texts)
    assert made.telescope.site == "green_bank"
    assert made.name == "mustang2 (detectors 170)"
    assert made.provenance.startswith(
        "mustang2 with detectors 170 instead of detectors 223; van Marrewijk"
    )
    assert made == base.varied(detectors=170)


def test_a_variant_that_changes_nothing_is_the_instrument_itself(base: Instrument) -> None:
    assert scene(like="MUSTANG-2").instrument == base
    assert scene(like="mustang2", detectors=223, field_of_view="252 arcsec").instrument == base


def test_its_name_does_not_depend_on_how_units_are_written() -> None:
    one, other = (
        scene(like="mustang2", net=net).instrument for net in ("1 mK s(1/2)", "1000 uK s(1/2)")
    )
    assert one.name == other.name == "mustang2 (net 1 mK s(1/2))"
    many = scene(
        like="mustang2", net="1 mK s(1/2)", knee="1 Hz", slope=2, sample_rate="50 Hz", detectors=7
    ).instrument
    assert many.name.startswith("mustang2 (variant ")
    assert "sample_rate 50 Hz" in many.description


def test_it_has_random_numbers_of_its_own_unless_it_keeps_the_name(base: Instrument) -> None:
    assert base.varied(detectors=170).identity != base.identity
    assert base.varied(detectors=170, name="mustang2").identity == base.identity


def test_the_beam_follows_aperture_and_band(base: Instrument) -> None:
    """lambda / D: half the dish, twice the beam; the ratio to the diffraction limit stays."""
    assert np.isclose(
        base.varied(telescope={"diameter": "50 m"}).beam_fwhm, 2 * base.beam_fwhm, rtol=1e-12
    )
    band = {
        "name": "low",
        "low": "39 GHz",
        "high": "54 GHz",
    }  # centre: half of that of 78 to 108 GHz
    assert np.isclose(base.varied(band=band).beam_fwhm, 2 * base.beam_fwhm, rtol=1e-12)
    assert np.isclose(
        base.varied(telescope={"diameter": "50 m"}, fwhm="9 arcsec").beam_fwhm,
        np.radians(9 / 3600),
        rtol=1e-12,
    )
    limited = instruments.create("ccat")  # states no fwhm
    assert np.isclose(
        limited.varied(telescope={"diameter": "3 m"}).beam_fwhm, 2 * limited.beam_fwhm, rtol=1e-12
    )


def test_a_telescope_keeps_what_is_not_named(base: Instrument) -> None:
    made = base.varied(telescope={"elevation_min": "20 deg"}).telescope
    assert made == base.telescope.model_copy(update={"elevation_min": np.radians(20.0)})


@pytest.mark.parametrize("how", ["file", "set", "set on a name", "telescope"])
def test_resolved_yaml_says_what_it_is_and_loads_again(how: str) -> None:
    text, settings = TEXT, ()
    if how == "set":
        settings = ("instrument.detectors=30",)
    if how == "set on a name":
        text, settings = (
            TEXT.replace("{like: mustang2, detectors: 170}", "mustang2"),
            ("instrument.knee=1 Hz",),
        )
    if how == "telescope":
        settings = ("instrument.telescope.elevation_min=20 deg",)
    file = parse(text, overrides=settings)
    resolved = file.resolved_yaml()
    assert "\n  like: mustang2\n" in resolved
    again = parse(resolved)
    assert again.scene().instrument == file.scene().instrument
    assert again.resolved_yaml() == resolved
    assert f"name: {file.scene().instrument.name}" in resolved.partition("x-resolved")[2]


@pytest.mark.parametrize(
    ("setting", "message", "label"),
    [
        (
            "instrument.detectrs=3",
            "unknown key 'detectrs' for the pipeline, instrument",
            "did you mean 'detectors'?",
        ),
        (
            "instrument.telescope.diamter=3 m",
            "unknown key 'diamter' for the pipeline, instrument.telescope",
            "'diameter'?",
        ),
        ("instrument.like=mustng2", "unknown instrument 'mustng2'", "did you mean 'mustang2'?"),
        (
            "instrument.band=mustang_90ghz",
            "unknown band 'mustang_90ghz'",
            "did you mean 'mustang2_90ghz'?",
        ),
        (
            "instrument.detectors=0",
            "the pipeline, instrument.detectors: must be at least 1, got 0",
            "",
        ),
        (
            "instrument.like=7",
            "the pipeline, instrument: like takes the name of an instrument, not 7",
            "",
        ),
    ],
)
def test_mistakes_name_the_field_and_what_exists(setting: str, message: str, label: str) -> None:
    with pytest.raises(ConfigurationError) as err:
        parse(TEXT, overrides=[setting])
    (found,) = err.value.diagnostics
    assert message in found.message
    assert label in found.label


def test_the_schema_knows_variants() -> None:
    import jsonschema

    header = {"site": "green_bank", "time": "2024-11-25", "operators": ["PointingDaisy"]}
    validator = jsonschema.Draft202012Validator(json_schema())
    for instrument, valid in (
        (
            {
                "like": "mustang2",
                "detectors": 170,
                "telescope": {"diameter": "50 m"},
                "band": "atlast_92ghz",
            },
            True,
        ),
        ({"like": "mustang2", "detectrs": 170}, False),
    ):
        assert validator.is_valid({**header, "instrument": instrument}) is valid


def test_products_tell_of_it() -> None:
    data = zonda.Pipeline(parse(TEXT).operators).run(parse(TEXT).scene(), threads=1)
    assert data.observations[0].instrument.name == "mustang2 (detectors 170)"
    assert data.observations[0].n_detectors == 170


def test_only_an_instrument_has_variants(base: Instrument) -> None:
    assert not hasattr(base.band, "varied")
    with pytest.raises(ValueError, match="like takes the name of an instrument"):
        variant({"like": base.band})


def test_what_is_changed_for_a_camera_of_several_bands_holds_for_all_of_them() -> None:
    made = instruments.create("act_pa5").varied(net="1 mK s(1/2)", detectors=10, fwhm="3 arcmin")
    for camera in made.cameras.values():
        assert (camera.net, camera.detectors) == (1e-3, 10)
        assert np.isclose(camera.beam_fwhm, np.radians(3 / 60), rtol=1e-12)
    assert len(made.focalplane()) == 20


def test_bands_by_the_names_of_the_instruments() -> None:
    base = instruments.create("so_lat_mf")
    made = base.varied(bands=[{"name": "f090", "net": "1 mK s(1/2)"}, "f150"])
    assert made.cameras["f090"].net == 1e-3
    assert made.cameras["f090"].band == base.cameras["f090"].band
    assert made.cameras["f150"].net == base.cameras["f150"].net
    assert list(base.varied(bands=["f150"]).cameras) == ["f150"]
    own = base.varied(
        bands=[
            {
                "name": "f090",
                "low": "80 GHz",
                "high": "90 GHz",
                "net": "1 mK s(1/2)",
                "detectors": 24,
            }
        ]
    )
    assert own.cameras["f090"].band.low == 80e9


def test_a_layout_without_wafers_has_none() -> None:
    made = instruments.create("so_lat_mf").varied(layout="hexagon", detectors=170)
    assert (made.wafers, set(made.focalplane().wafer)) == (1, {0})


@pytest.mark.parametrize(
    ("changes", "at", "message", "cure"),
    [
        (
            "detectors: 170",
            "170",
            "12 wafers share their pixels equally; detectors of f090 is 170",
            "write 168 or 192",
        ),
        (
            "detectors: 2",
            "2",
            "12 wafers share their pixels equally; detectors of f090 is 2",
            "write 24,",
        ),
        (
            "detectors: 171, layout: hexagon",
            "171",
            "needs an even number of detectors",
            "write 170 or 172",
        ),
        ("band: f091", "f091", "so_lat_mf has no band 'f091'", "its bands: f090, f150"),
        (
            "bands: [f150, {name: f091, net: 1 mK s(1/2)}]",
            "f091",
            "so_lat_mf has no band 'f091'",
            "low, high or file",
        ),
        (
            "layout: rings, wafers: 3",
            "3",
            "3 wafers go with layout: wafers, not rings",
            "write layout: wafers",
        ),
    ],
)
def test_mistakes_stand_at_what_is_wrong(changes: str, at: str, message: str, cure: str) -> None:
    with pytest.raises(ConfigurationError) as err:
        parse(TEXT.replace("{like: mustang2, detectors: 170}", f"{{like: so_lat_mf, {changes}}}"))
    (found,) = err.value.diagnostics
    assert message in found.message
    assert cure in found.help
    assert found.render().splitlines()[4].count("^") == len(at)
    if "band" in changes:
        assert "did you mean" in found.label
