"""``northfinder devices``: which ports there are, and who answers."""

from __future__ import annotations

import click
from rich.console import Console
from rich.table import Table

from drivers.discovery import Identification, identify
from drivers.transport.clock import SystemClock
from drivers.transport.serial_port import list_ports
from northfinder.cli.show import print_json, safe


@click.command("devices")
@click.argument("ports", nargs=-1, metavar="[PORT]...")
@click.option("--json", "as_json", is_flag=True, help="One JSON array on standard output.")
def command(ports: tuple[str, ...], *, as_json: bool) -> None:
    """List the serial ports, or those named, and identify what is behind each: listens first, then asks.

    Moves nothing and changes no setting; a silent port takes some seconds, for every baud rate is tried.

    \b
      northfinder devices
      northfinder devices /dev/ttyUSB0 socket://127.0.0.1:4001
    """  # noqa: D301  # \b is click's mark to keep these lines as they are
    clock = SystemClock()
    found = [identify(port, clock) for port in ports or [port.address for port in list_ports()]]
    if as_json:
        print_json(found)
    elif not found:
        click.echo("no serial ports found; name one, as in: northfinder devices /dev/ttyUSB0")
    else:
        Console().print(_table(found))


def _table(found: list[Identification]) -> Table:
    table = Table("address", "baud rate", "kind", "model", "serial number", "remark")
    for each in found:
        identity = each.identity
        who = ("", "", "") if identity is None else (identity.kind, identity.model, identity.serial_number)
        baudrate = "" if each.baudrate is None else str(each.baudrate)
        table.add_row(*(safe(cell) for cell in (each.address, baudrate, *who, each.remark)))
    return table
