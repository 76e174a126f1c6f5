"""The thread that writes a record: rows in the order they come, durable on disk at each commit."""

from __future__ import annotations

import queue
import sqlite3
import threading
import time
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

from northfinder.errors import RecordError
from northfinder.record.files import log_of, make_folder, sync_folder
from northfinder.record.lock import RecordLock
from northfinder.record.schema import APPLICATION_ID, INSERT, PAGE_SIZE, SCHEMA, SCHEMA_VERSION, Row

#: A disk that has taken nothing for so long ends the measurement, in s.
STALL_TIMEOUT = 60.0
#: How long another program may lock the file, and the disk keep the end of a measurement waiting, in s.
CLOSE_TIMEOUT = 60.0
#: How long a program that reads may hold up the tidying at the end, in s; the record is complete without it.
TIDY_TIMEOUT = 2.0
#: After so many transactions, 10 s of them, the log is copied to the file.
CHECKPOINT_COMMITS = 100
#: So many bytes of samples may wait for the disk.
MAX_WAITING_BYTES = 1 << 27

#: Rows of one table.
Batch = tuple[str, list[Row]]


def create(path: Path) -> tuple[sqlite3.Connection, RecordLock]:
    """Return a connection to a new, empty record, and the lock on it. Raises RecordError."""
    make_folder(path.parent)
    try:
        path.open("xb").close()
    except FileExistsError:
        raise RecordError(f"the record {path} exists already, and records are never overwritten") from None
    except OSError as error:
        raise RecordError(f"the record {path} cannot be created: {error.strerror}") from None
    try:
        return _open(path, "created", create_tables=True)
    except RecordError:
        for left in (path, log_of(path), path.with_name(f"{path.name}-shm")):  # it holds nothing
            with suppress(OSError):
                left.unlink(missing_ok=True)
        raise


def lay_out(db: sqlite3.Connection) -> None:
    """Make an empty record of an empty database, in one transaction."""
    db.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    db.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
    db.executescript(f"BEGIN; {SCHEMA} COMMIT")


def reopen(path: Path) -> tuple[sqlite3.Connection, RecordLock]:
    """Return a connection to an existing record, and the lock on it. Raises RecordError."""
    return _open(path, "continued", create_tables=False)


def _open(path: Path, doing: str, *, create_tables: bool) -> tuple[sqlite3.Connection, RecordLock]:
    lock = RecordLock(path)
    try:
        # Made here and used in the writer's thread alone from then on.
        db = sqlite3.connect(path, timeout=CLOSE_TIMEOUT, isolation_level=None, check_same_thread=False)
    except sqlite3.Error as error:
        lock.release()
        raise RecordError(f"the record {path} cannot be {doing}: {error}") from error
    try:
        if create_tables:
            db.execute(f"PRAGMA page_size = {PAGE_SIZE}")
        db.execute("PRAGMA synchronous = EXTRA")  # FULL, and no journal comes back after the power has failed
        db.execute("PRAGMA journal_mode = WAL")
        db.execute("PRAGMA wal_autocheckpoint = 0")  # SQLite would keep its failures to itself
        if create_tables:
            lay_out(db)
            db.execute("PRAGMA wal_checkpoint(TRUNCATE)")  # from now on the file itself says what it is
    except sqlite3.Error as error:
        db.close()
        lock.release()
        raise RecordError(f"the record {path} cannot be {doing}: {error}") from error
    if create_tables:
        sync_folder(path.parent)
    return db, lock


def finish(db: sqlite3.Connection) -> None:
    """Make one file of the record, unless somebody reads it right now: it is complete as it is."""
    db.execute(f"PRAGMA busy_timeout = {round(1000 * TIDY_TIMEOUT)}")
    try:
        db.execute("PRAGMA journal_mode = DELETE")
    except sqlite3.OperationalError as error:
        if error.sqlite_errorcode != sqlite3.SQLITE_BUSY:
            raise


class Writer(threading.Thread):
    """Writes rows in the order they come; those that have come meanwhile go into one transaction.

    The first failure ends it: it is raised once, and the record takes nothing more. No fsync is tried again after one
    has failed, since the second would only seem to succeed.
    """

    def __init__(
        self, path: Path, opened: tuple[sqlite3.Connection, RecordLock], monotonic: Callable[[], float] = time.monotonic
    ) -> None:
        super().__init__(name="recorder", daemon=True)
        self._path = path
        self._db, self._lock = opened
        self._monotonic = monotonic
        self._waiting: queue.SimpleQueue[list[Batch] | threading.Event | None] = queue.SimpleQueue()
        self._n_waiting = 0  # bytes of samples
        self._busy_since: float | None = None  # when the disk was given what it has not yet taken
        self._error: str | None = None
        self._stalled = False
        self._told = False
        self.checkpoint_commits = CHECKPOINT_COMMITS
        self._n_commits = 0

    @property
    def delay(self) -> float:
        """For how long the disk has been busy with what it was given, in s."""
        since = self._busy_since
        return 0.0 if since is None else self._monotonic() - since

    def put(self, batches: list[Batch], n_bytes: int = 0) -> None:
        """Take rows with `n_bytes` of samples. Raises RecordError, once, if the writer failed or the disk stalls."""
        if self.delay > STALL_TIMEOUT:
            self._stall(f"the disk has taken nothing for {STALL_TIMEOUT:g} s")
        elif self._n_waiting > MAX_WAITING_BYTES:
            self._stall(f"the disk is too slow: {self._n_waiting / 1e6:.0f} MB wait for it")
        self._tell()
        if self._told:
            return
        self._n_waiting += n_bytes
        self._waiting.put(batches)

    def flush(self) -> None:
        """Wait until all that was taken has been written. Raises RecordError, once, if the writer has failed."""
        written = threading.Event()
        self._waiting.put(written)
        if not self._stalled and not written.wait(CLOSE_TIMEOUT):
            self._stall(f"the disk has taken nothing for {CLOSE_TIMEOUT:g} s")
        self._tell()

    def close(self) -> None:
        """Make one file of the record. Raises RecordError, once, if anything could not be written."""
        self._waiting.put(None)
        self.join(TIDY_TIMEOUT if self._stalled else CLOSE_TIMEOUT)
        self._tell()

    def run(self) -> None:
        """Write until told to end."""
        while True:
            taken = [self._waiting.get()]
            self._busy_since = self._monotonic()
            with suppress(queue.Empty):
                while True:
                    taken.append(self._waiting.get_nowait())
            self._n_waiting = 0
            self._write([batch for item in taken if isinstance(item, list) for batch in item])
            self._busy_since = None
            for item in taken:
                if isinstance(item, threading.Event):
                    item.set()
            if None in taken:
                break
        self._finish()

    def _write(self, batches: list[Batch]) -> None:
        """Write rows, all or none, to the disk itself."""
        if self._error is not None or not batches:
            return
        try:
            self._db.execute("BEGIN IMMEDIATE")
            for table, rows in batches:
                self._db.executemany(INSERT[table], rows)
            self._db.execute("COMMIT")
            self._n_commits += 1
            if self._n_commits % self.checkpoint_commits == 0:
                self._db.execute("PRAGMA wal_checkpoint(PASSIVE)")
        except Exception as error:  # noqa: BLE001  # whatever it is, it must be told, not die with this thread
            self._error = str(error)
            with suppress(sqlite3.Error):
                self._db.rollback()

    def _finish(self) -> None:
        try:
            if self._error is None:
                finish(self._db)
                self._db.close()
            else:
                self._leave()
        except sqlite3.Error as error:
            self._error = self._error or str(error)
        finally:
            self._lock.release()

    def _leave(self) -> None:
        """Close the files as they are: a reader that stays to the last keeps SQLite from copying and syncing more."""
        with suppress(sqlite3.Error):
            reader = sqlite3.connect(f"{self._path.absolute().as_uri()}?mode=ro", uri=True)
            with closing(reader):
                reader.execute("SELECT count(*) FROM meta").fetchone()
                self._db.close()
        self._db.close()

    def _stall(self, reason: str) -> None:
        """Give the measurement up; what waits is still written if the disk comes back in time."""
        if not self._stalled and not self._told:
            self._stalled = True
            self._told = True
            raise RecordError(f"the record {self._path} cannot be written: {reason}")

    def _tell(self) -> None:
        """Raise what has gone wrong, once."""
        if self._error is not None and not self._told:
            self._told = True
            raise RecordError(f"the record {self._path} cannot be written: {self._error}")
