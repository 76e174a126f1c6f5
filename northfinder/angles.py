"""Angles as people read them: to the digits that their interval supports, directions from 0 to below 360 deg."""

from __future__ import annotations

import math


def decimals_for(half_deg: float) -> int:
    """Return how many decimals show two digits of half an interval; three if there is none.

    >>> decimals_for(0.21), decimals_for(0.0345), decimals_for(62.0)
    (2, 3, 0)
    """
    return 3 if half_deg <= 0.0 else min(6, max(0, 1 - math.floor(math.log10(half_deg))))


def direction_text(angle_deg: float, decimals: int) -> str:
    """Return a direction as text, below 360 once it is rounded too.

    >>> direction_text(359.9996, 3), direction_text(-0.02, 2)
    ('0.000', '359.98')
    """
    return f"{round(angle_deg % 360.0, decimals) % 360.0:.{decimals}f}"
