"""A rotation stage of Zaber devices, ASCII protocol version 2: ``zaber:PORT``. See ``docs/zaber.md``."""

from __future__ import annotations

from drivers.api import Clock, Stage, StageLimits
from drivers.transport.serial_port import open_link
from drivers.zaber.address import parse_address
from drivers.zaber.options import AxisOptions
from drivers.zaber.stage import ZaberStage

__all__ = ["AxisOptions", "ZaberStage", "open_stage", "stage_axes"]

BAUDRATE = 115_200  #: as delivered


def open_stage(
    address: str,
    clock: Clock,
    *,
    baudrate: int = BAUDRATE,
    limits: StageLimits | None = None,
    device: int | None = None,
    azimuth_axis: int = 1,
    elevation_axis: int | None = None,
    azimuth_units_per_deg: float | None = None,
    elevation_units_per_deg: float | None = None,
    azimuth_zero_deg: float = 0.0,
    elevation_zero_deg: float = 0.0,
) -> Stage:
    """Open the port of a Zaber stage; `connect` then speaks to it.

    Parameters
    ----------
    address
        ``PORT``, ``PORT/DEVICE``, or ``PORT/DEVICE,DEVICE`` where each axis is a device of its own.
    clock
        The host's.
    baudrate
        Bit/s.
    limits
        Narrows the limits of the devices.
    device
        Number of the device, instead of one in the address; 1 if neither is given.
    azimuth_axis, elevation_axis
        Numbers of the axes; by default 1 and 2 of one device, or 1 of either device. 0: no elevation axis.
    azimuth_units_per_deg, elevation_units_per_deg
        Microsteps of one degree, negative if the axis counts against the stage's sense.
    azimuth_zero_deg, elevation_zero_deg
        The stage's angle where the device's position is 0.

    Raises
    ------
    ValueError
        If the address or an option makes no sense.
    LinkError
        If the port cannot be opened.
    """
    port, devices = parse_address(address)
    axes = stage_axes(
        devices if device is None else (device,),
        axis_numbers=(azimuth_axis, elevation_axis),
        units_per_deg=(azimuth_units_per_deg, elevation_units_per_deg),
        zero_deg=(azimuth_zero_deg, elevation_zero_deg),
    )
    return ZaberStage(open_link(port, clock, baudrate=baudrate), clock, axes, limits=limits)


def stage_axes(
    devices: tuple[int, ...] = (),
    *,
    axis_numbers: tuple[int, int | None] = (1, None),
    units_per_deg: tuple[float | None, float | None] = (None, None),
    zero_deg: tuple[float, float] = (0.0, 0.0),
) -> list[AxisOptions]:
    """Return the axes of a stage, azimuth first; the arguments are pairs of those of `open_stage`."""
    azimuth_device = devices[0] if devices else 1
    elevation_device = devices[-1] if devices else 1
    azimuth_axis, elevation_axis = axis_numbers
    if elevation_axis is None:
        elevation_axis = 2 if elevation_device == azimuth_device else 1
    if (elevation_device, elevation_axis) == (azimuth_device, azimuth_axis):
        raise ValueError(f"azimuth and elevation are both axis {azimuth_axis} of device {azimuth_device}")
    places = [("azimuth", azimuth_device, azimuth_axis), ("elevation", elevation_device, elevation_axis)]
    return [
        AxisOptions(name=name, device=device, axis=axis, units_per_deg=units, position_zero_deg=zero)
        for (name, device, axis), units, zero in zip(places, units_per_deg, zero_deg, strict=True)
        if axis or name == "azimuth"
    ]
