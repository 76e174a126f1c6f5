"""CAN buses: links that share an adapter, read by a thread of its own.

An address is ``INTERFACE:CHANNEL[@BITRATE]``, see `drivers.transport.can_address`. Opening a bus that this program
has open already gives another link to it; the adapter is released with the last of them.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable

from drivers.api import BusCounts, Clock, FrameLink
from drivers.errors import LinkError
from drivers.transport.can_address import BusAddress
from drivers.transport.can_frames import ERROR, REMOTE, STANDARD_MASK, Frame, is_bus_off
from drivers.transport.can_port import Port, PythonCanPort
from drivers.transport.serial_port import DEFAULT_BAUDRATE
from drivers.transport.slcan import SlcanPort
from drivers.transport.socketcand import SocketcandPort

MAX_FRAMES = 65_536  #: that wait for the host on one link; a minute of a fast gyro
_POLL = 0.05  # s, how often an idle reader looks whether it shall end
_FLAGS = REMOTE | ERROR

_buses: dict[str, _Bus] = {}
_registry = threading.Lock()


def open_bus(
    address: BusAddress,
    clock: Clock,
    *,
    accept: Iterable[int] | None = None,
    baudrate: int = DEFAULT_BAUDRATE,
    max_frames: int = MAX_FRAMES,
) -> FrameLink:
    """Open a bus, or another link to one that is open.

    Parameters
    ----------
    address
        Which bus.
    clock
        Its `wait` ends when something arrives on the link.
    accept
        Identifiers of the frames that the link is to get, None for all.
    baudrate
        Of the serial port of an slcan adapter, bit/s.
    max_frames
        How many may wait on the link; it is lost once more have come than the program takes.

    Raises
    ------
    LinkError
        If there is no such adapter or channel, it is in use, or has no such bit rate.
    """
    with _registry:
        bus = _buses.get(address.name)
        if bus is None or bus.lost:
            bus = _buses[address.name] = _Bus(address, _open_port(address, baudrate))
        elif bus.address != address:
            raise LinkError(f"cannot open {address}: this program has it open as {bus.address}")
        return bus.link(clock, None if accept is None else frozenset(accept), max_frames)


def _open_port(address: BusAddress, baudrate: int) -> Port:
    if address.interface == "slcan":
        return SlcanPort(address, baudrate)
    if address.interface == "socketcand":
        return SocketcandPort(address)
    return PythonCanPort(address)


class CanLink:
    """A `FrameLink` to a shared bus."""

    def __init__(self, bus: _Bus, clock: Clock, max_frames: int) -> None:
        self.clock = clock
        self._frames: deque[Frame] = deque()
        self._max_frames = max_frames
        self._overflowed = False
        self._bus = bus
        self._lost = ""
        self._closed = False

    @property
    def name(self) -> str:
        """The bus it belongs to."""
        return self._bus.address.name

    @property
    def counts(self) -> BusCounts:
        """What has been heard on the bus."""
        return self._bus.counts()

    def send(self, identifier: int, data: bytes) -> None:
        """Send one data frame; blocks while the bus takes no more, for a second at most."""
        self._require_open()
        self._bus.send(identifier, data)

    def receive(self) -> list[Frame]:
        """Return all data frames that have arrived. Never waits."""
        lost = self._lost or self._bus.lost  # seen before the frames, or the last one could be overlooked
        frames = self._frames
        if not frames:
            if lost:
                self._require_open()
            return []
        return [frames.popleft() for _ in range(len(frames))]

    def close(self) -> None:
        """Release the bus. Closing twice is no error."""
        if not self._closed:
            self._closed = True
            self._lost = f"{self.name} is closed"
            self._bus.leave(self)
            self._frames.clear()

    def put(self, frames: list[Frame]) -> None:
        """Keep frames that have come; the link is lost if too many wait. Called by the reader."""
        if self._overflowed or len(self._frames) + len(frames) > self._max_frames:
            self._overflowed = True
            self._lost = f"{self.name} has lost frames: {self._max_frames} waited, and the program did not take them"
        else:
            self._frames.extend(frames)

    def _require_open(self) -> None:
        lost = self._lost or self._bus.lost
        if lost:
            raise LinkError(lost)


class _Bus:
    """An open adapter, its reader, and the links to it."""

    def __init__(self, address: BusAddress, port: Port) -> None:
        self.address = address
        self.lost = ""
        self._port = port
        self._links: tuple[tuple[CanLink, frozenset[int] | None], ...] = ()
        self._closed = False
        self._n_frames = self._n_errors = self._n_remote = 0
        self._identifiers: set[int] = set()
        self._sending = threading.Lock()
        self._reader = threading.Thread(target=self._read_on, name=f"reader of {address}", daemon=True)

    def link(self, clock: Clock, accept: frozenset[int] | None, max_frames: int) -> CanLink:
        """Return a new link. Called with the registry locked, as `leave` locks it."""
        link = CanLink(self, clock, max_frames)
        self._links = (*self._links, (link, accept))
        if not self._reader.is_alive():
            self._reader.start()
        return link

    def leave(self, link: CanLink) -> None:
        """Take a link off; release the adapter with the last one."""
        with _registry:
            self._links = tuple(entry for entry in self._links if entry[0] is not link)
            if self._links:
                return
            self._closed = True
            if _buses.get(self.address.name) is self:
                del _buses[self.address.name]
            self._reader.join(1.0)
            self._port.close()

    def counts(self) -> BusCounts:
        """Return what has been heard."""
        return BusCounts(
            n_frames=self._n_frames,
            n_errors=self._n_errors,
            n_remote=self._n_remote,
            n_malformed=self._port.n_malformed,
            identifiers=frozenset(self._identifiers.copy()),
        )

    def send(self, identifier: int, data: bytes) -> None:
        """Send a data frame. Raises LinkError if the bus takes none, or is gone."""
        try:
            with self._sending:
                self._port.send(identifier, data)
        except TimeoutError as error:
            raise LinkError(
                f"{self.address} takes no more frames: is another node powered, at this bit rate?"
            ) from error
        except (OSError, ValueError) as error:
            self._lose(f"{self.address.name} was unplugged ({error})")
            raise LinkError(self.lost) from error

    def _read_on(self) -> None:
        try:
            while not self._closed and not self.lost:
                frames = self._port.read(_POLL)
                if frames:
                    self._dispatch(frames)
        except (OSError, ValueError) as error:
            if not self._closed:
                self._lose(f"{self.address.name} was unplugged ({error})")

    def _dispatch(self, frames: list[Frame]) -> None:
        """Hand frames to the links that want them, oldest first."""
        data = [frame for frame in frames if not frame[0] & _FLAGS]
        if len(data) != len(frames):
            self._note([identifier for identifier, _ in frames if identifier & _FLAGS])
        self._n_frames += len(data)
        self._identifiers.update(identifier for identifier, _ in data if identifier <= STANDARD_MASK)
        for link, accept in self._links:
            wanted = data if accept is None else [frame for frame in data if frame[0] in accept]
            if wanted:
                link.put(wanted)
                link.clock.notify()

    def _note(self, identifiers: list[int]) -> None:
        """Count frames that are no data."""
        for identifier in identifiers:
            if not identifier & ERROR:
                self._n_remote += 1
                continue
            self._n_errors += 1
            if is_bus_off(identifier):
                self._lose(f"{self.address.name} is off the bus after too many errors: check wiring and bit rate")

    def _lose(self, reason: str) -> None:
        self.lost = self.lost or reason
        for link, _ in self._links:
            link.clock.notify()
