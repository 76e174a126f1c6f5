"""A node's object dictionary at work: values of the entries of ``objects``, with what happens when one is written.

A key is ``index << 8 | subindex``. Numbers are kept as integers, texts as bytes.
"""

from sim_device.firmware.objects import LONGEST_TEXT, SIGNED, SIZES, TEXT

WRITE_ONLY = 0x06010001
READ_ONLY = 0x06010002
NO_OBJECT = 0x06020000
CANNOT_BE_MAPPED = 0x06040041
MAPPING_TOO_LONG = 0x06040042
WRONG_LENGTH = 0x06070010
TOO_LONG = 0x06070012
TOO_SHORT = 0x06070013
NO_SUBINDEX = 0x06090011
OUT_OF_RANGE = 0x06090030
WRONG_STATE = 0x08000022


class Abort(Exception):  # noqa: N818 - the specification's word
    """An access is refused.

    Attributes
    ----------
    code : int
        Abort code of SDO.
    """

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


def number(kind: int, data: bytes) -> int:
    """Return the number of that type in `data`."""
    value = int.from_bytes(data, "little")
    bits = 8 * SIZES[kind]
    return value - (1 << bits) if kind in SIGNED and value >> (bits - 1) else value


def encoded(kind: int, value: "int | bytes") -> bytes:
    """Return a number of that type, or a text, as it goes over the bus."""
    if isinstance(value, bytes):
        return value
    size = SIZES[kind]
    return (value & ((1 << 8 * size) - 1)).to_bytes(size, "little")


class Dictionary:
    """The objects of one node.

    Parameters
    ----------
    entries : list
        As ``objects.variable`` makes them.
    node_id : int
        Of the node.
    """

    def __init__(self, entries: list, node_id: int) -> None:  # type: ignore[type-arg]  # MicroPython has no list[tuple]
        self._node_id = node_id
        self._entries = {entry[0] << 8 | entry[1]: entry for entry in entries}
        self._indices = {entry[0] for entry in entries}
        self._defaults = {}
        for key, entry in self._entries.items():
            self._defaults[key] = self._default(entry[4])
        self._values = dict(self._defaults)
        self._readers = {}  # type: ignore[var-annotated]  # of functions
        self._writers = {}  # type: ignore[var-annotated]  # of functions

    def _default(self, default: "int | str | tuple[int] | None") -> "int | bytes":
        if isinstance(default, tuple):
            return default[0] + self._node_id
        if isinstance(default, str):
            return default.encode()
        return default or 0

    def define(self, key: int, default: "int | str") -> None:
        """Set a default that the device knows only when it runs."""
        self._defaults[key] = self._values[key] = self._default(default)

    def on_read(self, key: int, reader: "object") -> None:
        """Let ``reader()`` give the value of a key."""
        self._readers[key] = reader

    def on_write(self, key: int, writer: "object") -> None:
        """Let ``writer(value)`` return the value to keep, or raise Abort."""
        self._writers[key] = writer

    def reset(self, first_index: int, last_index: int) -> None:
        """Set the objects of these indices to their defaults."""
        for key in self._values:
            if first_index <= key >> 8 <= last_index:
                self._values[key] = self._defaults[key]

    # by the device

    def get(self, key: int) -> int:
        """Return the number of a key."""
        reader = self._readers.get(key)
        value = self._values[key] if reader is None else reader()
        return value if isinstance(value, int) else 0

    def put(self, key: int, value: int) -> None:
        """Set the number of a key, unchecked."""
        self._values[key] = value

    def data(self, key: int) -> bytes:
        """Return the value of a key as it goes over the bus."""
        reader = self._readers.get(key)
        return encoded(self._entries[key][2], self._values[key] if reader is None else reader())

    def size(self, key: int) -> int:
        """Return how many bytes the number of a key has."""
        return SIZES[self._entries[key][2]]

    def mappable(self, target: int, forbidden: str) -> bool:
        """Return whether a mapping's entry is right: an object with its length, whose access is not `forbidden`."""
        entry = self._entries.get(target >> 8)
        if entry is None or not entry[6] or entry[3] == forbidden:
            return False
        return SIZES[entry[2]] * 8 == target & 0xFF

    # by the host

    def read(self, key: int) -> bytes:
        """Return the value of a key; raise Abort if it cannot be read."""
        if self._entry(key)[3] == "wo":
            raise Abort(WRITE_ONLY)
        return self.data(key)

    def check_writable(self, key: int) -> int:
        """Return the greatest length of what may be written; raise Abort if nothing may be."""
        entry = self._entry(key)
        if entry[3] not in {"rw", "wo"}:
            raise Abort(READ_ONLY)
        return LONGEST_TEXT if entry[2] == TEXT else SIZES[entry[2]]

    def check_length(self, key: int, length: int) -> None:
        """Raise Abort if no value of this length may be written."""
        longest = self.check_writable(key)
        if length > longest:
            raise Abort(TOO_LONG)
        if length < longest and self._entries[key][2] != TEXT:
            raise Abort(TOO_SHORT)

    def write(self, key: int, data: bytes) -> None:
        """Write a value; raise Abort if that is refused."""
        self.check_length(key, len(data))
        kind = self._entries[key][2]
        if kind == TEXT:
            self._values[key] = bytes(data)
        else:
            self.write_number(key, number(kind, data))

    def write_number(self, key: int, value: int) -> None:
        """Write a number; raise Abort if that is refused."""
        limits = self._entries[key][5]
        if limits is not None and not limits[0] <= value <= limits[1]:
            raise Abort(OUT_OF_RANGE)
        writer = self._writers.get(key)
        self._values[key] = value if writer is None else writer(value)

    def _entry(self, key: int) -> tuple:  # type: ignore[type-arg]  # MicroPython has no tuple of mixed types
        if key not in self._entries:
            raise Abort(NO_SUBINDEX if key >> 8 in self._indices else NO_OBJECT)
        return tuple(self._entries[key])
