"""What an operator sees while a measurement runs: a live picture on a terminal, plain lines elsewhere, on stderr."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Protocol

from rich.console import Console
from rich.live import Live

from drivers.api import Clock
from northfinder.cli.live_view import LiveView, azimuth_text, countdown
from northfinder.estimation import Fix
from northfinder.sequencer import Progress, State
from northfinder.text import printable

#: Host time between two pictures, in s.
REFRESH_PERIOD = 0.25


class Display(Protocol):
    """Shows where a measurement stands."""

    def show(self, progress: Progress, fix: Fix | None) -> None:
        """Show it, unless it is too soon for another picture."""

    def say(self, text: str) -> None:
        """Tell the operator something that must be read."""


class LiveDisplay:
    """A picture that is drawn anew in place."""

    def __init__(self, live: Live, clock: Clock, view: LiveView) -> None:
        """Draw `view` on `live`, at most each REFRESH_PERIOD by `clock`."""
        self._live = live
        self._clock = clock
        self._view = view
        self._next = -math.inf

    def show(self, progress: Progress, fix: Fix | None) -> None:
        """Take note of it, and draw it if it is time."""
        now = self._clock.now()
        self._view.note(progress, fix, now)
        if now >= self._next:
            self._next = now + REFRESH_PERIOD
            self._live.update(self._view.picture(progress, now, self._live.console.width), refresh=True)

    def say(self, text: str) -> None:
        """Print it above the picture."""
        self._live.console.print(text, markup=False, highlight=False)


class PlainDisplay:
    """One line for every change of state or step."""

    def __init__(self) -> None:
        """Start with nothing said."""
        self._last: tuple[State, int] | None = None

    def show(self, progress: Progress, fix: Fix | None) -> None:
        """Print a line if the state or the step has changed."""
        if (progress.state, progress.n_done) == self._last or progress.state in {State.SETTLE, State.SLEW}:
            return
        self._last = (progress.state, progress.n_done)
        line = progress.state.value
        if progress.state is State.DWELL and progress.step is not None:
            line = (
                f"dwell {progress.n_done + 1} at {printable(progress.step.name)}, {countdown(progress.remaining)} to go"
            )
            line += "" if fix is None else f", azimuth {azimuth_text(fix)} (95 %)"
        print(line, file=sys.stderr, flush=True)  # noqa: T201  # what it is for

    def say(self, text: str) -> None:
        """Print it."""
        print(text, file=sys.stderr, flush=True)  # noqa: T201  # what it is for


class SilentDisplay:
    """Shows nothing but what must be read."""

    def show(self, progress: Progress, fix: Fix | None) -> None:
        """Show nothing."""

    def say(self, text: str) -> None:
        """Print it."""
        print(text, file=sys.stderr, flush=True)  # noqa: T201  # what it is for


def _live(console: Console) -> Live:
    """Return a live view that leaves the program's own streams alone: it may get stuck, and they must not."""
    return Live(console=console, auto_refresh=False, transient=True, redirect_stdout=False, redirect_stderr=False)


class DisplayContext(AbstractContextManager[Display]):
    """Chooses the display for this terminal, and takes it down at the end."""

    def __init__(
        self,
        clock: Clock,
        *,
        quiet: bool,
        step_names: Callable[[], Sequence[str]] = tuple,
        time: float | None = None,
        console: Console | None = None,
    ) -> None:
        """Prepare, draw nothing yet.

        `step_names` tells the plan's steps, `time` how long it may take, s; `console` is standard error by default.
        """
        console = console or Console(stderr=True)
        # A dumb terminal cannot draw in place: it would show nothing at all.
        live = console.is_terminal and not console.is_dumb_terminal and not quiet
        self._live = _live(console) if live else None
        self._context: AbstractContextManager[object] = self._live or nullcontext()
        self._display: Display = SilentDisplay() if quiet else PlainDisplay()
        if self._live is not None:
            self._display = LiveDisplay(self._live, clock, LiveView(step_names, time))

    def __enter__(self) -> Display:
        """Put the display up."""
        self._context.__enter__()
        return self._display

    def __exit__(self, *failure: object) -> None:
        """Take the display down."""
        self._context.__exit__(*failure)  # type: ignore[arg-type]  # handed through unread
