"""KVH's configuration mode: lines of text, in which a unit is asked what its numbers mean. It sends no samples there.

    host  =KEYWORD,value or ?KEYWORD CR LF     unit  KEYWORD,value in capitals, or INVALID,... for what it does not know

Nothing is changed unless the operator allows it: a unit keeps what it is set to without its supply.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Self

from drivers.errors import DeviceFaultError, DeviceTimeoutError, ProtocolError
from drivers.frame_stream import FrameStream
from drivers.protocol.kvh import Units, decoder, speaks_format_c

DATA_RATES = (1, 5, 10, 25, 50, 100, 250, 500, 750, 1000, 3600, 5000)  #: Hz
TEMPERATURE_UNITS = ("C", "C_100", "F", "F_100")
_PATIENCE = 0.5  # s
_ATTEMPTS = 3


@dataclass(frozen=True, slots=True)
class Found:
    """What a unit says of itself."""

    units: Units
    form: str  #: A or B
    serial_number: str = ""


class ConfigurationMode:
    """A visit to configuration mode, as a context: whatever happens in it, the unit sends samples again after it."""

    def __init__(self, stream: FrameStream) -> None:
        self._stream = stream

    def __enter__(self) -> Self:
        heard, answer = self._exchange("=CONFIG,1", "CONFIG")
        if answer is None:
            self._leave()
            raise _no_answer(self._stream.link.name, heard)
        return self

    def __exit__(self, *_: object) -> None:
        self._leave()

    def ask(self, keyword: str) -> str | None:
        """Return the value of a setting, None if the unit does not know it."""
        _, answer = self._exchange(f"?{keyword}", keyword)
        return answer or None

    def set(self, keyword: str, value: str) -> None:
        """Change a setting; raise DeviceFaultError if the unit refuses."""
        _, answer = self._exchange(f"={keyword},{value}", keyword)
        if answer != value:
            raise DeviceFaultError(f"{self._stream.link.name} refuses ={keyword},{value}")

    def _leave(self) -> None:
        leave(self._stream)

    def _exchange(self, command: str, keyword: str) -> tuple[bytes, str | None]:
        """Return all that came after a command, and its answer: empty if it is INVALID, None if there is none."""
        answer = re.compile(rb"(?:%s,|(INVALID))([ -~]*)[\r\n]" % keyword.encode("ascii"))
        heard = b""
        for _ in range(_ATTEMPTS):
            self._stream.link.write(command.encode("ascii") + b"\r\n")
            heard, found = self._stream.hear(answer.search, patience=_PATIENCE, heard=heard)
            if found is not None:
                return heard, "" if found[1] else found[2].decode("ascii")
        return heard, None


def leave(stream: FrameStream) -> None:
    """Leave configuration mode, which a unit does not answer."""
    stream.link.write(b"=CONFIG,0\r\n")


def configure(stream: FrameStream, *, data_rate: int | None, may_set: bool) -> Found:
    """Ask a unit what it is set to, and set its data rate if that is asked for and allowed.

    Raises
    ------
    DeviceTimeoutError
        If it does not answer.
    ProtocolError
        If it is no such gyro, or sends what cannot be read.
    DeviceFaultError
        If it is set otherwise than asked for and that may not or cannot be changed.
    """
    name = stream.link.name
    with ConfigurationMode(stream) as mode:
        found = _ask_all(mode, name)
        if data_rate not in {None, found.units.data_rate}:
            if not may_set:
                raise DeviceFaultError(
                    f"{name} sends {found.units.data_rate} samples a second, {data_rate} are asked for: set it so, "
                    "or allow that with configure = true (it keeps the setting)"
                )
            mode.set("DR", str(data_rate))
            found = _ask_all(mode, name)
    return found


def _ask_all(mode: ConfigurationMode, name: str) -> Found:
    answers = {keyword: mode.ask(keyword) for keyword in ("DR", "ROTFMT", "ROTUNITS", "TEMPUNITS", "OUTPUTFMT", "IS")}
    rate, form = answers["DR"], answers["OUTPUTFMT"] or "A"  # older units have no other format
    rotation, angle = answers["ROTFMT"] or "DELTA", answers["ROTUNITS"] or "RAD"
    temperature = answers["TEMPUNITS"] or "C"
    if form == "C":
        raise ProtocolError(f"{name} sends format C, which is not read here: set it to A with =OUTPUTFMT,A")
    if rate is None or not rate.isdigit() or int(rate) == 0:
        raise ProtocolError(f"{name} says {rate!r} when asked for its data rate: is it a KVH gyro?")
    for value, known, what in (
        (form, ("A", "B"), "output format"),
        (rotation, ("DELTA", "RATE"), "rotation format"),
        (angle, ("RAD", "DEG"), "rotation unit"),
        (temperature, TEMPERATURE_UNITS, "temperature unit"),
    ):
        if value not in known:
            raise ProtocolError(f"{name} has the {what} {value!r}, expected {' or '.join(known)}")
    units = Units(data_rate=int(rate), delta=rotation == "DELTA", degrees=angle == "DEG", temperature=temperature)
    return Found(units, form, serial_number=answers["IS"] or "")


def _no_answer(name: str, heard: bytes) -> DeviceTimeoutError | ProtocolError:
    if not heard:
        return DeviceTimeoutError(f"{name} is silent: no KVH gyro has answered =CONFIG,1. Look at its supply and wires")
    if speaks_format_c(heard):
        return ProtocolError(f"{name} sends format C, which is not read here: set it to A with =OUTPUTFMT,A")
    if decoder().feed(heard):
        return DeviceTimeoutError(
            f"{name} sends samples but does not answer =CONFIG,1: is the pair from the host to the gyro wired?"
        )
    return ProtocolError(
        f"{name} sends bytes, {len(heard)} while waited for, but no message of a KVH gyro: is it one, "
        "and is its baud rate the port's?"
    )
