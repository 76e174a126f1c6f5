"""The host's end of the line for the firmware's tests: frames by struct and independent packages, virtual time."""

import struct
from dataclasses import dataclass
from typing import Protocol

from cobs import cobs
from cobs.cobs import DecodeError
from fastcrc import crc32

SESSION = 0x5EED1234
HASH = 0x66B325A6

HEARTBEAT, GET_CONFIG, SET_CONFIG_GYRO, SELF_TEST, CLEAR_FAULT = range(0x02, 0x07)
STREAM_START, STREAM_STOP = 0x10, 0x11
HOME, MOVE, STOP, SET_CONFIG_STAGE = range(0x20, 0x24)
ACK, ERROR, SAMPLES, STATUS = 0xC0, 0xFF, 0x40, 0x41
NOT_HOMED, HOMING, IDLE, MOVING, STOPPING, FAULT = range(6)


def frame(body: bytes) -> bytes:
    """Return the frame of `body`."""
    encoded: bytes = cobs.encode(body + crc32.iscsi(body).to_bytes(4, "little"))
    return encoded + b"\x00"


def bodies(data: bytes) -> list[bytes]:
    """Return the bodies of all frames in `data`, each of which must be whole."""
    assert not data or data[-1] == 0
    found = []
    for encoded in data.split(b"\x00")[:-1]:
        body: bytes = cobs.decode(encoded)
        assert crc32.iscsi(body[:-4]) == int.from_bytes(body[-4:], "little")
        found.append(body[:-4])
    return found


def decodes(encoded: bytes) -> bytes | None:
    """Return what the cobs package makes of `encoded`, None if it refuses."""
    try:
        decoded: bytes = cobs.decode(encoded)
    except DecodeError:
        return None
    return decoded


def hello(session: int = SESSION, *, version: int = 1, definition_hash: int = HASH) -> bytes:
    """Return a HELLO."""
    return frame(struct.pack("<BHII", 0x01, version, definition_hash, session))


def heartbeat(seen_time_us: int = 0, *, session: int = SESSION) -> bytes:
    """Return a HEARTBEAT."""
    return frame(struct.pack("<BIQ", HEARTBEAT, session, seen_time_us))


def request(kind: int, request_id: int, payload: bytes = b"", *, session: int = SESSION) -> bytes:
    """Return a request."""
    return frame(struct.pack("<BII", kind, session, request_id) + payload)


def target(azimuth: int, elevation: int, *, speed: int = 18 * 36_000) -> bytes:
    """Return the payload of a MOVE, both axes at the same speed."""
    return struct.pack("<iiII", azimuth, elevation, speed, speed)


def reply(kind: int, request_id: int, payload: bytes = b"", *, session: int = SESSION) -> bytes:
    """Return the body of the reply that is expected."""
    return struct.pack("<BII", kind, session, request_id) + payload


def refusal(request_id: int, code: int, detail: int = 0, *, session: int = SESSION) -> bytes:
    """Return the body of the ERROR that is expected."""
    return reply(ERROR, request_id, struct.pack("<Hi", code, detail), session=session)


@dataclass(frozen=True, slots=True)
class Status:
    """A STAGE_STATUS, field by field."""

    kind: int
    state: int
    fault: int
    flags: int
    session: int
    time_us: int
    move_id: int
    azimuth: int
    elevation: int
    azimuth_rate: int
    elevation_rate: int
    count: int


def status(body: bytes) -> Status:
    """Return the status that `body` holds."""
    return Status(*struct.unpack("<BBBBIQIiiiiI", body))


class Device(Protocol):
    """Either device."""

    @property
    def session(self) -> int:
        """The open session."""

    @property
    def n_dropped(self) -> int:
        """Frames dropped."""

    def feed(self, data: bytes, now_us: int) -> None:
        """Take bytes."""

    def poll(self, now_us: int) -> bytes:
        """Work."""

    def next_due_us(self) -> int | None:
        """Tell when."""


class FakeHost:
    """Runs a device through virtual time, and keeps all that it says.

    ``beat_us`` is the time between heartbeats, 0 for none.
    """

    def __init__(self, device: Device, *, beat_us: int = 100_000) -> None:
        self.device = device
        self.now_us = 0
        self.beat_us = beat_us
        self.heard: list[bytes] = []
        self.last_id = 0

    def send(self, data: bytes) -> list[bytes]:
        """Feed `data` now and return what comes back at once."""
        self.device.feed(data, self.now_us)
        return self.hear()

    def hear(self) -> list[bytes]:
        """Poll now and return what came."""
        found = bodies(self.device.poll(self.now_us))
        self.heard += found
        return found

    def ask(self, kind: int, payload: bytes = b"") -> bytes:
        """Send the next request and return its reply."""
        self.last_id += 1
        answers = [body for body in self.send(request(kind, self.last_id, payload)) if body[0] not in {SAMPLES, STATUS}]
        assert len(answers) == 1
        return answers[0]

    def run(self, duration_us: int) -> list[bytes]:
        """Let time pass, event by event, with heartbeats; return what came."""
        end_us = self.now_us + duration_us
        n_heard = len(self.heard)
        while self.now_us < end_us:
            due = self.device.next_due_us()
            beat = (self.now_us // self.beat_us + 1) * self.beat_us if self.beat_us else end_us
            self.now_us = max(self.now_us, min(end_us, beat, end_us if due is None else due))
            self.hear()
            if self.beat_us and self.now_us == beat:
                self.send(heartbeat(self.now_us))
        return self.heard[n_heard:]

    @property
    def status(self) -> Status:
        """The newest status."""
        return next(status(body) for body in reversed(self.heard) if body[0] == STATUS)

    def run_to_rest(self, within_us: int = 120_000_000) -> Status:
        """Let time pass until the stage is neither homing, moving nor stopping."""
        end_us = self.now_us + within_us
        while self.status.state in {HOMING, MOVING, STOPPING}:
            assert self.now_us < end_us
            self.run(50_000)
        return self.status
