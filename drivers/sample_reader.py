"""Reading a gyro that sends by itself: from frames that have come to numbered samples, and on to blocks of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.api import Clock, GyroStatus, RateBlock, RateCounts
from drivers.errors import DeviceError, DeviceFaultError, DeviceTimeoutError
from drivers.frame_stream import FrameStream
from drivers.protocol.crc_frames import Frames
from drivers.protocol.sample_index import CounterError, Part, SampleIndex, parts

BATCH_TIME = 0.2  # s of samples that are decoded together
LONGEST_BLOCK = 0.25  # s
MAX_SILENCE = 1.0  # s, or three samples if that is longer

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Samples as a driver has decoded them, oldest first; n of each array, n > 0."""

    records: NDArray[np.void]  #: all that came of them, shape (n,)
    counters: NDArray[np.integer]  #: shape (n,)
    counts: RateCounts  #: shape (n, n_axes)
    status: NDArray[np.uint8]  #: `drivers.api.GyroStatus`, shape (n,)
    differences: bool = False  #: whether each rate is a difference to the sample before: over a gap it is none


#: Turns frames into samples, None if there are none; what is wrong with them comes beside those before it.
Decode = Callable[[list[Frames]], tuple[Samples | None, DeviceError | None]]
#: Returns what consecutive records hold beside rates: temperature in degrees Celsius, specific force in m/s^2.
Beside = Callable[[NDArray[np.void]], tuple[float | None, Vector | None]]


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleFormat:
    """What the frames of a stream hold, and what it means."""

    decode: Decode
    beside: Beside
    frame_size: int  #: bytes of a sample on the line
    sample_rate: float  #: samples a second
    rate_lsb: float  #: rad/s per count
    span: int  #: how many values the samples' counter has
    step: int = 1  #: by how much it rises from sample to sample


class _Blocks:
    """Makes blocks of a stream's samples: numbers them, and cuts them at gaps and where their status changes."""

    def __init__(self, form: SampleFormat) -> None:
        self.form = form
        self._index = SampleIndex(span=form.span, step=form.step, sample_rate=form.sample_rate)

    def make(self, samples: Samples, now: float, *, damaged: bool) -> list[RateBlock]:
        """Return samples as blocks; `now`, `damaged` and what is raised are as `SampleIndex.number` has them."""
        expected = self._index.next_index
        numbered = self._index.number(samples.counters, now, damaged=damaged)
        records, counts, status = samples.records, samples.counts, samples.status
        if samples.differences:
            whole = np.diff(numbered.index, prepend=expected - 1) == 1
            records, counts, status, numbered = records[whole], counts[whole], status[whole], numbered.only(whole)
        longest = max(1, round(LONGEST_BLOCK * self.form.sample_rate))
        return [
            self._block(records[part.where], counts[part.where], part, int(status[part.where.start]), now)
            for part in parts(numbered, status, expected=expected, longest=longest)
        ]

    def _block(self, records: NDArray[np.void], counts: RateCounts, part: Part, status: int, now: float) -> RateBlock:
        temperature, specific_force = self.form.beside(records)
        return RateBlock(
            first_index=part.first,
            device_time=part.first / self.form.sample_rate,
            arrival_time=now,
            counts=counts,
            rate_lsb=self.form.rate_lsb,
            temperature=temperature,
            specific_force=specific_force,
            status=GyroStatus(status) | (GyroStatus.OVERRUN if part.unsure else GyroStatus.OK),
            n_lost=part.n_lost,
        )


class SampleReader:
    """`drivers.api.Gyro.read` of an instrument that sends by itself, between `begin` and `end`.

    Parameters
    ----------
    stream
        Of its frames.
    clock
        That of the stream's link.
    """

    def __init__(self, stream: FrameStream, clock: Clock) -> None:
        self._stream = stream
        self._clock = clock
        self._blocks: _Blocks | None = None
        self._batch = 0
        self._max_silence = MAX_SILENCE
        self._waiting: list[Frames] = []
        self._ended = False
        self._heard_at = 0.0
        self._failure: DeviceError | None = None

    @property
    def under_way(self) -> bool:
        """Whether samples are read."""
        return self._blocks is not None and not self._ended

    def begin(self, form: SampleFormat, *, waiting: Sequence[Frames] = ()) -> None:
        """Read samples from now on, numbered from 0; `waiting` have come already."""
        self._blocks, self._waiting = _Blocks(form), list(waiting)
        self._batch = max(1, round(BATCH_TIME * form.sample_rate)) * form.frame_size
        self._max_silence = max(MAX_SILENCE, 3 / form.sample_rate)
        self._ended, self._failure = False, None
        self._heard_at = self._clock.now()
        self._stream.damaged()

    def end(self) -> None:
        """Take no more; what was sent before can still be read."""
        self._ended = True

    def reset(self) -> None:
        """Forget the stream."""
        self._blocks = self._failure = None

    def read(self) -> list[RateBlock]:
        """Return the blocks that have come; the rest is as `drivers.api.Gyro.read` says."""
        if self._failure is not None:
            raise self._failure
        if self._blocks is None:
            self._stream.take_raw()
            return []
        frames, self._waiting = self._waiting, []
        frames += self._stream.take(0 if self._ended else self._batch)
        now = self._clock.now()
        blocks = self._made(self._blocks, frames, now) if frames else []
        if blocks:
            self._heard_at = now
        elif self._failure is not None:
            raise self._failure
        elif not self._ended and now - self._heard_at > self._max_silence and not self._stream.holds:
            raise DeviceTimeoutError(
                f"{self._stream.link.name} has sent no samples for {now - self._heard_at:.1f} s: "
                "was it switched off or unplugged?"
            )
        if self._ended:
            self._blocks = None
        return blocks

    def _made(self, blocks: _Blocks, frames: list[Frames], now: float) -> list[RateBlock]:
        """Return the blocks of frames, and note what is wrong with these."""
        samples, self._failure = blocks.form.decode(frames)
        if samples is None:
            return []
        try:
            return blocks.make(samples, now, damaged=self._stream.damaged())
        except CounterError as error:
            name = self._stream.link.name
            self._failure = DeviceFaultError(f"{name} has a sample counter that {error}: was it reset?")
            return []
