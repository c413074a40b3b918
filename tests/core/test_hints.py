"""Names as people write them, and names that mean another thing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from zonda.core import registry
from zonda.core.cli import main
from zonda.core.configuration.locate import folders, locate
from zonda.core.configuration.pipeline_file import load
from zonda.core.errors import InputError
from zonda.core.registry import RegistryError
from zonda.core.scene import Scene
from zonda.core.site import Site

PIPELINE = """site: {site}
instrument: {instrument}
time: 2024-11-25T07:00
target: 05h00m00s +20d00m00s
operators:
  - PointingDaisy: {{scan_duration: 10 s}}
  - WhiteNoise
  - Efficiency
  - BinMap: {{pixel: 2 arcsec}}
  - SaveMap
"""


@pytest.mark.parametrize(
    ("names", "written", "meant"),
    [
        (registry.instruments, "GBT", "gbt"),
        (registry.instruments, "MUSTANG-2", "mustang2"),
        (registry.instruments, "atlast full", "atlast_full"),
        (registry.instruments, "zonda:SPT-3G", "zonda:spt3g"),
        (registry.sites, "Green Bank", "green_bank"),
        (registry.sites, "green-bank", "green_bank"),
        (registry.sites, "Llano de Chajnantor", "llano_de_chajnantor"),
        (registry.bands, "MUSTANG2 90GHz", "mustang2_90ghz"),
        (registry.noise_models, "Background-Limited", "background_limited"),
        (registry.weather_sources, "ERA5", "era5"),
        (registry.metrics, "Map-RMS", "map_rms"),
    ],
)
def test_capitals_hyphens_and_spaces_make_no_difference(
    names: Any, written: str, meant: str
) -> None:
    assert names.registered(written) == meant
    assert names.get(written) is names.get(meant) or names.create(written) == names.create(meant)


def test_shipped_pipelines_too() -> None:
    assert locate("MUSTANG2-Cluster") == locate("mustang2_cluster")


def test_a_pipeline_takes_them(tmp_path: Path) -> None:
    (tmp_path / "p.yaml").write_text(PIPELINE.format(site="Green Bank", instrument="MUSTANG-2"))
    scene = load(tmp_path / "p.yaml").scene()
    assert (scene.site.name, scene.instrument.name) == ("green_bank", "mustang2")


def test_operators_are_classes_and_keep_their_spelling() -> None:
    for written in ("binmap", "bin_map", "Bin-Map"):
        with pytest.raises(
            RegistryError, match=f"unknown operator '{written}'; did you mean 'BinMap'"
        ):
            registry.operators.get(written)


def test_two_names_that_differ_by_capitals_alone_are_told_apart(fresh_registries: None) -> None:
    for name, altitude in (("Far_Hill", "1 km"), ("farhill", "2 km")):
        registry.sites.register(
            Site(name=name, latitude="1 deg", longitude="1 deg", altitude=altitude)
        )
    assert registry.sites.create("Far_Hill").altitude == 1000.0
    assert registry.sites.create("farhill").altitude == 2000.0
    with pytest.raises(
        RegistryError, match="site 'far hill' may be 'Far_Hill' and 'farhill'; write one of them"
    ):
        registry.sites.create("far hill")


def test_an_alias_of_the_same_site_is_no_other_name() -> None:
    assert (
        registry.sites.create("Mauna-Kea")
        == registry.sites.create("mauna_kea")
        == registry.sites.create("maunakea")
    )


@pytest.mark.parametrize(
    ("written", "site", "words"),
    [
        ("lmt", "sierra_negra", "'lmt' is an instrument; its telescope LMT stands at sierra_negra"),
        ("TolTEC", "sierra_negra", "'toltec' is an instrument"),
        ("GBT", "green_bank", "its telescope GBT stands at green_bank"),
        ("CMB-S4 LAT", "cerro_toco", "CMB-S4 LAT stands at cerro_toco"),
        ("spt", "amundsen_scott", "stands at amundsen_scott"),  # and not the near 'srt'
        ("JCMT", "mauna_kea", "Mauna Kea Observatory"),
    ],
)
def test_a_site_called_by_its_telescope(written: str, site: str, words: str) -> None:
    with pytest.raises(RegistryError, match=f"unknown site '{written}'") as caught:
        registry.sites.create(written)
    assert caught.value.label == f"did you mean '{site}'?"
    assert words in caught.value.cure


@pytest.mark.parametrize(
    ("written", "label", "words"),
    [
        ("Green Bank", "'green_bank' is a site", "instruments that stand there: gbt, mustang2"),
        ("sierra_negra", "'sierra_negra' is a site", "lmt, "),
        ("teide", "'teide' is a site", ""),
        (
            "CMB-S4 LAT",
            "did you mean 'cmb_s4'?",
            "CMB-S4 LAT is a telescope; instruments on it: cmb_s4",
        ),
        ("Prime-Cam", "did you mean 'ccat'?", "a Prime-Cam module"),
        ("mustng2", "did you mean 'mustang2'?", ""),
    ],
)
def test_an_instrument_called_by_its_site_or_telescope(
    written: str, label: str, words: str
) -> None:
    with pytest.raises(RegistryError, match=f"unknown instrument '{written}'") as caught:
        registry.instruments.create(written)
    assert caught.value.label == label
    assert words in caught.value.cure


def test_every_telescope_has_a_site_that_is_registered() -> None:
    for name in registry.instruments:
        telescope = registry.instruments.create(name).telescope
        assert telescope.name == "generic 6 m" or telescope.site in registry.sites


def test_the_site_of_a_telescope_is_no_part_of_what_a_run_is_known_by() -> None:
    """It changes no result: files that were resolved before stay what they were."""
    scene = Scene(site="green_bank", instrument="mustang2", time="2024-11-25T07:00")
    assert "site" not in scene.model_dump(mode="json")["instrument"]["telescope"]


def test_check_warns_of_a_telescope_on_another_site(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "p.yaml").write_text(PIPELINE.format(site="mauna_kea", instrument="mustang2"))
    assert main(["check", str(tmp_path / "p.yaml")]) == 0
    error = capsys.readouterr().err
    assert (
        "warning: GBT stands at green_bank, 7430 km away: here it looks through the atmosphere of"
        " mauna_kea" in error
    )
    assert "write 'site: green_bank' for its own" in error
    (tmp_path / "p.yaml").write_text(PIPELINE.format(site="GreenBank", instrument="mustang2"))
    assert main(["check", str(tmp_path / "p.yaml")]) == 0
    assert capsys.readouterr().err == ""


def test_what_is_shipped_in_folders_are_pipelines():
    """Beside validation/mustang2 there are claims.yaml, which is none."""
    for path in folders().values():
        assert load(path).operators
    with pytest.raises(InputError, match="no such pipeline"):
        locate("validation/claims")
