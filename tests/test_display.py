"""What an operator sees while a measurement runs: the live picture, plain lines, nothing."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from virtual import assume, virtual_bench

from drivers.api import StageMode, StageState
from drivers.transport.virtual import VirtualClock
from northfinder.adaptive import Wishes, make_plan
from northfinder.cli.display import REFRESH_PERIOD, DisplayContext
from northfinder.cli.live_view import LiveView
from northfinder.cli.show import print_result
from northfinder.cyclogram import Step
from northfinder.estimation import Fix
from northfinder.measurement import Measurement, measure
from northfinder.sequencer import Progress, State
from northfinder.units import DPH

NAMES = ("U1", "U2", "east", "west")


def stage(now: float, *, heard: float = 0.0) -> StageState:
    """Return a state of a stage at rest."""
    return StageState(device_time=now, arrival_time=heard, mode=StageMode.IDLE, azimuth=0.5, elevation=0.0)


def dwell(n_done: int, fraction: float, *, now: float = 0.0, name: str | None = None, **more: object) -> Progress:
    """Return a progress in a dwell of 20 s of four."""
    step = Step(name=name or NAMES[n_done], azimuth=0.0, elevation=0.0, dwell=20.0)
    given: dict[str, Any] = {"rate": 38.0 * DPH, "n_samples": 1000, "stage": stage(now)} | more
    return Progress(
        state=State.DWELL, n_done=n_done, n_steps=4, step=step, step_fraction=fraction,
        remaining=20.0 * (4 - n_done - fraction), **given,
    )  # fmt: skip


def drawn(view: LiveView, progress: Progress, now: float = 0.0, width: int = 100) -> str:
    """Return the picture as text."""
    console = Console(file=io.StringIO(), width=width, force_terminal=False)
    console.print(view.picture(progress, now, width))
    text = console.file.getvalue()  # type: ignore[attr-defined]  # it is the StringIO from above
    return str(text)


def test_the_plan_shows_done_current_and_coming_steps() -> None:
    """Each step once, with a mark of its own."""
    view, progress = LiveView(lambda: NAMES), dwell(2, 0.25)
    view.note(progress, None, 0.0)
    text = drawn(view, progress)
    assert "✓ U1  ✓ U2  ▶ east  · west" in text
    assert "dwell, step 3 of 4: east" in text


def test_a_mirrored_step_is_named_as_it_was_taken() -> None:
    """A symmetrical plan may go west first: the picture says what was done, not what was planned."""
    view = LiveView(lambda: NAMES)
    view.note(dwell(2, 0.5, name="west"), None, 0.0)
    progress = dwell(3, 0.5, name="east")
    view.note(progress, None, 1.0)
    assert "✓ west  ▶ east" in drawn(view, progress)


def test_the_countdown_holds_the_turns_to_come() -> None:
    """Dwells of 20 s with turns of 10 s between: what is left is both, by the stage's own clock."""
    view = LiveView(lambda: NAMES)
    slew = Progress(state=State.SLEW, n_steps=4, remaining=80.0, stage=stage(100.0))
    view.note(slew, None, 0.0)
    assert view.to_go(slew) == 80.0  # how long a turn takes is not known yet
    progress = dwell(0, 0.5, now=120.0)
    view.note(progress, None, 1.0)
    assert view.to_go(progress) == pytest.approx(70.0 + 3 * 10.0)
    for n_done in (1, 2):
        progress = dwell(n_done, 0.0, now=110.0 + 30.0 * n_done)
        view.note(progress, None, 2.0)
    assert view.to_go(progress) == pytest.approx(40.0 + 10.0)
    assert "about 0:50 to the end" in drawn(view, progress)


def test_the_rate_is_that_of_dwells_alone() -> None:
    """What a gyro says while the stage turns would hide what it says at rest."""
    view = LiveView(lambda: NAMES)
    for rate in (30.0, 31.0, 32.0):
        view.note(dwell(0, 0.5, rate=rate * DPH), None, 0.0)
    turning = Progress(state=State.SLEW, n_done=1, n_steps=4, rate=30_000.0 * DPH, stage=stage(0.0))
    view.note(turning, None, 0.0)
    assert "+32.00 deg/h  ▁▅█" in drawn(view, turning)


def test_what_is_wrong_is_said() -> None:
    """Lost samples, a silent stage, a disk that does not follow."""
    view = LiveView(lambda: NAMES)
    for now, n_samples in ((0.0, 0), (1.0, 235), (2.0, 470)):
        progress = dwell(0, 0.5, n_samples=n_samples, n_lost=7, record_delay=3.2, stage=stage(0.0, heard=1.2))
        view.note(progress, None, now)
    text = drawn(view, progress, 2.0)
    assert "gyro 235 samples/s, 7 lost; stage heard 0.8 s ago" in text
    assert "470 samples, the disk is 3 s behind" in text


def test_names_of_steps_are_printable() -> None:
    """A plan's file cannot reach the terminal."""
    view = LiveView(lambda: ("\x1b[2J\u202eU1",))
    progress = dwell(0, 0.5, name="\x1b]52;c;AAAA\x07")
    view.note(progress, None, 0.0)
    assert not set(drawn(view, progress)) & {"\x1b", "\u202e", "\x07"}


@pytest.mark.parametrize("width", [40, 60, 80, 120])
def test_nothing_is_cut_on_any_terminal(width: int) -> None:
    """Every step and every word is there, no line is broken between a step and its mark, and ^C fits beside it."""
    names = ("U1", "U2", "U3", "west", "east", "west", "up", "down", "north", "south")
    view, progress = LiveView(lambda: names), dwell(2, 0.5, name="U3", n_samples=123_456, stage=stage(0.0))
    view.note(progress, None, 0.0)
    lines = drawn(view, progress, width=width).splitlines()
    assert all(len(line) <= width - len("^C") for line in lines)
    rows = [line.strip("│╭╮╰╯─ ") for line in lines]
    text = " ".join(" ".join(rows).split())
    assert "✓ U1 ✓ U2 ▶ U3 · west · east · west · up · down · north · south" in text
    assert not any(row.endswith("·") for row in rows)
    for whole in ("stage heard 0.0 s ago", "elevation 0.000 deg, idle", "123,456 samples, the disk keeps up"):
        assert whole in text


def test_a_long_plan_shows_what_is_about_the_present() -> None:
    """A hundred steps are not a hundred lines, and the current one is among those shown."""
    names = [f"s{number}" for number in range(100)]
    view = LiveView(lambda: names)
    for at in (0, 50, 99):
        progress = dwell(at, 0.5, name=names[at])
        view.note(progress, None, 0.0)
        text = drawn(view, progress, width=60)
        assert f"▶ s{at}" in text
        assert len(text.splitlines()) <= 16


#: How much slower time passes for the screen than on the bench: fewer pictures show the same.
SLOWED = 8.0


class SlowClock(VirtualClock):
    """The bench's time, slowed."""

    def __init__(self, clock: VirtualClock) -> None:
        """Follow `clock`."""
        self._clock = clock

    def now(self) -> float:
        """Return the present instant."""
        return self._clock.now() / SLOWED


class Screen:
    """A whole measurement on the emulated bench, watched on a console."""

    def __init__(self, folder: Path, *, terminal: bool, quiet: bool = False) -> None:
        """Measure, and keep what was shown."""
        clock = VirtualClock()
        self.file = io.StringIO()
        console = Console(file=self.file, width=100, height=40, force_terminal=terminal, color_system=None)
        plan = make_plan(Wishes(name="refined", time=120.0), assume(latitude_deg=50.429), settle=0.5)
        bench = virtual_bench()
        context = DisplayContext(
            SlowClock(bench.clock), quiet=quiet, step_names=plan.step_names, time=plan.time, console=console
        )
        with context as display:
            self.outcome = measure(
                Measurement(
                    open_gyro=bench.open_gyro, open_stage=bench.open_stage, plan=plan, settle=0.5,
                    assumptions=assume(latitude_deg=50.429), record=folder / "north.sqlite",
                ),
                clock=bench.clock, utc=clock.now, watcher=display,
            )  # fmt: skip

    @property
    def pictures(self) -> list[str]:
        """All pictures drawn, without the codes that place them."""
        return [re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", part) for part in self.file.getvalue().split("╭")[1:]]


def test_a_measurement_on_a_terminal(tmp_path: Path) -> None:
    """The steps are ticked off one by one, the time to go falls, and the interval narrows to that of the fix."""
    screen = Screen(tmp_path, terminal=True)
    ticked = [picture.count("✓") for picture in screen.pictures]
    assert ticked == sorted(ticked)
    assert set(ticked) == set(range(max(ticked) + 1))
    assert max(ticked) >= 4
    to_go = [int(m) * 60 + int(s) for each in screen.pictures for m, s in re.findall(r"about (\d+):(\d\d)", each)]
    assert 100 < to_go[0] <= 120
    assert to_go[-1] < 5
    assert to_go == sorted(to_go, reverse=True)
    halves = [float(half) for each in screen.pictures for half in re.findall(r"± (\S+) deg \(95 %\)", each)]
    assert halves[-1] < 0.7 * halves[0]
    assert len(screen.pictures) < 5 + 130.0 / SLOWED / REFRESH_PERIOD


def test_a_measurement_without_a_terminal(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Plain lines on standard error: no code that places or colours anything."""
    screen = Screen(tmp_path, terminal=False)
    shown = capsys.readouterr()
    assert not shown.out
    assert "\x1b" not in shown.err + screen.file.getvalue()
    lines = shown.err.splitlines()
    assert lines[0] == "connect"
    assert sum(line.startswith("dwell ") for line in lines) >= 5
    assert re.search(r"azimuth \d+\.\d+ ± \d+\.\d+ deg \(95 %\)", lines[-2])


def test_a_terminal_that_cannot_place_its_cursor_gets_lines(capsys: pytest.CaptureFixture[str]) -> None:
    """TERM=dumb: a picture would never be drawn, so the lines are."""
    console = Console(file=io.StringIO(), force_terminal=True, _environ={"TERM": "dumb"})
    with DisplayContext(VirtualClock(), quiet=False, console=console) as display:
        display.show(Progress(state=State.CONNECT), None)
    assert capsys.readouterr().err == "connect\n"


def test_a_quiet_measurement(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Nothing at all."""
    screen = Screen(tmp_path, terminal=True, quiet=True)
    assert not screen.file.getvalue()
    assert not capsys.readouterr().err
    assert screen.outcome.fix.azimuth_sd > 0.0


def test_a_view_of_several_measurements_begins_anew(tmp_path: Path) -> None:
    """What was known of the last measurement is not shown of the next."""
    view = LiveView(lambda: NAMES)
    view.note(dwell(3, 0.5), _some_fix(tmp_path), 0.0)
    assert "(95 %)" in drawn(view, dwell(3, 0.5))
    begin = Progress(state=State.CONNECT)
    view.note(begin, None, 1.0)
    assert "not yet known" in drawn(view, begin, 1.0)


def _some_fix(folder: Path) -> Fix:
    return Screen(folder, terminal=True, quiet=True).outcome.fix


RESULT: dict[str, Any] = {
    "azimuth_deg": 359.99996, "azimuth_sd_deg": 0.107, "latitude_deg": -0.0001, "latitude_sd_deg": 0.116,
    "bias_dph": [-0.0001, 38.2], "scale_factor": None, "n_rejected": 0, "rescaled_by": 1.0,
    "checks": [
        {"passed": True, "decisive": True, "sentence": "the first holds"},
        {"passed": False, "decisive": False, "sentence": "the second does not"},
        {"passed": False, "decisive": True, "sentence": "the third does not"},
    ],
    "notes": ["note [/bold] of \x1b a file"], "record": "records [red]/a[/red].sqlite",
}  # fmt: skip


def test_a_result_is_said_as_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    """Brackets in a path are no markup, directions end below 360, nothing is minus zero, each ± is explained."""
    print_result(RESULT)
    text = " ".join(capsys.readouterr().out.split())
    assert "records [red]/a[/red].sqlite" in text
    assert "note [/bold] of ? a file" in text
    assert "azimuth 0.000 ± 0.107 deg" in text
    assert "latitude 0.000 ± 0.116 deg" in text
    assert "bias 0.000, 38.200 deg/h" in text
    assert "each ± is one standard deviation" in text


def test_a_warning_is_no_failure(capsys: pytest.CaptureFixture[str]) -> None:
    """Only a decisive check fails, in the words of the report."""
    print_result(RESULT)
    text = capsys.readouterr().out
    for verdict, sentence in (("pass", "first holds"), ("warning", "second does not"), ("FAIL", "third does not")):
        assert re.search(rf"│ {verdict} +the {sentence}", text)
