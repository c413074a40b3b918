"""Noise of maximum-likelihood maps from closed forms of the scene, or a table of `zonda noise`.

What detectors share has the spectra S_de(f) = sum_w P_w(f) v_d v_e of waves w across the focal
plane (`ClosedForm.across`), v the cosine and the sine of a wave over the white level of a detector,
and the part of pink noise that all have in common. In equation (2) of `baseline_noise` then

    E_k(f) = q_k^T S q_k,   D(f) = 1 + pink noise of its own + (tr S - sum_k E_k) / (n - k).

q_1 is what all see alike (or each wafer), the mean emission of the atmosphere too; the others are
the leading eigenvectors of S below `SLOW` beside it. The two ends of a scan of T seconds do not
meet: this step of variance 2 int P df adds 4 int P df / T / (2 pi f)^2 to each spectrum P. The
average over the samples of a baseline is neglected: it matters only where white noise is larger.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from zonda.core.data import Observation
from zonda.core.errors import PipelineError
from zonda.core.observation import ClosedForm
from zonda.core.types import Floats

from .baseline_noise import SLOW, BaselineNoise, leading_of, members

WAVES, ANGLES = 60, 12
"""Wave numbers across the focal plane, and directions of half a turn, isotropic in the mean."""
EVEN = 1e-5
"""Phase across the focal plane below which detectors see a wave alike: the gradients of longer
waves have 1e-10 of their power, which is up to 1e9 times that of white noise."""


def of_scene(
    found: BaselineNoise, observation: Observation, rows: NDArray[np.intp], place: str
) -> BaselineNoise:
    """Noise of the detectors ``rows`` from the scene's closed forms; number of modes and bins of
    frequency are those of what was ``found`` in the streams.

    Raises PipelineError where a component of the scene has no closed form.
    """
    net, lacking = observation.focalplane.net[rows], []
    for name in sorted(observation.components & {"atmosphere", "pink"}):
        if name not in observation.closed_forms:
            lacking += [name] * bool(name != "pink" or observation.focalplane.knee.any())
    if not observation.noise_levels or (net <= 0).any():
        lacking = ["white noise of each detector"]
    if lacking:
        raise PipelineError(
            f"the scene has no closed form of {lacking[0]}",
            place=place,
            cure="set noise: estimated, or give a table of zonda noise",
        )
    n, mean, f = len(rows), 2 * np.mean(net**2), found.frequency.copy()
    f[0] = f[1] / 2
    forms = [form for every in observation.closed_forms.values() for form in every]
    waves, across = _waves(observation, rows, forms, f)
    whole = [(form.shared, form(f)) for form in forms if form.across is None]
    pink = sum(((1 - share) * power for share, power in whole), np.zeros(len(f))) / mean
    even = sum((share * power for share, power in whole), np.zeros(len(f))) / mean
    columns = np.concatenate([np.full((n, 1), 1.0), waves], axis=1)
    powers = np.concatenate([even[:, None], across], axis=1)
    number = np.diff(found.edges).astype(np.float64)
    seconds = observation.n_samples / observation.sample_rate
    powers += 4 / seconds**2 * np.einsum("f,fw->w", number, powers) / (2 * np.pi * f[:, None]) ** 2
    slow = np.where(f < SLOW, number, 0.0)
    slow[0] = 0.0
    alike = waves[:, 0]
    groups = members(found.groups)
    first = np.zeros((len(groups), n))
    for row, at in zip(first, groups, strict=True):
        row[at] = alike[at] / np.sqrt((alike[at] ** 2).sum())
    numbers = [int((found.modes[:, at] != 0).any(axis=1).sum()) for at in groups]
    weighed = columns * np.sqrt(np.einsum("f,fw->w", slow, powers))
    q = leading_of(found.groups, weighed, numbers, first)
    spectra = np.einsum("fw,kw->fk", powers, np.einsum("kd,dw->kw", q, columns) ** 2)
    whole_power = np.einsum("fw,w->f", powers, (columns**2).sum(axis=0))
    rest = whole_power - spectra.sum(axis=1)
    return replace(
        found,
        white=net**2 * observation.sample_rate,
        modes=q,
        values=1 + np.einsum("f,fk->k", slow, spectra) / max(slow.sum(), 1),
        own=1 + pink + np.maximum(rest, 0.0) / max(n - len(q), 1),
        shared=spectra,
    )


def of_table(found: BaselineNoise, columns: Mapping[str, Floats]) -> BaselineNoise:
    """Noise that was ``found``, with white levels of a table and the detectors' own spectra of its
    knees and slopes; the spectra of modes remain.
    """
    f = np.maximum(found.frequency, found.frequency[1] / 2)[:, None]
    knee, slope = (columns.get(name, np.zeros(1)) for name in ("knee", "slope"))
    return replace(found, own=1 + ((knee / f) ** slope).mean(axis=1))


def _waves(
    observation: Observation, rows: NDArray[np.intp], forms: list[ClosedForm], f: Floats
) -> tuple[Floats, Floats]:
    """Waves (n_det, n) over white noise, the even one first, and the density of each (n_f, n)."""
    plane = observation.focalplane
    xi, eta = plane.xi[rows] - plane.xi[rows].mean(), plane.eta[rows] - plane.eta[rows].mean()
    reach = max(float(np.hypot(xi, eta).max()), 1e-6)
    edges = np.concatenate([[0.0], np.geomspace(EVEN, 50, WAVES) / reach, [np.inf]])
    number = np.concatenate([[0.0], np.sqrt(edges[1:-2] * edges[2:-1]), edges[-2:-1]])
    angle = np.pi * (np.arange(ANGLES) + 0.5) / ANGLES
    k = np.multiply.outer(number, np.stack([np.cos(angle), np.sin(angle)])).transpose(1, 0, 2)
    phase = np.multiply.outer(xi, k[0].ravel()) + np.multiply.outer(eta, k[1].ravel())
    waves = np.concatenate([np.cos(phase), np.sin(phase)], axis=1)
    each = np.zeros((len(f), len(number)))
    for form in forms:
        each += form.across(f, edges) if form.across else 0.0
    density = np.repeat(each, ANGLES, axis=1) / ANGLES
    gain = (plane.illumination_efficiency / plane.main_beam_efficiency)[rows]
    gain /= np.sqrt(np.mean(gain**2))
    return waves * (gain / plane.net[rows] / np.sqrt(2))[:, None], np.tile(density, (1, 2))
