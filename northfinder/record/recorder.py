"""Writing the record of a measurement: everything is handed to a thread of its own, so that no disk holds up the bench.

A stage stops by itself when its host is silent for a quarter of a second, which is nothing to a disk that is busy.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from drivers.api import DeviceIdentity, RateBlock, StageState
from northfinder.errors import RecordError
from northfinder.record import writer
from northfinder.record.reader import CLOSED, DwellSpan, Record
from northfinder.record.schema import MAX_BLOCK_BYTES, TABLES, Row, sealed
from northfinder.text import json_text

#: What has arrived is handed to the file at least this often, in s.
WRITE_PERIOD = 0.1
#: What a row takes beside its counts, a state of the stage, how often one comes, and what a record takes besides.
_ROW_BYTES, _STATE_BYTES, _STATES_PER_S, _OTHER_BYTES = 110, 110, 10.0, 24_000_000
#: The shortest block that a gyro is expected to send, in samples; shorter ones take more room.
_BLOCK_SAMPLES = 20


class Recorder:
    """Writes a record. Use as a context manager; whatever ends the block, the record is closed."""

    def __init__(
        self, path: Path, now: Callable[[], float], *, clock: Callable[[], float] | None = None, resume: bool = False
    ) -> None:
        """Create the file `path`, which must not exist, or with `resume` go on with it. Raises RecordError.

        `now` tells the date in s since 1970, `clock` a time that never goes back, by default the same.
        """
        self.path = path
        self.now = now  #: the date in s since 1970
        self._clock = clock or now
        self._pending: dict[str, list[Row]] = {"block": [], "stage_state": []}
        self._pending_bytes = 0
        self._next_write = self._clock() + WRITE_PERIOD
        self._closed = False
        self.n_samples = 0
        self.n_lost = 0
        self.stream = 0  #: number of the gyro's stream that is being recorded
        self.resumed = resume  #: whether it goes on with what was interrupted
        self._next_row = dict.fromkeys(TABLES, 1)
        opened = writer.reopen(path) if resume else writer.create(path)
        self._writer = writer.Writer(path, opened)
        self._writer.start()
        if resume:
            self._go_on()

    def _go_on(self) -> None:
        """Count on from what the record holds, now that nobody else writes it. Raises RecordError."""
        try:
            with Record(self.path) as record:
                self.n_samples, self.n_lost = record.totals()
                self._next_row = {table: record.count(table) + 1 for table in TABLES}
                self.stream = max((info.stream for info in record.streams()), default=-1) + 1
        except RecordError:
            self._closed = True
            self._writer.close()
            raise

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

    @property
    def delay(self) -> float:
        """For how long the disk has been busy with what it was given, in s."""
        return self._writer.delay

    def require_space(self, duration: float, sample_rate: float, n_axes: int) -> None:
        """Raise RecordError unless the disk has room for `duration` s of a gyro with this rate, in Hz, and axes."""
        needed = expected_bytes(duration, sample_rate, n_axes)
        try:
            free = shutil.disk_usage(self.path.parent).free
        except OSError:  # it cannot be told; what does not fit is said when it is written
            return
        if free < needed:
            raise RecordError(
                f"the disk of {self.path.parent} has {free / 1e6:.0f} MB free, the record of this plan takes up to "
                f"{needed / 1e6:.0f} MB: make room, or record elsewhere with --out"
            )

    def set_meta(self, key: str, value: object) -> None:
        """Keep `value`, anything that can be JSON, under `key`."""
        self._put("meta", key, json_text(value))

    def begin_stream(
        self, identities: Mapping[str, DeviceIdentity], *, sample_rate: float, n_axes: int, software: str = ""
    ) -> None:
        """Keep that the gyro starts a stream now, and from what."""
        value = json_text(dict(identities))
        self._put("stream", self.stream, self.now(), self._clock(), sample_rate, n_axes, value, software)

    def add_block(self, block: RateBlock) -> None:
        """Keep a block of samples; of at most MAX_BLOCK_BYTES, see `parts`."""
        counts = np.ascontiguousarray(block.counts)
        data = counts.astype(counts.dtype.newbyteorder("<"), copy=False).tobytes()
        if len(data) > MAX_BLOCK_BYTES:
            raise RecordError(f"a block of {len(data)} bytes is too long for a record: at most {MAX_BLOCK_BYTES}")
        dtype = "<f4" if counts.dtype.kind == "f" else "<i4"
        tilt = block.tilt if block.tilt is not None else (None, None)
        force = block.specific_force if block.specific_force is not None else (None, None, None)
        self._keep(
            "block", self.stream, block.first_index, counts.shape[0], counts.shape[1], block.device_time,
            block.arrival_time, block.rate_lsb, dtype, block.temperature, *tilt, *force, block.status, block.n_lost,
            data,
        )  # fmt: skip
        self._pending_bytes += len(data)
        self.n_samples += counts.shape[0]
        self.n_lost += block.n_lost
        self._write_if_due()

    def add_state(self, state: StageState) -> None:
        """Keep a reported state of the stage."""
        self._keep(
            "stage_state", self.stream, state.device_time, state.arrival_time, state.mode.value, state.azimuth,
            state.elevation, state.azimuth_rate, state.elevation_rate, state.in_position, state.fault,
        )  # fmt: skip
        self._write_if_due()

    def add_step(self, span: DwellSpan) -> None:
        """Keep a finished dwell."""
        self._put("step", *(getattr(span, name) for name in DwellSpan.__slots__))

    def add_event(self, kind: str, detail: str = "") -> None:
        """Keep that something happened now."""
        self._put("event", self.stream, self.now(), kind, detail)

    def add_fix(self, value: object) -> None:
        """Keep what was estimated."""
        self._put("fix", self.now(), json_text(value))

    def _row(self, table: str, *values: Any) -> Row:  # noqa: ANN401  # whatever the columns hold
        row = sealed(table, self._next_row[table], values)
        self._next_row[table] += 1
        return row

    def _keep(self, table: str, *values: Any) -> None:  # noqa: ANN401  # whatever the columns hold
        self._pending[table].append(self._row(table, *values))

    def _put(self, table: str, *values: Any) -> None:  # noqa: ANN401  # whatever the columns hold
        """Hand over one row, after all that came before it."""
        self.write()
        self._writer.put([(table, [self._row(table, *values)])])

    def _write_if_due(self) -> None:
        if self._clock() >= self._next_write:
            self.write()

    def write(self) -> None:
        """Hand over to the file all that has arrived. Raises RecordError if it has failed to take what came before."""
        self._next_write = self._clock() + WRITE_PERIOD
        batches = [(table, rows) for table, rows in self._pending.items() if rows]
        n_bytes, self._pending_bytes = self._pending_bytes, 0
        self._pending = {table: [] for table in self._pending}
        if batches:
            self._writer.put(batches, n_bytes)

    def flush(self) -> None:
        """Wait until the file holds all that has arrived. Raises RecordError."""
        self.write()
        self._writer.flush()

    def close(self) -> None:
        """Write what is left and make one file of the record. Closing twice is no error. Raises RecordError."""
        if self._closed:
            return
        self._closed = True
        try:
            self.set_meta(CLOSED, {table: number - 1 for table, number in self._next_row.items()} | {"note": 0})
            self.flush()
        finally:
            self._writer.close()


def expected_bytes(duration: float, sample_rate: float, n_axes: int) -> int:
    """Return the most that the record of `duration` s takes, at a sample rate in Hz."""
    per_s = sample_rate * (4 * n_axes + _ROW_BYTES / _BLOCK_SAMPLES) + _STATES_PER_S * _STATE_BYTES
    return round(1.1 * duration * per_s) + _OTHER_BYTES


def parts(block: RateBlock, sample_rate: float) -> Iterator[RateBlock]:
    """Yield the block in parts that a record takes; nearly always that is the block itself."""
    n_samples, n_axes = block.counts.shape
    most = MAX_BLOCK_BYTES // (4 * n_axes)
    if n_samples <= most:
        yield block
        return
    for k in range(math.ceil(n_samples / most)):
        first = k * most
        yield replace(
            block,
            first_index=block.first_index + first,
            device_time=block.device_time + first / sample_rate,
            counts=block.counts[first : first + most],
            n_lost=0 if k else block.n_lost,
        )
