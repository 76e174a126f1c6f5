r"""The datagrams of Safran Sensonor's STIM300, big-endian, and what its configuration says of them.

    samples   id, rate 3 x i24, status, [acceleration 3 x i24, status], [inclination 3 x i24, status],
              [temperatures 3 x i16, status for each of these], [PPS or AUX i24, status], counter u8, latency u16
    others    B1 B3 part number, B5 B7 serial number, BC BD configuration, D1 D2 bias trim, BE BF extended error

Each ends with a CRC-32, see `crc_frames`, and if so configured with CR LF. The id says which clusters there are: 90 to
94 and A5 to A7, F0 to F7 with PPS, and 98 to 9C and AD to AF of older units with AUX.

A unit at rest, its z axis up (https://github.com/geirhovland/stim300):

>>> wire = bytes.fromhex(
...     "af000124fffad600035b00ffe7a6ffdd36081c5200ff7e70feba0c3ffa1d0023a023c023a000"
...     "2319230a231c00239523b6239500ffef0200e101fac64942c6"
... )
>>> [frames] = decoder().feed(wire)
>>> sample = decode_samples(frames)
>>> (triple(sample, "rate") / 2**14).tolist()
[[0.017822265625, -0.0806884765625, 0.05242919921875]]
>>> sample["counter"].tolist(), sample["latency_us"].tolist()
([225], [506])
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, IntFlag
from math import radians
from typing import Any

import numpy as np
from construct import Array, BitsInteger, BitStruct, Bytes, Const, Flag, Int8ub, Int16sb, Int16ub, Int24sb, Struct
from numpy.typing import NDArray

from drivers.errors import ProtocolError
from drivers.protocol.crc_frames import CRC_SIZE, CrcFrameDecoder, Frames
from drivers.protocol.layout import integers24, numpy_dtype
from drivers.protocol.text import printable

TERMINATOR = b"\r\n"
COUNTER_RATE = 2000  #: Hz, what `counter` counts
COUNTER_SPAN = 256
INCLINATION_RANGE_G = 1.7
STANDARD_GRAVITY = 9.80665  #: m/s^2

PART_NUMBER = (0xB1, 0xB3)
SERIAL_NUMBER = (0xB5, 0xB7)
CONFIGURATION = (0xBC, 0xBD)
BIAS_TRIM = (0xD1, 0xD2)
EXTENDED_ERROR = (0xBE, 0xBF)


class Cluster(IntFlag):
    """What a datagram of samples holds besides the rate."""

    ACCELERATION = 1
    INCLINATION = 2
    TEMPERATURE = 4
    PPS = 8
    AUX = 16


class Status(IntFlag):
    """A cluster's status byte: of all internal samples since the last datagram."""

    X = 1
    Y = 2
    Z = 4
    CHANNEL_ERROR = 8
    OVERLOAD = 16
    OUTSIDE_CONDITIONS = 32
    START_UP = 64
    INTEGRITY_ERROR = 128


class Output(Enum):
    """What the numbers of a cluster mean; of a gyro rates and angles, of an accelerometer one more integral each."""

    RATE = 0
    INCREMENT = 1
    AVERAGE = 2
    INTEGRAL = 3


def _sample_ids() -> dict[int, Cluster]:
    ids = {}
    for clusters in range(8):
        plain = (0x90 if clusters <= 4 else 0xA0) + clusters
        ids[plain] = Cluster(clusters)
        ids[plain + 8] = Cluster(clusters) | Cluster.AUX
        ids[0xF0 + clusters] = Cluster(clusters) | Cluster.PPS
    return ids


#: The datagrams of samples by id.
SAMPLE_IDS = _sample_ids()


def _sample_layout(identifier: int, clusters: Cluster) -> Struct:
    names = ["rate"]
    names += ["acceleration"] if Cluster.ACCELERATION in clusters else []
    names += ["inclination"] if Cluster.INCLINATION in clusters else []
    fields: list[Any] = ["id" / Const(identifier, Int8ub)]
    for name in names:
        fields += [name / Array(3, Int24sb), f"{name}_status" / Int8ub]
    for name in names if Cluster.TEMPERATURE in clusters else []:
        fields += [f"{name}_temperature" / Array(3, Int16sb), f"{name}_temperature_status" / Int8ub]
    if clusters & (Cluster.PPS | Cluster.AUX):
        fields += ["pulse" / Int24sb, "pulse_status" / Int8ub]
    return Struct(*fields, "counter" / Int8ub, "latency_us" / Int16ub)


def _axis_codes(first: str, *fields: Any) -> tuple[Any, ...]:  # noqa: ANN401  # construct's fields have no type
    """Return the fields of three bytes that tell a cluster's axes, output and filters."""
    return (
        first / BitStruct("reserved" / Flag, "axes" / Array(3, Flag), "output" / BitsInteger(4)),
        f"{first}_filters" / BitStruct("x" / BitsInteger(4), "y" / BitsInteger(4)),
        *fields,
    )


#: The one declaration of every datagram, without its CRC.
LAYOUTS: dict[int, Struct] = {
    identifier: _sample_layout(identifier, SAMPLE_IDS[identifier]) for identifier in SAMPLE_IDS
}
for _identifiers, _fields in {
    PART_NUMBER: ("number" / Bytes(14), "revision" / Bytes(1)),
    SERIAL_NUMBER: ("prefix" / Bytes(1), "number" / Bytes(7), "reserved" / Bytes(7)),
    CONFIGURATION: (
        "revision" / Bytes(1),
        "firmware" / Int8ub,
        "datagram" / BitStruct("sample_rate" / BitsInteger(3), "clusters" / BitsInteger(4), "terminated" / Flag),
        "line"
        / BitStruct("bit_rate" / BitsInteger(4), "two_stop_bits" / Flag, "parity" / BitsInteger(2), "ended" / Flag),
        *_axis_codes("gyro", "gyro_g" / BitStruct("filter_z" / BitsInteger(4), "compensation" / BitsInteger(4))),
        *_axis_codes("accelerometer", "accelerometer_z" / Int8ub),
        *_axis_codes("inclinometer", "pps" / BitStruct("filter_z" / BitsInteger(4), "output" / BitsInteger(4))),
        "pulse" / BitStruct("reserved" / BitsInteger(4), "is_pps" / Flag, "filter" / BitsInteger(3)),
        "gyro_ranges" / Bytes(2),
        "ranges" / BitStruct("x" / BitsInteger(4), "y" / BitsInteger(4), "z" / BitsInteger(4), "rest" / BitsInteger(4)),
        "inclinometer_ranges" / Bytes(2),
        "time_of_validity" / Int8ub,
    ),
    BIAS_TRIM: ("trim" / Bytes(27), "reference" / Bytes(4), "saves_left" / Int16ub, "reserved" / Bytes(2)),
    EXTENDED_ERROR: ("bits" / Bytes(16),),
}.items():
    for _identifier in _identifiers:
        LAYOUTS[_identifier] = Struct("id" / Const(_identifier, Int8ub), *_fields)

_DTYPES = {bytes([identifier]): numpy_dtype(LAYOUTS[identifier]) for identifier in SAMPLE_IDS}
_SIZES = {bytes([identifier]): layout.sizeof() + CRC_SIZE for identifier, layout in LAYOUTS.items()}


def decoder() -> CrcFrameDecoder:
    """Return a decoder of the byte stream, with or without CR LF."""
    return CrcFrameDecoder(_SIZES, terminator=TERMINATOR)


def wire_size(identifier: int, *, terminated: bool) -> int:
    """Return how many bytes a datagram is on the line."""
    size: int = _SIZES[bytes([identifier])]
    return size + len(TERMINATOR) * terminated


def decode_samples(frames: Frames) -> NDArray[np.void]:
    """Return datagrams of samples as records, shape (n,), with the fields of the layout in wire units.

    Numbers of three bytes stay bytes, see `triple`.
    """
    return frames.bodies.view(_DTYPES[frames.header])[:, 0]


def triple(samples: NDArray[np.void], cluster: str) -> NDArray[np.int32]:
    """Return the counts of a cluster's three axes, shape (n, 3)."""
    return integers24(samples[cluster])


@dataclass(frozen=True, slots=True, kw_only=True)
class Configuration:
    """What the configuration datagram says."""

    revision: str
    firmware: int
    sample_rate: int | None  #: Hz, None for an external trigger
    clusters: Cluster
    terminated: bool  #: whether CR LF ends each datagram
    bit_rate: int | None  #: bit/s, None for one of the user's own
    axes: tuple[bool, bool, bool]  #: which gyros are active
    gyro: Output
    accelerometer: Output | None  #: None for an output that is not read here
    inclinometer: Output | None
    accelerometer_range_g: int

    @property
    def rate_lsb(self) -> float:
        """Rad/s of one count of rate, or of the difference of two integrals; needs the sample rate."""
        if self.gyro in {Output.RATE, Output.AVERAGE}:
            return radians(2**-14)
        return radians(2**-21) * (self.sample_rate or 0)

    @property
    def acceleration_lsb(self) -> float | None:
        """m/s^2 of one count of acceleration, None if it is none that can be read here."""
        return self._force_lsb(self.accelerometer, _G_BITS[self.accelerometer_range_g])

    @property
    def inclination_lsb(self) -> float | None:
        """As `acceleration_lsb`, of the inclinometers."""
        return self._force_lsb(self.inclinometer, 22)

    def _force_lsb(self, output: Output | None, bits: int) -> float | None:
        if output in {Output.RATE, Output.AVERAGE}:
            return float(STANDARD_GRAVITY * 2.0**-bits)
        if output is Output.INCREMENT and self.sample_rate:
            return float(2.0 ** -(bits + 3) * self.sample_rate)  # m/s a sample
        return None


_SAMPLE_RATES: dict[int, int | None] = {0: 125, 1: 250, 2: 500, 3: 1000, 4: 2000, 5: None}
_BIT_RATES: dict[int, int | None] = {0: 374_400, 1: 460_800, 2: 921_600, 3: 1_843_200, 15: None}
_RANGES_G = {0: 10, 2: 2, 3: 5, 4: 30, 6: 80}
_G_BITS = {2: 21, 5: 20, 10: 19, 30: 18, 80: 16}  # of a fraction: 1 g is 2^n counts
_FORCE_OUTPUTS = {output.value: output for output in Output}


def parse_configuration(body: bytes) -> Configuration:
    """Return what a configuration datagram says.

    Raises
    ------
    ProtocolError
        If it holds a code that is not known.
    """
    fields = LAYOUTS[body[0]].parse(body)
    codes = {
        "sample rate": (fields.datagram.sample_rate, _SAMPLE_RATES),
        "bit rate": (fields.line.bit_rate, _BIT_RATES),
        "gyro output": (fields.gyro.output, range(12)),
        "accelerometer range": (fields.ranges.x, _RANGES_G),
    }
    for name, (code, known) in codes.items():
        if code not in known:
            raise ProtocolError(f"a STIM300 reports a configuration with the unknown {name} {code}")
    clusters = _cluster_flags(fields.datagram.clusters, is_pps=fields.pulse.is_pps)
    return Configuration(
        revision=printable(fields.revision),
        firmware=fields.firmware,
        sample_rate=_SAMPLE_RATES[fields.datagram.sample_rate],
        clusters=clusters,
        terminated=fields.datagram.terminated,
        bit_rate=_BIT_RATES[fields.line.bit_rate],
        axes=tuple(fields.gyro.axes),
        gyro=Output(fields.gyro.output & 3),  # from 4 on the same ones, delayed
        accelerometer=_FORCE_OUTPUTS.get(fields.accelerometer.output),
        inclinometer=_FORCE_OUTPUTS.get(fields.inclinometer.output),
        accelerometer_range_g=_RANGES_G[fields.ranges.x],
    )


def _cluster_flags(code: int, *, is_pps: bool) -> Cluster:
    """Return the clusters of the four bits PPS or AUX, temperature, inclination, acceleration."""
    clusters = Cluster(code & 7)
    if code & 8:
        clusters |= Cluster.PPS if is_pps else Cluster.AUX
    return clusters


def parse_part_number(body: bytes) -> str:
    """Return the part number, ``DDDDD-DDDDDD-DDDD`` and the revision."""
    fields = LAYOUTS[body[0]].parse(body)
    text, raw = fields.number.hex().upper(), fields.number
    tail = raw[8:11].hex().upper()  # digits 13 and 15 lie in two places, their upper halves zero
    return f"{text[1:6]}-{text[8:14]}-{tail[5]}{tail[0]}{tail[1]}{tail[2]} rev {printable(fields.revision)}"


def parse_serial_number(body: bytes) -> str:
    """Return the serial number, ``N`` and 14 digits."""
    fields = LAYOUTS[body[0]].parse(body)
    digits: str = fields.number.hex().upper()
    return printable(fields.prefix) + digits


def parse_extended_error(body: bytes) -> tuple[str, ...]:
    """Return what is wrong by the 128 bits of the extended error information, in words where they are known."""
    value = int.from_bytes(LAYOUTS[body[0]].parse(body).bits, "big")
    return tuple(_ERRORS.get(bit, f"error bit {bit}") for bit in range(128) if value >> bit & 1)


START_UP_ERROR = "start-up under way"
_ERRORS = {
    16: START_UP_ERROR,
    17: "reference voltage 1",
    18: "reference voltage 2",
    19: "reference voltage 3",
    20: "supply voltage",
    21: "regulated voltage 1",
    22: "regulated voltage 2",
    23: "regulated voltage 3",
    56: "memory",
    57: "program memory",
    58: "internal converter",
    59: "supply overvoltage",
    68: "serial port cannot send in time",
    85: "self-test does not run",
    97: "processor temperature",
    101: "gyro x overload",
    102: "gyro y overload",
    103: "gyro z overload",
    104: "accelerometer x overload",
    105: "accelerometer y overload",
    106: "accelerometer z overload",
    107: "inclinometer x overload",
    108: "inclinometer y overload",
    109: "inclinometer z overload",
    111: "reference voltage 4",
    112: "PPS time overflow",
}
