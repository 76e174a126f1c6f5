"""The uncertainty budget in the units of the field: as plain data, and as a table for people."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from rich.box import SIMPLE
from rich.table import Table

from northfinder.estimation.budget import Budget, Contribution
from northfinder.units import ARCSEC, DPH

#: SI units to those of the field: what to divide by, and the name.
_FIELD_UNITS = {
    "rad": (ARCSEC, "arcsec"),
    "rad/sqrt(s)": (math.radians(1.0) / 60.0, "deg/√h"),
    "rad/s": (DPH, "deg/h"),
    "rad/s/sqrt(s)": (DPH / 60.0, "deg/h/√h"),
    "rad/s^2": (DPH / 3600.0, "deg/h/h"),
    "rad/s/g": (DPH, "deg/h/g"),
    "1": (1.0, ""),
}
_DEGREES = {"latitude entry", "azimuth offset"}
_NOTHING = 1e-9  # deg
_ANGLE_WHITE_NOISE = "deg/h·s"  # an arc second by another name


def budget_to_json(budget: Budget) -> list[dict[str, Any]]:
    """Return the lines of the budget as plain data, the largest first."""
    return [_line_to_json(line) for line in budget.contributions]


def _line_to_json(line: Contribution) -> dict[str, Any]:
    size, unit = (math.radians(1.0), "deg") if line.quantity in _DEGREES else _FIELD_UNITS[line.unit]
    unit = _ANGLE_WHITE_NOISE if line.quantity == "angle white noise" else unit

    def sensitivity(coefficient: float | None) -> float | None:
        return None if coefficient is None else math.degrees(coefficient * size)

    return {
        "quantity": line.quantity,
        "sd": line.sd / size,
        "unit": unit,
        "evaluation": line.evaluation,
        "azimuth_sensitivity": sensitivity(line.azimuth_sensitivity),
        "latitude_sensitivity": sensitivity(line.latitude_sensitivity),
        "azimuth_deg": math.degrees(line.azimuth),
        "latitude_deg": math.degrees(line.latitude),
    }


def budget_table(lines: Sequence[Mapping[str, Any]], *, title: str = "") -> Table:
    """Return the budget as `budget_to_json` gave it, with the combined standard uncertainties below."""
    silent = ", ".join(line["quantity"] for line in lines if not line["sd"])
    table = Table(title=title, show_footer=True, caption=f"taken as exact: {silent}" if silent else None, box=SIMPLE)
    table.add_column("quantity", footer="combined", no_wrap=True)
    table.add_column("sd", justify="right", no_wrap=True)
    table.add_column("type")
    for name in ("azimuth_deg", "latitude_deg"):
        table.add_column(name.replace("_", ", "), justify="right", footer=_shown(math.hypot(*(x[name] for x in lines))))
    for line in lines:
        if line["sd"]:
            sd = f"{line['sd']:.3g} {line['unit']}"
            shown = (_shown(line[name]) for name in ("azimuth_deg", "latitude_deg"))
            table.add_row(line["quantity"], sd, line["evaluation"], *shown)
    return table


def _shown(angle_deg: float) -> str:
    return f"{angle_deg:.4f}" if angle_deg > _NOTHING else ""


def largest(lines: Sequence[Mapping[str, Any]], n: int = 3) -> str:
    """Return the `n` largest contributions to the azimuth in one line.

    >>> largest([{"quantity": "bias instability", "azimuth_deg": 0.12}, {"quantity": "tilt", "azimuth_deg": 0.0}])
    'bias instability 0.120'
    """
    felt = (line for line in lines[:n] if line["azimuth_deg"] > _NOTHING)
    return ", ".join(f"{line['quantity']} {line['azimuth_deg']:.3f}" for line in felt)
