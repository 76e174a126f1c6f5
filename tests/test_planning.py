"""Predicted standard deviations: those that the estimator states; and the figures that the plans are held to."""

import math
from itertools import pairwise

import pytest
from simulated_means import DPH, OMEGA_DPH, TVG43, make_means

from drivers.api import StageLimits
from northfinder.cyclogram import Step
from northfinder.errors import ConfigError, EstimateError
from northfinder.estimation import Known, NoiseModel, estimate
from northfinder.estimation.planning import PlannedDwell, Truth, planned_means, predict
from northfinder.layouts import PLANS, Family, families
from northfinder.plans import Candidate, Conditions, _candidate, _search, candidates, timetable
from northfinder.turns import Turns
from northfinder.units import EARTH_RATE

NOISE = NoiseModel.from_field_units(**TVG43)
LATITUDE_DEG = 50.429
#: The simulator holds the earth rate to seven figures.
ROUNDED = EARTH_RATE / (OMEGA_DPH * DPH)
EAST_WEST = ((0, 0), (90, 0), (180, 0), (57, 0), (237, 0), (57, 0), (0, 90), (0, -90))

(REFINED,) = families("refined", needs_latitude=False)


def planned(positions: tuple[tuple[float, float], ...], *, dwell: float, turn: float) -> list[PlannedDwell]:
    """Return equal dwells at positions in deg, the first beginning at 0 s."""
    return [
        PlannedDwell(
            start=i * (dwell + turn), duration=dwell, azimuth=math.radians(azimuth), elevation=math.radians(elevation)
        )
        for i, (azimuth, elevation) in enumerate(positions)
    ]


def conditions(time: float, *, needs_latitude: bool = False, turns: Turns | None = None) -> Conditions:
    """Return conditions for the gyro of the published campaign, 8 s a turn unless told otherwise."""
    latitude = math.radians(LATITUDE_DEG)
    return Conditions(
        noise=NOISE,
        known=Known() if needs_latitude else Known(latitude=latitude),
        turns=turns or Turns(constant=8.0),
        time=time,
        needs_latitude=needs_latitude,
        truth=Truth(latitude=latitude),
    )


def azimuth_sd_deg(candidate: Candidate) -> float:
    """Return the predicted sd of the azimuth times cos(latitude), deg."""
    return math.degrees(candidate.prediction.azimuth_sd) * math.cos(math.radians(LATITUDE_DEG))


def pattern_of(family: Family) -> tuple[Step, ...]:
    """Return the pattern of one repetition."""
    layout = family(1)
    assert layout is not None
    return layout.pattern


@pytest.mark.parametrize(("azimuth_deg", "latitude_deg"), [(33, 50.429), (147, -33), (222, 0.5), (300, 80)])
@pytest.mark.parametrize("known", [{}, {"latitude": True}, {"scale_factor": 1.02, "scale_factor_sd": 0.01}])
def test_the_predicted_sd_is_the_one_stated(azimuth_deg: float, latitude_deg: float, known: dict[str, float]) -> None:
    """Means simulated apart from the planner give, to 1e-9, the sds that were predicted for the same dwells."""
    given = {name: value for name, value in known.items() if name != "latitude"}
    if "latitude" in known:
        given["latitude"] = math.radians(latitude_deg)
    what = Known(acceleration_sensitive_drift_rate=1e-5, acceleration_sensitive_drift_rate_sd=1e-8, **given)
    means = make_means(
        azimuth_deg, latitude_deg, positions=EAST_WEST, dwell=20.0, turn=8.0, mean=1.0,
        scale_factor=known.get("scale_factor", 1.0) * ROUNDED, d_g_dph=math.degrees(1e-5) * 3600,
    )  # fmt: skip
    stated = estimate(means, noise=NOISE, known=what, weights="generalised")
    truth = Truth(azimuth=math.radians(azimuth_deg), latitude=math.radians(latitude_deg))
    found = predict(planned(EAST_WEST, dwell=20.0, turn=8.0), NOISE, what, truth)
    assert found.azimuth_sd == pytest.approx(stated.azimuth_sd, rel=1e-9)
    if "latitude" in known:
        assert found.latitude_sd is None
    else:
        assert found.latitude_sd == pytest.approx(stated.latitude_sd, rel=1e-9)


def test_dwells_are_cut_as_measured_ones() -> None:
    """Means of a second that share their end points, and a shorter last one."""
    means = planned_means(planned(((0, 0), (90, 0)), dwell=2.5, turn=8.0), Truth(), known=Known())
    assert means.duration.tolist() == [1.0, 1.0, 0.5] * 2
    assert means.gap.tolist() == [0.0, 0.0, 8.0, 0.0, 0.0]
    assert means.dwell.tolist() == [0, 0, 0, 1, 1, 1]


def test_what_determines_no_azimuth_is_an_error() -> None:
    """One position, or none, tells nothing, and the sentence says which quantity is missing."""
    with pytest.raises(EstimateError, match="do not determine"):
        predict(planned(((0, 0),), dwell=20.0, turn=8.0), NOISE, Known(), Truth())
    with pytest.raises(EstimateError, match="without a dwell"):
        predict([], NOISE, Known(), Truth())


@pytest.mark.parametrize(("time", "most"), [(180, 0.124), (300, 0.091), (960, 0.048)])
def test_refined_keeps_the_figures_it_is_held_to(time: float, most: float) -> None:
    """Azimuth sd times cos(latitude) with 8 s a turn; and better than every plan that does not know north ahead."""
    (refined,) = candidates("refined", conditions(time))
    assert azimuth_sd_deg(refined) <= most
    for name in PLANS:
        if name not in {"refined", "double"}:
            assert azimuth_sd_deg(candidates(name, conditions(time))[0]) > azimuth_sd_deg(refined)


@pytest.mark.parametrize(("time", "most"), [(180, 0.110), (300, 0.083), (960, 0.047)])
def test_double_keeps_the_figures_it_is_held_to(time: float, most: float) -> None:
    """East-west pairs from a known azimuth, 8 s a turn."""
    assert azimuth_sd_deg(candidates("double", conditions(time))[0]) <= most


def test_the_latitude_is_measured_where_needed() -> None:
    """Refined turns up and down for the latitude only, and then states both."""
    without, (needing,) = (
        candidates("refined", conditions(300))[0],
        candidates("refined", conditions(300, needs_latitude=True)),
    )
    assert not [step for step in without.cyclogram.steps if step.elevation]
    assert needing.prediction.latitude_sd is not None
    assert {"up", "down"} <= {step.name for step in needing.cyclogram.steps}
    assert math.degrees(needing.prediction.latitude_sd) < 0.3


@pytest.mark.parametrize("name", PLANS)
def test_candidates_fill_the_time_and_come_best_first(name: str) -> None:
    """The last dwell ends with the time, turns and settling included; none is shorter than 5 s."""
    stage = Turns(speed=math.radians(11.25), acceleration=math.radians(5.625), pause=1.0)
    found = candidates(name, conditions(300, turns=stage), n=3)
    assert [each.score for each in found] == sorted(each.score for each in found)
    for each in found:
        assert each.dwells[-1].start + each.dwells[-1].duration == pytest.approx(300)
        assert min(dwell.duration for dwell in each.dwells) >= 5.0 - 1e-9
        assert each.dwells[0].start >= 1.0


@pytest.mark.parametrize("time", [240, 420, 900])
def test_a_search_finds_the_best_number_of_dwells(time: float) -> None:
    """No other number of pairs would do better in the same time."""
    at = conditions(time)
    found = min(_search(REFINED, at), key=lambda each: each.score)
    everything = [_candidate(REFINED, n, at) for n in range(2, 40)]
    assert found.score == pytest.approx(min(each.score for each in everything if each is not None))


def test_a_time_too_short_and_an_unknown_plan_are_refused() -> None:
    """The sentence names plan and time, or the plans there are."""
    with pytest.raises(ConfigError, match="refined does not fit into 30 s"):
        candidates("refined", conditions(30))
    with pytest.raises(ConfigError, match="no plan 'refind': expected refined, double"):
        candidates("refind", conditions(300))


@pytest.mark.parametrize(("order", "degree"), [("13312442", 1), ("1324423131422413", 2)])
def test_balanced_orders_cancel_drift(order: str, degree: int) -> None:
    """Opposite positions see the same mean of the drift, linear by the short order, quadratic too by the long one."""
    family = next(
        family for family in families("drift-balanced", needs_latitude=False)
        if sum(step.dwell for step in pattern_of(family)) == len(order)
    )  # fmt: skip
    at = conditions(960)
    found = _candidate(family, 2, at)
    assert found is not None
    for power in range(1, degree + 1):
        moment = dict.fromkeys(("U1", "U2", "U3", "U4"), 0.0)
        for step, dwell in zip(found.cyclogram.steps, found.dwells, strict=True):
            moment[step.name] += (
                ((dwell.start + dwell.duration) ** (power + 1) - dwell.start ** (power + 1)) / (power + 1) / 960**power
            )
        assert moment["U1"] == pytest.approx(moment["U3"], rel=1e-9)
        assert moment["U2"] == pytest.approx(moment["U4"], rel=1e-9)


def test_a_balanced_order_keeps_the_azimuth_under_drift() -> None:
    """Equal weights, 1 deg/h an hour: 13312442 gives the azimuth exactly, 12341234 does not."""
    around = {"1": (0, 0), "2": (90, 0), "3": (180, 0), "4": (270, 0)}
    errors = []
    for order in ("13312442", "12341234"):
        means = make_means(33.0, 45.0, positions=[around[each] for each in order], dwell=30.0, drift_dph_per_h=1.0)
        errors.append(math.degrees(estimate(means, noise=NOISE).azimuth) - 33.0)
    assert errors[0] == pytest.approx(0.0, abs=1e-9)
    assert abs(errors[1]) > 0.05


def test_turns_of_a_stage() -> None:
    """90 deg in 10 s at 11.25 deg/s and 5.625 deg/s^2; a short turn never reaches the speed; every arrival settles."""
    limits = StageLimits(
        azimuth_min=-7.0, azimuth_max=7.0, elevation_min=-1.6, elevation_max=1.6,
        max_speed=math.radians(11.25), max_acceleration=math.radians(5.625),
    )  # fmt: skip
    turns = Turns.of_stage(limits, 0.5)
    assert turns.duration(math.radians(90)) - turns.duration(0.0) == pytest.approx(10.0)
    assert turns.duration(math.radians(180)) - turns.duration(0.0) == pytest.approx(18.0)
    assert turns.duration(math.radians(5.625)) - turns.duration(0.0) == pytest.approx(2.0)
    assert turns.duration(0.0) > 0.5
    assert Turns(constant=8.0).duration(1.0) == 8.0


def test_both_axes_turn_at_once() -> None:
    """From the east to straight up with the azimuth going on to the west takes one turn of 90 deg, not two."""
    stage = Turns(speed=math.radians(11.25), acceleration=math.radians(5.625))
    (found,) = candidates("refined", conditions(960, needs_latitude=True, turns=stage))
    dwells = timetable(found.cyclogram, stage, math.radians(33))
    n_tilting = 0
    for before, dwell in pairwise(dwells):
        if abs(before.elevation - dwell.elevation) == pytest.approx(math.pi / 2):
            assert dwell.start - before.start - before.duration == pytest.approx(10.0)
            n_tilting += 1
    assert n_tilting >= 4
