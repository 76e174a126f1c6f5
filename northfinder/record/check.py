"""Whether a record is sound: its file, the seal of every row, missing rows, gaps in the samples, and its end."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

from northfinder.record.database import open_for_reading
from northfinder.record.lock import is_being_written
from northfinder.record.reader import CLOSED
from northfinder.record.recovery import closing_counts
from northfinder.record.schema import NAMES, TABLES, Row, is_sound

#: So many findings of one kind are named one by one.
_MAX_NAMED = 10


@dataclass(slots=True)
class Examination:
    """What a check has found."""

    damage: list[str] = field(default_factory=list)  #: what is not as it was written, a sentence each
    notes: list[str] = field(default_factory=list)  #: what to know of a sound record
    n_rows: int = 0
    n_samples: int = 0
    n_missing: int = 0  #: samples that never came, by their index

    @property
    def sound(self) -> bool:
        """Whether all is as it was written."""
        return not self.damage


def examine(path: Path) -> Examination:
    """Check the record at `path` row by row. Raises RecordError if it is none, or of another version."""
    found = Examination()
    written = is_being_written(path)  # before the database is opened: SQLite would lose its locks
    with closing(open_for_reading(path)) as db:
        _examine_file(db, found)
        last = {table: _examine_table(db, table, found) for table in TABLES}
        _examine_end(db, last, found, written=written)
    return found


def _examine_file(db: sqlite3.Connection, found: Examination) -> None:
    try:
        messages = [row[0] for row in db.execute(f"PRAGMA quick_check({_MAX_NAMED})")]
    except (sqlite3.Error, UnicodeError) as error:
        messages = [str(error)]
    found.damage += [f"SQLite says: {message}" for message in messages if message != "ok"]


def _examine_table(db: sqlite3.Connection, table: str, found: Examination) -> int:
    """Check the rows of a table; return the number of the last one."""
    missing, altered, last, previous = [], [], 0, None
    try:
        for row in db.execute(f"SELECT {NAMES[table]} FROM {table} ORDER BY id"):  # noqa: S608  # names of ours
            if not isinstance(row[0], int) or row[0] <= last:
                altered.append(f"row {row[0]} of {table} stands after row {last}")
                continue
            if row[0] != last + 1:
                missing.append(f"rows {last + 1} to {row[0] - 1} of {table} are missing")
            last = row[0]
            if not is_sound(table, row):
                altered.append(f"row {last} of {table} does not match its checksum")
                continue
            found.n_rows += 1
            if table == "block":
                found.notes += _gap(previous, row, found)
                previous = row
    except (sqlite3.Error, UnicodeError) as error:
        altered.append(f"{table} cannot be read beyond row {last}: {error}")
    for sentences in (missing, altered):
        found.damage += sentences[:_MAX_NAMED]
        if len(sentences) > _MAX_NAMED:
            found.damage.append(f"and {len(sentences) - _MAX_NAMED} more of {table} likewise")
    return last


def _gap(previous: Row | None, row: Row, found: Examination) -> Iterator[str]:
    """Yield a note on samples that are missing between two blocks of one stream."""
    _, stream, first, n_samples = row[:4]
    found.n_samples += n_samples
    expected = 0 if previous is None or previous[1] != stream else previous[2] + previous[3]
    if first > expected:
        found.n_missing += first - expected
        if found.n_missing == first - expected:  # one example will do; the sum stands in the summary
            yield f"samples {expected} to {first - 1} of stream {stream} never came"


def _examine_end(db: sqlite3.Connection, last: dict[str, int], found: Examination, *, written: bool) -> None:
    """Compare with what the record held when it was closed."""
    try:
        counts = closing_counts(
            row[0] for row in db.execute("SELECT value FROM meta WHERE key = ? ORDER BY id", (CLOSED,))
        )
    except (sqlite3.Error, UnicodeError):
        return  # said already
    if written:
        found.notes.append("it is being written")
    elif counts is None or any(last[table] > counts.get(table, 0) for table in ("block", "event")):
        found.notes.append("it was not closed: what came in its last 0.1 s may be missing")
    if counts is not None:
        short = [table for table, number in counts.items() if last.get(table, 0) < number]
        found.damage += [f"{table} ends at row {last[table]} of {counts[table]}" for table in short if table in last]
    if not last["fix"] and not written:
        found.notes.append("the measurement ended early: northfinder resume goes on with it")
