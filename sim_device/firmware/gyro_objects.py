"""The gyro's object dictionary. See ``docs/canopen.md``, section 3."""

from sim_device.firmware.objects import (
    ARRAY,
    I16,
    I24,
    I32,
    MAP,
    SAMPLE,
    U8,
    U16,
    U24,
    U32,
    U40,
    counts,
    group,
    identity,
    member,
    receive_pdo,
    transmit_pdo,
    variable,
)

PRODUCT_CODE = 1


def _sample(axis: int) -> list[int]:
    """Return the mapping of an axis: its rate, the sample's number and status."""
    return [0x21000020 | axis << 8, 0x21010018, 0x21020008]


OBJECTS = (
    identity(0, PRODUCT_CODE)
    + receive_pdo(1, 0x200, [0x21100020])
    + transmit_pdo(1, 0x180, _sample(1), SAMPLE)
    + transmit_pdo(2, 0x280, [0x21030018, 0x21040028])
    + transmit_pdo(3, 0x380, [0x21050010, 0x21060118, 0x21060218])
    + transmit_pdo(4, 0x480, _sample(2), SAMPLE)
    + transmit_pdo(5, 0x500, _sample(3), SAMPLE)
    + [
        variable(0x2010, U32, "rw", None, "Sample rate"),
        variable(0x2011, U32, "const", None, "Range"),
        variable(0x2012, U8, "const", None, "Number of axes"),
        variable(0x2013, U8, "rw", None, "Samples in a burst", (1, 255)),
        variable(0x2014, U16, "rw", 1000, "Slow period", (100, 10_000)),
        variable(0x2020, U8, "rw", 0, "Stream", (0, 1)),
        variable(0x2101, U24, "ro", 0, "Sample number", mappable=MAP),
        variable(0x2102, U8, "ro", 0, "Sample status", mappable=MAP),
        variable(0x2103, U24, "ro", 0, "Time mark number", mappable=MAP),
        variable(0x2104, U40, "ro", 0, "Time mark", mappable=MAP),
        variable(0x2105, I16, "ro", 0, "Temperature", mappable=MAP),
        variable(0x2107, U32, "ro", 0, "Samples lost", mappable=MAP),
        variable(0x2110, U32, "rw", 0, "Samples seen", mappable=MAP),
    ]
    + group(
        0x2100,
        ARRAY,
        "Rate",
        [
            member(I32, "ro", 0, "Rate, axis 1", mappable=MAP),
            member(I32, "ro", 0, "Rate, axis 2", mappable=MAP),
            member(I32, "ro", 0, "Rate, axis 3", mappable=MAP),
        ],
    )
    + group(
        0x2106,
        ARRAY,
        "Tilt",
        [
            member(I24, "ro", 0, "Tilt x", mappable=MAP),
            member(I24, "ro", 0, "Tilt y", mappable=MAP),
        ],
    )
)
OBJECTS += counts(OBJECTS)
