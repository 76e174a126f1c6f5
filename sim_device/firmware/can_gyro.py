"""The gyro on a CAN bus: configuration and self-test by SDO, the stream of samples by PDO.

See ``docs/canopen.md``, section 3.
"""

import struct

from sim_device.firmware.dictionary import OUT_OF_RANGE, WRONG_STATE, Abort
from sim_device.firmware.gyro_objects import OBJECTS
from sim_device.firmware.hardware import GyroBoard
from sim_device.firmware.node import MANUFACTURER, OPERATIONAL, Node
from sim_device.firmware.objects import PDO_INVALID

SENSOR_FAULT = 0x5030
SAMPLES_LOST = 0x8110

_SENSOR_FAULT = 1 << 2  # status bits
_OVERRUN = 1 << 4
_TIME_PDO, _SLOW_PDO = 2, 3
_SAMPLE_PDOS = (1, 4, 5)
_RATES = (0x210001, 0x210002, 0x210003)
_U24 = 0xFFFFFF


class GyroNode(Node):
    """A gyro on the bus.

    Parameters
    ----------
    board : GyroBoard
        The hardware, or its emulation.
    node_id : int
        1 to 127.

    Attributes
    ----------
    room : int
        Frames that the bus can take now, None for any number; a burst beyond is lost.
    """

    def __init__(self, board: GyroBoard, node_id: int) -> None:
        super().__init__(board, node_id, OBJECTS)
        self.room: "int | None" = None
        self._board: GyroBoard = board
        self._next = 0  # number of the next sample
        self._streaming = False
        self._mark_due = 0  # number of the sample from which on the next time mark is due
        self._n_lost = 0
        self._overrun = 0  # status bit of the next burst
        define = self.dictionary.define
        define(0x201000, board.sample_rate_millihz)
        define(0x201100, board.range_dph)
        define(0x201200, board.n_axes)
        define(0x201300, min(255, max(1, board.sample_rate_millihz // 5000)))
        if board.n_axes == 1:
            for key in (0x180301, 0x180401):
                define(key, self.dictionary.get(key) | PDO_INVALID)
            for pdo in self._transmit:
                pdo.compile()
        self.dictionary.on_write(0x201000, self._set_sample_rate)
        self.dictionary.on_write(0x201300, self._set_burst)
        self.dictionary.on_write(0x202000, self._set_stream)

    @property
    def session(self) -> int:
        """Whether there is a host that reads samples, or waits for a self-test."""
        return int(self._streaming or self.testing)

    @property
    def seen_time_us(self) -> int:
        """Instant of the newest sample that the host says it has read, 0 if none."""
        n_seen = self.dictionary.get(0x211000)
        return self._board.sample_time_us(min(n_seen, self._next) - 1) if n_seen and self._streaming else 0

    # requests

    def _set_sample_rate(self, value: int) -> int:
        if value != self._board.sample_rate_millihz:
            raise Abort(OUT_OF_RANGE)
        return value

    def _set_burst(self, value: int) -> int:
        if self._streaming:
            raise Abort(WRONG_STATE)
        return value

    def _set_stream(self, value: int) -> int:
        if value and not self._streaming:
            if self.state != OPERATIONAL or self.testing:
                raise Abort(WRONG_STATE)
            self._board.start_sampling(self._now_us)
            self._streaming = True
            self._next = self._mark_due = self._n_lost = self._overrun = 0
            for key in (0x210100, 0x210200, 0x210700, 0x211000):
                self.dictionary.put(key, 0)
        elif not value and self._streaming:
            self._flush()
            self._halt()
        return value

    def _flush(self) -> None:
        """Send the samples taken since the last burst."""
        n_left = 0
        while self._board.sample_time_us(self._next + n_left) <= self._now_us:
            n_left += 1
        if n_left:
            self._send_burst(n_left)

    def _halt(self) -> None:
        self._board.stop_sampling()
        self._streaming = False
        self.dictionary.put(0x202000, 0)
        self._recovered(MANUFACTURER)

    def _left_operational(self, _command: int) -> None:
        if self._streaming:
            self._halt()

    def _at_work(self) -> bool:
        return self._streaming

    def _start(self) -> None:
        """Send nothing before the stream has started."""

    # work

    def _due_us(self) -> "int | None":
        if not self._streaming:
            return None
        return self._board.sample_time_us(self._next + self.dictionary.get(0x201300) - 1)

    def _work(self, now_us: int) -> None:
        n = self.dictionary.get(0x201300)
        while self._streaming and self._board.sample_time_us(self._next + n - 1) <= now_us:
            self._send_burst(n)

    def _send_burst(self, n: int) -> None:
        """Send the next `n` samples, or lose them if the bus cannot take them."""
        board, first = self._board, self._next
        rates = struct.unpack("<%di" % (n * board.n_axes), board.read_samples(n))
        self._next += n
        status = board.status() | self._overrun
        if status & _SENSOR_FAULT and not self._register & MANUFACTURER:
            self._emergency(SENSOR_FAULT, MANUFACTURER)
        if self.room is not None and len(self._out) + n * board.n_axes > self.room:
            self._lose(n)
            return
        self._overrun = 0
        if first >= self._mark_due:
            self._mark(first)
        self._send_samples(first, rates, status)

    def _send_samples(self, first: int, rates: tuple[int, ...], status: int) -> None:
        out, axes = self._out, self._board.n_axes
        identifiers = [self._transmit[number - 1].identifier for number in _SAMPLE_PDOS[:axes]]
        pack = struct.pack
        trailer = status << 24
        for offset in range(0, len(rates), axes):
            tail = (first & _U24) | trailer
            for axis in range(axes):
                if identifiers[axis] != -1:
                    out.append((identifiers[axis], pack("<iI", rates[offset + axis], tail)))
            first += 1
        for axis in range(axes):
            self.dictionary.put(_RATES[axis], rates[axis - axes])
        self.dictionary.put(0x210100, (first - 1) & _U24)
        self.dictionary.put(0x210200, status)

    def _mark(self, first: int) -> None:
        """Tell the instant of a sample, and what the slow sensors read."""
        board, put = self._board, self.dictionary.put
        tilt_x, tilt_y = board.tilt()
        put(0x210300, first & _U24)
        put(0x210400, board.sample_time_us(first))
        put(0x210500, board.temperature())
        put(0x210601, tilt_x)
        put(0x210602, tilt_y)
        self._mark_due = first + max(1, self.dictionary.get(0x201400) * board.sample_rate_millihz // 1_000_000)
        for number in (_TIME_PDO, _SLOW_PDO):
            pdo = self._transmit[number - 1]
            pdo.triggered = True
        self._send_triggered()

    def _lose(self, n: int) -> None:
        self._n_lost += n
        self._overrun = _OVERRUN
        self.dictionary.put(0x210700, self._n_lost & 0xFFFFFFFF)
        self._emergency(SAMPLES_LOST)
