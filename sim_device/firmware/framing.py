"""Frames of the native protocol: ``COBS(body || crc) 00``, see ``docs/protocol.md`` section 1.

>>> frame(bytes([0, 65])).hex()
'0106416de9714200'
"""

import array
import struct

MAX_BODY = 512
MAX_ENCODED = 519  # COBS of the longest body and its CRC, without the 00
_FULL = 254  # bytes of a COBS group that ends without a zero


def _crc_table() -> list[int]:
    """Return the table of CRC-32C (Castagnoli), reflected polynomial 82F63B78, for one byte at a time."""
    table = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0x82F63B78 if crc & 1 else 0)
        table.append(crc)
    return table


_CRC_TABLE = array.array("I", _crc_table())


def crc32c(data: bytes) -> int:
    """Return the CRC-32C of `data`."""
    table = _CRC_TABLE
    crc = 0xFFFFFFFF
    for byte in data:
        crc = table[(crc ^ byte) & 0xFF] ^ (crc >> 8)
    return crc ^ 0xFFFFFFFF


def cobs_encode(data: bytes) -> bytes:
    """Return `data` rid of its zeros: groups of up to 254 bytes after a length byte, which stands for a zero behind."""
    out = bytearray()
    rest = b""
    for run in data.split(b"\x00"):
        n_full = len(run) // _FULL
        for start in range(0, n_full * _FULL, _FULL):
            out.append(_FULL + 1)
            out += run[start : start + _FULL]
        rest = run[n_full * _FULL :]
        out.append(len(rest) + 1)
        out += rest
    ends_full = bool(data) and data[-1] != 0 and not rest
    return bytes(out[:-1] if ends_full else out)


def cobs_decode(data: bytes) -> "bytes | None":
    """Return what `data` was encoded from, None if it is malformed."""
    out = bytearray()
    size = len(data)
    start = 0
    while start < size:
        end = start + data[start]
        if end > size or end == start:
            return None
        out += data[start + 1 : end]
        if data[start] <= _FULL and end < size:
            out.append(0)
        start = end
    return bytes(out)


def frame(body: bytes) -> bytes:
    """Return the whole frame of `body`, delimiter included."""
    return cobs_encode(body + struct.pack("<I", crc32c(body))) + b"\x00"


def _body(encoded: bytes) -> "bytes | None":
    """Return the body of a frame received without its delimiter, None if it is damaged."""
    data = cobs_decode(encoded)
    if data is None or len(data) < 5 or crc32c(data[:-4]) != struct.unpack("<I", data[-4:])[0]:
        return None
    return data[:-4]


class FrameReader:
    """Cuts the bytes of a line into frames; damaged ones are dropped and counted.

    Attributes
    ----------
    n_dropped : int
        Frames dropped so far.
    """

    def __init__(self) -> None:
        self.n_dropped = 0
        self._partial = b""
        self._overlong = False

    def feed(self, data: bytes) -> list[bytes]:
        """Return the bodies of the frames that `data` completes, oldest first."""
        bodies = []
        pieces = data.split(b"\x00")
        for piece in pieces[:-1]:
            encoded, overlong = self._take(piece)
            if not encoded and not overlong:
                continue  # an empty frame is no error
            body = None if overlong else _body(encoded)
            if body is None:
                self.n_dropped += 1
            else:
                bodies.append(body)
        self._keep(pieces[-1])
        return bodies

    def _take(self, piece: bytes) -> tuple[bytes, bool]:
        """Return what came since the last delimiter, and whether it is longer than any frame."""
        self._keep(piece)
        taken = (self._partial, self._overlong)
        self._partial, self._overlong = b"", False
        return taken

    def _keep(self, piece: bytes) -> None:
        """Hold `piece` until its delimiter comes; forget what is longer than any frame."""
        if self._overlong or len(self._partial) + len(piece) > MAX_ENCODED:
            self._partial, self._overlong = b"", True
        else:
            self._partial += piece
