"""A CAN bus in virtual time: devices that are functions of time, and links to them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol

from drivers.api import BusCounts
from drivers.errors import LinkError
from drivers.transport.can_frames import is_bus_off, is_data
from drivers.transport.virtual import VirtualClock


class FrameDevice(Protocol):
    """A device on a bus of frames as a function of time; else like `TimedDevice`."""

    def feed(self, identifier: int, data: bytes, now_us: int) -> None:
        """Take a frame that reaches the device now."""

    def poll(self, now_us: int) -> list[tuple[int, bytes]]:
        """Return the frames that the device has sent up to now."""

    def next_due_us(self) -> int | None:
        """Return when the device will next act if nothing reaches it, None for never."""


class VirtualBus:
    """A bus of frames in virtual time: what a device sends reaches all links and all other devices at once."""

    def __init__(self, devices: Sequence[FrameDevice], clock: VirtualClock, *, name: str = "virtual") -> None:
        self.name = name
        self.lost = ""
        self._devices = devices
        self._clock = clock
        self._links: list[VirtualFrameLink] = []
        self._n_frames = self._n_errors = 0
        self._identifiers: set[int] = set()
        clock.attach(self)

    def link(self, *, accept: Iterable[int] | None = None) -> VirtualFrameLink:
        """Return a new link that gets the frames of the identifiers `accept`, or all."""
        link = VirtualFrameLink(self, None if accept is None else frozenset(accept))
        self._links.append(link)
        return link

    def leave(self, link: VirtualFrameLink) -> None:
        """Take a link off."""
        if link in self._links:
            self._links.remove(link)

    def counts(self) -> BusCounts:
        """Return what has been heard."""
        return BusCounts(n_frames=self._n_frames, n_errors=self._n_errors, identifiers=frozenset(self._identifiers))

    def send(self, identifier: int, data: bytes) -> None:
        """Hand a frame of a link to all devices; what they answer at once has arrived on return."""
        try:
            for device in self._devices:
                device.feed(identifier, data, self._clock.now_us)
        except ConnectionError as error:
            self._lose(f"{self.name} was unplugged ({error})")
        self._poll()

    def due_us(self) -> int | None:
        """Return when a device will next act."""
        try:
            due = [device.next_due_us() for device in self._devices]
        except ConnectionError as error:
            self._lose(f"{self.name} was unplugged ({error})")
            return None
        return min((at_us for at_us in due if at_us is not None), default=None)

    def act(self, at_us: int) -> None:
        """Let the devices do what is due; `at_us` is when it was due."""
        if not self._poll() and not self.lost and self.due_us() == at_us:
            raise RuntimeError(f"a device on {self.name} is due at {at_us} us but does nothing: time would stand still")

    def _poll(self) -> bool:
        """Pass on what the devices have sent, until they say no more; return whether it was anything."""
        heard = False
        try:
            while frames := [
                (device, identifier, data)
                for device in self._devices
                for identifier, data in device.poll(self._clock.now_us)
            ]:
                heard = True
                self._pass_on(frames)
        except ConnectionError as error:
            self._lose(f"{self.name} was unplugged ({error})")
        if heard:
            self._clock.notify()
        return heard

    def _pass_on(self, frames: list[tuple[FrameDevice, int, bytes]]) -> None:
        for sender, identifier, data in frames:
            if not is_data(identifier):
                self._n_errors += 1
                if is_bus_off(identifier):
                    self._lose(f"{self.name} is off the bus after too many errors")
                continue
            self._n_frames += 1
            self._identifiers.add(identifier)
            for link in self._links:
                link.take(identifier, data)
            for device in self._devices:
                if device is not sender:
                    device.feed(identifier, data, self._clock.now_us)

    def _lose(self, reason: str) -> None:
        self.lost = reason
        self._clock.detach(self)
        self._clock.notify()


class VirtualFrameLink:
    """A `FrameLink` to a `VirtualBus`. Frames take no time on the bus."""

    def __init__(self, bus: VirtualBus, accept: frozenset[int] | None) -> None:
        self._bus = bus
        self._accept = accept
        self._arrived: list[tuple[int, bytes]] = []
        self._closed = ""

    @property
    def name(self) -> str:
        """The bus's name."""
        return self._bus.name

    @property
    def counts(self) -> BusCounts:
        """What has been heard on the bus."""
        return self._bus.counts()

    def send(self, identifier: int, data: bytes) -> None:
        """Send one data frame."""
        self._require_open()
        self._bus.send(identifier, data)
        self._require_open()

    def receive(self) -> list[tuple[int, bytes]]:
        """Return all data frames that have arrived. Never waits."""
        if not self._arrived:
            self._require_open()
        frames, self._arrived = self._arrived, []
        return frames

    def take(self, identifier: int, data: bytes) -> None:
        """Let a frame arrive, if the link wants it."""
        if self._accept is None or identifier in self._accept:
            self._arrived.append((identifier, data))

    def close(self) -> None:
        """Leave the bus."""
        self._bus.leave(self)
        self._closed = f"{self.name} is closed"
        self._arrived.clear()

    def _require_open(self) -> None:
        if self._closed or self._bus.lost:
            raise LinkError(self._closed or self._bus.lost)
