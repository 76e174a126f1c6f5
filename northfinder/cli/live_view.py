"""The picture of a running measurement on a terminal: plan, time to go, rate, azimuth, health."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence

from rich.box import ROUNDED
from rich.console import RenderableType
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from northfinder.angles import decimals_for, direction_text
from northfinder.estimation import Fix
from northfinder.sequencer import Progress, State
from northfinder.text import printable
from northfinder.units import DPH

_BARS = "▁▂▃▄▅▆▇█"
#: Means of a batch of samples in the sparkline, and intervals in the trail.
_N_RATES, _N_INTERVALS = 48, 6
#: Columns of what stands beside the names, and of all that surrounds it. Two more are left free, for the ^C that a
#: terminal adds to the last line: on a line of its own it would leave a remnant of the picture behind.
_WIDEST, _NARROWEST, _FRAME = 66, 15, 13 + 2
#: Lines of the plan that are shown at once.
_PLAN_LINES = 4
#: Characters to either side of the azimuth in its interval.
_HALF_WIDTH = 14
#: Host time over which samples are counted, s.
_COUNTED = 2.0
#: A stage says where it is many times a second; longer silence than this is worth a colour, s.
_SILENCE = 0.5
#: What is handed to the record is written each 100 ms; longer than this is worth a colour, s.
_SLOW_DISK = 1.0
_IN_STEPS = {State.SLEW, State.SETTLE, State.DWELL}


class LiveView:
    """Takes note of each progress, which costs next to nothing, and draws the last one when asked."""

    def __init__(self, step_names: Callable[[], Sequence[str]], time: float | None = None) -> None:
        """`step_names` tells the plan's steps as far as they are known now, `time` how long it may take, s."""
        self._step_names = step_names
        self._time = time
        self._begin()

    def _begin(self) -> None:
        """Begin with nothing noted."""
        self._rates: deque[float] = deque(maxlen=_N_RATES)
        self._intervals: deque[float] = deque(maxlen=_N_INTERVALS)
        self._counts: deque[tuple[float, int]] = deque()
        self._fix: Fix | None = None
        self._begun: float | None = None  # of the first slew, by the stage's clock
        self._dwelt = 0.0  # s, of finished dwells
        self._n_done = 0
        self._taken: dict[int, str] = {}  # names of the steps as they were taken

    def note(self, progress: Progress, fix: Fix | None, now: float) -> None:
        """Take note of where the measurement stands at host time `now`."""
        if progress.n_done < self._n_done:  # another measurement
            self._begin()
        if progress.state is State.DWELL and progress.rate is not None:
            self._rates.append(progress.rate / DPH)
        if fix is not None and fix is not self._fix:
            self._fix = fix
            self._intervals.append(math.degrees(fix.coverage_factor() * fix.azimuth_sd))
        if self._begun is None and progress.state in _IN_STEPS and progress.stage is not None:
            self._begun = progress.stage.device_time
        if progress.n_done > self._n_done and progress.step is not None:
            self._dwelt += progress.step.dwell
        self._n_done = progress.n_done
        if progress.step is not None and progress.state in _IN_STEPS:
            self._taken[progress.n_done] = progress.step.name
        if not self._counts or now - self._counts[-1][0] >= _COUNTED / 8.0:
            self._counts.append((now, progress.n_samples))
            while now - self._counts[0][0] > _COUNTED and len(self._counts) > 2:
                self._counts.popleft()

    def to_go(self, progress: Progress) -> float:
        """Return the time to the end, s.

        What is left of the plan's time; without one the dwells to come, and as much turning a step as there was so far.
        """
        if self._begun is not None and progress.stage is not None and self._time is not None:
            return max(0.0, self._time - (progress.stage.device_time - self._begun))
        to_come = max(0, progress.n_steps - progress.n_done - (progress.state is State.DWELL))
        n_turned = progress.n_done + (progress.state is State.DWELL)
        if self._begun is None or progress.stage is None or not n_turned:
            return progress.remaining
        in_dwell = progress.step_fraction * progress.step.dwell if progress.step else 0.0
        turning = progress.stage.device_time - self._begun - self._dwelt - in_dwell
        return progress.remaining + to_come * max(0.0, turning) / n_turned

    def picture(self, progress: Progress, now: float, width: int = 80) -> RenderableType:
        """Return the picture of `progress` at host time `now`, on a terminal of `width` columns."""
        width = max(_NARROWEST, min(_WIDEST, width - _FRAME))
        table = Table.grid(padding=(0, 2))
        table.add_column(style="dim", no_wrap=True)
        table.add_column(overflow="fold", width=width)
        # A plan may take its steps in mirrored order: those taken are named as they were.
        names = [self._taken.get(number, name) for number, name in enumerate(self._step_names())]
        if names:
            table.add_row("plan", _plan(names, progress, width))
        table.add_row("now", _now(progress))
        if progress.state is State.DWELL:
            table.add_row("", ProgressBar(total=1.0, completed=progress.step_fraction, width=40))
        if progress.n_steps:
            table.add_row("to go", Text(f"about {countdown(self.to_go(progress))} to the end", style="bold"))
        if self._rates:
            said = f"{self._rates[-1]:+9.2f} deg/h  "
            table.add_row("rate", said + sparkline(list(self._rates)[-max(1, width - len(said)) :]))
        table.add_row("azimuth", self._azimuth(width))
        if progress.stage is not None:
            angles = (math.degrees(angle) for angle in (progress.stage.azimuth, progress.stage.elevation))
            table.add_row("stage", "azimuth {:.3f}, elevation {:.3f} deg, ".format(*angles) + progress.stage.mode.value)
        table.add_row("links", self._links(progress, now))
        table.add_row("record", _record(progress))
        return Panel(table, title="north-finder", box=ROUNDED, expand=False)

    def _azimuth(self, width: int) -> Text:
        if self._fix is None:
            return Text("not yet known", style="dim")
        half = self._intervals[-1]
        text = Text(azimuth_text(self._fix), style="bold")
        text.append(" (95 %)", style="cyan not bold")
        drawn = "  " + interval(half, max(self._intervals))
        if len(text) + len(drawn) <= width:
            text.append(drawn, style="cyan not bold")
        if len(self._intervals) > 1:
            trail = " › ".join(f"{each:.2g}" for each in self._intervals)
            text.append(f"\n± {trail}", style="dim not bold")
        return text

    def _links(self, progress: Progress, now: float) -> Text:
        (began, first), (ended, last) = self._counts[0], self._counts[-1]
        span = ended - began
        rate = f"{(last - first) / span:,.0f} samples/s" if span > 0.0 and last > first else "no samples now"
        lost = Text(f", {progress.n_lost:,} lost", style="red") if progress.n_lost else Text(", none lost")
        text = Text(f"gyro {rate}") + lost
        if progress.stage is not None:
            silence = max(0.0, now - progress.stage.arrival_time)
            text.append(f"; stage heard {silence:.1f} s ago", style="red" if silence > _SILENCE else "")
        return text


def _plan(names: Sequence[str], progress: Progress, width: int) -> Text:
    """Return the steps done, current and coming; of a long plan the lines about the current one."""
    lines, at = [Text()], 0
    for number, name in enumerate(names):
        done, current = number < progress.n_done, number == progress.n_done and progress.state in _IN_STEPS
        mark, style = ("✓", "green") if done else ("▶", "bold") if current else ("·", "dim")
        step = Text(f"{mark} {printable(name, max_length=20)}", style=style)
        if lines[-1] and lines[-1].cell_len + len("  ") + step.cell_len > width:
            lines.append(Text())
        lines[-1].append_text(Text("  " if lines[-1] else "") + step)
        at = len(lines) - 1 if number <= progress.n_done else at
    first = max(0, min(at - 1, len(lines) - _PLAN_LINES))
    return Text("\n").join(lines[first : first + _PLAN_LINES])


def _now(progress: Progress) -> str:
    step = progress.step
    if step is None or progress.state not in _IN_STEPS:
        return progress.state.value
    number = min(progress.n_done + 1, progress.n_steps)
    return f"{progress.state.value}, step {number} of {progress.n_steps}: {printable(step.name)}"


def _record(progress: Progress) -> Text:
    late = progress.record_delay > _SLOW_DISK
    health = f"the disk is {progress.record_delay:.0f} s behind" if late else "the disk keeps up"
    return Text(f"{progress.n_samples:,} samples, ") + Text(health, style="red" if late else "")


def sparkline(values: Sequence[float] | deque[float]) -> str:
    """Return values as bars of eight heights, from the least to the greatest.

    >>> sparkline([0.0, 1.0, 2.0, 7.0])
    '▁▂▃█'
    """
    low, high = min(values), max(values)
    step = (high - low) / (len(_BARS) - 1) or 1.0
    return "".join(_BARS[round((value - low) / step)] for value in values)


def interval(half: float, widest: float) -> str:
    """Return an interval around its middle, drawn to the scale of the widest one.

    >>> interval(1.0, 2.0)
    '       ├──────●──────┤       '
    """
    n = min(_HALF_WIDTH, round(_HALF_WIDTH * half / widest)) if widest > 0.0 else 0
    arm = "─" * (n - 1)
    return (f"├{arm}●{arm}┤" if n else "●").center(2 * _HALF_WIDTH + 1)


def countdown(seconds: float) -> str:
    """Return a span as minutes and seconds.

    >>> countdown(125.2)
    '2:05'
    """
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d}"


def azimuth_text(fix: Fix) -> str:
    """Return the azimuth and half its 95 % interval."""
    half = math.degrees(fix.coverage_factor() * fix.azimuth_sd)
    decimals = decimals_for(half)
    return f"{direction_text(math.degrees(fix.azimuth), decimals)} ± {half:.{decimals}f} deg"
