"""Frames: whatever the line does, what comes out was sent, and what did not is counted."""

from __future__ import annotations

import random
from itertools import pairwise

import pytest
from cobs import cobs
from golden import GOLDEN, Golden
from hypothesis import example, given
from hypothesis import strategies as st

from drivers.protocol.framing import MAX_BODY, MAX_FRAME, FrameCounts, FrameDecoder, _unstuff, encode_frame

BODIES = st.lists(
    st.one_of(
        st.binary(min_size=1, max_size=MAX_BODY),
        st.integers(1, MAX_BODY).map(lambda size: b"\xa5" * size),  # no 00 for COBS to break up
        st.integers(1, MAX_BODY).map(bytes),
    ),
    max_size=5,
)


def cut(data: bytes, cuts: list[int]) -> list[bytes]:
    """Cut `data` at the given places, modulo its length."""
    places = sorted({place % (len(data) + 1) for place in cuts} | {0, len(data)})
    return [data[start:stop] for start, stop in pairwise(places)]


def decode(chunks: list[bytes]) -> tuple[list[bytes], FrameCounts]:
    """Feed chunks to a new decoder."""
    decoder = FrameDecoder()
    return [body for chunk in chunks for body in decoder.feed(chunk)], decoder.counts


@given(BODIES)
def test_what_is_encoded_comes_back(bodies: list[bytes]) -> None:
    """Every body arrives, whole and in order, and nothing is counted as lost."""
    found, counts = decode([b"".join(map(encode_frame, bodies))])
    assert found == bodies
    assert counts == FrameCounts(n_frames=len(bodies))


@given(st.binary(max_size=3 * MAX_FRAME), BODIES, st.binary(max_size=40), st.lists(st.integers(0, 5000), max_size=12))
def test_any_chunking_gives_the_same(junk: bytes, bodies: list[bytes], tail: bytes, cuts: list[int]) -> None:
    """Bodies and counters depend on the bytes alone, byte by byte, at once, or cut anywhere."""
    data = junk + b"".join(map(encode_frame, bodies)) + tail
    whole = decode([data])
    assert decode(cut(data, cuts)) == whole
    assert decode([data[i : i + 1] for i in range(len(data))]) == whole


@given(st.binary(max_size=2 * MAX_FRAME), BODIES)
def test_junk_costs_no_frame_behind_a_delimiter(junk: bytes, bodies: list[bytes]) -> None:
    """After junk and one 00 every frame is found, and every byte of the junk is accounted for."""
    found, counts = decode([junk + b"\0" + b"".join(map(encode_frame, bodies))])
    assert found == bodies
    assert counts.n_skipped == len(junk.replace(b"\0", b""))


@given(st.one_of(st.binary(min_size=1, max_size=2 * MAX_FRAME), st.binary(max_size=MAX_FRAME).map(cobs.encode)))
@example(b"\xff" + b"\x01" * 254)
@example(b"\xff" + b"\x02" * 255)
@example(b"\x01")
def test_unstuffing_agrees_with_the_package(run: bytes) -> None:
    """Every run is undone as the cobs package does it, or is as impossible to both."""
    run = run.replace(b"\0", b"\1")
    try:
        expected = cobs.decode(run)
    except cobs.DecodeError:
        expected = b""
    assert _unstuff(run) == expected


@pytest.mark.parametrize("golden", GOLDEN, ids=lambda golden: golden.name)
def test_every_bit_flip_is_caught(golden: Golden) -> None:
    """No frame of any type with one or two bits flipped is ever taken for another; the next frame is found."""
    frame = golden.frame
    marker = b"next frame"
    n_bits = 8 * len(frame)
    rng = random.Random(1)
    patterns = [(bit,) for bit in range(n_bits)] + [tuple(rng.sample(range(n_bits), 2)) for _ in range(2000)]
    for bits in patterns:
        damaged = bytearray(frame)
        for bit in bits:
            damaged[bit // 8] ^= 1 << bit % 8
        found, counts = decode([bytes(damaged) + b"\0" + encode_frame(marker)])
        assert found == [marker], f"bits {bits}"
        assert counts.n_bad_cobs + counts.n_bad_crc >= 1


def test_without_the_crc_flips_would_pass() -> None:
    """The flip test has the power to fail: most single flips pass COBS, and the CRC alone catches them."""
    frame = GOLDEN[-1].frame
    damaged = [
        bytes([*frame[:i], frame[i] ^ 1 << bit, *frame[i + 1 : -1]]) for i in range(len(frame) - 1) for bit in range(8)
    ]
    passed = [run for run in damaged if 0 not in run and _unstuff(run)]
    counts = decode([run + b"\0" for run in passed])[1]
    assert len(passed) > len(damaged) / 2
    assert counts.n_bad_crc == len(passed)


def test_a_run_without_end_is_dropped_and_costs_no_memory() -> None:
    """A megabyte without 00 is counted once; at most one frame's bytes are ever held; then frames are found again."""
    decoder = FrameDecoder()
    for _ in range(1000):
        assert decoder.feed(b"\x55" * 1000) == []
        assert len(decoder._rest) <= MAX_FRAME
    assert decoder.feed(b"\0" + encode_frame(b"good")) == [b"good"]
    assert decoder.counts == FrameCounts(n_frames=1, n_too_long=1, n_skipped=1_000_000)


def test_the_longest_frame_passes_and_one_byte_more_does_not() -> None:
    """A body of 512 bytes fits in 519 bytes and a delimiter."""
    longest = encode_frame(b"\xa5" * MAX_BODY)
    assert len(longest) == MAX_FRAME + 1
    assert decode([longest])[0] == [b"\xa5" * MAX_BODY]
    assert decode([b"\xa5" + longest]) == ([], FrameCounts(n_too_long=1, n_skipped=MAX_FRAME + 1))


@pytest.mark.parametrize("size", [0, MAX_BODY + 1])
def test_impossible_bodies_are_refused(size: int) -> None:
    """A caller learns at once that a body is empty or too long."""
    with pytest.raises(ValueError, match=f"{size} bytes"):
        encode_frame(bytes(size))


def test_empty_frames_are_no_error() -> None:
    """Delimiters alone count as nothing."""
    assert decode([b"\0\0\0" + encode_frame(b"x") + b"\0"]) == ([b"x"], FrameCounts(n_frames=1))
