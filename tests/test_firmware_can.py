"""The CANopen slave: NMT, heartbeat, SDO with its abort codes, PDOs and their mapping, SYNC; and the data sheets."""

import random
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from fake_boards import FakeGyroBoard, FakeStageBoard
from hypothesis import given, settings
from hypothesis import strategies as st
from raw_can import PREPARE, RESET_COMMUNICATION, RESET_NODE, START, STOP, RawCanHost, RefusedError

import drivers
from sim_device.data_sheets import SHEETS, data_sheet
from sim_device.firmware.can_axis import AxisNode
from sim_device.firmware.can_gyro import GyroNode
from sim_device.firmware.node import Node

FOLDER = Path(drivers.__file__).parent / "eds"
GYRO, AXIS = 16, 32
MAKERS: list[Callable[[], Node]] = [
    lambda: GyroNode(FakeGyroBoard(), GYRO),
    lambda: AxisNode(FakeStageBoard(), 0, AXIS),
]


def _gyro() -> RawCanHost:
    return RawCanHost(GyroNode(FakeGyroBoard(), GYRO))


def _axis() -> RawCanHost:
    return RawCanHost(AxisNode(FakeStageBoard(), 0, AXIS))


@pytest.mark.parametrize("file", sorted(SHEETS))
def test_data_sheets_are_those_of_the_dictionaries(file: str) -> None:
    """What is shipped was written from what the firmware holds."""
    assert (FOLDER / file).read_text(encoding="ascii") == data_sheet(file)


# NMT


def test_boots_up_and_beats() -> None:
    """A node says once that it has started, then tells its state each 100 ms."""
    host = _gyro()
    assert host.heard == [(0, 0x710, b"\x00")]
    host.run(300_000)
    host.nmt(START, GYRO)
    host.run(100_000)
    beats = [(time, data) for time, identifier, data in host.heard if identifier == 0x710]
    assert beats[1:] == [(100_000, b"\x7f"), (200_000, b"\x7f"), (300_000, b"\x7f"), (400_000, b"\x05")]


def test_heartbeat_time_is_the_hosts_choice() -> None:
    """1017 sets the period, 0 silences."""
    host = _gyro()
    host.write(0x1017, 20, 2)
    host.forget()
    host.run(100_000)
    assert len(host.data(0x710)) == 5
    host.write(0x1017, 0, 2)
    host.forget()
    host.run(1_000_000)
    assert host.data(0x710) == []


@pytest.mark.parametrize(("command", "state"), [(START, 5), (STOP, 4), (PREPARE, 127)])
@pytest.mark.parametrize("addressed", [0, AXIS, AXIS + 1])
def test_nmt_commands(command: int, state: int, addressed: int) -> None:
    """A command is obeyed by all or by the node that it names."""
    host = _axis()
    host.nmt(command, addressed)
    host.forget()
    host.run(100_000)
    assert host.data(0x720) == [bytes((127 if addressed == AXIS + 1 else state,))]


@pytest.mark.parametrize("frame", [b"", b"\x01", b"\x01\x00\x00", b"\x03\x00", b"\xff\xff"])
def test_malformed_nmt_is_ignored(frame: bytes) -> None:
    """A command of another length or number changes nothing."""
    host = _axis()
    host.send(0, frame)
    host.run(100_000)
    assert host.data(0x720) == [b"\x00", b"\x7f"]


def test_stopped_node_answers_no_sdo() -> None:
    """In STOPPED only NMT and the heartbeat are alive."""
    host = _axis()
    host.nmt(STOP)
    host.send(0x600 + AXIS, struct.pack("<BHB4x", 0x40, 0x1000, 0))
    assert host.data(0x580 + AXIS) == []


@pytest.mark.parametrize(("command", "period", "text"), [(RESET_NODE, 100, b""), (RESET_COMMUNICATION, 100, b"a")])
def test_resets_restore_defaults(command: int, period: int, text: bytes) -> None:
    """Reset node restores all objects, reset communication those below 2000; both boot up."""
    host = _axis()
    host.write(0x1017, 20, 2)
    host.request(b"\x2f\x04\x20\x00a\x00\x00\x00")
    host.forget()
    host.nmt(command)
    assert host.data(0x720) == [b"\x00"]
    assert host.read(0x1017) == period
    assert host.request(b"\x40\x04\x20\x00\x00\x00\x00\x00")[0] == (0x4F if text else 0x41)


# SDO


@pytest.mark.parametrize("make", MAKERS)
def test_every_object_reads_and_writes_as_its_entry_says(make: Callable[[], Node]) -> None:
    """Each object reads; a writable one takes its own value back; another length and another access are refused."""
    node = make()
    host = RawCanHost(node)
    for entry in SHEETS["gyro.eds" if isinstance(node, GyroNode) else "cia402_stage.eds"][2]:
        index, subindex, kind, access = entry[:4]
        size = {0x02: 1, 0x05: 1, 0x03: 2, 0x06: 2, 0x10: 3, 0x16: 3, 0x04: 4, 0x07: 4}.get(kind)
        if size is None:
            continue  # texts and longer numbers have tests of their own
        value = host.read(index, subindex)
        mapping = 0x1600 <= index < 0x1800 or 0x1A00 <= index < 0x1C00
        if access != "rw":
            with pytest.raises(RefusedError, match="06010002"):
                host.write(index, value, size, subindex=subindex)
            continue
        if not mapping:
            host.write(index, value, size, subindex=subindex)
        for other in {1, 2, 3, 4} - {size}:
            with pytest.raises(RefusedError, match="06070012" if other > size else "06070013"):
                host.write(index, value, other, subindex=subindex)


@pytest.mark.parametrize(
    ("request_frame", "code"),
    [
        (struct.pack("<BHB4x", 0x40, 0x5FFF, 0), 0x06020000),
        (struct.pack("<BHB4x", 0x23, 0x5FFF, 0), 0x06020000),
        (struct.pack("<BHB4x", 0x40, 0x1018, 5), 0x06090011),
        (struct.pack("<BHBH2x", 0x2B, 0x2014, 0, 5), 0x06090030),
        (struct.pack("<BHB4x", 0xA4, 0x1000, 0), 0x05040001),  # block upload
        (struct.pack("<BHB4x", 0xC2, 0x2004, 0), 0x05040001),  # block download
        (struct.pack("<B7x", 0x60), 0x05040001),  # segment of no transfer
        (struct.pack("<B7x", 0x00), 0x05040001),
        (struct.pack("<BHBI", 0x21, 0x2004, 0, 101), 0x06070012),
        (struct.pack("<BHBI", 0x21, 0x1017, 0, 1), 0x06070013),
    ],
)
def test_sdo_refusals(request_frame: bytes, code: int) -> None:
    """Each wrong request is answered with the code of what is wrong."""
    with pytest.raises(RefusedError) as caught:
        _gyro().request(request_frame)
    assert caught.value.code == code


def _download(host: RawCanHost, text: bytes, *, announced: int | None = None, toggled: int = 0) -> None:
    """Write the user text by segments, with a wrong length announced or a segment's toggle bit wrong if asked."""
    host.request(struct.pack("<BHBI", 0x21, 0x2004, 0, len(text) if announced is None else announced))
    parts = [text[at : at + 7] for at in range(0, len(text), 7)] or [b""]
    for number, part in enumerate(parts):
        toggle = (number & 1 ^ (toggled == number + 1)) << 4
        last = number == len(parts) - 1
        host.request(bytes((toggle | 7 - len(part) << 1 | last,)) + part.ljust(7, b"\x00"))


def _upload(host: RawCanHost) -> bytes:
    answer = host.request(struct.pack("<BHB4x", 0x40, 0x2004, 0))
    if answer[0] & 2:
        return answer[4 : 8 - (answer[0] >> 2 & 3)]
    text, toggle, last = b"", 0, False
    while not last:
        part = host.request(bytes((0x60 | toggle,)) + bytes(7))
        assert part[0] & 0x10 == toggle
        text += part[1 : 8 - (part[0] >> 1 & 7)]
        toggle ^= 0x10
        last = bool(part[0] & 1)
    assert len(text) == struct.unpack_from("<I", answer, 4)[0]
    return text


@given(st.binary(max_size=100))
@settings(max_examples=40, deadline=None)
def test_segmented_transfer_of_any_text(text: bytes) -> None:
    """What is written by segments is read back, whatever its length."""
    host = _gyro()
    _download(host, text)
    assert _upload(host) == text


def test_segmented_transfers_that_go_wrong_change_nothing() -> None:
    """A wrong toggle bit, another length than announced, too long a text, an abort by the client: all refused."""
    host = _gyro()
    _download(host, b"as it was")
    with pytest.raises(RefusedError, match="05030000"):
        _download(host, bytes(30), toggled=2)
    with pytest.raises(RefusedError, match="06070010"):
        _download(host, bytes(30), announced=31)
    host.request(struct.pack("<BHB4x", 0x20, 0x2004, 0))  # length not announced
    for number in range(14):
        host.request(bytes((number % 2 << 4,)) + bytes(7))
    with pytest.raises(RefusedError, match="06070012"):
        host.request(bytes(8))
    host.request(struct.pack("<BHBI", 0x21, 0x2004, 0, 9))
    host.send(0x600 + GYRO, struct.pack("<BHBI", 0x80, 0x2004, 0, 0x05040000))
    with pytest.raises(RefusedError, match="05040001"):
        host.request(b"\x01" + bytes(7))
    assert _upload(host) == b"as it was"


# PDO


def _remap(host: RawCanHost, index: int, identifier: int, mapped: list[int]) -> None:
    host.write(index, 0x80000000 | identifier, 4, subindex=1)
    host.write(index + 0x200, 0, 1)
    for number, target in enumerate(mapped):
        host.write(index + 0x200, target, 4, subindex=number + 1)
    host.write(index + 0x200, len(mapped), 1)
    host.write(index, identifier, 4, subindex=1)


def test_mapping_is_the_hosts_choice() -> None:
    """A transmit PDO sends what has been mapped to it, under the identifier that it was given."""
    host = _axis()
    _remap(host, 0x1800, 0x1A5, [0x60610008, 0x603F0010, 0x60640020])
    host.nmt(START)
    assert host.data(0x1A5) == [bytes(7)]
    assert host.data(0x1A0) == []


@pytest.mark.parametrize(
    ("index", "target", "code"),
    [
        (0x1800, 0x60980008, "06040041"),  # not for PDOs
        (0x1800, 0x60410020, "06040041"),  # another length
        (0x1800, 0x5FFF0008, "06040041"),
        (0x1400, 0x60410010, "06040041"),  # read-only
    ],
)
def test_what_cannot_be_mapped(index: int, target: int, code: str) -> None:
    """A mapping to an object that is not for PDOs of this direction is refused."""
    host = _axis()
    host.write(index, 0x80000000 | host.read(index, 1), 4, subindex=1)
    host.write(index + 0x200, 0, 1)
    with pytest.raises(RefusedError, match=code):
        host.write(index + 0x200, target, 4, subindex=1)


def test_mapping_is_at_most_eight_bytes_and_changes_only_while_invalid() -> None:
    """Three times 32 bits do not fit; a valid PDO keeps its mapping and identifier."""
    host = _axis()
    for subindex, value, size in ((0, 1, 1), (1, 0x60410010, 4)):
        with pytest.raises(RefusedError, match="08000022"):
            host.write(0x1A00, value, size, subindex=subindex)
    with pytest.raises(RefusedError, match="08000022"):
        host.write(0x1800, 0x1A5, 4, subindex=1)
    with pytest.raises(RefusedError, match="06040042"):
        _remap(host, 0x1800, 0x1A0, [0x60640020, 0x606C0020, 0x21100020])
    with pytest.raises(RefusedError, match="06040041"):
        host.write(0x1A00, 4, 1)  # the fourth entry is empty


@pytest.mark.parametrize("identifier", [0, 0x80, 0x180, 0x620, 0x5A0, 0x720, 0x20000200])
def test_identifiers_of_other_services_are_refused(identifier: int) -> None:
    """A PDO can never answer as NMT, SDO or heartbeat."""
    with pytest.raises(RefusedError, match="06090030"):
        _axis().write(0x1400, 0x80000000 | identifier, 4, subindex=1)


def test_synchronous_pdos() -> None:
    """A PDO of type n goes out at each nth SYNC, one of type 0 at that after its event; received ones wait for it."""
    host = _axis()
    host.write(0x1800, 2, 1, subindex=2)
    host.write(0x1801, 0, 1, subindex=2)
    host.write(0x1400, 1, 1, subindex=2)
    host.nmt(START)
    host.forget()
    host.send(0x200 + AXIS, struct.pack("<Hi", 6, 0))
    assert host.read(0x6041) & 0x6F == 0x40
    for _ in range(4):
        host.send(0x80, b"")
    assert host.read(0x6041) & 0x6F == 0x21
    assert len(host.data(0x1A0)) == 2
    assert len(host.data(0x2A0)) == 1  # the controlword's


def test_event_timer() -> None:
    """A PDO with an event timer goes out at least so often."""
    host = _axis()
    host.write(0x1800, 30, 2, subindex=5)
    host.nmt(START)
    host.forget()
    host.run(300_000)
    assert len(host.data(0x1A0)) == 10


def test_short_pdo_is_ignored_and_reported_once() -> None:
    """Too few bytes are an emergency, not half a command; a good PDO ends it."""
    host = _axis()
    host.nmt(START)
    host.send(0x200 + AXIS, b"\x06\x00")
    host.send(0x200 + AXIS, b"\x06")
    assert host.data(0x80 + AXIS) == [struct.pack("<HB5x", 0x8210, 0x11)]
    assert host.read(0x6041) & 0x6F == 0x40
    host.send(0x200 + AXIS, struct.pack("<Hi", 6, 0))
    assert host.data(0x80 + AXIS)[1:] == [bytes(8)]
    assert host.read(0x6041) & 0x6F == 0x21


def test_pdos_pass_in_operational_only() -> None:
    """Before NMT's start a PDO is neither taken nor sent."""
    host = _axis()
    host.send(0x200 + AXIS, struct.pack("<Hi", 6, 0))
    host.run(2_000_000)
    assert host.data(0x1A0) == []
    assert host.read(0x6041) & 0x6F == 0x40


# fuzz


def _valid(rng: random.Random) -> tuple[int, bytes]:
    """Return a frame that some node would take, of a random service."""
    service = rng.randrange(6)
    if service == 0:
        command = START if rng.random() < 0.9 else rng.choice((STOP, PREPARE, RESET_NODE, RESET_COMMUNICATION))
        return 0, bytes((command, rng.choice((0, GYRO, AXIS))))
    if service == 1:
        return rng.choice(((0x80, b""), (0x77F, b"\x05")))
    if service == 2:
        return 0x200 + AXIS, struct.pack(
            "<Hi", rng.choice((0, 2, 6, 7, 15, 15, 31, 31, 0x80)), rng.randrange(-(10**7), 10**7)
        )
    if service == 3:
        return 0x600 + AXIS, struct.pack("<BHBb3x", 0x2F, 0x6060, 0, rng.choice((0, 1, 6)))
    node_id = rng.choice((GYRO, AXIS))
    entry = rng.choice(SHEETS["gyro.eds" if node_id == GYRO else "cia402_stage.eds"][2])
    command = rng.choice((0x40, 0x23, 0x27, 0x2B, 0x2F, 0x20, 0x21, 0x60, 0x70, 0x00, 0x10, 0x01, 0x80))
    return 0x600 + node_id, struct.pack("<BHB", command, entry[0], entry[1]) + rng.choice((bytes(4), rng.randbytes(4)))


def _fuzzed(rng: random.Random) -> tuple[int, bytes]:
    """Return a random frame, a valid one, or one with some bits flipped."""
    if rng.random() < 0.2:
        return rng.randrange(0x800), rng.randbytes(rng.randrange(9))
    identifier, data = _valid(rng)
    if rng.random() < 0.5:
        return identifier, data
    changed = bytearray(data)
    for _ in range(rng.randrange(1, 4)):
        if changed:
            changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return identifier, bytes(changed)


def _without_start(identifier: int, data: bytes) -> bytes:
    """Return `data` without what might be bit 4 of a controlword, wherever that is mapped."""
    if identifier == 0:
        return data
    keep = 0
    if identifier in {0x600 + GYRO, 0x600 + AXIS}:
        keep = 4 if data and data[0] >= 0x20 else 1
    return data[:keep] + bytes(byte & ~0x10 for byte in data[keep:])


def _fuzz(n_frames: int, seed: int, *, starts: bool) -> tuple[int, int, int]:
    """Throw frames at an axis and a gyro; return (bootings, frames while the axis was enabled, drive commands).

    Unless it `starts`, bit 4 of the controlword never comes, so no valid sequence sets the axis in motion.
    """
    rng = random.Random(seed)
    board = FakeStageBoard(30 * 36_000, 0)
    node = AxisNode(board, 0, AXIS)
    host = RawCanHost(GyroNode(FakeGyroBoard(), GYRO), node)
    n_booted = n_enabled = 0
    for number in range(n_frames):
        identifier, data = _fuzzed(rng)
        host.send(identifier, data if starts else _without_start(identifier, data))
        n_enabled += node.dictionary.get(0x604100) & 0x6F == 0x27
        if number % 10 == 0:
            host.run(rng.randrange(5_000))
            for _, heard, told in host.heard:
                assert 0 < heard < 0x800
                assert len(told) <= 8
                n_booted += heard in {0x710, 0x720} and told == b"\x00"
            host.forget()
    return n_booted, n_enabled, len(board.path)


def test_fuzz() -> None:
    """Random and mutated frames raise nothing, and move nothing without a valid sequence; with one they may."""
    n_booted, n_enabled, n_driven = _fuzz(20_000, 1, starts=False)
    assert n_booted > 100  # the frames do reach the nodes
    assert n_enabled > 100  # and nothing but a set-point or homing's start is missing
    assert n_driven == 0
    assert _fuzz(20_000, 1, starts=True)[2] > 0


@pytest.mark.campaign
def test_fuzz_at_length() -> None:
    """The same with a million frames."""
    assert [_fuzz(100_000, seed, starts=False)[2] for seed in range(2, 12)] == [0] * 10
