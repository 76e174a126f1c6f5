"""Serving the bench on a CAN bus: where hosts reach it, and the faults of the bus.

Of the faults of `sim_device.faults`, a bus has ``gyro:`` and ``stage:`` ``drop=P`` (each frame is lost with probability
P), ``freeze@T+D`` and ``reset@T``, and those of the plant. Its own are ``bus:unplug@T`` (the adapter is gone from then
on) and ``bus:off@T+D`` (the hosts' controllers are off the bus).
"""

from __future__ import annotations

from typing import Protocol

from sim_device.can_bench import AZIMUTH_ID, ELEVATION_ID, GYRO_ID, CanBench
from sim_device.faults import FaultSpec, link_faults, schedule
from sim_device.slcan import SlcanPort
from sim_device.socketcand import SocketcandPort

BUSES = ("socketcand", "slcan")
_OF_BUS = ("unplug", "off")
_OF_LINE = ("drop", "freeze")


class CanPort(Protocol):
    """Where hosts reach the bus."""

    @property
    def address(self) -> str:
        """INTERFACE:CHANNEL, without the bit rate."""

    @property
    def handles(self) -> tuple[int, ...]:
        """File descriptors that tell when a host has said something."""

    def take_in(self, now_us: int) -> None:
        """Do what the hosts say."""

    def bring_out(self) -> bool:
        """Tell the hosts what they have to hear; return whether there was something."""

    def close(self) -> None:
        """Take the place away."""


class BusConnection:
    """The bus behind its port."""

    def __init__(self, bench: CanBench, port: CanPort) -> None:
        self.port = port
        self._bench = bench

    @property
    def plugged(self) -> bool:
        """Whether the port is there."""
        return not self._bench.wire.unplugged

    @property
    def addresses(self) -> dict[str, str]:
        """What the host opens, by device."""
        bus = f"{self.port.address}@{self._bench.wire.bitrate}"
        nodes = {"gyro": f"{GYRO_ID}", "stage": f"{AZIMUTH_ID},{ELEVATION_ID}"}
        drivers = {"gyro": "canopen-gyro", "stage": "cia402-stage"}
        served = {seat.name for seat in self._bench.lines}
        return {name: f"{drivers[name]}:{bus}/{nodes[name]}" for name in ("gyro", "stage") if name in served}

    def take_in(self, now_us: int) -> None:
        """Hand the nodes what hosts have said."""
        if self.plugged:
            self.port.take_in(now_us)

    def bring_out(self, now_us: int) -> bool:  # noqa: ARG002 - the frames know when they were sent
        """Tell hosts what nodes have said; return whether there was something."""
        if self.plugged:
            return self.port.bring_out()
        self.port.close()
        return False


def open_port(bench: CanBench, bus: str, host: str) -> CanPort:
    """Return the port of a kind of bus; ValueError if there is none."""
    if bus == "socketcand":
        return SocketcandPort(bench.wire, host)
    if bus != "slcan":
        raise ValueError(f"no bus {bus!r}: one of {', '.join(BUSES)}")
    try:
        return SlcanPort(bench.wire)
    except (ImportError, AttributeError):
        raise ValueError("there are no pseudo-terminals on this system: serve socketcand instead of slcan") from None


def schedule_bus(specs: list[FaultSpec], bench: CanBench) -> None:
    """Let the faults happen; ValueError if there is no such fault on a bus."""
    plant = []
    for spec in specs:
        if spec.device == "bus":
            _schedule_of_bus(spec, bench)
        elif spec.name in {"duplicate", "garbage", "delay", "flip", "unplug"}:
            raise ValueError(
                f"fault {spec.text!r}: a line's; a bus has {', '.join((*_OF_LINE, 'reset'))}, bus:unplug@T"
            )
        elif spec.name not in _OF_LINE:
            plant.append(spec)
    for seat in bench.lines:
        faults = link_faults(specs, seat.name)
        seat.drop, seat.freezes_us = faults.drop, faults.freezes_us
    schedule(plant, bench)


def _schedule_of_bus(spec: FaultSpec, bench: CanBench) -> None:
    if spec.name not in _OF_BUS:
        raise ValueError(f"fault {spec.text!r}: a bus has {' and '.join(_OF_BUS)}")
    if spec.name == "unplug":
        bench.at(spec.instant_us(), bench.wire.unplug)
        return
    bench.at(spec.instant_us(), lambda: bench.wire.switch_off(off=True))
    if spec.duration_us is not None:
        bench.at(spec.instant_us() + spec.duration_us, lambda: bench.wire.switch_off(off=False))
