"""Compare errors with stated standard deviations over the globe, each run a whole ``find`` on the emulated bench.

    python tools/consistency.py [--json] [--repeat N | --runs N] [-- FIND-OPTION...]
    python tools/consistency.py --buses [-- FIND-OPTION...]

Every azimuth of AZIMUTHS_DEG at every latitude of LATITUDES_DEG, or with --runs so many azimuths around the horizon at
these latitudes in turn, each with a seed of its own, through pseudo-terminals and the whole protocol. The rms of error
over stated standard deviation is 1 if the statement is honest.

With --buses each azimuth is measured over serial lines, over socketcand at full speed and over slcan at ten times real
time, with the same seed: a table of errors and standard deviations, and exit code 1 unless those of a bus are the
serial line's to SD_TOLERANCE, the errors to ERROR_TOLERANCE standard deviations.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass

AZIMUTHS_DEG = (0.0, 33.0, 90.0, 147.0, 180.0, 225.0, 270.0, 359.0)
LATITUDES_DEG = (-65.0, -33.0, 0.5, 20.0, 50.429, 75.0)
BUSES = {"serial": [], "socketcand": ["--bus", "socketcand"], "slcan": ["--bus", "slcan", "--speed", "10"]}
SD_TOLERANCE = 0.05
ERROR_TOLERANCE = 0.5


@dataclass(frozen=True, slots=True)
class Run:
    """One measurement and its errors."""

    seed: int
    azimuth_deg: float
    latitude_deg: float
    azimuth_error_deg: float
    azimuth_sd_deg: float
    latitude_error_deg: float | None
    latitude_sd_deg: float | None
    trustworthy: bool


def find(azimuth_deg: float, latitude_deg: float, seed: int, options: list[str]) -> Run:
    """Run one measurement."""
    command = [
        sys.executable, "-m", "northfinder", "find", "--json", "--quiet", "--speed", "max", "--seed", str(seed),
        "--sim-azimuth", str(azimuth_deg), "--sim-latitude", str(latitude_deg), *options,
    ]  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run([*command, "--out", folder], capture_output=True, text=True, check=False)
    if not done.stdout:
        raise SystemExit(f"{' '.join(command)} ended with exit code {done.returncode}: {done.stderr}")
    fix = json.loads(done.stdout)
    latitude = fix["latitude_deg"]
    return Run(
        seed=seed,
        azimuth_deg=azimuth_deg,
        latitude_deg=latitude_deg,
        azimuth_error_deg=math.remainder(fix["azimuth_deg"] - azimuth_deg, 360.0),
        azimuth_sd_deg=fix["azimuth_sd_deg"],
        latitude_error_deg=None if latitude is None else latitude - latitude_deg,
        latitude_sd_deg=fix["latitude_sd_deg"],
        trustworthy=fix["trustworthy"],
    )


def places(repeat: int, n_runs: int | None) -> list[tuple[float, float]]:
    """Return azimuth and latitude of each run, deg."""
    if n_runs is None:
        return [(azimuth, latitude) for latitude in LATITUDES_DEG for azimuth in AZIMUTHS_DEG] * repeat
    azimuths = [360.0 * (number + 0.3) / n_runs for number in range(n_runs)]
    return list(zip(azimuths, itertools.cycle(LATITUDES_DEG), strict=False))


def all_runs(at: list[tuple[float, float]], options: list[str]) -> Iterator[Run]:
    """Run once at each place, and show each."""
    for seed, (azimuth, latitude) in enumerate(at, start=1):
        run = find(azimuth, latitude, seed, options)
        print(
            f"azimuth {azimuth:5.1f} latitude {latitude:6.2f}: azimuth {run.azimuth_error_deg:+.3f} "
            f"(sd {run.azimuth_sd_deg:.3f}), latitude {run.latitude_error_deg} (sd {run.latitude_sd_deg})",
            file=sys.stderr,
        )
        yield run


def compare_buses(options: list[str]) -> bool:
    """Print the table of all azimuths over serial lines and buses; return whether they agree."""
    print("| azimuth | " + " | ".join(f"{bus}: error, sd, deg" for bus in BUSES) + " | greatest difference, sd |")
    print("|---|" + "---|" * (len(BUSES) + 1))
    agree = True
    for seed, azimuth in enumerate(AZIMUTHS_DEG, start=1):
        serial, *others = runs = [find(azimuth, 50.429, seed, [*options, *extra]) for extra in BUSES.values()]
        sd = serial.azimuth_sd_deg
        difference = max(abs(run.azimuth_error_deg - serial.azimuth_error_deg) for run in others) / sd
        same_sd = all(abs(run.azimuth_sd_deg / sd - 1) <= SD_TOLERANCE for run in others)
        agree = agree and same_sd and difference <= ERROR_TOLERANCE
        cells = [f"{run.azimuth_error_deg:+.4f}, {run.azimuth_sd_deg:.4f}" for run in runs]
        print(f"| {azimuth} | {' | '.join(cells)} | {difference:.3f} |", flush=True)
    return agree


def rms(values: list[float]) -> float | None:
    """Return the root mean square, None of nothing."""
    return math.sqrt(math.fsum(value**2 for value in values) / len(values)) if values else None


def main() -> None:
    """Run them all and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=1)
    parser.add_argument("--runs", type=int, metavar="N", help="so many azimuths instead of the whole grid")
    parser.add_argument("--buses", action="store_true", help="compare CAN buses with serial lines")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    parser.add_argument("options", nargs="*", help="handed to find, after --")
    arguments = parser.parse_args()
    if arguments.buses:
        sys.exit(0 if compare_buses(arguments.options) else 1)
    runs = list(all_runs(places(arguments.repeat, arguments.runs), arguments.options))
    latitudes = [(run.latitude_error_deg, run.latitude_sd_deg) for run in runs]
    figures = {
        "n_runs": len(runs),
        "n_trustworthy": sum(run.trustworthy for run in runs),
        "azimuth_rms_over_sd": rms([run.azimuth_error_deg / run.azimuth_sd_deg for run in runs]),
        "latitude_rms_over_sd": rms([error / sd for error, sd in latitudes if error is not None and sd]),
        "latitude_mean_error_deg": math.fsum(error or 0.0 for error, _ in latitudes) / len(runs),
        "largest_azimuth_error_over_sd": max(abs(run.azimuth_error_deg) / run.azimuth_sd_deg for run in runs),
    }
    if arguments.json:
        print(json.dumps(figures | {"runs": [asdict(run) for run in runs]}))
        return
    for name, value in figures.items():
        print(f"{name:32} {value if value is None else round(value, 4)}")


if __name__ == "__main__":
    main()
