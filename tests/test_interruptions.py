"""Whatever interrupts a measurement: the stage stops, the record is closed, the exit code is documented."""

import json
import os
import pty
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from interruptible import BENCHES, INTERRUPTIONS, LiveBench, interruptible

from drivers.transport.clock import SystemClock
from northfinder.cli import interruption
from northfinder.cli.bench import stop_on_signal
from northfinder.errors import RecordError
from northfinder.record import Record
from northfinder.record.check import examine
from northfinder.sequencer import StopRequestedError

NORTHFINDER = [sys.executable, "-m", "northfinder"]
FIND = [*NORTHFINDER, *["find", "--speed", "max", "--seed", "1", "--plan", "four-position", "--dwell", "20"]]
TIMEOUT = 60
#: A measurement with a quick stage, on devices to be named.
QUICK_TURN = Path(__file__).parent / "quick_turn.toml"
FIND_ON = [*NORTHFINDER, "find", "--plan", str(QUICK_TURN), "--profile", "tvg43", "--latitude", "50.429"]
WHOLE_RUN = 39.0  #: s that it takes from the program's start to its end
STOP_TIME = 0.3  #: s after which the stage must be at rest
ENDED_WITHIN = 3.0  #: s after which the program must have ended when the disk takes no more; 1 s but on a busy machine
#: How the program may end, and the state in which it then leaves the measurement: one that had ended already is done;
#: a signal that comes before the program has begun to run ends it as any other.
ENDS = {
    (130, "stopped"),
    (130, "done"),
    (0, "done"),
    (130, "not begun"),
    (-2, "not begun"),
    (-15, "not begun"),
    (-1, "not begun"),
}


@contextmanager
def emulated(*arguments: str) -> Iterator[dict[str, str]]:
    """Yield the addresses of an emulator that outlives its hosts."""
    command = [*NORTHFINDER, "emulate", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as child:
        assert child.stdout is not None
        try:
            yield json.loads(child.stdout.readline())
        finally:
            child.terminate()


def only_record(folder: Path) -> Path:
    """Return the one file that a measurement has left: a record, with no log beside it."""
    (path,) = folder.iterdir()
    return path


def last_state(path: Path) -> str:
    """Return the state in which a measurement ended."""
    with Record(path) as record:
        return [detail for _, kind, detail in record.events() if kind == "state"][-1]


def test_a_terminal_that_takes_nothing_holds_up_nothing(tmp_path: Path) -> None:
    """Nobody reads what the live view writes: the measurement goes on to its result, and the program ends."""
    master, slave = pty.openpty()
    command = [*FIND, "--json", "--out", str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=slave) as child:
        os.close(slave)
        out, _ = child.communicate(timeout=TIMEOUT)
    assert child.returncode == 0
    result = json.loads(out)
    assert len(os.read(master, 1 << 20)) > 1000
    os.close(master)
    assert abs(result["azimuth_deg"] - 33.0) < 4 * result["azimuth_sd_deg"]
    assert examine(only_record(tmp_path)).sound


def test_a_pipe_whose_reader_has_gone(tmp_path: Path) -> None:
    """Progress that nobody takes any more is no reason to stop a measurement."""
    command = [*FIND, "--json", "--out", str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        assert child.stdout is not None
        assert child.stderr is not None
        child.stderr.close()
        assert json.loads(child.stdout.read())["n_lost"] == 0
        assert child.wait(TIMEOUT) == 0
    assert last_state(only_record(tmp_path)) == "done"


def is_complete(path: Path) -> bool:
    """Return whether a record holds a whole measurement by now."""
    try:
        with Record(path) as record:
            return record.is_complete()
    except RecordError:  # not yet begun
        return False


MOVING = [*((how, "native") for how in INTERRUPTIONS), *(("SIGTERM", devices) for devices in BENCHES[1:])]


@pytest.mark.parametrize(("how", "devices"), MOVING)
def test_interrupted_while_the_stage_moves(tmp_path: Path, how: str, devices: str) -> None:
    """Whatever ends the program, the stage is at rest within 0.3 s, the record closed and sound, the exit code 130."""
    with (
        LiveBench(seed=3, devices=devices) as bench,
        interruptible(how, [*FIND_ON, *bench.options], tmp_path) as host,
    ):
        host.go_on_until(bench.stage_moves)
        interrupted = host.interrupt()
        assert host.wait(TIMEOUT) == 130
        assert bench.at_rest_since() - interrupted < STOP_TIME
        assert not bench.stage_moves()
    assert last_state(only_record(tmp_path / "records")) == "stopped"
    assert examine(only_record(tmp_path / "records")).sound


@pytest.mark.parametrize("n_moments", [6, pytest.param(300, marks=pytest.mark.campaign)])
def test_interrupted_while_it_starts(tmp_path: Path, n_moments: int) -> None:
    """At any moment of its first second, in which modules are imported: it ends, and has not been heard in vain."""
    rng = np.random.default_rng(12)
    command = [*NORTHFINDER, "find", "--speed", "1", "--quiet"]
    for number in range(n_moments):
        with interruptible("SIGTERM", command, tmp_path / str(number)) as host:
            host.go_on(rng.uniform(0.05, 1.2))
            host.interrupt()
            assert host.wait(5) in {130, -signal.SIGTERM}


def test_an_interruption_that_was_swallowed_stops_a_measurement(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is raised in a callback of Python's own is lost; that a signal has come is not."""
    monkeypatch.setattr(interruption, "has_come", True)
    with pytest.raises(StopRequestedError):
        measure_nothing()


def measure_nothing() -> None:
    """Measure as the program does, but for the measurement."""
    with stop_on_signal(SystemClock()) as stop_requested:
        if stop_requested():
            raise StopRequestedError


def test_a_result_that_nobody_takes(tmp_path: Path) -> None:
    """It waits for whoever should read it, as every program does; a Ctrl-C ends that."""
    with interruptible("full pipe", [*FIND, "--quiet"], tmp_path) as host:
        host.go_on_until(lambda: any(is_complete(path) for path in tmp_path.glob("records/*.sqlite")))
        host.go_on(0.2)
        host.interrupt()
        assert host.wait(TIMEOUT) == 130
    assert examine(only_record(tmp_path / "records")).sound


@pytest.fixture
def ctrl_c() -> Iterator[None]:
    """Let a Ctrl-C interrupt, whatever those who started these tests want of it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("ctrl_c")
def test_a_stop_that_comes_too_late() -> None:
    """When the measurement has just ended, a Ctrl-C is meant for what follows; else the result might wait for ever."""

    def stopped_at_the_end() -> None:
        with stop_on_signal(SystemClock()) as stop_requested:
            assert not stop_requested()
            signal.raise_signal(signal.SIGINT)
            assert stop_requested()

    with pytest.raises(KeyboardInterrupt):
        stopped_at_the_end()


def test_what_the_starter_wants_ignored(tmp_path: Path) -> None:
    """Under nohup a hang-up stops nothing; a Ctrl-C does, also in the background, where shells let it be ignored."""
    ignoring = ["env", "--ignore-signal=HUP", "--ignore-signal=INT"]
    with LiveBench(seed=5) as bench, interruptible("Ctrl-C", [*ignoring, *FIND_ON, *bench.options], tmp_path) as host:
        host.go_on_until(bench.stage_moves)
        host.send(signal.SIGHUP)
        host.go_on(0.5)
        assert bench.stage_moves()
        host.interrupt()
        assert host.wait(TIMEOUT) == 130
    assert last_state(only_record(tmp_path / "records")) == "stopped"


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """Yield a folder that is a disk of 32 MiB of its own."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=32M", "tmpfs", str(folder)], check=False)
    if mounted.returncode:
        pytest.skip("whoever runs these tests may not mount a disk")
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def fill_up(folder: Path) -> None:
    """Write until the disk is full to the last byte."""
    with (folder / "filler").open("wb", buffering=0) as file:
        for size in (1 << 16, 1):
            with suppress(OSError):
                while True:
                    file.write(bytes(size))


def test_a_disk_that_fills_up(small_disk: Path) -> None:
    """Others take the last room while the stage moves: it is stopped, one sentence at once, exit code 5."""
    with LiveBench(seed=4) as bench, interruptible("Ctrl-C", [*FIND_ON, *bench.options], small_disk) as host:
        host.go_on_until(bench.stage_moves)
        fill_up(small_disk)
        full = time.monotonic()
        assert host.wait(TIMEOUT) == 5
        assert time.monotonic() - full < ENDED_WITHIN
        assert not bench.stage_moves()
        assert host.said().splitlines()[-1].endswith("cannot be written: database or disk is full")
    (path,) = (small_disk / "records").glob("*.sqlite")
    assert examine(path).sound
    (small_disk / "filler").unlink()


@pytest.mark.campaign
@pytest.mark.parametrize("batch", range(40))
def test_interrupted_at_any_moment(tmp_path: Path, batch: int) -> None:
    """The same at 25 random moments of a whole run of the program, from its start to its end, of each batch."""
    rng = np.random.default_rng([9, batch])
    ends = []
    for number in range(25):
        ends.append(interrupted(INTERRUPTIONS[number % len(INTERRUPTIONS)], rng, tmp_path / str(number)))
        (tmp_path / "ends.txt").write_text("".join(f"{end}\n" for end in ends))  # what docs/reliability.md sums up
    assert all(end.as_promised or end.void for end in ends)
    assert sum(end.void for end in ends) < 3


@dataclass(frozen=True, kw_only=True)
class Ended:
    """How a program that was interrupted came to its end."""

    how: str
    moved: bool  #: whether the stage did when it was interrupted
    at_rest_after: float  #: s, negative if it was before
    state: str  #: of the measurement
    code: int | None  #: None if it did not end
    sound: bool  #: whether the record is, if there is one

    @property
    def void(self) -> bool:
        """Return whether a busy machine had kept the host from its heartbeats, and so ended the run before."""
        return self.at_rest_after < 0.0 and self.sound and (self.code, self.state) == (3, "failed")

    @property
    def as_promised(self) -> bool:
        """Return whether nothing is wrong with it."""
        return self.at_rest_after < STOP_TIME and self.sound and (self.code, self.state) in ENDS


def interrupted(how: str, rng: np.random.Generator, folder: Path) -> Ended:
    """Run the whole program on a bench of its own, interrupt it at a random moment, and return what came of it."""
    with LiveBench(seed=int(rng.integers(1 << 32))) as bench:
        with interruptible(how, [*FIND_ON, *bench.options], folder) as host:
            host.go_on(rng.uniform(0.0, WHOLE_RUN))
            instant, moved = host.interrupt(), bench.stage_moves()
            try:
                code = host.wait(TIMEOUT)
            except subprocess.TimeoutExpired:
                code = None
        assert not bench.stage_moves()
        at_rest_after = bench.at_rest_since() - instant
    records = list((folder / "records").glob("*"))
    return Ended(
        how=how,
        moved=moved,
        at_rest_after=at_rest_after,
        state=last_state(records[0]) if records else "not begun",
        code=code,
        sound=len(records) <= 1 and all(examine(path).sound for path in records),
    )


@pytest.mark.parametrize("n_kills", [1, pytest.param(60, marks=pytest.mark.campaign)])
def test_killed_and_resumed(tmp_path: Path, n_kills: int) -> None:
    """Kill -9 at random moments of a measurement, then `resume`: it completes, and its fix is right."""
    rng = np.random.default_rng(10)
    for number in range(n_kills):
        folder = tmp_path / str(number)
        with emulated("--speed", "max", "--seed", str(number)) as addresses:
            command = [*NORTHFINDER, "find", "--gyro", addresses["gyro"], "--stage", addresses["stage"], "--profile",
                       "tvg43", "--latitude", "50.429", "--time", "120", "--out", str(folder)]  # fmt: skip
            with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as child:
                assert child.stderr is not None
                for _ in range(int(rng.integers(3, 9))):
                    child.stderr.readline()
                child.send_signal(signal.SIGKILL)
            path = next(folder.glob("*.sqlite"))
            done = subprocess.run(
                [*NORTHFINDER, "resume", str(path), "--json"],
                capture_output=True,
                text=True,
                timeout=TIMEOUT,
                check=False,
            )
        assert done.returncode == 0, done.stderr
        fix = json.loads(done.stdout)
        assert abs(fix["azimuth_deg"] - 33.0) < 4.5 * fix["azimuth_sd_deg"]
        assert examine(path).sound
