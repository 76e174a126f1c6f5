"""One axis of the stage: a CiA 402 drive on its node, in profile position and homing mode.

Set-point handshake (IEC 61800-7-201, profile position): target and bit 4 go out; bit 12 comes; bit 4 falls; bit 12
falls; then bit 10 tells the arrival. It goes on in `advance`, which never waits. A drive that faults is left alone
until `reset_fault`.
"""

from __future__ import annotations

from enum import Enum

from drivers.api import Clock, FrameLink
from drivers.canopen.node import Node, load_dictionary
from drivers.canopen.pdo import PdoCodec
from drivers.cia402.options import DriveOptions
from drivers.cia402.words import (
    FAULTY,
    REFUSALS,
    UNKNOWN_FAULT,
    Control,
    DriveState,
    Status,
    drive_state,
    fault_name,
)

EDS = "cia402_stage.eds"
HOMING_START_TIME = 0.5  # s after which a homing that needs no motion is taken for one that has begun
AXIS_NAMES = ("azimuth", "elevation")

_CONTROL, _STATUS = (0x6040, 0), (0x6041, 0)
_POSITION, _VELOCITY, _TARGET = (0x6064, 0), (0x606C, 0), (0x607A, 0)
_SPEED = (0x6081, 0)
_ERROR = (0x603F, 0)
_DEVICE_TIME, _TIME_SEEN = (0x2110, 0), (0x2111, 0)


class Activity(Enum):
    """What an axis does, as the host knows it."""

    REST = "rest"
    OFFERED = "set-point offered"
    TAKEN = "set-point taken"
    MOVING = "moving"
    HOMING_ASKED = "homing asked for"
    HOMING = "homing"
    STOPPING = "stopping"


class Axis:
    """A drive and what it does.

    Parameters
    ----------
    link
        To the bus; closed with the node.
    clock
        The clock that `link` notifies.
    node_id
        The drive's number.
    index
        0 azimuth, 1 elevation.
    options
        How the drive is used.
    """

    def __init__(self, link: FrameLink, clock: Clock, node_id: int, index: int, options: DriveOptions) -> None:
        self.index = index
        self.options = options
        self.node = node = Node(link, clock, load_dictionary(EDS, node_id), title=f"{AXIS_NAMES[index]} axis")
        self.ours = False  #: whether it is this project's axis, known after `setup.meet`
        self.units = 0.0  #: position units per rad, negative if they count the other way; known after `configure`
        self.speed_units = 0.0  #: per rad/s
        self.acceleration_units = 0.0  #: per rad/s^2
        self.activity = Activity.REST
        self.homed = False
        self.in_position = False  #: whether the last move has arrived
        self.fault = ""
        self._cause = ""  # what the newest EMCY named
        self.refusal = ""  #: why the last set-point was refused
        self.statusword = self.position = self.velocity = 0  #: newest, in units of the drive
        self.device_time_ms: int | None = None  #: newest, None for a drive that tells none
        self._seen_ms: int | None = None
        self._clock = clock
        self._target = 0
        self._speed = 0
        self._asked_at = 0.0
        remote = node.remote
        self._command_codec, self._seen_codec = PdoCodec(remote.rpdo[1]), PdoCodec(remote.rpdo[2])
        self._status_codec, self._time_codec = PdoCodec(remote.tpdo[1]), PdoCodec(remote.tpdo[2])
        node.collect(self._status_codec.cob_id, self._time_codec.cob_id)

    @property
    def name(self) -> str:
        """The axis for messages."""
        return self.node.name

    @property
    def state(self) -> DriveState | None:
        """State of the drive."""
        return drive_state(self.statusword)

    def use_plain_time(self) -> None:
        """Expect velocity alone in TPDO 2: a drive of the market has no device time."""
        pdo = self.node.remote.tpdo[2]
        pdo.clear()
        pdo.add_variable(*_VELOCITY)
        self._time_codec = PdoCodec(pdo)

    # What arrives

    def take_in(self) -> bool:
        """Take in what has come, and go on with what is under way; return whether there was anything. Never waits.

        Raises
        ------
        LinkError
            If the bus is lost.
        """
        self.node.service()
        heard = self._take_emergencies()
        times = self.node.take_values(self._time_codec)
        statuses = self.node.take_values(self._status_codec)
        if times and len(times[_VELOCITY]):
            self.velocity = int(times[_VELOCITY][-1])
            self.device_time_ms = int(times[_DEVICE_TIME][-1]) if _DEVICE_TIME in times else None
        if statuses:
            for statusword, position in zip(statuses[_STATUS].tolist(), statuses[_POSITION].tolist(), strict=True):
                self.statusword, self.position = statusword, position
                self.advance()
                heard = True
        return heard

    def advance(self) -> None:
        """Go one step on, by the newest statusword."""
        word, state = self.statusword, self.state
        if state in FAULTY:
            self._note_fault()
        elif self.activity is Activity.STOPPING:
            if state is not DriveState.OPERATION_ENABLED and not self.velocity:
                self.activity = Activity.REST
        elif self.activity is not Activity.REST and state is not DriveState.OPERATION_ENABLED:
            self._note_fault("SWITCHED_OFF")
        elif self.activity is Activity.OFFERED:
            if word & Status.ACKNOWLEDGED:
                self.activity = Activity.TAKEN
                self.control(Control.ENABLE)
        elif self.activity is Activity.TAKEN:
            if word & Status.ACKNOWLEDGED:
                self.control(Control.ENABLE)  # once more: it may have been lost
            else:
                self.activity = Activity.MOVING
        if self.activity is Activity.MOVING and not word & Status.ACKNOWLEDGED and word & Status.TARGET_REACHED:
            self.activity, self.in_position = Activity.REST, True
        self._advance_homing(word)

    # What the host asks for; nothing of this waits

    def control(self, word: int) -> None:
        """Send a controlword, with the target that holds."""
        frame = self._command_codec.encode({_CONTROL: word, _TARGET: self._target})
        self.node.send(self._command_codec.cob_id, frame)

    def offer(self, position: int) -> None:
        """Begin the handshake for a move to a position in units of the drive."""
        self._target = position
        self.refusal, self.in_position = "", False
        self.activity = Activity.OFFERED
        self.offer_again()

    def offer_again(self) -> None:
        """Offer the set-point by a rising edge; it may have been lost before, and is absolute."""
        self.control(Control.ENABLE)
        self.control(Control.START)

    def start_homing(self) -> None:
        """Begin homing."""
        self.homed = self.in_position = False
        self.activity, self._asked_at = Activity.HOMING_ASKED, self._clock.now()
        self.control(Control.ENABLE)
        self.control(Control.START)

    def quick_stop(self) -> None:
        """Come to rest at the quick stop ramp."""
        if self.state not in FAULTY:
            self.activity = Activity.STOPPING
            self.control(Control.QUICK_STOP)

    def acknowledge(self) -> None:
        """Tell a drive that has such an object what device time has been read, if that is news."""
        if self.device_time_ms != self._seen_ms:
            self._seen_ms = self.device_time_ms
            self.node.send(self._seen_codec.cob_id, self._seen_codec.encode({_TIME_SEEN: self._seen_ms or 0}))

    def hold(self) -> None:
        """Let the target be where the axis is."""
        self._target = self.position

    def forget_fault(self) -> None:
        """Take the axis for one without a fault."""
        self.fault = self._cause = ""
        self.node.emergencies.clear()

    # What waits for an answer

    def read_status(self) -> None:
        """Read by SDO what the PDOs will tell later."""
        self.statusword, self.position = self.node.objects.read(*_STATUS), self.node.objects.read(*_POSITION)
        self.velocity = self.node.objects.read_optional(*_VELOCITY) or 0
        self.hold()
        if self.state in FAULTY:
            self.fault = fault_name(self.node.objects.read_optional(*_ERROR) or 0)

    def set_speed(self, speed: float) -> None:
        """Let moves go at `speed` in rad/s."""
        units = max(1, round(speed * self.speed_units))
        if units != self._speed:
            self.node.objects.write(*_SPEED, units, verify=True)
            self._speed = units

    def _advance_homing(self, word: int) -> None:
        """Go one step on with a homing."""
        if self.activity is Activity.HOMING_ASKED and (
            not word & Status.TARGET_REACHED or self._clock.now() - self._asked_at >= HOMING_START_TIME
        ):
            self.activity = Activity.HOMING
        if self.activity is not Activity.HOMING or not word & Status.TARGET_REACHED | word & Status.HOMING_ERROR:
            return
        self.activity = Activity.REST
        self.homed = bool(word & Status.HOMED) and not word & Status.HOMING_ERROR
        if not self.homed:
            self._note_fault("HOMING_FAILED")
        self.hold()
        self.control(Control.ENABLE)

    def _take_emergencies(self) -> bool:
        """Take note of the EMCYs that have come; return whether there were any."""
        emergencies, self.node.emergencies = self.node.emergencies, []
        for emergency in emergencies:
            if emergency.code in REFUSALS:
                self.refusal = REFUSALS[emergency.code]
            elif emergency.code >> 8 and emergency.code != 0x8210:
                self._cause = fault_name(emergency.code)
                if self.fault == UNKNOWN_FAULT:
                    self.fault = self._cause
        return bool(emergencies)

    def _note_fault(self, what: str = UNKNOWN_FAULT) -> None:
        """Latch a fault by the name its EMCY has told, else as `what`."""
        self.fault = self.fault or self._cause or what
        self.activity = Activity.REST
        self.in_position = False
