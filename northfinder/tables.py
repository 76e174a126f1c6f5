"""Measured tables as CSV: a table of dwells, or a static triad of gyros and accelerometers.

Columns are found by name, in any order; others are ignored. The unit stands at the end of a name.

======================  ==================================================  ==========================================
kind                    columns                                             units
======================  ==================================================  ==========================================
dwell table             ``stage_azimuth_*``, ``elevation_*``                ``deg``, ``rad``
                        ``duration_*``                                      ``s``, ``min``
                        ``rate_*``                                          ``dph`` (deg/h), ``deg_s``, ``rad_s``
                        ``dwell``, if there: must grow from row to row
static triad            ``gyro_x_*``, ``gyro_y_*``, ``gyro_z_*``            ``dph``, ``deg_s``, ``rad_s``
                        ``accel_x_*``, ``accel_y_*``, ``accel_z_*``         ``ms2`` (m/s^2), ``g``
                        ``position``, if there: names the position
                        ``time_s``, read where a noise model needs it       ``s``
======================  ==================================================  ==========================================

Rows are in the order of time. ``# key: value`` lines are offered as metadata. Of them only one thing is used unasked:
"points at stage_azimuth_deg + 180" says where the input axis stands on the stage, and the result repeats it.
"""

from __future__ import annotations

import math
import os
import re
import stat
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from northfinder.delimited import Header, read_header, read_rows, shown
from northfinder.errors import RecordError
from northfinder.text import printable
from northfinder.units import DPH

Array = NDArray[np.float64]

MAX_POSITIONS = 100

_ANGLE = {"deg": math.radians(1.0), "rad": 1.0}
_DURATION = {"s": 1.0, "min": 60.0}
_RATE = {"dph": DPH, "deg_s": math.radians(1.0), "rad_s": 1.0}
_ACCELERATION = {"ms2": 1.0, "g": 9.80665}

_DWELLS = {"stage_azimuth": _ANGLE, "elevation": _ANGLE, "duration": _DURATION, "rate": _RATE}
_GYROS = {f"gyro_{axis}": _RATE for axis in "xyz"}
_TRIAD = _GYROS | {f"accel_{axis}": _ACCELERATION for axis in "xyz"}


def stated_input_axis_offset(metadata: Mapping[str, str]) -> float | None:
    """Return the angle in rad of "points at stage_azimuth_deg + ANGLE" in a comment, None without one."""
    pattern = r"points at stage_azimuth_deg ([+-]) (\d{1,3}(?:\.\d+)?)(?![\d.]*\d)"
    for value in metadata.values():
        found = re.search(pattern, value, re.ASCII)
        if found:
            return math.radians(float(found[1] + found[2]))
    return None


@dataclass(frozen=True, slots=True, kw_only=True)
class DwellTable:
    """Mean rates of one gyro in successive attitudes of the stage, in the order of time. Arrays of shape (n,)."""

    azimuth: Array  #: rad, of the stage
    elevation: Array  #: rad
    duration: Array  #: s
    rate: Array  #: rad/s
    metadata: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class TriadPosition:
    """What a triad at rest measured in one position, in the pieces that it was read in."""

    name: str
    pieces: tuple[Array, ...]  #: rates in rad/s and specific forces in m/s^2, body axes x, y, z, shape (6, n) each
    interval: tuple[float, float] | None = None  #: start and duration, s, if they were asked for

    @property
    def rate(self) -> Array:
        """All rates, rad/s, shape (n, 3)."""
        return np.hstack([piece[:3] for piece in self.pieces]).T

    @property
    def specific_force(self) -> Array:
        """All specific forces, m/s^2, shape (n, 3)."""
        return np.hstack([piece[3:] for piece in self.pieces]).T


@dataclass(frozen=True, slots=True, kw_only=True)
class StaticTriad:
    """A triad in its successive positions; two runs of rows with one name are two positions."""

    positions: tuple[TriadPosition, ...]
    metadata: Mapping[str, str] = field(default_factory=dict)


def read_table(path: Path, *, timed: bool = False) -> DwellTable | StaticTriad:
    """Read a table of either kind, told apart by the names of its columns; if `timed`, when a triad's positions were.

    Raises
    ------
    RecordError
        In one sentence: the file cannot be read, is no such table, or a row (line and column named) is no row of it.
    """
    try:
        with path.open("rb") as file:
            return _read(file, timed=timed)
    except RecordError as error:
        raise RecordError(f"{printable(str(path))}: {error}") from None
    except (OSError, ValueError) as error:  # ValueError: a path with a zero byte
        reason = error.strerror if isinstance(error, OSError) and error.strerror else "no valid path"
        raise RecordError(f"{printable(str(path))}: cannot be read: {reason}") from None


def _read(file: BinaryIO, *, timed: bool) -> DwellTable | StaticTriad:
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        raise RecordError("is no regular file")
    header = read_header(file)
    is_triad = any(name.startswith(("gyro_", "accel_")) for name in header.names)
    return _triad(file, header, timed=timed) if is_triad else _dwells(file, header)


def _columns(header: Header, wanted: Mapping[str, Mapping[str, float]]) -> tuple[list[int], Array]:
    """Return the index of each wanted column and the factors that take its unit to SI."""
    indices, factors = [], []
    for stem, units in wanted.items():
        found = [(i, factor) for unit, factor in units.items() for i in _places(header, f"{stem}_{unit}")]
        spellings = ", ".join(f"{stem}_{unit}" for unit in units)
        if not found:
            names = ", ".join(shown(name) for name in header.names[:12])
            raise RecordError(f"column {stem} is missing (one of {spellings}), found {names}")
        if len(found) > 1:
            raise RecordError(f"column {stem} is there {len(found)} times, expected one of {spellings}")
        indices.append(found[0][0])
        factors.append(found[0][1])
    return indices, np.array(factors)


def _places(header: Header, name: str) -> list[int]:
    return [i for i, there in enumerate(header.names) if there == name]


def _dwells(file: BinaryIO, header: Header) -> DwellTable:
    indices, factors = _columns(header, _DWELLS)
    number = _places(header, "dwell")[:1]
    pieces = [columns for _, columns in read_rows(file, header, indices + number)]
    if not pieces:
        raise RecordError("there are column names but no rows")
    columns = np.hstack(pieces)
    azimuth, elevation, duration, rate = columns[:4] * factors[:, np.newaxis]
    for wrong, what in (
        (np.abs(elevation) > math.radians(90.0) + 1e-9, "an elevation beyond 90 deg"),
        (duration <= 0.0, "a duration that is not positive"),
        (np.diff(columns[4:], prepend=-np.inf).ravel() <= 0.0, "a number that does not grow"),
    ):
        if wrong.any():
            raise RecordError(f"row {int(np.argmax(wrong)) + 1} of the dwells has {what}")
    return DwellTable(azimuth=azimuth, elevation=elevation, duration=duration, rate=rate, metadata=header.metadata)


def _triad(file: BinaryIO, header: Header, *, timed: bool) -> StaticTriad:
    indices, factors = _columns(header, _TRIAD | ({"time": {"s": 1.0}} if timed else {}))
    label = next(iter(_places(header, "position")), None)
    runs: list[tuple[str, list[Array]]] = []
    for name, columns in read_rows(file, header, indices, label):
        if not runs or runs[-1][0] != name:
            runs.append((name, []))
        np.multiply(columns, factors[:, np.newaxis], out=columns)
        runs[-1][1].append(columns)
        if len(runs) > MAX_POSITIONS:
            raise RecordError(
                f"there are more than {MAX_POSITIONS} positions: is column 'position' a name per position?"
            )
    if not runs:
        raise RecordError("there are column names but no rows")
    return StaticTriad(positions=tuple(_positions(runs)), metadata=header.metadata)


def _positions(runs: list[tuple[str, list[Array]]]) -> list[TriadPosition]:
    positions: list[TriadPosition] = []
    used: set[str] = set()
    for n, (label, pieces) in enumerate(runs, 1):
        name = label or "static"
        name = name if name not in used else f"{name}_{n}"
        used.add(name)
        interval = _interval(name, np.concatenate([piece[6] for piece in pieces])) if len(pieces[0]) > 6 else None
        positions.append(TriadPosition(name=name, pieces=tuple(piece[:6] for piece in pieces), interval=interval))
    return positions


def _interval(name: str, time: Array) -> tuple[float, float]:
    """Return start and duration of a position, a sample lasting as long as the mean distance of two."""
    if not np.all(np.diff(time) > 0.0):
        raise RecordError(f"position {shown(name)}: time_s does not grow from row to row")
    return float(time[0]), float(time[-1] - time[0]) * time.size / max(time.size - 1, 1)
