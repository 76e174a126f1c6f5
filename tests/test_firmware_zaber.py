"""The emulated Zaber controller on an ideal board: what it answers, how it moves, what it refuses."""

from __future__ import annotations

from itertools import pairwise

import pytest
from fake_boards import DEG, FakeStageBoard

from sim_device.firmware.zaber import ZaberDevice, checksum

STEP = 3600  # microsteps a degree


class Host:
    """Asks the controller, and lets time pass."""

    def __init__(self, azimuth_deg: float = 5, elevation_deg: float = -3) -> None:
        self.board = FakeStageBoard(round(azimuth_deg * DEG), round(elevation_deg * DEG))
        self.device = ZaberDevice(self.board)
        self.now_us = 0

    def ask(self, text: str) -> str:
        """Send a line; return what comes at once."""
        self.device.feed(text.encode() + b"\n", self.now_us)
        return self.device.poll(self.now_us).decode().removesuffix("\r\n")

    def run(self, seconds: float) -> str:
        """Let time pass; return what came."""
        end_us, heard = self.now_us + round(seconds * 1e6), b""
        while (due_us := self.device.next_due_us()) <= end_us:
            assert due_us > self.now_us or self.now_us == 0
            self.now_us = due_us
            heard += self.device.poll(due_us)
        self.now_us = end_us
        return heard.decode()

    def homed(self) -> Host:
        """Home both axes."""
        assert self.ask("/1 home") == "@01 0 OK BUSY WR 0"
        self.run(60)
        assert self.ask("/1") == "@01 0 OK IDLE -- 0"
        return self


@pytest.mark.parametrize(
    ("question", "answer"),
    [
        ("/", "@01 0 OK IDLE WR 0"),
        ("/0 get version", "@01 0 OK IDLE WR 7.35"),
        ("/1 0 7 get deviceid", "@01 0 07 OK IDLE WR 65001"),
        ("/1 2 get pos", "@01 2 OK IDLE WR 0"),
        ("/1 get pos", "@01 0 OK IDLE WR 0 0"),
        ("/1 get limit.max", "@01 0 OK IDLE WR 1368000 342000"),
        ("/1 warnings", "@01 0 OK IDLE WR 01 WR"),
        ("/1 3 get pos", "@01 3 RJ IDLE WR BADAXIS"),
        ("/1 1 get system.serial", "@01 1 RJ IDLE WR DEVICEONLY"),
        ("/1 get peripheral.id", "@01 0 RJ IDLE WR BADCOMMAND"),
        ("/1 renumber 5", "@01 0 RJ IDLE WR BADCOMMAND"),
        ("/1 1 move abs 10", "@01 1 RJ IDLE WR BADDATA"),
        ("/1 1 100 home", "@01 1 RJ IDLE WR BADMESSAGEID"),
        ("/1 1 set maxspeed 999999999", "@01 1 RJ IDLE WR BADDATA"),
        ("/2 home", ""),
        ("home", ""),
        ("/1 home:00", ""),
    ],
)
def test_questions_and_answers(question: str, answer: str) -> None:
    """Each question gets its answer, with its number; one for another device or with a wrong sum none. None moves."""
    host = Host()
    assert host.ask(question) == answer
    host.run(1)
    assert host.board.path == []


def test_checksums_both_ways() -> None:
    """A right sum is taken, and answers have one once asked for."""
    host = Host()
    assert host.ask(f"/1 set comm.checksum 1:{checksum(b'1 set comm.checksum 1'):02X}") == "@01 0 OK IDLE WR 0:3E"
    assert host.ask("/1 get comm.checksum") == "@01 0 OK IDLE WR 1:3D"


def test_homing_and_moves() -> None:
    """Homed at its references, it goes where it is told, each axis by itself."""
    host = Host().homed()
    assert abs(host.board.position(0)) < 10
    assert abs(host.board.position(1)) < 10
    assert host.ask(f"/1 1 4 move abs {40 * STEP}") == "@01 1 04 OK BUSY -- 0"
    assert host.ask("/1 2 move abs -36000") == "@01 2 OK BUSY -- 0"
    host.run(10)
    assert host.ask("/1 get pos") == f"@01 0 OK IDLE -- {40 * STEP} -36000"
    host.ask("/1 1 move rel -3600")
    host.run(3)
    assert host.ask("/1 1 get pos") == f"@01 1 OK IDLE -- {39 * STEP}"


def test_speeds() -> None:
    """A move with a speed takes its time: 10 deg at 2 deg/s in 5 s and the ramps."""
    host = Host().homed()
    host.ask(f"/1 1 move abs {10 * STEP} {round(2 * STEP * 1.6384)}")
    host.run(4.9)
    assert " BUSY " in host.ask("/1 1")
    host.run(0.6)
    assert " IDLE " in host.ask("/1 1")
    assert host.ask(f"/1 1 move abs 0 {10**8}") == "@01 1 RJ IDLE -- BADDATA"


def test_another_move_takes_over() -> None:
    """A move during a move brakes first, then goes on to the new target, and says that it has."""
    host = Host().homed()
    host.ask(f"/1 1 move abs {90 * STEP}")
    host.run(3)
    assert host.ask("/1 1 move abs 0") == "@01 1 OK BUSY NI 0"
    host.run(20)
    assert host.ask("/1 1 get pos") == "@01 1 OK IDLE NI 0"
    path = [where for _, axis, where in host.board.path if axis == 0]
    assert max(abs(b - a) for a, b in pairwise(path)) <= 18 * DEG // 100


def test_velocity_and_stop() -> None:
    """A move at a velocity ends at the limit, or when it is stopped."""
    host = Host().homed()
    host.ask(f"/1 2 move vel {-9 * STEP}")
    host.run(3)
    assert host.ask("/1 stop") == "@01 0 OK BUSY NI 0"
    host.run(2)
    where = host.board.position(1)
    assert -20 * DEG < where < -DEG
    host.ask("/1 2 move vel -99999")
    host.run(40)
    assert abs(host.board.position(1) + 95 * DEG) <= 10


def test_alerts() -> None:
    """An axis that comes to rest says so if it shall."""
    host = Host().homed()
    host.ask("/1 set comm.alert 1")
    host.ask("/1 1 move abs 3600")
    assert host.run(5) == "!01 1 IDLE --\r\n"


def test_emergency_stop_and_its_end() -> None:
    """Pressed in motion it stops and switches the drivers off, until the button is out and they are switched on."""
    host = Host().homed()
    host.ask(f"/1 move abs {20 * STEP}")
    host.run(1)
    host.board.pressed = True
    host.run(3)
    assert host.ask("/1 1 warnings") == "@01 1 OK IDLE FH 01 FH"
    assert host.ask("/1 1 move abs 0") == "@01 1 RJ IDLE FH DRIVERDISABLED"
    assert host.ask("/1 driver enable") == "@01 0 RJ IDLE FH AGAIN"
    host.board.pressed = False
    assert host.ask("/1 driver enable") == "@01 0 OK IDLE -- 0"
    host.ask("/1 move abs 0")
    host.run(10)
    assert host.ask("/1 get pos") == "@01 0 OK IDLE -- 0 0"


def test_faults_have_flags() -> None:
    """A blocked axis has stalled; one whose encoder jumps at rest has lost its reference; a switch is a limit."""
    host = Host().homed()
    host.board.stuck[0] = host.board.overloaded[0] = True
    host.ask(f"/1 1 move abs {20 * STEP}")
    host.run(8)
    assert " IDLE FS " in host.ask("/1 1")
    assert " IDLE -- " in host.ask("/1 2")
    host = Host().homed()
    host.board.error[1] = 2 * DEG
    host.run(1)
    assert host.ask("/1 2 warnings") == "@01 2 OK IDLE FQ 02 FQ WR"
    host = Host().homed()
    host.ask(f"/1 1 move abs {20 * STEP}")
    host.run(1)
    host.board.switch[0] = True
    host.run(3)
    assert " IDLE WL " in host.ask("/1 1")
    assert host.ask("/1 1 warnings clear") == "@01 1 OK IDLE -- 01 WL"


def test_no_watchdog() -> None:
    """Without a word from the host a move goes on to its target."""
    host = Host().homed()
    host.ask(f"/1 1 move abs {180 * STEP}")
    host.run(30)
    assert abs(host.board.position(0) - 180 * DEG) <= 10


def test_home_during_a_move() -> None:
    """Homing asked for in motion begins from rest and finds the reference."""
    host = Host().homed()
    host.ask(f"/1 1 move abs {20 * STEP}")
    host.run(1)
    assert host.ask("/1 1 home") == "@01 1 OK BUSY WR 0"
    host.run(60)
    assert host.ask("/1 1 get pos").startswith("@01 1 OK IDLE")
    assert abs(host.board.position(0)) < 10
