"""The Epson driver on the emulated sensor in virtual time, over good lines and bad, and on fakes that misbehave."""

from __future__ import annotations

from math import cos, degrees, radians
from typing import Any

import numpy as np
import pytest
from served import near_home

from drivers.api import DAMAGED, GyroStatus, RateBlock
from drivers.epson import EpsonGyro, open_gyro
from drivers.epson.recognise import RECOGNISER
from drivers.errors import DeviceError, DeviceFaultError, DeviceTimeoutError, LinkError, ProtocolError
from drivers.protocol.epson import MODELS
from drivers.transport.virtual import VirtualClock, VirtualLink
from sim_device.bench import SimBench
from sim_device.faults import FaultSpec, FaultyLine, link_faults, schedule
from sim_device.firmware.epson import EpsonDevice
from sim_device.plant.gyro import DPH
from sim_device.plant.profile import load_profile

EARTH_RATE = 7.292115e-5
LATITUDE, AZIMUTH = radians(50.429), radians(33.0)


class Bench:
    """The driver on the emulated sensor."""

    def __init__(self, *faults: str, profile: str = "m-g370", seed: int = 3, **options: Any) -> None:  # noqa: ANN401 - of the driver
        self.sim = SimBench(profile, gyro="epson", seed=seed, latitude=LATITUDE, azimuth=AZIMUTH)
        self.clock = VirtualClock()
        specs = [FaultSpec.parse(fault) for fault in faults]
        schedule(specs, self.sim)
        self.line = FaultyLine(self.sim.gyro, link_faults(specs, "gyro"), seed=seed)
        self.link = VirtualLink(self.line, self.clock, name="bench")
        self.gyro = EpsonGyro(self.link, self.clock, **options)

    def started(self) -> Bench:
        """Connect and start."""
        self.gyro.connect()
        self.gyro.start()
        return self

    def stream(self, seconds: float) -> list[RateBlock]:
        """Return the blocks of some time."""
        end, blocks = self.clock.now() + seconds, []
        while self.clock.now() < end:
            blocks += self.gyro.read()
            self.clock.wait(min(end, self.clock.now() + 0.05))
        return blocks


def test_from_connect_to_blocks() -> None:
    """It says who it is, tests itself, and streams every sample once, with its index, in blocks of 0.25 s at most."""
    bench = Bench()
    identity = bench.gyro.connect()
    assert (identity.model, identity.serial_number) == ("Epson G370PDS0", "SIM-G3")
    assert (bench.gyro.sample_rate, bench.gyro.n_axes) == (125.0, 3)
    assert bench.gyro.self_test().passed
    bench.gyro.start()
    begin = bench.clock.now()
    blocks = bench.stream(20.0)
    assert [block.first_index for block in blocks] == np.cumsum([0, *(len(block.counts) for block in blocks)])[
        :-1
    ].tolist()
    n_samples = sum(len(block.counts) for block in blocks)
    assert 125 * (bench.clock.now() - begin) - n_samples < 50
    assert max(len(block.counts) for block in blocks) <= 31
    assert {block.status for block in blocks} <= {GyroStatus.OK, GyroStatus.NOT_READY}
    bench.gyro.stop()
    assert sum(len(block.counts) for block in bench.gyro.read()) < 50
    assert bench.stream(2.0) == []


def test_rates_and_gravity_are_those_of_the_world() -> None:
    """Over 100 s the level axis along the azimuth reads the earth's rate and the sensor's own bias, gravity 1 g."""
    bench = Bench(profile="ideal", axis="x")
    blocks = bench.started().stream(10.0)
    rate = np.concatenate([block.rate for block in blocks])
    azimuth, elevation = (axis.true_angle(0) for axis in bench.sim.plant_stage.axes)
    level = EARTH_RATE * cos(LATITUDE) * cos(elevation) * cos(AZIMUTH + azimuth)
    tipped = EARTH_RATE * np.sin(LATITUDE) * np.sin(elevation)
    assert rate.shape[1] == 1
    assert rate.mean() == pytest.approx(level + tipped, abs=0.001 * DPH)
    force = blocks[0].specific_force
    assert force is not None
    assert np.linalg.norm(force) == pytest.approx(9.80665, rel=1e-4)
    assert blocks[0].temperature == pytest.approx(24.0, abs=0.01)


@pytest.mark.parametrize("rate", [1000.0, 200.0, 62.5])
def test_other_sample_rates(rate: float) -> None:
    """It is set to the rate asked for, and sends so many samples."""
    bench = Bench(sample_rate=rate).started()
    assert sum(len(block.counts) for block in bench.stream(8.0)) == pytest.approx(8 * rate, abs=0.25 * rate + 3)


def test_the_noise_is_that_of_the_profile() -> None:
    """Means of 1 s scatter by the angle random walk: 0.06 deg/sqrt(h) is 3.6 deg/h; 180 of them tell it to 6 %."""
    blocks = Bench().started().stream(60.0)
    rate = np.concatenate([block.rate for block in blocks]) / DPH
    means = rate[: len(rate) // 125 * 125].reshape(-1, 125, 3).mean(axis=1)
    found = np.sqrt((np.diff(means, axis=0) ** 2).mean() / 2)
    assert found == pytest.approx(load_profile("m-g370").gyro.noise.angle_random_walk_deg_per_sqrt_h * 60, rel=0.25)


def test_16_bits_are_refused_with_the_reason() -> None:
    """The earth's rate is 0.6 of a step of 16 bits: refused before a port is opened."""
    with pytest.raises(ValueError, match=r"finds no north: the earth turns at 0.0042 deg/s, which is 0.6 of the least"):
        open_gyro("/dev/null", VirtualClock(), bits=16)
    assert degrees(EARTH_RATE) / MODELS["G370PDS0"].rate_lsb_deg == pytest.approx(0.63, abs=0.01)
    for options, words in (
        ({"bits": 24}, "32 bits, not 24"), ({"sample_rate": 300.0}, "15.625, 20, 25.*not 300"), ({"axis": "w"}, "'w'"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            open_gyro("/dev/null", VirtualClock(), **options)


def test_a_running_sensor_is_taken_over() -> None:
    """A sensor that streams already, at another rate, is stopped and set anew."""
    bench = Bench().started()
    bench.stream(3.0)
    bench.link.close()  # the program has died
    again = EpsonGyro(VirtualLink(bench.line, bench.clock), bench.clock, sample_rate=250.0)
    again.connect()
    again.start()
    bench.clock.sleep_until(bench.clock.now() + 1.0)
    assert again.read()[0].first_index == 0


class Deaf:
    """The sensor's line, on which one command is lost."""

    def __init__(self, line: FaultyLine, lost: int) -> None:
        self.poll, self.next_due_us = line.poll, line.next_due_us
        self._line, self._lost = line, lost
        self.n_commands = 0

    def feed(self, data: bytes, now_us: int) -> None:
        """Pass a command, or lose it."""
        if self.n_commands != self._lost:
            self._line.feed(data, now_us)
        self.n_commands += 1


def test_any_one_command_may_be_lost() -> None:
    """It is set, its self-test has run and has failed, and it streams: each command of all that, lost in turn."""

    def begun_without(lost: int) -> int:
        bench = Bench()
        bench.sim.gyro_board.self_test_failures = 4
        bench.link.close()  # which would take what comes on the line
        line = Deaf(bench.line, lost)
        bench.gyro = EpsonGyro(VirtualLink(line, bench.clock), bench.clock)
        bench.gyro.connect()
        assert bench.gyro.self_test().failures == ("gyro x", "gyro y", "gyro z", "accelerometers"), lost
        bench.gyro.start()
        assert bench.stream(0.5), lost
        return line.n_commands

    for lost in range(begun_without(-1)):
        begun_without(lost)


def test_a_failed_self_test_has_names() -> None:
    """What the sensor finds wrong with itself is told by name."""
    bench = Bench()
    bench.gyro.connect()
    bench.sim.gyro_board.self_test_failures = 4
    assert bench.gyro.self_test().failures == ("gyro x", "gyro y", "gyro z", "accelerometers")


@pytest.mark.parametrize("seed", range(3))
def test_a_noisy_line_loses_samples_but_never_alters_one(seed: int) -> None:
    """With bytes lost and bits flipped, each sample is that of the clean line under its index, or counted as lost."""
    clean = np.concatenate([block.counts for block in Bench(seed=seed).started().stream(30.0)])
    bench = Bench("gyro:drop=3e-4", "gyro:flip=3e-5", seed=seed)
    for _ in range(20):  # configuring over such a line may take more than one attempt
        try:
            bench.started()
        except DeviceError:
            continue
        break
    blocks = bench.stream(30.0)
    assert sum(block.n_lost for block in blocks) > 0
    assert bench.gyro.troubles[DAMAGED] > 0
    last = blocks[-1].first_index + len(blocks[-1].counts)
    assert sum(block.n_lost + len(block.counts) for block in blocks) == last
    shift = _shift(clean, blocks[0])
    for block in blocks:
        where = slice(block.first_index + shift, block.first_index + shift + len(block.counts))
        if where.stop <= len(clean):
            assert np.array_equal(clean[where], block.counts)


def _shift(clean: np.ndarray[Any, Any], block: RateBlock) -> int:
    """Return at which sample of the clean line a block's stream began."""
    (places,) = np.nonzero((clean == block.counts[0]).all(axis=1))
    assert len(places) == 1
    return int(places[0]) - block.first_index


def test_a_silent_sensor_is_seen() -> None:
    """One reset in mid-stream falls silent: a timeout; one unplugged is a lost link; closing raises nothing."""
    bench = Bench().started()
    bench.stream(2.0)
    bench.sim.reset("gyro")
    with pytest.raises(DeviceTimeoutError, match="bench has sent no samples for"):
        bench.stream(5.0)
    bench.gyro.close()
    bench = Bench("gyro:unplug@5").started()
    with pytest.raises(LinkError, match="bench was unplugged"):
        bench.stream(10.0)
    bench.gyro.close()


class Fake:
    """Registers that answer by a table."""

    def __init__(self, **registers: int) -> None:
        self.registers = {int(name[1:], 16): value for name, value in registers.items()}
        self.out = b""

    def feed(self, data: bytes, now_us: int) -> None:
        """Answer a read."""
        if len(data) == 3 and not data[0] & 0x80:
            self.out += bytes((data[0],)) + self.registers.get(data[0], 0).to_bytes(2, "big") + b"\r"

    def poll(self, now_us: int) -> bytes:
        """Return the answers."""
        out, self.out = self.out, b""
        return out

    def next_due_us(self) -> int | None:
        """Do nothing."""
        return None


class Mute(Fake):
    """Says nothing."""

    def feed(self, data: bytes, now_us: int) -> None:
        """Take it."""


@pytest.mark.parametrize(
    ("fake", "error", "words"),
    [
        (Mute(), DeviceTimeoutError, "COM3 is silent: no Epson sensor has told its register 4C"),
        (Fake(r4C=0x1234), ProtocolError, "COM3 is no Epson sensor: its id is 1234, expected 5345"),
        (Fake(r4C=0x5345, r04=0x20), DeviceFaultError, "hardware error, 0020"),
        (Fake(r4C=0x5345, r0A=0x400), DeviceTimeoutError, "has not ended starting within 3 s"),
        (Fake(r4C=0x5345, r6A=0x3347), ProtocolError, "is an Epson 'G3'; known are G320PDG0, G354"),
        (
            Fake(r4C=0x5345, r6A=0x3347, r6C=0x3037, r6E=0x4450, r70=0x3053),
            DeviceFaultError,
            "does not take its sample rate: register 04 holds 0000, 0400 was written",
        ),
    ],
)
def test_odd_answers(fake: Fake, error: type[DeviceError], words: str) -> None:
    """What is no such sensor, or is not well, is named with what was found and what was expected."""
    clock = VirtualClock()
    gyro = EpsonGyro(VirtualLink(fake, clock, name="COM3"), clock)
    with pytest.raises(error, match=words):
        gyro.connect()
    with pytest.raises(ProtocolError, match="not been connected"):
        gyro.start()


def test_a_port_is_recognised() -> None:
    """The registers of identity, or two bursts, say who it is; asking changes nothing; other bytes are nobody."""
    bench = Bench()
    before = dict(_device(bench)._registers)
    bench.sim.gyro.feed(RECOGNISER.question, 1_000_000)
    heard = bench.sim.gyro.poll(1_000_000)
    identity = RECOGNISER.recognise(b"\x80\x00" + heard)
    assert identity is not None
    assert (identity.model, identity.serial_number) == ("Epson G370PDS0", "SIM-G3")
    assert _device(bench)._registers == before
    assert not _device(bench)._sampling
    assert RECOGNISER.recognise(heard[:-8]) is None
    assert RECOGNISER.recognise(bytes(range(256)) * 8) is None
    bench.started()
    bench.sim.gyro.poll(bench.sim.now_us)
    bench.sim.advance_to(bench.sim.now_us + 300_000)
    streamed = RECOGNISER.recognise(bench.sim.gyro.poll(bench.sim.now_us)[7:])
    assert streamed is not None
    assert streamed.model == "Epson"


def _device(bench: Bench) -> EpsonDevice:
    device = bench.sim.gyro.device
    assert isinstance(device, EpsonDevice)
    return device


def test_a_stage_may_stand_elsewhere() -> None:
    """The emulated sensor takes a bench of one axis: the other two are 0."""
    sim = SimBench(near_home(), gyro="epson", seed=1)
    clock = VirtualClock()
    gyro = EpsonGyro(VirtualLink(sim.gyro, clock), clock)
    gyro.connect()
    gyro.start()
    clock.sleep_until(clock.now() + 1.0)
    assert not gyro.read()[0].counts[:, 1:].any()
