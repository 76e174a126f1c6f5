"""Files that are no records, records that somebody has made up, and names that are none: one sentence each."""

import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from recording import fill, make_record
from test_cli_records import json_of, run

from northfinder.errors import RecordError
from northfinder.record import Record
from northfinder.record.files import new_file
from northfinder.record.recorder import Recorder
from northfinder.record.recovery import recover
from northfinder.record.schema import INSERT, TABLES, checksum
from northfinder.record.writer import create

COMMANDS = ("show", "check", "solve", "resume", "recover", "export", "note")
#: s, for a command that must not wait for anything.
PATIENCE = 60


def arguments(command: str, path: Path) -> list[str]:
    """Return how a command is given a record."""
    more = {"note": ["a lorry"], "export": ["--to", "csv"]}.get(command, [])
    return [command, *more, "--", str(path)]


def refused(capsys: pytest.CaptureFixture[str], command: str, path: Path) -> str:
    """Run a command that must end with exit code 5 and one sentence; return the sentence."""
    code, out, err = run(capsys, *arguments(command, path))
    assert (code, out, len(err.splitlines())) == (5, "", 1), err
    assert err.startswith("northfinder: ")
    return err


def in_time(*given: str) -> subprocess.CompletedProcess[str]:
    """Run a command in a process of its own, which must end by itself."""
    return subprocess.run(
        [sys.executable, "-m", "northfinder", *given], capture_output=True, text=True, timeout=PATIENCE, check=False
    )


@pytest.mark.parametrize("command", COMMANDS)
def test_a_pipe_is_not_waited_for(tmp_path: Path, command: str) -> None:
    """Nobody writes into it, so whoever opened it would wait for ever."""
    os.mkfifo(tmp_path / "r.sqlite")
    ended = in_time(*arguments(command, tmp_path / "r.sqlite"))
    assert (ended.returncode, ended.stdout) == (5, "")
    assert "found a pipe or a device, expected a file" in ended.stderr
    assert len(ended.stderr.splitlines()) == 1


@pytest.mark.parametrize("command", ["show", "check", "solve", "export", "note"])
@pytest.mark.parametrize("ending", ["-journal", "-wal", "-shm"])
def test_a_pipe_beside_the_record_is_not_waited_for(tmp_path: Path, command: str, ending: str) -> None:
    """SQLite would open it, as a rest of what was cut off."""
    path = make_record(tmp_path / "r.sqlite", 3)
    os.mkfifo(f"{path}{ending}")
    ended = in_time(*arguments(command, path))
    assert (ended.returncode, ended.stdout) == (5, "")
    assert f"found r.sqlite{ending}, expected a file there or nothing" in ended.stderr


def test_a_pipe_in_the_folder_is_listed_as_damaged(tmp_path: Path) -> None:
    """The other records are listed, and the newest of them takes the note."""
    os.mkfifo(tmp_path / "z.sqlite")
    make_record(tmp_path / "a.sqlite", 3)
    ended = in_time("records", str(tmp_path), "--json")
    assert [line["state"] for line in json.loads(ended.stdout)["records"]] == ["damaged", "complete"]
    assert in_time("note", "wind", "--in", str(tmp_path)).returncode == 0


@pytest.mark.parametrize("command", COMMANDS)
def test_names_and_kinds_of_files_that_cannot_be(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    """A name that is too long, a folder, a link to itself, a file as folder."""
    assert "File name too long" in refused(capsys, command, tmp_path / ("a" * 300))
    for folder in (tmp_path, Path("/"), Path()):
        assert "found a folder, expected a file" in refused(capsys, command, folder)
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    assert "symbolic links" in refused(capsys, command, tmp_path / "loop")
    (tmp_path / "file").touch()
    assert "Not a directory" in refused(capsys, command, tmp_path / "file" / "r.sqlite")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
@pytest.mark.parametrize("command", COMMANDS)
def test_a_file_that_may_not_be_read(tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str) -> None:
    """That is about a file, exit code 5, not about how the command was given."""
    path = make_record(tmp_path / "r.sqlite", 3)
    path.chmod(0)
    assert "r.sqlite" in refused(capsys, command, path)


def test_an_empty_file_and_a_torn_record_are_called_what_they_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither is another kind of SQLite file, and of the torn one most can be saved."""
    (tmp_path / "empty.sqlite").touch()
    assert "empty.sqlite is no record of a measurement: it is empty" in refused(
        capsys, "show", tmp_path / "empty.sqlite"
    )
    path = make_record(tmp_path / "r.sqlite", 200)
    path.write_bytes(path.read_bytes()[:-16_384])
    assert "northfinder recover saves the rest" in refused(capsys, "show", path)
    assert recover(path, tmp_path / "new.sqlite").found["block"] > 0


ENDLESS = (
    "CREATE VIEW event AS WITH RECURSIVE c(i) AS (SELECT 1 UNION ALL SELECT i FROM c) "
    "SELECT i AS id, 0 AS stream, 1.0 AS time, '' AS kind, '' AS detail, 0 AS crc FROM c WHERE i = 2"
)
FOREVER = "CREATE TRIGGER t AFTER INSERT ON note BEGIN DELETE FROM event; END"


@pytest.mark.parametrize("statements", [["DROP TABLE event", ENDLESS], [FOREVER]])
@pytest.mark.parametrize("command", ["show", "check", "note", "export"])
def test_a_record_runs_no_program(tmp_path: Path, statements: list[str], command: str) -> None:
    """A table that is a view without end is not read, and a note sets nothing off."""
    path = make_record(tmp_path / "r.sqlite", 3)
    with sqlite3.connect(path) as db:
        for statement in statements:
            db.execute(statement)
    db.close()
    before = path.read_bytes()
    ended = in_time(*arguments(command, path))
    assert ended.returncode == 5
    assert "expected plain tables alone" in ended.stderr
    assert path.read_bytes() == before


def forge(path: Path, table: str, column: str, value: object, *, key: str = "") -> None:
    """Give a record another value, with the seal that goes with it."""
    where = f"WHERE key = '{key}'" if key else ""
    with sqlite3.connect(path) as db:
        row = list(db.execute(f"SELECT * FROM {table} {where} ORDER BY id DESC").fetchone())  # noqa: S608  # names of ours
        row[1 + [each.name for each in TABLES[table]].index(column)] = value
        db.execute(f"DELETE FROM {table} WHERE id = {row[0]}")  # noqa: S608  # names of ours
        db.execute(INSERT[table], (*row[:-1], checksum(table, row[:-1])))
    db.close()


@pytest.mark.parametrize(
    ("table", "column", "value"),
    [
        ("step", "step", 1 << 31), ("step", "step", -1), ("step", "sample_rate", 0.0), ("step", "sample_rate", 1e308),
        ("step", "sample_rate", float("inf")), ("step", "stream_start", 1e308), ("step", "measured_azimuth", 1e308),
        ("step", "stop_index", 0), ("step", "first_index", -1), ("step", "stream", 1 << 40), ("step", "turn_on", -1),
        ("stream", "sample_rate", 0.0), ("stream", "stream", 1 << 31), ("stream", "n_axes", 0),
    ],
)  # fmt: skip
def test_numbers_that_cannot_be_are_damage(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], table: str, column: str, value: float
) -> None:
    """Whoever can seal a row makes no command fail in any other way than by naming the row."""
    path = make_record(tmp_path / "r.sqlite", 3)
    forge(path, table, column, value)
    assert f"of {table} is no" in refused(capsys, "export", path)


@pytest.mark.parametrize("value", ["[1]", '"x"', "5", '{"gyro": 1}', "null"])
@pytest.mark.parametrize("key", ["plan", "identities"])
def test_entries_of_another_form_are_not_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], key: str, value: str
) -> None:
    """`records` lists such a record and the ones beside it, and `show` shows the rest of it."""
    path = make_record(tmp_path / "r.sqlite", 3)
    with Recorder(path, lambda: 1.7e9, resume=True) as recorder:
        recorder.set_meta(key, 0)
    forge(path, "meta", "value", value, key=key)
    (listed,) = json_of(capsys, "records", str(tmp_path))["records"]
    assert listed["state"] == "complete"
    assert run(capsys, "show", str(path))[0] == 0


NO_UNICODE = os.fsdecode(b"r\xff.sqlite")


@pytest.mark.parametrize(
    "name", ["r\x1b[2J.sqlite", "r\u202e.sqlite", "r\n.sqlite", "-r.sqlite", "r?#%41.sqlite", NO_UNICODE]
)
def test_names_of_all_sorts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """Every command takes them, shows them harmlessly on one line, and writes valid JSON."""
    monkeypatch.chdir(tmp_path)
    make_record(Path(name), 30)
    for command in ("show", "check", "note", "export", "recover"):
        given = arguments(command, Path(name))
        code, out, err = run(capsys, *given)
        assert (code, err) == (0, ""), command
        assert not {"\x1b", "\u202e", "\udcff"} & set(out)
        for left in tmp_path.iterdir():
            if left.name != name:
                left.unlink()
        code, out, err = run(capsys, given[0], "--json", *given[1:])
        assert (code, err) == (0, ""), command
        assert "r" in str(json.loads(out))
        Path(name).with_suffix(".csv").unlink(missing_ok=True)
        for left in tmp_path.glob("*-recovered*"):
            left.unlink()
    assert len(json_of(capsys, "records", ".")["records"]) == 1
    code, out, _ = run(capsys, "records", ".")
    assert (code, len(out.splitlines())) == (0, 2)


def test_a_folder_whose_name_is_no_unicode_keeps_the_fix(tmp_path: Path) -> None:
    """The name of the record stands in the fix, which is the last thing written."""
    path = tmp_path / NO_UNICODE
    with Recorder(path, lambda: 1.0) as recorder:
        recorder.add_fix({"record": str(path), "azimuth_deg": 33.0})
    with Record(path) as record:
        assert record.fixes()[0]["azimuth_deg"] == 33.0


def cut_while_recording(folder: Path) -> Path:
    """Return a record as a process that died has left it, most of it in the log."""
    folder.mkdir()
    recorder = Recorder(folder / "live.sqlite", lambda: 1.0)
    fill(recorder, 50)
    recorder.flush()
    for name in ("live.sqlite", "live.sqlite-wal"):
        shutil.copy(folder / name, folder / name.replace("live", "dead"))
    recorder.close()
    return folder / "dead.sqlite"


def test_recover_reads_the_log_behind_a_link_and_a_log_alone(tmp_path: Path) -> None:
    """The log lies beside the file, not beside the link; and where the file is gone the log still holds rows."""
    dead = cut_while_recording(tmp_path / "real")
    (tmp_path / "link.sqlite").symlink_to(dead)
    assert recover(tmp_path / "link.sqlite", tmp_path / "a.sqlite").found["block"] == 50
    dead.unlink()
    with pytest.raises(RecordError, match="its log is there: northfinder recover saves what that holds"):
        Record(dead)
    assert recover(dead, tmp_path / "b.sqlite").found["block"] == 50


def test_a_record_that_is_being_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing invites to resume it, and what is recovered from it is said to be a part."""
    path = tmp_path / "r.sqlite"
    with Recorder(path, lambda: 1.0) as recorder:
        recorder.add_event("state", "slew")
        recorder.flush()
        code, out, _ = run(capsys, "check", str(path))
        assert (code, "resume" in out, "being written" in out) == (0, False, True)
        code, out, _ = run(capsys, "recover", str(path))
        assert code == 0
        assert "what comes from now on is not saved" in out


def test_check_goes_on_after_a_file_that_is_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every record given is examined and told of, in text and as JSON, each once."""
    good, bad = make_record(tmp_path / "good.sqlite", 3), tmp_path / "none.sqlite"
    code, out, err = run(capsys, "check", str(bad), str(good), str(good))
    assert (code, out.count("sound"), len(err.splitlines())) == (5, 1, 1)
    code, out, err = run(capsys, "check", "--json", str(bad), str(good), str(good))
    assert (code, len(err.splitlines())) == (5, 1)
    first, second = json.loads(out)["records"]
    assert (first["sound"], second["sound"]) == (False, True)
    assert "No such file" in first["found"]["damage"][0]


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("", "nothing to read"),
        (" \n ", "nothing to read"),
        ("\x1b\x07", "2 characters"),
        ("a" * 4001, "4001 characters"),
    ],
)
def test_notes_that_say_nothing_or_too_much(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, found: str
) -> None:
    """What was found, what is expected, exit code 2, and nothing is written."""
    path = make_record(tmp_path / "r.sqlite", 3)
    before = path.read_bytes()
    code, _, err = run(capsys, "note", text, str(path))
    assert code == 2
    assert f"found {found}, expected 1 to 4000 characters" in err
    assert path.read_bytes() == before


def test_a_note_that_is_the_name_of_a_record(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Somebody has forgotten the note: it does not go into the newest record instead."""
    path = make_record(tmp_path / "r.sqlite", 3)
    code, _, err = run(capsys, "note", str(path), "--in", str(tmp_path))
    assert code == 2
    assert "found the name of a file" in err
    with Record(path) as record:
        assert record.notes() == []


def test_a_note_of_several_lines_becomes_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With blanks between them, rather than question marks."""
    path = make_record(tmp_path / "r.sqlite", 3)
    assert json_of(capsys, "note", "wind\nand\train ", str(path)) == {"record": str(path), "text": "wind and rain"}
    with Record(path) as record:
        assert record.notes()[0][2] == "wind and rain"


def test_what_shall_be_written_goes_nowhere_else(tmp_path: Path) -> None:
    """No file and no link is overwritten, also none of a name that a half-written file might have had."""
    path = make_record(tmp_path / "r.sqlite", 30)
    (tmp_path / "out.csv.part").write_text("precious")
    (tmp_path / "link.csv").symlink_to(tmp_path / "nothing")
    with pytest.raises(RecordError, match="exists already"), new_file(tmp_path / "link.csv"):
        pass
    with pytest.raises(RecordError, match=r"the folder .* cannot be made: File exists"):
        create(path / "r.sqlite")
    with pytest.raises(RecordError, match="File name too long"), new_file(tmp_path / ("a" * 300)) as part:
        part.write_text("x")
    with new_file(tmp_path / "out.csv") as part:
        part.write_text("x")
    assert (tmp_path / "out.csv.part").read_text() == "precious"
    assert {each.name for each in tmp_path.iterdir()} == {"r.sqlite", "out.csv.part", "link.csv", "out.csv"}


#: Lets files have so many bytes at the most, which is what a full disk looks like.
NO_ROOM = "import resource, sys; n = int(sys.argv[1]); resource.setrlimit(resource.RLIMIT_FSIZE, (n, n)); "
COMMAND = "from northfinder.cli import main; main(sys.argv[2:])"
BEGINNING = (
    "from pathlib import Path; from northfinder.record.recorder import Recorder; Recorder(Path(sys.argv[2]), float)"
)


def without_room(room: int, program: str, *given: str) -> subprocess.CompletedProcess[str]:
    """Run a program whose files may have `room` bytes."""
    return subprocess.run(
        [sys.executable, "-c", NO_ROOM + program, str(room), *given],
        capture_output=True, text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip


@pytest.mark.parametrize("room", [1, 10_000, 60_000])
@pytest.mark.parametrize(
    "given", [["recover"], *(["export", "--to", kind] for kind in ("csv", "parquet", "npz", "mat"))]
)
def test_a_disk_without_room_is_left_as_it_was(tmp_path: Path, given: list[str], room: int) -> None:
    """One sentence, exit code 5, and nothing but the record."""
    path = make_record(tmp_path / "r.sqlite", 400)
    ended = without_room(room, COMMAND, *given, str(path))
    assert (ended.returncode, ended.stdout, len(ended.stderr.splitlines())) == (5, "", 1), ended.stderr
    assert [each.name for each in tmp_path.iterdir()] == ["r.sqlite"]


@pytest.mark.parametrize("room", [1, 10_000, 60_000])
def test_a_record_that_cannot_be_begun_is_no_file(tmp_path: Path, room: int) -> None:
    """An empty file would be listed as a damaged record."""
    ended = without_room(room, BEGINNING, str(tmp_path / "r.sqlite"))
    assert "cannot be created" in ended.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def long_record(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a record that takes seconds to export or to recover."""
    return make_record(tmp_path_factory.mktemp("long") / "r.sqlite", 4000, n=250)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("given", [["export", "--to", "csv"], ["export", "--to", "npz"], ["recover"]])
def test_an_interruption_leaves_nothing_that_looks_whole(
    tmp_path: Path, long_record: Path, given: list[str], number: signal.Signals
) -> None:
    """As soon as it writes: Ctrl-C, a termination, a closed terminal; exit code 130, one sentence, no file."""
    process = subprocess.Popen(
        [sys.executable, "-m", "northfinder", *given, str(long_record), "--out", str(tmp_path / "out")],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    pause, looks = threading.Event(), 10_000
    for _ in range(looks):
        if list(tmp_path.iterdir()):
            break
        pause.wait(0.005)
    process.send_signal(number)
    out, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, out, err.strip()) == (130, "", "northfinder: interrupted")
    assert list(tmp_path.iterdir()) == []
