"""The ratio of two smooth fields, as a smooth field: the mean emission over the transmission."""

from __future__ import annotations

import math

import numpy as np

from zonda.core.numerics.chunks import chunks, empty
from zonda.core.numerics.radiation import LEAST_TRANSMISSION
from zonda.core.numerics.smooth import SmoothField, interpolating, spline_basis
from zonda.core.types import AnyFloats, Floats, Indices, Integers

AT_ONCE = 4096
"""Detectors whose series of the smooth fields are worked on at a time."""

TOLERANCE = 1e-7
"""Largest error allowed in a ratio, relative to its largest value."""


def field_ratio(
    above: SmoothField,
    below: SmoothField,
    use: Indices,
) -> tuple[SmoothField, float]:
    """The smooth field above / max(below, `LEAST_TRANSMISSION`), and its largest error over the
    detectors ``use``.

    The ratio is taken at the coarse times (with its derivative at the two ends) and refitted by an
    interpolating spline in time and by least squares over the nodes of ``above``; where the nodes
    do not carry it, over its own leading singular vectors. The fit is made from some hundreds of
    detectors, its error taken over all. The step is halved until the error at the cells' midpoints
    is below `TOLERANCE`.
    """
    step, rows = min(above.step, below.step), _representatives(above.weights, use)

    def fitted(basis: Floats, fit: Floats) -> tuple[SmoothField, float]:
        field = SmoothField(basis, _spline(np.asarray(fit, np.float64)), step, above.n_samples)
        return field, _error(field, above, below, step, use)

    while True:
        known = _ratio(above, below, step, rows)
        tolerance = TOLERANCE * max(
            float(np.abs(known[np.isin(rows, use), 1:-1]).max(initial=0.0)),
            1e-30,
        )
        nodes = above.weights.astype(np.float64)
        fits = [
            np.linalg.lstsq(nodes[rows], known[:, part], rcond=1e-12)[0]
            for part in chunks(known.shape[1])
        ]
        field, error = fitted(nodes, np.concatenate(fits, axis=1))
        if not error <= tolerance:
            _, size, fit = np.linalg.svd(known, full_matrices=False)
            fit = fit[: max(1, int(np.count_nonzero(size > 1e-13 * size[0])))]
            every = np.arange(len(nodes))
            basis = [
                _ratio(above, below, step, every[part]) @ fit.T
                for part in chunks(len(nodes), AT_ONCE)
            ]
            field, error = fitted(np.concatenate(basis), fit)
        if error <= tolerance or step == 1:
            return field, error
        step //= 2


def _representatives(weights: AnyFloats, use: Indices) -> Indices:
    """Some hundreds of more than 512 detectors: evenly chosen, those at which a node weighs most
    and least, and some in ``use``.
    """
    n = len(weights)
    if n <= 512:
        return np.arange(n)
    evenly = np.linspace(0, n - 1, 256)
    used = use[np.linspace(0, len(use) - 1, min(len(use), 64)).astype(np.intp)]
    return np.unique(
        np.r_[evenly.astype(np.intp), weights.argmin(axis=0), weights.argmax(axis=0), used]
    )


def _ratio(above: SmoothField, below: SmoothField, step: int, rows: Indices) -> Floats:
    """The ratio for the detectors ``rows`` at the coarse times; in the first and last column,
    its slopes at the ends.
    """
    one = above.weights[rows]
    other = below.weights[rows]
    high = knots_of(above, step)
    low = knots_of(below, step)
    found = empty((len(rows), low.shape[1] + 2))
    ratio = found[:, 1:-1]
    ends = [0, -1]
    for part in chunks(low.shape[1]):
        np.divide(
            one @ high[:, part],
            np.maximum(other @ low[:, part], LEAST_TRANSMISSION),
            out=ratio[:, part],
        )
    bottom = other @ low[:, ends]
    slope = one @ _end_slopes(above, step) - ratio[:, ends] * (other @ _end_slopes(below, step)) * (
        bottom > LEAST_TRANSMISSION
    )
    found[:, ends] = slope / np.maximum(bottom, LEAST_TRANSMISSION)
    return found


def _error(
    field: SmoothField,
    above: SmoothField,
    below: SmoothField,
    step: int,
    use: Indices,
) -> float:
    """Largest difference between ``field`` and above / below at the cells' midpoints, over the
    detectors ``use``.
    """
    middle, top, bottom = (knots_of(f, step, 0.5) for f in (field, above, below))
    worst = 0.0
    for detectors in chunks(len(use), AT_ONCE):
        one, other, fitted = (f.weights[use[detectors]] for f in (above, below, field))
        for part in chunks(middle.shape[1]):
            exact = (one @ top[:, part]) / np.maximum(other @ bottom[:, part], LEAST_TRANSMISSION)
            worst = max(worst, float(np.abs(fitted @ middle[:, part] - exact).max(initial=0.0)))
    return worst


def knots_of(field: SmoothField, step: int, offset: float = 0.0) -> Floats:
    """Node values at samples (j + offset) * step: (n_node, n_cell + 1 or n_cell).

    ``step`` divides the field's own; all cells' edges (offset 0), or one point inside each (0 <
    offset < 1).
    """
    cells = -(-field.n_samples // step)
    m, u = _cells(field, (np.arange(cells + (offset == 0), dtype=np.float64) + offset) * step)
    return _sum(field, m, spline_basis(u))


def _end_slopes(field: SmoothField, step: int) -> Floats:
    """Derivatives of the node values per ``step`` at the first and at the last of `knots_of`:
    (n_node, 2).
    """
    m, u = _cells(field, np.array([0.0, -(-field.n_samples // step) * step]))
    v = 1.0 - u
    slope = np.array([-v * v / 2, u * (3 * u - 4) / 2, -v * (3 * v - 4) / 2, u * u / 2])
    return _sum(field, m, slope) * (step / field.step)


def _cells(field: SmoothField, sample: Floats) -> tuple[Integers, Floats]:
    """The cells that samples lie in, and how far into the cell they are (0 to 1)."""
    position = sample / field.step
    m = np.minimum(position.astype(np.int64), field.coefficients.shape[1] - 4)
    return m, position - m


def _sum(field: SmoothField, m: Integers, weights: Floats) -> Floats:
    c = field.coefficients.astype(np.float64, copy=False)
    return np.asarray(sum(w * c[:, m + j] for j, w in enumerate(weights)))


def _spline(known: Floats) -> Floats:
    """B-spline coefficients (n_node, k) from (first slope, k - 2 values, last slope) per node: the
    complete cubic spline.

    The spline of the mirrored values has no slope at its ends. What gives it one is zero at all
    knots: c_j = A z^j + B z^(m - j), z = sqrt(3) - 2, solves c_(j-1) + 4 c_j + c_(j+1) = 0 for
    knots 0 .. m, with (c_1 - c_-1) / 2 = sqrt(3) (A - z^m B).
    """
    first = known[:, :1]
    last = known[:, -1:]
    m = known.shape[1] - 3
    z = math.sqrt(3) - 2
    far = z**m
    a, b = (
        (one - far * other) / (math.sqrt(3) * (1 - far * far))
        for one, other in ((first, last), (-last, -first))
    )
    falling = z ** np.arange(-1.0, m + 2)
    mirrored = np.pad(interpolating(known[:, 1:-1]), ((0, 0), (1, 1)), mode="reflect")
    return np.asarray(mirrored + a * falling + b * falling[::-1])
