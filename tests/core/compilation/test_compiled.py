from __future__ import annotations

import os
from pathlib import Path

import pytest

from zonda.core.compilation import compiled


@pytest.fixture
def unset(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")  # restored after the test, whatever it sets
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home" / "cache"))


def test_a_folder_that_lasts_is_preferred(
    unset: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(
        compiled, "_writable", lambda folder: folder == tmp_path / "home" / "cache" / "numba"
    )
    compiled.ensure_cache()
    assert os.environ["NUMBA_CACHE_DIR"] == ""


def test_nowhere_to_keep_it(unset: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "_writable", lambda folder: False)
    with pytest.warns(UserWarning, match="set NUMBA_CACHE_DIR"):
        compiled.ensure_cache()
    assert Path(os.environ["NUMBA_CACHE_DIR"]).is_dir()


def test_a_users_choice_stays(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(compiled, "_writable", lambda folder: False)
    compiled.ensure_cache()
    assert os.environ["NUMBA_CACHE_DIR"] == str(tmp_path)


def test_writable(tmp_path: Path) -> None:
    assert compiled._writable(tmp_path / "not" / "there" / "yet")
    (tmp_path / "file").touch()
    assert not compiled._writable(tmp_path / "file" / "below")


def test_blas_takes_one_thread_unless_told_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "3")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    compiled.one_blas_thread()
    assert os.environ["OPENBLAS_NUM_THREADS"] == "3"
    assert os.environ["MKL_NUM_THREADS"] == os.environ["OMP_NUM_THREADS"] == "1"
    monkeypatch.setenv("MKL_NUM_THREADS", "")  # so that they are gone after the test
    monkeypatch.setenv("OMP_NUM_THREADS", "")
    monkeypatch.delenv("MKL_NUM_THREADS")
    monkeypatch.delenv("OMP_NUM_THREADS")
