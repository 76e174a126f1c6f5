"""How a command that writes a file ends when it is told to."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn


@contextmanager
def tidied_up() -> Iterator[None]:
    """Let a termination or a hang-up end the block as Ctrl-C does, so that nothing half written is left behind."""

    def end(number: int, frame: FrameType | None) -> NoReturn:  # noqa: ARG001  # the signal module's signature
        raise KeyboardInterrupt

    signals = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {number: signal.signal(number, end) for number in signals}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
