"""An Epson sensor as a gyro: configured by `connect`, streaming between `start` and `stop`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.api import ByteLink, Clock, DeviceIdentity, GyroStatus, RateBlock, SelfTest
from drivers.epson.settings import Registers, Unit
from drivers.errors import DeviceError, ProtocolError
from drivers.frame_stream import LONGEST_BLOCK, FrameStream, SampleReader
from drivers.protocol.crc_frames import CrcFrameCounts, Frames
from drivers.protocol.epson import BURST_SIZE, ERROR, BurstDecoder, CounterCheck, records
from drivers.protocol.sample_index import Part, SampleIndex, parts

STANDARD_GRAVITY = 9.80665  # m/s^2
COUNTER_SPAN = 65_536
_SATURATION = 2**31 - 2**20  # steps of a 32-bit field: next to its end


class EpsonGyro:
    """An M-G320 to M-G370; a `drivers.api.Gyro`.

    Parameters
    ----------
    link
        The open line to the unit; the driver closes it.
    clock
        The clock that `link` notifies.
    sample_rate
        Samples a second to set, one of `drivers.protocol.epson.RATE_CODES`.
    axis
        The one axis to use, ``x``, ``y`` or ``z``; empty for all three.
    """

    def __init__(self, link: ByteLink, clock: Clock, *, sample_rate: float = 125.0, axis: str = "") -> None:
        self._link = link
        self._clock = clock
        self._sample_rate = sample_rate
        self._axes = ["xyz".index(axis)] if axis else [0, 1, 2]
        self._registers = Registers(link, clock)
        self._unit: Unit | None = None
        self._stream: FrameStream | None = None
        self._reader: SampleReader | None = None
        self._index = SampleIndex(span=COUNTER_SPAN, step=1, sample_rate=sample_rate)
        self._counter = CounterCheck()

    @property
    def sample_rate(self) -> float:
        """Samples a second."""
        return self._sample_rate

    @property
    def n_axes(self) -> int:
        """How many input axes a sample holds, 1 or 3."""
        return len(self._axes)

    @property
    def link_counts(self) -> CrcFrameCounts:
        """What has come over the link, and what of it could not be used; for ``crc`` read sum."""
        return self._stream.counts if self._stream else CrcFrameCounts()

    @property
    def n_implausible(self) -> int:
        """Bursts with a right sum but an impossible counter."""
        return self._counter.n_dropped

    def connect(self) -> DeviceIdentity:
        """End sampling, ask who it is, and set rate, filter, burst and automatic sending.

        Raises
        ------
        DeviceTimeoutError
            If nothing answers.
        ProtocolError
            If it is no such sensor.
        DeviceFaultError
            If it reports a hardware error, or does not take a setting.
        """
        self._reader = None
        self._registers.enter_configuration()
        self._unit = unit = self._registers.identify()
        self._registers.configure(self._sample_rate)
        self._stream = FrameStream(self._link, self._clock, BurstDecoder(unit.model), what="Epson sensor")
        self._reader = SampleReader(self._stream, self._clock)
        return DeviceIdentity(
            kind="gyro",
            model=f"Epson {unit.product}",
            serial_number=unit.serial_number,
            firmware_version=unit.version,
            protocol="Epson UART",
        )

    def self_test(self) -> SelfTest:
        """Run the unit's self-test, which takes a fraction of a second."""
        self._connected()
        self._registers.enter_configuration()
        return SelfTest(self._registers.self_test())

    def start(self) -> None:
        """Enter sampling mode; samples are counted from the first that comes."""
        reader = self._connected()[1]
        if reader.under_way:
            return
        self._registers.enter_configuration()
        self._index = SampleIndex(span=COUNTER_SPAN, step=1, sample_rate=self._sample_rate)
        self._counter = CounterCheck()
        reader.begin(self._blocks, sample_rate=self._sample_rate, frame_size=BURST_SIZE[32], waiting=[])
        self._registers.start_sampling()

    def read(self) -> list[RateBlock]:
        """Return the blocks that have arrived, oldest first, ``[]`` if none. Never waits.

        Raises
        ------
        LinkError
            If the link is lost.
        DeviceTimeoutError
            If the stream has fallen silent.
        """
        return self._connected()[1].read()

    def stop(self) -> None:
        """Leave sampling mode. What was sent before can still be read."""
        _, reader = self._connected()
        if reader.under_way:
            self._registers.stop_sampling()
        reader.end()

    def close(self) -> None:
        """Leave sampling mode if the link still lives, and release it."""
        try:
            if self._reader is not None and self._reader.under_way:
                self._registers.stop_sampling()
        except DeviceError:
            pass  # the link is on its way out; an unread sensor does no harm
        finally:
            self._reader = None
            self._link.close()

    def _connected(self) -> tuple[Unit, SampleReader]:
        if self._unit is None or self._reader is None:
            self._link.receive()  # a lost link is told as such
            raise ProtocolError(f"{self._link.name} has not been connected")
        return self._unit, self._reader

    def _blocks(self, frames: list[Frames], now: float) -> tuple[list[RateBlock], DeviceError | None]:
        """Return bursts as blocks."""
        bursts = self._counter.confirm(records(frames))
        if not len(bursts) or self._stream is None:
            return [], None
        expected = self._index.next_index
        numbered = self._index.number(bursts["counter"], now, damaged=self._stream.damaged())
        counts = bursts["rate"][:, self._axes].astype(np.int32)
        status = _status(bursts, counts)
        longest = max(1, round(LONGEST_BLOCK * self._sample_rate))
        return [
            self._block(bursts[part.where], counts[part.where], part, status=int(status[part.where.start]), now=now)
            for part in parts(numbered, status, expected=expected, longest=longest)
        ], None

    def _block(
        self, bursts: NDArray[np.void], counts: NDArray[np.int32], part: Part, *, status: int, now: float
    ) -> RateBlock:
        model = self._connected()[0].model
        mean = bursts["acceleration"].astype(np.float64).mean(axis=0) * (model.acceleration_lsb * STANDARD_GRAVITY)
        x, y, z = mean.tolist()
        return RateBlock(
            first_index=part.first,
            device_time=part.first / self._sample_rate,
            arrival_time=now,
            counts=counts,
            rate_lsb=model.rate_lsb,
            temperature=model.celsius(float(bursts["temperature"].mean())),
            specific_force=(x, y, z),
            status=GyroStatus(status) | (GyroStatus.OVERRUN if part.unsure else GyroStatus.OK),
            n_lost=part.n_lost,
        )


def _status(bursts: NDArray[np.void], counts: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Return the status of each burst."""
    failed = bursts["flags"] & ERROR != 0
    saturated = (np.abs(counts.astype(np.int64)) >= _SATURATION).any(axis=1)
    status: NDArray[np.uint8] = (GyroStatus.SENSOR_FAULT * failed + GyroStatus.SATURATED * saturated).astype(np.uint8)
    return status
