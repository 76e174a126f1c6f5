"""The self-test of either native device."""

from __future__ import annotations

from drivers.api import SelfTest
from drivers.native.session import Session
from drivers.protocol.native import SELF_TEST_NAMES, MessageType

_ATTEMPTS = 15  # at the usual interval: 3 s for a test of 2 s


def run_self_test(session: Session) -> SelfTest:
    """Run the self-test and return its failures by name."""
    result = session.request(MessageType.SELF_TEST, reply=MessageType.SELF_TEST_RESULT, attempts=_ATTEMPTS)
    failures = result.failures
    bits = [bit for bit in range(16) if failures >> bit & 1]
    return SelfTest(tuple(SELF_TEST_NAMES[bit] if bit < len(SELF_TEST_NAMES) else f"bit {bit}" for bit in bits))
