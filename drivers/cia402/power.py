"""Modes of operation and power of a drive at rest: asked for step by step, each waited for."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from drivers.cia402.axis import Axis
from drivers.cia402.words import FAULTY, HOMING, PROFILE_POSITION, Control, DriveState, Status
from drivers.errors import DeviceFaultError

_MODE, _MODE_SHOWN = (0x6060, 0), (0x6061, 0)

Wait = Callable[[Callable[[], bool], str], None]  #: waits until something is so, which is named for messages


def see_homed(axis: Axis, wait: Wait) -> None:
    """Ask an axis at rest whether it is homed: in homing mode bit 12 tells."""
    _set_mode(axis, HOMING, wait)
    axis.homed = bool(axis.statusword & Status.HOMED)


def enable(axis: Axis, mode: int, wait: Wait) -> None:
    """Bring an axis at rest to OPERATION ENABLED in a mode of operation.

    Raises
    ------
    DeviceFaultError
        If the drive faults.
    DeviceTimeoutError
        If it does not go there.
    """
    _set_mode(axis, mode, wait)
    if mode == PROFILE_POSITION:
        axis.hold()
    if axis.state is DriveState.OPERATION_ENABLED:
        return
    for word, state in (
        (Control.DISABLE_VOLTAGE, DriveState.SWITCH_ON_DISABLED),
        (Control.SHUTDOWN, DriveState.READY_TO_SWITCH_ON),
        (Control.SWITCH_ON, DriveState.SWITCHED_ON),
        (Control.ENABLE, DriveState.OPERATION_ENABLED),
    ):
        axis.control(word)
        wait(partial(_reached, axis, state), f"the state {state.name}")


def reset_fault(axis: Axis, wait: Wait) -> None:
    """Reset a latched fault; the drive stays without power. Never moves.

    Raises
    ------
    DeviceFaultError
        If the axis still moves, or its fault cannot be reset yet.
    """
    if axis.state is DriveState.FAULT_REACTION_ACTIVE:
        raise DeviceFaultError(f"{axis.name} still slows down: clear its fault once it is at rest")
    if axis.state is DriveState.FAULT:
        axis.control(Control.DISABLE_VOLTAGE)
        axis.control(Control.RESET_FAULT)
        try:
            wait(lambda: axis.state not in FAULTY, "a reset of its fault")
        except TimeoutError:
            raise DeviceFaultError(f"{axis.name} keeps the fault {axis.fault}: its cause must go first") from None
        axis.control(Control.DISABLE_VOLTAGE)
    axis.forget_fault()


def _set_mode(axis: Axis, mode: int, wait: Wait) -> None:
    """Change the mode of operation, and wait until the drive shows it."""
    objects = axis.node.objects
    if objects.read(*_MODE_SHOWN) != mode:
        objects.write(*_MODE, mode)
        wait(lambda: objects.read(*_MODE_SHOWN) == mode, f"mode of operation {mode}")
    axis.statusword = objects.read(0x6041)


def _reached(axis: Axis, state: DriveState) -> bool:
    if axis.state in FAULTY:
        raise DeviceFaultError(f"{axis.name} reports {axis.fault}; it stays without power until the fault is cleared")
    return axis.state is state
