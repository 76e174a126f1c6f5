"""Solutions of measured tables in degrees and deg/h, as plain dictionaries ready for JSON."""

from __future__ import annotations

import math
from typing import Any

from northfinder.estimation.double_gyrocompass import TriadSolution
from northfinder.estimation.dwell_table import DwellTableFix
from northfinder.estimation.triad import AXES, AxisDirection, TriadFix
from northfinder.units import DPH


def dwell_table_json(fix: DwellTableFix) -> dict[str, Any]:
    """Return the solution of a dwell table; None where a quantity is not known."""
    return {
        "azimuth_deg": _deg(fix.azimuth),
        "azimuth_sd_deg": _deg(fix.azimuth_sd),
        "latitude_deg": _deg(fix.latitude),
        "latitude_sd_deg": _deg(fix.latitude_sd),
        "horizontal_rate_dph": fix.horizontal_rate / DPH,
        "horizontal_rate_sd_dph": fix.horizontal_rate_sd / DPH,
        "scale_factor": fix.scale_factor,
        "scale_factor_sd": fix.scale_factor_sd,
        "bias_dph": fix.bias / DPH,
        "noise_sd_dph": fix.noise_sd / DPH,
        "n_dwells": fix.n_dwells,
        "degrees_of_freedom": fix.degrees_of_freedom,
        "method": fix.method,
    }


def triad_json(solution: TriadSolution) -> dict[str, Any]:
    """Return the solution of a triad.

    At the top stand latitude, biases and the axes in the first position, from all positions together. Under
    ``positions`` stands what each position says alone, with the axes from all together as ``combined_axes``.
    """
    combined = solution.combined
    positions = {}
    for alone, axes in zip(solution.positions, combined.axes, strict=True):
        positions[alone.names[0]] = _fix(alone) | {"combined_axes": _axes(axes)}
    method = "double gyrocompassing" if len(combined.names) > 1 else "analytic gyrocompassing"
    return {"method": method, "position": combined.names[0], **_fix(combined), "positions": positions}


def _fix(fix: TriadFix) -> dict[str, Any]:
    return {
        "axes": _axes(fix.axes[0]),
        "latitude_deg": _deg(fix.latitude),
        "latitude_sd_deg": _deg(fix.latitude_sd),
        "bias_dph": None if fix.bias is None else [float(b) / DPH for b in fix.bias],
        "bias_sd_dph": None if fix.bias_sd is None else [float(sd) / DPH for sd in fix.bias_sd],
        "notes": list(fix.notes),
    }


def _axes(axes: tuple[AxisDirection, AxisDirection, AxisDirection]) -> dict[str, Any]:
    return {name: _axis(axis) for name, axis in zip(AXES, axes, strict=True)}


def _axis(axis: AxisDirection) -> dict[str, Any]:
    values = {
        "azimuth_deg": _deg(axis.azimuth),
        "azimuth_sd_deg": _deg(axis.azimuth_sd),
        "elevation_deg": _deg(axis.elevation),
        "elevation_sd_deg": _deg(axis.elevation_sd),
    }
    return values | ({"reason": axis.reason} if axis.reason else {})


def _deg(angle: float | None) -> float | None:
    return None if angle is None else math.degrees(float(angle))
