"""The whole bench in virtual time: plant, boards and firmware together, as a host meets them."""

from __future__ import annotations

import math
import struct

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from raw_host import (
    FAULT,
    HOME,
    HOMING,
    IDENTITY,
    IDLE,
    MOVING,
    SAMPLES,
    STAGE_STATUS,
    STREAM_START,
    Decoder,
    Samples,
    Status,
    heartbeat,
    hello,
    move,
    parse_samples,
    parse_status,
    request,
)

from sim_device.bench import SimBench
from sim_device.faults import FaultSpec, schedule
from sim_device.plant.earth import EARTH_RATE
from sim_device.plant.gyro import ARCSEC, DPH
from sim_device.plant.noise import RecordedNoise
from sim_device.plant.profile import AccelerometerProfile, load_profile

SECOND = 1_000_000


class Host:
    """Drives both lines of a bench in virtual time and acknowledges what it hears, unless told to fall silent."""

    def __init__(self, bench: SimBench) -> None:
        self.bench = bench
        self.now = 0
        self.silent = False
        self.samples: list[Samples] = []
        self.statuses: list[Status] = []
        self.bodies: list[bytes] = []
        self._decoders = {line.name: Decoder() for line in bench.lines}
        for line in bench.lines:
            line.feed(hello(), 0)

    def service(self) -> None:
        """Take what has come from both devices by now."""
        for line in self.bench.lines:
            for body in self._decoders[line.name].feed(line.poll(self.now)):
                self.bodies.append(body)
                if body[0] == SAMPLES:
                    self.samples.append(parse_samples(body))
                elif body[0] == STAGE_STATUS:
                    self.statuses.append(parse_status(body))
                    if not self.silent:
                        line.feed(heartbeat(self.statuses[-1].time_us), self.now)

    def run(self, seconds: float) -> None:
        """Let time pass."""
        end = self.now + round(seconds * SECOND)
        while self.now < end:
            due = [instant for line in self.bench.lines if (instant := line.next_due_us()) is not None]
            self.now = min(*due, end)
            self.service()

    def run_until(self, state: int, *, within: float = 120.0) -> Status:
        """Let time pass until the stage reports that state, and return its report."""
        end = self.now + round(within * SECOND)
        self.statuses.clear()
        while self.now < end:
            self.run(0.01)
            found = [status for status in self.statuses if status.state == state]
            if found:
                return found[0]
        raise AssertionError(f"no state {state} within {within} s, only {self.statuses[-1:]}")

    def home(self) -> None:
        """Home the stage."""
        self.bench.stage.feed(request(HOME, 1), self.now)
        self.run_until(IDLE)


def rates_dph(samples: list[Samples]) -> NDArray[np.float64]:
    """Return all rates in deg/h, shape (n,)."""
    return np.array([count for block in samples for count in block.counts]) / 1024


def test_both_devices_answer_hello() -> None:
    """Each device says what it is, from the profile."""
    host = Host(SimBench("tvg43", seed=17))
    host.service()
    identities = [body for body in host.bodies if body[0] == IDENTITY]
    assert [(body[11], body[24:40].rstrip(b"\0"), body[40:56].rstrip(b"\0")) for body in identities] == [
        (2, b"stage2", b"SIM-S17"),
        (1, b"tvg43", b"SIM-G17"),
    ]


def test_homing_finds_the_true_reference() -> None:
    """After homing the stage stands at its true zero within the edge's repeatability, wherever it was at power-up."""
    for seed in range(3):
        host = Host(SimBench("tvg43", seed=seed))
        host.home()
        true = [axis.true_angle(host.now) / ARCSEC for axis in host.bench.plant_stage.axes]
        assert np.abs(true).max() < 3.0


def test_quarter_turn_takes_ten_seconds() -> None:
    """With the profile tvg43 the stage turns 90 deg in 10 s, to within the positioning error."""
    bench = SimBench("tvg43", seed=2)
    host = Host(bench)
    host.home()
    begin, before = host.now, bench.plant_stage.azimuth.true_angle(host.now)
    bench.stage.feed(move(2, 90.0), host.now)
    status = host.run_until(IDLE)
    assert (status.time_us - begin) / SECOND == pytest.approx(10.0, abs=0.05)
    assert status.azimuth == pytest.approx(90 * 36_000, abs=5)
    turned = bench.plant_stage.azimuth.true_angle(host.now) - before
    assert math.degrees(turned) * 3600 == pytest.approx(90 * 3600, abs=15)


def test_four_positions_over_the_wire() -> None:
    """With the profile ideal, the rates that arrive at four positions and up are the earth's, to the wire's LSB."""
    azimuth, latitude = math.radians(33.0), math.radians(-65.0)
    bench = SimBench("ideal", seed=1, azimuth=azimuth, latitude=latitude, tilt=(30 * ARCSEC, 0.0))
    host = Host(bench)
    host.home()
    bench.gyro.feed(request(STREAM_START, 1), host.now)
    for number, (stage_azimuth, elevation) in enumerate([(0, 0), (90, 0), (180, 0), (270, 0), (0, 90)], start=2):
        bench.stage.feed(move(number, stage_azimuth, elevation), host.now)
        host.run_until(IDLE)
        host.run(0.5)
        block = host.samples[-1]
        a = azimuth + math.radians(stage_azimuth)
        e = math.radians(elevation)
        level = EARTH_RATE * (math.cos(latitude) * math.cos(e) * math.cos(a) + math.sin(latitude) * math.sin(e))
        assert np.ptp(block.counts) == 0
        assert block.counts[0] / 1024 == pytest.approx(level / DPH, abs=4e-3)  # 30 arcsec of tilt: up to 2.2e-3
        assert block.tilt == (300, 0)
    assert [block.index for block in host.samples] == [47 * k for k in range(len(host.samples))]


def test_how_the_lines_are_driven_changes_nothing() -> None:
    """The gyro's samples are the same whether both lines are asked in turn or only the gyro, and at any instants."""

    def stream(steps: list[int], *, ask_stage: bool) -> bytes:
        bench = SimBench("tvg43", seed=3)
        for line in bench.lines:
            line.feed(hello(), 0)
        bench.gyro.feed(request(STREAM_START, 1), 0)
        bench.stage.feed(request(HOME, 1), 0)
        for beat in range(1, 40):  # keeps the stage moving, whoever listens
            instant = beat * 200_000
            bench.at(instant, lambda seen=instant: bench.stage.feed(heartbeat(seen), seen))  # type: ignore[misc]  # default
        out, now = bytearray(), 0
        for step in steps:
            now += step
            if ask_stage:
                bench.stage.poll(now)
            out += bench.gyro.poll(now)
        out += bench.gyro.poll(8 * SECOND)
        return bytes(out)

    alone = stream([8 * SECOND], ask_stage=False)
    assert len(alone) > 30 * 188
    assert stream([3_333] * 2_000, ask_stage=True) == alone
    assert stream([1, 777_777, 10, 1_234_567], ask_stage=True) == alone


def test_same_seed_same_run() -> None:
    """Two benches with the same seed send the same bytes; another seed sends others."""

    def samples(seed: int) -> list[Samples]:
        host = Host(SimBench("tvg43", seed=seed))
        host.bench.gyro.feed(request(STREAM_START, 1), 0)
        host.run(2.0)
        return host.samples

    assert samples(5) == samples(5)
    assert samples(5) != samples(6)


@pytest.mark.parametrize(
    ("fault", "code"),
    [
        ("e-stop", 2),
        ("stall=azimuth", 3),
        ("runaway=azimuth", 4),
        ("encoder-freeze=azimuth", 5),
        ("encoder-jump=azimuth", 5),
        ("limit-switch=elevation", 6),
    ],
)
def test_plant_faults_reach_the_firmware(fault: str, code: int) -> None:
    """Each fault of the plant, in mid-move, is told by its own code, and the axis comes to rest."""
    host = Host(SimBench("tvg43", seed=4))
    host.home()
    host.bench.stage.feed(move(2, -90.0, -45.0), host.now)
    host.run_until(MOVING)
    schedule([FaultSpec.parse(f"stage:{fault}@{host.now / SECOND + 4:.6f}")], host.bench)
    assert host.run_until(FAULT, within=8.0).fault == code
    if fault.startswith("runaway"):
        host.bench.plant_stage.azimuth.run_away(host.now, 0.0)
    host.run(5.0)
    where = [axis.true_angle(host.now) for axis in host.bench.plant_stage.axes]
    host.run(1.0)
    assert [axis.true_angle(host.now) for axis in host.bench.plant_stage.axes] == where


def test_silent_host_trips_the_watchdog() -> None:
    """A stage at full speed whose host falls silent latches WATCHDOG and is at rest 300 ms after the last heartbeat."""
    host = Host(SimBench("tvg43", seed=4))
    host.home()
    host.bench.stage.feed(move(2, 180.0), host.now)
    host.run_until(MOVING)
    host.run(4.0)
    host.silent = True
    last_heartbeat = max(status.time_us for status in host.statuses)
    assert host.run_until(FAULT, within=0.5).fault == 1
    host.run(3.0)
    axis = host.bench.plant_stage.azimuth
    instants = np.arange(last_heartbeat, host.now, 1000.0)
    moving = instants[:-1][np.diff(axis.true_angles(instants)) != 0]
    assert 200_000 < moving[-1] - last_heartbeat <= 320_000  # two control periods to notice and to follow


def test_reset_in_mid_run() -> None:
    """A device that is reset comes back with a greater boot count, another turn-on bias, and no session."""
    bench = SimBench("tvg43", seed=4)
    host = Host(bench)
    host.home()
    before = bench.gyro_board.gyro.bias[0]
    schedule([FaultSpec.parse("gyro:reset@100"), FaultSpec.parse("stage:reset@100")], bench)
    host.run(101.0)
    assert bench.gyro.device.session == bench.stage.device.session == 0
    host.bodies.clear()
    for line in bench.lines:
        line.feed(hello(), host.now)
    host.run(0.2)
    boots = [struct.unpack_from("<IQ", body, 12) for body in host.bodies if body[0] == IDENTITY]
    assert [boot_count for boot_count, _ in boots] == [2, 2]
    assert all(time_us < 80 * SECOND for _, time_us in boots)  # their clocks began again
    assert host.statuses[-1].state == 0
    assert bench.gyro_board.gyro.bias[0] != before
    bench.stage.feed(request(HOME, 1), host.now)
    host.run_until(HOMING)
    host.run_until(IDLE)
    assert abs(bench.plant_stage.azimuth.true_angle(host.now)) < 3 * ARCSEC


def test_noise_of_ones_own() -> None:
    """A bench takes any noise source, such as a recording."""
    recording = RecordedNoise(np.array([1.0, -1.0] * 500) * DPH, 235.0, sample_rate=235.0)
    host = Host(SimBench("ideal", latitude=math.pi / 2, noise=[recording]))
    host.bench.gyro.feed(request(STREAM_START, 1), 0)
    host.run(1.0)
    rates = rates_dph(host.samples)[:234]
    assert rates - rates.mean() == pytest.approx(np.resize([1.0, -1.0], 234), abs=2e-3)


def test_gyro_sensor_fault_is_reported() -> None:
    """A gyro whose supervision trips says so in the status of its next block."""
    bench = SimBench("tvg43", seed=1)
    host = Host(bench)
    schedule([FaultSpec.parse("gyro:sensor-fault@1")], bench)
    bench.gyro.feed(request(STREAM_START, 1), 0)
    host.run(2.0)
    assert [block.status for block in host.samples[:4]] == [0, 0, 0, 0]
    assert host.samples[-1].status == 4


def test_an_instrument_that_nobody_made_is_named() -> None:
    """A kind of gyro or stage unknown to the emulator is refused with those it knows."""
    with pytest.raises(ValueError, match=r"no emulated stage 'lathe': expected one of .*native"):
        SimBench(stage="lathe")


def test_accelerometers_feel_the_vertical() -> None:
    """Gravity shows on the z axis, which points down, or on the input axis if tipped, and biases as they are."""
    profile = load_profile("fast3")
    sensors = AccelerometerProfile(bias_mg=(1.0, -2.0, 3.0))
    bench = SimBench(
        msgspec.structs.replace(profile, gyro=msgspec.structs.replace(profile.gyro, accelerometers=sensors))
    )
    board = bench.gyro_board
    elevation = bench.plant_stage.axes[1].true_angle(0)
    board.start_sampling(0)
    board.read_samples(10)
    expected = np.array([np.sin(elevation), 0.0, -np.cos(elevation)]) * 1e6 + [1e3, -2e3, 3e3]
    np.testing.assert_allclose(board.specific_force(), expected, atol=1.0)
