"""The gyro of ``docs/canopen.md`` on a CAN bus: ``canopen-gyro:BUS/NODE``."""

from __future__ import annotations

from drivers.api import Clock, Gyro
from drivers.canopen.address import parse_node_address
from drivers.canopen.node import MAX_SILENCE
from drivers.canopen_gyro.gyro import IDENTIFIERS, CanopenGyro
from drivers.transport.can_bus import open_bus
from drivers.transport.serial_port import DEFAULT_BAUDRATE

__all__ = ["CanopenGyro", "open_gyro"]


def open_gyro(
    address: str,
    clock: Clock,
    *,
    baudrate: int = DEFAULT_BAUDRATE,
    sample_rate: float | None = None,
    block_duration: float = 0.5,
    max_silence: float = MAX_SILENCE,
) -> Gyro:
    """Open the bus of a gyro; `connect` then speaks to it. `baudrate` is that of an slcan adapter's serial port.

    Bursts of `block_duration` s are asked for, as of a gyro on a serial line: a dwell begins with a whole block, so the
    dwells of both hold the same samples.

    Raises
    ------
    ValueError
        If `address` names no node of a bus.
    LinkError
        If the bus cannot be opened.
    """
    where = parse_node_address(address, 1)
    node = where.nodes[0]
    link = open_bus(where.bus, clock, accept=[base + node for base in IDENTIFIERS], baudrate=baudrate)
    return CanopenGyro(
        link, clock, node, sample_rate=sample_rate, block_duration=block_duration, max_silence=max_silence
    )
