"""The STIM300 as a gyro of three axes: it streams by itself, and is asked what it is before the stream is used."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.api import ByteLink, Clock, DeviceIdentity, GyroStatus, RateBlock, SelfTest
from drivers.errors import DeviceError, DeviceFaultError, DeviceTimeoutError, ProtocolError
from drivers.frame_stream import BATCH_TIME, FrameStream
from drivers.protocol.crc_frames import CrcFrameCounts, Frames
from drivers.protocol.sample_index import CounterError, SampleIndex, cut
from drivers.protocol.stim300 import (
    CONFIGURATION,
    COUNTER_RATE,
    COUNTER_SPAN,
    EXTENDED_ERROR,
    PART_NUMBER,
    SAMPLE_IDS,
    SERIAL_NUMBER,
    START_UP_ERROR,
    Cluster,
    Configuration,
    Output,
    Status,
    decode_samples,
    decoder,
    parse_configuration,
    parse_extended_error,
    parse_part_number,
    parse_serial_number,
    triple,
    wire_size,
)
from drivers.stim300.settings import Settings, apply

MAX_SILENCE = 1.0  # s
LONGEST_BLOCK = 0.25  # s
START_UP_TIME = 3.0  # s, in which the self-test waits for the end of the start-up
_TURN = 2**24  # counts after which an integrated angle begins again


def _gyro_status(byte: int) -> GyroStatus:
    status = GyroStatus.OK
    if byte & (Status.INTEGRITY_ERROR | Status.CHANNEL_ERROR):
        status |= GyroStatus.SENSOR_FAULT
    if byte & Status.START_UP:
        status |= GyroStatus.NOT_READY
    if byte & Status.OUTSIDE_CONDITIONS:
        status |= GyroStatus.TEMPERATURE
    if byte & Status.OVERLOAD:
        status |= GyroStatus.SATURATED
    return status


#: What a status byte of the gyros says of a block.
GYRO_STATUS = np.array([_gyro_status(byte) for byte in range(256)], np.uint8)


class Stim300Gyro:
    """An STIM300; a `drivers.api.Gyro`.

    Parameters
    ----------
    link
        The open line to the unit; the driver closes it.
    clock
        The clock that `link` notifies.
    settings
        What is asked of it.
    """

    def __init__(self, link: ByteLink, clock: Clock, settings: Settings | None = None) -> None:
        self._clock = clock
        self._settings = settings or Settings()
        self._stream = FrameStream(link, clock, decoder(), what="STIM300")
        self._configuration: Configuration | None = None
        self._index: SampleIndex | None = None
        self._waiting: list[Frames] = []
        self._batch = 0
        self._integral: NDArray[np.int32] | None = None
        self._heard_at = 0.0
        self._streaming = False
        self._failure: DeviceError | None = None

    @property
    def sample_rate(self) -> float:
        """Samples a second, known after `connect`."""
        return float(self._configuration.sample_rate or 0) if self._configuration else 0.0

    @property
    def n_axes(self) -> int:
        """How many input axes a sample holds, 3."""
        return 3

    @property
    def configuration(self) -> Configuration:
        """What the unit is set to, known after `connect`."""
        if self._configuration is None:
            raise ProtocolError(f"{self._stream.link.name} has not been connected")
        return self._configuration

    @property
    def link_counts(self) -> CrcFrameCounts:
        """What has come over the link, and what of it could not be used."""
        return self._stream.counts

    def connect(self) -> DeviceIdentity:
        """Ask the unit for its part number, serial number and configuration; change this only if told to.

        Raises
        ------
        DeviceTimeoutError
            If nothing answers.
        ProtocolError
            If it is no STIM300.
        DeviceFaultError
            If it is not set to what is asked for, or cannot be used as it is set.
        """
        self._streaming = False
        self._failure = None
        part = parse_part_number(self._ask(b"N\r", PART_NUMBER))
        serial = parse_serial_number(self._ask(b"I\r", SERIAL_NUMBER))
        self._configuration = parse_configuration(self._ask(b"C\r", CONFIGURATION))
        if self._settings.differs_from(self._configuration):
            apply(self._settings, self._stream, self._clock)
            self._configuration = parse_configuration(self._ask(b"C\r", CONFIGURATION))
            self._settings.check(self._configuration)
        self._check(self._configuration)
        return DeviceIdentity(
            kind="gyro",
            model=f"STIM300 {part}",
            serial_number=serial,
            firmware_version=f"{self._configuration.revision}{self._configuration.firmware}",
            protocol="STIM300 datagrams",
        )

    def self_test(self) -> SelfTest:
        """Ask for the extended error information; blocks up to 3 s while the unit starts up."""
        deadline = self._clock.now() + START_UP_TIME
        while True:
            failures = parse_extended_error(self._ask(b"E\r", EXTENDED_ERROR))
            if START_UP_ERROR not in failures or self._clock.now() >= deadline:
                return SelfTest(failures)
            self._clock.sleep_until(min(deadline, self._clock.now() + BATCH_TIME))

    def start(self) -> None:
        """Begin to count samples at 0, with the first after the unit has said its configuration once more.

        Raises
        ------
        DeviceTimeoutError
            If it does not answer.
        DeviceFaultError
            If its configuration has changed.
        """
        if self._streaming:
            return
        before = self.configuration
        if parse_configuration(self._ask(b"C\r", CONFIGURATION)) != before:
            raise DeviceFaultError(f"{self._stream.link.name} has another configuration than when it was connected")
        step = COUNTER_RATE // (before.sample_rate or COUNTER_RATE)
        self._index = SampleIndex(span=COUNTER_SPAN, step=step, sample_rate=self.sample_rate)
        self._stream.damaged()
        self._integral = None
        self._heard_at = self._clock.now()
        self._streaming = True

    def read(self) -> list[RateBlock]:
        """Return the blocks that have arrived, oldest first, ``[]`` if none. Never waits.

        Raises
        ------
        LinkError
            If the link is lost.
        DeviceTimeoutError
            If the stream has fallen silent.
        DeviceFaultError
            If the unit was reset.
        ProtocolError
            If it sends other datagrams than it was set to.
        """
        if self._failure is not None:
            raise self._failure
        if self._index is None:
            self._stream.take_raw()
            return []
        frames, self._waiting = self._waiting, []
        frames += self._stream.take(self._batch if self._streaming else 0)
        blocks = self._blocks(frames, self._index)
        if self._failure is not None and not blocks:
            raise self._failure
        silence = self._clock.now() - self._heard_at
        if self._streaming and silence > MAX_SILENCE and not self._stream.holds:
            raise DeviceTimeoutError(
                f"{self._stream.link.name} has sent no samples for {silence:.1f} s: was it switched off or unplugged?"
            )
        if not self._streaming:
            self._index = None  # what was sent before the stop has been read
        return blocks

    def stop(self) -> None:
        """Take no more samples; the unit goes on sending. What was sent before can still be read."""
        self._streaming = False

    def close(self) -> None:
        """Release the link; the unit goes on sending."""
        self._streaming = False
        self._stream.link.close()

    def _ask(self, question: bytes, identifiers: tuple[int, int]) -> bytes:
        """Return the body of the answer, and keep what came after it."""
        answer, *self._waiting = self._stream.ask(question, tuple(bytes([code]) for code in identifiers))
        body: bytes = answer.bodies[-1].tobytes()
        return body

    def _check(self, found: Configuration) -> None:
        """Raise DeviceFaultError if the unit cannot be used as it is set."""
        name = self._stream.link.name
        if found.sample_rate is None:
            raise DeviceFaultError(
                f"{name} samples at an external trigger: give it a sample rate in service mode ('m 0' for 125 Hz)"
            )
        if not all(found.axes):
            axes = ", ".join(axis for axis, active in zip("xyz", found.axes, strict=True) if not active)
            raise DeviceFaultError(f"{name} has its gyro {axes} switched off: all three are needed")
        identifier = next(code for code, clusters in SAMPLE_IDS.items() if clusters == found.clusters)
        size = wire_size(identifier, terminated=found.terminated)
        if found.bit_rate and size * 10 * found.sample_rate > found.bit_rate:
            raise DeviceFaultError(
                f"{name} sends {size} bytes {found.sample_rate} times a second, too many for {found.bit_rate} bit/s: "
                "samples would be lost"
            )
        self._batch = max(1, round(BATCH_TIME * found.sample_rate)) * size

    def _blocks(self, frames: list[Frames], index: SampleIndex) -> list[RateBlock]:
        """Return the samples among the frames as blocks; note what is wrong in `_failure`."""
        runs = [decode_samples(run) for run in frames if self._is_sample(run)]
        if not runs:
            return []
        samples = np.concatenate(runs) if len(runs) > 1 else runs[0]
        now = self._heard_at = self._clock.now()
        try:
            return self._numbered(samples, index, now)
        except CounterError as error:
            self._failure = DeviceFaultError(
                f"{self._stream.link.name} has a sample counter that {error}: was it reset?"
            )
            return []

    def _is_sample(self, run: Frames) -> bool:
        identifier = run.header[0]
        if self._failure is not None:
            return False
        if identifier in (*PART_NUMBER, *SERIAL_NUMBER):
            self._failure = DeviceFaultError(f"{self._stream.link.name} was reset: it says again who it is")
        clusters = SAMPLE_IDS.get(identifier)
        if clusters is not None and clusters != self.configuration.clusters:
            self._failure = ProtocolError(
                f"{self._stream.link.name} sends datagrams {identifier:02X}, which are not those it is set to"
            )
        return clusters is not None and self._failure is None

    def _numbered(self, samples: NDArray[np.void], index: SampleIndex, now: float) -> list[RateBlock]:
        counts = triple(samples, "rate")
        integrates = self.configuration.gyro is Output.INTEGRAL
        if integrates:
            before = counts[:1] if self._integral is None else self._integral
            differences = counts - np.concatenate((before, counts[:-1]))
            if self._integral is None:  # the first one only says where the integral stands
                samples, differences = samples[1:], differences[1:]
            self._integral = counts[-1:]
            counts = (differences + _TURN // 2) % _TURN - _TURN // 2
            if not len(samples):
                return []
        expected = index.next_index
        numbered = index.number(samples["counter"], now, damaged=self._stream.damaged())
        where, status = numbered.index, GYRO_STATUS[samples["rate_status"]]
        unsure = None if numbered.unsure is None else int(where[numbered.unsure])
        if integrates:  # a difference over a gap is no sample
            whole = np.diff(where, prepend=expected - 1) == 1
            samples, counts, where, status = samples[whole], counts[whole], where[whole], status[whole]
        blocks = []
        for part in cut(where, status, longest=round(LONGEST_BLOCK * self.sample_rate)):
            first = int(where[part.start])
            flags = GyroStatus(int(status[part.start]))
            if unsure is not None and expected <= unsure <= first:
                flags |= GyroStatus.OVERRUN
            blocks.append(self._block(samples[part], counts[part], first, flags, first - expected, now))
            expected = int(where[part.stop - 1]) + 1
        return blocks

    def _block(
        self,
        samples: NDArray[np.void],
        counts: NDArray[np.int32],
        first: int,
        status: GyroStatus,
        n_lost: int,
        now: float,
    ) -> RateBlock:
        found = self.configuration
        temperature = None
        if Cluster.TEMPERATURE in found.clusters:
            temperature = float(samples["rate_temperature"].mean()) / 256
        return RateBlock(
            first_index=first,
            device_time=first / self.sample_rate,
            arrival_time=now,
            counts=counts,
            rate_lsb=found.rate_lsb,
            temperature=temperature,
            specific_force=self._specific_force(samples),
            status=status,
            n_lost=n_lost,
        )

    def _specific_force(self, samples: NDArray[np.void]) -> tuple[float, float, float] | None:
        """Return the mean of the accelerometers, or else of the inclinometers, in m/s^2, None if it is not sound."""
        found = self.configuration
        for cluster, name, lsb in (
            (Cluster.ACCELERATION, "acceleration", found.acceleration_lsb),
            (Cluster.INCLINATION, "inclination", found.inclination_lsb),
        ):
            if cluster in found.clusters and lsb is not None and not samples[f"{name}_status"].any():
                x, y, z = (triple(samples, name).mean(axis=0) * lsb).tolist()
                return x, y, z
        return None
