r"""A CAN bus behind an slcan adapter: the LAWICEL protocol on a serial port, each message ended by ``\r``.

    host:    C          close the channel       adapter: \r, or \a if it was closed already
    host:    S8         1 Mbit/s                adapter: \r, or \a if it has no such bit rate
    host:    O          open the channel        adapter: \r
    host:    F          status flags            adapter: F80
    host:    t19021FA0  send                    adapter: \r, z\r, or \a if it could not
                                                adapter: t1901... for each frame on the bus

Written here because python-can's own reader takes a byte a system call, drops what the adapter answers, and waits two
seconds at each start. The protocol has no checksum: a line of another length than its own is dropped and counted.
"""

from __future__ import annotations

import re
import time
from contextlib import suppress

from drivers.api import EXTENDED_IDENTIFIER
from drivers.errors import LinkError
from drivers.transport.can_address import BusAddress
from drivers.transport.can_frames import ERROR, EXTENDED_MASK, REMOTE, STANDARD_MASK, Frame
from drivers.transport.serial_port import open_port, read_some, write_all

BITRATES = {
    10_000: "S0", 20_000: "S1", 50_000: "S2", 100_000: "S3", 125_000: "S4",
    250_000: "S5", 500_000: "S6", 800_000: "S7", 1_000_000: "S8",
}  # fmt: skip
_ANSWER_TIME = 0.3  # s; an adapter that stays silent for longer is one that does not answer this
_STATUS_PERIOD = 0.2  # s
_BAD_FLAGS = 0xE8  # bus error, arbitration lost, error passive, data overrun
_MAX_LINE = 64  # bytes; the longest frame with a time stamp has 31
_LINE = re.compile(
    rb"t([0-9A-Fa-f]{3})([0-8])([0-9A-Fa-f]*)\r|T([0-9A-Fa-f]{8})([0-8])([0-9A-Fa-f]*)\r|([^\r\a]*)([\r\a])"
)
_ACKNOWLEDGED = {b"", b"z", b"Z"}


class SlcanPort:
    """An open channel of an slcan adapter; `baudrate` is that of its serial port."""

    def __init__(self, address: BusAddress, baudrate: int) -> None:
        self.n_malformed = 0
        self._rest = b""
        self._tells_status = False
        self._status_at = 0.0
        if address.bitrate not in BITRATES:
            known = ", ".join(map(str, BITRATES))
            raise LinkError(f"cannot open {address}: an slcan adapter has the bit rates {known}")
        self._port = open_port(address.channel, baudrate=baudrate)
        try:
            self._set_up(address, BITRATES[address.bitrate])
        except OSError as error:
            self._port.close()
            raise LinkError(f"cannot open {address}: {error}") from error
        except LinkError:
            self._port.close()
            raise

    def read(self, timeout: float) -> list[Frame]:
        """Return what has come."""
        now = time.monotonic()
        if self._tells_status and now >= self._status_at:
            self._status_at = now + _STATUS_PERIOD
            write_all(self._port, b"F\r")
        self._rest += read_some(self._port, timeout)
        return self._frames()

    def send(self, identifier: int, data: bytes) -> None:
        """Send a data frame."""
        head = (
            f"T{identifier & EXTENDED_MASK:08X}"
            if identifier & EXTENDED_IDENTIFIER
            else f"t{identifier & STANDARD_MASK:03X}"
        )
        write_all(self._port, f"{head}{len(data)}{data.hex().upper()}\r".encode())

    def close(self) -> None:
        """Close the channel and release the port."""
        with suppress(OSError):
            write_all(self._port, b"C\r")
        with suppress(OSError, ValueError):
            self._port.close()

    def _set_up(self, address: BusAddress, bitrate: str) -> None:
        write_all(self._port, b"\r\rC\r")
        heard = self._answer(_ANSWER_TIME) != b"" or self._port.in_waiting > 0
        while self._answer(0.02):
            pass
        for command, meaning in ((bitrate, f"the bit rate {address.bitrate}"), ("O", "to open its channel")):
            write_all(self._port, f"{command}\r".encode())
            answer = self._answer(_ANSWER_TIME)
            if answer.endswith(b"\a"):
                raise LinkError(f"cannot open {address}: the adapter refuses {meaning}")
            heard = heard or answer != b""
        if not heard:
            raise LinkError(f"cannot open {address}: nothing answers there like an slcan adapter")
        write_all(self._port, b"F\r")
        deadline = time.monotonic() + _ANSWER_TIME
        while (answer := self._answer(deadline - time.monotonic())) and answer[:1] not in b"F\a":
            pass  # a frame came first
        self._tells_status = answer.startswith(b"F")
        self._status_at = time.monotonic() + _STATUS_PERIOD

    def _answer(self, timeout: float) -> bytes:
        """Return the next message with its end, ``b""`` if none comes in time."""
        deadline = time.monotonic() + timeout
        while not (match := re.match(rb"[^\r\a]*[\r\a]", self._rest)):
            left = deadline - time.monotonic()
            if left <= 0:
                return b""
            self._rest = (self._rest + read_some(self._port, left))[-4096:]
        self._rest = self._rest[match.end() :]
        return match[0]

    def _frames(self) -> list[Frame]:
        """Return the frames of all whole lines that have come."""
        frames: list[Frame] = []
        end = 0
        for match in _LINE.finditer(self._rest):
            end = match.end()
            standard, length, data, extended, long_length, long_data, other, mark = match.groups()
            if standard is not None:
                self._take(int(standard, 16), length, data, frames)
            elif extended is not None:
                self._take(int(extended, 16) & EXTENDED_MASK | EXTENDED_IDENTIFIER, long_length, long_data, frames)
            else:
                self._note(other, mark, frames)
        self._rest = self._rest[end:]
        if len(self._rest) > _MAX_LINE:
            self.n_malformed += 1
            self._rest = b""
        return frames

    def _take(self, identifier: int, length: bytes, digits: bytes, frames: list[Frame]) -> None:
        """Take a data frame if it has all its digits, with or without a time stamp behind."""
        n_digits = 2 * int(length)
        if len(digits) - n_digits in {0, 4}:
            frames.append((identifier, bytes.fromhex(digits[:n_digits].decode())))
        else:
            self.n_malformed += 1

    def _note(self, message: bytes, mark: bytes, frames: list[Frame]) -> None:
        """Take a message that is no data frame."""
        if mark == b"\a":
            frames.append((ERROR, b""))  # a frame that the adapter could not send
        elif message[:1] == b"F":
            if len(message) == 3 and message[1:].isalnum() and _flags(message) & _BAD_FLAGS:
                frames.append((ERROR, b""))
        elif message[:1] in {b"r", b"R"}:
            frames.append((REMOTE, b""))
        elif message not in _ACKNOWLEDGED:
            self.n_malformed += 1


def _flags(message: bytes) -> int:
    try:
        return int(message[1:3], 16)
    except ValueError:
        return 0xFF
