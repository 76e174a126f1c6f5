"""The device side judged by a CANopen master written elsewhere: the `canopen` package, on two kinds of bus."""

import contextlib
import select
import struct
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import canopen
import pytest
from canopen.profiles.p402 import BaseNode402
from canopen.sdo import SdoAbortedError

import drivers
from sim_device.can_bench import CanBench
from sim_device.slcan import SlcanPort
from sim_device.virtual_bus import BusPump

EDS = Path(drivers.__file__).parent / "eds"
SPEED = 10.0  # times real time
DEG = 36_000
GYRO, AZIMUTH = 16, 32
PATIENCE = 60.0  #: s, for what comes at once on a machine that is not busy


def _patient(node: Any) -> Any:  # noqa: ANN401 - a class without types
    """Return a node of the master that waits for answers for as long as a busy machine needs."""
    node.sdo.RESPONSE_TIMEOUT = PATIENCE
    for name in ("RESET_FAULT", "SWITCH_OP_MODE", "SWITCH_STATE_FINAL", "SWITCH_STATE_SINGLE", "CHECK_TPDO"):
        setattr(node, f"TIMEOUT_{name}", PATIENCE)
    return node


def _bench() -> CanBench:
    """Return a bench whose azimuth stands near its reference, with a host that is alive."""
    bench = next(bench for bench in map(_seeded, range(100)) if abs(bench.plant_stage.azimuth.true_angle(0)) < 0.1)
    host = bench.wire.tap()

    def beat() -> None:
        host.send(0x77F, b"\x05", bench.now_us)
        host.waiting.clear()
        bench.at(bench.now_us + 50_000, beat)

    bench.at(0, beat)
    return bench


def _seeded(seed: int) -> CanBench:
    return CanBench("ideal", seed=seed)


@contextlib.contextmanager
def _running(target: Callable[[threading.Event], None]) -> Iterator[None]:
    stop = threading.Event()
    thread = threading.Thread(target=target, args=(stop,))
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


@contextlib.contextmanager
def _connected(address: dict[str, Any]) -> Iterator[canopen.Network]:
    network = canopen.Network()
    network.connect(**address)
    try:
        yield network
    finally:
        network.disconnect()


@contextlib.contextmanager
def _on_bus(bench: CanBench, address: dict[str, Any]) -> Iterator[canopen.Network]:
    """Connect a master by a bus of python-can on which the bench has an end of its own."""
    with can.Bus(**address) as bus:

        def pump(stop: threading.Event) -> None:
            BusPump(bench, bus).run(stop, SPEED)

        with _running(pump), _connected(address) as network:
            yield network


def on_virtual(bench: CanBench) -> contextlib.AbstractContextManager[canopen.Network]:
    """Connect a master by python-can's virtual bus."""
    return _on_bus(bench, {"interface": "virtual", "channel": f"bench {id(bench)}"})


def on_vcan(bench: CanBench) -> contextlib.AbstractContextManager[canopen.Network]:
    """Connect a master by the kernel's virtual CAN, where there is one."""
    if not Path("/sys/class/net/vcan0").exists():
        pytest.skip("no vcan0 on this machine")
    return _on_bus(bench, {"interface": "socketcan", "channel": "vcan0"})


@contextlib.contextmanager
def on_slcan(bench: CanBench) -> Iterator[canopen.Network]:
    """Connect a master by python-can's slcan to the adapter on a pseudo-terminal."""
    port = SlcanPort(bench.wire)

    def pump(stop: threading.Event) -> None:
        begin = time.monotonic()
        while not stop.is_set():
            select.select(port.handles, [], [], 0.001)
            now_us = round((time.monotonic() - begin) * 1e6 * SPEED)
            port.take_in(now_us)
            bench.advance_to(now_us)
            port.bring_out()

    channel = port.address.removeprefix("slcan:")
    with contextlib.closing(port), _running(pump):
        address = {"interface": "slcan", "channel": channel, "bitrate": 1_000_000, "sleep_after_open": 0}
        with _connected(address) as network:
            yield network


@pytest.fixture(params=[on_virtual, on_slcan, on_vcan], ids=["virtual", "slcan", "vcan"])
def rig(request: pytest.FixtureRequest) -> Iterator[tuple[CanBench, Any]]:
    """Return a bench, and the master's drive of its azimuth, in PRE-OPERATIONAL."""
    bench = _bench()
    make_drive: Any = BaseNode402
    with request.param(bench) as network:
        drive = _patient(network.add_node(make_drive(AZIMUTH, str(EDS / "cia402_stage.eds"))))
        drive.nmt.state = "RESET"
        deadline = time.monotonic() + PATIENCE
        while drive.nmt.state != "PRE-OPERATIONAL":
            assert time.monotonic() < deadline
        yield bench, drive


def _wait(drive: Any, mask: int, bits: int) -> None:  # noqa: ANN401 - a class without types
    deadline = time.monotonic() + PATIENCE
    while drive.sdo[0x6041].raw & mask != bits:
        assert time.monotonic() < deadline


def _move(drive: Any, target: int) -> None:  # noqa: ANN401 - as above
    """Do the set-point handshake, and wait until the target is reached."""
    drive.rpdo[1][0x607A].raw = target
    drive.controlword = 0x0F
    drive.controlword = 0x1F
    _wait(drive, 0x1000, 0x1000)
    drive.controlword = 0x0F
    _wait(drive, 0x1000, 0)
    _wait(drive, 0x0400, 0x0400)


def test_drive(rig: tuple[CanBench, Any]) -> None:
    """State machine to OPERATION ENABLED, homing, profile position moves, fault and reset."""
    bench, drive = rig
    drive.sdo[0x1800][5].raw = 100  # this master wants its statusword regularly
    drive.sdo[0x6099][2].raw = 10_800
    drive.setup_402_state_machine()
    drive.nmt.state = "OPERATIONAL"
    drive.state = "OPERATION ENABLED"
    assert drive.state == "OPERATION ENABLED"
    assert drive.homing(PATIENCE)
    assert abs(bench.plant_stage.azimuth.true_angle(bench.now_us)) < 1e-3
    drive.op_mode = "PROFILED POSITION"
    for target in (20 * DEG, -5 * DEG):
        _move(drive, target)
        assert abs(drive.sdo[0x6064].raw - target) <= 10
    bench.plant_stage.e_stop = True
    _wait(drive, 0x4F, 0x08)
    assert drive.sdo[0x603F].raw == 0x9000
    assert drive.emcy.active[0].code == 0x9000
    bench.plant_stage.e_stop = False
    drive.controlword = 0
    drive.controlword = 0x80
    _wait(drive, 0x4F, 0x40)
    assert not drive.emcy.active
    drive.state = "OPERATION ENABLED"
    _move(drive, 0)


def _code(access: Callable[[], object]) -> int:
    """Return the abort code of an access that must be refused."""
    with pytest.raises(SdoAbortedError) as caught:
        access()
    code: int = caught.value.code
    return code


def _announce(node: Any, variable: Any, length: int) -> Callable[[], object]:  # noqa: ANN401 - as above
    """Return the beginning of a download by segments; the master's own leaves a stream behind if it is refused."""
    request = struct.pack("<BHBI", 0x21, variable.index, variable.subindex, length)
    return lambda: node.sdo.request_response(request)


def _check_object(node: Any, variable: Any) -> None:  # noqa: ANN401 - as above
    """Read an object of the data sheet; write it as it may be, and as it may not be."""
    index, subindex, length = variable.index, variable.subindex, len(variable) // 8
    data = node.sdo.upload(index, subindex)
    is_text = variable.data_type == 0x09
    if not variable.writable:
        assert _code(_announce(node, variable, length or 1)) == 0x06010002
        return
    if not 0x1600 <= index < 0x1800 and not 0x1A00 <= index < 0x1C00:  # mappings change only while the PDO is invalid
        node.sdo.download(index, subindex, data)
        assert node.sdo.upload(index, subindex) == data
    assert _code(_announce(node, variable, 101 if is_text else length + 1)) == 0x06070012
    if length > 1 and not is_text:
        assert _code(lambda: node.sdo.download(index, subindex, bytes(length - 1))) == 0x06070013
    if variable.max is not None and variable.max < (1 << 8 * length - 1) - 1:
        high = (variable.max + 1).to_bytes(length, "little", signed=True)
        assert _code(lambda: node.sdo.download(index, subindex, high)) == 0x06090030


@pytest.mark.parametrize(("file", "node_id"), [("gyro.eds", GYRO), ("cia402_stage.eds", AZIMUTH)])
def test_every_object_of_the_data_sheet(file: str, node_id: int) -> None:
    """Each object of the data sheet is there, with its access, its length and its limits; nothing else is."""
    with on_virtual(_bench()) as network:
        node = _patient(network.add_node(node_id, str(EDS / file)))
        n_checked = 0
        for entry in node.object_dictionary.values():
            members = entry.values() if hasattr(entry, "values") else [entry]
            for variable in members:
                _check_object(node, variable)
                n_checked += 1
            if hasattr(entry, "values"):
                assert _code(lambda: node.sdo.upload(entry.index, 0x20)) == 0x06090011  # noqa: B023 - called at once
        assert n_checked > 90
        assert _code(lambda: node.sdo.upload(0x5000, 0)) == 0x06020000
        assert _code(lambda: node.sdo.download(0x5000, 0, b"x")) == 0x06020000


def test_segmented_transfer_of_a_text() -> None:
    """A text of 100 bytes goes there and back, one of 101 does not."""
    text = "".join(chr(33 + number % 90) for number in range(100))
    with on_virtual(_bench()) as network:
        node = _patient(network.add_node(GYRO, str(EDS / "gyro.eds")))
        node.sdo["User text"].raw = text
        assert node.sdo["User text"].raw == text
        node.sdo["User text"].raw = ""
        assert node.sdo["User text"].raw == ""


def test_samples_by_the_masters_pdos() -> None:
    """The master's own decoding of the sample PDO gives the numbers in turn, and the marks of time."""
    with on_virtual(_bench()) as network:
        node = _patient(network.add_node(GYRO, str(EDS / "gyro.eds")))
        pdos: Any = node.tpdo
        pdos.read()
        numbers: list[int] = []
        enough = threading.Event()

        def note(pdo: Any) -> None:  # noqa: ANN401 - a class without types
            numbers.append(pdo["Sample number"].raw)
            if len(numbers) >= 300:
                enough.set()

        pdos[1].add_callback(note)
        node.nmt.state = "OPERATIONAL"
        node.sdo["Stream"].raw = 1
        assert enough.wait(PATIENCE)
        assert numbers[:300] == list(range(300))
        assert pdos[2]["Time mark"].raw > 0
        node.sdo["Stream"].raw = 0
