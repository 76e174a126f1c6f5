"""Records for tests: small, with no two blocks alike, and everything that a record may hold."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from drivers.api import DeviceIdentity, GyroStatus, RateBlock, StageMode, StageState
from northfinder.record import DwellSpan
from northfinder.record.recorder import Recorder

GYRO = DeviceIdentity(kind="gyro", model="fast3", serial_number="A7", boot_count=3)


def block(first_index: int, n: int = 39, *, n_axes: int = 3, seed: int = 7) -> RateBlock:
    """Return a block of noise."""
    rng = np.random.default_rng([seed, first_index])
    return RateBlock(
        first_index=first_index, device_time=5.0 + first_index / 2000, arrival_time=1.5 + first_index / 2000,
        counts=rng.integers(-(2**24), 2**24, (n, n_axes), dtype=np.int32), rate_lsb=4.7e-9,
        temperature=24.0 + first_index * 1e-3, tilt=(1e-5, -2e-5), specific_force=(0.01, -0.02, 9.81),
        status=GyroStatus.OVERRUN,
    )  # fmt: skip


def state(time: float) -> StageState:
    """Return a state of a stage that turns."""
    return StageState(
        device_time=time, arrival_time=time + 0.01, mode=StageMode.MOVING, azimuth=0.1 * time, elevation=-0.5,
        azimuth_rate=0.1,
    )  # fmt: skip


def span(number: int, first_index: int, stop_index: int) -> DwellSpan:
    """Return a finished dwell."""
    return DwellSpan(
        step=number, name=f"U{number + 1}", azimuth=1.5 * number, elevation=0.0,
        dwell=(stop_index - first_index) / 2000, measured_azimuth=1.5 * number + 1e-6, measured_elevation=1e-6,
        first_index=first_index, stop_index=stop_index, sample_rate=2000.0,
    )  # fmt: skip


def fill(recorder: Recorder, n_blocks: int, *, n: int = 39) -> None:
    """Record a stream of `n_blocks` blocks of `n` samples with states, two dwells, an event and a fix."""
    recorder.set_meta("plan", {"name": "six-position", "steps": [1, 2, 3], "text": "x" * 9000})  # longer than a page
    recorder.set_meta("sample_rate", 2000.0)
    recorder.begin_stream({"gyro": GYRO}, sample_rate=2000.0, n_axes=3)
    for k in range(n_blocks):
        recorder.add_block(block(n * k, n))
        if k % 10 == 0:
            recorder.add_state(state(k / 10))
            recorder.write()
    total = n * n_blocks
    recorder.add_step(span(0, total // 8, total // 3))
    recorder.add_step(span(1, total // 2, total - total // 8))
    recorder.add_event("fault", "STALL")
    recorder.add_fix({"azimuth_deg": 33.25})


def make_record(
    path: Path, n_blocks: int = 60, *, n: int = 39, now: Callable[[], float] = lambda: 1.7e9
) -> Path:  # fmt: skip
    """Write a closed record and return its path."""
    with Recorder(path, now) as recorder:
        fill(recorder, n_blocks, n=n)
    return path
