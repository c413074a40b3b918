"""Turbulence drawn for one observation: the layers laid out along its lines of sight, and the band's response to them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from zonda.core.types import Floats

from .fluctuations import AtNodes, OfDetectors, times, units_fit
from .model import AtmosphereModel
from .path_delay import delay_per_vapour
from .response import Response
from .statements import statements
from .turbulence.sampling import Drifting, DriftingLayers


def draw(model: AtmosphereModel, label: str) -> AtNodes | OfDetectors:
    """The fluctuations of an observation, stated in its log."""
    parameters, observation, chosen, law = model.parameters, model.observation, model.resolution(), model.fluctuation
    law.check(model.pwv, label)
    turbulence = _drifting(model)
    path = turbulence.paths[chosen.step]
    shares = np.array([layer.amplitude for layer in model.layers])
    heights = np.array([layer.height for layer in model.layers])
    vapour_height = float(shares @ heights / shares.sum())
    per_vapour = delay_per_vapour(np.asarray(model.profile.at(heights).temperature), shares)
    top = model.band.pwv_max / model.pwv - 1
    response = Response(
        model.band, model.pwv, law.limits(top), (path.low, path.high), vapour_height, per_vapour, streams(parameters.outputs)
    )

    def pwv(g: Floats, own: slice) -> Floats:
        y, count = law(g), 0
        if y.min() < -1 or y.max() > top:
            clipped = np.clip(y, -1.0, top)
            count, y = int((clipped != y)[:, own].sum()), clipped
        observation.tally.count(label, "values of the PWV clipped to the table", count)
        return y

    for what, text in statements(model, path):
        observation.tally.state(label, what, text)
    if "path_delay" in parameters.outputs:
        observation.tally.state(label, "wet path delay", f"{per_vapour:.3f} times the PWV (non-dispersive)")
    make = AtNodes.make if chosen.nodes.shape else OfDetectors
    return make(chosen.nodes, turbulence, pwv, response, chosen.step, observation.n_samples)


def _drifting(model: AtmosphereModel) -> DriftingLayers:
    """The layers that are simulated, over the whole scan."""
    chosen, omit = model.resolution(), model.parameters.omit
    parts = zip(model.turbulence, model.layers, chosen.steps, strict=True)
    drifting = [Drifting(field, layer.height, layer.amplitude, layer.wind, step) for field, layer, step in parts]
    drifting = [one for number, one in enumerate(drifting) if number not in omit]
    first, count = times(slice(0, model.observation.n_samples), chosen.step)
    kind = np.float64 if chosen.nodes.shape else np.float32
    points, span = (chosen.nodes.xi, chosen.nodes.eta), (first, first + count)
    return DriftingLayers(model.observation, model.plane, points, drifting, chosen.step, span, kind)


def state_drawn(model: AtmosphereModel, label: str, state: AtNodes | OfDetectors) -> None:
    """State mean and rms of what has been drawn."""
    count, total, squares = state.drawn()
    if count:
        mean = total / count
        rms = math.sqrt(max(squares / count - mean**2, 0.0))
        text = f"mean {mean:+.3%}, rms {rms:.3%} of the mean PWV, over the field and the scan"
        model.observation.tally.state(label, "PWV of this realization", text)


def streams(outputs: Sequence[str]) -> tuple[str, ...]:
    """Names, in `Response`, of what a block is given."""
    return "emission", "transmission", *dict.fromkeys(outputs)


def in_time_order(model: AtmosphereModel) -> bool:
    """Whether blocks should come in order of time: detectors are evaluated one by one, and share the turbulence of the moment."""
    o, chosen = model.observation, model.resolution()
    if chosen.nodes.shape:
        return False
    return not units_fit(o.n_detectors, o.n_samples, chosen.step, len(streams(model.parameters.outputs)))
