"""Monte Carlo of plant to estimate: ``python tools/accuracy.py [--profile P] [--runs N] [--jobs J] [--json]``.

Seeded cycles of the emulated gyro, without firmware and wire, through the plans and the estimators of the instrument:

formula (2), (3)     the closed forms on the published cyclogram, 8 dwells of 120 s and 10 s a turn
GLS                  generalised least squares on the same data
refined 180, ...     the plan of `find --time`, latitude known, its pairs pointed by the running estimate; 8 s a turn

The published cyclogram is measured at the published azimuth, 18.887 deg, because the accuracy of formula (2) depends on
it; `refined` at azimuths all around. Latitudes run from 75 deg south to 75 deg north. The acceleration-sensitive drift
rate differs from its profile by another error every cycle, of the standard deviation stated there. With --thorough the
published cyclogram is measured again at azimuths all around, and `refined` with the latitude to be found as well.

Azimuth errors are times cos(latitude), in deg. A figure's own sampling error stands behind it as +-.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import sys
import time
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial

import msgspec
import numpy as np
from numpy.typing import NDArray

from drivers.api import StageLimits
from northfinder.adaptive import Wishes, make_plan
from northfinder.cyclogram import Standing, Step, six_position
from northfinder.errors import EstimateError
from northfinder.estimation import ClosedForm, Fix, RateMeans, solve_closed_form
from northfinder.estimation.geometry import sensitivity
from northfinder.estimation.means import concatenate, from_samples
from northfinder.record import DwellSpan
from northfinder.sequencer import Plan
from northfinder.solution import Assumptions, solve
from northfinder.turns import BLOCK_PAUSE
from northfinder.units import DPH, EARTH_RATE
from sim_device.plant.earth import Site
from sim_device.plant.gyro import Gyro
from sim_device.plant.noise import NoiseSource
from sim_device.plant.profile import GyroProfile, load_profile

Array = NDArray[np.float64]
Figures = dict[str, float]

PUBLISHED_AZIMUTH = math.radians(18.887)
LATITUDES = tuple(math.radians(latitude) for latitude in (-75, -50.429, -20, 0.5, 33, 50.429, 75))
TURN_PUBLISHED, TURN = 10.0, 8.0  #: s
SAMPLE_RATE = 1.0  #: Hz; the plant's samples are exact means of its continuous noise at any rate
TIMES = (180.0, 300.0, 960.0)  #: s
RENEWALS = range(3, 9)  #: after how many dwells the running estimate is renewed: later ones would point no better
KEYS = ("rms_deg", "rms_over_sd", "coverage")  #: of the table printed
#: Promised: method, figure, lowest, highest.
PROMISES = (
    ("formula (2), (3)", "azimuth_rms_deg", 0.95 * 0.190, 1.05 * 0.190),
    ("GLS", "azimuth_rms_deg", 0.0, 0.135),
    ("GLS", "latitude_rms_deg", 0.0, 0.12),
    ("refined 180", "azimuth_rms_deg", 0.0, 0.13),
    ("refined 300", "azimuth_rms_deg", 0.0, 0.095),
    ("refined 960", "azimuth_rms_deg", 0.0, 0.052),
)


@dataclass(slots=True, kw_only=True)
class Bench:
    """A gyro of the plant on an ideal stage whose every turn takes the same time."""

    profile: str
    site: Site
    seed: int
    turn: float = TURN  #: s
    drift_error_sds: float = 0.0  #: error of the acceleration-sensitive drift rate, in sd of the instrument's profile
    noise: NoiseSource | None = None  #: in place of the profile's
    spans: list[DwellSpan] = field(default_factory=list)
    gyro: Gyro = field(init=False)
    _parts: list[RateMeans] = field(default_factory=list)
    _next_index: int = 0

    def __post_init__(self) -> None:
        """Switch the gyro on."""
        gyro = plant(self.profile)
        known = assume(self.profile).known()
        drift = gyro.acceleration_sensitive_drift_rate_dph_per_g
        drift += self.drift_error_sds * known.acceleration_sensitive_drift_rate_sd / DPH
        self.gyro = Gyro(
            msgspec.structs.replace(gyro, acceleration_sensitive_drift_rate_dph_per_g=drift),
            self.site,
            seed=self.seed,
            sample_rate=SAMPLE_RATE,
            batch=1200,
            noise=None if self.noise is None else [self.noise],
        )

    def standing(self, fix: Fix | None) -> Standing:
        """Return where the measurement stands."""
        at = (self.spans[-1].azimuth, self.spans[-1].elevation) if self.spans else (0.0, 0.0)
        elapsed = self._next_index / SAMPLE_RATE
        return Standing(done=tuple(self.spans), fix=fix, elapsed=elapsed, azimuth=at[0], elevation=at[1])

    def dwell(self, step: Step) -> None:
        """Turn to a position, but for the first, and measure there."""
        gap = round(self.turn * SAMPLE_RATE) if self.spans else 0
        self.gyro.skip(gap)
        first = self._next_index + gap
        n = max(1, round(step.dwell * SAMPLE_RATE))
        rate = self.gyro.measure_at_rest(step.azimuth, step.elevation, n)
        number = len(self.spans)
        self._parts.append(
            from_samples(
                rate, first, SAMPLE_RATE, samples_per_mean=1, dwell=number, azimuth=step.azimuth,
                elevation=step.elevation,
            )
        )  # fmt: skip
        self._next_index = first + n
        self.spans.append(
            DwellSpan(
                step=number, name=step.name, dwell=step.dwell, azimuth=step.azimuth, elevation=step.elevation,
                measured_azimuth=step.azimuth, measured_elevation=step.elevation, first_index=first,
                stop_index=self._next_index, sample_rate=SAMPLE_RATE,
            )
        )  # fmt: skip

    def means(self) -> RateMeans:
        """Return the means measured so far."""
        return concatenate(self._parts)

    def measure(self, plan: Plan, assumptions: Assumptions | None = None) -> RateMeans:
        """Carry out a plan, its later steps pointed by the estimate so far if there are assumptions to make one."""
        fix = None
        while (step := plan.next_step(self.standing(fix))) is not None:
            self.dwell(step)
            if assumptions is not None and len(self.spans) in RENEWALS:
                fix = running(fix, self.means(), assumptions)
        return self.means()


def running(fix: Fix | None, means: RateMeans, assumptions: Assumptions) -> Fix | None:
    """Return the estimate so far, None if it is too early for one; to be fast, the later ones renew the azimuth alone.

    That comes from the means of whole dwells, by the weights of the noise model: for pointing as good as the full fix.
    """
    if fix is None:
        try:
            return solve(means, assumptions)
        except EstimateError:
            return None
    noise, dwells = assumptions.noise(), means.per_dwell()
    h = sensitivity(dwells.azimuth, dwells.elevation, dwells.tilt)[:, 0]
    columns = np.column_stack([h, np.ones(dwells.n), dwells.rate])
    white = columns if noise is None else np.linalg.solve(np.linalg.cholesky(noise.covariance(dwells)), columns)
    north, east = np.linalg.lstsq(white[:, :4], white[:, 4], rcond=None)[0][:2]
    return replace(fix, azimuth=math.atan2(east, north))


@lru_cache
def assume(profile: str, latitude: float | None = None) -> Assumptions:
    """Return assumptions of an instrument that knows the gyro, and perhaps the latitude, rad."""
    latitude_deg = None if latitude is None else math.degrees(latitude)
    return Assumptions.gather(method="generalised", profile=profile, latitude_deg=latitude_deg, g_drift_dph=None)


@lru_cache
def refined(profile: str, duration: float, *, latitude_known: bool) -> Plan:
    """Return the instrument's own plan for so many seconds, with every turn, also to the first dwell, of TURN.

    Which latitude is known makes no difference to it.
    """
    latitude = LATITUDES[0] if latitude_known else None
    plan = make_plan(Wishes(name="refined", time=duration), assume(profile, latitude), settle=TURN - BLOCK_PAUSE)
    turn = 2.0 * math.pi
    plan.check(
        StageLimits(azimuth_min=-turn, azimuth_max=turn, elevation_min=-turn, elevation_max=turn, max_speed=math.inf)
    )
    return plan


@lru_cache
def plant(profile: str) -> GyroProfile:
    """Return the emulator's gyro of that name."""
    return load_profile(profile).gyro


@dataclass(frozen=True, slots=True)
class Deviation:
    """Errors of one fix with their stated standard deviations, rad; the azimuth's times cos(latitude)."""

    azimuth: float
    azimuth_sd: float
    latitude: float = 0.0
    latitude_sd: float = 0.0  #: 0 where no latitude was measured
    factor: float = 1.959964  #: of the 95 % interval


def deviation(site: Site, azimuth: float, azimuth_sd: float) -> Deviation:
    """Return the errors of an azimuth at a site."""
    scale = math.cos(site.latitude)
    return Deviation(math.remainder(azimuth - site.heading, 2.0 * math.pi) * scale, azimuth_sd * scale)


def of_fix(site: Site, fix: Fix, *, latitude_known: bool = False) -> Deviation:
    """Return the errors of a fix of the instrument."""
    found = replace(deviation(site, fix.azimuth, fix.azimuth_sd), factor=fix.coverage_factor())
    if fix.latitude is None or latitude_known:
        return found
    return replace(found, latitude=fix.latitude - site.latitude, latitude_sd=fix.latitude_sd or 0.0)


def of_closed_form(site: Site, form: ClosedForm, gyro: GyroProfile) -> Deviation:
    """Return the errors of the closed forms, the latitude's from where the acceleration-sensitive drift puts it."""
    scale = 1.0 + gyro.scale_factor_error
    drift = gyro.acceleration_sensitive_drift_rate_dph_per_g * DPH / EARTH_RATE
    biased = math.atan2(scale * math.sin(site.latitude) + drift, scale * math.cos(site.latitude))
    found = deviation(site, form.azimuth, form.azimuth_sd or 0.0)
    return replace(found, latitude=(form.latitude or 0.0) - biased, latitude_sd=form.latitude_sd or 0.0)


def published(profile: str, site: Site, seed: int, drift_error_sds: float) -> dict[str, Deviation]:
    """Return the errors of the closed forms and of generalised least squares on the published cyclogram."""
    assumptions = assume(profile)
    bench = Bench(profile=profile, site=site, seed=seed, turn=TURN_PUBLISHED, drift_error_sds=drift_error_sds)
    means = bench.measure(six_position())
    closed = solve_closed_form(means, noise=assumptions.noise())
    return {
        "formula (2), (3)": of_closed_form(site, closed, bench.gyro.profile),
        "GLS": of_fix(site, solve(means, assumptions)),
    }


def cycle(profile: str, seed: int, number: int, *, thorough: bool = False) -> dict[str, Deviation]:
    """Return the errors of every method in one cycle; equal seeds and numbers give equal cycles."""
    rng = np.random.default_rng([seed, number])
    latitude = LATITUDES[number % len(LATITUDES)]
    around = Site(latitude=latitude, heading=float(rng.uniform(0.0, 2.0 * math.pi)))
    drift = float(rng.standard_normal())
    gyro_seeds = iter(rng.integers(2**62, size=8).tolist())
    found = published(profile, Site(latitude=latitude, heading=PUBLISHED_AZIMUTH), next(gyro_seeds), drift)
    plans: list[tuple[str, float, float | None]] = [
        (f"refined {duration:.0f}", duration, latitude) for duration in TIMES
    ]
    if thorough:
        again = published(profile, around, next(gyro_seeds), drift)
        found |= {f"{name}, all around": errors for name, errors in again.items()}
        plans += [(f"refined {duration:.0f} + latitude", duration, None) for duration in TIMES]
    for name, duration, known in plans:
        bench = Bench(profile=profile, site=around, seed=next(gyro_seeds), drift_error_sds=drift)
        plan = refined(profile, duration, latitude_known=known is not None)
        fix = solve(bench.measure(plan, assume(profile, known)), assume(profile, known))
        found[name] = of_fix(around, fix, latitude_known=known is not None)
    return found


def figures(errors: list[Deviation]) -> Figures:
    """Return the figures of one method, each with its sampling error; of the latitude where it was measured."""
    columns = np.array([(e.azimuth, e.azimuth_sd, e.latitude, e.latitude_sd, e.factor) for e in errors]).T
    azimuth, azimuth_sd, latitude, latitude_sd, factor = columns
    found = consistency("azimuth", azimuth, azimuth_sd, factor)
    if latitude_sd.all():
        found |= consistency("latitude", latitude, latitude_sd, factor)
    return {"runs": len(errors)} | found


def consistency(name: str, error: Array, sd: Array, factor: Array) -> Figures:
    """Return rms error and stated standard deviation, their ratio, and how many 95 % intervals hold the truth."""
    n = error.size
    relative, covered = 1.0 / math.sqrt(2.0 * n), float(np.mean(np.abs(error) < factor * sd))
    rms, stated = (math.degrees(math.sqrt(float(np.mean(each**2)))) for each in (error, sd))
    ratio = math.sqrt(float(np.mean((error / sd) ** 2)))
    return {
        f"{name}_rms_deg": rms,
        f"{name}_rms_deg_sampling_sd": rms * relative,
        f"{name}_stated_sd_deg": stated,
        f"{name}_mean_deg": math.degrees(float(np.mean(error))),
        f"{name}_rms_over_sd": ratio,
        f"{name}_rms_over_sd_sampling_sd": ratio * relative,
        f"{name}_coverage": covered,
        f"{name}_coverage_sampling_sd": math.sqrt(0.95 * 0.05 / n),
    }


def misses(found: dict[str, Figures]) -> list[str]:
    """Return a line for every promise that is broken by more than two sampling errors."""
    promises = [promise for promise in PROMISES if promise[0] in found]
    for method, each in found.items():
        for name in ("azimuth", "latitude"):
            if f"{name}_rms_over_sd" in each:
                promises += [(method, f"{name}_rms_over_sd", 0.95, 1.05), (method, f"{name}_coverage", 0.935, 0.965)]
    lines = []
    for method, name, low, high in promises:
        value, slack = found[method][name], 2.0 * found[method][f"{name}_sampling_sd"]
        if not low - slack <= value <= high + slack:
            lines.append(f"{method}: {name} is {value:.4f}, promised {low:g} to {high:g}")
    return lines


def campaign(profile: str, runs: int, *, seed: int, jobs: int, thorough: bool = False) -> dict[str, Figures]:
    """Return the figures of every method over `runs` cycles; shows the progress on standard error."""
    work = partial(cycle, profile, seed, thorough=thorough)
    errors: dict[str, list[Deviation]] = {}
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        for done, found in enumerate(pool.imap(work, range(runs), chunksize=5), start=1):
            for name, each in found.items():
                errors.setdefault(name, []).append(each)
            if done % 20 == 0 or done == runs:
                print(f"\r{done} of {runs} cycles", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return {name: figures(each) for name, each in errors.items()}


def show(found: dict[str, Figures]) -> None:
    """Print a table."""
    for method, each in found.items():
        for name in ("azimuth", "latitude"):
            if f"{name}_rms_deg" in each:
                shown = (f"{each[f'{name}_{key}']:.4f} +- {each[f'{name}_{key}_sampling_sd']:.4f}" for key in KEYS)
                rms, ratio, covered = shown
                print(f"{method:24} {name:9} rms {rms} deg, over stated sd {ratio}, 95 % covers {covered}")


def main() -> int:
    """Run the campaign; the exit code is 1 if a promise is broken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--profile", default="tvg43", help="known to the emulator and to the instrument")
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--thorough", action="store_true")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    options = parser.parse_args()
    started = time.perf_counter()
    found = campaign(options.profile, options.runs, seed=options.seed, jobs=options.jobs, thorough=options.thorough)
    broken = misses(found) if options.profile == "tvg43" else []
    wall = round(time.perf_counter() - started, 1)
    if options.json:
        facts = {"profile": options.profile, "runs": options.runs, "seed": options.seed, "wall_s": wall}
        print(json.dumps(facts | {"methods": found, "misses": broken}))
    else:
        show(found)
        print(f"{options.runs} cycles of seed {options.seed} in {wall:g} s")
    for line in broken:
        print(line, file=sys.stderr)
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
