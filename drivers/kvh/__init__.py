"""KVH's fibre-optic gyros DSP-1750 and DSP-1760, and the 1750 and 1775 with accelerometers: see ``docs/kvh.md``."""

from __future__ import annotations

from drivers.api import Clock, Gyro
from drivers.kvh.gyro import KvhGyro
from drivers.kvh.settings import DATA_RATES
from drivers.transport.serial_port import DEFAULT_BAUDRATE, open_link

__all__ = ["KvhGyro", "open_gyro"]


def open_gyro(
    address: str,
    clock: Clock,
    *,
    baudrate: int = DEFAULT_BAUDRATE,
    axis: str = "",
    sample_rate: float | None = None,
    configure: bool = False,
) -> Gyro:
    """Open the port of a KVH gyro; `connect` then speaks to it.

    Parameters
    ----------
    address, clock
        As `drivers.transport.serial_port.open_link` has them.
    baudrate
        What the unit is set to.
    axis
        The one axis to use, ``x``, ``y`` or ``z``; empty for all that the unit has, one or three.
    sample_rate
        Samples a second that it must send, None for any.
    configure
        Whether it may be set to send them, a setting that it keeps.

    Raises
    ------
    LinkError
        If the port cannot be opened.
    ValueError
        If there is no such axis or sample rate.
    """
    if axis not in {"", "x", "y", "z"}:
        raise ValueError(f"the axis of a KVH gyro is x, y or z, not {axis!r}")
    if sample_rate is not None and sample_rate not in DATA_RATES:
        raise ValueError(f"a KVH gyro sends {', '.join(map(str, DATA_RATES))} samples a second, not {sample_rate:g}")
    rate = None if sample_rate is None else int(sample_rate)
    return KvhGyro(open_link(address, clock, baudrate=baudrate), clock, axis=axis, data_rate=rate, may_set=configure)
