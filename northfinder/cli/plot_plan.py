"""Predicted standard deviations against time as a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from northfinder.errors import RecordError


def plot_plans(path: Path, title: str, curves: Mapping[str, Sequence[Mapping[str, Any]]]) -> None:
    """Draw what each plan states after its dwells (`plan_report.curve_json`) into the SVG file `path`.

    Raises RecordError if the file cannot be written.
    """
    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    axes = figure.add_subplot(xscale="log", yscale="log", xlabel="time, s", ylabel="predicted sd, deg")
    for name, points in curves.items():
        times = [point["time_s"] for point in points]
        (line,) = axes.plot(times, [point["azimuth_sd_cos_latitude_deg"] for point in points], ".-", label=name)
        measured = [point for point in points if point["latitude_sd_deg"] is not None]
        axes.plot(
            [point["time_s"] for point in measured],
            [point["latitude_sd_deg"] for point in measured],
            ".--",
            color=line.get_color(),
        )
    axes.set_title(title.replace("$", r"\$"), fontsize="medium")
    axes.grid(visible=True, which="both", alpha=0.3)
    axes.legend()
    try:
        # the same data give the same file: no date, and names that do not change
        with mpl.rc_context({"svg.hashsalt": "northfinder"}):
            figure.savefig(path, format="svg", metadata={"Date": None})
    except OSError as error:
        raise RecordError(f"the plot {path} cannot be written: {error.strerror}") from None
