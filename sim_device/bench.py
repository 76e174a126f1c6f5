"""A whole bench in virtual time: plant, boards and firmware of the devices, on one clock.

A `World` is the plant with the boards of both devices; `SimBench` runs the serial firmware on them, and
`sim_device.can_bench` that of a CAN bus. A `Line` is the host's end of one device's serial line, a function of time
like the firmware itself: ``feed(data, now_us)``, ``poll(now_us)``, ``next_due_us()``, all in world time. Whichever
line is asked, the whole world is first brought to that instant in the order of what is due, so that the gyro always
samples where the stage was.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

from sim_device.instruments import GYROS, STAGES, Device, Hosted, instrument
from sim_device.plant.boards import SimGyroBoard, SimStageBoard
from sim_device.plant.earth import Site
from sim_device.plant.gyro import STREAM_ACCELEROMETERS, STREAM_STAGE, STREAM_TILT, Gyro, seed_of
from sim_device.plant.noise import NoiseSource
from sim_device.plant.profile import Profile, load_profile, with_parked_stage
from sim_device.plant.stage import Stage

NOISE_BATCH = 8192  #: samples made at a time
FIRST_BOOT = 1


class Seat:
    """A device's place in the world: when it started, and when it will next do something."""

    def __init__(self, bench: World, name: str, device: Hosted) -> None:
        self.bench = bench
        self.name = name  #: what an operator calls the device, "gyro" or "stage"
        self.acknowledged = True  #: whether the host says what it has read; else `unread` tells
        self.unread = False  #: whether the host has still to read what the device has sent
        self.device = device
        self.epoch_us = 0  #: world time of the device's start
        self.due_us = device.next_due_us()  #: when the device will next do something, in world time; None if never

    @property
    def told_us(self) -> int:
        """Device time of the newest status of a stage that its host has to acknowledge, -1 if there is none."""
        return -1

    @property
    def rests(self) -> bool:
        """Whether the device tells its status as one at rest, though another part of the stage may move."""
        return False

    def serve(self) -> None:
        """Let the device do what is due now."""
        raise NotImplementedError

    def restart(self, device: Hosted) -> None:
        """Go on with a device that has just started."""
        self.device = device
        self.epoch_us = self.bench.now_us
        self._note_due()

    def _note_due(self) -> None:
        due_us = self.device.next_due_us()
        self.due_us = None if due_us is None else due_us + self.epoch_us


class Line(Seat):
    """The host's end of one device's line."""

    def __init__(self, bench: World, name: str, device: Device, *, acknowledged: bool = True) -> None:
        super().__init__(bench, name, device)
        self.device: Device = device
        self.acknowledged = acknowledged
        self.room: int | None = None  #: bytes that the line can take now, None for any number; beyond, blocks are lost
        self._out = bytearray()

    def feed(self, data: bytes, now_us: int) -> None:
        """Hand `data` to the device at `now_us`."""
        self.bench.advance_to(now_us)
        self.device.feed(data, self.bench.now_us - self.epoch_us)
        self.serve()

    def poll(self, now_us: int) -> bytes:
        """Return what the device has sent up to `now_us`."""
        if now_us > self.bench.now_us:
            self.bench.advance_to(now_us)
        if not self._out:
            return b""
        out = bytes(self._out)
        self._out.clear()
        return out

    def next_due_us(self) -> int | None:
        """Return when the device will next do something, or now if it has sent already."""
        return self.bench.now_us if self._out else self.due_us

    @property
    def told_us(self) -> int:
        """Device time of the newest status frame of a stage, -1 if there is none."""
        return self.device.told_time_us

    def serve(self) -> None:
        """Let the device do what is due now."""
        sent = self.device.poll(self.bench.now_us - self.epoch_us, self.room)
        if sent:
            self._out += sent
            if self.room is not None:  # several blocks may be due before the line is looked at again
                self.room = max(0, self.room - len(sent))
        self._note_due()

    def restart(self, device: Hosted) -> None:
        """Go on with a device that has just started; what the old one had not yet sent is lost."""
        self._out.clear()
        super().restart(device)


class World:
    """An emulated gyro on an emulated stage, as plant and boards; what runs on the boards is a subclass' business.

    Parameters
    ----------
    profile
        Its name, the path of its file, or itself.
    seed
        Of all that is random.
    azimuth
        True azimuth of stage azimuth zero, rad.
    latitude
        Rad.
    tilt
        Of the rotation axis, rad, see the convention sheet in ``northfinder``.
    noise
        Of each gyro axis, instead of the profile's.
    parked
        Whether the stage stands at zero when it is switched on, as a mount does that never turns.

    """

    gyro: Seat
    lines: tuple[Seat, ...]  #: those of the stage first: the gyro samples where it then stands

    def __init__(
        self,
        profile: str | Profile = "tvg43",
        *,
        seed: int = 0,
        azimuth: float = 0.0,
        latitude: float = 0.0,
        tilt: tuple[float, float] = (0.0, 0.0),
        noise: list[NoiseSource] | None = None,
        parked: bool = False,
    ) -> None:
        self.profile = profile if isinstance(profile, Profile) else load_profile(profile)
        if parked:
            self.profile = with_parked_stage(self.profile)
        self.seed = seed
        self.now_us = 0
        self.site = Site(latitude=latitude, heading=azimuth, tilt=tilt)
        self.plant_stage = Stage(self.profile.stage, seed_of(seed, STREAM_STAGE))
        self._noise = noise
        self._order = itertools.count()
        self._scheduled: list[tuple[int, int, Callable[[], None]]] = []
        self.stage_board = self._make_stage_board(FIRST_BOOT)
        self.gyro_board = self._make_gyro_board(FIRST_BOOT)

    def advance_to(self, now_us: int) -> None:
        """Let everything happen that is due up to `now_us`, in its order. An instant already past changes nothing."""
        while (event := self._next_event()) is not None and event[0] <= now_us:
            self.now_us = max(self.now_us, event[0])
            line = event[1]
            if line is None:
                heapq.heappop(self._scheduled)[2]()
                continue
            line.serve()
            if line.due_us == event[0]:
                raise RuntimeError(f"the {line.name} has been served at {event[0]} us and is due at that instant again")
        self.now_us = max(self.now_us, now_us)

    def next_due_us(self) -> int | None:
        """Return when something will next happen, None if nothing is due."""
        event = self._next_event()
        return None if event is None else event[0]

    def at(self, instant_us: int, action: Callable[[], None]) -> None:
        """Let `action` happen at an instant of the world, such as a fault of the plant."""
        heapq.heappush(self._scheduled, (instant_us, next(self._order), action))

    def reset(self, name: str) -> None:
        """Switch the device of that name ("gyro" or "stage") off and on, now."""
        if name == "gyro":
            self.gyro_board = self._make_gyro_board(self.gyro_board.boot_count + 1)
        elif name == "stage":
            self.stage_board = self._make_stage_board(self.stage_board.boot_count + 1)
        else:
            raise ValueError(f"no device {name!r}: gyro or stage")
        self._restart(name)

    def _restart(self, name: str) -> None:
        """Start the firmware of a device on its new board."""
        raise NotImplementedError

    def _next_event(self) -> tuple[int, Seat | None] | None:
        found: tuple[int, Seat | None] | None = (self._scheduled[0][0], None) if self._scheduled else None
        for line in self.lines:
            due = line.due_us
            if due is not None and (found is None or due < found[0]):
                found = due, line
        return found

    def _make_gyro_board(self, boot_count: int) -> SimGyroBoard:
        gyro = Gyro(
            self.profile.gyro,
            self.site,
            seed=self.seed,
            start=boot_count,
            noise=self._noise,
            batch=NOISE_BATCH,
        )
        return SimGyroBoard(
            gyro,
            self.plant_stage,
            serial_number=f"SIM-G{self.seed % 10**10}",
            tilt_rng=np.random.default_rng(seed_of(self.seed, STREAM_TILT, boot_count)),
            accelerometer_rng=np.random.default_rng(seed_of(self.seed, STREAM_ACCELEROMETERS, boot_count)),
            epoch_us=self.now_us,
            boot_count=boot_count,
        )

    def _make_stage_board(self, boot_count: int) -> SimStageBoard:
        return SimStageBoard(
            self.plant_stage,
            serial_number=f"SIM-S{self.seed % 10**10}",
            epoch_us=self.now_us,
            boot_count=boot_count,
        )


class SimBench(World):
    """The bench with serial firmware, each device on a line of its own.

    Parameters
    ----------
    profile
        Its name, the path of its file, or itself; the gyro's own if empty.
    gyro, stage
        Which instruments they are, see `sim_device.instruments`.
    options
        What `World` takes.

    """

    gyro: Line
    lines: tuple[Line, ...]

    def __init__(
        self,
        profile: str | Profile = "",
        *,
        gyro: str = "native",
        stage: str = "native",
        **options: Any,  # noqa: ANN401 - those of World
    ) -> None:
        self._kinds = {"gyro": instrument(GYROS, "gyro", gyro), "stage": instrument(STAGES, "stage", stage)}
        super().__init__(profile or self._kinds["gyro"].profile, **options)
        self.stage = self._line("stage", self.stage_board)
        self.gyro = self._line("gyro", self.gyro_board)
        self.lines = (self.stage, self.gyro)

    def _line(self, name: str, board: SimGyroBoard | SimStageBoard) -> Line:
        kind = self._kinds[name]
        return Line(self, name, kind.firmware(board), acknowledged=kind.acknowledges)

    def _restart(self, name: str) -> None:
        line, board = (self.gyro, self.gyro_board) if name == "gyro" else (self.stage, self.stage_board)
        line.restart(self._kinds[name].firmware(board))
