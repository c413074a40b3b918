"""Cameras of several bands: each band has the bits that it has alone, products and files bear its
name.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

import zonda
from zonda.core.configuration.diagnostics import ConfigurationError
from zonda.core.configuration.pipeline_file import parse
from zonda.core.errors import ZondaError
from zonda.core.maps.map_product import MapProduct
from zonda.core.numerics.radiation import to_kelvin_rj
from zonda.core.plan.planning import planning_of
from zonda.core.registry import bands

BANDS: dict[str, dict[str, Any]] = {
    "f090": {"low": "77 GHz", "high": "106 GHz", "net": "300 uK s(1/2)", "knee": "0.5 Hz"},
    "f150": {"low": "130 GHz", "high": "170 GHz", "net": "360 uK s(1/2)", "fwhm": "1.4 arcmin"},
}
PLANES = ("signal", "hits", "weights", "noise", "half_difference")
PIXELS = 19


def camera(*names: str, **changes: Any) -> zonda.Instrument:
    """6 m, with these bands."""
    common = {
        "name": "camera",
        "telescope": {"name": "dish", "diameter": "6 m"},
        "detectors": PIXELS,
        "field_of_view": "20 arcmin",
        "main_beam_efficiency": 0.8,
        "illumination_efficiency": 0.9,
        "sample_rate": "50 Hz",
    }
    if len(names) > 1:
        return zonda.Instrument(
            **common, bands=[{"name": name, **BANDS[name]} for name in names], **changes
        )
    own = dict(BANDS[names[0]])
    band = {"name": names[0], "low": own.pop("low"), "high": own.pop("high")}
    return zonda.Instrument(**common, band=band, **own, **changes)


def scene(*names: str, **changes: Any) -> zonda.Scene:
    instrument = camera(*names, **changes)
    return zonda.Scene(
        site="llano_de_chajnantor",
        instrument=instrument,
        time="2022-08-01T23:00",
        target="260d -10d",
        seed=3,
    )


def pipeline(*more: zonda.Operator, without: tuple[type, ...] = ()) -> zonda.Pipeline:
    values = np.zeros((64, 64))
    values[30, 34] = 1e-4
    steps = [
        zonda.PointingDaisy(radius="15 arcmin", speed="10 arcmin/s", scan_duration="30 s", scans=2),
        zonda.SkyMap(map=values, unit="K_CMB", pixel_size="30 arcsec", centre="target"),
        zonda.AtmosphereLayers(pwv="1 mm", pwv_rms="2 %"),
        zonda.WhiteNoise(scatter="10 %"),
        zonda.PinkNoise(),
        zonda.Efficiency(calibration_error="3 %"),
        zonda.HighpassFilter(frequency="0.2 Hz"),
        zonda.CommonModeFilter(),
        zonda.BinMap(pixel="1 arcmin"),
        *more,
    ]
    runs = {"noiseless": {"only": ["sky"], "modes": "full"}}
    return zonda.Pipeline([s for s in steps if not isinstance(s, without)], runs=runs)


@pytest.fixture(scope="module")
def both() -> Any:
    return pipeline().run(scene("f090", "f150"), keep=["signal", "white", "atmosphere"], threads=1)


@pytest.mark.parametrize("name", BANDS)
def test_a_band_alone_has_the_bits_that_it_has_beside_another(both: Any, name: str) -> None:
    """Noise, its scatter, the calibration error, sky, atmosphere and filters: all of the maps."""
    alone = pipeline().run(scene(name), keep=["signal"], threads=2)
    for product in ("map", "noiseless/map"):
        for plane in PLANES:
            one, other = getattr(alone[product], plane), getattr(both[f"{product}_{name}"], plane)
            np.testing.assert_array_equal(one, other)
    for scan in range(2):
        np.testing.assert_array_equal(
            alone.tod(scan=scan), both.tod(scan=f"scan-{scan:03d}-{name}")
        )
    assert both[f"map_{name}"].band.name == name
    assert both[f"map_{name}"].fwhm == alone["map"].fwhm


def test_bands_see_one_atmosphere_and_have_noise_of_their_own(both: Any) -> None:
    """The fluctuation of the emission, detector by detector, at 6 m: > 0.999 although the beams
    differ. White noise: correlated by 0 within 4 standard errors, n^-1/2."""
    scans = [next(o for o in both.observations if o.name == f"scan-000-{name}") for name in BANDS]
    streams = [[o.detdata[what].astype(float) for o in scans] for what in ("atmosphere", "white")]
    one, other = (x - x.mean(axis=1, keepdims=True) for x in streams[0])
    correlation = (one * other).sum(1) / np.sqrt((one**2).sum(1) * (other**2).sum(1))
    assert correlation.min() > 0.999
    one, other = streams[1]
    assert abs((one * other).sum() / np.sqrt((one**2).sum() * (other**2).sum())) < 4 / one.size**0.5


def test_products_scans_and_the_log_bear_the_bands_names(both: Any) -> None:
    assert {
        "map_f090",
        "map_f150",
        "noiseless/map_f090",
        "noiseless/map_f150",
        "input_f090",
    } <= set(both)
    assert [o.name for o in both.observations] == [
        f"scan-00{k}-{name}" for k in range(2) for name in BANDS
    ]
    assert [(o.name, o.n_detectors) for o in both.scans] == [
        ("scan-000", 2 * PIXELS),
        ("scan-001", 2 * PIXELS),
    ]
    assert both.log.get("BinMap f090", "samples binned") == both["map_f090"].hits.sum()
    ratio = np.nanmax(both["input_f090"].values) / np.nanmax(both["input_f150"].values)
    kelvin = [to_kelvin_rj("K_CMB", camera(name).band) for name in BANDS]
    assert ratio == pytest.approx(kelvin[0] / kelvin[1], rel=1e-12)


def test_files_per_band(tmp_path: Path) -> None:
    steps = [getattr(zonda, name)() for name in ("ModeSpectrum", "SaveMap", "Report", "SaveTOD")]
    transfer = zonda.TransferFunction(bins=3)
    made = pipeline(
        transfer, zonda.MeasureFigures(metrics=["central_rms"]), *steps, without=(zonda.PinkNoise,)
    )
    data = made.run(scene("f090", "f150"), output=tmp_path, threads=1)
    for name in BANDS:
        header = fits.getheader(tmp_path / f"map_{name}.fits")
        assert header["BAND"] == name
        assert header["RESTFRQ"] == pytest.approx(camera(name).band.centre)
        assert header["NSCANS"] == 2
        assert (tmp_path / f"noiseless_map_{name}.fits").exists()
        assert (tmp_path / f"transfer_function_{name}.ecsv").exists()
        assert (tmp_path / f"modes_{name}.ecsv").exists()
        assert (tmp_path / f"tod_scan-001-{name}.h5").exists()
        assert f"central_rms {name}" in [f.name for f in data[f"figures_{name}"]]
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "Band f090" in page
    assert "Band f150" in page
    assert "19 + 19 detectors" in page


def test_arrays_side_by_side() -> None:
    plane = camera("f090", "f150", pixels="separate").focalplane()
    one, other = (np.stack([plane.xi, plane.eta])[:, plane.band == k] for k in (0, 1))
    assert (
        np.hypot(*(one[:, :, None] - other[:, None])).min() > 0
    )  # no detector of one where there is one of the other
    assert 2 * np.arctan(plane.radius) <= np.radians(20 / 60) * (1 + 1e-9)


def test_values_of_the_instrument_hold_for_bands_that_do_not_state_theirs() -> None:
    made = camera("f090", "f150", slope=1.5, knee="0.1 Hz").cameras
    assert [c.slope for c in made.values()] == [1.5, 1.5]
    assert [c.knee for c in made.values()] == [0.5, 0.1]
    assert made["f090"].beam_fwhm == camera("f090").beam_fwhm  # the diffraction limit
    assert made["f150"].beam_fwhm == pytest.approx(np.radians(1.4 / 60))


def test_one_band_of_several_is_chosen_by_its_name() -> None:
    whole = camera("f090", "f150")
    for chosen in (
        whole.varied(band="f150"),
        zonda.Instrument(**whole.model_dump(mode="json") | {"band": "f150"}),
    ):
        assert chosen == whole.cameras["f150"]
        assert chosen.identity == camera("f150").identity
    assert whole.varied(detectors=7).cameras["f150"].detectors == 7


def test_a_variant_with_another_dish_keeps_the_ratio_to_the_diffraction_limit() -> None:
    wide = camera("f090", "f150").varied(telescope={"diameter": "3 m"}).cameras
    assert wide["f150"].beam_fwhm == pytest.approx(2 * np.radians(1.4 / 60))
    assert wide["f090"].beam_fwhm == pytest.approx(2 * camera("f090").beam_fwhm)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"bands": [{"name": "a", **BANDS["f090"]}, {"name": "a", **BANDS["f150"]}]},
            "two bands are called a",
        ),
        (
            {
                "bands": [
                    {"name": "a", **BANDS["f090"]},
                    {"name": "b", **BANDS["f150"], "detectors": 7},
                ]
            },
            "as many detectors in every band: a has 19, b has 7",
        ),
        (
            {"bands": [{"name": "a b", **BANDS["f090"]}]},
            "bands.0.name: 'a b' has a character that is not allowed",
        ),
        ({"bands": ["f090x"]}, "unknown band 'f090x'"),
        (
            {"bands": [{"name": "so_93gz", "net": "1 mK s(1/2)"}]},
            "bands.0.name: unknown band 'so_93gz'(.|\n)*did you mean 'so_93ghz'",
        ),
        (
            {"band": "f15"},
            (
                "band: camera has no band 'f15'(.|\n)*did you mean 'f150'(.|\n)*write one of f090,"
                " f150"
            ),
        ),
        (
            {"polarization": "pairs"},
            "even number of detectors, two in each pixel; detectors of f090 is 19",
        ),
    ],
)
def test_bad_bands(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ZondaError, match=words):
        zonda.Instrument(**camera("f090", "f150").model_dump(mode="json") | changes)


def test_a_registered_band_by_its_name() -> None:
    made = zonda.Instrument(
        **camera("f090", "f150").model_dump(mode="json")
        | {"bands": ["so_93ghz", {"name": "so_145ghz", "knee": "1 Hz"}]}
    )
    assert made.cameras["so_93ghz"].band == bands.create("so_93ghz")
    assert made.cameras["so_145ghz"].knee == 1


def two_bands(folder: Path, maps: str) -> Path:
    """A pipeline file of a camera with two registered bands and these last steps."""
    file = folder / "two.yaml"
    lines = [
        "site: llano_de_chajnantor",
        "time: 2022-08-01T23:00",
        "target: 260d -10d",
        (
            "instrument: {name: x, telescope: {name: d, diameter: 6 m}, detectors: 7,"
            " field_of_view: 20 arcmin,"
        ),
        (
            "  main_beam_efficiency: 0.8, illumination_efficiency: 0.9, net: 1 mK s(1/2),"
            " sample_rate: 50 Hz,"
        ),
        "  bands: [so_93ghz, so_145ghz]}",
        f"operators: [PointingDaisy: {{scan_duration: 20 s}}, WhiteNoise, Efficiency, {maps}]",
    ]
    file.write_text("\n".join(lines))
    return file


def written(net: str, passband: str) -> str:
    """A pipeline file whose bands are written out."""
    return "\n".join(
        [
            "site: llano_de_chajnantor",
            "time: 2022-08-01T23:00",
            "target: 260d -10d",
            "instrument:",
            "  name: x",
            "  telescope: {name: d, diameter: 6 m}",
            "  detectors: 7",
            "  field_of_view: 20 arcmin",
            "  main_beam_efficiency: 0.8",
            "  illumination_efficiency: 0.9",
            "  sample_rate: 50 Hz",
            "  bands:",
            f"    - {{name: a, low: 80 GHz, high: 90 GHz, net: {net}}}",
            f"    - {{name: b, {passband}, net: 1 mK s(1/2)}}",
            "    - so_145ghz",
            "operators: [PointingDaisy: {scan_duration: 20 s}, WhiteNoise, Efficiency, BinMap]",
        ]
    )


@pytest.mark.parametrize(
    ("net", "passband", "place", "words"),
    [
        (
            "300 uJy",
            "low: 100 GHz, high: 110 GHz",
            "t.yaml:13:53",
            "bands.0.net: a noise level is in K",
        ),
        (
            "1 mK s(1/2)",
            "file: bad.txt",
            "t.yaml:14:23",
            "bands.1.file: passband file .*: line 2: transmission is 'nan'",
        ),
    ],
)
def test_a_mistake_of_a_band_is_told_once_at_its_place(
    tmp_path: Path, net: str, passband: str, place: str, words: str
) -> None:
    (tmp_path / "bad.txt").write_text("90 1\n100 nan\n110 0\n")
    text = written(net, passband).replace("    - so_145ghz\n", "")
    with pytest.raises(ConfigurationError) as caught:
        parse(text, name="t.yaml", folder=tmp_path)
    (found,) = caught.value.diagnostics
    assert found.place == place
    assert re.search(words, found.message)


def test_entries_of_a_list_are_set_by_their_number() -> None:
    text = written("1 mK s(1/2)", "low: 100 GHz, high: 110 GHz").replace(
        "- so_145ghz", "- {name: so_145ghz, net: 1 mK s(1/2)}"
    )
    assert (
        parse(text, overrides=["instrument.bands.1.net=3 mK s(1/2)"])
        .scene()
        .instrument.cameras["b"]
        .net
        == 3e-3
    )


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("instrument.bands.0.net=3 mK", "bands.0.net: expected a noise level"),
        (
            "instrument.bands.3.net=3 mK s(1/2)",
            "'instrument.bands' is a list of 3: its entries are counted from 0",
        ),
        (
            "instrument.bands.a.net=3 mK s(1/2)",
            "write instrument.bands.0 or instrument.bands.1 or instrument.bands.2",
        ),
        ("instrument.bands.2.net=3 mK s(1/2)", "'instrument.bands.2' is a name, not a mapping"),
        ("weather.2.x=1", "the file has no 'weather'(.|\n)*set the whole list: weather='"),
    ],
)
def test_settings_that_do_not_fit_a_list(setting: str, words: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        parse(written("1 mK s(1/2)", "low: 100 GHz, high: 110 GHz"), overrides=[setting])
    assert any(re.search(words, found.render()) for found in caught.value.diagnostics)


def test_the_plan_of_a_file_with_several_bands(tmp_path: Path) -> None:
    file = two_bands(tmp_path, "BinMap: {pixel: 1 arcmin}")
    assert (
        zonda.load(file, ["instrument.band=so_145ghz"]).scene().instrument.band.name == "so_145ghz"
    )
    made = zonda.plan(zonda.load(file))
    assert set(made.bands) == {"so_93ghz", "so_145ghz"}
    assert "band so_145ghz:" in str(made)
    again = tmp_path / "again.yaml"
    again.write_text(made.apply(zonda.load(file)).resolved_yaml())
    assert zonda.load(again).scene().instrument == zonda.load(file).scene().instrument


def test_a_step_that_points_and_makes_a_stream_observes_all_bands_and_then_each() -> None:
    seen = []

    class Reader(zonda.PointingStare):
        provides = frozenset({"boresight", zonda.Component("recorded", "calibrated")})

        def observe(self, data: Any) -> None:
            seen.append(data.band)
            if not data.band:
                super().observe(data)

        def exec(self, block: Any, state: Any) -> None:
            block.new("recorded")[...] = block.observation.instrument.band.centre / 1e11

    data = zonda.Pipeline([Reader(), zonda.BinMap(pixel="1 arcmin")]).run(
        scene("f090", "f150"), threads=1
    )
    assert seen == ["", "f090", "f150"]
    for name, camera in data.scene.instrument.cameras.items():
        found = data[f"map_{name}"].signal
        np.testing.assert_allclose(
            found[np.isfinite(found)], camera.band.centre / 1e11, rtol=1e-6
        )  # float32


def test_a_product_name_that_a_band_takes_is_refused() -> None:
    made = pipeline(
        zonda.BinMap(pixel="1 arcmin", product="map_f150_f090"),
        zonda.BinMap(pixel="1 arcmin", product="map_f150"),
    )
    data = made.run(scene("f090", "f150"), threads=1)
    assert isinstance(data["map_f150_f090_f090"], MapProduct)


def test_a_campaign_adds_up_each_band(tmp_path: Path) -> None:
    """Tasks of one scan each: the maps have the bits of one run, and the report knows both
    bands.
    """
    steps = pipeline(zonda.SaveMap(), zonda.MeasureFigures(metrics=["central_rms"]), zonda.Report())
    steps = zonda.Pipeline(steps.operators)
    both = scene("f090", "f150")
    zonda.campaign(steps, both, output=tmp_path / "campaign", realizations=1, engine="serial")
    once = steps.run(both, output=tmp_path / "once", threads=1)
    for name in BANDS:
        with fits.open(tmp_path / "campaign" / f"map_{name}.fits") as found:
            for plane in ("signal", "hits", "noise", "half_difference"):
                hdu = found[0] if plane == "signal" else found[plane.upper()]
                np.testing.assert_array_equal(hdu.data, getattr(once[f"map_{name}"], plane))
            assert found[0].header["NSCANS"] == 2
    page = (tmp_path / "campaign" / "report.html").read_text(encoding="utf-8")
    assert f"central_rms {name}" in page
    assert "scan-001-f090" in page


def test_the_forecast_knows_that_maps_of_all_bands_grow_beside_each_other(tmp_path: Path) -> None:
    """`zonda plan`: the bands' maps beside what one of them holds."""
    file = zonda.load(two_bands(tmp_path, "BinMap: {pixel: 2 arcsec}, SaveMap"))
    both = zonda.plan(file).memory
    alone = [
        zonda.plan(zonda.load(tmp_path / "two.yaml", [f"instrument.band={name}"]))
        for name in ("so_93ghz", "so_145ghz")
    ]
    maps = []
    for made in alone:
        (step,) = (o for o in made.context.operators if o.label == "BinMap")
        maps.append(planning_of(step).memory(made.context.first))
    assert min(maps) > 5e6
    assert both >= max(m.memory for m in alone) + min(maps)
    assert both < sum(m.memory for m in alone)


def test_what_bands_hold_for_each_other_counts_in_the_budget() -> None:
    """The least that a worker needs: more than the most of the bands alone, by the maps of the
    other.
    """
    steps = pipeline().operators
    made = {names: zonda.Pipeline(steps) for names in (("f090",), ("f150",), ("f090", "f150"))}
    scans = {
        names: one.point(scene(*names), {}, Path()).observations for names, one in made.items()
    }
    least = {names: one.least_memory(scans[names]) for names, one in made.items()}
    maps = planning_of(made["f090",].operators[-1]).memory(scans["f090",][0])
    more = least["f090", "f150"] - max(least["f090",], least["f150",])
    assert abs(more - 1.05 * maps) <= 1e6  # rounded up to MB with a margin of 5 %


def test_edges_are_where_a_band_has_half_of_its_peak(tmp_path):
    path = tmp_path / "band.txt"
    path.write_text("80 0\n90 0.8\n100 2\n110 0.2\n130 0\n")
    # half of 2 is 1: 90 + 10 (1 - 0.8) / (2 - 0.8), 100 + 10 (2 - 1) / (2 - 0.2)
    assert zonda.Band(name="b", file=path).edges == pytest.approx((91.6667e9, 105.5556e9), rel=1e-6)
    assert zonda.Band(name="b", low="80 GHz", high="90 GHz").edges == (80e9, 90e9)
    path.write_text("80 1\n90 1.5\n")  # the table ends above half of the peak
    assert zonda.Band(name="b", file=path).edges == (80e9, 90e9)
