"""The host's real time."""

from __future__ import annotations

import threading
import time


class SystemClock:
    """Monotonic time, and a wait that any thread can end: the `Clock` of everything real."""

    def __init__(self) -> None:
        self._news = threading.Event()

    def now(self) -> float:
        """Return the present instant in seconds."""
        return time.monotonic()

    def sleep_until(self, instant: float) -> None:
        """Return once `instant` has come."""
        while (duration := instant - self.now()) > 0:
            time.sleep(duration)

    def wait(self, deadline: float) -> None:
        """Return at `deadline`, or as soon as a link has called `notify` since the last wait."""
        self._news.wait(max(0.0, deadline - self.now()))
        self._news.clear()

    def notify(self) -> None:
        """End the present `wait`, or else the next one."""
        self._news.set()
