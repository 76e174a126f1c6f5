"""Whatever single message is lost, either way, on any line or bus: the measurement goes on to its end, and is right."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from can_virtual import CanVirtualBench
from msgspec.structs import replace
from served import near_home
from virtual import Unwatched, assume

from drivers.api import ByteLink, Clock, Gyro, Stage
from drivers.epson import EpsonGyro
from drivers.errors import DeviceError
from drivers.kvh import KvhGyro
from drivers.native import NativeGyro, NativeStage
from drivers.stim300 import Stim300Gyro
from drivers.transport.virtual import VirtualClock, VirtualLink
from drivers.zaber import ZaberStage, stage_axes
from northfinder.cyclogram import read_cyclogram
from northfinder.errors import NorthFinderError
from northfinder.measurement import Measurement, Outcome, measure
from sim_device import instruments
from sim_device.bench import Line, SimBench
from sim_device.can_bench import CanBench
from sim_device.plant.noise import Rates
from sim_device.plant.profile import load_profile

QUICK_TURN = read_cyclogram(Path(__file__).parent / "quick_turn.toml")
GYROS: dict[str, Callable[[ByteLink, Clock], Gyro]] = {
    "native": NativeGyro,
    "epson": EpsonGyro,
    "kvh": KvhGyro,
    "stim300": Stim300Gyro,
}
STAGES: dict[str, Callable[[ByteLink, Clock], Stage]] = {
    "native": NativeStage,
    "zaber": lambda link, clock: ZaberStage(link, clock, stage_axes()),
}


LOST_TO = ("to the gyro", "to the stage")
LOST_FROM = ("from the gyro", "from the stage")
LATEST_S = 4.0  # by which a lost message may hold up a measurement: what takes longest is to find that a stream is over
EARLY = 60  # messages of connecting, of which each is another; later ones are much alike


@dataclass
class LossyLine:
    """A line on which one message is lost, counted from 0 for each direction; -1 for none."""

    line: Line
    lost_to: int = -1
    lost_from: int = -1
    n_to: int = 0
    n_from: int = 0

    def feed(self, data: bytes, now_us: int) -> None:
        """Pass what the host says."""
        self.line.feed(b"" if self.n_to == self.lost_to else data, now_us)
        self.n_to += 1

    def poll(self, now_us: int) -> bytes:
        """Pass what the device says."""
        data = self.line.poll(now_us)
        self.n_from += bool(data)
        return b"" if self.n_from - 1 == self.lost_from else data

    def next_due_us(self) -> int | None:
        """Return when the device is due."""
        return self.line.next_due_us()


class Silence:
    """A gyro without noise: its measurement is right to what a message lost may change."""

    def read(self, n: int) -> Rates:
        """Return the next `n` samples, rad/s."""
        return np.zeros(n)


class SerialBench:
    """A gyro and a quick stage near its references; of what is said, one message is lost."""

    def __init__(self, gyro: str, stage: str, direction: str = "", message: int = -1) -> None:
        own = load_profile(instruments.GYROS[gyro].profile)
        sim = SimBench(
            replace(own, stage=near_home(brisk=True).stage),
            gyro=gyro,
            stage=stage,
            azimuth=math.radians(33.0),
            latitude=math.radians(50.429),
            noise=[Silence()] * own.gyro.n_axes,
        )
        self.clock = VirtualClock()
        self._kinds = gyro, stage
        self._lines = [
            LossyLine(line, message if direction == to else -1, message if direction == back else -1)
            for line, to, back in zip((sim.gyro, sim.stage), LOST_TO, LOST_FROM, strict=True)
        ]
        self._links = [VirtualLink(line, self.clock, name=line.line.name) for line in self._lines]

    @property
    def counts(self) -> dict[str, int]:
        """How many messages were said in each direction."""
        said = {to: line.n_to for to, line in zip(LOST_TO, self._lines, strict=True)}
        return said | {back: line.n_from for back, line in zip(LOST_FROM, self._lines, strict=True)}

    def measure(self, record: Path) -> Outcome:
        """Measure four positions of two seconds."""
        measurement = Measurement(
            open_gyro=lambda: GYROS[self._kinds[0]](self._links[0], self.clock),
            open_stage=lambda: STAGES[self._kinds[1]](self._links[1], self.clock),
            plan=QUICK_TURN,
            settle=0.5,
            assumptions=assume(latitude_deg=50.429),
            record=record,
        )
        return measure(measurement, clock=self.clock, utc=self.clock.now, watcher=Unwatched())


class BusBench:
    """The same on a CAN bus, where one frame is lost once the stage moves.

    Controllers repeat frames, so that none is lost unless a node is too slow; a node that misses a word of connecting
    is named, before anything is measured.
    """

    def __init__(self, direction: str = "", message: int = -1) -> None:
        world = CanBench(
            near_home(brisk=True), azimuth=math.radians(33.0), latitude=math.radians(50.429), noise=[Silence()]
        )
        self._stage, self._has_moved = world.plant_stage, False
        self._bench = CanVirtualBench(world)
        self._bench.tap.to_bench = partial(self._fate, "to the bench")
        self._bench.tap.to_host = partial(self._fate, "from the bench")
        self._lost = direction, message
        self.clock = self._bench.clock
        self.counts = {"to the bench": 0, "from the bench": 0}

    def measure(self, record: Path) -> Outcome:
        """Measure four positions of two seconds."""
        return self._bench.measure(record, QUICK_TURN, latitude_deg=50.429)

    def _fate(self, direction: str, identifier: int, data: bytes) -> list[tuple[int, bytes]]:
        self._has_moved = self._has_moved or self._stage.rest_since_us() > self._bench.bench.now_us
        if not self._has_moved:
            return [(identifier, data)]
        lost = self._lost == (direction, self.counts[direction])
        self.counts[direction] += 1
        return [] if lost else [(identifier, data)]


BENCHES: dict[str, Callable[..., SerialBench | BusBench]] = {
    "native": partial(SerialBench, "native", "native"),
    "zaber": partial(SerialBench, "native", "zaber"),
    "epson": partial(SerialBench, "epson", "native"),
    "kvh": partial(SerialBench, "kvh", "native"),
    "stim300": partial(SerialBench, "stim300", "native"),
    "CAN": BusBench,
}


@pytest.mark.parametrize("n_trials", [4, pytest.param(200, marks=pytest.mark.campaign)])
@pytest.mark.parametrize("make", BENCHES.values(), ids=list(BENCHES))
def test_a_lost_message_ends_no_measurement(
    tmp_path: Path, make: Callable[..., SerialBench | BusBench], n_trials: int
) -> None:
    """Any one, drawn at random: the azimuth is as without the loss, and comes a few seconds later at most."""
    whole = make()
    azimuth = whole.measure(tmp_path / "whole.sqlite").fix.azimuth
    assert azimuth == pytest.approx(math.radians(33.0), abs=math.radians(0.2))
    rng = np.random.default_rng(1)
    for trial in range(n_trials):
        direction, n_messages = list(whole.counts.items())[int(rng.integers(len(whole.counts)))]
        message = int(rng.integers(min(EARLY, n_messages) if trial % 2 else n_messages))
        bench = make(direction, message)
        try:
            outcome = bench.measure(tmp_path / f"{trial}.sqlite")
        except (DeviceError, NorthFinderError) as error:
            pytest.fail(f"message {message} {direction} was lost: {error}")
        assert outcome.fix.azimuth == pytest.approx(azimuth, abs=math.radians(0.1)), (direction, message)
        assert bench.clock.now() < whole.clock.now() + LATEST_S, (direction, message)
