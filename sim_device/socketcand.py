"""A socketcand server: the bench's CAN bus over TCP, for any number of clients.

The protocol is text in angle brackets. The server greets with ``< hi >``; the client says ``< open can0 >`` and
``< rawmode >``, each answered with ``< ok >``; from then on the client sends ``< send 123 2 a 1f >`` (identifier,
length, bytes; eight digits for 29 bits) and gets ``< frame 123 23.424242 0A1F >`` and ``< error 20000040 23.424242 >``
(identifier of an error frame as of SocketCAN). ``< echo >`` is answered in kind.
"""

from __future__ import annotations

import contextlib
import re
import socket
import time

from sim_device.can_bench import ERROR, EXTENDED, Tap, Wire
from sim_device.ports import READ_SIZE, listen

CHANNEL = "can0"
GREETING = b"< hi >"
LONGEST_COMMAND = 200
BUFFER = 1 << 20  #: bytes held back for a client that does not read; frames beyond are lost to it
QUIET_S = 0.2  #: after rawmode's answer, which clients expect alone, unless they speak first

_COMMAND = re.compile(r"<([^<>]*)>")
_ERROR_CLASS = 0x20000000


class Conversation:
    """One client, without its socket: `feed` takes what it says, `out` holds what to tell it."""

    def __init__(self, wire: Wire) -> None:
        self.out = bytearray(GREETING)
        self.tap: Tap | None = None  #: once in raw mode
        self._wire = wire
        self._text = ""
        self._is_open = False

    def feed(self, data: bytes, now_us: int) -> None:
        """Take what the client says; frames reach the wire at `now_us`."""
        self._text += data.decode("ascii", errors="replace")
        end = 0
        for match in _COMMAND.finditer(self._text):
            end = match.end()
            self._execute(match[1].split(), now_us)
        self._text = self._text[end:][-LONGEST_COMMAND:]

    def collect(self) -> None:
        """Put what the tap has heard into `out`."""
        if self.tap is None or not self.tap.waiting:
            return
        lines = [_line(*heard) for heard in self.tap.waiting]
        self.tap.waiting.clear()
        if len(self.out) < BUFFER:
            self.out += "".join(lines).encode()

    def leave(self) -> None:
        """Hang up."""
        if self.tap is not None:
            self._wire.remove(self.tap)
            self.tap = None

    def _execute(self, words: list[str], now_us: int) -> None:
        match words:
            case ["open", channel]:
                self._is_open = channel == CHANNEL
                self.out += b"< ok >" if self._is_open else b"< error could not open bus >"
            case ["rawmode"] if self._is_open:
                self.tap = self.tap or self._wire.tap()
                self.out += b"< ok >"
            case ["send", identifier, length, *data] if self.tap is not None:
                self._send(self.tap, identifier, length, data, now_us)
            case ["echo"]:
                self.out += b"< echo >"
            case _:
                self.out += b"< error unknown command >"

    def _send(self, tap: Tap, identifier: str, length: str, data: list[str], now_us: int) -> None:
        try:
            number, count, content = int(identifier, 16), int(length, 16), bytes(int(byte, 16) for byte in data)
        except ValueError:
            number, count, content = -1, 0, b""
        extended = len(identifier) == 8
        if not 0 <= number <= (0x1FFFFFFF if extended else 0x7FF) or count != len(content) or count > 8:
            self.out += b"< error syntax error in send command >"
        else:
            tap.send(number | (EXTENDED if extended else 0), content, now_us)


def _line(time_us: int, identifier: int, data: bytes) -> str:
    stamp = f"{time_us // 1_000_000}.{time_us % 1_000_000:06d}"
    if identifier & ERROR:
        return f"< error {identifier & 0x1FFFFFFF | _ERROR_CLASS:08X} {stamp} >"
    if identifier & EXTENDED:
        return f"< frame {identifier & 0x1FFFFFFF:08X} {stamp} {data.hex().upper()} >"
    return f"< frame {identifier & 0x7FF:03X} {stamp} {data.hex().upper()} >"


class SocketcandPort:
    """The server's socket, and those of its clients.

    Parameters
    ----------
    wire
        What it serves.
    host, port
        To listen on; port 0 for any that is free.

    """

    def __init__(self, wire: Wire, host: str, port: int = 0) -> None:
        self._wire = wire
        self._listener, name = listen(host, port)
        self._clients: dict[socket.socket, Conversation] = {}
        self._quiet_until: dict[socket.socket, float] = {}
        self.address = f"socketcand:{name}:{CHANNEL}"

    @property
    def handles(self) -> tuple[int, ...]:
        """File descriptors that tell when a client has come or said something."""
        return (self._listener.fileno(), *(client.fileno() for client in self._clients))

    def take_in(self, now_us: int) -> None:
        """Welcome new clients, and do what all of them say."""
        with contextlib.suppress(BlockingIOError):
            while True:
                client, _ = self._listener.accept()
                client.settimeout(0)
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._clients[client] = Conversation(self._wire)
        for client, conversation in list(self._clients.items()):
            was_raw = conversation.tap is not None
            try:
                data = client.recv(READ_SIZE)
            except BlockingIOError:
                continue
            except OSError:
                data = b""
            if not data:
                self._drop(client)
                continue
            conversation.feed(data, now_us)
            if was_raw:
                self._quiet_until.pop(client, None)
            elif conversation.tap is not None:
                self._quiet_until[client] = time.monotonic() + QUIET_S

    def bring_out(self) -> bool:
        """Tell all clients what they have to hear; return whether there was something."""
        spoke = False
        for client, conversation in list(self._clients.items()):
            if not self._is_quiet(client):
                conversation.collect()
            if conversation.out:
                spoke = True
                self._send(client, conversation)
        return spoke

    def close(self) -> None:
        """Hang up, and listen no more."""
        for client in list(self._clients):
            self._drop(client)
        self._listener.close()

    def _is_quiet(self, client: socket.socket) -> bool:
        """Return whether the answer to rawmode has only just gone out."""
        until = self._quiet_until.get(client)
        if until is None:
            return False
        if time.monotonic() < until:
            return True
        del self._quiet_until[client]
        return False

    def _send(self, client: socket.socket, conversation: Conversation) -> None:
        try:
            del conversation.out[: client.send(conversation.out)]
        except BlockingIOError:
            return
        except OSError:
            self._drop(client)

    def _drop(self, client: socket.socket) -> None:
        self._clients.pop(client).leave()
        self._quiet_until.pop(client, None)
        client.close()
