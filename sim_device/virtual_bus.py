"""The bench on a bus of python-can inside this process, its ``virtual`` interface or any other, for tests."""

from __future__ import annotations

import threading
import time

import can

from sim_device.can_bench import ERROR, EXTENDED, REMOTE, CanBench

_STEP_S = 0.001


class BusPump:
    """Takes frames across between a bus of python-can and the bench's wire.

    Parameters
    ----------
    bench
        What is on the bus.
    bus
        The bench's own end of the bus; the caller closes it.

    Attributes
    ----------
    n_sent
        Frames that the bench has sent.

    """

    def __init__(self, bench: CanBench, bus: can.BusABC) -> None:
        self._bench = bench
        self._bus = bus
        self._tap = bench.wire.tap()
        self.n_sent = 0

    def step(self, now_us: int) -> None:
        """Bring the bench to `now_us`, in world time, with what has come over the bus."""
        while (message := self._bus.recv(0)) is not None:
            self._take(message, now_us)
        self._bench.advance_to(now_us)
        waiting = self._tap.waiting
        while waiting:
            time_us, identifier, data = waiting.popleft()
            self._bus.send(_message(time_us, identifier, data))
            self.n_sent += 1

    def run(self, stop: threading.Event, speed: float = 1.0) -> None:
        """Go with wall time, `speed` times as fast, until `stop` is set.

        It waits for no host: one that is away for long has missed its heartbeats. Tests of hosts that move the
        stage use `step`.
        """
        begin, origin_us = time.monotonic(), self._bench.now_us
        while not stop.is_set():
            message = self._bus.recv(_STEP_S)
            now_us = origin_us + round((time.monotonic() - begin) * 1e6 * speed)
            if message is not None:
                self._take(message, now_us)
            self.step(now_us)

    def _take(self, message: can.Message, now_us: int) -> None:
        self._tap.send(_identifier(message), bytes(message.data), now_us)


def _identifier(message: can.Message) -> int:
    flags = EXTENDED * message.is_extended_id | REMOTE * message.is_remote_frame
    return message.arbitration_id | flags


def _message(time_us: int, identifier: int, data: bytes) -> can.Message:
    return can.Message(
        timestamp=time_us * 1e-6,
        arbitration_id=identifier & 0x1FFFFFFF,
        is_extended_id=bool(identifier & EXTENDED),
        is_remote_frame=bool(identifier & REMOTE),
        is_error_frame=bool(identifier & ERROR),
        dlc=len(data),
        data=None if identifier & REMOTE else data,
    )
