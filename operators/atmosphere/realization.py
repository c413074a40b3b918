"""Turbulence drawn for one observation, the band's response to it, and what the report says of
both.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from zonda.core.instrument import SPEED_OF_LIGHT
from zonda.core.types import Floats

from .fluctuations import BYTES_KEPT, AtNodes, OfDetectors, keeps_all, times, units_bytes
from .model import AtmosphereModel, ExpectedLoad
from .response import NAMES, Response, delay_per_vapour
from .turbulence.beams import rayleigh_distance, widened
from .turbulence.geometry import looking
from .turbulence.lines_of_sight import LinesOfSight
from .turbulence.sampling import Drifting, DriftingLayers, share_tiles

PLANES = {
    "transverse": "transverse to the mean line of sight",
    "cone": "the unrolled cone of the mean elevation (wide throw or field)",
    "horizontal": "horizontal (the throw is too wide to unroll)",
}


def draw(model: AtmosphereModel, label: str) -> AtNodes | OfDetectors:
    """The fluctuations of an observation, stated in its log."""
    parameters = model.parameters
    observation = model.observation
    chosen = model.resolution()
    law = model.fluctuation
    law.check(model.pwv, label)
    turbulence = _layers_of(model, label)
    path = turbulence.paths[chosen.step]
    shares = np.array([layer.amplitude for layer in model.layers])
    vapour_height = height_of_vapour(model)
    per_vapour = delay_per_vapour(np.asarray(model.profile.at(model.heights).temperature), shares)
    top = model.band.pwv_max / model.pwv - 1
    sines = (path.low, path.high)
    terms = model.terms((path.low, path.high))
    names = streams(parameters.outputs)
    response = Response(
        model.band,
        model.pwv,
        law.limits(top),
        sines,
        vapour_height,
        per_vapour,
        names,
        terms,
    )
    if terms is not None:
        turbulence.weights = terms.weights

    def pwv(g: Floats, weighted: Floats, sine: Floats, own: slice) -> tuple[Floats, Floats]:
        strength = model.strength(sine)
        if strength is not None:
            g = g * strength
            weighted = weighted * strength
        y = law(g)
        count = 0
        if y.min() < -1 or y.max() > top:
            clipped = np.clip(y, -1.0, top)
            count = int((clipped != y)[:, own].sum())
            y = clipped
        observation.log.count(label, "values of the PWV clipped to the table", count)
        return y, weighted

    for what, text in _statements(model, path):
        observation.log.state(label, what, text)
    if "path_delay" in parameters.outputs:
        observation.log.state(
            label,
            "wet path delay",
            f"{per_vapour:.3f} times the PWV (non-dispersive)",
        )
    arguments = chosen.nodes, turbulence, pwv, response, chosen.step, observation.n_samples
    if chosen.nodes.shape:
        return AtNodes.make(*arguments)
    made = OfDetectors(*arguments)
    if observation.common is not None:
        made.join(observation.once((label, "units", *looking(observation)), list))
    return made


def height_of_vapour(model: AtmosphereModel) -> float:
    """Mean height of the layers by their shares [m]."""
    shares = np.array([layer.amplitude for layer in model.layers])
    return float(shares @ np.array([layer.height for layer in model.layers]) / shares.sum())


def _layers_of(model: AtmosphereModel, label: str) -> DriftingLayers:
    """The layers; bands of one camera make the tiles of lattices that they look through together
    once for all.

    A band takes what was made for it, so that tiles are released with the last that needs them.
    """
    observation = model.observation
    if observation.common is None:
        return drifting_layers(model)
    loads: dict[str, ExpectedLoad] = observation.once((label, "loads"), dict)

    def make() -> dict[str, DriftingLayers]:
        return _of_bands([load.model() for load in loads.values()], label)

    return observation.once((label, "layers"), make).pop(observation.name)


def _of_bands(models: Sequence[AtmosphereModel], label: str) -> dict[str, DriftingLayers]:
    """Layers by name of the band's scan."""
    layers = [drifting_layers(model) for model in models]
    for model, others in zip(models, share_tiles(layers), strict=True):
        whole = len(model.simulated)
        text = "lattices of its own: other beams or directions"
        named = ((models[k].observation.instrument.band.name, n) for k, n in sorted(others.items()))
        if parts := ", ".join(f"{name} ({n} of {whole} layers)" for name, n in named):
            text = f"lattices made once with those of {parts}"
        model.observation.log.state(label, "turbulence beside other bands", text)
    return {model.observation.name: one for model, one in zip(models, layers, strict=True)}


def drifting_layers(
    model: AtmosphereModel,
    points: tuple[Floats, Floats] | None = None,
) -> DriftingLayers:
    """The layers that are simulated, over the whole scan, to be looked at from focal-plane
    ``points``, by default the nodes.
    """
    chosen = model.resolution()
    parts = list(zip(model.turbulence, model.layers, chosen.steps, strict=True))
    drifting = [
        Drifting(field, layer.height, layer.amplitude, layer.wind, step)
        for field, layer, step in (parts[k] for k in model.simulated)
    ]
    first, count = times(slice(0, model.observation.n_samples), chosen.step)
    kind = np.float64 if chosen.nodes.shape else np.float32
    points = points or (chosen.nodes.xi, chosen.nodes.eta)
    span = (first, first + count)
    return DriftingLayers(model.observation, model.plane, points, drifting, chosen.step, span, kind)


def state_drawn(model: AtmosphereModel, label: str, state: AtNodes | OfDetectors) -> None:
    """State mean and rms of what has been drawn."""
    count, total, squares = state.drawn()
    if count:
        mean = total / count
        rms = math.sqrt(max(squares / count - mean**2, 0.0))
        text = f"mean {mean:+.3%}, rms {rms:.3%} of the mean PWV, over the field and the scan"
        model.observation.log.state(label, "PWV of this realization", text)


def streams(outputs: Sequence[str]) -> tuple[str, ...]:
    """Names, in `Response`, of what a block is given."""
    return "emission", "transmission", *dict.fromkeys(outputs)


def in_time_order(model: AtmosphereModel) -> bool:
    """True if blocks should come in order of time: detectors are evaluated one by one, and share
    the turbulence of the moment.
    """
    return model.resolution().nodes.shape is None and not keeps_all(*_units(model))


def bytes_of_units(model: AtmosphereModel) -> int:
    """Bytes of the detectors' series that are kept; 0 where they are interpolated from nodes."""
    if model.resolution().nodes.shape:
        return 0
    every = units_bytes(*_units(model))
    return min(every, BYTES_KEPT) if in_time_order(model) else every


def _units(model: AtmosphereModel) -> tuple[int, int, int, int]:
    """Detectors, samples, step and streams of the units."""
    o = model.observation
    names = streams(model.parameters.outputs)
    return o.n_detectors, o.n_samples, model.resolution().step, len(names)


def _statements(model: AtmosphereModel, path: LinesOfSight) -> Iterator[tuple[str, str]]:
    """(what, text) of a model that is evaluated along a path."""
    for what, text in model.profile.stated:
        if what != "wind" or model.parameters.wind == "profile":
            yield what, text
    yield from _of_the_pwv(model)
    yield from _of_the_beam(model, path)
    yield from _of_the_resolution(model)


def _of_the_pwv(model: AtmosphereModel) -> Iterator[tuple[str, str]]:
    law = model.fluctuation
    before, after = law.before_and_after()
    yield (
        "mean PWV",
        f"{model.pwv * 1e3:.3f} mm" + ("" if model.parameters.pwv else " (of the weather)"),
    )
    yield "PWV rms", f"{before:.3%} of the mean before the beam, {after:.3%} after it"
    yield "distribution of the PWV", "log-normal" if law.log_normal else "normal"
    each = (
        f"{layer.height:.0f} m: {law.scale * layer.amplitude * math.sqrt(field.variance):.3%}"
        for layer, field in zip(model.layers, model.turbulence, strict=True)
    )
    yield "PWV rms after the beam, per layer", ", ".join(each)
    if model.parameters.pwv_rms_at == "zenith":
        text = (
            f"{law.rms / model.parameters.pwv_rms:.3f} of that at the zenith, at"
            f" {math.degrees(model.elevation):.1f} deg"
        )
        yield (
            "PWV rms by elevation",
            text
            + (
                ", one value for the scan"
                if model.strength(np.ones(1)) is None
                else ", and by sample"
            ),
        )
    if model.parameters.layer_response == "layer":
        for name in NAMES:
            each = (
                f"{h:.0f} m: {k:.3f}" for h, k in zip(model.heights, model.kappa[name], strict=True)
            )
            yield f"{name} of a layer's water, over the column's", ", ".join(each)
    else:
        yield "emission and opacity of a layer's water", "as of the column, whatever its height"


def _of_the_beam(model: AtmosphereModel, path: LinesOfSight) -> Iterator[tuple[str, str]]:
    layers = model.layers
    fields = model.turbulence
    footprint = model.parameters.beam
    sizes = (f"{field.sigma:.3g} m / {field.spacing:g} m" for field in fields)
    yield "beam sigma / lattice spacing, per layer", ", ".join(dict.fromkeys(sizes))
    instrument = model.observation.instrument
    diameter = instrument.telescope.diameter
    wavelength = SPEED_OF_LIGHT / instrument.band.centre
    sines = math.sin(model.plane.elevation) / np.array([path.high, path.low])
    ends = [widened(diameter, wavelength, layers[-1].distance * k) for k in (*sines, 1.0)]
    text = (
        f"{ends[0] / ends[2]:.3f} to {ends[1] / ends[2]:.3f} of the one used, in the highest layer"
    )
    yield "width of the beam over the elevations of field and scan", text
    if footprint != "gaussian":
        far = rayleigh_distance(diameter, wavelength)
        beyond = sum(layer.distance > far for layer in layers)
        yield (
            "footprint",
            (
                f"{footprint}; {beyond} of {len(layers)} layers lie beyond {far:.0f} m, where beams"
                " lose their rim"
            ),
        )
    yield (
        "turbulence covariance",
        f"within {fields[0].fidelity.error:.1%} of the variance ({model.parameters.fidelity})",
    )


def _of_the_resolution(model: AtmosphereModel) -> Iterator[tuple[str, str]]:
    chosen = model.resolution()
    plane = model.plane
    error = (
        f"; expected rms error {chosen.focal_plane_error:.1e} of the fluctuation"
        if chosen.nodes.shape
        else ""
    )
    yield "nodes", f"{chosen.nodes}{error}"
    several = len(set(chosen.steps)) > 1
    steps = (
        f"{min(chosen.steps)} to {max(chosen.steps)} samples, by layer"
        if several
        else f"{min(chosen.steps)} samples"
    )
    yield "step in time", f"{steps}; expected rms error {chosen.time_error:.1e} of the fluctuation"
    yield "nodes and step of the mean emission", f"{chosen.mean_nodes}; {chosen.mean_step} samples"
    both = "each, for nodes and for the step" if chosen.nodes.shape else "x sqrt(2) for the step"
    yield "error allowed", f"{chosen.tolerance:.1e} of the fluctuation {both}"
    text = (
        f"{chosen.differential:.1e} of the fluctuation is left after subtraction of the focal-plane"
        " mean"
    )
    yield "differential signal", text
    yield (
        "plane of the turbulence",
        f"{PLANES[plane.kind]}; squared separations within {plane.bound:.1%}",
    )
    if plane.kind == "cone":
        yield (
            "wind on the unrolled cone",
            f"drifts within {plane.drift_bound:.1%} at the ends of the scan",
        )
