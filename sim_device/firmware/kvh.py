"""A KVH gyro: it tests itself at power-on, then streams messages; text in configuration mode.

Byte-level facts in ``docs/kvh.md``.
"""

import struct

from sim_device.firmware.crc32 import crc32
from sim_device.firmware.hardware import GyroBoard

START_UP_US = 500_000  # from power-on to the first message
_DATA_RATES = (1, 5, 10, 25, 50, 100, 250, 500, 750, 1000, 3600, 5000)
_RATE_LSB = 3.141592653589793 / 180 / 3600 / 1024  # rad/s
_MAX_LINE = 64
_INVALID_AFTER_CONFIGURATION = 2  # messages


class KvhDevice:
    """A gyro on the line.

    Parameters
    ----------
    board : GyroBoard
        The hardware, or its emulation; of one axis, that is x.
    """

    output_format = "A"  # or B
    rotation_format = "DELTA"  # or RATE
    rotation_units = "RAD"  # or DEG
    temperature_units = "C"  # or C_100, F, F_100
    accelerometers = True
    told_time_us = -1
    testing = False

    def __init__(self, board: GyroBoard) -> None:
        rate = board.sample_rate_millihz // 1000
        if board.sample_rate_millihz % 1000 or rate not in _DATA_RATES:
            raise ValueError(
                "a KVH gyro sends 1, 5, 10, 25, 50, 100, 250, 500, 750, 1000, 3600 or 5000 samples a second"
            )
        self.session = 0
        self.seen_time_us = 0
        self._board = board
        self._rate = rate
        self._batch = max(1, rate // 125)  # messages sent together
        self._line = b""
        self._said = b""  # goes out whole, whether or not there is room
        self._running = False
        self._configuring = False
        self._start_us = START_UP_US
        self._next = 0
        self._sequence = 0
        self._n_invalid = 0

    def feed(self, data: bytes, now_us: int) -> None:
        """Take bytes that have arrived, and act on the lines they complete."""
        self.session = 1
        self.seen_time_us = now_us
        lines = (self._line + data).replace(b"\r", b"\n").split(b"\n")
        self._line = lines.pop()[-_MAX_LINE:]
        for line in lines:
            text = "".join([chr(byte) for byte in line.strip() if 32 <= byte < 127])
            if text:
                self._obey(text.upper(), now_us)

    def poll(self, now_us: int, room: "int | None" = None) -> bytes:
        """Do all that is due and return the bytes to send; messages beyond `room` bytes are lost."""
        if not self._running and not self._configuring and now_us >= self._start_us:
            if self._start_us == START_UP_US:
                self._said += self._test()
            self._running = True
            self._next = 0
            self._board.start_sampling(self._start_us)
        out, self._said = self._said, b""
        while self._running and self._board.sample_time_us(self._next + self._batch - 1) <= now_us:
            for message in self._take_batch():
                if room is None or len(out) + len(message) <= room:
                    out += message
        return out

    def next_due_us(self) -> "int | None":
        """Return when `poll` will have something to do."""
        if self._said:
            return self.seen_time_us
        if self._running:
            return self._board.sample_time_us(self._next + self._batch - 1)
        return None if self._configuring else self._start_us

    # text

    def _obey(self, line: str, now_us: int) -> None:
        if line == "=CONFIG,1" and (self._running or self._configuring):
            if self._running:
                self._board.stop_sampling()
            self._running = False
            self._configuring = True
            self._say("CONFIG,1")
        elif line == "?BIT" and self._running:
            self._said += self._test()
        elif self._configuring and line == "=CONFIG,0":
            self._configuring = False
            self._start_us = now_us
            self._n_invalid = _INVALID_AFTER_CONFIGURATION
        elif self._configuring:
            self._say(self._answer(line))

    def _say(self, text: str) -> None:
        self._said += text.encode() + b"\r\n"

    def _answer(self, line: str) -> str:
        """Return what is said to a command in configuration mode."""
        known = {
            "IS": (self._board.serial_number, ()),
            "DR": (str(self._rate), (str(self._rate),)),
            "OUTPUTFMT": (self.output_format, ("A", "B")),
            "ROTFMT": (self.rotation_format, ("DELTA", "RATE")),
            "ROTUNITS": (self.rotation_units, ("RAD", "DEG")),
            "TEMPUNITS": (self.temperature_units, ("C", "C_100", "F", "F_100")),
        }
        keyword, _, value = line[1:].partition(",")
        if line[0] == "?" and keyword in known and not value:
            return keyword + "," + known[keyword][0]
        if line[0] != "=" or keyword not in known or value not in known[keyword][1]:
            return "INVALID," + line
        if keyword == "OUTPUTFMT":
            self.output_format = value
        elif keyword == "ROTFMT":
            self.rotation_format = value
        elif keyword == "ROTUNITS":
            self.rotation_units = value
        elif keyword == "TEMPUNITS":
            self.temperature_units = value
        return keyword + "," + value

    def _test(self) -> bytes:
        """Return the message of the built-in test."""
        failures = self._board.self_test()
        body = b"\xfe\x81\x00\xaa" + bytes([0x7F & ~(failures & 0x7F), 0x7F & ~(failures >> 7 & 0x7F)]) + b"\x7f" * 4
        return body + bytes([sum(body) & 0xFF])

    # messages

    def _take_batch(self) -> "list[bytes]":
        """Return the messages of the next samples."""
        board, n = self._board, self._batch
        n_axes = board.n_axes
        raw = struct.unpack("<%di" % (n_axes * n), board.read_samples(n))
        scale = _RATE_LSB / self._rate if self.rotation_format == "DELTA" else _RATE_LSB
        if self.rotation_units == "DEG":
            scale *= 180 / 3.141592653589793
        force = (0.0, 0.0, 0.0)
        if self.accelerometers:
            force = tuple([axis * 1e-6 for axis in board.specific_force()])
        valid = self._validity()
        temperature = self._temperature()
        head = b"\xfe\x81\xff\x55" if self.output_format == "A" else b"\xfe\x81\xff\x56"
        messages = []
        for sample in range(n):
            rates = [rate * scale for rate in raw[n_axes * sample : n_axes * (sample + 1)]]
            body = head + struct.pack(">3f", *rates, *[0.0] * (3 - n_axes)) + struct.pack(">3f", *force)
            if self.output_format == "B":
                body += struct.pack(">I", board.sample_time_us(self._next + sample) & 0xFFFFFFFF)
            status = valid
            if self._n_invalid:
                self._n_invalid -= 1
                status &= 0x70
            body += struct.pack(">BBh", status, self._sequence, temperature)
            self._sequence = (self._sequence + 1) & 0x7F
            messages.append(body + struct.pack(">I", crc32(body)))
        self._next += n
        return messages

    def _validity(self) -> int:
        gyros = 0 if self._board.status() & 7 else (1 if self._board.n_axes == 1 else 7)
        return gyros | (0x70 if self.accelerometers else 0)

    def _temperature(self) -> int:
        hundredths = self._board.temperature() * 100 // 256
        if self.temperature_units[0] == "F":
            hundredths = hundredths * 9 // 5 + 3200
        return hundredths if self.temperature_units.endswith("_100") else (hundredths + 50) // 100
