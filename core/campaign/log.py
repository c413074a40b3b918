"""The job log: an SQLite file that the main process alone writes, and anybody may read.

No write-ahead log, which shared file systems do not bear: the ordinary rollback journal.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..storage.files import output_error, writing

DAMAGE = (sqlite3.Error, UnicodeDecodeError)
"""What reading a damaged file may raise; the second from the text of the first."""

STATES = ("waiting", "claimed", "done", "failed")

TABLES = (
    (
        "tasks (number INTEGER PRIMARY KEY, state TEXT NOT NULL, attempts INTEGER NOT NULL, error"
        " TEXT NOT NULL, host TEXT NOT NULL, seconds REAL NOT NULL, digest TEXT NOT NULL, machine"
        " INTEGER NOT NULL)"
    ),
    "combined (number INTEGER PRIMARY KEY, layout TEXT NOT NULL)",
    "machines (id INTEGER PRIMARY KEY, text TEXT NOT NULL UNIQUE)",
)


@dataclass(frozen=True)
class TaskRow:
    """What is known of a task.

    Attributes
    ----------
    attempts
        How often it was begun since it was last put off.
    error
        Of the last attempt that failed, also where a later one was done.
    machine
        On what it was done (`machines.here`); empty: unknown.
    """

    number: int
    state: str
    attempts: int
    error: str
    host: str
    seconds: float
    digest: str
    machine: str


WAITING = TaskRow(-1, "waiting", 0, "", "", 0.0, "", "")
"""Of a task that no log knows."""


class Log:
    """An open job log. Raises `OutputError` where it cannot be written, `InputError` where it is
    damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with self._errors():
            self._db = sqlite3.connect(path, isolation_level=None, timeout=30)
            self._db.execute("PRAGMA journal_mode = DELETE")
            for table in TABLES:
                self._db.execute(f"CREATE TABLE IF NOT EXISTS {table}")

    def check(self) -> None:
        """Read the whole file; raise `InputError` where it is damaged."""
        with self._errors():
            found = [str(row[0]) for row in self._db.execute("PRAGMA integrity_check")]
            if found != ["ok"]:
                raise sqlite3.DatabaseError(found[0])

    def combined(self, layouts: Mapping[int, str]) -> set[int]:
        """Combinations whose products are written. ``layouts``: by number, their layouts' digests,
        which the log must know.
        """
        with self._errors():
            found: dict[int, str] = dict(self._db.execute("SELECT number, layout FROM combined"))
            if not found.items() <= layouts.items():
                raise sqlite3.DatabaseError("it names products that are not of this campaign")
            return set(found)

    def combine(self, number: int, layout: str) -> None:
        """Record that a combination's products are written."""
        self._write("INSERT OR IGNORE INTO combined VALUES (?, ?)", [(number, layout)])

    def begin(self, numbers: Iterable[int]) -> None:
        """Enter tasks that are not there yet, as waiting."""
        self._write(
            "INSERT OR IGNORE INTO tasks VALUES (?, 'waiting', 0, '', '', 0, '', 0)",
            ((n,) for n in numbers),
        )

    def claim(self, numbers: Iterable[int]) -> None:
        """Record that tasks are given to workers."""
        self._write(
            "UPDATE tasks SET state = 'claimed', attempts = attempts + 1 WHERE number = ?",
            ((n,) for n in numbers),
        )

    def done(self, number: int, host: str, seconds: float, digest: str, machine: str = "") -> None:
        """Record that a task's product is complete."""
        with self.together():
            self._write("INSERT OR IGNORE INTO machines (text) VALUES (?)", [(machine,)])
            self._write(
                "UPDATE tasks SET state = 'done', host = ?, seconds = ?, digest = ?, "
                "machine = (SELECT id FROM machines WHERE text = ?) WHERE number = ?",
                [(host, seconds, digest, machine, number)],
            )

    def failed(self, number: int, host: str, seconds: float, error: str, again: bool) -> None:
        """An attempt failed; ``again``: the task waits for another one."""
        self._write(
            "UPDATE tasks SET state = ?, host = ?, seconds = ?, error = ?, digest = '', machine = 0"
            " WHERE number = ?",
            [("waiting" if again else "failed", host, seconds, error, number)],
        )

    def put_off(self, numbers: Iterable[int], error: str = "") -> None:
        """Tasks wait again, with all their attempts before them. ``error``: why; empty: the one
        before is kept.
        """
        self._write(
            "UPDATE tasks SET state = 'waiting', attempts = 0, digest = '', machine = 0, "
            "error = CASE WHEN ?1 = '' THEN error ELSE ?1 END WHERE number = ?2",
            ((error, n) for n in numbers),
        )

    def rows(self) -> list[TaskRow]:
        """All tasks, in order."""
        with self._errors():
            return _rows(self._db)

    def close(self) -> None:
        """Close the file."""
        self._db.close()

    @contextlib.contextmanager
    def together(self) -> Iterator[None]:
        """Write what the body says at once, when it ends: the disk is waited for once."""
        if self._db.in_transaction:
            yield
            return
        with self._errors():
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield
            except BaseException:
                with contextlib.suppress(sqlite3.Error):
                    self._db.execute("ROLLBACK")
                raise
            self._db.execute("COMMIT")

    def _write(self, statement: str, rows: Iterable[tuple[Any, ...]]) -> None:
        with self.together():
            self._db.executemany(statement, rows)

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            with writing(self.path):
                yield
        except DAMAGE as err:
            raise _error(err, self.path) from None


def read(path: Path) -> list[TaskRow]:
    """The rows of a log that another process may be writing. Raises `InputError` where it is
    damaged.
    """
    for mode in (
        "ro",
        "rw",
    ):  # a log whose writer was killed must be mended first, which takes leave to write
        try:
            database = sqlite3.connect(
                f"{path.resolve().as_uri()}?mode={mode}", uri=True, timeout=30
            )
            try:
                return _rows(database)
            finally:
                database.close()
        except sqlite3.OperationalError as err:
            if "no such table" in str(err):  # its writer has just begun, or was killed then
                return []
            failure: Exception = err
        except DAMAGE as err:
            failure = err
            break
    raise damaged(path, failure)


def damaged(path: Path, err: Exception) -> InputError:
    """The error of a log that cannot be read."""
    return InputError(
        f"is damaged: {err}",
        place=str(path),
        cure=f"zonda resume {path.parent} makes it anew from what is there",
    )


def _rows(database: sqlite3.Connection) -> list[TaskRow]:
    columns = "number, state, attempts, error, host, seconds, digest, COALESCE(text, '')"
    query = f"SELECT {columns} FROM tasks LEFT JOIN machines ON id = machine ORDER BY number"
    found = [TaskRow(*values) for values in database.execute(query)]
    kinds = (int, str, int, str, str, float | int, str, str)
    if any(
        row.state not in STATES or not all(map(isinstance, astuple(row), kinds)) for row in found
    ):
        raise sqlite3.DatabaseError("it holds an unknown state of a task")
    return found


def _error(err: Exception, path: Path) -> Exception:
    """`OutputError` for a fault of the disk or a locked file; `InputError` (damaged) for all
    else.
    """
    kind = (getattr(err, "sqlite_errorname", None) or "").removeprefix("SQLITE_").partition("_")[0]
    number = {"FULL": errno.ENOSPC, "READONLY": errno.EROFS, "PERM": errno.EACCES}.get(kind)
    of_the_header = (
        kind == "READONLY" and os.access(path, os.W_OK) and os.access(path.parent, os.W_OK)
    )
    if of_the_header or (number is None and kind not in ("IOERR", "CANTOPEN", "BUSY", "LOCKED")):
        return damaged(path, err)
    return output_error(OSError(number, str(err)) if number else OSError(str(err)), path)
