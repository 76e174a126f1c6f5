"""The STIM300 as a gyro of three axes: it streams by itself, and is asked what it is before the stream is used."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.api import ByteLink, Clock, DeviceIdentity, GyroStatus, RateBlock, SelfTest
from drivers.errors import DeviceError, DeviceFaultError, ProtocolError
from drivers.frame_stream import FrameStream
from drivers.protocol.crc_frames import CrcFrameCounts, Frames
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
from drivers.sample_reader import BATCH_TIME, SampleFormat, SampleReader, Samples, Vector
from drivers.stim300.settings import Settings, apply

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
        self._reader = SampleReader(self._stream, clock)
        self._configuration: Configuration | None = None
        self._integral: NDArray[np.int32] | None = None

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

    @property
    def troubles(self) -> dict[str, int]:
        """What has gone wrong on the link and been made up for."""
        return self._stream.troubles

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
        self._reader.reset()
        part = parse_part_number(self._ask(b"N\r", PART_NUMBER)[0])
        serial = parse_serial_number(self._ask(b"I\r", SERIAL_NUMBER)[0])
        self._configuration = parse_configuration(self._ask(b"C\r", CONFIGURATION)[0])
        if self._settings.differs_from(self._configuration):
            apply(self._settings, self._stream)
            self._configuration = parse_configuration(self._ask(b"C\r", CONFIGURATION)[0])
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
            failures = parse_extended_error(self._ask(b"E\r", EXTENDED_ERROR)[0])
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
        if self._reader.under_way:
            return
        before, rate = self.configuration, round(self.sample_rate)
        answer, waiting = self._ask(b"C\r", CONFIGURATION)
        if parse_configuration(answer) != before:
            raise DeviceFaultError(f"{self._stream.link.name} has another configuration than when it was connected")
        self._integral = None
        form = SampleFormat(
            decode=self._decode,
            beside=self._beside,
            frame_size=_datagram_size(before),
            sample_rate=rate,
            rate_lsb=before.rate_lsb,
            span=COUNTER_SPAN,
            step=COUNTER_RATE // rate,
        )
        self._reader.begin(form, waiting=waiting)

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
        return self._reader.read()

    def stop(self) -> None:
        """Take no more samples; the unit goes on sending. What was sent before can still be read."""
        self._reader.end()

    def close(self) -> None:
        """Release the link; the unit goes on sending."""
        self._reader.reset()
        self._stream.link.close()

    def _ask(self, question: bytes, identifiers: tuple[int, int]) -> tuple[bytes, list[Frames]]:
        """Return the body of the answer, and what came after it."""
        answer, *after = self._stream.ask(question, tuple(bytes([code]) for code in identifiers))
        return answer.bodies[-1].tobytes(), after

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
        size = _datagram_size(found)
        if found.bit_rate and size * 10 * found.sample_rate > found.bit_rate:
            raise DeviceFaultError(
                f"{name} sends {size} bytes {found.sample_rate} times a second, too many for {found.bit_rate} bit/s: "
                "samples would be lost"
            )

    def _decode(self, frames: list[Frames]) -> tuple[Samples | None, DeviceError | None]:
        """Return the samples among the frames, up to what is wrong."""
        runs, failure = [], None
        for run in frames:
            failure = self._wrong(run.header[0])
            if failure is not None:
                break
            if run.header[0] in SAMPLE_IDS:
                runs.append(decode_samples(run))
        if not runs:
            return None, failure
        samples = np.concatenate(runs) if len(runs) > 1 else runs[0]
        counts = triple(samples, "rate")
        integrates = self.configuration.gyro is Output.INTEGRAL
        if integrates:
            samples, counts = self._differences(samples, counts)
            if not len(samples):
                return None, failure
        status = GYRO_STATUS[samples["rate_status"]]
        return Samples(samples, samples["counter"], counts, status, differences=integrates), failure

    def _wrong(self, identifier: int) -> DeviceError | None:
        """Return what is wrong with a datagram in the stream."""
        name = self._stream.link.name
        if identifier in {*PART_NUMBER, *SERIAL_NUMBER}:
            return DeviceFaultError(f"{name} was reset: it says again who it is")
        if SAMPLE_IDS.get(identifier, self.configuration.clusters) != self.configuration.clusters:
            return ProtocolError(f"{name} sends datagrams {identifier:02X}, which are not those it is set to")
        return None

    def _differences(
        self, samples: NDArray[np.void], counts: NDArray[np.int32]
    ) -> tuple[NDArray[np.void], NDArray[np.int32]]:
        """Return how far the integrated angles have gone; the very first only says where they stand."""
        before, self._integral = self._integral, counts[-1:]
        if before is None:
            before, samples, counts = counts[:1], samples[1:], counts[1:]
        gone = counts - np.concatenate((before, counts[:-1]))
        return samples, (gone + _TURN // 2) % _TURN - _TURN // 2

    def _beside(self, samples: NDArray[np.void]) -> tuple[float | None, Vector | None]:
        """Return temperature and specific force, where they are among what the unit sends."""
        temperature = None
        if Cluster.TEMPERATURE in self.configuration.clusters:
            temperature = float(samples["rate_temperature"].mean()) / 256
        return temperature, self._specific_force(samples)

    def _specific_force(self, samples: NDArray[np.void]) -> Vector | None:
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


def _datagram_size(found: Configuration) -> int:
    identifier = next(code for code, clusters in SAMPLE_IDS.items() if clusters == found.clusters)
    return wire_size(identifier, terminated=found.terminated)
