"""Exports open in pandas, NumPy and SciPy with the values of the record, bit for bit; a failed one leaves nothing."""

import json
import sqlite3
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from pyarrow import parquet
from recording import GYRO, block, make_record, span
from scipy import io

from northfinder.errors import RecordError
from northfinder.export import FORMATS, export_record
from northfinder.record import Record
from northfinder.record.recorder import Recorder

Columns = Mapping[str, NDArray[Any]]


def from_csv(path: Path) -> Columns:
    """Read with pandas."""
    table = pd.read_csv(path)
    return {name: table[name].to_numpy() for name in table}


def from_parquet(path: Path) -> Columns:
    """Read with pandas."""
    table = pd.read_parquet(path)
    return {name: table[name].to_numpy() for name in table}


def from_npz(path: Path) -> Columns:
    """Read with NumPy, without pickles."""
    with np.load(path, allow_pickle=False) as archive:
        return dict(archive)


def from_mat(path: Path) -> Columns:
    """Read with SciPy."""
    return {name: array[:, 0] for name, array in io.loadmat(path).items() if getattr(array, "ndim", 0) == 2}


READERS: dict[str, Callable[[Path], Columns]] = {
    "csv": from_csv, "parquet": from_parquet, "npz": from_npz, "mat": from_mat,
}  # fmt: skip


def exported(tmp_path: Path, record: Path, kind: str) -> Columns:
    """Export a record and read it again."""
    out = tmp_path / f"out.{kind}"
    with Record(record) as opened:
        n = export_record(opened, out, kind)
    columns = READERS[kind](out)
    assert len(columns["sample_index"]) == n
    assert {path.name for path in tmp_path.iterdir()} == {record.name, out.name}
    return columns


@pytest.mark.parametrize("kind", FORMATS)
def test_an_export_holds_what_the_record_holds(tmp_path: Path, kind: str) -> None:
    """Counts, rates, times and everything beside them come back bit for bit, each sample with its dwell."""
    path = make_record(tmp_path / "r.sqlite", 600)
    columns = exported(tmp_path, path, kind)
    with Record(path) as record:
        blocks, spans = list(record.blocks()), record.steps()
    counts = np.concatenate([each.counts for each in blocks])
    rates = np.concatenate([each.rate for each in blocks])
    for axis in range(3):
        assert columns[f"counts_{axis + 1}"].dtype.kind == "i"
        assert np.array_equal(columns[f"counts_{axis + 1}"], counts[:, axis])
        assert np.array_equal(columns[f"rate_{axis + 1}_rad_s"], rates[:, axis])
    index = columns["sample_index"]
    assert np.array_equal(index, np.arange(len(counts)))
    assert np.array_equal(columns["device_time_s"][::39], [each.device_time for each in blocks])
    assert np.array_equal(columns["temperature_degc"][::39], np.array([each.temperature for each in blocks]))
    assert set(columns["tilt_y_rad"]) == {-2e-5}
    assert set(columns["specific_force_z_m_s2"]) == {9.81}
    assert set(columns["status"]) == {16}
    for each in spans:
        inside = (index >= each.first_index) & (index < each.stop_index)
        assert np.array_equal(columns["step"] == each.step, inside)
        assert set(columns["stage_azimuth_rad"][inside]) == {each.measured_azimuth}
    assert np.isnan(columns["stage_elevation_rad"][columns["step"] == -1]).all()


@pytest.mark.parametrize("kind", FORMATS)
def test_floats_gaps_streams_and_what_was_not_measured(tmp_path: Path, kind: str) -> None:
    """float32 samples stay what they are, also those that are no number; a gap and a second stream show."""
    path = tmp_path / "r.sqlite"
    values = np.array([[0.1], [np.nan], [-3.3e38], [1e-42]], np.float32)
    bare = replace(block(0, 4, n_axes=1), counts=values, temperature=None, tilt=None, specific_force=None)
    with Recorder(path, lambda: 1.0) as recorder:
        recorder.begin_stream({"gyro": GYRO}, sample_rate=2000.0, n_axes=1)
        recorder.add_block(bare)
        recorder.add_block(replace(bare, first_index=10, n_lost=6))
        recorder.stream = 1
        recorder.begin_stream({"gyro": GYRO}, sample_rate=2000.0, n_axes=1)
        recorder.add_block(bare)
    columns = exported(tmp_path, path, kind)
    assert columns["sample_index"].tolist() == [0, 1, 2, 3, 10, 11, 12, 13, 0, 1, 2, 3]
    assert columns["stream"].tolist() == [0] * 8 + [1] * 4
    assert np.array_equal(columns["counts_1"].astype(np.float32)[:4], values[:, 0], equal_nan=True)
    assert np.array_equal(columns["rate_1_rad_s"][:4], values[:, 0].astype(np.float64) * 4.7e-9, equal_nan=True)
    assert np.isnan(columns["temperature_degc"].astype(np.float64)).all()


def test_what_goes_with_the_samples(tmp_path: Path) -> None:
    """NPZ and MAT hold the dwells as arrays, Parquet holds plan, devices and fix beside the table."""
    path = make_record(tmp_path / "r.sqlite", 20)
    with Record(path) as record:
        for kind in ("npz", "mat", "parquet"):
            export_record(record, tmp_path / f"out.{kind}", kind)
    archive, matlab = from_npz(tmp_path / "out.npz"), io.loadmat(tmp_path / "out.mat")
    assert archive["step_name"].tolist() == list(matlab["step_name"]) == ["U1", "U2"]
    first = [span(0, 97, 260).measured_azimuth, span(1, 390, 683).measured_azimuth]
    assert archive["step_measured_azimuth_rad"].tolist() == matlab["step_measured_azimuth_rad"][:, 0].tolist() == first
    kept = parquet.read_schema(tmp_path / "out.parquet").metadata[b"northfinder"]
    assert json.loads(kept)["fixes"] == json.loads(str(archive["about_json"]))["fixes"] == [{"azimuth_deg": 33.25}]
    assert json.loads(matlab["about_json"][0])["plan"]["name"] == "six-position"


@pytest.mark.parametrize("kind", FORMATS)
def test_a_failed_export_leaves_nothing(tmp_path: Path, kind: str) -> None:
    """A damaged record, one without samples, a file that is there: one sentence each, and no file."""
    path = make_record(tmp_path / "r.sqlite", 30)
    (tmp_path / "there").write_text("precious")
    with Record(path) as record, pytest.raises(RecordError, match="exists already"):
        export_record(record, tmp_path / "there", kind)
    assert (tmp_path / "there").read_text() == "precious"
    with sqlite3.connect(path) as db:
        db.execute("UPDATE block SET first_index = first_index + 1 WHERE id = 20")
    db.close()
    with Record(path) as record, pytest.raises(RecordError, match="row 20 of block"):
        export_record(record, tmp_path / "out", kind)
    empty = tmp_path / "empty.sqlite"
    Recorder(empty, lambda: 1.0).close()
    with Record(empty) as record, pytest.raises(RecordError, match="holds no samples"):
        export_record(record, tmp_path / "out", kind)
    with Record(path) as record, pytest.raises(RecordError, match="cannot be made: File exists"):
        export_record(record, tmp_path / "there" / "out", kind)
    assert {file.name for file in tmp_path.iterdir()} == {"r.sqlite", "there", "empty.sqlite"}
