"""Two CiA 402 drives as one rotation stage. See ``docs/canopen.md``, section 4."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from drivers.api import Clock, DeviceIdentity, FrameLink, SelfTest, StageLimits, StageState
from drivers.canopen.identity import run_self_test
from drivers.canopen.node import MAX_SILENCE, OPERATIONAL
from drivers.cia402 import setup
from drivers.cia402.axis import AXIS_NAMES, Activity, Axis
from drivers.cia402.options import DriveOptions
from drivers.cia402.pair import identity_of, state_of
from drivers.cia402.power import enable, reset_fault, see_homed
from drivers.cia402.presence import ANSWER_TIMEOUT, Presence
from drivers.cia402.words import HOMING, PROFILE_POSITION, Control, DriveState
from drivers.errors import DeviceError, DeviceFaultError, DeviceTimeoutError, LinkError
from drivers.limits import joined, require_within

IDENTIFIERS = (0x080, 0x180, 0x280, 0x580, 0x700)  #: to which each node's number is added
REST_TIMEOUT = 10.0  # s for a drive found moving to come to rest
INSIST_PERIOD = (
    0.3  # s after which a set-point that a drive has not taken is offered again; in motion it tells its state sooner
)
STOP_INTERVAL = 0.05  # s between repetitions of a stop
STOP_ATTEMPTS = 20


class Cia402Stage:
    """A stage of two drives on one bus; a `drivers.api.Stage`.

    The drives watch the host's heartbeat, which `state` and every call that waits keep going: if the host dies in
    motion they come to rest by themselves. A fault of one axis stops the other.

    Parameters
    ----------
    links
        To the bus, one for each axis, open at least for `IDENTIFIERS` of its node; the driver closes them.
    clock
        The clock that the links notify.
    node_ids
        Numbers of the azimuth and the elevation axis.
    limits
        Narrows the limits that the drives have; never widens them.
    options
        How the drives are used.
    max_silence
        Time without a heartbeat, s, after which a node counts as cut off.
    """

    def __init__(
        self,
        links: Sequence[FrameLink],
        clock: Clock,
        node_ids: Sequence[int],
        *,
        limits: StageLimits | None = None,
        options: DriveOptions | None = None,
        max_silence: float = MAX_SILENCE,
    ) -> None:
        options = options or DriveOptions()
        self._clock = clock
        self._axes = [
            Axis(link, clock, node_id, index, options)
            for index, (link, node_id) in enumerate(zip(links, node_ids, strict=True))
        ]
        for axis in self._axes:
            axis.node.max_silence = max_silence
        self._presence = Presence(self._axes, clock)
        self._own_limits = limits
        self._limits: StageLimits | None = None
        self._state: StageState | None = None

    @property
    def limits(self) -> StageLimits:
        """Where the stage may be sent, known after `connect`."""
        if self._limits is None:
            raise LinkError(f"the limits of {self._names} are known after connect")
        return self._limits

    @property
    def troubles(self) -> dict[str, int]:
        """What has gone wrong with either node and been made up for."""
        azimuth, elevation = (axis.node.troubles for axis in self._axes)
        return {what: n + elevation[what] for what, n in azimuth.items()}

    def connect(self) -> DeviceIdentity:
        """Meet both drives, bring them to rest, configure them. Never moves.

        Raises
        ------
        DeviceTimeoutError
            If a node does not answer.
        ProtocolError
            If one is no such drive, or two nodes have one number.
        DeviceFaultError
            If a drive refuses what it must be told.
        """
        self._state, self._limits, self._presence.connected = None, None, False
        identities = [setup.meet(axis) for axis in self._axes]
        for axis in self._axes:
            setup.bring_to_rest(axis, self._presence.waiter(axis, REST_TIMEOUT))
            setup.configure(axis)
            setup.map_pdos(axis)
            see_homed(axis, self._presence.waiter(axis))
        self._limits = joined(*(setup.limits_of(axis, self._own_limits) for axis in self._axes))
        self._presence.connected = True
        for axis in self._axes:
            axis.node.order("OPERATIONAL")
        for axis in self._axes:
            self._presence.waiter(axis)(partial(axis.node.stands_in, OPERATIONAL), "OPERATIONAL")
            axis.node.watch()
        self._state = self._newest()
        return identity_of(*identities)

    def self_test(self) -> SelfTest:
        """Run the self-test of drives that have one, up to 3 s each. Never moves."""
        self._require_connected()
        failures = [
            f"{AXIS_NAMES[axis.index]}: {failure}"
            for axis in self._axes
            if axis.ours
            for failure in run_self_test(axis.node, self._clock).failures
        ]
        return SelfTest(tuple(failures))

    def home(self) -> None:
        """Begin homing of both axes; `state` tells when it is done. Enables the drives.

        Raises
        ------
        DeviceFaultError
            If a drive refuses, or is not at rest.
        """
        self._require_connected()
        self._require_rest("homing")
        self._enable(HOMING)
        for axis in self._axes:
            axis.start_homing()
        self._await_both(lambda axis: axis.activity is not Activity.HOMING_ASKED, "begun homing")

    def move(self, azimuth: float, elevation: float, *, speed: float | None = None) -> None:
        """Begin a move of both axes to absolute angles in rad; `speed` in rad/s, the limit if None.

        Raises
        ------
        ValueError
            If the target or the speed lies outside `limits`.
        DeviceFaultError
            If a drive refuses, is not homed, or not at rest.
        """
        limits = self.limits
        speed = limits.max_speed if speed is None else speed
        slowest, half = 1 / self._axes[0].speed_units, 0.5 / min(abs(axis.units) for axis in self._axes)
        require_within("azimuth", azimuth, limits.azimuth_min, limits.azimuth_max, unit="deg", slack=half)
        require_within("elevation", elevation, limits.elevation_min, limits.elevation_max, unit="deg", slack=half)
        require_within("speed", speed, slowest, limits.max_speed, unit="deg/s", slack=half)
        self._require_rest("a move")
        for axis in self._axes:
            if not axis.homed:
                raise DeviceFaultError(f"{axis.name} must be homed first")
        self._enable(PROFILE_POSITION)
        for axis in self._axes:
            axis.set_speed(speed)
        for axis, angle in zip(self._axes, (azimuth, elevation), strict=True):
            axis.offer(round(angle * axis.units))
        self._await_both(lambda axis: axis.activity is not Activity.OFFERED, "taken the set-point", Axis.offer_again)
        self._state = self._newest()

    def state(self) -> StageState:
        """Service both axes and return the newest state. Never waits.

        Raises
        ------
        LinkError
            If the bus is lost.
        DeviceTimeoutError
            If the heartbeat of an axis has stopped.
        DeviceFaultError
            If a drive was reset.
        """
        self._require_connected()
        heard = [axis.take_in() for axis in self._axes]
        for axis in self._axes:
            axis.node.check_alive()
        if any(axis.fault for axis in self._axes):
            self._stop_moving()
        if self._state is None or any(heard):
            self._state = self._newest()
        return self._state

    def stop(self) -> None:
        """Bring both axes to rest at the quick stop ramp; returns while they still slow down.

        Raises
        ------
        DeviceTimeoutError
            If a drive does not leave OPERATION ENABLED within a second; without heartbeats it stops by itself.
        """
        self._require_connected()
        self._stop(STOP_ATTEMPTS)
        self._state = self._newest()

    def clear_fault(self) -> None:
        """Reset latched faults, on the operator's word alone. Never moves, and leaves the drives without power.

        Raises
        ------
        DeviceFaultError
            If an axis still moves, or the cause of its fault is still there.
        """
        self._require_connected()
        for axis in self._axes:
            reset_fault(axis, self._presence.waiter(axis))
        for axis in self._axes:
            if axis.activity is Activity.REST:
                see_homed(axis, self._presence.waiter(axis))
        self._state = self._newest()

    def close(self) -> None:
        """Stop the stage if the bus still lives, take the power off drives at rest, and release the bus."""
        try:
            if self._presence.connected:
                self._stop(6)
                for axis in self._axes:
                    if axis.activity is Activity.REST and axis.state is DriveState.OPERATION_ENABLED:
                        axis.control(Control.DISABLE_VOLTAGE)
                    axis.node.order("PRE-OPERATIONAL")
        except DeviceError:
            pass  # without heartbeats the drives stop by themselves
        finally:
            self._presence.connected = False
            for axis in self._axes:
                axis.node.close()

    # How both axes are one stage

    @property
    def _names(self) -> str:
        return " and ".join(axis.name for axis in self._axes)

    def _newest(self) -> StageState:
        return state_of(self._axes, self._clock.now())

    def _stop_moving(self) -> None:
        """Stop each axis that moves and is not being stopped."""
        for axis in self._axes:
            if axis.activity not in {Activity.REST, Activity.STOPPING}:
                axis.quick_stop()

    def _stop(self, attempts: int) -> None:
        """Stop each axis that moves, and wait until its drive has heard it."""
        self._stop_moving()
        stopping = [axis for axis in self._axes if axis.activity is Activity.STOPPING]
        for _ in range(attempts):
            deadline = self._clock.now() + STOP_INTERVAL
            while self._clock.now() < deadline:
                if not any(axis.state is DriveState.OPERATION_ENABLED for axis in stopping):
                    return
                self._presence.wait(deadline)
            for axis in stopping:
                axis.quick_stop()
        if stopping:
            raise DeviceTimeoutError(
                f"{' and '.join(axis.name for axis in stopping)} did not stop within {attempts * STOP_INTERVAL:g} s; "
                "press the emergency stop if it moves"
            )

    def _enable(self, mode: int) -> None:
        for axis in self._axes:
            enable(axis, mode, self._presence.waiter(axis))

    def _require_connected(self) -> None:
        if not self._presence.connected:
            raise LinkError(f"{self._names} are not connected: connect first")

    def _require_rest(self, what: str) -> None:
        """Raise DeviceFaultError unless both axes are at rest without a fault."""
        for axis in self._axes:
            axis.take_in()
            if axis.fault:
                raise DeviceFaultError(f"{axis.name} refuses {what}: the fault {axis.fault} must be cleared first")
            if axis.activity is not Activity.REST:
                raise DeviceFaultError(f"{axis.name} refuses {what}: it must be at rest first")

    def _await_both(
        self, so: Callable[[Axis], bool], what: str, insist: Callable[[Axis], None] = lambda _: None
    ) -> None:
        """Wait until something is so of both axes; stop both and raise if it does not come to that, insisted or not."""
        insist_at = self._clock.now() + INSIST_PERIOD
        deadline = self._clock.now() + ANSWER_TIMEOUT
        while True:
            missing = [axis for axis in self._axes if not so(axis)]
            troubled = [axis for axis in self._axes if axis.fault or axis.refusal]
            if not missing and not troubled:
                self._state = self._newest()
                return
            if troubled or self._clock.now() >= deadline:
                self._stop_moving()
                self._state = self._newest()
                raise (
                    _trouble(troubled[0])
                    if troubled
                    else DeviceTimeoutError(f"{missing[0].name} has not {what} within {ANSWER_TIMEOUT:g} s")
                )
            if self._clock.now() >= insist_at:
                for axis in missing:
                    insist(axis)
                insist_at += INSIST_PERIOD
            self._presence.wait(deadline)


def _trouble(axis: Axis) -> DeviceFaultError:
    """Return what an axis has against what it was asked."""
    if axis.fault:
        return DeviceFaultError(f"{axis.name} reports {axis.fault}; it stays stopped until the fault is cleared")
    return DeviceFaultError(f"{axis.name} refused the set-point: {axis.refusal}")
