"""Who answered a HELLO, and whether it is the right one."""

from __future__ import annotations

from construct import Container

from drivers.api import DeviceIdentity
from drivers.errors import DeviceError, DeviceTimeoutError, ProtocolError
from drivers.protocol.native import DEFINITION_HASH, PROTOCOL_VERSION, DeviceKind, MessageType, build
from drivers.protocol.text import unpadded

KIND_NAMES = {DeviceKind.GYRO: "gyro", DeviceKind.STAGE: "stage"}
_KIND_TITLES = {DeviceKind.GYRO: "a gyro", DeviceKind.STAGE: "a rotation stage"}


def hello(session: int) -> bytes:
    """Return the body of the HELLO that asks for `session`."""
    return build(MessageType.HELLO, protocol_version=PROTOCOL_VERSION, definition_hash=DEFINITION_HASH, session=session)


def identity(answer: Container, port: str, expected: DeviceKind | None) -> DeviceIdentity:
    """Return who sent an IDENTITY.

    Parameters
    ----------
    answer
        The IDENTITY message.
    port
        Name of the link, for messages.
    expected
        What device it shall be, None for any.

    Raises
    ------
    ProtocolError
        If it is another device, speaks another version, or has refused the session.
    """
    try:
        kind = DeviceKind(answer.device_kind)
    except ValueError:
        raise ProtocolError(f"{port} is a device of the unknown kind {answer.device_kind}") from None
    if expected not in {None, kind}:
        raise ProtocolError(f"{port} is {_KIND_TITLES[kind]}, {_KIND_TITLES[expected or kind]} was expected")
    name = f"the {KIND_NAMES[kind]} on {port}"
    if answer.protocol_version != PROTOCOL_VERSION:
        raise ProtocolError(
            f"{name} speaks protocol version {answer.protocol_version}, this driver speaks {PROTOCOL_VERSION}"
        )
    if answer.definition_hash != DEFINITION_HASH:
        raise ProtocolError(
            f"{name} has another definition of protocol version {PROTOCOL_VERSION}: "
            f"{answer.definition_hash:08X}, this driver has {DEFINITION_HASH:08X}"
        )
    if answer.session == 0:
        raise ProtocolError(f"{name} refused to open a session")
    return DeviceIdentity(
        kind=KIND_NAMES[kind],
        model=unpadded(answer.model),
        serial_number=unpadded(answer.serial_number),
        firmware_version=unpadded(answer.firmware_version),
        protocol=f"native {answer.protocol_version}",
        boot_count=answer.boot_count,
    )


def no_answer(port: str, n_bytes: int, n_frames: int) -> DeviceError:
    """Return the exception for a HELLO without an answer, after so many bytes and whole frames."""
    if n_frames:
        return DeviceTimeoutError(f"{port}: {n_frames} frames came but no answer to HELLO: is the line to it cut?")
    if n_bytes:
        return ProtocolError(f"{port}: {n_bytes} bytes came but no valid frame: wrong baud rate or another device?")
    return DeviceTimeoutError(f"nothing answered on {port}: is the device powered, and is this its port?")
