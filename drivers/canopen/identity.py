"""Who a node is, and its self-test: what both devices of ``docs/canopen.md`` have."""

from __future__ import annotations

from drivers.api import Clock, DeviceIdentity, SelfTest
from drivers.canopen.node import SERVICE_PERIOD, Node
from drivers.errors import DeviceTimeoutError, ProtocolError
from drivers.protocol.native import self_test_failures

PROTOCOL = "canopen 1"
_IDENTITY = 0x1018
_BOOT_COUNT, _SERIAL_NUMBER = 0x2002, 0x2003
_TEST, _DONE = 0x2030, 2
_TEST_TIMEOUT = 3.0  # s, for a test of 2 s


def identify(node: Node, kind: str) -> DeviceIdentity:
    """Return who a node is: one that the EDS file describes.

    Raises
    ------
    DeviceTimeoutError
        If the node does not answer.
    ProtocolError
        If it is another device or of another revision, or two nodes answer.
    """
    node.greet()
    objects = node.objects
    for subindex, what in ((1, "vendor"), (2, "product"), (3, "revision")):
        found, expected = objects.read(_IDENTITY, subindex), objects.default(_IDENTITY, subindex)
        shift = 16 if what == "revision" else 0  # the lower half counts changes that change nothing here
        if found >> shift != expected >> shift:
            raise ProtocolError(f"{node.name} is no {kind} of this protocol: its {what} is {found}, not {expected}")
    return DeviceIdentity(
        kind=kind,
        model=objects.read_text(0x1008),
        serial_number=objects.read_text(_SERIAL_NUMBER),
        firmware_version=objects.read_text(0x100A),
        protocol=PROTOCOL,
        boot_count=objects.read(_BOOT_COUNT),
    )


def run_self_test(node: Node, clock: Clock) -> SelfTest:
    """Run a node's self-test and return its failures by name. Raises DeviceTimeoutError if it does not end in 3 s."""
    objects = node.objects
    objects.write(_TEST, 1, 1)
    deadline = clock.now() + _TEST_TIMEOUT
    while objects.read(_TEST, 2) != _DONE:
        if clock.now() >= deadline:
            raise DeviceTimeoutError(f"the self-test of {node.name} has not ended within {_TEST_TIMEOUT:g} s")
        pause = clock.now() + SERVICE_PERIOD
        while clock.now() < pause:
            node.wait(pause)
    return SelfTest(self_test_failures(objects.read(_TEST, 3)))
