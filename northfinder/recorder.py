"""Writing the record of a measurement: everything is handed to a thread of its own, so that no disk holds up the bench.

A stage stops by itself when its host is silent for a quarter of a second, which is nothing to a disk that is busy.
"""

from __future__ import annotations

import queue
import sqlite3
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

import fastcrc
import msgspec
import numpy as np

from drivers.api import RateBlock, StageState
from northfinder.errors import RecordError
from northfinder.record import APPLICATION_ID, SCHEMA, SCHEMA_VERSION, DwellSpan

#: What has arrived is handed to the file at least this often, in s.
WRITE_PERIOD = 0.1
#: How long the disk may keep the end of a measurement waiting, in s.
CLOSE_TIMEOUT = 60.0
#: So many writes may wait for the disk, two minutes of them, before the measurement is given up.
MAX_WAITING = 1200

#: A statement and the rows to execute it with.
Insert = tuple[str, list[tuple[object, ...]]]


class Recorder:
    """Writes a new record. Use as a context manager; whatever ends the block, the record is closed."""

    def __init__(self, path: Path, now: Callable[[], float]) -> None:
        """Create the file `path`, which must not exist; `now` tells the host's time in s. Raises RecordError."""
        self.path = path
        self._now = now
        self._blocks: list[tuple[object, ...]] = []
        self._states: list[tuple[object, ...]] = []
        self._next_write = now() + WRITE_PERIOD
        self._closed = False
        self.n_samples = 0
        self.n_lost = 0
        self._writer = _Writer(path, _create(path))
        self._writer.start()

    def __enter__(self) -> Self:
        """Return the recorder itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Close the record; a failure to do so does not hide the exception that ended the block."""
        try:
            self.close()
        except RecordError:
            if error is None:
                raise

    def set_meta(self, key: str, value: object) -> None:
        """Keep `value`, anything that can be JSON, under `key`."""
        row: tuple[object, ...] = (key, msgspec.json.encode(value).decode())
        self._put(("INSERT OR REPLACE INTO meta VALUES (?, ?)", [row]))

    def add_block(self, block: RateBlock) -> None:
        """Keep a block of samples."""
        counts = np.ascontiguousarray(block.counts)
        data = counts.astype(counts.dtype.newbyteorder("<"), copy=False).tobytes()
        dtype = "<f4" if counts.dtype.kind == "f" else "<i4"
        tilt = block.tilt if block.tilt is not None else (None, None)
        force = block.specific_force if block.specific_force is not None else (None, None, None)
        self._blocks.append(
            (
                block.first_index, counts.shape[0], counts.shape[1], block.device_time, block.arrival_time,
                block.rate_lsb, dtype, block.temperature, *tilt, *force, int(block.status), block.n_lost,
                fastcrc.crc32.iscsi(data), data,
            )
        )  # fmt: skip
        self.n_samples += counts.shape[0]
        self.n_lost += block.n_lost
        self._write_if_due()

    def add_state(self, state: StageState) -> None:
        """Keep a reported state of the stage."""
        self._states.append(
            (
                state.device_time, state.arrival_time, state.mode.value, state.azimuth, state.elevation,
                state.azimuth_rate, state.elevation_rate, int(state.in_position), state.fault,
            )
        )  # fmt: skip
        self._write_if_due()

    def add_step(self, span: DwellSpan) -> None:
        """Keep a finished dwell."""
        self.write()
        row: tuple[object, ...] = (
            span.step, span.name, span.azimuth, span.elevation, span.dwell, span.measured_azimuth,
            span.measured_elevation, span.first_index, span.stop_index, span.sample_rate,
        )  # fmt: skip
        self._put(("INSERT INTO step VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", [row]))

    def add_event(self, kind: str, detail: str = "") -> None:
        """Keep that something happened now."""
        self.write()
        self._put(("INSERT INTO event (time, kind, detail) VALUES (?, ?, ?)", [(self._now(), kind, detail)]))

    def add_fix(self, value: object) -> None:
        """Keep what was estimated."""
        self.write()
        row: tuple[object, ...] = (self._now(), msgspec.json.encode(value).decode())
        self._put(("INSERT INTO fix (time, value) VALUES (?, ?)", [row]))

    def _write_if_due(self) -> None:
        if self._now() >= self._next_write:
            self.write()

    def write(self) -> None:
        """Hand over to the file all that has arrived. Raises RecordError if it has failed to take what came before."""
        self._next_write = self._now() + WRITE_PERIOD
        blocks, self._blocks = self._blocks, []
        states, self._states = self._states, []
        if blocks or states:
            self._put(
                ("INSERT INTO block VALUES (NULL, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", blocks),
                ("INSERT INTO stage_state VALUES (NULL, ?, ?, ?, ?, ?, ?, ?, ?, ?)", states),
            )

    def flush(self) -> None:
        """Wait until the file holds all that has arrived. Raises RecordError."""
        self.write()
        self._writer.flush()

    def _put(self, *inserts: Insert) -> None:
        self._writer.put(inserts)

    def close(self) -> None:
        """Write what is left and make one file of the record. Closing twice is no error. Raises RecordError."""
        if self._closed:
            return
        self._closed = True
        try:
            self.flush()
        finally:
            self._writer.close()


def _create(path: Path) -> sqlite3.Connection:
    """Return a connection to a new, empty record."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.open("xb").close()
    except FileExistsError:
        raise RecordError(f"the record {path} exists already, and records are never overwritten") from None
    except OSError as error:
        raise RecordError(f"the record {path} cannot be created: {error.strerror}") from None
    try:
        # Made here and used in the writer's thread alone from then on.
        db = sqlite3.connect(path, timeout=CLOSE_TIMEOUT, isolation_level=None, check_same_thread=False)
        db.execute("PRAGMA journal_mode = WAL")
        db.execute("PRAGMA synchronous = FULL")
        db.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        db.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
        db.executescript(SCHEMA)
    except sqlite3.Error as error:
        raise RecordError(f"the record {path} cannot be created: {error}") from error
    return db


class _Writer(threading.Thread):
    """Executes inserts in the order they come; those that have come meanwhile go into one transaction.

    The first failure ends it: it is raised once, and the record takes nothing more.
    """

    def __init__(self, path: Path, db: sqlite3.Connection) -> None:
        super().__init__(name="recorder", daemon=True)
        self._path = path
        self._db = db
        self._waiting: queue.Queue[tuple[Insert, ...] | threading.Event | None] = queue.Queue(MAX_WAITING)
        self._error: str | None = None
        self._told = False

    def put(self, inserts: tuple[Insert, ...]) -> None:
        """Take inserts. Raises RecordError, once, if the writer has failed."""
        self._tell()
        try:
            self._waiting.put_nowait(inserts)
        except queue.Full:
            self._error = "the disk has taken nothing for too long"
            self._tell()

    def flush(self) -> None:
        """Wait until all that was taken has been written. Raises RecordError, once, if the writer has failed."""
        written = threading.Event()
        self._waiting.put(written)
        if not written.wait(CLOSE_TIMEOUT):
            self._error = f"the disk has taken nothing for {CLOSE_TIMEOUT:g} s"
        self._tell()

    def close(self) -> None:
        """Make one file of the record. Raises RecordError, once, if anything could not be written."""
        self._waiting.put(None)
        self.join(CLOSE_TIMEOUT)
        self._tell()

    def run(self) -> None:
        """Write until told to end."""
        while True:
            batch = [self._waiting.get()]
            with suppress(queue.Empty):
                while True:
                    batch.append(self._waiting.get_nowait())
            self._write([insert for item in batch if isinstance(item, tuple) for insert in item])
            for item in batch:
                if isinstance(item, threading.Event):
                    item.set()
            if None in batch:
                break
        self._finish()

    def _write(self, inserts: list[Insert]) -> None:
        """Execute inserts, all or none."""
        if self._error is not None or not inserts:
            return
        try:
            self._db.execute("BEGIN")
            for statement, rows in inserts:
                self._db.executemany(statement, rows)
            self._db.execute("COMMIT")
        except sqlite3.Error as error:
            self._error = str(error)
            with suppress(sqlite3.Error):
                self._db.rollback()

    def _finish(self) -> None:
        try:
            self._db.execute("PRAGMA journal_mode = DELETE")
        except sqlite3.Error as error:
            self._error = self._error or str(error)
        finally:
            self._db.close()

    def _tell(self) -> None:
        """Raise what has gone wrong, once."""
        if self._error is not None and not self._told:
            self._told = True
            raise RecordError(f"the record {self._path} cannot be written: {self._error}")
