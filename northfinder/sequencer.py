"""The measurement as an explicit state machine: which state follows which event, and what each state does.

    CONNECT -> IDENTIFY -> SELF_TEST -> HOME -> SLEW -> SETTLE -> DWELL -> SLEW -> ... -> FINISH -> DONE
    any failure -> FAULT, where the stage is stopped; the operator's stop -> STOP, likewise

Everything that arrives is handed to the recorder first. Dwells and settling are counted in the gyro's own samples and
slews in the stage's own time, so the same sequence runs against hardware and at any speed against an emulator.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Protocol

from drivers.api import (
    REPEATED,
    Clock,
    DeviceIdentity,
    Gyro,
    GyroStatus,
    RateBlock,
    Stage,
    StageLimits,
    StageMode,
    StageState,
)
from drivers.errors import DeviceError, DeviceFaultError, DeviceTimeoutError
from northfinder.cyclogram import Standing, Step, reachable_azimuth
from northfinder.errors import NorthFinderError, SequenceError
from northfinder.estimation import Fix
from northfinder.record import DwellSpan
from northfinder.record.recorder import Recorder, parts
from northfinder.streams import Earlier, StreamPlace


class State(Enum):
    """Where the measurement stands."""

    CONNECT = "connect"
    IDENTIFY = "identify"
    SELF_TEST = "self-test"
    HOME = "home"
    SLEW = "slew"
    SETTLE = "settle"
    DWELL = "dwell"
    FINISH = "finish"
    STOP = "stop"
    FAULT = "fault"
    DONE = "done"
    STOPPED = "stopped"
    FAILED = "failed"


class Event(Enum):
    """What a state's action may end with."""

    OK = "ok"
    PLAN_COMPLETE = "plan complete"
    STOP_REQUESTED = "stop requested"
    FAILURE = "failure"


def _working(following: State, **more: State) -> dict[Event, State]:
    table = {Event.OK: following, Event.STOP_REQUESTED: State.STOP, Event.FAILURE: State.FAULT}
    return table | {Event[name]: state for name, state in more.items()}


TRANSITIONS: dict[State, dict[Event, State]] = {
    State.CONNECT: _working(State.IDENTIFY),
    State.IDENTIFY: _working(State.SELF_TEST),
    State.SELF_TEST: _working(State.HOME),
    State.HOME: _working(State.SLEW),
    State.SLEW: _working(State.SETTLE, PLAN_COMPLETE=State.FINISH),
    State.SETTLE: _working(State.DWELL),
    State.DWELL: _working(State.SLEW),
    State.FINISH: _working(State.DONE),
    State.STOP: {Event.OK: State.STOPPED, Event.FAILURE: State.FAULT},
    State.FAULT: {Event.OK: State.FAILED},
}

#: Host time within which a moving stage must have come to rest after a stop, in s.
STOP_TIMEOUT = 5.0
#: How often the devices are served at least while nothing arrives, in s; heartbeats hang on it.
SERVICE_PERIOD = 0.05
#: Dwells begin at whole multiples of this in the gyro's samples, in s: so a stage that comes to rest a moment sooner or
#: later, as over another bus, does not move the samples that a dwell holds.
DWELL_GRID = 1.0
#: Stage time within which homing must end, in s.
HOME_TIMEOUT = 180.0
#: Stage time beyond twice its calculated duration within which a slew must end, in s.
SLEW_MARGIN = 10.0
#: For how many times its dwells, and how long besides a step, a plan is given room on the disk; times in s.
SPACE_FACTOR, SPACE_PER_STEP = 1.5, 30.0
_OF_A_STEP = {State.SLEW, State.SETTLE, State.DWELL}
#: What a stage latches when its host falls silent: the one fault that is expected after an interruption.
HOST_SILENT = {"WATCHDOG", "HEARTBEAT"}


class StopRequestedError(NorthFinderError):
    """The operator asked to stop; the stage is at rest and the record holds all that was measured."""


class Plan(Protocol):
    """What to do next, perhaps in the light of what has been measured."""

    @property
    def name(self) -> str:
        """The plan's name."""

    @property
    def n_steps(self) -> int:
        """How many steps it has, as far as known now."""

    def check(self, limits: StageLimits) -> None:
        """Get ready for a stage with these limits. Raises ConfigError if it cannot take all positions."""

    def next_step(self, standing: Standing) -> Step | None:
        """Return the next step, in stage azimuths; None when the plan is complete."""

    def remaining_dwell(self, n_done: int) -> float:
        """Return how many seconds of dwell are still to come after `n_done` dwells, as far as known now."""

    def outline(self) -> object:
        """Return what the record keeps of the plan: plain data or dataclasses, with ``name``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """What an observer may show. Times in s, rate in rad/s."""

    state: State
    n_done: int = 0
    n_steps: int = 0
    step: Step | None = None
    step_fraction: float = 0.0  #: how much of the present dwell is done
    remaining: float = 0.0  #: s of dwell still to come in the whole plan
    rate: float | None = None  #: mean over the newest block, first axis
    stage: StageState | None = None
    n_samples: int = 0
    n_lost: int = 0
    record_delay: float = 0.0  #: s for which the disk has not taken what it was given


class Observer(Protocol):
    """Whoever watches a measurement; must return quickly."""

    def on_progress(self, progress: Progress) -> None:
        """Take note of where the measurement stands; called for every batch of samples."""

    def on_dwell(self, span: DwellSpan, blocks: list[RateBlock]) -> Fix | None:
        """Take note of a finished dwell and of the blocks that hold its samples; return the estimate so far, if any."""


@dataclass(slots=True, kw_only=True)
class Sequencer:
    """Runs one measurement: opens the devices, follows the plan, records everything, leaves all at rest."""

    open_gyro: Callable[[], Gyro]
    open_stage: Callable[[], Stage]
    plan: Plan
    recorder: Recorder
    clock: Clock
    observer: Observer
    settle: float = 0.5  #: s of samples left out after each slew
    stop_requested: Callable[[], bool] = lambda: False
    earlier: Earlier = field(default_factory=Earlier)  #: what was done before an interruption
    facts: Mapping[str, object] = field(default_factory=dict)  #: for the record, once the devices are the right ones
    gyro: Gyro | None = None
    stage: Stage | None = None
    identities: dict[str, DeviceIdentity] = field(default_factory=dict)
    spans: list[DwellSpan] = field(default_factory=list)
    fix: Fix | None = None  #: from the dwells so far
    _place: StreamPlace = field(default_factory=StreamPlace)
    _step: Step | None = None
    _next_index: int = 0  #: one past the newest sample
    _first: int = 0  #: first sample of the present or coming dwell
    _newest: RateBlock | None = None
    _blocks: list[RateBlock] = field(default_factory=list)  #: of the present dwell
    _state: StageState | None = None
    _now: State = State.CONNECT
    _failure: Exception | None = None
    #: Kind of event, device and what went wrong: how often up to now, and what of it are blocks that the gyro flagged.
    _told: dict[tuple[str, str, str], int] = field(default_factory=dict)
    _flagged: dict[tuple[str, str, str], int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Go on after what was done before."""
        self.spans.extend(self.earlier.spans)

    def run(self) -> list[DwellSpan]:
        """Run the measurement and return its dwells.

        Raises the DeviceError or NorthFinderError that ended it early, or StopRequestedError; the stage is then
        stopped and everything measured is recorded.
        """
        actions = {
            State.CONNECT: self._connect, State.IDENTIFY: self._identify, State.SELF_TEST: self._self_test,
            State.HOME: self._home, State.SLEW: self._slew, State.SETTLE: self._settle, State.DWELL: self._dwell,
            State.FINISH: self._finish, State.STOP: self._stop, State.FAULT: self._fault,
        }  # fmt: skip
        try:
            while self._now in actions:
                self.recorder.add_event("state", self._now.value)
                self._report()
                number = f" {len(self.spans) + 1}" if self._now in _OF_A_STEP else ""
                event = self._act(actions[self._now])
                self._tell_troubles(f"{self._now.value}{number}")
                self._now = self._after(event)
            self.recorder.add_event("state", self._now.value)
        finally:
            self._close()
        if self._failure is not None:
            raise self._failure
        return self.spans

    def _act(self, action: Callable[[], Event]) -> Event:
        """Run a state's action; what ends it early becomes an event."""
        try:
            return action()
        except StopRequestedError as stop:
            self._failure = stop
            return Event.STOP_REQUESTED
        except (DeviceError, NorthFinderError) as failure:
            self._failure = failure
            return Event.FAILURE

    def _tell_troubles(self, where: str) -> None:
        """Record what has gone wrong since the last time and been made up for: gaps, repeated requests, and such."""
        found = self._flagged | {("gap", "gyro", "samples missing"): self.recorder.n_lost}
        for name, device in (("gyro", self.gyro), ("stage", self.stage)):
            for what, n in ({} if device is None else device.troubles).items():
                found["retry" if what == REPEATED else "link", name, what] = n
        told, self._told = self._told, found
        if self._now in {State.CONNECT, State.IDENTIFY}:
            return  # a line may have been opened in the middle of a frame
        for (kind, name, what), n in found.items():
            if n > (before := told.get((kind, name, what), 0)):
                self.recorder.add_event(kind, f"{name}, {where}: {what}: {n - before}")

    def _after(self, event: Event) -> State:
        try:
            return TRANSITIONS[self._now][event]
        except KeyError:
            raise SequenceError(f"event {event.value!r} has no place in state {self._now.value!r}") from None

    # What each state does

    def _connect(self) -> Event:
        self.gyro = self.open_gyro()
        self.stage = self.open_stage()
        return Event.OK

    def _identify(self) -> Event:
        gyro, stage = self._devices()
        self.identities = {"gyro": gyro.connect(), "stage": stage.connect()}
        # First, so that a record says nothing of devices that none of its samples are from.
        self.earlier.check(self.identities, sample_rate=gyro.sample_rate, n_axes=gyro.n_axes)
        for key, value in {**self.facts, "identities": self.identities, "sample_rate": gyro.sample_rate}.items():
            self.recorder.set_meta(key, value)
        self.plan.check(stage.limits)
        self.recorder.set_meta("plan", self.plan.outline())
        n_done = len(self.spans)
        duration = SPACE_FACTOR * self.plan.remaining_dwell(n_done) + SPACE_PER_STEP * (self.plan.n_steps - n_done)
        self.recorder.require_space(duration, gyro.sample_rate, gyro.n_axes)
        return Event.OK

    def _self_test(self) -> Event:
        gyro, stage = self._devices()
        for name, self_test in (("gyro", gyro.self_test), ("stage", stage.self_test)):
            result = self_test()
            self.recorder.add_event("self-test", f"{name}: {', '.join(result.failures) or 'passed'}")
            if not result.passed:
                raise DeviceFaultError(f"the {name} failed its self-test: {', '.join(result.failures)}")
            self._check_stop()
        return Event.OK

    def _home(self) -> Event:
        gyro, stage = self._devices()
        state = self._service_stage()
        if self.recorder.resumed and state.mode is StageMode.FAULT and state.fault in HOST_SILENT:
            state = self._rearm(stage, state.fault)
        if state.mode is not StageMode.IDLE:
            stage.home()
            deadline = state.device_time + HOME_TIMEOUT
            self._serve(lambda: self._at_rest(deadline, "homing"), stream=False)
        self.recorder.begin_stream(self.identities, sample_rate=gyro.sample_rate, n_axes=gyro.n_axes)
        gyro.start()
        return Event.OK

    def _rearm(self, stage: Stage, fault: str) -> StageState:
        """Clear what the interruption itself has made the stage latch: the operator has asked to go on."""
        self.recorder.add_event("fault cleared", fault)
        stage.clear_fault()
        deadline = self.clock.now() + STOP_TIMEOUT
        while (state := self._service_stage()).mode is StageMode.FAULT and self.clock.now() < deadline:
            self.clock.wait(self.clock.now() + SERVICE_PERIOD)
        return state

    def _slew(self) -> Event:
        stage = self._devices()[1]
        state = self._service_stage()
        self._step = self.plan.next_step(self._standing(state))
        if self._step is None:
            return Event.PLAN_COMPLETE
        limits = stage.limits
        azimuth = reachable_azimuth(self._step.azimuth, state.azimuth, limits.azimuth_min, limits.azimuth_max)
        travel = max(abs(azimuth - state.azimuth), abs(self._step.elevation - state.elevation))
        duration = travel / limits.max_speed + (
            limits.max_speed / limits.max_acceleration if limits.max_acceleration else 0.0
        )
        stage.move(azimuth, self._step.elevation)
        deadline = state.device_time + 2 * duration + SLEW_MARGIN
        self._serve(lambda: self._at_rest(deadline, "the slew", in_position=True))
        return Event.OK

    def _settle(self) -> Event:
        # The block being filled when the stage came to rest still holds samples of the slew: settling starts with
        # the block after it.
        self._serve_until_index(self._next_index + 1)
        rate = self._devices()[0].sample_rate
        settled, grid = self._next_index + round(self.settle * rate), max(1, round(DWELL_GRID * rate))
        self._first = -(-settled // grid) * grid
        self._serve_until_index(self._first)
        return Event.OK

    def _dwell(self) -> Event:
        step = self._present_step()
        first = self._first
        rate = self._devices()[0].sample_rate
        stop = first + round(step.dwell * rate)
        if step.deadline is not None:
            stop = min(stop, math.floor((step.deadline - self.earlier.elapsed) * rate))
        stop = max(stop, first + 1)
        self._blocks = [] if self._newest is None or self._next_index <= first else [self._newest]
        states: list[StageState] = [self._service_stage()]

        def done() -> bool:
            if self._state is not None and self._state is not states[-1]:
                states.append(self._state)
            if states[-1].mode is not StageMode.IDLE:
                raise DeviceFaultError(f"the stage left its position during a dwell: it is {states[-1].mode.value}")
            return self._next_index >= stop

        self._serve(done, first=first, stop=stop)
        span = DwellSpan(
            step=len(self.spans),
            name=step.name,
            azimuth=step.azimuth,
            elevation=step.elevation,
            dwell=step.dwell,
            measured_azimuth=math.fsum(state.azimuth for state in states) / len(states),
            measured_elevation=math.fsum(state.elevation for state in states) / len(states),
            first_index=first,
            stop_index=stop,
            sample_rate=rate,
            stream=self.recorder.stream,
            stream_start=self._place.start,
            turn_on=self._place.turn_on,
        )
        self.spans.append(span)
        self.recorder.add_step(span)
        self.fix = self.observer.on_dwell(span, self._blocks)
        return Event.OK

    def _finish(self) -> Event:
        self._devices()[0].stop()
        return Event.OK

    def _stop(self) -> Event:
        """Bring the stage to rest on the operator's word."""
        self._rest()
        self.recorder.add_event("stopped", "on request")
        return Event.OK

    def _fault(self) -> Event:
        """Bring the stage to rest as far as it still listens."""
        self.recorder.add_event("failure", str(self._failure))
        try:
            self._rest()
        except DeviceError as error:
            self.recorder.add_event("failure", f"while stopping the stage: {error}")
        return Event.OK

    @property
    def duration(self) -> float:
        """Time of the plan that has passed, in s: from the first to the last sample, without interruptions."""
        return self.earlier.elapsed + self._next_index / self._devices()[0].sample_rate

    # What they share

    def _devices(self) -> tuple[Gyro, Stage]:
        if self.gyro is None or self.stage is None:
            raise SequenceError(f"state {self._now.value!r} came before the devices were opened")
        return self.gyro, self.stage

    def _standing(self, state: StageState) -> Standing:
        return Standing(
            done=tuple(self.spans),
            fix=self.fix,
            elapsed=self.duration,
            azimuth=state.azimuth,
            elevation=state.elevation,
        )

    def _present_step(self) -> Step:
        if self._step is None:
            raise SequenceError(f"state {self._now.value!r} came before a step was chosen")
        return self._step

    def _rest(self) -> None:
        if self.stage is None or self._state is None:
            return  # never moved
        self.stage.stop()
        deadline = self.clock.now() + STOP_TIMEOUT
        while self._service_stage().mode in {StageMode.MOVING, StageMode.HOMING, StageMode.STOPPING}:
            if self.clock.now() >= deadline:
                raise DeviceTimeoutError(f"the stage has not come to rest within {STOP_TIMEOUT:g} s of a stop")
            self.clock.wait(min(deadline, self.clock.now() + SERVICE_PERIOD))

    def _close(self) -> None:
        for device in (self.stage, self.gyro):
            if device is not None:
                device.close()

    def _check_stop(self) -> None:
        if self.stop_requested():
            raise StopRequestedError("stopped on request: the stage is at rest and the record is closed")

    def _service_stage(self) -> StageState:
        state = self._devices()[1].state()
        if state is not self._state:
            self._state = state
            self.recorder.add_state(state)
        return state

    def _serve(self, done: Callable[[], bool], *, stream: bool = True, first: int | None = None, stop: int = 0) -> None:
        """Serve both devices until `done`; keep the blocks of samples ``first`` to ``stop`` for the dwell."""
        gyro = self._devices()[0]
        while True:
            self._check_stop()
            before = self._state
            state = self._service_stage()
            if state.mode is StageMode.FAULT:
                raise DeviceFaultError(f"the stage reports {state.fault}; it stays stopped until the fault is cleared")
            arrived = gyro.read()  # before the stream, too: what a gyro sends unasked must not fill its line
            blocks = [part for block in arrived for part in parts(block, gyro.sample_rate)] if stream else []
            if blocks and not self._next_index:
                self._place = self._placed(blocks[0])
            for block in blocks:
                self.recorder.add_block(block)
                if block.status:
                    self._note_flags(block.status)
                self._newest = block
                self._next_index = block.first_index + len(block.counts)
                if first is not None and block.first_index < stop and self._next_index > first:
                    self._blocks.append(block)
            if blocks:
                self._report(blocks[-1], first=first, stop=stop)
            if done():
                return
            if not blocks and state is before:  # else look again first: the devices wait for word of what has come
                self.clock.wait(self.clock.now() + SERVICE_PERIOD)

    def _note_flags(self, status: GyroStatus) -> None:
        for flag in status:
            key = ("status", "gyro", f"blocks flagged {str(flag.name).lower().replace('_', ' ')}")
            self._flagged[key] = self._flagged.get(key, 0) + 1

    def _placed(self, block: RateBlock) -> StreamPlace:
        """Return where the stream that begins with `block` lies after what was done before."""
        sample_rate, utc = self._devices()[0].sample_rate, self.recorder.now()
        return self.earlier.place(block, self.identities["gyro"], sample_rate=sample_rate, utc=utc)

    def _serve_until_index(self, index: int) -> None:
        self._serve(lambda: self._next_index >= index)

    def _at_rest(self, deadline: float, doing: str, *, in_position: bool = False) -> bool:
        state = self._state
        if state is None:
            return False
        if state.mode is StageMode.IDLE and (state.in_position or not in_position):
            return True
        if state.device_time > deadline:
            raise DeviceTimeoutError(f"{doing} has not ended in time: the stage is {state.mode.value}")
        return False

    def _report(self, block: RateBlock | None = None, *, first: int | None = None, stop: int = 0) -> None:
        fraction = 0.0 if first is None else min(1.0, (self._next_index - first) / (stop - first))
        step = self._step
        to_come = self.plan.remaining_dwell(len(self.spans))
        if step is not None:
            to_come -= fraction * step.dwell
        self.observer.on_progress(
            Progress(
                state=self._now,
                n_done=len(self.spans),
                n_steps=self.plan.n_steps,
                step=step,
                step_fraction=fraction,
                remaining=max(0.0, to_come),
                rate=None if block is None else float(block.counts[:, 0].mean()) * block.rate_lsb,
                stage=self._state,
                n_samples=self.recorder.n_samples,
                n_lost=self.recorder.n_lost,
                record_delay=self.recorder.delay,
            )
        )
