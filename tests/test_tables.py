"""Reading measured tables: every good file to SI, every bad one to one sentence that names the place."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from northfinder import delimited
from northfinder.errors import RecordError
from northfinder.tables import DwellTable, StaticTriad, read_table

DPH = math.pi / 180.0 / 3600.0
DWELLS = "dwell,stage_azimuth_deg,elevation_deg,duration_s,rate_dph\n0,90,0,2.5,-9.5\n1,270,-30,2.5,8.25\n"
TRIAD_NAMES = "gyro_x_dph,gyro_y_dph,gyro_z_dph,accel_x_ms2,accel_y_ms2,accel_z_ms2"
TRIAD = f"position,time_s,{TRIAD_NAMES}\nup,0,1,2,-3,9.8,0.1,-0.2\ndown,1,4,5,6,-9.8,0.3,0.4\n"


def read(folder: Path, content: str | bytes) -> DwellTable | StaticTriad:
    """Write `content` to a file and read it."""
    path = folder / "table.csv"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_table(path)


def read_dwells(folder: Path, content: str | bytes) -> DwellTable:
    """Read what must be a dwell table."""
    table = read(folder, content)
    assert isinstance(table, DwellTable)
    return table


def read_triad(folder: Path, content: str | bytes) -> StaticTriad:
    """Read what must be a triad."""
    table = read(folder, content)
    assert isinstance(table, StaticTriad)
    return table


def test_a_dwell_table_comes_in_si_units(tmp_path: Path) -> None:
    """Degrees and deg/h of the columns become rad and rad/s."""
    table = read_dwells(tmp_path, DWELLS)
    np.testing.assert_allclose(table.azimuth, [math.pi / 2, 3 * math.pi / 2])
    np.testing.assert_allclose(table.elevation, [0.0, -math.pi / 6])
    np.testing.assert_allclose(table.duration, [2.5, 2.5])
    np.testing.assert_allclose(table.rate, [-9.5 * DPH, 8.25 * DPH])


def test_a_triad_comes_by_position(tmp_path: Path) -> None:
    """Rows of a position stay together, in axes x, y, z."""
    up, down = read_triad(tmp_path, TRIAD).positions
    assert (up.name, down.name) == ("up", "down")
    np.testing.assert_allclose(up.rate, [[1 * DPH, 2 * DPH, -3 * DPH]])
    np.testing.assert_allclose(down.specific_force, [[-9.8, 0.3, 0.4]])


def test_position_and_time_are_optional_and_returning_is_a_new_position(tmp_path: Path) -> None:
    """A file without positions is one; a body turned back stands in a third position, not in the first."""
    assert [p.name for p in read_triad(tmp_path, f"{TRIAD_NAMES}\n1,2,3,9.8,0,0\n").positions] == ["static"]
    again = TRIAD + "up,2,1,2,3,9.8,0,0\n"
    assert [p.name for p in read_triad(tmp_path, again).positions] == ["up", "down", "up_3"]


@pytest.mark.parametrize(
    ("names", "values", "rate"),
    [
        ("rate_rad_s,duration_min,elevation_rad,stage_azimuth_rad,note", "0.5,1,0.25,1.5,hello", 0.5),
        ("stage_azimuth_rad, elevation_rad ,RATE_DEG_S,duration_min", " 1.5,0.25 , 90,1", math.pi / 2),
        ('"stage_azimuth_rad","elevation_rad","duration_min","rate_dph"', '"1.5",.25,1e0,+9E1', 90 * DPH),
    ],
)
def test_columns_are_found_by_name_with_their_unit(tmp_path: Path, names: str, values: str, rate: float) -> None:
    """Any order, further columns, capitals, blanks, quotes and other units are no hindrance."""
    table = read_dwells(tmp_path, f"{names}\n{values}\n")
    np.testing.assert_allclose([table.azimuth[0], table.elevation[0], table.duration[0]], [1.5, 0.25, 60.0])
    np.testing.assert_allclose(table.rate, [rate])


@pytest.mark.parametrize("dress", [lambda b: b"\xef\xbb\xbf" + b, lambda b: b.replace(b"\n", b"\r\n"), bytes.rstrip])
def test_marks_of_other_systems_are_no_hindrance(tmp_path: Path, dress: object) -> None:
    """A byte order mark, carriage returns, and a last line without an end."""
    assert callable(dress)
    np.testing.assert_allclose(read_dwells(tmp_path, dress(DWELLS.encode())).rate, [-9.5 * DPH, 8.25 * DPH])


def test_the_times_of_positions_are_read_where_they_are_needed(tmp_path: Path) -> None:
    """Start, and a duration in which each sample lasts as long as two are apart; times that go back are refused."""
    rows = [f"{name},{time},1,2,3,9.8,0,0" for name, time in (("up", 5.0), ("up", 5.5), ("down", 8.0), ("down", 8.25))]
    path = tmp_path / "timed.csv"
    path.write_text("\n".join([TRIAD.splitlines()[0], *rows]))
    table = read_table(path, timed=True)
    assert isinstance(table, StaticTriad)
    assert [position.interval for position in table.positions] == [(5.0, 1.0), (8.0, 0.5)]
    assert [position.rate.shape for position in table.positions] == [(2, 3), (2, 3)]
    path.write_text("\n".join([TRIAD.splitlines()[0], *reversed(rows)]))
    with pytest.raises(RecordError, match="position 'down': time_s does not grow"):
        read_table(path, timed=True)
    path.write_text(f"{TRIAD_NAMES}\n1,2,3,9.8,0,0\n")
    with pytest.raises(RecordError, match="column time is missing"):
        read_table(path, timed=True)


def test_comments_are_offered_as_metadata(tmp_path: Path) -> None:
    """Key and value of each comment that has a colon."""
    table = read_dwells(tmp_path, "# run: T1\n# latitude_deg: -49.5 (by map)\n\n" + DWELLS)
    assert table.metadata["run"] == "T1"
    assert table.metadata["latitude_deg"] == "-49.5 (by map)"


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("", "the file is empty"),
        ("# only: this\n", "comments only"),
        (DWELLS.splitlines()[0], "no rows"),
        (TRIAD.splitlines()[0] + "\n# end\n", "no rows"),
        (
            DWELLS.replace("rate_dph", "speed"),
            "column rate is missing (one of rate_dph, rate_deg_s, rate_rad_s), found",
        ),
        (TRIAD.replace("gyro_z_dph", "gyro_w_dph"), "column gyro_z is missing"),
        (DWELLS.replace("dwell,", "rate_rad_s,"), "column rate is there 2 times"),
        (DWELLS.replace("2.5,-9.5", "2.5,fast"), "line 2, column 'rate_dph': found 'fast', expected a finite number"),
        (DWELLS.replace("8.25", ""), "line 3, column 'rate_dph': found nothing"),
        (DWELLS.replace("8.25", "nan"), "line 3, column 'rate_dph': found 'nan'"),
        (DWELLS.replace("8.25", "-inf"), "found '-inf'"),
        (DWELLS.replace("8.25", "1e999"), "found '1e999'"),
        (DWELLS.replace("8.25", "1_0"), "found '1_0'"),
        (DWELLS.replace("8.25", "8.25,1"), "line 3 has 6 columns, expected 5"),
        ("# c\n" + DWELLS.replace("0,90,", "90,"), "line 3 has 4 columns"),
        (DWELLS.replace(",", ";"), "separated by semicolons"),
        (DWELLS.replace(",", "\t"), "separated by tabs"),
        (DWELLS.encode("utf-16"), "zero byte"),
        (DWELLS.encode() + b"\0\0", "line 4 holds a zero byte"),
        (DWELLS.encode() + b"2,\xff", "line 4 is not UTF-8 text (byte 0xff)"),
        (b"9" * 70_000, "line 1 is longer"),
        (DWELLS.encode() + b"9" * 10_000_000, "line 4 is longer"),
        (DWELLS.replace("-30", "91"), "row 2 of the dwells has an elevation"),
        (DWELLS.replace("2.5,8", "0,8"), "row 2 of the dwells has a duration"),
        (DWELLS.replace("1,270", "0,270"), "row 2 of the dwells has a number that does not grow"),
        (DWELLS.replace("8.25", "\x1b[2J"), r"found '\x1b[2J'"),
        (TRIAD_NAMES + ",position\n" + "".join(f"1,2,3,9,0,0,p{i}\n" for i in range(101)), "more than 100 positions"),
    ],
)
def test_a_bad_file_is_told_in_one_sentence(tmp_path: Path, content: str | bytes, told: str) -> None:
    """What is wrong, and where, in one printable line."""
    with pytest.raises(RecordError) as caught:
        read(tmp_path, content)
    message = str(caught.value)
    assert told in message
    assert message.startswith(str(tmp_path / "table.csv"))
    assert message.isprintable()


@pytest.mark.parametrize("name", ["missing.csv", ".", "a\0b"])
def test_what_is_no_file_is_told(tmp_path: Path, name: str) -> None:
    """A missing file, a folder and an impossible name."""
    with pytest.raises(RecordError, match="cannot be read"):
        read_table(tmp_path / name)


def test_a_pipe_is_refused() -> None:
    """A device or pipe could go on for ever."""
    reader, writer = os.pipe()
    try:
        with pytest.raises(RecordError, match="is no regular file"):
            read_table(Path(f"/dev/fd/{reader}"))
    finally:
        os.close(reader)
        os.close(writer)


NUMBERS = st.floats(allow_nan=False, allow_infinity=False, width=32)


@given(
    rows=st.lists(st.tuples(NUMBERS, NUMBERS, NUMBERS, NUMBERS, NUMBERS, NUMBERS), min_size=1),
    order=st.permutations(range(6)),
)
@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_numbers_survive_in_any_order_of_columns(
    tmp_path: Path, rows: list[tuple[float, ...]], order: list[int]
) -> None:
    """What is written with all digits is read to the last bit, times the unit."""
    names = [f"{kind}_{axis}_{unit}" for kind, unit in (("gyro", "rad_s"), ("accel", "ms2")) for axis in "xyz"]
    lines = [",".join(names[i] for i in order), *(",".join(repr(row[i]) for i in order) for row in rows)]
    (position,) = read_triad(tmp_path, "\n".join(lines)).positions
    np.testing.assert_array_equal(np.hstack([position.rate, position.specific_force]), np.array(rows))


@given(content=st.one_of(st.binary(), st.text(alphabet='#:,;-.eE+01289 \t\n\r"up').map(str.encode)), head=st.booleans())
@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_bytes_give_a_table_or_one_sentence(tmp_path: Path, content: bytes, head: bool) -> None:  # noqa: FBT001  # hypothesis
    """Junk, alone or below good names, never ends in another exception nor in a value that is not finite."""
    names = TRIAD.splitlines()[0].encode() + b"\n"
    message, tables = "", []
    try:
        tables.append(read(tmp_path, names + content if head else content))
    except RecordError as error:
        message = str(error)
    assert message.isprintable()
    assert bool(message) != bool(tables)
    for table in tables:
        assert isinstance(table, StaticTriad)
        assert all(np.isfinite(p.rate).all() and np.isfinite(p.specific_force).all() for p in table.positions)


DECIMAL = st.from_regex(r"-?([0-9]{1,6}\.?[0-9]{0,4}|\.[0-9]{1,3})", fullmatch=True)
JUNK = st.sampled_from(
    [b"-", b".", b"e", b"+", b",", b"\n", b" ", b"x", b"#", b"\r\n", b"up", b"nan", b"\0", b"7", b""]
)


def by_rows(runs: Iterable[tuple[str, NDArray[np.float64]]]) -> list[tuple[str, list[float]]]:
    """Return label and numbers of each row."""
    return [(name, row) for name, columns in runs for row in columns.T.tolist()]


@given(
    data=st.data(),
    rows=st.lists(st.tuples(DECIMAL, DECIMAL, DECIMAL), min_size=1, max_size=6),
    label=st.integers(-1, 3),
)
@settings(deadline=None, max_examples=100)
def test_the_bulk_parser_never_differs_from_the_exact_one(
    data: st.DataObject, rows: list[tuple[str, ...]], label: int
) -> None:
    """On good rows it gives the same numbers; on rows with junk put in anywhere, the same or nothing."""
    fields = [list(row) if label < 0 else [*row[:label], "up", *row[label:]] for row in rows]
    good = "".join(",".join(row) + "\n" for row in fields).encode()
    place, cut = data.draw(st.integers(0, len(good) - 1)), data.draw(st.integers(0, 2))
    bad = good[:place] + data.draw(JUNK) + good[place + cut :]
    bad = bad if bad.endswith(b"\n") else bad + b"\n"
    column, names = (None if label < 0 else label), ["c"] * len(fields[0])
    wanted = [i for i in range(len(names)) if i != label]
    for chunk in (good, bad):
        bulk = delimited._bulk(chunk, names, wanted, column)
        if chunk is good:
            assert bulk is not None
        if bulk is not None:
            assert by_rows(bulk) == by_rows(delimited._lines(chunk, 0, names, wanted, column))


def test_the_bulk_parser_leaves_comments_to_the_exact_one() -> None:
    """A number sign begins a comment, even where a name stands."""
    assert delimited._bulk(b"#up,1,2\n", ["c"] * 3, [1, 2], 0) is None
    assert delimited._bulk(b"up,1,2\n#up,1,2\n", ["c"] * 3, [1, 2], 0) is None


def test_the_bulk_parser_leaves_zero_bytes_to_the_exact_one() -> None:
    """Text of a label holds none."""
    assert delimited._bulk(b"\0up,1,2\n", ["c"] * 3, [1, 2], 0) is None


@pytest.mark.parametrize("field", [b" up", b'"up"', b"p1", "\u00fcp".encode()])
def test_the_bulk_parser_reads_a_name_as_the_exact_one_does(field: bytes) -> None:
    """Blanks and quotes are no part of a name; digits and letters of any script are."""
    chunk = field + b",1,2\n"
    (bulk,), (exact,) = (
        delimited._bulk(chunk, ["c"] * 3, [1, 2], 0) or [],
        list(delimited._lines(chunk, 0, ["c"] * 3, [1, 2], 0)),
    )
    assert bulk[0] == exact[0]


def test_the_bulk_parser_leaves_a_number_too_large_to_the_exact_one() -> None:
    """Four hundred digits are no finite number, and infinity is none."""
    for text in (b"9" * 400, b"inf", b"nan"):
        assert delimited._bulk(b"1," + text + b"\n", ["c"] * 2, [0, 1], None) is None


def test_a_large_file_is_read_in_bulk_and_still_names_the_line(tmp_path: Path) -> None:
    """Chunks of one position, a chunk with two and the tail join to all rows; a fault far down has its line."""
    rng = np.random.default_rng(7)
    values = np.round(rng.normal(size=(120_000, 6)) * 50.0, 4)
    rows = [
        f"{'up' if i < 70_000 else 'down'},{i}," + ",".join(map(repr, row)) for i, row in enumerate(values.tolist())
    ]
    text = "\n".join([TRIAD.splitlines()[0], *rows])
    assert len(text) > 1.5 * delimited._CHUNK
    up, down = read_triad(tmp_path, text).positions
    np.testing.assert_allclose(np.vstack([up.rate, down.rate]) / DPH, values[:, :3], rtol=1e-14)
    np.testing.assert_array_equal(np.vstack([up.specific_force, down.specific_force]), values[:, 3:])
    rows[99_999] = rows[99_999] + "-"
    with pytest.raises(RecordError, match="line 100001, column 'accel_z_ms2': found"):
        read(tmp_path, "\n".join([TRIAD.splitlines()[0], *rows]))
