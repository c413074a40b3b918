"""The second run in a folder removes what the first one wrote and it does not make, and nothing
else.
"""

from __future__ import annotations

import json
import os
import warnings
from pathlib import Path

import pytest

from zonda.core.errors import OutputError
from zonda.core.storage import output_folder
from zonda.core.storage.files import write_text


def run(folder: Path, *names: str, inputs: tuple[Path, ...] = ()) -> str:
    """Write files as a run does; the warning that it gives."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        with output_folder.recording(folder, anew=True, inputs=inputs):
            for name in names:
                write_text(folder / name, f"{name} of {names}")
    return "".join(str(w.message) for w in told)


def names(folder: Path) -> set[str]:
    return {
        p.relative_to(folder).as_posix()
        for p in folder.rglob("*")
        if p.is_file() and p.name != output_folder.RECORD
    }


def test_what_the_second_run_does_not_make_is_removed(tmp_path):
    (tmp_path / "mine.txt").write_text("precious")
    assert run(tmp_path, "map.fits", "sub/tod.h5", "resolved.yaml") == ""
    assert "removed sub/tod.h5: of an earlier run" in run(tmp_path, "map.fits", "resolved.yaml")
    assert names(tmp_path) == {"map.fits", "resolved.yaml", "mine.txt"}
    assert not (tmp_path / "sub").exists()


def test_a_run_that_writes_nothing_removes_nothing(tmp_path):
    run(tmp_path, "map.fits")
    assert run(tmp_path) == ""
    assert names(tmp_path) == {"map.fits"}
    run(tmp_path, "other.fits")
    assert names(tmp_path) == {"other.fits"}


@pytest.mark.parametrize("how", ["longer", "same size", "link", "folder"])
def test_a_file_that_was_changed_is_refused(tmp_path, how):
    run(tmp_path, "map.fits", "other.fits")
    path = tmp_path / "map.fits"
    content = path.read_text()
    path.unlink()
    if how == "folder":
        path.mkdir()
    elif how == "link":
        (tmp_path / "victim").write_text(content)
        path.symlink_to("victim")
    else:
        path.write_text(content + "more" if how == "longer" else content.swapcase())
    before = names(tmp_path)
    with pytest.raises(OutputError, match="was changed") as caught:
        run(tmp_path, "new.fits")
    assert caught.value.place == str(path)
    assert "move or remove it" in caught.value.cure
    assert names(tmp_path) == before


@pytest.mark.parametrize("how", ["file", "link"])
def test_a_file_that_is_changed_while_the_run_is_at_work_stays(tmp_path, how):
    """Minutes lie between the look at the folder and the first product."""
    run(tmp_path, "map.fits", "sub/other.fits")
    (tmp_path / "elsewhere").mkdir()

    def work() -> None:
        with output_folder.recording(tmp_path, anew=True):
            if how == "file":
                (tmp_path / "map.fits").write_text("precious, and of the user")
            else:
                (tmp_path / "sub").rename(tmp_path / "elsewhere" / "sub")
                (tmp_path / "sub").symlink_to("elsewhere/sub")
            write_text(tmp_path / "new.fits", "")

    gone = "sub/other.fits" if how == "file" else "map.fits"
    with pytest.warns(UserWarning, match=f"removed {gone}: of an earlier run"):
        work()
    kept = {"map.fits"} if how == "file" else {"elsewhere/sub/other.fits"}
    assert names(tmp_path) - {"sub/other.fits"} == {"new.fits", *kept}


def test_files_that_the_run_reads_stay(tmp_path):
    run(tmp_path, "tod.h5", "map.fits")
    run(tmp_path, "new.fits", inputs=(tmp_path / "tod.h5",))
    assert names(tmp_path) == {"tod.h5", "new.fits"}
    run(tmp_path, "newest.fits")  # nor does a later one take it for a product
    assert names(tmp_path) == {"tod.h5", "newest.fits"}


def test_a_run_that_was_killed_leaves_files_that_the_next_one_knows(tmp_path, monkeypatch):
    run(tmp_path, "map.fits", "noiseless_map.fits")
    replace = os.replace

    class Killed(BaseException):
        pass

    def kill(source, target):
        if Path(target).name == "noise_map.fits":
            raise Killed
        replace(source, target)

    monkeypatch.setattr(os, "replace", kill)
    with pytest.raises(Killed):
        run(tmp_path, "map.fits", "noise_map.fits")
    assert names(tmp_path) == {"map.fits"}  # of the second run alone
    monkeypatch.undo()
    run(tmp_path, "other.fits")
    assert names(tmp_path) == {"other.fits"}


@pytest.mark.parametrize(
    "name",
    ["../victim", "{}/victim", "sub/../../victim", ".", "", "link/victim", "a\0b", "\ud800", 5],
)
def test_a_record_that_was_made_up_reaches_nothing_outside(tmp_path, name):
    out, victim = tmp_path / "out", tmp_path / "victim"
    out.mkdir()
    victim.write_text("precious")
    (out / "link").symlink_to(tmp_path)
    about = victim.stat()
    if isinstance(name, str):
        name = name.replace("{}", str(tmp_path))
    lines = [
        json.dumps([name, about.st_size, about.st_mtime_ns]),
        "[",
        "{}",
        '["a"]',
        "[" * 9999,
        '["a", Infinity, 1]',
    ]
    (out / output_folder.RECORD).write_text("\n".join(lines))
    run(out, "map.fits")
    assert victim.read_text() == "precious"


def test_a_record_that_is_a_link_is_refused(tmp_path):
    (tmp_path / "victim").write_text("precious")
    (tmp_path / output_folder.RECORD).symlink_to("victim")
    with pytest.raises(OutputError, match="is no regular file"):
        run(tmp_path, "map.fits")
    assert names(tmp_path) == {"victim"}


def test_files_outside_the_folder_are_not_recorded(tmp_path):
    out = tmp_path / "out"
    with output_folder.recording(out, anew=True), output_folder.recording(out, anew=True):
        write_text(tmp_path / "beside.txt", "")
        write_text(out / "map.fits", "")
    assert (out / output_folder.RECORD).read_text().count("\n") == 1
