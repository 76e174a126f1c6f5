"""The host's real time."""

from __future__ import annotations

import math
import threading
import time
from contextlib import suppress


class SystemClock:
    """Monotonic time, and a wait that any thread can end: the `Clock` of everything real."""

    def __init__(self) -> None:
        self._no_news = threading.Lock()  # held while there is none: a third of an Event's cost a wait
        self._no_news.acquire()
        self._alarm = math.inf

    def now(self) -> float:
        """Return the present instant in seconds."""
        return time.monotonic()

    def sleep_until(self, instant: float) -> None:
        """Return once `instant` has come."""
        while (duration := instant - self.now()) > 0:
            time.sleep(duration)

    def wait(self, deadline: float) -> None:
        """Return at `deadline` or the `alarm`, or as soon as a link has called `notify` since the last wait."""
        deadline, self._alarm = min(deadline, self._alarm), math.inf
        self._no_news.acquire(timeout=min(max(0.0, deadline - self.now()), threading.TIMEOUT_MAX))

    def alarm(self, instant: float) -> None:
        """End the next `wait` at `instant` at the latest."""
        self._alarm = min(self._alarm, instant)

    def notify(self) -> None:
        """End the present `wait`, or else the next one."""
        with suppress(RuntimeError):  # there is news already
            self._no_news.release()
