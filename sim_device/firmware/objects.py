"""Object dictionaries as data: CiA 301 types and the entries that every node has.

An entry is ``(index, subindex, type, access, default, limits, mappable, name)``. The default is an integer, a text, a
tuple ``(base,)`` that stands for ``base`` plus the node's own id, or None where the device knows it only when it runs.
Limits are ``(low, high)`` or None. Access is ``ro``, ``rw``, ``wo`` or ``const``. Subindex 0 of records and arrays is
made from their entries (`counts`). See ``docs/canopen.md``.
"""

I8 = 0x02
I16 = 0x03
I32 = 0x04
U8 = 0x05
U16 = 0x06
U32 = 0x07
TEXT = 0x09
I24 = 0x10
U24 = 0x16
U40 = 0x18

#: Bytes of each type of number.
SIZES = {I8: 1, I16: 2, I32: 4, U8: 1, U16: 2, U32: 4, I24: 3, U24: 3, U40: 5}
SIGNED = (I8, I16, I32, I24)
LONGEST_TEXT = 100

EVENT = 255  # transmission type: when the device profile says so
SAMPLE = 254  # transmission type: with each sample
PDO_INVALID = 0x80000000
NO_REMOTE = 0x40000000  # no remote frames: this node answers none

ARRAY = 8
RECORD = 9
MAP = 1  # may be mapped to a PDO
N_MAPPED = 4  # entries of a mapping, at most

#: Kind and name of each index that has subindices.
GROUPS: dict[int, tuple[int, str]] = {}


def variable(
    index: int,
    kind: int,
    access: str,
    default: "int | str | tuple[int] | None",
    name: str,
    limits: "tuple[int, int] | None" = None,
    mappable: int = 0,
    subindex: int = 0,
) -> tuple:  # type: ignore[type-arg]  # MicroPython has no tuple of mixed types
    """Return an entry."""
    return (index, subindex, kind, access, default, limits, mappable, name)


def member(
    kind: int,
    access: str,
    default: "int | str | tuple[int] | None",
    name: str,
    limits: "tuple[int, int] | None" = None,
    mappable: int = 0,
) -> tuple:  # type: ignore[type-arg]  # as `variable`
    """Return a member of a record or array, for `group`."""
    return (kind, access, default, name, limits, mappable)


def group(index: int, kind: int, name: str, members: list) -> list:  # type: ignore[type-arg]  # as `variable`
    """Return the entries of a record or array."""
    GROUPS[index] = (kind, name)
    entries = []
    for number, (of_type, access, default, title, limits, mappable) in enumerate(members):
        entries.append(variable(index, of_type, access, default, title, limits, mappable, number + 1))
    return entries


def identity(device_type: int, product_code: int) -> list:  # type: ignore[type-arg]  # as `variable`
    """Return what every node has."""
    entries = [
        variable(0x1000, U32, "const", device_type, "Device type"),
        variable(0x1001, U8, "ro", 0, "Error register", mappable=MAP),
        variable(0x1005, U32, "const", 0x80, "COB-ID SYNC message"),
        variable(0x1008, TEXT, "const", None, "Manufacturer device name"),
        variable(0x1009, TEXT, "const", "1", "Manufacturer hardware version"),
        variable(0x100A, TEXT, "const", "1.0.0", "Manufacturer software version"),
        variable(0x1014, U32, "const", (0x80,), "COB-ID EMCY"),
        variable(0x1017, U16, "rw", 100, "Producer heartbeat time"),
        variable(0x2002, U32, "const", None, "Boot count"),
        variable(0x2003, TEXT, "const", None, "Serial number text"),
        variable(0x2004, TEXT, "rw", "", "User text"),
    ]
    entries += group(
        0x1018,
        RECORD,
        "Identity object",
        [
            member(U32, "const", 0, "Vendor-ID"),
            member(U32, "const", product_code, "Product code"),
            member(U32, "const", 0x00010000, "Revision number"),
            member(U32, "const", None, "Serial number"),
        ],
    )
    entries += group(
        0x1200,
        RECORD,
        "SDO server parameter",
        [
            member(U32, "const", (0x600,), "COB-ID client to server"),
            member(U32, "const", (0x580,), "COB-ID server to client"),
        ],
    )
    entries += group(
        0x2030,
        RECORD,
        "Self-test",
        [
            member(U8, "rw", 0, "Start", (0, 1)),
            member(U8, "ro", 0, "State", (0, 2)),
            member(U16, "ro", 0, "Failures"),
        ],
    )
    return entries


def receive_pdo(number: int, identifier: int, mapped: list) -> list:  # type: ignore[type-arg]  # as `variable`
    """Return the entries of receive PDO `number`, counted from 1, on `identifier` plus the node's id."""
    parameters = [
        member(U32, "rw", (identifier,), "COB-ID used by RPDO"),
        member(U8, "rw", EVENT, "Transmission type"),
    ]
    return _pdo(0x1400 + number - 1, f"RPDO {number}", parameters, "rw", mapped)


def transmit_pdo(number: int, identifier: int, mapped: list, kind: int = EVENT) -> list:  # type: ignore[type-arg]  # as `variable`
    """Return the entries of transmit PDO `number`; one of kind SAMPLE cannot be mapped otherwise."""
    access = "const" if kind == SAMPLE else "rw"
    parameters = [
        member(U32, "rw", (identifier | NO_REMOTE,), "COB-ID used by TPDO"),
        member(U8, access, kind, "Transmission type"),
        member(U16, access, 0, "Inhibit time"),
        member(U8, "const", 0, "Reserved"),
        member(U16, access, 0, "Event timer"),
    ]
    return _pdo(0x1800 + number - 1, f"TPDO {number}", parameters, access, mapped)


def _pdo(index: int, name: str, parameters: list, access: str, mapped: list) -> list:  # type: ignore[type-arg]  # as above
    entries = group(index, RECORD, name + " communication parameter", parameters)
    targets = [
        member(U32, access, mapped[number] if number < len(mapped) else 0, f"Mapped object {number + 1}")
        for number in range(N_MAPPED)
    ]
    entries += group(index + 0x200, RECORD, name + " mapping parameter", targets)
    entries.append(variable(index + 0x200, U8, access, len(mapped), "Number of mapped objects", (0, N_MAPPED)))
    return entries


def counts(entries: list) -> list:  # type: ignore[type-arg]  # as `variable`
    """Return the entries of subindex 0 that `entries` lack: the highest subindex of each record and array."""
    highest: dict[int, int] = {}
    given = set()
    for entry in entries:
        index, subindex = entry[0], entry[1]
        highest[index] = max(highest.get(index, 0), subindex)
        if subindex == 0:
            given.add(index)
    return [
        variable(index, U8, "const", number, "Highest subindex supported")
        for index, number in sorted(highest.items())
        if index not in given
    ]
