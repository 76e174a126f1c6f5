"""The native drivers: against the project's own firmware in virtual time, and against fakes where that never errs."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable
from math import nan, radians

import numpy as np
import pytest
from golden import GOLDEN, SESSION
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.api import REPEATED, Gyro, GyroStatus, RateBlock, Stage, StageLimits, StageMode, StageState
from drivers.errors import DeviceError, DeviceFaultError, DeviceTimeoutError, LinkError, ProtocolError
from drivers.native import NativeGyro, NativeStage
from drivers.native.session import MAX_STREAM
from drivers.protocol.framing import FrameDecoder, encode_frame
from drivers.protocol.native import ANGLE_LSB, DEFINITION_HASH, MessageType, StageCode, message_type, parse
from drivers.transport.virtual import TimedDevice, VirtualClock, VirtualLink
from sim_device.bench import SimBench

DPH = radians(1 / 3600)
ARCSEC = radians(1 / 3600)
Fate = Callable[[bytes], int]


class Tap:
    """Sits between a device and its line, keeps every body, and decides how many copies of each pass."""

    def __init__(self, device: TimedDevice) -> None:
        self.device = device
        self.to_device: Fate = lambda _: 1
        self.to_host: Fate = lambda _: 1
        self.damage: Callable[[bytes], bytes] = bytes
        self.unplugged = False
        self.asked: list[tuple[int, bytes]] = []
        self.said: list[bytes] = []
        self._decoders = FrameDecoder(), FrameDecoder()

    def feed(self, data: bytes, now_us: int) -> None:
        """Pass what the host says."""
        self._check()
        for body in self._decoders[0].feed(data):
            self.asked.append((now_us, body))
            self.device.feed(self.damage(encode_frame(body) * self.to_device(body)), now_us)

    def poll(self, now_us: int) -> bytes:
        """Pass what the device says."""
        self._check()
        bodies = self._decoders[1].feed(self.device.poll(now_us))
        self.said += bodies
        return self.damage(b"".join(encode_frame(body) * self.to_host(body) for body in bodies))

    def next_due_us(self) -> int | None:
        """Return when the device is due."""
        return self.device.next_due_us()

    def requests(self, kind: MessageType) -> list[tuple[int, bytes]]:
        """Return when the host sent messages of a type, and their bodies."""
        return [(now_us, body) for now_us, body in self.asked if body[0] == kind]

    def _check(self) -> None:
        if self.unplugged:
            raise ConnectionResetError("cable pulled")


class Bench:
    """The emulated bench with both native drivers, in virtual time."""

    def __init__(self, *, seed: int = 1, limits: StageLimits | None = None) -> None:
        self.clock = VirtualClock()
        self.sim = SimBench("tvg43", seed=seed, azimuth=radians(147.0), latitude=radians(-33.0))
        self.gyro_tap, self.stage_tap = Tap(self.sim.gyro), Tap(self.sim.stage)
        self.gyro = NativeGyro(VirtualLink(self.gyro_tap, self.clock, name="bench:gyro"), self.clock)
        self.stage = NativeStage(VirtualLink(self.stage_tap, self.clock, name="bench:stage"), self.clock, limits=limits)

    def serve(self, done: Callable[[StageState], bool], *, timeout: float = 120.0) -> StageState:
        """Serve the stage until `done`."""
        deadline = self.clock.now() + timeout
        before = None
        while not done(state := self.stage.state()):
            assert self.clock.now() < deadline, f"still {state}"
            if state is before:  # look again before waiting: the next call acknowledges what this one has brought
                self.clock.wait(self.clock.now() + 0.05)
            before = state
        return state

    def homed(self) -> Bench:
        """Connect and home the stage."""
        self.stage.connect()
        self.stage.home()
        self.serve(lambda state: state.mode is StageMode.IDLE)
        return self

    def stream(self, duration: float) -> list[RateBlock]:
        """Read the gyro for a while."""
        end = self.clock.now() + duration
        blocks = self.gyro.read()
        while self.clock.now() < end:
            self.clock.wait(min(end, self.clock.now() + 0.05))
            while new := self.gyro.read():
                blocks += new
        return blocks


class FakeDevice:
    """Answers HELLO with the identity it was given and each request with the reply it was given, else ACK."""

    def __init__(
        self, kind: int = 1, *, version: int = 1, definition: int = DEFINITION_HASH, session: int = -1
    ) -> None:
        self.identity = kind, version, definition, session
        self.model = b"tvg43"
        self.replies: dict[int, tuple[int, bytes]] = {
            0x03: (0x83, struct.pack("<IIBBH", 235_000, 1_080_000, 1, 47, 0))
            if kind == 1
            else (0xA3, struct.pack("<iiiiIIHH", -10, 10, -10, 10, 5, 5, 100, 300))
        }
        self.out = b""
        self._decoder = FrameDecoder()

    def feed(self, data: bytes, now_us: int) -> None:
        """Answer."""
        for body in self._decoder.feed(data):
            if body[0] == 0x01:
                kind, version, definition, session = self.identity
                number = int.from_bytes(body[7:11], "little") if session < 0 else session
                head = struct.pack("<BHIIBIQ", 0x81, version, definition, number, kind, 7, now_us)
                self.say(head + struct.pack("<16s16s8s", self.model, b"TVG43-0017", b"1.0.0"))
            elif body[0] != 0x02:
                code, payload = self.replies.get(body[0], (0xC0, b""))
                self.say(bytes([code]) + body[1:9] + payload)

    def say(self, body: bytes) -> None:
        """Send a body."""
        self.out += encode_frame(body)

    def poll(self, now_us: int) -> bytes:
        """Return what was said."""
        out, self.out = self.out, b""
        return out

    def next_due_us(self) -> int | None:
        """Due only if something has been said."""
        return 0 if self.out else None


def gyro_on(device: TimedDevice) -> NativeGyro:
    """Return a driver on a device, with the golden frames' session."""
    clock = VirtualClock()
    return NativeGyro(VirtualLink(device, clock, name="COM3"), clock, draw_session=lambda: SESSION)


def stage_on(device: TimedDevice) -> NativeStage:
    """Return a driver on a device, with the golden frames' session."""
    clock = VirtualClock()
    return NativeStage(VirtualLink(device, clock, name="COM4"), clock, draw_session=lambda: SESSION)


def streaming_fake() -> tuple[FakeDevice, NativeGyro]:
    """Return a fake one-axis gyro with its stream started."""
    device = FakeDevice()
    gyro = gyro_on(device)
    gyro.connect()
    gyro.start()
    return device, gyro


def golden_body(name: str) -> bytes:
    """Return the body of a golden frame."""
    return next(FrameDecoder().feed(golden.frame)[0] for golden in GOLDEN if golden.name == name)


def samples(first_index: int, n: int = 3, time_us: int = 0) -> bytes:
    """Return the body of a one-axis SAMPLES whose rates are their own index's low bits."""
    rates = [(first_index + i) % 2**31 for i in range(n)]
    head = struct.pack("<BBBBIIQHhIii", 0x40, 1, n, 0, SESSION, first_index % 2**32, time_us, 0, 0, 0, 0, 0)
    return head + struct.pack(f"<{n}i", *rates)


# The whole way, against the firmware


def test_the_drivers_are_what_the_instrument_needs() -> None:
    """The drivers satisfy the Protocols (the type checker reads this), and connect to the firmware."""
    bench = Bench()
    gyro: Gyro = bench.gyro
    stage: Stage = bench.stage
    assert (gyro.connect().kind, stage.connect().kind) == ("gyro", "stage")
    assert (gyro.sample_rate, gyro.n_axes) == (235.0, 1)
    assert stage.limits.azimuth_max == pytest.approx(radians(380))
    assert stage.limits.max_speed > 0
    assert gyro.self_test().passed
    assert stage.self_test().passed


def test_samples_come_whole_and_in_si() -> None:
    """Ten seconds of stream hold every sample once, and say what the firmware said, in rad/s, rad, s."""
    bench = Bench()
    bench.gyro.connect()
    bench.gyro.start()
    blocks = bench.stream(10.0)
    sent = [parse(body) for body in bench.gyro_tap.said if body[0] == MessageType.SAMPLES]
    assert sum(len(block.counts) for block in blocks) == pytest.approx(2350, abs=47)
    assert [block.first_index for block in blocks] == [47 * i for i in range(len(blocks))]
    assert not any(block.n_lost for block in blocks)
    for block, message in zip(blocks, sent, strict=True):
        np.testing.assert_allclose(block.rate, np.asarray(message.rate) / 1024 * DPH, rtol=1e-12)
        assert block.device_time == pytest.approx(message.device_time_us / 1e6)
        assert block.arrival_time >= block.device_time
    bench.gyro.stop()
    rest = bench.gyro.read()  # the last, shorter block goes out before the answer to STREAM_STOP
    assert all(block.n_lost == 0 for block in rest)
    assert bench.stream(3.0) == []


def test_golden_samples_in_si() -> None:
    """The golden one-axis block reads 43.5, -253.75 and 38.25 deg/h, 30 and -12.5 arcsec, 24.5 C, saturated."""
    device, gyro = streaming_fake()
    device.say(golden_body("SAMPLES, one axis"))
    gyro._clock.sleep_until(1.0)
    (block,) = gyro.read()
    assert block.rate[:, 0] / DPH == pytest.approx([43.5, -253.75, 38.25])
    assert block.tilt == pytest.approx((30 * ARCSEC, -12.5 * ARCSEC))
    assert block.temperature == 24.5
    assert block.status is GyroStatus.SATURATED
    assert (block.first_index, block.n_lost, gyro.overrun_count) == (4700, 4700, 2)
    assert block.device_time == pytest.approx(20.000123)


def test_a_move_ends_at_its_target() -> None:
    """Homing, then a move to azimuth 123.4567 deg and elevation -45.5 deg: the encoders end there, to an arcsecond."""
    bench = Bench().homed()
    target = radians(123.4567), radians(-45.5)
    bench.stage.move(*target, speed=radians(10))
    assert bench.serve(lambda state: state.mode is StageMode.MOVING).azimuth_rate >= 0
    state = bench.serve(lambda state: state.in_position)
    assert (state.azimuth, state.elevation) == pytest.approx(target, abs=30 * ARCSEC)
    (_, body) = bench.stage_tap.requests(MessageType.MOVE)[-1]
    move = parse(body)
    assert (move.azimuth, move.elevation, move.azimuth_speed) == (4_444_441, -1_638_000, 360_000)


def test_in_position_is_of_this_move() -> None:
    """Right after a move is accepted the state is of this move, though no new status has come for a second."""
    bench = Bench().homed()
    assert bench.stage.state().in_position
    bench.stage_tap.to_host = lambda body: body[0] != MessageType.STAGE_STATUS
    bench.stage.move(radians(30), 0.0)
    end = bench.clock.now() + 0.5
    while bench.clock.now() < end:
        state = bench.stage.state()
        assert (state.mode, state.in_position) == (StageMode.MOVING, False)
        bench.clock.wait(bench.clock.now() + 0.05)
    bench.stage_tap.to_host = lambda _: 1
    assert bench.serve(lambda state: state.in_position).azimuth == pytest.approx(radians(30), abs=30 * ARCSEC)


def test_homing_again_does_not_look_done_at_once() -> None:
    """A stage that was idle is homing after `home`, whatever old status still lies about."""
    bench = Bench().homed()
    bench.stage_tap.to_host = lambda body: body[0] != MessageType.STAGE_STATUS
    bench.stage.home()
    assert bench.stage.state().mode is StageMode.HOMING


# Requests


def test_a_request_is_executed_once_whatever_is_lost() -> None:
    """With three replies lost a MOVE goes out four times, unchanged, 200 ms apart; the stage moves once."""
    bench = Bench().homed()
    lost = iter([0, 0, 0])
    bench.stage_tap.to_host = lambda body: next(lost, 1) if body[0] == MessageType.ACK else 1
    begun = bench.clock.now_us
    bench.stage.move(radians(10), 0.0)
    sent = bench.stage_tap.requests(MessageType.MOVE)
    assert len({body for _, body in sent}) == 1
    assert [at - begun for at, _ in sent] == pytest.approx([0, 200_000, 400_000, 600_000], abs=2)
    bench.serve(lambda state: state.in_position)
    states = [parse(body) for body in bench.stage_tap.said if body[0] == MessageType.STAGE_STATUS]
    assert len({state.move_id for state in states}) == 3  # none, the homing, this move
    assert bench.stage.troubles[REPEATED] == 3


def test_replies_that_come_twice_confuse_nothing() -> None:
    """With every message doubled, both ways, a whole sequence goes as ever, and no sample counts twice."""
    bench = Bench()
    for tap in (bench.gyro_tap, bench.stage_tap):
        tap.to_host = tap.to_device = lambda _: 2
    bench.homed()
    bench.stage.move(radians(20), radians(5))
    bench.serve(lambda state: state.in_position)
    bench.gyro.connect()
    assert bench.gyro.self_test().passed
    bench.gyro.start()
    blocks = bench.stream(5.0)
    assert [block.first_index for block in blocks] == [47 * i for i in range(len(blocks))]
    assert not any(block.n_lost for block in blocks)


def test_an_unanswered_request_gives_up_by_name() -> None:
    """Five askings without reply are a timeout after one second that names the request and the device."""
    bench = Bench().homed()
    bench.stage_tap.to_host = lambda body: body[0] != MessageType.ACK
    begun = bench.clock.now()
    with pytest.raises(
        DeviceTimeoutError, match=r"the stage on bench:stage did not answer MOVE within 1.0 s, asked 5 times"
    ):
        bench.stage.move(0.1, 0.0)
    assert bench.clock.now() - begun == pytest.approx(1.0, abs=1e-5)


def test_stop_gets_through_a_bad_line() -> None:
    """STOP is accepted within 300 ms though the line loses five of every six messages."""
    bench = Bench().homed()
    bench.stage.move(radians(300), 0.0)
    bench.serve(lambda state: state.azimuth > radians(20))
    count = iter(range(10**6))
    bench.stage_tap.to_device = lambda body: body[0] != MessageType.STOP or next(count) % 6 == 5
    begun = bench.clock.now()
    bench.stage.stop()
    assert bench.clock.now() - begun <= 0.3
    state = bench.serve(lambda state: state.mode is StageMode.IDLE)
    assert not state.in_position
    assert state.azimuth < radians(90)


def test_stop_that_is_never_accepted_says_what_to_do() -> None:
    """A stage that does not take STOP gives a timeout that points to the emergency stop."""
    bench = Bench().homed()
    bench.stage_tap.to_host = lambda body: body[0] != MessageType.ACK
    with pytest.raises(DeviceTimeoutError, match=r"did not answer STOP within 1\.0 s.*emergency stop"):
        bench.stage.stop()


# Heartbeat, silence, reset, unplugging


def test_heartbeats_keep_a_moving_stage_alive() -> None:
    """While served each 50 ms the stage hears a heartbeat at least each 100 ms; each tells the newest device time."""
    bench = Bench().homed()
    bench.stage.move(radians(200), 0.0)
    bench.serve(lambda state: state.in_position)
    beats = bench.stage_tap.requests(MessageType.HEARTBEAT)
    assert max(np.diff([at for at, _ in beats])) <= 100_000
    seen = [parse(body).seen_time_us for _, body in beats]
    assert seen == sorted(seen)
    assert seen[-1] > 10_000_000


def test_a_stage_left_alone_stops_by_its_watchdog() -> None:
    """Without service there is no heartbeat: WATCHDOG latches, is a state and no exception, and needs clear_fault."""
    bench = Bench().homed()
    bench.stage.move(radians(200), 0.0)
    bench.clock.sleep_until(bench.clock.now() + 3.0)
    state = bench.stage.state()
    assert (state.mode, state.fault) == (StageMode.FAULT, "WATCHDOG")
    with pytest.raises(DeviceFaultError, match="refused MOVE: FAULT_LATCHED, the fault WATCHDOG must be cleared first"):
        bench.stage.move(0.0, 0.0)
    bench.stage.clear_fault()
    state = bench.serve(lambda state: state.mode is StageMode.IDLE)
    assert state.fault == ""


def test_each_block_of_a_gyro_is_acknowledged() -> None:
    """Blocks of 200 ms each bring a heartbeat at once that tells that very block's time."""
    bench = Bench()
    bench.gyro.connect()
    bench.gyro.start()
    blocks = bench.stream(5.0)
    beats = bench.gyro_tap.requests(MessageType.HEARTBEAT)
    told = {(at_us / 1e6, parse(body).seen_time_us / 1e6) for at_us, body in beats}
    assert {(block.arrival_time, block.device_time) for block in blocks[1:]} <= told


def test_a_reset_gyro_falls_silent_and_is_seen() -> None:
    """A gyro reset in mid-stream is a timeout after a second of silence; reconnected, its boot count has grown."""
    bench = Bench()
    first = bench.gyro.connect()
    bench.gyro.start()
    bench.stream(2.0)
    bench.sim.reset("gyro")
    begun = bench.clock.now()
    with pytest.raises(DeviceTimeoutError, match=r"the gyro on bench:gyro has sent no samples for 1\.\d s"):
        bench.stream(10.0)
    assert bench.clock.now() - begun < 1.3
    with pytest.raises(ProtocolError, match="refused STREAM_STOP: NO_SESSION, the device was reset"):
        bench.gyro.stop()
    assert bench.gyro.connect().boot_count == first.boot_count + 1
    assert parse(bench.gyro_tap.requests(MessageType.GET_CONFIG)[-1][1]).request_id == 1
    bench.gyro.start()
    assert bench.stream(1.0)[0].first_index == 0


def test_a_stage_that_falls_silent_is_seen() -> None:
    """A stage cut off in motion is a timeout within about a second; one at rest, which says little, within three."""
    for angle, limit in ((90.0, 1.1), (0.0, 3.1)):
        bench = Bench().homed()
        bench.stage.move(radians(angle), 0.0)
        bench.serve(lambda state, angle=angle: state.in_position or bool(angle))  # type: ignore[misc]  # bound at once
        bench.stage_tap.to_host = lambda _: 0
        begun = bench.clock.now()
        with pytest.raises(DeviceTimeoutError, match="the stage on bench:stage has sent no status"):
            bench.serve(lambda _: False)
        assert bench.clock.now() - begun <= limit


def test_a_lost_word_of_arrival_is_soon_made_up_for() -> None:
    """The one status that tells of rest is lost: the next one comes as if the stage still moved."""
    bench = Bench().homed()
    arrivals: list[float] = []

    def lose_the_first(body: bytes) -> bool:
        if body[0] != MessageType.STAGE_STATUS or parse(body).state != StageCode.IDLE:
            return True
        arrivals.append(bench.clock.now())
        return len(arrivals) > 1

    bench.stage.move(radians(20), 0.0)
    bench.stage_tap.to_host = lose_the_first
    state = bench.serve(lambda state: state.in_position)
    assert state.arrival_time - arrivals[0] <= 0.15


def test_unplugging_is_a_link_error_and_close_raises_nothing() -> None:
    """A pulled cable is a LinkError with the port's name from read and state; close then raises nothing."""
    bench = Bench().homed()
    bench.gyro.connect()
    bench.gyro.start()
    bench.stream(1.0)
    bench.gyro_tap.unplugged = bench.stage_tap.unplugged = True
    with pytest.raises(LinkError, match="bench:gyro was unplugged"):
        bench.stream(1.0)
    with pytest.raises(LinkError, match="bench:stage was unplugged"):
        bench.serve(lambda _: False)
    bench.gyro.close()
    bench.stage.close()


def test_close_leaves_the_devices_at_rest() -> None:
    """Closing stops a stream and a motion; afterwards every call is a LinkError."""
    bench = Bench().homed()
    bench.gyro.connect()
    bench.gyro.start()
    bench.stage.move(radians(100), 0.0)
    bench.serve(lambda state: state.azimuth > radians(10))
    bench.gyro.close()
    bench.stage.close()
    assert len(bench.gyro_tap.requests(MessageType.STREAM_STOP)) == 1
    assert len(bench.stage_tap.requests(MessageType.STOP)) == 1
    for call in (bench.gyro.read, bench.gyro.stop, bench.stage.state, bench.stage.home):
        with pytest.raises(LinkError):
            call()


# What answers, and what does not


@pytest.mark.parametrize(
    ("device", "message"),
    [
        (FakeDevice(version=2), "the gyro on COM3 speaks protocol version 2, this driver speaks 1"),
        (FakeDevice(version=2, session=0), "the gyro on COM3 speaks protocol version 2, this driver speaks 1"),
        (FakeDevice(definition=0x1234), "the gyro on COM3 has another definition of protocol version 1: 00001234"),
        (FakeDevice(kind=2), "COM3 is a rotation stage, a gyro was expected"),
        (FakeDevice(kind=9), "COM3 is a device of the unknown kind 9"),
        (FakeDevice(session=0), "the gyro on COM3 refused to open a session"),
    ],
)
def test_the_wrong_device_is_named_at_once(device: FakeDevice, message: str) -> None:
    """Another version, definition or kind is refused by name, without a second's delay, and nothing else is tried."""
    gyro = gyro_on(device)
    with pytest.raises(ProtocolError, match=message):
        gyro.connect()
    assert gyro._clock.now() < 1.0
    with pytest.raises(LinkError, match="connect first"):
        gyro.start()


def test_a_stage_finds_a_gyro_in_its_place() -> None:
    """The other way round the sentence is right too."""
    with pytest.raises(ProtocolError, match="COM4 is a gyro, a rotation stage was expected"):
        stage_on(FakeDevice(kind=1)).connect()


class FakeBabbler(FakeDevice):
    """Answers everything with the same bytes."""

    def __init__(self, answer: bytes) -> None:
        super().__init__()
        self.answer = answer

    def feed(self, data: bytes, now_us: int) -> None:
        """Babble."""
        self.out += self.answer


@pytest.mark.parametrize(
    ("answer", "error", "message"),
    [
        (b"", DeviceTimeoutError, "nothing answered on COM3: is the device powered"),
        (
            b"\r\nlogin: \0",
            ProtocolError,
            r"COM3: 50 bytes came but no valid frame: wrong baud rate or another device\?",
        ),
        (encode_frame(b"\x02echo"), DeviceTimeoutError, "COM3: 5 frames came but no answer to HELLO"),
    ],
)
def test_no_answer_says_what_was_heard(answer: bytes, error: type[DeviceError], message: str) -> None:
    """Silence, garbage, and frames that are no answer are told apart, each after the five askings."""
    gyro = gyro_on(FakeBabbler(answer))
    with pytest.raises(error, match=message):
        gyro.connect()
    assert gyro._clock.now() == pytest.approx(1.0, abs=1e-5)


def test_hostile_names_become_printable() -> None:
    """Control characters in a device's texts never reach the terminal."""
    device = FakeDevice()
    device.model = b"\x1b]52;c;\x07\xc3\xa9\r\n"
    assert gyro_on(device).connect().model == "?]52;c;?????"


@pytest.mark.parametrize(
    ("code", "detail", "error", "message"),
    [
        (1, 0, ProtocolError, "UNKNOWN_REQUEST, this kind of device has no such request"),
        (3, 0, ProtocolError, "NO_SESSION, the device was reset, or another program has greeted it"),
        (4, 17, DeviceFaultError, "OUT_OF_RANGE, the device does not support this azimuth_speed"),
        (4, 3, DeviceFaultError, "OUT_OF_RANGE, the device does not support this value at offset 3"),
        (5, 0, DeviceFaultError, "NOT_HOMED, the stage must be homed first"),
        (7, 2, DeviceFaultError, "FAULT_LATCHED, the fault E_STOP must be cleared first"),
        (7, 99, DeviceFaultError, "FAULT_LATCHED, the fault fault 99 must be cleared first"),
        (8, 1, DeviceFaultError, "SOFT_LIMIT, the elevation lies outside the device's limits"),
        (9, 0, DeviceFaultError, "CABLE_WRAP, the azimuth would wind the cable too far"),
        (77, 0, ProtocolError, "unknown code 77"),
    ],
)
def test_refusals_have_names(code: int, detail: int, error: type[DeviceError], message: str) -> None:
    """Every error reply is an exception that names device, request, code, and what it means."""
    device = FakeDevice(kind=2)
    device.replies[0x21] = (0xFF, struct.pack("<Hi", code, detail))
    stage = stage_on(device)
    device.say(golden_body("STAGE_STATUS, moving"))
    stage.connect()
    with pytest.raises(error, match=f"the stage on COM4 refused MOVE.*{message}"):
        stage.move(0.0, 0.0)


def test_a_reply_of_the_wrong_type_is_refused() -> None:
    """A reply to the right request but of another type is a ProtocolError that names both."""
    device, gyro = streaming_fake()
    device.replies[0x05] = (0xC0, b"")
    with pytest.raises(ProtocolError, match="the gyro on COM3 answered SELF_TEST with ACK"):
        gyro.self_test()


def test_self_test_failures_have_names() -> None:
    """The golden failures are the resonator drive and the tilt sensor; a bit of a later version has a number."""
    device, gyro = streaming_fake()
    device.replies[0x05] = (0x85, struct.pack("<H", 1 << 2 | 1 << 4 | 1 << 9))
    result = gyro.self_test()
    assert result.failures == ("resonator drive", "tilt sensor", "bit 9")
    assert not result.passed


@pytest.mark.parametrize("config", [(0, 1, 1, 47, 0), (235_000, 1, 2, 47, 0), (235_000, 1, 1, 0, 0)])
def test_an_impossible_configuration_is_refused(config: tuple[int, ...]) -> None:
    """A gyro that claims no rate, two axes or empty blocks is a ProtocolError, not a division by zero."""
    device = FakeDevice()
    device.replies[0x03] = (0x83, struct.pack("<IIBBH", *config))
    with pytest.raises(ProtocolError, match="impossible configuration"):
        gyro_on(device).connect()


# Limits


@pytest.mark.parametrize(
    ("azimuth", "elevation", "speed", "message"),
    [
        (40.1, 0.0, None, "azimuth 40.1000 deg lies outside the stage's limits, -380.0000 to 40.0000 deg"),
        (0.0, -96.0, None, "elevation -96.0000 deg"),
        (nan, 0.0, None, "azimuth nan deg"),
        (0.0, 0.0, 12.0, "speed 12.0000 deg/s lies outside"),
        (0.0, 0.0, 0.0, "speed 0.0000 deg/s"),
    ],
)
def test_what_lies_outside_the_limits_is_not_sent(
    azimuth: float, elevation: float, speed: float | None, message: str
) -> None:
    """A target or speed outside the narrower of host's and device's limits is a ValueError, and nothing goes out."""
    wide = radians(1000)
    own = StageLimits(
        azimuth_min=-wide, azimuth_max=radians(40), elevation_min=-wide, elevation_max=wide, max_speed=radians(9)
    )
    bench = Bench(limits=own)
    bench.stage.connect()
    with pytest.raises(ValueError, match=message):
        bench.stage.move(radians(azimuth), radians(elevation), speed=None if speed is None else radians(speed))
    assert not bench.stage_tap.requests(MessageType.MOVE)


def test_the_very_limits_can_be_reached() -> None:
    """A target exactly at a limit, as `limits` tells it, goes out as the device's own count."""
    bench = Bench().homed()
    limits = bench.stage.limits
    bench.stage.move(limits.azimuth_min, limits.elevation_max)
    move = parse(bench.stage_tap.requests(MessageType.MOVE)[-1][1])
    assert (move.azimuth, move.elevation) == (-380 * 36_000, 95 * 36_000)
    assert move.azimuth_speed == round(limits.max_speed / ANGLE_LSB)


def test_limits_that_leave_nothing_are_refused() -> None:
    """Limits that do not overlap the device's are a caller's mistake, told at connect."""
    own = StageLimits(azimuth_min=8.0, azimuth_max=9.0, elevation_min=0.0, elevation_max=0.1, max_speed=0.1)
    with pytest.raises(ValueError, match="nowhere to go"):
        Bench(limits=own).stage.connect()


# The index, and a damaged line


@settings(deadline=None, max_examples=50)
@given(st.lists(st.tuples(st.integers(0, 2**31 - 1), st.integers(1, 119)), min_size=1, max_size=30))
def test_lost_samples_are_counted_exactly(blocks: list[tuple[int, int]]) -> None:
    """Whatever is lost, and however often the 32-bit index wraps, the lost samples are counted, none too many."""
    device, gyro = streaming_fake()
    index = 0
    for number, (gap, n) in enumerate(blocks):
        index += gap
        device.say(samples(index, n, time_us=number + 1))
        gyro._clock.sleep_until(gyro._clock.now() + 0.1)
        (block,) = gyro.read()
        assert (block.first_index, block.n_lost, len(block.counts)) == (index, gap, n)
        index += n


def test_a_block_that_comes_twice_counts_once() -> None:
    """The same block again is dropped; a block that goes back otherwise is a reset device, by name."""
    device, gyro = streaming_fake()
    for body in (samples(0, 3, 10), samples(3, 3, 20), samples(3, 3, 20), samples(6, 3, 30)):
        device.say(body)
    gyro._clock.sleep_until(1.0)
    assert [block.first_index for block in gyro.read()] == [0, 3, 6]
    device.say(samples(0, 3, 15))
    gyro._clock.sleep_until(2.0)
    with pytest.raises(DeviceFaultError, match="the gyro on COM3 was reset: its sample index went back from 9 to 0"):
        gyro.read()


def test_frames_of_another_session_are_ignored() -> None:
    """A stream frame or reply that is no part of this conversation counts as foreign and changes nothing."""
    device, gyro = streaming_fake()
    device.say(samples(0)[:4] + b"\1\2\3\4" + samples(0)[8:])
    device.say(struct.pack("<BII", 0xC0, 0xBAD, 1))
    device.say(b"\x99unknown")
    gyro._clock.sleep_until(1.0)
    assert gyro.read() == []
    assert (gyro.link_counts.n_foreign, gyro.link_counts.n_unknown) == (2, 1)


def test_axes_other_than_announced_are_refused() -> None:
    """A three-axis block from a one-axis gyro is a ProtocolError, not a wrong rate."""
    device, gyro = streaming_fake()
    device.say(golden_body("SAMPLES, three axes"))
    gyro._clock.sleep_until(1.0)
    with pytest.raises(ProtocolError, match="sent 3 axes, 1 were announced"):
        gyro.read()


def test_memory_stays_bounded_when_nobody_reads() -> None:
    """Stream frames that nobody reads do not pile up without end; the index then tells what was dropped."""
    device, gyro = streaming_fake()
    n_blocks = MAX_STREAM + 100
    for number in range(n_blocks):
        device.say(samples(3 * number, 3, number + 1))
    gyro._clock.sleep_until(1.0)
    blocks = gyro.read()
    assert len(blocks) == MAX_STREAM
    assert sum(block.n_lost + len(block.counts) for block in blocks) == 3 * n_blocks


@pytest.mark.parametrize("seed", range(3))
def test_a_noisy_line_loses_samples_but_never_alters_one(seed: int) -> None:
    """With 1 byte in 2000 flipped or lost a sequence still runs, and every sample is right or counted as lost."""
    rng = random.Random(seed)

    def damage(data: bytes) -> bytes:
        out = bytearray()
        for byte in data:
            chance = rng.random()
            if chance < 0.00025:
                continue
            out.append(byte ^ 1 << rng.randrange(8) if chance < 0.0005 else byte)
        return bytes(out)

    bench = Bench(seed=seed)
    bench.gyro_tap.damage = bench.stage_tap.damage = damage
    bench.homed()
    bench.stage.move(radians(45), radians(-20))
    bench.serve(lambda state: state.in_position)
    bench.gyro.connect()
    bench.gyro.start()
    blocks = bench.stream(60.0)
    truth: dict[int, list[int]] = {}
    for body in bench.gyro_tap.said:
        if message_type(body) is MessageType.SAMPLES:
            message = parse(body)
            truth |= {message.first_index + i: list(sample) for i, sample in enumerate(message.rate)}
    got = {block.first_index + i: sample for block in blocks for i, sample in enumerate(block.counts.tolist())}
    assert all(truth[index] == sample for index, sample in got.items())
    n_lost = sum(block.n_lost for block in blocks)
    assert n_lost + len(got) == max(got) + 1
    assert 0 < n_lost < 0.3 * len(truth)
    frames = bench.gyro.link_counts.frames
    assert frames.n_bad_crc + frames.n_bad_cobs > 0
