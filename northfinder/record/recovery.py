"""A torn or damaged record to a new one that holds every sound row; the original is only read."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import msgspec

from northfinder.errors import RecordError
from northfinder.record.files import has_log, new_file, require_file
from northfinder.record.lock import is_being_written
from northfinder.record.pages import scan
from northfinder.record.reader import CLOSED
from northfinder.record.schema import INSERT, NAMES, PAGE_SIZE, SCHEMA, TABLES, sealed
from northfinder.record.writer import lay_out

#: Rows written at a time.
_BATCH = 500
#: Runs of lost rows that are named one by one.
_MAX_NAMED = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class Salvage:
    """What was found in a damaged record, and what was not."""

    found: dict[str, int]  #: rows by table
    lost: dict[str, tuple[tuple[int, int], ...]]  #: first and last number of each run of missing rows, by table
    closed: bool  #: whether the record was closed, so that rows lost at its end are known too
    written: bool = False  #: whether it is still being written

    @property
    def n_lost(self) -> int:
        """How many rows are known to be lost."""
        return sum(last - first + 1 for runs in self.lost.values() for first, last in runs)

    def sentences(self) -> list[str]:
        """Return what there is to say, a sentence each."""
        said = [f"{number} rows of {table} saved" for table, number in self.found.items() if number]
        for table, runs in self.lost.items():
            n = sum(last - first + 1 for first, last in runs)
            named = ", ".join(str(a) if a == b else f"{a} to {b}" for a, b in runs[:_MAX_NAMED])
            more = ", …" if len(runs) > _MAX_NAMED else ""
            said.append(f"{n} rows of {table} lost: {named}{more}")
        if not self.lost:
            said.append("no row is missing")
        if self.written:
            said.append("the record is being written: what comes from now on is not saved")
        elif not self.closed:
            said.append("the record was not closed: what came in its last 0.1 s may be missing")
        return said


def recover(path: Path, out: Path) -> Salvage:
    """Write all sound rows of the record at `path`, and of the log beside it, to a new record `out`.

    Rows are numbered anew, without gaps; an event says what is missing. `out` is there once it is whole. Raises
    RecordError if `path` cannot be read or holds no row of a record, or `out` exists.
    """
    if os.path.lexists(path) or not has_log(path):
        require_file(path)
    written = is_being_written(path)
    try:
        # First a temporary file, if it grows large.
        with new_file(out) as part, closing(sqlite3.connect("", isolation_level=None)) as sorter:
            _collect(path, sorter)
            salvage = _tally(sorter, written=written)
            if not any(salvage.found.values()):
                raise RecordError(f"{path} holds no row of a record")
            _write(sorter, part, [f"from {path.name}", *salvage.sentences()])
    except sqlite3.Error as error:
        raise RecordError(f"{path} cannot be recovered to {out}: {error}") from error
    return salvage


def _collect(path: Path, sorter: sqlite3.Connection) -> None:
    sorter.executescript(SCHEMA)
    sorter.execute("BEGIN")
    for table, row in scan(path):
        sorter.execute(INSERT[table].replace("INSERT", "INSERT OR IGNORE", 1), row)
    sorter.execute("COMMIT")


def _tally(sorter: sqlite3.Connection, *, written: bool) -> Salvage:
    counts = closing_counts(row[2] for row in sorter.execute("SELECT * FROM meta WHERE key = ? ORDER BY id", (CLOSED,)))
    found, lost = {}, {}
    for table in TABLES:
        numbers = (row[0] for row in sorter.execute(f"SELECT id FROM {table} ORDER BY id"))  # noqa: S608  # names of ours
        found[table], runs = _missing(numbers, (counts or {}).get(table, 0))
        if runs:
            lost[table] = runs
    return Salvage(found=found, lost=lost, closed=counts is not None, written=written)


def closing_counts(values: Iterator[str]) -> dict[str, int] | None:
    """Return how many rows each table had when the record was closed last, None if it never was."""
    newest = None
    for value in values:
        try:
            newest = msgspec.json.decode(value, type=dict[str, int] | None)
        except (msgspec.MsgspecError, RecursionError):
            newest = None
    return newest


def _missing(numbers: Iterator[int], n_expected: int) -> tuple[int, tuple[tuple[int, int], ...]]:
    """Return how many numbers there are, and the runs that are missing among 1, 2, ... up to `n_expected` at least."""
    found, previous, runs = 0, 0, []
    for number in numbers:
        if number > previous + 1:
            runs.append((previous + 1, number - 1))
        found, previous = found + 1, number
    if previous < n_expected:
        runs.append((previous + 1, n_expected))
    return found, tuple(runs)


def _write(sorter: sqlite3.Connection, out: Path, sentences: list[str]) -> None:
    """Write the rows found to a new record, numbered anew, and what became of the old one as an event."""
    with closing(sqlite3.connect(out, isolation_level=None)) as db:
        db.execute(f"PRAGMA page_size = {PAGE_SIZE}")
        db.execute("PRAGMA journal_mode = OFF")  # what is not finished is thrown away
        lay_out(db)
        db.execute("BEGIN")
        sorter.execute("DELETE FROM meta WHERE key = ?", (CLOSED,))  # its numbers are not those of the new record
        counts = {table: _copy(sorter, db, table) for table in TABLES}
        time = db.execute("SELECT max(time) FROM event").fetchone()[0] or 0.0
        counts["event"] += 1
        db.execute(INSERT["event"], sealed("event", counts["event"], (0, time, "recovered", "; ".join(sentences))))
        counted = msgspec.json.encode(counts).decode()
        db.execute(INSERT["meta"], sealed("meta", counts["meta"] + 1, (CLOSED, counted)))
        db.execute("COMMIT")


def _copy(sorter: sqlite3.Connection, db: sqlite3.Connection, table: str) -> int:
    """Copy the rows of a table; return how many there are."""
    n_rows = 0
    found = sorter.execute(f"SELECT {NAMES[table]} FROM {table} ORDER BY id")  # noqa: S608  # names of ours
    rows = (sealed(table, number, row[1:-1]) for number, row in enumerate(found, 1))
    while batch := list(islice(rows, _BATCH)):
        db.executemany(INSERT[table], batch)
        n_rows += len(batch)
    return n_rows
