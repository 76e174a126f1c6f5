"""Serial ports, and TCP in the place of one, through pyserial.

An address is a device path (``/dev/ttyUSB0``), a Windows port (``COM3``) or ``socket://host:port``.
"""

from __future__ import annotations

import errno
import os
import re
import select
import socket
import threading
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass

import serial
from serial.tools import list_ports as _list_ports

from drivers.api import ByteLink, Clock
from drivers.errors import LinkError

DEFAULT_BAUDRATE = 921_600
_POLL = 0.05  # s, how often an idle reader looks whether it shall end
_WRITE_TIMEOUT = 1.0  # s
_CHUNK = 4096  # bytes a read at most
_MAX_CHUNKS = 1024  # chunks that wait for the host; beyond it the operating system's buffer fills
_SOCKET = "socket://"
_SOCKET_ADDRESS = re.compile(r"socket://([\w.-]+|\[[\da-fA-F:.]+\]):(\d{1,5})", re.ASCII)

_OPEN_FAILURES = {
    errno.ENOENT: "there is no such port; `northfinder devices` lists the ports",
    errno.ENODEV: "there is no device behind it; is it plugged in?",
    errno.EACCES: "no permission; on Linux the user must be in the port's group, often dialout",
    errno.EPERM: "no permission; on Linux the user must be in the port's group, often dialout",
    errno.EBUSY: "another program is using it",
    errno.EAGAIN: "another program is using it",
    errno.ENOTTY: "it is no serial port",
    errno.ECONNREFUSED: "nothing listens there",
}


@dataclass(frozen=True, slots=True)
class PortInfo:
    """A serial port of this machine."""

    address: str
    description: str


def list_ports() -> list[PortInfo]:
    """Return the serial ports of this machine, by address."""
    return [PortInfo(port.device, port.description or "") for port in sorted(_list_ports.comports())]


def open_link(address: str, clock: Clock, *, baudrate: int = DEFAULT_BAUDRATE) -> ByteLink:
    """Open a port for this program alone.

    Parameters
    ----------
    address
        Device path, Windows port name, or ``socket://host:port``.
    clock
        Its `wait` ends when something arrives.
    baudrate
        Bit/s; without meaning for a socket.

    Raises
    ------
    LinkError
        If the port does not exist, is in use, or may not be opened.
    """
    return SerialLink(open_port(address, baudrate=baudrate), address, clock)


def open_port(address: str, *, baudrate: int = DEFAULT_BAUDRATE) -> serial.Serial:
    """Open a port for this program alone, for `read_some` and `write_all`; the rest is as `open_link` says."""
    url = _SOCKET_ADDRESS.fullmatch(address)
    if "://" in address and not (url and int(url[2]) < 2**16):
        raise LinkError(f"cannot open {address}: of all URLs only socket://HOST:PORT is that of a device")
    try:
        port = serial.serial_for_url(
            address,
            baudrate,
            timeout=0 if _selectable(address) else _POLL,
            write_timeout=_WRITE_TIMEOUT,
            exclusive=True if os.name == "posix" else None,
        )
    except (OSError, ValueError) as error:
        raise LinkError(f"cannot open {address}: {_why(error)}") from error
    _hasten(port, address)
    return port


class SerialLink:
    """A `ByteLink` over an open pyserial port, read by a thread of its own."""

    def __init__(self, port: serial.Serial, address: str, clock: Clock) -> None:
        self._port = port
        self._name = address
        self._clock = clock
        self._chunks: deque[bytes] = deque()
        self._closed = False
        self._lost = ""
        self._reader = threading.Thread(target=self._read_on, name=f"reader of {address}", daemon=True)
        self._reader.start()

    @property
    def name(self) -> str:
        """The address it was opened with."""
        return self._name

    def write(self, data: bytes) -> None:
        """Hand over all of `data` for sending; blocks while the port takes no more, for a second at most."""
        self._require_open()
        try:
            write_all(self._port, data)
        except TimeoutError as error:
            raise LinkError(f"{self._name} takes no more bytes: nothing reads at its other end") from error
        except (OSError, ValueError) as error:
            self._lost = self._lost or f"{self._name} was unplugged ({error})"
            self._require_open()

    def receive(self) -> bytes:
        """Return all bytes that have arrived, ``b""`` if none. Never waits."""
        lost = self._lost  # seen before the chunks, or the last one could be overlooked
        if not self._chunks:
            if lost or self._closed:
                self._require_open()
            return b""
        return b"".join(self._chunks.popleft() for _ in range(len(self._chunks)))

    def close(self) -> None:
        """Release the port. Closing twice is no error."""
        if self._closed:
            return
        self._closed = True
        self._reader.join(1.0)
        self._chunks.clear()
        with suppress(OSError, ValueError):
            self._port.close()

    def _require_open(self) -> None:
        if self._closed:
            raise LinkError(f"{self._name} is closed")
        if self._lost:
            raise LinkError(self._lost)

    def _read_on(self) -> None:
        try:
            while not self._closed:
                if len(self._chunks) >= _MAX_CHUNKS:
                    time.sleep(_POLL)
                elif data := read_some(self._port, _POLL):
                    self._chunks.append(data)
                    self._clock.notify()
        except (OSError, ValueError) as error:
            self._lost = f"{self._name} was unplugged ({error})"
            self._clock.notify()


def read_some(port: serial.Serial, timeout: float) -> bytes:
    """Return what has come, waiting up to `timeout` s for the first byte (50 ms where it cannot be waited for).

    Raises
    ------
    OSError
        If the port is gone.
    """
    if port.timeout == 0:
        ready, _, _ = select.select([port.fileno()], [], [], timeout)
        size = _CHUNK if ready else 0
    else:
        size = min(_CHUNK, max(1, port.in_waiting))
    if not size:
        return b""
    if os.name != "posix":
        data: bytes = port.read(size)
        return data
    data = os.read(port.fileno(), size)
    if not data:
        raise ConnectionError("the other end is gone")
    return data


def write_all(port: serial.Serial, data: bytes) -> None:
    """Write to a port; pyserial's own write makes a second system call each time.

    Raises
    ------
    TimeoutError
        If it takes nothing for a second.
    OSError
        If the port is gone.
    """
    if os.name != "posix":
        try:
            port.write(data)
        except serial.SerialTimeoutException as error:
            raise TimeoutError from error
        return
    descriptor = port.fileno()
    while data:
        try:
            data = data[os.write(descriptor, data) :]
        except BlockingIOError:
            if not select.select([], [descriptor], [], _WRITE_TIMEOUT)[1]:
                raise TimeoutError from None


def _selectable(address: str) -> bool:
    """Return whether the port can be waited for with select, which takes all that has come in one read."""
    return os.name == "posix" or address.startswith(_SOCKET)


def _hasten(port: serial.Serial, address: str) -> None:
    """Ask for short delays where the port has such a thing."""
    with suppress(OSError, ValueError, AttributeError, NotImplementedError):
        if address.startswith(_SOCKET):
            with socket.fromfd(port.fileno(), socket.AF_INET, socket.SOCK_STREAM) as same:
                same.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        else:
            port.set_low_latency_mode(True)  # Linux alone has it


def _why(error: BaseException) -> str:
    """Return in plain words why a port cannot be opened."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, socket.gaierror):
            return "its host name is not known"
        if isinstance(cause, TimeoutError):
            return "its host does not answer"
        if cause.args and cause.args[0] in _OPEN_FAILURES:
            return _OPEN_FAILURES[cause.args[0]]
        cause = cause.__context__
    return str(error)
