"""What both devices do alike: take requests from the line, run the self-test, tell when they have something to do."""

import struct

from sim_device.firmware.hardware import Board
from sim_device.firmware.session import HELLO, NOT_READY, SELF_TEST_RESULT, Session, error


class Device:
    """A device on the line, as a function of time: `feed`, `poll`, `next_due_us`.

    Parameters
    ----------
    board : Board
        The hardware, or its emulation.
    kind : int
        GYRO or STAGE.
    """

    told_time_us = -1  # device time of the newest status that the host has to acknowledge

    def __init__(self, board: Board, kind: int) -> None:
        self._board = board
        self._session = Session(board, kind)
        self._fed_us = 0
        self._test_due_us = 0
        self._test_request = 0  # number of the SELF_TEST that runs
        self.testing = False  # whether a self-test is under way

    @property
    def session(self) -> int:
        """Number of the open session, 0 if none."""
        return self._session.number

    @property
    def seen_time_us(self) -> int:
        """Newest device time that the host has read in the open session, 0 if none."""
        return self._session.seen_time_us

    @property
    def n_dropped(self) -> int:
        """Received frames that were dropped."""
        return self._session.n_dropped

    def feed(self, data: bytes, now_us: int) -> None:
        """Take bytes that have arrived, and act on the frames they complete."""
        self._fed_us = now_us
        for body in self._session.read(data):
            request = self._session.accept(body, now_us)
            if request is None:
                continue
            kind, payload = request
            if kind == HELLO:
                self.testing = False
                self._reset(now_us)
            else:
                reply = self._execute(kind, payload, now_us)
                if reply is not None:
                    self._session.answer(reply)
            self._conclude(now_us)

    def _execute(self, kind: int, payload: bytes, now_us: int) -> "tuple[int, bytes] | None":
        """Execute a request and return its reply, None if that comes later."""
        raise NotImplementedError

    def _reset(self, now_us: int) -> None:
        """Come to rest for a new session."""
        raise NotImplementedError

    def _conclude(self, now_us: int) -> None:
        """Do what follows the reply to a request, or to HELLO."""

    def _at_work(self) -> int:
        """Return the error code that says why there can be no self-test now, 0 if there can."""
        raise NotImplementedError

    def _start_self_test(self, _payload: bytes, now_us: int) -> "tuple[int, bytes] | None":
        reason = NOT_READY if self.testing else self._at_work()
        if reason:
            return error(reason)
        self.testing = True
        self._test_request = self._session.request_id
        self._test_due_us = now_us + self._board.self_test_us()
        return None

    def _finish_self_test(self, now_us: int) -> None:
        """Answer the SELF_TEST that is done by now, if the host still waits for it."""
        if not self.testing or self._test_due_us > now_us:
            return
        self.testing = False
        failures = self._board.self_test()
        if self._test_request == self._session.request_id:
            self._session.answer((SELF_TEST_RESULT, struct.pack("<H", failures)))

    def _reply_due_us(self) -> "int | None":
        """Return when there will be a reply to send, None if none is under way."""
        if self._session.n_waiting:
            return self._fed_us
        return self._test_due_us if self.testing else None
