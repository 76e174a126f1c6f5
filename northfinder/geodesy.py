"""From the true azimuth to those of a map and of a compass, where the position is known (docs/method.md, section 12).

grid azimuth     = true azimuth - meridian convergence     grid north east of true north is positive
magnetic bearing = true azimuth - declination              magnetic north east of true north is positive
"""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from northfinder.errors import ConfigError
from northfinder.estimation.checks import Check, agreement
from northfinder.text import printable

#: Latitudes in deg for which UTM zones are defined.
_UTM_SOUTH, _UTM_NORTH = -80.0, 84.0
#: Heights in m for which the magnetic model is made.
_HEIGHTS = (-1_000.0, 850_000.0)
#: By so many deg, about 1 km, a latitude given as exact may differ from that of the position: either may be rounded.
_ROUNDED = 0.01
#: Below so many nT of horizontal intensity compasses, and the model's declination with them, are unreliable.
_BLACKOUT = 2000.0
_POSITION_FORM = "LAT,LON[,HEIGHT] in deg and m, such as 50.429,30.523,170"


@dataclass(frozen=True, slots=True)
class Position:
    """Where the instrument stands, in WGS 84."""

    latitude: float  #: rad, north positive
    longitude: float  #: rad, east positive
    height: float = 0.0  #: m above the ellipsoid; the sea level does as well here


@dataclass(frozen=True, slots=True, kw_only=True)
class Convergence:
    """Direction of grid north."""

    angle: float  #: rad, of grid north from true north, east positive
    epsg: int
    name: str  #: of the coordinate reference system


@dataclass(frozen=True, slots=True, kw_only=True)
class Declination:
    """Direction of magnetic north, by the World Magnetic Model."""

    angle: float  #: rad, of magnetic north from true north, east positive
    sd: float  #: rad, by the model's own error model
    model: str
    valid_from: dt.date
    valid_until: dt.date  #: the first day on which the model does not hold


def parse_position(text: str) -> Position:
    """Return the position of ``LAT,LON[,HEIGHT]`` in deg and m. Raises ConfigError.

    >>> parse_position("0,90,12").height
    12.0
    """
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in {2, 3} or not all(map(math.isfinite, values)):
        raise ConfigError(f"the position {printable(text)!r} cannot be read: expected {_POSITION_FORM}")
    latitude, longitude, *height = values
    for name, value, low, high, unit in (
        ("latitude", latitude, -90.0, 90.0, "deg"),
        ("longitude", longitude, -180.0, 360.0, "deg"),
        ("height", height[0] if height else 0.0, *_HEIGHTS, "m"),
    ):
        if not low <= value <= high:
            raise ConfigError(f"the position's {name} is {value:g}: expected {low:g} to {high:g} {unit}")
    return Position(math.radians(latitude), math.radians(longitude), *height)


def utm_epsg(position: Position) -> int | None:
    """Return the EPSG code of the UTM zone, with the wider zones of Norway and Svalbard; None beyond all zones."""
    latitude, longitude = math.degrees(position.latitude), math.degrees(position.longitude)
    if not _UTM_SOUTH <= latitude < _UTM_NORTH:
        return None
    longitude = (longitude + 180.0) % 360.0 - 180.0
    zone = math.floor((longitude + 180.0) / 6.0) + 1
    if 56.0 <= latitude < 64.0 and 3.0 <= longitude < 12.0:
        zone = 32
    if latitude >= 72.0 and 0.0 <= longitude < 42.0:
        zone = 31 + 2 * math.floor((longitude + 3.0) / 12.0)
    return (32600 if latitude >= 0.0 else 32700) + zone


def convergence(position: Position, epsg: int) -> Convergence:
    """Return where grid north is in the projected coordinate reference system `epsg`.

    Raises ConfigError if there is no such system, if its axes do not point east and north, or if the position lies
    outside of what it can map.
    """
    import pyproj  # noqa: PLC0415  # heavy, and only a position needs it
    from pyproj.exceptions import CRSError  # noqa: PLC0415

    try:
        crs = pyproj.CRS.from_epsg(epsg)
    except CRSError:
        raise ConfigError(f"no coordinate reference system has the EPSG code {epsg}") from None
    directions = {axis.direction for axis in crs.axis_info}
    geodetic = crs.geodetic_crs
    if not crs.is_projected or directions != {"east", "north"} or geodetic is None:
        found = f"its axes point {' and '.join(sorted(directions))}" if crs.is_projected else "it is no projection"
        raise ConfigError(f"EPSG:{epsg}, {crs.name}, has no grid north: {found}")
    # The system's own datum and prime meridian, in its own unit.
    unit = geodetic.axis_info[0].unit_conversion_factor
    own = pyproj.Transformer.from_crs("EPSG:4326", geodetic, always_xy=True)
    longitude, latitude = own.transform(math.degrees(position.longitude), math.degrees(position.latitude))
    factors = pyproj.Proj(crs).get_factors(longitude * unit, latitude * unit, radians=True)
    angle = math.radians(factors.meridian_convergence)
    if not math.isfinite(angle):
        raise ConfigError(f"the position lies outside of what EPSG:{epsg}, {crs.name}, can map")
    return Convergence(angle=angle, epsg=epsg, name=crs.name)


def decimal_year(date: dt.date) -> float:
    """Return the year with the part of it that has passed at the beginning of `date`, 365 or 366 days alike."""
    first = dt.date(date.year, 1, 1)
    return date.year + (date - first).days / (dt.date(date.year + 1, 1, 1) - first).days


def declination(position: Position, year: float) -> Declination:
    """Return where magnetic north is at a decimal year.

    Its standard deviation is that of the model's error model, ``sqrt(0.26^2 + (5417 nT/H)^2)`` deg in WMM2025, which
    allows for the field of the earth's crust but for nothing of iron or current nearby.

    Raises ConfigError outside of the years for which the model holds, and where the field is too steep for a compass.
    """
    from pygeomag import GeoMag  # noqa: PLC0415  # only a position needs it

    model = GeoMag()
    begin, end = model.life_span
    valid_from, valid_until = dt.date(int(begin), 1, 1), dt.date(int(end), 1, 1)
    if not begin <= year < end:
        raise ConfigError(
            f"the magnetic model {model.model} holds from {valid_from} to {valid_until}, not in {year:.1f}"
        )
    field = model.calculate(
        glat=math.degrees(position.latitude),
        glon=math.degrees(position.longitude),
        alt=position.height / 1e3,
        time=year,
    )
    if field.h < _BLACKOUT:
        raise ConfigError(f"no compass can be used here: the horizontal magnetic field is {field.h:.0f} nT only")
    return Declination(
        angle=math.radians(field.d),
        sd=math.radians(field.calculate_uncertainty().d),
        model=model.model,
        valid_from=valid_from,
        valid_until=valid_until,
    )


@dataclass(frozen=True, slots=True)
class Place:
    """A position, and the grid in which it is wanted."""

    position: Position
    epsg: int | None = None  #: None for the UTM zone

    @classmethod
    def of(cls, position: str | None, epsg: int | None) -> Place | None:
        """Return the place that options or a configuration name, None without a position. Raises ConfigError."""
        if position is None:
            if epsg is not None:
                raise ConfigError("the EPSG code of a grid needs a position: give both")
            return None
        place = cls(parse_position(position), epsg)
        place.convergence()  # complains now, rather than after the measurement
        return place

    @classmethod
    def from_json(cls, value: object) -> Place | None:
        """Return the place that `to_json` gave, None if it is no such thing."""
        try:
            table = dict(value)  # type: ignore[call-overload]  # whatever a file holds; checked by the attempt
            epsg = None if table["epsg"] is None else int(table["epsg"])
            numbers = [float(table[name]) for name in ("latitude_deg", "longitude_deg", "height_m")]
            return cls(parse_position(",".join(map(repr, numbers))), epsg)
        except (TypeError, KeyError, ValueError, ConfigError):
            return None

    def to_json(self) -> dict[str, Any]:
        """Return it as plain data."""
        position = self.position
        return {
            "latitude_deg": math.degrees(position.latitude),
            "longitude_deg": math.degrees(position.longitude),
            "height_m": position.height,
            "epsg": self.epsg,
        }

    def convergence(self) -> Convergence | None:
        """Return where grid north is, None if no grid was asked for and no UTM zone is defined here."""
        epsg = utm_epsg(self.position) if self.epsg is None else self.epsg
        return None if epsg is None else convergence(self.position, epsg)


def bearings_json(place: Place, result: Mapping[str, Any], date: dt.date) -> dict[str, Any]:
    """Return what the result of a measurement on `date` is on a map and by a compass, as plain data.

    The position's latitude is not used in the fix; where the fix measured one, a check compares the two.
    """
    said: dict[str, Any] = {"position": place.to_json()}
    said["grid"] = _grid_json(place, result)
    said["magnetic"] = _magnetic_json(place, result, date)
    check = position_check(place.position, result)
    return said | ({} if check is None else {"checks": [*result["checks"], check]})


def _grid_json(place: Place, result: Mapping[str, Any]) -> dict[str, Any]:
    grid = place.convergence()
    if grid is None:
        return {"reason": "no UTM zone is defined at this latitude: name a grid by its EPSG code"}
    return {
        "azimuth_deg": (result["azimuth_deg"] - math.degrees(grid.angle)) % 360.0,
        "azimuth_sd_deg": result["azimuth_sd_deg"],
        "convergence_deg": math.degrees(grid.angle),
        "epsg": grid.epsg,
        "name": grid.name,
    }


def _magnetic_json(place: Place, result: Mapping[str, Any], date: dt.date) -> dict[str, Any]:
    try:
        found = declination(place.position, decimal_year(date))
    except ConfigError as error:
        return {"date": str(date), "reason": str(error)}
    return {
        "bearing_deg": (result["azimuth_deg"] - math.degrees(found.angle)) % 360.0,
        "bearing_sd_deg": math.hypot(result["azimuth_sd_deg"], math.degrees(found.sd)),
        "declination_deg": math.degrees(found.angle),
        "declination_sd_deg": math.degrees(found.sd),
        "model": found.model,
        "date": str(date),
        "valid_from": str(found.valid_from),
        "valid_until": str(found.valid_until),
    }


def position_check(position: Position, result: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return whether the latitude of a result agrees with the position's, None if the result has none.

    It is not decisive: the fix does not rest on the position. A latitude that was given exactly may be rounded.
    """
    if result["latitude_deg"] is None:
        return None
    difference = math.radians(result["latitude_deg"]) - position.latitude
    sd = math.radians(result["latitude_sd_deg"])
    check: Check = agreement("latitude", difference, sd, "rad", math.inf)
    limit = math.degrees(check.limit) if sd else _ROUNDED
    passed = abs(math.degrees(difference)) <= limit
    measured = "measured" if sd else "given"
    figures = f"it differs by {math.degrees(difference):.3g} deg, limit {limit:.2g} deg"
    return {
        "name": "position",
        "passed": passed,
        "decisive": False,
        "value": math.degrees(difference),
        "sd": math.degrees(sd),
        "limit": limit,
        "unit": "deg",
        "sentence": f"the {measured} latitude {'agrees' if passed else 'does not agree'} with the position: {figures}",
    }
