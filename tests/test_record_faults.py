"""Disks and processes that fail: whatever was acknowledged is there, and nothing is lost without a word."""

import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from power_cut import TRACED, Disk
from recording import block, fill

from northfinder.errors import RecordError
from northfinder.record import Record
from northfinder.record.check import examine
from northfinder.record.recorder import Recorder, expected_bytes, parts
from northfinder.record.writer import STALL_TIMEOUT

STRACE = shutil.which("strace")
traced = pytest.mark.skipif(STRACE is None, reason="needs strace")
CHILD = [sys.executable, str(Path(__file__).parent / "recorder_child.py")]


def strace(*options: str, path: Path, n_blocks: int) -> subprocess.CompletedProcess[str]:
    """Run the recording child under strace."""
    assert STRACE is not None
    command = [STRACE, "-f", "-q", *options, *CHILD, str(path), str(n_blocks)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


@cache
def traced_disk(n_blocks: int) -> Disk:
    """Return all that one whole recording did to its files."""
    with TemporaryDirectory() as folder:
        log = Path(folder) / "log"
        done = strace(
            "-y", "-xx", "-s", "100000", "-o", str(log), "-e", TRACED, path=Path(folder) / "r.sqlite", n_blocks=n_blocks
        )
        assert done.returncode == 0, done.stderr
        disk = Disk(log.read_text(), "r.sqlite")
    assert [step.offset for step in disk.steps if step.name == "said"] == list(range(1, n_blocks + 1))
    return disk


def check_cut(path: Path, acknowledged: int) -> None:
    """Assert that the record opens, holds what was acknowledged, and nothing that was not written."""
    try:
        with Record(path) as record:
            blocks = list(record.blocks())
    except RecordError:
        assert not acknowledged
        return
    assert len(blocks) >= acknowledged
    for k, each in enumerate(blocks):
        assert each.first_index == 39 * k
        assert np.array_equal(each.counts, block(39 * k).counts)


@traced
def test_killed_at_each_call(tmp_path: Path) -> None:
    """Kill -9 after each call that changes a file: it opens, and all that was acknowledged is there."""
    disk = traced_disk(10)
    for after in range(len(disk.steps) + 1):
        folder = tmp_path / str(after)
        folder.mkdir()
        check_cut(folder / "r.sqlite", disk.cut(after, folder, None))
    assert len(disk.steps) > 100


@traced
@pytest.mark.parametrize("n_cuts", [80, pytest.param(100_000, marks=pytest.mark.campaign)])
def test_the_power_fails(tmp_path: Path, n_cuts: int) -> None:
    """Each sector not yet synced kept, dropped or garbled: it opens, and what was acknowledged is there."""
    disk = traced_disk(10)
    rng = np.random.default_rng(5)
    folder = tmp_path / "disk"
    for _ in range(n_cuts):
        folder.mkdir()
        check_cut(folder / "r.sqlite", disk.cut(int(rng.integers(len(disk.steps) + 1)), folder, rng))
        shutil.rmtree(folder)


@traced
def test_the_power_cut_model_finds_what_is_not_synced(tmp_path: Path) -> None:
    """Power check: were no sync heeded, acknowledged blocks would be lost."""
    disk = traced_disk(10)
    other = Disk("", "r.sqlite")
    other.steps = [step for step in disk.steps if step.name != "sync"]
    rng = np.random.default_rng(6)
    lost = 0
    for number in range(30):
        folder = tmp_path / str(number)
        folder.mkdir()
        acknowledged = other.cut(len(other.steps), folder, rng)
        try:
            check_cut(folder / "r.sqlite", acknowledged)
        except AssertionError:
            lost += 1
    assert lost > 15


FAILURES = [
    ("pwrite64:error=ENOSPC", 60, "database or disk is full"),
    ("pwrite64:error=EIO", 45, "disk I/O error"),
    ("pwrite64:error=EROFS", 45, "disk I/O error"),  # a disk in trouble that the system has made read-only
    ("fdatasync:error=EIO", 12, "disk I/O error"),
]
SAID_WITHIN = 1.0  #: s after a call has failed, and the process ended


def fails_at(tmp_path: Path, fault: str, when: int, message: str) -> bool:
    """Let a call fail; assert that it is said and that nothing acknowledged is lost; return whether it came to it."""
    path, log = tmp_path / f"{when}.sqlite", tmp_path / "log"
    of_record = [option for end in ("", "-wal", "-shm", "-journal") for option in ("-P", f"{path}{end}")]
    options = ("-y", "-ttt", "-o", str(log), "-e", TRACED, "-e", f"inject={fault}:when={when}+", *of_record)
    done = strace(*options, path=path, n_blocks=30)
    acknowledged = len(done.stdout.split()) // 2
    if done.returncode == 0:
        assert acknowledged == 30
        return False
    assert done.returncode == 5, done.stderr
    assert message in done.stderr or ("created" in done.stderr and "disk I/O error" in done.stderr)
    assert len(done.stderr.strip().splitlines()) == 1
    check_cut(path, acknowledged)
    calls = log.read_text().splitlines()
    failed = next(number for number, line in enumerate(calls) if "INJECTED" in line)
    (ended,) = (line for line in calls[failed:] if "+++ exited with 5 +++" in line)
    assert instant(ended) - instant(calls[failed]) < SAID_WITHIN
    if fault.startswith("fdatasync") and "created" not in done.stderr:
        assert not [line for line in calls[failed + 1 :] if "sync(" in line]
    return True


def instant(call: str) -> float:
    """Return when a traced call was made, in s."""
    return float(call.split()[1])


@traced
@pytest.mark.parametrize(("fault", "when", "message"), FAILURES, ids=[fault for fault, _, _ in FAILURES])
def test_a_failing_disk_is_named(tmp_path: Path, fault: str, when: int, message: str) -> None:
    """From some call on the disk fails: one sentence in 1 s, exit code 5, all acknowledged kept, no sync retried."""
    assert fails_at(tmp_path, fault, when, message)


@traced
@pytest.mark.campaign
@pytest.mark.parametrize("fault", ["pwrite64:error=ENOSPC", "pwrite64:error=EIO", "fdatasync:error=EIO",
                                   "fsync:error=EIO", "ftruncate:error=EIO", "openat:error=EIO",
                                   "pwrite64:error=EROFS", "fdatasync:error=EROFS", "openat:error=EROFS"])  # fmt: skip
def test_a_disk_that_fails_at_any_call(tmp_path: Path, fault: str) -> None:
    """The same at each call of the recording, however early."""
    message = "full" if "ENOSPC" in fault else ""
    path, log = tmp_path / "whole.sqlite", tmp_path / "whole"
    strace("-y", "-o", str(log), "-e", TRACED, path=path, n_blocks=30)
    name = fault.partition(":")[0]
    n_calls = sum(f" {name}(" in line and "whole.sqlite" in line for line in log.read_text().splitlines())
    for when in range(1, n_calls + 1):
        fails_at(tmp_path, fault, when, message)


@traced
def test_interrupted_calls_are_made_again(tmp_path: Path) -> None:
    """EINTR is no failure."""
    done = strace(
        "-o", "/dev/null", "-e", "inject=pwrite64:error=EINTR:when=5+7", path=tmp_path / "r.sqlite", n_blocks=10
    )
    assert done.returncode == 0, done.stderr
    check_cut(tmp_path / "r.sqlite", 10)


def test_a_file_that_cannot_grow(tmp_path: Path) -> None:
    """A limit on the size of files, with writes cut short by it: one sentence, and all acknowledged is kept."""
    path = tmp_path / "r.sqlite"
    done = subprocess.run(
        [*CHILD, str(path), "200", "200000"], capture_output=True, text=True, timeout=120, check=False
    )  # fmt: skip
    assert done.returncode == 5
    assert "cannot be written" in done.stderr
    check_cut(path, len(done.stdout.split()) // 2)
    assert len(done.stdout.split()) > 4


def test_a_disk_that_stalls(tmp_path: Path) -> None:
    """A minute without a sign of the disk is named; what was taken before is kept, and nothing ever waits for it."""
    path = tmp_path / "r.sqlite"
    recorder = Recorder(path, lambda: 1.0)
    recorder.flush()
    stranger = sqlite3.connect(path, isolation_level=None)
    stranger.execute("BEGIN IMMEDIATE")
    recorder.add_block(block(0))
    recorder.write()
    while not recorder.delay:  # until the writer has got it
        time.sleep(0)
    since = time.monotonic()
    recorder._writer._monotonic = lambda: since + 5.0
    recorder.add_block(block(39))
    recorder.write()
    recorder._writer._monotonic = lambda: since + STALL_TIMEOUT + 1.0
    recorder.add_block(block(78))
    with pytest.raises(RecordError, match="the disk has taken nothing for 60 s"):
        recorder.write()
    stranger.execute("ROLLBACK")
    stranger.close()
    recorder.close()
    with Record(path) as record:
        assert [each.first_index for each in record.blocks()] == [0, 39]


@traced
@pytest.mark.campaign
def test_a_disk_that_stalls_for_5_s(tmp_path: Path) -> None:
    """An fdatasync that takes 5 s costs nothing."""
    done = strace(
        "-o", "/dev/null", "-e", "inject=fdatasync:delay_enter=5s:when=9", path=tmp_path / "r.sqlite", n_blocks=20
    )
    assert done.returncode == 0
    assert examine(tmp_path / "r.sqlite").n_samples == 20 * 39


@pytest.mark.parametrize("n_kills", [20, pytest.param(10_000, marks=pytest.mark.campaign)])
def test_killed_at_any_moment(tmp_path: Path, n_kills: int) -> None:
    """Kill -9 of a process that records: the file opens, and what was acknowledged is there."""
    rng = np.random.default_rng(8)
    with subprocess.Popen([*CHILD, "-"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1) as server:
        assert server.stdin is not None
        assert server.stdout is not None
        for number in range(n_kills):
            path = tmp_path / f"{number}.sqlite"
            server.stdin.write(f"{path}\n")
            pid = int(server.stdout.readline().removeprefix("pid "))
            said = [server.stdout.readline() for _ in range(int(rng.integers(1, 40)))]
            os.kill(pid, signal.SIGKILL)
            said += iter(server.stdout.readline, "gone\n")
            check_cut(path, int(said[-1].removeprefix("ack ")))
            assert examine(path).sound
            for file in tmp_path.glob(f"{number}.*"):
                file.unlink()
        server.stdin.close()


def test_room_is_asked_for_ahead(tmp_path: Path) -> None:
    """An hour of a fast triad needs some 120 MB, and a year of it more than there is."""
    assert 100e6 < expected_bytes(3600.0, 2000.0, 3) < 250e6
    with Recorder(tmp_path / "r.sqlite", lambda: 1.0) as recorder:
        recorder.require_space(60.0, 2000.0, 3)
        with pytest.raises(RecordError, match=r"MB free, the record of this plan takes up to .* MB: make room"):
            recorder.require_space(3e9, 2000.0, 3)


def test_long_blocks_are_cut(tmp_path: Path) -> None:
    """A block of any length goes into the record in parts of 32 KiB at most, no sample twice or missing."""
    whole = block(1000, 30_000)
    pieces = list(parts(replace(whole, n_lost=7), 2000.0))
    assert max(piece.counts.nbytes for piece in pieces) <= 1 << 15
    assert np.array_equal(np.concatenate([piece.counts for piece in pieces]), whole.counts)
    assert [piece.n_lost for piece in pieces] == [7] + [0] * (len(pieces) - 1)
    assert pieces[1].first_index == 1000 + len(pieces[0].counts)
    assert pieces[1].device_time == pytest.approx(whole.device_time + len(pieces[0].counts) / 2000.0)
    with Recorder(tmp_path / "r.sqlite", lambda: 1.0) as recorder:
        with pytest.raises(RecordError, match="too long for a record"):
            recorder.add_block(whole)
        fill(recorder, 1)


def test_what_is_no_number_is_not_recorded_as_one(tmp_path: Path) -> None:
    """An attitude that is nan fails at once and by name, rather than in the writer's thread."""
    with Recorder(tmp_path / "r.sqlite", lambda: 1.0) as recorder:
        with pytest.raises(RecordError, match="device_time of block has no value"):
            recorder.add_block(replace(block(0), device_time=float("nan")))
        recorder.add_block(replace(block(39), temperature=float("nan")))
    with Record(tmp_path / "r.sqlite") as record:
        assert [each.temperature for each in record.blocks()] == [None]
