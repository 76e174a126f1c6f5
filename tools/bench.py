"""Measure how fast and how large the instrument is: ``python tools/bench.py [--json] [NAME...]``.

find     wall time and memory of a whole ``find --speed max``, both processes' start included
decode   bytes of the wire to arrays
live     processor time of transport, driver and record at 2,000 samples/s of three axes
record   processor time of the recorder alone at 2,000 samples/s of three axes; size and ``solve`` of an hour of it
estimate time of an estimate from 16 min and from 24 h of 1 s means
stim300  frames a second decoded; processor time of transport, driver and record at 2,000 samples/s
kvh      frames a second decoded
epson    frames a second decoded
table    wall time and memory of ``solve`` on a static triad as CSV, an hour at 2,000 samples/s
plan     wall time of ``northfinder plan`` with its plot
help     wall time of ``northfinder --help``
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from bench_gyros import bench_epson, bench_kvh, bench_stim300

from drivers.api import ByteLink, RateBlock
from drivers.native import NativeGyro, open_gyro
from drivers.protocol.framing import FrameDecoder
from drivers.protocol.native import decode_samples
from drivers.transport.clock import SystemClock
from drivers.transport.virtual import VirtualClock, VirtualLink
from northfinder.cli.emulator import EmulatorProcess, SimulationOptions
from northfinder.estimation import RateMeans
from northfinder.record import DwellSpan
from northfinder.record.recorder import Recorder
from northfinder.solution import Assumptions, solve
from northfinder.units import DPH
from sim_device.bench import SimBench

#: What the project promises; the figures are printed beside them.
LIMITS = {
    "find_wall_s": 4.0,
    "find_memory_mb": 150.0,
    "decode_samples_per_s": 1e6,
    "live_cpu_percent": 5.0,
    "record_cpu_percent": 2.0,
    "record_hour_mb": 120.0,
    "record_hour_solve_s": 3.0,
    "estimate_16_min_s": 0.03,
    "estimate_24_h_s": 2.0,
    "stim300_frames_per_s": 5e5,
    "stim300_live_cpu_percent": 6.0,
    "kvh_frames_per_s": 5e5,
    "epson_frames_per_s": 5e5,
    "table_wall_s": 3.0,
    "plan_wall_s": 5.0,
    "help_wall_s": 0.5,
}
LIVE_SECONDS = 20.0


def run_timed(arguments: list[str]) -> tuple[float, float]:
    """Run ``northfinder`` and return its wall time in s and its greatest resident memory in MB."""
    started = time.perf_counter()
    child = subprocess.Popen([sys.executable, "-m", "northfinder", *arguments], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise SystemExit(f"northfinder {' '.join(arguments)} ended with exit code {child.returncode}")
    return time.perf_counter() - started, usage.ru_maxrss / 1024


def bench_find() -> dict[str, float]:
    """Time five whole measurements of 16 min of data, the published cyclogram."""
    command = ["find", "--json", "--quiet", "--speed", "max", "--plan", "six-position"]
    with tempfile.TemporaryDirectory() as folder:
        runs = [run_timed([*command, "--seed", str(seed), "--out", folder]) for seed in range(5)]
    return {
        "find_wall_s": statistics.median(wall for wall, _ in runs),
        "find_memory_mb": max(memory for _, memory in runs),
    }


class Tap:
    """A link that keeps what comes through it."""

    def __init__(self, link: ByteLink) -> None:
        """Listen to `link`."""
        self.link = link
        self.name = link.name
        self.kept = bytearray()

    def write(self, data: bytes) -> None:
        """Hand on."""
        self.link.write(data)

    def receive(self) -> bytes:
        """Hand on, and keep."""
        data = self.link.receive()
        self.kept += data
        return data

    def close(self) -> None:
        """Hand on."""
        self.link.close()


def sampled_wire(seconds: float) -> bytes:
    """Return what an emulated gyro sends in `seconds`: SAMPLES frames of 47 samples."""
    clock = VirtualClock()
    tap = Tap(VirtualLink(SimBench("tvg43", seed=1).gyro, clock))
    gyro = NativeGyro(tap, clock)
    gyro.connect()
    gyro.start()
    tap.kept.clear()
    while clock.now() < seconds:
        gyro.read()
        clock.wait(clock.now() + 1.0)
    return bytes(tap.kept)


def bench_decode() -> dict[str, float]:
    """Time the way from bytes to arrays of rates on frames of 47 samples."""
    wire = sampled_wire(seconds=400.0)
    n_samples, best = 0, np.inf
    for _ in range(5):
        started = time.perf_counter()
        decoder = FrameDecoder()
        batches = [decode_samples(decoder.feed(wire[i : i + 4096])) for i in range(0, len(wire), 4096)]
        best = min(best, time.perf_counter() - started)
        n_samples = sum(records["rate"].size for batch in batches for records in batch)
    return {"decode_samples_per_s": n_samples / best}


def bench_live() -> dict[str, float]:
    """Measure this process while it reads and records a fast gyro in real time."""
    clock = SystemClock()
    options = SimulationOptions(azimuth_deg=33.0, latitude_deg=50.0, profile="fast3", seed=1, speed="1")
    with EmulatorProcess(options) as emulator, tempfile.TemporaryDirectory() as folder:
        address = emulator.announcement()["gyro"].removeprefix("native:")
        with Recorder(Path(folder) / "live.sqlite", time.time) as recorder:
            gyro = open_gyro(address, clock)
            gyro.connect()
            gyro.start()
            started, cpu = clock.now(), time.process_time()
            while clock.now() < started + LIVE_SECONDS:
                for block in gyro.read():
                    recorder.add_block(block)
                clock.wait(clock.now() + 0.05)
            cpu, wall = time.process_time() - cpu, clock.now() - started
            gyro.close()
            rate, lost = recorder.n_samples / wall, recorder.n_lost
    return {"live_cpu_percent": 100 * cpu / wall, "live_samples_per_s": rate, "live_samples_lost": lost}


def fast_blocks(seconds: float) -> Iterator[RateBlock]:
    """Yield blocks of 39 samples of three axes at 2,000 samples/s, at rest in four positions, half a minute each."""
    noise = np.random.default_rng(1).normal(0.0, 300 * DPH, (200, 39, 3))
    for number in range(round(seconds * 2000 / 39)):
        first = 39 * number
        azimuth = first // 60_000 % 4 * np.pi / 2
        rate = noise[number % 200] + 9 * DPH * np.array([np.cos(azimuth + 0.5), -np.sin(azimuth + 0.5), 1.0])
        yield RateBlock(
            first_index=first, device_time=first / 2000, arrival_time=first / 2000, rate_lsb=1e-9,
            counts=np.asarray(rate / 1e-9, dtype=np.int32), temperature=25.0 + 1e-4 * number, tilt=(1e-5, 1.3e-5),
        )  # fmt: skip


def bench_record() -> dict[str, float]:
    """Record in real time, with nothing else to do; then an hour as fast as it goes, and solve that."""
    clock = SystemClock()
    with tempfile.TemporaryDirectory() as folder:
        blocks = list(fast_blocks(LIVE_SECONDS))
        with Recorder(Path(folder) / "live.sqlite", time.time, clock=clock.now) as recorder:
            started, cpu = clock.now(), time.process_time()
            for block in blocks:
                clock.sleep_until(started + block.arrival_time)
                recorder.add_block(block)
            cpu, wall = time.process_time() - cpu, clock.now() - started
        path = Path(folder) / "hour.sqlite"
        with Recorder(path, lambda: 1e9, clock=clock.now) as recorder:
            assumptions = Assumptions.gather(method="generalised", profile="tvg43", latitude_deg=50.0, g_drift_dph=None)
            recorder.set_meta("assumptions", assumptions)
            recorder.begin_stream({}, sample_rate=2000.0, n_axes=3)
            for block in fast_blocks(3600.0):
                recorder.add_block(block)
            for number in range(119):
                azimuth, first = number % 4 * np.pi / 2, 60_000 * number + 6000
                recorder.add_step(
                    DwellSpan(
                        step=number, name="", azimuth=azimuth, elevation=0.0, dwell=27.0, measured_azimuth=azimuth,
                        measured_elevation=0.0, first_index=first, stop_index=first + 54_000, sample_rate=2000.0,
                    )
                )  # fmt: skip
        solving = statistics.median(run_timed(["solve", str(path), "--json"])[0] for _ in range(3))
        size = path.stat().st_size / 1e6
    return {"record_cpu_percent": 100 * cpu / wall, "record_hour_mb": size, "record_hour_solve_s": solving}


def four_positions(seconds: int) -> RateMeans:
    """Return means of 1 s on four positions in turn, 27 s each and 3 s a turn, with white noise."""
    second = np.arange(seconds)
    dwell = second // 27
    rate = 38 * DPH + 9 * DPH * np.cos(dwell * np.pi / 2 + 0.5) + np.random.default_rng(1).normal(0, DPH, seconds)
    return RateMeans(
        start=second + 3.0 * dwell, duration=np.ones(seconds), rate=rate, azimuth=dwell % 4 * np.pi / 2,
        elevation=np.zeros(seconds), dwell=dwell, n_samples=np.full(seconds, 235),
    )  # fmt: skip


def bench_estimate() -> dict[str, float]:
    """Time the estimate of a whole measurement and of a day, disturbed seconds looked for and all checks made."""
    assumptions = Assumptions.gather(method="generalised", profile="tvg43", latitude_deg=50.0, g_drift_dph=None)
    figures = {}
    for name, seconds, n_runs in (("estimate_16_min_s", 960, 20), ("estimate_24_h_s", 86_400, 3)):
        means = four_positions(seconds)
        times = []
        for _ in range(n_runs):
            started = time.perf_counter()
            solve(means, assumptions)
            times.append(time.perf_counter() - started)
        figures[name] = statistics.median(times)
    return figures


def bench_table() -> dict[str, float]:
    """Time a triad turned over after half an hour; each half minute is a copy, which the reader does not know."""
    rng = np.random.default_rng(1)
    names = "position,time_s,gyro_x_dph,gyro_y_dph,gyro_z_dph,accel_x_ms2,accel_y_ms2,accel_z_ms2\n"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "triad.csv"
        with path.open("w", encoding="ascii") as file:
            file.write(names)
            for position, sign in (("up", 1.0), ("down", -1.0)):
                rate = np.array([sign * 11.7, 5.0, -3.0 * sign]) + 40.0 * rng.standard_normal((60_000, 3))
                force = np.array([sign * 9.806, 0.01, 0.06 * sign]) + 0.003 * rng.standard_normal((60_000, 3))
                rows = zip(rate.round(4).tolist(), force.round(6).tolist(), strict=True)
                text = "".join(
                    f"{position},{i / 2000:.4f},{','.join(map(repr, (*w, *a)))}\n" for i, (w, a) in enumerate(rows)
                )
                for _ in range(60):
                    file.write(text)
        wall, memory = run_timed(["solve", str(path), "--json"])
        return {"table_wall_s": wall, "table_memory_mb": memory, "table_size_mb": path.stat().st_size / 1e6}


def bench_plan() -> dict[str, float]:
    """Time the search for the best plan of 16 min, latitude included, with its plot."""
    with tempfile.TemporaryDirectory() as folder:
        plot = str(Path(folder) / "plan.svg")
        command = ["plan", "--profile", "tvg43", "--time", "960", "--need-latitude", "--plot", plot]
        return {"plan_wall_s": run_timed(command)[0]}


def bench_help() -> dict[str, float]:
    """Time the help page."""
    return {"help_wall_s": statistics.median(run_timed(["--help"])[0] for _ in range(5))}


BENCHES: dict[str, Callable[[], dict[str, float]]] = {
    "find": bench_find,
    "decode": bench_decode,
    "live": bench_live,
    "record": bench_record,
    "estimate": bench_estimate,
    "stim300": bench_stim300,
    "kvh": bench_kvh,
    "epson": bench_epson,
    "table": bench_table,
    "plan": bench_plan,
    "help": bench_help,
}


def main() -> None:
    """Run the benches named, or all, and print their figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", choices=[[], *BENCHES], default=[], metavar="NAME")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    arguments = parser.parse_args()
    figures: dict[str, float] = {}
    for name in arguments.names or BENCHES:
        print(f"{name} ...", file=sys.stderr)
        figures |= BENCHES[name]()
    if arguments.json:
        print(json.dumps(figures))
        return
    for name, value in figures.items():
        limit = f"   (promised: {LIMITS[name]:,g})" if name in LIMITS else ""
        print(f"{name:24} {value:14,.3f}{limit}")


if __name__ == "__main__":
    main()
