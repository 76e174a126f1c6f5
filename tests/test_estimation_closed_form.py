"""The published closed forms: right in every quadrant and hemisphere, and the published scatter on the cyclogram."""

from __future__ import annotations

import math

import numpy as np
import pytest
from simulated_means import DPH, TVG43, U1, U2, U3, U4, U5, draw_noise, make_means

from northfinder.errors import EstimateError
from northfinder.estimation import NoiseModel, estimate, solve_closed_form

NOISE = NoiseModel.from_field_units(**TVG43)


@pytest.mark.parametrize("azimuth_deg", [0.0, 33.0, 90.0, 147.0, 180.0, 225.0, 270.0, 359.0])
@pytest.mark.parametrize("latitude", [-75.0, -33.0, 0.0, 50.429, 75.0])
def test_every_quadrant_and_hemisphere_is_exact(azimuth_deg: float, latitude: float) -> None:
    """Formulas (2) and (3) with two-argument arctangents give back azimuth and latitude, whatever bias and scale."""
    result = solve_closed_form(make_means(azimuth_deg, latitude, scale_factor=1.02))
    error = (math.degrees(result.azimuth) - azimuth_deg + 180.0) % 360.0 - 180.0
    assert error == pytest.approx(0.0, abs=1e-9)
    assert result.latitude is not None
    assert math.degrees(result.latitude) == pytest.approx(latitude, abs=1e-9)
    assert result.bias_horizontal / DPH == pytest.approx(38.0)
    assert result.bias_vertical == pytest.approx(result.bias_horizontal)
    assert result.azimuth_sd is None


def test_scale_factors_per_plane_and_their_ratio() -> None:
    """By (10) an acceleration-sensitive drift shows as a larger vertical scale factor, and (12) takes it out again."""
    means = make_means(18.887, 50.429, scale_factor=1.021, d_g_dph=3.0)
    true = math.radians(50.429)
    published = solve_closed_form(means, known_latitude=true)
    assert published.scale_factor_horizontal == pytest.approx(1.021)
    assert published.scale_factor_vertical == pytest.approx(1.280, abs=0.005)
    assert published.latitude is not None
    assert math.degrees(published.latitude) == pytest.approx(56.6, abs=0.1)
    assert published.scale_factor_vertical is not None
    ratio = 1.021 / published.scale_factor_vertical
    corrected = solve_closed_form(means, scale_factor_ratio=ratio)
    assert corrected.latitude == pytest.approx(true, abs=1e-7)
    elsewhere = solve_closed_form(make_means(18.887, 30.0, scale_factor=1.021, d_g_dph=3.0), scale_factor_ratio=ratio)
    assert elsewhere.latitude is not None
    assert math.degrees(elsewhere.latitude) - 30.0 == pytest.approx(2.6, abs=0.2)  # k of one latitude, at another


def test_later_visits_of_a_position_do_not_count() -> None:
    """The repeated U1 hold the drift: whatever they read, the published formulas do not see it."""
    means = make_means(130.0, 50.0)
    rate = means.rate[:, 0].copy()
    rate[[4, 7]] += 5.0 * DPH
    first, disturbed = solve_closed_form(means), solve_closed_form(means.with_rate(rate))
    assert (disturbed.azimuth, disturbed.latitude) == (first.azimuth, first.latitude)


def test_no_scale_factor_where_the_earth_is_not_felt() -> None:
    """On the equator the vertical scale factor has no value, and is not infinite."""
    result = solve_closed_form(make_means(10.0, 0.0), known_latitude=0.0)
    assert result.scale_factor_vertical is None
    assert result.scale_factor_horizontal == pytest.approx(1.0)


@pytest.mark.parametrize(("positions", "missing"), [((U1, U2, U3), "U4"), ((U2, U3, U4, U5), "U1"), ((U1, U3), "U2")])
def test_a_missing_position_is_named(positions: tuple[tuple[float, float], ...], missing: str) -> None:
    """Without one of the level positions there is no azimuth by (2), and the message says which is missing."""
    with pytest.raises(EstimateError, match=missing):
        solve_closed_form(make_means(30.0, 50.0, positions=positions))


def test_without_the_vertical_pair_there_is_an_azimuth_and_no_latitude() -> None:
    """Five positions give what five positions can."""
    result = solve_closed_form(make_means(130.0, 50.0, positions=(U1, U2, U3, U4, U5)), noise=NOISE)
    assert math.degrees(result.azimuth) == pytest.approx(130.0)
    assert result.latitude is None
    assert result.latitude_sd is None
    assert "U6" in result.latitude_reason


def test_at_a_pole_there_is_no_azimuth() -> None:
    """Where nothing horizontal is felt the reason is named."""
    with pytest.raises(EstimateError, match="not distinguishable from zero"):
        solve_closed_form(make_means(30.0, 90.0), noise=NOISE)


def test_standard_deviations_are_those_of_small_disturbances() -> None:
    """The stated sd follow from the covariance of the dwell means by numerical differences of the result."""
    means = make_means(200.0, -20.0)
    base = solve_closed_form(means, noise=NOISE)
    step = 1e-4 * DPH
    gradients = []
    for i in range(means.n):
        rate = means.rate[:, 0] + step * (np.arange(means.n) == i)
        moved = solve_closed_form(means.with_rate(rate))
        assert moved.latitude is not None
        assert base.latitude is not None
        gradients.append([(moved.azimuth - base.azimuth) / step, (moved.latitude - base.latitude) / step])
    jacobian = np.array(gradients).T
    sds = np.sqrt(np.diag(jacobian @ NOISE.covariance(means) @ jacobian.T))
    assert [base.azimuth_sd, base.latitude_sd] == pytest.approx(sds.tolist(), rel=1e-4)


def test_the_published_scatter() -> None:
    """On the cyclogram with 10 s turns formula (2) scatters by 0.19 deg sec(lat), as published and as predicted."""
    n_runs, cos_lat = 600, math.cos(math.radians(50.429))
    means = make_means(18.887, 50.429)
    drawn = draw_noise(np.random.default_rng(20), means, n_runs, sample_rate=2.0, **TVG43)
    azimuths = [solve_closed_form(means.with_rate(means.rate[:, 0] + noise)).azimuth for noise in drawn]
    scatter = float(np.sqrt(np.mean((np.degrees(azimuths) - 18.887) ** 2))) * cos_lat
    assert scatter == pytest.approx(0.190, rel=0.15)
    predicted = solve_closed_form(means, noise=NOISE).azimuth_sd
    assert predicted is not None
    assert scatter == pytest.approx(math.degrees(predicted) * cos_lat, rel=4.0 / math.sqrt(2.0 * n_runs))


def test_what_better_weights_gain() -> None:
    """Over all azimuths the same eight dwells weighted by their noise give 0.131 deg sec(lat), short means less yet."""
    cos_lat = math.cos(math.radians(50.429))

    def rms_sd(mean: float | None) -> float:
        cycles = [make_means(azimuth, 50.429, mean=mean) for azimuth in range(0, 360, 45)]
        sds = [estimate(cycle, noise=NOISE, weights="generalised").azimuth_sd for cycle in cycles]
        return math.degrees(float(np.sqrt(np.mean(np.square(sds))))) * cos_lat

    assert rms_sd(None) == pytest.approx(0.131, rel=0.03)
    assert rms_sd(5.0) < 0.125
