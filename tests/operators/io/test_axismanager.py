"""HDF5 of sotodlib's `AxisManager.save` in LoadTOD, written here with h5py alone; tests/interop has
files of sotodlib itself."""

import json
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import zonda
from zonda.core.configuration.parameters import ParameterError
from zonda.core.errors import InputError
from zonda.core.numerics.radiation import to_kelvin_rj
from zonda.operators.io.save_tod import load_tod, reader

from ...axismanagers import NAMES, RATE, TURNS, N, content, saved, spans

INSTRUMENT = {
    "name": "camera",
    "telescope": {"name": "dish", "diameter": "0.42 m"},
    "bands": [
        {"name": "f090", "low": "79 GHz", "high": "105 GHz", "fwhm": "30 arcmin"},
        {"name": "f150", "low": "130 GHz", "high": "165 GHz", "fwhm": "17 arcmin"},
    ],
    "detectors": 2,
    "field_of_view": "10 deg",
    "net": "1 mK s(1/2)",
    "main_beam_efficiency": 1.0,
    "illumination_efficiency": 1.0,
    "sample_rate": "50 Hz",
}


def run(path: Path, *steps: Any, **parameters: Any) -> Any:
    recorded = zonda.LoadTOD(file=path, **parameters)
    scene = recorded.scene(seed=1, instrument=INSTRUMENT)
    return zonda.Pipeline([recorded, zonda.Efficiency(), *steps]).run(scene, keep=["signal"])


def test_everything_but_the_stream(tmp_path: Path) -> None:
    fields = content()
    opened = reader(saved(tmp_path / "a.h5"))
    tod = opened.tod
    opened.close()
    assert tod.name == "obs_1750000000_satp1_1111111"
    assert tod.start.startswith("2025-06-15T15:06:40")
    np.testing.assert_allclose(tod.sample_rate, RATE, rtol=1e-6)
    xi, eta, gamma = tod.xieta_sotodlib()
    plane = fields["focal_plane"]
    np.testing.assert_allclose(xi[:5], plane["xi"][:5], atol=1e-15)
    np.testing.assert_allclose(eta[:5], plane["eta"][:5], atol=1e-15)
    np.testing.assert_allclose(np.exp(1j * (gamma - plane["gamma"]))[:5], 1, atol=1e-14)
    assert (tod.detector_flags != 0).tolist() == [False, True, False, False, True, True]
    np.testing.assert_allclose(np.degrees(tod.site[1:3]), [-22.9601, -67.7884], atol=1e-4)
    assert tod.columns["wafer"].tolist() == [0, 0, 0, 1, 1, 1]
    turns, gap = np.zeros((2, N), bool)
    for start, stop in TURNS:
        turns[start:stop] = True
    gap[150:160] = True
    np.testing.assert_array_equal((tod.flags & 4) != 0, turns)
    np.testing.assert_array_equal((tod.flags & 1) != 0, gap)
    # POSIX times have 0.24 us
    np.testing.assert_allclose(
        tod.intervals["throw_rightleft"], [(20 / RATE, 200 / RATE)], atol=3e-7
    )
    wanted = [(220 / RATE, 380 / RATE)]
    np.testing.assert_allclose(tod.intervals["scan_leftright"], wanted, atol=3e-7)


def test_the_stream_with_its_flags(tmp_path: Path) -> None:
    """Glitches of one detector and what sees a source are NaN; a mask without bit 4 keeps that."""
    path = saved(tmp_path / "a.h5")
    for mask, source in ((7, True), (3, False)):
        data = run(path, unit="mK_RJ", detector_mask=mask)
        of_f090, of_f150 = data.observations
        # the dark one is with the first band
        assert (of_f090.n_detectors, of_f150.n_detectors) == (3, 3)
        stream = of_f090.detdata["signal"][0]
        bad = np.zeros(N, bool)
        bad[100:110] = True
        bad[250:255] = source
        np.testing.assert_array_equal(np.isnan(stream), bad)
        wanted = 1e-3 * np.sin(np.arange(N) / RATE)
        np.testing.assert_allclose(stream[~bad], wanted[~bad], rtol=0, atol=1e-9)
        spoilt = np.isnan(of_f150.detdata["signal"][1])
        assert np.flatnonzero(spoilt[:240]).tolist() == []
        assert np.flatnonzero(spoilt[260:]).tolist() == [40, *range(50, 60)]
    np.testing.assert_allclose(of_f090.hwp_angle, content()["hwp_angle"])


def test_az_el_and_roll_are_the_boresight(tmp_path: Path) -> None:
    data = run(saved(tmp_path / "a.h5"), unit="K_RJ")
    scan = data.observations[0]
    np.testing.assert_allclose(scan.azimuth, content()["boresight"]["az"], atol=1e-12)
    np.testing.assert_allclose(scan.elevation, np.radians(50), atol=1e-12)
    x, y, z, w = scan.boresight_azel.T
    roll = np.arctan2(w * x + y * z, w * y - x * z)
    np.testing.assert_allclose(roll, np.radians(10), atol=1e-12)


def test_units(tmp_path: Path) -> None:
    """The unit is that of a Quantity or of the parameter, of the CMB too; without one it is refused."""
    bare = saved(tmp_path / "a.h5")
    with pytest.raises(InputError, match=r"has no unit(.|\n)*LoadTOD: {unit: K_CMB}"):
        run(bare)
    with pytest.raises(ParameterError, match="give a unit of temperature"):
        run(bare, unit="pW")
    with pytest.raises(InputError, match="in 'pW', not in kelvin"):
        run(saved(tmp_path / "p.h5", {"signal": "pW"}))
    kelvin = run(bare, unit="K_RJ")
    cmb = run(bare, unit="mK_CMB")
    quantity = run(saved(tmp_path / "q.h5", {"signal": "mK"}))
    for k, edges in enumerate((("79 GHz", "105 GHz"), ("130 GHz", "165 GHz"))):
        band = zonda.Band(name="b", low=edges[0], high=edges[1])
        one, two, three = (d.observations[k].detdata["signal"] for d in (kelvin, cmb, quantity))
        np.testing.assert_allclose(two, one * 1e-3 * to_kelvin_rj("K_CMB", band), rtol=3e-7)
        np.testing.assert_allclose(three, one * 1e-3, rtol=3e-7)


def test_an_instrument_without_the_band_is_refused(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.h5")
    recorded = zonda.LoadTOD(file=path, unit="K_RJ")
    with pytest.raises(InputError, match=r"at 90 GHz, the instrument at 147\.5 GHz alone"):
        recorded.scene(instrument=INSTRUMENT | {"bands": INSTRUMENT["bands"][1:]})
    without = content()["det_info"]
    del without["wafer"]
    recorded = zonda.LoadTOD(file=saved(tmp_path / "b.h5", det_info=without), unit="K_RJ")
    with pytest.raises(InputError, match="states no band, and the instrument has several"):
        recorded.scene(instrument=INSTRUMENT)


def test_sites(tmp_path: Path) -> None:
    about = {"obs_id": "x", "telescope": "GBT"}
    with pytest.raises(InputError, match=r"where its telescope 'gbt' stands(.|\n)*latitude"):
        reader(saved(tmp_path / "a.h5", obs_info=about))
    about |= {"latitude": 38.4, "longitude": -79.8, "altitude": 800.0}
    opened = reader(saved(tmp_path / "a.h5", obs_info=about))
    np.testing.assert_allclose(np.degrees(opened.tod.site[1:3]), [38.4, -79.8])
    opened.close()


def test_flac_without_its_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = saved(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        del file["signal"]
        group = file.create_group("signal")
        group.attrs["flacarray_format_version"] = "1"
        group.create_dataset("stream_starts", data=np.zeros(len(NAMES), np.int64))
        about = json.loads(file.attrs["_axisman"])
        about["schema"][1]["encoding"] = "flacarray"
        file.attrs["_axisman"] = json.dumps(about)
    monkeypatch.setitem(sys.modules, "flacarray.hdf5", None)
    with pytest.raises(InputError, match=r"compressed with FLAC(.|\n)*pip install flacarray"):
        load_tod(path)


def changed(folder: Path, name: str, **changes: Any) -> Path:
    fields = content()
    for key, value in changes.items():
        *parents, last = key.split("__")
        at = fields
        for parent in parents:
            at = at[parent]
        at[last] = value
    return saved(folder / f"{name}.h5", **fields)


FAULTS: list[tuple[dict[str, Any], str]] = [
    ({"timestamps": np.zeros(N)}, "timestamps do not increase"),
    ({"timestamps": np.full(N, np.nan)}, "timestamps do not increase"),
    ({"timestamps": np.zeros(7)}, "timestamps is no array of 400 numbers"),
    ({"boresight__el": np.full(N, np.nan)}, "NaN or impossible values in boresight_azel"),
    ({"boresight__el": np.array(["x"] * N, "S")}, "el is no array of 400 numbers"),
    ({"boresight": {}}, "incomplete or corrupt: there is no field az"),
    ({"focal_plane": {}}, "there is no field xi"),
    ({"signal": np.zeros((len(NAMES), 7))}, "has no stream 'signal'"),
    ({"signal": np.full((len(NAMES), N), b"x")}, "not 6 x 400 numbers"),
    ({"flags__turnarounds": spans([[(-5, 20)]])}, "do not fit together"),
    ({"flags__turnarounds": spans([[(5, 500)]])}, "beyond its 400 samples"),
    ({"flags__glitches": spans([[(5, 3)]] * 6)}, "do not fit together"),
    ({"flags__slow": spans([[(0, 5)]] * 6) | {"ends": np.arange(6)}}, "do not fit together"),
    ({"hwp_angle": np.full(N, np.inf)}, "NaN or impossible values in hwp_angle"),
    ({"det_info__wafer__bandpass": np.array(["f090"], "S")}, "no array of 6 texts"),
    ({"obs_info__telescope": "moon"}, "where its telescope"),
]


@pytest.mark.parametrize(("changes", "said"), FAULTS, ids=[said for _, said in FAULTS])
def test_faults_are_named(tmp_path: Path, changes: dict[str, Any], said: str) -> None:
    path = changed(tmp_path, "a", **changes)
    with pytest.raises(InputError, match=said):
        run(path, unit="K_RJ")


@pytest.mark.parametrize(
    "text", ["3", "[]", "{}", '{"version": 1, "schema": []}', '{"version": 0, "schema": [7]}', "\0"]
)
def test_schemas_that_are_none(tmp_path: Path, text: str) -> None:
    path = saved(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        file.attrs["_axisman"] = np.bytes_(text) if "\0" in text else text
    with pytest.raises(InputError, match=r"AxisManager of sotodlib|incomplete or corrupt"):
        reader(path)
