"""Pipelines that a forecast covers, and their steps that matter for the noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from zonda.core.errors import PipelineError
from zonda.core.mapmaker import makes_products
from zonda.core.operator import Operator
from zonda.core.output import is_output
from zonda.operators.atmosphere.layers import AtmosphereLayers
from zonda.operators.filters.common_mode import CommonModeFilter
from zonda.operators.filters.highpass import HighpassFilter
from zonda.operators.maps.bin_map import BinMap
from zonda.operators.noise.pink import PinkNoise
from zonda.operators.noise.white import WhiteNoise
from zonda.operators.optics.efficiency import Efficiency
from zonda.operators.optics.polarizers import HalfWavePlate
from zonda.operators.sky.skymap import SkyMap

if TYPE_CHECKING:
    from zonda.core.configuration.loaded import PipelineFile

ANY = frozenset(("name",))
COVERED: dict[type[Operator], frozenset[str] | None] = {
    AtmosphereLayers: frozenset(AtmosphereLayers.model_fields) - {"beam", "edge_taper"},
    WhiteNoise: frozenset({"net", "reference", "model"}),
    PinkNoise: None,
    Efficiency: frozenset({"main_beam", "illumination"}),
    HighpassFilter: frozenset({"frequency", "degree", "oversampling"}),
    CommonModeFilter: frozenset({"method", "residual", "gap", "on_undetermined"}),
    BinMap: frozenset(
        {
            "pixel",
            "width",
            "height",
            "centre",
            "projection",
            "frame",
            "weights",
            "noise",
            "half_difference",
            "smooth",
            "product",
            "stokes",
            "condition_limit",
        }
    ),
    HalfWavePlate: None,
    SkyMap: None,
}
"""Parameters that may have any value; the others must have their defaults. None: all may."""

BY_SEEDS = "find the noise with `zonda run` and several seeds"
CURE = f"remove it, or {BY_SEEDS}"


@dataclass(frozen=True)
class Steps:
    """The steps that make, filter and map the noise.

    Attributes
    ----------
    operators
        In order; neither sky nor outputs.
    binning
        The map.
    highpass, common
        The filters; None: there is none.
    """

    operators: tuple[Operator, ...]
    binning: BinMap
    highpass: HighpassFilter | None
    common: CommonModeFilter | None

    @classmethod
    def among(cls, operators: Sequence[Operator]) -> Steps:
        """Select the steps that matter; they have one map and at most one of each filter."""
        binning = next(o for o in operators if isinstance(o, BinMap))
        highpass = next((o for o in operators if isinstance(o, HighpassFilter)), None)
        common = next((o for o in operators if isinstance(o, CommonModeFilter)), None)
        return cls(tuple(operators), binning, highpass, common)

    def of(self, kind: type[Any]) -> list[Any]:
        """Steps of one class."""
        return [o for o in self.operators if isinstance(o, kind)]


def steps_of(file: PipelineFile) -> Steps:
    """The steps of a pipeline file that matter for the noise of its map.

    Raises PipelineError for what the forecast does not cover, with the step's name.
    """
    kept: list[Operator] = []
    for step in file.steps:
        operator = step.operator
        if is_output(operator) or (makes_products(operator) and not isinstance(operator, BinMap)):
            continue
        if type(operator) is SkyMap:
            continue
        if "boresight" not in operator.provides:
            _check(operator, step.key)
        kept.append(operator)
    _check_together(kept, file.header.name)
    return Steps.among(kept)


def _check(operator: Operator, name: str) -> None:
    """Refuse an operator, or a parameter of it, that is not covered."""
    if type(operator) not in COVERED:
        raise PipelineError("the forecast does not cover this step", place=name, cure=CURE)
    free = COVERED[type(operator)]
    if free is None:
        return
    usual = type(operator)()
    for parameter in type(operator).model_fields:
        value = getattr(operator, parameter)
        if parameter not in free | ANY and value != getattr(usual, parameter):
            raise PipelineError(
                f"the forecast does not cover {parameter}: {value}",
                place=name,
                cure=f"leave {parameter} out, or {BY_SEEDS}",
            )


def _check_together(steps: Sequence[Operator], name: str) -> None:
    """Refuse what the forecast does not cover of several steps."""
    maps, highpass, common, air, white, pink = (
        [o for o in steps if isinstance(o, kind)]
        for kind in (
            BinMap,
            HighpassFilter,
            CommonModeFilter,
            AtmosphereLayers,
            WhiteNoise,
            PinkNoise,
        )
    )
    one = "have one BinMap"
    for wrong, text, cure in (
        (not maps, "there is no map", one),
        (len(maps) > 1, f"there are {len(maps)} maps, the forecast is of one", one),
        *(
            (len(o) > 1, f"{o[0].label}: there are {len(o)} of them, the forecast covers one", CURE)
            for o in (highpass, common, air)
            if o
        ),
        (not (air or white or pink), "nothing in this pipeline makes noise", "add WhiteNoise"),
        (
            highpass and common and steps.index(common[0]) < steps.index(highpass[0]),
            "the forecast covers a CommonModeFilter only after the HighpassFilter",
            "exchange the two",
        ),
        (
            air and not highpass,
            "without a HighpassFilter the mean emission of the atmosphere, tens of kelvin, is in"
            " the map",
            "add HighpassFilter, or leave AtmosphereLayers out",
        ),
        (
            not common and any(o.shared > 0 for o in pink if isinstance(o, PinkNoise)),
            "noise that detectors share adds up coherently without a CommonModeFilter, which the"
            " forecast does not cover",
            "add CommonModeFilter, or set PinkNoise.shared to 0",
        ),
    ):
        if wrong:
            raise PipelineError(text, place=name, cure=cure)
