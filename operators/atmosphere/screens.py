"""`AtmosphereScreens`: the turbulence that the detectors saw, as fields: each layer at a moment,
and their sum over the field.

The realization is that of `AtmosphereLayers` (the same random streams), evaluated at other places:
layer l on its lattice, in the frame that drifts with its wind, and the fluctuation of the PWV along
lines of sight over the field of view,

    dPWV = airmass PWV y,
    y as in equation (1) of `layers`.                                                (1)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from zonda.core.canvas import Sketch, shown_axes
from zonda.core.configuration.units import Seconds
from zonda.core.data import Data
from zonda.core.errors import InputError, PipelineError
from zonda.core.numerics.sphere import FWHM_PER_SIGMA
from zonda.core.output import Output, Progress
from zonda.core.storage.files import atomic_path, product_path
from zonda.core.storage.fits_files import header_of, write_image
from zonda.core.storage.table_files import Column, write_ecsv
from zonda.core.types import Floats, Integers

from .model import AtmosphereModel, ExpectedLoad
from .realization import drifting_layers, height_of_vapour
from .response import airmass
from .turbulence.lines_of_sight import LinesOfSight

ACROSS = (4, 5, 3)
"""Panels in a row: what leaves the fewest places empty."""
SIDE = 3.6, 3.2
"""Of a panel with its labels, in."""


@dataclass(frozen=True)
class LayerScreen:
    """One layer about the point that the boresight looks through at a moment.

    Attributes
    ----------
    height, distance
        Of the layer, and along the line of sight, m.
    wind
        (east, north), m/s.
    values
        (n_along, n_across) fluctuation of the PWV at zenith in this layer, m: p a_l g_l PWV.
    spacing
        Between the values, m.
    track
        (n, 2) across and along the wind, m, where the boresight passes through the layer during the
        scan; 0 at the moment.
    fwhm, field
        Width of the beam there, and diameter of the field of view, m.
    """

    height: float
    distance: float
    wind: tuple[float, float]
    values: Floats
    spacing: float
    track: Floats
    fwhm: float
    field: float

    def draw(self, ax: Any) -> None:
        """Draw its values, the track, the beam, the field of view and the wind."""
        from matplotlib.patches import Circle

        half = self.values.shape[0] * self.spacing / 2
        speed = math.hypot(*self.wind)
        azimuth = math.degrees(math.atan2(*self.wind)) % 360
        wind = f"wind {speed:.3g} m/s towards {azimuth:.0f}°"
        _image(ax, self.values, half, f"{self.height:.0f} m\n{wind}")
        ax.plot(*self.track.T, color="black", linewidth=0.6)
        here = tuple(self.track[np.abs(self.track).sum(axis=1).argmin()])
        ax.plot(*here, "x", color="black", markersize=5)
        for width, line in ((self.fwhm, "-"), (self.field, ":")):
            ax.add_patch(Circle(here, width / 2, fill=False, edgecolor="black", linestyle=line))
        arrow = {"arrowstyle": "-|>", "linewidth": 1.4}
        ax.annotate("", (-0.86 * half, 0.9 * half), (-0.86 * half, 0.5 * half), arrowprops=arrow)
        sides = (-half, half)
        ax.set(xlim=sides, ylim=sides, xlabel="across the wind [m]", ylabel="along the wind [m]")


@dataclass(frozen=True)
class Screens:
    """The layers at a moment, and the PWV over the field of view at several.

    Attributes
    ----------
    layers
        From the lowest up.
    moment
        Of ``layers``, s since the scan's start.
    seconds
        (k,) of ``pwv``, s since the scan's start.
    pwv
        (k, n, n) fluctuation of the PWV along the line of sight, m; rows eta, columns xi; NaN
        beyond the field.
    side
        Of the field, rad.
    mean_pwv
        At zenith, m.
    observation
        Name of the scan.
    """

    layers: list[LayerScreen]
    moment: float
    seconds: Floats
    pwv: Floats
    side: float
    mean_pwv: float
    observation: str

    def plot(self, layer: int = 0, ax: Any = None) -> Any:
        """Draw a layer (0: the lowest) into ``ax`` (default: a new figure), and return the
        matplotlib Axes. Raises InputError for a layer that there is not.
        """
        if not -len(self.layers) <= layer < len(self.layers):
            cure = f"choose 0 (the lowest) to {len(self.layers) - 1}"
            raise InputError(f"there is no layer {layer}", place="atmosphere", cure=cure)
        ax = shown_axes(ax, (5.4, 4.6))
        self.layers[layer].draw(ax)
        return ax

    def sketches(self, name: str) -> list[Sketch]:
        """The layers, and the strip; see `core.canvas.Drawable`."""
        layers = _panels(len(self.layers))
        for ax, layer in zip(layers, self.layers, strict=True):
            layer.draw(ax)
        text = (
            "PWV fluctuation (at zenith) in each simulated layer,"
            f" {self.moment:.3g} s after the start of {self.observation}, in the frame that drifts"
            " with the layer's wind (arrow). Line: where the boresight passes through the layer in"
            " the scan; cross: at this moment; solid circle: the beam (FWHM); dotted: the field of"
            " view."
        )
        strip = _panels(len(self.seconds))
        half = math.degrees(self.side) * 30
        for ax, second, pwv in zip(strip, self.seconds, self.pwv, strict=True):
            mean = np.nanmean(pwv)
            _image(ax, pwv - mean, half, f"{second:.3g} s\nmean {mean * 1e6:+.3g} µm")
            ax.set(xlabel="xi [arcmin]", ylabel="eta [arcmin]")
        caption = (
            "Fluctuation of the PWV along the line of sight [µm] over the field of view of"
            f" {self.observation}, minus its mean over the field, which each title states. Mean PWV"
            f" {self.mean_pwv * 1e3:.3g} mm."
        )
        return [
            Sketch(f"{name}_layers", "Turbulent layers", text, layers[0]),
            Sketch(f"{name}_field", "PWV over the field", caption, strip[0]),
        ]


def _panels(count: int) -> list[Any]:
    """``count`` axes in rows."""
    from matplotlib.figure import Figure

    columns = min(count, min(ACROSS, key=lambda n: -count % n))
    rows = -(-count // columns)
    size = columns * SIDE[0], rows * SIDE[1]
    figure = Figure(figsize=size, dpi=110, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
    for ax in axes[count:]:
        ax.remove()
    return axes[:count]


def _image(ax: Any, values: Floats, half: float, title: str) -> None:
    """Values [m] in µm, with a colour bar of its own, zero in white."""
    shown = np.ma.masked_invalid(values * 1e6)
    top = float(np.abs(shown).max()) or 1.0
    sides = (-half, half, -half, half)
    picture = ax.imshow(shown, origin="lower", extent=sides, cmap="RdBu_r", vmin=-top, vmax=top)
    ax.figure.colorbar(picture, ax=ax, shrink=0.8, label="change of the PWV [µm]")
    ax.locator_params(nbins=5)
    ax.set_title(title, fontsize=9)


MOST_CELLS = 400
"""Lattice points along each side of a layer's picture."""
LEAST_BEAMS = 4.0
"""Width of a layer's picture in beams, at least."""


NOTHING = "there is no atmosphere to show"


class AtmosphereScreens(Output):
    """Pictures and files of the simulated turbulence: each layer at a moment, and the PWV over the
    field as time goes on.

    They show the realization that the detectors saw. Each layer is shown in the frame that drifts
    with its wind, with the wind, the beam, the field of view and the boresight's track through it.
    Makes the product ``screens`` (a `Screens`); where there is an output folder, it is written
    there as ``screens.fits`` and ``screens.ecsv``. `Plots` and `Report` show it.

    Raises `PipelineError` where there is no `AtmosphereLayers`, or no scan of that number. A
    campaign has none: its log says so.
    """

    requires = frozenset({"boresight"})
    optional = frozenset({"atmosphere"})
    provides = frozenset({"screens"})
    one_band = True

    observation: int = Field(0, ge=0)
    """Number of the scan, counted from 0."""
    moment: Seconds | None = Field(None, ge=0, examples=["30 s"])
    """When the layers are shown, since the start of the scan. Default: the middle."""
    moments: int = Field(6, ge=1, le=100)
    """How many pictures of the PWV over the field, evenly over the scan."""
    pixels: int = Field(48, ge=4, le=512)
    """Points along each side of the field."""

    def check(self, data: Data) -> list[str]:
        """Refuse a scan that is not there, once the telescope is pointed."""
        if data.observations:
            data.check_scan(self.observation, self.label)
        if data.made and "atmosphere" not in data.made:
            raise PipelineError(NOTHING, place=self.label, cure="add AtmosphereLayers")
        return []

    def watch(self, data: Data, done: Progress) -> None:
        """Refuse a scan that is not there before any is simulated; a part of a campaign does not
        know how many there are.
        """
        if done == "pointing" and not data.laid_out:
            data.check_scan(self.observation, self.label)

    def finalize(self, data: Data) -> None:
        """Evaluate the layers and write them; on the sum of a campaign's scans, which has no scan
        any more, say so instead.
        """
        if data.laid_out:
            text = "the scans of a campaign are not here when it is combined; run one of them"
            data.log.state(self.label, "not drawn", text)
            return
        data.check_scan(self.observation, self.label)
        load = data.observations[self.observation].expected_load
        if not isinstance(load, ExpectedLoad):
            raise PipelineError(NOTHING, place=self.label, cure="add AtmosphereLayers")
        found = screens(load.model(), self.moment, self.moments, self.pixels)
        key = self.name or "screens"
        data.products[key] = found
        if data.output is not None:
            write(found, product_path(data.output, data.named(key)))


def screens(model: AtmosphereModel, moment: float | None, moments: int, pixels: int) -> Screens:
    """The layers of an observation at a ``moment`` [s] after its start, and the PWV over the field
    at ``moments``.
    """
    o = model.observation
    seconds = np.asarray(o.seconds_at(np.arange(o.n_samples, dtype=np.int64)), np.float64)
    seconds = seconds - seconds[0]
    at = (
        o.n_samples // 2
        if moment is None
        else int(np.searchsorted(seconds, min(moment, float(seconds[-1]))))
    )
    step = model.resolution().step
    samples = np.linspace(0, o.n_samples - 1, moments + 2)[1:-1].astype(np.int64) // step * step
    plane = o.focalplane
    radius = max(
        float(np.hypot(plane.xi, plane.eta).max()),
        float(plane.fwhm.max()) / 2,
    )  # of one detector its beam
    line = np.linspace(-1, 1, pixels) * radius
    xi, eta = (grid.ravel() for grid in np.meshgrid(line, line))
    inside = np.hypot(xi, eta) <= radius * (1 + 1e-9)
    pwv = np.full((moments, pixels * pixels), np.nan)
    pwv[:, inside] = pwv_at(model, xi[inside], eta[inside], samples).T
    layers = _layers(model, at)
    cube = pwv.reshape(moments, pixels, pixels)
    return Screens(
        layers,
        float(seconds[at]),
        seconds[samples],
        cube,
        2 * radius,
        model.pwv,
        o.name,
    )


def pwv_at(model: AtmosphereModel, xi: Floats, eta: Floats, samples: Integers) -> Floats:
    """(n, k) fluctuation of the PWV [m] along lines of sight at focal-plane offsets (n,) and
    samples (k,), equation (1).

    Samples are rounded down to the times that `AtmosphereLayers` evaluates.
    """
    step = model.resolution().step
    law = model.fluctuation
    layers = drifting_layers(model, (xi, eta))
    height = height_of_vapour(model)
    found = []
    for sample in samples:
        g, sine = layers(xi, eta, int(sample) // step, 1)
        strength = model.strength(sine)
        y = np.clip(
            law(g if strength is None else g * strength),
            -1.0,
            model.band.pwv_max / model.pwv - 1,
        )
        found.append((model.pwv * y * airmass(np.arcsin(sine), height))[:, 0])
    return np.stack(found, axis=1)


def _layers(model: AtmosphereModel, at: int) -> list[LayerScreen]:
    """Every layer that is simulated about the boresight's place at sample ``at``."""
    o = model.observation
    plane = model.plane
    step = max(1, o.n_samples // 2000)
    samples = np.append(np.arange(0, o.n_samples, step), at)
    path = LinesOfSight(o, plane, 1, 0, o.n_samples)
    zero = np.zeros(1)
    x, y, _ = path(zero, zero, 0, o.n_samples)
    crossing = np.stack([x[0], y[0]])[:, samples]
    angle = 2 * float(np.hypot(o.focalplane.xi, o.focalplane.eta).max())
    found = []
    for number in model.simulated:
        layer = model.layers[number]
        field = model.turbulence[number]
        matrix, start, velocity = plane.affine(layer.height, layer.wind)
        place = (
            matrix @ crossing + start[:, None] + velocity[:, None] * path.seconds[samples]
        ).T  # across, along
        here = place[-1]
        track = place[:-1] - place[-1]
        fwhm = field.sigma * FWHM_PER_SIGMA
        d = field.spacing
        half = max(
            LEAST_BEAMS / 2 * fwhm,
            layer.distance * angle,
            float(np.abs(track).max()) * 1.05,
        )
        cells = min(MOST_CELLS // 2, math.ceil(half / d))
        i, j = (round(float(v) / d) for v in here)
        values = field.region(i - cells, i + cells + 1, j - cells, j + cells + 1).astype(np.float64)
        offset = here - np.array([i, j]) * d  # of the moment from the middle of the picture
        east, north = (float(v) for v in layer.wind)
        found.append(
            LayerScreen(
                layer.height,
                layer.distance,
                (east, north),
                model.pwv * model.fluctuation.scale * layer.amplitude * values.T,
                d,
                track + offset,
                fwhm,
                layer.distance * angle,
            )
        )
    return found


COLUMNS = (
    ("height", "m", "above the telescope"),
    ("distance", "m", "along the line of sight"),
    ("wind_east", "m / s", "towards the east"),
    ("wind_north", "m / s", "towards the north"),
    ("beam", "m", "FWHM of the beam in the layer"),
    ("field", "m", "diameter of the field of view in the layer"),
    ("pwv_rms", "m", "of the fluctuation within the picture"),
)
"""Of the table of layers: name, unit and description."""


def write(found: Screens, stem: Path) -> list[Path]:
    """``STEM.fits`` (PWV over the field, then each layer) and ``STEM.ecsv`` (the layers); their
    paths. Raises OutputError.
    """
    images = stem.with_name(f"{stem.name}.fits")
    table = stem.with_name(f"{stem.name}.ecsv")
    step = math.degrees(found.side) / (found.pwv.shape[1] - 1)
    with atomic_path(images) as temporary, open(temporary, "wb") as file:
        cards = [
            ("EXTNAME", "PWV", "fluctuation along the line of sight"),
            *_axis_cards(("XI", "ETA"), found.pwv, step),
        ]
        for k, second in enumerate(found.seconds):
            cards.append((f"TIME{k + 1}", float(second), "[s] since the start of the scan"))
        write_image(file, header_of(cards), found.pwv, np.float64)
        for k, layer in enumerate(found.layers):
            cards = [
                ("EXTNAME", f"LAYER{k}"),
                ("HEIGHT", layer.height, "[m]"),
                ("TIME", found.moment, "[s]"),
                *_axis_cards(("ACROSS", "ALONG"), layer.values, layer.spacing),
            ]
            write_image(file, header_of(cards), layer.values, np.float64)
    rows = [
        (r.height, r.distance, *r.wind, r.fwhm, r.field, float(r.values.std()))
        for r in found.layers
    ]
    columns = [
        Column(name, values, unit, text)
        for (name, unit, text), values in zip(COLUMNS, zip(*rows, strict=True), strict=True)
    ]
    meta = {"OBSERVATION": found.observation, "MOMENT": found.moment, "PWV": found.mean_pwv}
    write_ecsv(table, columns, meta)
    return [images, table]


def _axis_cards(names: tuple[str, str], values: Floats, step: float) -> list[tuple[Any, ...]]:
    """Unit of an image, and its axes: (along FITS axis 1, along 2), centred."""
    cards: list[tuple[Any, ...]] = [("BUNIT", "m")]
    for axis, (name, n) in enumerate(zip(names, values.shape[:-3:-1], strict=True), 1):
        cards += [(f"CTYPE{axis}", name), (f"CDELT{axis}", step), (f"CRPIX{axis}", (n + 1) / 2)]
    return cards
