"""``northfinder doctor``: what is wrong with a bench, in words."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import click
from rich.console import Console
from rich.table import Table

from drivers.api import BusCounts, Clock, FrameLink
from drivers.discovery import identify
from drivers.errors import DeviceError
from drivers.transport.can_address import parse_bus_address
from drivers.transport.can_bus import open_bus
from drivers.transport.clock import SystemClock
from northfinder import doctor
from northfinder.adaptive import Wishes
from northfinder.cli import EXIT_FINDING
from northfinder.cli.bench import gyro_of, named_bench, stage_of, stop_on_signal
from northfinder.cli.show import print_json, safe
from northfinder.config import Config, GyroTable, StageTable
from northfinder.diagnosis import judged
from northfinder.doctor import Finding, Verdict
from northfinder.errors import ConfigError
from northfinder.examination import Examination
from northfinder.solution import Assumptions

_CAN_DRIVERS = ("canopen-gyro", "cia402-stage")
_MARKS = {Verdict.PASSED: "[green]pass[/green]", Verdict.FAILED: "[red]FAIL[/red]", Verdict.SKIPPED: "skip"}


@click.command("doctor")
@click.option("--gyro", "gyro_address", metavar="DRIVER:ADDRESS", help="Such as native:/dev/ttyUSB0.")
@click.option("--stage", "stage_address", metavar="DRIVER:ADDRESS", help="Such as native:/dev/ttyUSB1.")
@click.option("--config", "config_file", type=click.Path(path_type=Path), metavar="FILE", help="A bench as TOML.")
@click.option(
    "--time", "time_s", type=click.FloatRange(min=5, max=3600), default=60.0, show_default=True, metavar="S",
    help="How long to listen to the gyro at rest.",
)  # fmt: skip
@click.option("--move", is_flag=True, help="Allow homing and small moves of the stage; else nothing is moved.")
@click.option("--profile", metavar="NAME|FILE", help="Gyro profile: how noisy it may be.")
@click.option("--plan", metavar="NAME|FILE", help="Plan to judge the accuracy by, as for find.")
@click.option("--measure-time", "measure_s", type=click.FloatRange(min=10, max=3600), metavar="S", help="Its time.")
@click.option(
    "--until-sd", "until_sd_deg", type=click.FloatRange(min=0, min_open=True), metavar="DEG",
    help="Standard deviation of the azimuth that is wanted.",
)  # fmt: skip
@click.option("--latitude", "latitude_deg", type=click.FloatRange(-90, 90), metavar="DEG", help="Latitude, if known.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object on standard output.")
def command(
    *,
    gyro_address: str | None,
    stage_address: str | None,
    config_file: Path | None,
    time_s: float,
    move: bool,
    profile: str | None,
    plan: str | None,
    measure_s: float | None,
    until_sd_deg: float | None,
    latitude_deg: float | None,
    as_json: bool,
) -> None:
    """Check a bench: links, self-tests, samples, noise, tilt, stage, accuracy. Moves nothing unless told --move.

    Leave the gyro at rest meanwhile. The exit code is 6 if a check has failed.

    \b
      northfinder doctor --config bench.toml
      northfinder doctor --gyro stim300:/dev/ttyUSB0 --stage zaber:/dev/ttyUSB1 --profile stim300 --move
    """  # noqa: D301  # \b is click's mark to keep these lines as they are
    config = named_bench(gyro_address, stage_address, config_file)
    if config is None:
        raise ConfigError("name the bench that is to be checked: --config, or --gyro and --stage")
    table = config.measurement
    assumptions = Assumptions.gather(
        method="generalised",
        profile=profile or config.gyro.profile,
        latitude_deg=table.latitude_deg if latitude_deg is None else latitude_deg,
        g_drift_dph=None,
    )
    wanted_deg = until_sd_deg or table.until_sd_deg
    wishes = Wishes(
        name=plan or table.plan,
        time=measure_s or table.time_s,
        dwell=None if measure_s or table.time_s else table.dwell_s,
        azimuth=None if table.azimuth_deg is None else math.radians(table.azimuth_deg),
    )
    clock = SystemClock()
    with stop_on_signal(clock) as stop_requested:
        examination = Examination(
            open_gyro=partial(gyro_of, config.gyro, clock),
            open_stage=None if config.stage is None else partial(stage_of, config.stage, clock),
            clock=clock,
            stop_requested=stop_requested,
        )
        findings = _examined(examination, config, clock, duration=time_s, move=move)
    wanted = None if wanted_deg is None else math.radians(wanted_deg)
    findings += judged(examination, assumptions, wishes, wanted=wanted, settle=table.settle_s)
    _show(findings, as_json=as_json)


def _examined(examination: Examination, config: Config, clock: Clock, *, duration: float, move: bool) -> list[Finding]:
    """Run the examination; say of a bus what was heard on it, and of a device that did not answer who is there."""
    tables: dict[str, GyroTable | StageTable | None] = {"gyro": config.gyro, "stage": config.stage}
    buses = dict(_buses([table.address for table in tables.values() if table is not None], clock))
    examination.run(duration=duration, move=move)
    findings = list(examination.findings)
    for link in buses.values():
        findings.append(doctor.check_bus(BusCounts(), link.counts))
        link.close()
    for failed in [each.name for each in examination.findings if each.verdict is Verdict.FAILED]:
        table = tables.get(failed)
        driver, _, port = ("", "", "") if table is None else table.address.partition(":")
        if table is not None and driver not in _CAN_DRIVERS:
            findings.append(doctor.explain_link(table.address, identify(port, clock), baudrate=table.baudrate))
    return findings


def _buses(addresses: list[str], clock: Clock) -> Iterator[tuple[str, FrameLink]]:
    """Open each CAN bus of the bench once more, to count what is heard on it. A bus that cannot be opened is left."""
    for address in addresses:
        driver, _, where = address.partition(":")
        bus = where.rpartition("/")[0]
        if driver in _CAN_DRIVERS:
            try:
                yield bus, open_bus(parse_bus_address(bus), clock, accept=[])
            except (DeviceError, ValueError):
                continue


def _show(findings: list[Finding], *, as_json: bool) -> None:
    """Print what was found, and leave with the exit code for it."""
    failed = [each for each in findings if each.verdict is Verdict.FAILED]
    if as_json:
        print_json({"passed": not failed, "checks": findings})
    else:
        table = Table(box=None, show_header=False)
        for each in findings:
            table.add_row(_MARKS[each.verdict], each.name, safe(each.sentence))
        Console().print(table)
    if failed:
        click.get_current_context().exit(EXIT_FINDING)
