"""Campaigns from the command line: the same bits in any order, failures, resumption."""

from __future__ import annotations

import json
import os
import random
import signal
import threading
from concurrent.futures import Executor, Future
from dataclasses import replace

import h5py
import pytest

from zonda.core.campaign import tasks as campaign
from zonda.core.campaign.campaign_file import Job
from zonda.core.campaign.folder import Record
from zonda.core.campaign.tasks import Outcome, perform
from zonda.core.experiment import experiment
from zonda.core.experiment.engines import Pool, SerialExecutor

SERIAL = ("--engine", "serial", "--threads", 1)


class Shuffled(Executor):
    """Takes all tasks first, then does them in a random order."""

    def __init__(self, expected, seed):
        self.expected, self.seed, self.calls = expected, seed, []

    def submit(self, fn, /, *args, **kwargs):
        future = Future()
        self.calls.append((future, fn, args))
        if len(self.calls) == self.expected:
            threading.Thread(target=self.work, args=(self.calls,)).start()
            self.calls, self.expected = [], 1
        return future

    def work(self, calls):
        random.Random(self.seed).shuffle(calls)
        for future, fn, args in calls:
            future.set_result(fn(*args))


def read(folder):
    return list(Record(Job.read(folder), folder).rows())


def states(folder):
    return [row.state for row in read(folder)]


def test_products(undisturbed):
    names = {p.name for p in undisturbed.iterdir()}
    assert names == {
        "zonda-files.jsonl",
        "campaign.json",
        "tasks.npz",
        "map.fits",
        "noise_map.fits",
        "resolved.yaml",
    }
    from astropy.io import fits

    with fits.open(undisturbed / "map.fits") as file:
        assert file[0].header["NSCANS"] == 12
        assert file["HITS"].data.sum() <= 12 * 300 * 19
        assert "nights:" in "".join(str(card) for card in file[0].header["HISTORY"])


@pytest.mark.nightly
def test_processes_give_the_same_bits(undisturbed, bench):
    out = bench.run(bench.CAMPAIGN, "--engine", "processes", "--workers", 3)
    assert bench.planes(out) == bench.planes(undisturbed)
    assert bench.planes(out, "noise_map.fits") == bench.planes(undisturbed, "noise_map.fits")


def test_any_order_of_completion_gives_the_same_bits(undisturbed, bench, monkeypatch):
    for seed in (1, 2):
        monkeypatch.setattr(
            "zonda.core.experiment.engines.SerialExecutor", lambda seed=seed: Shuffled(12, seed)
        )
        monkeypatch.setattr(
            "zonda.core.experiment.engines.Pool", lambda ex, *rest, **more: Pool(ex, 12, 0, 1, None)
        )
        out = bench.run(bench.CAMPAIGN, *SERIAL)
        assert bench.planes(out) == bench.planes(undisturbed)


def test_tasks_of_whole_entries_give_the_same_bits(undisturbed, bench):
    out = bench.run("{nights: 3, realizations: 2, task: entry}", *SERIAL)
    assert len(Job.read(out).tasks) == 6
    assert bench.planes(out) == bench.planes(undisturbed)


def test_a_tree_of_several_levels_gives_the_same_maps(undisturbed, bench, monkeypatch):
    monkeypatch.setattr("zonda.core.campaign.tasks.FAN", 2)
    assert bench.planes(bench.run(bench.CAMPAIGN, *SERIAL)) == bench.planes(undisturbed)


def test_scans_as_tasks_are_the_plain_run(bench, capsys):
    """One entry is an ordinary run: same maps, same mean spectrum, same log, the same told of it
    with its shares.
    """
    plain, split = bench.new(), bench.new()
    file = bench.file("null")
    said = []
    for out, how in ((plain, ()), (split, SERIAL)):
        assert bench.command("run", file, "--output", out, "--no-prune", "--verbose", *how) == 0
        said.append([line for line in capsys.readouterr().err.splitlines() if line.endswith("%)")])
    assert said[0] == said[1]
    assert any(line.startswith("BinMap: samples binned: ") for line in said[0])
    assert bench.planes(plain) == bench.planes(split)
    from astropy.io import fits

    tallies = []
    for out in (plain, split):
        with fits.open(out / "map.fits") as opened:
            tallies.append(
                [tuple(row) for row in opened["TALLY"].data if row["WHAT"].startswith("samples")]
            )
    assert tallies[0] == tallies[1]


def test_one_set_of_products_for_each_combination(bench):
    out = bench.run(
        "{grid: {PointingDaisy.radius: [1 arcmin, 2 arcmin]}, realizations: 2, combine:"
        " [realization]}",
        *SERIAL,
    )
    folders = sorted(p.name for p in out.iterdir() if p.is_dir())
    assert folders == ["PointingDaisy.radius=1-arcmin", "PointingDaisy.radius=2-arcmin"]
    assert bench.planes(out / folders[0]) != bench.planes(out / folders[1])


def test_several_files(bench):
    one, two = (
        bench.file("null", name="one.yaml"),
        bench.file("null", ("seed: 1", "seed: 2"), name="two.yaml"),
    )
    out = bench.new()
    assert bench.command("run", one, two, "--output", out, *SERIAL) == 0
    assert bench.planes(out / "one") != bench.planes(out / "two")


def test_time_streams_spectra_pictures_and_report(bench):
    more = "  - SaveMap\n  - SaveTOD\n  - TimeStreams\n  - Plots\n  - Report\n"
    out = bench.run("{nights: 2}", *SERIAL, changes=(("  - SaveMap\n", more),))
    files = list(out.glob("entries/*/tod_*.h5"))
    assert len(files) == 4
    numbers = []
    for path in files:
        with h5py.File(path) as f:
            session = f["instrument"].attrs
            numbers.append(
                [
                    f.attrs["observation_name"],
                    f.attrs["observation_uid"],
                    session["session_name"],
                    session["session_uid"],
                ]
            )
    assert [len(set(column)) for column in zip(*numbers, strict=True)] == [4, 4, 4, 4]
    assert {"map.png", "power_spectra.png", "tod.png", "scan.png", "report.html"} <= {
        p.name for p in out.iterdir()
    }
    report = (out / "report.html").read_text()
    assert "000001-scan-001" in report
    assert "this table and the plan are of its first entry" in report


def test_other_bands_are_not_co_added(bench, capsys):
    assert bench.run("{grid: {instrument: [gbt, atlast]}}", *SERIAL, status=2)
    assert "cannot be added up" in capsys.readouterr().err


# ---- failures


def failing(times, error="it broke", **more):
    """A stand-in for `perform` that fails so many times for task 3, or always (-1)."""
    left = [times]

    def work(order):
        if order.task.number == 3 and left[0]:
            left[0] -= 1
            return Outcome("here", 0.1, error=error, **more)
        return perform(order)

    return work


def test_a_campaign_that_cannot_begin_leaves_nothing(bench, capsys):
    """The first of two sets of products is laid out before the second is found to be impossible."""
    path = bench.file(
        "{nights: 2, grid: {target: ['az 180 deg el 60 deg', 'az 180 deg el 1 deg']}, combine:"
        " [night]}"
    )
    folder = bench.folder / "out"
    assert bench.command("run", path, "--output", folder, "--engine", "serial") == 2
    assert "elevation" in capsys.readouterr().err
    assert [p.name for p in folder.rglob("*")] in ([], [".zonda-lock"])


def test_a_failed_task_is_tried_again(undisturbed, bench, monkeypatch):
    monkeypatch.setattr(campaign, "perform", failing(2))
    out = bench.run(bench.CAMPAIGN, *SERIAL)
    row = read(out)[3]
    assert (row.state, row.attempts, row.error) == ("done", 3, "it broke")
    assert bench.planes(out) == bench.planes(undisturbed)


def test_tries_are_bounded_and_resume_goes_on(undisturbed, bench, monkeypatch, capsys):
    monkeypatch.setattr(campaign, "perform", failing(-1))
    out = bench.run(bench.CAMPAIGN, *SERIAL, status=2)
    assert "1 of 12 tasks failed; the first is 3: it broke" in capsys.readouterr().err
    assert states(out) == ["done"] * 3 + ["failed"] + ["done"] * 8
    assert read(out)[3].attempts == 3
    assert not (out / "map.fits").exists()
    assert bench.command("status", out) == 0
    shown = capsys.readouterr().out
    assert "failed   1" in shown
    assert "it broke" in shown
    monkeypatch.setattr(campaign, "perform", perform)
    before = {p.name: p.stat().st_mtime_ns for p in (out / "tasks").iterdir()}
    monkeypatch.setattr(Record, "finish", lambda *a: None)
    monkeypatch.setattr(Record, "discard_partials", lambda *a: None)
    assert bench.command("resume", out, *SERIAL) == 0
    after = {p.name: p.stat().st_mtime_ns for p in (out / "tasks").iterdir()}
    for name in before.keys() & {f"{number:06d}.npz" for number in range(12)}:
        assert after[name] == before[name]  # what was done was not done again
    assert bench.planes(out) == bench.planes(undisturbed)
    assert states(out) == ["done"] * 12


def test_what_cannot_succeed_is_not_tried_again(bench, monkeypatch):
    monkeypatch.setattr(campaign, "perform", failing(-1, final=True))
    out = bench.run(bench.CAMPAIGN, *SERIAL, status=2)
    assert read(out)[3].attempts == 1


def test_an_exception_leaves_a_campaign_that_resumes(undisturbed, bench, monkeypatch):
    def interrupted(order):
        if order.task.number == 5:
            raise KeyboardInterrupt
        return perform(order)

    monkeypatch.setattr(campaign, "perform", interrupted)
    out = bench.run(bench.CAMPAIGN, *SERIAL, status=130)
    assert states(out) == ["done"] * 5 + ["waiting"] * 7
    assert not (out / ".zonda-lock").exists()
    monkeypatch.setattr(campaign, "perform", perform)
    assert (
        bench.command("run", bench.folder / "p.yaml", "--output", out, *SERIAL) == 2
    )  # unfinished: not thrown away
    assert bench.command("resume", out, *SERIAL) == 0
    assert bench.planes(out) == bench.planes(undisturbed)


def test_a_plain_run_leaves_an_unfinished_campaign_alone(undisturbed, bench, monkeypatch, capsys):
    out = half(bench, monkeypatch)
    before = {p: p.stat().st_mtime_ns for p in out.rglob("*") if p.is_file()}
    capsys.readouterr()
    plain = bench.file("null", name="plain.yaml")
    assert bench.command("run", plain, "--output", out) == 2
    said = capsys.readouterr().err
    assert (
        f"error: {out}: holds an unfinished campaign\n  = zonda resume {out}, remove it, or choose"
        " another folder" in said
    )
    assert {p: p.stat().st_mtime_ns for p in out.rglob("*") if p.is_file()} == before
    assert bench.command("resume", out, *SERIAL) == 0
    assert bench.planes(out) == bench.planes(undisturbed)
    assert (
        bench.command("run", plain, "--output", out) == 0
    )  # a finished one's products are replaced, as another run's are
    assert bench.planes(out) != bench.planes(undisturbed)
    assert not (out / "campaign.json").exists()
    assert not (out / "tasks.npz").exists()
    capsys.readouterr()
    assert bench.command("status", out) == 2
    assert "holds no campaign" in capsys.readouterr().err


def test_a_campaign_into_the_folder_of_a_plain_run_says_so(undisturbed, bench, capsys):
    out = bench.new()
    assert bench.command("run", bench.file("null", name="plain.yaml"), "--output", out) == 0
    (out / "of-mine.txt").write_text("")
    capsys.readouterr()
    assert bench.command("run", bench.file(bench.CAMPAIGN), "--output", out, *SERIAL) == 0
    assert f"{out}: 3 files of an earlier run removed" in capsys.readouterr().err
    assert bench.planes(out) == bench.planes(undisturbed)
    assert (out / "of-mine.txt").exists()


@pytest.mark.parametrize("name", ["tasks", "entries"])
def test_a_folder_of_a_campaign_that_is_a_link_is_refused(bench, capsys, tmp_path, name):
    out, other = bench.new(), tmp_path / "of-others"
    out.mkdir()
    other.mkdir()
    (other / "000000.npz").write_text("precious")
    (out / name).symlink_to(other)
    assert bench.command("run", bench.file(bench.CAMPAIGN), "--output", out, *SERIAL) == 2
    assert f"error: {out / name}: is reached through a link" in capsys.readouterr().err
    assert [p.name for p in other.iterdir()] == ["000000.npz"]


def test_files_of_others_in_a_folder_called_tasks_stay(bench):
    out = bench.new()
    (out / "tasks").mkdir(parents=True)
    (out / "tasks" / "notes.txt").write_text("precious")
    assert bench.command("run", bench.file(bench.CAMPAIGN), "--output", out, *SERIAL) == 0
    assert [p.name for p in (out / "tasks").iterdir()] == ["notes.txt"]


@pytest.mark.nightly
def test_a_killed_worker_does_not_lose_the_campaign(undisturbed, bench, monkeypatch):
    submit, killed = experiment._submit, []

    def and_kill(pool, function, *arguments):
        future = submit(pool, function, *arguments)
        if getattr(arguments[0], "task", None) and arguments[0].task.number == 4 and not killed:
            killed.append(True)
            for process in list(pool.executor._processes.values()):
                os.kill(process.pid, signal.SIGKILL)
        return future

    monkeypatch.setattr(experiment, "_submit", and_kill)
    out = bench.run(bench.CAMPAIGN, "--engine", "processes", "--workers", 2)
    assert killed
    rows = read(out)
    assert any(row.attempts == 2 and "killed" in row.error for row in rows)
    assert bench.planes(out) == bench.planes(undisturbed)


def half(bench, monkeypatch):
    """A campaign of which tasks 0 to 4 are done."""
    monkeypatch.setattr(
        campaign,
        "perform",
        lambda order: (
            Outcome("", 0.0, error="no", final=True) if order.task.number > 4 else perform(order)
        ),
    )
    out = bench.run(bench.CAMPAIGN, *SERIAL, status=2)
    monkeypatch.setattr(campaign, "perform", perform)
    return out


def test_damaged_products_are_made_again(undisturbed, bench, monkeypatch, capsys):
    out = half(bench, monkeypatch)
    products = sorted((out / "tasks").glob("0000*.npz"))
    assert len(products) == 5
    products[0].write_bytes(products[0].read_bytes()[:-100])
    products[1].unlink()
    products[2].write_bytes(products[3].read_bytes())
    (out / "tasks" / "layout-0000.npz").write_bytes(b"")
    (out / "tasks" / ".left.part.npz").write_bytes(b"half")
    capsys.readouterr()
    assert bench.command("resume", out, *SERIAL) == 0
    assert "2 partial products damaged: run again" in capsys.readouterr().err
    assert bench.planes(out) == bench.planes(undisturbed)


def test_resume_refuses_what_has_changed(bench, monkeypatch, capsys):
    out = half(bench, monkeypatch)
    text = (bench.folder / "p.yaml").read_text()
    (bench.folder / "p.yaml").write_text(text + "\n# changed\n")
    assert bench.command("resume", out, *SERIAL) == 2
    assert "has changed or is gone" in capsys.readouterr().err
    (bench.folder / "p.yaml").write_text(text)
    (out / "resolved.yaml").write_text("seed: 3\n")
    assert bench.command("resume", out, *SERIAL) == 2
    assert "resolved.yaml has changed" in capsys.readouterr().err
    assert bench.command("resume", out, *SERIAL, "--anyway") == 0


def test_resume_of_what_is_no_campaign(bench, tmp_path, capsys):
    assert bench.command("resume", tmp_path) == 2
    assert "holds no campaign" in capsys.readouterr().err
    (tmp_path / "campaign.json").write_text('{"digest": "0"}\n{}\n')
    for name in ("resume", "status"):
        assert bench.command(name, tmp_path) == 2
        assert "checksum is wrong" in capsys.readouterr().err


def test_resume_of_a_finished_campaign_does_nothing(bench, undisturbed, monkeypatch):
    before = bench.planes(undisturbed)
    monkeypatch.setattr(campaign, "perform", None)
    monkeypatch.setattr(campaign, "combine", None)
    assert bench.command("resume", undisturbed, *SERIAL) == 0
    assert bench.planes(undisturbed) == before


def test_shares_of_an_array(undisturbed, bench, capsys):
    file, out = bench.file(bench.CAMPAIGN), bench.new()
    for k in (2, 1, 3):
        assert bench.command("run", file, "--output", out, *SERIAL, "--task", f"{k}/3") == 0
    assert not (out / "map.fits").exists()
    capsys.readouterr()
    assert bench.command("status", out, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["counts"] == {"waiting": 0, "claimed": 0, "done": 12, "failed": 0}
    assert {t["entry"] for t in found["tasks"]} >= {"night=2, realization=1"}
    assert bench.command("resume", out, *SERIAL) == 0
    assert bench.planes(out) == bench.planes(undisturbed)
    assert (
        bench.command("run", bench.file("{nights: 2}"), "--output", out, *SERIAL, "--task", "1/3")
        == 2
    )
    assert "holds another campaign" in capsys.readouterr().err


def test_an_operator_that_cannot_be_combined_is_named(bench, monkeypatch, capsys):
    from zonda.operators.diagnostics.power_spectrum import PowerSpectrum

    monkeypatch.setattr(
        PowerSpectrum,
        "collect",
        lambda self, data, observation, state: data.products.update(spectrum=state),
    )
    out = bench.run(bench.CAMPAIGN, *SERIAL, "--no-prune", status=2)
    assert "'spectrum' cannot be combined" in capsys.readouterr().err
    assert states(out).count("failed") == 1  # the others would fail alike: they are not tried


def test_every_transition_is_in_the_files(bench, monkeypatch):
    """Tasks 0 to 4 are done, the rest has failed."""
    out = half(bench, monkeypatch)
    job = Job.read(out)
    record, other = Record(job, out), Record(job, out)
    assert record.done == {}  # nothing is combined
    task = job.tasks[5]
    record.put_off([task])
    assert next(r for r in other.rows() if r.number == 5).state == "waiting"
    record.claim([5])
    assert [(r.state, r.attempts) for r in other.rows()][5] == ("claimed", 1)
    record.failed(task, "h", 1.0, "no", again=True)
    record.put_off()
    assert [(r.state, r.attempts, r.error) for r in other.rows()][5] == ("waiting", 1, "no")
    record.claim([5])
    record.failed(task, "h", 1.0, "never", again=False)
    record.put_off()
    assert [(r.state, r.attempts, r.error) for r in other.rows()][5] == ("failed", 2, "never")
    record.claim([5])
    record.succeeded(task, "h", 2.0, "{}")
    assert [(r.state, r.attempts, r.error) for r in record.rows()][5] == ("done", 3, "never")
    assert isinstance(SerialExecutor().submit(len, "ab").result(), int)


def test_a_combination_is_finished_if_its_record_lists_its_tasks(bench, undisturbed):
    """A record of other tasks, as of another campaign, counts as none."""
    job = Job.read(undisturbed)
    record = Record(job, undisturbed)
    assert record.combined.keys() == {0}
    assert record.done.keys() == set(range(12))
    shorter = replace(job, tasks=job.tasks[:-1])
    assert Record(shorter, undisturbed).combined == {}
