"""Safran Sensonor's STIM300, an inertial unit of three vibratory gyros, over RS-422: see ``docs/stim300.md``."""

from __future__ import annotations

from drivers.api import Clock, Gyro
from drivers.stim300.gyro import Stim300Gyro
from drivers.stim300.settings import Settings
from drivers.transport.serial_port import open_link

__all__ = ["DEFAULT_BAUDRATE", "Stim300Gyro", "open_gyro"]

DEFAULT_BAUDRATE = 460_800


def open_gyro(
    address: str,
    clock: Clock,
    *,
    baudrate: int = DEFAULT_BAUDRATE,
    sample_rate: float | None = None,
    output: str = "",
    configure: bool = False,
) -> Gyro:
    """Open the port of an STIM300; `connect` then speaks to it.

    Parameters
    ----------
    address, clock
        As `drivers.transport.serial_port.open_link` has them.
    baudrate
        What the unit is set to, bit/s.
    sample_rate
        Samples a second that it must be set to: 125, 250, 500, 1000 or 2000; None for any.
    output
        Of the gyros, that it must be set to: ``rate``, ``increment``, ``average`` or ``integral``; empty for any.
    configure
        Whether it may be set so, in utility mode, until it is switched off.

    Raises
    ------
    LinkError
        If the port cannot be opened.
    ValueError
        If there is no such sample rate or output.
    """
    settings = Settings.gather(sample_rate=sample_rate, output=output, configure=configure)
    return Stim300Gyro(open_link(address, clock, baudrate=baudrate), clock, settings)
