"""The process that looks at an HDF5 file first: whatever it ends with but 0 is a failure."""

import sys

import pytest

from zonda.core.errors import InputError
from zonda.core.storage import hdf5_files


@pytest.mark.parametrize("status", [1, 2, 120])
def test_a_first_look_that_fails_is_told(tmp_path, monkeypatch, status):
    (tmp_path / "x.h5").write_bytes(b"")
    program = tmp_path / "python"
    program.write_text(
        f"#!/bin/sh\necho 'Traceback' >&2\necho 'ImportError: no h5py' >&2\nexit {status}\n"
    )
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    with pytest.raises(InputError) as caught:
        hdf5_files.survey(tmp_path / "x.h5", "file x.h5", "copy it again")
    assert f"status {status}" in str(caught.value)
    assert "ImportError: no h5py" in str(caught.value)
    assert "copy it again" in str(caught.value)


def test_a_library_that_ends_the_process_is_a_failure(tmp_path, monkeypatch):
    """As libhdf5 or an import may do, in a true child."""
    (tmp_path / "h5py.py").write_text("import sys\nsys.exit(1)\n")
    (tmp_path / "x.h5").write_bytes(b"")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(InputError, match="ended with status 1"):
        hdf5_files.survey(tmp_path / "x.h5", "file x.h5", "copy it again")


def test_what_python_says_of_a_file_is_left_to_its_reader(tmp_path):
    (tmp_path / "x.h5").write_bytes(b"no HDF5")
    hdf5_files.survey(tmp_path / "x.h5", "file x.h5", "copy it again")
