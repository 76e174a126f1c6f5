"""Where the emulator meets a host: pseudo-terminals and TCP ports. Never waits; what a line cannot take is lost."""

from __future__ import annotations

import contextlib
import os
import socket
import sys
from typing import Protocol

from sim_device.bench import Line
from sim_device.faults import Endpoint

UART_BUFFER = 4096  #: bytes that a device holds back when its line is full
READ_SIZE = 65_536
UNREAD_BYTES = 512  #: beyond which a host that acknowledges nothing is waited for


class Port(Protocol):
    """One device's place where a host can open it."""

    @property
    def address(self) -> str:
        """What the host opens."""

    @property
    def handles(self) -> tuple[int, ...]:
        """File descriptors that tell when a host has said something."""

    def receive(self) -> bytes:
        """Return what the host has sent."""

    def send(self, data: bytes) -> int:
        """Send as much of `data` as the line takes now; return how much that was."""

    def unread(self) -> int:
        """Return how many bytes the host has not read yet, as far as can be told."""

    def close(self) -> None:
        """Take the place away: the host sees the line go."""


class PtyPort:
    """A pseudo-terminal in raw mode. Its other end stays open here too, so that hosts can come and go."""

    def __init__(self) -> None:
        import tty  # noqa: PLC0415 - there is none on Windows

        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.address = os.ttyname(self._slave)
        self.handles: tuple[int, ...] = (self._master,)

    def receive(self) -> bytes:
        """Return what the host has sent."""
        try:
            return os.read(self._master, READ_SIZE)
        except BlockingIOError:
            return b""

    def send(self, data: bytes) -> int:
        """Send as much of `data` as fits."""
        try:
            return os.write(self._master, data)
        except BlockingIOError:
            return 0

    def unread(self) -> int:
        """Return how many bytes the host has not read yet."""
        import fcntl  # noqa: PLC0415 - as tty
        import termios  # noqa: PLC0415 - as tty

        return int.from_bytes(fcntl.ioctl(self._slave, termios.FIONREAD, bytes(4)), sys.byteorder)

    def close(self) -> None:
        """Hang up."""
        for handle in (self._slave, self._master):
            with contextlib.suppress(OSError):
                os.close(handle)


class TcpPort:
    """A TCP port for one host at a time; a second one is refused by closing its connection.

    Parameters
    ----------
    host
        Address to listen on.
    port
        Its number, 0 for any that is free.

    """

    def __init__(self, host: str, port: int = 0) -> None:
        self._listener, name = listen(host, port)
        self._client: socket.socket | None = None
        self.address = f"socket://{name}"

    @property
    def handles(self) -> tuple[int, ...]:
        """File descriptors of the listener and of the host, if there is one."""
        client = () if self._client is None else (self._client.fileno(),)
        return (self._listener.fileno(), *client)

    def receive(self) -> bytes:
        """Return what the host has sent. A host that has gone makes room for the next."""
        data = self._read()
        if not data:
            self._accept()
        return data

    def send(self, data: bytes) -> int:
        """Send as much of `data` as fits; all of it goes nowhere if there is no host."""
        if self._client is None:
            return len(data)
        try:
            return self._client.send(data)
        except BlockingIOError:
            return 0
        except OSError:
            self._hang_up()
            return len(data)

    def unread(self) -> int:
        """Return nothing: the network has taken what was sent, and does not tell whether the host has."""
        return 0

    def close(self) -> None:
        """Hang up and listen no more."""
        self._hang_up()
        self._listener.close()

    def _read(self) -> bytes:
        if self._client is None:
            return b""
        try:
            data = self._client.recv(READ_SIZE)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._hang_up()
        return data

    def _accept(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                newcomer, _ = self._listener.accept()
                if self._client is not None:
                    newcomer.close()
                    continue
                newcomer.settimeout(0)
                newcomer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._client = newcomer

    def _hang_up(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None


def listen(host: str, port: int = 0) -> tuple[socket.socket, str]:
    """Return a socket that listens without waiting, and ``HOST:PORT`` as a host would write it."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.create_server((host, port), family=family)
    listener.settimeout(0)
    name = f"[{host}]" if ":" in host else host
    return listener, f"{name}:{listener.getsockname()[1]}"


class Connection:
    """A device's line behind a port: takes bytes across in both directions, and loses whole chunks as a UART would."""

    def __init__(self, line: Line, endpoint: Endpoint, port: Port) -> None:
        self.line = line
        self.port = port
        self.plugged = True
        self._endpoint = endpoint
        self._waiting = bytearray()

    def take_in(self, now_us: int) -> None:
        """Hand the device what its host has said."""
        data = self.port.receive() if self.plugged else b""
        try:
            if data:
                self._endpoint.feed(data, now_us)
        except ConnectionResetError:
            self._unplug()

    def bring_out(self, now_us: int) -> bool:
        """Send the host what its device has said; return whether there was something."""
        if not self.plugged:
            return False
        try:
            fresh = self._endpoint.poll(now_us)
        except ConnectionResetError:
            self._unplug()
            return False
        if len(self._waiting) + len(fresh) <= UART_BUFFER:
            self._waiting += fresh
        if self._waiting:
            del self._waiting[: self.port.send(bytes(self._waiting))]
        self.line.room = UART_BUFFER - len(self._waiting)
        if not self.line.acknowledged:
            self.line.unread = len(self._waiting) + self.port.unread() > UNREAD_BYTES
        return bool(fresh)

    def _unplug(self) -> None:
        self.plugged = False
        self.port.close()
