"""A KVH gyro of one or three axes: it streams by itself, and is asked what its numbers mean before they are used."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.api import ByteLink, Clock, DeviceIdentity, GyroStatus, RateBlock, SelfTest
from drivers.errors import DeviceError, DeviceFaultError, DeviceTimeoutError, ProtocolError
from drivers.frame_stream import FrameStream
from drivers.kvh.settings import Found, configure, leave
from drivers.protocol.crc_frames import CrcFrameCounts, Frames
from drivers.protocol.kvh import (
    ACCELEROMETERS_VALID,
    FORMATS,
    GYROS_VALID,
    SEQUENCE_SPAN,
    decode_messages,
    decoder,
    find_test,
    wire_size,
)
from drivers.sample_reader import SampleFormat, SampleReader, Samples, Vector

STANDARD_GRAVITY = 9.80665  # m/s^2
_LOOK_TIME = 3.0  # s in which some axis has to become valid
_LEAVE_TIME = 1.0  # s without a message, after which the unit is told once more to leave configuration mode
_LOOK_MESSAGES = 10  # in which every axis that there is must be valid once
_TEST_TIME = 1.0  # s
_TEST_ATTEMPTS = 2


class KvhGyro:
    """A DSP-1750, DSP-1760, 1750 or 1775; a `drivers.api.Gyro`.

    Parameters
    ----------
    link
        The open line to the unit; the driver closes it.
    clock
        The clock that `link` notifies.
    axis
        The one axis to use, ``x``, ``y`` or ``z``; empty for all that the unit has.
    data_rate
        Samples a second that it must send, None for any.
    may_set
        Whether it may be set to that.
    """

    def __init__(
        self, link: ByteLink, clock: Clock, *, axis: str = "", data_rate: int | None = None, may_set: bool = False
    ) -> None:
        self._clock = clock
        self._stream = FrameStream(link, clock, decoder(), what="KVH gyro", sign=_tells_of_test)
        self._n_tests = 0
        self._reader = SampleReader(self._stream, clock)
        self._axis = axis
        self._data_rate = data_rate
        self._may_set = may_set
        self._found: Found | None = None
        self._axes: list[int] = []

    @property
    def sample_rate(self) -> float:
        """Samples a second, known after `connect`."""
        return float(self._found.units.data_rate) if self._found else 0.0

    @property
    def n_axes(self) -> int:
        """How many input axes a sample holds, 1 or 3, known after `connect`."""
        return len(self._axes)

    @property
    def found(self) -> Found:
        """What the unit says of itself, known after `connect`."""
        if self._found is None:
            raise ProtocolError(f"{self._stream.link.name} has not been connected")
        return self._found

    @property
    def link_counts(self) -> CrcFrameCounts:
        """What has come over the link, and what of it could not be used."""
        return self._stream.counts

    @property
    def troubles(self) -> dict[str, int]:
        """What has gone wrong on the link and been made up for."""
        return self._stream.troubles

    def connect(self) -> DeviceIdentity:
        """Ask the unit in configuration mode what it is set to, and look which of its axes are there.

        Raises
        ------
        DeviceTimeoutError
            If nothing answers.
        ProtocolError
            If it is no such gyro, or sends what cannot be read.
        DeviceFaultError
            If it is not set to what is asked for, or has other axes.
        """
        self._reader.reset()
        self._found = configure(self._stream, data_rate=self._data_rate, may_set=self._may_set)
        valid, n_accelerometers = self._look()
        self._axes = self._choose(valid)
        kind = "1750 or 1775" if n_accelerometers else "DSP-1750 or DSP-1760"
        return DeviceIdentity(
            kind="gyro",
            model=f"KVH {kind}",
            serial_number=self._found.serial_number,
            protocol=f"KVH format {self._found.form}",
        )

    def self_test(self) -> SelfTest:
        """Ask for the built-in test; of a unit that has none, look at what its messages say of themselves."""
        for _ in range(_TEST_ATTEMPTS):
            self._stream.link.write(b"?BIT\r\n")
            _, failures = self._stream.hear(find_test, patience=_TEST_TIME)
            if failures is not None:
                return SelfTest(failures)
        valid, _ = self._look()
        return SelfTest(tuple(f"gyro {'xyz'[axis]} is not valid" for axis in self._axes if axis not in valid))

    def start(self) -> None:
        """Begin to count samples at 0, with the first that comes from now on."""
        if self._reader.under_way:
            return
        units, size = self.found.units, wire_size(self.found.form)
        self._stream.drain(bytes_per_second=units.data_rate * size)
        self._n_tests = self._stream.n_signs
        form = SampleFormat(
            decode=self._decode,
            beside=self._beside,
            frame_size=size,
            sample_rate=units.data_rate,
            rate_lsb=units.rate_lsb,
            span=SEQUENCE_SPAN,
        )
        self._reader.begin(form)

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
            If it sends another format than it said.
        """
        return self._reader.read()

    def stop(self) -> None:
        """Take no more samples; the unit goes on sending. What was sent before can still be read."""
        self._reader.end()

    def close(self) -> None:
        """Release the link; the unit goes on sending."""
        self._reader.reset()
        self._stream.link.close()

    def _look(self) -> tuple[list[int], int]:
        """Return which gyros have been valid in some messages, and how many of these had valid accelerometers."""
        deadline = self._clock.now() + max(_LOOK_TIME, 3 * _LOOK_MESSAGES / self.sample_rate)
        leave_at = self._clock.now() + max(_LEAVE_TIME, 2 / self.sample_rate)
        statuses: list[int] = []
        while self._clock.now() < deadline:
            for frames in self._stream.take():
                statuses += decode_messages(frames)["status"].tolist()
            gyros = {axis for status in statuses for axis in range(3) if status & GYROS_VALID[axis]}
            if gyros and len(statuses) >= _LOOK_MESSAGES:
                return sorted(gyros), sum(status & ACCELEROMETERS_VALID == ACCELEROMETERS_VALID for status in statuses)
            if not statuses and self._clock.now() >= leave_at:
                leave(self._stream)
                leave_at = deadline
            self._clock.wait(min(leave_at, deadline))
        if statuses:
            raise DeviceFaultError(f"{self._stream.link.name} says of none of its gyros that it is valid")
        raise DeviceTimeoutError(f"{self._stream.link.name} has sent no message after it was asked what it is set to")

    def _choose(self, valid: list[int]) -> list[int]:
        names = ", ".join("xyz"[axis] for axis in valid)
        if self._axis:
            if "xyz".index(self._axis) not in valid:
                raise DeviceFaultError(f"{self._stream.link.name} has no valid gyro {self._axis}, only {names}")
            return ["xyz".index(self._axis)]
        if len(valid) == 2:
            raise DeviceFaultError(f"{self._stream.link.name} has gyros {names}: say which one with axis = 'x'")
        return valid

    def _decode(self, frames: list[Frames]) -> tuple[Samples | None, DeviceError | None]:
        """Return the samples in messages, up to what is wrong."""
        form = self.found.form
        runs = [decode_messages(run) for run in frames if FORMATS[run.header] == form]
        failure: DeviceError | None = None
        if len(runs) < len(frames):
            failure = ProtocolError(
                f"{self._stream.link.name} sends another format than {form}, which it said it sends"
            )
        if self._stream.n_signs > self._n_tests:
            failure = DeviceFaultError(f"{self._stream.link.name} was reset: it tells how its power-on test went")
        if not runs:
            return None, failure
        messages = np.concatenate(runs) if len(runs) > 1 else runs[0]
        counts = messages["rotation"][:, self._axes].astype(np.float32)
        status = self._status(messages, counts)
        return Samples(messages, messages["sequence"] % SEQUENCE_SPAN, counts, status), failure

    def _status(self, messages: NDArray[np.void], counts: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Return the status of each message; numbers that are none become 0, in place."""
        wanted = sum(GYROS_VALID[axis] for axis in self._axes)
        wrong = messages["status"] & wanted != wanted
        finite = np.isfinite(counts).all(axis=1)
        counts[~finite] = 0.0
        return np.where(wrong | ~finite, GyroStatus.SENSOR_FAULT, GyroStatus.OK).astype(np.uint8)

    def _beside(self, messages: NDArray[np.void]) -> tuple[float, Vector | None]:
        """Return temperature and specific force."""
        return self.found.units.celsius(float(messages["temperature"].mean())), _specific_force(messages)


def _tells_of_test(heard: bytes) -> bool:
    return find_test(heard) is not None


def _specific_force(messages: NDArray[np.void]) -> Vector | None:
    """Return the mean of the accelerometers in m/s^2, None if there are none or they are not valid."""
    if (messages["status"] & ACCELEROMETERS_VALID != ACCELEROMETERS_VALID).any():
        return None
    x, y, z = (messages["acceleration"].astype(np.float64).mean(axis=0) * STANDARD_GRAVITY).tolist()
    return x, y, z
