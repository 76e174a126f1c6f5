"""The host's presence on the bus: its heartbeat, which the drives watch, and which goes on while it waits for them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from drivers.api import Clock
from drivers.canopen.node import SERVICE_PERIOD
from drivers.cia402.axis import Axis
from drivers.cia402.power import Wait
from drivers.cia402.setup import HOST_NODE
from drivers.errors import DeviceTimeoutError

HEARTBEAT_PERIOD = 0.05  # s of host time; half of what the drives are promised, so that a late call does no harm
HEARTBEAT_SPAN_MS = 100  # of device time
ANSWER_TIMEOUT = 1.0  # s for a drive to go where it was told


class Presence:
    """Beats before each look at what an axis has sent, once `connected`; `clock` is that of the axes' links."""

    def __init__(self, axes: Sequence[Axis], clock: Clock) -> None:
        self.connected = False  #: whether the drives are told that the host is there
        self._axes = axes
        self._clock = clock
        self._beaten_at = 0.0
        self._beaten_ms = 0
        for axis in axes:
            axis.node.duty = self._beat

    def waiter(self, axis: Axis, timeout: float = ANSWER_TIMEOUT) -> Wait:
        """Return what waits until something is so of an axis, and raises DeviceTimeoutError if it does not come."""

        def wait(so: Callable[[], bool], what: str) -> None:
            deadline = self._clock.now() + timeout
            while not so():
                if self._clock.now() >= deadline:
                    raise DeviceTimeoutError(f"{axis.name} has not come to {what} within {timeout:g} s")
                self.wait(deadline)

        return wait

    def wait(self, deadline: float) -> None:
        """Let a service period pass, or less if something comes."""
        heard = [axis.take_in() for axis in self._axes]
        if not any(heard):
            self._clock.wait(min(deadline, self._clock.now() + SERVICE_PERIOD))
            for axis in self._axes:
                axis.take_in()

    def _beat(self) -> None:
        """Send the host's heartbeat if it is time; so before anything new is looked at."""
        if not self.connected:
            return
        now = self._clock.now()
        newest_ms = max(axis.device_time_ms or 0 for axis in self._axes)
        if newest_ms - self._beaten_ms >= HEARTBEAT_SPAN_MS or now - self._beaten_at >= HEARTBEAT_PERIOD:
            self._beaten_at, self._beaten_ms = now, newest_ms
            self._axes[0].node.send(0x700 + HOST_NODE, b"\x05")
        for axis in self._axes:
            axis.acknowledge()
