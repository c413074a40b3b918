"""Planning of the sky: bounds, coarser forms and memory (`core.plan`)."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from zonda.core.data import Observation
from zonda.core.instrument import Band
from zonda.core.numerics.radiation import (
    ELECTRON_REST_ENERGY,
    HOTTEST_GAS,
    sz_of_band,
    sz_per_y,
)
from zonda.core.plan.bounds import (
    Bound,
    Choice,
    Context,
    Effect,
    Estimate,
    Saving,
    Traits,
    exact,
    full,
    not_simulated,
    single,
)
from zonda.core.plan.planning import Knob, Planning

from .beam import margins
from .convolved import conversion
from .gridding import Grid, extremes
from .sky_input import GAS
from .skymap import SkyMap

CUBIC = 3e-3
"""Largest error of cubic B-splines on 4 points per FWHM, of a point source's peak (`SkyMap`)."""

COORDINATES = 5e-4 / 4
"""Error of float32 coordinates, beams (`sampling`)."""

LINEAR = 1.1 * 2 * 8 * math.log(2) / 12
"""Times n^-2: error of linear sampling on n points per FWHM, of a point source's peak: 1.1 h^2 / 12
(|f_xx| + |f_yy|).
"""

PENCIL, STRAIGHT = Saving("deep_field", 0.035), Saving("atlast_reduced", 0.034)
"""Of no beam; of linear sampling."""


def chromaticity(band: Band) -> float:
    """Relative change of a point source's peak where FWHM ~ 1 / nu: |<(nu / nu_0)^2> - 1| over the
    band.
    """
    nu = band.frequency
    t = band.transmission
    return abs(float(np.trapezoid(t * (nu / band.centre) ** 2, nu) / np.trapezoid(t, nu)) - 1)


class SkyPlanning(Planning[SkyMap]):
    """Planning of `SkyMap`: beam, sampling, chromaticity."""

    of = SkyMap
    knobs = (
        Knob("pixels_per_fwhm", (2, 3, 4, 6, 8), "sky interpolated between points"),
        Knob(
            "interpolation",
            ("linear", "cubic"),
            "sky linear between points, not by cubic splines",
        ),
    )

    def memory(self, observation: Observation) -> int:
        """The map, the coefficients of each beam (float64 and float32), and the transforms of one
        while it is convolved: grids of 8 bytes.
        """
        widths, _ = self.operator.beam_widths(observation)
        grid = self.operator.grid_of(observation)
        polarized = grid.source.polarization is not None
        angles = 40 * observation.n_samples if polarized else 0
        cells = [np.prod(self._convolved_shape(grid, float(fwhm))) for fwhm in widths]
        spread = 1 if grid.gridding is None or grid.is_flat else len(widths)  # for each beam
        coefficients = (36 if polarized else 12) * sum(cells) + 24 * max(cells)
        return int(grid.source.nbytes + spread * grid.nbytes + coefficients) + angles

    def _convolved_shape(self, grid: Grid, fwhm: float) -> tuple[int, int]:
        """(ny, nx) on which the map is convolved."""
        if grid.gridding is not None:
            return grid.shape
        jacobian = np.radians(np.asarray(grid.wcs.pixel_scale_matrix, np.float64))
        return margins(grid.shape, jacobian, fwhm, self.operator.pixels_per_fwhm)[2]

    def traits(self, observation: Observation) -> Traits:
        """Largest brightness of the map before the beam."""
        sky = self.operator
        band = observation.instrument.band
        grid = sky.grid_of(observation)
        if not grid.reached(observation, self._widest(observation)):
            return Traits(peak=abs(sky.outside))
        if not grid.resampled:
            values = sky.brightness_on(grid, band).planes[0]
            return Traits(peak=float(np.nanmax(np.abs(values - sky.outside), initial=0.0)))
        found = conversion(grid, band, sky.spectral_index)
        factor = sky.scale * float(np.asarray(found.factor).max())
        ends = extremes(grid.source, grid.wcs, grid.tiles, found.per_area)
        return Traits(peak=max(abs(v * factor - sky.outside) for v in ends))

    def _widest(self, observation: Observation) -> float:
        return float(self.operator.beam_widths(observation)[0].max(initial=0.0))

    def estimate(self, context: Context) -> Estimate:
        """Each effect as a share of a point source's peak."""
        o = context.first
        step = self.operator
        widest = self._widest(context.first)
        fwhm = 0.0
        what = "not convolved: no detector reaches the map"
        if any(step.grid_of(x).reached(x, widest) for x in context.observations):
            fwhm = float(step.fwhm or o.focalplane.fwhm.max())
            what = "Gaussian"
            if step.beam != "gaussian":
                fwhm = 0.0
                what = "none"
        choices = (full(what), *self._without_beam(context, fwhm))
        effects: tuple[Effect, ...] = (
            Effect("beam convolution", choices, context.sky_error(1.0), "the sky's peak"),
            self._order(context, step.grid_of(o), fwhm),
            exact(
                "coordinate precision",
                context.sky_error(1.43 * COORDINATES),
                "1.43 x 5e-4 pixel of a quarter beam",
                "float32 offsets",
            ),
            one_beam(context),
        )
        if step.te is not None:
            terms = sz_of_band(o.instrument.band)
            hottest = HOTTEST_GAS if isinstance(step.te, Path) else step.te
            last = terms[-1] * (hottest / ELECTRON_REST_ENERGY) ** (len(terms) - 1)
            share = float(abs(last / sz_per_y(terms, hottest)))
            text = "the series' last term over its sum, of the sky's peak"
            what = f"to theta^5: {step.grid_of(o).source.notes[GAS]}"
            effects += (exact("relativistic SZ", context.sky_error(share), text, what),)
        return Estimate(effects)

    def _without_beam(self, context: Context, fwhm: float) -> list[Choice]:
        """A pencil beam changes waves on the map by 1 - exp(-2 pi^2 sigma^2 k^2), most at the
        pixels' Nyquist frequency.
        """
        if not fwhm or not context.coverage:
            return []
        exponent = 2 * math.pi**2 * fwhm**2 / (8 * math.log(2)) / (2 * context.coverage.pixel) ** 2
        text = "1 - exp(-2 pi^2 sigma^2 k^2) at k = 1 / (2 pixel) of the map, of the sky's peak"
        bound = context.sky_error(-math.expm1(-exponent))
        bound["transfer"] = math.expm1(min(exponent, 700.0))  # of the waves under the beam
        settings = {"beam": "none", "fwhm": None}
        bound = context.behind_modes(bound)
        return [Choice("dropped", "no beam", settings, False, bound, text, saves=PENCIL)]

    def _order(self, context: Context, grid: Grid, fwhm: float) -> Effect:
        """Linear sampling for cubic splines, on the grid there is."""
        operator = self.operator
        name = "sampling order"
        cubic = "cubic B-spline"
        if operator.interpolation == "linear" or not fwhm:
            what = "linear" if operator.interpolation == "linear" else cubic
            return exact(name, context.sky_error(CUBIC), "0.3 % of a point source's peak", what)
        scale = np.linalg.norm(np.asarray(grid.wcs.pixel_scale_matrix), axis=0)
        points = fwhm / float(np.radians(scale).max())
        finer = 2 <= points < operator.pixels_per_fwhm
        n = points * (math.ceil(operator.pixels_per_fwhm / points - 1e-9) if finer else 1)
        text = (
            "1.1 h^2 / 12 (|f_xx| + |f_yy|) of a point source on n points h apart per FWHM: 1.02 /"
            " n^2 of its peak"
        )
        bound = context.sky_error(LINEAR / n**2)
        settings = {"interpolation": "linear"}
        linear = Choice("coarse", "linear", settings, False, bound, text, saves=STRAIGHT)
        return Effect(name, (full(cubic), linear), bound, text)


def one_beam(context: Context) -> Effect:
    """Effect of the beam's change over the band, which is not simulated."""
    return not_simulated(
        "beam chromaticity",
        "one beam for the band",
        context.sky_error(chromaticity(context.first.instrument.band)),
        "|<(nu / nu_0)^2> - 1| over the band: FWHM ~ 1 / nu, a point source's peak",
    )


def brightness(traits: Traits) -> Bound:
    """Bound on the error of a sky that is left out."""
    peak = traits.peak or 0.0
    return {"tod": peak, "map_rms": peak, "peak": peak, "transfer": 1.0}


class SourcesPlanning(Planning[Any]):
    """Planning of `PointSources`, which is exact but for the beam: one for the band."""

    of = "zonda.operators.sky.point_sources:PointSources"

    def traits(self, observation: Observation) -> Traits:
        """Brightness of the brightest source in the smallest beam."""
        found = self._seen(observation)
        area = math.pi * float(observation.focalplane.fwhm.min()) ** 2 / (4 * math.log(2))
        return Traits(peak=float(np.abs(found.power[found.in_view]).max(initial=0.0)) / area)

    def memory(self, observation: Observation) -> int:
        """The catalogue, and lists of what is in view."""
        found = self._seen(observation)
        lists = 8 * len(found.number)
        sources = 100 * len(found.power)
        return lists + 200 * observation.n_detectors + sources

    def estimate(self, context: Context) -> Estimate:
        """Error of leaving the step out: the brightest source."""
        text = "the brightest source in its beam"
        what = "exact: each through its beam"
        size = brightness(self.traits(context.first))
        return Estimate((exact("point sources", size, text, what), one_beam(context)))

    def _seen(self, observation: Observation) -> Any:
        from .point_sources import Sources

        return Sources.of(self.operator, observation)


class CMBPlanning(Planning[Any]):
    """Planning of `CMBSky`, which has no coarser form. The map is not drawn for it."""

    of = "zonda.operators.sky.cmb:CMBSky"

    def traits(self, observation: Observation) -> Traits:
        """Four and a half standard deviations of the sky, which is larger than 1 K_RJ per K_CMB
        nowhere.
        """
        spectrum = self.operator.read().values[0]
        variance = (2 * np.arange(len(spectrum)) + 1) @ spectrum / (4 * math.pi)
        return Traits(peak=4.5 * math.sqrt(float(variance)))

    def memory(self, observation: Observation) -> int:
        """Bytes while the maps become a table: more than drawing them takes. 47 and 110 were
        measured for each pixel.
        """
        polarized = observation.focalplane.polarized and self.operator.read().values[1:].any()
        return int(12 * self.operator.nside**2 * (110 if polarized else 50))

    def estimate(self, context: Context) -> Estimate:
        """Error of leaving the step out."""
        size = brightness(self.traits(context.first))
        what = f"drawn at nside {self.operator.nside}"
        return single("CMB", size, "4.5 (sum (2 l + 1) C_l / 4 pi)^(1/2), K_CMB", what)


class PySMPlanning(Planning[Any]):
    """Planning of `PySMSky`, which has no coarser form. The map of the band is made for it, and
    serves the run.
    """

    of = "zonda.operators.sky.pysm:PySMSky"

    def traits(self, observation: Observation) -> Traits:
        """Largest brightness where the scan looks."""
        return self._sampled(observation).traits(observation)

    def memory(self, observation: Observation) -> int:
        """Templates and maps, and what `SkyMap` keeps of them."""
        number = len(self.operator.models) + len(self.operator.components)
        own = int(12 * self.operator.nside**2 * 8 * (6 + 6 * number))
        return own + self._sampled(observation).memory(observation)

    def estimate(self, context: Context) -> Estimate:
        """Error of leaving the step out."""
        size = brightness(self.traits(context.first))
        what = f"at nside {self.operator.nside}"
        return single("sky of PySM", size, "largest brightness in view", what)

    def _sampled(self, observation: Observation) -> SkyPlanning:
        return SkyPlanning(self.operator.sky(observation))
