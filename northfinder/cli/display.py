"""What an operator sees while a measurement runs: a live table on a terminal, plain lines elsewhere, on stderr."""

from __future__ import annotations

import math
import sys
from contextlib import AbstractContextManager, nullcontext
from typing import Protocol

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table

from drivers.api import Clock
from northfinder.estimation import Fix
from northfinder.sequencer import Progress, State
from northfinder.units import DPH

#: Host time between two pictures, in s.
REFRESH_PERIOD = 0.1


class Display(Protocol):
    """Shows where a measurement stands."""

    def show(self, progress: Progress, fix: Fix | None) -> None:
        """Show it, unless it is too soon for another picture."""

    def say(self, text: str) -> None:
        """Tell the operator something that must be read."""


class LiveDisplay:
    """A table that is drawn anew in place."""

    def __init__(self, live: Live, clock: Clock) -> None:
        """Draw on `live`, at most each REFRESH_PERIOD by `clock`."""
        self._live = live
        self._clock = clock
        self._next = -math.inf

    def show(self, progress: Progress, fix: Fix | None) -> None:
        """Draw the table."""
        now = self._clock.now()
        if now < self._next:
            return
        self._next = now + REFRESH_PERIOD
        self._live.update(self._table(progress, fix), refresh=True)

    def say(self, text: str) -> None:
        """Print it above the table."""
        self._live.console.print(text)

    def _table(self, progress: Progress, fix: Fix | None) -> Table:
        table = Table.grid(padding=(0, 2))
        step = progress.step
        number = min(progress.n_done + 1, progress.n_steps)
        name = "" if step is None else f"{step.name}, step {number} of {progress.n_steps}"
        table.add_row("state", f"{progress.state.value} {name}")
        if progress.state is State.DWELL and step is not None:
            table.add_row("dwell", ProgressBar(total=1.0, completed=progress.step_fraction, width=40))
        table.add_row("to go", f"{countdown(progress.remaining)} of dwell")
        if progress.rate is not None:
            table.add_row("rate", f"{progress.rate / DPH:+.2f} deg/h")
        if progress.stage is not None:
            table.add_row(
                "stage",
                f"azimuth {math.degrees(progress.stage.azimuth):.3f}, "
                f"elevation {math.degrees(progress.stage.elevation):.3f} deg",
            )
        table.add_row("samples", f"{progress.n_samples}, {progress.n_lost} lost")
        table.add_row("azimuth", "not yet known" if fix is None else azimuth_text(fix))
        return table


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
            line = f"dwell {progress.n_done + 1} at {progress.step.name}, {countdown(progress.remaining)} to go"
            line += "" if fix is None else f", azimuth {azimuth_text(fix)}"
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


class DisplayContext(AbstractContextManager[Display]):
    """Chooses the display for this terminal, and takes it down at the end."""

    def __init__(self, clock: Clock, *, quiet: bool) -> None:
        """Prepare; nothing is drawn yet."""
        console = Console(stderr=True)
        live = console.is_terminal and not quiet
        self._live = Live(console=console, auto_refresh=False, transient=True) if live else None
        self._context: AbstractContextManager[object] = self._live or nullcontext()
        self._display: Display = SilentDisplay() if quiet else PlainDisplay()
        if self._live is not None:
            self._display = LiveDisplay(self._live, clock)

    def __enter__(self) -> Display:
        """Put the display up."""
        self._context.__enter__()
        return self._display

    def __exit__(self, *failure: object) -> None:
        """Take the display down."""
        self._context.__exit__(*failure)  # type: ignore[arg-type]  # handed through unread


def azimuth_text(fix: Fix) -> str:
    """Return the azimuth as an operator reads it."""
    return f"{math.degrees(fix.azimuth):.3f} ± {math.degrees(fix.azimuth_sd):.3f} deg"


def countdown(seconds: float) -> str:
    """Return a span as minutes and seconds.

    >>> countdown(125.2)
    '2:05'
    """
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d}"
