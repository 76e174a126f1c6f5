"""Virtual time: devices that are functions of time, stepped as fast as the host computes.

A whole measurement runs in it inside a test, with the very drivers that talk to a serial port.
"""

from __future__ import annotations

from math import ceil, inf
from typing import Protocol

from drivers.errors import LinkError


class TimedDevice(Protocol):
    """A device as a function of time, in whole microseconds of the virtual clock.

    Any call may raise ConnectionError: the device has been unplugged, for good.
    """

    def feed(self, data: bytes, now_us: int) -> None:
        """Take bytes that reach the device now."""

    def poll(self, now_us: int) -> bytes:
        """Return the bytes that the device has sent up to now."""

    def next_due_us(self) -> int | None:
        """Return when the device will next act if nothing reaches it, None for never."""


class _Acting(Protocol):
    """What takes part in virtual time."""

    def due_us(self) -> int | None:
        """Return when it will next act."""

    def act(self, at_us: int) -> None:
        """Do what was due at `at_us`."""


class VirtualClock:
    """A `Clock` on which time passes only in `wait` and `sleep_until`, from one act of a device to the next.

    Devices act in the order of their due times; those due together in the order their links were opened.
    """

    def __init__(self) -> None:
        self._now_us = 0
        self._news = False
        self._alarm = inf
        self._links: list[_Acting] = []

    @property
    def now_us(self) -> int:
        """The present instant in microseconds."""
        return self._now_us

    def now(self) -> float:
        """Return the present instant in seconds."""
        return self._now_us / 1e6

    def sleep_until(self, instant: float) -> None:
        """Let time pass until `instant`, whatever arrives."""
        end_us = _round_up_us(instant)
        while self._step(end_us):
            pass

    def wait(self, deadline: float) -> None:
        """Let time pass until something new has arrived on any link, a link has failed, or `deadline` has come."""
        deadline, self._alarm = min(deadline, self._alarm), inf
        end_us = _round_up_us(deadline)
        while not self._news and self._step(end_us):
            pass
        self._news = False

    def alarm(self, instant: float) -> None:
        """End the next `wait` at `instant` at the latest."""
        self._alarm = min(self._alarm, instant)

    def notify(self) -> None:
        """End the present `wait`, or else the next one."""
        self._news = True

    def attach(self, link: _Acting) -> None:
        """Let `link` take part; called by the link itself."""
        self._links.append(link)

    def detach(self, link: _Acting) -> None:
        """Let `link` take part no longer; called by the link itself."""
        if link in self._links:
            self._links.remove(link)

    def _step(self, end_us: int) -> bool:
        """Go to the next act of a device, or to the end; return whether the end is still to come."""
        due = [(link.due_us(), link) for link in tuple(self._links)]
        next_us = min((at_us for at_us, _ in due if at_us is not None), default=None)
        if next_us is None or next_us > end_us:
            self._now_us = max(self._now_us, end_us)
            return False
        self._now_us = max(self._now_us, next_us)
        for at_us, link in due:
            if at_us is not None and at_us <= self._now_us:
                link.act(at_us)
        return True


class VirtualLink:
    """A `ByteLink` to a device in virtual time. Bytes take no time on the line."""

    def __init__(self, device: TimedDevice, clock: VirtualClock, *, name: str = "virtual") -> None:
        self._device = device
        self._clock = clock
        self._name = name
        self._arrived = bytearray()
        self._lost = ""
        clock.attach(self)

    @property
    def name(self) -> str:
        """What an operator would call it."""
        return self._name

    def write(self, data: bytes) -> None:
        """Hand `data` to the device now; its answer, if it is immediate, has arrived on return."""
        self._require_open()
        try:
            self._device.feed(data, self._clock.now_us)
        except ConnectionError as error:
            self._lose(error)
            self._require_open()
        self._poll()

    def receive(self) -> bytes:
        """Return all bytes that have arrived. Never waits."""
        if not self._arrived:
            self._require_open()
        data = bytes(self._arrived)
        self._arrived.clear()
        return data

    def close(self) -> None:
        """Leave the device."""
        self._clock.detach(self)
        self._lost = self._lost or f"{self._name} is closed"
        self._arrived.clear()

    def due_us(self) -> int | None:
        """Return when the device will next act."""
        try:
            return self._device.next_due_us()
        except ConnectionError as error:
            self._lose(error)
            return None

    def act(self, at_us: int) -> None:
        """Let the device do what is due; `at_us` is when it was due."""
        if not self._poll() and not self._lost and self.due_us() == at_us:
            raise RuntimeError(
                f"the device on {self._name} is due at {at_us} us but does nothing: time would stand still"
            )

    def _poll(self) -> bool:
        """Collect what the device has sent; return whether it was anything."""
        try:
            data = self._device.poll(self._clock.now_us)
        except ConnectionError as error:
            self._lose(error)
            return False
        if data:
            self._arrived += data
            self._clock.notify()
        return bool(data)

    def _lose(self, error: ConnectionError) -> None:
        self._lost = f"{self._name} was unplugged ({error})"
        self._clock.detach(self)
        self._clock.notify()

    def _require_open(self) -> None:
        if self._lost:
            raise LinkError(self._lost)


def _round_up_us(instant: float) -> int:
    """Return the first microsecond that `VirtualClock.now` does not report as earlier than `instant`."""
    instant_us = ceil(instant * 1e6)
    return instant_us if instant_us / 1e6 >= instant else instant_us + 1
