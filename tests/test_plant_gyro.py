"""The gyro's errors come out as the profile asks for, and profiles are read strictly."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec
import numpy as np
import pytest

from sim_device.plant.earth import EARTH_RATE, Site
from sim_device.plant.gyro import DPH, Gyro
from sim_device.plant.profile import GyroProfile, TemperatureProfile, load_profile, profile_names

KYIV = Site(latitude=math.radians(50.429), heading=math.radians(18.9))
IDEAL = load_profile("ideal").gyro
TVG43 = load_profile("tvg43").gyro
FOUR = np.radians([0.0, 90.0, 180.0, 270.0])


def altered(profile: GyroProfile, **changes: object) -> GyroProfile:
    """Return the profile with some of its keys changed."""
    return msgspec.structs.replace(profile, **changes)


def test_ideal_gyro_gives_the_projection() -> None:
    """Without errors a sample is the earth's rate about the input axis."""
    rate = Gyro(IDEAL, KYIV, seed=1).measure(FOUR, np.zeros(4))[:, 0]
    true_azimuth = np.radians([18.9, 108.9, 198.9, 288.9])
    assert rate == pytest.approx(EARTH_RATE * math.cos(KYIV.latitude) * np.cos(true_azimuth), abs=1e-18)


def test_errors_of_tvg43() -> None:
    """Scale factor, bias and acceleration-sensitive drift rate of tvg43 are those of the paper's table."""
    profile = altered(TVG43, noise=IDEAL.noise, turn_on_bias_sd_dph=0.0)
    u1, _, u3, _ = Gyro(profile, KYIV, seed=1).measure(FOUR, np.zeros(4))[:, 0] / DPH
    assert (u1 + u3) / 2 == pytest.approx(38.0)
    assert (u1 - u3) / 2 == pytest.approx(1.021 * 15.041067 * math.cos(KYIV.latitude) * math.cos(math.radians(18.9)))
    u5, u6 = Gyro(profile, KYIV, seed=1).measure(np.zeros(2), np.radians([90.0, -90.0]))[:, 0] / DPH
    assert (u5 - u6) / 2 == pytest.approx(1.021 * 15.041067 * math.sin(KYIV.latitude) + 3.0)
    scale_ratio = (u1 - u3) / (u5 - u6) / math.cos(math.radians(18.9)) * math.tan(KYIV.latitude)
    assert scale_ratio == pytest.approx(0.797, abs=0.002)  # the paper's k


def test_turn_on_bias() -> None:
    """The bias is drawn anew with each seed and each start, with the profile's sd, and only then."""
    biases = np.array([Gyro(TVG43, KYIV, seed=seed).bias[0] / DPH for seed in range(400)])
    assert biases.mean() == pytest.approx(38.0, abs=4 * 0.46 / 20)
    assert biases.std() == pytest.approx(0.46, rel=4 / math.sqrt(800))
    assert Gyro(TVG43, KYIV, seed=3).bias == Gyro(TVG43, KYIV, seed=3).bias
    assert Gyro(TVG43, KYIV, seed=3, start=1).bias != Gyro(TVG43, KYIV, seed=3, start=2).bias


def test_temperature_moves_the_bias() -> None:
    """The bias follows the warm-up exponentially and does not depend on the size of a read."""
    thermal = TemperatureProfile(
        ambient_c=10.0,
        warm_up_rise_c=20.0,
        warm_up_time_constant_s=100.0,
        reference_c=30.0,
        bias_coefficient_dph_per_c=0.5,
    )
    profile = altered(IDEAL, temperature=thermal)
    gyro = Gyro(profile, Site(latitude=0.0, heading=math.pi / 2), seed=1, sample_rate=1.0)
    rate = gyro.measure(np.zeros(1000), np.zeros(1000))[:, 0] / DPH
    assert rate[[0, 100, 999]] == pytest.approx([-10.0, -10.0 * math.exp(-1), 0.0], abs=1e-3)
    assert gyro.temperature == pytest.approx(30.0, abs=1e-2)
    again = Gyro(profile, gyro.site, seed=1, sample_rate=1.0)
    parts = np.concatenate([again.measure_at_rest(0.0, 0.0, n) for n in (1, 399, 600)])[:, 0] / DPH
    assert np.array_equal(parts, rate)


def test_saturation_and_resolution() -> None:
    """Beyond its range the gyro stays at the limit and says so; the rate comes in steps of the resolution."""
    gyro = Gyro(altered(IDEAL, range_dph=8.0, resolution_dph=0.5), Site(latitude=0.0, heading=0.0), seed=1)
    rate = gyro.measure(FOUR, np.zeros(4))[:, 0] / DPH
    assert gyro.saturated
    assert rate == pytest.approx([8.0, 0.0, -8.0, 0.0])
    assert gyro.measure_at_rest(math.radians(60.5), 0.0, 1)[0, 0] / DPH == pytest.approx(7.5)  # 7.407
    assert not gyro.saturated


def test_three_axes_have_their_own_noise() -> None:
    """Each axis of three has noise of its own, and a misalignment for each is asked for."""
    profile = load_profile("fast3").gyro
    rate = Gyro(profile, KYIV, seed=1).measure_at_rest(0.0, 0.0, 4000)
    assert rate.shape == (4000, 3)
    correlation = np.asarray(np.corrcoef(np.diff(rate, axis=0), rowvar=False))
    assert np.abs(correlation[np.triu_indices(3, 1)]).max() < 5 / math.sqrt(4000)


def test_skipping_is_reading() -> None:
    """Samples that pass unread leave the noise where reading them would have."""
    read, skipped = (Gyro(TVG43, KYIV, seed=4, batch=100) for _ in range(2))
    read.measure_at_rest(0.0, 0.0, 12_345)
    skipped.skip(12_345)
    assert np.array_equal(read.measure_at_rest(0.5, 0.0, 50), skipped.measure_at_rest(0.5, 0.0, 50))


def test_wrong_number_of_noise_sources() -> None:
    """Noise given for another number of axes is refused."""
    with pytest.raises(ValueError, match="has 1 axes, but noise was given for 0"):
        Gyro(IDEAL, KYIV, seed=1, noise=[])


def test_recording_as_noise(tmp_path: Path) -> None:
    """A profile takes a recording as its noise, from a file beside it."""
    counts = np.random.default_rng(1).integers(-50, 50, 1000).astype(np.int16)
    np.savez(tmp_path / "static.npz", rate_counts=counts)
    text = (Path(str(__file__)).parents[1] / "sim_device/plant/profiles/ideal.toml").read_text(encoding="utf-8")
    recording = (
        '[gyro.recording]\nfile = "static.npz"\nkey = "rate_counts"\nsample_rate_hz = 235.0\ndph_per_count = 0.1\n'
    )
    (tmp_path / "mine.toml").write_text(text + recording, encoding="utf-8")
    profile = load_profile(tmp_path / "mine.toml").gyro
    gyro = Gyro(profile, Site(latitude=0.0, heading=math.pi / 2), seed=1)
    rate = gyro.measure_at_rest(0.0, 0.0, 1000)[:, 0] / DPH
    assert rate == pytest.approx((counts - counts.mean()) * 0.1, abs=1e-8)
    assert profile.recording is not None
    with pytest.raises(ValueError, match=r"static.npz: cannot read array 'other'"):
        Gyro(altered(profile, recording=msgspec.structs.replace(profile.recording, key="other")), KYIV, seed=1)


def test_profiles_that_come_with_it() -> None:
    """The emulator's own profiles parse and are called what their files are."""
    assert profile_names() == ["fast3", "ideal", "kvh", "m-g370", "stim300", "triad", "tvg43"]
    assert [load_profile(name).name for name in profile_names()] == profile_names()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("bias_dph = 38.0", "bias_dhp = 38.0", r"unknown key `bias_dhp` - at `\$.gyro`"),
        ("bias_dph = 38.0", 'bias_dph = "38"', r"Expected `float`, got `str` - at `\$.gyro.bias_dph`"),
        ("sample_rate_hz = 235.0", "sample_rate_hz = 0", r"> 0.* - at `\$.gyro.sample_rate_hz`"),
        ("sample_rate_hz = 235.0", "", r"missing required field `sample_rate_hz`"),
        ("sample_rate_hz = 235.0", "sample_rate_hz = 235.0\nn_axes = 2", r"n_axes must be 1 or 3, got 2"),
        ("limit_deg = 380.0", "limit_deg = 420.0", r"limit_deg < switch_deg"),
        ("[stage]", "[stage", r"Expected ']'"),
    ],
)
def test_profile_errors_name_key_and_file(tmp_path: Path, old: str, new: str, message: str) -> None:
    """A mistake in a profile is one clear line that names the key and the file."""
    text = (Path(str(__file__)).parents[1] / "sim_device/plant/profiles/tvg43.toml").read_text(encoding="utf-8")
    path = tmp_path / "mine.toml"
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(ValueError, match=message) as caught:
        load_profile(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_no_such_profile() -> None:
    """A name that is neither a profile nor a file is refused with the names there are."""
    with pytest.raises(ValueError, match=r"no profile 'tvg44': neither one of fast3, .*, tvg43 nor a readable file"):
        load_profile("tvg44")
