"""The operator's notes: added to a record at any time, also while it is being written."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

from northfinder.record.database import one_line, open_for_reading
from northfinder.record.schema import INSERT, sealed
from northfinder.text import printable

#: A note longer than this is a document.
MAX_NOTE = 4000
#: How long the note waits for whoever writes the record, s.
_TIMEOUT = 10.0


def add_note(path: Path, text: str, *, now: float) -> None:
    """Add `text` to the record, at `now` s since 1970. Raises RecordError."""
    open_for_reading(path).close()  # says what is wrong with it, if anything
    with one_line(path, "written"), closing(sqlite3.connect(path, timeout=_TIMEOUT, isolation_level=None)) as db:
        db.execute("PRAGMA synchronous = FULL")
        db.execute("BEGIN IMMEDIATE")
        number = db.execute("SELECT coalesce(max(id), 0) + 1 FROM note").fetchone()[0]
        db.execute(INSERT["note"], sealed("note", number, (now, printable(text, max_length=MAX_NOTE))))
        db.execute("COMMIT")
