"""A rotation stage of two CiA 402 drives on a CAN bus: ``cia402-stage:BUS/AZIMUTH,ELEVATION``."""

from __future__ import annotations

from drivers.api import Clock, Stage, StageLimits
from drivers.canopen.address import parse_node_address
from drivers.canopen.node import MAX_SILENCE
from drivers.cia402.options import DriveOptions
from drivers.cia402.stage import IDENTIFIERS, Cia402Stage
from drivers.transport.can_bus import open_bus
from drivers.transport.serial_port import DEFAULT_BAUDRATE

__all__ = ["Cia402Stage", "DriveOptions", "open_stage"]


def open_stage(
    address: str,
    clock: Clock,
    *,
    baudrate: int = DEFAULT_BAUDRATE,
    limits: StageLimits | None = None,
    drive: DriveOptions | None = None,
    max_silence: float = MAX_SILENCE,
) -> Stage:
    """Open the bus of a stage; `connect` then speaks to it. `baudrate` is that of an slcan adapter's serial port.

    Raises
    ------
    ValueError
        If `address` names no two nodes of a bus.
    LinkError
        If the bus cannot be opened.
    """
    where = parse_node_address(address, 2)
    links = []
    try:
        for node in where.nodes:
            accept = [base + node for base in IDENTIFIERS]
            links.append(open_bus(where.bus, clock, accept=accept, baudrate=baudrate))
    except Exception:
        for link in links:
            link.close()
        raise
    return Cia402Stage(links, clock, where.nodes, limits=limits, options=drive, max_silence=max_silence)
