"""What the instrument needs from a gyro, a stage and a link, as Protocols and plain data.

Whoever writes a driver satisfies `Gyro` or `Stage`; nothing has to be inherited. Drivers never block but in the calls
that say so: `read` and `state` return what has arrived. Waiting is done by one owner of the time, `Clock.wait`, which
returns early when any link opened on that clock has something to read; so a fault of the stage is seen while the
instrument waits for the gyro.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum, IntFlag
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

#: Rate samples as they came from the device, shape (n, n_axes): int32 counts, or float32 where the device sends those.
RateCounts = NDArray[np.int32] | NDArray[np.float32]


#: Names of what may go wrong on any link, see `Gyro.troubles`.
REPEATED, DAMAGED = "requests repeated", "damaged frames"


class Clock(Protocol):
    """The host's time, in seconds from any origin; never goes back."""

    def now(self) -> float:
        """Return the present instant."""

    def sleep_until(self, instant: float) -> None:
        """Return once `instant` has come."""

    def wait(self, deadline: float) -> None:
        """Return at `deadline`, or earlier once something new has come on any link of this clock, or a link has failed.

        Look at the links first, then wait: what has come since the last `wait` ends the next one at once.
        """

    def alarm(self, instant: float) -> None:
        """End the next `wait` at `instant` at the latest. For drivers that have to ask again soon by themselves."""

    def notify(self) -> None:
        """End the present `wait`, or else the next one. For links, which may call it from any thread."""


class ByteLink(Protocol):
    """An open two-way stream of bytes. Raises LinkError from every call once it is lost or closed."""

    @property
    def name(self) -> str:
        """What an operator would call it, for messages: ``/dev/ttyUSB0``."""

    def write(self, data: bytes) -> None:
        """Hand over all of `data` for sending."""

    def receive(self) -> bytes:
        """Return all bytes that have arrived, ``b""`` if none. Never waits."""

    def close(self) -> None:
        """Release the port. Closing twice is no error."""


#: Set in a `FrameLink` identifier of 29 bits, as in SocketCAN; identifiers of 11 bits stand alone.
EXTENDED_IDENTIFIER = 1 << 31


@dataclass(frozen=True, slots=True)
class BusCounts:
    """What has been heard on a bus since it was opened, by all links to it."""

    n_frames: int = 0  #: data frames of any identifier
    n_errors: int = 0  #: error frames, and errors that the adapter reports
    n_remote: int = 0  #: remote frames, which nothing here asks for or answers
    n_malformed: int = 0  #: what an adapter has sent that is no frame
    identifiers: frozenset[int] = frozenset()  #: of 11 bits, of all data frames heard


class FrameLink(Protocol):
    """An open connection to a bus of addressed frames, such as CAN. Raises LinkError from every call once it is lost.

    Several links may be open to one bus; each then gets all frames that it asked for, but none that another link of
    this program has sent.
    """

    @property
    def name(self) -> str:
        """What an operator would call it, for messages: ``socketcan:can0``."""

    @property
    def counts(self) -> BusCounts:
        """What has been heard on the bus."""

    def send(self, identifier: int, data: bytes) -> None:
        """Send one data frame; blocks while the bus takes no more, for a second at most."""

    def receive(self) -> list[tuple[int, bytes]]:
        """Return all data frames that have arrived as (identifier, data), oldest first. Never waits."""

    def close(self) -> None:
        """Release the bus. Closing twice is no error."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceIdentity:
    """Who answered: printable text only, whatever the device sent."""

    kind: str  #: "gyro" or "stage"
    model: str
    serial_number: str
    firmware_version: str = ""
    protocol: str = ""
    boot_count: int = 0


@dataclass(frozen=True, slots=True)
class SelfTest:
    """Outcome of a device's self-test: the failures by name, none of them if it passed."""

    failures: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        """Whether nothing failed."""
        return not self.failures


class GyroStatus(IntFlag):
    """What a gyro says about a block of its samples. Any flag but `OVERRUN` makes the samples unfit for use."""

    OK = 0
    NOT_READY = 1  #: still starting up
    SATURATED = 2  #: the rate left the measuring range within the block
    SENSOR_FAULT = 4  #: the gyro's own supervision tripped
    TEMPERATURE = 8  #: outside the operating temperature
    OVERRUN = 16  #: samples were lost inside the device before this block
    TILT_INVALID = 32  #: the tilt of this block must not be used


@dataclass(frozen=True, slots=True, kw_only=True)
class RateBlock:
    """Consecutive rate samples of a gyro, with what it measured beside them.

    ``counts * rate_lsb`` is the rate in rad/s, shape (n, n_axes); kept as counts so that nothing is lost in a record.
    """

    first_index: int  #: index of the first sample; counts every sample the device took since the stream's start
    device_time: float  #: s, the device's clock at the first sample
    arrival_time: float  #: s, the host's clock when the block was decoded
    counts: RateCounts  #: shape (n, n_axes)
    rate_lsb: float  #: rad/s per count
    temperature: float | None = None  #: degrees Celsius
    tilt: tuple[float, float] | None = None  #: rad, see the convention sheet in ``northfinder``
    #: m/s^2, mean over the block along the axes of a triad, its upward axis reading +g at rest; None if not measured
    specific_force: tuple[float, float, float] | None = None
    status: GyroStatus = GyroStatus.OK
    n_lost: int = 0  #: samples missing between the previous block and this one, found from the index

    @property
    def rate(self) -> NDArray[np.float64]:
        """Rate in rad/s, shape (n, n_axes)."""
        return self.counts.astype(np.float64) * self.rate_lsb


class StageMode(Enum):
    """What a stage is doing."""

    NOT_HOMED = "not homed"
    HOMING = "homing"
    IDLE = "idle"  #: homed and at rest
    MOVING = "moving"
    STOPPING = "stopping"
    FAULT = "fault"  #: at rest or stopping, and latched until `Stage.clear_fault`


@dataclass(frozen=True, slots=True, kw_only=True)
class StageState:
    """Where the stage is and what it does. Angles are the encoders', azimuth multi-turn."""

    device_time: float  #: s, the stage's own clock
    arrival_time: float  #: s, the host's clock
    mode: StageMode
    azimuth: float  #: rad
    elevation: float  #: rad
    azimuth_rate: float = 0.0  #: rad/s
    elevation_rate: float = 0.0  #: rad/s
    in_position: bool = False  #: at rest at the target of the last accepted move
    fault: str = ""  #: name of the latched fault, empty if none


@dataclass(frozen=True, slots=True, kw_only=True)
class StageLimits:
    """How far the host may send the stage, and how fast: never wider than the device's own limits."""

    azimuth_min: float  #: rad
    azimuth_max: float  #: rad
    elevation_min: float  #: rad
    elevation_max: float  #: rad
    max_speed: float  #: rad/s, of either axis
    max_acceleration: float = field(default=0.0)  #: rad/s^2, 0 if unknown


class Gyro(Protocol):
    """One gyro, from the port to blocks of samples.

    The calls come in the order connect, self_test, start, read..., stop, close; close is allowed at any time.
    """

    @property
    def sample_rate(self) -> float:
        """Samples a second, known after `connect`."""

    @property
    def n_axes(self) -> int:
        """How many input axes a sample holds, 1 or 3, known after `connect`."""

    @property
    def troubles(self) -> Mapping[str, int]:
        """What has gone wrong on the link and been made up for, how often since it was opened, by its name.

        Such as REPEATED or DAMAGED; what is zero may be left out.
        """

    def connect(self) -> DeviceIdentity:
        """Open a session: identify, check the protocol version, configure. Blocks up to a few seconds.

        Raises DeviceTimeoutError if nothing answers, ProtocolError if it is no such gyro.
        """

    def self_test(self) -> SelfTest:
        """Run the device's self-test. Blocks until done."""

    def start(self) -> None:
        """Start the sample stream; the index of its first sample is 0."""

    def read(self) -> list[RateBlock]:
        """Return the blocks that have arrived, oldest first, ``[]`` if none. Never waits.

        Before `start` there are none, but what a gyro sends unasked is taken off its line.

        Raises LinkError if the link is lost, DeviceTimeoutError if a started stream has fallen silent.
        """

    def stop(self) -> None:
        """Stop the sample stream."""

    def close(self) -> None:
        """Leave the device at rest and release its link. Raises nothing for a link already lost."""


class Stage(Protocol):
    """One two-axis rotation stage. Only `home` and `move` ever set it in motion.

    `state` must be called at least every 100 ms while the stage moves: it keeps the link alive, and a stage that hears
    nothing from the host stops.
    """

    @property
    def limits(self) -> StageLimits:
        """Where the stage may be sent, known after `connect`."""

    @property
    def troubles(self) -> Mapping[str, int]:
        """What has gone wrong on the link and been made up for, as that of a gyro."""

    def connect(self) -> DeviceIdentity:
        """Open a session. Blocks up to a few seconds; never moves."""

    def self_test(self) -> SelfTest:
        """Run the device's self-test, which never moves. Blocks until done."""

    def home(self) -> None:
        """Begin homing; `state` tells when it is done. Blocks only until the device has accepted."""

    def move(self, azimuth: float, elevation: float, *, speed: float | None = None) -> None:
        """Begin a move of both axes to absolute angles in rad; `speed` in rad/s, the limit if None.

        Blocks only until the device has accepted. Raises ValueError for a target outside `limits`, DeviceFaultError
        if the device refuses.
        """

    def state(self) -> StageState:
        """Service the link and return the newest state. Never waits.

        Raises LinkError if the link is lost, DeviceTimeoutError if the stage has fallen silent. A latched fault is a
        state, not an exception.
        """

    def stop(self) -> None:
        """Bring both axes to rest in a controlled way. Blocks until accepted; returns while still slowing down."""

    def clear_fault(self) -> None:
        """Re-arm after a latched fault, on the operator's word alone. Never moves."""

    def close(self) -> None:
        """Stop the stage if it moves, and release its link. Raises nothing for a link already lost."""
