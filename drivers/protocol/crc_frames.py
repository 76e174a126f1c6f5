r"""Frames of fixed length that begin with a header and end with a CRC-32: those of the STIM300 and of KVH's gyros.

    header, data, crc: CRC-32/MPEG-2, big-endian, of all before it and of zeros (never sent) up to a multiple of 4 bytes

There is no delimiter: a header is only the place to try. CRC-32/MPEG-2 has the polynomial 04C11DB7, starts with all
ones, and neither reflects nor inverts. A frame may be followed by a terminator, which is no part of it.

>>> decoder = CrcFrameDecoder({b"\xbe": 21}, terminator=b"\r\n")
>>> body = b"\xbe" + bytes(16)
>>> wire = body + checksum(body).to_bytes(4, "big")
>>> [frames.bodies.tobytes() == body for frames in decoder.feed(b"junk" + wire + b"\r\n" + wire[:20])]
[True]
>>> decoder.counts
CrcFrameCounts(n_frames=1, n_bad_crc=0, n_skipped=4)
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from fastcrc import crc32
from numpy.typing import NDArray

CRC_SIZE = 4
_MAX_RUN = 4096  # frames looked at together


@dataclass(slots=True)
class CrcFrameCounts:
    """What a decoder has met. A header within data whose checksum is wrong counts as a bad frame, too."""

    n_frames: int = 0  #: good ones
    n_bad_crc: int = 0
    n_skipped: int = 0  #: bytes that were part of no good frame, nor its terminator


@dataclass(frozen=True, slots=True)
class Frames:
    """Good frames of one kind, one after the other."""

    header: bytes
    bodies: NDArray[np.uint8]  #: without the checksum, shape (n, length)


def checksum(body: bytes) -> int:
    """Return the CRC of a frame's header and data."""
    return int(crc32.mpeg_2(body + bytes(-len(body) % 4)))


class CrcFrameDecoder:
    """Turns any chunks of a byte stream into its good frames.

    What comes out, and what is counted, depends on the bytes alone and not on how they were cut into chunks, but for
    the number of `Frames` it comes in. After any fault the first whole frame is found again. Between calls at most one
    frame and a terminator are held.

    Parameters
    ----------
    sizes
        Length of each kind of frame with header and CRC, by header; the headers are of one length.
    terminator
        What may follow a frame.
    """

    def __init__(self, sizes: Mapping[bytes, int], *, terminator: bytes = b"") -> None:
        self._sizes = dict(sizes)
        self._header = re.compile(b"|".join(map(re.escape, self._sizes)), re.DOTALL)
        self._header_size = len(next(iter(self._sizes)))
        self._terminator = terminator
        self._counts = CrcFrameCounts()
        self._rest = b""
        self._after_frame = False  # whether a terminator may come next

    @property
    def counts(self) -> CrcFrameCounts:
        """A copy of the counters."""
        return replace(self._counts)

    def feed(self, data: bytes) -> list[Frames]:
        """Return the good frames that `data` completes, oldest first."""
        buffer, position = self._rest + data, 0
        found: list[Frames] = []
        while (match := self._header.search(buffer, position)) is not None:
            self._skip(buffer[position : match.start()])
            position = match.start()
            header = match.group()
            size = self._sizes[header]
            if len(buffer) - position < size:
                break
            bodies, taken = self._take_run(buffer, position, header, size)
            if len(bodies):
                found.append(Frames(header, bodies))
            else:
                self._counts.n_bad_crc += 1
                self._counts.n_skipped += 1
            position += taken
        else:
            keep = self._undecided(buffer, position)
            self._skip(buffer[position:keep])
            position = keep
        self._rest = buffer[position:]
        return found

    def _take_run(self, buffer: bytes, start: int, header: bytes, size: int) -> tuple[NDArray[np.uint8], int]:
        """Return the good frames of one kind that stand at `start`, and how many bytes they are; one byte if none."""
        body = size - CRC_SIZE
        if checksum(buffer[start : start + body]) != int.from_bytes(buffer[start + body : start + size], "big"):
            self._after_frame = False
            return np.empty((0, body), np.uint8), 1
        ended = bool(self._terminator) and buffer.startswith(self._terminator, start + size)
        stride = size + len(self._terminator) * ended
        n_most = min(_MAX_RUN, (len(buffer) - start - size) // stride + 1)
        rows = np.ndarray((n_most, size), np.uint8, buffer, start, (stride, 1))
        alike = (rows[:, : self._header_size] == np.frombuffer(header, np.uint8)).all(axis=1)
        if ended:
            ends = np.ndarray((n_most - 1, stride - size), np.uint8, buffer, start + size, (stride, 1))
            alike[1:] &= (ends == np.frombuffer(self._terminator, np.uint8)).all(axis=1)
        n_good = _count_good(rows if alike.all() else rows[: int(np.argmin(alike))])
        self._counts.n_frames += n_good
        self._after_frame = True
        return rows[:n_good, :body].copy(), (n_good - 1) * stride + size

    def _skip(self, junk: bytes) -> None:
        """Count what is part of no frame."""
        if junk:
            ended = self._after_frame and bool(self._terminator) and junk.startswith(self._terminator)
            self._counts.n_skipped += len(junk) - len(self._terminator) * ended
            self._after_frame = False

    def _undecided(self, buffer: bytes, position: int) -> int:
        """Return where what may be the beginning of a header, or a terminator not yet whole, begins."""
        rest = buffer[position:]
        if self._after_frame and len(rest) < len(self._terminator) and self._terminator.startswith(rest):
            return position
        for keep in range(min(self._header_size - 1, len(rest)), 0, -1):
            if any(header.startswith(rest[-keep:]) for header in self._sizes):
                return len(buffer) - keep
        return len(buffer)


def _count_good(rows: NDArray[np.uint8]) -> int:
    """Return how many of the frames are good, up to the first that is not."""
    body = rows.shape[1] - CRC_SIZE
    width = body + -body % 4
    padded = np.zeros((len(rows), width), np.uint8)
    padded[:, :body] = rows[:, :body]
    data = padded.tobytes()
    wanted = np.ascontiguousarray(rows[:, body:]).view(">u4")[:, 0].tolist()
    mpeg_2 = crc32.mpeg_2
    for n_good, crc in enumerate(wanted):
        if mpeg_2(data[n_good * width : n_good * width + width]) != crc:
            return n_good
    return len(rows)
