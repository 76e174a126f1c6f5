"""The proof of accuracy: seeded cycles of the emulated gyro, against what is published and what is stated.

Bounds follow from the numbers of runs; without the wire but where a test says so.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from accuracy import (
    PUBLISHED_AZIMUTH,
    Bench,
    Deviation,
    assume,
    campaign,
    deviation,
    figures,
    misses,
    of_fix,
    plant,
    refined,
)
from ahrs.filters import TRIAD
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from simulated_means import TVG43, make_means
from virtual import virtual_bench

from northfinder.cyclogram import four_position, six_position
from northfinder.estimation import ClosedForm, Fix, NoiseModel, RateMeans, estimate, solve_closed_form
from northfinder.estimation.dwell_table import solve_dwell_table
from northfinder.estimation.geometry import sensitivity
from northfinder.estimation.noise_identification import identify
from northfinder.estimation.triad import StaticMean, gyrocompass
from northfinder.profile import GyroProfile, NoiseTable
from northfinder.record import DwellSpan, Record
from northfinder.reduction import reduce_record
from northfinder.solution import solve
from northfinder.tables import DwellTable, read_table
from northfinder.units import DPH, EARTH_RATE
from sim_device.plant.earth import Site
from sim_device.plant.gyro import Gyro, noise_coefficients
from sim_device.plant.noise import NoiseSource, RateNoise, RecordedNoise

Array = NDArray[np.float64]

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
PAPER = Site(latitude=math.radians(50.429), heading=PUBLISHED_AZIMUTH)
N_CYCLES = 300
LIMIT_4 = 14.86  #: chi-square of 4 degrees of freedom exceeds it in 0.5 % of cases
TRUE_NOISE = NoiseModel.from_field_units(**TVG43)


def site(azimuth_deg: float, latitude_deg: float) -> Site:
    """Return a site, angles in degrees."""
    return Site(latitude=math.radians(latitude_deg), heading=math.radians(azimuth_deg))


def published_means(seed: int, *, at: Site = PAPER, noise: NoiseSource | None = None) -> RateMeans:
    """Return 1 s means of the published cyclogram."""
    return Bench(profile="tvg43", site=at, seed=seed, turn=10.0, noise=noise).measure(six_position())


def rms(values: list[float]) -> float:
    """Return the root mean square."""
    return math.sqrt(math.fsum(value**2 for value in values) / len(values))


def covered(errors: list[Deviation]) -> float:
    """Return the part of the azimuths within their 95 % interval."""
    return figures(errors)["azimuth_coverage"]


# The published table


@lru_cache
def closed_forms() -> tuple[ClosedForm, ...]:
    """Return the closed forms on seeded cycles at the published place, each after a start of the gyro of its own."""
    return tuple(
        solve_closed_form(published_means(seed), known_latitude=PAPER.latitude) for seed in range(1, N_CYCLES + 1)
    )


def test_formula_2_scatters_as_published() -> None:
    """Sd 0.19 deg sec(lat) within a turn-on, within 15 % (the sampling error is 4 %), and no bias."""
    errors = [deviation(PAPER, form.azimuth, 0.0).azimuth for form in closed_forms()]
    assert math.degrees(rms(errors)) == pytest.approx(0.19, rel=0.15)
    assert abs(np.mean(errors)) < 4.0 * rms(errors) / math.sqrt(N_CYCLES)


def test_latitude_by_formula_3_is_off_as_published() -> None:
    """Near 56 deg at 50.429, where the acceleration-sensitive drift rate puts it; sd of a few tenths of a degree."""
    latitudes = np.degrees([form.latitude or 0.0 for form in closed_forms()])
    assert np.mean(latitudes) == pytest.approx(56.07, abs=0.6)
    assert 0.1 < np.std(latitudes) < 0.45


def test_bias_and_scale_factors_of_the_planes_are_those_published() -> None:
    """Bias 38 sd 0.46 deg/h in both planes; by (10) scale factors 1.021 and 1.280, ratio 0.797."""
    forms = closed_forms()
    for biases in ([form.bias_horizontal for form in forms], [form.bias_vertical or 0.0 for form in forms]):
        assert np.mean(biases) / DPH == pytest.approx(38.0, abs=4.0 * 0.46 / math.sqrt(N_CYCLES))
        assert np.std(biases) / DPH == pytest.approx(0.46, rel=4.0 / math.sqrt(2.0 * N_CYCLES))
    horizontal = float(np.mean([form.scale_factor_horizontal or 0.0 for form in forms]))
    vertical = float(np.mean([form.scale_factor_vertical or 0.0 for form in forms]))
    assert horizontal == pytest.approx(1.021, abs=0.002)
    assert vertical == pytest.approx(1.280, abs=0.002)
    assert horizontal / vertical == pytest.approx(0.797, abs=0.002)


def replayed(spans: list[DwellSpan], *, seed: int, minutes: int) -> Array:
    """Return the dwell means that the plant gives without the wire, its noise begun so long before the samples."""
    gyro = Gyro(plant("tvg43"), PAPER, seed=seed, start=1, batch=8192)
    gyro.skip(minutes * 60 * 235)
    at, rates = 0, []
    for span in spans:
        gyro.skip(span.first_index - at)
        at = span.stop_index
        rates.append(gyro.measure_at_rest(span.azimuth, span.elevation, at - span.first_index).mean())
    return np.array(rates)


def test_the_wire_changes_nothing(tmp_path: Path) -> None:
    """What firmware, protocol, driver and record make of a cycle are the plant's own dwell means, to 1 mdeg/h."""
    bench = virtual_bench(seed=2, azimuth_deg=math.degrees(PAPER.heading))
    bench.measure(tmp_path / "cycle.sqlite", six_position(30.0))
    with Record(tmp_path / "cycle.sqlite") as record:
        wired, spans = reduce_record(record).means().per_dwell(), record.steps()
    unwired = [wired.with_rate(replayed(spans, seed=2, minutes=minutes)) for minutes in range(3)]
    differences = [float(np.abs(means.rate - wired.rate).max()) / DPH for means in unwired]
    same, *others = np.argsort(differences)
    assert differences[same] < 0.001
    assert differences[others[0]] > 0.05  # other noise would show
    azimuths = [solve_closed_form(means).azimuth for means in (wired, unwired[same])]
    assert azimuths[0] == pytest.approx(azimuths[1], abs=math.radians(0.01))


# Real noise


def recording(name: str) -> Path:
    """Return the path of a recording, or skip where the recordings are not at hand."""
    path = DATA / name
    if not path.exists():
        pytest.skip(f"no recording {path}")
    return path


def profile_of(noise: NoiseModel) -> GyroProfile:
    """Return a profile of that noise alone, as the allan command saves it."""
    hour = 3600.0
    return GyroProfile(
        name="identified",
        noise=NoiseTable(
            angle_white_noise_dph_s=noise.angle_white_noise / DPH,
            angle_random_walk_deg_per_sqrt_h=math.degrees(noise.angle_random_walk) * math.sqrt(hour),
            bias_instability_dph=noise.bias_instability / DPH,
            rate_random_walk_dph_per_sqrt_h=noise.rate_random_walk / DPH * math.sqrt(hour),
            rate_ramp_dph_per_h=noise.rate_ramp / DPH * hour,
        ),
        acceleration_sensitive_drift_rate_dph_per_g=3.0,
    )


def scaled(noise: NoiseModel, factor: float) -> NoiseModel:
    """Return the model with all coefficients times `factor`."""
    return NoiseModel(*(factor * getattr(noise, name) for name in noise.__slots__))


def test_a_profile_identified_from_a_real_recording_covers_its_noise() -> None:
    """Half of a real gyro's 10,000 s, scaled to the bias instability of tvg43, gives the profile for the other half.

    Four short dwells and one again at two headings a quarter turn apart, whose errors are nearly independent: 184 of
    them, a sampling error of 1.6 %.
    """
    with np.load(recording("adis16405_static_x_100hz.npz")) as file:
        sample_rate, rate = float(file["sample_rate_hz"]), np.radians(file["rate_counts"] * file["deg_s_per_count"])
    cyclogram = four_position(15.0)
    length = round((cyclogram.duration + 4 * 8.0) * sample_rate)
    halves, errors = np.split(rate, 2), []
    for known, measured in (halves, halves[::-1]):
        noise = identify(known, sample_rate).noise
        factor = TRUE_NOISE.bias_instability / noise.bias_instability
        assumptions = replace(assume("tvg43"), profile=profile_of(scaled(noise, factor)))
        for first in range(0, measured.size - length + 1, length):
            stretch = measured[first : first + length] * factor
            for heading_deg in (30.0 + first / length, 120.0 + first / length):
                at = site(heading_deg, 50.0)
                source = RecordedNoise(stretch, sample_rate, sample_rate=1.0)
                means = Bench(profile="tvg43", site=at, seed=first, noise=source).measure(cyclogram)
                errors.append(of_fix(at, solve(means, assumptions)))
    assert len(errors) > 180
    assert 0.92 <= covered(errors) <= 0.98


# A profile that is wrong


@lru_cache
def published_cycles(n: int = 200) -> tuple[tuple[Site, RateMeans], ...]:
    """Return seeded cycles of the published cyclogram at azimuths all around and latitudes south and north."""
    sites = [site(360.0 * i / n, -70.0 + 140.0 * ((i * 0.618034) % 1.0)) for i in range(n)]
    return tuple((at, published_means(1000 + i, at=at)) for i, at in enumerate(sites))


def estimates(factor: float, cycles: tuple[tuple[Site, RateMeans], ...]) -> tuple[list[Deviation], list[Fix]]:
    """Return the errors and fixes with a profile whose coefficients are `factor` times the truth."""
    noise = scaled(TRUE_NOISE, factor)
    fixes = [estimate(means, noise=noise, weights="generalised") for _, means in cycles]
    return [of_fix(at, fix, latitude_known=True) for (at, _), fix in zip(cycles, fixes, strict=True)], fixes


def says_that_the_profile_does_not_fit(fix: Fix) -> bool:
    """Return whether a sentence of the fix says so."""
    return any("the noise model does not fit" in check.sentence for check in fix.checks if not check.passed)


def test_half_the_noise_in_the_profile_still_covers_and_is_said() -> None:
    """All coefficients half the truth: the 95 % interval covers 93 % or more, and every fix says what is wrong."""
    errors, fixes = estimates(0.5, published_cycles())
    assert covered(errors) >= 0.93
    assert all(says_that_the_profile_does_not_fit(fix) for fix in fixes)
    assert min(fix.rescaled_by for fix in fixes) > 1.8


def test_twice_the_noise_in_the_profile_is_said_and_the_right_one_is_not() -> None:
    """All coefficients twice the truth: covered anyway, and said by every fix; the right profile is hardly accused."""
    cycles = published_cycles()[:60]
    errors, fixes = estimates(2.0, cycles)
    assert covered(errors) >= 0.93
    assert all(says_that_the_profile_does_not_fit(fix) for fix in fixes)
    assert sum(says_that_the_profile_does_not_fit(fix) for fix in estimates(1.0, cycles)[1]) <= 2


# Knocks


class Knocked:
    """Noise with knocks in it: in 2 % of the seconds a rate of 100 sd, either way."""

    def __init__(self, noise: NoiseSource, sd: float, rng: np.random.Generator) -> None:
        """Knock `noise`, whose 1 s means have this sd, rad/s."""
        self.noise, self.sd, self.rng = noise, sd, rng

    def read(self, n: int) -> Array:
        """Return the next `n` seconds."""
        knocks = np.where(self.rng.random(n) < 0.02, self.rng.choice([-100.0, 100.0], n) * self.sd, 0.0)
        return self.noise.read(n) + knocks


def test_knocks_are_found_left_out_and_cost_little() -> None:
    """In 2 % of the seconds a knock of 100 sd: the rms error grows by less than 10 %, and the fix counts them."""
    coefficients = noise_coefficients(plant("tvg43").noise)
    sd = math.sqrt(2.0) * coefficients.angle_white_noise  # of a mean over 1 s
    calm: list[Deviation] = []
    knocked: list[Deviation] = []
    rejected = []
    for seed in range(100):
        at = site(seed * 137.5, 50.0)
        for errors, rng in ((calm, None), (knocked, np.random.default_rng(seed))):
            noise: NoiseSource = RateNoise(coefficients, 1.0, np.random.SeedSequence(seed))
            noise = noise if rng is None else Knocked(noise, sd, rng)
            fix = solve(published_means(seed, at=at, noise=noise), assume("tvg43"))
            errors.append(of_fix(at, fix))
        rejected.append(fix.n_rejected)
    assert rms([error.azimuth for error in knocked]) < 1.1 * rms([error.azimuth for error in calm])
    assert np.mean(rejected) == pytest.approx(0.02 * 960, rel=0.1)
    assert covered(knocked) > 0.95 - 3.0 * math.sqrt(0.05 * 0.95 / 100)


# All over the earth


@pytest.mark.parametrize("latitude_deg", [-33.0, 0.0, 80.0, -80.0])
def test_refined_holds_its_promise_all_over_the_earth(latitude_deg: float) -> None:
    """South, at the equator and at latitude 80 the interval covers, and the sd is that of the same plan, times sec."""
    n, errors = 100, []
    latitude = math.radians(latitude_deg)
    plan, assumptions = refined("tvg43", 180.0, latitude_known=True), assume("tvg43", latitude)
    for seed in range(n):
        at = site(3.6 * seed, latitude_deg)
        fix = solve(Bench(profile="tvg43", site=at, seed=seed).measure(plan, assumptions), assumptions)
        errors.append(of_fix(at, fix, latitude_known=True))
    found = figures(errors)
    assert found["azimuth_coverage"] > 0.95 - 3.0 * math.sqrt(0.05 * 0.95 / n)
    assert found["azimuth_rms_over_sd"] == pytest.approx(1.0, abs=3.5 / math.sqrt(2.0 * n))
    assert np.median(np.degrees([each.azimuth_sd for each in errors])) == pytest.approx(0.1085, rel=0.05)


# Real MEMS gyro


def turntable(run: str) -> DwellTable:
    """Return the dwells of a run."""
    table = read_table(recording(f"adxrs290_{run}.csv"))
    assert isinstance(table, DwellTable)
    return table


def half_differences(table: DwellTable) -> tuple[Array, Array]:
    """Return north and east rates and their covariance by plain least squares, from half differences of the pairs."""
    h = sensitivity(table.azimuth + math.pi, table.elevation, np.zeros((len(table.rate), 2)))[:, 0, :2]
    design, values = (h[::2] - h[1::2]) / 2.0, (table.rate[::2] - table.rate[1::2]) / 2.0
    inverse = np.linalg.inv(design.T @ design)
    rates = inverse @ design.T @ values
    variance = np.sum((values - design @ rates) ** 2) / (len(values) - 2)
    return rates, inverse * variance


@pytest.mark.parametrize("run", ["t13_1", "t16_1", "t17_1", "t17_2", "t17_3", "t17_4"])
def test_mems_azimuth_is_stated_no_surer_than_plain_least_squares(run: str) -> None:
    """Pairs of opposite dwells leave nothing to gain on plain least squares, so the stated sd is that of it."""
    table = turntable(run)
    fix = solve_dwell_table(table.azimuth, table.elevation, table.rate, input_axis_offset=math.pi)
    (north, east), covariance = half_differences(table)
    gradient = np.array([-east, north]) / (north**2 + east**2)
    assert fix.azimuth_sd == pytest.approx(math.sqrt(gradient @ covariance @ gradient), rel=1e-6)


def test_mems_runs_in_four_mountings_agree_within_their_stated_sd() -> None:
    """T17-1 to 4, mounted at 0, 90, 180 and 270 deg: one earth rate, and one error that turns with the mounting.

    An error of the turntable that repeats every turn looks like an earth rate fixed to the motor, whose angle is the
    stage azimuth less that of the mounting. With it the runs agree; one that scattered twice as much would not.
    """
    rows, values = [], []
    for i, run in enumerate(("t17_1", "t17_2", "t17_3", "t17_4")):
        rates, covariance = half_differences(turntable(run))
        c, s = round(math.cos(i * math.pi / 2)), round(math.sin(i * math.pi / 2))
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))
        rows.append(whiten @ np.array([[1.0, 0.0, c, s], [0.0, 1.0, -s, c]]))
        values.append(whiten @ rates)
    design, target = np.vstack(rows), np.concatenate(values)
    solution = np.linalg.lstsq(design, target, rcond=None)[0]
    chi2 = float(np.sum((target - design @ solution) ** 2))
    assert chi2 < LIMIT_4 < 4.0 * chi2
    covariance = np.linalg.inv(design.T @ design)[:2, :2]
    horizontal = float(np.hypot(*solution[:2])) / DPH
    assert horizontal == pytest.approx(9.87, abs=3.0 * math.sqrt(np.trace(covariance) / 2.0) / DPH)


# The same figures by other people's means


def test_on_white_noise_generalised_least_squares_are_ordinary_ones() -> None:
    """Equal weights are the best there are: the same azimuth, latitude and standard deviations to 1e-9."""
    white = NoiseModel.from_field_units(angle_random_walk_deg_per_sqrt_h=0.003)
    means = make_means(147.0, -33.0, mean=1.0)
    noisy = means.with_rate(means.rate[:, 0] + 0.2 * DPH * np.random.default_rng(5).standard_normal(means.n))
    best, plain = (estimate(noisy, noise=white, weights=weights) for weights in ("generalised", "ordinary"))
    for name in ("azimuth", "azimuth_sd", "latitude", "latitude_sd", "scale_factor", "scale_factor_sd"):
        assert getattr(best, name) == pytest.approx(getattr(plain, name), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("heading_deg", [18.887, 100.0, 200.0, 340.0])
@pytest.mark.parametrize("latitude_deg", [-65.0, 0.5, 50.429])
def test_three_axes_agree_with_other_peoples_attitude(heading_deg: float, latitude_deg: float) -> None:
    """Without noise a triad's axes point where SciPy's align_vectors and the TRIAD of ahrs see them, to 1e-9."""
    latitude = math.radians(latitude_deg)
    earth, up = np.array([math.cos(latitude), 0.0, -math.sin(latitude)]), np.array([0.0, 0.0, -1.0])
    truth = Rotation.from_euler("ZYX", [heading_deg, 12.0, -7.0], degrees=True)
    rate, force = truth.inv().apply(earth), truth.inv().apply(up)
    mean = StaticMean(
        name="here", rate=EARTH_RATE * rate, rate_sd=np.zeros(3), specific_force=9.81 * force,
        specific_force_sd=np.zeros(3), n_samples=100, degrees_of_freedom=19,
    )  # fmt: skip
    fix = gyrocompass(mean)
    assert fix.latitude == pytest.approx(latitude, abs=1e-9)
    aligned = Rotation.align_vectors([up, earth], [force, rate])[0].as_matrix()
    triad = np.asarray(TRIAD(v1=up, v2=earth).estimate(w1=force, w2=rate)).T  # of ahrs, from north, east, down to body
    for mat_nb in (aligned, triad):
        for axis, direction in enumerate(fix.axes[0]):
            north, east, down = mat_nb[:, axis]
            assert direction.elevation == pytest.approx(math.asin(-down), abs=1e-9)
            assert direction.azimuth is not None
            assert math.remainder(direction.azimuth - math.atan2(east, north), 2 * math.pi) == pytest.approx(
                0, abs=1e-9
            )


# The tool itself


def test_a_broken_promise_is_told() -> None:
    """Errors three times the stated sd break every promise about them; honest ones none."""
    rng = np.random.default_rng(3)
    honest = [Deviation(0.0008 * x, 0.0008) for x in rng.standard_normal(400)]
    bold = [Deviation(0.0024 * x, 0.0008) for x in rng.standard_normal(400)]
    assert misses({"refined 960": figures(honest)}) == []
    told = misses({"refined 960": figures(bold)})
    assert [line.split()[2] for line in told] == ["azimuth_rms_deg", "azimuth_rms_over_sd", "azimuth_coverage"]


@pytest.mark.campaign
def test_every_promise_is_kept() -> None:
    """A thousand cycles of every method, and as many around the horizon and with the latitude to be found."""
    assert misses(campaign("tvg43", 1000, seed=2, jobs=2, thorough=True)) == []
