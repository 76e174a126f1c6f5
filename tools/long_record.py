"""Make a record of a measurement that never was, of any length, and time what reads it.

python tools/long_record.py                        # an hour at 2,000 samples/s of three axes
python tools/long_record.py --seconds 600 --keep record.sqlite
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from drivers.api import DeviceIdentity, RateBlock, StageMode, StageState
from northfinder.estimation.geometry import sensitivity
from northfinder.record import DwellSpan
from northfinder.record.recorder import Recorder
from northfinder.solution import Assumptions
from northfinder.units import ARCSEC, DPH, EARTH_RATE

#: Stage azimuth and elevation of the positions, deg, with their names.
POSITIONS = (
    ("U1", 0.0, 0.0), ("U2", 90.0, 0.0), ("U3", 180.0, 0.0), ("U4", 270.0, 0.0), ("U5", 0.0, 90.0), ("U6", 0.0, -90.0),
)  # fmt: skip
AZIMUTH, LATITUDE = math.radians(33.0), math.radians(50.429)
TURN = 8.0  # s
BLOCK = 50  # samples
RATE_LSB = 1e-9  # rad/s
GYRO = DeviceIdentity(kind="gyro", model="synthetic", serial_number="G1", firmware_version="1", protocol="none")
STAGE = DeviceIdentity(kind="stage", model="synthetic", serial_number="S1", firmware_version="1", protocol="none")


def write_record(
    path: Path,
    *,
    seconds: float,
    sample_rate: float = 2000.0,
    n_axes: int = 3,
    n_dwells: int = 18,
    identities: Mapping[str, DeviceIdentity] | None = None,
    meta: Mapping[str, object] | None = None,
    events: Sequence[tuple[str, str]] = (),
    profile: str | None = "tvg43",
    started: float = 1_790_000_000.0,
) -> None:
    """Write a whole record of `seconds` s without any device: white angle noise on the earth's rate, seeded."""
    rng = np.random.default_rng(1)
    devices = identities or {"gyro": GYRO, "stage": STAGE}
    host = [started]
    with Recorder(path, lambda: host[0]) as recorder:
        kept = {
            "northfinder": "0.1.0",
            "identities": devices,
            "sample_rate": sample_rate,
            "plan": {"name": "synthetic", "steps": [None] * n_dwells},
            "config": {"gyro": {"address": "synthetic"}, "stage": {"address": "synthetic"}},
            "assumptions": Assumptions.gather(
                method="generalised", profile=profile, latitude_deg=None, g_drift_dph=0.0
            ),
        } | dict(meta or {})
        for key, value in kept.items():
            recorder.set_meta(key, value)
        recorder.begin_stream(devices, sample_rate=sample_rate, n_axes=n_axes)
        for kind, detail in (("state", "connect"), *events):
            recorder.add_event(kind, detail)
        per_dwell = round(seconds / n_dwells * sample_rate)
        stage = (0.0, 0.0)
        for number in range(n_dwells):
            name, azimuth, elevation = POSITIONS[number % len(POSITIONS)]
            target = math.radians(azimuth), math.radians(elevation)
            first, settled = number * per_dwell, number * per_dwell + round(TURN * sample_rate)
            rates = _rates(rng, target, per_dwell, sample_rate, n_axes)
            for begin in range(0, per_dwell, BLOCK):
                now = (first + begin) / sample_rate
                host[0] = started + now + 0.05
                counts = rates[begin : begin + BLOCK]
                recorder.add_block(_block(first + begin, now, host[0], counts))
                if begin * 20 % round(sample_rate) < 20 * BLOCK:
                    part = min(1.0, begin / sample_rate / TURN)
                    recorder.add_state(_state(now, host[0], stage, target, part))
            recorder.add_step(
                DwellSpan(
                    step=number, name=name, azimuth=target[0], elevation=target[1],
                    dwell=per_dwell / sample_rate - TURN, measured_azimuth=target[0],
                    measured_elevation=target[1], first_index=settled,
                    stop_index=first + per_dwell, sample_rate=sample_rate,
                )
            )  # fmt: skip
            recorder.flush()  # faster than any gyro: wait for the disk
            stage = target
        recorder.add_event("state", "done")
        recorder.add_fix({})


def _rates(
    rng: np.random.Generator, target: tuple[float, float], n: int, sample_rate: float, n_axes: int
) -> np.ndarray[tuple[int, int], np.dtype[np.int32]]:
    """Return the counts of a position, shape (n, n_axes): earth rate, bias and white angle noise."""
    azimuth, elevation = (np.array([angle]) for angle in target)
    axes = sensitivity(azimuth, elevation, np.zeros((1, 2)), n_axes=n_axes)[0]
    level, down = EARTH_RATE * math.cos(LATITUDE), EARTH_RATE * math.sin(LATITUDE)
    earth = axes @ np.array([level * math.cos(AZIMUTH), level * math.sin(AZIMUTH), down])
    angle = rng.normal(0.0, 0.764 * DPH, (n + 1, n_axes))
    walk = rng.normal(0.0, 0.003 * math.radians(1.0) / 60.0 * math.sqrt(sample_rate), (n, n_axes))
    rate = earth + 38.0 * DPH + np.diff(angle, axis=0) * sample_rate + walk
    return np.asarray(np.round(rate / RATE_LSB).clip(-(2**31), 2**31 - 1), dtype=np.int32)


def _block(
    first: int, now: float, arrival: float, counts: np.ndarray[tuple[int, int], np.dtype[np.int32]]
) -> RateBlock:
    return RateBlock(
        first_index=first, device_time=now, arrival_time=arrival, counts=counts, rate_lsb=RATE_LSB,
        temperature=20.0 + 5.0 * (1.0 - math.exp(-now / 900.0)),
        tilt=(12.0 * ARCSEC + ARCSEC * math.sin(now / 40.0), -7.0 * ARCSEC + ARCSEC * math.cos(now / 55.0)),
    )  # fmt: skip


def _state(now: float, arrival: float, begin: tuple[float, float], end: tuple[float, float], part: float) -> StageState:
    azimuth, elevation = (a + part * (b - a) for a, b in zip(begin, end, strict=True))
    mode = StageMode.IDLE if part >= 1.0 else StageMode.MOVING
    return StageState(device_time=now + 3.5, arrival_time=arrival, mode=mode, azimuth=azimuth, elevation=elevation)


def main() -> None:
    """Make the record and time its readers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--sample-rate", type=float, default=2000.0)
    parser.add_argument("--axes", type=int, default=3)
    parser.add_argument("--keep", type=Path, help="write the record here, and leave it")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = arguments.keep or Path(folder) / "long.sqlite"
        write_record(path, seconds=arguments.seconds, sample_rate=arguments.sample_rate, n_axes=arguments.axes)
        print(f"record {path.stat().st_size / 1e6:.1f} MB")
        page = Path(folder) / "long.html"
        for command in (["solve", str(path), "--json"], ["report", str(path), "-o", str(page)]):
            started = time.perf_counter()
            subprocess.run([sys.executable, "-m", "northfinder", *command], stdout=subprocess.DEVNULL, check=True)
            print(f"{command[0]} {time.perf_counter() - started:.2f} s")
        print(f"page {page.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
