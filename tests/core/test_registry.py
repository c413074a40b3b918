from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from zonda.core import registry
from zonda.core.configuration.diagnostics import ConfigurationError
from zonda.core.configuration.pipeline_file import parse
from zonda.core.discovery import API_VERSION
from zonda.core.hooks import PluginWarning
from zonda.core.operator import Operator
from zonda.core.registry import RegistryError
from zonda.core.site import Site

SITE = (
    "from zonda.core.site import Site\nhill = Site(name='hill', latitude='1 deg', longitude='2"
    " deg')\n"
)
SITE += "def dale():\n    return Site(name='dale', latitude='3 deg', longitude='4 deg')\n"
OPERATOR = (
    'from zonda.core.operator import Operator\nclass {name}(Operator):\n    """{doc}"""\n   '
    " zonda_api = {api}\n"
)

Plugin = Callable[..., Path]


def test_objects_and_factories(plugin: Plugin) -> None:
    plugin(
        "zonda-hills",
        "1.2",
        {"zonda.sites": {"hill": "zt_hills:hill", "dale": "zt_hills:dale"}},
        zt_hills=SITE,
    )
    assert "hill" in registry.sites
    assert "zonda-hills:hill" in registry.sites
    assert "other:hill" not in registry.sites
    assert "zt_hills" not in sys.modules  # nothing is imported before it is used
    assert registry.sites.create("hill").name == "hill"
    assert registry.sites.create("zonda-hills:dale").name == "dale"
    assert callable(registry.sites.get("dale"))
    found = [f for f in registry.sites.candidates() if f.name == "hill"]
    assert [(f.distribution, f.version, f.reference) for f in found] == [
        ("zonda-hills", "1.2", "zt_hills:hill")
    ]


def test_unknown_name(plugin: Plugin) -> None:
    plugin("zonda-hills", "1.2", {"zonda.sites": {"hill": "zt_hills:hill"}}, zt_hills=SITE)
    with pytest.raises(RegistryError, match="unknown site 'Hil'") as caught:
        registry.sites.get("Hil")
    assert caught.value.label == "did you mean 'hill'?"
    assert "`zonda plugins` lists all" in caught.value.cure


def test_broken_plugin_is_named_and_the_rest_works(plugin: Plugin) -> None:
    plugin(
        "zonda-broken",
        "0.9",
        {"zonda.sites": {"cliff": "zt_broken:cliff"}},
        zt_broken="import a_library_that_is_not_there\n",
    )
    plugin("zonda-lost", "0.1", {"zonda.sites": {"pit": "zt_not_there:pit", "gap": "zt_hills:gap"}})
    plugin("zonda-hills", "1.2", {"zonda.sites": {"hill": "zt_hills:hill"}}, zt_hills=SITE)
    with pytest.raises(
        RegistryError, match=r"site 'cliff' could not be loaded from the plugin zonda-broken 0.9"
    ) as caught:
        registry.sites.get("cliff")
    assert (
        caught.value.label == "ModuleNotFoundError: No module named 'a_library_that_is_not_there'"
    )
    assert "a fault in zonda-broken (zt_broken:cliff)" in caught.value.cure
    with pytest.raises(RegistryError, match=r"zonda-lost 0\.1"):
        registry.sites.get("pit")
    with pytest.raises(RegistryError, match=r"zonda-lost 0\.1; AttributeError"):
        registry.sites.get("gap")
    assert registry.sites.create("hill").name == "hill"


def test_factory_that_fails_or_returns_something_else(plugin: Plugin) -> None:
    source = (
        "def slip():\n    raise RuntimeError('no ground')\ndef fog():\n    return 3\nnumber = 4\n"
    )
    points = {"slip": "zt_slip:slip", "fog": "zt_slip:fog", "number": "zt_slip:number"}
    plugin("zonda-slip", "2", {"zonda.sites": points}, zt_slip=source)
    with pytest.raises(RegistryError, match=r"zonda-slip 2; RuntimeError: no ground"):
        registry.sites.create("slip")
    for name in ("fog", "number"):
        with pytest.raises(RegistryError, match=f"site '{name}' from zonda-slip 2 is not a Site"):
            registry.sites.create(name)


def test_every_wrong_field_of_a_factory_is_named(plugin: Plugin) -> None:
    source = (
        "from zonda import Site\ndef bog():\n    return Site(name='bog', latitude='20 deg',"
        " colour='green')\n"
    )
    plugin("zonda-bog", "3", {"zonda.sites": {"bog": "zt_bog:bog"}}, zt_bog=source)
    with pytest.raises(RegistryError) as caught:
        registry.sites.create("bog")
    assert caught.value.label == "Site needs 'longitude'; unknown parameter 'colour' for Site"


def test_operator_must_be_a_class_of_operators(plugin: Plugin) -> None:
    plugin("zonda-odd", "2", {"zonda.operators": {"Odd": "zt_odd:Odd"}}, zt_odd="class Odd: ...\n")
    with pytest.raises(
        RegistryError, match="operator 'Odd' from zonda-odd 2 is not a subclass of Operator"
    ):
        registry.operators.get("Odd")


@pytest.mark.parametrize(
    ("api", "cure"),
    [(API_VERSION - 1, "pip install -U zonda-aged"), (API_VERSION + 1, "pip install -U zonda")],
)
def test_outdated_plugin(plugin: Plugin, api: int, cure: str) -> None:
    source = OPERATOR.format(name="Aged", doc="Aged.", api=api)
    plugin("zonda-aged", "0.1", {"zonda.operators": {"Aged": "zt_aged:Aged"}}, zt_aged=source)
    words = (
        f"operator 'Aged' from zonda-aged 0.1 is written for plugin API {api}; this is API"
        f" {API_VERSION}"
    )
    with pytest.raises(RegistryError, match=words) as caught:
        registry.operators.get("Aged")
    assert caught.value.cure == cure


def test_duplicates_name_both_and_can_be_told_apart(plugin: Plugin) -> None:
    for number in "12":
        source = OPERATOR.format(name="Twin", doc=f"Twin {number}.", api=API_VERSION)
        plugin(
            f"zonda-twin{number}",
            "2.0",
            {"zonda.operators": {"Twin": f"zt_twin{number}:Twin"}},
            **{f"zt_twin{number}": source},
        )
    words = (
        "operator 'Twin' is provided by zonda-twin1 2.0 and zonda-twin2 2.0|by zonda-twin2 2.0 and"
        " zonda-twin1 2.0"
    )
    with pytest.raises(RegistryError, match=words) as caught:
        registry.operators.get("Twin")
    assert "'zonda-twin1:Twin'" in caught.value.label
    assert registry.operators.get("zonda-twin2:Twin").__doc__.startswith("Twin 2.")


def test_operators_come_from_both_groups(plugin: Plugin) -> None:
    source = OPERATOR.format(name="One", doc="", api=API_VERSION) + OPERATOR.format(
        name="Two", doc="", api=API_VERSION
    )
    groups = {
        "zonda.operators": {"One": "zt_both:One", "Same": "zt_both:One"},
        "zonda.mapmakers": {"Two": "zt_both:Two", "Same": "zt_both:One"},
    }
    plugin("zonda-both", "1", groups, zt_both=source)
    assert {"One", "Two"} <= set(registry.operators)
    assert registry.operators.get("Same") is registry.operators.get(
        "One"
    )  # the same object offered as both is no conflict
    assert registry.operators.get("Two").__name__ == "Two"


def test_a_plugin_that_doubles_a_mapmaker_as_operator_is_a_conflict(plugin: Plugin) -> None:
    for kind, number in (("operators", 1), ("mapmakers", 2)):
        source = OPERATOR.format(name="Twin", doc="", api=API_VERSION)
        plugin(
            f"zonda-k{number}",
            "1",
            {f"zonda.{kind}": {"Twin": f"zt_k{number}:Twin"}},
            **{f"zt_k{number}": source},
        )
    with pytest.raises(RegistryError, match="provided by"):
        registry.operators.get("Twin")


def test_allow_list(plugin: Plugin, monkeypatch: pytest.MonkeyPatch) -> None:
    plugin("zonda-hills", "1.2", {"zonda.sites": {"hill": "zt_hills:hill"}}, zt_hills=SITE)
    plugin("zonda.dales", "1.2", {"zonda.sites": {"dale": "zt_hills:dale"}})
    for value, expected in (
        ("", set()),
        ("zonda_hills", {"hill"}),
        ("Zonda-Dales, zonda-hills", {"hill", "dale"}),
    ):
        monkeypatch.setenv("ZONDA_PLUGINS", value)
        registry.refresh()
        assert {"hill", "dale"} & set(registry.sites) == expected


def test_a_group_that_is_gone_is_told_once_with_what_replaces_it(plugin: Plugin) -> None:
    plugin(
        "zonda-hills",
        "1.2",
        {"zonda.sites": {"hill": "zt_hills:hill"}, "zonda.products": {"Sum": "zt_hills:Sum"}},
        zt_hills=SITE,
    )
    with pytest.warns(PluginWarning, match=r"zonda-hills .*zonda\.products.* is gone: .*class"):
        assert "hill" in registry.sites
    assert "green_bank" in registry.sites  # in silence: warnings of plugins are errors in tests


def test_broken_metadata_hides_nothing_else(plugin: Plugin) -> None:
    folder = plugin("zonda-hills", "1.2", {"zonda.sites": {"hill": "zt_hills:hill"}}, zt_hills=SITE)
    info = folder / "zonda_torn-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_bytes(b"Name: zonda-torn\nVersion: 1.0\n")
    (info / "entry_points.txt").write_bytes(b"[zonda.sites]\nbog = \xff\n")
    registry.refresh()
    with pytest.warns(PluginWarning, match="zonda_torn-1.0.dist-info"):
        assert "hill" in registry.sites
    assert "bog" not in registry.sites


def test_register(fresh_registries: None) -> None:
    @registry.operators.register
    class Mine(Operator):
        """Mine."""

    @registry.operators.register(name="Other")
    class Theirs(Operator):
        """Theirs."""

    assert registry.operators.get("Mine") is Mine
    assert registry.operators.get("Other") is Theirs
    registry.sites.register(Site(name="yard", latitude="1 deg", longitude="1 deg"))
    assert registry.sites.create("yard").name == "yard"
    assert [f.distribution for f in registry.sites.candidates() if f.name == "yard"] == [
        "this session"
    ]
    with pytest.raises(RegistryError, match="has no name"):
        registry.sites.register(object())
    again: Any = type("Mine", (Operator,), {"__module__": __name__})
    assert registry.operators.get("Mine") is not again
    registry.operators.register(again)  # a notebook's cell run twice
    assert registry.operators.get("Mine") is again


def test_register_does_not_shadow_a_plugin(plugin: Plugin) -> None:
    plugin("zonda-hills", "1.2", {"zonda.sites": {"hill": "zt_hills:hill"}}, zt_hills=SITE)
    with pytest.raises(RegistryError, match=r"site 'hill' is already provided by zonda-hills 1\.2"):
        registry.sites.register(Site(name="hill", latitude="1 deg", longitude="1 deg"))


def test_faults_of_plugins_have_a_place_in_the_file(plugin: Plugin, toys: Any) -> None:
    plugin(
        "zonda-broken",
        "0.9",
        {"zonda.operators": {"Fancy": "zt_broken:Fancy"}},
        zt_broken="import nowhere_to_be_found\n",
    )
    text = f"{toys.head}operators:\n  - ToyPointing: {{duration: 1 s}}\n  - Fancy: {{x: 1}}\n"
    with pytest.raises(ConfigurationError) as caught:
        parse(text, name="t.yaml")
    (found,) = caught.value.diagnostics
    assert found.place == "t.yaml:8:5"
    assert found.message == "operator 'Fancy' could not be loaded from the plugin zonda-broken 0.9"
    assert found.label.startswith("ModuleNotFoundError")


def test_reading_the_registry_imports_nothing_heavy() -> None:
    heavy = (
        "numpy",
        "astropy",
        "numba",
        "healpy",
        "scipy",
        "matplotlib",
        "h5py",
        "pydantic",
        "click",
    )
    code = (
        "import sys, zonda.core.registry as r; list(r.operators), len(r.sites); print([m for m in"
        f" {heavy} if m in sys.modules])"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"
