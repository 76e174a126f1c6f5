"""A triad and its line for the tests of gyros that send by themselves."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from fake_boards import FakeGyroBoard

from sim_device.instruments import Device


class TriadBoard(FakeGyroBoard):
    """A triad that stands still at 125 Hz; of `rates` it reads one after the other for ever."""

    sample_rate_millihz = 125_000
    serial_number = "N25581846020021"

    def __init__(self) -> None:
        super().__init__(3)
        self.rates = [(65_700, -297_450, 193_275)]
        self.force = (-11_890, -16_986, 1_013_829)
        self.failures = 0

    def read_samples(self, n: int) -> bytes:
        """Give the next samples."""
        first, self.n_read = self.n_read, self.n_read + n
        rates = [self.rates[(first + i) % len(self.rates)] for i in range(n)]
        return np.array(rates, "<i4").tobytes()

    def specific_force(self) -> tuple[int, int, int]:
        """Give what was set."""
        return self.force

    def temperature(self) -> int:
        """Give 35.5 degrees Celsius."""
        return 0x2380

    def self_test(self) -> int:
        """Give what was set."""
        return self.failures


class Wire:
    """A unit on its line, in virtual time, with whatever befalls it."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self.damage: Callable[[bytes], bytes] = bytes
        self.answers = True
        self.unplugged = False

    def feed(self, data: bytes, now_us: int) -> None:
        """Pass what the host says."""
        if self.answers:
            self.device.feed(data, now_us)

    def poll(self, now_us: int) -> bytes:
        """Pass what the unit says."""
        if self.unplugged:
            raise ConnectionResetError("cable pulled")
        return self.damage(self.device.poll(now_us))

    def next_due_us(self) -> int | None:
        """Return when the unit is due."""
        if self.unplugged:
            raise ConnectionResetError("cable pulled")
        return self.device.next_due_us()
