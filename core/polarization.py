"""Linear polarization as detectors see it: angles on the sky, and rotation of Q and U from one
meridian to another.

Angles are COSMO's (from south to east, the same as from north to west): Q + i U = P exp(2 i psi). A
detector of polarization efficiency p sees

    d = I + p (Q cos 2 psi + U sin 2 psi)                                                        (1)

with psi the angle of its axis from the local meridian. In the boresight's frame let X and Y be the
detector's axes and n the pole of the meridians. At the angular distance b from the pole X n = sin b
cos psi and Y n = -sin b sin psi, so that

    exp(2 i psi) = (X n - i Y n)^2 / |X n - i Y n|^2                                             (2)

needs no trigonometry. Behind a half-wave plate at the angle chi, gamma the detector's angle, both
in the focal plane,

    2 psi becomes 2 psi + 4 (chi - gamma),   (3)

as in TOAST (`StokesWeights`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .kernels import kernel
from .numerics.projection import rotation_matrices
from .numerics.quaternions import detector_quaternions
from .observation import Observation
from .types import AnyFloats, Floats, Indices

AT_ONCE = 512
"""Samples whose angles are in the first cache together."""


class PolarizationAngles(NamedTuple):
    """Equations (2) and (3) for an observation and meridians through one pole.

    Attributes
    ----------
    poles
        (3, n_samp) the pole in the boresight's frame.
    axes
        (n_det, 2, 3) X and Y of each detector in the boresight's frame.
    plate
        (2, n_samp) cos 4 chi and sin 4 chi; (2, 0) without a half-wave plate.
    gamma
        (n_det, 2) cos 4 gamma and -sin 4 gamma.
    """

    poles: Floats
    axes: Floats
    plate: Floats
    gamma: Floats

    @classmethod
    def of(cls, observation: Observation, boresight: Floats, pole: Floats) -> PolarizationAngles:
        """``boresight``: (n_samp, 4), as recorded or where it is in fact (`Observation`); ``pole``:
        ICRS direction (3,).
        """
        plane = observation.focalplane
        quaternions = detector_quaternions(plane.xi, plane.eta, plane.polarization_angle)
        axes = np.ascontiguousarray(np.moveaxis(rotation_matrices(quaternions)[:, :, :2], 2, 1))
        turn = 4 * plane.polarization_angle
        chi = observation.hwp_angle
        plate = np.zeros((2, 0))
        if chi is not None:
            plate = np.stack([np.cos(4 * chi), np.sin(4 * chi)])
        return cls(
            seen_from(boresight, pole),
            axes,
            plate,
            np.stack([np.cos(turn), -np.sin(turn)], axis=1),
        )

    @property
    def nbytes(self) -> int:
        return sum(part.nbytes for part in self)

    def fill(self, detectors: Indices, start: int, cosine: Floats, sine: Floats) -> None:
        """cos 2 psi and sin 2 psi of ``detectors`` (numbers, n) from sample ``start`` on, into
        arrays (n, m).

        At the pole itself, where psi is not defined, 1 and 0. The bits depend on detector and
        sample alone.
        """
        _fill(*self, detectors, start, cosine, sine)

    def add(
        self,
        detectors: Indices,
        start: int,
        efficiency: Floats,
        q_and_u: tuple[AnyFloats, AnyFloats],
        rows: Indices,
        out: AnyFloats,
    ) -> None:
        """Add p (Q cos 2 psi + U sin 2 psi), equation (1), to ``rows`` (n,) of ``out`` (n_row, m).

        ``efficiency`` (n,) p and ``q_and_u``, both (n, m), of ``detectors``; the rest as of `fill`.
        """
        _add(*self, detectors, start, efficiency, *q_and_u, rows, out)


def seen_from(quaternions: Floats, direction: Floats) -> Floats:
    """(3, n) an ICRS direction in the frames of boresights (n, 4), all of which ``quaternions``
    turn to ICRS.
    """
    return np.ascontiguousarray(np.einsum("nij,i->jn", rotation_matrices(quaternions), direction))


@kernel
def fill_row(poles, axis, plate, gamma, start, c, s):  # type: ignore[no-untyped-def]
    """`PolarizationAngles.fill` of one detector, with its ``axis`` (2, 3) and ``gamma`` (2,), into
    ``c``, ``s`` (n,).
    """
    n = c.size
    x, y, z = poles[0, start : start + n], poles[1, start : start + n], poles[2, start : start + n]
    x0, x1, x2, y0, y1, y2 = axis[0, 0], axis[0, 1], axis[0, 2], axis[1, 0], axis[1, 1], axis[1, 2]
    for t in range(n):
        a = x[t] * x0 + y[t] * x1 + z[t] * x2
        b = x[t] * y0 + y[t] * y1 + z[t] * y2
        square = a * a + b * b
        over = 1.0 / (square if square > 0.0 else 1.0)
        c[t] = (a * a - b * b) * over if square > 0.0 else 1.0
        s[t] = -2.0 * a * b * over
    if plate.shape[1] > 0:
        p, q, g, h = plate[0, start : start + n], plate[1, start : start + n], gamma[0], gamma[1]
        for t in range(n):
            u, v = p[t] * g - q[t] * h, p[t] * h + q[t] * g
            c[t], s[t] = c[t] * u - s[t] * v, c[t] * v + s[t] * u


@kernel
def _fill(  # type: ignore[no-untyped-def]
    poles, axes, plate, gamma, detectors, start, cosine, sine
):
    for k in range(detectors.size):
        d = detectors[k]
        fill_row(poles, axes[d], plate, gamma[d], start, cosine[k], sine[k])


@kernel
def _add(  # type: ignore[no-untyped-def]
    poles, axes, plate, gamma, detectors, start, efficiency, q, u, rows, out
):
    n, cast = out.shape[1], out.dtype.type
    cosine, sine = np.empty(AT_ONCE), np.empty(AT_ONCE)
    for k in range(detectors.size):
        d = detectors[k]
        for first in range(0, n, AT_ONCE):
            stop = min(first + AT_ONCE, n)
            c, s = cosine[: stop - first], sine[: stop - first]
            fill_row(poles, axes[d], plate, gamma[d], start + first, c, s)
            row, one, two, p = (
                out[rows[k], first:stop],
                q[k, first:stop],
                u[k, first:stop],
                efficiency[k],
            )
            for t in range(stop - first):
                row[t] += cast(p * (np.float64(one[t]) * c[t] + np.float64(two[t]) * s[t]))


def between_meridians(directions: Floats, of: Floats, to: Floats) -> NDArray[np.complex128]:
    """Factors (...) that turn Q + i U from meridians through the pole ``of`` to those through
    ``to``; 1 at either pole.

    With delta the angle of the new meridian in the old axes, Q' + i U' = (Q + i U) exp(-2 i delta).

    Parameters
    ----------
    directions
        (..., 3) unit vectors, in the frame of both poles (3,).
    """
    north = float(to @ of) - (directions @ to) * (directions @ of)
    west = directions @ np.cross(of, to)
    turn = north - 1j * west
    square = turn.real**2 + turn.imag**2
    lost = square < 1e-28
    return np.asarray(np.where(lost, 1.0, turn**2 / np.where(lost, 1.0, square)), np.complex128)


def turned_by(q_and_u: Floats, turn: NDArray[np.complex128]) -> Floats:
    """(2, ...) Q and U times the factors of `between_meridians` (...)."""
    q, u = q_and_u
    return np.stack([q * turn.real - u * turn.imag, q * turn.imag + u * turn.real])
