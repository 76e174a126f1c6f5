"""The STIM300: frames of a real unit, the data sheet's checksums, the firmware, and the driver against it."""

from __future__ import annotations

from itertools import pairwise
from math import radians
from typing import Any

import numpy as np
import pytest
from fake_boards import FakeGyroBoard
from hypothesis import given, settings
from hypothesis import strategies as st
from streaming import TriadBoard, Wire

from drivers.api import DAMAGED, REPEATED, Gyro, GyroStatus, RateBlock
from drivers.errors import DeviceFaultError, DeviceTimeoutError, LinkError, ProtocolError
from drivers.protocol.crc_frames import Frames, checksum
from drivers.protocol.stim300 import (
    SAMPLE_IDS,
    Cluster,
    Output,
    decode_samples,
    decoder,
    parse_configuration,
    parse_extended_error,
    parse_part_number,
    parse_serial_number,
    triple,
    wire_size,
)
from drivers.protocol.stim300_utility import Reply, crc8_of, encode_command, parse_replies
from drivers.stim300 import Stim300Gyro, open_gyro
from drivers.stim300.gyro import GYRO_STATUS
from drivers.stim300.recognise import RECOGNISER
from drivers.stim300.settings import Settings
from drivers.transport.virtual import VirtualClock, VirtualLink
from sim_device.bench import SimBench
from sim_device.firmware.crc32 import crc32
from sim_device.firmware.stim300 import ACCELERATION, INCLINATION, PPS, TEMPERATURE, Stim300Device
from sim_device.firmware.stim300_utility import crc8

#: A unit at rest, from https://github.com/geirhovland/stim300.
GOLDEN = bytes.fromhex(
    "af000124fffad600035b00ffe7a6ffdd36081c5200ff7e70feba0c3ffa1d0023a023c023a000"
    "2319230a231c00239523b6239500ffef0200e101fac64942c6"
)
#: Texts of the data sheet with their checksums.
CHECKED_TEXTS = {
    b"$isn,": 28, b"#isn,0,N2558184602002,": 32, b"#UTILITYMODE,": 234, b"$sm,4,": 115, b"#sm,0,4,": 213,
    b"$sgu,2,": 111, b"$sd,1,": 148, b"$xn,": 150, b"#,1,": 180,
}  # fmt: skip
#: Bytes of each datagram of samples, without CR LF.
LENGTHS = {
    0x90: 18, 0x91: 28, 0x92: 28, 0x93: 38, 0x94: 25, 0xA5: 42, 0xA6: 42, 0xA7: 59,
    0xF0: 22, 0xF1: 32, 0xF2: 32, 0xF3: 42, 0xF4: 29, 0xF5: 46, 0xF6: 46, 0xF7: 63,
    0x98: 22, 0x99: 32, 0x9A: 32, 0x9B: 42, 0x9C: 29, 0xAD: 46, 0xAE: 46, 0xAF: 63,
}  # fmt: skip
DPH = radians(1 / 3600)


def golden(identifier: int, data: str, *, end: str = "") -> bytes:
    """Return a datagram typed by hand."""
    body = bytes([identifier]) + bytes.fromhex(data)
    return body + checksum(body).to_bytes(4, "big") + bytes.fromhex(end)


def only(found: list[Frames]) -> Frames:
    """Return the only frames."""
    assert len(found) == 1
    return found[0]


class TestGolden:
    """Bytes of real units and of the data sheet."""

    def test_a_real_unit(self) -> None:
        """The datagram AF of a unit at rest decodes to the values that its owner printed."""
        sample = decode_samples(only(decoder().feed(GOLDEN)))
        assert (triple(sample, "rate") / 2**14).tolist() == [[0.017822265625, -0.0806884765625, 0.05242919921875]]
        assert np.allclose(triple(sample, "acceleration") / 2**19, [[-0.01189, -0.01699, 1.01383]], atol=5e-6)
        assert np.allclose(triple(sample, "inclination") / 2**22, [[-0.0079079, -0.0198946, 0.9996407]], atol=1e-7)
        assert (sample["rate_temperature"] / 256).tolist() == [[35.625, 35.75, 35.625]]
        assert (sample["inclination_temperature"] / 256).tolist() == [[0x2395 / 256, 0x23B6 / 256, 0x2395 / 256]]
        assert (sample["counter"][0], sample["latency_us"][0]) == (225, 506)

    def test_both_checksums_know_it(self) -> None:
        """The CRC of the driver and that of the firmware agree with the real unit's."""
        assert checksum(GOLDEN[:-4]) == 0xC64942C6
        assert crc32(GOLDEN[:-4] + b"\0") == 0xC64942C6

    @pytest.mark.parametrize(("text", "crc"), CHECKED_TEXTS.items())
    def test_data_sheet_texts(self, text: bytes, crc: int) -> None:
        """The CRC-8 of the data sheet's examples, by the driver's and by the firmware's code."""
        assert crc8_of(text) == crc8(text) == crc

    def test_commands_and_replies(self) -> None:
        """Commands are written as in the data sheet; replies are found among whatever else came."""
        assert (encode_command("isn"), encode_command("sm", 4)) == (b"$isn,28\r", b"$sm,4,115\r")
        heard = b"\x90#\r\x0d##isn,0,N1,9\r#isn,0,N2558184602002,32\r#UTILITYMODE,234\r#sm,0,4,213\r#,1,180\r#sm,0,4"
        assert parse_replies(heard) == [
            Reply("isn", 0, ("N2558184602002",)), Reply("UTILITYMODE", 0), Reply("sm", 0, ("4",)), Reply("", 1)
        ]  # fmt: skip

    @pytest.mark.parametrize(("identifier", "length"), LENGTHS.items())
    def test_every_datagram_of_samples(self, identifier: int, length: int) -> None:
        """Each id has its length and its clusters in their places, with CR LF and without."""
        clusters = SAMPLE_IDS[identifier]
        data = "00012c ffffff 800000 01"
        data += " 000001 7fffff 000002 02" if Cluster.ACCELERATION in clusters else ""
        data += " 000003 000004 000005 04" if Cluster.INCLINATION in clusters else ""
        n_triples = 1 + (Cluster.ACCELERATION in clusters) + (Cluster.INCLINATION in clusters)
        data += " 1000 2000 ff00 08" * n_triples if Cluster.TEMPERATURE in clusters else ""
        data += " 00ffee 10" if clusters & (Cluster.PPS | Cluster.AUX) else ""
        for end in ("", "0d0a"):
            wire = golden(identifier, data + " c8 0203", end=end)
            assert len(wire) == length + len(end) // 2 == wire_size(identifier, terminated=bool(end))
            sample = decode_samples(only(decoder().feed(wire)))
            assert triple(sample, "rate").tolist() == [[300, -1, -(2**23)]]
            assert (sample["rate_status"][0], sample["counter"][0], sample["latency_us"][0]) == (1, 200, 515)
            if Cluster.INCLINATION in clusters:
                assert triple(sample, "inclination").tolist() == [[3, 4, 5]]
            if Cluster.TEMPERATURE in clusters:
                assert sample["rate_temperature"].tolist() == [[4096, 8192, -256]]

    def test_what_it_says_of_itself(self) -> None:
        """Part number, serial number, configuration and error bits in their places."""
        assert parse_part_number(golden(0xB1, "0863062d8416712d234001000000 42")[:-4]) == "86306-841671-1234 rev B"
        assert parse_serial_number(golden(0xB5, "4e 25581846020021" + 7 * "00")[:-4]) == "N25581846020021"
        wire = golden(0xBD, "45 1f 9d 30 71 44 40 72 44 44 70 44 40 0b 00 00 30 00 00 00 00", end="0d0a")
        found = parse_configuration(only(decoder().feed(wire)).bodies.tobytes())
        assert (found.revision, found.firmware, found.sample_rate, found.bit_rate) == ("E", 31, 2000, 1_843_200)
        assert found.clusters == Cluster.PPS | Cluster.TEMPERATURE | Cluster.INCLINATION
        assert found.terminated
        assert (found.axes, found.gyro, found.accelerometer) == ((True, True, True), Output.INCREMENT, Output.AVERAGE)
        assert found.rate_lsb == pytest.approx(radians(2**-21) * 2000)
        bits = (1 << 16 | 1 << 104 | 1 << 127).to_bytes(16, "big")
        assert parse_extended_error(b"\xbe" + bits) == (
            "start-up under way",
            "accelerometer x overload",
            "error bit 127",
        )

    @given(st.binary(min_size=35, max_size=35))
    def test_whatever_it_says_of_itself(self, data: bytes) -> None:
        """Any contents of these datagrams become printable text, or a configuration, or one clear refusal."""
        texts = [parse_part_number(b"\xb1" + data[:15]), parse_serial_number(b"\xb5" + data[:15])]
        assert all(
            text.isprintable() and text.isascii() for text in [*texts, *parse_extended_error(b"\xbe" + data[:16])]
        )
        try:
            found = parse_configuration(b"\xbc" + data[:21])
        except ProtocolError as error:
            assert "unknown" in str(error)  # noqa: PT017  # either outcome is right
        else:
            assert found.revision.isprintable()
            assert found.rate_lsb >= 0

    @given(st.binary(max_size=200))
    def test_any_replies(self, heard: bytes) -> None:
        """Whatever is heard in utility mode, replies have a good checksum."""
        for reply in parse_replies(heard):
            text = ",".join(["#" + reply.command, str(reply.status), *reply.values, ""])
            assert b"%d\r" % crc8_of(text.encode()) in heard

    def test_an_unknown_configuration(self) -> None:
        """A code that no data sheet knows is refused by name."""
        body = golden(0xBC, "45 1f e0" + 18 * "00")[:-4]
        with pytest.raises(ProtocolError, match="unknown sample rate 7"):
            parse_configuration(body)

    @pytest.mark.parametrize(
        ("byte", "status"),
        [
            (0x00, GyroStatus.OK), (0x80, GyroStatus.SENSOR_FAULT), (0x40, GyroStatus.NOT_READY),
            (0x20, GyroStatus.TEMPERATURE), (0x11, GyroStatus.SATURATED), (0x0A, GyroStatus.SENSOR_FAULT),
        ],
    )  # fmt: skip
    def test_status(self, byte: int, status: GyroStatus) -> None:
        """Each bit of the status byte says of a block what it means."""
        assert GYRO_STATUS[byte] == status


class TestFirmware:
    """What the emulated unit sends, byte for byte."""

    def test_power_on(self) -> None:
        """It says who it is after its start-up, then sends a sample each 8 ms, by itself."""
        device = Stim300Device(TriadBoard())
        assert (device.poll(0), device.next_due_us(), device.session) == (b"", 300_000, 0)
        said = device.poll(300_000)
        assert said[:20] == golden(0xB1, "0863062d8416712d234001000000 41")
        assert said[20:40] == golden(0xB5, "4e 25581846020021 00000000000000")
        assert said[40:66] == golden(0xBC, "41 1f 0a 10 70 44 40 70 00 00 70 00 00 08 00 00 00 00 00 00 00")
        first = said[66:]
        assert first == golden(
            0xA5, "000124 fffad6 00035b 00 ffe7a6 ffdd36 081c52 00 2380 2380 2380 00 2380 2380 2380 00 00 01f4"
        )
        assert device.next_due_us() == 308_000
        assert device.poll(308_000)[-7:-4].hex() == "1001f4"

    def test_clusters_and_ids(self) -> None:
        """With other clusters it sends other datagrams, all of which the decoder takes."""
        for clusters in range(16):
            for old in (False, True):
                for end in (False, True):
                    device = Stim300Device(TriadBoard())
                    device.clusters, device.old_ids, device.terminated = clusters, old, end
                    found = decoder().feed(device.poll(400_000))
                    assert [len(frames.bodies) for frames in found] == [1, 1, 1, 13]
                    expected = parse_configuration(found[2].bodies.tobytes()).clusters
                    assert SAMPLE_IDS[found[3].header[0]] == expected

    def test_answers_take_the_place_of_samples(self) -> None:
        """Each command costs one sample, and in increments what it held; the counter goes on."""
        device = Stim300Device(TriadBoard())
        device.poll(300_000)
        device.feed(b"N\rT\rX\re\rE\r", 303_000)
        found = decoder().feed(device.poll(340_000))
        assert [(frames.header[0], len(frames.bodies)) for frames in found] == [
            (0xB1, 1),
            (0xD1, 1),
            (0xBE, 1),
            (0xA5, 2),
        ]
        assert decode_samples(found[3])["counter"].tolist() == [64, 80]

    def test_increments_lose_nothing(self) -> None:
        """Increments and integrals add up to the angle turned, whatever the rates."""
        board = TriadBoard()
        board.rates = [(1, -1, 70_001), (3, 0, -123_456), (1_400_000_000, -5, 17)]
        for output in (1, 3):
            board.n_read = 0
            device = Stim300Device(board)
            device.output = output
            frames = decoder().feed(device.poll(300_000 + 8000 * 2999))[-1]
            counts = triple(decode_samples(frames), "rate").astype(np.int64)
            if output == 3:
                counts = (np.diff(counts, axis=0, prepend=0) + 2**23) % 2**24 - 2**23
            turned = 1000 * np.sum(board.rates, axis=0) * 2**-10 / 3600 / 125  # deg
            assert np.abs(counts.sum(axis=0) / 2**21 - turned).max() < 2**-21

    @given(st.lists(st.binary(max_size=30), max_size=10), st.booleans())
    def test_any_text(self, lines: list[bytes], utility: bool) -> None:  # noqa: FBT001  # drawn
        """Whatever comes over the line, the unit lives, and streams when it is told to."""
        device = Stim300Device(TriadBoard())
        device.poll(300_000)
        for line in [b"UTILITYMODE"] * utility + lines:
            device.feed(line + b"\r", 400_000)
            device.feed(b"$" + line + b",%d\r" % crc8(b"$" + line + b","), 400_000)
            device.poll(400_000)
        device.feed(b"\r$xn,150\r", 500_000)
        device.poll(500_000)
        assert decoder().feed(device.poll(1_000_000))

    def test_a_full_line_loses_whole_datagrams(self) -> None:
        """What has no room is left out as a whole."""
        device = Stim300Device(TriadBoard())
        device.poll(300_000)
        assert len(device.poll(340_000, room=100)) == 84
        assert device.poll(348_000, room=10) == b""

    @pytest.mark.parametrize(
        ("asked", "told"),
        [
            (b"$isn,28\r", b"#isn,0,N25581846020021,"), (b"$isn,29\r", b"#,2,"), (b"hello\r", b"#,1,"),
            (b"$what,", b"#,3,"), (b"$sm,0,", b"#sm,0,0,"), (b"$sm,4,", b"#sm,5,"), (b"$sm,", b"#sm,4,"),
            (b"$sgu,x,", b"#sgu,5,"), (b"$sgu,9,", b"#sgu,5,"), (b"$sgu,1,", b"#sgu,0,1,"),
        ],
    )  # fmt: skip
    def test_utility_mode(self, asked: bytes, told: bytes) -> None:
        """Commands in utility mode are answered with their status, and the stream is silent meanwhile."""
        device = Stim300Device(TriadBoard())
        device.poll(300_000)
        device.feed(b"UTILITYMODE\r", 301_000)
        assert device.poll(301_000) == b"#UTILITYMODE,234\r"
        line = asked if asked.endswith(b"\r") else asked + b"%d\r" % crc8(asked)
        device.feed(line, 400_000)
        assert device.poll(400_000) == told + b"%d\r" % crc8(told)
        assert device.next_due_us() is None
        device.feed(b"$xn,150\r", 500_000)
        assert len(decoder().feed(device.poll(540_000))[0].bodies) == 6
        assert device.next_due_us() == 548_000

    @pytest.mark.parametrize(("n_axes", "millihz"), [(1, 125_000), (3, 235_000), (3, 125_500)])
    def test_another_board(self, n_axes: int, millihz: int) -> None:
        """A board that no STIM300 has is refused."""
        board = FakeGyroBoard(n_axes)
        board.sample_rate_millihz = millihz
        with pytest.raises(ValueError, match="three axes"):
            Stim300Device(board)


class Rig:
    """A driver on an emulated unit."""

    def __init__(self, board: TriadBoard | None = None, settings: Settings | None = None) -> None:
        self.clock = VirtualClock()
        self.board = board or TriadBoard()
        self.device = Stim300Device(self.board)
        self.wire = Wire(self.device)
        self.gyro = Stim300Gyro(VirtualLink(self.wire, self.clock, name="rig"), self.clock, settings)

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


class TestDriver:
    """The driver against the emulated unit in virtual time."""

    def test_is_a_gyro(self) -> None:
        """It is what the instrument needs."""
        gyro: Gyro = Rig().gyro
        assert gyro.n_axes == 3

    def test_identity_and_configuration(self) -> None:
        """It says who it is, and how it is set."""
        rig = Rig()
        who = rig.gyro.connect()
        assert (who.kind, who.model) == ("gyro", "STIM300 86306-841671-1234 rev A")
        assert (who.serial_number, who.firmware_version) == ("N25581846020021", "A31")
        assert (rig.gyro.sample_rate, rig.gyro.n_axes) == (125.0, 3)

    @pytest.mark.parametrize("output", range(4))
    @pytest.mark.parametrize("end", [False, True])
    def test_blocks(self, output: int, end: bool) -> None:  # noqa: FBT001  # a parameter
        """Rates, forces and temperatures arrive in SI, each sample once, in each output of the gyros."""
        rig = Rig()
        rig.device.output, rig.device.terminated = output, end
        rig.device.clusters = ACCELERATION | INCLINATION | TEMPERATURE | PPS
        blocks = rig.started().run(3.0)
        assert blocks[0].first_index == 0
        assert all(b.first_index == a.first_index + len(a.counts) for a, b in pairwise(blocks))
        assert sum(len(block.counts) for block in blocks) > 350
        assert {block.status for block in blocks} == {GyroStatus.OK}
        assert {block.n_lost for block in blocks} == {0}
        assert all(0 < len(block.counts) <= 31 for block in blocks)
        rate = np.concatenate([block.rate for block in blocks]).mean(axis=0)
        assert np.allclose(rate, np.array(self.rate_dph) * DPH, rtol=1e-3)
        assert blocks[0].specific_force == pytest.approx((-0.11661, -0.16659, 9.94226), abs=2e-5)
        assert blocks[0].temperature == 35.5
        assert blocks[1].device_time == blocks[1].first_index / 125

    rate_dph = (65_700 / 1024, -297_450 / 1024, 193_275 / 1024)

    def test_specific_force_needs_a_sensor(self) -> None:
        """Without accelerometers the inclinometers serve, without either there is none."""
        for clusters, force in ((INCLINATION, pytest.approx(9.94, abs=0.01)), (TEMPERATURE, None)):
            rig = Rig()
            rig.device.clusters = clusters
            found = rig.started().run(0.5)[0].specific_force
            assert found == force if found is None else found[2] == force

    def test_integrals_turn_over(self) -> None:
        """The integrated angle begins again at 4 deg; the rate does not notice."""
        rig = Rig()
        rig.board.rates = [(1_000_000_000, -1_000_000_000, 0)]  # 271 deg/s, 2.2 deg a sample
        rig.device.output = 3
        blocks = rig.started().run(2.0)
        rate = np.concatenate([block.rate for block in blocks])
        assert np.allclose(rate, np.array([1e9, -1e9, 0]) / 1024 * DPH, rtol=1e-6)

    def test_start_ends_what_came_before(self) -> None:
        """However long the gyro was connected before, sample 0 is of the time of `start`."""
        rig = Rig()
        rig.gyro.connect()
        rig.clock.sleep_until(30.0)
        rig.board.rates = [(225, 450, 675)]
        rig.gyro.start()
        assert np.concatenate([block.counts for block in rig.run(0.5)]).tolist()[0] == [1, 2, 3]

    def test_status_cuts_blocks(self) -> None:
        """A block holds samples of one status only, that of the unit at the time."""
        rig = Rig().started()
        rig.run(0.5)
        rig.board.flags = 2
        rig.run(0.099)
        rig.board.flags = 0
        blocks = rig.run(1.0)
        assert [block.status for block in blocks if block.status] == [GyroStatus.SATURATED]
        (hit,) = [len(block.counts) for block in blocks if block.status]
        assert hit == 12

    @settings(max_examples=20, deadline=None)
    @given(st.integers(0, 2**32), st.floats(0, 0.25))
    def test_lost_and_damaged_datagrams(self, seed: int, share: float) -> None:
        """Datagrams that are lost or damaged are counted, and every other sample has its right index."""
        rng = np.random.default_rng(seed)
        rig = Rig()
        rig.board.rates = [(225 * i, 0, 0) for i in range(1000)]
        rig.started()
        first, n_damaged = None, 0

        def hurt(data: bytes) -> bytes:
            nonlocal n_damaged
            if not data or rng.random() >= share:
                return data
            if rng.random() < 0.5:
                return b""
            n_damaged += 1
            return data[:9] + bytes([data[9] ^ 1]) + data[10:]

        rig.wire.damage = hurt
        n_lost = n = 0
        for block in rig.run(6.0):
            values = block.counts[:, 0].tolist()
            first = values[0] - block.first_index if first is None else first
            assert values == list(range(first + block.first_index, first + block.first_index + len(values)))
            n_lost += block.n_lost
            n += len(values)
        assert n + n_lost == block.first_index + len(block.counts)
        assert (rig.gyro.troubles[DAMAGED] > 0) == (n_damaged > 0)

    @pytest.mark.parametrize("gap", [0.05, 0.128, 0.3, 0.9])
    def test_gaps_longer_than_the_counter(self, gap: float) -> None:
        """In real time a gap of any length is found by the time of arrival; one longer than the counter is flagged."""
        rig = Rig()
        rig.board.rates = [(225 * i, 0, 0) for i in range(5000)]
        rig.started()
        before = rig.run(3.0)
        origin = int(before[0].counts[0, 0])
        rig.wire.damage = lambda _: b""
        rig.run(gap)
        rig.wire.damage = bytes
        back = rig.clock.now()
        blocks = rig.run(3.0)
        settled = 0.3 if round(gap * 125) % 16 else 1.6  # whole turns of the counter show only by coming late
        for block in blocks:
            if block.arrival_time < back + settled:
                continue
            assert block.counts[0, 0] - origin == block.first_index
        n_lost = sum(block.n_lost for block in blocks)
        assert abs(n_lost - gap * 125) <= 1
        flagged = [block for block in blocks if block.status & GyroStatus.OVERRUN]
        assert len(flagged) == (gap >= 0.128)

    def test_reset(self) -> None:
        """A unit that starts anew is a fault, after all samples before it."""
        rig = Rig().started()
        n = sum(len(block.counts) for block in rig.run(1.0))
        rig.device.feed(b"R\r", rig.clock.now_us)
        with pytest.raises(DeviceFaultError, match="reset"):
            rig.run(1.0)
        assert n > 90
        with pytest.raises(DeviceFaultError, match="reset"):
            rig.gyro.read()

    def test_another_datagram(self) -> None:
        """A unit that is set anew while it is measured with is noticed."""
        rig = Rig().started()
        rig.run(0.5)
        rig.device.clusters = 0
        with pytest.raises(ProtocolError, match="datagrams 90"):
            rig.run(1.0)

    def test_set_between_connect_and_start(self) -> None:
        """A configuration that changes before the stream starts is a fault."""
        rig = Rig()
        rig.gyro.connect()
        rig.device.output = 1
        with pytest.raises(DeviceFaultError, match="another configuration"):
            rig.gyro.start()

    def test_silence(self) -> None:
        """A unit that falls silent is a timeout, not sooner than a second."""
        rig = Rig().started()
        rig.wire.damage = lambda _: b""
        with pytest.raises(DeviceTimeoutError, match="no samples for 1"):
            rig.run(2.0)

    def test_unplugged(self) -> None:
        """What came before the cable was pulled can be read; then the link is lost."""
        rig = Rig().started()
        rig.clock.sleep_until(rig.clock.now() + 0.1)
        assert rig.gyro.read() == []  # too few to be worth it, yet
        rig.wire.unplugged = True
        rig.clock.sleep_until(rig.clock.now() + 0.01)
        assert sum(len(block.counts) for block in rig.gyro.read()) == 12
        with pytest.raises(LinkError, match="unplugged"):
            rig.gyro.read()
        rig.gyro.close()

    def test_stop(self) -> None:
        """What was sent before the stop can be read, nothing after it; a new start begins at 0."""
        rig = Rig().started()
        rig.run(0.3)
        rig.clock.sleep_until(rig.clock.now() + 0.1)
        rig.gyro.stop()
        assert len(rig.gyro.read()) == 1
        assert rig.run(1.0) == []
        rig.gyro.start()
        assert rig.run(0.5)[0].first_index == 0

    def test_self_test(self) -> None:
        """The extended error information, in words."""
        rig = Rig()
        rig.gyro.connect()
        assert rig.gyro.self_test().passed
        rig.board.failures = 1 | 4
        assert rig.gyro.self_test().failures == ("memory", "gyro x overload")

    def test_nobody_there(self) -> None:
        """A silent line, a line of noise, and one whose answers do not come are told apart."""
        rig = Rig()
        rig.wire.damage = lambda _: b""
        with pytest.raises(DeviceTimeoutError, match="silent"):
            rig.gyro.connect()
        rig.wire.damage = lambda data: bytes(byte ^ 0x55 for byte in data)
        with pytest.raises(ProtocolError, match="bit rate"):
            rig.gyro.connect()
        rig.wire.damage, rig.wire.answers = bytes, False
        with pytest.raises(DeviceTimeoutError, match="sends samples but does not answer 'N'"):
            rig.gyro.connect()

    def test_answers_lost_once_are_asked_for_again(self) -> None:
        """A question or an answer may be lost."""
        rig = Rig()
        rig.clock.sleep_until(1.0)
        spoilt = []

        def spoil(data: bytes) -> bytes:
            if data[:1] in (b"\xb1", b"\xb5", b"\xbc") and data[:1] not in spoilt:
                spoilt.append(data[:1])
                return data[:-1] + bytes([data[-1] ^ 1])
            return data

        rig.gyro._stream.take_raw()
        rig.wire.damage = spoil
        assert rig.gyro.connect().serial_number == "N25581846020021"
        assert len(spoilt) == 3
        assert rig.gyro.troubles[REPEATED] == 3


class TestSettings:
    """What an operator may ask for."""

    def test_refused_without_leave(self) -> None:
        """A unit that is set otherwise is refused, with what to do; nothing is sent in utility mode."""
        rig = Rig(settings=Settings(output=Output.AVERAGE))
        with pytest.raises(DeviceFaultError, match=r"gyro output rate, average is asked for: .*configure = true"):
            rig.gyro.connect()
        rig = Rig(settings=Settings(sample_rate=2000))
        with pytest.raises(DeviceFaultError, match="samples at 125 Hz, 2000 Hz is asked for"):
            rig.gyro.connect()

    def test_set_with_leave(self) -> None:
        """With leave it is set in utility mode, and streams again."""
        rig = Rig(settings=Settings(sample_rate=125, output=Output.INCREMENT, configure=True))
        rig.started()
        assert rig.gyro.configuration.gyro is Output.INCREMENT
        assert rig.run(1.0)

    def test_refused_by_the_unit(self) -> None:
        """A setting that the unit refuses is named, and it is not left silent."""
        rig = Rig(settings=Settings(sample_rate=2000, configure=True))
        with pytest.raises(DeviceFaultError, match=r"refuses \$sm,4: invalid parameter"):
            rig.gyro.connect()
        rig.clock.sleep_until(rig.clock.now() + 0.1)
        assert rig.gyro._stream.take()

    def test_an_older_unit(self) -> None:
        """A unit without utility mode is named as such."""
        rig = Rig(settings=Settings(output=Output.INCREMENT, configure=True))
        obey = rig.device._obey
        rig.device._obey = lambda line, now_us: None if b"UTIL" in line else obey(line, now_us)  # type: ignore[method-assign]  # a unit of another make
        with pytest.raises(DeviceTimeoutError, match="older unit"):
            rig.gyro.connect()

    @pytest.mark.parametrize(
        ("options", "said"),
        [({"sample_rate": 300}, "samples at 125, 250"), ({"output": "delta"}, "one of rate, increment")],
    )
    def test_senseless_options(self, options: dict[str, Any], said: str) -> None:
        """What no unit can be set to is refused before the port is opened."""
        with pytest.raises(ValueError, match=said):
            open_gyro("/dev/nonexistent", VirtualClock(), **options)

    def test_too_slow_a_line(self) -> None:
        """More bytes than the line can carry are refused."""
        board = TriadBoard()
        board.sample_rate_millihz = 2_000_000
        rig = Rig(board)
        rig.device.bit_rate_code = 1
        with pytest.raises(DeviceFaultError, match="42 bytes 2000 times a second, too many for 460800"):
            rig.gyro.connect()


class TestRecogniser:
    """Who is on a line, from what is heard."""

    def test_heard(self) -> None:
        """One good datagram is proof, who it is comes from others; noise and half datagrams are none."""
        device = Stim300Device(TriadBoard())
        said = device.poll(400_000)
        who = RECOGNISER.recognise(said)
        assert who is not None
        assert (who.model, who.serial_number) == ("STIM300 86306-841671-1234 rev A", "N25581846020021")
        later = RECOGNISER.recognise(said[80:200])
        assert later is not None
        assert (later.model, later.serial_number) == ("STIM300", "")
        assert RECOGNISER.recognise(said[80:140]) is None
        assert RECOGNISER.recognise(np.random.default_rng(1).bytes(100_000)) is None

    def test_bench(self) -> None:
        """The emulated bench can hold one; its noise is the data sheet's: 0.15 deg per root hour."""
        bench = SimBench(gyro="stim300", seed=1, azimuth=radians(147), latitude=radians(-33))
        clock = VirtualClock()
        gyro = Stim300Gyro(VirtualLink(bench.gyro, clock), clock)
        gyro.connect()
        gyro.start()
        blocks = []
        while clock.now() < 20:
            blocks += gyro.read()
            clock.wait(clock.now() + 0.2)
        noise = np.concatenate([block.rate for block in blocks[5:]]).std(axis=0) / DPH
        assert np.allclose(noise, 0.15 * 60 * 125**0.5, rtol=0.1)
        assert blocks[-1].specific_force is not None
        assert np.linalg.norm(blocks[-1].specific_force) == pytest.approx(9.80665, rel=2e-3)
