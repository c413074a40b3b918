"""Files of partial products: whole or refused."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest

from zonda.core.campaign import trees
from zonda.core.errors import InputError

TREE = {
    "a": {"b": np.arange(5), "names": ["x", "y"]},
    "c": [1, 2.5, None, True, "é"],
    "d": np.zeros((2, 0), np.float32),
}


def test_what_is_written_is_read(tmp_path):
    trees.write(tmp_path / "p.npz", "me", TREE, {"host": "here"})
    found = trees.read(tmp_path / "p.npz", "me")
    assert found["c"] == TREE["c"]
    assert np.array_equal(found["a"]["b"], np.arange(5))
    assert found["d"].shape == (2, 0)
    assert found["d"].dtype == np.float32
    assert trees.head(tmp_path / "p.npz", "me") == {"host": "here"}


def test_the_same_product_is_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        trees.write(tmp_path / name, "me", TREE)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert trees.digest_of(tmp_path / "a") == trees.digest_of(tmp_path / "b") != ""
    assert trees.digest_of(tmp_path / "c") == ""


def test_every_damage_is_noticed(tmp_path):
    path = tmp_path / "p.npz"
    trees.write(path, "me", TREE)
    whole = path.read_bytes()
    for at in range(0, len(whole), 7):
        damaged = bytearray(whole)
        damaged[at] ^= 0x55
        path.write_bytes(damaged)
        with contextlib.suppress(
            InputError
        ):  # bits of the archive's own bookkeeping that nobody reads may change
            found = trees.read(path, "me")
            assert np.array_equal(found["a"]["b"], np.arange(5))
            assert found["c"] == TREE["c"]
    for length in range(0, len(whole), 11):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError):
            trees.read(path, "me")


def test_the_product_of_another_task_is_refused(tmp_path):
    trees.write(tmp_path / "p.npz", "me", TREE)
    with pytest.raises(InputError, match="another task"):
        trees.read(tmp_path / "p.npz", "you")
    with pytest.raises(InputError, match="another task"):
        trees.head(tmp_path / "p.npz", "you")


def test_objects_are_neither_written_nor_read(tmp_path):
    for value in ({"x": object()}, {"x": np.array([{}])}, {(1, 2): "x"}):
        with pytest.raises((TypeError, ValueError)):
            trees.write(tmp_path / "p.npz", "me", value)
    assert list(tmp_path.iterdir()) == []
