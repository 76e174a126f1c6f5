"""One axis of the stage: follows a motion profile, watches its encoder, finds its reference.

Positions are encoder counts since power-up. See ``docs/protocol.md`` section 5.
"""

from sim_device.firmware.hardware import StageBoard
from sim_device.firmware.motion import brake, trapezoid

E_STOP = 2
STALL = 3
RUNAWAY = 4
ENCODER = 5
LIMIT_SWITCH = 6

_ARCSEC = 10
_DEGREE = 36_000

IN_POSITION = 30 * _ARCSEC  # the encoder this near the target of an ended profile
CREEP = _DEGREE // 100  # per second, of the last pass of homing
FASTEST_CREEP = 3 * _DEGREE // 10
LAG = _DEGREE // 2  # between profile and encoder: the axis does not follow
_JUMP = _DEGREE // 10  # more than the axis can have moved
_WRONG_WAY = _DEGREE // 10  # per second
_STILL = 10 * _ARCSEC
_TRAIL = 8  # control periods over which the rate is measured


class Axis:
    """An axis with its drive, encoder and limit switches.

    Attributes
    ----------
    offset : int
        Encoder count at the reference, 0 before homing.
    reading : int
        Encoder count when last observed.
    profile : Profile
        What it follows.
    """

    def __init__(self, board: StageBoard, index: int) -> None:
        self.offset = 0
        self.reading = 0
        self.profile = trapezoid(0, 0, 1, 1, 0)
        self._board = board
        self._index = index
        self._shift = 0  # encoder minus drive counts: not 0 once the encoder has lost counts
        self._command = 0  # where the drive was sent last
        self._command_at_change = 0  # the same, when the encoder last changed
        self._trail = [(0, 0)]  # latest readings and their instants
        self._rest_reading = 0
        self._switch_armed = False

    # motion

    def start(self, now_us: int) -> None:
        """Get ready to leave from rest: from where the axis stands, wherever it was sent before."""
        self._trail = []
        self.observe(now_us)
        if abs(self.lag) > IN_POSITION:
            self._command = self.reading
        self._command_at_change = self._command
        self.profile = trapezoid(self._command, self._command, 1, 1, now_us)
        self._switch_armed = not self._board.limit_switch(self._index, now_us)

    def go(self, target: int, speed: int, acceleration: int, now_us: int) -> None:
        """Leave for `target`."""
        self.profile = trapezoid(self._command, target, speed, acceleration, now_us)

    def brake(self, now_us: int) -> None:
        """Come to rest as fast as the board may."""
        self.profile = brake(self.profile, self._board.stop_deceleration, now_us)

    def hold(self, now_us: int) -> None:
        """Stay where the encoder says that the axis is."""
        self.profile = trapezoid(self.reading, self.reading, 1, 1, now_us)

    def drive(self, now_us: int) -> None:
        """Send the drive to where the profile is now."""
        self._command = self.profile.position(now_us)
        self._board.drive(self._index, self._command - self._shift, now_us)

    def arrived(self, now_us: int) -> bool:
        """Return whether the drive has been sent to the profile's end."""
        return now_us >= self.profile.end_us and self._command == self.profile.target

    def realign(self) -> None:
        """Take encoder and drive to stand at the same place, after the encoder has lost counts."""
        self._shift += self.reading - self._command
        self._command = self.reading

    # supervision

    @property
    def lag(self) -> int:
        """Where the axis is, less where it was sent."""
        return self.reading - self._command

    @property
    def lost(self) -> bool:
        """Whether the axis does not follow."""
        return abs(self.lag) > LAG

    @property
    def rate(self) -> int:
        """Measured speed, counts a second."""
        return self._rate_since(0)

    def _rate_since(self, entry: int) -> int:
        """Return the speed measured since an entry of the trail."""
        (first_us, first), (last_us, last) = self._trail[entry], self._trail[-1]
        return (last - first) * 1_000_000 // (last_us - first_us) if last_us > first_us else 0

    @property
    def still(self) -> bool:
        """Whether the encoder has not moved for some control periods."""
        readings = [reading for _, reading in self._trail]
        return len(readings) == _TRAIL and max(readings) - min(readings) <= _STILL

    def position(self, now_us: int) -> int:
        """Return the encoder's position about the reference."""
        return self._board.encoder(self._index, now_us) - self.offset

    def observe(self, now_us: int) -> None:
        """Read the encoder."""
        reading = self._board.encoder(self._index, now_us)
        if reading != self.reading:
            self._command_at_change = self._command
        self.reading = reading
        self._trail = self._trail[1 - _TRAIL :]
        self._trail.append((now_us, reading))

    def check(self, now_us: int) -> int:
        """Observe the axis in motion and return what is wrong with it, 0 if nothing."""
        last_us, last = self._trail[-1]
        self.observe(now_us)
        closed = self._board.limit_switch(self._index, now_us)
        tripped = closed and self._switch_armed
        self._switch_armed = not closed
        if tripped:
            return LIMIT_SWITCH
        if abs(self.reading - last) > _JUMP + 2 * self._board.max_speed * (now_us - last_us) // 1_000_000:
            return ENCODER
        return self.diagnose(now_us) if self.lost else 0

    def diagnose(self, now_us: int) -> int:
        """Return why the axis is not where it was sent."""
        if self._board.overload(self._index, now_us):
            return STALL
        if abs(self._command - self._command_at_change) > IN_POSITION:
            return ENCODER
        direction = self.profile.direction
        rate = self._rate_since(max(-3, -len(self._trail)))
        forward = direction * rate if direction else -abs(rate)
        return RUNAWAY if direction * self.lag > 0 or forward < -_WRONG_WAY else STALL

    @property
    def runs(self) -> bool:
        """Whether the encoder moves from one look to the next."""
        return abs(self._rate_since(-2)) > _DEGREE // 10

    def rest(self) -> None:
        """Remember where the axis rests."""
        self._rest_reading = self.reading

    def disturbed(self, now_us: int) -> bool:
        """Observe the axis at rest and return whether the encoder has left where it rested."""
        self.observe(now_us)
        return abs(self.reading - self._rest_reading) > _JUMP


class Homing:
    """Takes an axis to its reference edge: each pass slower than the one before, all but the first upward.

    Attributes
    ----------
    done, failed : bool
        How it ended.
    edge : int
        Encoder count of the edge, as met last.
    """

    def __init__(
        self,
        board: StageBoard,
        index: int,
        axis: Axis,
        farthest: int,
        speed: int,
        acceleration: int,
        now_us: int,
        creep: int = CREEP,
    ) -> None:
        self.done = False
        self.failed = False
        self.edge = 0
        self._board = board
        self._index = index
        self._axis = axis
        self._fast = speed
        self._acceleration = acceleration
        self._speeds = [min(speed, slow) for slow in (speed, FASTEST_CREEP, creep)]  # of passes to do
        self._step = self._seek
        self._clearance = 0
        self._side = board.reference_side(index, now_us)
        axis.go(axis.reading - self._side * farthest, speed, acceleration, now_us)

    def step(self, now_us: int) -> None:
        """Do what is next at this control period."""
        self._step(now_us)

    def _seek(self, now_us: int) -> None:
        if self._board.reference_side(self._index, now_us) != self._side:
            self.edge = self._axis.reading
            self._axis.brake(now_us)
            self._step = self._slow_down
        else:
            self.failed = self._axis.arrived(now_us)

    def _slow_down(self, now_us: int) -> None:
        if not self._axis.arrived(now_us):
            return
        self._clearance = 3 * self._speeds[0] * self._board.control_period_us // 1_000_000 + 60 * _ARCSEC
        self._speeds = self._speeds[1:]
        below = self.edge - self._clearance if self._speeds else self.edge
        self._axis.go(below, self._fast, self._acceleration, now_us)
        self._step = self._come_back

    def _come_back(self, now_us: int) -> None:
        if not self._axis.arrived(now_us):
            return
        if not self._speeds:
            self.done = True
            return
        self._side = self._board.reference_side(self._index, now_us)
        self._axis.go(self.edge + self._clearance, self._speeds[0], self._acceleration, now_us)
        self._step = self._seek
