"""The manufacturer's own library drives the emulated Zaber controller, over a pseudo-terminal and over TCP."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from served import near_home, served

pytest.importorskip("zaber_motion")

from zaber_motion import exceptions
from zaber_motion.ascii import Connection

PATIENCE_MS = 30_000
DETECTION_MS = 4_000  # all of which the library waits for more devices
STEP = 3600.0  # microsteps a degree


@pytest.fixture
def connection(tmp_path: Path) -> Iterator[Connection]:
    """Connect to the controller on a pseudo-terminal, close to its references."""
    profile = near_home(power_up_deg=0.2, brisk=True)
    with (
        served(tmp_path, "stage", "zaber", profile) as address,
        Connection.open_serial_port(address) as connection,
    ):
        connection.default_request_timeout = PATIENCE_MS
        yield connection


def test_the_library_drives_the_controller(connection: Connection) -> None:
    """It finds the device, homes it, moves both axes, stops one, and reads the limits, with checksums on."""
    assert connection.checksum_enabled
    connection.default_request_timeout = DETECTION_MS
    assert [device.device_address for device in connection.detect_devices(identify_devices=False)] == [1]
    connection.default_request_timeout = PATIENCE_MS
    device = connection.get_device(1)
    azimuth, elevation = device.get_axis(1), device.get_axis(2)
    assert not azimuth.is_homed()
    assert azimuth.warnings.get_flags() == {"WR"}
    device.settings.set("comm.checksum", 1)
    device.all_axes.home()
    assert azimuth.is_homed()
    assert elevation.is_homed()
    azimuth.move_absolute(2 * STEP)
    elevation.move_relative(-STEP)
    assert [azimuth.get_position(), elevation.get_position()] == [2 * STEP, -STEP]
    azimuth.move_absolute(180 * STEP, wait_until_idle=False)
    assert azimuth.is_busy()
    assert not elevation.is_busy()
    azimuth.stop()
    assert not azimuth.is_busy()
    assert azimuth.get_position() < 180 * STEP
    assert [azimuth.settings.get("limit.min"), azimuth.settings.get("limit.max")] == [-380 * STEP, 380 * STEP]


def test_the_library_hears_refusals(connection: Connection) -> None:
    """A target beyond the limit, an unknown command, another axis, and a move before homing are refused by name."""
    device = connection.get_device(1)
    azimuth = device.get_axis(1)
    with pytest.raises(exceptions.BadDataException):
        azimuth.move_absolute(STEP)
    with pytest.raises(exceptions.BadDataException):
        azimuth.move_relative(400 * STEP)
    with pytest.raises(exceptions.BadCommandException):
        azimuth.generic_command("fly away")
    with pytest.raises(exceptions.BadCommandException):
        device.generic_command("renumber 3")
    with pytest.raises(exceptions.CommandFailedException, match="BADAXIS"):
        device.get_axis(3).generic_command("get pos")
    connection.checksum_enabled = False
    assert azimuth.generic_command("get version", check_errors=False).data == "DEVICEONLY"


def test_the_library_over_tcp(tmp_path: Path) -> None:
    """The same line over TCP."""
    with served(tmp_path, "stage", "zaber", near_home(), "--tcp") as address:
        host, port = address.removeprefix("socket://").split(":")
        with Connection.open_tcp(host, int(port)) as connection:
            assert connection.get_device(1).settings.get("deviceid") == 65001
