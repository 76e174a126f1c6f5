"""The noise model: units, Allan deviation, and the covariance of interval means, dense and in one pass."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from simulated_means import DPH, TVG43, draw_noise, make_means

from northfinder.estimation import NoiseModel, RateMeans
from northfinder.estimation.whitening import whiten

Array = NDArray[np.float64]


def irregular(n: int = 120) -> RateMeans:
    """Means of uneven length, some sharing end points, some after gaps of any size."""
    rng = np.random.default_rng(5)
    duration = rng.choice([0.4, 1.0, 2.5], n)
    gap = rng.choice([0.0, 0.0, 0.7, 30.0], n)
    start = 1e5 + np.cumsum(gap) + np.concatenate([[0.0], np.cumsum(duration)[:-1]])
    zero = np.zeros(n)
    return RateMeans(start=start, duration=duration, rate=zero, azimuth=zero, elevation=zero, n_samples=np.full(n, 100))


def variogram(cov: Array) -> Array:
    """Variance of the difference of any two means: what is left when the bias is unknown."""
    return np.asarray(np.add.outer(cov.diagonal(), cov.diagonal()) - 2.0 * cov)


def test_field_units_are_those_of_a_data_sheet() -> None:
    """Each coefficient, given alone, reads back from the Allan deviation at its textbook averaging time."""
    hour = np.array([3600.0])

    def allan_dph(tau: Array, **coefficient: float) -> float:
        return float(NoiseModel.from_field_units(**coefficient).allan_deviation(tau)[0] / DPH)

    assert allan_dph(hour, angle_random_walk_deg_per_sqrt_h=0.003) == pytest.approx(0.003)
    assert allan_dph(hour, bias_instability_dph=0.06) == pytest.approx(0.664 * 0.06, rel=1e-3)
    assert allan_dph(3.0 * hour, rate_random_walk_dph_per_sqrt_h=0.2) == pytest.approx(0.2)
    assert allan_dph(np.sqrt(2.0) * hour, rate_ramp_dph_per_h=0.1) == pytest.approx(0.1)
    assert allan_dph(np.array([60.0]), angle_white_noise_dph_s=0.764) == pytest.approx(np.sqrt(3.0) * 0.764 / 60.0)


@pytest.mark.parametrize("bad", [-1.0, float("nan"), float("inf")])
def test_a_coefficient_must_be_a_number_that_can_be_one(bad: float) -> None:
    """A negative or endless coefficient is refused by name."""
    with pytest.raises(ValueError, match="bias_instability"):
        NoiseModel(bias_instability=bad)


def test_angle_white_noise_ties_neighbours_by_their_common_end_point() -> None:
    """The mean over a whole run has the noise of its two ends alone, however finely it is cut."""
    cut = make_means(0.0, 0.0, positions=((0, 0),), dwell=60.0, mean=1.0)
    cov = NoiseModel(angle_white_noise=1.0).covariance(cut)
    assert np.mean(cov) == pytest.approx(2.0 / 60.0**2, rel=1e-12)
    assert cov[0, 1] == -1.0
    assert cov[0, 2] == 0.0


def test_flicker_covariance_is_the_integrated_logarithm() -> None:
    """The variance of every difference of means is that of ``-(B^2/pi) ln|t|`` integrated over both intervals."""
    for means in (irregular(), make_means(0.0, 0.0), make_means(0.0, 0.0, mean=2.0)):
        begin, end = means.start, means.start + means.duration

        def twice_integrated(t: Array) -> Array:
            safe = np.where(t == 0.0, 1.0, np.abs(t))
            return np.asarray(0.5 * t**2 * (np.log(safe) - 1.5))

        def term(a: Array, b: Array) -> Array:
            return twice_integrated(np.subtract.outer(a, b))

        box = term(end, begin) + term(begin, end) - term(end, end) - term(begin, begin)
        exact = variogram(-box / np.pi / np.outer(means.duration, means.duration))
        ours = variogram(NoiseModel(bias_instability=1.0).covariance(means))
        off = ~np.eye(means.n, dtype=bool)
        np.testing.assert_allclose(ours[off], exact[off], rtol=1e-3)


@pytest.mark.parametrize("kind", sorted(TVG43))
def test_covariance_is_that_of_simulated_samples(kind: str) -> None:
    """Over 3,000 runs drawn sample by sample the variances of differences lie within their sampling error."""
    means = make_means(0.0, 0.0, positions=((0, 0), (90, 0)), dwell=12.0, turn=4.0, mean=4.0)
    coefficient = {kind: TVG43[kind]}
    n_runs = 3000
    drawn = draw_noise(np.random.default_rng(11), means, n_runs, **coefficient)
    predicted = variogram(NoiseModel.from_field_units(**coefficient).covariance(means))
    seen = np.mean((drawn[:, :, np.newaxis] - drawn[:, np.newaxis, :]) ** 2, axis=0)
    off = ~np.eye(means.n, dtype=bool)
    ratio = seen[off] / predicted[off]
    bound = 4.5 * np.sqrt(2.0 / n_runs) + 0.02  # 0.02: samples of 0.1 s stand for continuous time
    assert np.all(np.abs(ratio - 1.0) < bound), ratio


@pytest.mark.parametrize("without", [None, *sorted(TVG43), "all but angle_white_noise_dph_s"])
def test_one_pass_equals_the_dense_cholesky_factor(without: str | None) -> None:
    """Whitening in one pass gives the rows of the inverse Cholesky factor to 1e-9, gaps and ramp included."""
    coefficients = TVG43 | {"rate_ramp_dph_per_h": 0.1}
    if without == "all but angle_white_noise_dph_s":
        coefficients = {"angle_white_noise_dph_s": 0.764}
    elif without is not None:
        coefficients[without] = 0.0
    noise, means = NoiseModel.from_field_units(**coefficients), irregular()
    columns = np.random.default_rng(3).standard_normal((means.n, 4))
    dense = solve_triangular(np.linalg.cholesky(noise.covariance(means)), columns, lower=True)
    one_pass = whiten(noise, means, columns)
    assert np.max(np.abs(one_pass - dense)) < 1e-9 * np.max(np.abs(dense))


def test_a_noise_model_without_noise_is_refused() -> None:
    """An all-zero model would claim a perfect gyro; it is refused, never divided by."""
    means = irregular()
    with pytest.raises(ValueError, match="without error"):
        whiten(NoiseModel(), means, np.ones((means.n, 1)))
