"""Grid azimuth and magnetic bearing: against published values, and where they cannot be had."""

from __future__ import annotations

import datetime as dt
import math
from pathlib import Path
from typing import Any

import ahrs
import pyproj
import pytest
from hypothesis import given
from hypothesis import strategies as st

from northfinder.errors import ConfigError
from northfinder.geodesy import (
    Place,
    Position,
    bearings_json,
    convergence,
    decimal_year,
    declination,
    parse_position,
    utm_epsg,
)

#: NOAA's test values of the model (public domain), as another package brings them.
WMM_TEST_VALUES = Path(ahrs.__file__).parent / "utils" / "WMM2025" / "WMM2025_TEST_VALUES.txt"


def at(latitude_deg: float, longitude_deg: float, height: float = 0.0) -> Position:
    """Return the position of angles in deg."""
    return Position(math.radians(latitude_deg), math.radians(longitude_deg), height)


def published_rows() -> list[list[float]]:
    """Return the rows of the published table: date, height km, latitude, longitude, X, Y, Z, H, F, I, D, ..."""
    lines = WMM_TEST_VALUES.read_text(encoding="ascii").splitlines()
    return [[float(value) for value in line.split()] for line in lines if line.strip() and not line.startswith("#")]


@pytest.mark.parametrize("row", published_rows())
def test_the_declination_is_the_published_one_to_its_last_digit(row: list[float]) -> None:
    """All rows of the WMM2025 test table agree, and the uncertainty is that of the published error model."""
    year, height_km, latitude, longitude, *_, horizontal, _, _, published = row[:11]
    found = declination(at(latitude, longitude, 1e3 * height_km), year)
    assert math.degrees(found.angle) == pytest.approx(published, abs=0.005 + 1e-9)
    assert math.degrees(found.sd) == pytest.approx(math.hypot(0.26, 5417.0 / horizontal), rel=1e-4)


def test_the_published_table_is_whole() -> None:
    """Twelve rows, both hemispheres, both dates: the test above has something to compare with."""
    rows = published_rows()
    assert len(rows) == 12
    assert {row[0] for row in rows} == {2025.0, 2027.5}
    assert {row[2] for row in rows} == {80.0, 0.0, -80.0}


def test_the_convergence_is_the_published_one_to_its_last_digit() -> None:
    """The value in pyproj's own tests: UTM zone 10N on NAD83(NSRS2007) at longitude -120, latitude 34."""
    assert math.degrees(convergence(at(34.0, -120.0), 3717).angle) == pytest.approx(1.67864770, abs=0.5e-8)


def test_the_convergence_has_the_sign_of_surveyors() -> None:
    """East of the central meridian grid north is east of true north on the northern hemisphere, west on the southern;
    to second order it is the difference of longitude times the sine of the latitude.
    """
    for latitude, epsg in ((50.0, 32636), (-50.0, 32736)):
        for off in (-1.0, 1.0):
            angle = math.degrees(convergence(at(latitude, 33.0 + off), epsg).angle)
            assert angle == pytest.approx(off * math.sin(math.radians(latitude)), abs=1e-3)


@pytest.mark.parametrize(
    ("epsg", "latitude", "longitude"),
    [(32631, 0.1, 3.5), (32736, -33.0, 31.0), (27572, 46.0, 5.0), (27700, 52.0, 1.0), (2193, -41.0, 175.0),
     (31467, 50.0, 9.7), (28355, -35.0, 149.0), (2056, 47.0, 9.0), (5514, 49.5, 15.0)],
)  # fmt: skip
def test_the_convergence_is_the_direction_of_a_mapped_meridian(epsg: int, latitude: float, longitude: float) -> None:
    """Grids of any datum, prime meridian, unit and order of axes: a short step north leads there on the map.

    But for some arc seconds by which old datums are turned against WGS 84.
    """
    angle = convergence(at(latitude, longitude), epsg).angle
    to_map = pyproj.Transformer.from_crs("EPSG:4326", f"EPSG:{epsg}", always_xy=True)
    (x0, x1), (y0, y1) = to_map.transform([longitude, longitude], [latitude - 1e-3, latitude + 1e-3])
    assert angle == pytest.approx(-math.atan2(x1 - x0, y1 - y0), abs=6e-5)


@pytest.mark.parametrize(
    ("latitude", "longitude", "epsg"),
    [(50.4, 30.5, 32636), (-33.9, 18.4, 32734), (0.0, -180.0, 32601), (10.0, 180.0, 32601), (10.0, 359.0, 32630),
     (60.4, 5.3, 32632), (55.9, 5.3, 32631), (78.2, 15.6, 32633), (73.0, 8.0, 32631), (73.0, 41.9, 32637),
     (84.0, 0.0, None), (-80.1, 0.0, None), (83.9, 50.0, 32639)],
)  # fmt: skip
def test_the_zone_of_utm(latitude: float, longitude: float, epsg: int | None) -> None:
    """Zones of both hemispheres, their edges, the wider ones of Norway and Svalbard, none at the poles."""
    assert utm_epsg(at(latitude, longitude)) == epsg


@pytest.mark.parametrize(
    ("text", "words"),
    [("north", "cannot be read"), ("50", "cannot be read"), ("1,2,3,4", "cannot be read"), ("nan,0", "cannot be read"),
     ("91,0", "latitude is 91"), ("0,361", "longitude is 361"), ("0,0,1e9", "height is 1e"), ("1,\x1b[2J", r"\?\[2J")],
)  # fmt: skip
def test_a_wrong_position_is_named(text: str, words: str) -> None:
    """The message says what was found and what was expected, in printable characters."""
    with pytest.raises(ConfigError, match=words):
        parse_position(text)


@given(st.floats(-90, 90), st.floats(-180, 360), st.floats(-1000, 850000))
def test_a_position_comes_through_a_record(latitude: float, longitude: float, height: float) -> None:
    """What is kept as plain data is the same place again, whatever the numbers."""
    place = Place(parse_position(f"{latitude!r},{longitude!r},{height!r}"), 32636)
    again = Place.from_json(place.to_json())
    assert again is not None
    assert again.epsg == 32636
    assert again.position.latitude == pytest.approx(place.position.latitude, abs=1e-12)
    assert again.position.longitude == pytest.approx(place.position.longitude, abs=1e-12)
    assert again.position.height == height


@pytest.mark.parametrize("value", [None, 3, "text", [], {}, {"latitude_deg": "x"}, {"latitude_deg": 99, "epsg": None}])
def test_what_is_no_position_in_a_record_is_none(value: object) -> None:
    """A foreign or altered record cannot make the report fail."""
    assert Place.from_json(value) is None


@pytest.mark.parametrize(
    ("epsg", "words"), [(4326, "no projection"), (2053, "south and west"), (5513, "south and west"), (999999, "999999")]
)
def test_a_grid_without_grid_north_is_refused(epsg: int, words: str) -> None:
    """Geographic systems, axes that point elsewhere, codes that are none: before anything is measured."""
    with pytest.raises(ConfigError, match=words):
        Place.of("50,30", epsg)


def test_a_grid_needs_a_position() -> None:
    """An EPSG code alone says nothing."""
    assert Place.of(None, None) is None
    with pytest.raises(ConfigError, match="position"):
        Place.of(None, 32636)


def test_the_decimal_year() -> None:
    """The part of the year that has passed, in leap years too."""
    assert decimal_year(dt.date(2025, 1, 1)) == 2025.0
    assert decimal_year(dt.date(2028, 7, 2)) == pytest.approx(2028 + 183 / 366)


def result(latitude: float | None = 50.0, sd: float | None = 0.1) -> dict[str, Any]:
    """Return what of a fix the bearings are made from."""
    return {
        "azimuth_deg": 1.0, "azimuth_sd_deg": 0.1, "latitude_deg": latitude, "latitude_sd_deg": sd, "checks": ["other"],
    }  # fmt: skip


def test_bearings_are_the_azimuth_from_other_norths() -> None:
    """Grid azimuth and magnetic bearing lie in [0, 360); the model's uncertainty is added to that of the bearing."""
    said = bearings_json(Place(at(50.05, 30.5)), result(), dt.date(2026, 11, 22))
    grid, magnetic = said["grid"], said["magnetic"]
    assert grid["azimuth_deg"] == pytest.approx(1.0 - grid["convergence_deg"])
    assert grid["azimuth_sd_deg"] == 0.1
    assert magnetic["bearing_deg"] == pytest.approx(361.0 - magnetic["declination_deg"])
    assert magnetic["bearing_sd_deg"] == pytest.approx(math.hypot(0.1, magnetic["declination_sd_deg"]))
    assert (magnetic["model"], magnetic["valid_until"]) == ("WMM-2025", "2030-01-01")


@pytest.mark.parametrize(("latitude", "passed"), [(50.1, True), (50.2, True), (51.0, False), (49.0, False)])
def test_the_position_checks_the_measured_latitude(latitude: float, passed: bool) -> None:  # noqa: FBT001  # a case
    """A latitude further off than chance allows is said, as a warning: the fix does not rest on the position."""
    checks = bearings_json(Place(at(50.0, 30.5)), result(latitude), dt.date(2026, 11, 22))["checks"]
    assert checks[0] == "other"
    assert (checks[1]["name"], checks[1]["passed"], checks[1]["decisive"]) == ("position", passed, False)
    assert ("does not agree" in checks[1]["sentence"]) is not passed


@pytest.mark.parametrize(("latitude", "passed"), [(50.0, True), (50.0009, True), (49.98, False), (-50.0, False)])
def test_a_latitude_that_was_given_may_be_rounded(latitude: float, passed: bool) -> None:  # noqa: FBT001  # a case
    """A thousandth of a degree is no slip, and no reason for a warning; the wrong hemisphere is."""
    (_, check) = bearings_json(Place(at(50.0, 30.5)), result(latitude, 0.0), dt.date(2026, 11, 22))["checks"]
    assert check["passed"] is passed
    assert check["limit"] > 0.0
    assert check["sentence"].startswith("the given latitude " + ("agrees" if passed else "does not agree"))


def test_a_latitude_that_was_not_measured_is_not_checked() -> None:
    """There is nothing to compare."""
    said = bearings_json(Place(at(50.0, 30.5)), result(None, None), dt.date(2026, 11, 22))
    assert "checks" not in said


@pytest.mark.parametrize(
    ("date", "words"), [(dt.date(2024, 12, 31), "2025-01-01"), (dt.date(2030, 1, 1), "2030-01-01")]
)
def test_the_model_is_not_used_beyond_its_time(date: dt.date, words: str) -> None:
    """Outside of its validity the report says so in one sentence, and has no bearing."""
    magnetic = bearings_json(Place(at(50.0, 30.5)), result(), date)["magnetic"]
    assert "bearing_deg" not in magnetic
    assert words in magnetic["reason"]


def test_no_compass_at_the_magnetic_pole_and_no_zone_at_the_north_pole() -> None:
    """Both are said, neither is a failure."""
    said = bearings_json(Place(at(86.0, 142.0)), result(86.0), dt.date(2026, 1, 1))
    assert "no compass" in said["magnetic"]["reason"]
    assert "UTM" in said["grid"]["reason"]
