"""``northfinder resume``: the rest of a measurement that was interrupted."""

from __future__ import annotations

import time
from contextlib import ExitStack
from functools import partial
from importlib.metadata import version
from pathlib import Path

import click
import msgspec

from drivers.transport.clock import SystemClock
from northfinder.cli.aside import Aside
from northfinder.cli.bench import checked_bench, stop_on_signal
from northfinder.cli.display import DisplayContext
from northfinder.cli.find import planned_gyro, stage_opener
from northfinder.cli.options import FILE
from northfinder.cli.show import print_json, print_result, require_trustworthy
from northfinder.config import Config, StageTable, read_config
from northfinder.errors import ConfigError
from northfinder.measurement import Measurement, measure
from northfinder.record import Record
from northfinder.resume import remainder_of
from northfinder.solve_file import kept_bearings


@click.command("resume")
@click.argument("file", type=FILE, metavar="RECORD")
@click.option("--gyro", "gyro_address", metavar="DRIVER:ADDRESS", help="If not where it was.")
@click.option("--stage", "stage_address", metavar="DRIVER:ADDRESS", help="If not where it was.")
@click.option("--config", "config_file", type=click.Path(path_type=Path), metavar="FILE", help="A bench as TOML.")
@click.option("--quiet", is_flag=True, help="Show no progress.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object on standard output.")
def command(
    *,
    file: Path,
    gyro_address: str | None,
    stage_address: str | None,
    config_file: Path | None,
    quiet: bool,
    as_json: bool,
) -> None:
    """Go on with the measurement of RECORD at the step in hand, with the same plan and the same devices.

    After a power cut, a program that was killed, or a cable pulled out. The same gyro and the same stage must be
    there; if the gyro was switched off meanwhile it gets a bias of its own for the rest.

    \b
      northfinder resume records/north-20260101T120000.000000Z.sqlite
      northfinder resume records/north-20260101T120000.000000Z.sqlite --gyro native:/dev/ttyUSB2 --json
    """  # noqa: D301  # \b is click's mark to keep these lines as they are
    with Record(file) as record:
        rest = remainder_of(record)
    if rest.emulated and config_file is None and not (gyro_address and stage_address):
        raise ConfigError(
            f"the devices of {file} were an emulator that ended with the command: name others with --gyro and --stage"
        )
    config = _bench(rest.config if config_file is None else read_config(config_file), gyro_address, stage_address)
    clock, plan = SystemClock(), rest.plan
    with ExitStack() as stack:
        stop_requested = stack.enter_context(stop_on_signal(clock))
        display = stack.enter_context(Aside(DisplayContext(clock, quiet=quiet)))
        measurement = Measurement(
            open_gyro=partial(planned_gyro, config.gyro, clock, rest.assumptions.calibration, plan.name),
            open_stage=stage_opener(config.stage, clock, plan.name, display.say),
            plan=plan,
            settle=rest.config.measurement.settle_s,
            assumptions=rest.assumptions,
            record=file,
            meta={"northfinder": version("northfinder"), "config": config},
            resume=True,
        )
        outcome = measure(measurement, clock=clock, utc=time.time, watcher=display, stop_requested=stop_requested)
    result = outcome.to_json() | {"plan": plan.name}
    with Record(file) as record:
        result |= kept_bearings(record, result)
    if as_json:
        print_json(result)
    else:
        print_result(result)
    require_trustworthy(result)


def _bench(config: Config, gyro_address: str | None, stage_address: str | None) -> Config:
    """Return the bench with the devices where they are now. Raises ConfigError."""
    if gyro_address is not None:
        config = msgspec.structs.replace(config, gyro=msgspec.structs.replace(config.gyro, address=gyro_address))
    if stage_address is not None:
        stage = config.stage or StageTable(address=stage_address)
        config = msgspec.structs.replace(config, stage=msgspec.structs.replace(stage, address=stage_address))
    return checked_bench(config)
