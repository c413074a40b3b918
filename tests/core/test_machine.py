"""The user's cache folder, and what identifies a processor."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from zonda.core import machine


def test_where(monkeypatch, tmp_path):
    monkeypatch.setenv("ZONDA_CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path))
    expected = {
        "win32": tmp_path / "zonda" / "cache",
        "darwin": Path.home() / "Library/Caches/zonda",
    }
    assert machine.cache_folder() == expected.get(sys.platform, tmp_path / "zonda")


@pytest.mark.parametrize(
    "name",
    ["NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES", "NPY_DISABLE_CPU_FEATURES", "OPENBLAS_CORETYPE"],
)
def test_what_is_remembered_of_a_processor_knows_its_restraints(monkeypatch, name):
    monkeypatch.delenv(name, raising=False)
    machine.processor.cache_clear()
    assert f" {name}=" not in machine.processor()
    monkeypatch.setenv(name, "less")
    machine.processor.cache_clear()
    try:
        assert f" {name}=less" in machine.processor()
    finally:
        machine.processor.cache_clear()
