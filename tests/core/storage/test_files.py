"""A product is there whole or not at all, and the message says what to do."""

from __future__ import annotations

import contextlib
import errno
import os

import pytest

from zonda.core.errors import InputError, OutputError
from zonda.core.storage import fits_files, hdf5_files, table_files
from zonda.core.storage.files import (
    atomic_path,
    check_output_folder,
    output_error,
    product_path,
    write_text,
)


def fits_opened(path):
    return fits_files.opened(path, "here", "mend it")


def hdf5_opened(path):
    return hdf5_files.opened(path, "here", "HDF5", "mend it")


def reading_a_table(path):
    return contextlib.nullcontext(table_files.read_table(path, "here"))


def left(folder):
    return sorted(p.name for p in folder.iterdir())


def test_success_leaves_only_the_product(tmp_path):
    target = tmp_path / "new" / "folder" / "map.fits"
    with atomic_path(target) as temporary:
        assert temporary.parent == target.parent
        assert temporary.suffix == ".fits"
        temporary.write_bytes(b"whole")
        assert not target.exists()
    assert target.read_bytes() == b"whole"
    assert left(target.parent) == ["map.fits"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit, MemoryError])
def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path, error):
    target = tmp_path / "map.fits"
    target.write_bytes(b"old")
    with pytest.raises(error), atomic_path(target) as temporary:  # noqa: PT012
        temporary.write_bytes(b"half")
        raise error
    assert target.read_bytes() == b"old"
    assert left(tmp_path) == ["map.fits"]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full on this system")
def test_a_really_full_disk(tmp_path):
    with (  # noqa: PT012
        pytest.raises(OutputError, match="no space left on the disk") as caught,
        atomic_path(tmp_path / "a.bin") as temporary,
    ):
        temporary.symlink_to("/dev/full")  # every write to it fails with ENOSPC
        temporary.write_bytes(b"x" * 10)
    assert caught.value.place == str(tmp_path / "a.bin")
    assert "free some space" in caught.value.cure
    assert left(tmp_path) == []


def test_a_disk_that_is_full_only_when_the_file_is_synchronized(tmp_path, monkeypatch):
    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputError, match="no space left"):
        write_text(tmp_path / "a.txt", "text")
    assert left(tmp_path) == []


def test_hdf5_reports_a_full_disk_without_an_error_number(tmp_path):
    error = OSError(
        "Can't write data (file write failed: time = now, errno = 28, error message = 'No space"
        " left on device')"
    )
    assert "no space left on the disk" in str(output_error(error, tmp_path / "tod.h5"))


def test_a_folder_in_the_way(tmp_path):
    (tmp_path / "map.fits").mkdir()
    with pytest.raises(OutputError, match="there is a folder of that name"):
        write_text(tmp_path / "map.fits", "text")
    assert left(tmp_path) == ["map.fits"]


def test_a_file_in_place_of_the_folder(tmp_path):
    (tmp_path / "out").write_text("a file")
    for folder in (tmp_path / "out", tmp_path / "out" / "deeper"):
        with pytest.raises(OutputError, match="file") as caught:
            check_output_folder(folder)
        assert str(folder) in str(caught.value)
        assert "choose another output folder" in caught.value.cure


def test_check_output_folder_creates_and_leaves_no_probe(tmp_path):
    assert check_output_folder(tmp_path / "a" / "b") == tmp_path / "a" / "b"
    assert left(tmp_path / "a" / "b") == []


def test_a_folder_that_may_not_be_written(tmp_path):
    if os.geteuid() == 0:  # root may write anywhere: ask as nobody, in a child process
        os.chmod(tmp_path, 0o755)
        child = os.fork()
        if child == 0:
            status = 1
            try:
                os.setuid(65534)
                check_output_folder(tmp_path / "out")
            except OutputError as error:
                status = 0 if "permission denied" in str(error) else 2
            finally:
                os._exit(status)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    else:
        os.chmod(tmp_path, 0o555)
        with pytest.raises(OutputError, match="permission denied"):
            check_output_folder(tmp_path / "out")
    assert left(tmp_path) == []


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("map", "map.fits"),
        ("noiseless/map", "noiseless_map.fits"),
        ("../../etc/passwd", "etc_passwd.fits"),
        ("/abs/olute", "abs_olute.fits"),
        ("..\\win", "win.fits"),
        ("a b\n<c>", "a-b-c.fits"),
        (".hidden", "hidden.fits"),
    ],
)
def test_product_names_never_leave_the_folder(tmp_path, name, file):
    path = product_path(tmp_path, name, ".fits")
    assert path == tmp_path / file
    assert path.resolve().parent == tmp_path.resolve()


@pytest.mark.parametrize("name", ["", "..", "/", "../.."])
def test_a_name_without_letters_is_refused(tmp_path, name):
    with pytest.raises(OutputError, match="cannot name a file"):
        product_path(tmp_path, name)


@pytest.mark.parametrize("opened", [fits_opened, hdf5_opened, reading_a_table])
def test_pipes_and_devices_are_not_waited_for(tmp_path, opened):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="a pipe or a device") as told:
        opened(tmp_path / "pipe").__enter__()
    assert told.value.place == "here"
