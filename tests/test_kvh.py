"""KVH's gyros: messages of real units and of the manual, the firmware, and the driver against it."""

from __future__ import annotations

import struct
from collections.abc import Callable
from itertools import pairwise
from math import pi, radians
from typing import Any

import numpy as np
import pytest
from fake_boards import FakeGyroBoard
from hypothesis import given, settings
from hypothesis import strategies as st
from streaming import TriadBoard, Wire

from drivers.api import Gyro, GyroStatus, RateBlock
from drivers.errors import DeviceFaultError, DeviceTimeoutError, LinkError, ProtocolError
from drivers.kvh import KvhGyro, open_gyro
from drivers.kvh.recognise import RECOGNISER
from drivers.protocol.crc_frames import checksum
from drivers.protocol.kvh import Units, decode_messages, decoder, find_test, speaks_format_c
from drivers.transport.virtual import VirtualClock, VirtualLink
from sim_device.bench import SimBench
from sim_device.firmware.crc32 import crc32
from sim_device.firmware.kvh import KvhDevice

#: Of a real 1750, from https://github.com/TRECVT/ros_kvh1750; the last one damaged on purpose.
GOOD = (
    bytes.fromhex("fe81ff553b041f78b9b96613ba234b38bb7c0410b8def4803f7f4b7b701f001df12fb6ee"),
    bytes.fromhex("fe81ff55b3d0bbe732193ef430ac19a5ba8f78d63a2905943f7ecbd47768001dadc5f651"),
)
BAD = bytes.fromhex("fe81ff55b46b86c6b44f5b83b4106d09bb713cb7bbabd9143f7e319a7769001d95bbdb4f")
#: The example of the 1775's manual, section 5.2.1.
MANUAL = bytes.fromhex("fe81ff5537a96a6e38586c1fb75bf862bf803e78bb650d283b0a37ac773d00284bfa34d8")
DPH = radians(1 / 3600)


class SlowBoard(TriadBoard):
    """A triad at 100 Hz."""

    sample_rate_millihz = 100_000


class Rig:
    """A driver on an emulated unit."""

    def __init__(self, board: FakeGyroBoard | None = None, **options: Any) -> None:  # noqa: ANN401  # the driver's
        self.clock = VirtualClock()
        self.board = board or SlowBoard()
        self.device = KvhDevice(self.board)
        self.wire = Wire(self.device)
        self.gyro = KvhGyro(VirtualLink(self.wire, self.clock, name="rig"), self.clock, **options)

    def run(self, duration: float) -> list[RateBlock]:
        """Return the blocks of some time."""
        blocks, deadline = [], self.clock.now() + duration
        while self.clock.now() < deadline:
            blocks += self.gyro.read()
            self.clock.wait(min(deadline, self.clock.now() + 0.05))
        return blocks + self.gyro.read()

    def started(self) -> Rig:
        """Connect and start."""
        self.gyro.connect()
        self.gyro.start()
        return self


class TestGolden:
    """Bytes of real units and of the manual."""

    def test_two_good_ones_and_a_bad_one(self) -> None:
        """Two messages of a real unit decode to what its owner's program made of them, the damaged one is not taken."""
        reader = decoder()
        (frames,) = reader.feed(GOOD[0] + GOOD[1] + BAD)
        messages = decode_messages(frames)
        assert messages["status"].tolist() == [0x70, 0x77]
        assert messages["sequence"].tolist() == [31, 104]
        assert messages["temperature"].tolist() == [29, 29]
        assert np.allclose(
            messages["rotation"],
            [[2.0160358e-3, -3.53620009e-4, -6.22916501e-4], [-9.719934e-8, 8.920086e-9, 1.2521936e-9]],
            rtol=1e-7,
            atol=0,
        )
        assert np.allclose(
            messages["acceleration"],
            [[-3.84545699e-3, -1.06313266e-4, 0.997245491], [-1.0946046e-3, 6.4476696e-4, 0.99529767]],
            rtol=1e-7,
            atol=0,
        )
        assert reader.counts.n_bad_crc == 1
        assert checksum(BAD[:-4]) == crc32(BAD[:-4]) == 0x14DC0D3A

    def test_the_manual(self) -> None:
        """The manual's example decodes to the values printed there."""
        (frames,) = decoder().feed(MANUAL)
        message = decode_messages(frames)[0]
        assert message["rotation"].tolist() == pytest.approx([2.019593e-5, 5.159911e-5, -1.3111248e-5], rel=1e-6)
        assert (message["status"], message["sequence"], message["temperature"]) == (0x77, 61, 40)
        assert crc32(MANUAL[:-4]) == 0x4BFA34D8

    def test_format_b(self) -> None:
        """Format B has the time before the status."""
        body = bytes.fromhex("fe81ff56") + struct.pack(">6fIBBh", 1, -2, 3, 0, 0, 1, 123_456_789, 0x77, 127, -40)
        (frames,) = decoder().feed(body + checksum(body).to_bytes(4, "big"))
        message = decode_messages(frames)[0]
        assert message["rotation"].tolist() == [1, -2, 3]
        assert (message["time_us"], message["sequence"], message["temperature"]) == (123_456_789, 127, -40)

    def test_built_in_test(self) -> None:
        """The manual's message of a unit in order is found, bits that are not set are named, a wrong sum is nothing."""
        assert find_test(b"\xfe\x81" + bytes.fromhex("fe8100aa7f7f7f7f7f7f23")) == ()
        assert find_test(bytes.fromhex("fe8100aa777f7b7f7f7f17")) == (
            "built-in test, byte 0 bit 3",
            "built-in test, byte 2 bit 2",
        )
        assert find_test(bytes.fromhex("fe8100aa7f7f7f7f7f7f24")) is None

    @pytest.mark.parametrize(
        ("unit", "value", "celsius"), [("C", 29, 29.0), ("C_100", 2950, 29.5), ("F", 212, 100.0), ("F_100", 3200, 0.0)]
    )
    def test_temperature(self, unit: str, value: int, celsius: float) -> None:
        """Each unit of temperature becomes degrees Celsius."""
        assert Units(data_rate=1, temperature=unit).celsius(value) == pytest.approx(celsius)


class TestFirmware:
    """What the emulated unit sends, byte for byte."""

    def test_power_on(self) -> None:
        """It says how its test went, then sends a message each 10 ms, by itself."""
        board = SlowBoard()
        board.rates = [(36_864_000, -73_728_000, 0)]  # 10 and -20 deg/s
        board.force = (0, 0, 1_000_000)
        device = KvhDevice(board)
        assert (device.poll(0), device.next_due_us(), device.session) == (b"", 500_000, 0)
        said = device.poll(500_000)
        assert said[:11] == bytes.fromhex("fe8100aa7f7f7f7f7f7f23")
        body = bytes.fromhex("fe81ff55") + struct.pack(
            ">6fBBh", 10 * pi / 180 / 100, -20 * pi / 180 / 100, 0, 0, 0, 1, 0x77, 0, 36
        )
        assert said[11:] == body + checksum(body).to_bytes(4, "big")
        assert device.next_due_us() == 510_000
        assert device.poll(510_000)[29] == 1

    @pytest.mark.parametrize(
        ("asked", "told"),
        [
            (b"?is\r\n", b"IS,N25581846020021"), (b"?dr\n", b"DR,100"), (b"=rotfmt,rate\r", b"ROTFMT,RATE"),
            (b"=ROTUNITS,DEG\r\n", b"ROTUNITS,DEG"), (b"=tempunits,c_100\n", b"TEMPUNITS,C_100"),
            (b"=outputfmt,b\n", b"OUTPUTFMT,B"), (b"=dr,250\n", b"INVALID,=DR,250"), (b"hello\n", b"INVALID,HELLO"),
        ],
    )  # fmt: skip
    def test_configuration_mode(self, asked: bytes, told: bytes) -> None:
        """Text is answered in capitals, and no messages are sent meanwhile; the first two after it are not valid."""
        device = KvhDevice(SlowBoard())
        device.poll(500_000)
        device.feed(asked, 501_000)
        assert device.poll(501_000) == b""  # in normal mode it is not heard
        device.feed(b"=config,1\r\n", 502_000)
        assert device.poll(502_000) == b"CONFIG,1\r\n"
        device.feed(asked, 800_000)
        assert device.poll(800_000) == told + b"\r\n"
        assert device.next_due_us() is None
        device.feed(b"=config,0\r\n", 900_000)
        (frames,) = decoder().feed(device.poll(930_000))
        assert decode_messages(frames)["status"].tolist() == [0x70, 0x70, 0x77, 0x77]

    @given(st.lists(st.binary(max_size=30), max_size=10), st.booleans())
    def test_any_text(self, lines: list[bytes], configuring: bool) -> None:  # noqa: FBT001  # drawn
        """Whatever comes over the line, the unit lives, and streams when it is told to."""
        device = KvhDevice(SlowBoard())
        device.poll(500_000)
        for line in [b"=CONFIG,1\n"] * configuring + lines:
            device.feed(line + b"\r\n", 600_000)
            device.poll(600_000)
        device.feed(b"\n=CONFIG,0\n", 700_000)
        assert decoder().feed(device.poll(800_000))

    def test_a_full_line_loses_whole_messages(self) -> None:
        """What has no room is left out as a whole, and its number with it."""
        device = KvhDevice(SlowBoard())
        device.poll(500_000)
        assert len(device.poll(550_000, room=100)) == 72
        (frames,) = decoder().feed(device.poll(560_000))
        assert decode_messages(frames)["sequence"].tolist() == [6]

    def test_another_board(self) -> None:
        """A sample rate that no KVH gyro has is refused."""
        with pytest.raises(ValueError, match="3600 or 5000"):
            KvhDevice(TriadBoard())


class TestDriver:
    """The driver against the emulated unit in virtual time."""

    def test_is_a_gyro(self) -> None:
        """It is what the instrument needs."""
        gyro: Gyro = Rig().gyro
        assert gyro.n_axes == 0

    def test_identity(self) -> None:
        """It says who it is, as far as it tells."""
        rig = Rig()
        who = rig.gyro.connect()
        assert (who.model, who.serial_number, who.protocol) == ("KVH 1750 or 1775", "N25581846020021", "KVH format A")
        assert (rig.gyro.sample_rate, rig.gyro.n_axes) == (100.0, 3)
        assert rig.gyro.self_test().passed

    @pytest.mark.parametrize("form", ["A", "B"])
    @pytest.mark.parametrize("rotation", ["DELTA", "RATE"])
    @pytest.mark.parametrize("angle", ["RAD", "DEG"])
    def test_blocks(self, form: str, rotation: str, angle: str) -> None:
        """Rates, forces and temperatures arrive in SI, each sample once, however the unit is set."""
        rig = Rig()
        rig.device.output_format, rig.device.rotation_format, rig.device.rotation_units = form, rotation, angle
        rig.device.temperature_units = "F_100"
        blocks = rig.started().run(3.0)
        assert blocks[0].first_index == 0
        assert all(b.first_index == a.first_index + len(a.counts) for a, b in pairwise(blocks))
        assert sum(len(block.counts) for block in blocks) > 270
        assert {(block.status, block.n_lost) for block in blocks} == {(GyroStatus.OK, 0)}
        assert all(0 < len(block.counts) <= 25 for block in blocks)
        assert blocks[0].counts.dtype == np.float32
        rate = np.concatenate([block.rate for block in blocks])
        assert np.allclose(rate, np.array([65_700, -297_450, 193_275]) / 1024 * DPH, rtol=1e-6)
        assert blocks[0].specific_force == pytest.approx((-0.11660, -0.16658, 9.94227), abs=1e-4)
        assert blocks[0].temperature == pytest.approx(35.5, abs=0.01)
        assert blocks[1].device_time == blocks[1].first_index / 100

    def test_one_axis(self) -> None:
        """A unit of one gyro gives one axis, and no force without accelerometers."""
        board = FakeGyroBoard(1)
        rig = Rig(board)
        rig.device.accelerometers = False
        who = rig.gyro.connect()
        assert (who.model, rig.gyro.n_axes) == ("KVH DSP-1750 or DSP-1760", 1)
        rig.gyro.start()
        block = rig.run(1.0)[0]
        assert (block.counts.shape[1], block.specific_force) == (1, None)

    def test_the_axis_asked_for(self) -> None:
        """One axis of three can be had by itself; one that is not there is refused."""
        rig = Rig(axis="z").started()
        assert rig.gyro.n_axes == 1
        assert np.allclose(rig.run(0.5)[0].rate, 193_275 / 1024 * DPH, rtol=1e-6)
        rig = Rig(FakeGyroBoard(1), axis="z")
        rig.device.accelerometers = False
        with pytest.raises(DeviceFaultError, match="no valid gyro z, only x"):
            rig.gyro.connect()

    def test_two_axes(self) -> None:
        """Of two gyros one has to be chosen."""
        rig = Rig()
        rig.device._validity = lambda: 0x06  # type: ignore[method-assign]  # a unit of another make
        with pytest.raises(DeviceFaultError, match="gyros y, z: say which"):
            rig.gyro.connect()

    def test_invalid(self) -> None:
        """Messages that are not valid, or hold no number, make a block that must not be used."""
        rig = Rig().started()
        rig.run(0.5)
        rig.board.flags = 4
        blocks = rig.run(0.2)
        rig.board.flags = 0
        blocks += rig.run(0.5)
        assert sum(len(block.counts) for block in blocks if block.status == GyroStatus.SENSOR_FAULT) == 20
        rig.wire.damage = _with_number(float("nan"))
        (block,) = [block for block in rig.run(0.3) if block.status][:1]
        assert block.status == GyroStatus.SENSOR_FAULT
        assert not block.counts[:, 0].any()

    def test_start_ends_what_came_before(self) -> None:
        """However long the gyro was connected before, sample 0 is of the time of `start`."""
        rig = Rig()
        rig.gyro.connect()
        rig.clock.sleep_until(30.0)
        rig.board.rates = [(1024, 2048, 3072)]  # type: ignore[attr-defined]  # of the triad
        rig.gyro.start()
        assert np.allclose(rig.run(0.5)[0].rate[0] / DPH, [1, 2, 3])

    @settings(max_examples=20, deadline=None)
    @given(st.integers(0, 2**32), st.floats(0, 0.25))
    def test_lost_and_damaged_messages(self, seed: int, share: float) -> None:
        """Messages that are lost or damaged are counted, and every other sample has its right index."""
        rng = np.random.default_rng(seed)
        board = SlowBoard()
        board.rates = [(1024 * i, 0, 0) for i in range(4000)]
        rig = Rig(board)
        rig.device.rotation_format = "RATE"
        rig.started()

        def hurt(data: bytes) -> bytes:
            if not data or rng.random() >= share:
                return data
            return b"" if rng.random() < 0.5 else data[:9] + bytes([data[9] ^ 1]) + data[10:]

        rig.wire.damage = hurt
        n_lost = n = 0
        first: int | None = None
        for block in rig.run(6.0):
            values = np.rint(block.rate[:, 0] / DPH).astype(int).tolist()
            first = values[0] - block.first_index if first is None else first
            assert values == list(range(first + block.first_index, first + block.first_index + len(values)))
            n_lost += block.n_lost
            n += len(values)
        assert n + n_lost == block.first_index + len(block.counts)

    def test_a_gap_longer_than_the_sequence(self) -> None:
        """Two seconds without messages, in real time, are found by the time of arrival and flagged."""
        rig = Rig().started()
        rig.run(3.0)
        before = rig.clock.now()
        rig.gyro._reader._max_silence = 5.0
        rig.wire.damage = lambda _: b""
        rig.run(2.0)
        rig.wire.damage = bytes
        blocks = rig.run(1.0)
        flagged = [block for block in blocks if block.status & GyroStatus.OVERRUN]
        assert len(flagged) == 1
        assert abs(flagged[0].n_lost - 200) <= 1
        assert flagged[0].device_time > before - 3.0

    @pytest.mark.parametrize("word", [b"=CONFIG,0\r\n", b"?BIT\r\n"])
    def test_a_lost_word_is_said_again(self, monkeypatch: pytest.MonkeyPatch, word: bytes) -> None:
        """The first end of configuration mode, or question for the built-in test, is lost: it is found all the same."""
        board = SlowBoard()
        board.failures = 1
        rig = Rig(board)
        heard, feed = [], rig.device.feed

        def lose_the_first(data: bytes, now_us: int) -> None:
            heard.append(data)
            if data != word or heard.count(word) > 1:
                feed(data, now_us)

        monkeypatch.setattr(rig.device, "feed", lose_the_first)
        rig.gyro.connect()
        assert not rig.gyro.self_test().passed
        rig.gyro.start()
        assert rig.run(1.0)
        assert heard.count(word) == 2

    def test_silence_and_unplugging(self) -> None:
        """A unit that falls silent is a timeout; a cable that is pulled, a lost link."""
        rig = Rig().started()
        rig.wire.damage = lambda _: b""
        with pytest.raises(DeviceTimeoutError, match="no samples for 1"):
            rig.run(2.0)
        rig.wire.unplugged = True
        rig.clock.sleep_until(rig.clock.now() + 0.1)
        with pytest.raises(LinkError, match="unplugged"):
            rig.run(1.0)
        rig.gyro.close()

    def test_another_format(self) -> None:
        """A unit that is set anew while it is measured with is noticed."""
        rig = Rig().started()
        rig.run(0.5)
        rig.device.output_format = "B"
        with pytest.raises(ProtocolError, match="another format than A"):
            rig.run(1.0)

    def test_reset(self) -> None:
        """A unit that starts anew tells of its test, which is a fault."""
        rig = Rig().started()
        rig.run(1.0)
        began = rig.clock.now_us
        fresh = KvhDevice(rig.board)
        rig.wire.device = _Later(fresh, began)
        with pytest.raises(DeviceFaultError, match="was reset: it tells how its power-on test went"):
            rig.run(2.0)

    def test_stop(self) -> None:
        """What was sent before the stop can be read, nothing after it; a new start begins at 0."""
        rig = Rig().started()
        rig.run(0.3)
        rig.gyro.stop()
        rig.gyro.read()
        assert rig.run(1.0) == []
        rig.gyro.start()
        assert rig.run(0.5)[0].first_index == 0

    def test_self_test(self) -> None:
        """What the built-in test finds is named; a unit without one is judged by its validity."""
        rig = Rig()
        rig.gyro.connect()
        rig.board.failures = 4  # type: ignore[attr-defined]  # of the triad
        assert rig.gyro.self_test().failures == ("built-in test, byte 0 bit 2",)
        rig.wire.answers = False
        assert rig.gyro.self_test().passed

    def test_nobody_there(self) -> None:
        """A silent line, a line of noise, and one whose answers do not come are told apart."""
        rig = Rig()
        rig.wire.damage = lambda _: b""
        with pytest.raises(DeviceTimeoutError, match="silent"):
            rig.gyro.connect()
        rig.wire.damage = lambda data: bytes(byte ^ 0x55 for byte in data)
        with pytest.raises(ProtocolError, match="baud rate"):
            rig.gyro.connect()
        rig = Rig()
        rig.wire.answers = False
        with pytest.raises(DeviceTimeoutError, match="sends samples but does not answer =CONFIG,1"):
            rig.gyro.connect()

    def test_format_c(self) -> None:
        """Format C is recognised and refused with what to do, asked or only heard."""
        rig = Rig()
        rig.device.output_format = "C"
        with pytest.raises(ProtocolError, match=r"format C, which is not read here: .*=OUTPUTFMT,A"):
            rig.gyro.connect()
        body = bytes.fromhex("fe81ff57") + struct.pack(">7fBB", 1, 2, 3, 0, 0, 1, 25.0, 0x77, 5)
        message = body + crc32(body).to_bytes(4, "big")
        assert speaks_format_c(b"\xfe" + message + b"\xfe")
        assert not speaks_format_c(message[:-1] + b"\x00")
        rig = Rig()
        rig.wire.damage = lambda data: message if data else b""
        rig.wire.answers = False
        with pytest.raises(ProtocolError, match="format C"):
            rig.gyro.connect()

    def test_sample_rate(self) -> None:
        """Another sample rate is refused, or asked for where that is allowed."""
        with pytest.raises(
            DeviceFaultError, match=r"sends 100 samples a second, 250 are asked for: .*configure = true"
        ):
            Rig(data_rate=250).gyro.connect()
        with pytest.raises(DeviceFaultError, match="refuses =DR,250"):
            Rig(data_rate=250, may_set=True).gyro.connect()
        rig = Rig(data_rate=100, may_set=True).started()
        assert rig.run(0.5)

    @pytest.mark.parametrize(("options", "said"), [({"sample_rate": 300}, "not 300"), ({"axis": "w"}, "x, y or z")])
    def test_senseless_options(self, options: dict[str, Any], said: str) -> None:
        """What no unit has is refused before the port is opened."""
        with pytest.raises(ValueError, match=said):
            open_gyro("/dev/nonexistent", VirtualClock(), **options)


class TestRecogniser:
    """Who is on a line, from what is heard."""

    def test_heard(self) -> None:
        """One good message is proof; noise and half messages are none."""
        who = RECOGNISER.recognise(GOOD[0][5:] + GOOD[1])
        assert who is not None
        assert (who.model, who.protocol) == ("KVH 1750 or 1775", "KVH format A")
        assert RECOGNISER.recognise(GOOD[1][5:] + BAD) is None
        assert RECOGNISER.recognise(np.random.default_rng(1).bytes(100_000)) is None
        body = bytes.fromhex("fe81ff57") + struct.pack(">7fBB", 1, 2, 3, 0, 0, 1, 25.0, 0x77, 5)
        third = RECOGNISER.recognise(body + crc32(body).to_bytes(4, "big"))
        assert third is not None
        assert "C, which is not read" in third.protocol

    def test_bench(self) -> None:
        """The emulated bench can hold one; its noise is the data sheet's: 0.012 deg per root hour."""
        bench = SimBench(gyro="kvh", seed=1, azimuth=radians(147), latitude=radians(-33))
        clock = VirtualClock()
        gyro = KvhGyro(VirtualLink(bench.gyro, clock), clock)
        gyro.connect()
        gyro.start()
        blocks = []
        while clock.now() < 20:
            blocks += gyro.read()
            clock.wait(clock.now() + 0.2)
        noise = np.concatenate([block.rate for block in blocks[5:]]).std(axis=0) / DPH
        assert np.allclose(noise, 0.012 * 60 * 100**0.5, rtol=0.1)


class _Later:
    """A device that was switched on at an instant."""

    session = seen_time_us = 0
    told_time_us = -1
    testing = False

    def __init__(self, device: KvhDevice, began_us: int) -> None:
        self.device = device
        self.began_us = began_us

    def feed(self, data: bytes, now_us: int) -> None:
        """Pass on, in the device's time."""
        self.device.feed(data, now_us - self.began_us)

    def poll(self, now_us: int, room: int | None = None) -> bytes:
        """Pass on, in the device's time."""
        return self.device.poll(now_us - self.began_us, room)

    def next_due_us(self) -> int | None:
        """Pass on, in the world's time."""
        due = self.device.next_due_us()
        return None if due is None else due + self.began_us


def _with_number(number: float) -> Callable[[bytes], bytes]:
    """Return what puts a number in the place of the first rotation of messages of format A, with a good checksum."""

    def put(data: bytes) -> bytes:
        if not data:
            return data
        body = data[:4] + struct.pack(">f", number) + data[8:32]
        return body + crc32(body).to_bytes(4, "big")

    return put
