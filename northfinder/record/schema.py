"""The layout of a record, as data: its tables, the units of their columns, and the seal on every row.

A row is sealed with the CRC-32C over the name of its table and all its values, number included, in MessagePack. So a
row that is altered anywhere, or taken for one of another table, is known by itself: SQLite need not vouch for it, and
`pages` finds rows in a file that SQLite cannot open. Numbers run from 1 without a gap, and nothing is ever
changed or deleted; a missing number is a lost row. docs/record.md describes every column.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import fastcrc
import msgspec

from northfinder.errors import RecordError

#: "NFR1" in the file's header tells a record from any other SQLite file.
APPLICATION_ID = 0x4E465231
SCHEMA_VERSION = 1
#: Size of the database's pages in bytes: large enough to waste little between blocks, small enough to be lost.
PAGE_SIZE = 8192
#: The counts of one row hold at most this many bytes; the recorder cuts longer blocks.
MAX_BLOCK_BYTES = 1 << 15
#: No row is larger than this; SQLite is told so, and reads no more.
MAX_ROW_BYTES = 1 << 22

Kind = Literal["INTEGER", "REAL", "TEXT", "BLOB"]
Row = tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class Column:
    """One column: its name, SQLite's type, and the unit of its values."""

    name: str
    kind: Kind
    unit: str = ""
    optional: bool = False  #: whether a row may have no value there: it was not measured, or is no number


def _columns(text: str) -> tuple[Column, ...]:
    """Return columns written as ``name KIND unit`` a line, with a ``?`` after the kind of those that are optional."""
    parts = (line.split() for line in text.strip().splitlines())
    return tuple(
        Column(name, kind.rstrip("?"), "".join(unit), kind.endswith("?"))  # type: ignore[arg-type]  # words of ours
        for name, kind, *unit in parts
    )


#: The columns of each table; before them stands ``id``, after them ``crc``.
TABLES: dict[str, tuple[Column, ...]] = {
    "meta": _columns("""
        key TEXT
        value TEXT"""),
    "stream": _columns("""
        stream INTEGER
        utc REAL s
        clock REAL s
        sample_rate REAL Hz
        n_axes INTEGER
        identities TEXT
        software TEXT"""),
    "block": _columns("""
        stream INTEGER
        first_index INTEGER
        n_samples INTEGER
        n_axes INTEGER
        device_time REAL s
        arrival_time REAL s
        rate_lsb REAL rad/s
        dtype TEXT
        temperature REAL? degC
        tilt_x REAL? rad
        tilt_y REAL? rad
        specific_force_x REAL? m/s^2
        specific_force_y REAL? m/s^2
        specific_force_z REAL? m/s^2
        status INTEGER
        n_lost INTEGER
        counts BLOB"""),
    "stage_state": _columns("""
        stream INTEGER
        device_time REAL s
        arrival_time REAL s
        mode TEXT
        azimuth REAL? rad
        elevation REAL? rad
        azimuth_rate REAL? rad/s
        elevation_rate REAL? rad/s
        in_position INTEGER
        fault TEXT"""),
    "step": _columns("""
        step INTEGER
        name TEXT
        azimuth REAL rad
        elevation REAL rad
        dwell REAL s
        measured_azimuth REAL rad
        measured_elevation REAL rad
        first_index INTEGER
        stop_index INTEGER
        sample_rate REAL Hz
        stream INTEGER
        stream_start REAL s
        turn_on INTEGER"""),
    "event": _columns("""
        stream INTEGER
        time REAL s
        kind TEXT
        detail TEXT"""),
    "note": _columns("""
        time REAL s
        text TEXT"""),
    "fix": _columns("""
        time REAL s
        value TEXT"""),
}


def _create(table: str) -> str:
    columns = ", ".join(f"{column.name} {column.kind}" for column in TABLES[table])
    return f"CREATE TABLE {table} (id INTEGER PRIMARY KEY, {columns}, crc INTEGER NOT NULL);"


SCHEMA = "\n".join(map(_create, TABLES))
#: The statement that adds a sealed row to each table.
INSERT = {table: f"INSERT INTO {table} VALUES ({', '.join('?' * (len(TABLES[table]) + 2))})" for table in TABLES}  # noqa: S608  # names of ours
#: The columns of each table in order, for SELECT.
NAMES = {table: ", ".join(("id", *(column.name for column in TABLES[table]), "crc")) for table in TABLES}


def _integer(value: Any) -> int:  # noqa: ANN401  # whatever a driver says
    number = int(value)
    if not -(1 << 63) <= number < 1 << 63:
        raise RecordError(f"the number {number} is too large for a record")
    return number


def _real(value: Any) -> float | None:  # noqa: ANN401  # whatever a driver says
    """Return a float as SQLite gives it back: it keeps no negative zero, and no number for one that is none."""
    number = float(value)
    return number + 0.0 if number == number else None  # noqa: PLR0124  # false for nan alone


def _text(value: str) -> str:
    """Return a text that is Unicode, whatever it held."""
    return value if value.isascii() else value.encode(errors="replace").decode()


_CASTS: dict[Kind, Callable[[Any], Any]] = {"INTEGER": _integer, "REAL": _real, "TEXT": _text, "BLOB": bytes}
_TABLE_CASTS = {table: tuple(_CASTS[column.kind] for column in columns) for table, columns in TABLES.items()}
_TYPES: dict[Kind, type] = {"INTEGER": int, "REAL": float, "TEXT": str, "BLOB": bytes}
_TABLE_TYPES = {
    table: tuple({_TYPES[column.kind]} | ({type(None)} if column.optional else set()) for column in columns)
    for table, columns in TABLES.items()
}
_encode = msgspec.msgpack.Encoder().encode


def checksum(table: str, values: Iterable[Any]) -> int:
    """Return the seal of a row: the CRC-32C of its table's name, its number and its values."""
    return int(fastcrc.crc32.iscsi(_encode((table, *values))))


def sealed(table: str, number: int, values: Iterable[Any]) -> Row:
    """Return the row as it is kept: number, values in their kinds, checksum. Raises RecordError for what cannot be."""
    cast = _TABLE_CASTS[table]
    row = (number, *(None if v is None else c(v) for c, v in zip(cast, values, strict=True)))
    if None in row:
        _check_values(table, row)
    return (*row, checksum(table, row))


def _check_values(table: str, row: Row) -> None:
    """Raise RecordError if a value is missing that must be there."""
    for column, value in zip(TABLES[table], row[1:], strict=True):
        if value is None and not column.optional:
            raise RecordError(f"{column.name} of {table} has no value, or is no number: it cannot be recorded")


def is_sound(table: str, row: Row) -> bool:
    """Return whether a row is one of this table, as it was written."""
    return are_sound(table, [row])


def are_sound(table: str, rows: Sequence[Row]) -> bool:
    """Return whether every row, of equally many values, is one of this table, as it was written."""
    *columns, checksums = zip(*rows, strict=True)
    if len(columns) != len(_TABLE_TYPES[table]) + 1 or set(map(type, columns[0])) != {int}:
        return False
    if not all(set(map(type, c)) <= allowed for c, allowed in zip(columns[1:], _TABLE_TYPES[table], strict=True)):
        return False
    return [checksum(table, row[:-1]) for row in rows] == list(checksums)
