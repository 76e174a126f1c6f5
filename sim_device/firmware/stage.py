"""The stage's firmware: configuration, self-test, status, homing, moves and their supervision.

See ``docs/protocol.md`` sections 3 and 5.
"""

import struct

from sim_device.firmware.axis import E_STOP, ENCODER, IN_POSITION, RUNAWAY, Axis, Homing
from sim_device.firmware.device import Device
from sim_device.firmware.framing import frame
from sim_device.firmware.hardware import StageBoard
from sim_device.firmware.session import (
    ACK,
    CABLE_WRAP,
    CLEAR_FAULT,
    FAULT_LATCHED,
    GET_CONFIG,
    HOME,
    MOVE,
    MOVING,
    NOT_HOMED,
    NOT_READY,
    OUT_OF_RANGE,
    SELF_TEST,
    SET_CONFIG_STAGE,
    SOFT_LIMIT,
    STAGE,
    STAGE_CONFIG,
    STOP,
    UNKNOWN_REQUEST,
    error,
)

_NOT_HOMED, _HOMING, _IDLE, _MOVING, _STOPPING, _FAULT = range(6)  # states

_WATCHDOG = 1
_HOMING_FAILED = 7
_LOSE_HOMING = (RUNAWAY, ENCODER, _HOMING_FAILED)

_REST_STATUS_US = 1_000_000
_AFTERGLOW_US = 500_000  # after a motion, for which the status keeps its rhythm: that of arrival may be lost
_REST_CHECK_US = 100_000
_SETTLE_US = 1_000_000
_HOMING_MARGIN = 360_000  # beyond the range, 10 deg
_CONFIG = "<iiiiIIHH"
_CONFIG_OFFSETS = (9, 13, 17, 21, 25, 29, 33, 35)


def _i32(value: int) -> int:
    """Return `value`, or the nearest that an i32 holds."""
    return max(-0x80000000, min(value, 0x7FFFFFFF))


def _default_watchdog_ms(board: StageBoard) -> int:
    """Return the time that leaves the stage at rest 300 ms after the last heartbeat, if its brakes are up to it."""
    braking_ms = 1000 * board.max_speed // board.stop_deceleration
    return 300 - braking_ms if braking_ms <= 200 else 300


class StageDevice(Device):
    """A stage on the line.

    Parameters
    ----------
    board : StageBoard
        The hardware, or its emulation.
    """

    def __init__(self, board: StageBoard) -> None:
        super().__init__(board, STAGE)
        self._board: StageBoard = board
        self._axes = [Axis(board, 0), Axis(board, 1)]
        self._homings: list[Homing] = []
        self._state = _NOT_HOMED
        self._fault = 0
        self._homed = False
        self._in_motion = False
        self._in_position = False
        self._motion_us = 0
        self._moved_us = -_AFTERGLOW_US  # when it was last in motion
        self._suspected_us = -1  # since when the stage at rest is not where it rested
        self._move_id = 0
        self._tick_due_us = 0
        self._status_due_us = 0
        self._status_count = 0
        self._news = False  # a status frame is to go out at once
        self.told_time_us = -1  # device time of the newest status frame
        self._config = (
            board.azimuth_limits[0],
            board.azimuth_limits[1],
            board.elevation_limits[0],
            board.elevation_limits[1],
            board.max_speed,
            board.max_acceleration,
            100,
            _default_watchdog_ms(board),
        )
        self._handlers = {
            GET_CONFIG: self._get_config,
            SET_CONFIG_STAGE: self._set_config,
            SELF_TEST: self._start_self_test,
            CLEAR_FAULT: self._clear_fault,
            HOME: self._home,
            MOVE: self._move,
            STOP: self._stop,
        }
        self._actions = {
            _HOMING: self._advance_homing,
            _MOVING: self._advance_move,
            _STOPPING: self._advance_stop,
            _FAULT: self._advance_fault,
        }

    def poll(self, now_us: int, _room: "int | None" = None) -> bytes:
        """Do all that is due, in order of time, and return the bytes to send: none of them may be lost."""
        due = self._work_due_us()
        while due <= now_us:
            self._work(due)
            due = self._work_due_us()
        return self._session.take()

    def next_due_us(self) -> int:
        """Return when `poll` will have something to do."""
        return self._fed_us if self._session.n_waiting else self._work_due_us()

    # requests

    def _execute(self, kind: int, payload: bytes, now_us: int) -> "tuple[int, bytes] | None":
        handler = self._handlers.get(kind)
        if handler is None:
            return error(UNKNOWN_REQUEST)
        reply = handler(payload, now_us)
        if reply is None or reply[0] != 0xFF:
            self._news = True
        return reply

    def _get_config(self, _payload: bytes, _now_us: int) -> "tuple[int, bytes] | None":
        return (STAGE_CONFIG, struct.pack(_CONFIG, *self._config))

    def _set_config(self, payload: bytes, now_us: int) -> "tuple[int, bytes] | None":
        if self._in_motion:
            return error(MOVING)
        board = self._board
        config = struct.unpack(_CONFIG, payload)
        ranges = (
            board.azimuth_limits,
            (config[0], board.azimuth_limits[1]),
            board.elevation_limits,
            (config[2], board.elevation_limits[1]),
            (1, board.max_speed),
            (1, board.max_acceleration),
            (20, 1000),
            (100, 300),
        )
        for value, (lowest, highest), offset in zip(config, ranges, _CONFIG_OFFSETS):
            if not lowest <= value <= highest:
                return error(OUT_OF_RANGE, offset)
        self._config = config
        return self._get_config(payload, now_us)

    def _clear_fault(self, _payload: bytes, now_us: int) -> "tuple[int, bytes] | None":
        if self._state != _FAULT:
            return ACK
        if self._in_motion:
            return error(MOVING)
        if self._board.e_stop(now_us):
            return error(FAULT_LATCHED, E_STOP)
        for axis in self._axes:
            axis.observe(now_us)
            axis.rest()
            if self._fault == ENCODER:
                axis.realign()
        self._fault = 0
        self._enter(_IDLE if self._homed else _NOT_HOMED)
        return ACK

    def _home(self, _payload: bytes, now_us: int) -> "tuple[int, bytes] | None":
        refusal = self._refusal(now_us)
        if refusal is not None:
            return refusal
        self._set_out(_HOMING, now_us)
        self._homed = False
        board = self._board
        speed, acceleration = self._config[4:6]
        ranges = (2 * board.cable_wrap, board.elevation_limits[1] - board.elevation_limits[0])
        self._homings = [
            Homing(board, index, self._axes[index], ranges[index] + _HOMING_MARGIN, speed, acceleration, now_us)
            for index in (0, 1)
        ]
        return ACK

    def _move(self, payload: bytes, now_us: int) -> "tuple[int, bytes] | None":
        targets_speeds = struct.unpack("<iiII", payload)
        targets, speeds = targets_speeds[:2], targets_speeds[2:]
        refusal = self._refusal(now_us) or self._path_refusal(targets, speeds)
        if refusal is not None:
            return refusal
        self._set_out(_MOVING, now_us)
        for axis, target, speed in zip(self._axes, targets, speeds):
            axis.go(axis.offset + target, speed, self._config[5], now_us)
        return ACK

    def _refusal(self, now_us: int) -> "tuple[int, bytes] | None":
        """Return why the stage may not set out now, None if it may."""
        if not self._in_motion:
            self._check_rest(now_us)
        if self._state == _FAULT:
            return error(FAULT_LATCHED, self._fault)
        if self._in_motion or self._suspected_us >= 0:
            return error(MOVING)
        return error(NOT_READY) if self.testing else None

    def _path_refusal(self, targets: tuple[int, ...], speeds: tuple[int, ...]) -> "tuple[int, bytes] | None":
        """Return why the stage may not go to these targets at these speeds, None if it may."""
        azimuth_min, azimuth_max, elevation_min, elevation_max, max_speed = self._config[:5]
        if not self._homed:
            return error(NOT_HOMED)
        if abs(targets[0]) > self._board.cable_wrap:
            return error(CABLE_WRAP)
        if not azimuth_min <= targets[0] <= azimuth_max:
            return error(SOFT_LIMIT, 0)
        if not elevation_min <= targets[1] <= elevation_max:
            return error(SOFT_LIMIT, 1)
        for speed, offset in zip(speeds, (17, 21)):
            if not 1 <= speed <= max_speed:
                return error(OUT_OF_RANGE, offset)
        return None

    def _stop(self, _payload: bytes, now_us: int) -> "tuple[int, bytes] | None":
        if self._state in {_HOMING, _MOVING}:
            self._brake(_STOPPING, now_us)
        return ACK

    def _at_work(self) -> int:
        return MOVING if self._in_motion else 0

    def _reset(self, now_us: int) -> None:
        self._stop(b"", now_us)
        self._move_id = self._status_count = 0
        self._in_position = False
        self._news = True

    # work in time

    def _work_due_us(self) -> int:
        due = min(self._tick_due_us, self._watchdog_due_us())
        if self._session.number:
            due = min(due, self._status_due_us)
        return min(due, self._test_due_us) if self.testing else due

    def _watchdog_due_us(self) -> int:
        """Return when the watchdog trips: never before the next control tick if the stage is not on its way."""
        if self._state not in {_HOMING, _MOVING}:
            return self._tick_due_us
        return max(self._motion_us, self._session.heartbeat_us) + self._config[7] * 1000

    def _work(self, now_us: int) -> None:
        """Do what is due at this instant."""
        self._finish_self_test(now_us)
        if self._state in {_HOMING, _MOVING} and self._watchdog_due_us() <= now_us:
            self._latch(_WATCHDOG, now_us)
        if self._tick_due_us <= now_us:
            if self._in_motion:
                self._moved_us = now_us
                self._tick(now_us)
            else:
                self._check_rest(now_us)
            soon = self._in_motion or self._suspected_us >= 0
            self._tick_due_us = now_us + (self._board.control_period_us if soon else _REST_CHECK_US)
        self._conclude(now_us)

    def _conclude(self, now_us: int) -> None:
        """Send the status if it is due."""
        if not self._session.number or not (self._news or self._status_due_us <= now_us):
            return
        self._news = False
        self._session.send(self._status(now_us))
        self.told_time_us = now_us
        self._status_count += 1
        brisk = now_us < self._moved_us + _AFTERGLOW_US
        self._status_due_us = now_us + (self._config[6] * 1000 if brisk or self._in_motion else _REST_STATUS_US)

    def _status(self, now_us: int) -> bytes:
        """Return the frame that tells the present state."""
        azimuth, elevation = self._axes
        body = struct.pack(
            "<BBBBIQIiiiiI",
            0x41,
            self._state,
            self._fault,
            self._in_position | self._homed << 1,
            self._session.number,
            now_us,
            self._move_id,
            _i32(azimuth.position(now_us)),
            _i32(elevation.position(now_us)),
            _i32(azimuth.rate) if self._in_motion else 0,
            _i32(elevation.rate) if self._in_motion else 0,
            self._status_count & 0xFFFFFFFF,
        )
        return frame(body)

    # motion

    def _enter(self, state: int) -> None:
        self._state = state
        self._news = True

    def _set_out(self, state: int, now_us: int) -> None:
        """Begin a motion that a request asked for."""
        self._enter(state)
        self._in_motion = True
        self._in_position = False
        self._move_id = self._session.request_id
        self._motion_us = self._tick_due_us = now_us
        for axis in self._axes:
            axis.start(now_us)

    def _brake(self, state: int, now_us: int) -> None:
        """Bring both axes to rest."""
        self._enter(state)
        for axis in self._axes:
            axis.brake(now_us)

    def _latch(self, fault: int, now_us: int) -> None:
        """Latch a fault, and bring the stage to rest if it moves."""
        self._fault = fault
        self._suspected_us = -1
        self._in_position = False
        if fault in _LOSE_HOMING:
            self._homed = False
        self._brake(_FAULT, now_us)

    def _come_to_rest(self, state: int) -> None:
        self._in_motion = False
        for axis in self._axes:
            axis.rest()
        if state != self._state:
            self._enter(state)

    def _check_rest(self, now_us: int) -> None:
        """Supervise the stage at rest."""
        if self._state == _FAULT:
            return
        disturbed = [axis.disturbed(now_us) for axis in self._axes]
        if self._board.e_stop(now_us):
            self._latch(E_STOP, now_us)
        elif not (self._homed and any(disturbed)):
            self._suspected_us = -1
        elif self._suspected_us < 0:
            self._suspected_us = now_us  # a second look tells an axis that runs from an encoder that has jumped
        elif now_us > self._suspected_us:
            self._latch(RUNAWAY if any(axis.runs for axis in self._axes) else ENCODER, now_us)

    def _tick(self, now_us: int) -> None:
        """Supervise and drive the stage in motion."""
        if self._state == _FAULT:
            for axis in self._axes:
                axis.observe(now_us)
                if axis.lost and self._fault != ENCODER:
                    axis.hold(now_us)
        else:
            faults = [axis.check(now_us) for axis in self._axes]
            fault = E_STOP if self._board.e_stop(now_us) else faults[0] or faults[1]
            if fault:
                self._latch(fault, now_us)
        self._actions[self._state](now_us)
        if self._in_motion:
            for axis in self._axes:
                axis.drive(now_us)

    def _advance_homing(self, now_us: int) -> None:
        for homing in self._homings:
            homing.step(now_us)
        if any(homing.failed for homing in self._homings):
            self._latch(_HOMING_FAILED, now_us)
        elif all(homing.done for homing in self._homings) and self._settled(now_us):
            for axis, homing in zip(self._axes, self._homings):
                axis.offset = homing.edge
            self._homed = self._in_position = True
            self._come_to_rest(_IDLE)

    def _advance_move(self, now_us: int) -> None:
        if self._settled(now_us):
            self._in_position = True
            self._come_to_rest(_IDLE)

    def _advance_stop(self, now_us: int) -> None:
        if self._settled(now_us):
            self._come_to_rest(_IDLE if self._homed else _NOT_HOMED)

    def _advance_fault(self, now_us: int) -> None:
        trusted = self._fault != ENCODER
        if all(axis.arrived(now_us) and (axis.still or not trusted) for axis in self._axes):
            for axis in self._axes:
                if trusted:
                    axis.hold(now_us)
                    axis.drive(now_us)
            self._come_to_rest(_FAULT)

    def _settled(self, now_us: int) -> bool:
        """Return whether both axes rest at the end of their profiles; latch a fault if one does not get there."""
        if not all(axis.arrived(now_us) for axis in self._axes):
            return False
        late = [axis for axis in self._axes if abs(axis.lag) > IN_POSITION]
        if late and now_us - max(axis.profile.end_us for axis in self._axes) > _SETTLE_US:
            self._latch(late[0].diagnose(now_us), now_us)
        return not late
