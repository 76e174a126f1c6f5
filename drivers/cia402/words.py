"""Controlword, statusword and faults of CiA 402 (IEC 61800-7-201, 7.2), as far as they are used."""

from __future__ import annotations

from enum import Enum, IntEnum, IntFlag

from canopen.emcy import EmcyError


class Control(IntEnum):
    """Controlwords."""

    DISABLE_VOLTAGE = 0x0000
    QUICK_STOP = 0x0002
    SHUTDOWN = 0x0006
    SWITCH_ON = 0x0007
    ENABLE = 0x000F
    START = 0x001F  #: enabled, with a new set-point or the start of homing
    RESET_FAULT = 0x0080


class Status(IntFlag):
    """Bits of the statusword beyond those of the state."""

    TARGET_REACHED = 1 << 10
    ACKNOWLEDGED = 1 << 12  #: profile position: the set-point was taken
    HOMED = 1 << 12  #: homing mode
    HOMING_ERROR = 1 << 13  #: homing mode


class DriveState(Enum):
    """States of the drive; the values are mask and pattern of the statusword."""

    NOT_READY = (0x4F, 0x00)
    SWITCH_ON_DISABLED = (0x4F, 0x40)
    READY_TO_SWITCH_ON = (0x6F, 0x21)
    SWITCHED_ON = (0x6F, 0x23)
    OPERATION_ENABLED = (0x6F, 0x27)
    QUICK_STOP_ACTIVE = (0x6F, 0x07)
    FAULT_REACTION_ACTIVE = (0x4F, 0x0F)
    FAULT = (0x4F, 0x08)


FAULTY = {DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE}
PROFILE_POSITION, HOMING = 1, 6  #: modes of operation

UNKNOWN_FAULT = "fault"
_NAMES = {
    0x8130: "WATCHDOG",
    0x9000: "E_STOP",
    0x7121: "STALL",
    0x8400: "RUNAWAY",
    0x7305: "ENCODER",
    0x8612: "LIMIT_SWITCH",
    0x8613: "HOMING_FAILED",
}
#: EMCY codes by which an axis refuses a set-point without a fault.
REFUSALS = {0xFF01: "it is not homed", 0xFF02: "it lies outside the drive's limits", 0xFF03: "it is relative"}


def drive_state(statusword: int) -> DriveState | None:
    """Return the state that a statusword tells, None if it tells none.

    >>> drive_state(0x0637)
    <DriveState.OPERATION_ENABLED: (111, 39)>
    """
    for state in DriveState:
        mask, pattern = state.value
        if statusword & mask == pattern:
            return state
    return None


def fault_name(code: int) -> str:
    """Return what an error code (603F, or of an EMCY) means.

    >>> fault_name(0x9000), fault_name(0x8611), fault_name(0)
    ('E_STOP', 'fault 8611 (Monitoring)', 'fault')
    """
    if not code:
        return UNKNOWN_FAULT
    return _NAMES.get(code) or f"fault {code:04X} ({EmcyError(code, 0, b'', 0.0).get_desc()})"
