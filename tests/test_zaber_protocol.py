"""The Zaber ASCII protocol's lines, typed by hand, whole, cut, damaged and among junk; and the emulator's own codec."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.protocol.zaber import (
    MAX_LINE,
    REJECTIONS,
    WARNINGS,
    Alert,
    LineDecoder,
    Reply,
    checksum,
    encode_command,
    integers,
)
from sim_device.firmware.zaber import checksum as firmware_checksum

#: Lines typed by hand, their sums added up apart from any codec here, and what they say.
GOLDEN = [
    (
        b"@01 1 19 OK BUSY -- 100000:EC\r\n",
        Reply(device=1, axis=1, message_id=19, accepted=True, busy=True, warning="", data="100000", summed=True),
    ),
    (
        b"@01 0 OK IDLE WR 0\r\n",
        Reply(device=1, axis=0, message_id=None, accepted=True, busy=False, warning="WR", data="0", summed=False),
    ),
    (
        b"@12 2 07 RJ IDLE FS BADDATA:10\r\n",
        Reply(device=12, axis=2, message_id=7, accepted=False, busy=False, warning="FS", data="BADDATA", summed=True),
    ),
    (b"!01 1 IDLE --:96\r\n", Alert(device=1, axis=1, busy=False, warning="", data="", summed=True)),
]
LINES = [line for line, _ in GOLDEN]


def decoded(chunks: list[bytes]) -> tuple[list[Reply | Alert], object]:
    """Return what a new decoder makes of some chunks, and its counters."""
    decoder = LineDecoder()
    return [message for chunk in chunks for message in decoder.feed(chunk)], decoder.counts


def cut(data: bytes, places: list[int]) -> list[bytes]:
    """Return `data` cut at some places."""
    edges = [0, *sorted(place % (len(data) + 1) for place in places), len(data)]
    return [data[a:b] for a, b in pairwise(edges)]


@pytest.mark.parametrize(("line", "message"), GOLDEN, ids=[line.decode().strip() for line in LINES])
def test_golden_lines(line: bytes, message: Reply | Alert) -> None:
    """Each line typed by hand says what it shall."""
    assert decoded([line])[0] == [message]


def test_golden_commands() -> None:
    """Commands are the very bytes that an independent client has sent."""
    assert encode_command("get pos", device=1, axis=1, message_id=0) == b"/1 1 00 get pos:2C\n"
    assert encode_command("move abs 100000", device=1, axis=1, message_id=19) == b"/1 1 19 move abs 100000:86\n"


@pytest.mark.parametrize("command", ["get pos\n", "a:b", "é", "\x1b[2J"])
def test_a_command_cannot_hold_another_one(command: str) -> None:
    """What would end the line or begin its sum is refused."""
    with pytest.raises(ValueError, match="is no command"):
        encode_command(command)
    with pytest.raises(ValueError, match="no device 100"):
        encode_command("home", device=100)


@given(st.lists(st.sampled_from(LINES), max_size=6), st.lists(st.integers(0, 500), max_size=8))
def test_chunks_do_not_matter(lines: list[bytes], places: list[int]) -> None:
    """However the bytes come, the messages and the counters are the same."""
    data = b"".join(lines)
    assert decoded(cut(data, places)) == decoded([data])
    assert len(decoded([data])[0]) == len(lines)


@given(st.binary(max_size=600), st.lists(st.integers(0, 700), max_size=5))
def test_junk_before_and_after(junk: bytes, places: list[int]) -> None:
    """Whatever comes before, the next whole line after a line's end is heard."""
    data = junk + b"\r\n" + LINES[0] + junk
    messages, counts = decoded(cut(data, places))
    assert GOLDEN[0][1] in messages
    assert (messages, counts) == decoded([data])


@given(st.sampled_from([line for line in LINES if b":" in line]), st.integers(0, 1000))
def test_every_flipped_bit_is_caught(line: bytes, place: int) -> None:
    """A summed line with any one bit flipped says nothing, or (its colon gone) no number that a question asks for."""
    place %= 8 * (len(line) - 2)
    damaged = bytearray(line)
    damaged[place // 8] ^= 1 << place % 8
    decoder = LineDecoder()
    decoder.require_sum = True
    assert decoder.feed(bytes(damaged)) == []
    free, _ = decoded([bytes(damaged)])
    assert all(not message.summed and integers(message.data, 1) is None for message in free)


@given(st.sampled_from(LINES), st.integers(1, 40))
def test_truncated_lines_say_nothing(line: bytes, n: int) -> None:
    """A line that lost its end runs into the next one; once a sum is asked for neither is taken for a message."""
    decoder = LineDecoder()
    decoder.require_sum = True
    short = line[: max(1, len(line) - 2 - n)]
    assert [message for message in decoder.feed(short + b"\r\n") if message.summed] == []


def test_memory_is_bounded() -> None:
    """A line without end is given up, counted once, and the next one is heard."""
    decoder = LineDecoder()
    for _ in range(1000):
        assert decoder.feed(b"x" * 100) == []
        assert len(decoder._rest) <= MAX_LINE
    assert decoder.feed(b"\r\n" + LINES[0]) == [GOLDEN[0][1]]
    assert decoder.counts.n_malformed == 1


def test_what_is_counted() -> None:
    """Good lines, information, wrong sums and other text are counted apart."""
    decoder = LineDecoder()
    decoder.feed(LINES[0] + b"#01 0 Visit a page\r\n" + LINES[0].replace(b"EC", b"ED") + b"login:\r\n")
    counts = decoder.counts
    assert (counts.n_lines, counts.n_information, counts.n_bad_sum, counts.n_malformed) == (1, 1, 1, 1)


@given(st.binary(max_size=80))
def test_two_codecs_agree_on_the_sum(text: bytes) -> None:
    """Driver and emulator compute the same sum, and it brings the bytes to 0."""
    assert checksum(text) == firmware_checksum(text)
    assert (sum(text) + checksum(text)) % 256 == 0


def test_flags_and_rejections_are_words() -> None:
    """Every flag has two capital letters and a meaning, every rejection a sentence."""
    assert all(len(flag) == 2 and flag[0] in "FWN" and meaning for flag, meaning in WARNINGS.items())
    assert len(set(REJECTIONS.values())) == len(REJECTIONS)
