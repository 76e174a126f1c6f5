"""Motion profiles in closed form, in integers: no error grows with time, and all controllers compute the same path.

With speed ``v``, acceleration ``a`` and distance ``d``: the ramp lasts ``v/a`` and covers ``v^2/2a``; a move lasts
``d/v + v/a``, where ``v^2 <= a d``. Positions in counts, times in microseconds.
"""

_SECOND = 1_000_000


def square_root(value: int) -> int:
    """Return the integer part of the square root, by Newton's method."""
    root = value
    better = (value + 1) // 2
    while better < root:
        root = better
        better = (root + value // root) // 2
    return root


def _divide_up(dividend: int, divisor: int) -> int:
    return -(-dividend // divisor)


class Profile:
    """Motion along one axis: speeding up, going on, slowing down to rest at the target; made by `trapezoid` or `brake`.

    Attributes
    ----------
    start, target : int
        Positions; no position of the profile lies outside them.
    direction : int
        1, -1, or 0 if there is nowhere to go.
    end_us : int
        When the target is reached.
    """

    def __init__(
        self, start: int, target: int, speed: int, acceleration: int, start_us: int, rise_us: int, end_us: int
    ) -> None:
        self.start = start
        self.target = target
        self.direction = (target > start) - (target < start)
        self.end_us = end_us
        self._speed = speed
        self._acceleration = acceleration
        self._start_us = start_us
        self._rise_us = rise_us
        self._fall_us = _divide_up(speed * _SECOND, acceleration)

    def position(self, now_us: int) -> int:
        """Return where the axis shall be."""
        distance = abs(self.target - self.start)
        elapsed = now_us - self._start_us
        left = self.end_us - now_us
        if elapsed <= 0:
            travelled = 0
        elif left <= 0:
            travelled = distance
        elif elapsed < self._rise_us:
            travelled = self._acceleration * elapsed * elapsed // (2 * _SECOND * _SECOND)
        elif left <= self._fall_us:
            travelled = distance - self._acceleration * left * left // (2 * _SECOND * _SECOND)
        else:
            travelled = self._speed * (2 * elapsed - self._rise_us) // (2 * _SECOND)
        return self.start + self.direction * max(0, min(travelled, distance))

    def velocity(self, now_us: int) -> int:
        """Return how fast it shall go there, with its sign."""
        elapsed = now_us - self._start_us
        left = self.end_us - now_us
        if elapsed < 0 or left <= 0:
            return 0
        speed = self._speed
        if elapsed < self._rise_us:
            speed = self._acceleration * elapsed // _SECOND
        elif left <= self._fall_us:
            speed = min(speed, self._acceleration * left // _SECOND)
        return self.direction * speed


def trapezoid(start: int, target: int, speed: int, acceleration: int, start_us: int) -> Profile:
    """Return the move from rest at `start` to rest at `target`, triangular if too short to reach `speed`."""
    distance = abs(target - start)
    speed = max(1, min(speed, square_root(acceleration * distance)))
    rise_us = speed * _SECOND // acceleration
    duration = rise_us + _divide_up(distance * _SECOND, speed) if distance else 0
    return Profile(start, target, speed, acceleration, start_us, rise_us, start_us + duration)


def brake(profile: Profile, deceleration: int, now_us: int) -> Profile:
    """Return the way to rest from where `profile` is now; never beyond its target."""
    start = profile.position(now_us)
    speed = abs(profile.velocity(now_us))
    distance = min(speed * speed // (2 * deceleration), abs(profile.target - start))
    duration = _divide_up(speed * _SECOND, deceleration)
    return Profile(start, start + profile.direction * distance, speed, deceleration, now_us, 0, now_us + duration)
