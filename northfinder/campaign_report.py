"""The tables of a campaign as plain data: (5) to (7) and (9) to (15) of [S2] (docs/method.md, section 10)."""

from __future__ import annotations

import datetime as dt
import math
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from northfinder.campaign import Campaign, Member
from northfinder.estimation import Fix, Known
from northfinder.estimation.calibration import with_ratio
from northfinder.estimation.campaign import circular_mean, consistency, deviations, scatter, turn_on_scatter
from northfinder.units import DPH, EARTH_RATE

Array = NDArray[np.float64]
_HOUR = 3600.0  # s


def campaign_json(campaign: Campaign) -> dict[str, Any]:
    """Return all tables as plain data, angles in deg, rates in deg/h."""
    latitude, azimuth = campaign.latitude, campaign.azimuth
    result: dict[str, Any] = {
        "n_records": len(campaign.members),
        "n_turn_ons": int(campaign.turn_on[-1]) + 1,
        "true_latitude_deg": None if latitude is None else math.degrees(latitude),
        "true_azimuth_deg": None if azimuth is None else math.degrees(azimuth),
        "pause_h": _pause_hours(campaign),
        "azimuth": _azimuth_json(campaign),
        "latitude": {},
        "planes": {},
    }
    planes = _planes(campaign)
    if planes:
        result["planes"] = {name: _scatter_json(campaign, values) for name, values in planes.items()}
    latitudes = _latitudes(campaign, planes)
    if latitudes:
        result["latitude"] = {name: _latitude_json(campaign, values) for name, values in latitudes.items()}
    result["consistency"] = _consistency_json(campaign)
    result["records"] = [_record_json(campaign, i, latitudes) for i in range(len(campaign.members))]
    return result


def _pause_hours(campaign: Campaign) -> float | None:
    if campaign.pause_after is None:
        return None
    before, after = campaign.members[campaign.pause_after : campaign.pause_after + 2]
    return (after.facts.started - before.facts.ended) / _HOUR


def _azimuth_json(campaign: Campaign) -> dict[str, Any]:
    """Return (5) to (7): mean and sd of each part, sd times cos(latitude), within and between turn-ons."""
    azimuths = campaign.values(lambda member: member.fix.azimuth)
    split = turn_on_scatter(deviations(azimuths, circular_mean(azimuths)), campaign.turn_on)
    level = None if campaign.latitude is None else math.cos(campaign.latitude)
    result: dict[str, Any] = {}
    for name in campaign.parts:
        part = azimuths[campaign.part(name)]
        found = scatter(part, circular=True)
        sd = _degrees(found.sd)
        result[name] = {
            "n": found.n,
            "mean_deg": math.degrees(found.mean),
            "sd_deg": sd,
            "sd_cos_latitude_deg": None if sd is None or level is None else sd * level,
        }
        if campaign.azimuth is not None:
            error = math.remainder(found.mean - campaign.azimuth, 2.0 * math.pi)
            result[name]["error_deg"] = math.degrees(error)
    return result | {
        "within_turn_on_sd_deg": _degrees(split.within),
        "between_turn_ons_sd_deg": _degrees(split.between),
        "between_turn_ons_probability": split.probability,
    }


def _planes(campaign: Campaign) -> dict[str, Array]:
    """Return (10) and (11) of each record: biases in deg/h and, at a known latitude, scale factors and their ratio."""
    values: dict[str, Array] = {}
    if any(member.bias is not None for member in campaign.members):
        for i, plane in enumerate(("horizontal", "vertical")):
            values[f"bias_{plane}_dph"] = campaign.values(lambda m, i=i: m.bias[i] / DPH if m.bias else None)  # type: ignore[misc]
    if campaign.latitude is not None:
        level, upright = EARTH_RATE * math.cos(campaign.latitude), EARTH_RATE * math.sin(campaign.latitude)
        values["scale_factor_horizontal"] = campaign.values(lambda m: math.hypot(*m.plain.rates[:2])) / level
        vertical = campaign.values(lambda m: None if m.plain.latitude is None else float(m.plain.rates[2]))
        if abs(upright) > 0.01 * EARTH_RATE and np.isfinite(vertical).any():
            values["scale_factor_vertical"] = vertical / upright
            values["ratio"] = values["scale_factor_horizontal"] / values["scale_factor_vertical"]
    return values


def _latitudes(campaign: Campaign, planes: dict[str, Array]) -> dict[str, Array]:
    """Return the latitude of each record, rad: as stated, (9) with nothing corrected, (12) with the mean ratio k."""
    found = {"stated": campaign.values(lambda member: None if _was_given(member) else member.fix.latitude)}
    found["plain"] = campaign.values(lambda member: member.plain.latitude)
    if "ratio" in planes:
        first = campaign.part("all" if campaign.pause_after is None else "before")
        ratio = float(np.nanmean(planes["ratio"][first]))
        found["with_ratio"] = campaign.values(lambda member: _with_ratio(member.plain, ratio))
    return {name: values for name, values in found.items() if np.isfinite(values).any()}


def _was_given(member: Member) -> bool:
    return member.known_latitude is not None


def _with_ratio(plain: Fix, ratio: float) -> float | None:
    if plain.latitude is None:
        return None
    return with_ratio(plain, Known(), ratio=ratio, ratio_sd=0.0).latitude


def _scatter_json(campaign: Campaign, values: Array) -> dict[str, Any]:
    result = {}
    for name in campaign.parts:
        part = values[campaign.part(name)]
        found = scatter(part[np.isfinite(part)]) if np.isfinite(part).any() else None
        result[name] = {"n": 0} if found is None else {"n": found.n, "mean": found.mean, "sd": found.sd}
    return result


def _latitude_json(campaign: Campaign, values: Array) -> dict[str, Any]:
    """Return (9) or (13) to (15): mean, mean error and sd of each part."""
    result = {}
    for name, part in _scatter_json(campaign, np.degrees(values)).items():
        line = {"n": part["n"], "mean_deg": part.get("mean"), "sd_deg": part.get("sd")}
        if campaign.latitude is not None and part["n"]:
            line["error_deg"] = part["mean"] - math.degrees(campaign.latitude)
        result[name] = line
    return result


def _consistency_json(campaign: Campaign) -> dict[str, Any]:
    """Return whether azimuth and latitude scatter as stated: over all, within turn-ons, and against the truth."""
    azimuths = campaign.values(lambda member: member.fix.azimuth)
    sds = {"azimuth": campaign.values(lambda member: member.fix.azimuth_sd)}
    off = {"azimuth": deviations(azimuths, circular_mean(azimuths))}
    errors = {} if campaign.azimuth is None else {"azimuth": deviations(azimuths, campaign.azimuth)}
    measured = [member.fix.latitude is not None and not _was_given(member) for member in campaign.members]
    if all(measured):
        off["latitude"] = campaign.values(lambda member: member.fix.latitude)
        sds["latitude"] = campaign.values(lambda member: member.fix.latitude_sd)
        if campaign.latitude is not None:
            errors["latitude"] = off["latitude"] - campaign.latitude
    result = {}
    for name, values in off.items():
        judged = {
            "all": consistency(values, sds[name]),
            "within_turn_ons": consistency(values, sds[name], campaign.turn_on) if campaign.turn_on[-1] else None,
            "against_truth": consistency(errors[name], sds[name], known=True) if name in errors else None,
        }
        result[name] = {key: msgspec.to_builtins(each) for key, each in judged.items() if each is not None}
    return result


def _record_json(campaign: Campaign, i: int, latitudes: dict[str, Array]) -> dict[str, Any]:
    member = campaign.members[i]
    facts = member.facts
    named = {
        f"latitude_{name}_deg": math.degrees(values[i]) for name, values in latitudes.items() if np.isfinite(values[i])
    }
    return {
        "record": str(member.path),
        "started": dt.datetime.fromtimestamp(facts.started, dt.UTC).isoformat(timespec="seconds"),
        "serial_number": None if facts.gyro is None else facts.gyro.serial_number,
        "turn_on": int(campaign.turn_on[i]) + 1,
        "part": "after" if campaign.part("after")[i] else "before",
        "azimuth_deg": math.degrees(member.fix.azimuth),
        "azimuth_sd_deg": math.degrees(member.fix.azimuth_sd),
        "latitude_sd_deg": _degrees(member.fix.latitude_sd),
        "trustworthy": member.fix.trustworthy,
    } | named


def _degrees(angle: float | None) -> float | None:
    return None if angle is None else math.degrees(angle)
