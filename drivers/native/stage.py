"""The native stage: session, limits, homing and moves, and STAGE_STATUS frames as states."""

from __future__ import annotations

from collections.abc import Callable

from construct import Container

from drivers.api import ByteLink, Clock, DeviceIdentity, SelfTest, StageLimits, StageMode, StageState
from drivers.errors import DeviceError, DeviceTimeoutError, LinkError, ProtocolError
from drivers.limits import narrowed, require_within
from drivers.native.refusal import fault_name
from drivers.native.self_test import run_self_test
from drivers.native.session import HEARTBEAT_PERIOD, LinkCounts, Session, random_session
from drivers.protocol.native import (
    ANGLE_LSB,
    IN_POSITION,
    US_PER_S,
    DeviceKind,
    MessageType,
    StageCode,
    parse,
)

MAX_SILENCE = 1.0  # s in motion, or five status periods if that is longer
MAX_SILENCE_AT_REST = 3.0  # s; a stage at rest reports each second
STOP_INTERVAL = 0.05  # s between repetitions of STOP, which must get through a bad line soon
STOP_ATTEMPTS = 20
_MODES = {
    StageCode.NOT_HOMED: StageMode.NOT_HOMED,
    StageCode.HOMING: StageMode.HOMING,
    StageCode.IDLE: StageMode.IDLE,
    StageCode.MOVING: StageMode.MOVING,
    StageCode.STOPPING: StageMode.STOPPING,
    StageCode.FAULT: StageMode.FAULT,
}
_AT_REST = {StageMode.NOT_HOMED, StageMode.IDLE, StageMode.FAULT}


class NativeStage:
    """A two-axis stage that speaks the native protocol; a `drivers.api.Stage`.

    Parameters
    ----------
    link
        The open line to the stage; the driver closes it.
    clock
        The clock that `link` notifies.
    limits
        Narrows the limits that the device reports; never widens them.
    draw_session
        Draws session numbers.
    """

    def __init__(
        self,
        link: ByteLink,
        clock: Clock,
        *,
        limits: StageLimits | None = None,
        draw_session: Callable[[], int] = random_session,
    ) -> None:
        self._clock = clock
        self._session = Session(link, clock, kind=DeviceKind.STAGE, draw_session=draw_session)
        self._own_limits = limits
        self._limits: StageLimits | None = None
        self._status_period = 0.1
        self._move_id = 0
        self._begun = StageMode.MOVING
        self._report: Container | None = None
        self._state: StageState | None = None

    @property
    def limits(self) -> StageLimits:
        """Where the stage may be sent, known after `connect`."""
        if self._limits is None:
            raise LinkError(f"{self._session.name} has not told its limits yet: connect first")
        return self._limits

    @property
    def link_counts(self) -> LinkCounts:
        """What has come over the link that could not be used."""
        return self._session.counts

    @property
    def troubles(self) -> dict[str, int]:
        """What has gone wrong on the link and been made up for."""
        return self._session.troubles

    def connect(self) -> DeviceIdentity:
        """Open a session, read the limits and the first state. Never moves; brings a moving stage to rest.

        Raises
        ------
        DeviceTimeoutError
            If nothing answers.
        ProtocolError
            If it is no stage of this protocol version.
        """
        self._report, self._state, self._move_id = None, None, 0
        identity = self._session.open()
        config = self._session.request(MessageType.GET_CONFIG, reply=MessageType.STAGE_CONFIG)
        self._status_period = config.status_period_ms / 1000
        self._limits = narrowed(_limits(config), self._own_limits)
        deadline = self._clock.now() + MAX_SILENCE_AT_REST
        while not self._refresh():
            now = self._clock.now()
            if now >= deadline:
                raise DeviceTimeoutError(f"{self._session.name} answers but sends no status")
            self._clock.wait(min(deadline, now + HEARTBEAT_PERIOD))
        return identity

    def self_test(self) -> SelfTest:
        """Run the device's self-test, up to 3 s. Never moves."""
        return run_self_test(self._session)

    def home(self) -> None:
        """Begin homing; `state` tells when it is done.

        Raises
        ------
        DeviceFaultError
            If the device refuses.
        """
        self._session.request(MessageType.HOME)
        self._accepted(StageMode.HOMING)

    def move(self, azimuth: float, elevation: float, *, speed: float | None = None) -> None:
        """Begin a move of both axes to absolute angles in rad; `speed` in rad/s, the limit if None.

        Raises
        ------
        ValueError
            If the target or the speed lies outside `limits`.
        DeviceFaultError
            If the device refuses.
        """
        limits = self.limits
        speed = limits.max_speed if speed is None else speed
        half = ANGLE_LSB / 2
        require_within("azimuth", azimuth, limits.azimuth_min, limits.azimuth_max, unit="deg", slack=half)
        require_within("elevation", elevation, limits.elevation_min, limits.elevation_max, unit="deg", slack=half)
        require_within("speed", speed, ANGLE_LSB, limits.max_speed, unit="deg/s", slack=half)
        speed_counts = round(speed / ANGLE_LSB)
        self._session.request(
            MessageType.MOVE,
            azimuth=round(azimuth / ANGLE_LSB),
            elevation=round(elevation / ANGLE_LSB),
            azimuth_speed=speed_counts,
            elevation_speed=speed_counts,
        )
        self._accepted(StageMode.MOVING)

    def state(self) -> StageState:
        """Service the link and return the newest state. Never waits.

        After `home` or `move` the state is of that very motion: until the stage has reported on it, the mode is the
        one it has accepted, and the angles are the last known.

        Raises
        ------
        LinkError
            If the link is lost.
        DeviceTimeoutError
            If the stage has fallen silent.
        """
        self._refresh()
        if self._state is None:
            raise LinkError(f"{self._session.name} has told no state yet: connect first")
        at_rest = self._state.mode in _AT_REST
        patience = MAX_SILENCE_AT_REST if at_rest else max(MAX_SILENCE, 5 * self._status_period)
        if self._session.silence > patience:
            raise DeviceTimeoutError(
                f"{self._session.name} has sent no status for {self._session.silence:.1f} s: was it reset or cut off?"
            )
        return self._state

    def stop(self) -> None:
        """Bring both axes to rest in a controlled way; returns while they still slow down.

        Raises
        ------
        DeviceTimeoutError
            If the stage does not accept within a second; without heartbeats it stops by itself.
        """
        try:
            self._session.request(MessageType.STOP, interval=STOP_INTERVAL, attempts=STOP_ATTEMPTS)
        except DeviceTimeoutError as error:
            raise DeviceTimeoutError(f"{error}; press the emergency stop if it moves") from error

    def clear_fault(self) -> None:
        """Re-arm after a latched fault, on the operator's word alone. Never moves.

        Raises
        ------
        DeviceFaultError
            If the axes still move, or the emergency stop is still pressed.
        """
        self._session.request(MessageType.CLEAR_FAULT)

    def close(self) -> None:
        """Stop the stage if the link still lives, and release it."""
        try:
            if self._session.is_open:
                self._session.request(MessageType.STOP, interval=STOP_INTERVAL, attempts=6)
        except DeviceError:
            pass  # without heartbeats the stage stops by itself
        finally:
            self._session.close()

    def _accepted(self, mode: StageMode) -> None:
        """Let the state be of the motion that the device has just accepted."""
        self._move_id, self._begun = self._session.last_request_id, mode
        self._refresh()
        if self._report is not None:
            self._state = self._interpret(self._report)

    def _refresh(self) -> bool:
        """Take in what has come; return whether a new status was among it."""
        bodies = self._session.take_stream()
        if not bodies:
            return False
        self._report = parse(bodies[-1])
        self._state = self._interpret(self._report)
        return True

    def _interpret(self, report: Container) -> StageState:
        """Return a STAGE_STATUS as a state, seen from the last motion accepted."""
        if report.state not in _MODES:
            raise ProtocolError(f"{self._session.name} reports the unknown state {report.state}")
        mode = _MODES[report.state]
        if report.move_id < self._move_id and mode is not StageMode.FAULT:
            mode = self._begun
        return StageState(
            device_time=report.device_time_us / US_PER_S,
            arrival_time=self._clock.now(),
            mode=mode,
            azimuth=report.azimuth * ANGLE_LSB,
            elevation=report.elevation * ANGLE_LSB,
            azimuth_rate=report.azimuth_rate * ANGLE_LSB,
            elevation_rate=report.elevation_rate * ANGLE_LSB,
            in_position=bool(report.flags & IN_POSITION) and report.move_id == self._move_id != 0,
            fault=fault_name(report.fault),
        )


def _limits(config: Container) -> StageLimits:
    """Return a STAGE_CONFIG's limits."""
    return StageLimits(
        azimuth_min=config.azimuth_min * ANGLE_LSB,
        azimuth_max=config.azimuth_max * ANGLE_LSB,
        elevation_min=config.elevation_min * ANGLE_LSB,
        elevation_max=config.elevation_max * ANGLE_LSB,
        max_speed=config.max_speed * ANGLE_LSB,
        max_acceleration=config.max_acceleration * ANGLE_LSB,
    )
