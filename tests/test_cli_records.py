"""The commands about records, as users meet them: output, JSON and exit codes."""

import json
import os
import shutil
import sqlite3
from pathlib import Path
from typing import Any

import pytest
from recording import fill, make_record, span

from northfinder.cli import main
from northfinder.errors import RecordError
from northfinder.record import Record
from northfinder.record.lock import RecordLock, _locked, is_being_written
from northfinder.record.notes import add_note
from northfinder.record.recorder import Recorder


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    """Run a command and return exit code, standard output and standard error."""
    with pytest.raises(SystemExit) as left:
        main(list(arguments))
    assert isinstance(left.value.code, int)
    return left.value.code, *capsys.readouterr()


def json_of(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    """Return what a command says with --json."""
    code, out, err = run(capsys, *arguments, "--json")
    assert code == 0, err
    found: dict[str, Any] = json.loads(out)
    return found


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with a whole record, one that ends early, a damaged one, and something else."""
    make_record(tmp_path / "a.sqlite", 20, now=lambda: 1.7e9)
    with Recorder(tmp_path / "b.sqlite", lambda: 1.8e9) as recorder:
        recorder.set_meta("plan", {"name": "[red]double\x1b[2J", "steps": [1, 2]})
        recorder.add_event("state", "slew")
    shutil.copy(tmp_path / "a.sqlite", tmp_path / "c.sqlite")
    with sqlite3.connect(tmp_path / "c.sqlite") as db:
        db.execute("UPDATE event SET time = 1")
    db.close()
    (tmp_path / "d.sqlite").write_text("something else")
    return tmp_path


def test_records_lists_all_with_their_state(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Newest first by name; complete, ending early and damaged told apart, also while one is being written."""
    listed = json_of(capsys, "records", str(folder))["records"]
    assert [Path(line["record"]).name for line in listed] == ["d.sqlite", "c.sqlite", "b.sqlite", "a.sqlite"]
    assert [line["state"] for line in listed] == ["damaged", "damaged", "ends early", "complete"]
    assert listed[3]["azimuth_deg"] == 33.25
    assert listed[3]["steps"] == "2 of the 3 steps"
    assert "row 1 of event" in listed[1]["problem"]
    lock = RecordLock(folder / "b.sqlite")
    assert json_of(capsys, "records", str(folder))["records"][2]["state"] == "being written"
    lock.release()
    code, out, _ = run(capsys, "records", str(folder))
    assert code == 0
    assert "\x1b[2J" not in out
    assert "[red]" in out


def test_a_list_of_records_is_a_line_each(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On 80 columns and narrower, and into a pipe: names as `find` gives them are whole, and come last."""
    names = [f"north-20260101T120000.00000{k}Z.sqlite" for k in range(4)]
    fix = {"azimuth_deg": 329.16, "azimuth_sd_deg": 0.2918, "latitude_deg": 50.0, "latitude_sd_deg": 0.2}
    for k, name in enumerate(names[:3]):
        with Recorder(tmp_path / name, lambda: 1.0) as recorder:
            recorder.set_meta("plan", {"name": "drift-balanced", "steps": list(range(10))})
            for step in range(k):
                recorder.add_step(span(step, 0, 9))
            if k:
                recorder.add_event("state", "slew")
            if k == 2:
                recorder.add_fix(fix)
    (tmp_path / names[3]).write_text("something else")
    long = "a name that somebody gave to a record, longer than any terminal is wide, " * 3 + ".sqlite"
    shutil.copy(tmp_path / names[2], tmp_path / long)
    lock = RecordLock(tmp_path / names[0])
    for columns in ("40", "80"):
        monkeypatch.setenv("COLUMNS", columns)
        code, out, _ = run(capsys, "records", str(tmp_path))
        head, *lines, last = out.splitlines()
        assert (code, head.split()[-1]) == (0, "record")
        assert [line.split()[-1] for line in lines] == names[::-1]
        assert max(map(len, lines)) <= 80
        assert last.endswith(long)
        assert lines[0].startswith("damaged ")
        assert lines[1].split()[:5] == ["329.160", "±", "0.292", "drift-balanced", "0.1"]
        assert lines[2].startswith("ends early, 1/10 ")
        assert lines[3].startswith("being written, 0/10 ")
    lock.release()


def test_a_fix_that_failed_is_not_listed_like_any_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Whoever reads an azimuth off the list, or off the page, sees that it must not be trusted."""
    checks = [{"decisive": False, "passed": False}, {"decisive": True, "passed": True}]
    for name, failed in (("a", []), ("b", [{"decisive": True, "passed": False}])):
        with Recorder(tmp_path / f"{name}.sqlite", lambda: 1.0) as recorder:
            recorder.add_fix({"azimuth_deg": 33.0, "azimuth_sd_deg": 0.5, "checks": checks + failed})
    listed = json_of(capsys, "records", str(tmp_path))["records"]
    assert [line["trustworthy"] for line in listed] == [False, True]
    lines = run(capsys, "records", str(tmp_path))[1].splitlines()
    assert [line.split()[:4][-1] == "!" for line in lines[1:]] == [True, False]
    assert "not to be trusted" in run(capsys, "show", str(tmp_path / "b.sqlite"))[1]
    assert "not to be trusted" not in run(capsys, "show", str(tmp_path / "a.sqlite"))[1]


def test_show_tells_all_but_the_samples(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Devices, steps, events and fix; strings from devices do nothing to the terminal."""
    code, out, _ = run(capsys, "show", str(folder / "a.sqlite"))
    assert code == 0
    for text in ("2023-11-14 22:13:20 UTC", "U2", "STALL", "complete, 2 of the 3 steps"):
        assert text in out
    found = json_of(capsys, "show", str(folder / "a.sqlite"))
    assert found["n_blocks"] == 20
    assert found["meta"]["plan"]["name"] == "six-position"
    assert found["streams"][0]["identities"]["gyro"]["serial_number"] == "A7"
    code, out, _ = run(capsys, "show", str(folder / "b.sqlite"))
    assert (code, "\x1b" in out) == (0, False)


def test_check_has_exit_codes(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """0 for sound records, also those that end early; 5 as soon as one is damaged or none."""
    code, out, _ = run(capsys, "check", str(folder / "a.sqlite"), str(folder / "b.sqlite"))
    assert code == 0
    assert out.count("sound") == 2
    assert "780 samples" in out
    assert "northfinder resume goes on" in out
    code, out, _ = run(capsys, "check", str(folder / "a.sqlite"), str(folder / "c.sqlite"))
    assert code == 5
    assert "DAMAGED" in out
    assert "row 1 of event does not match its checksum" in out
    code, _, err = run(capsys, "check", str(folder / "d.sqlite"))
    assert code == 5
    assert "is no record" in err


def test_recover_by_default_beside_the_record(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It says what is saved and lost, and what it wrote is sound."""
    code, out, _ = run(capsys, "recover", str(folder / "c.sqlite"))
    assert code == 0
    assert "20 rows of block saved" in out
    assert "1 rows of event lost: 1" in out
    assert run(capsys, "check", str(folder / "c-recovered.sqlite"))[0] == 0
    code, _, err = run(capsys, "recover", str(folder / "c.sqlite"))
    assert code == 5
    assert "exists already" in err


def test_export_says_how_much(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By default beside the record; a kind that is none is a usage error."""
    code, out, _ = run(capsys, "export", str(folder / "a.sqlite"), "--to", "csv")
    assert (code, out) == (0, f"780 samples written to {folder / 'a.csv'}\n")
    assert (folder / "a.csv").read_text().startswith('"stream","sample_index","device_time_s","counts_1"')
    assert run(capsys, "export", str(folder / "a.sqlite"), "--to", "xls")[0] == 2


def test_notes_go_to_the_newest_record(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without a record named, that which was begun last; they are listed among the events, in order of time."""
    code, out, _ = run(capsys, "note", "a lorry\x1b[2J passed", "--in", str(folder))
    assert (code, out) == (0, f"noted in {folder / 'b.sqlite'}\n")
    code, _, _ = run(capsys, "note", "and another", str(folder / "b.sqlite"))
    with Record(folder / "b.sqlite") as record:
        assert [event[1:] for event in record.events()] == [
            ("note", "a lorry?[2J passed"), ("note", "and another"), ("state", "slew"),
        ]  # fmt: skip
        assert record.notes()[0][0] > 1.75e9
    assert run(capsys, "check", str(folder / "b.sqlite"))[0] == 0
    assert run(capsys, "note", " ", str(folder / "b.sqlite"))[0] == 2
    assert run(capsys, "note", "text", "--in", str(folder / "none"))[0] == 5
    assert run(capsys, "note", "text", str(folder / "d.sqlite"))[0] == 5


def test_a_note_while_the_record_is_being_written(tmp_path: Path) -> None:
    """Neither disturbs the other: all rows and the note are there, in one file."""
    path = tmp_path / "r.sqlite"
    with Recorder(path, lambda: 5.0) as recorder:
        fill(recorder, 100)
        add_note(path, "wind", now=6.0)
        fill(recorder, 0)
    with Record(path) as record:
        assert record.notes() == [(6.0, "note", "wind")]
        assert record.count("block") == 100
    assert [file.name for file in tmp_path.iterdir()] == ["r.sqlite"]


def test_a_record_has_one_writer(tmp_path: Path) -> None:
    """Another process, as far as locks go, cannot resume a record that is being written."""
    path = make_record(tmp_path / "r.sqlite", 3)
    lock = RecordLock(path)
    with pytest.raises(RecordError, match="being written by another process"):
        Recorder(path, lambda: 1.0, resume=True)
    lock.release()
    Recorder(path, lambda: 1.0, resume=True).close()


def test_who_asks_for_a_writer_is_none(tmp_path: Path) -> None:
    """Two commands that look at a record in the same moment do not take each other for its writer."""
    path = make_record(tmp_path / "r.sqlite", 3)
    asking = _locked(path, shared=True)
    assert asking is not None
    assert not is_being_written(path)
    os.close(asking)
    lock = RecordLock(path)
    assert is_being_written(path)
    lock.release()


@pytest.mark.parametrize("command", ["show", "check", "recover", "resume", "export"])
def test_a_file_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str) -> None:
    """One line that names it, and exit code 5."""
    more = ["--to", "npz"] if command == "export" else []
    code, out, err = run(capsys, command, str(tmp_path / "none.sqlite"), *more)
    assert (code, out) == (5, "")
    assert "none.sqlite" in err
    assert len(err.strip().splitlines()) == 1


def test_resume_says_what_it_lacks(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A whole measurement, and a record without a configuration, are refused in a sentence."""
    code, _, err = run(capsys, "resume", str(folder / "a.sqlite"))
    assert code == 5
    assert "nothing is left to resume" in err
    code, _, err = run(capsys, "resume", str(folder / "b.sqlite"))
    assert code == 5
    assert "cannot be resumed: its entry 'config'" in err
