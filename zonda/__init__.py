"""Simulation of the data of ground-based (sub-)millimetre telescopes, and of the maps made from
them.

>>> import zonda
>>> scene = zonda.Scene(site="green_bank", instrument="mustang2", time="2024-11-25T07:00",
target="05h +20d", seed=1)

Nothing heavy is imported until a name is used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_WHERE = {
    "Data": "zonda.core.data",
    "Observation": "zonda.core.data",
    "Focalplane": "zonda.core.focalplane",
    "Scene": "zonda.core.scene",
    "Site": "zonda.core.site",
    "Instrument": "zonda.core.instrument",
    "Telescope": "zonda.core.instrument",
    "Band": "zonda.core.instrument",
    "Operator": "zonda.core.operator",
    "Pipeline": "zonda.core.pipeline",
    "ZondaError": "zonda.core.errors",
    "load": "zonda.core.configuration.pipeline_file",
    "plan": "zonda.core.plan.planner",
    "campaign": "zonda.core.campaign.function",
    "map": "zonda.core.mapping",
    "Variant": "zonda.core.experiment.variant",
    "Experiment": "zonda.core.experiment.experiment",
    "measure": "zonda.core.figures",
    "sensitivity": "zonda.plugins.forecast.sensitivity",
    "read_map": "zonda.core.maps.read_map",
    "hookimpl": "zonda.core.hooks",
    # for authors of operators
    "Block": "zonda.core.block",
    "Stream": "zonda.core.stream",
    "Product": "zonda.core.product",
    "Component": "zonda.core.signal",
    "Signal": "zonda.core.signal",
    "product_name": "zonda.core.signal",
    "MapMaker": "zonda.core.mapmaker",
    "Output": "zonda.core.output",
    "StreamOutput": "zonda.core.output",
    "Planning": "zonda.core.plan.planning",
    "Figure": "zonda.core.figures",
    "FigureMetric": "zonda.core.figures",
    "Knob": "zonda.core.plan.planning",
    "NoiseModel": "zonda.operators.noise.models",
    "register": "zonda.core.registry",
    "operator": "zonda.core.function_operator",
    "normals": "zonda.core.numerics.random",
    "uniforms": "zonda.core.numerics.random",
    "quantity": "zonda.core.configuration.parameters",
    "WeatherSource": "zonda.core.weather",
    "Column": "zonda.core.weather",
} | dict.fromkeys(
    (
        "Angle",
        "AngularSpeed",
        "AngularAcceleration",
        "Seconds",
        "Hertz",
        "Metres",
        "MetresPerSecond",
        "Kelvin",
        "KelvinRootSecond",
        "Fraction",
    ),
    "zonda.core.configuration.units",
)

_MODULES = "linear", "testing"

__all__ = ["__version__", *_WHERE]

if TYPE_CHECKING:
    from zonda.core.block import Block as Block
    from zonda.core.campaign.function import campaign as campaign
    from zonda.core.configuration.parameters import quantity as quantity
    from zonda.core.configuration.pipeline_file import load as load
    from zonda.core.configuration.units import Angle as Angle
    from zonda.core.configuration.units import AngularAcceleration as AngularAcceleration
    from zonda.core.configuration.units import AngularSpeed as AngularSpeed
    from zonda.core.configuration.units import Fraction as Fraction
    from zonda.core.configuration.units import Hertz as Hertz
    from zonda.core.configuration.units import Kelvin as Kelvin
    from zonda.core.configuration.units import KelvinRootSecond as KelvinRootSecond
    from zonda.core.configuration.units import Metres as Metres
    from zonda.core.configuration.units import MetresPerSecond as MetresPerSecond
    from zonda.core.configuration.units import Seconds as Seconds
    from zonda.core.data import Data as Data
    from zonda.core.data import Observation as Observation
    from zonda.core.errors import ZondaError as ZondaError
    from zonda.core.experiment.experiment import Experiment as Experiment
    from zonda.core.experiment.variant import Variant as Variant
    from zonda.core.figures import Figure as Figure
    from zonda.core.figures import FigureMetric as FigureMetric
    from zonda.core.figures import measure as measure
    from zonda.core.focalplane import Focalplane as Focalplane
    from zonda.core.function_operator import operator as operator
    from zonda.core.hooks import hookimpl as hookimpl
    from zonda.core.instrument import Band as Band
    from zonda.core.instrument import Instrument as Instrument
    from zonda.core.instrument import Telescope as Telescope
    from zonda.core.mapmaker import MapMaker as MapMaker
    from zonda.core.mapping import map as map
    from zonda.core.maps.read_map import read_map as read_map
    from zonda.core.numerics.random import normals as normals
    from zonda.core.numerics.random import uniforms as uniforms
    from zonda.core.operator import Operator as Operator
    from zonda.core.output import Output as Output
    from zonda.core.output import StreamOutput as StreamOutput
    from zonda.core.pipeline import Pipeline as Pipeline
    from zonda.core.plan.planner import plan as plan
    from zonda.core.plan.planning import Knob as Knob
    from zonda.core.plan.planning import Planning as Planning
    from zonda.core.product import Product as Product
    from zonda.core.registry import register as register
    from zonda.core.scene import Scene as Scene
    from zonda.core.signal import Component as Component
    from zonda.core.signal import Signal as Signal
    from zonda.core.signal import product_name as product_name
    from zonda.core.site import Site as Site
    from zonda.core.stream import Stream as Stream
    from zonda.core.weather import Column as Column
    from zonda.core.weather import WeatherSource as WeatherSource
    from zonda.operators.noise.models import NoiseModel as NoiseModel

    sensitivity: Any
    # imported here by its module, it would close a circle: the forecast knows map makers, whose
    # files name this version


def __getattr__(name: str) -> Any:
    if name in _WHERE:
        return getattr(import_module(_WHERE[name]), name)
    if name in _MODULES:
        return import_module(f"zonda.{name}")
    if not name.startswith("_"):
        from zonda.core.registry import operators

        if name in operators:  # zonda.BinMap, zonda.WhiteNoise and every plugin's operator
            return operators.get(name)
        from difflib import get_close_matches

        near = get_close_matches(name, __dir__(), n=1)
        raise AttributeError(
            f"module 'zonda' has no attribute {name!r}"
            + (f"; did you mean {near[0]!r}?" if near else "")
        )
    raise AttributeError(f"module 'zonda' has no attribute {name!r}")


def __dir__() -> list[str]:
    from zonda.core.registry import operators

    return sorted({*__all__, *_MODULES, *operators})
