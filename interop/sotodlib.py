"""Scans as sotodlib's AxisManager, and their pointing by so3g. Needs the extra sotodlib."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from zonda.core.errors import InputError
from zonda.core.flags import DETECTOR_MASK, SAMPLE_MASK, TURNAROUND, samples_in
from zonda.core.machine import needed
from zonda.core.numerics.celestial import orientation
from zonda.core.types import Bools, Floats
from zonda.operators.io.axismanager import SAMPLES, SCANS, UNION
from zonda.operators.io.time_ordered_data import TimeOrderedData

from .scans import Scan, Source, scan_of

EXTRA = "sotodlib"

CALIBRATION = {"phase_to_pW": 1.0, "polarity": 1, "r_tes": 0.004, "r_n": 0.008, "r_frac": 0.5}
"""Calibration of every detector: factors that leave the signal in K_RJ, and stand-ins for the
resistances [ohm] of a detector that is biased well, which zonda does not simulate.
"""


def to_axismanager(
    source: Source,
    stream: str = "signal",
    *,
    scan: str | int | None = None,
    dtype: Literal["float32", "float64"] = "float32",
) -> Any:
    """A scan as a `sotodlib.core.AxisManager` with sotodlib's names, angles in rad.

    - ``signal`` (dets, samps) K_RJ, the atmosphere's mean emission included.
    - ``timestamps`` (samps,) POSIX seconds.
    - ``boresight`` (samps,): az without jumps of 360 deg, el, roll.
    - ``boresight_equ`` (samps,): ra, dec, psi, ICRS, zonda's own pointing, which maps of sotodlib
      use where it is there.
    - ``focal_plane`` (dets,): xi, eta (sines, not zonda's tangents) and gamma.
    - ``flags``, a FlagManager of RangesMatrix (dets, samps): those of `axismanager.SAMPLES`;
      ``detectors``, whole rows; ``samples``, single samples that are not finite or flagged in the
      file; ``excluded``, all that no map uses. ``turnarounds``, ``left_scan`` and ``right_scan``
      are Ranges (samps,); the last two where there are throws.
    - ``det_info`` (dets,): name, readout_id, det_id, band, wafer_slot; wafer.bandpass, array, type.
    - ``det_cal`` (dets,): bg, the wafer's number, -1 for detectors that no map uses; bandpass;
      those of `CALIBRATION`.
    - ``iir_params``, empty: no filter of the read-out is to be taken off.
    - ``obs_info``: obs_id, telescope, timestamp, start_time, stop_time, duration, site, latitude,
      longitude [deg], altitude [m].
    - ``hwp_angle`` (samps,), where there is a half-wave plate.

    Parameters
    ----------
    source
        The result of ``pipeline.run(scene, keep=["signal"])``, one of its observations, a file of
        `SaveTOD` (or another in TOAST's HDF5 layout), or what `load_tod` returned. Of a camera of
        several bands each has scans of its own.
    stream
        Name of the stream.
    scan
        Name or number of the scan in the result of a run of several.
    dtype
        so3g's projections and filters want float32, which rounds 30 K of atmosphere to 1 uK.

    Raises
    ------
    InputError
        sotodlib is not installed; the stream was not kept or is not in the file; there is no
        azimuth and elevation.
    """
    core = needed("sotodlib.core", EXTRA)
    found = scan_of(source, stream, scan)
    tod = found.tod
    _check_azel(tod)
    aman = core.AxisManager(
        core.LabelAxis("dets", list(tod.names)),
        core.OffsetAxis("samps", tod.n_samples, 0, tod.name),
    )
    aman.wrap("timestamps", tod.times, [(0, "samps")])
    aman.wrap(
        "signal",
        np.ascontiguousarray(tod.streams[stream], dtype),
        [(0, "dets"), (1, "samps")],
    )
    azimuth, elevation, roll = _angles(tod.boresight_azel)
    pointed = {"az": np.unwrap(-azimuth), "el": elevation, "roll": roll}
    aman.wrap("boresight", _along(core, aman.samps, pointed))
    if len(tod.boresight_radec):
        ra, dec, psi = _angles(tod.boresight_radec)
        pointed = {"ra": ra % (2 * np.pi), "dec": dec, "psi": psi}
        aman.wrap("boresight_equ", _along(core, aman.samps, pointed))
    offsets = dict(zip(("xi", "eta", "gamma"), tod.xieta_sotodlib(), strict=True))
    aman.wrap("focal_plane", _along(core, aman.dets, offsets))
    if tod.hwp_angle is not None:
        aman.wrap("hwp_angle", tod.hwp_angle, [(0, "samps")])
    aman.wrap("flags", _flags(core, aman, found))
    aman.wrap("det_info", _det_info(core, aman, tod))
    aman.wrap("det_cal", _det_cal(core, aman, tod))
    aman.wrap("obs_info", _obs_info(core, tod))
    aman.wrap("iir_params", core.AxisManager())
    return aman


def sight_line(source: Source, *, scan: str | int | None = None, stream: str = "signal") -> Any:
    """The boresight on the sky as so3g computes it from azimuth, elevation and roll: a
    `so3g.proj.CelestialSightLine`.

    At the site of the scan, without refraction (zonda points above the atmosphere), with UT1-UTC
    and polar motion of the IERS. zonda's own directions are in ``boresight_equ`` of
    `to_axismanager`.

    Raises InputError as `to_axismanager`.
    """
    proj = needed("so3g.proj", EXTRA)
    tod = scan_of(source, stream, scan).tod
    _check_azel(tod)
    middle = (
        40587.0 + (tod.times[0] + tod.times[-1]) / 2 / 86400
    )  # POSIX seconds as a modified Julian date
    earth = orientation(np.array([middle]))
    longitude, latitude, turned = _moved_by_the_pole(tod.site, float(earth.x[0]), float(earth.y[0]))
    site = proj.EarthlySite(
        float(np.degrees(longitude)),
        float(np.degrees(latitude)),
        float(tod.site[3]),
    )
    azimuth, elevation, roll = _angles(tod.boresight_azel)
    return proj.CelestialSightLine.az_el(
        tod.times,
        turned - azimuth,
        elevation,
        roll=roll,
        site=site,
        weather="vacuum",
        dut1=float(earth.ut1_utc[0]),
    )


def _moved_by_the_pole(
    site: tuple[str, float, float, float],
    x: float,
    y: float,
) -> tuple[float, float, float]:
    """Longitude and latitude of a site about the celestial pole, and the azimuth of its north
    there, rad.

    x, y: polar motion [rad], which `CelestialSightLine.az_el` has no argument for. IERS Conventions
    (2010), equation 5.3.
    """
    import erfa

    _, latitude, longitude, _ = site

    def axes(longitude: float, latitude: float) -> Floats:  # east, north, up
        (sl, cl), (sb, cb) = ((np.sin(angle), np.cos(angle)) for angle in (longitude, latitude))
        return np.array([[-sl, cl, 0.0], [-sb * cl, -sb * sl, cb], [cb * cl, cb * sl, sb]])

    _, north, up = axes(longitude, latitude) @ erfa.pom00(x, y, 0.0)
    longitude, latitude = np.arctan2(up[1], up[0]), np.arcsin(up[2])
    east_there, north_there, _ = axes(longitude, latitude)
    return (
        float(longitude),
        float(latitude),
        float(np.arctan2(north @ east_there, north @ north_there)),
    )


def _check_azel(tod: TimeOrderedData) -> None:
    if not len(tod.boresight_azel):
        cure = (
            "load the file with LoadTOD and save it again: azimuth and elevation are then computed"
        )
        raise InputError(
            "has no azimuth and elevation (shared/boresight_azel)",
            place=tod.name,
            cure=cure,
        )


def _angles(quaternions: Floats) -> tuple[Floats, Floats, Floats]:
    """Longitude, latitude and psi [rad] of Rz(longitude) Ry(pi/2 - latitude) Rz(psi), (n, 4)."""
    x, y, z, w = quaternions.T
    longitude = np.arctan2(y * z - w * x, x * z + w * y)
    latitude = np.pi / 2 - 2 * np.arctan2(np.hypot(x, y), np.hypot(z, w))
    return longitude, latitude, np.arctan2(w * x + y * z, w * y - x * z)


def _along(core: Any, axis: Any, columns: dict[str, Any]) -> Any:
    """AxisManager of columns along an axis."""
    made = core.AxisManager(axis)
    for key, values in columns.items():
        made.wrap(key, np.ascontiguousarray(values), [(0, axis.name)])
    return made


def _flags(core: Any, aman: Any, scan: Scan) -> Any:
    """The FlagManager."""
    so3g = needed("so3g.proj", EXTRA)
    tod, flags = scan.tod, core.FlagManager.for_tod(aman)

    def of_samples(where: Bools) -> Any:
        ranges = so3g.Ranges.from_mask(where)
        return so3g.RangesMatrix([ranges.copy() for _ in tod.names])

    scans = _scans(tod)
    for name, bit in SAMPLES.items():
        if name not in scans:
            flags.wrap_dets_samps(name, of_samples((tod.flags & np.uint8(bit)) != 0))
    for name, where in scans.items():
        flags.wrap(name, so3g.Ranges.from_mask(where), [(0, "samps")])
    dead = (tod.detector_flags & np.uint8(DETECTOR_MASK)) != 0
    flags.wrap_dets("detectors", dead)
    flags.wrap_dets_samps(
        "samples",
        so3g.RangesMatrix([so3g.Ranges.from_mask(row) for row in scan.spoilt]),
    )
    excluded = (
        of_samples((tod.flags & np.uint8(SAMPLE_MASK)) != 0) + flags.detectors + flags.samples
    )
    flags.wrap_dets_samps(UNION, excluded)
    return flags


def _scans(tod: TimeOrderedData) -> dict[str, Bools]:
    """Masks (n_samp,) of samples in turnarounds and, of a scan that goes back and forth, of those
    in throws of either direction, by sotodlib's names.
    """
    found = {"turnarounds": np.asarray((tod.flags & np.uint8(TURNAROUND)) != 0, np.bool_)}
    if any(tod.intervals.get(f"throw_{end}") for end in SCANS.values()):
        found |= {
            name: samples_in(tod.intervals.get(f"throw_{end}", []), tod.seconds)
            for name, end in SCANS.items()
        }
    return found


def _det_info(core: Any, aman: Any, tod: TimeOrderedData) -> Any:
    names = np.array(tod.names)
    n = tod.n_detectors
    centre = tod.columns.get("band_centre", np.full(n, np.nan))
    band = np.array(
        [str(tod.metadata["band"])] * n
        if "band" in tod.metadata
        else [f"{c / 1e9:.4g} GHz" for c in centre]
    )
    wafer = tod.columns.get("wafer", np.zeros(n)).astype(int)
    slots = np.array([f"ws{number}" for number in wafer])
    about = dict.fromkeys(("name", "readout_id", "det_id"), names)
    info = _along(core, aman.dets, {**about, "band": band, "wafer_slot": slots})
    wafers = {"bandpass": band, "array": slots, "type": np.full(n, "OPTC")}
    info.wrap("wafer", _along(core, info.dets, wafers))
    return info


def _det_cal(core: Any, aman: Any, tod: TimeOrderedData) -> Any:
    """Calibration of the detectors: what sotodlib asks before it uses one."""
    n = tod.n_detectors
    dead = (tod.detector_flags & np.uint8(DETECTOR_MASK)) != 0
    group = tod.columns.get("wafer", np.zeros(n)).astype(int)
    columns = {"bg": np.where(dead, -1, group), "bandpass": aman.det_info.band}
    columns |= {name: np.full(n, value) for name, value in CALIBRATION.items()}
    return _along(core, aman.dets, columns)


def _obs_info(core: Any, tod: TimeOrderedData) -> Any:
    info = core.AxisManager()
    first = float(tod.times[0])
    last = float(tod.times[-1])
    about = {
        "obs_id": tod.name,
        "telescope": tod.telescope,
        "timestamp": first,
        "start_time": first,
        "stop_time": last,
        "duration": last - first,
        **dict(zip(("site", "latitude", "longitude", "altitude"), _site(tod), strict=True)),
    }
    for name, value in about.items():
        info.wrap(name, value)
    return info


def _site(tod: TimeOrderedData) -> tuple[str, float, float, float]:
    """Name, latitude, longitude [deg] and altitude [m]."""
    name, latitude, longitude, altitude = tod.site
    return name, float(np.degrees(latitude)), float(np.degrees(longitude)), float(altitude)
