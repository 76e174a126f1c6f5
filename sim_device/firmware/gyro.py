"""The gyro's firmware: configuration, self-test and the stream of sample blocks.

See ``docs/protocol.md`` sections 3 and 4.
"""

import struct

from sim_device.firmware.device import Device
from sim_device.firmware.framing import frame
from sim_device.firmware.hardware import GyroBoard
from sim_device.firmware.session import (
    ACK,
    CLEAR_FAULT,
    GET_CONFIG,
    GYRO,
    GYRO_CONFIG,
    NOT_READY,
    OUT_OF_RANGE,
    SELF_TEST,
    SET_CONFIG_GYRO,
    STREAM_START,
    STREAM_STOP,
    STREAMING,
    UNKNOWN_REQUEST,
    error,
)

_OVERRUN = 1 << 4  # status bit
_MAX_BLOCK = {1: 119, 3: 39}  # samples, by number of axes


class GyroDevice(Device):
    """A gyro on the line.

    Parameters
    ----------
    board : GyroBoard
        The hardware, or its emulation.
    """

    def __init__(self, board: GyroBoard) -> None:
        super().__init__(board, GYRO)
        self._board: GyroBoard = board
        # about 0.2 s of samples
        self._block_samples = min(max(1, board.sample_rate_millihz // 5000), _MAX_BLOCK[board.n_axes])
        self._streaming = False
        self._next_index = 0
        self._n_overruns = 0
        self._overrun = 0  # status bit of the next block
        self._handlers = {
            GET_CONFIG: self._get_config,
            SET_CONFIG_GYRO: self._set_config,
            SELF_TEST: self._start_self_test,
            CLEAR_FAULT: self._clear_fault,
            STREAM_START: self._start_stream,
            STREAM_STOP: self._stop_stream,
        }

    def _execute(self, kind: int, payload: bytes, now_us: int) -> "tuple[int, bytes] | None":
        handler = self._handlers.get(kind)
        return error(UNKNOWN_REQUEST) if handler is None else handler(payload, now_us)

    def poll(self, now_us: int, room: "int | None" = None) -> bytes:
        """Do all that is due and return the bytes to send; at most `room` bytes, beyond which sample blocks are lost.

        Replies are never lost.
        """
        self._finish_self_test(now_us)
        self._send_due_blocks(now_us, room)
        return self._session.take()

    def next_due_us(self) -> "int | None":
        """Return when `poll` will have something to do, None if not before something is fed."""
        due = self._reply_due_us()
        if due is None and self._streaming:
            return self._board.sample_time_us(self._next_index + self._block_samples - 1)
        return due

    # requests

    def _get_config(self, _payload: bytes, _now_us: int) -> "tuple[int, bytes] | None":
        board = self._board
        config = (board.sample_rate_millihz, board.range_dph, board.n_axes, self._block_samples, 0)
        return (GYRO_CONFIG, struct.pack("<IIBBH", *config))

    def _set_config(self, payload: bytes, now_us: int) -> "tuple[int, bytes] | None":
        sample_rate_millihz, _, _, block_samples, _ = struct.unpack("<IIBBH", payload)
        if self._streaming:
            return error(STREAMING)
        if sample_rate_millihz not in {0, self._board.sample_rate_millihz}:
            return error(OUT_OF_RANGE, 9)
        if block_samples > _MAX_BLOCK[self._board.n_axes]:
            return error(OUT_OF_RANGE, 18)
        self._block_samples = block_samples or self._block_samples
        return self._get_config(payload, now_us)

    def _clear_fault(self, _payload: bytes, _now_us: int) -> "tuple[int, bytes] | None":
        return ACK  # a gyro latches none

    def _start_stream(self, _payload: bytes, now_us: int) -> "tuple[int, bytes] | None":
        if self.testing:
            return error(NOT_READY)
        if not self._streaming:
            self._board.start_sampling(now_us)
            self._streaming = True
            self._next_index = self._n_overruns = self._overrun = 0
        return ACK

    def _stop_stream(self, _payload: bytes, now_us: int) -> "tuple[int, bytes] | None":
        if self._streaming:
            self._send_due_blocks(now_us, None)
            n_left = 0
            while self._board.sample_time_us(self._next_index + n_left) <= now_us:
                n_left += 1
            if n_left:
                self._session.send(self._take_block(n_left))
            self._halt_stream()
        return ACK

    # work

    def _reset(self, _now_us: int) -> None:
        if self._streaming:
            self._halt_stream()

    def _halt_stream(self) -> None:
        self._board.stop_sampling()
        self._streaming = False

    def _at_work(self) -> int:
        return STREAMING if self._streaming else 0

    def _send_due_blocks(self, now_us: int, room: "int | None") -> None:
        """Send each block whose last sample has been taken, or count its samples as lost if there is no room."""
        n = self._block_samples
        while self._streaming and self._board.sample_time_us(self._next_index + n - 1) <= now_us:
            block = self._take_block(n)
            if room is None or self._session.n_waiting + len(block) <= room:
                self._session.send(block)
                self._overrun = 0
            else:
                self._n_overruns += n
                self._overrun = _OVERRUN

    def _take_block(self, n: int) -> bytes:
        """Return the frame of the next `n` samples."""
        board = self._board
        index = self._next_index
        self._next_index += n
        rate = board.read_samples(n)
        tilt_x, tilt_y = board.tilt()
        head = struct.pack(
            "<BBBBIIQHhIii",
            0x40,
            board.n_axes,
            n,
            0,
            self._session.number,
            index & 0xFFFFFFFF,
            board.sample_time_us(index),
            board.status() | self._overrun,
            board.temperature(),
            self._n_overruns & 0xFFFFFFFF,
            tilt_x,
            tilt_y,
        )
        return frame(head + rate)
