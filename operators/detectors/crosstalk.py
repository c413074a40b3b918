"""Crosstalk between detectors.

    y_d = x_d + sum_e C_de x_e,   C_dd = 0,   (1)

at every instant, C_de the share of the signal of detector e that is read in detector d. The sum is
formed in the order of the detectors.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pydantic import model_validator

from zonda.core.configuration.input_paths import InputPath
from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Fraction
from zonda.core.data import Block, Data, Observation
from zonda.core.errors import InputError
from zonda.core.focalplane import Focalplane
from zonda.core.kernels import kernel
from zonda.core.operator import Operator
from zonda.core.storage.table_files import read_table

NEXT = 1.2
"""Detectors up to this many of the smallest distance away are neighbours: six in a hexagon, four in
a square.
"""

COLUMNS = ("detector", "source", "share")
"""Of a matrix in a file."""


class Crosstalk(Operator):
    """Add to the signal of each detector shares of the signals of others: y_d = x_d + sum_e C_de
    x_e.

    C is `level` for the nearest neighbours in the focal plane that are of the same band, or the
    table in `file`. A sample that is not finite adds nothing to others.
    """

    requires = frozenset({"signal"})
    provides = frozenset({"signal"})
    linear = True
    couples = "detectors"

    level: Fraction = quantity("0.3 %", ge=-0.5, le=0.5)
    """Share of each nearest neighbour's signal."""
    file: InputPath | None = None
    """Table (ECSV or CSV) of shares, with columns `detector` and `source` (names) and `share`;
    instead of `level`.
    """

    @model_validator(mode="after")
    def _one_of_two(self) -> Crosstalk:
        if self.file is not None and "level" in self.model_fields_set:
            raise ValueError("give either level, for nearest neighbours, or file")
        return self

    def check(self, data: Data) -> list[str]:
        """Raise InputError where the table is wrong, or of other detectors."""
        if self.file is not None and data.observations:
            read_shares(self.file, data.observations[0].focalplane)
        return []

    def prepare(self, observation: Observation) -> Any:
        """C of equation (1), a `scipy.sparse.csr_array`. Raises InputError for a file that does not
        suit the focal plane.
        """
        found = self.shares(observation)
        observation.log.state(self.label, "pairs of detectors with crosstalk", f"{found.nnz}")
        return found

    def shares(self, observation: Observation) -> Any:
        """See `prepare`."""
        plane = observation.focalplane
        return neighbours(plane, self.level) if self.file is None else read_shares(self.file, plane)

    def exec(self, block: Block, state: Any) -> None:
        """Equation (1); the block has all detectors."""
        signal = block.detdata["signal"]
        given = block.buffer("(before)", block.shape)
        given[...] = signal
        _add_shares(given, state.indptr, state.indices, state.data, signal)


def neighbours(plane: Focalplane, level: float) -> Any:
    """``level`` for each pair of nearest neighbours of one band; detectors in one place are
    none.
    """
    from scipy.sparse import csr_array
    from scipy.spatial import cKDTree

    at = np.stack([plane.xi, plane.eta], axis=1).round(12)
    bands = np.asarray(plane.band)
    pairs = [np.zeros((0, 2), np.int64)]
    for band in np.unique(bands):
        of_band = np.flatnonzero(bands == band)
        places = np.unique(at[of_band], axis=0)
        if len(places) > 1:
            nearest, _ = cKDTree(places).query(places, k=[2])
            reach = NEXT * float(np.min(nearest))
            near = of_band[cKDTree(at[of_band]).query_pairs(reach, output_type="ndarray")]
            pairs += [near, near[:, ::-1]]
    found = np.concatenate(pairs)
    found = found[(at[found[:, 0]] != at[found[:, 1]]).any(axis=1)]
    return csr_array((np.full(len(found), level), found.T), (len(plane), len(plane)))


def read_shares(path: Path, plane: Focalplane) -> Any:
    """C from a table of `COLUMNS`."""
    from scipy.sparse import csr_array

    table = read_table(path)
    number = {name: k for k, name in enumerate(plane.names)}
    index = []
    for column in COLUMNS[:2]:
        names = table.texts(column)
        for row, name in enumerate(names):
            if name not in number:
                cure = f"the names are such as {', '.join(plane.names[:3])}"
                table.note(row, f"{column} {name!r} is no detector of the focal plane", cure)
        index.append(np.array([number.get(name, -1) for name in names], np.int64))
    detector, source = index
    table.note_rows(
        (detector == source) & (detector >= 0),
        lambda row: "is a detector's share of itself",
        "remove it; gains are not crosstalk",
    )
    share = table.numbers(COLUMNS[2])
    table.check()
    found = csr_array((share, (detector, source)), (len(plane), len(plane)))
    if found.nnz < len(share):
        raise InputError(
            "a pair of detectors is there twice",
            place=table.place,
            cure="remove one of the rows",
        )
    return found


@kernel
def _add_shares(given, first, source, share, out):  # type: ignore[no-untyped-def]
    """Equation (1); the detectors' samples in turn, so that a sample has the same bits in every
    block.
    """
    for d in range(out.shape[0]):
        for k in range(first[d], first[d + 1]):
            row, factor = given[source[k]], out.dtype.type(share[k])
            for t in range(out.shape[1]):
                if np.isfinite(row[t]):
                    out[d, t] += factor * row[t]
