"""The shipped pipeline, shortened: what a user gets from `zonda run mustang2_cluster`."""

import errno
import os

import numpy as np
import pytest

import zonda
from zonda.core import cli
from zonda.pipelines import mustang2_cluster as twin

SHORT = ["PointingDaisy.scan_duration=12 s", "PointingDaisy.scans=2"]
ARGUMENTS = ["run", "mustang2_cluster", *(a for s in SHORT for a in ("--set", s))]
PICTURES = ["input", "noiseless_map", "map", "noise_map", "coverage", "power_spectra"]


def command(*arguments):
    return cli.main([str(a) for a in arguments])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "mustang2_cluster"
    assert command(*ARGUMENTS, "--output", out) == 0
    return out


def test_products(folder):
    names = {p.name for p in folder.iterdir()}
    maps = {"map.fits", "noise_map.fits", "noiseless_map.fits", "source_free_map.fits"}
    assert maps | {f"{n}.png" for n in PICTURES} | {"report.html", "resolved.yaml"} <= names
    assert not [n for n in names if n.startswith(".") or ".part" in n]


def test_maps_carry_what_they_should(folder):
    from astropy.io import fits
    from astropy.wcs import WCS

    with fits.open(folder / "map.fits") as file:
        header = file[0].header
        assert {"SIGNAL", "HITS", "WEIGHTS", "NOISE", "HALF_DIFFERENCE"} <= {h.name for h in file}
        assert (header["BUNIT"], header["TEMPSCAL"], header["SEED"]) == ("K", "K_RJ", 20241125)
        assert np.isclose(header["BMAJ"] * 3600, 8.5)
        x, y = WCS(header).world_to_pixel_values(75, 20)
        x, y = round(float(x)), round(float(y))
        assert file["HITS"].data[y - 15 : y + 15, x - 15 : x + 15].sum() > 0
        assert file["HITS"].data.sum() <= 2 * 1200 * 223
    with fits.open(folder / "noise_map.fits") as file:
        rms = [file[0].header[k] for k in ("RMSHALF", "RMSFREE")]
        assert all(1e-4 < r < 1e-2 for r in rms)


def test_report_says_what_was_simulated(folder):
    text = (folder / "report.html").read_text()
    for words in (
        "20241125",
        "mustang2",
        "green_bank",
        "AtmosphereLayers",
        "7.7 mm",
        "data:image/png;base64",
        zonda.__version__,
        "numpy",
    ):
        assert words in text
    assert "http://" not in text.replace("http://www.w3.org", "")


def test_resolved_file_gives_the_same_bits(folder, tmp_path):
    assert command("run", folder / "resolved.yaml", "--output", tmp_path / "again") == 0
    from astropy.io import fits

    for name in ("map.fits", "noise_map.fits", "noiseless_map.fits"):
        with fits.open(folder / name) as a, fits.open(tmp_path / "again" / name) as b:
            assert np.array_equal(a[0].data, b[0].data, equal_nan=True)


def test_the_twin_in_python_is_the_same():
    loaded = zonda.load("mustang2_cluster")
    assert loaded.scene() == twin.scene()
    one, other = loaded.pipeline(), twin.pipeline()
    assert [o.model_dump() for o in one.operators] == [o.model_dump() for o in other.operators]
    assert (one.runs, one.name, one.description) == (other.runs, other.name, other.description)


def test_the_twin_gives_identical_bits():
    loaded = zonda.load("mustang2_cluster", overrides=SHORT)
    whole = loaded.pipeline()
    one = zonda.Pipeline(whole.operators[:-3], runs=whole.runs).run(
        loaded.scene()
    )  # without files and pictures
    short = twin.pipeline()
    steps = [
        short.operators[0].model_copy(update={"scan_duration": 12.0, "scans": 2}),
        *short.operators[1:-3],
    ]
    other = zonda.Pipeline(steps, runs=short.runs).run(twin.scene(), threads=1)
    for name in ("map", "noiseless/map", "source_free/map"):
        for part in ("signal", "hits", "weights", "noise", "half_difference"):
            assert np.array_equal(
                getattr(one.products[name], part),
                getattr(other.products[name], part),
                equal_nan=True,
            )


def test_the_run_tells_of_losses_alone(tmp_path, capsys):
    assert command(*ARGUMENTS, "--output", tmp_path / "out") == 0
    said = capsys.readouterr()
    assert said.out == f"{tmp_path / 'out'}/\n"
    assert "samples binned" not in said.err
    first, *rest = said.err.splitlines()
    assert first.startswith("simulated in full (")
    assert all(line.startswith("SkyMap: samples outside the input map: ") for line in rest)


def test_output_is_a_file(tmp_path, capsys):
    (tmp_path / "out").write_text("")
    assert command(*ARGUMENTS, "--output", tmp_path / "out") == 2
    message = capsys.readouterr().err
    assert "out" in message
    assert "Traceback" not in message


def test_full_disk_leaves_nothing_half_written(tmp_path, monkeypatch, capsys):
    real = os.replace

    def full(source, target):
        if str(target).endswith("noiseless_map.fits"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(source, target)

    monkeypatch.setattr(os, "replace", full)
    assert command(*ARGUMENTS, "--output", tmp_path / "out") == 2
    message = capsys.readouterr().err
    assert "no space left on the disk" in message
    assert "Traceback" not in message
    assert not [
        p
        for p in (tmp_path / "out").iterdir()
        if ".part" in p.name or p.name == "noiseless_map.fits"
    ]


def test_atlast_reduced_on_a_thin_slice(tmp_path):
    """Two scans of 4 s, all detectors: a map and its noise map, whose noise is that of the
    detectors' NET.
    """
    from astropy.io import fits

    out = tmp_path / "out"
    loaded = zonda.load("atlast_reduced", overrides=["PointingDaisy.scan_duration=4 s"])
    chain = zonda.Pipeline(
        [o for o in loaded.pipeline().operators if type(o).__name__ not in ("Plots", "Report")]
    )
    with pytest.warns(UserWarning, match="acceleration|samples per FWHM"):
        data = chain.run(loaded.scene(), output=out)
    assert [(o.n_detectors, o.n_samples, o.sample_rate) for o in data.observations] == [
        (3000, 900, 225.0)
    ] * 2
    product = data.products["map"]
    assert product.hits.sum() == 2 * 900 * 3000
    both = np.isfinite(product.half_difference) & (product.hits > 40)
    # the half-difference over each pixel's noise from NET has unit variance, and what filters leave
    # of 1/f noise and air more
    ratio = (product.half_difference / product.noise)[both].std()
    assert 0.9 < ratio < 1.5
    with fits.open(out / "map.fits") as file:
        assert {"SIGNAL", "HITS", "WEIGHTS", "NOISE", "HALF_DIFFERENCE"} <= {h.name for h in file}
