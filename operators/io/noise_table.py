"""Noise of single detectors as a table: `zonda noise` measures and writes it
(`core.detector_files.read_noise` reads it).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from zonda.core import flags
from zonda.core.errors import InputError
from zonda.core.numerics.chunks import TILE_DETECTORS, chunks
from zonda.core.storage.table_files import Column, write_ecsv
from zonda.core.types import Bools, Floats

from .recorded_scan import rows_of_bands
from .recorded_stream import AT_ONCE, RecordedStream
from .save_tod import reader
from .time_ordered_data import TimeOrderedData

COLUMNS = {
    "net": ("K s(1/2)", "white noise: rms of one second of integration"),
    "net_error": ("K s(1/2)", "standard error"),
    "knee": ("Hz", "where 1/f noise equals white noise; 0: none was found"),
    "knee_error": (
        "Hz",
        "standard error; where none was found, the lowest frequency that was looked at",
    ),
    "slope": ("", "1/f noise falls as f^-slope"),
    "slope_error": ("", "standard error"),
    "chi_square": ("", "of the fit, over its degrees of freedom"),
    "segments": ("", "segments without a flagged sample"),
}
"""Of the table, beside the names and positions of the detectors."""

Estimate = Callable[[Floats, Bools, float], Any]
"""From samples [K], which of them may be used, and their rate [Hz], an object with `COLUMNS`; None:
there is no estimate.
"""


def noise_of(
    path: Path,
    signal: str,
    estimate: Estimate,
    *,
    subtract_mean: bool,
) -> tuple[TimeOrderedData, dict[str, Any]]:
    """Everything but the streams of a file, and the noise of each unflagged detector by name; None:
    no estimate.

    Parameters
    ----------
    subtract_mean
        Subtract at each sample the mean over the detectors of a band, in which the atmosphere is;
        the noise of n detectors then loses 1/n of its variance, which is given back.

    Raises
    ------
    InputError
        Where the file cannot be read, or has no such stream.
    """
    file = reader(path)
    try:
        tod = file.tod
        place = f"zonda noise, {path}"
        if signal not in file.streams:
            have = ", ".join(sorted(file.streams)) or "none"
            raise InputError(
                f"has no stream {signal!r}",
                place=place,
                cure=f"choose --signal from: {have}",
            )
        usable = (tod.detector_flags & np.uint8(flags.DETECTOR_MASK)) == 0
        if not usable.any():
            raise InputError(
                "all detectors are flagged",
                place=place,
                cure="unflag those that can be used",
            )
        good = (tod.flags & np.uint8(flags.SAMPLE_MASK)) == 0
        found = {}
        for band in rows_of_bands(tod, None, place):
            use = band[usable[band]]
            stream = RecordedStream(file, signal, use, np.uint8(flags.DETECTOR_MASK))
            mean = (
                _mean(stream, len(use), tod.n_samples) if subtract_mean and len(use) > 1 else None
            )
            back = 1.0 if mean is None else np.sqrt(len(use) / (len(use) - 1))
            for rows in chunks(len(use), TILE_DETECTORS):
                values, _ = stream.read(rows, slice(0, tod.n_samples))
                for number, row in enumerate(values, rows.start):
                    found[tod.names[use[number]]] = estimate(
                        row if mean is None else (row - mean) * back,
                        good,
                        tod.sample_rate,
                    )
    finally:
        file.close()
    return tod, found


def _mean(stream: RecordedStream, n_detectors: int, n_samples: int) -> Floats:
    """(n_samp,) mean over the detectors, of those that are finite."""
    total = np.zeros(n_samples)
    number = np.zeros(n_samples)
    for rows in chunks(n_detectors, TILE_DETECTORS):
        for samples in chunks(n_samples, AT_ONCE):
            values, _ = stream.read(rows, samples)
            total[samples] += np.nansum(values, axis=0)
            number[samples] += np.isfinite(values).sum(axis=0)
    return np.asarray(np.divide(total, number, out=np.full(n_samples, np.nan), where=number > 0))


def write_noise(
    path: Path,
    tod: TimeOrderedData,
    found: Mapping[str, Any],
    meta: Mapping[str, Any],
) -> Path:
    """Write the table that `LoadTOD` reads (``noise:``): a row for each detector with an
    estimate.
    """
    rows = [k for k, name in enumerate(tod.names) if found.get(name) is not None]
    names = [tod.names[k] for k in rows]
    columns = [Column("name", names, "", "detector")]
    columns += [
        Column("xi", tod.xi[rows], "rad", "tangent of the offset towards increasing azimuth"),
        Column("eta", tod.eta[rows], "rad", "tangent of the offset towards increasing elevation"),
    ]
    for name, (unit, text) in COLUMNS.items():
        columns.append(Column(name, [float(getattr(found[d], name)) for d in names], unit, text))
    return write_ecsv(path, columns, meta)
