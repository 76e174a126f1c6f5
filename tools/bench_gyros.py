"""Measure the gyros that send by themselves; run by ``python tools/bench.py stim300 kvh epson``.

Decoding: what an emulated unit sends in 200 s, in chunks of 4096 bytes as a port hands them over, to arrays of counts.
Live: the processor time of transport, driver and record in this process at 2,000 samples/s.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable
from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.discovery import open_gyro
from drivers.frame_stream import FrameDecoder
from drivers.protocol import epson, kvh, stim300
from drivers.protocol.crc_frames import Frames
from drivers.transport.clock import SystemClock
from northfinder.cli.emulator import EmulatorProcess, SimulationOptions
from northfinder.record.recorder import Recorder
from sim_device.bench import SimBench

SENT_SECONDS = 200
LIVE_SECONDS = 20.0
_CHUNK = 4096


def frames_per_second(
    kind: str,
    decoder: Callable[[], FrameDecoder],
    counts: Callable[[Frames], NDArray],  # type: ignore[type-arg]  # integers or floats
    *,
    prepare: bytes = b"",
) -> float:
    """Return how many frames a second are decoded to counts, the best of five runs; `prepare` makes the unit send."""
    line = SimBench(gyro=kind, seed=1).gyro
    if prepare:
        line.feed(prepare, 0)
    wire = b"".join(line.poll(second * 1_000_000) for second in range(SENT_SECONDS))
    best, n_frames = math.inf, 0
    for _ in range(5):
        started, reader = time.process_time(), decoder()
        found = [counts(run) for i in range(0, len(wire), _CHUNK) for run in reader.feed(wire[i : i + _CHUNK])]
        best = min(best, time.process_time() - started)
        n_frames = sum(map(len, found))
    return n_frames / best


def bench_stim300() -> dict[str, float]:
    """Time decoding of rate, acceleration and temperature, and measure this process at 2,000 of them a second."""

    def counts(frames: Frames) -> NDArray[np.int32]:
        if frames.header[0] not in stim300.SAMPLE_IDS:
            return np.empty((0, 3), np.int32)
        return stim300.triple(stim300.decode_samples(frames), "rate")

    figures = {"stim300_frames_per_s": frames_per_second("stim300", stim300.decoder, counts)}
    return figures | {f"stim300_{name}": value for name, value in live("stim300").items()}


def bench_kvh() -> dict[str, float]:
    """Time decoding of format A."""

    def counts(frames: Frames) -> NDArray[np.float32]:
        return kvh.decode_messages(frames)["rotation"].astype(np.float32)

    return {"kvh_frames_per_s": frames_per_second("kvh", kvh.decoder, counts)}


def bench_epson() -> dict[str, float]:
    """Time decoding of bursts of 32-bit numbers."""
    settings = (
        (epson.UART_CTRL[1], 1),
        (epson.BURST_CTRL1[1], epson.BURST_FIELDS & 0xFF),
        (epson.BURST_CTRL1[1] + 1, epson.BURST_FIELDS >> 8),
        (epson.BURST_CTRL2[1] + 1, epson.BURST_WIDTHS[32]),
    )
    prepare = epson.select_window(1) + b"".join(epson.write_command(*setting) for setting in settings)
    prepare += epson.select_window(0) + epson.write_command(epson.MODE_CTRL[1] + 1, epson.SAMPLING)

    def counts(frames: Frames) -> NDArray[np.int32]:
        return epson.records([frames])["rate"].astype(np.int32)

    def decoder() -> epson.BurstDecoder:
        return epson.BurstDecoder(epson.MODELS["G370PDS0"])

    return {"epson_frames_per_s": frames_per_second("epson", decoder, counts, prepare=prepare)}


def live(kind: str) -> dict[str, float]:
    """Measure this process while it reads and records an emulated unit at 2,000 samples/s."""
    clock = SystemClock()
    with tempfile.TemporaryDirectory() as folder:
        own = (resources.files("sim_device.plant") / "profiles" / f"{kind}.toml").read_text(encoding="utf-8")
        profile = Path(folder) / "fast.toml"
        profile.write_text(own.replace("sample_rate_hz = 125.0", "sample_rate_hz = 2000.0"), encoding="utf-8")
        options = SimulationOptions(
            azimuth_deg=33.0, latitude_deg=50.0, profile=str(profile), seed=1, speed="1", gyro=kind
        )
        with EmulatorProcess(options) as emulator, Recorder(Path(folder) / "live.sqlite", time.time) as recorder:
            gyro = open_gyro(emulator.announcement()["gyro"], clock)
            gyro.connect()
            gyro.start()
            started, cpu = clock.now(), time.process_time()
            while clock.now() < started + LIVE_SECONDS:
                for block in gyro.read():
                    recorder.add_block(block)
                clock.wait(clock.now() + 0.05)
            cpu, wall = time.process_time() - cpu, clock.now() - started
            gyro.close()
            return {
                "live_cpu_percent": 100 * cpu / wall,
                "live_samples_per_s": recorder.n_samples / wall,
                "live_samples_lost": recorder.n_lost,
            }
