from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

from zonda.core.storage import user_cache


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("ZONDA_CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_there_and_back(place):
    key, value = {"a": [1, 0.1], "b": "x"}, {"rows": [["a", 1e-300, None, True]]}
    assert user_cache.recall("kind", key) is None
    user_cache.remember("kind", key, value)
    assert user_cache.recall("kind", key) == value
    assert user_cache.recall("other", key) is None
    assert user_cache.recall("kind", {**key, "b": "y"}) is None
    assert [p.name[:5] for p in place.iterdir()] == ["kind-"]


@pytest.mark.parametrize(
    "content", ["", "{", "[]", "null", '{"key": "another", "value": 1}', "\x00"]
)
def test_a_damaged_file_is_none(place, content):
    user_cache.remember("kind", "key", 1)
    next(place.iterdir()).write_text(content)
    assert user_cache.recall("kind", "key") is None
    user_cache.remember("kind", "key", 2)
    assert user_cache.recall("kind", "key") == 2


def test_a_changed_value_is_none(place):
    user_cache.remember("kind", "key", 0.25)
    path = next(place.iterdir())
    path.write_text(path.read_text().replace("0.25", "0.75"))
    assert user_cache.recall("kind", "key") is None


@pytest.mark.parametrize("value", [(1, 2), {1: 2}, float("nan"), object(), {1, 2}])
def test_what_json_would_change_is_not_kept(place, value):
    user_cache.remember("kind", "key", value)
    assert user_cache.recall("kind", "key") is None
    assert not place.exists() or list(place.iterdir()) == []


def test_nowhere_to_write(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("ZONDA_CACHE_DIR", str(tmp_path / "file" / "below"))
    user_cache.remember("kind", "key", 1)
    assert user_cache.recall("kind", "key") is None


def test_the_oldest_go(place, monkeypatch):
    monkeypatch.setattr(user_cache, "MOST", 3)
    for number in range(6):
        user_cache.remember("kind", number, number)
        newest = max(place.iterdir(), key=lambda p: p.stat().st_mtime_ns)
        os.utime(newest, (number, number))
    found = [json.loads(p.read_text())["value"] for p in place.iterdir()]
    assert len(found) == 3
    assert 5 in found


def test_where(monkeypatch, tmp_path):
    monkeypatch.setenv("ZONDA_CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path))
    expected = {
        "win32": tmp_path / "zonda" / "cache",
        "darwin": Path.home() / "Library/Caches/zonda",
    }
    assert user_cache.folder() == expected.get(sys.platform, tmp_path / "zonda")
