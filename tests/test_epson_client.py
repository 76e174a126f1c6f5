"""The manufacturer's own library finds, configures and reads the emulated Epson sensor on a pseudo-terminal."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from served import near_home, served

from sim_device.plant.profile import GyroProfile

pytest.importorskip("esensorlib")

from esensorlib.sensor_device import SensorDevice

LATITUDE, AZIMUTH = 50.429, 33.0
EARTH_RATE = math.degrees(7.292115e-5)  # deg/s
#: Input axis x points to the azimuth, level; a sensor without errors.
TRUE_RATE_X = EARTH_RATE * math.cos(math.radians(LATITUDE)) * math.cos(math.radians(AZIMUTH))
BASIC: dict[str, Any] = {
    "dout_rate": 200, "filter_sel": None, "ndflags": True, "tempc": True, "counter": "sample", "chksm": True,
    "auto_start": False, "uart_auto": True, "is_32bit": True, "a_range": False, "ext_trigger": False,
}  # fmt: skip


def sum_of(unscaled: tuple[int, ...], widths: str) -> int:
    """Return the sum of the 16-bit words of a burst's fields but the last."""
    total = 0
    for value, width in zip(unscaled[:-1], widths, strict=True):
        total += (value & 0xFFFF) + (value >> 16 & 0xFFFF if width == "i" else 0)
    return total & 0xFFFF


def test_the_library_reads_the_sensor(tmp_path: Path) -> None:
    """It detects the model, tests it, and reads bursts of 32 and 16 bits whose rates, sums and counters are right."""
    gyro = GyroProfile(model="M-G370PDS0", n_axes=3, sample_rate_hz=1000.0, range_dph=720_000.0)
    profile = replace(near_home(power_up_deg=0.0), gyro=gyro)
    options = ("--latitude", str(LATITUDE), "--azimuth", str(AZIMUTH))
    with served(tmp_path, "gyro", "epson", profile, *options) as address:
        sensor = SensorDevice(port=address, speed=460800)
        assert sensor.info["prod_id"] == "G370PDS0"
        assert sensor.info["serial_id"].rstrip("\0") == "SIM-G1"
        sensor.init_check()
        sensor.do_selftest()
        for bits, widths in ((32, "HiiiiiiiH"), (16, "H" * 9)):
            sensor.set_config(**BASIC | {"is_32bit": bits == 32})
            sensor.goto("sampling")
            assert len(sensor.burst_fields) == 10
            raw = [sensor.read_sample_unscaled() for _ in range(20)]
            scaled = sensor.read_sample()
            sensor.goto("config")
            assert all(sample[-1] == sum_of(sample, widths) for sample in raw)
            assert [b[-2] - a[-2] for a, b in pairwise(raw)] == [1] * 19
            assert scaled[1] == pytest.approx(24.0, abs=0.01)
            if bits == 32:
                assert scaled[2] == pytest.approx(TRUE_RATE_X, abs=2e-6)
                assert scaled[5:8] == pytest.approx((0.0, 0.0, -1000.0), abs=0.01)  # mg; its z axis points down
            else:
                assert scaled[2] == 0.0  # a third of a step: of no use
