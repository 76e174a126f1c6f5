"""``northfinder allan`` as users meet it: tables, JSON, saved profile, picture, exit codes."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import allantools
import numpy as np
import pytest

from northfinder.cli import main
from northfinder.profile import find_profile
from northfinder.units import DPH
from sim_device.plant.noise import NoiseCoefficients, RateNoise
from sim_device.plant.profile import load_profile

ADIS = Path(__file__).parents[2] / "shared" / "data" / "adis16405_static_x_100hz.npz"
NOISE = NoiseCoefficients(angle_random_walk=0.003 * 60.0 * DPH, bias_instability=0.06 * DPH)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One hour of an emulated gyro at 10 Hz, with angle random walk and bias instability only."""
    path = tmp_path_factory.mktemp("static") / "static.npz"
    rate = RateNoise(NOISE, 10.0, np.random.SeedSequence(4)).read(36_000)
    np.savez(path, rate_dph=rate / DPH, sample_rate_hz=10.0)
    return path


def allan(*arguments: str | Path) -> int:
    """Run the command and return its exit code."""
    with pytest.raises(SystemExit) as left:
        main(["allan", *map(str, arguments)])
    assert isinstance(left.value.code, int)
    return left.value.code


def as_json(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> dict[str, Any]:
    """Run the command and return its one JSON object."""
    assert allan(*arguments, "--json") == 0
    result: dict[str, Any] = json.loads(capsys.readouterr().out)
    return result


def test_json_holds_coefficients_and_curve(capsys: pytest.CaptureFixture[str], recording: Path) -> None:
    """The coefficients lie within 3.5 sd of the emulator's; the arrays of the curve are of one length."""
    result = as_json(capsys, recording)
    found = result["coefficients"]
    for key, true in (("angle_random_walk_deg_per_sqrt_h", 0.003), ("bias_instability_dph", 0.06)):
        assert abs(found[key]["value"] - true) < 3.5 * found[key]["sd"]
        assert found[key]["observable"]
    white = found["angle_white_noise_dph_s"]
    assert (white["value"], white["sd"], white["observable"]) == (0.0, None, False)
    assert 0.0 < white["upper_bound"] < 0.05
    assert result["duration_s"] == 3600.0
    assert {len(column) for name, column in result["allan"].items() if name != "confidence"} == {38}


def test_a_saved_profile_is_taken_by_instrument_and_emulator(
    capsys: pytest.CaptureFixture[str], recording: Path, tmp_path: Path
) -> None:
    """Both read the same coefficients from the file; a profile that exists is not overwritten."""
    path = tmp_path / "mine.toml"
    result = as_json(capsys, recording, "--save", path, "--name", 'gyro "7"')
    saved, emulated = find_profile(str(path)), load_profile(path)
    assert saved.name == emulated.name == 'gyro "7"'
    for key, coefficient in result["coefficients"].items():
        assert getattr(saved.noise, key) == pytest.approx(coefficient["value"], rel=1e-5)
        assert getattr(emulated.gyro.noise, key) == getattr(saved.noise, key)
    assert allan(recording, "--save", path) == 5
    assert "exists already" in capsys.readouterr().err


def test_tables_for_people(capsys: pytest.CaptureFixture[str], recording: Path) -> None:
    """Coefficients by their IEEE names with units, what is not observable, and the deviation at each decade."""
    assert allan(recording, "--skip", "60") == 0
    out = capsys.readouterr().out
    for text in ("angle random walk", "deg/√h", "bias instability", "not observable", "35400 samples", "95 % band"):
        assert text in out
    assert [line.split()[1] for line in out.splitlines() if ".." in line] == ["0.1", "1", "10", "100", "1000"]


def test_plot_is_the_same_svg_each_time(capsys: pytest.CaptureFixture[str], recording: Path, tmp_path: Path) -> None:
    """The picture is SVG, and the same data give the same bytes."""
    one, other = tmp_path / "one.svg", tmp_path / "other.svg"
    for path in (one, other):
        as_json(capsys, recording, "--plot", path)
    assert ET.parse(one).getroot().tag.endswith("svg")  # noqa: S314  # our own file
    assert one.read_bytes() == other.read_bytes()
    assert allan(recording, "--plot", tmp_path / "no" / "such.svg") == 5


def test_nothing_is_drawn_unasked(recording: Path) -> None:
    """Without a plot matplotlib is not imported: it would take longer than the command itself."""
    code = (
        "import sys; from northfinder.cli.allan import command; command.main(sys.argv[1:], standalone_mode=False);"
        "sys.exit('matplotlib' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(recording)], capture_output=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("text", "code", "message"),
    [
        ("time_s,rate_dph\n0,1\n1,2\n2,4\n", 4, "too short a record"),
        ("time_s,speed\n0,1\n1,2\n", 5, "name one with --column"),
    ],
)
def test_failures_are_one_line_and_an_exit_code(
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    text: str,
    code: int,
    message: str,
) -> None:
    """Data that tell nothing end with 4, a file that is no recording with 5."""
    path = tmp_path / "a.csv"
    path.write_text(text)
    assert allan(path) == code
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.skipif(not ADIS.exists(), reason="the recording is not part of the project")
def test_a_real_recording_agrees_with_allantools(capsys: pytest.CaptureFixture[str]) -> None:
    """10,000 s of a real gyro: the deviation agrees to 1e-6; coefficients and fit are those of its Allan plot."""
    result = as_json(capsys, ADIS)
    curve = result["allan"]
    with np.load(ADIS) as file:
        rate = file["rate_counts"] * file["deg_s_per_count"] * 3600.0
    _, peer, _, _ = allantools.oadev(rate, rate=100.0, data_type="freq", taus=np.array(curve["tau_s"]))
    np.testing.assert_allclose(curve["deviation_dph"], peer, rtol=1e-6)
    tau = np.array(curve["tau_s"])
    within = (tau > 0.1) & (tau < 200.0)
    np.testing.assert_allclose(np.array(curve["model_dph"])[within], peer[within], rtol=0.1)
    assert result["coefficients"]["angle_random_walk_deg_per_sqrt_h"]["value"] == pytest.approx(2.41, abs=0.05)
    assert result["coefficients"]["bias_instability_dph"]["value"] == pytest.approx(27.5, abs=5.0)


def test_a_record_too_short_for_a_profile_saves_none(
    capsys: pytest.CaptureFixture[str], recording: Path, tmp_path: Path
) -> None:
    """Five minutes say nothing of the drift within a measurement: exit code 4, and no file."""
    path = tmp_path / "short.toml"
    assert allan(recording, "--skip", "3300", "--save", path) == 4
    assert "a profile needs at least 600 s at rest, and this record holds 300 s" in capsys.readouterr().err
    assert not path.exists()
