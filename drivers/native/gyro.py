"""The native gyro: session, configuration, and SAMPLES frames as blocks of rate."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from construct import Container
from numpy.typing import NDArray

from drivers.api import ByteLink, Clock, DeviceIdentity, GyroStatus, RateBlock, SelfTest
from drivers.errors import DeviceError, DeviceFaultError, DeviceTimeoutError, ProtocolError
from drivers.native.self_test import run_self_test
from drivers.native.session import LinkCounts, Session, random_session
from drivers.protocol.native import (
    ANGLE_LSB,
    RATE_LSB,
    TEMPERATURE_LSB,
    US_PER_S,
    DeviceKind,
    MessageType,
    decode_samples,
)

MAX_SILENCE = 1.0  # s, or three blocks if that is longer
MAX_BLOCK_SAMPLES = {1: 119, 3: 39}  # by axes: what a frame of 512 bytes holds
_INDEX_SPAN = 2**32
_KNOWN_STATUS = sum(GyroStatus)
_HEAD = ["first_index", "device_time_us", "status", "temperature", "overrun_count", "tilt_x", "tilt_y"]


class NativeGyro:
    """A gyro that speaks the native protocol; a `drivers.api.Gyro`.

    Parameters
    ----------
    link
        The open line to the gyro; the driver closes it.
    clock
        The clock that `link` notifies.
    sample_rate
        Samples a second to ask for, None to leave it.
    block_duration
        Length of a block to ask for, s, None to leave it. The longest that a frame holds if that is shorter.
    draw_session
        Draws session numbers.
    """

    def __init__(
        self,
        link: ByteLink,
        clock: Clock,
        *,
        sample_rate: float | None = None,
        block_duration: float | None = None,
        draw_session: Callable[[], int] = random_session,
    ) -> None:
        self._clock = clock
        self._session = Session(link, clock, kind=DeviceKind.GYRO, draw_session=draw_session)
        self._wanted_rate_millihz = round((sample_rate or 0.0) * 1000)
        self._wanted_block = block_duration
        self._sample_rate = 0.0
        self._range = 0.0
        self._n_axes = 0
        self._max_silence = MAX_SILENCE
        self._streaming = False
        self._next_index = 0
        self._last_time_us = -1
        self._overrun_count = 0

    @property
    def sample_rate(self) -> float:
        """Samples a second, known after `connect`."""
        return self._sample_rate

    @property
    def n_axes(self) -> int:
        """How many input axes a sample holds, 1 or 3, known after `connect`."""
        return self._n_axes

    @property
    def measuring_range(self) -> float:
        """Greatest rate of either sign in rad/s, known after `connect`."""
        return self._range

    @property
    def overrun_count(self) -> int:
        """Samples that the device itself reports as lost since the stream's start."""
        return self._overrun_count

    @property
    def link_counts(self) -> LinkCounts:
        """What has come over the link that could not be used."""
        return self._session.counts

    @property
    def troubles(self) -> dict[str, int]:
        """What has gone wrong on the link and been made up for."""
        return self._session.troubles

    def connect(self) -> DeviceIdentity:
        """Open a session: identify, check the protocol version, configure.

        Raises
        ------
        DeviceTimeoutError
            If nothing answers.
        ProtocolError
            If it is no gyro of this protocol version.
        DeviceFaultError
            If the gyro does not support the sample rate or block size asked for.
        """
        self._streaming = False
        identity = self._session.open()
        config = self._configure()
        self._sample_rate = config.sample_rate_millihz / 1000
        self._n_axes = config.n_axes
        self._range = config.range_dph * RATE_LSB * 2**10
        self._max_silence = max(MAX_SILENCE, 3 * config.block_samples / self._sample_rate)
        return identity

    def _configure(self) -> Container:
        """Ask for the sample rate and the block length wanted; return the configuration in force."""
        if self._wanted_rate_millihz:
            config = self._set(sample_rate_millihz=self._wanted_rate_millihz, block_samples=0)
        else:
            config = self._checked(self._session.request(MessageType.GET_CONFIG, reply=MessageType.GYRO_CONFIG))
        if self._wanted_block is None:
            return config
        wanted = round(self._wanted_block * config.sample_rate_millihz / 1000)
        block_samples = max(1, min(wanted, MAX_BLOCK_SAMPLES[config.n_axes]))
        return self._set(sample_rate_millihz=0, block_samples=block_samples)

    def _set(self, **fields: int) -> Container:
        return self._checked(
            self._session.request(MessageType.SET_CONFIG_GYRO, reply=MessageType.GYRO_CONFIG, **fields)
        )

    def _checked(self, config: Container) -> Container:
        if config.n_axes not in {1, 3} or not config.sample_rate_millihz or not config.block_samples:
            raise ProtocolError(
                f"{self._session.name} reports an impossible configuration: {config.n_axes} axes, "
                f"{config.sample_rate_millihz} mHz, {config.block_samples} samples a block"
            )
        return config

    def self_test(self) -> SelfTest:
        """Run the device's self-test, up to 3 s."""
        return run_self_test(self._session)

    def start(self) -> None:
        """Start the sample stream; the index of its first sample is 0. A stream under way goes on."""
        if self._streaming:
            return
        self._session.expect_stream()
        self._next_index, self._last_time_us, self._overrun_count = 0, -1, 0
        self._session.request(MessageType.STREAM_START)
        self._streaming = True

    def read(self) -> list[RateBlock]:
        """Return the blocks that have arrived, oldest first, ``[]`` if none. Never waits.

        Raises
        ------
        LinkError
            If the link is lost.
        DeviceTimeoutError
            If a started stream has fallen silent.
        DeviceFaultError
            If the sample index went back: the device was reset.
        """
        bodies = self._session.take_stream()
        if bodies:
            now = self._clock.now()
            return [block for records in decode_samples(bodies) for block in self._blocks(records, now)]
        if self._streaming and self._session.silence > self._max_silence:
            raise DeviceTimeoutError(
                f"{self._session.name} has sent no samples for {self._session.silence:.1f} s: was it reset or cut off?"
            )
        return []

    def stop(self) -> None:
        """Stop the sample stream. What was sent before can still be read."""
        self._session.request(MessageType.STREAM_STOP)
        self._streaming = False

    def close(self) -> None:
        """Stop the stream if the link still lives, and release it."""
        try:
            if self._streaming:
                self._session.request(MessageType.STREAM_STOP, attempts=2)
        except DeviceError:
            pass  # the link is on its way out; an unread gyro does no harm
        finally:
            self._streaming = False
            self._session.close()

    def _blocks(self, records: NDArray[np.void], now: float) -> list[RateBlock]:
        """Return records of equal form as blocks."""
        counts = records["rate"]
        if counts.shape[2] != self._n_axes:
            raise ProtocolError(f"{self._session.name} sent {counts.shape[2]} axes, {self._n_axes} were announced")
        blocks = []
        for head, rates in zip(records[_HEAD].tolist(), counts, strict=True):
            first_index, time_us, status, temperature, overrun_count, tilt_x, tilt_y = head
            n_lost = self._advance(first_index, time_us, len(rates))
            if n_lost is None:
                continue
            self._overrun_count = overrun_count
            blocks.append(
                RateBlock(
                    first_index=self._next_index - len(rates),
                    device_time=time_us / US_PER_S,
                    arrival_time=now,
                    counts=rates,
                    rate_lsb=RATE_LSB,
                    temperature=temperature * TEMPERATURE_LSB,
                    tilt=(tilt_x * ANGLE_LSB, tilt_y * ANGLE_LSB),
                    status=GyroStatus(status & _KNOWN_STATUS),
                    n_lost=n_lost,
                )
            )
        return blocks

    def _advance(self, first_index: int, time_us: int, n_samples: int) -> int | None:
        """Return how many samples are missing before a block, None if the block came twice."""
        gap = (first_index - self._next_index) % _INDEX_SPAN
        if gap < _INDEX_SPAN // 2:
            self._next_index += gap + n_samples
            self._last_time_us = time_us
            return gap
        if time_us == self._last_time_us:
            return None
        raise DeviceFaultError(
            f"{self._session.name} was reset: its sample index went back "
            f"from {self._next_index % _INDEX_SPAN} to {first_index}"
        )
