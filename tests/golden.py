"""The golden frames of ``docs/protocol.md`` section 7, typed, with the values each holds.

Field names are those of the definition in section 6; values are in wire units, written as physical value times unit.
"""

from dataclasses import dataclass

DEG = 36_000  #: 0.1 arcsec in a degree; also 0.1 arcsec/s in a deg/s
ARCSEC = 10  #: 0.1 arcsec in an arcsec
DPH = 1024  #: 2^-10 deg/h in a deg/h
CELSIUS = 256  #: 1/256 degree in a degree Celsius

SESSION = 0x5EED1234
DEFINITION_HASH = 0x66B325A6


@dataclass(frozen=True, slots=True)
class Golden:
    """One frame as it goes over the line, delimiter included, and what it says."""

    name: str  #: message name of the definition, then what tells it from others of that name
    frame: bytes
    values: dict[str, object]  #: every field in order; ``rate`` is a list, all axes of a sample together

    @property
    def message(self) -> str:
        """The message's name in the definition."""
        return self.name.split(",")[0]


def _counts(lsb_per_unit: int, *physical: float) -> list[int]:
    """Return physical values in wire units."""
    return [round(value * lsb_per_unit) for value in physical]


GOLDEN = [
    Golden(
        "HELLO",
        bytes.fromhex("0301010da625b3663412ed5e9204686100"),
        {"type": 0x01, "protocol_version": 1, "definition_hash": DEFINITION_HASH, "session": SESSION},
    ),
    Golden(
        "IDENTITY, gyro",
        bytes.fromhex(
            "0381010ba625b3663412ed5e01070101044e61bc01010101067476673433010101010101010101010b54564734332d30"
            "303137010101010106312e302e300101054041f47900"
        ),
        {
            "type": 0x81,
            "protocol_version": 1,
            "definition_hash": DEFINITION_HASH,
            "session": SESSION,
            "device_kind": 1,
            "boot_count": 7,
            "device_time_us": 12_345_678,
            "model": b"tvg43" + bytes(11),
            "serial_number": b"TVG43-0017" + bytes(6),
            "firmware_version": b"1.0.0" + bytes(3),
        },
    ),
    Golden(
        "HEARTBEAT",
        bytes.fromhex("0a023412ed5e60b2920501010105e61efbd100"),
        {"type": 0x02, "session": SESSION, "seen_time_us": 93_500_000},
    ),
    Golden(
        "SET_CONFIG_GYRO",
        bytes.fromhex("07043412ed5e02010104f895030101010101022f0105bebe58b000"),
        {
            "type": 0x04,
            "session": SESSION,
            "request_id": 2,
            "sample_rate_millihz": 235_000,
            "range_dph": 0,
            "n_axes": 0,
            "block_samples": 47,
            "reserved": 0,
        },
    ),
    Golden(
        "GYRO_CONFIG",
        bytes.fromhex("07833412ed5e02010104f8950304c07a1003012f0105e912ec7c00"),
        {
            "type": 0x83,
            "session": SESSION,
            "request_id": 2,
            "sample_rate_millihz": 235_000,
            "range_dph": 1_080_000,
            "n_axes": 1,
            "block_samples": 47,
            "reserved": 0,
        },
    ),
    Golden(
        "SELF_TEST_RESULT",
        bytes.fromhex("07853412ed5e0301010214058f41e83500"),
        {"type": 0x85, "session": SESSION, "request_id": 3, "failures": 1 << 2 | 1 << 4},
    ),
    Golden(
        "STREAM_START",
        bytes.fromhex("07103412ed5e040101053c58b21600"),
        {"type": 0x10, "session": SESSION, "request_id": 4},
    ),
    Golden(
        "ACK",
        bytes.fromhex("07c03412ed5e0401010585f7131400"),
        {"type": 0xC0, "session": SESSION, "request_id": 4},
    ),
    Golden(
        "MOVE",
        bytes.fromhex("07213412ed5e05010104c0509408c08fceff40e30904d0dd06057cecf8c200"),
        {
            "type": 0x21,
            "session": SESSION,
            "request_id": 5,
            "azimuth": 270 * DEG,
            "elevation": -90 * DEG,
            "azimuth_speed": 18 * DEG,
            "elevation_speed": 25 * DEG // 2,
        },
    ),
    Golden(
        "ERROR",
        bytes.fromhex("07ff3412ed5e0501010208020101010521064bcc00"),
        {"type": 0xFF, "session": SESSION, "request_id": 5, "code": 8, "detail": 1},
    ),
    Golden(
        "STAGE_CONFIG",
        bytes.fromhex("07a33412ed5e0601010880422fff80bdd008a0d0cbff602f340440e30904a0f1040264072c01267c836600"),
        {
            "type": 0xA3,
            "session": SESSION,
            "request_id": 6,
            "azimuth_min": -380 * DEG,
            "azimuth_max": 380 * DEG,
            "elevation_min": -95 * DEG,
            "elevation_max": 95 * DEG,
            "max_speed": 18 * DEG,
            "max_acceleration": 9 * DEG,
            "status_period_ms": 100,
            "watchdog_ms": 300,
        },
    ),
    Golden(
        "SAMPLES, one axis",
        bytes.fromhex(
            "04400103073412ed5e5c1201057b2d31010101010202048018020101032c01010583ffffff02ae01010409fcff029901"
            "05a12e77c900"
        ),
        {
            "type": 0x40,
            "n_axes": 1,
            "n_samples": 3,
            "reserved": 0,
            "session": SESSION,
            "first_index": 4700,
            "device_time_us": 20_000_123,
            "status": 1 << 1,
            "temperature": 49 * CELSIUS // 2,
            "overrun_count": 2,
            "tilt_x": 30 * ARCSEC,
            "tilt_y": -25 * ARCSEC // 2,
            "rate": _counts(DPH, 43.5, -253.75, 38.25),
        },
    ),
    Golden(
        "SAMPLES, three axes",
        bytes.fromhex(
            "044003020d3412ed5effffffff20459bd6010101010103c0fa0101010101010103a08c01010226010104fbffff04d1ff"
            "ff022a01010203010108d0fffffa4b291200"
        ),
        {
            "type": 0x40,
            "n_axes": 3,
            "n_samples": 2,
            "reserved": 0,
            "session": SESSION,
            "first_index": 4_294_967_295,
            "device_time_us": 3_600_500_000,
            "status": 0,
            "temperature": -21 * CELSIUS // 4,
            "overrun_count": 0,
            "tilt_x": 0,
            "tilt_y": 3600 * ARCSEC,
            "rate": _counts(DPH, 9.5, -1.25, -11.75, 10.5, 0.75, -12),
        },
    ),
    Golden(
        "STAGE_STATUS, moving",
        bytes.fromhex("0341030a023412ed5ed03f4401010101020501010419d143089001e7ff40e309063022f9ff4d01010532466e9700"),
        {
            "type": 0x41,
            "state": 3,
            "fault": 0,
            "flags": 1 << 1,
            "session": SESSION,
            "device_time_us": 21_250_000,
            "move_id": 5,
            "azimuth": 4_444_441,  # 123.4567 deg
            "elevation": -91 * DEG // 2,
            "azimuth_rate": 18 * DEG,
            "elevation_rate": -25 * DEG // 2,
            "status_count": 77,
        },
    ),
    Golden(
        "STAGE_STATUS, fault",
        bytes.fromhex("0d410501023412ed5ef0e04b01010101020501010440694705c088e4ff0101010101010102520101051298948700"),
        {
            "type": 0x41,
            "state": 5,
            "fault": 1,
            "flags": 1 << 1,
            "session": SESSION,
            "device_time_us": 21_750_000,
            "move_id": 5,
            "azimuth": 130 * DEG,
            "elevation": -50 * DEG,
            "azimuth_rate": 0,
            "elevation_rate": 0,
            "status_count": 82,
        },
    ),
]
