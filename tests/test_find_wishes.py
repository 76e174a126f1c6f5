"""What `find` asks of the plan: the command line before the configuration."""

import math
from typing import Any

from northfinder.adaptive import Wishes
from northfinder.cli.find import _wishes
from northfinder.config import MeasurementTable

NOTHING: dict[str, Any] = {"plan": None, "time_s": None, "until_sd_deg": None, "azimuth_deg": None, "dwell_s": None}
TABLE = MeasurementTable(plan="double", time_s=180.0, until_sd_deg=0.2, azimuth_deg=30.0)


def test_the_configuration_holds_where_the_command_line_is_silent() -> None:
    """Every wish of the file reaches the plan, angles in rad."""
    assert _wishes(TABLE, **NOTHING) == Wishes(
        name="double", time=180.0, until_sd=math.radians(0.2), azimuth=math.radians(30.0)
    )
    assert _wishes(MeasurementTable(), **NOTHING) == Wishes()


def test_the_command_line_comes_first() -> None:
    """A dwell asked for puts the file's time aside, as they exclude each other; and a time the file's dwell."""
    asked = _wishes(TABLE, **NOTHING | {"plan": "six-position", "dwell_s": 20.0, "until_sd_deg": 0.1})
    assert asked == Wishes(name="six-position", dwell=20.0, until_sd=math.radians(0.1), azimuth=math.radians(30.0))
    assert _wishes(MeasurementTable(dwell_s=20.0), **NOTHING | {"time_s": 300.0}) == Wishes(time=300.0)
