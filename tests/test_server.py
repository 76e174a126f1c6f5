"""The emulator as a process of its own: on pseudo-terminals and TCP, at real time and as fast as its host."""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import select
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from raw_host import (
    FAULT,
    HOME,
    IDENTITY,
    IDLE,
    MOVING,
    SAMPLES,
    SELF_TEST,
    SESSION,
    STAGE_STATUS,
    STREAM_START,
    Decoder,
    RawPort,
    Samples,
    heartbeat,
    hello,
    parse_samples,
    parse_status,
    request,
)

from sim_device.bench import SimBench
from sim_device.pace import REST_PATIENCE_US, Pace, WallTime
from sim_device.server import main

ROOT = Path(__file__).parents[1]
PATIENCE = 60.0  #: s, for what comes at once on a machine that is not busy
TURN = 0.5  #: s, for which either side may be held up between its clock and the line
SELF_TEST_RESULT = 0x85
NEAR_REFERENCE = "2413"  #: seed of a stage that is soon homed

Server = tuple["subprocess.Popen[str]", dict[str, Any]]
Start = Callable[..., Server]


@pytest.fixture
def start() -> Iterator[Start]:
    """Return a function that starts the emulator with options and gives the process and what it announced."""
    with contextlib.ExitStack() as stack:

        def begin(*options: str) -> Server:
            command = [sys.executable, "-m", "sim_device", "--parent-death", *options]
            pipe = subprocess.PIPE
            process = stack.enter_context(
                subprocess.Popen(command, cwd=ROOT, stdin=pipe, stdout=pipe, stderr=pipe, text=True)
            )
            stack.callback(process.kill)
            assert process.stdout is not None
            return process, json.loads(process.stdout.readline())

        yield begin


@contextlib.contextmanager
def opened(address: str) -> Iterator[RawPort]:
    """Open an address for a while."""
    port = RawPort(address)
    try:
        yield port
    finally:
        port.close()


def test_announces_itself(start: Start) -> None:
    """One line of JSON says where the devices are and what world they are in; SIGTERM ends it in order."""
    process, facts = start("--profile", "ideal", "--seed", "7", "--azimuth", "33", "--latitude", "-65")
    assert facts.pop("gyro").startswith("native:/dev/")
    assert facts.pop("stage").startswith("native:/dev/")
    assert facts == {"profile": "ideal", "seed": 7, "azimuth_deg": 33.0, "latitude_deg": -65.0, "pid": process.pid}
    process.send_signal(signal.SIGTERM)
    assert process.communicate(timeout=PATIENCE) == ("", "")
    assert process.returncode == 0


def test_ends_with_its_parent(start: Start) -> None:
    """When its standard input ends, as it does when the parent dies, the emulator ends as well."""
    process, _ = start("--profile", "ideal")
    assert process.stdin is not None
    process.stdin.close()
    assert process.wait(timeout=PATIENCE) == 0


@pytest.mark.parametrize("options", [[], ["--tcp"]], ids=["pty", "tcp"])
def test_both_devices_answer_again_and_again(start: Start, options: list[str]) -> None:
    """Each device answers HELLO, and answers the next host after the first has gone."""
    _, facts = start("--profile", "tvg43", "--seed", "7", *options)
    for name, kind, model in (("gyro", 1, b"tvg43"), ("stage", 2, b"stage2")):
        for session in (1, 2):
            with opened(facts[name]) as port:
                port.send(hello(session))
                identity = port.wait_for(IDENTITY)
                while int.from_bytes(identity[7:11], "little") != session:
                    identity = port.wait_for(IDENTITY)
                assert identity[11] == kind
                assert identity[24:40].rstrip(b"\0") == model


def test_one_host_at_a_time_over_tcp(start: Start) -> None:
    """A second host at the same TCP port is turned away; the first goes on; once it has gone another may come."""
    _, facts = start("--profile", "ideal", "--tcp", "--only", "gyro")
    assert "stage" not in facts
    assert facts["gyro"].startswith("native:socket://127.0.0.1:")
    with opened(facts["gyro"]) as first:
        first.send(hello())
        first.wait_for(IDENTITY)
        with opened(facts["gyro"]) as second, pytest.raises(EOFError):
            second.receive()
        first.send(hello(2))
        assert first.wait_for(IDENTITY)[7] == 2
    deadline = time.monotonic() + PATIENCE
    while True:  # until the emulator has seen the first one go
        with opened(facts["gyro"]) as third, contextlib.suppress(EOFError):
            third.send(hello(3))
            assert third.wait_for(IDENTITY)[7] == 3
            return
        assert time.monotonic() < deadline


def follow(gyro: RawPort, stage: RawPort | None, *, until: Callable[[bytes], bool]) -> list[bytes]:
    """Acknowledge everything on both lines until a body says that it is enough; return all bodies."""
    ports = [port for port in (gyro, stage) if port is not None]
    bodies: list[bytes] = []
    while True:
        ready = select.select([port.handle for port in ports], [], [], PATIENCE)[0]
        assert ready, "the emulator has fallen silent"
        for port in ports:
            if port.handle not in ready:
                continue
            for body in port.receive():
                bodies.append(body)
                if body[0] == SAMPLES:
                    port.send(heartbeat(parse_samples(body).time_us))
                elif body[0] == STAGE_STATUS:
                    port.send(heartbeat(parse_status(body).time_us))
                if until(body):
                    return bodies


def homed(body: bytes) -> bool:
    """Return whether this is the status of a stage at rest after homing."""
    return body[0] == STAGE_STATUS and parse_status(body).state == IDLE


def test_full_speed_is_a_lockstep(start: Start) -> None:
    """As fast as the host reads: 100 s of data in far less, nothing lost, the same again from the same seed."""

    def run() -> tuple[list[int], float]:
        _, facts = start("--seed", "3", "--speed", "max")
        with opened(facts["gyro"]) as gyro, opened(facts["stage"]) as stage:
            gyro.send(hello())
            stage.send(hello())
            stage.send(request(HOME, 1))
            follow(gyro, stage, until=homed)
            begin = time.monotonic()
            gyro.send(request(STREAM_START, 1))
            done = 100 * 235

            def enough(body: bytes) -> bool:
                return body[0] == SAMPLES and parse_samples(body).index >= done

            bodies = follow(gyro, stage, until=enough)
            wall = time.monotonic() - begin
        blocks = [parse_samples(body) for body in bodies if body[0] == SAMPLES]
        assert [block.index for block in blocks] == list(range(0, 47 * len(blocks), 47))
        assert blocks[-1].n_overruns == 0
        return [count for block in blocks for count in block.counts], wall

    counts, wall = run()
    assert wall < 100.0  # 0.3 s on a quiet machine
    assert run()[0] == counts


def device_time_us(port: RawPort, session: int) -> int:
    """Open a session and return the device's time then."""
    port.send(hello(session))
    identity = port.wait_for(IDENTITY)
    while int.from_bytes(identity[7:11], "little") != session:
        identity = port.wait_for(IDENTITY)
    return int.from_bytes(identity[16:24], "little")


@pytest.mark.parametrize("speed", [1, 10])
def test_as_many_times_real_time(start: Start, speed: int) -> None:
    """A second of data takes a second, at 10x no less than a tenth of it, by the clocks of both."""
    _, facts = start("--profile", "ideal", "--only", "gyro", "--speed", str(speed))
    with opened(facts["gyro"]) as gyro:
        asked = time.monotonic()
        begin_us = device_time_us(gyro, SESSION)
        answered = time.monotonic()
        gyro.send(request(STREAM_START, 1))
        end_us = begin_us + 1_000_000 * speed
        follow(gyro, None, until=lambda body: body[0] == SAMPLES and parse_samples(body).time_us > end_us)
        asked_again = time.monotonic()
        passed = (device_time_us(gyro, 2) - begin_us) * 1e-6
        answered_again = time.monotonic()
    assert asked_again - answered - TURN < passed < (answered_again - asked + TURN) * speed


@pytest.mark.parametrize("speed", ["1", "20", "max"])
def test_killed_host_stops_the_stage(start: Start, speed: str) -> None:
    """The host is killed while the stage moves: its watchdog brings it to rest."""
    _, facts = start("--profile", "ideal", "--speed", speed, "--seed", NEAR_REFERENCE)
    command = [sys.executable, str(ROOT / "tests" / "raw_host.py"), facts["stage"]]
    with opened(facts["stage"]) as observer, subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as host:
        assert host.stdout is not None
        lines: list[str] = []
        while sum(line.startswith(f"{MOVING} ") for line in lines) < 10:
            lines.append(host.stdout.readline())
            assert lines[-1], "the host has ended"
            assert not lines[-1].startswith(f"{FAULT} "), "the host was too slow itself"
        host.kill()
        acknowledged_us = max(int(line.split()[1]) for line in [*lines, *host.stdout])
        fault = None
        while fault is None:
            found = [parse_status(body) for body in observer.receive() if body[0] == STAGE_STATUS]
            fault = next((status for status in found if status.state == FAULT), None)
    assert fault.fault == 1
    # 300 ms after the last heartbeat, which came as long after what it acknowledges as the machine took
    assert fault.time_us - acknowledged_us > 200_000


def test_unplugged_line_hangs_up(start: Start) -> None:
    """A line unplugged by a fault is gone for the host, and the other goes on."""
    _, facts = start("--profile", "ideal", "--speed", "max", "--fault", "gyro:unplug@30")
    with opened(facts["gyro"]) as gyro, opened(facts["stage"]) as stage:
        gyro.send(hello())
        gyro.wait_for(IDENTITY)
        gyro.send(request(STREAM_START, 1))
        with pytest.raises(EOFError):
            follow(gyro, None, until=lambda _: False)
        stage.send(hello())
        stage.wait_for(IDENTITY)


def test_full_line_drops_blocks_as_a_uart_would(start: Start) -> None:
    """A host that does not read loses blocks, is told so, and finds no block damaged."""
    _, facts = start("--profile", "fast3", "--only", "gyro")
    with opened(facts["gyro"]) as gyro:
        gyro.send(hello())
        gyro.send(request(STREAM_START, 1))
        begin = time.monotonic()
        blocks: list[Samples] = []
        while not blocks or blocks[-1].n_overruns == 0:
            blocked = select.select([], [], [], 2.5)  # 60 kB of samples, more than the line and the device hold
            assert blocked == ([], [], [])
            for _ in range(16):  # what has come by then, and more
                blocks += [parse_samples(body) for body in gyro.receive() if body[0] == SAMPLES]
            assert time.monotonic() - begin < PATIENCE
        assert gyro.n_damaged == 0
        assert next(block for block in blocks if block.n_overruns).status & 16
        n_missing = sum(b.index - a.index - len(a.counts) // 3 for a, b in itertools.pairwise(blocks))
        assert n_missing == blocks[-1].n_overruns


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--profile", "tvg44"], "no profile 'tvg44'"),
        (["--latitude", "91"], "latitude must be from -90 to 90 deg, got 91"),
        (["--speed", "0.5"], "speed must be at least 1, got 0.5"),
        (["--seed", "-1"], "seed must not be negative"),
        (["--fault", "gyro:explode@1"], "the gyro has no fault 'explode'"),
    ],
)
def test_wrong_options(options: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Options that make no sense end it at once with one line and exit code 2."""
    assert main(options) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert message in said.err
    assert said.err.count("\n") == 1


def test_lost_time_does_not_pass() -> None:
    """An emulator that got no processor for half a second goes on where it was: its hosts were not silent."""
    instants = iter([5.0, 5.04, 5.05, 5.55, 5.6])
    wall = WallTime(lambda: next(instants))
    assert [wall.now_us() for _ in range(4)] == [40_000, 50_000, 110_000, 160_000]
    assert wall.origin == pytest.approx(5.44)


def test_pace_without_hosts() -> None:
    """Without hosts time runs at real time, or at the speed asked for, however long the emulator was not looked at."""
    for speed, expected in [(1.0, 3_000_000), (5.0, 15_000_000), (math.inf, 3_000_000)]:
        bench = SimBench("ideal")
        pace = Pace(bench, speed)
        for wall_us in (10, 1_000_000, 1_000_001, 3_000_000):
            pace.advance(wall_us)
            assert not pace.run_ahead()
        assert bench.now_us == expected


@pytest.mark.parametrize("streams", [False, True])
def test_pace_with_a_host_that_dies(*, streams: bool) -> None:
    """Once its host is silent the world waits for a while, then goes on at real time."""
    bench = SimBench("ideal")
    line = bench.gyro if streams else bench.stage
    line.feed(hello(), 0)
    line.feed(request(STREAM_START if streams else SELF_TEST, 1), 0)
    pace = Pace(bench, math.inf)
    pace.advance(0)
    while pace.run_ahead():
        pass
    ahead = bench.now_us
    assert ahead < 2_000_000
    pace.advance(REST_PATIENCE_US)
    assert bench.now_us == ahead
    pace.advance(REST_PATIENCE_US + 5_000_000)
    assert bench.now_us == ahead + 5_000_000
    assert not pace.run_ahead()


def test_pace_when_a_frame_is_lost() -> None:
    """A host that says three times that it has read nothing newer has lost it: the world holds for it no longer."""
    bench = SimBench("ideal")
    bench.stage.feed(hello(), 0)
    pace = Pace(bench, math.inf)
    pace.advance(0)
    while pace.run_ahead():
        pass
    held_us = bench.now_us
    for _ in range(2):
        bench.stage.feed(heartbeat(0), bench.now_us)
        assert not pace.run_ahead()
    bench.stage.feed(heartbeat(0), bench.now_us)
    while pace.run_ahead():
        pass
    assert bench.now_us == held_us + 1_000_000


def test_pace_of_a_self_test() -> None:
    """At full speed the wait for a self-test's end is skipped."""
    bench, decoder = SimBench("ideal"), Decoder()
    bench.gyro.feed(hello(), 0)
    bench.gyro.feed(request(SELF_TEST, 1), 0)
    pace = Pace(bench, math.inf)
    pace.advance(0)
    while pace.run_ahead():
        pass
    assert SELF_TEST_RESULT in [body[0] for body in decoder.feed(bench.gyro.poll(bench.now_us))]


@pytest.mark.parametrize("away_us", [0, 3_000_000])
def test_pace_makes_up_for_waiting(away_us: int) -> None:
    """At 10x a minute takes 6 s though the host needs 5 ms a block; of a long absence a second is made up for."""
    bench, pending = SimBench("ideal"), deque[tuple[int, int]]()
    pace, decoder = Pace(bench, 10.0), Decoder()
    bench.gyro.feed(hello(), 0)
    bench.gyro.feed(request(STREAM_START, 1), 0)
    back_us = 2_000_000 + away_us
    for wall_us in range(0, back_us + 4_000_000, 1000):
        pace.advance(wall_us)
        while pending and pending[0][0] <= wall_us and not 2_000_000 <= wall_us < back_us:
            bench.gyro.feed(heartbeat(pending.popleft()[1]), bench.now_us)
        ahead = True
        while ahead:
            said = decoder.feed(bench.gyro.poll(bench.now_us))
            samples = [parse_samples(body) for body in said if body[0] == SAMPLES]
            pending.extend((wall_us + 5000, block.time_us) for block in samples)
            ahead = not said and pace.run_ahead()
    made_up_us = 1_000_000 if away_us else 0
    assert bench.now_us == pytest.approx(10 * (6_000_000 + made_up_us) + max(0, away_us - made_up_us), abs=1_000_000)
