"""A fix from a file: a record of ours, a table of dwells, or a static triad."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from northfinder.errors import ConfigError, RecordError
from northfinder.estimation.means import RateMeans
from northfinder.estimation.noise import NoiseModel
from northfinder.geodesy import Place, bearings_json
from northfinder.record import Record
from northfinder.record.facts import completeness, gyro_identity, record_date
from northfinder.reduction import reduce_record
from northfinder.solution import Assumptions, fix_to_json, solve, supplement
from northfinder.tables import DwellTable, StaticTriad, read_table, stated_input_axis_offset

Array = NDArray[np.float64]

_SQLITE = b"SQLite format 3\0"


def solve_file(
    path: Path,
    assumptions: Assumptions | None,
    *,
    revise: Callable[[Assumptions], Assumptions] = lambda kept: kept,
    input_axis_offset: float | None = None,
    place: Place | None = None,
) -> dict[str, Any]:
    """Return the fix from a file of any kind.

    Parameters
    ----------
    path : Path
        Told apart by its content, not by its name.
    assumptions : Assumptions, optional
        In place of those kept in a record; for a table its latitude is used, and for a triad the noise of its profile.
    revise : callable
        What to change of those assumptions.
    input_axis_offset : float, optional
        For a table of dwells: where the input axis points at stage azimuth zero, rad. If not given, what the file
        states, or zero.
    place : Place, optional
        In place of the one kept in a record; for grid azimuth and magnetic bearing.

    Raises
    ------
    ConfigError
        A place is given with a table, which has no date.
    RecordError
        The file is of no kind known, or damaged.
    EstimateError
        Its data determine no azimuth.
    """
    try:
        with path.open("rb") as file:
            is_record = file.read(len(_SQLITE)) == _SQLITE
    except OSError as error:
        raise RecordError(f"{path}: cannot be read: {error.strerror}") from None
    if is_record:
        return solve_record(path, assumptions, revise=revise, place=place)
    if place is not None:
        raise ConfigError(f"{path} is a table without a date: a position is for a record")
    revised = revise(assumptions or Assumptions())
    latitude = None if revised.latitude_deg is None else math.radians(revised.latitude_deg)
    noise = revised.noise()
    table = read_table(path, timed=noise is not None)
    return _solve_table(table, latitude, input_axis_offset, noise)


def solve_record(
    path: Path,
    assumptions: Assumptions | None = None,
    *,
    revise: Callable[[Assumptions], Assumptions] = lambda kept: kept,
    place: Place | None = None,
) -> dict[str, Any]:
    """Return the fix from a record, under its own assumptions unless others are given.

    Raises RecordError, EstimateError, and ConfigError if the calibration is not for this record.
    """
    with Record(path) as record:
        assumptions = revise(assumptions or kept_assumptions(record))
        if assumptions.calibration is not None:
            assumptions.calibration.check(gyro_identity(record), record_date(record))
        means = reduce_record(record).means()
        fix = solve(means, assumptions)
        plan = record.meta("plan")
        name = plan.get("name") if isinstance(plan, dict) else None
        about = {"plan": name, "record": str(path)} | completeness(record)
        result = fix_to_json(fix) | supplement(means, assumptions, fix) | about
        return result | kept_bearings(record, result, place)


def kept_bearings(record: Record, result: dict[str, Any], place: Place | None = None) -> dict[str, Any]:
    """Return grid azimuth and magnetic bearing of the result of a record, nothing if no place is given or kept."""
    place = place or Place.from_json(record.meta("place"))
    if place is None:
        return {}
    try:
        date = record_date(record)
    except (OverflowError, OSError, ValueError):
        raise RecordError(f"the record {record.path} is damaged: it ends at a date that cannot be") from None
    return bearings_json(place, result, date)


def kept_assumptions(record: Record) -> Assumptions:
    """Return the assumptions of the live run. Raises RecordError if they are not in the record."""
    try:
        return msgspec.convert(record.meta("assumptions"), Assumptions)
    except msgspec.ValidationError as error:
        raise RecordError(f"the record {record.path} is damaged: its assumptions cannot be read: {error}") from None


def _solve_table(
    table: DwellTable | StaticTriad,
    latitude: float | None,
    input_axis_offset: float | None,
    noise: NoiseModel | None,
) -> dict[str, Any]:
    # What only tables need is dear to import, and records are solved much more often.
    from northfinder.estimation.double_gyrocompass import solve_triad  # noqa: PLC0415
    from northfinder.estimation.dwell_table import solve_dwell_table  # noqa: PLC0415
    from northfinder.estimation.triad import static_mean_of  # noqa: PLC0415
    from northfinder.table_report import dwell_table_json, triad_json  # noqa: PLC0415

    if isinstance(table, StaticTriad):
        means = [static_mean_of(position.name, position.pieces) for position in table.positions]
        covariance = None if noise is None or len(means) == 1 else _covariance(table, noise)
        return triad_json(solve_triad(means, latitude=latitude, rate_covariance=covariance))
    if input_axis_offset is None:
        input_axis_offset = stated_input_axis_offset(table.metadata) or 0.0
    fix = solve_dwell_table(
        table.azimuth, table.elevation, table.rate, input_axis_offset=input_axis_offset, latitude=latitude
    )
    return dwell_table_json(fix) | {"input_axis_offset_deg": math.degrees(input_axis_offset)}


def _covariance(table: StaticTriad, noise: NoiseModel) -> Array:
    """Return the covariance of the mean rates of a gyro over the positions, rad^2/s^2."""
    start, duration = np.array([position.interval for position in table.positions], dtype=np.float64).T
    zero = np.zeros(start.size)
    n_samples = [sum(piece.shape[1] for piece in position.pieces) for position in table.positions]
    means = RateMeans(start=start, duration=duration, rate=zero, azimuth=zero, elevation=zero, n_samples=n_samples)
    return noise.covariance(means)
