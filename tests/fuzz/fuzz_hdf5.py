"""HDF5 and NetCDF files of any bytes, as TOAST's time-ordered data and as ERA5: whole and finite,
or an `InputError`.

Inputs begin with one byte: 1 is time-ordered data, anything else is an ERA5 file.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from engine import ROOT, fuzz, guided_by, scratch, told

with guided_by("zonda.operators.io", "zonda.operators.atmosphere.weather", "scipy.io._netcdf"):
    import numpy as np

    from zonda.core.configuration.time import Instant
    from zonda.core.errors import ZondaError
    from zonda.core.site import Site
    from zonda.operators.atmosphere.weather.era5 import Era5
    from zonda.operators.io.save_tod import load_tod, save_tod
    from zonda.operators.io.time_ordered_data import TimeOrderedData

FILE = scratch(".h5")
SITE = Site(name="here", latitude="40.6 deg", longitude="10.1 deg", altitude="500 m")
TIME = Instant.parse("2024-03-01T01:30")


def whole(tod: TimeOrderedData) -> None:
    """The promises of `TimeOrderedData`, in words of their own."""
    n, d = len(tod.times), len(tod.names)
    assert tod.seconds.shape == tod.times.shape == tod.flags.shape == (n,)
    assert {tod.boresight_azel.shape, tod.boresight_radec.shape} in ({(n, 4)}, {(n, 4), (0, 4)})
    assert tod.quats.shape == (d, 4)
    assert tod.detector_flags.shape == (d,)
    assert all(column.shape == (d,) for column in tod.columns.values())
    assert all(
        stream.shape[:2] == (d, n) and stream.dtype.kind in "fiu" for stream in tod.streams.values()
    )
    for values in (
        tod.times,
        tod.seconds,
        tod.boresight_azel,
        tod.boresight_radec,
        tod.quats,
        [tod.sample_rate, tod.field_of_view],
    ):
        assert np.isfinite(values).all()
    assert np.isfinite(tod.site[1:]).all()
    assert tod.sample_rate > 0


def target(data: bytes) -> None:
    FILE.write_bytes(data[1:])
    try:
        if data[:1] == b"\1":
            whole(load_tod(FILE))
        else:
            column = Era5(file=FILE).column(SITE, TIME)
            assert all(
                np.isfinite(values).all()
                for values in (column.pressure, column.height, column.temperature, column.h2o)
            )
            assert (column.pressure > 0).all()
            assert (column.h2o >= 0).all()
    except ZondaError as err:
        told(err)


def tiny_scan(detectors: int = 2, samples: int = 5) -> TimeOrderedData:
    """A scan of random numbers."""
    rng = np.random.default_rng(0)
    unit = np.tile([0.0, 0.0, 0.0, 1.0], (max(detectors, samples), 1))
    seconds = np.arange(samples) / 10
    columns = {
        "fwhm": np.full(detectors, 1e-4),
        "net": np.full(detectors, 1e-3),
        "band_centre": np.full(detectors, 9e10),
    }
    return TimeOrderedData(
        name="scan",
        start="2024-11-25T07:00:00",
        seconds=seconds,
        times=1.7e9 + seconds,
        sample_rate=10.0,
        telescope="t",
        field_of_view=1e-3,
        site=("here", 0.7, -1.4, 800.0),
        boresight_azel=unit[:samples],
        boresight_radec=unit[:samples],
        flags=np.zeros(samples, np.uint8),
        detector_flags=np.zeros(detectors, np.uint8),
        names=[f"d{k}" for k in range(detectors)],
        quats=unit[:detectors],
        columns=columns,
        streams={"signal": rng.standard_normal((detectors, samples))},
        metadata={"seed": 1},
    )


def seeds() -> Iterator[bytes]:
    import importlib.util

    yield b"\1" + save_tod(FILE, tiny_scan()).read_bytes()
    path = ROOT / "tests" / "operators" / "atmosphere" / "weather" / "era5_files.py"
    spec = importlib.util.spec_from_file_location("era5_files", path)
    assert spec is not None
    assert spec.loader is not None
    era5_files = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(era5_files)
    for layout in (era5_files.new_layout, era5_files.old_layout):
        yield (
            b"\0"
            + layout(
                FILE, latitude=(41.0, 40.5), longitude=(10.0, 10.25), hours=(0, 3)
            ).read_bytes()
        )


WORDS = (
    "valid_time",
    "time",
    "pressure_level",
    "level",
    "latitude",
    "longitude",
    "hours since 1900-01-01",
    "scale_factor",
    "hPa",
    "_FillValue",
    "toast_format_version",
    "CDF\1",
    "CDF\2",
    "\x89HDF",
    "TREE",
    "SNOD",
    "HEAP",
    "OHDR",
    "GCOL",
)

if __name__ == "__main__":
    fuzz("hdf5", target, seeds, longest=60_000, words=WORDS)
