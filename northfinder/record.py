"""The record of a measurement: one SQLite file that holds everything that was measured, and what was made of it.

Written in write-ahead mode, so that whatever was committed survives the death of the process; when the record is
closed, one plain file remains. Times are in s, angles in rad, rates in rad/s per count; the schema below is version 1.

    meta          key, value         configuration, identities, versions, as JSON
    block         one row a block of samples, counts as little-endian int32 or float32, CRC-32C of the counts
    stage_state   one row a reported state of the stage
    step          one row a step of the plan: target, measured stage angles, first and stop index of its samples
    event         what happened and when, by the host's clock
    fix           what was estimated, as JSON
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import fastcrc
import msgspec
import numpy as np

from drivers.api import GyroStatus, RateBlock, StageMode, StageState
from northfinder.errors import RecordError

#: "NFR1" in the file's header tells a record from any other SQLite file.
APPLICATION_ID = 0x4E465231
SCHEMA_VERSION = 1
#: A block longer than this is no block of ours, in bytes.
MAX_BLOCK_BYTES = 1 << 20

SCHEMA = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE block (
    id INTEGER PRIMARY KEY, first_index INTEGER NOT NULL, n_samples INTEGER NOT NULL, n_axes INTEGER NOT NULL,
    device_time REAL NOT NULL, arrival_time REAL NOT NULL, rate_lsb REAL NOT NULL, dtype TEXT NOT NULL,
    temperature REAL, tilt_x REAL, tilt_y REAL,
    specific_force_x REAL, specific_force_y REAL, specific_force_z REAL,
    status INTEGER NOT NULL, n_lost INTEGER NOT NULL,
    crc INTEGER NOT NULL, counts BLOB NOT NULL);
CREATE TABLE stage_state (
    id INTEGER PRIMARY KEY, device_time REAL NOT NULL, arrival_time REAL NOT NULL, mode TEXT NOT NULL,
    azimuth REAL NOT NULL, elevation REAL NOT NULL, azimuth_rate REAL NOT NULL, elevation_rate REAL NOT NULL,
    in_position INTEGER NOT NULL, fault TEXT NOT NULL);
CREATE TABLE step (
    id INTEGER PRIMARY KEY, name TEXT NOT NULL, azimuth REAL NOT NULL, elevation REAL NOT NULL, dwell REAL NOT NULL,
    measured_azimuth REAL NOT NULL, measured_elevation REAL NOT NULL,
    first_index INTEGER NOT NULL, stop_index INTEGER NOT NULL, sample_rate REAL NOT NULL);
CREATE TABLE event (id INTEGER PRIMARY KEY, time REAL NOT NULL, kind TEXT NOT NULL, detail TEXT NOT NULL);
CREATE TABLE fix (id INTEGER PRIMARY KEY, time REAL NOT NULL, value TEXT NOT NULL);
"""

_DTYPES: dict[str, np.dtype[Any]] = {"<i4": np.dtype("<i4"), "<f4": np.dtype("<f4")}


@dataclass(frozen=True, slots=True, kw_only=True)
class DwellSpan:
    """A finished dwell: which step, where the stage really stood, and which samples belong to it."""

    step: int  #: number of the step in the plan, from 0
    name: str  #: the position, as U1
    azimuth: float  #: rad, the step's target
    elevation: float  #: rad
    dwell: float  #: s
    measured_azimuth: float  #: rad, mean of the encoder over the dwell
    measured_elevation: float  #: rad
    first_index: int  #: of the dwell's first sample
    stop_index: int  #: one past its last
    sample_rate: float  #: Hz


@contextmanager
def _one_line(path: Path, doing: str) -> Iterator[None]:
    """Turn SQLite's exceptions into one sentence about the record."""
    try:
        yield
    except sqlite3.Error as error:
        raise RecordError(f"the record {path} cannot be {doing}: {error}") from error


class Record:
    """Reads a record, finished or left behind by a process that died. Use as a context manager."""

    def __init__(self, path: Path) -> None:
        """Open the file `path`. Raises RecordError if it is no record of a version this program knows."""
        self.path = path
        if not path.is_file():
            raise RecordError(f"no record {path}: expected a file")
        with _one_line(path, "read"):
            self._db = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)
            try:
                application_id = self._db.execute("PRAGMA application_id").fetchone()[0]
                version = self._db.execute("PRAGMA user_version").fetchone()[0]
            except sqlite3.DatabaseError:
                self._db.close()
                raise RecordError(f"{path} is no record of a measurement") from None
        if application_id != APPLICATION_ID or version != SCHEMA_VERSION:
            self._db.close()
            found = f"version {version}" if application_id == APPLICATION_ID else "another kind of SQLite file"
            raise RecordError(f"{path} is no record of version {SCHEMA_VERSION}: found {found}")

    def __enter__(self) -> Self:
        """Return the record itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Close the file."""
        self._db.close()

    def meta(self, key: str) -> Any:  # noqa: ANN401  # as it was given to set_meta
        """Return the value kept under `key`, None if there is none."""
        with _one_line(self.path, "read"):
            row = self._db.execute("SELECT value FROM meta WHERE key = ?", (key,)).fetchone()
        try:
            return None if row is None else msgspec.json.decode(row[0])
        except msgspec.DecodeError:
            raise RecordError(f"the record {self.path} is damaged: its entry {key!r} is no JSON") from None

    def steps(self) -> list[DwellSpan]:
        """Return the finished dwells in order."""
        with _one_line(self.path, "read"):
            rows = self._db.execute("SELECT * FROM step ORDER BY id").fetchall()
        return [DwellSpan(**dict(zip(DwellSpan.__slots__, row, strict=True))) for row in rows]

    def blocks(self, first_index: int = 0, stop_index: int = 1 << 62) -> Iterator[RateBlock]:
        """Yield the blocks that hold a sample of ``first_index <= index < stop_index``, in order.

        Raises RecordError at a block whose counts do not match their length or their CRC.
        """
        query = (
            "SELECT id, first_index, n_samples, n_axes, device_time, arrival_time, rate_lsb, dtype, temperature,"
            " tilt_x, tilt_y, specific_force_x, specific_force_y, specific_force_z,"
            " status, n_lost, crc, counts FROM block"
            " WHERE first_index < ? AND first_index + n_samples > ? ORDER BY id"
        )
        with _one_line(self.path, "read"):
            for row in self._db.execute(query, (stop_index, first_index)):
                yield self._block(row)

    def _block(self, row: tuple[Any, ...]) -> RateBlock:
        number, first, n_samples, n_axes, device_time, arrival_time, lsb, dtype, temperature, x, y, *rest = row
        force_x, force_y, force_z, status, n_lost, crc, data = rest
        sound = (
            dtype in _DTYPES
            and isinstance(data, bytes)
            and len(data) <= MAX_BLOCK_BYTES
            and len(data) == 4 * n_samples * n_axes
            and fastcrc.crc32.iscsi(data) == crc
        )
        if not sound:
            raise RecordError(f"the record {self.path} is damaged: block {number} does not match its checksum")
        return RateBlock(
            first_index=first,
            device_time=device_time,
            arrival_time=arrival_time,
            counts=np.frombuffer(data, _DTYPES[dtype]).reshape(n_samples, n_axes),
            rate_lsb=lsb,
            temperature=temperature,
            tilt=None if x is None or y is None else (x, y),
            specific_force=None if None in {force_x, force_y, force_z} else (force_x, force_y, force_z),
            status=GyroStatus(status),
            n_lost=n_lost,
        )

    def states(self) -> list[StageState]:
        """Return the reported states of the stage in order."""
        with _one_line(self.path, "read"):
            rows = self._db.execute(
                "SELECT device_time, arrival_time, mode, azimuth, elevation, azimuth_rate, elevation_rate,"
                " in_position, fault FROM stage_state ORDER BY id"
            ).fetchall()
        return [
            StageState(
                device_time=row[0], arrival_time=row[1], mode=StageMode(row[2]), azimuth=row[3], elevation=row[4],
                azimuth_rate=row[5], elevation_rate=row[6], in_position=bool(row[7]), fault=row[8],
            )
            for row in rows
        ]  # fmt: skip

    def events(self) -> list[tuple[float, str, str]]:
        """Return (time, kind, detail) of what happened, in order."""
        with _one_line(self.path, "read"):
            return self._db.execute("SELECT time, kind, detail FROM event ORDER BY id").fetchall()

    def is_complete(self) -> bool:
        """Return whether the measurement went on to its fix, rather than ending early."""
        with _one_line(self.path, "read"):
            return bool(self._db.execute("SELECT count(*) FROM fix").fetchone()[0])

    def fixes(self) -> list[Any]:
        """Return what was estimated, oldest first."""
        with _one_line(self.path, "read"):
            rows = self._db.execute("SELECT value FROM fix ORDER BY id").fetchall()
        return [msgspec.json.decode(row[0]) for row in rows]
