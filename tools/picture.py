"""Draw the picture of the README: a seeded ``find`` on the emulated bench, its seconds and its result, as SVG.

python tools/picture.py docs/result.svg
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, cast

import matplotlib as mpl
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.projections.polar import PolarAxes

from northfinder.estimation import RateMeans
from northfinder.record import Record
from northfinder.reduction import reduce_record
from northfinder.units import DPH

COMMAND = ["find", "--json", "--quiet", "--speed", "max", "--seed", "1", "--time", "960"]


def find(folder: str) -> tuple[dict[str, Any], RateMeans]:
    """Return the result of a measurement and the means it rests on."""
    command = [sys.executable, "-m", "northfinder", *COMMAND, "--out", folder]
    fix = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    with Record(Path(fix["record"])) as record:
        return fix, reduce_record(record).means()


def draw_rates(axes: Axes, means: RateMeans) -> None:
    """Draw the mean rate of each second and of each dwell against time."""
    dwells = means.per_dwell()
    axes.plot(means.middle / 60, means.rate[:, 0] / DPH, ".", color="0.75", markersize=2, label="1 s means")
    axes.hlines(
        dwells.rate[:, 0] / DPH, dwells.start / 60, (dwells.start + dwells.duration) / 60, color="C0", linewidth=2,
        label="dwells",
    )  # fmt: skip
    axes.set(xlabel="time, min", ylabel="rate, deg/h", title="what the gyro said")
    axes.legend(loc="upper right", frameon=False)


def draw_compass(axes: PolarAxes, fix: dict[str, Any]) -> None:
    """Draw the azimuth on a compass rose, and the figures."""
    azimuth = math.radians(fix["azimuth_deg"])
    axes.set_theta_zero_location("N")
    axes.set_theta_direction(-1)
    axes.set_thetagrids(range(0, 360, 45), ["N", "NE", "E", "SE", "S", "SW", "W", "NW"])
    axes.set_yticks([])
    axes.annotate(
        "", xy=(azimuth, 1.0), xytext=(azimuth, 0.0), arrowprops={"arrowstyle": "-|>", "color": "C3", "lw": 2}
    )
    axes.set_title(
        f"azimuth {fix['azimuth_deg']:.2f} ± {fix['azimuth_sd_deg']:.2f} deg\n"
        f"latitude {fix['latitude_deg']:.2f} ± {fix['latitude_sd_deg']:.2f} deg"
    )


def main() -> None:
    """Measure and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        fix, means = find(folder)
    mpl.use("svg")
    mpl.rcParams["svg.hashsalt"] = "northfinder"  # the same data give the same file
    figure = plt.figure(figsize=(10, 4.2), layout="constrained")
    grid = figure.add_gridspec(1, 2, width_ratios=(1.7, 1))
    draw_rates(figure.add_subplot(grid[0]), means)
    draw_compass(cast("PolarAxes", figure.add_subplot(grid[1], projection="polar")), fix)
    figure.savefig(arguments.file, metadata={"Date": None})


if __name__ == "__main__":
    main()
