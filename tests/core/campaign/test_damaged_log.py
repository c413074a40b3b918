"""A job log that is damaged anyhow: what is resumed is right, and no finished task is done again
without a word.
"""

from __future__ import annotations

import os
import random
import shutil
import sqlite3
from pathlib import Path

import pytest

from zonda.core.campaign import work as campaign
from zonda.core.campaign.log import Log
from zonda.core.campaign.task import Outcome, perform
from zonda.core.errors import InputError

SERIAL = ("--engine", "serial", "--threads", 1)
SETS = (
    "{grid: {PointingDaisy.radius: [1 arcmin, 2 arcmin]}, nights: 2, combine: [night], retries: 0}"
)
FOLDERS = ("PointingDaisy.radius=1-arcmin", "PointingDaisy.radius=2-arcmin")
ROUNDS = int(os.environ.get("ZONDA_DAMAGE_ROUNDS", "24"))
"""Logs that are damaged; a thousand take some minutes."""


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


def hot_journal(path: Path) -> None:
    """Leave the log as a process that is killed amid a transaction leaves it: half of it written,
    the rest in the journal.
    """
    database = sqlite3.connect(path, isolation_level=None)
    database.execute("PRAGMA cache_size = 1")
    database.execute("PRAGMA cache_spill = 1")
    database.execute("BEGIN IMMEDIATE")
    database.execute("UPDATE tasks SET state = 'claimed', digest = '', error = hex(zeroblob(4000))")
    database.execute("DELETE FROM combined")
    journal = path.with_name(f"{path.name}-journal")
    copies = {p: p.read_bytes() for p in (path, journal)}
    database.execute("ROLLBACK")
    database.close()
    for p, content in copies.items():
        p.write_bytes(content)


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
        [k for k, byte in enumerate(spoilt) if byte] if how < 4 else range(100)
    )  # the last: in the header
    for _ in range(chance.choice([1, 1, 3, 30])):
        spoilt[chance.choice(used)] ^= 1 << chance.randrange(8)
    return bytes(spoilt)


def test_a_log_damaged_at_random(module_bench, template, tmp_path, monkeypatch, capsys):
    bench, (half, expected) = module_bench, template
    done: list[int] = []
    monkeypatch.setattr(
        campaign, "perform", lambda order: done.append(order.task.number) or perform(order)
    )
    aside = again = 0
    for number in [*range(ROUNDS), 77]:  # the last: an error whose own text cannot be read
        chance = random.Random(number)
        out = tmp_path / "out"
        shutil.copytree(half, out)
        path = out / "jobs.sqlite"
        if number % 4 == 3:
            hot_journal(path)
            if chance.random() < 0.7:
                path = path.with_name("jobs.sqlite-journal")
        path.write_bytes(damage(path.read_bytes(), chance))
        done.clear()
        capsys.readouterr()
        assert bench.command("status", out) in (0, 2), number
        said = capsys.readouterr().err
        assert not said or "is damaged" in said, (number, said)
        assert bench.command("resume", out, *SERIAL) == 0, (number, capsys.readouterr().err)
        said = capsys.readouterr().err
        assert {6, 7} <= set(done), number
        assert sorted(set(done)) == sorted(done), number
        if set(done) & {0, 1, 2, 3}:  # these are combined, and nothing but the log says so
            assert "the job log was damaged: it is kept as jobs.damaged-1.sqlite" in said, (
                number,
                said,
            )
            aside += 1
        if set(done) & {4, 5}:
            assert "partial products were missing or damaged" in said, (number, said)
            again += 1
        assert [bench.planes(out / f) for f in FOLDERS] == expected, number
        shutil.rmtree(out)
    assert 0 < aside < ROUNDS
    assert again < ROUNDS / 4


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


def test_a_log_cannot_claim_what_another_combination_is(tmp_path):
    """One changed number must not make a combination count as written that is not."""
    log = Log(tmp_path / "jobs.sqlite")
    log.combine(0, "a" * 32)
    assert log.combined({0: "a" * 32, 1: "b" * 32}) == {0}
    log._db.execute("UPDATE combined SET number = 1")
    with pytest.raises(InputError, match="is damaged"):
        log.combined({0: "a" * 32, 1: "b" * 32})
    log.close()
