"""The conversation with the host, alike in both devices: HELLO, sessions, requests executed once, replies.

See ``docs/protocol.md`` section 2.
"""

import struct

from sim_device.firmware.framing import FrameReader, frame
from sim_device.firmware.hardware import Board

PROTOCOL_VERSION = 1
DEFINITION_HASH = 0x66B325A6
FIRMWARE_VERSION = "1.0.0"

GYRO = 1
STAGE = 2

HELLO = 0x01
HEARTBEAT = 0x02
GET_CONFIG = 0x03
SET_CONFIG_GYRO = 0x04
SELF_TEST = 0x05
CLEAR_FAULT = 0x06
STREAM_START = 0x10
STREAM_STOP = 0x11
HOME = 0x20
MOVE = 0x21
STOP = 0x22
SET_CONFIG_STAGE = 0x23

GYRO_CONFIG = 0x83
SELF_TEST_RESULT = 0x85
STAGE_CONFIG = 0xA3

#: Length of each body that a host may send.
LENGTHS = {
    HELLO: 11,
    HEARTBEAT: 13,
    GET_CONFIG: 9,
    SET_CONFIG_GYRO: 21,
    SELF_TEST: 9,
    CLEAR_FAULT: 9,
    STREAM_START: 9,
    STREAM_STOP: 9,
    HOME: 9,
    MOVE: 25,
    STOP: 9,
    SET_CONFIG_STAGE: 37,
}
_HEADER = 9

DEAF_BEATS = 3  #: heartbeats that tell nothing newer, after which what was last sent must be lost

UNKNOWN_REQUEST = 1
BAD_LENGTH = 2
NO_SESSION = 3
OUT_OF_RANGE = 4
NOT_HOMED = 5
MOVING = 6
FAULT_LATCHED = 7
SOFT_LIMIT = 8
CABLE_WRAP = 9
STREAMING = 10
NOT_READY = 11

#: A reply is its type and its payload.
ACK = (0xC0, b"")


def error(code: int, detail: int = 0) -> tuple[int, bytes]:
    """Return the reply that refuses a request."""
    return (0xFF, struct.pack("<Hi", code, detail))


def _text(text: str, size: int) -> bytes:
    """Return `text` as a field of `size` bytes, padded with zeros."""
    return (text.encode() + bytes(size))[:size]


class Session:
    """One device's end of the line.

    Attributes
    ----------
    number : int
        Number of the open session, 0 if none.
    seen_time_us : int
        Newest device time that the host says it has read in this session, or has evidently lost.
    heartbeat_us : int
        When the last HEARTBEAT of this session came.
    request_id : int
        Number of the last request of this session.
    n_waiting : int
        Bytes waiting to be sent.
    """

    def __init__(self, board: Board, device_kind: int) -> None:
        self.number = 0
        self.seen_time_us = 0
        self.heartbeat_us = 0
        self.request_id = 0
        self._board = board
        self._device_kind = device_kind
        self._reader = FrameReader()
        self._n_ignored = 0
        self._reply = b""  # to the last request; empty while that is at work
        self._outbox: list[bytes] = []
        self._n_deaf = 0  # heartbeats that told nothing newer, since something was last sent
        self.n_waiting = 0

    @property
    def n_dropped(self) -> int:
        """Frames dropped: damaged, or of a type or length that no host may send."""
        return self._reader.n_dropped + self._n_ignored

    def send(self, encoded: bytes) -> None:
        """Put a whole frame in the queue."""
        self._n_deaf = 0
        self._outbox.append(encoded)
        self.n_waiting += len(encoded)

    def take(self) -> bytes:
        """Return all that waits to be sent, and empty the queue."""
        out = b"".join(self._outbox)
        self._outbox = []
        self.n_waiting = 0
        return out

    def read(self, data: bytes) -> list[bytes]:
        """Return the bodies of the frames that `data` completes; `accept` each before the next."""
        return self._reader.feed(data)

    def accept(self, body: bytes, now_us: int) -> "tuple[int, bytes] | None":
        """Return (type, payload) of a request to execute, or (HELLO, b"") once a HELLO has been answered, or None.

        The caller must `answer` each request but HELLO before it accepts the next, or later, if that takes time.
        """
        kind = body[0]
        right_length = len(body) == LENGTHS.get(kind)
        if kind not in LENGTHS or (not right_length and (kind <= HEARTBEAT or len(body) < _HEADER)):
            self._n_ignored += 1
        elif kind == HELLO:
            self._open(body, now_us)
            return (HELLO, b"")
        elif kind == HEARTBEAT:
            self._note_heartbeat(body, now_us)
        elif self._is_new(body):
            if right_length:
                return (kind, body[_HEADER:])
            self.answer(error(BAD_LENGTH))
        return None

    def answer(self, reply: tuple[int, bytes]) -> None:
        """Send the reply to the last request, and keep it for repetition."""
        self._reply = self._encode_reply(self.number, self.request_id, reply)
        self.send(self._reply)

    def _encode_reply(self, number: int, request_id: int, reply: tuple[int, bytes]) -> bytes:
        return frame(struct.pack("<BII", reply[0], number, request_id) + reply[1])

    def _open(self, body: bytes, now_us: int) -> None:
        """Open the session that a HELLO asks for, if host and device speak the same protocol, and say who we are."""
        _, version, definition_hash, number = struct.unpack("<BHII", body)
        agreed = version == PROTOCOL_VERSION and definition_hash == DEFINITION_HASH
        self.number = number if agreed else 0
        self.seen_time_us = 0
        self.heartbeat_us = now_us
        self.request_id = 0
        self._reply = b""
        board = self._board
        identity = struct.pack(
            "<BHIIBIQ",
            0x81,
            PROTOCOL_VERSION,
            DEFINITION_HASH,
            self.number,
            self._device_kind,
            board.boot_count & 0xFFFFFFFF,
            now_us,
        )
        names = _text(board.model, 16) + _text(board.serial_number, 16) + _text(FIRMWARE_VERSION, 8)
        self.send(frame(identity + names))

    def _note_heartbeat(self, body: bytes, now_us: int) -> None:
        _, number, seen_time_us = struct.unpack("<BIQ", body)
        if self.number and number == self.number:
            self.heartbeat_us = now_us
            self._n_deaf = self._n_deaf + 1 if seen_time_us <= self.seen_time_us else 0
            # one heartbeat may have been on its way, and one may go out before what has come is read
            self.seen_time_us = max(self.seen_time_us, seen_time_us, now_us if self._n_deaf >= DEAF_BEATS else 0)

    def _is_new(self, body: bytes) -> bool:
        """Return whether to execute a request; refuse it, repeat its reply or stay silent if not."""
        _, number, request_id = struct.unpack("<BII", body[:_HEADER])
        if not self.number or number != self.number:
            self.send(self._encode_reply(number, request_id, error(NO_SESSION)))
            return False
        if request_id > self.request_id:
            self.request_id = request_id
            self._reply = b""
            return True
        if request_id == self.request_id:
            self.send(self._reply)
        return False
