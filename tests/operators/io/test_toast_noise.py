"""The noise models of TOAST files: NET, knee and slope fitted to their power spectra."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import zonda
from zonda.core.errors import InputError
from zonda.core.flags import INVALID
from zonda.core.testing import Given, Points, made_up_scene
from zonda.operators.io.save_tod import load_tod, save_tod
from zonda.operators.io.toast_noise import fit

TRUTH = [
    (3e-4, 0.1, 1e-3, 1.0),
    (3e-4, 5.0, 1e-4, 2.5),
    (1e-3, 0.01, 1e-5, 1.3),
    (3e-4, 1.0, 1e-2, 3.8),
    (3e-4, 0.1, 1e-3, 0.3),
]
"""NET, knee, minimum frequency, slope."""


def toasts(f: Any, net: float, knee: float, low: float, slope: float) -> Any:
    """As toast.noise_sim.AnalyticNoise."""
    return net**2 * (f**slope + knee**slope) / (f**slope + low**slope)


def ours(f: Any, net: float, knee: float, low: float, slope: float) -> Any:
    return net**2 * (1 + (knee / np.maximum(f, low)) ** slope)


@pytest.mark.parametrize("form", [toasts, ours])
@pytest.mark.parametrize("truth", TRUTH)
def test_the_spectrum_that_was_written_comes_back(form: Any, truth: Any) -> None:
    f = np.geomspace(1e-6, 50, 100)
    found = fit(f, form(f, *truth).astype("f4").astype(float), "here")
    np.testing.assert_allclose(found, truth, rtol=1e-5)  # TOAST stores spectra in float32, 6e-8


def test_a_measured_spectrum_and_a_white_one() -> None:
    """Of 20 000 linear frequencies with 20 degrees of freedom each: NET to 1 %, knee and slope to
    some standard errors.
    """
    f, draw = np.arange(1, 20001) * 2.5e-3, np.random.default_rng(0)
    scatter = draw.chisquare(20, len(f)) / 20
    net, knee, _, slope = fit(f, ours(f, 3e-4, 5.0, 1e-4, 2.0) * scatter, "here")
    assert abs(net / 3e-4 - 1) < 0.01
    assert abs(knee / 5.0 - 1) < 0.1
    assert abs(slope / 2.0 - 1) < 0.1
    white = fit(f, 1e-6 * scatter, "here")
    assert abs(white[0] / 1e-3 - 1) < 0.01
    assert white[1] == 0


@pytest.mark.parametrize(("rise", "knee"), [(1.4, 0.0), (1.6, 0.1)])
def test_a_spectrum_that_hardly_rises_is_white(rise: float, knee: float) -> None:
    """Up to half as much power again. The spectrum ``toasts`` rises to (knee / low)^slope of the
    white level.
    """
    f = np.geomspace(1e-3, 10, 200)
    net, found, *_ = fit(f, toasts(f, 1e-3, 0.1, 0.1 / rise, 1.0), "here")
    assert net == pytest.approx(1e-3, rel=0.003)  # 1 / f is a hundredth at the highest frequencies
    assert found == pytest.approx(knee, rel=1e-5)


@pytest.mark.parametrize("form", [toasts, ours])
def test_a_spectrum_that_is_flat_nowhere_begins_with_its_frequencies(form: Any) -> None:
    """Nothing is known below the lowest."""
    f = np.geomspace(1e-3, 10, 200)
    np.testing.assert_allclose(
        fit(f, form(f, 1e-3, 0.1, 1e-9, 1.0), "here"), [1e-3, 0.1, f[0], 1.0], rtol=1e-5
    )


def test_a_fit_does_not_depend_on_where_a_spectrum_is_sampled() -> None:
    """Of a spectrum that has neither form: it rises ever more steeply. The fit stands between 1 and
    2.5 for the same share.
    """

    def steeper(f: Any) -> Any:
        return 1 + 0.5 / f + (0.2 / f) ** 2.5

    (_, knee, _, slope), (_, other_knee, _, other_slope) = (
        fit(f, steeper(f), "here")
        for f in (np.linspace(0.05, 15, 3000), np.geomspace(0.05, 15, 300))
    )
    assert knee == pytest.approx(other_knee, abs=0.01)  # 0.036 where each of the 3000 counts alike
    assert slope == pytest.approx(other_slope, abs=0.03)  # 0.10


def write_model(
    file: Any, names: list[str], spectra: Any, units: str = "K2 s", model: str = "measured"
) -> None:
    """As `toast.noise.Noise.save_hdf5`: half of the detectors share their second spectrum."""
    group, f = file["metadata"].create_group(model), np.geomspace(1e-5, 10, 120)
    group.attrs["class"], group.attrs["psd_units"] = "toast.noise.Noise", units
    keys = [name.encode() for name in names] + [b"common"]
    rows = [spectra(f, k) for k in range(len(keys))]
    group.create_dataset("0a", data=np.vstack([f, rows]).astype("f4"))
    group.create_dataset("0a_keys", data=np.array(keys, "S16"))
    mix = [(name.encode(), name.encode(), 1.0) for name in names] + [
        (name.encode(), b"common", 2.0) for name in names[::2]
    ]
    group.create_dataset("mixing_matrix", data=np.array(mix, "S16, S16, f4"))


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    zonda.Pipeline([Points(), Given(), zonda.SaveTOD()]).run(
        made_up_scene(), output=tmp_path, threads=1
    )
    (path,) = tmp_path.glob("tod_*.h5")
    return path


def test_a_model_of_the_file_is_chosen_by_name(saved: Path) -> None:
    """Each detector's spectrum is that which TOAST mixes for it: its own, and four times the common
    one for every second.
    """
    with h5py.File(saved, "a") as file:
        names = [row["name"].decode() for row in file["instrument/focalplane"][:]]
        write_model(
            file,
            names,
            lambda f, k: (
                ours(f, 1e-3 * (1 + k), 0.2, 1e-3, 1.0) if k < len(names) else 0 * f + 1e-6
            ),
        )
    step = zonda.LoadTOD(file=saved, noise_model="measured")
    data = zonda.Data(step.scene())
    step.observe(data)
    (observation,) = data.observations
    own = 1e-6 * (1 + np.arange(len(names))) ** 2
    expected = np.sqrt(own + np.where(np.arange(len(names)) % 2 == 0, 4e-6, 0))
    np.testing.assert_allclose(observation.focalplane.net, expected, rtol=1e-5)
    np.testing.assert_allclose(
        observation.focalplane.knee, 0.2 * own / expected**2, rtol=1e-4
    )  # slope 1
    assert ("noise of the detectors", "fitted to the file's measured") in [
        (what, text) for _, what, text in observation.log
    ]


def test_a_table_stands_in_for_a_model_that_cannot_be_used(saved: Path) -> None:
    """As the message about the model advises."""
    tod = load_tod(saved)
    del tod.columns["net"]
    path, table = save_tod(saved.with_name("bare.h5"), tod), saved.with_suffix(".ecsv")
    with h5py.File(path, "a") as file:
        write_model(file, tod.names, lambda f, k: 0 * f + 1e-6, units="V2 s", model="noise_model")
    head = "".join(
        f"# - {{name: {name}, datatype: float64}}\n" for name in ("net", "knee", "slope")
    )
    rows = "".join(f"{name} 0.002 0.5 1.5\n" for name in tod.names)
    head = f"# %ECSV 1.0\n# ---\n# datatype:\n# - {{name: name, datatype: string}}\n{head}"
    table.write_text(f"{head}name net knee slope\n{rows}")
    with pytest.raises(InputError, match="spectra in 'V2 s'"):
        zonda.LoadTOD(file=path).scene()
    step = zonda.LoadTOD(file=path, noise=table)
    data = zonda.Data(step.scene())
    step.observe(data)
    np.testing.assert_array_equal(data.observations[0].focalplane.knee, 0.5)


def test_models_that_cannot_be_used(saved: Path) -> None:
    with h5py.File(saved, "a") as file:
        names = [row["name"].decode() for row in file["instrument/focalplane"][:]]
        write_model(file, names, lambda f, k: 0 * f + 1e-6, units="V2 s", model="volts")
        write_model(file, names, lambda f, k: 0 * f - 1e-6, model="negative")
        write_model(file, names[1:], lambda f, k: 0 * f + 1e-6, model="one_lacks")
    wrong = {
        "none_such": "has no noise model 'none_such'",
        "volts": "spectra in 'V2 s', not in K2 s",
        "negative": "not positive and finite",
        "one_lacks": f"has no spectrum of detector {names[0]}",
    }
    for model, message in wrong.items():
        with pytest.raises(InputError, match=message) as caught:
            zonda.LoadTOD(file=saved, noise_model=model).scene()
        assert saved.name in caught.value.place
        assert caught.value.cure


@pytest.mark.parametrize("kind", ["zero", "NaN", "none"])
def test_a_flagged_detector_needs_no_spectrum(saved: Path, kind: str) -> None:
    """It weighs nothing; the noise of another detector stands for it."""
    tod = load_tod(saved)
    tod.detector_flags[3] |= INVALID
    path = save_tod(saved.with_name("flagged.h5"), tod)
    bad = {"zero": 0.0, "NaN": np.nan, "none": 1e-6}[kind]
    with h5py.File(path, "a") as file:
        write_model(
            file, tod.names, lambda f, k: 0 * f + (bad if k == 3 else 1e-6), model="measured"
        )
        if kind == "none":
            group = file["metadata/measured"]
            rows = [row for row in group["mixing_matrix"][:] if row[0] != tod.names[3].encode()]
            del group["mixing_matrix"]
            group.create_dataset("mixing_matrix", data=np.array(rows, "S16, S16, f4"))
    step = zonda.LoadTOD(file=path, noise_model="measured")
    data = zonda.Data(step.scene())
    step.observe(data)
    (observation,) = data.observations
    assert not observation.good_detectors[3]
    assert np.isfinite(observation.focalplane.net).all()
    with pytest.raises(InputError, match=tod.names[3]):
        zonda.LoadTOD(file=path, noise_model="measured", detector_mask=0).scene()


def test_units_and_the_frequency_zero(saved: Path) -> None:
    """TOAST's spectra may be in other units, and begin at 0 Hz."""
    with h5py.File(saved, "a") as file:
        names = [row["name"].decode() for row in file["instrument/focalplane"][:]]
        write_model(file, names, lambda f, k: 0 * f + 1.0, units="mK2 s")
        group = file["metadata/measured"]
        rows = group["0a"][:]
        del group["0a"]
        group.create_dataset("0a", data=np.hstack([np.zeros((len(rows), 1), "f4"), rows]))
    step = zonda.LoadTOD(file=saved, noise_model="measured")
    data = zonda.Data(step.scene())
    step.observe(data)
    np.testing.assert_allclose(data.observations[0].focalplane.net[1::2], 1e-3, rtol=1e-6)
    np.testing.assert_allclose(
        data.observations[0].focalplane.net[::2], 1e-3 * np.sqrt(5), rtol=1e-6
    )
