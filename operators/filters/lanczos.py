"""Leading eigenpairs of G = A A^T by the Lanczos iteration (full reorthogonalization, float64).

One step reads the stream once and gives A^T q and A A^T q together. It starts near the detector
mean and stops when

    |G u_i - sigma_i^2 u_i| <= residual * sigma_i^2   for every mode that is wanted.             (1)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from zonda.core.numerics.chunks import chunks, empty
from zonda.core.types import Floats

from .gram import Gram, directions, near_the_mean

EMPTY = 1e-13
"""Share of the stream's energy, per detector, that G cannot tell from rounding."""

NOTHING = 1e-26
"""Share of the stream's energy below which what is left after subtraction is float64 rounding:
there is no further mode.
"""


@dataclass
class Ritz:
    """Approximate leading eigenpairs of G, largest first.

    Attributes
    ----------
    values
        sigma_i^2; may be longer than ``detectors``.
    detectors, times
        u_i (k, n_det) and v_i = A^T u_i (k, n_samp).
    residuals
        Left side of (1) over sigma_i^2.
    rank
        Rank of A as far as it matters here (a lower bound).
    """

    values: Floats
    detectors: Floats
    times: Floats
    residuals: Floats
    rank: int
    steps: int
    what: str = "singular modes"
    count: int = 0
    """How many of them are removed."""

    @property
    def energies(self) -> Floats:
        """|v_i|^2 of the modes."""
        return np.asarray(np.einsum("kt,kt->k", self.times, self.times))

    @classmethod
    def nothing(cls, n_det: int, n_samples: int, why: str = "no good detector") -> Ritz:
        """No mode at all."""
        return cls(
            np.zeros(0), np.zeros((0, n_det)), np.zeros((0, n_samples)), np.zeros(0), 0, 0, why
        )


def lanczos(gram: Gram, wanted: int, residual: float, gap: float | None) -> Ritz:
    """The leading ``wanted`` modes of ``gram`` to a residual, equation (1).

    ``gap``: the largest ratio of a singular value to the one before at which the modes are of use;
    where every ratio is larger the iteration ends at residuals of a tenth. None: they are wanted in
    any case.
    """
    n = gram.n_good
    if n == 0:
        return Ritz.nothing(gram.use.size, gram.n_samples)
    if gram.energy == 0:
        return Ritz.nothing(gram.use.size, gram.n_samples, "the signal is zero")
    basis: list[Floats] = [near_the_mean(gram.use)]
    times: list[Floats] = []
    projected = np.zeros((n, n)) if n <= 4096 else np.zeros((512, 512))
    while True:
        m = len(basis)
        image, time = gram.apply(basis[-1])
        times.append(time)
        space = np.array(basis)
        column = space @ image
        projected[:m, m - 1] = projected[m - 1, :m] = column
        rest = image - column @ space
        again = space @ rest
        rest -= again @ space
        rest[~gram.use] = 0.0
        beta = float(np.linalg.norm(rest))
        values, vectors = np.linalg.eigh(projected[:m, :m])
        values, vectors = values[::-1], vectors[:, ::-1]
        floor = EMPTY * n * gram.energy
        residuals = beta * np.abs(vectors[-1]) / np.maximum(values, floor)
        exhausted = m == min(n, len(projected)) or gram.energy - float(values.sum()) <= floor
        converged = m > wanted and bool((residuals[:wanted] <= residual).all())
        if exhausted or converged or _gaps_are_closed(values, residuals, wanted, gap):
            k = min(wanted, m)
            rank = int(np.count_nonzero(values > floor))
            if not exhausted:
                rank += 1
            elif rank < n:  # G squares what is small: look at the remainder itself
                seen = vectors[:, :rank].T
                rank += gram.left(seen @ space, _combined(seen, times)) > NOTHING * gram.energy
            leading = vectors[:, :k].T
            return Ritz(
                values, np.array(leading @ space), _combined(leading, times), residuals[:k], rank, m
            )
        if beta <= 1e-14 * gram.energy:  # an invariant subspace: go on in a new direction
            rest = gram.use * directions(m, gram.use.size)
            for _ in range(2):
                rest = rest - (space @ rest) @ space
            beta = float(np.linalg.norm(rest))
        basis.append(rest / beta)


def _gaps_are_closed(values: Floats, residuals: Floats, wanted: int, gap: float | None) -> bool:
    """True if no wanted mode is determined, as far as residuals of a tenth show."""
    if gap is None or len(values) < wanted + 3 or not (residuals[: wanted + 1] <= 0.1).all():
        return False
    size = np.sqrt(np.maximum(values, 0.0))
    return all(size[i + 1] > gap * size[i] for i in range(wanted))


def _combined(shares: Floats, times: list[Floats]) -> Floats:
    """Sums (k, n_samp) of series with their ``shares`` (k, m)."""
    found = empty((len(shares), times[0].size))
    for part in chunks(times[0].size):
        found[:, part] = shares @ np.array([series[part] for series in times])
    return found
