"""Who a Zaber device is, by its answers."""

from __future__ import annotations

import re
from dataclasses import dataclass

from drivers.api import DeviceIdentity
from drivers.errors import ProtocolError
from drivers.protocol.zaber import integers
from drivers.zaber.line import Line, Target


@dataclass(frozen=True, slots=True)
class Device:
    """A device that has been asked."""

    identity: DeviceIdentity
    device_id: int
    firmware: tuple[int, int]


def identity_of(*, device_id: str, serial_number: str, version: str) -> DeviceIdentity:
    """Return who has answered so to ``get deviceid``, ``get system.serial`` and ``get version``."""
    return DeviceIdentity(
        kind="stage",
        model=f"Zaber {device_id}".strip(),
        serial_number=serial_number,
        firmware_version=version,
        protocol="Zaber ASCII 2",
    )


def meet(line: Line, number: int) -> Device:
    """Ask a device who it is, and switch its checksums on. Raises as `Line.ask`; DeviceError if it does not say."""
    target = Target(number)
    answers = []
    for setting in ("deviceid", "version", "system.serial"):
        reply = line.ask(target, f"get {setting}")
        if not reply.accepted:
            raise line.refusal(target, f"get {setting}", reply)
        answers.append(reply.data)
    line.ask(target, "set comm.checksum 1")
    device_id, version, serial_number = answers
    found = integers(device_id, 1)
    if found is None:
        raise ProtocolError(f"a device's id is {device_id!r}, expected a number")
    identity = identity_of(device_id=device_id, serial_number=serial_number, version=version)
    return Device(identity, found[0], _firmware(version))


def _firmware(version: str) -> tuple[int, int]:
    """Return a firmware's version as two numbers.

    >>> _firmware("7.35"), _firmware("6.06")
    ((7, 35), (6, 6))
    """
    found = re.match(r"(\d+)\.(\d+)", version, re.ASCII)
    if found is None:
        raise ProtocolError(f"a device's firmware is {version!r}, expected a version such as 7.35")
    return int(found[1]), int(found[2])
