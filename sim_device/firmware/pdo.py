"""One PDO of a node, as its parameters and mapping in the object dictionary say (CiA 301, 7.5.2)."""

from sim_device.firmware.dictionary import (
    CANNOT_BE_MAPPED,
    MAPPING_TOO_LONG,
    OUT_OF_RANGE,
    WRONG_STATE,
    Abort,
    Dictionary,
)
from sim_device.firmware.objects import N_MAPPED, PDO_INVALID

_EXTENDED = 1 << 29
_FIRST_EVENT_TYPE = 254
_LAST_SYNC_TYPE = 240


def _restricted(identifier: int) -> bool:
    """Return whether an identifier belongs to another service (CiA 301, table 41)."""
    return (
        identifier <= 0x180
        or 0x580 < identifier < 0x600
        or 0x600 < identifier < 0x680
        or identifier >= 0x6E0
    )  # fmt: skip


class Pdo:
    """A PDO.

    Parameters
    ----------
    dictionary : Dictionary
        Of the node.
    index : int
        Of its communication parameter.

    Attributes
    ----------
    identifier : int
        Of its frames, -1 if it is invalid.
    kind : int
        Transmission type.
    keys : list
        Of the mapped objects.
    length : int
        In bytes.
    timer_us : int
        Longest time between two of its frames, 0 if there is none.
    """

    def __init__(self, dictionary: Dictionary, index: int) -> None:
        self.triggered = False  # to be sent
        self.n_syncs = 0  # since it was sent last
        self.sent_us = 0
        self.received = b""  # waits for SYNC
        self._dictionary = dictionary
        self._com = index << 8
        self._map = (index + 0x200) << 8
        self._transmits = index >= 0x1800
        dictionary.on_write(self._com + 1, self._set_identifier)
        dictionary.on_write(self._com + 2, self._set_kind)
        if self._transmits:
            dictionary.on_write(self._com + 5, self._set_timer)
        dictionary.on_write(self._map, self._set_count)
        for subindex in range(1, N_MAPPED + 1):
            dictionary.on_write(self._map + subindex, self._set_entry)
        self.compile()

    def compile(self) -> None:
        """Take up what the dictionary says."""
        get = self._dictionary.get
        self._adopt(get(self._com + 1))
        self.kind = get(self._com + 2)
        self.timer_us = get(self._com + 5) * 1000 if self._transmits else 0
        self._adopt_count(get(self._map))
        self.triggered = False
        self.n_syncs = 0
        self.received = b""

    def data(self) -> bytes:
        """Return the mapped objects' present values."""
        return b"".join([self._dictionary.data(key) for key in self.keys])

    def _adopt(self, value: int) -> None:
        self.identifier = -1 if value & PDO_INVALID else value & 0x7FF

    def _adopt_count(self, count: int) -> None:
        targets = [self._dictionary.get(self._map + 1 + number) for number in range(count)]
        self.keys = [target >> 8 for target in targets]
        self.length = sum([target & 0xFF for target in targets]) // 8

    # writers

    def _set_identifier(self, value: int) -> int:
        identifier = value & 0x7FF
        if value & _EXTENDED or value & 0x1FFFF800 or _restricted(identifier):
            raise Abort(OUT_OF_RANGE)
        if not value & PDO_INVALID and self.identifier not in {-1, identifier}:
            raise Abort(WRONG_STATE)
        self._adopt(value)
        return value

    def _set_kind(self, value: int) -> int:
        if _LAST_SYNC_TYPE < value < _FIRST_EVENT_TYPE:
            raise Abort(OUT_OF_RANGE)
        self.kind = value
        self.n_syncs = 0
        return value

    def _set_timer(self, value: int) -> int:
        self.timer_us = value * 1000
        return value

    def _set_entry(self, value: int) -> int:
        self._check_free()
        if self._dictionary.get(self._map):
            raise Abort(WRONG_STATE)
        if value and not self._dictionary.mappable(value, "wo" if self._transmits else "ro"):
            raise Abort(CANNOT_BE_MAPPED)
        return value

    def _set_count(self, count: int) -> int:
        self._check_free()
        targets = [self._dictionary.get(self._map + 1 + number) for number in range(count)]
        if 0 in targets:
            raise Abort(CANNOT_BE_MAPPED)
        if sum([target & 0xFF for target in targets]) > 64:
            raise Abort(MAPPING_TOO_LONG)
        self._adopt_count(count)
        return count

    def _check_free(self) -> None:
        if self.identifier != -1:
            raise Abort(WRONG_STATE)
