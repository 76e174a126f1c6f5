"""The bench on a CAN bus: the gyro and both axes of the stage are nodes on one wire, to which hosts are tapped.

The wire carries frames without delay: what a host sends reaches all nodes and all other hosts, what a node sends
reaches all hosts. (No node listens to another.) Identifiers carry flags: EXTENDED, REMOTE and, toward hosts, ERROR.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from sim_device.bench import Seat, World
from sim_device.firmware.can_axis import AxisNode
from sim_device.firmware.can_gyro import GyroNode
from sim_device.firmware.node import Node
from sim_device.plant.gyro import STREAM_FAULTS, seed_of
from sim_device.plant.profile import Profile

EXTENDED = 1 << 31  #: 29-bit identifier
REMOTE = 1 << 30  #: remote frame; its data are zeros, as many as it asks for
ERROR = 1 << 29  #: error frame, toward hosts only
BUS_OFF = ERROR | 0x40
RESTARTED = ERROR | 0x100

GYRO_ID, AZIMUTH_ID, ELEVATION_ID = 16, 32, 33
BITRATE = 1_000_000

Frame = tuple[int, bytes]


class Tap:
    """A host's controller on the wire.

    Parameters
    ----------
    wire
        What it is tapped to.
    bitrate
        To which it is set; at another one than the wire's it neither hears nor is heard. 0 while it is closed.

    """

    def __init__(self, wire: Wire, bitrate: int = 0) -> None:
        self.wire = wire
        self.bitrate = bitrate
        self.waiting: deque[tuple[int, int, bytes]] = deque()  #: (world time in us, identifier, data)

    @property
    def attuned(self) -> bool:
        """Whether it is open at the wire's bit rate."""
        return self.bitrate == self.wire.bitrate

    def send(self, identifier: int, data: bytes, now_us: int) -> bool:
        """Put a frame on the wire; return whether it got there."""
        if not self.attuned or self.wire.off:
            return False
        self.wire.from_host(self, identifier, data, now_us)
        return True


class Seated(Seat):
    """A node's place on the wire."""

    def __init__(self, bench: CanBench, name: str, node: Node) -> None:
        super().__init__(bench, name, node)
        self.node = node
        self.drop = 0.0  #: probability with which a frame is lost, either way
        self.freezes_us: tuple[tuple[int, int], ...] = ()  #: (from, until): it neither hears nor speaks
        self._wire = bench.wire
        self._rng = np.random.default_rng(seed_of(bench.seed, STREAM_FAULTS, node.node_id))

    @property
    def told_us(self) -> int:
        """Device time of the newest status of an axis, -1 if there is none."""
        return self.node.told_time_us if isinstance(self.node, AxisNode) else -1

    @property
    def rests(self) -> bool:
        """Whether it is an axis at rest."""
        return isinstance(self.node, AxisNode) and not self.node.drive.in_motion

    def hear(self, identifier: int, data: bytes) -> None:
        """Take a frame from the wire, now."""
        if self.node.accepts(identifier) and self._passes():
            self.node.feed(identifier, data, self.bench.now_us - self.epoch_us)
            self.serve()

    def serve(self) -> None:
        """Let the node do what is due now."""
        frames = self.node.poll(self.bench.now_us - self.epoch_us)
        if self.drop or self.freezes_us:
            frames = [frame for frame in frames if self._passes()]
        if frames:
            self._wire.from_node(frames, self.bench.now_us)
        self._note_due()

    def start(self, node: Node) -> None:
        """Go on with a node that has just started."""
        self.node = node
        self.restart(node)

    def _passes(self) -> bool:
        now_us = self.bench.now_us
        if any(begin <= now_us < end for begin, end in self.freezes_us):
            return False
        return not self.drop or self._rng.random() >= self.drop


class Wire:
    """What nodes and hosts are tapped to."""

    def __init__(self, bench: CanBench, bitrate: int) -> None:
        self.bitrate = bitrate
        self.off = False  #: nothing passes: the hosts' controllers are off the bus
        self.unplugged = False  #: the hosts' adapters are gone
        self.taps: list[Tap] = []
        self._bench = bench

    def tap(self, bitrate: int | None = None) -> Tap:
        """Return a new host's tap, open at the wire's bit rate unless another is given."""
        tap = Tap(self, self.bitrate if bitrate is None else bitrate)
        self.taps.append(tap)
        return tap

    def remove(self, tap: Tap) -> None:
        """Forget a host."""
        self.taps.remove(tap)

    def from_host(self, sender: Tap, identifier: int, data: bytes, now_us: int) -> None:
        """Carry a host's frame to all others."""
        bench = self._bench
        bench.advance_to(now_us)
        for tap in self.taps:
            if tap is not sender and tap.attuned:
                tap.waiting.append((bench.now_us, identifier, data))
        if not identifier & (EXTENDED | REMOTE):
            for seat in bench.lines:
                seat.hear(identifier, data)

    def from_node(self, frames: list[Frame], now_us: int) -> None:
        """Carry a node's frames to all hosts."""
        if self.off:
            return
        for tap in self.taps:
            if tap.attuned:
                tap.waiting.extend([(now_us, identifier, data) for identifier, data in frames])

    def unplug(self) -> None:
        """Take the hosts' adapters away."""
        self.unplugged = True

    def switch_off(self, *, off: bool) -> None:
        """Let the hosts' controllers go off the bus, as after too many errors, or come back."""
        self.off = off
        for tap in self.taps:
            tap.waiting.append((self._bench.now_us, BUS_OFF if off else RESTARTED, bytes(8)))


class CanBench(World):
    """The bench with its CAN firmware.

    Parameters
    ----------
    profile
        Its name, the path of its file, or itself.
    bitrate
        Of the wire, bit/s.
    options
        What `World` takes.

    """

    lines: tuple[Seated, ...]

    def __init__(
        self,
        profile: str | Profile = "tvg43",
        *,
        bitrate: int = BITRATE,
        **options: Any,  # noqa: ANN401 - those of World
    ) -> None:
        super().__init__(profile, **options)
        self.wire = Wire(self, bitrate)
        self.azimuth = Seated(self, "stage", AxisNode(self.stage_board, 0, AZIMUTH_ID))
        self.elevation = Seated(self, "stage", AxisNode(self.stage_board, 1, ELEVATION_ID))
        self.gyro: Seated = Seated(self, "gyro", GyroNode(self.gyro_board, GYRO_ID))
        self.lines = (self.azimuth, self.elevation, self.gyro)

    def _restart(self, name: str) -> None:
        if name == "gyro":
            self.gyro.start(GyroNode(self.gyro_board, GYRO_ID))
        else:
            self.azimuth.start(AxisNode(self.stage_board, 0, AZIMUTH_ID))
            self.elevation.start(AxisNode(self.stage_board, 1, ELEVATION_ID))
