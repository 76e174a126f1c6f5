"""Plans in the course of a measurement: true azimuths from the running estimate, the time kept, an end when sure."""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest
from virtual import VirtualBench, assume, virtual_bench

from drivers.api import StageLimits
from northfinder.adaptive import AdaptivePlan, Wishes, make_plan
from northfinder.cyclogram import Cyclogram, Standing, Step, find_cyclogram
from northfinder.errors import ConfigError
from northfinder.estimation import Fix
from northfinder.estimation.planning import PlannedDwell, Truth, planned_means, predict
from northfinder.measurement import Measurement, Outcome, measure
from northfinder.record import DwellSpan, Record
from northfinder.sequencer import Progress
from northfinder.solution import Assumptions, solve
from northfinder.turns import Turns

LATITUDE_DEG = 50.429
LIMITS = StageLimits(
    azimuth_min=math.radians(-380), azimuth_max=math.radians(380), elevation_min=math.radians(-95),
    elevation_max=math.radians(95), max_speed=math.radians(11.25), max_acceleration=math.radians(5.625),
)  # fmt: skip


@dataclass
class Watching:
    """A watcher that keeps the running fix after each number of dwells."""

    fixes: dict[int, Fix | None] = field(default_factory=dict)

    def show(self, progress: Progress, fix: Fix | None) -> None:
        """Keep it."""
        self.fixes[progress.n_done] = fix


def run(
    path: Path, bench: VirtualBench, wishes: Wishes, assumptions: Assumptions, *, watcher: Watching | None = None
) -> tuple[AdaptivePlan, Outcome, list[DwellSpan]]:
    """Measure by the plan wished for."""
    plan = make_plan(wishes, assumptions, settle=0.5)
    measurement = Measurement(
        open_gyro=bench.open_gyro, open_stage=bench.open_stage, plan=plan, settle=0.5, assumptions=assumptions,
        record=path,
    )  # fmt: skip
    outcome = measure(measurement, clock=bench.clock, utc=bench.clock.now, watcher=watcher or Watching())
    with Record(path) as record:
        return plan, outcome, record.steps()


def fix_at(azimuth: float, *, azimuth_sd: float = 0.01) -> Fix:
    """Return a noise-free fix of an azimuth in rad, with the sd given."""
    dwells = [PlannedDwell(start=30.0 * i, duration=20.0, azimuth=i * math.pi / 2, elevation=0.0) for i in range(4)]
    fix = solve(planned_means(dwells, Truth(azimuth=azimuth), known=assume().known()), assume())
    return replace(fix, azimuth_sd=azimuth_sd)


def span(number: int, azimuth: float) -> DwellSpan:
    """Return a finished dwell at a stage azimuth in rad."""
    return DwellSpan(
        step=number, name="", azimuth=azimuth, elevation=0.0, dwell=5.0, measured_azimuth=azimuth,
        measured_elevation=0.0, first_index=number * 3000, stop_index=number * 3000 + 1175, sample_rate=235.0,
    )  # fmt: skip


@pytest.mark.parametrize(("azimuth_deg", "time"), [(33, 180), (147, 180), (222, 180), (331, 300)])
def test_refined_finds_north_in_time(tmp_path: Path, azimuth_deg: int, time: int) -> None:
    """All quadrants: within four stated sds, all dwells within the time, pairs square to north, sd as predicted."""
    bench = virtual_bench(seed=azimuth_deg, azimuth_deg=azimuth_deg)
    assumptions = assume(latitude_deg=LATITUDE_DEG)
    _, outcome, spans = run(tmp_path / "r.sqlite", bench, Wishes(time=time), assumptions)
    fix = outcome.fix
    assert abs(math.remainder(fix.azimuth - math.radians(azimuth_deg), 2 * math.pi)) < 4 * fix.azimuth_sd
    assert time - 3 < outcome.duration <= time
    assert math.degrees(fix.azimuth_sd) * math.cos(math.radians(LATITUDE_DEG)) < {180: 0.14, 300: 0.10}[time]
    for each in spans[3:]:
        true_deg = math.degrees(each.measured_azimuth) + azimuth_deg
        assert each.name == ("east" if math.sin(math.radians(true_deg)) > 0 else "west")
        assert abs(math.cos(math.radians(true_deg))) < math.sin(math.radians(6.0))
    dwells = [
        PlannedDwell(
            start=each.first_index / each.sample_rate, duration=(each.stop_index - each.first_index) / each.sample_rate,
            azimuth=each.measured_azimuth, elevation=each.measured_elevation,
        )
        for each in spans
    ]  # fmt: skip
    noise, known = assumptions.noise(), assumptions.known()
    assert noise is not None
    truth = Truth(azimuth=fix.azimuth, latitude=math.radians(LATITUDE_DEG))
    predicted = predict(dwells, noise, replace(known, scale_factor=fix.scale_factor), truth)
    assert fix.azimuth_sd == pytest.approx(fix.rescaled_by * predicted.azimuth_sd, rel=0.01)


def test_refined_measures_the_latitude_where_it_is_not_given(tmp_path: Path) -> None:
    """Southern hemisphere, nothing known: azimuth and latitude within four sds, in time."""
    bench = virtual_bench(seed=4, azimuth_deg=200.0, latitude_deg=-33.0)
    _, outcome, _ = run(tmp_path / "r.sqlite", bench, Wishes(time=300), assume())
    fix = outcome.fix
    assert fix.latitude is not None
    assert fix.latitude_sd is not None
    assert abs(fix.latitude - math.radians(-33)) < 4 * fix.latitude_sd < math.radians(2)
    assert abs(math.remainder(fix.azimuth - math.radians(200), 2 * math.pi)) < 4 * fix.azimuth_sd
    assert outcome.duration <= 300


def test_a_measurement_ends_when_sure_enough(tmp_path: Path) -> None:
    """The first dwell after which the stated sd is reached is the last one."""
    watcher = Watching()
    wishes = Wishes(until_sd=math.radians(0.3))
    bench = virtual_bench(seed=2, azimuth_deg=70.0)
    plan, outcome, spans = run(tmp_path / "r.sqlite", bench, wishes, assume(latitude_deg=LATITUDE_DEG), watcher=watcher)
    assert outcome.fix.azimuth_sd <= math.radians(0.3)
    assert len(spans) < plan.n_steps
    before = watcher.fixes[len(spans) - 1]
    assert before is not None
    assert before.azimuth_sd > math.radians(0.3)


def test_double_starts_from_the_azimuth_given(tmp_path: Path) -> None:
    """Pairs at once, near the true east-west line even before there is an estimate; and the azimuth is found."""
    bench = virtual_bench(seed=6, azimuth_deg=70.0)
    wishes = Wishes(name="double", time=180, azimuth=math.radians(74.0))
    _, outcome, spans = run(tmp_path / "r.sqlite", bench, wishes, assume(latitude_deg=LATITUDE_DEG))
    for each in spans:
        assert abs(math.cos(each.measured_azimuth + math.radians(70))) < math.sin(math.radians(15))
    assert abs(math.remainder(outcome.fix.azimuth - math.radians(70), 2 * math.pi)) < 4 * outcome.fix.azimuth_sd
    assert math.degrees(outcome.fix.azimuth_sd) * math.cos(math.radians(LATITUDE_DEG)) < 0.13


def designed(wishes: Wishes, latitude_deg: float | None = None) -> AdaptivePlan:
    """Return a plan that knows its stage."""
    plan = make_plan(wishes, assume(latitude_deg=latitude_deg), settle=0.5)
    plan.check(LIMITS)
    return plan


def test_the_side_nearest_to_the_stage_comes_first() -> None:
    """From where the opening ends the stage goes to the nearer of east and west, and then to the other."""
    plan = designed(Wishes(time=300), latitude_deg=LATITUDE_DEG)
    done = tuple(span(i, i * math.pi / 2) for i in range(3))
    for azimuth_deg, name in ((20, "west"), (100, "west"), (200, "east"), (300, "east")):
        fix = fix_at(math.radians(azimuth_deg))
        standing = Standing(done=done, fix=fix, elapsed=50.0, azimuth=math.pi)
        step = plan.next_step(standing)
        assert step is not None
        assert (azimuth_deg, step.name) == (azimuth_deg, name)
        assert abs(step.azimuth - math.pi) <= math.pi / 2 + 1e-6
        after = replace(standing, done=(*done, span(3, step.azimuth)), elapsed=80.0, azimuth=step.azimuth)
        other = plan.next_step(after)
        assert other is not None
        assert other.name == {"east": "west", "west": "east"}[name]
        assert abs(math.remainder(other.azimuth - step.azimuth, 2 * math.pi)) == pytest.approx(math.pi)


def test_dwells_shrink_when_time_has_been_lost_and_grow_when_gained() -> None:
    """What is left is divided anew before every step; with too little left the last steps are dropped, then all."""
    plan = designed(Wishes(time=300), latitude_deg=LATITUDE_DEG)
    done = tuple(span(i, i * math.pi / 2) for i in range(3))
    standing = Standing(done=done, fix=fix_at(math.radians(33)), azimuth=math.pi)
    dwells = []
    for elapsed in (40.0, 60.0, 100.0, 200.0, 260.0, 298.0):
        step = plan.next_step(replace(standing, elapsed=elapsed))
        dwells.append(0.0 if step is None else step.dwell)
    assert dwells[0] > dwells[1] > dwells[2] > 5.0
    assert dwells[3] > 0.0
    assert dwells[-1] == 0.0


def test_without_an_estimate_the_stage_zero_is_taken_for_north() -> None:
    """A gyro too noisy for its profile: the plan goes on with positions that still add up to an estimate."""
    plan = designed(Wishes(time=300), latitude_deg=LATITUDE_DEG)
    done = tuple(span(i, i * math.pi / 2) for i in range(3))
    step = plan.next_step(Standing(done=done, elapsed=50.0, azimuth=math.pi))
    assert step is not None
    assert abs(math.sin(step.azimuth)) == pytest.approx(1.0)


def test_an_untrustworthy_fix_does_not_end_the_measurement() -> None:
    """Sure enough, but with a decisive check failed: the plan goes on."""
    plan = designed(Wishes(until_sd=0.1), latitude_deg=LATITUDE_DEG)
    done = tuple(span(i, i * math.pi / 2) for i in range(3))
    fix = fix_at(1.0, azimuth_sd=0.05)
    doubtful = replace(fix, checks=tuple(replace(check, passed=False) for check in fix.checks))
    assert plan.next_step(Standing(done=done, fix=fix, elapsed=50.0, azimuth=math.pi)) is None
    assert plan.next_step(Standing(done=done, fix=doubtful, elapsed=50.0, azimuth=math.pi)) is not None


def test_default_plans() -> None:
    """Refined with a noise model, else the published six positions; a dwell asks for those too."""
    assert designed(Wishes(), latitude_deg=LATITUDE_DEG).name == "refined"
    assert designed(Wishes(), latitude_deg=LATITUDE_DEG).time == 300.0
    assert designed(Wishes(until_sd=0.001)).time == 1800.0
    published = make_plan(Wishes(), assume(profile=None), settle=0.5)
    published.check(LIMITS)
    assert (published.name, published.time, published.remaining_dwell(0)) == ("six-position", None, 960.0)
    assert designed(Wishes(dwell=20.0)).remaining_dwell(0) == 160.0
    timed = make_plan(Wishes(name="four-position", time=120.0), assume(profile=None), settle=0.5)
    timed.check(LIMITS)
    assert 50.0 < timed.remaining_dwell(0) < 80.0


@pytest.mark.parametrize(
    ("wishes", "profile", "message"),
    [
        (Wishes(dwell=20.0, time=300.0), "tvg43", "cannot both be given"),
        (Wishes(name="refined", dwell=20.0), "tvg43", "refined chooses its dwells"),
        (Wishes(name="refined"), None, "refined needs the noise: give --profile"),
        (Wishes(name="double"), "tvg43", "give --azimuth"),
        (Wishes(name="refind"), "tvg43", "no plan 'refind': expected refined, double"),
    ],
)
def test_wishes_that_do_not_go_together(wishes: Wishes, profile: str | None, message: str) -> None:
    """One sentence, before any device is opened."""
    with pytest.raises(ConfigError, match=message):
        make_plan(wishes, assume(profile=profile), settle=0.5)


def test_a_time_or_a_stage_that_does_not_do_is_refused() -> None:
    """Too short a time, and a stage that cannot turn to any azimuth, are named once the stage is known."""
    with pytest.raises(ConfigError, match=r"refined does not fit into 80 s: it takes at least 115 s$"):
        make_plan(Wishes(time=80.0), assume(), settle=0.5).check(LIMITS)
    short = make_plan(Wishes(time=60.0), assume(profile=None), settle=0.5)
    with pytest.raises(ConfigError, match=r"six-position does not fit into 60 s: it takes at least 126 s$"):
        short.check(LIMITS)
    narrow = replace(LIMITS, azimuth_min=0.0, azimuth_max=math.radians(300))
    with pytest.raises(ConfigError, match="refined may need any azimuth: the stage turns only from 0 to 300 deg"):
        make_plan(Wishes(), assume(), settle=0.5).check(narrow)


@pytest.mark.parametrize(
    ("name", "profile"),
    [("refined", "tvg43"), ("six-position", "tvg43"), ("drift-balanced", "tvg43"), ("four-position", None)],
)
def test_the_time_named_is_the_shortest_that_does(name: str, profile: str | None) -> None:
    """Given that time the plan is made, given a second less it is not, with a noise model and without."""
    assumptions = assume(profile)
    quickest = Turns.of_stage(LIMITS, 0.5)
    with pytest.raises(ConfigError, match="takes at least") as refused:
        make_plan(Wishes(name=name, time=25.0), assumptions, settle=0.5, quickest=quickest)
    assert str(refused.value).endswith(" s")
    shortest = float(str(refused.value).split()[-2])
    make_plan(Wishes(name=name, time=shortest), assumptions, settle=0.5, quickest=quickest).check(LIMITS)
    with pytest.raises(ConfigError, match="does not fit into"):
        make_plan(Wishes(name=name, time=shortest - 1.0), assumptions, settle=0.5, quickest=quickest)


def test_a_time_that_no_stage_could_keep_is_refused_at_once(tmp_path: Path) -> None:
    """Before the stage is known; and noise that no time makes up for is called that."""
    with pytest.raises(ConfigError, match="at least 52 s, more on a slow stage"):
        make_plan(Wishes(time=40.0), assume(), settle=0.5)
    noisy = tmp_path / "noisy.toml"
    noisy.write_text('name = "noisy"\n[noise]\nangle_random_walk_deg_per_sqrt_h = 1e4\n')
    with pytest.raises(ConfigError, match="determines no azimuth in 300 s, nor in any time up to 3600 s"):
        make_plan(Wishes(time=300.0), assume(str(noisy)), settle=0.5)


def test_true_azimuths_from_a_file(tmp_path: Path) -> None:
    """A cyclogram of one's own may count azimuths from north; it is not mirrored."""
    file = tmp_path / "own.toml"
    file.write_text(
        'name = "own"\n'
        "[[step]]\nname = 'here'\nazimuth_deg = 0.0\nelevation_deg = 0\ndwell_s = 10\n"
        "[[step]]\nname = 'east'\nazimuth_deg = 90.0\nelevation_deg = 0\ndwell_s = 30\nfrom_north = true\n"
    )
    plan = find_cyclogram(str(file))
    step = plan.next_step(Standing(done=(span(0, 0.0),), fix=fix_at(math.radians(200))))
    assert step is not None
    assert math.degrees(step.azimuth) == pytest.approx(-110.0)
    assert step.name == "east"
    assert not step.from_north


def test_a_dwell_is_refused_where_the_file_says_the_dwells(tmp_path: Path) -> None:
    """Not ignored; a time does stretch the file's dwells."""
    file = tmp_path / "own.toml"
    file.write_text(
        'name = "own"\n'
        + "".join(
            f"[[step]]\nname = 'U{i}'\nazimuth_deg = {90 * i}\nelevation_deg = 0\ndwell_s = 10\n" for i in range(4)
        )
    )
    with pytest.raises(ConfigError, match=r"own\.toml has dwells of its own: give --time to stretch them, not --dwell"):
        make_plan(Wishes(name=str(file), dwell=20.0), assume(), settle=0.5)
    for wishes, dwell in ((Wishes(name=str(file)), 40.0), (Wishes(name=str(file), time=200.0), 150.0)):
        plan = make_plan(wishes, assume(), settle=0.5)
        plan.check(LIMITS)
        assert plan.remaining_dwell(0) == pytest.approx(dwell, abs=25.0)
        assert (plan.remaining_dwell(0) == 40.0) is (wishes.time is None)


def test_a_plain_cyclogram_is_a_plan() -> None:
    """Its steps come one after the other as they stand."""
    steps = tuple(Step(name=f"U{i}", azimuth=float(i), elevation=0.0, dwell=5.0) for i in range(2))
    plan = Cyclogram(name="two", steps=steps)
    assert plan.next_step(Standing()) == steps[0]
    assert plan.next_step(Standing(done=(span(0, 0.0),))) == steps[1]
    assert plan.next_step(Standing(done=(span(0, 0.0), span(1, 1.0)))) is None
