"""The user's cache folder."""

from __future__ import annotations

import sys
from pathlib import Path

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
