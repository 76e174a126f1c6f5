"""The report: what is measured is what is shown, in every format; nothing in a record can reach out of the page."""

from __future__ import annotations

import contextlib
import json
import math
import re
import shutil
import sqlite3
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result
from hypothesis import given, settings
from hypothesis import strategies as st
from long_record import write_record
from look import HOSTILE, HOSTILE_NAME, Chromium, browser
from look import measure as look_measure
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text
from virtual import Unwatched, assume, virtual_bench

from drivers.api import DeviceIdentity
from northfinder.adaptive import Wishes, make_plan
from northfinder.cli import cli
from northfinder.errors import ConfigError, RecordError
from northfinder.estimation.allan import averaging_factors, overlapping_allan_deviation
from northfinder.estimation.means import RateMeans
from northfinder.geodesy import Place
from northfinder.measurement import Measurement, measure
from northfinder.record.schema import INSERT, NAMES, sealed
from northfinder.report.axes import Axis
from northfinder.report.campaign import of_the_mean
from northfinder.report.charts import Line, Mark, broken, charts, dwell_pairs, moving_average, pooled_allan
from northfinder.report.compass import rose
from northfinder.report.content import azimuth_figure, budget_lines, method_rows, other_figures, standing
from northfinder.report.document import record_json, record_markdown
from northfinder.report.figures import report_style
from northfinder.report.gather import RecordReport, gather_record
from northfinder.report.page import record_page
from northfinder.report.paper import record_pages
from northfinder.report.series import Envelope, thinned
from northfinder.solve_file import solve_record

#: Seconds of each dwell of the emulated measurement, and when it began.
DWELL = 15.0
IN_2026 = 1_790_000_000.0
#: Elements that hold no others.
VOID = {"meta", "link", "br", "path", "circle", "rect"}
URL_ATTRIBUTES = {"src", "href", "action", "data", "poster", "srcset", "xlink:href", "background", "formaction"}


class Page(HTMLParser):
    """A page as a browser sees it: its elements, its texts, and whether its elements are nested properly."""

    def __init__(self, text: str) -> None:
        """Read the page."""
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[str] = []
        self.open: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note an element."""
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note an element that is closed at once."""
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        """Note that an element ends, which must be the last one opened."""
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        """Note a text, but for the style."""
        if "style" not in self.open:
            self.texts.append(data)

    @property
    def text(self) -> str:
        """All texts, blanks made one."""
        return " ".join(" ".join(self.texts).split())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder for the records of this module."""
    return tmp_path_factory.mktemp("records")


@pytest.fixture(scope="module")
def emulated(folder: Path) -> Path:
    """Return the record of an emulated measurement of six positions, and back to the first between and at the end."""
    path = folder / "emulated.sqlite"
    bench = virtual_bench(azimuth_deg=213.0)
    measurement = Measurement(
        open_gyro=bench.open_gyro, open_stage=bench.open_stage, settle=0.5, assumptions=assume(), record=path,
        plan=make_plan(Wishes(name="six-position", dwell=DWELL), assume(), settle=0.5),
    )  # fmt: skip
    measure(measurement, clock=bench.clock, utc=lambda: IN_2026 + bench.clock.now(), watcher=Unwatched())
    return path


@pytest.fixture(scope="module")
def report(emulated: Path) -> RecordReport:
    """Return the report of it, at a known position."""
    return gather_record(emulated, Place.of("50.429,30.523,170", None))


@pytest.fixture(scope="module")
def hostile(folder: Path) -> Path:
    """Return a record whose devices, plan and notes want to do harm."""
    path = folder / "hostile.sqlite"
    gyro = DeviceIdentity(kind="gyro", model=HOSTILE, serial_number=HOSTILE_NAME, firmware_version="\x00\n\x9b")
    meta = {"northfinder": HOSTILE, "plan": {"name": HOSTILE}, "config": {"gyro": {"address": HOSTILE}}}
    events = [("note", HOSTILE), (HOSTILE_NAME, HOSTILE)]
    devices = {"gyro": gyro}
    write_record(path, seconds=120.0, sample_rate=50.0, n_axes=1, n_dwells=6, identities=devices,
                 meta=meta | {"identities": devices}, events=events)  # fmt: skip
    return path


@pytest.fixture(scope="module")
def early(folder: Path) -> Path:
    """Return a record that determines no azimuth."""
    path = folder / "early.sqlite"
    write_record(path, seconds=40.0, sample_rate=50.0, n_axes=1, n_dwells=1)
    return path


@pytest.fixture(scope="module")
def axes(folder: Path) -> Path:
    """Return a record of three axes with more dwells than are drawn one by one."""
    path = folder / "axes.sqlite"
    write_record(path, seconds=1000.0, sample_rate=20.0, n_axes=3, n_dwells=60)
    return path


# Series


@given(st.lists(st.integers(1, 400), min_size=1, max_size=12), st.integers(0, 50), st.integers(0, 2**32))
def test_an_envelope_is_the_same_however_the_samples_come(sizes: list[int], gap: int, seed: int) -> None:
    """Least, greatest and mean of each stretch are those of its samples, whatever the batches and the gaps."""
    rng = np.random.default_rng(seed)
    envelope, values, places, index = Envelope(2, n_bins=16), [], [], 0
    for size in sizes:
        batch = rng.normal(size=(size, 2))
        envelope.add(index, batch)
        values.append(batch)
        places.append(np.arange(index, index + size))
        index += size + gap
    found = envelope.series()
    every, place = np.concatenate(values), np.concatenate(places)
    width = 2 * (found.x[0] - 0.0) if found.x[0] else 1.0
    bins = (place // width).astype(int)
    assert len(found.x) <= 16
    for row, x in enumerate(found.x):
        own = every[bins == int(x // width)]
        assert found.low[row] == pytest.approx(own.min(axis=0))
        assert found.high[row] == pytest.approx(own.max(axis=0))
        assert found.mean[row] == pytest.approx(own.mean(axis=0))


@given(st.integers(2, 5000), st.integers(2, 60), st.integers(0, 2**32))
def test_thinning_keeps_the_ends_and_the_peaks(n: int, n_columns: int, seed: int) -> None:
    """A line drawn from two points a column shows the same extremes."""
    x, y = np.arange(n, dtype=float), np.random.default_rng(seed).normal(size=n)
    thin_x, thin_y = thinned(x, y, n_columns=n_columns)
    assert len(thin_x) <= 2 * n_columns + 2
    assert (thin_y.min(), thin_y.max(), thin_x[0], thin_x[-1]) == (y.min(), y.max(), 0.0, n - 1.0)
    assert np.all(np.diff(thin_x) > 0)
    assert np.array_equal(y[thin_x.astype(int)], thin_y)


def test_a_line_is_broken_between_dwells() -> None:
    """Nothing is drawn where nothing was measured."""
    x, _ = broken(np.arange(6.0), np.arange(6.0), np.array([0, 0, 0, 1, 1, 1]))
    assert np.flatnonzero(np.isnan(x)).tolist() == [3]


@given(st.floats(-1e5, 1e5), st.floats(1e-3, 1e6))
def test_ticks_lie_within_their_axis_and_are_told_apart(low: float, span: float) -> None:
    """At most ten round values, no two with the same text."""
    ticks = Axis(low, low + span, most=9).ticks()
    assert len(ticks) <= 10
    assert all(low - 1e-6 * span <= value <= low + span * (1 + 1e-6) for value, _ in ticks)
    assert len({text for _, text in ticks}) == len(ticks)


def test_the_pooled_allan_deviation_of_one_run_is_the_usual_one() -> None:
    """And with two runs the squares are weighted by how many differences each gives."""
    rate = np.random.default_rng(3).normal(size=120)
    start = np.concatenate([np.arange(80.0), 100.0 + np.arange(40.0)])
    means = RateMeans(
        start=start, duration=np.ones(120), rate=rate, azimuth=np.zeros(120), elevation=np.zeros(120),
        dwell=np.repeat([0, 1], [80, 40]),
    )  # fmt: skip
    alone = pooled_allan(means.select(means.dwell == 0), None)
    both = pooled_allan(means, None)
    assert alone is not None
    assert both is not None
    dph = math.radians(1.0) / 3600.0
    expected = overlapping_allan_deviation(rate[:80], averaging_factors(80)) / dph
    assert alone.deviation[:, 0] == pytest.approx(expected)
    first, second = (overlapping_allan_deviation(part, np.array([1])) / dph for part in (rate[:80], rate[80:]))
    assert both.deviation[0, 0] ** 2 == pytest.approx(float((79 * first**2 + 39 * second**2)[0] / 118))


# What is said


def test_the_report_gives_the_fix_of_solve(report: RecordReport, emulated: Path) -> None:
    """To the last bit, with the bearings of the position given."""
    solved = solve_record(emulated, place=Place.of("50.429,30.523,170", None))
    assert report.result == solved
    assert "grid" in report.result


def test_intervals_are_of_95_percent(report: RecordReport) -> None:
    """The answer is the azimuth with 1.96 standard deviations, to two digits of them."""
    figure = azimuth_figure(report)
    assert figure is not None
    assert float(figure.value.rstrip("°")) == pytest.approx(report.result["azimuth_deg"], abs=0.05)
    half = 1.959964 * report.result["azimuth_sd_deg"]
    assert float(figure.interval.rstrip("°")) == pytest.approx(half, rel=0.06)
    assert [each.name for each in other_figures(report)] == ["Latitude", "Grid azimuth", "Magnetic bearing"]
    assert all(each.value and each.interval for each in other_figures(report))
    assert standing(report)[0]


def test_dwells_are_shown_as_measured(report: RecordReport) -> None:
    """Eight dwells; their samples scatter as published, and averaging takes the scatter away."""
    pairs = dwell_pairs(report)
    assert [pair.dwell.span.name for pair in pairs] == ["U1", "U2", "U3", "U4", "U1", "U5", "U6", "U1"]
    dph = math.radians(1.0) / 3600.0
    assert [float(pair.dwell.raw_sd[0]) / dph for pair in pairs] == pytest.approx([254.0] * 8, rel=0.1)
    assert [int(pair.dwell.n_samples) for pair in pairs] == [round(DWELL * 235)] * 8
    assert report.means is not None
    assert pairs[1].mean[0] == pytest.approx(float(report.means.rate[15:30, 0].mean()) / dph)
    raw, averaged = (pairs[0].raw.y_range, pairs[0].averaged.y_range)
    assert raw is not None
    assert averaged is not None
    assert raw[1] > 100.0 * averaged[1]


@pytest.mark.parametrize("window", [1.0, 4.0, 5.0, 60.0])
def test_a_moving_average_stands_in_the_middle_of_what_it_averages(window: float) -> None:
    """A ramp stays where it is, whether an even or an odd number of values is averaged."""
    x, y = moving_average(np.arange(60.0) + 0.5, 3.0 * (np.arange(60.0) + 0.5), window)
    assert len(x) == 60 - round(window) + 1
    assert y == pytest.approx(3.0 * x)


def test_the_stage_is_drawn_in_the_time_of_the_samples(report: RecordReport) -> None:
    """At the middle of each dwell the drawn path stands where the dwell was measured, though its clock is another."""
    assert report.stage is not None
    for dwell in report.dwells:
        middle = (dwell.start + dwell.stop) / 2
        for drawn, measured in ((report.stage.azimuth, dwell.span.measured_azimuth),
                                (report.stage.elevation, dwell.span.measured_elevation)):  # fmt: skip
            assert np.interp(middle, report.stage.time, drawn) == pytest.approx(measured, abs=1e-6)


def test_what_adds_nothing_to_the_uncertainty_has_no_bar(report: RecordReport) -> None:
    """It is named instead; the bars add up, in quadrature, to what is stated."""
    lines, idle = budget_lines(report)
    shares = [0.0 if line.azimuth == "none" else float(line.azimuth.rstrip("°")) for line in lines]
    assert math.hypot(*shares) == pytest.approx(report.result["azimuth_sd_deg"], abs=1e-4 * len(lines))
    assert all(line.azimuth != "none" or line.latitude != "none" for line in lines)
    budget = [dict(line) for line in report.result["budget"]]
    budget[0] |= {"azimuth_deg": 0.0, "latitude_deg": 1e-12}
    budget[1] |= {"azimuth_deg": 3e-5}
    others, more = budget_lines(replace(report, result=report.result | {"budget": budget}))
    assert [line.quantity for line in others] == [line.quantity for line in lines[1:]]
    assert others[0].azimuth == "< 0.0001°"
    assert more == [f"Without effect on this measurement: {lines[0].quantity}.", *idle]
    widened = budget_lines(replace(report, result=report.result | {"rescaled_by": 1.694}))[1]
    assert widened == ["The noise is 1.69 times the profile's, as the residuals ask.", *idle]


def test_published_formulas_stand_with_their_intervals(report: RecordReport) -> None:
    """They differ from the fix, and a reader must see that they may."""
    said = dict(method_rows(report))["published formulas"]
    closed = report.result["closed_form"]
    assert f"azimuth {closed['azimuth_deg']:.3f}° ± {1.959964 * closed['azimuth_sd_deg']:.3f}° by (2)" in said
    assert f"± {1.959964 * closed['latitude_sd_deg']:.3f}° by (3)" in said


def test_dwells_are_named_where_there_is_room(report: RecordReport) -> None:
    """By name if they are few, else by number, as they are drawn below; a long name in a short dwell not at all."""
    assert [mark.name for mark in _rate_marks(report)] == ["U1", "U2", "U3", "U4", "U1", "U5", "U6", "U1"]
    many = replace(report, dwells=report.dwells * 2)
    assert [mark.name for mark in _rate_marks(many)] == [str(number) for number in range(1, 17)]
    long = [
        replace(each, span=replace(each.span, name="a name of forty letters, more or less so"))
        for each in report.dwells
    ]
    assert [mark.name for mark in _rate_marks(replace(report, dwells=(long[0], *report.dwells[1:])))][:2] == ["", "U2"]
    assert [mark.name for mark in _rate_marks(replace(report, dwells=tuple(long)))] == [str(n) for n in range(1, 9)]


def _rate_marks(report: RecordReport) -> tuple[Mark, ...]:
    return next(chart.marks for chart in charts(report) if chart.name == "rate")


def test_tilt_and_temperature_are_not_drawn_between_dwells(axes: Path) -> None:
    """Nothing was measured there: the line is broken, and no point of it lies outside of a dwell."""
    report = gather_record(axes)
    report = replace(report, dwells=report.dwells[:5])
    line = next(chart.items[0] for chart in charts(report) if chart.name == "temperature")
    assert isinstance(line, Line)
    last = report.dwells[-1].stop / 60.0
    drawn = line.x[line.x <= last]
    assert all(any(d.start / 60.0 <= x <= d.stop / 60.0 for d in report.dwells) for x in drawn)
    assert np.isnan(line.x).sum() == 4


def test_angles_have_ticks_at_parts_of_a_circle() -> None:
    """A stage that turns once around has ticks each quarter; a small angle has decimal ones."""
    assert [text for _, text in Axis(-10.0, 370.0, angles=True).ticks()] == ["0", "90", "180", "270", "360"]
    assert [text for _, text in Axis(-0.1, 0.11, angles=True).ticks()] == ["−0.10", "−0.05", "0.00", "0.05", "0.10"]


# The page


def check_self_contained(page: Page) -> None:
    """Check that nothing of the page asks for anything or runs anything."""
    assert not page.open
    tags = {tag for tag, _ in page.elements}
    assert not tags & {"script", "iframe", "object", "embed", "img", "form", "base", "image", "use", "foreignobject"}
    policies = [a["content"] for _, a in page.elements if a.get("http-equiv") == "Content-Security-Policy"]
    assert len(policies) == 1
    assert str(policies[0]).startswith("default-src 'none'; style-src 'unsafe-inline'; img-src data:;")
    for _, attributes in page.elements:
        assert not [name for name in attributes if name.startswith("on")]
        assert all(str(attributes[name]).startswith("data:") for name in URL_ATTRIBUTES & set(attributes))
        assert "url(" not in str(attributes.get("style"))


def test_the_page_holds_everything_asked_for(report: RecordReport) -> None:
    """One well-formed, self-contained page with all sections, light, dark and for paper."""
    text = record_page(report)
    page = Page(text)
    check_self_contained(page)
    for words in (
        "Azimuth", "Latitude", "Grid azimuth", "Magnetic bearing", "Checks", "What the uncertainty is made of",
        "Rate against time", "Each dwell without and with averaging", "Residuals", "Allan deviation of the residuals",
        "Stage angles", "Tilt", "Temperature", "How it was computed", "Instrument and software", "SIM-G1", "WMM-2025",
        "UTM zone 36N", "the measured latitude agrees with the position", "passed", "bias instability",
    ):  # fmt: skip
        assert words in page.text, words
    assert "prefers-color-scheme: dark" in text
    assert "@page { size: A4" in text
    assert "url(" not in text
    assert "@import" not in text
    labels = [a.get("aria-label") for tag, a in page.elements if tag == "svg"]
    assert all(labels)
    assert len(labels) == 2 + 2 * 8 + len(charts(report))


def test_the_numbers_drawn_are_numbers(report: RecordReport) -> None:
    """No path holds a nan or an infinity, which a browser would drop without a word."""
    drawn = [str(a["d"]) for tag, a in Page(record_page(report)).elements if tag == "path"]
    assert len(drawn) > 20
    assert all(re.fullmatch(r"[MLHVAZ0-9 .\-lv]*", each) for each in drawn)


def test_nothing_in_a_record_does_anything(hostile: Path) -> None:
    """Names and notes with markup, scripts, escape codes and turned text are shown as text, or as question marks."""
    report = gather_record(hostile)
    text = record_page(report)
    check_self_contained(Page(text))
    assert "<script>document" not in text
    assert "&lt;script&gt;document" in text
    for shown in (text, record_markdown(report)):
        assert not [character for character in shown if not character.isprintable() and character != "\n"]
    assert "\\<script\\>document" in record_markdown(report)
    assert not re.search(r"(?<!\\)<", record_markdown(report))
    assert "49" not in Page(text).text.split("{{")[1][:12]


@settings(max_examples=50)
@given(st.text(max_size=60))
def test_any_name_is_shown_or_replaced(name: str) -> None:
    """Whatever a device calls itself, the page has the same elements and only printable characters."""
    from northfinder.report.page import render  # noqa: PLC0415  # beside its only use
    from northfinder.text import printable  # noqa: PLC0415

    given_names = {
        "title": "t", "value": "", "interval": "", "basis": "", "facts": [("gyro", printable(name))], "plots": [],
        "scatter_head": [], "scatter_rows": [], "judged_head": [], "judged_rows": [], "record_head": [],
        "record_rows": [[printable(name)]], "version": "",
    }  # fmt: skip
    page = Page(render("campaign.html", **given_names))
    plain = Page(render("campaign.html", **(given_names | {"facts": [("gyro", "x")], "record_rows": [["x"]]})))
    assert page.elements == plain.elements
    assert all(character.isprintable() or character == "\n" for text in page.texts for character in text)


def test_colours_stand_out_in_every_scheme() -> None:
    """As WCAG 2 asks, AA: texts 4.5 to 1 from what they stand on, lines and bars 3 to 1; light, dark and printed."""
    style = (resources.files("northfinder.report") / "templates" / "style.css").read_text(encoding="utf-8")
    schemes = [
        dict(re.findall(r"--([a-z]+): (#[0-9a-f]{6})", each))
        for each in re.findall(r":root \{(.*?)\}", style, re.DOTALL)
    ]
    assert len(schemes) == 3
    for scheme in schemes:
        for ground in ("paper", "sheet", "shade"):
            for text in ("ink", "muted", "good", "bad", "warn"):
                assert _contrast(scheme[text], scheme[ground]) >= 4.5, (text, ground)
            for line in ("accent", "one", "two", "three", "faint", "model"):
                assert _contrast(scheme[line], scheme[ground]) >= 3.0, (line, ground)


def _contrast(one: str, other: str) -> float:
    """Return the contrast ratio of WCAG 2."""
    light, dark = sorted((_luminance(one), _luminance(other)), reverse=True)
    return (light + 0.05) / (dark + 0.05)


def _luminance(colour: str) -> float:
    parts = [int(colour[k : k + 2], 16) / 255.0 for k in (1, 3, 5)]
    red, green, blue = (part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def test_a_record_without_an_azimuth_has_a_report(early: Path) -> None:
    """It says why there is none, and shows what was measured."""
    page = Page(record_page(gather_record(early)))
    check_self_contained(page)
    assert "No azimuth" in page.text
    assert "do not determine" in page.text
    assert "Rate against time" in page.text
    assert "Allan deviation" not in page.text


@pytest.mark.parametrize(
    ("table", "column", "value", "readable"),
    [
        ("step", "sample_rate", 0.0, False), ("step", "sample_rate", 1e308, False),
        ("step", "stream_start", -1e308, False), ("step", "stop_index", 0, False),
        ("step", "name", "<b>\x1b", True), ("event", "time", 1e300, True),
        ("stage_state", "elevation", math.inf, True), ("stage_state", "device_time", -1e308, True),
        ("block", "temperature", 1e308, True), ("meta", "value", "[[[]]]", None), ("fix", "value", "3", True),
    ],
)  # fmt: skip
def test_a_record_that_cannot_be_is_one_sentence(
    early: Path,
    tmp_path: Path,
    table: str,
    column: str,
    value: object,
    readable: bool | None,  # noqa: FBT001  # a case
) -> None:
    """Rows with sound seals and absurd values give a page, or a RecordError: never anything else."""
    for number in range(1, 7 if table == "meta" else 2):
        path = tmp_path / f"{number}.sqlite"
        shutil.copy(early, path)
        with contextlib.closing(sqlite3.connect(path)) as db, db:
            row = list(db.execute(f"SELECT {NAMES[table]} FROM {table} WHERE id = ?", (number,)).fetchone())  # noqa: S608
            names = [each.strip() for each in NAMES[table].split(",")]
            row[names.index(column)] = value
            db.execute(f"DELETE FROM {table} WHERE id = ?", (number,))  # noqa: S608  # names of ours
            db.execute(INSERT[table], sealed(table, number, row[1:-1]))
        refusal = ""
        try:
            check_self_contained(Page(record_page(gather_record(path))))
        except RecordError as error:
            refusal = str(error)
        assert readable in {None, not refusal}
        assert not refusal or str(path) in refusal


def test_three_axes_and_many_dwells(axes: Path) -> None:
    """Each axis has its colour; beyond 48 dwells the page says how many it leaves out."""
    report = gather_record(axes)
    page = Page(record_page(report))
    check_self_contained(page)
    assert "axis 3" in page.text
    assert "The 12 later dwells are not drawn" in page.text
    loud = replace(report, dwells=tuple(replace(each, raw_sd=100.0 * each.raw_sd) for each in report.dwells))
    for text in (record_page(loud), record_markdown(loud)):
        assert not re.search(r"\de\+\d", text)  # no power of ten among figures for people
    assert report.n_missing == 0


def test_the_rose_points_where_the_azimuth_does() -> None:
    """The needle's tip lies in the direction of the azimuth in all quadrants; the wedge is as wide as the interval."""
    for azimuth in (0.0, 33.0, 123.0, 213.0, 303.0):
        svg = rose(azimuth, 2.0, grid_deg=None, magnetic_deg=None)
        needle = re.search(r'class="needle" d="M(\S+) (\S+?)L', svg)
        assert needle is not None
        x, y = float(needle[1]), float(needle[2])
        assert math.degrees(math.atan2(x, -y)) % 360 == pytest.approx(azimuth, abs=0.02)
        wedge = re.search(r'class="wedge" d="M0 0L(\S+) (\S+?)A\S+ \S+ 0 0 1 (\S+) (\S+?)Z', svg)
        assert wedge is not None
        low, high = (math.degrees(math.atan2(float(wedge[k]), -float(wedge[k + 1]))) for k in (1, 3))
        assert (high - low) % 360 == pytest.approx(4.0, abs=0.02)


# The command and the other formats


def invoke(*arguments: object) -> Result:
    """Run the command line in this process."""
    return CliRunner().invoke(cli, [str(each) for each in arguments], catch_exceptions=True)


@pytest.mark.parametrize(
    ("kind", "begins"),
    [
        ("html", b"<!doctype html>"),
        ("svg", b"<?xml"),
        ("png", b"\x89PNG"),
        ("pdf", b"%PDF"),
        ("json", b"{"),
        ("md", b"# "),
    ],
)
def test_each_format_is_written_beside_the_record(emulated: Path, kind: str, begins: bytes) -> None:
    """With the record's name, and said on standard output."""
    done = invoke("report", emulated, "--format", kind)
    assert done.exit_code == 0, done.output
    path = emulated.with_suffix(f".{kind}")
    assert done.output.strip() == str(path)
    assert path.read_bytes().startswith(begins)
    assert sorted(each.name for each in emulated.parent.glob(".*")) == []


def test_the_json_is_the_report_as_data(emulated: Path, report: RecordReport) -> None:
    """On standard output, one object: the fix of solve, the dwells, the residuals' Allan deviation."""
    done = invoke("report", emulated, "--format", "json", "-o", "-")
    data = json.loads(done.output)
    assert data["result"]["azimuth_deg"] == report.result["azimuth_deg"]
    assert len(data["dwells"]) == 8
    assert data["residual_allan"]["tau_s"][0] == 1.0
    assert data["identities"]["gyro"]["serial_number"] == "SIM-G1"
    assert set(data) == set(record_json(report))


def test_the_markdown_has_tables_of_equal_rows(report: RecordReport) -> None:
    """Each table's rows have as many cells as its head."""
    for table in re.findall(r"(?:^\|.*\|\n)+", record_markdown(report), re.MULTILINE):
        cells = {len(re.findall(r"(?<!\\)\|", row)) for row in table.splitlines()}
        assert len(cells) == 1


def test_a_picture_of_one_part(emulated: Path, early: Path, tmp_path: Path) -> None:
    """The same data give the same file; what a record does not have is named."""
    files = [tmp_path / f"{n}.svg" for n in (1, 2)]
    for file in files:
        assert invoke("report", emulated, "--part", "rate", "-o", file).exit_code == 0
    assert files[0].read_bytes() == files[1].read_bytes()
    none = tmp_path / "none.svg"
    assert invoke("report", early, "-o", none).exit_code == 0
    said = " ".join(re.findall(r"<!-- (.*?) -->", none.read_text(encoding="utf-8")))
    assert "No azimuth these positions do not determine" in said
    done = invoke("report", early, "--part", "allan", "-o", tmp_path / "a.svg")
    assert "nothing to draw as --part allan" in str(done.exception)


@pytest.mark.parametrize("name", ["emulated", "hostile", "early", "axes"])
def test_nothing_leaves_the_paper(name: str, request: pytest.FixtureRequest) -> None:
    """Every text lies on its page, whatever it is and however many there are; the last says which record it is."""
    report = gather_record(request.getfixturevalue(name))
    report = replace(report, events=tuple((IN_2026, "note", f"a lorry, {number}") for number in range(120)))
    with report_style():
        pages = record_pages(report)
        for page in pages:
            FigureCanvasAgg(page).draw()  # type: ignore[no-untyped-call]  # matplotlib's
            width, height = page.bbox.size
            for text in page.findobj(Text):
                box = text.get_window_extent()
                if text.get_text().strip() and text.get_visible():
                    assert min(box.x0, box.y0) >= 0.0, text
                    assert box.x1 <= width, text
                    assert box.y1 <= height, text
    said = [text.get_text() for page in pages for text in page.texts]
    assert f"{name}.sqlite" in said[1:]
    assert {"note: a lorry, 0", "note: a lorry, 119"} <= set(said)


def test_a_legend_leaves_the_title_alone(axes: Path) -> None:
    """Three axes have many names: they stand on a line of their own."""
    with report_style():
        figure = record_pages(gather_record(axes))[1]
        FigureCanvasAgg(figure).draw()  # type: ignore[no-untyped-call]  # matplotlib's
        axis = figure.axes[0]
        legend = axis.get_legend()
        assert legend is not None
        assert len(legend.get_texts()) == 4
        (title,) = [each for each in axis.findobj(Text) if each.get_text() == "Rate against time"]
        assert not legend.get_window_extent().overlaps(title.get_window_extent())


def test_no_record_is_ever_written_over(emulated: Path) -> None:
    """Neither the one that is read nor any other database."""
    before = emulated.read_bytes()
    done = invoke("report", emulated, "-o", emulated)
    assert isinstance(done.exception, ConfigError)
    assert emulated.read_bytes() == before


def test_the_report_of_a_campaign(folder: Path, emulated: Path, hostile: Path) -> None:
    """Many records give one page, and its tables and picture in the other formats."""
    page = folder / "campaign.html"
    done = invoke("report", emulated, hostile, "-o", page)
    assert done.exit_code == 0, done.exception
    parsed = Page(page.read_text(encoding="utf-8"))
    check_self_contained(parsed)
    assert "Campaign of 2 measurements" in parsed.text
    for kind, begins in (("md", "# Campaign"), ("json", '{"n_records":2'), ("svg", "<?xml")):
        path = folder / f"campaign.{kind}"
        assert invoke("report", emulated, hostile, "-o", path).exit_code == 0
        assert path.read_text(encoding="utf-8").startswith(begins)


def campaign_of(azimuths: list[float], turn_ons: list[int], probability: float | None) -> dict[str, Any]:
    """Return what is needed of the result of a campaign."""
    rows = [{"azimuth_deg": each % 360.0, "turn_on": own} for each, own in zip(azimuths, turn_ons, strict=True)]
    mean = float(np.mean(azimuths)) % 360.0
    return {"records": rows, "azimuth": {"all": {"mean_deg": mean}, "between_turn_ons_probability": probability}}


def test_the_mean_of_a_campaign_has_its_interval() -> None:
    """By Student's t, across north; measurements after one turn-on count once where turn-ons differ."""
    azimuths = [359.9, 360.3, 359.8, 360.2]
    half, words = of_the_mean(campaign_of(azimuths, [1, 1, 2, 2], 0.7))
    assert half == pytest.approx(3.18245 * np.std(azimuths, ddof=1) / 2.0, rel=1e-5)
    assert words == "4 measurements"
    half, words = of_the_mean(campaign_of([10.0, 10.2, 20.0, 20.2, 30.0, 30.2], [1, 1, 2, 2, 3, 3], 1e-9))
    assert half == pytest.approx(4.30265 * 10.0 / math.sqrt(3.0), rel=1e-5)
    assert words == "3 turn-ons, which differ"


@pytest.mark.campaign
def test_a_page_is_measured_at_the_width_of_a_telephone(tmp_path: Path) -> None:
    """What fits 500 px, the narrowest window of the browser itself, and not 390 is found."""
    command = browser()
    if command is None:
        pytest.skip("no Chromium on this machine")
    chromium = Chromium(command, tmp_path)
    page = tmp_path / "page.html"
    words = "<p>word</p>" * 30
    page.write_text(f'<!doctype html><body><div style="width: 450px">{words}</div></body>', encoding="utf-8")
    assert look_measure(chromium, page, 1280)[1] == []
    assert "the page is wider than the window: 458 of 390" in look_measure(chromium, page, 390)[1]


@pytest.mark.campaign
def test_the_pages_in_a_browser(tmp_path: Path) -> None:
    """Rendered wide and narrow, light and dark, and on paper: nothing overlaps, is cut, complains or asks for more."""
    if browser() is None:
        pytest.skip("no Chromium on this machine")
    tool = Path(__file__).resolve().parents[1] / "tools" / "look.py"
    done = subprocess.run([sys.executable, str(tool), str(tmp_path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
