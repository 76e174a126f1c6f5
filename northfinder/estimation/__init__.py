"""Arithmetic from interval means of the rate to azimuth and latitude: arrays in, frozen results out.

One linear model serves all: the mean rate over an interval is ``h . (N, E, V) + bias(t) + noise``, with the input axis
``h`` from the measured stage angles and tilt. ``N, E, V`` are the earth's rotation, times the scale factor, along stage
azimuth zero turned to true north (docs/method.md, section 3); azimuth and latitude follow from them.
"""

from northfinder.estimation.checks import Check
from northfinder.estimation.closed_form import ClosedForm, solve_closed_form
from northfinder.estimation.fix import Fix, Known
from northfinder.estimation.least_squares import estimate
from northfinder.estimation.means import RateMeans
from northfinder.estimation.noise import NoiseModel

__all__ = [
    "Check",
    "ClosedForm",
    "Fix",
    "Known",
    "NoiseModel",
    "RateMeans",
    "estimate",
    "solve_closed_form",
]
