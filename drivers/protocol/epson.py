r"""Epson's inertial sensors M-G3xx on a UART: registers, and bursts of samples.

    ADDR 00 0D           read the register at an even address, answered by ADDR HIGH LOW 0D
    ADDR|80 VALUE 0D     write one byte, not answered
    FE WINDOW 0D         choose the window of registers that the next commands are for

A burst with the fields that this driver asks for, of 36 bytes with 32-bit fields, of 22 with 16-bit ones; big-endian:

    80 | flags u16 | temperature i32 | rate 3 x i32 | acceleration 3 x i32 | counter u16 | sum u16 | 0D

``sum`` is that of the 16-bit words between 80 and itself. Every single flipped bit is caught, but 1 in 65,536 damaged
bursts would pass. So the fixed bytes must be right, the flags must say that every value is new, and the temperature
must be one that the sensor can stand; a jump of the counter is believed only if the next burst goes on from it.

>>> read_command(0x4C).hex(), write_command(0x03, 2).hex(), select_window(1).hex()
('4c000d', '83020d', 'fe010d')
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import radians
from typing import Any

import numpy as np
from construct import Array, Const, Int8ub, Int16sb, Int16ub, Int32sb, Struct
from numpy.typing import NDArray

from drivers.protocol.crc_frames import CrcFrameCounts, Frames
from drivers.protocol.layout import numpy_dtype
from drivers.protocol.text import printable

HEADER = b"\x80"
DELIMITER = 0x0D
ID_VALUE = 0x5345

# registers: (window, address)
MODE_CTRL = (0, 0x02)
DIAG_STAT = (0, 0x04)
ID = (0, 0x4C)
SIG_CTRL = (1, 0x00)
MSC_CTRL = (1, 0x02)
SMPL_CTRL = (1, 0x04)
FILTER_CTRL = (1, 0x06)
UART_CTRL = (1, 0x08)
GLOB_CMD = (1, 0x0A)
BURST_CTRL1 = (1, 0x0C)
BURST_CTRL2 = (1, 0x0E)
PROD_ID = tuple((1, address) for address in (0x6A, 0x6C, 0x6E, 0x70))
VERSION = (1, 0x72)
SERIAL_NUM = tuple((1, address) for address in (0x74, 0x76, 0x78, 0x7A))

SAMPLING, CONFIGURING = 1, 2  #: written to the high byte of MODE_CTRL
IN_CONFIGURATION = 0x0400  #: of MODE_CTRL
NOT_READY = 0x0400  #: of GLOB_CMD
FILTER_BUSY = 0x0020  #: of FILTER_CTRL
SELF_TEST = 0x0400  #: of MSC_CTRL
HARDWARE_ERRORS = 0x0060  #: of DIAG_STAT
SELF_TEST_ERRORS = {0x4000: "gyro x", 0x2000: "gyro y", 0x1000: "gyro z", 0x0800: "accelerometers"}

ALL_NEW = 0xFE00  #: flags: temperature, rates and accelerations are new
ERROR = 0x0001  #: flag: one of the sensor's diagnoses has failed

#: Code of each sample rate, Hz, in SMPL_CTRL.
RATE_CODES = {
    2000.0: 0, 1000.0: 1, 500.0: 2, 250.0: 3, 125.0: 4, 62.5: 5, 31.25: 6, 15.625: 7,
    400.0: 8, 200.0: 9, 100.0: 10, 80.0: 11, 50.0: 12, 40.0: 13, 25.0: 14, 20.0: 15,
}  # fmt: skip
_INTERNAL_RATE = 2000.0  # Hz, of the moving averages
_FINE = 65_536  # steps of a 32-bit field in one of a 16-bit field


@dataclass(frozen=True, slots=True)
class Model:
    """What the numbers of a model mean; for one step of a 16-bit field."""

    rate_lsb_deg: float  #: deg/s
    acceleration_lsb_mg: float
    temperature_lsb: float  #: degrees Celsius
    temperature_at_25: int

    @property
    def rate_lsb(self) -> float:
        """rad/s in one step of a 32-bit field."""
        return radians(self.rate_lsb_deg) / _FINE

    @property
    def acceleration_lsb(self) -> float:
        """Standard gravities in one step of a 32-bit field."""
        return self.acceleration_lsb_mg * 1e-3 / _FINE

    def celsius(self, raw: float) -> float:
        """Return the temperature of a 32-bit field."""
        return (raw / _FINE - self.temperature_at_25) * self.temperature_lsb + 25.0

    def temperature_range(self) -> tuple[int, int]:
        """Return the 32-bit fields of -60 and 110 degrees Celsius, the lesser first."""
        lowest, highest = sorted(self.temperature_at_25 + (degree - 25) / self.temperature_lsb for degree in (-60, 110))
        return int(max(lowest, -32768) * _FINE), int(min(highest, 32767) * _FINE)


_OLD: tuple[float, int] = (-0.0037918, 2634)
_NEW: tuple[float, int] = (1 / 256, 0)
#: Scales by product id.
MODELS = {
    "G320PDG0": Model(1 / 125, 1 / 5, *_OLD),
    "G354PDH0": Model(1 / 62.5, 1 / 5, *_OLD),
    "G355QDG0": Model(1 / 66, 1 / 4, *_NEW),
    "G364PDC0": Model(0.0075, 1 / 8, *_OLD),
    "G364PDCA": Model(0.00375, 1 / 8, *_OLD),
    "G365PDC1": Model(1 / 66, 1 / 6.25, *_OLD),
    "G365PDF1": Model(1 / 66, 1 / 2.5, *_OLD),
    "G366PDG0": Model(1 / 66, 1 / 4, *_NEW),
    "G370PDF1": Model(1 / 66, 1 / 2.5, *_OLD),
    "G370PDG0": Model(1 / 66, 1 / 4, *_NEW),
    "G370PDS0": Model(1 / 150, 1 / 2.5, *_OLD),
    "G370PDT0": Model(1 / 150, 1 / 4, *_NEW),
}


def _layout(number: Any) -> Struct:  # noqa: ANN401  # construct's fields have no type
    return Struct(
        "header" / Const(HEADER[0], Int8ub),
        "flags" / Int16ub,
        "temperature" / number,
        "rate" / Array(3, number),
        "acceleration" / Array(3, number),
        "counter" / Int16ub,
        "sum" / Int16ub,
        "delimiter" / Const(DELIMITER, Int8ub),
    )


#: The one declaration of a burst, by bits of its fields.
BURSTS = {16: _layout(Int16sb), 32: _layout(Int32sb)}
_DTYPES = {bits: numpy_dtype(layout) for bits, layout in BURSTS.items()}
BURST_SIZE = {bits: dtype.itemsize for bits, dtype in _DTYPES.items()}
#: Values of BURST_CTRL1, and of the high byte of BURST_CTRL2 by bits, that ask for this burst.
BURST_FIELDS = 0xF003
BURST_WIDTHS = {16: 0x00, 32: 0x70}


def read_command(address: int) -> bytes:
    """Return the command that reads the register at an even address of the window chosen."""
    return bytes((address & 0x7E, 0, DELIMITER))


def write_command(address: int, value: int) -> bytes:
    """Return the command that writes one byte: the low one of a register at its address, the high one at that + 1."""
    return bytes((address & 0x7F | 0x80, value, DELIMITER))


def select_window(window: int) -> bytes:
    """Return the command that chooses a window."""
    return write_command(0x7E, window)


def text_of(words: list[int]) -> str:
    """Return the text that registers hold, the low byte of each first; other characters become ``?``.

    >>> text_of([0x3347, 0x3037, 0x4450, 0x3053])
    'G370PDS0'
    """
    data = b"".join(word.to_bytes(2, "little") for word in words)
    return printable(data.rstrip(b"\0")).strip()


def filter_code(sample_rate: float) -> int:
    """Return the code in FILTER_CTRL of the moving average that reaches over at least one sample period.

    >>> filter_code(125.0), filter_code(2000.0)
    (4, 0)
    """
    taps = _INTERNAL_RATE / sample_rate
    return next(code for code in range(8) if 2**code >= taps)


class BurstDecoder:
    """Turns any chunks of a byte stream into good bursts.

    What comes out, and what is counted, depends on the bytes alone and not on how they were cut into chunks, but for
    the number of `Frames` it comes in. After any fault the first whole burst is found again. Between calls at most one
    burst is held.

    Parameters
    ----------
    model
        Whose temperatures are possible ones.
    bits
        Of the fields, 16 or 32.
    """

    def __init__(self, model: Model, bits: int = 32) -> None:
        self._dtype = _DTYPES[bits]
        self._size = self._dtype.itemsize
        self._weights = np.zeros(self._size, np.float32)  # of the bytes in the sum
        self._weights[1 : self._size - 3] = [256, 1] * ((self._size - 4) // 2)
        coldest, hottest = model.temperature_range()
        self._temperatures = (coldest, hottest) if bits == 32 else (coldest // _FINE, hottest // _FINE)
        self._counts = CrcFrameCounts()
        self._in_step = True  # whether the last place tried held a burst
        self._rest = b""

    @property
    def counts(self) -> CrcFrameCounts:
        """A copy of the counters; a burst that cannot be one counts as one with a wrong sum."""
        return replace(self._counts)

    def feed(self, data: bytes) -> list[Frames]:
        """Return the good bursts that `data` completes, oldest first; `records` reads them."""
        buffer, position = self._rest + data, 0
        found = []
        while (start := buffer.find(HEADER, position)) >= 0:
            self._counts.n_skipped += start - position
            position = start
            if len(buffer) - position < self._size:
                break
            rows = self._good_run(buffer, position)
            if len(rows):
                self._counts.n_frames += len(rows)
                found.append(Frames(HEADER, rows.copy()))
                position += len(rows) * self._size
            else:
                self._counts.n_bad_crc += 1
                self._counts.n_skipped += 1
                position += 1
        else:
            self._counts.n_skipped += len(buffer) - position
            position = len(buffer)
        self._rest = buffer[position:]
        return found

    def _good_run(self, buffer: bytes, start: int) -> NDArray[np.uint8]:
        """Return the good bursts that stand one after the other from `start` on, shape (n, size)."""
        if buffer[start + self._size - 1] != DELIMITER:
            return np.empty((0, self._size), np.uint8)
        n = (len(buffer) - start) // self._size if self._in_step else 1  # among junk a look costs little
        rows = np.ndarray((n, self._size), np.uint8, buffer, start)
        good = self._check(rows)
        self._in_step = bool(good[0])
        return rows if good.all() else rows[: int(good.argmin())]

    def _check(self, rows: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Return which rows are bursts."""
        bursts = rows.view(self._dtype)[:, 0]
        sums = (rows @ self._weights).astype(np.uint32) & 0xFFFF  # exact: below 2^24
        good: NDArray[np.bool_] = (bursts["sum"] == sums) & (bursts["header"] == HEADER[0])
        good &= bursts["delimiter"] == DELIMITER
        good &= bursts["flags"] & ALL_NEW == ALL_NEW
        coldest, hottest = self._temperatures
        return good & (bursts["temperature"] >= coldest) & (bursts["temperature"] <= hottest)


def records(frames: list[Frames]) -> NDArray[np.void]:
    """Return bursts as records with the fields of the layout, shape (n,)."""
    rows = np.concatenate([run.bodies for run in frames]) if len(frames) > 1 else frames[0].bodies
    bits = next(bits for bits, size in BURST_SIZE.items() if size == rows.shape[1])
    found: NDArray[np.void] = rows.view(_DTYPES[bits])[:, 0]
    return found


class CounterCheck:
    """Lets through bursts whose counter goes on, and jumps of it that the next burst confirms.

    A burst that fits neither the one before nor the one after, while these fit each other, is damaged, its sum or no.
    """

    def __init__(self) -> None:
        self._last: int | None = None  # counter of the last burst let through
        self._held: NDArray[np.void] | None = None  # a burst with a jump, of which it is not known yet
        self.n_dropped = 0

    def confirm(self, bursts: NDArray[np.void], *, final: bool = False) -> NDArray[np.void]:
        """Return what of the bursts held and of `bursts` is good; the last one is held if its counter jumps."""
        if self._held is not None:
            bursts = np.concatenate([self._held, bursts])
            self._held = None
        if not len(bursts):
            return bursts
        counters = bursts["counter"].astype(np.int64)
        before = counters[0] - 1 if self._last is None else self._last
        rises = np.diff(counters, prepend=before) % _FINE
        after = np.append(rises[1:], 1)
        impostors = (rises != 1) & (after != 1) & ((rises + after) % _FINE == 2)
        confirmed = rises[-1] == 1 or (len(rises) > 1 and impostors[-2])
        if not confirmed and not final:
            self._held, bursts, impostors = bursts[-1:].copy(), bursts[:-1], impostors[:-1]
        self.n_dropped += int(impostors.sum())
        bursts = bursts[~impostors]
        if len(bursts):
            self._last = int(bursts["counter"][-1])
        return bursts
