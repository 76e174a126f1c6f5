"""Reading static recordings: each kind of file, what it may leave open, and whatever is wrong with it in one line."""

from __future__ import annotations

import contextlib
import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.api import GyroStatus, RateBlock
from northfinder.archive import read_arrays
from northfinder.errors import RecordError
from northfinder.rate_files import RateSelection, RateSeries, read_rate_file
from northfinder.record import DwellSpan
from northfinder.record.recorder import Recorder
from northfinder.units import DPH

ANY = RateSelection()
ARCHIVE = {"rate_counts": np.array([3, -1, 2, 7], np.int16), "deg_s_per_count": 0.05, "sample_rate_hz": 100.0}


def archive(path: Path, **arrays: object) -> Path:
    """Write a compressed archive."""
    np.savez_compressed(path, **arrays)  # type: ignore[arg-type]  # NumPy takes whatever becomes an array
    return path


def record(path: Path, *, steps: list[tuple[int, int]], lost: int = 0, unfit: int = -1, rate: object = 50.0) -> Path:
    """Write a record of 10 blocks of 10 samples whose counts are their index, some lost or unfit."""
    with Recorder(path, lambda: 0.0) as recorder:
        if rate is not None:
            recorder.set_meta("sample_rate", rate)
        for k in range(10):
            first = 10 * k + (lost if k >= 3 else 0)
            counts = np.arange(first, first + 10, dtype=np.int32)[:, np.newaxis] * np.array([1, -1, 2], np.int32)
            status = GyroStatus.SATURATED if k == unfit else GyroStatus.OK
            recorder.add_block(
                RateBlock(
                    first_index=first, device_time=0.0, arrival_time=0.0, counts=counts, rate_lsb=1e-6, status=status
                )
            )  # fmt: skip
        for number, (first, stop) in enumerate(steps):
            recorder.add_step(
                DwellSpan(
                    step=number, name="U1", azimuth=0.0, elevation=0.0, dwell=1.0, measured_azimuth=0.0,
                    measured_elevation=0.0, first_index=first, stop_index=stop, sample_rate=25.0,
                )
            )  # fmt: skip
    return path


def read(path: Path, text: str, selection: RateSelection = ANY) -> RateSeries:
    """Read `text` as a file."""
    path.write_text(text)
    return read_rate_file(path, selection)


def refusal(path: Path, selection: RateSelection = ANY) -> str:
    """Return the one line with which the file is refused."""
    with pytest.raises(RecordError) as caught:
        read_rate_file(path, selection)
    line = str(caught.value)
    assert line.count(path.name) == 1
    assert "\n" not in line
    return line


@pytest.mark.parametrize(("unit", "si"), [("dph", DPH), ("deg_s", 3600 * DPH), ("rad_s", 1.0)])
def test_csv_gives_rate_and_sample_rate(tmp_path: Path, unit: str, si: float) -> None:
    """The unit at the end of the name counts, and the column of time gives the sample rate."""
    series = read(tmp_path / "a.csv", f"# here\ntime_s,temperature_c,rate_{unit}\n5,20,1.5\n5.1,20,-2\n5.2,21,4\n")
    np.testing.assert_allclose(series.rate, np.array([1.5, -2.0, 4.0]) * si)
    assert series.sample_rate == pytest.approx(10.0)
    assert series.notes == ()


def test_csv_with_several_rates_needs_a_choice(tmp_path: Path) -> None:
    """Two rates are not guessed at; a named one is taken, and a column in counts with its scale."""
    path = tmp_path / "a.csv"
    path.write_text("gyro_x_dph,gyro_y_dph,counts\n1,2,3\n4,5,6\n")
    assert "2 rates" in refusal(path)
    assert "no column time_s" in refusal(path, RateSelection(column="gyro_y_dph"))
    series = read_rate_file(path, RateSelection(column="gyro_y_dph", sample_rate=2.0))
    np.testing.assert_allclose(series.rate, np.array([2.0, 5.0]) * DPH)
    assert "no unit" in refusal(path, RateSelection(column="counts", sample_rate=2.0))
    series = read_rate_file(path, RateSelection(column="counts", sample_rate=2.0, scale=1e-3))
    np.testing.assert_allclose(series.rate, [3e-3, 6e-3])


def test_missing_rows_leave_the_longest_run(tmp_path: Path) -> None:
    """Noise is not identified across a gap: the longest run is taken, and a note says so."""
    times = [*range(3), *range(10, 17), *range(30, 34)]
    rows = "".join(f"{t},{t}\n" for t in times)
    series = read(tmp_path / "a.csv", "time_s,rate_dph\n" + rows)
    np.testing.assert_allclose(series.rate / DPH, np.arange(10, 17))
    assert series.sample_rate == pytest.approx(1.0)
    assert "7 of 14" in series.notes[0]


def test_a_resolution_that_hides_the_noise_is_noted(tmp_path: Path) -> None:
    """Samples that mostly repeat the one before come with a note."""
    rows = "".join(f"{t},{t // 10}\n" for t in range(50))
    assert "resolution" in read(tmp_path / "a.csv", "time_s,rate_dph\n" + rows).notes[0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty"),
        ("time_s,rate\n1,2\n2,3\n", "name one with --column"),
        ("time_s,rate_dph\n", "holds 0 samples"),
        ("time_s,rate_dph\n1,2\n", "holds 1 samples"),
        ("time_s,rate_dph\n1,2\n1,3\n", "does not grow from sample 1"),
        ("time_s,rate_dph\n1,2\n2,x\n", "column 'rate_dph'"),
        ("time_s,rate_dph\n1,2\n2,nan\n", "finite number"),
        ("\x00\x01", "zero byte"),
    ],
)
def test_csv_that_is_no_recording_is_refused(tmp_path: Path, text: str, message: str) -> None:
    """Each in one line with the place."""
    path = tmp_path / "a.csv"
    path.write_text(text)
    assert message in refusal(path)


def test_archive_of_counts_with_their_scale(tmp_path: Path) -> None:
    """Counts, scale and sample rate stand side by side in the archive."""
    series = read_rate_file(archive(tmp_path / "a.npz", **ARCHIVE, source="a label"), ANY)
    np.testing.assert_allclose(series.rate, np.array([3, -1, 2, 7]) * 0.05 * 3600 * DPH)
    assert series.sample_rate == 100.0


def test_archive_of_several_axes_with_time(tmp_path: Path) -> None:
    """An axis of an array is chosen by number, and an array of time gives the sample rate."""
    path = archive(tmp_path / "a.npz", gyro_dph=np.arange(12.0).reshape(4, 3), time_s=np.arange(4) * 0.25)
    series = read_rate_file(path, RateSelection(axis=2))
    np.testing.assert_allclose(series.rate / DPH, [1.0, 4.0, 7.0, 10.0])
    assert series.sample_rate == pytest.approx(4.0)
    assert "no axis 4, expected 1 to 3" in refusal(path, RateSelection(axis=4))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rate_counts": np.array([1.0, np.nan])}, "sample 2 is nan rad/s"),
        ({"rate_counts": np.zeros((2, 2, 2))}, "expected (n,)"),
        ({"deg_s_per_count": "none"}, "name one with --column"),
        ({"sample_rate_hz": np.array([1.0, 2.0])}, "neither sample_rate_hz"),
        ({"sample_rate_hz": -5.0}, "sample rate is -5 Hz"),
        ({"rate_counts": np.array([{}, {}], dtype=object)}, "name one with --column"),
    ],
)
def test_archive_that_is_no_recording_is_refused(tmp_path: Path, change: dict[str, object], message: str) -> None:
    """Each in one line; what would have to be unpickled is not looked at."""
    assert message in refusal(archive(tmp_path / "a.npz", **(ARCHIVE | change)))


def test_an_array_larger_than_its_data_is_refused(tmp_path: Path) -> None:
    """A head that declares more numbers than follow is believed in nothing: no memory is taken for them."""
    data = io.BytesIO()
    np.lib.format.write_array_header_1_0(data, {"descr": "<f8", "fortran_order": False, "shape": (1 << 50,)})
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("rate_dph.npy", data.getvalue() + bytes(64))
    assert "size that its head declares" in refusal(path)


def _damaged(data: st.DataObject, content: bytes, begin: int) -> bytes:
    """Return `content` with bytes changed from `begin` on, and the end cut off."""
    changed = bytearray(content)
    for _ in range(data.draw(st.integers(1, 4))):
        changed[data.draw(st.integers(begin, len(content) - 1))] = data.draw(st.integers(0, 255))
    return bytes(changed[: data.draw(st.integers(begin, len(content)))])


@settings(max_examples=200)
@given(data=st.data())
def test_a_damaged_archive_is_refused_or_read(data: st.DataObject, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Whatever bytes of the archive, or of an array in a sound one, are changed: numbers or one line, nothing else."""
    path = archive(tmp_path_factory.getbasetemp() / "damaged.npz", **ARCHIVE)
    if data.draw(st.booleans()):
        path.write_bytes(_damaged(data, path.read_bytes(), 4))
    else:
        array = io.BytesIO()
        np.save(array, np.arange(3))
        with zipfile.ZipFile(path, "w") as file:
            file.writestr("rate_dph.npy", _damaged(data, array.getvalue(), 0))
    with contextlib.suppress(RecordError):
        assert all(array.dtype.kind in "iuf" for array in read_arrays(path).values())


def test_a_record_gives_its_longest_dwell(tmp_path: Path) -> None:
    """While the stage turned is no rest: the longest dwell is taken, sample by sample, of the axis asked for."""
    path = record(tmp_path / "a.sqlite", steps=[(3, 20), (25, 88), (90, 100)])
    series = read_rate_file(path, RateSelection(axis=2, skip=0.4))
    np.testing.assert_allclose(series.rate, -1e-6 * np.arange(35, 88))
    assert series.sample_rate == 25.0
    assert series.notes == ()


def test_a_record_without_dwells_is_taken_whole(tmp_path: Path) -> None:
    """With the sample rate it says, or the one given."""
    path = record(tmp_path / "a.sqlite", steps=[])
    assert (read_rate_file(path, ANY).rate.size, read_rate_file(path, ANY).sample_rate) == (100, 50.0)
    other = record(tmp_path / "b.sqlite", steps=[], rate=None)
    assert "--sample-rate" in refusal(other)
    assert read_rate_file(other, RateSelection(sample_rate=8.0)).sample_rate == 8.0


@pytest.mark.parametrize(("lost", "unfit", "kept"), [(5, -1, range(35, 105)), (0, 6, range(60))])
def test_lost_and_unfit_samples_of_a_record_part_it(tmp_path: Path, lost: int, unfit: int, kept: range) -> None:
    """The longest unbroken run of samples fit for use is taken, and a note says so."""
    series = read_rate_file(record(tmp_path / "a.sqlite", steps=[], lost=lost, unfit=unfit), ANY)
    np.testing.assert_allclose(series.rate, 1e-6 * np.array(kept))
    assert "longest unbroken run" in series.notes[0]


def test_records_that_hold_nothing_are_refused(tmp_path: Path) -> None:
    """No such axis, no sample fit for use, nothing left, no file, no record."""
    path = record(tmp_path / "a.sqlite", steps=[(60, 70)], unfit=6)
    assert "no samples fit for use" in refusal(path)
    assert "no axis 9" in refusal(path, RateSelection(axis=9))
    whole = record(tmp_path / "b.sqlite", steps=[])
    assert "nothing is left after skipping 2 s" in refusal(whole, RateSelection(skip=2.0))
    assert "cannot be read" in refusal(tmp_path / "c.sqlite")
    stranger = tmp_path / "d.sqlite"
    stranger.write_bytes(b"SQLite format 3\0" + bytes(100))
    assert "no record" in refusal(stranger)
