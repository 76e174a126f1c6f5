"""An axis of the stage on CAN: the states of CiA 402, set-points, homing, the watchdog, and faults that latch."""

import struct
from itertools import pairwise

import pytest
from fake_boards import DEG, FakeStageBoard
from raw_can import PREPARE, RESET_COMMUNICATION, RESET_NODE, SECOND, START, STOP, RawCanHost, RefusedError

from sim_device.firmware.can_axis import AxisNode

NODE = 32
DISABLED, READY, SWITCHED_ON, ENABLED = 0x40, 0x21, 0x23, 0x27
QUICK_STOP, REACTING, FAULT = 0x07, 0x0F, 0x08
IN_MOTION, REACHED, LIMITED, BIT_12, BIT_13, HOMED = 0x100, 0x400, 0x800, 0x1000, 0x2000, 0x4000
WATCHDOG, E_STOP, STALL, RUNAWAY, ENCODER, LIMIT_SWITCH, HOMING_FAILED = (
    0x8130, 0x9000, 0x7121, 0x8400, 0x7305, 0x8612, 0x8613,
)  # fmt: skip
#: Controlwords that lead to each state from DISABLED.
WAYS = {DISABLED: [], READY: [6], SWITCHED_ON: [6, 7], ENABLED: [6, 7, 15], QUICK_STOP: [6, 7, 15, 2]}


class Axis:
    """A host with one axis, in OPERATIONAL."""

    def __init__(self, start: int = 3 * DEG, axis: int = 0) -> None:
        self.board = FakeStageBoard(start, start)
        self.index = axis
        self.node = AxisNode(self.board, axis, NODE)
        self.host = RawCanHost(self.node)
        self.host.nmt(START)
        self.host.run(1000)

    @property
    def word(self) -> int:
        """The statusword that a PDO told last."""
        word: int = struct.unpack_from("<H", self.host.data(0x180 + NODE)[-1])[0]
        return word

    @property
    def state(self) -> int:
        """The state of the drive that a PDO told last."""
        return self.word & (0x6F if self.word & 0x20 or not self.word & 0x48 else 0x4F)

    @property
    def emergencies(self) -> list[int]:
        """Codes of the emergencies so far."""
        return [struct.unpack_from("<H", data)[0] for data in self.host.data(0x80 + NODE)]

    @property
    def position(self) -> int:
        """The encoder's position, by SDO."""
        value = self.host.read(0x6064)
        return value - (value >> 31 << 32)

    def command(self, word: int, target: int = 0) -> None:
        """Send a controlword with a target."""
        self.host.send(0x200 + NODE, struct.pack("<Hi", word, target))

    def lead(self, state: int) -> None:
        """Bring the drive to a state."""
        for word in WAYS[state]:
            self.command(word)
        assert self.word & 0x6F == state or state == DISABLED

    def mode(self, mode: int) -> None:
        """Choose the mode."""
        self.host.write(0x6060, mode, 1)

    def home(self) -> None:
        """Home the axis."""
        self.mode(6)
        self.lead(ENABLED)
        self.command(0x1F)
        for _ in range(100):
            self.host.run(SECOND)
            if not self.word & IN_MOTION:
                break
        assert self.word & (HOMED | BIT_12 | REACHED | BIT_13) == HOMED | BIT_12 | REACHED

    def ready(self) -> None:
        """Home the axis and choose profile position."""
        self.home()
        self.command(0x0F)
        self.mode(1)
        self.board.path.clear()

    def go(self, target: int) -> None:
        """Offer a set-point; it must be taken."""
        self.command(0x0F, target)
        self.command(0x1F, target)
        assert self.word & BIT_12
        self.command(0x0F, target)
        assert not self.word & BIT_12

    def moving(self) -> None:
        """Be homed and one second on the way to 100 deg."""
        self.ready()
        self.go(100 * DEG)
        self.host.run(SECOND)
        assert self.word & IN_MOTION

    def rest(self, limit_us: int = 60 * SECOND) -> int:
        """Let time pass until the axis rests; return how long that took."""
        begin_us = self.host.now_us
        while self.node.drive.in_motion:
            assert self.host.now_us - begin_us < limit_us
            self.host.run(10_000)
        self.host.run(1000)
        return self.host.now_us - begin_us

    def stays(self) -> bool:
        """Return whether nothing moves for a while."""
        before = list(self.board.axis)
        self.host.run(3 * SECOND)
        return self.board.axis == before


# states


@pytest.mark.parametrize(
    ("state", "word", "then"),
    [
        (DISABLED, 6, READY), (DISABLED, 7, DISABLED), (DISABLED, 15, DISABLED), (DISABLED, 0, DISABLED),
        (DISABLED, 0x1F, DISABLED), (DISABLED, 0x80, DISABLED),
        (READY, 7, SWITCHED_ON), (READY, 15, ENABLED), (READY, 0, DISABLED), (READY, 2, DISABLED), (READY, 6, READY),
        (SWITCHED_ON, 15, ENABLED), (SWITCHED_ON, 6, READY), (SWITCHED_ON, 0, DISABLED), (SWITCHED_ON, 2, DISABLED),
        (ENABLED, 7, SWITCHED_ON), (ENABLED, 6, READY), (ENABLED, 0, DISABLED), (ENABLED, 2, QUICK_STOP),
        (ENABLED, 15, ENABLED), (ENABLED, 0x80, ENABLED),
        (QUICK_STOP, 0, DISABLED), (QUICK_STOP, 15, ENABLED), (QUICK_STOP, 6, QUICK_STOP), (QUICK_STOP, 7, QUICK_STOP),
    ],
)  # fmt: skip
def test_transitions(state: int, word: int, then: int) -> None:
    """Each controlword leads where CiA 402 says, and nothing moves."""
    axis = Axis()
    axis.lead(state)
    axis.command(word)
    assert axis.state == then
    assert axis.stays()


def test_quick_stop_option_leads_to_switch_on_disabled() -> None:
    """With option 2 a quick stop ends in SWITCH ON DISABLED once at rest, with 6 it stays."""
    axis = Axis()
    axis.host.write(0x605A, 2, 2)
    axis.moving()
    axis.command(2)
    assert axis.state == QUICK_STOP
    axis.rest()
    assert axis.state == DISABLED


@pytest.mark.parametrize("word", [0, 2, 6, 7])
def test_leaving_operation_enabled_brings_to_rest_for_good(word: int) -> None:
    """An axis that is no longer enabled brakes, and goes nowhere when it is enabled again."""
    axis = Axis()
    axis.moving()
    axis.command(word)
    axis.rest(3 * SECOND)
    for again in (0, 6, 7, 15):
        axis.command(again)
    assert axis.state == ENABLED
    assert axis.stays()


# profile position


def test_set_point_handshake_and_move() -> None:
    """Bit 12 comes and goes with bit 4, bit 10 comes at the target, on the profile that was asked for."""
    axis = Axis()
    axis.ready()
    axis.host.write(0x6081, 9 * DEG, 4)
    axis.host.write(0x6084, 4 * DEG, 4)
    axis.go(40 * DEG)
    assert not axis.word & REACHED
    took_us = axis.rest()
    assert axis.word & REACHED
    assert axis.position == 40 * DEG
    assert took_us == pytest.approx((40 / 9 + 9 / 4) * 1e6, abs=50_000)
    speeds = [(b[2] - a[2]) * 100 for a, b in pairwise(axis.board.path)]
    assert max(speeds) == pytest.approx(9 * DEG, rel=1e-3)


def test_all_objects_of_a_pdo_count_before_its_controlword() -> None:
    """The target that comes with bit 4 is the one that is gone to, not the one before."""
    axis = Axis()
    axis.ready()
    axis.command(0x0F, -70 * DEG)
    axis.command(0x1F, 20 * DEG)
    axis.rest()
    assert axis.position == 20 * DEG


def test_whatever_the_order_of_the_mapping() -> None:
    """The same with the controlword mapped first or last; a refused value keeps it from acting."""
    for mapped in ([0x60400010, 0x60810020], [0x60810020, 0x60400010]):
        axis = Axis()
        write = axis.host.write
        write(0x1400, 0x80000220, 4, subindex=1)
        write(0x1600, 0, 1)
        for number, target in enumerate(mapped):
            write(0x1600, target, 4, subindex=number + 1)
        write(0x1600, 2, 1)
        write(0x1400, 0x220, 4, subindex=1)
        first = mapped[0] == 0x60400010
        axis.host.send(0x220, struct.pack("<HI" if first else "<IH", *((6, 0) if first else (0, 6))))
        assert axis.state == DISABLED
        assert axis.emergencies == [0x6320]
        axis.host.send(0x220, struct.pack("<HI" if first else "<IH", *((6, DEG) if first else (DEG, 6))))
        assert axis.state == READY
        assert axis.host.read(0x6081) == DEG


def test_set_point_in_motion_waits_its_turn() -> None:
    """A second set-point is taken when the first move has ended; if bit 4 falls before, never."""
    axis = Axis()
    axis.ready()
    axis.go(10 * DEG)
    axis.command(0x1F, 20 * DEG)
    assert not axis.word & BIT_12
    axis.rest()
    axis.rest()
    assert axis.position == 20 * DEG
    assert axis.word & BIT_12
    axis.go(0)
    axis.command(0x1F, 30 * DEG)
    axis.command(0x0F, 30 * DEG)
    axis.rest()
    assert axis.stays()
    assert axis.position == 0


def test_change_at_once_brakes_first() -> None:
    """With bit 5 the present move is cut short."""
    axis = Axis()
    axis.moving()
    axis.command(0x3F, 0)
    axis.rest()
    axis.rest()
    assert axis.position == 0
    assert max(position for _, _, position in axis.board.path) < 50 * DEG


@pytest.mark.parametrize(
    ("prepare", "word", "target", "code"),
    [
        ("ready", 0x1F, 381 * DEG, 0xFF02),
        ("ready", 0x1F, -381 * DEG, 0xFF02),
        ("ready", 0x5F, 10 * DEG, 0xFF03),
        ("unhomed", 0x1F, 10 * DEG, 0xFF01),
    ],
)
def test_refused_set_points(prepare: str, word: int, target: int, code: int) -> None:
    """Outside the limits, relative, not homed: no bit 12, an emergency that says why, no motion."""
    axis = Axis()
    if prepare == "ready":
        axis.ready()
    else:
        axis.mode(1)
        axis.lead(ENABLED)
    axis.command(word, target)
    assert axis.emergencies == [code]
    assert not axis.word & BIT_12
    assert bool(axis.word & LIMITED) == (code == 0xFF02)
    assert axis.stays()


def test_soft_limits_are_about_the_reference_and_only_narrowed() -> None:
    """607D holds the target, never goes beyond the device's own, and moves with the home offset."""
    axis = Axis()
    axis.ready()
    axis.host.write(0x607D, 30 * DEG, 4, subindex=2)
    axis.command(0x1F, 31 * DEG)
    assert axis.emergencies == [0xFF02]
    with pytest.raises(RefusedError, match="06090030"):
        axis.host.write(0x607D, 381 * DEG, 4, subindex=2)
    shifted = Axis()
    shifted.host.write(0x607C, 90 * DEG, 4)
    shifted.host.write(0x607D, 470 * DEG, 4, subindex=2)
    shifted.ready()
    assert shifted.host.read(0x6064) == 90 * DEG
    shifted.go(465 * DEG)
    shifted.rest()
    assert shifted.position == 465 * DEG
    assert abs(shifted.board.position(0) - 375 * DEG) <= 10
    shifted.command(0x1F, 471 * DEG)
    assert shifted.emergencies == [0xFF02]


def test_halt_brakes_and_its_end_starts_nothing() -> None:
    """Bit 8 brings the axis to rest with bit 10; when it falls the axis stays."""
    axis = Axis()
    axis.moving()
    axis.command(0x10F, 100 * DEG)
    axis.rest()
    assert axis.word & REACHED
    assert axis.board.position(0) < 90 * DEG
    axis.command(0x0F, 100 * DEG)
    assert axis.stays()


def test_mode_changes_at_rest_only() -> None:
    """In motion the mode stays; others than 0, 1 and 6 are refused at all times."""
    axis = Axis()
    axis.moving()
    with pytest.raises(RefusedError, match="08000022"):
        axis.mode(6)
    axis.rest()
    axis.mode(6)
    with pytest.raises(RefusedError, match="06090030"):
        axis.mode(3)


@pytest.mark.parametrize("words", [(0x16, 0x17, 0x1F, 0x1F), (6, 7, 0x1F, 0x1F)])
def test_no_edge_no_motion(words: tuple[int, ...]) -> None:
    """Bit 4 that is up, or comes up, when operation is being enabled has no rising edge."""
    axis = Axis()
    axis.mode(6)
    for word in words:
        axis.command(word)
    assert axis.state == ENABLED
    assert axis.stays()


def test_fault_voids_the_set_point_that_waits() -> None:
    """A set-point offered in motion is forgotten with a fault, even when the drive is enabled again."""
    axis = Axis()
    axis.moving()
    axis.command(0x1F, -100 * DEG)
    axis.board.pressed = True
    axis.rest(3 * SECOND)
    axis.board.pressed = False
    assert axis.stays()
    for word in (0, 0x80, 6, 7, 15):
        axis.command(word)
    assert axis.state == ENABLED
    assert axis.stays()


# homing


@pytest.mark.parametrize("start", [-20 * DEG, 20 * DEG, 0])
@pytest.mark.parametrize("index", [0, 1])
def test_homing_finds_the_reference(start: int, index: int) -> None:
    """From either side the edge is met, and the axis then stands there."""
    axis = Axis(start, index)
    axis.home()
    assert abs(axis.board.position(index)) <= 10
    assert axis.host.read(0x6064) == 0


def test_homing_clears_bits_10_and_12_at_its_start() -> None:
    """Not for a moment does a homing that has just begun look interrupted or done."""
    axis = Axis()
    axis.home()
    axis.command(0x0F)
    axis.host.forget()
    axis.command(0x1F)
    axis.host.run(500_000)
    words = [struct.unpack_from("<H", data)[0] for data in axis.host.data(0x180 + NODE)]
    assert len(words) >= 5
    assert not any(word & (REACHED | BIT_12 | HOMED) for word in words)


@pytest.mark.parametrize("word", [0x0F, 0x11F, 0x07])
def test_interrupted_homing(word: int) -> None:
    """Bit 4 falling, halt and disabling end it: at rest with bit 10, without 12, not homed."""
    axis = Axis(100 * DEG)
    axis.mode(6)
    axis.lead(ENABLED)
    axis.command(0x1F)
    axis.host.run(SECOND)
    axis.command(word)
    axis.rest()
    assert axis.word & (REACHED | BIT_12 | BIT_13 | HOMED) == REACHED
    assert axis.stays()


def test_homing_without_reference_fails() -> None:
    """An axis that meets no edge within its range latches HOMING_FAILED, with bit 13."""
    axis = Axis()
    axis.board.dead_side = 1
    axis.mode(6)
    axis.lead(ENABLED)
    axis.command(0x1F)
    axis.rest(120 * SECOND)
    assert axis.emergencies == [HOMING_FAILED]
    assert axis.state == FAULT
    assert axis.word & BIT_13


# the watchdog


@pytest.mark.parametrize(("option", "state"), [(1, FAULT), (2, DISABLED), (3, QUICK_STOP)])
def test_host_that_dies_stops_the_axis(option: int, state: int) -> None:
    """Without a heartbeat the axis sets out to rest within 300 ms, in the state that 6007 asks for, and stays."""
    axis = Axis()
    axis.host.write(0x6007, option, 2)
    axis.moving()
    axis.host.beats = False
    axis.host.run(300_000)
    assert axis.emergencies == [WATCHDOG]
    axis.rest(3 * SECOND)
    axis.host.beats = True
    assert axis.state == state
    assert axis.stays()


def test_brakes_that_are_up_to_it_leave_it_at_rest_after_300_ms() -> None:
    """The default time leaves room for braking."""
    axis = Axis()
    axis.board.stop_deceleration = 360 * DEG  # 50 ms from full speed
    axis.node = AxisNode(axis.board, 0, NODE)
    axis.host = RawCanHost(axis.node)
    axis.host.nmt(START)
    axis.ready()
    axis.go(300 * DEG)
    axis.host.run(4 * SECOND)
    axis.host.beats = False
    axis.host.run(300_000)
    before = list(axis.board.axis)
    axis.host.run(SECOND)
    assert axis.board.axis == before


def test_any_other_nodes_heartbeat_does_not_count() -> None:
    """Only the node of 1016 keeps the axis going; a watchdog of 0 or beyond 300 ms is refused."""
    axis = Axis()
    axis.moving()
    axis.host.beats = False
    for _ in range(10):
        axis.host.send(0x77E, b"\x05")
        axis.host.send(0x77F, b"\x04")
        axis.host.send(0x77F, b"\x05\x00")
        axis.host.run(50_000)
    assert WATCHDOG in axis.emergencies
    for value in (0, 127 << 16, 127 << 16 | 99, 127 << 16 | 301, 100, 128 << 16 | 200):
        with pytest.raises(RefusedError, match="06090030"):
            axis.host.write(0x1016, value, 4, subindex=1)


def test_axis_at_rest_needs_no_heartbeat() -> None:
    """The watchdog watches motion alone."""
    axis = Axis()
    axis.ready()
    axis.host.beats = False
    axis.host.run(10 * SECOND)
    assert axis.state == ENABLED


@pytest.mark.parametrize("command", [STOP, RESET_NODE, RESET_COMMUNICATION])
def test_nmt_stop_and_resets_bring_to_rest(command: int) -> None:
    """A node that is stopped or reset in motion does not go on."""
    axis = Axis()
    axis.moving()
    axis.host.nmt(command)
    axis.rest(3 * SECOND)
    axis.host.nmt(START)
    axis.host.run(1000)
    assert axis.state == FAULT
    assert axis.host.read(0x603F) == WATCHDOG
    assert bool(axis.word & HOMED) == (command != RESET_NODE)


def test_pre_operational_leaves_the_axis_to_its_watchdog() -> None:
    """NMT's PRE-OPERATIONAL ends PDOs, not the move; the heartbeat still guards it."""
    axis = Axis()
    axis.moving()
    axis.host.nmt(PREPARE)
    axis.host.run(SECOND)
    assert axis.node.drive.in_motion
    axis.host.beats = False
    axis.host.run(SECOND)
    assert axis.emergencies == [WATCHDOG]


# faults


def _press(board: FakeStageBoard) -> None:
    board.pressed = True


def _stall(board: FakeStageBoard) -> None:
    board.stuck[0] = board.overloaded[0] = True


def _run_away(board: FakeStageBoard) -> None:
    board.away[0] = -30 * DEG


def _freeze(board: FakeStageBoard) -> None:
    board.frozen[0] = board.axis[0]


def _jump(board: FakeStageBoard) -> None:
    board.error[0] = 5 * DEG


def _switch(board: FakeStageBoard) -> None:
    board.switch[0] = True


PLANTED = [
    (_press, E_STOP), (_stall, STALL), (_run_away, RUNAWAY), (_freeze, ENCODER), (_jump, ENCODER),
    (_switch, LIMIT_SWITCH),
]  # fmt: skip


@pytest.mark.parametrize(("plant", "code"), PLANTED)
def test_faults_latch_and_are_told(plant: object, code: int) -> None:
    """Each fault of a moving axis brings it to rest, is told once by emergency and 603F, and latches."""
    axis = Axis()
    axis.moving()
    assert callable(plant)
    plant(axis.board)
    axis.host.run(3 * SECOND)
    axis.board.away[0] = 0
    axis.rest(5 * SECOND)
    assert axis.emergencies == [code]
    assert axis.state == FAULT
    assert axis.host.read(0x603F) == code
    assert axis.host.read(0x1001) == 0x21
    for word in (6, 7, 15, 0x1F, 0):
        axis.command(word, 10 * DEG)
    assert axis.state == FAULT
    assert axis.stays()


@pytest.mark.parametrize("word", [0x80, 0x86, 0x8F, 0x9F])
def test_fault_reset_needs_an_edge_and_enables_nothing(word: int) -> None:
    """Bit 7 rising leads to SWITCH ON DISABLED, whatever else is asked; while it is up nothing happens."""
    axis = Axis()
    axis.moving()
    axis.command(0x80)  # up before the fault: no edge later
    axis.board.pressed = True
    axis.rest(3 * SECOND)
    axis.board.pressed = False
    axis.command(word)
    assert axis.state == FAULT
    axis.command(0)
    axis.command(word)
    assert axis.state == DISABLED
    assert axis.emergencies == [E_STOP, 0]
    assert axis.host.read(0x603F) == 0
    axis.command(word)
    assert axis.state == DISABLED
    assert axis.stays()


def test_fault_cannot_be_reset_while_pressed_or_in_motion() -> None:
    """The emergency stop must be released and the axis at rest."""
    axis = Axis()
    axis.moving()
    axis.board.pressed = True
    axis.host.run(20_000)
    assert axis.state == REACTING
    for _ in range(2):
        axis.command(0)
        axis.command(0x80)
        axis.rest(3 * SECOND)
        assert axis.state == FAULT
    axis.board.pressed = False
    axis.command(0)
    axis.command(0x80)
    assert axis.state == DISABLED


def test_faults_at_rest() -> None:
    """The emergency stop and a displaced encoder latch at rest too, the latter takes the homing away."""
    axis = Axis()
    axis.ready()
    axis.board.error[0] = DEG
    axis.host.run(200_000)
    assert axis.emergencies == [ENCODER]
    assert not axis.word & HOMED
    pressed = Axis()
    pressed.board.pressed = True
    pressed.host.run(200_000)
    assert pressed.state == FAULT


def test_an_axis_that_runs_away_at_rest() -> None:
    """An axis found moving at rest is a RUNAWAY, not an encoder that has jumped."""
    axis = Axis()
    axis.ready()
    for _ in range(200):
        axis.board.axis[0] += 30 * DEG // 1000
        axis.host.run(1000)
    assert axis.emergencies == [RUNAWAY]
    assert not axis.word & HOMED


def test_no_set_point_is_taken_from_where_the_encoder_has_jumped_to() -> None:
    """A set-point that comes right after an encoder's jump leads to the fault, not to a move."""
    axis = Axis()
    axis.ready()
    axis.board.error[0] = DEG
    axis.command(0x1F, 10 * DEG)
    assert not axis.word & (BIT_12 | IN_MOTION)
    axis.host.run(20_000)
    assert axis.emergencies == [ENCODER]
    assert axis.state == FAULT
    assert axis.stays()


def test_reset_node_resets_no_fault() -> None:
    """What has latched stays latched through NMT's resets."""
    axis = Axis()
    axis.board.pressed = True
    axis.host.run(200_000)
    axis.board.pressed = False
    axis.host.nmt(RESET_NODE)
    axis.host.nmt(START)
    axis.host.run(SECOND)
    assert axis.state == FAULT


def test_self_test_and_enabled_exclude_each_other() -> None:
    """No self-test in OPERATION ENABLED, no OPERATION ENABLED during it."""
    axis = Axis()
    axis.lead(SWITCHED_ON)
    axis.host.write(0x2030, 1, 1, subindex=1)
    axis.command(15)
    assert axis.state == SWITCHED_ON
    assert axis.host.read(0x2030, 2) == 1
    axis.host.run(600_000)
    assert (axis.host.read(0x2030, 2), axis.host.read(0x2030, 3)) == (2, 0)
    axis.command(15)
    assert axis.state == ENABLED
    with pytest.raises(RefusedError, match="08000022"):
        axis.host.write(0x2030, 1, 1, subindex=1)


# status


def test_status_period() -> None:
    """Velocity with device time, then statusword with position: each 100 ms in motion, each second at rest."""
    axis = Axis()
    axis.moving()
    axis.host.run(2 * SECOND)
    axis.host.forget()
    axis.host.run(SECOND)
    heard = [(identifier, data) for _, identifier, data in axis.host.heard if identifier in {0x1A0, 0x2A0}]
    assert [identifier for identifier, _ in heard] == [0x2A0, 0x1A0] * 10
    velocity, time_ms = struct.unpack("<iI", heard[-2][1])
    assert velocity == pytest.approx(18 * DEG, rel=0.01)
    assert time_ms == pytest.approx(axis.host.now_us / 1000, abs=100)
    word, position, mode = struct.unpack("<Hib", heard[-1][1])
    assert (word & IN_MOTION, mode) == (IN_MOTION, 1)
    assert position == pytest.approx(axis.host.read(0x6064), abs=2 * DEG)
    axis.rest()
    axis.host.forget()
    axis.host.run(3 * SECOND)
    assert len(axis.host.data(0x1A0)) == 3


def test_two_axes_share_a_stage() -> None:
    """Each axis of one board moves by itself; the emergency stop is a fault of both."""
    board = FakeStageBoard(3 * DEG, 3 * DEG)
    nodes = AxisNode(board, 0, 32), AxisNode(board, 1, 33)
    host = RawCanHost(*nodes)
    host.nmt(START)
    for node in (0, 1):
        host.write(0x6060, 6, 1, node=node)
    for word in (6, 7, 15, 31):
        host.send(0x220, struct.pack("<Hi", word, 0))
        host.send(0x221, struct.pack("<Hi", word, 0))
    host.run(60 * SECOND)
    assert [abs(board.position(axis)) <= 10 for axis in (0, 1)] == [True, True]
    board.pressed = True
    host.run(SECOND)
    assert [host.read(0x603F, node=node) for node in (0, 1)] == [E_STOP, E_STOP]
