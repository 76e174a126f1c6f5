"""CRC-32/MPEG-2 as the STIM300 and KVH's gyros use it: polynomial 04C11DB7, from all ones, highest bit first."""

from array import array


def _table() -> array:  # type: ignore[type-arg]  # MicroPython has no array[int]
    table = array("I")
    for byte in range(256):
        crc = byte << 24
        for _ in range(8):
            crc = (crc << 1 ^ 0x04C11DB7) & 0xFFFFFFFF if crc & 0x80000000 else crc << 1
        table.append(crc)
    return table


_TABLE = _table()


def crc32(data: bytes) -> int:
    """Return the CRC of `data`."""
    crc = 0xFFFFFFFF
    table = _TABLE
    for byte in data:
        crc = (crc << 8) & 0xFFFFFFFF ^ table[crc >> 24 ^ byte]
    return crc
