"""A triad measures: at rest, turned by hand, on a stage; found again from the record; and what is refused."""

from __future__ import annotations

import io
import json
import math
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from virtual import Unwatched, VirtualBench, assume

from drivers.api import Gyro, RateBlock, Stage
from drivers.fixed_mount import FixedMount
from drivers.transport.clock import SystemClock
from northfinder.adaptive import Wishes, make_plan
from northfinder.cli.operator import TerminalOperator
from northfinder.errors import ConfigError, EstimateError
from northfinder.measurement import Measurement, Outcome, measure
from northfinder.sequencer import Plan
from northfinder.solve_file import solve_record
from northfinder.triad_plans import fit_for
from sim_device.bench import SimBench
from sim_device.plant.earth import Site, pedestal_attitude

MICRO_G = 9.80665e-6
TILT = (math.radians(4.0), math.radians(-3.0))


@dataclass
class WithAccelerometers:
    """The native gyro with the emulated accelerometers in the place of its tilt sensors."""

    gyro: Any
    bench: SimBench

    def read(self) -> list[RateBlock]:
        """Return the blocks, with what the accelerometers read meanwhile."""
        return [self._beside(block) for block in self.gyro.read()]

    def _beside(self, block: RateBlock) -> RateBlock:
        x, y, z = (MICRO_G * count for count in self.bench.gyro_board.specific_force())
        return replace(block, tilt=None, specific_force=(x, y, z))

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401  # whatever a gyro has
        return getattr(self.gyro, name)


@dataclass
class Turner:
    """An operator who turns the emulated stage by half a turn, at once."""

    bench: VirtualBench
    requests: list[str]

    def ask(self, request: str) -> None:
        """Turn it."""
        self.requests.append(request)
        stage = self.bench.bench.plant_stage
        axis, now_us = stage.azimuth, self.bench.bench.now_us
        axis.drive(axis.motor_angle(now_us) + math.pi, now_us, 1000)

    def has_answered(self) -> bool:
        """Say that it is done."""
        return True


def bench_of(profile: str = "triad", *, seed: int = 1, tilt: tuple[float, float] = TILT, **site: float) -> VirtualBench:
    """Return a bench, level unless tilted, at azimuth 33 deg and latitude 50.429 deg unless said otherwise."""
    azimuth, latitude = (math.radians(site.get(name, angle)) for name, angle in (("azimuth", 33), ("latitude", 50.429)))
    return VirtualBench(SimBench(profile, seed=seed, azimuth=azimuth, latitude=latitude, tilt=tilt))


def run(
    bench: VirtualBench, record: Path, plan: str, *, stage: Callable[[], Stage] | None = None,
    accelerometers: bool = True, profile: str = "triad", time: float = 120.0, **assumed: Any,  # noqa: ANN401  # handed through
) -> Outcome:  # fmt: skip
    """Run the plan of that name, on a fixed mount unless there is a stage."""
    assumptions = assume(profile, **assumed)
    course: Plan = make_plan(Wishes(name=plan, time=time), assumptions, settle=0.5)

    def open_gyro() -> Gyro:
        gyro: Any = bench.open_gyro()
        return fit_for(WithAccelerometers(gyro, bench.bench) if accelerometers else gyro, plan)

    measurement = Measurement(
        open_gyro=open_gyro, open_stage=stage or (lambda: FixedMount(bench.clock)), plan=course, settle=0.5,
        assumptions=assumptions, record=record,
    )  # fmt: skip
    return measure(measurement, clock=bench.clock, utc=bench.clock.now, watcher=Unwatched())


def azimuth_of_x(azimuth_deg: float, tilt: tuple[float, float]) -> float:
    """Return where the first axis points on the ground, rad."""
    x = pedestal_attitude(Site(latitude=0.0, heading=math.radians(azimuth_deg), tilt=tilt))[:, 0]
    return math.atan2(x[1], x[0])


def off(outcome: Outcome, azimuth: float) -> float:
    """Return the error of the azimuth in stated standard deviations."""
    return math.remainder(outcome.fix.azimuth - azimuth, 2 * math.pi) / outcome.fix.azimuth_sd


@pytest.mark.parametrize(("azimuth", "latitude"), [(33, 50.429), (147, -33), (200, 10), (301, 62)])
def test_a_triad_at_rest_finds_north(tmp_path: Path, azimuth: int, latitude: float) -> None:
    """Without a stage, leaning by 5 deg, levelled by its accelerometers: right within what it states, and no surer."""
    bench = bench_of(seed=azimuth, azimuth=azimuth, latitude=latitude)
    outcome = run(bench, tmp_path / "r.sqlite", "static", time=60.0)
    assert abs(off(outcome, azimuth_of_x(azimuth, TILT))) < 3.5
    by_bias = 0.1 / (15.041 * math.cos(math.radians(latitude)))
    assert by_bias < outcome.fix.azimuth_sd < 1.5 * by_bias
    assert outcome.fix.latitude is not None
    assert outcome.fix.latitude_sd is not None
    assert abs(outcome.fix.latitude - math.radians(latitude)) < 3.5 * outcome.fix.latitude_sd
    assert outcome.fix.trustworthy
    report = outcome.to_json()
    assert report["levelling"]["tilt_x_deg"] == pytest.approx(4.0, abs=0.03)
    assert {line["quantity"] for line in report["budget"]} >= {"bias", "tilt"}
    again = solve_record(tmp_path / "r.sqlite")
    assert {name: again[name] for name in again if name in report} == {
        name: report[name] for name in again if name in report
    }


def test_tilt_sensors_level_a_triad_as_well(tmp_path: Path) -> None:
    """Where they have measured the accelerometers are not asked: no levelling in the result."""
    outcome = run(bench_of(tilt=(0.01, 0.02)), tmp_path / "r.sqlite", "static", time=60.0, accelerometers=False)
    assert abs(off(outcome, math.radians(33))) < 3.5
    assert "levelling" not in outcome.to_json()


def test_a_triad_turned_by_hand_is_surer(tmp_path: Path) -> None:
    """The operator is asked once, for half a turn; level biases of gyros and accelerometers go out."""
    bench = bench_of(seed=4, tilt=(0.0, 0.0))
    operator = Turner(bench, [])
    outcome = run(
        bench, tmp_path / "r.sqlite", "two-position", stage=lambda: FixedMount(bench.clock, operator),
        turn_sd_deg=0.05,
    )  # fmt: skip
    assert operator.requests == ["turn the gyro by 180 deg either way and leave it at rest"]
    assert abs(off(outcome, math.radians(33))) < 3.5
    assert outcome.fix.azimuth_sd < math.radians(0.15)
    report = outcome.to_json()
    assert report["levelling"]["tilt_sd_deg"] < 0.002
    assert report["levelling"]["accelerometer_bias_mg"][:2] == pytest.approx([0.15, -0.1], abs=0.02)
    assert any(line["quantity"] == "turn by hand" for line in report["budget"])


@pytest.mark.parametrize("plan", ["six-position", "refined"])
@pytest.mark.parametrize("latitude_deg", [None, 50.429])
def test_a_triad_on_the_full_cyclogram(tmp_path: Path, plan: str, latitude_deg: float | None) -> None:
    """All three axes estimated together, levelled on the turning stage: azimuth and latitude as sure as they say."""
    tilt = (math.radians(0.2), math.radians(-0.3))
    bench = bench_of("triad", seed=11, tilt=tilt)
    outcome = run(
        bench, tmp_path / "r.sqlite", plan, stage=bench.open_stage, time=150.0, latitude_deg=latitude_deg,
    )  # fmt: skip
    assert abs(off(outcome, azimuth_of_x(33, tilt))) < 3.5
    assert outcome.fix.azimuth_sd < math.radians(0.12)
    assert outcome.fix.latitude is not None
    if latitude_deg is None:
        assert outcome.fix.latitude_sd is not None
        assert abs(outcome.fix.latitude - math.radians(50.429)) < 3.5 * outcome.fix.latitude_sd
        assert outcome.fix.latitude_sd < math.radians(0.12)
    assert outcome.fix.trustworthy
    report = outcome.to_json()
    assert report["levelling"]["tilt_x_deg"] == pytest.approx(0.2, abs=4 * report["levelling"]["tilt_sd_deg"])
    assert len(outcome.fix.bias) == 3


def test_one_gyro_cannot_do_what_three_can(tmp_path: Path) -> None:
    """A gyro of one axis is turned away before anything is measured."""
    with pytest.raises(ConfigError, match=r"plan static needs a triad of gyros, and the tvg43 has one axis"):
        run(bench_of("tvg43"), tmp_path / "r.sqlite", "static", accelerometers=False)


def test_the_plan_static_must_know_the_biases() -> None:
    """A profile that is silent about them gives no figure for the azimuth; an end at an sd cannot be had."""
    with pytest.raises(ConfigError, match=r"give --profile with gyro_bias_sd_dph under \[errors\]"):
        make_plan(Wishes(name="static"), assume("tvg43"), settle=0.5)
    with pytest.raises(ConfigError, match="leave --until-sd out"):
        make_plan(Wishes(name="two-position", until_sd=0.01), assume("triad"), settle=0.5)


def test_a_triad_that_lies_over_is_told_how_to_stand(tmp_path: Path) -> None:
    """Its third axis must point down, more or less."""
    with pytest.raises(EstimateError, match="mount the triad with its third axis down"):
        run(bench_of(tilt=(1.2, 0.0)), tmp_path / "r.sqlite", "static", time=20.0)


def test_a_fixed_mount_turns_nowhere() -> None:
    """It is asked for nothing but its own position."""
    mount = FixedMount(SystemClock())
    mount.move(0.0, 0.0)
    assert mount.state() is mount.state()
    with pytest.raises(ValueError, match="there is no stage to turn to azimuth 90, elevation 0"):
        mount.move(math.pi / 2, 0.0)


def test_enter_says_that_the_turn_is_made() -> None:
    """A line on standard input is the answer; the end of the input is none."""
    said: list[str] = []
    clock = SystemClock()
    operator = TerminalOperator(clock, said.append, io.StringIO("\n"))
    mount = FixedMount(clock, operator)
    mount.move(math.pi, 0.0)
    deadline = clock.now() + 10.0
    while not mount.state().in_position and clock.now() < deadline:
        clock.wait(deadline)
    assert mount.state().azimuth == math.pi
    assert said == ["turn the gyro by 180 deg either way and leave it at rest; then press Enter"]
    mount.move(0.0, 0.0)
    mount.stop()
    assert mount.state().azimuth == math.pi


def test_without_a_terminal_nobody_can_be_asked() -> None:
    """Said before a port is opened."""
    with pytest.raises(ConfigError, match="there is no terminal to ask at: give --stage"):
        TerminalOperator(SystemClock(), print)


def test_find_needs_no_stage(tmp_path: Path) -> None:
    """The whole command on the emulated triad, and a plan that needs a stage told so."""
    find = [sys.executable, "-m", "northfinder", "find"]
    asked = ["--plan", "static", "--time", "60", "--speed", "max", "--seed", "2", "--json", "--quiet"]
    ran = subprocess.run([*find, *asked, "--out", str(tmp_path)], capture_output=True, check=False, timeout=300)
    assert ran.returncode == 0, ran.stderr
    result = json.loads(ran.stdout)
    assert abs(result["azimuth_deg"] - 33.0) < 4.0 * result["azimuth_sd_deg"]
    assert 0.5 < result["azimuth_sd_deg"] < 1.0
    refused = subprocess.run(
        [*find, "--gyro", "native:/dev/none", "--plan", "six-position"], capture_output=True, check=False, timeout=300
    )
    assert refused.returncode == 2
    assert b"the plan six-position turns the gyro on a stage: give --stage" in refused.stderr


def test_the_emulator_serves_a_gyro_alone_at_zero() -> None:
    """What stands on no stage stands where the truth says, not where a stage happens to be switched on."""
    axes = (SimBench("tvg43", seed=1, parked=True).plant_stage, SimBench("tvg43", seed=1).plant_stage)
    parked, anywhere = (abs(stage.azimuth.true_angle(0)) for stage in axes)
    assert parked < 1e-3
    assert anywhere > 0.1
