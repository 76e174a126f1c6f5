"""One open CAN adapter each, whatever its kind: what the reader of a bus needs of it."""

from __future__ import annotations

import logging
from contextlib import suppress
from typing import Any, Protocol

import can

from drivers.api import EXTENDED_IDENTIFIER
from drivers.errors import LinkError
from drivers.transport.can_address import SET_BITRATE, BusAddress
from drivers.transport.can_frames import ERROR, EXTENDED_MASK, REMOTE, Frame

SEND_TIMEOUT = 1.0  # s
_BATCH = 512  # frames a read at most
_NO_DRIVER = (ImportError, NotImplementedError, AttributeError, NameError)  # what the makers' missing libraries lead to

# Its warnings are about what here becomes an exception or a count; without a handler they would go to the terminal.
logging.getLogger("can").addHandler(logging.NullHandler())


class Port(Protocol):
    """An open adapter. Any call may raise OSError, ValueError or LinkError: it is gone."""

    n_malformed: int

    def read(self, timeout: float) -> list[Frame]:
        """Return what has come, waiting up to `timeout` s for the first frame."""

    def send(self, identifier: int, data: bytes) -> None:
        """Send a data frame. Raises TimeoutError if the bus takes none for a second."""

    def close(self) -> None:
        """Release the adapter."""


class PythonCanPort:
    """Any adapter that python-can knows."""

    def __init__(self, address: BusAddress) -> None:
        self.n_malformed = 0
        channel: str | int = int(address.channel) if address.channel.isdecimal() else address.channel
        options: dict[str, Any] = {"bitrate": address.bitrate} if address.interface in SET_BITRATE else {}
        try:
            self._bus = can.Bus(channel, interface=address.interface, **options)
        except (can.CanError, OSError, ValueError, *_NO_DRIVER) as error:
            raise LinkError(f"cannot open {address}: {_why(error)}") from error

    def read(self, timeout: float) -> list[Frame]:
        """Return what has come."""
        frames: list[Frame] = []
        try:
            message = self._bus.recv(timeout)
            while message is not None:
                if not message.is_fd:
                    frames.append((_identifier(message), bytes(message.data)))
                if len(frames) >= _BATCH:
                    break
                message = self._bus.recv(0)
        except can.CanError as error:
            raise OSError(str(error)) from error
        return frames

    def send(self, identifier: int, data: bytes) -> None:
        """Send a data frame."""
        message = can.Message(
            arbitration_id=identifier & EXTENDED_MASK,
            is_extended_id=bool(identifier & EXTENDED_IDENTIFIER),
            data=data,
        )
        try:
            self._bus.send(message, SEND_TIMEOUT)
        except can.CanTimeoutError as error:
            raise TimeoutError(str(error)) from error
        except can.CanError as error:
            if "buffer" in str(error).lower() or "timed out" in str(error).lower():  # the kernel's queue, pcan's queue
                raise TimeoutError(str(error)) from error
            raise OSError(str(error)) from error

    def close(self) -> None:
        """Release the adapter."""
        with suppress(can.CanError, OSError, ValueError):
            self._bus.shutdown()


def _identifier(message: can.Message) -> int:
    """Return a message's identifier with its flags."""
    identifier = message.arbitration_id
    if message.is_error_frame:
        return identifier | ERROR
    if message.is_extended_id:
        identifier |= EXTENDED_IDENTIFIER
    return identifier | REMOTE if message.is_remote_frame else identifier


def _why(error: BaseException) -> str:
    """Return in plain words why a bus cannot be opened."""
    text = " ".join(str(error).split()) or type(error).__name__
    if getattr(error, "errno", None) == 19 or "No such device" in text:
        return f"there is no such channel ({text})"
    if isinstance(error, _NO_DRIVER):
        return f"its driver is not installed on this machine ({text})"
    return text
