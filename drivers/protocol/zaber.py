r"""The Zaber ASCII protocol, version 2: commands out, replies and alerts in. No I/O and no clock here.

    /DEVICE AXIS ID COMMAND:SUM\n          command; axis 0 is all axes of the device, device 0 all devices
    @DD A ID FLAG STATUS WW DATA:SUM\r\n   reply; flag OK or RJ, status IDLE or BUSY, WW the gravest warning or --
    !DD A STATUS WW DATA:SUM\r\n           alert, which the device sends by itself
    #DD A ID TEXT:SUM\r\n                  information, which is skipped

Numbers are decimal. SUM is the longitudinal redundancy check: two hexadecimal digits that bring the sum of all bytes
after the first to 0 modulo 256. It is optional on both ways; the ID, 00 to 99, is repeated by the reply.

Eight bits of sum are weak: every single flipped bit is caught, but of arbitrary damage 1 in 256 passes. So the decoder
takes only what has the exact form of a reply, and the driver only what answers an open question: with its ID, device,
axis and number of values. See ``docs/zaber.md``, section 4, for what remains.

>>> encode_command("get pos", device=1, axis=1, message_id=0)
b'/1 1 00 get pos:2C\n'
>>> decoder = LineDecoder()
>>> decoder.feed(b"junk\r\n@01 1 19 OK BUSY -- 10")
[]
>>> decoder.feed(b"0000:EC\r\n")
[Reply(device=1, axis=1, message_id=19, accepted=True, busy=True, warning='', data='100000', summed=True)]
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

MAX_LINE = 200  #: bytes of a line without its end; the protocol's own packets are at most 80 to 128 long
N_IDS = 100
EMPTY = "--"  #: in the place of a warning
VELOCITY_UNITS = 1.6384  #: of ``maxspeed`` and of ``move``, for one microstep/s
ACCELERATION_UNITS = 1.6384e-4  #: of ``accel``, for one microstep/s^2

#: What each warning flag means. F: the axis has stopped, or its driver is off. W: take care. N: a note.
WARNINGS = {
    "FF": "a critical system error",
    "FN": "a peripheral that the controller does not support",
    "FZ": "a peripheral that is not activated",
    "FH": "the emergency stop has switched its driver off",
    "FV": "a supply voltage too high or too low, its driver is off",
    "FO": "its driver is off",
    "FC": "an inrush of current",
    "FM": "a motor too hot or too cold",
    "FD": "its driver is off",
    "FQ": "an encoder error",
    "FI": "an index error",
    "FA": "an analog encoder out of step",
    "FR": "an overdrive beyond its limit",
    "FS": "stalled and stopped",
    "FB": "a stream beyond its bounds",
    "FP": "a path not followed",
    "FE": "an error of its limits",
    "FT": "an excessive twist",
    "WL": "a limit sensor triggered unexpectedly",
    "WV": "a supply voltage out of range",
    "WT": "a controller too hot",
    "WS": "stalled, and recovered",
    "WM": "displaced while at rest",
    "WP": "an invalid type of calibration",
    "WR": "no reference position",
    "WH": "not homed",
    "NC": "moved by its knob or another manual control",
    "NI": "a movement interrupted by another",
    "ND": "a stream interrupted",
    "NR": "a value rounded",
    "NT": "a value truncated",
    "NU": "a setting not in force yet",
    "NJ": "a joystick being calibrated",
    "NB": "in firmware update mode",
}
NOT_HOMED = frozenset({"WR", "WH"})
#: Warnings after which the position is in doubt, though the driver is still on.
DOUBTFUL = frozenset({"WL", "WS", "WM"})

#: Why a device rejects a command.
REJECTIONS = {
    "AGAIN": "it cannot be done just now",
    "BADAXIS": "it has no such axis",
    "BADCOMMAND": "it does not know this command or setting",
    "BADDATA": "a value is out of range",
    "BADMESSAGEID": "the message number is out of range",
    "DEVICEONLY": "the command is for a device, not for an axis",
    "DRIVERDISABLED": "the axis' driver is off",
    "FULL": "it can take no more",
    "INACTIVE": "the axis is not activated",
    "LOCKSTEP": "the axis is locked to another one",
    "NOACCESS": "it is locked against this command",
    "PARKED": "the axis is parked",
    "STATUSBUSY": "the axis must be at rest first",
}

_REPLY = re.compile(
    r"@(?P<device>\d\d) (?P<axis>\d)(?: (?P<id>\d\d))? (?P<flag>OK|RJ) (?P<status>IDLE|BUSY) "
    r"(?P<warning>--|[FWN][A-Z])(?: (?P<data>[ -~]*))?",
    re.ASCII,
)
_ALERT = re.compile(
    r"!(?P<device>\d\d) (?P<axis>\d) (?P<status>IDLE|BUSY) (?P<warning>--|[FWN][A-Z])(?: (?P<data>[ -~]*))?", re.ASCII
)
_SUM = re.compile(rb"(.*):([0-9A-F]{2})", re.DOTALL)


@dataclass(frozen=True, slots=True)
class Reply:
    """What a device answers."""

    device: int
    axis: int
    message_id: int | None
    accepted: bool  #: OK, else RJ
    busy: bool
    warning: str  #: the gravest, ``""`` if none
    data: str
    summed: bool  #: whether it came with a checksum


@dataclass(frozen=True, slots=True)
class Alert:
    """What a device says unasked, such as that an axis has come to rest."""

    device: int
    axis: int
    busy: bool
    warning: str
    data: str
    summed: bool


@dataclass(slots=True)
class LineCounts:
    """What a decoder has met."""

    n_lines: int = 0  #: replies and alerts
    n_information: int = 0  #: lines that begin with #
    n_bad_sum: int = 0
    n_malformed: int = 0  #: lines of impossible form, or too long


def checksum(text: bytes) -> int:
    """Return the longitudinal redundancy check of what stands between a message's first byte and the colon.

    >>> f"{checksum(b'1 1 19 move abs 100000'):02X}"
    '86'
    """
    return -sum(text) & 0xFF


def encode_command(command: str, *, device: int = 0, axis: int = 0, message_id: int | None = None) -> bytes:
    """Return the line of a command, with its checksum.

    Raises
    ------
    ValueError
        If a number is out of range, or the command holds what would end the line or begin its checksum.
    """
    if not (0 <= device < 100 and 0 <= axis < 10 and (message_id is None or 0 <= message_id < N_IDS)):
        raise ValueError(f"no device {device}, axis {axis}, message {message_id}")
    if not re.fullmatch(r"[ -9;-~]*", command, re.ASCII):
        raise ValueError(f"{command!r} is no command")
    words = [str(device), str(axis), *([] if message_id is None else [f"{message_id:02d}"]), *command.split()]
    text = " ".join(words).encode("ascii")
    return b"/%b:%02X\n" % (text, checksum(text))


class LineDecoder:
    """Turns any chunks of a byte stream into replies and alerts; skips and counts the rest.

    What comes out depends on the bytes alone and not on how they were cut into chunks. Between calls at most
    `MAX_LINE` bytes are held. Once `require_sum` is set, lines without a checksum are dropped as damaged.
    """

    def __init__(self) -> None:
        self.require_sum = False
        self._counts = LineCounts()
        self._rest = b""
        self._overlong = False

    @property
    def counts(self) -> LineCounts:
        """A copy of the counters."""
        return replace(self._counts)

    def feed(self, data: bytes) -> list[Reply | Alert]:
        """Return the messages that `data` completes, oldest first."""
        *lines, rest = data.replace(b"\r", b"\n").split(b"\n")
        if lines:
            lines[0], self._rest = self._rest + lines[0], b""
        messages = []
        for line in lines:
            if self._fits(line) and line:
                message = self._parse(line)
                if message is not None:
                    messages.append(message)
            self._overlong = False
        rest = self._rest + rest
        self._rest = rest if self._fits(rest) else b""
        return messages

    def _fits(self, line: bytes) -> bool:
        if not self._overlong and len(line) <= MAX_LINE:
            return True
        self._counts.n_malformed += not self._overlong
        self._overlong = True
        return False

    def _parse(self, line: bytes) -> Reply | Alert | None:
        """Return the message that a line holds, None if it is none."""
        summed = _SUM.fullmatch(line)
        body = summed[1] if summed else line
        if summed and checksum(body[1:]) != int(summed[2], 16):
            self._counts.n_bad_sum += 1
            return None
        if body[:1] == b"#":
            self._counts.n_information += 1
            return None
        text = body.decode("latin-1")
        found = _REPLY.fullmatch(text) or _ALERT.fullmatch(text)
        if found is None or (self.require_sum and not summed):
            self._counts.n_malformed += 1
            return None
        self._counts.n_lines += 1
        return _message(found.groupdict(), summed=summed is not None)


def _message(fields: dict[str, str | None], *, summed: bool) -> Reply | Alert:
    device, axis, busy = int(fields["device"] or 0), int(fields["axis"] or 0), fields["status"] == "BUSY"
    warning = (fields["warning"] or "").replace(EMPTY, "")
    data = (fields["data"] or "").strip()
    if "flag" not in fields:
        return Alert(device, axis, busy, warning, data, summed)
    number = None if fields["id"] is None else int(fields["id"])
    return Reply(device, axis, number, fields["flag"] == "OK", busy, warning, data, summed)


def integers(data: str, count: int) -> tuple[int, ...] | None:
    """Return the `count` whole numbers of a reply's data, None if it holds anything else.

    >>> integers("10 -20", 2), integers("10 NA", 2), integers("10", 2), integers("1_0", 1)
    ((10, -20), None, None, None)
    """
    words = data.split(" ")
    if len(words) != count or not all(re.fullmatch(r"-?\d{1,15}", word, re.ASCII) for word in words):
        return None
    return tuple(int(word) for word in words)
