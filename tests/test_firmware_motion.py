"""Motion profiles: never outside start and target, never faster than told, always at rest at the end."""

import math

from hypothesis import given
from hypothesis import strategies as st

from sim_device.firmware.motion import Profile, brake, square_root, trapezoid

positions = st.integers(-15_000_000, 15_000_000)
speeds = st.integers(1, 1_000_000)
accelerations = st.integers(1, 1_000_000)


def _instants(profile: Profile, start_us: int, n: int = 97) -> list[int]:
    """Return instants from before the start until after the end."""
    duration = profile.end_us - start_us
    return [start_us + duration * step // n for step in range(-1, n + 2)]


@given(st.integers(0, 10**24))
def test_square_root(value: int) -> None:
    """The integer square root is that of the standard library."""
    assert square_root(value) == math.isqrt(value)


@given(positions, positions, speeds, accelerations, st.integers(0, 10**12))
def test_trapezoid(start: int, target: int, speed: int, acceleration: int, start_us: int) -> None:
    """A move leaves start, never turns back, keeps its speed, and ends at rest at the target."""
    profile = trapezoid(start, target, speed, acceleration, start_us)
    instants = _instants(profile, start_us)
    path = [profile.position(instant) for instant in instants]
    assert path[:2] == [start, start]
    assert path[-1] == profile.position(profile.end_us) == target
    forward = profile.direction
    for (t0, x0), (t1, x1) in zip(
        zip(instants, path, strict=True), zip(instants[1:], path[1:], strict=True), strict=False
    ):
        # one count for the rounding of either position, one for that of the instants
        assert -1 <= (x1 - x0) * forward <= speed * (t1 - t0) / 1e6 + 3
    assert all(0 <= profile.velocity(instant) * forward <= speed for instant in instants)
    assert profile.velocity(profile.end_us) == 0


@given(positions, positions, speeds, accelerations)
def test_trapezoid_takes_the_time_of_the_formula(start: int, target: int, speed: int, acceleration: int) -> None:
    """A move lasts d/v + v/a, or 2 sqrt(d/a) if it is too short to reach the speed."""
    distance = abs(target - start)
    duration = trapezoid(start, target, speed, acceleration, 0).end_us / 1e6
    if distance == 0:
        assert duration == 0
    elif speed * speed <= acceleration * distance:
        assert math.isclose(duration, distance / speed + speed / acceleration, abs_tol=3e-6)
    else:
        peak = math.isqrt(acceleration * distance)
        assert math.isclose(duration, distance / peak + peak / acceleration, abs_tol=3e-6)


@given(positions, positions, speeds, accelerations, st.floats(-0.1, 1.1), st.integers(1, 8))
def test_brake(start: int, target: int, speed: int, acceleration: int, fraction: float, firmness: int) -> None:
    """Braking at any instant, as hard as the move or harder, ends at rest before the target, without a jump."""
    move = trapezoid(start, target, speed, acceleration, 0)
    now_us = round(move.end_us * fraction)
    stop = brake(move, acceleration * firmness, now_us)
    assert abs(stop.position(now_us) - move.position(now_us)) <= 1
    if stop.direction:  # else it can stop within a count
        assert abs(stop.velocity(now_us) - move.velocity(now_us)) <= 1
    low, high = min(start, target), max(start, target)
    path = [stop.position(instant) for instant in _instants(stop, now_us)]
    assert all(low <= position <= high for position in path)
    assert path[-1] == stop.target
    assert stop.end_us - now_us <= math.ceil(speed * 1e6 / (acceleration * firmness))


@given(st.integers(1, 1_000_000), st.integers(100, 1_000_000), st.floats(0, 1))
def test_brake_decelerates_evenly(speed: int, deceleration: int, fraction: float) -> None:
    """Braking from a cruise follows v t - a t^2 / 2."""
    start_us = 10**10
    move = trapezoid(0, 10**12, speed, 1_000_000, 0)
    stop = brake(move, deceleration, start_us)
    elapsed_us = round(fraction * (stop.end_us - start_us))
    t = elapsed_us / 1e6
    expected = speed * t - deceleration * t * t / 2
    assert math.isclose(stop.position(start_us + elapsed_us) - stop.start, expected, rel_tol=1e-9, abs_tol=3)


@given(positions, positions, st.floats(0, 1))
def test_weak_brake_keeps_within_the_move(start: int, target: int, fraction: float) -> None:
    """Even a brake too weak for the way that is left does not go beyond the target."""
    move = trapezoid(start, target, 648_000, 324_000, 0)
    stop = brake(move, 32_400, round(move.end_us * fraction))
    assert min(start, target) <= stop.target <= max(start, target)


@given(positions, positions, st.floats(0, 1), st.floats(0, 1))
def test_brake_again(start: int, target: int, first: float, second: float) -> None:
    """Braking while braking changes nothing but rounding."""
    move = trapezoid(start, target, 648_000, 324_000, 0)
    stop = brake(move, 324_000, round(move.end_us * first))
    again_us = round(move.end_us * first + (stop.end_us - move.end_us * first) * second)
    again = brake(stop, 324_000, again_us)
    assert abs(again.target - stop.target) <= 3
