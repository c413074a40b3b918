"""Write the time-ordered data of every scan, block by block, as TOAST's HDF5 or FITS binary
tables.
"""

from __future__ import annotations

import threading
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from zonda.core.data import Block, Data, Observation
from zonda.core.errors import InputError, OutputError
from zonda.core.flags import DETECTOR_MASK
from zonda.core.output import StreamOutput, output_folder
from zonda.core.product import Record
from zonda.core.storage.files import AnyPath, atomic_path, check_memory, product_path
from zonda.core.stream import UNITS, StreamName, streams_asked, streams_needed
from zonda.core.weather import GroundWeather

from . import axismanager, fits_table, toast_hdf5
from .recorded_stream import kelvin_per
from .time_ordered_data import TimeOrderedData, TodWriter

_FORMATS: dict[str, Any] = {"hdf5": toast_hdf5, "fits": fits_table}


@dataclass
class Files(Record):
    """Files that were written, in the order of their scans."""

    paths: list[str]

    def __iadd__(self, other: Files) -> Files:
        """Append the files of later scans."""
        self.paths += other.paths
        return self


@dataclass
class _State:
    """An open file, which gets its name when ``whole`` is closed. ``largest``: greatest magnitude
    written, K, for the statement about rounding.
    """

    path: Path
    writer: TodWriter
    whole: ExitStack
    largest: float = 0.0
    lock: threading.Lock = field(default_factory=threading.Lock)


class SaveTOD(StreamOutput):
    """Files of the streams at this step, one per scan: ``tod_<observation>.h5`` or ``.fits``.

    The smooth mean emission is added in float64, so `signal` is the whole T_scan (or what the
    filters left of it). HDF5 files have TOAST 3's layout (version 2), which TOAST and sotodlib
    read; the noise model in them is the instrument's nominal one. A file gets its name when its
    scan is complete: a failed or interrupted run leaves no half file.

    Raises `OutputError` when there is no output folder, it cannot be written, or the disk is full.
    """

    knows_means = True

    format: Literal["hdf5", "fits"] = "hdf5"
    """File format: hdf5 (TOAST's layout) or fits (binary tables)."""
    streams: list[StreamName] = Field(["signal"], min_length=1)
    """Streams to write; components (sky, atmosphere ...) are as they entered the calibrated sum,
    atmosphere without its mean.
    """
    dtype: Literal["float64", "float32"] = "float64"
    """Number type in the file. TOAST wants float64; float32 rounds a mean of 30 K to 2 uK."""

    @property
    def requires(self) -> frozenset[str]:
        """`signal`, and streams of other steps."""
        return streams_needed(self.streams)

    @property
    def optional(self) -> frozenset[str]:
        """Components among the streams."""
        return streams_asked(self.streams)

    def observe(self, data: Data) -> None:
        """Refuse a missing or unwritable output folder before anything is simulated."""
        output_folder(data, self.label)

    def prepare(self, observation: Observation) -> _State:
        module = _FORMATS[self.format]
        stem = (
            f"tod_{observation.name}"
            if self.label == "SaveTOD"
            else f"tod_{self.label}_{observation.name}"
        )
        path = product_path(output_folder(observation, self.label), stem, module.SUFFIX)
        tod = TimeOrderedData.of(observation)
        streams = list(dict.fromkeys(self.streams))
        with ExitStack() as whole:
            temporary = whole.enter_context(atomic_path(path))
            return _State(path, module.Writer(temporary, tod, streams, self.dtype), whole.pop_all())

    def exec(self, block: Block, state: _State) -> None:
        for name in dict.fromkeys(self.streams):
            if name not in block.detdata:
                have = ", ".join(sorted(block.detdata))
                raise OutputError(
                    f"there is no stream {name!r} at this step",
                    place=self.label,
                    cure=f"choose from: {have}",
                )
            values = block.total(name)
            largest = float(np.abs(values).max(initial=0.0)) if name not in UNITS else 0.0
            with state.lock:
                state.largest = max(state.largest, largest)
                state.writer.write(name, block.detectors, block.samples, values)

    def collect(self, data: Data, observation: Observation, state: _State) -> None:
        tod = state.writer.tod
        tod.weather = observation.weather or _weather(data, observation, self.label)
        if self.dtype == "float32":
            observation.log.state(
                self.label,
                "largest rounding to float32 [K]",
                f"{state.largest * 2.0**-24:.1e}",
            )
        if "white" not in observation.components:
            observation.log.state(
                self.label,
                "NET of the detectors",
                "the instrument's; this run has no white noise",
            )
        tod.take_flags(observation)
        log = "\n".join(f"{who}: {what}: {value}" for who, what, value in observation.log)
        tod.metadata.update(_provenance(data), tally=log)
        state.writer.finish()
        state.whole.close()
        data.add(self.label, Files([str(state.path)]))

    def finalize(self, data: Data) -> None:
        files: Files | None = data.take(self.label)
        if files is not None:
            data.products.setdefault("tod_file", []).extend(map(Path, files.paths))

    def discard(self, observation: Observation, state: _State) -> None:
        state.writer.close()
        with suppress(OutputError), state.whole:
            raise OutputError("the scan is not complete", place=str(state.path))


def _weather(data: Data, observation: Observation, place: str) -> GroundWeather | None:
    """Weather of the scene, for a run without an atmosphere."""
    try:
        return data.scene.ground_weather()
    except InputError as err:
        observation.log.state(place, "weather is not written", str(err).splitlines()[0])
        return None


def _provenance(data: Data) -> dict[str, str | int | float]:
    versions = data.provenance.get("versions", {})
    found: dict[str, str | int | float] = {"pipeline": str(data.provenance.get("name", ""))}
    if "zonda" in versions:
        found["version"] = str(versions["zonda"])
    if text := data.provenance.get("resolved_yaml"):
        found["resolved_yaml"] = str(text)
    if plan := data.provenance.get("plan"):
        found["plan"] = "\n".join(" | ".join(map(str, row)) for row in plan)
    return found


def load_tod(path: AnyPath) -> TimeOrderedData:
    """Read a file that `SaveTOD` wrote, or another TOAST layout-2 HDF5 file. Temperatures are
    converted to K; single samples that it flags (`DETECTOR_MASK`) become NaN.

    Raises
    ------
    InputError
        When it cannot be read as such.
    """
    opened = reader(path, whole=True)
    tod = opened.tod
    place = opened.place
    every = np.arange(tod.n_detectors)
    samples = slice(0, tod.n_samples)
    try:
        spoilt: Any = opened.flags(every, samples)
        if spoilt is not None:
            spoilt = (spoilt & ~tod.detector_flags[:, None] & np.uint8(DETECTOR_MASK)) != 0
        for name, unit in opened.streams.items():
            check_memory(8 * len(every) * tod.n_samples, f"the stream {name}", place)
            values = opened.read(name, every, samples)
            if (factor := kelvin_per(unit) or 1.0) != 1.0:
                values = values * factor
            if spoilt is not None and spoilt.any():
                values = np.where(spoilt, np.nan, values)
            tod.streams[name] = values
    finally:
        opened.close()
    tod.check(place)
    return tod


def save_tod(path: AnyPath, tod: TimeOrderedData) -> Path:
    """Write a whole scan, ``tod.streams`` included; the format follows the suffix (.h5, .hdf5,
    .fits). Returns the path.

    Raises
    ------
    OutputError
        When it cannot be written.
    """
    module: Any = fits_table if is_fits(path) else toast_hdf5
    types = {s.dtype.name for s in tod.streams.values()}
    with atomic_path(path) as temporary:
        writer = module.Writer(
            temporary,
            tod,
            list(tod.streams),
            "float64" if types != {"float32"} else "float32",
        )
        try:
            for name, values in tod.streams.items():
                writer.write(name, slice(0, tod.n_detectors), slice(0, tod.n_samples), values)
            writer.finish()
        finally:
            writer.close()
    return Path(path)


def reader(
    path: AnyPath,
    *,
    whole: bool = False,
) -> fits_table.Reader | toast_hdf5.Reader:
    """An open file, whose streams are read in rectangles; ``whole``: it may be compressed. Raises
    InputError when it cannot be read as such.
    """
    if is_fits(path):
        return fits_table.Reader(path, whole=whole)
    if axismanager.holds_axismanager(path):
        return axismanager.Reader(path)
    return toast_hdf5.Reader(path)


def is_fits(path: AnyPath) -> bool:
    """True if the path names a FITS file."""
    name = Path(path).name.lower()
    return name.endswith((".fits", ".fit", ".fits.gz", ".fit.gz"))
