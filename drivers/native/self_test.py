"""The self-test of either native device."""

from __future__ import annotations

from drivers.api import SelfTest
from drivers.native.session import Session
from drivers.protocol.native import MessageType, self_test_failures

_ATTEMPTS = 15  # at the usual interval: 3 s for a test of 2 s


def run_self_test(session: Session) -> SelfTest:
    """Run the self-test and return its failures by name."""
    result = session.request(MessageType.SELF_TEST, reply=MessageType.SELF_TEST_RESULT, attempts=_ATTEMPTS)
    return SelfTest(self_test_failures(result.failures))
