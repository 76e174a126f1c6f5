"""Statistics of campaigns: right on angles around north, honest about scatter, between turn-ons and within."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from northfinder.estimation.campaign import (
    circular_mean,
    consistency,
    deviations,
    longest_gap,
    scatter,
    turn_on_scatter,
)


@given(st.floats(0.0, 6.28), st.lists(st.floats(-0.7, 0.7), min_size=2, max_size=8))
def test_angles_are_averaged_as_numbers_wherever_zero_lies(direction: float, off: list[float]) -> None:
    """Mean and sd of azimuths are those of their deviations, also across north; never the mean of 359 and 1."""
    angles = (direction + np.array(off)) % (2.0 * math.pi)
    expected = direction + float(np.mean(off))
    assert math.remainder(circular_mean(angles) - expected, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-9)
    found = scatter(angles, circular=True)
    assert 0.0 <= found.mean <= 2.0 * math.pi
    assert found.sd == pytest.approx(float(np.std(off, ddof=1)), abs=1e-9)


def test_weights_count() -> None:
    """A value with three times the weight pulls the mean three times as much."""
    assert circular_mean(np.radians([359.0, 3.0]), [3.0, 1.0]) == pytest.approx(0.0, abs=1e-12)
    assert np.degrees(deviations(np.radians([359.0, 3.0]), math.radians(1.0))) == pytest.approx([-2.0, 2.0])


def test_a_single_value_has_no_scatter() -> None:
    """The sd of one value is not known, rather than zero."""
    assert scatter([1.5]).sd is None
    assert consistency([0.1], [1.0]) is None


def test_scatter_between_turn_ons_is_told_from_that_within() -> None:
    """Over 300 campaigns of 4 turn-ons with 5 values the variances average to what was put in."""
    rng = np.random.default_rng(5)
    turn_on = np.repeat(np.arange(4), 5)
    within, between, chance = [], [], []
    for _ in range(300):
        found = turn_on_scatter(rng.normal(0.0, 2.0, 4)[turn_on] + rng.normal(0.0, 0.7, 20), turn_on)
        alike = turn_on_scatter(rng.normal(0.0, 0.7, 20), turn_on)
        within.append((found.within or 0.0) ** 2)
        between.append((found.between or 0.0) ** 2)
        chance.append(alike.probability or 0.0)
    assert np.mean(within) == pytest.approx(0.49, abs=4.0 * 0.49 * math.sqrt(2.0 / 16.0 / 300.0))
    assert np.mean(between) == pytest.approx(4.0, abs=4.0 * 4.1 * math.sqrt(2.0 / 3.0 / 300.0))
    assert np.mean(np.array(chance) < 0.05) == pytest.approx(0.05, abs=4.0 * math.sqrt(0.05 * 0.95 / 300.0))


def test_turn_ons_that_leave_something_open() -> None:
    """One turn-on says nothing of the scatter between, one value a turn-on nothing of that within."""
    one, single = turn_on_scatter([1.0, 2.0, 3.0], [7, 7, 7]), turn_on_scatter([1.0, 2.0, 3.0], [0, 1, 2])
    assert (one.n_turn_ons, one.within, one.between) == (1, 1.0, None)
    assert (single.n_turn_ons, single.within, single.between) == (3, None, 1.0)


@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_honest_statements_are_told_from_dishonest_ones(factor: float) -> None:
    """The rms of normalised errors is that of the statements; its 95 % bounds hold when they are honest, only then."""
    rng = np.random.default_rng(8)
    sd = rng.uniform(0.1, 0.4, 24)
    group = np.repeat(np.arange(3), 8)
    kept = []
    for _ in range(200):
        off = factor * rng.normal(0.0, sd) + np.array([0.5, -3.0, 1.0])[group]
        within = consistency(off, sd, group)
        assert within is not None
        assert within.dof == 21
        kept.append(within.low < within.rms < within.high)
        overall = consistency(off, sd)
        assert overall is not None
        assert overall.probability < 1e-6  # the turn-ons differ
    assert (abs(np.mean(kept) - 0.95) < 4.0 * math.sqrt(0.95 * 0.05 / 200.0)) == (factor == 1.0)


def test_errors_against_the_truth_keep_all_degrees_of_freedom() -> None:
    """Nothing is taken off known errors: a common offset counts."""
    found = consistency([1.0, 1.0, 1.0], [1.0, 1.0, 1.0], known=True)
    assert found is not None
    assert (found.dof, found.rms) == (3, 1.0)


def test_the_pause_is_the_gap_that_stands_out() -> None:
    """By its length in hours, or by standing out; regular campaigns have none."""
    assert longest_gap([4.0, 4.0, 300.0, 4.0]) == 2
    assert longest_gap([4.0, 5.0, 6.0, 4.0]) is None
    assert longest_gap([4.0, 5.0, 6.0, 4.0], least=5.0) == 1
    assert longest_gap([4.0, 5.0], least=9.0) is None
    assert longest_gap([]) is None
