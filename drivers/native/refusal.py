"""What an ERROR reply means, as an exception that says what to do."""

from __future__ import annotations

from construct import Container

from drivers.errors import DeviceFaultError, ProtocolError
from drivers.protocol.layout import numpy_dtype
from drivers.protocol.native import LAYOUTS, ErrorCode, Fault, MessageType

_MEANINGS = {
    ErrorCode.UNKNOWN_REQUEST: "this kind of device has no such request",
    ErrorCode.BAD_LENGTH: "its length is not what the device expects",
    ErrorCode.NO_SESSION: "the device was reset, or another program has greeted it; connect again",
    ErrorCode.NOT_HOMED: "the stage must be homed first",
    ErrorCode.MOVING: "the stage must be at rest first",
    ErrorCode.CABLE_WRAP: "the azimuth would wind the cable too far",
    ErrorCode.STREAMING: "the sample stream must be stopped first",
    ErrorCode.NOT_READY: "a self-test is running",
}
_PROTOCOL_CODES = {ErrorCode.UNKNOWN_REQUEST, ErrorCode.BAD_LENGTH, ErrorCode.NO_SESSION}


def refusal(name: str, request: MessageType, reply: Container) -> DeviceFaultError | ProtocolError:
    """Return the exception for an ERROR reply.

    Parameters
    ----------
    name
        The device, for the message.
    request
        What was asked.
    reply
        The ERROR message.

    Returns
    -------
    DeviceFaultError or ProtocolError
        ProtocolError where host and device do not understand each other, DeviceFaultError where the device's state
        or limits forbid the request.
    """
    try:
        code = ErrorCode(reply.code)
    except ValueError:
        return ProtocolError(f"{name} refused {request.name} with the unknown code {reply.code}")
    text = f"{name} refused {request.name}: {code.name}, {_meaning(code, request, reply.detail)}"
    return ProtocolError(text) if code in _PROTOCOL_CODES else DeviceFaultError(text)


def fault_name(fault: int) -> str:
    """Return the name of a latched fault, empty for 0."""
    if not fault:
        return ""
    return Fault(fault).name if fault in set(Fault) else f"fault {fault}"


def _meaning(code: ErrorCode, request: MessageType, detail: int) -> str:
    if code is ErrorCode.FAULT_LATCHED:
        return f"the fault {fault_name(detail)} must be cleared first"
    if code is ErrorCode.SOFT_LIMIT:
        return f"the {'elevation' if detail else 'azimuth'} lies outside the device's limits"
    if code is ErrorCode.OUT_OF_RANGE:
        return f"the device does not support this {_field_at(request, detail)}"
    return _MEANINGS[code]


def _field_at(request: MessageType, offset: int) -> str:
    """Return the name of the field of a request that begins at `offset`."""
    dtype = numpy_dtype(LAYOUTS[request])
    names = {field[1]: name for name, field in (dtype.fields or {}).items()}
    return names.get(offset, f"value at offset {offset}")
