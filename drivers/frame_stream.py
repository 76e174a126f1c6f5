"""The host's end of a line on which an instrument sends frames unasked: taken in batches that are worth decoding."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

from drivers.api import DAMAGED, REPEATED, ByteLink, Clock
from drivers.errors import DeviceTimeoutError, LinkError, ProtocolError
from drivers.protocol.crc_frames import CrcFrameCounts, Frames

_DRAIN_TIME = 0.06  # s, more than a reader of a port that was full takes to read on
_DRAIN_SLACK = 256  # bytes
_MAX_DRAINS = 20
_LONGEST_SIGN = 15  # bytes, less one
_LONGEST_HOLD = 0.25  # s for which bytes wait for more of them
_MAX_HEARD = 4096  # bytes that are searched for an answer
T = TypeVar("T")


class FrameDecoder(Protocol):
    """Turns bytes into frames; see `drivers.protocol.crc_frames.CrcFrameDecoder`."""

    @property
    def counts(self) -> CrcFrameCounts:
        """A copy of what it has met so far."""

    def feed(self, data: bytes) -> list[Frames]:
        """Return the good frames that `data` completes."""


#: Whether bytes hold what is looked for.
Sign = Callable[[bytes], bool]


class FrameStream:
    """Frames from a link.

    Parameters
    ----------
    link
        The open line.
    clock
        The clock that `link` notifies.
    decoder
        Of the frames.
    what
        The instrument, for messages.
    sign
        Whether bytes hold what the instrument sends besides its frames, at most 16 bytes; counted in `n_signs`.
    """

    def __init__(
        self, link: ByteLink, clock: Clock, decoder: FrameDecoder, *, what: str, sign: Sign = lambda _: False
    ) -> None:
        self.link = link
        self._clock = clock
        self._decoder = decoder
        self._what = what
        self._sign = sign
        self._tail = b""  # in which a sign may have begun
        self.n_signs = 0  #: how many batches have held one
        self._pending: list[bytes] = []
        self._n_pending = 0
        self._pending_since = 0.0
        self._n_bytes = self._n_repeated = 0
        self._lost: LinkError | None = None
        self._counts = decoder.counts

    @property
    def counts(self) -> CrcFrameCounts:
        """What the decoder has met."""
        return self._decoder.counts

    @property
    def troubles(self) -> dict[str, int]:
        """What has gone wrong and been made up for, as `drivers.api.Gyro.troubles`."""
        counts = self.counts
        return {REPEATED: self._n_repeated, DAMAGED: counts.n_bad_crc, "bytes skipped": counts.n_skipped}

    @property
    def holds(self) -> bool:
        """Whether bytes have come that are still to be decoded."""
        return bool(self._pending)

    def damaged(self) -> bool:
        """Return whether anything on the line could not be used since the last time this was asked."""
        before, self._counts = self._counts, self._decoder.counts
        return before.n_skipped != self._counts.n_skipped

    def take(self, batch: int = 0) -> list[Frames]:
        """Return the frames that have come, oldest first; none while less than `batch` bytes have, but not for long.

        Raises
        ------
        LinkError
            If the link is lost and all that came over it has been taken.
        """
        self._take_in()
        if not self._pending or (
            self._n_pending < batch and not self._lost and self._clock.now() - self._pending_since < _LONGEST_HOLD
        ):
            return []
        data = b"".join(self._pending)
        self._pending.clear()
        self._n_pending = 0
        if self._sign is not None:
            self.n_signs += self._sign(self._tail + data)
            self._tail = data[-_LONGEST_SIGN:]
        return self._decoder.feed(data)

    def take_raw(self) -> bytes:
        """Return the bytes that have come, as they are."""
        self._take_in()
        data = b"".join(self._pending)
        self._pending.clear()
        self._n_pending = 0
        self._tail = b""
        return data

    def hear(self, find: Callable[[bytes], T | None], *, patience: float, heard: bytes = b"") -> tuple[bytes, T | None]:
        """Take bytes as they are until `find` finds something in them, at most for `patience` s.

        Return the newest of those heard, after what was heard before, and what was found, None if nothing.
        """
        deadline = self._clock.now() + patience
        while True:
            heard = heard[-_MAX_HEARD:] + self.take_raw()
            found = find(heard)
            if found is not None or self._clock.now() >= deadline:
                return heard, found
            self._clock.wait(deadline)

    def drain(self, *, bytes_per_second: float) -> None:
        """Throw away what has come, until no more comes than is being sent: what waited in buffers is gone then."""
        for _ in range(_MAX_DRAINS):
            self.take_raw()
            before = self._clock.now()
            self._clock.sleep_until(before + _DRAIN_TIME)
            if len(self.take_raw()) <= 2 * bytes_per_second * (self._clock.now() - before) + _DRAIN_SLACK:
                return

    def ask(
        self, question: bytes, headers: tuple[bytes, ...], *, attempts: int = 3, patience: float = 0.5
    ) -> list[Frames]:
        """Ask until a frame with one of `headers` comes; return it, and what came after it.

        Raises
        ------
        DeviceTimeoutError
            If nothing came, or other frames only.
        ProtocolError
            If bytes came but no good frame.
        LinkError
            If the link is lost.
        """
        n_bytes, n_frames = self._n_bytes, self.counts.n_frames
        for attempt in range(attempts):
            self._n_repeated += attempt > 0
            self.link.write(question)
            deadline = self._clock.now() + patience
            while True:
                frames = self.take()
                for place, run in enumerate(frames):
                    if run.header in headers:
                        return frames[place:]
                if self._clock.now() >= deadline:
                    break
                if not frames:
                    self._clock.wait(deadline)
        raise self._no_answer(question, self._n_bytes - n_bytes, self.counts.n_frames - n_frames)

    def _take_in(self) -> None:
        if self._lost:
            if not self._pending:
                raise self._lost
            return
        try:
            data = self.link.receive()
        except LinkError as error:
            if not self._pending:
                raise
            self._lost = error  # once what has come before is taken
            return
        if data:
            if not self._pending:
                self._pending_since = self._clock.now()
            self._pending.append(data)
            self._n_pending += len(data)
            self._n_bytes += len(data)

    def _no_answer(self, question: bytes, n_bytes: int, n_frames: int) -> DeviceTimeoutError | ProtocolError:
        asked = question.decode("ascii", "replace").strip()
        name = self.link.name
        if n_frames:
            return DeviceTimeoutError(
                f"{name} sends samples but does not answer {asked!r}: is the pair from the host to the {self._what} "
                "wired?"
            )
        if n_bytes:
            return ProtocolError(
                f"{name} sends bytes, {n_bytes} while waited for, but no frame of a {self._what}: "
                "is it one, and is its bit rate the port's?"
            )
        return DeviceTimeoutError(
            f"{name} is silent: no {self._what} has answered {asked!r}. Look at its supply and its wires, "
            "and switch it off and on if it was left in a service mode"
        )
