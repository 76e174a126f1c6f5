"""Whole measurements with gyros that send by themselves, on the native stage, in virtual time and with faults."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
from virtual import VirtualBench

from drivers.api import Clock, Gyro
from drivers.errors import DeviceFaultError
from drivers.kvh import KvhGyro
from drivers.stim300 import Stim300Gyro
from drivers.transport.virtual import VirtualLink
from northfinder.cyclogram import four_position
from northfinder.measurement import Outcome
from northfinder.record import Record
from northfinder.solve_file import solve_record
from sim_device.bench import SimBench

OPEN: dict[str, Callable[[VirtualLink, Clock], Gyro]] = {"stim300": Stim300Gyro, "kvh": KvhGyro}


@dataclass
class StreamingBench(VirtualBench):
    """A bench whose gyro is one of these."""

    kind: str = "stim300"

    def open_gyro(self) -> Gyro:  # type: ignore[override]  # another gyro
        """Return a driver of the emulated gyro."""
        return OPEN[self.kind](self._link("gyro"), self.clock)


def streaming_bench(kind: str, *faults: str, azimuth_deg: float = 213.0) -> StreamingBench:
    """Return a bench with a gyro of that kind."""
    bench = SimBench(gyro=kind, seed=5, azimuth=math.radians(azimuth_deg), latitude=math.radians(-42.0))
    return StreamingBench(bench, faults, kind=kind)


def measured(bench: StreamingBench, record: Path, dwell: float = 8.0) -> Outcome:
    """Return the outcome of a measurement of 40 s and the slews."""
    return bench.measure(record, four_position(dwell=dwell), profile=bench.kind, latitude_deg=-42.0)


def error_of(outcome: Outcome) -> float:
    """Return the error of the azimuth, rad."""
    return math.remainder(outcome.fix.azimuth - math.radians(213.0), math.tau)


def test_the_truth_is_found(tmp_path: Path) -> None:
    """The fix is the truth within 4 standard deviations, nothing is lost, and the record gives it again."""
    record = tmp_path / "find.sqlite"
    outcome = measured(streaming_bench("stim300"), record)
    assert abs(error_of(outcome)) < 4 * outcome.fix.azimuth_sd < math.radians(40)
    assert solve_record(record)["azimuth_deg"] == outcome.to_json()["azimuth_deg"]
    with Record(record) as kept:
        assert kept.totals()[1] == 0


def test_a_bad_line(tmp_path: Path) -> None:
    """Bytes that are lost and flipped cost their samples, which are counted, and the fix is still the truth."""
    record = tmp_path / "find.sqlite"
    outcome = measured(streaming_bench("kvh", "gyro:drop=2e-4", "gyro:flip=2e-4"), record)
    assert abs(error_of(outcome)) < 4 * outcome.fix.azimuth_sd < math.radians(4)
    with Record(record) as kept:
        n_samples, n_lost = kept.totals()
    assert 0.005 < n_lost / n_samples < 0.05


def test_a_gyro_that_is_reset(tmp_path: Path) -> None:
    """A reset in mid-measurement ends it with a fault; the record keeps what came before."""
    record = tmp_path / "find.sqlite"
    with pytest.raises(DeviceFaultError, match="was reset"):
        measured(streaming_bench("stim300", "gyro:reset@60"), record)
    with Record(record) as kept:
        assert kept.totals()[0] > 1000
