"""An Epson sensor as a gyro: configured by `connect`, streaming between `start` and `stop`."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from drivers.api import ByteLink, Clock, DeviceIdentity, GyroStatus, RateBlock, SelfTest
from drivers.epson.settings import Registers, Unit
from drivers.errors import DeviceError, ProtocolError
from drivers.frame_stream import FrameStream
from drivers.protocol.crc_frames import CrcFrameCounts, Frames
from drivers.protocol.epson import BURST_SIZE, ERROR, BurstDecoder, CounterCheck, Model, records
from drivers.sample_reader import SampleFormat, SampleReader, Samples, Vector

STANDARD_GRAVITY = 9.80665  # m/s^2
COUNTER_SPAN = 65_536
START_ATTEMPTS = 3
START_TIME = 0.2  # s, and two samples, in which the first must come
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

    @property
    def troubles(self) -> dict[str, int]:
        """What has gone wrong on the link and been made up for."""
        return self._stream.troubles if self._stream else {}

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
        unit, stream, reader = self._connected()
        if reader.under_way:
            return
        self._registers.enter_configuration()
        self._counter = CounterCheck()
        form = SampleFormat(
            decode=self._decode,
            beside=partial(_beside, unit.model),
            frame_size=BURST_SIZE[32],
            sample_rate=self._sample_rate,
            rate_lsb=unit.model.rate_lsb,
            span=COUNTER_SPAN,
        )
        reader.begin(form, waiting=self._first_frames(stream))

    def read(self) -> list[RateBlock]:
        """Return the blocks that have arrived, oldest first, ``[]`` if none. Never waits.

        Raises
        ------
        LinkError
            If the link is lost.
        DeviceTimeoutError
            If the stream has fallen silent.
        """
        return self._connected()[-1].read()

    def stop(self) -> None:
        """Leave sampling mode. What was sent before can still be read."""
        reader = self._connected()[-1]
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

    def _connected(self) -> tuple[Unit, FrameStream, SampleReader]:
        if self._unit is None or self._stream is None or self._reader is None:
            self._link.receive()  # a lost link is told as such
            raise ProtocolError(f"{self._link.name} has not been connected")
        return self._unit, self._stream, self._reader

    def _first_frames(self, stream: FrameStream) -> list[Frames]:
        """Enter sampling mode, which nothing answers: again if nothing comes; return the first that did."""
        for _ in range(START_ATTEMPTS):
            self._registers.start_sampling()
            deadline = self._clock.now() + START_TIME + 2 / self._sample_rate
            while self._clock.now() < deadline:
                if frames := stream.take():
                    return frames
                self._clock.wait(deadline)
        return []

    def _decode(self, frames: list[Frames]) -> tuple[Samples | None, DeviceError | None]:
        """Return the samples in bursts."""
        bursts = self._counter.confirm(records(frames))
        if not len(bursts):
            return None, None
        counts = bursts["rate"][:, self._axes].astype(np.int32)
        return Samples(bursts, bursts["counter"], counts, _status(bursts, counts)), None


def _beside(model: Model, bursts: NDArray[np.void]) -> tuple[float, Vector]:
    """Return temperature and specific force."""
    mean = bursts["acceleration"].astype(np.float64).mean(axis=0) * (model.acceleration_lsb * STANDARD_GRAVITY)
    x, y, z = mean.tolist()
    return model.celsius(float(bursts["temperature"].mean())), (x, y, z)


def _status(bursts: NDArray[np.void], counts: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Return the status of each burst."""
    failed = bursts["flags"] & ERROR != 0
    saturated = (np.abs(counts.astype(np.int64)) >= _SATURATION).any(axis=1)
    status: NDArray[np.uint8] = (GyroStatus.SENSOR_FAULT * failed + GyroStatus.SATURATED * saturated).astype(np.uint8)
    return status
