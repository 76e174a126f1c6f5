"""CAN transports: python-can's virtual bus, a socketcand server and an slcan adapter made here. No test sleeps."""

from __future__ import annotations

import os
import random
import re
import select
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count

import can
import pytest
from can.interfaces.virtual import channels
from hypothesis import given
from hypothesis import strategies as st

from drivers.api import EXTENDED_IDENTIFIER, FrameLink
from drivers.canopen.address import parse_node_address
from drivers.errors import LinkError
from drivers.transport.can_address import BusAddress, parse_bus_address
from drivers.transport.can_bus import open_bus
from drivers.transport.can_frames import ERROR, REMOTE, Frame
from drivers.transport.clock import SystemClock
from drivers.transport.slcan import SlcanPort
from drivers.transport.socketcand import SocketcandPort

PATIENCE = 5.0
posix = pytest.mark.skipif(sys.platform == "win32", reason="needs pseudo-terminals")
_channels = count()


# Addresses


@pytest.mark.parametrize(
    ("text", "bus", "nodes"),
    [
        ("slcan:/dev/ttyACM0@1000000/16", BusAddress("slcan", "/dev/ttyACM0", 1_000_000), (16,)),
        ("socketcan:can0@500000/32,33", BusAddress("socketcan", "can0", 500_000), (32, 33)),
        ("socketcand:127.0.0.1:29536:can0@125000/1", BusAddress("socketcand", "127.0.0.1:29536:can0", 125_000), (1,)),
        ("socketcand:[::1]:29536:can0/127", BusAddress("socketcand", "[::1]:29536:can0"), (127,)),
        ("pcan:PCAN_USBBUS1@250000/1,2", BusAddress("pcan", "PCAN_USBBUS1", 250_000), (1, 2)),
        ("virtual:bench/16", BusAddress("virtual", "bench"), (16,)),
    ],
)  # fmt: skip
def test_addresses_of_the_manual(text: str, bus: BusAddress, nodes: tuple[int, ...]) -> None:
    """The address forms of the manual mean what it says."""
    address = parse_node_address(text, len(nodes))
    assert (address.bus, address.nodes) == (bus, nodes)
    assert parse_bus_address(str(bus)) == bus


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("slcan:/dev/ttyACM0@1000000", "names no node"),
        ("slcan:/dev/ttyACM0/16", "says no bit rate: write it like slcan:/dev/ttyACM0@500000"),
        ("slcan:@1000000/16", "names no channel"),
        ("serial:/dev/ttyACM0/16", "names no CAN interface"),
        ("can0/16", "names no CAN interface"),
        ("socketcan:can0/0", "node 0 .* must be from 1 to 127"),
        ("socketcan:can0/128", "node 128 .* must be from 1 to 127"),
        ("socketcan:can0/16,17", "names 2 nodes, this device has 1"),
        ("socketcan:can0@fast/16", "the bit rate 'fast' .* must be a number from 10000 to 1000000"),
        ("socketcan:can0@8000000/16", "the bit rate '8000000'"),
        ("socketcand:127.0.0.1:can0/16", "is no bus of a socketcand server"),
        ("socketcand:127.0.0.1:99999:can0/16", "the port of .* must be from 1 to 65535"),
        ("socketcand:127.0.0.1:29536:can0 >/16", "is no name of a bus"),
        ("", "names no node"),
    ],
)
def test_wrong_addresses_say_what_is_wrong(text: str, complaint: str) -> None:
    """Each kind of mistake has its own sentence."""
    with pytest.raises(ValueError, match=complaint):
        parse_node_address(text, 1)


@given(st.text(alphabet="slcansocketcand:/@,.0123456789virtual[] \n", max_size=40), st.integers(1, 2))
def test_any_text_is_an_address_or_a_value_error(text: str, n_nodes: int) -> None:
    """No text raises anything else, and what is taken can be written and read again."""
    try:
        address = parse_node_address(text, n_nodes)
    except ValueError:
        return
    assert len(address.nodes) == n_nodes
    assert parse_bus_address(str(address.bus)) == address.bus


def test_one_node_twice_is_no_stage() -> None:
    """A stage whose axes are one node is refused."""
    with pytest.raises(ValueError, match="names one node twice"):
        parse_node_address("virtual:bench/32,32", 2)


# A bus that several devices share, on python-can's virtual interface


@pytest.fixture
def peer() -> Iterator[tuple[can.BusABC, BusAddress]]:
    """Make another controller on a new virtual bus."""
    channel = f"transport-{next(_channels)}"
    with can.Bus(channel, interface="virtual") as bus:
        yield bus, BusAddress("virtual", channel)


def collect(link: FrameLink, clock: SystemClock, n: int) -> list[Frame]:
    """Return the next `n` frames."""
    deadline = clock.now() + PATIENCE
    frames = link.receive()
    while len(frames) < n and clock.now() < deadline:
        clock.wait(deadline)
        frames += link.receive()
    return frames


def until_lost(link: FrameLink, clock: SystemClock) -> str:
    """Receive until the link fails, and return what it says."""
    deadline = clock.now() + PATIENCE
    while clock.now() < deadline:
        try:
            link.receive()
        except LinkError as error:
            return str(error)
        clock.wait(clock.now() + 0.05)
    return "never lost"


def test_frames_pass_both_ways(peer: tuple[can.BusABC, BusAddress]) -> None:
    """Identifiers of both lengths and all lengths of data arrive as they were sent, in order."""
    bus, address = peer
    clock = SystemClock()
    link = open_bus(address, clock)
    frames = [(0x190, bytes(range(n))) for n in range(9)] + [(EXTENDED_IDENTIFIER | 0x190, b"x")]
    for identifier, data in frames:
        bus.send(can.Message(arbitration_id=identifier & 0x1FFFFFFF, is_extended_id=identifier >> 31 == 1, data=data))
    assert collect(link, clock, len(frames)) == frames
    link.send(0x210, b"\x01\x02")
    link.send(EXTENDED_IDENTIFIER | 0x12345, b"")
    first, second = bus.recv(PATIENCE), bus.recv(PATIENCE)
    assert first is not None
    assert second is not None
    assert (first.arbitration_id, first.is_extended_id, bytes(first.data)) == (0x210, False, b"\x01\x02")
    assert (second.arbitration_id, second.is_extended_id) == (0x12345, True)
    link.close()


def test_a_bus_is_shared_and_released_with_its_last_link(peer: tuple[can.BusABC, BusAddress]) -> None:
    """Three links are one controller; each gets what it asked for; the last one that closes releases the bus."""
    bus, address = peer
    clock = SystemClock()
    before = len(channels[address.channel])
    links = [open_bus(address, clock, accept=accept) for accept in ([0x190], [0x1A0, 0x1A1], None)]
    assert len(channels[address.channel]) == before + 1
    for identifier in (0x190, 0x1A0, 0x7FF):
        bus.send(can.Message(arbitration_id=identifier, is_extended_id=False))
    assert [identifier for identifier, _ in collect(links[2], clock, 3)] == [0x190, 0x1A0, 0x7FF]
    assert [[identifier for identifier, _ in link.receive()] for link in links[:2]] == [[0x190], [0x1A0]]
    links[0].close()
    links[0].close()
    with pytest.raises(LinkError, match="is closed"):
        links[0].receive()
    bus.send(can.Message(arbitration_id=0x1A1, is_extended_id=False))
    assert collect(links[1], clock, 1) == [(0x1A1, b"")]
    links[1].close()
    links[2].close()
    assert len(channels[address.channel]) == before


def test_one_bus_has_one_bit_rate(peer: tuple[can.BusABC, BusAddress]) -> None:
    """Opening a bus again with another bit rate is an error that names both."""
    link = open_bus(peer[1], SystemClock())
    with pytest.raises(LinkError, match="@500000: this program has it open as virtual:"):
        open_bus(BusAddress("virtual", peer[1].channel, 500_000), SystemClock())
    link.close()


def test_error_and_remote_frames_are_counted_and_are_no_data(peer: tuple[can.BusABC, BusAddress]) -> None:
    """What is no data frame never comes out of `receive`, and is counted."""
    bus, address = peer
    clock = SystemClock()
    link = open_bus(address, clock)
    bus.send(can.Message(arbitration_id=0x190, is_remote_frame=True, is_extended_id=False, dlc=8))
    bus.send(can.Message(arbitration_id=0x8, is_error_frame=True, data=bytes(8)))
    bus.send(can.Message(arbitration_id=0x190, is_extended_id=False, data=b"ok"))
    assert collect(link, clock, 1) == [(0x190, b"ok")]
    counts = link.counts
    assert (counts.n_frames, counts.n_errors, counts.n_remote, counts.identifiers) == (1, 1, 1, frozenset({0x190}))
    link.close()


def test_bus_off_is_a_named_loss_for_every_link(peer: tuple[can.BusABC, BusAddress]) -> None:
    """A controller that has switched itself off is a LinkError of all links, after the frames before; it can reopen."""
    bus, address = peer
    clock = SystemClock()
    links = [open_bus(address, clock) for _ in range(2)]
    bus.send(can.Message(arbitration_id=0x190, is_extended_id=False))
    bus.send(can.Message(arbitration_id=0x40, is_error_frame=True, data=bytes(8)))
    assert collect(links[0], clock, 1) == [(0x190, b"")]
    for link in links:
        assert re.search("off the bus after too many errors", until_lost(link, clock))
        with pytest.raises(LinkError, match="off the bus"):
            link.send(0x200, b"")
    again = open_bus(address, clock)
    bus.send(can.Message(arbitration_id=0x191, is_extended_id=False))
    assert collect(again, clock, 1) == [(0x191, b"")]
    for link in (*links, again):
        link.close()


def test_a_program_that_does_not_read_is_told_so(peer: tuple[can.BusABC, BusAddress]) -> None:
    """Frames beyond the queue's bound are never dropped in silence: the link is lost, with that sentence."""
    bus, address = peer
    clock = SystemClock()
    slow, other = open_bus(address, clock, max_frames=10), open_bus(address, clock, accept=[0x7FF])
    for _ in range(11):
        bus.send(can.Message(arbitration_id=0x190, is_extended_id=False))
    bus.send(can.Message(arbitration_id=0x7FF, is_extended_id=False))
    assert collect(other, clock, 1) == [(0x7FF, b"")]
    assert "has lost frames: 10 waited" in until_lost(slow, clock)
    slow.close()
    other.close()


def test_interfaces_that_are_not_there_say_so() -> None:
    """No such channel, or no driver of the adapter on this machine: one sentence with the address."""
    for address in (
        BusAddress("socketcan", "nocan7"),
        BusAddress("kvaser", "0", 500_000),
        BusAddress("pcan", "X", 500_000),
    ):
        with pytest.raises(LinkError, match=f"cannot open {address}: "):
            open_bus(address, SystemClock())


# socketcand


class FakeServer:
    """A socketcand server for one client: says what it is told, and keeps what it hears."""

    def __init__(self, *answers: bytes) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = BusAddress("socketcand", f"127.0.0.1:{self._listener.getsockname()[1]}:can0")
        self.heard = b""
        self.client: socket.socket | None = None
        self._answers = answers
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        self.client = self._listener.accept()[0]
        for i, answer in enumerate(self._answers):
            if i:
                self.heard += self.client.recv(1000)
            self.client.sendall(answer)

    def say(self, text: bytes) -> None:
        """Say something more."""
        self._thread.join(PATIENCE)
        assert self.client is not None
        self.client.sendall(text)

    def close(self) -> None:
        """Go away."""
        self._thread.join(PATIENCE)
        if self.client is not None:
            self.client.close()
        self._listener.close()


GOOD = (b"< hi >", b"< ok >", b"< ok >< frame 123 1.5 01 >")


def test_a_socketcand_bus() -> None:
    """Frames behind the handshake's last answer are not lost; sending is as the protocol says; errors are counted."""
    server = FakeServer(*GOOD)
    clock = SystemClock()
    link = open_bus(server.address, clock)
    server.say(b"< frame 190 1.0 1F A0 >< frame 1ABCDEF0 2.0  >< error 040008 3.0 >< nonsense >< fra")
    server.say(b"me 7FF 4.000 0001020304050607 >")
    assert collect(link, clock, 4) == [
        (0x123, b"\x01"),
        (0x190, b"\x1f\xa0"),
        (EXTENDED_IDENTIFIER | 0x1ABCDEF0, b""),
        (0x7FF, bytes(range(8))),
    ]
    assert (link.counts.n_errors, link.counts.n_malformed) == (1, 1)
    assert server.client is not None
    link.send(0x190, b"\x1f\xa0")
    link.send(EXTENDED_IDENTIFIER | 0x12345, b"")
    text = b""
    while text.count(b">") < 2:
        text += server.client.recv(100)
    assert text == b"< send 190 2 1F A0 >< send 00012345 0  >"
    server.close()
    assert "was unplugged (the server is gone)" in until_lost(link, clock)
    link.close()


@pytest.mark.parametrize(
    ("answers", "complaint"),
    [
        ((b"HTTP/1.1 400 Bad Request\r\n\r\n>",), "is no socketcand server: it greets with 'HTTP/1.1 400"),
        ((b"< hi >", b"< error could not open bus >"), "answered 'open can0' with 'error could not open bus"),
        ((b"< hi >", b"< ok >", b"< error unknown command >"), "answered 'rawmode' with 'error unknown command"),
    ],
)
def test_a_server_that_refuses(answers: tuple[bytes, ...], complaint: str) -> None:
    """What the server says instead stands in the error."""
    server = FakeServer(*answers)
    with pytest.raises(LinkError, match=re.escape(complaint)):
        open_bus(server.address, SystemClock())
    server.close()


def test_no_server_at_all() -> None:
    """A closed port is said to be one, at once."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with pytest.raises(LinkError, match="no socketcand server listens there"):
        open_bus(BusAddress("socketcand", f"127.0.0.1:{port}:can0"), SystemClock())


# slcan


class FakeAdapter:
    """An slcan adapter on a pseudo-terminal; answers each command from a table, and may say more."""

    def __init__(self, **answers: bytes) -> None:
        import tty  # noqa: PLC0415  # there is none on Windows

        self._master, slave = os.openpty()
        tty.setraw(slave)
        self.address = BusAddress("slcan", os.ttyname(slave), 1_000_000)
        self._slave = slave
        self._answers = {"C": b"\a", "S": b"\r", "O": b"\r", "F": b"F00\r", "t": b"z\r"} | answers
        self.heard: list[bytes] = []
        self.news = threading.Condition()
        self._unplugged = False
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        rest = b""
        while not self._unplugged:
            if not select.select([self._master], [], [], 0.02)[0]:
                continue
            rest += os.read(self._master, 1000)
            *lines, rest = rest.split(b"\r")
            with self.news:
                self.heard += [line for line in lines if line]
                self.news.notify_all()
            for line in lines:
                if line:
                    self.say(self._answers.get(chr(line[0]), b""))

    def say(self, text: bytes) -> None:
        """Say something."""
        os.write(self._master, text)

    def unplug(self) -> None:
        """Pull the cable."""
        if not self._unplugged:
            self._unplugged = True
            self._thread.join(PATIENCE)
            os.close(self._slave)
            os.close(self._master)


@contextmanager
def adapter(**answers: bytes) -> Iterator[FakeAdapter]:
    """Yield an adapter, and unplug it."""
    fake = FakeAdapter(**answers)
    try:
        yield fake
    finally:
        fake.unplug()


@posix
def test_an_slcan_bus() -> None:
    """The channel is closed, set, opened, and asked for its status; frames pass both ways; bad lines are counted."""
    with adapter() as fake:
        clock = SystemClock()
        link = open_bus(fake.address, clock)
        assert fake.heard == [b"C", b"S8", b"O", b"F"]
        fake.say(b"t19021FA0\rT1ABCDEF00\rt7FF8000102030405060")
        fake.say(b"7\rt1902FF\rt19F9000\rt19018812AB\r")  # a lost digit, an impossible length, a time stamp
        assert collect(link, clock, 4) == [
            (0x190, b"\x1f\xa0"),
            (EXTENDED_IDENTIFIER | 0x1ABCDEF0, b""),
            (0x7FF, bytes(range(8))),
            (0x190, b"\x88"),
        ]
        assert link.counts.n_malformed == 2
        link.send(0x210, b"\x0a\xff")
        link.send(EXTENDED_IDENTIFIER | 0x12345, b"")
        with fake.news:
            assert fake.news.wait_for(lambda: b"T000123450" in fake.heard, PATIENCE)
        assert b"t21020AFF" in fake.heard
        link.close()
        with fake.news:
            assert fake.news.wait_for(lambda: fake.heard[-1] == b"C", PATIENCE)


@posix
def test_what_an_slcan_adapter_complains_of_is_counted() -> None:
    """Status flags that tell of errors, and refusals to send, count as error frames."""
    with adapter(F=b"F80\r", t=b"\a") as fake:
        clock = SystemClock()
        link = open_bus(fake.address, clock)
        link.send(0x200, b"")
        deadline = clock.now() + PATIENCE
        while link.counts.n_errors < 3 and clock.now() < deadline:
            link.receive()
            clock.wait(clock.now() + 0.05)
        assert link.counts.n_errors >= 3
        link.close()


@posix
@pytest.mark.parametrize(
    ("answers", "complaint"),
    [
        ({"S": b"\a"}, "the adapter refuses the bit rate 1000000"),
        ({"O": b"\a"}, "the adapter refuses to open its channel"),
        ({"C": b"", "S": b"", "O": b"", "F": b""}, "nothing answers there like an slcan adapter"),
    ],
    ids=["bit rate", "open", "silence"],
)
def test_an_slcan_adapter_that_refuses(answers: dict[str, bytes], complaint: str) -> None:
    """Its refusal, or that nothing answers, is the error."""
    with adapter(**answers) as fake, pytest.raises(LinkError, match=complaint):
        open_bus(fake.address, SystemClock())


def test_slcan_has_its_own_bit_rates() -> None:
    """A bit rate that no such adapter has is refused before the port is touched, with those that it has."""
    with pytest.raises(LinkError, match="an slcan adapter has the bit rates 10000, 20000, 50000"):
        open_bus(BusAddress("slcan", "/dev/none", 333_000), SystemClock())
    with pytest.raises(LinkError, match="there is no such port"):
        open_bus(BusAddress("slcan", "/dev/none", 500_000), SystemClock())


@posix
def test_an_slcan_adapter_can_be_unplugged() -> None:
    """A port that goes is a LinkError, after the frames before it."""
    fake = FakeAdapter()
    clock = SystemClock()
    link = open_bus(fake.address, clock)
    fake.say(b"t1900\r")
    assert collect(link, clock, 1) == [(0x190, b"")]
    fake.unplug()
    assert "was unplugged" in until_lost(link, clock)
    link.close()


# Any chunking, any damage


def _socketcand_text(frame: Frame) -> bytes:
    identifier, data = frame
    name = f"{identifier & 0x1FFFFFFF:08X}" if identifier >> 31 else f"{identifier:03X}"
    return f"< frame {name} 12.345678 {data.hex()} >".encode()


def _slcan_text(frame: Frame) -> bytes:
    identifier, data = frame
    head = f"T{identifier & 0x1FFFFFFF:08X}" if identifier >> 31 else f"t{identifier:03X}"
    return f"{head}{len(data)}{data.hex()}\r".encode()


FRAMES = st.lists(
    st.tuples(
        st.integers(0, 0x7FF) | st.integers(0, 0x1FFFFFFF).map(lambda i: i | EXTENDED_IDENTIFIER), st.binary(max_size=8)
    ),
    max_size=20,
)


def _parse(kind: type[SocketcandPort | SlcanPort], chunks: list[bytes]) -> tuple[list[Frame], int]:
    """Return what a port makes of chunks of text, and how much of it was malformed."""
    port = object.__new__(kind)
    port._rest, port.n_malformed = b"", 0
    frames = []
    for chunk in chunks:
        port._rest += chunk
        frames += port._frames()
    return frames, port.n_malformed


@pytest.mark.parametrize(("kind", "text"), [(SocketcandPort, _socketcand_text), (SlcanPort, _slcan_text)])
@given(frames=FRAMES, size=st.integers(1, 50))
def test_any_chunking_gives_the_same_frames(
    kind: type[SocketcandPort | SlcanPort], text: object, frames: list[Frame], size: int
) -> None:
    """However the text is cut, the frames are those that were sent, and nothing is malformed."""
    assert callable(text)
    stream = b"".join(text(frame) for frame in frames)
    chunks = [stream[i : i + size] for i in range(0, len(stream), size)]
    assert _parse(kind, chunks) == (frames, 0)


@pytest.mark.parametrize("kind", [SocketcandPort, SlcanPort])
@given(stream=st.binary(max_size=400), size=st.integers(1, 50))
def test_any_bytes_are_survived(kind: type[SocketcandPort | SlcanPort], stream: bytes, size: int) -> None:
    """Random bytes raise nothing, and only whole frames of at most eight bytes come out."""
    for identifier, data in _parse(kind, [stream[i : i + size] for i in range(0, len(stream), size)])[0]:
        assert len(data) <= 8
        assert identifier & (ERROR | REMOTE) or identifier <= 0x7FF or identifier & EXTENDED_IDENTIFIER


def test_a_lost_character_costs_its_line_alone() -> None:
    """Of a thousand slcan lines each robbed of one character, no wrong frame comes out, and each is counted."""
    rng = random.Random(1)
    good = (0x190, bytes(range(1, 9)))
    for _ in range(1000):
        line = bytearray(_slcan_text((rng.randrange(0x800), rng.randbytes(rng.randrange(9)))))
        del line[rng.randrange(len(line) - 1)]
        frames, n_malformed = _parse(SlcanPort, [bytes(line), _slcan_text(good)])
        assert frames == [good]
        assert n_malformed == 1
