"""The native protocol, version 1: every layout of ``docs/protocol.md``, declared once.

Bytes of a body, little-endian; ``header`` is type u8, session u32, request_id u32:

    01 HELLO              type, protocol_version u16, definition_hash u32, session u32
    81 IDENTITY           as HELLO, device_kind u8, boot_count u32, device_time_us u64, three texts of 16, 16, 8
    02 HEARTBEAT          type, session u32, seen_time_us u64
    03 05 06 10 11 20 22  header: GET_CONFIG, SELF_TEST, CLEAR_FAULT, STREAM_START, STREAM_STOP, HOME, STOP
    04 83                 header, the gyro's configuration: SET_CONFIG_GYRO, GYRO_CONFIG
    23 A3                 header, the stage's configuration: SET_CONFIG_STAGE, STAGE_CONFIG
    21 MOVE               header, azimuth i32, elevation i32, azimuth_speed u32, elevation_speed u32
    85 C0 FF              header, and SELF_TEST_RESULT: failures u16; ACK: nothing; ERROR: code u16, detail i32
    40 SAMPLES            36 bytes, then rate i32 x samples x axes
    41 STAGE_STATUS       40 bytes

A move to azimuth 270 deg and elevation -90 deg at 18 and 12.5 deg/s, 36,000 counts a degree:

>>> from drivers.protocol.framing import encode_frame
>>> body = build(
...     MessageType.MOVE, session=0x5EED1234, request_id=5,
...     azimuth=270 * 36_000, elevation=-90 * 36_000, azimuth_speed=18 * 36_000, elevation_speed=450_000,
... )
>>> encode_frame(body).hex()
'07213412ed5e05010104c0509408c08fceff40e30904d0dd06057cecf8c200'
>>> parse(body).elevation
-3240000
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from itertools import groupby
from math import radians
from typing import Any

import numpy as np
from construct import (
    Array,
    Bytes,
    Const,
    Container,
    Default,
    Int8ul,
    Int16sl,
    Int16ul,
    Int32sl,
    Int32ul,
    Int64ul,
    Struct,
    this,
)
from numpy.typing import NDArray

from drivers.errors import ProtocolError
from drivers.protocol.layout import numpy_dtype

PROTOCOL_VERSION = 1
DEFINITION_HASH = 0x66B325A6  #: CRC-32C of the definition in ``docs/protocol.md`` section 6

RATE_LSB = radians(2**-10 / 3600)  #: rad/s
ANGLE_LSB = radians(0.1 / 3600)  #: rad; also rad/s, rad/s^2
TEMPERATURE_LSB = 1 / 256  #: degrees Celsius
US_PER_S = 1e6  #: device time is divided by it, which rounds better than a product


class MessageType(IntEnum):
    """The first byte of a body."""

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
    SAMPLES = 0x40
    STAGE_STATUS = 0x41
    IDENTITY = 0x81
    GYRO_CONFIG = 0x83
    SELF_TEST_RESULT = 0x85
    STAGE_CONFIG = 0xA3
    ACK = 0xC0
    ERROR = 0xFF


class DeviceKind(IntEnum):
    """What answers a HELLO."""

    GYRO = 1
    STAGE = 2


class ErrorCode(IntEnum):
    """Why a device refuses a request."""

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


class Fault(IntEnum):
    """What a stage latches."""

    WATCHDOG = 1
    E_STOP = 2
    STALL = 3
    RUNAWAY = 4
    ENCODER = 5
    LIMIT_SWITCH = 6
    HOMING_FAILED = 7


class StageCode(IntEnum):
    """The state of a stage in STAGE_STATUS."""

    NOT_HOMED = 0
    HOMING = 1
    IDLE = 2
    MOVING = 3
    STOPPING = 4
    FAULT = 5


#: Bits of SELF_TEST_RESULT, bit 0 first.
SELF_TEST_NAMES = (
    "memory", "reference voltage", "resonator drive", "temperature sensor",
    "tilt sensor", "encoder", "motor driver", "limit switch",
)  # fmt: skip
IN_POSITION = 1  #: bit of `flags` in STAGE_STATUS
HOMED = 2  #: bit of `flags` in STAGE_STATUS


def _layout(message_type: MessageType, *fields: Any) -> Struct:  # noqa: ANN401  # construct's fields have no type
    return Struct("type" / Const(int(message_type), Int8ul), *fields)


_HEADER = ("session" / Int32ul, "request_id" / Int32ul)
_HELLO = ("protocol_version" / Int16ul, "definition_hash" / Int32ul, "session" / Int32ul)
_GYRO_CONFIG = (
    "sample_rate_millihz" / Int32ul,
    "range_dph" / Default(Int32ul, 0),
    "n_axes" / Default(Int8ul, 0),
    "block_samples" / Int8ul,
    "reserved" / Default(Int16ul, 0),
)
_STAGE_CONFIG = (
    "azimuth_min" / Int32sl,
    "azimuth_max" / Int32sl,
    "elevation_min" / Int32sl,
    "elevation_max" / Int32sl,
    "max_speed" / Int32ul,
    "max_acceleration" / Int32ul,
    "status_period_ms" / Int16ul,
    "watchdog_ms" / Int16ul,
)
_IDENTITY = (
    *_HELLO,
    "device_kind" / Int8ul,
    "boot_count" / Int32ul,
    "device_time_us" / Int64ul,
    "model" / Bytes(16),
    "serial_number" / Bytes(16),
    "firmware_version" / Bytes(8),
)
_MOVE = (
    "azimuth" / Int32sl,
    "elevation" / Int32sl,
    "azimuth_speed" / Int32ul,
    "elevation_speed" / Int32ul,
)
_SAMPLES = (
    "n_axes" / Int8ul,
    "n_samples" / Int8ul,
    "reserved" / Default(Int8ul, 0),
    "session" / Int32ul,
    "first_index" / Int32ul,
    "device_time_us" / Int64ul,
    "status" / Int16ul,
    "temperature" / Int16sl,
    "overrun_count" / Int32ul,
    "tilt_x" / Int32sl,
    "tilt_y" / Int32sl,
    "rate" / Array(this.n_samples, Array(this.n_axes, Int32sl)),
)
_STAGE_STATUS = (
    "state" / Int8ul,
    "fault" / Int8ul,
    "flags" / Int8ul,
    "session" / Int32ul,
    "device_time_us" / Int64ul,
    "move_id" / Int32ul,
    "azimuth" / Int32sl,
    "elevation" / Int32sl,
    "azimuth_rate" / Int32sl,
    "elevation_rate" / Int32sl,
    "status_count" / Int32ul,
)

#: The one declaration of every message.
LAYOUTS: dict[MessageType, Struct] = {
    message_type: _layout(message_type, *fields)
    for message_type, fields in {
        MessageType.HELLO: _HELLO,
        MessageType.IDENTITY: _IDENTITY,
        MessageType.HEARTBEAT: ("session" / Int32ul, "seen_time_us" / Int64ul),
        MessageType.GET_CONFIG: _HEADER,
        MessageType.SET_CONFIG_GYRO: (*_HEADER, *_GYRO_CONFIG),
        MessageType.GYRO_CONFIG: (*_HEADER, *_GYRO_CONFIG),
        MessageType.SELF_TEST: _HEADER,
        MessageType.SELF_TEST_RESULT: (*_HEADER, "failures" / Int16ul),
        MessageType.CLEAR_FAULT: _HEADER,
        MessageType.STREAM_START: _HEADER,
        MessageType.STREAM_STOP: _HEADER,
        MessageType.HOME: _HEADER,
        MessageType.MOVE: (*_HEADER, *_MOVE),
        MessageType.STOP: _HEADER,
        MessageType.SET_CONFIG_STAGE: (*_HEADER, *_STAGE_CONFIG),
        MessageType.STAGE_CONFIG: (*_HEADER, *_STAGE_CONFIG),
        MessageType.ACK: _HEADER,
        MessageType.ERROR: (*_HEADER, "code" / Int16ul, "detail" / Int32sl),
        MessageType.SAMPLES: _SAMPLES,
        MessageType.STAGE_STATUS: _STAGE_STATUS,
    }.items()
}

#: The record of one SAMPLES body for each permitted (n_axes, n_samples).
_SAMPLES_DTYPES = {
    (n_axes, n_samples): numpy_dtype(LAYOUTS[MessageType.SAMPLES], n_axes=n_axes, n_samples=n_samples)
    for n_axes, most in ((1, 119), (3, 39))
    for n_samples in range(1, most + 1)
}
_LENGTHS: dict[int, int] = {code: layout.sizeof() for code, layout in LAYOUTS.items() if code != MessageType.SAMPLES}


def message_type(body: bytes) -> MessageType | None:
    """Return the type of a body, or None if it is unknown or the length is not exactly its own."""
    code = body[0]
    if code == MessageType.SAMPLES:
        dtype = _SAMPLES_DTYPES.get((body[1], body[2])) if len(body) > 2 else None
        return MessageType.SAMPLES if dtype and len(body) == dtype.itemsize else None
    return MessageType(code) if _LENGTHS.get(code) == len(body) else None


def parse(body: bytes) -> Container:
    """Return the fields of a body by name, in wire units.

    Raises
    ------
    ProtocolError
        If the type is unknown or the length is not exactly its own.
    """
    kind = message_type(body)
    if kind is None:
        raise ProtocolError(f"no message of type {body[0]:02X} has a body of {len(body)} bytes")
    return LAYOUTS[kind].parse(body)


def build(kind: MessageType, **fields: int | bytes | list[list[int]]) -> bytes:
    """Return the body of a message; reserved and read-only fields may be left out."""
    body: bytes = LAYOUTS[kind].build(fields)
    return body


def self_test_failures(bits: int) -> tuple[str, ...]:
    """Return the names of the bits that are set in the result of a self-test.

    >>> self_test_failures(0x8020)
    ('encoder', 'bit 15')
    """
    names = dict(enumerate(SELF_TEST_NAMES))
    return tuple(names.get(bit, f"bit {bit}") for bit in range(16) if bits >> bit & 1)


def decode_samples(bodies: Sequence[bytes]) -> list[NDArray[np.void]]:
    """Return the SAMPLES bodies as arrays of records, one array for each run of bodies of equal form.

    Parameters
    ----------
    bodies
        Bodies that `message_type` calls SAMPLES.

    Returns
    -------
    list of ndarray
        Records with the fields of the layout, in wire units; ``records["rate"]`` has the shape
        (n_bodies, n_samples, n_axes). They look into one read-only copy of the bytes.
    """
    return [
        np.frombuffer(b"".join(run), _SAMPLES_DTYPES[form])
        for form, run in groupby(bodies, key=lambda body: (body[1], body[2]))
    ]
