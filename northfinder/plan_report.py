"""Candidate plans with what they will give, in the units of the field."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from northfinder.cyclogram import Cyclogram
from northfinder.errors import ConfigError, EstimateError
from northfinder.estimation.planning import Prediction
from northfinder.layouts import MEASURE_LATITUDE, PLANS
from northfinder.plans import Candidate, Conditions, candidates, predicted

#: Candidates listed of each plan, which differ in order or number of dwells.
N_LISTED = 2
#: Points of a curve of standard deviation against time.
N_POINTS = 10


def survey(conditions: Conditions, *, azimuth_known: bool) -> tuple[list[Candidate], dict[str, str]]:
    """Return candidates of every plan, the best first, and why the plans without any have none.

    Raises ConfigError if no plan is left.
    """
    found: list[Candidate] = []
    refused: dict[str, str] = {}
    for name in PLANS:
        if name == "double" and not azimuth_known:
            refused[name] = "starts from a roughly known azimuth, which is not given"
            continue
        if conditions.needs_latitude and name not in MEASURE_LATITUDE:
            refused[name] = "does not measure the latitude"
            continue
        try:
            found += candidates(name, conditions, n=N_LISTED)
        except ConfigError as error:
            refused[name] = str(error)
    if not found:
        raise ConfigError(f"no plan gives what is wanted in {conditions.time:g} s: {next(iter(refused.values()))}")
    return sorted(found, key=lambda each: each.score), refused


def best_of_each(found: Sequence[Candidate]) -> list[Candidate]:
    """Return the best candidate of each plan, from candidates the best first."""
    return list({each.cyclogram.name: each for each in reversed(found)}.values())[::-1]


def candidate_json(candidate: Candidate, conditions: Conditions) -> dict[str, Any]:
    """Return a candidate as plain data: angles in deg, times in s."""
    dwells = [step.dwell for step in candidate.cyclogram.steps]
    return {
        "plan": candidate.cyclogram.name,
        "order": order(candidate.cyclogram),
        "n_dwells": len(dwells),
        "shortest_dwell_s": min(dwells),
        "longest_dwell_s": max(dwells),
        "duration_s": candidate.dwells[-1].start + candidate.dwells[-1].duration,
        **_prediction_json(candidate.prediction, conditions),
    }


def curve_json(candidate: Candidate, conditions: Conditions) -> list[dict[str, Any]]:
    """Return what the fix will state after some of the dwells, from the first that determine an azimuth to the last."""
    n = len(candidate.dwells)
    points = []
    for i in sorted({round(1 + k * (n - 1) / (N_POINTS - 1)) for k in range(N_POINTS)}):
        dwells = candidate.dwells[:i]
        try:
            prediction = predicted(dwells, conditions)
        except EstimateError:
            continue
        points.append({"time_s": dwells[-1].start + dwells[-1].duration, **_prediction_json(prediction, conditions)})
    return points


def _prediction_json(prediction: Prediction, conditions: Conditions) -> dict[str, Any]:
    azimuth_sd = math.degrees(prediction.azimuth_sd)
    return {
        "azimuth_sd_deg": azimuth_sd,
        "azimuth_sd_cos_latitude_deg": azimuth_sd * math.cos(conditions.truth.latitude),
        "latitude_sd_deg": None if prediction.latitude_sd is None else math.degrees(prediction.latitude_sd),
    }


def order(cyclogram: Cyclogram) -> str:
    """Return the order of positions in short: what is gone through twice or more stands in brackets, with how often.

    The last time may break off before its end. 1 to 6 are positions of the stage, letters are true directions.
    """
    names = [_SHORT[step.name] for step in cyclogram.steps]
    n_opening = sum(not step.from_north for step in cyclogram.steps) % len(names)
    opening, pattern = names[:n_opening], names[n_opening:]
    period = next(p for p in range(1, len(pattern) + 1) if pattern[p:] == pattern[:-p])
    times = len(pattern) / period
    repeated = f"({''.join(pattern[:period])}) x {times:.3g}" if times >= 2 else "".join(pattern)
    return f"{''.join(opening)} {repeated}".strip()


_SHORT = {f"U{i}": str(i) for i in range(1, 7)} | {
    name: name[0].upper() for name in ("north", "east", "south", "west", "up", "down")
}
