"""How an Epson sensor is known: by the bursts it sends, or by its registers of identity.

To read a register its window has to be chosen, which is a write; it changes no setting and moves nothing, and every
driver chooses its windows itself.
"""

from __future__ import annotations

from dataclasses import dataclass

from drivers.api import DeviceIdentity
from drivers.protocol import epson

_WORDS = [address for _, address in (*epson.PROD_ID, *epson.SERIAL_NUM)]


@dataclass(frozen=True, slots=True)
class EpsonRecogniser:
    """A `drivers.recognition.Recogniser` of Epson sensors."""

    name: str = "epson"
    baudrates: tuple[int, ...] = (460_800, 230_400, 921_600)
    question: bytes = b"".join(
        [
            b"\r",
            epson.select_window(0),
            epson.read_command(epson.ID[1]),
            epson.select_window(1),
            *(epson.read_command(address) for address in _WORDS),
            epson.select_window(0),
        ]
    )

    def recognise(self, heard: bytes) -> DeviceIdentity | None:
        """Return who has told its id and its product, or sends bursts as this driver sets them; None if nobody."""
        start = heard.find(bytes((epson.ID[1],)) + epson.ID_VALUE.to_bytes(2, "big") + b"\r")
        if start >= 0:
            words = [_word(heard, start + 4 * place, address) for place, address in enumerate(_WORDS, 1)]
            product = epson.text_of([word or 0 for word in words[:4]])
            if None not in words and product[:1] == "G":
                return _identity(product, epson.text_of([word or 0 for word in words[4:]]))
        for bits in (32, 16):
            for model in (epson.MODELS["G370PDS0"], epson.MODELS["G370PDT0"]):
                decoder = epson.BurstDecoder(model, bits)
                if sum(len(run.bodies) for run in decoder.feed(heard)) >= 2:
                    return _identity("", "")
        return None


def _word(heard: bytes, place: int, address: int) -> int | None:
    """Return the register that a reply at `place` tells, None if there is no such reply."""
    reply = heard[place : place + 4]
    if len(reply) < 4 or (reply[0], reply[3]) != (address, epson.DELIMITER):
        return None
    return int.from_bytes(reply[1:3], "big")


def _identity(product: str, serial_number: str) -> DeviceIdentity:
    model = f"Epson {product}".strip()
    return DeviceIdentity(kind="gyro", model=model, serial_number=serial_number, protocol="Epson UART")


RECOGNISER = EpsonRecogniser()
