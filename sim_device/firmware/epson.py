"""An Epson M-G370 on a UART, as a function of time: registers, modes, and bursts. See ``docs/epson.md``.

The unit averages and thins out the board's samples to the rate that it is set to; it takes the rates that divide the
board's. Integers only.
"""

import struct

from sim_device.firmware.hardware import GyroBoard

PRODUCT = b"G370PDS0"
_DELIMITER = 0x0D
_RATES_MILLIHZ = (
    2000000, 1000000, 500000, 250000, 125000, 62500, 31250, 15625,
    400000, 200000, 100000, 80000, 50000, 40000, 25000, 20000,
)  # fmt: skip
_BATCHES_MILLIHZ = 31250  # above, several samples are read at a time
_SELF_TEST = 0x04  # of the high byte of MSC_CTRL
_RESET = 0x80  # of the low byte of GLOB_CMD
_I32 = 0x7FFFFFFF

# registers that can be written, as the address of their low byte in window 1; the high byte is at the next one
_SIG_CTRL, _MSC_CTRL, _SMPL_CTRL, _FILTER_CTRL, _UART_CTRL, _BURST_CTRL1, _BURST_CTRL2 = 0, 2, 4, 6, 8, 12, 14
_DEFAULTS = {_SIG_CTRL: 0xFE00, _MSC_CTRL: 0x0006, _SMPL_CTRL: 0x0403, _FILTER_CTRL: 0x0003, _UART_CTRL: 0x0000,
             _BURST_CTRL1: 0xF006, _BURST_CTRL2: 0x0000, 0x10: 0, 0x12: 0x00CC, 0x14: 0, 0x16: 0}  # fmt: skip


def _clipped(value: int) -> int:
    return max(-_I32 - 1, min(value, _I32))


class EpsonDevice:
    """The unit on its line.

    Attributes
    ----------
    session : int
        1 once a host has said something.
    seen_time_us : int
        When it last did.

    Parameters
    ----------
    board : GyroBoard
        The hardware, or its emulation.
    """

    told_time_us = -1

    def __init__(self, board: GyroBoard) -> None:
        self.session = 0
        self.seen_time_us = 0
        self.testing = False
        self._board = board
        self._in = b""
        self._out = b""
        self._window = 0
        self._sampling = False
        self._counter = 0
        self._next = 0  # the board's sample that comes next
        self._thinned = 1  # how many of these go into one of the unit's
        self._per_batch = 1  # how many of the unit's samples are made at a time
        self._newest = b""  # the last burst
        self._test_due_us = 0
        self._diagnosis = 0
        self._registers = dict(_DEFAULTS)

    def feed(self, data: bytes, now_us: int) -> None:
        """Take bytes that have arrived, and act on the commands they complete."""
        self.session = 1
        self.seen_time_us = now_us
        self._finish_test(now_us)
        self._in += data
        while len(self._in) >= 3:
            if self._in[2] != _DELIMITER:
                self._in = self._in[1:]
                continue
            command, value = self._in[0], self._in[1]
            self._in = self._in[3:]
            if command == 0x80 and self._sampling:
                self._out += self._newest
            elif command & 0x80:
                self._write(command & 0x7F, value, now_us)
            elif not (self._sampling and self._registers[_UART_CTRL] & 1):
                self._out += bytes((command,)) + struct.pack(">HB", self._read(command & 0x7E), _DELIMITER)

    def poll(self, now_us: int, room: "int | None" = None) -> bytes:
        """Do what is due and return the bytes to send: of bursts at most `room` bytes, beyond which they are lost."""
        self._finish_test(now_us)
        while self._sampling and self._batch_due_us() <= now_us:
            for burst in self._take_batch():
                self._newest = burst
                if self._registers[_UART_CTRL] & 1 and (room is None or len(self._out) + len(burst) <= room):
                    self._out += burst
        out, self._out = self._out, b""
        return out

    def next_due_us(self) -> "int | None":
        """Return when `poll` will have something to do, None if not before something is fed."""
        if self._sampling:
            return self._batch_due_us()
        return self._test_due_us if self.testing else None

    # registers

    def _read(self, address: int) -> int:
        if address == 0x7E:
            return self._window
        if self._window == 0:
            return {0x02: 0 if self._sampling else 0x0400, 0x04: self._diagnosis, 0x4C: 0x5345}.get(address, 0)
        if 0x6A <= address <= 0x70:
            return self._word(PRODUCT, address - 0x6A)
        if address == 0x72:
            return 0x0127
        if 0x74 <= address <= 0x7A:
            return self._word(self._board.serial_number.encode()[-8:], address - 0x74)
        return self._registers.get(address, 0)

    @staticmethod
    def _word(text: bytes, place: int) -> int:
        pair = (text + bytes(8))[place : place + 2]
        return pair[0] | pair[1] << 8

    def _write(self, address: int, value: int, now_us: int) -> None:
        if address == 0x7E:
            self._window = value & 1
        elif self._window == 0:
            if address == 0x03 and value in (1, 2):
                self._change_mode(value == 1, now_us)
        elif not self._sampling:
            self._set(address, value, now_us)

    def _set(self, address: int, value: int, now_us: int) -> None:
        """Write a byte of window 1."""
        register, high = address & 0x7E, address & 1
        if register == 0x0A and not high and value & _RESET:
            self._registers = dict(_DEFAULTS)
        if register not in self._registers or (register == _SMPL_CTRL and high and not self._thinning(value)):
            return
        if register == _MSC_CTRL and high and value & _SELF_TEST:
            self.testing = True
            self._test_due_us = now_us + self._board.self_test_us()
        if register == _FILTER_CTRL and not high:
            value &= 0x1F
        kept = self._registers[register]
        self._registers[register] = kept & 0x00FF | value << 8 if high else kept & 0xFF00 | value

    def _thinning(self, code: int) -> int:
        """Return how many of the board's samples go into one, 0 if the rate of that code cannot be had."""
        if code >= len(_RATES_MILLIHZ):
            return 0
        rate, board = _RATES_MILLIHZ[code], self._board.sample_rate_millihz
        return board // rate if board >= rate and board % rate == 0 else 0

    def _finish_test(self, now_us: int) -> None:
        if self.testing and self._test_due_us <= now_us:
            self.testing = False
            self._registers[_MSC_CTRL] &= ~(_SELF_TEST << 8)
            failures = self._board.self_test()
            self._diagnosis = 0x7800 if failures else 0

    # sampling

    def _change_mode(self, sampling: bool, now_us: int) -> None:  # noqa: FBT001  # MicroPython calls with names are slow
        if sampling and not self._sampling:
            rate = self._board.sample_rate_millihz
            self._thinned = self._thinning(self._registers[_SMPL_CTRL] >> 8) or max(1, rate // 125000)
            self._per_batch = max(1, rate // self._thinned // _BATCHES_MILLIHZ)
            self._board.start_sampling(now_us)
            self._next = 0
        elif self._sampling and not sampling:
            self._board.stop_sampling()
        self._sampling = sampling
        self.testing = self.testing and not sampling

    def _batch_due_us(self) -> int:
        return self._board.sample_time_us(self._next + self._thinned * self._per_batch - 1)

    def _take_batch(self) -> list:  # type: ignore[type-arg]  # MicroPython has no list[bytes]
        """Return the bursts of the next samples."""
        board = self._board
        thinning, n = self._thinned, self._per_batch
        axes = board.n_axes
        samples = struct.unpack("<%di" % (axes * thinning * n), board.read_samples(thinning * n))
        self._next += thinning * n
        temperature = 2634 * 65536 - (board.temperature() - 6400) * 2560000000 // 37918
        force = [_clipped(micro_g * 16384 // 100) for micro_g in board.specific_force()]
        status = board.status()
        flags = self._registers[_SIG_CTRL] & 0xFE00 | (1 if status & 4 else 0)
        bursts = []
        for first in range(0, axes * thinning * n, axes * thinning):
            one = samples[first : first + axes * thinning]
            # 2^-10 deg/h is 8/3 of 1/150/65536 deg/s
            rates = [_clipped(sum(one[axis::axes]) * 8 // (3 * thinning)) for axis in range(axes)]
            bursts.append(self._burst(flags, temperature, rates + [0] * (3 - axes), force))
            self._counter = self._counter + 1 & 0xFFFF
        return bursts

    def _burst(self, flags: int, temperature: int, rates: list, force: list) -> bytes:  # type: ignore[type-arg]  # as above
        """Return a burst with the fields that are asked for."""
        fields, widths = self._registers[_BURST_CTRL1], self._registers[_BURST_CTRL2]
        body = struct.pack(">H", flags) if fields & 0x8000 else b""
        for bit, values in ((0x4000, [temperature]), (0x2000, rates), (0x1000, force)):
            if fields & bit:
                for value in values:
                    body += struct.pack(">i", value) if widths & bit else struct.pack(">h", value >> 16)
        if fields & 0x0004:
            body += b"\0\0"
        if fields & 0x0002:
            body += struct.pack(">H", self._counter)
        if fields & 0x0001:
            body += struct.pack(">H", sum(struct.unpack(">%dH" % (len(body) // 2), body)) & 0xFFFF)
        return b"\x80" + body + b"\r"
