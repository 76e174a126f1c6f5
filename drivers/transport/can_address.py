"""Addresses of CAN buses: ``INTERFACE:CHANNEL[@BITRATE]``, such as ``slcan:/dev/ttyACM0@1000000``.

INTERFACE is python-can's name of a kind of adapter, CHANNEL what this kind calls one of its buses, BITRATE in bit/s.
Where the operating system or a server has set the bit rate it may be left out, and is not set again.
"""

from __future__ import annotations

from dataclasses import dataclass

#: What each interface needs, with an example of a channel.
INTERFACES = {
    "kvaser": "0",
    "pcan": "PCAN_USBBUS1",
    "slcan": "/dev/ttyACM0",
    "socketcan": "can0",
    "socketcand": "127.0.0.1:29536:can0",
    "udp_multicast": "239.74.163.2",
    "vector": "0",
    "virtual": "bench",
}
#: Interfaces whose adapter has to be told the bit rate.
SET_BITRATE = frozenset({"kvaser", "pcan", "slcan", "vector"})
MAX_BITRATE = 1_000_000  # of CAN 2.0
MIN_BITRATE = 10_000


@dataclass(frozen=True, slots=True)
class BusAddress:
    """Where a bus is."""

    interface: str
    channel: str
    bitrate: int | None = None

    @property
    def name(self) -> str:
        """The address as written, without the bit rate."""
        return f"{self.interface}:{self.channel}"

    def __str__(self) -> str:
        return self.name if self.bitrate is None else f"{self.name}@{self.bitrate}"


def parse_bus_address(text: str) -> BusAddress:
    """Return the bus that `text` names.

    Raises
    ------
    ValueError
        If it names none, with what is wrong.

    Examples
    --------
    >>> parse_bus_address("slcan:/dev/ttyACM0@1000000")
    BusAddress(interface='slcan', channel='/dev/ttyACM0', bitrate=1000000)
    """
    interface, colon, rest = text.partition(":")
    if interface not in INTERFACES or not colon:
        raise ValueError(f"{text!r} names no CAN interface: write INTERFACE:CHANNEL[@BITRATE] with one of {_known()}")
    channel, at, bitrate_text = rest.rpartition("@") if "@" in rest else (rest, "", "")
    example = INTERFACES[interface]
    if not channel or not channel.isprintable() or channel != channel.strip():
        raise ValueError(f"{text!r} names no channel: write it like {interface}:{example}")
    if interface == "socketcand":
        split_socketcand(channel)
    if not at:
        if interface in SET_BITRATE:
            raise ValueError(f"{text!r} says no bit rate: write it like {interface}:{example}@500000")
        return BusAddress(interface, channel)
    return BusAddress(interface, channel, _bitrate(text, bitrate_text))


def split_socketcand(channel: str) -> tuple[str, int, str]:
    """Return host, port and bus of a socketcand channel ``HOST:PORT:BUS``; ValueError if it is none."""
    parts = channel.rsplit(":", 2)
    if len(parts) != 3 or not all(parts) or not (parts[1].isascii() and parts[1].isdigit()) or "/" in channel:
        raise ValueError(f"{channel!r} is no bus of a socketcand server: write it like {INTERFACES['socketcand']}")
    host, port, bus = parts
    if not 0 < int(port) < 2**16:
        raise ValueError(f"the port of {channel!r} must be from 1 to 65535")
    if not (bus.isascii() and bus.replace("_", "").replace("-", "").replace(".", "").isalnum()):
        raise ValueError(f"{bus!r} in {channel!r} is no name of a bus, such as can0")
    return host.strip("[]"), int(port), bus


def _bitrate(text: str, bitrate: str) -> int:
    if not (bitrate.isascii() and bitrate.isdigit() and MIN_BITRATE <= int(bitrate[:9]) <= MAX_BITRATE):
        raise ValueError(
            f"the bit rate {bitrate!r} in {text!r} must be a number from {MIN_BITRATE} to {MAX_BITRATE} bit/s"
        )
    return int(bitrate)


def _known() -> str:
    return ", ".join(sorted(INTERFACES))
