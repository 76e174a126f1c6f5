"""Where the axes are: asked of all of them again and again, without ever waiting for an answer."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf

from drivers.api import Clock
from drivers.errors import DeviceTimeoutError, ProtocolError
from drivers.zaber.axis import AxisReport, ZaberAxis
from drivers.zaber.line import Line

POLL_PERIOD = 0.01  # s between questions for the position, unless an alert calls for one
ANSWER_TIMEOUT = 0.25  # s after which a question for the position is asked again
MAX_SILENCE = 1.0  # s without an answer


class Poll:
    """The questions for their positions that axes on a line have still to answer; `clock` is the line's."""

    def __init__(self, line: Line, clock: Clock, axes: Sequence[ZaberAxis]) -> None:
        self._line = line
        self._clock = clock
        self._axes = axes
        self._open: dict[int, int] = {}  # axis to number of the question that is open
        self._reports: dict[int, AxisReport] = {}  # by axis
        self._asked_at = -inf
        self._waiting_since: float | None = None  # when the first question was sent that has no answer yet
        self._odd_answer = ""  # since the last good one

    def take(self) -> list[AxisReport]:
        """Take in answers, and return the reports of all axes once all have come, else none."""
        self._line.service()
        for index, number in list(self._open.items()):
            reply = self._line.take(number)
            if reply is None:
                continue
            del self._open[index]
            if report := self._axes[index].report(reply):
                self._reports[index] = report
            else:  # once, it may be damage; the silence counts on
                self._odd_answer = reply.data
        if self._open or len(self._reports) < len(self._axes):
            return []
        reports = [self._reports[index] for index in range(len(self._axes))]
        self._reports = {}
        self._waiting_since, self._odd_answer = None, ""
        return reports

    def ask(self, now: float) -> None:
        """Ask the axes, unless they were asked a moment ago and have still to answer.

        Raises
        ------
        DeviceTimeoutError
            If one has not answered for a second.
        ProtocolError
            If it has, with something else.
        """
        silence = 0.0 if self._waiting_since is None else now - self._waiting_since
        if silence > MAX_SILENCE:
            name = f"the stage on {self._line.name}"
            if self._odd_answer:
                raise ProtocolError(f"{name} answers questions for its position with {self._odd_answer!r}")
            raise DeviceTimeoutError(f"{name} has not told its position for {silence:.1f} s: was it cut off?")
        wait = ANSWER_TIMEOUT if self._open else 0.0 if self._line.alerted else POLL_PERIOD
        due = self._asked_at + wait
        if now < due:
            self._clock.alarm(due)
            return
        self.drop()
        self._line.alerted = False
        self._open = {index: self._line.send(axis.target, "get pos") for index, axis in enumerate(self._axes)}
        self._asked_at = now
        if self._waiting_since is None:
            self._waiting_since = now

    def drop(self) -> None:
        """Forget what was asked before something changed."""
        for number in self._open.values():
            self._line.forget(number)
        self._open.clear()
        self._reports.clear()
        self._asked_at = -inf

    def restart(self) -> None:
        """Forget what was asked, and count the silence from the next question on."""
        self.drop()
        self._waiting_since = None
