"""Toy components, and third-party plugins made of a fake dist-info on sys.path."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import pytest
from pydantic import Field

from zonda.core import discovery, hooks, registry
from zonda.core.configuration.input_paths import InputPath
from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Angle, AngularSpeed, Hertz, Seconds
from zonda.core.instrument import Band, Instrument, Telescope
from zonda.core.operator import Operator
from zonda.core.site import Site


@pytest.fixture
def fresh_registries(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Registries without what was registered by hand, and read anew before and after."""
    monkeypatch.delenv("ZONDA_PLUGINS", raising=False)
    for each in registry.registries:
        monkeypatch.setattr(each, "_session", {})
    registry.refresh()
    hooks.manager.cache_clear()
    yield
    monkeypatch.undo()
    registry.refresh()
    hooks.manager.cache_clear()


@pytest.fixture
def plugin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fresh_registries: None
) -> Iterator[Callable[..., Path]]:
    """``plugin("zonda-toltec", "1.2", {"zonda.sites": {"name": "module:attr"}}, module="source")``
    fakes a distribution.
    """
    folder = tmp_path / "site-packages"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    made: list[str] = []

    def add(name: str, version: str, groups: dict[str, dict[str, str]], **modules: str) -> Path:
        info = folder / f"{name.replace('-', '_')}-{version}.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        lines = [
            f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in points.items())
            for group, points in groups.items()
        ]
        (info / "entry_points.txt").write_text("\n".join(lines))
        for module, text in modules.items():
            (folder / f"{module}.py").write_text(text)
            made.append(module)
        registry.refresh()
        hooks.manager.cache_clear()
        return folder

    yield add
    for module in made:
        sys.modules.pop(module, None)
    discovery.refresh()


class ToyPointing(Operator):
    """Points."""

    provides = frozenset({"boresight"})
    radius: Angle = quantity("4 arcmin", gt=0)
    """Petal length."""
    speed: AngularSpeed = quantity("51 arcsec/s", gt=0)
    """Typical speed."""
    duration: Seconds = Field(gt=0)
    """Length of one scan."""
    sample_rate: Hertz | None = Field(None, gt=0)
    """Read-out rate."""
    method: Literal["auto", "exact"] = "auto"
    """How."""
    scans: int = Field(1, ge=1, le=64)
    """Number of scans."""

    def observe(self, data: Any) -> None:
        """Not looked at by tests of the configuration."""


class ToySky(Operator):
    """A sky."""

    requires = frozenset({"boresight"})
    provides = frozenset({"sky"})
    file: InputPath | None = None
    """Input map."""

    def exec(self, block: Any, state: Any) -> None:
        """See `ToyPointing.observe`."""


class ToyNoise(Operator):
    """Noise."""

    requires = frozenset({"boresight"})
    provides = frozenset({"white"})
    knee: Hertz = quantity("0.5 Hz", gt=0)
    """Knee."""

    def exec(self, block: Any, state: Any) -> None:
        """See `ToyPointing.observe`."""


class ToySum(Operator):
    """Calibrated sum."""

    requires = frozenset({"boresight"})
    optional = frozenset({"sky", "white"})
    provides = frozenset({"signal"})

    def exec(self, block: Any, state: Any) -> None:
        """See `ToyPointing.observe`."""


class ToyMap(Operator):
    """A mapmaker."""

    requires = frozenset({"signal"})
    provides = frozenset({"map"})
    pixel: Angle = quantity("2 arcsec", gt=0)
    """Pixel size."""

    def exec(self, block: Any, state: Any) -> None:
        """See `ToyPointing.observe`."""


def toy_camera() -> Instrument:
    return Instrument(
        name="toy_camera",
        telescope=Telescope(name="toy", diameter="100 m"),
        band="toy_band",
        detectors=7,
        field_of_view="4 arcmin",
        main_beam_efficiency=0.3,
        illumination_efficiency=0.8,
        net="1.7 mK s(1/2)",
        sample_rate="100 Hz",
    )


@pytest.fixture
def toys(fresh_registries: None) -> Any:
    """Toy operators, site, band and instrument, registered as a script would."""
    registry.sites.register(
        Site(name="toy_site", latitude="38 deg", longitude="-79 deg", altitude="800 m")
    )
    registry.bands.register(Band(name="toy_band", low="78 GHz", high="108 GHz"))
    registry.instruments.register(toy_camera)
    for operator in (ToyPointing, ToySky, ToyNoise, ToySum):
        registry.operators.register(operator)
    registry.operators.register(ToyMap)
    return SimpleNamespace(
        head=(
            "site: toy_site\ninstrument: toy_camera\ntime: 2024-11-25T07:00\ntarget: 05h00m00s"
            " +20d00m00s\nseed: 3\n"
        ),
        steps=(
            "operators:\n  - ToyPointing: {duration: 45 min}\n  - ToySky\n  - ToyNoise\n  -"
            " ToySum:\n  - ToyMap\n"
        ),
    )
