"""Asking the operator at the terminal to do something by hand, while the measurement goes on."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from typing import TextIO

from drivers.api import Clock
from northfinder.errors import ConfigError


class TerminalOperator:
    """Whoever sits at the terminal: Enter says that it is done."""

    def __init__(self, clock: Clock, say: Callable[[str], None], answers: TextIO | None = None) -> None:
        """Take requests to `say`, and lines of `answers`, by default standard input, which must then be a terminal.

        Raises ConfigError if there is no terminal to ask at.
        """
        if answers is None and not sys.stdin.isatty():
            raise ConfigError(
                "the plan two-position without a stage asks the operator to turn the gyro, and there is no terminal "
                "to ask at: give --stage, or run it in a terminal"
            )
        self._clock = clock
        self._say = say
        self._answers = answers or sys.stdin
        self._answered = threading.Event()

    def ask(self, request: str) -> None:
        """Show the request and wait for Enter in a thread of its own."""
        self._answered.clear()
        self._say(f"{request}; then press Enter")
        threading.Thread(target=self._listen, name="operator", daemon=True).start()

    def has_answered(self) -> bool:
        """Return whether Enter was pressed since the request."""
        return self._answered.is_set()

    def _listen(self) -> None:
        if self._answers.readline():
            self._answered.set()
            self._clock.notify()
