"""A calibration from records of measurements where the truth is known."""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from northfinder.calibration import AzimuthTable, Calibration, DriftTable, Model, RatioTable
from northfinder.errors import ConfigError, EstimateError, RecordError
from northfinder.estimation import Fix, Known
from northfinder.estimation.calibration import Constants, ModelFit, Reading, calibrate
from northfinder.estimation.geometry import by_tilt
from northfinder.estimation.propagation import Propagation
from northfinder.record import Record
from northfinder.record.facts import RecordFacts, facts_of, require_complete
from northfinder.reduction import reduce_record
from northfinder.solution import Assumptions, Problem
from northfinder.solve_file import kept_assumptions
from northfinder.text import printable
from northfinder.units import DPH

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """What is known of the place of one record, in deg; None to take the latitude the record was measured with."""

    latitude_deg: float | None
    azimuth_deg: float | None


def calibrate_records(
    records: Sequence[tuple[Path, Truth]],
    *,
    valid_days: int,
    latitude_sd_deg: float = 0.0,
    azimuth_sd_deg: float = 0.0,
    model: Model | None = None,
    revise: Callable[[Assumptions], Assumptions] = lambda kept: kept,
) -> tuple[Calibration, Constants]:
    """Return the calibration that the records give, and what it rests on.

    Parameters
    ----------
    records : sequence of (Path, Truth)
        At least one; all of the same gyro.
    valid_days : int
        From the day of the last record.
    latitude_sd_deg, azimuth_sd_deg : float
        Of the true values.
    model : {"acceleration-sensitive", "ratio"}, optional
        The one to apply; if not given that which the data support, and acceleration-sensitive if they do not tell.
    revise : callable
        What to change of the assumptions of each record, such as its gyro profile.

    Raises
    ------
    ConfigError
        The records are of several gyros, or no latitude is known.
    RecordError, EstimateError
        As for `solve_record`; also for a record without its gyro's identity.
    """
    readings, facts = [], []
    for path, truth in records:
        with Record(path) as record:
            require_complete(record)
            assumptions = revise(kept_assumptions(record))
            readings.append(_reading(record, truth, assumptions))
            facts.append(facts_of(record))
    serial_number, gyro_model = _one_gyro([path for path, _ in records], facts)
    constants = calibrate(readings, latitude_sd=math.radians(latitude_sd_deg), azimuth_sd=math.radians(azimuth_sd_deg))
    date = max(each.date for each in facts)
    warm = [temperature for each in facts for temperature in each.temperatures or ()]
    calibration = Calibration(
        serial_number=serial_number,
        gyro_model=gyro_model,
        date=date,
        valid_until=date + dt.timedelta(days=valid_days),
        n_records=len(readings),
        latitudes_deg=sorted({math.degrees(reading.latitude) for reading in readings}),
        temperature_min_c=min(warm, default=None),
        temperature_max_c=max(warm, default=None),
        model=model or constants.supported or "acceleration-sensitive",
        supported=constants.supported,
        acceleration_sensitive=_drift_table(constants.acceleration_sensitive),
        ratio=None if constants.ratio is None else _ratio_table(constants.ratio),
        azimuth=_azimuth_table(constants),
    )
    return calibration, constants


def _reading(record: Record, truth: Truth, assumptions: Assumptions) -> Reading:
    latitude_deg = assumptions.latitude_deg if truth.latitude_deg is None else truth.latitude_deg
    if latitude_deg is None:
        raise ConfigError(f"{record.path} was not measured at a known latitude: give --latitude")
    problem = Problem.of(reduce_record(record).means(), assumptions)
    fix = problem.estimate(Known())
    if fix.latitude is None:
        raise EstimateError(f"{record.path} gives no calibration: {fix.latitude_reason}")
    return Reading(
        rates=fix.rates,
        covariance=fix.rates_covariance,
        common=_common(problem, fix, assumptions),
        latitude=math.radians(latitude_deg),
        azimuth=None if truth.azimuth_deg is None else math.radians(truth.azimuth_deg),
    )


def _common(problem: Problem, fix: Fix, assumptions: Assumptions) -> Array:
    """Return the covariance of N, E and V that the errors of tilt and stage angles bring to all records alike."""
    path = Propagation.of(
        problem.means, noise=problem.noise, known=Known(), drift=problem.drift, weights=problem.weights
    )
    stage = assumptions.declared().stage_angle_sd * path.by_stage_angles(fix.rates)
    tilt = assumptions.known().tilt_sd * by_tilt(fix.rates)
    return np.asarray(stage @ stage.T + tilt @ tilt.T)


def _one_gyro(paths: Sequence[Path], facts: Sequence[RecordFacts]) -> tuple[str, str]:
    """Return serial number and model of the gyro that made all the records."""
    first = None
    for path, each in zip(paths, facts, strict=True):
        if each.gyro is None:
            raise RecordError(f"the record {path} does not say which gyro measured it")
        first = first or each.gyro
        if each.gyro.serial_number != first.serial_number:
            raise ConfigError(
                f"a calibration is of one gyro: {paths[0]} is of {printable(first.serial_number)!r}, "
                f"{path} of {printable(each.gyro.serial_number)!r}"
            )
    if first is None:
        raise ConfigError("there is no record to calibrate from")
    return first.serial_number, first.model


def _drift_table(fit: ModelFit) -> DriftTable:
    return DriftTable(
        scale_factor=fit.first,
        scale_factor_sd=fit.first_sd,
        drift_rate_dph_per_g=fit.second / DPH,
        drift_rate_sd_dph_per_g=fit.second_sd / DPH,
        correlation=fit.correlation,
        chi2=fit.chi2,
        dof=fit.dof,
    )


def _ratio_table(fit: ModelFit) -> RatioTable:
    return RatioTable(
        scale_factor=fit.first,
        scale_factor_sd=fit.first_sd,
        ratio=fit.second,
        ratio_sd=fit.second_sd,
        chi2=fit.chi2,
        dof=fit.dof,
    )


def _azimuth_table(constants: Constants) -> AzimuthTable | None:
    if constants.azimuth_offset is None or constants.azimuth_offset_sd is None:
        return None
    return AzimuthTable(
        offset_deg=math.degrees(constants.azimuth_offset), offset_sd_deg=math.degrees(constants.azimuth_offset_sd)
    )
