"""Damaged records: every sound row is found, no altered one is taken for good, and the original is never changed."""

import hashlib
import shutil
import sqlite3
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from recording import block, fill, make_record

from northfinder.errors import RecordError
from northfinder.record import Record
from northfinder.record.check import examine
from northfinder.record.pages import rows_of_page, scan
from northfinder.record.recorder import Recorder
from northfinder.record.recovery import recover
from northfinder.record.schema import INSERT, PAGE_SIZE, TABLES, Row, checksum

Rows = dict[tuple[str, int], Row]
SECTOR = 512


def rows_of(path: Path) -> Rows:
    """Return all sound rows that are found in a file and its log."""
    return {(table, row[0]): row for table, row in scan(path)}


def rows_in(page: bytes, fetch: Callable[[int], bytes]) -> Rows:
    """Return the rows that begin in a page."""
    return {(table, row[0]): row for table, row in rows_of_page(page, fetch)}


class Pages:
    """The pages of a file, some of them damaged, and the rows that are found in each."""

    def __init__(self, data: bytes) -> None:
        """Take the sound file."""
        self.pages = [data[i : i + PAGE_SIZE] for i in range(0, len(data), PAGE_SIZE)]
        self.rows = [self.found(number, page) for number, page in enumerate(self.pages)]
        # Whose rows go on in another page is asked again if that page is damaged.
        self.long = [number for number, page in enumerate(self.pages) if self._needs_others(page)]

    def _needs_others(self, page: bytes) -> bool:
        return len(rows_in(page, lambda _: b"")) != len(rows_in(page, self.fetch({})))

    def fetch(self, damaged: dict[int, bytes]) -> Callable[[int], bytes]:
        """Return what reads pages, with those damaged in place of the sound ones."""
        return lambda number: damaged.get(number - 1, self.pages[number - 1]) if 0 < number <= len(self.pages) else b""

    def found(self, number: int, page: bytes) -> Rows:
        """Return the rows that begin in `page`, put in place of page `number`."""
        return rows_in(page, self.fetch({number: page}))

    def lost_by(self, number: int, page: bytes) -> list[Row]:
        """Return the rows lost when `page` stands in place of page `number`; no row may be found that was not there."""
        lost = []
        for each in {number, *self.long}:
            before = self.rows[each]
            content = page if each == number else self.pages[each]
            after = rows_in(content, self.fetch({number: page}))
            assert after.items() <= before.items()
            lost += [row for key, row in before.items() if key not in after]
        return lost


def size(row: Row) -> int:
    """Return how many bytes a row takes, about."""
    return sum(len(value) if isinstance(value, bytes | str) else 8 for value in row)


FLIPS = [pytest.param(20, 64, id="small"), pytest.param(1700, 1, id="1-MiB", marks=pytest.mark.campaign)]


@pytest.mark.parametrize(("n_blocks", "stride"), FLIPS)
def test_a_flipped_byte_costs_its_own_row_at_most(tmp_path: Path, n_blocks: int, stride: int) -> None:
    """Each byte of the file, its bits flipped in some way: at most one row is lost, and none is altered."""
    pages = Pages(make_record(tmp_path / "r.sqlite", n_blocks).read_bytes())
    assert sum(map(len, pages.rows)) > n_blocks
    rng = np.random.default_rng(1)
    for number, page in enumerate(pages.pages):
        for offset in range(number % stride, PAGE_SIZE, stride):
            damaged = bytearray(page)
            damaged[offset] ^= int(rng.integers(1, 256))
            assert len(pages.lost_by(number, bytes(damaged))) <= 1


@pytest.mark.parametrize(("n_blocks", "n_hits"), [(20, 150), pytest.param(1700, 1_000_000, marks=pytest.mark.campaign)])
def test_a_trashed_sector_costs_less_than_a_block(tmp_path: Path, n_blocks: int, n_hits: int) -> None:
    """Random content in any 512 bytes: what is lost is less than 32 KiB, and no other row is altered."""
    pages = Pages(make_record(tmp_path / "r.sqlite", n_blocks).read_bytes())
    rng = np.random.default_rng(2)
    for _ in range(n_hits):
        number = int(rng.integers(len(pages.pages)))
        offset = SECTOR * int(rng.integers(PAGE_SIZE // SECTOR))
        page = pages.pages[number]
        damaged = page[:offset] + rng.bytes(SECTOR) + page[offset + SECTOR :]
        assert sum(map(size, pages.lost_by(number, damaged))) <= 1 << 15


@pytest.mark.parametrize(("n_blocks", "stride"), [(20, 131), pytest.param(1700, 1, marks=pytest.mark.campaign)])
def test_a_torn_file_gives_all_rows_before_the_tear(tmp_path: Path, n_blocks: int, stride: int) -> None:
    """Cut anywhere: all rows of whole pages are found, and whatever is found is as it was written."""
    pages = Pages(make_record(tmp_path / "r.sqlite", n_blocks).read_bytes())
    for cut in range(0, len(pages.pages) * PAGE_SIZE, stride):
        number, offset = divmod(cut, PAGE_SIZE)
        cut_away = dict.fromkeys(range(number + 1, len(pages.pages)), b"") | {number: pages.pages[number][:offset]}
        torn = rows_in(cut_away[number], pages.fetch(cut_away))
        assert torn.items() <= pages.rows[number].items()
    path = tmp_path / "r.sqlite"
    before = rows_of(path)
    path.write_bytes(path.read_bytes()[: len(pages.pages) // 2 * PAGE_SIZE])
    whole_pages: Rows = {}
    for number in range(len(pages.pages) // 2):
        whole_pages |= pages.rows[number]
    assert before.items() >= rows_of(path).items()
    assert len(rows_of(path)) >= len(whole_pages) - len(pages.long)


def content(record: Record) -> list[object]:
    """Return all that a record says, in a form that can be compared."""
    blocks = [(b.first_index, b.device_time, b.temperature, b.rate_lsb, b.counts.tobytes()) for b in record.blocks()]
    return [blocks, record.steps(), record.states(), record.events(), record.fixes(), record.meta("plan"),
            [info.stream for info in record.streams()]]  # fmt: skip


@pytest.mark.parametrize("n_hits", [80, pytest.param(20_000, marks=pytest.mark.campaign)])
def test_a_reader_gives_what_was_written_or_names_the_damage(tmp_path: Path, n_hits: int) -> None:
    """Through SQLite: after any flip the record reads as before, or there is one RecordError; never anything else."""
    path = make_record(tmp_path / "r.sqlite", 40)
    data = path.read_bytes()
    with Record(path) as record:
        expected = content(record)
    rng = np.random.default_rng(3)
    n_named = 0
    damaged = tmp_path / "d.sqlite"
    for _ in range(n_hits):
        flipped = bytearray(data)
        flipped[int(rng.integers(len(data)))] ^= int(rng.integers(1, 256))
        damaged.write_bytes(flipped)
        try:
            with Record(damaged) as record:
                assert content(record) == expected
        except RecordError:
            n_named += 1
    assert n_named > n_hits / 5


def test_recover_saves_the_rest_and_says_what_is_lost(tmp_path: Path) -> None:
    """A record whose tree is broken in the middle: the new one is sound, what is lost is named, the old as it was."""
    path = make_record(tmp_path / "r.sqlite", 200)
    data = bytearray(path.read_bytes())
    pages = [number for number, rows in enumerate(Pages(bytes(data)).rows) if ("block", 100) in rows]
    for page in pages:
        data[PAGE_SIZE * page : PAGE_SIZE * page + 700] = bytes(700)
    path.write_bytes(data)
    checksum = hashlib.sha256(data).hexdigest()
    assert not examine(path).sound
    with Record(path) as record, pytest.raises(RecordError, match="northfinder recover saves the rest"):
        list(record.blocks())
    salvage = recover(path, tmp_path / "new.sqlite")
    assert hashlib.sha256(path.read_bytes()).hexdigest() == checksum
    assert {file.name for file in tmp_path.iterdir()} == {"r.sqlite", "new.sqlite"}
    assert salvage.closed
    assert 0 < salvage.n_lost < 20
    assert examine(tmp_path / "new.sqlite").sound
    with Record(tmp_path / "new.sqlite") as record:
        blocks = list(record.blocks())
        assert len(blocks) == salvage.found["block"] >= 190
        for each in blocks:
            assert np.array_equal(each.counts, block(each.first_index).counts)
        kind, detail = record.events()[-1][1:]
        assert kind == "recovered"
        assert "rows of block lost" in detail


def test_recover_reads_the_log_of_a_process_that_died(tmp_path: Path) -> None:
    """What stands only in the write-ahead log is saved too, also where the file itself is gone to nothing."""
    recorder = Recorder(tmp_path / "r.sqlite", lambda: 1.0)
    fill(recorder, 50)
    recorder.flush()
    for name in ("r.sqlite", "r.sqlite-wal"):
        shutil.copy(tmp_path / name, tmp_path / f"dead-{name}")
    recorder.close()
    expected = {key: row for key, row in rows_of(tmp_path / "r.sqlite").items() if row[1] != "closed"}
    assert rows_of(tmp_path / "dead-r.sqlite") == expected
    (tmp_path / "dead-r.sqlite").write_bytes(b"")
    salvage = recover(tmp_path / "dead-r.sqlite", tmp_path / "new.sqlite")
    assert sum(salvage.found.values()) == len(expected)
    assert not salvage.closed
    assert "not closed" in " ".join(salvage.sentences())


def test_recover_refuses_what_is_no_record_and_overwrites_nothing(tmp_path: Path) -> None:
    """Noise holds no row; a file that is there stays as it is."""
    noise = tmp_path / "noise"
    noise.write_bytes(np.random.default_rng(4).bytes(200_000))
    with pytest.raises(RecordError, match="holds no row of a record"):
        recover(noise, tmp_path / "new.sqlite")
    assert not (tmp_path / "new.sqlite").exists()
    path = make_record(tmp_path / "r.sqlite", 5)
    (tmp_path / "there.sqlite").write_bytes(b"precious")
    with pytest.raises(RecordError, match="exists already"):
        recover(path, tmp_path / "there.sqlite")
    assert (tmp_path / "there.sqlite").read_bytes() == b"precious"


@pytest.mark.parametrize("table", [table for table in TABLES if table != "note"])
def test_every_value_of_a_row_is_under_its_seal(tmp_path: Path, table: str) -> None:
    """A value changed by SQLite's own means, in any column of any table, is found; so is a row that was taken away."""
    path = make_record(tmp_path / "r.sqlite", 12)
    for column in TABLES[table]:
        changed = {"TEXT": "'other'", "BLOB": "zeroblob(468)", "INTEGER": "77", "REAL": "77.5"}[column.kind]
        copy = tmp_path / f"{column.name}.sqlite"
        shutil.copy(path, copy)
        alter(copy, f"UPDATE {table} SET {column.name} = {changed} WHERE id = 1")  # noqa: S608  # names of ours
        with Record(copy) as record, pytest.raises(RecordError, match=f"row 1 of {table} does not match its checksum"):
            list(record.rows(table))
        assert [line for line in examine(copy).damage if f"row 1 of {table} does not match" in line]
    alter(path, f"DELETE FROM {table} WHERE id = 1")  # noqa: S608  # names of ours
    assert not examine(path).sound
    if table in {"meta", "block", "stage_state", "step"}:  # with other rows after it
        with Record(path) as record, pytest.raises(RecordError, match=f"row 1 of {table} is missing"):
            list(record.rows(table))


def alter(path: Path, statement: str) -> None:
    """Do something to a record that no program of ours does."""
    with sqlite3.connect(path) as db:
        db.execute(statement)
    db.close()


def test_rows_cut_off_at_the_end_are_missed(tmp_path: Path) -> None:
    """A closed record knows how many rows it had."""
    path = make_record(tmp_path / "r.sqlite", 12)
    alter(path, "DELETE FROM block WHERE id > 10")
    assert "block ends at row 10 of 12" in examine(path).damage
    with Record(path) as record, pytest.raises(RecordError, match="row 11 of block is missing"):
        list(record.blocks())


HOSTILE = [
    ("counts", b"1234567"),
    ("n_samples", -39),
    ("n_axes", 0),
    ("dtype", "<c16"),
    ("rate_lsb", None),
    ("counts", None),
    ("status", None),
    ("n_samples", 2**62),
]


@pytest.mark.parametrize(("column", "value"), HOSTILE)
def test_a_hostile_block_with_a_right_seal_is_refused(tmp_path: Path, column: str, value: object) -> None:
    """Whoever can seal a row still cannot make the reader fail in any other way than by naming the row."""
    path = make_record(tmp_path / "r.sqlite", 3)
    names = [each.name for each in TABLES["block"]]
    with sqlite3.connect(path) as db:
        row = list(db.execute("SELECT * FROM block WHERE id = 2").fetchone())
        row[1 + names.index(column)] = value
        db.execute("DELETE FROM block WHERE id = 2")
        db.execute(INSERT["block"], (*row[:-1], checksum("block", row[:-1])))
    db.close()
    with Record(path) as record, pytest.raises(RecordError, match="row 2 of block"):
        list(record.blocks())


def test_a_giant_value_is_never_loaded(tmp_path: Path) -> None:
    """A blob of 200 MB in the file costs one sentence and no memory."""
    path = make_record(tmp_path / "r.sqlite", 3)
    alter(path, "UPDATE block SET counts = zeroblob(200000000) WHERE id = 2")
    tracemalloc.start()
    with Record(path) as record, pytest.raises(RecordError, match="too big"):
        list(record.blocks())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1e6


def test_reading_pages_takes_the_same_memory_for_any_record(tmp_path: Path) -> None:
    """Blocks of 32 KiB each: a few of them are held at a time, however many there are."""
    peaks = []
    for n_blocks in (4, 16):
        path = make_record(tmp_path / f"{n_blocks}.sqlite", n_blocks, n=2730)
        tracemalloc.start()
        n_found = sum(table == "block" for table, _ in scan(path))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert n_found == n_blocks
    assert peaks[1] < 1.2 * peaks[0]
    assert peaks[1] < 8 * 32_768
