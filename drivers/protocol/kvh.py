r"""What KVH's fibre-optic gyros send: DSP-1750, DSP-1760, and the 1750 and 1775 with accelerometers. Big-endian.

    format A  FE81FF55, rotation 3 x f32, acceleration 3 x f32, status u8, sequence u8, temperature i16, crc u32
    format B  FE81FF56, as A with a time in us, u32, before the status
    format C  FE81FF57, as A with a f32 (temperature and magnetic field in turn) for the temperature; not read here
    test      FE8100AA, 6 bytes, the sum of all bytes before it, u8: an answer to ?BIT

Rotation is a rate or the angle since the last message, in radians or degrees, see `Units`. The sequence runs from 0 to
127. The CRC is that of `crc_frames`. Commands are lines of text, for which see `drivers.kvh.settings`.

A real unit that sends angles (https://github.com/TRECVT/ros_kvh1750):

>>> wire = bytes.fromhex("fe81ff553b041f78b9b96613ba234b38bb7c0410b8def4803f7f4b7b701f001df12fb6ee")
>>> [frames] = decoder().feed(wire)
>>> message = decode_messages(frames)
>>> [f"{angle:.6e}" for angle in message["rotation"][0]]
['2.016036e-03', '-3.536200e-04', '-6.229165e-04']
>>> hex(int(message["status"][0])), message["sequence"].tolist(), message["temperature"].tolist()
('0x70', [31], [29])
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from math import radians

import numpy as np
from construct import Array, Const, Float32b, Int8ub, Int16sb, Int32ub, Struct
from fastcrc import crc32
from numpy.typing import NDArray

from drivers.protocol.crc_frames import CRC_SIZE, CrcFrameDecoder, Frames
from drivers.protocol.layout import numpy_dtype

SEQUENCE_SPAN = 128
GYROS_VALID = (1, 2, 4)  #: bits of the status, of x, y and z
ACCELEROMETERS_VALID = 0x70
_A, _B, _C = bytes.fromhex("fe81ff55"), bytes.fromhex("fe81ff56"), bytes.fromhex("fe81ff57")
_C_SIZE = 38
_TEST = re.compile(rb"\xfe\x81\x00\xaa(?=(.{6})(.))", re.DOTALL)
_ALL_GOOD = 0x7F

_MOTION = ("rotation" / Array(3, Float32b), "acceleration" / Array(3, Float32b))
_REST = ("status" / Int8ub, "sequence" / Int8ub, "temperature" / Int16sb)
#: The one declaration of each message, without its CRC.
LAYOUTS: dict[bytes, Struct] = {
    _A: Struct("header" / Const(int.from_bytes(_A, "big"), Int32ub), *_MOTION, *_REST),
    _B: Struct("header" / Const(int.from_bytes(_B, "big"), Int32ub), *_MOTION, "time_us" / Int32ub, *_REST),
}
_DTYPES = {header: numpy_dtype(layout) for header, layout in LAYOUTS.items()}
_SIZES = {header: layout.sizeof() + CRC_SIZE for header, layout in LAYOUTS.items()}
FORMATS = {_A: "A", _B: "B"}


def decoder() -> CrcFrameDecoder:
    """Return a decoder of the byte stream, formats A and B."""
    return CrcFrameDecoder(_SIZES)


def wire_size(form: str) -> int:
    """Return how many bytes a message of format A or B is."""
    size: int = next(_SIZES[header] for header, name in FORMATS.items() if name == form)
    return size


def decode_messages(frames: Frames) -> NDArray[np.void]:
    """Return messages as records, shape (n,), with the fields of the layout in wire units."""
    return frames.bodies.view(_DTYPES[frames.header])[:, 0]


def speaks_format_c(heard: bytes) -> bool:
    """Return whether a good message of format C was heard."""
    starts = [match.start() for match in re.finditer(re.escape(_C), heard)]
    messages = [heard[start : start + _C_SIZE] for start in starts]
    return any(
        len(message) == _C_SIZE and crc32.mpeg_2(message[:-CRC_SIZE]) == int.from_bytes(message[-CRC_SIZE:], "big")
        for message in messages
    )


def find_test(heard: bytes) -> tuple[str, ...] | None:
    """Return what the built-in test in `heard` says is wrong, ``()`` for nothing, None if there is no test.

    Its sum is of eight bits only: it counts as an answer to a question, never by itself.
    """
    for match in _TEST.finditer(heard):
        data, total = match.groups()
        if (sum(match.group()) + sum(data)) % 256 == total[0]:
            return tuple(
                f"built-in test, byte {i} bit {bit}"
                for i, byte in enumerate(data)
                for bit in range(8)
                if (byte ^ _ALL_GOOD) >> bit & 1
            )
    return None


@dataclass(frozen=True, slots=True, kw_only=True)
class Units:
    """What the numbers of a unit mean, as it says of itself."""

    data_rate: int  #: Hz
    delta: bool = True  #: angles since the last message, else rates
    degrees: bool = False
    temperature: str = "C"  #: C, C_100, F or F_100

    @property
    def rate_lsb(self) -> float:
        """Rad/s of a rotation of one."""
        return (radians(1) if self.degrees else 1.0) * (self.data_rate if self.delta else 1)

    def celsius(self, temperature: float) -> float:
        """Return a temperature in degrees Celsius."""
        value = temperature / 100 if self.temperature.endswith("_100") else temperature
        return (value - 32) / 1.8 if self.temperature.startswith("F") else value
