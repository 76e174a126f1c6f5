"""The streams of a resumed measurement on one time axis, and whether the gyro was switched off between them.

A gyro counts its samples anew with each stream. Where the next stream lies against the ones before is told by the
gyro's own clock, to its resolution, if it ran on; else by the host's date, to a second or so. That is enough: the
time between two streams only says how far slow noise may have moved meanwhile.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from drivers.api import DeviceIdentity, RateBlock
from northfinder.errors import ConfigError, RecordError
from northfinder.record import DwellSpan, Record, StreamInfo
from northfinder.text import printable

#: Date and gyro's clock agree to this, in s, where the gyro does not count how often it was switched on.
_CLOCKS_AGREE = 10.0
#: Two streams are at least this far apart, in s.
_LEAST_PAUSE = 1.0


@dataclass(frozen=True, slots=True)
class StreamPlace:
    """Where a stream lies: `start` s after sample 0 of the first, after `turn_on` times off and on."""

    start: float = 0.0
    turn_on: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Earlier:
    """What a measurement has done before it was interrupted."""

    spans: tuple[DwellSpan, ...] = ()  #: its finished dwells
    anchor: StreamInfo | None = None  #: the last stream with a finished dwell
    last: RateBlock | None = None  #: the last block of that stream
    elapsed: float = field(default=0.0)  #: s of the plan that the finished dwells and their slews have taken

    def check(self, identities: Mapping[str, DeviceIdentity], *, sample_rate: float, n_axes: int) -> None:
        """Raise ConfigError unless the rest is to be measured with the same gyro in the same way, on the same stage."""
        if self.anchor is None:
            return
        gyro, before = identities["gyro"], self._said_of("gyro")
        found = (gyro.model, gyro.serial_number, sample_rate, n_axes)
        expected = (before.get("model"), before.get("serial_number"), self.anchor.sample_rate, self.anchor.n_axes)
        if found != expected:
            shown = "{} {}, {:g} samples/s of {}"
            raise ConfigError(
                f"the rest must be measured with the same gyro: found {shown.format(*found)}, "
                f"expected {printable(shown.format(*expected))}"
            )
        self._check_stage(identities["stage"])

    def _check_stage(self, stage: DeviceIdentity) -> None:
        """Raise ConfigError for another stage: its azimuth zero points elsewhere."""
        before = self._said_of("stage")
        found = (stage.model, stage.serial_number)
        expected = (before.get("model"), before.get("serial_number"))
        if before and found != expected:
            raise ConfigError(
                f"the rest must be measured on the same stage: found {printable('{} {}'.format(*found))}, "
                f"expected {printable('{} {}'.format(*expected))}"
            )

    def place(self, block: RateBlock, gyro: DeviceIdentity, *, sample_rate: float, utc: float) -> StreamPlace:
        """Return where the stream lies whose first block, of `gyro`, has just come, at `utc` s since 1970."""
        if self.anchor is None or self.last is None:
            return StreamPlace()
        span, last = self.spans[-1], self.last
        last_start = span.stream_start + last.first_index / self.anchor.sample_rate
        last_utc = self.anchor.utc + last.arrival_time - self.anchor.clock
        by_gyro, by_date = block.device_time - last.device_time, utc - last_utc
        went_on = by_gyro > 0.0 and self._same_turn_on(gyro, abs(by_gyro - by_date))
        pause = by_gyro if went_on else max(by_date, len(last.counts) / sample_rate + _LEAST_PAUSE)
        start = last_start + pause - block.first_index / sample_rate
        return StreamPlace(start=start, turn_on=span.turn_on if went_on else span.turn_on + 1)

    def _said_of(self, device: str) -> dict[str, Any]:
        identities = self.anchor.identities if self.anchor else None
        found = identities.get(device) if isinstance(identities, dict) else None
        return found if isinstance(found, dict) else {}

    def _same_turn_on(self, gyro: DeviceIdentity, disagreement: float) -> bool:
        if not gyro.boot_count:  # it may not count them
            return disagreement < _CLOCKS_AGREE and not self._said_of("gyro").get("boot_count")
        return gyro.boot_count == self._said_of("gyro").get("boot_count")


def earlier_of(record: Record) -> Earlier:
    """Return what `record` holds of a measurement that is to go on. Raises RecordError."""
    spans, streams = record.steps(), {info.stream: info for info in record.streams()}
    if not spans:
        return Earlier()
    number = spans[-1].stream
    if number not in streams:
        raise RecordError(f"the record {record.path} does not say from which gyro its samples are: it cannot go on")
    (last,) = deque(record.blocks(spans[-1].first_index, stream=number), maxlen=1) or (None,)
    ends = {span.stream: span.stop_index / span.sample_rate for span in spans}
    return Earlier(spans=tuple(spans), anchor=streams[number], last=last, elapsed=sum(ends.values()))
