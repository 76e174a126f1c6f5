"""PDOs in batches: many frames of one PDO at once, decoded by the mapping that the EDS file declares."""

from __future__ import annotations

import canopen
import numpy as np
from canopen.objectdictionary.datatypes import SIGNED_TYPES
from numpy.typing import NDArray


class PdoCodec:
    """Encodes and decodes the frames of one PDO.

    Parameters
    ----------
    pdo
        A PDO of a canopen node; unless it has a mapping already it gets that of the object dictionary.

    Notes
    -----
    A frame is one little-endian number of up to 64 bits (CiA 301, 7.4.7); an object is a span of its bits.
    """

    def __init__(self, pdo: canopen.pdo.PdoMap) -> None:
        if not pdo.map:
            pdo.read(from_od=True)
        self.cob_id = pdo.cob_id or 0
        self.length: int = pdo.length // 8  #: bytes of a frame
        self._spans = {
            (each.index, each.subindex): (_offset(each), each.length, each.od.data_type in SIGNED_TYPES)
            for each in pdo.map
        }

    def decode(self, frames: list[bytes]) -> tuple[dict[tuple[int, int], NDArray[np.int64]], int]:
        """Return each object's values by index and subindex, and how many frames had another length.

        Those frames are left out; the values are in the order of the others.
        """
        whole = [frame for frame in frames if len(frame) == self.length]
        padded = whole if self.length == 8 else [frame.ljust(8, b"\0") for frame in whole]
        numbers = np.frombuffer(b"".join(padded), dtype="<u8")
        values = {key: _field(numbers, *span) for key, span in self._spans.items()}
        return values, len(frames) - len(whole)

    def encode(self, values: dict[tuple[int, int], int]) -> bytes:
        """Return a frame of values by index and subindex; objects not given are 0."""
        number = 0
        for key, value in values.items():
            if key not in self._spans:
                raise KeyError(f"object {key[0]:04X}:{key[1]} is not in this PDO")
            offset, length, _ = self._spans[key]
            number |= (value & (1 << length) - 1) << offset
        return number.to_bytes(self.length, "little")


def _offset(variable: canopen.pdo.PdoVariable) -> int:
    """Return the first bit of an object; the type that canopen declares for it is wrong."""
    offset: object = variable.offset
    return offset if isinstance(offset, int) else 0


def _field(numbers: NDArray[np.uint64], offset: int, length: int, signed: bool) -> NDArray[np.int64]:  # noqa: FBT001  # of a span
    """Return the bits ``offset`` to ``offset + length`` of each number, with their sign if they have one."""
    high = (numbers << np.uint64(64 - offset - length)).view(np.int64)
    if signed:
        return high >> np.int64(64 - length)
    return (high.view(np.uint64) >> np.uint64(64 - length)).view(np.int64)
