"""How a Zaber device is known by its answers. The questions are for settings and can move or change nothing."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.api import DeviceIdentity
from drivers.protocol.zaber import LineDecoder, Reply, encode_command
from drivers.zaber.identity import identity_of

_QUESTIONS = {11: "get deviceid", 12: "get system.serial", 13: "get version"}


@dataclass(frozen=True, slots=True)
class ZaberRecogniser:
    """A `drivers.recognition.Recogniser` of Zaber devices in the ASCII protocol."""

    name: str = "zaber"
    baudrates: tuple[int, ...] = (115_200, 57_600, 19_200, 9_600)
    question: bytes = b"".join(encode_command(text, message_id=number) for number, text in _QUESTIONS.items())

    def recognise(self, heard: bytes) -> DeviceIdentity | None:
        """Return the first device that has answered at least two of the questions, each under its number."""
        answers: dict[int, dict[int, str]] = {}
        for message in LineDecoder().feed(heard):
            if isinstance(message, Reply) and message.accepted and message.message_id in _QUESTIONS:
                answers.setdefault(message.device, {})[message.message_id] = message.data
        for device in sorted(answers):
            told = answers[device]
            if len(told) > 1 and told.get(11, "0").isdecimal():
                return identity_of(device_id=told.get(11, ""), serial_number=told.get(12, ""), version=told.get(13, ""))
        return None


RECOGNISER = ZaberRecogniser()
