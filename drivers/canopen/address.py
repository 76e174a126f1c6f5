"""Addresses of CANopen devices: ``BUS/NODE[,NODE]``, such as ``socketcan:can0@500000/32,33``."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.transport.can_address import BusAddress, parse_bus_address

MAX_NODE = 127


@dataclass(frozen=True, slots=True)
class NodeAddress:
    """Nodes of one device on one bus."""

    bus: BusAddress
    nodes: tuple[int, ...]


def parse_node_address(text: str, n_nodes: int) -> NodeAddress:
    """Return the device that `text` names, which must have so many nodes.

    Raises
    ------
    ValueError
        If it names none, with what is wrong.

    Examples
    --------
    >>> parse_node_address("socketcan:can0@500000/32,33", 2)
    NodeAddress(bus=BusAddress(interface='socketcan', channel='can0', bitrate=500000), nodes=(32, 33))
    """
    bus, slash, nodes_text = text.rpartition("/")
    parts = nodes_text.split(",")
    if not slash or not all(part.isascii() and part.isdigit() for part in parts):
        raise ValueError(f"{text!r} names no node: write {_example(n_nodes)}")
    nodes = tuple(int(part[:9]) for part in parts)
    if len(nodes) != n_nodes:
        raise ValueError(f"{text!r} names {len(nodes)} nodes, this device has {n_nodes}: write {_example(n_nodes)}")
    for node in nodes:
        if not 1 <= node <= MAX_NODE:
            raise ValueError(f"node {node} in {text!r} must be from 1 to {MAX_NODE}")
    if len(set(nodes)) != len(nodes):
        raise ValueError(f"{text!r} names one node twice")
    return NodeAddress(parse_bus_address(bus), nodes)


def _example(n_nodes: int) -> str:
    nodes = ",".join(str(32 + i) for i in range(n_nodes)) if n_nodes > 1 else "16"
    return f"BUS/{nodes}, for example slcan:/dev/ttyACM0@1000000/{nodes}"
