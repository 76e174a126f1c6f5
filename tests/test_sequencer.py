"""The sequence on the emulated bench: what it does and records, and how every failure ends with the stage at rest."""

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from msgspec.structs import replace
from virtual import Noted, VirtualBench, virtual_bench

from drivers.api import REPEATED, Stage, StageLimits, StageMode
from drivers.errors import DeviceError, DeviceFaultError, DeviceTimeoutError, LinkError
from drivers.native import NativeStage
from drivers.transport.virtual import VirtualLink
from northfinder.cyclogram import Cyclogram, Step, six_position
from northfinder.errors import ConfigError, RecordError
from northfinder.record import Record
from northfinder.record.recorder import Recorder
from northfinder.sequencer import TRANSITIONS, Event, Progress, Sequencer, State, StopRequestedError
from sim_device.bench import SimBench
from sim_device.plant.profile import load_profile

#: The six positions in ten seconds each.
SHORT = six_position(10.0)


@contextmanager
def sequencer(
    bench: VirtualBench, path: Path, *, plan: Cyclogram = SHORT, noted: Noted | None = None
) -> Iterator[Sequencer]:
    """Yield a sequencer on the bench that records to `path`."""
    with Recorder(path, bench.clock.now) as recorder:
        yield Sequencer(
            open_gyro=bench.open_gyro,
            open_stage=bench.open_stage,
            plan=plan,
            recorder=recorder,
            clock=bench.clock,
            observer=noted or Noted(),
        )


def stage_speed(bench: VirtualBench, after: float) -> float:
    """Return how fast the emulated stage turns, `after` seconds from now, in rad/s."""
    bench.bench.advance_to(bench.clock.now_us + round(after * 1e6))
    before = [bench.bench.stage_board.encoder(axis, bench.bench.now_us) for axis in (0, 1)]
    bench.bench.advance_to(bench.bench.now_us + 100_000)
    later = [bench.bench.stage_board.encoder(axis, bench.bench.now_us) for axis in (0, 1)]
    return max(abs(b - a) for a, b in zip(before, later, strict=True)) * math.radians(1 / 36000) / 0.1


def test_every_working_state_can_fail_and_be_stopped() -> None:
    """No state of a measurement lacks a way to FAULT and to STOP, and every state named leads somewhere."""
    working = [state for state in TRANSITIONS if state not in {State.STOP, State.FAULT}]
    assert all(TRANSITIONS[state][Event.FAILURE] is State.FAULT for state in working)
    assert all(TRANSITIONS[state][Event.STOP_REQUESTED] is State.STOP for state in working)
    ends = {State.DONE, State.STOPPED, State.FAILED}
    assert {following for table in TRANSITIONS.values() for following in table.values()} - set(TRANSITIONS) == ends


def test_the_plan_is_followed_and_everything_is_recorded(tmp_path: Path) -> None:
    """Each dwell stands at its position, holds exactly its samples, and no sample of the stream is missing."""
    bench, noted = virtual_bench(), Noted()
    with sequencer(bench, tmp_path / "r.sqlite", noted=noted) as sequence:
        spans = sequence.run()
    for span, step in zip(spans, SHORT.steps, strict=True):
        assert span.stop_index - span.first_index == 2350
        turns = (span.measured_azimuth - step.azimuth) / (2 * math.pi)
        assert turns == pytest.approx(round(turns), abs=1e-5)
        assert span.measured_elevation == pytest.approx(step.elevation, abs=1e-5)
    for span, blocks in noted.dwells:
        assert blocks[0].first_index <= span.first_index
        assert blocks[-1].first_index + len(blocks[-1].counts) >= span.stop_index
    with Record(tmp_path / "r.sqlite") as record:
        blocks = list(record.blocks())
        assert record.steps() == spans
        assert record.meta("identities")["gyro"]["model"] == "tvg43"
        assert [detail for _, kind, detail in record.events() if kind == "state"][-2:] == ["finish", "done"]
    ends = np.cumsum([len(block.counts) for block in blocks])
    assert [block.first_index for block in blocks[1:]] == list(ends[:-1])


def test_no_sample_of_a_slew_enters_a_dwell(tmp_path: Path) -> None:
    """Every dwell begins at least the settling time after the stage has come to rest, and ends before it moves."""
    bench = virtual_bench()
    with sequencer(bench, tmp_path / "r.sqlite") as sequence:
        spans = sequence.run()
    with Record(tmp_path / "r.sqlite") as record:
        blocks, states = list(record.blocks()), record.states()
    origin = blocks[0].device_time - blocks[0].first_index / 235  # both emulated devices start at one instant
    moving = [state.device_time for state in states if state.mode is not StageMode.IDLE]
    for span in spans:
        first, last = origin + span.first_index / 235, origin + (span.stop_index - 1) / 235
        assert not [time for time in moving if first - 0.49 <= time < last - 0.001]


def test_a_dwell_ends_by_its_deadline(tmp_path: Path) -> None:
    """However late a dwell begins, it takes no sample beyond its deadline; one already past still takes one sample."""
    steps = (
        Step(name="U2", azimuth=math.radians(90), elevation=0.0, dwell=20.0, deadline=15.0),
        Step(name="U2", azimuth=math.radians(90), elevation=0.0, dwell=20.0, deadline=15.0),
    )
    with sequencer(virtual_bench(), tmp_path / "r.sqlite", plan=Cyclogram(name="late", steps=steps)) as sequence:
        spans = sequence.run()
    assert spans[0].stop_index == 15 * 235
    assert spans[0].stop_index - spans[0].first_index > 235
    assert spans[1].stop_index - spans[1].first_index == 1


def test_countdown_and_progress(tmp_path: Path) -> None:
    """What is still to come falls to nothing, and the rate shown is that of the newest block."""
    noted = Noted()
    with sequencer(virtual_bench(), tmp_path / "r.sqlite", noted=noted) as sequence:
        sequence.run()
    remaining = [progress.remaining for progress in noted.progress if progress.state is State.DWELL]
    assert remaining[0] == 80.0
    assert remaining[-1] == 0.0
    assert all(a >= b for a, b in pairwise(remaining))
    rates = [progress.rate for progress in noted.progress if progress.rate is not None]
    assert np.mean(rates) / math.radians(1 / 3600) == pytest.approx(38, abs=20)


@pytest.mark.parametrize("state", [State.HOME, State.SLEW, State.SETTLE, State.DWELL])
def test_a_stop_on_request_leaves_the_stage_at_rest(tmp_path: Path, state: State) -> None:
    """Wherever the operator stops, the stage comes to rest and the record says why."""
    bench = virtual_bench()
    asked = False

    def ask(progress: Progress) -> None:
        nonlocal asked
        asked = asked or (progress.state is state and (state is State.HOME or progress.n_done == 2))

    with sequencer(bench, tmp_path / "r.sqlite", noted=Noted(on_any=ask)) as sequence:
        sequence.stop_requested = lambda: asked
        with pytest.raises(StopRequestedError, match="at rest"):
            sequence.run()
    assert stage_speed(bench, 0.0) == 0.0
    with Record(tmp_path / "r.sqlite") as record:
        assert [(kind, detail) for _, kind, detail in record.events()][-1] == ("state", "stopped")
        assert len(record.steps()) == (0 if state is State.HOME else 2)


FAULTS = [
    ("stage:stall=azimuth@40", DeviceFaultError, "STALL"),
    ("stage:runaway=azimuth@46", DeviceFaultError, "RUNAWAY"),
    ("stage:runaway=azimuth@50", DeviceFaultError, "RUNAWAY"),
    ("stage:encoder-jump=elevation@40", DeviceFaultError, "ENCODER"),
    ("stage:encoder-jump=elevation@50", DeviceFaultError, "ENCODER"),
    ("stage:limit-switch=azimuth@40", DeviceFaultError, "LIMIT_SWITCH"),
    ("stage:e-stop@40", DeviceFaultError, "E_STOP"),
    ("stage:e-stop@50", DeviceFaultError, "E_STOP"),
    ("stage:unplug@50", LinkError, "virtual stage"),
    ("gyro:unplug@50", LinkError, "virtual gyro"),
    ("stage:reset@50", DeviceError, "virtual stage"),
    ("gyro:reset@50", DeviceError, "virtual gyro"),
    ("gyro:freeze@50+9", DeviceTimeoutError, "virtual gyro"),
    ("stage:freeze@50+9", DeviceTimeoutError, "virtual stage"),
]


@pytest.mark.parametrize(("fault", "kind", "name"), FAULTS, ids=[fault for fault, _, _ in FAULTS])
def test_a_fault_is_named_and_ends_with_the_stage_at_rest(
    tmp_path: Path, fault: str, kind: type[Exception], name: str
) -> None:
    """A fault in the middle of a run: the right error, within seconds, the stage stopped, the record kept."""
    bench = virtual_bench(faults=(fault,))
    with sequencer(bench, tmp_path / "r.sqlite") as sequence, pytest.raises(kind, match=name):
        sequence.run()
    instant = float(fault.partition("@")[2].partition("+")[0])
    assert instant <= bench.clock.now() <= instant + 6
    if "runaway" not in fault:  # the emulated drive of a runaway does not listen any more
        assert stage_speed(bench, 3.0) == 0.0
    with Record(tmp_path / "r.sqlite") as record:
        events = [(kind, detail) for _, kind, detail in record.events()]
        assert ("state", "failed") in events
        assert [detail for kind, detail in events if kind == "failure"]
        assert list(record.blocks())[-1].device_time > instant - 1


def test_lost_frames_are_counted_and_survived(tmp_path: Path) -> None:
    """A line that flips bits costs samples, counted right, and the measurement goes on."""
    bench = virtual_bench(faults=("gyro:flip=0.00002", "stage:flip=0.00002"))
    with sequencer(bench, tmp_path / "r.sqlite") as sequence:
        spans = sequence.run()
        recorder = sequence.recorder
        assert recorder.n_lost > 0
        assert recorder.n_lost % 47 == 0  # whole blocks
    assert len(spans) == 8
    with Record(tmp_path / "r.sqlite") as record:
        blocks = list(record.blocks())
    n_received = sum(len(block.counts) for block in blocks)
    end = blocks[-1].first_index + len(blocks[-1].counts)
    assert end - blocks[0].first_index - n_received == sum(block.n_lost for block in blocks[1:])


class AskedAgain:
    """A stage that had to be asked three times for each move."""

    def __init__(self, stage: NativeStage) -> None:
        self._stage = stage
        self.troubles = {REPEATED: 0}

    def move(self, azimuth: float, elevation: float) -> None:
        """Move, in the end."""
        self.troubles = {REPEATED: self.troubles[REPEATED] + 2}
        self._stage.move(azimuth, elevation)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401  # all else is the stage's
        return getattr(self._stage, name)


def test_what_goes_wrong_and_is_made_up_for_is_told(tmp_path: Path) -> None:
    """Gaps, requests that had to be repeated and damaged frames stand among the events, each with its place."""
    bench = virtual_bench(faults=("gyro:flip=0.00002",))
    with sequencer(bench, tmp_path / "r.sqlite") as sequence:
        sequence.open_stage = lambda: cast("Stage", AskedAgain(bench.open_stage()))
        sequence.run()
        n_lost = sequence.recorder.n_lost
    with Record(tmp_path / "r.sqlite") as record:
        told = [(kind, detail) for _, kind, detail in record.events()]
    of_gyro = r"gyro, (?:slew|settle|dwell) [1-8]: "
    gaps = [re.fullmatch(of_gyro + r"samples missing: (\d+)", detail) for kind, detail in told if kind == "gap"]
    assert sum(int(gap[1]) for gap in gaps if gap) == n_lost > 0
    assert all(gaps)
    assert any(kind == "link" and re.fullmatch(of_gyro + r"damaged frames: \d+", detail) for kind, detail in told)
    retries = [detail for kind, detail in told if kind == "retry"]
    assert retries == [f"stage, slew {number}: requests repeated: 2" for number in range(1, 9)]


def test_a_sound_bench_has_nothing_to_tell(tmp_path: Path) -> None:
    """No trouble is made up where there is none."""
    with sequencer(virtual_bench(), tmp_path / "r.sqlite") as sequence:
        sequence.run()
    with Record(tmp_path / "r.sqlite") as record:
        assert {kind for _, kind, _ in record.events()} == {"state", "self-test"}


def test_flagged_blocks_are_told(tmp_path: Path) -> None:
    """Blocks that the gyro declares unfit stand among the events."""
    profile = load_profile("tvg43")
    bench = VirtualBench(SimBench(replace(profile, gyro=replace(profile.gyro, range_dph=30.0)), seed=1))
    with sequencer(bench, tmp_path / "r.sqlite") as sequence:
        sequence.run()
    with Record(tmp_path / "r.sqlite") as record:
        flagged = [detail for _, kind, detail in record.events() if kind == "status"]
    assert flagged
    assert all(re.fullmatch(r"gyro, \w+ [1-8]: blocks flagged saturated: \d+", detail) for detail in flagged)


def test_an_unreachable_plan_is_refused_before_anything_moves(tmp_path: Path) -> None:
    """A step beyond the stage's limits is refused while the stage is not even homed."""
    steps = (SHORT.steps[0], Step(name="west", azimuth=math.radians(-90), elevation=0.0, dwell=5.0))
    bench = virtual_bench()
    limits = StageLimits(
        azimuth_min=0.0, azimuth_max=math.radians(180), elevation_min=-0.1, elevation_max=0.1, max_speed=1.0
    )
    with sequencer(bench, tmp_path / "r.sqlite", plan=Cyclogram(name="west", steps=steps)) as sequence:
        sequence.open_stage = lambda: NativeStage(
            VirtualLink(bench.bench.stage, bench.clock), bench.clock, limits=limits
        )
        with pytest.raises(ConfigError, match="azimuth -90 deg cannot be reached: the stage turns from 0 to 180 deg"):
            sequence.run()
    with Record(tmp_path / "r.sqlite") as record:
        assert {state.mode for state in record.states()} <= {StageMode.NOT_HOMED}


def test_a_full_disk_stops_the_stage(tmp_path: Path) -> None:
    """When the record cannot grow the measurement ends with that sentence, and the stage is at rest."""
    bench = virtual_bench()
    with sequencer(bench, tmp_path / "r.sqlite") as sequence:
        sequence.recorder._writer._db.execute("PRAGMA max_page_count = 30")
        with pytest.raises(RecordError, match="database or disk is full"):
            sequence.run()
    assert stage_speed(bench, 0.0) == 0.0
