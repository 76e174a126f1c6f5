"""The Allan deviation as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from northfinder.errors import RecordError


def plot_allan(path: Path, title: str, result: dict[str, Any]) -> None:
    """Draw the deviation with its band and the fitted model of `noise_report.noise_json` into the SVG file `path`.

    Raises RecordError if the file cannot be written.
    """
    allan = result["allan"]
    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    axes = figure.add_subplot(xscale="log", yscale="log", xlabel="averaging time, s", ylabel="Allan deviation, deg/h")
    axes.fill_between(allan["tau_s"], allan["low_dph"], allan["high_dph"], alpha=0.25, label="95 % band")
    axes.plot(allan["tau_s"], allan["deviation_dph"], ".", label="measured")
    axes.plot(allan["tau_s"], allan["model_dph"], "k-", linewidth=1.0, label="identified noise")
    axes.set_title(title.replace("$", r"\$"), fontsize="medium")
    axes.grid(visible=True, which="both", alpha=0.3)
    axes.legend()
    try:
        # the same data give the same file: no date, and names that do not change
        with mpl.rc_context({"svg.hashsalt": "northfinder"}):
            figure.savefig(path, format="svg", metadata={"Date": None})
    except OSError as error:
        raise RecordError(f"the plot {path} cannot be written: {error.strerror}") from None
