"""Interval means: averaged without loss, joined only where they touch, refused where they are no data."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from simulated_means import TVG43, make_means

from northfinder.errors import EstimateError
from northfinder.estimation import NoiseModel, RateMeans
from northfinder.estimation.means import concatenate, from_samples


def some(**changes: ArrayLike) -> RateMeans:
    """Three good means with something changed."""
    good: dict[str, ArrayLike] = {"start": [0.0, 1.0, 2.0], "duration": [1.0] * 3, "rate": [0.0] * 3}
    return RateMeans(**good | {"azimuth": [0.0] * 3, "elevation": [0.0] * 3} | changes)


@given(n=st.integers(1, 500), size=st.integers(1, 60))
def test_averaging_twice_is_averaging_once(n: int, size: int) -> None:
    """Short means of a run, merged, are the mean of its samples over the run's own time, whatever is left over."""
    rate = np.random.default_rng(n).standard_normal(n)
    short = from_samples(rate, 235, 235.0, samples_per_mean=size, azimuth=1.0, elevation=0.5, dwell=3)
    whole = short.per_dwell()
    assert whole.n == 1
    assert whole.rate[0, 0] == pytest.approx(rate.mean(), abs=1e-12)
    assert whole.start[0] == 1.0
    assert whole.duration[0] == pytest.approx(n / 235.0)
    assert whole.n_samples[0] == n
    assert (whole.azimuth[0], whole.elevation[0], whole.dwell[0]) == pytest.approx((1.0, 0.5, 3))


def test_merged_means_have_the_covariance_of_the_merged() -> None:
    """The covariance of dwell means is that of their short means, averaged: one model at every length."""
    noise = NoiseModel.from_field_units(**TVG43)
    short = make_means(0.0, 0.0, mean=10.0)
    average = np.kron(np.eye(8), np.full((1, 12), 1.0 / 12.0))
    apart = average @ noise.covariance(short) @ average.T
    merged = noise.covariance(short.per_dwell())
    differences = np.diff(np.eye(8), axis=0)  # a common constant is arbitrary
    np.testing.assert_allclose(
        differences @ merged @ differences.T, differences @ apart @ differences.T, rtol=5e-3, atol=1e-3 * apart.max()
    )


def test_a_hole_within_a_dwell_is_not_averaged_over() -> None:
    """Lost or rejected seconds leave two means of one dwell, each over its own time."""
    means = make_means(0.0, 0.0, positions=((0, 0), (90, 0)), dwell=10.0, mean=1.0)
    keep = np.ones(means.n, dtype=bool)
    keep[4] = False
    runs = means.select(keep).per_dwell()
    assert runs.dwell.tolist() == [0, 0, 1]
    assert runs.duration.tolist() == [4.0, 5.0, 10.0]


def test_only_means_that_touch_share_an_end_point() -> None:
    """Rounding of the times never parts neighbours, and one lost sample always does."""
    period = 1.0 / 235.0
    touching = some(start=[0.0, 1.0 + 1e-6, 2.0], n_samples=[235] * 3)
    parted = some(start=[0.0, 1.0 + period, 2.0 + period], n_samples=[235] * 3)
    assert touching.gap.tolist() == [0.0, 0.0]
    assert parted.gap.tolist() == pytest.approx([period, 0.0])


def test_parts_are_joined_in_order() -> None:
    """Runs of samples from one dwell after another make one series."""
    parts = [
        from_samples(np.full(20, float(i)), 100 * i, 10.0, samples_per_mean=10, azimuth=0.0, elevation=0.0, dwell=i)
        for i in range(3)
    ]
    joined = concatenate(parts)
    assert joined.start.tolist() == [0.0, 1.0, 10.0, 11.0, 20.0, 21.0]
    assert joined.rate[:, 0].tolist() == [0.0, 0.0, 1.0, 1.0, 2.0, 2.0]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"rate": [0.0, np.nan, 0.0]}, "rate of mean 1 is not a finite number"),
        ({"azimuth": [np.inf, 0.0, 0.0]}, "azimuth of mean 0"),
        ({"tilt": [[0.0, 0.0], [0.0, 0.0], [0.0, np.nan]]}, "tilt of mean 2"),
        ({"duration": [1.0, 0.0, 1.0]}, "positive duration"),
        ({"start": [0.0, 0.5, 2.0]}, "must not overlap"),
        ({"start": [2.0, 1.0, 0.0]}, "order of time"),
        ({"dwell": [1, 0, 0]}, "order of time"),
    ],
)
def test_data_that_cannot_be_are_refused_by_name(change: dict[str, ArrayLike], reason: str) -> None:
    """A value that is no number, an empty interval or a wrong order is named, and nothing is estimated."""
    with pytest.raises(EstimateError, match=reason):
        some(**change)


def test_no_data_are_refused() -> None:
    """An empty series gives a reason."""
    empty: list[float] = []
    with pytest.raises(EstimateError, match="no rate means"):
        RateMeans(start=empty, duration=empty, rate=empty, azimuth=empty, elevation=empty)
    with pytest.raises(EstimateError, match="no rate means"):
        concatenate([])
    with pytest.raises(EstimateError, match="no samples to average in dwell 0"):
        from_samples([], 0, 10.0, samples_per_mean=10, azimuth=0.0, elevation=0.0)


def test_arrays_must_fit_each_other() -> None:
    """A caller's wrong shape is a ValueError that names the array."""
    with pytest.raises(ValueError, match="elevation has shape"):
        some(elevation=[0.0, 0.0])
