"""How the world's time runs against wall time while the emulator is served, at real time or faster.

At 1x world time is wall time. Faster, the world never runs slower than that, and runs ahead only while the host keeps
up: it goes from one thing that is due to the next, and holds as soon as a device has sent a stream frame that its
host must acknowledge (``seen_time_us`` of HEARTBEAT) and has not; a host that goes on saying so has lost it, and is
held up no longer. Where hosts acknowledge nothing, it holds while they have not read what was sent, and for a stage
that is polled, the last poll counts. So a run at full speed is a lockstep with the host. When the host stays away,
time goes on at 1x from there, and a dead host trips the stage's watchdog as in reality: after a quarter of a second
with the stage at rest; a while later while it moves, so that a host which is merely busy finds the same world again.
At N times real time what was waited for a host is made up for, up to a second of it, so that N is what a whole run
has if its host is fast enough.

Time in which the emulator itself got no processor does not pass in the world (`WallTime`): what its hosts said
meanwhile is with the devices late, and a watchdog would take that for their silence.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from sim_device.bench import Seat, World

MOVING_PATIENCE_US = 600_000  #: wall time for which the world waits for the host while the stage moves; hosts wait 1 s
REST_PATIENCE_US = 250_000  #: the same with the stage at rest
MOVING_WINDOW_US = 150_000  #: stage in motion: its status period of 100 ms and a little, well under its watchdog
REST_WINDOW_US = 1_100_000  #: stage at rest: its status period of 1 s and a little
UNREAD_LOOK_US = 200  #: between looks at whether the host has read what it need not acknowledge
CATCH_UP_US = 1_000_000  #: of wall time, the most that is made up for
LONGEST_STEP_US = 60_000  #: of wall time at once; the emulator looks at its lines more often than that if it is let
CONTROL_US = 20_000  #: the stage counts as in motion for so long after its drives were last told something


class WallTime:
    """Wall time since it was made, in microseconds, less what was lost between two looks at it.

    Parameters
    ----------
    monotonic
        The system's time in s.

    """

    def __init__(self, monotonic: Callable[[], float]) -> None:
        self._monotonic = monotonic
        self.origin = self._last = monotonic()  #: the system's time at which it began, or would have if none was lost

    def now_us(self) -> int:
        """Return it; since the last look at most LONGEST_STEP_US have passed."""
        now = self._monotonic()
        self.origin += max(0.0, now - self._last - 1e-6 * LONGEST_STEP_US)
        self._last = now
        return round((now - self.origin) * 1e6)


class Pace:
    """Takes a bench through time; wall time in microseconds from the start of serving.

    Parameters
    ----------
    bench
        What is served.
    speed
        How many times real time, at least 1; inf for as fast as the hosts keep up.

    """

    def __init__(self, bench: World, speed: float) -> None:
        if not speed >= 1:
            raise ValueError(f"the speed must be at least 1, got {speed:g}")
        self._bench = bench
        self._speed = speed
        self._wall_us = 0
        self._lead_us = 0  # the most by which the world has been ahead of wall time since the stage moves or rests
        self._in_motion = False
        self._limit_us = 0.0  # of the world, by the speed

    def advance(self, wall_us: int) -> None:
        """Let the world follow wall time at 1x, or without hosts at the speed asked for."""
        bench = self._bench
        passed_us, self._wall_us = wall_us - self._wall_us, wall_us
        behind_us = min(max(0.0, self._limit_us - bench.now_us), self._speed * CATCH_UP_US)
        self._limit_us = math.inf if self._speed == math.inf else bench.now_us + behind_us + self._speed * passed_us
        if self._in_motion != self._moves():
            self._in_motion = not self._in_motion
            self._lead_us = bench.now_us - (wall_us - passed_us)
        if self._speed > 1 and not self._with_host():
            bench.advance_to(bench.now_us + passed_us if self._speed == math.inf else round(self._limit_us))
        else:
            bench.advance_to(self._steady_us())
        self._lead_us = max(self._lead_us, bench.now_us - wall_us)

    def run_ahead(self) -> bool:
        """Go to what a device with a host does next, if the host keeps up; return whether the world is there now."""
        due = self._next_us()
        if due is None:
            return False
        self._bench.advance_to(round(min(due, self._limit_us)))
        self._lead_us = max(self._lead_us, self._bench.now_us - self._wall_us)
        return due <= self._limit_us

    def wait_us(self) -> float:
        """Return for how long, in wall time, nothing will happen unless a host says something."""
        due = self._next_us()
        if due is not None:
            return max(0.0, due - self._limit_us) / self._speed
        if self._speed > 1 and any(line.unread for line in self._bench.lines):
            return UNREAD_LOOK_US  # nothing tells when a host has read
        next_due = self._bench.next_due_us()
        if next_due is None:
            return math.inf
        behind = self._steady_us() if self._with_host() or self._speed == 1 else self._bench.now_us
        return max(0, next_due - behind)

    def _with_host(self) -> bool:
        return any(line.device.session for line in self._bench.lines)

    def _steady_us(self) -> int:
        """Return where the world is at least, hosts or not."""
        if self._speed == 1:
            return self._wall_us
        return self._wall_us + self._lead_us - (MOVING_PATIENCE_US if self._in_motion else REST_PATIENCE_US)

    def _moves(self) -> bool:
        return self._bench.now_us <= self._bench.plant_stage.rest_since_us() + CONTROL_US

    def _next_us(self) -> int | None:
        """Return what the world may run ahead to, None if it has to wait."""
        if self._speed == 1:
            return None
        hosted = [line for line in self._bench.lines if line.device.session]
        due = min((line.due_us for line in hosted if line.due_us is not None), default=None)
        if any(line.device.testing for line in hosted):
            return due  # the host waits for the outcome, and may not listen to the other device meanwhile
        return due if due is not None and all(due <= self._horizon_us(line) for line in hosted) else None

    def _horizon_us(self, line: Seat) -> float:
        """Return up to when a line's host lets the world run ahead."""
        seen_us = line.device.seen_time_us
        if not line.acknowledged and line.unread:
            return -math.inf
        if line is self._bench.gyro:
            if not line.acknowledged:
                return math.inf
            awaited = self._bench.gyro_board.newest_block_us > seen_us
            return -math.inf if awaited else math.inf
        if line.told_us > seen_us:
            return -math.inf
        return line.epoch_us + seen_us + (MOVING_WINDOW_US if self._moves() and not line.rests else REST_WINDOW_US)
