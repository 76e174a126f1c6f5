"""The gyro on a CAN bus: one sample a PDO, as blocks of rate. See ``docs/canopen.md``, section 3."""

from __future__ import annotations

from drivers.api import Clock, DeviceIdentity, FrameLink, RateBlock, SelfTest
from drivers.canopen.identity import identify, run_self_test
from drivers.canopen.node import HEARTBEAT_MS, MAX_SILENCE, OPERATIONAL, Node, load_dictionary
from drivers.canopen.pdo import PdoCodec
from drivers.canopen_gyro.samples import SampleAssembler, SampleOrderError
from drivers.errors import DeviceError, DeviceFaultError, DeviceTimeoutError, LinkError, ProtocolError
from drivers.protocol.native import RATE_LSB

EDS = "gyro.eds"
LONGEST_PAUSE = 1.0  # s without samples, or five blocks if that is longer
MAX_BURST = 255  # samples
BLOCK_TIME = 0.2  # s, of a gyro that sends its samples in shorter bursts
IDENTIFIERS = (0x080, 0x180, 0x280, 0x380, 0x480, 0x500, 0x580, 0x700)  #: to which the node's number is added

_SAMPLE_RATE, _RANGE, _N_AXES, _BURST, _SLOW_PERIOD, _STREAM = 0x2010, 0x2011, 0x2012, 0x2013, 0x2014, 0x2020
_RATE, _NUMBER, _STATUS = 0x2100, (0x2101, 0), (0x2102, 0)
_MARK_NUMBER, _MARK_TIME = (0x2103, 0), (0x2104, 0)
_TEMPERATURE, _TILT_X, _TILT_Y = (0x2105, 0), (0x2106, 1), (0x2106, 2)
_SEEN = (0x2110, 0)
_AXIS_PDOS = (1, 4, 5)
_NAMES = {0x5030: "SENSOR_FAULT"}
_HARMLESS = {0x8110, 0x8210}  # the sample numbers tell of lost ones; the host's PDOs are as long as they should be


class CanopenGyro:
    """A gyro on a CAN bus; a `drivers.api.Gyro`.

    Parameters
    ----------
    link
        To the bus, open at least for `IDENTIFIERS` of the node; the driver closes it.
    clock
        The clock that `link` notifies.
    node_id
        The gyro's number on the bus.
    sample_rate
        Samples a second to ask for, None to leave it.
    block_duration
        Length of a burst to ask for in s, None to leave it.
    max_silence
        Time without a heartbeat, s, after which the node counts as cut off.
    """

    def __init__(
        self,
        link: FrameLink,
        clock: Clock,
        node_id: int,
        *,
        sample_rate: float | None = None,
        block_duration: float | None = None,
        max_silence: float = MAX_SILENCE,
    ) -> None:
        self._clock = clock
        self._node = node = Node(link, clock, load_dictionary(EDS, node_id), title="gyro")
        node.max_silence = max_silence
        self._axis_codecs = [PdoCodec(node.remote.tpdo[number]) for number in _AXIS_PDOS]
        self._mark_codec, self._slow_codec = PdoCodec(node.remote.tpdo[2]), PdoCodec(node.remote.tpdo[3])
        self._seen_codec = PdoCodec(node.remote.rpdo[1])
        node.collect(*(codec.cob_id for codec in (*self._axis_codecs, self._mark_codec, self._slow_codec)))
        node.duty = self._acknowledge
        self._wanted_rate_millihz = round((sample_rate or 0.0) * 1000)
        self._wanted_block = block_duration
        self._sample_rate = self._range = 0.0
        self._n_axes = self._burst = self._block_samples = 0
        self._assembler = SampleAssembler(1, 1.0, 1)
        self._streaming = self._connected = False
        self._n_acknowledged = 0
        self._heard_at = 0.0
        self._failure: DeviceError | None = None

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
    def n_malformed(self) -> int:
        """Frames with the node's identifiers that were of another length than their own."""
        return self._node.n_malformed

    @property
    def troubles(self) -> dict[str, int]:
        """What has gone wrong with the node and on the bus, which others share, and been made up for."""
        return {**self._node.troubles, "errors on the bus": self._node.bus.n_errors}

    def connect(self) -> DeviceIdentity:
        """Stop the node, check what it is, configure it, and start it.

        Raises
        ------
        DeviceTimeoutError
            If the node does not answer.
        ProtocolError
            If it is no gyro of this protocol, or two nodes have its number.
        DeviceFaultError
            If it does not support the sample rate or burst asked for.
        """
        node = self._node
        self._streaming = self._connected = False
        self._failure = None
        node.order("PRE-OPERATIONAL")  # which stops a stream
        who = identify(node, "gyro")
        self._configure()
        node.objects.write(0x1017, 0, HEARTBEAT_MS, verify=True)
        node.command("OPERATIONAL", OPERATIONAL)
        node.emergencies.clear()
        node.watch()
        self._connected = True
        return who

    def self_test(self) -> SelfTest:
        """Run the device's self-test, up to 3 s."""
        return run_self_test(self._node, self._clock)

    def start(self) -> None:
        """Start the sample stream; the index of its first sample is 0. A stream under way goes on."""
        if self._streaming:
            return
        if not self._connected:
            raise LinkError(f"{self._node.name} cannot start: connect first")
        self._node.service()
        for codec in self._axis_codecs:
            self._node.take(codec.cob_id)  # of a stream before
        self._assembler = SampleAssembler(self._n_axes, self._sample_rate, self._block_samples)
        self._n_acknowledged = 0
        self._node.objects.write(_STREAM, 0, 1)
        self._heard_at = self._clock.now()
        self._streaming = True

    def read(self) -> list[RateBlock]:
        """Return the blocks that have arrived, oldest first, ``[]`` if none. Never waits.

        Raises
        ------
        LinkError
            If the bus is lost.
        DeviceTimeoutError
            If the heartbeat of the node, or a started stream, has fallen silent.
        DeviceFaultError
            If the gyro reports a fault, was reset, or sends numbers that one gyro cannot send.
        """
        if self._failure is not None:
            raise self._failure
        self._node.service()
        try:
            self._take_in()
            self._check()
        except DeviceError as failure:
            self._failure = failure
        blocks = self._assembler.blocks(self._clock.now(), flush=not self._streaming)
        if self._failure is not None and not blocks:
            raise self._failure
        return blocks

    def stop(self) -> None:
        """Stop the sample stream. What was sent before can still be read."""
        self._node.objects.write(_STREAM, 0, 0)
        self._streaming = False

    def close(self) -> None:
        """Stop the stream if the bus still lives, and release it."""
        try:
            if self._streaming:
                self._node.objects.write(_STREAM, 0, 0)
            if self._connected:
                self._node.order("PRE-OPERATIONAL")
        except DeviceError:
            pass  # the link is on its way out; an unread gyro does no harm
        finally:
            self._streaming = self._connected = False
            self._node.close()

    def _configure(self) -> None:
        """Bring the configuration to what was asked for, and read what is in force."""
        objects = self._node.objects
        if self._wanted_rate_millihz:
            objects.write(_SAMPLE_RATE, 0, self._wanted_rate_millihz, verify=True)
        rate, self._n_axes = objects.read(_SAMPLE_RATE), objects.read(_N_AXES)
        if self._wanted_block is not None:
            objects.write(_BURST, 0, max(1, min(MAX_BURST, round(self._wanted_block * rate / 1000))), verify=True)
        self._burst = burst = objects.read(_BURST)
        if self._n_axes not in {1, 3} or not rate or not burst:
            raise ProtocolError(
                f"{objects.name} reports an impossible configuration: {self._n_axes} axes, {rate} mHz, "
                f"{burst} samples a burst"
            )
        self._sample_rate = rate / 1000
        self._range = objects.read(_RANGE) * RATE_LSB * 2**10
        usual = round(BLOCK_TIME * self._sample_rate)
        self._block_samples = burst if 2 * burst > usual else max(1, usual)
        objects.write(_SLOW_PERIOD, 0, max(100, round(1000 * self._block_samples / self._sample_rate)), verify=True)

    def _take_in(self) -> None:
        """Take in the PDOs that have come. Raises DeviceFaultError if one gyro cannot have sent them."""
        node = self._node
        arrived = [node.take_values(codec) for codec in self._axis_codecs]
        for axis, values in enumerate(arrived[: self._n_axes], 1):
            if not values:
                continue
            self._heard_at = self._clock.now()
            try:
                self._assembler.add(axis - 1, values[_NUMBER], values[_RATE, axis], values[_STATUS])
            except SampleOrderError as error:
                raise DeviceFaultError(f"{node.name} was reset, or another node has its number: {error}") from None
        for mark in _rows(node, self._mark_codec, _MARK_NUMBER, _MARK_TIME):
            self._assembler.mark(*mark)
        for slow in _rows(node, self._slow_codec, _TEMPERATURE, _TILT_X, _TILT_Y):
            self._assembler.note(*slow)

    def _check(self) -> None:
        """Raise what is wrong with the node."""
        node = self._node
        for emergency in node.emergencies:
            if emergency.code >> 8 and emergency.code not in _HARMLESS:
                name = _NAMES.get(emergency.code, emergency.get_desc())
                raise DeviceFaultError(f"{node.name} reports {name} (EMCY {emergency.code:04X})")
        node.emergencies.clear()
        node.check_alive()
        silence = self._clock.now() - self._heard_at
        if self._streaming and silence > max(LONGEST_PAUSE, 5 * self._block_samples / self._sample_rate):
            raise DeviceTimeoutError(f"{node.name} is alive but has sent no samples for {silence:.1f} s")

    def _acknowledge(self) -> None:
        """Tell the device what has been read, a burst at a time; so before anything new is looked at."""
        n_seen = self._assembler.n_seen
        if self._streaming and n_seen - self._n_acknowledged >= self._burst:
            self._n_acknowledged = n_seen
            self._node.send(self._seen_codec.cob_id, self._seen_codec.encode({_SEEN: n_seen}))


def _rows(node: Node, codec: PdoCodec, *keys: tuple[int, int]) -> list[tuple[int, ...]]:
    """Return the values of a PDO's objects in each frame that has come."""
    values = node.take_values(codec)
    return list(zip(*(values[key].tolist() for key in keys), strict=True)) if values else []
