"""Devices by name, over real pseudo-terminals where a device is needed."""

from __future__ import annotations

import os
import random
import select
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Self

import pytest

from drivers.api import DeviceIdentity
from drivers.discovery import GYROS, STAGES, identify, open_gyro, open_stage, recognisers
from drivers.errors import DeviceTimeoutError, LinkError
from drivers.native import NativeGyro, NativeStage
from drivers.recognition import Recogniser
from drivers.transport.clock import SystemClock
from sim_device.bench import SimBench

if sys.platform != "win32":
    import tty

posix = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals")
PATIENCE = 10.0  # s


class PtyGyro:
    """The emulated gyro on a pseudo-terminal, in real time, on a thread of its own."""

    def __init__(self, answer: bytes = b"") -> None:
        self.bench = SimBench("tvg43", seed=5, azimuth=1.0, latitude=0.5)
        self.answer = answer  # instead of the firmware's
        self.master, slave = os.openpty()
        self.path = os.ttyname(slave)
        self._slave = slave
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def stop(self) -> None:
        """End the service and take the port away."""
        self._done.set()
        self._thread.join(PATIENCE)
        os.close(self._slave)
        os.close(self.master)

    def _serve(self) -> None:
        start = time.monotonic()
        while not self._done.is_set():
            ready, _, _ = select.select([self.master], [], [], 0.005)
            now_us = round((time.monotonic() - start) * 1e6)
            if ready:
                data = os.read(self.master, 4096)
                if self.answer:
                    os.write(self.master, self.answer)
                else:
                    self.bench.gyro.feed(data, now_us)
            if out := self.bench.gyro.poll(now_us):
                os.write(self.master, out)


@pytest.fixture
def port(request: pytest.FixtureRequest) -> Iterator[PtyGyro]:
    """Serve a gyro, or what the test gives instead of its answers."""
    device = PtyGyro(getattr(request, "param", b""))
    yield device
    device.stop()


@posix
def test_a_gyro_streams_over_a_real_terminal(port: PtyGyro) -> None:
    """Opened by name, the emulated gyro connects, tests itself and streams over a pseudo-terminal; nothing is lost."""
    clock = SystemClock()
    gyro = open_gyro(f"native:{port.path}", clock, block_duration=10 / 235)
    assert isinstance(gyro, NativeGyro)
    assert gyro.connect().model == "tvg43"
    assert gyro.self_test().passed
    gyro.start()
    blocks = gyro.read()
    deadline = clock.now() + PATIENCE
    while len(blocks) < 10 and clock.now() < deadline:
        clock.wait(deadline)
        blocks += gyro.read()
    gyro.stop()
    gyro.close()
    assert [block.first_index for block in blocks[:10]] == list(range(0, 100, 10))
    assert not any(block.n_lost for block in blocks)


@posix
def test_a_device_tells_who_it_is(port: PtyGyro) -> None:
    """`identify` names device and serial number, and leaves the port free."""
    for _ in range(2):
        found = identify(port.path, SystemClock())
        assert found.address == f"native:{port.path}"
        assert found.identity is not None
        assert (found.identity.kind, found.identity.serial_number) == ("gyro", "SIM-G5")


@posix
@pytest.mark.parametrize("port", [b"AT\r\nERROR\r\n"], indirect=True)
def test_something_else_behind_the_port_is_told(port: PtyGyro) -> None:
    """Where another device answers `identify` says what was heard."""
    found = identify(port.path, SystemClock())
    assert found.identity is None
    assert "bytes came but no valid frame" in found.remark


@posix
def test_a_silent_port_is_told() -> None:
    """Where nothing answers `identify` says so, and so does opening a device there."""
    master, slave = os.openpty()
    path = os.ttyname(slave)
    assert identify(path, SystemClock()).remark.startswith(f"nothing answered on {path}")
    stage = open_stage(f"native:{path}", SystemClock())
    assert isinstance(stage, NativeStage)
    with pytest.raises(DeviceTimeoutError, match=f"nothing answered on {path}"):
        stage.connect()
    stage.close()
    os.close(master)
    os.close(slave)


@dataclass(frozen=True)
class FakeRecogniser:
    """Knows an instrument by one word."""

    name: str
    word: bytes
    question: bytes = b""
    baudrates: tuple[int, ...] = (9600,)

    def recognise(self, heard: bytes) -> DeviceIdentity | None:
        """Return it if its word was heard."""
        return DeviceIdentity(kind="gyro", model=self.name, serial_number="") if self.word in heard else None


class Chatty:
    """A device on a pseudo-terminal that says a word again and again, or only when it is asked; notes what it hears."""

    def __init__(self, word: bytes, *, asked: bytes = b"") -> None:
        self.heard = b""
        self.master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._serve, args=(word, asked))
        self._thread.start()

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, *failure: object) -> None:
        """End it."""
        self._done.set()
        self._thread.join(PATIENCE)
        os.close(self._slave)
        os.close(self.master)

    def _serve(self, word: bytes, asked: bytes) -> None:
        while not self._done.is_set():
            ready, _, _ = select.select([self.master], [], [], 0.005)
            data = os.read(self.master, 4096) if ready else b""
            self.heard += data
            if not asked or (data and asked in self.heard):
                os.write(self.master, word)


@posix
def test_whoever_talks_is_not_asked() -> None:
    """An instrument that streams is known by listening alone: not a byte is sent to it."""
    known = (FakeRecogniser("talker", b"abc"), FakeRecogniser("asker", b"never", question=b"who?"))
    with Chatty(b"xabc") as device:
        found = identify(device.path, SystemClock(), known=known)
        assert (found.address, found.baudrate) == (f"talker:{device.path}", 9600)
        assert device.heard == b""


@posix
def test_whoever_waits_to_be_asked_is_asked_last() -> None:
    """Only after all baud rates were listened at; its answer then names it."""
    known = (
        FakeRecogniser("talker", b"abc", baudrates=(19200, 9600)),
        FakeRecogniser("asker", b"me", question=b"who?"),
    )
    with Chatty(b"me", asked=b"who?") as device:
        found = identify(device.path, SystemClock(), known=known)
        assert found.address == f"asker:{device.path}"
        assert device.heard == b"who?"


@pytest.mark.parametrize("known", recognisers(), ids=lambda each: each.name)
def test_every_question_is_harmless_to_the_others(known: Recogniser) -> None:
    """A question ends no command of another instrument; the name is a driver's; random bytes are nobody's."""
    drivers = {entry.name for group in (GYROS, STAGES) for entry in entry_points(group=group)}
    assert known.name in drivers
    assert known.baudrates
    lines = known.question.replace(b"\n", b"\r").split(b"\r")
    text = [line for line in lines if line and line.isascii() and line.decode().isprintable()]
    assert all(line.startswith(b"/") for line in text)  # as only Zaber's commands do
    noise = random.Random(5).randbytes(20_000)
    assert known.recognise(noise) is None
    assert known.recognise(b"") is None


def test_a_port_that_cannot_be_opened_is_told() -> None:
    """A missing port is a remark of `identify`, and a LinkError when a device is opened there."""
    assert "there is no such port" in identify("/dev/there-is-no-such-port", SystemClock()).remark
    with pytest.raises(LinkError, match="there is no such port"):
        open_gyro("native:/dev/there-is-no-such-port", SystemClock())


@pytest.mark.parametrize("device", ["", "native", "native:", ":/dev/ttyUSB0", "/dev/ttyUSB0"])
def test_an_address_without_a_driver_says_how_to_write_it(device: str) -> None:
    """Without a driver or an address the sentence shows how it is written."""
    with pytest.raises(ValueError, match="write DRIVER:ADDRESS, for example native:/dev/ttyUSB0"):
        open_gyro(device, SystemClock())


def test_an_unknown_driver_lists_the_known_ones() -> None:
    """A driver that is not installed is named with those that are."""
    with pytest.raises(ValueError, match=r"no stage driver 'newport' in 'newport:COM3'; known are .*native"):
        open_stage("newport:COM3", SystemClock())


@pytest.mark.parametrize(("group", "function"), [(GYROS, "open_gyro"), (STAGES, "open_stage")])
def test_the_native_driver_is_an_entry_point(group: str, function: str) -> None:
    """Our own driver comes in by the same door as anyone else's."""
    assert EntryPoint("native", f"drivers.native:{function}", group) in tuple(entry_points(group=group))


def test_an_option_unknown_to_the_driver_is_named() -> None:
    """A bench's file with a mistyped option says which one, and what the driver takes."""
    with pytest.raises(ValueError, match="the driver 'native' takes no option 'blocksize'; it takes baudrate"):
        open_gyro("native:/dev/null", SystemClock(), blocksize=3)
