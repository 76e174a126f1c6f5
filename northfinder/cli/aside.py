"""A display in a thread of its own: a terminal that takes nothing any more, or is gone, must not hold up the bench."""

from __future__ import annotations

import queue
import threading
from contextlib import AbstractContextManager, suppress
from types import TracebackType
from typing import Self

from northfinder.cli import DISPLAY_THREAD
from northfinder.cli.display import Display
from northfinder.estimation import Fix
from northfinder.sequencer import Progress

#: What may wait to be shown; beyond it the newest is left out.
_MAX_WAITING = 2000
#: How long a terminal may take at the end for what is still to be shown, in s.
_PATIENCE = 2.0


class Aside:
    """Hands everything to a `Display` in another thread; never waits, and never fails. Use as a context manager."""

    def __init__(self, display: AbstractContextManager[Display]) -> None:
        """Put `display` up and show on it from now on."""
        self._display = display
        self._waiting: queue.Queue[tuple[Progress, Fix | None] | str | None] = queue.Queue(_MAX_WAITING)
        self._thread = threading.Thread(target=self._run, name=DISPLAY_THREAD, daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        """Return it."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Take the display down once it has shown what is left; one that is stuck ends with the program."""
        self._put(None)
        self._thread.join(_PATIENCE)

    def show(self, progress: Progress, fix: Fix | None) -> None:
        """Show it soon."""
        self._put((progress, fix))

    def say(self, text: str) -> None:
        """Say it soon."""
        self._put(text)

    def _put(self, item: tuple[Progress, Fix | None] | str | None) -> None:
        with suppress(queue.Full):
            self._waiting.put_nowait(item)

    def _run(self) -> None:
        with suppress(OSError, ValueError), self._display as display:  # whoever looked may go: the record has it all
            while (item := self._waiting.get()) is not None:
                if isinstance(item, str):
                    display.say(item)
                else:
                    display.show(*item)
