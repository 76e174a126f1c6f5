"""The stage's firmware: homing, moves, stopping, the watchdog, and every fault that must latch."""

import struct
from collections.abc import Callable
from itertools import pairwise

import pytest
from fake_boards import DEG, FakeStageBoard
from fake_host import (
    ACK,
    CLEAR_FAULT,
    FAULT,
    GET_CONFIG,
    HOME,
    HOMING,
    IDLE,
    MOVE,
    MOVING,
    NOT_HOMED,
    SELF_TEST,
    SET_CONFIG_STAGE,
    STATUS,
    STOP,
    STOPPING,
    FakeHost,
    Status,
    heartbeat,
    hello,
    refusal,
    reply,
    request,
    status,
    target,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_device.firmware.stage import StageDevice

WATCHDOG, E_STOP, STALL, RUNAWAY, ENCODER, LIMIT_SWITCH, HOMING_FAILED = range(1, 8)
IN_POSITION, HOMED = 1, 2
BRAKING_US = 2_000_000  # from the full speed of the fake board

starts = st.tuples(st.integers(-390 * DEG, 390 * DEG), st.integers(-100 * DEG, 100 * DEG))
targets = st.tuples(st.integers(-380 * DEG, 380 * DEG), st.integers(-95 * DEG, 95 * DEG))
few = settings(max_examples=25, deadline=None)


def _connected(azimuth: int = 30 * DEG, elevation: int = -10 * DEG) -> tuple[FakeHost, FakeStageBoard]:
    board = FakeStageBoard(azimuth, elevation)
    host = FakeHost(StageDevice(board))
    host.send(hello())
    return host, board


def _homed(azimuth: int = 3 * DEG, elevation: int = -2 * DEG) -> tuple[FakeHost, FakeStageBoard]:
    host, board = _connected(azimuth, elevation)
    assert host.ask(HOME) == reply(ACK, 1)
    assert host.run_to_rest().state == IDLE
    board.path.clear()
    return host, board


def _moving() -> tuple[FakeHost, FakeStageBoard]:
    """Return a stage 1 s into a move of both axes, azimuth upward and elevation downward."""
    host, board = _homed()
    assert host.ask(MOVE, target(200 * DEG, -80 * DEG))[0] == ACK
    host.run(1_000_000)
    assert host.status.state == MOVING
    return host, board


def _assert_at_rest(host: FakeHost, board: FakeStageBoard) -> None:
    """Check that nothing moves for a while."""
    before = list(board.axis)
    host.run(3_000_000)
    assert board.axis == before
    if host.device.session:
        assert (host.status.azimuth_rate, host.status.elevation_rate) == (0, 0)


def _statuses(host: FakeHost) -> list[bytes]:
    return [body for body in host.heard if body[0] == STATUS]


# homing


@few
@given(starts)
def test_homing_finds_the_reference_from_anywhere(start: tuple[int, int]) -> None:
    """From any position homing ends with both axes at the reference edge, within an arcsec."""
    host, board = _connected(*start)
    host.ask(HOME)
    found = host.run_to_rest()
    assert (found.state, found.flags, found.move_id) == (IDLE, IN_POSITION | HOMED, 1)
    assert (found.azimuth, found.elevation) == (0, 0)
    # the last pass is at 36 arcsec/s: 0.36 arcsec a control period
    assert all(0 <= board.position(axis) <= 10 for axis in (0, 1))


def test_homing_again_gives_the_same_reference() -> None:
    """The edge is approached from the same side each time, so it is found at the same place."""
    host, board = _homed()
    places = []
    for azimuth in (90 * DEG, -45 * DEG, 1, -1):
        host.ask(MOVE, target(azimuth, azimuth // 4))
        host.run_to_rest()
        host.ask(HOME)
        assert host.status.flags == 0
        host.run_to_rest()
        places += [board.position(0), board.position(1)]
    assert max(places) - min(places) <= 4


def test_homing_needs_a_reference() -> None:
    """A dead reference sensor gives HOMING_FAILED after the range has been searched, and not before."""
    host, board = _connected()
    board.dead_side = -1
    host.ask(HOME)
    found = host.run_to_rest()
    assert (found.state, found.fault, found.flags) == (FAULT, HOMING_FAILED, 0)
    travelled = board.axis[1]
    assert 190 * DEG < travelled < 210 * DEG
    assert host.ask(HOME) == refusal(2, 7, HOMING_FAILED)


def test_homing_notices_a_reference_that_dies() -> None:
    """A sensor that sticks once the edge has been met fast is found out in the slow pass."""
    host, board = _connected()
    host.ask(HOME)
    while board.position(0) >= 0:
        host.run(10_000)
    host.run(20_000)
    board.dead_side = 1
    assert (host.run_to_rest(12_000_000).state, host.status.fault) == (FAULT, HOMING_FAILED)


def test_homing_drives_off_a_limit_switch() -> None:
    """A switch that is closed at the start lets homing leave it, and trips if it closes again."""
    host, board = _connected()
    board.switch[0] = True
    host.ask(HOME)
    host.run(300_000)
    assert host.status.state == HOMING
    board.switch[0] = False
    host.run(20_000)
    board.switch[0] = True
    host.run(20_000)
    assert (host.status.state, host.status.fault) == (FAULT, LIMIT_SWITCH)


# moves


@few
@given(st.lists(targets, min_size=1, max_size=3), st.integers(9 * DEG, 18 * DEG))
def test_moves_reach_their_targets_on_a_straight_path(where: list[tuple[int, int]], speed: int) -> None:
    """Each move ends in position at its target, and its path never leaves the span from start to target."""
    host, board = _homed()
    zero = (board.position(0), board.position(1))
    before = (0, 0)
    for goal in where:
        board.path.clear()
        host.ask(MOVE, target(*goal, speed=speed))
        found = host.run_to_rest()
        assert (found.state, found.flags, found.move_id) == (IDLE, IN_POSITION | HOMED, host.last_id)
        assert (found.azimuth, found.elevation) == goal
        for _, axis, position in board.path:
            assert min(before[axis], goal[axis]) <= position - zero[axis] <= max(before[axis], goal[axis])
        before = goal


def test_a_move_of_a_right_angle() -> None:
    """90 deg at 18 deg/s and 9 deg/s^2 take 7 s; the status tells the speed on the way."""
    host, _ = _homed()
    host.ask(MOVE, target(90 * DEG, 0))
    start_us = host.now_us
    host.run(3_500_000)
    assert host.status.azimuth_rate == 18 * DEG
    assert host.status.elevation_rate == 0
    host.run_to_rest()
    arrived = next(s.time_us for s in map(status, _statuses(host)) if s.state == IDLE and s.time_us > start_us)
    assert 7_000_000 <= arrived - start_us <= 7_030_000


def test_repeated_move_moves_once() -> None:
    """A MOVE that comes again, even after later ones, is answered or ignored, never executed."""
    host, board = _homed()
    first = request(MOVE, 2, target(10 * DEG, 0))
    host.send(first)
    assert host.send(first)[0] == reply(ACK, 2)
    host.run_to_rest()
    host.send(request(MOVE, 3, target(20 * DEG, 0)))
    host.run_to_rest()
    board.path.clear()
    assert host.send(request(MOVE, 3, target(20 * DEG, 0))) == [reply(ACK, 3)]
    assert host.send(first) == []
    host.run(1_000_000)
    assert board.path == []


@pytest.mark.parametrize(
    ("payload", "code", "detail"),
    [
        (target(380 * DEG + 1, 0), 8, 0),
        (target(-380 * DEG - 1, 0), 8, 0),
        (target(0, 95 * DEG + 1), 8, 1),
        (target(0, -(2**31)), 8, 1),
        (target(400 * DEG + 1, 0), 9, 0),
        (target(-(2**31), 0), 9, 0),
        (target(0, 0, speed=0), 4, 17),
        (target(0, 0, speed=18 * DEG + 1), 4, 17),
        (struct.pack("<iiII", 0, 0, 1, 2**32 - 1), 4, 21),
    ],
)
def test_impossible_move_is_refused(payload: bytes, code: int, detail: int) -> None:
    """A target outside the limits or an impossible speed is refused by name, and nothing moves."""
    host, board = _homed()
    assert host.ask(MOVE, payload) == refusal(2, code, detail)
    host.run(500_000)
    assert board.path == []
    assert host.status.move_id == 1


def test_move_needs_homing_and_rest() -> None:
    """MOVE is refused before homing, while homing, while moving and while stopping."""
    host, _ = _connected()
    there = target(DEG, DEG)
    assert host.ask(MOVE, there) == refusal(1, 5)
    host.ask(HOME)
    assert host.ask(MOVE, there) == refusal(3, 6)
    assert host.ask(HOME) == refusal(4, 6)
    assert host.ask(SELF_TEST) == refusal(5, 6)
    host.run_to_rest()
    assert host.ask(MOVE, target(100 * DEG, 0))[0] == ACK
    assert host.ask(MOVE, there) == refusal(7, 6)
    host.run(1_000_000)
    host.ask(STOP)
    assert host.status.state == STOPPING
    assert host.ask(MOVE, there) == refusal(9, 6)
    assert host.ask(SET_CONFIG_STAGE, bytes(28)) == refusal(10, 6)


# configuration and status

WIDE = (-380 * DEG, 380 * DEG, -95 * DEG, 95 * DEG, 18 * DEG, 9 * DEG, 100, 300)


def test_narrower_limits_are_obeyed() -> None:
    """Limits, speed and acceleration may be narrowed, and widened again to those built in."""
    host, _ = _homed()
    narrow = struct.pack("<iiiiIIHH", -DEG, 90 * DEG, 0, 5 * DEG, 2 * DEG, DEG, 50, 100)
    assert host.ask(SET_CONFIG_STAGE, narrow) == reply(0xA3, 2, narrow)
    assert host.ask(MOVE, target(-DEG - 1, 0, speed=DEG)) == refusal(3, 8, 0)
    assert host.ask(MOVE, target(0, 6 * DEG, speed=DEG)) == refusal(4, 8, 1)
    assert host.ask(MOVE, target(0, 0)) == refusal(5, 4, 17)
    wide = struct.pack("<iiiiIIHH", *WIDE)
    assert host.ask(SET_CONFIG_STAGE, wide) == reply(0xA3, 6, wide)
    assert host.ask(GET_CONFIG) == reply(0xA3, 7, wide)


@pytest.mark.parametrize(
    ("field", "value", "offset"),
    [
        (0, -380 * DEG - 1, 9),
        (1, 380 * DEG + 1, 13),
        (1, -380 * DEG - 1, 13),
        (2, -95 * DEG - 1, 17),
        (3, 95 * DEG + 1, 21),
        (4, 0, 25),
        (4, 18 * DEG + 1, 25),
        (5, 0, 29),
        (5, 9 * DEG + 1, 29),
        (6, 19, 33),
        (6, 1001, 33),
        (7, 99, 35),
        (7, 301, 35),
    ],
)
def test_wider_limits_are_refused(field: int, value: int, offset: int) -> None:
    """Nothing wider than what is built in is taken, and a refused configuration changes nothing."""
    host, _ = _connected()
    values = list(WIDE)
    values[field] = value
    assert host.ask(SET_CONFIG_STAGE, struct.pack("<iiiiIIHH", *values)) == refusal(1, 4, offset)
    assert host.ask(GET_CONFIG) == reply(0xA3, 2, struct.pack("<iiiiIIHH", *WIDE))


def test_status_keeps_its_rhythm() -> None:
    """Once a second at rest, each period in motion and half a second after, at once after a change; all counted."""
    host, _ = _homed()
    host.run(5_000_000)
    times = [status(body).time_us for body in _statuses(host)][-4:]
    assert [later - sooner for sooner, later in pairwise(times)] == [1_000_000] * 3
    host.ask(MOVE, target(50 * DEG, 0))
    assert (host.status.state, host.status.time_us) == (MOVING, host.now_us)
    host.run(1_000_000)
    times = [status(body).time_us for body in _statuses(host)][-10:]
    assert [later - sooner for sooner, later in pairwise(times)] == [100_000] * 9
    host.run(10_000_000)
    times = [
        status(body).time_us for body in _statuses(host) if status(body).state == IDLE and status(body).move_id > 1
    ]
    assert [later - sooner for sooner, later in pairwise(times)][:7] == [100_000] * 5 + [1_000_000] * 2
    assert [status(body).count for body in _statuses(host)] == list(range(len(_statuses(host))))


# coming to rest


@pytest.mark.parametrize("how", [request(STOP, 3), hello(7), hello(version=2)], ids=["STOP", "HELLO", "refused HELLO"])
def test_stopping_a_move(how: bytes) -> None:
    """STOP and any HELLO bring the stage to rest at the greatest deceleration, still homed."""
    host, board = _moving()
    host.send(how)
    host.run(BRAKING_US + 100_000)
    _assert_at_rest(host, board)
    host.send(hello(9))
    assert (host.status.state, host.status.flags, host.status.move_id) == (IDLE, HOMED, 0)


@few
@given(st.integers(0, 20_000_000))
def test_stop_at_any_instant_of_homing(after_us: int) -> None:
    """Homing can be stopped at any instant; the stage is then not homed, unless it was done."""
    host, board = _connected(100 * DEG, 50 * DEG)
    host.ask(HOME)
    host.run(after_us)
    done = host.status.state == IDLE
    assert host.ask(STOP) == reply(ACK, 2)
    assert host.run_to_rest(BRAKING_US + 200_000).state == (IDLE if done else NOT_HOMED)
    _assert_at_rest(host, board)


def test_stop_at_rest_changes_nothing() -> None:
    """STOP is accepted in every state, and at rest it is nothing but a reply."""
    host, board = _connected()
    assert host.ask(STOP) == reply(ACK, 1)
    assert host.status.state == NOT_HOMED
    board.pressed = True
    host.run(200_000)
    assert host.ask(STOP) == reply(ACK, 2)
    assert (host.status.state, host.status.fault) == (FAULT, E_STOP)


# the watchdog


@pytest.mark.parametrize("command", [HOME, MOVE])
@pytest.mark.parametrize("silent_after_us", [0, 5_000, 1_234_567])
def test_watchdog_stops_the_stage(command: int, silent_after_us: int) -> None:
    """300 ms after the last heartbeat the stage brakes; what it hears of another session does not count."""
    host, board = _homed() if command == MOVE else _connected()
    host.send(request(command, 2, target(200 * DEG, 80 * DEG) if command == MOVE else b""))
    host.run(silent_after_us)
    last_us = host.now_us
    host.send(heartbeat())
    host.beat_us = 0
    for _ in range(60):
        host.run(50_000)
        host.send(heartbeat(session=99))
        if host.now_us < last_us + 300_000:
            assert host.status.fault == 0
    tripped = next(s for s in map(status, _statuses(host)) if s.fault)
    assert (tripped.state, tripped.fault, tripped.time_us) == (FAULT, WATCHDOG, last_us + 300_000)
    assert max(time_us for time_us, _, _ in board.path) <= last_us + 300_000 + BRAKING_US + 200_000
    _assert_at_rest(host, board)
    assert host.status.flags == (HOMED if command == MOVE else 0)


def test_watchdog_counts_from_the_start_of_the_motion() -> None:
    """A host that had nothing to say at rest has the whole time once it sets the stage in motion."""
    host, _ = _homed()
    host.beat_us = 0
    host.run(10_000_000)
    host.ask(MOVE, target(50 * DEG, 0))
    host.run(299_999)
    assert host.status.state == MOVING
    host.run(1)
    assert (host.status.state, host.status.fault) == (FAULT, WATCHDOG)


def test_watchdog_lets_a_stop_finish() -> None:
    """A host may say STOP and leave: that latches nothing."""
    host, _ = _moving()
    host.ask(STOP)
    host.beat_us = 0
    host.run(BRAKING_US + 500_000)
    assert (host.status.state, host.status.fault) == (IDLE, 0)


# faults


def _press(board: FakeStageBoard) -> None:
    board.pressed = True


def _block(board: FakeStageBoard) -> None:
    board.stuck[0] = board.overloaded[0] = True


def _run_away(board: FakeStageBoard) -> None:
    board.away[0] = 40 * DEG


def _reverse(board: FakeStageBoard) -> None:
    board.away[0] = -5 * DEG


def _freeze(board: FakeStageBoard) -> None:
    board.frozen[0] = board.axis[0]


def _jump(board: FakeStageBoard) -> None:
    board.error[0] = 3 * DEG


def _close(board: FakeStageBoard) -> None:
    board.switch[1] = True


FAULTS: list[tuple[Callable[[FakeStageBoard], None], int, bool]] = [
    (_press, E_STOP, True),
    (_block, STALL, True),
    (_run_away, RUNAWAY, False),
    (_reverse, RUNAWAY, False),
    (_freeze, ENCODER, False),
    (_jump, ENCODER, False),
    (_close, LIMIT_SWITCH, True),
]


def _cure(board: FakeStageBoard) -> None:
    """Let the board behave again, where it stands."""
    board.pressed = False
    board.stuck, board.overloaded, board.switch = [False, False], [False, False], [False, False]
    board.away, board.frozen = [0, 0], [None, None]


@pytest.mark.parametrize(("harm", "fault", "keeps_homing"), FAULTS, ids=[harm.__name__ for harm, _, _ in FAULTS])
def test_fault_in_motion_latches(harm: Callable[[FakeStageBoard], None], fault: int, *, keeps_homing: bool) -> None:
    """Each fault is seen within 0.3 s, latches, stops both axes; only CLEAR_FAULT re-arms, and it does not move."""
    host, board = _moving()
    harm(board)
    host.run(300_000)
    assert (host.status.state, host.status.fault) == (FAULT, fault)
    assert host.ask(CLEAR_FAULT) == refusal(3, 6)
    host.run(500_000)
    _cure(board)
    host.run(BRAKING_US)
    assert host.status.state == FAULT
    assert host.status.flags == (HOMED if keeps_homing else 0)
    for command, payload in ((HOME, b""), (MOVE, target(0, 0))):
        assert host.ask(command, payload) == refusal(host.last_id, 7, fault)
    _assert_at_rest(host, board)
    assert host.ask(CLEAR_FAULT) == reply(ACK, host.last_id)
    assert host.status.state == (IDLE if keeps_homing else NOT_HOMED)
    assert host.status.fault == 0
    _assert_at_rest(host, board)
    host.ask(HOME)
    assert (host.run_to_rest().state, board.position(0) // 20) == (IDLE, 0)


@pytest.mark.parametrize(
    ("harm", "fault"), [(_press, E_STOP), (_block, STALL), (_freeze, ENCODER), (_close, LIMIT_SWITCH)]
)
def test_fault_in_homing_latches(harm: Callable[[FakeStageBoard], None], fault: int) -> None:
    """Homing is supervised as a move is."""
    host, board = _connected(100 * DEG, -50 * DEG)
    host.ask(HOME)
    host.run(1_000_000)
    harm(board)
    host.run(300_000)
    assert (host.status.state, host.status.fault) == (FAULT, fault)


def test_stall_is_not_pushed_on() -> None:
    """After a stall the drive is told to stay where the axis is, so that it does not leap when freed."""
    host, board = _moving()
    _block(board)
    host.run(3_000_000)
    held = board.axis[0]
    board.stuck[0] = False
    _assert_at_rest(host, board)
    _cure(board)
    host.ask(CLEAR_FAULT)
    host.ask(MOVE, target(0, 0))
    host.run(20_000)
    assert abs(board.axis[0] - held) < 100
    found = host.run_to_rest()
    assert (found.state, found.azimuth, found.flags) == (IDLE, 0, IN_POSITION | HOMED)


def test_runaway_is_not_at_rest() -> None:
    """As long as an axis runs by itself the stage is not at rest, and the fault cannot be cleared."""
    host, board = _moving()
    _run_away(board)
    host.run(5_000_000)
    assert host.ask(CLEAR_FAULT) == refusal(3, 6)
    _cure(board)
    host.run(200_000)
    assert host.ask(CLEAR_FAULT) == reply(ACK, 4)


def test_stall_freed_while_braking() -> None:
    """An axis that comes free while the other still brakes stays where it is."""
    host, board = _moving()
    _block(board)
    host.run(500_000)
    assert host.status.fault == STALL
    held = board.axis[0]
    _cure(board)
    host.run(BRAKING_US)
    assert board.axis[0] == held


@pytest.mark.parametrize(("overloaded", "fault"), [(True, STALL), (False, ENCODER)])
def test_short_of_the_target(*, overloaded: bool, fault: int) -> None:
    """An axis that stays 0.2 deg short of its target is no arrival: a fault comes 1 s after the profile's end."""
    host, board = _homed()
    board.stuck[0] = True
    board.overloaded[0] = overloaded
    host.ask(MOVE, target(DEG // 5, 0))
    host.run(1_000_000)
    assert host.status.state == MOVING
    host.run(500_000)
    assert (host.status.state, host.status.fault) == (FAULT, fault)


def test_small_encoder_error_is_in_position() -> None:
    """Backlash and encoder resolution of some arcsec are no fault."""
    host, board = _homed()
    board.error = [50, -50]
    host.ask(MOVE, target(20 * DEG, 10 * DEG))
    found = host.run_to_rest()
    assert (found.state, found.flags) == (IDLE, IN_POSITION | HOMED)
    assert (found.azimuth, found.elevation) == (20 * DEG + 50, 10 * DEG - 50)


@pytest.mark.parametrize(("harm", "fault"), [(_press, E_STOP), (_jump, ENCODER)])
def test_fault_at_rest_latches(harm: Callable[[FakeStageBoard], None], fault: int) -> None:
    """At rest the emergency stop and a jumping encoder latch within 0.1 s."""
    host, board = _homed()
    harm(board)
    host.run(100_000)
    assert (host.status.state, host.status.fault) == (FAULT, fault)
    assert host.status.flags == (HOMED if fault == E_STOP else 0)


def test_jumped_encoder_does_not_move_the_stage() -> None:
    """After an encoder jump, clearing and homing again start from where the stage truly stands."""
    host, board = _homed()
    board.error[0] = -30 * DEG
    host.run(200_000)
    host.ask(CLEAR_FAULT)
    board.path.clear()
    before = board.position(0)
    host.ask(HOME)
    host.run(20_000)
    assert all(abs(position - before) < 100 for _, axis, position in board.path if axis == 0)
    host.run_to_rest()
    host.ask(MOVE, target(45 * DEG, 0))
    assert host.run_to_rest().azimuth == 45 * DEG
    assert abs(board.position(0) - 45 * DEG) <= 10


@pytest.mark.parametrize("command", [HOME, MOVE])
def test_pressed_e_stop_refuses_motion_at_once(command: int) -> None:
    """A command that comes between the press and the next check is refused, and so is CLEAR_FAULT."""
    host, board = _homed()
    _press(board)
    assert host.ask(command, target(0, 0) if command == MOVE else b"") == refusal(2, 7, E_STOP)
    assert host.ask(CLEAR_FAULT) == refusal(3, 7, E_STOP)
    assert host.status.fault == E_STOP
    assert board.path == []


def test_e_stop_without_a_host() -> None:
    """The emergency stop works while no session is open."""
    board = FakeStageBoard()
    host = FakeHost(StageDevice(board))
    _press(board)
    host.run(200_000)
    host.send(hello())
    assert (host.status.state, host.status.fault) == (FAULT, E_STOP)


def test_hand_turned_before_homing() -> None:
    """A stage turned by hand before it is homed is no fault, and homing starts from where it stands."""
    host, board = _connected()
    board.axis[0] += 20 * DEG
    host.run(300_000)
    assert host.status.state == NOT_HOMED
    host.ask(HOME)
    host.run(20_000)
    assert abs(board.path[0][2] - 50 * DEG) < 100
    assert host.run_to_rest().state == IDLE


def test_extreme_counts_fit_the_status() -> None:
    """A count that no i32 holds is told as the nearest that one does."""
    host, board = _homed()
    board.error = [2**33, -(2**33)]
    host.run(1_500_000)
    found: Status = host.status
    assert (found.azimuth, found.elevation) == (2**31 - 1, -(2**31))
