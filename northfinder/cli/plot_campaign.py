"""A campaign as a picture: azimuth and latitude of each measurement with what was stated of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from northfinder.errors import RecordError


def plot_campaign(path: Path, result: dict[str, Any]) -> None:
    """Draw the measurements of `campaign_report.campaign_json` in order into the SVG file `path`.

    Raises RecordError if the file cannot be written.
    """
    latitudes = [name for name in ("stated", "with_ratio", "plain") if name in result["latitude"]]
    figure = Figure(figsize=(7.0, 2.5 + 2.5 * bool(latitudes)), layout="constrained")
    axes = figure.subplots(1 + bool(latitudes), 1, sharex=True, squeeze=False)[:, 0]
    centre = result["azimuth"]["all"]["mean_deg"]
    _draw(axes[0], result, "azimuth_deg", "azimuth_sd_deg", label="stated", centre=centre)
    axes[0].set_ylabel("azimuth, deg")
    if latitudes:
        for name in latitudes:
            sd = "latitude_sd_deg" if name == "stated" else None
            _draw(axes[1], result, f"latitude_{name}_deg", sd, label=name.replace("_", " "))
        axes[1].set_ylabel("latitude, deg")
        axes[1].legend(fontsize="small")
    for axis, truth in zip(axes, ("true_azimuth_deg", "true_latitude_deg"), strict=False):
        if result[truth] is not None:
            axis.axhline(result[truth], color="k", linewidth=0.8)
        for i in _turn_ons(result):
            axis.axvline(i - 0.5, color="k", linewidth=0.5, linestyle=":")
        axis.grid(visible=True, alpha=0.3)
    axes[-1].set_xlabel("measurement (dotted: turn-on)")
    try:
        with mpl.rc_context({"svg.hashsalt": "northfinder"}):  # the same data give the same file
            figure.savefig(path, format="svg", metadata={"Date": None})
    except OSError as error:
        raise RecordError(f"the plot {path} cannot be written: {error.strerror}") from None


def _draw(
    axis: Axes, result: dict[str, Any], value: str, sd: str | None, *, label: str, centre: float | None = None
) -> None:
    rows = [(i, row) for i, row in enumerate(result["records"]) if row.get(value) is not None]
    x, y = [i + 1 for i, _ in rows], [row[value] for _, row in rows]
    if centre is not None:  # azimuths about north stand together
        y = [centre + (each - centre + 180.0) % 360.0 - 180.0 for each in y]
    bars = None if sd is None else [row[sd] for _, row in rows]
    axis.errorbar(x, y, yerr=bars, fmt=".", capsize=2, label=label)


def _turn_ons(result: dict[str, Any]) -> list[int]:
    """Return the number of the first measurement of each turn-on but the first."""
    turn_ons = [row["turn_on"] for row in result["records"]]
    return [i + 1 for i in range(1, len(turn_ons)) if turn_ons[i] != turn_ons[i - 1]]
