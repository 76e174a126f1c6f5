"""The native gyro and stage: the devices of ``docs/protocol.md``, over a serial port or TCP."""

from __future__ import annotations

from drivers.api import Clock, Gyro, Stage, StageLimits
from drivers.native.gyro import NativeGyro
from drivers.native.stage import NativeStage
from drivers.transport.serial_port import DEFAULT_BAUDRATE, open_link

__all__ = ["NativeGyro", "NativeStage", "open_gyro", "open_stage"]


def open_gyro(
    address: str,
    clock: Clock,
    *,
    baudrate: int = DEFAULT_BAUDRATE,
    sample_rate: float | None = None,
    block_duration: float = 0.5,
) -> Gyro:
    """Open the port of a native gyro; `connect` then speaks to it.

    Raises
    ------
    LinkError
        If the port cannot be opened.
    """
    link = open_link(address, clock, baudrate=baudrate)
    return NativeGyro(link, clock, sample_rate=sample_rate, block_duration=block_duration)


def open_stage(
    address: str,
    clock: Clock,
    *,
    baudrate: int = DEFAULT_BAUDRATE,
    limits: StageLimits | None = None,
) -> Stage:
    """Open the port of a native stage; `connect` then speaks to it.

    Raises
    ------
    LinkError
        If the port cannot be opened.
    """
    return NativeStage(open_link(address, clock, baudrate=baudrate), clock, limits=limits)
