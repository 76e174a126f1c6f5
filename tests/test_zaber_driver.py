"""The Zaber driver on the emulated controller in virtual time, and on fakes that misbehave."""

from __future__ import annotations

from collections.abc import Callable
from math import degrees, radians
from typing import Any

import pytest
from served import near_home

from drivers.api import DAMAGED, StageLimits, StageMode, StageState
from drivers.errors import DeviceError, DeviceFaultError, DeviceTimeoutError, LinkError, ProtocolError
from drivers.protocol.zaber import checksum
from drivers.transport.virtual import VirtualClock, VirtualLink
from drivers.zaber import ZaberStage, open_stage, stage_axes
from drivers.zaber.recognise import RECOGNISER
from sim_device.bench import SimBench
from sim_device.faults import Endpoint, FaultSpec, FaultyLine, link_faults, schedule


class Bench:
    """The driver on the emulated controller."""

    def __init__(self, *faults: str, limits: StageLimits | None = None, seed: int = 3, **options: Any) -> None:  # noqa: ANN401 - of stage_axes
        self.sim = SimBench(near_home(), stage="zaber", seed=seed)
        self.clock = VirtualClock()
        specs = [FaultSpec.parse(fault) for fault in faults]
        schedule(specs, self.sim)
        line: Endpoint = FaultyLine(self.sim.stage, link_faults(specs, "stage"), seed=seed)
        self.stage = ZaberStage(
            VirtualLink(line, self.clock, name="bench"), self.clock, stage_axes(**options), limits=limits
        )

    def serve(self, done: Callable[[StageState], bool], patience: float = 120.0) -> StageState:
        """Serve the stage until its state is as wanted."""
        deadline = self.clock.now() + patience
        while not done(state := self.stage.state()):
            assert self.clock.now() < deadline, state
            self.clock.wait(self.clock.now() + 0.05)
        return state

    def homed(self) -> Bench:
        """Connect and home."""
        self.stage.connect()
        self.stage.home()
        self.serve(lambda state: state.mode is StageMode.IDLE)
        return self

    def angles_deg(self) -> list[float]:
        """Return where the axes truly stand."""
        return [degrees(axis.true_angle(self.sim.now_us)) for axis in self.sim.plant_stage.axes]


def test_from_connect_to_a_position() -> None:
    """It says who it is and where it may go, homes, and moves to the very angles asked for, each way."""
    bench = Bench()
    identity = bench.stage.connect()
    assert (identity.kind, identity.model, identity.firmware_version) == ("stage", "Zaber 65001", "7.35")
    limits = bench.stage.limits
    assert [degrees(x) for x in (limits.azimuth_min, limits.azimuth_max)] == pytest.approx([-380, 380])
    assert [degrees(x) for x in (limits.elevation_min, limits.elevation_max)] == pytest.approx([-95, 95])
    assert degrees(limits.max_speed) == pytest.approx(11.25, rel=1e-3)
    assert bench.stage.state().mode is StageMode.NOT_HOMED
    assert bench.stage.self_test().passed
    bench.homed()
    for azimuth, elevation in ((123.4, -45.6), (-270.0, 90.0), (-270.0, 90.0)):
        bench.stage.move(radians(azimuth), radians(elevation))
        assert bench.stage.state().mode is StageMode.MOVING
        state = bench.serve(lambda state: state.in_position)
        assert state.mode is StageMode.IDLE
        assert [degrees(state.azimuth), degrees(state.elevation)] == pytest.approx([azimuth, elevation], abs=3e-4)
        assert bench.angles_deg() == pytest.approx([azimuth, elevation], abs=3e-4)


def test_units_sense_and_zero_are_by_configuration() -> None:
    """With other microsteps a degree, the other sense and another zero, the axes go where that says."""
    bench = Bench(units_per_deg=(7200.0, -3600.0), zero_deg=(10.0, 5.0)).homed()
    assert [degrees(x) for x in (bench.stage.limits.azimuth_min, bench.stage.limits.azimuth_max)] == pytest.approx(
        [-180, 200]
    )
    assert degrees(bench.stage.limits.elevation_max) == pytest.approx(100)
    bench.stage.move(radians(30), radians(-15))
    bench.serve(lambda state: state.in_position)
    assert bench.angles_deg() == pytest.approx([40, 20], abs=3e-4)


def test_speed_is_that_asked_for() -> None:
    """A move of 20 deg at 4 deg/s takes 5 s and the ramps; the host's limit holds where no speed is given."""
    slow = StageLimits(azimuth_min=-2, azimuth_max=2, elevation_min=-1, elevation_max=1, max_speed=radians(2))
    for bench, speed, duration in ((Bench().homed(), radians(4), 5.0), (Bench(limits=slow).homed(), None, 10.0)):
        begin = bench.clock.now()
        bench.stage.move(radians(20), 0.0, speed=speed)
        bench.serve(lambda state: state.in_position)
        assert duration <= bench.clock.now() - begin < duration + 1.2


def test_one_axis() -> None:
    """Without an elevation axis the elevation is 0, the limits say so, and nothing else can be asked for."""
    bench = Bench(axis_numbers=(1, 0)).homed()
    assert (bench.stage.limits.elevation_min, bench.stage.limits.elevation_max) == (0.0, 0.0)
    bench.stage.move(radians(15), 0.0)
    assert bench.serve(lambda state: state.in_position).elevation == 0.0
    with pytest.raises(ValueError, match=r"elevation 1.0000 deg lies outside"):
        bench.stage.move(0.0, radians(1))


def test_stop_and_close_bring_it_to_rest() -> None:
    """Stopped in motion it comes to rest without being in position; closing in motion stops it as well."""
    bench = Bench().homed()
    bench.stage.move(radians(90), 0.0)
    bench.serve(lambda state: state.azimuth > radians(20))
    bench.stage.stop()
    assert bench.stage.state().mode is StageMode.STOPPING
    state = bench.serve(lambda state: state.mode is StageMode.IDLE)
    assert not state.in_position
    assert radians(20) < state.azimuth < radians(40)
    bench.stage.move(radians(300), 0.0)
    bench.serve(lambda state: state.azimuth > radians(60))
    bench.stage.close()
    bench.sim.advance_to(bench.sim.now_us + 60_000_000)
    assert bench.angles_deg()[0] < 90
    with pytest.raises(LinkError, match="connect first"):
        bench.stage.state()
    bench.stage.close()


def test_a_stage_found_moving_is_brought_to_rest() -> None:
    """Connecting anew stops a motion that another program has begun, and keeps the reference."""
    bench = Bench().homed()
    bench.stage.move(radians(90), 0.0)
    bench.serve(lambda state: state.azimuth > radians(20))
    second = ZaberStage(VirtualLink(bench.sim.stage, bench.clock), bench.clock, stage_axes())
    second.connect()
    assert second.state().mode is StageMode.IDLE
    assert second.state().azimuth < radians(40)


@pytest.mark.parametrize(
    ("fault", "words"),
    [("stage:e-stop@40+3", "emergency stop"), ("stage:stall=azimuth@40", "stalled and stopped")],
)
def test_faults_stop_the_other_axis_too(fault: str, words: str) -> None:
    """A fault of an axis is a state with its name; the whole stage is at rest and refuses to move until cleared."""
    bench = Bench(fault).homed()
    assert bench.clock.now() < 39
    bench.sim.advance_to(bench.sim.now_us)
    bench.stage.move(0.0, radians(10))
    bench.serve(lambda state: state.in_position)
    bench.clock.sleep_until(38.0)
    bench.stage.move(radians(200), radians(-60), speed=radians(6))
    state = bench.serve(lambda state: state.mode is StageMode.FAULT)
    assert words in state.fault
    bench.clock.sleep_until(bench.clock.now() + 5)
    assert bench.stage.state().mode is StageMode.FAULT
    before = bench.angles_deg()
    bench.clock.sleep_until(bench.clock.now() + 5)
    assert bench.angles_deg() == before
    with pytest.raises(DeviceFaultError, match="must be cleared first"):
        bench.stage.move(0.0, 0.0)
    assert not bench.stage.self_test().passed
    bench.stage.clear_fault()
    assert bench.stage.state().mode is StageMode.IDLE


def test_refusals_are_sentences() -> None:
    """Not homed, outside the limits, in motion: each is refused before anything is sent, in words."""
    bench = Bench()
    with pytest.raises(LinkError, match="connect first"):
        bench.stage.move(0.0, 0.0)
    bench.stage.connect()
    with pytest.raises(DeviceFaultError, match="must be homed first"):
        bench.stage.move(0.1, 0.0)
    bench.homed()
    with pytest.raises(ValueError, match=r"azimuth 381.0000 deg lies outside the stage's limits, -380.0000 to 380"):
        bench.stage.move(radians(381), 0.0)
    with pytest.raises(ValueError, match=r"speed 12.0000 deg/s"):
        bench.stage.move(0.0, 0.0, speed=radians(12))
    bench.stage.move(radians(50), 0.0)
    with pytest.raises(DeviceFaultError, match="at rest first"):
        bench.stage.home()


def test_a_stage_cut_off_is_seen() -> None:
    """A controller that falls silent is a timeout in a second; one unplugged is a lost link."""
    fake = Fake()
    stage, clock = on_fake(fake, units_per_deg=(1000.0, 1000.0))
    stage.connect()
    fake.mute = True
    begin = clock.now()
    with pytest.raises(DeviceTimeoutError, match="has not told its position"):
        wait_for(stage, clock, lambda _: False)
    assert clock.now() - begin < 1.2
    stage.close()
    bench = Bench("stage:unplug@40").homed()
    with pytest.raises(LinkError, match="bench was unplugged"):
        bench.serve(lambda _: False)
    bench.stage.close()


class Silent:
    """Takes everything and says nothing."""

    def feed(self, data: bytes, now_us: int) -> None:
        """Take it."""

    def poll(self, now_us: int) -> bytes:
        """Say nothing."""
        return b""

    def next_due_us(self) -> int | None:
        """Do nothing."""
        return None


class Fake(Silent):
    """A controller at rest that answers by a table, with right sums."""

    def __init__(self, **answers: str) -> None:
        self.answers = {
            "get deviceid": "30222", "get version": "7.35", "get system.serial": "5", "get limit.min": "-360000",
            "get limit.max": "360000", "get maxspeed": "100000", "get accel": "205", "warnings": "00", "get pos": "0",
        } | {name.replace("_", " ").replace("  ", "_"): answer for name, answer in answers.items()}  # fmt: skip
        self.out = b""
        self.heard: list[str] = []
        self.mute = False

    def feed(self, data: bytes, now_us: int) -> None:
        """Answer each line, unless mute."""
        if self.mute:
            return
        for line in data.decode().splitlines():
            device, axis, number, *words = line[1:].partition(":")[0].split(" ")
            self.heard.append(" ".join(words))
            answer = self.answers.get(" ".join(words), "0")
            flag, _, answer = answer.rpartition("|")
            text = f"{int(device):02d} {axis} {number} {flag or 'OK IDLE --'} {answer}"
            self.out += f"@{text}:{checksum(text.encode()):02X}\r\n".encode()

    def poll(self, now_us: int) -> bytes:
        """Return the answers."""
        out, self.out = self.out, b""
        return out


def on_fake(fake: Silent, limits: StageLimits | None = None, **options: Any) -> tuple[ZaberStage, VirtualClock]:  # noqa: ANN401 - of stage_axes
    """Return a driver on a fake."""
    clock = VirtualClock()
    return ZaberStage(VirtualLink(fake, clock, name="COM3"), clock, stage_axes(**options), limits=limits), clock


def wait_for(stage: ZaberStage, clock: VirtualClock, done: Callable[[StageState], bool]) -> None:
    """Serve a stage until its state is as wanted."""
    while not done(stage.state()):
        clock.wait(clock.now() + 0.05)


@pytest.mark.parametrize(
    ("answers", "error", "words"),
    [
        ({"get deviceid": "RJ IDLE --|BADCOMMAND"}, ProtocolError, "device 1 on COM3 rejected 'get deviceid': BADCOMM"),
        ({"get limit.min": "?"}, ProtocolError, r"azimuth axis \(device 1 axis 1\) on COM3 answered limit.min with"),
        ({"get version": "abc"}, ProtocolError, "firmware is 'abc'"),
        ({"get deviceid": "xyz"}, ProtocolError, "id is 'xyz'"),
        ({"get pos": "NA"}, ProtocolError, "answers questions for its position with 'NA'"),
        ({"warnings": "02 WR"}, ProtocolError, "answered a question for its warnings"),
        ({"stop": "RJ IDLE --|AGAIN"}, None, ""),
    ],
)
def test_odd_answers(answers: dict[str, str], error: type[DeviceError] | None, words: str) -> None:
    """What no Zaber says is a ProtocolError that names axis, question and answer."""
    fake = Fake()
    fake.answers |= answers
    stage, _ = on_fake(fake, units_per_deg=(1000.0, 1000.0))
    if error is None:
        stage.connect()
        return
    with pytest.raises(error, match=words):
        stage.connect()


def test_units_must_be_known() -> None:
    """Of a device that is not known, how far a microstep goes has to be told: nothing is guessed."""
    with pytest.raises(ValueError, match=r"set azimuth_units_per_deg to the microsteps .* this device, id 30222"):
        on_fake(Fake())[0].connect()


@pytest.mark.parametrize(
    ("flag", "mode", "fault"),
    [
        ("WR", StageMode.NOT_HOMED, ""),
        ("WH", StageMode.NOT_HOMED, ""),
        ("NI", StageMode.IDLE, ""),
        ("WV", StageMode.IDLE, ""),
        ("WM", StageMode.FAULT, "azimuth displaced while at rest (WM), elevation displaced while at rest (WM)"),
        ("FB", StageMode.FAULT, "azimuth a stream beyond its bounds (FB), elevation a stream beyond its bounds (FB)"),
        ("FX", StageMode.FAULT, "azimuth an unknown fault (FX), elevation an unknown fault (FX)"),
    ],
)
def test_flags_become_states(flag: str, mode: StageMode, fault: str) -> None:
    """F flags, and those that put the position in doubt, are faults by name; no reference is not homed."""
    fake = Fake()
    fake.answers["get pos"] = f"OK IDLE {flag}|0"
    stage, _ = on_fake(fake, units_per_deg=(1000.0, 1000.0))
    stage.connect()
    assert (stage.state().mode, stage.state().fault) == (mode, fault)


def test_an_old_firmware_moves_at_its_own_speed_alone() -> None:
    """Before 7.25 a move takes no speed: a slower one is refused in words, not executed too fast."""
    fake = Fake()
    fake.answers["get version"] = "6.28"
    stage, clock = on_fake(fake, units_per_deg=(1000.0, 1000.0))
    stage.connect()
    stage.move(0.1, 0.1)
    assert "move abs 5730" in fake.heard
    fake.answers["get pos"] = "5730"
    wait_for(stage, clock, lambda state: state.in_position)
    with pytest.raises(ValueError, match=r"older than 7.25"):
        stage.move(0.1, 0.1, speed=stage.limits.max_speed / 2)


def test_a_jump_at_rest_needs_a_second_answer() -> None:
    """One odd position at rest is not believed; if it stays it is."""
    fake = Fake()
    stage, clock = on_fake(fake, units_per_deg=(1000.0, 1000.0))
    stage.connect()
    stage.move(0.0, 0.0)

    def polled() -> StageState:
        n_asked = fake.heard.count("get pos")
        while fake.heard.count("get pos") < n_asked + 2:
            stage.state()
            clock.wait(clock.now() + 0.05)
        return stage.state()

    assert polled().azimuth == 0.0
    fake.answers["get pos"] = "9000"
    assert polled().azimuth == 0.0
    fake.answers["get pos"] = "0"
    assert polled().azimuth == 0.0
    fake.answers["get pos"] = "9000"
    polled()
    assert degrees(polled().azimuth) == pytest.approx(9.0)


def test_a_move_that_ends_elsewhere() -> None:
    """At rest but not at its target the stage has a fault: the command may have been damaged on its way."""
    fake = Fake()
    stage, clock = on_fake(fake, units_per_deg=(1000.0, 1000.0))
    stage.connect()
    stage.move(0.1, 0.1)
    wait_for(stage, clock, lambda state: state.mode is StageMode.FAULT)
    assert stage.state().fault == "the stage has come to rest away from its target"
    stage.clear_fault()
    assert stage.state().mode is StageMode.IDLE


def test_homing_that_ends_without_a_reference() -> None:
    """Idle again but still without a reference, homing has failed: a fault, not an endless wait."""
    fake = Fake()
    fake.answers["get pos"] = "OK IDLE WR|0"
    fake.answers["warnings"] = "01 WR"
    stage, clock = on_fake(fake, units_per_deg=(1000.0, 1000.0))
    stage.connect()
    stage.home()
    while stage.state().mode is StageMode.HOMING:
        clock.wait(clock.now() + 0.05)
    assert stage.state().fault == "homing has ended without a reference position"


def test_nothing_answers() -> None:
    """Silence is a timeout that says what was asked, and how often."""
    with pytest.raises(
        DeviceTimeoutError, match=r"device 1 on COM3 did not answer 'get deviceid' within 1.0 s, asked 5"
    ):
        on_fake(Silent())[0].connect()


@pytest.mark.parametrize("seed", range(4))
def test_a_damaged_line_never_misleads(seed: int) -> None:
    """With bytes lost and bits flipped both ways a sequence still ends where it shall."""
    bench = Bench("stage:flip=1e-4", "stage:drop=1e-4", seed=seed).homed()
    bench.stage.move(radians(45), radians(-20))
    state = bench.serve(lambda state: state.in_position)
    assert bench.angles_deg() == pytest.approx([45, -20], abs=1e-3)
    assert [degrees(state.azimuth), degrees(state.elevation)] == pytest.approx([45, -20], abs=1e-3)
    assert bench.stage.troubles[DAMAGED] > 0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"azimuth_units_per_deg": 0.0}, "azimuth_units_per_deg is 0"),
        ({"azimuth_axis": 2, "elevation_axis": 2}, "both axis 2 of device 1"),
        ({"device": 100}, "axis 1 of device 100"),
        ({"azimuth_axis": 0}, "axis 0 of device 1"),
        ({"elevation_zero_deg": 1e6}, "elevation_zero_deg is 1e"),
    ],
)
def test_options_are_checked(options: dict[str, Any], words: str) -> None:
    """An option that makes no sense is named before a port is opened."""
    with pytest.raises(ValueError, match=words):
        open_stage("/dev/null/1", VirtualClock(), **options)


def test_a_port_is_recognised_by_its_answers() -> None:
    """Its answers say who it is, and asking moves nothing; other bytes, or one answer alone, are nobody."""
    sim = SimBench(near_home(), stage="zaber", seed=7)
    sim.stage.feed(RECOGNISER.question, 1_000_000)
    heard = sim.stage.poll(1_000_000)
    identity = RECOGNISER.recognise(b"rubbish\r\n" + heard + b"@01")
    assert identity is not None
    assert (identity.model, identity.serial_number, identity.firmware_version) == ("Zaber 65001", "7", "7.35")
    assert RECOGNISER.recognise(heard.splitlines()[0] + b"\r\n") is None
    assert RECOGNISER.recognise(bytes(range(256)) * 4) is None
    assert sim.plant_stage.rest_since_us() == 0
