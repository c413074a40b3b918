"""What a killed worker leaves."""

from zonda.core.campaign.folder import clean
from zonda.core.storage.files import temporary_sibling


def test_half_written_files_go_wherever_they_are(tmp_path):
    for where in ("", "tasks", "entries/000001", "site=atacama"):
        folder = tmp_path / where
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "map.fits").write_text("whole")
        (folder / ".mine.part").write_text("of somebody else")
        temporary_sibling(folder / "map.fits").write_text("half")
        temporary_sibling(folder / "tod").mkdir()
    clean(tmp_path)
    assert sorted({p.name for p in tmp_path.rglob("*") if p.is_file()}) == [".mine.part", "map.fits"]
    assert not [p for p in tmp_path.rglob("*.part*") if p.is_dir()]


def test_a_campaign_that_ends_well_leaves_none(bench, monkeypatch):
    from zonda.core.campaign.work import Tasks

    def leaves(folder):
        (folder / "entries/000000").mkdir(parents=True, exist_ok=True)
        temporary_sibling(folder / "entries/000000/tod.h5").write_text("half")

    usual = Tasks.run
    monkeypatch.setattr(Tasks, "run", lambda self, tasks: (leaves(self.folder), usual(self, tasks))[1])
    out = bench.run("{nights: 1}", "--engine", "serial", "--threads", 1)
    assert not list(out.rglob("*.part*"))
