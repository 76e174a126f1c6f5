"""The bench that a command line names: its devices, how they are opened, and how the operator stops them."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TypeVar

from drivers.api import Clock, Gyro, Stage
from drivers.discovery import check_gyro, check_stage, open_gyro, open_stage
from drivers.transport.clock import SystemClock
from northfinder.cli import ending_signals, interruption
from northfinder.config import Config, GyroTable, StageTable, read_config
from northfinder.errors import ConfigError

Device = TypeVar("Device", Gyro, Stage)


def named_bench(gyro_address: str | None, stage_address: str | None, config_file: Path | None) -> Config | None:
    """Return the bench that was named by file or addresses, None if none was. Raises ConfigError."""
    if config_file is not None:
        if gyro_address or stage_address:
            raise ConfigError("--config names the devices: leave --gyro and --stage out")
        return checked_bench(read_config(config_file))
    if gyro_address is None and stage_address is None:
        return None
    if gyro_address is None:
        raise ConfigError("--stage goes with --gyro, and that is missing")
    stage = None if stage_address is None else StageTable(address=stage_address)
    return checked_bench(Config(gyro=GyroTable(address=gyro_address), stage=stage))


def checked_bench(config: Config) -> Config:
    """Return the bench if there are drivers for it that take what they are told; nothing is opened. Raises ConfigError.

    So a name mistyped is found before a record is begun.
    """
    gyro, stage = config.gyro, config.stage
    try:
        check_gyro(gyro.address, **gyro.driver_options())
        if stage is not None:
            check_stage(stage.address, limits=stage.limits(), **stage.driver_options())
    except ValueError as error:
        raise ConfigError(str(error)) from None
    return config


def gyro_of(table: GyroTable, clock: Clock) -> Gyro:
    """Open the gyro of a bench. Raises ConfigError for an address that names none, LinkError."""
    return _opened(open_gyro, table.address, clock, **table.driver_options())


def stage_of(table: StageTable, clock: Clock) -> Stage:
    """Open the stage of a bench. Raises ConfigError for an address that names none, LinkError."""
    return _opened(open_stage, table.address, clock, limits=table.limits(), **table.driver_options())


def _opened(opener: Callable[..., Device], address: str, clock: Clock, **options: object) -> Device:
    """Open a device by its address; an address that names none is the operator's mistake."""
    try:
        return opener(address, clock, **options)
    except ValueError as error:
        raise ConfigError(str(error)) from None


@contextmanager
def stop_on_signal(clock: SystemClock) -> Iterator[Callable[[], bool]]:
    """Let the first Ctrl-C, termination or hang-up ask for a stop; yield the question whether one was asked for.

    One that came when there was nothing left to stop interrupts what follows: nobody may be there to read it.
    """
    requested = interruption.has_come

    def request(number: int, frame: FrameType | None) -> None:  # noqa: ARG001  # the signal module's signature
        nonlocal requested
        requested = True
        clock.notify()

    before = {number: signal.signal(number, request) for number in ending_signals()}
    try:
        yield lambda: requested
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if requested:
        signal.raise_signal(signal.SIGINT)
