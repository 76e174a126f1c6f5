"""One axis of the stage in motion: homing, moves, braking, and the faults that latch. What drives a CiA 402 node.

The same supervision as in ``stage``, for a single axis; see ``docs/protocol.md``, section 5.
"""

from sim_device.firmware.axis import E_STOP, ENCODER, IN_POSITION, RUNAWAY, Axis, Homing
from sim_device.firmware.hardware import StageBoard

REST, HOMING, MOVING, BRAKING = range(4)  # activities

HOMING_FAILED = 7
_LOSE_HOMING = (RUNAWAY, ENCODER, HOMING_FAILED)

_REST_CHECK_US = 100_000
_SETTLE_US = 1_000_000
_HOMING_MARGIN = 360_000  # beyond the range, 10 deg


class Drive:
    """An axis with its supervision.

    Parameters
    ----------
    board : StageBoard
        The hardware, or its emulation; shared with the other axis.
    index : int
        0 azimuth, 1 elevation.

    Attributes
    ----------
    activity : int
        REST, HOMING, MOVING or BRAKING.
    fault : int
        Latched fault, 0 if none; numbers as in STAGE_STATUS.
    homed, in_position : bool
        Whether the reference is known; whether the axis rests at the target of the last move.
    motion_us : int
        When the present motion began.
    due_us : int
        When `advance` is due.
    """

    def __init__(self, board: StageBoard, index: int) -> None:
        self.activity = REST
        self.fault = 0
        self.homed = False
        self.in_position = False
        self.motion_us = 0
        self.due_us = 0
        self._suspected_us = -1  # since when the axis at rest is not where it rested
        self.limits = (board.azimuth_limits, board.elevation_limits)[index]  # about the reference edge
        self._board = board
        self._index = index
        self._axis = Axis(board, index)
        self._homing: "Homing | None" = None
        self._home_offset = 0

    @property
    def in_motion(self) -> bool:
        """Whether the axis is on its way, or slowing down."""
        return self.activity != REST

    @property
    def suspected(self) -> bool:
        """Whether the axis at rest is not where it rested, and it is not known yet why."""
        return self._suspected_us >= 0

    @property
    def velocity(self) -> int:
        """Measured speed, counts a second."""
        return self._axis.rate if self.in_motion else 0

    def position(self, now_us: int) -> int:
        """Return the encoder's position."""
        return self._axis.position(now_us)

    def within(self, target: int) -> bool:
        """Return whether a target lies within what the stage can do."""
        about_edge = target - self._home_offset
        if self._index == 0 and abs(about_edge) > self._board.cable_wrap:
            return False
        return self.limits[0] <= about_edge <= self.limits[1]

    # what a host asks for, all of it at rest

    def move(self, target: int, speed: int, acceleration: int, now_us: int) -> None:
        """Set out for `target`."""
        self._set_out(MOVING, now_us)
        self._axis.go(self._axis.offset + target, speed, acceleration, now_us)

    def home(self, speed: int, creep: int, acceleration: int, home_offset: int, now_us: int) -> None:
        """Set out for the reference edge, which then is at `home_offset`."""
        self._set_out(HOMING, now_us)
        self.homed = False
        self._home_offset = home_offset
        board = self._board
        span = 2 * board.cable_wrap if self._index == 0 else self.limits[1] - self.limits[0]
        farthest = span + _HOMING_MARGIN
        self._homing = Homing(board, self._index, self._axis, farthest, speed, acceleration, now_us, creep)

    def brake(self, now_us: int) -> None:
        """Come to rest, if on the way."""
        if self.activity in {HOMING, MOVING}:
            self.activity = BRAKING
            self._axis.brake(now_us)

    def latch(self, fault: int, now_us: int) -> None:
        """Latch a fault, and come to rest."""
        self.fault = fault
        self._suspected_us = -1
        self.in_position = False
        if fault in _LOSE_HOMING:
            self.homed = False
        if self.in_motion:
            self.activity = BRAKING
            self._axis.brake(now_us)

    def clear(self, now_us: int) -> bool:
        """Clear the fault if the axis rests and the emergency stop is released; return whether it is cleared."""
        if self.in_motion or self._board.e_stop(now_us):
            return False
        self._axis.observe(now_us)
        self._axis.rest()
        if self.fault == ENCODER:
            self._axis.realign()
        self.fault = 0
        return True

    # work in time

    def check(self, now_us: int) -> None:
        """Supervise the axis at rest, before it is set in motion."""
        if not self.in_motion:
            self._check_rest(now_us)
            if self.suspected:
                self.due_us = min(self.due_us, now_us + self._board.control_period_us)

    def advance(self, now_us: int) -> None:
        """Do what is due at this control period."""
        if self.in_motion:
            self._supervise(now_us)
            self._advance(now_us)
            if self.in_motion:
                self._axis.drive(now_us)
        else:
            self._check_rest(now_us)
        soon = self.in_motion or self.suspected
        self.due_us = now_us + (self._board.control_period_us if soon else _REST_CHECK_US)

    def _set_out(self, activity: int, now_us: int) -> None:
        self.activity = activity
        self._suspected_us = -1
        self.in_position = False
        self.motion_us = self.due_us = now_us
        self._axis.start(now_us)

    def _come_to_rest(self) -> None:
        self.activity = REST
        self._axis.rest()

    def _check_rest(self, now_us: int) -> None:
        if self.fault:
            return
        disturbed = self._axis.disturbed(now_us)
        if self._board.e_stop(now_us):
            self.latch(E_STOP, now_us)
        elif not (self.homed and disturbed):
            self._suspected_us = -1
        elif self._suspected_us < 0:
            self._suspected_us = now_us  # a second look tells an axis that runs from an encoder that has jumped
        elif now_us > self._suspected_us:
            self.latch(RUNAWAY if self._axis.runs else ENCODER, now_us)

    def _supervise(self, now_us: int) -> None:
        axis = self._axis
        if self.fault:
            axis.observe(now_us)
            if axis.lost and self.fault != ENCODER:
                axis.hold(now_us)
            return
        fault = axis.check(now_us)
        if self._board.e_stop(now_us):
            fault = E_STOP
        if fault:
            self.latch(fault, now_us)

    def _advance(self, now_us: int) -> None:
        if self.fault:
            self._advance_fault(now_us)
        elif self.activity == HOMING:
            self._advance_homing(now_us)
        elif self._settled(now_us):
            self.in_position = self.activity == MOVING
            self._come_to_rest()

    def _advance_homing(self, now_us: int) -> None:
        homing = self._homing
        if homing is None:  # HOMING without it does not occur
            return
        homing.step(now_us)
        if homing.failed:
            self.latch(HOMING_FAILED, now_us)
        elif homing.done and self._settled(now_us):
            self._axis.offset = homing.edge - self._home_offset
            self.homed = self.in_position = True
            self._come_to_rest()

    def _advance_fault(self, now_us: int) -> None:
        axis = self._axis
        trusted = self.fault != ENCODER
        if axis.arrived(now_us) and (axis.still or not trusted):
            if trusted:
                axis.hold(now_us)
                axis.drive(now_us)
            self._come_to_rest()

    def _settled(self, now_us: int) -> bool:
        """Return whether the axis rests at the end of its profile; latch a fault if it does not get there."""
        axis = self._axis
        if not axis.arrived(now_us):
            return False
        late = abs(axis.lag) > IN_POSITION
        if late and now_us - axis.profile.end_us > _SETTLE_US:
            self.latch(axis.diagnose(now_us), now_us)
        return not late
