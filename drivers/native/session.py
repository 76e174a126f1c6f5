"""One conversation with a native device: HELLO, requests and replies, stream frames, heartbeats.

``docs/protocol.md`` section 2. Nothing here waits but `open` and `request`.
"""

from __future__ import annotations

import secrets
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from construct import Container

from drivers.api import DAMAGED, REPEATED, ByteLink, Clock, DeviceIdentity
from drivers.errors import DeviceTimeoutError, LinkError, ProtocolError
from drivers.native.greeting import KIND_NAMES, hello, identity, no_answer
from drivers.native.refusal import refusal
from drivers.protocol.framing import FrameCounts, FrameDecoder, encode_frame
from drivers.protocol.layout import numpy_dtype
from drivers.protocol.native import (
    LAYOUTS,
    DeviceKind,
    MessageType,
    build,
    message_type,
    parse,
)

REPEAT_INTERVAL = 0.2  # s between repetitions of a request
ATTEMPTS = 5
HEARTBEAT_PERIOD = 0.05  # s of host time; half of what the protocol asks, so that a late call does no harm
MAX_STREAM = 4096  # stream frames that wait for the driver; the index shows it if more came


def _span(kind: MessageType, name: str) -> slice:
    """Return where a field of a stream frame lies in its body."""
    dtype, offset = numpy_dtype(LAYOUTS[kind], n_axes=1, n_samples=1).fields[name][:2]  # type: ignore[index]  # has fields
    return slice(offset, offset + dtype.itemsize)


_MAX_REPLIES = 16  # only the one to the last request matters
_TAKES_TIME = {MessageType.SELF_TEST}  # answered late: to ask again is no trouble
_STREAM_TYPES = (MessageType.SAMPLES, MessageType.STAGE_STATUS)
_SESSION_SPAN = {kind: _span(kind, "session") for kind in _STREAM_TYPES}
_TIME_SPAN = {kind: _span(kind, "device_time_us") for kind in _STREAM_TYPES}


def random_session() -> int:
    """Return a random session number, never 0."""
    return secrets.randbelow(2**32 - 1) + 1


@dataclass(frozen=True, slots=True)
class LinkCounts:
    """What has come over a link that could not be used."""

    frames: FrameCounts = field(default_factory=FrameCounts)
    n_bytes: int = 0  #: all bytes heard
    n_unknown: int = 0  #: whole frames of unknown type or wrong length
    n_foreign: int = 0  #: messages of another session


class Session:
    """A conversation with one device over `link`.

    Parameters
    ----------
    link
        The open line to the device.
    clock
        The clock that `link` notifies.
    kind
        What device is expected, None for any.
    draw_session
        Draws session numbers, 1 to 2^32 - 1.
    """

    def __init__(
        self,
        link: ByteLink,
        clock: Clock,
        *,
        kind: DeviceKind | None,
        draw_session: Callable[[], int] = random_session,
    ) -> None:
        self._link = link
        self._clock = clock
        self._kind = kind
        self._draw_session = draw_session
        self._decoder = FrameDecoder()
        self._number = 0
        self._number_bytes = b""
        self._open = False
        self._request_id = 0
        self._replies: deque[Container] = deque(maxlen=_MAX_REPLIES)
        self._stream: deque[bytes] = deque(maxlen=MAX_STREAM)
        self._stream_at = 0.0
        self._seen_us = 0
        self._beaten_us = 0
        self._beaten_at = 0.0
        self._n_bytes = self._n_unknown = self._n_foreign = self._n_repeated = 0

    @property
    def name(self) -> str:
        """Device and port, for messages: ``the gyro on /dev/ttyUSB0``."""
        return f"the {KIND_NAMES[self._kind] if self._kind else 'device'} on {self._link.name}"

    @property
    def is_open(self) -> bool:
        """Whether the device has accepted this session."""
        return self._open

    @property
    def counts(self) -> LinkCounts:
        """What has come that could not be used."""
        return LinkCounts(self._decoder.counts, self._n_bytes, self._n_unknown, self._n_foreign)

    @property
    def troubles(self) -> dict[str, int]:
        """What has gone wrong and been made up for, as `drivers.api.Gyro.troubles`."""
        frames = self._decoder.counts
        n_damaged = frames.n_bad_cobs + frames.n_bad_crc + frames.n_too_long
        return {REPEATED: self._n_repeated, DAMAGED: n_damaged, "unknown messages": self._n_unknown}

    @property
    def silence(self) -> float:
        """Seconds of host time since the last stream frame, or since `expect_stream`."""
        return self._clock.now() - self._stream_at

    def open(self, *, attempts: int = ATTEMPTS) -> DeviceIdentity:
        """Say HELLO and check who answers.

        Raises
        ------
        DeviceTimeoutError
            If nothing answers.
        ProtocolError
            If it is another device, speaks another version, or no such thing.
        """
        self._begin(self._draw_session())
        heard = self._n_bytes, self._decoder.counts.n_frames
        answer = self._exchange(b"\0" + encode_frame(hello(self._number)), self._greets, attempts=attempts)
        if answer is None:
            n_bytes, n_frames = self._n_bytes - heard[0], self._decoder.counts.n_frames - heard[1]
            raise no_answer(self._link.name, n_bytes, n_frames)
        who = identity(answer, self._link.name, self._kind)
        self._open = True
        self._beaten_at = self._stream_at = self._clock.now()
        return who

    def request(
        self,
        kind: MessageType,
        *,
        reply: MessageType = MessageType.ACK,
        interval: float = REPEAT_INTERVAL,
        attempts: int = ATTEMPTS,
        **fields: int,
    ) -> Container:
        """Make a request, repeated until its reply comes, and return the reply. Stream frames are kept meanwhile.

        Parameters
        ----------
        kind
            The request.
        reply
            What answers it.
        interval, attempts
            Seconds between repetitions, and how often it is sent.
        **fields
            Its payload, in wire units.

        Raises
        ------
        DeviceTimeoutError
            If no reply comes. Whether the request was executed is then unknown.
        DeviceFaultError, ProtocolError
            If the device refuses, see `drivers.native.refusal.refusal`, or answers with something else.
        LinkError
            If the link is lost, or no session is open.
        """
        if not self._open:
            raise LinkError(f"{self.name} has no open session for {kind.name}: connect first")
        self._request_id += 1
        number = self._request_id
        frame = encode_frame(build(kind, session=self._number, request_id=number, **fields))
        n_repeated = self._n_repeated
        answer = self._exchange(frame, lambda message: message.get("request_id") == number, interval, attempts)
        if kind in _TAKES_TIME:
            self._n_repeated = n_repeated
        if answer is None:
            raise DeviceTimeoutError(
                f"{self.name} did not answer {kind.name} within {interval * attempts:.1f} s, asked {attempts} times"
            )
        if answer.type == MessageType.ERROR:
            raise refusal(self.name, kind, answer)
        if answer.type != reply:
            raise ProtocolError(f"{self.name} answered {kind.name} with {MessageType(answer.type).name}")
        return answer

    @property
    def last_request_id(self) -> int:
        """Number of the newest request."""
        return self._request_id

    def service(self) -> None:
        """Send the heartbeat if it is time, and take in what has arrived. Never waits.

        In this order a heartbeat acknowledges what the caller has had since the last call and could act on: an emulator
        that runs ahead of real time by the heartbeats then meets every command at the same instant of its world.
        """
        if self._open:
            self._beat()
        data = self._link.receive()
        if data:
            self._n_bytes += len(data)
            for body in self._decoder.feed(data):
                self._sort(body)

    def take_stream(self) -> list[bytes]:
        """Service the link and return the bodies of the stream frames that have come, oldest first."""
        self.service()
        bodies = list(self._stream)
        self._stream.clear()
        return bodies

    def expect_stream(self) -> None:
        """Forget stream frames that came before, and count the silence from now."""
        self._stream.clear()
        self._stream_at = self._clock.now()

    def close(self) -> None:
        """Release the link."""
        self._open = False
        self._link.close()

    def _begin(self, number: int) -> None:
        self._open = False
        self._number = number
        self._number_bytes = number.to_bytes(4, "little")
        self._request_id = 0
        self._seen_us = self._beaten_us = 0
        self._stream.clear()

    def _sort(self, body: bytes) -> None:
        """Put a body where it belongs."""
        kind = message_type(body)
        if kind is None:
            self._n_unknown += 1
        elif kind in _STREAM_TYPES:
            if body[_SESSION_SPAN[kind]] == self._number_bytes:
                self._seen_us = max(self._seen_us, int.from_bytes(body[_TIME_SPAN[kind]], "little"))
                self._stream_at = self._clock.now()
                self._stream.append(body)
            else:
                self._n_foreign += 1
        else:
            message = parse(body)
            if kind is MessageType.IDENTITY or message.session == self._number:
                self._replies.append(message)
            else:
                self._n_foreign += 1

    def _beat(self) -> None:
        now = self._clock.now()
        if self._seen_us > self._beaten_us or now - self._beaten_at >= HEARTBEAT_PERIOD:
            beat = build(MessageType.HEARTBEAT, session=self._number, seen_time_us=self._seen_us)
            self._link.write(encode_frame(beat))
            self._beaten_us, self._beaten_at = self._seen_us, now

    def _exchange(
        self,
        frame: bytes,
        answers: Callable[[Container], bool],
        interval: float = REPEAT_INTERVAL,
        attempts: int = ATTEMPTS,
    ) -> Container | None:
        """Send `frame` up to `attempts` times, `interval` apart, until a message comes that `answers` it."""
        self._replies.clear()
        for attempt in range(attempts):
            self._n_repeated += attempt > 0
            self._link.write(frame)
            for message in self._listen(self._clock.now() + interval):
                if answers(message):
                    return message
        return None

    def _listen(self, deadline: float) -> Iterator[Container]:
        """Yield the messages that come until `deadline`, keeping the heartbeat going."""
        while True:
            self.service()
            while self._replies:
                yield self._replies.popleft()
            now = self._clock.now()
            if now >= deadline:
                return
            self._clock.wait(min(deadline, now + HEARTBEAT_PERIOD))

    def _greets(self, message: Container) -> bool:
        """Whether `message` answers the HELLO: with its session, or with none because it refuses."""
        return message.type == MessageType.IDENTITY and message.session in {self._number, 0}
