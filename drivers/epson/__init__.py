"""Epson's inertial sensors M-G320 to M-G370 on a UART: ``epson:PORT``. See ``docs/epson.md``."""

from __future__ import annotations

from drivers.api import Clock, Gyro
from drivers.epson.gyro import EpsonGyro
from drivers.epson.settings import check_options
from drivers.transport.serial_port import open_link

__all__ = ["EpsonGyro", "open_gyro"]

BAUDRATE = 460_800  #: as delivered


def open_gyro(
    address: str,
    clock: Clock,
    *,
    baudrate: int = BAUDRATE,
    sample_rate: float = 125.0,
    bits: int = 32,
    axis: str = "",
) -> Gyro:
    """Open the port of an Epson sensor; `connect` then configures it.

    Parameters
    ----------
    address, clock
        As `drivers.transport.serial_port.open_link` has them.
    baudrate
        What the unit is set to.
    sample_rate
        Samples a second that it is set to.
    bits
        Of each number: 32.
    axis
        The one axis to use, ``x``, ``y`` or ``z``; empty for all three.

    Raises
    ------
    LinkError
        If the port cannot be opened.
    ValueError
        If there is no such sample rate or axis, or numbers of 16 bits are asked for.
    """
    check_options(sample_rate=sample_rate, bits=bits, axis=axis)
    return EpsonGyro(open_link(address, clock, baudrate=baudrate), clock, sample_rate=sample_rate, axis=axis)
