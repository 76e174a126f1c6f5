"""MATLAB's MAT-files of level 5, written one array after the other, without holding any in memory.

Layout after "MAT-File Format", The MathWorks: a header of 128 bytes, then an element of type miMATRIX for each array:

    u32 miMATRIX, u32 bytes | flags: u32 miUINT32, u32 8, u32 class, u32 0 | dimensions: u32 miINT32, u32 8, i32 rows,
    i32 columns | name: u32 miINT8, u32 length, characters, padding to 8 | data: u32 type, u32 bytes, values by columns,
    padding to 8
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import BinaryIO

import numpy as np

from northfinder.errors import RecordError

_MATRIX, _INT8, _INT32, _UINT32 = 14, 1, 5, 6
_CHARACTERS = (4, 4, 2)
#: Of a NumPy dtype: MATLAB's class, type of the data, bytes of a value.
_TYPES = {"f8": (6, 9, 8), "f4": (7, 7, 4), "i4": (12, 5, 4), "i8": (14, 12, 8)}
_MAX_BYTES = 2**31 - 1


def write_header(file: BinaryIO) -> None:
    """Begin a MAT-file."""
    file.write(b"MATLAB 5.0 MAT-file, written by northfinder".ljust(124) + struct.pack("<HH", 0x0100, 0x4D49))


def write_array(file: BinaryIO, name: str, dtype: np.dtype[np.generic], n: int, data: Iterable[bytes]) -> None:
    """Write a column of `n` numbers of `dtype`, whose bytes come in pieces. Raises RecordError if it is too large."""
    _write(file, name, _TYPES[dtype.str[1:]], (n, 1), data)


def write_text(file: BinaryIO, name: str, lines: list[str]) -> None:
    """Write lines of text as a matrix of characters."""
    rows = [np.frombuffer(line.encode("utf-16-le"), "<u2") for line in lines]
    width = max((row.size for row in rows), default=0)
    matrix = np.full((len(rows), width), ord(" "), "<u2")
    for filled, row in zip(matrix, rows, strict=True):
        filled[: row.size] = row
    _write(file, name, _CHARACTERS, (len(lines), width), [matrix.tobytes(order="F")])


def _write(
    file: BinaryIO, name: str, kind: tuple[int, int, int], shape: tuple[int, int], data: Iterable[bytes]
) -> None:
    matlab_class, data_type, size = kind
    n_bytes = size * shape[0] * shape[1]
    title = name.encode("ascii")
    padding = -n_bytes % 8
    total = 16 + 16 + 8 + len(title) + -len(title) % 8 + 8 + n_bytes + padding
    if total > _MAX_BYTES:
        raise RecordError(f"{name} takes {n_bytes / 1e9:.1f} GB, more than a MAT-file holds: export to npz or parquet")
    file.write(struct.pack("<II", _MATRIX, total))
    file.write(struct.pack("<IIII", _UINT32, 8, matlab_class, 0))
    file.write(struct.pack("<IIii", _INT32, 8, *shape))
    file.write(struct.pack("<II", _INT8, len(title)) + title + bytes(-len(title) % 8))
    file.write(struct.pack("<II", data_type, n_bytes))
    file.writelines(data)
    file.write(bytes(padding))
