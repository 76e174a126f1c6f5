"""The published formulas beside the fix, where the plan took the published positions; in the units of the field."""

from __future__ import annotations

import math
from typing import Any

from northfinder.errors import EstimateError
from northfinder.estimation import Fix, NoiseModel, RateMeans, solve_closed_form
from northfinder.units import DPH


def published_json(means: RateMeans, noise: NoiseModel | None, fix: Fix) -> dict[str, Any]:
    """Return what formulas (2), (3) and (10) of docs/method.md, section 2, say; nothing without positions U1 to U4.

    The azimuth is of stage azimuth zero, before any calibrated offset. The latitude by (3) takes no acceleration-
    sensitive drift rate out, and the scale factors by (10) rest on the latitude of the fix.
    """
    if means.n_axes != 1:
        return {}
    try:
        found = solve_closed_form(means, noise=noise, known_latitude=fix.latitude)
    except EstimateError:
        return {}
    return {
        "closed_form": {
            "azimuth_deg": math.degrees(found.azimuth),
            "azimuth_sd_deg": _degrees(found.azimuth_sd),
            "latitude_deg": _degrees(found.latitude),
            "latitude_sd_deg": _degrees(found.latitude_sd),
            "bias_horizontal_dph": found.bias_horizontal / DPH,
            "bias_vertical_dph": None if found.bias_vertical is None else found.bias_vertical / DPH,
            "scale_factor_horizontal": found.scale_factor_horizontal,
            "scale_factor_vertical": found.scale_factor_vertical,
        }
    }


def _degrees(angle: float | None) -> float | None:
    return None if angle is None else math.degrees(angle)
