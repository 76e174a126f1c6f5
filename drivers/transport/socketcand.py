"""A CAN bus behind a socketcand server, in its raw mode.

    server: < hi >
    host:   < open can0 >          server: < ok >
    host:   < rawmode >            server: < ok >
    host:   < send 190 2 1F A0 >
    server: < frame 190 1234.567890 1FA0 >
    server: < error 040 1234.567890 >

Written here because python-can's own reader takes a server that has gone for a silent one, and takes a frame a call.
"""

from __future__ import annotations

import re
import select
import socket
import time
from contextlib import suppress

from drivers.api import EXTENDED_IDENTIFIER
from drivers.errors import LinkError
from drivers.transport.can_address import BusAddress, split_socketcand
from drivers.transport.can_frames import ERROR, EXTENDED_MASK, STANDARD_MASK, Frame
from drivers.transport.can_port import SEND_TIMEOUT

_CONNECT_TIMEOUT = 3.0  # s
_CHUNK = 65536
_MAX_MESSAGE = 256  # bytes without a ">": no socketcand server
_MESSAGE = re.compile(rb"< frame ([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8}) [\d.]+ ((?:[0-9A-Fa-f]{2} ?){0,8}) *>|<([^<>]*)>")
_ERROR = re.compile(rb" error ([0-9A-Fa-f]{1,8})\b")


class SocketcandPort:
    """An open bus of a socketcand server."""

    def __init__(self, address: BusAddress) -> None:
        self.n_malformed = 0
        self._rest = b""
        host, port, bus = split_socketcand(address.channel)
        deadline = time.monotonic() + _CONNECT_TIMEOUT
        try:
            self._socket = socket.create_connection((host, port), _CONNECT_TIMEOUT)
        except OSError as error:
            raise LinkError(f"cannot open {address}: {_why(error)}") from error
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._expect(address, "hi", deadline)
            for request in (f"open {bus}", "rawmode"):
                self._socket.sendall(f"< {request} >".encode())
                self._expect(address, "ok", deadline, request)
            self._socket.settimeout(SEND_TIMEOUT)
        except OSError as error:
            self._socket.close()
            raise LinkError(f"cannot open {address}: {_why(error)}") from error
        except LinkError:
            self._socket.close()
            raise

    def read(self, timeout: float) -> list[Frame]:
        """Return what has come."""
        if b">" not in self._rest:
            if not select.select([self._socket], [], [], timeout)[0]:
                return []
            self._receive()
        return self._frames()

    def send(self, identifier: int, data: bytes) -> None:
        """Send a data frame."""
        text = (
            f"{identifier & EXTENDED_MASK:08X}"
            if identifier & EXTENDED_IDENTIFIER
            else f"{identifier & STANDARD_MASK:03X}"
        )
        self._socket.sendall(f"< send {text} {len(data)} {data.hex(' ').upper()} >".encode())

    def close(self) -> None:
        """Leave the server."""
        with suppress(OSError):
            self._socket.close()

    def _receive(self) -> None:
        data = self._socket.recv(_CHUNK)
        if not data:
            raise ConnectionError("the server is gone")
        self._rest += data

    def _frames(self) -> list[Frame]:
        """Return the frames of all whole messages that have come."""
        frames: list[Frame] = []
        end = 0
        for match in _MESSAGE.finditer(self._rest):
            identifier, data, other = match.groups()
            if match.start() != end and self._rest[end : match.start()].strip():
                self.n_malformed += 1
            end = match.end()
            if identifier is None:
                self._note(other, frames)
            else:
                number = int(identifier, 16)
                if len(identifier) == 8:
                    number |= EXTENDED_IDENTIFIER
                frames.append((number, bytes.fromhex(data.decode())))
        self._rest = self._rest[end:]
        if len(self._rest) > _MAX_MESSAGE:
            self.n_malformed += 1
            self._rest = b""
        return frames

    def _note(self, message: bytes, frames: list[Frame]) -> None:
        """Take a message that is no frame."""
        error = _ERROR.match(message)
        if error:
            frames.append((int(error[1], 16) & EXTENDED_MASK | ERROR, b""))
        elif message.strip() != b"ok":
            self.n_malformed += 1

    def _expect(self, address: BusAddress, answer: str, deadline: float, request: str = "") -> None:
        """Take one message, which must be `answer`. Raises LinkError if it is another."""
        while b">" not in self._rest and len(self._rest) < _MAX_MESSAGE:
            self._socket.settimeout(max(0.01, deadline - time.monotonic()))
            self._receive()
        message, _, self._rest = self._rest.partition(b">")
        text = message.decode("ascii", "replace").strip("< \r\n")
        if text != answer:
            shown = "".join(c if c.isascii() and c.isprintable() else "?" for c in text[:60])
            asked = f"answered {request!r} with" if request else "is no socketcand server: it greets with"
            raise LinkError(f"cannot open {address}: the server {asked} {shown!r}")


def _why(error: OSError) -> str:
    if isinstance(error, TimeoutError):
        return "the server does not answer"
    if isinstance(error, ConnectionRefusedError):
        return "no socketcand server listens there"
    if isinstance(error, socket.gaierror):
        return "its host name is not known"
    return str(error)
