"""The object dictionary of one axis of the stage, a CiA 402 drive. See ``docs/canopen.md``, section 4."""

from sim_device.firmware.objects import (
    ARRAY,
    I8,
    I16,
    I32,
    MAP,
    RECORD,
    U8,
    U16,
    U32,
    counts,
    group,
    identity,
    member,
    receive_pdo,
    transmit_pdo,
    variable,
)

PRODUCT_CODE = 2
COUNTS_PER_TURN = 12_960_000  # 0.1 arcsec
HOMING_METHOD = 20

OBJECTS = (
    identity(0x00020192, PRODUCT_CODE)
    + receive_pdo(1, 0x200, [0x60400010, 0x607A0020])
    + receive_pdo(2, 0x300, [0x21110020])
    + transmit_pdo(1, 0x180, [0x60410010, 0x60640020, 0x60610008])
    + transmit_pdo(2, 0x280, [0x606C0020, 0x21100020])
    + [
        variable(0x2010, U8, "const", None, "Axis", (0, 1)),
        variable(0x2014, U16, "rw", 100, "Status period", (20, 1000)),
        variable(0x2110, U32, "ro", 0, "Device time", mappable=MAP),
        variable(0x2111, U32, "rw", 0, "Device time seen", mappable=MAP),
        variable(0x6007, I16, "rw", 1, "Abort connection option code", (1, 3)),
        variable(0x603F, U16, "ro", 0, "Error code", mappable=MAP),
        variable(0x6040, U16, "rw", 0, "Controlword", mappable=MAP),
        variable(0x6041, U16, "ro", 0, "Statusword", mappable=MAP),
        variable(0x605A, I16, "rw", 6, "Quick stop option code", (1, 6)),
        variable(0x605E, I16, "rw", 2, "Fault reaction option code", (1, 2)),
        variable(0x6060, I8, "rw", 0, "Modes of operation", (0, 6), MAP),
        variable(0x6061, I8, "ro", 0, "Modes of operation display", mappable=MAP),
        variable(0x6064, I32, "ro", 0, "Position actual value", mappable=MAP),
        variable(0x6065, U32, "const", None, "Following error window"),
        variable(0x6067, U32, "const", None, "Position window"),
        variable(0x606C, I32, "ro", 0, "Velocity actual value", mappable=MAP),
        variable(0x607A, I32, "rw", 0, "Target position", mappable=MAP),
        variable(0x607C, I32, "rw", 0, "Home offset", (-COUNTS_PER_TURN, COUNTS_PER_TURN)),
        variable(0x607F, U32, "const", None, "Max profile velocity"),
        variable(0x6081, U32, "rw", None, "Profile velocity", mappable=MAP),
        variable(0x6083, U32, "rw", None, "Profile acceleration", mappable=MAP),
        variable(0x6084, U32, "rw", None, "Profile deceleration", mappable=MAP),
        variable(0x6085, U32, "const", None, "Quick stop deceleration"),
        variable(0x6086, I16, "const", 0, "Motion profile type"),
        variable(0x6098, I8, "rw", HOMING_METHOD, "Homing method", (HOMING_METHOD, HOMING_METHOD)),
        variable(0x609A, U32, "rw", None, "Homing acceleration"),
        variable(0x60C5, U32, "const", None, "Max acceleration"),
        variable(0x6502, U32, "const", 0x21, "Supported drive modes"),
    ]
    + group(0x1016, ARRAY, "Consumer heartbeat time", [member(U32, "rw", None, "Consumer heartbeat time 1")])
    + group(
        0x607D,
        ARRAY,
        "Software position limit",
        [member(I32, "rw", None, "Min position limit"), member(I32, "rw", None, "Max position limit")],
    )
    + group(
        0x608F,
        RECORD,
        "Position encoder resolution",
        [member(U32, "const", COUNTS_PER_TURN, "Encoder increments"), member(U32, "const", 1, "Motor revolutions")],
    )
    + group(
        0x6099,
        ARRAY,
        "Homing speeds",
        [
            member(U32, "rw", None, "Speed during search for switch"),
            member(U32, "rw", 360, "Speed during search for zero"),
        ],
    )
)
OBJECTS += counts(OBJECTS)
