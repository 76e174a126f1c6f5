"""Devices by name: ``DRIVER:ADDRESS``, for example ``native:/dev/ttyUSB0``.

Drivers are found through the entry points ``northfinder.gyros`` and ``northfinder.stages``, so other packages can bring
their own: a function ``(address, clock, **options)`` that returns a `drivers.api.Gyro` or `drivers.api.Stage`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from inspect import Parameter, signature
from typing import Any

from drivers.api import ByteLink, Clock, DeviceIdentity, Gyro, Stage
from drivers.errors import DeviceError
from drivers.recognition import GROUP as RECOGNISERS
from drivers.recognition import Recogniser
from drivers.transport.serial_port import open_link

GYROS = "northfinder.gyros"
STAGES = "northfinder.stages"
#: How long a port is listened to at each baud rate, and after each question, in s.
LISTEN = 0.3
MAX_HEARD = 100_000  #: bytes
_EXAMPLE = "native:/dev/ttyUSB0"


@dataclass(frozen=True, slots=True)
class Identification:
    """Who is behind a port: an identity, or else what was heard instead."""

    address: str  #: DRIVER:ADDRESS, the port alone where nothing was recognised
    identity: DeviceIdentity | None = None
    remark: str = ""
    baudrate: int | None = None  #: at which it was recognised


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


def check_gyro(device: str, **options: Any) -> None:  # noqa: ANN401  # each driver has its own
    """Raise ValueError where `open_gyro` would for the same reasons; nothing is opened."""
    _found(GYROS, "gyro", device, options)


def check_stage(device: str, **options: Any) -> None:  # noqa: ANN401  # each driver has its own
    """Raise ValueError where `open_stage` would for the same reasons; nothing is opened."""
    _found(STAGES, "stage", device, options)


def recognisers() -> list[Recogniser]:
    """Return what every driver knows of its device's bytes, by the drivers' names."""
    return [entry.load() for entry in sorted(entry_points(group=RECOGNISERS), key=lambda entry: entry.name)]


def identify(port: str, clock: Clock, *, known: Sequence[Recogniser] | None = None) -> Identification:
    """Find out who is behind a port, without opening it for use: listen first, then ask.

    Nothing is moved and no setting changed; a moving native stage comes to rest. Takes some seconds where nothing
    answers: each baud rate of each instrument is tried.
    """
    known = recognisers() if known is None else known
    heard: dict[int, int] = {}
    try:
        for asking in (False, True):
            for baudrate in _baudrates(port, known, asking=asking):
                here = [each for each in known if baudrate in each.baudrates or _is_socket(port)]
                found, n_bytes = _heard(port, clock, here, baudrate, asking=asking)
                if found is not None:
                    return found
                heard[baudrate] = max(heard.get(baudrate, 0), n_bytes)
    except DeviceError as error:
        return Identification(port, remark=str(error))
    return Identification(port, remark=_nothing_known(port, heard))


def _baudrates(port: str, known: Sequence[Recogniser], *, asking: bool) -> list[int]:
    """Return the baud rates to try, the usual ones first; a socket has but one."""
    usual = sorted({each.baudrates[0] for each in known if each.question or not asking}, reverse=True)
    others = sorted({rate for each in known if each.question or not asking for rate in each.baudrates}, reverse=True)
    return list(dict.fromkeys([*usual, *others]))[: 1 if _is_socket(port) else None]


def _is_socket(port: str) -> bool:
    return port.startswith("socket://")


def _heard(
    port: str, clock: Clock, known: Sequence[Recogniser], baudrate: int, *, asking: bool
) -> tuple[Identification | None, int]:
    """Return who was recognised on the port at one baud rate, and how many bytes came."""
    link = open_link(port, clock, baudrate=baudrate)
    try:
        total = 0
        # Text first: its ends of lines mean nothing to the others, and a native HELLO is made to mean nothing to it.
        for question in sorted({each.question for each in known if each.question}, reverse=True) if asking else [b""]:
            if question:
                link.write(question)
            identification, n_bytes = _listen(link, clock, known, baudrate)
            total += n_bytes
            if identification is not None:
                return identification, total
        return None, total
    finally:
        link.close()


def _listen(
    link: ByteLink, clock: Clock, known: Sequence[Recogniser], baudrate: int
) -> tuple[Identification | None, int]:
    deadline = clock.now() + LISTEN
    heard = b""
    while clock.now() < deadline and len(heard) < MAX_HEARD:
        clock.wait(deadline)
        if not (data := link.receive()):
            continue
        heard += data
        for each in known:
            identity = each.recognise(heard)
            if identity is not None:
                return Identification(f"{each.name}:{link.name}", identity, baudrate=baudrate), len(heard)
    return None, len(heard)


def _nothing_known(port: str, heard: dict[int, int]) -> str:
    most = max(heard, key=lambda baudrate: heard[baudrate], default=0)
    if not most or not heard[most]:
        return f"nothing answered on {port}: is the device powered, and is this its port?"
    tried = ", ".join(str(rate) for rate in sorted(heard))
    return (
        f"{port}: {heard[most]} bytes came but no valid frame of any instrument known, at {tried} bit/s: "
        "another baud rate or another device?"
    )


def _open(group: str, kind: str, device: str, clock: Clock, options: dict[str, Any]) -> Any:  # noqa: ANN401  # a driver's
    factory, address = _found(group, kind, device, options)
    return factory(address, clock, **options)


def _found(group: str, kind: str, device: str, options: dict[str, Any]) -> tuple[Callable[..., Any], str]:
    """Return the driver's function, which takes `options`, and what it is to open. Raises ValueError."""
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
    return factory, address


def _check_options(driver: str, factory: Callable[..., Any], options: dict[str, Any]) -> None:
    """Raise ValueError for an option that the driver does not take."""
    parameters = list(signature(factory).parameters.values())[2:]  # after address and clock
    if any(parameter.kind is Parameter.VAR_KEYWORD for parameter in parameters):
        return
    taken = {parameter.name for parameter in parameters}
    unknown = sorted(options.keys() - taken)
    if unknown:
        raise ValueError(f"the driver {driver!r} takes no option {unknown[0]!r}; it takes {', '.join(sorted(taken))}")
