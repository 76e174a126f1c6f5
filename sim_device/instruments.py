"""The instruments that the emulator can be: by name, which firmware runs on the board, and which profile is its own.

A name is that of the driver that speaks to it: ``--gyro stim300`` is served for ``stim300:/dev/...``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from sim_device.firmware.epson import EpsonDevice
from sim_device.firmware.gyro import GyroDevice
from sim_device.firmware.kvh import KvhDevice
from sim_device.firmware.stage import StageDevice
from sim_device.firmware.stim300 import Stim300Device
from sim_device.firmware.zaber import ZaberDevice
from sim_device.plant.boards import SimGyroBoard, SimStageBoard

BoardT = TypeVar("BoardT")


class Hosted(Protocol):
    """What the firmware of any device says of its host, and when it has something to do, in the board's time."""

    @property
    def seen_time_us(self) -> int:
        """Newest device time that the host says it has read, or at which it was heard."""

    @property
    def session(self) -> int:
        """Number of the open session, 0 if there is no host."""

    @property
    def testing(self) -> bool:
        """Whether a self-test is under way."""

    def next_due_us(self) -> int | None:
        """Return when there will be something to do."""


class Device(Hosted, Protocol):
    """What the firmware of a device on a serial line offers, in the board's time."""

    @property
    def told_time_us(self) -> int:
        """Device time of the newest status that the host has to acknowledge, -1 if there is none."""

    def feed(self, data: bytes, now_us: int) -> None:
        """Take what came over the line."""

    def poll(self, now_us: int, room: int | None = None) -> bytes:
        """Do what is due and return what to send: of a stream at most `room` bytes, beyond which it is lost."""


@dataclass(frozen=True, slots=True)
class Instrument(Generic[BoardT]):
    """One kind of gyro or stage.

    ``acknowledges`` tells whether its host says what it has read, as that of the native devices does: then the
    emulator knows how far ahead of the host it is.
    """

    firmware: Callable[[BoardT], Device]
    profile: str = "tvg43"  #: the bench's, unless another one is asked for
    acknowledges: bool = False


GYROS: dict[str, Instrument[SimGyroBoard]] = {
    "epson": Instrument(EpsonDevice, profile="m-g370"),
    "kvh": Instrument(KvhDevice, profile="kvh"),
    "native": Instrument(GyroDevice, acknowledges=True),
    "stim300": Instrument(Stim300Device, profile="stim300"),
}
STAGES: dict[str, Instrument[SimStageBoard]] = {
    "native": Instrument(StageDevice, acknowledges=True),
    "zaber": Instrument(ZaberDevice),
}


def instrument(table: dict[str, Instrument[Any]], kind: str, name: str) -> Instrument[Any]:
    """Return the instrument of that name; ValueError if there is none."""
    if name not in table:
        raise ValueError(f"no emulated {kind} {name!r}: expected one of {', '.join(sorted(table))}")
    return table[name]
