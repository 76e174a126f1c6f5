"""Addresses of Zaber stages: ``PORT``, ``PORT/DEVICE``, or ``PORT/DEVICE,DEVICE`` for two devices with an axis each."""

from __future__ import annotations

import re

#: A Linux pseudo-terminal's path ends in a number that is no device.
_ADDRESS = re.compile(r"(?P<port>/dev/pts/\d+|.+?)(?:/(?P<azimuth>\d{1,2})(?:,(?P<elevation>\d{1,2}))?)?", re.ASCII)


def parse_address(address: str) -> tuple[str, tuple[int, ...]]:
    """Return the port and the numbers of the devices that `address` names, none, one or two.

    >>> parse_address("/dev/ttyUSB1"), parse_address("/dev/ttyUSB1/2"), parse_address("COM3/1,2")
    (('/dev/ttyUSB1', ()), ('/dev/ttyUSB1', (2,)), ('COM3', (1, 2)))
    >>> parse_address("/dev/pts/5"), parse_address("socket://10.0.0.7:55550/1")
    (('/dev/pts/5', ()), ('socket://10.0.0.7:55550', (1,)))

    Raises
    ------
    ValueError
        If it is empty, or a device's number is not 1 to 99.
    """
    found = _ADDRESS.fullmatch(address)
    if found is None:
        raise ValueError(f"{address!r} names no port: write PORT or PORT/DEVICE, for example /dev/ttyUSB1/1")
    devices = tuple(int(number) for number in found.group("azimuth", "elevation") if number is not None)
    if 0 in devices:
        raise ValueError(f"{address!r} names device 0, which is all of them: a device has a number of 1 to 99")
    return found["port"], devices
