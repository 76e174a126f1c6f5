"""Frames of the device's side, against the independent packages cobs and fastcrc."""

import re
from pathlib import Path

from fake_host import decodes, frame
from fastcrc import crc32
from golden import GOLDEN
from hypothesis import given
from hypothesis import strategies as st

from sim_device.firmware import framing, session

PROTOCOL = (Path(__file__).parent.parent / "docs" / "protocol.md").read_text()

#: Bytes with many zeros, and runs about the 254 that a COBS group holds.
awkward = st.one_of(
    st.binary(max_size=520),
    st.lists(st.sampled_from([b"\x00", b"\x01", b"\xff", b"x" * 253, b"y" * 254, b"z" * 255]), max_size=8).map(
        b"".join
    ),
)
bodies = st.binary(min_size=1, max_size=512)


def _blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PROTOCOL, re.DOTALL)


def test_golden_frames_are_those_of_the_document() -> None:
    """The typed frames and the document's are the same, in the same order."""
    assert [golden.frame for golden in GOLDEN] == [
        bytes.fromhex(block.replace("\n", "")) for block in _blocks("golden")
    ]


def test_definition_hash_is_that_of_the_document() -> None:
    """The firmware stands for the definition that the document prints."""
    (definition,) = _blocks("definition")
    assert framing.crc32c(definition.encode()) == session.DEFINITION_HASH == 0x66B325A6


def test_crc_check_value() -> None:
    """The check value of CRC-32C is E3069283."""
    assert framing.crc32c(b"123456789") == 0xE3069283


@given(awkward)
def test_crc_agrees_with_peer(data: bytes) -> None:
    """Our CRC is that of the fastcrc package."""
    assert framing.crc32c(data) == crc32.iscsi(data)


@given(awkward)
def test_cobs_agrees_with_peer(data: bytes) -> None:
    """What we encode the cobs package decodes, and the other way round, byte for byte."""
    encoded = framing.cobs_encode(data)
    assert b"\x00" not in encoded
    assert decodes(encoded) == data
    assert framing.cobs_decode(encoded) == data


@given(bodies)
def test_frame_agrees_with_peer(body: bytes) -> None:
    """A whole frame is the one that the packages make."""
    assert framing.frame(body) == frame(body)
    assert len(framing.frame(body)) <= 520


@given(st.binary(max_size=600).map(lambda data: data.replace(b"\x00", b"\x07")))
def test_malformed_cobs_is_refused_as_by_peer(data: bytes) -> None:
    """Any bytes without zero decode as in the cobs package, or are refused by both."""
    assert framing.cobs_decode(data) == decodes(data)


def test_zero_in_cobs_is_refused() -> None:
    """A zero length byte, which no line can deliver, does not hang the decoder."""
    assert framing.cobs_decode(b"\x02x\x00") is None


@given(st.lists(bodies, max_size=6), st.data())
def test_any_chunking(sent: list[bytes], data: st.DataObject) -> None:
    """However the bytes are cut, the same bodies come out and nothing is counted as lost."""
    line = b"\x00".join(map(framing.frame, sent))
    cuts = data.draw(st.lists(st.integers(0, len(line)), max_size=20).map(sorted))
    reader = framing.FrameReader()
    got = [
        body for start, end in zip([0, *cuts], [*cuts, len(line)], strict=True) for body in reader.feed(line[start:end])
    ]
    assert got == sent
    assert reader.n_dropped == 0


@given(bodies, st.data())
def test_flipped_bit_is_lost_and_counted(body: bytes, data: st.DataObject) -> None:
    """One flipped bit costs the frame, is counted, and leaves its neighbours whole."""
    damaged = bytearray(framing.frame(body))
    bit = data.draw(st.integers(0, 8 * (len(damaged) - 1) - 1))
    damaged[bit // 8] ^= 1 << bit % 8
    reader = framing.FrameReader()
    assert reader.feed(framing.frame(b"before") + damaged + b"\x00" + framing.frame(b"after")) == [b"before", b"after"]
    assert 1 <= reader.n_dropped <= 2


@given(st.binary(max_size=3000), bodies)
def test_resynchronises_after_junk(junk: bytes, body: bytes) -> None:
    """After any junk and a zero the next frame is read."""
    reader = framing.FrameReader()
    assert reader.feed(junk + b"\x00" + framing.frame(body))[-1] == body


def test_overlong_run_is_dropped_once() -> None:
    """A run longer than any frame is one lost frame, fed at once or byte by byte, and takes no room."""
    reader = framing.FrameReader()
    for _ in range(10_000):
        reader.feed(b"\x01")
        assert len(reader._partial) <= framing.MAX_ENCODED
    assert reader.feed(b"\x00" + framing.frame(b"ok")) == [b"ok"]
    assert reader.n_dropped == 1


def test_longest_body_passes() -> None:
    """The receiver has room for a frame of 520 bytes."""
    body = b"\x55" * 512
    reader = framing.FrameReader()
    assert len(framing.frame(body)) == 520
    assert reader.feed(framing.frame(body)) == [body]


def test_truncated_frame_is_counted() -> None:
    """A frame of which only the CRC is left has no body."""
    reader = framing.FrameReader()
    assert reader.feed(framing.frame(b"")) == []
    assert reader.n_dropped == 1
