"""Epson's bursts and commands: golden bytes typed by hand, cut, damaged and among junk."""

from __future__ import annotations

import random
import struct
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.protocol.crc_frames import CrcFrameCounts
from drivers.protocol.epson import (
    BURST_SIZE,
    MODELS,
    BurstDecoder,
    CounterCheck,
    filter_code,
    read_command,
    records,
    select_window,
    text_of,
    write_command,
)

G370 = MODELS["G370PDS0"]
#: Flags; 25 C; 41,073 steps (0.0041782 deg/s), -1, 2; 0, 0, 2,500 x 65,536 steps (1 g); counter 258; the sum.
GOLDEN = bytes.fromhex("80 FE00 0A4A0000 0000A071 FFFFFFFF 00000002 00000000 00000000 09C40000 0102 B381 0D")
#: The same sample in 16 bits: of the earth's rotation nothing is left.
GOLDEN_16 = bytes.fromhex("80 FE00 0A4A 0000 FFFF 0000 0000 0000 09C4 0102 130F 0D")


def burst(counter: int = 0, rate: tuple[int, int, int] = (1, -2, 3), *, flags: int = 0xFE00, raw: int = 2634) -> bytes:
    """Return a burst with a right sum."""
    body = struct.pack(">Hi3i3iH", flags, raw << 16, *rate, 0, 0, 2500 << 16, counter & 0xFFFF)
    total = sum(struct.unpack(f">{len(body) // 2}H", body)) & 0xFFFF
    return b"\x80" + body + struct.pack(">HB", total, 0x0D)


def decoded(chunks: list[bytes]) -> tuple[list[int], CrcFrameCounts]:
    """Return the counters of the bursts in some chunks, and what was counted."""
    decoder = BurstDecoder(G370)
    found = [count for chunk in chunks for frames in decoder.feed(chunk) for count in records([frames])["counter"]]
    return [int(count) for count in found], decoder.counts


def cut(data: bytes, places: list[int]) -> list[bytes]:
    """Return `data` cut at some places."""
    return [data[a:b] for a, b in pairwise([0, *sorted(place % (len(data) + 1) for place in places), len(data)])]


def test_golden_burst() -> None:
    """The burst typed by hand says what it shall, in physical units."""
    (frames,) = BurstDecoder(G370).feed(GOLDEN)
    (found,) = records([frames])
    assert (found["flags"], found["counter"]) == (0xFE00, 258)
    assert found["rate"].tolist() == [41073, -1, 2]
    assert found["rate"][0] * np.degrees(G370.rate_lsb) == pytest.approx(0.0041782, abs=1e-7)
    assert found["acceleration"][2] * G370.acceleration_lsb == pytest.approx(1.0)
    assert G370.celsius(found["temperature"]) == pytest.approx(25.0)
    (frames,) = BurstDecoder(G370, 16).feed(GOLDEN_16)
    assert records([frames])["rate"].tolist() == [[0, -1, 0]]


def test_commands() -> None:
    """Commands are three bytes, reads at even addresses, writes with the highest bit."""
    assert read_command(0x4C) == b"\x4c\x00\r"
    assert write_command(0x03, 0x01) == b"\x83\x01\r"
    assert select_window(1) == b"\xfe\x01\r"
    assert text_of([0x4953, 0x2D4D, 0x1B47, 0]) == "SIM-G?"


def test_filters_reach_over_a_sample_period() -> None:
    """The moving average of the 2,000 Hz inside lasts as long as a sample period, or longer."""
    for rate in (2000.0, 1000.0, 400.0, 125.0, 80.0, 15.625):
        assert 2 ** filter_code(rate) / 2000 >= 1 / rate


@given(st.lists(st.integers(0, 999), max_size=12), st.integers(0, 40), st.binary(max_size=90))
def test_chunks_do_not_matter(places: list[int], n: int, junk: bytes) -> None:
    """However the bytes come, with junk between, what is found and counted is the same."""
    data = b"".join(burst(i) for i in range(n)) + junk + burst(n) + burst(n + 1)
    assert decoded(cut(data, places)) == decoded([data])
    assert decoded([data])[0][:n] == list(range(n))


@given(st.binary(max_size=200))
def test_found_again_after_junk(junk: bytes) -> None:
    """After any junk all but the first few bursts are found, and every byte is counted as one or the other."""
    data = junk + b"".join(burst(i) for i in range(20))
    found, counts = decoded([data])
    assert found[-14:] == list(range(6, 20))
    assert 0 <= len(data) - counts.n_frames * BURST_SIZE[32] - counts.n_skipped < BURST_SIZE[32]


@given(st.integers(0, 36 * 8 - 1), st.integers(0, 60_000))
def test_every_flipped_bit_is_caught(bit: int, counter: int) -> None:
    """Of three bursts the one with a flipped bit is lost, never altered."""
    wire = bytearray(b"".join(burst(counter + i, (i, 5, -7)) for i in range(3)))
    wire[36 + bit // 8] ^= 1 << bit % 8
    assert decoded([bytes(wire)])[0] == [counter, counter + 2]


@given(st.integers(1, 35), st.integers(0, 35))
def test_truncated_bursts_are_lost(n: int, start: int) -> None:
    """A burst that misses bytes anywhere is lost, and those around it are found."""
    middle = burst(8)
    wire = burst(7) + middle[:start] + middle[start + n :] + b"".join(burst(i) for i in range(9, 14))
    found, _ = decoded([wire])
    assert found[0] == 7
    assert 8 not in found
    assert found[-3:] == [11, 12, 13]


@pytest.mark.parametrize(
    "bad", [burst(1, flags=0x7E00), burst(1, flags=0xF000), burst(1, raw=-30_000), burst(1, raw=32_767)]
)
def test_impossible_bursts_are_refused(bad: bytes) -> None:
    """A right sum is not enough: every value must be new, and the temperature one that the sensor stands."""
    assert decoded([burst(0) + bad + burst(2)])[0] == [0, 2]


def test_damage_that_the_sum_lets_through() -> None:
    """Of random bursts with a right sum the seven flags let one in 128 pass, and the temperature fewer."""
    rng = random.Random(1)
    bodies = [rng.randbytes(32) for _ in range(8_000)]
    wire = b"".join(
        b"\x80" + body + struct.pack(">HB", sum(struct.unpack(">16H", body)) & 0xFFFF, 0x0D)[-3:] for body in bodies
    )
    found, counts = decoded([wire])
    assert counts.n_frames == len(found) < 8_000 * 2**-7 * 1.5


def test_a_counter_must_be_confirmed() -> None:
    """A burst whose counter fits neither neighbour is dropped; a true gap, which the next burst confirms, is not."""

    def confirmed(counters: list[int], *, batch: int) -> tuple[list[int], int]:
        check, out = CounterCheck(), []
        for first in range(0, len(counters), batch):
            (frames,) = BurstDecoder(G370).feed(b"".join(burst(c) for c in counters[first : first + batch]))
            out += check.confirm(records([frames]))["counter"].tolist()
        return out, check.n_dropped

    for batch in (1, 2, 3, 10):
        assert confirmed([5, 6, 7, 900, 9, 10], batch=batch) == ([5, 6, 7, 9, 10], 1)
        assert confirmed([5, 6, 7, 900, 901, 902], batch=batch) == ([5, 6, 7, 900, 901, 902], 0)
        assert confirmed([65_534, 65_535, 0, 1], batch=batch) == ([65_534, 65_535, 0, 1], 0)
        assert confirmed([5, 6, 9, 12, 13, 14], batch=batch) == ([5, 6, 9, 12, 13, 14], 0)
