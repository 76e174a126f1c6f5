"""Transports: real pseudo-terminals and sockets, and virtual time. No test sleeps; all waits have a deadline."""

from __future__ import annotations

import os
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress

import pytest

from drivers.api import ByteLink, Clock
from drivers.errors import LinkError
from drivers.transport.clock import SystemClock
from drivers.transport.serial_port import _MAX_CHUNKS, SerialLink, list_ports, open_link
from drivers.transport.virtual import VirtualClock, VirtualLink

PATIENCE = 5.0  # s, far more than anything here takes
posix = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals")


class Pty:
    """A pseudo-terminal: the device's end, and the path of the host's."""

    def __init__(self) -> None:
        self.master, slave = os.openpty()
        self.path = os.ttyname(slave)
        os.close(slave)

    def write(self, data: bytes) -> None:
        """Send as the device."""
        while data:
            data = data[os.write(self.master, data) :]

    def unplug(self) -> None:
        """Take the device's end away."""
        with suppress(OSError):
            os.close(self.master)


@pytest.fixture
def pty() -> Iterator[Pty]:
    """Make a pseudo-terminal."""
    pty = Pty()
    yield pty
    pty.unplug()


def receive(link: ByteLink, clock: Clock, size: int) -> bytes:
    """Collect `size` bytes from `link`."""
    deadline = clock.now() + PATIENCE
    data = link.receive()
    while len(data) < size and clock.now() < deadline:
        clock.wait(deadline)
        data += link.receive()
    return data


def until_lost(link: ByteLink, clock: Clock) -> str:
    """Receive until the link fails, and return what it says."""
    deadline = clock.now() + PATIENCE
    while clock.now() < deadline:
        try:
            link.receive()
        except LinkError as error:
            return str(error)
        clock.wait(deadline)
    return "never lost"


@posix
def test_bytes_pass_both_ways(pty: Pty) -> None:
    """All 256 byte values pass a pseudo-terminal unchanged in either direction."""
    clock = SystemClock()
    link = open_link(pty.path, clock)
    every = bytes(range(256)) * 8
    pty.write(every)
    assert receive(link, clock, len(every)) == every
    assert link.receive() == b""
    link.write(every)
    sent = b""
    while len(sent) < len(every):
        sent += os.read(pty.master, 4096)
    assert sent == every
    link.close()


@posix
def test_a_long_stream_arrives_whole(pty: Pty) -> None:
    """A megabyte sent at once, far beyond all buffers, arrives whole and in order."""
    clock = SystemClock()
    link = open_link(pty.path, clock)
    stream = b"".join(index.to_bytes(4, "big") for index in range(250_000))
    sender = threading.Thread(target=pty.write, args=(stream,))
    sender.start()
    assert receive(link, clock, len(stream)) == stream
    sender.join(PATIENCE)
    link.close()


@posix
def test_an_arrival_ends_the_wait(pty: Pty) -> None:
    """A wait of an hour ends when a byte comes, and one that came before the wait is not slept over."""
    clock = SystemClock()
    link = open_link(pty.path, clock)
    pty.write(b"x")
    clock.wait(clock.now() + 3600)
    assert link.receive() == b"x"
    link.close()


@posix
def test_a_port_is_opened_by_one_alone(pty: Pty) -> None:
    """A second open fails and says why; after close the port is free again."""
    clock = SystemClock()
    link = open_link(pty.path, clock)
    with pytest.raises(LinkError, match=f"cannot open {pty.path}: another program is using it"):
        open_link(pty.path, clock)
    link.close()
    open_link(pty.path, clock).close()


@posix
def test_unplugging_is_named(pty: Pty) -> None:
    """What came before the unplugging can be read; then every call names the port, and the wait ends at once."""
    clock = SystemClock()
    link = open_link(pty.path, clock)
    assert isinstance(link, SerialLink)
    pty.write(b"last words")
    clock.wait(clock.now() + PATIENCE)  # the reader has them
    pty.unplug()
    link._reader.join(PATIENCE)
    assert link.receive() == b"last words"
    assert until_lost(link, clock).startswith(f"{pty.path} was unplugged")
    with pytest.raises(LinkError, match="was unplugged"):
        link.write(b"x")
    link.close()


@posix
def test_a_closed_link_says_so(pty: Pty) -> None:
    """After close, even twice, every call is a LinkError; the reader thread has ended."""
    link = open_link(pty.path, SystemClock())
    assert isinstance(link, SerialLink)
    link.close()
    link.close()
    assert not link._reader.is_alive()
    with pytest.raises(LinkError, match=f"{pty.path} is closed"):
        link.receive()
    with pytest.raises(LinkError, match=f"{pty.path} is closed"):
        link.write(b"x")


@posix
def test_nobody_at_the_other_end_blocks_nothing(pty: Pty) -> None:
    """A line that takes no more bytes is a LinkError within about a second, not a hang; close does not hang either."""
    clock = SystemClock()
    link = open_link(pty.path, clock)
    begun = clock.now()
    with pytest.raises(LinkError, match="takes no more bytes"):
        link.write(bytes(4096 * 1000))
    link.close()
    assert clock.now() - begun < PATIENCE


@posix
def test_an_unread_link_closes(pty: Pty) -> None:
    """A reader whose queue is full still ends when the link is closed."""
    link = open_link(pty.path, SystemClock())
    assert isinstance(link, SerialLink)
    link._chunks.extend([b"unread"] * _MAX_CHUNKS)
    pty.write(b"more")
    link.close()
    assert not link._reader.is_alive()


@pytest.mark.parametrize(
    ("address", "reason"),
    [
        ("/dev/there-is-no-such-port", "there is no such port"),
        (str(os.devnull), "it is no serial port"),
        ("socket://127.0.0.1:9", "nothing listens there"),
        ("socket://127.0.0.1:notaport", "only socket://HOST:PORT"),
        ("socket://127.0.0.1:70000", "only socket://HOST:PORT"),
        ("spy:///dev/ttyS0", "only socket://HOST:PORT"),
    ],
)
def test_what_cannot_be_opened_is_named(address: str, reason: str) -> None:
    """Each failure to open is one sentence with the address and the reason."""
    with pytest.raises(LinkError, match=reason) as caught:
        open_link(address, SystemClock())
    assert str(caught.value).startswith(f"cannot open {address}: ")
    assert "\n" not in str(caught.value)


def test_a_socket_in_the_place_of_a_port() -> None:
    """Bytes pass a TCP connection both ways, whole reads at a time, and the peer's leaving is named."""
    clock = SystemClock()
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"socket://127.0.0.1:{server.getsockname()[1]}"
        link = open_link(address, clock)
        peer, _ = server.accept()
        with peer:
            data = bytes(range(256)) * 100
            peer.sendall(data)
            assert receive(link, clock, len(data)) == data
            link.write(b"\0answer")
            assert peer.recv(100) == b"\0answer"
        assert until_lost(link, clock).startswith(f"{address} was unplugged")
        link.close()


def test_the_system_clock_keeps_its_promises() -> None:
    """A wait ends at its deadline, a deadline in the past at once, and sleep_until is not cut short by news."""
    clock = SystemClock()
    start = clock.now()
    clock.wait(start - 1)
    clock.notify()
    clock.sleep_until(start + 0.02)
    assert clock.now() >= start + 0.02
    clock.wait(start + 3600)  # ended by the notice before
    clock.wait(start + 0.04)
    assert start + 0.04 <= clock.now() < start + PATIENCE


def test_ports_are_listed() -> None:
    """The list of ports holds addresses, whatever this machine has."""
    assert all(port.address for port in list_ports())


class FakeTicker:
    """Sends its name and the time each `period_us`; echoes what it is fed; may be unplugged."""

    def __init__(self, name: str, period_us: int) -> None:
        self.name = name
        self.period_us = period_us
        self.due_us = period_us
        self.out = b""
        self.unplugged_us: int | None = None

    def feed(self, data: bytes, now_us: int) -> None:
        """Echo."""
        self._check(now_us)
        self.out += data

    def poll(self, now_us: int) -> bytes:
        """Tick."""
        self._check(now_us)
        while self.due_us <= now_us:
            self.out += f"{self.name}{self.due_us} ".encode()
            self.due_us += self.period_us
        out, self.out = self.out, b""
        return out

    def next_due_us(self) -> int | None:
        """Return when it ticks next."""
        return self.due_us

    def _check(self, now_us: int) -> None:
        if self.unplugged_us is not None and now_us >= self.unplugged_us:
            raise ConnectionResetError("cable pulled")


def test_virtual_devices_act_in_the_order_of_time() -> None:
    """Two devices on one clock act at their own instants, in order, and each wait ends at the next arrival."""
    clock = VirtualClock()
    links = [VirtualLink(FakeTicker("a", 300), clock), VirtualLink(FakeTicker("b", 200), clock)]
    log = []
    while clock.now_us < 900:
        clock.wait(900e-6)
        log.append((clock.now_us, *(link.receive() for link in links)))
    assert log == [
        (200, b"", b"b200 "),
        (300, b"a300 ", b""),
        (400, b"", b"b400 "),
        (600, b"a600 ", b"b600 "),
        (800, b"", b"b800 "),
        (900, b"a900 ", b""),
    ]


def test_virtual_time_passes_to_the_deadline() -> None:
    """With nothing due a wait ends at its deadline exactly; sleep_until lets devices act but is not cut short."""
    clock = VirtualClock()
    clock.wait(0.1 + 0.2)
    assert clock.now() >= 0.1 + 0.2
    assert clock.now_us == 300_001  # the sum is a little more than 0.3
    link = VirtualLink(FakeTicker("t", 400_000), clock)
    clock.sleep_until(1.0)
    assert clock.now() == 1.0
    assert link.receive() == b"t400000 t800000 "


def test_a_virtual_answer_is_there_at_once() -> None:
    """What a device answers to a write has arrived on return, and the next wait does not let time pass."""
    clock = VirtualClock()
    link = VirtualLink(FakeTicker("e", 10**9), clock)
    link.write(b"echo")
    clock.wait(1.0)
    assert clock.now_us == 0
    assert link.receive() == b"echo"


def test_a_virtual_device_can_be_unplugged() -> None:
    """A ConnectionError of the device is a LinkError of the link, seen in the wait, after the bytes before it."""
    clock = VirtualClock()
    device = FakeTicker("u", 100)
    device.unplugged_us = 250
    link = VirtualLink(device, clock, name="bench:gyro")
    clock.sleep_until(1e-3)
    assert link.receive() == b"u100 u200 "
    for call in (link.receive, lambda: link.write(b"x")):
        with pytest.raises(LinkError, match=r"bench:gyro was unplugged \(cable pulled\)"):
            call()
    link.close()
    other = VirtualLink(device, clock, name="bench:stage")
    with pytest.raises(LinkError, match="bench:stage was unplugged"):
        other.write(b"x")
    other.close()
    with pytest.raises(LinkError, match="unplugged"):
        other.receive()


def test_a_device_that_stops_time_is_found_out() -> None:
    """A device that is due but does nothing is an error of the device, not an endless loop."""

    class FakeStuck(FakeTicker):
        def poll(self, now_us: int) -> bytes:
            return b""

    clock = VirtualClock()
    VirtualLink(FakeStuck("s", 100), clock)
    with pytest.raises(RuntimeError, match="due at 100 us but does nothing"):
        clock.wait(1.0)
