"""``northfinder find``: the main job, from two devices to a fix and a record."""

from __future__ import annotations

import math
import secrets
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, date, datetime
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import click
import msgspec
from click.core import ParameterSource

from drivers.api import Clock, Gyro, Stage
from drivers.fixed_mount import FixedMount
from drivers.transport.clock import SystemClock
from northfinder.adaptive import Wishes, make_plan
from northfinder.calibration import Calibration, checked, read_calibration
from northfinder.cli.aside import Aside
from northfinder.cli.bench import gyro_of, named_bench, stage_of, stop_on_signal
from northfinder.cli.display import DisplayContext, SilentDisplay
from northfinder.cli.emulator import EmulatorProcess, SimulationOptions
from northfinder.cli.operator import TerminalOperator
from northfinder.cli.options import estimation_options, position_options
from northfinder.cli.show import print_json, print_result, require_trustworthy
from northfinder.config import Config, GyroTable, MeasurementTable, StageTable
from northfinder.errors import ConfigError
from northfinder.geodesy import Place, bearings_json
from northfinder.layouts import PLANS
from northfinder.measurement import Measurement, measure
from northfinder.solution import Assumptions, Method
from northfinder.triad_plans import TRIAD_PLANS, fit_for
from northfinder.turns import BLOCK_PAUSE, Turns

#: When the command was given, as near as can be told.
STARTED = time.monotonic()
#: Options that say what is emulated, and how.
EMULATED = {"sim_azimuth", "sim_latitude", "sim_gyro", "sim_stage", "sim_profile", "seed", "speed", "bus"}
EMULATED_SILENCE = 5.0  #: s without a heartbeat, for which an emulated node is waited


@click.command("find")
@click.option("--gyro", "gyro_address", metavar="DRIVER:ADDRESS", help="Such as native:/dev/ttyUSB0.")
@click.option("--stage", "stage_address", metavar="DRIVER:ADDRESS", help="Such as native:/dev/ttyUSB1.")
@click.option("--config", "config_file", type=click.Path(path_type=Path), metavar="FILE", help="A bench as TOML.")
@click.option(
    "--plan",
    metavar="NAME|FILE",
    help="refined (default with a profile), double, drift-balanced, four-position, six-position, or a TOML file; "
    "of a triad without a stage: static, two-position.",
)
@click.option(
    "--time", "time_s", type=click.FloatRange(min=10, max=3600), metavar="S", help="From the first slew to the end."
)
@click.option(
    "--until-sd",
    "until_sd_deg",
    type=click.FloatRange(min=0, min_open=True),
    metavar="DEG",
    help="Stop once the azimuth is this sure; after --time, or half an hour, in any case.",
)
@click.option("--azimuth", "azimuth_deg", type=float, metavar="DEG", help="Roughly known azimuth, for the plan double.")
@click.option("--dwell", "dwell_s", type=click.FloatRange(min=1), metavar="S", help="Dwell of six or four positions.")
@click.option(
    "--turn-sd", "turn_sd_deg", type=click.FloatRange(min=0), default=0.5, show_default=True, metavar="DEG",
    help="Standard deviation of a turn by hand.",
)  # fmt: skip
@click.option(
    "--repeat", type=click.IntRange(min=1), default=1, metavar="N", help="Measure N times, and compare the fixes."
)
@click.option("--out", type=click.Path(path_type=Path), default=Path("records"), show_default=True, metavar="DIR")
@click.option("--quiet", is_flag=True, help="Show no progress.")
@click.option("--sim-azimuth", type=float, default=33.0, show_default=True, metavar="DEG", help="The emulator's truth.")
@click.option("--sim-latitude", type=click.FloatRange(-90, 90), default=50.429, show_default=True, metavar="DEG")
@click.option("--sim-gyro", default="native", show_default=True, metavar="KIND", help="Which gyro is emulated.")
@click.option("--sim-stage", default="native", show_default=True, metavar="KIND", help="Which stage is emulated.")
@click.option("--sim-profile", metavar="NAME|FILE", help="The emulated gyro's errors and noise; its kind's own else.")
@click.option("--seed", type=click.IntRange(min=0), help="Of the emulated noise; random if not given.")
@click.option("--speed", default="1", show_default=True, metavar="X|max", help="Emulator's speed over real time.")
@click.option("--bus", type=click.Choice(["socketcand", "slcan"]), help="Emulate a CAN bus instead of serial lines.")
@position_options
@estimation_options
def command(**given: Any) -> None:  # noqa: ANN401  # click's keywords, those of Options
    """Measure the true azimuth of the input axis at stage azimuth zero, and the latitude.

    Without devices an emulated bench is started for the run.

    \b
      northfinder find --speed max
      northfinder find --gyro native:/dev/ttyUSB0 --stage native:/dev/ttyUSB1 --latitude 50.429
      northfinder find --config bench.toml --json
    """  # noqa: D301  # \b is click's mark to keep these lines as they are
    options = Options(**given)
    # Whatever can be wrong with the command is found before an emulator is started or a port is opened.
    bench = options.bench()
    truth = None if bench else options.truth()
    config = bench or options.emulated_bench()
    assumptions = options.assumptions(config)
    place = options.place(config.measurement)
    wishes = options.wishes(config.measurement)
    settle = config.measurement.settle_s
    plan = make_plan(wishes, assumptions, settle=settle, quickest=_quickest_turns(config.stage, truth, settle))
    _check_stage(config, plan.name)
    clock = SystemClock()
    with ExitStack() as stack:
        if truth is not None:
            config = _emulated(config, stack.enter_context(EmulatorProcess(truth)))
        stop_requested = stack.enter_context(stop_on_signal(clock))
        shown = DisplayContext(clock, quiet=options.quiet, step_names=plan.step_names, time=plan.time)
        display = stack.enter_context(Aside(shown))
        watcher = SilentDisplay() if options.quiet else display  # what shows nothing need not run aside
        results: list[dict[str, Any]] = []
        for _ in range(options.repeat):
            if stop_requested():
                break
            begun = time.monotonic() if results else STARTED
            measurement = Measurement(
                open_gyro=partial(planned_gyro, config.gyro, clock, assumptions.calibration, plan.name),
                open_stage=stage_opener(config.stage, clock, plan.name, display.say),
                plan=plan,
                settle=config.measurement.settle_s,
                assumptions=assumptions,
                record=_record_path(options.out),
                meta={
                    "northfinder": version("northfinder"),
                    "config": config,
                    "simulation": truth,
                    "wishes": wishes,
                    "place": None if place is None else place.to_json(),
                },
            )
            outcome = measure(measurement, clock=clock, utc=time.time, watcher=watcher, stop_requested=stop_requested)
            result = outcome.to_json() | {"plan": plan.name}
            result |= {} if place is None else bearings_json(place, result, _today())
            results.append(result | {"wall_s": round(time.monotonic() - begun, 3)})
    _show(results, None if truth is None else (truth.azimuth_deg, truth.latitude_deg), as_json=options.as_json)
    for result in results:
        require_trustworthy(result)


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """What the command line says, in the units of its options."""

    gyro_address: str | None
    stage_address: str | None
    config_file: Path | None
    plan: str | None
    time_s: float | None
    until_sd_deg: float | None
    azimuth_deg: float | None
    dwell_s: float | None
    turn_sd_deg: float
    repeat: int
    out: Path
    quiet: bool
    sim_azimuth: float
    sim_latitude: float
    sim_gyro: str
    sim_stage: str
    sim_profile: str | None
    seed: int | None
    speed: str
    bus: str | None
    position: str | None
    epsg: int | None
    latitude_deg: float | None
    latitude_sd_deg: float
    calibration_file: Path | None
    profile: str | None
    g_drift_dph: float | None
    method: Method
    as_json: bool

    def bench(self) -> Config | None:
        """Return the bench that was named, None if none was. Raises ConfigError."""
        named = self.config_file or self.gyro_address or self.stage_address
        if named and (emulated := _given_for_the_emulator()):
            verb = "is" if len(emulated) == 1 else "are"
            raise ConfigError(
                f"{', '.join(emulated)} {verb} of the emulated bench: to be left out where devices are named"
            )
        return named_bench(self.gyro_address, self.stage_address, self.config_file)

    def emulated_bench(self) -> Config:
        """Return the bench to emulate, without addresses yet; at rest there is no stage on it."""
        stage = None if self.plan == "static" else StageTable(address="")
        return Config(gyro=GyroTable(address="", profile=self._emulated_profile()), stage=stage)

    def _emulated_profile(self) -> str:
        """Return the profile asked for, else one that the plan can use, else that of the kind of gyro."""
        if self.sim_profile is None and self.sim_gyro == "native" and self.plan in TRIAD_PLANS:
            return "triad"
        return self.sim_profile or _profile_of(self.sim_gyro)

    def truth(self) -> SimulationOptions:
        """Return the world to emulate; without a seed another one each time. Raises ConfigError."""
        _check_speed(self.speed)
        return SimulationOptions(
            gyro=self.sim_gyro,
            stage=self.sim_stage,
            only="gyro" if self.plan == "static" else "",
            azimuth_deg=self.sim_azimuth,
            latitude_deg=self.sim_latitude,
            profile=self._emulated_profile(),
            seed=secrets.randbits(32) if self.seed is None else self.seed,
            speed=self.speed,
            bus=self.bus or "",
        )

    def assumptions(self, config: Config) -> Assumptions:
        """Return what is taken as known, from the options or else from the configuration. Raises ConfigError."""
        calibration = None if self.calibration_file is None else read_calibration(self.calibration_file)
        if calibration is not None:
            calibration.check(None, _today())
        return Assumptions.gather(
            profile=self.profile or config.gyro.profile,
            latitude_deg=config.measurement.latitude_deg if self.latitude_deg is None else self.latitude_deg,
            latitude_sd_deg=self.latitude_sd_deg,
            g_drift_dph=self.g_drift_dph,
            method=self.method,
            calibration=calibration,
            turn_sd_deg=self.turn_sd_deg if config.stage is None and self._plan(config) == "two-position" else 0.0,
        )

    def place(self, table: MeasurementTable) -> Place | None:
        """Return where the instrument stands, by the options or else by the configuration. Raises ConfigError."""
        return Place.of(self.position or table.position, table.epsg if self.epsg is None else self.epsg)

    def _plan(self, config: Config) -> str | None:
        return self.plan or config.measurement.plan

    def wishes(self, table: MeasurementTable) -> Wishes:
        """Return what is asked of the plan, by the options or else by the configuration."""
        time_s, dwell_s = self.time_s, self.dwell_s
        own_dwells = self.plan is not None and self.plan not in (*PLANS, *TRIAD_PLANS)
        if time_s is None and dwell_s is None and not own_dwells:  # the file's time is not for a plan that is a file
            time_s, dwell_s = table.time_s, table.dwell_s
        until_sd_deg = table.until_sd_deg if self.until_sd_deg is None else self.until_sd_deg
        azimuth_deg = table.azimuth_deg if self.azimuth_deg is None else self.azimuth_deg
        return Wishes(
            name=self.plan or table.plan,
            time=time_s,
            dwell=dwell_s,
            until_sd=None if until_sd_deg is None else math.radians(until_sd_deg),
            azimuth=None if azimuth_deg is None else math.radians(azimuth_deg),
        )


def _given_for_the_emulator() -> list[str]:
    """Return the options for the emulated bench that the command line in hand gives."""
    context = click.get_current_context()
    return [
        parameter.opts[0]
        for parameter in context.command.params
        if parameter.name in EMULATED and context.get_parameter_source(parameter.name) is ParameterSource.COMMANDLINE
    ]


def _check_speed(text: str) -> None:
    from sim_device.server import parse_speed  # noqa: PLC0415  # not needed with devices

    try:
        possible = parse_speed(text) >= 1.0
    except ValueError:
        possible = False
    if not possible:
        raise ConfigError(f"--speed: found {text!r}, expected a number of at least 1, or max")


def _profile_of(gyro: str) -> str:
    from sim_device.instruments import GYROS, instrument  # noqa: PLC0415  # not needed with devices

    try:
        return instrument(GYROS, "gyro", gyro).profile
    except ValueError as error:
        raise ConfigError(f"--sim-gyro: {error}") from None


def _show(results: list[dict[str, Any]], truth: tuple[float, float] | None, *, as_json: bool) -> None:
    """Print the only result, or the summary of a campaign."""
    if len(results) == 1:
        if as_json:
            print_json(results[0])
        else:
            print_result(results[0], truth=truth)
        return
    from northfinder.campaign import gather, read_member  # noqa: PLC0415  # only a campaign needs it
    from northfinder.campaign_report import campaign_json  # noqa: PLC0415
    from northfinder.cli.stats import print_campaign  # noqa: PLC0415

    summary = campaign_json(gather([read_member(Path(result["record"])) for result in results]))
    if as_json:
        print_json({"fixes": results, "campaign": summary})
    else:
        print_campaign(summary)


def _check_stage(config: Config, plan: str) -> None:
    """Raise ConfigError if the plan needs a stage, and there is none."""
    if config.stage is None and plan not in TRIAD_PLANS:
        raise ConfigError(
            f"the plan {plan} turns the gyro on a stage: give --stage, or [stage] in the bench's file; "
            f"without one a triad has the plans {' and '.join(TRIAD_PLANS)}"
        )


def _quickest_turns(stage: StageTable | None, truth: SimulationOptions | None, settle: float) -> Turns:
    """Return the turns of the stage as far as they are known before it is asked: it will be no quicker."""
    if truth is None:
        return Turns(pause=settle + BLOCK_PAUSE) if stage is None else Turns.of_stage(stage.limits(), settle)
    from sim_device.plant.profile import load_profile  # noqa: PLC0415  # not needed with devices

    try:
        emulated = load_profile(truth.profile).stage
    except ValueError as error:
        raise ConfigError(f"--sim-profile: {error}") from None
    return Turns(
        speed=math.radians(emulated.max_speed_deg_per_s),
        acceleration=math.radians(emulated.max_acceleration_deg_per_s2),
        pause=settle + BLOCK_PAUSE,
    )


def planned_gyro(table: GyroTable, clock: Clock, calibration: Calibration | None, plan: str) -> Gyro:
    """Open the gyro; connecting it checks that it has the axes for the plan, and that the calibration is its own."""
    return fit_for(checked(gyro_of(table, clock), calibration, _today()), plan)


def stage_opener(table: StageTable | None, clock: Clock, plan: str, say: Callable[[str], None]) -> Callable[[], Stage]:
    """Return what opens the stage, or what stands for it; raises ConfigError if that takes a terminal."""
    if table is not None:
        return partial(stage_of, table, clock)
    operator = TerminalOperator(clock, say) if plan == "two-position" else None
    return lambda: FixedMount(clock, operator)


def _today() -> date:
    return datetime.now(UTC).date()


def _emulated(config: Config, emulator: EmulatorProcess) -> Config:
    """Return the configuration with the emulator's addresses."""
    addresses = emulator.announcement()
    config = msgspec.structs.replace(
        config,
        gyro=msgspec.structs.replace(config.gyro, address=addresses["gyro"]),
        stage=None if config.stage is None else msgspec.structs.replace(config.stage, address=addresses["stage"]),
    )
    return _patient(config) if addresses["gyro"].startswith("canopen-gyro:") else config


def _patient(config: Config) -> Config:
    """Return the configuration such that an emulated node, which may wait for a busy machine, is not taken for dead."""
    options = config.gyro.options | {"max_silence": EMULATED_SILENCE}
    gyro = msgspec.structs.replace(config.gyro, options=options)
    stage = None if config.stage is None else msgspec.structs.replace(config.stage, options=options)
    return msgspec.structs.replace(config, gyro=gyro, stage=stage)


def _record_path(folder: Path) -> Path:
    """Return a new name in `folder`, by date and time."""
    return folder / f"north-{datetime.now(UTC):%Y%m%dT%H%M%S.%f}Z.sqlite"
