"""An interrupted measurement goes on: at every step and sub-step, on the same bench, the gyro switched off or not."""

import math
import shutil
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from virtual import VirtualBench, assume, virtual_bench

from drivers.api import DeviceIdentity, Gyro, RateBlock, Stage
from drivers.native import NativeGyro, NativeStage
from northfinder.adaptive import Wishes, make_plan
from northfinder.config import Config, GyroTable, StageTable
from northfinder.errors import ConfigError, RecordError
from northfinder.estimation import Fix
from northfinder.measurement import Measurement, Outcome, measure
from northfinder.record import DwellSpan, Record, StreamInfo
from northfinder.record.check import examine
from northfinder.reduction import Reduction
from northfinder.resume import remainder_of
from northfinder.sequencer import Progress, State
from northfinder.solution import solve
from northfinder.solve_file import solve_record
from northfinder.streams import Earlier

WISHES = Wishes(name="refined", time=100.0)
ASSUMPTIONS = assume(latitude_deg=50.429)
META = {"config": Config(gyro=GyroTable(address="native:a"), stage=StageTable(address="native:b")), "wishes": WISHES}


class PowerCutError(BaseException):
    """The host's process is gone."""


@dataclass
class Cutter:
    """A watcher that looks for a moment, keeps the record's files as they are then, and ends the process."""

    record: Path
    at: Callable[[Progress], bool]
    seen: list[Progress] = field(default_factory=list)

    def show(self, progress: Progress, fix: Fix | None) -> None:
        """Cut if this is the moment."""
        self.seen.append(progress)
        if self.at(progress):
            written(self.record, progress)
            for path in self.record.parent.glob(f"{self.record.name}*"):
                if not path.name.endswith("-shm"):  # no file but memory shared by processes
                    shutil.copy(path, path.with_name(f"cut-{path.name}"))
            raise PowerCutError


def written(path: Path, progress: Progress) -> None:
    """Wait until the recorder's thread has brought to the file what was handed to it up to this moment."""
    pause, looks = threading.Event(), 3000
    for _ in range(looks):
        with Record(path) as record:
            states = [detail for _, kind, detail in record.events() if kind == "state"]
            if states[-1:] == [progress.state.value] and len(record.steps()) == progress.n_done:
                return
        pause.wait(0.01)
    pytest.fail(f"the recorder has not written {progress.state} after {progress.n_done} steps")


def dead_gyro(bench: VirtualBench) -> Gyro:
    """Return a gyro whose host ends without a word: its link is cut, and nothing is sent."""
    link = bench._link("gyro")
    gyro = NativeGyro(link, bench.clock, draw_session=lambda: next(bench._sessions))
    gyro.close = link.close  # type: ignore[method-assign]  # a dead process says nothing
    return gyro


def dead_stage(bench: VirtualBench) -> Stage:
    """Return a stage whose host ends likewise."""
    link = bench._link("stage")
    stage = NativeStage(link, bench.clock, draw_session=lambda: next(bench._sessions))
    stage.close = link.close  # type: ignore[method-assign]  # as above
    return stage


def never(progress: Progress) -> bool:  # noqa: ARG001  # a moment's signature
    """Return that this is not the moment."""
    return False


def interrupted(bench: VirtualBench, path: Path, at: Callable[[Progress], bool]) -> Path:
    """Measure until the moment comes; return what the process left of its record."""
    measurement = Measurement(
        open_gyro=lambda: dead_gyro(bench), open_stage=lambda: dead_stage(bench),
        plan=make_plan(WISHES, ASSUMPTIONS, settle=0.5), settle=0.5, assumptions=ASSUMPTIONS, record=path, meta=META,
    )  # fmt: skip
    with pytest.raises(PowerCutError):
        measure(measurement, clock=bench.clock, utc=bench.clock.now, watcher=Cutter(path, at))
    return path.with_name(f"cut-{path.name}")


def resumed(
    bench: VirtualBench, path: Path, watcher: Cutter | None = None, *, meta: Mapping[str, object] | None = None
) -> Outcome:
    """Go on with a record."""
    with Record(path) as record:
        rest = remainder_of(record)
    measurement = Measurement(
        open_gyro=bench.open_gyro, open_stage=bench.open_stage, plan=rest.plan, settle=0.5,
        assumptions=rest.assumptions, record=path, resume=True, meta=meta or {},
    )  # fmt: skip
    return measure(measurement, clock=bench.clock, utc=bench.clock.now, watcher=watcher or Cutter(path, never))


def spans_of(path: Path) -> list[DwellSpan]:
    """Return the finished dwells."""
    with Record(path) as record:
        return record.steps()


MOMENTS = [(State.HOME, 0), (State.SLEW, 0), (State.DWELL, 0), (State.SETTLE, 2), (State.DWELL, 3), (State.FINISH, 5)]


@pytest.mark.parametrize(("state", "n_done"), MOMENTS, ids=lambda value: getattr(value, "value", value))
def test_a_measurement_goes_on_from_wherever_it_was_cut(tmp_path: Path, state: State, n_done: int) -> None:
    """Nothing finished is repeated, the plan ends as planned, the fix is right, and `solve` gives it bit for bit."""
    bench = virtual_bench(seed=11)
    path = interrupted(
        bench,
        tmp_path / "r.sqlite",
        lambda now: (
            (now.state, now.n_done) == (state, n_done) and (state is not State.DWELL or now.step_fraction > 0.4)
        ),
    )
    finished = spans_of(path)
    assert len(finished) <= n_done
    bench.clock.sleep_until(bench.clock.now() + 20.0)
    watcher = Cutter(path, never)
    outcome = resumed(bench, path, watcher)
    spans = spans_of(path)
    assert spans[: len(finished)] == finished
    assert min(now.n_done for now in watcher.seen) == len(finished)
    assert [span.step for span in spans] == list(range(len(spans)))
    assert {span.stream for span in spans[len(finished) :]} <= {0 if state is State.HOME else 1}
    assert abs(outcome.fix.azimuth - math.radians(33.0)) < 4 * outcome.fix.azimuth_sd
    assert solve_record(path)["azimuth_deg"] == outcome.to_json()["azimuth_deg"]
    assert 90.0 < outcome.duration <= 100.0
    assert examine(path).sound


def test_the_parts_lie_where_the_gyros_clock_puts_them(tmp_path: Path) -> None:
    """A gyro that ran on: dwells of the second stream start as much later as its clock says, the pause included."""
    bench = virtual_bench(seed=12)
    path = interrupted(bench, tmp_path / "r.sqlite", lambda now: (now.state, now.n_done) == (State.SLEW, 3))
    bench.clock.sleep_until(bench.clock.now() + 100.0)
    resumed(bench, path)
    with Record(path) as record:
        blocks = [list(record.blocks(stream=number)) for number in (0, 1)]
        spans = record.steps()
    assert {span.turn_on for span in spans} == {0}
    (start,) = {span.stream_start for span in spans if span.stream == 1}
    begin = [stream[0].device_time - stream[0].first_index / 235 for stream in blocks]
    assert start == pytest.approx(begin[1] - begin[0], abs=1e-3)
    assert start > 100.0


def test_a_gyro_switched_off_gets_a_bias_of_its_own(tmp_path: Path) -> None:
    """After a power cut of gyro and host the rest is a new turn-on, in its place by the date; the fix is right."""
    bench = virtual_bench(seed=13)
    path = interrupted(bench, tmp_path / "r.sqlite", lambda now: (now.state, now.n_done) == (State.SLEW, 4))
    bench.bench.reset("gyro")
    bench.bench.reset("stage")
    bench.clock.sleep_until(bench.clock.now() + 300.0)
    outcome = resumed(bench, path)
    spans = spans_of(path)
    assert [span.turn_on for span in spans] == [0] * 4 + [1] * (len(spans) - 4)
    assert spans[-1].stream_start > 300.0
    assert abs(outcome.fix.azimuth - math.radians(33.0)) < 4 * outcome.fix.azimuth_sd


def test_interrupted_twice(tmp_path: Path) -> None:
    """A resumed measurement can be cut and resumed again."""
    bench = virtual_bench(seed=14)
    path = interrupted(bench, tmp_path / "r.sqlite", lambda now: (now.state, now.n_done) == (State.DWELL, 1))
    with pytest.raises(PowerCutError):
        resumed(bench, path, Cutter(path, lambda now: (now.state, now.n_done) == (State.SLEW, 3)))
    outcome = resumed(bench, path)
    spans = spans_of(path)
    assert sorted({span.stream for span in spans}) == [0, 1, 2]
    assert [span.step for span in spans] == list(range(len(spans)))
    assert abs(outcome.fix.azimuth - math.radians(33.0)) < 4 * outcome.fix.azimuth_sd


def test_another_gyro_is_refused(tmp_path: Path) -> None:
    """The rest is measured with the gyro of the first part, or not at all; the record stays as it is."""
    bench = virtual_bench(seed=15)
    path = interrupted(bench, tmp_path / "r.sqlite", lambda now: (now.state, now.n_done) == (State.SLEW, 2))
    elsewhere = {"config": {"gyro": {"address": "native:/dev/ttyUSB7"}}}
    with Record(path) as record:
        before = record.meta("config")
    with pytest.raises(ConfigError, match=r"same gyro: found tvg43 SIM-G16.* expected tvg43 SIM-G15"):
        resumed(virtual_bench(seed=16), path, meta=elsewhere)
    assert len(spans_of(path)) == 2
    with Record(path) as record:
        assert record.meta("identities")["gyro"]["serial_number"] == "SIM-G15"
        assert record.meta("config") == before
    resumed(bench, path, meta=elsewhere)
    with Record(path) as record:
        assert record.meta("config") == elsewhere["config"]


def test_another_stage_is_refused() -> None:
    """Its azimuth zero points elsewhere; what a record does not say of a stage is no reason to refuse one."""
    gyro, stage = (DeviceIdentity(kind=kind, model="m", serial_number="1") for kind in ("gyro", "stage"))
    other = replace(stage, serial_number="2")
    kept = {kind: {"model": "m", "serial_number": "1"} for kind in ("gyro", "stage")}
    anchor = StreamInfo(stream=0, utc=0.0, clock=0.0, sample_rate=9.0, n_axes=1, identities=kept, software="")
    Earlier(anchor=anchor).check({"gyro": gyro, "stage": stage}, sample_rate=9.0, n_axes=1)
    with pytest.raises(ConfigError, match="same stage: found m 2, expected m 1"):
        Earlier(anchor=anchor).check({"gyro": gyro, "stage": other}, sample_rate=9.0, n_axes=1)
    unsaid = replace(anchor, identities={"gyro": kept["gyro"]})
    Earlier(anchor=unsaid).check({"gyro": gyro, "stage": other}, sample_rate=9.0, n_axes=1)


def test_a_whole_measurement_is_not_resumed(tmp_path: Path) -> None:
    """Nor is a record that does not say how to go on."""
    bench = virtual_bench(seed=17)
    path = interrupted(bench, tmp_path / "r.sqlite", lambda now: (now.state, now.n_done) == (State.SLEW, 4))
    with Record(path) as record:
        too_late = remainder_of(record)
    resumed(bench, path)
    with Record(path) as record, pytest.raises(RecordError, match="whole measurement"):
        remainder_of(record)
    # Somebody else has gone on with it between a look at the record and its lock.
    measurement = Measurement(
        open_gyro=bench.open_gyro, open_stage=bench.open_stage, plan=too_late.plan, settle=0.5,
        assumptions=too_late.assumptions, record=path, resume=True,
    )  # fmt: skip
    with pytest.raises(RecordError, match="whole measurement"):
        measure(measurement, clock=bench.clock, utc=bench.clock.now, watcher=Cutter(path, never))
    with Record(path) as record:
        assert len(record.fixes()) == 1
    assert examine(path).sound


# The estimate from two streams against that from one, of the same samples.

DWELLS = 9
RATE, DWELL, PERIOD = 50.0, 20.0, 25.0  # Hz, s, s


def dwells(rng: np.random.Generator) -> list[tuple[DwellSpan, RateBlock]]:
    """Return a measurement of nine positions with the noise of a gyro, cut from one stream."""
    noise = ASSUMPTIONS.noise()
    assert noise is not None
    n = round(DWELLS * PERIOD * RATE)
    white, slow = noise.angle_white_noise * RATE, noise.rate_random_walk / math.sqrt(RATE)
    rate = white * np.diff(rng.normal(size=n + 1)) + slow * np.cumsum(rng.normal(size=n))
    rate += noise.angle_random_walk * math.sqrt(RATE) * rng.normal(size=n)
    found = []
    for k in range(DWELLS):
        first, stop = round(k * PERIOD * RATE), round((k * PERIOD + DWELL) * RATE)
        azimuth = (0, 3, 1, 2, 2, 1, 3, 0, 1)[k] * math.pi / 2
        earth = 4.6e-5 * math.cos(azimuth + math.radians(33.0)) * 1.021
        span = DwellSpan(
            step=k, name=f"U{k}", azimuth=azimuth, elevation=0.0, dwell=DWELL, measured_azimuth=azimuth,
            measured_elevation=0.0, first_index=first, stop_index=stop, sample_rate=RATE,
        )  # fmt: skip
        counts = ((rate[first:stop] + earth) / 1e-10).astype(np.int32).reshape(-1, 1)
        found.append(
            (span, RateBlock(first_index=first, device_time=0.0, arrival_time=0.0, counts=counts, rate_lsb=1e-10))
        )  # fmt: skip
    return found


def fix_of(found: list[tuple[DwellSpan, RateBlock]]) -> Fix:
    """Return the fix from dwells."""
    reduction = Reduction()
    for span, block in found:
        reduction.add(span, [block])
    return solve(reduction.means(), assume(latitude_deg=50.429))


def cut(found: list[tuple[DwellSpan, RateBlock]], at: int, *, turn_on: int) -> list[tuple[DwellSpan, RateBlock]]:
    """Return the same samples as two streams, the second beginning with dwell `at`."""
    origin = found[at][0].first_index
    later = [
        (
            replace(
                span, first_index=span.first_index - origin, stop_index=span.stop_index - origin, stream=1,
                stream_start=origin / RATE, turn_on=turn_on,
            ),
            replace(block, first_index=block.first_index - origin),
        )
        for span, block in found[at:]
    ]  # fmt: skip
    return found[:at] + later


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("at", range(1, DWELLS))
def test_a_cut_between_steps_changes_nothing(seed: int, at: int) -> None:
    """The same samples as two streams of a gyro that ran on: the same fix, to a hundredth of its standard deviation."""
    found = dwells(np.random.default_rng(seed))
    whole, parted = fix_of(found), fix_of(cut(found, at, turn_on=0))
    assert abs(parted.azimuth - whole.azimuth) < 0.01 * whole.azimuth_sd
    assert parted.azimuth_sd == pytest.approx(whole.azimuth_sd, rel=0.01)


@pytest.mark.parametrize("at", range(1, DWELLS))
def test_a_new_turn_on_may_have_any_bias(at: int) -> None:
    """A jump of a hundred deg/h between two turn-ons leaves the fix where it is, and costs some of its certainty."""
    found = dwells(np.random.default_rng(6))
    parted = cut(found, at, turn_on=1)
    jump = round(100 * math.radians(1 / 3600) / 1e-10)
    jumped = parted[:at] + [(span, replace(block, counts=block.counts + jump)) for span, block in parted[at:]]
    whole, fix, other = fix_of(found), fix_of(parted), fix_of(jumped)
    assert other.azimuth == pytest.approx(fix.azimuth, abs=1e-3 * fix.azimuth_sd)
    assert abs(fix.azimuth - whole.azimuth) < 3 * fix.azimuth_sd
    assert whole.azimuth_sd * 0.99 < fix.azimuth_sd < 4 * whole.azimuth_sd
