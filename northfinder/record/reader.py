"""The record of a measurement: one SQLite file that holds everything that was measured, and what was made of it.

Written in write-ahead mode, so that whatever was committed survives the death of the process; when the record is
closed, one plain file remains. `schema` is its layout, version 1, docs/record.md its description. Times are in
s, angles in rad, rates in rad/s per count. Every row is checked against its seal before anything is made of it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec
import numpy as np

from drivers.api import GyroStatus, RateBlock, RateCounts, StageMode, StageState
from northfinder.errors import RecordError
from northfinder.record.block_columns import BlockColumns
from northfinder.record.database import one_line, open_for_reading
from northfinder.record.schema import MAX_BLOCK_BYTES, NAMES, Row, are_sound, is_sound

_DTYPES: dict[str, np.dtype[Any]] = {"<i4": np.dtype("<i4"), "<f4": np.dtype("<f4")}
_ALL_STATUS = sum(GyroStatus)
_STATUS = {int(status): status for status in (GyroStatus.OK, GyroStatus.OVERRUN)}  # the usual ones, quickly
_ANY_INDEX = (0, 1 << 62)
_FETCHED = 64  # rows at a time
#: Samples a second, numbers of streams and steps, times in s and angles in rad, beyond which nothing can be meant.
_SAMPLE_RATES, _MAX_NUMBER, _MAX_REAL = (1e-3, 1e7), 1 << 31, 1e12
#: The entry of meta that a closed record has: how many rows each table held before it, but for notes.
CLOSED = "closed"


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
    first_index: int  #: of the dwell's first sample in its stream
    stop_index: int  #: one past its last
    sample_rate: float  #: Hz
    stream: int = 0  #: number of the gyro's stream; a measurement that was resumed has several
    stream_start: float = 0.0  #: s, time of the stream's sample 0, from sample 0 of the first stream
    turn_on: int = 0  #: how many times the gyro had been switched off and on since the first stream


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamInfo:
    """One stream of the gyro: a measurement that was never interrupted has one."""

    stream: int  #: its number, from 0
    utc: float  #: s since 1970, when it was started
    clock: float  #: s, the clock of the arrival times at that instant
    sample_rate: float  #: Hz
    n_axes: int
    identities: dict[str, Any]  #: of the devices
    software: str  #: version that recorded it


class Record:
    """Reads a record, finished or left behind by a process that died. Use as a context manager.

    All that is read is bounded and checked: RecordError names what is damaged.
    """

    def __init__(self, path: Path) -> None:
        """Open the file `path`. Raises RecordError if it is no record of a version this program knows."""
        self.path = path
        self._db = open_for_reading(path)
        self._closed_with: dict[str, int] | None = None

    def __enter__(self) -> Self:
        """Return the record itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Close the file."""
        self._db.close()

    def rows(self, table: str, first: int = 1) -> Iterator[Row]:
        """Yield the rows of `table` from number `first` on, in order, without their checksum.

        Raises RecordError at a row that is missing or altered.
        """
        for rows in self._checked(table, first, None):
            for row in rows:
                yield row[:-1]

    def _checked(self, table: str, first: int, stop: int | None) -> Iterator[list[Row]]:
        """Yield the rows of `table` from number `first` to before `stop`, a few at a time, each seal checked."""
        number = first
        query = f"SELECT {NAMES[table]} FROM {table} WHERE id >= ? AND id < ? ORDER BY id"  # noqa: S608  # names of ours
        with one_line(self.path, "read"):
            cursor = self._db.execute(query, (first, _ANY_INDEX[1] if stop is None else stop))
            while rows := cursor.fetchmany(_FETCHED):
                if [row[0] for row in rows] != list(range(number, number + len(rows))):
                    missing = next(n for n, row in enumerate(rows, number) if row[0] != n)
                    raise self._damaged(f"row {missing} of {table} is missing")
                if not are_sound(table, rows):
                    altered = next(row[0] for row in rows if not is_sound(table, row))
                    raise self._damaged(f"row {altered} of {table} does not match its checksum")
                number += len(rows)
                yield rows
        if table != "meta" and number <= self._closing().get(table, 0) and (stop is None or number < stop):
            raise self._damaged(f"row {number} of {table} is missing")

    def _closing(self) -> dict[str, int]:
        """Return how many rows each table had when the record was closed last, nothing if it never was."""
        if self._closed_with is None:
            found = self.meta(CLOSED)
            self._closed_with = found if isinstance(found, dict) else {}
        return self._closed_with

    def count(self, table: str) -> int:
        """Return how many rows `table` has, by the number of its last one."""
        with one_line(self.path, "read"):
            found = self._db.execute(f"SELECT max(id) FROM {table}").fetchone()[0]  # noqa: S608  # names of ours
        return found if isinstance(found, int) else 0

    def totals(self) -> tuple[int, int]:
        """Return how many samples the record holds, and how many are missing between its blocks, as it says itself."""
        with one_line(self.path, "read"):
            n_samples, n_lost = self._db.execute("SELECT sum(n_samples), sum(n_lost) FROM block").fetchone()
        return n_samples or 0, n_lost or 0

    def _damaged(self, what: str) -> RecordError:
        return RecordError(f"the record {self.path} is damaged: {what}; northfinder recover saves the rest")

    def meta(self, key: str) -> Any:  # noqa: ANN401  # as it was given to set_meta
        """Return the value kept under `key`, None if there is none; the newest, if it was kept several times."""
        found = None
        for _, name, value in self.rows("meta"):
            found = value if name == key else found
        return None if found is None else self._decoded(found, f"its entry {key!r}")

    def _decoded(self, text: str, what: str) -> Any:  # noqa: ANN401  # any plain data
        try:
            return msgspec.json.decode(text)
        except (msgspec.DecodeError, RecursionError):
            raise self._damaged(f"{what} is no JSON") from None

    def streams(self) -> list[StreamInfo]:
        """Return the streams of the gyro in order; none if the measurement ended before."""
        streams = [
            StreamInfo(
                stream=stream, utc=utc, clock=clock, sample_rate=sample_rate, n_axes=n_axes,
                identities=self._decoded(identities, f"the identities of stream {stream}"), software=software,
            )
            for _, stream, utc, clock, sample_rate, n_axes, identities, software in self.rows("stream")
        ]  # fmt: skip
        for number, info in enumerate(streams, 1):
            if not (_is_possible(info) and 0 < info.n_axes < _MAX_NUMBER):
                raise self._damaged(f"row {number} of stream is no stream of samples")
        return streams

    def steps(self) -> list[DwellSpan]:
        """Return the finished dwells in order."""
        spans = [DwellSpan(**dict(zip(DwellSpan.__slots__, row[1:], strict=True))) for row in self.rows("step")]
        for number, span in enumerate(spans, 1):
            possible = 0 <= span.first_index < span.stop_index <= _ANY_INDEX[1] and 0 <= span.step < _MAX_NUMBER
            possible = possible and 0 <= span.turn_on < _MAX_NUMBER
            if not (possible and _is_possible(span)):
                raise self._damaged(f"row {number} of step is no dwell")
        return spans

    def blocks(
        self, first_index: int = _ANY_INDEX[0], stop_index: int = _ANY_INDEX[1], *, stream: int | None = None
    ) -> Iterator[RateBlock]:
        """Yield the blocks that hold a sample of ``first_index <= index < stop_index``, in order.

        Of the `stream` given, found quickly, or of all streams. Raises RecordError at a block that is missing or
        altered.
        """
        first = 1 if stream is None else self._first_block(stream, first_index)
        for row in self.rows("block", first):
            if stream is not None and (row[1], row[2]) >= (stream, stop_index):
                return
            block = self._block(row)
            if block.first_index < stop_index and block.first_index + len(block.counts) > first_index:
                yield block

    def blocks_of(self, span: DwellSpan) -> Iterator[RateBlock]:
        """Yield the blocks that hold the samples of a dwell, in order."""
        return self.blocks(span.first_index, span.stop_index, stream=span.stream)

    def columns_of(self, span: DwellSpan) -> BlockColumns | None:
        """Return the blocks that hold the samples of a dwell as columns, None if there are none; the quick way."""
        first = self._first_block(span.stream, span.first_index)
        stop = max(first, self._first_block(span.stream, span.stop_index))
        rows = [row for rows in self._checked("block", first, stop + 1) for row in rows]
        while rows and (rows[-1][1], rows[-1][2]) >= (span.stream, span.stop_index):
            rows.pop()
        return _columns(rows, self._counts(rows)) if rows else None

    def column_batches(self, n_blocks: int) -> Iterator[tuple[int, BlockColumns]]:
        """Yield (stream, blocks as columns) of the whole record in order, `n_blocks` at a time where it can."""
        batch: list[Row] = []
        for rows in self._checked("block", 1, None):
            for row in rows:
                if batch and (row[1] != batch[0][1] or len(batch) >= n_blocks):
                    yield batch[0][1], _columns(batch, self._counts(batch))
                    batch = []
                batch.append(row)
        if batch:
            yield batch[0][1], _columns(batch, self._counts(batch))

    def _first_block(self, stream: int, index: int) -> int:
        """Return the number of the first block that ends after sample `index` of `stream`: they are in that order."""
        low, high = 1, self.count("block") + 1
        query = "SELECT id, stream, first_index + n_samples FROM block WHERE id >= ? ORDER BY id LIMIT 1"
        with one_line(self.path, "read"):
            while low < high:
                middle = (low + high) // 2
                row = self._db.execute(query, (middle,)).fetchone()
                if row is None or not all(isinstance(value, int) for value in row):
                    raise self._damaged(f"row {middle} of block cannot be read")
                if (row[1], row[2]) > (stream, index):
                    high = middle
                else:
                    low = middle + 1
        return low

    def _counts(self, rows: Sequence[Row]) -> RateCounts:
        """Return the counts of blocks of one form, joined. Raises RecordError if any are none."""
        for number, _, first, n_samples, n_axes, _, _, _, dtype, *_, status, n_lost, data, _ in rows:
            possible = dtype in _DTYPES and n_axes > 0 and min(first, status, n_lost) >= 0
            if not possible or not 0 < len(data) == 4 * n_samples * n_axes <= MAX_BLOCK_BYTES:
                raise self._damaged(f"row {number} of block is no block of samples")
            if (n_axes, dtype) != (rows[0][4], rows[0][8]):
                raise self._damaged(f"row {number} of block has samples of another form than those before")
        data = b"".join(row[-2] for row in rows)
        return np.frombuffer(data, _DTYPES[rows[0][8]]).reshape(-1, rows[0][4])

    def _block(self, row: Row) -> RateBlock:
        counts = self._counts([(*row, 0)])
        _, _, first, _, _, device_time, arrival_time, lsb, _, temperature, x, y, *force, status, n_lost, _ = row
        return RateBlock(
            first_index=first,
            device_time=device_time,
            arrival_time=arrival_time,
            counts=counts,
            rate_lsb=lsb,
            temperature=temperature,
            tilt=None if x is None or y is None else (x, y),
            specific_force=None if None in force else (force[0], force[1], force[2]),
            status=_STATUS.get(status) or GyroStatus(status & _ALL_STATUS),
            n_lost=n_lost,
        )

    def states(self) -> list[StageState]:
        """Return the reported states of the stage in order."""
        try:
            return [
                StageState(
                    device_time=row[2], arrival_time=row[3], mode=StageMode(row[4]), azimuth=_number(row[5]),
                    elevation=_number(row[6]), azimuth_rate=_number(row[7]), elevation_rate=_number(row[8]),
                    in_position=bool(row[9]), fault=row[10],
                )
                for row in self.rows("stage_state")
            ]  # fmt: skip
        except ValueError as error:
            raise self._damaged(f"a state of the stage cannot be: {error}") from None

    def events(self) -> list[tuple[float, str, str]]:
        """Return (time, kind, detail) of what happened, in order; the operator's notes among it as kind "note"."""
        events = [(time, kind, detail) for _, _, time, kind, detail in self.rows("event")]
        notes = self.notes()
        return sorted(events + notes, key=lambda event: event[0]) if notes else events

    def notes(self) -> list[tuple[float, str, str]]:
        """Return (time, "note", text) of the operator's notes, in order."""
        return [(time, "note", text) for _, time, text in self.rows("note")]

    def is_complete(self) -> bool:
        """Return whether the measurement went on to its fix, rather than ending early."""
        return self.count("fix") > 0

    def fixes(self) -> list[Any]:
        """Return what was estimated, oldest first."""
        return [self._decoded(value, f"fix {number}") for number, _, value in self.rows("fix")]


def _is_possible(stated: DwellSpan | StreamInfo) -> bool:
    """Return whether the number of the stream, its sample rate, and all times and angles can be what they say."""
    reals = (getattr(stated, name) for name in stated.__slots__ if isinstance(getattr(stated, name), float))
    rate_can_be = _SAMPLE_RATES[0] <= stated.sample_rate <= _SAMPLE_RATES[1]
    return rate_can_be and 0 <= stated.stream < _MAX_NUMBER and all(abs(real) <= _MAX_REAL for real in reals)


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _columns(rows: Sequence[Row], counts: RateCounts) -> BlockColumns:
    """Return checked rows of blocks as columns."""
    _, _, first, n_samples, _, device_time, _, lsb, _, temperature, x, y, fx, fy, fz, status, _, _, _ = zip(
        *rows, strict=True
    )
    return BlockColumns(
        first_index=np.array(first),
        n_samples=np.array(n_samples),
        device_time=np.array(device_time, dtype=np.float64),
        rate_lsb=np.array(lsb),
        temperature=np.array(temperature, dtype=np.float64),  # None becomes nan
        tilt=np.array((x, y), dtype=np.float64).T,
        specific_force=np.array((fx, fy, fz), dtype=np.float64).T,
        status=np.array(status),
        counts=counts,
    )
