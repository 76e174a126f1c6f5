"""The database of a record, opened to be read: only if it is one, and such that it does nothing by itself."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from northfinder.errors import RecordError
from northfinder.record.files import has_log, log_of, require_database
from northfinder.record.schema import APPLICATION_ID, MAX_ROW_BYTES, SCHEMA_VERSION

#: How a file of SQLite begins, and where it says whose it is.
_SQLITE, _APPLICATION_ID, _HEADER_BYTES = b"SQLite format 3\0", slice(68, 72), 100


@contextmanager
def one_line(path: Path, doing: str) -> Iterator[None]:
    """Turn SQLite's exceptions into one sentence about the record."""
    try:
        yield
    except (sqlite3.Error, UnicodeError) as error:  # damaged text, even that of SQLite's own complaint
        hint = "; northfinder recover saves the rest" if type(error) is sqlite3.DatabaseError else ""
        raise RecordError(f"the record {path} cannot be {doing}: {error}{hint}") from error


def open_for_reading(path: Path) -> sqlite3.Connection:
    """Return a connection that reads the record at `path`, and changes no more of it than a cut left to be undone.

    Raises RecordError if it is no record of a version this program knows.
    """
    require_database(path)
    with one_line(path, "read"):
        db = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)
        try:
            db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_ROW_BYTES)
            _require_record(db, path)
        except BaseException:
            db.close()
            raise
    return db


def _require_record(db: sqlite3.Connection, path: Path) -> None:
    """Raise RecordError if a database is no record; sqlite3.OperationalError if that cannot be told here."""
    try:
        application_id, version = _kind(db, path)
    except sqlite3.OperationalError as error:  # it could be one, but not here: no rights, no room beside it
        if error.sqlite_errorcode == sqlite3.SQLITE_CANTOPEN and has_log(path):
            raise _log_locked_up(path) from None
        raise
    except (sqlite3.DatabaseError, UnicodeError) as error:
        raise _unreadable(path, error) from None
    if application_id == 0 and not path.stat().st_size:
        raise RecordError(f"{path} is no record of a measurement: it is empty")
    if application_id != APPLICATION_ID or version != SCHEMA_VERSION:
        found = f"version {version}" if application_id == APPLICATION_ID else "another kind of SQLite file"
        raise RecordError(f"{path} is no record of version {SCHEMA_VERSION}: found {found}")
    if (program := _program_in(db)) is not None:
        raise RecordError(f"{path} is no record of a measurement: found {program} in it, expected plain tables alone")


def _program_in(db: sqlite3.Connection) -> str | None:
    """Return what a database holds beside tables that would run when it is read or written, None if nothing."""
    query = "SELECT type, name FROM sqlite_master WHERE type IN ('view', 'trigger') OR sql LIKE 'CREATE VIRTUAL%'"
    try:
        found = db.execute(query).fetchone()
    except (sqlite3.Error, UnicodeError):
        return None  # damaged: whoever reads the tables will say so
    return None if found is None else f"the {found[0]} {found[1]}"


def _log_locked_up(path: Path) -> RecordError:
    return RecordError(
        f"the record {path} cannot be read: its newest rows stand in {log_of(path).name}, and SQLite must write beside "
        "it to read them: copy both to where that is allowed, or northfinder recover --out elsewhere"
    )


def _unreadable(path: Path, error: Exception) -> RecordError:
    """Return what to say of a file that SQLite does not take for a database: its header may still be a record's."""
    with path.open("rb") as file:
        header = file.read(_HEADER_BYTES)
    if header.startswith(_SQLITE) and header[_APPLICATION_ID] == APPLICATION_ID.to_bytes(4, "big"):
        return RecordError(f"the record {path} is damaged: {error}; northfinder recover saves the rest")
    return RecordError(f"{path} is no record of a measurement")


def _kind(db: sqlite3.Connection, path: Path) -> tuple[int, int]:
    """Return application and version of a database; first undo what was cut off while it was being closed."""
    try:
        application_id = db.execute("PRAGMA application_id").fetchone()[0]
    except sqlite3.OperationalError:
        if not path.with_name(path.name + "-journal").exists():
            raise
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=rw", uri=True)) as writer:
            writer.execute("PRAGMA schema_version")
        application_id = db.execute("PRAGMA application_id").fetchone()[0]
    return application_id, db.execute("PRAGMA user_version").fetchone()[0]
