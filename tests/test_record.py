"""The record: what goes in comes out, also after a crash; damage and strangers are named."""

import os
import signal
import sqlite3
import subprocess
import sys
from itertools import chain, repeat
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.api import GyroStatus, RateBlock, StageMode, StageState
from northfinder.errors import RecordError
from northfinder.record import DwellSpan, Record
from northfinder.record.recorder import WRITE_PERIOD, Recorder


def now() -> float:
    """Return an odd instant."""
    return 100.25


def block(first_index: int, n: int = 4, *, n_axes: int = 1, lost: int = 0) -> RateBlock:
    """Return a block with no two counts alike."""
    counts = np.arange(first_index, first_index + n * n_axes, dtype=np.int32).reshape(n, n_axes) * 1021 - 7
    return RateBlock(
        first_index=first_index, device_time=first_index / 235, arrival_time=1.5 + first_index / 235, counts=counts,
        rate_lsb=4.7e-9, temperature=24.5, tilt=(1e-5, -2e-5), status=GyroStatus.OVERRUN, n_lost=lost,
    )  # fmt: skip


STATE = StageState(
    device_time=7.25, arrival_time=8.5, mode=StageMode.MOVING, azimuth=1.25, elevation=-0.5, azimuth_rate=0.2,
    elevation_rate=-0.1, in_position=False, fault="",
)  # fmt: skip
SPAN = DwellSpan(
    step=0, name="U1", azimuth=0.0, elevation=0.1, dwell=120.0, measured_azimuth=1e-6, measured_elevation=0.100001,
    first_index=4, stop_index=12, sample_rate=235.0,
)  # fmt: skip


def same_block(one: RateBlock, other: RateBlock) -> bool:
    """Whether two blocks hold the same, bit for bit."""
    names = ("first_index", "device_time", "arrival_time", "rate_lsb", "temperature", "tilt", "status", "n_lost")
    same = all(getattr(one, name) == getattr(other, name) for name in names)
    return same and one.counts.dtype == other.counts.dtype and np.array_equal(one.counts, other.counts)


def test_a_record_returns_what_was_put_in(tmp_path: Path) -> None:
    """Blocks, states, steps, events, fixes and meta data come back as they were; one file is left."""
    path = tmp_path / "deep" / "north.sqlite"
    blocks = [block(0), block(4, n_axes=3), block(10, lost=2)]
    with Recorder(path, now) as recorder:
        recorder.set_meta("plan", {"name": "six-position", "dwells": [1, 2.5]})
        for each in blocks:
            recorder.add_block(each)
        recorder.add_state(STATE)
        recorder.add_step(SPAN)
        recorder.add_event("fault", "STALL")
        recorder.add_fix({"azimuth_deg": 33.25})
        assert (recorder.n_samples, recorder.n_lost) == (12, 2)
    assert [entry.name for entry in path.parent.iterdir()] == ["north.sqlite"]
    with Record(path) as record:
        assert all(same_block(a, b) for a, b in zip(record.blocks(), blocks, strict=True))
        assert [each.first_index for each in record.blocks(4, 8)] == [4]
        assert record.states() == [STATE]
        assert record.steps() == [SPAN]
        assert record.events() == [(100.25, "fault", "STALL")]
        assert record.fixes() == [{"azimuth_deg": 33.25}]
        assert record.meta("plan") == {"name": "six-position", "dwells": [1, 2.5]}
        assert record.meta("nothing") is None


@given(
    counts=st.lists(st.integers(-(2**31), 2**31 - 1), min_size=1, max_size=300),
    floats=st.booleans(),
)
@settings(max_examples=12)
def test_counts_survive_bit_for_bit(tmp_path_factory: pytest.TempPathFactory, counts: list[int], floats: bool) -> None:  # noqa: FBT001
    """Any int32, and any float32 a gyro may send, comes back exactly."""
    path = tmp_path_factory.mktemp("record") / "north.sqlite"
    array = np.array(counts, np.int32).reshape(-1, 1)
    sent = RateBlock(
        first_index=0, device_time=0.0, arrival_time=0.0, counts=(array / 7).astype(np.float32) if floats else array,
        rate_lsb=1.0,
    )  # fmt: skip
    with Recorder(path, now) as recorder:
        recorder.add_block(sent)
    with Record(path) as record:
        (read,) = record.blocks()
    assert same_block(sent, read)


def test_what_has_arrived_is_handed_over_in_time(tmp_path: Path) -> None:
    """Another process sees a block as soon as the write period has passed, the record still open."""
    path = tmp_path / "north.sqlite"
    instants = chain([0.0, WRITE_PERIOD / 2, WRITE_PERIOD], repeat(WRITE_PERIOD))
    with Recorder(path, lambda: next(instants)) as recorder:
        recorder.add_block(block(0))
        with Record(path) as record:
            assert list(record.blocks()) == []
        recorder.add_block(block(4))
        recorder._writer.flush()
        with Record(path) as record:
            assert [each.first_index for each in record.blocks()] == [0, 4]


def test_a_killed_recorder_leaves_a_readable_record(tmp_path: Path) -> None:
    """Kill -9 without closing: every block that was written is there."""
    path = tmp_path / "north.sqlite"
    program = (
        "import sys; sys.path.insert(0, sys.argv[2])\n"
        "from pathlib import Path\n"
        "from test_record import block, now\n"
        "from northfinder.record.recorder import Recorder\n"
        "recorder = Recorder(Path(sys.argv[1]), now)\n"
        "for k in range(50):\n"
        "    recorder.add_block(block(4 * k)); recorder.flush()\n"
        "print('written', flush=True)\n"
        "sys.stdin.read()\n"
    )
    child = subprocess.Popen(
        [sys.executable, "-c", program, str(path), str(Path(__file__).parent)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    with child:
        assert child.stdout is not None
        assert child.stdout.readline() == b"written\n"
        os.kill(child.pid, signal.SIGKILL)
    with Record(path) as record:
        assert [each.first_index for each in record.blocks()] == [4 * k for k in range(50)]


def test_a_record_is_never_overwritten(tmp_path: Path) -> None:
    """An existing file of that name is left as it is."""
    path = tmp_path / "north.sqlite"
    path.write_bytes(b"precious")
    with pytest.raises(RecordError, match="exists already"):
        Recorder(path, now)
    assert path.read_bytes() == b"precious"


def test_a_file_that_does_not_take_anything_holds_up_nobody(tmp_path: Path) -> None:
    """While another program has locked the file, blocks are taken as fast as ever, and are written once it lets go."""
    path = tmp_path / "north.sqlite"
    with Recorder(path, now) as recorder:
        stranger = sqlite3.connect(path, isolation_level=None)
        stranger.execute("BEGIN IMMEDIATE")
        for k in range(100):
            recorder.add_block(block(4 * k))
            recorder.write()
        with Record(path) as record:
            assert list(record.blocks()) == []
        stranger.execute("ROLLBACK")
        stranger.close()
    with Record(path) as record:
        assert [each.first_index for each in record.blocks()] == [4 * k for k in range(100)]


def test_a_full_disk_is_said_at_once(tmp_path: Path) -> None:
    """When the file cannot grow the next write fails with one sentence, and what was written stays readable."""
    path = tmp_path / "north.sqlite"
    recorder = Recorder(path, now)
    recorder.add_block(block(0))
    recorder.flush()
    pages = recorder._writer._db.execute("PRAGMA page_count").fetchone()[0]
    recorder._writer._db.execute(f"PRAGMA max_page_count = {pages}")
    recorder.add_block(block(4, n=8_000))
    with pytest.raises(RecordError, match=r"north.sqlite cannot be written: database or disk is full"):
        recorder.flush()
    recorder.add_block(block(8_004))  # taken no more, and not said again
    recorder.close()
    with Record(path) as record:
        assert [each.first_index for each in record.blocks()] == [0]


@pytest.mark.parametrize("content", [b"", b"not a database at all" * 100, b"SQLite format 3\x00" + bytes(100)])
def test_another_file_is_no_record(tmp_path: Path, content: bytes) -> None:
    """Empty, foreign and broken files are refused by name."""
    path = tmp_path / "other.sqlite"
    path.write_bytes(content)
    with pytest.raises(RecordError, match=r"other.sqlite is no record"):
        Record(path)


def test_a_record_of_another_version_is_refused(tmp_path: Path) -> None:
    """The sentence names both versions."""
    path = tmp_path / "north.sqlite"
    Recorder(path, now).close()
    with sqlite3.connect(path) as db:
        db.execute("PRAGMA user_version = 7")
    db.close()
    with pytest.raises(RecordError, match="no record of version 1: found version 7"):
        Record(path)


def test_a_missing_record_is_named(tmp_path: Path) -> None:
    """A path to nothing gives one sentence."""
    with pytest.raises(RecordError, match=r"none.sqlite: cannot be read: No such file"):
        Record(tmp_path / "none.sqlite")


def test_an_altered_block_is_found(tmp_path: Path) -> None:
    """One changed byte of the counts does not pass the checksum."""
    path = tmp_path / "north.sqlite"
    with Recorder(path, now) as recorder:
        recorder.add_block(block(0))
    with sqlite3.connect(path) as db:
        data = bytearray(db.execute("SELECT counts FROM block").fetchone()[0])
        data[5] ^= 1
        db.execute("UPDATE block SET counts = ?", (bytes(data),))
    db.close()
    with Record(path) as record, pytest.raises(RecordError, match="row 1 of block does not match its checksum"):
        list(record.blocks())
