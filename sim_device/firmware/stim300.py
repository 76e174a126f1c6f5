"""An STIM300: it says who it is at power-on, then streams datagrams of rate, acceleration and temperature.

Byte-level facts in ``docs/stim300.md``. What the board samples is the mean rate over a sample interval: there is no
filter, so the outputs rate and average rate are the same numbers.
"""

import struct

from sim_device.firmware.crc32 import crc32
from sim_device.firmware.hardware import GyroBoard
from sim_device.firmware.stim300_utility import UtilityMode

START_UP_US = 300_000  # from power-on to the first datagram
ANSWER_US = 200  # from a command to its datagram in the place of a sample, at least
_LATENCY_US = 500
_SAMPLE_RATES = (125, 250, 500, 1000, 2000)  # by their codes
_COUNTS_PER_LSB = 225  # 2^-14 deg/s in 2^-10 deg/h
_TURN = 1 << 24
_MAX_LINE = 64

RATE, INCREMENT, AVERAGE, INTEGRAL = range(4)
ACCELERATION, INCLINATION, TEMPERATURE, PPS = 1, 2, 4, 8


def _i24(value: int) -> bytes:
    return (min(max(value, -0x800000), 0x7FFFFF) & 0xFFFFFF).to_bytes(3, "big")


class Stim300Device:
    """An STIM300 on the line.

    Parameters
    ----------
    board : GyroBoard
        The hardware, or its emulation: three axes at one of the unit's sample rates.
    """

    clusters = ACCELERATION | TEMPERATURE
    output = RATE
    terminated = False  # whether CR LF ends each datagram
    old_ids = False  # of a unit with AUX instead of PPS
    told_time_us = -1
    testing = False

    def __init__(self, board: GyroBoard) -> None:
        rate = board.sample_rate_millihz // 1000
        if board.n_axes != 3 or board.sample_rate_millihz % 1000 or rate not in _SAMPLE_RATES:
            raise ValueError("an STIM300 has three axes and samples at 125, 250, 500, 1000 or 2000 Hz")
        self.session = 0
        self.seen_time_us = 0
        self._board = board
        self._rate = rate
        self.bit_rate_code = 1 if rate <= 500 else 2  # 460800 or 921600
        self._batch = rate // 125  # samples sent together
        self._line = b""
        self._answers: list = []  # type: ignore[type-arg]  # datagrams that take the place of samples
        self._said: list = []  # type: ignore[type-arg]  # what goes out whole, whether or not there is room
        self._utility = None  # type: UtilityMode | None
        self._next = 0
        self._carried = [0, 0, 0]  # parts of a count that increments have not yet said
        self._integral = [0, 0, 0]
        self._reset(0)

    def feed(self, data: bytes, now_us: int) -> None:
        """Take bytes that have arrived, and act on the lines they complete."""
        self.session = 1
        self.seen_time_us = now_us
        lines = (self._line + data).split(b"\r")
        self._line = lines.pop()[-_MAX_LINE:]
        for line in lines:
            self._obey(line.strip(), now_us)

    def poll(self, now_us: int, room: "int | None" = None) -> bytes:
        """Do all that is due and return the bytes to send; datagrams beyond `room` bytes are lost."""
        if not self._running and self._utility is None and now_us >= self._start_us:
            self._begin()
        out = b"".join(self._said)
        self._said = []
        while self._running and self._board.sample_time_us(self._next + self._batch - 1) <= now_us:
            for datagram in self._take_batch():
                if room is None or len(out) + len(datagram) <= room:
                    out += datagram
        return out

    def next_due_us(self) -> "int | None":
        """Return when `poll` will have something to do."""
        if self._said:
            return self.seen_time_us
        if self._running:
            return self._board.sample_time_us(self._next + self._batch - 1)
        return None if self._utility is not None else self._start_us

    # modes

    def _reset(self, now_us: int) -> None:
        """Start up; say who it is when that is over."""
        self._running = False
        self._start_us = now_us + START_UP_US
        self._introduce = True

    def _begin(self) -> None:
        """Enter normal mode."""
        if self._introduce:
            self._said += [self._part_number(), self._serial_number(), self._configuration()]
        self._introduce = False
        self._running = True
        self._next = 0
        self._board.start_sampling(self._start_us)

    def _obey(self, line: bytes, now_us: int) -> None:
        if self._utility is not None:
            self._said.append(self._utility.answer(line))
            if self._utility.left:
                self._utility = None
                self._start_us = now_us
            return
        if not self._running:
            return
        makers = {
            b"N": self._part_number,
            b"I": self._serial_number,
            b"C": self._configuration,
            b"T": self._bias_trim,
            b"E": self._extended_error,
        }
        if line in makers:
            self._answers.append(makers[line]())
        elif line == b"R":
            self._board.stop_sampling()
            self._reset(now_us)
        elif line == b"UTILITYMODE":
            self._board.stop_sampling()
            self._running = False
            self._utility = UtilityMode(self, self._board.serial_number)
            self._said.append(self._utility.greeting())

    def set_sample_rate(self, code: int) -> bool:
        """Return whether the unit samples at that rate: this one at the board's alone."""
        return 0 <= code < 5 and _SAMPLE_RATES[code] == self._rate

    # datagrams

    def _datagram(self, body: bytes) -> bytes:
        crc = crc32(body + bytes(-len(body) % 4))
        return body + crc.to_bytes(4, "big") + (b"\r\n" if self.terminated else b"")

    def _take_batch(self) -> list:  # type: ignore[type-arg]
        """Return the datagrams of the next samples, or what takes their place."""
        board, n = self._board, self._batch
        raw = struct.unpack("<%di" % (3 * n), board.read_samples(n))
        slow = self._slow_clusters()
        status = self._status()
        datagrams = []
        for sample in range(n):
            rates = self._scaled(raw[3 * sample : 3 * sample + 3])
            counter = (self._next + sample) * (2000 // self._rate) & 0xFF
            if self._answers:
                datagrams.append(self._answers.pop(0))
                continue
            body = self._head + _i24(rates[0]) + _i24(rates[1]) + _i24(rates[2]) + status
            datagrams.append(self._datagram(body + slow + struct.pack(">BH", counter, _LATENCY_US)))
        self._next += n
        return datagrams

    def _scaled(self, rates: tuple) -> "list[int]":  # type: ignore[type-arg]
        """Return board counts in counts of the output that is set."""
        if self.output in (RATE, AVERAGE):
            return [(rate + _COUNTS_PER_LSB // 2) // _COUNTS_PER_LSB for rate in rates]
        increments = []
        divisor = 3600 * self._rate  # 2^-10 deg/h for a sample interval, in 2^-21 deg: 2048 / (3600 rate)
        for axis in range(3):
            whole, self._carried[axis] = divmod(self._carried[axis] + 2048 * rates[axis], divisor)
            increments.append(whole)
        if self.output == INCREMENT:
            return increments
        for axis in range(3):
            total = (self._integral[axis] + increments[axis]) % _TURN
            self._integral[axis] = total
            increments[axis] = total - _TURN if total >= _TURN // 2 else total
        return increments

    def _slow_clusters(self) -> bytes:
        """Return all between the rates and the counter; the same for the samples of a batch."""
        x, y, z = self._board.specific_force()
        out = b""
        if self.clusters & ACCELERATION:
            out += b"".join([_i24((force << 19) // 1_000_000) for force in (x, y, z)]) + b"\0"
        if self.clusters & INCLINATION:
            out += b"".join([_i24((force << 22) // 1_000_000) for force in (x, y, z)]) + b"\0"
        if self.clusters & TEMPERATURE:
            triple = struct.pack(">hhhB", *[self._board.temperature()] * 3, 0)
            out += triple * (1 + (self.clusters & 1) + (self.clusters >> 1 & 1))
        if self.clusters & PPS:
            out += b"\0\0\0\0"
        return out

    def _status(self) -> bytes:
        flags = self._board.status()
        byte = (0x40 if flags & 1 else 0) | (0x17 if flags & 2 else 0) | (0x0F if flags & 4 else 0)
        return bytes([byte])

    @property
    def _head(self) -> bytes:
        return bytes([self._identifier()])

    def _identifier(self) -> int:
        three = self.clusters & 7
        plain = (0x90 if three <= 4 else 0xA0) + three
        if self.clusters & PPS:
            return plain + 8 if self.old_ids else 0xF0 + three
        return plain

    def _part_number(self) -> bytes:
        body = b"\x08\x63\x06\x2d\x84\x16\x71\x2d\x23\x40\x01\x00\x00\x00A"  # 86306-841671-1234 rev A
        return self._datagram(bytes([0xB1 + 2 * self.terminated]) + body)

    def _serial_number(self) -> bytes:
        digits = "".join([c for c in self._board.serial_number if c.isdigit()])
        digits = ("0" * 14 + digits)[-14:]
        body = b"N" + bytes([int(digits[i : i + 2], 16) for i in range(0, 14, 2)]) + bytes(7)
        return self._datagram(bytes([0xB5 + 2 * self.terminated]) + body)

    def _configuration(self) -> bytes:
        body = bytearray(22)
        body[0] = 0xBC + self.terminated
        body[1] = ord("A")
        body[2] = 31
        body[3] = _SAMPLE_RATES.index(self._rate) << 5 | self.clusters << 1 | self.terminated
        body[4] = self.bit_rate_code << 4
        body[5] = 0x70 | self.output
        body[6] = 0x44  # filters of 262 Hz
        body[7] = 0x40
        body[8] = body[11] = 0x70
        body[14] = 0 if self.old_ids else 8
        return self._datagram(bytes(body))

    def _bias_trim(self) -> bytes:
        return self._datagram(bytes([0xD1 + self.terminated]) + bytes(35))

    def _extended_error(self) -> bytes:
        failures = self._board.self_test()
        bits = (1 if failures & 1 else 0) << 56 | (1 if failures & 2 else 0) << 17 | (1 if failures & 4 else 0) << 101
        bits |= (1 if failures & 8 else 0) << 97
        return self._datagram(bytes([0xBE + self.terminated]) + bits.to_bytes(16, "big"))
