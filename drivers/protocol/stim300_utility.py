r"""Utility mode of the STIM300: commands in text with a CRC-8, for machines.

    host  $command,parameter,...,crc CR        unit  #command,status,value,...,crc CR

The checksum has the polynomial 07, starts with FF, covers all up to and with the last comma, and is written in decimal.

>>> encode_command("isn")
b'$isn,28\r'
>>> parse_replies(b"#isn,0,N2558184602002,32\r")
[Reply(command='isn', status=0, values=('N2558184602002',))]
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from fastcrc import crc8

ENTER = b"UTILITYMODE\r"
ENTERED = "UTILITYMODE"  #: command of the reply that has no status
MAX_REPLY = 256  #: bytes

_REPLY = re.compile(rb"(?=(#[ -~]{1,%d})\r)" % MAX_REPLY)  # looks ahead: a # within one may begin the true reply
#: Why a command is refused, by status.
REFUSALS = {
    1: "invalid command",
    2: "wrong checksum",
    3: "unknown command",
    4: "wrong number of parameters",
    5: "invalid parameter",
    6: "saved too often",
    7: "cannot be saved",
    8: "reduced to the limits of the bias trim",
}


@dataclass(frozen=True, slots=True)
class Reply:
    """One reply with a good checksum."""

    command: str  #: empty if the unit did not understand it
    status: int  #: 0 for success
    values: tuple[str, ...] = ()


def crc8_of(text: bytes) -> int:
    """Return the checksum of a command or reply up to its last comma."""
    return int(crc8.smbus(text, 0xFF))


def encode_command(command: str, *parameters: int | str) -> bytes:
    """Return a command as bytes."""
    text = "".join(f"{part}," for part in (f"${command}", *parameters)).encode("ascii")
    return text + b"%d\r" % crc8_of(text)


def parse_replies(heard: bytes) -> list[Reply]:
    """Return the good replies in what was heard, whatever stands between them."""
    replies = (_parse(match.group(1)) for match in _REPLY.finditer(heard))
    return [reply for reply in replies if reply is not None]


def _parse(line: bytes) -> Reply | None:
    text, comma, crc = line.rpartition(b",")
    if not crc.isdigit() or len(crc) > 3 or int(crc) != crc8_of(text + comma):
        return None
    command, *values = text[1:].decode("ascii").split(",")
    if command == ENTERED and not values:
        return Reply(ENTERED, 0)
    if not values or not values[0].isdigit():
        return None
    return Reply(command, int(values[0]), tuple(values[1:]))
