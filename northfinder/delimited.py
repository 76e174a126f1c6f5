"""Numbers from a file of comma-separated rows, fast when it is well formed and exact about the place when it is not.

A file is UTF-8 text: ``#`` lines are comments, of which ``# key: value`` is kept as metadata; the first other line
holds the column names; every later line is a row with a number in each wanted column. Reading goes by chunks, on all
processors. A chunk of regular rows goes through Arrow; whatever that refuses is read again line by line, which either
accepts it or names the line and the column.
"""

from __future__ import annotations

import math
import os
import re
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
from numpy.typing import NDArray

from northfinder.errors import RecordError

if TYPE_CHECKING:
    from pyarrow import DictionaryArray

MAX_LINE = 65_536  #: bytes; a longer line is no row of a table
MAX_ROWS = 50_000_000
_CHUNK = 1 << 22  #: bytes that a processor takes at a time
_BULK = 1 << 18  #: bytes from which the bulk parser is worth its start
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)

Array = NDArray[np.float64]
#: Consecutive rows with one label: the label, and the wanted columns, shape (len(wanted), n).
Run = tuple[str, Array]


@dataclass(frozen=True, slots=True)
class Header:
    """What stands above the rows."""

    names: tuple[str, ...]
    metadata: dict[str, str]
    n_lines: int  #: lines up to and with the column names


def read_header(file: BinaryIO) -> Header:
    """Read comments and column names, and leave `file` at the first row.

    Raises
    ------
    RecordError
        If there is no line of column names, or it is no text.
    """
    metadata: dict[str, str] = {}
    n_lines = 0
    while raw := file.readline(MAX_LINE + 1):
        n_lines += 1
        text = _text(raw.removeprefix(b"\xef\xbb\xbf") if n_lines == 1 else raw, n_lines)
        if text.startswith("#"):
            key, colon, value = text.lstrip("# ").partition(":")
            if colon:
                metadata.setdefault(key.strip(), value.strip())
        elif text:
            return Header(_names(text), metadata, n_lines)
    raise RecordError("the file is empty" if not n_lines else "the file has comments only, no column names and no rows")


def read_rows(
    file: BinaryIO, header: Header, wanted: Sequence[int], label: int | None = None
) -> Iterator[tuple[str, Array]]:
    """Yield runs of consecutive rows that carry the same label.

    Parameters
    ----------
    file
        Open at the first row, as `read_header` leaves it.
    header
        What `read_header` returned.
    wanted
        Indices of the columns to return.
    label
        Index of the column with the label of a row; without one all labels are empty.

    Yields
    ------
    tuple
        The label and the columns, shape (len(wanted), n). A long run comes in several pieces.

    Raises
    ------
    RecordError
        For the first row that does not hold a finite number in each wanted column.
    """
    n_lines, n_rows = header.n_lines, 0
    for chunk, bulk in _parsed(file, header.names, wanted, label):
        for name, columns in _lines(chunk, n_lines, header.names, wanted, label) if bulk is None else bulk:
            n_rows += columns.shape[1]
            yield name, columns
        if n_rows > MAX_ROWS:
            raise RecordError(f"the file has more than {MAX_ROWS} rows")
        n_lines += chunk.count(b"\n")


def _parsed(
    file: BinaryIO, names: Sequence[str], wanted: Sequence[int], label: int | None
) -> Iterator[tuple[bytes, list[Run] | None]]:
    """Yield the chunks in order, each with what `_bulk` says of it; some are read ahead, one a processor."""
    n_ahead = os.cpu_count() or 1
    with ThreadPoolExecutor(n_ahead) as pool:
        ahead: deque[tuple[bytes, Future[list[Run] | None]]] = deque()
        while chunk := _whole_lines(file):
            ahead.append((chunk, pool.submit(_bulk_if_large, chunk, names, wanted, label)))
            if len(ahead) > n_ahead:
                chunk, bulk = ahead.popleft()
                yield chunk, bulk.result()
        yield from ((chunk, bulk.result()) for chunk, bulk in ahead)


def _whole_lines(file: BinaryIO) -> bytes:
    """Return about _CHUNK bytes that end with a line, none at the end of the file."""
    start = file.tell()
    file.seek(start + _CHUNK)
    file.readline(MAX_LINE + 1)
    end = file.tell()
    file.seek(start)
    chunk = file.read(end - start)  # at once: these are too many bytes to copy once more
    return chunk + b"\n" if chunk and not chunk.endswith(b"\n") else chunk


def shown(text: str) -> str:
    """Return `text` quoted, short and printable, for a message."""
    return repr(text if len(text) <= 40 else text[:37] + "...")


def _text(raw: bytes, line: int) -> str:
    if len(raw) > MAX_LINE:
        raise RecordError(f"line {line} is longer than {MAX_LINE} bytes, no row of a table")
    if b"\0" in raw:
        raise RecordError(f"line {line} holds a zero byte: the file is binary or not UTF-8, expected CSV text")
    try:
        return raw.decode().strip()
    except UnicodeDecodeError as error:
        raise RecordError(f"line {line} is not UTF-8 text (byte 0x{raw[error.start]:02x})") from None


def _fields(text: str) -> list[str]:
    return [field.strip().strip('"') for field in text.split(",")]


def _names(text: str) -> tuple[str, ...]:
    for separator, name in ((";", "semicolons"), ("\t", "tabs")):
        if separator in text and "," not in text:
            raise RecordError(f"the columns are separated by {name}, expected commas")
    return tuple(_fields(text.lower()))


def _lines(
    chunk: bytes, n_before: int, names: Sequence[str], wanted: Sequence[int], label: int | None
) -> Iterator[tuple[str, Array]]:
    rows: list[tuple[str, list[float]]] = []
    for line, raw in enumerate(chunk[:-1].split(b"\n"), n_before + 1):
        text = _text(raw, line)
        if not text or text.startswith("#"):
            continue
        fields = _fields(text)
        if len(fields) != len(names):
            raise RecordError(f"line {line} has {len(fields)} columns, expected {len(names)} as in the line of names")
        numbers = [_number(fields[i], line, names[i]) for i in wanted]
        rows.append(("" if label is None else fields[label], numbers))
    for name, run in groupby(rows, key=lambda row: row[0]):
        yield name, np.array([numbers for _, numbers in run], dtype=np.float64).T


def _number(field: str, line: int, column: str) -> float:
    if not _NUMBER.fullmatch(field) or not math.isfinite(float(field)):
        found = shown(field) if field else "nothing"
        raise RecordError(f"line {line}, column {shown(column)}: found {found}, expected a finite number")
    return float(field)


def _bulk_if_large(chunk: bytes, names: Sequence[str], wanted: Sequence[int], label: int | None) -> list[Run] | None:
    return _bulk(chunk, names, wanted, label) if len(chunk) >= _BULK else None


def _bulk(chunk: bytes, names: Sequence[str], wanted: Sequence[int], label: int | None) -> list[Run] | None:
    """Return the runs of a chunk of regular rows, as `_lines` would; None if a row is not regular.

    Arrow takes some things for rows or numbers that are none here: those are looked for, and left to `_lines`.
    """
    import pyarrow as pa  # noqa: PLC0415  # dear to import, and only large files need it
    from pyarrow import csv  # noqa: PLC0415

    if b"#" in chunk or b"\0" in chunk or (b"\r" in chunk and chunk.count(b"\r") != chunk.count(b"\r\n")):
        return None
    columns = [str(i) for i in range(len(names))]
    types = {columns[i]: pa.float64() for i in wanted}
    if label is not None:
        types[columns[label]] = pa.dictionary(pa.int32(), pa.string())
    try:
        table = csv.read_csv(
            pa.BufferReader(chunk),
            csv.ReadOptions(column_names=columns, block_size=len(chunk) + 1, use_threads=False),
            csv.ParseOptions(quote_char=False),
            csv.ConvertOptions(include_columns=list(types), column_types=types, null_values=[]),
        )
    except pa.ArrowInvalid:
        return None
    runs: list[Run] = []
    for batch in table.to_batches():
        # By DLPack: to_numpy would import pandas.
        numbers = np.array([np.from_dlpack(batch.column(columns[i])) for i in wanted])
        if not math.isfinite(numbers.sum()) and not np.isfinite(numbers).all():
            return None
        runs += [("", numbers)] if label is None else _labelled(numbers, batch.column(columns[label]))
    return runs


def _labelled(numbers: Array, labels: DictionaryArray) -> Iterator[Run]:
    """Yield the runs of rows of the same label."""
    texts = [text.strip().strip('"') for text in labels.dictionary.to_pylist()]
    codes = np.from_dlpack(labels.indices)
    edges = np.flatnonzero(codes[1:] != codes[:-1]) + 1
    for part, first in zip(np.split(numbers, edges, axis=1), [0, *edges.tolist()], strict=True):
        yield texts[codes[first]], part
