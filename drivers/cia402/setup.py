"""Getting to know a drive and telling it how it is used: what is written is read back before it is enabled."""

from __future__ import annotations

from math import tau

import canopen

from drivers.api import DeviceIdentity, StageLimits
from drivers.canopen.identity import PROTOCOL
from drivers.canopen.node import HEARTBEAT_MS
from drivers.canopen.objects import MissingObjectError, Objects
from drivers.cia402.axis import AXIS_NAMES, Axis
from drivers.cia402.options import DriveOptions
from drivers.cia402.power import Wait
from drivers.cia402.words import FAULTY, Control, DriveState
from drivers.errors import DeviceFaultError, ProtocolError
from drivers.limits import AxisLimits

HOST_NODE = 127
STATUS_PERIOD_MS = 100  # of a drive in motion
_DRIVE_PROFILE = 402
_FASTEST_WATCHDOG_MS, _SLOWEST_WATCHDOG_MS, _WATCHDOG_MS = 100, 300, 200
_FAULT = 1  # of 6007: loss of the host is one
_QUICK_STOP_RAMP = 2  # of 605E: on it a fault brings the axis to rest


def meet(axis: Axis) -> DeviceIdentity:
    """Return who a node is, which must be a drive of CiA 402; for ours, of this axis.

    Raises
    ------
    DeviceTimeoutError
        If the node does not answer.
    ProtocolError
        If it is no drive, or the other axis.
    """
    node, objects = axis.node, axis.node.objects
    node.greet()
    device_type = objects.read(0x1000)
    if device_type & 0xFFFF != _DRIVE_PROFILE:
        raise ProtocolError(f"{node.name} is no drive of CiA 402: its device type is {device_type:08X}")
    axis.ours = all(objects.read(0x1018, subindex) == objects.default(0x1018, subindex) for subindex in (1, 2))
    if axis.ours and objects.read(0x2010) != axis.index:
        raise ProtocolError(f"{node.name} is the other axis: name azimuth before elevation")
    return DeviceIdentity(
        kind="stage",
        model=_text(objects, 0x1008),
        serial_number=objects.read_text(0x2003) if axis.ours else str(objects.read(0x1018, 4)),
        firmware_version=_text(objects, 0x100A),
        protocol=f"{PROTOCOL}, CiA 402",
        boot_count=objects.read(0x2002) if axis.ours else 0,
    )


def bring_to_rest(axis: Axis, wait: Wait) -> None:
    """Stop a drive that another host has left moving, and take its power away. A latched fault stays."""
    axis.read_status()
    axis.node.order("PRE-OPERATIONAL")
    if axis.state in FAULTY:
        return
    if axis.state is DriveState.OPERATION_ENABLED:
        axis.node.objects.write(0x6040, 0, Control.QUICK_STOP)

        def rests() -> bool:
            axis.read_status()
            return not axis.velocity

        wait(rests, "rest")
    axis.node.objects.write(0x6040, 0, Control.DISABLE_VOLTAGE)
    axis.read_status()


def configure(axis: Axis) -> None:
    """Write units, homing, reactions and supervision, and read them back.

    Raises
    ------
    DeviceFaultError, ProtocolError
        If the drive refuses something it must have.
    """
    objects, options = axis.node.objects, axis.options
    axis.units = _units(objects, options, axis.index)
    axis.speed_units = abs(axis.units) if options.speed_units is None else options.speed_units / tau
    axis.acceleration_units = (
        abs(axis.units) if options.acceleration_units is None else options.acceleration_units / tau
    )
    watch_host(objects)
    objects.write(0x6007, 0, _FAULT, verify=True)
    _try(objects, 0x605E, 0, _QUICK_STOP_RAMP)
    _try(objects, 0x605A, 0, options.quick_stop)
    _try(objects, 0x607C, 0, round(options.home_offset[axis.index] * axis.units))
    if options.homing_method is not None:
        objects.write(0x6098, 0, options.homing_method, verify=True)
    for subindex, speed in ((1, options.home_speed), (2, options.home_creep)):
        if speed is not None:
            objects.write(0x6099, subindex, max(1, round(speed * axis.speed_units)), verify=True)
    if options.acceleration is not None:
        acceleration = max(1, round(options.acceleration * axis.acceleration_units))
        objects.write(0x6083, 0, acceleration, verify=True)
        _try(objects, 0x6084, 0, acceleration)
    objects.write(0x1017, 0, HEARTBEAT_MS, verify=True)


def watch_host(objects: Objects) -> None:
    """Let the drive watch the host's heartbeat, for at most 300 ms."""
    watched = objects.read(0x1016, 1)
    period_ms = watched & 0xFFFF
    if not _FASTEST_WATCHDOG_MS <= period_ms <= _SLOWEST_WATCHDOG_MS:
        period_ms = _WATCHDOG_MS
    if watched != HOST_NODE << 16 | period_ms:
        objects.write(0x1016, 1, HOST_NODE << 16 | period_ms, verify=True)


def map_pdos(axis: Axis) -> None:
    """Give the drive the PDOs of ``docs/canopen.md``; one of the market has no device time to send."""
    objects, remote = axis.node.objects, axis.node.remote
    if axis.ours:
        _save(objects, remote.rpdo[2])
    else:
        axis.use_plain_time()
    _save(objects, remote.rpdo[1])
    for pdo in (remote.tpdo[1], remote.tpdo[2]):
        _save(objects, pdo, None if axis.ours else STATUS_PERIOD_MS)  # ours have a status period of their own


def limits_of(axis: Axis, own: StageLimits | None) -> AxisLimits:
    """Return where a drive may go and how fast.

    The soft limits 607D are narrowed to `own` first, never widened.

    Raises
    ------
    ProtocolError
        If neither the drive nor the host has limits.
    """
    objects = axis.node.objects
    asked = (-float("inf"), float("inf")) if own is None else _own_limits(own, axis.index)
    lowest, highest = _soft_limits(axis, asked)
    if not (lowest > -float("inf") and highest < float("inf")):
        name = AXIS_NAMES[axis.index]
        raise ProtocolError(f"{axis.name} has no soft limits: give {name}_min_deg and {name}_max_deg")
    if lowest > highest:
        raise ValueError("the limits asked for leave the stage nowhere to go within its own")
    speed_units = objects.read_optional(0x607F) or objects.read(0x6081)
    acceleration_units = min(objects.read(0x6083), objects.read_optional(0x6084) or objects.read(0x6083))
    speed = speed_units / axis.speed_units
    return AxisLimits(
        lowest,
        highest,
        speed if own is None else min(speed, own.max_speed),
        acceleration_units / axis.acceleration_units,
    )


def _soft_limits(axis: Axis, asked: tuple[float, float]) -> tuple[float, float]:
    """Return the narrower of the limits asked for and the drive's, in rad, once the drive has them too."""
    objects, units = axis.node.objects, axis.units
    low, high = objects.read_optional(0x607D, 1), objects.read_optional(0x607D, 2)
    if low is None or high is None:
        return asked
    if low == high == 0:  # that of many a drive for none
        low, high = -(2**31), 2**31 - 1
        told = -float("inf"), float("inf")
    else:
        told = tuple(sorted((low / units, high / units)))  # type: ignore[assignment]  # two of them
    both = max(told[0], asked[0]), min(told[1], asked[1])
    if both[0] <= both[1] and both != told:
        edges = sorted(min(max(round(edge * units), low), high) for edge in both if abs(edge) != float("inf"))
        if len(edges) == 2:
            objects.write(0x607D, 1, edges[0], verify=True)
            objects.write(0x607D, 2, edges[1], verify=True)
    return both


def _own_limits(own: StageLimits, index: int) -> tuple[float, float]:
    return (own.elevation_min, own.elevation_max) if index else (own.azimuth_min, own.azimuth_max)


def _units(objects: Objects, options: DriveOptions, index: int) -> float:
    """Return a drive's position units per rad: the option's, or those of its encoder and gear."""
    told = options.units_per_turn[index]
    if told is not None:
        return told / tau
    increments, turns = objects.read_optional(0x608F, 1), objects.read_optional(0x608F, 2)
    if not increments or not turns:
        raise ProtocolError(f"{objects.name} does not tell its units: give {AXIS_NAMES[index]}_units_per_turn")
    return increments / turns / tau


def _save(objects: Objects, pdo: canopen.pdo.PdoMap, period_ms: int | None = None) -> None:
    """Write a PDO's mapping as it stands, sent on each event and at least each so many ms."""
    pdo.enabled, pdo.trans_type, pdo.event_timer = True, 255, period_ms
    pdo.inhibit_time = pdo.sync_start_value = None
    objects.save(pdo)


def _try(objects: Objects, index: int, subindex: int, value: int) -> None:
    """Write what a drive need not have."""
    try:
        objects.write(index, subindex, value, verify=True)
    except MissingObjectError:
        if value and index == 0x607C:
            raise DeviceFaultError(f"{objects.name} has no home offset: leave it out") from None


def _text(objects: Objects, index: int) -> str:
    try:
        return objects.read_text(index)
    except MissingObjectError:
        return ""
