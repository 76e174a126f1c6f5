"""The CAN drivers against the project's own nodes in virtual time: the same contract as on serial lines."""

from __future__ import annotations

from math import degrees, radians
from pathlib import Path

import numpy as np
import pytest
from can_virtual import CanVirtualBench, can_bench
from virtual import virtual_bench

from drivers.api import Gyro, Stage, StageLimits, StageMode, StageState
from drivers.cia402 import Cia402Stage, DriveOptions
from drivers.errors import DeviceFaultError, ProtocolError
from northfinder.config import read_config
from northfinder.cyclogram import six_position
from northfinder.errors import ConfigError
from northfinder.record import Record
from sim_device.can_bench import AZIMUTH_ID, ELEVATION_ID
from sim_device.firmware.can_axis import AxisNode

ARCSEC = radians(1 / 3600)
SHORT = six_position(10.0)


def drive_on(bench: CanVirtualBench, stage: Cia402Stage, duration: float) -> StageState:
    """Serve a stage for so long."""
    end = bench.clock.now() + duration
    return bench.serve(stage, lambda _: bench.clock.now() >= end)


# The whole way


def test_a_measurement_over_can_is_that_over_serial_lines(tmp_path: Path) -> None:
    """With one seed the dwells hold the same samples of the same world, so the fix is the same to a hundredth sd."""
    serial = virtual_bench(seed=5, azimuth_deg=200.0).measure(tmp_path / "serial.sqlite", SHORT)
    can = can_bench(seed=5, azimuth_deg=200.0).measure(tmp_path / "can.sqlite", SHORT)
    assert can.n_lost == 0
    assert can.fix.azimuth_sd == pytest.approx(serial.fix.azimuth_sd, rel=0.05)
    assert abs(can.fix.azimuth - serial.fix.azimuth) < 0.5 * serial.fix.azimuth_sd
    with Record(tmp_path / "can.sqlite") as record:
        blocks = list(record.blocks())
        assert record.meta("identities")["stage"]["protocol"] == "canopen 1, CiA 402"
    ends = np.cumsum([len(block.counts) for block in blocks])
    assert [block.first_index for block in blocks[1:]] == list(ends[:-1])
    times = np.diff([block.device_time for block in blocks])
    np.testing.assert_allclose(times, 47 / 235, atol=2e-6)


def test_the_drivers_are_what_the_instrument_needs() -> None:
    """The drivers satisfy the Protocols (the type checker reads this), and connect to the nodes."""
    bench = can_bench()
    gyro: Gyro = bench.open_gyro()
    stage: Stage = bench.open_stage()
    assert (gyro.connect().kind, stage.connect().kind) == ("gyro", "stage")
    assert (gyro.sample_rate, gyro.n_axes) == (235.0, 1)
    assert stage.limits.azimuth_max == pytest.approx(radians(380))
    assert gyro.self_test().passed
    assert stage.self_test().passed


def test_three_axes_come_together() -> None:
    """Of a three-axis gyro each sample holds the rates of one instant: those that the nodes sent under one number."""
    bench = can_bench("fast3")
    gyro = bench.open_gyro()
    gyro.connect()
    gyro.start()
    blocks = bench.stream(gyro, 1.0)
    gyro.stop()
    blocks += gyro.read()
    counts = np.concatenate([block.counts for block in blocks])
    sent = {axis: {} for axis in (0, 1, 2)}  # type: dict[int, dict[int, int]]
    for _, identifier, data in bench.tap.said:
        axis = {0x190: 0, 0x490: 1, 0x510: 2}.get(identifier)
        if axis is not None:
            sent[axis][int.from_bytes(data[4:7], "little")] = int.from_bytes(data[:4], "little", signed=True)
    assert counts.shape == (len(sent[0]), 3)
    assert len(counts) > 1900
    for axis in (0, 1, 2):
        assert counts[:, axis].tolist() == [sent[axis][index] for index in range(len(counts))]


def test_everything_is_written_and_read_back_before_the_drives_are_enabled() -> None:
    """Each object of the drives' set-up is downloaded, then uploaded, before the first controlword that enables."""
    bench = can_bench(
        drive=DriveOptions(
            acceleration=radians(2.0), homing_method=20, home_speed=radians(5.0), home_creep=radians(0.02)
        ),
        limits=StageLimits(
            azimuth_min=radians(-20), azimuth_max=radians(370), elevation_min=-1.0, elevation_max=1.0, max_speed=0.1
        ),
    )
    stage = bench.homed()
    enabled_at = next(i for i, (_, _, data) in enumerate(bench.tap.asked) if _enables(bench, i, data))
    requests = [data for _, identifier, data in bench.tap.asked[:enabled_at] if identifier == 0x600 + AZIMUTH_ID]
    for index, subindex in (
        (0x6007, 0), (0x605A, 0), (0x605E, 0), (0x607C, 0), (0x607D, 1), (0x607D, 2), (0x6083, 0), (0x6084, 0),
        (0x6098, 0), (0x6099, 1), (0x6099, 2), (0x6060, 0),
    ):  # fmt: skip
        written = _position(requests, 1, index, subindex)
        read = _position(requests, 2, 0x6061 if index == 0x6060 else index, subindex)
        assert 0 <= written < read, f"{index:04X}"
    assert _position(requests, 2, 0x1016, 1) >= 0
    assert _position(requests, 1, 0x1016, 1) < 0  # its default is right
    assert degrees(stage.limits.azimuth_min) == pytest.approx(-20)
    assert stage.limits.max_speed == 0.1
    assert stage.limits.max_acceleration == pytest.approx(radians(2.0))


def _position(requests: list[bytes], command: int, index: int, subindex: int) -> int:
    """Return where the last download (1) or upload (2) of an object stands among SDO requests, -1 if nowhere."""
    target = index.to_bytes(2, "little") + bytes([subindex])
    found = [i for i, data in enumerate(requests) if data[0] >> 5 == command and data[1:4] == target]
    return found[-1] if found else -1


def _enables(bench: CanVirtualBench, index: int, data: bytes) -> bool:
    return bench.tap.asked[index][1] == 0x200 + AZIMUTH_ID and data[0] & 0x0F == 0x0F


def test_the_set_point_handshake() -> None:
    """Of a move each axis gets: its target without bit 4, with bit 4, and once it has set bit 12, without it again."""
    bench = can_bench()
    stage = bench.homed()
    n_before, n_said = len(bench.tap.asked), len(bench.tap.said)
    stage.move(radians(30), radians(-10), speed=radians(5))
    state = bench.serve(stage, lambda state: state.in_position)
    assert (state.azimuth, state.elevation) == pytest.approx((radians(30), radians(-10)), abs=30 * ARCSEC)
    for node, target in ((AZIMUTH_ID, 1_080_000), (ELEVATION_ID, -360_000)):
        words = [data for _, identifier, data in bench.tap.asked[n_before:] if identifier == 0x200 + node][-3:]
        assert [int.from_bytes(word[:2], "little") for word in words] == [0x0F, 0x1F, 0x0F]
        assert {int.from_bytes(word[2:6], "little", signed=True) for word in words} == {target}
        statuses = [data for _, identifier, data in bench.tap.said[n_said:] if identifier == 0x180 + node]
        bits = [status[1] >> 4 & 1 for status in statuses]
        assert 1 in bits
        assert bits[-1] == 0


def test_a_move_speed_reaches_the_drives() -> None:
    """The stage never turns faster than asked: 6081 was written to both drives."""
    bench = can_bench()
    stage = bench.homed()
    stage.move(radians(30), radians(20), speed=radians(3))
    rates = []
    while not (state := stage.state()).in_position:
        rates.append(max(abs(state.azimuth_rate), abs(state.elevation_rate)))
        bench.clock.wait(bench.clock.now() + 0.05)
    assert max(rates) == pytest.approx(radians(3), rel=0.05)


def test_targets_beyond_the_limits_are_refused_by_the_host() -> None:
    """A target outside the limits, or a speed beyond them, is a ValueError, and nothing is sent to the drives."""
    bench = can_bench()
    stage = bench.homed()
    n_asked = len(bench.tap.asked)
    for azimuth, elevation, speed, name in (
        (7.0, 0.0, 0.1, "azimuth"),
        (0.0, 2.0, 0.1, "elevation"),
        (0, 0, 9.0, "speed"),
    ):
        with pytest.raises(ValueError, match=f"{name} .* lies outside the stage's limits"):
            stage.move(azimuth, elevation, speed=speed)
    assert len(bench.tap.asked) == n_asked


def test_nothing_moves_before_homing_and_connect_moves_nothing() -> None:
    """A move of a stage that is not homed is refused; connecting and self-tests set nothing in motion."""
    bench = can_bench()
    stage = bench.open_stage()
    stage.connect()
    stage.self_test()
    with pytest.raises(DeviceFaultError, match="must be homed first"):
        stage.move(0.1, 0.0)
    assert bench.bench.plant_stage.rest_since_us() == 0
    assert stage.state().mode is StageMode.NOT_HOMED


def test_a_homed_stage_need_not_home_again() -> None:
    """Who connects to drives that are homed finds them so, and they stand where they stood."""
    bench = can_bench()
    first = bench.homed()
    first.move(0.2, 0.1)
    bench.serve(first, lambda state: state.in_position)
    first.close()
    second = bench.open_stage()
    second.connect()
    state = second.state()
    assert state.mode is StageMode.IDLE
    assert (state.azimuth, state.elevation) == pytest.approx((0.2, 0.1), abs=30 * ARCSEC)


def test_stop_in_motion_and_on_again() -> None:
    """A stop brings both axes to rest in a fraction of a second, and the next move needs no more than itself."""
    bench = can_bench()
    stage = bench.homed()
    stage.move(radians(90), radians(45))
    drive_on(bench, stage, 2.0)
    begun = bench.clock.now()
    stage.stop()
    state = bench.serve(stage, lambda state: state.mode is StageMode.IDLE)
    assert bench.clock.now() - begun < 0.5
    assert not state.in_position
    stage.move(radians(5), 0.0)
    assert bench.serve(stage, lambda state: state.in_position).azimuth == pytest.approx(radians(5), abs=30 * ARCSEC)


# Faults


def test_a_fault_is_reset_on_request_alone_and_enables_nothing() -> None:
    """After an emergency stop nothing moves until `clear_fault`, which leaves both drives without power."""
    bench = can_bench()
    stage = bench.homed()
    stage.move(radians(90), 0.0)
    bench.clock.wait(bench.clock.now() + 0.05)
    bench.bench.plant_stage.e_stop = True
    state = bench.serve(stage, lambda state: state.mode is StageMode.FAULT)
    assert state.fault.startswith("E_STOP")
    drive_on(bench, stage, 2.0)
    assert stage.state().fault == "E_STOP"
    with pytest.raises(DeviceFaultError, match="the fault E_STOP must be cleared first"):
        stage.move(0.0, 0.0)
    with pytest.raises(DeviceFaultError, match="keeps the fault E_STOP"):
        stage.clear_fault()
    bench.bench.plant_stage.e_stop = False
    n_asked = len(bench.tap.asked)
    stage.clear_fault()
    words = [data[0] for _, identifier, data in bench.tap.asked[n_asked:] if identifier == 0x200 + AZIMUTH_ID]
    assert 0x80 in words
    assert not any(word & 0x0F == 0x0F for word in words)
    assert stage.state().mode is StageMode.IDLE
    assert bench.bench.azimuth.node.dictionary.read(0x604100)[0] & 0x6F == 0x40  # SWITCH ON DISABLED
    stage.move(radians(10), 0.0)
    bench.serve(stage, lambda state: state.in_position)


def test_a_fault_of_one_axis_stops_the_other() -> None:
    """When the azimuth axis stalls the elevation axis is brought to rest too, and the state names the axis."""
    bench = can_bench()
    stage = bench.homed()
    stage.move(radians(90), radians(90))
    bench.clock.wait(bench.clock.now() + 0.05)
    bench.bench.plant_stage.azimuth.stall(bench.bench.now_us)
    state = bench.serve(stage, lambda state: state.mode is StageMode.FAULT)
    assert state.fault == "STALL (azimuth)"
    state = drive_on(bench, stage, 1.0)
    assert state.elevation_rate == 0.0
    assert state.elevation < radians(45)


def test_the_drives_stop_when_the_host_dies() -> None:
    """A host that falls silent in motion leaves both axes at rest within 300 ms of its last heartbeat."""
    bench = can_bench()
    stage = bench.homed()
    stage.move(radians(90), radians(45))
    drive_on(bench, stage, 1.0)
    last = max(at_us for at_us, identifier, _ in bench.tap.asked if identifier == 0x77F)
    bench.clock.sleep_until(last * 1e-6 + 0.3)
    stopped = _encoders(bench)
    bench.clock.sleep_until(bench.clock.now() + 3.0)
    assert _encoders(bench) == pytest.approx(stopped, abs=50)  # 5 arcsec
    assert bench.bench.azimuth.node.dictionary.read(0x603F00) == b"\x30\x81"


def _encoders(bench: CanVirtualBench) -> list[int]:
    """Return the counts of both axes' encoders."""
    return [bench.bench.stage_board.encoder(axis, bench.bench.now_us) for axis in (0, 1)]


def of_the_market(identifier: int, data: bytes) -> list[tuple[int, bytes]]:
    """Let the axes be another maker's: another vendor and product."""
    if identifier in {0x580 + AZIMUTH_ID, 0x580 + ELEVATION_ID} and data[1:4] in {b"\x18\x10\x01", b"\x18\x10\x02"}:
        return [(identifier, data[:4] + b"\xef\xbe\xad\xde")]
    return [(identifier, data)]


def test_drives_of_the_market_work_by_standard_objects_alone() -> None:
    """Of a drive that is not ours only standard objects are touched; its units, also reversed, are options."""
    bench = can_bench(drive=DriveOptions(units_per_turn=(12_960_000.0, -12_960_000.0)))
    bench.tap.to_host = of_the_market
    stage = bench.homed()
    stage.move(radians(30), radians(10))
    state = bench.serve(stage, lambda state: state.in_position)
    assert (state.azimuth, state.elevation) == pytest.approx((radians(30), radians(10)), abs=30 * ARCSEC)
    positions = [axis.drive.position(bench.bench.now_us) for axis in _axes(bench)]
    assert positions == pytest.approx([1_080_000, -360_000], abs=300)
    assert state.device_time == pytest.approx(bench.clock.now(), abs=0.2)
    stage.stop()
    stage.close()
    requests = [data for _, identifier, data in bench.tap.asked if identifier in {0x620, 0x621}]
    assert not [data for data in requests if 0x20 <= data[2] < 0x60 and data[0] >> 5 in {1, 2}]


def _axes(bench: CanVirtualBench) -> list[AxisNode]:
    """Return the firmware of both axes."""
    nodes = [bench.bench.azimuth.node, bench.bench.elevation.node]
    return [node for node in nodes if isinstance(node, AxisNode)]


@pytest.mark.parametrize(
    ("index", "value", "complaint"),
    [
        (b"\x00\x10\x00", 0x191, "is no drive of CiA 402: its device type is 00000191"),
        (b"\x10\x20\x00", 1, "is the other axis"),
    ],
)
def test_another_device_is_refused(index: bytes, value: int, complaint: str) -> None:
    """A node that is no drive, or the other axis, is named as such before anything is written to it."""
    bench = can_bench()
    bench.tap.to_host = lambda identifier, data: [
        (identifier, data[:4] + value.to_bytes(4, "little") if data[1:4] == index and identifier == 0x5A0 else data)
    ]
    with pytest.raises(ProtocolError, match=complaint):
        bench.open_stage().connect()
    assert not [data for _, identifier, data in bench.tap.asked if identifier == 0x620 and data[0] >> 5 == 1]


def test_the_configuration_tells_the_drives(tmp_path: Path) -> None:
    """The bench file's [stage.drive] becomes the driver's options, in SI; it is for such stages only, and checked."""
    bench = tmp_path / "bench.toml"
    text = """[gyro]
address = "canopen-gyro:virtual:b/16"
[stage]
address = "{}"
[stage.drive]
azimuth_units_per_turn = -3600.0
homing_method = 33
home_speed_deg_s = {}
"""
    bench.write_text(text.format("cia402-stage:virtual:b/32,33", 9))

    def drive_options() -> object:
        stage = read_config(bench).stage
        assert stage is not None
        return stage.driver_options()["drive"]

    options = drive_options()
    assert options == DriveOptions(units_per_turn=(-3600.0, None), homing_method=33, home_speed=radians(9))
    bench.write_text(text.format("native:/dev/ttyUSB0", 9))
    with pytest.raises(ConfigError, match="is for a cia402-stage, not for native:/dev/ttyUSB0"):
        drive_options()
    bench.write_text(text.format("cia402-stage:virtual:b/32,33", -1))
    with pytest.raises(ConfigError, match="home_speed must be positive"):
        drive_options()
