"""Whether the bytes on a line are those of an STIM300."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.api import DeviceIdentity
from drivers.protocol.stim300 import (
    PART_NUMBER,
    SAMPLE_IDS,
    SERIAL_NUMBER,
    decoder,
    parse_part_number,
    parse_serial_number,
)


@dataclass(frozen=True, slots=True)
class Stim300Recogniser:
    """A `drivers.recognition.Recogniser`: one datagram with a good CRC-32 is proof."""

    name: str = "stim300"
    baudrates: tuple[int, ...] = (460_800, 921_600, 1_843_200, 374_400)
    question: bytes = b""  #: it talks unasked

    def recognise(self, heard: bytes) -> DeviceIdentity | None:
        """Return who sent `heard`, None if it is no STIM300."""
        model = serial = ""
        found = False
        for frames in decoder().feed(heard):
            identifier, body = frames.header[0], frames.bodies[0].tobytes()
            if identifier in PART_NUMBER:
                model = f" {parse_part_number(body)}"
            elif identifier in SERIAL_NUMBER:
                serial = parse_serial_number(body)
            found = found or identifier in SAMPLE_IDS or bool(model or serial)
        if not found:
            return None
        return DeviceIdentity(kind="gyro", model=f"STIM300{model}", serial_number=serial, protocol="STIM300 datagrams")


RECOGNISER = Stim300Recogniser()
