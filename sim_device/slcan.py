r"""A serial CAN adapter on a pseudo-terminal, as it speaks the LAWICEL protocol ("slcan").

Commands are ASCII and end with CR; the adapter answers CR for yes, BEL for no:

=====================  ========================================================================================
``Sn``                 bit rate: 10, 20, 50, 100, 125, 250, 500, 800, 1000 kbit/s for n = 0 to 8; while closed
``sxxyy``              bit timing registers, taken without being understood; while closed
``O``, ``L``, ``C``    open, open to listen only, close
``tiiildd``, ``T``     send a frame with an 11-bit or 29-bit identifier; answered ``z``, ``Z`` and CR
``riiil``, ``R``       the same for remote frames
``F``                  status bits as two digits: 2 warning, 3 overrun, 5 error passive, 7 bus error; clears them
``V``, ``N``           version and serial number
``Zn``                 time stamps (ms within a minute, four digits behind each frame) on or off; while closed
=====================  ========================================================================================

Frames that come in are told in the same form as they are sent.
"""

from __future__ import annotations

from collections.abc import Callable

from sim_device.can_bench import ERROR, EXTENDED, REMOTE, Wire
from sim_device.ports import PtyPort

RATES = (10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000)
YES, NO = b"\r", b"\a"
LONGEST_COMMAND = 32
BUFFER = 65_536  #: bytes held back for a host that does not read; frames beyond are lost

WARNING, OVERRUN, PASSIVE, BUS_ERROR = 0x04, 0x08, 0x20, 0x80
_MINUTE_MS = 60_000


class Adapter:
    """The adapter without its port: `feed` takes what the host says, `out` holds what to tell it."""

    def __init__(self, wire: Wire) -> None:
        self.out = bytearray()
        self._wire = wire
        self._tap = wire.tap(0)
        self._rate = 0
        self._listens_only = False
        self._stamps = False
        self._status = 0
        self._line = bytearray()
        self._now_us = 0
        self._commands: dict[str, Callable[[str], bytes]] = {
            "": lambda _: YES,
            "S": self._set_rate,
            "s": self._set_timing,
            "O": self._open,
            "L": self._open,
            "C": self._close,
            "F": self._tell_status,
            "V": lambda _: b"V1013\r",
            "N": lambda _: b"NSIM1\r",
            "Z": self._set_stamps,
            "t": self._send,
            "T": self._send,
            "r": self._send,
            "R": self._send,
        }

    @property
    def is_open(self) -> bool:
        """Whether it is on the bus."""
        return self._tap.bitrate != 0

    def feed(self, data: bytes, now_us: int) -> None:
        """Take what the host says; frames reach the wire at `now_us`."""
        self._now_us = now_us
        *lines, rest = (bytes(self._line) + data).split(YES)
        for line in lines:
            self.out += self._execute(line)
        self._line = bytearray(rest[: LONGEST_COMMAND + 1])

    def collect(self) -> None:
        """Put what the tap has heard into `out`."""
        waiting = self._tap.waiting
        if not waiting:
            return
        heard = list(waiting)
        waiting.clear()
        if any(identifier & ERROR for _, identifier, _ in heard):
            self._status |= WARNING | PASSIVE | BUS_ERROR
        if len(self.out) > BUFFER:
            self._status |= OVERRUN
        elif self.is_open:
            self.out += "".join([self._told(*frame) for frame in heard if not frame[1] & ERROR]).encode()

    def _execute(self, line: bytes) -> bytes:
        try:
            text = line.decode("ascii")
        except UnicodeDecodeError:
            return NO
        command = self._commands.get(text[:1])
        return NO if command is None or len(text) > LONGEST_COMMAND else command(text)

    def _set_rate(self, text: str) -> bytes:
        if self.is_open or len(text) != 2 or not "0" <= text[1] <= "8":
            return NO
        self._rate = RATES[int(text[1])]
        return YES

    def _set_timing(self, text: str) -> bytes:
        if self.is_open or len(text) != 5 or _hexadecimal(text[1:]) is None:
            return NO
        self._rate = -1  # unknown, so no bus has it
        return YES

    def _open(self, text: str) -> bytes:
        if self.is_open or not self._rate or len(text) != 1:
            return NO
        self._listens_only = text == "L"
        self._tap.bitrate = self._rate
        return YES

    def _close(self, text: str) -> bytes:
        if not self.is_open or len(text) != 1:
            return NO
        self._tap.bitrate = 0
        self._tap.waiting.clear()
        return YES

    def _set_stamps(self, text: str) -> bytes:
        if self.is_open or text not in {"Z0", "Z1"}:
            return NO
        self._stamps = text == "Z1"
        return YES

    def _tell_status(self, text: str) -> bytes:
        if not self.is_open or len(text) != 1:
            return NO
        self.collect()
        status, self._status = self._status, 0
        if not self._tap.attuned:
            status |= BUS_ERROR
        return f"F{status:02X}\r".encode()

    def _send(self, text: str) -> bytes:
        frame = _parse(text)
        if frame is None or not self.is_open or self._listens_only:
            return NO
        if not self._tap.send(*frame, self._now_us):
            self._status |= WARNING | PASSIVE | BUS_ERROR  # nobody acknowledges it
        return b"z\r" if text[0] in "tr" else b"Z\r"

    def _told(self, time_us: int, identifier: int, data: bytes) -> str:
        remote, extended = identifier & REMOTE, identifier & EXTENDED
        kind = ("R" if extended else "r") if remote else ("T" if extended else "t")
        name = f"{identifier & 0x1FFFFFFF:08X}" if extended else f"{identifier & 0x7FF:03X}"
        stamp = f"{time_us // 1000 % _MINUTE_MS:04X}" if self._stamps else ""
        return f"{kind}{name}{len(data)}{'' if remote else data.hex().upper()}{stamp}\r"


def _hexadecimal(text: str) -> int | None:
    return int(text, 16) if text and all(digit in "0123456789abcdefABCDEF" for digit in text) else None


def _parse(text: str) -> tuple[int, bytes] | None:
    """Return the frame of a command to send, None if it is none."""
    extended, remote = text[0] in "TR", text[0] in "rR"
    digits = 8 if extended else 3
    identifier, length = _hexadecimal(text[1 : 1 + digits]), text[1 + digits : 2 + digits]
    if identifier is None or identifier > (0x1FFFFFFF if extended else 0x7FF) or length not in list("012345678"):
        return None
    tail = text[2 + digits :]
    if len(text) < 2 + digits or len(tail) != (0 if remote else 2 * int(length)):
        return None
    if tail and _hexadecimal(tail) is None:
        return None
    data = bytes(int(length)) if remote else bytes.fromhex(tail)
    return identifier | EXTENDED * extended | REMOTE * remote, data


class SlcanPort:
    """An adapter on a pseudo-terminal of its own."""

    def __init__(self, wire: Wire) -> None:
        self._pty = PtyPort()
        self._adapter = Adapter(wire)
        self.address = f"slcan:{self._pty.address}"

    @property
    def handles(self) -> tuple[int, ...]:
        """File descriptors that tell when the host has said something."""
        return self._pty.handles

    def take_in(self, now_us: int) -> None:
        """Do what the host says."""
        data = self._pty.receive()
        if data:
            self._adapter.feed(data, now_us)

    def bring_out(self) -> bool:
        """Tell the host what it has to hear; return whether there was something."""
        self._adapter.collect()
        out = self._adapter.out
        if not out:
            return False
        del out[: self._pty.send(bytes(out))]
        return True

    def close(self) -> None:
        """Hang up."""
        self._pty.close()
