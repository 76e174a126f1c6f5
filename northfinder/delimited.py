"""Numbers from a file of comma-separated rows, fast when it is well formed and exact about the place when it is not.

A file is UTF-8 text: ``#`` lines are comments, of which ``# key: value`` is kept as metadata; the first other line
holds the column names; every later line is a row with a number in each wanted column. Reading goes by chunks. A large
chunk of plain decimals goes through a bulk parser; whatever that refuses is read again line by line, which either
accepts it or names the line and the column.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from northfinder.errors import RecordError

MAX_LINE = 65_536  #: bytes; a longer line is no row of a table
MAX_ROWS = 50_000_000
_CHUNK = 1 << 22
_BULK = 1 << 18  #: bytes from which the bulk parser is worth its start
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_COMMA_TO_NEWLINE = bytes.maketrans(b",", b"\n")
_PLAIN_LABEL = re.compile(rb"[A-Za-z_]*")  # shares no byte with a plain decimal

Array = NDArray[np.float64]


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
    while chunk := file.read(_CHUNK):
        chunk += file.readline(MAX_LINE + 1)
        chunk = chunk if chunk.endswith(b"\n") else chunk + b"\n"
        n_here = chunk.count(b"\n")
        bulk = _bulk(chunk, n_here, len(header.names), label) if len(chunk) >= _BULK else None
        runs = _lines(chunk, n_lines, header.names, wanted, label) if bulk is None else [(bulk[0], bulk[1][wanted])]
        for name, columns in runs:
            n_rows += columns.shape[1]
            yield name, columns
        if n_rows > MAX_ROWS:
            raise RecordError(f"the file has more than {MAX_ROWS} rows")
        n_lines += n_here


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


def _bulk(chunk: bytes, n_rows: int, n_columns: int, label: int | None) -> tuple[str, Array] | None:
    """Return label and columns, shape (n_columns, n_rows), of a chunk of plain decimals of one label; None for another.

    The parser behind `scipy.io.mmread` is the fastest at hand, but it ends a number quietly at what it does not know
    and skips empty lines. So what is left of the chunk without digits and signs must be that of regular rows, no field
    with two points; each sign must begin its field; and an empty field is missed in the count of numbers.
    """
    from scipy.io import mmread  # noqa: PLC0415  # dear to import, and only large files need it

    if b"\r" in chunk:
        chunk = chunk.replace(b"\r\n", b"\n")
    first = chunk[: chunk.index(b"\n")].split(b",")
    name = b"" if label is None or len(first) <= label else first[label]
    row = b",".join(name if i == label else b"" for i in range(n_columns)) + b"\n"
    skeleton = chunk.translate(None, b"0123456789-")
    if not _PLAIN_LABEL.fullmatch(name) or b".." in skeleton or skeleton.translate(None, b".") != row * n_rows:
        return None
    data = np.frombuffer(b"\n" + chunk, dtype=np.uint8)
    if np.any(data[np.flatnonzero(data == ord("-")) - 1] > ord(",")):  # what may stand there is "," or a line's end
        return None
    head = f"%%MatrixMarket matrix array real general\n{n_columns - bool(name)} {n_rows}\n".encode()
    try:
        columns = mmread(io.BytesIO(head + chunk.translate(_COMMA_TO_NEWLINE, name)))
    except ValueError:
        return None
    if not np.isfinite(columns).all():
        return None
    if name and label is not None:
        columns = np.insert(columns, label, 0.0, axis=0)
    return name.decode(), columns
