"""The stage's axes move, err and fail as physics would have it, and the boards hand that to the firmware."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from sim_device.plant.boards import ANGLE_LSB, RATE_LSB, SimGyroBoard, SimStageBoard
from sim_device.plant.earth import EARTH_RATE, Site
from sim_device.plant.gyro import ARCSEC, Gyro
from sim_device.plant.profile import AxisProfile, load_profile
from sim_device.plant.stage import Stage, StageAxis

PERIOD = 10_000
SPEED = math.radians(20.0)
PLAIN = AxisProfile(limit_deg=95.0, switch_deg=100.0, mechanics_deg=105.0)


def make_axis(seed: int = 1, **errors: float) -> StageAxis:
    """Return an axis with these errors."""
    return StageAxis(msgspec.structs.replace(PLAIN, **errors), SPEED, np.random.default_rng(seed))


def sweep(axis: StageAxis, target: float, begin_us: int, *, speed: float = math.radians(10.0)) -> int:
    """Drive to `target` at a constant speed as a controller would, and return when it has arrived."""
    start = axis.motor_angle(begin_us)
    n = max(1, math.ceil(abs(target - start) / (speed * PERIOD * 1e-6)))
    for k in range(1, n + 1):
        axis.drive(start + (target - start) * k / n, begin_us + (k - 1) * PERIOD, PERIOD)
    return begin_us + n * PERIOD


def test_follows_the_commands() -> None:
    """An ideal axis is where it was told one period later, and half way in between."""
    axis = make_axis()
    axis.drive(0.001, 50_000, PERIOD)
    assert axis.true_angle(49_999) == 0.0
    assert axis.true_angle(55_000) == pytest.approx(0.0005)
    assert axis.true_angle(60_000) == axis.true_angle(10**9) == pytest.approx(0.001)
    assert axis.true_angles(np.array([40_000.0, 52_500.0, 70_000.0])) == pytest.approx([0.0, 0.00025, 0.001])


def test_drive_has_a_greatest_speed() -> None:
    """A far command takes the time it takes, and a new one on the way starts from where the axis is."""
    axis = make_axis()
    axis.drive(math.radians(20.0), 0, PERIOD)
    assert axis.true_angle(500_000) == pytest.approx(math.radians(10.0))
    axis.drive(0.0, 500_000, PERIOD)
    assert axis.true_angle(750_000) == pytest.approx(math.radians(5.0))
    assert axis.true_angle(1_100_000) == pytest.approx(0.0)


def test_power_up_anywhere() -> None:
    """The axis stands anywhere within its power-up range, and the same seed finds it there again."""
    angles = np.degrees([make_axis(seed, power_up_deg=90.0).true_angle(0) for seed in range(200)])
    assert np.abs(angles).max() <= 90
    assert angles.std() == pytest.approx(90 / math.sqrt(3), rel=0.15)
    assert make_axis(5, power_up_deg=90.0).true_angle(0) == make_axis(5, power_up_deg=90.0).true_angle(0)


def test_positioning_error() -> None:
    """The true angle errs against the encoder by the profile's rms over a turn, the same way at each pass."""
    axis = make_axis(positioning_error_arcsec=2.0, mechanics_deg=1000.0, switch_deg=900.0)
    end = sweep(axis, 2 * math.pi, 0)
    times = np.linspace(0, end, 2000)
    error = (axis.true_angles(times) - np.array([axis.motor_angle(int(t)) for t in times])) / ARCSEC
    assert error.std() == pytest.approx(2.0, rel=0.02)
    there = axis.true_angle(end)
    again = sweep(axis, 2 * math.pi, sweep(axis, 0.3, end))
    assert axis.true_angle(again) == pytest.approx(there, abs=1e-12)


def test_repeatability() -> None:
    """Coming back again and again scatters by the profile's sd, and not while at rest."""
    axis = make_axis(repeatability_arcsec=0.5)
    now, angles = 0, []
    for _ in range(200):
        now = sweep(axis, 0.0, sweep(axis, 0.1, now + 500_000) + 500_000)
        assert axis.true_angle(now) == axis.true_angle(now + 400_000)
        angles.append(axis.true_angle(now) / ARCSEC)
    assert np.std(angles) == pytest.approx(0.5, rel=4 / math.sqrt(400))


def test_backlash() -> None:
    """Coming from the one side and from the other leaves the load apart by the backlash."""
    axis = make_axis(backlash_arcsec=10.0)
    up = sweep(axis, 0.1, 0)
    from_below = axis.true_angle(up)
    down = sweep(axis, 0.1, sweep(axis, 0.2, up))
    assert (axis.true_angle(down) - from_below) / ARCSEC == pytest.approx(10.0)


def test_encoder_resolution() -> None:
    """The encoder reads in steps of its resolution, never further off than half of it."""
    axis = make_axis(encoder_resolution_arcsec=0.2, power_up_deg=90.0)
    sweep(axis, 0.001, 0)
    readings = np.array([axis.encoder(t) for t in range(0, 100_000, 777)]) / (0.2 * ARCSEC)
    assert readings == pytest.approx(np.rint(readings), abs=1e-6)
    motor = np.array([axis.motor_angle(t) for t in range(0, 100_000, 777)]) / (0.2 * ARCSEC)
    assert np.abs(readings - motor).max() <= 0.5 + 1e-6


def test_switches_reference_and_stop() -> None:
    """The reference edge is at zero, a switch closes near the end, the stop holds the axis, and the drive says so."""
    axis = make_axis()
    now = sweep(axis, -0.1, 0)
    assert not axis.above_reference(now)
    now = sweep(axis, 0.1, now)
    assert axis.above_reference(now)
    now = sweep(axis, math.radians(99.9), now)
    assert not axis.limit_switch(now)
    now = sweep(axis, math.radians(100.1), now)
    assert axis.limit_switch(now)
    assert not axis.overload()
    now = sweep(axis, math.radians(120.0), now)
    assert axis.true_angle(now) == pytest.approx(math.radians(105.0))
    assert axis.overload()


def test_stall() -> None:
    """A blocked axis stays where it is, the drive complains, and it moves again once free."""
    axis = make_axis()
    axis.drive(0.01, 0, 100_000)
    axis.stall(50_000)
    axis.drive(0.02, 60_000, PERIOD)
    assert axis.true_angle(10**7) == pytest.approx(0.005)
    assert axis.overload()
    axis.stall(10**7, stalled=False)
    axis.drive(0.006, 10**7, PERIOD)
    assert axis.true_angle(10**7 + PERIOD) == pytest.approx(0.006)
    assert not axis.overload()


def test_runaway() -> None:
    """A drive that runs away goes on whatever it is told, up to the stop, until the fault ends."""
    axis = make_axis()
    axis.run_away(1_000_000, math.radians(-5.0))
    axis.drive(0.0, 2_000_000, PERIOD)
    assert axis.true_angle(3_000_000) == pytest.approx(math.radians(-10.0), abs=1e-6)
    axis.run_away(4_000_000, 0.0)
    assert axis.true_angle(10**8) == pytest.approx(math.radians(-15.0), abs=1e-6)
    axis.run_away(10**8, math.radians(50.0))
    assert axis.true_angle(10**9) == pytest.approx(math.radians(105.0))


def test_encoder_and_switch_faults() -> None:
    """An encoder freezes or jumps, a switch sticks, and the axis itself does not care."""
    axis = make_axis()
    axis.freeze_encoder(0)
    now = sweep(axis, 0.1, 0)
    assert axis.encoder(now) == 0.0
    axis.freeze_encoder(now, frozen=False)
    axis.jump_encoder(0.05)
    assert axis.encoder(now) == pytest.approx(0.15)
    assert axis.true_angle(now) == pytest.approx(0.1)
    axis.stick_limit_switch(closed=True)
    assert axis.limit_switch(now)
    axis.stick_limit_switch(closed=None)
    assert not axis.limit_switch(now)


def test_long_forgotten_trajectory_is_refused() -> None:
    """The trajectory is kept for 100 s of motion; asking further back is an error, not a wrong angle."""
    axis = make_axis()
    now = 0
    for target in (0.5, -0.5) * 20:
        now = sweep(axis, target, now)
    assert axis.true_angles(np.array([now - 90e6, float(now)])).shape == (2,)
    with pytest.raises(ValueError, match="the trajectory is kept from"):
        axis.true_angles(np.array([1e6, 2e6]))


def make_boards(tilt: tuple[float, float] = (0.0, 0.0)) -> tuple[SimGyroBoard, SimStageBoard]:
    """Return the boards of the ideal bench at the equator, heading east of north by 30 deg, at rest at zero."""
    profile = load_profile("ideal")
    axes = {name: msgspec.structs.replace(getattr(profile.stage, name), power_up_deg=0.0) for name in ("azimuth",)}
    stage = Stage(msgspec.structs.replace(profile.stage, elevation=axes["azimuth"], **axes), np.random.SeedSequence(1))
    site = Site(latitude=0.0, heading=math.radians(30.0), tilt=tilt)
    gyro = SimGyroBoard(
        Gyro(profile.gyro, site, seed=1),
        stage,
        serial_number="G1",
        tilt_rng=np.random.default_rng(1),
        accelerometer_rng=np.random.default_rng(1),
        epoch_us=0,
        boot_count=1,
    )
    return gyro, SimStageBoard(stage, serial_number="S1", epoch_us=0, boot_count=1)


def test_gyro_board_samples_where_the_stage_is() -> None:
    """Samples taken while the stage turns hold its rotation, whose sum is the angle turned, then the new attitude."""
    gyro, stage = make_boards()
    gyro.start_sampling(0)
    before = np.frombuffer(gyro.read_samples(47), "<i4") * RATE_LSB
    assert before == pytest.approx(EARTH_RATE * math.cos(math.radians(30.0)), abs=RATE_LSB)
    now, step = 1_000_000, round(math.radians(0.1) / ANGLE_LSB)  # 10 deg/s in elevation
    for k in range(1, 101):
        stage.drive(1, k * step, now + (k - 1) * PERIOD)
    for k in range(1, 101):
        stage.drive(0, k * step, now + (k - 1) * PERIOD)
    assert gyro.sample_time_us(235) == 1_000_000
    moving = np.frombuffer(gyro.read_samples(500), "<i4") * RATE_LSB
    assert moving.shape == (500,)
    after = np.frombuffer(gyro.read_samples(1), "<i4")[0] * RATE_LSB
    azimuth, elevation = math.radians(40.0), math.radians(10.0)
    assert after == pytest.approx(EARTH_RATE * math.cos(azimuth) * math.cos(elevation), abs=RATE_LSB)
    assert stage.encoder(0, 3_000_000) == stage.encoder(1, 3_000_000) == 100 * step
    # about the x axis the azimuth's rotation is seen as -sin(elevation) of it: its integral, 1 - cos, over 10 deg
    turned = (moving - EARTH_RATE * 0.84).sum() / 235
    assert turned == pytest.approx(-(1 - math.cos(elevation)), abs=2e-5)


def test_gyro_board_reports_tilt_and_time() -> None:
    """Tilt goes out in 0.1 arcsec, temperature in 1/256 degree; sample times do not drift."""
    gyro, _ = make_boards(tilt=(30 * ARCSEC, -12.5 * ARCSEC))
    gyro.start_sampling(5)
    gyro.read_samples(1)
    assert gyro.tilt() == (300, -125)
    assert gyro.temperature() == 24 * 256
    assert gyro.status() == 0
    gyro.sensor_fault = True
    assert gyro.status() == 4
    assert gyro.sample_time_us(235 * 3600) == 5 + 3600 * 1_000_000


def test_noise_between_streams_goes_on() -> None:
    """A stream that starts a little later meets the same noise; one that starts ten minutes later meets later noise."""
    profile = load_profile("tvg43")

    def first_samples(start_us: int) -> bytes:
        stage = Stage(profile.stage, np.random.SeedSequence(1))
        board = SimGyroBoard(
            Gyro(profile.gyro, Site(latitude=0.5, heading=0.0), seed=1),
            stage,
            serial_number="G",
            tilt_rng=np.random.default_rng(1),
            accelerometer_rng=np.random.default_rng(1),
            epoch_us=0,
            boot_count=1,
        )
        board.start_sampling(start_us)
        return board.read_samples(10)

    assert first_samples(1_000_000) == first_samples(1_234_567)
    assert first_samples(1_000_000) != first_samples(601_000_000)


def test_stage_board_counts_from_power_up() -> None:
    """Encoder counts start at zero wherever the axis stands, and limits are the profile's in 0.1 arcsec."""
    profile = load_profile("tvg43").stage
    stage = Stage(profile, np.random.SeedSequence(3))
    board = SimStageBoard(stage, serial_number="S", epoch_us=0, boot_count=1)
    assert [board.encoder(axis, 0) for axis in (0, 1)] == [0, 0]
    assert abs(stage.azimuth.true_angle(0)) > math.radians(1.0)
    board.drive(0, -1000, 0)
    assert board.encoder(0, 10_000) == pytest.approx(-1000, abs=2)
    assert board.azimuth_limits == (-13_680_000, 13_680_000)
    assert board.max_speed == 405_000
    assert board.reference_side(0, 0) == (1 if stage.azimuth.true_angle(0) > 0 else -1)
    assert not board.e_stop(0)
    stage.e_stop = True
    assert board.e_stop(0)
