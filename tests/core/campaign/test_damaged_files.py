"""A campaign's files that are damaged anyhow: the resumed campaign is right, and does again what was
damaged.
"""

from __future__ import annotations

import os
import random
import shutil

import pytest

from zonda.core.campaign import tasks as campaign
from zonda.core.campaign.tasks import Outcome, perform

SERIAL = ("--engine", "serial", "--threads", 1)
SETS = (
    "{grid: {PointingDaisy.radius: [1 arcmin, 2 arcmin]}, nights: 2, combine: [night], retries: 0}"
)
FOLDERS = ("PointingDaisy.radius=1-arcmin", "PointingDaisy.radius=2-arcmin")
ROUNDS = int(os.environ.get("ZONDA_DAMAGE_ROUNDS", "24"))
"""Files that are damaged; a thousand take some minutes."""


@pytest.fixture(scope="module")
def template(tmp_path_factory, module_bench):
    """A campaign of 8 tasks: the first four are done and combined, of the others two are done. And
    its maps when all are.
    """
    bench = module_bench
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            campaign,
            "perform",
            lambda order: (
                perform(order)
                if order.task.number < 6
                else Outcome("", 0.0, error="no", final=True)
            ),
        )
        half = bench.run(SETS, *SERIAL, status=2)
    assert (half / FOLDERS[0] / "map.fits").exists()
    whole = tmp_path_factory.mktemp("whole") / "out"
    shutil.copytree(half, whole)
    assert bench.command("resume", whole, *SERIAL) == 0
    return half, [bench.planes(whole / f) for f in FOLDERS]


def damage(content: bytes, chance: random.Random) -> bytes:
    spoilt = bytearray(content)
    how = chance.randrange(5)
    if how == 0:
        return bytes(spoilt[: chance.randrange(len(spoilt))])
    if how == 1:
        begin = chance.randrange(len(spoilt))
        length = chance.randrange(1, 2000)
        spoilt[begin : begin + length] = chance.randbytes(min(length, len(spoilt) - begin))
        return bytes(spoilt)
    used = (
        [k for k, byte in enumerate(spoilt) if byte] if how < 4 else range(min(100, len(spoilt)))
    )  # the last: in the header
    for _ in range(chance.choice([1, 1, 3, 30])):
        spoilt[chance.choice(used)] ^= 1 << chance.randrange(8)
    return bytes(spoilt)


def test_files_damaged_at_random(module_bench, template, tmp_path, monkeypatch, capsys):
    bench, (half, expected) = module_bench, template
    done: list[int] = []
    monkeypatch.setattr(
        campaign, "perform", lambda order: done.append(order.task.number) or perform(order)
    )
    record = f"../{FOLDERS[0]}/tasks.npz"
    names = [record, *sorted(p.name for p in (half / "tasks").iterdir())]
    assert {"000004.npz", "000006.failed", "layout-0001.npz"} <= set(names)
    hurt = dict.fromkeys(names, 0)
    for number in range(ROUNDS):
        chance = random.Random(number)
        out, name = tmp_path / "out", names[number % len(names)]
        shutil.copytree(half, out)
        path = out / "tasks" / name
        path.write_bytes(damage(path.read_bytes(), chance))
        done.clear()
        assert bench.command("status", out) == 0, number
        capsys.readouterr()
        assert bench.command("resume", out, *SERIAL) == 0, (number, capsys.readouterr().err)
        said = capsys.readouterr().err
        assert {6, 7} <= set(done), number
        assert sorted(set(done)) == sorted(done), number
        again = set(done) - {6, 7}
        if name == record:  # its parts are gone
            assert again in (set(), {0, 1, 2, 3}), number
        elif name in ("000004.npz", "000005.npz"):
            assert again <= {int(name[:6])}, number
            assert ("1 partial product damaged: run again" in said) == bool(again), (number, said)
        else:
            assert not again, number
        hurt[name] += bool(again)
        assert [bench.planes(out / f) for f in FOLDERS] == expected, number
        shutil.rmtree(out)
    assert hurt[record] > 0
    assert hurt["000004.npz"] + hurt["000005.npz"] > 0


def test_a_campaign_file_damaged_at_random(module_bench, template, tmp_path, capsys):
    """Its checksum says so; nothing is touched."""
    bench, (half, _) = module_bench, template
    content = (half / "campaign.json").read_bytes()
    out = tmp_path / "out"
    shutil.copytree(half, out)
    for number in range(24):
        (out / "campaign.json").write_bytes(damage(content, random.Random(number)))
        before = {p: p.stat().st_mtime_ns for p in out.rglob("*") if p.is_file()}
        for name in ("status", "resume"):
            assert bench.command(name, out) == 2, number
            said = capsys.readouterr().err
            assert "cannot be used" in said, (number, said)
            assert "Traceback" not in said
        assert {p: p.stat().st_mtime_ns for p in out.rglob("*") if p.is_file()} == before
