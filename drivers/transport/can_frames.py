"""Frames as the transports pass them: identifier and data, the identifier with SocketCAN's flags.

So an error frame or a remote frame can never be taken for data, nor an identifier of 29 bits for one of 11.
"""

from __future__ import annotations

REMOTE = 1 << 30
ERROR = 1 << 29
BUS_OFF = 0x40  #: class of an error frame: the controller has switched itself off
STANDARD_MASK = 0x7FF
EXTENDED_MASK = 0x1FFF_FFFF
Frame = tuple[int, bytes]


def is_data(identifier: int) -> bool:
    """Return whether a frame of this identifier holds data."""
    return not identifier & (REMOTE | ERROR)


def is_bus_off(identifier: int) -> bool:
    """Return whether a frame tells that the controller has switched itself off."""
    return bool(identifier & ERROR and identifier & BUS_OFF)
