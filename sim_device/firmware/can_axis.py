"""One axis of the stage on a CAN bus: the drive state machine of CiA 402, profile position and homing.

See ``docs/canopen.md``, section 4.
"""

from sim_device.firmware.axis import (
    CREEP,
    E_STOP,
    ENCODER,
    FASTEST_CREEP,
    IN_POSITION,
    LAG,
    LIMIT_SWITCH,
    RUNAWAY,
    STALL,
)
from sim_device.firmware.dictionary import OUT_OF_RANGE, WRONG_STATE, Abort
from sim_device.firmware.drive import HOMING, HOMING_FAILED, MOVING, Drive
from sim_device.firmware.drive_objects import OBJECTS
from sim_device.firmware.hardware import StageBoard
from sim_device.firmware.node import DEVICE_PROFILE, OPERATIONAL, PREPARE, RESET_NODE, Node

# states, as they stand in the statusword
DISABLED, READY, SWITCHED_ON, ENABLED = 0x40, 0x21, 0x23, 0x27
QUICK_STOP, REACTING, FAULT = 0x07, 0x0F, 0x08

WATCHDOG = 1
_CODES = {
    WATCHDOG: 0x8130,
    E_STOP: 0x9000,
    STALL: 0x7121,
    RUNAWAY: 0x8400,
    ENCODER: 0x7305,
    LIMIT_SWITCH: 0x8612,
    HOMING_FAILED: 0x8613,
}
_NOT_HOMED, _OUTSIDE, _RELATIVE = 0xFF01, 0xFF02, 0xFF03

_PROFILE_POSITION, _HOMING_MODE = 1, 6
_RESET, _HALT, _START, _AT_ONCE, _FROM_HERE = 0x80, 0x100, 0x10, 0x20, 0x40  # bits of the controlword
_ALWAYS = 0x210  # bits of the statusword: voltage, remote
_IN_MOTION, _REACHED, _LIMITED, _BIT_12, _BIT_13, _HOMED = 0x100, 0x400, 0x800, 0x1000, 0x2000, 0x4000

_REST_STATUS_US = 1_000_000
_HOST = 127
_STAY = 5  # quick stop option codes from here on stay in QUICK STOP ACTIVE


def _default_watchdog_ms(board: StageBoard) -> int:
    """Return the time that leaves the axis at rest 300 ms after the last heartbeat, if its brakes are up to it."""
    braking_ms = 1000 * board.max_speed // board.stop_deceleration
    return 300 - braking_ms if braking_ms <= 200 else 300


def _i32(value: int) -> int:
    return max(-0x80000000, min(value, 0x7FFFFFFF))


class AxisNode(Node):
    """An axis on the bus.

    Parameters
    ----------
    board : StageBoard
        The hardware, or its emulation; shared with the other axis.
    axis : int
        0 azimuth, 1 elevation.
    node_id : int
        1 to 127.

    Attributes
    ----------
    told_time_us : int
        Device time told by the newest status, -1 if none has been.
    """

    def __init__(self, board: StageBoard, axis: int, node_id: int) -> None:
        super().__init__(board, node_id, OBJECTS)
        self.drive = Drive(board, axis)
        self._board: StageBoard = board
        self._drive_state = DISABLED
        self._controlword = 0  # that was acted upon last
        self._commanded = False  # a controlword waits to be acted upon
        self._offered = False  # a set-point waits for the axis to rest
        self._acknowledged = False
        self._limited = False
        self._heartbeat_host_us = 0
        self._reported = (0, 0)  # statusword and mode
        self._status_due_us = 0
        self.told_time_us = -1
        self._define(board, axis)
        self._connect()

    def _define(self, board: StageBoard, axis: int) -> None:
        speed, acceleration = board.max_speed, board.max_acceleration
        for key, default in (
            (0x101601, _HOST << 16 | _default_watchdog_ms(board)),
            (0x201000, axis),
            (0x606500, LAG),
            (0x606700, IN_POSITION),
            (0x607D01, self.drive.limits[0]),
            (0x607D02, self.drive.limits[1]),
            (0x607F00, speed),
            (0x608100, speed),
            (0x608300, acceleration),
            (0x608400, acceleration),
            (0x608500, board.stop_deceleration),
            (0x609901, speed),
            (0x609902, CREEP),
            (0x609A00, acceleration),
            (0x60C500, acceleration),
        ):
            self.dictionary.define(key, default)

    def _connect(self) -> None:
        """Let objects read and written reach the drive."""
        board, dictionary = self._board, self.dictionary
        for key, reader in (
            (0x211000, self._device_time),
            (0x603F00, self._error_code),
            (0x604100, self._statusword),
            (0x606100, self._mode),
            (0x606400, self._position),
            (0x606C00, self._velocity),
        ):
            dictionary.on_read(key, reader)
        for key, highest in (
            (0x608100, board.max_speed),
            (0x608300, board.max_acceleration),
            (0x608400, board.max_acceleration),
            (0x609901, board.max_speed),
            (0x609902, FASTEST_CREEP),
            (0x609A00, board.max_acceleration),
        ):
            dictionary.on_write(key, _between(1, highest))
        dictionary.on_write(0x101601, self._set_watchdog)
        dictionary.on_write(0x604000, self._set_controlword)
        dictionary.on_write(0x605A00, self._set_quick_stop)
        dictionary.on_write(0x606000, self._set_mode)
        dictionary.on_write(0x607D01, self._set_limit)
        dictionary.on_write(0x607D02, self._set_limit)

    @property
    def session(self) -> int:
        """Whether there is a host that reads the state, or waits for a self-test."""
        return int(self.state == OPERATIONAL or self.testing)

    @property
    def seen_time_us(self) -> int:
        """Newest device time that the host says it has read."""
        return self.dictionary.get(0x211100) * 1000

    def accepts(self, identifier: int) -> bool:
        """Return whether this node listens to an identifier."""
        return super().accepts(identifier) or identifier == self._host_identifier()

    # objects

    def _device_time(self) -> int:
        return self._now_us // 1000

    def _error_code(self) -> int:
        return _CODES[self.drive.fault] if self.drive.fault else 0

    def _mode(self) -> int:
        return self.dictionary.get(0x606000)

    def _position(self) -> int:
        return _i32(self.drive.position(self._now_us))

    def _velocity(self) -> int:
        return _i32(self.drive.velocity)

    def _statusword(self) -> int:
        drive, mode = self.drive, self._mode()
        word = self._drive_state | _ALWAYS | _IN_MOTION * drive.in_motion | _HOMED * drive.homed
        if mode == _HOMING_MODE:
            word |= _REACHED * (not drive.in_motion) | _BIT_12 * (drive.homed and not drive.in_motion)
            word |= _BIT_13 * (drive.fault == HOMING_FAILED)
        elif mode == _PROFILE_POSITION:
            halted = self._controlword & _HALT and not drive.in_motion
            word |= _REACHED * bool(drive.in_position or halted) | _BIT_12 * self._acknowledged
            word |= _BIT_13 * (drive.fault == STALL) | _LIMITED * self._limited
        return word

    def _set_watchdog(self, value: int) -> int:
        if not (1 <= value >> 16 <= 127 and 100 <= value & 0xFFFF <= 300):
            raise Abort(OUT_OF_RANGE)
        return value

    def _set_controlword(self, value: int) -> int:
        self._commanded = True
        return value

    def _set_quick_stop(self, value: int) -> int:
        if value not in {1, 2, 5, 6}:
            raise Abort(OUT_OF_RANGE)
        return value

    def _set_mode(self, value: int) -> int:
        if value not in {0, _PROFILE_POSITION, _HOMING_MODE}:
            raise Abort(OUT_OF_RANGE)
        if value != self._mode():
            if self.drive.in_motion:
                raise Abort(WRONG_STATE)
            self._void()
        return value

    def _set_limit(self, value: int) -> int:
        lowest, highest = self.drive.limits
        if not lowest <= value - self.dictionary.get(0x607C00) <= highest:
            raise Abort(OUT_OF_RANGE)
        return value

    # the bus

    def _host_identifier(self) -> int:
        return 0x700 + (self.dictionary.get(0x101601) >> 16)

    def _heard(self, identifier: int, data: bytes) -> None:
        if identifier == self._host_identifier() and data in {b"\x05", b"\x7f"}:
            self._heartbeat_host_us = self._now_us

    def _refused(self) -> None:
        self._commanded = False

    def _at_work(self) -> bool:
        return self._drive_state == ENABLED or self.drive.in_motion

    def _left_operational(self, command: int) -> None:
        self.told_time_us = -1
        if command == PREPARE:
            return
        if self.drive.in_motion and not self.drive.fault:
            self._lose_connection()
        if command == RESET_NODE:
            self.drive.homed = self.drive.in_position = False
        if self._drive_state not in {REACTING, FAULT} and not self.drive.fault:
            self._disable(DISABLED)
        self._controlword = 0

    # work in time

    def _due_us(self) -> "int | None":
        due = min(self.drive.due_us, self._status_due_us)
        watchdog = self._watchdog_due_us()
        return due if watchdog is None else min(due, watchdog)

    def _watchdog_due_us(self) -> "int | None":
        """Return when the host's heartbeat is missed, None if the axis is not on its way."""
        if self.drive.activity not in {HOMING, MOVING}:
            return None
        since_us = max(self.drive.motion_us, self._heartbeat_host_us)
        return since_us + (self.dictionary.get(0x101601) & 0xFFFF) * 1000

    def _work(self, now_us: int) -> None:
        watchdog = self._watchdog_due_us()
        if watchdog is not None and watchdog <= now_us:
            self._lose_connection()
        if self.drive.due_us <= now_us:
            self.drive.advance(now_us)

    def _lose_connection(self) -> None:
        """Do what is to be done when the host has gone."""
        option = self.dictionary.get(0x600700)
        if option == 1:
            self.drive.latch(WATCHDOG, self._now_us)
            return
        self._emergency(_CODES[WATCHDOG])
        self._disable(DISABLED if option == 2 else QUICK_STOP)

    def _conclude(self, now_us: int) -> None:
        if self._commanded:
            self._commanded = False
            self._obey(self.dictionary.get(0x604000), now_us)
            self._status_due_us = now_us
        self._follow_drive()
        if self._offered and not (self.drive.in_motion or self.drive.suspected):
            self._take_set_point(now_us)
        report = (self._statusword(), self._mode())
        if report != self._reported or self._status_due_us <= now_us:
            self._reported = report
            self._status_due_us = now_us + self._status_period_us()
            self._trigger(1)
            self._trigger(2)
            if self.state == OPERATIONAL:
                self.told_time_us = self._device_time() * 1000

    def _status_period_us(self) -> int:
        return self.dictionary.get(0x201400) * 1000 if self.drive.in_motion else _REST_STATUS_US

    def _follow_drive(self) -> None:
        """Take the state along with what has become of the axis."""
        if self.drive.fault and self._drive_state not in {REACTING, FAULT}:
            self._drive_state = REACTING
            self._void()
            self._emergency(_CODES[self.drive.fault], DEVICE_PROFILE)
        if self._drive_state == REACTING and not self.drive.in_motion:
            self._drive_state = FAULT
        if self._drive_state == QUICK_STOP and not self.drive.in_motion and self._option_leaves():
            self._drive_state = DISABLED

    def _option_leaves(self) -> bool:
        return self.dictionary.get(0x605A00) < _STAY

    # the controlword

    def _obey(self, word: int, now_us: int) -> None:
        before, self._controlword = self._controlword, word
        self.drive.check(now_us)
        self._follow_drive()
        if self._drive_state in {REACTING, FAULT} or word & _RESET:
            rising = word & _RESET and not before & _RESET
            if rising and self._drive_state == FAULT and self.drive.clear(now_us):
                self._drive_state = DISABLED
                self._recovered(DEVICE_PROFILE)
            return
        was_enabled = self._drive_state == ENABLED
        self._switch(word)
        if was_enabled and self._drive_state == ENABLED:
            self._operate(word, before, now_us)

    def _switch(self, word: int) -> None:
        """Change the state as the first four bits of a controlword ask."""
        state = self._drive_state
        if not word & 2:
            if state != DISABLED:
                self._disable(DISABLED)
        elif not word & 4:
            if state == ENABLED:
                self._disable(QUICK_STOP)
            elif state != QUICK_STOP:
                self._disable(DISABLED)
        elif not word & 1:
            if state != QUICK_STOP:
                self._disable(READY)
        elif not word & 8:
            if state in {READY, SWITCHED_ON, ENABLED}:
                self._disable(SWITCHED_ON)
        elif state in {READY, SWITCHED_ON} or (state == QUICK_STOP and not self._option_leaves()):
            self._drive_state = SWITCHED_ON if self.testing else ENABLED

    def _disable(self, state: int) -> None:
        """Enter a state without motion."""
        self._drive_state = state
        self._void()
        self.drive.brake(self._now_us)

    def _void(self) -> None:
        """Forget the set-point that was offered."""
        self._offered = self._acknowledged = self._limited = False

    def _operate(self, word: int, before: int, now_us: int) -> None:
        rising = word & _START and not before & _START
        mode = self._mode()
        if mode == _PROFILE_POSITION:
            if word & _HALT or not word & _START:
                self._offered = self._acknowledged = False
            if word & _HALT:
                self.drive.brake(now_us)
            elif rising:
                self._offer(word, now_us)
        elif mode == _HOMING_MODE:
            if word & _HALT or not word & _START:
                self.drive.brake(now_us)
            elif rising and not self.drive.in_motion:
                get = self.dictionary.get
                self.drive.home(get(0x609901), get(0x609902), get(0x609A00), get(0x607C00), now_us)

    def _offer(self, word: int, now_us: int) -> None:
        self._void()
        if word & _FROM_HERE:
            self._emergency(_RELATIVE)
            return
        self._offered = True
        if word & _AT_ONCE:
            self.drive.brake(now_us)

    def _take_set_point(self, now_us: int) -> None:
        self._offered = False
        get = self.dictionary.get
        target = get(0x607A00)
        if not self.drive.homed:
            self._emergency(_NOT_HOMED)
        elif not (get(0x607D01) <= target <= get(0x607D02) and self.drive.within(target)):
            self._limited = True
            self._emergency(_OUTSIDE)
        else:
            self._acknowledged = True
            self.drive.move(target, get(0x608100), min(get(0x608300), get(0x608400)), now_us)


def _between(lowest: int, highest: int) -> object:
    """Return a writer that takes values of a range."""

    def write(value: int) -> int:
        if not lowest <= value <= highest:
            raise Abort(OUT_OF_RANGE)
        return value

    return write
