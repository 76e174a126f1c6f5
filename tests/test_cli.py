"""The command line as users meet it: processes, pseudo-terminals, output and exit codes."""

import json
import os
import pty
import signal
import socket
import struct
import subprocess
import sys
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import fastcrc
import pytest
from cobs import cobs
from rich.console import Console

from drivers.api import DeviceIdentity
from drivers.discovery import Identification
from northfinder.cli import devices, doctor, main
from northfinder.cli.solve import command as solve_command
from northfinder.doctor import Finding, Verdict
from northfinder.record import Record

DATA = Path(__file__).parents[2] / "shared" / "data"
TIMEOUT = 60


def northfinder(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run the program to its end."""
    command = [sys.executable, "-m", "northfinder", *arguments]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=TIMEOUT, check=False)


def only_line(stderr: str) -> str:
    """Return the one line the program said about its failure; progress lines stand before it."""
    line = stderr.strip().splitlines()[-1]
    assert line.startswith("northfinder: ")
    assert "Traceback" not in stderr
    return line


@contextmanager
def emulated(*arguments: str) -> Iterator[dict[str, str]]:
    """Yield what ``northfinder emulate`` announces."""
    command = [sys.executable, "-m", "northfinder", "emulate", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        assert child.stdout is not None
        try:
            yield json.loads(child.stdout.readline())
        finally:
            child.terminate()


def test_find_gives_one_object_and_a_record(tmp_path: Path) -> None:
    """Through ptys and the whole protocol: the truth within four standard deviations, all the promised keys."""
    done = northfinder(
        "find", "--json", "--speed", "max", "--seed", "7", "--sim-azimuth", "225", "--sim-latitude", "-33",
        "--plan", "six-position", "--dwell", "20", "--out", str(tmp_path), cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    fix = json.loads(done.stdout)
    wanted = (
        "azimuth_deg azimuth_sd_deg latitude_deg latitude_sd_deg bias_dph scale_factor plan checks n_samples n_lost "
        "duration_s wall_s record"
    )
    assert set(wanted.split()) <= set(fix)
    assert abs(fix["azimuth_deg"] - 225) < 4 * fix["azimuth_sd_deg"]
    assert abs(fix["latitude_deg"] + 33) < 4 * fix["latitude_sd_deg"]
    assert fix["n_lost"] == 0
    with Record(Path(fix["record"])) as record:
        assert len(record.steps()) == 8
        assert record.fixes()[0]["azimuth_deg"] == fix["azimuth_deg"]
    again = northfinder("solve", fix["record"], "--json", cwd=tmp_path)
    assert json.loads(again.stdout)["azimuth_deg"] == fix["azimuth_deg"]


def test_find_shows_a_panel_and_plain_progress(tmp_path: Path) -> None:
    """Without a terminal: a panel with the truth on stdout, lines of progress on stderr."""
    done = northfinder("find", "--speed", "max", "--plan", "six-position", "--dwell", "10", cwd=tmp_path)
    assert "true north" in done.stdout
    assert "in the emulator" in done.stdout
    assert "dwell 3 at U3" in done.stderr
    assert len(list((tmp_path / "records").glob("north-*.sqlite"))) == 1


def test_find_over_tcp(tmp_path: Path) -> None:
    """The devices may be anywhere pyserial reaches: socket:// addresses work as device paths do."""
    with emulated("--tcp", "--speed", "max", "--seed", "3") as addresses:
        assert addresses["gyro"].startswith("native:socket://127.0.0.1:")
        devices = northfinder(
            "devices", "--json", addresses["gyro"].removeprefix("native:"), addresses["stage"].removeprefix("native:"),
            cwd=tmp_path,
        )  # fmt: skip
        assert [each["identity"]["kind"] for each in json.loads(devices.stdout)] == ["gyro", "stage"]
        done = northfinder(
            "find", "--json", "--gyro", addresses["gyro"], "--stage", addresses["stage"], "--profile", "tvg43",
            "--plan", "four-position", "--dwell", "10", "--latitude", "50.429", cwd=tmp_path,
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    fix = json.loads(done.stdout)
    assert abs(fix["azimuth_deg"] - 33) < 4 * fix["azimuth_sd_deg"]


def test_a_bench_file(tmp_path: Path) -> None:
    """Addresses, limits and the plan from a file."""
    with emulated("--speed", "max") as addresses:
        (tmp_path / "bench.toml").write_text(
            f'[gyro]\naddress = "{addresses["gyro"]}"\nprofile = "tvg43"\n'
            f'[stage]\naddress = "{addresses["stage"]}"\nazimuth_min_deg = -10.0\nazimuth_max_deg = 300.0\n'
            '[measurement]\nplan = "four-position"\ndwell_s = 5.0\nlatitude_deg = 50.429\n'
        )
        done = northfinder("find", "--config", "bench.toml", "--json", cwd=tmp_path)
    fix = json.loads(done.stdout)
    assert fix["plan"] == "four-position"
    with Record(Path(tmp_path / fix["record"])) as record:
        azimuths = [span.measured_azimuth for span in record.steps()]
    assert max(azimuths) < 5.24  # back to 0, not on to 360 deg


WRONG = [
    (["find", "--gyro", "native:/dev/tty-none", "--stage", "native:/dev/tty-none"], 3, "/dev/tty-none"),
    (["find", "--gyro", "native:/dev/null", "--stage", "native:/dev/null"], 3, "/dev/null"),
    (["find", "--gyro", "other:/dev/null", "--stage", "native:/dev/null"], 2, "no gyro driver 'other'"),
    (["find", "--gyro", "native:/dev/null"], 2, "--stage"),
    (["find", "--gyro", "native:a", "--stage", "native:b", "--seed", "1"], 2, "--seed is of the emulated"),
    (["find", "--plan", "five-position"], 2, "no plan 'five-position'"),
    (["find", "--profile", "none.toml"], 2, "no gyro profile 'none.toml'"),
    (["find", "--speed", "slow"], 2, "--speed: found 'slow', expected a number of at least 1, or max"),
    (["find", "--speed", "0.5"], 2, "--speed: found '0.5', expected a number of at least 1, or max"),
    (["find", "--speed", "nan"], 2, "--speed: found 'nan', expected a number of at least 1, or max"),
    (["find", "--config", "none.toml"], 2, "none.toml: cannot be read"),
    (["emulate", "--fault", "stage:boredom@3"], 2, "boredom"),
    (["solve", "none.csv"], 5, "none.csv: cannot be read"),
    (["solve", "empty.csv"], 5, "empty.csv"),
    (["solve", "missing.csv"], 5, "rate"),
    (["solve", "text.csv"], 5, "'fast'"),
]


@pytest.mark.parametrize(("arguments", "code", "message"), WRONG, ids=[" ".join(case[0][:3]) for case in WRONG])
def test_whatever_is_wrong_is_one_line_and_an_exit_code(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    code: int,
    message: str,
) -> None:
    """The line names the thing and what was found; the code is the documented one."""
    (tmp_path / "empty.csv").write_text("")
    (tmp_path / "missing.csv").write_text("stage_azimuth_deg,elevation_deg,duration_s\n0,0,3\n")
    (tmp_path / "text.csv").write_text("stage_azimuth_deg,elevation_deg,duration_s,rate_dph\n0,0,3,fast\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as left:
        main(arguments)
    assert left.value.code == code
    out, err = capsys.readouterr()
    assert message in only_line(err)
    assert out == ""


def test_a_wrong_option_is_a_usage_error(tmp_path: Path) -> None:
    """The parser's own complaints end with 2 as well."""
    done = northfinder("find", "--latitude", "95", cwd=tmp_path)
    assert done.returncode == 2
    assert "-90<=x<=90" in done.stderr


@contextmanager
def talking_port(answer: bytes) -> Iterator[str]:
    """Yield a pty behind which somebody answers whatever is written with `answer`."""
    master, slave = pty.openpty()
    tty.setraw(slave)

    def talk() -> None:
        while True:
            try:
                if not os.read(master, 4096):
                    return
                os.write(master, answer)
            except OSError:
                return

    thread = threading.Thread(target=talk, daemon=True)
    thread.start()
    yield os.ttyname(slave)
    os.close(slave)
    os.close(master)


def identity(*, version: int) -> bytes:
    """Return the refusing answer to HELLO of a gyro of another protocol version."""
    body = struct.pack("<BHIIBIQ16s16s8s", 0x81, version, 0x12345678, 0, 1, 7, 1_000_000, b"tvg43", b"A1", b"2.0")
    return bytes(cobs.encode(body + struct.pack("<I", fastcrc.crc32.iscsi(body)))) + b"\0"


STRANGERS = [
    (b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9*47\r\n", "no valid frame"),
    (b"\x00" * 7, "no valid frame"),
    (bytes(range(256)) * 4, "no valid frame"),
    (b"", "nothing answered"),
    (identity(version=2), "speaks protocol version 2, this driver speaks 1"),
]


@pytest.mark.parametrize(("answer", "message"), STRANGERS)
def test_a_stranger_behind_the_port(tmp_path: Path, answer: bytes, message: str) -> None:
    """Another instrument, or garbage: device error, and the port is named."""
    with talking_port(answer) as port, emulated() as addresses:
        done = northfinder("find", "--gyro", f"native:{port}", "--stage", addresses["stage"], cwd=tmp_path)
    assert done.returncode == 3
    assert port in only_line(done.stderr)
    assert message in only_line(done.stderr)


def test_devices_exchanged(tmp_path: Path) -> None:
    """A stage where a gyro is expected is recognised."""
    with emulated() as addresses:
        done = northfinder("find", "--gyro", addresses["stage"], "--stage", addresses["gyro"], cwd=tmp_path)
    assert done.returncode == 3
    assert "rotation stage, a gyro was expected" in only_line(done.stderr)


def test_damaged_frames_hold_up_no_measurement_at_full_speed(tmp_path: Path) -> None:
    """Lost frames, those that tell of arrival among them, hold up neither the emulator nor the host."""
    with emulated("--speed", "max", "--fault", "stage:flip=4e-4", "--fault", "gyro:flip=1e-5") as addresses:
        found = ["--gyro", addresses["gyro"], "--stage", addresses["stage"], "--profile", "tvg43", "--time", "120"]
        done = northfinder("find", *found, "--latitude", "50.429", "--quiet", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (path,) = (tmp_path / "records").iterdir()
    with Record(path) as record:
        kinds = [kind for _, kind, detail in record.events() if detail.startswith("stage, slew")]
    assert "link" in kinds


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_stops_stage_and_closes_the_record(tmp_path: Path, number: int) -> None:
    """Ctrl-C, termination and hang-up: exit code 130, and one closed file that says it was stopped."""
    command = [sys.executable, "-m", "northfinder", "find", "--speed", "100", "--seed", "1", "--plan", "six-position"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as child:
        assert child.stderr is not None
        for line in child.stderr:
            if line.startswith("dwell 2"):
                child.send_signal(number)
                break
        rest = child.stderr.read()
        assert child.wait(TIMEOUT) == 130
    assert "northfinder: stopped on request" in rest
    (path,) = (tmp_path / "records").iterdir()
    with Record(path) as record:
        assert record.events()[-1][1:] == ("state", "stopped")
        assert len(record.steps()) >= 1


def test_nothing_listens_beyond_loopback() -> None:
    """The emulator's TCP ports are not to be had from any other address of the machine."""
    with emulated("--tcp") as addresses:
        port = int(addresses["gyro"].rpartition(":")[2])
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            probe.connect(("127.0.0.1", port))
        hosts = {entry[4][0] for entry in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
        for host in hosts - {"127.0.0.1"}:
            with socket.socket() as probe:
                assert probe.connect_ex((str(host), port)) != 0


README = [("t13_1", 2.1, 3.7), ("t16_1", 15.3, 5.3), ("t17_1", 24.8, 10.5), ("t17_2", -6.4, 9.3), ("t17_3", 1.2, 14.7),
          ("t17_4", -43.7, 14.2)]  # fmt: skip


@pytest.mark.skipif(not DATA.is_dir(), reason="the real recordings are not beside this checkout")
@pytest.mark.parametrize(("name", "azimuth_deg", "sd_deg"), README)
def test_solve_agrees_with_plain_least_squares_on_real_dwells(
    tmp_path: Path, name: str, azimuth_deg: float, sd_deg: float
) -> None:
    """The azimuth of stage zero on the recordings of a real turntable, as found by independent means."""
    done = northfinder("solve", str(DATA / f"adxrs290_{name}.csv"), "--json", cwd=tmp_path)
    fix = json.loads(done.stdout)
    assert (fix["azimuth_deg"] - azimuth_deg + 180) % 360 - 180 == pytest.approx(0, abs=0.5 * sd_deg)
    assert fix["azimuth_sd_deg"] == pytest.approx(sd_deg, rel=0.15)
    assert fix["input_axis_offset_deg"] == 180


@pytest.mark.skipif(not DATA.is_dir(), reason="the real recordings are not beside this checkout")
def test_solve_a_real_triad(tmp_path: Path) -> None:
    """A ring-laser unit in two positions: biases below 0.5 deg/h, the latitude of the place."""
    done = northfinder("solve", str(DATA / "ln100_two_position_1hz.csv"), "--json", cwd=tmp_path)
    fix = json.loads(done.stdout)
    assert abs(fix["latitude_deg"] - 51.0784) < 0.5
    assert all(abs(bias) < 0.5 for bias in fix["bias_dph"])
    assert set(fix["positions"]) == {"up", "down"}
    assert set(fix["axes"]["y"]) >= {"azimuth_deg", "azimuth_sd_deg", "elevation_deg"}
    assert fix["axes"]["x"]["azimuth_deg"] is None  # it points up


def test_solve_help_names_its_options() -> None:
    """The help of a command shows an example."""
    assert solve_command.help is not None
    assert "northfinder solve dwells.csv" in solve_command.help


def test_a_measurement_starts_without_what_is_slow_to_import() -> None:
    """SciPy's statistics and the plots take a second to import, and `find` needs none of them."""
    program = "import sys, northfinder.cli.find; print([m for m in ('scipy.stats', 'matplotlib') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_what_devices_say_is_no_markup(capsys: pytest.CaptureFixture[str]) -> None:
    """Brackets in a model's name or in a finding are shown as they stand, and break nothing."""
    who = DeviceIdentity(kind="gyro", model="[/red]x[bold]", serial_number="7")
    Console(width=200).print(devices._table([Identification(address="tty[0]", identity=who, remark="[link=x]")]))
    doctor._show([Finding(verdict=Verdict.PASSED, name="links", sentence="said [/] and [red]")], as_json=False)
    out = capsys.readouterr().out
    assert all(text in out for text in ("[/red]x[bold]", "tty[0]", "[link=x]", "said [/] and [red]"))
