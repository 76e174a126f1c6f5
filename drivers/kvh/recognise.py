"""Whether the bytes on a line are those of a KVH gyro."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.api import DeviceIdentity
from drivers.protocol.kvh import ACCELEROMETERS_VALID, FORMATS, decode_messages, decoder, speaks_format_c


@dataclass(frozen=True, slots=True)
class KvhRecogniser:
    """A `drivers.recognition.Recogniser`: one message with a good CRC-32 is proof."""

    name: str = "kvh"
    baudrates: tuple[int, ...] = (921_600, 460_800, 576_000, 115_200, 57_600, 38_400, 19_200, 9600)
    question: bytes = b""  #: it talks unasked

    def recognise(self, heard: bytes) -> DeviceIdentity | None:
        """Return who sent `heard`, None if it is no KVH gyro."""
        for frames in decoder().feed(heard):
            valid = decode_messages(frames)["status"] & ACCELEROMETERS_VALID == ACCELEROMETERS_VALID
            model = "KVH 1750 or 1775" if valid.any() else "KVH DSP-1750 or DSP-1760"
            return _identity(model, FORMATS[frames.header])
        return _identity("KVH 1775", "C, which is not read here") if speaks_format_c(heard) else None


def _identity(model: str, form: str) -> DeviceIdentity:
    return DeviceIdentity(kind="gyro", model=model, serial_number="", protocol=f"KVH format {form}")


RECOGNISER = KvhRecogniser()
