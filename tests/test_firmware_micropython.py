"""The firmware stays within what MicroPython runs."""

import ast
import shutil
import subprocess
from pathlib import Path

import pytest

import sim_device.firmware

FIRMWARE = Path(sim_device.firmware.__file__).parent
MODULES = sorted(FIRMWARE.glob("*.py"))
ALLOWED = {"struct", "array"}

#: A stage and a gyro in virtual time: sessions, homing, a move, the watchdog, a stream; then both on CAN.
SMOKE = """
import struct
from fake_boards import DEG, FakeGyroBoard, FakeStageBoard
from sim_device.firmware.can_axis import AxisNode
from sim_device.firmware.can_gyro import GyroNode
from sim_device.firmware.framing import FrameReader, frame
from sim_device.firmware.gyro import GyroDevice
from sim_device.firmware.stage import StageDevice

def request(kind, number, payload=b""):
    return frame(struct.pack("<BII", kind, 5, number) + payload)

hello = frame(struct.pack("<BHII", 1, 1, 0x66B325A6, 5))
board = FakeStageBoard(20 * DEG, -10 * DEG)
stage = StageDevice(board)
reader = FrameReader()
now = 0

def run(duration, beats=True):
    global now
    end = now + duration
    state = None
    while now < end:
        now = min(end, now + 50000)
        if beats:
            stage.feed(frame(struct.pack("<BIQ", 2, 5, now)), now)
        for body in reader.feed(stage.poll(now)):
            state = tuple(body[1:4]) if body[0] == 0x41 else state
    return state

stage.feed(hello + request(0x20, 1), now)
print(run(20000000), board.position(0) < 10)
stage.feed(request(0x21, 2, struct.pack("<iiII", 40 * DEG, -40 * DEG, 18 * DEG, 18 * DEG)), now)
print(run(10000000), board.position(0) // DEG)
stage.feed(request(0x21, 3, struct.pack("<iiII", 0, 0, 18 * DEG, 18 * DEG)), now)
print(run(10000000, beats=False))
gyro = GyroDevice(FakeGyroBoard(3))
gyro.feed(hello + request(0x10, 1), 0)
print([len(body) for body in FrameReader().feed(gyro.poll(400000))])
heard = []
axis = AxisNode(FakeStageBoard(3 * DEG, 0), 0, 32)
now = 1
axis.feed(0, bytes((1, 32)), now)
axis.feed(0x620, struct.pack("<BHBBBBB", 0x2F, 0x6060, 0, 6, 0, 0, 0), now)
for word in (6, 7, 15, 31):
    axis.feed(0x220, struct.pack("<Hi", word, 0), now)
while now < 20000000:
    now += 50000
    axis.feed(0x77F, b"\\x05", now)
    heard = [struct.unpack("<H", data[:2])[0] for name, data in axis.poll(now) if name == 0x1A0] or heard
print(hex(heard[-1]))
node = GyroNode(FakeGyroBoard(3), 16)
node.feed(0, bytes((1, 0)), 0)
node.feed(0x610, struct.pack("<BHBBBBB", 0x2F, 0x2020, 0, 1, 0, 0, 0), 0)
print(len(node.poll(400000)))
"""
SAID = "(2, 0, 3) True\n(2, 0, 3) 40\n(5, 1, 2)\n[64, 9, 504, 504]\n0x5637\n308\n"


def _imports(source: str) -> set[str]:
    """Return the modules that `source` imports."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(node.module or "")
    return found


def _foreign(source: str) -> set[str]:
    """Return the imports of `source` that a microcontroller does not have."""
    return {name for name in _imports(source) if name not in ALLOWED and not name.startswith("sim_device.firmware.")}


def _unsupported(source: str) -> list[str]:
    """Return the constructs of `source` that MicroPython's compiler does not take."""
    displays = (ast.List, ast.Tuple, ast.Set)
    return [
        ast.unparse(node)
        for node in ast.walk(ast.parse(source))
        if isinstance(node, (ast.Match, ast.TryStar, ast.AsyncFunctionDef))
        or (
            isinstance(node, displays)
            and not isinstance(getattr(node, "ctx", None), ast.Store)
            and any(isinstance(element, ast.Starred) for element in node.elts)
        )
        or (isinstance(node, ast.Dict) and None in node.keys)
    ]


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.stem)
def test_imports_only_what_a_microcontroller_has(path: Path) -> None:
    """The firmware imports struct, array and its own modules."""
    assert _foreign(path.read_text()) == set()


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.stem)
def test_syntax_is_micropythons(path: Path) -> None:
    """The firmware uses no syntax that MicroPython lacks."""
    assert _unsupported(path.read_text()) == []


def test_the_checks_see_what_they_look_for() -> None:
    """A planted import or construct is found."""
    assert _foreign("import struct, typing\nfrom dataclasses import field\nimport sim_device.plant") == {
        "typing",
        "dataclasses",
        "sim_device.plant",
    }
    assert _unsupported("a = [*b, 1]\nc, *d = e\nf = {**g}\nh(*i)") == ["[*b, 1]", "{**g}"]


def test_smoke_script_on_this_python(capsys: pytest.CaptureFixture[str]) -> None:
    """The smoke script says what it shall."""
    exec(compile(SMOKE, "smoke", "exec"), {})  # noqa: S102  # our own text, the very one that MicroPython runs
    assert capsys.readouterr().out == SAID


def test_smoke_script_on_micropython(tmp_path: Path) -> None:
    """The same under MicroPython, where it is installed."""
    micropython = shutil.which("micropython")
    if micropython is None:
        pytest.skip("no micropython on this machine")
    script = tmp_path / "smoke.py"
    script.write_text(SMOKE)
    path = f"{FIRMWARE.parent.parent}:{Path(__file__).parent}"
    done = subprocess.run([micropython, script], env={"MICROPYPATH": path}, capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == (SAID, "")
