"""Whether the bytes on a line are those of a native device."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count

from drivers.api import DeviceIdentity
from drivers.errors import ProtocolError
from drivers.native.greeting import KIND_NAMES, hello, identity
from drivers.protocol.framing import FrameDecoder, encode_frame
from drivers.protocol.native import DeviceKind, MessageType, message_type, parse

#: Bytes at which other instruments would take what came before for a command of theirs.
_ENDS_OF_COMMANDS = b"\r\n"


def _harmless_hello() -> bytes:
    """Return a HELLO, ended by zeros, that no instrument with commands in text or registers takes for one of those."""
    frames = (encode_frame(hello(session)) for session in count(0x6E6F7274))
    return b"\0" + next(frame for frame in frames if not any(end in frame for end in _ENDS_OF_COMMANDS))


@dataclass(frozen=True, slots=True)
class NativeRecogniser:
    """A `drivers.recognition.Recogniser`: a frame with a good CRC-32C is proof.

    Its question is HELLO, which moves nothing; a stage that another host is moving comes to rest.
    """

    name: str = "native"
    baudrates: tuple[int, ...] = (921_600,)
    question: bytes = _harmless_hello()

    def recognise(self, heard: bytes) -> DeviceIdentity | None:
        """Return who sent `heard`, None if it is no native device."""
        kind = None
        for body in FrameDecoder().feed(b"\0" + heard):
            of_body = message_type(body)
            if of_body is MessageType.IDENTITY:
                return self._answered(body)
            if of_body in {MessageType.SAMPLES, MessageType.STAGE_STATUS}:
                kind = DeviceKind.GYRO if of_body is MessageType.SAMPLES else DeviceKind.STAGE
        if kind is None:
            return None
        return DeviceIdentity(kind=KIND_NAMES[kind], model="in use by another host", serial_number="")

    @staticmethod
    def _answered(body: bytes) -> DeviceIdentity:
        answer = parse(body)
        try:
            return identity(answer, "it", None)
        except ProtocolError as error:
            kind = KIND_NAMES.get(answer.device_kind, "unknown")
            return DeviceIdentity(kind=kind, model=str(error), serial_number="")


RECOGNISER = NativeRecogniser()
