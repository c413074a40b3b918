"""The top level of a pipeline file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from ..scene import Scene
from ..signal import Signal
from .parameters import Parameters, quantity
from .units import Fraction, Kelvin


class Accuracy(Parameters):
    """Metric for which the knobs are chosen."""

    target: Fraction = Field(gt=0, le=1)
    """Largest error of the metric."""
    metric: str = "map_rms"
    """A metric of `zonda accuracy`."""

    @model_validator(mode="before")
    @classmethod
    def _target_alone(cls, value: Any) -> Any:
        return value if isinstance(value, dict | Accuracy) else {"target": value}


class Limits(Parameters):
    """Largest errors that the plan may add, in the products' own units."""

    map_rms: Kelvin | None = Field(None, ge=0)
    """rms per map pixel, e.g. 3 uK; where absent, a tenth of the noise."""
    peak: Kelvin | None = Field(None, ge=0)
    """Of the sky's brightness in the map; where absent, as `map_rms`."""
    transfer: Fraction | None = Field(None, ge=0, le=1)
    """Of the transfer function; where absent, 1 %."""
    tod: Kelvin | None = Field(None, ge=0)
    """rms of one sample of the calibrated time stream; where absent, a tenth of its white noise."""

    psd: Fraction | None = Field(None, ge=0, le=1)
    """Of the time stream's power spectrum, relative; where absent, 10 %."""

    @model_validator(mode="after")
    def _something(self) -> Limits:
        if not self.model_fields_set:
            raise ValueError(
                "state at least one of map_rms, peak, transfer, tod, psd; or a share of the noise,"
                " e.g. 10 %"
            )
        return self


class Header(Parameters):
    """Top level of a pipeline file, without its scene and its operators."""

    version: Literal[1] = 1
    """Version of this file format."""
    name: str = Field("", pattern=r"^$|^[A-Za-z0-9][\w .+-]*$")
    """Shown in products; where absent, the file's name without suffix."""
    description: str = ""
    """One line for `zonda pipelines`."""
    requires: list[str] = Field(default_factory=list)
    """Packages and versions this file needs, as pip writes them, e.g. zonda-toltec>=1.2."""
    runs: dict[str, Signal] = Field(default_factory=dict)
    """Further signals, e.g. noiseless: {only: [sky]} or source_free: {without: [sky]}: what a
    subset of the components makes.
    """
    only: list[str] = Field(default_factory=list)
    """Components that the complete signal is narrowed to (`--only`), at the levels of the whole
    scene; where absent, all.
    """
    precision: Literal["float32", "float64"] = "float32"
    """Type of the time streams."""
    accuracy: Accuracy | None = None
    """Error that the result may have from its approximations, e.g. 1 %, or {target: 1 %, metric:
    peak}: `zonda run` then takes the cheapest setting of the knobs that a stored Pareto front of
    `zonda accuracy` shows to meet it, else the tightest."""
    budget: Annotated[Fraction, Field(ge=0, le=1)] | Limits = quantity("10 %")
    """Errors that the plan may add: a share of the noise (0: simulate everything in full), or e.g.
    {map_rms: 3 uK}.
    """
    campaign: Any = None
    """None; a file with a campaign has the header of its `Section`."""
    sweep: Any = None
    """None; see `Section`."""
    outputs: Path | None = None
    """Folder for products, relative to the working directory; where absent, out/<name>."""

    @field_validator("outputs")
    @classmethod
    def _a_path(cls, value: Path | None) -> Path | None:
        if value is not None and "\0" in str(value):
            raise ValueError("a folder's name cannot hold a null character")
        return value


SCENE_KEYS = tuple(Scene.model_fields)
KEYS = [
    "version",
    "name",
    "description",
    "requires",
    "seed",
    "site",
    "instrument",
    "time",
    "target",
    "weather",
]
KEYS += [key for key in (*SCENE_KEYS, *Header.model_fields) if key not in KEYS] + ["operators"]
