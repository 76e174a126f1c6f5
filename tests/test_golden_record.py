"""A record of schema version 1, made once and kept: every version of the program reads it, and gives its fix.

It holds two streams, the gyro switched off between them, a gap, a note, and everything that a block may carry.
"""

import gzip
import hashlib
from pathlib import Path

import numpy as np
import pytest

from drivers.api import GyroStatus, StageMode
from northfinder.record import Record
from northfinder.record.check import examine
from northfinder.record.schema import SCHEMA_VERSION, TABLES
from northfinder.solve_file import solve_record

CONTENT = "efb7f85d0bbf0cd4bc71323860b317120ec9021155f77c2815575e8228e8502b"


@pytest.fixture
def golden(tmp_path: Path) -> Path:
    """Return the record."""
    path = tmp_path / "golden.sqlite"
    path.write_bytes(gzip.decompress((Path(__file__).parent / "golden_record_v1.sqlite.gz").read_bytes()))
    return path


def test_every_value_is_read_as_it_was_written(golden: Path) -> None:
    """All rows, bit for bit: numbers by their exact decimal form, samples by their bytes."""
    digest = hashlib.sha256()
    with Record(golden) as record:
        for table in ("meta", "stream", "block", "stage_state", "step", "event", "note", "fix"):
            for row in record.rows(table):
                digest.update(repr(row).encode())
    assert digest.hexdigest() == CONTENT
    assert examine(golden).sound


def test_what_the_rows_mean(golden: Path) -> None:
    """Streams, blocks, states, steps, notes and fix as the program understands them."""
    with Record(golden) as record:
        blocks, spans = list(record.blocks()), record.steps()
        assert [(info.stream, info.sample_rate, info.n_axes) for info in record.streams()] == [
            (0, 20.0, 1),
            (1, 20.0, 1),
        ]
        assert [(span.stream, span.turn_on, span.stream_start) for span in spans][3:5] == [(0, 0, 0.0), (1, 1, 140.0)]
        assert record.states()[2].mode is StageMode.IDLE
        assert ("note", "the first half, then a power cut") in [event[1:] for event in record.events()]
        assert record.is_complete()
    (gap,) = [each for each in blocks if each.n_lost]
    assert (gap.first_index, gap.n_lost, gap.status) == (270, 10, GyroStatus.OVERRUN)
    assert blocks[0].counts.dtype == np.int32
    assert blocks[0].counts.shape == (20, 1)
    assert (blocks[0].tilt, blocks[0].specific_force) == ((1e-6, -2e-6), (0.01, 0.02, 9.8))


def test_its_fix(golden: Path) -> None:
    """As it was estimated when it was made, to the rounding of another machine's linear algebra."""
    with Record(golden) as record:
        kept = record.fixes()[-1]
    found = solve_record(golden)
    for name in ("azimuth_deg", "azimuth_sd_deg", "latitude_deg", "bias_dph", "scale_factor"):
        assert found[name] == pytest.approx(kept[name], rel=1e-9)
    assert found["azimuth_deg"] == pytest.approx(216.94995681320208, rel=1e-9)
    assert abs(found["azimuth_deg"] - 217.0) < 3 * found["azimuth_sd_deg"]


def test_the_version_grows_with_the_schema() -> None:
    """Whoever changes the tables raises the version, and keeps what reads this one."""
    columns = [(table, column.name, column.kind, column.unit) for table, listed in TABLES.items() for column in listed]
    assert SCHEMA_VERSION == 1
    assert hashlib.sha256(repr(columns).encode()).hexdigest()[:16] == "b5f44e12dc698bd5"
