"""Measure the instrument on CAN buses: ``python tools/bench_can.py [--json]``.

can_find         wall time of ``find --speed max`` of 16 min of data over socketcand, both processes' start included
can_live         processor time of transport, driver and record of this process, over slcan at 1,000 samples/s of one
                 axis in real time, in bursts of 0.2 s; can_live_single with each sample by itself
python_can_slcan processor time of python-can's own reader for the same frames as single samples, and nothing else
"""

from __future__ import annotations

import argparse
import contextlib
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from importlib import resources
from pathlib import Path

import can

from drivers.canopen_gyro import open_gyro
from drivers.transport.clock import SystemClock
from northfinder.cli.emulator import EmulatorProcess, SimulationOptions
from northfinder.record.recorder import Recorder

#: What the project promises; the figures are printed beside them.
LIMITS = {"can_find_wall_s": 12.0, "can_live_cpu_percent": 40.0, "can_live_single_cpu_percent": 40.0}
LIVE_SECONDS = 20.0


def bench_find() -> dict[str, float]:
    """Time three whole measurements of 16 min of data, the published cyclogram, over socketcand."""
    walls = []
    for seed in range(3):
        started = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-m", "northfinder", "find", "--json", "--quiet", "--speed", "max"]
            options = ["--plan", "six-position", "--bus", "socketcand", "--seed", str(seed), "--out", folder]
            subprocess.run([*command, *options], stdout=subprocess.DEVNULL, check=True)
        walls.append(time.perf_counter() - started)
    return {"can_find_wall_s": statistics.median(walls)}


@contextlib.contextmanager
def emulated_gyro() -> Iterator[str]:
    """Yield the place of an emulated gyro of 1,000 samples/s on an slcan bus at real time."""
    with tempfile.TemporaryDirectory() as folder:
        profile = Path(folder) / "fast1.toml"
        fast3 = (resources.files("sim_device.plant") / "profiles" / "fast3.toml").read_text()
        profile.write_text(fast3.replace("n_axes = 3", "n_axes = 1").replace("= 2000.0", "= 1000.0"))
        options = SimulationOptions(
            azimuth_deg=33.0, latitude_deg=50.0, profile=str(profile), seed=1, speed="1", bus="slcan"
        )
        with EmulatorProcess(options) as emulator:
            yield emulator.announcement()["gyro"].removeprefix("canopen-gyro:")


def bench_live(name: str, block_duration: float) -> dict[str, float]:
    """Measure this process while it reads and records the gyro in real time."""
    clock = SystemClock()
    with emulated_gyro() as place, tempfile.TemporaryDirectory() as folder:
        gyro = open_gyro(place, clock, block_duration=block_duration)
        with Recorder(Path(folder) / "live.sqlite", time.time) as recorder, contextlib.closing(gyro):
            gyro.connect()
            gyro.start()
            started, cpu = clock.now(), time.process_time()
            while clock.now() < started + LIVE_SECONDS:
                for block in gyro.read():
                    recorder.add_block(block)
                clock.wait(clock.now() + 0.05)
            cpu, wall = time.process_time() - cpu, clock.now() - started
            return {
                f"{name}_cpu_percent": 100 * cpu / wall,
                f"{name}_samples_per_s": recorder.n_samples / wall,
                f"{name}_samples_lost": recorder.n_lost,
            }


def bench_python_can() -> dict[str, float]:
    """Measure python-can's reader alone: start the stream by hand, and take each frame."""
    with emulated_gyro() as place:
        channel, _, rest = place.removeprefix("slcan:").partition("@")
        with can.Bus(channel, interface="slcan", bitrate=int(rest.partition("/")[0]), sleep_after_open=0) as bus:
            for identifier, text in ((0, "0110"), (0x610, "2f13200001000000"), (0x610, "2f20200001000000")):
                bus.send(can.Message(arbitration_id=identifier, data=bytes.fromhex(text), is_extended_id=False))
            started, cpu, n_samples = time.monotonic(), time.process_time(), 0
            while time.monotonic() < started + LIVE_SECONDS:
                message = bus.recv(0.05)
                n_samples += message is not None and message.arbitration_id == 0x190
            wall = time.monotonic() - started
            return {
                "python_can_slcan_cpu_percent": 100 * (time.process_time() - cpu) / wall,
                "python_can_slcan_samples_per_s": n_samples / wall,
            }


def main() -> None:
    """Measure, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    arguments = parser.parse_args()
    figures = bench_find() | bench_live("can_live", 0.2) | bench_live("can_live_single", 0.0) | bench_python_can()
    if arguments.json:
        print(json.dumps(figures))
        return
    for name, value in figures.items():
        limit = f"   (promised: {LIMITS[name]:g})" if name in LIMITS else ""
        print(f"{name:32} {value:12,.3f}{limit}")


if __name__ == "__main__":
    main()
