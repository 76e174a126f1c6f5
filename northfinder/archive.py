r"""Arrays of numbers from a NumPy archive (NPZ), never running what it holds.

An archive is a ZIP file of NPY members: ``\x93NUMPY``, version (two bytes), length of the head (u16 in version 1, u32
in version 2), the head as text, then the numbers. Only heads of plain numbers are understood, by their pattern alone,
and no array is larger than what is really there.
"""

from __future__ import annotations

import math
import re
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from northfinder.delimited import shown
from northfinder.errors import RecordError

MAX_BYTES = 1 << 30  #: of all arrays
MAX_ARRAYS = 1000
_MAGIC = b"\x93NUMPY"
_HEAD = re.compile(
    rb"\{'descr': '([<>|](?:[iu][1248]|f[248]))', 'fortran_order': (True|False),"
    rb" 'shape': \(((?:\d{1,12},? ?){0,8})\), \}\s*"
)
_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)

Numbers = NDArray[Any]


def read_arrays(path: Path) -> dict[str, Numbers]:
    """Return the arrays of whole or real numbers by name; others are left out.

    Raises RecordError if the file is no such archive, is damaged, or is larger than any recording.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            if len(members) > MAX_ARRAYS or sum(member.file_size for member in members) > MAX_BYTES:
                raise RecordError(f"holds more than {MAX_ARRAYS} arrays or {MAX_BYTES} bytes, no recording")
            found = {member.filename.removesuffix(".npy"): _array(archive, member) for member in members}
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError) as error:
        raise RecordError(f"is no sound NumPy archive: {str(error) or 'it ends too early'}") from None
    return {name: array for name, array in found.items() if array is not None}


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> Numbers | None:
    """Return the array of a member, None if it holds anything but numbers."""
    if member.compress_type not in _COMPRESSIONS:
        raise RecordError(f"{shown(member.filename)} is compressed in a way that NumPy does not use")
    with archive.open(member) as file:
        preamble = file.read(len(_MAGIC) + 2)
        length = int.from_bytes(file.read(2 if preamble.endswith(b"\1\0") else 4), "little")
        if preamble not in {_MAGIC + b"\1\0", _MAGIC + b"\2\0"}:
            raise RecordError(f"{shown(member.filename)} is no NumPy array")
        head = _HEAD.fullmatch(file.read(length))
        if head is None:
            return None
        data = file.read()
    dtype = np.dtype(head[1].decode())
    shape = tuple(int(part) for part in head[3].replace(b",", b" ").split())
    if len(data) != math.prod(shape) * dtype.itemsize:
        raise RecordError(f"array {shown(member.filename)} does not have the size that its head declares")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if head[2] == b"True" else "C")
