"""Units of the field, in SI; multiply to come in, divide to go out."""

from __future__ import annotations

import math

#: rad/s in one degree an hour.
DPH = math.radians(1.0) / 3600.0
#: rad in one arc second.
ARCSEC = math.radians(1.0) / 3600.0
#: m/s^2 in one thousandth of standard gravity.
MILLI_G = 9.80665e-3
#: Rate of the earth's rotation about its axis, rad/s (15.041067 deg/h).
EARTH_RATE = 7.292115e-5
