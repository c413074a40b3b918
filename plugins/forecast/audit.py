"""Simulated depths beside the forecast: `zonda sensitivity --audit N`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from zonda.core.accuracy.metrics import Metric
from zonda.core.configuration.loaded import PipelineFile
from zonda.core.data import Data
from zonda.core.errors import InputError
from zonda.core.experiment.experiment import Experiment
from zonda.core.experiment.variant import Variant
from zonda.core.maps.map_product import MapProduct
from zonda.core.numerics.sphere import FWHM_PER_SIGMA
from zonda.core.pipeline import Pipeline
from zonda.core.signal import product_name, stream_of
from zonda.core.tables import aligned
from zonda.core.types import Floats
from zonda.operators.maps.bin_map import BinMap

from .depth import PARTS, Depth, prefixed, scatter
from .survey import steps_of

if TYPE_CHECKING:
    from zonda.operators.sky.skymap import SkyMap

    from .source import Seen

COMPONENTS = {"white": "white", "1/f": "pink", "atmosphere": "atmosphere"}
"""By part of the noise, the component that makes it."""
TOGETHER = "together"
SKY = "only_source"
GIVEN = "source_unfiltered"
RATIO = "S/N"
"""Rows that begin so are numbers; the others K_RJ."""


@dataclass(frozen=True)
class Row:
    """One part of the noise, K_RJ.

    Attributes
    ----------
    forecast
        Rms of the forecast.
    mean, error
        Root of the mean square over ``seeds`` simulated maps, and its standard error: that from
        their scatter, or from the scatter that white noise would have (`depth.scatter`) if that is
        more, since few seeds do not tell their own.
    """

    part: str
    forecast: float
    mean: float
    error: float
    seeds: int

    @property
    def difference(self) -> float:
        """Difference of the forecast from the simulation, relative to the simulation."""
        return self.forecast / self.mean - 1 if self.mean > 0 else math.nan

    @property
    def z(self) -> float:
        """The difference in standard errors of what was simulated."""
        return (self.forecast - self.mean) / self.error if self.error > 0 else math.nan


@dataclass(frozen=True)
class Audited:
    """Table of the parts, and of the total noise."""

    rows: tuple[Row, ...]

    @property
    def together(self) -> Row | None:
        """Row of the total noise; None if a part of it is not forecast."""
        return next((r for r in self.rows if r.part == TOGETHER), None)

    def as_dict(self) -> list[dict[str, Any]]:
        """The rows, for JSON."""
        return [{**asdict(r), "difference": r.difference, "z": r.z} for r in self.rows]

    def __str__(self) -> str:
        kelvin = [r for r in self.rows if not r.part.startswith(RATIO)]
        factor, unit = prefixed(max(r.mean for r in kelvin), "K_RJ")
        head = ("", f"forecast [{unit}]", "simulated", "standard error", "difference", "z")
        table = []
        for r in self.rows:
            scale = factor if r in kelvin else 1.0
            figures = (f"{v * scale:.4g}" for v in (r.forecast, r.mean, r.error))
            table.append((r.part, *figures, f"{100 * r.difference:+.1f} %", f"{r.z:+.1f}"))
        title = f"audit: {self.rows[0].seeds} simulations of the whole pipeline"
        return "\n".join([title, *aligned(table, head, "<>")])


@dataclass(frozen=True)
class Forecasted:
    """Forecast beside the simulations: the depths of a map's planes, the radius of its circle and
    its beam's FWHM, rad; the place that the circle is about, if not the map's centre; the source.
    """

    planes: Mapping[str, Depth]
    radius: float
    fwhm: float
    centre: tuple[float, float] | None = None
    source: Seen | None = None

    def parts(self, plane: str) -> list[str]:
        """The parts of the noise that are forecast of a plane, but for those that it has not."""
        return [p for p in PARTS if self.planes[plane].variance[p][-1] > 0]


def audit(
    file: PipelineFile,
    forecasts: Mapping[str, Forecasted],
    seeds: int,
    threads: int | None = None,
) -> dict[str, Audited]:
    """Simulate a pipeline with ``seeds`` seeds, from its own on, and compare the noise of its maps
    with the ``forecasts``.

    They are by the name of the band, "" where the camera has one. The parts are signals of one run,
    behind the modes of the complete one, so that their maps add up to its map.
    """
    if seeds < 2:
        raise InputError(
            f"{seeds} simulation has no standard error",
            place="--audit",
            cure="ask for 2 or more",
        )
    every = list(dict.fromkeys(p for f in forecasts.values() for p in f.parts("I")))
    first = file.scene().seed
    made = list[dict[str, dict[str, MapProduct]]]()
    sky = next((f.source.sky for f in forecasts.values() if f.source), None)
    variant = _signals(file, every, sky)
    name = next(o.product for o in variant.pipeline.operators if isinstance(o, BinMap))
    metrics = [_Maps(every, list(forecasts), name, sky is not None)]
    experiment = Experiment([variant], range(first, first + seeds), metrics, threads=threads)
    experiment.run(take=lambda _, number, found: made.extend(found.values()))
    return {
        band: Audited(tuple(_audited(of, [one[band] for one in made], sky)))
        for band, of in forecasts.items()
    }


def _audited(of: Forecasted, made: list[dict[str, MapProduct]], sky: SkyMap | None) -> list[Row]:
    """``made``: of each seed the maps of each part of the noise, and of all of it."""
    rows = []
    if of.centre is not None:
        made = [{k: replace(m, centre=of.centre) for k, m in one.items()} for one in made]
    for plane, depth in of.planes.items():
        parts = of.parts(plane)
        together = [TOGETHER] if len(depth.known) == len(PARTS) else []
        for name in parts + together:
            forecast = sum(
                float(depth.variance[p][-1]) for p in (parts if name == TOGETHER else [name])
            )
            maps = [
                one[name] if one[name].polarization is None else one[name].stokes(plane)
                for one in made
            ]
            what = name if plane == "I" else f"{plane} {name}"
            rows.append(_row(what, math.sqrt(forecast), maps, of))
    if of.source is not None and sky is not None:
        rows += _of_source(of, of.source, made, of.source.sky.scale / sky.scale)
    return rows


def _row(what: str, forecast: float, maps: Sequence[MapProduct], of: Forecasted) -> Row:
    """Rms of maps in the circle beside its forecast."""
    squares = np.array([m.smoothed_rms(m.fwhm, of.radius) ** 2 for m in maps])
    mean = math.sqrt(squares.mean())
    own = float(squares.std(ddof=1)) / (2 * mean)
    error = max(own, scatter(of.fwhm / FWHM_PER_SIGMA, of.radius) * mean) / math.sqrt(len(maps))
    return Row(what, forecast, mean, error, len(maps))


def _of_source(
    of: Forecasted,
    source: Seen,
    made: list[dict[str, MapProduct]],
    scale: float,
) -> list[Row]:
    """Rows of the source: its peak, and its S/N by all noise; ``scale``: of the source over the one
    in the maps.
    """
    depth = of.planes["I"]
    end = float(of.planes["I"].seconds[-1])
    maps = [{k: one[k].by_stokes()["I"] for k in (SKY, GIVEN, TOGETHER)} for one in made]
    sigma = of.fwhm / FWHM_PER_SIGMA
    beam = np.exp(-((maps[0][SKY].distance() / sigma) ** 2) / 2)
    peaks = scale * np.array([_mean(m[SKY], beam) for m in maps])
    mean = abs(float(peaks.mean()))
    seeds = len(made)
    pixels = maps[0][SKY].pixel ** 2 / 24 / sigma**2  # share of a point's peak that they smear
    error = math.hypot(float(peaks.std(ddof=1)) / math.sqrt(seeds), pixels * mean)
    rows = [Row("peak of the source", abs(float(source.left(end))), mean, error, seeds)]
    noise = _row(TOGETHER, float(depth.total(end)), [m[TOGETHER] for m in maps], of)
    ratio = mean / noise.mean
    error = ratio * math.hypot(error / mean, noise.error / noise.mean)
    rows.append(Row(f"{RATIO} peak", float(source.snr(depth, end)), ratio, error, seeds))
    sums = np.array(
        [[_mean(m, one[GIVEN].signal) for m in (one[SKY], one[TOGETHER])] for one in maps]
    )
    ratio = scale * float(sums[:, 0].mean() / np.sqrt((sums[:, 1] ** 2).mean()))
    error = ratio / math.sqrt(2 * seeds)  # of the rms of so many normal deviates
    forecast = float(source.snr(depth, end, "template"))
    return [*rows, Row(f"{RATIO} template", forecast, ratio, error, seeds)]


def _mean(product: MapProduct, template: Floats) -> float:
    """sum w k m / sum w k of a map m with the weights w, k a template."""
    known = np.isfinite(product.signal * template)
    weight = (product.weights * template)[known]
    return float(weight @ product.signal[known] / weight.sum())


def _signals(file: PipelineFile, parts: Sequence[str], sky: SkyMap | None) -> Variant:
    """The pipeline with a signal of each part of the noise, and with a source and its signals."""
    operators = [
        o.model_copy(update={"smooth": None, "half_difference": False})
        if isinstance(o, BinMap)
        else o
        for o in steps_of(file).operators
    ]
    runs = {
        f"only_{COMPONENTS[p]}": {"only": [COMPONENTS[p]], "modes": "full"}
        for p in parts
        if len(parts) > 1 or sky
    }
    if sky is not None:
        pointing = [k for k, o in enumerate(operators) if "boresight" in o.provides]
        operators.insert(pointing[-1] + 1, sky)
        alone: dict[str, Any] = {"only": ["sky"], "modes": "full"}
        runs |= {"noise": {"without": ["sky"], "modes": "full"}, SKY: alone}
        runs |= {GIVEN: {**alone, "filters": "none"}}
    header = file.header
    pipeline = Pipeline(operators, runs=runs, name=header.name, precision=header.precision)
    return Variant(pipeline, file.scene())


class _Maps(Metric):
    """Maps of each part, and of the total noise, by band ("" where there is one); and of the
    source, filtered and not, where there is one."""

    def __init__(self, parts: Sequence[str], bands: Sequence[str], name: str, source: bool) -> None:
        self.parts = parts
        self.bands = bands
        self.name = name
        self.source = source

    def measure(self, data: Data) -> dict[str, dict[str, MapProduct]]:
        found = {}
        for band in self.bands:
            plain = f"{self.name}_{band}" if band else self.name
            signals = {TOGETHER: "noise", SKY: SKY, GIVEN: GIVEN} if self.source else {TOGETHER: ""}
            alone = len(self.parts) == 1 and not self.source
            signals |= {p: "" if alone else f"only_{COMPONENTS[p]}" for p in self.parts}
            found[band] = {
                what: data.products[product_name(stream_of(signal), plain)]
                for what, signal in signals.items()
            }
        return found
