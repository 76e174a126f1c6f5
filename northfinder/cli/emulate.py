"""``northfinder emulate``: the emulated bench for other programs."""

from __future__ import annotations

import click

from northfinder.errors import ConfigError
from sim_device.can_bench import BITRATE
from sim_device.can_server import BUSES
from sim_device.instruments import GYROS, STAGES
from sim_device.server import ServeOptions, parse_speed, serve


@click.command("emulate")
@click.option(
    "--profile",
    default="",
    metavar="NAME|FILE",
    help="Errors and noise of gyro and stage; the gyro's own if not given.",
)
@click.option("--gyro", type=click.Choice(sorted(GYROS)), default="native", show_default=True, help="Which instrument.")
@click.option("--stage", type=click.Choice(sorted(STAGES)), default="native", show_default=True, help="Likewise.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of everything random.")
@click.option(
    "--azimuth",
    "azimuth_deg",
    type=float,
    default=33.0,
    show_default=True,
    metavar="DEG",
    help="True azimuth of the input axis at stage azimuth zero.",
)
@click.option(
    "--latitude",
    "latitude_deg",
    type=click.FloatRange(-90, 90),
    default=50.429,
    show_default=True,
    metavar="DEG",
)
@click.option(
    "--tilt",
    "tilt_arcsec",
    type=float,
    nargs=2,
    default=(0.0, 0.0),
    show_default=True,
    metavar="X Y",
    help="How far the rotation axis leans toward stage azimuth 0 and 90, in arcsec.",
)
@click.option("--speed", default="1", show_default=True, metavar="X|max", help="Times real time.")
@click.option(
    "--tcp",
    is_flag=False,
    flag_value="127.0.0.1",
    default="",
    metavar="[HOST]",
    help="Serve TCP instead of pseudo-terminals, on the loopback interface unless HOST says otherwise.",
)
@click.option("--bus", type=click.Choice(BUSES), help="Serve a CAN bus instead of serial lines.")
@click.option("--bitrate", type=int, default=BITRATE, show_default=True, help="Of the CAN bus, bit/s.")
@click.option("--fault", "faults", multiple=True, metavar="FAULT", help="As stage:e-stop@30; may be repeated.")
def command(
    *,
    profile: str,
    gyro: str,
    stage: str,
    seed: int,
    azimuth_deg: float,
    latitude_deg: float,
    tilt_arcsec: tuple[float, float],
    speed: str,
    tcp: str,
    bus: str | None,
    bitrate: int,
    faults: tuple[str, ...],
) -> None:
    """Serve an emulated gyro and stage until interrupted, and print their addresses as one line of JSON.

    \b
      northfinder emulate
      northfinder emulate --gyro stim300 --stage zaber
      northfinder emulate --bus socketcand --speed max
      northfinder emulate --tcp --speed 10 --fault gyro:drop=1e-5 --fault stage:e-stop@120
    """  # noqa: D301  # \b is click's mark to keep these lines as they are
    try:
        serve(
            ServeOptions(
                profile=profile,
                gyro=gyro,
                stage=stage,
                seed=seed,
                azimuth_deg=azimuth_deg,
                latitude_deg=latitude_deg,
                tilt_arcsec=tilt_arcsec,
                speed=parse_speed(speed),
                tcp=tcp,
                bus=bus or "",
                bitrate=bitrate,
                faults=faults,
            )
        )
    except (ValueError, OSError) as error:
        raise ConfigError(str(error)) from None
