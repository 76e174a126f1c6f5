"""A host made by hand, for tests of the emulator: no driver of ours, just bytes of docs/protocol.md.

Run as a program it homes the stage at a port, sets it moving and prints each device time that it acknowledges.
"""

from __future__ import annotations

import os
import select
import socket
import struct
import sys
import time
from dataclasses import dataclass, field

import fastcrc
from cobs import cobs

SESSION = 0x5EED1234
DEFINITION_HASH = 0x66B325A6
HELLO, HEARTBEAT, SELF_TEST, STREAM_START, HOME, MOVE = 0x01, 0x02, 0x05, 0x10, 0x20, 0x21
IDENTITY, ACK, SAMPLES, STAGE_STATUS = 0x81, 0xC0, 0x40, 0x41
NOT_HOMED, HOMING, IDLE, MOVING, STOPPING, FAULT = range(6)
DEGREE = 36_000  #: counts
PATIENCE = 60.0  #: s, for what comes at once on a machine that is not busy


def frame(body: bytes) -> bytes:
    """Return the whole frame of a body."""
    return bytes(cobs.encode(body + struct.pack("<I", fastcrc.crc32.iscsi(body)))) + b"\x00"


def hello(session: int = SESSION) -> bytes:
    """Return the frame that opens a session."""
    return frame(struct.pack("<BHII", HELLO, 1, DEFINITION_HASH, session))


def heartbeat(seen_us: int, session: int = SESSION) -> bytes:
    """Return the frame that acknowledges a device time."""
    return frame(struct.pack("<BIQ", HEARTBEAT, session, seen_us))


def request(kind: int, number: int, payload: bytes = b"", session: int = SESSION) -> bytes:
    """Return the frame of a request."""
    return frame(struct.pack("<BII", kind, session, number) + payload)


def move(number: int, azimuth_deg: float, elevation_deg: float = 0.0, speed_deg_per_s: float = 11.25) -> bytes:
    """Return the frame of a MOVE."""
    speed = round(speed_deg_per_s * DEGREE)
    azimuth, elevation = round(azimuth_deg * DEGREE), round(elevation_deg * DEGREE)
    return request(MOVE, number, struct.pack("<iiII", azimuth, elevation, speed, speed))


@dataclass(frozen=True, slots=True)
class Status:
    """A STAGE_STATUS."""

    state: int
    fault: int
    time_us: int
    azimuth: int
    elevation: int


@dataclass(frozen=True, slots=True)
class Samples:
    """A SAMPLES frame."""

    index: int
    time_us: int
    status: int
    n_overruns: int
    tilt: tuple[int, int]
    counts: tuple[int, ...]


def parse_status(body: bytes) -> Status:
    """Return the fields of a STAGE_STATUS body."""
    _, state, fault, _, _, time_us, _, azimuth, elevation = struct.unpack_from("<BBBBIQIii", body)
    return Status(state, fault, time_us, azimuth, elevation)


def parse_samples(body: bytes) -> Samples:
    """Return the fields of a SAMPLES body."""
    _, axes, n, _, _, index, time_us, status, _, overruns, x, y = struct.unpack_from("<BBBBIIQHhIii", body)
    return Samples(index, time_us, status, overruns, (x, y), struct.unpack_from(f"<{n * axes}i", body, 36))


@dataclass(slots=True)
class Decoder:
    """Turns bytes into bodies; counts what is damaged."""

    n_damaged: int = 0
    _rest: bytes = field(default=b"")

    def feed(self, data: bytes) -> list[bytes]:
        """Return the bodies that `data` completes."""
        *frames, self._rest = (self._rest + data).split(b"\x00")
        bodies = []
        for encoded in filter(None, frames):
            try:
                body = cobs.decode(encoded)
            except cobs.DecodeError:
                self.n_damaged += 1
                continue
            if len(body) > 4 and fastcrc.crc32.iscsi(body[:-4]) == int.from_bytes(body[-4:], "little"):
                bodies.append(body[:-4])
            else:
                self.n_damaged += 1
        return bodies


class RawPort:
    """An open address of the emulator, ``native:/dev/pts/3`` or ``native:socket://127.0.0.1:4711``."""

    def __init__(self, address: str) -> None:
        target = address.removeprefix("native:")
        self._decoder = Decoder()
        self._socket: socket.socket | None = None
        if target.startswith("socket://"):
            host, port = target.removeprefix("socket://").rsplit(":", 1)
            self._socket = socket.create_connection((host, int(port)), timeout=PATIENCE)
            self.handle = self._socket.fileno()
        else:
            self.handle = os.open(target, os.O_RDWR | os.O_NOCTTY)

    def send(self, data: bytes) -> None:
        """Send all of `data`."""
        os.write(self.handle, data)

    def receive(self, timeout: float = PATIENCE) -> list[bytes]:
        """Return the bodies that arrive with the next bytes; EOFError if the line is gone, TimeoutError if none do."""
        if not select.select([self.handle], [], [], timeout)[0]:
            raise TimeoutError("nothing came")
        try:
            data = os.read(self.handle, 65_536)
        except OSError:
            data = b""
        if not data:
            raise EOFError("the line is gone")
        return self._decoder.feed(data)

    def wait_for(self, kind: int, timeout: float = PATIENCE) -> bytes:
        """Return the next body of that type."""
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            for body in self.receive(timeout):
                if body[0] == kind:
                    return body
        raise TimeoutError(f"no message of type {kind:02X} came")

    @property
    def n_damaged(self) -> int:
        """Frames that came damaged."""
        return self._decoder.n_damaged

    def close(self) -> None:
        """Release the line."""
        if self._socket is None:
            os.close(self.handle)
        else:
            self._socket.close()


def main(address: str) -> None:
    """Home, then move, acknowledging every status and printing what was acknowledged with the state."""
    port = RawPort(address)
    port.send(hello())
    port.send(request(HOME, 1))
    moving = False
    while True:
        for body in port.receive():
            if body[0] != STAGE_STATUS:
                continue
            status = parse_status(body)
            port.send(heartbeat(status.time_us))
            sys.stdout.write(f"{status.state} {status.time_us}\n")
            sys.stdout.flush()
            if status.state == IDLE and not moving:
                moving = True
                port.send(move(2, 350.0))


if __name__ == "__main__":
    main(sys.argv[1])
