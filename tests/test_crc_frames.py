"""Frames of fixed length with a CRC-32: any chunking, junk and damage, for those of the STIM300 and of KVH."""

from __future__ import annotations

import random
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.protocol.crc_frames import CrcFrameDecoder, Frames, checksum

SIZES = {b"\x90": 18, b"\x94": 25, b"\xa5": 42, b"\xbd": 26}
LONG_HEADERS = {b"\xfe\x81\xff\x55": 36, b"\xfe\x81\xff\x56": 40}
END = b"\r\n"

Tried = tuple[dict[bytes, int], bytes]


def frame(header: bytes, size: int, rng: random.Random) -> bytes:
    """Return a good frame with random data."""
    body = header + rng.randbytes(size - 4 - len(header))
    return body + checksum(body).to_bytes(4, "big")


def unpacked(found: list[Frames]) -> list[bytes]:
    """Return the single bodies."""
    return [row.tobytes() for frames in found for row in frames.bodies]


def fed(tried: Tried, wire: bytes, cuts: list[int]) -> tuple[list[bytes], CrcFrameDecoder]:
    """Return what comes out of `wire` cut into chunks, and the decoder."""
    sizes, end = tried
    decoder = CrcFrameDecoder(sizes, terminator=end)
    edges = [0, *sorted(cut % (len(wire) + 1) for cut in cuts), len(wire)]
    found = [frames for begin, stop in pairwise(edges) for frames in decoder.feed(wire[begin:stop])]
    return unpacked(found), decoder


tried_ones = st.sampled_from([(SIZES, b""), (SIZES, END), (LONG_HEADERS, b"")])


@given(tried_ones, st.integers(0, 2**32), st.lists(st.integers(0, 5000), max_size=40))
def test_any_chunking(tried: Tried, seed: int, cuts: list[int]) -> None:
    """What comes out, and what is counted, does not depend on the chunks; every good frame comes out."""
    rng = random.Random(seed)
    sizes, end = tried
    wire, sent, junk = b"", [], 0
    for _ in range(rng.randrange(30)):
        header = rng.choice(list(sizes))
        if rng.random() < 0.3:
            noise = bytes(rng.choice(b"\x00\x11\r\n\xfe\x81\xff") for _ in range(rng.randrange(1, 30)))
            noise = noise if not noise.startswith(b"\r\n") else b"\x00" + noise
            wire, junk = wire + noise, junk + len(noise)
        good = frame(header, sizes[header], rng)
        sent.append(good[:-4])
        wire += good + end
    found, decoder = fed(tried, wire, cuts)
    assert found == sent
    assert decoder.counts.n_frames == len(sent)
    whole = fed(tried, wire, [])[1].counts
    assert decoder.counts == whole
    held = len(decoder._rest)
    assert whole.n_skipped + sum(len(body) + 4 + len(end) for body in sent) in range(len(wire) - held, len(wire) + 1)
    assert junk - 3 <= whole.n_skipped <= junk


@settings(max_examples=200)
@given(tried_ones, st.integers(0, 2**32), st.sampled_from(["flip", "cut", "double", "overwrite", "insert"]))
def test_damage_is_lost_and_counted(tried: Tried, seed: int, kind: str) -> None:
    """Damage costs the frames it hits and no other; nothing that was not sent comes out."""
    rng = random.Random(seed)
    sizes, end = tried
    good = [frame(header, sizes[header], rng) + end for header in rng.choices(list(sizes), k=8)]
    hit = rng.randrange(8)
    place = rng.randrange(len(good[hit]) - len(end))
    before, byte, after = good[hit][:place], good[hit][place], good[hit][place + 1 :]
    damaged = {
        "flip": before + bytes([byte ^ 1 << rng.randrange(8)]) + after,
        "cut": before + after,
        "double": before + bytes([byte, byte]) + after,
        "overwrite": before + rng.randbytes(1) + after,
        "insert": before + rng.randbytes(rng.randrange(1, 50)) + good[hit][place:],
    }[kind]
    wire = b"".join([*good[:hit], damaged, *good[hit + 1 :]]) + bytes(70)
    found, decoder = fed(tried, wire, [rng.randrange(len(wire)) for _ in range(5)])
    sent = [whole[: len(whole) - 4 - len(end)] for whole in good]
    # a repeated byte may leave the frame whole beside it, and an insertion before it does
    missed = [body for body in sent if body not in found]
    assert set(found) <= set(sent)
    assert missed in ([], [sent[hit]])
    assert not missed or decoder.counts.n_skipped > 70 + 9


@pytest.mark.parametrize("size", [18, 25, 42])
def test_every_flip_of_one_or_two_bits_is_caught(size: int) -> None:
    """No frame with one or two flipped bits passes as the frame that was sent or as another."""
    header = next(key for key, value in SIZES.items() if value == size)
    good = frame(header, size, random.Random(size))
    number = int.from_bytes(good, "big")
    n_bits = 8 * size
    decoder = CrcFrameDecoder(SIZES)
    for first in range(n_bits):
        for second in range(first, n_bits):
            bad = number ^ (1 << first) ^ (1 << second if second != first else 0)
            assert not decoder.feed(bad.to_bytes(size, "big") + bytes(64))


def test_garbage() -> None:
    """A megabyte of noise gives no frame, and the decoder holds at most one frame of it; a frame after it is found."""
    decoder = CrcFrameDecoder(SIZES, terminator=END)
    rng = np.random.default_rng(1)
    for _ in range(64):
        assert decoder.feed(rng.bytes(16_384)) == []
        assert len(decoder._rest) <= 44
    good = frame(b"\xa5", 42, random.Random(1))
    assert unpacked(decoder.feed(bytes(64) + good)) == [good[:-4]]


def test_a_checksum_cut_short_would_be_noticed() -> None:
    """With half of the checksum looked at, noise passes about as often as it must: the search for errors has power."""
    rng = np.random.default_rng(2)
    sent = rng.bytes(16_384 * 24)
    passed = sum(
        checksum(sent[i : i + 14]) >> 22 == int.from_bytes(sent[i + 14 : i + 16], "big") >> 6
        for i in range(0, len(sent) - 18, 12)
    )
    expected = len(sent) / 12 / 2**10
    assert abs(passed - expected) < 5 * expected**0.5


def test_runs_come_out_together() -> None:
    """Equal frames one after the other come out as one array, ended by CR LF or not."""
    rng = random.Random(3)
    for end in (b"", END):
        wire = b"".join(frame(b"\xa5", 42, rng) + end for _ in range(500))
        decoder = CrcFrameDecoder(SIZES, terminator=END)
        assert [len(frames.bodies) for frames in decoder.feed(wire)] == [500]
        assert decoder.counts.n_skipped == 0
