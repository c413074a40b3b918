"""One scan with one stream, from a run in Python or from a file: what the bridges turn into objects
of other packages.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from zonda.core.data import Data, Observation, kept, one_scan
from zonda.core.errors import InputError
from zonda.core.flags import DETECTOR_MASK
from zonda.core.storage.files import AnyPath
from zonda.core.types import Bools, Floats
from zonda.operators.io.recorded_stream import RecordedStream
from zonda.operators.io.save_tod import reader
from zonda.operators.io.time_ordered_data import TimeOrderedData

Source = Data | Observation | TimeOrderedData | AnyPath
"""The result of `Pipeline.run`, one of its observations, what `load_tod` returned, or the path of
such a file.
"""


@dataclass
class Scan:
    """A scan and one of its streams.

    Attributes
    ----------
    tod
        Pointing, detectors, flags; ``tod.streams`` holds the one stream, K_RJ.
    stream
        Its name.
    spoilt
        (n_det, n_samp) True where a single sample of a detector is not finite, or the file flags
        it.
    """

    tod: TimeOrderedData
    stream: str
    spoilt: Bools


def scan_of(source: Source, stream: str = "signal", scan: str | int | None = None) -> Scan:
    """The scan of a source, with all of a stream in memory.

    Parameters
    ----------
    source
        See `Source`. Of a run and its observations the stream must have been kept:
        ``pipeline.run(scene, keep=["signal"])``.
    stream
        Its name.
    scan
        Name or number of the scan in a `Data` of several.

    Raises
    ------
    InputError
        There is no such scan or stream, or a file cannot be read.
    """
    scene = None
    if isinstance(source, Data):
        scene = source.scene
        source = one_scan(source.observations, scan)
    elif scan is not None:
        raise InputError(
            "scan chooses from the scans of a run",
            place=f"scan={scan!r}",
            cure="leave it out: there is one",
        )
    if isinstance(source, Observation):
        values = kept(source, stream)
        flagged = None
        tod = TimeOrderedData.of(source)
        if (
            scene is not None and tod.weather is None
        ):  # no step made an atmosphere of it; as SaveTOD writes it
            with contextlib.suppress(InputError):
                tod.weather = scene.ground_weather()
    elif isinstance(source, TimeOrderedData):
        if stream not in source.streams:
            raise _absent(stream, source.streams, source.name)
        tod = source
        values = np.asarray(source.streams[stream], np.float64)
        flagged = None
    else:
        tod, values, flagged = _read(source, stream)
    spoilt = ~np.isfinite(values)
    if flagged is not None:
        spoilt |= flagged
    return Scan(replace(tod, streams={stream: values}), stream, spoilt)


def _read(
    path: AnyPath,
    stream: str,
) -> tuple[TimeOrderedData, Floats, Bools | None]:
    """Read a file without its other streams, and the single samples that it flags."""
    opened = reader(path)
    try:
        tod = opened.tod
        if stream not in opened.streams:
            raise _absent(stream, opened.streams, str(path))
        every = np.arange(tod.n_detectors)
        whole = slice(0, tod.n_samples)
        values, _ = RecordedStream(opened, stream, every, np.uint8(0)).read(
            slice(0, tod.n_detectors),
            whole,
        )
        flags = opened.flags(every, whole)
    finally:
        opened.close()
    return (
        tod,
        values,
        None if flags is None else np.asarray((flags & np.uint8(DETECTOR_MASK)) != 0, np.bool_),
    )


def _absent(stream: str, streams: Iterable[str], place: str) -> InputError:
    cure = f"choose from: {', '.join(sorted(streams)) or 'none'}"
    return InputError(f"there is no stream {stream!r}", place=place, cure=cure)
