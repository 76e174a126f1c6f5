"""Devices by name: ``DRIVER:ADDRESS``, for example ``native:/dev/ttyUSB0``.

Drivers are found through the entry points ``northfinder.gyros`` and ``northfinder.stages``, so other packages can bring
their own: a function ``(address, clock, **options)`` that returns a `drivers.api.Gyro` or `drivers.api.Stage`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import entry_points
from inspect import Parameter, signature
from typing import Any

from drivers.api import Clock, DeviceIdentity, Gyro, Stage
from drivers.errors import DeviceError
from drivers.native import identify as identify_native

GYROS = "northfinder.gyros"
STAGES = "northfinder.stages"
_EXAMPLE = "native:/dev/ttyUSB0"


@dataclass(frozen=True, slots=True)
class Identification:
    """Who is behind a port: an identity, or else what was heard instead."""

    address: str  #: DRIVER:ADDRESS
    identity: DeviceIdentity | None = None
    remark: str = ""


def open_gyro(device: str, clock: Clock, **options: Any) -> Gyro:  # noqa: ANN401  # each driver has its own
    """Open the gyro ``DRIVER:ADDRESS``.

    Raises
    ------
    ValueError
        If there is no such driver, or `device` names none.
    LinkError
        If the port cannot be opened.
    """
    gyro: Gyro = _open(GYROS, "gyro", device, clock, options)
    return gyro


def open_stage(device: str, clock: Clock, **options: Any) -> Stage:  # noqa: ANN401  # each driver has its own
    """Open the stage ``DRIVER:ADDRESS``.

    Raises
    ------
    ValueError
        If there is no such driver, or `device` names none.
    LinkError
        If the port cannot be opened.
    """
    stage: Stage = _open(STAGES, "stage", device, clock, options)
    return stage


def identify(port: str, clock: Clock) -> Identification:
    """Ask who is behind a port, without opening it for use. Moves nothing; a moving stage comes to rest."""
    address = f"native:{port}"
    try:
        return Identification(address, identify_native(port, clock))
    except DeviceError as error:
        return Identification(address, remark=str(error))


def _open(group: str, kind: str, device: str, clock: Clock, options: dict[str, Any]) -> Any:  # noqa: ANN401  # a driver's
    driver, colon, address = device.partition(":")
    known = {entry.name: entry for entry in entry_points(group=group)}
    if not (driver and colon and address):
        raise ValueError(f"{device!r} names no {kind}: write DRIVER:ADDRESS, for example {_EXAMPLE}")
    if driver not in known:
        raise ValueError(
            f"there is no {kind} driver {driver!r} in {device!r}; known are {', '.join(sorted(known))}: "
            f"write DRIVER:ADDRESS, for example {_EXAMPLE}"
        )
    factory: Callable[..., Any] = known[driver].load()
    _check_options(driver, factory, options)
    return factory(address, clock, **options)


def _check_options(driver: str, factory: Callable[..., Any], options: dict[str, Any]) -> None:
    """Raise ValueError for an option that the driver does not take."""
    parameters = list(signature(factory).parameters.values())[2:]  # after address and clock
    if any(parameter.kind is Parameter.VAR_KEYWORD for parameter in parameters):
        return
    taken = {parameter.name for parameter in parameters}
    unknown = sorted(options.keys() - taken)
    if unknown:
        raise ValueError(f"the driver {driver!r} takes no option {unknown[0]!r}; it takes {', '.join(sorted(taken))}")
