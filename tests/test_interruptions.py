"""Whatever interrupts a measurement: the stage stops, the record is closed, the exit code is documented."""

import json
import os
import pty
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from drivers.api import StageMode
from drivers.discovery import open_stage
from drivers.transport.clock import SystemClock
from northfinder.record import Record
from northfinder.record.check import examine

NORTHFINDER = [sys.executable, "-m", "northfinder"]
FIND = [*NORTHFINDER, *["find", "--speed", "max", "--seed", "1", "--plan", "four-position", "--dwell", "20"]]
TIMEOUT = 60


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


def at_rest(address: str) -> bool:
    """Return whether the emulated stage stands still."""
    stage = open_stage(address, SystemClock())
    stage.connect()
    mode = stage.state().mode
    stage.close()
    return mode in {StageMode.IDLE, StageMode.NOT_HOMED}


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


def test_a_terminal_that_is_closed(tmp_path: Path) -> None:
    """The window goes away in mid-run: writes fail, a hang-up comes; the record is closed, exit code 130."""
    master, slave = pty.openpty()
    command = [*NORTHFINDER, "find", "--speed", "30", "--seed", "1", "--plan", "six-position", "--out", str(tmp_path)]
    with subprocess.Popen(command, stdout=slave, stderr=slave) as child:
        os.close(slave)
        seen = b""
        while b"dwell" not in seen:
            seen += os.read(master, 4096)
        os.close(master)
        child.send_signal(signal.SIGHUP)
        assert child.wait(TIMEOUT) == 130
    assert last_state(only_record(tmp_path)) == "stopped"
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


@pytest.mark.campaign
def test_a_stop_at_any_moment(tmp_path: Path) -> None:
    """Ctrl-C, termination, hang-up at random moments: stage at rest, record closed and sound, exit code 130."""
    rng = np.random.default_rng(9)
    with emulated("--speed", "5", "--seed", "2") as addresses:
        for number in range(200):
            folder = tmp_path / str(number)
            command = [*NORTHFINDER, "find", "--gyro", addresses["gyro"], "--stage", addresses["stage"], "--plan",
                       "six-position", "--dwell", "5", "--out", str(folder)]  # fmt: skip
            with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as child:
                assert child.stderr is not None
                child.stderr.readline()
                with pytest.raises(subprocess.TimeoutExpired):
                    child.wait(rng.uniform(0.0, 8.0))
                child.send_signal([signal.SIGINT, signal.SIGTERM, signal.SIGHUP][number % 3])
                child.stderr.read()
                assert child.wait(TIMEOUT) == 130
            assert at_rest(addresses["stage"])
            assert last_state(only_record(folder)) == "stopped"
            assert examine(only_record(folder)).sound


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
