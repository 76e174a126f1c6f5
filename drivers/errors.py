"""What can go wrong between the host and a device.

Every exception a driver or a transport raises on purpose is a `DeviceError`:

    DeviceError
     +-- LinkError            the port cannot be opened, was unplugged, or is closed
     +-- DeviceTimeoutError   nothing, or not the answer, came before the deadline (also a TimeoutError)
     +-- ProtocolError        bytes came that this protocol does not allow: wrong device, wrong version, refused request
     +-- DeviceFaultError     the device itself reports a fault, or refuses because of one

A caller's mistake is a ValueError or a TypeError. Exceptions of third-party libraries stop at ``drivers.transport``,
those of canopen at ``drivers.canopen``.
A message says what was asked, what came, and what to do next.
"""

from __future__ import annotations


class DeviceError(Exception):
    """A device, its link or its protocol failed."""


class LinkError(DeviceError):
    """The link itself: cannot open, unplugged, closed."""


class DeviceTimeoutError(DeviceError, TimeoutError):
    """The device stayed silent past the deadline."""


class ProtocolError(DeviceError):
    """What came is not what the protocol allows."""


class DeviceFaultError(DeviceError):
    """The device reports a fault."""
