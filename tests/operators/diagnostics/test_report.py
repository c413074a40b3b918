"""One page with everything in it, and nothing in it that is not escaped."""

from __future__ import annotations

import dataclasses
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from astropy.io import fits

import zonda
from zonda.core.configuration.target import Target
from zonda.core.errors import OutputError
from zonda.operators.diagnostics.plot_operators import Picture
from zonda.operators.diagnostics.report import (
    Report,
    _target,
    brightness,
    expected,
    flux_density,
    readable,
    results,
    sexagesimal,
)

PNG = b"\x89PNG\r\n\x1a\n" + b"\0\0\0\rIHDR" + (640).to_bytes(4, "big") + (480).to_bytes(4, "big")
EVIL = "<script>alert('x')</script>&\"quoted\""


class Checker(HTMLParser):
    """Every element closed, nothing loaded from outside, no script."""

    VOID = frozenset({"meta", "img", "br", "link"})

    def __init__(self):
        super().__init__()
        self.open, self.text, self.images = [], [], []

    def handle_starttag(self, tag, attributes):
        assert tag != "script"
        assert tag != "link"
        found = dict(attributes)
        if tag == "img":
            assert found["src"].startswith("data:image/png;base64,")
            assert found["alt"]
            self.images.append(found["alt"])
        assert not found.get("href", "#").startswith("http")
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


@pytest.fixture
def report(data, make_observation):
    def make():
        data.observations.append(make_observation(500))
        Report().finalize(data)
        page = (data.output / "report.html").read_text(encoding="utf-8")
        checker = Checker()
        checker.feed(page)
        assert checker.open == []
        return page, " ".join(" ".join(checker.text).split()), checker

    return make


def test_it_says_what_was_simulated(data, report):
    data.log.count("SkyMap", "samples outside the input map", 12345)
    data.log.state("AtmosphereLayers", "mean PWV", "7.7 mm")
    data.provenance["versions"] = {"zonda": "0.1.0", "numpy": "9.9.9"}
    data.provenance["command"] = "zonda run demo"
    data.provenance["timings"] = [
        ("SkyMap", "exec", 1.5),
        ("SkyMap", "prepare", 0.25),
        ("BinMap", "exec", 0.5),
    ]
    data.provenance["operators"] = [
        ("PinkNoise", "PinkNoise", {"knee": "0.5 Hz", "radius": "0.0011635528346628863 rad"})
    ]
    data.products["pictures"] = [Picture("map", "The map", "What came out.", PNG)]
    page, text, checker = report()
    for part in (
        "camera on dish at hill",
        "seed 7, zonda 0.1.0",
        "2024-11-25T07:00:00.123456789Z",
        "scan_0",
        "12 345",
        "samples outside the input map",
        "mean PWV",
        "7.7 mm",
        "numpy 9.9.9",
        "zonda run demo",
        "1.750 s",
        "4 arcmin",
        "Simulated, not observed, by zonda 0.1.0",
        "a: 1",
        "Main-beam efficiency",
        "80 to 100 GHz",
        "1 mK_RJ √s",
    ):
        assert part in text, part
    assert checker.images == ["The map: What came out."]
    assert 'title="0.0011635528346628863 rad"' in page


def test_what_was_counted_follows_the_order_of_the_steps(data, report):
    data.provenance["operators"] = [("SkyMap", "SkyMap", {}), ("BinMap", "BinMap", {})]
    data.provenance["runs"] = {"noiseless": {"only": ["sky"]}}
    data.provenance["timings"] = [("SkyMap", "exec", 1.5), ("BinMap", "observe", 0.0)]
    for step in ("BinMap", "SkyMap"):
        data.log.count(step, "apples", 1)
    _, text, _ = report()
    log = text[
        text.index("step what value") : text.index("Computing time", text.index("step what value"))
    ]
    assert log.index("SkyMap") < log.index("BinMap")
    assert "signal noiseless only sky" in text
    assert (
        "BinMap"
        not in text[text.index("step CPU") : text.index("Provenance", text.index("step CPU"))]
    )  # not timed


def test_every_text_is_escaped(data, report):
    data.provenance.update(
        name=EVIL, description=EVIL, command=EVIL, resolved_yaml=EVIL, versions={EVIL: EVIL}
    )
    data.provenance["operators"] = [(EVIL, EVIL, {EVIL: EVIL})]
    data.provenance["timings"] = [(EVIL, EVIL, 1.0)]
    data.log.state(EVIL, EVIL, EVIL)
    data.products["pictures"] = [Picture("map", EVIL, EVIL, PNG)]
    page, text, _ = report()
    assert "<script" not in page
    assert text.count("<script>") >= 8  # shown as text


def test_the_page_is_the_only_file(data, report):
    report()
    assert [p.name for p in data.output.iterdir()] == ["report.html"]


def test_it_draws_its_own_pictures_where_no_step_did(data, report):
    _, _, checker = report()
    assert any(alt.startswith("Boresight track") for alt in checker.images)


def test_a_run_from_python_has_a_report_too(data, report):
    data.provenance.clear()
    page, text, _ = report()
    assert "zonda run" in text
    assert re.search(r'id="steps"', page) is None  # no empty sections


def test_no_output_folder(data):
    data.output = None
    with pytest.raises(OutputError, match="no output folder"):
        Report().finalize(data)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("0.0011635528346628863 rad", "4 arcmin"),
        ("4.1209164e-05 rad", "8.5 arcsec"),
        ("516.0 s", "8.6 min"),
        ("9.3e10 Hz", "93 GHz"),
        ("0.08 Hz", "0.08 Hz"),
        ("0.0017 K s(1/2)", "1.7 mK sqrt(s)"),
        ("0.0077 m", "7.7 mm"),
        ("0.0 s", "0 s"),
        ("0.3", "0.3"),
        ("['signal']", "['signal']"),
        ("-1.5707963267948966 rad", "-90 deg"),
        ("12 parsec", "12 parsec"),
        ("0.00024240684055 rad / s", "50 arcsec/s"),
        ("128 s", "128 s"),
        ("516 s", "8.6 min"),
    ],
)
def test_quantities_are_readable(text, shown):
    assert readable(text) == shown


@pytest.mark.parametrize("dec", ["-04d40m00s", "-00d00m00.04s", "89d59m59.96s", "20d"])
@pytest.mark.parametrize("ra", ["02h32m11s", "23h59m59.996s", "0h"])
def test_positions_aresexagesimal(ra, dec):
    """Half of the last figure is the largest error: 0.005 s of right ascension, 0.05 arcsec of
    declination.
    """
    target = Target.parse(f"{ra} {dec}")
    again = Target.parse(
        sexagesimal(target.longitude, target.latitude).translate(str.maketrans("−°′″", "-dms"))
    )
    turn = 2 * np.pi
    assert abs((again.longitude - target.longitude + np.pi) % turn - np.pi) <= 0.0051 * turn / 86400
    assert again.latitude == pytest.approx(target.latitude, abs=0.051 * turn / 1296000)


def test_targets_are_readable():
    assert _target(Target.parse("02h32m11s -04d40m00s")) == "02h32m11.00s −04°40′00.0″ (ICRS)"
    assert _target(Target.parse("az 180 deg el 60 deg")) == "azimuth 180°, elevation 60°"
    assert _target(Target.parse("galactic 120.5 deg -30 deg")) == "galactic l 120.5°, b -30°"


def test_the_flux_density_of_a_beam(data):
    """S = 2 k T Omega / c^2 / <nu^-2>, Omega = 1.1331 FWHM^2; of a flat band <nu^-2> = 1 / (nu_1
    nu_2).
    """
    band = data.scene.instrument.band
    low, high = band.frequency[0], band.frequency[-1]
    fwhm = np.radians(10 / 3600)
    expected = (
        2 * 1.380649e-23 * 1e-3 * 1.13309 * fwhm**2 / 299792458.0**2 * low * high / 1e-26
    )  # Jy for 1 mK
    shown = flux_density(1e-3, fwhm, band)
    value, unit = shown.split("\u00a0")
    assert float(value) * {"Jy": 1, "mJy": 1e-3, "µJy": 1e-6}[unit] == pytest.approx(
        expected, rel=5e-3
    )  # three figures


def test_the_white_noise_that_is_expected():
    """Beside the map's own smoothing, which weighs every pixel: the formula takes the circle to be
    covered evenly (5 %).
    """
    scene = zonda.Scene(
        site="green_bank", instrument="mustang2", time="2024-11-25T07:00", target="05h +20d", seed=1
    )
    steps = [
        zonda.PointingDaisy(scan_duration="20 s"),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        zonda.BinMap(pixel="3 arcsec"),
    ]
    data = zonda.Pipeline(steps).run(scene)
    product, circle = data.products["map"], np.radians(2 / 60)
    ((what, beam, pixel),) = rows = expected("map", product, circle)
    value, unit = beam.partition(",")[0].split("\u00a0")
    smoothed = product.smoothed(product.fwhm).noise[product.distance() <= circle / 2]
    wanted = np.nanmedian(smoothed)
    assert float(value) * {"µK_RJ": 1e-6, "mK_RJ": 1e-3}[unit] == pytest.approx(wanted, rel=0.05)
    assert beam.endswith("(12″ beam)")
    assert what == "white noise by NET and samples, central 2′ (14 beams)"
    assert rows[0] in results(data, circle)[1]
    ((what, beam, same),) = expected("map", dataclasses.replace(product, fwhm=0.0), circle)
    assert (beam, same) == ("", pixel)
    assert (
        expected(
            "map", dataclasses.replace(product, noise=np.full(product.hits.shape, np.nan)), circle
        )
        == []
    )


def test_long_lists_are_folded(data, make_observation):
    """Scans, counts, decisions and files beyond a dozen or so are in <details>; each is there,
    once, under its step's name.
    """
    data.observations += [make_observation(50, index=k) for k in range(40)]
    for k in range(30):
        data.log.state("Step", f"figure {k:02d}", "1")
    data.provenance["plan"] = [(f"effect {k}", "full", "0", "x") for k in range(20)]
    data.products["tod_file"] = [data.output / f"tod_{k:03d}.h5" for k in range(50)]
    data.products["pictures"] = []
    Report().finalize(data)
    page = (data.output / "report.html").read_text(encoding="utf-8")
    checker = Checker()
    checker.feed(page)
    assert checker.open == []
    shown = re.sub(r"<details>.*?</details>", "", page, flags=re.S)
    for what, count, some in (
        ("28 more scans", 40, 12),
        ("18 more counts and figures", 30, 12),
        ("8 more decisions", 20, 12),
    ):
        assert f"<summary>{what}</summary>" in page
        word = {"scans": "scan_", "figures": "figure ", "decisions": "effect "}[what.split()[-1]]
        assert len(set(re.findall(rf"{word}\d+", page))) == count
        assert len(set(re.findall(rf"{word}\d+", shown))) == some
    assert "<summary>all 50 files</summary>" in page
    assert page.count("<li>tod_") == 50
    rest = page[page.index("18 more counts") :]
    assert rest.index("<th>Step</th>") < rest.index(
        "figure 12"
    )  # the folded table begins with the name


def test_short_lists_are_not_folded(data, make_observation):
    data.observations += [make_observation(50, index=k) for k in range(14)]
    data.products["tod_file"] = [data.output / f"tod_{k}.h5" for k in range(4)]
    data.products["pictures"] = []
    Report().finalize(data)
    page = (data.output / "report.html").read_text(encoding="utf-8")
    assert "more scans" not in page
    assert "tod_0.h5, tod_1.h5, tod_2.h5, tod_3.h5" in page


def test_counts_have_their_share(data, report):
    data.log.count("SkyMap", "samples outside the input map", 2623184, 57531250)
    _, text, _ = report()
    assert "2 623 184 (4.56 %)" in text  # spaces are narrow ones that do not break


def test_the_depth_of_a_map_is_told_per_beam():
    """An area A that N detectors cover evenly for a time t has N t Omega / A per beam; the read-out
    is slower than usual.
    """
    scene = zonda.Scene(
        site="green_bank", instrument="mustang2", time="2024-11-25T07:00", target="05h +20d", seed=1
    )
    daisy = zonda.PointingDaisy(scan_duration="20 s", sample_rate="40 Hz")
    data = zonda.Pipeline(
        [daisy, zonda.WhiteNoise(), zonda.Efficiency(), zonda.BinMap(pixel="3 arcsec")]
    ).run(scene)
    product = data.products["map"]
    near = product.distance() <= np.radians(1 / 60)
    seconds = np.median(product.hits[near]) / 40 * np.pi / (4 * np.log(2)) * (8.5 / 3) ** 2
    what = "time of all detectors, central 2′ (14 beams)"
    samples = f"{np.median(product.hits[near]):.4g} samples (3″ pixels)"
    rows = results(data, np.radians(2 / 60))[1]
    assert (what, f"{seconds:.3g}\u00a0s (8.5″ beam)", samples) in rows


def test_the_central_circle_holds_several_beams(tmp_path):
    """Beams of 2 arcmin, of which an arcminute is the half: five of them, in the report, its
    pictures and the files alike.
    """
    camera = {"like": "mustang2", "detectors": 61, "field_of_view": "20 arcmin", "fwhm": "2 arcmin"}
    scene = zonda.Scene(
        site="green_bank", instrument=camera, time="2024-11-25T07:00", target="05h +20d", seed=1
    )
    daisy = zonda.PointingDaisy(
        radius="10 arcmin", scan_duration="20 s", scans=2, sample_rate="40 Hz"
    )
    steps = [
        daisy,
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        zonda.BinMap(pixel="30 arcsec"),
        zonda.SaveMap(),
        zonda.Report(),
    ]
    data = zonda.Pipeline(steps).run(scene, output=tmp_path)
    product, text = data.products["map"], (tmp_path / "report.html").read_text(encoding="utf-8")
    radius = np.radians(5 / 60)
    assert product.rms() == product.rms(radius) != product.rms(np.radians(0.5 / 60))
    assert text.count("central 10′ (5 beams)") == 3
    assert "within the dotted circle of 10′ (5 beams): " in text
    half = product.smoothed_rms(product.fwhm, radius, of="half_difference")
    assert brightness(half) in text
    header = fits.getheader(tmp_path / "noise_map.fits")
    assert header["RMSHALF"] == pytest.approx(product.rms(radius, of="half_difference"))
    assert "central 10 arcmin" in header.comments["RMSHALF"]
    asked = results(data, np.radians(3 / 60))
    assert any("central 3′ (1.5 beams)" in what for what, *_ in asked[1])


def test_the_net_is_that_of_all_scans(data, report, make_observation):
    first = make_observation(500)
    first.focalplane.net = (
        first.focalplane.net * 5
    )  # noise that follows from the load: every scan has its own
    data.observations.append(first)
    assert "1 to 5 mK_RJ √s, mean 3 (no white noise is simulated)" in report()[1]
    data.provenance["operators"] = [("WhiteNoise", "WhiteNoise", {})]
    text = report()[1]
    assert "1 to 5 mK_RJ √s" in text
    assert "no white noise" not in text
