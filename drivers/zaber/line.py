"""Questions and answers on a line of Zaber devices: each answer is told by its number, device and axis."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.api import DAMAGED, REPEATED, ByteLink, Clock
from drivers.errors import DeviceFaultError, DeviceTimeoutError, ProtocolError
from drivers.protocol.zaber import N_IDS, REJECTIONS, Alert, LineCounts, LineDecoder, Reply, encode_command

REPEAT_INTERVAL = 0.2  # s between repetitions of a command
ATTEMPTS = 5
_STEP = 0.05  # s a wait at most, so that a link's loss is seen


@dataclass(frozen=True, slots=True)
class Target:
    """Whom a command is for: an axis of a device, or with axis 0 the device itself."""

    device: int
    axis: int = 0


class Line:
    """A line with one or more Zaber devices.

    A command that is repeated has a new number each time, and the old ones are forgotten: so an answer that comes late
    or twice is never taken for another one's.

    Parameters
    ----------
    link
        The open line; closed by `close`.
    clock
        The clock that `link` notifies.
    """

    def __init__(self, link: ByteLink, clock: Clock) -> None:
        self._link = link
        self._clock = clock
        self._decoder = LineDecoder()
        self._next_id = 0
        self._asked: dict[int, Target] = {}
        self._answers: dict[int, Reply] = {}
        self._n_foreign = self._n_repeated = 0
        self.alerted = False  #: whether an axis has said something unasked since this was last reset

    @property
    def name(self) -> str:
        """The port, for messages."""
        return self._link.name

    @property
    def counts(self) -> LineCounts:
        """What has come over the line."""
        return self._decoder.counts

    @property
    def n_foreign(self) -> int:
        """Replies that answered no open question."""
        return self._n_foreign

    @property
    def troubles(self) -> dict[str, int]:
        """What has gone wrong and been made up for, as `drivers.api.Gyro.troubles`."""
        return {REPEATED: self._n_repeated, DAMAGED: self.counts.n_bad_sum + self.counts.n_malformed}

    def require_sums(self) -> None:
        """Take only lines with a checksum from now on."""
        self._decoder.require_sum = True

    def send(self, target: Target, command: str) -> int:
        """Send a command and return its number, for `take`."""
        number = self._next_id
        self._next_id = (number + 1) % N_IDS
        self._asked[number] = target
        self._answers.pop(number, None)
        self._link.write(encode_command(command, device=target.device, axis=target.axis, message_id=number))
        return number

    def take(self, number: int) -> Reply | None:
        """Return the answer to a command, None if it has not come. Never waits; look at the link with `service`."""
        return self._answers.pop(number, None)

    def forget(self, number: int) -> None:
        """Take no answer to a command any more."""
        self._asked.pop(number, None)
        self._answers.pop(number, None)

    def service(self) -> None:
        """Take in what has arrived. Never waits."""
        data = self._link.receive()
        for message in self._decoder.feed(data) if data else ():
            if isinstance(message, Alert):
                self.alerted = True
            elif message.message_id in self._asked and self._answers_to(message, self._asked[message.message_id]):
                del self._asked[message.message_id]
                self._answers[message.message_id] = message
            else:
                self._n_foreign += 1

    def ask(
        self, target: Target, command: str, *, interval: float = REPEAT_INTERVAL, attempts: int = ATTEMPTS
    ) -> Reply:
        """Send a command, again until its answer comes, and return the answer, whether OK or RJ.

        Raises
        ------
        DeviceTimeoutError
            If no answer comes. Whether the command was executed is then unknown.
        LinkError
            If the link is lost.
        """
        for attempt in range(attempts):
            self._n_repeated += attempt > 0
            number = self.send(target, command)
            deadline = self._clock.now() + interval
            while True:
                self.service()
                reply = self.take(number)
                if reply is not None:
                    return reply
                if self._clock.now() >= deadline:
                    break
                self._clock.wait(min(deadline, self._clock.now() + _STEP))
            self.forget(number)
        raise DeviceTimeoutError(
            f"{self.describe(target)} on {self.name} did not answer {command.strip() or 'a poll'!r} within "
            f"{interval * attempts:.1f} s, asked {attempts} times"
        )

    def order(self, target: Target, command: str, *, interval: float = REPEAT_INTERVAL) -> Reply:
        """Ask, and raise what `refusal` returns if the answer is RJ twice: once, it may be of a damaged command."""
        reply = self.ask(target, command, interval=interval)
        if not reply.accepted:
            reply = self.ask(target, command, interval=interval)
        if not reply.accepted:
            raise self.refusal(target, command, reply)
        return reply

    def refusal(self, target: Target, command: str, reply: Reply) -> DeviceFaultError | ProtocolError:
        """Return the exception for a command that was rejected."""
        meaning = REJECTIONS.get(reply.data, "for a reason this driver does not know")
        kind = ProtocolError if reply.data in {"BADCOMMAND", "BADAXIS", "DEVICEONLY"} else DeviceFaultError
        return kind(f"{self.describe(target)} on {self.name} rejected {command!r}: {reply.data}, {meaning}")

    @staticmethod
    def describe(target: Target) -> str:
        """Return what an operator would call it."""
        return f"device {target.device}" + (f" axis {target.axis}" if target.axis else "")

    def close(self) -> None:
        """Release the link."""
        self._link.close()

    @staticmethod
    def _answers_to(reply: Reply, target: Target) -> bool:
        return (reply.device, reply.axis) == (target.device, target.axis) or (
            not reply.accepted and (reply.device, reply.axis) == (target.device, 0)
        )
