"""Seeded faults: of the line between host and device, and of the plant at a given instant.

Faults are written as text, ``DEVICE:NAME[=VALUE][@SECONDS[+SECONDS]]``, the instant counted from the bench's start:

====================================  ==================================================================
``drop=P``, ``flip=P``                each byte is lost, or has one bit flipped, with probability P
``duplicate=P``, ``garbage=P``        each chunk is sent twice, or followed by random bytes, with probability P
``delay=MS``                          each chunk arrives so much later, either way
``freeze@T+D``                        the device neither hears nor speaks for D seconds
``unplug@T``                          the line is gone from then on
``reset@T``                           the device is switched off and on
``stall=AXIS@T``                      stage: the axis (``azimuth``, ``elevation``) is blocked
``runaway=AXIS@T``                    stage: its drive runs away
``encoder-freeze=AXIS@T``             stage: its encoder freezes
``encoder-jump=AXIS@T``               stage: its encoder jumps by 5 deg
``limit-switch=AXIS@T``               stage: its limit switch sticks closed
``e-stop@T``                          stage: the emergency stop is pressed, for D seconds with ``+D``
``sensor-fault@T``                    gyro: its supervision trips
====================================  ==================================================================

A CAN bus has some of them and others of its own, see `sim_device.can_server`.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sim_device.bench import Line, World
from sim_device.plant.gyro import STREAM_FAULTS, seed_of
from sim_device.plant.stage import Stage, StageAxis

RUNAWAY_SPEED = math.radians(5.0)  #: rad/s
ENCODER_JUMP = math.radians(5.0)  #: rad
GARBAGE_BYTES = 32  #: at most

_SPEC = re.compile(r"(gyro|stage|bus):([a-z-]+)(?:=([^@]+))?(?:@(\d+(?:\.\d+)?)(?:\+(\d+(?:\.\d+)?))?)?")


class Endpoint(Protocol):
    """The host's end of a line, with or without faults."""

    def feed(self, data: bytes, now_us: int) -> None:
        """Hand `data` to the device."""

    def poll(self, now_us: int) -> bytes:
        """Return what has come from the device."""

    def next_due_us(self) -> int | None:
        """Return when something may come."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkFaults:
    """What happens to the bytes of a line, either way; probabilities are per byte or per chunk."""

    drop: float = 0.0  #: per byte
    flip: float = 0.0  #: per byte, one of its bits
    duplicate: float = 0.0  #: per chunk
    garbage: float = 0.0  #: per chunk: 1 to 32 random bytes behind it
    delay_us: int = 0
    freezes_us: tuple[tuple[int, int], ...] = ()  #: (from, until): nothing passes
    unplug_us: int | None = None  #: nothing passes, and any use raises ConnectionResetError, from then on


class FaultyLine:
    """A line with faults; the same interface, seeded.

    Parameters
    ----------
    line
        The line without faults.
    faults
        What happens on it.
    seed
        Of what happens when.

    """

    def __init__(self, line: Line, faults: LinkFaults, seed: int) -> None:
        self._line = line
        self._faults = faults
        self._rng = np.random.default_rng(seed_of(seed, STREAM_FAULTS, len(line.name)))
        self._underway: deque[tuple[int, bytes]] = deque()

    def feed(self, data: bytes, now_us: int) -> None:
        """Hand what is left of `data` to the device."""
        self._check_plugged(now_us)
        damaged = self._damage(data, now_us)
        if not damaged:
            self._line.bench.advance_to(now_us)
        elif self._faults.delay_us:
            due = now_us + self._faults.delay_us
            self._line.bench.at(due, lambda: self._line.feed(damaged, due))
        else:
            self._line.feed(damaged, now_us)

    def poll(self, now_us: int) -> bytes:
        """Return what has come through up to `now_us`."""
        self._check_plugged(now_us)
        damaged = self._damage(self._line.poll(now_us), now_us)
        if damaged:
            self._underway.append((now_us + self._faults.delay_us, damaged))
        arrived = []
        while self._underway and self._underway[0][0] <= now_us:
            arrived.append(self._underway.popleft()[1])
        return b"".join(arrived)

    def next_due_us(self) -> int | None:
        """Return when something may come, or the line be unplugged."""
        instants = [self._line.next_due_us(), self._faults.unplug_us]
        if self._underway:
            instants.append(self._underway[0][0])
        known = [instant for instant in instants if instant is not None]
        return min(known) if known else None

    def _check_plugged(self, now_us: int) -> None:
        if self._faults.unplug_us is not None and now_us >= self._faults.unplug_us:
            raise ConnectionResetError(f"the {self._line.name} has been unplugged")

    def _damage(self, data: bytes, now_us: int) -> bytes:
        if not data or any(begin <= now_us < end for begin, end in self._faults.freezes_us):
            return b""
        chunk = np.frombuffer(data, dtype=np.uint8)
        if self._faults.flip:
            hit = self._rng.random(chunk.size) < self._faults.flip
            chunk = chunk ^ np.where(hit, 1 << self._rng.integers(0, 8, chunk.size), 0).astype(np.uint8)
        if self._faults.drop:
            chunk = chunk[self._rng.random(chunk.size) >= self._faults.drop]
        data = chunk.tobytes()
        if self._faults.duplicate and self._rng.random() < self._faults.duplicate:
            data += data
        if self._faults.garbage and self._rng.random() < self._faults.garbage:
            data += self._rng.bytes(int(self._rng.integers(1, GARBAGE_BYTES + 1)))
        return data


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultSpec:
    """One fault as written."""

    device: str
    name: str
    value: str
    begin_us: int | None
    duration_us: int | None
    text: str

    @classmethod
    def parse(cls, text: str) -> FaultSpec:
        """Return the fault that `text` describes; ValueError if it describes none."""
        match = _SPEC.fullmatch(text)
        if match is None:
            raise ValueError(f"fault {text!r} is not of the form DEVICE:NAME[=VALUE][@SECONDS[+SECONDS]]")
        device, name, value, begin, duration = match.groups(default="")
        begin_us, duration_us = (round(float(part) * 1e6) if part else None for part in (begin, duration))
        return cls(device=device, name=name, value=value, begin_us=begin_us, duration_us=duration_us, text=text)

    def instant_us(self) -> int:
        """Return when it happens; ValueError if that is not said."""
        if self.begin_us is None:
            raise ValueError(f"fault {self.text!r} needs an instant: {self.text}@SECONDS")
        return self.begin_us

    def number(self, highest: float) -> float:
        """Return its value as a number; ValueError if it is none between 0 and `highest`."""
        try:
            number = float(self.value)
        except ValueError:
            number = math.nan
        if not 0 <= number <= highest:
            raise ValueError(f"fault {self.text!r} needs a value from 0 to {highest:g}, got {self.value!r}")
        return number


def link_faults(specs: list[FaultSpec], device: str) -> LinkFaults:
    """Return the faults of one device's line."""
    mine = [spec for spec in specs if spec.device == device]
    rates = {spec.name: spec.number(1.0) for spec in mine if spec.name in {"drop", "flip", "duplicate", "garbage"}}
    delays = [round(spec.number(10_000.0) * 1000) for spec in mine if spec.name == "delay"]
    freezes = [(spec.instant_us(), spec.duration_us or 2**62) for spec in mine if spec.name == "freeze"]
    unplugs = [spec.instant_us() for spec in mine if spec.name == "unplug"]
    return LinkFaults(
        **rates,
        delay_us=sum(delays),
        freezes_us=tuple((begin, begin + duration) for begin, duration in freezes),
        unplug_us=min(unplugs, default=None),
    )


def schedule(specs: list[FaultSpec], bench: World) -> None:
    """Let the faults of devices and plant happen at their instants.

    Raises
    ------
    ValueError
        If there is no such fault.

    """
    for spec in specs:
        if spec.name in {"drop", "flip", "duplicate", "garbage", "delay", "freeze", "unplug"}:
            continue
        action = _action(spec, bench)
        bench.at(spec.instant_us(), action)
        if spec.name == "e-stop" and spec.duration_us is not None:
            bench.at(spec.instant_us() + spec.duration_us, lambda: _press(bench.plant_stage, pressed=False))


def _action(spec: FaultSpec, bench: World) -> Callable[[], None]:
    if spec.name == "reset" and spec.device != "bus":
        return lambda: bench.reset(spec.device)
    if spec.device == "gyro" and spec.name == "sensor-fault":
        return lambda: setattr(bench.gyro_board, "sensor_fault", True)
    if spec.device == "stage" and spec.name == "e-stop":
        return lambda: _press(bench.plant_stage, pressed=True)
    if spec.device == "stage" and spec.name in _AXIS_FAULTS:
        if spec.value not in {"azimuth", "elevation"}:
            raise ValueError(f"fault {spec.text!r} needs an axis, azimuth or elevation, got {spec.value!r}")
        axis: StageAxis = getattr(bench.plant_stage, spec.value)
        return lambda: _AXIS_FAULTS[spec.name](axis, bench.now_us)
    raise ValueError(f"fault {spec.text!r}: the {spec.device} has no fault {spec.name!r}")


def _press(stage: Stage, *, pressed: bool) -> None:
    stage.e_stop = pressed


_AXIS_FAULTS: dict[str, Callable[[StageAxis, int], None]] = {
    "stall": lambda axis, now_us: axis.stall(now_us),
    "runaway": lambda axis, now_us: axis.run_away(now_us, RUNAWAY_SPEED),
    "encoder-freeze": lambda axis, now_us: axis.freeze_encoder(now_us),
    "encoder-jump": lambda axis, _: axis.jump_encoder(ENCODER_JUMP),
    "limit-switch": lambda axis, _: axis.stick_limit_switch(closed=True),
}
