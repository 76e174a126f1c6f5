"""The doctor finds each planted fault and names it, finds a good bench good, and moves nothing unasked."""

from __future__ import annotations

import json
import math
import os
import re
import select
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any
from uuid import uuid4

import can
import msgspec
import numpy as np
import pytest
from virtual import VirtualBench, assume

from drivers.api import (
    BusCounts,
    DeviceIdentity,
    GyroStatus,
    RateBlock,
    StageLimits,
    StageMode,
    StageState,
)
from drivers.discovery import Identification
from drivers.transport.can_address import parse_bus_address
from drivers.transport.can_bus import open_bus
from drivers.transport.clock import SystemClock
from northfinder.adaptive import Wishes
from northfinder.diagnosis import judged
from northfinder.doctor import (
    Finding,
    Stream,
    Verdict,
    check_bus,
    check_noise,
    check_rate,
    check_stage,
    check_stream,
    check_tilt,
    explain_link,
)
from northfinder.estimation import NoiseModel
from northfinder.examination import Examination
from northfinder.sequencer import StopRequestedError
from northfinder.units import DPH
from sim_device.bench import SimBench
from sim_device.plant.profile import NoiseProfile, Profile, load_profile

DURATION = 30.0
LIMITS = StageLimits(azimuth_min=-6.0, azimuth_max=6.0, elevation_min=-1.6, elevation_max=1.6, max_speed=0.2)


def bench_of(*faults: str, profile: str | Profile = "tvg43", tilt: tuple[float, float] = (0.0, 0.0)) -> VirtualBench:
    """Return an emulated bench with planted faults."""
    return VirtualBench(SimBench(profile, seed=3, azimuth=1.0, latitude=0.9, tilt=tilt), faults)


def with_gyro(**changes: Any) -> Profile:  # noqa: ANN401  # fields of a profile
    """Return the emulated profile with another gyro."""
    profile = load_profile("tvg43")
    return msgspec.structs.replace(profile, gyro=msgspec.structs.replace(profile.gyro, **changes))


def examined(
    bench: VirtualBench, *, move: bool = False, wanted: float | None = None, stage: bool = True, profile: str = "tvg43"
) -> dict[str, Finding]:
    """Return what the doctor says of a bench, by the name of the check; a failure before anything that has passed."""
    examination = Examination(
        open_gyro=bench.open_gyro, open_stage=bench.open_stage if stage else None, clock=bench.clock
    )
    examination.run(duration=DURATION, move=move)
    judgement = judged(examination, assume(profile), Wishes(time=300.0), wanted=wanted, settle=0.5)
    found: dict[str, Finding] = {}
    for finding in [*examination.findings, *judgement]:
        if finding.name not in found or finding.verdict is Verdict.FAILED:
            found[finding.name] = finding
    return found


def failures(found: dict[str, Finding]) -> set[str]:
    """Return the names of the checks that have failed."""
    return {name for name, finding in found.items() if finding.verdict is Verdict.FAILED}


def test_a_good_bench_is_found_good() -> None:
    """Every check passes; the stage is not moved, nor homed, unless it is allowed."""
    bench = bench_of()
    before = [axis.true_angle(0) for axis in bench.bench.plant_stage.axes]
    found = examined(bench)
    assert failures(found) == set()
    assert {name for name, each in found.items() if each.verdict is Verdict.SKIPPED} == {"move"}
    assert {"gyro", "gyro self-test", "stage", "stage self-test", "samples", "sample rate", "noise", "tilt"} <= set(
        found
    )
    assert "will give the azimuth to" in found["accuracy"].sentence
    assert [axis.true_angle(bench.bench.now_us) for axis in bench.bench.plant_stage.axes] == before


def test_small_moves_are_made_when_allowed() -> None:
    """Homed, aside by 5 deg and back, and so it says."""
    bench = bench_of()
    found = examined(bench, move=True)
    assert failures(found) == set()
    assert found["move"].sentence == "both axes went 5 deg aside and came back to their places"
    assert abs(bench.bench.plant_stage.azimuth.true_angle(bench.bench.now_us)) < 1e-3


NOISY = NoiseProfile(angle_random_walk_deg_per_sqrt_h=0.2)
PLANTED: dict[str, tuple[Callable[[], VirtualBench], dict[str, str]]] = {
    "lost samples": (lambda: bench_of("gyro:drop=2e-4"), {"samples": "were lost in .* gaps, .* is the cable good"}),
    "gyro unplugged": (lambda: bench_of("gyro:unplug@12"), {"stream": "unplugged"}),
    "gyro silent": (lambda: bench_of("gyro:freeze@12"), {"stream": "silent|no samples|nothing"}),
    "sensor fault": (lambda: bench_of("gyro:sensor-fault@12"), {"status": "own supervision says that it is faulty"}),
    "saturated": (lambda: bench_of(profile=with_gyro(range_dph=300.0)), {"range": "axis x is saturated in .* blocks"}),
    "tilted": (lambda: bench_of(tilt=(0.03, -0.01)), {"tilt": "leans by 1.719 and -0.573 deg .*: level it"}),
    "noisy": (lambda: bench_of(profile=with_gyro(noise=NOISY)), {"noise": "noisier than its profile"}),
    "quiet": (
        lambda: bench_of(profile=with_gyro(noise=NoiseProfile(angle_white_noise_dph_s=0.01))),
        {"noise": "another gyro's profile"},
    ),
    "emergency stop": (lambda: bench_of("stage:e-stop@12"), {"stage": "the stage reports E_STOP: find the reason"}),
    "stage unplugged": (lambda: bench_of("stage:unplug@12"), {"stream": "unplugged"}),
    "gyro absent": (lambda: bench_of("gyro:freeze@0"), {"gyro": "nothing answered on virtual gyro"}),
    "stage absent": (lambda: bench_of("stage:freeze@0"), {"stage": "nothing answered on virtual stage"}),
}  # fmt: skip


@pytest.mark.parametrize("name", PLANTED)
def test_each_planted_fault_is_named(name: str) -> None:
    """The check that is there for it fails, with words for it."""
    make, expected = PLANTED[name]
    found = examined(make())
    assert set(expected) <= failures(found)
    for check, sentence in expected.items():
        assert re.search(sentence, found[check].sentence), found[check].sentence


def test_a_failed_self_test_is_told() -> None:
    """By the names of the failed tests."""
    bench = bench_of()
    bench.bench.gyro_board.self_test_failures = 1
    found = examined(bench)
    assert "gyro self-test" in failures(found)
    assert found["gyro self-test"].sentence.startswith("the gyro failed its self-test: ")


@pytest.mark.parametrize("fault", ["stall=azimuth", "runaway=elevation", "encoder-freeze=azimuth", "e-stop"])
def test_a_stage_that_cannot_move_is_found_by_moving(fault: str) -> None:
    """At rest nothing shows; the small move ends in the fault's name, and the stage is stopped."""
    bench = bench_of(f"stage:{fault}@{DURATION + 12}")
    found = examined(bench, move=True)
    assert "move" in failures(found)
    assert any(word in found["move"].sentence for word in ("ended in", "has not ended", "refuse"))


def test_too_noisy_for_what_is_asked() -> None:
    """The planner's own prediction is held against the standard deviation that is wanted."""
    found = examined(bench_of(), wanted=math.radians(0.01))
    assert failures(found) == {"accuracy"}
    assert "asked are 0.01: take more time, or a quieter gyro" in found["accuracy"].sentence
    assert failures(examined(bench_of(), wanted=math.radians(1.0))) == set()


def test_a_stop_ends_it_at_once() -> None:
    """The operator's Ctrl-C is no finding."""
    bench = bench_of()
    examination = Examination(
        open_gyro=bench.open_gyro, open_stage=None, clock=bench.clock, stop_requested=lambda: True
    )
    with pytest.raises(StopRequestedError):
        examination.run(duration=10.0)


def stream_of(rate: float = 10.0, *, late: float = 0.0, clock_rate: float = 1.0, n_axes: int = 1) -> Stream:
    """Return a made stream of 60 s at `rate` samples/s, a living signal."""
    rng = np.random.default_rng(1)
    blocks = []
    for k in range(60):
        counts = rng.integers(-5, 6, (int(rate), n_axes)).astype(np.int32)
        at = (k + 1) / clock_rate + (late if k == 30 else 0.0)
        blocks.append(
            RateBlock(first_index=k * int(rate), device_time=float(k), arrival_time=at, counts=counts, rate_lsb=DPH)
        )
    return Stream(sample_rate=rate, n_axes=n_axes, blocks=tuple(blocks))


def only(findings: list[Finding], name: str) -> Finding:
    """Return the finding of that name."""
    return next(finding for finding in findings if finding.name == name)


@pytest.mark.parametrize(("clock_rate", "passed"), [(1.0, True), (1.003, True), (1.02, False), (0.5, False)])
def test_the_sample_rate_is_held_against_the_clock(clock_rate: float, *, passed: bool) -> None:
    """A gyro set to another rate than it says."""
    finding = only(check_stream(stream_of(clock_rate=clock_rate)), "sample rate")
    assert (finding.verdict is Verdict.PASSED) is passed
    assert ("is it set to another rate" in finding.sentence) is not passed


def test_what_is_held_back_is_told() -> None:
    """A block a second late."""
    finding = only(check_stream(stream_of(late=1.0)), "delay")
    assert finding.verdict is Verdict.FAILED
    assert "holds them back" in finding.sentence


def test_a_dead_axis_is_told() -> None:
    """One of three gives one value only."""
    stream = stream_of(n_axes=3)
    dead = [replace(block, counts=block.counts * np.array([1, 0, 1], np.int32)) for block in stream.blocks]
    finding = only(check_stream(replace(stream, blocks=tuple(dead))), "signal")
    assert finding.verdict is Verdict.FAILED
    assert finding.sentence.startswith("axis y gives one value only")


@pytest.mark.parametrize(
    ("status", "words"),
    [(GyroStatus.TEMPERATURE, "outside its operating temperature"), (GyroStatus.NOT_READY, "still starting up")],
)
def test_what_the_gyro_says_of_itself_is_told(status: GyroStatus, words: str) -> None:
    """In words."""
    stream = stream_of()
    said = tuple(replace(block, status=status) for block in stream.blocks)
    finding = only(check_stream(replace(stream, blocks=said)), "status")
    assert finding.verdict is Verdict.FAILED
    assert words in finding.sentence


def test_overruns_point_to_the_baud_rate() -> None:
    """Samples that the gyro itself could not get rid of."""
    stream = stream_of()
    lossy = (replace(stream.blocks[0], n_lost=3, status=GyroStatus.OVERRUN), *stream.blocks[1:])
    finding = only(check_stream(replace(stream, blocks=lossy)), "samples")
    assert "raise the baud rate" in finding.sentence


def test_no_samples_at_all() -> None:
    """Nothing to judge but that."""
    (finding,) = check_stream(Stream(sample_rate=10.0, n_axes=1, blocks=()))
    assert finding.verdict is Verdict.FAILED


def test_the_earth_rate_must_be_plausible() -> None:
    """A triad that feels nothing, and a gyro that is being turned."""
    still, quiet = stream_of(n_axes=3), stream_of()
    assert check_rate(still, bias_sd=1.0 * DPH).verdict is Verdict.FAILED
    assert check_rate(still, bias_sd=6.0 * DPH).verdict is Verdict.PASSED
    assert check_rate(quiet).verdict is Verdict.PASSED
    turned = tuple(replace(block, rate_lsb=1000 * DPH, counts=np.abs(block.counts) + 1) for block in quiet.blocks)
    assert "is the gyro at rest" in check_rate(replace(quiet, blocks=turned)).sentence


def test_without_a_noise_model_noise_is_not_judged() -> None:
    """No profile, no verdict; too few samples likewise."""
    model = NoiseModel(angle_random_walk=1e-6)
    assert check_noise(stream_of(), None)[0].verdict is Verdict.SKIPPED
    short = Stream(sample_rate=10.0, n_axes=1, blocks=stream_of().blocks[:2])
    assert check_noise(short, model)[0].verdict is Verdict.SKIPPED


def with_force(force: tuple[float, float, float]) -> Stream:
    """Return a stream with accelerometers."""
    stream = stream_of(n_axes=3)
    return replace(stream, blocks=tuple(replace(block, specific_force=force) for block in stream.blocks))


def test_accelerometers_must_read_gravity_and_level() -> None:
    """Their norm, then the tilt they show; of a stage not homed its attitude is not known."""
    good = check_tilt(with_force((0.0, 0.0, -9.81)), (0.3, 0.0))
    assert [finding.verdict for finding in good] == [Verdict.PASSED, Verdict.PASSED]
    wrong = check_tilt(with_force((0.0, 0.0, -1.0)), (0.0, 0.0))
    assert wrong[0].verdict is Verdict.FAILED
    assert "another unit" in wrong[0].sentence
    leaning = check_tilt(with_force((-0.5, 0.0, -9.79)), (0.0, 0.0))
    assert leaning[1].verdict is Verdict.FAILED
    assert "level it" in leaning[1].sentence
    assert check_tilt(with_force((0.0, 0.0, -9.81)), None)[1].verdict is Verdict.SKIPPED
    assert check_tilt(stream_of(), None)[0].verdict is Verdict.SKIPPED


def state(azimuth: float = 0.0, mode: StageMode = StageMode.IDLE, fault: str = "") -> StageState:
    """Return a state of a stage."""
    return StageState(device_time=0.0, arrival_time=0.0, mode=mode, azimuth=azimuth, elevation=0.0, fault=fault)


def test_a_stage_left_alone_must_stand_still() -> None:
    """One that creeps, one outside its limits, one with a fault, one that says nothing."""
    assert all(finding.verdict is Verdict.PASSED for finding in check_stage([state(), state(1e-6)], LIMITS))
    creeping = check_stage([state(), state(0.01)], LIMITS)
    assert "has moved by 0.573 deg though nobody asked" in only(creeping, "azimuth").sentence
    assert "outside its limits" in only(check_stage([state(7.0)], LIMITS), "azimuth").sentence
    (faulty,) = check_stage([state(), state(mode=StageMode.FAULT, fault="FOLLOWING_ERROR")], LIMITS)
    assert "FOLLOWING_ERROR" in faulty.sentence
    assert check_stage([], LIMITS)[0].verdict is Verdict.SKIPPED


IDENTITY = DeviceIdentity(kind="gyro", model="STIM300", serial_number="N1")


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (Identification("stim300:/dev/x", IDENTITY, baudrate=460800), "on /dev/x at 460800 bit/s, not at 921600"),
        (Identification("kvh:/dev/x", IDENTITY, baudrate=921600), "driver is kvh: write kvh:/dev/x for stim300:/dev/x"),
        (Identification("stim300:/dev/x", IDENTITY, baudrate=921600), "another program may have used the port"),
        (Identification("/dev/x", remark="/dev/x: 12 bytes came but no valid frame"), "12 bytes came but no valid"),
    ],
)  # fmt: skip
def test_why_a_port_does_not_answer(found: Identification, words: str) -> None:
    """Another baud rate, another instrument, another user, or nobody known."""
    finding = explain_link("stim300:/dev/x", found, baudrate=921600)
    assert finding.verdict is Verdict.FAILED
    assert words in finding.sentence


def test_error_frames_ask_for_the_terminating_resistors() -> None:
    """As they come over a real bus interface of python-can, within the process."""
    name = f"doctor-{uuid4()}"
    clock = SystemClock()
    link = open_bus(parse_bus_address(f"virtual:{name}@500000"), clock, accept=[])
    peer = can.Bus(interface="virtual", channel=name)
    try:
        peer.send(can.Message(arbitration_id=0x181, data=b"\0", is_extended_id=False))
        for _ in range(5):
            peer.send(can.Message(is_error_frame=True))
        deadline = clock.now() + 10.0
        while (link.counts.n_errors < 5 or not link.counts.n_frames) and clock.now() < deadline:
            clock.wait(min(deadline, clock.now() + 0.05))
        finding = check_bus(BusCounts(), link.counts)
    finally:
        link.close()
        peer.shutdown()
    assert finding.verdict is Verdict.FAILED
    assert finding.sentence.startswith("5 error frames came beside 1 good ones")
    assert "terminating resistor of 120 ohm at both ends" in finding.sentence
    assert check_bus(BusCounts(), BusCounts()).sentence.startswith("nothing is heard on the bus")
    assert check_bus(BusCounts(), BusCounts(n_frames=9)).verdict is Verdict.PASSED
    assert check_bus(BusCounts(), BusCounts(n_malformed=2)).verdict is Verdict.FAILED


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals")
def test_a_wrong_baud_rate_shows_as_bytes_that_mean_nothing() -> None:
    """On a port full of bytes: the gyro does not answer, the port is named with what came; exit code 6, and JSON."""
    master, slave = os.openpty()
    done = threading.Event()

    def babble() -> None:
        while not done.is_set():
            _, ready, _ = select.select([], [master], [], 0.05)
            if ready:
                os.write(master, bytes(range(0x80, 0xFF)))
            done.wait(0.01)

    thread = threading.Thread(target=babble)
    thread.start()
    try:
        ran = subprocess.run(
            [sys.executable, "-m", "northfinder", "doctor", "--gyro", f"native:{os.ttyname(slave)}", "--json"],
            capture_output=True, check=False, timeout=120,
        )  # fmt: skip
    finally:
        done.set()
        while select.select([master], [], [], 0.0)[0]:
            os.read(master, 4096)
        os.close(slave)
        thread.join(10.0)
        os.close(master)
    assert ran.returncode == 6, ran.stderr
    report = json.loads(ran.stdout)
    assert report["passed"] is False
    sentences = {check["name"]: check["sentence"] for check in report["checks"] if check["verdict"] == "failed"}
    assert "bytes came but no valid frame: wrong baud rate or another device?" in sentences["gyro"]
    assert "bytes came but no valid frame of any instrument known, at " in sentences["port"]
    assert "another baud rate or another device?" in sentences["port"]


def test_a_doctor_needs_a_bench() -> None:
    """Without devices there is nothing to examine: a mistake of usage."""
    ran = subprocess.run([sys.executable, "-m", "northfinder", "doctor"], capture_output=True, check=False, timeout=120)
    assert ran.returncode == 2
    assert b"name the bench that is to be checked" in ran.stderr
