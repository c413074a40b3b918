"""Maximum-likelihood maps have the same bits however they are executed: memory budgets, files,
threads of BLAS, campaigns that are interrupted."""

import hashlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

import zonda
from zonda.core import cli
from zonda.core.campaign import tasks
from zonda.core.campaign.campaign_file import Job
from zonda.core.configuration.pipeline_file import load
from zonda.core.errors import PipelineError
from zonda.core.flags import OPAQUE
from zonda.core.hooks import manager
from zonda.core.run import streams
from zonda.core.run.streams import Files
from zonda.operators.maps import compressed_scan, runs_of_pointing
from zonda.plugins.checks.scenes import run as run_of

from ...scenes import camera
from .test_maximum_likelihood import SIGMA, drifts, observation

YAML = f"""\
{camera(76)}campaign: CAMPAIGN
runs: {{quiet: {{only: [white, pink]}}}}
operators:
  - PointingDaisy: {{radius: 1 arcmin, speed: 50 arcsec/s, scan_duration: 24 s, scans: 3, gap: 1 s}}
  - AtmosphereLayers: {{pwv: 5 mm, layers: 2}}
  - WhiteNoise
  - PinkNoise
  - Efficiency
  - MaximumLikelihoodMap: {{pixel: 3 arcsec}}
  - SaveMap
"""


STREAMS = ["signal", "signal/quiet"]
PLATE = (
    ("  knee:", "  polarization: pairs\n  knee:"),
    ("  - AtmosphereLayers", "  - HalfWavePlate: {frequency: 2 Hz}\n  - AtmosphereLayers"),
    ("{pixel: 3 arcsec}", "{pixel: 3 arcsec, stokes: IQU}"),
)


def file_of(folder, campaign="null", changes=()):
    path = Path(folder) / f"{hashlib.md5(campaign.encode()).hexdigest()}.yaml"
    text = YAML.replace("CAMPAIGN", campaign)
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    return path


def digest(data):
    """Of all values of the maps of both signals."""
    found = hashlib.sha256()
    for name in ("map", "quiet/map"):
        for plane in ("signal", "half_difference", "noise"):
            found.update(np.ascontiguousarray(getattr(data[name], plane)).tobytes())
    return found.hexdigest()


def run(folder, changes=(), **how):
    file = load(str(file_of(folder, changes=changes)), ())
    return file.pipeline().run(file.scene(), **{"threads": 1, "output": folder / "out", **how})


@pytest.fixture(scope="module")
def ample(tmp_path_factory):
    """The digest of a run with ample memory, and its data."""
    data = run(tmp_path_factory.mktemp("ample"))
    return digest(data), data


def test_streams_that_do_not_fit_are_made_again_for_both_readings(ample, tmp_path):
    whole, data = ample
    assert not any("made again" in what for _, what, _ in data.log)
    # streams of two signals take 2 x 76 x 1200 x 4 bytes = 730 kB, more than half; a block 1075 kB
    data = run(tmp_path, memory=1_100_000)
    assert digest(data) == whole
    again = [what for _, what, _ in data.log if "made again" in what]
    assert again == [f"stream {name} made again when it is read" for name in STREAMS]


AGAIN = "runs are found anew in each iteration, baselines "


@pytest.mark.parametrize(
    ("hold", "room", "said"),
    [
        (True, 0, "in temporary files"),
        (False, 0, f"{AGAIN}in temporary files"),
        (False, 1 << 40, f"{AGAIN}in memory"),
    ],
)
def test_compressed_scans_have_the_same_bits_wherever_they_are(
    ample, tmp_path, monkeypatch, hold, room, said
):
    """Some detectors at a time; two threads."""
    monkeypatch.setattr("zonda.core.pipeline.files_of", lambda budget: Files(room))
    monkeypatch.setattr(Files, "fits", lambda self, size: hold)
    monkeypatch.setattr(streams, "LEAST_FILE", 1)
    monkeypatch.setattr(compressed_scan, "PART", 5000)
    monkeypatch.setattr(runs_of_pointing, "FOUND", 100_000)
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    data = run(tmp_path, threads=2)
    assert digest(data) == ample[0]
    assert ("MaximumLikelihoodMap", "compressed scans", said) in list(data.log)
    assert not any(what == "compressed scans" for _, what, _ in ample[1].log)
    assert not list(temporary.iterdir())


def test_campaigns_keep_their_runs(ample, tmp_path, monkeypatch):
    """Partial products hold runs, also where a single run would find them anew."""
    monkeypatch.setattr(Files, "fits", lambda self, size: False)
    path, out = str(file_of(tmp_path, "{}")), tmp_path / "out"
    engine = ["--engine", "serial", "--threads", "1", "--no-prune"]
    assert cli.main(["run", path, "--output", str(out), *engine]) == 0
    found, expected = zonda.read_map(out / "map.fits"), ample[1]["map"].signal
    np.testing.assert_array_equal(found.signal, expected)


@pytest.mark.parametrize(
    ("polarized", "plate", "how"),
    [
        (False, False, {"pixel": "15 arcsec", "width": "7.5 arcmin"}),
        (False, False, {"nside": 8192}),
        (True, False, {"pixel": "15 arcsec", "stokes": "IQU"}),
        (True, True, {"pixel": "15 arcsec", "stokes": "IQU"}),
    ],
)
def test_gaps_and_angles_have_the_same_bits_wherever_they_are(monkeypatch, polarized, plate, how):
    """Samples without a value, in stretches and alone, and flagged instants."""
    rng = np.random.default_rng(3)
    maker = zonda.MaximumLikelihoodMap(half_difference=False, tolerance=0.09, refine=0, **how)
    o = observation(polarized, plate)
    noise = drifts(o, rng) + SIGMA * rng.normal(size=(o.n_detectors, o.n_samples))
    noise[2, ::97] = noise[5:9, 2000:2300] = np.nan
    monkeypatch.setattr(streams, "LEAST_FILE", 1)
    monkeypatch.setattr(compressed_scan, "PART", 50_000)

    def made(hold, room, found):
        o = observation(polarized, plate)
        o.flags[1000:1100] |= OPAQUE
        with monkeypatch.context() as here:
            here.setattr("zonda.core.pipeline.files_of", lambda budget: Files(room))
            here.setattr(Files, "fits", lambda self, size: hold)
            here.setattr(runs_of_pointing, "FOUND", found)
            data = run_of([maker], o, noise)
        said = [text for _, what, text in data.log if what == "compressed scans"]
        planes = data["map"].planes.values()
        return [np.asarray(plane.values).tobytes() for plane in planes], said

    whole, said = made(True, 1 << 40, 1 << 22)
    assert not said
    assert made(True, 0, 1) == (whole, ["in temporary files"])
    assert made(False, 0, 1) == (whole, [f"{AGAIN}in temporary files"])
    assert made(False, 1 << 40, 1 << 19) == (whole, [f"{AGAIN}in memory"])


def test_scans_that_fit_nowhere_are_refused_before_anything_runs(tmp_path, monkeypatch):
    monkeypatch.setattr("zonda.core.pipeline.files_of", lambda budget: Files(0))
    monkeypatch.setattr(streams, "free_disk", lambda: 1000)
    with pytest.raises(PipelineError, match="neither in memory") as caught:
        run(tmp_path)
    assert "pixel" in caught.value.cure
    assert "baseline" in caught.value.cure


def test_arrays_in_files_are_what_they_were(monkeypatch):
    monkeypatch.setattr(streams, "AT_A_TIME", 7)
    rng = np.random.default_rng(1)
    large = rng.integers(0, 1000, size=(30, 2000)).astype(np.int32)
    found = Files(0).put({"a": [large, 3, "text"], "b": {"c": np.arange(5.0)}})
    assert isinstance(found["a"][0], np.memmap)
    np.testing.assert_array_equal(found["a"][0], large)
    assert found["a"][1:] == [3, "text"]
    assert not isinstance(found["b"]["c"], np.memmap)


def test_room_in_memory_is_given_once():
    files = Files(100)
    assert not files.needed(60, "here", "less")
    assert files.needed(60, "here", "less")
    assert not files.needed(40, "here", "less")


PROGRAM = """
import sys
from pathlib import Path
from tests.operators.maps.test_likelihood_bits import PLATE, digest, run
changes = PLATE if sys.argv[3] == "IQU" else ()
print(digest(run(Path(sys.argv[1]), changes, threads=int(sys.argv[2]))))
"""


@pytest.mark.nightly
@pytest.mark.parametrize("stokes", ["I", "IQU"])
def test_threads_of_blas_change_no_bit(ample, tmp_path, stokes):
    """Of I, and of I, Q and U with a half-wave plate."""
    here = ample[0] if stokes == "I" else digest(run(tmp_path, PLATE))
    runs = []
    for threads in ("1", "2"):
        folder = tmp_path / threads
        folder.mkdir()
        more = {"OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads}
        command = [sys.executable, "-W", "ignore", "-c", PROGRAM, str(folder), threads, stokes]
        runs.append(
            subprocess.Popen(
                command,
                env=os.environ | more,
                cwd=Path(__file__).parents[3],
                stdout=subprocess.PIPE,
                text=True,
            )
        )
    assert [one.communicate()[0].split()[-1] for one in runs] == [here] * 2


def planes(folder):
    from astropy.io import fits

    found = {}
    for path in sorted(folder.glob("*.fits")):
        with fits.open(path) as file:
            found |= {(path.name, hdu.name): hdu.data.tobytes() for hdu in file if hdu.is_image}
    return found


@pytest.fixture(scope="module")
def single(tmp_path_factory):
    """Planes of the maps of one run."""
    folder = tmp_path_factory.mktemp("single")
    arguments = ["run", str(file_of(folder)), "--output", str(folder / "out"), "--threads", "2"]
    assert cli.main([*arguments, "--no-prune"]) == 0
    return planes(folder / "out")


def test_an_interrupted_campaign_has_the_bits_of_one_run(single, tmp_path, monkeypatch):
    """Two of three tasks, then the rest; partial products do not fit in memory."""
    monkeypatch.setattr(tasks, "available_memory", lambda: 0)
    monkeypatch.setattr(streams, "LEAST_FILE", 1)
    path, out = str(file_of(tmp_path, "{keep_tasks: true}")), tmp_path / "out"
    engine = ["--engine", "serial", "--threads", "1"]
    assert (
        cli.main(["run", path, "--output", str(out), *engine, "--task", "1/2", "--no-prune"]) == 0
    )
    assert len(Job.read(out).tasks) == 3
    assert not list(out.glob("*.fits"))
    assert cli.main(["resume", str(out), *engine]) == 0
    assert planes(out) == single
    assert ("map.fits", "SIGNAL") in single


@pytest.mark.nightly
@pytest.mark.parametrize("workers", [1, 2, 3, 4])
def test_workers_change_no_bit(single, tmp_path, workers):
    path, out = str(file_of(tmp_path, "{}")), tmp_path / "out"
    engine = ["--engine", "processes", "--workers", str(workers), "--no-prune"]
    assert cli.main(["run", path, "--output", str(out), *engine]) == 0
    assert planes(out) == single


def test_a_signal_has_its_bits_without_others(ample, tmp_path):
    file = load(str(file_of(tmp_path)), ())
    steps = [step.operator for step in file.steps]
    data = zonda.Pipeline(steps).run(file.scene(), threads=1, output=tmp_path / "out")
    data.products["quiet/map"] = ample[1].products["quiet/map"]
    assert digest(data) == ample[0]


def test_iterations_show_their_progress(tmp_path):
    """Progress of the noise, a draw of it, both signals and their halves rises to the tolerance."""
    seen = {}

    class Hears:
        @zonda.hookimpl
        def zonda_progress(self, done, total, what):
            if "iterations" in what:
                seen.setdefault(what.partition(", ")[2], []).append(done / total)

    plugin = Hears()
    manager().register(plugin)
    try:
        run(tmp_path)
    finally:
        manager().unregister(plugin)
    both = [
        f"{name}{half}" for name in ("map", "quiet/map") for half in ("", ", half 1", ", half 2")
    ]
    assert list(seen) == ["noise", "noise, a draw", *both]
    for shares in seen.values():
        assert shares == sorted(shares)
        assert shares[-1] == 1


def test_realizations_are_draws_of_the_noise(tmp_path):
    """`realizations` without co-adding: a map of other noise each, independent of the others."""
    path, out = str(file_of(tmp_path, "{realizations: 3, combine: []}")), tmp_path / "out"
    assert (
        cli.main(["run", path, "--output", str(out), "--engine", "serial", "--threads", "1"]) == 0
    )
    maps = [zonda.read_map(p) for p in sorted(out.glob("*/map.fits"))]
    assert len(maps) == 3
    ok = np.all([m.known & (m.hits > 30) for m in maps], axis=0)
    one, two, three = (m.signal[ok] for m in maps)
    for a, b in ((one, two), (one, three), (two, three)):
        # independent: correlations of n pixels scatter by n^-1/2; slow noise leaves fewer
        assert abs(np.corrcoef(a, b)[0, 1]) < 0.3
