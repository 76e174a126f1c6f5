"""Rows of a record found in its pages, whatever has become of the file around them.

SQLite finds a row by its way down a tree, so one bad page may hide thousands of good rows. Here every page of the file
and of its write-ahead log is searched for whatever looks like the head of a row (https://www.sqlite.org/fileformat2.html,
sections 1.6 and 2.1), and what its seal proves to be one is yielded. No header, tree or pointer is relied on but the
chain of a row that is longer than a page. Files are only read, a page at a time.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from northfinder.errors import RecordError
from northfinder.record.files import has_log, log_of
from northfinder.record.schema import MAX_ROW_BYTES, PAGE_SIZE, TABLES, Row, is_sound

_WAL_HEADER, _FRAME_HEADER = 32, 24  # bytes
#: Pages of a log that are remembered for long rows: many times what a recorder lets it grow to.
_MAX_FRAMES = 100_000
#: A row's header begins with its size, then nothing in place of its number, which stands before it.
_HEAD = re.compile(rb"(?=([\x05-\x30])\x00)")
_INTEGER_BYTES = {0: 0, 1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8, 8: 0, 9: 0}
_BY_LENGTH = {
    length: tuple(table for table in TABLES if len(TABLES[table]) + 2 == length)
    for length in {len(columns) + 2 for columns in TABLES.values()}
}
_MAX_LOCAL = PAGE_SIZE - 35
_MIN_LOCAL = (PAGE_SIZE - 12) * 32 // 255 - 23

#: Returns the content of a page by its number, b"" if there is none.
FetchPage = Callable[[int], bytes]


def scan(path: Path) -> Iterator[tuple[str, Row]]:
    """Yield (table, row) of all sound rows in the file `path` and its log, in the order of the pages.

    A row may come several times; of a file that is gone its log alone is read. Raises RecordError if they cannot be.
    """
    logged = has_log(path)
    try:
        with BytesIO() if logged and not path.exists() else path.open("rb") as file:
            if not logged:
                yield from _scan_file(file, _fetcher(file, None, {}))
                return
            with log_of(path).open("rb") as wal:
                fetch = _fetcher(file, wal, _frames(wal))
                yield from _scan_file(file, fetch)
                yield from _scan_log(wal, fetch)
    except OSError as error:
        raise RecordError(f"{path}: cannot be read: {error.strerror}") from None


def _scan_file(file: BinaryIO, fetch: FetchPage) -> Iterator[tuple[str, Row]]:
    offset = 0
    while page := _read(file, offset, PAGE_SIZE):
        yield from rows_of_page(page, fetch)
        offset += PAGE_SIZE


def _scan_log(wal: BinaryIO, fetch: FetchPage) -> Iterator[tuple[str, Row]]:
    offset = _WAL_HEADER
    while frame := _read(wal, offset, _FRAME_HEADER + PAGE_SIZE):
        yield from rows_of_page(frame[_FRAME_HEADER:], fetch)
        offset += _FRAME_HEADER + PAGE_SIZE


def _read(file: BinaryIO, offset: int, size: int) -> bytes:
    file.seek(offset)
    return file.read(size)


def _frames(wal: BinaryIO) -> dict[int, int]:
    """Return where in the log the newest content of each page stands."""
    found: dict[int, int] = {}
    for number in range(_MAX_FRAMES):
        offset = _WAL_HEADER + number * (_FRAME_HEADER + PAGE_SIZE)
        head = _read(wal, offset, 4)
        if len(head) < 4:
            break
        found[int.from_bytes(head, "big")] = offset + _FRAME_HEADER
    return found


def _fetcher(file: BinaryIO, wal: BinaryIO | None, frames: dict[int, int]) -> FetchPage:
    n_pages = -(-file.seek(0, os.SEEK_END) // PAGE_SIZE)

    def fetch(number: int) -> bytes:
        if wal is not None and number in frames:
            return _read(wal, frames[number], PAGE_SIZE)
        return _read(file, (number - 1) * PAGE_SIZE, PAGE_SIZE) if 1 <= number <= n_pages else b""

    return fetch


def rows_of_page(page: bytes, fetch: FetchPage) -> Iterator[tuple[str, Row]]:
    """Yield (table, row) of all sound rows that begin in `page`."""
    end = 0
    for head in _HEAD.finditer(page):
        start = head.start()
        if start < end:  # inside the row before
            continue
        for table in _tables(page, start):
            payload, size = _payload(page, start, fetch)
            row = _decode(table, payload, _number(page, start))
            if row is not None and is_sound(table, row):
                end = start + min(size, _local(size))
                yield table, row


def _tables(page: bytes, start: int) -> tuple[str, ...]:
    """Return which tables a row of as many columns may be of; none if it cannot be one."""
    position, stop, n_columns = start + 1, start + page[start], 0
    while position < stop and position < len(page):
        n_columns += page[position] < 0x80
        position += 1
    return _BY_LENGTH.get(n_columns, ()) if position == stop else ()


def _number(page: bytes, start: int) -> int:
    """Return the row's number: the variable-length integer that ends where the header begins."""
    first = start - 1
    while first > 0 and page[first - 1] >= 0x80 and start - first < 8:
        first -= 1
    number = 0
    for byte in page[max(first, 0) : start]:
        number = number << 7 | byte & 0x7F
    return number


def _serial_types(data: bytes) -> list[int]:
    """Return the serial types of a row's header."""
    types, value = [], 0
    for byte in data[1 : data[0]]:
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            types.append(value)
            value = 0
    return types


def _size(serial_type: int) -> int:
    """Return how many bytes a value takes; more than any row has if it cannot be one."""
    if serial_type >= 12:
        return (serial_type - 12) // 2
    return 8 if serial_type == 7 else _INTEGER_BYTES.get(serial_type, MAX_ROW_BYTES)


def _local(size: int) -> int:
    """Return how much of a row stands in the page where it begins."""
    if size <= _MAX_LOCAL:
        return size
    local = _MIN_LOCAL + (size - _MIN_LOCAL) % (PAGE_SIZE - 4)
    return local if local <= _MAX_LOCAL else _MIN_LOCAL


def _payload(page: bytes, start: int, fetch: FetchPage) -> tuple[bytes, int]:
    """Return header and values of a row, and how long they should be; b"" if they are not there."""
    size = page[start] + sum(map(_size, _serial_types(page[start : start + page[start]])))
    local = _local(size)
    if size >= MAX_ROW_BYTES or start + local > len(page):
        return b"", size
    if local == size:
        return page[start : start + size], size
    data, following = bytearray(page[start : start + local]), page[start + local : start + local + 4]
    while len(data) < size and len(following) == 4:
        part = fetch(int.from_bytes(following, "big"))
        if len(part) < 4:
            return b"", size
        following = part[:4]
        data += part[4 : 4 + size - len(data)]
    return bytes(data), size


def _decode(table: str, payload: bytes, number: int) -> Row | None:
    """Return the row that `payload` holds, None if it cannot be one of this table."""
    if not payload:
        return None
    position = payload[0]
    values: list[object] = []
    kinds = ["INTEGER", *(column.kind for column in TABLES[table]), "INTEGER"]
    for kind, serial_type in zip(kinds, _serial_types(payload), strict=True):
        size = _size(serial_type)
        data = payload[position : position + size]
        if len(data) < size:
            return None
        position += size
        if serial_type == 0:
            values.append(None)
        elif serial_type >= 12:
            if (kind == "TEXT") != bool(serial_type % 2) or kind not in {"TEXT", "BLOB"}:
                return None
            values.append(data.decode(errors="replace") if kind == "TEXT" else data)
        else:
            value = _numeric(serial_type, data)
            values.append(float(value) if kind == "REAL" else value)
    return (number, *values[1:])


def _numeric(serial_type: int, data: bytes) -> float:
    if serial_type == 7:
        value: float = struct.unpack(">d", data)[0]
        return value
    return serial_type - 8 if serial_type in {8, 9} else int.from_bytes(data, "big", signed=True)
