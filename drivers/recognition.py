"""Which instrument is behind a port: what each driver knows of the bytes that its device sends.

A driver takes part with one object that satisfies `Recogniser`, under its own name in the entry point group
``northfinder.recognisers``. Recognisers are pure: bytes in, an identity out; `drivers.discovery.identify` opens the
port, listens first at each baud rate, and asks a question only where nothing was recognised by listening.
"""

from __future__ import annotations

from typing import Protocol

from drivers.api import DeviceIdentity

GROUP = "northfinder.recognisers"


class Recogniser(Protocol):
    """How one kind of instrument is known by its bytes; frozen plain data and one pure function."""

    @property
    def name(self) -> str:
        """The driver's name, as in ``stim300:/dev/ttyUSB0``."""

    @property
    def baudrates(self) -> tuple[int, ...]:
        """Baud rates that the instrument may be set to, the usual one first; all of them are listened at."""

    @property
    def question(self) -> bytes:
        """What makes an instrument of this kind say who it is, ``b""`` where it talks unasked.

        It must move nothing and change no setting of any instrument, whoever may be behind the port.
        """

    def recognise(self, heard: bytes) -> DeviceIdentity | None:
        """Return who sent `heard`, None if it is not one of these.

        `heard` is what came in some tenths of a second, perhaps after the question; it may begin and end within a
        frame and hold junk. Only what a checksum (or as much as the instrument has of one) vouches for counts, in at
        least two frames where it is a sum of 16 bits or less. What is not known of the identity is an empty string.
        """
