"""What a killed worker leaves."""

import shutil
from types import SimpleNamespace

import pytest

from zonda.core.campaign.campaign_file import FILE, digest_of_text
from zonda.core.campaign.folder import clean
from zonda.core.storage import files
from zonda.core.storage.files import temporary_sibling

JOB = SimpleNamespace(combinations=[SimpleNamespace(folder="site=atacama")], entries=[None, None])


def test_half_written_files_go_from_folders_of_the_campaign(tmp_path):
    for where in ("", "tasks", "entries/000001", "site=atacama", "of another run"):
        folder = tmp_path / where
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "map.fits").write_text("whole")
        (folder / ".mine.part").write_text("of somebody else")
        temporary_sibling(folder / "map.fits").write_text("half")
        temporary_sibling(folder / "tod").mkdir()
    clean(tmp_path, JOB)
    assert len(list((tmp_path / "of another run").iterdir())) == 4  # it may be at work
    shutil.rmtree(tmp_path / "of another run")
    assert sorted({p.name for p in tmp_path.rglob("*") if p.is_file()}) == [
        ".mine.part",
        "map.fits",
    ]
    assert not [p for p in tmp_path.rglob("*.part*") if p.is_dir()]


def test_a_campaign_that_ends_well_leaves_none(bench, monkeypatch):
    from zonda.core.campaign.tasks import Tasks

    def leaves(folder):
        (folder / "entries/000000").mkdir(parents=True, exist_ok=True)
        temporary_sibling(folder / "entries/000000/tod.h5").write_text("half")

    usual = Tasks.run
    monkeypatch.setattr(
        Tasks, "run", lambda self, tasks: (leaves(self.folder), usual(self, tasks))[1]
    )
    out = bench.run("{nights: 1}", "--engine", "serial", "--threads", 1)
    assert not list(out.rglob("*.part*"))


@pytest.mark.parametrize("command", ["resume", "status", "run"])
def test_the_folder_of_an_older_version_is_refused(bench, undisturbed, capsys, command):
    _, _, text = (undisturbed / FILE).read_text().rstrip().partition("\n")
    text = text.replace('"format":4', '"format":3', 1)
    out = bench.new()
    out.mkdir()
    (out / FILE).write_text(f'{{"digest": "{digest_of_text(text)}"}}\n{text}\n')
    arguments = [bench.file(bench.CAMPAIGN), "--output", out] if command == "run" else [out]
    assert bench.command(command, *arguments) == 2
    assert f"error: {out}: holds a campaign of zonda" in (said := capsys.readouterr().err)
    assert "choose another output folder" in said
    assert [p.name for p in out.iterdir() if not p.name.startswith(".")] == [FILE]


def test_the_file_that_proves_a_folder_writable_is_removed_after_a_kill(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "discard", lambda path: None)  # SIGKILL: it never comes to that
    files.check_output_folder(tmp_path / "entries")
    assert len(list((tmp_path / "entries").iterdir())) == 1
    clean(tmp_path, JOB)
    assert list((tmp_path / "entries").iterdir()) == []
